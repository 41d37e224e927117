//! The line-array engine compared with the direct sum and with the slow reference.

mod alone;
mod models;
mod moving;
mod still;
mod tolerance;

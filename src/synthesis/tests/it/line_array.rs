//! Tests of the line-array engine against the direct sum and the slow reference.

mod alone;
mod models;
mod moving;
mod still;
mod tolerance;

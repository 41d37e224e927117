//! Tests of the line-array engine against the direct sum and the slow reference.

mod models;
mod moving;
mod single_echo;
mod still;
mod tolerance;

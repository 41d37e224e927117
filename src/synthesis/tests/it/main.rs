//! Tests of the echo model against closed forms and direct, slow formulas. `echo` and `array` are tested together through their
//! public interfaces.

mod error_models;
mod gridded_lines;
mod line_array;
mod moving;
mod paths;
mod probe;
mod rays;
mod receiver;
mod reflected_rays;
mod span;
mod synthesis;
mod walk;

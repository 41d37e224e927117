//! The echo model compared with closed forms and with direct, slow formulas: `echo` and `array` together, through their public interfaces.

mod error_models;
mod gridded_lines;
mod line_array;
mod paths;
mod probe;
mod receiver;
mod span;
mod synthesis;
mod walk;

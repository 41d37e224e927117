//! The echo model held to closed forms and to plain slow formulas: `echo` and `array` together, through their public faces.

mod error_models;
mod paths;
mod probe;
mod receiver;
mod rig;
mod span;
mod synthesis;
mod walk;

//! Measurement of tolerances: every method at every tolerance on scenes with a moving platform.
//!
//! Read [`case`] (scenes and motions), [`methods`] (choice of models and synthesis, or refusal) and [`measure`] (truth and error norms).

pub(crate) mod case;
pub(crate) mod draw;
pub(crate) mod measure;
pub(crate) mod methods;
pub(crate) mod table;

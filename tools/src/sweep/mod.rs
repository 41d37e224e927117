//! The contract of tolerances, measured: every method asked for every tolerance on scenes that move.
//!
//! Read [`case`] (scenes and motions), [`methods`] (how a tolerance becomes models and a sum, or a refusal), [`measure`] (truth and norm).

pub(crate) mod case;
pub(crate) mod draw;
pub(crate) mod measure;
pub(crate) mod methods;
pub(crate) mod table;

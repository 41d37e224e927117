//! The contract of tolerances, measured: every method asked for every tolerance on scenes that move.
//!
//! Read [`case`] (scenes and motions), [`methods`] (how a tolerance becomes models and a sum, or a refusal), [`measure`] (truth and norm).

pub mod case;
pub mod draw;
pub mod measure;
pub mod methods;
pub mod table;

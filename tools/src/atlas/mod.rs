//! The failure atlas: sweeps through every regime in which methods are known to fail.
//!
//! Read [`spot`] (one sonar, one motion, one scene), [`regimes`] (the sweeps) and [`measure`] (results of every method and of the
//! selection).

pub(crate) mod measure;
pub(crate) mod regimes;
pub(crate) mod spot;

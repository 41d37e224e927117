//! The map of failures: every regime in which methods are known to break, swept through the place where they do.
//!
//! Read [`spot`] (one sonar, one motion, one scene), [`regimes`] (what is swept), [`measure`] (what every method makes of it, and the plan).

pub(crate) mod measure;
pub(crate) mod regimes;
pub(crate) mod spot;

//! Short forms of the commands: stored tables that still hold, tolerances that are kept.

mod bench;
mod charts;
mod plan;
mod regimes;
mod simplify;
mod soundings;
mod stability;
mod sweep;

//! Short forms of the commands: tests of the stored tables and of the tolerances.

mod bench;
mod charts;
mod plan;
mod regimes;
mod simplify;
mod soundings;
mod stability;
mod sweep;

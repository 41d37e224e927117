//! One ping from its order to its output: schedule, plan, method selection, echo model, receiver, beams and lines.
//!
//! No file, no socket and no clock: the runtime says when, and hands the results over.

#![warn(missing_docs)]
#![cfg_attr(not(test), deny(clippy::disallowed_methods))]

pub mod conditions;
pub mod element_synthesis;
pub mod engines;
pub mod error_check;
pub mod fan_truth;
pub mod faults;
pub mod footprints;
mod image_thinning;
pub(crate) mod line_engines;
pub mod line_truth;
pub mod make_ping;
pub mod method_selection;
pub mod methods;
pub mod more_pulses;
mod multipath;
pub mod ping_cost;
pub mod pipeline;
pub mod plan;
mod range_floors;
mod refraction;
pub mod rig;
pub mod rig_schedule;
pub mod schedule;
mod sea_surface;
pub mod threads;
pub mod trigger;
pub mod view;
mod volume;
pub mod work;
pub mod world;

pub use make_ping::{finish_ping, make_degraded_ping, make_ping};
pub use plan::{blank, fill, max_samples, max_segments, polyline, pulse, sample_count};
pub use range_floors::RangeFloorFinder;
pub use refraction::virtual_point_m;
pub use schedule::{PingOrder, Schedule, TURNAROUND_S, period_ns, window_s};
pub use trigger::{EarlyPolicy, Refusal, Triggered};
pub use volume::volume_directions;

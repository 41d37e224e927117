//! Bytes to samples, samples to a state at a time. Sans I/O.
//!
//! ```text
//! bytes -> framing -> sentence -> message_time -> decoder -> NavSample -> history (rings) -> Trajectory, NavState
//! ```
//! `log` and `track` read recorded files (already in memory).
//! Not modelled: depth sensors, binary attitude, fail-over between sources, several talkers on one line told apart.
pub mod decoder;
mod fields;
pub mod framing;
pub mod history;
pub mod log;
pub mod message_time;
pub mod ring;
pub mod sentence;
pub mod track;

pub use crate::geodesy::LocalTangentPlane;
pub use decoder::{NavCounters, NavDecoder};
pub use history::{Coverage, HistoryCounts, NavGap, NavHistory};

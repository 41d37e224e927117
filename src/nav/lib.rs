//! Navigation: decodes bytes to samples, and samples to the state and trajectory of the platform. Sans I/O.
//!
//! ```text
//! bytes -> framing -> sentence -> message_time -> decoder -> NavSample -> history (rings) -> Trajectory, NavState
//! ```
//!
//! Fixed-length records (`records`) and MAVLink messages (`mavlink`) are decoded to the same [`reading::Reading`]s as sentences.
//! [`log`] and [`track`] decode recorded files in memory. [`capture`] extracts the datagrams of a packet capture. [`encode`] writes
//! sentences for output. Speed measurements of Doppler logs are not supported.
#![warn(missing_docs)]
#![cfg_attr(not(test), deny(clippy::disallowed_methods))]

pub mod capture;
pub mod decoder;
pub mod detection;
pub mod encode;
pub mod fault;
mod fields;
pub mod framing;
pub mod health;
pub mod history;
pub mod log;
pub mod mavlink;
pub(crate) mod message_time;
pub mod passes;
mod proprietary;
pub mod reading;
pub mod recording;
pub mod records;
pub mod replacement;
pub mod report;
pub mod ring;
pub mod sentence;
pub mod stamp;
pub mod track;

pub use decoder::{NavCounters, NavDecoder};
pub use echotank_core::geodesy::LocalTangentPlane;
pub use history::{Coverage, HistoryCounts, NavGap, NavHistory};

//! Bytes to samples, samples to a state at a time. Sans I/O.
//!
//! ```text
//! bytes -> framing -> sentence -> message_time -> decoder -> NavSample -> history (rings) -> Trajectory, NavState
//! ```
//! Records of fixed length (`records`) and MAVLink (`mavlink`) become the same readings as sentences. `log` and `track` read recorded files
//! (already in memory); `capture` finds the datagrams in a packet capture.
//! [`encode`] makes the sentences that go out.
//! Not modelled: Doppler logs.
pub mod capture;
pub mod decoder;
pub mod encode;
mod fields;
pub mod framing;
pub mod health;
pub mod history;
pub mod log;
pub mod mavlink;
pub(crate) mod message_time;
mod proprietary;
pub mod reading;
pub mod records;
pub mod report;
pub mod ring;
pub mod sentence;
pub mod spoil;
pub mod stamp;
pub mod track;

pub use decoder::{NavCounters, NavDecoder};
pub use echotank_core::geodesy::LocalTangentPlane;
pub use history::{Coverage, HistoryCounts, NavGap, NavHistory};

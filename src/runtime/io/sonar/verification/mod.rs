//! A verifying receiver for each live family. The receiver acts like a topside and counts every record.
//!
//! - [`decode`]: bytes to numbered records
//! - [`accounting`]: lost, duplicate, late, damaged and different records
//! - [`report`]: the findings as JSON lines
//! - [`listener`]: the sockets
//!
//! | family | evidence of a fault |
//! |---|---|
//! | 7k | ping numbers of 7000, 7007, 7018, 7038, 7503; a checksum |
//! | JSF | ping numbers of messages 80, by channel; no checksum |
//! | WBMS | ping numbers of all packets; a CRC |
//! | Ping | ping numbers of 2198, 3011, 3012; a checksum |
//! | VITA 49 | a 4-bit count per stream and the packet times: up to 15 consecutive losses; no checksum |
//! | element stream | frame numbers; no checksum |
//! | Imagenex 872 | only surplus answers and undecodable bytes |
//!
//! If a family has no checksum, content is compared with a run without faults. Runs with the same seed give identical payloads.

pub mod accounting;
pub mod decode;
pub mod listener;
pub mod report;

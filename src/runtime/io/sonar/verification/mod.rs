//! A listener for every live family: takes what a sonar sends as a topside would, and accounting for it by whatever its records carry.
//!
//! - [`decode`]: bytes to records and their places among the unnumbered
//! - [`accounting`]: what is lost, came twice or late, is damaged or different
//! - [`report`]: the findings as JSON lines
//! - [`listener`]: the sockets
//!
//! | family | what tells |
//! |---|---|
//! | 7k | ping numbers of 7000, 7007, 7018, 7038, 7503; a checksum |
//! | JSF | ping numbers of messages 80, by channel; no checksum |
//! | WBMS | ping numbers of all packets; a CRC |
//! | Ping | ping numbers of 2198, 3011, 3012; a checksum |
//! | VITA 49 | a count of 4 bits per stream and the packets' times: up to 15 lost in a row; no checksum |
//! | element stream | frame numbers; no checksum |
//! | Imagenex 872 | nothing: that there are more answers than were asked for, or bytes of none |
//!
//! What no checksum tells is found against the sums of the same run without faults: with one seed the payload is the same bit for bit.

pub mod accounting;
pub mod decode;
pub mod listener;
pub mod report;

//! Transmission and file formats of sonars and recordings, sans I/O.
//!
//! Parsers read slices, and emitters append to buffers of the caller. The crate opens no socket or file, reads no clock, and does
//! not depend on the rest of the program. Each format has one folder. The files of a format have the same order: description and
//! source, frame, records, lengths, parsing, emitting, printing, tests.
//!
//! Two guarantees are valid for every format. Parsing never panics for any bytes. Emitting allocates only when the caller's buffer
//! grows.
//!
//! - [`sevenk`]: Teledyne RESON 7k (TCP and UDP port 7000, `.s7k` files).
//! - [`jsf`]: EdgeTech JSF (TCP ports 1700 and 1701, `.jsf` files).
//! - [`wbms`]: NORBIT WBMS (TCP ports 2209 to 2212); [`imagenex872`]: Imagenex 872 (TCP port 4040).
//! - [`elements`]: element samples with a minimal header, Echotank's own format.
//! - [`ping_protocol`]: Blue Robotics and Cerulean Ping protocol (Omniscan 450, Surveyor 240).
//! - [`sigmf`]: metadata of a sample file; [`wav`]: multichannel WAV and RF64.
//! - [`vita49`]: ANSI/VITA 49.2 signal data and context packets (UDP port 4991).
//! - [`xtf`]: Triton XTF files.
//!
//! [`describer`] describes messages of any format as text.

#![forbid(unsafe_code)]
#![warn(missing_docs)]
#![cfg_attr(not(test), deny(clippy::disallowed_methods))]

pub mod calendar;
pub mod describer;
pub mod elements;
pub mod framing;
pub mod imagenex872;
pub mod jsf;
mod layout;
pub mod ping_protocol;
pub mod sevenk;

pub mod sigmf;
pub mod vita49;
pub mod wav;
pub mod wbms;
pub mod xtf;

pub use layout::WireError;
pub use sevenk::frame::extend_encoded;

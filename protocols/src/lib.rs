//! Sonar wire formats, sans I/O.
//!
//! Bytes come in as slices and go out into buffers that belong to the caller. There is no socket, no file and no clock here, and nothing of
//! the program around it: a format is one folder, and every file in it keeps the same order: what it is and where its layout was read,
//! frame, records, length, parse, emit, print, tests.
//!
//! Two promises hold for every format. Parsing never panics, whatever the bytes; emitting allocates nothing but the growth of the
//! caller's buffer.
//!
//! - [`sevenk`]: Teledyne RESON 7k (TCP and UDP port 7000, `.s7k` files).
//! - [`jsf`]: EdgeTech JSF (TCP ports 1700 and 1701, `.jsf` files).
//! - [`wbms`]: NORBIT WBMS (TCP ports 2209 to 2212); [`imagenex872`]: Imagenex 872 (TCP port 4040).
//! - [`elements`]: element samples with little around them, a stream of our own.
//! - [`ping_protocol`]: Blue Robotics and Cerulean Ping protocol (Omniscan 450, Surveyor 240).
//! - [`sigmf`]: the words beside a file of samples; [`wav`]: multichannel WAV and RF64.
//! - [`vita49`]: ANSI/VITA 49.2 signal data and context packets (UDP port 4991).
//! - [`xtf`]: Triton XTF files.
//!
//! [`words`] prints any of them.

#![forbid(unsafe_code)]

pub mod calendar;
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
pub mod words;
pub mod xtf;

pub use layout::WireError;

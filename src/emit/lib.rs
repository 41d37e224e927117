//! Converts computed pings into records of sonar protocols, one module per sonar family. Sans I/O.
//!
//! The input is the plan and the output of one ping, and the record types that clients subscribe to. The output is complete,
//! time-stamped records in pooled buffers.

#![warn(missing_docs)]
#![cfg_attr(not(test), deny(clippy::disallowed_methods))]

pub mod blocks;
pub mod changes;
pub mod element_stream;
pub mod elements;
pub mod imagenex872;
pub mod jsf;
pub mod packets;
pub mod passband;
pub mod ping_protocol;
pub mod pool;
pub mod ros2;
pub mod session;
pub mod sevenk;
pub mod vita49;
pub mod wbms;
pub mod xtf;

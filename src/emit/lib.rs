//! Frames to datagrams, one folder per sonar family. Sans I/O.
//!
//! In: the plan and the output of one ping, and what somebody wants of it. Out: whole records, stamped, in buffers from a pool.
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
pub mod session;
pub mod sevenk;
pub mod vita49;
pub mod wbms;
pub mod xtf;

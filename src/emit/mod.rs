//! Frames to datagrams, one folder per sonar family. Sans I/O.
//!
//! In: the plan and the output of one ping, and what somebody wants of it. Out: whole records, stamped, in buffers from a pool.
pub mod pool;
pub mod session;
pub mod sevenk;

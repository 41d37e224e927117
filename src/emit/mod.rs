//! Frames to datagrams, one folder per sonar family. Sans I/O.
pub mod sevenk;

//! The domain types that every other crate shares: time, frames of reference, geodesy, and the data that passes between the stages of a ping.
//!
//! Knows no stage, opens no file and reads no clock.

pub mod flow;
pub mod frames;
pub mod geodesy;
pub mod time;
pub mod utm;

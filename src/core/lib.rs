//! Domain types shared by all other crates: time, frames of reference, geodesy, and the data passed between the stages of a ping.
//!
//! The crate depends on no other stage, opens no file and reads no clock.

#![warn(missing_docs)]
#![cfg_attr(not(test), deny(clippy::disallowed_methods))]

pub mod arrays;
pub mod frames;
pub mod geodesy;
pub mod instrument;
pub mod model;
pub mod navigation;
mod parts;
pub mod ping;
pub mod pulse;
pub mod records;
pub mod scene;
pub mod settings;
pub mod simd;
pub mod sound_speed;
#[doc(hidden)]
pub mod testing;
pub mod time;
pub mod utm;

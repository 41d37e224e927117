//! Forms beams from element samples ([`beam`]), and pictures, detections and mosaics from beams ([`image`]).

#![warn(missing_docs)]
#![cfg_attr(not(test), deny(clippy::disallowed_methods))]

pub mod beam;
pub mod image;

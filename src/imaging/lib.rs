//! Forms beams from element samples ([`beam`]), and pictures, detections and mosaics from beams ([`image`]).

#![warn(missing_docs)]

pub mod beam;
pub mod image;

//! From element samples to beams ([`beam`]) and from beams to pictures, detections and mosaics ([`image`]).

pub mod beam;
pub mod image;

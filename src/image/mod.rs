//! Beams to side-scan lines and pictures.

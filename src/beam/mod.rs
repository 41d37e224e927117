//! Element samples to beams.

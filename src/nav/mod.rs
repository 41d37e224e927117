//! Bytes to samples, samples to a state at a time.

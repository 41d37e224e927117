//! Arrivals to element samples, and the receiver chain.

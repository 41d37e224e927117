//! The plan of one ping.

//! Arrivals to element samples, and the receiver chain.
//!
//! In: [`ArrivalChunk`](crate::arrivals::ArrivalChunk)s of one element. Out: samples of its complex envelope in volts.
//! [`direct`] sums the echoes, [`filter`] takes a densely made sum down to the sample rate, [`receiver`] adds what the electronics do,
//! [`faults`] what they should not do.
//! [`gridded`] sums them on a grid within a tolerance, [`gridded2d`] and [`lines`] all elements of a line array at once. No configuration selects
//! [`lines`] yet.
//!
//! Not modelled: transmit leakage.

pub mod direct;
pub mod error_models;
pub mod faults;
pub mod filter;
pub mod gridded;
pub mod gridded2d;
pub mod lines;
pub(crate) mod phasor;
pub mod receiver;
pub mod windows;

pub use direct::Direct;
pub use filter::{Decimator, FilterError, oversample};
pub use receiver::receive;

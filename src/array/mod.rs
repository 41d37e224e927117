//! Arrivals to element samples, and the receiver chain.
//!
//! In: [`ArrivalChunk`](crate::flow::ArrivalChunk)s of one element. Out: samples of its complex envelope in volts.
//! [`direct`] sums the echoes, [`filter`] takes a densely made sum down to the sample rate, [`receiver`] adds what the electronics do.
//!
//! Not modelled: crosstalk, transmit leakage, gain and phase errors of single elements, dead elements.

pub mod direct;
pub mod filter;
pub mod gridded;
pub mod gridded2d;
mod phasor;
pub mod receiver;

pub use direct::Direct;
pub use filter::{Decimator, FilterError, oversample};
pub use receiver::receive;

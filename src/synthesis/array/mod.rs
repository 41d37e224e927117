//! Arrivals to element samples, and the receiver chain.
//!
//! In: [`ArrivalChunk`](echotank_core::flow::ArrivalChunk)s of one element. Out: samples of its complex envelope in volts.
//! [`direct`] sums the echoes, [`filter`] takes a densely made sum down to the sample rate, [`receiver`] adds what the electronics do,
//! [`faults`] what they should not do.
//! For comparison [`spectral`] sums them as the paper does, and [`nearest`] and [`linear`] as simple simulators do. [`gridded`] sums them on a
//! grid within a tolerance, [`gridded2d`] all elements of a line array at once.
//!
//! Not modelled: transmit leakage.

pub mod direct;
pub mod error_models;
pub mod faults;
pub mod filter;
pub mod gridded;
pub mod gridded2d;
pub mod linear;
pub mod nearest;
mod phasor;
pub mod receiver;
pub mod replica;
pub mod spectral;
pub mod windows;

pub use direct::Direct;
pub use filter::{Decimator, FilterError, oversample};
pub use linear::Linear;
pub use nearest::Nearest;
pub use receiver::receive;
pub use replica::Replica;
pub use spectral::{Bins, Spectral, Spectrum};

//! Synthesis of element samples from arrivals, and the receiver chain.
//!
//! The input is the [`ArrivalChunk`](crate::arrivals::ArrivalChunk)s of one element. The result is samples of its complex envelope
//! in volts. [`direct`] sums the echoes. [`filter`] decimates a dense sum to the sample rate. [`gridded`] sums the echoes of one
//! element on a grid within a tolerance. [`gridded2d`] and [`lines`] sum the echoes of all elements of a line array together.
//! [`instrument`] applies imperfections of transducers and receiver, [`receiver`] noise, gain and conversion, and [`faults`] faults.

pub mod direct;
pub mod echo_profile;
pub mod error_models;
pub mod faults;
pub mod filter;
pub mod gridded;
pub mod gridded2d;
pub mod instrument;
pub mod lines;
mod noise;
pub(crate) mod phasor;
pub(crate) mod quadrature;
pub mod receiver;
mod windows;

pub use direct::Direct;
pub use filter::{Decimator, FilterDesign, FilterError, oversample};
pub use receiver::{fill_gains, receive};
pub use windows::{DisplacedSums, EchoEnd, EchoEnds, cut_echoes, displaced_echo_errors, echo_ends};

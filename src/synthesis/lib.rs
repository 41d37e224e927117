//! Element samples of a ping: scatterers to arrivals ([`echo`]), arrivals to samples ([`array`]).
//!
//! In: a plan of the ping and its scatterers. Out: complex samples of every element, after the receiver. One crate, since the walk over the
//! scatterers and the engines that sum the arrivals are compiled together for each pair.

pub mod array;
pub mod comparison;
pub mod echo;
pub mod slabs;

#![warn(missing_docs)]
#![cfg_attr(not(test), deny(clippy::disallowed_methods))]
//! Element samples of one ping: scatterers to arrivals ([`echo`]), and arrivals to samples
//! ([`mod@array`]).
//!
//! Input: a [`PingPlan`](echotank_core::ping::PingPlan) and its scatterers. Output: complex
//! baseband samples of every element, after the receiver chain.
//!
//! Both stages are one crate because the compiler monomorphises the walk over the scatterers for
//! each engine that sums the arrivals.

pub mod array;
pub mod arrivals;
pub mod comparison;
pub mod echo;
pub mod edges;
pub mod error_model;
pub mod slabs;

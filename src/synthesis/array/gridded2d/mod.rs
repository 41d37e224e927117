//! Line arrays, whole stretches of elements at a time: a transform over delay and slope.
//!
//! An echo at y metres along a stretch of the line, of what left w seconds from mid-pulse, is late by
//!
//! ```text
//! u(y, w) = u - s y/c + d w + (second and third order in y and w) / R
//! ```
//!
//! with slope s, dilation d (its Doppler) and range R of its own. Echoes are spread on a grid over u and s. Of the dilation, the line
//! d = d0 + d1 s is left to the grid: a column of one slope has one Doppler, and the aperture grows by c d1 T. What is left of d (motion
//! across the array, the bottom's roughness) and R are short Chebyshev series; each echo carries its own values, so any steady motion of
//! the platform is met without a model of the bottom. The channels of the grid are a few sums of the series' products, as the echoes of the
//! task need them (`merge.rs`). What is smooth in the time of emission is taken
//! at a few instants of it, so a ping's templates are values of functions that only the pulse decides ([`pulse`]), read where the motion
//! puts them: they are made anew for every task. Then, column by column, FFT over time; block by block of bins, a few columns at a time,
//! templates and the turn from the column to each element, as a polynomial in the element's place times one rotor per block; element by
//! element, inverse FFT. Slabs of delay are added up in order.
//!
//! In: [`LineChunk`](echotank_core::flow::LineChunk)s of one slab at the middle of one stretch. Out: samples of its elements, receiver filter
//! included. f64 geometry and templates; grids and transforms in f32 or f64. A task is one thread's: no sum crosses threads.
//!
//! The strength of an echo differs along a stretch too (range, scattering law, element pattern): what is a line over the slope goes into the
//! templates, and the rest, where a survey of the echoes finds it too large, into channels of first and second order in the place. So does
//! what is left of the pulse's third order where the platform moves across the line.
//!
//! Not modelled: alias images of the filter's stop band (82 dB down).

pub mod alone;
mod columns;
mod elements;
#[cfg(target_arch = "x86_64")]
mod elements_avx512;
mod engine;
mod lanes;
mod line_array;
mod merge;
mod panel;
pub mod plan;
pub mod pulse;
mod sample;
mod series;
mod smooth;
mod spread;
#[cfg(target_arch = "x86_64")]
mod spread_avx512;
mod stages;
mod task;
mod weights;

pub use engine::{Filter, Fineness, LineEngine, Orders, PulseMotion, TaskReport, Work};
pub use line_array::Gridded2d;
pub use plan::{Bounds, Choice, Precision, Refusal, Spec, choose};
pub use sample::Sample;
pub use stages::{Stage, Stages};

//! Synthesis of line arrays, whole sections of elements at a time: a transform over delay and
//! slope.
//!
//! For an element at y metres along a section, sound that left w seconds from mid-pulse arrives at
//! the delay
//!
//! ```text
//! u(y, w) = u - s y/c + d w + (second and third order in y and w) / R
//! ```
//!
//! with slope s, dilation d (the Doppler) and range R of each echo. The engine spreads echoes on a
//! grid over u and s.
//!
//! The linear part d = d0 + d1 s of the dilation is left to the grid: a column of one slope has one
//! Doppler, and the aperture grows by c d1 T. The residual of d (motion across the array, roughness
//! of the seabed) and R enter as short Chebyshev series. Each echo carries its own values, so any
//! steady motion is covered without a model of the seabed. The channels of the grid are a few sums
//! of the products of these series, selected for the echoes of the task (`merge.rs`).
//!
//! Quantities that are smooth in the time of emission are evaluated at a few instants. Templates
//! are therefore values of functions of the pulse alone ([`pulse`]), read at the frequencies that
//! the motion sets, and are recomputed for every task.
//!
//! The steps are an FFT over time for each column, then templates and the phase from the column to
//! each element, then an inverse FFT for each element. The second step handles one block of bins
//! and a few columns at a time. It uses a polynomial in the element's position times one rotor per
//! block. Slabs of delay are added in order.
//!
//! Input: [`LineChunk`](crate::arrivals::LineChunk)s of one slab at the middle of one section.
//! Output: samples of its elements, with the receiver filter. Geometry and templates are f64, grids
//! and transforms f32 or f64. One thread computes a task, and no sum crosses threads.
//!
//! The strength of an echo also varies along a section (range, scattering law, element pattern).
//! The part that is linear in slope goes into the templates. Where a survey of the echoes finds the
//! residual too large, it goes into channels of first and second order in position. The residual of
//! the pulse's third order, from motion across the line, is treated in the same way.
//!
//! Not modelled: aliases from the stop band of the filter (82 dB down).

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
pub mod single_echo;
mod smooth;
mod spread;
#[cfg(target_arch = "x86_64")]
mod spread_avx512;
mod stages;
mod task;
mod weights;

pub use engine::{Filter, LineEngine, Orders, PulseMotion, Resolution, TaskReport, Work};
pub use line_array::Gridded2d;
pub use plan::{Bounds, Choice, Precision, Refusal, Spec, choose};
pub use sample::Sample;
pub use stages::{Stage, Stages, measure_stages};

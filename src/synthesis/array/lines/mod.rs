//! Synthesis of all elements of a line array together, 16 neighbouring elements in the lanes of a vector.
//!
//! An echo is a point on a grid of delays and Dopplers, at each element. It is spread over a few rows (delays) with a short kernel and over
//! a few columns (Dopplers) with interpolation weights:
//!
//! ```text
//! grid[block][column][row][element] += weight(column) kernel(row - x) amplitude exp(-j 2pi f_c (m - T/2))
//! ```
//!
//! Here m is the arrival of the middle of the pulse at the element and x the same in rows. An FFT over the rows of each column, a template per
//! column (the pulse stretched by its Doppler, the receiver filter, and the correction of the kernel) and an inverse FFT yield the samples.
//! All transforms run over the 16 elements of a block at once.
//!
//! - `kernel`: the kernel, a polynomial fitted to the spectrum of the pulse.
//! - `dopplers`: columns and their weights.
//! - `nodes`: interpolation along the line. Delays and gains are exact at nodes, and cubic within a block.
//! - `polynomials`: polynomials through values, by powers.
//! - `design`: sizes from a tolerance, with predicted error and cost.
//! - `windows`: the error in the worst window.
//! - `spread`: the inner loop.
//! - `products`: columns times templates.
//! - `aligned`: its buffers.
//! - `engine`: one ping. Start there.
//!
//! Sources: Fessler and Sutton 2003 (nonuniform FFT, least-squares kernels); Meng et al. 2023 (the echo model).
//!
//! The change of the Doppler during the pulse adds a phase that is quadratic in time: its mean over the pulse to the amplitude, and a delay of both ends to
//! the rows; the rest to the weights. See `dopplers`.
//!
//! Not modelled: most of the energy beyond half the sample rate, which the receiver filter attenuates by 82 dB and more.

mod aligned;
mod design;
mod dopplers;
mod engine;
mod kernel;
mod nodes;
mod polynomials;
mod products;
mod spread;
mod windows;

pub use design::{Design, Heard, LineMotion, MIN_TOLERANCE, Refusal, Spec};
pub use engine::GriddedLines;

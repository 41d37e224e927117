//! Which fineness a tolerance asks for, and what is refused.
//!
//! The parts of the error, each relative to the echoes of a window: the two kernels (computed, not estimated: [`Kernel::error`]), the
//! series (each task takes as many terms as its own echoes need, and reports what it left out), the delay's fourth order along a stretch,
//! the part of the twist that is no curve over the slope (motion across the array), rounding.

use std::f64::consts::TAU;

use crate::array::gridded::kernel::Kernel;
use crate::flow::{ArrayGeometry, MethodCard, Pulse};

use super::engine::{Fineness, PulseMotion};

/// Stretches tried, from long to short: long ones are cheap.
const STRETCHES: [usize; 6] = [128, 64, 32, 16, 8, 1];
/// Kernels of half a stretch's ends are worse than their mean over the band, and there are two of them.
const KERNEL_FACTOR: f64 = 3.0;
/// Of f32 grids and transforms: 1e-7 of the strongest echo of a slab, over the weakest window of it, some 30 dB below.
const F32_ERROR: f64 = 1e-5;
/// Of the worst case of the twist that no curve over the slope describes, how much a window's mean square sees (measured: a fifteenth).
const TWIST_SHARE: f64 = 1.0 / 8.0;
/// Per m/s along the array, 400 kHz, 5 ms, 36 m: third orders in slope and motion that are taken at a column's own slope (measured).
const UNDERWAY_ERROR_S_PER_M: f64 = 1.8e-6;
/// Below this nothing is promised: the receiver filter's stop band is 82 dB down and its image is left out, and motion across the array
/// leaves what the columns beside an echo do not know.
pub const LEAST_TOLERANCE: f64 = 2e-5;

/// What the scene and the platform may be.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Bounds {
    pub nearest_m: f64,
    /// Sine of the greatest angle from broadside.
    pub greatest_slope: f64,
    /// Speed along and across the array, m/s.
    pub along_m_per_s: f64,
    pub across_m_per_s: f64,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Precision {
    Single,
    Double,
}

/// What was chosen.
#[derive(Clone, Debug)]
pub struct Choice {
    pub fineness: Fineness,
    pub precision: Precision,
    pub card: MethodCard,
}

#[derive(Clone, Copy, Debug, PartialEq, thiserror::Error)]
pub enum Refusal {
    #[error("tolerance {tolerance}: gridded-2d promises none below {LEAST_TOLERANCE}")]
    TooFine { tolerance: f64 },
    #[error(
        "tolerance {tolerance}: with scatterers as near as {nearest_m} m and {across_m_per_s} m/s across the array no stretch of the \
         line is short enough for gridded-2d"
    )]
    TooNear {
        tolerance: f64,
        nearest_m: f64,
        across_m_per_s: f64,
    },
    #[error("sample rate {rate_hz} Hz: a slab of {samples} samples is too short for the pulse")]
    SlabTooShort { rate_hz: f64, samples: usize },
}

/// Longest slab that is tried, samples.
const MOST_SLAB: usize = 1 << 16;

/// The cheapest fineness that keeps `tolerance`.
pub fn choose(
    tolerance: f64,
    array: &ArrayGeometry,
    pulse: &Pulse,
    sound_speed_m_per_s: f64,
    rate_hz: f64,
    bounds: Bounds,
    motion: PulseMotion,
) -> Result<Choice, Refusal> {
    if tolerance.is_nan() || tolerance < LEAST_TOLERANCE {
        return Err(Refusal::TooFine { tolerance });
    }
    let per_m = TAU * (pulse.center_frequency_hz + 0.5 * rate_hz) / sound_speed_m_per_s;
    let half_s = 0.5 * pulse.duration_s;
    let beyond_series = |stretch: usize| {
        let half_m = 0.5 * stretch.min(array.elements) as f64 * array.spacing_m;
        let quartic = per_m * half_m.powi(4) / (8.0 * bounds.nearest_m.powi(3));
        let twist = per_m * bounds.across_m_per_s * bounds.greatest_slope * half_m * half_s
            / bounds.nearest_m;
        quartic + twist * TWIST_SHARE + UNDERWAY_ERROR_S_PER_M * bounds.along_m_per_s
    };
    // All parts but this one add up to four fifths of the tolerance at most, squared.
    let share = if tolerance < 1e-4 { 0.9 } else { 0.3 } * tolerance;
    let stretch = STRETCHES
        .into_iter()
        .find(|&stretch| beyond_series(stretch) <= share)
        .ok_or(Refusal::TooNear {
            tolerance,
            nearest_m: bounds.nearest_m,
            across_m_per_s: bounds.across_m_per_s,
        })?;
    let precision = if tolerance >= 4.0 * F32_ERROR {
        Precision::Single
    } else {
        Precision::Double
    };
    let moments = match precision {
        Precision::Single => 8,
        Precision::Double => 12,
    };
    // Where the rest is not small either, the kernels leave it room.
    let kernel_share = if tolerance < 1e-4 { 0.42 } else { 0.78 };
    let (width, kernel_error) = (2..=12)
        .map(|width| {
            (
                width,
                Kernel::new(width, 2.0, moments).error * KERNEL_FACTOR,
            )
        })
        .find(|(_, error)| *error <= kernel_share * tolerance)
        .ok_or(Refusal::TooFine { tolerance })?;
    // A third of a slab at most goes to echoes that begin near its end.
    let mut slab_samples = 1024;
    while (slab_samples as f64) < 3.0 * rate_hz * (pulse.duration_s + 2e-3) {
        slab_samples *= 2;
        if slab_samples > MOST_SLAB {
            return Err(Refusal::SlabTooShort {
                rate_hz,
                samples: slab_samples,
            });
        }
    }
    let series = 0.2 * tolerance;
    let rounding = match precision {
        Precision::Single => F32_ERROR,
        Precision::Double => 0.0,
    };
    let error = [kernel_error, series, beyond_series(stretch), rounding]
        .iter()
        .map(|e| e * e)
        .sum::<f64>()
        .sqrt();
    if error > tolerance {
        return Err(Refusal::TooFine { tolerance });
    }
    Ok(Choice {
        fineness: Fineness {
            stretch,
            slab_samples,
            time_width: width,
            slope_width: width,
            moments,
            series,
            motion,
        },
        precision,
        card: MethodCard {
            name: "gridded-2d",
            error,
            // Not predicted yet; `examples/line_array.rs` measures it.
            cost_ms: 0.0,
            why: format!(
                "stretches of {stretch} elements, kernels {width} wide ({kernel_error:.1e}), series to {series:.1e}, beyond them {:.1e}",
                beyond_series(stretch)
            ),
        },
    })
}

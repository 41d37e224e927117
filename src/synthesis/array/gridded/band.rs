//! Selection of the band of a received pulse that the engine keeps.
//!
//! Truncation of the spectrum must cause a small error in every window. The error is near the ends
//! of pulses, and a sharp truncation rings into times without an echo. The selection therefore
//! synthesises an echo with and without the truncation. It compares both window by window
//! ([`SingleEcho`]), as the accuracy requirement does.

use std::sync::LazyLock;

use crate::array::filter::bessel_i0;

use super::choose::SHARE;
use super::one_dimensional::{GriddedError, Spec};
use super::single_echo::SingleEcho;

/// Maximum width of the band in multiples of the sample rate. Half of it if a filter removes nearly
/// all energy beyond.
const MAX_BANDS: usize = 8;

/// Step between the bands to try, in sample rates.
const STEP: f64 = 0.125;

/// Fraction of the tolerance for truncation if no band reaches [`SHARE`].
const LAST_SHARE: f64 = 0.7;

/// The kept band of the received pulse.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Band {
    /// Half the width of the part with unit gain.
    pub(crate) whole_hz: f64,
    /// Width of the fade beyond; 0 for a sharp cut.
    pub(crate) fade_hz: f64,
    /// Truncation error in the worst window, in the units of the tolerance.
    pub outside: f64,
}

/// Width of the fade in sample rates. It confines the truncation error of an echo to 24 samples
/// about it.
const FADE: f64 = 0.125;

/// Shape parameter of the Kaiser window whose integral is the fade: 70 dB down beyond these 24
/// samples.
const FADE_BETA: f64 = 9.0;

impl Band {
    /// Gain at frequency `f_hz`.
    pub(super) fn gain(&self, f_hz: f64) -> f64 {
        let beyond_hz = f_hz.abs() - self.whole_hz;
        if beyond_hz <= 0.0 {
            return 1.0;
        }
        if beyond_hz >= self.fade_hz {
            return 0.0;
        }
        let place = beyond_hz / self.fade_hz * (FADING.len() - 1) as f64;
        let (cell, x) = (place as usize, place.fract());
        FADING[cell] * (1.0 - x) + FADING[cell + 1] * x
    }
}

/// Integral of the window from the outer end of the fade to its inner end.
static FADING: LazyLock<Vec<f64>> = LazyLock::new(|| {
    const STEPS: usize = 1024;
    let bump = |i: usize| {
        let x = 2.0 * (i as f64 + 0.5) / STEPS as f64 - 1.0;
        bessel_i0(FADE_BETA * (1.0 - x * x).sqrt())
    };
    let all: f64 = (0..STEPS).map(bump).sum();
    let mut left = all;
    let mut fading = vec![1.0];
    for i in 0..STEPS {
        left -= bump(i);
        fading.push((left / all).max(0.0));
    }
    fading
});

/// From this tolerance on, the choice of a band looks at twice the sample rate to either side. Beyond that, the stop band of a receiver filter passes
/// 4e-5 to 6e-5 of the worst window of a sharp tone; predictions look at all that [`WIDEST`] covers.
const NEAR_TOLERANCE: f64 = 1e-4;

/// Multiples of the sample rate allowed for the band, and the reach of the check to either side of
/// the carrier, in sample rates. The reach is twice the widest band, or the widest band if the
/// check stops early.
fn reach(spec: &Spec) -> (usize, f64) {
    match spec.filter.is_some() && spec.tolerance >= NEAR_TOLERANCE {
        true => (MAX_BANDS / 2, 0.25 * MAX_BANDS as f64),
        false => (MAX_BANDS, WIDEST),
    }
}

/// Reach of predictions to either side of the carrier, in sample rates.
pub(super) const WIDEST: f64 = MAX_BANDS as f64;

/// Reach of the check to either side of the carrier, in sample rates.
pub(super) fn widest(spec: &Spec) -> f64 {
    reach(spec).1
}

/// Selects the narrowest band whose truncation error is within its share of the tolerance in every
/// window. Both ends of the Doppler span are tested.
pub(super) fn band(spec: &Spec, alone: &SingleEcho) -> Result<Band, GriddedError> {
    let (most, _) = reach(spec);
    let steps = (most as f64 / STEP) as usize;
    let mut least: Option<Band> = None;
    for step in (0.5 / STEP) as usize..=steps {
        let half_hz = 0.5 * step as f64 * STEP * spec.sample_rate_hz;
        for fade_hz in [0.0, FADE * spec.sample_rate_hz] {
            let mut band = Band {
                whole_hz: half_hz - fade_hz,
                fade_hz,
                outside: 0.0,
            };
            band.outside = alone.left_out(&band).worst;
            if band.outside <= SHARE * spec.tolerance {
                return Ok(band);
            }
            if least.is_none_or(|least| band.outside < least.outside) {
                least = Some(band);
            }
        }
    }
    match least {
        Some(band) if band.outside <= LAST_SHARE * spec.tolerance => Ok(band),
        least => Err(GriddedError::OutOfBand {
            tolerance: spec.tolerance,
            share: least.map_or(1.0, |band| band.outside),
        }),
    }
}

//! The band of a received pulse that is kept.
//!
//! What is left out of an echo must be little in every window: it lies about the ends of pulses, and what is cut sharply rings on, where there is no
//! echo at all. So an echo is made with and without it, and looked at window by window ([`Alone`]), as the contract does.

use std::sync::LazyLock;

use crate::array::filter::bessel_i0;

use super::alone::Alone;
use super::choose::SHARE;
use super::one_dimensional::{GriddedError, Spec};

/// Multiples of the sample rate that the band may have; where a filter leaves next to nothing beyond, half as many.
const MAX_BANDS: usize = 8;

/// Bands are tried in steps of this share of the sample rate.
const STEP: f64 = 0.125;

/// Of the tolerance, what may be left out where no band leaves out less than [`SHARE`].
const LAST_SHARE: f64 = 0.7;

/// The band that is kept of the received pulse.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Band {
    /// Kept whole up to here to either side.
    pub(crate) whole_hz: f64,
    /// Beyond that it is let fade over this; 0: cut.
    pub(crate) fade_hz: f64,
    /// Of the tolerance's norm: error that leaving out the rest makes in the worst window.
    pub outside: f64,
}

/// Over which a band fades, in sample rates: what it leaves out of an echo then stays within 24 samples of it.
const FADE: f64 = 0.125;

/// The fade is the integral of a Kaiser window: beyond the samples just named 70 dB down.
const FADE_BETA: f64 = 9.0;

impl Band {
    /// Share of frequency `f_hz` that is kept.
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

/// The integral from the outer end of the fade to its inner one.
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

/// What a receiver filter's stop band lets pass of a sharp tone beyond twice the sample rate to either side is 4e-6 of a window in noise (random scene 61
/// of `tools/sweep`): from this tolerance on that is not looked at.
const NEAR_TOLERANCE: f64 = 3e-5;

/// Multiples of the sample rate that the band may have, and how far to either side of the carrier it is looked at, in sample rates: twice the widest
/// band, or in the near case the widest, which the others are measured by.
fn reach(spec: &Spec) -> (usize, f64) {
    match spec.filter.is_some() && spec.tolerance >= NEAR_TOLERANCE {
        true => (MAX_BANDS / 2, 0.25 * MAX_BANDS as f64),
        false => (MAX_BANDS, MAX_BANDS as f64),
    }
}

/// How far to either side of the carrier the band of pulses is looked at, sample rates.
pub(super) fn widest(spec: &Spec) -> f64 {
    reach(spec).1
}

/// The narrowest band that leaves out no more than its share in any window, at the ends of the span of Dopplers.
pub(super) fn band(spec: &Spec, alone: &Alone) -> Result<Band, GriddedError> {
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
            band.outside = alone.left_out(&band);
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

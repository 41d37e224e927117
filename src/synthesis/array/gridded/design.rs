//! Design of an engine: its grids, kernel and error, selected before any table is computed. The
//! method selection compares engines by their designs.
//!
//! The input is a [`Spec`]. The result is a [`Design`], or the reason for refusal.

use std::f64::consts::TAU;
use std::sync::{Arc, Mutex, PoisonError};

use num_complex::Complex64;

use crate::array::echo_profile::EchoProfile;
use crate::array::filter::Decimator;
use echotank_core::model::DopplerModel;
use echotank_core::pulse::{FLOOR_BELOW_STRONGEST_DB, Pulse};
use echotank_core::simd::SimdLevel;

use super::band::{Band, WIDEST, band, widest};
use super::batched_fft::lanes_for;
use super::choose::{
    NS_PER_ARRIVAL, NS_PER_GRID_VALUE, NS_PER_LANE_VALUE, NS_PER_SPREAD, SERIES_SHARE, Trials,
    delay_kernel, few, series_terms, sweep, weights_carry_curvature,
};
use super::cost_estimate::CostEstimate;
use super::doppler::{CurvatureWeights, DopplerGrid, DopplerSpan, Received};
use super::evenly::{beyond_hz, evenly};
use super::kernel::{Kernel, MAX_WIDTH};
use super::moments::Real;
use super::one_dimensional::{GriddedError, Spec};
use super::prepare::Frame;
use super::pulse_spectrum::PulseSpectrum;
use super::single_echo::{EchoErrors, SingleEcho};
use super::transform::grid_size;

/// What no design has for a tolerance.
const DELAY_KERNEL: &str = "kernel over delay";
const DOPPLER_GRID: &str = "grid over Dopplers";

/// Curvature times pulse length above which the series for the middle of an echo fails.
const MAX_CURVATURE_TIMES_PULSE: f64 = 0.05;

pub(crate) struct Design {
    pulse: Pulse,
    filter: Option<Decimator>,
    spectrum: PulseSpectrum,
    band: Band,
    pub kernel: Kernel,
    /// Length of the record and of its spectrum, in samples.
    pub period: usize,
    period_s: f64,
    pub bins: usize,
    pub grid: usize,
    /// Time from the start of the record to the first sample, seconds.
    pub(crate) lead_s: f64,
    pub frame: Frame,
    /// Terms of the series in curvature. The first term is the echo without curvature.
    pub terms: Vec<DesignedTerm>,
    /// True if all echoes share one Doppler column.
    pub(crate) has_one_column: bool,
    /// Maximum distance of Dopplers at the middle of an echo from the span of Dopplers at leading
    /// edges.
    pub beside: f64,
    sweep: f64,
    pub error: f64,
    /// Errors of a single echo without curvature, with the noise floor of the contract; and what the greatest curvature adds.
    pub single_echo: EchoErrors,
    pub curved: f64,
    /// As asked for.
    sample_rate_hz: f64,
    tolerance: f64,
    /// rms rounding error of a number, relative to it.
    grid_rounding: f64,
}

pub(crate) struct DesignedTerm {
    pub grid: DopplerGrid,
    /// Chunks whose largest |p|, relative to that of the design, is below this value skip the term.
    pub(crate) min_curvature: f64,
}

/// All that a design depends on.
#[derive(Clone, PartialEq)]
struct DesignKey {
    pulse: Pulse,
    sample_rate_hz: f64,
    samples: usize,
    filter: Option<Decimator>,
    doppler: DopplerModel,
    span: DopplerSpan,
    curvature_per_s: f64,
    tolerance: f64,
    level_range_db: f64,
    few: bool,
    moments: usize,
}

type Designed = Result<Arc<Design>, GriddedError>;

/// Designs made last, the latest first. A design takes up to half a second. Method selections ask for the same ones again and again, and so does
/// the engine that is made after them.
static DESIGNED: Mutex<Vec<(DesignKey, Designed)>> = Mutex::new(Vec::new());

/// Maximum number of [`DESIGNED`] designs. The tables of a pulse's spectrum are most of one.
const MAX_DESIGNED: usize = 32;

/// [`Design::new`], made once for a specification.
pub(super) fn designed<M: Real>(spec: &Spec, weakening: f64) -> Designed {
    let key = DesignKey {
        pulse: *spec.pulse,
        sample_rate_hz: spec.sample_rate_hz,
        samples: spec.samples,
        filter: spec.filter.cloned(),
        doppler: spec.doppler,
        span: spec.span,
        curvature_per_s: spec.curvature_per_s,
        tolerance: spec.tolerance,
        level_range_db: spec.level_range_db,
        few: few(spec),
        moments: M::MOMENTS,
    };
    // Designs are complete when they are inserted, so a poisoned lock is ignored.
    let kept = || DESIGNED.lock().unwrap_or_else(PoisonError::into_inner);
    {
        let mut kept = kept();
        if let Some(at) = kept.iter().position(|(of, _)| *of == key) {
            kept[..=at].rotate_right(1);
            return kept[0].1.clone();
        }
    }
    let made = Design::new::<M>(spec, weakening).map(Arc::new);
    let mut kept = kept();
    kept.insert(0, (key, made.clone()));
    kept.truncate(MAX_DESIGNED);
    made
}

impl Design {
    /// Designs an engine; M is the precision of moments. `weakening`: see
    /// [`weakening()`](super::choose::weakening).
    fn new<M: Real>(asked: &Spec, weakening: f64) -> Result<Self, GriddedError> {
        let spec = &Spec {
            tolerance: asked.tolerance / weakening,
            ..*asked
        };
        let pulse = spec.pulse;
        let rate_hz = spec.sample_rate_hz;
        let carrier_hz = pulse.center_frequency_hz;
        let unreachable = |missing| GriddedError::Unreachable {
            tolerance: asked.tolerance,
            missing,
        };
        let (still, greatest_q) = match spec.doppler {
            DopplerModel::None => (true, 0.0),
            DopplerModel::Stretch => (false, 0.0),
            DopplerModel::StretchQuadratic => (false, spec.curvature_per_s.abs()),
            DopplerModel::PaperEq21 => return Err(GriddedError::DopplerModel),
        };
        // sqrt(eta^2 + 2 q T) - eta with eta at least 0.9. For curvatures beyond this bound the
        // series below fails. If weights carry the curvature, the shift of a sweep's ends is added.
        let beside = greatest_q
            * (1.25 * pulse.duration_s
                + 0.5 * (pulse.duration_s.powi(2) * pulse.sweep_hz_per_s() / carrier_hz).abs());
        let span = match still {
            true => DopplerSpan {
                least: 0.0,
                greatest: 0.0,
            },
            false => DopplerSpan {
                least: spec.span.least - beside,
                greatest: spec.span.greatest + beside,
            },
        };
        let fastest = span.least.abs().max(span.greatest);
        let half_s = 0.5 * pulse.duration_s;
        let greatest_p = greatest_q / (1.0 - fastest).powi(3);
        // The phase at the upper end of the band changes faster than at the carrier.
        let highest_carrier_hz = carrier_hz + 0.5 * pulse.bandwidth_hz;
        let curvature_rad = TAU * highest_carrier_hz * greatest_p * half_s * half_s;
        let needed = match greatest_q < MAX_CURVATURE_TIMES_PULSE / pulse.duration_s {
            true => series_terms(curvature_rad, spec.tolerance),
            false => None,
        };
        let count = needed.ok_or(GriddedError::Curvature {
            curvature_per_s: greatest_q,
            turned_rad: curvature_rad,
            tolerance: asked.tolerance,
        })?;
        let highest_hz = ((WIDEST + 0.25) * rate_hz + fastest * carrier_hz) / (1.0 - fastest);
        let known_hz = highest_hz + beyond_hz(pulse.duration_s, fastest) / (1.0 - fastest);
        let spectrum = PulseSpectrum::with_powers(pulse, known_hz, 2 * count);
        // The single-echo error in every window determines the design.
        let alone = SingleEcho::for_design(asked, span, &spectrum, widest(asked));
        let kept = band(asked, &alone)?;
        let kept_hz = 2.0 * (kept.whole_hz + kept.fade_hz);

        // An echo extends half a pulse and half a filter to either side of its middle, and further
        // by the shift from curvature.
        let filter_s = spec.filter.map_or(0.0, |f| -f.dense_first_s(0.0));
        let alone_s = half_s / (1.0 - fastest) + filter_s + 2.0 / rate_hz;
        let period_with =
            |reach_s: f64| grid_size(spec.samples + (2.0 * reach_s * rate_hz).ceil() as usize);
        let bins_of = |period: usize| {
            let bins = (kept_hz / rate_hz * period as f64).ceil() as usize;
            bins + bins % 2
        };
        let roughly = 5 * bins_of(period_with(alone_s)) / 4;
        let trials = Trials {
            spec,
            span,
            grid: roughly,
        };
        // The curvature phase is that of the highest frequency. The phase at the carrier, which
        // weights and templates use, is slightly smaller.
        let received = |order| Received {
            spectrum: &spectrum,
            carrier_hz,
            duration_s: pulse.duration_s,
            order,
            greatest_p,
        };
        let of_dopplers =
            |grid: &DopplerGrid| alone.dopplers(grid, received(0), &kept).worst / weakening;
        let weights = match count > 0 && weights_carry_curvature(spec, curvature_rad, greatest_p) {
            true => trials.doppler(curvature_rad, of_dopplers),
            false => None,
        };
        let weights_carry = weights.is_some();
        let count = if weights_carry { 0 } else { count };
        let doppler = weights
            .or_else(|| trials.doppler(0.0, of_dopplers))
            .ok_or_else(|| unreachable(DOPPLER_GRID))?;
        let mut terms = vec![DesignedTerm {
            grid: doppler.grid,
            min_curvature: 0.0,
        }];
        let mut fit_error2 = doppler.error.powi(2);
        let mut term_rad = 1.0;
        for order in 1..=count {
            term_rad *= curvature_rad / order as f64;
            let (grid, error) = trials
                .term(term_rad)
                .ok_or_else(|| unreachable(DOPPLER_GRID))?;
            fit_error2 += error * error;
            terms.push(DesignedTerm {
                grid,
                min_curvature: (SERIES_SHARE * spec.tolerance / term_rad).powf(1.0 / order as f64),
            });
        }
        // The ends of curved pulses move by p (T/2)^2.
        let reach_s = alone_s + greatest_p * half_s * half_s;
        let period = period_with(reach_s);
        let period = period + period % 2;
        let bins = bins_of(period);
        let period_s = period as f64 / rate_hz;

        // The cost of moments does not depend on the width; the cost of direct spreading does.
        let has_one_column = terms.iter().all(|term| term.grid.columns == 1);
        let max_width = match (has_one_column, M::MOMENTS) {
            (false, 8) => 8,
            _ => MAX_WIDTH,
        };
        let (grid, kernel) = delay_kernel::<M>(spec, bins, max_width, |grid, kernel| {
            alone.kernel(kernel, &kept, grid as f64 / period_s).worst / weakening
        })
        .ok_or_else(|| unreachable(DELAY_KERNEL))?;

        let grid_rounding = if M::MOMENTS == 8 { 1e-7 } else { 3e-13 };
        let rounding = grid_rounding * kernel.amplification();
        let series = match weights_carry {
            true => 0.0,
            false => term_rad * curvature_rad / (count + 1) as f64,
        };
        // What is promised refers to the noise floor of the contract.
        let promised = Spec {
            level_range_db: asked.level_range_db.min(FLOOR_BELOW_STRONGEST_DB),
            ..*asked
        };
        let beyond = SingleEcho::for_prediction(&promised, span, &spectrum, WIDEST);
        let of_band = beyond.left_out(&kept);
        let promised = SingleEcho::for_prediction(&promised, span, &spectrum, widest(asked));
        let grid_hz = grid as f64 / period_s;
        let of_kernel = promised.kernel(&kernel, &kept, grid_hz);
        let of_rounding = promised.rounding(&kernel, &kept, grid_hz, grid_rounding);
        let of_terms = (fit_error2 - doppler.error.powi(2)).max(0.0).sqrt();
        let mut of_doppler = match terms[0].grid.columns {
            1 => EchoErrors::default(),
            _ => promised.dopplers(&terms[0].grid, received(0), &kept),
        };
        if terms[0].grid.columns == 1 {
            of_doppler = of_doppler.at_least(doppler.error);
        }
        // With curvature, the end of an echo is off by the error of the fit there.
        let of_weights = if weights_carry { doppler.error } else { 0.0 };
        let curved = of_weights.hypot(of_terms).hypot(series);
        let fits = [of_kernel, of_doppler, of_band, of_rounding];
        let all = |error: &dyn Fn(&EchoErrors) -> f64| {
            let errors = fits.iter().map(error);
            errors.fold(0.0, f64::hypot)
        };
        let single_echo = EchoErrors {
            worst: all(&|of| of.worst),
            by_level: std::array::from_fn(|step| all(&|of| of.by_level[step])),
            mean: all(&|of| of.mean),
        };
        let error = [
            kernel.error,
            fit_error2.sqrt(),
            kept.outside / weakening,
            rounding,
            series,
        ]
        .iter()
        .map(|e| e * e)
        .sum::<f64>()
        .sqrt();
        Ok(Self {
            pulse: *pulse,
            filter: spec.filter.cloned(),
            frame: Frame {
                carrier_hz,
                half_pulse_s: half_s,
                still,
                greatest_q: match count > 0 || weights_carry {
                    true => greatest_q,
                    false => 0.0,
                },
                greatest_p,
                curved: weights_carry,
                sweep_hz_per_s: pulse.sweep_hz_per_s(),
            },
            spectrum,
            band: kept,
            kernel,
            period,
            period_s,
            bins,
            grid,
            lead_s: reach_s,
            terms,
            has_one_column,
            beside,
            sweep: sweep(spec),
            error,
            single_echo,
            curved,
            sample_rate_hz: rate_hz,
            tolerance: asked.tolerance,
            grid_rounding,
        })
    }

    /// Grid steps per second.
    pub(crate) fn grid_hz(&self) -> f64 {
        self.grid as f64 / self.period_s
    }

    /// One echo without Doppler, with its errors. `everywhere`: energy of the errors that spread over the record, relative to that of the strongest
    /// window.
    pub(super) fn echo_at_rest(&self, everywhere: f64) -> EchoProfile {
        let span = DopplerSpan {
            least: 0.0,
            greatest: 0.0,
        };
        let spec = Spec {
            pulse: &self.pulse,
            sample_rate_hz: self.sample_rate_hz,
            samples: 0,
            filter: self.filter.as_ref(),
            doppler: DopplerModel::None,
            span,
            curvature_per_s: 0.0,
            tolerance: self.tolerance,
            level_range_db: FLOOR_BELOW_STRONGEST_DB,
            arrivals: 0,
            simd_level: SimdLevel::best(),
        };
        let of_others = [self.grid_rounding, everywhere];
        SingleEcho::for_design(&spec, span, &self.spectrum, widest(&spec)).profile(
            &self.kernel,
            &self.band,
            self.grid_hz(),
            of_others,
        )
    }

    fn frequencies(&self) -> impl Iterator<Item = f64> + '_ {
        (0..self.bins).map(|q| (q as f64 - (self.bins / 2) as f64) / self.period_s)
    }

    /// Templates of every column of each term: `[bin * columns + column]`, lowest frequency first.
    pub(super) fn templates(&self) -> impl Iterator<Item = Vec<Complex64>> + '_ {
        let heard = |f_hz: f64| self.filter.as_ref().map_or(1.0, |filter| filter.gain(f_hz));
        let gain: Vec<f64> = self
            .frequencies()
            .map(|f_hz| heard(f_hz) * self.band.gain(f_hz))
            .collect();
        let first_hz = -((self.bins / 2) as f64) / self.period_s;
        self.terms.iter().enumerate().map(move |(order, term)| {
            let received = Received {
                spectrum: &self.spectrum,
                carrier_hz: self.pulse.center_frequency_hz,
                duration_s: self.pulse.duration_s,
                order,
                greatest_p: self.frame.greatest_p,
            };
            evenly(&term.grid, received, (first_hz, 1.0 / self.period_s), &gain)
        })
    }

    /// Factor per bin. It corrects the spectrum of the kernel and the first grid value of the
    /// flush, and moves the start of the record to 0.
    pub(crate) fn undo(&self) -> Vec<Complex64> {
        let undo = |f_hz: f64| {
            let nu = f_hz * self.period_s / self.grid as f64;
            let turns = f_hz * self.lead_s - nu * self.kernel.first() as f64;
            let size = 1.0 / (self.kernel.window_gain(nu) * self.period_s);
            Complex64::from_polar(size, TAU * turns)
        };
        self.frequencies().map(undo).collect()
    }

    /// Curvature terms of the weights on `grid`, and the phase at the ends of the pulse for which
    /// they are designed. `None` if separate columns carry the curvature.
    pub(crate) fn curvature_weights(&self, grid: &DopplerGrid) -> Option<(CurvatureWeights, f64)> {
        let (carrier_hz, half_s) = (self.frame.carrier_hz, self.frame.half_pulse_s);
        self.frame.curved.then(|| {
            let weights =
                grid.curvature_weights(grid.theta(carrier_hz, self.pulse.duration_s), self.sweep);
            (
                weights,
                TAU * carrier_hz * self.frame.greatest_p * half_s * half_s,
            )
        })
    }

    /// Cost of one element. `words` is the size of a grid value relative to f32.
    pub(super) fn cost_estimate(
        &self,
        words: f64,
        arrivals: usize,
        share: f64,
        curvature_per_s: f64,
    ) -> CostEstimate {
        let mut ns = CostEstimate {
            echoes_ns: arrivals as f64 * NS_PER_ARRIVAL,
            grids_ns: 0.0,
        };
        let curvature = curvature_per_s / self.frame.greatest_p.max(f64::MIN_POSITIVE);
        for term in self
            .terms
            .iter()
            .filter(|term| term.min_curvature <= curvature)
        {
            let grid = &term.grid;
            ns.grids_ns += self.grid as f64
                * words
                * match grid.columns {
                    1 => NS_PER_GRID_VALUE,
                    all => {
                        ns.echoes_ns += arrivals as f64 * NS_PER_SPREAD;
                        let lanes = lanes_for(grid.columns_of(share).min(all));
                        lanes as f64 * NS_PER_LANE_VALUE
                    }
                };
        }
        ns
    }
}

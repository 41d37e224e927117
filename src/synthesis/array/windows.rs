//! Error models for the largest windowed error with a noise floor. [`super::error_models`] has
//! those of whole echoes.
//!
//! A window of one pulse length may hold only one end of an echo, or the tail of the receiver
//! filter. Its error is relative to that part or to the noise, whichever is larger.
//!
//! The model synthesises a single echo at several positions between two samples, once by the method
//! and once exactly. It compares both window by window.
//!
//! The inputs are the conditions, the pulse of the plan and the noise level. The result is an error
//! model for the worst window.

use num_complex::Complex64;

use crate::arrivals::{ArrivalChunk, ArrivalSink};
use crate::edges::Edges;
use crate::error_model::{Conditions, ErrorModel};
use echotank_core::arrays::ReceiverFilter;
use echotank_core::model::Synthesis;
use echotank_core::ping::PingPlan;
use echotank_core::pulse::MIN_WINDOW;

use super::Direct;
use super::error_models::synthesis_error_model;
use super::filter::{Decimator, FilterError, oversample};
use crate::comparison::Comparison;
use crate::comparison::spectral::Bins;

/// Tested echo positions between two samples: on a sample, halfway, and positions that repeat on no
/// dense grid.
const PLACES: [f64; 6] = [0.0, 0.5, 0.118, 0.236, 0.618, 0.854];

/// Factor for untested positions and for several echoes in one window.
const MORE: f64 = 1.5;

/// Maximum counted error: that of an echo with the opposite sign.
const MOST: f64 = 2.0;

/// As [`synthesis_error_model`], for the worst window. The noise is `noise_below_db` below the
/// strongest echo. Engines with a tolerance have their own error models. `doppler_hz` is the
/// additional pass band of the receiver filter beside the band of the pulse, Hz.
pub fn window_error_model(
    synthesis: Synthesis,
    conditions: &Conditions,
    plan: &PingPlan,
    doppler_hz: f64,
    noise_below_db: f64,
) -> Result<ErrorModel, FilterError> {
    let mut error_model = synthesis_error_model(synthesis, conditions);
    let exact = match synthesis {
        Synthesis::Direct => conditions.filter == ReceiverFilter::None,
        Synthesis::Spectral | Synthesis::Nearest | Synthesis::Linear => false,
        Synthesis::Reference
        | Synthesis::Gridded1d
        | Synthesis::Gridded2d
        | Synthesis::GriddedLines => true,
    };
    if !exact {
        let alone = SingleEcho::new(synthesis, conditions, plan, doppler_hz)?;
        let worst = alone.worst(conditions, noise_below_db);
        error_model.error = error_model.error.max(MORE * worst).min(MOST);
        error_model.why += &format!(
            "; largest single-echo error {worst:.1e}, noise floor {noise_below_db} dB below the strongest window"
        );
    }
    Ok(error_model)
}

/// A single echo in its own record.
struct SingleEcho<'a> {
    plan: &'a PingPlan,
    rate_hz: f64,
    /// The tested method, prepared once for all positions; `None` for the direct sum.
    method: Option<Comparison>,
    own: Option<Decimator>,
    exact: Option<Decimator>,
    /// Number of samples of a window.
    window: usize,
    /// Number of silent samples on either side of the echo: a window plus the reach of the filters.
    silence: usize,
    samples: usize,
}

impl<'a> SingleEcho<'a> {
    fn new(
        synthesis: Synthesis,
        conditions: &Conditions,
        plan: &'a PingPlan,
        doppler_hz: f64,
    ) -> Result<Self, FilterError> {
        let rate_hz = conditions.sample_rate_hz;
        let filter = |like: Synthesis| match conditions.filter {
            ReceiverFilter::None => Ok(None),
            ReceiverFilter::Fir => {
                let dense = oversample(&plan.pulse, rate_hz, like);
                Decimator::new(&plan.pulse, rate_hz, doppler_hz, dense).map(Some)
            }
        };
        let (own, exact) = (filter(synthesis)?, filter(Synthesis::Reference)?);
        let sounding = (plan.pulse.duration_s * rate_hz).ceil();
        let window = sounding.max(MIN_WINDOW) as usize;
        let reach = own.as_ref().map_or(0.0, |f| (f.half_s() * rate_hz).ceil());
        let silence = window + reach as usize + 2;
        let samples = sounding as usize + 2 * silence;
        let record_s = samples as f64 / rate_hz;
        let mut method = Comparison::new(synthesis, rate_hz, record_s, None, own.as_ref());
        if let Some(method) = &mut method {
            method.prepare(plan, rate_hz, own.as_ref());
        }
        Ok(Self {
            plan,
            rate_hz,
            method,
            own,
            exact,
            window,
            silence,
            samples,
        })
    }

    /// Error in the worst window over all positions at rest. If the method supports Doppler, also
    /// at the largest Doppler.
    fn worst(&self, conditions: &Conditions, noise_below_db: f64) -> f64 {
        let fastest = 2.0 * conditions.speed_m_per_s / conditions.sound_speed_m_per_s;
        let dopplers = match self.method {
            None if fastest > 0.0 => &[0.0, fastest, -fastest][..],
            _ => &[0.0],
        };
        let places = dopplers
            .iter()
            .flat_map(|&doppler| PLACES.map(|place| (place, doppler)));
        places
            .map(|(place, doppler)| self.at(place, doppler, noise_below_db))
            .fold(0.0, f64::max)
    }

    /// Error in the worst window of an echo that begins `place` samples after a sample.
    fn at(&self, place: f64, doppler: f64, noise_below_db: f64) -> f64 {
        let (want, got) = (self.exactly(place, doppler), self.summed(place, doppler));
        let energies = |samples: Vec<f64>| -> Vec<f64> {
            let windows = samples.windows(self.window);
            windows.map(|w| w.iter().sum()).collect()
        };
        let pairs = got.iter().zip(&want);
        let off = energies(pairs.map(|(g, w)| (g - w).norm_sqr()).collect());
        let all = energies(want.iter().map(|w| w.norm_sqr()).collect());
        let noise = all.iter().copied().fold(0.0, f64::max) * 10f64.powf(-noise_below_db / 10.0);
        let weakest = self.plan.pulse.weakest_window(self.rate_hz).powi(2);
        let shares = off.iter().zip(&all);
        shares
            .map(|(off, here)| off / (here * weakest).max(noise))
            .fold(0.0, f64::max)
            .sqrt()
    }

    fn echo(&self, place: f64, doppler: f64) -> ArrivalChunk {
        let mut echo = ArrivalChunk::new();
        echo.len = 1;
        echo.delay_s[0] = (self.silence as f64 + place) / self.rate_hz;
        echo.doppler[0] = doppler;
        echo.amplitude[0] = Complex64::ONE;
        echo
    }

    fn exactly(&self, place: f64, doppler: f64) -> Vec<Complex64> {
        self.direct(self.exact.as_ref(), &self.echo(place, doppler))
    }

    fn direct(&self, filter: Option<&Decimator>, echo: &ArrivalChunk) -> Vec<Complex64> {
        let mut out = vec![Complex64::ZERO; self.samples];
        match filter {
            None => Direct::new(self.plan, self.rate_hz, 0.0, &mut out).accept(echo),
            Some(filter) => {
                let mut dense = vec![Complex64::ZERO; filter.dense_len(self.samples)];
                let first_s = filter.dense_first_s(0.0);
                Direct::new(self.plan, filter.dense_rate_hz(), first_s, &mut dense)
                    .with_edges(Edges::Weighted)
                    .accept(echo);
                filter.apply(&dense, &mut out);
            }
        }
        out
    }

    fn summed(&self, place: f64, doppler: f64) -> Vec<Complex64> {
        let echo = self.echo(place, doppler);
        let Some(method) = &self.method else {
            return self.direct(self.own.as_ref(), &echo);
        };
        let mut out = vec![Complex64::ZERO; self.samples];
        let (plan, rate_hz) = (self.plan, self.rate_hz);
        method.sum(plan, rate_hz, 0.0, &mut Bins::default(), &mut out, |sink| {
            sink.accept(&echo)
        });
        out
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use echotank_core::pulse::{Pulse, PulseKind};
    use echotank_core::testing::plan_at_rest;

    fn conditions(pulse: Pulse, filter: ReceiverFilter) -> Conditions {
        Conditions {
            pulse,
            sound_speed_m_per_s: 1500.0,
            sample_rate_hz: 40e3,
            filter,
            speed_m_per_s: 0.0,
            acceleration_m_per_s2: 0.0,
            turning_m_per_s: 0.0,
            range_m: (10.0, 50.0),
            segment_s: 0.01,
            scatterers: 1000,
            elements: 1,
            tolerance: 1e-3,
            echo_statistics: None,
        }
    }

    fn pulse(bandwidth_hz: f64, duration_s: f64, taper: f64) -> Pulse {
        Pulse {
            kind: match bandwidth_hz {
                0.0 => PulseKind::Cw,
                _ => PulseKind::LfmUp,
            },
            center_frequency_hz: 400e3,
            bandwidth_hz,
            duration_s,
            taper,
        }
    }

    #[test]
    fn no_position_between_two_samples_exceeds_the_error_model() {
        for (synthesis, filter) in [
            (Synthesis::Direct, ReceiverFilter::Fir),
            (Synthesis::Spectral, ReceiverFilter::Fir),
            (Synthesis::Nearest, ReceiverFilter::Fir),
            (Synthesis::Linear, ReceiverFilter::Fir),
            (Synthesis::Spectral, ReceiverFilter::None),
            (Synthesis::Linear, ReceiverFilter::None),
        ] {
            for pulse in [
                pulse(24e3, 1e-3, 0.0),
                pulse(24e3, 0.4e-3, 0.5),
                pulse(0.0, 1e-3, 0.1),
            ] {
                let c = conditions(pulse, filter);
                let plan = plan_at_rest(&pulse, 100, 1500.0);
                let error_model =
                    window_error_model(synthesis, &c, &plan, 900.0, 55.0).expect("fits");
                let alone = SingleEcho::new(synthesis, &c, &plan, 900.0).expect("fits");
                let got = (0..24)
                    .map(|k| (0.01 + 0.754_877_666 * f64::from(k)).fract())
                    .map(|place| alone.at(place, 0.0, 55.0))
                    .fold(0.0, f64::max);
                println!("{synthesis:?} {filter:?} {pulse:?}: {got:.2e}, {error_model:?}");
                // The error of an error model is at most twice the echo.
                assert!(
                    got.min(MOST) <= error_model.error,
                    "{got:e}, {error_model:?}"
                );
            }
        }
    }

    /// The flanks rise quadratically. Half a sample is therefore a large fraction of an echo where
    /// the echo exceeds the noise.
    #[test]
    fn the_worst_window_is_an_end_and_exceeds_the_error_of_the_whole_echo() {
        let pulse = pulse(0.0, 1e-3, 1.0);
        let c = conditions(pulse, ReceiverFilter::Fir);
        let plan = plan_at_rest(&pulse, 100, 1500.0);
        for synthesis in [Synthesis::Nearest, Synthesis::Linear] {
            let whole = synthesis_error_model(synthesis, &c).error;
            let worst = window_error_model(synthesis, &c, &plan, 900.0, 55.0).expect("fits");
            assert!(worst.error > 2.0 * whole, "{whole:e}, {worst:?}");
        }
    }
}

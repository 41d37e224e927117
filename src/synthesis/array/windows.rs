//! Error models of sums without a tolerance, for the largest windowed error with a noise floor.
//!
//! A window of one pulse length may hold only one end of an echo, or the tail of the receiver
//! filter. Its error is relative to that part or to the noise floor, whichever is larger.
//!
//! The model synthesises a single echo at several positions between two samples, once by the method
//! and once exactly. It compares both window by window, and as a whole: where many echoes sound
//! together, their errors have random phases, and fade otherwise than the echoes. The result depends on the pulse, the
//! filter and the method alone, so it is computed once for each of them.

use std::sync::{Arc, Mutex, PoisonError};

use num_complex::Complex64;

use crate::arrivals::{ArrivalChunk, ArrivalSink};
use echotank_core::model::Synthesis;
use echotank_core::ping::PingPlan;
use echotank_core::pulse::{MIN_WINDOW, Pulse, noise_share};

use super::Direct;
use super::filter::{Decimator, FilterDesign, FilterError};
use super::quadrature::Quadrature;
use crate::comparison::Comparison;
use crate::comparison::spectral::Bins;
use crate::error_model::OVERLAPPING;

/// Tested echo positions between two samples: on a sample, halfway, and positions that repeat on no
/// dense grid.
const PLACES: [f64; 6] = [0.0, 0.5, 0.118, 0.236, 0.618, 0.854];

/// Factor for untested positions and for several echoes in one window.
const MORE: f64 = 1.5;

/// Maximum counted error: that of an echo with the opposite sign.
const MOST: f64 = 2.0;

/// Number of results that are kept.
const KEPT: usize = 64;

/// Sum whose error is asked for.
#[derive(Clone, Debug, PartialEq)]
struct Asked {
    synthesis: Synthesis,
    pulse: Pulse,
    rate_hz: f64,
    filter: Option<FilterDesign>,
}

/// The last [`KEPT`] results, by what they are of.
struct Kept<T>(Mutex<Vec<(Asked, T)>>);

impl<T: Clone> Kept<T> {
    const fn new() -> Self {
        Self(Mutex::new(Vec::new()))
    }

    /// A result that is kept, or that `make` has of a single echo. Only the pulse of `plan` matters.
    fn get_or_make(
        &self,
        plan: &PingPlan,
        asked: Asked,
        make: impl FnOnce(&SingleEcho) -> T,
    ) -> Result<T, FilterError> {
        let results = || self.0.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some((_, result)) = results().iter().find(|(of, _)| *of == asked) {
            return Ok(result.clone());
        }
        let filter = asked.filter.map(|f| f.decimator()).transpose()?;
        let echo = SingleEcho::new(asked.synthesis, plan, asked.rate_hz, filter.as_ref());
        let result = make(&echo);
        let mut results = results();
        if results.len() >= KEPT {
            results.remove(0);
        }
        results.push((asked, result.clone()));
        Ok(result)
    }
}

/// Errors of one echo.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct SingleEchoErrors {
    /// In its worst window.
    pub window: f64,
    /// Of the whole echo, mean square over its positions between two samples.
    pub whole: f64,
    /// Of the whole echo, at its worst position.
    pub whole_at_worst: f64,
}

impl SingleEchoErrors {
    /// In the worst window of a ping with `fading` and `tails` as in [`EchoStatistics`](crate::error_model::EchoStatistics): the end of an echo has no
    /// more than its whole error.
    pub(super) fn of_ping(self, fading: f64, tails: f64) -> f64 {
        let of_ends = (cut_echoes(tails) * self.window).min(tails * self.whole_at_worst);
        of_ends.max(fading * self.whole).min(MOST)
    }
}

/// What ends of echoes amount to in the noise floor of a ping, over that of an echo of its own: more than 1 where the record cuts off echoes that are
/// stronger than all that it holds. `tails` as in [`EchoStatistics`](crate::error_model::EchoStatistics).
pub fn cut_echoes(tails: f64) -> f64 {
    match tails.is_finite() {
        true => (tails / OVERLAPPING * noise_share().sqrt()).max(1.0),
        false => 1.0,
    }
}

/// Errors of one echo, for the methods `direct`, `spectral`, `nearest` and
/// `linear`. `filter` is the receiver filter of the method, whose allowance for Doppler limits that
/// of echoes. Only the pulse of `plan` matters.
///
/// Results are kept, so that repeated selections of methods cost nothing.
pub(super) fn window_error(
    synthesis: Synthesis,
    plan: &PingPlan,
    rate_hz: f64,
    filter: Option<FilterDesign>,
) -> Result<SingleEchoErrors, FilterError> {
    static RESULTS: Kept<SingleEchoErrors> = Kept::new();
    let asked = Asked {
        synthesis,
        pulse: plan.pulse,
        rate_hz,
        filter,
    };
    let doppler = filter.map_or(0.0, |f| f.doppler_hz / plan.pulse.center_frequency_hz);
    RESULTS.get_or_make(plan, asked, |echo| {
        let worst = echo.worst(doppler);
        SingleEchoErrors {
            window: MORE * worst.window,
            whole: MORE * worst.whole,
            whole_at_worst: MORE * worst.whole_at_worst,
        }
    })
}

/// Errors of one echo that is displaced in time, in its worst window, for each radian of its carrier at the end of the pulse.
///
/// `shapes`: the displacement of each error over the share of the pulse, 1 at its end or any other scale; `filter` is the receiver filter. Phases
/// count at the highest frequency of the sweep.
///
/// A displaced echo has another phase, and its flanks and the tail of the filter behind its end are displaced too. A window that holds no more than
/// these is off by more than the phase, most of all at low carriers. Without filter and taper, samples that an edge crosses are not counted.
///
/// Results are kept, for one set of shapes: repeated selections of methods cost nothing.
pub fn displaced_echo_errors<const N: usize>(
    plan: &PingPlan,
    rate_hz: f64,
    filter: Option<FilterDesign>,
    shapes: [fn(f64) -> f64; N],
) -> Result<[f64; N], FilterError> {
    static RESULTS: Kept<Vec<f64>> = Kept::new();
    let asked = Asked {
        synthesis: Synthesis::Direct,
        pulse: plan.pulse,
        rate_hz,
        filter,
    };
    let errors = RESULTS.get_or_make(plan, asked, |echo| echo.displaced(shapes).to_vec())?;
    Ok(std::array::from_fn(|k| errors[k]))
}

/// What of an echo, and of its displacements, lies before a sample or behind it, by how far the sample is from an end of the echo. Behind the receiver
/// filter an echo begins earlier and ends later.
#[derive(Debug)]
pub struct EchoEnds {
    /// Samples before the beginning at which the tables begin.
    before: usize,
    /// Of the energy of an echo, up to a sample, by how many samples the echo began before it. Pulse and filter are symmetric: it is the energy from a
    /// sample on, too, by how many samples later the echo ends. At every [`Self::PER_SAMPLE`]-th of a sample.
    energies: Vec<f64>,
    /// Errors of displacements: up to a sample, from a sample on, and of the whole echo. `[index][shape]`.
    begins: Vec<DisplacedSums>,
    ends: Vec<DisplacedSums>,
    whole: Vec<DisplacedSums>,
}

/// Sums over samples of an echo that is displaced, for each radian of its carrier at the highest frequency of the sweep, over the energy of the echo.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct DisplacedSums {
    /// Of energy times phase.
    pub phase: f64,
    /// Of the squares of errors.
    pub square: f64,
}

impl DisplacedSums {
    /// With another sample, of an echo of unit energy.
    fn and(self, got: Complex64, want: Complex64) -> Self {
        let off = (got - want) / DISPLACED_RAD;
        Self {
            // What is late has a negative phase.
            phase: self.phase - (off * want.conj()).im,
            square: self.square + off.norm_sqr(),
        }
    }
}

/// An end of an echo.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum EchoEnd {
    /// Where it begins.
    Begin,
    /// Where it ends.
    End,
}

impl EchoEnds {
    const PER_SAMPLE: usize = 8;
    /// Samples from an end of an echo that the tables cover at most.
    const MOST: usize = 64;

    /// Samples before an echo's beginning from which it is heard.
    pub fn before(&self) -> usize {
        self.before
    }

    /// The table of energies.
    pub fn energies(&self) -> &[f64] {
        &self.energies
    }

    /// The errors of all shapes up to here in the tables.
    pub fn errors(&self, end: EchoEnd, index: usize) -> &[DisplacedSums] {
        let table = match end {
            EchoEnd::Begin => &self.begins,
            EchoEnd::End => &self.ends,
        };
        let shapes = self.whole.len();
        &table[index * shapes..(index + 1) * shapes]
    }

    /// ... of whole echoes.
    pub fn whole(&self) -> &[DisplacedSums] {
        &self.whole
    }

    /// Index in the tables of so many samples from an end; none before it. Behind it, the last one.
    pub fn index(&self, samples: f64) -> Option<usize> {
        let place = ((samples + self.before as f64) * Self::PER_SAMPLE as f64).round();
        (place >= 0.0).then(|| (place as usize).min(self.energies.len() - 1))
    }

    /// The sample behind the beginning up to which an echo has this share of its energy, as far as the table covers.
    pub fn samples_of(&self, share: f64) -> f64 {
        let index = self.energies.partition_point(|energy| *energy < share);
        index as f64 / Self::PER_SAMPLE as f64 - self.before as f64
    }

    /// How many samples the tables cover behind the beginning.
    pub fn covered(&self) -> f64 {
        (self.energies.len() - 1) as f64 / Self::PER_SAMPLE as f64 - self.before as f64
    }
}

/// The ends of a single echo. `shapes`: of displacements, as in [`displaced_echo_errors`]. Results are kept as there.
pub fn echo_ends<const N: usize>(
    plan: &PingPlan,
    rate_hz: f64,
    filter: Option<FilterDesign>,
    shapes: [fn(f64) -> f64; N],
) -> Result<Arc<EchoEnds>, FilterError> {
    static RESULTS: Kept<Arc<EchoEnds>> = Kept::new();
    let asked = Asked {
        synthesis: Synthesis::Direct,
        pulse: plan.pulse,
        rate_hz,
        filter,
    };
    RESULTS.get_or_make(plan, asked, |echo| Arc::new(echo.ends(&shapes)))
}

/// Carrier phase of test displacements, radians: small against 1, and large against the error of the quadrature.
const DISPLACED_RAD: f64 = 1e-3;

/// Positions between two samples of displaced echoes: so that about these many samples are looked at in all, behind a filter and without one, within
/// limits. A sample may fall anywhere on a flank or on a tail.
const FILTERED_SAMPLES: usize = 2048;
const UNFILTERED_SAMPLES: usize = 8192;
const DISPLACED_PLACES: (usize, usize) = (4, 64);

/// A single echo in its own record.
struct SingleEcho<'a> {
    plan: &'a PingPlan,
    rate_hz: f64,
    /// The tested method, prepared once for all positions; `None` for the direct sum.
    method: Option<Comparison>,
    filter: Option<&'a Decimator>,
    /// Number of samples of a window.
    window: usize,
    /// Number of silent samples on either side of the echo: a window plus the reach of the filters.
    silence: usize,
    samples: usize,
}

impl<'a> SingleEcho<'a> {
    fn new(
        synthesis: Synthesis,
        plan: &'a PingPlan,
        rate_hz: f64,
        filter: Option<&'a Decimator>,
    ) -> Self {
        let sounding = (plan.pulse.duration_s * rate_hz).ceil();
        let window = sounding.max(MIN_WINDOW) as usize;
        let reach = filter.map_or(0.0, |f| (f.half_s() * rate_hz).ceil());
        let silence = window + reach as usize + 2;
        let samples = sounding as usize + 2 * silence;
        let record_s = samples as f64 / rate_hz;
        let mut method = Comparison::new(synthesis, rate_hz, record_s, None, filter);
        if let Some(method) = &mut method {
            method.prepare(plan, rate_hz, filter);
        }
        Self {
            plan,
            rate_hz,
            method,
            filter,
            window,
            silence,
            samples,
        }
    }

    /// Errors over all positions at rest. If the method supports Doppler, also at the largest Doppler; the
    /// greater ones.
    fn worst(&self, fastest: f64) -> SingleEchoErrors {
        let dopplers = match self.method {
            None if fastest > 0.0 => &[0.0, fastest, -fastest][..],
            _ => &[0.0],
        };
        let mut worst = SingleEchoErrors {
            window: 0.0,
            whole: 0.0,
            whole_at_worst: 0.0,
        };
        for &doppler in dopplers {
            let mut square = 0.0;
            for place in PLACES {
                let errors = self.at(place, doppler);
                worst.window = worst.window.max(errors.window);
                worst.whole_at_worst = worst.whole_at_worst.max(errors.whole);
                square += errors.whole.powi(2) / PLACES.len() as f64;
            }
            worst.whole = worst.whole.max(square.sqrt());
        }
        worst
    }

    /// [`DISPLACED_RAD`] at the highest frequency of the sweep, seconds.
    fn displaced_s(&self) -> f64 {
        let pulse = &self.plan.pulse;
        let highest_hz = pulse.center_frequency_hz + 0.5 * pulse.bandwidth_hz;
        DISPLACED_RAD / (std::f64::consts::TAU * highest_hz)
    }

    /// See [`displaced_echo_errors`].
    fn displaced<const N: usize>(&self, shapes: [fn(f64) -> f64; N]) -> [f64; N] {
        let looked_at = match self.filter {
            Some(_) => FILTERED_SAMPLES,
            None => UNFILTERED_SAMPLES,
        };
        let places = (looked_at / self.samples).clamp(DISPLACED_PLACES.0, DISPLACED_PLACES.1);
        let late_s = self.displaced_s();
        let mut worst = [0.0f64; N];
        for place in (0..places).map(|k| k as f64 / places as f64) {
            let want = self.late(place, |_| 0.0);
            for (worst, shape) in worst.iter_mut().zip(shapes) {
                let got = self.late(place, |share| late_s * shape(share));
                *worst = worst.max(self.compared(&want, &got).window / DISPLACED_RAD);
            }
        }
        worst
    }

    /// See [`echo_ends`].
    fn ends(&self, shapes: &[fn(f64) -> f64]) -> EchoEnds {
        const FINE: usize = EchoEnds::PER_SAMPLE;
        let before = self.silence - self.window;
        let covered = (before + EchoEnds::MOST).min(self.samples - self.window);
        let entries = (covered - 1) * FINE + 1;
        let mut energies = vec![0.0; entries];
        let none = DisplacedSums::default();
        let [mut begins, mut ends] = [(); 2].map(|()| vec![none; entries * shapes.len()]);
        let mut whole = vec![none; shapes.len()];
        let sounding = self.plan.pulse.duration_s * self.rate_hz;
        let late_s = self.displaced_s();
        for k in 0..FINE {
            let place = k as f64 / FINE as f64;
            // The echo begins `before` samples and `k` of them later, behind `window` samples.
            let index_of = |n: usize| ((n - self.window) * FINE).checked_sub(k);
            let ends_at = ((self.silence + before) as f64 + place + sounding) * FINE as f64;
            let index_from = |n: usize| (ends_at.round() as usize).checked_sub(n * FINE);
            let want = self.exactly(place, 0.0);
            let energy: f64 = want.iter().map(|x| x.norm_sqr()).sum();
            let mut up_to = 0.0;
            for (n, x) in want.iter().enumerate().skip(self.window).take(covered) {
                up_to += x.norm_sqr();
                if let Some(index) = index_of(n) {
                    energies[index] = up_to / energy;
                }
            }
            let unit = energy.sqrt().recip();
            let late = |late_s: &dyn Fn(f64) -> f64| {
                let samples = self.late(place, late_s).into_iter();
                samples.map(|x| x * unit).collect::<Vec<Complex64>>()
            };
            let want = late(&|_| 0.0);
            for (s, shape) in shapes.iter().enumerate() {
                let got = late(&|share| late_s * shape(share));
                let mut up_to = none;
                for n in self.window..self.window + covered {
                    up_to = up_to.and(got[n], want[n]);
                    if let Some(index) = index_of(n) {
                        begins[index * shapes.len() + s] = up_to;
                    }
                }
                let mut from = none;
                for n in (0..self.samples).rev() {
                    from = from.and(got[n], want[n]);
                    if let Some(index) = index_from(n).filter(|index| *index < entries) {
                        ends[index * shapes.len() + s] = from;
                    }
                }
                // The place between two samples makes no difference.
                whole[s] = from;
            }
        }
        EchoEnds {
            before,
            energies,
            begins,
            ends,
            whole,
        }
    }

    /// An echo that begins `place` samples after a sample. Its sound of the share s of the pulse comes `late_s(s)` seconds late.
    fn late(&self, place: f64, late_s: impl Fn(f64) -> f64) -> Vec<Complex64> {
        let pulse = &self.plan.pulse;
        let (carrier_hz, duration_s) = (pulse.center_frequency_hz, pulse.duration_s);
        let delay_s = (self.silence as f64 + place) / self.rate_hz;
        let late_s = |since_s: f64| late_s((since_s / duration_s).clamp(0.0, 1.0));
        let value = |since_s: f64| {
            let late_s = late_s(since_s);
            let emitted_s = (since_s - late_s).clamp(0.0, duration_s);
            let turns = carrier_hz * late_s;
            pulse.envelope(emitted_s) * Complex64::cis(-std::f64::consts::TAU * turns)
        };
        let mut out = vec![Complex64::ZERO; self.samples];
        let Some(filter) = self.filter else {
            for (k, sample) in out.iter_mut().enumerate() {
                let since_s = k as f64 / self.rate_hz - delay_s;
                if (0.0..=duration_s).contains(&since_s) {
                    *sample = value(since_s);
                }
            }
            return out;
        };
        let flank_s = 0.5 * pulse.taper * duration_s;
        let breaks_s = [0.0, flank_s, duration_s - flank_s, duration_s];
        let mut quadrature = Quadrature::new(filter, 0.0, out.len());
        for ends_s in breaks_s.windows(2) {
            let heard_s = |emitted_s: f64| delay_s + emitted_s + late_s(emitted_s);
            quadrature.add((heard_s(ends_s[0]), heard_s(ends_s[1])), |t_s, _| {
                value(t_s - delay_s)
            });
        }
        quadrature.finish(&mut out);
        out
    }

    /// Errors of an echo that begins `place` samples after a sample.
    fn at(&self, place: f64, doppler: f64) -> SingleEchoErrors {
        let (want, got) = (self.exactly(place, doppler), self.summed(place, doppler));
        self.compared(&want, &got)
    }

    fn compared(&self, want: &[Complex64], got: &[Complex64]) -> SingleEchoErrors {
        let energies = |energy: fn(Complex64, Complex64) -> f64| {
            let samples = got.iter().zip(want).map(|(got, want)| energy(*got, *want));
            window_energies(samples, self.window)
        };
        let off = energies(|got, want| (got - want).norm_sqr());
        let all = energies(|_, want| want.norm_sqr());
        let strongest = all.iter().copied().fold(0.0, f64::max);
        let floor = strongest * noise_share();
        let shares = off.iter().zip(&all);
        let worst = shares
            .map(|(off, here)| off / here.max(floor))
            .fold(0.0, f64::max);
        let [off, all] = [off, all].map(|energies| energies.iter().sum::<f64>());
        let whole = (off / all).sqrt();
        SingleEchoErrors {
            window: worst.sqrt(),
            whole,
            whole_at_worst: whole,
        }
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
        let echo = self.echo(place, doppler);
        let mut out = vec![Complex64::ZERO; self.samples];
        match self.filter {
            None => Direct::new(self.plan, self.rate_hz, 0.0, &mut out).accept(&echo),
            Some(filter) => exact_echo(&self.plan.pulse, filter, &echo, 0.0, &mut out),
        }
        out
    }

    fn direct(&self, echo: &ArrivalChunk) -> Vec<Complex64> {
        let mut out = vec![Complex64::ZERO; self.samples];
        match self.filter {
            None => Direct::new(self.plan, self.rate_hz, 0.0, &mut out).accept(echo),
            Some(filter) => {
                let mut dense = vec![Complex64::ZERO; filter.dense_len(self.samples)];
                let first_s = filter.dense_first_s(0.0);
                Direct::new(self.plan, filter.dense_rate_hz(), first_s, &mut dense)
                    .with_ends(Some(filter.ends()))
                    .accept(echo);
                filter.apply(&dense, &mut out);
            }
        }
        out
    }

    fn summed(&self, place: f64, doppler: f64) -> Vec<Complex64> {
        let echo = self.echo(place, doppler);
        let Some(method) = &self.method else {
            return self.direct(&echo);
        };
        let mut out = vec![Complex64::ZERO; self.samples];
        let (plan, rate_hz) = (self.plan, self.rate_hz);
        method.sum(plan, rate_hz, 0.0, &mut Bins::default(), &mut out, |sink| {
            sink.accept(&echo)
        });
        out
    }
}

/// Energies of all windows of `window` samples. Differences of running sums are accurate to 1e-16 of
/// the whole, far below the noise floor.
fn window_energies(samples: impl Iterator<Item = f64>, window: usize) -> Vec<f64> {
    let mut total = 0.0;
    let running = std::iter::once(0.0).chain(samples.map(|energy| {
        total += energy;
        total
    }));
    let running: Vec<f64> = running.collect();
    let windows = running.iter().zip(&running[window..]);
    windows.map(|(before, after)| after - before).collect()
}

/// Overwrites `out` with the echoes of a chunk without curvature after the filter, by quadrature.
pub(crate) fn exact_echo(
    pulse: &Pulse,
    filter: &Decimator,
    chunk: &ArrivalChunk,
    first_sample_s: f64,
    out: &mut [Complex64],
) {
    let flank_s = 0.5 * pulse.taper * pulse.duration_s;
    let duration_s = pulse.duration_s;
    let breaks_s = [0.0, flank_s, duration_s - flank_s, duration_s];
    let mut quadrature = Quadrature::new(filter, first_sample_s, out.len());
    for i in 0..chunk.len {
        let (delay_s, doppler) = (chunk.delay_s[i], chunk.doppler[i]);
        for ends_s in breaks_s.windows(2) {
            let ends_s = (
                delay_s + ends_s[0] / (1.0 + doppler),
                delay_s + ends_s[1] / (1.0 + doppler),
            );
            quadrature.add(ends_s, |t_s, _| {
                let since_s = t_s - delay_s;
                let emitted_s = ((1.0 + doppler) * since_s).clamp(0.0, duration_s);
                let carrier = pulse.center_frequency_hz * delay_s;
                let turns = pulse.center_frequency_hz * doppler * since_s
                    - (carrier - carrier.round_ties_even());
                let carrier = Complex64::cis(std::f64::consts::TAU * turns);
                chunk.amplitude[i] * pulse.envelope(emitted_s) * carrier
            });
        }
    }
    quadrature.finish(out);
}

#[cfg(test)]
mod tests {
    use super::super::filter::oversample;
    use super::*;
    use echotank_core::pulse::PulseKind;
    use echotank_core::testing::plan_at_rest;

    /// The table of a chirp behind the receiver filter: half of its energy at its middle, next to none before the filter hears it, and never less than before.
    #[test]
    fn an_echo_has_half_of_its_energy_at_its_middle() {
        const SAMPLES: f64 = 40.0;
        let pulse = Pulse {
            kind: PulseKind::LfmUp,
            center_frequency_hz: 200e3,
            bandwidth_hz: 20e3,
            duration_s: SAMPLES / RATE_HZ,
            taper: 0.25,
        };
        let filter = design(Synthesis::Direct, &pulse);
        let plan = plan_at_rest(&pulse, 200, 1500.0);
        let ends = echo_ends(&plan, RATE_HZ, Some(filter), SHAPES).expect("fits");
        let up_to = |samples: f64| ends.energies()[ends.index(samples).expect("in the table")];
        assert!((up_to(0.5 * SAMPLES) - 0.5).abs() < 0.03);
        assert!(up_to(-0.9 * ends.before() as f64) < 1e-6);
        assert!(ends.index(-1.1 * ends.before() as f64).is_none());
        assert!(ends.energies().is_sorted_by(|a, b| *b > *a - 1e-3));
        assert!(up_to(1e3) > 0.999);
    }

    const SHAPES: [fn(f64) -> f64; 2] = [|_| 1.0, |t| 2.0 * t - 1.0];

    /// Of an even pulse without a filter: a constant displacement has the phase of the carrier, and a linear one about its middle that of its place.
    #[test]
    fn the_ends_of_a_displaced_echo_have_its_phases() {
        const SAMPLES: f64 = 40.0;
        let pulse = pulse(0.0, SAMPLES / RATE_HZ, 0.0);
        let plan = plan_at_rest(&pulse, 200, 1500.0);
        let ends = echo_ends(&plan, RATE_HZ, None, SHAPES).expect("no filter");
        let near = |a: f64, b: f64| assert!((a - b).abs() < 0.03, "{a} {b}");
        for samples in [2.5, 10.25, 20.0, 39.5, 60.0] {
            let index = ends.index(samples).expect("in the table");
            let share = (samples / SAMPLES).min(1.0);
            near(ends.energies()[index], share);
            for (end, sign) in [(EchoEnd::Begin, -1.0), (EchoEnd::End, 1.0)] {
                let [constant, linear] = *ends.errors(end, index) else {
                    panic!("two shapes");
                };
                near(constant.phase, share);
                near(constant.square, share);
                // From the end inwards, 1 - 2 x.
                near(linear.phase, sign * (share - share.powi(2)));
                near(linear.square, (1.0 - (1.0 - 2.0 * share).powi(3)) / 6.0);
            }
        }
        let [constant, linear] = *ends.whole() else {
            panic!("two shapes");
        };
        near(constant.phase, 1.0);
        near(linear.phase, 0.0);
        near(linear.square, 1.0 / 3.0);
    }

    /// A lone echo over the noise floor of its own, and over that of a record whose strongest window is 20 dB below it.
    #[test]
    fn an_echo_that_the_record_cuts_off_counts_over_the_floor_of_the_rest() {
        let tails = |below: f64| OVERLAPPING / (noise_share() * below).sqrt();
        assert!((cut_echoes(tails(1.0)) - 1.0).abs() < 1e-9);
        assert!((cut_echoes(tails(0.01)) - 10.0).abs() < 1e-9);
        assert_eq!(cut_echoes(OVERLAPPING), 1.0);
        assert_eq!(cut_echoes(f64::INFINITY), 1.0);
    }

    const RATE_HZ: f64 = 40e3;

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

    /// 40 kHz with a filter of its method's density, or without a filter.
    fn design(synthesis: Synthesis, pulse: &Pulse) -> FilterDesign {
        FilterDesign {
            pulse: *pulse,
            sample_rate_hz: RATE_HZ,
            doppler_hz: 900.0,
            oversample: oversample(pulse, RATE_HZ, synthesis),
        }
    }

    #[test]
    fn no_position_between_two_samples_exceeds_the_error_model() {
        for (synthesis, filtered) in [
            (Synthesis::Direct, true),
            (Synthesis::Spectral, true),
            (Synthesis::Nearest, true),
            (Synthesis::Linear, true),
            (Synthesis::Spectral, false),
            (Synthesis::Linear, false),
        ] {
            for pulse in [
                pulse(24e3, 1e-3, 0.0),
                pulse(24e3, 0.4e-3, 0.5),
                pulse(0.0, 1e-3, 0.1),
            ] {
                let design = filtered.then(|| design(synthesis, &pulse));
                let plan = plan_at_rest(&pulse, 100, 1500.0);
                let said = window_error(synthesis, &plan, RATE_HZ, design).expect("fits");
                let said = said.of_ping(1.0, f64::INFINITY);
                let filter = design.map(|f| f.decimator().expect("fits"));
                let alone = SingleEcho::new(synthesis, &plan, RATE_HZ, filter.as_ref());
                let got = (0..24)
                    .map(|k| (0.01 + 0.754_877_666 * f64::from(k)).fract())
                    .map(|place| alone.at(place, 0.0).window)
                    .fold(0.0, f64::max);
                println!("{synthesis:?} {filtered} {pulse:?}: {got:.2e}, {said:.2e}");
                // The error of an error model is at most twice the echo.
                assert!(got.min(MOST) <= said, "{got:e}, {said:e}");
            }
        }
    }

    /// Sharp pulses, short flanks, long tones, narrow and wide bands. The factors for several echoes,
    /// which may cancel, are up to 10; single echoes are accurate to 1e-4.
    #[test]
    fn direct_is_accurate_in_every_window() {
        for (pulse, rate_hz) in [
            (pulse(24e3, 1e-3, 0.0), 40e3),
            (pulse(20e3, 2e-3, 0.1), 40e3),
            (pulse(10e3, 2e-3, 0.2), 25e3),
            (pulse(0.0, 1.1e-3, 0.5), 40e3),
            (pulse(0.0, 10e-3, 0.0), 40e3),
            (pulse(30e3, 5e-3, 0.0), 40e3),
            (pulse(20e3, 0.27e-3, 0.1), 60e3),
            (pulse(25e3, 0.27e-3, 0.0), 60e3),
        ] {
            let filter = FilterDesign {
                sample_rate_hz: rate_hz,
                oversample: oversample(&pulse, rate_hz, Synthesis::Direct),
                ..design(Synthesis::Direct, &pulse)
            };
            let plan = plan_at_rest(&pulse, 100, 1500.0);
            let error =
                window_error(Synthesis::Direct, &plan, rate_hz, Some(filter)).expect("fits");
            let error = error.of_ping(1.0 / pulse.weakest_window(rate_hz), f64::INFINITY);
            println!("{} points, {pulse:?}: {error:.1e}", filter.oversample);
            assert!(error < 3e-4, "{pulse:?}: {error:e}");
        }
    }
}

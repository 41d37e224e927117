//! The measured error of what goes out: windows of every few pings, computed again through the reference's equation.
//!
//! In: the samples of a ping before noise, gain and converter. Out: a [`ErrorCheck`] over the newest [`KEPT`] windows. A window is a pulse long and
//! its error counts against its own level, or a noise floor 55 dB below the strongest window of its element, as the tolerance has it. Half of the
//! windows are drawn at random; the others are the weakest of their element above the floor, where errors count most. Of a long window a part is
//! computed. Which windows are looked at depends on seed, ping number and samples alone, and how many on the ping's predicted cost, of which they
//! may use [`SHARE`]: the same pings are checked the same on every machine. A window sees every scatterer whose echo is under way in it, and
//! those alone.

use std::sync::{Mutex, PoisonError};

use num_complex::Complex64;
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::{Rng, SeedableRng};
use rayon::prelude::*;

use echotank_config::spec::SonarSpec;
use echotank_core::arrays::ReceiverFilter;
use echotank_core::model::Synthesis;
use echotank_core::ping::{ErrorCheck, PingOutput, PingPlan};
use echotank_core::pulse::{MIN_WINDOW, Pulse, noise_share};
use echotank_core::scene::Scatterers;
use echotank_synthesis::array::direct::Direct;
use echotank_synthesis::array::error_models::synthesis_cost_ms;
use echotank_synthesis::array::filter::{self, Decimator, FilterError};
use echotank_synthesis::echo::error_models::{doppler_error_model, path_error_model};
use echotank_synthesis::echo::probe::{Instant, echoes_at, receivable, receivable_ranges_m};
use echotank_synthesis::error_model::Conditions;

/// Windows that an error check rests on, at most.
pub const KEPT: usize = 64;
/// ... and at least.
pub const LEAST: usize = 16;
/// Of a ping's predicted cost.
pub const SHARE: f64 = 0.01;
/// A checked window is above what is allowed when its error is above this many tolerances; on two checked pings running that is a fault.
pub const FAULT: f64 = 1.3;
/// Looked at in one ping, at most.
pub(crate) const MAX_PER_PING: usize = 16;
/// Samples that are computed of a window, at most.
const SPAN: usize = 64;
/// ... and no longer than this, seconds: so long the expansion about their middle is good to 1e-6 rad.
const SPAN_S: f64 = 1e-3;

/// Samples of a window: a pulse long, but of [`MIN_WINDOW`] samples at least.
pub(crate) fn window_samples(pulse_s: f64, rate_hz: f64) -> usize {
    (pulse_s * rate_hz).ceil().max(MIN_WINDOW) as usize
}

/// The worst window of any element of a whole ping, rms of what is off over the truth's rms in the window or in the ping, whichever is larger:
/// norm M of docs/accuracy.md, weaker than the contract. Infinite where something is heard and nothing is there, no number where a sample is none.
pub fn worst_window(got: &PingOutput, truth: &PingOutput, pulse_s: f64, rate_hz: f64) -> f64 {
    let window = window_samples(pulse_s, rate_hz);
    let mut worst = 0.0f64;
    for (got, truth) in got.elements.iter().zip(&truth.elements) {
        for element in 0..truth.elements {
            let (got, truth) = (got.element(element), truth.element(element));
            let whole = mean_square(truth);
            for (got, truth) in got.chunks(window).zip(truth.chunks(window)) {
                let off = got.iter().zip(truth).map(|(g, t)| (g - t).norm_sqr());
                let off = off.sum::<f64>() / truth.len() as f64;
                if off.is_nan() {
                    return f64::NAN;
                }
                if off > 0.0 {
                    worst = worst.max((off / mean_square(truth).max(whole)).sqrt());
                }
            }
        }
    }
    worst
}

/// First samples of the windows of a record, half a window apart; the last one ends with the record.
fn starts(samples: usize, window: usize) -> impl Iterator<Item = usize> {
    let last = samples.saturating_sub(window);
    (0..last).step_by((window / 2).max(1)).chain([last])
}

/// Mean square of the strongest window.
fn strongest(iq: &[Complex64], window: usize) -> f64 {
    let of = |first: usize| mean_square(&iq[first..(first + window).min(iq.len())]);
    starts(iq.len(), window).map(of).fold(0.0, f64::max)
}

/// First sample of the weakest window above the floor; none in a silent record.
fn weakest(iq: &[Complex64], window: usize, floor: f64) -> Option<usize> {
    let of = |first: usize| mean_square(&iq[first..(first + window).min(iq.len())]);
    let levels = starts(iq.len(), window).map(|first| (first, of(first)));
    let above = levels.filter(|(_, level)| *level > floor);
    above
        .min_by(|a, b| a.1.total_cmp(&b.1))
        .map(|(first, _)| first)
}

/// Measured on one core: ns per scatterer to find those that are heard, per scatterer heard to solve it, and per point of its echo.
const FIND_NS: f64 = 3.0;
const SOLVE_NS: f64 = 500.0;
const POINT_NS: f64 = 0.5;

/// Elements that `gridded-2d` takes at a time; good enough for a cost, as is the next.
const NOMINAL_SECTION_ELEMENTS: f64 = 32.0;
/// Nodes along a line that `gridded-lines` solves delays at; good enough for a cost, as is the next.
const NOMINAL_NODES: f64 = 5.0;
const NOMINAL_SOUND_SPEED_M_PER_S: f64 = 1500.0;

/// Keeps these draws apart from everything else that is seeded with the same number.
const TAG: [u8; 8] = *b"certific";

/// One window under scrutiny.
#[derive(Clone, Copy, Debug)]
struct Probe {
    array: usize,
    element: usize,
    /// The weakest of the element, or a random one.
    is_weakest: bool,
    /// Where the window begins in the record, and what is computed in the window, as shares of what there is.
    begins: f64,
    part: f64,
    /// The part that is computed.
    first: usize,
    count: usize,
    /// What the ping made of it, and the mean square it is held against.
    got: [Complex64; SPAN],
    scale: f64,
    /// Mean of |got - reference|^2 / scale.
    error: f64,
}

impl Default for Probe {
    fn default() -> Self {
        Self {
            array: 0,
            element: 0,
            is_weakest: false,
            begins: 0.0,
            part: 0.0,
            first: 0,
            count: 1,
            got: [Complex64::ZERO; SPAN],
            scale: 0.0,
            error: 0.0,
        }
    }
}

pub(crate) struct ErrorChecker {
    /// The receiver filter at the reference's density.
    decimator: Option<Decimator>,
    /// The first `active` are this ping's.
    probes: Vec<Mutex<Probe>>,
    active: usize,
    /// One per thread: the points of one sample.
    dense: Vec<Mutex<Vec<Complex64>>>,
    ranges_m: Vec<(f64, f64)>,
    candidates: Vec<(u32, u64)>,
    /// Predicted cost of a scatterer at an element, ns.
    pair_ns: f64,
    /// What may be spent, ns, and which share of a ping's predicted cost is added for each.
    credit_ns: f64,
    share: f64,
    /// Relative square errors of random windows, the newest `KEPT`, and of all windows.
    recent: [f64; KEPT],
    seen: usize,
    recent_of_all: [f64; KEPT],
    seen_of_all: usize,
    tolerance: f64,
    /// The newest error check was above [`FAULT`] tolerances, and so was the one before it.
    above: bool,
    fault: bool,
}

impl ErrorChecker {
    /// To be made inside the pool that will run it. `shortest`: the pulse that the receiver filter is made for.
    pub(crate) fn new(
        spec: &SonarSpec,
        shortest: &Pulse,
        doppler_hz: f64,
    ) -> Result<Self, FilterError> {
        let rate_hz = spec.receiver.sample_rate_hz;
        // Denser than `direct`, whose own error the check shall see.
        let oversample = 2 * filter::oversample(shortest, rate_hz, Synthesis::Direct);
        let decimator = match spec.receiver.filter {
            ReceiverFilter::Fir => Some(Decimator::new(shortest, rate_hz, doppler_hz, oversample)?),
            ReceiverFilter::None => None,
        };
        Ok(Self {
            decimator,
            probes: (0..MAX_PER_PING).map(|_| Mutex::default()).collect(),
            active: 0,
            dense: (0..rayon::current_num_threads())
                .map(|_| Mutex::default())
                .collect(),
            ranges_m: Vec::with_capacity(MAX_PER_PING),
            candidates: Vec::new(),
            pair_ns: pair_ns(spec),
            credit_ns: 0.0,
            share: SHARE,
            recent: [0.0; KEPT],
            seen: 0,
            recent_of_all: [0.0; KEPT],
            seen_of_all: 0,
            tolerance: spec.synthesis.tolerance,
            above: false,
            fault: false,
        })
    }

    /// Goes on from the windows and the allowance of another: the error check is of what goes out, whichever methods made it.
    pub(crate) fn carry_on(&mut self, from: &Self) {
        self.credit_ns = from.credit_ns;
        (self.recent, self.seen) = (from.recent, from.seen);
        (self.recent_of_all, self.seen_of_all) = (from.recent_of_all, from.seen_of_all);
        (self.above, self.fault) = (from.above, from.fault);
    }

    /// Sets the predicted cost of a scatterer from the sonar's model.
    pub(crate) fn set_model(&mut self, spec: &SonarSpec) {
        self.pair_ns = pair_ns(spec);
    }

    /// How much error checks may cost, in place of [`SHARE`] of a ping: 0 is nothing, infinity as many samples as a ping can have looked at.
    pub(crate) fn allow(&mut self, share: f64) {
        self.share = share;
        self.credit_ns = 0.0;
    }

    /// Samples of a window that are computed.
    fn span(&self, window: usize, rate_hz: f64) -> usize {
        window.min(SPAN).min((SPAN_S * rate_hz) as usize).max(1)
    }

    /// Points that `count` samples of the output are made of.
    fn points(&self, count: usize) -> usize {
        self.decimator
            .as_ref()
            .map_or(count, |d| d.dense_len(count))
    }

    /// What the filter takes in around `count` samples, seconds.
    fn reach_s(&self, count: usize, rate_hz: f64) -> f64 {
        let dense_hz = self
            .decimator
            .as_ref()
            .map_or(rate_hz, Decimator::dense_rate_hz);
        self.points(count) as f64 / dense_hz
    }

    /// Chooses this ping's windows, as many as its cost allows.
    pub(crate) fn choose(&mut self, plan: &PingPlan, spec: &SonarSpec, scatterers: usize) {
        let rate_hz = spec.receiver.sample_rate_hz;
        let elements: usize = spec.receive.iter().map(|array| array.elements).sum();
        let window_s = plan.window_s(rate_hz);
        let window = window_samples(plan.pulse.duration_s, rate_hz).min(plan.sample_count);
        let span = self.span(window, rate_hz);
        let span_s = plan.pulse.duration_s + self.reach_s(span, rate_hz);
        let under_way = scatterers as f64 * (span_s / window_s).min(1.0);
        // Of a part every element is looked at.
        let looks = spec.receive.iter().map(|a| a.element_pattern.stands_for());
        let looks = looks.max().unwrap_or(1) as f64;
        let points = self.points(span) as f64;
        let probe_ns = looks * under_way * (SOLVE_NS + POINT_NS * points) + 1e3;
        let find_ns = FIND_NS * scatterers as f64;
        self.credit_ns += self.share * self.pair_ns * (scatterers * elements) as f64;
        // Nothing is saved up beyond a full ping's worth: scenes change.
        let most = MAX_PER_PING as f64;
        self.credit_ns = self.credit_ns.min(find_ns + most * probe_ns);
        self.active = 0;
        let affordable = ((self.credit_ns - find_ns) / probe_ns).floor();
        // What finding the scatterers costs is shared by a ping's windows: wait until there are enough of them.
        if elements == 0 || affordable < 1.0 || affordable < most && affordable * probe_ns < find_ns
        {
            return;
        }
        self.active = affordable as usize;
        self.credit_ns -= find_ns + affordable * probe_ns;
        let mut draws = stream(plan, spec.receiver.seed);
        for probe in &mut self.probes[..self.active] {
            let mut element = (draws.next_u64() % elements as u64) as usize;
            let mut array = 0;
            while element >= spec.receive[array].elements {
                element -= spec.receive[array].elements;
                array += 1;
            }
            let mut share = || (draws.next_u64() >> 11) as f64 / (1u64 << 53) as f64;
            let probe = probe.get_mut().unwrap_or_else(PoisonError::into_inner);
            probe.array = array;
            probe.element = element;
            probe.is_weakest = share() < 0.5;
            (probe.begins, probe.part) = (share(), share());
            (probe.count, probe.scale) = (0, 0.0);
        }
    }

    /// Keeps what is needed of one element's finished samples, before the receiver changes them.
    pub(crate) fn take(
        &self,
        plan: &PingPlan,
        rate_hz: f64,
        array: usize,
        element: usize,
        iq: &[Complex64],
    ) {
        let window = window_samples(plan.pulse.duration_s, rate_hz).min(iq.len());
        let mut floor = None;
        for probe in &self.probes[..self.active] {
            let mut probe = probe.lock().unwrap_or_else(PoisonError::into_inner);
            if (probe.array, probe.element) != (array, element) {
                continue;
            }
            let floor = *floor.get_or_insert_with(|| strongest(iq, window) * noise_share());
            let at = |share: f64, places: usize| (share * (places + 1) as f64) as usize;
            let quiet = match probe.is_weakest {
                true => weakest(iq, window, floor),
                false => None,
            };
            let begins = quiet.unwrap_or_else(|| at(probe.begins, iq.len() - window));
            let count = self.span(window, rate_hz);
            let first = begins + at(probe.part, window - count);
            probe.scale = mean_square(&iq[begins..begins + window]).max(floor);
            (probe.first, probe.count) = (first, count);
            probe.got[..count].copy_from_slice(&iq[first..first + count]);
        }
    }

    /// Computes this ping's windows again, and says what the newest ones tell together.
    pub(crate) fn check_error(
        &mut self,
        plan: &PingPlan,
        spec: &SonarSpec,
        scatterers: &Scatterers,
    ) -> Option<ErrorCheck> {
        let rate_hz = spec.receiver.sample_rate_hz;
        let window = window_samples(plan.pulse.duration_s, rate_hz).min(plan.sample_count);
        let span = self.span(window, rate_hz);
        let half_span_s = 0.5 * self.reach_s(span, rate_hz);
        let middle = 0.5 * (span - 1) as f64;
        let instant = |probe: &Probe| Instant {
            element: probe.element,
            time_s: plan.first_sample_s + (probe.first as f64 + middle) / rate_hz,
            half_span_s,
        };
        self.ranges_m.clear();
        for probe in &mut self.probes[..self.active] {
            let probe = probe.get_mut().unwrap_or_else(PoisonError::into_inner);
            let array = spec.receive[probe.array].whole();
            let tx = &spec.transmit[array.transmit];
            let of = spec.receive[probe.array].element_pattern.stands_for();
            let ranges_m = [0, of - 1].map(|j| {
                let element = probe.element * of + j;
                receivable_ranges_m(
                    plan,
                    tx,
                    &array,
                    Instant {
                        element,
                        ..instant(probe)
                    },
                )
            });
            let [(near_m, far_m), (also_near_m, also_far_m)] = ranges_m;
            self.ranges_m
                .push((near_m.min(also_near_m), far_m.max(also_far_m)));
        }
        if self.active > 0 {
            receivable(plan, scatterers, &self.ranges_m, &mut self.candidates);
        }
        let this = &*self;
        this.probes[..this.active]
            .par_iter()
            .enumerate()
            .for_each(|(k, probe)| {
                let mut probe = probe.lock().unwrap_or_else(PoisonError::into_inner);
                let at = instant(&probe);
                let square = this.off(plan, spec, scatterers, &probe, at, k);
                // Where nothing sounds the reference must be silent too.
                probe.error = match (probe.scale > 0.0, square > 0.0) {
                    (true, _) => square / probe.scale,
                    (false, wrong) => f64::from(u8::from(wrong)),
                };
            });
        let mut worst = 0.0f64;
        for probe in &mut self.probes[..self.active] {
            let probe = probe.get_mut().unwrap_or_else(PoisonError::into_inner);
            worst = worst.max(probe.error.sqrt());
            self.recent_of_all[self.seen_of_all % KEPT] = probe.error;
            self.seen_of_all += 1;
            if !probe.is_weakest {
                self.recent[self.seen % KEPT] = probe.error;
                self.seen += 1;
            }
        }
        if self.active > 0 {
            let above = worst > FAULT * self.tolerance;
            self.fault = above && self.above;
            self.above = above;
        }
        let (windows, error, low, high) = estimate(&self.recent[..self.seen.min(KEPT)])?;
        let of_all = &self.recent_of_all[..self.seen_of_all.min(KEPT)];
        Some(ErrorCheck {
            windows,
            error,
            low,
            high,
            worst: of_all.iter().copied().fold(0.0, f64::max).sqrt(),
            tolerance: self.tolerance,
            exceeded: self.active > 0 && self.above,
            fault: self.fault,
        })
    }

    /// Mean square of what a window is off by, from the `k`th instant's candidates.
    fn off(
        &self,
        plan: &PingPlan,
        spec: &SonarSpec,
        scatterers: &Scatterers,
        probe: &Probe,
        at: Instant,
        k: usize,
    ) -> f64 {
        let thread = rayon::current_thread_index().unwrap_or(0);
        let dense = &mut *self.dense[thread]
            .lock()
            .unwrap_or_else(PoisonError::into_inner);
        dense.clear();
        dense.resize(self.points(probe.count), Complex64::ZERO);
        let array = probe.array;
        let sample_rate_hz = spec.receiver.sample_rate_hz;
        let first_sample_s = plan.first_sample_s + probe.first as f64 / sample_rate_hz;
        let filter = self.decimator.as_ref();
        let (first_s, rate_hz, _) =
            filter::grid_ahead(filter, first_sample_s, sample_rate_hz, probe.count);
        let ends = filter.map(Decimator::ends);
        let of = spec.receive[array].element_pattern.stands_for();
        let array = &spec.receive[array].whole();
        let tx = &spec.transmit[array.transmit];
        let indices = || {
            self.candidates
                .iter()
                .filter(|(_, mask)| mask >> k & 1 == 1)
                .map(|(i, _)| *i as usize)
        };
        let mut sink = Direct::new(plan, rate_hz, first_s, dense).with_ends(ends);
        for j in 0..of {
            let element = at.element * of + j;
            let at = Instant { element, ..at };
            echoes_at(plan, tx, array, at, scatterers, indices(), &mut sink);
        }
        let mut filtered = [Complex64::ZERO; SPAN];
        let want = match &self.decimator {
            None => &dense[..probe.count],
            Some(d) => {
                d.apply(dense, &mut filtered[..probe.count]);
                &filtered[..probe.count]
            }
        };
        let got = &probe.got[..probe.count];
        let off = got
            .iter()
            .zip(want)
            .map(|(g, w)| (g - w / of as f64).norm_sqr());
        off.sum::<f64>() / probe.count.max(1) as f64
    }
}

/// Predicted cost of one scatterer at one element, ns.
fn pair_ns(spec: &SonarSpec) -> f64 {
    let conditions = Conditions {
        pulse: spec.pulse,
        sound_speed_m_per_s: NOMINAL_SOUND_SPEED_M_PER_S,
        sample_rate_hz: spec.receiver.sample_rate_hz,
        filter: spec.receiver.filter,
        speed_m_per_s: 0.0,
        acceleration_m_per_s2: 0.0,
        turning_m_per_s: 0.0,
        range_m: (1.0, spec.limits.range_m.1),
        segment_s: spec.model.segment_s,
        scatterers: 1,
        elements: 1,
        tolerance: spec.synthesis.tolerance,
        echo_statistics: None,
    };
    let model = &spec.model;
    let walk_ms = path_error_model(model.path, &conditions).cost_ms
        + doppler_error_model(model.doppler, model.path, &conditions).cost_ms;
    // A whole line is walked once for a section of it, or at its nodes only.
    let elements: usize = spec.receive.iter().map(|array| array.elements).sum();
    let shared_by = match model.synthesis {
        Synthesis::Gridded2d => NOMINAL_SECTION_ELEMENTS,
        Synthesis::GriddedLines => {
            (elements as f64 / (NOMINAL_NODES * spec.receive.len() as f64)).max(1.0)
        }
        _ => 1.0,
    };
    let sum_ms = synthesis_cost_ms(model.synthesis, &conditions) + walk_ms / shared_by;
    sum_ms * 1e6
}

fn stream(plan: &PingPlan, seed: u64) -> ChaCha8Rng {
    let mut key = [0; 32];
    key[..8].copy_from_slice(&seed.to_le_bytes());
    key[8..12].copy_from_slice(&plan.ping_number.to_le_bytes());
    key[12..16].copy_from_slice(&(plan.sonar as u32).to_le_bytes());
    key[24..].copy_from_slice(&TAG);
    ChaCha8Rng::from_seed(key)
}

fn mean_square(iq: &[Complex64]) -> f64 {
    iq.iter().map(|x| x.norm_sqr()).sum::<f64>() / iq.len().max(1) as f64
}

/// How many, the root mean of relative square errors, and both ends of the interval that their own scatter gives it.
fn estimate(squares: &[f64]) -> Option<(u32, f64, f64, f64)> {
    if squares.len() < LEAST {
        return None;
    }
    let n = squares.len() as f64;
    let mean = squares.iter().sum::<f64>() / n;
    let variance = squares.iter().map(|s| (s - mean).powi(2)).sum::<f64>() / (n - 1.0);
    let two_sided = 1.96 * (variance / n).sqrt();
    Some((
        squares.len() as u32,
        mean.sqrt(),
        (mean - two_sided).max(0.0).sqrt(),
        (mean + two_sided).sqrt(),
    ))
}

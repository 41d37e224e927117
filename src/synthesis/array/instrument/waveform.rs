//! A pulse that reaches the elements directly, as a function of time behind the receiver filter.
//!
//! The waveform W(s) is a table at [`OVERSAMPLE`] times the sample rate, interpolated through six points. An element receives
//!
//! ```text
//! A W(s) exp(j 2 pi f_c (s - t)),    s = t + drift t + offset
//! ```
//!
//! with the carrier f_c of the sonar and the time t since its pulse. W is the complex envelope about f_c, so its own carrier may be another.

use num_complex::Complex64;

use super::super::filter::Decimator;
use super::super::phasor::cis;
use echotank_core::pulse::Pulse;

/// Number of points of the table per sample.
pub(super) const OVERSAMPLE: usize = 16;
/// Time constants after which a ring-down ends: -174 dB.
const RING_DECAYS: f64 = 20.0;
/// Points beyond the table that the interpolation reaches.
const REACH: f64 = 3.0;

/// Resonance of a waveform.
#[derive(Clone, Copy, Debug)]
pub(super) struct Ringing {
    /// Time constant, seconds.
    pub(super) decay_s: f64,
    /// Resonance frequency, hertz from the carrier of the sonar.
    pub(super) apart_hz: f64,
}

/// Content of a waveform.
#[derive(Clone, Copy, Debug)]
pub(super) struct WaveformSource {
    pub(super) pulse: Pulse,
    /// Carrier of the pulse, hertz from that of the sonar.
    pub(super) apart_hz: f64,
    pub(super) ringing: Option<Ringing>,
    /// End of the waveform at the latest, seconds.
    pub(super) until_s: f64,
}

impl WaveformSource {
    /// Envelope about the carrier of the sonar, without resonance and filter.
    fn at(&self, t_s: f64) -> Complex64 {
        let envelope = self.pulse.envelope(t_s);
        if self.apart_hz == 0.0 || envelope == Complex64::ZERO {
            return envelope;
        }
        envelope * turn(self.apart_hz * t_s)
    }

    /// Duration with the ring-down, seconds.
    fn duration_s(&self) -> f64 {
        self.whole_s().min(self.until_s)
    }

    fn whole_s(&self) -> f64 {
        self.pulse.duration_s + self.ringing.map_or(0.0, |ring| RING_DECAYS * ring.decay_s)
    }

    /// Fills `out` with the envelope at steps of `step_s` from 0. A point stands for the part of the pulse within half a step of it.
    fn fill(&self, step_s: f64, out: &mut [Complex64]) {
        let end_s = self.pulse.duration_s;
        for (n, out) in out.iter_mut().enumerate() {
            let at_s = n as f64 * step_s;
            let from_s = (at_s - 0.5 * step_s).max(0.0);
            let to_s = (at_s + 0.5 * step_s).min(end_s);
            *out = match to_s > from_s {
                true => self.at(0.5 * (from_s + to_s)) * ((to_s - from_s) / step_s),
                false => Complex64::ZERO,
            };
        }
        if let Some(ringing) = self.ringing {
            ringing.pass(step_s, out);
        }
    }
}

impl Ringing {
    /// Passes samples through the resonance y' = (x - y)/tau + j 2 pi f y. The input is linear between its samples.
    fn pass(&self, step_s: f64, samples: &mut [Complex64]) {
        let steps = step_s / self.decay_s;
        let turns = self.apart_hz * step_s;
        let pole = Complex64::new(-steps, std::f64::consts::TAU * turns);
        let decay = turn(turns) * libm::exp(-steps);
        let first = (decay - 1.0) / pole;
        let second = (first - 1.0) / pole;
        let (old, new) = ((first - second) * steps, second * steps);
        let (mut before, mut state) = (Complex64::ZERO, Complex64::ZERO);
        for sample in samples {
            let input = *sample;
            state = decay * state + old * before + new * input;
            *sample = state;
            before = input;
        }
    }
}

/// exp(j 2 pi turns).
pub(super) fn turn(turns: f64) -> Complex64 {
    let (cos, sin) = cis(turns);
    Complex64::new(cos, sin)
}

/// Instants of a waveform at one element.
#[derive(Clone, Copy, Debug)]
pub(super) struct Timing {
    /// Time of the waveform less that of the element at the start of the sonar's pulse, seconds.
    pub(super) offset_s: f64,
    /// Change of that difference per second: the Doppler of the element's motion.
    pub(super) drift: f64,
}

/// Times of the samples of an element.
#[derive(Clone, Copy, Debug)]
pub(super) struct SampleClock {
    pub(super) first_s: f64,
    pub(super) rate_hz: f64,
    /// Carrier of the sonar, hertz.
    pub(super) carrier_hz: f64,
}

/// A waveform as a table.
pub(super) struct Waveform {
    /// Without filter and resonance the envelope is exact, and there is no table.
    exact: Option<WaveformSource>,
    rate_hz: f64,
    /// Time of the first point, seconds.
    first_s: f64,
    table: Vec<Complex64>,
    /// The waveform ahead of the filter, with zeros around it.
    ahead: Vec<Complex64>,
}

impl Waveform {
    /// Room for waveforms as long as `longest`.
    pub(super) fn with_room_for(
        longest: &WaveformSource,
        filter: Option<&Decimator>,
        sample_rate_hz: f64,
    ) -> Self {
        let rate_hz = sample_rate_hz * OVERSAMPLE as f64;
        let points = points(longest, rate_hz);
        let taps = filter.map_or(1, |filter| filter.taps().len());
        Self {
            exact: None,
            rate_hz,
            first_s: 0.0,
            table: Vec::with_capacity(points + taps),
            ahead: Vec::with_capacity(points + 2 * taps),
        }
    }

    /// Computes the table of `source`.
    pub(super) fn set(&mut self, source: &WaveformSource, filter: Option<&Decimator>) {
        self.exact = None;
        let (points, step_s) = (points(source, self.rate_hz), 1.0 / self.rate_hz);
        let Some(filter) = filter else {
            if source.ringing.is_none() {
                self.exact = Some(*source);
            }
            self.first_s = 0.0;
            self.table.clear();
            self.table.resize(points, Complex64::ZERO);
            source.fill(step_s, &mut self.table);
            return;
        };
        let beside = filter.taps().len() - 1;
        self.ahead.clear();
        self.ahead.resize(points + 2 * beside, Complex64::ZERO);
        source.fill(step_s, &mut self.ahead[beside..beside + points]);
        self.first_s = -0.5 * beside as f64 * step_s;
        self.table.resize(points + beside, Complex64::ZERO);
        filter.apply_dense(&self.ahead, &mut self.table);
    }

    /// First and last time at which the waveform is not zero, seconds.
    pub(super) fn span_s(&self) -> (f64, f64) {
        let beyond_s = REACH / self.rate_hz;
        let last_s = self.first_s + self.table.len() as f64 / self.rate_hz;
        (self.first_s - beyond_s, last_s + beyond_s)
    }

    fn at(&self, s: f64) -> Complex64 {
        if let Some(source) = &self.exact {
            return source.at(s);
        }
        let place = (s - self.first_s) * self.rate_hz;
        let below = place.floor();
        let t = place - below;
        let first = below as i64 - 2;
        let weights = lagrange(t);
        let mut sum = Complex64::ZERO;
        for (j, weight) in (first..).zip(weights) {
            let value = usize::try_from(j).ok().and_then(|j| self.table.get(j));
            sum += value.copied().unwrap_or(Complex64::ZERO) * weight;
        }
        sum
    }

    /// Adds the waveform times `amplitude` to the samples of an element.
    pub(super) fn add(
        &self,
        amplitude: f64,
        timing: Timing,
        clock: SampleClock,
        iq: &mut [Complex64],
    ) {
        let (from_s, to_s) = self.span_s();
        let index = |s: f64| {
            let t_s = (s - timing.offset_s) / (1.0 + timing.drift);
            (t_s - clock.first_s) * clock.rate_hz
        };
        // Negative numbers become 0.
        let from = (index(from_s).floor() as usize).min(iq.len());
        let to = (index(to_s).ceil() as usize).clamp(from, iq.len());
        for (k, sample) in iq.iter_mut().enumerate().take(to).skip(from) {
            let t_s = clock.first_s + k as f64 / clock.rate_hz;
            let ahead_s = timing.drift * t_s + timing.offset_s;
            let value = self.at(t_s + ahead_s);
            *sample += amplitude * value * turn(clock.carrier_hz * ahead_s);
        }
    }
}

/// Number of points of a waveform ahead of the filter.
fn points(source: &WaveformSource, rate_hz: f64) -> usize {
    (source.duration_s() * rate_hz).ceil() as usize + 2
}

/// Weights of the points at -2 to 3 at `t` in [0, 1].
fn lagrange(t: f64) -> [f64; 6] {
    let [a, b, c, d, e, f] = [t + 2.0, t + 1.0, t, t - 1.0, t - 2.0, t - 3.0];
    [
        -(b * c * d * e * f) / 120.0,
        (a * c * d * e * f) / 24.0,
        -(a * b * d * e * f) / 12.0,
        (a * b * c * e * f) / 12.0,
        -(a * b * c * d * f) / 24.0,
        (a * b * c * d * e) / 120.0,
    ]
}

//! Imperfections of transducers and receiver in element samples.
//!
//! The input is the sum of the echoes at every element, behind the receiver filter. In this order:
//!
//! 1. the pulse that leaks from the transmitter, and pulses of second sonars, are added;
//! 2. the response of the transducers filters the samples;
//! 3. each element has its gain and phase;
//! 4. elements couple into each other;
//! 5. tones of power supplies are added.
//!
//! Noise, gain and converter follow ([`receive`](super::receive)). Every sample depends on the plan of its ping and the configuration only.

mod response;
mod second_sonar;
mod tones;
mod waveform;

#[cfg(test)]
mod tests;

use num_complex::Complex64;
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::{Rng, SeedableRng};
use rayon::prelude::*;

use super::filter::{Decimator, FilterDesign, FilterError, occupied_hz};
use crate::echo::levels::amplitude_from_db;
use echotank_config::spec::SonarSpec;
use echotank_core::arrays::{ArrayGeometry, TransmitArray};
use echotank_core::instrument::{ElementSpread, Instrument, Leakage, gain};
use echotank_core::ping::{ElementFrame, PingPlan};
use echotank_core::pulse::Pulse;

use response::ResponseFilter;
use second_sonar::{Arrival, SecondSonarWaves};
use waveform::{OVERSAMPLE, Ringing, SampleClock, Timing, Waveform, WaveformSource};

/// Tag of the random numbers of element errors, different from other uses of the same seed.
const SPREAD_TAG: [u8; 8] = *b"elemsprd";

/// Imperfections that cannot be computed.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum InstrumentError {
    /// The receiver filter cannot be designed.
    #[error("receiver filter: {0}")]
    Filter(#[from] FilterError),
    /// The response rings for longer than the filter of the samples.
    #[error(
        "sonar.instrument.response: rings for more than 500 samples; a lower q or receiver.sample_rate_khz, or a smoother file, is needed"
    )]
    Response,
}

/// Sizes for which [`ElementInstrument`] is made.
#[derive(Clone, Copy, Debug)]
pub struct InstrumentSizes {
    /// Design of the receiver filter; `None` without a filter.
    pub filter: Option<FilterDesign>,
    /// Edge of the pass band for Doppler beside the band of the pulse, hertz.
    pub doppler_hz: f64,
    /// Samples of the longest ping.
    pub max_samples: usize,
}

/// Imperfections of one sonar, with their tables and buffers.
pub struct ElementInstrument {
    instrument: Instrument,
    transmit: Vec<TransmitArray>,
    receive: Vec<ArrayGeometry>,
    sample_rate_hz: f64,
    filter: Option<Decimator>,
    /// Way of sound from the reference point to the farthest element, metres.
    reach_m: f64,
    leaks: Vec<Leak>,
    second_sonars: Vec<SecondSonarWaves>,
    /// Pulses of second sonars in this ping.
    arrivals: Vec<Arrival>,
    response: Option<ResponseFilter>,
    /// Complex gains by array and element; empty if all are 1.
    gains: Vec<Vec<Complex64>>,
    /// Sum of the tones in this ping.
    tones: Vec<Complex64>,
    /// Samples without crosstalk, by array.
    uncoupled: Vec<Vec<Complex64>>,
}

/// A pulse of the sonar that leaks into its elements.
struct Leak {
    pulse: Pulse,
    delay_s: f64,
    /// Transmit array; `None` is that of each receive array.
    transmit: Option<usize>,
    /// Pulse length of the waveform, seconds.
    made_s: Option<f64>,
    waveform: Waveform,
    /// End of the waveform at the latest, seconds: that of the longest ping.
    until_s: f64,
}

impl ElementInstrument {
    /// Imperfections of a sonar; `None` without any.
    ///
    /// # Errors
    /// The response or the receiver filter cannot be computed.
    pub fn new(spec: &SonarSpec, sizes: InstrumentSizes) -> Result<Option<Self>, InstrumentError> {
        let Some(instrument) = &spec.instrument else {
            return Ok(None);
        };
        let rate_hz = spec.receiver.sample_rate_hz;
        let carrier_hz = spec.pulse.center_frequency_hz;
        let filter = sizes.filter.map(|design| {
            let oversample = OVERSAMPLE;
            FilterDesign {
                oversample,
                ..design
            }
            .decimator()
        });
        let filter = filter.transpose()?;
        let response = response_filter(spec, sizes.doppler_hz)?;
        let second_sonars: Vec<_> = instrument
            .second_sonars
            .iter()
            .map(|second| SecondSonarWaves::new(second, carrier_hz, filter.as_ref(), rate_hz))
            .collect();
        let max_window_s = sizes.max_samples as f64 / rate_hz;
        let max_arrivals = second_sonars.iter();
        let max_arrivals = max_arrivals
            .map(|second| second.max_arrivals(max_window_s))
            .sum();
        let elements = spec.receive.iter().flat_map(|array| {
            let outermost = array.outermost();
            outermost.map(|element| array.element_body_m(element).length())
        });
        Ok(Some(Self {
            leaks: leaks(spec, instrument.leakage, filter.as_ref(), max_window_s),
            arrivals: Vec::with_capacity(max_arrivals),
            gains: element_gains(spec, &instrument.element_spread),
            tones: match instrument.tones.is_empty() {
                true => Vec::new(),
                false => Vec::with_capacity(sizes.max_samples),
            },
            uncoupled: match is_coupled(instrument) {
                true => spec.receive.iter().map(|_| Vec::new()).collect(),
                false => Vec::new(),
            },
            reach_m: elements.fold(0.0, f64::max),
            instrument: instrument.clone(),
            transmit: spec.transmit.clone(),
            receive: spec.receive.clone(),
            sample_rate_hz: rate_hz,
            filter,
            second_sonars,
            response,
        }))
    }

    /// Number of later samples on which a sample depends.
    pub fn lookahead(&self) -> usize {
        self.response.as_ref().map_or(0, ResponseFilter::lookahead)
    }

    /// Computes what all elements of a ping share. To be called before [`Self::add_to_element`].
    pub fn prepare(&mut self, plan: &PingPlan) {
        for leak in &mut self.leaks {
            leak.prepare(plan, self.instrument.leakage, self.filter.as_ref());
        }
        let window_s = plan.window_s(self.sample_rate_hz);
        let reach_s = self.reach_m / plan.sound_speed_m_per_s;
        self.arrivals.clear();
        for (index, second) in self.second_sonars.iter().enumerate() {
            second.arrivals(index, plan, window_s, reach_s, &mut self.arrivals);
        }
        if !self.instrument.tones.is_empty() {
            let clock = self.clock(plan);
            self.tones.clear();
            self.tones.resize(plan.sample_count, Complex64::ZERO);
            for tone in &self.instrument.tones {
                let filter = self.filter.as_ref();
                tones::add_tone(tone, plan.transmit_utc, clock, filter, &mut self.tones);
            }
        }
    }

    fn clock(&self, plan: &PingPlan) -> SampleClock {
        SampleClock {
            first_s: plan.first_sample_s,
            rate_hz: self.sample_rate_hz,
            carrier_hz: plan.pulse.center_frequency_hz,
        }
    }

    /// Whether [`Self::add_to_element`] has an effect.
    pub fn acts_on_elements(&self) -> bool {
        !(self.leaks.is_empty() && self.second_sonars.is_empty() && self.gains.is_empty())
            || self.response.is_some()
    }

    /// Steps 1 to 3 for the samples of one element. `before` is a buffer.
    pub fn add_to_element(
        &self,
        plan: &PingPlan,
        array_index: usize,
        element: usize,
        iq: &mut [Complex64],
        before: &mut Vec<Complex64>,
    ) {
        let array = &self.receive[array_index];
        let (clock, c) = (self.clock(plan), plan.sound_speed_m_per_s);
        if let Some(leakage) = &self.instrument.leakage {
            for leak in &self.leaks {
                let transmit = &self.transmit[leak.transmit.unwrap_or(array.transmit)];
                let way_m = transmit
                    .mounting
                    .position_m
                    .distance(array.element_body_m(element));
                let timing = Timing {
                    offset_s: -leak.delay_s - way_m / c,
                    drift: 0.0,
                };
                let level_db = plan.settings.source_level_db
                    + transmit.level_offset_db
                    + leakage.level_db
                    + array.sensitivity_db;
                leak.waveform
                    .add(amplitude_from_db(level_db), timing, clock, iq);
            }
        }
        for arrival in &self.arrivals {
            self.second_sonars[arrival.sonar].add(arrival, c, array, element, clock, iq);
        }
        if let Some(response) = &self.response {
            before.clear();
            before.extend_from_slice(iq);
            response.apply(before, iq);
        }
        if let Some(&gain) = self
            .gains
            .get(array_index)
            .and_then(|gains| gains.get(element))
        {
            for sample in iq {
                *sample *= gain;
            }
        }
    }

    /// Step 4 for the samples of all arrays.
    pub fn couple(&mut self, frames: &mut [ElementFrame]) {
        if self.uncoupled.is_empty() {
            return;
        }
        for (uncoupled, frame) in self.uncoupled.iter_mut().zip(frames.iter()) {
            uncoupled.resize(frame.iq.len(), Complex64::ZERO);
            let copies = uncoupled.par_chunks_mut(frame.samples.max(1));
            let rows = frame.iq.par_chunks(frame.samples.max(1));
            copies
                .zip(rows)
                .for_each(|(copy, row)| copy.copy_from_slice(row));
        }
        let factor = |db: Option<f64>| db.map(|db| gain(db, 0.0).re);
        let crosstalk = &self.instrument.crosstalk;
        let (elements, arrays) = (factor(crosstalk.elements_db), factor(crosstalk.arrays_db));
        let uncoupled = &self.uncoupled;
        for (index, frame) in frames.iter_mut().enumerate() {
            let count = frame.samples;
            if count == 0 {
                continue;
            }
            let own = &uncoupled[index];
            let rows = frame.iq.par_chunks_mut(count).enumerate();
            rows.for_each(|(element, out)| {
                // Elements beyond the end of an array do not exist.
                let mut add = |array: &[Complex64], element: usize, factor: f64| {
                    let rows = array.chunks_exact(count);
                    for (x, y) in out.iter_mut().zip(rows.skip(element).take(1).flatten()) {
                        *x += y * factor;
                    }
                };
                if let Some(factor) = elements {
                    if let Some(before) = element.checked_sub(1) {
                        add(own, before, factor);
                    }
                    add(own, element + 1, factor);
                }
                if let Some(factor) = arrays {
                    for (other, uncoupled) in uncoupled.iter().enumerate() {
                        if other != index {
                            add(uncoupled, element, factor);
                        }
                    }
                }
            });
        }
    }

    /// Step 5 for the samples of one element.
    pub fn add_tones(&self, iq: &mut [Complex64]) {
        for (sample, tone) in iq.iter_mut().zip(&self.tones) {
            *sample += tone;
        }
    }
}

/// The filter of the response over the band of the shortest pulse; `None` without a response.
fn response_filter(
    spec: &SonarSpec,
    doppler_hz: f64,
) -> Result<Option<ResponseFilter>, InstrumentError> {
    let instrument = spec.instrument.as_ref();
    let Some(response) = instrument.and_then(|instrument| instrument.response.as_ref()) else {
        return Ok(None);
    };
    let shortest = Pulse {
        duration_s: spec.limits.pulse_duration_s.0,
        ..spec.pulse
    };
    let pass_hz = 0.5 * occupied_hz(&shortest) + doppler_hz;
    let (carrier_hz, rate_hz) = (spec.pulse.center_frequency_hz, spec.receiver.sample_rate_hz);
    let filter = ResponseFilter::design(response, carrier_hz, pass_hz, rate_hz);
    filter.map(Some).ok_or(InstrumentError::Response)
}

/// Work of the imperfections for each sample of an element.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct InstrumentWork {
    /// Complex products of the response.
    pub products: f64,
    /// Passes over the samples.
    pub passes: f64,
}

impl InstrumentWork {
    /// Work for a sonar; pulses that leak or arrive are short and cost nothing here.
    pub fn of(spec: &SonarSpec, doppler_hz: f64) -> Self {
        let Some(instrument) = &spec.instrument else {
            return Self::default();
        };
        let response = response_filter(spec, doppler_hz).ok().flatten();
        let crosstalk = &instrument.crosstalk;
        let others = match crosstalk.arrays_db {
            Some(_) => spec.receive.len() - 1,
            None => 0,
        };
        let passes = usize::from(!instrument.element_spread.is_none())
            + usize::from(!instrument.tones.is_empty())
            + usize::from(is_coupled(instrument))
            + 2 * usize::from(crosstalk.elements_db.is_some())
            + others;
        Self {
            products: response.map_or(0, |filter| filter.taps()) as f64,
            passes: passes as f64,
        }
    }
}

fn is_coupled(instrument: &Instrument) -> bool {
    let crosstalk = &instrument.crosstalk;
    crosstalk.elements_db.is_some() || crosstalk.arrays_db.is_some()
}

/// The pulses that leak, with room for the longest.
fn leaks(
    spec: &SonarSpec,
    leakage: Option<Leakage>,
    filter: Option<&Decimator>,
    max_window_s: f64,
) -> Vec<Leak> {
    let Some(leakage) = leakage else {
        return Vec::new();
    };
    let until_s = max_window_s + filter.map_or(0.0, Decimator::half_s);
    let own = (spec.pulse, 0.0, None);
    let more = spec.more_pulses.iter();
    let more = more.map(|more| (more.pulse, more.delay_s, more.transmit));
    let pulses = std::iter::once(own).chain(more);
    let leak = |(pulse, delay_s, transmit): (Pulse, f64, Option<usize>)| {
        let longest = Pulse {
            duration_s: spec.limits.pulse_duration_s.1,
            ..pulse
        };
        let longest = source(longest, leakage, spec.pulse.center_frequency_hz, until_s);
        let rate_hz = spec.receiver.sample_rate_hz;
        Leak {
            pulse,
            delay_s,
            transmit,
            made_s: None,
            until_s,
            waveform: Waveform::with_room_for(&longest, filter, rate_hz),
        }
    };
    pulses.map(leak).collect()
}

/// Waveform of a pulse that leaks.
fn source(pulse: Pulse, leakage: Leakage, carrier_hz: f64, until_s: f64) -> WaveformSource {
    WaveformSource {
        pulse,
        apart_hz: pulse.center_frequency_hz - carrier_hz,
        ringing: leakage.ring_down.map(|resonance| Ringing {
            decay_s: resonance.decay_s(),
            apart_hz: resonance.frequency_hz - carrier_hz,
        }),
        until_s,
    }
}

impl Leak {
    /// Computes the waveform for the pulse length of a ping.
    fn prepare(&mut self, plan: &PingPlan, leakage: Option<Leakage>, filter: Option<&Decimator>) {
        let duration_s = plan.settings.pulse_duration_s;
        let Some(leakage) = leakage.filter(|_| self.made_s != Some(duration_s)) else {
            return;
        };
        let pulse = Pulse {
            duration_s,
            ..self.pulse
        };
        let source = source(pulse, leakage, plan.pulse.center_frequency_hz, self.until_s);
        self.waveform.set(&source, filter);
        self.made_s = Some(duration_s);
    }
}

/// Complex gains by array and element; empty if all are 1. Random gains depend on the seed, the name of the sonar, the array and the element only.
fn element_gains(spec: &SonarSpec, spread: &ElementSpread) -> Vec<Vec<Complex64>> {
    if spread.is_none() {
        return Vec::new();
    }
    let random = |array: usize, element: usize| {
        let mut key = [0; 32];
        key[..8].copy_from_slice(&spread.seed.to_le_bytes());
        key[8..12].copy_from_slice(&(array as u32).to_le_bytes());
        key[12..16].copy_from_slice(&(element as u32).to_le_bytes());
        key[16..24].copy_from_slice(&hash(spec.name.as_bytes()).to_le_bytes());
        key[24..].copy_from_slice(&SPREAD_TAG);
        let mut rng = ChaCha8Rng::from_seed(key);
        // Box and Muller 1958, from numbers in (0, 1].
        let mut unit = || ((rng.next_u64() >> 11) + 1) as f64 / (1u64 << 53) as f64;
        let radius = (-2.0 * libm::log(unit())).sqrt();
        let (sin, cos) = libm::sincos(std::f64::consts::TAU * unit());
        gain(
            spread.gain_db * radius * cos,
            spread.phase_rad * radius * sin,
        )
    };
    let arrays = spec.receive.iter().enumerate().map(|(array, geometry)| {
        let elements = 0..geometry.elements;
        elements.map(|element| random(array, element)).collect()
    });
    let mut gains: Vec<Vec<Complex64>> = arrays.collect();
    for error in &spread.measured {
        gains[error.array][error.element] = gain(error.gain_db, error.phase_rad);
    }
    gains
}

/// FNV-1a, 64 bits.
fn hash(bytes: &[u8]) -> u64 {
    let start = 0xcbf2_9ce4_8422_2325;
    bytes.iter().fold(start, |hash, &byte| {
        (hash ^ u64::from(byte)).wrapping_mul(0x0100_0000_01b3)
    })
}

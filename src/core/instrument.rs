//! Imperfections of transducers and receiver, and other sources that the receive elements pick up.

use num_complex::Complex64;

use crate::pulse::Pulse;

/// Imperfections of one sonar. The default has none.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Instrument {
    /// Pulse that leaks from the transmitter into the receive elements.
    pub leakage: Option<Leakage>,
    /// Coupling between elements.
    pub crosstalk: Crosstalk,
    /// Response of the transducers over frequency.
    pub response: Option<TransducerResponse>,
    /// Gain and phase of single elements.
    pub element_spread: ElementSpread,
    /// Tones of power supplies.
    pub tones: Vec<Tone>,
    /// Other sonars in the same water.
    pub second_sonars: Vec<SecondSonar>,
}

/// Pulse that leaks from a transmitter into the receive elements.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Leakage {
    /// Level at an element, relative to the source level at 1 m, dB.
    pub level_db: f64,
    /// Resonance that rings after the pulse; `None` ends with the pulse.
    pub ring_down: Option<Resonance>,
}

/// A single resonance.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Resonance {
    /// Quality factor: resonance frequency over -3 dB bandwidth.
    pub q: f64,
    /// Resonance frequency, hertz.
    pub frequency_hz: f64,
}

impl Resonance {
    /// Time constant of the decaying amplitude, Q / (pi f), seconds.
    pub fn decay_s(&self) -> f64 {
        self.q / (std::f64::consts::PI * self.frequency_hz)
    }

    /// Response at a frequency above 0, hertz, relative to that at resonance: 1 / (1 + j Q (f/f0 - f0/f)).
    pub fn response(&self, frequency_hz: f64) -> Complex64 {
        let detuning = frequency_hz / self.frequency_hz - self.frequency_hz / frequency_hz;
        Complex64::new(1.0, self.q * detuning).inv()
    }
}

/// Coupling between elements, dB; `None` is no coupling. The coupled signal has the sign of its source.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Crosstalk {
    /// Between neighbours in an array.
    pub elements_db: Option<f64>,
    /// Between elements with the same index in different arrays.
    pub arrays_db: Option<f64>,
}

/// Response of transmitter and receive elements together, relative to source level and sensitivity.
#[derive(Clone, Debug, PartialEq)]
pub enum TransducerResponse {
    /// One resonance with response 1 at its frequency.
    Resonance(Resonance),
    /// Points in order of frequency. Level and phase are linear between the points and constant beyond them.
    Table(Vec<ResponsePoint>),
}

/// Point of a transducer response.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ResponsePoint {
    /// Frequency, hertz.
    pub frequency_hz: f64,
    /// Level, dB.
    pub level_db: f64,
    /// Phase, radians; not wrapped.
    pub phase_rad: f64,
}

impl TransducerResponse {
    /// Response at a frequency above 0, hertz.
    pub fn at(&self, frequency_hz: f64) -> Complex64 {
        let points = match self {
            Self::Resonance(resonance) => return resonance.response(frequency_hz),
            Self::Table(points) => points,
        };
        let next = points.partition_point(|point| point.frequency_hz <= frequency_hz);
        let before = next.checked_sub(1).and_then(|before| points.get(before));
        let (level_db, phase_rad) = match (before, points.get(next)) {
            (Some(a), Some(b)) => {
                let share = (frequency_hz - a.frequency_hz) / (b.frequency_hz - a.frequency_hz);
                (
                    a.level_db + share * (b.level_db - a.level_db),
                    a.phase_rad + share * (b.phase_rad - a.phase_rad),
                )
            }
            (Some(end), None) | (None, Some(end)) => (end.level_db, end.phase_rad),
            (None, None) => (0.0, 0.0),
        };
        gain(level_db, phase_rad)
    }
}

/// Gain and phase errors of the receive elements, the same in every ping.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct ElementSpread {
    /// Standard deviation of the gain, dB.
    pub gain_db: f64,
    /// Standard deviation of the phase, radians.
    pub phase_rad: f64,
    /// Seed of gains and phases.
    pub seed: u64,
    /// Measured errors. Elements without one have a gain of 1.
    pub measured: Vec<ElementError>,
}

impl ElementSpread {
    /// Whether all elements are equal.
    pub fn is_none(&self) -> bool {
        self.gain_db == 0.0 && self.phase_rad == 0.0 && self.measured.is_empty()
    }
}

/// Measured gain and phase error of one element.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ElementError {
    /// Index of the receive array.
    pub array: usize,
    /// Index of the element.
    pub element: usize,
    /// Gain, dB.
    pub gain_db: f64,
    /// Phase, radians.
    pub phase_rad: f64,
}

/// Complex factor of a gain in dB and a phase in radians, with the same bits on every machine.
pub fn gain(db: f64, phase_rad: f64) -> Complex64 {
    let amplitude = libm::exp(db * (std::f64::consts::LN_10 / 20.0));
    let (sin, cos) = libm::sincos(phase_rad);
    Complex64::new(amplitude * cos, amplitude * sin)
}

/// Place at which a tone enters the receiver.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ToneEntry {
    /// The inputs of the receiver, before its filter.
    Input,
    /// I and Q after the mixer and the receiver filter, before the gain.
    Baseband,
}

/// A tone of constant frequency in all elements, with continuous phase from ping to ping.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Tone {
    /// Frequency, hertz.
    pub frequency_hz: f64,
    /// Level before the gain, dB re 1 V (rms). In baseband the level in I and in Q.
    pub level_db: f64,
    /// Phase at UTC 0, radians.
    pub phase_rad: f64,
    /// Place at which it enters the receiver.
    pub entry: ToneEntry,
}

/// Another sonar far away. Its pulses arrive as plane waves, at the instants of its own clock.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SecondSonar {
    /// Pulse, on its own clock.
    pub pulse: Pulse,
    /// Time between pulses on its own clock, seconds.
    pub period_s: f64,
    /// Arrival of a pulse at the reference point after UTC 0, seconds.
    pub offset_s: f64,
    /// Excess of its period over the nominal period in UTC, parts per million: positive is a slow clock.
    pub drift_ppm: f64,
    /// Direction from which the pulses arrive, radians clockwise from north.
    pub bearing_rad: f64,
    /// Angle of that direction below the horizon, radians.
    pub depression_rad: f64,
    /// Level at this sonar, dB re 1 uPa (rms).
    pub level_db: f64,
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_resonance_is_3_db_down_at_the_edges_of_its_band() {
        let resonance = Resonance {
            q: 8.0,
            frequency_hz: 100e3,
        };
        assert_eq!(resonance.response(100e3), Complex64::ONE);
        // Edges f0 (sqrt(1 + 1/4Q^2) +- 1/2Q): their difference is f0/Q.
        let middle = (1.0 + 1.0 / (4.0 * 64.0_f64)).sqrt();
        for (edge, phase) in [
            (middle - 1.0 / 16.0, 45.0),
            (middle + 1.0 / 16.0, -45.0_f64),
        ] {
            let response = resonance.response(100e3 * edge);
            assert!((response.norm() - 0.5_f64.sqrt()).abs() < 1e-12);
            assert!((response.arg().to_degrees() - phase).abs() < 1e-9);
        }
        assert!((resonance.decay_s() - 25.4648e-6).abs() < 1e-10);
    }

    #[test]
    fn a_table_is_linear_in_db_and_phase_and_constant_beyond_its_ends() {
        let point = |khz: f64, level_db: f64, phase_deg: f64| ResponsePoint {
            frequency_hz: 1e3 * khz,
            level_db,
            phase_rad: phase_deg.to_radians(),
        };
        let table =
            TransducerResponse::Table(vec![point(90.0, -6.0, 40.0), point(110.0, 0.0, -20.0)]);
        for (khz, level_db, phase_deg) in [
            (50.0, -6.0, 40.0),
            (90.0, -6.0, 40.0),
            (95.0, -4.5, 25.0),
            (110.0, 0.0, -20.0),
            (400.0, 0.0, -20.0),
        ] {
            let got = table.at(1e3 * khz);
            assert!(
                (20.0 * got.norm().log10() - level_db).abs() < 1e-12,
                "{khz}"
            );
            assert!((got.arg().to_degrees() - phase_deg).abs() < 1e-12, "{khz}");
        }
    }
}

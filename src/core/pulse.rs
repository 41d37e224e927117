//! The transmitted pulse.

use num_complex::Complex64;

/// The transmitted pulse: sqrt(2) Re{ a(t) exp(j 2pi f_c t) }, 0 <= t <= T.
/// LFM: a(t) = taper(t) exp(+-j pi (B/T) (t - T/2)^2), with the plus sign for an upward sweep. CW: a(t) = taper(t).
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Pulse {
    /// Modulation.
    pub kind: PulseKind,
    /// Centre frequency f_c, hertz.
    pub center_frequency_hz: f64,
    /// Swept bandwidth B, hertz; 0 for CW.
    pub bandwidth_hz: f64,
    /// Length T, seconds.
    pub duration_s: f64,
    /// Tukey taper: fraction of the pulse under the two cosine flanks; 0 is rectangular.
    pub taper: f64,
}

impl Pulse {
    /// Sweep rate, hertz per second: +B/T up, -B/T down, 0 for CW.
    pub fn sweep_hz_per_s(&self) -> f64 {
        match self.kind {
            PulseKind::LfmUp => self.bandwidth_hz / self.duration_s,
            PulseKind::LfmDown => -self.bandwidth_hz / self.duration_s,
            PulseKind::Cw => 0.0,
        }
    }

    /// Range resolution c / 2B at a sound speed in m/s, metres. B is at least the inverse of the pulse length.
    pub fn range_resolution_m(&self, sound_speed_m_per_s: f64) -> f64 {
        let bandwidth_hz = match self.kind {
            PulseKind::Cw => 0.0,
            PulseKind::LfmUp | PulseKind::LfmDown => self.bandwidth_hz,
        };
        sound_speed_m_per_s / (2.0 * bandwidth_hz.max(1.0 / self.duration_s))
    }

    /// a(t) at `t_s` seconds after the start of the pulse; zero outside 0..=T, both ends inclusive.
    pub fn envelope(&self, t_s: f64) -> Complex64 {
        let duration_s = self.duration_s;
        if !(0.0..=duration_s).contains(&t_s) {
            return Complex64::ZERO;
        }
        // Tukey: raised cosine over `taper * T / 2` at each end.
        let flank_s = 0.5 * self.taper * duration_s;
        let from_end_s = t_s.min(duration_s - t_s);
        let level = if from_end_s < flank_s {
            libm::sin(0.5 * std::f64::consts::PI * from_end_s / flank_s).powi(2)
        } else {
            1.0
        };
        let from_middle_s = t_s - 0.5 * duration_s;
        let turns = 0.5 * self.sweep_hz_per_s() * from_middle_s * from_middle_s;
        let (sin, cos) = libm::sincos(std::f64::consts::TAU * (turns - turns.round()));
        Complex64::new(level * cos, level * sin)
    }

    /// Lower bound of the rms of a window of one pulse length, relative to the rms of the echoes that overlap in the window. One
    /// window in ten thousand is weaker. A window with many degrees of freedom (bandwidth times window length) is never much weaker
    /// than its echoes. A window of a pure tone can be much weaker.
    ///
    /// The energy of a window follows a gamma distribution, whose lower tail is a power law. Taper flanks reduce the degrees of
    /// freedom of a chirp to those of a rectangular pulse with the same ratio of mean to mean square. A squared raised cosine has
    /// mean 3/8; its fourth power has mean 35/128.
    pub fn weakest_window(&self, sample_rate_hz: f64) -> f64 {
        let window_s = self.duration_s.max(MIN_WINDOW / sample_rate_hz);
        let flat = 1.0 - self.taper;
        let even = (flat + 3.0 / 8.0 * self.taper).powi(2) / (flat + 35.0 / 128.0 * self.taper);
        let freedom = 1.0 + (even * self.bandwidth_hz).max(1.0 / self.duration_s) * window_s;
        let weakest =
            libm::exp((WEAKEST_WINDOWS.ln() + libm::lgamma(freedom + 1.0)) / freedom) / freedom;
        weakest.sqrt().min(1.0)
    }
}

/// Minimum length of the windows over which errors are measured, samples.
pub const MIN_WINDOW: f64 = 32.0;

/// Level of the noise floor below the strongest window of a ping, dB. Errors of weaker windows are relative to the floor.
pub const FLOOR_BELOW_STRONGEST_DB: f64 = 55.0;

/// The noise floor over the strongest window's energy.
pub fn noise_share() -> f64 {
    libm::exp10(-0.1 * FLOOR_BELOW_STRONGEST_DB)
}

/// Fraction of windows that may be weaker than [`Pulse::weakest_window`]. A ping has some thousands of windows.
const WEAKEST_WINDOWS: f64 = 1e-4;

/// Modulation of a pulse.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum PulseKind {
    /// Linear frequency sweep, upward.
    LfmUp,
    /// Linear frequency sweep, downward.
    LfmDown,
    /// Constant frequency.
    Cw,
}

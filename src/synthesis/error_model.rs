//! Error and cost that are predicted for a method, and the conditions of a ping that the prediction depends on.

use echotank_core::arrays::ReceiverFilter;
use echotank_core::pulse::Pulse;

/// Predicted error and cost of a method, for method selection.
#[derive(Clone, Debug, PartialEq)]
pub struct ErrorModel {
    /// Name of the method.
    pub name: &'static str,
    /// Predicted relative error against the reference solution.
    pub error: f64,
    /// Predicted core time per ping, milliseconds.
    pub cost_ms: f64,
    /// Reason for the prediction, for reports.
    pub why: String,
}

impl ErrorModel {
    /// Returns the error model if its error is within `tolerance`.
    pub fn within(self, tolerance: f64) -> Result<Self, MethodRefused> {
        if self.error <= tolerance {
            return Ok(self);
        }
        Err(MethodRefused {
            name: self.name,
            error: self.error,
            tolerance,
            why: self.why,
        })
    }
}

/// Refusal of a method, because its error exceeds the tolerance.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[error("{name} has an error of {error:.1e} here, above the tolerance of {tolerance:.1e}: {why}")]
pub struct MethodRefused {
    /// Name of the method.
    pub name: &'static str,
    /// Predicted relative error, as in [`ErrorModel`].
    pub error: f64,
    /// Required tolerance.
    pub tolerance: f64,
    /// Reason for the prediction.
    pub why: String,
}

/// Parameters of the error and cost models, with the maxima over a ping or a run.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Conditions {
    /// Transmitted pulse.
    pub pulse: Pulse,
    /// Sound speed, metres per second.
    pub sound_speed_m_per_s: f64,
    /// Sample rate, hertz.
    pub sample_rate_hz: f64,
    /// Receiver filter.
    pub filter: ReceiverFilter,
    /// Speed of a transmitter or element, including its lever arm, metres per second.
    pub speed_m_per_s: f64,
    /// Acceleration of a transmitter or element, metres per second squared.
    pub acceleration_m_per_s2: f64,
    /// Speed of the end of a lever arm from the rotation of the platform, metres per second.
    pub turning_m_per_s: f64,
    /// Ranges of the nearest and the farthest scatterer, metres.
    pub range_m: (f64, f64),
    /// Maximum length of a polyline segment, seconds.
    pub segment_s: f64,
    /// Number of scatterers.
    pub scatterers: usize,
    /// Number of elements.
    pub elements: usize,
    /// Tolerance of methods that meet one.
    pub tolerance: f64,
    /// Statistics of the received echoes; `None` if echoes may come from any direction.
    pub echo_statistics: Option<EchoStatistics>,
}

/// What a sample of the echoes and of the elements, and motion tabled at instants, may leave out where echoes overlap, whose energy is not that of
/// Gaussian samples: with 1.1, as elsewhere, 2 of 81 rigs of `tools/points_random.py` were 2 % above the prediction. [`EchoStatistics::tails`] include it.
pub const OVERLAPPING: f64 = 1.3;

/// Energy-weighted motion of the received echoes, for the worst window of one pulse length, at any offset, of a ping. A phase in proportion to a
/// value is the relative error of that window's samples, against the window's own level or a noise floor 55 dB below the strongest window,
/// whichever is higher. Where many echoes interfere, the values include what their samples may cancel.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct EchoStatistics {
    /// Displacement of an element along the ray between pulse and echo, metres.
    pub displacement_m: f64,
    /// Closing speed along the ray, mean of transmitter and element, metres per second. A window may hold only the end of a
    /// pulse, where the Doppler phase is largest. The value is scaled so that its root mean square represents a whole pulse. It
    /// therefore exceeds [`Self::closing_of_echoes_m_per_s`].
    pub closing_m_per_s: f64,
    /// Closing speed of whole echoes, metres per second.
    pub closing_of_echoes_m_per_s: f64,
    /// Closing speeds of the echoes of a window lie so far apart, mean over windows, metres per second.
    pub closing_apart_m_per_s: f64,
    /// Second derivative of the range, mean of both legs, metres per second squared.
    pub range_acceleration_m_per_s2: f64,
    /// The same, with equal weight all through an echo: errors of its size are there at the onset too.
    pub range_acceleration_throughout_m_per_s2: f64,
    /// Third derivative of the range that leaves as much at an end of a pulse as all orders above the second about mid-pulse,
    /// mean of both legs, metres per second cubed.
    pub range_jerk_m_per_s3: f64,
    /// Acceleration of an element along the ray, metres per second squared.
    pub acceleration_m_per_s2: f64,
    /// Speed of an element on its lever arm from the rotation of the platform, along the ray, metres per second.
    pub turning_m_per_s: f64,
    /// Change of the acceleration of a transmitter or element along the ray, within a pulse, metres per second squared.
    pub acceleration_change_m_per_s2: f64,
    /// Step of the acceleration at mid-pulse after which the end of the pulse is as far off as it is, mean of both legs along the
    /// rays, metres per second squared.
    pub unsteady_m_per_s2: f64,
    /// Component along the ray of the motion of an element across its array, metres per second.
    pub across_m_per_s: f64,
    /// Ratio of the summed error of echoes with random phases, in the worst window of any element, to its root mean square. It
    /// includes an allowance for the sampling of echoes.
    pub spread: f64,
    /// Errors of random phase in the worst window, over their rms over whole echoes. It includes the fading of the window.
    pub fading: f64,
    /// In the worst window, the rms of all echoes that sound in it, or just before or after it, each as a whole, over the level of the window.
    /// Infinite before the samples are known: a window may hold no more than the tail of an echo.
    pub tails: f64,
    /// Of windows that hold no more than the ends of echoes, the rms of these ends over the level of the window, where they cancel the most, with what errors
    /// of two may add up to, and less where the engine errs less. The square root of two before the samples are known, of echoes that end together.
    pub ends: f64,
    /// Distance of an element from where the path model has it, along the rays, metres, where the path model is known.
    pub off_path_m: Option<f64>,
    /// Mean velocity within the pulse that the path model is off by, of transmitter and element together along the rays, metres per second, where the path
    /// model is known: scaled as [`Self::closing_m_per_s`]. [`Self::unsteady_m_per_s2`] is part of it.
    pub off_velocity_m_per_s: Option<f64>,
    /// Number of echoes of all elements.
    pub echoes: f64,
    /// How many of them have a sample whose gain or loss, at the beginning or the end, is an error above 2^-(k + 1) in some window, by k. The last
    /// number has all.
    pub prominent: [f64; PROMINENCES],
}

/// Levels of error of [`EchoStatistics::prominent`].
pub const PROMINENCES: usize = 16;

impl Conditions {
    /// Relative error from a phase error of `phase_rad` (rms); at most 2, the error of an echo with the opposite sign.
    pub fn error_of_phase(phase_rad: f64) -> f64 {
        phase_rad.min(2.0)
    }

    /// Wavenumber at the highest frequency of the sweep, radians per metre.
    pub fn wavenumber_per_m(&self) -> f64 {
        let highest_hz = self.pulse.center_frequency_hz + 0.5 * self.pulse.bandwidth_hz;
        std::f64::consts::TAU * highest_hz / self.sound_speed_m_per_s
    }
}

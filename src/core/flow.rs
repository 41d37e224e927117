//! The domain types passed between the stages of a ping, as plain data, and the interface between echoes and samples, [`ArrivalSink`].
//!
//! ```text
//! io::nav -> nav -> ping -> scene -> echo -> array -> beam -> image -> emit -> io
//!     NavSample PingPlan Scatterers ArrivalChunk ElementFrame BeamFrame Line  Datagram
//! ```
//!
//! Units are SI with radians, axes north-east-down, values f64. Degrees, kHz and dB occur only in the configuration and in records.
//! Times in seconds (`_s`) within a ping count from `PingPlan::transmit_utc`, the start of the pulse.

mod parts;

use std::net::SocketAddr;
use std::sync::Arc;

use glam::{DQuat, DVec3};
use num_complex::Complex64;

use crate::frames::{Pose, Trajectory};
use crate::time::UtcNs;

// ---------------------------------------------------------------- navigation

/// One decoded measurement of a navigation source.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct NavSample {
    /// Index of the source in `NavSpec::sources`.
    pub source: u16,
    /// Time of validity, rig time.
    pub valid_utc: UtcNs,
    /// Arrival of the first byte, rig time; for a recorded log the stamp of the recorder.
    pub arrival_utc: UtcNs,
    /// Measured values.
    pub quantity: NavQuantity,
}

/// Measured values of one sample. Angles in radians: roll positive starboard down, pitch positive bow up, heading clockwise from
/// true north. Heave is positive down.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum NavQuantity {
    /// Antenna position on WGS84.
    Position {
        /// Geodetic latitude, positive north.
        latitude_rad: f64,
        /// Longitude, positive east.
        longitude_rad: f64,
        /// Height above the datum of the source (mean sea level for GGA), if given.
        height_m: Option<f64>,
        /// Quality of the position.
        fix: FixQuality,
    },
    /// Position in world coordinates, from a CSV track.
    LocalPosition {
        /// World north, metres.
        north_m: f64,
        /// World east, metres.
        east_m: f64,
        /// World down, metres.
        down_m: f64,
    },
    /// Motion over ground.
    CourseSpeed {
        /// Course, clockwise from true north.
        course_rad: f64,
        /// Horizontal speed, metres per second.
        speed_m_per_s: f64,
    },
    /// True heading.
    Heading {
        /// Heading, clockwise from true north.
        heading_rad: f64,
    },
    /// Roll and pitch of the sensor.
    RollPitch {
        /// Roll, positive starboard down.
        roll_rad: f64,
        /// Pitch, positive bow up.
        pitch_rad: f64,
    },
    /// Heave of the sensor.
    Heave {
        /// Heave, metres, positive down.
        heave_down_m: f64,
    },
    /// Depth of the platform's depth sensor.
    Depth {
        /// Depth below the surface, metres.
        depth_m: f64,
    },
}

/// Quality of a GNSS position.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum FixQuality {
    /// No fix.
    #[default]
    None,
    /// GNSS without corrections; also manual and simulated positions.
    Autonomous,
    /// Differential GNSS.
    Differential,
    /// Real-time kinematic, integer ambiguities.
    RtkFixed,
    /// Real-time kinematic, float ambiguities.
    RtkFloat,
    /// Estimated position.
    DeadReckoning,
}

/// State of the platform at one instant, for output records; the echo model uses [`PingPlan::trajectory`].
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct NavState {
    /// Rig time.
    pub utc: UtcNs,
    /// Pose of the reference point.
    pub pose: Pose,
    /// Roll, positive starboard down, radians.
    pub roll_rad: f64,
    /// Pitch, positive bow up, radians.
    pub pitch_rad: f64,
    /// Heading, clockwise from true north, radians.
    pub heading_rad: f64,
    /// Heave, metres, positive down; zero if heave is not used.
    pub heave_down_m: f64,
    /// WGS84 latitude of the reference point, radians.
    pub latitude_rad: f64,
    /// WGS84 longitude of the reference point, radians.
    pub longitude_rad: f64,
    /// Height, metres: the negative of world down.
    pub height_m: f64,
    /// Quality of the newest position.
    pub fix: FixQuality,
    /// Age of the newest position used, seconds; negative if a later sample is known (interpolation).
    pub position_age_s: f64,
    /// Age of the newest attitude used, seconds; negative if a later sample is known.
    pub attitude_age_s: f64,
    /// Some quantity is extrapolated.
    pub extrapolated: bool,
    /// Quantities that are out of date.
    pub invalid: NavInvalid,
}

/// Flags of quantities that are too old; their last known values are held.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct NavInvalid {
    /// Horizontal position.
    pub position: bool,
    /// Heading.
    pub heading: bool,
    /// Roll and pitch.
    pub roll_pitch: bool,
    /// Heave or depth, if used.
    pub vertical: bool,
}

impl NavInvalid {
    /// Whether any quantity is invalid.
    pub fn any(&self) -> bool {
        self.position || self.heading || self.roll_pitch || self.vertical
    }
}

// ---------------------------------------------------------------- the ping

/// Settings that an operator or a topside can change while the sonar runs.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SonarSettings {
    /// The sonar pings.
    pub pinging: bool,
    /// Maximum slant range, metres.
    pub range_m: f64,
    /// Maximum ping rate, hertz; 0 only while `pinging` is false.
    pub max_ping_rate_hz: f64,
    /// Source level, dB re 1 uPa at 1 m.
    pub source_level_db: f64,
    /// Receiver gain, dB.
    pub gain_db: f64,
    /// Pulse length, seconds.
    pub pulse_duration_s: f64,
}

/// Inclusive limits of the settings; the maxima determine buffer sizes.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SettingLimits {
    /// Slant range, metres.
    pub range_m: (f64, f64),
    /// Ping rate, hertz.
    pub ping_rate_hz: (f64, f64),
    /// Source level, dB re 1 uPa at 1 m.
    pub source_level_db: (f64, f64),
    /// Receiver gain, dB.
    pub gain_db: (f64, f64),
    /// Pulse length, seconds.
    pub pulse_duration_s: (f64, f64),
}

/// Origin of the ping triggers.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum TriggerSource {
    /// The sonar's own ping rate.
    #[default]
    Internal,
    /// External pulses; the sonar itself starts only pings requested by number.
    External,
}

/// One requested change of the settings.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum SettingChange {
    /// Maximum slant range, metres.
    RangeM(f64),
    /// Maximum ping rate, hertz. 0 pauses pinging; a later rate above 0 resumes it.
    MaxPingRateHz(f64),
    /// Source level, dB re 1 uPa at 1 m.
    SourceLevelDb(f64),
    /// Receiver gain, dB.
    GainDb(f64),
    /// Pulse length, seconds.
    PulseDurationS(f64),
    /// Start pinging.
    Start,
    /// Stop pinging.
    Stop,
    /// Transmit this number of pings at the ping rate, then stop; ends a [`Self::Start`].
    PingTimes(u32),
    /// Change the trigger source.
    Trigger(TriggerSource),
}

/// Key of a device setting that the model stores but does not use.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct KeptKey {
    /// Protocol of the setting.
    pub via: &'static str,
    /// Name of the setting in the protocol.
    pub name: &'static str,
    /// Index of the channel or subsystem; 0 if there is one.
    pub place: u32,
}

/// Value of a stored setting, reported back unchanged.
#[derive(Clone, Debug, PartialEq)]
pub enum KeptValue {
    /// Integer value.
    Integer(i64),
    /// List of numbers.
    Numbers(Vec<f64>),
    /// Text value.
    Text(String),
}

/// Origin of a change.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Asker {
    /// Protocol, page or command.
    pub via: &'static str,
    /// Network address of the client, if there is one.
    pub peer: Option<SocketAddr>,
}

/// Time and origin of a change.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Asked {
    /// Rig time.
    pub utc: UtcNs,
    /// Origin.
    pub by: Asker,
}

impl From<UtcNs> for Asked {
    /// A change by the program itself.
    fn from(utc: UtcNs) -> Self {
        let by = Asker {
            via: "echotank",
            peer: None,
        };
        Self { utc, by }
    }
}

/// A change that took effect.
#[derive(Clone, Debug, PartialEq)]
pub enum Changed {
    /// A setting of the model.
    Setting(SettingChange),
    /// A stored setting.
    Kept(KeptKey, KeptValue),
}

/// One entry of the journal of changes.
#[derive(Clone, Debug, PartialEq)]
pub struct JournalEntry {
    /// Version of the settings after this change.
    pub version: u64,
    /// Time and origin.
    pub asked: Asked,
    /// The change.
    pub changed: Changed,
}

/// Result of an accepted change.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SettingApplied {
    /// Settings after the change.
    pub settings: SonarSettings,
    /// Number of changes so far; 0 is the configuration.
    pub version: u64,
}

/// A refused change; the settings are unchanged.
#[derive(Clone, Copy, Debug, PartialEq, thiserror::Error)]
#[error("{key} = {value}: must be {rule}")]
pub struct SettingRefused {
    /// Configuration key of the setting.
    pub key: &'static str,
    /// Refused value.
    pub value: f64,
    /// Violated rule.
    pub rule: SettingRule,
}

/// Rule for the value of a setting.
#[derive(Clone, Copy, Debug, PartialEq, thiserror::Error)]
pub enum SettingRule {
    /// The value must be finite.
    #[error("a finite number")]
    Finite,
    /// The value must lie in an inclusive interval.
    #[error("from {min} to {max}")]
    Between {
        /// Minimum.
        min: f64,
        /// Maximum.
        max: f64,
    },
    /// The value must be zero or lie in an inclusive interval.
    #[error("0 or from {min} to {max}")]
    ZeroOrBetween {
        /// Minimum.
        min: f64,
        /// Maximum.
        max: f64,
    },
    /// Too many settings are stored.
    #[error("one of at most {most} settings that are only kept")]
    TooMany {
        /// Maximum number of stored settings.
        most: usize,
    },
}

/// Access of any protocol, page or command to the settings of one sonar.
pub trait SettingsPort: Send + Sync {
    /// Settings of the next ping.
    fn settings(&self) -> SonarSettings;
    /// Present trigger source.
    fn trigger(&self) -> TriggerSource;
    /// Limits of the settings.
    fn limits(&self) -> SettingLimits;
    /// Version of the settings; increases with every change, including stored settings.
    fn version(&self) -> u64;
    /// Applies a change, or refuses it with the violated rule.
    fn apply(&self, change: SettingChange, asked: Asked) -> Result<SettingApplied, SettingRefused>;
    /// Stores a setting that the model does not use; refused only if too many are stored.
    fn keep(&self, key: KeptKey, value: KeptValue, asked: Asked) -> Result<(), SettingRefused>;
    /// Value of a stored setting.
    fn kept(&self, key: KeptKey) -> Option<KeptValue>;
    /// Changes after `version`, oldest first; old entries may be dropped.
    fn changes_since(&self, version: u64) -> Vec<JournalEntry>;
}

/// The transmitted pulse: sqrt(2) Re{ a(t) exp(j 2pi f_c t) }, 0 <= t <= T.
/// LFM: a(t) = taper(t) exp(+-j pi (B/T) (t - T/2)^2), plus for an up sweep. CW: a(t) = taper(t).
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

    /// Lower bound of the rms of a pulse-length window relative to the rms of the overlapping echoes in it; one window in ten
    /// thousand is weaker. With many degrees of freedom (bandwidth times window) no window is much weaker than its echoes; with a
    /// pure tone some are.
    ///
    /// The energy of a window follows a gamma distribution, whose lower tail is a power law. Taper flanks reduce the degrees of
    /// freedom of a chirp to those of a rectangular pulse with the same ratio of mean to mean square: a squared raised cosine has
    /// mean 3/8, its fourth power 35/128.
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

/// Share of windows that may be weaker than [`Pulse::weakest_window`]: a ping has some thousands.
const WEAKEST_WINDOWS: f64 = 1e-4;

/// Weights of the samples next to the edges of an echo in a sum over echoes. An echo of a rectangular pulse starts and ends with
/// a step between two samples.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Edges {
    /// The value at the sample: the output of a receiver without a filter.
    #[default]
    Sampled,
    /// Samples next to a step are weighted with [`edge_corrections`]. A convolution sum over them converges to its integral with
    /// order five in the step, instead of order one.
    Weighted,
}

/// Number of samples that [`edge_corrections`] weights at each end of an echo.
pub const EDGE_POINTS: usize = 4;

/// Corrections to the weight 1 of the first samples inside an edge, outermost first. `inside` is the distance of the outermost
/// sample from the edge in steps, 0..1.
///
/// Exact for cubics. The weights are those of Gregory's formula for an edge on a sample (251, 897, 633, 739 over 720), plus the
/// integral of the cubic through the four samples between the edge and the outermost sample. With one sample instead of four, the
/// weight would be the covered part of its cell, `inside` + 1/2.
pub fn edge_corrections(inside: f64) -> [f64; EDGE_POINTS] {
    let x = inside;
    [
        x * (1.0 + x * (11.0 / 12.0 + x * (1.0 / 3.0 + x / 24.0))) - 469.0 / 720.0,
        177.0 / 720.0 - x * x * (1.5 + x * (5.0 / 6.0 + x / 8.0)),
        x * x * (0.75 + x * (2.0 / 3.0 + x / 8.0)) - 87.0 / 720.0,
        19.0 / 720.0 - x * x * (1.0 / 6.0 + x * (1.0 / 6.0 + x / 24.0)),
    ]
}

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

/// Position and orientation of an array in the body.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Mounting {
    /// Centre of the array, body axes, metres.
    pub position_m: DVec3,
    /// Rotation from array to body axes.
    pub body_from_array: DQuat,
}

/// Directional response of a transmitter or of one receive element, in array axes.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Pattern {
    /// 1 in every direction.
    Omnidirectional,
    /// A rectangular piston: sinc(L u_x/lambda) sinc(W u_y/lambda), with u the unit vector to the point in array axes. A side of
    /// 0 is omnidirectional.
    Rectangle {
        /// Length L along x, metres.
        length_m: f64,
        /// Width W along y, metres.
        width_m: f64,
        /// No response behind the face (u_z < 0).
        baffled: bool,
    },
    /// Mean of several equal elements along x, represented by one element at their centre. The walk applies the array factor of
    /// the elements, which depends on the direction of the echo. Levels and culling use one element.
    Part {
        /// Number of elements.
        elements: usize,
        /// Spacing of the elements along x, metres.
        spacing_m: f64,
        /// Length of an element along x, metres.
        length_m: f64,
        /// Width of an element along y, metres.
        width_m: f64,
        /// No response behind the face (u_z < 0).
        baffled: bool,
    },
}

/// One transmit array: a single coherent radiator.
#[derive(Clone, Debug, PartialEq)]
pub struct TransmitArray {
    /// Position and orientation in the body.
    pub mounting: Mounting,
    /// Directional response.
    pub pattern: Pattern,
    /// Offset to the source level of the settings, dB.
    pub level_offset_db: f64,
}

/// One receive array: a uniform line of equal elements along the array's x axis, centred on the mounting.
#[derive(Clone, Debug, PartialEq)]
pub struct ArrayGeometry {
    /// Position and orientation in the body.
    pub mounting: Mounting,
    /// Number of elements.
    pub elements: usize,
    /// Element spacing along x, metres.
    pub spacing_m: f64,
    /// Directional response of one element.
    pub element_pattern: Pattern,
    /// Receive sensitivity, dB re 1 V/uPa.
    pub sensitivity_db: f64,
    /// Index of the transmit array whose pulse this array receives.
    pub transmit: usize,
}

impl ArrayGeometry {
    /// Position of element `e` along the array's x axis, metres.
    pub fn element_x_m(&self, e: usize) -> f64 {
        (e as f64 - (self.elements as f64 - 1.0) / 2.0) * self.spacing_m
    }
    /// Position of element `e` in body axes, metres.
    pub fn element_body_m(&self, e: usize) -> DVec3 {
        self.mounting.position_m
            + self.mounting.body_from_array * DVec3::new(self.element_x_m(e), 0.0, 0.0)
    }
}

/// One segment of the polyline: constant velocity and attitude of the reference point from `start_s` on.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Segment {
    /// Start, seconds after the start of the pulse; 0 for the first segment.
    pub start_s: f64,
    /// Reference point at `start_s`, world, metres.
    pub position_m: DVec3,
    /// Velocity, world, metres per second.
    pub velocity_m_per_s: DVec3,
    /// Rotation from body to world axes.
    pub world_from_body: DQuat,
}

/// Model of the platform motion during the listening window.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum PathModel {
    /// The platform is at rest during the window.
    StopAndHop,
    /// The platform moves along the segments of the plan: constant velocity and attitude on each, with a step of the attitude
    /// between them.
    Polyline,
    /// Each element moves along its own chords between the vertices of the plan, without steps. Chords include the rotation of an
    /// element on a lever arm.
    KSegment,
    /// Exact position and attitude at the time of reception.
    Continuous,
}

/// Model of the Doppler effect on echoes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum DopplerModel {
    /// No Doppler effect.
    None,
    /// Each echo is stretched uniformly about its leading edge.
    Stretch,
    /// Each echo is stretched about the middle of the pulse, with the change of the stretch during the pulse.
    StretchQuadratic,
    /// Eq. 21 of Meng et al. 2023 as printed: delays stretched, pulse not. For comparison.
    PaperEq21,
}

/// Method that sums echoes to element samples.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Synthesis {
    /// Retarded time of every sample on the continuous trajectory: the slow reference solution.
    Reference,
    /// Linearised sum with the selected path and Doppler models.
    Direct,
    /// Eqs. 18 and 21 of Meng et al. 2023 on their frequency grid.
    Spectral,
    /// Replica of each echo, placed at the nearest sample.
    Nearest,
    /// Replica of each echo, interpolated linearly between samples.
    Linear,
    /// Echoes gridded and transformed per element, within a tolerance.
    Gridded1d,
    /// Echoes gridded over delay and slope and transformed for a whole line array, within a tolerance.
    Gridded2d,
}

/// Anti-aliasing filter of the receiver.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ReceiverFilter {
    /// No filter: the sum is sampled directly.
    None,
    /// Linear-phase low-pass filter before sampling, with its delay removed.
    Fir,
}

/// Selected models and method of a ping.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ModelChoice {
    /// Motion model.
    pub path: PathModel,
    /// Doppler model.
    pub doppler: DopplerModel,
    /// Synthesis method.
    pub synthesis: Synthesis,
    /// Maximum length of a polyline segment, seconds.
    pub segment_s: f64,
    /// Scatterers are culled if their two-way pattern (transmit times element, relative to boresight) is below this level, dB
    /// (negative). [`Scatterers::loud`] lowers the level of single scatterers. `None` keeps all.
    pub cull_db: Option<f64>,
}

impl PathModel {
    /// All models.
    pub const ALL: [Self; 4] = [
        Self::StopAndHop,
        Self::Polyline,
        Self::KSegment,
        Self::Continuous,
    ];
    /// Name in the configuration and in records.
    pub fn name(self) -> &'static str {
        match self {
            Self::StopAndHop => "stop-and-hop",
            Self::Polyline => "polyline",
            Self::KSegment => "k-segment",
            Self::Continuous => "continuous",
        }
    }
}

impl DopplerModel {
    /// All models.
    pub const ALL: [Self; 4] = [
        Self::None,
        Self::Stretch,
        Self::StretchQuadratic,
        Self::PaperEq21,
    ];
    /// Name in the configuration and in records.
    pub fn name(self) -> &'static str {
        match self {
            Self::None => "none",
            Self::Stretch => "stretch",
            Self::StretchQuadratic => "stretch-quadratic",
            Self::PaperEq21 => "paper-eq21",
        }
    }
    /// Whether the pulse is unchanged, so that one spectrum or replica serves every echo.
    pub fn keeps_pulse(self) -> bool {
        matches!(self, Self::None | Self::PaperEq21)
    }
}

impl Synthesis {
    /// All methods.
    pub const ALL: [Self; 7] = [
        Self::Reference,
        Self::Direct,
        Self::Spectral,
        Self::Nearest,
        Self::Linear,
        Self::Gridded1d,
        Self::Gridded2d,
    ];
    /// Name in the configuration and in records.
    pub fn name(self) -> &'static str {
        match self {
            Self::Reference => "reference",
            Self::Direct => "direct",
            Self::Spectral => "spectral",
            Self::Nearest => "nearest",
            Self::Linear => "linear",
            Self::Gridded1d => "gridded-1d",
            Self::Gridded2d => "gridded-2d",
        }
    }
    /// Whether all echoes share one pulse; such methods need a model that [`DopplerModel::keeps_pulse`].
    pub fn shares_pulse(self) -> bool {
        matches!(self, Self::Spectral | Self::Nearest | Self::Linear)
    }
    /// Whether the method is built for a tolerance and meets it.
    pub fn keeps_tolerance(self) -> bool {
        matches!(self, Self::Gridded1d | Self::Gridded2d)
    }
    /// Whether the method supports this Doppler model.
    pub fn takes(self, doppler: DopplerModel) -> bool {
        match self {
            Self::Reference | Self::Direct => true,
            Self::Spectral | Self::Nearest | Self::Linear => doppler.keeps_pulse(),
            Self::Gridded1d | Self::Gridded2d => doppler != DopplerModel::PaperEq21,
        }
    }
}

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
    /// The error model if its error is within `tolerance`.
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

/// A method whose error exceeds the tolerance.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[error("{name} is off by {error:.1e} here, and {tolerance:.1e} is asked: {why}")]
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

/// Parameters of the error and cost models; the maxima over a ping or a run.
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
    /// Tolerance for methods that meet one.
    pub tolerance: f64,
    /// Statistics of the received echoes; `None` if echoes may come from any direction.
    pub heard: Option<Heard>,
}

/// Energy-weighted motion of the received echoes. Values are root mean squares over the echoes of a pulse-length window, for the
/// worst window of a ping. They are relative to that window or to the whole ping, whichever is louder.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Heard {
    /// Displacement of an element along the ray between pulse and echo, metres.
    pub hop_m: f64,
    /// Closing speed along the ray, mean of transmitter and element, metres per second. A window may hold only the end of a
    /// pulse, where the Doppler phase is largest. This value is scaled so that its root mean square represents a whole pulse and
    /// exceeds [`Self::closing_of_echoes_m_per_s`] accordingly.
    pub closing_m_per_s: f64,
    /// Closing speed of whole echoes, metres per second.
    pub closing_of_echoes_m_per_s: f64,
    /// Second derivative of the range, mean of both legs, metres per second squared.
    pub bend_m_per_s2: f64,
    /// Acceleration of an element along the ray, metres per second squared.
    pub acceleration_m_per_s2: f64,
    /// Speed of an element on its lever arm from the rotation of the platform, along the ray, metres per second.
    pub turning_m_per_s: f64,
    /// Component along the ray of the motion of an element across its array, metres per second.
    pub across_m_per_s: f64,
    /// Ratio of the summed error of echoes with random phases in the worst window of any element to its root mean square, with an
    /// allowance for the sampling of echoes.
    pub spread: f64,
    /// Maximum share of the loudest echo in the energy of a window.
    pub loudest: f64,
    /// Number of echoes of all elements.
    pub echoes: f64,
}

impl Conditions {
    /// Relative error from a phase error of `phase_rad` (rms); at most 2, that of a reversed echo.
    pub fn error_of_phase(phase_rad: f64) -> f64 {
        phase_rad.min(2.0)
    }

    /// Wavenumber at the highest frequency of the sweep, radians per metre.
    pub fn wavenumber_per_m(&self) -> f64 {
        let highest_hz = self.pulse.center_frequency_hz + 0.5 * self.pulse.bandwidth_hz;
        std::f64::consts::TAU * highest_hz / self.sound_speed_m_per_s
    }
}

/// Time-varying gain over slant range r, metres.
#[derive(Clone, Debug, PartialEq)]
pub enum TimeVaryingGain {
    /// No gain.
    None,
    /// spreading log10(r) + 2 absorption r, limited to 0..=max.
    Law {
        /// Spreading coefficient: 20, 30 or 40.
        spreading: f64,
        /// One-way absorption, dB per metre.
        absorption_db_per_m: f64,
        /// Maximum gain, dB.
        max_db: f64,
    },
    /// Points of range (metres) and gain (dB): linear between them, constant outside.
    Table(Vec<(f64, f64)>),
}

/// Receiver chain after the elements.
#[derive(Clone, Debug, PartialEq)]
pub struct Receiver {
    /// Sample rate, hertz.
    pub sample_rate_hz: f64,
    /// Anti-aliasing filter.
    pub filter: ReceiverFilter,
    /// Time-varying gain.
    pub tvg: TimeVaryingGain,
    /// Noise at the element, dB re 1 uPa^2/Hz; `None` is noiseless.
    pub noise_db: Option<f64>,
    /// Resolution of the converter, bits; `None` does not quantise.
    pub adc_bits: Option<u32>,
    /// Full scale of the converter and of integer records, volts (rms of the envelope).
    pub full_scale_v: f64,
    /// Seed of the noise.
    pub seed: u64,
}

/// Complete description of one ping of one sonar; later stages need nothing else.
#[derive(Clone, Debug)]
pub struct PingPlan {
    /// Index of the sonar.
    pub sonar: usize,
    /// Sequential number, from 1; a skipped ping keeps its number.
    pub ping_number: u32,
    /// Start of the pulse, rig time.
    pub transmit_utc: UtcNs,
    /// Time stamp of the records (`nav.stamp`).
    pub stamp_utc: UtcNs,
    /// Time since the previous transmitted ping, seconds; 0 for the first.
    pub ping_period_s: f64,
    /// Settings of this ping.
    pub settings: SonarSettings,
    /// Actual ping rate, hertz; below the maximum if the range requires it.
    pub ping_rate_hz: f64,
    /// Transmitted pulse.
    pub pulse: Pulse,
    /// Sound speed, metres per second.
    pub sound_speed_m_per_s: f64,
    /// One-way absorption, dB per metre.
    pub absorption_db_per_m: f64,
    /// Samples per element; sample k lies at `first_sample_s + k / receiver.sample_rate_hz`.
    pub sample_count: usize,
    /// Time of sample 0, seconds.
    pub first_sample_s: f64,
    /// Selected models and method.
    pub model: ModelChoice,
    /// State of the platform for output records.
    pub nav: NavState,
    /// Motion of the platform over the listening window.
    pub trajectory: Trajectory,
    /// Polyline over the listening window; at least one segment.
    pub segments: Vec<Segment>,
}

impl PingPlan {
    /// Length of the listening window, seconds.
    pub fn window_s(&self, sample_rate_hz: f64) -> f64 {
        self.first_sample_s + self.sample_count as f64 / sample_rate_hz
    }
}

// ---------------------------------------------------------------- the scene

/// Dependence of a scatterer's pressure on the angles between its normal and the two rays. Scatterers do not radiate behind their
/// normal.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ScatterLaw {
    /// Independent of direction.
    Point,
    /// Factor sqrt(cos i cos s) (bistatic Lambert).
    Lambert,
    /// Factor cos i of the incident ray, independent of the receiver (Meng et al. 2023, Eq. 13).
    LambertOneWay,
    /// Product of [`LawCurve::half`] for both rays, with the curve of the scatterers.
    Curve,
}

/// Backscattering strength over the angle of incidence, tabulated as the pressure factor of one leg; the factors of both legs
/// multiply.
#[derive(Clone, Debug, PartialEq)]
pub struct LawCurve {
    /// Fourth roots of the strength at even steps of the square root of the cosine, from grazing to normal incidence.
    half: Box<[f64; Self::STEPS + 1]>,
}

impl LawCurve {
    /// Number of steps: a Gaussian lobe 3 degrees wide is accurate to 0.01 dB, and the table of 32 KiB fits the L1 cache.
    const STEPS: usize = 4096;

    /// Curve of `strength`: backscattered power per square metre of seabed, as a function of the cosine of incidence (0 to 1).
    pub fn new(strength: impl Fn(f64) -> f64) -> Self {
        let mut half = Box::new([0.0; Self::STEPS + 1]);
        for (k, half) in half.iter_mut().enumerate() {
            let root = k as f64 / Self::STEPS as f64;
            *half = strength(root * root).max(0.0).sqrt().sqrt();
        }
        Self { half }
    }

    /// Pressure factor of one leg, interpolated linearly. `root` is the square root of the cosine of incidence, 0 to 1.
    #[inline(always)]
    pub fn half(&self, root: f64) -> f64 {
        let x = root * Self::STEPS as f64;
        let k = (x as usize).min(Self::STEPS - 1);
        self.half[k] + (x - k as f64) * (self.half[k + 1] - self.half[k])
    }
}

/// Point scatterers as a structure of arrays of equal length.
#[derive(Clone, Debug, Default)]
pub struct Scatterers {
    /// World north, metres.
    pub north_m: Vec<f64>,
    /// World east, metres.
    pub east_m: Vec<f64>,
    /// World down, metres.
    pub down_m: Vec<f64>,
    /// Outward unit normal, world axes; unused for points.
    pub normal: Vec<[f32; 3]>,
    /// Echo pressure at 1 m for unit incident pressure. For a seabed patch it is sqrt(mu area) times a fixed complex
    /// reflectivity.
    pub strength: Vec<Complex64>,
    /// Directional law.
    pub law: Vec<ScatterLaw>,
    /// Factor, 1 or more, by which the pattern floor ([`ModelChoice::cull_db`]) is lower for a scatterer louder than the ground.
    pub loud: Vec<f32>,
    /// Curve of scatterers with [`ScatterLaw::Curve`]; without it they are silent.
    pub curve: Option<Arc<LawCurve>>,
}

impl Scatterers {
    /// Number of scatterers.
    pub fn len(&self) -> usize {
        self.north_m.len()
    }
    /// Whether there are none.
    pub fn is_empty(&self) -> bool {
        self.north_m.is_empty()
    }
    /// Removes all scatterers.
    pub fn clear(&mut self) {
        self.truncate(0);
    }
    /// Removes all but the first `len` scatterers.
    pub fn truncate(&mut self, len: usize) {
        self.north_m.truncate(len);
        self.east_m.truncate(len);
        self.down_m.truncate(len);
        self.normal.truncate(len);
        self.strength.truncate(len);
        self.law.truncate(len);
        self.loud.truncate(len);
    }
    /// Copies scatterer `from` over scatterer `to`.
    pub fn copy_within(&mut self, from: usize, to: usize) {
        self.north_m[to] = self.north_m[from];
        self.east_m[to] = self.east_m[from];
        self.down_m[to] = self.down_m[from];
        self.normal[to] = self.normal[from];
        self.strength[to] = self.strength[from];
        self.law[to] = self.law[from];
        self.loud[to] = self.loud[from];
    }
    /// Changes the number of scatterers; new ones have zero strength.
    pub fn resize(&mut self, len: usize) {
        self.north_m.resize(len, 0.0);
        self.east_m.resize(len, 0.0);
        self.down_m.resize(len, 0.0);
        self.normal.resize(len, [0.0; 3]);
        self.strength.resize(len, Complex64::ZERO);
        self.law.resize(len, ScatterLaw::Point);
        self.loud.resize(len, 1.0);
    }
    /// Appends a scatterer: position in world metres, outward unit normal, strength and law.
    pub fn push(
        &mut self,
        position_m: DVec3,
        normal: [f32; 3],
        strength: Complex64,
        law: ScatterLaw,
    ) {
        self.north_m.push(position_m.x);
        self.east_m.push(position_m.y);
        self.down_m.push(position_m.z);
        self.normal.push(normal);
        self.strength.push(strength);
        self.law.push(law);
        self.loud.push(1.0);
    }
    /// Position of scatterer `i`, world, metres.
    pub fn position_m(&self, i: usize) -> DVec3 {
        DVec3::new(self.north_m[i], self.east_m[i], self.down_m[i])
    }
}

/// Region of the scene that a pair of transmitter and receive array can receive: a sphere, without directions in which the
/// two-way pattern is below the floor, and without the region behind a baffle. A footprint with a non-finite value is empty.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Footprint {
    /// Transmitter, world, metres.
    pub apex_m: DVec3,
    /// Centre of the receive array, world, metres.
    pub receiver_m: DVec3,
    /// Radius of the sphere around the apex, metres.
    pub max_range_m: f64,
    /// Bounds of the pattern: length and width of transmitter and element.
    pub sides: [PatternSide; Self::SIDES],
    /// Ratio of the maximum of the product of the sides to its floor; infinite keeps all directions.
    pub depth: f64,
    /// Faces of transmitter and element.
    pub faces: [BaffledFace; 2],
}

/// Bound on the pattern of one side of a rectangular radiator: it stays below 1 / (u / knee), with u the sine of the angle from
/// broadside.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PatternSide {
    /// Direction of the side, world, unit vector.
    pub axis: DVec3,
    /// Sine from which the bound is less than 1: lambda / (pi L); infinite for a side without length.
    pub knee: f64,
    /// Error of the sine from the rotation of the platform.
    pub turn: f64,
    /// Error of the sine times range from the distance of the radiator to the apex, metres.
    pub shift_m: f64,
}

/// A face without response behind it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct BaffledFace {
    /// Outward unit normal, world axes; zero for an open face.
    pub normal: DVec3,
    /// Error of the sine from the rotation of the platform, as in [`PatternSide`].
    pub turn: f64,
    /// Error from the distance of the face to the apex, metres, as in [`PatternSide`].
    pub shift_m: f64,
}

impl PatternSide {
    /// Side without a bound.
    pub const OPEN: Self = Self {
        axis: DVec3::X,
        knee: f64::INFINITY,
        turn: 0.0,
        shift_m: 0.0,
    };

    /// Factor by which the pattern is at least below 1 for a point at `range_m` whose component along the axis is `along_m`.
    #[inline(always)]
    pub fn below(&self, along_m: f64, range_m: f64) -> f64 {
        let sine = (along_m.abs() - self.shift_m) / range_m - self.turn;
        (sine / self.knee).max(1.0)
    }
}

impl BaffledFace {
    /// Face without a baffle.
    pub const OPEN: Self = Self {
        normal: DVec3::ZERO,
        turn: 0.0,
        shift_m: 0.0,
    };

    /// Whether a point at `range_m`, `ahead_m` along the normal, may be in front of the face.
    #[inline(always)]
    pub fn may_face(&self, ahead_m: f64, range_m: f64) -> bool {
        ahead_m >= -(self.turn * range_m + self.shift_m)
    }
}

impl Footprint {
    /// Length and width of transmitter and element.
    pub(crate) const SIDES: usize = 4;

    /// All directions within range of a point (world, metres).
    pub fn all_round(apex_m: DVec3, max_range_m: f64) -> Self {
        Self {
            apex_m,
            receiver_m: apex_m,
            max_range_m,
            sides: [PatternSide::OPEN; Self::SIDES],
            depth: f64::INFINITY,
            faces: [BaffledFace::OPEN; 2],
        }
    }

    /// Directions u within range with |u . axis| at most `max_sine`.
    pub fn fan(apex_m: DVec3, max_range_m: f64, axis: DVec3, max_sine: f64) -> Self {
        let mut footprint = Self::all_round(apex_m, max_range_m);
        footprint.sides[0] = PatternSide {
            axis,
            knee: max_sine,
            ..PatternSide::OPEN
        };
        footprint.depth = 1.0;
        footprint
    }

    /// Whether a position (world, metres) is inside.
    pub fn contains(&self, position_m: DVec3) -> bool {
        let d = position_m - self.apex_m;
        let range_squared = d.length_squared();
        if range_squared > self.max_range_m * self.max_range_m {
            return false;
        }
        let range_m = range_squared.sqrt();
        self.faces
            .iter()
            .all(|face| face.may_face(d.dot(face.normal), range_m))
            && (self.depth == f64::INFINITY
                || self
                    .sides
                    .iter()
                    .map(|side| side.below(d.dot(side.axis), range_m))
                    .product::<f64>()
                    <= self.depth)
    }

    /// Whether all values are finite and valid.
    pub fn is_finite(&self) -> bool {
        self.apex_m.is_finite()
            && self.receiver_m.is_finite()
            && self.max_range_m >= 0.0
            && self.max_range_m.is_finite()
            && self.depth >= 0.0
            && self
                .sides
                .iter()
                .all(|s| s.axis.is_finite() && s.knee >= 0.0 && s.turn >= 0.0 && s.shift_m >= 0.0)
            && self
                .faces
                .iter()
                .all(|f| f.normal.is_finite() && f.turn >= 0.0 && f.shift_m >= 0.0)
    }
}

/// Counts of one collection of scatterers.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct SceneCounts {
    /// Tiles in reach of a footprint.
    pub tiles_used: u64,
    /// Of those: tiles that had to be generated.
    pub tiles_made: u64,
    /// Seabed regions (one or more tiles) that are out of reach or empty.
    pub culled_tiles: u64,
    /// Seabed scatterers in generated tiles.
    pub made: u64,
    /// Scatterers of tiles in reach that are outside every footprint.
    pub culled: u64,
    /// Scatterers in shadow, including explicit points and scatterers of targets.
    pub shadowed: u64,
    /// Scatterers passed on, including explicit points and scatterers of targets.
    pub scatterers: u64,
    /// Explicit points passed on.
    pub points: u64,
    /// Targets passed on.
    pub targets: u64,
}

/// A named strong target, for the truth file.
#[derive(Clone, Debug, PartialEq)]
pub struct Target {
    /// Name in the scene.
    pub name: String,
    /// World, metres.
    pub position_m: DVec3,
    /// Target strength, dB.
    pub target_strength_db: f64,
}

// ---------------------------------------------------------------- echoes

/// Maximum number of scatterers in one chunk.
pub const CHUNK: usize = 256;

/// Echoes of up to [`CHUNK`] scatterers at one element, structure of arrays, small enough for L1.
pub struct ArrivalChunk {
    /// Number of echoes.
    pub len: usize,
    /// Index of the element.
    pub element: usize,
    /// Leading edge after the start of the pulse, seconds.
    pub delay_s: [f64; CHUNK],
    /// eta = dt'/dt - 1: Doppler stretch minus one, which keeps the precision of small values.
    pub doppler: [f64; CHUNK],
    /// Half of d2t'/dt2, per second. The sound at s seconds after the leading edge left at (1 + doppler) s + curvature s^2. Zero
    /// except with [`DopplerModel::StretchQuadratic`].
    pub curvature_per_s: [f64; CHUNK],
    /// Complex amplitude A_{m,e} at the element without carrier phase: uPa (rms), and volts after the sensitivity.
    pub amplitude: [Complex64; CHUNK],
}

impl ArrivalChunk {
    /// Empty chunk.
    pub fn new() -> Self {
        Self {
            len: 0,
            element: 0,
            delay_s: [0.0; CHUNK],
            doppler: [0.0; CHUNK],
            curvature_per_s: [0.0; CHUNK],
            amplitude: [Complex64::ZERO; CHUNK],
        }
    }
}

impl Default for ArrivalChunk {
    fn default() -> Self {
        Self::new()
    }
}

/// Consumer of echoes at elements.
pub trait ArrivalSink {
    /// Adds the echoes of a chunk.
    fn accept(&mut self, chunk: &ArrivalChunk);
}

/// Echoes of up to [`CHUNK`] scatterers at one point of a line array, and how each changes along the line and during the pulse.
///
/// With u(y, w) the delay, at y metres along the line from the point, of what left w seconds into the pulse (leading edge: 0, 0).
pub struct LineChunk {
    /// Number of echoes.
    pub len: usize,
    /// As in [`ArrivalChunk`].
    pub delay_s: [f64; CHUNK],
    /// As in [`ArrivalChunk`].
    pub doppler: [f64; CHUNK],
    /// As in [`ArrivalChunk`].
    pub amplitude: [Complex64; CHUNK],
    /// -c du/dy: sine of the angle from broadside, as the moving line receives it.
    pub slope: [f64; CHUNK],
    /// c d2u/dy2.
    pub bend_per_m: [f64; CHUNK],
    /// c d2u/dy dw.
    pub twist_per_s: [f64; CHUNK],
    /// c d2u/dw2: the part that the linear stretch omits.
    pub swing_m_per_s2: [f64; CHUNK],
    /// First-order variation of the amplitude along the stretch: `amplitude` times 1 + fade y + curl y^2 at y metres from the
    /// middle, exact at both ends. Zero if not requested.
    pub fade_per_m: [f64; CHUNK],
    /// Second-order variation of the amplitude along the stretch, as in `fade_per_m`.
    pub curl_per_m2: [f64; CHUNK],
}

impl LineChunk {
    /// Empty chunk.
    pub fn new() -> Self {
        let zero = [0.0; CHUNK];
        Self {
            len: 0,
            delay_s: zero,
            doppler: zero,
            amplitude: [Complex64::ZERO; CHUNK],
            slope: zero,
            bend_per_m: zero,
            twist_per_s: zero,
            swing_m_per_s2: zero,
            fade_per_m: zero,
            curl_per_m2: zero,
        }
    }

    /// Copies slope, bend, twist, swing, fade and curl of echo `from` to echo `to`.
    pub fn move_derivatives(&mut self, from: usize, to: usize) {
        self.slope[to] = self.slope[from];
        self.bend_per_m[to] = self.bend_per_m[from];
        self.twist_per_s[to] = self.twist_per_s[from];
        self.swing_m_per_s2[to] = self.swing_m_per_s2[from];
        self.fade_per_m[to] = self.fade_per_m[from];
        self.curl_per_m2[to] = self.curl_per_m2[from];
    }
}

impl Default for LineChunk {
    fn default() -> Self {
        Self::new()
    }
}

/// Consumer of echoes at stretches of a line array.
pub trait LineSink {
    /// Adds the echoes of a chunk.
    fn accept(&mut self, chunk: &LineChunk);
}

/// A stretch of a line array around its middle, and the requested interval of leading edges.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct LineStretch {
    /// Middle of the stretch relative to the centre of the array, metres.
    pub middle_m: f64,
    /// Distance from the middle to the outermost elements, metres.
    pub half_m: f64,
    /// Fade and curl are requested.
    pub fades: bool,
    /// Number of elements, for the counts.
    pub elements: u64,
    /// First requested leading edge, inclusive, seconds.
    pub earliest_s: f64,
    /// Last requested leading edge, exclusive, seconds.
    pub latest_s: f64,
}

/// Source of the echoes of one ping at one line array; threads use it concurrently.
pub trait LineSource: Sync {
    /// Number of candidate scatterers.
    fn scatterers(&self) -> u64;

    /// Lower bound of all leading edges anywhere on the line, seconds; infinite without echoes.
    fn earliest_s(&self) -> f64;

    /// Emits points of amplitude 0 that bound nearly all echoes of [`Self::walk`], and a sample of its echoes with fade and curl.
    fn survey(&self, stretch: LineStretch, sink: &mut impl LineSink);

    /// Emits the echoes at the middle of a stretch in a fixed order, in chunks of at most [`CHUNK`]. Counts are of
    /// scatterer-element pairs. An echo outside the requested delays is not counted, because another stretch requests it.
    fn walk(&self, stretch: LineStretch, sink: &mut impl LineSink) -> EchoCounts;
}

/// Counts of one walk over the scatterers.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct EchoCounts {
    /// Scatterer-element pairs passed on.
    pub used: u64,
    /// Culled by the patterns ([`ModelChoice::cull_db`]).
    pub culled: u64,
    /// Outside the listening window.
    pub outside_window: u64,
    /// Closer than a wavelength, where the far-field amplitude is invalid; clamped at one wavelength.
    pub too_close: u64,
    /// Polyline: in the gap of an element's step at a vertex; placed at the vertex time.
    pub no_root: u64,
    /// Polyline: two segments have a root; the first is used.
    pub two_roots: u64,
    /// After the last segment of the polyline; extrapolated along it.
    pub beyond_track: u64,
    /// Beyond the range of the engine. `gridded-1d`: clamped at its maximum Doppler. `gridded-2d`: all echoes of a ping that is
    /// nearer or faster than its tolerance allows.
    pub beyond_engine: u64,
}

impl std::ops::AddAssign for EchoCounts {
    fn add_assign(&mut self, o: Self) {
        self.used += o.used;
        self.culled += o.culled;
        self.outside_window += o.outside_window;
        self.too_close += o.too_close;
        self.no_root += o.no_root;
        self.two_roots += o.two_roots;
        self.beyond_track += o.beyond_track;
        self.beyond_engine += o.beyond_engine;
    }
}

/// Samples of all elements of one receive array: volts (rms) of the complex envelope about the centre frequency.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct ElementFrame {
    /// Index of the receive array.
    pub array: usize,
    /// Number of elements.
    pub elements: usize,
    /// Samples per element.
    pub samples: usize,
    /// Element-major samples: `iq[e * samples + k]`.
    pub iq: Vec<Complex64>,
    /// Number of values clipped by the converter in this ping.
    pub saturated: u64,
}

impl ElementFrame {
    /// Samples of element `e`.
    pub fn element(&self, e: usize) -> &[Complex64] {
        &self.iq[e * self.samples..(e + 1) * self.samples]
    }
    /// Mutable samples of element `e`.
    pub fn element_mut(&mut self, e: usize) -> &mut [Complex64] {
        &mut self.iq[e * self.samples..(e + 1) * self.samples]
    }
}

/// Beams of one fan after the matched filter; sample k of a beam is a leading edge at `first_sample_s + k / sample_rate`.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct BeamFrame {
    /// Number of beams.
    pub beams: usize,
    /// Samples per beam.
    pub samples: usize,
    /// Angles from the boresight, positive to starboard, radians; beam 0 is the most port.
    pub angle_rad: Vec<f64>,
    /// -3 dB width of each beam across track, radians.
    pub width_rad: Vec<f64>,
    /// Beam-major samples: `iq[b * samples + k]`.
    pub iq: Vec<Complex64>,
}

impl BeamFrame {
    /// Samples of beam `b`.
    pub fn beam(&self, b: usize) -> &[Complex64] {
        &self.iq[b * self.samples..(b + 1) * self.samples]
    }
}

/// Bottom detection of one beam.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Sounding {
    /// Index of the beam.
    pub beam: usize,
    /// Angle as in [`BeamFrame::angle_rad`].
    pub angle_rad: f64,
    /// Two-way travel time at the centre of the array, from the start of the pulse, seconds.
    pub twtt_s: f64,
    /// Predicted standard deviation of the travel time, seconds.
    pub error_s: f64,
    /// Detection method.
    pub detection: Detection,
    /// Echo level, volts (rms).
    pub level_v: f64,
}

/// Method of a bottom detection.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Detection {
    /// Amplitude of the beam.
    Amplitude,
    /// Phase difference of two subarrays.
    Phase,
}

/// Side of a side-scan line.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub enum Side {
    /// Left of the platform.
    Port,
    /// Right of the platform.
    Starboard,
}

/// One side-scan line: envelope over slant range, sample 0 at the start of the pulse.
#[derive(Clone, Debug, PartialEq)]
pub struct Line {
    /// Side of the platform.
    pub side: Side,
    /// Envelope, volts (rms).
    pub amplitude: Vec<f32>,
}

/// Side-scan lines of one further pulse of a ping.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct PulseLines {
    /// Delay of the pulse after the first pulse, seconds. Its lines start at its own start.
    pub delay_s: f64,
    /// Lines of this pulse.
    pub lines: Vec<Line>,
}

/// Ground truth of each sample of a side-scan line or of a beam: labels for machine learning. Not computed on the ping path.
#[derive(Clone, Debug, PartialEq)]
pub struct LineTruth {
    /// Side of the platform.
    pub side: Side,
    /// Target with the strongest echo in each sample: 1 is the first of the scene, 0 is none.
    pub target: Vec<u16>,
    /// Echo energy of that target, arbitrary unit.
    pub target_energy: Vec<f32>,
    /// Energy of all other echoes, same unit.
    pub other_energy: Vec<f32>,
    /// Visibility of the seabed.
    pub ground: Vec<GroundSeen>,
    /// Depth of the seabed, world, metres; NaN without seabed.
    pub down_m: Vec<f32>,
}

impl LineTruth {
    /// Adds echo energy of target `label` to sample `k`, which gets the label of its strongest target.
    pub fn claim(&mut self, k: usize, label: u16, energy: f32) {
        if energy > self.target_energy[k] {
            self.other_energy[k] += self.target_energy[k];
            (self.target[k], self.target_energy[k]) = (label, energy);
        } else {
            self.other_energy[k] += energy;
        }
    }
}

/// Visibility of the seabed on the beam axis at the range of a sample.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum GroundSeen {
    /// No seabed: water, a hole or the edge of the scene.
    #[default]
    None,
    /// Insonified seabed.
    Seen,
    /// Seabed entirely in shadow.
    Hidden,
}

/// Error of element samples against the reference solution, at random samples before noise, gain and converter. It is the rms of
/// the differences, each relative to the rms of the surrounding samples or of the whole ping of the element, whichever is larger.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ErrorCheck {
    /// Number of compared samples.
    pub samples: u32,
    /// Relative error.
    pub error: f64,
    /// Lower end of the 95 % confidence interval.
    pub low: f64,
    /// Upper end of the 95 % confidence interval.
    pub high: f64,
    /// `sonar.model.tolerance`.
    pub tolerance: f64,
    /// The error exceeds 1.3 tolerances on the last two pings with compared samples.
    pub fault: bool,
}

/// Results of one ping.
#[derive(Clone, Debug, Default)]
pub struct PingOutput {
    /// Error check over the newest compared samples; `None` if disabled or with too few samples.
    pub error_check: Option<ErrorCheck>,
    /// Element samples, one frame per receive array.
    pub elements: Vec<ElementFrame>,
    /// Beams, one frame per configured fan (at most one).
    pub beams: Vec<BeamFrame>,
    /// Bottom detections of the fan; none for beams without a bottom.
    pub soundings: Vec<Sounding>,
    /// Side-scan lines.
    pub lines: Vec<Line>,
    /// Side-scan lines of the further pulses, one each.
    pub more_lines: Vec<PulseLines>,
    /// Counts of the echoes.
    pub counts: EchoCounts,
    /// Counts of the scatterers.
    pub scene: SceneCounts,
    /// Selected methods, if method selection ran.
    pub methods: Option<MethodMark>,
    /// Effects of overload on this ping.
    pub overload_state: OverloadState,
}

/// Effects of overload on a ping; they depend on the machine.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct OverloadState {
    /// Tolerance used instead of the configured one.
    pub tolerance: Option<f64>,
    /// Delay of the pulse after its scheduled time, seconds.
    pub put_off_s: f64,
}

impl OverloadState {
    /// No effects.
    pub const NONE: Self = Self {
        tolerance: None,
        put_off_s: 0.0,
    };
}

/// Method selection of a ping and its prediction.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct MethodMark {
    /// Sequence number of the selection; the configuration is 0.
    pub plan: u32,
    /// Predicted relative error of element samples.
    pub predicted_error: f64,
    /// Predicted core time, milliseconds.
    pub predicted_ms: f64,
    /// Tolerance of the selection.
    pub tolerance: f64,
    /// Elements combined to one ([`Pattern::Part`]); 1 without combination.
    pub part_elements: usize,
}

// ---------------------------------------------------------------- out

/// One complete protocol record, ready for framing.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Datagram {
    /// Record number in the protocol (7038, 7018, ...).
    pub record_type: u32,
    /// Bytes of the record.
    pub bytes: Vec<u8>,
}

/// Test data for any crate.
#[doc(hidden)]
pub mod testing {
    use super::*;

    /// Plan of a ping of a platform at rest at the origin.
    pub fn plan_at_rest(pulse: &Pulse, sample_count: usize, sound_speed_m_per_s: f64) -> PingPlan {
        let trajectory = Trajectory::uniform(DVec3::ZERO, DVec3::ZERO, glam::DQuat::IDENTITY);
        PingPlan {
            sonar: 0,
            ping_number: 1,
            transmit_utc: UtcNs(0),
            stamp_utc: UtcNs(0),
            ping_period_s: 0.0,
            settings: SonarSettings {
                pinging: true,
                range_m: 10.0,
                max_ping_rate_hz: 1.0,
                source_level_db: 220.0,
                gain_db: 0.0,
                pulse_duration_s: pulse.duration_s,
            },
            ping_rate_hz: 1.0,
            pulse: *pulse,
            sound_speed_m_per_s,
            absorption_db_per_m: 0.0,
            sample_count,
            first_sample_s: 0.0,
            model: ModelChoice {
                path: PathModel::Polyline,
                doppler: DopplerModel::Stretch,
                synthesis: Synthesis::Direct,
                segment_s: 1.0,
                cull_db: None,
            },
            nav: NavState {
                utc: UtcNs(0),
                pose: trajectory.pose_at(0.0),
                roll_rad: 0.0,
                pitch_rad: 0.0,
                heading_rad: 0.0,
                heave_down_m: 0.0,
                latitude_rad: 0.0,
                longitude_rad: 0.0,
                height_m: 0.0,
                fix: FixQuality::None,
                position_age_s: 0.0,
                attitude_age_s: 0.0,
                extrapolated: false,
                invalid: Default::default(),
            },
            trajectory,
            segments: Vec::new(),
        }
    }
}

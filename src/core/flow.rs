//! The nouns that travel through the house, as plain data, and the one seam between stages, [`ArrivalSink`].
//!
//! ```text
//! io::nav -> nav -> ping -> scene -> echo -> array -> beam -> image -> emit -> io
//!     NavSample PingPlan Scatterers ArrivalChunk ElementFrame BeamFrame Line  Datagram
//! ```
//!
//! Inside: SI, radians, north-east-down, f64. Degrees, kHz and dB live in the configuration and on the wire.
//! The starting point of "the start of the pulse" is `PingPlan::transmit_utc`; every `_s` inside a ping counts from there.

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
    /// Which configured source said it (index into `NavSpec::sources`).
    pub source: u16,
    /// When it holds (rig time).
    pub valid_utc: UtcNs,
    /// When its first byte arrived (rig time; for a recorded log the recorder's stamp).
    pub arrival_utc: UtcNs,
    pub quantity: NavQuantity,
}

/// What was measured. Angles in radians, roll starboard down, pitch bow up, heading clockwise from true north, heave down.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum NavQuantity {
    /// Antenna position on WGS84. `height_m` is above the source's own zero (mean sea level for GGA); none when not given.
    Position {
        latitude_rad: f64,
        longitude_rad: f64,
        height_m: Option<f64>,
        fix: FixQuality,
    },
    /// Position already in world coordinates (a CSV track).
    LocalPosition {
        north_m: f64,
        east_m: f64,
        down_m: f64,
    },
    /// Over ground.
    CourseSpeed {
        course_rad: f64,
        speed_m_per_s: f64,
    },
    Heading {
        heading_rad: f64,
    },
    RollPitch {
        roll_rad: f64,
        pitch_rad: f64,
    },
    Heave {
        heave_down_m: f64,
    },
    /// Of the platform's depth sensor, below the surface.
    Depth {
        depth_m: f64,
    },
}

#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum FixQuality {
    #[default]
    None,
    Autonomous,
    Differential,
    RtkFixed,
    RtkFloat,
    DeadReckoning,
}

/// The platform at one instant, as the wire wants it (the model uses `PingPlan::trajectory`).
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct NavState {
    pub utc: UtcNs,
    pub pose: Pose,
    pub roll_rad: f64,
    pub pitch_rad: f64,
    pub heading_rad: f64,
    pub heave_down_m: f64,
    /// Of the reference point, WGS84.
    pub latitude_rad: f64,
    pub longitude_rad: f64,
    /// Up, metres: minus the world's down.
    pub height_m: f64,
    pub fix: FixQuality,
    /// Age of the newest position and attitude behind this state, seconds; negative where a later sample is known (interpolated).
    pub position_age_s: f64,
    pub attitude_age_s: f64,
    /// Some quantity had to be extrapolated.
    pub extrapolated: bool,
    /// What must not be relied on.
    pub invalid: NavInvalid,
}

/// Quantities older than they may be: the last known value stands in their place.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct NavInvalid {
    pub position: bool,
    pub heading: bool,
    pub roll_pitch: bool,
    /// Heave or depth, where it is used.
    pub vertical: bool,
}

impl NavInvalid {
    pub fn any(&self) -> bool {
        self.position || self.heading || self.roll_pitch || self.vertical
    }
}

// ---------------------------------------------------------------- the ping

/// What an operator, or a topside over its protocol, can change while the sonar runs. Changed only through `run::settings`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SonarSettings {
    pub pinging: bool,
    pub range_m: f64,
    /// 0 only while `pinging` is false.
    pub max_ping_rate_hz: f64,
    /// dB re 1 uPa at 1 m.
    pub source_level_db: f64,
    pub gain_db: f64,
    pub pulse_duration_s: f64,
}

/// The ranges settings may move in, inclusive; buffers are sized from the maxima.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SettingLimits {
    pub range_m: (f64, f64),
    pub ping_rate_hz: (f64, f64),
    pub source_level_db: (f64, f64),
    pub gain_db: (f64, f64),
    pub pulse_duration_s: (f64, f64),
}

/// What starts a ping.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum TriggerSource {
    /// The sonar's own beat.
    #[default]
    Internal,
    /// Somebody else's pulse: the sonar itself starts none but those asked for by number.
    External,
}

/// One change of the settings, as an operator or a topside asks for it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum SettingChange {
    RangeM(f64),
    /// 0 holds the sonar: it keeps what it is told and pings again when the rate is above 0.
    MaxPingRateHz(f64),
    /// dB re 1 uPa at 1 m.
    SourceLevelDb(f64),
    GainDb(f64),
    PulseDurationS(f64),
    Start,
    Stop,
    /// So many pings from now on, on the sonar's beat, and then none: ends what [`Self::Start`] began.
    PingTimes(u32),
    Trigger(TriggerSource),
}

/// Names a setting that a device has and the model does not use.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct KeptKey {
    /// The protocol whose setting it is.
    pub via: &'static str,
    pub name: &'static str,
    /// Which of several: a channel, a subsystem. 0 where there is one.
    pub place: u32,
}

/// What such a setting was told: it is reported as it was, and changes nothing else.
#[derive(Clone, Debug, PartialEq)]
pub enum KeptValue {
    Integer(i64),
    Numbers(Vec<f64>),
    Text(String),
}

/// Who asks for a change.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Asker {
    /// The protocol, page or command it came by.
    pub via: &'static str,
    pub peer: Option<SocketAddr>,
}

/// When and by whom a change was asked for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Asked {
    /// Rig time.
    pub utc: UtcNs,
    pub by: Asker,
}

impl From<UtcNs> for Asked {
    /// By this program itself.
    fn from(utc: UtcNs) -> Self {
        let by = Asker {
            via: "echotank",
            peer: None,
        };
        Self { utc, by }
    }
}

/// Something that was changed, whoever asked.
#[derive(Clone, Debug, PartialEq)]
pub enum Changed {
    Setting(SettingChange),
    Kept(KeptKey, KeptValue),
}

/// One line of the journal of changes.
#[derive(Clone, Debug, PartialEq)]
pub struct JournalEntry {
    /// The settings' version from this change on.
    pub version: u64,
    pub asked: Asked,
    pub changed: Changed,
}

/// A change that was obeyed.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SettingApplied {
    /// The settings with the change in them.
    pub settings: SonarSettings,
    /// Counts the changes obeyed so far; 0 is the configuration's own settings.
    pub version: u64,
}

/// A change that was refused: nothing changed.
#[derive(Clone, Copy, Debug, PartialEq, thiserror::Error)]
#[error("{key} = {value}: must be {rule}")]
pub struct SettingRefused {
    /// The setting's key in the configuration.
    pub key: &'static str,
    pub value: f64,
    pub rule: SettingRule,
}

#[derive(Clone, Copy, Debug, PartialEq, thiserror::Error)]
pub enum SettingRule {
    #[error("a finite number")]
    Finite,
    #[error("from {min} to {max}")]
    Between { min: f64, max: f64 },
    #[error("0 or from {min} to {max}")]
    ZeroOrBetween { min: f64, max: f64 },
    #[error("one of at most {most} settings that are only kept")]
    TooMany { most: usize },
}

/// The way from any protocol, page or command to the settings of one sonar; `run::settings` is behind it.
pub trait SettingsPort: Send + Sync {
    /// What the next ping obeys.
    fn settings(&self) -> SonarSettings;
    fn trigger(&self) -> TriggerSource;
    fn limits(&self) -> SettingLimits;
    /// Goes up with every change, those of kept settings included.
    fn version(&self) -> u64;
    fn apply(&self, change: SettingChange, asked: Asked) -> Result<SettingApplied, SettingRefused>;
    /// Keeps a setting that the model does not use. Refused only when too many are kept.
    fn keep(&self, key: KeptKey, value: KeptValue, asked: Asked) -> Result<(), SettingRefused>;
    fn kept(&self, key: KeptKey) -> Option<KeptValue>;
    /// The changes after `version`, oldest first; of a long time ago only the newest.
    fn changes_since(&self, version: u64) -> Vec<JournalEntry>;
}

/// The transmitted pulse: sqrt(2) Re{ a(t) exp(j 2pi f_c t) }, 0 <= t <= T.
/// LFM: a(t) = taper(t) exp(+-j pi (B/T) (t - T/2)^2), plus for an up sweep. CW: a(t) = taper(t).
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Pulse {
    pub kind: PulseKind,
    pub center_frequency_hz: f64,
    /// Swept bandwidth; 0 for CW.
    pub bandwidth_hz: f64,
    pub duration_s: f64,
    /// Tukey taper: the fraction of the pulse under its two cosine flanks; 0 is rectangular.
    pub taper: f64,
}

impl Pulse {
    /// Hz per second at which the frequency sweeps: +B/T up, -B/T down, 0 for CW.
    pub fn sweep_hz_per_s(&self) -> f64 {
        match self.kind {
            PulseKind::LfmUp => self.bandwidth_hz / self.duration_s,
            PulseKind::LfmDown => -self.bandwidth_hz / self.duration_s,
            PulseKind::Cw => 0.0,
        }
    }

    /// a(t), `t_s` seconds after the pulse began: zero outside 0..=T, both ends belonging to the pulse.
    pub fn envelope(&self, t_s: f64) -> Complex64 {
        let duration_s = self.duration_s;
        if !(0.0..=duration_s).contains(&t_s) {
            return Complex64::ZERO;
        }
        // Tukey: raised cosine over `taper * T / 2` at either end.
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

    /// How weak echoes that sound together may make a window of a pulse's length: its rms over theirs, in all windows but one in ten thousand. Of pulses
    /// with many degrees of freedom (their band times the window) no window is much weaker than the echoes in it, of a pure tone some are.
    ///
    /// A window's energy is that of so many normal numbers; the lower end of its distribution (gamma) is that of a power. Flanks leave a chirp fewer of
    /// them, as many as there are equal ones with the same mean and mean square: the square of a raised cosine is 3/8 on the mean, its fourth power 35/128.
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

/// Least samples of a window over which errors are counted.
pub const MIN_WINDOW: f64 = 32.0;

/// Share of all windows that may be weaker than [`Pulse::weakest_window`] says: a ping has some thousands.
const WEAKEST_WINDOWS: f64 = 1e-4;

/// How a sum over echoes is read at its points. An echo of a rectangular pulse begins and ends with a jump between two of them.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Edges {
    /// The value at the point, and nothing else: what a receiver without a filter would sample.
    #[default]
    Sampled,
    /// The points next to a jump are weighted with [`edge_corrections`], so that a filter's convolution sum over them converges on its
    /// integral to the fifth order in the step, where points alone give the first.
    Weighted,
}

/// Points that [`edge_corrections`] weighs at either end of an echo.
pub const EDGE_POINTS: usize = 4;

/// What is added to the weight 1 of the first points inside an edge, outermost first. `inside`: the outermost one's distance from the edge
/// in steps, 0..1.
///
/// Exact for cubics: the weights of Gregory's formula for an edge on a point (251, 897, 633, 739 over 720), and between the edge and the
/// point the integral of the cubic through the four points. With one point instead of four it would be its cell's covered part, `inside` + 1/2.
pub fn edge_corrections(inside: f64) -> [f64; EDGE_POINTS] {
    let x = inside;
    [
        x * (1.0 + x * (11.0 / 12.0 + x * (1.0 / 3.0 + x / 24.0))) - 469.0 / 720.0,
        177.0 / 720.0 - x * x * (1.5 + x * (5.0 / 6.0 + x / 8.0)),
        x * x * (0.75 + x * (2.0 / 3.0 + x / 8.0)) - 87.0 / 720.0,
        19.0 / 720.0 - x * x * (1.0 / 6.0 + x * (1.0 / 6.0 + x / 24.0)),
    ]
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum PulseKind {
    LfmUp,
    LfmDown,
    Cw,
}

/// Where an array sits in the body and what it radiates or hears.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Mounting {
    /// Body, metres: the array's centre.
    pub position_m: DVec3,
    pub body_from_array: DQuat,
}

/// Directional response of a transmitter or of one receive element, in array axes.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Pattern {
    /// 1 in every direction.
    Omnidirectional,
    /// A rectangular piston: sinc(L u_x/lambda) sinc(W u_y/lambda), u the unit vector to the point in array axes; a side of 0 is omnidirectional.
    /// `baffled`: nothing behind the face (u_z < 0).
    Rectangle {
        length_m: f64,
        width_m: f64,
        baffled: bool,
    },
    /// The mean of so many elements alike, `spacing_m` apart along x, each a rectangle as above: a part of a line, taken as one in its middle.
    /// What its elements' places make of an echo depends on where the echo comes from and is the walk's; levels and culling are one element's.
    Part {
        elements: usize,
        spacing_m: f64,
        length_m: f64,
        width_m: f64,
        baffled: bool,
    },
}

/// One transmit array: a single coherent radiator.
#[derive(Clone, Debug, PartialEq)]
pub struct TransmitArray {
    pub mounting: Mounting,
    pub pattern: Pattern,
    /// Added to the settings' source level, dB.
    pub level_offset_db: f64,
}

/// One receive array: a uniform line of equal elements along the array's x axis, centred on the mounting.
#[derive(Clone, Debug, PartialEq)]
pub struct ArrayGeometry {
    pub mounting: Mounting,
    pub elements: usize,
    pub spacing_m: f64,
    pub element_pattern: Pattern,
    /// dB re 1 V/uPa.
    pub sensitivity_db: f64,
    /// Index of the transmit array whose pulse this array listens to.
    pub transmit: usize,
}

impl ArrayGeometry {
    /// Element `e`'s place in array axes, metres along x.
    pub fn element_x_m(&self, e: usize) -> f64 {
        (e as f64 - (self.elements as f64 - 1.0) / 2.0) * self.spacing_m
    }
    /// Element `e`'s place in the body, metres.
    pub fn element_body_m(&self, e: usize) -> DVec3 {
        self.mounting.position_m
            + self.mounting.body_from_array * DVec3::new(self.element_x_m(e), 0.0, 0.0)
    }
}

/// A piece of the polyline: from `start_s` on, the reference point moves at constant velocity with constant attitude.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Segment {
    /// Seconds from the start of the pulse; the first segment's is 0.
    pub start_s: f64,
    /// Reference point at `start_s`, world, metres.
    pub position_m: DVec3,
    pub velocity_m_per_s: DVec3,
    pub world_from_body: DQuat,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum PathModel {
    StopAndHop,
    /// The platform on the plan's segments: constant velocity and attitude on each, and a step of the attitude between them.
    Polyline,
    /// Each element on chords of its own between the plan's vertices: no steps, and what rotation does to an element on an arm is in it.
    KSegment,
    /// Position and attitude at the moment of reception itself.
    Continuous,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum DopplerModel {
    None,
    /// Each echo stretched evenly about its leading edge.
    Stretch,
    /// Each echo stretched about the middle of the pulse, with the change of the stretch during it.
    StretchQuadratic,
    /// Eq. 21 of Meng et al. 2023 as printed: delays stretched, pulse not. For comparison.
    PaperEq21,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Synthesis {
    /// Retarded time per sample on the continuous trajectory: slow and trusted.
    Reference,
    /// The linearised sum under the chosen path and Doppler.
    Direct,
    /// Eqs. 18 and 21 of Meng et al. 2023 on their frequency grid.
    Spectral,
    /// Each echo's replica laid on the nearest sample.
    Nearest,
    /// Each echo's replica interpolated linearly between its samples.
    Linear,
    /// Echoes spread on a grid and transformed, an element at a time, within a tolerance.
    Gridded1d,
    /// The same over delay and slope, a whole line array at a time.
    Gridded2d,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ReceiverFilter {
    /// The sum is sampled at its points.
    None,
    /// A linear-phase low-pass ahead of the sampling, delay removed.
    Fir,
}

#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ModelChoice {
    pub path: PathModel,
    pub doppler: DopplerModel,
    pub synthesis: Synthesis,
    /// Longest polyline segment, seconds.
    pub segment_s: f64,
    /// Scatterers whose two-way pattern (transmit times element, over their boresights) is below this are left out, dB (negative);
    /// where [`Scatterers::loud`] says so, only below less. None keeps all.
    pub cull_db: Option<f64>,
}

impl PathModel {
    pub const ALL: [Self; 4] = [
        Self::StopAndHop,
        Self::Polyline,
        Self::KSegment,
        Self::Continuous,
    ];
    /// As the configuration and the records spell it.
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
    pub const ALL: [Self; 4] = [
        Self::None,
        Self::Stretch,
        Self::StretchQuadratic,
        Self::PaperEq21,
    ];
    /// As the configuration and the records spell it.
    pub fn name(self) -> &'static str {
        match self {
            Self::None => "none",
            Self::Stretch => "stretch",
            Self::StretchQuadratic => "stretch-quadratic",
            Self::PaperEq21 => "paper-eq21",
        }
    }
    /// Whether it leaves the pulse as it is, so that one spectrum or one replica serves every echo.
    pub fn keeps_pulse(self) -> bool {
        matches!(self, Self::None | Self::PaperEq21)
    }
}

impl Synthesis {
    pub const ALL: [Self; 7] = [
        Self::Reference,
        Self::Direct,
        Self::Spectral,
        Self::Nearest,
        Self::Linear,
        Self::Gridded1d,
        Self::Gridded2d,
    ];
    /// As the configuration and the records spell it.
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
    /// Whether it lays one and the same pulse under every echo, so that only [`DopplerModel::keeps_pulse`] models go with it.
    pub fn shares_pulse(self) -> bool {
        matches!(self, Self::Spectral | Self::Nearest | Self::Linear)
    }
    /// Whether it is made for a tolerance and keeps it, rather than having the error it has.
    pub fn keeps_tolerance(self) -> bool {
        matches!(self, Self::Gridded1d | Self::Gridded2d)
    }
    /// Whether it can sum echoes of this Doppler model.
    pub fn takes(self, doppler: DopplerModel) -> bool {
        match self {
            Self::Reference | Self::Direct => true,
            Self::Spectral | Self::Nearest | Self::Linear => doppler.keeps_pulse(),
            Self::Gridded1d | Self::Gridded2d => doppler != DopplerModel::PaperEq21,
        }
    }
}

/// What a method promises and costs; the method selection chooses among error models.
#[derive(Clone, Debug, PartialEq)]
pub struct ErrorModel {
    pub name: &'static str,
    /// Predicted relative error against the reference.
    pub error: f64,
    /// Predicted core milliseconds per ping.
    pub cost_ms: f64,
    pub why: String,
}

impl ErrorModel {
    /// The error model itself if its method reaches `tolerance`.
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

/// A method that cannot do what is asked of it.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[error("{name} is off by {error:.1e} here, and {tolerance:.1e} is asked: {why}")]
pub struct MethodRefused {
    pub name: &'static str,
    /// Predicted, as in [`ErrorModel`].
    pub error: f64,
    pub tolerance: f64,
    pub why: String,
}

/// What the errors and costs of methods depend on; the worst of a ping, or of a whole run.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Conditions {
    pub pulse: Pulse,
    pub sound_speed_m_per_s: f64,
    pub sample_rate_hz: f64,
    pub filter: ReceiverFilter,
    /// Of a transmitter or an element, its arm included.
    pub speed_m_per_s: f64,
    pub acceleration_m_per_s2: f64,
    /// How fast an arm's end moves by the platform's turning alone.
    pub turning_m_per_s: f64,
    /// Nearest and farthest scatterer.
    pub range_m: (f64, f64),
    pub segment_s: f64,
    pub scatterers: usize,
    pub elements: usize,
    /// What the methods that keep a tolerance are made for.
    pub tolerance: f64,
    /// None: echoes may come from any direction.
    pub heard: Option<Heard>,
}

/// How the echoes that are heard move, weighted with their energy: root mean squares over the echoes of a window of a pulse's length, of the
/// worst window of a ping, relative to that window or to the whole ping, whichever is louder.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Heard {
    /// How far an element moves along the ray between the pulse and the echo.
    pub hop_m: f64,
    /// Along the ray, the mean of transmitter and element. A window may hold the end of a pulse alone, where Doppler's phase has grown: as its root
    /// mean square there would be that of a whole pulse, so much more than [`Self::closing_of_echoes_m_per_s`].
    pub closing_m_per_s: f64,
    /// ... of whole echoes.
    pub closing_of_echoes_m_per_s: f64,
    /// Second derivative of the range, the mean of both legs.
    pub bend_m_per_s2: f64,
    /// Of an element, along the ray.
    pub acceleration_m_per_s2: f64,
    /// Of an element on its arm by the platform's turning alone, along the ray.
    pub turning_m_per_s: f64,
    /// Of an element, along the ray, of what its motion has across its array.
    pub across_m_per_s: f64,
    /// By how much the errors of echoes at random phases add up to more than their root mean square in the worst window of any element, and
    /// what else a sample of the echoes does not show.
    pub spread: f64,
    /// Of the energy of a window, at most, what its loudest echo alone has.
    pub loudest: f64,
    /// Echoes of all elements.
    pub echoes: f64,
}

impl Conditions {
    /// Relative error that a phase error of `phase_rad` (rms) makes at most: that of an echo turned upside down is 2.
    pub fn error_of_phase(phase_rad: f64) -> f64 {
        phase_rad.min(2.0)
    }

    /// Radians of carrier in a metre of path, at the highest frequency of the sweep.
    pub fn wavenumber_per_m(&self) -> f64 {
        let highest_hz = self.pulse.center_frequency_hz + 0.5 * self.pulse.bandwidth_hz;
        std::f64::consts::TAU * highest_hz / self.sound_speed_m_per_s
    }
}

/// Time-varying gain over slant range r.
#[derive(Clone, Debug, PartialEq)]
pub enum TimeVaryingGain {
    None,
    /// spreading log10(r) + 2 absorption r, clipped to 0..=max; `spreading` is 20, 30 or 40; `absorption_db_per_m` one way.
    Law {
        spreading: f64,
        absorption_db_per_m: f64,
        max_db: f64,
    },
    /// (range in metres, gain in dB), linear between, held outside.
    Table(Vec<(f64, f64)>),
}

/// Receiver chain behind the elements.
#[derive(Clone, Debug, PartialEq)]
pub struct Receiver {
    pub sample_rate_hz: f64,
    pub filter: ReceiverFilter,
    pub tvg: TimeVaryingGain,
    /// Noise at the element, dB re 1 uPa^2/Hz; none is noiseless.
    pub noise_db: Option<f64>,
    /// None: not quantised.
    pub adc_bits: Option<u32>,
    /// Volts (rms of the envelope) that fill the converter, and the wire's integers.
    pub full_scale_v: f64,
    pub seed: u64,
}

/// One ping of one sonar, complete: nothing downstream asks anybody else.
#[derive(Clone, Debug)]
pub struct PingPlan {
    pub sonar: usize,
    /// Sequential, from 1; a skipped ping keeps its number.
    pub ping_number: u32,
    /// Start of the pulse, rig time.
    pub transmit_utc: UtcNs,
    /// What the records are stamped with (`nav.stamp`).
    pub stamp_utc: UtcNs,
    /// Seconds since the previous transmitted ping; 0 for the first.
    pub ping_period_s: f64,
    pub settings: SonarSettings,
    /// The rate actually kept (lower than the maximum where the range is too long for it).
    pub ping_rate_hz: f64,
    pub pulse: Pulse,
    pub sound_speed_m_per_s: f64,
    /// One way.
    pub absorption_db_per_m: f64,
    /// Samples of every element; sample k lies at `first_sample_s + k / receiver.sample_rate_hz`.
    pub sample_count: usize,
    pub first_sample_s: f64,
    pub model: ModelChoice,
    pub nav: NavState,
    pub trajectory: Trajectory,
    /// The polyline over the listening window; at least one.
    pub segments: Vec<Segment>,
}

impl PingPlan {
    /// Length of the listening window, seconds.
    pub fn window_s(&self, sample_rate_hz: f64) -> f64 {
        self.first_sample_s + self.sample_count as f64 / sample_rate_hz
    }
}

// ---------------------------------------------------------------- the scene

/// How a scatterer's pressure depends on the angles between its normal and the two rays. Nothing on the far side of the normal.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ScatterLaw {
    /// The same in every direction.
    Point,
    /// Times sqrt(cos i cos s) (bistatic Lambert).
    Lambert,
    /// Times cos i of the incoming ray, whatever the direction of the receiver (Meng et al. 2023, Eq. 13).
    LambertOneWay,
    /// Times [`LawCurve::half`] of either ray, of the curve that comes with the scatterers.
    Curve,
}

/// A backscattering strength over the angle of incidence, ready for loops: the pressure of one leg, so that the legs multiply.
#[derive(Clone, Debug, PartialEq)]
pub struct LawCurve {
    /// Fourth roots of the strength at even steps of the root of the cosine, from grazing to normal incidence.
    half: Box<[f64; Self::STEPS + 1]>,
}

impl LawCurve {
    /// A Gaussian lobe 3 degrees wide is met to 0.01 dB between the nodes; 32 KiB stay near a core.
    const STEPS: usize = 4096;

    /// `strength`: a power per square metre of seabed, over the cosine of incidence (0 to 1).
    pub fn new(strength: impl Fn(f64) -> f64) -> Self {
        let mut half = Box::new([0.0; Self::STEPS + 1]);
        for (k, half) in half.iter_mut().enumerate() {
            let root = k as f64 / Self::STEPS as f64;
            *half = strength(root * root).max(0.0).sqrt().sqrt();
        }
        Self { half }
    }

    /// Pressure of one leg, linear between the nodes. `root`: of the cosine of incidence, 0 to 1.
    #[inline(always)]
    pub fn half(&self, root: f64) -> f64 {
        let x = root * Self::STEPS as f64;
        let k = (x as usize).min(Self::STEPS - 1);
        self.half[k] + (x - k as f64) * (self.half[k + 1] - self.half[k])
    }
}

/// Points that scatter, structure of arrays; all vectors have the same length.
#[derive(Clone, Debug, Default)]
pub struct Scatterers {
    /// World, metres.
    pub north_m: Vec<f64>,
    pub east_m: Vec<f64>,
    pub down_m: Vec<f64>,
    /// Unit, away from the solid; unused for points.
    pub normal: Vec<[f32; 3]>,
    /// Echo pressure at 1 m for unit incident pressure; for a patch of seabed sqrt(mu area) times its fixed complex reflectivity.
    pub strength: Vec<Complex64>,
    pub law: Vec<ScatterLaw>,
    /// By which factor, 1 or more, the floor of the patterns ([`ModelChoice::cull_db`]) lies lower for this one, because it is louder than the
    /// ground that the floor was chosen for.
    pub loud: Vec<f32>,
    /// Of those whose law is [`ScatterLaw::Curve`]; without it they are silent.
    pub curve: Option<Arc<LawCurve>>,
}

impl Scatterers {
    pub fn len(&self) -> usize {
        self.north_m.len()
    }
    pub fn is_empty(&self) -> bool {
        self.north_m.is_empty()
    }
    pub fn clear(&mut self) {
        self.truncate(0);
    }
    pub fn truncate(&mut self, len: usize) {
        self.north_m.truncate(len);
        self.east_m.truncate(len);
        self.down_m.truncate(len);
        self.normal.truncate(len);
        self.strength.truncate(len);
        self.law.truncate(len);
        self.loud.truncate(len);
    }
    /// Puts scatterer `from` in the place of scatterer `to`.
    pub fn copy_within(&mut self, from: usize, to: usize) {
        self.north_m[to] = self.north_m[from];
        self.east_m[to] = self.east_m[from];
        self.down_m[to] = self.down_m[from];
        self.normal[to] = self.normal[from];
        self.strength[to] = self.strength[from];
        self.law[to] = self.law[from];
        self.loud[to] = self.loud[from];
    }
    /// To be written over: what is added scatters nothing.
    pub fn resize(&mut self, len: usize) {
        self.north_m.resize(len, 0.0);
        self.east_m.resize(len, 0.0);
        self.down_m.resize(len, 0.0);
        self.normal.resize(len, [0.0; 3]);
        self.strength.resize(len, Complex64::ZERO);
        self.law.resize(len, ScatterLaw::Point);
        self.loud.resize(len, 1.0);
    }
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
    pub fn position_m(&self, i: usize) -> DVec3 {
        DVec3::new(self.north_m[i], self.east_m[i], self.down_m[i])
    }
}

/// What one pair of transmitter and receive array can hear of the scene: a ball, less the directions where the patterns of transmitter and
/// element together surely lie below what counts, and what lies behind a baffle. A footprint with a value that is not finite hears nothing.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Footprint {
    /// World, metres: the transmitter.
    pub apex_m: DVec3,
    /// World, metres: the middle of the receive array.
    pub receiver_m: DVec3,
    pub max_range_m: f64,
    pub sides: [PatternSide; Self::SIDES],
    /// How many times below its greatest value the product of the sides may fall; infinite keeps all.
    pub depth: f64,
    pub faces: [BaffledFace; 2],
}

/// One side of a rectangular radiator. Its pattern stays below 1 / (u / knee), u the sine of the direction off the side's broadside.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PatternSide {
    /// Along the side, in the world, unit.
    pub axis: DVec3,
    /// Sine from which that is less than 1: lambda / (pi L); infinite for a side without length.
    pub knee: f64,
    /// What the sine may be off by, because the platform turns ...
    pub turn: f64,
    /// ... and, over the range in metres, because the radiator sits or moves elsewhere than the apex.
    pub shift_m: f64,
}

/// A face that radiates or hears nothing behind.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct BaffledFace {
    /// Out of the face, in the world, unit; zero for a face that is open.
    pub normal: DVec3,
    /// As in [`PatternSide`].
    pub turn: f64,
    pub shift_m: f64,
}

impl PatternSide {
    pub const OPEN: Self = Self {
        axis: DVec3::X,
        knee: f64::INFINITY,
        turn: 0.0,
        shift_m: 0.0,
    };

    /// How many times below 1 the pattern surely lies where the direction's part along the axis is `along_m` of `range_m`.
    #[inline(always)]
    pub fn below(&self, along_m: f64, range_m: f64) -> f64 {
        let sine = (along_m.abs() - self.shift_m) / range_m - self.turn;
        (sine / self.knee).max(1.0)
    }
}

impl BaffledFace {
    pub const OPEN: Self = Self {
        normal: DVec3::ZERO,
        turn: 0.0,
        shift_m: 0.0,
    };

    #[inline(always)]
    pub fn may_face(&self, ahead_m: f64, range_m: f64) -> bool {
        ahead_m >= -(self.turn * range_m + self.shift_m)
    }
}

impl Footprint {
    /// Length and width of transmitter and element.
    pub(crate) const SIDES: usize = 4;

    /// Everything within range.
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

    /// Everything within range whose direction u has |u . axis| no greater than `max_sine`.
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

/// What one gathering met.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct SceneCounts {
    /// Tiles that lay in reach of a footprint, and of these the ones that had to be made.
    pub tiles_used: u64,
    pub tiles_made: u64,
    /// Pieces of the seabed around the footprints, one tile or many, that were out of reach or held no seabed.
    pub culled_tiles: u64,
    /// Scatterers of the seabed: those in the tiles that had to be made.
    pub made: u64,
    /// Those in the tiles in reach, which every ping looks at, are culled (in no footprint), in shadow, or handed on.
    pub culled: u64,
    /// Explicit points and scatterers of targets are among these.
    pub shadowed: u64,
    pub scatterers: u64,
    /// Explicit points and targets handed on.
    pub points: u64,
    pub targets: u64,
}

/// A named strong target, for the truth file.
#[derive(Clone, Debug, PartialEq)]
pub struct Target {
    pub name: String,
    /// World, metres.
    pub position_m: DVec3,
    /// dB.
    pub target_strength_db: f64,
}

// ---------------------------------------------------------------- echoes

/// Scatterers in one chunk at most.
pub const CHUNK: usize = 256;

/// Echoes of up to [`CHUNK`] scatterers at one element, structure of arrays, small enough for L1.
pub struct ArrivalChunk {
    pub len: usize,
    /// Which element of the array being computed.
    pub element: usize,
    /// Leading edge after the start of the pulse, seconds.
    pub delay_s: [f64; CHUNK],
    /// eta = dt'/dt - 1: the Doppler stretch minus one (kept so that small ones lose no digits).
    pub doppler: [f64; CHUNK],
    /// Half of d2t'/dt2, per second: s seconds after the leading edge sounds what left at (1 + doppler) s + curvature s^2. Zero unless the
    /// Doppler model is [`DopplerModel::StretchQuadratic`].
    pub curvature_per_s: [f64; CHUNK],
    /// Complex amplitude A_{m,e} at the element, without carrier phase: uPa (rms) after sensitivity: volts.
    pub amplitude: [Complex64; CHUNK],
}

impl ArrivalChunk {
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

/// Whatever turns echoes into samples. `echo` fills chunks, `array` implements this, `run` joins them.
pub trait ArrivalSink {
    fn accept(&mut self, chunk: &ArrivalChunk);
}

/// Echoes of up to [`CHUNK`] scatterers at one point of a line array, and how each changes along the line and during the pulse.
///
/// With u(y, w) the delay, at y metres along the line from the point, of what left w seconds into the pulse (leading edge: 0, 0).
pub struct LineChunk {
    pub len: usize,
    /// As [`ArrivalChunk`] has them.
    pub delay_s: [f64; CHUNK],
    pub doppler: [f64; CHUNK],
    pub amplitude: [Complex64; CHUNK],
    /// -c du/dy: the sine of the angle from broadside, as the moving line sees it.
    pub slope: [f64; CHUNK],
    /// c d2u/dy2.
    pub bend_per_m: [f64; CHUNK],
    /// c d2u/dy dw.
    pub twist_per_s: [f64; CHUNK],
    /// c d2u/dw2: what the linearised stretch leaves out.
    pub swing_m_per_s2: [f64; CHUNK],
    /// How the amplitude differs along the stretch: `amplitude` times 1 + fade y + curl y^2 at y metres from the middle, exact at both ends.
    /// Zero where they were not asked for.
    pub fade_per_m: [f64; CHUNK],
    pub curl_per_m2: [f64; CHUNK],
}

impl LineChunk {
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

    /// Copies slope, bend, twist, swing, fade and curl from one place to another.
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

/// As [`ArrivalSink`], for whole stretches of a line array.
pub trait LineSink {
    fn accept(&mut self, chunk: &LineChunk);
}

/// A stretch of a line array, by its middle, and the leading edges that are asked for.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct LineStretch {
    /// From the array's centre.
    pub middle_m: f64,
    /// From its middle to its outermost elements.
    pub half_m: f64,
    /// Whether fade and curl are wanted.
    pub fades: bool,
    /// Elements in it, for the counts.
    pub elements: u64,
    /// From `earliest_s` up to, not including, `latest_s`.
    pub earliest_s: f64,
    pub latest_s: f64,
}

/// Where the echoes of one ping at one line array come from; many threads ask at once.
pub trait LineSource: Sync {
    /// Scatterers that may be heard.
    fn scatterers(&self) -> u64;

    /// No echo begins before, anywhere on the line; infinite where there is none.
    fn earliest_s(&self) -> f64;

    /// Points of amplitude 0 that span what [`Self::walk`] would hand on (all but a few of the echoes lie between them), and a sample of its
    /// echoes, with fade and curl.
    fn survey(&self, stretch: LineStretch, sink: &mut impl LineSink);

    /// Echoes at the middle of a stretch, in chunks of at most [`CHUNK`], always in the same order. Counts are of scatterer-element pairs;
    /// an echo outside the delays asked for is not counted at all, since another stretch asks for it.
    fn walk(&self, stretch: LineStretch, sink: &mut impl LineSink) -> EchoCounts;
}

/// What a walk over the scatterers met.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct EchoCounts {
    /// Scatterer-element pairs handed on.
    pub used: u64,
    /// Left out by the patterns (`ModelChoice::cull_db`).
    pub culled: u64,
    /// Outside the listening window.
    pub outside_window: u64,
    /// Closer than a wavelength, where the far-field amplitude does not hold: held at one wavelength.
    pub too_close: u64,
    /// Polyline: fell into the gap where an element jumps at a vertex; placed at the vertex time.
    pub no_root: u64,
    /// Polyline: two segments had a root; the first was taken.
    pub two_roots: u64,
    /// Beyond the polyline's last segment; carried on along it.
    pub beyond_track: u64,
    /// Beyond what the engine is made for. `gridded-1d`: faster, and heard with the greatest Doppler it knows. `gridded-2d`: all those of a
    /// ping that was nearer or faster than its tolerance bears.
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
    pub elements: usize,
    pub samples: usize,
    /// Element-major: `iq[e * samples + k]`.
    pub iq: Vec<Complex64>,
    /// Sample values that met the converter's ends in this ping.
    pub saturated: u64,
}

impl ElementFrame {
    pub fn element(&self, e: usize) -> &[Complex64] {
        &self.iq[e * self.samples..(e + 1) * self.samples]
    }
    pub fn element_mut(&mut self, e: usize) -> &mut [Complex64] {
        &mut self.iq[e * self.samples..(e + 1) * self.samples]
    }
}

/// Beams of one fan after the matched filter; sample k of a beam is a leading edge at `first_sample_s + k / sample_rate`.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct BeamFrame {
    pub beams: usize,
    pub samples: usize,
    /// From the boresight, positive to starboard, radians; beam 0 is port-most.
    pub angle_rad: Vec<f64>,
    /// -3 dB width of each beam across, radians.
    pub width_rad: Vec<f64>,
    /// Beam-major: `iq[b * samples + k]`.
    pub iq: Vec<Complex64>,
}

impl BeamFrame {
    pub fn beam(&self, b: usize) -> &[Complex64] {
        &self.iq[b * self.samples..(b + 1) * self.samples]
    }
}

/// Where one beam of a fan meets the bottom.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Sounding {
    /// Which beam of the fan.
    pub beam: usize,
    /// As [`BeamFrame::angle_rad`].
    pub angle_rad: f64,
    /// Two-way travel time at the array's centre, from the start of the pulse.
    pub twtt_s: f64,
    /// Predicted standard deviation of it.
    pub error_s: f64,
    pub detection: Detection,
    /// Level of the echo, volts (rms).
    pub level_v: f64,
}

/// By what a bottom was found.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Detection {
    Amplitude,
    Phase,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub enum Side {
    Port,
    Starboard,
}

/// One side-scan line: envelope (volts, rms) against slant range, sample 0 at the start of the pulse.
#[derive(Clone, Debug, PartialEq)]
pub struct Line {
    pub side: Side,
    pub amplitude: Vec<f32>,
}

/// The side-scan lines of one of several pulses.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct PulseLines {
    /// It left so long after the sonar's own pulse. Its lines count from its own start.
    pub delay_s: f64,
    pub lines: Vec<Line>,
}

/// What the scene knows of each sample of one side-scan line, or of one beam of a fan: labels for those who teach machines to read pictures. Not made on the ping path.
#[derive(Clone, Debug, PartialEq)]
pub struct LineTruth {
    pub side: Side,
    /// The target with the strongest echo in each sample: 1 is the scene's first, 0 none.
    pub target: Vec<u16>,
    /// Its energy, and that of all else; the same unit, which is nobody's concern.
    pub target_energy: Vec<f32>,
    pub other_energy: Vec<f32>,
    pub ground: Vec<GroundSeen>,
    /// Depth of that ground, world, metres; NaN where there is none.
    pub down_m: Vec<f32>,
}

impl LineTruth {
    /// Echoes of target `label` in sample `k`: the sample is its if no other target's are stronger.
    pub fn claim(&mut self, k: usize, label: u16, energy: f32) {
        if energy > self.target_energy[k] {
            self.other_energy[k] += self.target_energy[k];
            (self.target[k], self.target_energy[k]) = (label, energy);
        } else {
            self.other_energy[k] += energy;
        }
    }
}

/// Whether the seabed on the beam's axis at the range of a sample is heard.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum GroundSeen {
    /// There is none: water, a hole, the end of the world.
    #[default]
    None,
    Seen,
    /// Something stands before all of it.
    Hidden,
}

/// The error of element samples against the reference, measured at random ones before noise, gain and converter: rms of the differences, each
/// over the rms of the samples around it or of the element's whole ping, whichever is larger.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ErrorCheck {
    /// How many samples it rests on.
    pub samples: u32,
    pub error: f64,
    /// Its 95 % interval.
    pub low: f64,
    pub high: f64,
    /// `sonar.model.tolerance`.
    pub tolerance: f64,
    /// On the newest two pings with samples looked at the error was above 1.3 tolerances.
    pub fault: bool,
}

/// Everything one ping produced.
#[derive(Clone, Debug, Default)]
pub struct PingOutput {
    /// Of the newest samples looked at, this ping's and those before it; none where none is asked for, or too few were seen yet.
    pub error_check: Option<ErrorCheck>,
    /// One per receive array.
    pub elements: Vec<ElementFrame>,
    /// One per configured fan (at most one today).
    pub beams: Vec<BeamFrame>,
    /// Of the fan, where it detects the bottom; a beam without a bottom has none.
    pub soundings: Vec<Sounding>,
    pub lines: Vec<Line>,
    /// Of the further pulses in the water, one each.
    pub more_lines: Vec<PulseLines>,
    pub counts: EchoCounts,
    pub scene: SceneCounts,
    /// Where the plan of methods chose something.
    pub methods: Option<MethodMark>,
    pub overload_state: OverloadState,
}

/// What was done to a ping because computing did not keep up; nothing, mostly. It depends on the machine.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct OverloadState {
    /// Made with this tolerance in place of the configured one.
    pub tolerance: Option<f64>,
    /// The pulse went out so much later than the beat had it, seconds.
    pub put_off_s: f64,
}

impl OverloadState {
    pub const NONE: Self = Self {
        tolerance: None,
        put_off_s: 0.0,
    };
}

/// Which plan of methods made a ping, and what it promised.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct MethodMark {
    /// Counts the plans of a sonar; the configuration's start is 0.
    pub plan: u32,
    /// By the plan's conditions, relative, of element samples.
    pub predicted_error: f64,
    pub predicted_ms: f64,
    pub tolerance: f64,
    /// Elements of a line that were made as one ([`Pattern::Part`]); 1 where elements themselves were made.
    pub part_elements: usize,
}

// ---------------------------------------------------------------- out

/// One whole protocol record, ready for framing.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Datagram {
    /// The protocol's own number (7038, 7018, ...).
    pub record_type: u32,
    pub bytes: Vec<u8>,
}

/// For the tests of any crate.
#[doc(hidden)]
pub mod testing {
    use super::*;

    /// A ping of a platform at rest in the origin.
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

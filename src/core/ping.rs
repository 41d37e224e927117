//! One ping: its plan, its counts and its output.

use std::sync::Arc;

use glam::DQuat;
use glam::DVec3;
use num_complex::{Complex32, Complex64};

use crate::frames::Trajectory;
use crate::model::ModelChoice;
use crate::navigation::NavState;
use crate::pulse::Pulse;
use crate::settings::SonarSettings;
use crate::sound_speed::SoundSpeedProfile;
use crate::time::UtcNs;

/// One segment of the polyline. Velocity and attitude of the reference point are constant from `start_s` on.
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

/// Complete description of one ping of one sonar. Later stages need no other input.
#[derive(Clone, Debug)]
pub struct PingPlan {
    /// Index of the sonar.
    pub sonar: usize,
    /// Sequential number, from 1. A skipped ping also has a number.
    pub ping_number: u32,
    /// Start of the pulse, rig time.
    pub transmit_utc: UtcNs,
    /// Time stamp of the records (`nav.stamp`).
    pub stamp_utc: UtcNs,
    /// Time since the previous transmitted ping, seconds; 0 for the first.
    pub ping_period_s: f64,
    /// Settings of this ping.
    pub settings: SonarSettings,
    /// Actual ping rate, hertz. Below the maximum if the range requires a longer period.
    pub ping_rate_hz: f64,
    /// Transmitted pulse.
    pub pulse: Pulse,
    /// Sound speed at the sonar, metres per second.
    pub sound_speed_m_per_s: f64,
    /// With a sound-speed profile, how sound bends. `None` in water of one sound speed.
    pub refraction: Option<Refraction>,
    /// One-way absorption, dB per metre.
    pub absorption_db_per_m: f64,
    /// Samples per element; sample k lies at `first_sample_s + k / receiver.sample_rate_hz`.
    pub sample_count: usize,
    /// Time of sample 0, seconds after the start of the pulse.
    pub first_sample_s: f64,
    /// Selected models and method.
    pub model: ModelChoice,
    /// Pattern floors by range, in place of the one of [`Self::model`].
    pub range_floors: RangeFloors,
    /// State of the platform for output records.
    pub nav: NavState,
    /// Position of the sonar for output records.
    pub sensor: SensorState,
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

/// Pattern floors by range. Empty where [`ModelChoice::cull_db`] holds at all ranges.
#[derive(Clone, Debug, Default)]
pub struct RangeFloors {
    /// Bins of slant range from the transmitter at the start of the pulse, per metre.
    pub per_m: f64,
    /// Lowest two-way pattern that culling keeps, relative to boresight, by bin. Infinite where the floor of the model holds.
    pub levels: Vec<f32>,
    /// Largest relative error of a window by what lies below the levels; 0 without levels.
    pub left_out: f64,
}

impl RangeFloors {
    /// The floor at a range. `floor`: that of the model, 0 without culling.
    #[inline(always)]
    pub fn at(&self, floor: f64, range_m: f64) -> f64 {
        match self.levels.get((range_m * self.per_m) as usize) {
            Some(level) if level.is_finite() && floor > 0.0 => f64::from(*level),
            _ => floor,
        }
    }
}

/// Water of a ping in which sound bends. Every scatterer is replaced by its *virtual point*, from which sound would arrive with the same time and direction in
/// water of the sound speed at the sonar.
#[derive(Clone, Debug)]
pub struct Refraction {
    /// Sound speed over depth.
    pub profile: Arc<SoundSpeedProfile>,
    /// Place of the sonar at the start of the pulse, world, metres: the mean of its receive arrays. Times and directions are exact there.
    pub array_m: DVec3,
    /// No ray is followed below this depth, metres: the seabed below the sonar.
    pub floor_m: f64,
    /// Where echoes by surface and bottom are made.
    pub reflections: Option<Reflections>,
    /// Some of the scatterers.
    pub places: SampledPlaces,
}

/// Places of an even sample of the scatterers of a ping, before they are replaced by virtual points: for the error model of these.
#[derive(Clone, Copy, Debug)]
pub struct SampledPlaces {
    at_m: [DVec3; Self::MAX],
    count: usize,
}

impl SampledPlaces {
    /// Places, at most.
    pub const MAX: usize = 64;

    /// Places, world, metres.
    pub fn at_m(&self) -> &[DVec3] {
        &self.at_m[..self.count]
    }

    /// Takes an even sample of `count` places.
    pub fn sample(&mut self, count: usize, place_m: impl Fn(usize) -> DVec3) {
        self.count = count.min(Self::MAX);
        for (k, at_m) in self.at_m[..self.count].iter_mut().enumerate() {
            *at_m = place_m((2 * k + 1) * count / (2 * self.count));
        }
    }
}

impl Default for SampledPlaces {
    fn default() -> Self {
        Self {
            at_m: [DVec3::ZERO; Self::MAX],
            count: 0,
        }
    }
}

/// Boundaries that reflect sound.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Reflections {
    /// Depth of the mean surface, metres.
    pub surface_m: f64,
    /// Whether the bottom reflects too.
    pub by_bottom: bool,
}

impl Refraction {
    /// Sound speed at the sonar, metres per second.
    pub fn sound_speed_m_per_s(&self) -> f64 {
        self.profile.at_m_per_s(self.array_m.z)
    }
}

/// Position of the sonar at the start of the pulse, for output records: the mean position of its receive arrays.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct SensorState {
    /// WGS84 latitude, radians.
    pub latitude_rad: f64,
    /// WGS84 longitude, radians.
    pub longitude_rad: f64,
    /// Depth below the world's vertical origin, metres; includes heave.
    pub depth_m: f64,
    /// Height above the seabed straight below, metres; `None` if the scene has no seabed there.
    pub altitude_m: Option<f64>,
    /// Depth of the platform's reference point without the heave of the records, metres. `None` if the records leave this depth to
    /// the client: the reference point is at the waterline, or the height comes from GNSS.
    pub still_depth_m: Option<f64>,
}

/// Counts of tiles and scatterers when the scene is collected for one ping.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct SceneCounts {
    /// Tiles in reach of a footprint.
    pub tiles_used: u64,
    /// Tiles in reach that had to be generated.
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
    /// Scatterers passed on without strength, because no ray reaches them through the water; included in `scatterers`.
    pub unreached: u64,
    /// Explicit points passed on; included in `scatterers`.
    pub points: u64,
    /// Targets passed on.
    pub targets: u64,
    /// Scatterers of the sea surface passed on; not included in `scatterers`.
    pub surface: u64,
    /// Echoes by way of surface or bottom passed on; not included in `scatterers`.
    pub images: u64,
    /// Scatterers of the water passed on, drawn for this ping.
    pub volume: u64,
    /// Moving scatterers passed on.
    pub moving: u64,
    /// Scatterers of the sea surface that were tested for the footprints.
    pub surface_tested: u64,
    /// Those of them within a footprint, before thinning.
    pub surface_made: u64,
    /// Pairs of legs by surface and bottom that were looked at.
    pub reflected_pairs: u64,
    /// Places of the surface whose motion or height was computed, about.
    pub waves: u64,
    /// Rays through water that bends sound, to scatterers and to their images.
    pub rays: u64,
}

/// Counts of one pass over the scatterers, in pairs of scatterer and element.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct EchoCounts {
    /// Pairs passed on to the synthesis.
    pub used: u64,
    /// Pairs culled by the patterns ([`ModelChoice::cull_db`]).
    pub culled: u64,
    /// Pairs outside the listening window.
    pub outside_window: u64,
    /// Pairs closer than a wavelength, where the far-field amplitude is invalid. The distance is clamped at one wavelength.
    pub too_close: u64,
    /// Pairs without a root on the polyline: the echo falls in the step of an element at a vertex. The vertex time is used.
    pub no_root: u64,
    /// Pairs with a root on two segments of the polyline. The first root is used.
    pub two_roots: u64,
    /// Pairs after the last segment of the polyline. The last segment is extrapolated.
    pub beyond_track: u64,
    /// Pairs beyond the range of the engine: faster, or of a greater change of Doppler, than it is designed for; for `gridded-2d`
    /// all pairs of a ping that is nearer or faster than its tolerance allows, for `gridded-lines` all pairs of a ping that is
    /// nearer than its interpolation along the line allows. The direct sum makes their elements instead.
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
    pub iq: Vec<Complex32>,
}

impl BeamFrame {
    /// Samples of beam `b`.
    pub fn beam(&self, b: usize) -> &[Complex32] {
        &self.iq[b * self.samples..(b + 1) * self.samples]
    }

    /// Sample `k` of beam `b` in double precision.
    pub fn sample(&self, b: usize, k: usize) -> Complex64 {
        let Complex32 { re, im } = self.beam(b)[k];
        Complex64::new(re.into(), im.into())
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

/// Side-scan lines of one later pulse of a ping.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct PulseLines {
    /// Delay of the pulse after the first pulse, seconds. Sample 0 of its lines lies at the start of this pulse.
    pub delay_s: f64,
    /// Lines of this pulse.
    pub lines: Vec<Line>,
}

/// Ground truth of each sample of a side-scan line or of a beam: labels for machine learning. Not computed on the ping path.
#[derive(Clone, Debug, PartialEq)]
pub struct LineTruth {
    /// Side of the platform.
    pub side: Side,
    /// Index of the target with the strongest echo in each sample: 1 is the first target of the scene, 0 is none.
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
    /// Adds echo energy of target `label` to sample `k`. The sample gets the label of its strongest target.
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

/// Error of element samples against the reference solution, in windows of one pulse length, before noise, gain and converter. The
/// error of a window is the rms of its differences over its own rms, or over a noise floor 55 dB below the strongest window of
/// the element, whichever is larger.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ErrorCheck {
    /// Number of compared windows at random places.
    pub windows: u32,
    /// Relative error: rms over these windows.
    pub error: f64,
    /// Lower end of the 95 % confidence interval of `error`.
    pub low: f64,
    /// Upper end of the 95 % confidence interval of `error`.
    pub high: f64,
    /// Largest error of the newest windows, the weakest of their elements among them.
    pub worst: f64,
    /// `sonar.model.tolerance`.
    pub tolerance: f64,
    /// A window of this ping exceeds 1.3 tolerances.
    pub exceeded: bool,
    /// A window exceeds 1.3 tolerances on each of the last two pings with compared windows.
    pub fault: bool,
}

/// Results of one ping: samples, beams, soundings, lines and counts.
#[derive(Clone, Debug, Default)]
pub struct PingOutput {
    /// Error check over the newest compared windows; `None` if disabled or with too few windows.
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
    /// Number of the block of pings whose first ping the selection was made on, from 1.
    pub plan: u32,
    /// Predicted relative error of element samples.
    pub predicted_error: f64,
    /// Predicted core time, milliseconds.
    pub predicted_ms: f64,
    /// Tolerance of the selection.
    pub tolerance: f64,
    /// Elements combined to one ([`Pattern::Part`](crate::arrays::Pattern::Part)); 1 without combination.
    pub part_elements: usize,
}

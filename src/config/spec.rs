//! Checked specifications, in SI units and radians. Only [`parse`](crate::parse) and [`load`](crate::load) make them.
//!
//! A value here has been validated; no stage checks it again.

mod devices;
mod families;
mod faults;
mod methods;
mod output;
mod overload;
mod samples;
mod trigger;
pub(crate) mod words;

pub use faults::{
    ConnectionFault, ElementFault, FaultKind, FaultRefused, FaultRequest, FaultSpec, NavByteFault,
    NavFault, TransportFault,
};

use std::net::{IpAddr, SocketAddr};
use std::path::PathBuf;

use glam::DVec3;

use echotank_core::arrays::{ArrayGeometry, Receiver, TransmitArray};
use echotank_core::model::ModelChoice;
use echotank_core::navigation::NavQuantity;
use echotank_core::ping::Side;
use echotank_core::pulse::Pulse;
use echotank_core::settings::SonarSettings;

pub use devices::{PingDevice, PingProtocolSpec, WbmsSpec};
pub use methods::AutoModel;
pub use output::MadeOutput;
pub use overload::OverloadSpec;
pub use samples::{ElementStreamSpec, SigmfSpec, Vita49Spec, WavSpec};
pub use trigger::{
    EarlyTrigger, ModemLine, OutLine, TriggerFrom, TriggerLineSpec, TriggerOutSpec, TriggerSpec,
};
pub use words::Words;

/// One rig, as a configuration file describes it.
#[derive(Clone, Debug)]
pub struct RigSpec {
    /// The file's own text, for records that carry it.
    pub source_text: String,
    /// Sound speed and absorption.
    pub medium: MediumSpec,
    /// Navigation sources and their evaluation.
    pub nav: NavSpec,
    /// Seabed, points and targets.
    pub scene: SceneSpec,
    /// Timing, threads and delivery.
    pub run: RunSpec,
    /// None: nothing is recorded.
    pub record: Option<RecordSpec>,
    /// Control over HTTP.
    pub control: ControlSpec,
    /// Scheduled faults.
    pub faults: Vec<FaultRequest>,
    /// At least one.
    pub sonars: Vec<SonarSpec>,
}

/// The water.
#[derive(Clone, Debug)]
pub struct MediumSpec {
    /// One value everywhere.
    pub sound_speed_m_per_s: f64,
    /// Absorption law or value.
    pub absorption: AbsorptionSpec,
}

/// How absorption is found.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum AbsorptionSpec {
    /// No absorption.
    None,
    /// dB per metre, one way.
    Fixed {
        /// One way.
        db_per_m: f64,
    },
    /// Francois and Garrison 1982.
    FrancoisGarrison(Water),
    /// Ainslie and McColm 1998.
    AinslieMcColm(Water),
}

/// Properties of the water that the absorption formulas use.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Water {
    /// Degrees Celsius.
    pub temperature_c: f64,
    /// Practical salinity (g/kg within the formulas' accuracy).
    pub salinity: f64,
    /// Metres.
    pub depth_m: f64,
    /// pH value.
    pub ph: f64,
}

/// Navigation sources and their evaluation.
#[derive(Clone, Debug)]
pub struct NavSpec {
    /// The point north = east = 0.
    pub origin: OriginSpec,
    /// Interpolation or extrapolation.
    pub mode: NavMode,
    /// Source of the platform's depth.
    pub vertical: VerticalSpec,
    /// With [`VerticalSpec::Depth`]: depth of the reference point from which the records count heave, metres. None: the records tell no heave.
    pub heave_from_depth_m: Option<f64>,
    /// Source of the records' UTC.
    pub stamp: StampSpec,
    /// Recorded sources start again at their end, time shifted by whole loops.
    pub loop_log: bool,
    /// In `predict`: longest extrapolation, seconds.
    pub max_extrapolation_s: f64,
    /// Depth of the history ring, seconds.
    pub history_s: f64,
    /// The course over ground is the heading if no source provides one.
    ///
    /// None: not configured; a log without heading then decides.
    pub heading_from_course: Option<bool>,
    /// None: the first source that provides a quantity owns it.
    pub failover: Option<FailoverSpec>,
    /// None: no sample is rejected.
    pub jump_gate: Option<JumpGateSpec>,
    /// A source is stale after this time without data, seconds.
    pub stale_s: f64,
    /// A source is lost after this time without data, seconds.
    pub lost_s: f64,
    /// In `predict`: action for a ping that needs data older than `max_extrapolation_s`.
    pub on_lost: OnLost,
    /// The platform is towed, and positions are those of the ship.
    pub tow: Option<TowSpec>,
    /// At least one.
    pub sources: Vec<NavSourceSpec>,
    /// Navigation sent out.
    pub outputs: Vec<NavOutputSpec>,
}

/// What happens to a ping without current navigation.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum OnLost {
    /// It is skipped.
    #[default]
    Skip,
    /// It is made with the last known motion, brought to rest, and flagged invalid.
    Hold,
}

/// A towed body that follows the tow point along the ship's heading.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct TowSpec {
    /// The tow point: forward and starboard of the ship's reference point, down from the waterline; metres.
    pub point_m: DVec3,
    /// Metres.
    pub cable_out_m: f64,
    /// Straight distance over cable length: 1 for a straight cable.
    pub cable_scope: f64,
}

/// One navigation output.
#[derive(Clone, Debug, PartialEq)]
pub struct NavOutputSpec {
    /// Unique among the outputs.
    pub name: String,
    /// Link to the device.
    pub target: NavTargetSpec,
    /// Sentences that are sent, in this order.
    pub sentences: Vec<NavSentence>,
    /// Two capital letters.
    pub talker: String,
    /// Ticks per second.
    pub rate_hz: f64,
    /// Delay of GGA and HDT after their time of validity, seconds.
    pub latency_s: f64,
    /// Pulse at the whole second.
    pub pulse: PulseSpec,
}

/// Link of a navigation output.
#[derive(Clone, Debug, PartialEq)]
pub enum NavTargetSpec {
    /// A host, a broadcast address or a multicast group.
    Udp {
        /// Host, broadcast address or multicast group.
        to: SocketAddr,
    },
    /// A server for any number of clients.
    TcpListen {
        /// Address of the server socket.
        listen: SocketAddr,
    },
    /// A serial port.
    Serial {
        /// Name of the port, such as /dev/ttyUSB0.
        port: String,
        /// Bits per second.
        baud: u32,
        /// Frame format.
        line: SerialLine,
    },
}

/// NMEA 0183 sentence of a navigation output.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum NavSentence {
    /// Date and time.
    Zda,
    /// Position and height.
    Gga,
    /// True heading.
    Hdt,
}

impl NavSentence {
    /// Three-letter formatter.
    pub fn name(self) -> &'static str {
        self.word()
    }
}

/// Pulse at the whole second, before its ZDA.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum PulseSpec {
    /// No pulse.
    #[default]
    None,
    /// The serial port's RTS, or DTR, for 100 ms.
    Rts,
    /// DTR of the serial port.
    Dtr,
    /// One byte, 0x07; over UDP in its own datagram.
    Byte,
}

/// Frame format of a serial port.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct SerialLine {
    /// Parity bit.
    pub parity: ParitySpec,
    /// 5 to 8.
    pub data_bits: u8,
    /// 1 or 2.
    pub stop_bits: u8,
}

impl Default for SerialLine {
    fn default() -> Self {
        Self {
            parity: ParitySpec::None,
            data_bits: 8,
            stop_bits: 1,
        }
    }
}

impl SerialLine {
    /// On the wire: start bit, data, parity and stop bits.
    pub fn bits_per_byte(&self) -> i64 {
        1 + i64::from(self.data_bits)
            + i64::from(self.parity != ParitySpec::None)
            + i64::from(self.stop_bits)
    }

    /// As `8N1`.
    pub fn name(&self) -> String {
        let parity = match self.parity {
            ParitySpec::None => 'N',
            ParitySpec::Even => 'E',
            ParitySpec::Odd => 'O',
        };
        format!("{}{parity}{}", self.data_bits, self.stop_bits)
    }
}

/// Parity bit of a serial frame.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum ParitySpec {
    /// No parity bit.
    #[default]
    None,
    /// Even parity.
    Even,
    /// Odd parity.
    Odd,
}

impl NavSpec {
    /// Depth of the reference point without heave, metres; none if it is not constant.
    pub fn still_depth_m(&self) -> Option<f64> {
        match self.vertical {
            VerticalSpec::Waterline { reference_down_m } => Some(reference_down_m),
            VerticalSpec::Gnss { .. } => None,
            VerticalSpec::Depth => self.heave_from_depth_m,
        }
    }

    /// Every source is recorded: the motion does not depend on the machine's time.
    pub fn is_recorded(&self) -> bool {
        self.sources.iter().all(NavSourceSpec::is_recorded)
    }
}

/// Failover between sources of a quantity.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct FailoverSpec {
    /// The next source takes over after this silence, seconds.
    pub after_s: f64,
    /// The better source becomes active again after it has delivered for this time, seconds.
    pub hold_off_s: f64,
}

/// Limits above which a sample is a jump.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct JumpGateSpec {
    /// Faster samples are rejected.
    pub max_speed_m_per_s: f64,
    /// Of heading, roll and pitch.
    pub max_rate_rad_per_s: f64,
}

/// The point north = east = 0.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum OriginSpec {
    /// The first position of the first source that has one.
    FirstFix,
    /// A fixed point, WGS84.
    Geodetic {
        /// North positive.
        latitude_rad: f64,
        /// East positive.
        longitude_rad: f64,
    },
}

/// Interpolation or extrapolation of navigation.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum NavMode {
    /// Extrapolate with rates to the ping (live default).
    Predict,
    /// Wait until the window is covered by samples on both sides (replay default).
    Settle,
}

impl NavSpec {
    /// True if the records tell the depth of the reference point beside its heave: it is not at the waterline, or a depth sensor gives it.
    pub fn tells_depth(&self) -> bool {
        !matches!(self.vertical, VerticalSpec::Gnss { .. }) && self.still_depth_m() != Some(0.0)
    }
}

/// Source of the reference point's down coordinate.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum VerticalSpec {
    /// The waterline is z = 0; reference point at `reference_down_m` below it, plus heave.
    Waterline {
        /// Depth of the reference point, positive down.
        reference_down_m: f64,
    },
    /// Minus the GNSS height (which already holds heave; heave is then not added), plus `datum_offset_m`.
    Gnss {
        /// Added to the depth.
        datum_offset_m: f64,
    },
    /// Given by a CSV track itself, or by a depth sensor; heave is not added.
    Depth,
}

/// Source of the records' UTC.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum StampSpec {
    /// Time of the navigation.
    Log,
    /// Time of this computer.
    Host,
}

/// One navigation source.
#[derive(Clone, Debug)]
pub struct NavSourceSpec {
    /// Unique among the sources.
    pub name: String,
    /// File or link.
    pub input: NavInputSpec,
    /// Time of validity of a measurement.
    pub time: TimePolicy,
    /// Treatment of NMEA checksums.
    pub checksum: ChecksumPolicy,
    /// Antenna, or depth sensor, in the body, metres; used with this source's positions and depths.
    pub lever_arm_m: DVec3,
    /// How its motion sensor sits in the body.
    pub mounting: SensorMounting,
    /// Format and its variants.
    pub dialect: NavDialect,
    /// Quantities used from this source; the first source in the file that provides a quantity is used.
    pub provides: Vec<NavChannel>,
    /// The configuration does not say what the source provides: `provides` holds what it may provide, and a quantity counts once
    /// it has come. False for a log that has been read: `provides` then holds what the log gives.
    pub detect: bool,
}

impl NavSourceSpec {
    /// Whether every source is a file.
    pub fn is_recorded(&self) -> bool {
        matches!(
            self.input,
            NavInputSpec::Log { .. } | NavInputSpec::Csv { .. }
        )
    }
}

/// A motion sensor's place and attitude in the body; by default at the reference point, along its axes.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct SensorMounting {
    /// Where the heave that it says is that of, metres.
    pub heave_arm_m: DVec3,
    /// Roll, pitch and yaw of the sensor's axes in the body: what it would say on a level platform heading north.
    pub angles_rad: DVec3,
}

/// Format of a source and its deviations from the standard.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct NavDialect {
    /// Format of the bytes.
    pub format: NavFormat,
    /// Sentences, by address or its last three letters, whose checksum is not looked at.
    pub ignore_checksum_for: Vec<String>,
    /// PASHR carries heave + up, against the documented + down.
    pub pashr_heave_up: bool,
    /// DPT, DBT, DBS and DBK say how deep the platform itself is.
    pub depth_is_own: bool,
    /// Quantities with the opposite sign.
    pub reversed: Reversed,
    /// East positive; makes magnetic headings true where the sentence does not say it.
    pub magnetic_variation_rad: Option<f64>,
}

/// Quantities that the source sends with the opposite sign of its documentation.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Reversed {
    /// The sign of roll is inverted.
    pub roll: bool,
    /// The sign of pitch is inverted.
    pub pitch: bool,
    /// The sign of heave is inverted.
    pub heave: bool,
}

/// Format of a source's bytes.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum NavFormat {
    /// NMEA 0183 sentences.
    #[default]
    Nmea,
    /// TSS1 motion sensor strings.
    Tss1,
    /// EM1000 too.
    Em3000,
    /// Kongsberg Seapath binary format 26.
    Seapath26,
    /// Kongsberg KMB binary datagrams.
    Kmb,
}

impl NavFormat {
    /// As the configuration has it.
    pub fn name(self) -> &'static str {
        self.word()
    }
}

/// File or link of a navigation source.
#[derive(Clone, Debug, PartialEq)]
pub enum NavInputSpec {
    /// A recorded log: lines with a time prefix, or plain NMEA. Where neither the lines nor the messages tell the time, sentences come at
    /// `plain_rate_hz`.
    Log {
        /// The log.
        path: PathBuf,
        /// Sentences per second of a log without any time.
        plain_rate_hz: f64,
    },
    /// CSV track: time, north, east, down, roll, pitch, heading.
    Csv {
        /// The track.
        path: PathBuf,
    },
    /// Datagrams.
    Udp {
        /// Local address.
        listen: SocketAddr,
        /// Group to join.
        multicast: Option<std::net::Ipv4Addr>,
    },
    /// A serial port.
    Serial {
        /// Name of the port, such as /dev/ttyUSB0.
        port: String,
        /// Bits per second.
        baud: u32,
        /// Frame format.
        line: SerialLine,
    },
    /// A connection to a server.
    TcpConnect {
        /// Host and port.
        address: String,
    },
    /// A server; its newest client speaks.
    TcpListen {
        /// Local address.
        listen: SocketAddr,
    },
}

/// Where a sample's validity time comes from.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum TimePolicy {
    /// From the message; a message without a time takes its arrival.
    Message,
    /// From the message; a message without a time takes the time of the last dated one of its burst.
    Burst,
    /// Arrival minus this many seconds (0: arrival).
    Arrival {
        /// Subtracted from the arrival time.
        latency_s: f64,
    },
}

/// Treatment of NMEA checksums.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ChecksumPolicy {
    /// Sentences without a valid checksum are rejected.
    Require,
    /// Sentences without a checksum are accepted.
    AcceptMissing,
    /// Checksums are not tested.
    Ignore,
}

/// Quantity of a navigation source.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub enum NavChannel {
    /// Latitude and longitude, or north and east.
    Position,
    /// Course and speed over ground.
    CourseSpeed,
    /// True heading.
    Heading,
    /// Roll and pitch.
    RollPitch,
    /// Vertical motion about the mean.
    Heave,
    /// How deep the platform is.
    Depth,
}

impl NavChannel {
    /// All quantities, in the order of their numbers.
    pub const ALL: [Self; 6] = [
        Self::Position,
        Self::CourseSpeed,
        Self::Heading,
        Self::RollPitch,
        Self::Heave,
        Self::Depth,
    ];

    /// The channel of a measured quantity.
    pub fn of(quantity: &NavQuantity) -> Self {
        match quantity {
            NavQuantity::Position { .. } | NavQuantity::LocalPosition { .. } => Self::Position,
            NavQuantity::CourseSpeed { .. } => Self::CourseSpeed,
            NavQuantity::Heading { .. } => Self::Heading,
            NavQuantity::RollPitch { .. } => Self::RollPitch,
            NavQuantity::Heave { .. } => Self::Heave,
            NavQuantity::Depth { .. } => Self::Depth,
        }
    }

    /// As `provides` has it.
    pub fn name(self) -> &'static str {
        self.word()
    }
}

/// Contents of the water.
#[derive(Clone, Debug)]
pub struct SceneSpec {
    /// Seed of the speckle.
    pub seed: u64,
    /// Position of the scene's origin.
    pub anchor: AnchorSpec,
    /// A gridded seabed continues as mirror images beyond its edge.
    pub mirror: bool,
    /// None: no seabed.
    pub seabed: Option<SeabedSpec>,
    /// Explicit scatterers, CSV.
    pub points: Option<PathBuf>,
    /// Named targets: points over the seabed (CSV) or shapes (`.toml`).
    pub targets: Option<PathBuf>,
    /// Shadow model.
    pub occlusion: OcclusionSpec,
    /// Memory for tiles, bytes.
    pub memory_limit_bytes: u64,
    /// None: every scatterer is used.
    pub simplify: Option<SimplifySpec>,
}

/// Position of the scene's origin.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum AnchorSpec {
    /// At the world's origin.
    Origin,
    /// Under the first position received.
    FirstFix,
    /// At the coordinates in the seabed file.
    File,
}

/// Shadow model.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum OcclusionSpec {
    /// No shadows.
    None,
    /// Seabed and solids cast shadows.
    Horizon,
    /// The seabed casts shadows by Eq. 27 of Meng et al. 2023, as printed.
    Paper,
}

/// The seabed, as scatterers on a surface.
#[derive(Clone, Debug)]
pub struct SeabedSpec {
    /// Depth of the surface.
    pub shape: SeabedShape,
    /// Scatterers per area.
    pub density: Density,
    /// Scattering law.
    pub bottom: BottomSpec,
    /// Reference of the angles on the seabed.
    pub incidence: IncidenceSpec,
    /// Backscattering strengths from a file.
    pub mosaic: Option<MosaicSpec>,
    /// Circular Gaussian reflectivity per scatterer (true) or 1.
    pub speckle: bool,
}

/// Scattering law of the seabed; strengths in dB per square metre.
#[derive(Clone, Debug, PartialEq)]
pub enum BottomSpec {
    /// mu cos i cos s.
    BistaticLambert {
        /// Lambert parameter.
        mu_db: f64,
    },
    /// mu cos^2 i of the incoming ray.
    Lambert {
        /// Lambert parameter.
        mu_db: f64,
    },
    /// Specular lobe, intermediate lobe and Lambert.
    ThreeTerm(ThreeTerm),
    /// Specular, intermediate and Lambert terms.
    Sediment(Sediment),
}

/// Sediment with a three-term scattering law (APL-UW TR 9407, 1994).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Sediment {
    /// Mud.
    Mud,
    /// Silt.
    Silt,
    /// Sand.
    Sand,
    /// Gravel.
    Gravel,
    /// Rock.
    Rock,
}

impl Sediment {
    /// Every sediment.
    pub const ALL: [Self; 5] = [Self::Mud, Self::Silt, Self::Sand, Self::Gravel, Self::Rock];
    /// Name in the configuration.
    pub fn name(self) -> &'static str {
        self.word()
    }
}

/// A exp(-i^2 / 2 B^2) + C cos^D i + E exp(-i^2 / 2 F^2).
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ThreeTerm {
    /// A and B.
    pub specular_db: f64,
    /// Standard deviation of the specular lobe.
    pub specular_rad: f64,
    /// C and D.
    pub lambert_db: f64,
    /// Exponent of the cosine.
    pub lambert_exponent: f64,
    /// E and F.
    pub intermediate_db: f64,
    /// Standard deviation of the intermediate lobe.
    pub intermediate_rad: f64,
}

/// Reference of the angle of incidence.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum IncidenceSpec {
    /// The surface normal.
    Normal,
    /// The vertical (Meng et al. 2023, Eq. 9): correct on flat bottoms only.
    Flat,
}

/// Grid of backscattering strengths in dB, in the formats and coordinates of the seabed.
#[derive(Clone, Debug, PartialEq)]
pub struct MosaicSpec {
    /// File of backscattering strengths.
    pub path: PathBuf,
    /// Coordinate system, if the file names none or a wrong one.
    pub crs: Option<CrsSpec>,
    /// Meaning of the values.
    pub values: MosaicValues,
    /// Moves the mosaic northward.
    pub offset_north_m: f64,
    /// Moves the mosaic eastward.
    pub offset_east_m: f64,
}

/// Meaning of a mosaic's values.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum MosaicValues {
    /// Strengths at this incidence, to which the scattering law is scaled.
    Absolute {
        /// Incidence angle of the strengths.
        incidence_rad: f64,
    },
    /// Values added to the scattering law.
    Relative,
}

/// Number of scatterers per area of seabed.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Density {
    /// Constant, per horizontal square metre.
    PerM2(f64),
    /// At slant range r at least `per_cell` in every r `beam_rad` x `range_m`, the finest resolution cell of any sonar: fewer per square metre the
    /// farther away, out to `longest_range_m`.
    Auto {
        /// Scatterers in the finest resolution cell.
        per_cell: f64,
        /// Range resolution.
        range_m: f64,
        /// Beam width.
        beam_rad: f64,
        /// Longest range of any sonar.
        longest_range_m: f64,
    },
}

/// Depth of the seabed.
#[derive(Clone, Debug)]
pub enum SeabedShape {
    /// z = depth + slope_north x + slope_east y.
    Plane {
        /// Below the scene's origin.
        depth_m: f64,
        /// Metres of depth per metre northward.
        slope_north: f64,
        /// Metres of depth per metre eastward.
        slope_east: f64,
    },
    /// A surveyed seabed. Its centre lies at the scene's origin plus the offset.
    File {
        /// The survey.
        file: SeabedFileSpec,
        /// Moves the survey northward.
        offset_north_m: f64,
        /// Moves the survey eastward.
        offset_east_m: f64,
    },
    /// A seabed of Meng et al. 2023.
    Paper(PaperShape),
}

/// The bottoms of Meng et al. 2023.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum PaperShape {
    /// Fig. 6.
    Curves,
    /// Fig. 12.
    Relief,
    /// Fig. 17, without its piers.
    Lake,
}

impl PaperShape {
    /// Name in the configuration.
    pub fn name(self) -> &'static str {
        self.word()
    }
}

/// Thinning of each ping's scatterers.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SimplifySpec {
    /// Choice of scatterers.
    pub method: SimplifyMethod,
    /// Scatterers of the seabed to keep in a ping.
    pub keep: usize,
    /// Weights of the energy terms.
    pub weights: EnergyWeights,
    /// The choice is renewed after the sonar has moved this far.
    pub hold_m: f64,
    /// The choice is renewed after the sonar has turned this much.
    pub hold_rad: f64,
    /// Find shadows among the scatterers before the choice.
    pub shadows: bool,
}

/// Choice of scatterers.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum SimplifyMethod {
    /// Eqs. 26-29 of Meng et al. 2023, corrected.
    Acoustic,
    /// The same as printed.
    Paper,
    /// Random, with compensated amplitudes.
    Unbiased,
}

impl SimplifyMethod {
    /// Every method.
    pub const ALL: [Self; 3] = [Self::Acoustic, Self::Paper, Self::Unbiased];
    /// Name in the configuration and on the command line.
    pub fn name(self) -> &'static str {
        self.word()
    }
}

/// Weights of the parts of a scatterer's energy.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct EnergyWeights {
    /// Gaussian curvature.
    pub curvature: f64,
    /// Scattered energy.
    pub scattering: f64,
    /// Two-way pattern.
    pub axis: f64,
    /// Of the product of scattering and axis.
    pub echo: f64,
}

impl EnergyWeights {
    /// Equal weights: the paper names three weights and gives no values.
    pub const PAPER: Self = Self {
        curvature: 1.0,
        scattering: 1.0,
        axis: 1.0,
        echo: 0.0,
    };
    /// Weights for [`SimplifyMethod::Unbiased`].
    pub const ECHO: Self = Self {
        curvature: 0.0,
        scattering: 0.0,
        axis: 0.0,
        echo: 1.0,
    };
    /// Default weights of a method.
    pub fn default_of(method: SimplifyMethod) -> Self {
        match method {
            SimplifyMethod::Acoustic | SimplifyMethod::Paper => Self::PAPER,
            SimplifyMethod::Unbiased => Self::ECHO,
        }
    }
}

/// A seabed file and its interpretation. None: as the file says, or detected from its values.
#[derive(Clone, Debug, PartialEq)]
pub struct SeabedFileSpec {
    /// The survey.
    pub path: PathBuf,
    /// None: detected.
    pub format: Option<SeabedFormat>,
    /// None: as the file says.
    pub crs: Option<CrsSpec>,
    /// None: as the file says, or by the sign of most values.
    pub values: Option<HeightSign>,
    /// Position of a grid's first row.
    pub first_row: Option<FirstRow>,
    /// Value of a hole, besides the one that the file names.
    pub nodata: Option<f64>,
    /// Grid cell for soundings, metres.
    pub cell_m: Option<f64>,
    /// Triangles of soundings with a longer edge are holes, metres.
    pub max_edge_m: Option<f64>,
}

impl SeabedFileSpec {
    /// The file as it presents itself.
    pub fn of(path: PathBuf) -> Self {
        Self {
            path,
            format: None,
            crs: None,
            values: None,
            first_row: None,
            nodata: None,
            cell_m: None,
            max_edge_m: None,
        }
    }
}

/// Format of a survey.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum SeabedFormat {
    /// ESRI ASCII grid.
    EsriAscii,
    /// GeoTIFF.
    GeoTiff,
    /// Bathymetric Attributed Grid (HDF5).
    Bag,
    /// Text of three columns.
    Xyz,
    /// LAS point cloud.
    Las,
    /// PLY point cloud.
    Ply,
}

/// Coordinate system of a file.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum CrsSpec {
    /// Metres about an origin without geographic position.
    Local,
    /// Longitude and latitude in degrees, WGS84.
    Geographic,
    /// Metres of a projection that is not converted to latitude and longitude.
    Projected,
    /// Universal transverse Mercator on WGS84.
    Utm {
        /// 1 to 60.
        zone: u8,
        /// Northern hemisphere.
        north: bool,
    },
}

impl std::str::FromStr for CrsSpec {
    type Err = &'static str;

    /// `local`, `geographic`, `projected`, `utm-31n`, `EPSG:4326`, `EPSG:32631`; in any case.
    fn from_str(text: &str) -> Result<Self, Self::Err> {
        const RULE: &str = "must be \"local\", \"geographic\", \"projected\", a zone like \"utm-31n\" or \"utm-19s\", or its number, \"EPSG:32631\"";
        let small = text.trim().to_ascii_lowercase();
        let zone = |digits: &str, north| match digits.parse() {
            Ok(zone) if (1..=60).contains(&zone) => Ok(Self::Utm { zone, north }),
            _ => Err(RULE),
        };
        match small.as_str() {
            "local" => Ok(Self::Local),
            "geographic" | "epsg:4326" => Ok(Self::Geographic),
            "projected" => Ok(Self::Projected),
            other => match (other.strip_prefix("utm-"), other.strip_prefix("epsg:")) {
                (Some(name), _) => match (name.strip_suffix('n'), name.strip_suffix('s')) {
                    (Some(digits), _) => zone(digits, true),
                    (_, Some(digits)) => zone(digits, false),
                    _ => Err(RULE),
                },
                (_, Some(code)) => match (code.strip_prefix("326"), code.strip_prefix("327")) {
                    (Some(digits), _) => zone(digits, true),
                    (_, Some(digits)) => zone(digits, false),
                    _ => Err(RULE),
                },
                _ => Err(RULE),
            },
        }
    }
}

/// Meaning of a survey's heights.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum HeightSign {
    /// Positive up.
    Elevation,
    /// Positive down.
    Depth,
}

/// Position of a grid's first row.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum FirstRow {
    /// At the northern edge.
    North,
    /// At the southern edge.
    South,
}

/// Timing, threads and delivery.
#[derive(Clone, Debug)]
pub struct RunSpec {
    /// 0: one per core.
    pub threads: usize,
    /// Delivery after the end of the window, seconds.
    pub latency_s: f64,
    /// Interval between printed status lines, seconds.
    pub status_interval_s: f64,
    /// Pings that may wait for delivery.
    pub queue_pings: usize,
    /// Clock of the rig.
    pub clock: ClockSpec,
    /// SCHED_FIFO, 1 to 99; 0: ordinary scheduling, and memory is not locked.
    pub priority: u8,
    /// Of the threads that compute pings, -20 to 0.
    pub compute_nice: i8,
    /// Folder of the fault log; none: the folder of the records.
    pub fault_directory: Option<PathBuf>,
    /// Share of the time to the next ping over which a ping's datagrams leave; none: all at once.
    pub spread_share: Option<f64>,
    /// Records over TCP are spread as well.
    pub pace_tcp: bool,
    /// When records leave.
    pub delivery: DeliverySpec,
    /// A streamed ping is computed in tiles, and its first blocks leave meanwhile.
    pub stream_tiles: bool,
    /// What happens when a ping cannot be ready in time.
    pub overload: OverloadSpec,
    /// Minimum computing time of a ping, halved at each looser tolerance, seconds; for testing overload.
    pub simulated_compute_s: f64,
    /// A ping is computed this long before its pulse, from the predicted motion, seconds. Above 0 only in `predict`.
    pub ahead_s: f64,
    /// Cost table of the methods on this machine; none: the built-in table.
    pub costs: Option<PathBuf>,
}

impl RunSpec {
    /// [`RunSpec::ahead_s`] in whole nanoseconds, so that every caller gets the same instant.
    pub fn ahead_ns(&self) -> i64 {
        (self.ahead_s * 1e9).round() as i64
    }

    /// The last instant after a pulse at which its samples are of use: the first block's where they stream, else the ping's delivery. Seconds.
    pub fn ready_after_s(&self, window_s: f64) -> f64 {
        match self.delivery {
            DeliverySpec::PingEnd => window_s + self.latency_s,
            DeliverySpec::Streaming { block_s, latency_s } => block_s + latency_s,
        }
    }
}

/// When element samples leave.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum DeliverySpec {
    /// At the end of the ping, with its other records.
    PingEnd,
    /// In blocks, each a constant time after the reception of its last sample.
    Streaming {
        /// Length of a block, seconds.
        block_s: f64,
        /// Delay of each block after its end, seconds.
        latency_s: f64,
    },
}

/// Speed of rig time. The samples do not depend on it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum ClockSpec {
    /// The computer's time.
    RealTime,
    /// This many times as fast as real time.
    Scaled(f64),
    /// As fast as pings can be computed.
    Fast,
    /// One ping per requested step.
    Lockstep,
}

impl ClockSpec {
    /// Whether rig time advances from pulse to pulse, so that nothing is late.
    pub fn is_own(self) -> bool {
        matches!(self, Self::Fast | Self::Lockstep)
    }
}

/// Where records are stored.
#[derive(Clone, Debug)]
pub struct RecordSpec {
    /// Created if it does not exist.
    pub directory: PathBuf,
}

/// Control over HTTP.
#[derive(Clone, Debug, Default)]
pub struct ControlSpec {
    /// None: no control.
    pub listen: Option<SocketAddr>,
    /// Always present unless `listen` is a loopback address.
    pub token: Option<String>,
    /// If the port of `listen` is taken, any free port is used.
    pub or_any_port: bool,
}

/// One sonar head.
#[derive(Clone, Debug)]
pub struct SonarSpec {
    /// Unique among the sonars.
    pub name: String,
    /// Serial number in the records.
    pub serial: u64,
    /// The transmitted pulse.
    pub pulse: Pulse,
    /// Further pulses in the water together with `pulse`.
    pub more_pulses: Vec<MorePulseSpec>,
    /// Transmit arrays.
    pub transmit: Vec<TransmitArray>,
    /// Names, in the order of `transmit`.
    pub transmit_names: Vec<String>,
    /// Receive arrays.
    pub receive: Vec<ArrayGeometry>,
    /// Names, in the order of `receive`.
    pub receive_names: Vec<String>,
    /// From element voltages to samples.
    pub receiver: Receiver,
    /// Settings at start.
    pub settings: SonarSettings,
    /// Range of each setting.
    pub limits: LimitsSpec,
    /// Source of pings.
    pub trigger: TriggerSpec,
    /// Signals at each pulse.
    pub trigger_out: TriggerOutSpec,
    /// Path, Doppler and synthesis methods.
    pub model: ModelChoice,
    /// Tolerance and error check.
    pub synthesis: SynthesisSpec,
    /// Side-scan lines and fan.
    pub beams: BeamsSpec,
    /// Look of replay pictures.
    pub picture: PictureSpec,
    /// Protocols.
    pub outputs: Vec<OutputSpec>,
}

/// A further pulse.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct MorePulseSpec {
    /// Duration and taper equal those of the sonar's own pulse.
    pub pulse: Pulse,
    /// Delay after the sonar's own pulse.
    pub delay_s: f64,
    /// Index of the transmit array that sends it, to all receive arrays; none: each receive array's own sends it.
    pub transmit: Option<usize>,
}

/// Look of replay pictures.
#[derive(Clone, Debug, PartialEq)]
pub struct PictureSpec {
    /// Across-track axis of the waterfall.
    pub range: PictureRange,
    /// The receiver's time-varying gain is removed.
    pub raw: bool,
    /// Colour map of waterfall and mosaic.
    pub colours: ColourMap,
    /// Limits of the colour scale.
    pub contrast: Contrast,
    /// The mean level at each range is removed.
    pub flatten: bool,
    /// Pixel size across the waterfall; none: 600 pixels per side.
    pub metres_per_pixel: Option<f64>,
    /// Interval between pictures of the fan, pings.
    pub fan_every_pings: u32,
    /// Look of the mosaic.
    pub mosaic: MosaicLook,
}

/// Look of a mosaic.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct MosaicLook {
    /// Pixel size.
    pub metres_per_pixel: f64,
    /// Value of a pixel that several passes cover.
    pub overlap: Overlap,
    /// Directions closer to the vertical are left out.
    pub nadir_rad: f64,
}

/// Value of a pixel that several pings cover.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Overlap {
    /// The mean intensity.
    Mean,
    /// The last ping.
    Last,
    /// The mean over the pings of the nearest pass.
    Nearest,
}

/// Across-track axis of a waterfall.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum PictureRange {
    /// Slant range.
    Slant,
    /// Ground range with a flat bottom at the true depth under the sonar.
    Ground,
    /// Ground range with a flat bottom at the range of the first bottom echo.
    GroundFirstReturn,
}

/// Limits of the colour scale.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Contrast {
    /// Shares (0 to 1) of the picture's own pixels that lie below darkest and below brightest.
    Percentiles {
        /// Share of the darkest pixels, 0 to 1.
        low: f64,
        /// Share of the pixels below the brightest, 0 to 1.
        high: f64,
    },
    /// dB re 1 V; over the mean at that range where the picture is flattened.
    Fixed {
        /// Level of the darkest colour, dB re 1 V.
        low_db: f64,
        /// Level of the brightest colour, dB re 1 V.
        high_db: f64,
    },
}

/// Colours from dark to bright.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ColourMap {
    /// Black to white.
    Grey,
    /// Black, brown, gold, pale yellow: side-scan paper.
    Copper,
    /// Dark blue to white through cyan: water columns.
    Blue,
    /// Blue, green, yellow, red: echo strength, and depth turned round.
    Rainbow,
}

impl Default for PictureSpec {
    fn default() -> Self {
        Self {
            range: PictureRange::Slant,
            raw: false,
            colours: ColourMap::Copper,
            // The water column, about a third of a picture, is dark; the seabed fills the middle, and little is brightest.
            contrast: Contrast::Percentiles {
                low: 0.28,
                high: 0.99997,
            },
            flatten: false,
            metres_per_pixel: None,
            fan_every_pings: 100,
            mosaic: MosaicLook {
                metres_per_pixel: 0.25,
                overlap: Overlap::Nearest,
                nadir_rad: 0.0,
            },
        }
    }
}

/// Tolerance, error check and options of the synthesis.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SynthesisSpec {
    /// Relative error of element samples in any window of a pulse's length, before noise and converter: what engines are made for, and what a
    /// error check is held to.
    pub tolerance: f64,
    /// Recompute random samples with the reference.
    pub error_check: bool,
    /// Step of `spectral`'s frequency grid; none: one over the longest record, or finer.
    pub frequency_step_hz: Option<f64>,
    /// Range of the nearest scatterer that `gridded-2d` is designed for.
    pub nearest_m: f64,
    /// Tolerance of the engine, where models need the rest of `tolerance`; none: all of it.
    pub engine_tolerance: Option<f64>,
    /// Methods that are chosen automatically.
    pub auto: AutoModel,
    /// Range cells by which echoes may be displaced if only pictures are used; none: the sample tolerance applies.
    pub image_cells: Option<f64>,
    /// Element samples or side-scan lines.
    pub output: MadeOutput,
    /// Why elements are required; none: only side-scan lines are.
    pub elements_for: Option<&'static str>,
}

impl SynthesisSpec {
    /// The tolerance that the engine is built for.
    pub fn made_for(&self) -> f64 {
        self.engine_tolerance.unwrap_or(self.tolerance)
    }
}

impl Default for SynthesisSpec {
    fn default() -> Self {
        Self {
            tolerance: 1e-3,
            error_check: false,
            frequency_step_hz: None,
            nearest_m: 5.0,
            engine_tolerance: None,
            auto: AutoModel::default(),
            image_cells: None,
            output: MadeOutput::Elements,
            elements_for: None,
        }
    }
}

pub use echotank_core::settings::SettingLimits as LimitsSpec;
pub use families::{ImagenexSpec, JsfChannels, JsfFormat, JsfSpec, XtfSpec};

/// Side-scan lines and a fan of beams.
#[derive(Clone, Debug, Default)]
pub struct BeamsSpec {
    /// Side-scan lines and their receive arrays.
    pub lines: Vec<LineSpec>,
    /// Side-scan lines are focused along range.
    pub focused_lines: bool,
    /// Range over the used array length, for focused lines; none: the whole array.
    pub line_f_number: Option<f64>,
    /// Shading along the array, for focused lines.
    pub line_shading: Shading,
    /// None: no fan.
    pub fan: Option<FanSpec>,
    /// Window of every matched filter.
    pub weighting: Shading,
    /// None: no synthetic aperture.
    pub synthetic_aperture: Option<SyntheticApertureSpec>,
}

/// Horizontal area onto which a replay's pings are back-projected.
#[derive(Clone, Debug, PartialEq)]
pub struct SyntheticApertureSpec {
    /// Indices of the receive arrays that are used.
    pub arrays: Vec<usize>,
    /// Southern and northern edge.
    pub north_m: (f64, f64),
    /// Western and eastern edge.
    pub east_m: (f64, f64),
    /// Depth of all pixels.
    pub down_m: f64,
    /// Pixel size.
    pub cell_m: f64,
}

impl SyntheticApertureSpec {
    /// Columns (west to east) and rows.
    pub fn size(&self) -> (usize, usize) {
        let cells = |(from, to): (f64, f64)| ((to - from) / self.cell_m - 1e-9).ceil() as usize;
        (cells(self.east_m).max(1), cells(self.north_m).max(1))
    }
}

/// A side-scan line.
#[derive(Clone, Debug)]
pub struct LineSpec {
    /// Side that the array looks to.
    pub side: Side,
    /// Index of the receive array.
    pub array: usize,
}

/// A fan of beams.
#[derive(Clone, Debug)]
pub struct FanSpec {
    /// Index of the receive array.
    pub array: usize,
    /// Number of beams.
    pub beams: usize,
    /// From port-most to starboard-most, radians.
    pub sector_rad: f64,
    /// Shading along the array.
    pub shading: Shading,
    /// Beamformer and its parameters.
    pub form: FanForm,
}

/// Distribution and forming of a fan's beams.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct FanForm {
    /// Beamforming method.
    pub former: Former,
    /// Distribution of the beams over the sector.
    pub spacing: BeamSpacing,
    /// Middle of the sector, from the boresight.
    pub center_rad: f64,
    /// Beam angles count from the vertical.
    pub roll_stabilised: bool,
    /// Range over the used array length with `dynamic-focus`; none: the whole array.
    pub f_number: Option<f64>,
    /// Maximum carrier phase error at the ends of a focal zone with `dynamic-focus`.
    pub focus_error_rad: f64,
    /// Detect the bottom in every beam.
    pub bottom_detection: bool,
}

impl Default for FanForm {
    fn default() -> Self {
        Self {
            former: Former::Exact,
            spacing: BeamSpacing::EquiAngle,
            center_rad: 0.0,
            roll_stabilised: false,
            f_number: None,
            focus_error_rad: 0.1,
            bottom_detection: false,
        }
    }
}

/// Beamforming method.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Former {
    /// Far field, true time delays at every frequency, f64.
    Exact,
    /// The same with FFTs over time and array, f32.
    Fft,
    /// Far field, true time delays to a fraction of a sample, f32.
    TimeDelay,
    /// Far field, carrier phases only.
    Phase,
    /// Near field, refocused along range, with the receiver's motion.
    DynamicFocus,
}

impl Former {
    /// Name in the configuration.
    pub fn name(self) -> &'static str {
        self.word()
    }
}

/// Distribution of the beams over the sector.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum BeamSpacing {
    /// Equal steps of angle.
    EquiAngle,
    /// Equal steps of distance on a flat bottom.
    EquiDistant,
    /// Equal steps of sine, as from an FFT over the array.
    EquiSine,
}

impl BeamSpacing {
    /// Name in the configuration.
    pub fn name(self) -> &'static str {
        self.word()
    }
}

/// Weights along an aperture or a pulse; side lobes are positive, dB under the main lobe.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub enum Shading {
    /// No shading.
    #[default]
    Uniform,
    /// Hann window.
    Hann,
    /// Hamming window.
    Hamming,
    /// Taylor window.
    Taylor {
        /// Below the main lobe.
        side_lobe_db: f64,
    },
    /// Chebyshev window; along a pulse the Taylor window of the same side lobes.
    Chebyshev {
        /// Below the main lobe.
        side_lobe_db: f64,
    },
    /// Kaiser window.
    Kaiser {
        /// Shape parameter.
        beta: f64,
    },
}

impl Shading {
    /// Name in the configuration.
    pub fn name(self) -> &'static str {
        match self {
            Self::Uniform => "uniform",
            Self::Hann => "hann",
            Self::Hamming => "hamming",
            Self::Taylor { .. } => "taylor",
            Self::Chebyshev { .. } => "chebyshev",
            Self::Kaiser { .. } => "kaiser",
        }
    }
}

/// A protocol and its parameters.
#[derive(Clone, Debug)]
pub enum OutputSpec {
    /// Teledyne RESON 7k.
    SevenK(SevenKSpec),
    /// EdgeTech JSF.
    Jsf(JsfSpec),
    /// Triton XTF.
    Xtf(XtfSpec),
    /// Imagenex 872.
    Imagenex872(ImagenexSpec),
    /// ANSI/VITA 49.2.
    Vita49(Vita49Spec),
    /// Element stream.
    Elements(ElementStreamSpec),
    /// SigMF recording.
    Sigmf(SigmfSpec),
    /// Multichannel WAV recording.
    Wav(WavSpec),
    /// Ping protocol.
    Ping(PingProtocolSpec),
    /// NORBIT WBMS.
    Wbms(WbmsSpec),
}

/// Teledyne RESON 7k output.
#[derive(Clone, Debug)]
pub struct SevenKSpec {
    /// TCP and UDP address.
    pub listen: SocketAddr,
    /// 7k device identifier.
    pub device_id: u32,
    /// Distinguishes heads with the same device identifier.
    pub enumerator: u16,
    /// Indices of the receive arrays of record 7038, in this order.
    pub arrays: Vec<usize>,
    /// Files leave out records that common readers do not know.
    pub has_common_files: bool,
    /// Packet length with network frame, bytes.
    pub max_packet: usize,
    /// Queue of one client; further records are dropped.
    pub client_queue_bytes: usize,
    /// A client with a full queue is disconnected instead of missing records.
    pub disconnect_when_full: bool,
    /// Addresses, besides a client's own, to which a client may have records sent.
    pub third_parties: Vec<IpAddr>,
    /// Connections at the same time.
    pub max_clients: usize,
}

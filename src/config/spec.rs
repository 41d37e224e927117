//! Checked specifications, in SI units and radians. Only [`parse`](crate::parse) and [`load`](crate::load) make them.
//!
//! A specification has been validated. Later stages do not check its values again.

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
    ConnectionFault, ElementFault, FaultCatalogueEntry, FaultKind, FaultRefused, FaultRequest,
    FaultSpec, NavByteFault, NavFault, TransportFault,
};

use std::net::{IpAddr, SocketAddr};
use std::path::PathBuf;
use std::sync::Arc;

use glam::DVec3;

use echotank_core::arrays::{ArrayGeometry, Receiver, TransmitArray};
use echotank_core::instrument::Instrument;
use echotank_core::model::ModelChoice;
use echotank_core::navigation::NavQuantity;
use echotank_core::ping::Side;
use echotank_core::pulse::Pulse;
use echotank_core::scene::ResolutionCell;
use echotank_core::settings::SonarSettings;
use echotank_core::sound_speed::SoundSpeedProfile;

pub use devices::{PingDevice, PingProtocolSpec, WbmsSpec};
pub use methods::AutoModel;
pub use output::SynthesisOutput;
pub use overload::OverloadSpec;
pub use samples::{ElementStreamSpec, McapSpec, SigmfSpec, Vita49Spec, WavSpec};
pub use trigger::{
    EarlyTrigger, ModemLine, OutLine, TriggerFrom, TriggerLineSpec, TriggerOutSpec, TriggerSpec,
};
pub use words::NamedChoice;

/// One rig, as a configuration file describes it.
#[derive(Clone, Debug)]
pub struct RigSpec {
    /// Text of the configuration file, for records that include it.
    pub source_text: String,
    /// Sound speed and absorption of the water.
    pub medium: MediumSpec,
    /// Navigation sources and the processing of their samples.
    pub nav: NavSpec,
    /// Seabed, points and targets.
    pub scene: SceneSpec,
    /// Timing, threads and delivery.
    pub run: RunSpec,
    /// Recording; `None` records nothing.
    pub record: Option<RecordSpec>,
    /// Control over HTTP.
    pub control: ControlSpec,
    /// Scheduled faults.
    pub faults: Vec<FaultRequest>,
    /// Sonars, at least one.
    pub sonars: Vec<SonarSpec>,
}

/// Acoustic properties of the water.
#[derive(Clone, Debug)]
pub struct MediumSpec {
    /// Sound speed, the same everywhere. With a profile its lowest speed, by which windows and buffers are long enough for every echo within range.
    pub sound_speed_m_per_s: f64,
    /// Sound speed over depth, if it changes.
    pub profile: Option<Arc<SoundSpeedProfile>>,
    /// Absorption law or value.
    pub absorption: AbsorptionSpec,
    /// Wind over the surface, metres per second.
    pub wind_m_per_s: f64,
    /// The sea surface; `None`: calm, and it scatters nothing.
    pub surface: Option<SurfaceSpec>,
    /// Echoes by way of surface and bottom, if they are computed.
    pub multipath: Option<MultipathSpec>,
    /// Volume reverberation, if there is any.
    pub volume: Option<VolumeSpec>,
}

/// The sea surface.
#[derive(Clone, Debug)]
pub struct SurfaceSpec {
    /// Wind speed at a height of 10 m, m/s.
    pub wind_m_per_s: f64,
    /// Rms height, metres, if not by the wind.
    pub roughness_m: Option<f64>,
    /// Rms slope, radians, if not by the wind.
    pub slope_rad: Option<f64>,
    /// Depth of the mean surface below the world's vertical origin, metres.
    pub down_m: f64,
    /// Where the wind comes from, radians clockwise from north; `None`: waves from all directions alike.
    pub wind_from_rad: Option<f64>,
    /// Whether its height moves reflections.
    pub heights: bool,
    /// How it scatters, if it does.
    pub scattering: Option<SurfaceScatteringSpec>,
}

/// Scattering by the sea surface.
#[derive(Clone, Debug)]
pub struct SurfaceScatteringSpec {
    /// Number of scatterers per area.
    pub density: Density,
    /// Time in which it changes, seconds.
    pub correlation_time_s: f64,
    /// Whether it moves with the waves.
    pub waves: bool,
}

/// Echoes by way of the surface and the bottom. Ratios and roughness of the bottom that are not given follow from its sediment.
#[derive(Clone, Debug, PartialEq)]
pub struct MultipathSpec {
    /// Also up to the surface and down to the bottom.
    pub surface_bottom: bool,
    /// Density relative to the water's.
    pub bottom_density_ratio: Option<f64>,
    /// Sound speed relative to the water's.
    pub bottom_speed_ratio: Option<f64>,
    /// Rms height of the bottom, metres.
    pub bottom_roughness_m: Option<f64>,
    /// Rms slope of the bottom's facets, radians.
    pub bottom_slope_rad: f64,
}

/// Volume reverberation.
#[derive(Clone, Debug, PartialEq)]
pub struct VolumeSpec {
    /// Layers without overlap, at least one, the shallowest first.
    pub layers: Vec<VolumeLayer>,
    /// Scatterers in each resolution cell.
    pub scatterers_per_cell: f64,
    /// Least distance of a scatterer from the transmitter, metres.
    pub nearest_m: f64,
}

/// Layer of water with one volume scattering strength.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct VolumeLayer {
    /// Depth of the upper edge, metres.
    pub top_m: f64,
    /// Depth of the lower edge, metres.
    pub bottom_m: f64,
    /// Volume scattering strength, dB re 1/m.
    pub sv_db: f64,
}

/// Absorption law.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum AbsorptionSpec {
    /// No absorption.
    None,
    /// Fixed absorption.
    Fixed {
        /// One-way absorption, dB per metre.
        db_per_m: f64,
    },
    /// Francois and Garrison 1982.
    FrancoisGarrison(Water),
    /// Ainslie and McColm 1998.
    AinslieMcColm(Water),
}

/// Properties of the water in the absorption formulas.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Water {
    /// Temperature, degrees Celsius.
    pub temperature_c: f64,
    /// Practical salinity. It equals g/kg within the accuracy of the formulas.
    pub salinity: f64,
    /// Depth, metres.
    pub depth_m: f64,
    /// pH value.
    pub ph: f64,
}

/// Navigation sources and the processing of their samples.
#[derive(Clone, Debug)]
pub struct NavSpec {
    /// World origin: the point north = east = 0.
    pub origin: OriginSpec,
    /// Interpolation or extrapolation of the samples.
    pub mode: NavMode,
    /// Source of the platform's depth.
    pub vertical: VerticalSpec,
    /// With [`VerticalSpec::Depth`]: depth of the reference point at which the heave of the records is zero, metres. `None`: the
    /// records have no heave.
    pub heave_from_depth_m: Option<f64>,
    /// Clock of the UTC in the records.
    pub stamp: StampSpec,
    /// True if recorded sources restart at their end. Each repetition shifts the times by the length of the log.
    pub loop_log: bool,
    /// Maximum extrapolation in mode `predict`, seconds.
    pub max_extrapolation_s: f64,
    /// Length of the history of samples, seconds.
    pub history_s: f64,
    /// True if the course over ground is the heading when no source provides a heading.
    ///
    /// `None` if not configured. A log without heading then enables this rule.
    pub heading_from_course: Option<bool>,
    /// Failover between sources. `None`: the first source that provides a quantity is always used.
    pub failover: Option<FailoverSpec>,
    /// Rejection of jumps. `None`: no sample is rejected.
    pub jump_gate: Option<JumpGateSpec>,
    /// Time without data after which a source is stale, seconds.
    pub stale_s: f64,
    /// Time without data after which a source is lost, seconds.
    pub lost_s: f64,
    /// In mode `predict`: action for a ping that needs data older than `max_extrapolation_s`.
    pub on_lost: OnLost,
    /// Towing. If present, the platform is towed, and positions are those of the ship.
    pub tow: Option<TowSpec>,
    /// Navigation sources, at least one.
    pub sources: Vec<NavSourceSpec>,
    /// Recording that takes the place of the live sources in a replay. A configuration never sets it.
    pub recording: Option<PathBuf>,
    /// Outputs of navigation sentences.
    pub outputs: Vec<NavOutputSpec>,
}

/// Action for a ping without current navigation.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum OnLost {
    /// The ping is skipped.
    #[default]
    Skip,
    /// The ping uses the last known motion, brought to rest, and is flagged invalid.
    Hold,
}

/// A towed body that follows the tow point along the ship's heading.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct TowSpec {
    /// Tow point, metres: forward and starboard of the ship's reference point, down from the waterline.
    pub point_m: DVec3,
    /// Length of the deployed cable, metres.
    pub cable_out_m: f64,
    /// Ratio of the straight distance to the cable length: 1 for a straight cable.
    pub cable_scope: f64,
}

/// Output of navigation sentences to one device.
#[derive(Clone, Debug, PartialEq)]
pub struct NavOutputSpec {
    /// Name, unique among the outputs.
    pub name: String,
    /// Connection to the device.
    pub target: NavTargetSpec,
    /// Sentences in the order of transmission.
    pub sentences: Vec<NavSentence>,
    /// Talker identifier: two capital letters.
    pub talker: String,
    /// Output rate, hertz.
    pub rate_hz: f64,
    /// Delay of GGA and HDT after the time of validity, seconds.
    pub latency_s: f64,
    /// Pulse that marks the whole second.
    pub pulse: PulseSpec,
}

/// Connection of a navigation output.
#[derive(Clone, Debug, PartialEq)]
pub enum NavTargetSpec {
    /// Datagrams to a host, a broadcast address or a multicast group.
    Udp {
        /// Host, broadcast address or multicast group.
        to: SocketAddr,
    },
    /// TCP server for any number of clients.
    TcpListen {
        /// Address of the server.
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

/// NMEA 0183 sentence type of a navigation output.
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
    /// Three-letter sentence formatter.
    pub fn name(self) -> &'static str {
        self.word()
    }
}

/// Pulse that marks the whole second, before the ZDA of that second.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum PulseSpec {
    /// No pulse.
    #[default]
    None,
    /// Active RTS line of the serial port for 100 ms.
    Rts,
    /// Active DTR line of the serial port for 100 ms.
    Dtr,
    /// Byte 0x07; over UDP in a separate datagram.
    Byte,
}

/// Frame format of a serial port.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct SerialLine {
    /// Parity bit.
    pub parity: ParitySpec,
    /// Number of data bits, 5 to 8.
    pub data_bits: u8,
    /// Number of stop bits, 1 or 2.
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
    /// Bits of one byte on the link: start bit, data, parity and stop bits.
    pub fn bits_per_byte(&self) -> i64 {
        1 + i64::from(self.data_bits)
            + i64::from(self.parity != ParitySpec::None)
            + i64::from(self.stop_bits)
    }

    /// Name in the notation `8N1`.
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
    /// Depth of the reference point without heave, metres; `None` if not constant.
    pub fn still_depth_m(&self) -> Option<f64> {
        match self.vertical {
            VerticalSpec::Waterline { reference_down_m } => Some(reference_down_m),
            VerticalSpec::Gnss { .. } => None,
            VerticalSpec::Depth => self.heave_from_depth_m,
        }
    }

    /// Whether every source is recorded. The motion then does not depend on the computer's time.
    pub fn is_recorded(&self) -> bool {
        self.sources.iter().all(NavSourceSpec::is_recorded)
    }
}

/// Parameters of the failover between sources of a quantity.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct FailoverSpec {
    /// Silence of the active source after which the next source takes over, seconds.
    pub after_s: f64,
    /// Time for which the better source must deliver before it becomes active again, seconds.
    pub hold_off_s: f64,
}

/// Limits of the jump gate. Samples above a limit are jumps.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct JumpGateSpec {
    /// Maximum speed between positions, metres per second.
    pub max_speed_m_per_s: f64,
    /// Maximum rate of heading, roll and pitch, radians per second.
    pub max_rate_rad_per_s: f64,
}

/// Origin of the world coordinates.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum OriginSpec {
    /// First position of the first source that has positions.
    FirstFix,
    /// Fixed point on WGS84.
    Geodetic {
        /// Latitude, radians, positive north.
        latitude_rad: f64,
        /// Longitude, radians, positive east.
        longitude_rad: f64,
    },
}

/// Processing of navigation samples at the time of a ping.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum NavMode {
    /// Extrapolation with rates to the ping (default of live sources).
    Predict,
    /// Interpolation. The ping waits for samples after its window (default of recorded sources).
    Settle,
}

impl NavSpec {
    /// Whether the records have the depth of the reference point besides its heave. True if the reference point is not at the
    /// waterline, or a depth sensor is used.
    pub fn has_depth(&self) -> bool {
        !matches!(self.vertical, VerticalSpec::Gnss { .. }) && self.still_depth_m() != Some(0.0)
    }
}

/// Source of the down coordinate of the reference point.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum VerticalSpec {
    /// Constant depth `reference_down_m` below the waterline z = 0, plus heave.
    Waterline {
        /// Depth of the reference point, metres, positive down.
        reference_down_m: f64,
    },
    /// Negative GNSS height plus `datum_offset_m`. The height already includes heave, so heave is not added.
    Gnss {
        /// Offset added to the depth, metres.
        datum_offset_m: f64,
    },
    /// Depth from a CSV track or a depth sensor. Heave is not added.
    Depth,
}

/// Clock of the UTC in the records.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum StampSpec {
    /// Time of the navigation samples.
    Log,
    /// Time of this computer.
    Host,
}

/// Navigation source: input, format, mounting and provided quantities.
#[derive(Clone, Debug)]
pub struct NavSourceSpec {
    /// Name, unique among the sources.
    pub name: String,
    /// File or connection.
    pub input: NavInputSpec,
    /// Rule for the time of validity of a measurement.
    pub time: TimePolicy,
    /// Rule for NMEA checksums.
    pub checksum: ChecksumPolicy,
    /// Position of the antenna or depth sensor in the body, metres. Used with the positions and depths of this source.
    pub lever_arm_m: DVec3,
    /// Mounting of the motion sensor in the body.
    pub mounting: SensorMounting,
    /// Format of the bytes, and its variants.
    pub dialect: NavDialect,
    /// Quantities used from this source. If several sources provide a quantity, the first source in the file is used.
    pub provides: Vec<NavChannel>,
    /// True if the configuration does not list the quantities. `provides` then has the quantities that the source may provide, and
    /// a quantity counts after its first sample. False for a log that has been read: `provides` then has the quantities of the log.
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

/// Position and orientation of a motion sensor in the body. The default is at the reference point, aligned with the body.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct SensorMounting {
    /// Position of the point whose heave the sensor measures, metres.
    pub heave_arm_m: DVec3,
    /// Roll, pitch and yaw of the sensor axes in the body, radians: the measurement on a level platform heading north.
    pub angles_rad: DVec3,
}

/// Format of a navigation source, and its deviations from the standard.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct NavDialect {
    /// Format of the bytes.
    pub format: NavFormat,
    /// Sentences with ignored checksums, by address or by the last three letters of the address.
    pub ignore_checksum_for: Vec<String>,
    /// True if PASHR has heave positive up. The documented sign is positive down.
    pub pashr_heave_up: bool,
    /// True if DPT, DBT, DBS and DBK measure the depth of the platform.
    pub depth_is_own: bool,
    /// Quantities with the opposite sign.
    pub reversed: Reversed,
    /// Magnetic variation, radians, positive east. It converts magnetic headings to true headings if the sentence has no variation.
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

/// Format of the bytes of a source.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum NavFormat {
    /// NMEA 0183 sentences.
    #[default]
    Nmea,
    /// TSS1 motion sensor strings.
    Tss1,
    /// Records of EM1000 and EM3000 motion sensors.
    Em3000,
    /// Kongsberg Seapath binary format 26.
    Seapath26,
    /// Kongsberg KMB binary datagrams.
    Kmb,
}

impl NavFormat {
    /// Name in the configuration.
    pub fn name(self) -> &'static str {
        self.word()
    }
}

/// File or connection of a navigation source.
#[derive(Clone, Debug, PartialEq)]
pub enum NavInputSpec {
    /// Recorded log: lines with a time stamp, or plain NMEA. If neither lines nor messages have a time, sentences arrive at
    /// `plain_rate_hz`.
    Log {
        /// Path of the log.
        path: PathBuf,
        /// Rate of the sentences of a log without any time, hertz.
        plain_rate_hz: f64,
    },
    /// CSV track: time, north, east, down, roll, pitch, heading.
    Csv {
        /// Path of the track.
        path: PathBuf,
    },
    /// UDP datagrams.
    Udp {
        /// Local address.
        listen: SocketAddr,
        /// Multicast group to join.
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
    /// TCP connection to a server.
    TcpConnect {
        /// Host and port of the server.
        address: String,
    },
    /// TCP server. Only the newest client is read.
    TcpListen {
        /// Local address.
        listen: SocketAddr,
    },
}

/// Rule for the time of validity of a sample.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum TimePolicy {
    /// Time of the message. A message without a time uses its arrival.
    Message,
    /// Time of the message. A message without a time uses the time of the last timed message of its burst.
    Burst,
    /// Arrival minus `latency_s`.
    Arrival {
        /// Latency subtracted from the arrival, seconds.
        latency_s: f64,
    },
}

/// Rule for NMEA checksums.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ChecksumPolicy {
    /// Sentences without a valid checksum are rejected.
    Require,
    /// Sentences without a checksum are accepted.
    AcceptMissing,
    /// Checksums are not tested.
    Ignore,
}

/// Quantity measured by a navigation source.
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
    /// Heave.
    Heave,
    /// Depth of the platform.
    Depth,
}

impl NavChannel {
    /// All quantities, in the order of their indices.
    pub const ALL: [Self; 6] = [
        Self::Position,
        Self::CourseSpeed,
        Self::Heading,
        Self::RollPitch,
        Self::Heave,
        Self::Depth,
    ];

    /// The quantity of a measured value.
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

    /// Name in the key `provides`.
    pub fn name(self) -> &'static str {
        self.word()
    }
}

/// Seabed, points and targets in the water.
#[derive(Clone, Debug)]
pub struct SceneSpec {
    /// Seed of the random reflectivities.
    pub seed: u64,
    /// Position of the scene's origin in the world.
    pub anchor: AnchorSpec,
    /// True if a gridded seabed continues as mirror images beyond its edge.
    pub mirror: bool,
    /// Seabed; `None` for a scene without seabed.
    pub seabed: Option<SeabedSpec>,
    /// CSV file of explicit scatterers.
    pub points: Option<PathBuf>,
    /// File of named targets: points over the seabed (CSV) or shapes (`.toml`).
    pub targets: Option<PathBuf>,
    /// Shadow model.
    pub occlusion: OcclusionSpec,
    /// Maximum memory of the tiles, bytes.
    pub memory_limit_bytes: u64,
    /// Simplification; `None` uses every scatterer.
    pub simplify: Option<SimplifySpec>,
}

/// Position of the scene's origin in the world.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum AnchorSpec {
    /// The world's origin.
    Origin,
    /// The horizontal position of the first fix.
    FirstFix,
    /// The coordinates in the seabed file.
    File,
}

/// Shadow model.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum OcclusionSpec {
    /// No shadows.
    None,
    /// Shadows of the seabed and of solids.
    Horizon,
    /// Shadows of the seabed by Eq. 27 of Meng et al. 2023, as printed.
    Paper,
}

/// Seabed, modelled as scatterers on a surface.
#[derive(Clone, Debug)]
pub struct SeabedSpec {
    /// Shape of the surface.
    pub shape: SeabedShape,
    /// Number of scatterers per area.
    pub density: Density,
    /// Scattering law.
    pub bottom: BottomSpec,
    /// Reference direction of the angle of incidence.
    pub incidence: IncidenceSpec,
    /// Map of backscattering strengths from a file.
    pub mosaic: Option<MosaicSpec>,
    /// True for a circular Gaussian reflectivity of each scatterer, false for the constant 1.
    pub speckle: bool,
}

/// Scattering law of the seabed. Strengths are in dB per square metre.
#[derive(Clone, Debug, PartialEq)]
pub enum BottomSpec {
    /// Strength mu cos i cos s (bistatic Lambert).
    BistaticLambert {
        /// Lambert parameter mu, dB.
        mu_db: f64,
    },
    /// Strength mu cos^2 i of the incident ray.
    Lambert {
        /// Lambert parameter mu, dB.
        mu_db: f64,
    },
    /// Sum of a specular lobe, an intermediate lobe and a Lambert term.
    ThreeTerm(ThreeTerm),
    /// The same sum, with the parameters of a sediment.
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
    /// All sediments.
    pub const ALL: [Self; 5] = [Self::Mud, Self::Silt, Self::Sand, Self::Gravel, Self::Rock];
    /// Name in the configuration.
    pub fn name(self) -> &'static str {
        self.word()
    }
}

/// Parameters of the strength A exp(-i^2 / 2 B^2) + C cos^D i + E exp(-i^2 / 2 F^2).
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ThreeTerm {
    /// A, dB.
    pub specular_db: f64,
    /// B: standard deviation of the specular lobe, radians.
    pub specular_rad: f64,
    /// C, dB.
    pub lambert_db: f64,
    /// D: exponent of the cosine.
    pub lambert_exponent: f64,
    /// E, dB.
    pub intermediate_db: f64,
    /// F: standard deviation of the intermediate lobe, radians.
    pub intermediate_rad: f64,
}

/// Reference direction of the angle of incidence.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum IncidenceSpec {
    /// Normal of the surface.
    Normal,
    /// Vertical (Meng et al. 2023, Eq. 9). Correct only on flat seabeds.
    Flat,
}

/// Grid of backscattering strengths in dB, in the formats and coordinate systems of the seabed.
#[derive(Clone, Debug, PartialEq)]
pub struct MosaicSpec {
    /// Path of the grid.
    pub path: PathBuf,
    /// Coordinate system, if the file has none or a wrong one.
    pub crs: Option<CrsSpec>,
    /// Meaning of the values.
    pub values: MosaicValues,
    /// Northward shift of the mosaic, metres.
    pub offset_north_m: f64,
    /// Eastward shift of the mosaic, metres.
    pub offset_east_m: f64,
}

/// Meaning of a mosaic's values.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum MosaicValues {
    /// Strengths at one angle of incidence. The scattering law is scaled to them.
    Absolute {
        /// Angle of incidence of the strengths, radians.
        incidence_rad: f64,
    },
    /// Differences to the scattering law.
    Relative,
}

/// Number of scatterers per area of seabed.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Density {
    /// Constant number per horizontal square metre.
    PerM2(f64),
    /// `per_cell` in every resolution cell of an array's main lobe, and fewer in its side lobes.
    Auto {
        /// Scatterers in a resolution cell.
        per_cell: f64,
        /// Finest resolution cell of any sonar with any pulse, metres and radians.
        cell: ResolutionCell,
        /// Maximum range of any sonar, metres.
        longest_range_m: f64,
        /// Probability that a ping keeps a scatterer of a side lobe, over its two-way pressure relative to the main lobe's.
        lobes: f64,
    },
}

/// Shape of the seabed.
#[derive(Clone, Debug)]
pub enum SeabedShape {
    /// Plane: z = depth + slope_north x + slope_east y.
    Plane {
        /// Depth below the scene's origin, metres.
        depth_m: f64,
        /// Change of depth per metre northward.
        slope_north: f64,
        /// Change of depth per metre eastward.
        slope_east: f64,
    },
    /// Surveyed seabed. Its centre is at the scene's origin plus the offset.
    File {
        /// File of the survey.
        file: SeabedFileSpec,
        /// Northward shift of the survey, metres.
        offset_north_m: f64,
        /// Eastward shift of the survey, metres.
        offset_east_m: f64,
    },
    /// Analytic seabed of Meng et al. 2023.
    Paper(PaperShape),
}

/// Analytic seabeds of Meng et al. 2023.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum PaperShape {
    /// Seabed of Fig. 6.
    Curves,
    /// Seabed of Fig. 12.
    Relief,
    /// Seabed of Fig. 17, without its piers.
    Lake,
}

impl PaperShape {
    /// Name in the configuration.
    pub fn name(self) -> &'static str {
        self.word()
    }
}

/// Selection of a subset of the scatterers of each ping.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SimplifySpec {
    /// Method of selection.
    pub method: SimplifyMethod,
    /// Number of seabed scatterers to keep in a ping.
    pub keep: usize,
    /// Weights of the energy terms.
    pub weights: EnergyWeights,
    /// Distance that the sonar moves before a new selection, metres.
    pub hold_m: f64,
    /// Angle that the sonar turns before a new selection, radians.
    pub hold_rad: f64,
    /// True if shadows are found among the scatterers before the selection.
    pub shadows: bool,
}

/// Method of selecting scatterers.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum SimplifyMethod {
    /// Eqs. 26-29 of Meng et al. 2023, corrected.
    Acoustic,
    /// Eqs. 26-29 of Meng et al. 2023, as printed.
    Paper,
    /// Random selection with compensated amplitudes.
    Unbiased,
}

impl SimplifyMethod {
    /// All methods.
    pub const ALL: [Self; 3] = [Self::Acoustic, Self::Paper, Self::Unbiased];
    /// Name in the configuration and on the command line.
    pub fn name(self) -> &'static str {
        self.word()
    }
}

/// Weights of the terms of a scatterer's energy.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct EnergyWeights {
    /// Weight of the Gaussian curvature.
    pub curvature: f64,
    /// Weight of the scattered energy.
    pub scattering: f64,
    /// Weight of the two-way pattern.
    pub axis: f64,
    /// Weight of the product of scattered energy and two-way pattern.
    pub echo: f64,
}

impl EnergyWeights {
    /// Equal weights. Meng et al. 2023 name three weights and give no values.
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

/// Seabed file and the interpretation of its values.
#[derive(Clone, Debug, PartialEq)]
pub struct SeabedFileSpec {
    /// Path of the survey.
    pub path: PathBuf,
    /// Format; `None` detects the format.
    pub format: Option<SeabedFormat>,
    /// Coordinate system; `None` uses that of the file.
    pub crs: Option<CrsSpec>,
    /// Sign of the heights; `None` uses that of the file, or the sign of most values.
    pub values: Option<HeightSign>,
    /// Position of the first row of a grid; `None` uses that of the file.
    pub first_row: Option<FirstRow>,
    /// Value of a hole, in addition to the value that the file declares.
    pub nodata: Option<f64>,
    /// Cell size of the grid for soundings, metres.
    pub cell_m: Option<f64>,
    /// Maximum edge length of a triangle of soundings, metres. Larger triangles are holes.
    pub max_edge_m: Option<f64>,
}

impl SeabedFileSpec {
    /// Specification that interprets the file only by its own content.
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
    /// Text with three columns.
    Xyz,
    /// LAS point cloud.
    Las,
    /// PLY point cloud.
    Ply,
}

/// Coordinate system of a seabed file.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum CrsSpec {
    /// Metres about an origin without a geographic position.
    Local,
    /// Longitude and latitude in degrees, WGS84.
    Geographic,
    /// Metres in a projection that is not converted to latitude and longitude.
    Projected,
    /// Universal transverse Mercator on WGS84.
    Utm {
        /// Zone number, 1 to 60.
        zone: u8,
        /// True for the northern hemisphere.
        north: bool,
    },
}

impl std::str::FromStr for CrsSpec {
    type Err = &'static str;

    /// Parses `local`, `geographic`, `projected`, `utm-31n`, `EPSG:4326` or `EPSG:32631`, in upper or lower case.
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

/// Sign of the heights of a survey.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum HeightSign {
    /// Heights are positive up.
    Elevation,
    /// Heights are positive down.
    Depth,
}

/// Position of the first row of a grid.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum FirstRow {
    /// At the northern edge.
    North,
    /// At the southern edge.
    South,
}

/// Timing, threads and delivery of pings.
#[derive(Clone, Debug)]
pub struct RunSpec {
    /// Number of computing threads; 0 means one per core.
    pub threads: usize,
    /// Delay of the delivery after the end of the listening window, seconds.
    pub latency_s: f64,
    /// Interval between printed status lines, seconds.
    pub status_interval_s: f64,
    /// Maximum number of pings that wait for delivery.
    pub queue_pings: usize,
    /// Speed of rig time.
    pub clock: ClockSpec,
    /// SCHED_FIFO priority, 1 to 99. With 0, scheduling is normal and memory is not locked.
    pub priority: u8,
    /// Nice value of the computing threads, -20 to 0.
    pub compute_nice: i8,
    /// Folder of the fault log; `None` uses the folder of the records.
    pub fault_directory: Option<PathBuf>,
    /// Fraction of the time to the next ping over which the datagrams of a ping are sent. `None` sends all at once.
    pub spread_share: Option<f64>,
    /// True if records over TCP are also spread in time.
    pub pace_tcp: bool,
    /// Time at which element samples are sent.
    pub delivery: DeliverySpec,
    /// True if a streamed ping is computed in tiles, and its first blocks are sent before the last tile is computed.
    pub stream_tiles: bool,
    /// Action if a ping cannot be ready in time.
    pub overload: OverloadSpec,
    /// Minimum computing time of a ping, seconds, for tests of overload. It is halved at each larger tolerance.
    pub simulated_compute_s: f64,
    /// Lead of the computation of a ping before its pulse, seconds, with the predicted motion. Above 0 only in mode `predict`.
    pub ahead_s: f64,
    /// File of the cost table of this machine; `None` uses the built-in table.
    pub costs: Option<PathBuf>,
}

impl RunSpec {
    /// [`RunSpec::ahead_s`] in whole nanoseconds, so every caller computes the same instant.
    pub fn ahead_ns(&self) -> i64 {
        (self.ahead_s * 1e9).round() as i64
    }

    /// Time after a pulse at which its samples must be ready, seconds. In streaming delivery this is the delivery of the first
    /// block, otherwise of the ping.
    pub fn ready_after_s(&self, window_s: f64) -> f64 {
        match self.delivery {
            DeliverySpec::PingEnd => window_s + self.latency_s,
            DeliverySpec::Streaming { block_s, latency_s } => block_s + latency_s,
        }
    }
}

/// Time at which element samples are sent.
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

/// Speed of rig time. The samples do not depend on the speed.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum ClockSpec {
    /// The computer's time.
    RealTime,
    /// Real time multiplied by this factor.
    Scaled(f64),
    /// As fast as pings can be computed.
    Fast,
    /// One ping per requested step.
    Lockstep,
}

impl ClockSpec {
    /// Whether rig time advances from pulse to pulse. No ping is then late.
    pub fn is_own(self) -> bool {
        matches!(self, Self::Fast | Self::Lockstep)
    }
}

/// Recording of the output records.
#[derive(Clone, Debug)]
pub struct RecordSpec {
    /// Folder of the records. It is created if it does not exist.
    pub directory: PathBuf,
    /// Whether recording is on when the daemon starts.
    pub at_start: bool,
}

/// Server for control over HTTP: address and password.
#[derive(Clone, Debug, Default)]
pub struct ControlSpec {
    /// Address of the server; `None` disables control.
    pub listen: Option<SocketAddr>,
    /// Password of the clients. Always present unless `listen` is a loopback address.
    pub token: Option<String>,
    /// True if any free port is used when the port of `listen` is in use.
    pub or_any_port: bool,
}

/// Sonar: pulse, arrays, receiver, settings, model, beams and outputs.
#[derive(Clone, Debug)]
pub struct SonarSpec {
    /// Name, unique among the sonars.
    pub name: String,
    /// Serial number in the records.
    pub serial: u64,
    /// The transmitted pulse.
    pub pulse: Pulse,
    /// Further pulses in the water together with `pulse`.
    pub more_pulses: Vec<MorePulseSpec>,
    /// Transmit arrays.
    pub transmit: Vec<TransmitArray>,
    /// Names of the transmit arrays, in the order of `transmit`.
    pub transmit_names: Vec<String>,
    /// Receive arrays.
    pub receive: Vec<ArrayGeometry>,
    /// Names of the receive arrays, in the order of `receive`.
    pub receive_names: Vec<String>,
    /// Receiver chain after the elements.
    pub receiver: Receiver,
    /// Imperfections of transducers and receiver; `None` without any.
    pub instrument: Option<Instrument>,
    /// Initial settings.
    pub settings: SonarSettings,
    /// Limits of the settings.
    pub limits: LimitsSpec,
    /// Origin of the ping triggers.
    pub trigger: TriggerSpec,
    /// Output signals at each pulse.
    pub trigger_out: TriggerOutSpec,
    /// Path model, Doppler model and synthesis method.
    pub model: ModelChoice,
    /// Tolerance and error check.
    pub synthesis: SynthesisSpec,
    /// Side-scan lines and fan of beams.
    pub beams: BeamsSpec,
    /// Appearance of replay pictures.
    pub picture: PictureSpec,
    /// Protocol outputs.
    pub outputs: Vec<OutputSpec>,
}

/// Further pulse of a ping.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct MorePulseSpec {
    /// Transmitted pulse. Duration and taper equal those of the sonar's own pulse.
    pub pulse: Pulse,
    /// Delay after the sonar's own pulse, seconds.
    pub delay_s: f64,
    /// Index of the transmit array of the pulse for all receive arrays. `None`: each receive array has its own transmit array.
    pub transmit: Option<usize>,
}

/// Appearance of replay pictures.
#[derive(Clone, Debug, PartialEq)]
pub struct PictureSpec {
    /// Across-track axis of the waterfall.
    pub range: PictureRange,
    /// True if the receiver's time-varying gain is removed.
    pub raw: bool,
    /// Colour map of waterfall and mosaic.
    pub colours: ColourMap,
    /// Limits of the colour scale.
    pub contrast: Contrast,
    /// True if the mean level at each range is removed.
    pub flatten: bool,
    /// Pixel size across the waterfall, metres; `None` gives 600 pixels per side.
    pub metres_per_pixel: Option<f64>,
    /// Number of pings between pictures of the fan.
    pub fan_every_pings: u32,
    /// Appearance of the mosaic.
    pub mosaic: MosaicLook,
}

/// Appearance of a mosaic.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct MosaicLook {
    /// Pixel size, metres.
    pub metres_per_pixel: f64,
    /// Value of a pixel that several pings cover.
    pub overlap: Overlap,
    /// Minimum angle from the vertical, radians. Samples below this angle are excluded.
    pub nadir_rad: f64,
}

/// Value of a pixel that several pings cover.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Overlap {
    /// Mean intensity of all pings.
    Mean,
    /// Intensity of the last ping.
    Last,
    /// Mean intensity of the pings of the nearest pass.
    Nearest,
}

/// Across-track axis of a waterfall.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum PictureRange {
    /// Slant range.
    Slant,
    /// Ground range, for a flat seabed at the true depth under the sonar.
    Ground,
    /// Ground range, for a flat seabed at the range of the first bottom echo.
    GroundFirstReturn,
}

/// Limits of the colour scale.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Contrast {
    /// Quantiles of the pixel values of each picture.
    Percentiles {
        /// Fraction of the pixels below the darkest colour, 0 to 1.
        low: f64,
        /// Fraction of the pixels below the brightest colour, 0 to 1.
        high: f64,
    },
    /// Fixed levels, dB re 1 V. In a flattened picture they are relative to the mean level at the range.
    Fixed {
        /// Level of the darkest colour, dB re 1 V.
        low_db: f64,
        /// Level of the brightest colour, dB re 1 V.
        high_db: f64,
    },
}

/// Colour map from dark to bright.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ColourMap {
    /// Black to white.
    Grey,
    /// Black, brown, gold, pale yellow, like side-scan paper.
    Copper,
    /// Dark blue to white through cyan, for water columns.
    Blue,
    /// Blue, green, yellow, red, for echo strength and, reversed, for depth.
    Rainbow,
}

impl Default for PictureSpec {
    fn default() -> Self {
        Self {
            range: PictureRange::Slant,
            raw: false,
            colours: ColourMap::Copper,
            // The water column, about a third of a picture, is dark. The seabed has medium levels, and few pixels have the
            // brightest colour.
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
    /// Tolerance of the relative error of element samples, before noise and converter, in any window of a pulse length. Engines are
    /// designed for it, and the error check tests it.
    pub tolerance: f64,
    /// True if random samples are recomputed with the reference solution.
    pub error_check: bool,
    /// Frequency step of `spectral`, hertz. `None` is the reciprocal of the longest record, or a finer step.
    pub frequency_step_hz: Option<f64>,
    /// Minimum range of scatterers for which `gridded-2d` is designed, metres.
    pub nearest_m: f64,
    /// Tolerance of the engine if models use the rest of `tolerance`. `None`: the engine has all of `tolerance`.
    pub engine_tolerance: Option<f64>,
    /// Methods that are selected automatically.
    pub auto: AutoModel,
    /// True if the culling level is not configured: culling then keeps its part of the tolerance in every window.
    pub culls_by_window: bool,
    /// Maximum displacement of echoes in range cells, if only pictures are used. `None`: the tolerance of samples applies.
    pub image_cells: Option<f64>,
    /// Result of the synthesis: element samples or side-scan lines.
    pub output: SynthesisOutput,
    /// Reason why elements are required; `None` if only side-scan lines are required.
    pub elements_for: Option<&'static str>,
}

impl SynthesisSpec {
    /// Tolerance for which the engine is designed.
    pub fn design_tolerance(&self) -> f64 {
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
            culls_by_window: false,
            image_cells: None,
            output: SynthesisOutput::Elements,
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
    /// True if side-scan lines are focused along range.
    pub focused_lines: bool,
    /// Ratio of range to used array length for focused lines; `None` uses the whole array.
    pub line_f_number: Option<f64>,
    /// Shading along the array for focused lines.
    pub line_shading: Shading,
    /// Fan of beams; `None` for a sonar without fan.
    pub fan: Option<FanSpec>,
    /// Window of all matched filters.
    pub weighting: Shading,
    /// Synthetic aperture image; `None` computes no image.
    pub synthetic_aperture: Option<SyntheticApertureSpec>,
}

/// Horizontal area on which a replay back-projects its pings.
#[derive(Clone, Debug, PartialEq)]
pub struct SyntheticApertureSpec {
    /// Indices of the receive arrays in use.
    pub arrays: Vec<usize>,
    /// Southern and northern edge, world, metres.
    pub north_m: (f64, f64),
    /// Western and eastern edge, world, metres.
    pub east_m: (f64, f64),
    /// Depth of all pixels, world, metres.
    pub down_m: f64,
    /// Pixel size, metres.
    pub cell_m: f64,
}

impl SyntheticApertureSpec {
    /// Number of columns (west to east) and of rows.
    pub fn size(&self) -> (usize, usize) {
        let cells = |(from, to): (f64, f64)| ((to - from) / self.cell_m - 1e-9).ceil() as usize;
        (cells(self.east_m).max(1), cells(self.north_m).max(1))
    }
}

/// Side-scan line of one receive array.
#[derive(Clone, Debug)]
pub struct LineSpec {
    /// Side of the platform to which the array points.
    pub side: Side,
    /// Index of the receive array.
    pub array: usize,
}

/// Fan of beams of one receive array.
#[derive(Clone, Debug)]
pub struct FanSpec {
    /// Index of the receive array.
    pub array: usize,
    /// Number of beams.
    pub beams: usize,
    /// Angle from the most port to the most starboard beam, radians.
    pub sector_rad: f64,
    /// Shading along the array.
    pub shading: Shading,
    /// Beamformer and its parameters.
    pub form: FanForm,
}

/// Beamforming method of a fan, and distribution of its beams.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct FanForm {
    /// Beamforming method.
    pub former: Former,
    /// Distribution of the beams over the sector.
    pub spacing: BeamSpacing,
    /// Angle of the middle of the sector from the boresight, radians.
    pub center_rad: f64,
    /// True if beam angles are relative to the vertical.
    pub roll_stabilised: bool,
    /// Ratio of range to used array length with `dynamic-focus`; `None` uses the whole array.
    pub f_number: Option<f64>,
    /// Maximum carrier phase error of the focus with `dynamic-focus`, radians.
    pub focus_error_rad: f64,
    /// Nearest range of the focus with `dynamic-focus`, metres.
    pub focus_from_m: f64,
    /// Of an arc: angle between the normals of the outermost elements that a beam uses, radians.
    pub aperture_rad: f64,
    /// True if the bottom is detected in every beam.
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
            focus_from_m: 0.0,
            aperture_rad: 80f64.to_radians(),
            bottom_detection: false,
        }
    }
}

/// Beamforming method.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Former {
    /// Far field, true time delays at all frequencies, computed in f64.
    Exact,
    /// The same as `Exact`, computed with FFTs over time and array in f32.
    Fft,
    /// Far field, true time delays to a fraction of a sample, computed in f32.
    TimeDelay,
    /// Far field, carrier phases only.
    Phase,
    /// Near field, refocused along range, with the motion of the receiver.
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
    /// Equal distances on a flat seabed.
    EquiDistant,
    /// Equal steps of the sine, as given by an FFT over the array.
    EquiSine,
}

impl BeamSpacing {
    /// Name in the configuration.
    pub fn name(self) -> &'static str {
        self.word()
    }
}

/// Weights along an aperture or a pulse. Side lobe levels are positive, dB below the main lobe.
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
        /// Side lobe level, dB below the main lobe.
        side_lobe_db: f64,
    },
    /// Chebyshev window. Along a pulse, the Taylor window with the same side lobe level is used.
    Chebyshev {
        /// Side lobe level, dB below the main lobe.
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

/// Output protocol and its parameters.
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
    /// MCAP recording with ROS 2 messages.
    Mcap(McapSpec),
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
    /// Number that distinguishes sonar heads with the same device identifier.
    pub enumerator: u16,
    /// Indices of the receive arrays of record 7038, in this order.
    pub arrays: Vec<usize>,
    /// True if files have only the records that common readers know.
    pub has_common_files: bool,
    /// Maximum packet length with network frame, bytes.
    pub max_packet: usize,
    /// Size of the queue of one client, bytes. Records beyond it are dropped.
    pub client_queue_bytes: usize,
    /// True if a client with a full queue is disconnected instead of missing records.
    pub disconnect_when_full: bool,
    /// Addresses, besides its own, to which a client may direct records.
    pub third_parties: Vec<IpAddr>,
    /// Maximum number of simultaneous connections.
    pub max_clients: usize,
}

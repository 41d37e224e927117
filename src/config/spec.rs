//! Checked specifications: what the rest of the house may rely on. SI and radians; made only by `config::check`.
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

pub use faults::{
    ConnectionFault, ElementFault, FaultKind, FaultRefused, FaultRequest, FaultSpec, NavByteFault,
    NavFault, TransportFault,
};

use std::net::SocketAddr;
use std::path::PathBuf;

use glam::DVec3;

use echotank_core::flow::{
    ArrayGeometry, ModelChoice, Pulse, Receiver, Side, SonarSettings, TransmitArray,
};

pub use devices::{PingDevice, PingProtocolSpec, WbmsSpec};
pub use methods::AutoModel;
pub use output::MadeOutput;
pub use overload::OverloadSpec;
pub use samples::{ElementStreamSpec, SigmfSpec, Vita49Spec, WavSpec};
pub use trigger::{
    EarlyTrigger, ModemLine, OutLine, TriggerFrom, TriggerLineSpec, TriggerOutSpec, TriggerSpec,
};

/// One rig: what a configuration file describes.
#[derive(Clone, Debug)]
pub struct RigSpec {
    /// The file's own text, for records that carry it.
    pub source_text: String,
    pub medium: MediumSpec,
    pub nav: NavSpec,
    pub scene: SceneSpec,
    pub run: RunSpec,
    pub record: Option<RecordSpec>,
    pub control: ControlSpec,
    /// The scenario of what goes wrong.
    pub faults: Vec<FaultRequest>,
    /// At least one.
    pub sonars: Vec<SonarSpec>,
}

#[derive(Clone, Debug)]
pub struct MediumSpec {
    pub sound_speed_m_per_s: f64,
    pub absorption: AbsorptionSpec,
}

#[derive(Clone, Copy, Debug, PartialEq)]
pub enum AbsorptionSpec {
    None,
    /// dB per metre, one way.
    Fixed {
        db_per_m: f64,
    },
    /// Francois and Garrison 1982.
    FrancoisGarrison(Water),
    /// Ainslie and McColm 1998.
    AinslieMcColm(Water),
}

#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Water {
    pub temperature_c: f64,
    /// Practical salinity (g/kg within the formulas' accuracy).
    pub salinity: f64,
    pub depth_m: f64,
    pub ph: f64,
}

#[derive(Clone, Debug)]
pub struct NavSpec {
    pub origin: OriginSpec,
    pub mode: NavMode,
    pub vertical: VerticalSpec,
    pub stamp: StampSpec,
    /// Recorded sources start again at their end, time shifted by whole loops.
    pub loop_log: bool,
    /// In `predict`: longest extrapolation before a ping is skipped, seconds.
    pub max_extrapolation_s: f64,
    /// Depth of the history ring, seconds.
    pub history_s: f64,
    /// Used where no source gives it.
    pub fallback_heading_from_course: bool,
    /// None: the first source that provides a quantity owns it.
    pub failover: Option<FailoverSpec>,
    pub jump_gate: Option<JumpGateSpec>,
    /// A source without a sample for so long is stale, or lost; seconds.
    pub stale_s: f64,
    pub lost_s: f64,
    /// In `predict`: what becomes of a ping for which something is older than `max_extrapolation_s`.
    pub on_lost: OnLost,
    /// The platform is towed, and positions are those of the ship.
    pub tow: Option<TowSpec>,
    /// At least one.
    pub sources: Vec<NavSourceSpec>,
    /// Navigation sent out.
    pub outputs: Vec<NavOutputSpec>,
}

#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum OnLost {
    /// It is skipped.
    #[default]
    Skip,
    /// It is made with what was last known, come to rest, and flagged invalid.
    Hold,
}

/// A towed body on the ship's heading behind the point where its cable leaves the ship.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct TowSpec {
    /// Where the cable leaves the ship: forward and starboard of the ship's reference point, down from the waterline; metres.
    pub point_m: DVec3,
    pub cable_out_m: f64,
    /// Straight distance over cable length: 1 for a straight cable.
    pub cable_scope: f64,
}

/// Where navigation goes out, and what of it.
#[derive(Clone, Debug, PartialEq)]
pub struct NavOutputSpec {
    pub name: String,
    pub target: NavTargetSpec,
    pub sentences: Vec<NavSentence>,
    /// Two capital letters.
    pub talker: String,
    pub rate_hz: f64,
    /// GGA and HDT go out so long after the instant they name, seconds.
    pub latency_s: f64,
    pub pulse: PulseSpec,
}

#[derive(Clone, Debug, PartialEq)]
pub enum NavTargetSpec {
    /// A host, a broadcast address or a multicast group.
    Udp { to: SocketAddr },
    /// A server for any number of clients.
    TcpListen { listen: SocketAddr },
    Serial {
        port: String,
        baud: u32,
        line: SerialLine,
    },
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum NavSentence {
    Zda,
    Gga,
    Hdt,
}

impl NavSentence {
    pub fn name(self) -> &'static str {
        match self {
            NavSentence::Zda => "ZDA",
            NavSentence::Gga => "GGA",
            NavSentence::Hdt => "HDT",
        }
    }
}

/// What marks the whole second, ahead of the sentence that names it.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum PulseSpec {
    #[default]
    None,
    /// The serial port's RTS, or DTR, for 100 ms.
    Rts,
    Dtr,
    /// One byte, 0x07; over UDP a datagram of its own.
    Byte,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct SerialLine {
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

#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum ParitySpec {
    #[default]
    None,
    Even,
    Odd,
}

impl NavSpec {
    /// Every source is recorded: the motion does not depend on the machine's time.
    pub fn is_recorded(&self) -> bool {
        self.sources.iter().all(NavSourceSpec::is_recorded)
    }
}

/// When another source takes a quantity over.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct FailoverSpec {
    /// Silence after which the next source speaks, seconds.
    pub after_s: f64,
    /// How long the better one must have come again before it has the word back, seconds.
    pub hold_off_s: f64,
}

/// What counts as a jump.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct JumpGateSpec {
    pub max_speed_m_per_s: f64,
    /// Of heading, roll and pitch.
    pub max_rate_rad_per_s: f64,
}

#[derive(Clone, Copy, Debug, PartialEq)]
pub enum OriginSpec {
    /// The first position of the first source that has one.
    FirstFix,
    Geodetic {
        latitude_rad: f64,
        longitude_rad: f64,
    },
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum NavMode {
    /// Extrapolate with rates to the ping (live default).
    Predict,
    /// Wait until the window is covered by samples on both sides (replay default).
    Settle,
}

/// What the world's down coordinate of the reference point is made of.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum VerticalSpec {
    /// The waterline is z = 0; reference point at `reference_down_m` below it, plus heave.
    Waterline { reference_down_m: f64 },
    /// Minus the GNSS height (which already holds heave; heave is then not added), plus `datum_offset_m`.
    Gnss { datum_offset_m: f64 },
    /// Given by a CSV track itself, or by a depth sensor; heave is not added.
    Depth,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum StampSpec {
    Log,
    Host,
}

#[derive(Clone, Debug)]
pub struct NavSourceSpec {
    pub name: String,
    pub input: NavInputSpec,
    pub time: TimePolicy,
    pub checksum: ChecksumPolicy,
    /// Antenna, or depth sensor, in the body, metres; used with this source's positions and depths.
    pub lever_arm_m: DVec3,
    /// How its motion sensor sits in the body.
    pub mounting: SensorMounting,
    pub dialect: NavDialect,
    /// What is taken from this source; the first source in the file that provides a quantity owns it.
    pub provides: Vec<NavChannel>,
}

impl NavSourceSpec {
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

/// What is particular about the messages of one source; by default nothing.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct NavDialect {
    pub format: NavFormat,
    /// Sentences, by address or its last three letters, whose checksum is not looked at.
    pub ignore_checksum_for: Vec<String>,
    /// PASHR carries heave + up, against the documented + down.
    pub pashr_heave_up: bool,
    /// DPT, DBT, DBS and DBK say how deep the platform itself is.
    pub depth_is_own: bool,
    pub reversed: Reversed,
    /// East positive; makes magnetic headings true where the sentence does not say it.
    pub magnetic_variation_rad: Option<f64>,
}

/// Quantities that the source sends with the opposite sign of its documentation.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Reversed {
    pub roll: bool,
    pub pitch: bool,
    pub heave: bool,
}

/// What a source's bytes are.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum NavFormat {
    #[default]
    Nmea,
    Tss1,
    /// EM1000 too.
    Em3000,
    Seapath26,
    Kmb,
}

impl NavFormat {
    /// As the configuration has it.
    pub fn name(self) -> &'static str {
        match self {
            NavFormat::Nmea => "nmea",
            NavFormat::Tss1 => "tss1",
            NavFormat::Em3000 => "em3000",
            NavFormat::Seapath26 => "seapath26",
            NavFormat::Kmb => "kmb",
        }
    }
}

#[derive(Clone, Debug, PartialEq)]
pub enum NavInputSpec {
    /// A recorded log: lines with a time prefix, or plain NMEA. Where neither the lines nor the messages tell the time, sentences come at
    /// `plain_rate_hz`.
    Log { path: PathBuf, plain_rate_hz: f64 },
    /// CSV track: time, north, east, down, roll, pitch, heading.
    Csv { path: PathBuf },
    Udp {
        listen: SocketAddr,
        multicast: Option<std::net::Ipv4Addr>,
    },
    Serial {
        port: String,
        baud: u32,
        line: SerialLine,
    },
    /// A client of somebody's server, named as the configuration has it.
    TcpConnect { address: String },
    /// A server; its newest client speaks.
    TcpListen { listen: SocketAddr },
}

/// Where a sample's validity time comes from.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum TimePolicy {
    /// From the message; a message without a time takes its arrival.
    Message,
    /// From the message; a message without a time takes the time of the last dated one of its burst.
    Burst,
    /// Arrival minus this many seconds (0: arrival).
    Arrival { latency_s: f64 },
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ChecksumPolicy {
    Require,
    AcceptMissing,
    Ignore,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub enum NavChannel {
    Position,
    CourseSpeed,
    Heading,
    RollPitch,
    Heave,
    /// How deep the platform is.
    Depth,
}

impl NavChannel {
    /// As `provides` has it.
    pub fn name(self) -> &'static str {
        match self {
            NavChannel::Position => "position",
            NavChannel::CourseSpeed => "course-speed",
            NavChannel::Heading => "heading",
            NavChannel::RollPitch => "roll-pitch",
            NavChannel::Heave => "heave",
            NavChannel::Depth => "depth",
        }
    }
}

#[derive(Clone, Debug)]
pub struct SceneSpec {
    pub seed: u64,
    pub anchor: AnchorSpec,
    pub mirror: bool,
    pub seabed: Option<SeabedSpec>,
    /// Explicit scatterers, CSV.
    pub points: Option<PathBuf>,
    /// Named targets: points over the seabed (CSV) or shapes (`.toml`).
    pub targets: Option<PathBuf>,
    pub occlusion: OcclusionSpec,
    /// Memory for tiles, bytes.
    pub memory_limit_bytes: u64,
    pub simplify: Option<SimplifySpec>,
}

/// Where the scene's own zero lies.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum AnchorSpec {
    /// At the world's origin.
    Origin,
    /// Under the first fix.
    FirstFix,
    /// Where the seabed's file says it lies on the earth.
    File,
}

/// What hides what.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum OcclusionSpec {
    /// Nothing.
    None,
    /// Whatever stands between.
    Horizon,
    /// Over the seabed, Meng et al. 2023, Eq. 27 as printed.
    Paper,
}

#[derive(Clone, Debug)]
pub struct SeabedSpec {
    pub shape: SeabedShape,
    pub density: Density,
    pub bottom: BottomSpec,
    pub incidence: IncidenceSpec,
    pub mosaic: Option<MosaicSpec>,
    /// Circular Gaussian reflectivity per scatterer (true) or 1.
    pub speckle: bool,
}

/// How much a square metre of seabed scatters back; powers in dB.
#[derive(Clone, Debug, PartialEq)]
pub enum BottomSpec {
    /// mu cos i cos s.
    BistaticLambert {
        mu_db: f64,
    },
    /// mu cos^2 i of the incoming ray.
    Lambert {
        mu_db: f64,
    },
    ThreeTerm(ThreeTerm),
    /// Three terms of its own.
    Sediment(Sediment),
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Sediment {
    Mud,
    Silt,
    Sand,
    Gravel,
    Rock,
}

impl Sediment {
    pub const ALL: [Self; 5] = [Self::Mud, Self::Silt, Self::Sand, Self::Gravel, Self::Rock];
    /// As the configuration spells it.
    pub fn name(self) -> &'static str {
        match self {
            Self::Mud => "mud",
            Self::Silt => "silt",
            Self::Sand => "sand",
            Self::Gravel => "gravel",
            Self::Rock => "rock",
        }
    }
}

/// A exp(-i^2 / 2 B^2) + C cos^D i + E exp(-i^2 / 2 F^2).
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ThreeTerm {
    /// A and B.
    pub specular_db: f64,
    pub specular_rad: f64,
    /// C and D.
    pub lambert_db: f64,
    pub lambert_exponent: f64,
    /// E and F.
    pub intermediate_db: f64,
    pub intermediate_rad: f64,
}

/// What the angle of incidence is measured from.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum IncidenceSpec {
    /// The surface's own normal.
    Normal,
    /// The vertical (Meng et al. 2023, Eq. 9): right on flat bottoms alone.
    Flat,
}

/// Backscattering strengths from place to place, in dB, on a grid of the same kinds and coordinates as the seabed.
#[derive(Clone, Debug, PartialEq)]
pub struct MosaicSpec {
    pub path: PathBuf,
    /// What its coordinates are, where the file does not say or says so wrongly.
    pub crs: Option<CrsSpec>,
    pub values: MosaicValues,
    pub offset_north_m: f64,
    pub offset_east_m: f64,
}

#[derive(Clone, Copy, Debug, PartialEq)]
pub enum MosaicValues {
    /// Backscattering strength at this incidence: the bottom's law is raised or lowered to meet it.
    Absolute { incidence_rad: f64 },
    /// To be added to the bottom's own.
    Relative,
}

/// How densely scatterers lie on the seabed.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Density {
    /// Per square metre of the horizontal, everywhere.
    PerM2(f64),
    /// At slant range r at least `per_cell` in every r `beam_rad` x `range_m`, the finest resolution cell of any sonar: fewer per square metre the
    /// farther away, out to `longest_range_m`.
    Auto {
        per_cell: f64,
        range_m: f64,
        beam_rad: f64,
        longest_range_m: f64,
    },
}

#[derive(Clone, Debug)]
pub enum SeabedShape {
    /// z = depth + slope_north x + slope_east y.
    Plane {
        depth_m: f64,
        slope_north: f64,
        slope_east: f64,
    },
    /// A surveyed seabed. The middle of what it covers lies at the scene's zero, moved by the offset.
    File {
        file: SeabedFileSpec,
        offset_north_m: f64,
        offset_east_m: f64,
    },
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
    pub const ALL: [Self; 3] = [Self::Curves, Self::Relief, Self::Lake];
    /// As the configuration spells it.
    pub fn name(self) -> &'static str {
        match self {
            Self::Curves => "paper-curves",
            Self::Relief => "paper-relief",
            Self::Lake => "paper-lake",
        }
    }
}

/// Thinning of each ping's scatterers.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SimplifySpec {
    pub method: SimplifyMethod,
    /// Scatterers of the seabed to keep in a ping.
    pub keep: usize,
    pub weights: EnergyWeights,
    /// A choice is kept until the sonar has moved this far,
    pub hold_m: f64,
    /// or turned this much.
    pub hold_rad: f64,
    /// Search for shadows while choosing.
    pub shadows: bool,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum SimplifyMethod {
    /// Eqs. 26-29 of Meng et al. 2023, mended.
    Acoustic,
    /// The same as printed.
    Paper,
    /// By chance, each with its probability made up for.
    Unbiased,
}

impl SimplifyMethod {
    pub const ALL: [Self; 3] = [Self::Acoustic, Self::Paper, Self::Unbiased];
    /// As the configuration and the command line spell it.
    pub fn name(self) -> &'static str {
        match self {
            Self::Acoustic => "acoustic",
            Self::Paper => "paper",
            Self::Unbiased => "acoustic-unbiased",
        }
    }
}

/// What the parts of a scatterer's energy count.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct EnergyWeights {
    pub curvature: f64,
    pub scattering: f64,
    pub axis: f64,
    /// Of the product of scattering and axis.
    pub echo: f64,
}

impl EnergyWeights {
    /// The paper names three weights and gives no values: all alike.
    pub const PAPER: Self = Self {
        curvature: 1.0,
        scattering: 1.0,
        axis: 1.0,
        echo: 0.0,
    };
    pub const ECHO: Self = Self {
        curvature: 0.0,
        scattering: 0.0,
        axis: 0.0,
        echo: 1.0,
    };
    pub fn default_of(method: SimplifyMethod) -> Self {
        match method {
            SimplifyMethod::Acoustic | SimplifyMethod::Paper => Self::PAPER,
            SimplifyMethod::Unbiased => Self::ECHO,
        }
    }
}

/// A seabed's file and what it is to be taken for. Where a choice is none the file decides, or where it says nothing, the look of its numbers.
#[derive(Clone, Debug, PartialEq)]
pub struct SeabedFileSpec {
    pub path: PathBuf,
    pub format: Option<SeabedFormat>,
    pub crs: Option<CrsSpec>,
    pub values: Option<HeightSign>,
    /// Which end of a grid its first row lies at.
    pub first_row: Option<FirstRow>,
    /// Stands for a hole, besides the value that the file itself names.
    pub nodata: Option<f64>,
    /// Soundings: cell of the grid that they are made into.
    pub cell_m: Option<f64>,
    /// Soundings: triangles with a longer edge are holes.
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

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum SeabedFormat {
    EsriAscii,
    GeoTiff,
    Bag,
    Xyz,
    Las,
    Ply,
}

/// What a file's coordinates are.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum CrsSpec {
    /// Metres about a zero that is nowhere on the earth.
    Local,
    /// Longitude and latitude in degrees, WGS84.
    Geographic,
    /// Metres of a projection that is not turned into latitude and longitude.
    Projected,
    /// Universal transverse Mercator on WGS84.
    Utm { zone: u8, north: bool },
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

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum HeightSign {
    /// Positive up.
    Elevation,
    /// Positive down.
    Depth,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum FirstRow {
    North,
    South,
}

/// Pacing and threads.
#[derive(Clone, Debug)]
pub struct RunSpec {
    /// 0: as many as there are cores.
    pub threads: usize,
    /// Delivery after the end of the window, seconds.
    pub latency_s: f64,
    /// Counters are printed this often, seconds.
    pub status_interval_s: f64,
    /// Pings that may wait for delivery.
    pub queue_pings: usize,
    pub clock: ClockSpec,
    /// SCHED_FIFO, 1 to 99; 0: ordinary scheduling, and memory is not locked.
    pub priority: u8,
    /// Of the threads that compute pings, -20 to 0.
    pub compute_nice: i8,
    /// Where the log of injected faults goes, if not beside the records.
    pub fault_directory: Option<PathBuf>,
    /// Of the time to the next ping, over which a ping's datagrams leave; none: all at once.
    pub spread_share: Option<f64>,
    /// So over TCP too.
    pub pace_tcp: bool,
    pub delivery: DeliverySpec,
    /// Pings that stream are made tile by tile, and leave meanwhile.
    pub stream_tiles: bool,
    pub overload: OverloadSpec,
    /// A ping takes at least so long, and half of it at each looser tolerance, seconds: an overload rehearsed.
    pub simulated_compute_s: f64,
    /// A ping is computed so long before its pulse, from the motion foreseen then, seconds. Above 0 in `predict` only.
    pub ahead_s: f64,
    /// What methods cost on this machine; none is the table that comes with the program.
    pub costs: Option<PathBuf>,
}

impl RunSpec {
    /// [`RunSpec::ahead_s`] in whole nanoseconds, so that everybody means the same instant.
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
    /// With all else that a ping makes.
    PingEnd,
    /// In blocks of so many seconds, each so long after its last sample would have been heard.
    Streaming { block_s: f64, latency_s: f64 },
}

/// How fast rig time goes. The samples do not depend on it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum ClockSpec {
    RealTime,
    /// So many times as fast as the machine's clock.
    Scaled(f64),
    /// As fast as pings can be computed.
    Fast,
    /// A ping for every step that is asked for.
    Lockstep,
}

impl ClockSpec {
    /// Rig time is not the machine's: it goes from pulse to pulse, and nothing is ever late.
    pub fn is_own(self) -> bool {
        matches!(self, Self::Fast | Self::Lockstep)
    }
}

#[derive(Clone, Debug)]
pub struct RecordSpec {
    pub directory: PathBuf,
}

/// Control over HTTP.
#[derive(Clone, Debug, Default)]
pub struct ControlSpec {
    /// None: no control.
    pub listen: Option<SocketAddr>,
    /// There is one wherever `listen` is not a loopback address.
    pub token: Option<String>,
    /// Where the port of `listen` is somebody else's, any other will do: nobody named it.
    pub or_any_port: bool,
}

#[derive(Clone, Debug)]
pub struct SonarSpec {
    pub name: String,
    pub serial: u64,
    pub pulse: Pulse,
    /// In the water together with `pulse`.
    pub more_pulses: Vec<MorePulseSpec>,
    pub transmit: Vec<TransmitArray>,
    pub transmit_names: Vec<String>,
    pub receive: Vec<ArrayGeometry>,
    pub receive_names: Vec<String>,
    pub receiver: Receiver,
    /// Settings at start.
    pub settings: SonarSettings,
    pub limits: LimitsSpec,
    pub trigger: TriggerSpec,
    pub trigger_out: TriggerOutSpec,
    pub model: ModelChoice,
    pub synthesis: SynthesisSpec,
    pub beams: BeamsSpec,
    pub picture: PictureSpec,
    pub outputs: Vec<OutputSpec>,
}

/// A pulse beside the sonar's own.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct MorePulseSpec {
    /// Duration and taper are those of the sonar's own.
    pub pulse: Pulse,
    /// After the sonar's own.
    pub delay_s: f64,
    /// Index of the transmit array that sends it, to all receive arrays; none: each receive array's own sends it.
    pub transmit: Option<usize>,
}

/// How the pictures of a replay look.
#[derive(Clone, Debug, PartialEq)]
pub struct PictureSpec {
    pub range: PictureRange,
    /// With the receiver's time-varying gain taken out again.
    pub raw: bool,
    pub colours: ColourMap,
    pub contrast: Contrast,
    /// The mean level at each range is taken out.
    pub flatten: bool,
    /// Of the waterfall, across; none: the range over 600 pixels.
    pub metres_per_pixel: Option<f64>,
    /// Of the fan's pictures.
    pub fan_every_pings: u32,
    pub mosaic: MosaicLook,
}

/// Pixels of a mosaic and what they keep.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct MosaicLook {
    pub metres_per_pixel: f64,
    pub overlap: Overlap,
    /// Directions nearer to the vertical than this are left out.
    pub nadir_rad: f64,
}

/// What a pixel keeps of several pings.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Overlap {
    /// The mean intensity.
    Mean,
    /// The ping that saw it last.
    Last,
    /// The pass that saw it from nearest; the mean over its pings.
    Nearest,
}

/// What a waterfall's columns are.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum PictureRange {
    Slant,
    /// Over a flat bottom as deep as the seabed under the sonar.
    Ground,
    /// Over a flat bottom as far away as the first echo of the bottom.
    GroundFirstReturn,
}

/// What is darkest and what is brightest in a picture.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Contrast {
    /// Shares (0 to 1) of the picture's own pixels that lie below darkest and below brightest.
    Percentiles { low: f64, high: f64 },
    /// dB re 1 V; over the mean at that range where the picture is flattened.
    Fixed { low_db: f64, high_db: f64 },
}

/// Colours from dark to bright.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ColourMap {
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

/// How the chosen synthesis is run and watched.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SynthesisSpec {
    /// Relative error of element samples in any window of a pulse's length, before noise and converter: what engines are made for, and what a
    /// error check is held to.
    pub tolerance: f64,
    /// Recompute random samples through the reference.
    pub error_check: bool,
    /// Step of `spectral`'s frequency grid; none: one over the longest record, or finer.
    pub frequency_step_hz: Option<f64>,
    /// Nearest scatterer for which `gridded-2d` is made.
    pub nearest_m: f64,
    /// What an engine is made for, where models need the rest of `tolerance`; none is all of it.
    pub engine_tolerance: Option<f64>,
    /// What the plan of methods chooses.
    pub auto: AutoModel,
    /// Pictures are all that is looked at: cells of range by which things may be displaced.
    pub image_cells: Option<f64>,
    pub output: MadeOutput,
    /// Why elements are made even so; none where lines are all that anybody sees.
    pub elements_for: Option<&'static str>,
}

impl SynthesisSpec {
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

pub use echotank_core::flow::SettingLimits as LimitsSpec;
pub use families::{ImagenexSpec, JsfChannels, JsfFormat, JsfSpec, XtfSpec};

#[derive(Clone, Debug, Default)]
pub struct BeamsSpec {
    /// Side-scan lines: which receive array makes which side.
    pub lines: Vec<LineSpec>,
    /// Lines are focused along range.
    pub focused_lines: bool,
    /// Of focused lines: range over the length in use, at most the whole line; none uses all of it everywhere.
    pub line_f_number: Option<f64>,
    /// Of focused lines, along the array.
    pub line_shading: Shading,
    pub fan: Option<FanSpec>,
    /// Along the pulse, of every matched filter.
    pub weighting: Shading,
    pub synthetic_aperture: Option<SyntheticApertureSpec>,
}

/// A patch of the world that a replay's pings are back-projected on.
#[derive(Clone, Debug, PartialEq)]
pub struct SyntheticApertureSpec {
    /// Receive arrays whose elements add to it.
    pub arrays: Vec<usize>,
    /// Southern and northern edge.
    pub north_m: (f64, f64),
    /// Western and eastern edge.
    pub east_m: (f64, f64),
    pub down_m: f64,
    pub cell_m: f64,
}

impl SyntheticApertureSpec {
    /// Columns (west to east) and rows.
    pub fn size(&self) -> (usize, usize) {
        let cells = |(from, to): (f64, f64)| ((to - from) / self.cell_m - 1e-9).ceil() as usize;
        (cells(self.east_m).max(1), cells(self.north_m).max(1))
    }
}

#[derive(Clone, Debug)]
pub struct LineSpec {
    pub side: Side,
    /// Index of the receive array.
    pub array: usize,
}

#[derive(Clone, Debug)]
pub struct FanSpec {
    /// Index of the receive array.
    pub array: usize,
    pub beams: usize,
    /// From port-most to starboard-most, radians.
    pub sector_rad: f64,
    pub shading: Shading,
    pub form: FanForm,
}

/// How a fan's beams are laid and formed.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct FanForm {
    pub former: Former,
    pub spacing: BeamSpacing,
    /// Middle of the sector, from the boresight.
    pub center_rad: f64,
    /// Angles are from the vertical, whatever the roll.
    pub roll_stabilised: bool,
    /// Of `dynamic-focus`: range over the length of line in use, at most all of it; none uses all of it everywhere.
    pub f_number: Option<f64>,
    /// Of `dynamic-focus`: what carrier phase a focus may err by at the ends of its zone.
    pub focus_error_rad: f64,
    /// Look for the bottom in every beam.
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

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Former {
    /// Far field, true time delays at every frequency, f64.
    Exact,
    /// The same by fast transforms over time and line, f32.
    Fft,
    /// Far field, true time delays to a fraction of a sample, f32.
    TimeDelay,
    /// Far field, carrier phases alone.
    Phase,
    /// Near field, refocused along range, with the receiver's motion.
    DynamicFocus,
}

impl Former {
    /// As the configuration spells it.
    pub fn name(self) -> &'static str {
        match self {
            Self::Exact => "exact",
            Self::Fft => "fft",
            Self::TimeDelay => "conventional",
            Self::Phase => "phase",
            Self::DynamicFocus => "dynamic-focus",
        }
    }
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum BeamSpacing {
    EquiAngle,
    /// On a flat bottom.
    EquiDistant,
    /// As a transform over the line has them.
    EquiSine,
}

impl BeamSpacing {
    /// As the configuration spells it.
    pub fn name(self) -> &'static str {
        match self {
            Self::EquiAngle => "equi-angle",
            Self::EquiDistant => "equi-distant",
            Self::EquiSine => "equi-sine",
        }
    }
}

/// Weights along an aperture or a pulse; side lobes are positive, dB under the main lobe.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub enum Shading {
    #[default]
    Uniform,
    Hann,
    Hamming,
    Taylor {
        side_lobe_db: f64,
    },
    /// Along a pulse: Taylor's of the same side lobes.
    Chebyshev {
        side_lobe_db: f64,
    },
    Kaiser {
        beta: f64,
    },
}

impl Shading {
    /// As the configuration spells it.
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

#[derive(Clone, Debug)]
pub enum OutputSpec {
    SevenK(SevenKSpec),
    Jsf(JsfSpec),
    Xtf(XtfSpec),
    Imagenex872(ImagenexSpec),
    Vita49(Vita49Spec),
    Elements(ElementStreamSpec),
    Sigmf(SigmfSpec),
    Wav(WavSpec),
    Ping(PingProtocolSpec),
    Wbms(WbmsSpec),
}

#[derive(Clone, Debug)]
pub struct SevenKSpec {
    pub listen: SocketAddr,
    pub device_id: u32,
    pub enumerator: u16,
    /// Receive arrays whose elements go into 7038, in this order.
    pub arrays: Vec<usize>,
    /// Bytes of a packet, network frame included.
    pub max_packet: usize,
    /// Bytes that may wait for one client before its records are dropped.
    pub client_queue_bytes: usize,
    /// A client whose queue is full is disconnected instead of missing records.
    pub disconnect_when_full: bool,
    pub max_clients: usize,
}

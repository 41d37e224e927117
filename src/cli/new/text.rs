//! The text of a rig: a piece for each table, in the order of the file. Values in `Debug` form are TOML.

use super::design::{
    Design, Kind, Protocol, SENSITIVITY_DB, SOUND_M_PER_S, SOURCE_DB, TOLERANCE, WATER, digits,
    word, words,
};
use super::track::ORIGIN_DEG;
use super::{Nav, Request};

/// Delay until the measurements after a ping are read, seconds: three intervals of a log of 1 Hz, of the track, and of live sources.
const LOG_LATENCY_S: f64 = 3.0;
const TRACK_LATENCY_S: f64 = 0.6;
const LIVE_LATENCY_S: f64 = 0.2;
/// Time between measurements of a live source that is bridged, seconds.
const LIVE_GAP_S: f64 = 1.1;
/// Who reaches a server.
const LOCAL: &str = "this computer only; 0.0.0.0:PORT: any computer";

/// The ping rate, and how it was chosen.
#[derive(Clone, Copy, Debug)]
pub(super) struct Pace {
    pub rate_hz: f64,
    /// Estimated time of a ping on two cores, seconds.
    pub compute_s: f64,
}

impl Pace {
    /// Time before the pulse at which a ping of a live rig is computed.
    fn ahead_s(self) -> f64 {
        (0.01 * (200.0 * self.compute_s).ceil()).clamp(0.05, 1.0)
    }
}

/// Name and direction, 1 to starboard and -1 to port, of the arrays of a side.
type Side = (&'static str, f64);
const SIDES: [Side; 2] = [("port", -1.0), ("starboard", 1.0)];

/// A number without the noise of its last digits.
fn n(x: f64) -> f64 {
    digits(x, 6)
}

/// The text of the rig.
pub(super) fn text(request: &Request, design: &Design, pace: Pace) -> String {
    let mut text = head(request, design) + &nav(request, design, pace);
    text += &(scene(request, design) + &run(request, pace));
    // A device of the Ping protocol is one side.
    let sonars: &[&[Side]] = match (design.kind, request.protocols.as_slice()) {
        (Kind::Sidescan, [Protocol::Ping]) => &[&SIDES[..1], &SIDES[1..]],
        (Kind::Sidescan, _) => &[&SIDES],
        _ => &[&[]],
    };
    for sides in sonars {
        text += &sonar(request, design, pace, sides);
    }
    text
}

fn head(request: &Request, design: &Design) -> String {
    format!(
        r#"# A {} of {} kHz to {} m, written by `echotank new`. Protocol: {}.
#
#   echotank check {name}
#   echotank run {name}
#
# The figures are those of a usual device of its kind. `echotank check --template` explains every key.

[medium]
sound_speed_m_per_s = {SOUND_M_PER_S:?} # m/s, the same everywhere
temperature_c = {:?} # degrees Celsius; with the salinity it sets the absorption
salinity_psu = {:?} # 0 for fresh water
"#,
        design.kind.noun(),
        n(design.frequency_hz / 1e3),
        design.range_m,
        words(&request.protocols),
        WATER.0,
        WATER.1,
        name = request.out.display(),
    )
}

fn nav(request: &Request, design: &Design, pace: Pace) -> String {
    let is_track = matches!(request.nav, Nav::Invented | Nav::Track(_));
    let [latitude, longitude] = ORIGIN_DEG;
    let vertical = match is_track {
        true => format!(
            r#"origin = {{ latitude_deg = {latitude:?}, longitude_deg = {longitude:?} }} # of north = east = 0 of the track
vertical = "depth" # down_m of the track is the depth of the reference point"#
        ),
        false => r#"vertical = "waterline" # depth = reference_depth_m + heave
reference_depth_m = 0.0 # m, of the vessel's reference point below the waterline"#
            .to_owned(),
    };
    let longest_s =
        pace.ahead_s() + 2.0 * design.range_m / SOUND_M_PER_S + design.duration_s + LIVE_GAP_S;
    let end = match request.nav.is_live() {
        true => format!(
            "max_extrapolation_ms = {:?} # ms; the motion is predicted for this long after the last measurement",
            100.0 * (10.0 * longest_s).ceil()
        ),
        false => "loop = true # begins again at the end".to_owned(),
    };
    let source = match &request.nav {
        Nav::Invented => format!(
            "kind = \"csv\"\npath = {:?} # an invented oval at 2.5 m/s in a slight swell",
            request.track_name()
        ),
        Nav::Track(path) => format!("kind = \"csv\"\npath = {path:?}"),
        Nav::Log(path) => format!(
            r#"kind = "log"
path = {path:?}
time = "burst" # a sentence without a time takes that of the sentences around it"#
        ),
        Nav::Udp(address) => format!(
            "kind = \"udp\"\nlisten = \"{address}\" # NMEA 0183: position, heading, and attitude if there is any"
        ),
        Nav::Tcp(address) => {
            format!("kind = \"tcp\"\nconnect = {address:?} # a server of NMEA 0183 sentences")
        }
        Nav::Serial(port, baud) => {
            format!("kind = \"serial\"\nport = {port:?}\nbaud = {baud} # bits per second")
        }
    };
    let lever_arm = match is_track {
        true => "",
        false => {
            "lever_arm_m = [0.0, 0.0, 0.0] # m, of the antenna: forward, starboard, down of the reference point\n"
        }
    };
    format!(
        r#"
[nav]
stamp = "host" # time of the records: of this computer; "log": of the navigation
{vertical}
{end}

[[nav.source]]
name = "nav"
{source}
{lever_arm}"#
    )
}

fn scene(request: &Request, design: &Design) -> String {
    let (scene, shape) = match &request.seabed {
        None => (
            r#"occlusion = "none" # "horizon": targets and relief cast shadows"#,
            format!(
                "shape = \"plane\"\ndepth_m = {:?} # m below the waterline",
                design.depth_m
            ),
        ),
        Some(seabed) => (
            r#"occlusion = "horizon" # relief casts shadows
anchor = "first-fix" # the survey lies under the first position; "file": at its own coordinates
extend = "mirror" # beyond its edge the survey goes on as its mirror image"#,
            format!("shape = \"file\"\npath = {:?}", seabed.path),
        ),
    };
    format!(
        r#"
[scene]
seed = 1 # the same seed gives the same speckle
memory_mib = 2048 # most memory of the seabed around the sonar
{scene}

[scene.seabed]
{shape}
bottom = "sand" # or mud, silt, gravel, rock
density = "auto" # five scatterers in every resolution cell
"#
    )
}

fn run(request: &Request, pace: Pace) -> String {
    let nav_s = match request.nav {
        Nav::Log(_) => LOG_LATENCY_S,
        Nav::Invented | Nav::Track(_) => TRACK_LATENCY_S,
        Nav::Udp(_) | Nav::Tcp(_) | Nav::Serial(..) => LIVE_LATENCY_S,
    };
    // A ping may take its whole period after its navigation is complete.
    let latency_ms = 100.0 * (10.0 * (nav_s + 1.0 / pace.rate_hz)).ceil();
    let queue = (1e-3 * latency_ms * pace.rate_hz).ceil() as usize + 8;
    let ahead = match request.nav.is_live() {
        true => format!(
            "ahead_ms = {:?} # a ping is computed this long before its pulse\n",
            (1e3 * pace.ahead_s()).round()
        ),
        false => String::new(),
    };
    let record = match request.protocols.contains(&Protocol::Xtf) {
        true => "\n[record]\ndirectory = \"recordings\" # folder of the files\n",
        false => "",
    };
    format!(
        r#"
[run]
latency_ms = {latency_ms:?} # records leave this long after the end of a ping
{ahead}queue_pings = {queue} # pings that wait for that time

[control]
listen = "127.0.0.1:7780" # the operator's page, http://127.0.0.1:7780/
{record}"#
    )
}

fn sonar(request: &Request, design: &Design, pace: Pace, sides: &[Side]) -> String {
    let name = match sides {
        [(side, _)] => format!("{}-{side}", word(&design.kind)),
        _ => word(&design.kind),
    };
    let mut text = format!(
        r#"
[[sonar]]
name = "{name}"

[sonar.pulse]
kind = "lfm" # a chirp; "cw": a tone, without bandwidth_khz
center_frequency_khz = {:?} # kHz
bandwidth_khz = {:?} # kHz; resolves {} cm in range
duration_ms = {:?} # ms
taper = 0.1 # share of the pulse that rises or falls
"#,
        n(design.frequency_hz / 1e3),
        n(design.bandwidth_hz / 1e3),
        digits(50.0 * SOUND_M_PER_S / design.bandwidth_hz, 2),
        n(1e3 * design.duration_s),
    );
    for side in sides {
        text += &side_arrays(request, design, *side);
    }
    if sides.is_empty() {
        text += &fan_arrays(request, design);
    }
    text += &receiver(design);
    text += &settings(design, pace);
    text += &format!(
        r#"
[sonar.model]
# The program selects methods that keep the tolerance; `echotank check` names them.
path = "auto"
doppler = "auto"
synthesis = "auto"
tolerance = {TOLERANCE:?} # relative error of the element samples
"#
    );
    text += &beams(design, sides);
    for protocol in &request.protocols {
        text += &output(*protocol, design.kind, sides);
    }
    text
}

fn side_arrays(request: &Request, design: &Design, (side, starboard): Side) -> String {
    let elements = design.elements;
    let spacing_m = digits(design.narrow_m() / elements as f64, 3);
    let length_m = n(spacing_m * elements as f64);
    let spacing = spacing(
        elements,
        spacing_m,
        "the elements fill the transmitter's length",
    );
    format!(
        r#"
[[sonar.transmit]]
name = "tx-{side}"
position_m = {position_m:?} # m: forward, starboard, down of the reference point
roll_deg = {roll_deg:?} # looks to {side}, 30 degrees below the horizon
pattern = "rectangle"
length_m = {length_m:?} # m along the track: a beam of {} degrees
width_m = {width_m:?} # m: 50 degrees across
baffled = true # not to the other side

[[sonar.receive]]
name = "{side}"
transmit = "tx-{side}" # receives the echoes of this transmitter only
elements = {elements} # in a line along the track
{spacing}position_m = {position_m:?}
roll_deg = {roll_deg:?}
element_pattern = "rectangle"
element_length_m = {spacing_m:?} # m along the line
element_width_m = {width_m:?} # m: 50 degrees across
baffled = true # not from the other side: without it the sides are mirrored
sensitivity_db = {SENSITIVITY_DB:?} # dB re 1 V/uPa
"#,
        design.beam_deg(length_m),
        position_m = [0.0, 0.1 * starboard, request.draft_m],
        roll_deg = -60.0 * starboard,
        width_m = digits(design.wavelength_m, 3),
    )
}

fn fan_arrays(request: &Request, design: &Design) -> String {
    let (elements, half_m) = (design.elements, digits(design.wavelength_m / 2.0, 3));
    let narrow_m = digits(design.narrow_m(), 3);
    let deg = design.beam_deg(narrow_m);
    let (transmit, roll) = match design.kind {
        Kind::ForwardLooking => (
            format!(
                r#"yaw_deg = 90.0 # lies across the track
roll_deg = 75.0 # looks ahead, 15 degrees below the horizon
pattern = "rectangle"
length_m = {half_m:?} # m across the track: a broad sector
width_m = {narrow_m:?} # m: {deg} degrees up and down"#
            ),
            "roll_deg = 75.0\n",
        ),
        _ => (
            format!(
                r#"pattern = "rectangle"
length_m = {narrow_m:?} # m along the track: a beam of {deg} degrees
width_m = {half_m:?} # m across the track: a broad swath"#
            ),
            "",
        ),
    };
    let spacing = spacing(
        elements,
        half_m,
        "half a wavelength, so that no beam has a grating lobe",
    );
    format!(
        r#"
[[sonar.transmit]]
name = "tx"
position_m = {position_m:?} # m: forward, starboard, down of the reference point
{transmit}
baffled = true # not to the back

[[sonar.receive]]
name = "rx"
elements = {elements} # in a line across the track
{spacing}position_m = {position_m:?}
yaw_deg = 90.0 # +x to starboard
{roll}element_pattern = "rectangle"
element_length_m = {half_m:?} # m along the line
element_width_m = {:?} # m: 25 degrees
baffled = true # not from the back
sensitivity_db = {SENSITIVITY_DB:?} # dB re 1 V/uPa
"#,
        digits(2.0 * design.wavelength_m, 3),
        position_m = [0.0, 0.0, request.draft_m],
    )
}

fn spacing(elements: usize, spacing_m: f64, comment: &str) -> String {
    match elements {
        1 => String::new(),
        _ => format!("spacing_m = {spacing_m:?} # m; {comment}\n"),
    }
}

fn receiver(design: &Design) -> String {
    format!(
        r#"
[sonar.receiver]
sample_rate_khz = {:?} # kHz, complex: the band and the Doppler shift at 10 m/s
rx_filter = "fir" # limits the band before sampling
tvg = "30logr" # time-varying gain: levels sand over the range
tvg_max_db = {:?} # dB
noise_db = {:?} # dB re 1 uPa^2/Hz at the elements
adc_bits = 16
full_scale_v = {:?} # V, above the strongest echo of the bottom
"#,
        n(design.sample_rate_hz / 1e3),
        design.tvg_max_db,
        design.noise_db,
        design.full_scale_v,
    )
}

fn settings(design: &Design, pace: Pace) -> String {
    let (range_m, rate_hz) = (design.range_m, pace.rate_hz);
    let allowed = digits(design.sound_rate_hz, 3);
    let why = match rate_hz < allowed {
        true => format!(
            " that two cores compute, by the cost estimate; the sound allows {allowed} at {range_m} m"
        ),
        false => format!(", which the sound allows at {range_m} m and two cores compute"),
    };
    let within = |x: f64, low: f64, high: f64| [digits(low * x, 3), digits(high * x, 3)];
    format!(
        r#"
[sonar.ping]
range_m = {range_m:?} # m
rate_hz = {rate_hz:?} # pings/s{why}
source_level_db = {SOURCE_DB:?} # dB re 1 uPa at 1 m
gain_db = 0.0 # dB

[sonar.limits]
# What a topside may set: lowest and highest.
range_m = {:?}
ping_rate_hz = {:?}
source_level_db = {:?}
gain_db = [-20.0, 40.0]
pulse_duration_ms = {:?}
"#,
        within(range_m, 0.2, 1.2),
        [0.1f64.min(rate_hz), digits(1.2 * allowed, 3)],
        [SOURCE_DB - 30.0, SOURCE_DB + 5.0],
        within(1e3 * design.duration_s, 0.5, 2.0),
    )
}

fn beams(design: &Design, sides: &[Side]) -> String {
    let (sector_deg, detection) = match design.kind {
        Kind::Board => return String::new(),
        Kind::Sidescan => {
            let lines = sides.iter();
            let lines =
                lines.map(|(side, _)| format!("{side} = \"{side}\" # the line of this array\n"));
            return "\n[sonar.beams]\n".to_owned() + &lines.collect::<String>();
        }
        Kind::Multibeam => (
            130.0,
            "bottom_detection = true # a sounding for each beam\n",
        ),
        Kind::ForwardLooking => (120.0, ""),
    };
    format!(
        r#"
[sonar.beams.fan]
array = "rx"
beams = {}
sector_deg = {sector_deg:?} # degrees from the first beam to the last
shading = "hann" # low side lobes
former = "conventional"
{detection}"#,
        (2 * design.elements).min(256),
    )
}

fn output(protocol: Protocol, kind: Kind, sides: &[Side]) -> String {
    let table = match protocol {
        Protocol::SevenK => "sevenk".to_owned(),
        other => word(&other),
    };
    let keys = match protocol {
        Protocol::SevenK => {
            let (id, device) = match kind {
                Kind::Sidescan => (104, "side-scan"),
                _ => (103, "multibeam; 7125: a SeaBat 7125"),
            };
            format!(
                r#"id = {id} # 7k device identifier of a generic {device}
listen = "127.0.0.1:7000" # {LOCAL}"#
            )
        }
        Protocol::Jsf => format!(
            r#"listen = "127.0.0.1:1700" # commands; {LOCAL}
listen_data = "127.0.0.1:1701" # data
subsystem = 20 # 20 low, 21 high, 22 very high frequency"#
        ),
        Protocol::Xtf => r#"samples = "u16" # counts; "f32": volts"#.to_owned(),
        Protocol::Wbms => {
            format!(r#"listen = "127.0.0.1:2209" # and the next three ports; {LOCAL}"#)
        }
        Protocol::Ping => match sides {
            [(side, starboard), ..] => {
                let number = usize::from(*starboard > 0.0);
                format!(
                    r#"device = "omniscan450"
side = "{side}"
listen = "127.0.0.1:{}" # {LOCAL}
channel_number = {number} # of the synchronised pair
channels = 2"#,
                    51200 + number
                )
            }
            [] => format!("device = \"surveyor240\"\nlisten = \"127.0.0.1:51200\" # {LOCAL}"),
        },
        Protocol::Imagenex872 => format!("listen = \"127.0.0.1:4040\" # {LOCAL}"),
        Protocol::Vita49 => r#"send_to = "127.0.0.1:4991" # UDP; a stream for each element
samples = "baseband" # I and Q; "passband" with passband_rate_khz: as from a converter"#
            .to_owned(),
        Protocol::Elements => format!("listen = \"127.0.0.1:7172\" # {LOCAL}"),
    };
    format!("\n[sonar.output.{table}]\n{keys}\n")
}

//! Every key of a configuration file, declared once: name, kind, rule, default, meaning.
//!
//! The reader (`raw`), the template and the JSON Schema (`describe`) all walk these tables, so that they cannot disagree. Rules that
//! need more than one key live in `check`.

mod devices;
mod families;
mod faults;
mod samples;
mod trigger;

/// A TOML table.
pub(crate) struct Table {
    pub doc: &'static str,
    pub keys: &'static [Key],
    /// Names the design knows and this version does not build: refused with those words.
    pub later: &'static [&'static str],
}

/// One key of a table.
pub(crate) struct Key {
    pub name: &'static str,
    pub kind: Kind,
    pub(crate) presence: Presence,
    pub doc: &'static str,
}

/// What may stand behind a key.
pub(crate) enum Kind {
    Bool,
    /// A finite number.
    Number(Range),
    /// A whole number, inclusive.
    Integer(i64, i64),
    /// 1 to 32 letters, digits, '-' or '_': fit for file names.
    Name,
    /// Text that is not empty.
    Text,
    /// The name of a file that must exist, relative to the configuration's folder.
    File,
    /// The name of a folder that is there or can be made, relative to the configuration's folder.
    Folder,
    Choice(&'static [&'static str], Later),
    /// So many numbers.
    Numbers(usize, Range),
    /// Pairs of numbers.
    Rows,
    /// At least one name.
    Names,
    /// At least one of the choices.
    Choices(&'static [&'static str]),
    Table(&'static Table),
    /// One or more tables.
    Tables(&'static Table),
    /// The first kind whose TOML type fits.
    Either(&'static Kind, &'static Kind),
}

/// Choices the design knows and this version does not build.
pub(crate) type Later = &'static [&'static str];

pub(crate) enum Presence {
    /// Must be there. With an example for the template (tables have none).
    Required(&'static str),
    /// May be left out: this TOML text then stands in its place.
    Default(&'static str),
    /// May be left out, and then does nothing. Commented out in the template.
    Optional(&'static str),
    /// As `Default`; the template has the second text in its place.
    Set(&'static str, &'static str),
    /// Whether it must be there depends on other keys; the template has it.
    Shown(&'static str),
}
use Presence::{Default, Optional, Required, Set, Shown};

/// Numbers from `min` (itself only if `min_included`) to `max`.
#[derive(Clone, Copy)]
pub(crate) struct Range {
    pub min: f64,
    pub(crate) min_included: bool,
    pub max: f64,
}

const fn from(min: f64, max: f64) -> Range {
    Range {
        min,
        min_included: true,
        max,
    }
}

const fn above(min: f64, max: f64) -> Range {
    Range {
        min,
        min_included: false,
        max,
    }
}

const fn key(name: &'static str, kind: Kind, presence: Presence, doc: &'static str) -> Key {
    Key {
        name,
        kind,
        presence,
        doc,
    }
}

// The ranges are those outside of which a value is surely a slip (a wrong unit, a lost digit), not those of good taste.
const METRES: Range = from(-1.0e6, 1.0e6);
const ARM_M: Range = from(-1000.0, 1000.0);
const ANGLE_DEG: Range = from(-360.0, 360.0);
const RANGE_M: Range = above(0.0, 20_000.0);
const RATE_HZ: Range = above(0.0, 1000.0);
const LEVEL_DB: Range = from(-100.0, 300.0);
const GAIN_DB: Range = from(-200.0, 200.0);
const PULSE_MS: Range = from(0.001, 10_000.0);
const SIDE_M: Range = from(0.0, 100.0);
const MAX_INTEGER: i64 = i64::MAX;

/// The whole file.
pub(crate) static RIG: Table = Table {
    doc: "An echotank rig: water, navigation, scene, and one or more sonars.",
    keys: &[
        key("medium", Kind::Table(&MEDIUM), Default("{}"), ""),
        key("nav", Kind::Table(&NAV), Required(""), ""),
        key("scene", Kind::Table(&SCENE), Default("{}"), ""),
        key("run", Kind::Table(&RUN), Default("{}"), ""),
        key("record", Kind::Table(&RECORD), Optional(""), ""),
        key("control", Kind::Table(&CONTROL), Default("{}"), ""),
        key("sonar", Kind::Tables(&SONAR), Required(""), ""),
        key("fault", Kind::Tables(&faults::FAULT), Optional(""), ""),
    ],
    later: &["web", "metrics", "trigger"],
};

static MEDIUM: Table = Table {
    doc: "The water: one sound speed everywhere.",
    keys: &[
        key(
            "sound_speed_m_per_s",
            Kind::Number(from(300.0, 3000.0)),
            Default("1500.0"),
            "",
        ),
        key(
            "absorption",
            Kind::Either(
                &Kind::Choice(&["francois-garrison", "ainslie-mccolm", "none"], &["thorp"]),
                &Kind::Table(&FIXED_ABSORPTION),
            ),
            Default("\"francois-garrison\""),
            "Francois and Garrison 1982, Ainslie and McColm 1998, nothing, or a number: { db_per_km = 30.0 }, one way.",
        ),
        key(
            "temperature_c",
            Kind::Number(from(-4.0, 40.0)),
            Default("10.0"),
            "This and the next three feed the absorption law only.",
        ),
        key(
            "salinity_psu",
            Kind::Number(from(0.0, 50.0)),
            Default("35.0"),
            "0 for a lake.",
        ),
        key(
            "depth_m",
            Kind::Number(from(0.0, 11_000.0)),
            Default("50.0"),
            "",
        ),
        key("ph", Kind::Number(from(6.0, 9.0)), Default("8.0"), ""),
    ],
    later: &["profile", "sound_speed_profile"],
};

static FIXED_ABSORPTION: Table = Table {
    doc: "A given absorption.",
    keys: &[key(
        "db_per_km",
        Kind::Number(from(0.0, 10_000.0)),
        Required("30.0"),
        "One way.",
    )],
    later: &[],
};

static NAV: Table = Table {
    doc: "How measurements become the platform's motion. Axes: body x forward, y starboard, z down; world north, east, down.",
    keys: &[
        key(
            "origin",
            Kind::Either(
                &Kind::Choice(&["first-fix"], &[]),
                &Kind::Table(&GEODETIC_ORIGIN),
            ),
            Default("\"first-fix\""),
            "Where north = east = 0 lies: the first position received, or { latitude_deg = 54.3, longitude_deg = 10.1 }.",
        ),
        key(
            "mode",
            Kind::Choice(&["settle", "predict"], &[]),
            Optional("\"predict\""),
            "\"settle\" waits for measurements on both sides of the ping, \"predict\" extrapolates. Default: settle where every source is a file, else predict.",
        ),
        key(
            "vertical",
            Kind::Choice(&["waterline", "gnss", "depth"], &[]),
            Default("\"waterline\""),
            "What the platform's depth is made of: \"waterline\" a fixed reference_depth_m plus heave, \"gnss\" minus the antenna's height plus datum_offset_m, \"depth\" a CSV track's own or a depth sensor's (provides \"depth\"). Heave is added only to the first.",
        ),
        key(
            "reference_depth_m",
            Kind::Number(METRES),
            Default("0.0"),
            "Of the reference point, positive down. Only with vertical = \"waterline\".",
        ),
        key(
            "datum_offset_m",
            Kind::Number(METRES),
            Default("0.0"),
            "Added to the depth. Only with vertical = \"gnss\".",
        ),
        key(
            "stamp",
            Kind::Choice(&["log", "host"], &[]),
            Default("\"log\""),
            "Which UTC the records carry: the navigation's, or this computer's.",
        ),
        key(
            "loop",
            Kind::Bool,
            Default("false"),
            "Recorded sources start again at their end, their time moved on by whole loops.",
        ),
        key(
            "max_extrapolation_ms",
            Kind::Number(from(0.0, 60_000.0)),
            Default("250.0"),
            "Longest look ahead: on_lost says what becomes of a ping that would need a longer one. Only with mode = \"predict\".",
        ),
        key(
            "history_s",
            Kind::Number(from(1.0, 3600.0)),
            Default("10.0"),
            "How much of the past is kept.",
        ),
        key(
            "heading_from_course",
            Kind::Bool,
            Default("false"),
            "Where no source gives a heading, take the course over ground.",
        ),
        key(
            "failover_s",
            Kind::Number(above(0.0, 3600.0)),
            Optional("2.0"),
            "Where several sources provide a quantity: the next one in the file speaks when the better one has been silent this long. Without it the first owns the quantity.",
        ),
        key(
            "hold_off_s",
            Kind::Number(from(0.0, 3600.0)),
            Default("5.0"),
            "How long the better source must have come again before it has the word back. Only with failover_s.",
        ),
        key(
            "jump_gate",
            Kind::Bool,
            Default("false"),
            "Set samples aside that lie farther from the one before than the platform can have moved, until five in a row agree.",
        ),
        key(
            "max_speed_m_per_s",
            Kind::Number(above(0.0, 150.0)),
            Default("50.0"),
            "Only with jump_gate.",
        ),
        key(
            "max_turn_rate_deg_per_s",
            Kind::Number(above(0.0, 1.0e4)),
            Default("60.0"),
            "Of heading, roll and pitch. Only with jump_gate.",
        ),
        key(
            "stale_s",
            Kind::Number(above(0.0, 3600.0)),
            Default("2.0"),
            "A source is stale, in the status, when nothing came for so long; on hold when it misses three of its own intervals.",
        ),
        key(
            "lost_s",
            Kind::Number(above(0.0, 86_400.0)),
            Default("10.0"),
            "A source is lost when nothing came for so long; not below stale_s.",
        ),
        key(
            "on_lost",
            Kind::Choice(&["hold", "skip"], &[]),
            Default("\"hold\""),
            "A ping for which something is older than max_extrapolation_ms: made with the last known motion come to rest, and flagged invalid; or skipped. Only with mode = \"predict\".",
        ),
        key("tow", Kind::Table(&NAV_TOW), Optional(""), ""),
        key("source", Kind::Tables(&NAV_SOURCE), Required(""), ""),
        key("output", Kind::Tables(&NAV_OUTPUT), Optional(""), ""),
    ],
    later: &[],
};

static NAV_TOW: Table = Table {
    doc: "The sonar is towed: positions are those of the ship's antennas (their lever_arm_m counts from the ship's reference point), all else is the towed body's. It follows on the heading, sqrt((cable_out_m * cable_scope)^2 - (its depth - the cable's height)^2) behind the point where the cable leaves the ship.",
    keys: &[
        key(
            "point_m",
            Kind::Numbers(3, ARM_M),
            Default("[0.0, 0.0, 0.0]"),
            "Where the cable leaves the ship: forward and starboard of the ship's reference point, down from the waterline.",
        ),
        key(
            "cable_out_m",
            Kind::Number(from(0.0, 20_000.0)),
            Required("60.0"),
            "",
        ),
        key(
            "cable_scope",
            Kind::Number(above(0.0, 1.0)),
            Default("1.0"),
            "Straight distance over cable length: below 1 for a cable that sags.",
        ),
    ],
    later: &[],
};

static NAV_OUTPUT: Table = Table {
    doc: "Navigation sent out, so that a device under test shares the pings' clock: at every whole second the pulse, then the ZDA that names it.",
    keys: &[
        key("name", Kind::Name, Required("\"clock\""), ""),
        key(
            "kind",
            Kind::Choice(&["udp", "tcp", "serial"], &[]),
            Required("\"udp\""),
            "\"udp\" (to), \"tcp\" (listen, for any number of clients), \"serial\" (port, baud).",
        ),
        key(
            "to",
            Kind::Text,
            Shown("\"127.0.0.1:10120\""),
            "Address and port of a host, a broadcast address or a multicast group. Only with kind = \"udp\".",
        ),
        key(
            "listen",
            Kind::Text,
            Optional("\"127.0.0.1:10121\""),
            "Only with kind = \"tcp\".",
        ),
        key(
            "port",
            Kind::Text,
            Optional("\"/dev/ttyUSB1\""),
            "Only with kind = \"serial\".",
        ),
        key(
            "baud",
            Kind::Integer(110, 4_000_000),
            Optional("9600"),
            "Only with kind = \"serial\".",
        ),
        key(
            "line",
            Kind::Choice(SERIAL_LINES, &[]),
            Default("\"8N1\""),
            "Data bits, parity and stop bits. Only with kind = \"serial\".",
        ),
        key(
            "sentences",
            Kind::Choices(&["ZDA", "GGA", "HDT"]),
            Default("[\"ZDA\", \"GGA\", \"HDT\"]"),
            "GGA is of the platform's reference point. ZDA goes out on whole seconds only, the others at every tick.",
        ),
        key(
            "talker",
            Kind::Text,
            Default("\"GP\""),
            "Two capital letters.",
        ),
        key(
            "rate_hz",
            Kind::Number(from(0.01, 200.0)),
            Default("1.0"),
            "Ticks lie on whole seconds and between them.",
        ),
        key(
            "latency_ms",
            Kind::Number(from(0.0, 1000.0)),
            Default("0.0"),
            "GGA and HDT go out so long after the instant they name, as a receiver's do, so that their measurements may have come; 0 carries the motion on.",
        ),
        key(
            "pulse",
            Kind::Choice(&["none", "rts", "dtr", "byte"], &[]),
            Default("\"none\""),
            "What marks the whole second ahead of its ZDA: the serial port's RTS or DTR raised for 100 ms, or one byte 0x07 (over UDP a datagram of its own).",
        ),
    ],
    later: &[],
};

const SERIAL_LINES: &[&str] = &[
    "8N1", "8E1", "8O1", "8N2", "7N1", "7E1", "7O1", "7N2", "7E2", "7O2",
];

static GEODETIC_ORIGIN: Table = Table {
    doc: "A given origin, WGS84.",
    keys: &[
        key(
            "latitude_deg",
            Kind::Number(from(-90.0, 90.0)),
            Required("54.3"),
            "North positive.",
        ),
        key(
            "longitude_deg",
            Kind::Number(from(-180.0, 180.0)),
            Required("10.1"),
            "East positive.",
        ),
    ],
    later: &[],
};

static NAV_SOURCE: Table = Table {
    doc: "One source of navigation; the first in the file that provides a quantity owns it.",
    keys: &[
        key("name", Kind::Name, Required("\"gnss\""), ""),
        key(
            "kind",
            Kind::Choice(&["log", "csv", "udp", "serial", "tcp"], &[]),
            Required("\"udp\""),
            "\"log\" a recorded log (path): text, pcap, pcapng or a MAVLink tlog, told from its first bytes; \"csv\" a track (path) with the columns time_s, north_m, east_m, down_m, roll_deg, pitch_deg, heading_deg; \"udp\" (listen), \"serial\" (port, baud), \"tcp\" (connect to a server, or listen for a client).",
        ),
        key(
            "path",
            Kind::File,
            Optional("\"data/survey.log\""),
            "File names count from this file's folder. Only with kind = \"log\" or \"csv\".",
        ),
        key(
            "plain_rate_hz",
            Kind::Number(from(0.001, 1.0e5)),
            Default("10.0"),
            "Sentences per second of a log in which neither the lines nor the messages carry a time. Only with kind = \"log\".",
        ),
        key(
            "listen",
            Kind::Text,
            Shown("\"127.0.0.1:10110\""),
            "Address and port. Only with kind = \"udp\" or \"tcp\".",
        ),
        key(
            "connect",
            Kind::Text,
            Optional("\"192.168.1.20:10110\""),
            "Host and port of a server. Only with kind = \"tcp\".",
        ),
        key(
            "multicast",
            Kind::Text,
            Optional("\"239.192.0.1\""),
            "Group to join, at the interface whose address `listen` has. Only with kind = \"udp\".",
        ),
        key(
            "port",
            Kind::Text,
            Optional("\"/dev/ttyUSB0\""),
            "Only with kind = \"serial\".",
        ),
        key(
            "baud",
            Kind::Integer(110, 4_000_000),
            Optional("115200"),
            "Only with kind = \"serial\".",
        ),
        key(
            "line",
            Kind::Choice(SERIAL_LINES, &[]),
            Default("\"8N1\""),
            "Data bits, parity and stop bits. Only with kind = \"serial\".",
        ),
        key(
            "time",
            Kind::Choice(&["message", "burst", "arrival"], &[]),
            Default("\"message\""),
            "When a measurement holds: the time in its message; the time of the last dated message of its burst, for messages that carry none; its arrival minus latency_ms.",
        ),
        key(
            "latency_ms",
            Kind::Number(from(0.0, 60_000.0)),
            Default("0.0"),
            "Only with time = \"arrival\".",
        ),
        key(
            "checksum",
            Kind::Choice(&["require", "accept-missing", "ignore"], &[]),
            Default("\"require\""),
            "",
        ),
        key(
            "ignore_checksum_for",
            Kind::Names,
            Optional("[\"PTNTHPR\"]"),
            "Sentences whose checksum is not looked at: whole addresses, or their last three letters.",
        ),
        key(
            "format",
            Kind::Choice(
                &["nmea", "tss1", "em3000", "seapath26", "kmb"],
                &["pd0", "pd6", "stdbin", "sbg"],
            ),
            Default("\"nmea\""),
            "What the bytes are: sentences, or records of one maker; em3000 is em1000 too.",
        ),
        key(
            "variants",
            Kind::Choices(&["pashr-heave-up", "own-depth"]),
            Optional("[\"pashr-heave-up\"]"),
            "Flavours of sentences that cannot be told from the sentence: PASHR with heave + up (WASSP), where it is + down elsewhere; DPT, DBT, DBS and DBK of a depth sensor, that say how deep the platform is and not how deep the water.",
        ),
        key(
            "reverse",
            Kind::Choices(&["roll", "pitch", "heave"]),
            Optional("[\"pitch\"]"),
            "Quantities that this instrument sends with the opposite sign of its format's documentation.",
        ),
        key(
            "magnetic_variation_deg",
            Kind::Number(from(-180.0, 180.0)),
            Optional("1.3"),
            "East positive. Makes HDG and HDM true headings where the sentence carries no variation; without it they are not taken.",
        ),
        key(
            "lever_arm_m",
            Kind::Numbers(3, ARM_M),
            Default("[0.0, 0.0, 0.0]"),
            "Where the antenna, or the depth sensor, sits: forward, starboard, down of the reference point.",
        ),
        key(
            "heave_arm_m",
            Kind::Numbers(3, ARM_M),
            Default("[0.0, 0.0, 0.0]"),
            "Where the heave is that of: forward, starboard, down of the reference point. What roll and pitch lift that point is taken off.",
        ),
        key(
            "mounting_deg",
            Kind::Numbers(3, ANGLE_DEG),
            Default("[0.0, 0.0, 0.0]"),
            "Roll, pitch and yaw that the motion sensor (or compass) says on a level platform heading north; taken off.",
        ),
        key(
            "provides",
            Kind::Choices(&[
                "position",
                "course-speed",
                "heading",
                "roll-pitch",
                "heave",
                "depth",
            ]),
            Default("[\"position\", \"course-speed\", \"heading\", \"roll-pitch\", \"heave\"]"),
            "What is taken from this source; \"depth\" is the platform's own (PIXSE,DEPIN_, PIPS, MAVLink's relative altitude, and with variants = [\"own-depth\"] DPT and its kin).",
        ),
    ],
    later: &[],
};

static SCENE: Table = Table {
    doc: "What lies in the water. Without a seabed, points and targets there is only noise.",
    keys: &[
        key(
            "seed",
            Kind::Integer(0, MAX_INTEGER),
            Default("1"),
            "Same seed, same speckle.",
        ),
        key(
            "anchor",
            Kind::Choice(&["origin", "first-fix", "file"], &[]),
            Default("\"origin\""),
            "Where the scene's own zero lies: at nav.origin, under the first position received, or where the seabed's file says it lies on the earth.",
        ),
        key(
            "extend",
            Kind::Choice(&["none", "mirror"], &[]),
            Default("\"none\""),
            "Beyond the edge of a gridded seabed: nothing, or its mirror image for ever.",
        ),
        key(
            "points",
            Kind::File,
            Optional("\"data/points.csv\""),
            "CSV of explicit scatterers: north_m, east_m, down_m, amplitude (echo pressure at 1 m for unit pressure), and if wanted amplitude_imag.",
        ),
        key(
            "targets",
            Kind::File,
            Optional("\"data/targets.csv\""),
            "Named targets: CSV of points laid over the seabed, or TOML of shapes (spheres, cylinders, boxes, ropes, meshes from OBJ, STL or PLY) anywhere in the water; hil-configs/README.md has their fields.",
        ),
        key(
            "memory_mib",
            Kind::Integer(1, 1_048_576),
            Default("512"),
            "Memory for the tiles of seabed around the sonar.",
        ),
        key(
            "incidence",
            Kind::Choice(&["normal", "flat"], &[]),
            Default("\"normal\""),
            "What angles on the seabed are measured from: its own normal, or the vertical (the paper's Eq. 9, right on flat bottoms alone).",
        ),
        key(
            "occlusion",
            Kind::Choice(&["none", "horizon", "paper"], &[]),
            Default("\"horizon\""),
            "Shadows: none; of seabed and solids, from transmitter and receiver; or over the seabed by the paper's rule (Eq. 27), which forgets obstacles.",
        ),
        key("seabed", Kind::Table(&SEABED), Shown(""), ""),
        key("simplify", Kind::Table(&SIMPLIFY), Default("{}"), ""),
    ],
    later: &[],
};

static SIMPLIFY: Table = Table {
    doc: "Leaves out scatterers of the seabed that a ping can do without; points and targets stay.",
    keys: &[
        key(
            "method",
            Kind::Choice(
                &["none", "acoustic-unbiased", "acoustic", "paper"],
                &["conventional"],
            ),
            Default("\"none\""),
            "All are computed; by chance with the lost level made up for; the strongest energies (Meng et al. 2023, mended); the same as printed.",
        ),
        key(
            "keep",
            Kind::Integer(1, 100_000_000),
            Optional("20000"),
            "Scatterers of a ping, needed unless method is none; acoustic-unbiased keeps so many on average.",
        ),
        key(
            "weight_curvature",
            Kind::Number(from(0.0, 1.0e6)),
            Optional("1.0"),
            "What Gaussian curvature counts; 1 unless acoustic-unbiased, then 0.",
        ),
        key(
            "weight_scattering",
            Kind::Number(from(0.0, 1.0e6)),
            Optional("1.0"),
            "What the energy that is sent back counts; 1 unless acoustic-unbiased, then 0.",
        ),
        key(
            "weight_axis",
            Kind::Number(from(0.0, 1.0e6)),
            Optional("1.0"),
            "What the two-way pattern counts; 1 unless acoustic-unbiased, then 0.",
        ),
        key(
            "weight_echo",
            Kind::Number(from(0.0, 1.0e6)),
            Optional("1.0"),
            "What the product of the last two counts; 0 unless acoustic-unbiased, then 1.",
        ),
        key(
            "hold_m",
            Kind::Number(from(0.0, 1.0e4)),
            Default("0.5"),
            "A choice is kept until the sonar has moved this far",
        ),
        key(
            "hold_deg",
            Kind::Number(from(0.0, 180.0)),
            Default("0.5"),
            "or turned this much.",
        ),
        key(
            "shadows",
            Kind::Bool,
            Default("false"),
            "Search for shadows among the scatterers itself, where occlusion is none, and choose what lies in them last (acoustic-unbiased: never).",
        ),
    ],
    later: &[],
};

static SEABED: Table = Table {
    doc: "The bottom, as scatterers on a surface. Leave the table out for none.",
    keys: &[
        key(
            "shape",
            Kind::Choice(
                &[
                    "plane",
                    "file",
                    "esri-ascii",
                    "paper-curves",
                    "paper-relief",
                    "paper-lake",
                ],
                &[],
            ),
            Required("\"plane\""),
            "\"file\": a survey in any format that is read; `echotank scene info` shows how it is understood. \"esri-ascii\": the same, of that format. The paper's bottoms (Figs. 6, 12, 17) lie some 30 m under the scene's zero, east of a track along north.",
        ),
        key(
            "depth_m",
            Kind::Number(METRES),
            Shown("40.0"),
            "Under the scene's zero. Only with shape = \"plane\".",
        ),
        key(
            "slope_north",
            Kind::Number(from(-10.0, 10.0)),
            Default("0.0"),
            "Metres of depth per metre. Only with shape = \"plane\".",
        ),
        key(
            "slope_east",
            Kind::Number(from(-10.0, 10.0)),
            Default("0.0"),
            "Only with shape = \"plane\".",
        ),
        key(
            "path",
            Kind::File,
            Optional("\"data/seabed.asc\""),
            "The middle of what it covers lies at the scene's zero. Only with shape = \"file\" or \"esri-ascii\".",
        ),
        key(
            "values",
            Kind::Choice(&["auto", "elevation", "depth"], &[]),
            Default("\"auto\""),
            "Heights (up positive) or depths; auto: as the file says, or as most of its signs are. Only with shape = \"file\" or \"esri-ascii\".",
        ),
        key(
            "offset_north_m",
            Kind::Number(METRES),
            Default("0.0"),
            "Moves the middle of the file. Only with shape = \"file\" or \"esri-ascii\".",
        ),
        key(
            "offset_east_m",
            Kind::Number(METRES),
            Default("0.0"),
            "Only with shape = \"file\" or \"esri-ascii\".",
        ),
        key(
            "format",
            Kind::Choice(
                &["auto", "esri-ascii", "geotiff", "bag", "xyz", "las", "ply"],
                &[],
            ),
            Default("\"auto\""),
            "Auto: by its first bytes, or its name. Only with shape = \"file\".",
        ),
        key(
            "crs",
            Kind::Text,
            Optional("\"utm-31n\""),
            "What its coordinates are, where it says so wrongly or not at all: local, geographic, projected, utm-31n, EPSG:32631. Only with shape = \"file\" or \"esri-ascii\".",
        ),
        key(
            "first_row",
            Kind::Choice(&["auto", "north", "south"], &[]),
            Default("\"auto\""),
            "Which end of a grid its first row lies at; auto: as the format has it. Only with shape = \"file\" or \"esri-ascii\".",
        ),
        key(
            "nodata",
            Kind::Number(from(-1.0e39, 1.0e39)),
            Optional("-32768.0"),
            "Stands for a hole, besides the value that the file names. Only with shape = \"file\" or \"esri-ascii\".",
        ),
        key(
            "cell_m",
            Kind::Number(above(0.0, 1.0e6)),
            Optional("5.0"),
            "Soundings: cell of the grid they are made into; left out: their mean distance. Only with shape = \"file\".",
        ),
        key(
            "max_edge_m",
            Kind::Number(above(0.0, 1.0e6)),
            Optional("50.0"),
            "Soundings: triangles with a longer edge are holes. Only with shape = \"file\".",
        ),
        key(
            "density",
            Kind::Choice(&["auto"], &[]),
            Optional("\"auto\""),
            "Five scatterers or more in every resolution cell of the finest sonar, c/(2 B) times beam width times range: fewer the farther away.",
        ),
        key(
            "density_per_m2",
            Kind::Number(above(0.0, 1.0e6)),
            Default("1.0"),
            "The same number everywhere, per square metre of the horizontal; not with density = \"auto\". The mean level does not depend on it.",
        ),
        key(
            "bottom",
            Kind::Choice(
                &[
                    "bistatic-lambert",
                    "lambert",
                    "three-term",
                    "mud",
                    "silt",
                    "sand",
                    "gravel",
                    "rock",
                ],
                &[],
            ),
            Default("\"bistatic-lambert\""),
            "The law of scattering. \"three-term\": mirror facets, Lambert and a slope between them; the names of sediments are three-term with values of their own.",
        ),
        key(
            "lambert_db",
            Kind::Number(from(-100.0, 20.0)),
            Default("-27.0"),
            "Lambert's mu: mud about -35, sand -27, rock -15 (round numbers; the names of sediments are from APL-UW TR 9407, 1994). Not with the name of a sediment.",
        ),
        key(
            "lambert_exponent",
            Kind::Number(from(0.0, 10.0)),
            Default("2.0"),
            "Of the cosine. Only with bottom = \"three-term\".",
        ),
        key(
            "specular_db",
            Kind::Number(from(-100.0, 30.0)),
            Default("-5.0"),
            "What the facets mirror at normal incidence. Only with bottom = \"three-term\".",
        ),
        key(
            "specular_width_deg",
            Kind::Number(from(2.0, 60.0)),
            Default("6.0"),
            "Standard deviation of that lobe. Only with bottom = \"three-term\".",
        ),
        key(
            "intermediate_db",
            Kind::Number(from(-100.0, 30.0)),
            Default("-23.0"),
            "The slope between the lobe and Lambert's law, at normal incidence. Only with bottom = \"three-term\".",
        ),
        key(
            "intermediate_width_deg",
            Kind::Number(from(2.0, 80.0)),
            Default("18.0"),
            "Standard deviation of that slope. Only with bottom = \"three-term\".",
        ),
        key(
            "mosaic",
            Kind::File,
            Optional("\"data/backscatter.asc\""),
            "Backscattering strengths in dB, a file of any of the formats of `path` (GeoTIFF, ESRI ASCII grid and so on); holes and what lies beyond keep the bottom's own. Over a seabed from a file it lies where its coordinates put it, and must count them in the same system; otherwise its centre lies at the scene's zero.",
        ),
        key(
            "mosaic_crs",
            Kind::Text,
            Optional("\"utm-31n\""),
            "As crs, of the mosaic's file. Only with a mosaic.",
        ),
        key(
            "mosaic_values",
            Kind::Choice(&["absolute", "relative"], &[]),
            Default("\"absolute\""),
            "\"absolute\": strengths at mosaic_incidence_deg, to which the law is raised or lowered; \"relative\": to be added to it. Only with a mosaic.",
        ),
        key(
            "mosaic_incidence_deg",
            Kind::Number(from(0.0, 85.0)),
            Default("45.0"),
            "Only with mosaic_values = \"absolute\".",
        ),
        key(
            "mosaic_offset_north_m",
            Kind::Number(METRES),
            Default("0.0"),
            "Moves the mosaic. Only with a mosaic.",
        ),
        key(
            "mosaic_offset_east_m",
            Kind::Number(METRES),
            Default("0.0"),
            "Moves the mosaic. Only with a mosaic.",
        ),
        key(
            "speckle",
            Kind::Bool,
            Default("true"),
            "Circular Gaussian reflectivities; false: all 1.",
        ),
    ],
    later: &[],
};

static RUN: Table = Table {
    doc: "Pacing and threads.",
    keys: &[
        key(
            "threads",
            Kind::Integer(0, 1024),
            Default("0"),
            "0: as many as there are cores. The samples do not depend on it.",
        ),
        key(
            "latency_ms",
            Kind::Number(from(0.0, 600_000.0)),
            Default("200.0"),
            "A ping is delivered this long after its listening window; later is a deadline miss.",
        ),
        key(
            "status_interval_s",
            Kind::Number(from(0.1, 86_400.0)),
            Default("10.0"),
            "The counters are printed this often.",
        ),
        key(
            "queue_pings",
            Kind::Integer(1, 10_000),
            Default("4"),
            "Pings that may wait for their delivery.",
        ),
        key(
            "overload",
            Kind::Choice(&["skip", "degrade", "stretch"], &[]),
            Default("\"skip\""),
            "What becomes of a ping that had to wait for others and cannot be ready in time: it is left out; or made with a tolerance ten times looser, and ten times again, back when there is room; or pulses come later, no faster than pings can be made. Counted, and told in truth.jsonl; then, and only then, the samples depend on the machine. With clock = \"fast\" and \"lockstep\" nothing is late.",
        ),
        key(
            "simulated_compute_ms",
            Kind::Number(from(0.0, 600_000.0)),
            Default("0.0"),
            "Every ping takes at least so long to compute, and half of it at each looser tolerance: to see what an overload does. Without effect with clock = \"fast\" and \"lockstep\".",
        ),
        key(
            "delivery",
            Kind::Choice(&["ping-end", "streaming"], &[]),
            Default("\"ping-end\""),
            "\"streaming\": element samples (vita49, elements) leave as they would be heard, block by block, each stream_latency_ms after its end; the ping is computed before that, whole: ahead_ms before its pulse, or, where somebody else triggers it, after, and stream_latency_ms must have room for it; so nav.mode must be \"predict\". All else leaves at the end of the ping. The samples are the same.",
        ),
        key(
            "stream_block_ms",
            Kind::Number(from(0.1, 1000.0)),
            Default("1.0"),
            "Only with delivery = \"streaming\".",
        ),
        key(
            "stream_latency_ms",
            Kind::Number(from(0.0, 600_000.0)),
            Default("0.5"),
            "Constant. Only with delivery = \"streaming\".",
        ),
        key(
            "stream_tiles",
            Kind::Bool,
            Default("false"),
            "A ping is computed tile by tile, each twice as long as the one before, and its first blocks leave meanwhile, so that stream_latency_ms needs room for the first alone, and that for none of the scene where nothing is near enough to be heard in it: for pulses that nobody knows beforehand, on a machine that makes a ping in a quarter of its window. Only with delivery = \"streaming\", model.synthesis = \"reference\" or \"direct\", without error checks, further pulses and passband samples.",
        ),
        key(
            "ahead_ms",
            Kind::Number(from(0.0, 10_000.0)),
            Shown("100.0"),
            "A ping is computed so long before its pulse, by the settings and from the motion known then; at least what a ping takes. Left out: 0, and 100 with delivery = \"streaming\". Above 0 only with nav.mode = \"predict\".",
        ),
        key(
            "clock",
            Kind::Choice(&["realtime", "scaled", "fast", "lockstep"], &[]),
            Default("\"realtime\""),
            "\"scaled\": clock_rate times as fast; \"fast\": as fast as pings can be computed; \"lockstep\": a ping for every step that is asked for (echotank ctl step). All but \"realtime\" need recorded navigation. The samples do not depend on it.",
        ),
        key(
            "clock_rate",
            Kind::Number(from(0.1, 1000.0)),
            Default("10.0"),
            "Only with clock = \"scaled\".",
        ),
        key(
            "pace",
            Kind::Choice(&["spread", "burst"], &[]),
            Default("\"spread\""),
            "A ping's datagrams leave evenly over a part of the time to the next ping, or all at once, which a receiver with a socket buffer of stock size loses most of. TCP loses nothing: see pace_tcp. With clock = \"fast\" and \"lockstep\" always all at once.",
        ),
        key(
            "pace_share",
            Kind::Number(from(0.01, 0.95)),
            Default("0.8"),
            "The part. Only with pace = \"spread\".",
        ),
        key(
            "pace_tcp",
            Kind::Bool,
            Default("false"),
            "Records of 7k, JSF, WBMS and the Ping protocol are spread over TCP too, by the kernel (Linux); otherwise as fast as a client takes them. Only with pace = \"spread\".",
        ),
        key(
            "priority",
            Kind::Integer(0, 99),
            Default("40"),
            "SCHED_FIFO priority of the threads that hand pings over, and memory locked, where the system allows it (echotank doctor); 0: neither.",
        ),
        key(
            "compute_nice",
            Kind::Integer(-20, 0),
            Default("0"),
            "Nice value of the threads that compute pings, where the system allows it (echotank doctor): the lower, the larger their share of the processors beside other programs that only count; -20 leaves those a hundredth. 0: as any other program.",
        ),
        key(
            "fault_directory",
            Kind::Folder,
            Optional("\"out\""),
            "Where faults-TIME.jsonl and overload-TIME.jsonl go; left out: record.directory (with overload = \"skip\" the first alone), and without that nowhere.",
        ),
        key(
            "costs",
            Kind::File,
            Optional("\"costs.toml\""),
            "What methods cost on this machine, as `echotank check --calibrate FILE` writes it; left out: the table that comes with the program. What is \"auto\" is chosen by it.",
        ),
    ],
    later: &["cores"],
};

static RECORD: Table = Table {
    doc: "Records everything that is sent. Leave the table out for no recording.",
    keys: &[key(
        "directory",
        Kind::Folder,
        Required("\"out\""),
        "Made if it is not there.",
    )],
    later: &["formats", "max_gib"],
};

static CONTROL: Table = Table {
    doc: "Control over HTTP: the operator's page at http://ADDRESS/, POST /control, GET /status, /metrics, /healthz. Without `listen` there is none.",
    keys: &[
        key(
            "listen",
            Kind::Text,
            Optional("\"127.0.0.1:7780\""),
            "Address and port.",
        ),
        key(
            "token",
            Kind::Text,
            Optional("\"a long secret\""),
            "Asked of whoever controls, as `Authorization: Bearer TOKEN` or on the page. Needed where `listen` is not this machine alone.",
        ),
    ],
    later: &[],
};

static SONAR: Table = Table {
    doc: "One sonar head; write the table again for another.",
    keys: &[
        key("name", Kind::Name, Required("\"main\""), ""),
        key("serial", Kind::Integer(0, MAX_INTEGER), Default("1"), ""),
        key("pulse", Kind::Table(&PULSE), Required(""), ""),
        key("more_pulse", Kind::Tables(&MORE_PULSE), Optional(""), ""),
        key("transmit", Kind::Tables(&TRANSMIT), Required(""), ""),
        key("receive", Kind::Tables(&RECEIVE), Required(""), ""),
        key("receiver", Kind::Table(&RECEIVER), Required(""), ""),
        key("ping", Kind::Table(&PING), Required(""), ""),
        key("limits", Kind::Table(&LIMITS), Default("{}"), ""),
        key("trigger", Kind::Table(&trigger::TRIGGER), Default("{}"), ""),
        key(
            "trigger_out",
            Kind::Table(&trigger::TRIGGER_OUT),
            Default("{}"),
            "",
        ),
        key("model", Kind::Table(&MODEL), Default("{}"), ""),
        key("beams", Kind::Table(&BEAMS), Default("{}"), ""),
        key("picture", Kind::Table(&PICTURE), Default("{}"), ""),
        key("output", Kind::Table(&OUTPUT), Default("{}"), ""),
    ],
    later: &["stabilisation"],
};

static PULSE: Table = Table {
    doc: "sqrt(2) Re{ a(t) exp(j 2 pi f_c t) }, 0 <= t <= T. LFM: a = taper(t) exp(+-j pi (B/T) (t - T/2)^2), plus for an up sweep, so f_c is the frequency at mid-pulse. CW: a = taper(t).",
    keys: &[
        key(
            "kind",
            Kind::Choice(&["lfm", "cw"], &["samples"]),
            Required("\"lfm\""),
            "",
        ),
        key(
            "sweep",
            Kind::Choice(&["up", "down"], &[]),
            Default("\"up\""),
            "Only with kind = \"lfm\".",
        ),
        key(
            "center_frequency_khz",
            Kind::Number(from(0.01, 10_000.0)),
            Required("200.0"),
            "",
        ),
        key(
            "bandwidth_khz",
            Kind::Number(above(0.0, 10_000.0)),
            Shown("20.0"),
            "The whole sweep. Only with kind = \"lfm\".",
        ),
        key("duration_ms", Kind::Number(PULSE_MS), Required("2.0"), ""),
        key(
            "taper",
            Kind::Number(from(0.0, 1.0)),
            Default("0.0"),
            "Tukey taper: the part of the pulse under its two cosine flanks together.",
        ),
    ],
    later: &[],
};

static MORE_PULSE: Table = Table {
    doc: "A pulse in the water together with the sonar's own, of the same kind, duration and taper; write the table again for another. Its echoes are in the same element samples; a matched filter of its own makes side-scan lines of them (more_lines in .npz, rows of their own in the picture, records 7000 and 7007 of their own, channels of XTF, subsystems of JSF). Two pulses a ping, the second half a period later, see the bottom at twice the density. With synthesis \"direct\", \"gridded-1d\" or \"reference\".",
    keys: &[
        key(
            "sweep",
            Kind::Choice(&["up", "down"], &[]),
            Default("\"down\""),
            "Only up against down, or another band, tells pulses apart.",
        ),
        key(
            "center_frequency_khz",
            Kind::Number(from(0.01, 10_000.0)),
            Optional("200.0"),
            "Left out: the pulse's own.",
        ),
        key(
            "bandwidth_khz",
            Kind::Number(above(0.0, 10_000.0)),
            Optional("20.0"),
            "At most the pulse's own; left out: as wide.",
        ),
        key(
            "delay_ms",
            Kind::Number(from(0.0, 10_000.0)),
            Default("0.0"),
            "After the sonar's own pulse.",
        ),
        key(
            "transmit",
            Kind::Name,
            Optional("\"tx\""),
            "The transmit array that sends it to all receive arrays; left out: each one's own.",
        ),
    ],
    later: &[],
};

static TRANSMIT: Table = Table {
    doc: "One transmit array, a single radiator. Angles: with all zero the array's x axis points forward and it looks straight down; roll_deg = -60 looks to starboard and 30 degrees below the horizon, 60 to port; body_from_array = Rz(yaw) Ry(pitch) Rx(roll).",
    keys: &[
        key("name", Kind::Name, Required("\"tx\""), ""),
        key(
            "position_m",
            Kind::Numbers(3, ARM_M),
            Default("[0.0, 0.0, 0.0]"),
            "Its centre: forward, starboard, down of the reference point.",
        ),
        key("roll_deg", Kind::Number(ANGLE_DEG), Default("0.0"), ""),
        key("pitch_deg", Kind::Number(ANGLE_DEG), Default("0.0"), ""),
        key("yaw_deg", Kind::Number(ANGLE_DEG), Default("0.0"), ""),
        key(
            "pattern",
            Kind::Choice(&["omnidirectional", "rectangle"], &["circle", "table"]),
            Default("\"omnidirectional\""),
            "\"rectangle\": a flat piston, sinc(L u_x/lambda) sinc(W u_y/lambda).",
        ),
        key(
            "length_m",
            Kind::Number(SIDE_M),
            Default("0.0"),
            "Along the array's x; 0: no directivity that way. Only with pattern = \"rectangle\".",
        ),
        key(
            "width_m",
            Kind::Number(SIDE_M),
            Default("0.0"),
            "Along the array's y. Only with pattern = \"rectangle\".",
        ),
        key(
            "baffled",
            Kind::Bool,
            Default("true"),
            "Nothing goes out of the back. Only with pattern = \"rectangle\".",
        ),
        key(
            "level_offset_db",
            Kind::Number(GAIN_DB),
            Default("0.0"),
            "Added to ping.source_level_db.",
        ),
    ],
    later: &[],
};

static RECEIVE: Table = Table {
    doc: "One receive array: equal elements in a line along the array's x axis, centred on position_m. Angles as for transmit; yaw_deg = 90 lays the line across the track with its +x end to starboard.",
    keys: &[
        key("name", Kind::Name, Required("\"rx\""), ""),
        key(
            "transmit",
            Kind::Name,
            Shown("\"tx\""),
            "Whose pulse it listens to; may be left out where there is one transmit array.",
        ),
        key("elements", Kind::Integer(1, 65_535), Required("32"), ""),
        key(
            "spacing_m",
            Kind::Number(above(0.0, 100.0)),
            Shown("0.00375"),
            "Centre to centre. Needed for more than one element.",
        ),
        key(
            "position_m",
            Kind::Numbers(3, ARM_M),
            Default("[0.0, 0.0, 0.0]"),
            "",
        ),
        key("roll_deg", Kind::Number(ANGLE_DEG), Default("0.0"), ""),
        key("pitch_deg", Kind::Number(ANGLE_DEG), Default("0.0"), ""),
        key("yaw_deg", Kind::Number(ANGLE_DEG), Set("0.0", "90.0"), ""),
        key(
            "element_pattern",
            Kind::Choice(&["omnidirectional", "rectangle"], &["circle", "table"]),
            Default("\"omnidirectional\""),
            "",
        ),
        key(
            "element_length_m",
            Kind::Number(SIDE_M),
            Default("0.0"),
            "Along the line, at most the spacing. Only with element_pattern = \"rectangle\".",
        ),
        key(
            "element_width_m",
            Kind::Number(SIDE_M),
            Default("0.0"),
            "Across the line. Only with element_pattern = \"rectangle\".",
        ),
        key(
            "baffled",
            Kind::Bool,
            Default("true"),
            "Nothing is heard through the back. Only with element_pattern = \"rectangle\".",
        ),
        key(
            "sensitivity_db",
            Kind::Number(from(-400.0, 200.0)),
            Default("-190.0"),
            "dB re 1 V/uPa; 0 makes volts of micropascals.",
        ),
    ],
    later: &["element_errors", "dead_elements"],
};

static RECEIVER: Table = Table {
    doc: "From the elements' volts to samples: complex envelopes about the centre frequency.",
    keys: &[
        key(
            "sample_rate_khz",
            Kind::Number(from(0.001, 100_000.0)),
            Required("40.0"),
            "At least 1.25 (max(B, 4/T) + 2 f_d), f_d the Doppler shift at 10 m/s.",
        ),
        key(
            "rx_filter",
            Kind::Choice(&["none", "fir"], &[]),
            Set("\"none\"", "\"fir\""),
            "\"fir\": a linear-phase low-pass ahead of the sampling, its delay removed.",
        ),
        key(
            "tvg",
            Kind::Either(
                &Kind::Choice(&["none", "20logr", "30logr", "40logr"], &[]),
                &Kind::Rows,
            ),
            Default("\"none\""),
            "Time-varying gain: N log10 r + 2 alpha r, held between 0 and tvg_max_db, or a table [[range_m, db], ...].",
        ),
        key(
            "tvg_max_db",
            Kind::Number(from(0.0, 300.0)),
            Default("120.0"),
            "Only with one of the laws.",
        ),
        key(
            "noise_db",
            Kind::Number(from(-200.0, 250.0)),
            Optional("45.0"),
            "At the elements, dB re 1 uPa^2/Hz. Left out: no noise.",
        ),
        key(
            "adc_bits",
            Kind::Integer(2, 32),
            Optional("16"),
            "Left out: not quantised.",
        ),
        key(
            "full_scale_v",
            Kind::Number(above(0.0, 1.0e12)),
            Default("1.0"),
            "Volts (rms of the envelope) that fill the converter and the wire's integers.",
        ),
        key(
            "seed",
            Kind::Integer(0, MAX_INTEGER),
            Default("1"),
            "Same seed, same noise.",
        ),
    ],
    later: &["passband"],
};

static PING: Table = Table {
    doc: "The settings at the start; a topside may change them within the limits.",
    keys: &[
        key("range_m", Kind::Number(RANGE_M), Required("100.0"), ""),
        key(
            "rate_hz",
            Kind::Number(RATE_HZ),
            Shown("5.0"),
            "Or period_ms; a range too long for it lowers the rate.",
        ),
        key(
            "period_ms",
            Kind::Number(above(0.0, 1.0e6)),
            Optional("200.0"),
            "In place of rate_hz.",
        ),
        key(
            "source_level_db",
            Kind::Number(LEVEL_DB),
            Required("210.0"),
            "dB re 1 uPa at 1 m, rms.",
        ),
        key("gain_db", Kind::Number(GAIN_DB), Default("0.0"), ""),
    ],
    later: &[],
};

static LIMITS: Table = Table {
    doc: "[lowest, highest] of each setting; buffers are sized from them. Left out: the setting cannot be changed.",
    keys: &[
        key(
            "range_m",
            Kind::Numbers(2, RANGE_M),
            Optional("[10.0, 150.0]"),
            "",
        ),
        key(
            "ping_rate_hz",
            Kind::Numbers(2, RATE_HZ),
            Optional("[0.1, 20.0]"),
            "",
        ),
        key(
            "source_level_db",
            Kind::Numbers(2, LEVEL_DB),
            Optional("[170.0, 220.0]"),
            "",
        ),
        key(
            "gain_db",
            Kind::Numbers(2, GAIN_DB),
            Optional("[0.0, 80.0]"),
            "",
        ),
        key(
            "pulse_duration_ms",
            Kind::Numbers(2, PULSE_MS),
            Optional("[1.0, 5.0]"),
            "",
        ),
    ],
    later: &[],
};

static MODEL: Table = Table {
    doc: "How the echoes are computed.",
    keys: &[
        key(
            "path",
            Kind::Choice(
                &[
                    "stop-and-hop",
                    "polyline",
                    "k-segment",
                    "continuous",
                    "auto",
                ],
                &[],
            ),
            Default("\"polyline\""),
            "How the platform moves between pulse and echo: not, on straight pieces, each element on straight pieces of its own, or as it does. \"auto\" (here, of doppler and of synthesis): the cheapest that keeps the tolerance with this sonar, scene and motion; `check` says what and why.",
        ),
        key(
            "doppler",
            Kind::Choice(
                &["none", "stretch", "stretch-quadratic", "paper-eq21", "auto"],
                &["common", "rank-r"],
            ),
            Default("\"stretch\""),
            "\"stretch-quadratic\" also follows the change of the stretch during the pulse; \"paper-eq21\" is Eq. 21 of Meng et al. 2023 as printed, for comparison.",
        ),
        key(
            "synthesis",
            Kind::Choice(
                &[
                    "reference",
                    "direct",
                    "gridded-1d",
                    "gridded-2d",
                    "spectral",
                    "nearest",
                    "linear",
                    "auto",
                ],
                &["gridded"],
            ),
            Shown("\"gridded-1d\""),
            "\"reference\" solves the travel time of every sample on the continuous motion (slow, trusted; path and doppler are then not used); \"direct\" sums linearised echoes; \"gridded-1d\" does within tolerance, faster, with any doppler but \"paper-eq21\"; \"gridded-2d\" for line arrays of many elements, with the receiver filter, and any doppler but \"paper-eq21\". For comparison, with doppler \"none\" or \"paper-eq21\": \"spectral\" (the paper's sum by frequency), \"nearest\" and \"linear\" (a sampled pulse laid down). Left out: \"gridded-1d\" where it takes the doppler and the receiver has its filter, else \"direct\".",
        ),
        key(
            "tolerance",
            Kind::Number(from(1e-8, 1e-1)),
            Default("1e-3"),
            "Relative error of element samples, before noise and converter, in any stretch of them as long as the pulse: what the \"gridded\" ones are made for, and what an error check is held to.",
        ),
        key(
            "tolerance_image",
            Kind::Number(from(1e-6, 10.0)),
            Optional("0.1"),
            "Of what is \"auto\", where pictures are all that is looked at: path and doppler may displace things by so many cells of range, and by 2.5 times as many along the track, whatever the samples are off by. Left out: samples count.",
        ),
        key(
            "output",
            Kind::Choice(&["elements", "beams", "auto"], &[]),
            Default("\"elements\""),
            "What pings are made of. \"beams\": lines alone, each from parts of its array, several elements made as one, as coarse as the tolerance bears; only where nobody sees elements. \"auto\": so where it may be and is cheaper; `check` says what and why.",
        ),
        key(
            "nearest_m",
            Kind::Number(above(0.0, 20_000.0)),
            Optional("5.0"),
            "The nearest scatterer for which \"gridded-2d\" is made; pings with nearer ones are counted. Left out: 5.",
        ),
        key(
            "frequency_step_hz",
            Kind::Number(from(0.01, 1e6)),
            Optional("5.0"),
            "Of \"spectral\". Left out: one over the record, or finer. Coarser, and late echoes wrap around onto early ones.",
        ),
        key(
            "error_check",
            Kind::Bool,
            Default("false"),
            "Whether random samples are recomputed through the reference and the error found is printed. Above 1.3 times tolerance on two pings running it is a fault.",
        ),
        key(
            "segment_ms",
            Kind::Number(from(0.1, 60_000.0)),
            Default("50.0"),
            "Longest piece of the polyline.",
        ),
        key(
            "cull_db",
            Kind::Number(from(-300.0, -1.0)),
            Optional("-60.0"),
            "Scatterers whose two-way pattern lies below are left out; for targets and points it lies lower by as much as they are stronger than the ground's. Left out: with synthesis = \"gridded-1d\" or \"gridded-2d\" over a seabed and without scene.points, the highest that costs half the tolerance on flat ground; otherwise all are kept.",
        ),
    ],
    later: &["simd", "incidence"],
};

static BEAMS: Table = Table {
    doc: "What is made of the elements: side-scan lines and a fan of beams.",
    keys: &[
        key(
            "port",
            Kind::Name,
            Optional("\"rx-port\""),
            "The receive array of the port side-scan line.",
        ),
        key(
            "starboard",
            Kind::Name,
            Optional("\"rx-starboard\""),
            "The receive array of the starboard side-scan line.",
        ),
        key(
            "line_former",
            Kind::Choice(&["aperture", "dynamic-focus"], &[]),
            Default("\"aperture\""),
            "\"aperture\": the plain sum of the elements. \"dynamic-focus\": refocused along range, with the receiver's motion.",
        ),
        key(
            "line_f_number",
            Kind::Number(above(0.0, 10_000.0)),
            Optional("50.0"),
            "Dynamic aperture: the length in use is range / line_f_number, at most the whole line. Left out: the whole line everywhere. Only with line_former = \"dynamic-focus\".",
        ),
        key(
            "line_shading",
            Kind::Choice(&["uniform", "hann", "taylor", "chebyshev"], &[]),
            Default("\"uniform\""),
            "Along the line. Only with line_former = \"dynamic-focus\".",
        ),
        key(
            "line_side_lobe_db",
            Kind::Number(from(15.0, 80.0)),
            Default("30.0"),
            "Of \"taylor\" and \"chebyshev\", below the main lobe.",
        ),
        key(
            "weighting",
            Kind::Choice(&["none", "hann", "hamming", "taylor", "kaiser"], &[]),
            Default("\"none\""),
            "Along the pulse, of every matched filter: lower side lobes of the compressed pulse, wider peak.",
        ),
        key(
            "weighting_side_lobe_db",
            Kind::Number(from(15.0, 80.0)),
            Default("35.0"),
            "Of \"taylor\", below the peak.",
        ),
        key(
            "weighting_beta",
            Kind::Number(from(0.0, 20.0)),
            Default("6.0"),
            "Of \"kaiser\".",
        ),
        key("fan", Kind::Table(&FAN), Shown(""), ""),
        key(
            "synthetic_aperture",
            Kind::Table(&SYNTHETIC_APERTURE),
            Optional(""),
            "",
        ),
    ],
    later: &[],
};

static SYNTHETIC_APERTURE: Table = Table {
    doc: "A patch of the world that all pings of a replay are back-projected on, by their navigation: echotank replay --formats sas writes it as picture, NumPy array and numbers. Leave the table out for none.",
    keys: &[
        key(
            "arrays",
            Kind::Names,
            Required("[\"rx\"]"),
            "Receive arrays; each of their elements adds a row per ping.",
        ),
        key(
            "north_m",
            Kind::Numbers(2, METRES),
            Required("[-5.0, 5.0]"),
            "Southern and northern edge.",
        ),
        key(
            "east_m",
            Kind::Numbers(2, METRES),
            Required("[30.0, 40.0]"),
            "Western and eastern edge.",
        ),
        key(
            "down_m",
            Kind::Number(METRES),
            Required("20.0"),
            "The depth of all its points.",
        ),
        key(
            "cell_m",
            Kind::Number(above(0.0, 100.0)),
            Default("0.02"),
            "Side of a pixel; below half the resolution.",
        ),
    ],
    later: &[],
};

static PICTURE: Table = Table {
    doc: "How the pictures of `echotank replay --formats png,fan,masks,mosaic` look. Records and pings.npz do not depend on it.",
    keys: &[
        key(
            "range",
            Kind::Choice(&["slant", "ground", "ground-first-return"], &[]),
            Default("\"slant\""),
            "Columns of the waterfall. \"ground\": over a flat bottom as deep as the seabed under the sonar (the truth); \"ground-first-return\": as far away as the line's own first echo of the bottom.",
        ),
        key(
            "gain",
            Kind::Choice(&["received", "raw"], &[]),
            Default("\"received\""),
            "\"received\": as the receiver's time-varying gain left it. \"raw\": that gain taken out again.",
        ),
        key(
            "colours",
            Kind::Choice(&["copper", "grey", "blue", "rainbow"], &[]),
            Default("\"copper\""),
            "Of waterfall and mosaic; fans are blue.",
        ),
        key(
            "contrast",
            Kind::Choice(&["percentiles", "fixed"], &[]),
            Default("\"percentiles\""),
            "Darkest and brightest: shares of the picture's own pixels, or levels.",
        ),
        key(
            "low_percent",
            Kind::Number(from(0.0, 100.0)),
            Default("28.0"),
            "Of \"percentiles\": of the pixels are darkest (of a mosaic at most 2, since it has no water column).",
        ),
        key(
            "high_percent",
            Kind::Number(from(0.0, 100.0)),
            Default("99.997"),
            "Of \"percentiles\": of the pixels are not brightest.",
        ),
        key(
            "low_db",
            Kind::Number(from(-400.0, 400.0)),
            Default("-80.0"),
            "Of \"fixed\", dB re 1 V.",
        ),
        key(
            "high_db",
            Kind::Number(from(-400.0, 400.0)),
            Default("0.0"),
            "Of \"fixed\", dB re 1 V.",
        ),
        key(
            "flatten",
            Kind::Bool,
            Default("false"),
            "The mean level at each range is taken out.",
        ),
        key(
            "m_per_pixel",
            Kind::Number(above(0.0, 1000.0)),
            Optional("0.1"),
            "Across the waterfall. Left out: 600 pixels to a side.",
        ),
        key(
            "fan_every_pings",
            Kind::Integer(1, 1_000_000),
            Default("100"),
            "A picture of the fan for the first ping and then every so many.",
        ),
        key(
            "mosaic_m_per_pixel",
            Kind::Number(from(0.01, 1000.0)),
            Default("0.25"),
            "",
        ),
        key(
            "overlap",
            Kind::Choice(&["nearest", "mean", "last"], &[]),
            Default("\"nearest\""),
            "What a pixel of the mosaic keeps of several passes.",
        ),
        key(
            "nadir_deg",
            Kind::Number(from(0.0, 89.0)),
            Default("0.0"),
            "Directions nearer to the vertical are left out of the mosaic.",
        ),
    ],
    later: &[],
};

static FAN: Table = Table {
    doc: "Beams of one array: across the track, beam 0 port-most; or, of an array that lies fore and aft (multibeam side-scan), beam 0 aft-most. Leave the table out for none.",
    keys: &[
        key(
            "array",
            Kind::Name,
            Required("\"rx\""),
            "A receive array whose +x end points to starboard or forward.",
        ),
        key("beams", Kind::Integer(1, 4096), Required("64"), ""),
        key(
            "sector_deg",
            Kind::Number(above(0.0, 180.0)),
            Required("120.0"),
            "From the first beam to the last.",
        ),
        key(
            "center_deg",
            Kind::Number(from(-90.0, 90.0)),
            Default("0.0"),
            "Middle of the sector, from the boresight.",
        ),
        key(
            "spacing",
            Kind::Choice(&["equi-angle", "equi-distant", "equi-sine"], &[]),
            Default("\"equi-angle\""),
            "Equal steps of angle, of distance on a flat bottom, or of sine.",
        ),
        key(
            "roll_stabilised",
            Kind::Bool,
            Default("false"),
            "Angles from the vertical: the beams are steered against the roll.",
        ),
        key(
            "shading",
            Kind::Choice(&["uniform", "hann", "taylor", "chebyshev"], &[]),
            Default("\"uniform\""),
            "",
        ),
        key(
            "shading_side_lobe_db",
            Kind::Number(from(15.0, 80.0)),
            Default("30.0"),
            "Of \"taylor\" and \"chebyshev\", below the main lobe.",
        ),
        key(
            "former",
            Kind::Choice(
                &["exact", "fft", "conventional", "phase", "dynamic-focus"],
                &[],
            ),
            Default("\"exact\""),
            "Far field in f64 at every frequency; the same by fast transforms in f32 (the fastest for a line of many elements); far field with time delays or with phases, or focused along range with the receiver's motion, in f32.",
        ),
        key(
            "bottom_detection",
            Kind::Bool,
            Default("false"),
            "A sounding for each beam, from amplitude or from the phase between the two halves of the line.",
        ),
        key(
            "f_number",
            Kind::Number(above(0.0, 10_000.0)),
            Optional("50.0"),
            "The aperture in use is range / f_number, at most the whole line. Left out: the whole line everywhere. Only with former = \"dynamic-focus\".",
        ),
        key(
            "focus_error_deg",
            Kind::Number(from(0.1, 90.0)),
            Default("5.0"),
            "Carrier phase that a focus may err by at the ends of its zone of ranges. Only with former = \"dynamic-focus\".",
        ),
    ],
    later: &[],
};

static OUTPUT: Table = Table {
    doc: "The protocols this sonar speaks; one table for each.",
    keys: &[
        key("sevenk", Kind::Table(&SEVENK), Shown(""), ""),
        key("jsf", Kind::Table(&families::JSF), Optional(""), ""),
        key("xtf", Kind::Table(&families::XTF), Optional(""), ""),
        key(
            "imagenex872",
            Kind::Table(&families::IMAGENEX872),
            Optional(""),
            "",
        ),
        key("ping", Kind::Table(&devices::PING), Optional(""), ""),
        key("wbms", Kind::Table(&devices::WBMS), Optional(""), ""),
        key("vita49", Kind::Table(&samples::VITA49), Optional(""), ""),
        key(
            "elements",
            Kind::Table(&samples::ELEMENTS),
            Optional(""),
            "",
        ),
        key("sigmf", Kind::Table(&samples::SIGMF), Optional(""), ""),
        key("wav", Kind::Table(&samples::WAV), Optional(""), ""),
    ],
    later: &["kmall", "r2sonic"],
};

static SEVENK: Table = Table {
    doc: "Teledyne RESON 7k over TCP and UDP.",
    keys: &[
        key(
            "id",
            Kind::Integer(1, u32::MAX as i64),
            Required("7125"),
            "7k device id: 7125 SeaBat 7125, 103 a multibeam, 104 a side-scan.",
        ),
        key(
            "enumerator",
            Kind::Integer(0, u16::MAX as i64),
            Default("0"),
            "Tells heads with one device id apart.",
        ),
        key(
            "arrays",
            Kind::Names,
            Shown("[\"rx\"]"),
            "Receive arrays whose elements fill record 7038, in this order. Left out: all.",
        ),
        key(
            "listen",
            Kind::Text,
            Default("\"127.0.0.1:7000\""),
            "Only this computer by default: the protocol knows no password.",
        ),
        key(
            "max_packet_bytes",
            Kind::Integer(1024, 1 << 30),
            Default("60000"),
            "Longer records go out in several packets of this length.",
        ),
        key(
            "client_queue_mib",
            Kind::Integer(1, 65_536),
            Default("64"),
            "What may wait for one slow client before its records are dropped.",
        ),
        key(
            "when_full",
            Kind::Choice(&["skip", "disconnect"], &[]),
            Default("\"skip\""),
            "What becomes of a client whose queue is full: it misses whole records, or is disconnected.",
        ),
        key("max_clients", Kind::Integer(1, 1000), Default("8"), ""),
    ],
    later: &[],
};

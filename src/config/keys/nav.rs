//! The keys of `[nav]` and the tables below it.

use super::*;

const SERIAL_LINES: &[&str] = &[
    "8N1", "8E1", "8O1", "8N2", "7N1", "7E1", "7O1", "7N2", "7E2", "7O2",
];

table! {
    /// How measurements become the platform's motion. Axes: body x forward, y starboard, z down; world north, east, down.
    Nav;

    /// Where north = east = 0 lies: the first position received, or { latitude_deg = 54.3, longitude_deg = 10.1 }.
    origin: ChoiceOrTable(GeodeticOrigin: "first-fix"), Default("\"first-fix\"");

    /// "settle" waits for measurements on both sides of the ping, "predict" extrapolates. Default: settle where every source is a file, else
    /// predict.
    mode: Choice("settle", "predict"), Optional("\"predict\"");

    /// What the platform's depth is made of: "waterline" a fixed reference_depth_m plus heave, "gnss" minus the antenna's height plus
    /// datum_offset_m, "depth" a CSV track's own or a depth sensor's (provides "depth"). Heave is added only to the first.
    vertical: Choice("waterline", "gnss", "depth"), Default("\"waterline\"");

    /// Of the reference point, positive down. Only with vertical = "waterline".
    reference_depth_m: Number(METRES), Default("0.0");

    /// Added to the depth. Only with vertical = "gnss".
    datum_offset_m: Number(METRES), Default("0.0");

    /// Which UTC the records carry: the navigation's, or this computer's.
    stamp: Choice("log", "host"), Default("\"log\"");

    /// Recorded sources start again at their end, their time moved on by whole loops.
    r#loop: Bool, Default("false");

    /// Longest look ahead: on_lost says what becomes of a ping that would need a longer one. Only with mode = "predict".
    max_extrapolation_ms: Ms(from(0.0, 60_000.0)), Default("250.0");

    /// How much of the past is kept.
    history_s: Number(from(1.0, 3600.0)), Default("10.0");

    /// Where no source gives a heading, take the course over ground.
    heading_from_course: Bool, Default("false");

    /// Where several sources provide a quantity: the next one in the file speaks when the better one has been silent this long. Without it the
    /// first owns the quantity.
    failover_s: Number(above(0.0, 3600.0)), Optional("2.0");

    /// How long the better source must have come again before it has the word back. Only with failover_s.
    hold_off_s: Number(from(0.0, 3600.0)), Default("5.0");

    /// Set samples aside that lie farther from the one before than the platform can have moved, until five in a row agree.
    jump_gate: Bool, Default("false");

    /// Only with jump_gate.
    max_speed_m_per_s: Number(above(0.0, 150.0)), Default("50.0");

    /// Of heading, roll and pitch. Only with jump_gate.
    max_turn_rate_deg_per_s: Degrees(above(0.0, 1.0e4)), Default("60.0");

    /// A source is stale, in the status, when nothing came for so long; on hold when it misses three of its own intervals.
    stale_s: Number(above(0.0, 3600.0)), Default("2.0");

    /// A source is lost when nothing came for so long; not below stale_s.
    lost_s: Number(above(0.0, 86_400.0)), Default("10.0");

    /// A ping for which something is older than max_extrapolation_ms: made with the last known motion come to rest, and flagged invalid; or
    /// skipped. Only with mode = "predict".
    on_lost: Choice("hold", "skip"), Default("\"hold\"");
    tow: Table(NavTow), Optional("");
    source: Tables(NavSource), Required("");
    output: Tables(NavOutput), Optional("");
}

table! {
    /// The sonar is towed: positions are those of the ship's antennas (their lever_arm_m counts from the ship's reference point), all else is the
    /// towed body's. It follows on the heading, sqrt((cable_out_m * cable_scope)^2 - (its depth - the cable's height)^2) behind the point where
    /// the cable leaves the ship.
    NavTow;

    /// Where the cable leaves the ship: forward and starboard of the ship's reference point, down from the waterline.
    point_m: Vector(ARM_M), Default("[0.0, 0.0, 0.0]");
    cable_out_m: Number(from(0.0, 20_000.0)), Required("60.0");

    /// Straight distance over cable length: below 1 for a cable that sags.
    cable_scope: Number(above(0.0, 1.0)), Default("1.0");
}

table! {
    /// Navigation sent out, so that a device under test shares the pings' clock: at every whole second the pulse, then the ZDA that names it.
    NavOutput;
    name: Name, Required("\"clock\"");

    /// "udp" (to), "tcp" (listen, for any number of clients), "serial" (port, baud).
    kind: Choice("udp", "tcp", "serial"), Required("\"udp\"");

    /// Address and port of a host, a broadcast address or a multicast group. Only with kind = "udp".
    to: Text, Shown("\"127.0.0.1:10120\"");

    /// Only with kind = "tcp".
    listen: Text, Optional("\"127.0.0.1:10121\"");

    /// Only with kind = "serial".
    port: Text, Optional("\"/dev/ttyUSB1\"");

    /// Only with kind = "serial".
    baud: Integer(110, 4_000_000), Optional("9600");

    /// Data bits, parity and stop bits. Only with kind = "serial".
    line: ChoiceOf(SERIAL_LINES), Default("\"8N1\"");

    /// GGA is of the platform's reference point. ZDA goes out on whole seconds only, the others at every tick.
    sentences: Choices("ZDA", "GGA", "HDT"), Default("[\"ZDA\", \"GGA\", \"HDT\"]");

    /// Two capital letters.
    talker: Text, Default("\"GP\"");

    /// Ticks lie on whole seconds and between them.
    rate_hz: Number(from(0.01, 200.0)), Default("1.0");

    /// GGA and HDT go out so long after the instant they name, as a receiver's do, so that their measurements may have come; 0 carries the motion
    /// on.
    latency_ms: Ms(from(0.0, 1000.0)), Default("0.0");

    /// What marks the whole second ahead of its ZDA: the serial port's RTS or DTR raised for 100 ms, or one byte 0x07 (over UDP a datagram of its
    /// own).
    pulse: Choice("none", "rts", "dtr", "byte"), Default("\"none\"");
}

table! {
    /// A given origin, WGS84.
    GeodeticOrigin;

    /// North positive.
    latitude_deg: Degrees(from(-90.0, 90.0)), Required("54.3");

    /// East positive.
    longitude_deg: Degrees(from(-180.0, 180.0)), Required("10.1");
}

table! {
    /// One source of navigation; the first in the file that provides a quantity owns it.
    NavSource;
    name: Name, Required("\"gnss\"");

    /// "log" a recorded log (path): text, pcap, pcapng or a MAVLink tlog, told from its first bytes; "csv" a track (path) with the columns
    /// time_s, north_m, east_m, down_m, roll_deg, pitch_deg, heading_deg; "udp" (listen), "serial" (port, baud), "tcp" (connect to a server, or
    /// listen for a client).
    kind: Choice("log", "csv", "udp", "serial", "tcp"), Required("\"udp\"");

    /// File names count from this file's folder. Only with kind = "log" or "csv".
    path: File, Optional("\"data/survey.log\"");

    /// Sentences per second of a log in which neither the lines nor the messages carry a time. Only with kind = "log".
    plain_rate_hz: Number(from(0.001, 1.0e5)), Default("10.0");

    /// Address and port. Only with kind = "udp" or "tcp".
    listen: Text, Shown("\"127.0.0.1:10110\"");

    /// Host and port of a server. Only with kind = "tcp".
    connect: Text, Optional("\"192.168.1.20:10110\"");

    /// Group to join, at the interface whose address `listen` has. Only with kind = "udp".
    multicast: Text, Optional("\"239.192.0.1\"");

    /// Only with kind = "serial".
    port: Text, Optional("\"/dev/ttyUSB0\"");

    /// Only with kind = "serial".
    baud: Integer(110, 4_000_000), Optional("115200");

    /// Data bits, parity and stop bits. Only with kind = "serial".
    line: ChoiceOf(SERIAL_LINES), Default("\"8N1\"");

    /// When a measurement holds: the time in its message; the time of the last dated message of its burst, for messages that carry none; its
    /// arrival minus latency_ms.
    time: Choice("message", "burst", "arrival"), Default("\"message\"");

    /// Only with time = "arrival".
    latency_ms: Ms(from(0.0, 60_000.0)), Default("0.0");
    checksum: Choice("require", "accept-missing", "ignore"), Default("\"require\"");

    /// Sentences whose checksum is not looked at: whole addresses, or their last three letters.
    ignore_checksum_for: Names, Optional("[\"PTNTHPR\"]");

    /// What the bytes are: sentences, or records of one maker; em3000 is em1000 too.
    format: Choice("nmea", "tss1", "em3000", "seapath26", "kmb"; later "pd0", "pd6", "stdbin", "sbg"), Default("\"nmea\"");

    /// Flavours of sentences that cannot be told from the sentence: PASHR with heave + up (WASSP), where it is + down elsewhere; DPT, DBT, DBS
    /// and DBK of a depth sensor, that say how deep the platform is and not how deep the water.
    variants: Choices("pashr-heave-up", "own-depth"), Optional("[\"pashr-heave-up\"]");

    /// Quantities that this instrument sends with the opposite sign of its format's documentation.
    reverse: Choices("roll", "pitch", "heave"), Optional("[\"pitch\"]");

    /// East positive. Makes HDG and HDM true headings where the sentence carries no variation; without it they are not taken.
    magnetic_variation_deg: Degrees(from(-180.0, 180.0)), Optional("1.3");

    /// Where the antenna, or the depth sensor, sits: forward, starboard, down of the reference point.
    lever_arm_m: Vector(ARM_M), Default("[0.0, 0.0, 0.0]");

    /// Where the heave is that of: forward, starboard, down of the reference point. What roll and pitch lift that point is taken off.
    heave_arm_m: Vector(ARM_M), Default("[0.0, 0.0, 0.0]");

    /// Roll, pitch and yaw that the motion sensor (or compass) says on a level platform heading north; taken off.
    mounting_deg: VectorDegrees(ANGLE_DEG), Default("[0.0, 0.0, 0.0]");

    /// What is taken from this source; "depth" is the platform's own (PIXSE,DEPIN_, PIPS, MAVLink's relative altitude, and with variants =
    /// ["own-depth"] DPT and its kin).
    provides: Choices("position", "course-speed", "heading", "roll-pitch", "heave", "depth"), Default("[\"position\", \"course-speed\", \"heading\", \"roll-pitch\", \"heave\"]");
}

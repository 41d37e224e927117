//! The keys of `[nav]` and the tables below it.

use super::*;

const SERIAL_LINES: &[&str] = &[
    "8N1", "8E1", "8O1", "8N2", "7N1", "7E1", "7O1", "7N2", "7E2", "7O2",
];

table! {
    /// How measurements become the platform's motion. Axes: body x forward, y starboard, z down; world north, east, down.
    Nav;

    /// The point north = east = 0: the first position received, or { latitude_deg = 54.3, longitude_deg = 10.1 }.
    origin: ChoiceOrTable(GeodeticOrigin: "first-fix"), Default("\"first-fix\"");

    /// "settle" waits for measurements on both sides of the ping; "predict" extrapolates. Default: "settle" if every source is a file, else
    /// "predict".
    mode: Choice("settle", "predict"), Optional("\"predict\"");

    /// Source of the platform's depth. "waterline": reference_depth_m plus heave. "gnss": datum_offset_m minus the antenna's height. "depth": the
    /// depth of a CSV track or of a depth sensor (provides "depth"). Heave is added only with "waterline".
    vertical: Choice("waterline", "gnss", "depth"), Default("\"waterline\"");

    /// Depth of the reference point without heave, positive down. With vertical = "depth", the records state the displacement from it as heave.
    /// Default: 0, but none with a depth sensor, whose records state the depth and no heave. Not with vertical = "gnss".
    reference_depth_m: Number(METRES), Optional("30.0");

    /// Added to the depth. Only with vertical = "gnss".
    datum_offset_m: Number(METRES), Default("0.0"), only with vertical = "gnss";

    /// UTC of the records: from the navigation ("log") or from this computer ("host").
    stamp: Choice("log", "host"), Default("\"log\"");

    /// Recorded sources restart at their end, with their time shifted by whole loops.
    r#loop: Bool, Default("false");

    /// Longest extrapolation. on_lost selects the action for a ping that needs a longer one. Only with mode = "predict".
    max_extrapolation_ms: Ms(from(0.0, 60_000.0)), Default("250.0");

    /// Time for which measurements are kept.
    history_s: Number(from(1.0, 3600.0)), Default("10.0");

    /// Use the course over ground as heading if no source provides a heading. Default: true, with a warning, if all sources are files, none
    /// holds a heading and one has no `provides`; else false.
    heading_from_course: Bool, Optional("true");

    /// If several sources provide a quantity, the next one in the file takes over after the active source is silent for this time. Default: only
    /// the first is used.
    failover_s: Number(above(0.0, 3600.0)), Optional("2.0");

    /// The better source becomes active again after it has delivered for this time. Only with failover_s.
    hold_off_s: Number(from(0.0, 3600.0)), Default("5.0"), only with failover_s;

    /// Reject samples that are farther from the previous one than the platform can have moved, until five in a row agree.
    jump_gate: Bool, Default("false");

    /// Speed limit of the jump gate. Only with jump_gate.
    max_speed_m_per_s: Number(above(0.0, 150.0)), Default("50.0"), only with jump_gate = true;

    /// Limit of the rates of heading, roll and pitch. Only with jump_gate.
    max_turn_rate_deg_per_s: Degrees(above(0.0, 1.0e4)), Default("60.0"), only with jump_gate = true;

    /// The status shows a source as stale after this time without data. It shows it as on hold after three missed intervals.
    stale_s: Number(above(0.0, 3600.0)), Default("2.0");

    /// A source is lost after this time without data. Not below stale_s.
    lost_s: Number(above(0.0, 86_400.0)), Default("10.0");

    /// What to do if a ping needs data older than max_extrapolation_ms. "hold": use the last known motion, brought to rest, and flag the ping as
    /// invalid. "skip": leave the ping out. Only with mode = "predict".
    on_lost: Choice("hold", "skip"), Default("\"hold\"");
    tow: Table(NavTow), Optional("");
    source: Tables(NavSource, 32), Required("");
    output: Tables(NavOutput, 32), Optional("");
}

table! {
    /// The sonar is towed. Positions are those of the ship's antennas, and lever_arm_m counts from the ship's reference point. All other quantities
    /// are those of the towed body. The body follows along the heading, sqrt((cable_out_m * cable_scope)^2 - (body depth - tow point depth)^2) behind
    /// the tow point.
    NavTow;

    /// The tow point: forward and starboard of the ship's reference point, down from the waterline.
    point_m: Vector(ARM_M), Default("[0.0, 0.0, 0.0]");
    cable_out_m: Number(from(0.0, 20_000.0)), Required("60.0");

    /// Straight distance divided by cable length. Below 1 for a sagging cable.
    cable_scope: Number(above(0.0, 1.0)), Default("1.0");
}

table! {
    /// Navigation output, which gives a device under test the clock of the pings: at every whole second a pulse, then the ZDA with its time.
    NavOutput;
    name: Name, Required("\"clock\"");

    /// "udp" (with to), "tcp" (with listen, any number of clients), "serial" (with port, baud).
    kind: Choice("udp", "tcp", "serial"), Required("\"udp\"");

    /// Address and port of a host, a broadcast address or a multicast group. Only with kind = "udp".
    to: Text, Shown("\"127.0.0.1:10120\""), needed with kind = "udp";

    /// Address and port. Only with kind = "tcp".
    listen: Text, Optional("\"127.0.0.1:10121\""), needed with kind = "tcp";

    /// Only with kind = "serial".
    port: Text, Optional("\"/dev/ttyUSB1\""), needed with kind = "serial";

    /// Only with kind = "serial".
    baud: Integer(110, 4_000_000), Optional("9600"), needed with kind = "serial";

    /// Data bits, parity and stop bits. Only with kind = "serial".
    line: ChoiceOf(SERIAL_LINES), Default("\"8N1\""), only with kind = "serial";

    /// GGA holds the position of the platform's reference point. ZDA is sent on whole seconds only, the others at every tick.
    sentences: Choices("ZDA", "GGA", "HDT"), Default("[\"ZDA\", \"GGA\", \"HDT\"]");

    /// Two capital letters.
    talker: Text, Default("\"GP\"");

    /// Ticks per second. Ticks include the whole seconds.
    rate_hz: Number(from(0.01, 200.0)), Default("1.0");

    /// Delay of GGA and HDT after their time of validity, as from a real receiver. 0: the motion is extrapolated.
    latency_ms: Ms(from(0.0, 1000.0)), Default("0.0");

    /// Pulse at the whole second, before its ZDA: RTS or DTR of the serial port raised for 100 ms, or one byte 0x07 (over UDP in its own
    /// datagram).
    pulse: Choice("none", "rts", "dtr", "byte"), Default("\"none\"");
}

table! {
    /// A fixed origin, WGS84.
    GeodeticOrigin;

    /// North positive.
    latitude_deg: Degrees(from(-90.0, 90.0)), Required("54.3");

    /// East positive.
    longitude_deg: Degrees(from(-180.0, 180.0)), Required("10.1");
}

table! {
    /// One navigation source. The first source in the configuration that provides a quantity is used for it.
    NavSource;
    name: Name, Required("\"gnss\"");

    /// "log": a recorded log (path), which is text, pcap, pcapng or a MAVLink tlog, detected from its first bytes. "csv": a track (path) with the
    /// columns time_s, north_m, east_m, down_m, roll_deg, pitch_deg, heading_deg. "udp" (with listen), "serial" (with port, baud), "tcp" (with
    /// connect for a client, or listen for a server).
    kind: Choice("log", "csv", "udp", "serial", "tcp"), Required("\"udp\"");

    /// Relative to the folder of this file. Only with kind = "log" or "csv".
    path: File, Optional("\"data/survey.log\""), needed with kind = "log" or "csv";

    /// Sentences per second of a log without any time. Only with kind = "log".
    plain_rate_hz: Number(from(0.001, 1.0e5)), Default("10.0"), only with kind = "log";

    /// Address and port. Only with kind = "udp" or "tcp".
    listen: Text, Shown("\"127.0.0.1:10110\""), only with kind = "udp" or "tcp";

    /// Host and port of a server. Only with kind = "tcp".
    connect: Text, Optional("\"192.168.1.20:10110\""), only with kind = "tcp";

    /// Group to join on the interface with the address in `listen`. Only with kind = "udp".
    multicast: Text, Optional("\"239.192.0.1\""), only with kind = "udp";

    /// Only with kind = "serial".
    port: Text, Optional("\"/dev/ttyUSB0\""), needed with kind = "serial";

    /// Only with kind = "serial".
    baud: Integer(110, 4_000_000), Optional("115200"), needed with kind = "serial";

    /// Data bits, parity and stop bits. Only with kind = "serial".
    line: ChoiceOf(SERIAL_LINES), Default("\"8N1\""), only with kind = "serial";

    /// Time of validity of a measurement. "message": the time in the message. "burst": the time of the last dated message in the same burst, for
    /// messages without a time. "arrival": the arrival time minus latency_ms.
    time: Choice("message", "burst", "arrival"), Default("\"message\"");

    /// Only with time = "arrival".
    latency_ms: Ms(from(0.0, 60_000.0)), Default("0.0");
    checksum: Choice("require", "accept-missing", "ignore"), Default("\"require\"");

    /// Sentences whose checksum is ignored: whole addresses, or their last three letters.
    ignore_checksum_for: Names, Optional("[\"PTNTHPR\"]");

    /// NMEA sentences, or the records of one maker. em3000 includes em1000.
    format: Choice("nmea", "tss1", "em3000", "seapath26", "kmb"; later "pd0", "pd6", "stdbin", "sbg"), Default("\"nmea\"");

    /// Variants that the sentence does not state. "pashr-heave-up": PASHR with heave positive up (WASSP); elsewhere it is positive down. "own-depth":
    /// DPT, DBT, DBS and DBK hold the depth of the platform, not that of the water.
    variants: Choices("pashr-heave-up", "own-depth"), Optional("[\"pashr-heave-up\"]");

    /// Quantities that this instrument sends with the sign opposite to its format.
    reverse: Choices("roll", "pitch", "heave"), Optional("[\"pitch\"]");

    /// East positive. Converts HDG and HDM without variation to true headings. Without it those sentences are ignored.
    magnetic_variation_deg: Degrees(from(-180.0, 180.0)), Optional("1.3");

    /// Position of the antenna or depth sensor: forward, starboard, down of the reference point.
    lever_arm_m: Vector(ARM_M), Default("[0.0, 0.0, 0.0]");

    /// The point whose heave is measured: forward, starboard, down of the reference point. Its lift by roll and pitch is subtracted.
    heave_arm_m: Vector(ARM_M), Default("[0.0, 0.0, 0.0]");

    /// Roll, pitch and yaw that the motion sensor or compass reports on a level platform heading north. They are subtracted.
    mounting_deg: VectorDegrees(ANGLE_DEG), Default("[0.0, 0.0, 0.0]");

    /// Quantities that are used from this source; a ping needs each of them. "depth" is the depth of the platform (PIXSE,DEPIN_, PIPS, relative
    /// altitude of MAVLink, and with variants = ["own-depth"] DPT, DBT, DBS and DBK). Default: what a file holds, or what a live source sends.
    provides: Choices("position", "course-speed", "heading", "roll-pitch", "heave", "depth"), Optional("[\"position\", \"heading\"]");
}

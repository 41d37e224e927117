//! Accepted configurations and their meaning; the template and the schema agree with the parser.

use std::f64::consts::FRAC_PI_2;
use std::fs;
use std::path::Path;

use echotank_config::{self as config, spec::*};
use echotank_core::arrays::{Pattern, ReceiverFilter, TimeVaryingGain};
use echotank_core::model::{DopplerModel, PathModel, Synthesis};
use echotank_core::ping::Side;
use echotank_core::pulse::PulseKind;
use echotank_testing::repository;
use glam::DVec3;
use proptest::prelude::*;
use serde_json::Value;

fn load(file: &str) -> RigSpec {
    echotank_runtime::config_files::load(&repository().join(file))
        .unwrap_or_else(|errors| panic!("{errors}"))
}

fn parse(text: &str) -> RigSpec {
    echotank_runtime::config_files::parse(text, &repository().join("tests/data/config"))
        .unwrap_or_else(|errors| panic!("{errors}"))
}

fn minimal() -> String {
    fs::read_to_string(repository().join("tests/data/config/minimal.toml")).expect("readable")
}

// ---------------------------------------------------------------- what the keys mean

#[test]
fn the_least_configuration_takes_the_defaults_the_template_shows() {
    let rig = parse(&minimal());
    assert_eq!(rig.source_text, minimal());
    assert_eq!(rig.medium.sound_speed_m_per_s, 1500.0);
    assert!(matches!(
        rig.medium.absorption,
        AbsorptionSpec::FrancoisGarrison(Water { temperature_c, salinity, ph, .. })
            if (temperature_c, salinity, ph) == (10.0, 35.0, 8.0)
    ));
    assert_eq!(rig.nav.mode, NavMode::Predict, "a live source");
    assert_eq!(rig.nav.origin, OriginSpec::FirstFix);
    assert_eq!(rig.nav.max_extrapolation_s, 0.25);
    assert_eq!(rig.nav.sources[0].provides.len(), 5);
    assert_eq!(rig.scene.memory_limit_bytes, 512 << 20);
    assert_eq!(rig.run.latency_s, 0.2);
    assert!(rig.record.is_none());
    let sonar = &rig.sonars[0];
    assert_eq!(sonar.receive[0].transmit, 0, "the only transmit array");
    assert_eq!(sonar.receive[0].element_pattern, Pattern::Omnidirectional);
    assert_eq!(sonar.model.path, PathModel::Polyline);
    assert_eq!(sonar.model.doppler, DopplerModel::Stretch);
    assert_eq!(sonar.model.synthesis, Synthesis::Direct);
    assert_eq!(sonar.model.cull_db, None);
    assert_eq!(sonar.receiver.filter, ReceiverFilter::None);
    assert_eq!(
        (sonar.receiver.noise_db, sonar.receiver.adc_bits),
        (None, None)
    );
    assert!(sonar.outputs.is_empty() && sonar.beams.lines.is_empty());
    assert_eq!(
        sonar.limits,
        LimitsSpec {
            range_m: (100.0, 100.0),
            ping_rate_hz: (5.0, 5.0),
            source_level_db: (210.0, 210.0),
            gain_db: (0.0, 0.0),
            pulse_duration_s: (2e-3, 2e-3),
        },
        "without limits nothing can be changed"
    );
}

#[test]
fn overload_skips_by_default_and_degrades_or_stretches_on_request() {
    let rig = parse(&minimal());
    assert_eq!(
        (rig.run.overload, rig.run.simulated_compute_s),
        (OverloadSpec::Skip, 0.0)
    );
    let with = |run: &str| parse(&(minimal() + "\n[run]\n" + run)).run;
    let run = with("overload = \"stretch\"\nsimulated_compute_ms = 60\n");
    assert_eq!(
        (run.overload, run.simulated_compute_s),
        (OverloadSpec::Stretch, 0.06)
    );
    let gridded = "\n[sonar.model]\nsynthesis = \"gridded-1d\"\ntolerance = 2e-3\n";
    let rig = parse(&(minimal() + gridded + "\n[run]\noverload = \"degrade\"\n"));
    assert_eq!(rig.run.overload, OverloadSpec::Degrade);
    assert_eq!(rig.sonars[0].looser_tolerances(), [0.02, 0.1]);
}

#[test]
fn streaming_keys_are_read_and_pings_are_spread_by_default() {
    let rig = parse(&minimal());
    assert_eq!(rig.run.delivery, DeliverySpec::PingEnd);
    assert_eq!((rig.run.ahead_s, rig.run.spread_share), (0.0, Some(0.8)));
    let run = "\n[run]\ndelivery = \"streaming\"\nstream_latency_ms = 2\nstream_tiles = true\npace = \"burst\"\n";
    let output =
        "\n[sonar.output.elements]\nsend_to = \"127.0.0.1:5, 127.0.0.1:6\"\nsample = \"f32\"\n";
    let text = minimal().replace(
        "[[nav.source]]",
        "max_extrapolation_ms = 500\n[[nav.source]]",
    );
    let rig = parse(&(text + output + run));
    let (block_s, latency_s) = (1e-3, 2e-3);
    assert_eq!(
        rig.run.delivery,
        DeliverySpec::Streaming { block_s, latency_s }
    );
    assert_eq!((rig.run.ahead_s, rig.run.spread_share), (0.1, None));
    assert!(rig.run.stream_tiles && !rig.run.pace_tcp);
    let OutputSpec::Elements(elements) = &rig.sonars[0].outputs[0] else {
        panic!("{:?}", rig.sonars[0].outputs);
    };
    assert_eq!((elements.send_to.len(), elements.is_float), (2, true));
}

#[test]
fn units_are_shifted_without_rounding_twice() {
    // For some of these, multiplying by 1e-3 or dividing by 1e3 is one bit off.
    for digits in ["0.9", "2.1", "4.9", "5.9e0", "59e-1", "1_000.7", "4"] {
        let text = minimal().replace("duration_ms = 2.0", &format!("duration_ms = {digits}"));
        let text = text.replace("sample_rate_khz = 40.0", "sample_rate_khz = 400.7");
        let sonar = &parse(&text).sonars[0];
        let (mantissa, exponent) = digits.split_once('e').unwrap_or((digits, "0"));
        let exponent: i32 = exponent.parse::<i32>().expect("exponent") - 3;
        let want: f64 = format!("{}e{exponent}", mantissa.replace('_', ""))
            .parse()
            .expect("number");
        assert_eq!(
            sonar.pulse.duration_s.to_bits(),
            want.to_bits(),
            "{digits} ms"
        );
        assert_eq!(
            sonar.receiver.sample_rate_hz.to_bits(),
            400_700f64.to_bits()
        );
    }
}

const EVERYTHING_ELSE: &str = r#"
[medium]
sound_speed_m_per_s = 1480
absorption = { db_per_km = 30 }

[nav]
origin = { latitude_deg = 90.0, longitude_deg = -180.0 }
mode = "settle"
vertical = "gnss"
datum_offset_m = -3.5
stamp = "host"
history_s = 60
heading_from_course = true

[[nav.source]]
name = "udp"
kind = "udp"
listen = "0.0.0.0:10110"
multicast = "239.192.0.1"
time = "arrival"
latency_ms = 20.0
checksum = "ignore"
lever_arm_m = [1, -2.5, -20]
provides = ["position", "course-speed"]

[[nav.source]]
name = "tty"
kind = "serial"
port = "/dev/ttyUSB0"
baud = 38400
time = "burst"
checksum = "accept-missing"
provides = ["roll-pitch", "heave"]

[[nav.source]]
name = "log"
kind = "log"
path = "broken/track.csv"
plain_rate_hz = 0.5

[scene]
seed = 9
anchor = "first-fix"
extend = "mirror"
points = "broken/track.csv"
targets = "broken/track.csv"
memory_mib = 3

[scene.seabed]
shape = "esri-ascii"
path = "broken/track.csv"
values = "depth"
offset_north_m = 5.0
offset_east_m = -6.0
density_per_m2 = 0.5
lambert_db = -15.0
speckle = false

[run]
threads = 3
latency_ms = 2500.0
status_interval_s = 1.0
queue_pings = 9
clock = "realtime"
priority = 0
compute_nice = -3

[record]
directory = "recordings"

[[fault]]
kind = "crosstalk"
sonar = "head"
array = 0
element = 1
other = 0
value = -20.0
at_s = 60
for_s = 10
ramp_s = 5
probability = 0.5
burst = 3
seed = 8

[control]
listen = "0.0.0.0:7780"
token = "secret"

[[sonar]]
name = "head"
serial = 77

[sonar.pulse]
kind = "cw"
center_frequency_khz = 400.0
duration_ms = 0.5
taper = 0.25

[[sonar.transmit]]
name = "a"

[[sonar.transmit]]
name = "b"
position_m = [1.0, 2.0, 3.0]
roll_deg = -60.0
pattern = "rectangle"
length_m = 0.3
width_m = 0.01
baffled = false
level_offset_db = -6.0

[[sonar.receive]]
name = "one"
transmit = "b"
elements = 1
roll_deg = 60.0
element_pattern = "rectangle"
element_length_m = 0.3

[[sonar.receive]]
name = "line"
transmit = "a"
elements = 4
spacing_m = 0.002
yaw_deg = 90.0
sensitivity_db = -180.5

[sonar.receiver]
sample_rate_khz = 50.0
rx_filter = "fir"
tvg = "40logr"
tvg_max_db = 60.0
noise_db = 40.0
adc_bits = 14
full_scale_v = 2.5
seed = 3

[sonar.ping]
range_m = 50
period_ms = 125.0
source_level_db = 200.0
gain_db = 12.0

[sonar.limits]
range_m = [10.0, 75.0]
ping_rate_hz = [1.0, 8.0]
source_level_db = [190.0, 200.0]
gain_db = [12.0, 12.0]
pulse_duration_ms = [0.3, 0.5]

[sonar.model]
path = "stop-and-hop"
doppler = "none"
synthesis = "reference"
segment_ms = 10.0
cull_db = -50.0

[sonar.beams]
port = "one"
starboard = "line"

[sonar.beams.fan]
array = "line"
beams = 3
sector_deg = 90.0
shading = "hann"

[sonar.output.sevenk]
id = 13003
enumerator = 2
arrays = ["line", "one"]
listen = "127.0.0.1:0"
max_packet_bytes = 1048576
client_queue_mib = 2
max_clients = 1
"#;

#[test]
fn navigation_scene_and_pacing_keys_set_the_specification() {
    let rig = parse(EVERYTHING_ELSE);
    let here = repository().join("tests/data/config");
    let track = here.join("broken/track.csv");
    assert_eq!(
        rig.medium.absorption,
        AbsorptionSpec::Fixed { db_per_m: 0.03 }
    );
    assert_eq!(
        rig.nav.origin,
        OriginSpec::Geodetic {
            latitude_rad: FRAC_PI_2,
            longitude_rad: -2.0 * FRAC_PI_2
        }
    );
    assert_eq!(rig.nav.mode, NavMode::Settle);
    assert_eq!(
        rig.nav.vertical,
        VerticalSpec::Gnss {
            datum_offset_m: -3.5
        }
    );
    assert_eq!(rig.nav.stamp, StampSpec::Host);
    assert!(rig.nav.fallback_heading_from_course && !rig.nav.loop_log);
    let [udp, tty, log] = &rig.nav.sources[..] else {
        panic!("three sources");
    };
    assert_eq!(
        udp.input,
        NavInputSpec::Udp {
            listen: "0.0.0.0:10110".parse().expect("address"),
            multicast: Some("239.192.0.1".parse().expect("group")),
        }
    );
    assert_eq!(udp.time, TimePolicy::Arrival { latency_s: 0.02 });
    assert_eq!(udp.lever_arm_m, DVec3::new(1.0, -2.5, -20.0));
    assert_eq!(
        udp.provides,
        [NavChannel::Position, NavChannel::CourseSpeed]
    );
    assert_eq!(
        tty.input,
        NavInputSpec::Serial {
            port: "/dev/ttyUSB0".into(),
            baud: 38400,
            line: SerialLine::default()
        }
    );
    assert_eq!(
        (tty.time, tty.checksum),
        (TimePolicy::Burst, ChecksumPolicy::AcceptMissing)
    );
    assert_eq!(
        log.input,
        NavInputSpec::Log {
            path: track.clone(),
            plain_rate_hz: 0.5
        }
    );
    let scene = &rig.scene;
    assert!(scene.anchor == AnchorSpec::FirstFix && scene.mirror);
    assert_eq!((scene.seed, scene.memory_limit_bytes), (9, 3 << 20));
    assert_eq!(
        (&scene.points, &scene.targets),
        (&Some(track.clone()), &Some(track.clone()))
    );
    let seabed = scene.seabed.as_ref().expect("a seabed");
    assert!(
        !seabed.speckle
            && seabed.density == Density::PerM2(0.5)
            && seabed.bottom == BottomSpec::BistaticLambert { mu_db: -15.0 }
    );
    assert!(matches!(
        &seabed.shape,
        SeabedShape::File { file, offset_north_m, offset_east_m }
            if *file == SeabedFileSpec {
                    format: Some(SeabedFormat::EsriAscii),
                    values: Some(HeightSign::Depth),
                    ..SeabedFileSpec::of(track.clone())
                }
                && (*offset_north_m, *offset_east_m) == (5.0, -6.0)
    ));
    assert_eq!((rig.run.threads, rig.run.queue_pings), (3, 9));
    assert_eq!(rig.run.clock, ClockSpec::RealTime);
    assert_eq!((rig.run.priority, rig.run.compute_nice), (0, -3));
    assert_eq!(rig.faults.len(), 1);
    let fault = rig.faults[0].checked().expect("checked");
    assert_eq!(
        (
            fault.at_s,
            fault.for_s,
            fault.ramp_s,
            fault.burst,
            fault.seed
        ),
        (Some(60.0), 10.0, 5.0, 3, 8)
    );
    assert_eq!(
        fault.kind,
        FaultKind::Element {
            fault: ElementFault::Crosstalk { from: 0, db: -20.0 },
            array: Some(0),
            element: Some(1),
        }
    );
    assert_eq!(rig.control.listen, Some(([0, 0, 0, 0], 7780).into()));
    assert_eq!(rig.control.token.as_deref(), Some("secret"));
    assert_eq!((rig.run.latency_s, rig.run.status_interval_s), (2.5, 1.0));
    let record = rig.record.expect("a recording");
    assert_eq!(
        record.directory,
        here.join("recordings"),
        "need not be there"
    );
}

#[test]
fn sonar_keys_set_the_specification() {
    let rig = parse(EVERYTHING_ELSE);
    let sonar = &rig.sonars[0];
    assert_eq!((sonar.name.as_str(), sonar.serial), ("head", 77));
    assert_eq!(sonar.pulse.kind, PulseKind::Cw);
    assert_eq!(
        (sonar.pulse.bandwidth_hz, sonar.pulse.duration_s),
        (0.0, 5e-4)
    );
    let transmit = &sonar.transmit[1];
    assert_eq!(transmit.mounting.position_m, DVec3::new(1.0, 2.0, 3.0));
    let boresight = transmit.mounting.body_from_array * DVec3::Z;
    assert!(
        (boresight.y - 0.75f64.sqrt()).abs() < 1e-15 && (boresight.z - 0.5).abs() < 1e-15,
        "roll -60 looks to starboard and 30 degrees below the horizon: {boresight}"
    );
    assert_eq!(
        transmit.pattern,
        Pattern::Rectangle {
            length_m: 0.3,
            width_m: 0.01,
            baffled: false
        }
    );
    let [one, line] = &sonar.receive[..] else {
        panic!("two arrays");
    };
    assert_eq!((one.transmit, one.spacing_m), (1, 0.0));
    assert_eq!(
        one.element_pattern,
        Pattern::Rectangle {
            length_m: 0.3,
            width_m: 0.0,
            baffled: true
        }
    );
    assert_eq!((line.transmit, line.sensitivity_db), (0, -180.5));
    let along = line.mounting.body_from_array * DVec3::X;
    assert!((along - DVec3::Y).length() < 1e-15, "{along}");
    assert_eq!(
        sonar.receiver.tvg,
        TimeVaryingGain::Law {
            spreading: 40.0,
            absorption_db_per_m: 0.03,
            max_db: 60.0
        }
    );
    assert_eq!(sonar.receiver.filter, ReceiverFilter::Fir);
    assert_eq!(
        (sonar.receiver.adc_bits, sonar.receiver.noise_db),
        (Some(14), Some(40.0))
    );
    assert_eq!(sonar.settings.max_ping_rate_hz, 8.0, "from the period");
    assert!(sonar.settings.pinging);
    assert_eq!(sonar.limits.range_m, (10.0, 75.0));
    assert_eq!(sonar.limits.pulse_duration_s, (3e-4, 5e-4));
    assert_eq!(
        (sonar.model.path, sonar.model.doppler),
        (PathModel::StopAndHop, DopplerModel::None)
    );
    assert_eq!(
        (sonar.model.segment_s, sonar.model.cull_db),
        (0.01, Some(-50.0))
    );
    let lines: Vec<_> = sonar
        .beams
        .lines
        .iter()
        .map(|l| (l.side, l.array))
        .collect();
    assert_eq!(lines, [(Side::Port, 0), (Side::Starboard, 1)]);
    let fan = sonar.beams.fan.as_ref().expect("a fan");
    assert_eq!((fan.array, fan.beams, fan.sector_rad), (1, 3, FRAC_PI_2));
    assert_eq!(fan.shading, Shading::Hann);
    let OutputSpec::SevenK(output) = &sonar.outputs[0] else {
        panic!("7k")
    };
    assert_eq!((output.device_id, output.enumerator), (13003, 2));
    assert_eq!(output.arrays, [1, 0], "in the order written");
    assert_eq!(
        (output.max_packet, output.client_queue_bytes),
        (1 << 20, 2 << 20)
    );
}

#[test]
fn a_tvg_table_and_the_absorption_laws_are_taken_as_given() {
    let text = minimal().replace(
        "sample_rate_khz = 40.0",
        "sample_rate_khz = 40.0\ntvg = [[0, 10], [50.5, 60.0]]",
    );
    let rig = parse(&text);
    assert_eq!(
        rig.sonars[0].receiver.tvg,
        TimeVaryingGain::Table(vec![(0.0, 10.0), (50.5, 60.0)])
    );
    for (law, want) in [("none", "None"), ("ainslie-mccolm", "AinslieMcColm")] {
        let rig = parse(&format!("[medium]\nabsorption = \"{law}\"\n{}", minimal()));
        assert!(format!("{:?}", rig.medium.absorption).starts_with(want));
    }
}

// ---------------------------------------------------------------- the configurations in the repository

#[test]
fn quickstart_is_accepted_and_its_summary_is_complete() {
    let rig = load("hil-configs/quickstart.toml");
    let summary = config::summary(&rig);
    for expected in [
        "wavelength 15.25 mm, range resolution 15.2 cm", // 1525/100e3; 1525/(2 x 5e3)
        "asked 4.00, kept 4.00",
        "2397 samples per element and ping", // (2 x 150/1525 + 3e-3) s at 12 kHz
        "together 1.99 deg",                 // 2 asin(0.443 x 15.25e-3/0.39)
        "elements (7038) 14.73 Mbit/s",      // 48 x 2397 x 4 B x 4 Hz
        "127.0.0.1:7000",
    ] {
        assert!(
            summary.contains(expected),
            "no \"{expected}\" in\n{summary}"
        );
    }
}

/// sin 10 deg = 0.1736, 1 - cos 10 deg = 0.0152.
#[test]
fn the_summary_states_the_tilt_of_an_array() {
    let text = minimal().replace(
        "[[sonar.transmit]]\nname = \"tx\"\n",
        "[[sonar.transmit]]\nname = \"tx\"\nposition_m = [3.0, 2.0, 1.0]\n",
    );
    assert_ne!(text, minimal(), "the position is in");
    let summary = config::summary(&parse(&text));
    // Roll: y sin - z (1 - cos) = 0.347 - 0.015; pitch: -x sin - z (1 - cos) = -0.521 - 0.015.
    let want = "at 3.000 m forward, 2.000 starboard, 1.000 down; roll +10 deg (starboard down): sinks 0.332 m; pitch +10 deg (bow up): rises 0.536 m";
    assert!(summary.contains(want), "{summary}");
}

#[test]
fn a_range_too_long_for_the_rate_is_a_note_and_no_error() {
    let text = minimal().replace("rate_hz = 5.0", "rate_hz = 50.0");
    let summary = config::summary(&parse(&text));
    // 2 x 100/1500 s, 2 ms pulse, 1 ms between the pings.
    let want = "main: the range of 100 m is too long for 50.00 pings/s; 7.33 are kept";
    assert!(summary.contains(want), "{summary}");
}

/// Rows of a CSV of numbers, without comments and heading.
fn rows(file: &str) -> Vec<Vec<f64>> {
    let text = fs::read_to_string(repository().join(file)).expect("readable");
    text.lines()
        .filter(|line| !line.starts_with('#'))
        .skip(1)
        .map(|line| {
            line.split(',')
                .map(|n| n.parse().expect("a number"))
                .collect()
        })
        .collect()
}

#[test]
fn the_points_and_their_track_match_their_comments() {
    let rig = load("hil-configs/points.toml");
    let sonar = &rig.sonars[0];
    assert_eq!(rig.medium.absorption, AbsorptionSpec::None);
    assert_eq!(sonar.model.synthesis, Synthesis::Reference);
    assert_eq!(sonar.receiver.noise_db, None);
    assert_eq!(sonar.limits.range_m, (75.0, 75.0), "a fixed range");

    let track = rows("hil-configs/data/points_nav.csv");
    assert_eq!(track.len(), 21);
    for row in &track {
        let t = row[0] - track[0][0];
        for (k, (start, speed)) in [(0.0, 4.0), (0.0, 2.0), (5.0, 0.3)].into_iter().enumerate() {
            let want = start + speed * t;
            assert!(
                (row[1 + k] - want).abs() < 1e-12,
                "t = {t}: {} against {want}",
                row[1 + k]
            );
        }
        assert_eq!(row[4..], [3.0, -2.0, 35.0]);
    }

    let points = rows("hil-configs/data/points.csv");
    assert_eq!(points.len(), 40);
    let mut starboard = 0;
    for point in &points {
        let position = DVec3::new(point[0], point[1], point[2]);
        for row in &track {
            let slant_m = (position - DVec3::new(row[1], row[2], row[3])).length();
            assert!((20.0..=70.0).contains(&slant_m), "{position}: {slant_m} m");
        }
        // Across the course (4, 2): starboard is (-2, 4).
        if -2.0 * point[0] + 4.0 * point[1] > 0.0 {
            starboard += 1;
        }
    }
    assert_eq!(starboard, 20);
}

// ---------------------------------------------------------------- template and schema

#[test]
fn mounting_towing_and_output_keys_set_the_specification() {
    let text = EVERYTHING_ELSE
        .replace("vertical = \"gnss\"\ndatum_offset_m = -3.5", "vertical = \"depth\"")
        .replace("mode = \"settle\"", "mode = \"predict\"\non_lost = \"skip\"")
        .replace("provides = [\"roll-pitch\", \"heave\"]", "provides = [\"roll-pitch\", \"depth\"]\nline = \"7E2\"\nvariants = [\"own-depth\"]\nheave_arm_m = [1, 2, 3]\nmounting_deg = [30, 0, -90]")
        .replace("[scene]\nseed", r#"[nav.tow]
point_m = [-10, 1, -3]
cable_out_m = 120
cable_scope = 0.9

[[nav.output]]
name = "board"
kind = "serial"
port = "/dev/ttyS0"
baud = 9600
line = "8N2"
sentences = ["ZDA"]
pulse = "rts"

[[nav.output]]
name = "bridge"
kind = "udp"
to = "239.192.0.2:60002"
talker = "IN"
rate_hz = 0.5
latency_ms = 150

[scene]
seed"#);
    let nav = parse(&text).nav;
    assert_eq!(
        (nav.on_lost, nav.vertical),
        (OnLost::Skip, VerticalSpec::Depth)
    );
    let tow = TowSpec {
        point_m: DVec3::new(-10.0, 1.0, -3.0),
        cable_out_m: 120.0,
        cable_scope: 0.9,
    };
    assert_eq!(nav.tow, Some(tow));
    let tty = &nav.sources[1];
    assert_eq!(tty.mounting.heave_arm_m, DVec3::new(1.0, 2.0, 3.0));
    assert_eq!(
        tty.mounting.angles_rad,
        DVec3::new(FRAC_PI_2 / 3.0, 0.0, -FRAC_PI_2)
    );
    assert!(tty.dialect.depth_is_own && tty.provides == [NavChannel::RollPitch, NavChannel::Depth]);
    let NavInputSpec::Serial { line, .. } = &tty.input else {
        panic!("serial")
    };
    assert_eq!((line.name().as_str(), line.bits_per_byte()), ("7E2", 11));
    let board = NavOutputSpec {
        name: "board".into(),
        target: NavTargetSpec::Serial {
            port: "/dev/ttyS0".into(),
            baud: 9600,
            line: SerialLine {
                stop_bits: 2,
                ..SerialLine::default()
            },
        },
        sentences: vec![NavSentence::Zda],
        talker: "GP".into(),
        rate_hz: 1.0,
        latency_s: 0.0,
        pulse: PulseSpec::Rts,
    };
    let bridge = NavOutputSpec {
        name: "bridge".into(),
        target: NavTargetSpec::Udp {
            to: "239.192.0.2:60002".parse().expect("address"),
        },
        sentences: vec![NavSentence::Zda, NavSentence::Gga, NavSentence::Hdt],
        talker: "IN".into(),
        rate_hz: 0.5,
        latency_s: 0.15,
        pulse: PulseSpec::None,
    };
    assert_eq!(nav.outputs, [board, bridge]);
    let said = config::summary(&parse(&text));
    for words in [
        "tty: heave of a point at 1.000 m forward, 2.000 starboard, 3.000 down",
        "tty: on a level platform says roll +30.000",
        "120.0 m of cable",
        "the depth sensor's",
        "board: GPZDA to /dev/ttyS0 at 9600 Bd 8N2, 1 a second, RTS at each second ahead of its ZDA",
        "bridge: INZDA INGGA INHDT to UDP 239.192.0.2:60002, 0.5 a second",
    ] {
        assert!(said.contains(words), "no `{words}` in\n{said}");
    }
}

#[test]
fn trigger_input_and_output_keys_set_the_specification() {
    let (rest, sonar) = minimal()
        .split_once("[[sonar]]")
        .map(|(rest, sonar)| (rest.to_owned(), sonar.to_owned()))
        .expect("one");
    let mut text = rest;
    for (name, trigger) in [
        ("own", ""),
        (
            "udp",
            "[sonar.trigger]\nsource = \"udp\"\nlisten = \"0.0.0.0:10125\"\nearly = \"queue\"\nmin_interval_ms = 80\nwatchdog_ms = 2500\n[sonar.trigger_out]\nto = \"127.0.0.1:1\"\nport = \"/dev/ttyS0\"\nline = \"dtr\"\npulse_ms = 0.3",
        ),
        (
            "dcd",
            "[sonar.trigger]\nsource = \"serial-dcd\"\nport = \"/dev/ttyS1\"\nedge = \"falling\"",
        ),
        ("asked", "[sonar.trigger]\nsource = \"protocol\""),
        (
            "after",
            "[sonar.trigger]\nsource = \"sonar\"\nfollow = \"udp\"\ndelay_ms = 33.3",
        ),
    ] {
        text += &format!("[[sonar]]{}\n{trigger}\n", sonar.replace("main", name));
    }
    let sonars = parse(&text).sonars;
    let plain = TriggerSpec::default();
    assert_eq!(sonars[0].trigger, plain);
    assert_eq!(sonars[0].trigger_out, TriggerOutSpec::default());
    let udp = TriggerSpec {
        from: TriggerFrom::Udp {
            listen: "0.0.0.0:10125".parse().expect("an address"),
        },
        early: EarlyTrigger::Queue,
        min_interval_s: 0.08,
        watchdog_s: Some(2.5),
    };
    assert_eq!(sonars[1].trigger, udp);
    let out = TriggerOutSpec {
        to: Some("127.0.0.1:1".parse().expect("an address")),
        serial: Some(TriggerLineSpec {
            port: "/dev/ttyS0".into(),
            line: OutLine::DataTerminalReady,
            pulse_s: 3e-4,
        }),
    };
    assert_eq!(sonars[1].trigger_out, out);
    let line = TriggerFrom::Serial {
        port: "/dev/ttyS1".into(),
        line: ModemLine::CarrierDetect,
        rising: false,
    };
    let after = TriggerFrom::Sonar {
        sonar: 1,
        delay_s: 0.0333,
    };
    let from: Vec<_> = sonars[2..].iter().map(|s| s.trigger.from.clone()).collect();
    assert_eq!(from, [line, TriggerFrom::Protocol, after]);
}

#[test]
fn the_template_is_accepted_as_it_stands() {
    let rig = parse_template(config::template());
    assert_eq!(rig.sonars.len(), 1);
    for line in config::template().lines() {
        assert!(line.len() <= 110, "{} columns: {line}", line.len());
    }
}

#[test]
fn a_default_in_the_template_may_be_uncommented_and_changes_nothing() {
    let lines: Vec<&str> = config::template().lines().collect();
    let plain = format!("{:?}", parse_template(config::template()));
    let mut uncommented = 0;
    for (i, line) in lines.iter().enumerate() {
        let Some(assignment) = line.strip_prefix("# ") else {
            continue;
        };
        let is_default = line.ends_with("; the default")
            || lines[i.saturating_sub(1)].ends_with("; the default]");
        // Keys that have an effect only with another choice are refused without it.
        let only_beside = lines[..i]
            .iter()
            .rev()
            .take_while(|l| l.starts_with("# ") && !l.contains(" = ") || l.contains("Only with"))
            .any(|l| l.contains("Only with"));
        // The same for keys of a table that is itself commented out.
        let is_header = |l: &&&str| {
            let text = l.trim_start_matches("# ");
            text.starts_with('[') && text.ends_with(']') && !text.contains(' ')
        };
        let header = lines[..i].iter().rev().find(is_header);
        let table_is_out = header.is_some_and(|h| h.starts_with("# "));
        if !is_default || !assignment.contains(" = ") || only_beside || table_is_out {
            continue;
        }
        let mut changed = lines.clone();
        changed[i] = assignment;
        let mut rig = parse_template(&changed.join("\n"));
        rig.source_text = config::template().to_owned();
        assert_eq!(format!("{rig:?}"), plain, "{assignment}");
        uncommented += 1;
    }
    assert!(uncommented >= 30, "only {uncommented} defaults were tried");
}

fn parse_template(text: &str) -> RigSpec {
    echotank_runtime::config_files::parse(text, Path::new("/nonexistent"))
        .unwrap_or_else(|errors| panic!("{errors}"))
}

fn schema() -> Value {
    serde_json::from_str(&config::schema()).expect("the schema is JSON")
}

/// Every property name in a schema, with its path.
fn property_names(schema: &Value, path: &str, names: &mut Vec<(String, String)>) {
    for inner in schema["anyOf"].as_array().into_iter().flatten() {
        property_names(inner, path, names);
    }
    property_names_of_items(schema, path, names);
    for (name, inner) in schema["properties"].as_object().into_iter().flatten() {
        let path = format!("{path}.{name}");
        names.push((name.clone(), path.clone()));
        property_names(inner, &path, names);
    }
}

fn property_names_of_items(schema: &Value, path: &str, names: &mut Vec<(String, String)>) {
    if schema["items"].is_object() {
        property_names(&schema["items"], path, names);
    }
}

#[test]
fn every_key_of_the_schema_stands_in_the_template() {
    let mut names = Vec::new();
    property_names(&schema(), "", &mut names);
    assert!(names.len() > 120, "only {} keys", names.len());
    let mut missing = Vec::new();
    for (name, path) in names {
        let header = path.trim_start_matches('.');
        let stands = config::template().lines().any(|line| {
            let line = line.trim_start_matches("# ");
            line.starts_with(&format!("{name} = "))
                || line.starts_with(&format!("[{header}]"))
                || line.starts_with(&format!("[[{header}]]"))
                || line.contains(&format!("{{ {name} = "))
                || line.contains(&format!(", {name} = "))
        });
        if !stands {
            missing.push(path);
        }
    }
    assert!(missing.is_empty(), "{missing:?}");
}

/// Whether `value` is valid under the subset of JSON Schema that the schema uses; unknown keywords fail the test.
fn valid(schema: &Value, value: &Value) -> bool {
    let known = [
        "$schema",
        "title",
        "description",
        "default",
        "type",
        "enum",
        "anyOf",
        "properties",
        "required",
        "additionalProperties",
        "items",
        "minItems",
        "maxItems",
        "minLength",
        "pattern",
        "minimum",
        "exclusiveMinimum",
        "maximum",
    ];
    let rules = schema.as_object().expect("a schema is an object");
    rules.iter().all(|(word, rule)| {
        assert!(known.contains(&word.as_str()), "{word}");
        let number = |v: &Value| v.as_f64().expect("a number");
        match word.as_str() {
            "type" => match rule.as_str().expect("a type") {
                "object" => value.is_object(),
                "array" => value.is_array(),
                "string" => value.is_string(),
                "boolean" => value.is_boolean(),
                "integer" => value.is_i64() || value.is_u64(),
                _ => value.is_number(),
            },
            "enum" => rule.as_array().expect("choices").contains(value),
            "anyOf" => rule
                .as_array()
                .expect("schemas")
                .iter()
                .any(|s| valid(s, value)),
            "properties" => value.as_object().is_none_or(|table| {
                table
                    .iter()
                    .all(|(name, inner)| rule.get(name).is_some_and(|s| valid(s, inner)))
            }),
            "required" => rule
                .as_array()
                .expect("names")
                .iter()
                .all(|name| value.get(name.as_str().expect("a name")).is_some()),
            "items" => value
                .as_array()
                .is_none_or(|items| items.iter().all(|i| valid(rule, i))),
            "minItems" => value
                .as_array()
                .is_none_or(|i| i.len() as f64 >= number(rule)),
            "maxItems" => value
                .as_array()
                .is_none_or(|i| i.len() as f64 <= number(rule)),
            "minLength" => value.as_str().is_none_or(|s| !s.is_empty()),
            "pattern" => value.as_str().is_none_or(|s| {
                (1..=32).contains(&s.len())
                    && s.chars()
                        .all(|c| c.is_ascii_alphanumeric() || c == '-' || c == '_')
            }),
            "minimum" => value.as_f64().is_none_or(|v| v >= number(rule)),
            "exclusiveMinimum" => value.as_f64().is_none_or(|v| v > number(rule)),
            "maximum" => value.as_f64().is_none_or(|v| v <= number(rule)),
            _ => true,
        }
    })
}

fn as_json(text: &str) -> Value {
    let table: toml::Table = text.parse().expect("TOML");
    serde_json::to_value(table).expect("plain data")
}

#[test]
fn accepted_configurations_are_valid_under_the_schema() {
    let schema = schema();
    let mut texts = vec![
        config::template().to_owned(),
        minimal(),
        EVERYTHING_ELSE.to_owned(),
    ];
    for file in ["hil-configs/points.toml", "hil-configs/quickstart.toml"] {
        texts.push(fs::read_to_string(repository().join(file)).expect("readable"));
    }
    for text in texts {
        assert!(valid(&schema, &as_json(&text)), "{text}");
    }
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 600, ..ProptestConfig::default() })]

    /// Replaces single values: accepted means valid, so an editor with the schema never marks a correct value.
    #[test]
    fn a_changed_configuration_that_is_accepted_is_valid_under_the_schema(
        line in any::<usize>(),
        value in prop::sample::select(vec![
            "0", "1", "-1", "0.5", "7", "60.0", "1e6", "-45.0", "true", "false", "\"none\"", "\"rectangle\"", "\"line\"", "\"one\"",
            "[1.0, 2.0]", "[1, 2, 3]", "[\"line\"]", "[[0.0, 1.0]]", "{ db_per_km = 1.0 }", "\"settle\"", "\"127.0.0.1:0\"", "12000",
        ]),
    ) {
        let lines: Vec<&str> = EVERYTHING_ELSE.lines().collect();
        let at = line % lines.len();
        let mut changed: Vec<String> = lines.iter().map(|l| (*l).to_owned()).collect();
        if let Some((key, _)) = lines[at].split_once(" = ") {
            changed[at] = format!("{key} = {value}");
        }
        let text = changed.join("\n");
        if echotank_runtime::config_files::parse(&text, &repository().join("tests/data/config")).is_ok() {
            prop_assert!(valid(&schema(), &as_json(&text)), "{}", changed[at]);
        }
    }
}

#[test]
fn any_line_may_be_left_out_and_is_either_not_needed_or_missed_by_name() {
    for (text, folder) in [
        (EVERYTHING_ELSE.to_owned(), "tests/data/config"),
        (config::template().to_owned(), "tests/data/config"),
    ] {
        let lines: Vec<&str> = text.lines().collect();
        for i in 0..lines.len() {
            let mut left = lines.clone();
            left.remove(i);
            if let Err(errors) =
                echotank_runtime::config_files::parse(&left.join("\n"), &repository().join(folder))
            {
                assert!(!errors.problems.is_empty());
                let said = errors.to_string();
                assert!(!said.contains("without a reason"), "{}: {said}", lines[i]);
            }
        }
    }
}

/// The minimal configuration with `lines` in `[sonar.model]`.
fn with_model(lines: &str) -> RigSpec {
    let filtered = minimal().replace(
        "sample_rate_khz = 40.0",
        "sample_rate_khz = 40.0\nrx_filter = \"fir\"",
    );
    parse(&format!("{filtered}\n[sonar.model]\n{lines}\n"))
}

#[test]
fn every_path_doppler_and_synthesis_is_selected_by_its_name() {
    for path in PathModel::ALL {
        for doppler in DopplerModel::ALL {
            for synthesis in Synthesis::ALL {
                let torn = (path, synthesis) == (PathModel::Polyline, Synthesis::Gridded2d);
                if !synthesis.takes(doppler) || torn {
                    continue;
                }
                let rig = with_model(&format!(
                    "path = \"{}\"\ndoppler = \"{}\"\nsynthesis = \"{}\"\ntolerance = 2e-2",
                    path.name(),
                    doppler.name(),
                    synthesis.name()
                ));
                let model = &rig.sonars[0].model;
                assert_eq!(
                    (model.path, model.doppler, model.synthesis),
                    (path, doppler, synthesis)
                );
                if synthesis != Synthesis::Reference {
                    let summary = config::summary(&rig);
                    assert!(summary.contains(path.name()), "{summary}");
                }
            }
        }
    }
    let spec = with_model("").sonars[0].synthesis;
    assert_eq!((spec.error_check, spec.frequency_step_hz), (false, None));
    assert_eq!(spec.tolerance, 1e-3);
    let spec = with_model(
        "error_check = true\ntolerance = 2e-5\nsynthesis = \"spectral\"\ndoppler = \"none\"\nfrequency_step_hz = 2.5",
    );
    let spec = spec.sonars[0].synthesis;
    assert_eq!(
        (spec.error_check, spec.frequency_step_hz),
        (true, Some(2.5))
    );
    assert_eq!(spec.tolerance, 2e-5);
}

/// The fast engine where it certainly reaches its tolerance, otherwise the exact sum.
#[test]
fn the_default_synthesis_is_an_engine_with_the_filter_and_the_direct_sum_without() {
    let chosen = |filter: &str, doppler: &str| {
        let text = minimal().replace(
            "sample_rate_khz = 40.0",
            &format!("sample_rate_khz = 40.0\nrx_filter = \"{filter}\""),
        );
        let text = format!("{text}\n[sonar.model]\ndoppler = \"{doppler}\"\n");
        parse(&text).sonars[0].model.synthesis
    };
    for doppler in ["none", "stretch", "stretch-quadratic"] {
        assert_eq!(chosen("fir", doppler), Synthesis::Gridded1d);
        assert_eq!(chosen("none", doppler), Synthesis::Direct);
    }
    assert_eq!(chosen("fir", "paper-eq21"), Synthesis::Direct);
}

#[test]
fn every_rig_of_the_repository_is_accepted() {
    let folder = repository().join("hil-configs");
    let mut seen = 0;
    for entry in std::fs::read_dir(folder).expect("a folder") {
        let path = entry.expect("an entry").path();
        if path.extension().is_some_and(|e| e == "toml") {
            let loaded = echotank_runtime::config_files::load(&path);
            assert!(loaded.is_ok(), "{}: {:?}", path.display(), loaded.err());
            seen += 1;
        }
    }
    assert!(seen > 10, "{seen} rigs");
}

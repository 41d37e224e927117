//! Tests of the detection of quantities in logs without a configured `provides`.

use echotank_config::spec::{NavChannel, NavInputSpec, NavSpec, VerticalSpec};
use echotank_core::navigation::{FixQuality, NavQuantity, NavSample};
use echotank_core::time::UtcNs;
use echotank_nav::detection::{detect, owners_text};
use echotank_nav::log::read_log;
use echotank_testing::nav::{nav, source};

use crate::log_source;

/// Logs without a configured `provides`.
fn open_logs(names: &[&str]) -> NavSpec {
    let of = |name: &&str| {
        let input = NavInputSpec::Log {
            path: (*name).into(),
            plain_rate_hz: 10.0,
        };
        let mut source = source(name, input, &NavChannel::ALL);
        source.detect = true;
        source
    };
    nav(names.iter().map(of).collect())
}

fn bytes(name: &str) -> Vec<u8> {
    let logs = echotank_testing::repository().join("tests/data/navlogs");
    std::fs::read(logs.join(name)).expect("test data")
}

/// One sample of a quantity per second.
fn samples(channel: NavChannel, seconds: std::ops::Range<i64>) -> Vec<NavSample> {
    let quantity = match channel {
        NavChannel::Position => NavQuantity::Position {
            latitude_rad: 0.9,
            longitude_rad: 0.1,
            height_m: None,
            fix: FixQuality::Autonomous,
        },
        NavChannel::CourseSpeed => NavQuantity::CourseSpeed {
            course_rad: 1.0,
            speed_m_per_s: 2.0,
        },
        NavChannel::Heading => NavQuantity::Heading { heading_rad: 1.0 },
        NavChannel::RollPitch => NavQuantity::RollPitch {
            roll_rad: 0.0,
            pitch_rad: 0.0,
        },
        NavChannel::Heave => NavQuantity::Heave { heave_down_m: 0.0 },
        NavChannel::Depth => NavQuantity::Depth { depth_m: 3.0 },
    };
    let at = |s: i64| NavSample {
        source: 0,
        valid_utc: UtcNs(0).plus_s(s as f64),
        arrival_utc: UtcNs(0).plus_s(s as f64),
        quantity,
    };
    seconds.map(at).collect()
}

fn owners(spec: &NavSpec) -> String {
    owners_text(spec, |channel| {
        let first = spec
            .sources
            .iter()
            .position(|s| s.provides.contains(&channel))?;
        u16::try_from(first).ok()
    })
}

#[test]
fn a_log_gives_what_it_holds_and_the_first_log_owns_each_quantity() {
    use NavChannel::{Heading, Heave, Position, RollPitch};
    let mut spec = open_logs(&["gyro", "ins"]);
    let gyro = samples(Heading, 0..100);
    let ins = [Position, Heading, RollPitch]
        .map(|c| samples(c, 0..100))
        .concat();
    let warnings = detect(&mut spec, &[gyro, ins]).expect("complete");
    assert_eq!(
        owners(&spec),
        "position from ins, heading from gyro, roll-pitch from ins"
    );
    assert_eq!(
        warnings,
        ["no source gives heave: the platform does not heave"]
    );
    assert!(spec.sources.iter().all(|s| !s.detect));
    assert!(!spec.sources[1].provides.contains(&Heave));
}

#[test]
fn a_quantity_of_a_short_time_is_left_out_unless_nothing_can_stand_for_it() {
    use NavChannel::{CourseSpeed, Heading, Position, RollPitch};
    let log = [
        samples(Position, 0..100),
        samples(CourseSpeed, 0..100),
        samples(Heading, 0..30),
        samples(RollPitch, 0..70),
    ]
    .concat();
    let mut spec = open_logs(&["log"]);
    let warnings = detect(&mut spec, std::slice::from_ref(&log)).expect("complete");
    assert_eq!(
        owners(&spec),
        "position from log, course-speed from log, roll-pitch from log"
    );
    assert_eq!(
        warnings[0],
        "log gives heading for 29 s of 99 s: not used; `provides` would select it"
    );
    assert!(
        warnings[1].contains("the course over ground is used"),
        "{warnings:?}"
    );
    assert_eq!(spec.heading_from_course, Some(true));

    let mut spec = open_logs(&["log"]);
    spec.heading_from_course = Some(false);
    detect(&mut spec, &[log]).expect("complete");
    assert!(spec.sources[0].provides.contains(&Heading));
}

#[test]
fn what_every_ping_needs_is_named_with_a_remedy() {
    use NavChannel::{Heading, Position};
    let refusal = |spec: &mut NavSpec, samples: Vec<NavSample>| {
        detect(spec, &[samples])
            .expect_err("incomplete")
            .to_string()
    };
    assert_eq!(
        refusal(&mut open_logs(&["gyro"]), samples(Heading, 0..9)),
        "no source gives a position: gyro gives heading; add a source that does"
    );
    let mut spec = open_logs(&["gnss"]);
    spec.heading_from_course = Some(false);
    assert_eq!(
        refusal(&mut spec, samples(Position, 0..9)),
        "no source gives a heading: gnss gives position; add a source that does, or set nav.heading_from_course = true"
    );
    let mut spec = open_logs(&["gnss"]);
    spec.vertical = VerticalSpec::Depth;
    let refused = refusal(&mut spec, samples(Position, 0..9));
    assert!(refused.contains("no source gives a depth"), "{refused}");
}

#[test]
fn what_is_configured_stays_as_it_is() {
    let mut spec = open_logs(&["gnss"]);
    spec.sources[0].detect = false;
    let before = spec.sources[0].provides.clone();
    let warnings = detect(&mut spec, &[samples(NavChannel::Position, 0..9)]).expect("unchanged");
    assert_eq!((warnings.len(), &spec.sources[0].provides), (0, &before));
}

#[test]
fn every_log_of_the_repository_gives_a_position_or_says_what_it_lacks() {
    let position = "position from log";
    let course = "position from log, course-speed from log";
    for (file, want) in [
        (
            "zeus_1200.log",
            "position from log, course-speed from log, heading from log",
        ),
        (
            "gofree_900.log",
            "position from log, course-speed from log, heading from log",
        ),
        (
            "rst39_oxts_pashr.log",
            "position from log, course-speed from log, heading from log, roll-pitch from log, heave from log",
        ),
        ("bluerov_udp.txt", course),
        ("mayara_udp10110.pcap", position),
        ("bluerov_90kB.tlog", position),
    ] {
        let mut spec = open_logs(&["log"]);
        let read = log_source(&NavChannel::ALL);
        let (samples, ..) = read_log(&bytes(file), 0, &read, 10.0);
        let found = detect(&mut spec, &[samples]);
        found.unwrap_or_else(|e| panic!("{file}: {e}"));
        assert!(owners(&spec).starts_with(want), "{file}: {}", owners(&spec));
    }
    let mut spec = open_logs(&["log"]);
    let read = log_source(&NavChannel::ALL);
    let (samples, ..) = read_log(&bytes("em122depth_300.rvdas"), 0, &read, 10.0);
    assert!(detect(&mut spec, &[samples]).is_err());
}

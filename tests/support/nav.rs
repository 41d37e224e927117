//! Navigation specifications with defaults. A test sets the fields that it examines.

use echotank_config::spec::{
    ChecksumPolicy, NavChannel, NavInputSpec, NavMode, NavSourceSpec, NavSpec, OnLost, OriginSpec,
    StampSpec, TimePolicy, VerticalSpec,
};
use glam::DVec3;

/// Source at the reference point, timed by arrival.
pub fn source(name: &str, input: NavInputSpec, provides: &[NavChannel]) -> NavSourceSpec {
    NavSourceSpec {
        name: name.into(),
        input,
        time: TimePolicy::Arrival { latency_s: 0.0 },
        checksum: ChecksumPolicy::Require,
        lever_arm_m: DVec3::ZERO,
        mounting: Default::default(),
        dialect: Default::default(),
        provides: provides.to_vec(),
        detect: false,
    }
}

/// Datagrams at a free port of this machine.
pub fn udp() -> NavInputSpec {
    NavInputSpec::Udp {
        listen: ([127, 0, 0, 1], 0).into(),
        multicast: None,
    }
}

/// Navigation in mode `settle` of a surface vessel, with the reference point at the waterline and 60 s of
/// history.
pub fn nav(sources: Vec<NavSourceSpec>) -> NavSpec {
    NavSpec {
        origin: OriginSpec::FirstFix,
        mode: NavMode::Settle,
        vertical: VerticalSpec::Waterline {
            reference_down_m: 0.0,
        },
        heave_from_depth_m: None,
        stamp: StampSpec::Log,
        loop_log: false,
        max_extrapolation_s: 0.25,
        history_s: 60.0,
        heading_from_course: None,
        failover: None,
        jump_gate: None,
        stale_s: 2.0,
        lost_s: 10.0,
        on_lost: OnLost::Skip,
        tow: None,
        recording: None,
        outputs: Vec::new(),
        sources,
    }
}

/// NMEA 0183 sentence: `body` between `$` and the checksum, with its line end.
pub fn sentence(body: &str) -> Vec<u8> {
    let sum = body.bytes().fold(0, |s, b| s ^ b);
    format!("${body}*{sum:02X}\r\n").into_bytes()
}

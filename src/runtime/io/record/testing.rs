//! A small sonar and its pings for tests of the recorders: two receive arrays of two and three elements, a fan of three beams, two lines.

use echotank_protocols::sevenk::file::FileHeader7200;
use echotank_protocols::sevenk::{OpenRecord, RecordStamp, SevenKTime};
use glam::DVec3;
use num_complex::{Complex32, Complex64};

use echotank_config::spec::{BeamsSpec, FanForm, FanSpec, LimitsSpec, Shading, SonarSpec};
use echotank_core::arrays::{
    ArrayGeometry, Mounting, Pattern, Receiver, TimeVaryingGain, TransmitArray,
};
use echotank_core::frames::{Trajectory, rotation_from_angles};
use echotank_core::ping::{BeamFrame, ElementFrame, Line, PingOutput, PingPlan, Side};
use echotank_core::pulse::{Pulse, PulseKind};
use echotank_core::testing::plan_at_rest;
use echotank_core::time::UtcNs;

const SAMPLES: usize = 20;

fn pulse() -> Pulse {
    Pulse {
        kind: PulseKind::LfmUp,
        center_frequency_hz: 400e3,
        bandwidth_hz: 30e3,
        duration_s: 1e-3,
        taper: 0.0,
    }
}

fn mounting(across_m: f64) -> Mounting {
    Mounting {
        position_m: DVec3::new(0.5, across_m, 0.7),
        body_from_array: rotation_from_angles(0.0, 0.0, 0.3),
    }
}

/// The sonar.
pub fn sonar() -> SonarSpec {
    let plan = plan(1);
    let transmit = |across_m| TransmitArray {
        mounting: mounting(across_m),
        pattern: Pattern::Omnidirectional,
        level_offset_db: 0.0,
    };
    let receive = |across_m, elements| ArrayGeometry {
        mounting: mounting(across_m),
        elements,
        spacing_m: 0.1,
        radius_m: None,
        element_pattern: Pattern::Rectangle {
            length_m: 0.1,
            width_m: 0.01,
            baffled: true,
        },
        sensitivity_db: -180.0,
        transmit: 0,
    };
    let base = echotank_testing::wire::sonar();
    SonarSpec {
        name: "bow".into(),
        serial: 7,
        pulse: pulse(),
        transmit: vec![transmit(-0.3), transmit(0.3)],
        transmit_names: vec!["port".into(), "starboard".into()],
        receive: vec![receive(-0.3, 2), receive(0.3, 3)],
        receive_names: vec!["port".into(), "starboard".into()],
        receiver: Receiver {
            sample_rate_hz: 40e3,
            tvg: TimeVaryingGain::None,
            full_scale_v: 1.0,
            ..base.receiver
        },
        settings: plan.settings,
        limits: LimitsSpec {
            range_m: (1.0, 10.0),
            ping_rate_hz: (0.1, 10.0),
            source_level_db: (200.0, 220.0),
            gain_db: (0.0, 20.0),
            pulse_duration_s: (1e-3, 1e-3),
        },
        model: plan.model,
        beams: BeamsSpec {
            fan: Some(FanSpec {
                array: 1,
                beams: 3,
                sector_rad: 1.0,
                shading: Shading::Uniform,
                form: FanForm::default(),
            }),
            ..base.beams
        },
        ..base
    }
}

/// Plan of a ping.
pub fn plan(ping_number: u32) -> PingPlan {
    let start = DVec3::new(3.0 * f64::from(ping_number), 7.0, 1.5);
    PingPlan {
        ping_number,
        transmit_utc: UtcNs(1_400_000_000_000_000_000 + i64::from(ping_number) * 250_000_000),
        trajectory: Trajectory::uniform(
            start,
            DVec3::new(1.5, -0.2, 0.01),
            rotation_from_angles(0.02, -0.01, 0.4),
        ),
        ..plan_at_rest(&pulse(), SAMPLES, 1500.0)
    }
}

/// Output of a ping; all samples differ and none is a multiple of a power of two.
pub fn output(ping_number: u32) -> PingOutput {
    let iq = |rows: usize, salt: f64| {
        (0..rows * SAMPLES)
            .map(|i| {
                let x = f64::from(ping_number) + salt + i as f64 / 7.0;
                Complex64::new(x.sin(), x.cos() / 3.0)
            })
            .collect::<Vec<_>>()
    };
    let elements = [2, 3]
        .into_iter()
        .enumerate()
        .map(|(array, elements)| ElementFrame {
            array,
            elements,
            samples: SAMPLES,
            iq: iq(elements, 10.0 * array as f64),
            saturated: 0,
        })
        .collect();
    let line = |side, salt| Line {
        side,
        amplitude: iq(1, salt).iter().map(|x| x.norm() as f32).collect(),
    };
    PingOutput {
        error_check: None,
        elements,
        soundings: Vec::new(),
        beams: vec![BeamFrame {
            beams: 3,
            samples: SAMPLES,
            angle_rad: vec![-0.5, 0.0, 0.5],
            width_rad: vec![0.3; 3],
            iq: iq(3, 100.0)
                .iter()
                .map(|x| Complex32::new(x.re as f32, x.im as f32))
                .collect(),
        }],
        lines: vec![line(Side::Port, 200.0), line(Side::Starboard, 300.0)],
        ..PingOutput::default()
    }
}

/// Time stamp of records in the `.s7k` files of the tests.
pub(crate) fn s7k_stamp() -> RecordStamp {
    RecordStamp {
        time: SevenKTime::from_utc_ns_clamped(1_400_000_000_123_000_000),
        device_id: 104,
        system_enumerator: 1,
    }
}

pub(crate) fn s7k_header() -> FileHeader7200 {
    FileHeader7200 {
        recording_name: "test".into(),
        ..FileHeader7200::default()
    }
}

pub(crate) fn s7k_record(record_type_id: u32, data: &[u8]) -> Vec<u8> {
    let mut bytes = Vec::new();
    let open = OpenRecord::begin(&mut bytes, record_type_id, &s7k_stamp());
    bytes.extend_from_slice(data);
    open.finish(&mut bytes);
    bytes
}

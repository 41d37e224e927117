//! Small sonar, its ping, and bytes of its clients, for the protocol tests.

use std::f64::consts::FRAC_PI_3;
use std::sync::Arc;

use echotank_config::spec::{
    BeamsSpec, FanForm, FanSpec, LimitsSpec, LineSpec, PictureSpec, SevenKSpec, Shading, SonarSpec,
    SynthesisSpec, TriggerOutSpec, TriggerSpec,
};
use echotank_core::arrays::{
    ArrayGeometry, Mounting, Pattern, Receiver, ReceiverFilter, TimeVaryingGain, TransmitArray,
};
use echotank_core::frames::{Trajectory, rotation_from_angles};
use echotank_core::model::{DopplerModel, ModelChoice, PathModel, Synthesis};
use echotank_core::navigation::{FixQuality, NavState};
use echotank_core::ping::{BeamFrame, ElementFrame, Line, PingOutput, PingPlan, Segment, Side};
use echotank_core::pulse::{Pulse, PulseKind};
use echotank_core::settings::SonarSettings;
use echotank_core::testing::plan_at_rest;
use echotank_core::time::UtcNs;
use echotank_emit::sevenk::records::DeviceSheet;
use echotank_protocols::sevenk::{Command, ControlRequest, Packetiser, RecordStamp, SevenKTime};
use echotank_runtime::clock::VirtualClock;
use echotank_runtime::settings::SettingsStore;
use glam::{DQuat, DVec3};
use num_complex::{Complex32, Complex64};

/// 2025-06-15 15:06:40 UTC.
pub const TRANSMIT_UTC: UtcNs = UtcNs(1_750_000_000_000_000_000);
pub const PULSE_S: f64 = 0.5;
pub const SAMPLE_RATE_HZ: f64 = 1000.0;
pub const FULL_SCALE_V: f64 = 2.0;
pub const SOUND_M_PER_S: f64 = 1500.0;
pub const ABSORPTION_DB_PER_M: f64 = 0.1;
pub const SERIAL: u64 = 0x1122_3344_5566_7788;
pub const DEVICE: u32 = 103;
pub const ENUMERATOR: u16 = 2;

pub const SETTINGS: SonarSettings = SonarSettings {
    pinging: true,
    range_m: 75.0,
    max_ping_rate_hz: 5.0,
    source_level_db: 210.0,
    gain_db: 20.0,
    pulse_duration_s: PULSE_S,
};

fn array(elements: usize, roll_rad: f64, yaw_rad: f64) -> ArrayGeometry {
    ArrayGeometry {
        mounting: Mounting {
            position_m: DVec3::new(1.0, 2.0, 3.0),
            body_from_array: rotation_from_angles(roll_rad, 0.0, yaw_rad),
        },
        elements,
        spacing_m: 0.01,
        radius_m: None,
        element_pattern: Pattern::Omnidirectional,
        sensitivity_db: -200.0,
        transmit: 0,
    }
}

/// Sonar with port and starboard side-scan arrays of 2 and 3 elements, and a fan of 4 beams from 5
/// elements.
pub fn sonar() -> SonarSpec {
    SonarSpec {
        name: "rig <1> & \"co\"".into(),
        serial: SERIAL,
        pulse: Pulse {
            kind: PulseKind::LfmUp,
            center_frequency_hz: 100_000.0,
            bandwidth_hz: 500.0,
            duration_s: PULSE_S,
            taper: 0.1,
        },
        more_pulses: Vec::new(),
        transmit: vec![TransmitArray {
            mounting: Mounting {
                position_m: DVec3::new(0.5, -0.25, 0.125),
                body_from_array: rotation_from_angles(-FRAC_PI_3, 0.0, 0.0),
            },
            pattern: Pattern::Rectangle {
                length_m: 0.5,
                width_m: 0.02,
                baffled: true,
            },
            level_offset_db: 0.0,
        }],
        transmit_names: vec!["starboard".into()],
        receive: vec![
            array(2, FRAC_PI_3, 0.0),
            array(3, -FRAC_PI_3, 0.0),
            array(5, 0.0, 1.57),
        ],
        receive_names: vec!["port".into(), "starboard".into(), "fan".into()],
        receiver: Receiver {
            sample_rate_hz: SAMPLE_RATE_HZ,
            filter: ReceiverFilter::None,
            tvg: TimeVaryingGain::Law {
                spreading: 30.0,
                absorption_db_per_m: 0.1,
                max_db: 80.0,
            },
            noise_db: None,
            adc_bits: None,
            full_scale_v: FULL_SCALE_V,
            seed: 1,
        },
        instrument: None,
        settings: SETTINGS,
        limits: LimitsSpec {
            range_m: (5.0, 200.0),
            ping_rate_hz: (0.1, 20.0),
            source_level_db: (160.0, 220.0),
            gain_db: (0.0, 60.0),
            pulse_duration_s: (1e-4, 1.0),
        },
        trigger: TriggerSpec::default(),
        trigger_out: TriggerOutSpec::default(),
        model: ModelChoice {
            path: PathModel::StopAndHop,
            doppler: DopplerModel::None,
            synthesis: Synthesis::Direct,
            segment_s: 0.01,
            cull_db: None,
        },
        synthesis: SynthesisSpec::default(),
        beams: BeamsSpec {
            focused_lines: false,
            line_f_number: None,
            synthetic_aperture: None,
            line_shading: Shading::Uniform,
            weighting: Shading::Uniform,
            lines: vec![
                LineSpec {
                    side: Side::Port,
                    array: 0,
                },
                LineSpec {
                    side: Side::Starboard,
                    array: 1,
                },
            ],
            fan: Some(FanSpec {
                array: 2,
                beams: 4,
                sector_rad: 2.0,
                shading: Shading::Uniform,
                form: FanForm::default(),
            }),
        },
        picture: PictureSpec::default(),
        outputs: Vec::new(),
    }
}

/// Small sonar with one array of `elements` elements and as many beams. Both lines are of this array.
pub fn large_sonar(elements: usize) -> SonarSpec {
    let mut sonar = sonar();
    sonar.receive = vec![sonar.receive[2].clone()];
    sonar.receive[0].elements = elements;
    for line in &mut sonar.beams.lines {
        line.array = 0;
    }
    sonar.beams.fan = Some(FanSpec {
        array: 0,
        beams: elements,
        sector_rad: 2.0,
        shading: Shading::Uniform,
        form: FanForm::default(),
    });
    sonar
}

/// Elements and beams of a ping of [`large_sonar`].
pub fn large_output(elements: usize, samples: usize) -> PingOutput {
    let value = |k: usize| Complex64::from_polar(0.5 + 0.001 * (k % 997) as f64, k as f64 * 0.37);
    let iq: Vec<_> = (0..elements * samples).map(value).collect();
    let beams = iq.iter().copied().map(narrow).collect();
    PingOutput {
        elements: vec![ElementFrame {
            array: 0,
            elements,
            samples,
            iq,
            saturated: 0,
        }],
        beams: vec![BeamFrame {
            beams: elements,
            samples,
            angle_rad: (0..elements).map(|b| b as f64 * 0.007 - 0.9).collect(),
            width_rad: vec![0.01; elements],
            iq: beams,
        }],
        ..PingOutput::default()
    }
}

/// Output with the elements of starboard before those of port, and without those of the fan.
pub fn output_spec() -> SevenKSpec {
    SevenKSpec {
        has_common_files: false,
        listen: "127.0.0.1:0".parse().expect("an address"),
        device_id: DEVICE,
        enumerator: ENUMERATOR,
        arrays: vec![1, 0],
        max_packet: 60_000,
        client_queue_bytes: 1 << 20,
        disconnect_when_full: false,
        third_parties: Vec::new(),
        max_clients: 8,
    }
}

pub fn sheet() -> Arc<DeviceSheet> {
    sheet_of(&sonar())
}

pub fn sheet_of(sonar: &SonarSpec) -> Arc<DeviceSheet> {
    Arc::new(DeviceSheet::new(
        &output_spec(),
        sonar,
        SOUND_M_PER_S,
        ABSORPTION_DB_PER_M,
    ))
}

pub fn store() -> Arc<SettingsStore> {
    Arc::new(SettingsStore::new(
        SETTINGS,
        sonar().limits,
        Arc::new(VirtualClock::default()),
    ))
}

pub fn plan(ping_number: u32, samples: usize) -> PingPlan {
    let trajectory = Trajectory::uniform(DVec3::ZERO, DVec3::X, DQuat::IDENTITY);
    PingPlan {
        ping_number,
        transmit_utc: TRANSMIT_UTC,
        stamp_utc: TRANSMIT_UTC,
        ping_period_s: 0.25,
        settings: SETTINGS,
        ping_rate_hz: 4.0,
        absorption_db_per_m: ABSORPTION_DB_PER_M,
        model: sonar().model,
        nav: NavState {
            utc: TRANSMIT_UTC,
            pose: trajectory.pose_at(0.0),
            roll_rad: 0.03,
            pitch_rad: -0.02,
            heading_rad: 4.5,
            heave_down_m: 0.75,
            latitude_rad: 0.9,
            longitude_rad: -0.1,
            height_m: -12.5,
            fix: FixQuality::RtkFixed,
            position_age_s: 0.1,
            attitude_age_s: 0.01,
            ..NavState::default()
        },
        trajectory,
        segments: vec![Segment {
            start_s: 0.0,
            position_m: DVec3::ZERO,
            velocity_m_per_s: DVec3::X,
            world_from_body: DQuat::IDENTITY,
        }],
        ..plan_at_rest(&sonar().pulse, samples, SOUND_M_PER_S)
    }
}

fn narrow(z: Complex64) -> Complex32 {
    Complex32::new(z.re as f32, z.im as f32)
}

/// Voltages that identify array, element and sample.
pub fn volts(array: usize, element: usize, sample: usize) -> Complex64 {
    Complex64::new(
        0.1 * (array + 1) as f64 + 0.01 * element as f64,
        -0.001 * (sample % 1000) as f64,
    )
}

pub fn output(samples: usize) -> PingOutput {
    let elements = sonar()
        .receive
        .iter()
        .enumerate()
        .map(|(array, geometry)| ElementFrame {
            array,
            elements: geometry.elements,
            samples,
            iq: (0..geometry.elements)
                .flat_map(|e| (0..samples).map(move |k| volts(array, e, k)))
                .collect(),
            saturated: 0,
        })
        .collect();
    let beams = BeamFrame {
        beams: 4,
        samples,
        angle_rad: vec![-0.75, -0.25, 0.25, 0.75],
        width_rad: vec![0.4, 0.3, 0.31, 0.41],
        iq: (0..4)
            .flat_map(|b| {
                (0..samples).map(move |k| {
                    let phase_rad = -1.0 + 0.001 * (k % 1000) as f64;
                    narrow(Complex64::from_polar(0.23 * (b + 1) as f64, phase_rad))
                })
            })
            .collect(),
    };
    let line = |side, scale: f32| Line {
        side,
        amplitude: (0..samples).map(|k| scale * (k % 1000) as f32).collect(),
    };
    PingOutput {
        error_check: None,
        elements,
        beams: vec![beams],
        lines: vec![line(Side::Port, 0.001), line(Side::Starboard, 0.002)],
        ..PingOutput::default()
    }
}

// ---------------------------------------------------------------- clients' bytes

/// Record 7500 (command) to a device.
pub fn command_record(command: Command, ticket: u32, device: u32, enumerator: u16) -> Vec<u8> {
    let stamp = RecordStamp {
        time: SevenKTime::from_utc_ns_clamped(0),
        device_id: device,
        system_enumerator: enumerator,
    };
    let mut record = Vec::new();
    ControlRequest {
        ticket,
        tracking_number: [u64::from(ticket) << 40, 7],
        command,
    }
    .emit(&mut record, &stamp);
    record
}

/// Record in one packet.
pub fn packet(record: &[u8]) -> Vec<u8> {
    let mut wire = Vec::new();
    Packetiser::whole_records().packetise(record, &mut wire);
    wire
}

/// Command to the Center, with network frame.
pub fn command(command: Command, ticket: u32) -> Vec<u8> {
    packet(&command_record(command, ticket, 7000, 0))
}

// ---------------------------------------------------------------- bytes by offset

pub fn u16_at(bytes: &[u8], at: usize) -> u16 {
    u16::from_le_bytes(bytes[at..at + 2].try_into().expect("2 bytes"))
}
pub fn i16_at(bytes: &[u8], at: usize) -> i16 {
    u16_at(bytes, at) as i16
}
pub fn u32_at(bytes: &[u8], at: usize) -> u32 {
    u32::from_le_bytes(bytes[at..at + 4].try_into().expect("4 bytes"))
}
pub fn f32_at(bytes: &[u8], at: usize) -> f32 {
    f32::from_bits(u32_at(bytes, at))
}
pub fn u64_at(bytes: &[u8], at: usize) -> u64 {
    u64::from_le_bytes(bytes[at..at + 8].try_into().expect("8 bytes"))
}
pub fn f64_at(bytes: &[u8], at: usize) -> f64 {
    f64::from_bits(u64_at(bytes, at))
}

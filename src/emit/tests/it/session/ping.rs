//! Tests of the Ping protocol: requests, replies, and the content of the next ping.

use std::net::SocketAddr;
use std::ops::Range;

use echotank_protocols::ping_protocol::common::{GeneralRequest, SetDeviceId};
use echotank_protocols::ping_protocol::omniscan450::{
    OsMonoProfile, OsPingParams, SetSpeedOfSound,
};
use echotank_protocols::ping_protocol::surveyor240::SetPingParameters;
use echotank_protocols::ping_protocol::{Frame, Message, emit_frame};

use std::sync::Arc;

use echotank_config::spec::{PingDevice, PingProtocolSpec};
use echotank_core::ping::{Detection, PingOutput, PingPlan, Side, Sounding};
use echotank_core::records::Datagram;
use echotank_core::settings::{ChangeOrigin, SettingChange, SettingsPort, StoredKey, StoredValue};
use echotank_core::time::UtcNs;
use echotank_emit::ping_protocol::session::PingPort;
use echotank_emit::ping_protocol::{Device, PingEmitter};
use echotank_emit::session::{Outgoing, Protocol, Session, Transport};
use echotank_protocols::ping_protocol::message_id;
use echotank_runtime::settings::SettingsStore;
use proptest::prelude::*;

use echotank_testing::wire as wire_rig;

/// Time of power-up of the device.
const NOW: UtcNs = wire_rig::TRANSMIT_UTC;

fn spec(device: PingDevice) -> PingProtocolSpec {
    PingProtocolSpec {
        device,
        listen: "127.0.0.1:0".parse().expect("address"),
        serial: None,
        channel: (1, 2),
        client_queue_bytes: 1 << 20,
        max_clients: 2,
    }
}

const OMNISCAN: PingDevice = PingDevice::Omniscan450 { side: Side::Port };

/// A ping of the small test sonar: 200 samples at 1 kHz.
fn ping() -> (PingPlan, PingOutput) {
    (wire_rig::plan(1, 200), wire_rig::output(200))
}

/// Client of a device, with the settings of its session.
struct Bench {
    device: Arc<Device>,
    settings: Arc<SettingsStore>,
    client: Box<dyn Session>,
}

fn bench(kind: PingDevice, transport: Transport) -> Bench {
    let sonar = wire_rig::sonar();
    let settings = wire_rig::store();
    let device = Arc::new(Device::new(&spec(kind), &sonar, 1500.0, NOW));
    let port = PingPort::new(Arc::clone(&device), Arc::clone(&settings) as _);
    let peer: SocketAddr = "127.0.0.1:9".parse().expect("address");
    let client = port.connect(transport, peer);
    Bench {
        device,
        settings,
        client,
    }
}

impl Bench {
    fn say(&mut self, bytes: &[u8]) -> Vec<Vec<u8>> {
        let mut out = Vec::new();
        self.client.receive(bytes, NOW, &mut out);
        out.into_iter()
            .map(|item| match item {
                Outgoing::Reply(datagram) => datagram.bytes,
                other => panic!("{other:?}"),
            })
            .collect()
    }

    /// Sends a command and returns the answer.
    fn ask(&mut self, emit: impl FnOnce(&mut Vec<u8>) -> Range<usize>) -> Answer {
        answer(&self.say(&bytes_of(emit)))
    }

    fn os(&mut self, change: impl FnOnce(&mut OsPingParams)) -> Answer {
        let mut params = OsPingParams {
            start_mm: 0,
            length_mm: 80_000,
            msec_per_ping: 200,
            pulse_len_percent: 0.1,
            filter_duration_percent: 0.0015,
            gain_index: -1,
            num_results: 600,
            enable: 1,
        };
        change(&mut params);
        self.ask(|buf| params.emit_frame(buf, 0, 1))
    }

    fn surveyor(&mut self, change: impl FnOnce(&mut SetPingParameters)) -> Answer {
        let mut params = SetPingParameters {
            start_mm: 0,
            end_mm: 80_000,
            sos_mps: 1480.0,
            gain_index: -1,
            msec_per_ping: 200,
            diagnostic_injected_signal: 0,
            ping_enable: 1,
            enable_channel_data: 0,
            reserved_for_raw_data: 0,
            enable_yz_point_data: 0,
            enable_atof_data: 1,
            target_ping_hz: 240_000,
            n_range_steps: 400,
            pulse_len_steps: 40.0,
        };
        change(&mut params);
        self.ask(|buf| params.emit_frame(buf, 0, 1))
    }
}

fn bytes_of(emit: impl FnOnce(&mut Vec<u8>) -> Range<usize>) -> Vec<u8> {
    let mut bytes = Vec::new();
    emit(&mut bytes);
    bytes
}

#[derive(Debug, PartialEq)]
enum Answer {
    Ack,
    Nack(String),
}

fn answer(replies: &[Vec<u8>]) -> Answer {
    let [bytes] = replies else {
        panic!("{} answers", replies.len())
    };
    let frame = Frame::parse(bytes).expect("a frame");
    match Message::parse(&frame).expect("a message") {
        Message::Ack(_) => Answer::Ack,
        Message::Nack { text, .. } => Answer::Nack(text),
        other => panic!("{other:?}"),
    }
}

#[test]
fn each_control_of_the_omniscan_is_acknowledged_and_in_the_settings() {
    let mut bench = bench(OMNISCAN, Transport::Tcp);
    let start = bench.settings.settings();
    let limits = *bench.settings.limits();
    assert_eq!(bench.os(|p| p.length_mm = 60_000), Answer::Ack);
    let settings = bench.settings.settings();
    assert_eq!((settings.range_m, settings.max_ping_rate_hz), (60.0, 5.0));
    // One tenth of 2 x 60 m / 1500 m/s.
    assert!((settings.pulse_duration_s - 8e-3).abs() < 1e-9);
    assert_eq!(
        settings.gain_db, start.gain_db,
        "automatic gain changes nothing"
    );
    assert_eq!(bench.os(|p| p.start_mm = 1000), Answer::Ack);
    assert_eq!(bench.settings.settings().range_m, 81.0);
    assert_eq!(bench.device.requested().start_m, 1.0);
    assert_eq!(bench.os(|p| p.gain_index = 7), Answer::Ack);
    assert_eq!(bench.settings.settings().gain_db, limits.gain_db.1);
    assert_eq!(bench.os(|p| p.msec_per_ping = 500), Answer::Ack);
    assert_eq!(bench.settings.settings().max_ping_rate_hz, 2.0);
    // A period of 0 and a negative period select the maximum rate.
    for msec in [0, 1] {
        assert_eq!(bench.os(|p| p.msec_per_ping = msec), Answer::Ack);
        let rate_hz = bench.settings.settings().max_ping_rate_hz;
        assert_eq!(rate_hz, limits.ping_rate_hz.1);
    }
    assert_eq!(bench.os(|p| p.enable = 0), Answer::Ack);
    assert!(!bench.settings.settings().pinging);
    assert_eq!(bench.os(|p| p.num_results = 1200), Answer::Ack);
    assert!(bench.settings.settings().pinging);
    assert_eq!(bench.device.requested().num_results, 1200);
}

#[test]
fn a_command_with_one_wrong_value_is_refused_with_a_reason_and_no_effect() {
    let mut bench = bench(OMNISCAN, Transport::Tcp);
    let before = (bench.settings.settings(), bench.device.requested());
    type Change = fn(&mut OsPingParams);
    let wrong: [(&str, Change); 7] = [
        ("range_m = 200.001: must be from 5 to 200", |p| {
            p.length_mm = 200_001
        }),
        ("length_mm must be above 0", |p| p.length_mm = 0),
        ("max_ping_rate_hz = 0.05", |p| p.msec_per_ping = 20_000),
        ("gain_index must be -1 or from 0 to 7", |p| p.gain_index = 8),
        ("num_results must be from 200 to 1200", |p| {
            p.num_results = 199
        }),
        ("num_results must be from 200 to 1200", |p| {
            p.num_results = 1201
        }),
        ("the pulse length", |p| p.pulse_len_percent = f32::NAN),
    ];
    for (words, change) in wrong {
        // The values before the wrong value are valid, so a partial acceptance would be visible.
        let got = bench.os(|p| {
            (p.start_mm, p.msec_per_ping, p.enable) = (0, 333, 0);
            change(p);
        });
        let Answer::Nack(text) = got else {
            panic!("{words}: obeyed")
        };
        assert!(text.contains(words), "{text}; wanted {words}");
        assert_eq!(
            (bench.settings.settings(), bench.device.requested()),
            before,
            "{words}"
        );
    }
    let counts = bench.client.counts();
    assert_eq!((counts.commands, counts.nacks), (7, 7));
}

#[test]
fn settings_without_a_model_are_stored_and_unsupported_ones_refused() {
    let mut bench = bench(OMNISCAN, Transport::Tcp);
    let speed_of_sound_mm_per_s: u32 = 1_480_500;
    let set = SetSpeedOfSound {
        speed_of_sound_mm_per_s,
    };
    // 169 reads the setting and 170 sets it.
    let set_sync = |buf: &mut Vec<u8>, n: u8| {
        emit_frame(buf, message_id::SET_SYNC_CHANNEL, 0, 1, |buf| {
            buf.extend([n, 2])
        })
    };
    assert_eq!(bench.ask(|buf| set.emit_frame(buf, 0, 1)), Answer::Ack);
    // The message number of earlier definitions is acknowledged under that number.
    let id = message_id::SET_SPEED_OF_SOUND_EARLIER;
    let answered = bench.say(&bytes_of(|buf| {
        emit_frame(buf, id, 0, 1, |buf| {
            buf.extend(speed_of_sound_mm_per_s.to_le_bytes());
        })
    }));
    let frame = Frame::parse(&answered[0]).expect("a frame");
    let acked = Message::parse(&frame).expect("a message");
    assert!(
        matches!(acked, Message::Ack(ack) if ack.acked_id == id),
        "{acked:?}"
    );
    let key = StoredKey {
        via: "ping",
        name: "speed_of_sound",
        place: 0,
    };
    assert_eq!(
        bench.settings.stored(key),
        Some(StoredValue::Numbers(vec![1480.5]))
    );
    assert_eq!(bench.ask(|buf| set_sync(buf, 0)), Answer::Ack);
    assert_eq!(bench.device.requested().sync.channel_number, 0);
    let refused = bench.ask(|buf| set_sync(buf, 2));
    assert!(matches!(refused, Answer::Nack(_)));
    let id = SetDeviceId { device_id: 9 };
    assert_eq!(bench.ask(|buf| id.emit_frame(buf, 0, 1)), Answer::Ack);
    // The device now identifies itself as 9.
    let mut bytes = Vec::new();
    GeneralRequest { requested_id: 4 }.emit_frame(&mut bytes, 5, 9);
    let [information] = &bench.say(&bytes)[..] else {
        panic!("one answer")
    };
    let frame = Frame::parse(information).expect("a frame");
    assert_eq!(
        (frame.message_id, frame.source, frame.destination),
        (4, 9, 5)
    );
    // The command of the multibeam sonar, and a message that this device does not have.
    for (id, payload) in [
        (message_id::SET_PING_PARAMETERS, 36),
        (message_id::GENERAL_REQUEST, 2),
    ] {
        let answer =
            bench.ask(|buf| emit_frame(buf, id, 0, 1, |buf| buf.resize(buf.len() + payload, 0)));
        assert!(matches!(answer, Answer::Nack(_)), "{id}");
    }
}

#[test]
fn each_control_of_the_surveyor_is_acknowledged_and_in_the_settings() {
    let mut bench = bench(PingDevice::Surveyor240, Transport::Tcp);
    let mut out = Vec::new();
    bench.client.greet(NOW, &mut out);
    assert_eq!(out.len(), 1, "it asks for the time");
    let limits = *bench.settings.limits();
    assert_eq!(bench.surveyor(|p| p.end_mm = 60_000), Answer::Ack);
    let settings = bench.settings.settings();
    assert_eq!((settings.range_m, settings.max_ping_rate_hz), (60.0, 5.0));
    // The start is at least 5 % of the range.
    assert!((bench.device.requested().start_m - 3.0).abs() < 1e-12);
    assert_eq!(bench.surveyor(|p| p.gain_index = 100), Answer::Ack);
    assert_eq!(bench.settings.settings().gain_db, limits.gain_db.1);
    assert_eq!(bench.surveyor(|p| p.end_mm = 0), Answer::Ack);
    assert_eq!(
        bench.settings.settings().range_m,
        80.0,
        "automatic range changes nothing"
    );
    assert_eq!(bench.surveyor(|p| p.ping_enable = 0), Answer::Ack);
    assert!(!bench.settings.settings().pinging);
    let yz = |p: &mut SetPingParameters| (p.enable_yz_point_data, p.enable_atof_data) = (1, 0);
    assert_eq!(bench.surveyor(yz), Answer::Ack);
    let requested = bench.device.requested();
    assert_eq!((requested.wants_yz, requested.wants_atof), (true, false));
    let wrong: [fn(&mut SetPingParameters); 6] = [
        |p| p.end_mm = 201_000,
        |p| p.start_mm = 80_000,
        |p| p.gain_index = 101,
        |p| p.n_range_steps = 801,
        |p| p.enable_channel_data = 1,
        |p| p.reserved_for_raw_data = 1,
    ];
    let before = (bench.settings.settings(), bench.device.requested());
    for (n, change) in wrong.into_iter().enumerate() {
        assert!(matches!(bench.surveyor(change), Answer::Nack(_)), "{n}");
        assert_eq!(
            (bench.settings.settings(), bench.device.requested()),
            before,
            "{n}"
        );
    }
}

#[test]
fn commands_come_in_pieces_over_tcp_and_garbage_is_counted_and_passed_over() {
    let mut bench = bench(OMNISCAN, Transport::Tcp);
    let mut bytes = b"not a frame".to_vec();
    GeneralRequest { requested_id: 5 }.emit_frame(&mut bytes, 0, 1);
    let (front, back) = bytes.split_at(bytes.len() - 3);
    assert!(bench.say(front).is_empty());
    assert!(bench.client.is_waiting());
    assert_eq!(bench.say(back).len(), 1);
    assert!(bench.client.counts().framing_errors >= 1);
    // A wrong length hides the following data until the message is abandoned.
    let mut bytes = b"BR\xFF\xFF\x06\x00\x00\x00".to_vec();
    GeneralRequest { requested_id: 4 }.emit_frame(&mut bytes, 0, 1);
    assert!(bench.say(&bytes).is_empty() && bench.client.is_waiting());
    let mut out = Vec::new();
    bench.client.give_up_waiting(NOW, &mut out);
    assert_eq!(out.len(), 1);
}

#[test]
fn over_udp_every_datagram_is_independent() {
    let mut bench = bench(OMNISCAN, Transport::Udp);
    assert!(bench.say(b"BR\xFF\xFF").is_empty());
    let mut bytes = Vec::new();
    GeneralRequest { requested_id: 4 }.emit_frame(&mut bytes, 0, 1);
    assert_eq!(bench.say(&bytes).len(), 1, "what came before is forgotten");
}

/// The frames of one ping of the device.
fn frames(device: &Arc<Device>, plan: &PingPlan, output: &PingOutput) -> Vec<Arc<Datagram>> {
    let mut into = Vec::new();
    PingEmitter::new(Arc::clone(device), 1).emit_ping(plan, output, &mut into);
    into
}

#[test]
fn a_profile_is_the_line_in_db_over_the_range_that_was_asked_for() {
    let mut bench = bench(OMNISCAN, Transport::Tcp);
    bench.os(|p| (p.start_mm, p.length_mm, p.num_results) = (20_000, 60_000, 1200));
    let (mut plan, mut output) = ping();
    plan.settings.range_m = 80.0;
    plan.transmit_utc = NOW.plus_s(2.5);
    plan.nav.heading_rad = 359.9_f64.to_radians();
    // 1 mV everywhere, and 100 mV at sample 67, which is at 50.25 m.
    let line = &mut output.lines[0];
    assert_eq!(line.side, Side::Port);
    line.amplitude = vec![1e-3; 200];
    line.amplitude[67] = 0.1;
    let sent = frames(&bench.device, &plan, &output);
    let frame = Frame::parse(&sent[0].bytes).expect("a frame");
    let profile = OsMonoProfile::parse(frame.payload).expect("a profile");
    let head = profile.head;
    assert_eq!(
        (head.start_mm, head.length_mm, head.num_results),
        (20_000, 60_000, 1200)
    );
    assert_eq!(
        (head.timestamp_ms, head.channel_number, head.sos_dmps),
        (2500, 1, 15_000)
    );
    assert!((head.vehicle_heading_deg - 359.9).abs() < 1e-4);
    assert!((head.transducer_heading_deg - 269.9).abs() < 1e-4);
    let results: Vec<f64> = profile.results_db().collect();
    // The levels are 60 dB and, at the target, 100 dB re 1 uV. A result is 50 mm long, a sample 0.75 m.
    let loudest = (0..1200).max_by(|&a, &b| results[a].total_cmp(&results[b]));
    let loudest_m = 20.0 + (loudest.expect("some") as f64 + 0.5) * 0.05;
    assert!((loudest_m - 67.0 * 0.75).abs() <= 0.05, "{loudest_m}");
    let step_db = (100.0 - 60.0) / 65_535.0;
    assert!((results[0] - 60.0).abs() < step_db, "{}", results[0]);
    assert!(
        (f64::from(head.max_pwr_db) - 100.0).abs() < 0.01,
        "{}",
        head.max_pwr_db
    );
}

#[test]
fn points_attitude_and_sides_are_in_the_devices_axes() {
    let mut bench = bench(PingDevice::Surveyor240, Transport::Tcp);
    bench.surveyor(|p| p.enable_yz_point_data = 1);
    for (roll_deg, pitch_deg) in [(5.0_f64, 3.0_f64), (-7.0, -2.0)] {
        let (mut plan, mut output) = ping();
        plan.nav.roll_rad = roll_deg.to_radians();
        plan.nav.pitch_rad = pitch_deg.to_radians();
        plan.nav.heave_down_m = 0.4;
        let sounding = |angle_deg: f64, range_m: f64| Sounding {
            beam: 0,
            angle_rad: angle_deg.to_radians(),
            twtt_s: 2.0 * range_m / 1500.0,
            error_s: 0.0,
            detection: Detection::Amplitude,
            level_v: 1.0,
        };
        // A flat seabed 20 m below. Starboard is to the right.
        let angles_deg = [-60.0_f64, -10.0, 0.0, 45.0];
        output.soundings = angles_deg
            .map(|a| sounding(a, 20.0 / a.to_radians().cos()))
            .into();
        let mut seen = 0;
        for sent in frames(&bench.device, &plan, &output) {
            let frame = Frame::parse(&sent.bytes).expect("a frame");
            let near = |got: f32, want: f64| {
                assert!(
                    (f64::from(got) - want).abs() < 1e-4 * want.abs().max(1.0),
                    "{got}, {want}"
                );
            };
            match Message::parse(&frame).expect("a message") {
                Message::AttitudeReport(report) => {
                    // The up vector has a component to port when starboard is down, and forward when the bow is up.
                    near(report.up[0], plan.nav.pitch_rad.sin());
                    near(
                        report.up[1],
                        plan.nav.pitch_rad.cos() * plan.nav.roll_rad.sin(),
                    );
                    assert_eq!(report.up[1] > 0.0, roll_deg > 0.0);
                }
                Message::AtofPointData(data) => {
                    for (point, angle_deg) in data.points().zip(angles_deg) {
                        near(point.angle_rad, -angle_deg.to_radians());
                        let depth_m = 750.0
                            * f64::from(point.two_way_time_s)
                            * f64::from(point.angle_rad).cos();
                        near(depth_m as f32, 20.0);
                    }
                }
                Message::YzPointData(data) => {
                    for ([y, z], angle_deg) in data.points().zip(angles_deg) {
                        near(z, -20.0);
                        near(y, -20.0 * angle_deg.to_radians().tan());
                    }
                    assert!((data.head.heave_m + 0.4).abs() < 1e-6, "up is positive");
                }
                other => panic!("{other:?}"),
            }
            seen += 1;
        }
        assert_eq!(seen, 3);
    }
}

proptest! {
    #[test]
    fn no_bytes_make_a_session_panic_or_leave_the_limits(bytes in proptest::collection::vec(any::<u8>(), 36), id in 0..4_usize) {
        let id = [message_id::OS_PING_PARAMS, message_id::SET_PING_PARAMETERS, message_id::SET_SPEED_OF_SOUND, message_id::SET_NET_INFO][id];
        for kind in [OMNISCAN, PingDevice::Surveyor240] {
            let mut bench = bench(kind, Transport::Tcp);
            let mut frame = Vec::new();
            emit_frame(&mut frame, id, 0, 1, |buf| buf.extend(&bytes));
            bench.say(&frame);
            let (s, l) = (bench.settings.settings(), bench.settings.limits());
            prop_assert!((l.range_m.0..=l.range_m.1).contains(&s.range_m));
            prop_assert!((l.gain_db.0..=l.gain_db.1).contains(&s.gain_db));
            prop_assert!((l.pulse_duration_s.0..=l.pulse_duration_s.1).contains(&s.pulse_duration_s));
        }
    }
}

#[test]
fn settings_changed_by_another_protocol_are_in_the_next_profile() {
    let bench = bench(OMNISCAN, Transport::Tcp);
    let origin = ChangeOrigin::from(NOW);
    bench
        .settings
        .apply(SettingChange::GainDb(60.0), origin)
        .expect("within the limits");
    let (mut plan, output) = ping();
    plan.settings = bench.settings.settings();
    let sent = frames(&bench.device, &plan, &output);
    let frame = Frame::parse(&sent[0].bytes).expect("a frame");
    let profile = OsMonoProfile::parse(frame.payload).expect("a profile");
    assert_eq!(profile.head.gain_index, 7);
    assert!((profile.head.analog_gain - 1000.0).abs() < 1e-2);
}

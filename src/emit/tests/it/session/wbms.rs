//! Tests of WBMS: requests, replies, and the content of the next ping.

use std::net::SocketAddr;
use std::sync::Arc;

use echotank_core::ping::{Detection, PingOutput, PingPlan, Sounding};
use echotank_core::records::Datagram;
use echotank_core::settings::{SettingsPort, TriggerSource};
use echotank_core::time::UtcNs;
use echotank_emit::session::{Outgoing, Protocol, Session, Transport};
use echotank_emit::wbms::control::ControlPort;
use echotank_emit::wbms::{Device, SubscribedPackets, WbmsEmitter};
use echotank_protocols::wbms::{Backscatter, Bathymetry, Packet, packet_type};
use echotank_runtime::settings::SettingsStore;
use proptest::prelude::*;

use echotank_testing::wire as wire_rig;

const NOW: UtcNs = wire_rig::TRANSMIT_UTC;

struct Bench {
    device: Arc<Device>,
    settings: Arc<SettingsStore>,
    client: Box<dyn Session>,
}

fn bench() -> Bench {
    let settings = wire_rig::store();
    let device = Arc::new(Device::new(&wire_rig::sonar(), wire_rig::SOUND_M_PER_S));
    let port = ControlPort::new(Arc::clone(&device), Arc::clone(&settings) as _);
    let peer: SocketAddr = "127.0.0.1:9".parse().expect("address");
    Bench {
        device,
        settings,
        client: port.connect(Transport::Tcp, peer),
    }
}

impl Bench {
    fn say(&mut self, text: &str) -> String {
        let mut out = Vec::new();
        self.client.receive(text.as_bytes(), NOW, &mut out);
        texts(out)
    }

    /// Sends a command and checks that the answer has the values of the command.
    fn set(&mut self, command: &str) {
        let line = format!("{command}\r\n");
        assert_eq!(self.say(&line), line);
    }
}

fn texts(out: Vec<Outgoing>) -> String {
    out.into_iter()
        .map(|item| match item {
            Outgoing::Reply(datagram) => String::from_utf8(datagram.bytes).expect("text"),
            other => panic!("{other:?}"),
        })
        .collect()
}

#[test]
fn each_control_is_answered_with_the_values_in_force_and_is_in_the_settings() {
    let mut bench = bench();
    bench.set("set_range 2.5 60");
    assert_eq!(bench.settings.settings().range_m, 60.0);
    assert_eq!(bench.device.requested().start_m, 2.5);
    bench.set("set_rate 12.5");
    assert_eq!(bench.settings.settings().max_ping_rate_hz, 12.5);
    assert_eq!(
        bench.say("set_rate -1\r\n"),
        "set_rate 20\r\n",
        "as fast as it goes"
    );
    // The amplitude covers 160 to 220 dB in 15 steps of 4 dB.
    bench.set("set_tx 100 0.5 10 500");
    let settings = bench.settings.settings();
    assert_eq!(
        (settings.source_level_db, settings.pulse_duration_s),
        (200.0, 5e-4)
    );
    bench.set("set_power 0");
    assert!(!bench.settings.settings().pinging);
    bench.set("set_power 1");
    assert!(bench.settings.settings().pinging);
    bench.set("set_trigger_mode 5");
    assert_eq!(bench.settings.trigger(), TriggerSource::External);
    bench.set("set_trigger_mode 0");
    assert_eq!(bench.settings.trigger(), TriggerSource::Internal);
    bench.set("set_sidescan_mode 9");
    bench.set("set_snippet_rate 0");
    bench.set("set_gain 12.5");
    assert_eq!(bench.settings.settings().gain_db, 12.5);
    bench.set("set_tp_rate 5");
    // These settings are only stored.
    for command in [
        "set_mode 2",
        "set_flip 1",
        "set_gate_mode 1",
        "set_gate_tilt -12.5",
        "set_direction 30",
        "set_opening_angle 120",
        "set_resolution 1 2",
        "set_autogate_preset 3",
        "sound_velocity 1480.5",
        "set_vga 50",
        "set_tx_direction -5",
        "set_tx_opening_angle 10",
        "set_tx_beam_number 4",
        "set_mf_decimation 2",
        "set_time_source 7",
        "set_ntp_server 192.168.1.91",
    ] {
        bench.set(command);
        let word = command.split(' ').next().expect("a word");
        assert_eq!(bench.say(&format!("{word}\r\n")), format!("{command}\r\n"));
    }
    bench.set("set_default");
    assert_eq!(bench.settings.settings(), wire_rig::SETTINGS);
    assert_eq!(bench.device.requested().start_m, 0.0);
    assert!(!bench.client.is_over());
    bench.say("exit\r\n");
    assert!(bench.client.is_over());
}

#[test]
fn queries_report_current_settings_whoever_changed_them() {
    let mut bench = bench();
    let origin = echotank_core::settings::ChangeOrigin::from(NOW);
    let change = echotank_core::settings::SettingChange::RangeM(42.5);
    bench
        .settings
        .apply(change, origin)
        .expect("within the limits");
    assert_eq!(bench.say("set_range\r\n"), "set_range 0 42.5\r\n");
    assert_eq!(bench.say("set_rate\r\n"), "set_rate 5\r\n");
    assert_eq!(bench.say("sound_velocity\r\n"), "sound_velocity 1500\r\n");
    assert_eq!(bench.say("partno\r\n"), "partno # simulator\r\n");
    assert!(
        bench
            .say("revision\r\n")
            .starts_with("revision # echotank ")
    );
}

#[test]
fn wrong_values_are_refused_with_a_reason_and_the_current_values() {
    let mut bench = bench();
    let before = (bench.settings.settings(), bench.device.requested());
    for (command, words) in [
        ("set_range 0 201", "set_range 0 75 # refused: range_m = 201"),
        (
            "set_range 50 50",
            "set_range 0 75 # refused: the range must end",
        ),
        (
            "set_range 50 20",
            "set_range 0 75 # refused: set_range takes",
        ),
        (
            "set_range near far",
            "set_range 0 75 # refused: set_range: \"near\" is not a number",
        ),
        (
            "set_range 1",
            "set_range 0 75 # refused: set_range takes two",
        ),
        (
            "set_rate 61",
            "set_rate 5 # refused: set_rate takes -1 to 60",
        ),
        ("set_rate 30", "set_rate 5 # refused: max_ping_rate_hz = 30"),
        // A valid amplitude with an invalid length: neither takes effect.
        (
            "set_tx 100 0.5 15 2000000",
            "set_tx 100 0.5 13 500000 # refused: ",
        ),
        ("set_trigger_mode 6", "set_trigger_mode 0 # refused: "),
        (
            "set_gain 101",
            "set_gain 20 # refused: set_gain takes 0 to 100",
        ),
        (
            "set_ntp_server a b",
            "set_ntp_server # refused: set_ntp_server takes one",
        ),
        ("set_rage 1 2", "set_rage # refused: unknown command"),
        ("\u{1b}[A", "[A # refused: unknown command"),
    ] {
        let said = bench.say(&format!("{command}\r\n"));
        assert!(
            said.starts_with(words),
            "{command}: {said:?}, wanted {words:?}"
        );
        assert!(
            said.ends_with("\r\n") && said.matches('\n').count() == 1,
            "{said:?}"
        );
        assert_eq!(
            (bench.settings.settings(), bench.device.requested()),
            before,
            "{command}"
        );
    }
    let counts = bench.client.counts();
    assert_eq!((counts.commands, counts.nacks), (13, 13));
}

#[test]
fn a_command_without_an_end_is_taken_when_it_is_whole_and_the_rest_waits() {
    let mut bench = bench();
    assert_eq!(bench.say("set_power 0"), "set_power 0\r\n");
    assert_eq!(bench.say("set_ran"), "");
    assert!(bench.client.is_waiting());
    assert_eq!(bench.say("ge 0 50\r\nset_po"), "set_range 0 50\r\n");
    assert_eq!(bench.say("wer 1\n"), "set_power 1\r\n");
    bench.say("set_unfinished");
    let mut out = Vec::new();
    bench.client.give_up_waiting(NOW, &mut out);
    assert!(texts(out).contains("unknown command"));
    // An unterminated line does not grow without limit.
    for _ in 0..100 {
        bench.say("xxxxxxxxxxxxxxxxxxxx");
    }
    assert!(bench.client.counts().nacks >= 2);
}

proptest! {
    #[test]
    fn no_bytes_make_the_control_panic(segments in proptest::collection::vec(proptest::collection::vec(any::<u8>(), 0..40), 0..6)) {
        let mut bench = bench();
        let mut out = Vec::new();
        for segment in &segments {
            bench.client.receive(segment, NOW, &mut out);
        }
        bench.client.give_up_waiting(NOW, &mut out);
        prop_assert!(!bench.client.is_waiting());
    }
}

// ---------------------------------------------------------------- packets

const ALL: SubscribedPackets = SubscribedPackets {
    bathymetry: true,
    water_column: true,
    side_scan: true,
};

/// 200 samples at 1 kHz, the first of them 10 ms after the start of the pulse.
fn ping() -> (PingPlan, PingOutput) {
    let mut plan = wire_rig::plan(7, 200);
    plan.first_sample_s = 0.01;
    (plan, wire_rig::output(200))
}

fn packets(bench: &Bench, plan: &PingPlan, output: &PingOutput) -> Vec<Arc<Datagram>> {
    let mut into = Vec::new();
    let mut emitter = WbmsEmitter::new(Arc::clone(&bench.device), 1);
    emitter.emit_ping(plan, output, ALL, &mut into);
    into
}

/// Soundings of a flat seabed `depth_m` below, in the four beams of the fan.
fn soundings(depth_m: f64) -> Vec<Sounding> {
    [-0.75_f64, -0.25, 0.25, 0.75]
        .iter()
        .enumerate()
        .map(|(beam, &angle_rad)| Sounding {
            beam,
            angle_rad,
            twtt_s: 2.0 * depth_m / angle_rad.cos() / wire_rig::SOUND_M_PER_S,
            error_s: 1e-4,
            detection: if beam % 2 == 0 {
                Detection::Amplitude
            } else {
                Detection::Phase
            },
            level_v: 0.5,
        })
        .collect()
}

#[test]
fn a_flat_bottom_comes_back_at_its_depth_within_half_a_sample() {
    let bench = bench();
    let (plan, mut output) = ping();
    for depth_m in [12.0, 33.3, 57.9] {
        output.soundings = soundings(depth_m);
        let sent = packets(&bench, &plan, &output);
        let packet = Packet::parse(&sent[0].bytes).expect("a packet");
        let bathymetry = Bathymetry::parse(&packet).expect("type 1");
        let head = bathymetry.head;
        assert_eq!((head.ping_number, head.sample_rate_hz), (7, 1000.0));
        assert_eq!(head.time_s, 1_750_000_000.0);
        assert_eq!(head.gain, 1.0, "displays divide by it");
        assert_eq!(head.tx_frequency_hz, 100_000.0);
        let c = f64::from(head.sound_velocity_m_per_s);
        let half_sample_m = c / (4.0 * f64::from(head.sample_rate_hz));
        for (n, d) in bathymetry.detections().enumerate() {
            let range_m = f64::from(d.sample_number) * c / (2.0 * f64::from(head.sample_rate_hz));
            let got_m = range_m * f64::from(d.angle_rad).cos();
            assert!(
                (got_m - depth_m).abs() <= half_sample_m,
                "{got_m}, {depth_m}"
            );
            assert_eq!((d.flags, d.quality_flags), (1 + u16::from(n % 2 == 1), 3));
        }
    }
}

#[test]
fn water_column_and_side_scan_are_the_beams_and_the_lines_on_the_fixed_scale() {
    let bench = bench();
    let (plan, output) = ping();
    let sent = packets(&bench, &plan, &output);
    assert_eq!(sent.len(), 3);
    for datagram in &sent[1..] {
        let packet = Packet::parse(&datagram.bytes).expect("a packet");
        let data = Backscatter::parse(&packet).expect("samples");
        let values: Vec<f64> = data.values().collect();
        if data.packet_type == packet_type::WATER_COLUMN {
            assert_eq!(
                (data.head.beams, data.head.samples, data.head.t0_samples),
                (4, 200, 10)
            );
            let angles: Vec<f32> = data.angles_rad().collect();
            assert_eq!(angles, [-0.75, -0.25, 0.25, 0.75], "port-most first");
            for (n, got) in values.iter().enumerate() {
                let volts = output.beams[0].sample(n % 4, n / 4).norm();
                let want = volts / wire_rig::FULL_SCALE_V * 32767.0;
                // Values within single precision of a half count may be rounded either way.
                assert!((got - want).abs() < 0.51, "{n}: {got}, {want}");
            }
        } else {
            assert_eq!(data.packet_type, packet_type::SIDE_SCAN);
            assert_eq!(
                (data.head.beams, data.head.samples, data.head.t0_samples),
                (2, 200, 0)
            );
            for (n, got) in values.iter().enumerate() {
                // Sides alternate: port, then starboard.
                let volts = f64::from(output.lines[n % 2].amplitude[n / 2]);
                assert_eq!(
                    *got,
                    (volts / wire_rig::FULL_SCALE_V * 32767.0).round(),
                    "{n}"
                );
            }
        }
        assert_eq!(data.head.gain, 1.0, "displays divide by it");
    }
}

#[test]
fn snippets_lie_around_their_detections() {
    let mut bench = bench();
    bench.say("set_sidescan_mode 0\r\n");
    let (plan, mut output) = ping();
    output.soundings = soundings(40.0);
    let sent = packets(&bench, &plan, &output);
    let packet = Packet::parse(&sent[2].bytes).expect("a packet");
    let data = Backscatter::parse(&packet).expect("samples");
    assert_eq!(data.packet_type, packet_type::SNIPPETS);
    assert_eq!((data.head.beams, data.head.samples), (4, 33));
    let values: Vec<f64> = data.values().collect();
    for (n, (start, centre)) in data.snippets().enumerate() {
        let want = (output.soundings[n].twtt_s * 1000.0).round();
        assert_eq!((f64::from(centre), start + 16), (want, centre));
        for m in 0..33 {
            // The first sample of a beam has the number 10.
            let sample = usize::from(start) + m - 10;
            let volts = output.beams[0].sample(n, sample).norm();
            let want = volts / wire_rig::FULL_SCALE_V * 32767.0;
            assert!((values[m * 4 + n] - want).abs() < 0.51, "{n}, {m}");
        }
    }
    bench.say("set_snippet_rate 0\r\n");
    assert_eq!(
        packets(&bench, &plan, &output).len(),
        2,
        "none at a rate of 0"
    );
    bench.say("set_tp_rate 0\r\n");
    assert_eq!(packets(&bench, &plan, &output).len(), 1, "bathymetry alone");
}

#[test]
fn the_water_column_is_sent_at_its_requested_rate() {
    let mut bench = bench();
    bench.say("set_tp_rate 2\r\n");
    let (mut plan, output) = ping();
    let mut emitter = WbmsEmitter::new(Arc::clone(&bench.device), 1);
    let mut columns = 0;
    for k in 0..10 {
        plan.transmit_utc = NOW.plus_s(0.1 * f64::from(k));
        let mut into = Vec::new();
        emitter.emit_ping(&plan, &output, ALL, &mut into);
        let is_column = |d: &&Arc<Datagram>| d.record_type == packet_type::WATER_COLUMN;
        columns += into.iter().filter(is_column).count();
    }
    assert_eq!(columns, 2, "of ten pings in a second, at 2 a second");
}

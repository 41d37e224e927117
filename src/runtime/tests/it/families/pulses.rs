//! Two pulses in one ping, in the families that support a second pulse.

use std::sync::Arc;

use echotank_config::spec::{JsfChannels, JsfFormat, JsfSpec, MorePulseSpec, SonarSpec};
use echotank_core::ping::{PingOutput, PulseLines};
use echotank_core::pulse::{Pulse, PulseKind};
use echotank_core::records::Datagram;
use echotank_emit::jsf::session::{JsfCommands, is_active};
use echotank_emit::jsf::{JsfEmitter, JsfSheet};
use echotank_emit::session::{Protocol, Transport};
use echotank_emit::sevenk::{RecordSet, SevenKEmitter};
use echotank_protocols::jsf::control::{error_code, system_type};
use echotank_protocols::jsf::{SonarData80, Value, command_type, message_type};
use echotank_protocols::sevenk::Record;
use echotank_protocols::sevenk::records::{SideScan7007, SonarSettings7000};
use echotank_protocols::xtf::{FileHeader, Ping};
use echotank_runtime::io::sonar::verify::Verifier;

use super::rig::*;
use echotank_testing::wire::*;

const DELAY_S: f64 = 2e-3;
const SAMPLES: usize = 40;

fn two_pulses() -> (SonarSpec, PingOutput) {
    let mut sonar = sonar();
    let second = Pulse {
        kind: PulseKind::LfmDown,
        center_frequency_hz: 103_000.0,
        ..sonar.pulse
    };
    sonar.more_pulses = vec![MorePulseSpec {
        pulse: second,
        delay_s: DELAY_S,
        transmit: None,
    }];
    let mut output = output(SAMPLES);
    let mut lines = output.lines.clone();
    for (line, level) in output.lines.iter_mut().zip([0.8, 0.6]) {
        line.amplitude = vec![level; SAMPLES];
    }
    for (line, level) in lines.iter_mut().zip([0.4, 0.2]) {
        line.amplitude = vec![level; SAMPLES];
    }
    output.more_lines = vec![PulseLines {
        delay_s: DELAY_S,
        lines,
    }];
    (sonar, output)
}

#[test]
fn each_pulse_has_settings_and_lines_of_its_own_in_7k_under_one_ping_number() {
    let (sonar, output) = two_pulses();
    let mut emitter = SevenKEmitter::new(sheet_of(&sonar), 2);
    let (plan, mut records) = (plan(9, SAMPLES), Vec::new());
    emitter.emit_ping(&plan, &output, RecordSet::ALL, &mut records);
    let of = |id: u32| {
        let found = records.iter().filter(move |r| r.record_type == id);
        found.map(|r| Record::parse(&r.bytes).expect("a record"))
    };
    let settings: Vec<_> = of(7000)
        .map(|r| SonarSettings7000::parse(r.body()).expect("7000"))
        .collect();
    let said = settings.iter();
    let said: Vec<_> = said
        .map(|s| (s.ping_number, s.multi_ping_sequence, s.frequency_hz))
        .collect();
    assert_eq!(said, [(9, 1, 100_000.0), (9, 2, 103_000.0)]);
    let last: Vec<_> = records
        .iter()
        .rev()
        .take(2)
        .map(|r| r.record_type)
        .collect();
    assert_eq!(last, [7007, 7000], "the second pulse comes behind the ping");

    let lines: Vec<_> = of(7007).collect();
    let levels: Vec<_> = lines
        .iter()
        .map(|r| {
            let line = SideScan7007::parse(r.body()).expect("7007");
            let counts = [line.port().next(), line.starboard().next()];
            (line.rth.multi_ping_sequence, counts.map(Option::unwrap))
        })
        .collect();
    let [(1, own), (2, second)] = levels[..] else {
        panic!("{levels:?}")
    };
    for (own, second, ratio) in [(own[0], second[0], 0.5), (own[1], second[1], 1.0 / 3.0)] {
        let got = f64::from(second) / f64::from(own);
        assert!((got - ratio).abs() < 1e-3, "{got}, want {ratio}");
    }
    // Each record carries the end of its own transmission.
    let times = lines
        .iter()
        .map(|r| r.frame.time.to_utc_ns().expect("a time"));
    for (time, late_s) in times.zip([0.0, DELAY_S]) {
        let want = plan.stamp_utc.plus_s(PULSE_S + late_s).0;
        assert!((time - want).abs() < 4000, "{time}, want {want}");
    }

    // Ping counters count the ping once.
    let mut verifier = Verifier::default();
    for record in &records {
        let body = Record::parse(&record.bytes).expect("a record");
        verifier.note(record.record_type, body.body());
    }
    for id in [7000, 7007] {
        let tally = verifier.tally(id);
        assert_eq!((tally.sent, tally.received, tally.duplicate), (1, 1, 0));
    }
}

#[test]
fn each_pulse_has_channels_of_its_own_in_xtf() {
    let (sonar, output) = two_pulses();
    let mut emitter = xtf_emitter(&sonar);
    let file = FileHeader::parse(&emitter.file_head()).expect("a header");
    let channels = file.channels.iter();
    let channels: Vec<_> = channels
        .map(|c| (c.name.as_str(), c.frequency_khz))
        .collect();
    assert_eq!(
        channels,
        [
            ("port", 100.0),
            ("starboard", 100.0),
            ("port 2", 103.0),
            ("starboard 2", 103.0)
        ]
    );
    let mut packets = Vec::new();
    emitter.emit_ping(&plan(9, SAMPLES), &output, &mut packets);
    let ping = Ping::parse(&packets[64..], &file).expect("a ping");
    let of = ping.channels.iter();
    let of: Vec<_> = of
        .map(|c| {
            let first = c.values().next().expect("samples");
            (c.header.frequency_khz, first)
        })
        .collect();
    assert_eq!(
        of.iter().map(|c| c.0).collect::<Vec<_>>(),
        [100, 100, 103, 103]
    );
    for (k, ratio) in [(1, 0.75), (2, 0.5), (3, 0.25)] {
        let got = of[k].1 / of[0].1;
        assert!((got - ratio).abs() < 1e-3, "channel {k}: {got}");
    }
}

fn jsf_of_two(channels: JsfChannels, format: JsfFormat) -> Vec<Arc<Datagram>> {
    let (sonar, output) = two_pulses();
    let sheet = Arc::new(JsfSheet {
        output: JsfSpec {
            silent_subsystems: Vec::new(),
            ..jsf_spec(channels, format)
        },
        sonar,
    });
    let mut emitter = JsfEmitter::new(sheet, Box::new(|_, _| {}));
    let mut messages = Vec::new();
    let wanted = |subsystem, channel| (subsystem, channel) != (21, 0);
    emitter.emit_ping(&plan(9, SAMPLES), &output, wanted, &mut messages);
    messages.retain(|m| m.record_type & 0xFFFF == u32::from(message_type::SONAR_DATA));
    messages
}

#[test]
fn each_pulse_is_a_subsystem_of_its_own_in_jsf() {
    let messages = jsf_of_two(JsfChannels::Sides, JsfFormat::Envelope);
    let said: Vec<_> = messages
        .iter()
        .map(|m| {
            let message = jsf_message(m);
            let data = SonarData80::parse(message.body).expect("80");
            let place = (message.header.subsystem, message.header.channel);
            let h = &data.header;
            (
                place,
                h.ping_number,
                h.frequencies_hz(),
                h.utc_ns(),
                data.values().next(),
            )
        })
        .collect();
    // A client has switched port off for the second pulse.
    let places: Vec<_> = said.iter().map(|s| s.0).collect();
    assert_eq!(places, [(20, 0), (20, 1), (21, 1)]);
    assert!(said.iter().all(|s| s.1 == 9), "one ping");
    let half = 0.5 * plan(9, SAMPLES).pulse.bandwidth_hz;
    assert_eq!(said[0].2, (100_000.0 - half, 100_000.0 + half), "up");
    assert_eq!(said[2].2, (103_000.0 + half, 103_000.0 - half), "down");
    let late_s = (said[2].3 - said[0].3) as f64 * 1e-9;
    assert!(
        (late_s - DELAY_S).abs() < 1e-3,
        "{late_s}, to a millisecond"
    );
    // Levels as synthesised: 0.8 and 0.6 for the first pulse, 0.2 for starboard of the second.
    let level = |k: usize| said[k].4.expect("samples");
    for (k, ratio) in [(1, 0.75), (2, 0.25)] {
        let got = level(k) / level(0);
        assert!((got - ratio).abs() < 1e-3, "message {k}: {got}");
    }
    // Unfiltered samples and elements contain all pulses together.
    for (channels, format, count) in [
        (JsfChannels::Sides, JsfFormat::Unfiltered, 2),
        (JsfChannels::Staves, JsfFormat::Envelope, 5),
    ] {
        let messages = jsf_of_two(channels, format);
        let all_own = messages.iter().all(|m| m.record_type >> 16 & 0xFF == 20);
        assert!(all_own && messages.len() == count, "{}", messages.len());
    }
}

#[test]
fn commands_for_the_second_pulses_subsystem_are_for_the_sonar_and_its_data_are_its_own() {
    let (sonar, _) = two_pulses();
    let sheet = Arc::new(JsfSheet {
        output: JsfSpec {
            silent_subsystems: vec![22],
            ..jsf_spec(JsfChannels::Sides, JsfFormat::Envelope)
        },
        sonar,
    });
    let store = store();
    let protocol = JsfCommands {
        sheet,
        settings: store.clone(),
    };
    let peer = "127.0.0.1:4711".parse().expect("an address");
    let mut client = JsfClient {
        store: store.clone(),
        session: protocol.connect(Transport::Tcp, peer),
        now: TRANSMIT_UTC,
    };
    let mut tell = |kind, subsystem, channel, number| {
        let value = Value::Number(number);
        client.command(&control(command_type::SET, kind, subsystem, channel, value))
    };
    assert!(tell(message_type::PING_RANGE, 21, 0, 42_000).is_empty());
    assert_eq!(store.snapshot().0.range_m, 42.0, "both are in one ping");
    assert!(tell(message_type::DATA_ACTIVE, 21, 1, 0).is_empty());
    assert!(tell(message_type::PING_RANGE, 22, 0, 30_000).is_empty());
    assert_eq!(store.snapshot().0.range_m, 42.0, "22 has no pulse");
    let refused = tell(message_type::PING_RANGE, 23, 0, 30_000);
    assert_eq!(
        refused[0].value,
        Value::Error(error_code::UNKNOWN_SUBSYSTEM)
    );
    let active = |subsystem, channel| is_active(store.as_ref(), subsystem, channel);
    assert!(active(20, 1) && active(21, 0) && !active(21, 1));
    let kind = client.get(message_type::SYSTEM_TYPE, 0);
    assert_eq!(kind, Value::Number(system_type::DUAL_FREQUENCY_SIDE_SCAN));
    assert_eq!(
        client.get(message_type::PING_RANGE, 0),
        Value::Number(42_000)
    );
}

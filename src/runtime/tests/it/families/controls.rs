//! Requests, replies, and the effect on the next ping.

use echotank_core::settings::{SettingsPort, StoredKey, TriggerSource};
use echotank_core::time::UtcNs;
use echotank_emit::imagenex872::emit_ping;
use echotank_emit::session::Wants;
use echotank_protocols::imagenex872::{Side, SwitchCommand};
use echotank_protocols::jsf::control::{error_code, system_type, trigger};
use echotank_protocols::jsf::{Value, command_type, message_type as t};
use proptest::prelude::*;

use super::rig::*;
use echotank_testing::wire::*;

const N: fn(i32) -> Value = Value::Number;

#[test]
fn every_jsf_setting_that_the_model_has_is_obeyed_by_the_next_ping() {
    let mut client = JsfClient::new();
    for (kind, value) in [
        (t::PING_RANGE, 60_000),
        (t::PING_RATE, 2_500),
        (t::PING_GAIN, 500),
        (t::ADC_GAIN, 20_000),
    ] {
        assert_eq!(client.set(kind, 0, N(value)), None, "{kind}: no answer");
        assert_eq!(client.get(kind, 0), N(value), "{kind}");
    }
    let s = client.store.snapshot().0;
    assert_eq!((s.range_m, s.max_ping_rate_hz), (60.0, 2.5));
    // Half the amplitude of the largest level, 220 dB; 20 times the amplitude.
    assert!((s.source_level_db - (220.0 + 20.0 * 0.5_f64.log10())).abs() < 1e-9);
    assert!((s.gain_db - 20.0 * 20.0_f64.log10()).abs() < 1e-9);
    // Stop, start, and a single ping.
    assert_eq!(client.set(t::PING, 0, N(0)), None);
    assert!(!client.store.snapshot().0.pinging);
    assert_eq!(client.get(t::PING, 0), N(0));
    assert_eq!(client.set(t::PING, 0, N(2)), None);
    assert!(client.store.snapshot().0.pinging, "one is owed");
    client.store.note_ping(echotank_core::time::MonoNs(1));
    assert!(!client.store.snapshot().0.pinging, "and then none");
    assert_eq!(client.set(t::PING, 0, N(1)), None);
    assert_eq!(client.get(t::PING, 0), N(1));
    // An external trigger, and back to the internal one.
    assert_eq!(client.set(t::PING_TRIGGER, 0, N(trigger::EXTERNAL)), None);
    assert_eq!(client.store.trigger(), TriggerSource::External);
    assert_eq!(client.get(t::PING_TRIGGER, 0), N(trigger::EXTERNAL));
    assert!(!client.store.snapshot().0.pinging);
    assert_eq!(client.set(t::PING_TRIGGER, 0, N(trigger::COUPLED)), None);
    assert_eq!(client.get(t::PING_TRIGGER, 0), N(trigger::COUPLED));
    assert!(client.store.snapshot().0.pinging, "its own schedule again");
    assert_eq!(client.set(t::SHUTDOWN, 0, N(1)), None);
    assert!(!client.store.snapshot().0.pinging);
}

#[test]
fn jsf_settings_without_a_model_are_kept_and_reported() {
    let mut client = JsfClient::new();
    let coupling = Value::Coupling {
        master_subsystem: 20,
        divisor: 2,
        delay_us: 500,
    };
    let before = client.store.snapshot().0;
    for (kind, channel, value) in [
        (t::DATA_ACTIVE, 0, N(0)),
        (t::DATA_ACTIVE, 1, N(1)),
        (t::PING_122, 0, N(-5)),
        (t::PING_SELECT, 0, Value::PulseName("chirp.spf".into())),
        (t::PING_COUPLING, 0, coupling),
        (t::PING_AUTO_SELECT, 0, N(2)),
        (t::ADC_AGC, 0, N(1)),
        (t::ADC_RATE, 0, N(50_000)),
    ] {
        assert_eq!(client.set(kind, channel, value.clone()), None, "{kind}");
        assert_eq!(client.get(kind, channel), value, "{kind}");
    }
    assert_eq!(client.store.snapshot().0, before, "no ping knows of them");
    // Message 83 switches the data of a channel off and on.
    use echotank_emit::jsf::session::is_active;
    let active = |channel| is_active(client.store.as_ref(), 20, channel);
    assert_eq!([0, 1, 2].map(active), [false, true, true]);
    let key = |place| StoredKey {
        via: "jsf",
        name: "message",
        place,
    };
    assert!(client.store.stored(key(83 | 20 << 16)).is_some());
}

#[test]
fn jsf_reports_its_identity_and_time() {
    let mut client = JsfClient::new();
    let millis = 1_750_000_000_123_000_000;
    client.now = echotank_core::time::UtcNs(millis);
    let time = Value::Time {
        seconds: 1_750_000_000,
        milliseconds: 123,
    };
    assert_eq!(client.get(t::SYSTEM_TIME, 0), time);
    let kind = system_type::SINGLE_FREQUENCY_SIDE_SCAN;
    assert_eq!(client.get(t::SYSTEM_TYPE, 0), N(kind));
    assert_eq!(client.get(t::OPERATIONAL, 0), N(0));
    assert_eq!(client.set(t::ALIVE, 0, N(4711)), Some(N(4711)));
    assert_eq!(client.get(t::ALIVE, 0), N(4711));
    assert_eq!(client.get(t::ADC_RATE, 0), N(1000), "of the receiver");
}

#[test]
fn every_jsf_refusal_has_its_code_and_changes_nothing() {
    for (kind, subsystem, channel, value, code) in [
        (t::PING_RANGE, 20, 0, N(4_999), error_code::FAILED),
        (t::PING_RANGE, 20, 0, N(i32::MAX), error_code::FAILED),
        (t::PING_RATE, 20, 0, N(-1), error_code::FAILED),
        (t::PING_GAIN, 20, 0, N(0), error_code::FAILED),
        (t::PING, 20, 0, N(7), error_code::FAILED),
        (t::PING_TRIGGER, 20, 0, N(3), error_code::FAILED),
        (t::DATA_ACTIVE, 20, 0, N(2), error_code::FAILED),
        (t::DATA_ACTIVE, 20, 9, N(1), error_code::UNKNOWN_CHANNEL),
        (
            t::PING_RANGE,
            40,
            0,
            N(60_000),
            error_code::UNKNOWN_SUBSYSTEM,
        ),
        (
            t::SYSTEM_TIME,
            0,
            0,
            Value::Time {
                seconds: 1,
                milliseconds: 2,
            },
            error_code::FAILED,
        ),
        (131, 20, 0, N(1), error_code::UNKNOWN_MESSAGE),
        (t::PING_RANGE, 20, 0, Value::None, error_code::WRONG_SIZE),
        (
            t::PING_SELECT,
            20,
            0,
            Value::PulseName(String::new()),
            error_code::UNKNOWN_PULSE,
        ),
    ] {
        let mut client = JsfClient::new();
        let asked = control(command_type::SET, kind, subsystem, channel, value);
        let answers = client.command(&asked);
        let [answer] = &answers[..] else {
            panic!("{asked}: {answers:?}")
        };
        assert_eq!(answer.command_type, command_type::ERROR, "{asked}");
        assert_eq!(answer.value, Value::Error(code), "{asked}");
        assert_eq!(client.store.snapshot(), (SETTINGS, 0), "{asked}");
        let counts = client.session.counts();
        assert_eq!((counts.commands, counts.nacks), (1, 1), "{asked}");
    }
}

#[test]
fn settings_of_the_other_frequency_are_stored_without_effect() {
    let mut client = JsfClient::new();
    let set = control(command_type::SET, t::PING_RANGE, 21, 0, N(30_000));
    assert!(client.command(&set).is_empty());
    let get = control(command_type::GET, t::PING_RANGE, 21, 0, Value::None);
    assert_eq!(client.command(&get)[0].value, N(30_000));
    assert_eq!(client.get(t::PING_RANGE, 0), N(75_000));
    assert_eq!(client.store.snapshot().0, SETTINGS);
}

#[test]
fn a_partial_jsf_command_waits_and_the_body_of_a_get_is_ignored() {
    let mut client = JsfClient::new();
    let mut bytes = Vec::new();
    control(command_type::SET, t::PING_RANGE, 20, 0, N(60_000)).emit(&mut bytes);
    assert!(client.send(&bytes[..17]).is_empty());
    assert!(client.session.is_waiting());
    assert_eq!(client.store.snapshot().0.range_m, 75.0);
    assert!(client.send(&bytes[17..]).is_empty());
    assert!(!client.session.is_waiting());
    assert_eq!(client.store.snapshot().0.range_m, 60.0);
    // A GET command with a body.
    let mut bytes = Vec::new();
    control(command_type::SET, t::PING_RANGE, 20, 0, N(-1)).emit(&mut bytes);
    bytes[6] = command_type::GET;
    assert_eq!(client.send(&bytes)[0].value, N(60_000));
    // Leading garbage is skipped and counted once.
    let mut rubbish = vec![0x55; 100];
    control(command_type::SET, t::PING_RANGE, 20, 0, N(61_000)).emit(&mut rubbish);
    client.send(&rubbish);
    assert_eq!(client.store.snapshot().0.range_m, 61.0);
    assert_eq!(client.session.counts().framing_errors, 1);
    // An unterminated command is abandoned, and the following commands are found.
    let mut hidden = bytes[..20].to_vec();
    hidden[12] = 200;
    control(command_type::SET, t::PING_RANGE, 20, 0, N(62_000)).emit(&mut hidden);
    client.send(&hidden);
    assert_eq!(client.store.snapshot().0.range_m, 61.0, "part of a body");
    client.session.give_up_waiting(client.now, &mut Vec::new());
    assert_eq!(client.store.snapshot().0.range_m, 62.0);
    assert!(!client.session.is_waiting());
}

fn switch(range_m: u8, data_gain: u8, side: Side) -> Vec<u8> {
    let mut bytes = Vec::new();
    SwitchCommand {
        range_m,
        frequency_index: 1,
        data_gain,
        balance_gain: 30,
        side,
    }
    .emit(&mut bytes);
    bytes
}

#[test]
fn a_switch_command_sets_range_and_gain_and_asks_for_one_side_of_one_ping() {
    let store = store();
    let (_, mut session) = imagenex(&store);
    session.receive(&switch(50, 50, Side::Port), TRANSMIT_UTC, &mut Vec::new());
    let s = store.snapshot().0;
    assert_eq!(
        (s.range_m, s.gain_db),
        (50.0, 30.0),
        "half way from 0 to 60 dB"
    );
    let asked = session.take_requested();
    assert_eq!(asked, Wants::class(0));
    assert_eq!(session.take_requested(), Wants::NONE, "once");
    let version = store.version();
    session.receive(&switch(50, 50, Side::Port), TRANSMIT_UTC, &mut Vec::new());
    assert_eq!(store.version(), version, "told again, nothing changes");
    // An idle sonar makes one ping for the request.
    use echotank_core::settings::SettingChange;
    store
        .apply(SettingChange::Stop, TRANSMIT_UTC)
        .expect("stops");
    session.receive(
        &switch(50, 50, Side::Starboard),
        TRANSMIT_UTC,
        &mut Vec::new(),
    );
    assert_eq!(
        session.take_requested(),
        Wants::class(0).union(Wants::class(2))
    );
    assert!(store.snapshot().0.pinging);
    store.note_ping(echotank_core::time::MonoNs(1));
    assert!(!store.snapshot().0.pinging);
}

/// A client that does not wait for the answer, which takes the rig's latency.
#[test]
fn a_repeated_switch_command_does_not_delay_the_answer_to_the_first() {
    let store = store();
    let (head, mut session) = imagenex(&store);
    let after = |ms: i64| TRANSMIT_UTC.plus_ns(ms * 1_000_000);
    let output = output(16);
    let answers_of = |ping: u32, pulse: UtcNs| {
        let mut plan = plan(ping, 16);
        plan.stamp_utc = pulse;
        let mut answers = Vec::new();
        let both = Wants::class(0).union(Wants::class(2));
        emit_ping(&head, &plan, &output, (40e3, 1.0), both, &mut answers);
        answers.len()
    };
    for ms in [0, 100, 200, 300] {
        session.receive(&switch(50, 50, Side::Port), after(ms), &mut Vec::new());
    }
    // The ping at 150 ms is ready at 350 ms: two commands came before its pulse and two after it.
    assert_eq!(answers_of(1, after(-50)), 0, "before the first command");
    assert_eq!(answers_of(2, after(150)), 1);
    assert_eq!(answers_of(3, after(400)), 1);
    assert_eq!(answers_of(4, after(650)), 0, "all are answered");
    // Commands without end take a bounded memory, and the first is answered all the same.
    for ms in 1000..2000 {
        session.receive(&switch(50, 50, Side::Port), after(ms), &mut Vec::new());
    }
    assert_eq!(answers_of(5, after(1001)), 1);
    assert_eq!(answers_of(6, after(3000)), 1);
    assert_eq!(answers_of(7, after(3250)), 0);
}

#[test]
fn an_invalid_or_truncated_switch_command_has_no_effect() {
    let mut limits = sonar().limits;
    limits.range_m.1 = 100.0;
    let store = std::sync::Arc::new(echotank_runtime::settings::SettingsStore::new(
        SETTINGS,
        limits,
        std::sync::Arc::new(echotank_runtime::clock::VirtualClock::default()),
    ));
    let (_, mut session) = imagenex(&store);
    let none = &mut Vec::new();
    session.receive(&switch(200, 0, Side::Port), TRANSMIT_UTC, none);
    let s = store.snapshot().0;
    assert_eq!(
        (s.range_m, s.gain_db),
        (75.0, 0.0),
        "range refused, gain not"
    );
    assert_eq!(session.counts().nacks, 1);
    let mut wrong = switch(50, 50, Side::Port);
    wrong[3] = 51; // not a range of the device
    session.receive(&wrong, TRANSMIT_UTC, none);
    assert_eq!(session.counts().nacks, 2);
    let bytes = switch(60, 0, Side::Port);
    session.receive(&bytes[..20], TRANSMIT_UTC, none);
    assert!(session.is_waiting());
    session.give_up_waiting(TRANSMIT_UTC, none);
    assert!(!session.is_waiting());
    session.receive(&bytes, TRANSMIT_UTC, none);
    assert_eq!(store.snapshot().0.range_m, 60.0);
}

proptest! {
    #[test]
    fn no_bytes_break_a_session(pieces in proptest::collection::vec(proptest::collection::vec(any::<u8>(), 0..60), 1..6), is_framed: bool) {
        let mut client = JsfClient::new();
        let store = store();
        let (_, mut imagenex) = imagenex(&store);
        for (k, piece) in pieces.iter().enumerate() {
            let mut bytes = piece.clone();
            if is_framed && bytes.len() > 16 {
                let len = bytes.len() - 16;
                bytes[..2].copy_from_slice(&[0x01, 0x16]);
                bytes[4] = [120, 121, 122, 123, 124, 125, 128, 129, 133, 140, 141, 142, 22, 41, 83][piece[0] as usize % 15];
                bytes[5] = 0;
                bytes[7] = 20;
                bytes[12..16].copy_from_slice(&(len as u32).to_le_bytes());
            }
            client.session.receive(&bytes, TRANSMIT_UTC, &mut Vec::new());
            imagenex.receive(&bytes, TRANSMIT_UTC, &mut Vec::new());
            if k % 2 == 1 {
                client.session.give_up_waiting(TRANSMIT_UTC, &mut Vec::new());
                imagenex.give_up_waiting(TRANSMIT_UTC, &mut Vec::new());
            }
        }
        let s = client.store.snapshot().0;
        prop_assert!((5.0..=200.0).contains(&s.range_m) && (0.0..=60.0).contains(&s.gain_db));
    }
}

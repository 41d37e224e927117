//! Tests of the session of one client over bytes in memory: settings, subscriptions, refusals and random bytes.

mod ping;
mod wbms;

use std::net::{IpAddr, Ipv4Addr, SocketAddr};
use std::sync::Arc;

use echotank_core::settings::{ChangeOrigin, Requester};
use echotank_core::time::UtcNs;
use echotank_emit::sevenk::RecordSet;
use echotank_emit::sevenk::records::DeviceSheet;
use echotank_emit::sevenk::session::{Outgoing, Session, SessionContext};
use echotank_protocols::sevenk::control::{
    Ack7501, GainType, Nack7502, PulseEnvelope, PulseType, ThirdParty, Transport,
};
use echotank_protocols::sevenk::records::RemoteSettings7503;
use echotank_protocols::sevenk::{
    Command, ControlRequest, ErrorCode, Packetiser, Record, RecordBody,
};
use echotank_runtime::settings::SettingsStore;
use echotank_testing::wire::*;
use proptest::prelude::*;

const NOW: UtcNs = UtcNs(1_750_000_000_000_000_000);

const CLIENT: SocketAddr = SocketAddr::new(IpAddr::V4(Ipv4Addr::LOCALHOST), 4001);
/// Port of the server.
const OWN_PORT: u16 = 7000;

struct Rig {
    sheet: Arc<DeviceSheet>,
    store: Arc<SettingsStore>,
    session: Session,
}

impl Rig {
    fn over(session: Session) -> Self {
        Self {
            sheet: sheet(),
            store: store(),
            session,
        }
    }
    fn tcp() -> Self {
        Self::over(Session::stream())
    }

    fn work(
        &mut self,
        step: impl FnOnce(&mut Session, &SessionContext<'_>, &mut Vec<Outgoing>),
    ) -> Vec<Outgoing> {
        let mut out = Vec::new();
        let context = SessionContext {
            sheet: &self.sheet,
            settings: self.store.as_ref(),
            now: NOW,
            is_own: |address| address.port() == OWN_PORT,
            by: Requester {
                peer: Some(CLIENT),
                ..ChangeOrigin::from(NOW).by
            },
        };
        step(&mut self.session, &context, &mut out);
        out
    }

    fn send(&mut self, bytes: &[u8]) -> Vec<Outgoing> {
        self.work(|session, context, out| session.receive(bytes, context, out))
    }

    fn give_up(&mut self) -> Vec<Outgoing> {
        self.work(Session::give_up_waiting)
    }

    /// The current settings, requested as a client does.
    fn settings_7503(&mut self) -> RemoteSettings7503 {
        let out = self.send(&command(single(7503), 99));
        let record = Record::parse(reply(&out, 1)).expect("a 7503");
        RemoteSettings7503::parse(record.body()).expect("settings")
    }

    /// Sends a command and returns the reply: success, or the code of the refusal. Checks ticket and tracking number.
    fn ask(&mut self, command: Command, ticket: u32) -> Result<(), ErrorCode> {
        let bytes = echotank_testing::wire::command(command, ticket);
        answer(&self.send(&bytes), ticket)
    }
}

fn subscribe(ids: &[u32]) -> Command {
    Command::Subscribe {
        record_type_ids: ids.to_vec(),
    }
}

fn single(record_type_id: u32) -> Command {
    Command::SingleRecord { record_type_id }
}

fn record_types(out: &[Outgoing]) -> Vec<u32> {
    out.iter()
        .map(|item| match item {
            Outgoing::Reply(datagram) | Outgoing::Echo(datagram) => {
                let record = Record::parse(&datagram.bytes).expect("a whole record");
                assert_eq!(record.frame.record_type_id, datagram.record_type);
                datagram.record_type
            }
            other => panic!("no record: {other:?}"),
        })
        .collect()
}

fn reply(out: &[Outgoing], at: usize) -> &[u8] {
    match &out[at] {
        Outgoing::Reply(datagram) => &datagram.bytes,
        other => panic!("no reply at {at}: {other:?}"),
    }
}

fn answer(out: &[Outgoing], ticket: u32) -> Result<(), ErrorCode> {
    let bytes = reply(out, 0);
    // Ticket and tracking number have the same offsets in 7501 and 7502.
    assert_eq!(u32_at(bytes, 64), ticket);
    assert_eq!(
        (u64_at(bytes, 68), u64_at(bytes, 76)),
        (u64::from(ticket) << 40, 7)
    );
    let record = Record::parse(bytes).expect("a whole record");
    match RecordBody::parse(&record).expect("an answer") {
        RecordBody::Ack(Ack7501 { .. }) => Ok(()),
        RecordBody::Nack(Nack7502 { error, .. }) => {
            assert_eq!(u32_at(bytes, 84), error.code());
            assert_eq!(out.len(), 1, "a refusal is not echoed");
            Err(error)
        }
        other => panic!("answered with {other}"),
    }
}

#[test]
fn a_range_change_is_acknowledged_echoed_and_in_the_next_snapshot() {
    let mut rig = Rig::tcp();
    let (_, before) = rig.store.snapshot();
    let out = rig.send(&command(Command::Range { range_m: 42.5 }, 11));
    assert_eq!(answer(&out, 11), Ok(()));
    assert_eq!(record_types(&out), [7501, 7500]);
    let Outgoing::Echo(echo) = &out[1] else {
        panic!("the second is the echo")
    };
    let record = Record::parse(&echo.bytes).expect("a 7500");
    let request = ControlRequest::parse(record.body()).expect("a command");
    assert_eq!(
        (request.ticket, request.command),
        (11, Command::Range { range_m: 42.5 })
    );
    let (settings, version) = rig.store.snapshot();
    assert_eq!((settings.range_m, version), (42.5, before + 1));
}

#[test]
fn each_setting_has_its_command() {
    let mut rig = Rig::tcp();
    for (ticket, command) in [
        Command::Range { range_m: 60.0 },
        Command::MaxPingRate { pings_per_s: 2.5 },
        Command::Power { power_db: 200.5 },
        Command::Gain { gain_db: 30.25 },
        Command::PulseLength {
            pulse_length_s: 0.25,
        },
        Command::StopPinging,
    ]
    .into_iter()
    .enumerate()
    {
        assert_eq!(rig.ask(command, ticket as u32), Ok(()));
    }
    let (s, version) = rig.store.snapshot();
    assert_eq!(
        (s.range_m, s.max_ping_rate_hz, s.source_level_db),
        (60.0, 2.5, 200.5)
    );
    assert_eq!(
        (s.gain_db, s.pulse_duration_s, s.pinging, version),
        (30.25, 0.25, false, 6)
    );
    assert_eq!(rig.ask(Command::StartPinging, 7), Ok(()));
    assert!(rig.store.snapshot().0.pinging);
    assert_eq!(
        rig.ask(Command::MaxPingRate { pings_per_s: 0.0 }, 8),
        Ok(())
    );
    assert!(
        !rig.store.snapshot().0.pinging,
        "a rate of 0 stops pinging from starting"
    );
}

#[test]
fn every_refusal_has_its_code_and_changes_nothing() {
    let party = ThirdParty {
        ipv4: 1,
        port: 7000,
        transport: Transport::Udp,
    };
    for (command, code) in [
        (Command::Range { range_m: 1e9 }, 0x7001),
        (Command::Gain { gain_db: -1.0 }, 0x7001),
        (
            Command::PulseLength {
                pulse_length_s: 0.0,
            },
            0x7001,
        ),
        (Command::MaxPingRate { pings_per_s: -1.0 }, 0x7001),
        (Command::Range { range_m: f32::NAN }, 0x7008),
        (single(7027), 0x7002),
        (single(7500), 0x700A),
        (subscribe(&[7027, 7070]), 0x7002),
        (subscribe(&[]), 0x7008),
        (Command::SubscribeRange { first: 9, last: 1 }, 0x7008),
        (
            Command::SubscribeRange {
                first: 8000,
                last: 9000,
            },
            0x7002,
        ),
        (Command::PulseType(PulseType::ContinuousWave), 0x7006),
        (Command::CenterFrequency { frequency_hz: 99e3 }, 0x7006),
        (
            Command::ChirpBand {
                start_hz: 99e3,
                stop_hz: 101e3,
            },
            0x7006,
        ),
        (Command::PingTimes { count: 0 }, 0x7001),
        (
            Command::SnippetControl {
                flags: 6,
                min_window_samples: 9,
                max_window_samples: 8,
            },
            0x7001,
        ),
        (
            Command::CoverageSector {
                sector_rad: -1.0,
                rx_steering_rad: 0.0,
            },
            0x7001,
        ),
        // A compression factor, and 8 and 32 bits at the same time.
        (Command::CompressedWaterColumn { flags: 1 << 13 }, 0x7006),
        (
            Command::CompressedWaterColumn {
                flags: 1 << 12 | 1 << 2,
            },
            0x7006,
        ),
        (
            Command::ConnectThirdParty {
                party,
                record_type_ids: vec![7027],
            },
            0x7002,
        ),
        (Command::Unknown(4242), 0x7007),
    ] {
        let mut rig = Rig::tcp();
        let got = rig.ask(command.clone(), 5).map_err(ErrorCode::code);
        assert_eq!(got, Err(code), "{command}");
        assert_eq!(rig.store.snapshot(), (SETTINGS, 0), "{command}");
        assert!(rig.session.subscribed().is_empty());
        let counts = rig.session.counts();
        assert_eq!((counts.commands, counts.nacks), (1, 1), "{command}");
    }
}

#[test]
fn unused_settings_are_acknowledged_and_reported_in_7503() {
    let mut rig = Rig::tcp();
    for (ticket, command) in [
        Command::BottomDetectionMask { flags: 3 << 8 },
        Command::BottomDetectionFilter {
            min_range_m: 2.0,
            max_range_m: 90.0,
            min_depth_m: 1.0,
            max_depth_m: 80.0,
            gate_tilt_rad: Some(0.125),
        },
        Command::PulseEnvelope {
            envelope: PulseEnvelope::Tukey,
            shading: 0.5,
        },
        Command::ProjectorSteering {
            vertical_rad: 0.25,
            horizontal_rad: -0.5,
        },
        Command::ProjectorBeamWidths {
            vertical_rad: 0.03,
            horizontal_rad: 2.0,
        },
        Command::MotionCompensation { roll: 1, pitch: 1 },
        Command::CoverageSector {
            sector_rad: 2.5,
            rx_steering_rad: 0.25,
        },
        Command::TriggerOut {
            flags: 1,
            length_s: 0.001,
            offset_s: 0.0005,
        },
        Command::SoundVelocity {
            flags: 1,
            sound_velocity_m_per_s: 1480.0,
            filter: 0,
        },
        Command::GainType(GainType::Fixed),
        Command::MatchFilter {
            window: 1,
            shading: 0.5,
        },
        Command::PpsEdge { edge: 1 },
        Command::SnippetControl {
            flags: 1,
            min_window_samples: 3,
            max_window_samples: 80,
        },
        Command::CompressedWaterColumn { flags: 1 << 2 },
        // The settings of the configuration.
        Command::PulseType(PulseType::LinearChirp),
        Command::CenterFrequency { frequency_hz: 1e5 },
        Command::ChirpBand {
            start_hz: 99_750.0,
            stop_hz: 100_250.0,
        },
    ]
    .into_iter()
    .enumerate()
    {
        let text = command.to_string();
        assert_eq!(rig.ask(command, ticket as u32), Ok(()), "{text}");
    }
    assert_eq!(rig.store.snapshot().0, SETTINGS, "no ping knows of them");
    let s = rig.settings_7503();
    assert_eq!(
        (s.bottom_filter_min_range_m, s.bottom_filter_max_range_m),
        (2.0, 90.0)
    );
    assert_eq!(
        (s.bottom_filter_min_depth_m, s.bottom_filter_max_depth_m),
        (1.0, 80.0)
    );
    assert_eq!(s.depth_gate_tilt_rad, 0.125);
    assert_eq!(
        (s.tx_pulse_envelope, s.tx_pulse_envelope_parameter),
        (1, 0.5)
    );
    assert_eq!(
        (
            s.projector_steer_vertical_rad,
            s.projector_steer_horizontal_rad
        ),
        (0.25, -0.5)
    );
    assert_eq!(s.projector_beam_width_horizontal_rad, 2.0);
    assert_eq!((s.receive_flags & 1, s.transmit_flags & 1), (1, 1));
    assert_eq!(
        (s.coverage_angle_rad, s.rx_horizontal_steering_rad),
        (2.5, 0.25)
    );
    assert_eq!(
        (s.trigger_out_width_s, s.trigger_out_offset_s),
        (0.001, 0.0005)
    );
    assert_eq!(s.sound_velocity_m_per_s, 1480.0);
}

#[test]
fn pings_by_number_and_by_a_foreign_trigger_are_asked_for_and_ended() {
    use echotank_core::time::MonoNs;
    let mut rig = Rig::tcp();
    assert_eq!(rig.ask(Command::SinglePing, 1), Ok(()));
    assert!(rig.store.snapshot().0.pinging, "one is owed");
    rig.store.note_ping(MonoNs(1));
    assert!(!rig.store.snapshot().0.pinging, "continuous pinging ended");
    assert_eq!(rig.ask(Command::PingTimes { count: 2 }, 2), Ok(()));
    rig.store.note_ping(MonoNs(2));
    assert!(rig.store.snapshot().0.pinging);
    rig.store.note_ping(MonoNs(3));
    assert!(!rig.store.snapshot().0.pinging);
    assert_eq!(rig.ask(Command::StartPinging, 3), Ok(()));
    assert_eq!(rig.ask(Command::ExternalTrigger, 4), Ok(()));
    assert!(!rig.store.snapshot().0.pinging, "it waits for a trigger");
    let state = rig.settings_7503().ping_state;
    assert_eq!(state, RemoteSettings7503::PING_EXTERNAL_TRIGGER);
    assert_eq!(rig.ask(Command::StartPinging, 6), Ok(()));
    assert!(
        rig.store.snapshot().0.pinging,
        "1100 ends the foreign trigger"
    );
}

#[test]
fn a_third_party_is_dialled_and_hung_up() {
    use echotank_emit::session as seam;
    let mut rig = Rig::tcp();
    let party = ThirdParty {
        ipv4: u32::from_le_bytes([127, 0, 0, 1]),
        port: 4000,
        transport: Transport::Tcp,
    };
    let out = rig.send(&command(
        Command::ConnectThirdParty {
            party,
            record_type_ids: vec![7000, 7027, 7018],
        },
        1,
    ));
    assert_eq!(answer(&out, 1), Ok(()));
    let peer = "127.0.0.1:4000".parse().expect("an address");
    let want = Outgoing::Dial {
        peer,
        transport: seam::Transport::Tcp,
        wants: RecordSet::of(&[7000, 7018]).into(),
    };
    assert_eq!(out[1], want);
    let out = rig.send(&command(Command::DisconnectThirdParty { party }, 2));
    assert_eq!(answer(&out, 2), Ok(()));
    let transport = seam::Transport::Tcp;
    assert_eq!(out[1], Outgoing::HangUp { peer, transport });
}

/// Otherwise a client could make the server send commands to itself, or flood any address.
#[test]
fn records_go_to_no_third_party_but_the_client_and_configured_addresses() {
    let mut output = output_spec();
    output.third_parties = vec!["192.0.2.7".parse().expect("an address")];
    let denied = Err(ErrorCode::RemoteCommandDenied);
    for (address, port, want) in [
        ([127, 0, 0, 1], 4000, Ok(())),
        ([192, 0, 2, 7], 4000, Ok(())),
        ([127, 0, 0, 1], OWN_PORT, denied),
        ([192, 0, 2, 7], OWN_PORT, denied),
        ([127, 0, 0, 1], 0, denied),
        ([127, 0, 0, 3], 4000, denied),
        ([192, 0, 2, 8], 4000, denied),
        ([255, 255, 255, 255], 4000, denied),
        ([0, 0, 0, 0], 4000, denied),
    ] {
        let mut rig = Rig::tcp();
        rig.sheet = Arc::new(DeviceSheet::new(&output, &sonar(), 1500.0, 0.0));
        let party = ThirdParty {
            ipv4: u32::from_le_bytes(address),
            port,
            transport: Transport::Udp,
        };
        let out = rig.send(&command(
            Command::ConnectThirdParty {
                party,
                record_type_ids: vec![7000],
            },
            1,
        ));
        assert_eq!(answer(&out, 1), want, "{party}");
        let dials = out.iter().filter(|o| matches!(o, Outgoing::Dial { .. }));
        assert_eq!(dials.count(), usize::from(want.is_ok()), "{party}");
    }
}

#[test]
fn commands_are_taken_when_addressed_to_us_or_to_any_sonar() {
    for (device, enumerator, accepted) in [
        (DEVICE, ENUMERATOR, true),
        (DEVICE, 0, true),
        (DEVICE, ENUMERATOR + 1, false),
        (7000, 0, true),
        (7000, 9, true),
        (0, 0, true),
        (7125, 0, true),
        (50, 0, true),
        (104, 0, false),
    ] {
        let mut rig = Rig::tcp();
        let bytes = packet(&command_record(
            Command::Range { range_m: 33.0 },
            1,
            device,
            enumerator,
        ));
        let want = if accepted {
            Ok(())
        } else {
            Err(ErrorCode::InvalidDeviceId)
        };
        assert_eq!(answer(&rig.send(&bytes), 1), want, "{device}:{enumerator}");
        assert_eq!(rig.store.version(), u64::from(accepted));
    }
}

#[test]
fn subscriptions_add_up_and_come_off_one_by_one_or_all_at_once() {
    let mut rig = Rig::tcp();
    // The requests of MBARI's client; half of them are not supported.
    let mbari = subscribe(&[
        1003, 1006, 1008, 1010, 1012, 1013, 1015, 1016, 7000, 7004, 7027,
    ]);
    assert_eq!(rig.ask(mbari, 0), Ok(()));
    let first = RecordSet::of(&[1003, 1012, 1013, 1015, 1016, 7000, 7004]);
    assert_eq!(rig.session.subscribed(), first);
    assert_eq!(rig.ask(subscribe(&[7038, 7500]), 1), Ok(()));
    assert_eq!(
        rig.session.subscribed(),
        first.union(RecordSet::of(&[7038, 7500]))
    );
    let fewer = Command::Unsubscribe {
        record_type_ids: vec![1003, 7004, 7027],
    };
    assert_eq!(rig.ask(fewer, 2), Ok(()));
    assert_eq!(
        rig.session.subscribed(),
        RecordSet::of(&[1012, 1013, 1015, 1016, 7000, 7038, 7500])
    );
    assert_eq!(rig.ask(Command::EndSubscriptions, 3), Ok(()));
    assert!(rig.session.subscribed().is_empty());
    let range = Command::SubscribeRange {
        first: 1000,
        last: 7004,
    };
    assert_eq!(rig.ask(range, 4), Ok(()));
    assert_eq!(
        rig.session.subscribed(),
        RecordSet::of(&[1003, 1009, 1012, 1013, 1015, 1016, 7000, 7004])
    );
}

#[test]
fn mounting_and_profile_are_sent_once_to_a_client_that_subscribes_and_on_request() {
    let mut rig = Rig::tcp();
    let out = rig.send(&command(subscribe(&[7030, 7000, 1009]), 1));
    assert_eq!(record_types(&out), [7501, 7030, 1009, 7500]);
    let out = rig.send(&command(subscribe(&[7030, 7018]), 2));
    assert_eq!(record_types(&out), [7501, 7500]);
    for id in [7030, 1009] {
        let out = rig.send(&command(single(id), 3));
        assert_eq!(record_types(&out), [7501, id, 7500]);
    }
    rig.ask(Command::EndSubscriptions, 4).expect("obeyed");
    let out = rig.send(&command(subscribe(&[1009]), 5));
    assert_eq!(record_types(&out), [7501, 1009, 7500]);
}

#[test]
fn a_sonar_without_a_fan_has_no_beams_to_subscribe_to() {
    let mut sonar = sonar();
    sonar.beams.fan = None;
    let mut rig = Rig::tcp();
    rig.sheet = sheet_of(&sonar);
    assert_eq!(
        rig.ask(subscribe(&[7018, 7004]), 1),
        Err(ErrorCode::RecordNotAvailable)
    );
    assert_eq!(rig.ask(subscribe(&[7018, 7007]), 2), Ok(()));
    assert_eq!(rig.session.subscribed(), RecordSet::of(&[7007]));
}

#[test]
fn settings_asked_for_come_behind_the_acknowledgement_with_ping_number_0() {
    let mut rig = Rig::tcp();
    rig.ask(Command::Power { power_db: 199.0 }, 1)
        .expect("obeyed");
    rig.ask(Command::StopPinging, 2).expect("obeyed");
    let out = rig.send(&command(single(7503), 3));
    assert_eq!(record_types(&out), [7501, 7503, 7500]);
    let record = Record::parse(reply(&out, 1)).expect("7503");
    let s = RemoteSettings7503::parse(record.body()).expect("7503");
    assert_eq!((s.ping_number, s.power_db, s.ping_state), (0, 199.0, 0));
    assert_eq!(s.tx_pulse_width_s, 0.5);
    let b = reply(&out, 1);
    assert_eq!((u32_at(b, 64 + 8), f32_at(b, 64 + 56)), (0, 199.0));
    let out = rig.send(&command(single(7001), 4));
    assert_eq!(record_types(&out), [7501, 7001, 7500]);
}

#[test]
fn a_single_record_request_is_served_once_and_refused_while_the_sonar_is_idle() {
    let mut rig = Rig::tcp();
    assert_eq!(rig.ask(single(7018), 1), Ok(()));
    assert_eq!(rig.session.take_requested(), RecordSet::of(&[7018]));
    assert!(rig.session.take_requested().is_empty() && rig.session.subscribed().is_empty());
    rig.ask(Command::StopPinging, 2).expect("obeyed");
    assert_eq!(rig.ask(single(7018), 3), Err(ErrorCode::RecordNotAvailable));
    assert!(rig.session.take_requested().is_empty());
}

#[test]
fn a_wrong_checksum_is_refused_with_the_ticket_and_the_next_command_obeyed() {
    for session in [Session::stream(), Session::datagrams()] {
        let mut rig = Rig::over(session);
        let mut bad = command(Command::Range { range_m: 60.0 }, 21);
        let last = bad.len() - 1;
        bad[last] ^= 0x40;
        let got = answer(&rig.send(&bad), 21).map_err(ErrorCode::code);
        assert_eq!(got, Err(0x7054));
        assert_eq!(rig.store.version(), 0);
        let good = command(Command::Range { range_m: 61.0 }, 22);
        let out = rig.send(&good);
        assert_eq!(answer(&out, 22), Ok(()));
        let counts = rig.session.counts();
        assert_eq!(
            (counts.framing_errors, counts.commands, counts.nacks),
            (1, 2, 1)
        );
    }
}

#[test]
fn a_wrong_checksum_of_something_else_is_only_counted() {
    let mut rig = Rig::tcp();
    let mut record = command_record(Command::Range { range_m: 60.0 }, 21, 7000, 0);
    record[32..36].copy_from_slice(&7610_u32.to_le_bytes());
    assert_eq!(rig.send(&packet(&record)), []);
    assert_eq!(rig.session.counts().framing_errors, 1);
    // With its checksum corrected, this is a complete record that is not a command.
    let end = record.len() - 4;
    let sum = echotank_protocols::sevenk::checksum(&record[..end]);
    record[end..].copy_from_slice(&sum.to_le_bytes());
    assert_eq!(rig.send(&packet(&record)), []);
    let counts = rig.session.counts();
    assert_eq!((counts.framing_errors, counts.other_records), (1, 1));
    assert_eq!(counts.commands, 0);
}

#[test]
fn records_behind_a_truncated_one_are_found_after_the_timeout() {
    let mut rig = Rig::tcp();
    // The record declares a longer length than the data.
    let long = command(subscribe(&[7000; 1000]), 1);
    assert_eq!(rig.send(&long[..200]), []);
    assert_eq!(rig.send(&command(Command::Range { range_m: 71.0 }, 2)), []);
    assert!(rig.session.is_waiting());
    let out = rig.give_up();
    assert_eq!(answer(&out, 2), Ok(()));
    assert_eq!(rig.store.snapshot().0.range_m, 71.0);
    assert!(!rig.session.is_waiting() && rig.session.counts().framing_errors >= 1);
}

#[test]
fn a_command_cut_into_packets_is_put_together_again() {
    let record = command_record(subscribe(&[7018; 300]), 3, 7000, 0);
    let mut wire = Vec::new();
    let mut packetiser = Packetiser::new(200).expect("a limit");
    let packets: Vec<_> = packetiser.packetise(&record, &mut wire).collect();
    assert!(packets.len() > 5);
    let mut rig = Rig::tcp();
    assert_eq!(answer(&rig.send(&wire), 3), Ok(()));
    let mut rig = Rig::over(Session::datagrams());
    let mut out = Vec::new();
    for packet in packets.into_iter().rev() {
        assert!(out.is_empty());
        out = rig.send(&wire[packet]);
    }
    assert_eq!(answer(&out, 3), Ok(()));
}

/// Random bytes, commands, and commands with one corrupted part.
fn anything() -> impl Strategy<Value = Vec<u8>> {
    let commands = (
        any::<u32>(),
        any::<u32>(),
        prop::collection::vec(any::<u8>(), 0..40),
    )
        .prop_map(|(id, ticket, arguments)| {
            let command =
                Command::parse(1003 + id % 130, &arguments).unwrap_or(Command::Unknown(id));
            command_record(command, ticket, 7000, 0)
        })
        .prop_map(|record| packet(&record));
    prop_oneof![
        prop::collection::vec(any::<u8>(), 0..300),
        commands.clone(),
        (commands, any::<prop::sample::Index>(), any::<u8>()).prop_map(|(mut bytes, at, value)| {
            let at = at.index(bytes.len());
            bytes[at] = value;
            bytes
        }),
    ]
}

proptest! {
    #[test]
    fn no_bytes_make_a_session_panic_and_it_answers_afterwards(pieces in prop::collection::vec(anything(), 0..12)) {
        for session in [Session::stream(), Session::datagrams()] {
            let mut rig = Rig::over(session);
            for piece in &pieces {
                let out = rig.send(piece);
                record_types(&out); // all are complete and correct
            }
            let limits = sonar().limits;
            let s = rig.store.snapshot().0;
            prop_assert!((limits.range_m.0..=limits.range_m.1).contains(&s.range_m));
            rig.give_up();
            let out = rig.send(&command(Command::Range { range_m: 20.0 }, 77));
            prop_assert_eq!(answer(&out, 77), Ok(()));
            prop_assert_eq!(rig.store.snapshot().0.range_m, 20.0);
        }
    }

    #[test]
    fn answers_do_not_depend_on_how_the_bytes_were_cut(pieces in prop::collection::vec(anything(), 1..6), cuts in prop::collection::vec(1..100_usize, 1..20)) {
        let bytes = pieces.concat();
        let mut whole = Rig::tcp();
        let mut want = whole.send(&bytes);
        want.extend(whole.give_up());
        let mut cut = Rig::tcp();
        let mut got = Vec::new();
        let mut rest = &bytes[..];
        for len in cuts.into_iter().cycle() {
            if rest.is_empty() {
                break;
            }
            let (piece, after) = rest.split_at(len.min(rest.len()));
            got.extend(cut.send(piece));
            rest = after;
        }
        got.extend(cut.give_up());
        prop_assert_eq!(got, want);
        prop_assert_eq!(cut.session.counts().commands, whole.session.counts().commands);
    }
}

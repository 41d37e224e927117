//! The server over loopback sockets: several clients, slow and vanished clients, garbage, UDP.

use std::io::{ErrorKind, Read, Write};
use std::net::{Shutdown, SocketAddr, TcpStream, UdpSocket};
use std::sync::Arc;
use std::time::Duration;

use echotank_config::spec::SevenKSpec;
use echotank_core::records::Datagram;
use echotank_emit::sevenk::{RecordSet, SevenKEmitter};
use echotank_protocols::sevenk::records::RawIq7038;
use echotank_protocols::sevenk::{Command, ErrorCode, NetworkFrame, Reassembler};
use echotank_runtime::io::sonar::client::{ClientError, OwnedRecord, SevenKClient};
use echotank_runtime::io::sonar::verify::{PingTally, Verifier};
use echotank_runtime::io::sonar::{
    ClientReport, OpenError, ServerTimes, SonarServer, Transport, start_sevenk, start_sevenk_with,
};
use echotank_runtime::settings::SettingsStore;
use echotank_testing::wire::*;

use super::{PATIENCE, eventually};

/// Timeouts of a server that waits only briefly for the rest of a command.
fn impatient() -> ServerTimes {
    ServerTimes {
        stall: Duration::from_millis(50),
        ..ServerTimes::default()
    }
}

struct Rig {
    server: SonarServer,
    store: Arc<SettingsStore>,
    emitter: SevenKEmitter,
}

impl Rig {
    fn new(change: impl FnOnce(&mut SevenKSpec)) -> Self {
        Self::with_times(change, ServerTimes::default())
    }

    fn with_times(change: impl FnOnce(&mut SevenKSpec), times: ServerTimes) -> Self {
        let mut spec = output_spec();
        change(&mut spec);
        let store = store();
        let server = start_sevenk_with(
            &spec,
            sheet(),
            store.clone(),
            Arc::new(|| TRANSMIT_UTC),
            times,
        )
        .expect("loopback is free");
        Self {
            server,
            store,
            emitter: SevenKEmitter::new(sheet(), 4),
        }
    }

    fn wanted(&self) -> RecordSet {
        self.server.wanted().into()
    }

    fn address(&self) -> SocketAddr {
        self.server.local_addr()
    }

    fn client(&self, record_types: &[u32]) -> SevenKClient {
        let mut client = SevenKClient::connect(self.address()).expect("connects");
        if !record_types.is_empty() {
            client.subscribe(record_types).expect("acknowledged");
        }
        client
    }

    /// Makes and delivers the subscribed records of one ping.
    fn ping(&mut self, number: u32, samples: usize) -> Vec<Arc<Datagram>> {
        let mut records = Vec::new();
        let wanted = self.wanted();
        self.emitter.emit_ping(
            &plan(number, samples),
            &output(samples),
            wanted,
            &mut records,
        );
        self.server.deliver(&records);
        records
    }

    /// Waits until nothing is queued for these clients, so that all sent records are counted.
    fn settle(&self, peers: &[SocketAddr]) {
        eventually("all counted", || {
            peers.iter().all(|&peer| {
                self.report_of(peer)
                    .is_some_and(|client| client.queued_bytes == 0)
            })
        });
    }

    fn report_of(&self, peer: SocketAddr) -> Option<ClientReport> {
        self.server
            .report()
            .clients
            .into_iter()
            .find(|client| client.peer == peer)
    }
}

fn subscribe(record_type_ids: &[u32]) -> Command {
    Command::Subscribe {
        record_type_ids: record_type_ids.to_vec(),
    }
}

fn once(record_type_id: u32) -> Command {
    Command::SingleRecord { record_type_id }
}

fn next(client: &mut SevenKClient) -> OwnedRecord {
    client
        .next_record(PATIENCE)
        .expect("connected")
        .expect("a record in time")
}

#[test]
fn three_clients_get_their_own_records_and_one_that_never_reads_only_loses_its_own() {
    const PINGS: u32 = 120;
    const SAMPLES: usize = 10_000; // 200 kB of elements per ping: 24 MB in all, more than any socket buffer
    let mut rig = Rig::new(|spec| spec.client_queue_bytes = 1 << 20);
    let mut elements = rig.client(&[7000, 7038]);
    let mut lines = rig.client(&[7007, 1012]);
    let idle = socket2::Socket::new(socket2::Domain::IPV4, socket2::Type::STREAM, None);
    let idle = idle.expect("a socket");
    // A machine with large buffers would otherwise accept everything.
    idle.set_recv_buffer_size(64 << 10).expect("a buffer");
    idle.connect(&rig.address().into()).expect("connects");
    let mut idle = TcpStream::from(idle);
    idle.write_all(&command(subscribe(&[7038]), 1))
        .expect("sent");
    let idle_peer = idle.local_addr().expect("an address");
    eventually("the idle client's subscription", || {
        rig.report_of(idle_peer)
            .is_some_and(|client| client.subscribed == RecordSet::of(&[7038]).into())
    });
    assert_eq!(rig.wanted(), RecordSet::of(&[7000, 7038, 7007, 1012]));

    let mut verifier = Verifier::default();
    for number in 1..=PINGS {
        rig.ping(number, SAMPLES);
        let got = [next(&mut elements), next(&mut elements)];
        assert_eq!(got.each_ref().map(OwnedRecord::record_type), [7000, 7038]);
        let raw = RawIq7038::parse(got[1].body()).expect("7038");
        assert_eq!(
            (raw.rth.ping_number, raw.iq_sample_major().len()),
            (number, SAMPLES * 5)
        );
        let sides = [next(&mut lines), next(&mut lines)];
        assert_eq!(sides.each_ref().map(OwnedRecord::record_type), [7007, 1012]);
        for record in got.iter().chain(&sides) {
            verifier.note(record.record_type(), record.body());
        }
    }
    for id in [7000, 7038, 7007] {
        let want = PingTally {
            sent: u64::from(PINGS),
            received: u64::from(PINGS),
            ..PingTally::default()
        };
        assert_eq!(verifier.tally(id), want, "{id}");
    }
    for client in [&elements, &lines] {
        assert_eq!(client.counters().errors(), 0);
    }
    let peers = [&elements, &lines].map(|c| c.local_addr().expect("connected"));
    rig.settle(&peers);
    let report = rig.server.report();
    assert_eq!(report.clients.len(), 3);
    for client in &report.clients {
        let counts = client.counts;
        if client.peer == idle_peer {
            assert!(counts.records_dropped > 0, "{counts:?}");
            let in_queue = 6; // 1 MiB of 200 kB records, and the record being written
            let accounted = counts.records_dropped + counts.records_sent;
            assert!(
                (u64::from(PINGS) - in_queue..=u64::from(PINGS) + 1).contains(&accounted),
                "{counts:?}"
            );
            assert!(client.queued_bytes <= (1 << 20), "{client:?}");
        } else {
            assert_eq!(counts.records_dropped, 0, "{counts:?}");
            // Two records per ping, and the acknowledgement.
            assert_eq!(counts.records_sent, 2 * u64::from(PINGS) + 1);
        }
    }
}

#[test]
fn what_the_slow_client_gets_in_the_end_is_whole_records_with_gaps() {
    const PINGS: u32 = 200;
    let mut rig = Rig::new(|spec| spec.client_queue_bytes = 300_000);
    let mut slow = rig.client(&[7038]);
    for number in 1..=PINGS {
        rig.ping(number, 10_000);
    }
    let dropped = rig.server.report().totals().records_dropped;
    assert!(dropped > 0, "40 MB do not fit");
    let mut verifier = Verifier::default();
    let mut last = 0;
    for _ in 0..u64::from(PINGS) - dropped {
        let record = next(&mut slow);
        let raw = RawIq7038::parse(record.body()).expect("whole");
        assert!(raw.rth.ping_number > last);
        last = raw.rth.ping_number;
        verifier.note(7038, record.body());
    }
    // With the queue empty again, the next record arrives.
    rig.ping(PINGS + 1, 10_000);
    let record = next(&mut slow);
    verifier.note(7038, record.body());
    let tally = verifier.tally(7038);
    assert_eq!((tally.lost, tally.duplicate, tally.late), (dropped, 0, 0));
    assert_eq!(slow.counters().errors(), 0);
}

#[test]
fn a_client_that_vanishes_during_a_record_does_not_affect_others() {
    let mut rig = Rig::new(|_| {});
    let mut steady = rig.client(&[7007]);
    let mut fleeting = TcpStream::connect(rig.address()).expect("connects");
    fleeting
        .write_all(&command(subscribe(&[7038]), 1))
        .expect("sent");
    eventually("the subscription", || rig.wanted().contains(7038));
    rig.ping(1, 100_000); // 2 MB
    let mut part = vec![0; 50_000];
    fleeting.read_exact(&mut part).expect("the beginning");
    drop(fleeting);
    for number in 2..=20 {
        rig.ping(number, 1000);
    }
    for _ in 1..=20 {
        assert_eq!(next(&mut steady).record_type(), 7007);
    }
    eventually("the client gone", || rig.server.report().clients.len() == 1);
    assert_eq!(rig.wanted(), RecordSet::of(&[7007]));
    let gone = rig.server.report().gone;
    assert_eq!(gone.commands, 1, "its counts stay: {gone:?}");
    assert!(gone.records_sent >= 1, "at least the acknowledgement");
}

#[test]
fn garbage_is_counted_at_its_sender_and_does_not_affect_others() {
    let mut rig = Rig::with_times(|_| {}, impatient());
    let mut steady = rig.client(&[7000]);
    let mut noisy = TcpStream::connect(rig.address()).expect("connects");
    let peer = noisy.local_addr().expect("an address");
    let spoiled = |at: usize, value: u8| {
        let mut bytes = command(Command::Gain { gain_db: 1.0 }, 2);
        bytes[at] = value;
        bytes
    };
    let truncated = command(Command::Gain { gain_db: 1.0 }, 3)[..90].to_vec();
    let mut errors = 0;
    for (number, garbage) in [
        b"not a sonar at all".to_vec(),
        spoiled(0, 9),
        spoiled(19, 0x7F),
        spoiled(36 + 4, 0xFE),
        truncated,
        vec![0xFF; 100_000],
    ]
    .into_iter()
    .enumerate()
    {
        // The noisy client is still served. Garbage without a valid record after it counts as one error, whatever its length.
        let range_m = 20.0 + number as f32;
        noisy.write_all(&garbage).expect("sent");
        noisy
            .write_all(&command(Command::Range { range_m }, 9))
            .expect("sent");
        eventually("the garbage counted, the command behind it obeyed", || {
            rig.store.snapshot().0.range_m == f64::from(range_m)
                && rig
                    .report_of(peer)
                    .is_some_and(|client| client.counts.framing_errors > errors)
        });
        errors = rig
            .report_of(peer)
            .map_or(0, |client| client.counts.framing_errors);
        rig.ping(number as u32 + 1, 10);
        assert_eq!(next(&mut steady).record_type(), 7000);
    }
    let report = rig.server.report();
    assert_eq!((report.clients.len(), report.gone.framing_errors), (2, 0));
    assert_eq!(steady.counters().errors(), 0);
}

#[test]
fn a_setting_over_the_wire_is_in_the_snapshot_once_acknowledged_and_echoed_to_listeners() {
    let rig = Rig::new(|_| {});
    let mut listener = rig.client(&[7500]);
    let mut operator = rig.client(&[]);
    // The listener also receives the echo of its own subscription.
    assert_eq!(next(&mut listener).record_type(), 7500);
    for k in 1..=50 {
        let range_m = 10.0 + k as f32;
        operator
            .command(Command::Range { range_m })
            .expect("acknowledged");
        assert_eq!(
            rig.store.snapshot(),
            (
                echotank_core::settings::SonarSettings {
                    range_m: f64::from(range_m),
                    ..SETTINGS
                },
                k
            )
        );
    }
    let refused = operator.command(Command::Range { range_m: 1e6 });
    assert!(
        matches!(
            refused,
            Err(ClientError::Refused(ErrorCode::ParameterOutOfRange))
        ),
        "{refused:?}"
    );
    for k in 1..=50 {
        let record = next(&mut listener);
        assert_eq!(record.record_type(), 7500);
        assert_eq!(f32_at(record.body(), 24), 10.0 + k as f32);
    }
    let nothing = listener
        .next_record(Duration::from_millis(50))
        .expect("connected");
    assert_eq!(nothing, None, "neither answers nor refusals of others");
    let totals = rig.server.report().totals();
    assert_eq!((totals.commands, totals.nacks), (52, 1));
}

#[test]
fn records_can_be_asked_for_one_at_a_time() {
    let mut rig = Rig::new(|_| {});
    let mut client = rig.client(&[]);
    let settings = client.request(7503).expect("at once");
    assert_eq!(u32_at(settings.body(), 8), 0, "ping number: settings now");
    assert_eq!(client.request(7001).expect("at once").record_type(), 7001);
    client.command(once(7018)).expect("promised");
    eventually("wanted", || rig.wanted() == RecordSet::of(&[7018]));
    rig.ping(1, 10);
    let beams = next(&mut client);
    assert_eq!((beams.record_type(), u32_at(beams.body(), 8)), (7018, 1));
    assert_eq!(rig.wanted(), RecordSet::EMPTY, "once");
    assert!(rig.ping(2, 10).is_empty());
}

#[test]
fn clients_beyond_the_limit_are_refused_until_one_leaves() {
    let rig = Rig::new(|spec| spec.max_clients = 2);
    let _first = rig.client(&[7000]);
    let second = rig.client(&[7000]);
    let mut third = SevenKClient::connect(rig.address()).expect("the kernel accepts");
    assert!(third.subscribe(&[7000]).is_err(), "closed by the server");
    assert_eq!(rig.server.report().refused, 1);
    drop(second);
    eventually("a free seat", || rig.server.report().clients.len() == 1);
    let _fourth = rig.client(&[7000]);
    assert_eq!(rig.server.report().admitted, 3);
}

#[test]
fn a_stalled_command_does_not_swallow_the_one_behind_it_for_ever() {
    let rig = Rig::with_times(|_| {}, impatient());
    let mut socket = TcpStream::connect(rig.address()).expect("connects");
    let long = command(subscribe(&[7000; 2000]), 1);
    socket.write_all(&long[..300]).expect("sent");
    let good = Command::Range { range_m: 42.0 };
    socket.write_all(&command(good, 2)).expect("sent");
    eventually("the command behind", || {
        rig.store.snapshot().0.range_m == 42.0
    });
}

#[test]
fn a_client_that_floods_commands_and_never_reads_is_not_read_from() {
    let mut rig = Rig::new(|_| {});
    let mut steady = rig.client(&[7000]);
    let mut flood = TcpStream::connect(rig.address()).expect("connects");
    let burst = command(once(7001), 1).repeat(100);
    flood.set_nonblocking(true).expect("a socket");
    let (mut written, mut stuck) = (0_usize, 0);
    while stuck < 100 {
        assert!(written < 256 << 20, "the server takes everything");
        match flood.write(&burst) {
            Ok(len) => (written, stuck) = (written + len, 0),
            Err(error) => {
                assert_eq!(error.kind(), ErrorKind::WouldBlock);
                stuck += 1;
                std::thread::sleep(Duration::from_millis(2));
            }
        }
    }
    rig.ping(1, 10);
    assert_eq!(next(&mut steady).record_type(), 7000);
    let peer = flood.local_addr().expect("an address");
    let report = rig.report_of(peer).expect("still there");
    assert!(
        report.queued_bytes < 8 << 20,
        "answers are bounded: {report:?}"
    );
}

#[test]
fn a_client_that_closes_its_sending_side_still_gets_its_answers() {
    let rig = Rig::new(|_| {});
    let mut socket = TcpStream::connect(rig.address()).expect("connects");
    socket.write_all(&command(once(7001), 1)).expect("sent");
    socket.shutdown(Shutdown::Write).expect("closed");
    socket.set_read_timeout(Some(PATIENCE)).expect("a socket");
    let mut bytes = Vec::new();
    socket
        .read_to_end(&mut bytes)
        .expect("answers, then the end");
    let first = NetworkFrame::parse(&bytes).expect("a frame");
    assert_eq!(u32_at(&bytes, 36 + 32), 7501);
    let second = first.packet_size_bytes as usize;
    assert_eq!(u32_at(&bytes, second + 36 + 32), 7001);
}

#[test]
fn stopping_writes_what_is_queued_and_then_closes() {
    let mut rig = Rig::new(|spec| spec.client_queue_bytes = 64 << 20);
    let mut client = rig.client(&[7038]);
    for number in 1..=20 {
        rig.ping(number, 10_000);
    }
    let reader = std::thread::spawn(move || {
        let mut verifier = Verifier::default();
        loop {
            match client.next_record(PATIENCE) {
                Ok(Some(record)) => verifier.note(7038, record.body()),
                Ok(None) => panic!("neither record nor end"),
                Err(ClientError::Closed) => return verifier.tally(7038),
                Err(error) => panic!("{error}"),
            };
        }
    });
    let report = rig.server.stop();
    let tally = reader.join().expect("no panic");
    assert_eq!((tally.received, tally.lost), (20, 0), "{report:?}");
    assert_eq!(report.clients.len(), 0);
    assert_eq!(
        (report.gone.records_sent, report.gone.records_unsent),
        (21, 0)
    );
}

#[test]
fn packets_are_as_long_as_the_listener_says() {
    for (max_packet, whole) in [(1000, false), (10_000_000, true)] {
        let mut rig = Rig::new(|spec| spec.max_packet = max_packet);
        let mut socket = TcpStream::connect(rig.address()).expect("connects");
        let ask = command(subscribe(&[7038]), 1);
        socket.write_all(&ask).expect("sent");
        eventually("the subscription", || rig.wanted().contains(7038));
        let records = rig.ping(1, 5000);
        let mut ack = vec![0; 36 + 64 + 20 + 4];
        socket.read_exact(&mut ack).expect("7501");
        let mut head = [0; 36];
        socket.read_exact(&mut head).expect("a network frame");
        let frame = NetworkFrame::parse(&head).expect("a network frame");
        let len = records[0].bytes.len();
        assert_eq!(frame.total_size_bytes as usize, len);
        if whole {
            assert_eq!(
                (frame.packet_size_bytes as usize, frame.total_packets),
                (len + 36, 1)
            );
        } else {
            assert_eq!(frame.packet_size_bytes, 1000);
            assert_eq!(frame.total_packets as usize, len.div_ceil(964));
        }
    }
}

#[test]
fn a_port_in_use_and_a_packet_too_short_are_refused_with_a_reason() {
    let rig = Rig::new(|_| {});
    let open = |change: &dyn Fn(&mut SevenKSpec)| {
        let mut spec = output_spec();
        change(&mut spec);
        start_sevenk(&spec, sheet(), store(), Arc::new(|| TRANSMIT_UTC)).map(|_| ())
    };
    let taken = open(&|spec| spec.listen = rig.address()).expect_err("in use");
    assert!(matches!(taken, OpenError::Listen { .. }));
    let words = taken.to_string();
    assert!(
        words.starts_with(&format!("cannot listen on TCP {}", rig.address())),
        "{words}"
    );
    let short = open(&|spec| spec.max_packet = 99).expect_err("too short");
    assert_eq!(
        short.to_string(),
        "max_packet = 99: must be from 100 to 4294967295"
    );
}

// ---------------------------------------------------------------- UDP

struct UdpClient {
    socket: UdpSocket,
    reassembler: Reassembler,
    buffer: Vec<u8>,
    longest: usize,
}

impl UdpClient {
    fn to(address: SocketAddr) -> Self {
        let socket = UdpSocket::bind("127.0.0.1:0").expect("a port");
        socket.connect(address).expect("loopback");
        socket.set_read_timeout(Some(PATIENCE)).expect("a socket");
        Self {
            socket,
            reassembler: Reassembler::new(1 << 20),
            buffer: vec![0; 65_536],
            longest: 0,
        }
    }
    fn send(&self, command: Command, ticket: u32) {
        let bytes = echotank_testing::wire::command(command, ticket);
        self.socket.send(&bytes).expect("sent");
    }
    /// The next record: type and whole bytes.
    fn next(&mut self) -> (u32, Vec<u8>) {
        loop {
            let len = self.socket.recv(&mut self.buffer).expect("a datagram");
            self.longest = self.longest.max(len);
            let whole = self.reassembler.push_datagram(&self.buffer[..len]);
            if let Some(record) = whole.expect("right") {
                return (record.frame.record_type_id, record.bytes().to_vec());
            }
        }
    }
}

#[test]
fn udp_subscribes_receives_records_in_datagrams_and_unsubscribes() {
    let mut rig = Rig::new(|spec| spec.max_packet = 1000);
    let mut client = UdpClient::to(rig.address());
    client.send(subscribe(&[7000, 7007]), 1);
    assert_eq!(client.next().0, 7501);
    eventually("wanted", || rig.wanted() == RecordSet::of(&[7000, 7007]));
    for number in 1..=10 {
        let records = rig.ping(number, 2000); // 8 kB of lines: 9 datagrams
        for want in &records {
            let (record_type, bytes) = client.next();
            assert_eq!((record_type, &bytes), (want.record_type, &want.bytes));
        }
    }
    assert_eq!(client.longest, 1000);
    client.send(
        Command::Unsubscribe {
            record_type_ids: vec![7007],
        },
        2,
    );
    assert_eq!(client.next().0, 7501);
    rig.ping(11, 2000);
    assert_eq!(client.next().0, 7000);
    client.send(Command::EndSubscriptions, 3);
    assert_eq!(client.next().0, 7501);
    eventually("nothing wanted", || rig.wanted().is_empty());
    client.send(Command::Range { range_m: 1e9 }, 4);
    let (record_type, bytes) = client.next();
    assert_eq!((record_type, u32_at(&bytes, 84)), (7502, 0x7001));
    rig.settle(&[client.socket.local_addr().expect("an address")]);
    let report = rig.server.report();
    assert_eq!(report.clients[0].transport, Transport::Udp);
    let counts = report.clients[0].counts;
    assert_eq!((counts.commands, counts.nacks), (4, 1));
    // Five replies and two records ten times, and one more.
    assert_eq!((counts.records_sent, counts.records_dropped), (4 + 21, 0));
}

#[test]
fn stray_udp_datagrams_are_counted_and_open_no_session() {
    let rig = Rig::new(|_| {});
    let socket = UdpSocket::bind("127.0.0.1:0").expect("a port");
    for garbage in [&b""[..], b"hello", &[0xFF; 2000]] {
        socket.send_to(garbage, rig.address()).expect("sent");
    }
    let mut client = UdpClient::to(rig.address());
    client.send(once(7001), 1);
    assert_eq!(client.next().0, 7501);
    assert_eq!(client.next().0, 7001);
    let report = rig.server.report();
    assert_eq!(
        (
            report.gone.framing_errors,
            report.admitted,
            report.clients.len()
        ),
        (3, 1, 1)
    );
}

#[test]
fn silent_udp_clients_are_dropped() {
    let times = ServerTimes {
        udp_idle: Duration::from_millis(30),
        udp_silence: Duration::from_millis(600),
        ..ServerTimes::default()
    };
    let rig = Rig::with_times(|_| {}, times);
    let mut idle = UdpClient::to(rig.address());
    idle.send(Command::Range { range_m: 20.0 }, 1);
    assert_eq!(idle.next().0, 7501);
    eventually("the idle one gone", || {
        rig.server.report().clients.is_empty()
    });
    let mut subscriber = UdpClient::to(rig.address());
    subscriber.send(subscribe(&[7000]), 1);
    assert_eq!(subscriber.next().0, 7501);
    eventually("the silent one gone", || {
        let report = rig.server.report();
        report.clients.is_empty() && report.admitted == 2 && rig.wanted().is_empty()
    });
    // It may reconnect.
    subscriber.send(subscribe(&[7000]), 2);
    assert_eq!(subscriber.next().0, 7501);
    assert_eq!(rig.wanted(), RecordSet::of(&[7000]));
}

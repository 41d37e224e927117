//! The load of a large multibeam: two topsides that read and one that does not. `tools/soak --load` is the long form.

use std::io::{Read, Write};
use std::net::TcpStream;
use std::sync::Arc;
use std::time::{Duration, Instant};

use echotank_config::spec::SevenKSpec;
use echotank_core::ping::PingOutput;
use echotank_emit::sevenk::records::DeviceSheet;
use echotank_emit::sevenk::{RecordSet, SevenKEmitter};
use echotank_protocols::sevenk::Command;
use echotank_runtime::io::sonar::client::SevenKClient;
use echotank_runtime::io::sonar::verify::Verifier;
use echotank_runtime::io::sonar::{SonarServer, start_sevenk};

use echotank_testing::wire::*;

const ELEMENTS: usize = 256;
pub(crate) const SAMPLES: usize = 2000;
const PINGS: u32 = 20;
const PATIENCE: Duration = Duration::from_secs(60);

pub(crate) fn frames() -> PingOutput {
    large_output(ELEMENTS, SAMPLES)
}

pub(crate) fn start(change: impl FnOnce(&mut SevenKSpec)) -> (SonarServer, SevenKEmitter) {
    let mut spec = output_spec();
    spec.arrays = vec![0];
    spec.client_queue_bytes = 16 << 20;
    change(&mut spec);
    let mut sonar = large_sonar(ELEMENTS);
    sonar.beams.lines.clear();
    let sheet = Arc::new(DeviceSheet::new(
        &spec,
        &sonar,
        SOUND_M_PER_S,
        ABSORPTION_DB_PER_M,
    ));
    let now = Arc::new(|| TRANSMIT_UTC);
    let server = start_sevenk(&spec, sheet.clone(), store(), now).expect("loopback is free");
    (server, SevenKEmitter::new(sheet, 8))
}

fn reader(server: &SonarServer) -> std::thread::JoinHandle<Verifier> {
    let mut client = SevenKClient::connect(server.local_addr()).expect("listening");
    client.subscribe(&[7038, 7018]).expect("subscribed");
    std::thread::spawn(move || {
        let mut verifier = Verifier::default();
        while verifier.tally(7038).received < u64::from(PINGS) {
            let record = client.next_record(PATIENCE).expect("connected");
            let record = record.expect("a record in time");
            verifier.note(record.record_type(), record.body());
        }
        assert_eq!(client.counters().checksum_errors, 0);
        verifier
    })
}

/// Connects a client with a small window that subscribes to elements.
fn slow(server: &SonarServer) -> TcpStream {
    let socket =
        socket2::Socket::new(socket2::Domain::IPV4, socket2::Type::STREAM, None).expect("a socket");
    socket.set_recv_buffer_size(64 << 10).expect("a buffer");
    socket
        .connect(&server.local_addr().into())
        .expect("connects");
    let mut stream = TcpStream::from(socket);
    let subscribe = Command::Subscribe {
        record_type_ids: vec![7038],
    };
    stream.write_all(&command(subscribe, 1)).expect("sent");
    stream
}

fn load(disconnect: bool) -> (u64, bool) {
    let (server, mut emitter) = start(|spec| spec.disconnect_when_full = disconnect);
    let mut third = slow(&server);
    let readers = [reader(&server), reader(&server)];
    let deadline = Instant::now() + PATIENCE;
    let seated = || {
        let report = server.report();
        report
            .clients
            .iter()
            .filter(|c| !c.subscribed.is_empty())
            .count()
            == 3
    };
    while !seated() {
        assert!(Instant::now() < deadline, "three clients");
        std::thread::sleep(Duration::from_millis(2));
    }
    let peer = third.local_addr().expect("bound");
    let output = frames();
    let wanted = RecordSet::from(server.wanted());
    let mut records = Vec::new();
    let mut byte = [0; 1];
    let mut is_open = true;
    for ping in 1..=PINGS {
        records.clear();
        emitter.emit_ping(&plan(ping, SAMPLES), &output, wanted, &mut records);
        server.deliver(&records);
        // The third client reads one byte per ping.
        is_open = is_open && matches!(third.read(&mut byte), Ok(1));
        // A loaded machine may not sustain 41 MB/s. Sending is therefore limited to the rate of the readers, so that only the third client can lose.
        let waiting = || {
            let report = server.report();
            let others = report.clients.iter().filter(|c| c.peer != peer);
            others.map(|c| c.queued_bytes).max().unwrap_or(0)
        };
        while waiting() > 8 << 20 {
            assert!(Instant::now() < deadline, "the readers read");
            std::thread::sleep(Duration::from_millis(1));
        }
    }
    for reader in readers {
        let verifier = reader.join().expect("no panic");
        for kind in [7018, 7038] {
            let tally = verifier.tally(kind);
            assert_eq!(
                (tally.received, tally.lost, tally.duplicate, tally.late),
                (PINGS.into(), 0, 0, 0),
                "{kind}"
            );
        }
    }
    let report = server.report();
    let third = report.clients.iter().find(|c| c.peer == peer);
    let dropped = third.map_or(report.gone.records_dropped, |c| c.counts.records_dropped);
    (dropped, third.is_some())
}

#[test]
fn two_topsides_lose_nothing_of_41_mb_a_second_while_a_third_misses_whole_records() {
    let (dropped, is_there) = load(false);
    // 2 MB per record, of which 16 MiB can be queued.
    assert!(
        is_there && (1..u64::from(PINGS)).contains(&dropped),
        "{dropped}"
    );
}

#[test]
fn a_topside_that_does_not_read_is_disconnected_where_the_configuration_says_so() {
    let (dropped, is_there) = load(true);
    // The record that did not fit, and the record in transit.
    assert!(
        !is_there && (1..=2).contains(&dropped),
        "{dropped} dropped, there: {is_there}"
    );
}

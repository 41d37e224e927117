//! A full server, and clients that have gone without a word.

use std::net::{SocketAddr, TcpStream, UdpSocket};
use std::sync::Arc;
use std::time::{Duration, Instant};

use echotank_protocols::sevenk::Command;
use echotank_runtime::io::sonar::client::SevenKClient;
use echotank_runtime::io::sonar::{ServerTimes, SonarServer, start_sevenk_with};
use echotank_testing::wire::*;

/// Time limit of a wait.
const PATIENCE: Duration = Duration::from_secs(20);

fn server(max_clients: usize, times: ServerTimes) -> SonarServer {
    let mut spec = output_spec();
    spec.max_clients = max_clients;
    start_sevenk_with(&spec, sheet(), store(), Arc::new(|| TRANSMIT_UTC), times)
        .expect("loopback is free")
}

fn eventually(what: &str, mut holds: impl FnMut() -> bool) {
    let deadline = Instant::now() + PATIENCE;
    while !holds() {
        assert!(Instant::now() < deadline, "never came: {what}");
        std::thread::sleep(Duration::from_millis(2));
    }
}

fn peers(server: &SonarServer) -> Vec<SocketAddr> {
    server
        .report()
        .clients
        .iter()
        .map(|client| client.peer)
        .collect()
}

#[test]
fn the_idlest_silent_client_gives_its_seat_to_a_new_one() {
    let times = ServerTimes {
        seat_idle: Duration::from_millis(300),
        ..ServerTimes::default()
    };
    let server = server(3, times);
    let mut subscriber = SevenKClient::connect(server.local_addr()).expect("connects");
    subscriber.subscribe(&[7000]).expect("acknowledged");
    let silent: Vec<_> = (1..3)
        .map(|k| {
            let stream = TcpStream::connect(server.local_addr()).expect("connects");
            eventually("admitted", || peers(&server).len() == 1 + k);
            stream
        })
        .collect();
    // Nobody has been idle for long enough: the new client is refused.
    drop(TcpStream::connect(server.local_addr()).expect("connects"));
    eventually("refused", || server.report().refused == 1);
    std::thread::sleep(2 * times.seat_idle);
    let mut new = SevenKClient::connect(server.local_addr()).expect("connects");
    new.subscribe(&[7000]).expect("has a seat");
    let left = peers(&server);
    let of = |k: usize| silent[k].local_addr().expect("an address");
    assert!(!left.contains(&of(0)) && left.contains(&of(1)), "{left:?}");
    assert!(subscriber.command(Command::Range { range_m: 80.0 }).is_ok());
}

/// A topside that was killed: its subscription would otherwise last for an hour.
#[cfg(target_os = "linux")]
#[test]
fn a_udp_client_whose_port_is_closed_leaves_and_the_others_lose_nothing() {
    let server = server(8, ServerTimes::default());
    let subscribe = |number| {
        let socket = UdpSocket::bind("127.0.0.1:0").expect("loopback is free");
        let wanted = Command::Subscribe {
            record_type_ids: vec![7000],
        };
        socket
            .send_to(&command(wanted, number), server.local_addr())
            .expect("sent");
        eventually("subscribed", || {
            let address = socket.local_addr().expect("an address");
            let report = server.report();
            let client = report.clients.iter().find(|client| client.peer == address);
            client.is_some_and(|client| !client.subscribed.is_empty())
        });
        socket
    };
    let (stays, killed) = (subscribe(1), subscribe(2));
    drop(killed);
    let mut emitter = echotank_emit::sevenk::SevenKEmitter::new(sheet(), 4);
    let mut sent = 0;
    eventually("the closed port", || {
        sent += 1;
        let mut records = Vec::new();
        let wanted = server.wanted().into();
        emitter.emit_ping(&plan(sent, 16), &output(16), wanted, &mut records);
        server.deliver(&records);
        peers(&server).len() == 1
    });
    let address = stays.local_addr().expect("an address");
    assert_eq!(peers(&server), [address]);
    eventually("all sent", || {
        let report = server.report();
        report.clients[0].queued_bytes == 0
    });
    let counts = server.report().clients[0].counts;
    assert_eq!(counts.records_dropped, 0, "{counts:?} of {sent} pings");
}

//! A full server, and clients that vanished.

use std::net::{SocketAddr, TcpStream, UdpSocket};
use std::sync::Arc;
use std::time::{Duration, Instant};

use echotank_core::records::Datagram;
use echotank_emit::element_stream::ElementsProtocol;
use echotank_protocols::sevenk::control::{ThirdParty, Transport as PartyTransport};
use echotank_protocols::sevenk::{Command, ErrorCode};
use echotank_runtime::io::sonar::client::{ClientError, SevenKClient};
use echotank_runtime::io::sonar::{
    ServerSpec, ServerTimes, SonarServer, WhenFull, start_sevenk_with,
};
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
    // No client has been idle for long enough, so the new client is refused.
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

/// A killed UDP client would otherwise stay subscribed for an hour.
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

/// Clients on a data port send no commands, and the kernel's buffer hides a client that does not read, because the records are small.
#[test]
fn clients_that_read_nothing_of_a_slow_stream_give_their_seats() {
    const CLIENTS: usize = 3;
    const RECORD_BYTES: usize = 8 * 1024;
    const RECORDS: usize = 64;
    let times = ServerTimes {
        seat_idle: Duration::from_millis(300),
        ..ServerTimes::default()
    };
    let spec = ServerSpec {
        listen: "127.0.0.1:0".parse().expect("an address"),
        tcp: true,
        udp: false,
        client_queue_bytes: 1 << 20,
        when_full: WhenFull::Skip,
        max_clients: CLIENTS,
    };
    let server = SonarServer::start(
        &spec,
        Arc::new(ElementsProtocol),
        Arc::new(|| TRANSMIT_UTC),
        times,
    );
    let server = server.expect("loopback is free");
    let connect = || TcpStream::connect(server.local_addr()).expect("connects");
    let mut reader = connect();
    let silent: Vec<_> = (1..CLIENTS).map(|_| connect()).collect();
    eventually("admitted", || peers(&server).len() == CLIENTS);
    let record = Arc::new(Datagram {
        record_type: 0,
        bytes: vec![0; RECORD_BYTES],
    });
    // The kernel alone would accept all these records for a client that does not read.
    for _ in 0..RECORDS {
        server.deliver(std::slice::from_ref(&record));
        let mut bytes = [0; RECORD_BYTES];
        std::io::Read::read_exact(&mut reader, &mut bytes).expect("connected");
    }
    std::thread::sleep(2 * times.seat_idle);
    let new = connect();
    let address = new.local_addr().expect("an address");
    eventually("a seat for a new client", || {
        peers(&server).contains(&address)
    });
    let left = peers(&server);
    let has = |stream: &TcpStream| left.contains(&stream.local_addr().expect("an address"));
    assert!(has(&reader), "{left:?}");
    let gone = silent.iter().filter(|stream| !has(stream)).count();
    assert_eq!(gone, 1, "{left:?}");
}

/// A client asks the server to send records to the server's own port. Echoes of commands would then be received as commands.
#[test]
fn a_server_sends_nothing_to_its_own_port() {
    let server = server(8, ServerTimes::default());
    let mut client = SevenKClient::connect(server.local_addr()).expect("connects");
    let party = |port| Command::ConnectThirdParty {
        party: ThirdParty {
            ipv4: u32::from_le_bytes([127, 0, 0, 1]),
            port,
            transport: PartyTransport::Udp,
        },
        record_type_ids: vec![7500, 7000],
    };
    let own = server.local_addr().port();
    let answer = client.command(party(own));
    assert!(
        matches!(
            answer,
            Err(ClientError::Refused(ErrorCode::RemoteCommandDenied))
        ),
        "{answer:?}"
    );
    assert_eq!(server.report().clients.len(), 1);
}

#[test]
fn an_unrenewed_stream_to_a_third_party_ends() {
    let times = ServerTimes {
        dial_udp: Duration::from_millis(200),
        ..ServerTimes::default()
    };
    let server = server(8, times);
    let mut client = SevenKClient::connect(server.local_addr()).expect("connects");
    let socket = UdpSocket::bind("127.0.0.1:0").expect("loopback is free");
    let port = socket.local_addr().expect("bound").port();
    let dial = Command::ConnectThirdParty {
        party: ThirdParty {
            ipv4: u32::from_le_bytes([127, 0, 0, 1]),
            port,
            transport: PartyTransport::Udp,
        },
        record_type_ids: vec![7000],
    };
    client.command(dial).expect("accepted");
    eventually("dialled", || server.report().admitted == 2);
    eventually("ended", || server.report().clients.len() == 1);
}

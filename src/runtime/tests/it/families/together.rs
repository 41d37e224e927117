//! 7k and JSF on one sonar at the same time, over sockets: each protocol changes settings, and each reports the changes of the other.

use std::io::{Read, Write};
use std::net::TcpStream;
use std::sync::Arc;
use std::time::{Duration, Instant};

use echotank_config::spec::{JsfChannels, JsfFormat};
use echotank_emit::jsf::session::{JsfCommands, JsfData};
use echotank_protocols::jsf::{Control, JsfStream, Message, Value, command_type, message_type};
use echotank_protocols::sevenk::control::{ThirdParty, Transport as WireTransport};
use echotank_protocols::sevenk::{Command, ControlRequest};
use echotank_runtime::io::sonar::client::SevenKClient;
use echotank_runtime::io::sonar::{
    ServerSpec, ServerTimes, SonarServer, Transport, WhenFull, start_sevenk,
};
use echotank_runtime::settings::SettingsStore;

use super::rig::*;
use echotank_testing::wire::*;

const PATIENCE: Duration = Duration::from_secs(20);

struct Rig {
    store: Arc<SettingsStore>,
    sevenk: SonarServer,
    commands: SonarServer,
    data: SonarServer,
}

fn listener() -> ServerSpec {
    ServerSpec {
        listen: "127.0.0.1:0".parse().expect("an address"),
        tcp: true,
        udp: false,
        client_queue_bytes: 1 << 20,
        when_full: WhenFull::Skip,
        max_clients: 4,
    }
}

impl Rig {
    fn new() -> Self {
        let store = store();
        let now: echotank_runtime::io::sonar::RigTime = Arc::new(|| TRANSMIT_UTC);
        let sheet_of_jsf = jsf_sheet(JsfChannels::Sides, JsfFormat::Envelope);
        let commands = JsfCommands {
            sheet: sheet_of_jsf.clone(),
            settings: store.clone(),
        };
        let data = JsfData {
            sheet: sheet_of_jsf,
        };
        let times = ServerTimes::default();
        Self {
            sevenk: start_sevenk(&output_spec(), sheet(), store.clone(), now.clone()).expect("7k"),
            commands: SonarServer::start(&listener(), Arc::new(commands), now.clone(), times)
                .expect("jsf"),
            data: SonarServer::start(&listener(), Arc::new(data), now, times).expect("jsf data"),
            store,
        }
    }
}

struct JsfSocket {
    socket: TcpStream,
    stream: JsfStream,
}

impl JsfSocket {
    fn to(server: &SonarServer) -> Self {
        let socket = TcpStream::connect(server.local_addr()).expect("listening");
        socket.set_read_timeout(Some(PATIENCE)).expect("a timeout");
        Self {
            socket,
            stream: JsfStream::new(Default::default()),
        }
    }

    fn send(&mut self, control: &Control) {
        let mut bytes = Vec::new();
        control.emit(&mut bytes);
        self.socket.write_all(&bytes).expect("sent");
    }

    fn next(&mut self) -> Vec<u8> {
        let mut buffer = [0; 65_536];
        loop {
            if let Some(message) = self.stream.next_message() {
                return message.expect("whole").to_vec();
            }
            let len = self.socket.read(&mut buffer).expect("in time");
            assert!(len > 0, "closed");
            let mut rest = &buffer[..len];
            while !rest.is_empty() {
                let taken = self.stream.push(rest);
                rest = &rest[taken..];
            }
        }
    }

    fn get(&mut self, kind: u16) -> Value {
        self.send(&control(command_type::GET, kind, 20, 0, Value::None));
        let bytes = self.next();
        let message = Message::parse(&bytes).expect("an answer");
        Control::parse(&message).expect("an answer").value
    }
}

fn eventually(what: &str, mut holds: impl FnMut() -> bool) {
    let deadline = Instant::now() + PATIENCE;
    while !holds() {
        assert!(Instant::now() < deadline, "never came: {what}");
        std::thread::sleep(Duration::from_millis(2));
    }
}

/// Next command that is echoed to a subscriber of 7500.
fn next_echo(client: &mut SevenKClient) -> Command {
    loop {
        let record = client
            .next_record(PATIENCE)
            .expect("connected")
            .expect("a record in time");
        if record.record_type() == 7500 {
            let request = ControlRequest::parse(record.body()).expect("a command");
            return request.command;
        }
    }
}

#[test]
fn each_protocol_reports_what_the_other_has_changed() {
    let rig = Rig::new();
    let mut topside = SevenKClient::connect(rig.sevenk.local_addr()).expect("listening");
    topside.subscribe(&[7500]).expect("subscribed");
    // The first echo is the client's own subscription.
    assert!(matches!(next_echo(&mut topside), Command::Subscribe { .. }));
    let mut jsf = JsfSocket::to(&rig.commands);
    // 7k changes a setting, JSF reports the change.
    topside
        .command(Command::Range { range_m: 42.0 })
        .expect("acknowledged");
    assert_eq!(jsf.get(message_type::PING_RANGE), Value::Number(42_000));
    assert!(matches!(next_echo(&mut topside), Command::Range { range_m } if range_m == 42.0));
    // JSF changes settings; 7k echoes the equivalent command exactly once.
    for (kind, value, want) in [
        (
            message_type::PING_RANGE,
            55_000,
            Command::Range { range_m: 55.0 },
        ),
        (
            message_type::PING_RATE,
            1_500,
            Command::MaxPingRate { pings_per_s: 1.5 },
        ),
        (message_type::PING, 0, Command::StopPinging),
        (message_type::PING, 1, Command::StartPinging),
    ] {
        jsf.send(&control(
            command_type::SET,
            kind,
            20,
            0,
            Value::Number(value),
        ));
        assert_eq!(next_echo(&mut topside), want);
    }
    let record = topside.request(7503).expect("settings");
    let body = record.body();
    assert_eq!(f32_at(body, 52), 55.0, "range in 7503");
}

#[test]
fn contradictory_commands_end_in_one_state_that_both_report() {
    const ROUNDS: usize = 200;
    let rig = Rig::new();
    let address = rig.sevenk.local_addr();
    let topside = std::thread::spawn(move || {
        let mut topside = SevenKClient::connect(address).expect("listening");
        for k in 0..ROUNDS {
            let range_m = if k % 3 == 0 {
                1e6
            } else {
                10.0 + (k % 7) as f32
            };
            assert_eq!(
                topside.command(Command::Range { range_m }).is_ok(),
                k % 3 != 0,
                "the limits hold with other clients active"
            );
        }
        topside
    });
    let mut jsf = JsfSocket::to(&rig.commands);
    for k in 0..ROUNDS {
        let mm = 100_000 + 1000 * (k % 5) as i32;
        jsf.send(&control(
            command_type::SET,
            message_type::PING_RANGE,
            20,
            0,
            Value::Number(mm),
        ));
    }
    // The reply follows all earlier commands.
    let _ = jsf.get(message_type::ALIVE);
    let mut topside = topside.join().expect("no panic");
    let truth = rig.store.snapshot().0.range_m;
    assert_eq!(
        jsf.get(message_type::PING_RANGE),
        Value::Number((truth * 1e3) as i32)
    );
    let record = topside.request(7503).expect("settings");
    assert_eq!(f64::from(f32_at(record.body(), 52)), truth);
    let counts = rig.store.counts();
    let refused = ROUNDS.div_ceil(3) as u64;
    assert_eq!(counts.refused, refused);
    // Every accepted command counts once, plus the settings that only JSF has.
    assert_eq!(counts.applied, ROUNDS as u64 - refused + 2 * ROUNDS as u64);
    let last = rig.store.recent().pop().expect("a change");
    assert!(["7k", "jsf"].contains(&last.origin.by.via), "{last:?}");
    assert!(last.origin.by.peer.is_some());
}

#[test]
fn a_data_port_client_gets_the_system_record_and_active_channels() {
    let rig = Rig::new();
    let mut data = JsfSocket::to(&rig.data);
    let bytes = data.next();
    let message = Message::parse(&bytes).expect("whole");
    assert_eq!(
        message.header.message_type,
        message_type::SYSTEM_INFORMATION
    );
    eventually("wanted", || !rig.data.wanted().is_empty());
    let messages = jsf_ping(
        JsfChannels::Sides,
        JsfFormat::Envelope,
        &plan(1, 6),
        &output(6),
    );
    rig.data.deliver(&messages);
    for want in &messages {
        assert_eq!(data.next(), want.bytes);
    }
}

#[test]
fn a_third_party_gets_its_subscribed_records_over_tcp_and_udp() {
    let rig = Rig::new();
    let mut topside = SevenKClient::connect(rig.sevenk.local_addr()).expect("listening");
    let listener = std::net::TcpListener::bind("127.0.0.1:0").expect("a port");
    let socket = std::net::UdpSocket::bind("127.0.0.1:0").expect("a port");
    socket.set_read_timeout(Some(PATIENCE)).expect("a timeout");
    let party = |port, transport| ThirdParty {
        ipv4: u32::from_le_bytes([127, 0, 0, 1]),
        port,
        transport,
    };
    let tcp = party(
        listener.local_addr().expect("bound").port(),
        WireTransport::Tcp,
    );
    let udp = party(
        socket.local_addr().expect("bound").port(),
        WireTransport::Udp,
    );
    for party in [tcp, udp] {
        topside
            .command(Command::ConnectThirdParty {
                party,
                record_type_ids: vec![7000],
            })
            .expect("acknowledged");
    }
    let (mut stream, _) = listener.accept().expect("dialled");
    stream.set_read_timeout(Some(PATIENCE)).expect("a timeout");
    let dialled = |transport| {
        let report = rig.sevenk.report();
        let mut clients = report.clients.iter();
        clients.any(|c| c.transport == transport && !c.subscribed.is_empty())
    };
    eventually("both seated", || {
        dialled(Transport::Tcp) && dialled(Transport::Udp)
    });
    let mut emitter = echotank_emit::sevenk::SevenKEmitter::new(sheet(), 1);
    let mut records = Vec::new();
    let wanted = echotank_emit::sevenk::RecordSet::of(&[7000, 7503]);
    emitter.emit_ping(&plan(8, 6), &output(6), wanted, &mut records);
    rig.sevenk.deliver(&records);
    let want = packet(&records[0].bytes).len();
    let mut bytes = vec![0; want];
    stream.read_exact(&mut bytes).expect("7000");
    assert_eq!(&bytes[36..], records[0].bytes);
    let mut datagram = [0; 2048];
    let len = socket.recv(&mut datagram).expect("7000");
    assert_eq!(&datagram[36..len], records[0].bytes);
    topside
        .command(Command::DisconnectThirdParty { party: tcp })
        .expect("acknowledged");
    assert_eq!(stream.read(&mut bytes).expect("closed"), 0);
    eventually("one seat is free", || !dialled(Transport::Tcp));
    assert!(dialled(Transport::Udp), "the other stays");
}

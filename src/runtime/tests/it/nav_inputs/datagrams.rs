//! Broadcast and multicast datagrams; serial lines with unusual rates.

use std::net::{Ipv4Addr, SocketAddr};

use echotank_config::spec::{NavChannel, NavInputSpec, ParitySpec, SerialLine, TimePolicy};
use echotank_core::time::UtcNs;
use echotank_nav::NavHistory;
use echotank_runtime::io::nav::NavInputs;
use serialport::SerialPort;
use socket2::{Domain, Protocol, Socket, Type};

use super::{eventually, nav_spec, opened, pseudo_terminal, source};

const HDT: &[u8] = b"$HEHDT,218.53,T*12\r\n";

fn gyros(inputs: Vec<NavInputSpec>) -> (NavInputs, NavHistory) {
    let gyro = |(i, input)| {
        let mut gyro = source(&format!("gyro{i}"), input);
        gyro.provides = vec![NavChannel::Heading];
        gyro.time = TimePolicy::Arrival { latency_s: 0.0 };
        gyro
    };
    opened(&nav_spec(
        inputs.into_iter().enumerate().map(gyro).collect(),
    ))
}

fn samples(inputs: &mut NavInputs, source: usize) -> u64 {
    inputs.counters()[source].decoder.samples
}

fn wait(inputs: &mut NavInputs, history: &mut NavHistory, what: &str, want: u64) {
    eventually(what, || {
        inputs.pull(UtcNs(i64::MAX), history);
        samples(inputs, 0) >= want
    });
}

fn sender() -> Socket {
    let socket = Socket::new(Domain::IPV4, Type::DGRAM, Some(Protocol::UDP)).expect("a socket");
    let at: SocketAddr = (Ipv4Addr::LOCALHOST, 0).into();
    socket.bind(&at.into()).expect("bound");
    socket
}

fn send(socket: &Socket, bytes: &[u8], to: (Ipv4Addr, u16)) {
    let to: SocketAddr = to.into();
    socket.send_to(bytes, &to.into()).expect("sent");
}

#[test]
fn a_broadcast_reaches_every_source_that_listens_on_its_port() {
    let listen = |port| NavInputSpec::Udp {
        listen: (Ipv4Addr::UNSPECIFIED, port).into(),
        multicast: None,
    };
    let (mut inputs, mut history) = gyros(vec![listen(0)]);
    let port = inputs.listening()[0].1.port();
    // Another program on the same machine.
    let (mut others, mut other_history) = gyros(vec![listen(port)]);
    let socket = sender();
    socket.set_broadcast(true).expect("allowed");
    for _ in 0..3 {
        send(&socket, HDT, (Ipv4Addr::new(127, 255, 255, 255), port));
    }
    wait(&mut inputs, &mut history, "first", 3);
    wait(&mut others, &mut other_history, "second", 3);
}

#[test]
fn no_other_socket_takes_the_datagrams_of_an_address() {
    let (inputs, _) = gyros(vec![NavInputSpec::Udp {
        listen: (Ipv4Addr::LOCALHOST, 0).into(),
        multicast: None,
    }]);
    let taken = inputs.listening()[0].1;
    let other = Socket::new(Domain::IPV4, Type::DGRAM, None).expect("socket");
    other.set_reuse_address(true).expect("option");
    other.set_reuse_port(true).expect("option");
    assert!(other.bind(&taken.into()).is_err());
}

#[test]
fn a_source_receives_its_own_multicast_group_at_its_interface() {
    let [own, foreign] = [1, 2].map(|last| Ipv4Addr::new(239, 192, 0, last));
    let member = |group, port| NavInputSpec::Udp {
        listen: (Ipv4Addr::LOCALHOST, port).into(),
        multicast: Some(group),
    };
    let (mut inputs, mut history) = gyros(vec![member(own, 0)]);
    let port = inputs.listening()[0].1.port();
    let (mut others, mut other_history) = gyros(vec![member(foreign, port)]);
    let socket = sender();
    socket
        .set_multicast_if_v4(&Ipv4Addr::LOCALHOST)
        .expect("an interface");
    // IEC 61162-450 wrapping: two sentences in a datagram.
    let wrapped = [
        b"UdPbC\0\\s:HE0001,n:1*1B\\",
        HDT,
        b"\\s:HE0001,n:2*18\\",
        HDT,
    ]
    .concat();
    for _ in 0..2 {
        send(&socket, &wrapped, (own, port));
        send(&socket, HDT, (foreign, port));
    }
    wait(&mut inputs, &mut history, "own group", 4);
    wait(&mut others, &mut other_history, "foreign group", 2);
    assert_eq!(samples(&mut inputs, 0), 4, "none of the other's");
    assert_eq!(samples(&mut others, 0), 2, "none of the other's");
    // Datagrams sent to this host itself are also received.
    send(&socket, HDT, (Ipv4Addr::LOCALHOST, port));
}

#[test]
fn a_line_of_any_rate_is_opened_at_it() {
    for (baud, line) in [
        (4800, SerialLine::default()),
        // A non-standard rate.
        (250_000, SerialLine::default()),
        (
            38_400,
            SerialLine {
                parity: ParitySpec::Even,
                data_bits: 7,
                stop_bits: 2,
            },
        ),
    ] {
        let (mut instrument, port) = pseudo_terminal();
        let (mut inputs, mut history) = gyros(vec![NavInputSpec::Serial {
            port: port.name().expect("a name"),
            baud,
            line,
        }]);
        // Both ends of a pseudo-terminal have the same rate.
        assert_eq!(
            instrument.baud_rate().expect("known"),
            baud,
            "{}",
            line.name()
        );
        std::io::Write::write_all(&mut instrument, HDT).expect("written");
        wait(&mut inputs, &mut history, &line.name(), 1);
    }
}

/// Sends 64 KiB datagrams of sentences faster than the limit, beside a gyro at its usual rate. The excess is dropped, one turn decodes a limited
/// number of sentences, and the gyro's sentences are still received.
#[test]
fn a_flood_is_dropped_and_an_instrument_beside_it_is_heard() {
    const TURN_BYTES: usize = 256 * 1024;
    const DATAGRAM_BYTES: usize = 64_000;
    let (mut inputs, mut history) = gyros(vec![NavInputSpec::Udp {
        listen: (Ipv4Addr::LOCALHOST, 0).into(),
        multicast: None,
    }]);
    let port = inputs.listening()[0].1.port();
    let socket = sender();
    // A kind of sentence that is counted and not used.
    let flood = b"$GPXTE,A,A,0.67,L,N*6F\r\n".repeat(DATAGRAM_BYTES / 24);
    let (mut sent, mut most) = (0, 0);
    eventually("the flood is dropped and the gyro is heard", || {
        for _ in 0..20 {
            // A full socket loses the datagram.
            let to: SocketAddr = (Ipv4Addr::LOCALHOST, port).into();
            let _ = socket.send_to(&flood, &to.into());
        }
        send(&socket, HDT, (Ipv4Addr::LOCALHOST, port));
        sent += 1;
        let before = inputs.counters()[0].decoder.sentences;
        inputs.pull(UtcNs(i64::MAX), &mut history);
        most = most.max(inputs.counters()[0].decoder.sentences - before);
        let counters = &inputs.counters()[0];
        counters.live.dropped_flood > 100 && counters.decoder.samples > 10
    });
    let limit = (TURN_BYTES + DATAGRAM_BYTES) / 24;
    assert!(most <= limit as u64, "{most} sentences in one turn");
    println!("{sent} turns, at most {most} sentences in one");
}

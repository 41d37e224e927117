//! Records received by a UDP client with a default socket buffer at 41 MB/s, if sent at once and if spread over the ping period. Also the duration of
//! a ping over TCP.

use std::io::{Read, Write};
use std::net::{TcpStream, UdpSocket};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use echotank_emit::sevenk::RecordSet;
use echotank_protocols::sevenk::Command;

use super::load::{SAMPLES, frames, start};
use echotank_testing::wire::*;

const PINGS: u32 = 6;
/// Ping period: 2 MB per record give 41 MB/s.
const PERIOD: Duration = Duration::from_millis(50);
const PATIENCE: Duration = Duration::from_secs(60);
const MAX_PACKET: usize = 8000;
/// Processing time of the receiver per datagram: at most 130 MB/s.
const WORK: Duration = Duration::from_micros(60);

/// Number of datagrams sent and received, with each ping spread over `over_s`.
fn sent_and_received(over_s: f64) -> (u64, u64) {
    let (server, mut emitter) = start(|spec| spec.max_packet = MAX_PACKET);
    let socket = UdpSocket::bind("127.0.0.1:0").expect("a port");
    socket.connect(server.local_addr()).expect("loopback");
    let subscribe = Command::Subscribe {
        record_type_ids: vec![7038],
    };
    socket.send(&command(subscribe, 1)).expect("sent");
    let patience = Instant::now() + PATIENCE;
    while server.wanted().is_empty() {
        assert!(Instant::now() < patience, "subscribed");
        std::thread::sleep(Duration::from_millis(2));
    }
    // The timeout lets the receiver detect the end.
    let end = Some(Duration::from_millis(20));
    socket.set_read_timeout(end).expect("set");
    let is_over = Arc::new(AtomicBool::new(false));
    let over = Arc::clone(&is_over);
    let receiver = std::thread::spawn(move || {
        let mut buffer = vec![0; 65_536];
        let mut received = 0_u64;
        loop {
            let was_over = over.load(Ordering::Acquire);
            while let Ok(len) = socket.recv(&mut buffer) {
                // The reply to the subscription is shorter.
                received += u64::from(len > 500);
                let until = Instant::now() + WORK;
                while Instant::now() < until {
                    std::hint::spin_loop();
                }
            }
            if was_over {
                return received;
            }
        }
    });
    let output = frames();
    let wanted = RecordSet::from(server.wanted());
    let mut records = Vec::new();
    emitter.emit_ping(&plan(1, SAMPLES), &output, wanted, &mut records);
    // Each datagram has a frame before its part.
    let part = MAX_PACKET - 36;
    let datagrams = records.iter().map(|r| r.bytes.len().div_ceil(part) as u64);
    let sent = datagrams.sum::<u64>() * u64::from(PINGS);
    let began = Instant::now();
    for ping in 1..=PINGS {
        std::thread::sleep((began + PERIOD * ping).saturating_duration_since(Instant::now()));
        server.deliver_over(&records, over_s);
    }
    let patience = Instant::now() + PATIENCE;
    while server.report().clients.iter().any(|c| c.queued_bytes > 0) {
        assert!(Instant::now() < patience, "all sent");
        std::thread::sleep(Duration::from_millis(2));
    }
    is_over.store(true, Ordering::Release);
    (sent, receiver.join().expect("no panic"))
}

#[test]
fn a_slow_udp_receiver_loses_most_of_a_burst_and_keeps_what_is_spread_over_most_of_the_interval() {
    let (sent, of_burst) = sent_and_received(0.0);
    let (also_sent, of_spread) = sent_and_received(0.8 * PERIOD.as_secs_f64());
    let (lost, lost_of_spread) = (sent - of_burst, also_sent - of_spread);
    println!("of {sent} datagrams lost: {lost} sent at once, {lost_of_spread} spread");
    assert_eq!(sent, also_sent);
    assert!(3 * lost > sent, "{lost} of {sent}: no burst");
    // A machine that delays the receiver for milliseconds still loses some datagrams.
    assert!(4 * lost_of_spread < lost, "{lost_of_spread} against {lost}");
}

/// Time from the first byte of a ping over TCP to the last, s, if the ping is spread over `over_s`.
fn lasts_over_tcp_s(over_s: f64) -> f64 {
    let (server, mut emitter) = start(|_| {});
    server.set_paces_tcp(true);
    let mut socket = TcpStream::connect(server.local_addr()).expect("loopback");
    socket.set_read_timeout(Some(PATIENCE)).expect("set");
    let subscribe = Command::Subscribe {
        record_type_ids: vec![7038],
    };
    socket.write_all(&command(subscribe, 1)).expect("sent");
    let mut buffer = vec![0; 65_536];
    let answer = socket.read(&mut buffer).expect("an answer");
    assert!(answer > 0);
    let wanted = RecordSet::from(server.wanted());
    let mut records = Vec::new();
    emitter.emit_ping(&plan(1, SAMPLES), &frames(), wanted, &mut records);
    let mut left: usize = records.iter().map(|r| r.bytes.len()).sum();
    assert!(left > 1_000_000, "{left} bytes");
    server.deliver_over(&records, over_s);
    let mut began = None;
    while left > 0 {
        let len = socket.read(&mut buffer).expect("more");
        began.get_or_insert_with(Instant::now);
        left = left.saturating_sub(len);
    }
    began.map_or(0.0, |began| began.elapsed().as_secs_f64())
}

#[test]
#[cfg(target_os = "linux")]
fn over_tcp_too_a_ping_lasts_as_long_as_it_is_spread() {
    let (spread_s, at_once_s) = (lasts_over_tcp_s(0.2), lasts_over_tcp_s(0.0));
    println!("over TCP {spread_s:.3} s spread over 0.2 s, {at_once_s:.3} s at once");
    // The kernel allows a small burst; the rate is never exceeded.
    assert!(spread_s > 0.14, "{spread_s} s");
}

//! Tests of the daemon with the Rust client of Blue Robotics for the Ping protocol (crate `bluerobotics-ping`). Its requests take
//! effect in the next pings.
//!
//! The crate implements commands, framing and checksums. It interprets the results of an Omniscan profile as text, because its
//! definitions have no width for them. It also lacks the messages of the Surveyor. The test decodes and encodes these payloads.

use std::future::Future;
use std::io;
use std::net::SocketAddr;
use std::ops::Range;
use std::pin::Pin;
use std::task::{Context, Poll, ready};

use bluerobotics_ping::device::PingDevice;
use bluerobotics_ping::message::ProtocolMessage;
use bluerobotics_ping::omniscan450;
use tokio::io::{AsyncRead, AsyncWrite, ReadBuf};
use tokio::net::{TcpStream, UdpSocket};
use tokio::sync::broadcast::Receiver;

use super::{Daemon, PATIENCE};

const ACK: u16 = 1;
const NACK: u16 = 2;
const PROFILE: u16 = 2198;
const POINTS: u16 = 3012;
const ATTITUDE: u16 = 504;

/// Adapter from datagrams to the stream that the client requires. It keeps the rest of a datagram for the next read.
struct Datagrams {
    socket: UdpSocket,
    datagram: Box<[u8]>,
    /// Unread part of the current datagram.
    left: Range<usize>,
}

impl AsyncRead for Datagrams {
    fn poll_read(
        self: Pin<&mut Self>,
        cx: &mut Context<'_>,
        into: &mut ReadBuf<'_>,
    ) -> Poll<io::Result<()>> {
        let this = self.get_mut();
        if this.left.is_empty() {
            let mut whole = ReadBuf::new(&mut this.datagram);
            ready!(this.socket.poll_recv(cx, &mut whole))?;
            this.left = 0..whole.filled().len();
        }
        let end = this.left.end.min(this.left.start + into.remaining());
        into.put_slice(&this.datagram[this.left.start..end]);
        this.left.start = end;
        Poll::Ready(Ok(()))
    }
}

impl AsyncWrite for Datagrams {
    fn poll_write(
        self: Pin<&mut Self>,
        cx: &mut Context<'_>,
        bytes: &[u8],
    ) -> Poll<io::Result<usize>> {
        self.socket.poll_send(cx, bytes)
    }
    fn poll_flush(self: Pin<&mut Self>, _: &mut Context<'_>) -> Poll<io::Result<()>> {
        Poll::Ready(Ok(()))
    }
    fn poll_shutdown(self: Pin<&mut Self>, _: &mut Context<'_>) -> Poll<io::Result<()>> {
        Poll::Ready(Ok(()))
    }
}

/// Runs a future within a time limit. The threads of the client are leaked, because a thread with a closed connection never ends.
fn run(future: impl Future<Output = ()>) {
    let runtime = tokio::runtime::Builder::new_multi_thread()
        .worker_threads(2)
        .enable_all()
        .build()
        .expect("threads");
    let done = runtime.block_on(async { tokio::time::timeout(2 * PATIENCE, future).await });
    runtime.shutdown_background();
    done.expect("in time");
}

async fn datagrams(to: SocketAddr) -> Datagrams {
    let socket = UdpSocket::bind("127.0.0.1:0").await.expect("a socket");
    socket.connect(to).await.expect("an address");
    Datagrams {
        socket,
        datagram: vec![0; 65_536].into(),
        left: 0..0,
    }
}

/// The payload of the next message of a type that satisfies a condition.
async fn next(
    heard: &mut Receiver<ProtocolMessage>,
    id: u16,
    wanted: impl Fn(&[u8]) -> bool,
) -> Vec<u8> {
    loop {
        let soon = tokio::time::timeout(PATIENCE, heard.recv()).await;
        let message = soon.unwrap_or_else(|_| panic!("no {id} in time"));
        let message = message.expect("connected");
        assert!(message.has_valid_crc());
        if message.message_id == id && wanted(&message.payload) {
            return message.payload;
        }
    }
}

fn u16_at(bytes: &[u8], at: usize) -> u16 {
    u16::from_le_bytes([bytes[at], bytes[at + 1]])
}

fn u32_at(bytes: &[u8], at: usize) -> u32 {
    u32::from_le_bytes([bytes[at], bytes[at + 1], bytes[at + 2], bytes[at + 3]])
}

fn f32_at(bytes: &[u8], at: usize) -> f32 {
    f32::from_bits(u32_at(bytes, at))
}

async fn omniscan(device: &omniscan450::Device) {
    let information = device.device_information().await.expect("answers");
    assert_eq!(information.device_revision, 1);
    device.protocol_version().await.expect("answers");
    let ask = |length_m: u32, msec: u32, gain: i16, results: u16| {
        let pulse = 0.02;
        device.os_ping_params(
            0,
            length_m * 1000,
            msec,
            0.0,
            0.0,
            pulse,
            0.0015,
            gain,
            results,
            1,
            0,
            0,
            0,
        )
    };
    for (length_m, msec, gain, results) in
        [(30, 250, 7, 1200), (60, 500, 0, 600), (20, 200, 3, 200)]
    {
        let mut heard = device.subscribe();
        ask(length_m, msec, gain, results).await.expect("sent");
        next(&mut heard, ACK, |p| u16_at(p, 0) == 2197).await;
        let obeyed = |p: &[u8]| {
            (u32_at(p, 8), u16_at(p, 20), u16_at(p, 22)) == (length_m * 1000, gain as u16, results)
        };
        let mut before = next(&mut heard, PROFILE, obeyed).await;
        for _ in 0..3 {
            let profile = next(&mut heard, PROFILE, |_| true).await;
            assert_eq!(profile.len(), 52 + 2 * usize::from(results));
            // A loaded machine skips pings, which keep their numbers.
            let pings = u32_at(&profile, 0) - u32_at(&before, 0);
            let step_ms = u32_at(&profile, 12) - u32_at(&before, 12);
            assert!(
                pings > 0 && step_ms.abs_diff(pings * msec) <= 1,
                "{step_ms} ms in {pings} pings, asked {msec}"
            );
            before = profile;
        }
        // No echo from the water, then a strong bottom echo 11.4 m below the sonar head.
        let (most, least) = (f32_at(&before, 36), f32_at(&before, 40));
        let db = |at_m: f32| {
            let index = (at_m / length_m as f32 * f32::from(results)) as usize;
            let count = u16_at(&before, 52 + 2 * index);
            least + f32::from(count) / 65_535.0 * (most - least)
        };
        let mean = |from_m: f32, to_m: f32| {
            let db: Vec<f32> = (0..50)
                .map(|k| db(from_m + (to_m - from_m) * k as f32 / 50.0))
                .collect();
            db.iter().sum::<f32>() / 50.0
        };
        let (water, sand) = (mean(4.0, 9.0), mean(14.0, 19.5));
        assert!(
            sand - water > 6.0,
            "{water} dB in the water, {sand} on the sand"
        );
    }
    // Values beyond the limits are refused with a reason and without effect.
    let mut heard = device.subscribe();
    ask(81, 100, 1, 600).await.expect("sent");
    let refused = next(&mut heard, NACK, |p| u16_at(p, 0) == 2197).await;
    let words = String::from_utf8_lossy(&refused[2..]).into_owned();
    assert!(words.contains("range_m = 81"), "{words}");
    next(&mut heard, PROFILE, |p| u32_at(p, 8) == 20_000).await;
    // The definitions of the crate number this command differently from brping.
    let mut heard = device.subscribe();
    device.set_speed_of_sound(1_480_000).await.expect("sent");
    next(&mut heard, ACK, |p| u16_at(p, 0) == 1002).await;
}

#[test]
fn an_omniscan_serves_the_manufacturers_rust_client_over_tcp_and_udp() {
    let mut daemon = Daemon::start(
        "tests/data/rigs/omniscan450.toml",
        [
            "sonar.0.output.ping.listen=127.0.0.1:0",
            "sonar.1.output.ping.listen=127.0.0.1:0",
            "scene.seabed.density_per_m2=3.0",
        ],
    );
    let at = daemon.announced("ping port", "tcp");
    run(async {
        let stream = TcpStream::connect(at).await.expect("listening");
        omniscan(&omniscan450::Device::new(stream)).await;
        omniscan(&omniscan450::Device::new(datagrams(at).await)).await;
    });
    daemon.terminate();
}

/// Message 3023. The crate lacks the messages of the Surveyor, so the test encodes the payload. Frame and checksum are the
/// client's.
fn ping_parameters(end_m: i32, msec: i16) -> ProtocolMessage {
    let mut payload = Vec::new();
    payload.extend(0_i32.to_le_bytes());
    payload.extend((end_m * 1000).to_le_bytes());
    payload.extend(1480.0_f32.to_le_bytes());
    payload.extend(20_i16.to_le_bytes());
    payload.extend(msec.to_le_bytes());
    // No test data; pinging on; no channel data, raw data or points in metres; angles and times on.
    payload.extend([0, 0, 0, 1, 0, 0, 0, 1]);
    payload.extend(240_000_i32.to_le_bytes());
    payload.extend(400_u16.to_le_bytes());
    payload.extend([0, 0]);
    payload.extend(5.0_f32.to_le_bytes());
    let mut message = ProtocolMessage::new();
    message.message_id = 3023;
    message.payload_length = payload.len() as u16;
    message.payload = payload;
    message.update_checksum();
    message
}

/// Checks the Surveyor. The client object is that of the Omniscan, because the crate has none for the Surveyor.
async fn surveyor(device: &omniscan450::Device) {
    device.device_information().await.expect("answers");
    let ask = |end_m, msec| {
        device
            .get_common()
            .send_message(ping_parameters(end_m, msec))
    };
    for (end_m, msec) in [(25, 250), (30, 400)] {
        let mut heard = device.subscribe();
        ask(end_m, msec).await.expect("sent");
        next(&mut heard, ACK, |p| u16_at(p, 0) == 3023).await;
        // The receive window includes the pulse.
        let listens_s = 2.0 * end_m as f32 / 1480.0;
        let obeyed = |p: &[u8]| (f32_at(p, 12) - f32_at(p, 28) - listens_s).abs() < 1e-3;
        let mut before = next(&mut heard, POINTS, obeyed).await;
        for _ in 0..3 {
            let points = next(&mut heard, POINTS, |_| true).await;
            let pings = u32_at(&points, 20) - u32_at(&before, 20);
            let step_ms = u32_at(&points, 0) - u32_at(&before, 0);
            assert!(
                pings > 0 && step_ms.abs_diff(pings * msec as u32) <= 1,
                "{step_ms} ms in {pings} pings, asked {msec}"
            );
            let count = usize::from(u16_at(&points, 36));
            assert!(count > 20, "{count} points");
            let mut depths: Vec<f32> = (0..count)
                .map(|n| (f32_at(&points, 40 + 16 * n), f32_at(&points, 44 + 16 * n)))
                .map(|(angle, time)| 740.0 * time * angle.cos())
                .collect();
            depths.sort_by(f32::total_cmp);
            let median = depths[count / 2];
            // 12 m minus 0.8 m of the sonar head. Heave and roll of the launch move single points.
            assert!((median - 11.2).abs() < 0.5, "{median} m");
            before = points;
        }
    }
    let mut heard = device.subscribe();
    let attitude = next(&mut heard, ATTITUDE, |_| true).await;
    assert!(f32_at(&attitude, 8) > 0.9, "up is up");
    let mut heard = device.subscribe();
    ask(61, 100).await.expect("sent");
    next(&mut heard, NACK, |p| u16_at(p, 0) == 3023).await;
}

#[test]
fn a_surveyor_serves_the_manufacturers_rust_client_over_tcp_and_udp() {
    let mut daemon = Daemon::start(
        "tests/data/rigs/surveyor240.toml",
        [
            "sonar.output.ping.listen=127.0.0.1:0",
            "scene.seabed.density_per_m2=1.0",
        ],
    );
    let at = daemon.announced("ping surveyor", "tcp");
    run(async {
        let stream = TcpStream::connect(at).await.expect("listening");
        surveyor(&omniscan450::Device::new(stream)).await;
        surveyor(&omniscan450::Device::new(datagrams(at).await)).await;
    });
    daemon.terminate();
}

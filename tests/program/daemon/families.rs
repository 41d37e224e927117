//! Tests of several protocols together. They send the same pings, and each reports setting changes by
//! another protocol.

use std::io::{BufRead, BufReader, Read, Write};
use std::net::{TcpStream, UdpSocket};
use std::time::{Duration, Instant};

use echotank_protocols::ping_protocol::surveyor240::SetPingParameters;
use echotank_protocols::ping_protocol::{Frame, Message, PingFraming, PingStream};
use echotank_protocols::vita49::{Context, Packet, PacketType};
use echotank_protocols::wbms::{self, Bathymetry, WbmsFraming, WbmsStream};

use echotank_runtime::io::control::client;

use super::{Daemon, PATIENCE};
use crate::files_in;

/// Two-way travel time of a range in the water of the rig, seconds.
fn twtt_s(range_m: f64) -> f64 {
    2.0 * range_m / 1480.0
}

/// Reads frames until one matches.
fn next<T>(
    stream: &mut TcpStream,
    frames: &mut PingStream,
    mut pick: impl FnMut(&Message<'_>) -> Option<T>,
) -> T {
    let until = Instant::now() + PATIENCE;
    let mut buffer = [0; 65_536];
    while Instant::now() < until {
        let len = stream.read(&mut buffer).expect("connected");
        assert!(len > 0, "the daemon hung up");
        let mut found = None;
        frames.feed(&buffer[..len], |item| {
            let frame = Frame::parse(item.expect("whole frames")).expect("right frames");
            let message = Message::parse(&frame).expect("right messages");
            found = found.take().or_else(|| pick(&message));
        });
        if let Some(found) = found {
            return found;
        }
    }
    panic!("it never came");
}

fn line(control: &mut BufReader<TcpStream>) -> String {
    let mut line = String::new();
    control.read_line(&mut line).expect("connected");
    line
}

#[test]
fn ping_wbms_and_vita_report_the_same_pings_and_settings() {
    let board = UdpSocket::bind("127.0.0.1:0").expect("a socket");
    board
        .set_read_timeout(Some(PATIENCE))
        .expect("a time to wait");
    let send_to = format!(
        "sonar.output.vita49.send_to=\"{}\"",
        board.local_addr().expect("address")
    );
    let record = tempfile::tempdir().expect("folder");
    let mut daemon = Daemon::start(
        "tests/data/rigs/surveyor240.toml",
        [
            "sonar.output.ping.listen=127.0.0.1:0",
            "sonar.output.wbms.listen=\"127.0.0.1:0\"",
            &send_to,
            "sonar.output.sigmf={}",
            "control.listen=127.0.0.1:0",
            "scene.seabed.density_per_m2=2.0",
            &format!("record.directory={:?}", record.path()),
        ],
    );
    let ping = daemon.announced("ping surveyor", "tcp");
    let control = daemon.announced("wbms surveyor control", "tcp");
    let bathymetry = daemon.announced("wbms surveyor bathymetry", "tcp");
    let http = daemon.announced("control http", "http");

    // Ping protocol: requests, replies and the following pings.
    let mut topside = TcpStream::connect(ping).expect("listening");
    topside.set_read_timeout(Some(PATIENCE)).expect("set");
    let mut frames = PingStream::new(PingFraming);
    let mut wanted = SetPingParameters {
        start_mm: 0,
        end_mm: 25_000,
        sos_mps: 1480.0,
        gain_index: -1,
        msec_per_ping: 250,
        diagnostic_injected_signal: 0,
        ping_enable: 1,
        enable_channel_data: 0,
        reserved_for_raw_data: 0,
        enable_yz_point_data: 0,
        enable_atof_data: 1,
        target_ping_hz: 240_000,
        n_range_steps: 400,
        pulse_len_steps: 5.0,
    };
    let mut bytes = Vec::new();
    wanted.emit_frame(&mut bytes, 0, 1);
    topside.write_all(&bytes).expect("connected");
    next(&mut topside, &mut frames, |message| {
        matches!(message, Message::Ack(ack) if ack.acked_id == 3023).then_some(())
    });
    let listens_for = |range_m: f64| {
        move |message: &Message<'_>| match message {
            Message::AtofPointData(data) => {
                let listens_s = f64::from(data.head.listening_s) - f64::from(data.head.pulse_s);
                let is_so = (listens_s - twtt_s(range_m)).abs() < 1e-3;
                is_so.then_some((data.head.ping_number, data.points().count()))
            }
            _ => None,
        }
    };
    let (_, points) = next(&mut topside, &mut frames, listens_for(25.0));
    assert!(points > 10, "{points} points of 80 beams");
    // The range exceeds the limit of the sonar: it is refused, and the range stays.
    wanted.end_mm = 61_000;
    bytes.clear();
    wanted.emit_frame(&mut bytes, 0, 1);
    topside.write_all(&bytes).expect("connected");
    let refused = next(&mut topside, &mut frames, |message| match message {
        Message::Nack { refused_id, text } => Some((*refused_id, text.clone())),
        _ => None,
    });
    assert_eq!(refused.0, 3023);
    assert!(refused.1.contains("range_m = 61"), "{}", refused.1);

    // WBMS reports the setting of the other client. The other client then reports the setting of WBMS.
    let text = TcpStream::connect(control).expect("listening");
    text.set_read_timeout(Some(PATIENCE)).expect("set");
    let mut text = BufReader::new(text);
    assert!(line(&mut text).contains("ready"));
    text.get_mut()
        .write_all(b"set_range\r\nset_range 0 20")
        .expect("connected");
    assert_eq!(line(&mut text).trim(), "set_range 0 25");
    assert_eq!(line(&mut text).trim(), "set_range 0 20");
    next(&mut topside, &mut frames, listens_for(20.0));

    // Both protocols report the same ping, and the VITA 49 receiver gets its samples.
    let mut depths = TcpStream::connect(bathymetry).expect("listening");
    depths.set_read_timeout(Some(PATIENCE)).expect("set");
    let mut packets = WbmsStream::new(WbmsFraming);
    let mut buffer = [0; 65_536];
    let mut seen = None;
    while seen.is_none() {
        let len = depths.read(&mut buffer).expect("connected");
        assert!(len > 0, "the daemon hung up");
        packets.feed(&buffer[..len], |item| {
            let packet = wbms::Packet::parse(item.expect("whole")).expect("right");
            let bathymetry = Bathymetry::parse(&packet).expect("type 1");
            let angles: Vec<f32> = bathymetry.detections().map(|d| d.angle_rad).collect();
            seen = Some((bathymetry.head.ping_number, angles));
        });
    }
    let (number, angles) = seen.expect("a ping");
    let points = next(&mut topside, &mut frames, |message| match message {
        Message::AtofPointData(data) if data.head.ping_number == number => {
            Some(data.points().map(|p| -p.angle_rad).collect::<Vec<f32>>())
        }
        Message::AtofPointData(data) if data.head.ping_number > number => Some(Vec::new()),
        _ => None,
    });
    // The ping that was read first may have left the other socket already. Otherwise both pings are equal.
    assert!(
        points.is_empty() || points == angles,
        "{points:?}, {angles:?}"
    );
    let mut datagram = [0; 2048];
    let deadline = Instant::now() + Duration::from_secs(30);
    let said = loop {
        assert!(Instant::now() < deadline, "no context");
        let len = board.recv(&mut datagram).expect("a packet");
        let packet = Packet::parse(&datagram[..len]).expect("right");
        if packet.packet_type == PacketType::Context {
            break Context::parse(packet.payload).expect("a context");
        }
    };
    assert_eq!(
        (said.sample_rate_hz, said.rf_reference_hz),
        (Some(34e3), Some(240e3))
    );

    // Client counts include the VITA 49 receiver, which sends no request.
    let (_, metrics) = client::get(http, "/metrics", None).expect("answers");
    let to = board.local_addr().expect("address");
    for (family, peer) in [
        ("vita49", format!("UDP {to}")),
        (
            "ping",
            format!("TCP {}", topside.local_addr().expect("bound")),
        ),
    ] {
        let label = format!("{{sonar=\"surveyor\",family=\"{family}\",peer=\"{peer}\"}} ");
        for (name, least) in [("bytes_sent", 1000), ("records_sent", 3)] {
            let start = format!("echotank_client_{name}{label}");
            let value = metrics.lines().find_map(|line| line.strip_prefix(&start));
            let value: u64 = value.and_then(|v| v.parse().ok()).expect(&start);
            assert!(value >= least, "{start}{value}");
        }
    }
    let (_, status) = client::get(http, "/status", None).expect("answers");
    assert!(status.contains(&format!("UDP {to}: ")), "{status}");

    let printed = daemon.terminate();
    assert!(printed.contains("vita49 surveyor:"), "{printed}");
    let mut files: Vec<_> = files_in(record.path()).collect();
    // Their names may differ by a second.
    files.sort_by_key(|file| file.extension().map(ToOwned::to_owned));
    let ends: Vec<_> = files.iter().filter_map(|f| f.extension()).collect();
    assert_eq!(ends, ["sigmf-data", "sigmf-meta", "svlog"], "{files:?}");
    let log = std::fs::read(&files[2]).expect("log");
    let mut profiles = 0;
    let mut stream = PingStream::new(PingFraming);
    stream.feed(&log, |item| {
        let frame = Frame::parse(item.expect("whole")).expect("right");
        profiles += u32::from(frame.message_id == 3012);
    });
    assert!(profiles > 2, "{profiles} pings in the log");
}

/// Client on a serial link whose other end is in the test.
#[cfg(target_os = "linux")]
#[test]
fn a_client_on_a_serial_line_is_answered_and_gets_every_ping() {
    use serialport::SerialPort;
    let (mut ours, theirs) = serialport::TTYPort::pair().expect("a pseudo-terminal");
    ours.set_timeout(PATIENCE).expect("set");
    let name = theirs.name().expect("a name");
    let mut daemon = Daemon::start(
        "tests/data/rigs/surveyor240.toml",
        [
            "sonar.output.ping.listen=127.0.0.1:0",
            &format!("sonar.output.ping.serial_port={name:?}"),
            "scene.seabed.density_per_m2=2.0",
        ],
    );
    daemon.announced("ping surveyor", "tcp");
    let mut bytes = Vec::new();
    echotank_protocols::ping_protocol::common::GeneralRequest { requested_id: 4 }
        .emit_frame(&mut bytes, 0, 1);
    let mut frames = PingStream::new(PingFraming);
    let (mut answered, mut pings) = (false, 0);
    let mut buffer = [0; 4096];
    let until = Instant::now() + PATIENCE;
    ours.write_all(&bytes).expect("the line is there");
    while (!answered || pings < 3) && Instant::now() < until {
        let len = ours.read(&mut buffer).expect("the line is there");
        frames.feed(&buffer[..len], |item| {
            // Reception may have begun in the middle of a frame.
            if let Ok(frame) = item.and_then(Frame::parse) {
                answered |= frame.message_id == 4;
                pings += u32::from(frame.message_id == 3012);
            }
        });
    }
    assert!(
        answered && pings >= 3,
        "answered: {answered}, {pings} pings"
    );
    drop(theirs);
    daemon.terminate();
}

//! Tests that samples streamed during the ping equal those sent at its end, bit for bit.

use std::collections::BTreeMap;
use std::net::UdpSocket;
use std::time::{Duration, Instant};

use echotank_protocols::elements::Frame;
use echotank_protocols::vita49::{Packet, PacketType};
use echotank_runtime::io::sonar::elements::ElementClient;

use super::{Daemon, PATIENCE};
use crate::file_of;

const RANGE_M: f64 = 150.0;
/// Listening window of a ping, seconds: 2 x 150 m at 1500 m/s, plus the pulse.
const WINDOW_S: f64 = 0.2;
const PINGS: usize = 6;
/// Number of elements of all arrays.
const ELEMENTS: usize = 32;
/// Number of elements of the first array.
const PORT: usize = 8;

/// Samples of whole pings, by ping number.
type Pings = BTreeMap<u32, Vec<u8>>;

/// Frames of a ping until it is complete.
#[derive(Default)]
struct Part {
    sample_times: u32,
    samples: Vec<u8>,
}

impl Part {
    /// Adds a frame. Returns the samples of the whole ping with its last frame.
    fn push(&mut self, frame: &Frame<'_>) -> Option<Vec<u8>> {
        if frame.head.first_sample == 0 {
            *self = Self::default();
        }
        if self.sample_times == frame.head.first_sample {
            self.sample_times += frame.sample_times;
            self.samples.extend_from_slice(frame.samples);
        }
        let is_whole = self.sample_times == frame.head.ping_samples;
        is_whole.then(|| std::mem::take(&mut self.samples))
    }
}

struct Heard {
    pings: Pings,
    /// Time from each pulse to its first frame, seconds.
    first_sample_s: Vec<f64>,
    /// Payloads of the packets between context packets.
    vita: Vec<Vec<u8>>,
}

impl Heard {
    /// Number of pings whose packets have the same samples as the frames of a ping. The last ping may be
    /// incomplete.
    fn vita_pings_among_the_others(&self) -> usize {
        // Elements of the first array, sample by sample, in big endian.
        let port = |frames: &[u8]| -> Vec<u8> {
            let sample_times = frames.chunks_exact(4 * ELEMENTS);
            let values = sample_times.flat_map(|k| k[..4 * PORT].chunks_exact(2));
            values.flat_map(|v| [v[1], v[0]]).collect()
        };
        let pings: Vec<_> = self.pings.values().map(|frames| port(frames)).collect();
        let same = self.vita.iter().filter(|samples| pings.contains(samples));
        same.count()
    }
}

fn listen(more: &[&str]) -> Heard {
    let board = UdpSocket::bind("127.0.0.1:0").expect("a socket");
    board.set_nonblocking(true).expect("set");
    let send_to = format!(
        "sonar.output.vita49.send_to=\"{}\"",
        board.local_addr().expect("bound")
    );
    let range = format!("sonar.ping.range_m={RANGE_M}");
    let common = [
        "sonar.output.sevenk.listen=127.0.0.1:0",
        "sonar.output.elements.listen=127.0.0.1:0",
        send_to.as_str(),
        range.as_str(),
        "sonar.ping.rate_hz=2",
        "sonar.model.synthesis=direct",
        "nav.mode=predict",
        "nav.on_lost=hold",
        "nav.stamp=host",
        "run.ahead_ms=400",
        "sonar.output.vita49.arrays=[\"port\"]",
        // There is one packet per block, so a socket buffer holds many blocks.
        "sonar.output.vita49.streams=vector",
        "run.queue_pings=8",
        "nav.loop=true",
    ];
    let mut daemon = Daemon::start("hil-configs/points.toml", [&common, more].concat());
    let address = daemon.announced("elements", "tcp");
    let mut client = ElementClient::connect(address).expect("listening");
    let mut heard = Heard {
        pings: Pings::new(),
        first_sample_s: Vec::new(),
        vita: Vec::new(),
    };
    let mut part = Part::default();
    let mut packet = vec![0; 65_536];
    let until = Instant::now() + PATIENCE;
    while heard.pings.len() < PINGS {
        assert!(Instant::now() < until, "{} pings", heard.pings.len());
        let open = client.read(Duration::from_millis(5), |frame, now| {
            let head = &frame.head;
            if head.first_sample == 0 {
                heard
                    .first_sample_s
                    .push((now.0 - head.pulse_utc_ns) as f64 / 1e9);
            }
            if let Some(samples) = part.push(frame) {
                heard.pings.insert(head.ping_number, samples);
            }
        });
        assert!(open.expect("connected"), "the daemon goes on");
        while let Ok(len) = board.recv(&mut packet) {
            let read = Packet::parse(&packet[..len]).expect("a packet");
            match read.packet_type {
                // A context packet begins a new ping.
                PacketType::Context => heard.vita.push(Vec::new()),
                PacketType::SignalData => {
                    if let Some(samples) = heard.vita.last_mut() {
                        samples.extend_from_slice(read.payload);
                    }
                }
            }
        }
    }
    daemon.terminate();
    heard
}

#[test]
fn streamed_samples_equal_those_sent_at_the_end_and_are_sent_during_reception() {
    let (streamed, whole) = std::thread::scope(|scope| {
        let streamed = scope.spawn(|| listen(&["run.delivery=streaming"]));
        let whole = scope.spawn(|| listen(&[]));
        (streamed.join().expect("ends"), whole.join().expect("ends"))
    });
    let mut compared = 0;
    for (number, samples) in &streamed.pings {
        let Some(other) = whole.pings.get(number) else {
            continue;
        };
        assert!(samples.len() > 1000 && samples.iter().any(|&b| b != 0));
        assert!(samples == other, "ping {number} differs");
        compared += 1;
    }
    assert!(
        compared >= PINGS / 2,
        "{compared} pings of {:?} and {:?}",
        streamed.pings.keys(),
        whole.pings.keys()
    );
    let of_vita = [&streamed, &whole].map(Heard::vita_pings_among_the_others);
    println!("{compared} pings compared, of VITA 49: {of_vita:?}");
    assert!(of_vita.iter().all(|&same| same >= PINGS / 2), "{of_vita:?}");
    let middle = |latencies: &[f64]| {
        let mut sorted = latencies.to_vec();
        sorted.sort_by(f64::total_cmp);
        sorted[sorted.len() / 2]
    };
    let (of_stream, of_whole) = (
        middle(&streamed.first_sample_s),
        middle(&whole.first_sample_s),
    );
    println!(
        "first sample {of_stream:.4} s after its pulse streaming, {of_whole:.4} s at the ping's end"
    );
    // The delay is at least a block of 1 ms plus 0.5 ms of latency. It always ends before the ping does.
    let least = streamed
        .first_sample_s
        .iter()
        .copied()
        .fold(f64::MAX, f64::min);
    assert!(least >= 1.5e-3, "{least} s");
    assert!(
        of_stream < WINDOW_S && of_whole > WINDOW_S,
        "{of_stream} {of_whole}"
    );
}

/// External pulses are known only on arrival, so the latency covers the computation of the whole ping.
#[test]
fn triggered_pings_stream_with_the_stated_latency_and_equal_the_recording() {
    triggered(0.3, &[]);
}

#[test]
fn pings_computed_tile_by_tile_stream_with_the_stated_latency() {
    // The margin is for a loaded machine and an unoptimised build. Late samples are truncated.
    triggered(2.0, &["run.stream_tiles=true"]);
}

fn triggered(latency_s: f64, more: &[&str]) {
    let folder = tempfile::tempdir().expect("folder");
    let record = format!("record.directory={:?}", folder.path());
    let latency = format!("run.stream_latency_ms={}", latency_s * 1e3);
    let common = [
        record.as_str(),
        latency.as_str(),
        "sonar.output.sevenk.listen=127.0.0.1:0",
        "sonar.output.elements={listen=\"127.0.0.1:0\", arrays=[\"port\"]}",
        "sonar.output.sigmf.arrays=[\"port\"]",
        "sonar.trigger.source=udp",
        "sonar.trigger.listen=127.0.0.1:0",
        "sonar.ping.range_m=50",
        "sonar.model.synthesis=direct",
        "nav.mode=predict",
        "nav.on_lost=hold",
        "nav.stamp=host",
        "nav.loop=true",
        "run.delivery=streaming",
        "run.ahead_ms=0",
    ];
    let mut daemon = Daemon::start("hil-configs/points.toml", [&common, more].concat());
    let address = daemon.announced("elements", "tcp");
    let listener = daemon.announced("trigger points", "udp");
    let mut client = ElementClient::connect(address).expect("listening");
    let trigger = UdpSocket::bind("127.0.0.1:0").expect("a socket");
    let (mut streamed, mut part, mut min_s) = (Vec::new(), Part::default(), f64::MAX);
    let until = Instant::now() + PATIENCE;
    let mut next = Instant::now();
    while streamed.len() < 3 {
        assert!(Instant::now() < until, "{} pings", streamed.len());
        if Instant::now() >= next {
            trigger.send_to(b"ping!", listener).expect("sent");
            next = Instant::now() + Duration::from_millis(600);
        }
        let open = client.read(Duration::from_millis(5), |frame, now| {
            let head = &frame.head;
            let end_s = f64::from(head.first_sample + frame.sample_times) / head.sample_rate_hz;
            let since_s = (now.0 - head.pulse_utc_ns) as f64 / 1e9;
            min_s = min_s.min(since_s - end_s);
            streamed.extend(part.push(frame));
        });
        assert!(open.expect("connected"), "the daemon goes on");
    }
    // A file receives each ping at its end.
    std::thread::sleep(Duration::from_millis(500));
    daemon.terminate();
    let recorded = std::fs::read(file_of(folder.path(), "", ".sigmf-data")).expect("readable");
    for (number, samples) in streamed.iter().enumerate() {
        assert!(samples.iter().any(|&b| b != 0));
        let same = recorded
            .chunks_exact(samples.len())
            .any(|ping| ping == samples.as_slice());
        assert!(same, "ping {number} is not in the recording");
    }
    // No frame arrives before the end of its block plus the latency. Host time may be read slightly later.
    assert!(min_s > latency_s - 1e-3, "{min_s} s");
}

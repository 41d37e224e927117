//! `echotank listen --vita49`: latency of the first sample of a ping after its pulse, and of every packet after its last sample.

use std::collections::HashMap;
use std::net::{SocketAddr, UdpSocket};
use std::time::{Duration, Instant};

use echotank_protocols::vita49::{Context, Packet, PacketType, PayloadFormat, SampleKind};

use super::{Failure, ListenArgs, print_spread};
use echotank_runtime::clock::{Clock, SystemClock};
use echotank_runtime::histograms::LatencyHistogram;

/// Size of the requested socket buffer, bytes: one second of 8 elements at 40 kS/s.
const RECEIVE_BUFFER_BYTES: usize = 2 << 20;
const LONGEST_DATAGRAM: usize = 65_536;
/// Modulus of the packet counts of a stream.
const COUNT_MODULUS: u8 = 16;

/// Counts of received packets.
#[derive(Default)]
struct Tally {
    streams: HashMap<u32, Stream>,
    pings: u64,
    packets: u64,
    /// Packets lost, from gaps in the packet counts. The loss of 16 consecutive packets is not detected.
    lost: u64,
    bytes: u64,
    /// Packets that are neither data nor context, or that have no time stamp.
    odd: u64,
    /// Start of the newest ping's samples, ns since 1970 UTC.
    ping_utc_ns: Option<i64>,
    first_is_due: bool,
}

#[derive(Default)]
struct Stream {
    next: Option<u8>,
    sample_rate_hz: Option<f64>,
    sample_time_bytes: Option<usize>,
}

fn sample_time_bytes(format: PayloadFormat) -> usize {
    let value = match format.kind {
        SampleKind::Fixed { bits } => usize::from(bits).div_ceil(8),
        SampleKind::Float => 4,
    };
    value * (1 + usize::from(format.is_complex)) * format.vector_size as usize
}

impl Tally {
    /// Counts a packet. Returns the time since the first sample of the ping, if the packet contains it, and since the last sample of the packet, ns.
    fn note(&mut self, bytes: &[u8], now_ns: i64) -> (Option<i64>, Option<i64>) {
        self.bytes += bytes.len() as u64;
        let packet = Packet::parse(bytes).ok();
        let Some((packet, time)) = packet.and_then(|packet| Some((packet, packet.time?))) else {
            self.odd += 1;
            return (None, None);
        };
        let utc_ns = time.to_utc_ns();
        let stream = self.streams.entry(packet.stream_id).or_default();
        match packet.packet_type {
            PacketType::Context => {
                if let Ok(context) = Context::parse(packet.payload) {
                    stream.sample_rate_hz = context.sample_rate_hz;
                    stream.sample_time_bytes = context.payload_format.map(sample_time_bytes);
                }
                if self.ping_utc_ns.replace(utc_ns) != Some(utc_ns) {
                    self.pings += 1;
                    self.first_is_due = true;
                }
                (None, None)
            }
            PacketType::SignalData => {
                self.packets += 1;
                let expected = stream.next.replace((packet.count + 1) % COUNT_MODULUS);
                let gap = expected.map_or(0, |next| {
                    (packet.count + COUNT_MODULUS - next) % COUNT_MODULUS
                });
                self.lost += u64::from(gap);
                let is_first =
                    std::mem::take(&mut self.first_is_due) && self.ping_utc_ns == Some(utc_ns);
                let last_ns = match (stream.sample_rate_hz, stream.sample_time_bytes) {
                    (Some(rate_hz), Some(bytes)) if rate_hz > 0.0 && bytes > 0 => {
                        let sample_times = packet.payload.len() / bytes;
                        let last_s = sample_times.saturating_sub(1) as f64 / rate_hz;
                        Some(now_ns - utc_ns - (last_s * 1e9) as i64)
                    }
                    _ => None,
                };
                (is_first.then_some(now_ns - utc_ns), last_ns)
            }
        }
    }
}

/// Receives datagrams at an address and prints the latencies.
pub(crate) fn main(args: &ListenArgs) -> Result<(), Failure> {
    let address: SocketAddr = args.address.parse().map_err(Failure::running)?;
    let socket = UdpSocket::bind(address).map_err(Failure::running)?;
    // The kernel may grant less.
    let _ = socket2::SockRef::from(&socket).set_recv_buffer_size(RECEIVE_BUFFER_BYTES);
    println!(
        "listening at {}",
        socket.local_addr().map_err(Failure::running)?
    );
    let end = args
        .seconds
        .map(|s| Instant::now() + Duration::from_secs_f64(s.clamp(0.0, 1e9)));
    let clock = SystemClock::new();
    let mut tally = Tally::default();
    let (first_sample, packets) = (LatencyHistogram::new(), LatencyHistogram::new());
    let us = |ns: i64| (ns.max(0) / 1000) as u64;
    let mut buffer = vec![0; LONGEST_DATAGRAM];
    let pulses = args.pulses()?;
    loop {
        let left = end.map_or(Duration::from_secs(1), |end| {
            end.saturating_duration_since(Instant::now())
                .min(Duration::from_secs(1))
        });
        if left.is_zero() {
            break;
        }
        socket
            .set_read_timeout(Some(left))
            .map_err(Failure::running)?;
        let Ok(len) = socket.recv(&mut buffer) else {
            continue;
        };
        let now_ns = clock.host_utc().0;
        let (first_ns, last_ns) = tally.note(&buffer[..len], now_ns);
        if let Some(ns) = first_ns {
            first_sample.note(us(ns));
            if let Some(pulses) = &pulses {
                pulses.first_sample(now_ns);
            }
        }
        if let Some(ns) = last_ns {
            packets.note(us(ns));
        }
    }
    println!(
        "{} pings; {} packets of {} streams, {} lost; {} bytes, {} packets not understood",
        tally.pings,
        tally.packets,
        tally.streams.len(),
        tally.lost,
        tally.bytes,
        tally.odd
    );
    if let Some(pulses) = &pulses {
        pulses.print();
    }
    print_spread("first sample after the pulse", &first_sample);
    print_spread("packet after its last sample", &packets);
    match tally.lost {
        0 => Ok(()),
        lost => Err(Failure::Running(format!("{lost} packets lost"))),
    }
}

#[cfg(test)]
mod tests {
    use echotank_protocols::vita49::{SignalStream, VrtTime};

    use super::*;

    #[test]
    fn latencies_follow_from_the_packet_timestamps() {
        let mut stream = SignalStream::new(7, true, 1, 1000.0, 1472);
        let mut tally = Tally::default();
        let mut latencies = Vec::new();
        for (ping, lost) in [(10_i64, false), (20, false), (30, true)] {
            let time = VrtTime::from_utc_ns(ping * 1_000_000_000);
            let mut packet = Vec::new();
            let context = Context {
                sample_rate_hz: Some(1000.0),
                ..stream.context()
            };
            stream.emit_context(&mut packet, time, &context);
            assert_eq!(tally.note(&packet, 0), (None, None));
            for (first, sample_times) in [(0_u128, 5), (5, 2)] {
                let mut bytes = Vec::new();
                let time = time.plus_ps(first * 1_000_000_000);
                let iq = vec![[1, 2]; sample_times];
                stream.emit_complex(&mut bytes, time, &iq, None, |_| {});
                if lost && first == 0 {
                    continue;
                }
                // Received 100 ms after the pulse.
                latencies.push(tally.note(&bytes, ping * 1_000_000_000 + 100_000_000));
            }
        }
        let ms = |ns: i64| Some(ns * 1_000_000);
        let (first, second) = ((ms(100), ms(96)), (None, ms(94)));
        assert_eq!(latencies, [first, second, first, second, second]);
        assert_eq!((tally.pings, tally.packets, tally.lost), (3, 5, 1));
        tally.note(b"something else", 0);
        assert_eq!(tally.odd, 1);
    }
}

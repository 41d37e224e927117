use echotank_protocols::vita49::{
    Context, Packet, PacketType, PayloadFormat, SampleKind, complex_samples, real_samples,
};
use num_complex::Complex64;

use super::*;

use echotank_core::arrays::ReceiverFilter;
use echotank_core::ping::ElementFrame;
use echotank_core::pulse::{Pulse, PulseKind};
use echotank_core::testing::plan_at_rest;
use echotank_core::time::UtcNs;

const PULSE: Pulse = Pulse {
    kind: PulseKind::LfmUp,
    center_frequency_hz: 400e3,
    bandwidth_hz: 20e3,
    duration_s: 1e-3,
    taper: 0.0,
};
const RATE_HZ: f64 = 40e3;
const SAMPLES: usize = 1001;

/// Sonar with an array of three elements and an array of one element.
fn sonar() -> SonarSpec {
    let text = include_str!("../../../hil-configs/points.toml");
    let folder = std::path::Path::new(concat!(env!("CARGO_MANIFEST_DIR"), "/../../hil-configs"));
    let rig = echotank_config::parse(text, folder, &echotank_config::AnyFiles).expect("right");
    let mut sonar = rig.sonars.into_iter().next().expect("one");
    sonar.pulse = PULSE;
    sonar.receiver.sample_rate_hz = RATE_HZ;
    sonar.receiver.full_scale_v = 2.0;
    sonar.receiver.filter = ReceiverFilter::None;
    sonar.receive.truncate(1);
    sonar.receive.push(sonar.receive[0].clone());
    sonar.receive[0].elements = 3;
    sonar.receive[1].elements = 1;
    sonar
}

/// I and Q of element e at sample k, below full scale.
fn iq(e: usize, k: usize) -> Complex64 {
    Complex64::new((e * 1000 + k) as f64 * 1e-4, -(k as f64) * 1e-4)
}

fn ping() -> (PingPlan, PingOutput) {
    let mut plan = plan_at_rest(&PULSE, SAMPLES, 1500.0);
    plan.first_sample_s = 2.5e-4;
    plan.stamp_utc = UtcNs(1_700_000_000_999_900_000);
    let frame = |array, elements, first: usize| ElementFrame {
        array,
        elements,
        samples: SAMPLES,
        iq: (0..elements * SAMPLES)
            .map(|n| iq(first + n / SAMPLES, n % SAMPLES))
            .collect(),
        saturated: 0,
    };
    let output = PingOutput {
        elements: vec![frame(0, 3, 0), frame(1, 1, 3)],
        ..PingOutput::default()
    };
    (plan, output)
}

fn spec() -> Vita49Spec {
    Vita49Spec {
        send_to: Vec::new(),
        arrays: vec![0, 1],
        passband_rate_hz: None,
        is_vector: false,
        first_stream: 7,
        max_packet: 1472,
        pace_bytes_per_s: 1e6,
        multicast_interface: std::net::Ipv4Addr::LOCALHOST,
        multicast_ttl: 1,
    }
}

/// Time of sample `k` of the ping, picoseconds since 1970.
fn sample_time_ps(k: usize, rate_hz: f64) -> u128 {
    1_700_000_000_999_900_000_000 + 250_000_000 + (k as f64 / rate_hz * 1e12).round() as u128
}

fn ps(time: Option<VrtTime>) -> u128 {
    let time = time.expect("UTC and picoseconds");
    u128::from(time.seconds) * 1_000_000_000_000 + u128::from(time.picoseconds)
}

#[test]
fn each_element_stream_carries_its_samples_times_and_counts() {
    let (plan, output) = ping();
    let mut emitter = Vita49Emitter::new(&spec(), &sonar());
    let mut packets = Packets::default();
    for round in 0..2 {
        emitter.emit_ping(&plan, &output, round == 1, &mut packets);
        for element in 0..4 {
            let mine: Vec<_> = packets
                .iter()
                .map(|bytes| Packet::parse(bytes).expect("a packet"))
                .filter(|packet| packet.stream_id == 7 + element as u32)
                .collect();
            assert_eq!(mine[0].packet_type, PacketType::Context);
            assert_eq!(mine[0].count, round);
            let said = Context::parse(mine[0].payload).expect("a context");
            assert_eq!(said.sample_rate_hz, Some(RATE_HZ));
            assert_eq!(said.rf_reference_hz, Some(400e3));
            assert_eq!(said.bandwidth_hz, Some(20e3));
            assert_eq!(
                said.payload_format,
                Some(PayloadFormat {
                    is_complex: true,
                    kind: SampleKind::Fixed { bits: 16 },
                    vector_size: 1
                })
            );
            // 2 V across 50 ohm: 80 mW, to 1/128 dB.
            let dbm = said.reference_level_dbm.expect("a level");
            assert!((dbm - 19.0309).abs() < 0.5 / 128.0, "{dbm}");
            let mut k = 0;
            for (n, packet) in mine[1..].iter().enumerate() {
                let before = usize::from(round) * (mine.len() - 1);
                assert_eq!(usize::from(packet.count), (before + n) % 16);
                assert_eq!(ps(packet.time), sample_time_ps(k, RATE_HZ));
                let trailer = packet.trailer.expect("a trailer");
                assert_eq!(trailer.over_range, Some(false));
                assert_eq!(trailer.sample_loss, Some(round == 1));
                for [i, q] in complex_samples(packet.payload) {
                    let want = iq(element, k) / 2.0 * 32767.0;
                    assert_eq!((i, q), (want.re.round() as i16, want.im.round() as i16));
                    k += 1;
                }
            }
            assert_eq!(k, SAMPLES);
        }
    }
}

#[test]
fn a_vector_stream_interleaves_all_elements_by_sample() {
    let (plan, output) = ping();
    let vector = Vita49Spec {
        is_vector: true,
        ..spec()
    };
    let mut emitter = Vita49Emitter::new(&vector, &sonar());
    let mut packets = Packets::default();
    let counts = emitter.emit_ping(&plan, &output, false, &mut packets);
    assert_eq!((counts.records, counts.saturated), (1 + 12, 0));
    let mut all = Vec::new();
    for bytes in packets.iter() {
        assert!(bytes.len() <= 1472);
        let packet = Packet::parse(bytes).expect("a packet");
        assert_eq!(packet.stream_id, 7);
        if packet.packet_type == PacketType::SignalData {
            assert_eq!(ps(packet.time), sample_time_ps(all.len() / 4, RATE_HZ));
            all.extend(complex_samples(packet.payload));
        }
    }
    assert_eq!(all.len(), 4 * SAMPLES);
    for (n, got) in all.iter().enumerate() {
        let want = iq(n % 4, n / 4) / 2.0 * 32767.0;
        assert_eq!(
            *got,
            [want.re.round() as i16, want.im.round() as i16],
            "{n}"
        );
    }
}

#[test]
fn passband_samples_equal_the_modulated_carrier_within_one_count() {
    let (plan, mut output) = ping();
    // A steady tone 3 kHz above the carrier at half of full scale.
    let tone = |k: usize| {
        let t = 2.5e-4 + k as f64 / RATE_HZ;
        Complex64::cis(std::f64::consts::TAU * 3e3 * t)
    };
    for frame in &mut output.elements {
        for (n, v) in frame.iq.iter_mut().enumerate() {
            *v = tone(n % SAMPLES);
        }
    }
    let real = Vita49Spec {
        passband_rate_hz: Some(1.2e6),
        ..spec()
    };
    let mut emitter = Vita49Emitter::new(&real, &sonar());
    let mut packets = Packets::default();
    emitter.emit_ping(&plan, &output, false, &mut packets);
    for element in 0..4 {
        let mut k = 0;
        for bytes in packets.iter() {
            let packet = Packet::parse(bytes).expect("a packet");
            if packet.stream_id != 7 + element {
                continue;
            }
            if packet.packet_type == PacketType::Context {
                let said = Context::parse(packet.payload).expect("a context");
                assert_eq!(said.sample_rate_hz, Some(1.2e6));
                assert_eq!(said.if_reference_hz, Some(400e3));
                assert!(!said.payload_format.expect("a format").is_complex);
                continue;
            }
            assert_eq!(ps(packet.time), sample_time_ps(k, 1.2e6));
            for got in real_samples(packet.payload) {
                let t = 2.5e-4 + k as f64 / 1.2e6;
                let want = 0.5 * 32767.0 * (std::f64::consts::TAU * 403e3 * t).cos();
                let inside = (1000..29_000).contains(&k);
                assert!(
                    !inside || (f64::from(got) - want).abs() <= 1.0,
                    "{k}: {got}, {want}"
                );
                k += 1;
            }
        }
        assert_eq!(k, 30_030);
    }
}

#[test]
fn blocks_of_an_odd_number_of_passband_samples_carry_every_sample_once() {
    let (plan, output) = ping();
    let real = Vita49Spec {
        passband_rate_hz: Some(1.2e6),
        ..spec()
    };
    let samples = |block_s: Option<f64>| -> Vec<i16> {
        let mut emitter = Vita49Emitter::new(&real, &sonar()).in_blocks_of(block_s);
        let mut packets = Packets::default();
        emitter.emit_ping(&plan, &output, false, &mut packets);
        let mut all = Vec::new();
        for bytes in packets.iter() {
            let packet = Packet::parse(bytes).expect("a packet");
            if packet.stream_id == 7 && packet.packet_type == PacketType::SignalData {
                assert_eq!(ps(packet.time), sample_time_ps(all.len(), 1.2e6));
                all.extend(real_samples(packet.payload));
            }
        }
        all
    };
    // Blocks of 501 samples, and blocks of one sample.
    for block_s in [501.0 / 1.2e6, 1.0 / 1.2e6] {
        assert_eq!(samples(Some(block_s)), samples(None));
    }
}

#[test]
fn values_beyond_full_scale_are_clipped_counted_and_flagged() {
    let (plan, mut output) = ping();
    output.elements[0].iq[5] = Complex64::new(2.1, f64::NAN);
    let mut emitter = Vita49Emitter::new(&spec(), &sonar());
    let mut packets = Packets::default();
    let counts = emitter.emit_ping(&plan, &output, false, &mut packets);
    assert_eq!(counts.saturated, 2);
    let data = packets
        .iter()
        .filter_map(|bytes| Packet::parse(bytes).ok())
        .find(|packet| packet.packet_type == PacketType::SignalData)
        .expect("data");
    assert_eq!(data.trailer.expect("a trailer").over_range, Some(true));
    assert_eq!(complex_samples(data.payload).nth(5), Some([32767, 0]));
}

#[test]
fn a_changed_context_sets_the_change_flag() {
    let (mut plan, output) = ping();
    let mut emitter = Vita49Emitter::new(&spec(), &sonar());
    let mut packets = Packets::default();
    let mut changes = Vec::new();
    for bandwidth_hz in [20e3, 20e3, 10e3, 10e3] {
        plan.pulse.bandwidth_hz = bandwidth_hz;
        emitter.emit_ping(&plan, &output, false, &mut packets);
        let first = Packet::parse(packets.iter().next().expect("one")).expect("a packet");
        changes.push(Context::parse(first.payload).expect("a context").is_change);
    }
    assert_eq!(changes, [false, false, true, false]);
}

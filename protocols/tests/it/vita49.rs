//! Compares VITA 49.2 with words assembled by hand and with the crate `vita49`, and parses random bytes.

use crate::support::{assert_same, bytes_of};
use echotank_protocols::WireError;
use echotank_protocols::vita49::{
    Context, ETHERNET_PACKET_BYTES, Packet, PacketType, PayloadFormat, SampleKind, SignalStream,
    Trailer, VrtTime, complex_samples, real_samples,
};
use proptest::prelude::*;
use vita49::Vrt;
use vita49::prelude::Cif0Manipulators;

const TIME: VrtTime = VrtTime {
    seconds: 1_750_000_000,
    picoseconds: 123_456_789_012,
};

fn words(words: &[u32]) -> Vec<u8> {
    words.iter().flat_map(|word| word.to_be_bytes()).collect()
}

fn context() -> Context {
    Context {
        is_change: true,
        bandwidth_hz: Some(20e3),
        rf_reference_hz: Some(400e3),
        reference_level_dbm: Some(-10.5),
        sample_rate_hz: Some(34_482.75),
        payload_format: Some(PayloadFormat {
            is_complex: true,
            kind: SampleKind::Fixed { bits: 16 },
            vector_size: 8,
        }),
        ..Context::default()
    }
}

#[test]
fn a_context_packet_is_word_for_word() {
    let golden = words(&[
        // Type 4, UTC, picoseconds, count 3, 15 words.
        0x4063_000F,
        0x0000_0100,
        1_750_000_000,
        0x0000_001C,
        0xBE99_1A14,
        // Change, bandwidth, RF frequency, level, rate, format: bits 31 29 27 24 21 15.
        0xA920_8000,
        // 20 000 x 2^20 = 0x4_E200_0000.
        0x0000_0004,
        0xE200_0000,
        0x0000_0061,
        0xA800_0000,
        // -10.5 x 128 = -1344 = 0xFAC0.
        0x0000_FAC0,
        // 34 482.75 x 2^20 = 0x8_6B2C_0000.
        0x0000_0008,
        0x6B2C_0000,
        // Complex, fixed, 16-bit fields with 16 bits; 8 side by side.
        0x2000_03CF,
        0x0000_0007,
    ]);
    let bytes = bytes_of(|buf| context().emit(buf, 0x100, 3, TIME));
    assert_same(&bytes, &golden, "context");
    let packet = Packet::parse(&golden).unwrap();
    assert_eq!(
        (packet.packet_type, packet.stream_id, packet.count),
        (PacketType::Context, 0x100, 3)
    );
    assert_eq!(packet.time, Some(TIME));
    assert_eq!(Context::parse(packet.payload), Ok(context()));
}

#[test]
fn a_data_packet_is_word_for_word() {
    let mut stream = SignalStream::new(0x105, true, 1, 1e6, ETHERNET_PACKET_BYTES);
    let trailer = Trailer {
        valid_data: Some(true),
        over_range: Some(true),
        sample_loss: Some(false),
        ..Trailer::default()
    };
    let golden = words(&[
        // Type 1 with trailer, UTC, picoseconds, count 0, 8 words.
        0x1460_0008,
        0x0000_0105,
        1_750_000_000,
        0x0000_001C,
        0xBE99_1A14,
        0x0001_FFFE,
        0x8000_7FFF,
        // Enables 30, 25, 24; indicators 18 and 13.
        0x4304_2000,
    ]);
    let mut packets = Vec::new();
    stream.emit_complex(
        &mut Vec::new(),
        TIME,
        &[[1, -2], [i16::MIN, i16::MAX]],
        Some(trailer),
        |packet| packets.push(packet.to_vec()),
    );
    assert_eq!(packets.len(), 1);
    assert_same(&packets[0], &golden, "data");
    let packet = Packet::parse(&golden).unwrap();
    assert_eq!(packet.trailer, Some(trailer));
    assert_eq!(
        complex_samples(packet.payload).collect::<Vec<_>>(),
        [[1, -2], [i16::MIN, i16::MAX]]
    );
}

/// The MIT/Apache crate `vita49`, an independent implementation.
#[test]
fn another_decoder_gives_equal_results() {
    let bytes = bytes_of(|buf| context().emit(buf, 0x100, 3, TIME));
    let packet = Vrt::try_from(&bytes[..]).unwrap();
    assert_eq!(packet.stream_id(), Some(0x100));
    assert_eq!(packet.integer_timestamp(), Some(TIME.seconds));
    assert_eq!(packet.fractional_timestamp(), Some(TIME.picoseconds));
    assert_eq!(packet.header().packet_count(), 3);
    let theirs = packet.payload().context().unwrap();
    assert!(theirs.context_changed());
    assert_eq!(theirs.bandwidth_hz(), Some(20e3));
    assert_eq!(theirs.rf_ref_freq_hz(), Some(400e3));
    assert_eq!(theirs.reference_level_db(), Some(-10.5));
    assert_eq!(theirs.sample_rate_sps(), Some(34_482.75));
    assert_eq!(
        theirs.signal_data_payload_format(),
        Some(&0x2000_03CF_0000_0007)
    );

    let mut stream = SignalStream::new(7, true, 4, 50e3, ETHERNET_PACKET_BYTES);
    let samples: Vec<[i16; 2]> = (0..4000).map(|k| [k as i16, -(k as i16)]).collect();
    let mut got = Vec::new();
    let mut count = 0;
    stream.emit_complex(&mut Vec::new(), TIME, &samples, None, |bytes| {
        assert!(bytes.len() <= ETHERNET_PACKET_BYTES);
        let packet = Vrt::try_from(bytes).unwrap();
        assert_eq!(packet.stream_id(), Some(7));
        assert_eq!(packet.header().packet_count(), count);
        count = (count + 1) % 16;
        got.extend_from_slice(packet.signal_payload().unwrap());
    });
    assert!(count != 0);
    assert_eq!(
        complex_samples(&got).collect::<Vec<_>>(),
        samples,
        "samples as the other decoder has them"
    );
}

#[test]
fn packets_of_a_ping_are_contiguous_to_a_picosecond_and_their_counter_wraps() {
    // 10 MS/s: 100 ns a sample, exact in picoseconds.
    let mut stream = SignalStream::new(1, true, 1, 10e6, 24 + 4 * 10);
    assert_eq!(stream.sample_times_per_packet(), 10);
    let mut at = 0_u64;
    let samples = vec![[0; 2]; 205];
    let mut counts = Vec::new();
    stream.emit_complex(&mut Vec::new(), TIME, &samples, None, |bytes| {
        let packet = Packet::parse(bytes).unwrap();
        assert_eq!(packet.time, Some(TIME.plus_ps(u128::from(at) * 100_000)));
        at += (packet.payload.len() / 4) as u64;
        counts.push(packet.count);
    });
    assert_eq!(at, 205);
    assert_eq!(counts, (0..21).map(|n| n % 16).collect::<Vec<u8>>());
    let end = VrtTime {
        seconds: 9,
        picoseconds: 999_999_999_999,
    };
    assert_eq!(
        end.plus_ps(1),
        VrtTime {
            seconds: 10,
            picoseconds: 0
        }
    );
    assert_eq!(
        VrtTime::from_utc_ns(1_750_000_000_123_456_789).to_utc_ns(),
        1_750_000_000_123_456_789
    );
}

/// Four context and four data packets that Wireshark's dissector decodes. Their payload format declares 16-bit numbers as IEEE single
/// precision (code 01110), which the dissector ignores; this crate refuses it.
#[test]
fn a_capture_that_another_decoder_accepts_parses_except_for_its_contradiction() {
    let pcap = std::fs::read(concat!(
        env!("CARGO_MANIFEST_DIR"),
        "/tests/data/proto_vita49.pcap"
    ))
    .unwrap();
    let (mut at, mut contexts, mut samples) = (24, 0, 0);
    while at < pcap.len() {
        let len = u32::from_le_bytes(pcap[at + 8..at + 12].try_into().unwrap()) as usize;
        // Ethernet, IPv4 and UDP headers.
        let bytes = &pcap[at + 16 + 42..at + 16 + len];
        at += 16 + len;
        let packet = Packet::parse(bytes).unwrap();
        assert_eq!(packet.size_bytes, bytes.len());
        assert_eq!(packet.time.unwrap().seconds, 1_750_000_000);
        if packet.packet_type == PacketType::SignalData {
            samples += complex_samples(packet.payload).len();
            continue;
        }
        contexts += 1;
        assert_eq!(
            Context::parse(packet.payload),
            Err(WireError::Unsupported {
                what: "VRT payload format",
                got: 0xAE00_03CF
            })
        );
        // Signed fixed point instead, with processing-efficient packing.
        let mut mended = bytes.to_vec();
        mended[4 * 12] = 0x20;
        let context = Context::parse(Packet::parse(&mended).unwrap().payload).unwrap();
        assert_eq!(context.rf_reference_hz, Some(400e3));
        assert_eq!(context.bandwidth_hz, Some(20e3));
        let mut again = Vec::new();
        context.emit(
            &mut again,
            packet.stream_id,
            packet.count,
            packet.time.unwrap(),
        );
        assert_same(&again, &mended, "context of the capture");
    }
    assert_eq!((contexts, samples), (4, 256));
}

#[test]
fn unsupported_contents_are_refused_by_name() {
    let unsupported = |bytes: &[u8]| {
        let error = Packet::parse(bytes).unwrap_err();
        assert!(matches!(error, WireError::Unsupported { .. }), "{error}");
    };
    unsupported(&words(&[0x6000_0002, 0]));
    let truncated = |bytes: &[u8]| {
        let error = Packet::parse(bytes).unwrap_err();
        assert!(matches!(error, WireError::Truncated { .. }), "{error}");
    };
    truncated(&[]);
    truncated(&words(&[0x1060_FFFF, 0, 0, 0, 0]));
    // Header, stream and time exceed the stated size.
    truncated(&words(&[0x1060_0004, 0, 0, 0, 0]));
    truncated(&words(&[0x1460_0005, 0, 0, 0, 0]));
    assert!(matches!(
        Context::parse(&words(&[0x0000_0002])),
        Err(WireError::Unsupported { .. })
    ));
    // Another time base is reported as no time.
    let gps = words(&[0x10A0_0005, 0, 5, 0, 0]);
    assert_eq!(Packet::parse(&gps).unwrap().time, None);
}

proptest! {
    #[test]
    fn no_bytes_make_a_parser_panic(mut bytes in proptest::collection::vec(any::<u8>(), 0..200), kind in 0..3_u8) {
        // Half of them start with a valid header.
        if kind > 0 && bytes.len() >= 4 {
            bytes[0] = [0x10, 0x40][usize::from(kind - 1)] | bytes[0] & 0x0C;
            let words = bytes.len() / 4;
            bytes[2..4].copy_from_slice(&(words as u16).to_be_bytes());
        }
        let _ = Context::parse(&bytes);
        if let Ok(packet) = Packet::parse(&bytes) {
            prop_assert!(packet.size_bytes <= bytes.len() && packet.payload.len() < packet.size_bytes);
            let _ = real_samples(packet.payload).count();
            if let Ok(context) = Context::parse(packet.payload) {
                let mut again = Vec::new();
                context.emit(&mut again, packet.stream_id, packet.count, packet.time.unwrap_or_default());
                prop_assert_eq!(Context::parse(Packet::parse(&again).unwrap().payload).unwrap(), context);
            }
        }
    }

    #[test]
    fn every_sample_round_trips_once_for_any_packet_size(
        count in 0..500_usize, elements in 1..6_u32, is_complex: bool, packet_bytes in 64..600_usize
    ) {
        let mut stream = SignalStream::new(3, is_complex, elements, 48e3, packet_bytes);
        let mut buf = Vec::new();
        if is_complex {
            let samples: Vec<[i16; 2]> = (0..count * elements as usize).map(|k| [k as i16, !(k as i16)]).collect();
            let mut got = Vec::new();
            stream.emit_complex(&mut buf, TIME, &samples, None, |bytes| {
                assert!(bytes.len() <= packet_bytes);
                got.extend(complex_samples(Packet::parse(bytes).unwrap().payload));
            });
            prop_assert_eq!(got, samples);
        } else {
            let samples: Vec<i16> = (0..count / 2 * 2 * elements as usize).map(|k| k as i16).collect();
            let mut got = Vec::new();
            stream.emit_real(&mut buf, TIME, &samples, None, |bytes| {
                assert!(bytes.len() <= packet_bytes);
                got.extend(real_samples(Packet::parse(bytes).unwrap().payload));
            });
            prop_assert_eq!(got, samples);
        }
    }

    #[test]
    fn contexts_round_trip(
        is_change: bool, numbers in any::<[Option<u32>; 4]>(), level in any::<Option<i16>>(), bits in 1..=64_u8, elements in 1..=65_536_u32, is_complex: bool
    ) {
        let [bandwidth, frequency, intermediate, rate] = numbers.map(|n| n.map(|n| f64::from(n) / 1024.0));
        let context = Context {
            is_change,
            bandwidth_hz: bandwidth,
            rf_reference_hz: frequency,
            if_reference_hz: intermediate,
            reference_level_dbm: level.map(|l| f64::from(l) / 128.0),
            sample_rate_hz: rate,
            payload_format: Some(PayloadFormat { is_complex, kind: SampleKind::Fixed { bits }, vector_size: elements }),
        };
        let mut bytes = Vec::new();
        context.emit(&mut bytes, 1, 2, TIME);
        prop_assert_eq!(Context::parse(Packet::parse(&bytes).unwrap().payload).unwrap(), context);
    }
}

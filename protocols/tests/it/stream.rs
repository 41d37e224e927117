//! Guarantees of the stream decoder: it returns every valid record, whatever lies between records and however the bytes are divided.

use crate::support::{STAMP, heading, record_of};
use echotank_protocols::sevenk::frame::{DATA_RECORD_FRAME_BYTES, NETWORK_FRAME_BYTES};
use echotank_protocols::sevenk::{
    Command, ControlRequest, ErrorCode, Packetiser, RecordBody, StreamDecoder, WireError, checksum,
};
use proptest::prelude::*;

fn packets_of(record: &[u8], max_packet_bytes: u32) -> Vec<u8> {
    let mut packets = Vec::new();
    Packetiser::new(max_packet_bytes)
        .unwrap()
        .packetise(record, &mut packets);
    packets
}

fn wire(record: &[u8]) -> Vec<u8> {
    packets_of(record, 60_000)
}

#[test]
fn a_refused_record_is_accessible_and_held_bytes_are_counted() {
    let mut bad = wire(&heading(1.0));
    let last = bad.len() - 1;
    bad[last] ^= 1;
    let mut decoder = StreamDecoder::default();
    decoder.push(b"x");
    assert!(matches!(decoder.next_record(), None | Some(Err(_))));
    decoder.push(&bad);
    let refused = loop {
        match decoder.next_record() {
            Some(Err(WireError::Checksum { .. })) => break decoder.refused_bytes().to_vec(),
            Some(Err(_)) => {}
            other => panic!("{other:?}"),
        }
    };
    assert_eq!(refused, bad);
    while decoder.next_record().is_some() {}
    let good = wire(&heading(2.0));
    decoder.push(&good[..70]);
    assert!(decoder.next_record().is_none());
    assert_eq!(decoder.held_bytes(), 70);
    decoder.push(&good[70..]);
    assert!(matches!(decoder.next_record(), Some(Ok(_))));
    assert_eq!(decoder.held_bytes(), 0);
}

/// All results for `stream`, pushed in pieces, including those after the peer closed.
fn decode_in_pieces(
    decoder: &mut StreamDecoder,
    stream: &[u8],
    piece_bytes: usize,
) -> (Vec<Vec<u8>>, Vec<WireError>) {
    let (mut records, mut errors) = (Vec::new(), Vec::new());
    let mut sort = |item: Result<echotank_protocols::sevenk::Record<'_>, WireError>| match item {
        Ok(record) => records.push(record.bytes().to_vec()),
        Err(error) => errors.push(error),
    };
    for piece in stream.chunks(piece_bytes) {
        decoder.feed(piece, &mut sort);
    }
    decoder.finish();
    decoder.feed(&[], &mut sort);
    (records, errors)
}

fn decode(stream: &[u8]) -> (Vec<Vec<u8>>, Vec<WireError>, StreamDecoder) {
    let mut decoder = StreamDecoder::default();
    let (records, errors) = decode_in_pieces(&mut decoder, stream, usize::MAX);
    (records, errors, decoder)
}

#[test]
fn records_come_out_byte_by_byte() {
    let records = [
        heading(0.5),
        record_of(7999, b"something else"),
        heading(1.5),
    ];
    let stream: Vec<u8> = records.iter().flat_map(|record| wire(record)).collect();
    let mut decoder = StreamDecoder::default();
    assert_eq!(
        decode_in_pieces(&mut decoder, &stream, 1),
        (records.to_vec(), vec![])
    );
    assert_eq!(
        (
            decoder.counters().records,
            decoder.counters().errors(),
            decoder.counters().skipped_bytes
        ),
        (3, 0, 0)
    );
}

#[test]
fn drf_offset_64_is_read_like_60() {
    let request = ControlRequest {
        ticket: 7,
        tracking_number: [1, 2],
        command: Command::Range { range_m: 75.0 },
    };
    let mut record = Vec::new();
    request.emit(&mut record, &STAMP);
    // As MBARI's client sends it.
    record[2] = 64;
    let end = record.len() - 4;
    let sum = checksum(&record[..end]);
    record[end..].copy_from_slice(&sum.to_le_bytes());
    let mut decoder = StreamDecoder::default();
    decoder.push(&wire(&record));
    let read = decoder.next_record().unwrap().unwrap();
    assert_eq!(
        RecordBody::parse(&read),
        Ok(RecordBody::RemoteControl(request))
    );
}

#[test]
fn each_kind_of_damage_is_reported_counted_and_skipped() {
    type Damage = fn(&mut Vec<u8>);
    type Expected = fn(&WireError) -> bool;
    let cases: [(&str, Damage, Expected, ErrorCode); 9] = [
        (
            "version",
            |w| w[0] = 4,
            |e| matches!(e, WireError::NetworkVersion { got: 4 }),
            ErrorCode::NetworkProtocolVersion,
        ),
        (
            "offset",
            |w| w[2] = 40,
            |e| matches!(e, WireError::NetworkOffset { got: 40 }),
            ErrorCode::NetworkOffset,
        ),
        (
            "oversized",
            |w| w[16..20].fill(0x7f),
            |e| matches!(e, WireError::Oversized { .. }),
            ErrorCode::InvalidParameter,
        ),
        (
            "packet size",
            |w| w[12] ^= 1,
            |e| matches!(e, WireError::PacketSizes { .. }),
            ErrorCode::InvalidParameter,
        ),
        (
            "data version",
            |w| w[36] = 6,
            |e| matches!(e, WireError::DataVersion { got: 6 }),
            ErrorCode::DataProtocolVersion,
        ),
        (
            "sync",
            |w| w[40] = 0,
            |e| matches!(e, WireError::SyncPattern { got: 0xff00 }),
            ErrorCode::DataSyncPattern,
        ),
        (
            "drf offset",
            |w| w[38] = 61,
            |e| matches!(e, WireError::RecordOffset { got: 61 }),
            ErrorCode::InvalidParameter,
        ),
        (
            "record size",
            |w| w[44] ^= 1,
            |e| matches!(e, WireError::RecordSize { .. }),
            ErrorCode::InvalidParameter,
        ),
        (
            "checksum",
            |w| w[100] ^= 1,
            |e| matches!(e, WireError::Checksum { .. }),
            ErrorCode::DataChecksum,
        ),
    ];
    for (name, damage, is_expected, nack) in cases {
        let good = [heading(0.5), heading(1.5)];
        let mut bad = wire(&heading(1.0));
        damage(&mut bad);
        let stream = [wire(&good[0]), bad.clone(), wire(&good[1])].concat();
        let (records, errors, decoder) = decode(&stream);
        assert_eq!(records, good, "{name}");
        assert!(
            errors.len() == 1 && is_expected(&errors[0]),
            "{name}: {errors:?}"
        );
        assert_eq!(errors[0].nack_code(), nack, "{name}");
        let counters = decoder.counters();
        assert_eq!(
            (counters.records, counters.errors(), counters.resyncs),
            (2, 1, 1),
            "{name}"
        );
        assert_eq!(counters.skipped_bytes, bad.len() as u64, "{name}");
    }
}

#[test]
fn a_shortened_record_does_not_hide_the_next() {
    let good = [heading(0.5), heading(1.5), heading(2.5)];
    let cut = wire(&record_of(7999, &[3; 500]));
    for kept in [1, 10, 36, 60, 99, 100, 101, 400, cut.len() - 1] {
        let stream = [
            wire(&good[0]),
            cut[..kept].to_vec(),
            wire(&good[1]),
            wire(&good[2]),
        ]
        .concat();
        let (records, errors, _) = decode(&stream);
        assert_eq!(records, good, "{kept} bytes of the cut record, {errors:?}");
        assert!(!errors.is_empty(), "{kept}");
    }
}

#[test]
fn a_shortened_fragment_does_not_hide_the_next_record() {
    let good = heading(0.5);
    let fragmented = packets_of(&record_of(7999, &[3; 1000]), 300);
    for kept in [150, 300, 336, 450, 600, fragmented.len() - 1] {
        let stream = [fragmented[..kept].to_vec(), wire(&good)].concat();
        let (records, errors, _) = decode(&stream);
        assert_eq!(
            records,
            std::slice::from_ref(&good),
            "{kept} bytes of the cut record"
        );
        assert!(!errors.is_empty());
    }
}

#[test]
fn a_lost_fragment_loses_only_its_record() {
    let good = heading(0.5);
    let fragmented = packets_of(&record_of(7999, &[3; 1000]), 300);
    let stream = [&fragmented[..300], &fragmented[600..], &wire(&good)].concat();
    let (records, errors, _) = decode(&stream);
    assert_eq!(records, [good]);
    assert_eq!(
        errors,
        [WireError::FragmentSequence {
            expected: 1,
            got: 2
        }]
    );
}

#[test]
fn another_protocol_is_detected_from_its_first_bytes() {
    let mut decoder = StreamDecoder::default();
    decoder.push(b"GET / HTTP/1.1\r\n\r\n");
    let version = u16::from_le_bytes(*b"GE");
    assert!(
        matches!(decoder.next_record(), Some(Err(WireError::NetworkVersion { got })) if got == version)
    );
    assert!(decoder.next_record().is_none());
}

#[test]
fn an_incomplete_record_is_held_until_the_peer_closes() {
    let packets = wire(&heading(0.5));
    let mut decoder = StreamDecoder::default();
    decoder.push(&packets[..70]);
    assert!(decoder.next_record().is_none());
    decoder.push(&packets[70..]);
    assert!(matches!(decoder.next_record(), Some(Ok(_))));
    decoder.push(&packets[..70]);
    decoder.finish();
    assert!(matches!(
        decoder.next_record(),
        Some(Err(WireError::Truncated { .. }))
    ));
    assert!(decoder.next_record().is_none());
    assert_eq!(decoder.counters().truncated_errors, 1);
    // The same connection may continue with valid bytes.
    decoder.push(&packets);
    assert!(matches!(decoder.next_record(), Some(Ok(_))));
}

#[test]
fn memory_is_bounded_by_the_record_limit() {
    let mut decoder = StreamDecoder::new(1000);
    let mut held = 0;
    // A valid header that announces more than ever arrives, pushed without taking records.
    let packets = packets_of(&record_of(7999, &[0; 900]), 100);
    for _ in 0..100 {
        held += decoder.push(&packets[..500]);
    }
    assert_eq!(held, decoder.capacity_bytes());
    // The longest permitted record in the shortest packets fits.
    let longest = record_of(7999, &vec![7; 1000 - 68]);
    let mut decoder = StreamDecoder::new(1000);
    assert_eq!(
        decode_in_pieces(&mut decoder, &packets_of(&longest, 100), 7).0,
        [longest]
    );
    // One more byte does not, and is refused by its header.
    let (records, errors) = decode_in_pieces(
        &mut StreamDecoder::new(1000),
        &wire(&record_of(7999, &vec![7; 1001 - 68])),
        7,
    );
    assert!(
        records.is_empty()
            && matches!(
                errors[0],
                WireError::Oversized {
                    total_bytes: 1001,
                    limit_bytes: 1000
                }
            )
    );
}

/// Bytes without a network frame: none is the 5 with which a frame begins.
fn rubbish() -> impl Strategy<Value = Vec<u8>> {
    proptest::collection::vec(
        any::<u8>().prop_map(|byte| if byte == 5 { 6 } else { byte }),
        1..200,
    )
}

proptest! {
    #[test]
    fn all_records_between_invalid_bytes_are_recovered(
        parts in proptest::collection::vec((rubbish(), proptest::collection::vec(any::<u8>(), 0..300), 100_u32..500), 1..8),
        piece_bytes in 1_usize..700,
    ) {
        let (mut stream, mut good, mut rubbish_bytes) = (Vec::new(), Vec::new(), 0);
        for (rubbish, body, max_packet_bytes) in parts {
            rubbish_bytes += rubbish.len() as u64;
            stream.extend(rubbish);
            good.push(record_of(7999, &body));
            stream.extend(packets_of(good.last().unwrap(), max_packet_bytes));
        }
        let mut decoder = StreamDecoder::default();
        let (records, errors) = decode_in_pieces(&mut decoder, &stream, piece_bytes);
        prop_assert_eq!(decoder.counters().skipped_bytes, rubbish_bytes);
        prop_assert_eq!(errors.len(), good.len());
        prop_assert_eq!(decoder.counters().resyncs, good.len() as u64);
        prop_assert_eq!(records, good);
    }

    #[test]
    fn one_damaged_byte_loses_at_most_its_own_record(at in 0_usize..3 * 108, value in any::<u8>()) {
        let good = [heading(0.5), heading(1.5), heading(2.5)];
        let mut stream: Vec<u8> = good.iter().flat_map(|record| wire(record)).collect();
        prop_assert_eq!(stream.len(), 3 * 108);
        stream[at] = value;
        let (records, _, _) = decode(&stream);
        for (index, record) in good.iter().enumerate() {
            prop_assert!(index == at / 108 || records.contains(record), "record {} lost by byte {}", index, at);
        }
    }

    #[test]
    fn any_bytes_stream_without_panic_and_every_byte_is_accounted_for(
        bytes in proptest::collection::vec(prop_oneof![any::<u8>(), Just(5), Just(36), Just(0)], 0..2000),
        piece_bytes in 1_usize..300,
    ) {
        let mut decoder = StreamDecoder::new(4096);
        let (records, _) = decode_in_pieces(&mut decoder, &bytes, piece_bytes);
        let in_records: u64 = records.iter().map(|record| (record.len() + NETWORK_FRAME_BYTES) as u64).sum();
        prop_assert_eq!(decoder.counters().skipped_bytes + in_records, bytes.len() as u64);
    }

    #[test]
    fn any_bytes_after_valid_frames_stream_without_panic(
        body in proptest::collection::vec(any::<u8>(), 0..400),
        damage in proptest::collection::vec((0_usize..400, any::<u8>()), 0..4),
        max_packet_bytes in 100_u32..200,
    ) {
        let mut packets = packets_of(&record_of(7999, &body), max_packet_bytes);
        for (at, value) in damage {
            let at = at % packets.len();
            packets[at] = value;
        }
        let good = heading(0.5);
        packets.extend(wire(&good));
        let (records, _, _) = decode(&packets);
        prop_assert!(records.contains(&good));
        prop_assert!(packets.len() >= NETWORK_FRAME_BYTES + DATA_RECORD_FRAME_BYTES);
    }
}

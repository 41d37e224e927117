//! Guarantees of packetiser and reassembler.

use crate::support;
use echotank_protocols::sevenk::packet::{
    MIN_MAX_PACKET_BYTES, PARTIAL_RECORDS, PacketLimitError, PacketRanges,
};
use echotank_protocols::sevenk::{NetworkFrame, Packetiser, Reassembler, StreamDecoder, WireError};
use proptest::prelude::*;

fn record_of(body_bytes: usize) -> Vec<u8> {
    let body: Vec<u8> = (0..body_bytes).map(|i| i as u8).collect();
    support::record_of(7999, &body)
}

fn datagrams(packetiser: &mut Packetiser, record: &[u8]) -> Vec<Vec<u8>> {
    let mut buf = vec![0; 5];
    let ranges: PacketRanges = packetiser.packetise(record, &mut buf);
    assert_eq!(ranges.whole(), 5..buf.len());
    ranges.map(|range| buf[range].to_vec()).collect()
}

#[test]
fn all_packets_but_the_last_are_full_and_numbered() {
    let record = record_of(200_000);
    let mut packetiser = Packetiser::default();
    let packets = datagrams(&mut packetiser, &record);
    assert_eq!(
        packets.iter().map(Vec::len).collect::<Vec<_>>(),
        [60_000, 60_000, 60_000, 200_068 - 3 * 59_964 + 36]
    );
    for (index, packet) in packets.iter().enumerate() {
        let frame = NetworkFrame::parse(packet).unwrap();
        assert_eq!(frame.check(u32::MAX), Ok(()));
        assert_eq!(
            (
                frame.sequence_number,
                frame.total_packets,
                frame.total_records
            ),
            (index as u32, 4, 1)
        );
        assert_eq!(
            (
                frame.packet_size_bytes as usize,
                frame.total_size_bytes as usize
            ),
            (packet.len(), record.len())
        );
        assert_eq!(
            (
                frame.source_device_id,
                frame.source_enumerator,
                frame.transmission_id
            ),
            (7125, 1, 0)
        );
    }
    let next = datagrams(&mut packetiser, &record);
    assert_eq!(NetworkFrame::parse(&next[0]).unwrap().transmission_id, 1);
}

#[test]
fn whole_records_are_one_packet_however_long() {
    let record = record_of(500_000);
    let packets = datagrams(&mut Packetiser::whole_records(), &record);
    assert_eq!(packets.len(), 1);
    let frame = NetworkFrame::parse(&packets[0]).unwrap();
    // Required by MBARI's reader.
    assert_eq!(frame.packet_size_bytes, frame.total_size_bytes + 36);
}

#[test]
fn a_limit_below_both_frames_is_refused() {
    assert!(Packetiser::new(MIN_MAX_PACKET_BYTES).is_ok());
    let error = PacketLimitError {
        max_packet_bytes: MIN_MAX_PACKET_BYTES - 1,
    };
    assert_eq!(
        Packetiser::new(MIN_MAX_PACKET_BYTES - 1).unwrap_err(),
        error
    );
}

#[test]
fn transmission_numbers_wrap() {
    let record = record_of(0);
    let mut packetiser = Packetiser::default();
    let ids: Vec<u16> = (0..65_538)
        .map(|_| {
            NetworkFrame::parse(&datagrams(&mut packetiser, &record)[0])
                .unwrap()
                .transmission_id
        })
        .collect();
    assert_eq!((ids[65_535], ids[65_536], ids[65_537]), (65_535, 0, 1));
}

#[test]
fn incomplete_records_are_dropped_oldest_first() {
    let mut packetiser = Packetiser::new(200).unwrap();
    let record = record_of(300);
    let sets: Vec<_> = (0..=PARTIAL_RECORDS)
        .map(|_| datagrams(&mut packetiser, &record))
        .collect();
    let mut reassembler = Reassembler::new(10_000);
    for set in &sets {
        assert!(reassembler.push_datagram(&set[0]).unwrap().is_none());
    }
    assert_eq!(reassembler.counters().abandoned_records, 1);
    // The first record was dropped, the second was not.
    assert!(
        sets[1][1..]
            .iter()
            .any(|packet| reassembler.push_datagram(packet).unwrap().is_some())
    );
    assert_eq!(reassembler.counters().records, 1);
}

#[test]
fn late_and_duplicate_packets_are_handled_and_counted() {
    let record = record_of(500);
    let packets = datagrams(&mut Packetiser::new(200).unwrap(), &record);
    assert_eq!(packets.len(), 4);
    let mut reassembler = Reassembler::new(10_000);
    for index in [3, 0, 0, 2] {
        assert!(
            reassembler
                .push_datagram(&packets[index])
                .unwrap()
                .is_none()
        );
    }
    assert_eq!(
        reassembler
            .push_datagram(&packets[1])
            .unwrap()
            .unwrap()
            .bytes(),
        record
    );
    let counters = reassembler.counters();
    assert_eq!(
        (
            counters.records,
            counters.duplicate_packets,
            counters.out_of_order_packets
        ),
        (1, 1, 3)
    );
}

#[test]
fn invalid_datagrams_are_reported_and_counted() {
    let mut reassembler = Reassembler::new(1000);
    let packet = datagrams(&mut Packetiser::default(), &record_of(10)).remove(0);
    assert!(matches!(
        reassembler.push_datagram(&packet[..20]),
        Err(WireError::Truncated { .. })
    ));
    assert!(matches!(
        reassembler.push_datagram(&packet[..packet.len() - 1]),
        Err(WireError::Truncated { .. })
    ));
    let mut flipped = packet.clone();
    flipped[100] ^= 1;
    assert!(matches!(
        reassembler.push_datagram(&flipped),
        Err(WireError::Checksum { .. })
    ));
    let long = datagrams(&mut Packetiser::default(), &record_of(1000)).remove(0);
    assert!(matches!(
        reassembler.push_datagram(&long),
        Err(WireError::Oversized { .. })
    ));
    assert_eq!(reassembler.counters().errors, 4);
    assert!(reassembler.push_datagram(&packet).unwrap().is_some());
}

proptest! {
    #[test]
    fn fragments_come_together_in_any_order(
        body_bytes in 0_usize..3000,
        max_packet_bytes in MIN_MAX_PACKET_BYTES..1500,
        shuffle in any::<u64>(),
    ) {
        let record = record_of(body_bytes);
        let mut packets = datagrams(&mut Packetiser::new(max_packet_bytes).unwrap(), &record);
        for packet in &packets {
            prop_assert!(packet.len() <= max_packet_bytes as usize);
            prop_assert_eq!(NetworkFrame::parse(packet).unwrap().check(u32::MAX), Ok(()));
        }
        // In order over a stream ...
        let mut decoder = StreamDecoder::default();
        decoder.push(&packets.concat());
        prop_assert_eq!(decoder.next_record().unwrap().unwrap().bytes(), &record[..]);
        // ... and as datagrams in another order, the first one twice.
        packets.sort_by_key(|packet| checksum_of(packet).wrapping_mul(shuffle | 1));
        packets.insert(0, packets[0].clone());
        let mut reassembler = Reassembler::new(1 << 20);
        let mut out = Vec::new();
        for packet in &packets {
            if let Some(whole) = reassembler.push_datagram(packet).unwrap() {
                out.push(whole.bytes().to_vec());
            }
        }
        let expected = if packets.len() == 2 { 2 } else { 1 };
        prop_assert_eq!(out, vec![record; expected]);
    }

    #[test]
    fn any_datagrams_reassemble_without_panic(
        datagrams in proptest::collection::vec(proptest::collection::vec(any::<u8>(), 0..150), 0..6),
        damage in proptest::collection::vec((0_usize..12, 0_usize..36, any::<u8>()), 0..6),
    ) {
        let mut reassembler = Reassembler::new(4096);
        for datagram in &datagrams {
            let _ = reassembler.push_datagram(datagram);
        }
        let mut packets = self::datagrams(&mut Packetiser::new(150).unwrap(), &record_of(1000));
        for (index, at, value) in damage {
            let index = index % packets.len();
            packets[index][at] = value;
        }
        for packet in &packets {
            let _ = reassembler.push_datagram(packet);
        }
    }
}

fn checksum_of(packet: &[u8]) -> u64 {
    packet.iter().fold(1, |hash: u64, &byte| {
        hash.wrapping_mul(31).wrapping_add(u64::from(byte))
    })
}

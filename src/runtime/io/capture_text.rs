//! Describes packet captures as text for `tools/wiredump`.
//!
//! Datagrams are decoded by destination port or by their first bytes. Each direction of a TCP connection is reassembled and decoded by either port.
//! Repeated segments are skipped, and early segments are kept until the gap is filled. After a lost segment decoding resynchronises behind the gap.

use std::collections::{BTreeMap, HashMap};

use echotank_protocols::describer::{Datagrams, Format, MessageDescriber};

use echotank_nav::capture::{self, Segment};

/// Maximum number of early segments kept in one direction before the missing segment counts as lost.
const MAX_WAITING: usize = 64;

/// One direction of a TCP connection.
#[derive(Default)]
struct StreamDirection {
    /// `None` until the first bytes reveal the format.
    describer: Option<MessageDescriber>,
    /// Sequence number of the next byte; `None` before the first segment.
    next: Option<u32>,
    /// Early segments by offset from the first sequence number, which orders them across wrap-around.
    waiting: BTreeMap<u32, Vec<u8>>,
    begun: u32,
}

impl StreamDirection {
    /// Adds a segment and passes the bytes that are now in order to `each`.
    fn push(&mut self, segment: &Segment<'_>, mut each: impl FnMut(&[u8])) {
        if segment.is_start {
            *self = Self {
                describer: self.describer.take(),
                next: Some(segment.sequence.wrapping_add(1)),
                begun: segment.sequence.wrapping_add(1),
                ..Self::default()
            };
        }
        if segment.payload.is_empty() {
            return;
        }
        if self.next.is_none() {
            self.begun = segment.sequence;
            self.next = Some(segment.sequence);
        }
        let place = segment.sequence.wrapping_sub(self.begun);
        let held = self.waiting.entry(place).or_default();
        if segment.payload.len() > held.len() {
            *held = segment.payload.to_vec();
        }
        while let Some((&place, _)) = self.waiting.first_key_value() {
            let at = self.next.unwrap_or(self.begun).wrapping_sub(self.begun);
            if place > at && self.waiting.len() <= MAX_WAITING {
                break;
            }
            let Some((place, bytes)) = self.waiting.pop_first() else {
                break;
            };
            // Skips bytes that `each` has already received.
            let known = at.saturating_sub(place) as usize;
            if let Some(new) = bytes.get(known..).filter(|new| !new.is_empty()) {
                each(new);
                let end = place.wrapping_add(bytes.len() as u32);
                self.next = Some(self.begun.wrapping_add(end));
            }
        }
    }
}

/// Describes each message of a pcap or pcapng file in one line, passed to `each` until it returns false. `format` overrides the detection.
pub fn describe_capture(
    bytes: &[u8],
    format: Option<Format>,
    each: &mut dyn FnMut(String) -> bool,
) {
    let mut datagrams = Datagrams::default();
    let mut directions: HashMap<(Vec<u8>, u16, u16), StreamDirection> = HashMap::new();
    for packet in capture::packets(bytes) {
        let mut goes_on = true;
        let arrival = packet.arrival.0;
        if let Some(payload) = packet.payload {
            let told = format
                .or(Format::of_port(packet.port))
                .or(Format::of_bytes(payload));
            let mut say =
                |line: String| goes_on &= each(format!("{arrival} to {}: {line}", packet.port));
            match told {
                Some(format) => datagrams.push(format, payload, &mut say),
                None => say(format!("{} B of no format that we know", payload.len())),
            }
        } else if let Some(segment) = packet.segment {
            let (from, to) = (segment.from_port, segment.to_port);
            let direction = directions
                .entry((segment.addresses.to_vec(), from, to))
                .or_default();
            let mut say =
                |line: String| goes_on &= each(format!("{arrival} {from} to {to}: {line}"));
            let mut describer = direction.describer.take();
            direction.push(&segment, |new| {
                let told = format
                    .or(Format::of_port(to))
                    .or(Format::of_port(from))
                    .or(Format::of_bytes(new));
                match (&mut describer, told) {
                    (Some(describer), _) => describer.push(new, &mut say),
                    (none, Some(format)) => {
                        none.insert(MessageDescriber::new(format))
                            .push(new, &mut say);
                    }
                    (_, None) => say(format!("{} B of no format that we know", new.len())),
                }
            });
            direction.describer = describer;
        }
        if !goes_on {
            return;
        }
    }
    let mut goes_on = true;
    for ((_, from, to), direction) in directions {
        if let Some(describer) = direction.describer.filter(|_| goes_on) {
            describer
                .finish(&mut |line: String| goes_on &= each(format!("{from} to {to}: {line}")));
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    const SERVER: u16 = 2210;

    /// A pcap of raw IP with TCP segments from the server: sequence number, SYN, payload.
    fn pcap(segments: &[(u32, bool, &[u8])]) -> Vec<u8> {
        let mut file = vec![0xD4, 0xC3, 0xB2, 0xA1, 2, 0, 4, 0, 0, 0, 0, 0, 0, 0, 0, 0];
        file.extend([0, 0, 4, 0, 101, 0, 0, 0]);
        for (sequence, is_start, payload) in segments {
            let mut packet = vec![0x45, 0];
            packet.extend((40 + payload.len() as u16).to_be_bytes());
            packet.extend([0, 0, 0, 0, 64, 6, 0, 0, 127, 0, 0, 1, 127, 0, 0, 1]);
            packet.extend(SERVER.to_be_bytes());
            packet.extend(50_000_u16.to_be_bytes());
            packet.extend(sequence.to_be_bytes());
            packet.extend([0, 0, 0, 0, 0x50, if *is_start { 0x12 } else { 0x10 }]);
            packet.extend([0; 6]);
            packet.extend(*payload);
            for value in [7, 0, packet.len() as u32, packet.len() as u32] {
                file.extend(value.to_le_bytes());
            }
            file.extend(packet);
        }
        file
    }

    fn lines(file: &[u8], format: Option<Format>) -> Vec<String> {
        let mut lines = Vec::new();
        describe_capture(file, format, &mut |line| {
            lines.push(line);
            true
        });
        lines
    }

    #[test]
    fn a_stream_cut_at_any_places_told_twice_and_out_of_order_is_read_as_it_was_sent() {
        let text = b"set_range 0 50\r\nset_rate 4\r\nset_power 1\r\n";
        let want = [
            "RangeM { start: 0.0, stop: 50.0",
            "RateHz(4.0)",
            "Power(true)",
        ];
        // Sequence numbers wrap around inside.
        let first = u32::MAX - 20;
        let at = |from: usize, to: usize| {
            let sequence = first.wrapping_add(1).wrapping_add(from as u32);
            (sequence, false, &text[from..to])
        };
        for (what, segments) in [
            ("whole", vec![(first, true, &b""[..]), at(0, 41)]),
            (
                "pieces",
                vec![(first, true, b""), at(0, 5), at(5, 17), at(17, 41)],
            ),
            (
                "twice",
                vec![(first, true, b""), at(0, 20), at(0, 20), at(10, 41)],
            ),
            (
                "early",
                vec![(first, true, b""), at(0, 5), at(17, 41), at(5, 17)],
            ),
            ("no start", vec![at(0, 20), at(20, 41)]),
        ] {
            let got = lines(&pcap(&segments), Some(Format::WbmsText));
            assert_eq!(got.len(), want.len(), "{what}: {got:?}");
            for (got, want) in got.iter().zip(want) {
                assert!(
                    got.starts_with("7000000000 2210 to 50000: WBMS"),
                    "{what}: {got}"
                );
                assert!(got.contains(want), "{what}: {got}, wanted {want}");
            }
        }
    }

    #[test]
    fn a_segment_that_never_comes_is_a_gap_and_no_end() {
        let mut segments = vec![(0, true, &b""[..]), (1, false, &b"set_rate 4\r\n"[..])];
        // One segment is lost; many segments follow.
        let lost = 13 + 12;
        segments.extend(
            (0..=MAX_WAITING as u32).map(|k| (lost + 12 * k, false, &b"set_rate 5\r\n"[..])),
        );
        let got = lines(&pcap(&segments), Some(Format::WbmsText));
        assert_eq!(got.len(), 2 + MAX_WAITING, "{got:?}");
    }

    proptest! {
        #[test]
        fn no_segments_make_it_panic(segments in proptest::collection::vec((any::<u32>(), any::<bool>(), proptest::collection::vec(any::<u8>(), 0..30)), 0..100)) {
            let segments: Vec<_> = segments.iter().map(|(s, start, p)| (*s, *start, &p[..])).collect();
            lines(&pcap(&segments), None);
        }
    }
}

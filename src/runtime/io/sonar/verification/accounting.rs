//! Accounts for received records: lost, duplicate, late, damaged or different from a reference run.

use std::collections::{BTreeMap, BTreeSet, HashMap};

use super::decode::{Family, ReceivedRecord, Sequence};
use super::report::{Finding, Report, ReportHead};
use crate::io::sonar::verify::{Arrival, NumberTracker, PingTally};

/// Checksums of records of a run without faults, by sequence and [`ReceivedRecord::key`].
pub type Checksums = HashMap<(Sequence, u64), u64>;

/// Maximum number of missing numbers in one gap whose bounds are kept.
const MAX_PLACES: usize = 100_000;
/// Maximum number of findings kept; further findings are only counted.
const MAX_FINDINGS: usize = 1_000_000;

/// 64-bit FNV-1a hash (Fowler, Noll, Vo).
fn checksum(bytes: &[u8]) -> u64 {
    bytes.iter().fold(0xcbf2_9ce4_8422_2325, |hash, byte| {
        (hash ^ u64::from(*byte)).wrapping_mul(0x100_0000_01b3)
    })
}

/// Tally and findings of the records that one listener received over all its connections.
pub struct Accounting {
    family: Family,
    sequences: BTreeMap<Sequence, NumberTracker>,
    /// Bounds of a missing packet (times of its stream, ns) or frame (ping numbers).
    between: BTreeMap<(Sequence, u32), (i64, i64)>,
    /// Time or ping number of the newest record of a sequence.
    newest: BTreeMap<Sequence, i64>,
    damaged: BTreeSet<(Sequence, u32)>,
    /// Reference checksums for the comparison.
    against: Option<Checksums>,
    /// Checksums of this run.
    checksums: Checksums,
    keeps_checksums: bool,
    findings: Vec<Finding>,
    /// Indices of findings that end at the next ping.
    open: Vec<usize>,
    unlisted: u64,
    pings: Option<(u32, u32)>,
    last_ping: Option<u32>,
    utc_ns: Option<(i64, i64)>,
}

impl Accounting {
    /// `against` holds the checksums of a run without faults. `keeps_checksums` enables [`Accounting::checksums`].
    pub fn new(family: Family, against: Option<Checksums>, keeps_checksums: bool) -> Self {
        Self {
            family,
            sequences: BTreeMap::new(),
            between: BTreeMap::new(),
            newest: BTreeMap::new(),
            damaged: BTreeSet::new(),
            against,
            checksums: Checksums::new(),
            keeps_checksums,
            findings: Vec::new(),
            open: Vec::new(),
            unlisted: 0,
            pings: None,
            last_ping: None,
            utc_ns: None,
        }
    }

    /// Checksums of this run; empty unless enabled.
    pub fn checksums(&self) -> &Checksums {
        &self.checksums
    }

    /// Number of the last ping received.
    pub fn last_ping(&self) -> Option<u32> {
        self.last_ping
    }

    /// Number of findings beyond the limit.
    pub fn unlisted(&self) -> u64 {
        self.unlisted
    }

    fn find(&mut self, finding: Finding) {
        if self.findings.len() < MAX_FINDINGS {
            self.findings.push(finding);
        } else {
            self.unlisted += 1;
        }
    }

    /// Adds a finding of the listener itself, such as a reset, between the pings `from` and `to`.
    pub fn found(&mut self, kind: &str, from: Option<u32>, to: Option<u32>) {
        self.find(Finding {
            kind: kind.into(),
            ping_number: from,
            to_ping: to,
            ..Finding::default()
        });
    }

    /// Like [`Accounting::found`], from the last ping received to the next one.
    pub(crate) fn found_until_next(&mut self, kind: &str) {
        self.found(kind, self.last_ping, None);
        self.open.push(self.findings.len() - 1);
    }

    /// Counts one received record and adds its findings.
    pub fn note(&mut self, record: &ReceivedRecord) {
        if let Some(ping) = record.ping_number.filter(|_| !record.is_damaged) {
            for at in self.open.drain(..) {
                self.findings[at].to_ping = Some(ping);
            }
            let (first, last) = self.pings.unwrap_or((ping, ping));
            self.pings = Some((first.min(ping), last.max(ping)));
            self.last_ping = Some(ping);
        }
        if let Some(utc) = record.utc_ns {
            let (first, last) = self.utc_ns.unwrap_or((utc, utc));
            self.utc_ns = Some((first.min(utc), last.max(utc)));
        }
        let Some(number) = record.number else {
            return;
        };
        let sequence = record.sequence;
        if record.is_damaged {
            if self.damaged.insert((sequence, number)) {
                self.find(finding("damaged", record));
            }
            // The count of a damaged datagram is used; otherwise the datagram would count as lost too.
            if self.family != Family::Vita49 {
                return;
            }
        }
        let mut before = None;
        let seen = match self.sequences.get_mut(&sequence) {
            Some(numbers) => {
                before = Some(numbers.span().1);
                numbers.note(number)
            }
            None => {
                self.sequences.insert(sequence, NumberTracker::from(number));
                Arrival::New
            }
        };
        let place = match sequence {
            Sequence::Packets { .. } => record.utc_ns,
            Sequence::Frames => record.ping_number.map(i64::from),
            Sequence::Records(_) | Sequence::Answers => None,
        };
        if let (Some(place), Arrival::New) = (place, seen) {
            let newest = self.newest.insert(sequence, place);
            if let (Some(before), Some(newest)) = (before, newest) {
                for missing in (before + 1..number).take(MAX_PLACES) {
                    self.between.insert((sequence, missing), (newest, place));
                }
            }
        }
        match seen {
            Arrival::New => {}
            Arrival::Duplicate => return self.find(finding("duplicate", record)),
            Arrival::Late => self.find(finding("late", record)),
        }
        if record.is_damaged {
            return;
        }
        let sum =
            (self.against.is_some() || self.keeps_checksums).then(|| checksum(record.content));
        if let (Some(against), Some(sum)) = (&self.against, sum)
            && against
                .get(&(sequence, record.key))
                .is_some_and(|was| *was != sum)
        {
            self.find(finding("different", record));
        }
        if let (true, Some(sum)) = (self.keeps_checksums, sum) {
            self.checksums.insert((sequence, record.key), sum);
        }
    }

    /// Tally of each sequence. Damaged records count as lost.
    pub fn tallies(&self) -> impl Iterator<Item = (Sequence, PingTally)> + '_ {
        let sequences = self.sequences.iter();
        sequences.map(|(sequence, numbers)| (*sequence, numbers.tally()))
    }

    /// All findings, with one finding for each lost number.
    pub fn report(&self) -> Report {
        let mut findings = self.findings.clone();
        for (sequence, numbers) in &self.sequences {
            for number in numbers.missing() {
                if self.damaged.contains(&(*sequence, number)) {
                    continue;
                }
                findings.push(self.lost(*sequence, number));
            }
        }
        let sequences = || self.sequences.keys();
        let types: Vec<u32> = sequences()
            .filter_map(|sequence| match sequence {
                Sequence::Records(record_type) => Some(*record_type),
                _ => None,
            })
            .collect();
        let detects = self.family.detectable_faults(self.against.is_some());
        Report {
            head: ReportHead {
                report: "echotank listen".into(),
                line: Some(self.family.name().into()),
                sonar: None,
                covers: (!types.is_empty()).then_some(types),
                detects: Some(detects.into_iter().map(str::to_owned).collect()),
                first_ping: self.pings.map(|(first, _)| first),
                last_ping: self.pings.map(|(_, last)| last),
                from_utc_ns: self.utc_ns.map(|(first, _)| first),
                to_utc_ns: self.utc_ns.map(|(_, last)| last),
            },
            findings,
        }
    }

    fn lost(&self, sequence: Sequence, number: u32) -> Finding {
        let lost = Finding {
            kind: "lost".into(),
            ..Finding::default()
        };
        let between = self.between.get(&(sequence, number));
        match sequence {
            Sequence::Records(record_type) => Finding {
                ping_number: Some(number),
                record_type: Some(record_type),
                ..lost
            },
            Sequence::Packets { stream, context } => Finding {
                stream: Some(stream),
                context: Some(context),
                from_utc_ns: between.map(|(from, _)| *from),
                to_utc_ns: between.map(|(_, to)| *to),
                ..lost
            },
            Sequence::Frames => Finding {
                frame_number: Some(number),
                ping_number: between.and_then(|(from, _)| u32::try_from(*from).ok()),
                to_ping: between.and_then(|(_, to)| u32::try_from(*to).ok()),
                ..lost
            },
            Sequence::Answers => lost,
        }
    }
}

fn finding(kind: &str, record: &ReceivedRecord) -> Finding {
    let (record_type, stream, context, frame_number) = match record.sequence {
        Sequence::Records(record_type) => (Some(record_type), None, None, None),
        Sequence::Packets { stream, context } => (None, Some(stream), Some(context), None),
        Sequence::Frames => (None, None, None, record.number),
        Sequence::Answers => (None, None, None, None),
    };
    Finding {
        kind: kind.into(),
        ping_number: record.ping_number,
        record_type,
        stream,
        context,
        frame_number,
        from_utc_ns: record.utc_ns,
        to_utc_ns: record.utc_ns,
        ..Finding::default()
    }
}

/// Formats checksums as text, one line each: `KIND A B KEY SUM`.
pub fn checksums_text(sums: &Checksums) -> String {
    let mut lines: Vec<String> = sums
        .iter()
        .map(|((sequence, key), sum)| {
            let (kind, a, b) = match sequence {
                Sequence::Records(record_type) => ("record", *record_type, 0),
                Sequence::Packets { stream, context } => ("packet", *stream, u32::from(*context)),
                Sequence::Frames => ("frame", 0, 0),
                Sequence::Answers => ("answer", 0, 0),
            };
            format!("{kind} {a} {b} {key} {sum:016x}\n")
        })
        .collect();
    lines.sort_unstable();
    lines.concat()
}

/// Parses the text of [`checksums_text`].
///
/// # Errors
/// Number of the first malformed line, from 1.
pub fn parse_checksums(text: &str) -> Result<Checksums, usize> {
    let lines = text.lines().enumerate();
    lines
        .map(|(at, line)| {
            let words: Vec<&str> = line.split_whitespace().collect();
            let wrong = at + 1;
            let [kind, a, b, key, sum] = words[..] else {
                return Err(wrong);
            };
            let integer = |text: &str| text.parse::<u32>().map_err(|_| wrong);
            let sequence = match kind {
                "record" => Sequence::Records(integer(a)?),
                "packet" => Sequence::Packets {
                    stream: integer(a)?,
                    context: integer(b)? == 1,
                },
                "frame" => Sequence::Frames,
                "answer" => Sequence::Answers,
                _ => return Err(wrong),
            };
            let sum = u64::from_str_radix(sum, 16).map_err(|_| wrong)?;
            Ok(((sequence, key.parse().map_err(|_| wrong)?), sum))
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use echotank_protocols::elements::{FrameHead, SampleType};
    use echotank_protocols::vita49::{SignalStream, VrtTime};
    use proptest::prelude::*;

    use super::super::decode::RecordDecoder;
    use super::*;

    /// Decodes datagrams or pieces of a connection.
    fn decode<'a>(
        family: Family,
        pieces: impl IntoIterator<Item = &'a [u8]>,
        against: Option<Checksums>,
    ) -> Accounting {
        let mut decoder = RecordDecoder::new(family);
        let mut accounting = Accounting::new(family, against, true);
        for piece in pieces {
            decoder.decode(piece, &mut |record| accounting.note(record));
        }
        accounting
    }

    /// Kind and count of all findings.
    fn kinds(accounting: &Accounting) -> Vec<(String, usize)> {
        let mut kinds = BTreeMap::new();
        for finding in accounting.report().findings {
            *kinds.entry(finding.kind).or_insert(0) += 1;
        }
        kinds.into_iter().collect()
    }

    /// Packets of two streams, 1 ms apart, with a pause after every tenth.
    fn packets() -> Vec<Vec<u8>> {
        let mut streams = [7, 8].map(|id| SignalStream::new(id, true, 1, 10e3, 1472));
        let mut packets = Vec::new();
        for k in 0..60_i64 {
            let utc_ns = 1_700_000_000_000_000_000 + k * 1_000_000 + k / 10 * 500_000_000;
            for stream in &mut streams {
                let samples = [[k as i16, 5]; 10];
                let time = VrtTime::from_utc_ns(utc_ns);
                stream.emit_complex(&mut Vec::new(), time, &samples, None, |packet| {
                    packets.push(packet.to_vec());
                });
            }
        }
        packets
    }

    #[test]
    fn vita_packets_are_accounted_for_by_their_counts_and_times() {
        let packets = packets();
        let heard = |packets: &[Vec<u8>], sums| {
            decode(Family::Vita49, packets.iter().map(Vec::as_slice), sums)
        };
        let clean = heard(&packets, None);
        assert_eq!(kinds(&clean), []);
        assert_eq!(clean.checksums().len(), 120);

        // Stream 7 loses 14 packets in a row, across two pauses.
        let mut some = packets.clone();
        let mut k = 0;
        some.retain(|_| {
            k += 1;
            !(k % 2 == 1 && (8..22).contains(&(k / 2)))
        });
        let lost = heard(&some, None);
        assert_eq!(kinds(&lost), [("lost".into(), 14)]);
        let findings = lost.report().findings;
        assert!(findings.iter().all(|f| f.stream == Some(7)));
        assert!(findings.iter().all(|f| f.from_utc_ns < f.to_utc_ns));

        let mut twice = packets.clone();
        twice.insert(41, packets[40].clone());
        twice.insert(80, packets[30].clone());
        let twice = heard(&twice, None);
        assert_eq!(kinds(&twice), [("duplicate".into(), 2)]);

        let mut late = packets.clone();
        let held = late.remove(30);
        late.insert(37, held);
        assert_eq!(kinds(&heard(&late, None)), [("late".into(), 1)]);

        let mut spoiled = packets.clone();
        spoiled[20][40] ^= 0x55;
        spoiled[30].truncate(36);
        assert_eq!(kinds(&heard(&spoiled, None)), [("damaged".into(), 1)]);
        let compared = heard(&spoiled, Some(clean.checksums().clone()));
        let want = [("damaged".into(), 1), ("different".into(), 1)];
        assert_eq!(kinds(&compared), want);
    }

    fn frames(first_number: u32) -> Vec<Vec<u8>> {
        let frame = |(number, ping): (u32, u32)| {
            let mut bytes = Vec::new();
            FrameHead {
                frame_number: first_number + number,
                ping_number: ping,
                first_sample: 0,
                ping_samples: 2,
                elements: 1,
                sample_type: SampleType::I16,
                volts_per_unit: 1.0,
                pulse_utc_ns: 0,
                first_sample_s: 0.0,
                sample_rate_hz: 1.0,
                center_frequency_hz: 1.0,
            }
            .emit(&mut bytes, 2, |buf| buf.extend([ping as u8; 8]));
            bytes
        };
        (0..20).zip(100..).map(frame).collect()
    }

    #[test]
    fn frames_are_lost_between_two_pings_and_the_same_whatever_their_numbers() {
        let mut sent = frames(5);
        let clean = decode(Family::Elements, [&sent.concat()[..]], None);
        assert_eq!(kinds(&clean), []);
        // A client that connected earlier has other frame numbers for the same pings.
        let other = frames(77).concat();
        let again = decode(
            Family::Elements,
            [&other[..]],
            Some(clean.checksums().clone()),
        );
        assert_eq!(kinds(&again), []);
        sent.remove(9);
        sent[3][75] ^= 1;
        let bytes = sent.concat();
        let pieces = bytes.chunks(13);
        let heard = decode(Family::Elements, pieces, Some(clean.checksums().clone()));
        let findings = heard.report().findings;
        let places: Vec<_> = findings
            .iter()
            .map(|f| (f.kind.as_str(), f.frame_number, f.ping_number, f.to_ping))
            .collect();
        let want = [
            ("different", Some(8), Some(103), None),
            ("lost", Some(14), Some(108), Some(110)),
        ];
        assert_eq!(places, want);
    }

    #[test]
    fn sums_survive_their_own_text() {
        let clean = decode(Family::Elements, [&frames(1).concat()[..]], None);
        let mut sums = clean.checksums().clone();
        sums.insert((Sequence::Records(7038), 3), u64::MAX);
        let sequence = Sequence::Packets {
            stream: 9,
            context: true,
        };
        sums.insert((sequence, 1 << 60), 0);
        let text = checksums_text(&sums);
        assert_eq!(parse_checksums(&text).expect("sums"), sums);
        assert_eq!(
            parse_checksums(&(text + "record 1 2 x 0\n")),
            Err(sums.len() + 1)
        );
    }

    proptest! {
        #[test]
        fn no_bytes_make_any_ear_fall(
            bytes in proptest::collection::vec(any::<u8>(), 0..400),
            mark in 0..6_usize,
            cut in 1..50_usize,
        ) {
            let marks: [&[u8]; 6] =
                [&[1, 0x16], &[0xEF, 0xBE, 0xAD, 0xDE], b"BR", b"IMX", b"ETEL", &[5, 0, 36, 0]];
            let bytes = [marks[mark], &bytes].concat();
            for family in Family::ALL {
                let accounting = decode(family, bytes.chunks(cut), None);
                let _ = accounting.report().text();
            }
        }
    }
}

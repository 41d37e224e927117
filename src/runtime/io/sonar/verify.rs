//! Tally of received records by ping number: sent, lost, duplicate, late.

use std::collections::{BTreeMap, BTreeSet};

/// Offset of the ping number in the record type headers of 7000, 7503, 7007, 7018 and 7038, bytes.
const PING_NUMBER_AT: usize = 8;
/// Offset of the multi-ping sequence in the record type headers of 7000 and 7007, bytes.
const SEQUENCE_AT: usize = 12;

/// Maximum number of missing ping numbers kept per record type; beyond the limit the lowest numbers count as lost permanently.
const MISSING_LIMIT: usize = 100_000;

/// Ping number of a record body. `None` for a record without a ping number, and for the reply to a request (7503 with 0). Also `None` for further
/// pulses of a ping (multi-ping sequence 2 and on).
pub fn ping_number(record_type: u32, body: &[u8]) -> Option<u32> {
    if !matches!(record_type, 7000 | 7503 | 7007 | 7018 | 7038) {
        return None;
    }
    if matches!(record_type, 7000 | 7007)
        && let Some(bytes) = body.get(SEQUENCE_AT..).and_then(|b| b.first_chunk())
        && u16::from_le_bytes(*bytes) > 1
    {
        return None;
    }
    let bytes = body.get(PING_NUMBER_AT..)?.first_chunk::<4>()?;
    Some(u32::from_le_bytes(*bytes)).filter(|&number| number != 0)
}

/// Tally of one record type. Skipped pings have numbers too, so they count as lost.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct PingTally {
    /// Numbers from the lowest to the highest received.
    pub sent: u64,
    /// Records received, duplicates included: sent - lost + duplicate.
    pub received: u64,
    /// Numbers never received.
    pub lost: u64,
    /// Records received more than once.
    pub duplicate: u64,
    /// Records received after a higher number; they do not count as lost.
    pub late: u64,
}

/// Counts records by type.
#[derive(Clone, Debug, Default)]
pub struct Verifier {
    streams: BTreeMap<u32, NumberTracker>,
}

/// Relation of a number to those received before.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Arrival {
    /// Higher than all before.
    New,
    /// Received before.
    Duplicate,
    /// Lower than one received before.
    Late,
}

/// Tracks the received and missing numbers of one sequence.
#[derive(Clone, Debug)]
pub struct NumberTracker {
    lowest: u32,
    highest: u32,
    missing: BTreeSet<u32>,
    /// Missing numbers beyond the limit, which are only counted.
    forgotten: u64,
    tally: PingTally,
}

impl Verifier {
    /// Counts a record. Returns false if the record has no ping number.
    pub fn note(&mut self, record_type: u32, body: &[u8]) -> bool {
        let Some(number) = ping_number(record_type, body) else {
            return false;
        };
        self.streams
            .entry(record_type)
            .and_modify(|numbers| {
                numbers.note(number);
            })
            .or_insert_with(|| NumberTracker::from(number));
        true
    }

    /// Tally of each record type, lowest type first.
    pub fn tallies(&self) -> impl Iterator<Item = (u32, PingTally)> + '_ {
        self.streams
            .iter()
            .map(|(&record_type, stream)| (record_type, stream.tally()))
    }

    /// Tally of one record type.
    pub fn tally(&self, record_type: u32) -> PingTally {
        self.streams
            .get(&record_type)
            .map_or_else(PingTally::default, NumberTracker::tally)
    }
}

impl From<u32> for NumberTracker {
    /// Begins with the first number.
    fn from(number: u32) -> Self {
        Self {
            lowest: number,
            highest: number,
            missing: BTreeSet::new(),
            forgotten: 0,
            tally: PingTally {
                received: 1,
                ..PingTally::default()
            },
        }
    }
}

impl NumberTracker {
    /// Counts a number and returns its relation to the earlier ones.
    pub fn note(&mut self, number: u32) -> Arrival {
        self.tally.received += 1;
        if number > self.highest {
            self.miss(self.highest + 1, number);
            self.highest = number;
            return Arrival::New;
        }
        if number < self.lowest {
            self.miss(number + 1, self.lowest);
            self.lowest = number;
        } else if !self.missing.remove(&number) {
            self.tally.duplicate += 1;
            return Arrival::Duplicate;
        }
        self.tally.late += 1;
        Arrival::Late
    }

    /// Lowest and highest number received.
    pub fn span(&self) -> (u32, u32) {
        (self.lowest, self.highest)
    }

    /// Missing numbers between the lowest and the highest, in ascending order; beyond 100 000 only the highest.
    pub fn missing(&self) -> impl Iterator<Item = u32> + '_ {
        self.missing.iter().copied()
    }

    /// Marks the numbers `first..end` as missing.
    fn miss(&mut self, first: u32, end: u32) {
        let kept_from = first.max(end.saturating_sub(MISSING_LIMIT as u32));
        self.forgotten += u64::from(kept_from - first);
        self.missing.extend(kept_from..end);
        while self.missing.len() > MISSING_LIMIT {
            self.missing.pop_first();
            self.forgotten += 1;
        }
    }

    /// The counts so far.
    pub fn tally(&self) -> PingTally {
        PingTally {
            sent: u64::from(self.highest - self.lowest) + 1,
            lost: self.missing.len() as u64 + self.forgotten,
            ..self.tally
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn noted(numbers: &[u32]) -> PingTally {
        let mut verifier = Verifier::default();
        for number in numbers {
            let mut body = vec![0; 12];
            body[8..].copy_from_slice(&number.to_le_bytes());
            verifier.note(7018, &body);
        }
        verifier.tally(7018)
    }

    #[test]
    fn losses_duplicates_and_late_comers_are_told_apart() {
        let tally = noted(&[5, 6, 6, 9, 7, 10, 10, 4]);
        let want = PingTally {
            sent: 7,
            received: 8,
            lost: 1,
            duplicate: 2,
            late: 2,
        };
        assert_eq!(tally, want, "8 is lost, 6 and 10 came twice, 7 and 4 late");
        assert_eq!(noted(&[]), PingTally::default());
    }

    #[test]
    fn a_leap_over_all_numbers_is_counted_without_being_stored() {
        let tally = noted(&[1, u32::MAX]);
        let span = u64::from(u32::MAX);
        assert_eq!((tally.sent, tally.lost), (span, span - 2));
    }

    #[test]
    fn records_without_a_ping_number_are_passed_over() {
        let mut verifier = Verifier::default();
        assert!(!verifier.note(1003, &[0; 37]));
        assert!(!verifier.note(7503, &[0; 260]), "an answer, not a ping");
        assert!(!verifier.note(7000, &[1; 11]), "cut off");
        assert_eq!(verifier.tallies().count(), 0);
    }

    proptest! {
        #[test]
        fn the_books_always_balance(numbers in proptest::collection::vec(1..60_u32, 1..200)) {
            let tally = noted(&numbers);
            prop_assert_eq!(tally.received, tally.sent - tally.lost + tally.duplicate);
            let distinct: BTreeSet<_> = numbers.iter().collect();
            prop_assert_eq!(tally.sent - tally.lost, distinct.len() as u64);
        }
    }
}

//! Accounts for what came of what was sent, by ping numbers: sent, lost, duplicate, late.

use std::collections::{BTreeMap, BTreeSet};

/// Where the ping number stands in the RTH of 7000, 7503, 7007, 7018 and 7038.
const PING_NUMBER_AT: usize = 8;
/// And the multi-ping sequence in that of 7000 and 7007.
const SEQUENCE_AT: usize = 12;

/// Missing ping numbers remembered per record type; beyond these the lowest count as lost for good.
const MISSING_LIMIT: usize = 100_000;

/// The ping number of a record body; none for records without one, for the answer to a request (7503 with 0), and for the further pulses of a
/// ping (multi-ping sequence 2 and on), whose first counts for it.
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

/// Of one record type. Ping numbers are given to skipped pings too: what the sonar skipped is lost as well.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct PingTally {
    /// From the lowest to the highest number seen, both included.
    pub sent: u64,
    /// Records that came, duplicates included: sent - lost + duplicate.
    pub received: u64,
    pub lost: u64,
    pub duplicate: u64,
    /// Came after a higher number; not lost.
    pub late: u64,
}

/// Notes records as they come.
#[derive(Clone, Debug, Default)]
pub struct Verifier {
    streams: BTreeMap<u32, NumberTracker>,
}

/// What a number was when it came.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Arrival {
    /// Higher than all before.
    New,
    Duplicate,
    /// After a higher one.
    Late,
}

/// The numbers of one stream as they come.
#[derive(Clone, Debug)]
pub struct NumberTracker {
    lowest: u32,
    highest: u32,
    missing: BTreeSet<u32>,
    /// Of those no longer remembered.
    forgotten: u64,
    tally: PingTally,
}

impl Verifier {
    /// Takes note of a record; false if it has no ping number.
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

    /// Per record type, lowest first.
    pub fn tallies(&self) -> impl Iterator<Item = (u32, PingTally)> + '_ {
        self.streams
            .iter()
            .map(|(&record_type, stream)| (record_type, stream.tally()))
    }

    pub fn tally(&self, record_type: u32) -> PingTally {
        self.streams
            .get(&record_type)
            .map_or_else(PingTally::default, NumberTracker::tally)
    }
}

impl From<u32> for NumberTracker {
    /// The first of them.
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

    /// Lowest and highest number seen.
    pub fn span(&self) -> (u32, u32) {
        (self.lowest, self.highest)
    }

    /// Those between that have not come, lowest first; of very many the highest.
    pub fn missing(&self) -> impl Iterator<Item = u32> + '_ {
        self.missing.iter().copied()
    }

    /// NumberTracker from `first` up to, not including, `end` have not come.
    fn miss(&mut self, first: u32, end: u32) {
        let kept_from = first.max(end.saturating_sub(MISSING_LIMIT as u32));
        self.forgotten += u64::from(kept_from - first);
        self.missing.extend(kept_from..end);
        while self.missing.len() > MISSING_LIMIT {
            self.missing.pop_first();
            self.forgotten += 1;
        }
    }

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

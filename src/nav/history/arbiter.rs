//! Which source speaks for a quantity. Comes in: who said something, and when it arrived. Goes out: whether it counts.
//!
//! Sources stand in the file's order. The best one that is not silent speaks; a worse one takes over when it has been silent for a configured
//! time, and it takes the word back when it has come without such a silence for another. Without fail-over the first one owns the quantity.

use echotank_config::spec::FailoverSpec;
use echotank_core::time::{NS_PER_S, UtcNs};

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Word {
    /// It counts.
    Has,
    /// It counts, and is the first of another source than before: nothing joins it to what was.
    Takes,
    HasNot,
}

#[derive(Clone, Copy, Debug)]
struct Candidate {
    source: u16,
    last: Option<UtcNs>,
    /// It has come without a silence from here on.
    since: UtcNs,
}

#[derive(Clone, Debug, Default)]
pub(crate) struct Arbiter {
    /// Best first.
    candidates: Vec<Candidate>,
    speaking: Option<usize>,
    /// When the first sample of any of them arrived.
    begun: Option<UtcNs>,
}

impl Arbiter {
    pub(super) fn new(sources: impl Iterator<Item = u16>) -> Self {
        let candidate = |source| Candidate {
            source,
            last: None,
            since: UtcNs(0),
        };
        Self {
            candidates: sources.map(candidate).collect(),
            speaking: None,
            begun: None,
        }
    }

    /// The source whose samples count at present; before any came, the best.
    pub(super) fn source(&self) -> Option<u16> {
        self.candidates
            .get(self.speaking.unwrap_or(0))
            .map(|c| c.source)
    }

    pub(super) fn hear(&mut self, source: u16, arrival: UtcNs, rule: Option<FailoverSpec>) -> Word {
        let Some(who) = self.candidates.iter().position(|c| c.source == source) else {
            return Word::HasNot;
        };
        let Some(rule) = rule else {
            return if who == 0 { Word::Has } else { Word::HasNot };
        };
        let silence_ns = (rule.after_s * NS_PER_S as f64) as i64;
        let hold_off_ns = (rule.hold_off_s * NS_PER_S as f64) as i64;
        let since = |from: UtcNs| arrival.0.saturating_sub(from.0);
        let begun = *self.begun.get_or_insert(arrival);
        let candidate = &mut self.candidates[who];
        if candidate.last.is_none_or(|last| since(last) > silence_ns) {
            candidate.since = arrival;
        }
        candidate.last = Some(candidate.last.map_or(arrival, |last| last.max(arrival)));
        let steady_ns = since(candidate.since);
        let silent = |c: &Candidate| since(c.last.unwrap_or(begun)) > silence_ns;
        let takes = match self.speaking {
            Some(speaking) if who == speaking => return Word::Has,
            Some(speaking) if who < speaking => {
                steady_ns >= hold_off_ns || silent(&self.candidates[speaking])
            }
            _ => self.candidates[..who].iter().all(silent),
        };
        if !takes {
            return Word::HasNot;
        }
        let first = self.speaking.replace(who).is_none();
        if first { Word::Has } else { Word::Takes }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const RULE: Option<FailoverSpec> = Some(FailoverSpec {
        after_s: 2.0,
        hold_off_s: 5.0,
    });

    /// Who speaks at each tenth of a second, where `comes(source, t)` says who sends.
    fn speakers(comes: fn(u16, f64) -> bool, until: i32) -> Vec<(f64, u16)> {
        let mut arbiter = Arbiter::new([3, 7].into_iter());
        let mut changes = Vec::new();
        for i in 0..until {
            let t = f64::from(i) / 10.0;
            for source in [7, 3] {
                if comes(source, t) {
                    let word = arbiter.hear(source, UtcNs(0).plus_s(t), RULE);
                    let spoke = word != Word::HasNot;
                    if spoke && changes.last().is_none_or(|(_, s)| *s != source) {
                        assert_eq!(word == Word::Takes, !changes.is_empty());
                        changes.push((t, source));
                    }
                }
            }
        }
        changes
    }

    #[test]
    fn the_second_takes_over_after_the_silence_and_the_first_comes_back_after_the_hold_off() {
        let changes = speakers(|source, t| source == 7 || !(10.0..20.0).contains(&t), 400);
        assert_eq!(changes, [(0.0, 3), (12.0, 7), (25.0, 3)]);
    }

    #[test]
    fn a_first_that_comes_and_goes_does_not_take_the_word_back() {
        // Three seconds on, three off, from 10 s on.
        let flaps = |source: u16, t: f64| source == 7 || t < 10.0 || (t as i64 / 3) % 2 == 0;
        let changes = speakers(flaps, 600);
        assert_eq!(changes.len(), 2, "{changes:?}");
    }

    #[test]
    fn where_the_first_never_comes_the_second_speaks_after_the_silence() {
        assert_eq!(speakers(|source, _| source == 7, 100), [(2.1, 7)]);
    }

    #[test]
    fn without_fail_over_only_the_first_counts() {
        let mut arbiter = Arbiter::new([3, 7].into_iter());
        assert_eq!(arbiter.hear(7, UtcNs(0), None), Word::HasNot);
        assert_eq!(arbiter.hear(3, UtcNs(0).plus_s(99.0), None), Word::Has);
        assert_eq!(arbiter.hear(5, UtcNs(0), RULE), Word::HasNot);
    }
}

//! Selects the active source of a quantity from the arrivals of all candidates.
//!
//! Sources rank in the order of the configuration file. The best source that is not silent is active. A lower-ranked source takes
//! over after a configured silence of all better sources. A better source takes back after it has delivered without such a silence
//! for a configured time. Without failover only the first source is used.
//!
//! An open source is a source that may provide the quantity but is not configured to. It ranks from its first sample on.

use echotank_config::spec::FailoverSpec;
use echotank_core::time::{NS_PER_S, UtcNs};

/// Whether a sample comes from the active source.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Verdict {
    /// The source is active.
    Active,
    /// The source is active, and no source was active before.
    First,
    /// The source becomes active. Its samples do not continue those of the previous source.
    TakesOver,
    /// The source is not active.
    Inactive,
}

#[derive(Clone, Copy, Debug)]
struct Candidate {
    source: u16,
    /// True for an open source until its first sample.
    is_open: bool,
    last: Option<UtcNs>,
    /// Arrival from which the source has delivered without a silence.
    since: UtcNs,
}

#[derive(Clone, Debug, Default)]
pub(crate) struct Arbiter {
    /// Candidates by rank, best first.
    candidates: Vec<Candidate>,
    active: Option<usize>,
    /// Arrival of the first sample of any candidate.
    first_arrival: Option<UtcNs>,
}

impl Arbiter {
    /// `sources` gives the index of each source, and whether the source is open.
    pub(super) fn new(sources: impl Iterator<Item = (u16, bool)>) -> Self {
        let candidate = |(source, is_open)| Candidate {
            source,
            is_open,
            last: None,
            since: UtcNs(0),
        };
        Self {
            candidates: sources.map(candidate).collect(),
            active: None,
            first_arrival: None,
        }
    }

    /// The active source. Before the first sample: the best source that is not open.
    pub(super) fn source(&self) -> Option<u16> {
        let active = self.active.and_then(|active| self.candidates.get(active));
        let first = || self.candidates.iter().find(|c| !c.is_open);
        active.or_else(first).map(|c| c.source)
    }

    pub(super) fn receive(
        &mut self,
        source: u16,
        arrival: UtcNs,
        rule: Option<FailoverSpec>,
    ) -> Verdict {
        let Some(who) = self.candidates.iter().position(|c| c.source == source) else {
            return Verdict::Inactive;
        };
        self.candidates[who].is_open = false;
        let Some(rule) = rule else {
            return match self.candidates[..who].iter().all(|c| c.is_open) {
                true => self.activate(who),
                false => Verdict::Inactive,
            };
        };
        let silence_ns = (rule.after_s * NS_PER_S as f64) as i64;
        let hold_off_ns = (rule.hold_off_s * NS_PER_S as f64) as i64;
        let since = |from: UtcNs| arrival.0.saturating_sub(from.0);
        let first_arrival = *self.first_arrival.get_or_insert(arrival);
        let candidate = &mut self.candidates[who];
        if candidate.last.is_none_or(|last| since(last) > silence_ns) {
            candidate.since = arrival;
        }
        candidate.last = Some(candidate.last.map_or(arrival, |last| last.max(arrival)));
        let steady_ns = since(candidate.since);
        let silent =
            |c: &Candidate| c.is_open || since(c.last.unwrap_or(first_arrival)) > silence_ns;
        let takes_over = match self.active {
            Some(active) if who == active => return Verdict::Active,
            Some(active) if who < active => {
                steady_ns >= hold_off_ns || silent(&self.candidates[active])
            }
            _ => self.candidates[..who].iter().all(silent),
        };
        match takes_over {
            true => self.activate(who),
            false => Verdict::Inactive,
        }
    }

    fn activate(&mut self, who: usize) -> Verdict {
        match self.active.replace(who) {
            None => Verdict::First,
            Some(before) if before == who => Verdict::Active,
            Some(_) => Verdict::TakesOver,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const RULE: Option<FailoverSpec> = Some(FailoverSpec {
        after_s: 2.0,
        hold_off_s: 5.0,
    });

    /// Changes of the active source at steps of 0.1 s. `comes(source, t)` tells whether the source sends at `t`.
    fn changes_of_source(comes: fn(u16, f64) -> bool, until: i32) -> Vec<(f64, u16)> {
        let mut arbiter = Arbiter::new([(3, false), (7, false)].into_iter());
        let mut changes = Vec::new();
        for i in 0..until {
            let t = f64::from(i) / 10.0;
            for source in [7, 3] {
                if comes(source, t) {
                    let verdict = arbiter.receive(source, UtcNs(0).plus_s(t), RULE);
                    let is_active = verdict != Verdict::Inactive;
                    if is_active && changes.last().is_none_or(|(_, s)| *s != source) {
                        assert_eq!(verdict == Verdict::TakesOver, !changes.is_empty());
                        changes.push((t, source));
                    }
                }
            }
        }
        changes
    }

    #[test]
    fn fails_over_after_the_silence_and_back_after_the_hold_off() {
        let changes = changes_of_source(|source, t| source == 7 || !(10.0..20.0).contains(&t), 400);
        assert_eq!(changes, [(0.0, 3), (12.0, 7), (25.0, 3)]);
    }

    #[test]
    fn an_intermittent_first_source_does_not_take_back() {
        // The source alternates every three seconds from 10 s on.
        let flaps = |source: u16, t: f64| source == 7 || t < 10.0 || (t as i64 / 3) % 2 == 0;
        let changes = changes_of_source(flaps, 600);
        assert_eq!(changes.len(), 2, "{changes:?}");
    }

    #[test]
    fn fails_over_if_the_first_source_never_arrives() {
        assert_eq!(changes_of_source(|source, _| source == 7, 100), [(2.1, 7)]);
    }

    #[test]
    fn without_failover_only_the_first_source_is_active() {
        let mut arbiter = Arbiter::new([(3, false), (7, true)].into_iter());
        let mut receive = |source, t| arbiter.receive(source, UtcNs(0).plus_s(t), None);
        assert_eq!(receive(7, 0.0), Verdict::Inactive);
        assert_eq!(receive(3, 99.0), Verdict::First);
        assert_eq!(receive(3, 99.1), Verdict::Active);
        assert_eq!(arbiter.receive(5, UtcNs(0), RULE), Verdict::Inactive);
    }

    #[test]
    fn a_source_that_only_may_provide_ranks_from_its_first_sample_on() {
        let mut arbiter = Arbiter::new([(3, true), (7, true)].into_iter());
        assert_eq!(arbiter.source(), None);
        let mut receive = |source, t| arbiter.receive(source, UtcNs(0).plus_s(t), None);
        assert_eq!(receive(7, 0.0), Verdict::First);
        assert_eq!(receive(3, 1.0), Verdict::TakesOver);
        assert_eq!(receive(7, 60.0), Verdict::Inactive);
        assert_eq!(arbiter.source(), Some(3));
        let mut arbiter = Arbiter::new([(3, true), (7, false)].into_iter());
        assert_eq!(arbiter.source(), Some(7));
        assert_eq!(arbiter.receive(7, UtcNs(0), RULE), Verdict::First);
    }
}

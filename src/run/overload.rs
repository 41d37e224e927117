//! When pings are too much for the machine: how long they take, whether the next will be ready in time, and what is then done.
//!
//! `run.overload` chooses. `skip`: a ping that cannot be ready by its deadline is not made. `stretch`: the next pulse waits until its ping can be,
//! so the interval is lengthened. `degrade`: the ping is made with a looser tolerance ([`Ladder`]). Whatever is chosen, a ping that cannot be
//! ready even so is skipped rather than late, and every single one is counted and has a line in `overload-*.jsonl`. Where time is the
//! pipeline's own nothing is late, and none of this happens: the bits stay the same.

use std::collections::VecDeque;
use std::sync::atomic::{AtomicI64, AtomicU64, Ordering::Relaxed};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use serde::Serialize;

use crate::config::spec::SonarSpec;

/// Pings of which the quickest tells what one costs: a single slow one is the machine's hiccup, three in a row are a cost.
const REMEMBERED: usize = 3;
/// After a ping was skipped for its cost, it is believed to cost so much less: it must be tried again some time.
const FORGIVEN: f64 = 0.8;
/// A cheaper setting that has not been tried is believed to cost this share of the one before.
const CHEAPER: f64 = 0.6;
/// The loosest tolerance a ladder goes to: the loosest there is.
const LOOSEST: f64 = 0.1;
/// Pings in time before a finer setting is tried again ...
const GOOD_PINGS: u32 = 20;
/// ... and at most, where finer ones have failed again and again.
const MOST_GOOD_PINGS: u32 = 1280;
/// A finer setting that had to be left before so many pings was taken too early.
const REGRETTED: u32 = 100;
/// A finer setting is tried where there is so many times its cost until the deadline.
const ROOM: f64 = 1.5;
/// Lines that wait to be written down; what is beyond is only counted.
const MOST_LINES: usize = 4096;

/// The next cheaper setting: the tolerance of engines that are made for one; none where it is the loosest.
pub fn cheaper(tolerance: f64) -> Option<f64> {
    (tolerance < LOOSEST).then_some((tolerance * 10.0).min(LOOSEST))
}

/// Tolerances from the configured one on, each the next cheaper; one alone where the synthesis knows none.
pub fn tolerances(spec: &SonarSpec) -> Vec<f64> {
    let first = spec.synthesis.tolerance;
    if !spec.model.synthesis.keeps_tolerance() {
        return vec![first];
    }
    std::iter::successors(Some(first), |t| cheaper(*t)).collect()
}

/// What a ping has cost lately, nanoseconds of computing.
#[derive(Clone, Debug, Default)]
pub struct Cost {
    took_ns: VecDeque<i64>,
}

impl Cost {
    pub fn note(&mut self, took_ns: i64) {
        if self.took_ns.len() == REMEMBERED {
            self.took_ns.pop_front();
        }
        self.took_ns.push_back(took_ns);
    }

    /// None before the first ping.
    pub fn ns(&self) -> Option<i64> {
        self.took_ns.iter().min().copied()
    }

    /// A ping was skipped for what it would cost.
    pub fn forgive(&mut self) {
        if let Some(ns) = self.ns() {
            self.note((ns as f64 * FORGIVEN) as i64);
        }
    }
}

/// Which setting the next ping has: down at once when it could not be ready, up again after so many that were, and more patiently each time that
/// was too early.
#[derive(Clone, Debug)]
pub struct Ladder {
    costs: Vec<Cost>,
    rung: usize,
    good: u32,
    wanted_good: u32,
    /// Pings since the last step to a finer setting, while it may be regretted.
    tried: Option<u32>,
}

impl Ladder {
    /// `rungs`: settings, at least one, the finest first.
    pub fn new(rungs: usize) -> Self {
        Self {
            costs: vec![Cost::default(); rungs.max(1)],
            rung: 0,
            good: 0,
            wanted_good: GOOD_PINGS,
            tried: None,
        }
    }

    /// What a ping on a rung will cost, as far as is known.
    fn cost_ns(&self, rung: usize) -> i64 {
        let known = self.costs[..=rung].iter().enumerate().rev();
        let mut known = known.filter_map(|(at, cost)| Some((at, cost.ns()?)));
        known.next().map_or(0, |(at, ns)| {
            (ns as f64 * CHEAPER.powi((rung - at) as i32)) as i64
        })
    }

    /// The rung of a ping that must be ready within `left_ns`; none where it could be on no rung.
    pub fn choose(&mut self, left_ns: i64) -> Option<usize> {
        if self.good >= self.wanted_good
            && let Some(finer) = self.rung.checked_sub(1)
        {
            self.good = 0;
            if self.cost_ns(finer) as f64 * ROOM <= left_ns as f64 {
                (self.rung, self.tried) = (finer, Some(0));
            } else {
                // It was that dear when the load was another: some time it is tried.
                self.costs[finer].forgive();
            }
        }
        let before = self.rung;
        while self.cost_ns(self.rung) > left_ns {
            if self.rung + 1 == self.costs.len() {
                self.costs.iter_mut().for_each(Cost::forgive);
                return None;
            }
            self.rung += 1;
        }
        if self.rung > before {
            self.good = 0;
            if self.tried.take().is_some() {
                self.wanted_good = (2 * self.wanted_good).min(MOST_GOOD_PINGS);
            }
        }
        Some(self.rung)
    }

    /// A ping on the chosen rung took so long, and was ready in time or not.
    pub fn note(&mut self, took_ns: i64, in_time: bool) {
        self.costs[self.rung].note(took_ns);
        match in_time {
            true => self.good = self.good.saturating_add(1),
            false => self.good = 0,
        }
        self.tried = self.tried.map(|pings| pings + 1);
        if self.tried == Some(REGRETTED) {
            (self.tried, self.wanted_good) = (None, GOOD_PINGS);
        }
    }

    /// Of the rung in use.
    pub fn now_ns(&self) -> i64 {
        self.cost_ns(self.rung)
    }
}

/// What the beat knows of the pipeline: how much lies before it. One per rig.
#[derive(Debug, Default)]
pub struct Backlog {
    sonars: Vec<Work>,
}

/// Of one sonar.
#[derive(Debug, Default)]
struct Work {
    /// Pings ordered and neither made nor skipped.
    ordered: AtomicU64,
    cost_ns: AtomicI64,
}

impl Backlog {
    pub fn new(sonars: usize) -> Self {
        Self {
            sonars: (0..sonars).map(|_| Work::default()).collect(),
        }
    }

    pub fn ordered(&self, sonar: usize) {
        self.sonars[sonar].ordered.fetch_add(1, Relaxed);
    }

    pub fn done(&self, sonar: usize) {
        let less = |n: u64| Some(n.saturating_sub(1));
        let _ = self.sonars[sonar]
            .ordered
            .fetch_update(Relaxed, Relaxed, less);
    }

    pub fn costs(&self, sonar: usize, ns: i64) {
        self.sonars[sonar].cost_ns.store(ns, Relaxed);
    }

    /// When a ping of this sonar would be ready if it were ordered now, behind all the others.
    pub fn ready_ns(&self, sonar: usize, now_ns: i64) -> i64 {
        let work = self.sonars.iter();
        let before: i64 = work
            .map(|w| w.cost_ns.load(Relaxed) * w.ordered.load(Relaxed) as i64)
            .sum();
        now_ns + before + self.sonars[sonar].cost_ns.load(Relaxed)
    }
}

/// One ping that was not as it should have been. A line of `overload-*.jsonl`.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Strain {
    /// `skipped`, `stretched`, `degraded`, `missed` (delivered after its deadline).
    pub what: &'static str,
    #[serde(serialize_with = "as_text")]
    pub sonar: Arc<str>,
    pub ping_number: u32,
    /// Of the pulse, rig time.
    pub utc_ns: i64,
    /// How much later the pulse went out.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub stretched_ms: Option<f64>,
    /// What its samples kept to.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub tolerance: Option<f64>,
}

fn as_text<S: serde::Serializer>(name: &Arc<str>, serializer: S) -> Result<S::Ok, S::Error> {
    serializer.serialize_str(name)
}

/// Strains on their way to the file.
#[derive(Debug, Default)]
pub struct StrainLog {
    waiting: Mutex<VecDeque<Strain>>,
}

impl StrainLog {
    pub fn note(&self, strain: Strain) {
        let mut waiting = self.lock();
        if waiting.len() < MOST_LINES {
            waiting.push_back(strain);
        }
    }

    /// What was noted since this was last asked.
    pub fn take(&self) -> Vec<Strain> {
        self.lock().drain(..).collect()
    }

    fn lock(&self) -> MutexGuard<'_, VecDeque<Strain>> {
        self.waiting.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const MS: i64 = 1_000_000;

    #[test]
    fn one_slow_ping_is_no_cost_and_three_are() {
        let mut cost = Cost::default();
        assert_eq!(cost.ns(), None);
        for (took, want) in [(10, 10), (500, 10), (12, 10), (11, 11), (90, 11), (80, 11), (95, 80)] {
            cost.note(took * MS);
            assert_eq!(cost.ns(), Some(want * MS), "after {took}");
        }
        for _ in 0..20 {
            cost.forgive();
        }
        assert!(cost.ns() < Some(10 * MS), "what was skipped is tried again");
    }

    #[test]
    fn a_ladder_of_tolerances_ends_at_the_loosest() {
        let of = |first| std::iter::successors(Some(first), |t| cheaper(*t)).count();
        assert_eq!((of(1e-3), of(5e-3), of(0.1)), (3, 3, 1));
        assert_eq!(cheaper(0.05), Some(0.1));
    }

    /// Pings that take 90 ms on the finest rung, 60 on the next, 20 on the loosest, every 50 ms, each of which may be 100 ms late.
    fn rungs(pings: usize, least_ms: impl Fn(usize) -> i64) -> Vec<Option<usize>> {
        let mut ladder = Ladder::new(3);
        let mut free_ms = 0;
        (0..pings as i64)
            .map(|k| {
                let (due, now) = (k * 50, free_ms.max(k * 50));
                let rung = ladder.choose((due + 100 - now) * MS)?;
                let took = [90, 60, 20][rung].min(least_ms(k as usize));
                free_ms = now + took;
                ladder.note(took * MS, free_ms <= due + 100);
                Some(rung)
            })
            .collect()
    }

    #[test]
    fn under_load_pings_are_made_cheaper_and_none_is_skipped() {
        let rungs = rungs(400, |_| 1000);
        assert!(rungs.iter().all(Option::is_some), "{rungs:?}");
        // Two thirds on the loosest keep up; finer ones come only after twenty good ones.
        assert!(rungs[10..].iter().filter(|r| **r == Some(2)).count() > 200);
        let finer = rungs.windows(2).filter(|w| w[1] < w[0]).count();
        assert!(finer <= 400 / 20, "{finer} times up");
    }

    #[test]
    fn when_the_load_is_gone_the_finest_comes_back_and_stays() {
        let rungs = rungs(700, |k| if k < 50 { 1000 } else { 5 });
        assert_eq!(rungs[49], Some(2), "{rungs:?}");
        assert!(rungs[600..].iter().all(|r| *r == Some(0)), "{rungs:?}");
    }

    #[test]
    fn what_is_too_much_on_every_rung_is_skipped_and_tried_again() {
        let mut ladder = Ladder::new(2);
        let mut made = 0;
        for _ in 0..100 {
            if ladder.choose(10 * MS).is_some() {
                ladder.note(50 * MS, false);
                made += 1;
            }
        }
        assert!((3..40).contains(&made), "{made}");
    }

    #[test]
    fn the_backlog_says_when_a_ping_would_be_ready() {
        let backlog = Backlog::new(2);
        assert_eq!(backlog.ready_ns(0, 5), 5);
        backlog.costs(0, 10);
        backlog.costs(1, 100);
        for sonar in [0, 0, 1] {
            backlog.ordered(sonar);
        }
        assert_eq!(backlog.ready_ns(0, 5), 5 + 20 + 100 + 10);
        backlog.done(1);
        backlog.done(1);
        assert_eq!(backlog.ready_ns(1, 5), 5 + 20 + 100);
    }
}

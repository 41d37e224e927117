//! When pings are too much for the machine: what one costs, whether the next can be ready in time, and what is then done (`run.overload`).
//!
//! `skip`: a ping that had to wait for others and cannot be ready by its instant any more is not made. `degrade`: it is made with a looser
//! tolerance ([`DegradationLevels`]). `stretch`: the next pulse waits until its ping can be ready ([`Backlog`]), so that the rate falls to what can be
//! kept. Whatever is chosen, what cannot be ready even so is skipped. A ping that waited for no other is made, late or not: skipping it would
//! help nobody, and it tells what pings cost; so is one whose sonar's last was skipped.
//!
//! Every decision rests on how long pings took: under overload which pings are made, when, and with which tolerance depends on the machine,
//! and each that differs says so ([`echotank_core::flow::OverloadState`]). Where pings keep up nothing is decided here, and where time is the pipeline's own
//! nothing is ever late: the bits stay the same.

use std::sync::atomic::{AtomicI64, AtomicU64, Ordering::Relaxed};
use std::sync::{Mutex, MutexGuard, PoisonError};

use serde::Serialize;

/// Pings whose median is what one costs: two slow ones in a row are the machine's hiccup, three of five are a cost.
const REMEMBERED: usize = 5;
/// After a finer setting was found too dear without being tried, it is believed to cost so much less: it must be tried again some time.
const FORGIVEN: f64 = 0.8;
/// A looser setting that has not been tried is believed to cost this share of the one before.
const CHEAPER: f64 = 0.6;
/// Pings in time before a finer setting is tried again, ...
const GOOD_PINGS: u32 = 20;
/// ... and at most, where finer ones have failed again and again: a minute at 20 pings a second.
const MAX_GOOD_PINGS: u32 = 1280;
/// A finer setting that had to be left before so many pings was taken too early.
const REGRETTED: u32 = 100;
/// A finer setting is tried where there is so many times its cost until the ping must be ready.
const ROOM: f64 = 1.5;
/// A pulse goes out where so many times what must be computed before its ping fits: costs scatter.
const RESERVE: f64 = 1.25;
/// Lines that wait to be written down; what is beyond is only counted.
const MAX_LINES: usize = 4096;

/// What a ping has cost lately, nanoseconds of rig time.
#[derive(Clone, Debug, Default)]
pub struct Cost {
    took_ns: [i64; REMEMBERED],
    count: usize,
    /// The first ping fills buffers and says nothing of the others.
    is_warm: bool,
}

impl Cost {
    pub fn note(&mut self, took_ns: i64) {
        if std::mem::replace(&mut self.is_warm, true) {
            self.took_ns[self.count % REMEMBERED] = took_ns;
            self.count += 1;
        }
    }

    /// The median; none before the second ping.
    pub fn ns(&self) -> Option<i64> {
        let mut known = self.took_ns;
        let known = &mut known[..self.count.min(REMEMBERED)];
        known.sort_unstable();
        known.get(known.len().saturating_sub(1) / 2).copied()
    }

    fn forgive(&mut self) {
        for ns in &mut self.took_ns {
            *ns = (*ns as f64 * FORGIVEN) as i64;
        }
    }
}

/// Which setting the next ping has: down at once when it could not be ready, up again after so many that were, and more patiently each time
/// that was too early.
#[derive(Clone, Debug)]
pub(crate) struct DegradationLevels {
    costs: Vec<Cost>,
    level: usize,
    good: u32,
    wanted_good: u32,
    /// Pings since the last step to a finer setting, while it may be regretted.
    tried: Option<u32>,
}

impl DegradationLevels {
    /// `levels`: settings, the finest first.
    pub(crate) fn new(levels: usize) -> Self {
        Self {
            costs: vec![Cost::default(); levels.max(1)],
            level: 0,
            good: 0,
            wanted_good: GOOD_PINGS,
            tried: None,
        }
    }

    /// What a ping on a level will cost, as far as is known.
    fn cost_ns(&self, level: usize) -> i64 {
        let known = self.costs[..=level].iter().enumerate().rev();
        let mut known = known.filter_map(|(at, cost)| Some((at, cost.ns()?)));
        known.next().map_or(0, |(at, ns)| {
            (ns as f64 * CHEAPER.powi((level - at) as i32)) as i64
        })
    }

    /// The level of a ping that must be ready within `left_ns`; none where no level is quick enough, and it `waited` for another ping.
    pub(crate) fn choose(&mut self, left_ns: i64, waited: bool) -> Option<usize> {
        self.consider_finer(left_ns);
        let loosest = self.costs.len() - 1;
        let fits = (self.level..=loosest).find(|&level| self.cost_ns(level) <= left_ns);
        let level = fits.or((!waited).then_some(loosest))?;
        if level > self.level {
            self.good = 0;
            if self.tried.take().is_some() {
                self.wanted_good = (2 * self.wanted_good).min(MAX_GOOD_PINGS);
            }
        }
        self.level = level;
        Some(level)
    }

    fn consider_finer(&mut self, left_ns: i64) {
        let Some(finer) = self.level.checked_sub(1) else {
            return;
        };
        if self.good < self.wanted_good {
            return;
        }
        self.good = 0;
        if self.cost_ns(finer) as f64 * ROOM <= left_ns as f64 {
            (self.level, self.tried) = (finer, Some(0));
        } else {
            // It was that dear under another load.
            self.costs[finer].forgive();
        }
    }

    /// A ping on the chosen level took so long, and was ready in time or not.
    pub(crate) fn note(&mut self, took_ns: i64, in_time: bool) {
        self.costs[self.level].note(took_ns);
        self.good = match in_time {
            true => self.good.saturating_add(1),
            false => 0,
        };
        self.tried = self.tried.map(|pings| pings + 1);
        if self.tried == Some(REGRETTED) {
            (self.tried, self.wanted_good) = (None, GOOD_PINGS);
        }
    }

    /// What the next ping will cost.
    pub(crate) fn now_ns(&self) -> i64 {
        self.cost_ns(self.level)
    }
}

/// What the beat knows of the pipeline: how much is ordered and not yet made. One per rig.
#[derive(Debug, Default)]
pub(crate) struct Backlog {
    sonars: Vec<Work>,
    /// When the ping that is being made was begun, ns of the rig's clock; 0: none is.
    began_ns: AtomicI64,
}

/// Of one sonar.
#[derive(Debug, Default)]
struct Work {
    /// Pings ordered and neither made nor skipped.
    ordered: AtomicU64,
    cost_ns: AtomicI64,
}

impl Backlog {
    pub(crate) fn new(sonars: usize) -> Self {
        Self {
            sonars: (0..sonars).map(|_| Work::default()).collect(),
            began_ns: AtomicI64::new(0),
        }
    }

    pub(crate) fn ordered(&self, sonar: usize) {
        self.sonars[sonar].ordered.fetch_add(1, Relaxed);
    }

    pub(crate) fn begun(&self, now_ns: i64) {
        self.began_ns.store(now_ns, Relaxed);
    }

    /// An order was obeyed or dropped.
    pub(crate) fn done(&self, sonar: usize) {
        self.began_ns.store(0, Relaxed);
        let less = |n: u64| Some(n.saturating_sub(1));
        let ordered = &self.sonars[sonar].ordered;
        let _ = ordered.fetch_update(Relaxed, Relaxed, less);
    }

    pub(crate) fn costs(&self, sonar: usize, ns: i64) {
        self.sonars[sonar].cost_ns.store(ns, Relaxed);
    }

    /// How much later a pulse of this sonar must be for its ping to be ready in time, where it would now have to be ready by `ready_by_ns`, ns.
    /// Never later than the pipeline is free: waiting longer helps nobody.
    pub(crate) fn put_off_ns(&self, sonar: usize, now_ns: i64, ready_by_ns: i64) -> i64 {
        let dear = |ns: i64| (ns as f64 * RESERVE) as i64;
        let load = |w: &Work| w.cost_ns.load(Relaxed) * w.ordered.load(Relaxed) as i64;
        let before: i64 = self.sonars.iter().map(load).sum();
        let gone = match self.began_ns.load(Relaxed) {
            0 => 0,
            began => (now_ns - began).max(0),
        };
        let before = (before - gone).max(0);
        let ready_ns = now_ns + dear(before + self.sonars[sonar].cost_ns.load(Relaxed));
        (ready_ns - ready_by_ns).clamp(0, dear(before))
    }
}

/// One ping that was not as it should have been. A line of `overload-*.jsonl`, which `run` writes where `run.fault_directory` says, and with
/// `degrade` and `stretch` beside the records.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub(crate) struct OverloadRecord {
    /// `skipped`, `degraded`, `stretched`, `truncated` (its first samples streamed and the others could not), or `late`: delivered after its instant.
    pub what: &'static str,
    pub sonar: String,
    pub ping_number: u32,
    /// Of the pulse, rig time.
    pub utc_ns: i64,
    /// That its samples kept to.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub tolerance: Option<f64>,
    /// How much later than the beat the pulse went out.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) put_off_ms: Option<f64>,
}

/// Strained pings on their way to the file.
#[derive(Debug, Default)]
pub(crate) struct OverloadLog {
    waiting: Mutex<Vec<OverloadRecord>>,
    unwritten: AtomicU64,
}

impl OverloadLog {
    pub(crate) fn note(&self, overloaded: OverloadRecord) {
        let mut waiting = self.lock();
        if waiting.len() < MAX_LINES {
            waiting.push(overloaded);
        } else {
            self.unwritten.fetch_add(1, Relaxed);
        }
    }

    /// What was noted since this was last asked.
    pub(crate) fn take(&self) -> Vec<OverloadRecord> {
        std::mem::take(&mut *self.lock())
    }

    /// Pings that the log has no line of.
    pub(crate) fn unwritten(&self) -> u64 {
        self.unwritten.load(Relaxed)
    }

    fn lock(&self) -> MutexGuard<'_, Vec<OverloadRecord>> {
        self.waiting.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const MS: i64 = 1_000_000;

    #[test]
    fn two_slow_pings_are_no_cost_and_three_of_five_are() {
        let mut cost = Cost::default();
        cost.note(9999 * MS);
        assert_eq!(cost.ns(), None, "the first fills buffers");
        for (took, want) in [(10, 10), (10, 10), (12, 10), (500, 10), (500, 12), (90, 90)] {
            cost.note(took * MS);
            assert_eq!(cost.ns(), Some(want * MS), "after {took}");
        }
        for _ in 0..20 {
            cost.forgive();
        }
        assert!(
            cost.ns() < Some(10 * MS),
            "what was too dear is tried again"
        );
    }

    /// What a machine makes of pings every 50 ms, each of which must be ready within 100 ms: the level of each, none where it was skipped.
    fn made(pings: i64, costs_ms: impl Fn(i64) -> Vec<i64>) -> (Vec<Option<usize>>, usize) {
        let mut levels = DegradationLevels::new(costs_ms(0).len());
        let (mut free_ms, mut late) = (0, 0);
        let levels = (0..pings).map(|k| {
            let (due, now) = (k * 50, free_ms.max(k * 50));
            let left_ms = due + 100 - now;
            if left_ms <= 0 {
                return None;
            }
            let level = levels.choose(left_ms * MS, now > due)?;
            let took = costs_ms(k)[level];
            free_ms = now + took;
            late += usize::from(free_ms > due + 100);
            levels.note(took * MS, free_ms <= due + 100);
            Some(level)
        });
        (levels.collect(), late)
    }

    #[test]
    fn where_pings_keep_up_nothing_is_skipped_and_nothing_loosened() {
        let (levels, late) = made(400, |k| vec![if k % 7 == 0 { 90 } else { 20 }, 15, 10]);
        assert!(levels.iter().all(|level| *level == Some(0)), "{levels:?}");
        assert_eq!(late, 0);
    }

    #[test]
    fn under_load_pings_are_made_looser_and_hardly_any_is_skipped() {
        let (levels, late) = made(400, |_| vec![90, 60, 20]);
        // It takes two to know what one costs.
        let skipped = levels.iter().filter(|level| level.is_none()).count();
        assert!(skipped <= 2 && late <= 3, "{skipped} {late}: {levels:?}");
        assert!(levels[10..].iter().filter(|r| **r == Some(2)).count() > 200);
        // Finer ones come only after twenty good ones, and less and less often.
        let finer = levels.windows(2).filter(|w| w[1] < w[0]).count();
        assert!((2..=400 / 20).contains(&finer), "{finer} times up");
    }

    #[test]
    fn when_the_load_is_gone_the_finest_comes_back_and_stays() {
        let load = |k| {
            if k < 50 {
                vec![90, 60, 20]
            } else {
                vec![9, 6, 2]
            }
        };
        let (levels, _) = made(1200, load);
        assert_eq!(levels[49], Some(2), "{levels:?}");
        assert!(levels[1000..].iter().all(|r| *r == Some(0)), "{levels:?}");
    }

    #[test]
    fn too_much_on_every_rung_is_made_in_time_as_often_as_it_can_be_and_the_rest_skipped() {
        let (levels, late) = made(400, |_| vec![80]);
        let count = levels.iter().flatten().count();
        // What has waited 30 of its 100 ms is too late: every other one.
        assert!((198..=201).contains(&count) && late <= 1, "{count} {late}");
        // What no skipping brings in time is made late all the same.
        let (levels, late) = made(400, |_| vec![180]);
        let count = levels.iter().flatten().count();
        assert!(
            count == late && (90..=112).contains(&count),
            "{count} {late}"
        );
    }

    #[test]
    fn a_pulse_waits_for_what_lies_before_it_and_no_longer() {
        let backlog = Backlog::new(2);
        let put_off = |ready_by| backlog.put_off_ns(0, 0, ready_by);
        assert_eq!(put_off(5), 0, "nothing is known");
        backlog.costs(0, 100);
        backlog.costs(1, 1000);
        assert_eq!(put_off(5), 0, "nothing lies before it: waiting is no help");
        for sonar in [0, 0, 1] {
            backlog.ordered(sonar);
        }
        // 1300 with its own, a quarter more: 1625.
        assert_eq!(put_off(1700), 0);
        assert_eq!(put_off(1600), 25);
        assert_eq!(put_off(0), 1500);
        backlog.begun(-200);
        assert_eq!(put_off(0), 1250);
        backlog.done(1);
        backlog.done(1);
        assert_eq!(put_off(0), 250);
    }

    #[test]
    fn stretched_pulses_keep_the_rate_that_the_machine_keeps() {
        // 60 ms a ping where 40 are asked for; each must be ready within 100.
        let backlog = Backlog::new(1);
        let (mut at, mut free, mut waiting) = (1, 0_i64, std::collections::VecDeque::new());
        let mut pulses = Vec::new();
        let mut late = 0;
        for now in 1..6000 {
            if let Some(due) = waiting.front().copied().filter(|_| free <= now) {
                if free > 0 && free == now {
                    backlog.done(0);
                    waiting.pop_front();
                    late += usize::from(now > due);
                    backlog.costs(0, 60);
                }
                free = 0;
                if !waiting.is_empty() {
                    backlog.begun(now);
                    free = now + 60;
                }
            }
            if now >= at {
                match backlog.put_off_ns(0, now, at + 100) {
                    0 => {
                        backlog.ordered(0);
                        waiting.push_back(at + 100);
                        pulses.push(at);
                        at += 40;
                    }
                    wait => at += wait,
                }
            }
        }
        let gaps: Vec<_> = pulses.windows(2).map(|w| w[1] - w[0]).collect();
        let mean = gaps[20..].iter().sum::<i64>() as f64 / (gaps.len() - 20) as f64;
        assert!((60.0..66.0).contains(&mean), "{mean}: {gaps:?}");
        assert_eq!(late, 0, "{gaps:?}");
    }
}

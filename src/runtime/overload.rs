//! Overload control (`run.overload`): estimates the compute time of pings and acts when the next ping cannot be ready in time.
//!
//! - `skip`: a ping that waited for another and cannot meet its deadline is not computed.
//! - `degrade`: such a ping is computed with a looser tolerance ([`DegradationLevels`]).
//! - `stretch`: the next pulse is delayed until its ping can be ready ([`Backlog`]). This lowers the ping rate to a sustainable one.
//!
//! With every policy, a ping that still cannot meet its deadline is skipped. Two pings are computed even if late: one that waited for no
//! other ping, and one whose predecessor on the same sonar was skipped. They keep the cost estimate current.
//!
//! The decisions depend on measured compute times. Under overload, the pings computed, their times and their tolerances depend on the
//! machine. Each affected ping reports this ([`echotank_core::ping::OverloadState`]). Without overload the output is deterministic, and
//! with a `fast` or `lockstep` clock no ping is late.

use std::sync::atomic::{AtomicI64, AtomicU64, Ordering::Relaxed};
use std::sync::{Mutex, MutexGuard, PoisonError};

use serde::Serialize;

/// Number of pings in the median of the cost estimate. Two slow pings in a row do not change the median; three of five do.
const MEDIAN_PINGS: usize = 5;
/// Factor on the cost estimate of a finer level that is rejected without a trial. The estimate falls until the level is tried again.
const ESTIMATE_DECAY: f64 = 0.8;
/// Assumed cost of an untried looser level, relative to the next finer one.
const CHEAPER: f64 = 0.6;
/// Number of consecutive pings in time before a finer level is tried.
const GOOD_PINGS: u32 = 20;
/// Upper bound of [`GOOD_PINGS`] after repeated failures: a minute at 20 pings a second.
const MAX_GOOD_PINGS: u32 = 1280;
/// Number of pings on a finer level after which the trial counts as a success.
const TRIAL_PINGS: u32 = 100;
/// Minimum ratio of the remaining time to the estimated cost for trying a finer level.
const TRIAL_MARGIN: f64 = 1.5;
/// Margin on the estimated cost of the backlog, because costs vary.
const BACKLOG_MARGIN: f64 = 1.25;
/// Maximum number of log records waiting to be written; further records are only counted.
const MAX_LINES: usize = 4096;

/// Recent compute times of the pings of one sonar, nanoseconds of rig time.
#[derive(Clone, Debug, Default)]
pub struct Cost {
    took_ns: [i64; MEDIAN_PINGS],
    count: usize,
    /// Whether the first ping, which allocates buffers, has been excluded.
    is_warm: bool,
}

impl Cost {
    /// Adds the compute time of one ping, nanoseconds. The first ping is ignored.
    pub fn note(&mut self, took_ns: i64) {
        if std::mem::replace(&mut self.is_warm, true) {
            self.took_ns[self.count % MEDIAN_PINGS] = took_ns;
            self.count += 1;
        }
    }

    /// The median compute time, nanoseconds; `None` before the second ping.
    pub fn ns(&self) -> Option<i64> {
        let mut known = self.took_ns;
        let known = &mut known[..self.count.min(MEDIAN_PINGS)];
        known.sort_unstable();
        known.get(known.len().saturating_sub(1) / 2).copied()
    }

    fn decay(&mut self) {
        for ns in &mut self.took_ns {
            *ns = (*ns as f64 * ESTIMATE_DECAY) as i64;
        }
    }
}

/// Selects the degradation level of the next ping.
///
/// The level becomes looser as soon as a ping would be late, and finer after a run of pings in time. Each failed trial of a finer level
/// doubles the length of that run.
#[derive(Clone, Debug)]
pub(crate) struct DegradationLevels {
    costs: Vec<Cost>,
    level: usize,
    good: u32,
    wanted_good: u32,
    /// Number of pings since the last step to a finer level, until the trial succeeds.
    tried: Option<u32>,
}

impl DegradationLevels {
    /// Creates `levels` levels; level 0 is the finest.
    pub(crate) fn new(levels: usize) -> Self {
        Self {
            costs: vec![Cost::default(); levels.max(1)],
            level: 0,
            good: 0,
            wanted_good: GOOD_PINGS,
            tried: None,
        }
    }

    /// Estimated compute time of a ping on a level, nanoseconds; 0 while unknown.
    fn cost_ns(&self, level: usize) -> i64 {
        let known = self.costs[..=level].iter().enumerate().rev();
        let mut known = known.filter_map(|(at, cost)| Some((at, cost.ns()?)));
        known.next().map_or(0, |(at, ns)| {
            (ns as f64 * CHEAPER.powi((level - at) as i32)) as i64
        })
    }

    /// Level of a ping that must be ready within `left_ns`. `None` skips a ping that `waited` for another ping and fits on no level.
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
        if self.cost_ns(finer) as f64 * TRIAL_MARGIN <= left_ns as f64 {
            (self.level, self.tried) = (finer, Some(0));
        } else {
            // The estimate was measured under another load.
            self.costs[finer].decay();
        }
    }

    /// Adds the compute time of a ping on the chosen level, and whether the ping met its deadline.
    pub(crate) fn note(&mut self, took_ns: i64, in_time: bool) {
        self.costs[self.level].note(took_ns);
        self.good = match in_time {
            true => self.good.saturating_add(1),
            false => 0,
        };
        self.tried = self.tried.map(|pings| pings + 1);
        if self.tried == Some(TRIAL_PINGS) {
            (self.tried, self.wanted_good) = (None, GOOD_PINGS);
        }
    }

    /// Estimated compute time of the next ping, nanoseconds.
    pub(crate) fn now_ns(&self) -> i64 {
        self.cost_ns(self.level)
    }
}

/// Pings that are ordered and not yet computed, with their estimated costs. One per rig.
#[derive(Debug, Default)]
pub(crate) struct Backlog {
    sonars: Vec<PendingWork>,
    /// Start of the current computation, ns of the rig's clock; 0 if idle.
    began_ns: AtomicI64,
}

/// Pending pings of one sonar.
#[derive(Debug, Default)]
struct PendingWork {
    /// Number of pings ordered and neither computed nor skipped.
    ordered: AtomicU64,
    cost_ns: AtomicI64,
}

impl Backlog {
    pub(crate) fn new(sonars: usize) -> Self {
        Self {
            sonars: (0..sonars).map(|_| PendingWork::default()).collect(),
            began_ns: AtomicI64::new(0),
        }
    }

    pub(crate) fn ordered(&self, sonar: usize) {
        self.sonars[sonar].ordered.fetch_add(1, Relaxed);
    }

    pub(crate) fn begun(&self, now_ns: i64) {
        self.began_ns.store(now_ns, Relaxed);
    }

    /// Counts an order as computed or dropped.
    pub(crate) fn done(&self, sonar: usize) {
        self.began_ns.store(0, Relaxed);
        let less = |n: u64| Some(n.saturating_sub(1));
        let ordered = &self.sonars[sonar].ordered;
        let _ = ordered.fetch_update(Relaxed, Relaxed, less);
    }

    pub(crate) fn costs(&self, sonar: usize, ns: i64) {
        self.sonars[sonar].cost_ns.store(ns, Relaxed);
    }

    /// Delay of this sonar's pulse that lets its ping meet its deadline, nanoseconds.
    ///
    /// `ready_by_ns` is the deadline without a delay. The delay never extends beyond the end of the backlog.
    pub(crate) fn put_off_ns(&self, sonar: usize, now_ns: i64, ready_by_ns: i64) -> i64 {
        let with_margin = |ns: i64| (ns as f64 * BACKLOG_MARGIN) as i64;
        let load = |w: &PendingWork| w.cost_ns.load(Relaxed) * w.ordered.load(Relaxed) as i64;
        let before: i64 = self.sonars.iter().map(load).sum();
        let gone = match self.began_ns.load(Relaxed) {
            0 => 0,
            began => (now_ns - began).max(0),
        };
        let before = (before - gone).max(0);
        let own = self.sonars[sonar].cost_ns.load(Relaxed);
        let ready_ns = now_ns + with_margin(before + own);
        (ready_ns - ready_by_ns).clamp(0, with_margin(before))
    }
}

/// One ping affected by overload: a line of `overload-*.jsonl`.
///
/// `run` writes the file to `run.fault_directory`, and with `degrade` and `stretch` also beside the recordings.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub(crate) struct OverloadRecord {
    /// `skipped`, `degraded`, `stretched`, `truncated` (only the first samples were streamed) or `late` (delivered after its deadline).
    pub what: &'static str,
    /// Configured name of the sonar.
    pub sonar: String,
    /// Number of the ping, from 1.
    pub ping_number: u32,
    /// UTC of the pulse, rig time.
    pub utc_ns: i64,
    /// Tolerance of a degraded ping.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub tolerance: Option<f64>,
    /// Delay of a stretched pulse after its scheduled instant.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) put_off_ms: Option<f64>,
}

/// Records waiting to be written to the overload log.
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

    /// Takes the records since the last call.
    pub(crate) fn take(&self) -> Vec<OverloadRecord> {
        std::mem::take(&mut *self.lock())
    }

    /// Records dropped because too many were waiting.
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
    fn two_slow_pings_do_not_change_the_median_cost_and_three_of_five_do() {
        let mut cost = Cost::default();
        cost.note(9999 * MS);
        assert_eq!(cost.ns(), None, "the first fills buffers");
        for (took, want) in [(10, 10), (10, 10), (12, 10), (500, 10), (500, 12), (90, 90)] {
            cost.note(took * MS);
            assert_eq!(cost.ns(), Some(want * MS), "after {took}");
        }
        for _ in 0..20 {
            cost.decay();
        }
        assert!(cost.ns() < Some(10 * MS), "the estimate decays");
    }

    /// Simulates pings every 50 ms with a deadline after 100 ms. Returns the level of each (`None` if skipped) and the number of late pings.
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
    fn without_overload_no_ping_is_skipped_or_degraded() {
        let (levels, late) = made(400, |k| vec![if k % 7 == 0 { 90 } else { 20 }, 15, 10]);
        assert!(levels.iter().all(|level| *level == Some(0)), "{levels:?}");
        assert_eq!(late, 0);
    }

    #[test]
    fn under_load_pings_are_degraded_and_at_most_two_are_skipped() {
        let (levels, late) = made(400, |_| vec![90, 60, 20]);
        // The first cost estimate needs two pings.
        let skipped = levels.iter().filter(|level| level.is_none()).count();
        assert!(skipped <= 2 && late <= 3, "{skipped} {late}: {levels:?}");
        assert!(levels[10..].iter().filter(|r| **r == Some(2)).count() > 200);
        // A finer level needs twenty pings in time, and more after each failure.
        let finer = levels.windows(2).filter(|w| w[1] < w[0]).count();
        assert!((2..=400 / 20).contains(&finer), "{finer} times up");
    }

    #[test]
    fn after_the_load_the_finest_level_returns_and_stays() {
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
    fn when_no_level_is_fast_enough_the_possible_pings_are_made_and_the_others_skipped() {
        let (levels, late) = made(400, |_| vec![80]);
        let count = levels.iter().flatten().count();
        // A ping that has waited 30 of its 100 ms is too late, so every other one is skipped.
        assert!((198..=201).contains(&count) && late <= 1, "{count} {late}");
        // If skipping does not help, pings are made late.
        let (levels, late) = made(400, |_| vec![180]);
        let count = levels.iter().flatten().count();
        assert!(
            count == late && (90..=112).contains(&count),
            "{count} {late}"
        );
    }

    #[test]
    fn a_pulse_waits_for_the_backlog_and_no_longer() {
        let backlog = Backlog::new(2);
        let put_off = |ready_by| backlog.put_off_ns(0, 0, ready_by);
        assert_eq!(put_off(5), 0, "no cost is known");
        backlog.costs(0, 100);
        backlog.costs(1, 1000);
        assert_eq!(put_off(5), 0, "the backlog is empty: waiting is no help");
        for sonar in [0, 0, 1] {
            backlog.ordered(sonar);
        }
        // 1300 with its own cost, plus 25 %: 1625.
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
    fn stretching_lowers_the_rate_to_the_compute_rate() {
        // A ping takes 60 ms, the requested period is 40 ms, and the deadline is after 100 ms.
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

//! Passes of a log: the parts between backward steps of its clock.
//!
//! A file can hold several runs in sequence, or a source whose clock was wrong for a time. The passes are played in file order,
//! each once:
//!
//! - A pass keeps its times if they follow those of the previous pass. The time between both passes is a gap.
//! - If a later pass continues the current pass, the clock was wrong in the passes between them. Those passes are shifted into the
//!   gap.
//! - Any other pass starts one step after the previous pass, with its times shifted.
//!
//! Passes of a stamped log that do not overlap keep their stamps. A log with parts in the wrong order is thus played by its stamps.

use super::decoder::{ClockEvent, ClockState};
use echotank_core::navigation::NavSample;
use echotank_core::time::{NS_PER_S, UtcNs};

/// Maximum time that a clock may lose in a wrong period, besides the length of the wrong passes.
const RETURN_TOLERANCE_NS: i64 = 10 * NS_PER_S;
/// Maximum step forward in a shifted pass. A longer step begins another pass.
const MAX_GAP_NS: i64 = 600 * NS_PER_S;
/// Step between two passes if the log shows none.
const DEFAULT_STEP_NS: i64 = NS_PER_S;

/// The start of a pass in a file.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(crate) struct Cut {
    /// Index of the first sample of the pass.
    pub(crate) sample: usize,
    /// Line at which the pass begins, from 1.
    pub(crate) line: u64,
}

/// Time base with which a pass is played.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum PassKind {
    /// The pass has its own times.
    Own,
    /// The times are shifted so that the pass follows the previous pass.
    Shifted,
    /// The clock was wrong, and the times are shifted into the gap between two passes.
    WrongClock,
}

/// Part of a log between two backward steps of its clock.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Pass {
    /// Line of the file at which the pass begins, from 1.
    pub line: u64,
    /// First time of validity in the file.
    pub first: UtcNs,
    /// Last time of validity in the file.
    pub last: UtcNs,
    /// Shift added to the times, nanoseconds.
    pub shift_ns: i64,
    /// Time base with which the pass is played.
    pub kind: PassKind,
}

impl Pass {
    /// First time of validity as played.
    pub fn start(&self) -> UtcNs {
        self.first.plus_ns(self.shift_ns)
    }

    fn end(&self) -> UtcNs {
        self.last.plus_ns(self.shift_ns)
    }

    fn length_ns(&self) -> i64 {
        self.last.0.saturating_sub(self.first.0)
    }
}

/// Shifts the samples of every pass to the time at which it is played, and returns the passes. Empty if all passes keep their times
/// and order.
///
/// `samples` are in file order. `stamped` is true if the arrivals are stamps of a recorder; otherwise the clock changes in `events`
/// are replaced by those of the passes.
pub(crate) fn place(
    samples: &mut [NavSample],
    cuts: &[Cut],
    stamped: bool,
    events: &mut Vec<ClockEvent>,
) -> Vec<Pass> {
    let ends = cuts.iter().skip(1).map(|cut| cut.sample);
    let ends = ends.chain([samples.len()]);
    let ranges = cuts.iter().zip(ends);
    let ranges: Vec<_> = ranges
        .filter(|(cut, end)| cut.sample < *end)
        .map(|(cut, end)| (cut.line, cut.sample..end))
        .collect();
    let mut passes: Vec<Pass> = ranges
        .iter()
        .filter_map(|(line, range)| {
            let times = samples[range.clone()].iter().map(|s| s.valid_utc);
            Some(Pass {
                line: *line,
                first: times.clone().min()?,
                last: times.max()?,
                shift_ns: 0,
                kind: PassKind::Own,
            })
        })
        .collect();
    if stamped && !overlap(&passes) {
        return Vec::new();
    }
    let mut placed = 0;
    while placed + 1 < passes.len() {
        let next = returns(&passes, placed).unwrap_or(placed + 1);
        let step_ns = last_step_ns(&samples[ranges[placed].1.clone()]);
        if next > placed + 1 {
            // The wrong passes are spaced evenly in the gap.
            let wrong = placed + 1..next;
            let length_ns: i64 = passes[wrong.clone()].iter().map(Pass::length_ns).sum();
            let room_ns = passes[next].first.0 - passes[placed].last.0 - length_ns;
            let step_ns = room_ns / (next - placed) as i64;
            for k in wrong {
                follow(&mut passes, k, step_ns, PassKind::WrongClock);
            }
            keep_shift(&mut passes, placed, next);
        } else if passes[next].first <= passes[placed].end() {
            let forward_ns = passes[next].first.0 - passes[placed].last.0;
            match (1..=MAX_GAP_NS).contains(&forward_ns) {
                true => keep_shift(&mut passes, placed, next),
                false => follow(&mut passes, next, step_ns, PassKind::Shifted),
            }
        }
        placed = next;
    }
    for (pass, (_, range)) in passes.iter().zip(&ranges) {
        for sample in &mut samples[range.clone()] {
            sample.valid_utc = sample.valid_utc.plus_ns(pass.shift_ns);
            sample.arrival_utc = sample.arrival_utc.plus_ns(pass.shift_ns);
        }
    }
    if !stamped {
        // The events of the decoder refer to the times of the file. They are replaced by events at the shifted times.
        events.clear();
        let mut before = ClockState::Right;
        for pass in &passes {
            let state = match pass.kind {
                PassKind::WrongClock => ClockState::Corrected {
                    by_s: pass.shift_ns / NS_PER_S,
                },
                PassKind::Own | PassKind::Shifted => ClockState::Right,
            };
            if state != before {
                let arrival = pass.start();
                events.push(ClockEvent { arrival, state });
            }
            before = state;
        }
    }
    passes
}

/// Pass `next` continues pass `placed` and has the same shift.
fn keep_shift(passes: &mut [Pass], placed: usize, next: usize) {
    (passes[next].shift_ns, passes[next].kind) = (passes[placed].shift_ns, passes[placed].kind);
}

/// Places pass `k` one step after the previous pass.
fn follow(passes: &mut [Pass], k: usize, step_ns: i64, kind: PassKind) {
    let start = passes[k - 1].end().plus_ns(step_ns);
    passes[k].shift_ns = start.0.saturating_sub(passes[k].first.0);
    passes[k].kind = kind;
}

/// The first later pass that continues pass `k`: the gap between them has the length of the passes between, within the tolerance.
fn returns(passes: &[Pass], k: usize) -> Option<usize> {
    let end = passes[k].last;
    let mut between_ns = 0_i64;
    for (next, pass) in passes.iter().enumerate().skip(k + 1) {
        let gap_ns = pass.first.0.saturating_sub(end.0);
        let room_ns = gap_ns.saturating_sub(between_ns);
        if gap_ns > 0 && (0..=RETURN_TOLERANCE_NS).contains(&room_ns) {
            return Some(next);
        }
        between_ns = between_ns.saturating_add(pass.length_ns());
    }
    None
}

fn overlap(passes: &[Pass]) -> bool {
    let mut spans: Vec<_> = passes.iter().map(|p| (p.first, p.last)).collect();
    spans.sort();
    spans.windows(2).any(|w| w[1].0 <= w[0].1)
}

/// Step between the last two different times of validity.
fn last_step_ns(samples: &[NavSample]) -> i64 {
    let last = samples.iter().map(|s| s.valid_utc).max();
    let before = samples
        .iter()
        .map(|s| s.valid_utc)
        .filter(|utc| Some(*utc) < last)
        .max();
    last.zip(before)
        .map_or(DEFAULT_STEP_NS, |(last, before)| last.0 - before.0)
}

#[cfg(test)]
mod tests {
    use super::*;
    use echotank_core::navigation::NavQuantity;

    /// A sample every second from each start, for the corresponding entry of `lengths_s`.
    fn passes(starts_s: &[i64], lengths_s: &[i64], stamped: bool) -> (Vec<i64>, Vec<PassKind>) {
        let (mut samples, mut cuts) = (Vec::new(), Vec::new());
        for (start_s, length_s) in starts_s.iter().zip(lengths_s) {
            cuts.push(Cut {
                sample: samples.len(),
                line: samples.len() as u64,
            });
            samples.extend((0..*length_s).map(|k| {
                let utc = UtcNs((start_s + k) * NS_PER_S);
                NavSample {
                    source: 0,
                    valid_utc: utc,
                    arrival_utc: utc,
                    quantity: NavQuantity::Heave { heave_down_m: 0.0 },
                }
            }));
        }
        let placed = place(&mut samples, &cuts, stamped, &mut Vec::new());
        let times: Vec<_> = samples.iter().map(|s| s.valid_utc.0 / NS_PER_S).collect();
        if !stamped {
            assert!(times.windows(2).all(|w| w[1] > w[0]), "{times:?}");
        }
        let starts = placed.iter().map(|p| p.start().0 / NS_PER_S).collect();
        (starts, placed.iter().map(|p| p.kind).collect())
    }

    #[test]
    fn passes_follow_one_another_in_the_order_of_the_file() {
        use PassKind::{Own, Shifted};
        let got = passes(&[1000, 100, 1000, 5000], &[30, 20, 30, 10], false);
        assert_eq!(got.0, [1000, 1030, 1050, 5000]);
        assert_eq!(got.1, [Own, Shifted, Shifted, Own]);
    }

    #[test]
    fn passes_of_a_wrong_clock_fill_their_gap() {
        use PassKind::{Own, WrongClock};
        for wrong_s in [-183_600, 72_000, -1_400_000_000, 1_600_000_000] {
            let got = passes(&[1000, 1010 + wrong_s, 1013], &[10, 3, 20], false);
            assert_eq!(got.0, [1000, 1010, 1013], "{wrong_s}");
            assert_eq!(got.1, [Own, WrongClock, Own], "{wrong_s}");
        }
    }

    #[test]
    fn stamped_parts_in_the_wrong_order_keep_their_stamps_and_overlapping_ones_do_not_mix() {
        assert!(passes(&[1000, 100, 5000], &[30, 20, 10], true).0.is_empty());
        assert_eq!(passes(&[1000, 1010, 1000], &[30, 5, 30], true).0.len(), 3);
    }
}

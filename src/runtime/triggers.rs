//! What came of triggers, in numbers.

use std::sync::atomic::{AtomicU64, Ordering::Relaxed};
use std::sync::{Arc, OnceLock};

use crate::io::trigger::TriggerListenerCounts;
use crate::io::trigger::out::OutCounts;
use echotank_ping::{Refusal, Triggered};

/// Of one sonar.
#[derive(Debug, Default)]
pub struct TriggerCounts {
    pub obeyed: AtomicU64,
    pub queued: AtomicU64,
    pub early: AtomicU64,
    pub stale: AtomicU64,
    pub duplicate: AtomicU64,
    pub held: AtomicU64,
    /// Found too many others waiting.
    pub dropped: AtomicU64,
    /// Did not come within the watchdog's time.
    pub absent: AtomicU64,
    /// Latest pulse of a beat, after its instant, microseconds.
    pub(crate) worst_pulse_us: AtomicU64,
    pub listener: OnceLock<Arc<TriggerListenerCounts>>,
    pub out: OnceLock<Arc<OutCounts>>,
}

impl TriggerCounts {
    pub fn note(&self, triggered: &Triggered) {
        let counter = match triggered {
            Triggered::Pulse(_) => &self.obeyed,
            Triggered::Queued => &self.queued,
            Triggered::Refused(why) => self.refusals(*why),
        };
        counter.fetch_add(1, Relaxed);
    }

    fn refusals(&self, why: Refusal) -> &AtomicU64 {
        match why {
            Refusal::Early => &self.early,
            Refusal::Stale => &self.stale,
            Refusal::Duplicate => &self.duplicate,
            Refusal::Held => &self.held,
        }
    }

    /// Name, meaning, value.
    pub fn all(&self) -> impl Iterator<Item = (&'static str, &'static str, u64)> + '_ {
        let listener = |of: fn(&TriggerListenerCounts) -> &AtomicU64| {
            self.listener.get().map(|listener| of(listener))
        };
        let out = |of: fn(&OutCounts) -> &AtomicU64| self.out.get().map(|out| of(out));
        [
            (
                "triggers_received",
                "Triggers that came by the sonar's own door",
                listener(|listener| &listener.received),
            ),
            (
                "triggers_spoiled",
                "Trigger sentences that were not whole",
                listener(|listener| &listener.spoiled),
            ),
            (
                "trigger_errors",
                "Errors of the door triggers come by",
                listener(|listener| &listener.errors),
            ),
            (
                "triggers_obeyed",
                "Triggers that made a ping",
                Some(&self.obeyed),
            ),
            (
                "triggers_queued",
                "Triggers that waited for the end of a ping",
                Some(&self.queued),
            ),
            (
                "triggers_early",
                "Triggers refused because the ping before was still listened to",
                Some(&self.early),
            ),
            (
                "triggers_stale",
                "Triggers refused because they were older than the last pulse",
                Some(&self.stale),
            ),
            (
                "triggers_duplicate",
                "Triggers refused because their number had come before",
                Some(&self.duplicate),
            ),
            (
                "triggers_held",
                "Triggers refused because the sonar did not obey any",
                Some(&self.held),
            ),
            (
                "triggers_dropped",
                "Triggers that found too many others waiting",
                Some(&self.dropped),
            ),
            (
                "triggers_absent",
                "Triggers that did not come within the watchdog's time",
                Some(&self.absent),
            ),
            (
                "triggers_sent",
                "Triggers sent to others",
                out(|out| &out.sent),
            ),
            (
                "triggers_unsent",
                "Triggers that could not be sent",
                out(|out| &out.failed),
            ),
            (
                "worst_pulse_us",
                "Latest pulse after its instant",
                Some(&self.worst_pulse_us),
            ),
        ]
        .into_iter()
        .map(|(name, doc, counter)| (name, doc, counter.map_or(0, |c| c.load(Relaxed))))
    }

    /// For the status lines; none where no trigger plays a part.
    pub fn line(&self, sonar: &str) -> Option<String> {
        let plays = self.listener.get().is_some() || self.out.get().is_some();
        let any = plays || self.obeyed.load(Relaxed) > 0;
        let figures: Vec<_> = self
            .all()
            .filter(|(_, _, value)| *value > 0)
            .map(|(name, _, value)| format!("{value} {}", name.replace('_', " ")))
            .collect();
        any.then(|| format!("sonar {sonar}: {}", figures.join(", ")))
    }
}

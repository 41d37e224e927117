//! Counters of external triggers.

use std::sync::atomic::{AtomicU64, Ordering::Relaxed};
use std::sync::{Arc, OnceLock};

use crate::io::trigger::TriggerListenerCounts;
use crate::io::trigger::out::TriggerOutputCounts;
use echotank_ping::{Refusal, Triggered};

/// Trigger counters of one sonar.
#[derive(Debug, Default)]
pub struct TriggerCounts {
    /// Triggers that started a ping.
    pub obeyed: AtomicU64,
    /// Triggers that waited for the end of a ping.
    pub queued: AtomicU64,
    /// Triggers refused because the previous ping was still being received.
    pub early: AtomicU64,
    /// Triggers refused because they were older than the last pulse.
    pub stale: AtomicU64,
    /// Triggers refused because their number had been received before.
    pub duplicate: AtomicU64,
    /// Triggers refused because the sonar does not accept external triggers.
    pub held: AtomicU64,
    /// Triggers dropped because the queue was full.
    pub dropped: AtomicU64,
    /// Triggers missing when the watchdog's time expired.
    pub absent: AtomicU64,
    /// Largest delay of a pulse after its scheduled instant, microseconds.
    pub(crate) worst_pulse_us: AtomicU64,
    /// Counters of the sonar's trigger input, if it has one.
    pub listener: OnceLock<Arc<TriggerListenerCounts>>,
    /// Counters of the sonar's trigger output, if it has one.
    pub out: OnceLock<Arc<TriggerOutputCounts>>,
}

impl TriggerCounts {
    /// Counts the outcome of one trigger.
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

    /// Name, description and value of every counter.
    pub fn all(&self) -> impl Iterator<Item = (&'static str, &'static str, u64)> + '_ {
        let listener = |of: fn(&TriggerListenerCounts) -> &AtomicU64| {
            self.listener.get().map(|listener| of(listener))
        };
        let out = |of: fn(&TriggerOutputCounts) -> &AtomicU64| self.out.get().map(|out| of(out));
        [
            (
                "triggers_received",
                "Triggers received on the sonar's trigger input",
                listener(|listener| &listener.received),
            ),
            (
                "triggers_spoiled",
                "Incomplete or invalid trigger sentences",
                listener(|listener| &listener.spoiled),
            ),
            (
                "trigger_errors",
                "Read errors of the sonar's trigger input",
                listener(|listener| &listener.errors),
            ),
            (
                "triggers_obeyed",
                "Triggers that started a ping",
                Some(&self.obeyed),
            ),
            (
                "triggers_queued",
                "Triggers that waited for the end of a ping",
                Some(&self.queued),
            ),
            (
                "triggers_early",
                "Triggers refused because the previous ping was still being received",
                Some(&self.early),
            ),
            (
                "triggers_stale",
                "Triggers refused because they were older than the last pulse",
                Some(&self.stale),
            ),
            (
                "triggers_duplicate",
                "Triggers refused because their number had been received before",
                Some(&self.duplicate),
            ),
            (
                "triggers_held",
                "Triggers refused because the sonar obeyed no external trigger",
                Some(&self.held),
            ),
            (
                "triggers_dropped",
                "Triggers dropped because the queue was full",
                Some(&self.dropped),
            ),
            (
                "triggers_absent",
                "Triggers missing at the end of the watchdog's time",
                Some(&self.absent),
            ),
            (
                "triggers_sent",
                "Triggers sent to other devices",
                out(|out| &out.sent),
            ),
            (
                "triggers_unsent",
                "Triggers that could not be sent",
                out(|out| &out.failed),
            ),
            (
                "worst_pulse_us",
                "Largest delay of a pulse after its scheduled instant, microseconds",
                Some(&self.worst_pulse_us),
            ),
        ]
        .into_iter()
        .map(|(name, doc, counter)| (name, doc, counter.map_or(0, |c| c.load(Relaxed))))
    }

    /// Non-zero counters as a status line; `None` for a sonar without triggers.
    pub fn line(&self, sonar: &str) -> Option<String> {
        let configured = self.listener.get().is_some() || self.out.get().is_some();
        let any = configured || self.obeyed.load(Relaxed) > 0;
        let figures: Vec<_> = self
            .all()
            .filter(|(_, _, value)| *value > 0)
            .map(|(name, _, value)| format!("{value} {}", name.replace('_', " ")))
            .collect();
        any.then(|| format!("sonar {sonar}: {}", figures.join(", ")))
    }
}

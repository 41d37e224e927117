//! Trigger inputs and trigger outputs of all sonars.

use std::sync::{Arc, Mutex, PoisonError};

use crossbeam_channel::{Receiver, bounded};

use super::DaemonError;
use crate::clock::{Clock, WakeUp};
use crate::counters::add;
use crate::gate::Gate;
use crate::io::trigger::out::TriggerOut;
use crate::io::trigger::{Sink, Trigger, TriggerListener};
use crate::triggers::TriggerCounts;
use echotank_config::spec::{ClockSpec, RigSpec, TriggerFrom};
use echotank_core::settings::TriggerSource;
use echotank_core::time::MonoNs;
use echotank_ping::Triggered;
use echotank_ping::trigger::Numbers;

/// Maximum number of external triggers that wait to be processed.
const MAX_WAITING: usize = 1024;

/// An external trigger.
#[derive(Clone, Copy)]
pub(super) struct ExternalTrigger {
    pub sonar: usize,
    pub at: MonoNs,
    pub number: Option<u32>,
}

pub(super) struct Triggers {
    /// Inputs, one per sonar; they close when dropped.
    pub listeners: Vec<Option<TriggerListener>>,
    pub(crate) outs: Vec<Option<TriggerOut>>,
    pub received: Receiver<ExternalTrigger>,
    /// Notified when a trigger arrives.
    pub wake_up: Arc<WakeUp>,
}

/// Initial trigger source of a sonar.
pub(super) fn at_first(from: &TriggerFrom, clock: ClockSpec) -> TriggerSource {
    match from {
        TriggerFrom::Internal => TriggerSource::Internal,
        // With a `fast` or `lockstep` clock an external trigger steps the internal schedule.
        from if from.is_wired() && clock.is_own() => TriggerSource::Internal,
        _ => TriggerSource::External,
    }
}

impl Triggers {
    pub(super) fn open(
        spec: &RigSpec,
        clock: &Arc<dyn Clock>,
        gate: &Arc<Gate>,
        counts: &[Arc<TriggerCounts>],
    ) -> Result<Self, DaemonError> {
        let (sender, received) = bounded(MAX_WAITING);
        let wake_up = Arc::new(WakeUp::default());
        let (mut listeners, mut outs) = (Vec::new(), Vec::new());
        for (sonar, (spec_of, counts)) in spec.sonars.iter().zip(counts).enumerate() {
            let sink: Sink = if spec.run.clock.is_own() {
                stepping(gate.clone(), counts.clone())
            } else {
                let (clock, wake_up, sender) = (clock.clone(), wake_up.clone(), sender.clone());
                let (counts, gate) = (counts.clone(), gate.clone());
                Arc::new(move |Trigger { age_ns, number }| {
                    let age_ns = (age_ns as f64 * gate.rate().unwrap_or(1.0)) as i64;
                    let at = clock.mono().plus_ns(-age_ns);
                    if sender
                        .try_send(ExternalTrigger { sonar, at, number })
                        .is_err()
                    {
                        add(&counts.dropped, 1);
                    }
                    wake_up.notify(&*clock);
                })
            };
            let listener = TriggerListener::open(&spec_of.trigger.from, sink)?;
            if let Some(listener) = &listener {
                listener.set_priority(spec.run.priority);
                let _ = counts.listener.set(listener.counts().clone());
            }
            listeners.push(listener);
            let out = TriggerOut::open(&spec_of.trigger_out, &spec_of.name)?;
            if let Some(out) = &out {
                let _ = counts.out.set(out.counts().clone());
            }
            outs.push(out);
        }
        Ok(Self {
            listeners,
            outs,
            received,
            wake_up,
        })
    }

    /// Addresses of the trigger inputs, one line each.
    pub(super) fn addresses(&self, spec: &RigSpec) -> Vec<String> {
        let named = spec.sonars.iter().zip(&self.listeners);
        named
            .filter_map(|(sonar, listener)| {
                let (transport, address) = listener.as_ref()?.address()?;
                Some(format!("trigger {} {transport} {address}", sonar.name))
            })
            .collect()
    }
}

/// Sink for a `lockstep` or `fast` clock: each accepted trigger is one step.
fn stepping(gate: Arc<Gate>, counts: Arc<TriggerCounts>) -> Sink {
    let numbers = Mutex::new(Numbers::default());
    Arc::new(move |Trigger { number, .. }| {
        let mut numbers = numbers.lock().unwrap_or_else(PoisonError::into_inner);
        match number.map_or(Ok(()), |number| numbers.check(number)) {
            Ok(()) => {
                add(&counts.obeyed, 1);
                gate.step(1);
            }
            Err(why) => counts.note(&Triggered::Refused(why)),
        }
    })
}

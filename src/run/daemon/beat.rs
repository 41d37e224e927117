//! The beat: turns the passing of time, and triggers, into orders.
//!
//! Where time is the machine's it has a thread of its own, so that a pulse is on time, and told to whoever is to be triggered, however busy the
//! pipeline is. Where time is the pipeline's, the pipeline asks.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::{self, JoinHandle};

use crossbeam_channel::Sender;

use super::triggers::{Came, Triggers};
use crate::config::spec::{RigSpec, StampSpec};
use crate::io::priority;
use crate::ping::beats::{Beats, Event, InForce};
use crate::ping::trigger::Numbers;
use crate::ping::{PingOrder, Refusal, Triggered};
use crate::run::control::RunControl;
use crate::run::counters::{add, worst};
use crate::run::faults::{Faults, PingMark};
use crate::run::settings::SettingsStore;
use crate::time::{Bell, Clock, NS_PER_S, Timeline, UtcNs};

/// The thread looks this often whether it should end, at least.
const LOOK_NS: i64 = NS_PER_S / 10;

pub(super) struct Beat {
    beats: Beats,
    timeline: Timeline,
    stamp: StampSpec,
    settings: Vec<Arc<SettingsStore>>,
    control: Arc<RunControl>,
    faults: Arc<Faults>,
    clock: Arc<dyn Clock>,
    own_time: bool,
    triggers: Triggers,
    /// The oldest trigger from outside that has not been looked at.
    came: Option<Came>,
    numbers: Vec<Numbers>,
    /// Of each sonar with a watchdog: its time, and since when it waits.
    watches: Vec<Option<Watch>>,
}

#[derive(Clone, Copy)]
struct Watch {
    patience_s: f64,
    since: UtcNs,
}

/// What the beat shares with the pipeline.
pub(super) struct Company {
    pub settings: Vec<Arc<SettingsStore>>,
    pub control: Arc<RunControl>,
    pub faults: Arc<Faults>,
    pub clock: Arc<dyn Clock>,
}

impl Beat {
    pub fn new(
        spec: &RigSpec,
        first: UtcNs,
        timeline: Timeline,
        company: Company,
        triggers: Triggers,
    ) -> Self {
        let specs = spec.sonars.iter().map(|sonar| &sonar.trigger);
        let watch = |patience_s| Watch {
            patience_s,
            since: first,
        };
        Self {
            beats: Beats::starting_at(first, spec.medium.sound_speed_m_per_s, specs.clone()),
            timeline,
            stamp: spec.nav.stamp,
            own_time: spec.run.clock.is_own(),
            numbers: vec![Numbers::default(); spec.sonars.len()],
            watches: specs.map(|spec| spec.watchdog_s.map(watch)).collect(),
            settings: company.settings,
            control: company.control,
            faults: company.faults,
            clock: company.clock,
            triggers,
            came: None,
        }
    }

    /// When a pulse is next due of a sonar that pings; none while nobody does.
    pub fn next_pulse(&self) -> Option<UtcNs> {
        let pings = |sonar: usize| self.settings[sonar].snapshot().0.pinging;
        self.beats.next_utc(pings)
    }

    /// The next pulse that has gone out by `now`, in order of time.
    pub fn next(&mut self, now: UtcNs) -> Option<(usize, PingOrder)> {
        loop {
            self.came = self.came.or_else(|| self.triggers.came.try_recv().ok());
            let until = self
                .came
                .map_or(now, |came| self.timeline.utc(came.at).min(now));
            let happened = {
                let (settings, timeline) = (&self.settings, self.timeline);
                self.beats.due(until, |sonar, at| {
                    settings[sonar].in_force(timeline.mono(at))
                })
            };
            let (sonar, event) = match (happened, self.came) {
                (Some(happened), _) => happened,
                (None, Some(came)) => {
                    self.came = None;
                    (came.sonar, Event::Trigger(self.obey(came)))
                }
                (None, None) => return None,
            };
            if let Some(order) = self.note(sonar, &event) {
                return Some((sonar, order));
            }
        }
    }

    /// What becomes of a trigger from outside.
    fn obey(&mut self, came: Came) -> Triggered {
        let at = self.timeline.utc(came.at);
        let known = came
            .number
            .map_or(Ok(()), |number| self.numbers[came.sonar].check(number));
        if let Err(why) = known {
            return Triggered::Refused(why);
        }
        if let Some(watch) = &mut self.watches[came.sonar] {
            watch.since = watch.since.max(at);
        }
        if self.control.gate().is_held() {
            return Triggered::Refused(Refusal::Held);
        }
        let in_force = self.settings[came.sonar].in_force(came.at);
        self.beats.trigger(came.sonar, at, in_force)
    }

    /// Counts what happened; the order, where it is one and its pulse goes out.
    fn note(&mut self, sonar: usize, event: &Event) -> Option<PingOrder> {
        let counts = &self.control.sonars()[sonar].triggers;
        if let Event::Trigger(triggered) = event {
            counts.note(triggered);
        }
        let order = event.order()?;
        let at = self.timeline.mono(order.transmit_utc);
        if let Event::Beat(_) = event {
            self.settings[sonar].pinged(at);
        }
        if self.faults.trigger_missed(PingMark::of(sonar, &order)) {
            add(&self.control.sonars()[sonar].counters.triggers_missed, 1);
            return None;
        }
        let late_ns = self.clock.mono().0 - at.0;
        if let Some(out) = &self.triggers.outs[sonar] {
            let utc = match self.stamp {
                StampSpec::Log => order.transmit_utc,
                StampSpec::Host => self.clock.host_utc().plus_ns(-late_ns),
            };
            out.pulse(order.ping_number, utc);
        }
        if !self.own_time && matches!(event, Event::Beat(_)) {
            worst(&counts.worst_pulse_us, late_ns.max(0) as u64 / 1000);
        }
        self.beats.pulsed(sonar, order.transmit_utc);
        Some(order)
    }

    /// Counts triggers that should have come.
    fn watch(&mut self, now: UtcNs) {
        for (sonar, watch) in self.watches.iter_mut().enumerate() {
            let Some(watch) = watch else { continue };
            let in_force = |at| self.settings[sonar].in_force(self.timeline.mono(at));
            while now.seconds_since(watch.since) > watch.patience_s {
                watch.since = watch.since.plus_s(watch.patience_s);
                let InForce { armed, .. } = in_force(watch.since);
                add(
                    &self.control.sonars()[sonar].triggers.absent,
                    u64::from(armed),
                );
            }
        }
    }

    /// The thread: hands every order on at its instant.
    fn run(mut self, orders: &Sender<(usize, PingOrder)>, pipeline: &Bell, stop: &AtomicBool) {
        while !stop.load(Ordering::Acquire) {
            let now = self.clock.mono();
            let utc = self.timeline.utc(now);
            while let Some((sonar, order)) = self.next(utc) {
                if orders.try_send((sonar, order)).is_err() {
                    add(&self.control.sonars()[sonar].counters.skipped_queue, 1);
                }
                pipeline.ring(&*self.clock);
            }
            self.watch(utc);
            let look = now.plus_ns(LOOK_NS);
            let next = self.beats.next_utc(|_| true);
            let until = next.map_or(look, |next| self.timeline.mono(next).min(look));
            let bell = self.triggers.bell.clone();
            self.clock.doze_until(until, &bell);
        }
    }

    /// Gives it a thread, which ends when what is returned is dropped. `priority`: SCHED_FIFO; 0: ordinary.
    pub fn start(
        self,
        orders: Sender<(usize, PingOrder)>,
        pipeline: Arc<Bell>,
        priority: u8,
    ) -> std::io::Result<BeatThread> {
        let stop = Arc::new(AtomicBool::new(false));
        let (clock, bell) = (self.clock.clone(), self.triggers.bell.clone());
        let thread = thread::Builder::new().name("beat".into()).spawn({
            let stop = stop.clone();
            move || {
                if priority > 0 {
                    // What is not allowed was said when the daemon started.
                    let _ = priority::first_in_first_out(priority);
                }
                self.run(&orders, &pipeline, &stop);
            }
        })?;
        Ok(BeatThread {
            stop,
            clock,
            bell,
            thread: Some(thread),
        })
    }
}

pub(super) struct BeatThread {
    stop: Arc<AtomicBool>,
    clock: Arc<dyn Clock>,
    bell: Arc<Bell>,
    thread: Option<JoinHandle<()>>,
}

impl Drop for BeatThread {
    fn drop(&mut self) {
        self.stop.store(true, Ordering::Release);
        self.bell.ring(&*self.clock);
        if let Some(thread) = self.thread.take() {
            // A panic in it was printed where it happened.
            let _ = thread.join();
        }
    }
}

//! The beat: issues ping orders from the schedules and from external triggers.
//!
//! With a real-time or scaled clock the beat runs in its own thread. Pulses and trigger outputs therefore stay on time while the pipeline is busy.
//! With a `fast` or `lockstep` clock the pipeline calls the beat.

use std::collections::VecDeque;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicI64, Ordering};
use std::thread::{self, JoinHandle};

use crossbeam_channel::Sender;

use super::triggers::{Came, Triggers};
use crate::clock::{Clock, WakeUp};
use crate::control::RunControl;
use crate::counters::{add, worst};
use crate::io::priority;
use crate::overload::{Backlog, OverloadRecord};
use crate::score::SKIPPED;
use crate::settings::SettingsStore;
use echotank_config::spec::{OverloadSpec, RigSpec, RunSpec, StampSpec};
use echotank_core::time::{MonoNs, NS_PER_S, Timeline, UtcNs};
use echotank_ping::beats::{Beats, Event, InForce};
use echotank_ping::faults::{Faults, PingMark};
use echotank_ping::trigger::Numbers;
use echotank_ping::{self as ping, PingOrder, Refusal, Triggered};

/// Maximum interval between checks of the stop flag.
const LOOK_NS: i64 = NS_PER_S / 10;

/// Minimum delay of a pulse that is put off, which limits the wake-ups of the thread.
const MIN_PUT_OFF_NS: i64 = NS_PER_S / 2000;

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
    /// Oldest external trigger that has not been processed.
    came: Option<Came>,
    numbers: Vec<Numbers>,
    /// Watchdog of each sonar that has one.
    watches: Vec<Option<Watch>>,
    /// Lead of an order before its pulse, nanoseconds.
    ahead_ns: i64,
    /// Ordered pulses whose trigger outputs are still to be sent, earliest first.
    untold: VecDeque<PulseNotice>,
    coming: Arc<Coming>,
    backlog: Arc<Backlog>,
    stretch: Option<Stretch>,
}

/// An order on its way from the beat to the pipeline.
#[derive(Clone, Copy)]
pub(super) struct Ordered {
    pub sonar: usize,
    pub order: PingOrder,
    /// Delay of the pulse behind the regular schedule.
    pub put_off_s: f64,
}

/// State of `run.overload = "stretch"`.
struct Stretch {
    backlog: Arc<Backlog>,
    run: RunSpec,
    sound_speed_m_per_s: f64,
    /// Per sonar: accumulated delay of the next pulse.
    put_off_ns: Vec<i64>,
}

/// A pulse as sent on a trigger output.
#[derive(Clone, Copy)]
struct PulseNotice {
    at: MonoNs,
    sonar: usize,
    number: u32,
    utc: UtcNs,
}

/// Instant of the next scheduled pulse and wake-up of the pipeline, shared by the beat and the pipeline.
pub(super) struct Coming {
    /// Notified when an order is queued.
    pub wake_up: WakeUp,
    next_utc_ns: AtomicI64,
}

impl Coming {
    /// Instant before which no further order has its pulse, except by external trigger.
    pub(super) fn next(&self) -> UtcNs {
        UtcNs(self.next_utc_ns.load(Ordering::Acquire))
    }
}

#[derive(Clone, Copy)]
struct Watch {
    patience_s: f64,
    since: UtcNs,
}

/// Shared state that the beat works with.
pub(super) struct BeatContext {
    pub settings: Vec<Arc<SettingsStore>>,
    pub control: Arc<RunControl>,
    pub faults: Arc<Faults>,
    pub clock: Arc<dyn Clock>,
    pub(crate) backlog: Arc<Backlog>,
}

impl Beat {
    pub(super) fn new(
        spec: &RigSpec,
        first: UtcNs,
        timeline: Timeline,
        context: BeatContext,
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
            settings: context.settings,
            control: context.control,
            faults: context.faults,
            clock: context.clock,
            triggers,
            came: None,
            ahead_ns: spec.run.ahead_ns(),
            untold: VecDeque::new(),
            stretch: (spec.run.overload == OverloadSpec::Stretch).then(|| Stretch {
                backlog: context.backlog.clone(),
                run: spec.run.clone(),
                sound_speed_m_per_s: spec.medium.sound_speed_m_per_s,
                put_off_ns: vec![0; spec.sonars.len()],
            }),
            backlog: context.backlog,
            coming: Arc::new(Coming {
                wake_up: WakeUp::default(),
                next_utc_ns: AtomicI64::new(first.0),
            }),
        }
    }

    pub(super) fn coming(&self) -> Arc<Coming> {
        self.coming.clone()
    }

    /// Instant of the next scheduled pulse of any sonar that pings. `None` if no sonar pings.
    pub(crate) fn next_pulse(&self) -> Option<UtcNs> {
        let pings = |sonar: usize| self.settings[sonar].snapshot().0.pinging;
        self.beats.next_utc(pings)
    }

    /// Next order with a pulse at or before `now`, in order of time.
    pub(super) fn next(&mut self, now: UtcNs) -> Option<(usize, PingOrder)> {
        loop {
            self.came = self.came.or_else(|| self.triggers.came.try_recv().ok());
            let until = self
                .came
                .map_or(now, |came| self.timeline.utc(came.at).min(now));
            self.stretch_until(until);
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

    /// Delays the pulses up to `until` whose pings could not be ready in time.
    fn stretch_until(&mut self, until: UtcNs) {
        let Some(stretch) = self.stretch.as_mut().filter(|_| !self.own_time) else {
            return;
        };
        let now = self.clock.mono();
        for (sonar, settings) in self.settings.iter().enumerate() {
            let at = self.beats.schedule(sonar).next_utc();
            if at > until {
                continue;
            }
            let pulse = self.timeline.mono(at);
            let InForce { settings, .. } = settings.in_force(pulse);
            if !settings.pinging {
                stretch.put_off_ns[sonar] = 0;
                continue;
            }
            let window_s = ping::window_s(&settings, stretch.sound_speed_m_per_s);
            let ready_by = pulse.plus_s(stretch.run.ready_after_s(window_s));
            let put_off_ns = stretch.backlog.put_off_ns(sonar, now.0, ready_by.0);
            if put_off_ns > 0 {
                let put_off_ns = put_off_ns.max(MIN_PUT_OFF_NS);
                self.beats.put_off(sonar, at.plus_ns(put_off_ns));
                stretch.put_off_ns[sonar] += put_off_ns;
            }
        }
    }

    /// Takes the delay of the pulse that was just ordered behind the regular schedule, seconds.
    fn put_off_s(&mut self, sonar: usize) -> f64 {
        let put_off = self.stretch.as_mut().map(|s| &mut s.put_off_ns[sonar]);
        put_off.map_or(0.0, |ns| std::mem::take(ns) as f64 / NS_PER_S as f64)
    }

    /// Outcome of an external trigger.
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

    /// Counts an event. Returns its order if the event is one and no fault suppresses the pulse.
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
        let again_s = match self.beats.is_second(sonar) {
            // An injected double trigger is not repeated again.
            true => None,
            false => self.faults.trigger_double_s(PingMark::of(sonar, &order)),
        };
        if let Some(after_s) = again_s {
            self.beats.again(sonar, order.transmit_utc.plus_s(after_s));
        }
        if self.triggers.outs[sonar].is_some() {
            for after_s in [Some(0.0), again_s].into_iter().flatten() {
                let at = at.plus_s(after_s);
                let told = PulseNotice {
                    at,
                    sonar,
                    number: order.ping_number,
                    utc: order.transmit_utc.plus_s(after_s),
                };
                let place = self.untold.partition_point(|other| other.at <= at);
                self.untold.insert(place, told);
            }
            self.tell();
        }
        self.beats.pulsed(sonar, order.transmit_utc);
        Some(order)
    }

    /// Sends the trigger outputs that are due.
    fn tell(&mut self) {
        while let Some(told) = self.untold.front().copied() {
            let late_ns = self.clock.mono().0 - told.at.0;
            if late_ns < 0 {
                return;
            }
            self.untold.pop_front();
            let Some(out) = &self.triggers.outs[told.sonar] else {
                continue;
            };
            let utc = match self.stamp {
                StampSpec::Log => told.utc,
                StampSpec::Host => self.clock.host_utc().plus_ns(-late_ns),
            };
            out.pulse(told.number, utc);
            if !self.own_time {
                let counts = &self.control.sonars()[told.sonar].triggers;
                worst(&counts.worst_pulse_us, late_ns as u64 / 1000);
            }
        }
    }

    /// Counts the external triggers that are overdue.
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

    /// Body of the thread: passes every order to the pipeline at its instant.
    fn run(mut self, orders: &Sender<Ordered>, stop: &AtomicBool) {
        while !stop.load(Ordering::Acquire) {
            let now = self.clock.mono();
            let utc = self.timeline.utc(now);
            self.tell();
            while let Some((sonar, order)) = self.next(utc.plus_ns(self.ahead_ns)) {
                let put_off_s = self.put_off_s(sonar);
                self.backlog.ordered(sonar);
                let ordered = Ordered {
                    sonar,
                    order,
                    put_off_s,
                };
                if let Err(refused) = orders.try_send(ordered) {
                    self.backlog.done(sonar);
                    let control = &self.control.sonars()[sonar];
                    add(&control.counters.skipped_queue, 1);
                    let order = refused.into_inner().order;
                    self.control.overload_states().note(OverloadRecord {
                        what: SKIPPED,
                        sonar: control.name.clone(),
                        ping_number: order.ping_number,
                        utc_ns: order.transmit_utc.0,
                        tolerance: None,
                        put_off_ms: None,
                    });
                }
                self.coming.wake_up.notify(&*self.clock);
            }
            self.watch(utc);
            let next = self.beats.next_utc(|_| true).unwrap_or(UtcNs(i64::MAX));
            self.coming.next_utc_ns.store(next.0, Ordering::Release);
            let order = self.timeline.mono(next.plus_ns(-self.ahead_ns));
            let told = self.untold.front().map(|told| told.at);
            let look = now.plus_ns(LOOK_NS);
            let until = told.map_or(order, |told| told.min(order)).min(look);
            let wake_up = self.triggers.wake_up.clone();
            self.clock.wait_until(until, &wake_up);
        }
    }

    /// Starts the thread, which ends when the returned value is dropped. `priority` is the SCHED_FIFO priority; 0 means ordinary scheduling.
    pub(super) fn start(
        self,
        orders: Sender<Ordered>,
        priority: u8,
    ) -> std::io::Result<BeatThread> {
        let stop = Arc::new(AtomicBool::new(false));
        let (clock, wake_up) = (self.clock.clone(), self.triggers.wake_up.clone());
        let thread = thread::Builder::new().name("beat".into()).spawn({
            let stop = stop.clone();
            move || {
                if priority > 0 {
                    // The daemon reports a refused priority at its start.
                    let _ = priority::first_in_first_out(priority);
                }
                self.run(&orders, &stop);
            }
        })?;
        Ok(BeatThread {
            stop,
            clock,
            wake_up,
            thread: Some(thread),
        })
    }
}

pub(super) struct BeatThread {
    stop: Arc<AtomicBool>,
    clock: Arc<dyn Clock>,
    wake_up: Arc<WakeUp>,
    thread: Option<JoinHandle<()>>,
}

impl Drop for BeatThread {
    fn drop(&mut self) {
        self.stop.store(true, Ordering::Release);
        self.wake_up.notify(&*self.clock);
        if let Some(thread) = self.thread.take() {
            // The panic message was printed when the panic occurred.
            let _ = thread.join();
        }
    }
}

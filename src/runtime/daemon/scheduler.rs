//! The ping scheduler: issues ping orders from the schedules and from external triggers.
//!
//! With a real-time or scaled clock the scheduler runs in its own thread. Pulses and trigger outputs therefore stay on time while the pipeline is busy.
//! With a `fast` or `lockstep` clock the pipeline calls the scheduler.

use std::collections::VecDeque;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicI64, Ordering};
use std::thread::{self, JoinHandle};

use crossbeam_channel::Sender;

use super::triggers::{ExternalTrigger, Triggers};
use crate::clock::{Clock, WakeUp};
use crate::control::RunControl;
use crate::counters::{add, worst};
use crate::io::priority;
use crate::overload::{Backlog, OverloadRecord};
use crate::score::SKIPPED;
use crate::settings::SettingsStore;
use echotank_config::spec::{OverloadSpec, RigSpec, RunSpec, StampSpec};
use echotank_core::time::{MonoNs, NS_PER_S, Timeline, UtcNs};
use echotank_ping::faults::{Faults, PingMark};
use echotank_ping::rig_schedule::{Event, RigSchedule, SettingsInForce};
use echotank_ping::trigger::Numbers;
use echotank_ping::{self as ping, PingOrder, Refusal, Triggered};

/// Maximum interval between checks of the stop flag.
const MAX_WAIT_NS: i64 = NS_PER_S / 10;

/// Minimum delay of a pulse that is put off, which limits the wake-ups of the thread.
const MIN_PUT_OFF_NS: i64 = NS_PER_S / 2000;

pub(super) struct PingScheduler {
    schedule: RigSchedule,
    timeline: Timeline,
    stamp: StampSpec,
    settings: Vec<Arc<SettingsStore>>,
    control: Arc<RunControl>,
    faults: Arc<Faults>,
    clock: Arc<dyn Clock>,
    own_time: bool,
    triggers: Triggers,
    /// Oldest external trigger that is not processed yet.
    pending: Option<ExternalTrigger>,
    numbers: Vec<Numbers>,
    /// Watchdog of each sonar that has one.
    watchdogs: Vec<Option<Watchdog>>,
    /// Lead of an order before its pulse, nanoseconds.
    ahead_ns: i64,
    /// Ordered pulses whose trigger outputs are still to be sent, earliest first.
    notices: VecDeque<PulseNotice>,
    next_order: Arc<NextOrder>,
    backlog: Arc<Backlog>,
    stretch: Option<Stretch>,
}

/// An order on its way from the scheduler to the pipeline.
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

/// Instant of the next scheduled pulse and wake-up of the pipeline, shared by the scheduler and the pipeline.
pub(super) struct NextOrder {
    /// Notified when an order is queued.
    pub wake_up: WakeUp,
    next_utc_ns: AtomicI64,
}

impl NextOrder {
    /// Instant before which no further order has its pulse, except by external trigger.
    pub(super) fn next(&self) -> UtcNs {
        UtcNs(self.next_utc_ns.load(Ordering::Acquire))
    }
}

#[derive(Clone, Copy)]
struct Watchdog {
    timeout_s: f64,
    since: UtcNs,
}

/// Shared state that the scheduler works with.
pub(super) struct SchedulerContext {
    pub settings: Vec<Arc<SettingsStore>>,
    pub control: Arc<RunControl>,
    pub faults: Arc<Faults>,
    pub clock: Arc<dyn Clock>,
    pub(crate) backlog: Arc<Backlog>,
}

impl PingScheduler {
    pub(super) fn new(
        spec: &RigSpec,
        first: UtcNs,
        timeline: Timeline,
        context: SchedulerContext,
        triggers: Triggers,
    ) -> Self {
        let specs = spec.sonars.iter().map(|sonar| &sonar.trigger);
        let watchdog = |timeout_s| Watchdog {
            timeout_s,
            since: first,
        };
        Self {
            schedule: RigSchedule::starting_at(
                first,
                spec.medium.sound_speed_m_per_s,
                specs.clone(),
            ),
            timeline,
            stamp: spec.nav.stamp,
            own_time: spec.run.clock.is_own(),
            numbers: vec![Numbers::default(); spec.sonars.len()],
            watchdogs: specs.map(|spec| spec.watchdog_s.map(watchdog)).collect(),
            settings: context.settings,
            control: context.control,
            faults: context.faults,
            clock: context.clock,
            triggers,
            pending: None,
            ahead_ns: spec.run.ahead_ns(),
            notices: VecDeque::new(),
            stretch: (spec.run.overload == OverloadSpec::Stretch).then(|| Stretch {
                backlog: context.backlog.clone(),
                run: spec.run.clone(),
                sound_speed_m_per_s: spec.medium.sound_speed_m_per_s,
                put_off_ns: vec![0; spec.sonars.len()],
            }),
            backlog: context.backlog,
            next_order: Arc::new(NextOrder {
                wake_up: WakeUp::default(),
                next_utc_ns: AtomicI64::new(first.0),
            }),
        }
    }

    pub(super) fn next_order(&self) -> Arc<NextOrder> {
        self.next_order.clone()
    }

    /// Instant of the next scheduled pulse of any sonar that pings. `None` if no sonar pings.
    pub(crate) fn next_pulse(&self) -> Option<UtcNs> {
        let pings = |sonar: usize| self.settings[sonar].snapshot().0.pinging;
        self.schedule.next_utc(pings)
    }

    /// Next order with a pulse at or before `now`, in order of time.
    pub(super) fn next(&mut self, now: UtcNs) -> Option<(usize, PingOrder)> {
        loop {
            self.pending = self
                .pending
                .or_else(|| self.triggers.received.try_recv().ok());
            let until = self
                .pending
                .map_or(now, |trigger| self.timeline.utc(trigger.at).min(now));
            self.stretch_until(until);
            let next = {
                let (settings, timeline) = (&self.settings, self.timeline);
                self.schedule.due(until, |sonar, at| {
                    settings[sonar].in_force(timeline.mono(at))
                })
            };
            let (sonar, event) = match (next, self.pending) {
                (Some(next), _) => next,
                (None, Some(trigger)) => {
                    self.pending = None;
                    (trigger.sonar, Event::Trigger(self.apply(trigger)))
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
            let at = self.schedule.of_sonar(sonar).next_utc();
            if at > until {
                continue;
            }
            let pulse = self.timeline.mono(at);
            let SettingsInForce { settings, .. } = settings.in_force(pulse);
            if !settings.pinging {
                stretch.put_off_ns[sonar] = 0;
                continue;
            }
            let window_s = ping::window_s(&settings, stretch.sound_speed_m_per_s);
            let ready_by = pulse.plus_s(stretch.run.ready_after_s(window_s));
            let put_off_ns = stretch.backlog.put_off_ns(sonar, now.0, ready_by.0);
            if put_off_ns > 0 {
                let put_off_ns = put_off_ns.max(MIN_PUT_OFF_NS);
                self.schedule.put_off(sonar, at.plus_ns(put_off_ns));
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
    fn apply(&mut self, trigger: ExternalTrigger) -> Triggered {
        let at = self.timeline.utc(trigger.at);
        let known = trigger
            .number
            .map_or(Ok(()), |number| self.numbers[trigger.sonar].check(number));
        if let Err(why) = known {
            return Triggered::Refused(why);
        }
        if let Some(watchdog) = &mut self.watchdogs[trigger.sonar] {
            watchdog.since = watchdog.since.max(at);
        }
        if self.control.gate().is_held() {
            return Triggered::Refused(Refusal::Held);
        }
        let in_force = self.settings[trigger.sonar].in_force(trigger.at);
        self.schedule.trigger(trigger.sonar, at, in_force)
    }

    /// Counts an event. Returns its order if the event is one and no fault suppresses the pulse.
    fn note(&mut self, sonar: usize, event: &Event) -> Option<PingOrder> {
        let counts = &self.control.sonars()[sonar].triggers;
        if let Event::Trigger(triggered) = event {
            counts.note(triggered);
        }
        let order = event.order()?;
        let at = self.timeline.mono(order.transmit_utc);
        if let Event::Scheduled(_) = event {
            self.settings[sonar].note_ping(at);
        }
        if self.faults.trigger_missed(PingMark::of(sonar, &order)) {
            add(&self.control.sonars()[sonar].counters.triggers_missed, 1);
            return None;
        }
        let second_s = match self.schedule.is_second(sonar) {
            // An injected double trigger is not repeated again.
            true => None,
            false => self.faults.trigger_double_s(PingMark::of(sonar, &order)),
        };
        if let Some(after_s) = second_s {
            self.schedule
                .trigger_again(sonar, order.transmit_utc.plus_s(after_s));
        }
        if self.triggers.outs[sonar].is_some() {
            for after_s in [Some(0.0), second_s].into_iter().flatten() {
                let at = at.plus_s(after_s);
                let notice = PulseNotice {
                    at,
                    sonar,
                    number: order.ping_number,
                    utc: order.transmit_utc.plus_s(after_s),
                };
                let place = self.notices.partition_point(|other| other.at <= at);
                self.notices.insert(place, notice);
            }
            self.send_notices();
        }
        self.schedule.note_pulse(sonar, order.transmit_utc);
        Some(order)
    }

    /// Sends the trigger outputs that are due.
    fn send_notices(&mut self) {
        while let Some(notice) = self.notices.front().copied() {
            let late_ns = self.clock.mono().0 - notice.at.0;
            if late_ns < 0 {
                return;
            }
            self.notices.pop_front();
            let Some(out) = &self.triggers.outs[notice.sonar] else {
                continue;
            };
            let utc = match self.stamp {
                StampSpec::Log => notice.utc,
                StampSpec::Host => self.clock.host_utc().plus_ns(-late_ns),
            };
            out.pulse(notice.number, utc);
            if !self.own_time {
                let counts = &self.control.sonars()[notice.sonar].triggers;
                worst(&counts.worst_pulse_us, late_ns as u64 / 1000);
            }
        }
    }

    /// Counts the external triggers that are overdue.
    fn check_watchdogs(&mut self, now: UtcNs) {
        for (sonar, watchdog) in self.watchdogs.iter_mut().enumerate() {
            let Some(watchdog) = watchdog else { continue };
            let in_force = |at| self.settings[sonar].in_force(self.timeline.mono(at));
            while now.seconds_since(watchdog.since) > watchdog.timeout_s {
                watchdog.since = watchdog.since.plus_s(watchdog.timeout_s);
                let SettingsInForce { armed, .. } = in_force(watchdog.since);
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
            self.send_notices();
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
                self.next_order.wake_up.notify(&*self.clock);
            }
            self.check_watchdogs(utc);
            let next = self.schedule.next_utc(|_| true).unwrap_or(UtcNs(i64::MAX));
            self.next_order.next_utc_ns.store(next.0, Ordering::Release);
            let order = self.timeline.mono(next.plus_ns(-self.ahead_ns));
            let notice = self.notices.front().map(|notice| notice.at);
            let check = now.plus_ns(MAX_WAIT_NS);
            let until = notice.map_or(order, |notice| notice.min(order)).min(check);
            let wake_up = self.triggers.wake_up.clone();
            self.clock.wait_until(until, &wake_up);
        }
    }

    /// Starts the thread, which ends when the returned value is dropped. `priority` is the SCHED_FIFO priority; 0 means ordinary scheduling.
    pub(super) fn start(
        self,
        orders: Sender<Ordered>,
        priority: u8,
    ) -> std::io::Result<SchedulerThread> {
        let stop = Arc::new(AtomicBool::new(false));
        let (clock, wake_up) = (self.clock.clone(), self.triggers.wake_up.clone());
        let thread = thread::Builder::new().name("scheduler".into()).spawn({
            let stop = stop.clone();
            move || {
                if priority > 0 {
                    // The daemon reports a refused priority at its start.
                    let _ = priority::first_in_first_out(priority);
                }
                self.run(&orders, &stop);
            }
        })?;
        Ok(SchedulerThread {
            stop,
            clock,
            wake_up,
            thread: Some(thread),
        })
    }
}

pub(super) struct SchedulerThread {
    stop: Arc<AtomicBool>,
    clock: Arc<dyn Clock>,
    wake_up: Arc<WakeUp>,
    thread: Option<JoinHandle<()>>,
}

impl Drop for SchedulerThread {
    fn drop(&mut self) {
        self.stop.store(true, Ordering::Release);
        self.wake_up.notify(&*self.clock);
        if let Some(thread) = self.thread.take() {
            // The panic message was printed when the panic occurred.
            let _ = thread.join();
        }
    }
}

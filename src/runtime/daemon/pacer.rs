//! The pacer: the loop that takes ping orders, computes the pings and passes them to the delivery threads on time.
//!
//! Each order passes through four steps: decide (make, skip or wait), make, account, and hand over to the delivery thread of its sonar.

use std::collections::VecDeque;
use std::ops::Range;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, OnceLock};

use crossbeam_channel::{Receiver, TrySendError, bounded};
use echotank_config::spec::{DeliverySpec, NavChannel, NavMode, NavSourceSpec};
use echotank_core::ping::OverloadState;
use echotank_core::time::{MonoNs, NS_PER_S, Timeline, UtcNs};
use echotank_nav::detection::owners_text;
use echotank_nav::{Coverage, NavGap};
use echotank_ping::method_selection::live::is_examined_before;
use echotank_ping::rig::{PingSlot, Rig};
use echotank_ping::{PingOrder, finish_ping, make_degraded_ping, make_ping};

use super::DaemonError;
use super::delivery::{Deadlines, Delivery, Lane};
use super::scheduler::{Ordered, PingScheduler, SchedulerContext};
use super::triggers::Triggers;
use crate::clock::{Clock, SystemClock};
use crate::control::{RunControl, SonarControl};
use crate::counters::{PingCounters, add};
use crate::io::nav::NavInputs;
use crate::io::nav::output::NavOutputs;
use crate::overload::{Backlog, DegradationLevels, OverloadRecord};
use crate::rig::plan_all;
use crate::score::SKIPPED;
use crate::settings::SettingsStore;
use crate::tiles::tile_ends;
use crate::waiting;

/// Longest sleep of the pipeline while it waits for an event without a known time (a live sample, a free slot), nanoseconds.
pub(super) const POLL_NS: i64 = 2_000_000;

/// Delay from the start to the first ping with recorded navigation: time to open the listeners and to compute the ping.
pub(super) const FIRST_PING_AFTER_NS: i64 = 500_000_000;

/// Interval at which the counters and states of the navigation are published to the status.
pub(super) const NAV_LINES_EVERY_NS: i64 = NS_PER_S / 4;

/// Maximum number of orders that wait for their navigation: 50 pings/s over 20 s of latency.
pub(super) const MAX_ORDERS: usize = 1000;

/// Blocks of a streamed ping that were sent before the ping was complete.
#[derive(Clone, Copy, Default)]
pub(super) struct Streamed {
    /// Number of samples sent, which is the index of the first unsent sample.
    pub(super) samples: usize,
    /// Number of whole blocks sent.
    pub(super) blocks: u32,
    /// Whether a block that can contain echoes was begun.
    pub(super) is_heard: bool,
    /// Instant at which the first tile was ready.
    pub(super) first_ready: Option<MonoNs>,
}

/// Timing of a ping under a clock that runs by itself (`realtime`, `scaled`).
#[derive(Clone, Copy)]
pub(super) struct Paced {
    pub(super) due: Deadlines,
    /// Degradation level; 0 is the full method.
    pub(super) level: usize,
    pub(super) put_off_s: f64,
    /// Earliest instant at which the ping counts as computed (`run.simulated_compute_ms`).
    pub(super) not_before: MonoNs,
}

/// An order that waits for its ping, with the instants at which the ping is due.
#[derive(Clone, Copy, Debug)]
pub(super) struct Waiting {
    pub(super) sonar: usize,
    pub(super) order: PingOrder,
    /// Delay of the pulse behind the regular schedule.
    pub(super) put_off_s: f64,
    /// How long it needs the motion of the platform.
    pub(super) motion_s: f64,
    pub(super) due: Deadlines,
}

/// State of the pipeline thread.
pub(super) struct Pacer {
    pub(super) rig: Rig,
    /// Cost estimates and degradation levels of the pings, one per sonar.
    pub(super) levels: Vec<DegradationLevels>,
    /// Load of the pipeline, shared with the scheduler thread.
    pub(super) backlog: Arc<Backlog>,
    /// Whether the pipeline has been idle since the last ping. If so, no earlier ping delayed the current one.
    pub(super) has_rested: bool,
    /// Per sonar: whether its last ping was skipped because of lateness.
    pub(super) skipped: Vec<bool>,
    /// Instant at which the first tile of the current streamed ping was ready.
    pub(super) first_ready: Option<MonoNs>,
    pub(super) inputs: NavInputs,
    pub(super) nav_out: NavOutputs,
    pub(super) settings: Vec<Arc<SettingsStore>>,
    /// Per sonar: version of the settings for which the pipeline last prepared.
    pub(super) expected: Vec<u64>,
    pub(super) control: Arc<RunControl>,
    pub(super) clock: Arc<dyn Clock>,
    /// Real clock, which measures computing times.
    pub(super) machine: SystemClock,
    pub(super) stop: Arc<AtomicBool>,
    /// Instant of the first ping, once known.
    pub(super) first: Option<UtcNs>,
    /// Trigger inputs and outputs, until the scheduler takes them.
    pub(super) triggers: Option<Triggers>,
    /// Orders sorted by transmit time.
    pub(super) waiting: VecDeque<Waiting>,
    /// Orders whose pings were skipped and whose motion the method selection has not seen yet, by sonar.
    pub(super) unexamined: Vec<VecDeque<PingOrder>>,
    pub(super) lanes: Vec<Lane>,
    /// Read also by the servers, to stamp their answers.
    pub(super) timeline: Arc<OnceLock<Timeline>>,
    /// Next publication of the navigation's counters, real time.
    pub(super) next_nav_lines: MonoNs,
}

/// Decision about the order at the front of the queue.
pub(super) enum Decision {
    /// Make the ping now, in this slot.
    Make(Paced, Box<PingSlot>),
    /// Skip the ping and count it.
    Skip,
    /// Decide again at this instant at the latest.
    Wait(MonoNs),
}

impl Pacer {
    pub(super) fn run(mut self) -> Result<(), DaemonError> {
        let Some(timeline) = self.start()? else {
            return Ok(());
        };
        // Set only here. Answers stamped before this point carry the host's time.
        let timeline = *self.timeline.get_or_init(|| timeline);
        self.inputs.set_timeline(timeline);
        let Some(scheduler) = self.scheduler(timeline) else {
            return Ok(());
        };
        let (sender, orders) = bounded(MAX_ORDERS);
        let next_order = scheduler.next_order();
        let priority = self.rig.spec.run.priority;
        let _thread = match scheduler.start(sender, priority) {
            Ok(thread) => thread,
            Err(why) => {
                tracing::error!(error = %why, "could not start the thread that orders pings");
                self.stop.store(true, Ordering::Release);
                return Ok(());
            }
        };
        while !self.stop.load(Ordering::Acquire) {
            let now = self.clock.mono();
            let utc = timeline.utc(now);
            // Read `next_order` before taking the orders: every order not taken below then has a pulse at `next` or later.
            let next = next_order.next();
            self.take_orders(&orders, &timeline);
            let known = self.known_until(utc, next);
            self.inputs.pull(known, &mut self.rig.history);
            self.renew_nav_lines();
            self.nav_out.publish(&mut self.rig.history, now, utc);
            self.expect_new_settings();
            let wait_until = match self.waiting.front().copied() {
                Some(front) => match self.decide(&front, now) {
                    Decision::Wait(until) => until,
                    decided => {
                        match decided {
                            Decision::Make(paced, slot) => {
                                self.ping_in_time(&front, now, paced, slot, &timeline);
                            }
                            _ => self.note_unexamined(front.sonar, front.order),
                        }
                        self.waiting.pop_front();
                        self.backlog.done(front.sonar);
                        continue;
                    }
                },
                None if self.inputs.finished() => return Ok(()),
                None => now.plus_ns(50 * POLL_NS),
            };
            let mut wait_until = wait_until.min(self.nav_out.next_publish());
            if self.inputs.is_behind() {
                wait_until = wait_until.min(now.plus_ns(POLL_NS));
            }
            self.has_rested = true;
            self.clock.wait_until(wait_until, &next_order.wake_up);
        }
        Ok(())
    }

    /// Lead of the order and computation of a ping before its pulse, nanoseconds.
    pub(super) fn ahead_ns(&self) -> i64 {
        self.rig.spec.run.ahead_ns()
    }

    /// Instant up to which recorded navigation may be read. In prediction mode a ping must not use samples from after its order, however late
    /// it is computed. `next` is the next pulse that can still be ordered.
    fn known_until(&self, utc: UtcNs, next: UtcNs) -> UtcNs {
        if self.rig.spec.nav.mode == NavMode::Settle {
            return utc;
        }
        let ordered = self.waiting.iter().map(|w| w.order.transmit_utc);
        let first = ordered.chain([next]).min();
        first.map_or(utc, |at| utc.min(at.plus_ns(-self.ahead_ns())))
    }

    /// Instant at which the recorded logs first hold the quantities that every ping needs and no live source provides. `None` if the daemon was
    /// stopped.
    pub(super) fn first_recorded(&mut self) -> Result<Option<UtcNs>, DaemonError> {
        let sources = self.rig.spec.nav.sources.clone();
        let is_recorded = |channel| {
            let gives = |s: &NavSourceSpec| s.provides.contains(&channel) && s.is_recorded();
            sources.iter().any(gives)
        };
        // A live source that was only detected as a possible sender of a quantity ranks behind a file that holds the quantity.
        let is_live = |channel| {
            let gives = |s: &NavSourceSpec| {
                let certain = !s.detect || !is_recorded(channel);
                s.provides.contains(&channel) && !s.is_recorded() && certain
            };
            sources.iter().any(gives)
        };
        if self.rig.history.silent().into_iter().all(is_live) {
            return Ok(self.inputs.recorded_start());
        }
        loop {
            let history = &self.rig.history;
            if let Some(first) = history.first_usable_utc_of(|channel| !is_live(channel)) {
                return Ok(Some(first));
            }
            if self.stop.load(Ordering::Acquire) {
                return Ok(None);
            }
            if self.inputs.is_all_known() {
                let missing = waiting::missing_quantities(&self.rig.spec.nav, history);
                return Err(DaemonError::NoNav(missing));
            }
            self.inputs.pull_next(&mut self.rig.history);
        }
    }

    pub(super) fn begin_schedules(&mut self, first: UtcNs) -> UtcNs {
        // Prediction needs navigation over the whole order lead before the first pulse.
        let first = first.plus_ns(self.ahead_ns());
        self.first = Some(first);
        self.inputs.note_start(first);
        self.rig.faults.begin(first);
        first
    }

    /// Creates the scheduler. Call once, after [`Self::begin_schedules`]; later calls return `None`.
    pub(super) fn scheduler(&mut self, timeline: Timeline) -> Option<PingScheduler> {
        let context = SchedulerContext {
            settings: self.settings.clone(),
            control: self.control.clone(),
            faults: self.rig.faults.clone(),
            clock: self.clock.clone(),
            backlog: self.backlog.clone(),
        };
        let triggers = self.triggers.take()?;
        let spec = &self.rig.spec;
        Some(PingScheduler::new(
            spec,
            self.first?,
            timeline,
            context,
            triggers,
        ))
    }

    /// Waits for the first navigation and aligns rig time with the clock. `None` if stopped before any navigation arrived.
    fn start(&mut self) -> Result<Option<Timeline>, DaemonError> {
        if self.inputs.recorded_start().is_some() {
            // Recorded log: start the timeline where the first ping is already complete, so that it is delivered at once.
            let Some(first) = self.first_recorded()? else {
                return Ok(None);
            };
            let first = self.begin_schedules(first);
            plan_all(&mut self.rig, &mut self.inputs, first);
            if let DeliverySpec::Streaming { .. } = self.rig.spec.run.delivery {
                // Streamed samples leave no earlier than their pulse, and the order precedes the pulse.
                let ordered = self.clock.mono().plus_ns(FIRST_PING_AFTER_NS);
                let first = first.plus_ns(-self.ahead_ns());
                return Ok(Some(Timeline::through(ordered, first)));
            }
            let latency_ns = (self.rig.spec.run.latency_s * NS_PER_S as f64) as i64;
            let sound_speed_m_per_s = self.rig.medium().sound_speed_m_per_s;
            let units = self.rig.sonars.iter();
            let window_s = units
                .map(|unit| echotank_ping::window_s(&unit.spec.settings, sound_speed_m_per_s))
                .fold(0.0, f64::max);
            let window_ns = (window_s * NS_PER_S as f64) as i64;
            return Ok(Some(Timeline::through(
                self.clock.mono().plus_ns(FIRST_PING_AFTER_NS),
                first.plus_ns(window_ns + latency_ns),
            )));
        }
        self.rig.make_starting_engines();
        while !self.stop.load(Ordering::Acquire) {
            let now = self.clock.mono();
            let rig_time = self.inputs.timeline();
            let utc = rig_time.map_or(UtcNs(i64::MAX), |timeline| timeline.utc(now));
            self.inputs.pull(utc, &mut self.rig.history);
            if let (Some(timeline), Some(first)) =
                (self.inputs.timeline(), self.rig.history.first_usable_utc())
            {
                self.begin_schedules(first.max(timeline.utc(now)));
                self.next_nav_lines = MonoNs(0);
                return Ok(Some(timeline));
            }
            self.renew_nav_lines_with(|pacer| {
                let reason =
                    waiting::reason(&pacer.rig.spec.nav, &mut pacer.inputs, &pacer.rig.history);
                vec![reason]
            });
            self.clock.sleep_until(now.plus_ns(POLL_NS));
        }
        Ok(None)
    }

    pub(super) fn renew_nav_lines(&mut self) {
        self.renew_nav_lines_with(|_| Vec::new());
    }

    fn renew_nav_lines_with(&mut self, first: impl FnOnce(&mut Self) -> Vec<String>) {
        self.control.note_iteration();
        let now = self.machine.mono();
        if now >= self.next_nav_lines {
            self.next_nav_lines = now.plus_ns(NAV_LINES_EVERY_NS);
            let history = &self.rig.history;
            let active = |channel| history.active_source(channel);
            let owners = owners_text(&self.rig.spec.nav, active);
            let owners = vec![format!("nav quantities: {owners}")];
            let of_channels = NavChannel::ALL.map(active);
            let lines = [
                first(self),
                owners,
                self.inputs.lines(),
                self.nav_out.lines(),
            ];
            self.control
                .set_nav(lines.concat(), self.inputs.sources(), of_channels);
        }
    }

    /// Prepares the pipelines for changed settings, before the first ping that uses them.
    pub(super) fn expect_new_settings(&mut self) {
        for (sonar, settings) in self.settings.iter().enumerate() {
            if settings.version() != self.expected[sonar] {
                let (settings, version) = settings.snapshot();
                self.rig.sonars[sonar].expect(&settings);
                self.expected[sonar] = version;
            }
        }
    }

    /// Moves all waiting orders from the scheduler to the queue, sorted by transmit time.
    fn take_orders(&mut self, orders: &Receiver<Ordered>, timeline: &Timeline) {
        let ended = match self.inputs.finished() {
            true => self.inputs.recorded_end(),
            false => None,
        };
        for ordered in orders.try_iter() {
            let Ordered {
                sonar,
                order,
                put_off_s,
            } = ordered;
            // The scheduler can order a few pings past the end of the log; they are dropped.
            if ended.is_some_and(|end| order.transmit_utc >= end) {
                self.backlog.done(sonar);
                continue;
            }
            if self.waiting.len() >= MAX_ORDERS {
                self.backlog.done(sonar);
                add(&self.counters(sonar).skipped_queue, 1);
                self.note_overload(SKIPPED, sonar, &order, OverloadState::NONE);
                self.note_unexamined(sonar, order);
                continue;
            }
            let window_s = self.rig.window_s(sonar, &order);
            let run = &self.rig.spec.run;
            let due = Deadlines {
                pulse: timeline.mono(order.transmit_utc),
                ready_by: timeline.mono(order.transmit_utc.plus_s(run.ready_after_s(window_s))),
                deadline: timeline.mono(order.transmit_utc.plus_s(window_s + run.latency_s)),
            };
            let place = self
                .waiting
                .partition_point(|w| w.order.transmit_utc <= order.transmit_utc);
            self.waiting.insert(
                place,
                Waiting {
                    sonar,
                    order,
                    put_off_s,
                    motion_s: self.rig.motion_s(sonar, &order),
                    due,
                },
            );
        }
    }

    /// Makes a ping that is due and records its cost.
    fn ping_in_time(
        &mut self,
        front: &Waiting,
        now: MonoNs,
        paced: Paced,
        slot: Box<PingSlot>,
        timeline: &Timeline,
    ) {
        let (sonar, deadline) = (front.sonar, front.due.ready_by);
        self.has_rested = false;
        self.backlog.begun(now.0);
        self.ping(sonar, &front.order, Some(paced), slot, timeline);
        let whole = self.clock.mono();
        let ready = self.first_ready.take().unwrap_or(whole);
        let levels = &mut self.levels[sonar];
        levels.note(ready.0 - now.0, ready <= deadline);
        self.backlog.costs(sonar, levels.now_ns());
    }

    /// Makes a ping, accounts for it and hands it over. Returns false, and counts the ping, if it cannot be made or is too late.
    pub(super) fn ping(
        &mut self,
        sonar: usize,
        order: &PingOrder,
        paced: Option<Paced>,
        mut slot: Box<PingSlot>,
        timeline: &Timeline,
    ) -> bool {
        let began = self.machine.mono();
        let level = paced.map_or(0, |paced| paced.level);
        self.examine_skipped(sonar, order, &mut slot, timeline);
        self.inputs.note_ping(sonar, order, level);
        self.take_profile(order, timeline);
        let made = self.make(sonar, order, paced, &mut slot, timeline);
        let Some(samples) = self.account(sonar, order, paced, made, began, &mut slot) else {
            self.lanes[sonar].spare = Some(slot);
            return false;
        };
        self.hand_over(sonar, paced, slot, samples);
        true
    }

    /// Takes the sound speed profile in force at the pulse.
    fn take_profile(&mut self, order: &PingOrder, timeline: &Timeline) {
        if let Some(profile) = self.control.profile_at(timeline.mono(order.transmit_utc)) {
            self.rig.set_profile(profile);
        }
    }

    /// Remembers an order that is skipped. Later selections depend on its motion, as if it had been made.
    fn note_unexamined(&mut self, sonar: usize, order: PingOrder) {
        let skipped = &mut self.unexamined[sonar];
        if skipped.len() < MAX_ORDERS {
            // Orders that find the queue full are skipped before older ones.
            let place = skipped.partition_point(|o| o.transmit_utc <= order.transmit_utc);
            skipped.insert(place, order);
        }
    }

    /// Lets the method selection see the motion of the pings that were skipped before `order`, whose navigation has arrived by now. In a gap of the
    /// navigation there is nothing to see.
    fn examine_skipped(
        &mut self,
        sonar: usize,
        order: &PingOrder,
        slot: &mut PingSlot,
        timeline: &Timeline,
    ) {
        let mode = self.rig.spec.nav.mode;
        let c = self.rig.medium().sound_speed_m_per_s;
        let first = order.ping_number;
        let is_before = |skipped: &&PingOrder| skipped.ping_number < first;
        while let Some(skipped) = self.unexamined[sonar].front().filter(is_before).copied() {
            self.unexamined[sonar].pop_front();
            if is_examined_before(first, &skipped, c) {
                self.inputs.note_skipped(sonar, &skipped);
                self.take_profile(&skipped, timeline);
                let _gap = self.rig.examine(sonar, &skipped, mode, slot);
            }
        }
    }

    /// Decides whether the ping at the front is made now, and at which degradation level. A ping needs its navigation, a free slot and enough time.
    fn decide(&mut self, front: &Waiting, now: MonoNs) -> Decision {
        let Waiting {
            sonar,
            order,
            motion_s,
            due,
            put_off_s,
        } = *front;
        let deadline = due.ready_by;
        let is_covered = match self.rig.spec.nav.mode {
            NavMode::Predict => true,
            NavMode::Settle => {
                let end = order.transmit_utc.plus_s(motion_s);
                self.rig.history.coverage(order.transmit_utc, end) == Coverage::Ready
            }
        };
        if now >= deadline {
            match is_covered {
                true => self.skip_late(sonar, &order),
                false => add(&self.counters(sonar).skipped_nav, 1),
            }
            return Decision::Skip;
        }
        let again = Decision::Wait(now.plus_ns(POLL_NS).min(deadline));
        if !is_covered {
            return again;
        }
        let Some(slot) = self.lanes[sonar].slot() else {
            return again;
        };
        // A sonar is not skipped twice in a row because of a busy pipeline. Otherwise, with several sonars, one could be skipped for ever.
        let waited = !self.has_rested && !std::mem::take(&mut self.skipped[sonar]);
        let Some(level) = self.levels[sonar].choose(deadline.0 - now.0, waited) else {
            self.skip_late(sonar, &order);
            self.skipped[sonar] = true;
            self.lanes[sonar].spare = Some(slot);
            return Decision::Skip;
        };
        let simulated_s = self.rig.spec.run.simulated_compute_s * 0.5_f64.powi(level as i32);
        let paced = Paced {
            due,
            level,
            put_off_s,
            not_before: now.plus_s(simulated_s),
        };
        Decision::Make(paced, slot)
    }

    /// Makes the ping in `slot`: tile by tile if its samples stream in tiles, else in one call. Returns the part that was already sent.
    fn make(
        &mut self,
        sonar: usize,
        order: &PingOrder,
        paced: Option<Paced>,
        slot: &mut PingSlot,
        timeline: &Timeline,
    ) -> Result<Streamed, NavGap> {
        let mode = self.rig.spec.nav.mode;
        let host_now = self.clock.host_utc();
        let host_utc = host_now.plus_ns(timeline.mono(order.transmit_utc).0 - self.clock.mono().0);
        let mut streamed = Streamed::default();
        let made = match paced.filter(|_| self.rig.spec.run.stream_tiles) {
            Some(Paced { due, .. }) => {
                let rig = &mut self.rig;
                make_ping::motion(rig, sonar, order, mode, host_utc, slot).map(|()| {
                    self.send_tiles(sonar, slot, due, true, &mut streamed);
                    make_ping::gather(&mut self.rig, sonar, slot);
                    self.send_tiles(sonar, slot, due, false, &mut streamed);
                    self.first_ready = streamed.first_ready;
                    finish_ping(&mut self.rig, sonar, slot);
                    slot.output.overload_state = OverloadState::NONE;
                })
            }
            None => {
                let level = paced.map_or(0, |paced| paced.level);
                make_degraded_ping(&mut self.rig, level, sonar, order, mode, host_utc, slot)
            }
        };
        if let Some(paced) = paced {
            self.clock.sleep_until(paced.not_before);
        }
        made.map(|()| streamed)
    }

    /// Counts the ping and logs every sign of overload. Returns the samples still to be sent, or `None` if the ping is skipped.
    fn account(
        &self,
        sonar: usize,
        order: &PingOrder,
        paced: Option<Paced>,
        made: Result<Streamed, NavGap>,
        began: MonoNs,
        slot: &mut PingSlot,
    ) -> Option<Range<usize>> {
        let Ok(streamed) = made else {
            add(&self.counters(sonar).skipped_nav, 1);
            return None;
        };
        if let Some(put_off_s) = paced.map(|paced| paced.put_off_s).filter(|s| *s > 0.0) {
            slot.output.overload_state.put_off_s = put_off_s;
            // The interval to the previous pulse grew, so the ping rate is lower.
            slot.plan.ping_rate_hz = 1.0 / (1.0 / slot.plan.ping_rate_hz + put_off_s);
        }
        let due = paced.map(|paced| paced.due);
        let samples = self.samples_left(sonar, order, due, &streamed, slot.plan.sample_count)?;
        let overload_state = slot.output.overload_state;
        if overload_state.tolerance.is_some() {
            self.note_overload("degraded", sonar, order, overload_state);
        }
        if overload_state.put_off_s > 0.0 {
            self.note_overload("stretched", sonar, order, overload_state);
        }
        let first_ready = streamed.first_ready.unwrap_or_else(|| self.clock.mono());
        if due.is_some_and(|due| first_ready > due.ready_by) {
            self.note_overload("late", sonar, order, overload_state);
        }
        self.count(sonar, paced, began, first_ready, slot);
        Some(samples)
    }

    /// Range of samples still to be sent: empty after a gap in the stream, `None` if the first samples are too late.
    fn samples_left(
        &self,
        sonar: usize,
        order: &PingOrder,
        due: Option<Deadlines>,
        streamed: &Streamed,
        total: usize,
    ) -> Option<Range<usize>> {
        let Some(due) = due else {
            return Some(streamed.samples..total);
        };
        let is_stream = self.rig.spec.run.delivery != DeliverySpec::PingEnd;
        if streamed.samples > 0 {
            if self.clock.mono() > self.block_due(sonar, due, streamed.samples) {
                add(&self.counters(sonar).truncated, 1);
                self.note_overload("truncated", sonar, order, OverloadState::NONE);
                return Some(total..total);
            }
        } else if is_stream && self.clock.mono() > due.ready_by {
            // Late first samples would break the constant latency of the stream.
            self.skip_late(sonar, order);
            return None;
        }
        Some(streamed.samples..total)
    }

    /// Updates the counters and histograms for a ping that was made.
    fn count(
        &self,
        sonar: usize,
        paced: Option<Paced>,
        began: MonoNs,
        first_ready: MonoNs,
        slot: &PingSlot,
    ) {
        let SonarControl {
            counters,
            histograms,
            ..
        } = &self.control.sonars()[sonar];
        let output = &slot.output;
        let saturated = output.elements.iter().map(|frame| frame.saturated).sum();
        let took_us = (self.machine.mono().0 - began.0).max(0) as u64 / 1000;
        counters.ping(&output.counts, saturated, took_us);
        counters.scene(&output.scene);
        counters.errors_of(output, &self.rig.sonars[sonar]);
        let level = paced.map_or(0, |paced| paced.level);
        counters.overload_state(level, &output.overload_state);
        counters.nav(&slot.plan.nav);
        if let Some(Paced { due, .. }) = paced {
            histograms.margin_us(due.ready_by.0 - first_ready.0);
            histograms.nav_to_samples_us(first_ready.0 - due.pulse.0);
        }
    }

    /// Passes the ping to the delivery thread of its sonar.
    fn hand_over(
        &mut self,
        sonar: usize,
        paced: Option<Paced>,
        slot: Box<PingSlot>,
        samples: Range<usize>,
    ) {
        let delivery = Delivery {
            slot,
            due: paced.map(|paced| paced.due),
            samples,
            is_tile: false,
        };
        // The queue holds all slots, so it is never full. If the delivery thread has ended, the daemon stops.
        if let Err(TrySendError::Disconnected(_)) = self.lanes[sonar].to_delivery.try_send(delivery)
        {
            self.stop.store(true, Ordering::Release);
        }
    }

    /// Instant at which the block that begins with `sample` is due.
    fn block_due(&self, sonar: usize, due: Deadlines, sample: usize) -> MonoNs {
        let rate_hz = self.rig.sonars[sonar].spec.receiver.sample_rate_hz;
        due.ready_by.plus_s(sample as f64 / rate_hz)
    }

    /// Makes tiles of a ping and sends them while they are in time and slots are free. `quiet` selects the tiles before the first possible echo,
    /// which need only the plan of the ping. The other tiles need the gathered scatterers.
    fn send_tiles(
        &mut self,
        sonar: usize,
        slot: &mut PingSlot,
        due: Deadlines,
        quiet: bool,
        streamed: &mut Streamed,
    ) {
        let DeliverySpec::Streaming { block_s, .. } = self.rig.spec.run.delivery else {
            return;
        };
        let rate_hz = self.rig.sonars[sonar].spec.receiver.sample_rate_hz;
        let samples = slot.plan.sample_count;
        for (blocks, end) in tile_ends(streamed.blocks, samples, rate_hz, block_s) {
            let Some(mut tile) = self.lanes[sonar].tile() else {
                return;
            };
            let made = match quiet {
                true => self.rig.begin_quiet(sonar, slot, end, &mut tile),
                false => {
                    let is_first = !std::mem::replace(&mut streamed.is_heard, true);
                    self.rig.begin(sonar, slot, (end, is_first), &mut tile)
                }
            };
            let now = self.clock.mono();
            if !made || now > self.block_due(sonar, due, streamed.samples) {
                self.lanes[sonar].spare_tile = Some(tile);
                return;
            }
            streamed.first_ready.get_or_insert(now);
            let delivery = Delivery {
                slot: tile,
                due: Some(due),
                samples: streamed.samples..end,
                is_tile: true,
            };
            // The queue has room for every slot.
            let _ = self.lanes[sonar].to_delivery.try_send(delivery);
            (streamed.samples, streamed.blocks) = (end, blocks);
        }
    }

    /// Counts a ping that is too late and logs it as a sign of overload.
    fn skip_late(&self, sonar: usize, order: &PingOrder) {
        add(&self.counters(sonar).skipped_late, 1);
        self.note_overload(SKIPPED, sonar, order, OverloadState::NONE);
    }

    /// Adds a record to the overload log.
    fn note_overload(
        &self,
        what: &'static str,
        sonar: usize,
        order: &PingOrder,
        overload_state: OverloadState,
    ) {
        let put_off = Some(overload_state.put_off_s).filter(|put_off_s| *put_off_s > 0.0);
        self.control.overload_states().note(OverloadRecord {
            what,
            sonar: self.control.sonars()[sonar].name.clone(),
            ping_number: order.ping_number,
            utc_ns: order.transmit_utc.0,
            tolerance: overload_state.tolerance,
            put_off_ms: put_off.map(|put_off_s| put_off_s * 1e3),
        });
    }

    fn counters(&self, sonar: usize) -> &PingCounters {
        &self.control.sonars()[sonar].counters
    }
}

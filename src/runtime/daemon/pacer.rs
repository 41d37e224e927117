//! The pacer: turns the passing of time into orders, and orders into pings that leave on time.
//!
//! Each order is *decided* (make, skip or wait), *made*, *accounted* for and *handed over* to the delivery thread of its sonar.

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
use echotank_ping::rig::{PingSlot, Rig};
use echotank_ping::{PingOrder, finish_ping, make_degraded_ping, make_ping};

use super::DaemonError;
use super::beat::{Beat, BeatContext, Ordered};
use super::delivery::{Delivery, Due, Lane};
use super::triggers::Triggers;
use crate::clock::{Clock, SystemClock};
use crate::control::{RunControl, SonarControl};
use crate::counters::{PingCounters, add};
use crate::io::nav::NavInputs;
use crate::io::nav::output::NavOutputs;
use crate::overload::{Backlog, DegradationLevels, OverloadRecord};
use crate::rig::plan_all;
use crate::settings::SettingsStore;
use crate::tiles::tile_ends;
use crate::waiting;

/// Longest the pipeline sleeps when it waits for something that no clock announces (a live sample, a free slot).
pub(super) const POLL_NS: i64 = 2_000_000;

/// With recorded navigation the first ping is due this long after the start: time to open the doors and to compute it.
pub(super) const FIRST_PING_AFTER_NS: i64 = 500_000_000;

/// How often the navigation's counters and states are written down for whoever prints.
pub(super) const NAV_LINES_EVERY_NS: i64 = NS_PER_S / 4;

/// Orders that may wait for their navigation: 50 pings/s over 20 s of latency.
pub(super) const MAX_ORDERS: usize = 1000;

/// What of a ping has left before it was whole.
#[derive(Clone, Copy, Default)]
pub(super) struct Streamed {
    /// The first of them that have not.
    pub(super) samples: usize,
    /// Whole blocks that have.
    pub(super) blocks: u32,
    /// Something can be heard in what has.
    pub(super) is_heard: bool,
    /// When the first tile was made.
    pub(super) first_ready: Option<MonoNs>,
}

/// How a ping is made where time is the machine's.
#[derive(Clone, Copy)]
pub(super) struct Paced {
    pub(super) due: Due,
    /// How loose it is.
    pub(super) level: usize,
    pub(super) put_off_s: f64,
    /// It counts as made no earlier than this (`run.simulated_compute_ms`).
    pub(super) not_before: MonoNs,
}

/// An order with its sonar and when its ping is due.
#[derive(Clone, Copy, Debug)]
pub(super) struct Waiting {
    pub(super) sonar: usize,
    pub(super) order: PingOrder,
    /// How much later its pulse is than the beat had it.
    pub(super) put_off_s: f64,
    pub(super) window_s: f64,
    pub(super) due: Due,
}

/// Turns the passing of time into orders, and orders into pings.
pub(super) struct Pacer {
    pub(super) rig: Rig,
    /// What pings cost and how loose they are, one per sonar.
    pub(super) levels: Vec<DegradationLevels>,
    /// What the beat is told of that.
    pub(super) backlog: Arc<Backlog>,
    /// It has had nothing to do since the last ping: no ping before it is to blame for what is late now.
    pub(super) has_rested: bool,
    /// Of each sonar: its last ping was skipped before its time.
    pub(super) skipped: Vec<bool>,
    /// Of a ping that was made tile by tile: when the first was.
    pub(super) first_ready: Option<MonoNs>,
    pub(super) inputs: NavInputs,
    pub(super) nav_out: NavOutputs,
    pub(super) settings: Vec<Arc<SettingsStore>>,
    /// Versions of the settings that the pipelines have been told of.
    pub(super) expected: Vec<u64>,
    pub(super) control: Arc<RunControl>,
    pub(super) clock: Arc<dyn Clock>,
    /// Tells how long computing took.
    pub(super) machine: SystemClock,
    pub(super) stop: Arc<AtomicBool>,
    /// Of the first ping, once it is known.
    pub(super) first: Option<UtcNs>,
    /// Until the beat has them.
    pub(super) triggers: Option<Triggers>,
    /// In order of `t_tx`.
    pub(super) waiting: VecDeque<Waiting>,
    /// One per sonar.
    pub(super) lanes: Vec<Lane>,
    /// Read by whoever stamps answers.
    pub(super) timeline: Arc<OnceLock<Timeline>>,
    /// When the navigation's counters are next renewed for whoever looks, in the machine's time.
    pub(super) next_nav_lines: MonoNs,
}

/// What is done with the order at the front of the queue.
pub(super) enum Decision {
    /// Make it now, in this slot.
    Make(Paced, Box<PingSlot>),
    /// It is skipped, and counted.
    Skip,
    /// Something must come first: look again at this instant at the latest.
    Wait(MonoNs),
}

impl Pacer {
    pub(super) fn run(mut self) -> Result<(), DaemonError> {
        let Some(timeline) = self.start()? else {
            return Ok(());
        };
        // Set once, here; whoever asked before got the host's time.
        let timeline = *self.timeline.get_or_init(|| timeline);
        self.inputs.set_timeline(timeline);
        let Some(beat) = self.beat(timeline) else {
            return Ok(());
        };
        let (sender, orders) = bounded(MAX_ORDERS);
        let coming = beat.coming();
        let priority = self.rig.spec.run.priority;
        let _beat = match beat.start(sender, priority) {
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
            // Read first: an order that is not among those taken now is not before it.
            let next = coming.next();
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
                        if let Decision::Make(paced, slot) = decided {
                            self.ping_in_time(&front, now, paced, slot, &timeline);
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
            self.clock.wait_until(wait_until, &coming.wake_up);
        }
        Ok(())
    }

    /// How long before its pulse a ping is ordered and computed.
    pub(super) fn ahead_ns(&self) -> i64 {
        self.rig.spec.run.ahead_ns()
    }

    /// How far recorded navigation may be read: what was not known yet when a ping had to be expected must not be known to it, however late it
    /// is computed. `next`: the next pulse that may still be ordered.
    fn known_until(&self, utc: UtcNs, next: UtcNs) -> UtcNs {
        if self.rig.spec.nav.mode == NavMode::Settle {
            return utc;
        }
        let ordered = self.waiting.iter().map(|w| w.order.transmit_utc);
        let first = ordered.chain([next]).min();
        first.map_or(utc, |at| utc.min(at.plus_ns(-self.ahead_ns())))
    }

    /// When the recorded logs first hold what a ping needs of them (the rest is live); none where the daemon is stopped.
    pub(super) fn first_recorded(&mut self) -> Result<Option<UtcNs>, DaemonError> {
        let sources = self.rig.spec.nav.sources.clone();
        let is_recorded = |channel| {
            let gives = |s: &NavSourceSpec| s.provides.contains(&channel) && s.is_recorded();
            sources.iter().any(gives)
        };
        // A live source that only may send a quantity stands behind a file that holds it.
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
        // Known for long enough to foresee it.
        let first = first.plus_ns(self.ahead_ns());
        self.first = Some(first);
        self.rig.faults.begin(first);
        first
    }

    /// To be asked once, after [`Self::begin_schedules`].
    pub(super) fn beat(&mut self, timeline: Timeline) -> Option<Beat> {
        let context = BeatContext {
            settings: self.settings.clone(),
            control: self.control.clone(),
            faults: self.rig.faults.clone(),
            clock: self.clock.clone(),
            backlog: self.backlog.clone(),
        };
        let triggers = self.triggers.take()?;
        let spec = &self.rig.spec;
        Some(Beat::new(spec, self.first?, timeline, context, triggers))
    }

    /// Waits for the first navigation and lays rig time over the clock. None: stopped before there was any.
    fn start(&mut self) -> Result<Option<Timeline>, DaemonError> {
        if self.inputs.recorded_start().is_some() {
            // A recorded log: as though the daemon had been listening for as long as a ping takes to be delivered, so that the first one
            // leaves at once.
            let Some(first) = self.first_recorded()? else {
                return Ok(None);
            };
            let first = self.begin_schedules(first);
            plan_all(&mut self.rig, &mut self.inputs, first);
            if let DeliverySpec::Streaming { .. } = self.rig.spec.run.delivery {
                // Nothing of it may leave before its pulse, which is expected before that.
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
        self.control.beat();
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

    /// Tells the pipelines of settings that a topside has changed: what they need is made before the first ping that obeys them.
    pub(super) fn expect_new_settings(&mut self) {
        for (sonar, settings) in self.settings.iter().enumerate() {
            if settings.version() != self.expected[sonar] {
                let (settings, version) = settings.snapshot();
                self.rig.sonars[sonar].expect(&settings);
                self.expected[sonar] = version;
            }
        }
    }

    /// Puts down every ping whose instant has come.
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
            // A log that has ended makes no more pings; the beat may have gone on a little.
            if ended.is_some_and(|end| order.transmit_utc >= end) {
                self.backlog.done(sonar);
                continue;
            }
            if self.waiting.len() >= MAX_ORDERS {
                self.backlog.done(sonar);
                add(&self.counters(sonar).skipped_queue, 1);
                continue;
            }
            let window_s = self.rig.window_s(sonar, &order);
            let run = &self.rig.spec.run;
            let due = Due {
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
                    window_s,
                    due,
                },
            );
        }
    }

    /// Makes a ping that is due, and notes what it cost.
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

    /// Makes a ping, accounts for it and hands it over; false where it cannot be made or is too late, which is counted.
    pub(super) fn ping(
        &mut self,
        sonar: usize,
        order: &PingOrder,
        paced: Option<Paced>,
        mut slot: Box<PingSlot>,
        timeline: &Timeline,
    ) -> bool {
        let began = self.machine.mono();
        let made = self.make(sonar, order, paced, &mut slot, timeline);
        let Some(samples) = self.account(sonar, order, paced, made, began, &mut slot) else {
            self.lanes[sonar].spare = Some(slot);
            return false;
        };
        self.hand_over(sonar, paced, slot, samples);
        true
    }

    /// Whether the ping at the front is made now, and how loosely: it needs its navigation, a free slot and enough time before its deadline.
    fn decide(&mut self, front: &Waiting, now: MonoNs) -> Decision {
        let Waiting {
            sonar,
            order,
            window_s,
            due,
            put_off_s,
        } = *front;
        let deadline = due.ready_by;
        let is_covered = match self.rig.spec.nav.mode {
            NavMode::Predict => true,
            NavMode::Settle => {
                let end = order.transmit_utc.plus_s(window_s);
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
        // Never two in a row: with several sonars each would find the pipeline busy with another's, and one of them be skipped for ever.
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

    /// Makes the ping in `slot`: tile by tile where it streams so, else at once. Returns what of it has left already.
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

    /// Counts the ping and notes every sign of overload. Returns its samples that have yet to leave; none where the ping is skipped.
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
            // The rate actually kept.
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

    /// The samples that may still leave: all but those that have, none behind a break in the stream. None at all where the first are too late.
    fn samples_left(
        &self,
        sonar: usize,
        order: &PingOrder,
        due: Option<Due>,
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
            // With its first samples late the latency would not be constant.
            self.skip_late(sonar, order);
            return None;
        }
        Some(streamed.samples..total)
    }

    /// Counters and histograms of a ping that was made.
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
        counters.error_check(output.error_check.as_ref());
        let level = paced.map_or(0, |paced| paced.level);
        counters.overload_state(level, &output.overload_state);
        if let Some(planner) = &self.rig.sonars[sonar].planner {
            counters.plan(output.methods.as_ref(), &planner.counts);
        }
        counters.nav(&slot.plan.nav);
        if let Some(Paced { due, .. }) = paced {
            histograms.margin_us(due.ready_by.0 - first_ready.0);
            histograms.nav_to_samples_us(first_ready.0 - due.pulse.0);
        }
    }

    /// Gives the ping to the sonar's delivery thread.
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
        // The queue holds as many as there are slots, so it is never full; a delivery thread that is gone ends the daemon.
        if let Err(TrySendError::Disconnected(_)) = self.lanes[sonar].to_delivery.try_send(delivery)
        {
            self.stop.store(true, Ordering::Release);
        }
    }

    /// When the block that begins with a sample leaves.
    fn block_due(&self, sonar: usize, due: Due, sample: usize) -> MonoNs {
        let rate_hz = self.rig.sonars[sonar].spec.receiver.sample_rate_hz;
        due.ready_by.plus_s(sample as f64 / rate_hz)
    }

    /// Makes tiles of a ping and lets them leave, as long as they are in time and there is room: those in which nothing can be heard (`quiet`), of a
    /// ping that is planned; the others of one that is prepared.
    fn send_tiles(
        &mut self,
        sonar: usize,
        slot: &mut PingSlot,
        due: Due,
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
            // The queue has room for every slot there is.
            let _ = self.lanes[sonar].to_delivery.try_send(delivery);
            (streamed.samples, streamed.blocks) = (end, blocks);
        }
    }

    /// Counts a ping that comes too late and notes it as a sign of overload.
    fn skip_late(&self, sonar: usize, order: &PingOrder) {
        add(&self.counters(sonar).skipped_late, 1);
        self.note_overload("skipped", sonar, order, OverloadState::NONE);
    }

    /// Writes a line of the overload log.
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

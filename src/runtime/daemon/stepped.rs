//! `fast` and `lockstep`: time goes from pulse to pulse, as `replay` has it, with the outputs and the topsides live.

use std::sync::atomic::Ordering;
use std::time::Duration;

use super::DaemonError;
use super::delivery::Lane;
use super::pacer::{FIRST_PING_AFTER_NS, POLL_NS, Pacer};
use crate::clock::Clock;
use echotank_core::time::Timeline;
use echotank_ping::rig::PingSlot;

/// Waiting for a slot, the pipeline looks this often whether the daemon stops.
const LOOK: Duration = Duration::from_millis(50);

impl Lane {
    /// Waits for a slot; none when the delivery thread has ended.
    fn next_slot(&mut self, stopped: impl Fn() -> bool) -> Option<Box<PingSlot>> {
        if let Some(spare) = self.spare.take() {
            return Some(spare);
        }
        while !stopped() {
            match self.free.recv_timeout(LOOK) {
                Ok(slot) => return Some(slot),
                Err(error) if error.is_timeout() => {}
                Err(_) => return None,
            }
        }
        None
    }
}

impl Pacer {
    /// Pings until the navigation ends or the daemon stops.
    pub(super) fn run_stepped(mut self) -> Result<(), DaemonError> {
        let Some(first) = self.first_recorded()? else {
            return Ok(());
        };
        let first = self.begin_schedules(first);
        crate::rig::plan_all(&mut self.rig, &mut self.inputs, first);
        // What is told before the first pulse is earlier than it.
        let first_mono = self.clock.mono().plus_ns(FIRST_PING_AFTER_NS);
        let timeline = *self
            .timeline
            .get_or_init(|| Timeline::through(first_mono, first));
        self.inputs.set_timeline(timeline);
        let Some(mut beat) = self.beat(timeline) else {
            return Ok(());
        };
        let gate = self.control.gate().clone();
        let mut handed_over = 0;
        loop {
            self.renew_nav_lines();
            if !gate.wait_open() || self.stop.load(Ordering::Acquire) {
                return Ok(());
            }
            self.expect_new_settings();
            let Some(at) = beat.next_pulse() else {
                // Nobody pings: time stands until somebody is told to.
                self.machine
                    .sleep_until(self.machine.mono().plus_ns(POLL_NS));
                continue;
            };
            self.clock.sleep_until(timeline.mono(at));
            let Some((sonar, order)) = beat.next(at) else {
                continue;
            };
            if !crate::rig::read_navigation_for(&mut self.rig, &mut self.inputs, sonar, &order) {
                return Ok(());
            }
            let stop = self.stop.clone();
            let Some(slot) = self.lanes[sonar].next_slot(|| stop.load(Ordering::Acquire)) else {
                return Ok(());
            };
            if self.ping(sonar, &order, None, slot, &timeline) {
                handed_over += 1;
                // A step is over when its ping has left: whoever asked for it may change settings for the next.
                if gate.is_paused() && !gate.wait_delivered(handed_over) {
                    return Ok(());
                }
            }
        }
    }
}

//! Clocks `fast` and `lockstep`: time advances from pulse to pulse, as in `replay`, with live outputs and clients.

use std::sync::atomic::Ordering;
use std::time::Duration;

use super::DaemonError;
use super::delivery::Lane;
use super::pacer::{FIRST_PING_AFTER_NS, POLL_NS, Pacer};
use crate::clock::Clock;
use echotank_core::time::Timeline;
use echotank_ping::rig::PingSlot;

/// Interval between checks of the stop flag while the pipeline waits for a slot.
const STOP_CHECK_INTERVAL: Duration = Duration::from_millis(50);

impl Lane {
    /// Waits for a free slot. `None` if `stopped` returns true or the delivery thread has ended.
    fn next_slot(&mut self, stopped: impl Fn() -> bool) -> Option<Box<PingSlot>> {
        if let Some(spare) = self.spare.take() {
            return Some(spare);
        }
        while !stopped() {
            match self.free.recv_timeout(STOP_CHECK_INTERVAL) {
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
        // The clock starts before the first pulse, so answers before the first pulse carry an earlier time.
        let first_mono = self.clock.mono().plus_ns(FIRST_PING_AFTER_NS);
        let timeline = *self
            .timeline
            .get_or_init(|| Timeline::through(first_mono, first));
        self.inputs.set_timeline(timeline);
        let Some(mut scheduler) = self.scheduler(timeline) else {
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
            let Some(at) = scheduler.next_pulse() else {
                // No sonar pings: time does not advance until a client changes the settings.
                self.machine
                    .sleep_until(self.machine.mono().plus_ns(POLL_NS));
                continue;
            };
            self.clock.sleep_until(timeline.mono(at));
            let Some((sonar, order)) = scheduler.next(at) else {
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
                // A step ends when its ping is delivered. Clients can then change the settings for the next ping.
                if gate.is_paused() && !gate.wait_delivered(handed_over) {
                    return Ok(());
                }
            }
        }
    }
}

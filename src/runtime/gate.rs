//! Pause and step control: decides whether the next ping may be sent.
//!
//! With a `realtime` or `scaled` clock, a pause stops the clock ([`PacedClock::stop`]). With a `fast` or `lockstep` clock, a pause stops the ordering
//! of pings. A step allows one more ping and pauses again. `lockstep` starts paused.

use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use crate::clock::PacedClock;

/// Interval at which waiting threads check whether the daemon stops.
const POLL: Duration = Duration::from_millis(50);

/// Pause state of a rig, shared by the pacing, delivery and control threads.
pub struct Gate {
    /// Pausable clock; `None` with a `fast` or `lockstep` clock.
    clock: Option<Arc<PacedClock>>,
    state: Mutex<State>,
    changed: Condvar,
}

#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
struct State {
    paused: bool,
    /// Number of pings still allowed while paused.
    steps: u64,
    /// Number of pings sent so far.
    delivered: u64,
    /// Whether the daemon is stopping and no thread waits any more.
    closed: bool,
}

impl State {
    fn holds(&self) -> bool {
        self.paused && self.steps == 0 && !self.closed
    }
}

impl Gate {
    /// Creates a gate that stops `clock` while paused. Pass `None` with a `fast` or `lockstep` clock.
    pub fn new(clock: Option<Arc<PacedClock>>, paused: bool) -> Self {
        let gate = Self {
            clock,
            state: Mutex::new(State {
                paused,
                ..State::default()
            }),
            changed: Condvar::new(),
        };
        gate.change(|_| {});
        gate
    }

    /// Pauses and cancels the remaining steps.
    pub fn pause(&self) {
        self.change(|state| {
            state.paused = true;
            state.steps = 0;
        });
    }

    /// Ends a pause.
    pub fn resume(&self) {
        self.change(|state| state.paused = false);
    }

    /// Allows `pings` more pings, then pauses.
    pub fn step(&self, pings: u64) {
        self.change(|state| {
            state.paused = true;
            state.steps = state.steps.saturating_add(pings);
        });
    }

    /// Counts a ping sent to the outputs.
    pub fn delivered(&self) {
        self.change(|state| {
            state.delivered += 1;
            state.steps = state.steps.saturating_sub(1);
        });
    }

    /// Releases all waiting threads because the daemon stops.
    pub fn close(&self) {
        self.change(|state| state.closed = true);
    }

    /// Whether no ping may be sent now.
    pub(crate) fn is_held(&self) -> bool {
        self.lock().holds()
    }

    /// Rig seconds per system second; `None` with a `fast` or `lockstep` clock.
    pub fn rate(&self) -> Option<f64> {
        self.clock.as_ref().map(|clock| clock.rate())
    }

    /// Changes the rate of the clock. Returns false with a `fast` or `lockstep` clock.
    pub fn set_rate(&self, rate: f64) -> bool {
        match &self.clock {
            Some(clock) => clock.set_rate(rate),
            None => return false,
        }
        true
    }

    pub(crate) fn is_paused(&self) -> bool {
        self.lock().paused
    }

    /// Number of pings sent to the outputs so far.
    pub fn pings_delivered(&self) -> u64 {
        self.lock().delivered
    }

    /// Waits until a ping may be sent. Returns false when the daemon stops.
    pub(crate) fn wait_open(&self) -> bool {
        let mut state = self.lock();
        while state.holds() {
            state = self.wait(state);
        }
        !state.closed
    }

    /// Waits until `pings` pings have been sent since the start. Returns false when the daemon stops.
    pub fn wait_delivered(&self, pings: u64) -> bool {
        let mut state = self.lock();
        while state.delivered < pings && !state.closed {
            state = self.wait(state);
        }
        !state.closed
    }

    fn wait<'a>(&self, state: MutexGuard<'a, State>) -> MutexGuard<'a, State> {
        self.changed
            .wait_timeout(state, POLL)
            .unwrap_or_else(PoisonError::into_inner)
            .0
    }

    fn change(&self, change: impl FnOnce(&mut State)) {
        let mut state = self.lock();
        change(&mut state);
        if let Some(clock) = &self.clock {
            if state.holds() {
                clock.stop();
            } else {
                clock.restart();
            }
        }
        self.changed.notify_all();
    }

    fn lock(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_clock_stops_again_after_the_allowed_steps() {
        let clock = Arc::new(PacedClock::at_rate(1.0));
        let gate = Gate::new(Some(clock.clone()), false);
        assert!(!clock.is_stopped());
        gate.pause();
        assert!(clock.is_stopped());
        gate.step(2);
        assert!(!clock.is_stopped());
        gate.delivered();
        assert!(!clock.is_stopped(), "one step remains");
        gate.delivered();
        assert!(clock.is_stopped() && gate.is_paused());
        gate.resume();
        assert!(!clock.is_stopped());
        gate.pause();
        gate.close();
        assert!(!clock.is_stopped(), "a closed gate lets the clock run");
        assert!(!gate.wait_open());
    }

    #[test]
    fn a_step_releases_a_waiting_thread() {
        let gate = Gate::new(None, true);
        std::thread::scope(|scope| {
            let waiter = scope.spawn(|| gate.wait_open());
            gate.step(1);
            assert!(waiter.join().expect("woken"));
        });
        gate.delivered();
        assert!(gate.wait_delivered(1));
        assert!(gate.lock().holds());
    }
}

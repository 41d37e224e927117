//! Pause and step: whether the next ping may leave.
//!
//! Paused, a rig whose time is the machine's stands still in the middle of whatever it does ([`PacedClock::stop`]); a rig that makes its own
//! time (`fast`, `lockstep`) orders no ping. A step lets one more ping out and pauses again. `lockstep` begins paused and stays so.

use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use crate::clock::PacedClock;

/// Waiting threads look this often whether the daemon stops.
const LOOK: Duration = Duration::from_millis(50);

pub struct Gate {
    /// Time that can be stopped; none where the rig makes its own.
    clock: Option<Arc<PacedClock>>,
    state: Mutex<State>,
    changed: Condvar,
}

#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
struct State {
    paused: bool,
    /// Pings that may still leave while paused.
    steps: u64,
    /// Pings that have left.
    delivered: u64,
    /// The daemon stops: everything passes.
    closed: bool,
}

impl State {
    fn holds(&self) -> bool {
        self.paused && self.steps == 0 && !self.closed
    }
}

impl Gate {
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

    pub fn pause(&self) {
        self.change(|state| {
            state.paused = true;
            state.steps = 0;
        });
    }

    pub fn resume(&self) {
        self.change(|state| state.paused = false);
    }

    /// Lets so many more pings out, and pauses.
    pub fn step(&self, pings: u64) {
        self.change(|state| {
            state.paused = true;
            state.steps = state.steps.saturating_add(pings);
        });
    }

    /// A ping has left.
    pub fn delivered(&self) {
        self.change(|state| {
            state.delivered += 1;
            state.steps = state.steps.saturating_sub(1);
        });
    }

    /// The daemon stops: nobody waits any more.
    pub fn close(&self) {
        self.change(|state| state.closed = true);
    }

    /// Nothing may leave now.
    pub(crate) fn is_held(&self) -> bool {
        self.lock().holds()
    }

    /// How many times as fast as the machine's its time goes; none where the rig makes its own.
    pub fn rate(&self) -> Option<f64> {
        self.clock.as_ref().map(|clock| clock.rate())
    }

    /// Lets time go at another rate; false where the rig makes its own.
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

    pub fn pings_delivered(&self) -> u64 {
        self.lock().delivered
    }

    /// Waits until a ping may be made; false when the daemon stops.
    pub(crate) fn wait_open(&self) -> bool {
        let mut state = self.lock();
        while state.holds() {
            state = self.wait(state);
        }
        !state.closed
    }

    /// Waits until so many pings have left; false when the daemon stops.
    pub fn wait_delivered(&self, pings: u64) -> bool {
        let mut state = self.lock();
        while state.delivered < pings && !state.closed {
            state = self.wait(state);
        }
        !state.closed
    }

    fn wait<'a>(&self, state: MutexGuard<'a, State>) -> MutexGuard<'a, State> {
        self.changed
            .wait_timeout(state, LOOK)
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
                clock.go();
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
    fn a_step_lets_one_ping_out_and_time_stands_again() {
        let clock = Arc::new(PacedClock::at_rate(1.0));
        let gate = Gate::new(Some(clock.clone()), false);
        assert!(!clock.is_stopped());
        gate.pause();
        assert!(clock.is_stopped());
        gate.step(2);
        assert!(!clock.is_stopped());
        gate.delivered();
        assert!(!clock.is_stopped(), "one more may leave");
        gate.delivered();
        assert!(clock.is_stopped() && gate.is_paused());
        gate.resume();
        assert!(!clock.is_stopped());
        gate.pause();
        gate.close();
        assert!(!clock.is_stopped(), "what stops does not stand");
        assert!(!gate.wait_open());
    }

    #[test]
    fn who_waits_at_the_gate_passes_with_a_step() {
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

//! System resources of the daemon: clocks, scheduling priority, locked memory.

use std::sync::{Arc, OnceLock};
use std::thread;

use echotank_config::spec::{ClockSpec, StampSpec};
use echotank_core::time::Timeline;

use crate::clock::{Clock, PacedClock, SystemClock, VirtualClock};
use crate::gate::Gate;
use crate::io::priority;
use crate::io::sonar::RigTime;

/// Locks memory and tries a real-time priority. Returns the outcome as a remark.
pub(super) fn request_real_time(priority: u8) -> String {
    if priority == 0 {
        return "normal scheduling (run.priority = 0)".to_owned();
    }
    let locked = priority::lock_memory();
    // A separate thread: the calling thread keeps its ordinary scheduling.
    let tried = thread::spawn(move || priority::first_in_first_out(priority)).join();
    let real_time = tried.unwrap_or_else(|_| Err(std::io::ErrorKind::Other.into()));
    match (real_time, locked) {
        (Ok(()), Ok(())) => {
            format!("pings are delivered at SCHED_FIFO priority {priority}, memory is locked")
        }
        (real_time, locked) => {
            let why = |what, result: std::io::Result<()>| {
                result.err().map(|error| format!("{what}: {error}"))
            };
            let why: Vec<_> = [why("SCHED_FIFO", real_time), why("locked memory", locked)]
                .into_iter()
                .flatten()
                .collect();
            format!(
                "warning: pings may be late: {} (run `echotank doctor` for details)",
                why.join("; ")
            )
        }
    }
}

/// Tries the nice value of the computing threads, unless it is 0. Returns the outcome as a remark.
pub(super) fn preference(nice: i8) -> Option<String> {
    if nice == 0 {
        return None;
    }
    // A separate thread: the calling thread keeps its nice value.
    let tried = thread::spawn(move || priority::nice(nice)).join();
    Some(match tried {
        Ok(Ok(())) => format!("pings are computed at nice {nice}"),
        Ok(Err(error)) => format!(
            "warning: pings are computed at normal priority: cannot set nice {nice}: {error} (run `echotank doctor` for details)"
        ),
        Err(_) => "warning: pings are computed at normal priority".to_owned(),
    })
}

/// Clock of a mode, and the gate that pauses it.
pub(super) fn clock_of(mode: ClockSpec) -> (Arc<dyn Clock>, Arc<Gate>) {
    let rate = match mode {
        ClockSpec::RealTime => 1.0,
        ClockSpec::Scaled(rate) => rate,
        ClockSpec::Fast | ClockSpec::Lockstep => {
            let now = SystemClock::new().host_utc();
            let gate = Gate::new(None, mode == ClockSpec::Lockstep);
            return (Arc::new(VirtualClock::starting_at(now)), Arc::new(gate));
        }
    };
    let clock = Arc::new(PacedClock::at_rate(rate));
    (clock.clone(), Arc::new(Gate::new(Some(clock), false)))
}

/// Source of the time stamps in answers: the same clock as the pings.
pub(super) fn answer_time(
    stamp: StampSpec,
    clock: &Arc<dyn Clock>,
    timeline: &Arc<OnceLock<Timeline>>,
) -> RigTime {
    let (clock, timeline) = (clock.clone(), timeline.clone());
    Arc::new(move || match (stamp, timeline.get()) {
        (StampSpec::Log, Some(timeline)) => timeline.utc(clock.mono()),
        _ => clock.host_utc(),
    })
}

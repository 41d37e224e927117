//! What the kernel grants a program that must be punctual: real-time scheduling of a thread, and memory that stays in memory.

use std::io;

/// Puts the calling thread under SCHED_FIFO. Without CAP_SYS_NICE or a limit on rtprio this is refused.
pub fn first_in_first_out(priority: u8) -> io::Result<()> {
    let parameters = libc::sched_param {
        sched_priority: i32::from(priority),
    };
    // SAFETY: the pointer is to a live structure that the call only reads; pid 0 is the calling thread.
    let status = unsafe { libc::sched_setscheduler(0, libc::SCHED_FIFO, &parameters) };
    outcome(status)
}

/// The calling thread's scheduling: policy and priority.
pub fn scheduling() -> (i32, i32) {
    let mut parameters = libc::sched_param { sched_priority: 0 };
    // SAFETY: pid 0 is the calling thread; the structure is live and written by the call.
    let policy = unsafe {
        libc::sched_getparam(0, &mut parameters);
        libc::sched_getscheduler(0)
    };
    (policy, parameters.sched_priority)
}

/// Keeps every page in memory once it has been touched. Refused unless memory may be locked without limit: under a limit a later
/// allocation would fail instead.
pub fn lock_memory() -> io::Result<()> {
    if limit(Limit::LockedMemory) != u64::MAX && !is_root() {
        let why = "the limit on locked memory is not \"unlimited\"";
        return Err(io::Error::new(io::ErrorKind::PermissionDenied, why));
    }
    let flags = libc::MCL_CURRENT | libc::MCL_FUTURE | libc::MCL_ONFAULT;
    // SAFETY: takes no pointers.
    outcome(unsafe { libc::mlockall(flags) })
}

fn outcome(status: libc::c_int) -> io::Result<()> {
    match status {
        0 => Ok(()),
        _ => Err(io::Error::last_os_error()),
    }
}

pub fn is_root() -> bool {
    // SAFETY: takes nothing and cannot fail.
    unsafe { libc::geteuid() == 0 }
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Limit {
    RealTimePriority,
    /// Bytes.
    LockedMemory,
    OpenFiles,
}

/// What this process may have; `u64::MAX` is no limit.
pub fn limit(which: Limit) -> u64 {
    let resource = match which {
        Limit::RealTimePriority => libc::RLIMIT_RTPRIO,
        Limit::LockedMemory => libc::RLIMIT_MEMLOCK,
        Limit::OpenFiles => libc::RLIMIT_NOFILE,
    };
    let mut limits = libc::rlimit {
        rlim_cur: 0,
        rlim_max: 0,
    };
    // SAFETY: the structure is live and written by the call.
    let status = unsafe { libc::getrlimit(resource, &mut limits) };
    match status {
        0 if limits.rlim_cur == libc::RLIM_INFINITY => u64::MAX,
        0 => limits.rlim_cur,
        _ => 0,
    }
}

/// Whether the kernel holds the host's clock to be disciplined (NTP, PTP), and its estimate of the error, microseconds.
pub fn clock_discipline() -> (bool, i64) {
    // SAFETY: all zero is a valid timex, which asks and changes nothing.
    let mut timex: libc::timex = unsafe { std::mem::zeroed() };
    // SAFETY: the structure is live and written by the call.
    let state = unsafe { libc::adjtimex(&mut timex) };
    let disciplined = state >= 0 && timex.status & libc::STA_UNSYNC == 0;
    (disciplined, timex.esterror)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_refused_leaves_the_thread_as_it_was_and_what_is_granted_is_there() {
        std::thread::spawn(|| {
            let before = scheduling();
            match first_in_first_out(10) {
                Ok(()) => assert_eq!(scheduling(), (libc::SCHED_FIFO, 10)),
                Err(_) => assert_eq!(scheduling(), before),
            }
        })
        .join()
        .expect("the thread");
        assert!(limit(Limit::OpenFiles) > 0);
    }
}

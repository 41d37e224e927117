//! Scheduling priority, locked memory and resource limits of this process.

use std::io;
use std::os::unix::thread::JoinHandleExt;
use std::thread::JoinHandle;

/// Puts the calling thread under SCHED_FIFO. Requires CAP_SYS_NICE or a limit on rtprio.
pub(crate) fn first_in_first_out(priority: u8) -> io::Result<()> {
    let parameters = libc::sched_param {
        sched_priority: i32::from(priority),
    };
    // SAFETY: the pointer is to a live structure that the call only reads; pid 0 is the calling thread.
    let status = unsafe { libc::sched_setscheduler(0, libc::SCHED_FIFO, &parameters) };
    outcome(status)
}

/// Puts another thread of this process under SCHED_FIFO.
pub(crate) fn first_in_first_out_of<T>(thread: &JoinHandle<T>, priority: u8) -> io::Result<()> {
    let parameters = libc::sched_param {
        sched_priority: i32::from(priority),
    };
    // SAFETY: a thread that has not been joined keeps its identity, even when it has ended; the structure is live and only read.
    let code = unsafe {
        libc::pthread_setschedparam(thread.as_pthread_t(), libc::SCHED_FIFO, &parameters)
    };
    match code {
        0 => Ok(()),
        code => Err(io::Error::from_raw_os_error(code)),
    }
}

/// Sets the nice value of the calling thread, -20 to 19. Threads that it starts inherit the value.
///
/// # Errors
/// A negative value is refused without CAP_SYS_NICE or a limit on nice.
pub fn nice(value: i8) -> io::Result<()> {
    // SAFETY: takes no pointers; on Linux 0 is the calling thread.
    outcome(unsafe { libc::setpriority(libc::PRIO_PROCESS, 0, i32::from(value)) })
}

/// The calling thread's nice value.
#[cfg(test)]
pub(crate) fn niceness() -> i32 {
    // SAFETY: takes no pointers. -1 is also an error, of which there is none for the calling thread.
    unsafe { libc::getpriority(libc::PRIO_PROCESS, 0) }
}

/// The calling thread's scheduling policy and priority.
#[cfg(test)]
pub(crate) fn scheduling() -> (i32, i32) {
    let mut parameters = libc::sched_param { sched_priority: 0 };
    // SAFETY: pid 0 is the calling thread; the structure is live and written by the call.
    let policy = unsafe {
        libc::sched_getparam(0, &mut parameters);
        libc::sched_getscheduler(0)
    };
    (policy, parameters.sched_priority)
}

/// Locks every page in memory once the page is touched. Refused unless locked memory is unlimited, because under a limit a later allocation would
/// fail.
pub(crate) fn lock_memory() -> io::Result<()> {
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

/// Whether the effective user is root.
pub fn is_root() -> bool {
    // SAFETY: takes nothing and cannot fail.
    unsafe { libc::geteuid() == 0 }
}

/// A resource limit of a process.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Limit {
    /// Highest real-time priority.
    RealTimePriority,
    /// 20 minus the lowest nice value.
    Nice,
    /// Locked memory, bytes.
    LockedMemory,
    /// Open file descriptors.
    OpenFiles,
}

/// Soft limit of this process; `u64::MAX` means unlimited.
pub fn limit(which: Limit) -> u64 {
    let resource = match which {
        Limit::RealTimePriority => libc::RLIMIT_RTPRIO,
        Limit::Nice => libc::RLIMIT_NICE,
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

/// Whether the kernel considers the host's clock synchronised (NTP, PTP), and the kernel's estimate of the clock error, us.
pub fn clock_discipline() -> (bool, i64) {
    // SAFETY: all zero is a valid timex, with which the call only reads.
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

    #[test]
    fn another_thread_is_put_ahead_and_one_that_has_ended_does_no_harm() {
        let (tell, told) = std::sync::mpsc::channel::<()>();
        let other = std::thread::spawn(move || {
            let before = scheduling();
            let _ = told.recv();
            (before, scheduling())
        });
        let granted = first_in_first_out_of(&other, 7);
        drop(tell);
        let (before, after) = other.join().expect("the thread");
        match granted {
            // The thread may have started only after the first reading.
            Ok(()) => assert_eq!(after, (libc::SCHED_FIFO, 7)),
            Err(_) => assert_eq!(before, after),
        }
        let ended = std::thread::spawn(|| ());
        while !ended.is_finished() {
            std::thread::yield_now();
        }
        let _ = first_in_first_out_of(&ended, 7);
    }

    #[test]
    fn a_nice_value_is_one_threads_own() {
        let before = niceness();
        std::thread::spawn(move || match nice(-5) {
            Ok(()) => assert_eq!(niceness(), -5),
            Err(_) => assert_eq!(niceness(), before),
        })
        .join()
        .expect("the thread");
        assert_eq!(niceness(), before);
    }
}

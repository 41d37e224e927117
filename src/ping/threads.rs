//! The threads that compute pings, and those that prepare for them.

/// The threads that compute pings; 0 means as many as there are cores.
pub fn pool(threads: usize) -> Result<rayon::ThreadPool, rayon::ThreadPoolBuildError> {
    rayon::ThreadPoolBuilder::new()
        .num_threads(threads)
        .thread_name(|k| format!("ping {k}"))
        .build()
}

/// Nice value of threads that prepare for later pings.
const BACKGROUND: libc::c_int = 10;

/// Lowers the priority of the calling thread, and of threads that it starts later, below those that compute pings. A lower priority stays.
pub(crate) fn run_in_background() {
    // SAFETY: takes no pointers; on Linux 0 is the calling thread.
    let _ = unsafe { libc::setpriority(libc::PRIO_PROCESS, 0, BACKGROUND) };
}

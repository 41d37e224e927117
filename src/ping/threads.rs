//! The threads that compute pings.

/// The threads that compute pings; 0 means as many as there are cores.
pub fn pool(threads: usize) -> Result<rayon::ThreadPool, rayon::ThreadPoolBuildError> {
    rayon::ThreadPoolBuilder::new()
        .num_threads(threads)
        .thread_name(|k| format!("ping {k}"))
        .build()
}

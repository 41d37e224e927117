//! How fast datagrams leave: a token bucket for each stream ([`bucket`]), several datagrams in one call of the kernel ([`batch`]); and the pace of
//! TCP connections ([`stream`]).
//!
//! A receiver's socket takes 208 kB on a stock Linux; a ping may be megabytes. Spread over a part of the time to the next ping it is never
//! much more than a few groups ahead of whoever reads.

pub mod batch;
pub(crate) mod bucket;
pub mod stream;

use std::sync::Arc;

use crate::io::priority;

/// Is told how late a group left, nanoseconds after it was due.
pub(crate) type Lateness = Arc<dyn Fn(i64) + Send + Sync>;

/// Of the threads that send.
#[derive(Clone, Default)]
pub(crate) struct Sending {
    /// SCHED_FIFO; 0: ordinary.
    pub priority: u8,
    pub(crate) lateness: Option<Lateness>,
}

impl Sending {
    /// To be called first by the thread that sends.
    pub(crate) fn begin(&self) {
        if self.priority > 0 {
            // What is not allowed was said when the daemon started.
            let _ = priority::first_in_first_out(self.priority);
        }
    }

    pub(crate) fn note(&self, late_ns: i64) {
        if let Some(lateness) = &self.lateness {
            lateness(late_ns);
        }
    }
}

//! Rate limits: a token bucket per stream ([`bucket`]), several datagrams per system call ([`batch`]), and the kernel's pacing of TCP connections
//! ([`stream`]).
//!
//! A default Linux receive buffer holds 208 kB, while a ping may be megabytes. A ping spread over part of the ping interval stays within a few groups
//! of its reader.

pub mod batch;
pub(crate) mod bucket;
pub mod stream;

use std::sync::Arc;

use crate::io::priority;

/// Receives how late a group was sent, ns after it was due.
pub(crate) type Lateness = Arc<dyn Fn(i64) + Send + Sync>;

/// Settings of sending threads.
#[derive(Clone, Default)]
pub(crate) struct Sending {
    /// SCHED_FIFO priority; 0: ordinary scheduling.
    pub priority: u8,
    pub(crate) lateness: Option<Lateness>,
}

impl Sending {
    /// Applies the priority; called first by the sending thread.
    pub(crate) fn begin(&self) {
        if self.priority > 0 {
            // A refusal was reported when the daemon started.
            let _ = priority::first_in_first_out(self.priority);
        }
    }

    pub(crate) fn note(&self, late_ns: i64) {
        if let Some(lateness) = &self.lateness {
            lateness(late_ns);
        }
    }
}

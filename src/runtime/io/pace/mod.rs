//! Rate limits: a token bucket per stream ([`bucket`]), several datagrams per system call ([`batch`]), and the kernel's pacing of TCP connections
//! ([`stream`]).
//!
//! A default Linux receive buffer holds 208 kB, but a ping can hold megabytes. A ping that is spread over part of the ping interval does not overflow
//! the buffer of a receiver.
//! of its reader.

pub mod batch;
pub(crate) mod bucket;
pub mod stream;

use std::sync::Arc;

use crate::io::priority;

/// Callback with the lateness of a sent group, ns.
pub(crate) type Lateness = Arc<dyn Fn(i64) + Send + Sync>;

/// Settings of sending threads.
#[derive(Clone, Default)]
pub(crate) struct Sending {
    /// SCHED_FIFO priority; 0 means ordinary scheduling.
    pub priority: u8,
    pub(crate) lateness: Option<Lateness>,
}

impl Sending {
    /// Applies the priority. The sending thread calls this first.
    pub(crate) fn begin(&self) {
        if self.priority > 0 {
            // The daemon reports a refused priority at its start.
            let _ = priority::first_in_first_out(self.priority);
        }
    }

    pub(crate) fn note(&self, late_ns: i64) {
        if let Some(lateness) = &self.lateness {
            lateness(late_ns);
        }
    }
}

//! One client as the threads share it: what it wants, what waits for it, what it cost.

use std::collections::VecDeque;
use std::net::SocketAddr;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use tokio::sync::Notify;

use super::{ClientCounts, ClientReport, QueueLimit, Transport, WhenFull};
use echotank_core::flow::Datagram;
use echotank_emit::session::{SessionCounts, Wants};

/// Answers that may wait for a client before it is no longer listened to (TCP) or loses them (UDP): a few dozen configurations.
const REPLY_BYTES: usize = 256 * 1024;

/// All counters are statistics: relaxed ordering throughout.
pub(super) struct Client {
    pub peer: SocketAddr,
    pub transport: Transport,
    /// It did not come by itself: records are sent to it because somebody else said so.
    pub dialled: bool,
    subscribed: AtomicU64,
    /// Wanted once, of the next ping.
    requested: AtomicU64,
    queue: Mutex<Queue>,
    /// Something was queued, or the client is leaving.
    wake: Notify,
    /// Answers were written.
    room: Notify,
    leaving: AtomicBool,
    /// Leaves at once, whatever waits.
    dropped: AtomicBool,
    /// ... and its connection is reset.
    reset: AtomicBool,
    /// The bits of an f64.
    pace_bytes_per_s: AtomicU64,
    bytes_sent: AtomicU64,
    records_sent: AtomicU64,
    records_dropped: AtomicU64,
    commands: AtomicU64,
    nacks: AtomicU64,
    framing_errors: AtomicU64,
}

/// A record and the wants that it answers.
#[derive(Clone)]
pub(super) struct Offer {
    pub class: Wants,
    pub datagram: Arc<Datagram>,
}

#[derive(Default)]
struct Queue {
    replies: VecDeque<Arc<Datagram>>,
    records: VecDeque<Offer>,
    /// Queued or being written.
    reply_bytes: usize,
    record_bytes: usize,
}

/// A datagram on its way; give it back with [`Client::written`].
pub(super) struct Taken {
    pub datagram: Arc<Datagram>,
    is_reply: bool,
}

impl Client {
    pub(super) fn new(peer: SocketAddr, transport: Transport, dialled: bool) -> Self {
        Self {
            peer,
            transport,
            dialled,
            subscribed: AtomicU64::new(0),
            requested: AtomicU64::new(0),
            queue: Mutex::new(Queue::default()),
            wake: Notify::new(),
            room: Notify::new(),
            leaving: AtomicBool::new(false),
            dropped: AtomicBool::new(false),
            reset: AtomicBool::new(false),
            pace_bytes_per_s: AtomicU64::new(f64::INFINITY.to_bits()),
            bytes_sent: AtomicU64::new(0),
            records_sent: AtomicU64::new(0),
            records_dropped: AtomicU64::new(0),
            commands: AtomicU64::new(0),
            nacks: AtomicU64::new(0),
            framing_errors: AtomicU64::new(0),
        }
    }

    /// A queue is whole between any two statements that hold the lock.
    fn lock(&self) -> MutexGuard<'_, Queue> {
        self.queue.lock().unwrap_or_else(PoisonError::into_inner)
    }

    // ------------------------------------------------------------ wants

    pub(super) fn wants(&self) -> Wants {
        self.subscribed()
            .union(Wants(self.requested.load(Ordering::Acquire)))
    }

    pub(super) fn subscribed(&self) -> Wants {
        Wants(self.subscribed.load(Ordering::Acquire))
    }

    /// Sets the subscriptions, adds single requests, and takes records off the queue that are no longer wanted.
    pub(super) fn want(&self, subscribed: Wants, requested: Wants) {
        let before = Wants(self.subscribed.swap(subscribed.0, Ordering::AcqRel));
        self.requested.fetch_or(requested.0, Ordering::AcqRel);
        let ended = before.without(subscribed);
        if !ended.is_empty() {
            let mut queue = self.lock();
            let mut freed = 0;
            queue.records.retain(|offer| {
                let stays = !ended.meets(offer.class);
                if !stays {
                    freed += offer.datagram.bytes.len();
                }
                stays
            });
            queue.record_bytes -= freed;
        }
    }

    // ------------------------------------------------------------ queue in

    /// Queues those of `offers` that the client wants and that fit. `over_s`: what then waits leaves evenly over so many seconds; 0: at once.
    pub(crate) fn offer(&self, offers: &[Offer], limit: QueueLimit, over_s: Option<f64>) {
        let wants = self.wants();
        if wants.is_empty() {
            return;
        }
        let mut queue = self.lock();
        let mut queued = false;
        for offer in offers.iter().filter(|offer| wants.meets(offer.class)) {
            let len = offer.datagram.bytes.len();
            let fits = queue.record_bytes == 0 || queue.record_bytes + len <= limit.bytes;
            if !fits {
                self.records_dropped.fetch_add(1, Ordering::Relaxed);
                if limit.when_full == WhenFull::Disconnect {
                    self.dropped.store(true, Ordering::Release);
                    drop(queue);
                    self.leave();
                    return;
                }
                continue;
            }
            queue.record_bytes += len;
            queue.records.push_back(offer.clone());
            self.requested.fetch_and(!offer.class.0, Ordering::AcqRel);
            queued = true;
        }
        if let Some(over_s) = over_s {
            let rate = match over_s > 0.0 {
                true => queue.record_bytes.max(1) as f64 / over_s,
                false => f64::INFINITY,
            };
            self.pace_bytes_per_s
                .store(rate.to_bits(), Ordering::Relaxed);
        }
        drop(queue);
        if queued {
            self.wake.notify_one();
        }
    }

    /// Queues an answer ahead of the records.
    pub(super) fn reply(&self, datagram: Arc<Datagram>) {
        let mut queue = self.lock();
        if self.transport == Transport::Udp && queue.reply_bytes > REPLY_BYTES {
            self.records_dropped.fetch_add(1, Ordering::Relaxed);
            return;
        }
        queue.reply_bytes += datagram.bytes.len();
        queue.replies.push_back(datagram);
        drop(queue);
        self.wake.notify_one();
    }

    /// Answers do not wait.
    pub(super) fn pace_bytes_per_s(&self, taken: &Taken) -> f64 {
        match taken.is_reply {
            true => f64::INFINITY,
            false => f64::from_bits(self.pace_bytes_per_s.load(Ordering::Relaxed)),
        }
    }

    /// Returns once the answers that wait are few enough for more commands.
    pub(crate) async fn room_for_replies(&self) {
        while self.lock().reply_bytes > REPLY_BYTES {
            self.room.notified().await;
        }
    }

    // ------------------------------------------------------------ queue out

    pub(super) fn take(&self) -> Option<Taken> {
        let mut queue = self.lock();
        if let Some(datagram) = queue.replies.pop_front() {
            return Some(Taken {
                datagram,
                is_reply: true,
            });
        }
        let offer = queue.records.pop_front()?;
        Some(Taken {
            datagram: offer.datagram,
            is_reply: false,
        })
    }

    /// Waits until there may be something to take, or the client is leaving.
    pub(crate) async fn woken(&self) {
        self.wake.notified().await;
    }

    /// `wire_bytes`: as sent, or why it was lost.
    pub(super) fn written(&self, taken: Taken, wire_bytes: Option<usize>) {
        match wire_bytes {
            Some(bytes) => {
                self.bytes_sent.fetch_add(bytes as u64, Ordering::Relaxed);
                self.records_sent.fetch_add(1, Ordering::Relaxed);
            }
            None => {
                self.records_dropped.fetch_add(1, Ordering::Relaxed);
            }
        }
        // The pool may have the buffer back before the client is seen to have room.
        let len = taken.datagram.bytes.len();
        drop(taken.datagram);
        let mut queue = self.lock();
        if taken.is_reply {
            queue.reply_bytes -= len;
        } else {
            queue.record_bytes -= len;
        }
        drop(queue);
        if taken.is_reply {
            self.room.notify_one();
        }
    }

    // ------------------------------------------------------------ leaving

    /// The client has closed: what waits for it is written, nothing more comes.
    pub(super) fn leave(&self) {
        self.subscribed.store(0, Ordering::Release);
        self.requested.store(0, Ordering::Release);
        self.leaving.store(true, Ordering::Release);
        self.wake.notify_one();
    }

    /// Its connection is cut off.
    pub(super) fn reset(&self) {
        self.reset.store(true, Ordering::Release);
        self.dropped.store(true, Ordering::Release);
        self.leave();
    }

    pub(crate) fn is_reset(&self) -> bool {
        self.reset.load(Ordering::Acquire)
    }

    pub(crate) fn is_leaving(&self) -> bool {
        self.leaving.load(Ordering::Acquire)
    }

    /// Resolves when nothing more is to be written, not even the rest of what was begun.
    pub(super) async fn gone(&self) {
        while !self.dropped.load(Ordering::Acquire) {
            self.woken().await;
        }
    }

    /// The last word on a client: its counts, with what is still queued as unsent.
    pub(super) fn close(&self) -> ClientCounts {
        let mut queue = self.lock();
        let unsent = queue.replies.len() + queue.records.len();
        *queue = Queue::default();
        drop(queue);
        ClientCounts {
            records_unsent: unsent as u64,
            ..self.counts()
        }
    }

    // ------------------------------------------------------------ counts

    pub(super) fn note(&self, session: SessionCounts) {
        self.commands.store(session.commands, Ordering::Relaxed);
        self.nacks.store(session.nacks, Ordering::Relaxed);
        self.framing_errors
            .store(session.framing_errors, Ordering::Relaxed);
    }

    fn counts(&self) -> ClientCounts {
        ClientCounts {
            bytes_sent: self.bytes_sent.load(Ordering::Relaxed),
            records_sent: self.records_sent.load(Ordering::Relaxed),
            records_dropped: self.records_dropped.load(Ordering::Relaxed),
            records_unsent: 0,
            commands: self.commands.load(Ordering::Relaxed),
            nacks: self.nacks.load(Ordering::Relaxed),
            framing_errors: self.framing_errors.load(Ordering::Relaxed),
        }
    }

    pub(super) fn report(&self) -> ClientReport {
        let queue = self.lock();
        let queued_bytes = queue.reply_bytes + queue.record_bytes;
        drop(queue);
        ClientReport {
            peer: self.peer,
            transport: self.transport,
            subscribed: self.subscribed(),
            queued_bytes,
            counts: self.counts(),
        }
    }
}

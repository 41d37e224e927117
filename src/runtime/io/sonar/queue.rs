//! State of one client, shared between threads: subscriptions, queue and counters.

use std::collections::VecDeque;
use std::net::SocketAddr;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use tokio::sync::Notify;

use super::{ClientCounts, ClientReport, QueueLimit, ServerTimes, Transport, WhenFull};
use echotank_core::records::Datagram;
use echotank_emit::session::{SessionCounts, Wants};

/// Size of queued replies, bytes, beyond which a TCP client is not read from and a UDP client loses replies: a few dozen configurations.
const REPLY_BYTES: usize = 256 * 1024;

/// A client of a server. Counters use relaxed ordering.
pub(super) struct Client {
    pub peer: SocketAddr,
    pub transport: Transport,
    /// Whether the server contacted this client at the request of a session.
    pub dialled: bool,
    subscribed: AtomicU64,
    /// Record classes requested once, from the next ping.
    requested: AtomicU64,
    queue: Mutex<Queue>,
    admitted: Instant,
    /// Time of the last received bytes, ms after `admitted`.
    received_ms: AtomicU64,
    /// Time of the last written datagram or of the last empty queue, ms after `admitted`.
    written_ms: AtomicU64,
    /// Notified when a datagram is queued or the client leaves.
    wake: Notify,
    /// Notified when replies are written.
    room: Notify,
    leaving: AtomicBool,
    /// Whether the client leaves at once and its queue is discarded.
    dropped: AtomicBool,
    /// Whether the connection is closed with a TCP reset.
    reset: AtomicBool,
    /// Bits of an f64: rate of the records, bytes/s.
    pace_bytes_per_s: AtomicU64,
    bytes_sent: AtomicU64,
    records_sent: AtomicU64,
    records_dropped: AtomicU64,
    commands: AtomicU64,
    nacks: AtomicU64,
    framing_errors: AtomicU64,
}

/// A record and the classes that it belongs to.
#[derive(Clone)]
pub(super) struct Offer {
    pub class: Wants,
    pub datagram: Arc<Datagram>,
    /// The requests for it outlast it.
    pub keeps_requests: bool,
}

#[derive(Default)]
struct Queue {
    replies: VecDeque<Arc<Datagram>>,
    records: VecDeque<Offer>,
    /// Bytes queued or being written.
    reply_bytes: usize,
    record_bytes: usize,
}

/// A datagram being written; return it with [`Client::written`].
pub(super) struct TakenDatagram {
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
            admitted: Instant::now(),
            received_ms: AtomicU64::new(0),
            written_ms: AtomicU64::new(0),
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

    /// Every statement under the lock leaves a consistent queue.
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

    /// Sets the subscriptions, adds single requests, and removes queued records that are no longer wanted.
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

    // ------------------------------------------------------------ idleness

    fn now_ms(&self) -> u64 {
        self.admitted.elapsed().as_millis() as u64
    }

    /// Records the arrival of bytes from the client.
    pub(super) fn note_received(&self) {
        self.received_ms.store(self.now_ms(), Ordering::Relaxed);
    }

    /// Records that the queue is empty at this instant.
    fn note_empty(&self, queue: &Queue) {
        if queue.reply_bytes + queue.record_bytes == 0 {
            self.written_ms.store(self.now_ms(), Ordering::Relaxed);
        }
    }

    /// Idle time of the client, if a full server may disconnect it.
    pub(super) fn idle(&self, times: &ServerTimes) -> Option<Duration> {
        let since = |ms: &AtomicU64| {
            Duration::from_millis(self.now_ms().saturating_sub(ms.load(Ordering::Relaxed)))
        };
        let (silent, unwritten) = (since(&self.received_ms), since(&self.written_ms));
        let queue = self.lock();
        let waits = queue.reply_bytes + queue.record_bytes > 0;
        drop(queue);
        let is_silent = silent > times.seat_idle && self.wants().is_empty()
            || silent > times.seat_udp_silence && self.transport == Transport::Udp;
        match waits && unwritten > times.seat_idle {
            true => Some(silent.max(unwritten)),
            false => is_silent.then_some(silent),
        }
    }

    // ------------------------------------------------------------ queue in

    /// Queues those of the wanted `offers` that fit. The queue is sent evenly over `over_s` seconds; 0 sends at once, `None` keeps the pace.
    pub(crate) fn offer(&self, offers: &[Offer], limit: QueueLimit, over_s: Option<f64>) {
        let wants = self.wants();
        if wants.is_empty() {
            return;
        }
        let mut queue = self.lock();
        self.note_empty(&queue);
        let mut queued = false;
        for offer in offers.iter().filter(|offer| wants.meets(offer.class)) {
            let len = offer.datagram.bytes.len();
            let fits = queue.record_bytes == 0 || queue.record_bytes + len <= limit.bytes;
            if !fits {
                self.records_dropped.fetch_add(1, Ordering::Relaxed);
                if limit.when_full == WhenFull::Disconnect {
                    drop(queue);
                    self.disconnect();
                    return;
                }
                continue;
            }
            queue.record_bytes += len;
            queue.records.push_back(offer.clone());
            if !offer.keeps_requests {
                self.requested.fetch_and(!offer.class.0, Ordering::AcqRel);
            }
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

    /// Queues a reply ahead of the records.
    pub(super) fn reply(&self, datagram: Arc<Datagram>) {
        let mut queue = self.lock();
        if self.transport == Transport::Udp && queue.reply_bytes > REPLY_BYTES {
            self.records_dropped.fetch_add(1, Ordering::Relaxed);
            return;
        }
        self.note_empty(&queue);
        queue.reply_bytes += datagram.bytes.len();
        queue.replies.push_back(datagram);
        drop(queue);
        self.wake.notify_one();
    }

    /// Pace of a datagram, bytes/s; replies are sent at once.
    pub(super) fn pace_bytes_per_s(&self, taken: &TakenDatagram) -> f64 {
        match taken.is_reply {
            true => f64::INFINITY,
            false => f64::from_bits(self.pace_bytes_per_s.load(Ordering::Relaxed)),
        }
    }

    /// Waits until the queued replies leave room for another command.
    pub(crate) async fn room_for_replies(&self) {
        while self.lock().reply_bytes > REPLY_BYTES {
            self.room.notified().await;
        }
    }

    // ------------------------------------------------------------ queue out

    pub(super) fn take(&self) -> Option<TakenDatagram> {
        let mut queue = self.lock();
        if let Some(datagram) = queue.replies.pop_front() {
            return Some(TakenDatagram {
                datagram,
                is_reply: true,
            });
        }
        let offer = queue.records.pop_front()?;
        Some(TakenDatagram {
            datagram: offer.datagram,
            is_reply: false,
        })
    }

    /// Waits until a datagram may be available or the client leaves.
    pub(crate) async fn wait_for_datagram(&self) {
        self.wake.notified().await;
    }

    /// Counts a datagram as written (`wire_bytes`) or as lost (`None`).
    pub(super) fn written(&self, taken: TakenDatagram, wire_bytes: Option<usize>) {
        self.written_ms.store(self.now_ms(), Ordering::Relaxed);
        match wire_bytes {
            Some(bytes) => {
                self.bytes_sent.fetch_add(bytes as u64, Ordering::Relaxed);
                self.records_sent.fetch_add(1, Ordering::Relaxed);
            }
            None => {
                self.records_dropped.fetch_add(1, Ordering::Relaxed);
            }
        }
        // The buffer returns to its pool before the queue shows room.
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

    /// Makes the client leave after its queue is written.
    pub(super) fn leave(&self) {
        self.subscribed.store(0, Ordering::Release);
        self.requested.store(0, Ordering::Release);
        self.leaving.store(true, Ordering::Release);
        self.wake.notify_one();
    }

    /// Makes the client leave at once and discards its queue.
    pub(super) fn disconnect(&self) {
        self.dropped.store(true, Ordering::Release);
        self.leave();
    }

    /// Disconnects the client with a TCP reset.
    pub(super) fn reset(&self) {
        self.reset.store(true, Ordering::Release);
        self.disconnect();
    }

    pub(crate) fn is_reset(&self) -> bool {
        self.reset.load(Ordering::Acquire)
    }

    pub(crate) fn is_leaving(&self) -> bool {
        self.leaving.load(Ordering::Acquire)
    }

    /// Waits until nothing more may be written, not even the rest of a record.
    pub(super) async fn gone(&self) {
        while !self.dropped.load(Ordering::Acquire) {
            self.wait_for_datagram().await;
        }
    }

    /// Empties the queue. Returns the final counts with the queued records as unsent.
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

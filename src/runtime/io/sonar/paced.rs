//! Thread that sends the datagrams of a server: each client at its own rate, several clients interleaved.
//!
//! A record enters the queue as packets, with the token bucket of its client. The record returns when its last packet is sent or one packet fails.
//! The timers of tokio have a resolution of 1 ms, which is too coarse. The thread therefore sleeps until absolute instants.

use std::io::{self, ErrorKind};
use std::net::SocketAddr;
use std::ops::Range;
use std::sync::Arc;
use std::time::Duration;

use crossbeam_channel::{Receiver, RecvTimeoutError, Sender, TryRecvError, unbounded};
use socket2::SockAddr;
use tokio::net::UdpSocket;
use tokio::sync::oneshot;

use crate::clock::{Clock, SystemClock};
use crate::io::pace::Sending;
use crate::io::pace::batch::send_batch;
use crate::io::pace::bucket::Bucket;
use echotank_core::time::MonoNs;

/// One record to be sent to one client. The buffers are reused.
pub(super) struct Burst {
    pub socket: Arc<UdpSocket>,
    pub to: SockAddr,
    /// Whether the socket has other clients too.
    pub is_shared: bool,
    pub wire: Vec<u8>,
    pub packets: Vec<Range<usize>>,
    /// `None` for the client's first record.
    pub(crate) bucket: Option<Bucket>,
    /// Infinity sends at once.
    pub bytes_per_s: f64,
    /// Error that ended the burst before its last packet.
    pub error: Option<io::Error>,
}

impl Burst {
    pub(super) fn empty(socket: Arc<UdpSocket>, to: SocketAddr, is_shared: bool) -> Self {
        Self {
            socket,
            to: to.into(),
            is_shared,
            wire: Vec::new(),
            packets: Vec::new(),
            bucket: None,
            bytes_per_s: f64::INFINITY,
            error: None,
        }
    }
}

/// Sending side of the queue. The thread ends when this value is dropped.
pub(super) struct PacedSender {
    jobs: Sender<Job>,
}

struct Job {
    burst: Burst,
    done: oneshot::Sender<Burst>,
}

impl PacedSender {
    pub(super) fn start(name: String, sending: Sending) -> io::Result<Self> {
        let (jobs, received) = unbounded();
        std::thread::Builder::new().name(name).spawn(move || {
            sending.begin();
            run(&received, &SystemClock::new(), &sending);
        })?;
        Ok(Self { jobs })
    }

    /// Sends a record and waits until it is sent; `None` if the thread has ended.
    pub(super) async fn send(&self, burst: Burst) -> Option<Burst> {
        let (done, sent) = oneshot::channel();
        self.jobs.send(Job { burst, done }).ok()?;
        sent.await.ok()
    }
}

/// A record in transmission; `next` is the index of its first unsent packet.
struct InFlight {
    job: Job,
    bucket: Bucket,
    next: usize,
    count: usize,
    bytes: usize,
    due: MonoNs,
}

impl InFlight {
    fn begin(mut job: Job, now: MonoNs) -> Self {
        let rate = job.burst.bytes_per_s;
        let mut bucket = job
            .burst
            .bucket
            .take()
            .unwrap_or_else(|| Bucket::new(rate, now));
        bucket.set_rate(rate, now);
        let mut flying = Self {
            job,
            bucket,
            next: 0,
            count: 0,
            bytes: 0,
            due: now,
        };
        flying.plan(now);
        flying
    }

    /// Chooses the next group of packets and the instant at which it is due.
    fn plan(&mut self, now: MonoNs) {
        let rest = &self.job.burst.packets[self.next..];
        (self.count, self.bytes) = self.bucket.group(rest.iter().map(ExactSizeIterator::len));
        self.due = self.bucket.due(self.bytes, now);
    }

    fn is_over(&self) -> bool {
        self.count == 0 || self.job.burst.error.is_some()
    }

    fn send_group(&mut self, now: MonoNs) {
        let burst = &mut self.job.burst;
        let group = &burst.packets[self.next..self.next + self.count];
        let packets: Vec<&[u8]> = group.iter().map(|p| &burst.wire[p.clone()]).collect();
        let mut unsent = &packets[..];
        burst.error = loop {
            let (sent, result) = send_batch(&*burst.socket, &burst.to, unsent);
            unsent = &unsent[sent..];
            match result {
                // A socket that serves several clients also reports the closed ports of other clients.
                Err(error) if burst.is_shared && error.kind() == ErrorKind::ConnectionRefused => {}
                result => break result.err(),
            }
        };
        self.next += self.count;
        self.bucket.take(self.bytes, now);
        self.plan(now);
    }

    fn land(mut self) {
        self.job.burst.bucket = Some(self.bucket);
        // An error means that the client has left.
        let _ = self.job.done.send(self.job.burst);
    }
}

fn run(jobs: &Receiver<Job>, clock: &SystemClock, sending: &Sending) {
    let mut flying: Vec<InFlight> = Vec::new();
    loop {
        let first = flying.iter().map(|f| f.due).min();
        let job = match first {
            None => jobs.recv().map_err(|_| RecvTimeoutError::Disconnected),
            Some(due) => match due.0 - clock.mono().0 {
                left_ns @ 1.. => jobs.recv_timeout(Duration::from_nanos(left_ns as u64)),
                _ => jobs.try_recv().map_err(|error| match error {
                    TryRecvError::Empty => RecvTimeoutError::Timeout,
                    TryRecvError::Disconnected => RecvTimeoutError::Disconnected,
                }),
            },
        };
        let now = clock.mono();
        match job {
            Ok(job) => flying.push(InFlight::begin(job, now)),
            Err(RecvTimeoutError::Timeout) => {}
            Err(RecvTimeoutError::Disconnected) => return,
        }
        let Some(next) = (0..flying.len()).min_by_key(|&k| flying[k].due) else {
            continue;
        };
        if flying[next].due <= now {
            if !flying[next].is_over() {
                sending.note(now.0 - flying[next].due.0);
                flying[next].send_group(now);
            }
            if flying[next].is_over() {
                flying.swap_remove(next).land();
            }
        }
    }
}

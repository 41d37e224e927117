//! A session with one client on a serial line. Received bytes go to the session; replies precede records.
//!
//! Records are dropped whole and counted if the queue is full. A fast sonar loses most of its records at 115200 bit/s. A failed line, such as an
//! unplugged adapter, is reopened.

use std::io::{ErrorKind, Read};
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread::{self, JoinHandle};
use std::time::Duration;

use crossbeam_channel::{Receiver, Sender, TryRecvError, bounded};

use crate::io::link::Link;
use crate::io::sonar::RigTime;
use echotank_core::records::Datagram;
use echotank_emit::session::{Outgoing, Session};

/// Maximum number of records queued for the line.
const MAX_WAITING: usize = 4;
/// Read timeout, which is the maximum delay of a reply.
const READ_TIMEOUT: Duration = Duration::from_millis(20);
/// Number of read timeouts after which an incomplete command is discarded.
const STALLED_READS: u32 = 100;
/// Pause before a failed line is reopened.
const AGAIN: Duration = Duration::from_secs(1);

/// Counters of a serial line.
#[derive(Debug, Default)]
pub struct LineCounts {
    /// Bytes written.
    pub bytes_sent: AtomicU64,
    /// Records that did not fit in the queue.
    pub records_dropped: AtomicU64,
    /// Commands received.
    pub commands: AtomicU64,
    /// Commands refused.
    pub nacks: AtomicU64,
    /// Failures of the line.
    pub failures: AtomicU64,
}

/// A serial line served by its own thread; stops when dropped.
pub struct SerialLine {
    records: Sender<Arc<Datagram>>,
    counts: Arc<LineCounts>,
    stop: Arc<AtomicBool>,
    thread: Option<JoinHandle<()>>,
    faulty: Mutex<Option<Box<dyn Link>>>,
}

impl SerialLine {
    /// Opens the line and starts its thread. `connect` creates a session, also after each failure of the line.
    ///
    /// # Errors
    /// The port or the thread cannot be opened.
    pub fn open(
        port: &str,
        baud: u32,
        connect: impl Fn() -> Box<dyn Session> + Send + 'static,
        rig_time: RigTime,
    ) -> std::io::Result<Self> {
        let (name, stop) = (port.to_owned(), Arc::new(AtomicBool::new(false)));
        let (records, waiting) = bounded(MAX_WAITING);
        let counts = Arc::new(LineCounts::default());
        let first = open(&name, baud)?;
        let thread = thread::Builder::new().name("serial".into()).spawn({
            let (counts, stop) = (Arc::clone(&counts), Arc::clone(&stop));
            move || {
                let mut line = Some(first);
                while !stop.load(Ordering::Acquire) {
                    if let Some(line) = line.take().or_else(|| open(&name, baud).ok()) {
                        let mut session = connect();
                        let _ = serve(line, &mut *session, &waiting, &rig_time, &counts, &stop);
                    }
                    if !stop.load(Ordering::Acquire) {
                        counts.failures.fetch_add(1, Ordering::Relaxed);
                        thread::sleep(AGAIN);
                    }
                }
            }
        })?;
        Ok(Self {
            records,
            counts,
            stop,
            thread: Some(thread),
            faulty: Mutex::default(),
        })
    }

    /// Counters so far.
    pub fn counts(&self) -> &Arc<LineCounts> {
        &self.counts
    }

    /// Sends all further records through the faulty link `line`. Replies bypass it.
    pub(crate) fn set_line(&self, line: Box<dyn Link>) {
        *self.faulty.lock().unwrap_or_else(PoisonError::into_inner) = Some(line);
    }

    /// Queues records. Never waits for the line.
    pub fn deliver(&self, records: &[Arc<Datagram>]) {
        let mut faulty = self.faulty.lock().unwrap_or_else(PoisonError::into_inner);
        let records = match &mut *faulty {
            Some(line) => line.records(records),
            None => records,
        };
        for record in records {
            if self.records.try_send(Arc::clone(record)).is_err() {
                self.counts.records_dropped.fetch_add(1, Ordering::Relaxed);
            }
        }
    }
}

impl Drop for SerialLine {
    fn drop(&mut self) {
        self.stop.store(true, Ordering::Release);
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
        }
    }
}

fn open(name: &str, baud: u32) -> std::io::Result<Box<dyn serialport::SerialPort>> {
    Ok(serialport::new(name, baud).timeout(READ_TIMEOUT).open()?)
}

/// Serves one session until the line fails or the server stops.
fn serve(
    mut line: Box<dyn serialport::SerialPort>,
    session: &mut dyn Session,
    waiting: &Receiver<Arc<Datagram>>,
    rig_time: &RigTime,
    counts: &LineCounts,
    stop: &AtomicBool,
) -> std::io::Result<()> {
    let mut out = Vec::new();
    let mut buffer = [0; 4096];
    let mut silent_reads = 0;
    session.greet(rig_time(), &mut out);
    loop {
        for item in out.drain(..) {
            if let Outgoing::Reply(datagram) = item {
                write(&mut *line, &datagram.bytes, counts, stop)?;
            }
        }
        match waiting.try_recv() {
            Ok(record) => write(&mut *line, &record.bytes, counts, stop)?,
            Err(TryRecvError::Empty) => {}
            Err(TryRecvError::Disconnected) => return Ok(()),
        }
        if stop.load(Ordering::Acquire) {
            return Ok(());
        }
        match line.read(&mut buffer) {
            Ok(0) => return Err(ErrorKind::UnexpectedEof.into()),
            Ok(len) => {
                silent_reads = 0;
                session.receive(&buffer[..len], rig_time(), &mut out);
            }
            Err(error) if is_silence(&error) => {
                silent_reads += 1;
                if silent_reads == STALLED_READS && session.is_waiting() {
                    session.give_up_waiting(rig_time(), &mut out);
                }
            }
            Err(error) => return Err(error),
        }
        let seen = session.counts();
        counts.commands.store(seen.commands, Ordering::Relaxed);
        counts.nacks.store(seen.nacks, Ordering::Relaxed);
    }
}

fn is_silence(error: &std::io::Error) -> bool {
    matches!(
        error.kind(),
        ErrorKind::TimedOut | ErrorKind::WouldBlock | ErrorKind::Interrupted
    )
}

/// Writes all of `bytes` unless the server stops. The duration is not limited.
fn write(
    line: &mut dyn serialport::SerialPort,
    mut bytes: &[u8],
    counts: &LineCounts,
    stop: &AtomicBool,
) -> std::io::Result<()> {
    while !bytes.is_empty() && !stop.load(Ordering::Acquire) {
        match line.write(bytes) {
            Ok(0) => return Err(ErrorKind::WriteZero.into()),
            Ok(len) => {
                counts.bytes_sent.fetch_add(len as u64, Ordering::Relaxed);
                bytes = &bytes[len..];
            }
            Err(error) if is_silence(&error) => {}
            Err(error) => return Err(error),
        }
    }
    Ok(())
}

//! Writes what the live sources receive, and the pings that use it, to a file that `replay --nav` reads.

use std::fs::File;
use std::io::Write;
use std::net::SocketAddr;
use std::path::Path;
use std::sync::Arc;
use std::thread::JoinHandle;

use crossbeam_channel::{Receiver, Sender, TrySendError, bounded};

use crate::io::record::RecordError;
use crate::outputs::recording::Recordings;
use echotank_config::spec::{NavInputSpec, NavSpec};
use echotank_nav::recording::{Entry, RecordingWriter};

/// Maximum number of entries that wait for the disk: a minute of ten sources at 100 Hz.
const QUEUE: usize = 60_000;
/// Size of a write, bytes.
const WRITE_BYTES: usize = 1 << 18;

/// Sending side of a recording. The file is complete when the value is dropped.
pub(super) struct NavRecorder {
    /// `None` after the recording stopped.
    sender: Option<Sender<Entry>>,
    thread: Option<JoinHandle<()>>,
    name: String,
    recordings: Arc<Recordings>,
}

impl NavRecorder {
    /// Creates the file, which must not exist, and the thread that writes it.
    pub(super) fn create(
        path: &Path,
        spec: &NavSpec,
        recordings: Arc<Recordings>,
    ) -> Result<Self, RecordError> {
        let mut head = Vec::new();
        let sources: Vec<_> = spec
            .sources
            .iter()
            .filter(|source| !source.is_recorded())
            .map(|source| {
                let (what, port) = described(&source.input);
                (source.name.clone(), what, port)
            })
            .collect();
        let writer = RecordingWriter::begin(&sources, &mut head);
        let io = |action| RecordError::io(path, action);
        let mut file = File::create_new(path).map_err(io("create"))?;
        // The lock prevents other programs of this kind from changing the file.
        let _ = file.try_lock();
        file.write_all(&head).map_err(io("write"))?;
        let (sender, entries) = bounded(QUEUE);
        let name = path.display().to_string();
        let thread = std::thread::Builder::new()
            .name("nav recorder".into())
            .spawn({
                let (path, recordings) = (path.to_owned(), recordings.clone());
                move || {
                    if let Err(error) = write_all(&path, file, &writer, &entries) {
                        stop(&path.display().to_string(), &error.to_string(), &recordings);
                    }
                }
            })
            .map_err(io("start a thread for"))?;
        Ok(Self {
            sender: Some(sender),
            thread: Some(thread),
            name,
            recordings,
        })
    }

    /// Queues an entry. If an entry is lost, the recording ends before it, because a replay of the rest would differ from the run.
    pub(super) fn note(&mut self, entry: Entry) {
        let Some(sender) = &self.sender else { return };
        match sender.try_send(entry) {
            Ok(()) => {}
            Err(TrySendError::Full(_)) => {
                stop(&self.name, "the disk is too slow", &self.recordings);
                self.sender = None;
            }
            // The thread has reported its error.
            Err(TrySendError::Disconnected(_)) => self.sender = None,
        }
    }
}

impl Drop for NavRecorder {
    fn drop(&mut self) {
        self.sender = None;
        if let Some(thread) = self.thread.take() {
            // The panic hook has reported a panic of the thread.
            let _ = thread.join();
        }
    }
}

fn stop(name: &str, why: &str, recordings: &Recordings) {
    tracing::error!(
        file = name,
        why,
        "navigation recording stopped; it can be replayed up to here"
    );
    recordings.stop(name, why);
}

/// Writes the entries until the senders are gone. After an error the file ends with its last whole entries.
fn write_all(
    path: &Path,
    mut file: File,
    writer: &RecordingWriter,
    entries: &Receiver<Entry>,
) -> Result<(), RecordError> {
    let io = |action| RecordError::io(path, action);
    let mut out = Vec::new();
    let mut length = file.metadata().map_err(io("read"))?.len();
    while let Ok(entry) = entries.recv() {
        out.clear();
        writer.write(&entry, &mut out);
        while out.len() < WRITE_BYTES
            && let Ok(entry) = entries.try_recv()
        {
            writer.write(&entry, &mut out);
        }
        if let Err(source) = file.write_all(&out) {
            // If this fails too, a replay ignores the truncated entry.
            let _ = file.set_len(length);
            return Err(io("write")(source));
        }
        length += out.len() as u64;
    }
    file.sync_data().map_err(io("close"))
}

/// Description and port of a live source.
fn described(input: &NavInputSpec) -> (String, u16) {
    let port = |address: &str| {
        let port = address.rsplit(':').next();
        port.and_then(|port| port.parse().ok()).unwrap_or(0)
    };
    let listening = |kind: &str, listen: &SocketAddr| (format!("{kind} {listen}"), listen.port());
    match input {
        NavInputSpec::Udp { listen, .. } => listening("udp", listen),
        NavInputSpec::TcpListen { listen } => listening("tcp client at", listen),
        NavInputSpec::TcpConnect { address } => (format!("tcp server {address}"), port(address)),
        NavInputSpec::Serial { port, baud, .. } => (format!("serial {port} at {baud} baud"), 0),
        NavInputSpec::Log { path, .. } | NavInputSpec::Csv { path } => {
            (path.display().to_string(), 0)
        }
    }
}

//! Recordings that the operator stops and starts, and that continue in a new file after an error, such as a full disk or a deleted folder.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::thread;
use std::time::{Duration, Instant};

use chrono::DateTime;
use tracing::info;

use crate::io::record::{RecordError, claim_name, make_folder};
use crate::io::sonar::RigTime;
use echotank_core::time::UtcNs;

/// Interval at which a stopped recording tries to open a new file.
const RETRY_INTERVAL: Duration = Duration::from_secs(5);
/// Interval at which the existence of the file is checked.
const CHECK_INTERVAL: Duration = Duration::from_secs(1);

/// Recordings of one sonar: their files and the operator's switch.
#[derive(Debug)]
pub(crate) struct Recordings {
    is_on: AtomicBool,
    /// By name and extension of the files.
    files: Mutex<BTreeMap<String, FileState>>,
}

/// State of one recording.
#[derive(Clone, Debug, Default, PartialEq, serde::Serialize)]
pub(crate) struct FileState {
    /// Path of the newest file.
    pub(crate) path: PathBuf,
    /// Length of the newest file when it was last checked, bytes.
    pub(crate) bytes: u64,
    /// Whether the file is open.
    pub(crate) is_open: bool,
    /// Whether the operator's switch applies; event logs are always on.
    pub(crate) is_switched: bool,
    /// Reason why the recording stopped by itself.
    pub(crate) stopped: Option<String>,
}

impl Default for Recordings {
    fn default() -> Self {
        Self {
            is_on: AtomicBool::new(true),
            files: Mutex::default(),
        }
    }
}

impl Recordings {
    /// Every statement under the lock leaves a consistent map.
    fn lock(&self) -> MutexGuard<'_, BTreeMap<String, FileState>> {
        self.files.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn change(&self, name: &str, change: impl FnOnce(&mut FileState)) {
        let mut files = self.lock();
        match files.get_mut(name) {
            Some(file) => change(file),
            None => change(files.entry(name.to_owned()).or_default()),
        }
    }

    /// Notes that a recording ended before the run.
    pub(crate) fn stop(&self, name: &str, why: &str) {
        self.change(name, |file| file.stopped = Some(why.to_owned()));
    }

    /// One line per stopped recording.
    pub(crate) fn lines(&self) -> Vec<String> {
        let all = self.lock();
        let line = |(name, file): (&String, &FileState)| {
            let why = file.stopped.as_ref()?;
            Some(format!("recording {name} stopped: {why}"))
        };
        all.iter().filter_map(line).collect()
    }

    /// State of every recording, by name and extension of its files.
    pub(crate) fn files(&self) -> BTreeMap<String, FileState> {
        self.lock().clone()
    }

    /// Whether the switch has a recording to stop or start.
    pub(crate) fn has_switched(&self) -> bool {
        self.lock().values().any(|file| file.is_switched)
    }

    /// Position of the operator's switch.
    pub(crate) fn is_on(&self) -> bool {
        self.is_on.load(Ordering::Relaxed)
    }

    /// Stops or starts the recordings from the next ping. A start opens new files.
    pub(crate) fn switch(&self, on: bool) {
        self.is_on.store(on, Ordering::Relaxed);
    }
}

/// Opens a recorder on an empty file, with the time of its start.
pub(crate) type Begin<R> = Box<dyn FnMut(&Path, UtcNs) -> Result<R, RecordError> + Send>;

/// Closes a recorder, at the time of its end.
pub(crate) type End<R> = fn(R, UtcNs) -> Result<(), RecordError>;

/// Folder, name and clock of a recording.
pub(crate) struct Place {
    pub directory: PathBuf,
    /// Files are `NAME-20140801T000010.EXTENSION`.
    pub name: String,
    pub extension: &'static str,
    /// Clock that gives the time in file names and headers.
    pub time: RigTime,
}

impl Place {
    /// Creates an empty file that no other recording uses.
    fn claim(&self, utc: UtcNs) -> Result<PathBuf, RecordError> {
        make_folder(&self.directory)?;
        let stamp = DateTime::from_timestamp_nanos(utc.0).format("%Y%m%dT%H%M%S");
        let stem = format!("{}-{stamp}", self.name);
        claim_name(&self.directory, &stem, self.extension)
    }
}

/// A recording of one kind. After an error it closes and keeps its file, and continues in a new file.
pub(crate) struct Recording<R> {
    place: Place,
    /// Name and extension of its files.
    name: String,
    begin: Begin<R>,
    /// `None`: dropping the recorder closes it, and the operator's switch does not apply.
    end: Option<End<R>>,
    open: Option<Open<R>>,
    /// Path of the newest file.
    path: PathBuf,
    next_try: Instant,
    recordings: Arc<Recordings>,
    /// Whether this ping is recorded.
    is_on: bool,
}

struct Open<R> {
    recorder: R,
    /// Whether the file holds more than its head.
    has_contents: bool,
    checked: Instant,
}

impl<R: Send + 'static> Recording<R> {
    /// Creates a recording whose first file is opened by the first write.
    pub(crate) fn later(place: Place, begin: Begin<R>, recordings: Arc<Recordings>) -> Self {
        Self {
            path: place.directory.clone(),
            name: format!("{}.{}", place.name, place.extension),
            place,
            begin,
            end: None,
            open: None,
            next_try: Instant::now(),
            recordings,
            is_on: true,
        }
    }

    /// Creates a recording that follows the operator's switch. Opens its first file if recording is on.
    pub(crate) fn open(
        place: Place,
        begin: Begin<R>,
        end: End<R>,
        recordings: Arc<Recordings>,
    ) -> Result<Self, RecordError> {
        let mut recording = Self::later(place, begin, recordings);
        recording.end = Some(end);
        recording
            .recordings
            .change(&recording.name, |file| file.is_switched = true);
        if recording.recordings.is_on() {
            recording.begin()?;
        }
        Ok(recording)
    }

    /// Reads the operator's switch before a ping: whether the ping is recorded. Closes the file if recording has been switched off.
    pub(crate) fn is_on(&mut self) -> bool {
        let was_on = self.is_on;
        self.is_on = self.end.is_none() || self.recordings.is_on();
        if was_on && !self.is_on {
            self.switch_off();
        }
        self.is_on
    }

    fn switch_off(&mut self) {
        let name = self.name.clone();
        // A stopped recording no longer waits for its disk.
        self.recordings.change(&name, |file| file.stopped = None);
        self.next_try = Instant::now();
        let (Some(open), Some(end)) = (self.open.take(), self.end) else {
            return;
        };
        info!(file = %self.path.display(), "recording is switched off");
        self.recordings.change(&name, |file| file.is_open = false);
        let (utc, recordings) = ((self.place.time)(), Arc::clone(&self.recordings));
        // Flushing a file can take longer than a ping.
        let close = move || {
            if let Err(error) = end(open.recorder, utc) {
                tracing::error!(%error, "the end of a recording");
                recordings.change(&name, |file| file.stopped = Some(error.to_string()));
            }
        };
        // Without a thread, the recorder is dropped, and `recover` repairs its file.
        let _ = thread::Builder::new()
            .name("record end".into())
            .spawn(close);
    }

    /// Path of the newest file.
    pub(crate) fn path(&self) -> &Path {
        &self.path
    }

    /// Opens a new file. A file on which the recorder cannot start is removed.
    fn begin(&mut self) -> Result<(), RecordError> {
        let utc = (self.place.time)();
        let path = self.place.claim(utc)?;
        let recorder = (self.begin)(&path, utc).inspect_err(|_| remove(&path))?;
        self.path = path;
        self.open = Some(Open {
            recorder,
            has_contents: false,
            checked: Instant::now(),
        });
        let path = self.path.clone();
        self.recordings.change(&self.name, |file| {
            (file.path, file.bytes, file.is_open) = (path, 0, true);
        });
        Ok(())
    }

    /// Opens a new file once the retry interval has passed. Returns whether a file is open. Of several failures in a row, only the first is an error.
    fn resume(&mut self) -> Result<bool, RecordError> {
        if self.open.is_some() {
            return Ok(true);
        }
        let now = Instant::now();
        if now < self.next_try {
            return Ok(false);
        }
        self.next_try = now + RETRY_INTERVAL;
        match self.begin() {
            Ok(()) => Ok(true),
            Err(error) => match self.note(&error) {
                true => Err(error),
                false => Ok(false),
            },
        }
    }

    /// Notes the reason why recording stopped. Returns true if the recording was running before.
    fn note(&self, error: &RecordError) -> bool {
        let why = error.to_string();
        let mut was_running = true;
        self.recordings.change(&self.name, |file| {
            file.is_open = false;
            was_running = file.stopped.replace(why).is_none();
        });
        was_running
    }

    /// Notes that the recording is running.
    fn note_success(&self) {
        let mut had_stopped = false;
        self.recordings.change(&self.name, |file| {
            had_stopped = file.stopped.take().is_some();
        });
        if had_stopped {
            info!(file = %self.path.display(), "recording goes on in a new file");
        }
    }

    /// Notes the length of the file. Stops the recording if the file is no longer in its folder.
    fn look(&mut self) -> Result<(), RecordError> {
        let now = Instant::now();
        let Some(open) = &mut self.open else {
            return Ok(());
        };
        if now - open.checked < CHECK_INTERVAL {
            return Ok(());
        }
        open.checked = now;
        let source = match std::fs::metadata(&self.path) {
            Ok(metadata) => {
                let bytes = metadata.len();
                self.recordings
                    .change(&self.name, |file| file.bytes = bytes);
                return Ok(());
            }
            Err(source) => source,
        };
        let error = RecordError::missing(&self.path, source);
        self.open = None;
        self.next_try = now;
        self.note(&error);
        Err(error)
    }

    /// Writes to the recorder, or tries a new file. `None` while nothing can be recorded or the ping is not. Each interruption gives one error.
    pub(crate) fn write<T>(
        &mut self,
        write: impl FnOnce(&mut R) -> Result<T, RecordError>,
    ) -> Result<Option<T>, RecordError> {
        if !self.is_on {
            return Ok(None);
        }
        self.look()?;
        if !self.resume()? {
            return Ok(None);
        }
        let Some(open) = &mut self.open else {
            return Ok(None);
        };
        match write(&mut open.recorder) {
            Ok(written) => {
                open.has_contents = true;
                self.note_success();
                Ok(Some(written))
            }
            Err(error) => {
                let had_contents = open.has_contents;
                self.open = None;
                self.next_try = Instant::now() + RETRY_INTERVAL;
                if !had_contents {
                    remove(&self.path);
                }
                match self.note(&error) {
                    true => Err(error),
                    false => Ok(None),
                }
            }
        }
    }

    /// Closes the file, if one is open.
    pub(crate) fn close(self) -> Result<(), RecordError> {
        let utc = (self.place.time)();
        match (self.open, self.end) {
            (Some(open), Some(end)) => end(open.recorder, utc),
            _ => Ok(()),
        }
    }
}

/// Removes a file without contents, and its companion files.
fn remove(path: &Path) {
    // A file that cannot be removed remains, and `recover` repairs it.
    let _ = std::fs::remove_file(path);
    if path.extension().is_some_and(|e| e == "sigmf-data") {
        for extension in ["sigmf-meta", "sigmf-journal"] {
            let _ = std::fs::remove_file(path.with_extension(extension));
        }
    }
}

#[cfg(test)]
mod tests {
    use std::fs::File;
    use std::io::Write;

    use super::*;

    fn place(directory: &Path) -> Place {
        Place {
            directory: directory.to_owned(),
            name: "hull".into(),
            extension: "txt",
            time: Arc::new(|| UtcNs(0)),
        }
    }

    fn begin(path: &Path, _: UtcNs) -> Result<File, RecordError> {
        File::create(path).map_err(|source| RecordError::missing(path, source))
    }

    /// The tail tells a file that was closed from one that was dropped.
    fn end(mut file: File, _: UtcNs) -> Result<(), RecordError> {
        file.write_all(b" end").expect("written");
        Ok(())
    }

    fn put(file: &mut File) -> Result<(), RecordError> {
        file.write_all(b"ping").expect("written");
        Ok(())
    }

    fn full() -> RecordError {
        RecordError::missing(Path::new("hull.txt"), std::io::Error::other("full"))
    }

    #[test]
    fn a_recording_stops_once_says_why_and_goes_on_in_a_new_file() {
        let folder = tempfile::tempdir().expect("a folder");
        let stopped = Arc::<Recordings>::default();
        let place = place(folder.path());
        let mut recording =
            Recording::open(place, Box::new(begin), end, stopped.clone()).expect("opens");
        let first = recording.path().to_owned();
        assert_eq!(recording.write(put).expect("written"), Some(()));
        let refused = recording.write(|_| Err::<(), _>(full()));
        assert!(refused.is_err());
        assert_eq!(stopped.lines().len(), 1, "{:?}", stopped.lines());
        // Not before the retry interval has passed.
        assert_eq!(recording.write(put).expect("waits"), None);
        // The disk is still full: no second error, and no empty file remains.
        recording.next_try = Instant::now();
        let refused = recording.write(|_| Err::<(), _>(full()));
        assert_eq!(refused.expect("told before"), None);
        let count = |folder: &Path| std::fs::read_dir(folder).expect("a folder").count();
        assert_eq!(count(folder.path()), 1);
        recording.next_try = Instant::now();
        assert_eq!(recording.write(put).expect("written"), Some(()));
        assert!(stopped.lines().is_empty());
        assert_ne!(recording.path(), first);
        assert_eq!(std::fs::read(&first).expect("kept"), b"ping");
        assert_eq!(std::fs::read(recording.path()).expect("there"), b"ping");
    }

    #[test]
    fn a_deleted_folder_is_noticed_and_made_again() {
        let folder = tempfile::tempdir().expect("a folder");
        let inside = folder.path().join("record");
        let stopped = Arc::<Recordings>::default();
        let mut recording =
            Recording::open(place(&inside), Box::new(begin), end, stopped.clone()).expect("opens");
        std::fs::remove_dir_all(&inside).expect("deleted");
        recording.open.as_mut().expect("open").checked -= CHECK_INTERVAL;
        let error = recording.write(put).expect_err("gone").to_string();
        assert!(error.contains("hull-"), "{error}");
        assert_eq!(stopped.lines().len(), 1);
        assert_eq!(recording.write(put).expect("written"), Some(()));
        assert!(stopped.lines().is_empty());
        assert_eq!(std::fs::read(recording.path()).expect("there"), b"ping");
    }

    #[test]
    fn the_operator_stops_a_recording_and_starts_a_new_file() {
        let folder = tempfile::tempdir().expect("a folder");
        let all = Arc::<Recordings>::default();
        let mut recording =
            Recording::open(place(folder.path()), Box::new(begin), end, all.clone())
                .expect("opens");
        let first = recording.path().to_owned();
        assert!(all.has_switched() && recording.is_on());
        assert_eq!(recording.write(put).expect("written"), Some(()));
        all.switch(false);
        // The ping that has begun is recorded whole.
        assert_eq!(recording.write(put).expect("written"), Some(()));
        assert!(!recording.is_on());
        assert_eq!(recording.write(put).expect("is off"), None);
        assert!(!all.files()["hull.txt"].is_open);
        let begun = Instant::now();
        while std::fs::read(&first).expect("kept") != b"pingping end" {
            assert!(begun.elapsed() < Duration::from_secs(60), "never closed");
            thread::yield_now();
        }
        all.switch(true);
        assert!(recording.is_on());
        assert_eq!(recording.write(put).expect("written"), Some(()));
        let file = &all.files()["hull.txt"];
        assert_ne!(file.path, first);
        assert!(file.is_open);
        recording.close().expect("closes");
        assert_eq!(std::fs::read(&file.path).expect("there"), b"ping end");
    }

    #[test]
    fn a_recording_that_is_switched_off_no_longer_complains() {
        let folder = tempfile::tempdir().expect("a folder");
        let all = Arc::<Recordings>::default();
        let mut recording =
            Recording::open(place(folder.path()), Box::new(begin), end, all.clone())
                .expect("opens");
        assert!(recording.write(|_| Err::<(), _>(full())).is_err());
        assert_eq!(all.lines().len(), 1);
        all.switch(false);
        assert!(!recording.is_on());
        assert!(all.lines().is_empty());
        // Started again, it does not wait for the retry interval.
        all.switch(true);
        assert!(recording.is_on());
        assert_eq!(recording.write(put).expect("written"), Some(()));
    }

    #[test]
    fn event_logs_stay_on() {
        let folder = tempfile::tempdir().expect("a folder");
        let all = Arc::<Recordings>::default();
        let mut log = Recording::later(place(folder.path()), Box::new(begin), all.clone());
        all.switch(false);
        assert!(log.is_on());
        assert_eq!(log.write(put).expect("written"), Some(()));
        assert!(!all.has_switched());
    }
}

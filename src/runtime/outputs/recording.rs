//! Recordings that continue in a new file after an error, such as a full disk or a deleted folder.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
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

/// Reasons of stopped recordings, by name and extension of their files.
#[derive(Debug, Default)]
pub(crate) struct StoppedRecordings(Mutex<BTreeMap<String, String>>);

impl StoppedRecordings {
    /// Every statement under the lock leaves a consistent map.
    fn lock(&self) -> MutexGuard<'_, BTreeMap<String, String>> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Notes that a recording ended before the run.
    pub(crate) fn stop(&self, name: &str, why: &str) {
        self.lock().insert(name.to_owned(), why.to_owned());
    }

    /// One line per stopped recording.
    pub(crate) fn lines(&self) -> Vec<String> {
        let all = self.lock();
        let line = |(name, why): (&String, &String)| format!("recording {name} stopped: {why}");
        all.iter().map(line).collect()
    }
}

/// Opens a recorder on an empty file, with the time of its start.
pub(crate) type Begin<R> = Box<dyn FnMut(&Path, UtcNs) -> Result<R, RecordError> + Send>;

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
    begin: Begin<R>,
    open: Option<Open<R>>,
    /// Path of the newest file.
    path: PathBuf,
    next_try: Instant,
    stopped: Arc<StoppedRecordings>,
}

struct Open<R> {
    recorder: R,
    /// Whether the file holds more than its head.
    has_contents: bool,
    checked: Instant,
}

impl<R> Recording<R> {
    /// Creates a recording whose first file is opened by the first write.
    pub(crate) fn later(place: Place, begin: Begin<R>, stopped: Arc<StoppedRecordings>) -> Self {
        Self {
            path: place.directory.clone(),
            place,
            begin,
            open: None,
            next_try: Instant::now(),
            stopped,
        }
    }

    /// Creates a recording and opens its first file.
    pub(crate) fn open(
        place: Place,
        begin: Begin<R>,
        stopped: Arc<StoppedRecordings>,
    ) -> Result<Self, RecordError> {
        let mut recording = Self::later(place, begin, stopped);
        recording.begin()?;
        Ok(recording)
    }

    /// Path of the newest file.
    pub(crate) fn path(&self) -> &Path {
        &self.path
    }

    fn name(&self) -> String {
        format!("{}.{}", self.place.name, self.place.extension)
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
        self.stopped.lock().insert(self.name(), why).is_none()
    }

    /// Notes that the recording is running.
    fn note_success(&self) {
        if self.stopped.lock().remove(&self.name()).is_some() {
            info!(file = %self.path.display(), "recording goes on in a new file");
        }
    }

    /// Stops the recording if the file is no longer in its folder.
    fn look(&mut self) -> Result<(), RecordError> {
        let now = Instant::now();
        let Some(open) = &mut self.open else {
            return Ok(());
        };
        if now - open.checked < CHECK_INTERVAL {
            return Ok(());
        }
        open.checked = now;
        let Err(source) = std::fs::metadata(&self.path) else {
            return Ok(());
        };
        let error = RecordError::missing(&self.path, source);
        self.open = None;
        self.next_try = now;
        self.note(&error);
        Err(error)
    }

    /// Writes to the recorder, or tries a new file. `None` while nothing can be recorded. Each interruption gives one error.
    pub(crate) fn write<T>(
        &mut self,
        write: impl FnOnce(&mut R) -> Result<T, RecordError>,
    ) -> Result<Option<T>, RecordError> {
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
    pub(crate) fn close(
        self,
        close: impl FnOnce(R) -> Result<(), RecordError>,
    ) -> Result<(), RecordError> {
        self.open.map_or(Ok(()), |open| close(open.recorder))
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
        let stopped = Arc::<StoppedRecordings>::default();
        let place = place(folder.path());
        let mut recording =
            Recording::open(place, Box::new(begin), stopped.clone()).expect("opens");
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
        let stopped = Arc::<StoppedRecordings>::default();
        let mut recording =
            Recording::open(place(&inside), Box::new(begin), stopped.clone()).expect("opens");
        std::fs::remove_dir_all(&inside).expect("deleted");
        recording.open.as_mut().expect("open").checked -= CHECK_INTERVAL;
        let error = recording.write(put).expect_err("gone").to_string();
        assert!(error.contains("hull-"), "{error}");
        assert_eq!(stopped.lines().len(), 1);
        assert_eq!(recording.write(put).expect("written"), Some(()));
        assert!(stopped.lines().is_empty());
        assert_eq!(std::fs::read(recording.path()).expect("there"), b"ping");
    }
}

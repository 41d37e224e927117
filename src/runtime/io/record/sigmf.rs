//! SigMF recordings: 16-bit I and Q samples of the elements, with a capture and an annotation for every ping.
//!
//! `NAME.sigmf-data` grows ping by ping. `NAME.sigmf-meta` is rewritten after 1, 2, 4, ... pings, at least every [`MAX_PINGS_UNSAID`] pings, and at
//! the end. `NAME.sigmf-journal` holds the metadata of later pings, one line each, and is removed at the end. `recover` merges the journal into the
//! metadata of an interrupted recording.

use std::fs::File;
use std::io::{Seek, Write};
use std::path::{Path, PathBuf};

use echotank_protocols::sigmf::{Annotation, Capture, DataType, Recording};
use serde_json::{Value, json};

use super::RecordError;
use echotank_config::spec::SonarSpec;
use echotank_core::ping::{OverloadState, PingOutput, PingPlan};
use echotank_core::pulse::PulseKind;
use echotank_emit::elements::interleave_iq;

/// Maximum number of pings whose metadata is only in the journal.
const MAX_PINGS_UNSAID: usize = 1024;

/// Paths of one recording.
#[derive(Clone, Debug)]
pub(super) struct Paths {
    pub data: PathBuf,
    pub meta: PathBuf,
    pub(crate) journal: PathBuf,
}

impl Paths {
    /// Paths for `stem`, the path without the extensions.
    pub(super) fn of(stem: &Path) -> Self {
        let named = |extension| {
            let mut path = stem.as_os_str().to_owned();
            path.push(extension);
            PathBuf::from(path)
        };
        Self {
            data: named(".sigmf-data"),
            meta: named(".sigmf-meta"),
            journal: named(".sigmf-journal"),
        }
    }

    /// Writes the metadata under a temporary name and renames the file, so that the metadata file is always complete.
    pub(crate) fn write_words(&self, text: &str) -> Result<(), RecordError> {
        let mut partial = self.meta.as_os_str().to_owned();
        partial.push(".partial");
        let partial = PathBuf::from(partial);
        std::fs::write(&partial, text).map_err(RecordError::io(&partial, "write"))?;
        std::fs::rename(&partial, &self.meta).map_err(RecordError::io(&self.meta, "rename to"))
    }
}

fn journal_line(capture: &Capture, annotation: &Annotation) -> String {
    let (capture, annotation) = (capture.to_json(), annotation.to_json());
    format!("{}\n", json!([capture, annotation]))
}

/// Parses the complete lines of a journal.
pub(super) fn journal_of(text: &str) -> impl Iterator<Item = (Capture, Annotation)> {
    text.lines().map_while(|line| {
        let both: Value = serde_json::from_str(line).ok()?;
        let capture = Capture::parse(both.get(0)?).ok()?;
        Some((capture, Annotation::parse(both.get(1)?).ok()?))
    })
}

/// Recorder of one SigMF recording. Drop closes the files if possible.
pub(crate) struct SigmfRecorder {
    paths: Paths,
    data: File,
    journal: File,
    arrays: Vec<usize>,
    sonar: SonarSpec,
    words: Recording,
    /// Number of sample times written.
    samples: u64,
    /// Number of pings in the metadata file.
    said: usize,
    iq: Vec<[i16; 2]>,
    bytes: Vec<u8>,
    /// Whether the metadata file is complete or can no longer be written.
    closed: bool,
}

impl SigmfRecorder {
    /// Creates the files of `stem`, the path without `.sigmf-data` and `.sigmf-meta`. Existing files are replaced.
    pub(crate) fn create(
        stem: &Path,
        arrays: &[usize],
        sonar: &SonarSpec,
    ) -> Result<Self, RecordError> {
        let paths = Paths::of(stem);
        let create = |path| File::create(path).map_err(RecordError::io(path, "create"));
        let (data, journal) = (create(&paths.data)?, create(&paths.journal)?);
        // The lock prevents `recover` from changing the files.
        let _ = data.try_lock();
        let elements: usize = arrays.iter().map(|&a| sonar.receive[a].elements).sum();
        let receiver = &sonar.receiver;
        let names: Vec<_> = arrays
            .iter()
            .map(|&a| format!("{} ({})", sonar.receive_names[a], sonar.receive[a].elements))
            .collect();
        let words = Recording {
            data_type: DataType::ComplexI16,
            sample_rate_hz: receiver.sample_rate_hz,
            channels: elements as u32,
            hardware: format!("simulated sonar {}, serial {}", sonar.name, sonar.serial),
            description: format!(
                "Element samples about the centre frequency; arrays and elements: {}; 32767 counts are {} V rms",
                names.join(", "),
                receiver.full_scale_v
            ),
            recorder: concat!("echotank ", env!("CARGO_PKG_VERSION")).into(),
            captures: Vec::new(),
            annotations: Vec::new(),
        };
        let mut recorder = Self {
            paths,
            data,
            journal,
            arrays: arrays.to_vec(),
            sonar: sonar.clone(),
            words,
            samples: 0,
            said: 0,
            iq: Vec::new(),
            bytes: Vec::new(),
            closed: false,
        };
        recorder.say()?;
        Ok(recorder)
    }

    pub(crate) fn paths(&self) -> [&Path; 2] {
        [&self.paths.data, &self.paths.meta]
    }

    /// Appends a ping. Returns the number of clipped values.
    pub(crate) fn push(
        &mut self,
        plan: &PingPlan,
        output: &PingOutput,
    ) -> Result<u64, RecordError> {
        if self.closed {
            return Err(RecordError::Stopped {
                path: self.paths.data.clone(),
            });
        }
        let samples = plan.sample_count;
        let full_scale_v = self.sonar.receiver.full_scale_v;
        let saturated = interleave_iq(output, &self.arrays, samples, full_scale_v, &mut self.iq);
        self.bytes.clear();
        self.bytes
            .extend(self.iq.as_flattened().iter().flat_map(|v| v.to_le_bytes()));
        if let Err(source) = self.data.write_all(&self.bytes) {
            return Err(self.stop(source));
        }
        let (capture, annotation) = words_of(plan, output.overload_state, self.samples, saturated);
        // Samples are written before their journal entry, so that no entry lacks its samples.
        let line = journal_line(&capture, &annotation);
        if let Err(source) = self.journal.write_all(line.as_bytes()) {
            return Err(self.stop(source));
        }
        self.words.captures.push(capture);
        self.words.annotations.push(annotation);
        self.samples += samples as u64;
        let pings = self.words.captures.len();
        if pings >= (2 * self.said).min(self.said + MAX_PINGS_UNSAID) {
            self.say()?;
        }
        Ok(saturated)
    }

    /// Stops recording and removes an incomplete ping. Metadata and journal stay as written.
    fn stop(&mut self, source: std::io::Error) -> RecordError {
        let sample_time_bytes = 4 * u64::from(self.words.channels);
        let _ = self.data.set_len(self.samples * sample_time_bytes);
        self.closed = true;
        RecordError::io(&self.paths.data, "write")(source)
    }

    fn say(&mut self) -> Result<(), RecordError> {
        self.paths.write_words(&self.words.to_json())?;
        self.said = self.words.captures.len();
        // Recovery skips duplicate entries, so an interruption between these two steps loses nothing.
        let emptied = self.journal.set_len(0);
        emptied
            .and_then(|()| self.journal.rewind())
            .map_err(RecordError::io(&self.paths.journal, "write"))
    }

    pub(crate) fn close(mut self) -> Result<(), RecordError> {
        self.end()
    }

    fn end(&mut self) -> Result<(), RecordError> {
        self.closed = true;
        if self.said < self.words.captures.len() {
            self.say()?;
        }
        // A closed recording has no journal. A remaining journal is harmless.
        let _ = std::fs::remove_file(&self.paths.journal);
        Ok(())
    }
}

impl Drop for SigmfRecorder {
    fn drop(&mut self) {
        // A drop cannot report an error; `close` does.
        let _ = self.end();
    }
}

fn words_of(
    plan: &PingPlan,
    overload_state: OverloadState,
    sample_start: u64,
    saturated: u64,
) -> (Capture, Annotation) {
    let looser = overload_state
        .tolerance
        .map_or_else(String::new, |tolerance| {
            format!("; overload: computed with tolerance {tolerance:e}")
        });
    let (pulse, nav, settings) = (&plan.pulse, &plan.nav, &plan.settings);
    let capture = Capture {
        sample_start,
        frequency_hz: Some(pulse.center_frequency_hz),
        utc_ns: plan.stamp_utc.plus_s(plan.first_sample_s).0,
    };
    let kind = match pulse.kind {
        PulseKind::Cw => "CW",
        PulseKind::LfmUp => "LFM up",
        PulseKind::LfmDown => "LFM down",
    };
    let half_band_hz = 0.5 * pulse.bandwidth_hz.max(1.0 / pulse.duration_s);
    let annotation = Annotation {
        sample_start,
        sample_count: plan.sample_count as u64,
        label: format!("ping {}", plan.ping_number),
        comment: format!(
            "{kind} of {:.6} s; range {} m, {:.3} pings/s, source level {} dB, gain {} dB, c {} m/s; latitude {:.7}, longitude {:.7}, heading {:.3}, roll {:.3}, pitch {:.3} deg, heave {:.3} m down; {saturated} values held{looser}",
            pulse.duration_s,
            settings.range_m,
            plan.ping_rate_hz,
            settings.source_level_db,
            settings.gain_db,
            plan.sound_speed_m_per_s,
            nav.latitude_rad.to_degrees(),
            nav.longitude_rad.to_degrees(),
            nav.heading_rad.to_degrees(),
            nav.roll_rad.to_degrees(),
            nav.pitch_rad.to_degrees(),
            nav.heave_down_m,
        ),
        band_hz: Some((
            pulse.center_frequency_hz - half_band_hz,
            pulse.center_frequency_hz + half_band_hz,
        )),
    };
    (capture, annotation)
}

#[cfg(test)]
mod tests {
    use super::super::testing;
    use super::*;

    #[test]
    fn every_ping_is_a_capture_with_an_annotation_and_its_samples() {
        let dir = tempfile::tempdir().expect("folder");
        let spec = testing::sonar();
        let pings = [1, 2, 4].map(|n| (testing::plan(n), testing::output(n)));
        let stem = dir.path().join("rec");
        let mut recorder = SigmfRecorder::create(&stem, &[0], &spec).expect("creates");
        let mut want = Vec::new();
        for (plan, output) in &pings {
            let held = recorder.push(plan, output).expect("writes");
            assert_eq!(held, 0);
            for k in 0..plan.sample_count {
                for e in 0..spec.receive[0].elements {
                    let v = output.elements[0].element(e)[k] / spec.receiver.full_scale_v * 32767.0;
                    want.extend((v.re.round() as i16).to_le_bytes());
                    want.extend((v.im.round() as i16).to_le_bytes());
                }
            }
        }
        // State of a recording that is interrupted here.
        let meta = || std::fs::read_to_string(dir.path().join("rec.sigmf-meta")).expect("there");
        let early = Recording::parse(&meta()).expect("whole");
        assert_eq!(early.captures.len(), 2);
        recorder.close().expect("closes");
        let data = std::fs::read(dir.path().join("rec.sigmf-data")).expect("there");
        assert!(data == want, "{} bytes, {} wanted", data.len(), want.len());
        let words = Recording::parse(&meta()).expect("whole");
        let sample_time_bytes = 4 * u64::from(words.channels);
        assert_eq!(words.channels as usize, spec.receive[0].elements);
        let mut start = 0;
        for ((plan, _), (capture, annotation)) in pings
            .iter()
            .zip(words.captures.iter().zip(&words.annotations))
        {
            assert_eq!(capture.sample_start, start);
            assert_eq!(capture.utc_ns, plan.stamp_utc.plus_s(plan.first_sample_s).0);
            assert_eq!(annotation.label, format!("ping {}", plan.ping_number));
            assert_eq!(
                (annotation.sample_start, annotation.sample_count),
                (start, plan.sample_count as u64)
            );
            start += plan.sample_count as u64;
        }
        assert_eq!(start * sample_time_bytes, data.len() as u64);
    }

    #[test]
    fn a_missing_folder_is_an_error_that_names_the_file() {
        let spec = testing::sonar();
        let error = SigmfRecorder::create(Path::new("/no/such/folder/a"), &[0], &spec)
            .err()
            .expect("no folder");
        let text = error.to_string();
        assert!(
            text.contains("/no/such/folder/a.sigmf-data: cannot create"),
            "{text}"
        );
    }
}

//! SigMF recordings: I and Q of the elements, 16 bits each, with a capture and an annotation for every ping.
//!
//! `NAME.sigmf-data` grows ping by ping; `NAME.sigmf-meta`, which says what is in it, is written anew after 1, 2, 4, ... pings, every
//! [`MOST_PINGS_UNSAID`] at the latest, and at the end: what a recording that was cut off has no words for is at its end.

use std::fs::File;
use std::io::Write;
use std::path::{Path, PathBuf};

use echotank_protocols::sigmf::{Annotation, Capture, DataType, Recording};

use super::RecordError;
use crate::config::spec::SonarSpec;
use crate::emit::elements::interleave_iq;
use crate::flow::{PingOutput, PingPlan, PulseKind};

/// Pings that a recording may hold without words for them.
const MOST_PINGS_UNSAID: usize = 1024;

/// Writes one recording. Dropping it closes it as well as it can.
pub struct SigmfRecorder {
    data_path: PathBuf,
    meta_path: PathBuf,
    data: File,
    arrays: Vec<usize>,
    sonar: SonarSpec,
    words: Recording,
    /// Moments so far.
    samples: u64,
    /// Pings that the words on the disk know of.
    said: usize,
    iq: Vec<[i16; 2]>,
    bytes: Vec<u8>,
    /// The words on the disk are all there are, or can no longer be written.
    closed: bool,
}

impl SigmfRecorder {
    /// `stem` is the name of both files without `.sigmf-data` and `.sigmf-meta`; what has these names is replaced.
    pub fn create(stem: &Path, arrays: &[usize], sonar: &SonarSpec) -> Result<Self, RecordError> {
        let named = |extension| {
            let mut path = stem.as_os_str().to_owned();
            path.push(extension);
            PathBuf::from(path)
        };
        let (data_path, meta_path) = (named(".sigmf-data"), named(".sigmf-meta"));
        let data = File::create(&data_path).map_err(RecordError::io(&data_path, "create"))?;
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
            data_path,
            meta_path,
            data,
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

    pub fn paths(&self) -> [&Path; 2] {
        [&self.data_path, &self.meta_path]
    }

    /// Appends a ping; returns how many values did not fit.
    pub fn push(&mut self, plan: &PingPlan, output: &PingOutput) -> Result<u64, RecordError> {
        if self.closed {
            return Err(RecordError::Stopped {
                path: self.data_path.clone(),
            });
        }
        let samples = plan.sample_count;
        let full_scale_v = self.sonar.receiver.full_scale_v;
        let saturated = interleave_iq(output, &self.arrays, samples, full_scale_v, &mut self.iq);
        self.bytes.clear();
        self.bytes
            .extend(self.iq.as_flattened().iter().flat_map(|v| v.to_le_bytes()));
        if let Err(source) = self.data.write_all(&self.bytes) {
            // Whole pings only; the words have none that is not there.
            let moment_bytes = 4 * u64::from(self.words.channels);
            let _ = self.data.set_len(self.samples * moment_bytes);
            self.closed = true;
            return Err(RecordError::io(&self.data_path, "write")(source));
        }
        let (capture, annotation) = words_of(plan, self.samples, saturated);
        self.words.captures.push(capture);
        self.words.annotations.push(annotation);
        self.samples += samples as u64;
        let pings = self.words.captures.len();
        if pings >= (2 * self.said).min(self.said + MOST_PINGS_UNSAID) {
            self.say()?;
        }
        Ok(saturated)
    }

    /// Writes what there is to say under a name of its own first, so that the words are whole at any moment.
    fn say(&mut self) -> Result<(), RecordError> {
        let mut partial = self.meta_path.as_os_str().to_owned();
        partial.push(".partial");
        let partial = PathBuf::from(partial);
        std::fs::write(&partial, self.words.to_json())
            .map_err(RecordError::io(&partial, "write"))?;
        std::fs::rename(&partial, &self.meta_path)
            .map_err(RecordError::io(&self.meta_path, "rename to"))?;
        self.said = self.words.captures.len();
        Ok(())
    }

    pub fn close(mut self) -> Result<(), RecordError> {
        self.end()
    }

    fn end(&mut self) -> Result<(), RecordError> {
        self.closed = true;
        if self.said < self.words.captures.len() {
            self.say()?;
        }
        Ok(())
    }
}

impl Drop for SigmfRecorder {
    fn drop(&mut self) {
        // Nobody is left to tell; `close` tells.
        let _ = self.end();
    }
}

fn words_of(plan: &PingPlan, sample_start: u64, saturated: u64) -> (Capture, Annotation) {
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
            "{kind} of {:.6} s; range {} m, {:.3} pings/s, source level {} dB, gain {} dB, c {} m/s; latitude {:.7}, longitude {:.7}, heading {:.3}, roll {:.3}, pitch {:.3} deg, heave {:.3} m down; {saturated} values held",
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
        // As a recording that is cut off now would be.
        let meta = || std::fs::read_to_string(dir.path().join("rec.sigmf-meta")).expect("there");
        let early = Recording::parse(&meta()).expect("whole");
        assert_eq!(early.captures.len(), 2);
        recorder.close().expect("closes");
        let data = std::fs::read(dir.path().join("rec.sigmf-data")).expect("there");
        assert!(data == want, "{} bytes, {} wanted", data.len(), want.len());
        let words = Recording::parse(&meta()).expect("whole");
        let moment_bytes = 4 * u64::from(words.channels);
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
        assert_eq!(start * moment_bytes, data.len() as u64);
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

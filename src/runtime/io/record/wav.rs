//! Multichannel WAV of the signals at the elements, for playback on a bench: real samples at the rate of the converters, one channel per element.
//!
//! Sample k lies k sample times after the start of the first ping's pulse. Every ping is placed at its own time, to the nearest sample. Silence
//! between pings is a hole if the file system supports holes. The header is correct after every ping.

use std::fs::File;
use std::io::{Seek, SeekFrom, Write};
use std::path::{Path, PathBuf};

use echotank_protocols::wav::{Container, WavFormat, WavSample};

use super::RecordError;
use echotank_config::spec::{SonarSpec, WavSpec};
use echotank_core::ping::{PingOutput, PingPlan};
use echotank_core::time::UtcNs;
use echotank_emit::elements::{counts, elements_of};
use echotank_emit::passband::Passband;

/// Recorder of one WAV file.
pub(crate) struct WavRecorder {
    path: PathBuf,
    file: File,
    format: WavFormat,
    arrays: Vec<usize>,
    full_scale_v: f64,
    in_rate_hz: f64,
    passband: Passband,
    /// Start of the first ping's pulse.
    origin: Option<UtcNs>,
    /// Number of sample times written or skipped.
    sample_times: u64,
    bytes: Vec<u8>,
    stopped: bool,
}

impl WavRecorder {
    /// Creates the file, replacing an existing one.
    pub(crate) fn create(
        path: &Path,
        output: &WavSpec,
        sonar: &SonarSpec,
    ) -> Result<Self, RecordError> {
        let file = File::create(path).map_err(RecordError::io(path, "create"))?;
        // The lock prevents `recover` from changing the file.
        let _ = file.try_lock();
        let channels: usize = output
            .arrays
            .iter()
            .map(|&a| sonar.receive[a].elements)
            .sum();
        let receiver = &sonar.receiver;
        let mut recorder = Self {
            path: path.to_owned(),
            file,
            format: WavFormat {
                // The configuration limits the number of channels.
                channels: channels.min(usize::from(u16::MAX)) as u16,
                sample_rate_hz: output.rate_hz,
                sample: if output.is_float {
                    WavSample::F32
                } else {
                    WavSample::I16
                },
            },
            arrays: output.arrays.clone(),
            full_scale_v: receiver.full_scale_v,
            in_rate_hz: receiver.sample_rate_hz,
            passband: Passband::new(
                receiver.sample_rate_hz,
                f64::from(output.rate_hz),
                sonar.pulse.center_frequency_hz,
            ),
            origin: None,
            sample_times: 0,
            bytes: Vec::new(),
            stopped: false,
        };
        recorder
            .write_header()
            .map_err(RecordError::io(path, "write"))?;
        Ok(recorder)
    }

    pub(crate) fn path(&self) -> &Path {
        &self.path
    }

    /// Writes a ping at its time. Returns the number of clipped values.
    pub(crate) fn push(
        &mut self,
        plan: &PingPlan,
        output: &PingOutput,
    ) -> Result<u64, RecordError> {
        if self.stopped {
            return Err(RecordError::Stopped {
                path: self.path.clone(),
            });
        }
        let origin = *self.origin.get_or_insert(plan.transmit_utc);
        let pulse_s = plan.transmit_utc.seconds_since(origin);
        let rate_hz = f64::from(self.format.sample_rate_hz);
        let begin_s = pulse_s + plan.first_sample_s;
        let end_s = begin_s + plan.sample_count as f64 / self.in_rate_hz;
        // A ping begins after the previous window; a shared sample belongs to the earlier ping.
        let first = ((begin_s * rate_hz).ceil().max(0.0) as u64).max(self.sample_times);
        let last = ((end_s * rate_hz).floor().max(0.0) as u64).max(first);
        let sample_times = (last - first) as usize;
        self.passband.begin(
            first as f64 / rate_hz - pulse_s,
            sample_times,
            plan.first_sample_s,
        );
        let saturated = self.fill(output, sample_times);
        let frame_bytes = self.format.frame_bytes();
        let at = echotank_protocols::wav::HEADER_BYTES as u64 + first * frame_bytes;
        let written = self
            .file
            .seek(SeekFrom::Start(at))
            .and_then(|_| self.file.write_all(&self.bytes));
        let before = self.sample_times;
        self.sample_times = if written.is_ok() { last } else { before };
        written
            .and_then(|()| self.write_header())
            .map_err(|source| {
                self.stopped = true;
                // Restores whole pings. If this fails too, readers use the length in the header.
                let frame_bytes = self.format.frame_bytes();
                let end = echotank_protocols::wav::HEADER_BYTES as u64 + before * frame_bytes;
                let _ = self.file.set_len(end);
                RecordError::io(&self.path, "write")(source)
            })?;
        Ok(saturated)
    }

    fn fill(&mut self, output: &PingOutput, sample_times: usize) -> u64 {
        let frame_bytes = self.format.frame_bytes() as usize;
        let sample_bytes = self.format.sample.bytes();
        self.bytes.clear();
        self.bytes.resize(sample_times * frame_bytes, 0);
        let mut saturated = 0;
        let (bytes, full_scale_v) = (&mut self.bytes, self.full_scale_v);
        let is_float = self.format.sample == WavSample::F32;
        let envelopes = elements_of(output, &self.arrays);
        self.passband.elements(envelopes, |elements, first, rows| {
            let frames = bytes[first * frame_bytes..].chunks_mut(frame_bytes);
            for (frame, row) in frames.zip(rows) {
                let samples = frame.chunks_mut(sample_bytes).skip(elements.start);
                for (sample, volts) in samples.zip(&row[..elements.len()]) {
                    let value = volts / full_scale_v;
                    if is_float {
                        sample.copy_from_slice(&(value as f32).to_le_bytes());
                    } else {
                        let (counts, held) = counts(value);
                        saturated += u64::from(held);
                        sample.copy_from_slice(&counts.to_le_bytes());
                    }
                }
            }
        });
        saturated
    }

    fn write_header(&mut self) -> std::io::Result<()> {
        let mut header = Vec::new();
        self.format
            .emit_header(&mut header, self.sample_times, Container::AsNeeded);
        self.file.seek(SeekFrom::Start(0))?;
        self.file.write_all(&header)
    }

    pub(crate) fn close(self) -> Result<(), RecordError> {
        if self.stopped {
            return Err(RecordError::Stopped { path: self.path });
        }
        self.file
            .sync_data()
            .map_err(RecordError::io(&self.path, "close"))
    }
}

#[cfg(test)]
mod tests {
    use echotank_protocols::wav::{HEADER_BYTES, WavHeader};
    use num_complex::Complex64;

    use super::super::testing;
    use super::*;

    /// A constant envelope of 1 V for 10 ms.
    fn ping(number: u32) -> (PingPlan, PingOutput) {
        let (mut plan, mut output) = (testing::plan(number), testing::output(number));
        plan.sample_count = 400;
        // Between two samples of the file.
        plan.transmit_utc = plan.transmit_utc.plus_ns(i64::from(number) * 333);
        let frame = &mut output.elements[0];
        frame.samples = plan.sample_count;
        frame.iq = vec![Complex64::ONE; frame.elements * frame.samples];
        (plan, output)
    }

    fn recorded(is_float: bool) -> (Vec<u8>, SonarSpec, Vec<(PingPlan, PingOutput)>) {
        let dir = tempfile::tempdir().expect("folder");
        let mut spec = testing::sonar();
        spec.receiver.full_scale_v = 4.0;
        let pings = vec![ping(1), ping(2)];
        let output = WavSpec {
            arrays: vec![0],
            rate_hz: 1_000_000,
            is_float,
        };
        let path = dir.path().join("a.wav");
        let mut wav = WavRecorder::create(&path, &output, &spec).expect("creates");
        for (plan, output) in &pings {
            wav.push(plan, output).expect("writes");
        }
        wav.close().expect("closes");
        (std::fs::read(&path).expect("there"), spec, pings)
    }

    #[test]
    fn pings_lie_where_they_happened_with_silence_between_them() {
        let (bytes, spec, pings) = recorded(false);
        let header = WavHeader::parse(&bytes).expect("a WAV");
        let channels = usize::from(header.format.channels);
        assert_eq!(channels, spec.receive[0].elements);
        assert_eq!(header.data_bytes as usize, bytes.len() - HEADER_BYTES);
        let at = |k: usize, channel: usize| {
            let at = HEADER_BYTES + 2 * (k * channels + channel);
            f64::from(i16::from_le_bytes([bytes[at], bytes[at + 1]]))
        };
        let origin = pings[0].0.transmit_utc;
        let mut sounding = vec![false; header.sample_times() as usize];
        for (plan, _) in &pings {
            let pulse_s = plan.transmit_utc.seconds_since(origin);
            let window_s = plan.sample_count as f64 / spec.receiver.sample_rate_hz;
            for (k, sounds) in sounding.iter_mut().enumerate() {
                let t = k as f64 / 1e6 - pulse_s;
                let into_s = t - plan.first_sample_s;
                *sounds |= (0.0..window_s).contains(&into_s);
                // A constant envelope of a quarter of full scale gives a constant carrier, with ringing at its ends.
                if into_s > 1e-3 && into_s < window_s - 1e-3 {
                    let turns = spec.pulse.center_frequency_hz * t;
                    let want = 32767.0 / 4.0 * (std::f64::consts::TAU * turns).cos();
                    let got = at(k, channels - 1);
                    assert!((got - want).abs() <= 1.0, "{k}: {got}, {want}");
                }
            }
        }
        let loud = sounding.iter().filter(|&&sounds| sounds).count();
        assert!(
            loud > 0 && loud < sounding.len(),
            "{loud} of {}",
            sounding.len()
        );
        for (k, _) in sounding.iter().enumerate().filter(|(_, sounds)| !**sounds) {
            assert_eq!(at(k, 0), 0.0, "{k} lies between pings");
        }
    }

    #[test]
    fn floats_are_parts_of_full_scale() {
        let (bytes, spec, _) = recorded(true);
        let header = WavHeader::parse(&bytes).expect("a WAV");
        assert_eq!(header.format.sample, WavSample::F32);
        let channels = spec.receive[0].elements;
        let largest = bytes[HEADER_BYTES..]
            .chunks_exact(4)
            .step_by(channels)
            .map(|b| f32::from_le_bytes([b[0], b[1], b[2], b[3]]).abs())
            .fold(0.0, f32::max);
        // The ends of the record ring by a few per cent.
        assert!((0.25..0.3).contains(&largest), "{largest}");
    }

    #[cfg(target_os = "linux")]
    #[test]
    fn a_full_disk_and_a_missing_folder_are_errors_that_name_the_file() {
        let spec = testing::sonar();
        let output = WavSpec {
            arrays: vec![0],
            rate_hz: 1_000_000,
            is_float: false,
        };
        for (path, action) in [("/no/such/folder/a.wav", "create"), ("/dev/full", "write")] {
            let error = WavRecorder::create(Path::new(path), &output, &spec)
                .err()
                .expect("cannot be written");
            let text = error.to_string();
            assert!(text.contains(path) && text.contains(action), "{text}");
        }
    }
}

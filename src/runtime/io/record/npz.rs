//! `pings.npz`: the samples of one sonar with positions and attitudes, for comparison with independent calculations.
//!
//! | array | shape | type and content |
//! |---|---|---|
//! | `iq_by_element` | pings, elements, samples | complex64 (complex128 on request), envelope in V rms; elements of all receive arrays in order |
//! | `element_array` | elements | i32, index of the receive array |
//! | `beams` | pings, beams, samples | as `iq_by_element`; zero beams without a fan |
//! | `beam_angle_rad` | beams, or pings, beams if they change | f64, from boresight, starboard positive |
//! | `lines` | pings, lines, line samples | f32, sample 0 at the start of the pulse |
//! | `line_side` | lines | i32, -1 port, +1 starboard |
//! | `sample_rate_hz`, `first_sample_s`, `center_frequency_hz`, `sound_speed_m_per_s` | scalar | f64; sample k lies at first_sample_s + k / sample_rate_hz from the start of the pulse |
//! | `ping_number` | pings | i64 |
//! | `ping_utc_ns` | pings | i64, start of the pulse |
//! | `transmit_position_m` | pings, 3 | f64, north-east-down, first transmit array at the start of the pulse |
//! | `element_position_m` | pings, elements, 3 | f64, north-east-down, at the start of the pulse |
//! | `velocity_m_per_s` | pings, 3 | f64, north-east-down, reference point at the start of the pulse |
//! | `position_m` | pings, 3 | f64, north-east-down, reference point at the start of the pulse |
//! | `attitude_deg` | pings, 3 | f64, roll (starboard down), pitch (bow up), heading, at the start of the pulse |
//! | `geodetic_deg` | pings, 2 | f64, latitude and longitude of the reference point at the start of the pulse |
//! | `line_position_m` | pings, lines, 3 | f64, north-east-down, transmit array of each line at the start of the pulse |
//! | `sounding_twtt_s`, `sounding_error_s` | pings, beams | f64, two-way time of the bottom in each beam and its predicted error; NaN without detection. Needs `bottom_detection`, as does the next |
//! | `sounding_method` | pings, beams | u1, 0 none, 1 amplitude, 2 phase |
//! | `plan` | scalar | JSON text: the sonar and the plan of the first ping |
//!
//! All pings have one shape; a ping with another number of samples is refused. Each array grows in a `.partial` file beside the target, so memory
//! stays small. [`NpzRecorder::finish`] assembles the arrays without compression and with fixed dates, so equal pings give equal bytes. Layout: NumPy
//! Enhancement Proposal 1 (`.npy` version 1.0) in a ZIP archive.

use std::fs::File;
use std::io::{BufReader, BufWriter, Read, Seek, SeekFrom, Write};
use std::path::{Path, PathBuf};

use num_complex::{Complex32, Complex64};
use zip::write::SimpleFileOptions;
use zip::{CompressionMethod, DateTime, ZipWriter};

use super::{PartialFile, RecordError, plan_text};
use echotank_config::spec::SonarSpec;
use echotank_core::frames::angles_from_rotation;
use echotank_core::ping::{Detection, PingOutput, PingPlan, Side};

/// Items converted to bytes at a time.
const BLOCK: usize = 8192;
/// Size from which members get 64-bit sizes, bytes; the limit of the format is slightly higher.
const LARGE_BYTES: u64 = 0xFFFF_0000;

/// Recorder of `pings.npz` for one sonar.
pub(crate) struct NpzRecorder {
    path: PathBuf,
    sonar: SonarSpec,
    double: bool,
    first: Option<First>,
    /// Whether a ping has other beam angles than the first.
    angles_change: bool,
    pings: usize,
    stopped: bool,
    bytes: Vec<u8>,
    arrays: PerPing,
}

/// Properties fixed by the first ping.
struct First {
    samples: usize,
    line_samples: usize,
    first_sample_s: f64,
    center_frequency_hz: f64,
    sound_speed_m_per_s: f64,
    beam_angle_rad: Vec<f64>,
    plan_json: String,
}

/// Arrays that grow with every ping.
struct PerPing {
    iq_by_element: PartialFile,
    beams: PartialFile,
    beam_angle_rad: PartialFile,
    lines: PartialFile,
    more_lines: PartialFile,
    ping_number: PartialFile,
    ping_utc_ns: PartialFile,
    transmit_position_m: PartialFile,
    element_position_m: PartialFile,
    velocity_m_per_s: PartialFile,
    position_m: PartialFile,
    attitude_deg: PartialFile,
    geodetic_deg: PartialFile,
    line_position_m: PartialFile,
    sounding_twtt_s: PartialFile,
    sounding_error_s: PartialFile,
    sounding_method: PartialFile,
}

impl NpzRecorder {
    /// Creates `dir/pings.npz`; the folder must exist. `double` selects complex128 samples. Each sonar needs its own folder.
    pub(crate) fn create(dir: &Path, sonar: &SonarSpec, double: bool) -> Result<Self, RecordError> {
        let path = dir.join("pings.npz");
        let grow = |name: &str| PartialFile::create(&dir.join(format!("pings.npz.{name}")));
        Ok(Self {
            arrays: PerPing {
                iq_by_element: grow("iq_by_element")?,
                beams: grow("beams")?,
                beam_angle_rad: grow("beam_angle_rad")?,
                lines: grow("lines")?,
                more_lines: grow("more_lines")?,
                ping_number: grow("ping_number")?,
                ping_utc_ns: grow("ping_utc_ns")?,
                transmit_position_m: grow("transmit_position_m")?,
                element_position_m: grow("element_position_m")?,
                velocity_m_per_s: grow("velocity_m_per_s")?,
                position_m: grow("position_m")?,
                attitude_deg: grow("attitude_deg")?,
                geodetic_deg: grow("geodetic_deg")?,
                line_position_m: grow("line_position_m")?,
                sounding_twtt_s: grow("sounding_twtt_s")?,
                sounding_error_s: grow("sounding_error_s")?,
                sounding_method: grow("sounding_method")?,
            },
            path,
            sonar: sonar.clone(),
            double,
            first: None,
            angles_change: false,
            pings: 0,
            stopped: false,
            bytes: Vec::with_capacity(BLOCK * 16),
        })
    }

    /// Adds a ping. Recording continues after [`RecordError::ShapeChanged`] and stops after any other error.
    pub(crate) fn push(&mut self, plan: &PingPlan, output: &PingOutput) -> Result<(), RecordError> {
        if self.stopped {
            return Err(RecordError::Stopped {
                path: self.path.clone(),
            });
        }
        self.check_shape(plan, output)?;
        let written = self.write(plan, output);
        match written {
            Ok(()) => self.pings += 1,
            Err(_) => self.stopped = true,
        }
        written
    }

    fn check_shape(&mut self, plan: &PingPlan, output: &PingOutput) -> Result<(), RecordError> {
        let line_samples = output.lines.first().map_or(0, |l| l.amplitude.len());
        let first = self.first.get_or_insert_with(|| First {
            samples: plan.sample_count,
            line_samples,
            first_sample_s: plan.first_sample_s,
            center_frequency_hz: plan.pulse.center_frequency_hz,
            sound_speed_m_per_s: plan.sound_speed_m_per_s,
            beam_angle_rad: output
                .beams
                .first()
                .map_or(Vec::new(), |b| b.angle_rad.clone()),
            plan_json: plan_text::sonar_and_plan(&self.sonar, plan).to_string(),
        });
        let elements: usize = output.elements.iter().map(|f| f.elements).sum();
        let fans = usize::from(self.sonar.beams.fan.is_some());
        let mut checks = vec![
            ("samples", plan.sample_count, first.samples),
            ("elements", elements, element_count(&self.sonar)),
            ("lines", output.lines.len(), self.sonar.beams.lines.len()),
            ("fans", output.beams.len(), fans),
        ];
        for frame in &output.elements {
            checks.push(("samples", frame.samples, first.samples));
        }
        for fan in &output.beams {
            checks.push(("beams", fan.beams, first.beam_angle_rad.len()));
            checks.push(("samples", fan.samples, first.samples));
        }
        for line in &output.lines {
            checks.push(("line samples", line.amplitude.len(), first.line_samples));
        }
        match checks.into_iter().find(|(_, got, want)| got != want) {
            None => Ok(()),
            Some((what, got, want)) => {
                if self.pings == 0 {
                    self.first = None;
                }
                Err(RecordError::ShapeChanged {
                    path: self.path.clone(),
                    ping_number: plan.ping_number,
                    what,
                    got,
                    want,
                })
            }
        }
    }

    fn write(&mut self, plan: &PingPlan, output: &PingOutput) -> Result<(), RecordError> {
        let (to, bytes) = (&mut self.arrays, &mut self.bytes);
        for frame in &output.elements {
            let parts = |x: &Complex64| [x.re, x.im];
            write_samples(
                &mut to.iq_by_element,
                bytes,
                (&frame.iq, parts),
                self.double,
            )?;
        }
        for fan in &output.beams {
            let parts = |x: &Complex32| [x.re, x.im].map(f64::from);
            write_samples(&mut to.beams, bytes, (&fan.iq, parts), self.double)?;
            let angles = fan.angle_rad.iter().flat_map(|angle| angle.to_le_bytes());
            to.beam_angle_rad.write(&angles.collect::<Vec<_>>())?;
            let first = self.first.as_ref().map(|first| &first.beam_angle_rad);
            self.angles_change |= first.is_some_and(|first| *first != fan.angle_rad);
        }
        for line in &output.lines {
            write_items(&mut to.lines, bytes, &line.amplitude, |a, out| {
                out.extend(a.to_le_bytes())
            })?;
        }
        // The lines of a later pulse are shorter and are padded with zeros.
        let line_samples = self.first.as_ref().map_or(0, |f| f.line_samples);
        for line in output.more_lines.iter().flat_map(|more| &more.lines) {
            let samples = (0..line_samples).map(|k| line.amplitude.get(k).copied().unwrap_or(0.0));
            bytes.clear();
            bytes.extend(samples.flat_map(f32::to_le_bytes));
            to.more_lines.write(bytes)?;
        }
        to.ping_number
            .write(&i64::from(plan.ping_number).to_le_bytes())?;
        to.ping_utc_ns.write(&plan.transmit_utc.0.to_le_bytes())?;

        let pose = plan.trajectory.pose_at(0.0);
        let doubles = |v: glam::DVec3| v.to_array().map(f64::to_le_bytes).concat();
        let transmit = self.sonar.transmit.first();
        let transmit_m =
            pose.point_m(transmit.map_or(glam::DVec3::ZERO, |t| t.mounting.position_m));
        to.transmit_position_m.write(&doubles(transmit_m))?;
        for array in &self.sonar.receive {
            for e in 0..array.elements {
                let element_m = pose.point_m(array.element_body_m(e));
                to.element_position_m.write(&doubles(element_m))?;
            }
        }
        to.velocity_m_per_s.write(&doubles(pose.velocity_m_per_s))?;
        to.position_m.write(&doubles(pose.position_m))?;
        let (roll, pitch, heading) = angles_from_rotation(pose.world_from_body);
        let degrees = glam::DVec3::new(roll, pitch, heading).map(f64::to_degrees);
        to.attitude_deg.write(&doubles(degrees))?;
        for angle_rad in [plan.nav.latitude_rad, plan.nav.longitude_rad] {
            to.geodetic_deg
                .write(&angle_rad.to_degrees().to_le_bytes())?;
        }
        for line in &self.sonar.beams.lines {
            let array = &self.sonar.receive[line.array];
            let mounting = &self.sonar.transmit[array.transmit].mounting;
            to.line_position_m
                .write(&doubles(pose.point_m(mounting.position_m)))?;
        }
        if sounded(&self.sonar) {
            let beams = output.beams.first().map_or(0, |fan| fan.beams);
            for beam in 0..beams {
                let found = output.soundings.iter().find(|s| s.beam == beam);
                let (twtt_s, error_s) =
                    found.map_or((f64::NAN, f64::NAN), |s| (s.twtt_s, s.error_s));
                to.sounding_twtt_s.write(&twtt_s.to_le_bytes())?;
                to.sounding_error_s.write(&error_s.to_le_bytes())?;
                to.sounding_method
                    .write(&[found.map_or(0, |s| match s.detection {
                        Detection::Amplitude => 1,
                        Detection::Phase => 2,
                    })])?;
            }
        }
        Ok(())
    }

    /// Assembles the file and returns its path; `None` without pings.
    pub(crate) fn finish(self) -> Result<Option<PathBuf>, RecordError> {
        if self.stopped {
            return Err(RecordError::Stopped { path: self.path });
        }
        let Some(first) = self.first.filter(|_| self.pings > 0) else {
            return Ok(None);
        };
        let (sonar, pings, samples) = (&self.sonar, self.pings, first.samples);
        let elements = element_count(sonar);
        let beams = first.beam_angle_rad.len();
        let lines = &sonar.beams.lines;
        let complex = if self.double { "<c16" } else { "<c8" };

        let mut archive = Archive::create(&self.path)?;
        let grown = self.arrays;
        archive.streamed(
            "iq_by_element",
            complex,
            &[pings, elements, samples],
            grown.iq_by_element,
        )?;
        let element_array: Vec<u8> = (0_i32..)
            .zip(&sonar.receive)
            .flat_map(|(i, array)| std::iter::repeat_n(i, array.elements))
            .flat_map(i32::to_le_bytes)
            .collect();
        archive.small("element_array", "<i4", &[elements], &element_array)?;
        archive.streamed("beams", complex, &[pings, beams, samples], grown.beams)?;
        if self.angles_change {
            let shape = [pings, beams];
            archive.streamed("beam_angle_rad", "<f8", &shape, grown.beam_angle_rad)?;
        } else {
            let angles = first.beam_angle_rad.iter();
            let angles: Vec<u8> = angles.flat_map(|angle| angle.to_le_bytes()).collect();
            archive.small("beam_angle_rad", "<f8", &[beams], &angles)?;
        }
        archive.streamed(
            "lines",
            "<f4",
            &[pings, lines.len(), first.line_samples],
            grown.lines,
        )?;
        let pulses = &sonar.more_pulses;
        if !pulses.is_empty() {
            let shape = [pings, pulses.len(), lines.len(), first.line_samples];
            archive.streamed("more_lines", "<f4", &shape, grown.more_lines)?;
            let delays: Vec<u8> = pulses
                .iter()
                .flat_map(|p| p.delay_s.to_le_bytes())
                .collect();
            archive.small("more_pulse_delay_s", "<f8", &[pulses.len()], &delays)?;
        }
        let sides: Vec<u8> = lines
            .iter()
            .map(|l| match l.side {
                Side::Port => -1_i32,
                Side::Starboard => 1,
            })
            .flat_map(i32::to_le_bytes)
            .collect();
        archive.small("line_side", "<i4", &[lines.len()], &sides)?;
        for (name, value) in [
            ("sample_rate_hz", sonar.receiver.sample_rate_hz),
            ("first_sample_s", first.first_sample_s),
            ("center_frequency_hz", first.center_frequency_hz),
            ("sound_speed_m_per_s", first.sound_speed_m_per_s),
        ] {
            archive.small(name, "<f8", &[], &value.to_le_bytes())?;
        }
        archive.streamed("ping_number", "<i8", &[pings], grown.ping_number)?;
        archive.streamed("ping_utc_ns", "<i8", &[pings], grown.ping_utc_ns)?;
        archive.streamed(
            "transmit_position_m",
            "<f8",
            &[pings, 3],
            grown.transmit_position_m,
        )?;
        archive.streamed(
            "element_position_m",
            "<f8",
            &[pings, elements, 3],
            grown.element_position_m,
        )?;
        archive.streamed(
            "velocity_m_per_s",
            "<f8",
            &[pings, 3],
            grown.velocity_m_per_s,
        )?;
        archive.streamed("position_m", "<f8", &[pings, 3], grown.position_m)?;
        archive.streamed("attitude_deg", "<f8", &[pings, 3], grown.attitude_deg)?;
        archive.streamed("geodetic_deg", "<f8", &[pings, 2], grown.geodetic_deg)?;
        let shape = [pings, lines.len(), 3];
        archive.streamed("line_position_m", "<f8", &shape, grown.line_position_m)?;
        if sounded(sonar) {
            let shape = [pings, beams];
            archive.streamed("sounding_twtt_s", "<f8", &shape, grown.sounding_twtt_s)?;
            archive.streamed("sounding_error_s", "<f8", &shape, grown.sounding_error_s)?;
            archive.streamed("sounding_method", "|u1", &shape, grown.sounding_method)?;
        }
        // NumPy text has four bytes per character. The type descriptor holds the length.
        let text: Vec<u8> = first
            .plan_json
            .chars()
            .flat_map(|c| u32::from(c).to_le_bytes())
            .collect();
        archive.small("plan", &format!("<U{}", text.len() / 4), &[], &text)?;
        archive.finish()?;
        Ok(Some(self.path))
    }
}

/// Whether bottom detection is configured.
fn sounded(sonar: &SonarSpec) -> bool {
    let fan = sonar.beams.fan.as_ref();
    fan.is_some_and(|fan| fan.form.bottom_detection)
}

fn element_count(sonar: &SonarSpec) -> usize {
    sonar.receive.iter().map(|array| array.elements).sum()
}

/// Writes the real and imaginary `parts` of samples in double or single precision.
fn write_samples<T>(
    to: &mut PartialFile,
    bytes: &mut Vec<u8>,
    (iq, parts): (&[T], impl Fn(&T) -> [f64; 2]),
    double: bool,
) -> Result<(), RecordError> {
    if double {
        write_items(to, bytes, iq, |x, out| {
            out.extend(parts(x).map(f64::to_le_bytes).as_flattened());
        })
    } else {
        write_items(to, bytes, iq, |x, out| {
            let parts = parts(x).map(|x| (x as f32).to_le_bytes());
            out.extend(parts.as_flattened());
        })
    }
}

pub(super) fn write_items<T>(
    to: &mut PartialFile,
    bytes: &mut Vec<u8>,
    items: &[T],
    append: impl Fn(&T, &mut Vec<u8>),
) -> Result<(), RecordError> {
    for block in items.chunks(BLOCK) {
        bytes.clear();
        for item in block {
            append(item, bytes);
        }
        to.write(bytes)?;
    }
    Ok(())
}

/// An `.npz` file being assembled.
pub(super) struct Archive {
    path: PathBuf,
    /// Target file, removed unless the archive is finished.
    target: PartialFile,
    zip: ZipWriter<BufWriter<File>>,
}

impl Archive {
    pub(super) fn create(path: &Path) -> Result<Self, RecordError> {
        let target = PartialFile::create(path)?;
        let file = target
            .file
            .get_ref()
            .try_clone()
            .map_err(RecordError::io(&target.partial, "create"))?;
        Ok(Self {
            path: path.to_owned(),
            zip: ZipWriter::new(BufWriter::with_capacity(1 << 18, file)),
            target,
        })
    }

    fn begin(
        &mut self,
        name: &str,
        descr: &str,
        shape: &[usize],
        data_bytes: u64,
    ) -> Result<(), RecordError> {
        let options = SimpleFileOptions::default()
            .compression_method(CompressionMethod::Stored)
            .last_modified_time(DateTime::DEFAULT)
            .unix_permissions(0o644)
            .large_file(data_bytes >= LARGE_BYTES);
        self.zip
            .start_file(format!("{name}.npy"), options)
            .map_err(|e| RecordError::io(&self.target.partial, "write")(e.into()))?;
        self.zip
            .write_all(&npy_header(descr, shape))
            .map_err(RecordError::io(&self.target.partial, "write"))
    }

    pub(super) fn small(
        &mut self,
        name: &str,
        descr: &str,
        shape: &[usize],
        data: &[u8],
    ) -> Result<(), RecordError> {
        self.begin(name, descr, shape, data.len() as u64)?;
        self.zip
            .write_all(data)
            .map_err(RecordError::io(&self.target.partial, "write"))
    }

    /// Copies a streamed array into the archive and removes its file.
    pub(super) fn streamed(
        &mut self,
        name: &str,
        descr: &str,
        shape: &[usize],
        mut from: PartialFile,
    ) -> Result<(), RecordError> {
        from.file
            .flush()
            .map_err(RecordError::io(&from.partial, "write"))?;
        let length = from
            .file
            .seek(SeekFrom::End(0))
            .and_then(|length| from.file.rewind().map(|()| length))
            .map_err(RecordError::io(&from.partial, "read back"))?;
        self.begin(name, descr, shape, length)?;
        let mut source = BufReader::with_capacity(1 << 18, from.file.get_ref());
        let mut block = vec![0; 1 << 18];
        loop {
            let n = source
                .read(&mut block)
                .map_err(RecordError::io(&from.partial, "read back"))?;
            if n == 0 {
                return Ok(());
            }
            self.zip
                .write_all(&block[..n])
                .map_err(RecordError::io(&self.target.partial, "write"))?;
        }
    }

    pub(super) fn finish(self) -> Result<(), RecordError> {
        let mut file = self
            .zip
            .finish()
            .map_err(|e| RecordError::io(&self.target.partial, "write")(e.into()))?;
        file.flush()
            .map_err(RecordError::io(&self.target.partial, "write"))?;
        self.target.keep(&self.path)
    }
}

/// Formats a `.npy` 1.0 header: magic, version, length and a Python literal, padded so that the data begins at a multiple of 64 bytes.
fn npy_header(descr: &str, shape: &[usize]) -> Vec<u8> {
    const PREFIX: usize = 10;
    let shape = match shape {
        [] => "()".to_owned(),
        [one] => format!("({one},)"),
        several => {
            let parts: Vec<_> = several.iter().map(usize::to_string).collect();
            format!("({})", parts.join(", "))
        }
    };
    let mut text = format!("{{'descr': '{descr}', 'fortran_order': False, 'shape': {shape}, }}");
    let padding = 64 - (PREFIX + text.len() + 1) % 64;
    text.extend(std::iter::repeat_n(' ', padding % 64));
    text.push('\n');
    let mut header = b"\x93NUMPY\x01\x00".to_vec();
    header.extend((text.len() as u16).to_le_bytes());
    header.extend(text.as_bytes());
    header
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::io::record::testing::{output, plan, sonar};
    use std::collections::BTreeMap;

    /// A parsed `.npy` file: type, shape, data.
    struct Npy {
        descr: String,
        shape: Vec<usize>,
        data: Vec<u8>,
    }

    impl Npy {
        fn parse(bytes: &[u8]) -> Self {
            assert_eq!(&bytes[..8], b"\x93NUMPY\x01\x00");
            let length = usize::from(u16::from_le_bytes([bytes[8], bytes[9]]));
            assert_eq!((10 + length) % 64, 0, "data are aligned");
            let text = std::str::from_utf8(&bytes[10..10 + length]).expect("ASCII");
            assert!(text.ends_with("}\n") || text.ends_with(" \n"));
            assert!(text.contains("'fortran_order': False"));
            let quoted = |key: &str| {
                let after = &text[text.find(key).expect("key") + key.len()..];
                let from = after.find('\'').expect("quote") + 1;
                after[from..].split('\'').next().expect("text").to_owned()
            };
            let after = &text[text.find("'shape': (").expect("shape") + 10..];
            let shape = after
                .split(')')
                .next()
                .expect("tuple")
                .split(',')
                .filter_map(|n| n.trim().parse().ok())
                .collect();
            Self {
                descr: quoted("'descr':"),
                shape,
                data: bytes[10 + length..].to_vec(),
            }
        }
        fn numbers<const N: usize, T>(&self, from: fn([u8; N]) -> T) -> Vec<T> {
            self.data
                .as_chunks::<N>()
                .0
                .iter()
                .map(|b| from(*b))
                .collect()
        }
        fn f64(&self) -> Vec<f64> {
            assert_eq!(self.descr, "<f8");
            self.numbers(f64::from_le_bytes)
        }
    }

    fn load(path: &Path) -> BTreeMap<String, Npy> {
        let mut zip = zip::ZipArchive::new(File::open(path).expect("file")).expect("zip");
        (0..zip.len())
            .map(|i| {
                let mut member = zip.by_index(i).expect("member");
                assert_eq!(member.compression(), CompressionMethod::Stored);
                let name = member
                    .name()
                    .expect("a name")
                    .trim_end_matches(".npy")
                    .to_owned();
                let mut bytes = Vec::new();
                member.read_to_end(&mut bytes).expect("checksum holds");
                (name, Npy::parse(&bytes))
            })
            .collect()
    }

    fn record(dir: &Path, double: bool) -> PathBuf {
        let mut npz = NpzRecorder::create(dir, &sonar(), double).expect("create");
        for ping in [4, 5, 7] {
            npz.push(&plan(ping), &output(ping)).expect("push");
        }
        npz.finish().expect("finish").expect("pings")
    }

    #[test]
    fn arrays_hold_what_was_pushed_in_the_promised_shapes() {
        let dir = tempfile::tempdir().expect("dir");
        let path = record(dir.path(), false);
        assert_eq!(path, dir.path().join("pings.npz"));
        let a = load(&path);
        let shapes: BTreeMap<_, _> = a
            .iter()
            .map(|(n, y)| (n.as_str(), (y.descr.as_str(), y.shape.as_slice())))
            .collect();
        let s: (usize, usize) = (5, 20);
        for (name, descr, shape) in [
            ("iq_by_element", "<c8", &[3, s.0, s.1][..]),
            ("element_array", "<i4", &[5]),
            ("beams", "<c8", &[3, 3, 20]),
            ("beam_angle_rad", "<f8", &[3]),
            ("lines", "<f4", &[3, 2, 20]),
            ("line_side", "<i4", &[2]),
            ("sample_rate_hz", "<f8", &[]),
            ("first_sample_s", "<f8", &[]),
            ("center_frequency_hz", "<f8", &[]),
            ("sound_speed_m_per_s", "<f8", &[]),
            ("ping_number", "<i8", &[3]),
            ("ping_utc_ns", "<i8", &[3]),
            ("transmit_position_m", "<f8", &[3, 3]),
            ("element_position_m", "<f8", &[3, 5, 3]),
            ("velocity_m_per_s", "<f8", &[3, 3]),
            ("position_m", "<f8", &[3, 3]),
            ("attitude_deg", "<f8", &[3, 3]),
            ("geodetic_deg", "<f8", &[3, 2]),
            ("line_position_m", "<f8", &[3, 2, 3]),
        ] {
            assert_eq!(shapes.get(name), Some(&(descr, shape)), "{name}");
        }
        assert_eq!(a.len(), 20, "and the plan");

        let iq = a["iq_by_element"].numbers(f32::from_le_bytes);
        for (p, ping) in [4, 5, 7].into_iter().enumerate() {
            let out = output(ping);
            let want = out.elements.iter().flat_map(|f| &f.iq);
            for (i, x) in want.enumerate() {
                let got = &iq[2 * (p * 100 + i)..][..2];
                assert_eq!(got, [x.re as f32, x.im as f32], "ping {ping} value {i}");
            }
        }
        assert_eq!(
            a["element_array"].numbers(i32::from_le_bytes),
            [0, 0, 1, 1, 1]
        );
        assert_eq!(a["line_side"].numbers(i32::from_le_bytes), [-1, 1]);
        assert_eq!(a["ping_number"].numbers(i64::from_le_bytes), [4, 5, 7]);
        assert_eq!(
            a["ping_utc_ns"].numbers(i64::from_le_bytes)[2],
            plan(7).transmit_utc.0
        );
        assert_eq!(a["sample_rate_hz"].f64(), [40e3]);
        assert_eq!(a["beam_angle_rad"].f64(), output(4).beams[0].angle_rad);
        assert_eq!(
            a["lines"].numbers(f32::from_le_bytes)[20..40],
            output(4).lines[1].amplitude
        );
    }

    #[test]
    fn beam_angles_are_stored_for_every_ping_where_they_change() {
        let dir = tempfile::tempdir().expect("dir");
        let mut npz = NpzRecorder::create(dir.path(), &sonar(), false).expect("create");
        let mut want = Vec::new();
        for ping in [4, 5, 7] {
            let mut output = output(ping);
            for angle_rad in &mut output.beams[0].angle_rad {
                *angle_rad += 0.01 * f64::from(ping);
            }
            want.extend(output.beams[0].angle_rad.iter().copied());
            npz.push(&plan(ping), &output).expect("push");
        }
        let a = load(&npz.finish().expect("finish").expect("pings"));
        assert_eq!(a["beam_angle_rad"].shape, [3, 3]);
        assert_eq!(a["beam_angle_rad"].f64(), want);
    }

    #[test]
    fn positions_are_world_positions_at_the_start_of_the_pulse() {
        let dir = tempfile::tempdir().expect("dir");
        let a = load(&record(dir.path(), false));
        let (plan, sonar) = (plan(5), sonar());
        let pose = plan.trajectory.pose_at(0.0);
        let transmit = &a["transmit_position_m"].f64()[3..6];
        assert_eq!(
            transmit,
            pose.point_m(sonar.transmit[0].mounting.position_m)
                .to_array()
        );
        let element = &a["element_position_m"].f64()[15 + 3 * 4..15 + 3 * 5];
        assert_eq!(
            element,
            pose.point_m(sonar.receive[1].element_body_m(2)).to_array()
        );
        assert_eq!(
            a["velocity_m_per_s"].f64()[3..6],
            pose.velocity_m_per_s.to_array()
        );
    }

    #[test]
    fn plan_is_json_text_that_says_what_an_outside_calculation_needs() {
        let dir = tempfile::tempdir().expect("dir");
        let a = load(&record(dir.path(), false));
        let text = &a["plan"];
        assert_eq!(text.descr, format!("<U{}", text.data.len() / 4));
        assert!(text.shape.is_empty());
        let json: String = text
            .numbers(u32::from_le_bytes)
            .into_iter()
            .filter_map(char::from_u32)
            .collect();
        let plan: serde_json::Value = serde_json::from_str(&json).expect("JSON");
        assert_eq!(plan["sonar"], sonar().name.as_str());
        assert_eq!(plan["plan"]["pulse"]["kind"], "lfm-up");
        assert_eq!(plan["plan"]["sample_count"], 20);
        assert_eq!(plan["receive"][1]["elements"], 3);
        assert_eq!(plan["receiver"]["sample_rate_hz"], 40e3);
    }

    #[test]
    fn double_precision_keeps_every_bit() {
        let dir = tempfile::tempdir().expect("dir");
        let a = load(&record(dir.path(), true));
        assert_eq!(a["iq_by_element"].descr, "<c16");
        let iq = a["iq_by_element"].numbers(f64::from_le_bytes);
        let want = output(4).elements[1].iq[7];
        assert_eq!(iq[2 * (40 + 7)..][..2], [want.re, want.im]);
    }

    #[test]
    fn equal_pings_make_equal_bytes_and_leave_no_other_file() {
        let (one, two) = (
            tempfile::tempdir().expect("dir"),
            tempfile::tempdir().expect("dir"),
        );
        let first = std::fs::read(record(one.path(), false)).expect("read");
        let second = std::fs::read(record(two.path(), false)).expect("read");
        assert!(first == second, "repetition gives other bytes");
        let left: Vec<_> = std::fs::read_dir(one.path()).expect("dir").collect();
        assert_eq!(left.len(), 1, "{left:?}");
    }

    #[test]
    fn another_range_is_refused_with_the_rule_and_the_file_stays_good() {
        let dir = tempfile::tempdir().expect("dir");
        let mut npz = NpzRecorder::create(dir.path(), &sonar(), false).expect("create");
        npz.push(&plan(1), &output(1)).expect("push");
        let mut longer = plan(2);
        longer.sample_count = 21;
        let error = npz.push(&longer, &output(2)).expect_err("another shape");
        let text = error.to_string();
        assert!(
            text.contains("pings.npz")
                && text.contains("ping 2 has 21 samples, the first had 20")
                && text.contains("keep range"),
            "{text}"
        );
        npz.push(&plan(3), &output(3)).expect("goes on");
        let a = load(&npz.finish().expect("finish").expect("pings"));
        assert_eq!(a["ping_number"].numbers(i64::from_le_bytes), [1, 3]);
    }

    #[test]
    fn without_pings_there_is_no_file_and_nothing_is_left() {
        let dir = tempfile::tempdir().expect("dir");
        let npz = NpzRecorder::create(dir.path(), &sonar(), false).expect("create");
        assert!(npz.finish().expect("finish").is_none());
        let mut dropped = NpzRecorder::create(dir.path(), &sonar(), false).expect("create");
        dropped.push(&plan(1), &output(1)).expect("push");
        drop(dropped);
        assert_eq!(std::fs::read_dir(dir.path()).expect("dir").count(), 0);
    }

    #[cfg(target_os = "linux")]
    #[test]
    fn a_full_disk_is_an_error_that_names_the_file_wherever_it_strikes() {
        for full in ["pings.npz.iq_by_element.partial", "pings.npz.partial"] {
            let dir = tempfile::tempdir().expect("dir");
            std::os::unix::fs::symlink("/dev/full", dir.path().join(full)).expect("link");
            let mut npz = NpzRecorder::create(dir.path(), &sonar(), false).expect("create");
            npz.push(&plan(1), &output(1)).expect("still in memory");
            let text = npz.finish().expect_err("full disk").to_string();
            assert!(
                text.contains(full) && text.contains("cannot write"),
                "{text}"
            );
            assert!(text.contains("No space left"), "{text}");
            let left = std::fs::read_dir(dir.path()).expect("dir").count();
            assert_eq!(left, 0, "nothing half-made is left");
        }
    }

    #[cfg(target_os = "linux")]
    #[test]
    fn after_a_full_disk_no_more_pings_are_taken() {
        let dir = tempfile::tempdir().expect("dir");
        let full = dir.path().join("pings.npz.lines.partial");
        std::os::unix::fs::symlink("/dev/full", &full).expect("link");
        let mut npz = NpzRecorder::create(dir.path(), &sonar(), false).expect("create");
        // Small writes stay in the buffer, so only a later ping reaches the disk.
        let failed = (1..10_000).find_map(|ping| npz.push(&plan(ping), &output(ping)).err());
        let text = failed.expect("full disk").to_string();
        assert!(text.contains("lines.partial: cannot write"), "{text}");
        let error = npz.push(&plan(1), &output(1)).expect_err("stopped");
        assert!(matches!(error, RecordError::Stopped { .. }), "{error}");
        assert!(matches!(npz.finish(), Err(RecordError::Stopped { .. })));
    }

    #[test]
    fn a_missing_folder_is_an_error_that_names_the_file() {
        let Err(error) = NpzRecorder::create(Path::new("/no/such/folder"), &sonar(), false) else {
            panic!("a file in no folder");
        };
        let text = error.to_string();
        assert!(text.starts_with("/no/such/folder/pings.npz."), "{text}");
        assert!(text.contains("cannot create"), "{text}");
    }
}

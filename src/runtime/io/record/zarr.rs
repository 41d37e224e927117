//! `pings.zarr`: the arrays of `pings.npz` as a Zarr store (format 3), a folder that xarray opens as one data set.
//!
//! The first dimension of the arrays is `ping`. Large arrays ([`SAMPLES`]) have one chunk for each ping, so that a reader loads the pings that it needs.
//! All others have one chunk, which grows by a row for each ping. Chunks are not compressed, so a chunk holds the little-endian values and nothing else,
//! and stores of successive pings are joined by renaming chunks ([`join`]).
//!
//! The store grows in a folder with the suffix `.partial` and appears when it is complete. It is written with the metadata by itself rather than by the
//! crate `zarrs`, whose codecs, caches and array views no part of this needs.
//!
//! Layout: Zarr core specification, version 3.0; names of dimensions and units as xarray reads them (CF Metadata Conventions 1.11).

use std::fs::File;
use std::io::Write;
use std::path::{Path, PathBuf};

use num_complex::{Complex32, Complex64};
use serde_json::{Map, Value, json};

use super::masks::SampleLabels;
use super::{RecordError, make_folder, plan_text};
use echotank_config::spec::SonarSpec;
use echotank_core::frames::angles_from_rotation;
use echotank_core::ping::{Detection, LineTruth, PingOutput, PingPlan, Side};

/// Arrays with one chunk for each ping.
const SAMPLES: [&str; 10] = [
    "elements",
    "beams",
    "lines",
    "more_lines",
    "line_target",
    "line_shadow",
    "line_depth_m",
    "beam_target",
    "beam_shadow",
    "beam_depth_m",
];
/// Arrays that label the dimensions, besides those named after their dimension.
const COORDINATES: [&str; 8] = [
    "time",
    "latitude_deg",
    "longitude_deg",
    "element_array",
    "sample_time_s",
    "line_side",
    "line_time_s",
    "more_pulse_delay_s",
];
/// File of the metadata of a group or an array.
const METADATA: &str = "zarr.json";

/// Type of the values of an array.
#[derive(Clone, Copy)]
enum DataType {
    U8,
    U16,
    I32,
    I64,
    F32,
    F64,
    C64,
    C128,
}

impl DataType {
    fn name(self) -> &'static str {
        match self {
            Self::U8 => "uint8",
            Self::U16 => "uint16",
            Self::I32 => "int32",
            Self::I64 => "int64",
            Self::F32 => "float32",
            Self::F64 => "float64",
            Self::C64 => "complex64",
            Self::C128 => "complex128",
        }
    }

    /// Value of chunks that are absent.
    fn fill(self) -> Value {
        match self {
            Self::U8 | Self::U16 | Self::I32 | Self::I64 => json!(0),
            Self::F32 | Self::F64 => json!("NaN"),
            Self::C64 | Self::C128 => json!(["NaN", "NaN"]),
        }
    }
}

/// The values of an array that one ping adds, or all values of an array without the dimension `ping`.
struct Rows {
    name: &'static str,
    data_type: DataType,
    /// Dimensions and their lengths. In an array of pings, `ping` precedes them.
    dims: Vec<(&'static str, usize)>,
    is_of_pings: bool,
    /// Unit, or empty.
    unit: &'static str,
    about: &'static str,
    bytes: Vec<u8>,
}

impl Rows {
    /// Metadata of the array with so many pings.
    fn metadata(&self, pings: usize) -> Value {
        let ping = self.is_of_pings.then_some(("ping", pings));
        let dims: Vec<_> = ping.into_iter().chain(self.dims.iter().copied()).collect();
        let shape: Vec<usize> = dims.iter().map(|(_, length)| *length).collect();
        let mut chunk = shape.clone();
        if SAMPLES.contains(&self.name) {
            chunk[0] = 1;
        }
        let mut attributes = json!({ "long_name": self.about });
        if !self.unit.is_empty() {
            attributes["units"] = self.unit.into();
        }
        json!({
            "zarr_format": 3,
            "node_type": "array",
            "shape": shape,
            "data_type": self.data_type.name(),
            "chunk_grid": { "name": "regular", "configuration": { "chunk_shape": chunk } },
            "chunk_key_encoding": { "name": "default", "configuration": { "separator": "/" } },
            "codecs": [{ "name": "bytes", "configuration": { "endian": "little" } }],
            "fill_value": self.data_type.fill(),
            "attributes": attributes,
            "dimension_names": dims.iter().map(|(name, _)| *name).collect::<Vec<_>>(),
        })
    }
}

/// Path of a chunk in the folder of its array: a part for each dimension, the first of which is `first`.
fn chunk_path(array: &Path, dims: usize, first: usize) -> PathBuf {
    let mut path = array.join("c").join(first.to_string());
    path.extend(std::iter::repeat_n("0", dims - 1));
    path
}

/// Recorder of `pings.zarr` for one sonar.
pub(crate) struct ZarrRecorder {
    path: PathBuf,
    partial: PathBuf,
    sonar: SonarSpec,
    double: bool,
    first: Option<First>,
    pings: usize,
    is_stopped: bool,
    is_kept: bool,
}

/// What the first ping fixes: its arrays, the files of those that grow, and the attributes of the store.
struct First {
    rows: Vec<Rows>,
    grown: Vec<Option<File>>,
    attributes: Map<String, Value>,
}

impl ZarrRecorder {
    /// Creates `dir/pings.zarr.partial`; `dir` must exist. `double` selects complex128 element samples. Each sonar needs its own folder.
    pub(crate) fn create(dir: &Path, sonar: &SonarSpec, double: bool) -> Result<Self, RecordError> {
        let partial = dir.join("pings.zarr.partial");
        // An interrupted replay leaves its folder.
        remove_store(&partial)?;
        make_folder(&partial)?;
        Ok(Self {
            path: dir.join("pings.zarr"),
            partial,
            sonar: sonar.clone(),
            double,
            first: None,
            pings: 0,
            is_stopped: false,
            is_kept: false,
        })
    }

    /// Adds a ping, with the labels of its side-scan lines and beams if there are any. Recording continues after [`RecordError::ShapeChanged`] and
    /// stops after any other error.
    pub(crate) fn push(
        &mut self,
        plan: &PingPlan,
        output: &PingOutput,
        (lines, beams): (&[LineTruth], &[LineTruth]),
    ) -> Result<(), RecordError> {
        if self.is_stopped {
            return Err(RecordError::Stopped {
                path: self.path.clone(),
            });
        }
        let mut rows = samples_of(&self.sonar, output, self.double);
        rows.extend(labels_of("line", lines));
        rows.extend(labels_of("beam", beams));
        rows.extend(geometry_of(&self.sonar, plan));
        rows.extend(soundings_of(&self.sonar, output));
        self.check_shape(plan, &rows)?;
        let written = self.write(plan, output, rows);
        match written {
            Ok(()) => self.pings += 1,
            Err(_) => self.is_stopped = true,
        }
        written
    }

    /// Refuses a ping whose arrays have another length than those of the first.
    fn check_shape(&self, plan: &PingPlan, rows: &[Rows]) -> Result<(), RecordError> {
        let Some(first) = &self.first else {
            return Ok(());
        };
        let dims = first.rows.iter().zip(rows);
        let mut dims = dims.flat_map(|(want, got)| want.dims.iter().zip(&got.dims));
        match dims.find(|(want, got)| want != got) {
            None => Ok(()),
            Some(((_, want), (dim, got))) => Err(RecordError::ShapeChanged {
                path: self.path.clone(),
                ping_number: plan.ping_number,
                what: match *dim {
                    "element" => "elements",
                    "beam" => "beams",
                    "sample" => "samples",
                    "line_sample" => "line samples",
                    _ => "lines",
                },
                got: *got,
                want: *want,
            }),
        }
    }

    fn write(
        &mut self,
        plan: &PingPlan,
        output: &PingOutput,
        mut rows: Vec<Rows>,
    ) -> Result<(), RecordError> {
        let is_first = self.first.is_none();
        if is_first {
            rows.extend(fixed_of(&self.sonar, plan, output));
        }
        let mut grown: Vec<Option<File>> = Vec::new();
        for (at, row) in rows.iter().enumerate() {
            let array = self.partial.join(row.name);
            let is_chunk = SAMPLES.contains(&row.name);
            let dims = row.dims.len() + usize::from(row.is_of_pings);
            let path = chunk_path(&array, dims, if is_chunk { self.pings } else { 0 });
            let write = |file: &mut File| {
                file.write_all(&row.bytes)
                    .map_err(RecordError::io(&path, "write"))
            };
            if is_chunk || is_first {
                make_folder(path.parent().unwrap_or(&array))?;
                let mut file = File::create(&path).map_err(RecordError::io(&path, "create"))?;
                write(&mut file)?;
                grown.push((!is_chunk).then_some(file));
            } else if let Some(file) = self.first.as_mut().and_then(|f| f.grown[at].as_mut()) {
                write(file)?;
            }
        }
        if is_first {
            for row in &mut rows {
                row.bytes = Vec::new();
            }
            self.first = Some(First {
                rows,
                grown,
                attributes: attributes_of(&self.sonar, plan),
            });
        }
        Ok(())
    }

    /// Writes the metadata and returns the path of the store; `None` without pings.
    pub(crate) fn finish(mut self) -> Result<Option<PathBuf>, RecordError> {
        if self.is_stopped {
            return Err(RecordError::Stopped {
                path: self.path.clone(),
            });
        }
        let Some(First {
            rows,
            mut attributes,
            ..
        }) = self.first.take()
        else {
            return Ok(None);
        };
        let arrays = rows.iter().map(|row| {
            let mut metadata = row.metadata(self.pings);
            let attributes = &mut metadata["attributes"];
            match row.name {
                "element_array" => attributes["names"] = json!(self.sonar.receive_names),
                "time" => attributes["calendar"] = json!("proleptic_gregorian"),
                _ => {}
            }
            (row.name.to_owned(), metadata)
        });
        let arrays: Map<String, Value> = arrays.collect();
        let coordinates = COORDINATES
            .iter()
            .filter(|name| arrays.contains_key(**name));
        let coordinates: Vec<_> = coordinates.copied().collect();
        attributes.insert("coordinates".into(), coordinates.join(" ").into());
        write_metadata(&self.partial, attributes, arrays)?;
        keep(&self.partial, &self.path)?;
        self.is_kept = true;
        Ok(Some(self.path.clone()))
    }
}

impl Drop for ZarrRecorder {
    fn drop(&mut self) {
        if !self.is_kept {
            // Errors are ignored: the suffix marks a folder that remains.
            let _ = remove_store(&self.partial);
        }
    }
}

/// Removes a store or the folder of an incomplete one, if it exists.
fn remove_store(path: &Path) -> Result<(), RecordError> {
    match path.is_dir() {
        true => std::fs::remove_dir_all(path).map_err(RecordError::io(path, "remove")),
        false => Ok(()),
    }
}

/// Renames a complete store to its final name. An existing store is replaced; another folder of this name is not.
fn keep(partial: &Path, path: &Path) -> Result<(), RecordError> {
    if path.join(METADATA).is_file() {
        remove_store(path)?;
    }
    std::fs::rename(partial, path).map_err(RecordError::io(path, "rename to"))
}

/// Writes the metadata of each array, and that of the group with a copy of all of them, which saves readers of a remote store a request for each.
fn write_metadata(
    store: &Path,
    attributes: Map<String, Value>,
    arrays: Map<String, Value>,
) -> Result<(), RecordError> {
    let write = |path: PathBuf, value: &Value| {
        std::fs::write(&path, format!("{value:#}\n")).map_err(RecordError::io(&path, "write"))
    };
    for (name, metadata) in &arrays {
        write(store.join(name).join(METADATA), metadata)?;
    }
    let group = json!({
        "zarr_format": 3,
        "node_type": "group",
        "attributes": attributes,
        "consolidated_metadata": { "kind": "inline", "must_understand": false, "metadata": arrays },
    });
    write(store.join(METADATA), &group)
}

fn attributes_of(sonar: &SonarSpec, plan: &PingPlan) -> Map<String, Value> {
    let attributes = json!({
        "Conventions": "CF-1.11",
        "source": "simulated by Echotank",
        "version": env!("CARGO_PKG_VERSION"),
        "sonar": sonar.name,
        "sample_rate_hz": sonar.receiver.sample_rate_hz,
        "first_sample_s": plan.first_sample_s,
        "center_frequency_hz": plan.pulse.center_frequency_hz,
        "sound_speed_m_per_s": plan.sound_speed_m_per_s,
        "plan": plan_text::sonar_and_plan(sonar, plan).to_string(),
    });
    match attributes {
        Value::Object(attributes) => attributes,
        _ => Map::new(),
    }
}

fn f64_bytes(values: impl IntoIterator<Item = f64>) -> Vec<u8> {
    values.into_iter().flat_map(f64::to_le_bytes).collect()
}

fn f32_bytes(values: impl IntoIterator<Item = f32>) -> Vec<u8> {
    values.into_iter().flat_map(f32::to_le_bytes).collect()
}

/// Elements, beams and side-scan lines.
fn samples_of(sonar: &SonarSpec, output: &PingOutput, double: bool) -> Vec<Rows> {
    let mut rows = Vec::new();
    let mut add = |name, data_type, dims, about, bytes| {
        rows.push(Rows {
            name,
            data_type,
            dims,
            is_of_pings: true,
            unit: "V",
            about,
            bytes,
        });
    };
    if let Some(frame) = output.elements.first() {
        let elements = output.elements.iter().map(|frame| frame.elements).sum();
        let parts = output.elements.iter().flat_map(|frame| &frame.iq);
        let parts = parts.flat_map(|Complex64 { re, im }| [*re, *im]);
        let (data_type, bytes) = match double {
            true => (DataType::C128, f64_bytes(parts)),
            false => (DataType::C64, f32_bytes(parts.map(|x| x as f32))),
        };
        let about = "envelope of each element, volts rms; elements of all receive arrays in order";
        let dims = vec![("element", elements), ("sample", frame.samples)];
        add("elements", data_type, dims, about, bytes);
    }
    if let Some(fan) = output.beams.first() {
        let parts = fan.iq.iter().flat_map(|Complex32 { re, im }| [*re, *im]);
        let dims = vec![("beam", fan.beams), ("sample", fan.samples)];
        let about = "beams of the fan after the matched filter, volts rms";
        add("beams", DataType::C64, dims, about, f32_bytes(parts));
    }
    let line_samples = output.lines.first().map_or(0, |line| line.amplitude.len());
    if line_samples > 0 {
        let values = output.lines.iter().flat_map(|line| &line.amplitude);
        let dims = vec![("line", output.lines.len()), ("line_sample", line_samples)];
        let about = "side-scan lines, volts rms; sample 0 is the start of the pulse";
        let bytes = f32_bytes(values.copied());
        add("lines", DataType::F32, dims, about, bytes);
    }
    if !sonar.more_pulses.is_empty() && line_samples > 0 {
        // The lines of a later pulse are shorter.
        let lines = output.more_lines.iter().flat_map(|more| &more.lines);
        let values = lines.flat_map(|line| {
            (0..line_samples).map(|k| line.amplitude.get(k).copied().unwrap_or(f32::NAN))
        });
        let dims = vec![
            ("pulse", sonar.more_pulses.len()),
            ("line", output.lines.len()),
            ("line_sample", line_samples),
        ];
        let about = "side-scan lines of each further pulse, volts rms; padded with NaN";
        add("more_lines", DataType::F32, dims, about, f32_bytes(values));
    }
    rows
}

/// Labels of the samples of lines or beams; none without truths.
fn labels_of(of: &'static str, truths: &[LineTruth]) -> Vec<Rows> {
    let Some(samples) = truths.first().map(|truth| truth.target.len()) else {
        return Vec::new();
    };
    let labels: Vec<_> = truths.iter().map(SampleLabels::of).collect();
    let target = labels.iter().flat_map(|label| &label.target);
    let (names, sample) = match of {
        "line" => (
            ["line_target", "line_shadow", "line_depth_m"],
            "line_sample",
        ),
        _ => (["beam_target", "beam_shadow", "beam_depth_m"], "sample"),
    };
    let rows = |name, data_type, unit, about, bytes| Rows {
        name,
        data_type,
        dims: vec![(of, labels.len()), (sample, samples)],
        is_of_pings: true,
        unit,
        about,
        bytes,
    };
    let [target_name, shadow_name, depth_name] = names;
    vec![
        rows(
            target_name,
            DataType::U16,
            "",
            "target with more echo energy than all others; 1 is the first of the scene, 0 none",
            target.flat_map(|t| t.to_le_bytes()).collect(),
        ),
        rows(
            shadow_name,
            DataType::U8,
            "",
            "1 where the ground on the axis lies in shadow and no target is labelled",
            labels
                .iter()
                .flat_map(|label| label.shadow.clone())
                .collect(),
        ),
        rows(
            depth_name,
            DataType::F32,
            "m",
            "depth of the ground on the axis",
            f32_bytes(labels.iter().flat_map(|label| label.depth_m.clone())),
        ),
    ]
}

/// Number, time and pose of a ping, at the start of the pulse.
fn geometry_of(sonar: &SonarSpec, plan: &PingPlan) -> Vec<Rows> {
    let rows = |name, data_type, dims, unit, about, bytes| Rows {
        name,
        data_type,
        dims,
        is_of_pings: true,
        unit,
        about,
        bytes,
    };
    let number = i64::from(plan.ping_number).to_le_bytes().to_vec();
    let utc_ns = plan.transmit_utc.0.to_le_bytes().to_vec();
    let since = "nanoseconds since 1970-01-01";
    let mut all = vec![
        rows(
            "ping",
            DataType::I64,
            vec![],
            "",
            "number of the ping",
            number,
        ),
        rows(
            "time",
            DataType::I64,
            vec![],
            since,
            "start of the pulse, UTC",
            utc_ns,
        ),
    ];
    let pose = plan.trajectory.pose_at(0.0);
    let (roll, pitch, heading) = angles_from_rotation(pose.world_from_body);
    for (name, unit, about, angle_rad) in [
        ("roll_deg", "degree", "roll, positive starboard down", roll),
        ("pitch_deg", "degree", "pitch, positive bow up", pitch),
        ("heading_deg", "degree", "heading from true north", heading),
        (
            "latitude_deg",
            "degrees_north",
            "WGS84 latitude of the reference point",
            plan.nav.latitude_rad,
        ),
        (
            "longitude_deg",
            "degrees_east",
            "WGS84 longitude of the reference point",
            plan.nav.longitude_rad,
        ),
    ] {
        let bytes = f64_bytes([angle_rad.to_degrees()]);
        all.push(rows(name, DataType::F64, vec![], unit, about, bytes));
    }
    let transmit = sonar.transmit.first();
    let transmit = transmit.map_or(glam::DVec3::ZERO, |array| array.mounting.position_m);
    for (name, unit, about, vector) in [
        (
            "position_m",
            "m",
            "reference point: north, east, down",
            pose.position_m,
        ),
        (
            "velocity_m_per_s",
            "m s-1",
            "velocity of the reference point: north, east, down",
            pose.velocity_m_per_s,
        ),
        (
            "transmit_position_m",
            "m",
            "first transmit array: north, east, down",
            pose.point_m(transmit),
        ),
    ] {
        let bytes = f64_bytes(vector.to_array());
        all.push(rows(
            name,
            DataType::F64,
            vec![("axis", 3)],
            unit,
            about,
            bytes,
        ));
    }
    let elements = sonar.receive.iter().flat_map(|array| {
        (0..array.elements).flat_map(move |e| pose.point_m(array.element_body_m(e)).to_array())
    });
    let bytes = f64_bytes(elements);
    all.push(rows(
        "element_position_m",
        DataType::F64,
        vec![("element", bytes.len() / 24), ("axis", 3)],
        "m",
        "each element: north, east, down",
        bytes,
    ));
    if !sonar.beams.lines.is_empty() {
        let lines = sonar.beams.lines.iter().flat_map(|line| {
            let array = sonar.receive[line.array].transmit;
            let mounting = &sonar.transmit[array].mounting;
            pose.point_m(mounting.position_m).to_array()
        });
        all.push(rows(
            "line_position_m",
            DataType::F64,
            vec![("line", sonar.beams.lines.len()), ("axis", 3)],
            "m",
            "transmit array of each line: north, east, down",
            f64_bytes(lines),
        ));
    }
    all
}

/// Angles and bottom detections of the beams, padded with NaN; none without a fan.
fn soundings_of(sonar: &SonarSpec, output: &PingOutput) -> Vec<Rows> {
    let (Some(fan), Some(spec)) = (output.beams.first(), &sonar.beams.fan) else {
        return Vec::new();
    };
    let rows = |name, data_type, unit, about, bytes| Rows {
        name,
        data_type,
        dims: vec![("beam", fan.beams)],
        is_of_pings: true,
        unit,
        about,
        bytes,
    };
    let angles = f64_bytes(fan.angle_rad.iter().copied());
    let about = "angle from the boresight, positive to starboard";
    let mut all = vec![rows("beam_angle_rad", DataType::F64, "rad", about, angles)];
    if spec.form.bottom_detection {
        let found = |beam| output.soundings.iter().find(move |s| s.beam == beam);
        let column = |of: fn(&echotank_core::ping::Sounding) -> f64| {
            f64_bytes((0..fan.beams).map(|beam| found(beam).map_or(f64::NAN, of)))
        };
        let about = "two-way time of the bottom, NaN without detection";
        let twtt_s = column(|s| s.twtt_s);
        all.push(rows("sounding_twtt_s", DataType::F64, "s", about, twtt_s));
        let about = "predicted standard deviation of sounding_twtt_s";
        let error_s = column(|s| s.error_s);
        all.push(rows("sounding_error_s", DataType::F64, "s", about, error_s));
        let about = "level of the bottom echo, volts rms";
        let level_v = column(|s| s.level_v);
        all.push(rows("sounding_level_v", DataType::F64, "V", about, level_v));
        let method = (0..fan.beams).map(|beam| match found(beam).map(|s| s.detection) {
            None => 0,
            Some(Detection::Amplitude) => 1,
            Some(Detection::Phase) => 2,
        });
        let about = "method of the detection: 0 none, 1 amplitude, 2 phase";
        all.push(rows(
            "sounding_method",
            DataType::U8,
            "",
            about,
            method.collect(),
        ));
    }
    all
}

/// Labels of the dimensions, which do not depend on the ping.
fn fixed_of(sonar: &SonarSpec, plan: &PingPlan, output: &PingOutput) -> Vec<Rows> {
    let rows = |name, data_type, dim, length, unit, about, bytes| Rows {
        name,
        data_type,
        dims: vec![(dim, length)],
        is_of_pings: false,
        unit,
        about,
        bytes,
    };
    let i32_bytes = |values: &[i32]| values.iter().flat_map(|v| v.to_le_bytes()).collect();
    let rate_hz = sonar.receiver.sample_rate_hz;
    let mut all = Vec::new();
    let arrays: Vec<i32> = (0_i32..)
        .zip(&sonar.receive)
        .flat_map(|(index, array)| std::iter::repeat_n(index, array.elements))
        .collect();
    all.push(rows(
        "element_array",
        DataType::I32,
        "element",
        arrays.len(),
        "",
        "receive array of each element, an index of names",
        i32_bytes(&arrays),
    ));
    let times = (0..plan.sample_count).map(|k| plan.first_sample_s + k as f64 / rate_hz);
    all.push(rows(
        "sample_time_s",
        DataType::F64,
        "sample",
        plan.sample_count,
        "s",
        "time of each sample after the start of the pulse",
        f64_bytes(times),
    ));
    if let Some(line) = output.lines.first() {
        let sides = sonar.beams.lines.iter().map(|line| match line.side {
            Side::Port => -1,
            Side::Starboard => 1,
        });
        let sides: Vec<i32> = sides.collect();
        all.push(rows(
            "line_side",
            DataType::I32,
            "line",
            sides.len(),
            "",
            "side of each line: -1 port, 1 starboard",
            i32_bytes(&sides),
        ));
        let samples = line.amplitude.len();
        all.push(rows(
            "line_time_s",
            DataType::F64,
            "line_sample",
            samples,
            "s",
            "time of each sample of a line after the start of the pulse",
            f64_bytes((0..samples).map(|k| k as f64 / rate_hz)),
        ));
        if !sonar.more_pulses.is_empty() {
            all.push(rows(
                "more_pulse_delay_s",
                DataType::F64,
                "pulse",
                sonar.more_pulses.len(),
                "s",
                "delay of each further pulse after the first",
                f64_bytes(sonar.more_pulses.iter().map(|pulse| pulse.delay_s)),
            ));
        }
    }
    all
}

/// Joins stores of successive pings of one sonar to the store that one recorder would have written of all of them, byte for byte. Returns the paths of
/// its files, relative to the store.
///
/// # Errors
/// A part cannot be read, or its arrays do not fit those of the first; the target cannot be written.
pub(crate) fn join(parts: &[&Path], target: &Path) -> Result<Vec<PathBuf>, RecordError> {
    let Some(first) = parts.first() else {
        return Ok(Vec::new());
    };
    let groups = parts.iter().map(|part| group_of(part));
    let groups = groups.collect::<Result<Vec<_>, _>>()?;
    let partial = target.with_extension("zarr.partial");
    remove_store(&partial)?;
    let (attributes, mut arrays) = groups[0].clone();
    let mut files = vec![PathBuf::from(METADATA)];
    for (name, metadata) in &mut arrays {
        files.push(Path::new(name).join(METADATA));
        let mut pings = 0;
        for (part, (_, arrays)) in parts.iter().zip(&groups) {
            let other = arrays.get(name).map_or(&Value::Null, |array| array);
            let rows = shape_of(other).first().copied().unwrap_or(0);
            let dims = shape_of(other).len();
            if dims == 0 || without_pings(other) != without_pings(metadata) {
                let why = format!(
                    "{name}: has another shape or type than in {}",
                    first.display()
                );
                return Err(unfit(part, why));
            }
            let is_chunk = SAMPLES.contains(&name.as_str());
            for row in 0..if is_chunk { rows } else { 1 } {
                let from = chunk_path(&part.join(name), dims, row);
                let inner = chunk_path(
                    Path::new(name),
                    dims,
                    if is_chunk { pings + row } else { 0 },
                );
                let to = partial.join(&inner);
                make_folder(to.parent().unwrap_or(&partial))?;
                if is_chunk {
                    std::fs::copy(&from, &to).map_err(RecordError::io(&from, "copy"))?;
                } else if is_of_pings(other) || *part == *first {
                    let bytes = std::fs::read(&from).map_err(RecordError::io(&from, "read"))?;
                    let file = File::options().create(true).append(true).open(&to);
                    file.and_then(|mut file| file.write_all(&bytes))
                        .map_err(RecordError::io(&to, "write"))?;
                }
                if is_chunk || *part == *first {
                    files.push(inner);
                }
            }
            pings += rows;
        }
        if is_of_pings(metadata) {
            metadata["shape"][0] = pings.into();
            if !SAMPLES.contains(&name.as_str()) {
                metadata["chunk_grid"]["configuration"]["chunk_shape"][0] = pings.into();
            }
        }
    }
    write_metadata(&partial, attributes, arrays)?;
    keep(&partial, target)?;
    Ok(files)
}

type Group = (Map<String, Value>, Map<String, Value>);

/// Attributes of a store, and the metadata of its arrays.
fn group_of(store: &Path) -> Result<Group, RecordError> {
    let path = store.join(METADATA);
    let text = std::fs::read_to_string(&path).map_err(RecordError::io(&path, "read"))?;
    let group: Value = serde_json::from_str(&text).map_err(|why| unfit(&path, why.to_string()))?;
    let arrays = &group["consolidated_metadata"]["metadata"];
    match (group["attributes"].as_object(), arrays.as_object()) {
        (Some(attributes), Some(arrays)) => Ok((attributes.clone(), arrays.clone())),
        _ => Err(unfit(&path, "is not of this program".into())),
    }
}

fn unfit(path: &Path, why: String) -> RecordError {
    RecordError::io(path, "join")(std::io::Error::other(why))
}

fn is_of_pings(array: &Value) -> bool {
    array["dimension_names"][0] == "ping"
}

fn shape_of(array: &Value) -> Vec<usize> {
    let shape = array["shape"].as_array();
    let lengths = shape.into_iter().flatten().filter_map(Value::as_u64);
    lengths.map(|length| length as usize).collect()
}

/// Metadata of an array but for the number of pings.
fn without_pings(array: &Value) -> Value {
    let mut array = array.clone();
    if is_of_pings(&array) {
        array["shape"][0] = Value::Null;
        array["chunk_grid"] = Value::Null;
    }
    array
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::io::record::testing::{output, plan, sonar};
    use std::collections::BTreeMap;

    fn store(dir: &Path, pings: &[u32]) -> PathBuf {
        std::fs::create_dir_all(dir).expect("folder");
        let mut zarr = ZarrRecorder::create(dir, &sonar(), false).expect("creates");
        for &number in pings {
            let (plan, output) = (plan(number), output(number));
            zarr.push(&plan, &output, (&[], &[])).expect("writes");
        }
        zarr.finish().expect("finishes").expect("has pings")
    }

    /// Contents of all files, by their paths below the folder.
    fn files(folder: &Path) -> BTreeMap<PathBuf, Vec<u8>> {
        let mut found = BTreeMap::new();
        for entry in std::fs::read_dir(folder).expect("a folder") {
            let path = entry.expect("an entry").path();
            let name = PathBuf::from(path.file_name().expect("a name"));
            match path.is_dir() {
                true => found.extend(
                    files(&path)
                        .into_iter()
                        .map(|(inner, b)| (name.join(inner), b)),
                ),
                false => drop(found.insert(name, std::fs::read(&path).expect("readable"))),
            }
        }
        found
    }

    #[test]
    fn a_chunk_holds_the_samples_of_one_ping_and_other_arrays_grow() {
        let dir = tempfile::tempdir().expect("folder");
        let path = store(dir.path(), &[3, 4, 6]);
        let of = |name: &str| std::fs::read(path.join(name)).expect(name);
        for (row, number) in [3, 4, 6].into_iter().enumerate() {
            let output = output(number);
            let iq = output.elements.iter().flat_map(|frame| &frame.iq);
            let want = f32_bytes(iq.flat_map(|x| [x.re as f32, x.im as f32]));
            assert!(
                of(&format!("elements/c/{row}/0/0")) == want,
                "ping {number}"
            );
            let want = f32_bytes(output.lines.iter().flat_map(|l| l.amplitude.clone()));
            assert!(of(&format!("lines/c/{row}/0/0")) == want, "ping {number}");
        }
        let numbers = [3_i64, 4, 6].map(i64::to_le_bytes).concat();
        assert_eq!(of("ping/c/0"), numbers);
        let metadata = |name: &str| -> Value {
            serde_json::from_slice(&of(&format!("{name}/zarr.json"))).expect("JSON")
        };
        let elements = metadata("elements");
        assert_eq!(elements["shape"], json!([3, 5, 20]));
        assert_eq!(
            elements["dimension_names"],
            json!(["ping", "element", "sample"])
        );
        let chunk = |array: &Value| array["chunk_grid"]["configuration"]["chunk_shape"].clone();
        assert_eq!(chunk(&elements), json!([1, 5, 20]));
        assert_eq!(chunk(&metadata("element_position_m")), json!([3, 5, 3]));
        let names = std::fs::read_dir(dir.path()).expect("a folder").count();
        assert_eq!(names, 1, "only the store remains");
    }

    #[test]
    fn joined_stores_are_the_store_of_all_pings() {
        let dir = tempfile::tempdir().expect("folder");
        let whole = store(&dir.path().join("whole"), &[1, 2, 3, 4]);
        let parts = [&[1][..], &[2, 3], &[4]];
        let parts = [0, 1, 2].map(|k| store(&dir.path().join(k.to_string()), parts[k]));
        let parts: Vec<&Path> = parts.iter().map(PathBuf::as_path).collect();
        let target = dir.path().join("pings.zarr");
        let mut listed = join(&parts, &target).expect("joins");
        let (joined, whole) = (files(&target), files(&whole));
        listed.sort();
        assert_eq!(listed, joined.keys().cloned().collect::<Vec<_>>());
        assert!(joined == whole, "{:?}", joined.keys());
    }

    #[test]
    fn a_ping_of_another_shape_is_left_out_and_the_store_stays_whole() {
        let dir = tempfile::tempdir().expect("folder");
        let mut zarr = ZarrRecorder::create(dir.path(), &sonar(), false).expect("creates");
        zarr.push(&plan(1), &output(1), (&[], &[])).expect("writes");
        let mut odd = output(2);
        for line in &mut odd.lines {
            line.amplitude.pop();
        }
        let error = zarr
            .push(&plan(2), &odd, (&[], &[]))
            .expect_err("shorter lines");
        assert!(
            error
                .to_string()
                .contains("ping 2 has 19 line samples, the first had 20"),
            "{error}"
        );
        zarr.push(&plan(3), &output(3), (&[], &[])).expect("writes");
        let path = zarr.finish().expect("finishes").expect("has pings");
        let alone = tempfile::tempdir().expect("folder");
        assert!(files(&path) == files(&store(alone.path(), &[1, 3])));
    }

    #[test]
    fn a_folder_that_is_no_store_is_not_replaced() {
        let dir = tempfile::tempdir().expect("folder");
        let other = dir.path().join("pings.zarr/notes.txt");
        std::fs::create_dir(dir.path().join("pings.zarr")).expect("folder");
        std::fs::write(&other, "kept").expect("written");
        let mut zarr = ZarrRecorder::create(dir.path(), &sonar(), false).expect("creates");
        zarr.push(&plan(1), &output(1), (&[], &[])).expect("writes");
        let error = zarr.finish().expect_err("the folder is not empty");
        assert!(
            error.to_string().contains("pings.zarr: cannot rename to"),
            "{error}"
        );
        assert_eq!(std::fs::read(&other).expect("kept"), b"kept");
        assert!(!dir.path().join("pings.zarr.partial").exists());
        std::fs::remove_dir_all(dir.path().join("pings.zarr")).expect("removed");
        // An earlier store is.
        store(dir.path(), &[1, 2]);
        store(dir.path(), &[5]);
        let numbers = std::fs::read(dir.path().join("pings.zarr/ping/c/0")).expect("there");
        assert_eq!(numbers, 5_i64.to_le_bytes());
    }
}

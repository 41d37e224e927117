//! One ping: first its samples, taken from the slot of the sonar without the interpreter lock, then the Python object around them.

use numpy::ndarray::{Array1, Array2};
use numpy::{Complex32, Complex64, Element, IntoPyArray, PyArray1};
use pyo3::prelude::*;
use pyo3::sync::PyOnceLock;
use pyo3::types::{PyDict, PyList};

use echotank_core::frames::angles_from_rotation;
use echotank_core::ping::{Detection, Line, Side, Sounding};
use echotank_runtime::io::record::masks::SampleLabels;
use echotank_runtime::replay::ReplayPings;

use crate::errors::{Kind, error};

/// Settings with which a ping was made.
#[pyclass(module = "echotank", frozen, get_all)]
#[derive(Clone, Copy)]
pub(crate) struct Settings {
    /// Maximum slant range, metres.
    range_m: f64,
    /// Maximum ping rate, hertz.
    max_ping_rate_hz: f64,
    /// Source level, dB re 1 uPa at 1 m.
    source_level_db: f64,
    /// Receiver gain, dB.
    gain_db: f64,
    /// Pulse length, seconds.
    pulse_duration_s: f64,
}

impl From<echotank_core::settings::SonarSettings> for Settings {
    fn from(s: echotank_core::settings::SonarSettings) -> Self {
        Self {
            range_m: s.range_m,
            max_ping_rate_hz: s.max_ping_rate_hz,
            source_level_db: s.source_level_db,
            gain_db: s.gain_db,
            pulse_duration_s: s.pulse_duration_s,
        }
    }
}

#[pymethods]
impl Settings {
    fn __repr__(&self) -> String {
        format!(
            "Settings(range_m={}, max_ping_rate_hz={}, source_level_db={}, gain_db={}, pulse_duration_s={})",
            self.range_m,
            self.max_ping_rate_hz,
            self.source_level_db,
            self.gain_db,
            self.pulse_duration_s
        )
    }
}

/// Pose of the platform's reference point at the start of the pulse.
#[pyclass(module = "echotank", frozen, get_all)]
#[derive(Clone, Copy)]
pub(crate) struct Pose {
    /// North, east, down from the world's origin, metres.
    position_m: (f64, f64, f64),
    /// North, east, down, metres per second.
    velocity_m_per_s: (f64, f64, f64),
    /// Roll, degrees, positive starboard down.
    roll_deg: f64,
    /// Pitch, degrees, positive bow up.
    pitch_deg: f64,
    /// Heading, degrees clockwise from true north.
    heading_deg: f64,
    /// WGS84 latitude, degrees.
    latitude_deg: f64,
    /// WGS84 longitude, degrees.
    longitude_deg: f64,
}

#[pymethods]
impl Pose {
    fn __repr__(&self) -> String {
        let (north, east, down) = self.position_m;
        format!(
            "Pose(north={north:.3}, east={east:.3}, down={down:.3} m, roll={:.3}, pitch={:.3}, heading={:.3} deg)",
            self.roll_deg, self.pitch_deg, self.heading_deg
        )
    }
}

/// Bottom detections of one ping, as columns.
#[pyclass(module = "echotank", frozen, get_all)]
pub(crate) struct Soundings {
    /// Index of the beam, int64 (soundings,).
    beam: Py<PyArray1<i64>>,
    /// Angle from the boresight, float64 (soundings,), radians, positive to starboard.
    angle_rad: Py<PyArray1<f64>>,
    /// Two-way travel time from the start of the pulse, float64 (soundings,), seconds.
    twtt_s: Py<PyArray1<f64>>,
    /// Predicted standard deviation of the travel time, float64 (soundings,), seconds.
    error_s: Py<PyArray1<f64>>,
    /// Level of the echo, float64 (soundings,), volts (rms).
    level_v: Py<PyArray1<f64>>,
    /// Method of the detection, uint8 (soundings,): 1 amplitude, 2 phase.
    method: Py<PyArray1<u8>>,
}

impl Soundings {
    pub(crate) fn of(py: Python<'_>, soundings: &[Sounding]) -> Self {
        let column = |of: fn(&Sounding) -> f64| {
            let values: Vec<f64> = soundings.iter().map(of).collect();
            values.into_pyarray(py).unbind()
        };
        let beams: Vec<i64> = soundings.iter().map(|s| s.beam as i64).collect();
        let method = |s: &Sounding| match s.detection {
            Detection::Amplitude => 1,
            Detection::Phase => 2,
        };
        let methods: Vec<u8> = soundings.iter().map(method).collect();
        Self {
            beam: beams.into_pyarray(py).unbind(),
            angle_rad: column(|s| s.angle_rad),
            twtt_s: column(|s| s.twtt_s),
            error_s: column(|s| s.error_s),
            level_v: column(|s| s.level_v),
            method: methods.into_pyarray(py).unbind(),
        }
    }
}

#[pymethods]
impl Soundings {
    #[new]
    fn new(
        beam: Py<PyArray1<i64>>,
        angle_rad: Py<PyArray1<f64>>,
        twtt_s: Py<PyArray1<f64>>,
        error_s: Py<PyArray1<f64>>,
        level_v: Py<PyArray1<f64>>,
        method: Py<PyArray1<u8>>,
    ) -> Self {
        Self {
            beam,
            angle_rad,
            twtt_s,
            error_s,
            level_v,
            method,
        }
    }

    fn __len__(&self, py: Python<'_>) -> PyResult<usize> {
        self.beam.bind(py).as_any().len()
    }

    fn __repr__(&self, py: Python<'_>) -> PyResult<String> {
        Ok(format!("Soundings({} beams)", self.__len__(py)?))
    }
}

/// Labels of samples: of one side-scan line, or of all beams.
#[pyclass(module = "echotank", frozen, get_all)]
pub(crate) struct Mask {
    /// Target with most of the energy, uint16: 1 is the first target of the scene, 0 none.
    target: Py<PyAny>,
    /// Shadow, uint8: 1 where ground on the beam axis is not insonified and no target is labelled.
    shadow: Py<PyAny>,
    /// Depth of the ground on the beam axis, float32, metres below the world's origin; NaN where absent.
    depth_m: Py<PyAny>,
}

impl Mask {
    fn of_line(py: Python<'_>, labels: SampleLabels) -> Self {
        let SampleLabels {
            target,
            shadow,
            depth_m,
            ..
        } = labels;
        Self {
            target: target.into_pyarray(py).into_any().unbind(),
            shadow: shadow.into_pyarray(py).into_any().unbind(),
            depth_m: depth_m.into_pyarray(py).into_any().unbind(),
        }
    }

    fn of_beams(py: Python<'_>, labels: &[SampleLabels], samples: usize) -> PyResult<Self> {
        fn all<T: Clone>(labels: &[SampleLabels], of: fn(&SampleLabels) -> &[T]) -> Vec<T> {
            labels.iter().flat_map(|l| of(l).iter().cloned()).collect()
        }
        let shape = (labels.len(), samples);
        Ok(Self {
            target: rows(py, shape, all(labels, |l| &l.target))?,
            shadow: rows(py, shape, all(labels, |l| &l.shadow))?,
            depth_m: rows(py, shape, all(labels, |l| &l.depth_m))?,
        })
    }
}

#[pymethods]
impl Mask {
    #[new]
    fn new(target: Py<PyAny>, shadow: Py<PyAny>, depth_m: Py<PyAny>) -> Self {
        Self {
            target,
            shadow,
            depth_m,
        }
    }
}

/// A two-dimensional array of `values`, which it takes over without a copy.
pub(crate) fn rows<T: Element>(
    py: Python<'_>,
    shape: (usize, usize),
    values: Vec<T>,
) -> PyResult<Py<PyAny>> {
    let array = Array2::from_shape_vec(shape, values)
        .map_err(|why| error(py, Kind::Echotank, format!("samples: {why}")))?;
    Ok(array.into_pyarray(py).into_any().unbind())
}

/// Name of a side as a key of `Ping.lines`.
pub(crate) fn side_name(side: Side) -> &'static str {
    match side {
        Side::Port => "port",
        Side::Starboard => "starboard",
    }
}

/// Samples of one array.
enum Samples {
    Single(Vec<Complex32>),
    Double(Vec<Complex64>),
}

/// What a ping is to hold.
#[derive(Clone, Copy)]
pub(crate) struct Wanted {
    pub(crate) elements: bool,
    pub(crate) masks: bool,
    pub(crate) double: bool,
}

/// Everything of one ping, owned, and free of the interpreter.
pub(crate) struct PingData {
    sonar: String,
    number: u32,
    utc_ns: i64,
    stamp_utc_ns: i64,
    /// Name, number of elements and of samples, samples.
    elements: Vec<(String, (usize, usize), Samples)>,
    samples: usize,
    /// Number of beams and of samples, samples.
    beams: (usize, usize, Vec<Complex32>),
    beam_angle_rad: Vec<f64>,
    beam_width_rad: Vec<f64>,
    lines: Vec<Line>,
    more_lines: Vec<Vec<Line>>,
    soundings: Vec<Sounding>,
    pose: Pose,
    settings: Settings,
    sample_rate_hz: f64,
    first_sample_s: f64,
    center_frequency_hz: f64,
    sound_speed_m_per_s: f64,
    /// Name, and positions of the elements, three numbers each.
    element_position_m: Vec<(String, Vec<f64>)>,
    transmit_position_m: Vec<(String, Vec<f64>)>,
    line_labels: Option<Vec<SampleLabels>>,
    beam_labels: Option<Vec<SampleLabels>>,
    truth_json: String,
    plan_json: String,
}

impl PingData {
    /// Takes the last ping of a sonar.
    pub(crate) fn of(pings: &ReplayPings, sonar: usize, wanted: Wanted) -> Self {
        let slot = pings.slot(sonar);
        let (plan, output) = (&slot.plan, &slot.output);
        let spec = &pings.rig().sonars[sonar].spec;
        let pose = plan.trajectory.pose_at(0.0);
        let (roll, pitch, heading) = angles_from_rotation(pose.world_from_body);
        let frames = output.elements.iter().filter(|_| wanted.elements);
        let elements = frames.map(|frame| {
            let samples = match wanted.double {
                true => Samples::Double(frame.iq.clone()),
                false => {
                    let single = |x: &Complex64| Complex32::new(x.re as f32, x.im as f32);
                    Samples::Single(frame.iq.iter().map(single).collect())
                }
            };
            let name = spec.receive_names[frame.array].clone();
            (name, (frame.elements, frame.samples), samples)
        });
        let fan = output.beams.first();
        let receive = spec.receive.iter().zip(&spec.receive_names);
        let transmit = spec.transmit.iter().zip(&spec.transmit_names);
        Self {
            sonar: spec.name.clone(),
            number: plan.ping_number,
            utc_ns: plan.transmit_utc.0,
            stamp_utc_ns: plan.stamp_utc.0,
            elements: elements.collect(),
            samples: plan.sample_count,
            beams: fan.map_or((0, plan.sample_count, Vec::new()), |fan| {
                (fan.beams, fan.samples, fan.iq.clone())
            }),
            beam_angle_rad: fan.map_or(Vec::new(), |fan| fan.angle_rad.clone()),
            beam_width_rad: fan.map_or(Vec::new(), |fan| fan.width_rad.clone()),
            lines: output.lines.clone(),
            more_lines: output.more_lines.iter().map(|m| m.lines.clone()).collect(),
            soundings: output.soundings.clone(),
            pose: Pose {
                position_m: pose.position_m.into(),
                velocity_m_per_s: pose.velocity_m_per_s.into(),
                roll_deg: roll.to_degrees(),
                pitch_deg: pitch.to_degrees(),
                heading_deg: heading.to_degrees(),
                latitude_deg: plan.nav.latitude_rad.to_degrees(),
                longitude_deg: plan.nav.longitude_rad.to_degrees(),
            },
            settings: plan.settings.into(),
            sample_rate_hz: spec.receiver.sample_rate_hz,
            first_sample_s: plan.first_sample_s,
            center_frequency_hz: plan.pulse.center_frequency_hz,
            sound_speed_m_per_s: plan.sound_speed_m_per_s,
            element_position_m: receive
                .map(|(array, name)| {
                    let at = |e| pose.point_m(array.element_body_m(e)).to_array();
                    (name.clone(), (0..array.elements).flat_map(at).collect())
                })
                .collect(),
            transmit_position_m: transmit
                .map(|(array, name)| {
                    let at = pose.point_m(array.mounting.position_m);
                    (name.clone(), at.to_array().to_vec())
                })
                .collect(),
            line_labels: wanted.masks.then(|| pings.line_labels(sonar)),
            beam_labels: wanted.masks.then(|| pings.beam_labels(sonar)),
            truth_json: pings.truth_json(sonar),
            plan_json: pings.plan_json(sonar),
        }
    }
}

/// One computed ping. Its arrays belong to it: they stay as they are when the next ping is computed.
#[pyclass(module = "echotank", frozen)]
pub(crate) struct Ping {
    /// Name of the sonar.
    #[pyo3(get)]
    sonar: String,
    /// Number of the ping, from 1.
    #[pyo3(get)]
    number: u32,
    /// Start of the pulse, nanoseconds since 1970 UTC.
    #[pyo3(get)]
    utc_ns: i64,
    /// Time stamp of the records (`nav.stamp`), nanoseconds since 1970 UTC.
    #[pyo3(get)]
    stamp_utc_ns: i64,
    /// Element samples of each receive array by its name: complex64 (elements, samples), volts (rms) of the complex envelope about
    /// `center_frequency_hz`; complex128 with `double=True`. Sample k lies at `first_sample_s + k / sample_rate_hz`.
    #[pyo3(get)]
    elements: Py<PyDict>,
    /// Beams of the fan after the matched filter: complex64 (beams, samples), volts (rms); no beams without a fan. Sample k is a leading edge at
    /// `first_sample_s + k / sample_rate_hz`.
    #[pyo3(get)]
    beams: Py<PyAny>,
    /// Angles of the beams from the boresight: float64 (beams,), radians, positive to starboard.
    #[pyo3(get)]
    beam_angle_rad: Py<PyArray1<f64>>,
    /// -3 dB widths of the beams across the track: float64 (beams,), radians.
    #[pyo3(get)]
    beam_width_rad: Py<PyArray1<f64>>,
    /// Side-scan lines by side, "port" and "starboard": float32 (samples,), envelope in volts (rms). Sample 0 is the start of the pulse.
    #[pyo3(get)]
    lines: Py<PyDict>,
    /// Side-scan lines of each further pulse, as `lines`. Sample 0 is the start of that pulse.
    #[pyo3(get)]
    more_lines: Py<PyList>,
    /// Bottom detections of the fan.
    #[pyo3(get)]
    soundings: Py<Soundings>,
    /// Pose of the platform at the start of the pulse.
    #[pyo3(get)]
    pose: Pose,
    /// Settings with which the ping was made.
    #[pyo3(get)]
    settings: Settings,
    /// Sample rate of the receiver, hertz.
    #[pyo3(get)]
    sample_rate_hz: f64,
    /// Time of sample 0 after the start of the pulse, seconds.
    #[pyo3(get)]
    first_sample_s: f64,
    /// Centre frequency of the pulse, hertz.
    #[pyo3(get)]
    center_frequency_hz: f64,
    /// Sound speed of the water, metres per second.
    #[pyo3(get)]
    sound_speed_m_per_s: f64,
    /// Positions of the elements of each receive array at the start of the pulse: float64 (elements, 3), north, east, down, metres.
    #[pyo3(get)]
    element_position_m: Py<PyDict>,
    /// Position of each transmit array at the start of the pulse: float64 (3,), north, east, down, metres.
    #[pyo3(get)]
    transmit_position_m: Py<PyDict>,
    samples: usize,
    masks: Option<(Py<PyDict>, Py<Mask>)>,
    truth_json: String,
    truth: PyOnceLock<Py<PyAny>>,
    plan_json: String,
    plan: PyOnceLock<Py<PyAny>>,
}

fn lines_by_side(py: Python<'_>, lines: Vec<Line>) -> PyResult<Py<PyDict>> {
    let by_side = PyDict::new(py);
    for Line { side, amplitude } in lines {
        by_side.set_item(side_name(side), amplitude.into_pyarray(py))?;
    }
    Ok(by_side.unbind())
}

fn positions(py: Python<'_>, of: Vec<(String, Vec<f64>)>) -> PyResult<Bound<'_, PyDict>> {
    let by_name = PyDict::new(py);
    for (name, numbers) in of {
        by_name.set_item(name, rows(py, (numbers.len() / 3, 3), numbers)?)?;
    }
    Ok(by_name)
}

fn from_json<'py>(
    py: Python<'py>,
    made: &PyOnceLock<Py<PyAny>>,
    text: &str,
) -> PyResult<Bound<'py, PyAny>> {
    let load = || {
        let loads = py.import("json")?.getattr("loads")?;
        Ok::<_, PyErr>(loads.call1((text,))?.unbind())
    };
    Ok(made.get_or_try_init(py, load)?.bind(py).clone())
}

impl Ping {
    /// The Python object of a ping. The arrays take over the samples.
    pub(crate) fn new(py: Python<'_>, data: PingData) -> PyResult<Self> {
        let elements = PyDict::new(py);
        for (name, shape, samples) in data.elements {
            let array = match samples {
                Samples::Single(iq) => rows(py, shape, iq)?,
                Samples::Double(iq) => rows(py, shape, iq)?,
            };
            elements.set_item(name, array)?;
        }
        let more_lines = data.more_lines.into_iter();
        let more_lines = more_lines.map(|lines| lines_by_side(py, lines));
        let (beams, beam_samples, iq) = data.beams;
        let transmit_position_m = PyDict::new(py);
        for (name, position) in data.transmit_position_m {
            transmit_position_m.set_item(name, Array1::from(position).into_pyarray(py))?;
        }
        let masks = match (data.line_labels, data.beam_labels) {
            (Some(of_lines), Some(of_beams)) => {
                let by_side = PyDict::new(py);
                for labels in of_lines {
                    let side = side_name(labels.side);
                    by_side.set_item(side, Py::new(py, Mask::of_line(py, labels))?)?;
                }
                let of_beams = Mask::of_beams(py, &of_beams, beam_samples)?;
                Some((by_side.unbind(), Py::new(py, of_beams)?))
            }
            _ => None,
        };
        Ok(Self {
            sonar: data.sonar,
            number: data.number,
            utc_ns: data.utc_ns,
            stamp_utc_ns: data.stamp_utc_ns,
            elements: elements.unbind(),
            beams: rows(py, (beams, beam_samples), iq)?,
            beam_angle_rad: data.beam_angle_rad.into_pyarray(py).unbind(),
            beam_width_rad: data.beam_width_rad.into_pyarray(py).unbind(),
            lines: lines_by_side(py, data.lines)?,
            more_lines: PyList::new(py, more_lines.collect::<PyResult<Vec<_>>>()?)?.unbind(),
            soundings: Py::new(py, Soundings::of(py, &data.soundings))?,
            pose: data.pose,
            settings: data.settings,
            sample_rate_hz: data.sample_rate_hz,
            first_sample_s: data.first_sample_s,
            center_frequency_hz: data.center_frequency_hz,
            sound_speed_m_per_s: data.sound_speed_m_per_s,
            element_position_m: positions(py, data.element_position_m)?.unbind(),
            transmit_position_m: transmit_position_m.unbind(),
            samples: data.samples,
            masks,
            truth_json: data.truth_json,
            truth: PyOnceLock::new(),
            plan_json: data.plan_json,
            plan: PyOnceLock::new(),
        })
    }

    fn masks_or_refuse(&self, py: Python<'_>) -> PyResult<&(Py<PyDict>, Py<Mask>)> {
        let why = "the masks were not asked for: use pings(..., masks=True)";
        self.masks
            .as_ref()
            .ok_or_else(|| error(py, Kind::Refused, why))
    }
}

#[pymethods]
impl Ping {
    /// Labels of the side-scan lines by side, arrays of (samples,). Needs `masks=True`.
    #[getter]
    fn masks<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyDict>> {
        Ok(self.masks_or_refuse(py)?.0.bind(py).clone())
    }

    /// Labels of the beams, arrays of (beams, samples). Needs `masks=True`.
    #[getter]
    fn beam_mask<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, Mask>> {
        Ok(self.masks_or_refuse(py)?.1.bind(py).clone())
    }

    /// Ground truth of the ping: the line of `truth.jsonl` as a dictionary.
    #[getter]
    fn truth<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        from_json(py, &self.truth, &self.truth_json)
    }

    /// The sonar with its arrays, receiver and pulse, and the plan of the ping: `plan` of `pings.npz` as a dictionary.
    #[getter]
    fn plan<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        from_json(py, &self.plan, &self.plan_json)
    }

    /// Times of the samples of `elements` and `beams` after the start of the pulse: float64 (samples,), seconds.
    #[getter]
    fn time_s<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray1<f64>> {
        let at = |k: usize| self.first_sample_s + k as f64 / self.sample_rate_hz;
        (0..self.samples)
            .map(at)
            .collect::<Vec<_>>()
            .into_pyarray(py)
    }

    fn __repr__(&self) -> String {
        format!(
            "Ping({} {}, {} samples, range {} m)",
            self.sonar, self.number, self.samples, self.settings.range_m
        )
    }
}

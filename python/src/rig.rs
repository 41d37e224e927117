//! A rig and its pings.

use std::path::{Path, PathBuf};
use std::sync::{Mutex, MutexGuard};

use pyo3::exceptions::PyTypeError;
use pyo3::prelude::*;
use pyo3::types::{PyBool, PyDict, PyFloat, PyInt, PyList, PyString, PyTuple};

use echotank_config::spec::{FaultRequest, RigSpec};
use echotank_core::settings::{SettingChange, SettingRefused};
use echotank_runtime::check::{CheckError, findings, select_methods};
use echotank_runtime::config_files::{LoadError, load_with};
use echotank_runtime::replay::{PingOptions, ReplayError, ReplayPings, Step, use_navigation};

use crate::errors::{Kind, class, error, released, wrong_configuration};
use crate::ping::{Ping, PingData, Settings, Wanted};

/// A rig: water, navigation, scene and sonars, from one configuration file.
///
/// Args:
///     path: The configuration (TOML).
///     overrides: Values of keys to change before the configuration is checked, such as ``{"sonar.ping.range_m": 80}``. A key of an array of
///         tables changes every entry; ``"sonar.0.ping.range_m"`` changes the first.
///     nav: A navigation log, or a recording of ``echotank run --record-nav``, in place of the live sources and of the first source's file.
///
/// Raises:
///     ConfigurationError: The configuration is wrong. ``problems`` holds every problem, ``str()`` prints them as ``echotank check`` does.
#[pyclass(module = "echotank", frozen)]
pub(crate) struct Rig {
    spec: RigSpec,
    path: PathBuf,
}

#[pymethods]
impl Rig {
    #[new]
    #[pyo3(signature = (path, overrides = None, *, nav = None))]
    fn new(
        py: Python<'_>,
        path: PathBuf,
        overrides: Option<&Bound<'_, PyDict>>,
        nav: Option<PathBuf>,
    ) -> PyResult<Self> {
        let mut set = Vec::new();
        for (key, value) in overrides.into_iter().flatten() {
            let key: String = key.extract()?;
            set.push(format!("{key}={}", toml_of(&value)?));
        }
        let loaded = released(py, || load_with(&path, &set))?;
        let mut spec = loaded.map_err(|failure| {
            let text = match &failure {
                LoadError::File(errors) => errors.to_string(),
                LoadError::Overridden { file, errors } => {
                    format!("{} (with overrides)\n{errors}", file.display())
                }
                LoadError::Override(text) => text.replacen("--set ", "override ", 1),
            };
            wrong_configuration(py, &text, failure.problems())
        })?;
        if let Some(log) = &nav {
            use_navigation(&mut spec, log).map_err(|why| {
                wrong_configuration(py, &format!("nav {}: {why}", log.display()), &[])
            })?;
        }
        Ok(Self { spec, path })
    }

    /// The configuration file.
    #[getter]
    fn path(&self) -> &Path {
        &self.path
    }

    /// Names of the sonars, in the order of the configuration.
    #[getter]
    fn sonars(&self) -> Vec<String> {
        self.spec.sonars.iter().map(|s| s.name.clone()).collect()
    }

    /// Derived values of the configuration, as ``echotank check`` prints them.
    fn summary(&self) -> String {
        echotank_config::summary(&self.spec)
    }

    /// Findings of the rig: what it does otherwise than is probably meant, each with a remedy, as ``echotank check`` reports them.
    ///
    /// Plans the first ping of every sonar. An empty list is the verdict "works".
    ///
    /// Raises:
    ///     ConfigurationError: The scene or the navigation cannot be opened.
    fn check<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyList>> {
        let checked = released(py, || {
            select_methods(&self.spec).map(|(_, selections)| findings(&self.spec, &selections))
        })?;
        let found = checked.map_err(|why| match why {
            CheckError::Threads(_) => error(py, Kind::Echotank, why),
            CheckError::Costs(_) | CheckError::First(_) => {
                wrong_configuration(py, &why.to_string(), &[])
            }
        })?;
        let finding = class(py, "Finding")?;
        let found = found.iter();
        let found = found.map(|f| finding.call1((f.kind.name(), &f.text, &f.remedy)));
        PyList::new(py, found.collect::<PyResult<Vec<_>>>()?)
    }

    /// An iterator over pings in the order of time, with the bits of ``echotank replay``.
    ///
    /// Every call opens the rig anew. The interpreter lock is released while a ping is computed. Pings at which the navigation has a gap are left out
    /// and counted.
    ///
    /// Args:
    ///     first: Number of the first ping of each sonar, from 1.
    ///     count: Number of pings of each sonar; without it, all that the navigation holds.
    ///     elements: Whether element samples are needed. Without them, ``sonar.model.output = "auto"`` may compute beams only, which is faster.
    ///     masks: Whether the pings hold labels of their samples.
    ///     double: Element samples as complex128 instead of complex64.
    ///     threads: Compute threads; 0 means one per core; without it, as configured. The samples do not depend on it.
    ///
    /// Raises:
    ///     ConfigurationError: The rig cannot be opened.
    ///     RefusedError: ``first`` or ``count`` is not above 0, or the navigation ends before ``first``.
    #[pyo3(signature = (first = 1, count = None, *, elements = true, masks = false, double = false, threads = None))]
    #[allow(clippy::too_many_arguments)] // keywords in Python
    fn pings(
        &self,
        py: Python<'_>,
        first: i64,
        count: Option<i64>,
        elements: bool,
        masks: bool,
        double: bool,
        threads: Option<usize>,
    ) -> PyResult<Pings> {
        let options = PingOptions {
            pings: range_of(py, first, count)?,
            threads: threads.unwrap_or(self.spec.run.threads),
            elements_for: elements.then_some("elements=True"),
        };
        let mut spec = self.spec.clone();
        // Without a last ping, a looped log never ends.
        spec.nav.loop_log &= count.is_some();
        let opened = released(py, || ReplayPings::open(spec, options))?;
        let pings = opened.map_err(|why| refused_or_failed(py, &why))?;
        let warn = class(py, "EchotankWarning")?;
        for warning in pings.nav_warnings() {
            let text = (format!("navigation: {warning}"), &warn);
            py.import("warnings")?.getattr("warn")?.call1(text)?;
        }
        Ok(Pings {
            sonars: self.sonars(),
            wanted: Wanted {
                elements,
                masks,
                double,
            },
            state: Mutex::new(State { pings, skipped: 0 }),
        })
    }

    fn __repr__(&self) -> String {
        format!("Rig({}, {})", self.path.display(), self.sonars().join(", "))
    }
}

/// First and last ping of each sonar.
fn range_of(py: Python<'_>, first: i64, count: Option<i64>) -> PyResult<Option<(u32, u32)>> {
    let refuse = |key, value, rule: &str| {
        Err(error(
            py,
            Kind::Refused,
            format!("{key} = {value}: must be {rule}"),
        ))
    };
    let Ok(from) = u32::try_from(first) else {
        return refuse("first", first, "a ping number from 1 to 4294967295");
    };
    if from == 0 {
        return refuse("first", first, "at least 1: pings are numbered from 1");
    }
    let Some(count) = count else {
        return Ok((from > 1).then_some((from, u32::MAX)));
    };
    if count < 1 {
        return refuse("count", count, "at least 1");
    }
    let last = first.saturating_add(count - 1).min(i64::from(u32::MAX));
    // At most the largest number of a ping.
    Ok(Some((from, last as u32)))
}

fn refused_or_failed(py: Python<'_>, why: &ReplayError) -> PyErr {
    match why {
        ReplayError::PastEnd { first, held, .. } => error(
            py,
            Kind::Refused,
            format!("first = {first}: the navigation holds only about {held} pings"),
        ),
        ReplayError::Recorded(_) | ReplayError::Beams { .. } => {
            wrong_configuration(py, &why.to_string(), &[])
        }
        ReplayError::Record(_) | ReplayError::NoPing(_) | ReplayError::Threads(_) => {
            error(py, Kind::Echotank, why)
        }
    }
}

/// A Python value as TOML text.
fn toml_of(value: &Bound<'_, PyAny>) -> PyResult<String> {
    if let Ok(flag) = value.cast::<PyBool>() {
        return Ok(flag.is_true().to_string());
    }
    if let Ok(text) = value.cast::<PyString>() {
        return Ok(serde_json::Value::from(text.to_string()).to_string());
    }
    if value.is_instance_of::<PyList>() || value.is_instance_of::<PyTuple>() {
        let items = value.try_iter()?.map(|item| toml_of(&item?));
        return Ok(format!(
            "[{}]",
            items.collect::<PyResult<Vec<_>>>()?.join(", ")
        ));
    }
    if let Ok(table) = value.cast::<PyDict>() {
        let mut items = Vec::new();
        for (key, item) in table {
            let key = serde_json::Value::from(key.extract::<String>()?);
            items.push(format!("{key} = {}", toml_of(&item)?));
        }
        return Ok(format!("{{ {} }}", items.join(", ")));
    }
    // Of NumPy's numbers, integers have an index, and all others become floats.
    let is_float = value.is_instance_of::<PyFloat>();
    if value.is_instance_of::<PyInt>() || (!is_float && value.hasattr("__index__")?) {
        return Ok(value.extract::<i64>()?.to_string());
    }
    if is_float || value.hasattr("__float__")? {
        return Ok(format!("{:?}", value.extract::<f64>()?));
    }
    let kind = value.get_type().name()?;
    Err(PyTypeError::new_err(format!(
        "overrides: {kind} is no value of a configuration; use bool, int, float, str, list or dict"
    )))
}

struct State {
    pings: ReplayPings,
    skipped: u64,
}

/// Pings of a rig, computed one after another. Made by :meth:`Rig.pings`.
#[pyclass(module = "echotank", frozen)]
pub(crate) struct Pings {
    sonars: Vec<String>,
    wanted: Wanted,
    state: Mutex<State>,
}

impl Pings {
    /// Runs `work` on the pings without the interpreter lock.
    fn with<T: Send>(
        &self,
        py: Python<'_>,
        work: impl FnOnce(&mut State) -> T + Send,
    ) -> PyResult<T> {
        released(py, || {
            let mut state: MutexGuard<'_, State> = self.state.lock().ok()?;
            Some(work(&mut state))
        })?
        .ok_or_else(|| {
            error(
                py,
                Kind::Echotank,
                "an earlier ping failed: open the pings anew",
            )
        })
    }

    /// Indices of the sonars of a name; all without a name.
    fn indices(&self, py: Python<'_>, sonar: Option<&str>) -> PyResult<Vec<usize>> {
        let Some(name) = sonar else {
            return Ok((0..self.sonars.len()).collect());
        };
        match self.sonars.iter().position(|own| own == name) {
            Some(index) => Ok(vec![index]),
            None => {
                let names = self.sonars.join(", ");
                let text = format!("sonar = {name:?}: must be one of {names}");
                Err(error(py, Kind::Refused, text))
            }
        }
    }
}

#[pymethods]
impl Pings {
    fn __iter__(this: PyRef<'_, Self>) -> PyRef<'_, Self> {
        this
    }

    fn __next__(&self, py: Python<'_>) -> PyResult<Option<Ping>> {
        let next = self.with(py, |state| {
            loop {
                match state.pings.step()? {
                    Step::Skipped { .. } => state.skipped += 1,
                    Step::Ping { sonar, .. } => {
                        return Some(PingData::of(&state.pings, sonar, self.wanted));
                    }
                }
            }
        })?;
        next.map(|data| Ping::new(py, data)).transpose()
    }

    /// Expected number of pings, for progress bars; 0 if it is unknown.
    fn __length_hint__(&self, py: Python<'_>) -> PyResult<usize> {
        let expected = self.with(py, |state| state.pings.expected())?;
        Ok(expected.map_or(0, |n| usize::try_from(n).unwrap_or(usize::MAX)))
    }

    /// Number of pings left out so far because the navigation has a gap.
    #[getter]
    fn skipped(&self, py: Python<'_>) -> PyResult<u64> {
        self.with(py, |state| state.skipped)
    }

    /// Settings of the next ping of a sonar; of the first one without a name.
    #[pyo3(signature = (sonar = None))]
    fn settings(&self, py: Python<'_>, sonar: Option<&str>) -> PyResult<Settings> {
        let index = self.indices(py, sonar)?[0];
        self.with(py, |state| state.pings.settings(index).into())
    }

    /// Changes settings from the next ping on.
    ///
    /// Args:
    ///     sonar: Name of the sonar; every sonar without a name.
    ///     range_m: Maximum slant range, metres.
    ///     max_ping_rate_hz: Maximum ping rate, hertz.
    ///     source_level_db: Source level, dB re 1 uPa at 1 m.
    ///     gain_db: Receiver gain, dB.
    ///     pulse_duration_s: Pulse length, seconds.
    ///
    /// Raises:
    ///     RefusedError: A value is outside ``sonar.limits``; no setting of that sonar is changed. Or the navigation is the recording of a run, which
    ///         has settings of its own.
    #[pyo3(signature = (sonar = None, *, range_m = None, max_ping_rate_hz = None, source_level_db = None, gain_db = None, pulse_duration_s = None))]
    #[allow(clippy::too_many_arguments)] // keywords in Python
    fn set(
        &self,
        py: Python<'_>,
        sonar: Option<&str>,
        range_m: Option<f64>,
        max_ping_rate_hz: Option<f64>,
        source_level_db: Option<f64>,
        gain_db: Option<f64>,
        pulse_duration_s: Option<f64>,
    ) -> PyResult<()> {
        let changes: Vec<SettingChange> = [
            range_m.map(SettingChange::RangeM),
            max_ping_rate_hz.map(SettingChange::MaxPingRateHz),
            source_level_db.map(SettingChange::SourceLevelDb),
            gain_db.map(SettingChange::GainDb),
            pulse_duration_s.map(SettingChange::PulseDurationS),
        ]
        .into_iter()
        .flatten()
        .collect();
        let indices = self.indices(py, sonar)?;
        let changed = self.with(py, |state| -> Result<bool, SettingRefused> {
            if state.pings.is_recorded_run() {
                return Ok(false);
            }
            for index in indices {
                state.pings.change(index, &changes)?;
            }
            Ok(true)
        })?;
        match changed {
            Ok(true) => Ok(()),
            Ok(false) => {
                let why = "the navigation is the recording of a run, whose pings have settings of their own";
                Err(error(py, Kind::Refused, why))
            }
            Err(why) => Err(error(py, Kind::Refused, why)),
        }
    }

    /// Injects a fault from the next ping on and returns its number.
    ///
    /// Args:
    ///     kind: Kind of the fault, as in ``[[fault]]``.
    ///     keys: The other keys of ``[[fault]]``, such as ``element=3`` or ``value=-20``.
    ///
    /// Raises:
    ///     RefusedError: The fault does not fit the rig.
    #[pyo3(signature = (kind, **keys))]
    fn inject(
        &self,
        py: Python<'_>,
        kind: &str,
        keys: Option<&Bound<'_, PyDict>>,
    ) -> PyResult<u32> {
        let request = match keys {
            Some(keys) => keys.copy()?,
            None => PyDict::new(py),
        };
        request.set_item("kind", kind)?;
        let text = py.import("json")?.getattr("dumps")?.call1((request,))?;
        let request: FaultRequest = serde_json::from_str(&text.extract::<String>()?)
            .map_err(|why| error(py, Kind::Refused, format!("fault: {why}")))?;
        let added = self.with(py, |state| state.pings.rig().faults.add(&request))?;
        added.map_err(|why| error(py, Kind::Refused, why))
    }

    /// Removes one fault by its number, or all faults, those of the configuration included. Returns how many were removed.
    #[pyo3(signature = (fault = None))]
    fn clear_faults(&self, py: Python<'_>, fault: Option<u32>) -> PyResult<usize> {
        self.with(py, |state| match fault {
            Some(id) => usize::from(state.pings.rig().faults.remove(id)),
            None => state.pings.rig().faults.clear(),
        })
    }

    /// The faults that were injected since the last call, one dictionary for each fault and ping, as in ``faults-*.jsonl``.
    fn take_injections<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        let made = self.with(py, |state| {
            serde_json::to_string(&state.pings.rig().faults.take_injections())
        })?;
        let text = made.map_err(|why| error(py, Kind::Echotank, why))?;
        py.import("json")?.getattr("loads")?.call1((text,))
    }

    fn __repr__(&self) -> String {
        format!("Pings({})", self.sonars.join(", "))
    }
}

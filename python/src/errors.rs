//! Exceptions of the package, and the border between Rust and Python.

use std::panic::{AssertUnwindSafe, catch_unwind};

use pyo3::exceptions::PyRuntimeError;
use pyo3::prelude::*;
use pyo3::types::PyTuple;

use echotank_config::Problem;

/// Exception classes of `echotank._errors`.
#[derive(Clone, Copy)]
pub(crate) enum Kind {
    /// The base class.
    Echotank,
    /// A wrong configuration.
    Configuration,
    /// A refused setting, fault or argument.
    Refused,
    /// A file that is not a recording.
    Recording,
}

impl Kind {
    fn name(self) -> &'static str {
        match self {
            Self::Echotank => "EchotankError",
            Self::Configuration => "ConfigurationError",
            Self::Refused => "RefusedError",
            Self::Recording => "RecordingError",
        }
    }
}

/// The class or named tuple `name` of `echotank._errors`.
pub(crate) fn class<'py>(py: Python<'py>, name: &str) -> PyResult<Bound<'py, PyAny>> {
    py.import("echotank._errors")?.getattr(name)
}

/// An exception with a text.
pub(crate) fn error(py: Python<'_>, kind: Kind, text: impl std::fmt::Display) -> PyErr {
    let made = class(py, kind.name()).and_then(|class| class.call1((text.to_string(),)));
    made.map_or_else(|failure| failure, PyErr::from_value)
}

/// A `ConfigurationError` with the problems of a configuration.
pub(crate) fn wrong_configuration(py: Python<'_>, text: &str, problems: &[Problem]) -> PyErr {
    let raise = || {
        let one = class(py, "Problem")?;
        let problems = problems.iter().map(|problem| {
            let Problem {
                path,
                line,
                value,
                rule,
                hint,
            } = problem;
            one.call1((path, line, value, rule, hint, problem.to_string()))
        });
        let problems = PyTuple::new(py, problems.collect::<PyResult<Vec<_>>>()?)?;
        class(py, Kind::Configuration.name())?.call1((text, problems))
    };
    raise().map_or_else(|failure| failure, PyErr::from_value)
}

/// Runs `work` without the interpreter lock. A panic becomes an exception.
pub(crate) fn released<T: Send>(py: Python<'_>, work: impl FnOnce() -> T + Send) -> PyResult<T> {
    let done = py.detach(|| catch_unwind(AssertUnwindSafe(work)));
    done.map_err(|panic| {
        let text = panic.downcast_ref::<String>().map(String::as_str);
        let text = text.or_else(|| panic.downcast_ref::<&str>().copied());
        PyRuntimeError::new_err(format!(
            "a fault of echotank, please report it: {}",
            text.unwrap_or("no text")
        ))
    })
}

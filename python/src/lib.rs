//! The native part of the Python package `echotank`: pings of a rig as NumPy arrays, and readers of recordings.
//!
//! The pings are those of a replay ([`echotank_runtime::replay::ReplayPings`]), so they have the same bits. The interpreter lock is released
//! while a ping is computed. A panic becomes an exception. Errors are classes of the module `echotank._errors`.

mod errors;
mod ping;
mod read;
mod rig;

use pyo3::prelude::*;

/// The native part of the package `echotank`.
#[pymodule]
mod _native {
    #[pymodule_export]
    use super::ping::{Mask, Ping, Pose, Settings, Soundings};
    #[pymodule_export]
    use super::read::read_records;
    #[pymodule_export]
    use super::rig::{Pings, Rig};

    use super::*;

    #[pymodule_init]
    fn init(module: &Bound<'_, PyModule>) -> PyResult<()> {
        module.add("__version__", env!("CARGO_PKG_VERSION"))
    }
}

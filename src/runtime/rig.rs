//! Opens a rig from its specification, feeds it recorded navigation and builds its compute thread pool.

use std::path::Path;

use echotank_config::spec::{NavMode, RigSpec};
use echotank_core::settings::SonarSettings;
use echotank_core::time::UtcNs;
use echotank_nav::Coverage;
use echotank_ping::PingOrder;
use echotank_ping::method_selection::costs::{Costs, CostsError};
use echotank_ping::rig::{Rig, RigError};
use thiserror::Error;

use crate::io::files::FileSystem;
use crate::io::nav::{NavInputs, NavOpenError};
use crate::io::{priority, text_of};

/// Errors of opening a rig.
#[derive(Debug, Error)]
pub enum OpenError {
    /// The scene, a sonar or the method selection is invalid.
    #[error(transparent)]
    Rig(#[from] RigError),
    /// A navigation source cannot be opened.
    #[error("navigation: {0}")]
    Nav(#[from] NavOpenError),
    /// The file of `run.costs` cannot be read.
    #[error("run.costs: {path}: {why}")]
    ReadCosts {
        /// The file as configured.
        path: String,
        /// The cause.
        why: std::io::Error,
    },
    /// The file of `run.costs` is not a valid cost table.
    #[error("run.costs: {0}")]
    Costs(#[from] CostsError),
}

/// Opens the rig of `spec`. Call inside the thread pool that computes the pings of the rig.
///
/// # Errors
/// See [`OpenError`].
pub fn open(spec: &RigSpec) -> Result<Rig, OpenError> {
    Ok(Rig::open(
        spec,
        costs_of(spec.run.costs.as_deref())?,
        &FileSystem,
    )?)
}

/// Reads the cost table of method selection from `path`. Without a path, returns the built-in table.
///
/// # Errors
/// The file cannot be read or is not a cost table.
pub fn costs_of(path: Option<&Path>) -> Result<Costs, OpenError> {
    let Some(path) = path else {
        return Ok(Costs::committed());
    };
    let name = path.display().to_string();
    let text = text_of(path).map_err(|why| OpenError::ReadCosts {
        path: name.clone(),
        why,
    })?;
    Ok(Costs::parse(&text, &name)?)
}

/// Reads recorded navigation up to what `order` needs, without waiting for a clock.
///
/// Returns false if the log ends first.
pub(crate) fn read_navigation_for(
    rig: &mut Rig,
    inputs: &mut NavInputs,
    sonar: usize,
    order: &PingOrder,
) -> bool {
    let from = order.transmit_utc;
    let to = from.plus_s(rig.motion_s(sonar, order));
    match rig.spec.nav.mode {
        // Only the samples that a live rig would have when it predicts the ping.
        NavMode::Predict => {
            let known = from.plus_ns(-rig.spec.run.ahead_ns());
            inputs.pull(known, &mut rig.history);
            !inputs.finished()
        }
        NavMode::Settle => {
            // A repeated log has no end. A quantity that two loops do not contain never arrives.
            let mut left = 2 * inputs.recorded_samples();
            loop {
                match rig.history.coverage(from, to) {
                    // The ping lies in a gap; the caller counts it as skipped.
                    Coverage::Ready | Coverage::Missing(_) => return true,
                    Coverage::Waiting => {}
                }
                if left == 0 || !inputs.pull_next(&mut rig.history) {
                    return false;
                }
                left -= 1;
            }
        }
    }
}

/// Calls [`Rig::select_first_methods`] for every sonar with a method selector, for a ping at `first`. Reads the recorded navigation that the selection needs.
pub(crate) fn plan_all(rig: &mut Rig, inputs: &mut NavInputs, first: UtcNs) {
    for sonar in 0..rig.sonars.len() {
        let order = PingOrder {
            ping_number: 1,
            transmit_utc: first,
            settings: SonarSettings {
                pinging: true,
                ..rig.sonars[sonar].spec.settings
            },
            period_s: 0.0,
        };
        if rig.sonars[sonar].method_selector.is_some()
            && read_navigation_for(rig, inputs, sonar, &order)
        {
            rig.select_first_methods(sonar, &order);
        }
    }
    rig.make_starting_engines();
}

/// Builds the thread pool that computes pings.
///
/// `threads` = 0 means one per core. A negative `nice` value is applied to each thread; 0 keeps the parent's.
pub(crate) fn pool_of(
    threads: usize,
    nice: i8,
) -> Result<rayon::ThreadPool, rayon::ThreadPoolBuildError> {
    rayon::ThreadPoolBuilder::new()
        .num_threads(threads)
        .thread_name(|k| format!("ping {k}"))
        .start_handler(move |_| {
            if nice < 0 {
                // The daemon has already warned if the system does not allow it.
                let _ = priority::nice(nice);
            }
        })
        .build()
}

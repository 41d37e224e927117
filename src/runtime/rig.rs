//! A rig with its files: opened from a specification, fed from recorded navigation, computed by threads of its own.

use std::path::Path;

use echotank_config::spec::{NavMode, RigSpec};
use echotank_core::flow::SonarSettings;
use echotank_core::time::UtcNs;
use echotank_nav::Coverage;
use echotank_ping::PingOrder;
use echotank_ping::method_selection::costs::{Costs, CostsError};
use echotank_ping::rig::{Rig, RigError};
use thiserror::Error;

use crate::io::files::FileSystem;
use crate::io::nav::{NavInputs, NavOpenError};
use crate::io::{priority, text_of};

/// Why a rig cannot be opened.
#[derive(Debug, Error)]
pub enum OpenError {
    #[error(transparent)]
    Rig(#[from] RigError),
    #[error("navigation: {0}")]
    Nav(#[from] NavOpenError),
    #[error("run.costs: {path}: {why}")]
    ReadCosts { path: String, why: std::io::Error },
    #[error("run.costs: {0}")]
    Costs(#[from] CostsError),
}

/// Opens the rig of `spec`. To be called inside the pool that will run it.
pub fn open(spec: &RigSpec) -> Result<Rig, OpenError> {
    Ok(Rig::open(
        spec,
        costs_of(spec.run.costs.as_deref())?,
        &FileSystem,
    )?)
}

/// The table of costs in a file, or without one the committed table.
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

/// Reads recorded navigation as far as a ping needs it, whatever the time is; false when the log has ended before.
pub(crate) fn read_on(
    rig: &mut Rig,
    inputs: &mut NavInputs,
    sonar: usize,
    order: &PingOrder,
) -> bool {
    let from = order.transmit_utc;
    let to = from.plus_s(rig.window_s(sonar, order));
    match rig.spec.nav.mode {
        // As it would have been known when the ping had to be foreseen.
        NavMode::Predict => {
            let known = from.plus_ns(-rig.spec.run.ahead_ns());
            inputs.pull(known, &mut rig.history);
            !inputs.finished()
        }
        NavMode::Settle => {
            while rig.history.coverage(from, to) != Coverage::Ready {
                if !inputs.pull_next(&mut rig.history) {
                    return false;
                }
            }
            true
        }
    }
}

/// As [`Rig::plan_first`], of every sonar of a rig whose navigation is recorded and begins at `first`; reads on as far as that needs.
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
        if rig.sonars[sonar].planner.is_some() && read_on(rig, inputs, sonar, &order) {
            rig.plan_first(sonar, &order);
        }
    }
}

/// The threads that compute pings; 0 means as many as there are cores. Their nice value where the system allows it; 0: as whoever makes them.
pub(crate) fn pool_of(
    threads: usize,
    nice: i8,
) -> Result<rayon::ThreadPool, rayon::ThreadPoolBuildError> {
    rayon::ThreadPoolBuilder::new()
        .num_threads(threads)
        .thread_name(|k| format!("ping {k}"))
        .start_handler(move |_| {
            if nice < 0 {
                // What is not allowed was said when the daemon started.
                let _ = priority::nice(nice);
            }
        })
        .build()
}

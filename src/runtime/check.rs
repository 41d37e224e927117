//! Selected methods, findings and verdict of a valid configuration: what `echotank check` reports.

mod verdict;

use thiserror::Error;

use crate::first_pings::{FirstPing, FirstPingError, PeakLevels, first, peak_levels};
use crate::rig::{OpenError, costs_of};
use echotank_config::spec::{RigSpec, SonarSpec};
use echotank_ping::method_selection::costs::Costs;
use echotank_ping::method_selection::{MotionScale, Scene, rank};
use echotank_ping::methods::Ranking;
use echotank_ping::period_ns;
use echotank_ping::threads::pool;

pub use verdict::{findings, text, verdict};

/// A first ping that is estimated to take longer is not computed for its levels.
const MAX_PEAK_PING_MS: f64 = 300.0;
/// Default displacement allowed in images, range cells, if no output carries element samples.
pub const IMAGE_CELLS: f64 = 0.1;

/// Selected methods of one sonar at its first ping.
pub struct SonarSelection<'a> {
    /// Configuration of the sonar.
    pub sonar: &'a SonarSpec,
    /// Plan, scatterers, ranking and cost of its first ping.
    pub first: FirstPing,
    /// Alternative selection with an image tolerance, where [`select_for_pictures`] found one.
    pub for_pictures: Option<Ranking>,
    /// Largest values of the first ping; absent if it takes long.
    pub peaks: Option<PeakLevels>,
    /// Time between pings, milliseconds.
    pub period_ms: f64,
    /// Number of compute threads.
    pub threads: usize,
}

/// Errors of planning the first pings.
#[derive(Debug, Error)]
pub enum CheckError {
    /// The cost table cannot be read.
    #[error(transparent)]
    Costs(#[from] OpenError),
    /// A first ping cannot be planned.
    #[error(transparent)]
    First(#[from] FirstPingError),
    /// The threads for computing cannot be started.
    #[error("threads: {0}")]
    Threads(#[from] rayon::ThreadPoolBuildError),
}

/// Plans the first ping of every sonar.
///
/// # Errors
/// See [`CheckError`].
pub fn select_methods(spec: &RigSpec) -> Result<(Costs, Vec<SonarSelection<'_>>), CheckError> {
    let costs = costs_of(spec.run.costs.as_deref())?;
    let pool = pool(spec.run.threads)?;
    let found = pool.install(|| first(spec, &costs))?;
    let peaks: Vec<_> = spec
        .sonars
        .iter()
        .zip(&found)
        .map(|(sonar, first)| {
            pool.install(|| peak_levels(sonar, &spec.medium, first, MAX_PEAK_PING_MS))
        })
        .collect();
    let threads = pool.current_num_threads();
    let found = found.into_iter().zip(peaks);
    let selections = spec
        .sonars
        .iter()
        .zip(found)
        .map(|(sonar, (first, peaks))| SonarSelection {
            for_pictures: None,
            peaks,
            period_ms: 1e-6
                * period_ns(&first.plan.settings, spec.medium.sound_speed_m_per_s) as f64,
            sonar,
            first,
            threads,
        });
    Ok((costs, selections.collect()))
}

/// Adds a selection with an image tolerance to sonars none of whose outputs carries element samples, although their tolerance refers to them.
///
/// # Errors
/// The threads cannot be started.
pub fn select_for_pictures(
    rig: &RigSpec,
    costs: &Costs,
    selections: &mut [SonarSelection],
) -> Result<(), rayon::ThreadPoolBuildError> {
    let pool = pool(rig.run.threads)?;
    for of in selections {
        of.for_pictures = pool.install(|| for_pictures(rig, of.sonar, &of.first, costs));
    }
    Ok(())
}

fn for_pictures(
    rig: &RigSpec,
    sonar: &SonarSpec,
    first: &FirstPing,
    costs: &Costs,
) -> Option<Ranking> {
    let synthesis = &sonar.synthesis;
    let asked = synthesis.auto.any() && synthesis.image_cells.is_none();
    if !asked || !sonar.element_readers().is_empty() {
        return None;
    }
    let mut spec = sonar.clone();
    spec.synthesis.image_cells = Some(IMAGE_CELLS);
    let scene = Scene {
        spec: &spec,
        medium: &rig.medium,
        plan: &first.plan,
        scatterers: &first.scatterers,
        count: first.scatterers.len(),
        costs,
        motion_scale: MotionScale::NONE,
    };
    rank(&scene, &[])
}

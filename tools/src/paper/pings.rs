//! Pings of a configuration in order, and single echoes through its pipeline.

use echotank_config::spec::RigSpec;
use echotank_core::ping::{PingOutput, PingPlan};
use echotank_core::scene::{Scatterers, Target};
use echotank_ping::threads::pool;
use echotank_testing::pings::LoggedPings;

/// The checked configuration of a figure.
pub(crate) fn load(name: &str) -> Result<RigSpec, String> {
    let file = crate::repository().join("hil-configs/paper").join(name);
    echotank_runtime::config_files::load(&file).map_err(|e| format!("{}: {e:?}", file.display()))
}

/// Parts of a ping that the figures need.
pub(crate) struct RecordedPing {
    pub(crate) plan: PingPlan,
    pub(crate) output: PingOutput,
}

/// Computes pings until the navigation ends. Also returns the targets of the scene.
pub(crate) fn run(spec: &RigSpec) -> Result<(Vec<RecordedPing>, Vec<Target>), String> {
    pool(0)
        .map_err(|e| e.to_string())?
        .install(|| run_here(spec))
}

fn run_here(spec: &RigSpec) -> Result<(Vec<RecordedPing>, Vec<Target>), String> {
    let mut pings = LoggedPings::open(spec)?.ok_or("the navigation has no position")?;
    let mut recorded = Vec::new();
    loop {
        let order = pings.next_order()?;
        if !pings.cover(&order) {
            break;
        }
        pings.make(&order)?;
        let slot = &pings.slot;
        recorded.push(RecordedPing {
            plan: slot.plan.clone(),
            // Element samples are large, and no figure shows them.
            output: PingOutput {
                beams: slot.output.beams.clone(),
                lines: slot.output.lines.clone(),
                ..PingOutput::default()
            },
        });
    }
    if recorded.is_empty() {
        return Err("the navigation ends before the first ping".into());
    }
    Ok((recorded, pings.rig.targets().to_vec()))
}

/// One point of unit strength.
pub(crate) fn point(at_m: glam::DVec3) -> Scatterers {
    echotank_testing::echo::points([at_m])
}

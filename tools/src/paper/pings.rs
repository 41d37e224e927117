//! Pings of a configuration, in order, and single echoes through its pipeline.

use std::sync::Arc;

use echotank_config::spec::{NavMode, RigSpec};
use echotank_core::ping::{PingOutput, PingPlan};
use echotank_core::scene::{Scatterers, Target};
use echotank_nav::Coverage;
use echotank_ping::Schedule;
use echotank_ping::rig::pool;
use echotank_runtime::clock::VirtualClock;
use echotank_runtime::io::nav::NavInputs;

/// The checked configuration of a figure.
pub(crate) fn load(name: &str) -> Result<RigSpec, String> {
    let file = crate::repository().join("hil-configs/paper").join(name);
    echotank_runtime::config_files::load(&file).map_err(|e| format!("{}: {e:?}", file.display()))
}

/// Parts of a ping that the figures need.
pub(crate) struct Heard {
    pub(crate) plan: PingPlan,
    pub(crate) output: PingOutput,
}

/// Makes pings until the navigation ends; also returns the scene's targets.
pub(crate) fn run(spec: &RigSpec) -> Result<(Vec<Heard>, Vec<Target>), String> {
    pool(0)
        .map_err(|e| e.to_string())?
        .install(|| run_here(spec))
}

fn run_here(spec: &RigSpec) -> Result<(Vec<Heard>, Vec<Target>), String> {
    let mut rig = echotank_runtime::rig::open(spec).map_err(|e| e.to_string())?;
    let clock = Arc::new(VirtualClock::default());
    let mut inputs = NavInputs::open(&spec.nav, clock).map_err(|e| e.to_string())?;
    while rig.history.first_usable_utc().is_none() {
        if !inputs.pull_next(&mut rig.history) {
            return Err("the navigation has no position".into());
        }
    }
    let first = rig.history.first_usable_utc().ok_or("no navigation")?;
    let mut schedule = Schedule::starting_at(first, rig.medium().sound_speed_m_per_s);
    let mut slot = rig.slot(0);
    let settings = spec.sonars[0].settings;
    let mut heard = Vec::new();
    'pings: loop {
        let order = schedule
            .due(schedule.next_utc(), |_| settings)
            .ok_or("the sonar does not ping")?;
        let end = order.transmit_utc.plus_s(rig.window_s(0, &order));
        while rig.history.coverage(order.transmit_utc, end) != Coverage::Ready {
            if !inputs.pull_next(&mut rig.history) {
                break 'pings;
            }
        }
        echotank_ping::make_ping(
            &mut rig,
            0,
            &order,
            NavMode::Settle,
            order.transmit_utc,
            &mut slot,
        )
        .map_err(|e| format!("{e:?}"))?;
        heard.push(Heard {
            plan: slot.plan.clone(),
            // Element samples are large and no figure shows them.
            output: PingOutput {
                beams: slot.output.beams.clone(),
                lines: slot.output.lines.clone(),
                ..PingOutput::default()
            },
        });
    }
    if heard.is_empty() {
        return Err("the navigation ends before the first ping".into());
    }
    Ok((heard, rig.targets().to_vec()))
}

/// One point of unit strength.
pub(crate) fn point(at_m: glam::DVec3) -> Scatterers {
    let mut points = Scatterers::default();
    points.push(
        at_m,
        [0.0; 3],
        num_complex::Complex64::ONE,
        echotank_core::scene::ScatterLaw::Point,
    );
    points
}

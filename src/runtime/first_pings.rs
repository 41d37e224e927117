//! The plans of a rig's first pings, without computing any: for `echotank check` and for tools.
//!
//! In: a rig. Out: for each sonar a ping of its own (its plan and scatterers) and the [`Ranking`] made on it. Where navigation is not recorded the
//! motion is supposed.

use glam::{DQuat, DVec3};
use thiserror::Error;

use crate::recorded::{RecordedError, RecordedRig};
use crate::rig::OpenError;
use echotank_config::spec::{AnchorSpec, RigSpec, SonarSpec, VerticalSpec};
use echotank_core::flow::{NavState, PingPlan, Scatterers, SonarSettings, Synthesis};
use echotank_core::frames::Trajectory;
use echotank_core::time::UtcNs;
use echotank_ping::footprints::footprints;
use echotank_ping::method_selection::costs::Costs;
use echotank_ping::method_selection::{Scene, Swell, rank};
use echotank_ping::methods::Ranking;
use echotank_ping::{self as ping, PingOrder};

/// Of a platform whose navigation comes only while it runs: 5 knots, straight ahead, level.
const SUPPOSED_M_PER_S: f64 = 2.572;
/// Pings tried where the first has a gap in its navigation.
const TRIES: u32 = 50;

#[derive(Debug, Error)]
pub enum FirstError {
    #[error(transparent)]
    Recorded(#[from] RecordedError),
    #[error(transparent)]
    Rig(#[from] OpenError),
    #[error("the recorded navigation covers none of the first {TRIES} pings of sonar {0}")]
    Gaps(String),
}

/// One sonar's.
pub struct First {
    pub plan: PingPlan,
    pub scatterers: Scatterers,
    /// None where nothing can be made at all.
    pub ranking: Option<Ranking>,
    /// The motion is not the configuration's.
    pub is_supposed: bool,
}

/// For each sonar. To be called inside the pool that would run it.
pub fn first(spec: &RigSpec, costs: &Costs) -> Result<Vec<First>, FirstError> {
    let pings = pings(spec)?;
    let is_supposed = !spec.nav.is_recorded();
    let sonars = spec.sonars.iter().zip(pings);
    Ok(sonars
        .map(|(sonar, (plan, scatterers))| First {
            ranking: rank(
                &Scene {
                    spec: sonar,
                    medium: &spec.medium,
                    plan: &plan,
                    scatterers: &scatterers,
                    count: scatterers.len(),
                    costs,
                    swell: Swell::NONE,
                },
                &[],
            ),
            plan,
            scatterers,
            is_supposed,
        })
        .collect())
}

/// For each sonar a ping with what it hears, down to the configuration's own floor of the patterns.
pub fn pings(spec: &RigSpec) -> Result<Vec<(PingPlan, Scatterers)>, FirstError> {
    match RecordedRig::open(&bare(spec)) {
        Ok(recorded) => recorded_pings(recorded),
        Err(RecordedError::NoLog) => supposed_pings(&bare(spec)),
        Err(other) => Err(other.into()),
    }
}

/// Hears what the sonars hear, with pipelines that cost nothing to make.
fn bare(spec: &RigSpec) -> RigSpec {
    let mut spec = spec.clone();
    for sonar in &mut spec.sonars {
        sonar.model.synthesis = Synthesis::Direct;
        sonar.synthesis.error_check = false;
        sonar.synthesis.auto = Default::default();
        sonar.synthesis.output = Default::default();
        sonar.beams = Default::default();
        sonar.more_pulses.clear();
    }
    spec.faults.clear();
    spec
}

fn recorded_pings(mut recorded: RecordedRig) -> Result<Vec<(PingPlan, Scatterers)>, FirstError> {
    let sonars = recorded.rig.sonars.len();
    let mode = recorded.rig.spec.nav.mode;
    let mut found: Vec<Option<(PingPlan, Scatterers)>> = vec![None; sonars];
    while let Some((sonar, order)) = recorded.next_order(TRIES) {
        if found[sonar].is_some() {
            continue;
        }
        if !recorded.settle(sonar, &order) {
            break;
        }
        let mut slot = recorded.rig.slot(sonar);
        let rig = &mut recorded.rig;
        if rig
            .prepare(sonar, &order, mode, UtcNs(0), &mut slot)
            .is_ok()
        {
            found[sonar] = Some((slot.plan, rig.scatterers().clone()));
        }
        if found.iter().all(Option::is_some) {
            break;
        }
    }
    let names = recorded.rig.sonars.iter().map(|unit| &unit.spec.name);
    names
        .zip(found)
        .map(|(name, ping)| ping.ok_or_else(|| FirstError::Gaps(name.clone())))
        .collect()
}

fn supposed_pings(spec: &RigSpec) -> Result<Vec<(PingPlan, Scatterers)>, FirstError> {
    let mut rig = crate::rig::open(spec)?;
    let place = rig.scene.geodetic_place().map(|p| (p.north_m, p.east_m));
    let (north_m, east_m) = match (spec.scene.anchor, place) {
        (AnchorSpec::File, Some((north_m, east_m))) => (-north_m, -east_m),
        _ => (0.0, 0.0),
    };
    rig.scene.place(north_m, east_m);
    let down_m = match spec.nav.vertical {
        VerticalSpec::Waterline { reference_down_m } => reference_down_m,
        _ => 0.0,
    };
    let mut pings = Vec::new();
    for sonar in 0..rig.sonars.len() {
        let mut slot = rig.slot(sonar);
        let unit = &rig.sonars[sonar];
        let order = PingOrder {
            ping_number: 1,
            transmit_utc: UtcNs(0),
            settings: SonarSettings {
                pinging: true,
                ..unit.spec.settings
            },
            period_s: 0.0,
        };
        slot.plan.trajectory = Trajectory::uniform(
            DVec3::new(0.0, 0.0, down_m),
            DVec3::X * SUPPOSED_M_PER_S,
            DQuat::IDENTITY,
        );
        let spec: SonarSpec = unit.spec.clone();
        ping::fill(&mut slot.plan, &spec, &order, NavState::default(), UtcNs(0));
        let mut heard = Vec::new();
        footprints(&spec, &slot.plan, &mut heard);
        let mut scatterers = Scatterers::default();
        rig.scene.gather(&heard, &mut scatterers);
        pings.push((slot.plan, scatterers));
    }
    Ok(pings)
}

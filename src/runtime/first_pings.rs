//! Plans each sonar's first ping without computing it, for `echotank check` and for tools.
//!
//! For each sonar, the result contains the plan, its scatterers, the [`Ranking`] of the methods and the cost of a ping. Without recorded navigation, a
//! uniform motion is assumed. The first ping makes all tiles of the seabed around it; what a ping under way makes is counted on the one after it.

use glam::{DQuat, DVec3};
use thiserror::Error;

use crate::recorded::{RecordedError, RecordedRig};
use crate::rig::OpenError;
use echotank_config::spec::{AnchorSpec, MediumSpec, RigSpec, SonarSpec, VerticalSpec};
use echotank_core::arrays::{ReceiverFilter, TimeVaryingGain};
use echotank_core::frames::Trajectory;
use echotank_core::model::Synthesis;
use echotank_core::navigation::NavState;
use echotank_core::ping::{PingPlan, SceneCounts};
use echotank_core::scene::Scatterers;
use echotank_core::settings::SonarSettings;
use echotank_core::time::{NS_PER_S, UtcNs};
use echotank_ping::footprints::footprints;
use echotank_ping::method_selection::costs::Costs;
use echotank_ping::method_selection::{MotionScale, Scene, rank, with_choice};
use echotank_ping::methods::Ranking;
use echotank_ping::ping_cost::PingCost;
use echotank_ping::pipeline::SonarPipeline;
use echotank_ping::rig::PingSlot;
use echotank_ping::schedule::period_ns;
use echotank_ping::{self as ping, PingOrder, RangeFloorFinder};

/// Speed assumed without recorded navigation: 5 knots, straight ahead and level.
const ASSUMED_M_PER_S: f64 = 2.572;
/// Number of pings tried if the first has a gap in its navigation.
const TRIES: u32 = 50;

/// Errors of planning a first ping.
#[derive(Debug, Error)]
pub enum FirstPingError {
    /// The rig or its recorded navigation cannot be opened.
    #[error(transparent)]
    Recorded(#[from] RecordedError),
    /// The rig cannot be opened.
    #[error(transparent)]
    Rig(#[from] OpenError),
    /// The navigation has a gap at each of these pings of the named sonar.
    #[error("the recorded navigation covers none of {TRIES} successive pings of sonar {0}")]
    Gaps(String),
}

/// First ping of one sonar.
pub struct FirstPing {
    /// Plan of the ping.
    pub plan: PingPlan,
    /// Scatterers in the footprint of the ping.
    pub scatterers: Scatterers,
    /// Counts of the next ping's scene.
    pub scene: SceneCounts,
    /// Candidate methods; `None` if no method applies.
    pub ranking: Option<Ranking>,
    /// Cost of a ping with the chosen methods.
    pub cost: Option<PingCost>,
    /// Whether the motion is assumed, because the navigation is not recorded.
    pub is_supposed: bool,
}

/// Plans the first ping of each sonar and ranks the methods. Call inside the thread pool that would run the rig.
///
/// # Errors
/// The rig cannot be opened, or the navigation covers none of the first 50 pings of a sonar.
pub fn first(spec: &RigSpec, costs: &Costs) -> Result<Vec<FirstPing>, FirstPingError> {
    let pings = planned(spec, 0)?;
    let is_supposed = !spec.nav.is_recorded();
    let sonars = spec.sonars.iter().zip(pings);
    Ok(sonars
        .map(|(sonar, planned)| {
            let Planned {
                plan,
                scatterers,
                scene,
            } = planned;
            let ranking = rank(
                &Scene {
                    spec: sonar,
                    medium: &spec.medium,
                    plan: &plan,
                    scatterers: &scatterers,
                    count: scatterers.len(),
                    costs,
                    motion_scale: MotionScale::NONE,
                },
                &[],
            );
            let cost = ranking.as_ref().map(|ranking| {
                let chosen = ranking.chosen();
                let sonar = with_choice(sonar, &chosen.choice);
                PingCost::new(&sonar, &plan, &scene, chosen.cost_ms(), costs)
            });
            FirstPing {
                plan,
                scatterers,
                scene,
                ranking,
                cost,
                is_supposed,
            }
        })
        .collect())
}

/// Largest values of a ping, volts.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct PeakLevels {
    /// I or Q of an element sample.
    pub element_v: f64,
    /// Magnitude of a beam sample.
    pub beam_v: f64,
    /// Sample of a side-scan line.
    pub line_v: f64,
}

/// Samples of echoes that the direct sum adds for the levels of a ping, at most: a second of one core, as long as an engine for long pulses takes to be made.
/// The lines of a fan have short pulses, and engines that are made sooner.
const MAX_DIRECT_SAMPLES: f64 = 2e8;
const MAX_DIRECT_SAMPLES_OF_FAN: f64 = 3e7;

/// Computes the first ping of `sonar` with noise and gain, but without converter: by the direct sum, or by the chosen methods where that takes too long.
/// `None` without methods, or if their estimated time on the threads of the current pool exceeds `max_ms`.
pub fn peak_levels(
    sonar: &SonarSpec,
    medium: &MediumSpec,
    first: &FirstPing,
    max_ms: f64,
) -> Option<PeakLevels> {
    let choice = &first.ranking.as_ref()?.chosen().choice;
    let mut plan = first.plan.clone();
    let elements: usize = sonar.receive.iter().map(|array| array.elements).sum();
    let echoes = (first.scatterers.len() * elements * (1 + sonar.more_pulses.len())) as f64;
    let max_samples = match sonar.beams.fan {
        Some(_) => MAX_DIRECT_SAMPLES_OF_FAN,
        None => MAX_DIRECT_SAMPLES,
    };
    let mut spec = sonar.clone();
    if echoes * plan.pulse.duration_s * sonar.receiver.sample_rate_hz <= max_samples {
        // No engine needs to be made for one ping; the receiver filter leaves levels as they are.
        spec.model = choice.model;
        spec.model.synthesis = Synthesis::Direct;
        spec.receiver.filter = ReceiverFilter::None;
    } else if first.cost.as_ref()?.wall_ms(rayon::current_num_threads()) <= max_ms {
        spec = with_choice(sonar, choice);
    } else {
        return None;
    }
    spec.synthesis.error_check = false;
    spec.receiver.adc_bits = None;
    if let TimeVaryingGain::Law {
        absorption_db_per_m,
        ..
    } = &mut spec.receiver.tvg
    {
        *absorption_db_per_m = plan.absorption_db_per_m;
    }
    plan.model = spec.model;
    let window_s = plan.window_s(spec.receiver.sample_rate_hz);
    let segment_s = spec.model.segment_s;
    ping::polyline(&plan.trajectory, window_s, segment_s, &mut plan.segments);
    let mut pipeline = SonarPipeline::new(&spec, medium).ok()?;
    let mut output = pipeline.blank_output();
    pipeline.compute_ping(&plan, &first.scatterers, &mut output);
    let largest = |values: &mut dyn Iterator<Item = f64>| values.fold(0.0, f64::max);
    let elements = output.elements.iter().flat_map(|frame| &frame.iq);
    let beams = output.beams.iter().flat_map(|frame| &frame.iq);
    let further = output.more_lines.iter().flat_map(|pulse| &pulse.lines);
    let lines = output.lines.iter().chain(further);
    let lines = lines.flat_map(|line| &line.amplitude);
    Some(PeakLevels {
        element_v: largest(&mut elements.map(|v| v.re.abs().max(v.im.abs()))),
        beam_v: f64::from(beams.map(|v| v.norm_sqr()).fold(0.0, f32::max)).sqrt(),
        line_v: largest(&mut lines.map(|&v| f64::from(v))),
    })
}

/// First ping of a sonar.
struct Planned {
    plan: PingPlan,
    scatterers: Scatterers,
    /// Of the next ping.
    scene: SceneCounts,
}

/// Plan of each sonar's first ping after the first `passed` ones, with the scatterers in its footprint, culled at the configured level.
///
/// # Errors
/// See [`first`].
pub fn pings(spec: &RigSpec, passed: u32) -> Result<Vec<(PingPlan, Scatterers)>, FirstPingError> {
    let planned = planned(spec, passed)?.into_iter();
    Ok(planned.map(|ping| (ping.plan, ping.scatterers)).collect())
}

fn planned(spec: &RigSpec, passed: u32) -> Result<Vec<Planned>, FirstPingError> {
    match RecordedRig::open(&bare(spec)) {
        Ok(recorded) => recorded_pings(recorded, passed),
        Err(RecordedError::NoLog) => assumed_pings(&bare(spec), passed),
        Err(other) => Err(other.into()),
    }
}

/// Specification with the same footprints and with pipelines that are cheap to build.
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

fn recorded_pings(mut recorded: RecordedRig, passed: u32) -> Result<Vec<Planned>, FirstPingError> {
    let sonars = recorded.rig.sonars.len();
    let mode = recorded.rig.spec.nav.mode;
    let mut found: Vec<Option<Planned>> = (0..sonars).map(|_| None).collect();
    let mut under_way = vec![false; sonars];
    while let Some((sonar, order)) = recorded.next_order(passed + TRIES) {
        if under_way[sonar] {
            continue;
        }
        if !recorded.settle(sonar, &order) {
            break;
        }
        if order.ping_number <= passed {
            continue;
        }
        let mut slot = recorded.rig.slot(sonar);
        let rig = &mut recorded.rig;
        if rig
            .prepare(sonar, &order, mode, UtcNs(0), &mut slot)
            .is_err()
        {
            continue;
        }
        match &mut found[sonar] {
            Some(planned) => {
                planned.scene = slot.output.scene;
                under_way[sonar] = true;
            }
            none => {
                *none = Some(Planned {
                    plan: slot.plan,
                    scatterers: rig.scatterers().clone(),
                    scene: slot.output.scene,
                });
            }
        }
        if under_way.iter().all(|&is| is) {
            break;
        }
    }
    let names = recorded.rig.sonars.iter().map(|unit| &unit.spec.name);
    names
        .zip(found)
        .map(|(name, ping)| ping.ok_or_else(|| FirstPingError::Gaps(name.clone())))
        .collect()
}

fn assumed_pings(spec: &RigSpec, passed: u32) -> Result<Vec<Planned>, FirstPingError> {
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
            ping_number: passed + 1,
            transmit_utc: UtcNs(0),
            settings: SonarSettings {
                pinging: true,
                ..unit.spec.settings
            },
            period_s: 0.0,
        };
        let spec: SonarSpec = unit.spec.clone();
        let period_ns = period_ns(&spec.settings, rig.medium().sound_speed_m_per_s);
        let step_m = ASSUMED_M_PER_S * period_ns as f64 / NS_PER_S as f64;
        let mut gather = |at_m: f64, slot: &mut PingSlot| {
            slot.plan.trajectory = Trajectory::uniform(
                DVec3::new(at_m, 0.0, down_m),
                DVec3::X * ASSUMED_M_PER_S,
                DQuat::IDENTITY,
            );
            let altitude_m = rig.scene.seabed_down_m(at_m, 0.0).map(|z_m| z_m - down_m);
            slot.plan.sensor.altitude_m = altitude_m.filter(|a| *a > 0.0);
            slot.plan.sound_speed_m_per_s = rig.medium().sound_speed_m_per_s;
            ping::fill(&mut slot.plan, &spec, &order, NavState::default(), UtcNs(0));
            rig.set_water(&mut slot.plan);
            let mut areas = Vec::new();
            footprints(&spec, &slot.plan, &mut areas);
            let mut scatterers = Scatterers::default();
            let areas = rig.widen(&slot.plan, &areas).to_vec();
            let mut scene = rig.scene.gather(&areas, &mut scatterers);
            rig.append_moving(&slot.plan, &mut scatterers, &mut scene);
            rig.add_surface(&slot.plan, &mut scatterers, &mut scene);
            rig.append_volume(&slot.plan, &mut scatterers, &mut scene);
            rig.propagate(&mut slot.plan, &mut scatterers, &mut scene);
            RangeFloorFinder::default().find(&spec, &mut slot.plan, &scatterers);
            (slot.plan.clone(), scatterers, scene)
        };
        let (plan, scatterers, _) = gather(f64::from(passed) * step_m, &mut slot);
        let (_, _, scene) = gather(f64::from(passed + 1) * step_m, &mut slot);
        pings.push(Planned {
            plan,
            scatterers,
            scene,
        });
    }
    Ok(pings)
}

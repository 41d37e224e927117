//! `gridded-2d` for a sonar: an engine for each receive array, a whole line of elements at a time.
//!
//! Made once, for the longest pulse and the fastest platform. A pulse of another length rebuilds an engine's tables inside the first ping that
//! has it.

use std::sync::Mutex;

use glam::DVec3;
use num_complex::Complex64;

use crate::engines::LEVEL_RANGE_DB;
use crate::plan;
use echotank_config::spec::SonarSpec;
use echotank_core::arrays::ArrayGeometry;
use echotank_core::ping::{EchoCounts, PingPlan};
use echotank_core::pulse::Pulse;
use echotank_core::simd::SimdLevel;
use echotank_synthesis::array::filter::Decimator;
use echotank_synthesis::array::gridded2d::{Bounds, Choice, Gridded2d, Refusal, Spec, choose};
use echotank_synthesis::echo::walk::{LineEchoes, LineWorkspace, TransmitLeg};
use echotank_synthesis::error_model::ErrorModel;

/// Platforms turn no faster, rad/s: a roll of 10 degrees in 5 s.
const FASTEST_TURN_RAD_PER_S: f64 = 0.25;

/// Across a line, m/s: what a ship sways and heaves. How much more a line can follow depends on the pulse and on where echoes come from, so it
/// is measured ping by ping, and pings that leave out too much are counted.
pub(crate) const SIDEWAYS_M_PER_S: f64 = 0.5;

/// For which an engine's sizes are chosen; with fewer or more it is as right, and nearly as fast.
pub(crate) const NOMINAL_SCATTERERS: usize = 300_000;

/// What the engine's bound on its series may be, in tolerances: eight of them that each leave less than half of it, all at their peaks at
/// once. A ping above that was beyond what the engine is made for.
const SERIES: f64 = 4.0;

/// One engine per receive array.
pub(crate) struct LineEngines {
    engines: Vec<Gridded2d>,
    /// One per thread of the pool: no lock ever waits.
    work: Vec<Mutex<LineWorkspace>>,
    tolerance: f64,
}

/// The longest pulse within the limits.
fn longest(spec: &SonarSpec) -> Pulse {
    Pulse {
        duration_s: spec.limits.pulse_duration_s.1,
        ..spec.pulse
    }
}

fn wanted<'a>(
    spec: &'a SonarSpec,
    array: &'a ArrayGeometry,
    longest: &'a Pulse,
    sound_speed_m_per_s: f64,
    fastest_m_per_s: f64,
    filter: Option<&'a Decimator>,
    scatterers: usize,
) -> Spec<'a> {
    let along = (array.mounting.body_from_array * DVec3::X).x.abs();
    Spec {
        array,
        pulse: longest,
        sound_speed_m_per_s,
        sample_rate_hz: spec.receiver.sample_rate_hz,
        filter,
        model: &spec.model,
        bounds: Bounds {
            nearest_m: spec.synthesis.nearest_m,
            greatest_slope: 1.0,
            along_m_per_s: along * fastest_m_per_s,
            across_m_per_s: SIDEWAYS_M_PER_S,
            turning_rad_per_s: FASTEST_TURN_RAD_PER_S,
        },
        tolerance: spec.synthesis.design_tolerance(),
        level_range_db: LEVEL_RANGE_DB,
        samples: plan::sample_count(
            &spec.settings,
            sound_speed_m_per_s,
            spec.receiver.sample_rate_hz,
        ),
        scatterers,
        simd_level: SimdLevel::best(),
    }
}

/// What engines would be made, one per receive array, without making them.
pub(crate) fn choices(
    spec: &SonarSpec,
    sound_speed_m_per_s: f64,
    fastest_m_per_s: f64,
    filter: Option<&Decimator>,
    scatterers: usize,
) -> Result<Vec<Choice>, Refusal> {
    if filter.is_none() {
        return Err(Refusal::NoFilter);
    }
    let longest = longest(spec);
    let choice = |array: &ArrayGeometry| {
        choose(&wanted(
            spec,
            array,
            &longest,
            sound_speed_m_per_s,
            fastest_m_per_s,
            filter,
            scatterers,
        ))
    };
    spec.receive.iter().map(choice).collect()
}

impl LineEngines {
    /// To be made inside the pool that will run it. `segments`: of the longest polyline.
    pub(crate) fn new(
        spec: &SonarSpec,
        sound_speed_m_per_s: f64,
        fastest_m_per_s: f64,
        filter: Option<&Decimator>,
        segments: usize,
    ) -> Result<Self, Refusal> {
        let longest = longest(spec);
        let engine = |array: &ArrayGeometry| {
            Gridded2d::new(&wanted(
                spec,
                array,
                &longest,
                sound_speed_m_per_s,
                fastest_m_per_s,
                filter,
                NOMINAL_SCATTERERS,
            ))
        };
        Ok(Self {
            engines: spec.receive.iter().map(engine).collect::<Result<_, _>>()?,
            work: (0..rayon::current_num_threads())
                .map(|_| Mutex::new(LineWorkspace::with_room_for(segments)))
                .collect(),
            tolerance: spec.synthesis.design_tolerance(),
        })
    }

    /// One per receive array.
    pub(crate) fn error_models(&self) -> impl Iterator<Item = &ErrorModel> {
        self.engines.iter().map(Gridded2d::error_model)
    }

    /// The samples of receive array `index`, element-major. Where a ping was nearer or faster than the engine is made for, by more than the
    /// tolerance bears, all its echoes are counted as beyond it.
    pub(crate) fn synthesise(
        &mut self,
        plan: &PingPlan,
        spec: &SonarSpec,
        index: usize,
        transmit_leg: &TransmitLeg,
        iq: &mut [Complex64],
    ) -> EchoCounts {
        let engine = &mut self.engines[index];
        let echoes = LineEchoes {
            plan,
            array: &spec.receive[index],
            transmit_leg,
            work: &self.work,
        };
        let mut counts = engine.synthesise(plan, &echoes, iq);
        if engine.left_out() > SERIES * self.tolerance {
            counts.beyond_engine = counts.used;
        }
        counts
    }
}

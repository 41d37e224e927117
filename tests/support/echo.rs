//! Sonar, plan and sink for the tests of the echo model.

use echotank_core::arrays::{ArrayGeometry, Mounting, Pattern, TransmitArray};
use echotank_core::frames::{Trajectory, rotation_from_angles};
use echotank_core::navigation::NavState;
use echotank_core::ping::{EchoCounts, PingPlan, Segment};
use echotank_core::pulse::{Pulse, PulseKind};
use echotank_core::scene::{ScatterLaw, Scatterers};
use echotank_core::settings::SonarSettings;
use echotank_core::testing::plan_at_rest;
use echotank_synthesis::arrivals::{ArrivalChunk, ArrivalSink};
use echotank_synthesis::echo::{TransmitLeg, Window, Workspace, arrivals, insonify};
use glam::{DQuat, DVec3};
use num_complex::Complex64;

pub const C: f64 = 1500.0;
pub const CARRIER_HZ: f64 = 400e3;
pub const WAVELENGTH_M: f64 = C / CARRIER_HZ;

pub fn lfm(bandwidth_hz: f64, duration_s: f64) -> Pulse {
    Pulse {
        kind: PulseKind::LfmUp,
        center_frequency_hz: CARRIER_HZ,
        bandwidth_hz,
        duration_s,
        taper: 0.0,
    }
}

pub fn cw(duration_s: f64) -> Pulse {
    Pulse {
        kind: PulseKind::Cw,
        bandwidth_hz: 0.0,
        ..lfm(0.0, duration_s)
    }
}

/// Plan in uniform motion: polyline with one segment, stretch, absorption 0.05 dB/m, unit source level.
pub fn uniform(position_m: DVec3, velocity_m_per_s: DVec3, world_from_body: DQuat) -> PingPlan {
    let trajectory = Trajectory::uniform(position_m, velocity_m_per_s, world_from_body);
    let pose = trajectory.pose_at(0.0);
    PingPlan {
        ping_period_s: 0.5,
        settings: SonarSettings {
            pinging: true,
            range_m: 200.0,
            max_ping_rate_hz: 10.0,
            source_level_db: 0.0,
            gain_db: 0.0,
            pulse_duration_s: 5e-3,
        },
        ping_rate_hz: 2.0,
        absorption_db_per_m: 0.05,
        nav: NavState {
            pose,
            ..NavState::default()
        },
        trajectory,
        segments: vec![Segment {
            start_s: 0.0,
            position_m,
            velocity_m_per_s,
            world_from_body,
        }],
        ..plan_at_rest(&lfm(30e3, 5e-3), 0, C)
    }
}

/// Plan of a level platform from the world's origin along x (north) at `speed_m_per_s`.
pub fn ahead(speed_m_per_s: f64) -> PingPlan {
    uniform(DVec3::ZERO, DVec3::X * speed_m_per_s, DQuat::IDENTITY)
}

/// Replaces the polyline by `count` chords of the trajectory over `span_s`, with the attitude at each chord's middle.
pub fn chords(plan: &mut PingPlan, span_s: f64, count: usize) {
    let step_s = span_s / count as f64;
    let place_m = |k: usize| plan.trajectory.pose_at(k as f64 * step_s).position_m;
    plan.segments = (0..count)
        .map(|k| Segment {
            start_s: k as f64 * step_s,
            position_m: place_m(k),
            velocity_m_per_s: (place_m(k + 1) - place_m(k)) / step_s,
            world_from_body: plan
                .trajectory
                .pose_at((k as f64 + 0.5) * step_s)
                .world_from_body,
        })
        .collect();
    plan.model.segment_s = step_s;
}

pub fn mounting(position_m: DVec3) -> Mounting {
    Mounting {
        position_m,
        body_from_array: DQuat::IDENTITY,
    }
}

pub fn transmitter(position_m: DVec3) -> TransmitArray {
    TransmitArray {
        mounting: mounting(position_m),
        pattern: Pattern::Omnidirectional,
        level_offset_db: 0.0,
    }
}

/// One omnidirectional element.
pub fn element(position_m: DVec3) -> ArrayGeometry {
    line(position_m, 1)
}

pub fn line(position_m: DVec3, elements: usize) -> ArrayGeometry {
    ArrayGeometry {
        mounting: mounting(position_m),
        elements,
        spacing_m: WAVELENGTH_M / 2.0,
        radius_m: None,
        element_pattern: Pattern::Omnidirectional,
        sensitivity_db: 0.0,
        transmit: 0,
    }
}

/// Orientation to starboard, 30 degrees below the horizon.
pub fn starboard() -> DQuat {
    rotation_from_angles(-60f64.to_radians(), 0.0, 0.0)
}

pub fn points(positions_m: impl IntoIterator<Item = DVec3>) -> Scatterers {
    let mut scatterers = Scatterers::default();
    for position_m in positions_m {
        scatterers.push(position_m, [0.0; 3], Complex64::ONE, ScatterLaw::Point);
    }
    scatterers
}

#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Arrival {
    pub delay_s: f64,
    pub doppler: f64,
    pub curvature_per_s: f64,
    pub amplitude: Complex64,
}

/// Sink that collects every echo.
#[derive(Default)]
pub struct Collected {
    pub arrivals: Vec<Arrival>,
    pub chunks: Vec<usize>,
}

impl ArrivalSink for Collected {
    fn accept(&mut self, chunk: &ArrivalChunk) {
        self.chunks.push(chunk.len);
        for i in 0..chunk.len {
            self.arrivals.push(Arrival {
                delay_s: chunk.delay_s[i],
                doppler: chunk.doppler[i],
                curvature_per_s: chunk.curvature_per_s[i],
                amplitude: chunk.amplitude[i],
            });
        }
    }
}

/// Unlimited listening window.
pub const ALWAYS: Window = Window {
    first_s: 0.0,
    last_s: 1e3,
};

pub fn collect(
    plan: &PingPlan,
    tx: &TransmitArray,
    array: &ArrayGeometry,
    element: usize,
    window: Window,
    scatterers: &Scatterers,
) -> (Collected, EchoCounts) {
    let mut sink = Collected::default();
    let counts = walk(plan, tx, array, element, window, scatterers, &mut sink);
    (sink, counts)
}

pub fn walk(
    plan: &PingPlan,
    tx: &TransmitArray,
    array: &ArrayGeometry,
    element: usize,
    window: Window,
    scatterers: &Scatterers,
    sink: &mut impl ArrivalSink,
) -> EchoCounts {
    let mut transmit_leg = TransmitLeg::new();
    let mut counts = insonify(plan, tx, window, scatterers, &mut transmit_leg);
    counts += arrivals(
        plan,
        array,
        element,
        &transmit_leg,
        &mut Workspace::new(),
        sink,
    );
    counts
}

/// Quasi-random numbers in 0..1, the same on every machine (a Weyl sequence).
pub fn weyl(k: usize, which: usize) -> f64 {
    const STEPS: [f64; 4] = [
        0.754_877_666_246_693,
        0.569_840_290_998_053,
        0.618_033_988_749_895,
        0.324_717_957_244_746,
    ];
    (0.5 + k as f64 * STEPS[which]).fract()
}

/// Relative l2 error |got - want| / |want| over whole records.
pub fn relative_l2(got: &[Complex64], want: &[Complex64]) -> f64 {
    let difference: f64 = got.iter().zip(want).map(|(a, b)| (a - b).norm_sqr()).sum();
    let size: f64 = want.iter().map(|b| b.norm_sqr()).sum();
    (difference / size).sqrt()
}

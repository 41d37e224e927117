//! Table of the errors of path and Doppler models: one point and one element, over speed and angle.

use echotank_core::arrays::{ArrayGeometry, TransmitArray};
use echotank_core::model::{DopplerModel, ModelChoice, PathModel, Synthesis};
use echotank_core::ping::PingPlan;
use echotank_core::pulse::{Pulse, PulseKind};
use echotank_core::scene::Scatterers;
use echotank_core::settings::SonarSettings;
use echotank_synthesis::array::Direct;
use echotank_synthesis::arrivals::{ArrivalChunk, ArrivalSink};
use echotank_synthesis::echo::{Window, reference};
use echotank_testing::echo as rig;
use glam::{DQuat, DVec3};
use num_complex::Complex64;
use serde::Serialize;

pub(crate) const C: f64 = 1500.0;
/// Sample rate, Hz: more than twice the band, so that both a chirp and its shifted copy are sampled fully.
const RATE_HZ: f64 = 80e3;
/// Maximum element-level error that passes.
pub(crate) const TOLERANCE: f64 = 1e-3;

/// Error below which errors are treated as equal.
const ROUNDING: f64 = 1e-9;

pub(crate) struct Method {
    pub(crate) name: &'static str,
    pub(crate) path: PathModel,
    pub(crate) doppler: DopplerModel,
}

/// Compared models, relative to the reference.
pub(crate) const METHODS: [Method; 5] = [
    method("paper-eq21", PathModel::Polyline, DopplerModel::PaperEq21),
    method("stop-and-hop", PathModel::StopAndHop, DopplerModel::None),
    method("none", PathModel::Polyline, DopplerModel::None),
    method("stretch", PathModel::Polyline, DopplerModel::Stretch),
    method(
        "stretch-quadratic",
        PathModel::Polyline,
        DopplerModel::StretchQuadratic,
    ),
];

const fn method(name: &'static str, path: PathModel, doppler: DopplerModel) -> Method {
    Method {
        name,
        path,
        doppler,
    }
}

#[derive(Clone, Copy, Serialize)]
pub(crate) struct Case {
    pub(crate) speed_m_per_s: f64,
    pub(crate) range_m: f64,
    /// Angle from the track: 0 is straight ahead.
    pub(crate) angle_deg: f64,
}

/// Speeds, ranges and angles of the full table.
pub(crate) fn cases() -> Vec<Case> {
    let mut cases = Vec::new();
    for range_m in [36.0, 250.0] {
        for speed_m_per_s in [0.1, 1.0, 2.572, 5.144, 10.0] {
            for angle_deg in [0.0, 30.0, 60.0, 90.0, 120.0, 180.0] {
                cases.push(Case {
                    speed_m_per_s,
                    range_m,
                    angle_deg,
                });
            }
        }
    }
    cases
}

pub(crate) fn heading() -> String {
    let mut lines = format!("{:>5} {:>6} {:>5}", "m", "m/s", "deg");
    for method in &METHODS {
        lines += &format!(" | {:^23}", method.name);
    }
    lines += &format!("\n{:>5} {:>6} {:>5}", "", "", "");
    for _ in &METHODS {
        lines += &format!(" | {:>8} {:>7} {:>6}", "range m", "error", "");
    }
    lines
}

/// One line of the table: for each method, the range error of the echo, the relative error of its samples, and whether it
/// passes.
pub(crate) fn row(case: Case, measured: &[(f64, f64)]) -> String {
    let mut line = format!(
        "{:>5} {:>6} {:>5}",
        case.range_m, case.speed_m_per_s, case.angle_deg
    );
    for &(range_error_m, error) in measured {
        let verdict = if error <= TOLERANCE { "pass" } else { "fail" };
        // Range errors below half a millimetre are shown as 0, without a sign.
        let range_error_m = if range_error_m.abs() < 5e-4 {
            0.0
        } else {
            range_error_m
        };
        // The remaining error is rounding of delays.
        let error = if error < ROUNDING {
            format!("<{ROUNDING:.0e}")
        } else {
            format!("{error:.1e}")
        };
        line += &format!(" | {range_error_m:>+8.3} {error:>7} {verdict:>6}");
    }
    line
}

/// Range error of the leading edge, metres one way, and relative l2 error of the samples over the echo and 3 ms on either side.
pub(crate) fn measure(method: &Method, case: Case) -> (f64, f64) {
    let (sin, cos) = case.angle_deg.to_radians().sin_cos();
    let at_m = DVec3::new(case.range_m * cos, case.range_m * sin, 0.0);
    let scatterers = rig::points([at_m]);
    let mut plan = plan(case);
    let exact_s = leading_s(&plan, &scatterers);
    plan.model.path = method.path;
    plan.model.doppler = method.doppler;
    let got_s = leading_s(&plan, &scatterers);

    let (tx, rx) = sonar();
    let first_s = exact_s - 3e-3;
    let count = ((plan.pulse.duration_s + 6e-3) * RATE_HZ) as usize;
    let mut want = vec![Complex64::ZERO; count];
    reference(
        &plan,
        &tx,
        &rx,
        0,
        &scatterers,
        None,
        RATE_HZ,
        first_s,
        &mut want,
    );
    let mut got = vec![Complex64::ZERO; count];
    let window = Window::of_samples(first_s, RATE_HZ, count);
    let mut sink = Direct::new(&plan, RATE_HZ, first_s, &mut got);
    rig::walk(&plan, &tx, &rx, 0, window, &scatterers, &mut sink);
    (0.5 * C * (got_s - exact_s), rig::relative_l2(&got, &want))
}

pub(crate) fn sonar() -> (TransmitArray, ArrayGeometry) {
    (rig::transmitter(DVec3::ZERO), rig::element(DVec3::ZERO))
}

/// Sink that keeps the leading edge of the last echo.
struct LeadingEdge(f64);

impl ArrivalSink for LeadingEdge {
    fn accept(&mut self, chunk: &ArrivalChunk) {
        self.0 = chunk.delay_s[chunk.len - 1];
    }
}

fn leading_s(plan: &PingPlan, scatterers: &Scatterers) -> f64 {
    let always = Window {
        first_s: 0.0,
        last_s: 10.0,
    };
    let mut edge = LeadingEdge(f64::NAN);
    let (tx, rx) = sonar();
    rig::walk(plan, &tx, &rx, 0, always, scatterers, &mut edge);
    edge.0
}

/// Plan with the pulse of the paper (400 kHz, 30 kHz, 5 ms, with tapers of a twentieth at each end), straight ahead along x.
pub(crate) fn plan(case: Case) -> PingPlan {
    let velocity_m_per_s = DVec3::X * case.speed_m_per_s;
    PingPlan {
        ping_period_s: 1.0,
        settings: SonarSettings {
            pinging: true,
            range_m: case.range_m,
            max_ping_rate_hz: 1.0,
            source_level_db: 0.0,
            gain_db: 0.0,
            pulse_duration_s: 5e-3,
        },
        ping_rate_hz: 1.0,
        pulse: Pulse {
            kind: PulseKind::LfmUp,
            center_frequency_hz: 400e3,
            bandwidth_hz: 30e3,
            duration_s: 5e-3,
            taper: 0.1,
        },
        sound_speed_m_per_s: C,
        absorption_db_per_m: 0.0,
        model: ModelChoice {
            path: PathModel::Continuous,
            doppler: DopplerModel::Stretch,
            synthesis: Synthesis::Direct,
            segment_s: 10.0,
            cull_db: None,
        },
        ..rig::uniform(DVec3::ZERO, velocity_m_per_s, DQuat::IDENTITY)
    }
}

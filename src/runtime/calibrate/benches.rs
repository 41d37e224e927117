//! Synthetic sonars and scenes for calibration. Together they contain every kind of work in different proportions.

use std::fmt::Write;
use std::path::Path;

use glam::{DQuat, DVec3};
use num_complex::Complex64;

use echotank_config::spec::{MediumSpec, SonarSpec};
use echotank_core::frames::{AttitudeKnot, Trajectory};
use echotank_core::navigation::NavState;
use echotank_core::ping::PingPlan;
use echotank_core::scene::{ScatterLaw, Scatterers};
use echotank_core::time::UtcNs;
use echotank_ping::{self as ping, PingOrder};

/// A sonar with one ping and its scatterers.
pub(super) struct Bench {
    pub spec: SonarSpec,
    pub medium: MediumSpec,
    pub plan: PingPlan,
    pub scatterers: Scatterers,
}

/// Parameters of a benchmark. All arrays lie along the track, 12 m above a flat bottom, at 3 m/s, with omnidirectional transmitters; one platform rolls.
struct BenchParameters {
    elements: usize,
    patterned: bool,
    carrier_khz: f64,
    bandwidth_khz: f64,
    pulse_ms: f64,
    taper: f64,
    rate_khz: f64,
    filtered: bool,
    range_m: f64,
    scatterers: usize,
    tolerance: f64,
    synthesis: &'static str,
    rolling: bool,
}

const PARAMETERS: [BenchParameters; 12] = [
    // From many echoes on one element to a fan of 128 elements; tapers of 0 make sharp pulse edges.
    parameters(1, 400.0, 20.0, 1.0, 0.2, 60.0, 60.0, 20_000, 1e-3),
    parameters(1, 200.0, 10.0, 0.5, 0.5, 40.0, 30.0, 100_000, 1e-2),
    parameters(3, 300.0, 8.0, 1.0, 0.2, 40.0, 120.0, 500, 1e-4),
    parameters(4, 200.0, 30.0, 2.0, 0.1, 80.0, 40.0, 4_000, 1e-4).omnidirectional(),
    parameters(4, 100.0, 10.0, 1.0, 0.2, 30.0, 60.0, 3_000, 1e-3).rolling(),
    parameters(32, 200.0, 20.0, 1.0, 0.1, 40.0, 30.0, 6_000, 1e-3),
    parameters(32, 100.0, 4.0, 4.0, 0.0, 20.0, 30.0, 1_500, 1e-2),
    parameters(128, 200.0, 20.0, 1.0, 0.1, 40.0, 30.0, 40_000, 1e-3),
    parameters(2, 200.0, 5.0, 4.0, 0.0, 40.0, 40.0, 5_000, 1e-3).unfiltered(),
    parameters(16, 50.0, 4.0, 1.0, 0.3, 20.0, 60.0, 2_000, 1e-3).unfiltered(),
    // "auto" takes gridded-2d with very many echoes only, which would take too long here.
    parameters(32, 100.0, 4.0, 4.0, 0.0, 20.0, 30.0, 1_500, 1e-2).by_gridded_2d(),
    parameters(128, 200.0, 20.0, 1.0, 0.1, 40.0, 30.0, 40_000, 1e-3).by_gridded_2d(),
];

#[allow(clippy::too_many_arguments)]
const fn parameters(
    elements: usize,
    carrier_khz: f64,
    bandwidth_khz: f64,
    pulse_ms: f64,
    taper: f64,
    rate_khz: f64,
    range_m: f64,
    scatterers: usize,
    tolerance: f64,
) -> BenchParameters {
    BenchParameters {
        elements,
        patterned: true,
        carrier_khz,
        bandwidth_khz,
        pulse_ms,
        taper,
        rate_khz,
        filtered: true,
        range_m,
        scatterers,
        tolerance,
        synthesis: "auto",
        rolling: false,
    }
}

const DEPTH_M: f64 = 12.0;
const SPEED_M_PER_S: f64 = 3.0;
const SOUND_SPEED_M_PER_S: f64 = 1500.0;

impl BenchParameters {
    const fn omnidirectional(mut self) -> Self {
        self.patterned = false;
        self
    }

    const fn unfiltered(mut self) -> Self {
        self.filtered = false;
        self
    }

    const fn rolling(mut self) -> Self {
        self.rolling = true;
        self
    }

    const fn by_gridded_2d(mut self) -> Self {
        self.synthesis = "gridded-2d";
        self
    }

    fn text(&self) -> String {
        let spacing_m = 0.5 * SOUND_SPEED_M_PER_S / (1e3 * self.carrier_khz);
        let mut text = format!(
            r#"[medium]
sound_speed_m_per_s = {SOUND_SPEED_M_PER_S:?}
absorption = "none"
[[nav.source]]
name = "none"
kind = "udp"
listen = "127.0.0.1:0"
[scene.seabed]
shape = "plane"
depth_m = {DEPTH_M:?}
density_per_m2 = 1.0
[[sonar]]
name = "bench"
[sonar.pulse]
kind = "lfm"
center_frequency_khz = {:?}
bandwidth_khz = {:?}
duration_ms = {:?}
taper = {:?}
[[sonar.transmit]]
name = "tx"
[[sonar.receive]]
name = "rx"
elements = {}
spacing_m = {spacing_m:?}
"#,
            self.carrier_khz, self.bandwidth_khz, self.pulse_ms, self.taper, self.elements
        );
        if !self.patterned {
            text.push_str("element_pattern = \"omnidirectional\"\n");
        } else {
            let _ = write!(
                text,
                "element_pattern = \"rectangle\"\nelement_length_m = {spacing_m:?}\nelement_width_m = {spacing_m:?}\n"
            );
        }
        let _ = write!(
            text,
            r#"[sonar.receiver]
sample_rate_khz = {:?}
rx_filter = "{}"
noise_db = "none"
[sonar.ping]
range_m = {range_m:?}
rate_hz = 2.0
source_level_db = 200.0
[sonar.limits]
range_m = [1.0, {range_m:?}]
pulse_duration_ms = [{pulse_ms:?}, {pulse_ms:?}]
[sonar.model]
path = "auto"
doppler = "auto"
synthesis = "{}"
tolerance = {:?}
error_check = false
"#,
            self.rate_khz,
            if self.filtered { "fir" } else { "none" },
            self.synthesis,
            self.tolerance,
            range_m = self.range_m,
            pulse_ms = self.pulse_ms,
        );
        text
    }

    fn bench(&self) -> Bench {
        let rig = crate::config_files::parse(&self.text(), Path::new("."))
            .expect("a test parses every benchmark configuration");
        let mut sonars = rig.sonars;
        let spec = sonars.swap_remove(0);
        let mut plan = ping::blank(0, &spec, &rig.medium, 0.0);
        plan.trajectory =
            Trajectory::uniform(DVec3::ZERO, DVec3::X * SPEED_M_PER_S, DQuat::IDENTITY);
        if self.rolling {
            plan.trajectory.attitude = rolling();
        }
        let order = PingOrder {
            ping_number: 1,
            transmit_utc: UtcNs(0),
            settings: spec.settings,
            period_s: 0.5,
        };
        ping::fill(&mut plan, &spec, &order, NavState::default(), UtcNs(0));
        Bench {
            scatterers: bottom(self.scatterers, self.range_m),
            medium: rig.medium,
            spec,
            plan,
        }
    }
}

/// Attitudes of a platform that rolls by 5 degrees in 8 s, ten a second.
fn rolling() -> Vec<AttitudeKnot> {
    let (peak_rad, per_s) = (5f64.to_radians(), std::f64::consts::TAU / 8.0);
    let knot = |k: i32| {
        let time_s = 0.1 * f64::from(k);
        let (sin, cos) = libm::sincos(per_s * time_s);
        AttitudeKnot {
            time_s,
            world_from_body: DQuat::from_rotation_x(peak_rad * sin),
            body_rate_rad_per_s: DVec3::X * (peak_rad * per_s * cos),
        }
    };
    (-1..=2).map(knot).collect()
}

/// `count` scatterers, spread evenly over a disc on the bottom.
fn bottom(count: usize, range_m: f64) -> Scatterers {
    let ground_m = (range_m * range_m - DEPTH_M * DEPTH_M).sqrt() * 0.95;
    // The golden angle spreads points evenly (Vogel 1979).
    let turn = std::f64::consts::PI * (3.0 - 5f64.sqrt());
    let mut scatterers = Scatterers::default();
    for k in 0..count {
        let radius_m = ground_m * ((k as f64 + 0.5) / count as f64).sqrt();
        let (sin, cos) = libm::sincos(k as f64 * turn);
        let at_m = DVec3::new(radius_m * cos, radius_m * sin, DEPTH_M);
        let strength = Complex64::from_polar(1.0, k as f64);
        scatterers.push(at_m, [0.0, 0.0, -1.0], strength, ScatterLaw::Lambert);
    }
    scatterers
}

/// All benchmarks.
pub(super) fn benches() -> impl Iterator<Item = Bench> {
    PARAMETERS.iter().map(BenchParameters::bench)
}

#[cfg(test)]
mod tests {
    use super::*;
    use echotank_ping::method_selection::costs::Costs;
    use echotank_ping::method_selection::{MotionScale, Scene, rank};
    use echotank_ping::work::Figure;

    /// Calibration needs every kind of work of the methods, except the slow reference and line arrays computed in parts. The other stages of a
    /// ping are not timed.
    #[test]
    fn the_benchmarks_contain_every_kind_of_work() {
        let costs = Costs::committed();
        let mut seen = echotank_ping::work::Work::NONE;
        for (k, bench) in benches().enumerate() {
            assert!(!bench.scatterers.is_empty());
            // The rolling platform and the filtered line array with sharp pulse edges have all of them but those of gridded-2d.
            if k != 4 && k != 6 && k != PARAMETERS.len() - 1 {
                continue;
            }
            let ranking = rank(
                &Scene {
                    spec: &bench.spec,
                    medium: &bench.medium,
                    plan: &bench.plan,
                    scatterers: &bench.scatterers,
                    count: bench.scatterers.len(),
                    costs: &costs,
                    motion_scale: MotionScale::NONE,
                },
                &[],
            );
            for candidate in ranking.expect("something can be made").candidates {
                for part in candidate.parts {
                    seen = seen.plus(&part.work);
                }
            }
        }
        for &figure in Figure::ALL {
            let excluded = matches!(figure, Figure::ReferencePoint | Figure::PartElement)
                || !figure.is_of_methods();
            assert!(seen[figure] > 0.0 || excluded, "{}", figure.name());
        }
    }
}

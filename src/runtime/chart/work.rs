//! Scaling of a ping's compute time with scatterers, elements, range and bandwidth, with fitted exponents.

use crate::chart::methods::Method;
use crate::chart::{Scene, run_method};
use echotank_config::spec::{MediumSpec, SonarSpec};
use echotank_core::ping::PingPlan;
use echotank_core::scene::Scatterers;
use echotank_ping as ping;

/// Fractions of the configured amount.
const SHARES: [f64; 4] = [0.125, 0.25, 0.5, 1.0];

/// Quantity that is varied.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Work {
    /// Number of scatterers.
    Scatterers,
    /// Number of receive elements, in proportion for each array.
    Elements,
    /// Range of the ping, and so its duration.
    Range,
    /// Bandwidth of the pulse, with the sample rate in proportion.
    Bandwidth,
}

impl Work {
    /// All quantities.
    pub const ALL: [Self; 4] = [
        Self::Scatterers,
        Self::Elements,
        Self::Range,
        Self::Bandwidth,
    ];
    /// Name with unit, for axes and tables.
    pub fn name(self) -> &'static str {
        match self {
            Self::Scatterers => "scatterers",
            Self::Elements => "elements",
            Self::Range => "range, m",
            Self::Bandwidth => "bandwidth, kHz",
        }
    }
}

/// Compute time of one method as a function of one quantity.
pub struct Curve {
    /// Method and its settings.
    pub method: Method,
    /// Varied quantity.
    pub work: Work,
    /// Amount and median milliseconds per ping.
    pub points: Vec<(f64, f64)>,
    /// Exponent p of ms = a amount^p, fitted by least squares in logarithms; `None` with fewer than two points.
    pub exponent: Option<f64>,
}

/// Measures `method` on `scene` with reduced amounts of `work`, each with `repeats` timed runs.
pub fn curve(
    sonar: &SonarSpec,
    medium: &MediumSpec,
    scene: &Scene,
    method: &Method,
    work: Work,
    repeats: usize,
) -> Curve {
    let full = method.on(sonar);
    let mut points: Vec<(f64, f64)> = Vec::new();
    for share in SHARES {
        let (spec, scene, amount) = reduced(&full, scene, work, share);
        if points.iter().any(|&(seen, _)| seen == amount) {
            continue;
        }
        let scenes = std::slice::from_ref(&scene);
        if let Ok((_, times, _)) = run_method(&spec, medium, scenes, repeats) {
            points.push((amount, times.median_ms));
        }
    }
    Curve {
        method: *method,
        work,
        exponent: exponent(&points),
        points,
    }
}

/// Specification and scene with a fraction of one quantity, and the resulting amount.
fn reduced(spec: &SonarSpec, scene: &Scene, work: Work, share: f64) -> (SonarSpec, Scene, f64) {
    let mut spec = spec.clone();
    let mut plan = scene.plan.clone();
    let mut scatterers = scene.scatterers.clone();
    let amount = match work {
        Work::Scatterers => {
            let every = (1.0 / share).round() as usize;
            scatterers = only(&scatterers, |k, _| k.is_multiple_of(every));
            scatterers.len() as f64
        }
        Work::Elements => {
            for array in &mut spec.receive {
                array.elements = ((array.elements as f64 * share).ceil() as usize).max(1);
            }
            spec.receive
                .iter()
                .map(|array| array.elements)
                .sum::<usize>() as f64
        }
        Work::Range => {
            plan.settings.range_m *= share;
            resample(&mut plan, &spec);
            let range_m = plan.settings.range_m;
            let here = plan.trajectory.pose_at(0.0).position_m;
            scatterers = only(&scatterers, |_, place_m| place_m.distance(here) <= range_m);
            range_m
        }
        Work::Bandwidth => {
            spec.pulse.bandwidth_hz *= share;
            plan.pulse.bandwidth_hz *= share;
            spec.receiver.sample_rate_hz *= share;
            resample(&mut plan, &spec);
            plan.pulse.bandwidth_hz / 1e3
        }
    };
    // A fan beamformer needs the configured number of elements.
    spec.beams.fan = match work {
        Work::Elements => None,
        _ => spec.beams.fan,
    };
    (spec, Scene { plan, scatterers }, amount)
}

fn resample(plan: &mut PingPlan, spec: &SonarSpec) {
    let (c, rate_hz) = (plan.sound_speed_m_per_s, spec.receiver.sample_rate_hz);
    plan.sample_count = ping::sample_count(&plan.settings, c, rate_hz);
}

fn only(all: &Scatterers, keep: impl Fn(usize, glam::DVec3) -> bool) -> Scatterers {
    let mut some = Scatterers {
        curve: all.curve.clone(),
        ..Scatterers::default()
    };
    for k in 0..all.len() {
        let place_m = glam::DVec3::new(all.north_m[k], all.east_m[k], all.down_m[k]);
        if keep(k, place_m) {
            some.push_copy(all, k, 1.0);
        }
    }
    some
}

/// Slope of the least-squares line through the logarithms.
fn exponent(points: &[(f64, f64)]) -> Option<f64> {
    let logs: Vec<(f64, f64)> = points
        .iter()
        .filter(|(x, y)| *x > 0.0 && *y > 0.0)
        .map(|(x, y)| (x.ln(), y.ln()))
        .collect();
    let n = logs.len() as f64;
    let (sx, sy) = logs
        .iter()
        .fold((0.0, 0.0), |(sx, sy), (x, y)| (sx + x, sy + y));
    let (mx, my) = (sx / n, sy / n);
    let (mut over, mut under) = (0.0, 0.0);
    for (x, y) in &logs {
        over += (x - mx) * (y - my);
        under += (x - mx) * (x - mx);
    }
    (logs.len() > 1 && under > 0.0).then(|| over / under)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_exponent_of_a_power_is_that_power() {
        let points: Vec<(f64, f64)> = [1.0, 3.0, 10.0, 70.0]
            .iter()
            .map(|&x: &f64| (x, 2.5 * x.powf(1.37)))
            .collect();
        let got = exponent(&points).unwrap();
        assert!((got - 1.37).abs() < 1e-12, "{got}");
        assert_eq!(exponent(&points[..1]), None);
        assert_eq!(exponent(&[(2.0, 1.0), (2.0, 3.0)]), None);
    }
}

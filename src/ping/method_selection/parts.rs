//! Lines made from parts: where nobody reads elements, some of a line's elements side by side are made as one ([`Pattern::Part`](echotank_core::arrays::Pattern)),
//! and the line is formed from the parts as it would be from elements.
//!
//! In: a sonar, a ping's plan and scatterers. Out: what each way to part its lines is off by, of the mean of all elements that a line is formed
//! from: by a sample of the echoes, each put together from elements and from parts at instants of the pulse and frequencies of its band.
//!
//! A part answers at the carrier and halfway through an echo (`echo::walk`). What is left grows with the square of a part's length: bandwidth
//! times the delay along it; how its answer changes while the platform moves by a pulse's worth; level, pattern and law of each element. Where
//! elements hear sideways what a transmitter sends there, the first is all of it: parts are far apart and have grating lobes, in whose
//! directions only a part's own zero at the carrier keeps them silent.

use std::f64::consts::TAU;

use glam::{DMat3, DVec3};
use num_complex::Complex64;

use crate::method_selection::echo_statistics::sampled;
use crate::range_floors::half_path_m;
use echotank_config::spec::SonarSpec;
use echotank_core::arrays::ArrayGeometry;
use echotank_core::model::PathModel;
use echotank_core::ping::PingPlan;
use echotank_core::scene::{LawCurve, ScatterLaw, Scatterers};
use echotank_synthesis::echo::levels::{Directivity, OneWay, amplitude_from_db};

/// Pairs of an echo and an element that are looked at, and echoes at least and at most.
const PAIRS: usize = 60_000;
const ECHOES: (usize, usize) = (200, 4000);
/// Scatterers among which those are drawn, roughly.
const AMONG: usize = 20_000;
/// Windows of a ping that are told apart.
const WINDOWS: usize = 16;
/// Instants at which the arrays' axes are looked at.
const INSTANTS: usize = 64;
/// A sample of the echoes may miss the worst; windows are coarser than those that errors are counted in.
const MARGIN: f64 = 1.5;
/// Instants of a pulse, and their shares of it: Gauss and Legendre's of the fifth order.
const NODES: [(f64, f64); 3] = [
    (0.112_701_665_379_258_3, 5.0 / 18.0),
    (0.5, 8.0 / 18.0),
    (0.887_298_334_620_741_7, 5.0 / 18.0),
];
/// What a pulse's edges have beyond its sweep stands at this share of the sample rate, to both sides.
const EDGES: f64 = 0.3;

/// A way to part lines.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Parting {
    /// Elements taken as one.
    pub of: usize,
    /// Relative error of the line, with the arrays' axes as they are at each echo.
    error: f64,
    /// ... for each second that the axes are old.
    error_per_s: f64,
    window_s: f64,
}

impl Parting {
    /// Under a path model; none where it cannot be had.
    pub fn error(&self, path: PathModel, segment_s: f64) -> Option<f64> {
        let old_s = match path {
            PathModel::StopAndHop => self.window_s,
            // Axes are those of a chord's middle.
            PathModel::KSegment => 0.5 * segment_s.min(self.window_s),
            PathModel::Continuous => 0.0,
            // Its steps of attitude would tear a part.
            PathModel::Polyline => return None,
        };
        Some(self.error + self.error_per_s * old_s)
    }
}

/// Numbers of elements that can be taken as one on every line, small ones first; none where an array is an arc.
pub(crate) fn divisors(spec: &SonarSpec) -> Vec<usize> {
    let least = spec.receive.iter().map(|array| array.elements).min();
    let fits = |a: &ArrayGeometry, of: usize| a.elements.is_multiple_of(of) && a.radius_m.is_none();
    let even = |of: &usize| spec.receive.iter().all(|a| fits(a, *of));
    (2..=least.unwrap_or(1)).filter(even).collect()
}

/// Each of [`divisors`]; none where nothing is heard. `spread`: of the worst window over the mean one, of random echoes. `turning`: how much faster the
/// platform has turned of late than in this ping.
pub fn partings(
    spec: &SonarSpec,
    plan: &PingPlan,
    scatterers: &Scatterers,
    spread: f64,
    turning: f64,
) -> Vec<Parting> {
    let divisors = divisors(spec);
    let mut worst = vec![[0.0f64; 2]; divisors.len()];
    let mut heard = false;
    for array in &spec.receive {
        let line = Line::new(spec, plan, array);
        let Some(errors) = line.errors(plan, scatterers, &divisors, spec) else {
            continue;
        };
        heard = true;
        let turning_rad_per_s = turning * line.turning_rad_per_s(plan);
        for (worst, [fresh, per_rad]) in worst.iter_mut().zip(errors) {
            worst[0] = worst[0].max(fresh);
            worst[1] = worst[1].max(per_rad * turning_rad_per_s);
        }
    }
    if !heard {
        return Vec::new();
    }
    let window_s = plan.window_s(spec.receiver.sample_rate_hz);
    let all = divisors.into_iter().zip(worst);
    all.map(|(of, [fresh, per_s])| Parting {
        of,
        error: MARGIN * spread * fresh,
        error_per_s: MARGIN * spread * per_s,
        window_s,
    })
    .collect()
}

/// One line with its transmitter.
struct Line<'a> {
    array: &'a ArrayGeometry,
    c: f64,
    window_s: f64,
    transmit_m: DVec3,
    transmit_from_world: DMat3,
    transmit_leg: Directivity,
    element: Directivity,
    one_way: OneWay,
    floor: f64,
    carrier_hz: f64,
    /// Instants of the pulse, frequencies then, what of the error counts, and what of the energy.
    looks: Vec<(f64, f64, f64, f64)>,
}

/// An echo that is looked at.
struct Echo {
    place_m: DVec3,
    normal: DVec3,
    law: ScatterLaw,
    /// Source's pattern and law, first leg, strength.
    sent: f64,
    /// Leading edge at the array's middle, about.
    delay_s: f64,
    weight: f64,
}

/// Energies of the line and of its parts, and what parts leave of both, for each way to part.
#[derive(Clone, Default)]
struct Sums {
    line: f64,
    of: Vec<[f64; 4]>,
}

const OFF: usize = 0;
const TILTED: usize = 1;
const OFF_PARTS: usize = 2;
const PARTS: usize = 3;

impl Sums {
    fn add(&mut self, other: &Self) {
        self.line += other.line;
        for (sum, other) in self.of.iter_mut().zip(&other.of) {
            for (sum, other) in sum.iter_mut().zip(other) {
                *sum += other;
            }
        }
    }
}

impl<'a> Line<'a> {
    fn new(spec: &SonarSpec, plan: &PingPlan, array: &'a ArrayGeometry) -> Self {
        let transmit = &spec.transmit[array.transmit];
        let wavelength_m = plan.sound_speed_m_per_s / plan.pulse.center_frequency_hz;
        let start = plan.trajectory.pose_at(0.0);
        let turn = start.world_from_body * transmit.mounting.body_from_array;
        let pulse = &plan.pulse;
        let rate_hz = spec.receiver.sample_rate_hz;
        let mut looks: Vec<_> = NODES
            .iter()
            .map(|&(share, weight)| {
                let w_s = share * pulse.duration_s;
                let swept_hz = pulse.sweep_hz_per_s() * (w_s - 0.5 * pulse.duration_s);
                (w_s, swept_hz, weight, weight)
            })
            .collect();
        // Of a rectangle's edges as far as samples hold them; of a taper's flanks: mean of f^2 |S|^2.
        let sharp_hz2 = rate_hz / (0.5 * TAU * TAU * pulse.duration_s);
        let smooth_hz2 = 1.0 / (8.0 * pulse.taper * pulse.duration_s * pulse.duration_s);
        let edge_hz = EDGES * rate_hz;
        let share = 0.5 * sharp_hz2.min(smooth_hz2) / (edge_hz * edge_hz);
        for beside_hz in [-edge_hz, edge_hz] {
            looks.push((0.5 * pulse.duration_s, beside_hz, share, 0.0));
        }
        Self {
            array,
            c: plan.sound_speed_m_per_s,
            window_s: plan.window_s(rate_hz),
            transmit_m: start.point_m(transmit.mounting.position_m),
            transmit_from_world: DMat3::from_quat(turn.inverse()),
            transmit_leg: Directivity::new(&transmit.pattern, wavelength_m),
            element: Directivity::new(&array.element_pattern, wavelength_m),
            one_way: OneWay::new(wavelength_m, plan.absorption_db_per_m),
            floor: plan.model.cull_db.map_or(0.0, amplitude_from_db),
            carrier_hz: pulse.center_frequency_hz,
            looks,
        }
    }

    /// How fast the line's own axis turns, at most.
    fn turning_rad_per_s(&self, plan: &PingPlan) -> f64 {
        let step_s = self.window_s / INSTANTS as f64;
        let axis = |k: usize| {
            let pose = plan.trajectory.pose_at(k as f64 * step_s);
            pose.world_from_body * (self.array.mounting.body_from_array * DVec3::X)
        };
        let turns = (0..INSTANTS).map(|k| axis(k + 1).distance(axis(k)) / step_s);
        turns.fold(0.0, f64::max)
    }

    /// The line's middle at an instant: where, how fast, and world to array axes.
    fn middle(&self, plan: &PingPlan, time_s: f64) -> (DVec3, DVec3, DMat3) {
        let pose = plan.trajectory.pose_at(time_s);
        let arm_m = self.array.mounting.position_m;
        let turn = pose.world_from_body * self.array.mounting.body_from_array;
        let from_world = DMat3::from_quat(turn.inverse());
        (
            pose.point_m(arm_m),
            pose.point_velocity_m_per_s(arm_m),
            from_world,
        )
    }

    /// Some of the echoes, drawn half by their energy and half evenly: always the same ones.
    fn draw(&self, plan: &PingPlan, scatterers: &Scatterers) -> Vec<Echo> {
        let (here_m, _, from_world) = self.middle(plan, 0.0);
        let curve = scatterers.curve.as_deref();
        let mut heard: Vec<(Echo, f64)> = Vec::new();
        for (i, weight) in sampled(scatterers, AMONG) {
            let law = scatterers.law[i];
            let place_m = scatterers.position_m(i);
            let out_m = scatterers.transmit_m(i) - self.transmit_m;
            let out_range_m = out_m.length().max(f64::MIN_POSITIVE);
            let back_m = place_m - here_m;
            let delay_s = (out_range_m + back_m.length()) / self.c;
            if delay_s > self.window_s {
                continue;
            }
            let out = self.transmit_from_world * (out_m / out_range_m);
            let back = from_world * back_m.normalize_or_zero();
            let sent = self.transmit_leg.towards(out.x, out.y, out.z);
            let received = self.element.towards(back.x, back.y, back.z);
            let level = (sent * received).abs();
            let floor = plan
                .range_floors
                .at(self.floor, half_path_m(scatterers, i, self.transmit_m));
            if level == 0.0 || level * f64::from(scatterers.loud[i]) < floor {
                continue;
            }
            let vector = |n: [f32; 3]| DVec3::from_array(n.map(f64::from));
            let normal = vector(scatterers.normal[i]);
            let sent_normal = vector(scatterers.transmit_normal(i));
            let cosine = (-sent_normal.dot(out_m) / out_range_m).max(0.0);
            let law_out = match law {
                ScatterLaw::Point | ScatterLaw::Water => 1.0,
                ScatterLaw::Lambert => cosine.sqrt(),
                ScatterLaw::LambertOneWay => cosine,
                ScatterLaw::Curve => curve.map_or(0.0, |curve| curve.half(cosine.sqrt().min(1.0))),
            };
            let sent = sent
                * law_out
                * self.one_way.amplitude(out_range_m)
                * scatterers.strength[i].norm();
            let back_range_m = back_m.length().max(f64::MIN_POSITIVE);
            let whole = sent * received * self.one_way.amplitude(back_range_m);
            let energy = weight * whole * whole;
            if energy > 0.0 {
                let echo = Echo {
                    place_m,
                    normal,
                    law,
                    sent,
                    delay_s,
                    weight,
                };
                heard.push((echo, energy));
            }
        }
        let wanted = (PAIRS / self.array.elements.max(1)).clamp(ECHOES.0, ECHOES.1);
        if heard.len() <= wanted {
            return heard.into_iter().map(|(echo, _)| echo).collect();
        }
        let all: f64 = heard.iter().map(|(_, energy)| energy).sum();
        let even = 0.5 / heard.len() as f64;
        let (mut reached, mut drawn) = (0.0, Vec::with_capacity(wanted));
        let step = 1.0 / wanted as f64;
        let mut next = 0.5 * step;
        for (mut echo, energy) in heard {
            let chance = 0.5 * energy / all + even;
            reached += chance;
            let mut times = 0.0;
            while next < reached {
                (next, times) = (next + step, times + 1.0);
            }
            if times > 0.0 {
                echo.weight *= times * step / chance;
                drawn.push(echo);
            }
        }
        drawn
    }

    /// Of each way to part: the worst relative error, and for each radian that the line's axis is off. None where nothing is heard.
    fn errors(
        &self,
        plan: &PingPlan,
        scatterers: &Scatterers,
        divisors: &[usize],
        spec: &SonarSpec,
    ) -> Option<Vec<[f64; 2]>> {
        let echoes = self.draw(plan, scatterers);
        let blank = Sums {
            line: 0.0,
            of: vec![[0.0; 4]; divisors.len()],
        };
        let mut windows = vec![blank.clone(); WINDOWS];
        let mut points: Vec<Sums> = Vec::new();
        let mut summation = EchoSummation::new(self, divisors);
        for echo in &echoes {
            let mut sums = blank.clone();
            summation.add_echo(plan, scatterers.curve.as_deref(), echo, &mut sums);
            let window = (echo.delay_s / self.window_s * WINDOWS as f64) as usize;
            windows[window.min(WINDOWS - 1)].add(&sums);
            if echo.law == ScatterLaw::Point {
                points.push(sums);
            }
        }
        let mut all = blank;
        windows.iter().for_each(|window| all.add(window));
        if all.line <= 0.0 {
            return None;
        }
        // Points may stand alone, in a window as long as a pulse.
        let pulses = (self.window_s / plan.pulse.duration_s).max(1.0);
        let share = |sums: &Sums, k: usize, among: f64| {
            let of = &sums.of[k];
            let line = sums.line.max(all.line / among);
            let mut off = [of[OFF] / line, of[TILTED] / line];
            // Error checks look at parts one by one.
            if spec.synthesis.error_check {
                let parts = of[PARTS].max(all.of[k][PARTS] / among);
                off[0] = off[0].max(of[OFF_PARTS] / parts.max(f64::MIN_POSITIVE));
            }
            off.map(f64::sqrt)
        };
        let worst = |k: usize| {
            let windows = windows.iter().map(|sums| share(sums, k, WINDOWS as f64));
            let points = points.iter().map(|sums| share(sums, k, pulses));
            windows
                .chain(points)
                .fold([0.0; 2], |a: [f64; 2], b| [a[0].max(b[0]), a[1].max(b[1])])
        };
        Some((0..divisors.len()).map(worst).collect())
    }
}

/// Buffers for [`EchoSummation::add_echo`].
struct EchoSummation<'a> {
    line: &'a Line<'a>,
    divisors: &'a [usize],
    /// Of each element, and of each part: x along the line.
    x_m: Vec<f64>,
    parts_m: Vec<Vec<f64>>,
    /// Halfway through the echo, at the carrier, of each element.
    halfway: Vec<Complex64>,
}

/// The scatterer relative to the middle of the line at one instant, in array axes.
#[derive(Clone, Copy)]
struct RelativePosition {
    d_m: DVec3,
    v_m_per_s: DVec3,
    normal: DVec3,
}

impl<'a> EchoSummation<'a> {
    fn new(line: &'a Line<'a>, divisors: &'a [usize]) -> Self {
        let array = line.array;
        let parts = |of: &usize| {
            let parts = array.in_parts(*of).expect("a divisor");
            (0..parts.elements).map(|k| parts.along_m(k)).collect()
        };
        Self {
            line,
            divisors,
            x_m: (0..array.elements).map(|e| array.along_m(e)).collect(),
            parts_m: divisors.iter().map(parts).collect(),
            halfway: vec![Complex64::ZERO; array.elements],
        }
    }

    fn relative(&self, plan: &PingPlan, echo: &Echo, time_s: f64) -> RelativePosition {
        let (here_m, velocity, from_world) = self.line.middle(plan, time_s);
        RelativePosition {
            d_m: from_world * (echo.place_m - here_m),
            v_m_per_s: from_world * velocity,
            normal: from_world * echo.normal,
        }
    }

    /// Later than the line's middle, x beside it, seconds.
    fn late_s(&self, relative: &RelativePosition, x_m: f64) -> f64 {
        let d = relative.d_m;
        let q = d - DVec3::X * x_m;
        let range_m = q.length().max(f64::MIN_POSITIVE);
        let longer_m = x_m * (x_m - 2.0 * d.x) / (range_m + d.length());
        longer_m / (self.line.c + relative.v_m_per_s.dot(q) / range_m)
    }

    /// Level of what an element x beside the middle hears.
    fn level(
        &self,
        relative: &RelativePosition,
        echo: &Echo,
        curve: Option<&LawCurve>,
        x_m: f64,
    ) -> f64 {
        let q = relative.d_m - DVec3::X * x_m;
        let range_m = q.length().max(f64::MIN_POSITIVE);
        let u = q / range_m;
        let cosine = (-relative.normal.dot(u)).max(0.0);
        let law = match echo.law {
            ScatterLaw::Point | ScatterLaw::Water | ScatterLaw::LambertOneWay => 1.0,
            ScatterLaw::Lambert => cosine.sqrt(),
            ScatterLaw::Curve => curve.map_or(0.0, |curve| curve.half(cosine.sqrt().min(1.0))),
        };
        let line = self.line;
        line.element.towards(u.x, u.y, u.z) * law * line.one_way.amplitude(range_m)
    }

    /// What one echo adds.
    fn add_echo(
        &mut self,
        plan: &PingPlan,
        curve: Option<&LawCurve>,
        echo: &Echo,
        sums: &mut Sums,
    ) {
        let line = self.line;
        // Once more with the line where it is by then.
        let (here_m, ..) = line.middle(plan, echo.delay_s);
        let out_m = echo.place_m.distance(line.transmit_m);
        let delay_s = (out_m + echo.place_m.distance(here_m)) / line.c;
        let half_s = 0.5 * plan.pulse.duration_s;
        let halfway = self.relative(plan, echo, delay_s + half_s);
        let per_s = TAU * line.carrier_hz;
        for e in 0..self.x_m.len() {
            self.halfway[e] = Complex64::cis(-per_s * self.late_s(&halfway, self.x_m[e]));
        }
        for &(w_s, beside_hz, error_share, energy_share) in &line.looks {
            let relative = self.relative(plan, echo, delay_s + w_s);
            let turning = TAU * (line.carrier_hz + beside_hz);
            let one = |x_m: f64| {
                let level = echo.sent * self.level(&relative, echo, curve, x_m);
                Complex64::cis(-turning * self.late_s(&relative, x_m)) * level
            };
            let echoes: Vec<Complex64> = self.x_m.iter().map(|&x_m| one(x_m)).collect();
            let whole = echoes.iter().sum::<Complex64>() / self.x_m.len() as f64;
            sums.line += echo.weight * energy_share * whole.norm_sqr();
            for ((of, parts_m), sums) in self.divisors.iter().zip(&self.parts_m).zip(&mut sums.of) {
                let (mut off, mut tilted) = (Complex64::ZERO, Complex64::ZERO);
                let share = 1.0 / parts_m.len() as f64;
                for (k, &x_m) in parts_m.iter().enumerate() {
                    let own = k * of..(k + 1) * of;
                    let middle = Complex64::cis(per_s * self.late_s(&halfway, x_m));
                    let (mut answer, mut turned) = (Complex64::ZERO, Complex64::ZERO);
                    for e in own.clone() {
                        answer += self.halfway[e];
                        turned += self.halfway[e] * (self.x_m[e] - x_m);
                    }
                    let middle = middle / *of as f64 * one(x_m);
                    let want = echoes[own].iter().sum::<Complex64>() / *of as f64;
                    let got = middle * answer;
                    off += (got - want) * share;
                    tilted += middle * turned * (share * per_s / line.c);
                    let of_each = echo.weight * share;
                    sums[OFF_PARTS] += of_each * error_share * (got - want).norm_sqr();
                    sums[PARTS] += of_each * energy_share * want.norm_sqr();
                }
                sums[OFF] += echo.weight * error_share * off.norm_sqr();
                sums[TILTED] += echo.weight * energy_share * tilted.norm_sqr();
            }
        }
    }
}

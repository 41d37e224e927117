//! Motion along the rays of a ping, weighted with the energy of their echoes. The closed forms of the error models hold for echoes from any
//! direction, but a beam to the side receives none from ahead.
//!
//! In: a ping's plan and scatterers. Out: [`EchoStatistics`]. Of a seabed, only an even sample of the scatterers is used;
//! points and targets are all used.

use glam::{DMat3, DVec3};

use crate::method_selection::{MotionScale, fades};
use crate::range_floors::half_path_m;
use echotank_config::spec::SonarSpec;
use echotank_core::arrays::{ArrayGeometry, TransmitArray};
use echotank_core::ping::PingPlan;
use echotank_core::pulse::{FLOOR_BELOW_STRONGEST_DB, MIN_WINDOW};
use echotank_core::scene::{ScatterLaw, Scatterers};
use echotank_synthesis::echo::levels::{Directivity, OneWay, amplitude_from_db};
use echotank_synthesis::error_model::{Conditions, EchoStatistics};

/// Approximate number of seabed scatterers in the sample. In each of a hundred windows they give root mean squares within a tenth. Fewer
/// predict smaller errors: 5,000 a path error 31 % below that of 20,000 with `line256.toml`.
pub const SAMPLE_SIZE: usize = 20_000;
/// Instants at which an element's motion is tabled.
const INSTANTS: usize = 64;
/// ... for [`echo_peaks`], which looks at no more than so many scatterers.
const FEW_INSTANTS: usize = 8;
const FEW_SCATTERERS: usize = 400;
/// Rounding of finite differences of velocities, m/s^2.
const STILL_M_PER_S2: f64 = 1e-9;
/// What a sample of the echoes and of the elements, and motion tabled at instants, may leave out of a root mean square.
const SAMPLED: f64 = 1.1;

/// The same where echoes overlap, whose energy is not that of Gaussian samples: with [`SAMPLED`] alone, 2 of 81 rigs of `tools/points_random.py`
/// were 2 % above the prediction.
const OVERLAPPING: f64 = 1.3;

/// A window may begin anywhere, and cut an echo anywhere: it is put together of so many parts, and looked at from each of them on.
const PARTS: usize = 4;

/// Quantities that the error models multiply, in the order of [`EchoStatistics`]: displacement, closing speed, range acceleration, its rate,
/// acceleration, turning, change of acceleration.
const QUANTITIES: usize = 7;
/// These quantities.
pub(super) fn quantities(echoes: &mut EchoStatistics) -> [&mut f64; QUANTITIES] {
    [
        &mut echoes.displacement_m,
        &mut echoes.closing_m_per_s,
        &mut echoes.range_acceleration_m_per_s2,
        &mut echoes.range_jerk_m_per_s3,
        &mut echoes.acceleration_m_per_s2,
        &mut echoes.turning_m_per_s,
        &mut echoes.acceleration_change_m_per_s2,
    ]
}

/// How their phases grow within an echo: t^0, t^1, t^2, each with a mean square of 1 over the echo. The third order is about mid-pulse, and as large
/// at both ends.
const GROWTH: [i32; QUANTITIES] = [0, 1, 2, 0, 0, 0, 0];
/// The last instant of an echo over the last part of a window's worth of it, for each of these powers: sqrt(3/2.31) and sqrt(5/3.05).
const LAST_INSTANT: [f64; 3] = [1.0, 1.14, 1.28];
/// A window with fewer echoes than this, by their energies, is one echo or the end of one; with fewer than the second, mostly.
const ALONE: f64 = 1.001;
const SINGLE: f64 = 1.25;

/// All points and targets, and of the ground every so many, about `among` of them: each with how many it stands for.
pub fn sampled(scatterers: &Scatterers, among: usize) -> impl Iterator<Item = (usize, f64)> {
    let stride = scatterers.len().div_ceil(among).max(1);
    let laws = scatterers.law.iter().enumerate();
    laws.filter_map(move |(i, law)| match law {
        ScatterLaw::Point => Some((i, 1.0)),
        _ if i.is_multiple_of(stride) => Some((i, stride as f64)),
        _ => None,
    })
}

/// What sounds in a part of a window: energy, and the weighted sums and squares of the quantities of [`EchoStatistics`].
#[derive(Clone, Copy, Default)]
struct Part {
    energy: f64,
    sums: [f64; QUANTITIES],
    squares: [f64; QUANTITIES],
    /// Squares of the component across the array and of the closing speed of whole echoes.
    across2: f64,
    closing2: f64,
    /// Of the loudest echo, all of it, and what of it sounds here.
    loudest: f64,
    loudest_here: f64,
    /// Sum of the products of the energies of two different echoes, from above: what interferes.
    mixed: f64,
    /// Of the echoes that begin here: how many, their energy, and the sum of its squares.
    echoes: f64,
    begun: f64,
    begun2: f64,
}

impl Part {
    fn and(mut self, other: &Self) -> Self {
        self.energy += other.energy;
        for q in 0..QUANTITIES {
            self.sums[q] += other.sums[q];
            self.squares[q] += other.squares[q];
        }
        self.across2 += other.across2;
        self.closing2 += other.closing2;
        self.loudest = self.loudest.max(other.loudest);
        // Echoes that do not sound at the same time do not interfere.
        self.mixed += other.energy * other.energy - other.loudest_here * other.loudest_here;
        self.echoes += other.echoes;
        self.begun += other.begun;
        self.begun2 += other.begun2;
        self
    }

    /// Of an echo what sounds here, `from` and `to` in pulses.
    fn add(&mut self, energy: f64, whole: f64, (from, to): (f64, f64), echo: &EchoMotion) {
        let share = energy * (to - from);
        self.energy += share;
        self.loudest = self.loudest.max(whole);
        self.loudest_here = self.loudest_here.max(whole * (to - from));
        for (q, value) in echo.values.into_iter().enumerate() {
            // Phases of Doppler grow with time, those of its change with the square: the end of a pulse has more of them than its beginning.
            let k = GROWTH[q];
            let grown = |power: i32| energy * (to.powi(power) - f64::powi(from, power));
            let unit = f64::from(2 * k + 1);
            self.sums[q] += value * unit.sqrt() / f64::from(k + 1) * grown(k + 1);
            self.squares[q] += value * value * grown(2 * k + 1);
        }
        self.across2 += share * echo.across_m_per_s.powi(2);
        self.closing2 += share * echo.values[1].powi(2);
    }

    /// The worst that the quantities amount to in samples of a window like this one, among windows whose number has the logarithm `looks`.
    ///
    /// A single echo is off by its own phase. Many echoes of random phases are Gaussian, and so is their error: it has a part in proportion to the
    /// samples (the mean phase) and one that does not depend on them (the spread of the phases), which counts more where the samples cancel.
    /// Between them, the energy of a window varies as the products of the energies of different echoes do.
    ///
    /// The last value is the same for errors of random phase with a mean square of 1 over every echo.
    fn amounts(&self, floor: f64, looks: f64, independent: f64) -> ([f64; QUANTITIES], f64) {
        let energy = self.energy.max(f64::MIN_POSITIVE);
        let of_part = (independent / PARTS as f64).max(1.0);
        let n = energy * energy * of_part / self.mixed.max(f64::MIN_POSITIVE);
        let (ratio, peak) = (fades::worst_ratio(looks, n), fades::worst_peak(looks, n));
        let crowd = energy / self.loudest.max(f64::MIN_POSITIVE);
        let mut amounts = [0.0; QUANTITIES];
        for (q, amount) in amounts.iter_mut().enumerate() {
            let square = self.squares[q] / energy;
            let mean = (self.sums[q] / energy).abs();
            let variance = (square - mean * mean).max(0.0);
            let all = (square * ratio).sqrt();
            let alone = all.min(mean + (variance * ratio).sqrt());
            let on_floor = (square * peak * energy / floor).sqrt();
            let margin = match crowd {
                ..ALONE => LAST_INSTANT[GROWTH[q] as usize],
                ..SINGLE => LAST_INSTANT[GROWTH[q] as usize] * SAMPLED,
                _ => OVERLAPPING,
            };
            *amount = alone.min(on_floor) * margin;
        }
        (
            amounts,
            OVERLAPPING * ratio.min(peak * energy / floor).sqrt(),
        )
    }
}

/// Statistics of the received echoes; `None` without echoes.
pub fn echo_statistics(
    spec: &SonarSpec,
    plan: &PingPlan,
    scatterers: &Scatterers,
) -> Option<EchoStatistics> {
    let rate_hz = spec.receiver.sample_rate_hz;
    let window_s = plan.pulse.duration_s.max(MIN_WINDOW / rate_hz);
    let windows = (plan.window_s(rate_hz) / window_s).ceil().max(1.0) as usize;
    let part_s = window_s / PARTS as f64;
    let elements: usize = spec.receive.iter().map(|array| array.elements).sum();
    let looks = ((windows * PARTS * elements).max(2) as f64).ln();
    // Autocorrelated over a pulse, a pulse's length of samples has two degrees of freedom and more.
    let independent = (1.0 + plan.pulse.bandwidth_hz * window_s).max(2.0);
    let mut worst = [0.0f64; QUANTITIES];
    let (mut across2, mut closing2) = (0.0f64, 0.0f64);
    let mut sounded = false;
    // Echoes in a loud window that count, at most; the loudest of a window; all of them.
    let mut crowd = 1.0f64;
    let mut fading = 1.0f64;
    let (mut strongest_share, mut echoes) = (0.0f64, 0.0);
    let mut parts = vec![Part::default(); windows * PARTS];
    for array in &spec.receive {
        let transmit = &spec.transmit[array.transmit];
        let ends = [0, array.elements - 1];
        let ends = &ends[..array.elements.min(2)];
        let each = array.elements as f64 / ends.len() as f64;
        for &element in ends {
            parts.fill(Part::default());
            let ends = (array, element);
            let receiver = ReceivingElement::new(spec, plan, transmit, ends, INSTANTS);
            receiver.accumulate(plan, scatterers, part_s, &mut parts);
            echoes += each * parts.iter().map(|part| part.echoes).sum::<f64>();
            let mean = parts.iter().map(|part| part.energy).sum::<f64>() / windows as f64;
            if mean == 0.0 {
                continue;
            }
            sounded = true;
            let window = |parts: &[Part]| parts.iter().fold(Part::default(), Part::and);
            let strongest = parts.windows(PARTS).map(|parts| window(parts).energy);
            let floor =
                strongest.fold(mean, f64::max) * libm::exp10(-0.1 * FLOOR_BELOW_STRONGEST_DB);
            for window in parts.windows(PARTS).map(window) {
                if window.energy == 0.0 {
                    continue;
                }
                if window.energy > mean && window.begun > 0.0 {
                    crowd = crowd.max(window.begun.powi(2) / window.begun2);
                }
                // What a typical window has, for costs and pictures.
                let against = window.energy.max(mean);
                strongest_share = strongest_share.max(window.loudest / against);
                across2 = across2.max(window.across2 / against);
                closing2 = closing2.max(window.closing2 / against);
                let (amounts, faded) = window.amounts(floor, looks, independent);
                fading = fading.max(faded);
                for (worst, amount) in worst.iter_mut().zip(amounts) {
                    *worst = worst.max(amount);
                }
            }
        }
    }
    let [
        displacement,
        closing,
        range_acceleration,
        range_jerk,
        acceleration,
        turning,
        acceleration_change,
    ] = worst;
    sounded.then(|| EchoStatistics {
        displacement_m: displacement,
        closing_m_per_s: closing,
        closing_of_echoes_m_per_s: closing2.sqrt(),
        range_acceleration_m_per_s2: range_acceleration,
        range_jerk_m_per_s3: range_jerk,
        acceleration_m_per_s2: acceleration,
        turning_m_per_s: turning,
        acceleration_change_m_per_s2: acceleration_change,
        across_m_per_s: across2.sqrt(),
        spread: 1.0
            + (spread(plan, window_s, windows * elements, crowd) - 1.0) * (1.0 - 1.0 / crowd),
        fading,
        strongest_share,
        echoes,
    })
}

/// Of many echoes at random phases. Mean squares of n independent samples of Gaussian noise: the greatest of `looks` is 1 + 2 sqrt(L/n) + 2 L/n times the mean, L = ln looks
/// (Laurent and Massart 2000, Lemma 1, in its sharper form for two degrees of freedom each: 1 + sqrt(2L/n) + L/n). A window has no more
/// independent samples than echoes.
fn spread(plan: &PingPlan, window_s: f64, looks: usize, crowd: f64) -> f64 {
    let independent = (1.0 + plan.pulse.bandwidth_hz * window_s).min(crowd);
    SAMPLED * fades::worst_peak((looks.max(2) as f64).ln(), independent).sqrt()
}

/// How a ping's echo moves, along its rays.
struct EchoMotion {
    /// In the order of [`EchoStatistics`].
    values: [f64; QUANTITIES],
    /// Across the array.
    across_m_per_s: f64,
}

/// Largest motion of the echoes of a ping, by a small sample of its scatterers: enough to tell one ping from another.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct EchoPeaks {
    /// In the order of [`EchoStatistics`].
    values: [f64; QUANTITIES],
    nearest_m: f64,
}

/// The peaks of a ping.
pub(super) fn echo_peaks(spec: &SonarSpec, plan: &PingPlan, scatterers: &Scatterers) -> EchoPeaks {
    let mut peaks = EchoPeaks {
        values: [0.0; QUANTITIES],
        nearest_m: f64::INFINITY,
    };
    let stride = scatterers.len().div_ceil(FEW_SCATTERERS).max(1);
    let heard_m = plan.window_s(spec.receiver.sample_rate_hz) * plan.sound_speed_m_per_s;
    let near = near(spec, plan, scatterers);
    for array in &spec.receive {
        let transmit = &spec.transmit[array.transmit];
        for element in [0, array.elements - 1] {
            let receiver =
                ReceivingElement::new(spec, plan, transmit, (array, element), FEW_INSTANTS);
            let evenly = (0..scatterers.len()).step_by(stride);
            for i in evenly.chain(near.iter().copied()) {
                let place_m = scatterers.position_m(i);
                let sent_m = scatterers.transmit_m(i);
                let ray = receiver.ray(sent_m, place_m, plan.sound_speed_m_per_s);
                if ray.out_range_m + ray.back_range_m > heard_m {
                    continue;
                }
                let line_m = receiver.line_distance_m(&ray, &receiver.at[ray.instant]);
                peaks.nearest_m = peaks.nearest_m.min(ray.out_range_m).min(line_m);
                let values = receiver.motion(&ray).values;
                for (peak, value) in peaks.values.iter_mut().zip(values) {
                    *peak = peak.max(value.abs());
                }
            }
        }
    }
    peaks
}

/// Scatterers so near that the platform's way during a pulse is no small part of their range.
fn near(spec: &SonarSpec, plan: &PingPlan, scatterers: &Scatterers) -> Vec<usize> {
    let pose = plan.trajectory.pose_at(0.0);
    let arms = spec.receive.iter().flat_map(|array| {
        let transmit = spec.transmit[array.transmit].mounting.position_m;
        [
            transmit,
            array.element_body_m(0),
            array.element_body_m(array.elements - 1),
        ]
    });
    let arm_m = arms.map(|arm_m| arm_m.length()).fold(0.0, f64::max);
    let way_m = pose.velocity_m_per_s.length() * plan.pulse.duration_s;
    let reach_m = arm_m + NEAR_WAYS * way_m;
    let at_m = pose.position_m;
    let places = scatterers
        .north_m
        .iter()
        .zip(&scatterers.east_m)
        .zip(&scatterers.down_m);
    places
        .enumerate()
        .filter(|&(_, ((&north_m, &east_m), &down_m))| {
            let (x, y, z) = (north_m - at_m.x, east_m - at_m.y, down_m - at_m.z);
            x * x + y * y + z * z < reach_m * reach_m
        })
        .map(|(i, _)| i)
        .take(FEW_SCATTERERS)
        .collect()
}

/// So many ways of the platform during a pulse away, series in that way converge well.
const NEAR_WAYS: f64 = 5.0;

impl EchoPeaks {
    /// Those of motion that is so much greater.
    pub(super) fn times(mut self, motion: &MotionScale) -> Self {
        for (value, factor) in self.values.iter_mut().zip(motion.factors()) {
            *value *= factor;
        }
        self
    }

    /// The conditions of a ping with these peaks, from those of another ping whose peaks were `then`.
    pub(super) fn scale(&self, then: &Self, mut conditions: Conditions) -> Conditions {
        if let Some(echoes) = &mut conditions.echo_statistics {
            for (k, statistic) in quantities(echoes).into_iter().enumerate() {
                let (now, then) = (self.values[k], then.values[k]);
                // What the other ping had none of, this one has at most everywhere.
                *statistic = match then > RESTING * now {
                    true => *statistic * now / then,
                    false => now,
                };
            }
        }
        let (nearest_m, farthest_m) = conditions.range_m;
        let nearer = self.nearest_m / then.nearest_m;
        if nearer.is_finite() {
            conditions.range_m.0 = (nearest_m * nearer).min(farthest_m);
        }
        conditions
    }
}

/// Below this share of the range from an array's end, the distance from the array counts.
const NEAR_LINE: f64 = 0.9;

/// Motion below this share of another ping's is none.
const RESTING: f64 = 1e-6;

/// One element with its transmitter, through a ping.
struct ReceivingElement {
    transmit_m: DVec3,
    transmit_m_per_s: DVec3,
    transmit_m_per_s2: DVec3,
    transmit_change_m_per_s2: DVec3,
    transmit_from_world: DMat3,
    transmit_leg: Directivity,
    element: Directivity,
    one_way: OneWay,
    /// Way along the array from this element to the last one on its other side, metres.
    line_m: f64,
    pulse_s: f64,
    step_s: f64,
    at: Vec<At>,
}

/// The way of an echo: directions, lengths, and the element where it is heard.
struct Ray {
    out: DVec3,
    out_range_m: f64,
    instant: usize,
    here_m: DVec3,
    back: DVec3,
    back_range_m: f64,
}

/// The element at one instant.
#[derive(Clone, Copy)]
struct At {
    position_m: DVec3,
    velocity_m_per_s: DVec3,
    acceleration_m_per_s2: DVec3,
    /// Of the acceleration within a pulse that begins here.
    change_m_per_s2: DVec3,
    turning_m_per_s: DVec3,
    array_from_world: DMat3,
    /// Along its array.
    axis: DVec3,
}

impl ReceivingElement {
    fn new(
        spec: &SonarSpec,
        plan: &PingPlan,
        transmit: &TransmitArray,
        (array, element): (&ArrayGeometry, usize),
        instants: usize,
    ) -> Self {
        let wavelength_m = plan.sound_speed_m_per_s / plan.pulse.center_frequency_hz;
        let step_s = plan.window_s(spec.receiver.sample_rate_hz) / instants as f64;
        let arm_m = array.element_body_m(element);
        let velocity =
            |t_s: f64, arm_m: DVec3| plan.trajectory.pose_at(t_s).point_velocity_m_per_s(arm_m);
        let acceleration = |t_s: f64, arm_m: DVec3| {
            let a = (velocity(t_s + step_s, arm_m) - velocity(t_s, arm_m)) / step_s;
            if a.length() < STILL_M_PER_S2 {
                DVec3::ZERO
            } else {
                a
            }
        };
        let start = plan.trajectory.pose_at(0.0);
        let place = transmit.mounting.position_m;
        // The largest change from an instant on, within a pulse.
        let pulse_steps = (plan.pulse.duration_s / step_s).ceil().max(1.0) as usize;
        let accelerations: Vec<DVec3> = (0..=instants + pulse_steps)
            .map(|k| acceleration(k as f64 * step_s, arm_m))
            .collect();
        let largest = |of: &[DVec3]| {
            let changes = of[1..].iter().map(|a| *a - of[0]);
            changes.fold(DVec3::ZERO, |most, change| {
                match change.length() > most.length() {
                    true => change,
                    false => most,
                }
            })
        };
        let change = |k: usize| largest(&accelerations[k..=k + pulse_steps]);
        let of_transmitter: Vec<DVec3> = (0..=pulse_steps)
            .map(|k| acceleration(k as f64 * step_s, place))
            .collect();
        Self {
            transmit_m: start.point_m(place),
            transmit_m_per_s: start.point_velocity_m_per_s(place),
            transmit_m_per_s2: acceleration(0.0, place),
            transmit_change_m_per_s2: largest(&of_transmitter),
            transmit_from_world: DMat3::from_quat(
                (start.world_from_body * transmit.mounting.body_from_array).inverse(),
            ),
            transmit_leg: Directivity::new(&transmit.pattern, wavelength_m),
            element: Directivity::new(&array.element_pattern, wavelength_m),
            one_way: OneWay::new(wavelength_m, plan.absorption_db_per_m),
            pulse_s: plan.pulse.duration_s,
            line_m: {
                let to_last_m = (array.elements - 1 - element) as f64 * array.spacing_m;
                let to_first_m = -(element as f64) * array.spacing_m;
                if element == 0 { to_last_m } else { to_first_m }
            },
            step_s,
            at: (0..=instants)
                .map(|k| {
                    let t_s = k as f64 * step_s;
                    let pose = plan.trajectory.pose_at(t_s);
                    let velocity = pose.point_velocity_m_per_s(arm_m);
                    At {
                        position_m: pose.point_m(arm_m),
                        velocity_m_per_s: velocity,
                        acceleration_m_per_s2: accelerations[k],
                        change_m_per_s2: change(k),
                        turning_m_per_s: velocity - pose.velocity_m_per_s,
                        array_from_world: DMat3::from_quat(
                            (pose.world_from_body * array.mounting.body_from_array).inverse(),
                        ),
                        axis: pose.world_from_body * (array.mounting.body_from_array * DVec3::X),
                    }
                })
                .collect(),
        }
    }

    /// The way to a scatterer and back.
    /// `sent_m`: the place as the transmitter sees it.
    fn ray(&self, sent_m: DVec3, place_m: DVec3, c: f64) -> Ray {
        let out_m = sent_m - self.transmit_m;
        let out_range_m = out_m.length().max(f64::MIN_POSITIVE);
        let about_s = (out_range_m + place_m.distance(self.at[0].position_m)) / c;
        let instant = ((about_s / self.step_s) as usize).min(self.at.len() - 1);
        let at = &self.at[instant];
        let since_s = (about_s - instant as f64 * self.step_s).clamp(0.0, self.step_s);
        let here_m = at.position_m + at.velocity_m_per_s * since_s;
        let back_m = place_m - here_m;
        let back_range_m = back_m.length().max(f64::MIN_POSITIVE);
        Ray {
            out: out_m / out_range_m,
            out_range_m,
            instant,
            here_m,
            back: back_m / back_range_m,
            back_range_m,
        }
    }

    /// Distance of a scatterer from the nearest element of the array.
    fn line_distance_m(&self, ray: &Ray, at: &At) -> f64 {
        let back_m = ray.back * ray.back_range_m;
        let (low, high) = (self.line_m.min(0.0), self.line_m.max(0.0));
        let along_m = back_m.dot(at.axis).clamp(low, high);
        (back_m - at.axis * along_m).length()
    }

    fn motion(&self, ray: &Ray) -> EchoMotion {
        let at = &self.at[ray.instant];
        let (v_out, v_back) = (self.transmit_m_per_s, at.velocity_m_per_s);
        let (closing_out, closing_back) = (v_out.dot(ray.out), v_back.dot(ray.back));
        // What is nearer than a wavelength is no far field of anything; see [`crate::conditions`].
        let at_least = |range_m: f64| range_m.max(self.one_way.wavelength_m);
        // Of a leg of length r: r'' = (v^2 - r'^2)/r - a.e, r''' = 3 (v.a - r' r'')/r.
        let leg = |v: DVec3, closing: f64, a: DVec3, ray: DVec3, range_m: f64| {
            let second = (v.length_squared() - closing * closing) / range_m - a.dot(ray);
            (second, 3.0 * (v.dot(a) + closing * second) / range_m)
        };
        let legs = [
            leg(
                v_out,
                closing_out,
                self.transmit_m_per_s2,
                ray.out,
                at_least(ray.out_range_m),
            ),
            leg(
                v_back,
                closing_back,
                at.acceleration_m_per_s2,
                ray.back,
                at_least(ray.back_range_m),
            ),
        ];
        let mut change = [0.5 * (legs[0].0 + legs[1].0), 0.5 * (legs[0].1 + legs[1].1)];
        // Elements between the ends may be nearer, and what is very near soon lies in another direction: 2/sqrt(3) v^3/d^2 is the greatest of
        // 3 v r'(1 - r'^2/v^2) v/d^2.
        let ends_m = ray.out_range_m.min(ray.back_range_m);
        let nearest_m = at_least(self.line_distance_m(ray, at).min(ends_m));
        let v = v_back.length();
        if nearest_m < (NEAR_LINE * ends_m).max(NEAR_WAYS * v * self.pulse_s) {
            let a = at.acceleration_m_per_s2.length();
            let most = [
                v * v / nearest_m + a,
                (2.0 / 3f64.sqrt() * v * v / nearest_m + 3.0 * a) * v / nearest_m,
            ];
            for ((value, most), leg) in change.iter_mut().zip(most).zip([legs[0].0, legs[0].1]) {
                *value = value.abs().max(0.5 * (leg.abs() + most));
            }
        }
        EchoMotion {
            values: [
                (ray.here_m - self.at[0].position_m).dot(ray.back),
                0.5 * (closing_out + closing_back),
                change[0],
                change[1],
                at.acceleration_m_per_s2.dot(ray.back),
                at.turning_m_per_s.dot(ray.back),
                self.transmit_change_m_per_s2
                    .dot(ray.out)
                    .abs()
                    .max(at.change_m_per_s2.dot(ray.back).abs()),
            ],
            across_m_per_s: closing_back - v_back.dot(at.axis) * at.axis.dot(ray.back),
        }
    }

    fn accumulate(
        &self,
        plan: &PingPlan,
        scatterers: &Scatterers,
        part_s: f64,
        parts: &mut [Part],
    ) {
        // Of a pulse, in parts.
        let length = plan.pulse.duration_s / part_s;
        let floor = plan.model.cull_db.map_or(0.0, amplitude_from_db);
        let curve = scatterers.curve.as_deref();
        for (i, weight) in sampled(scatterers, SAMPLE_SIZE) {
            let law = scatterers.law[i];
            let place_m = scatterers.position_m(i);
            let ray = self.ray(scatterers.transmit_m(i), place_m, plan.sound_speed_m_per_s);
            let (out, back) = (ray.out, ray.back);
            let at = &self.at[ray.instant];
            let begins = (ray.out_range_m + ray.back_range_m) / plan.sound_speed_m_per_s / part_s;
            if begins as usize >= parts.len() {
                continue;
            }
            let towards = |d: &Directivity, m: &DMat3, ray: DVec3| {
                let u = *m * ray;
                d.towards(u.x, u.y, u.z)
            };
            let level = towards(&self.transmit_leg, &self.transmit_from_world, out)
                * towards(&self.element, &at.array_from_world, back);
            let floor = plan
                .range_floors
                .at(floor, half_path_m(scatterers, i, self.transmit_m));
            if level.abs() * f64::from(scatterers.loud[i]) < floor {
                continue;
            }
            let facing = |normal: [f32; 3], ray: DVec3| {
                (-DVec3::from_array(normal.map(f64::from)).dot(ray)).max(0.0)
            };
            let facing_out = facing(scatterers.transmit_normal(i), out);
            let facing_back = facing(scatterers.normal[i], back);
            let law = match law {
                ScatterLaw::Point | ScatterLaw::Water => 1.0,
                ScatterLaw::Lambert => (facing_out * facing_back).sqrt(),
                ScatterLaw::LambertOneWay => facing_out,
                ScatterLaw::Curve => curve.map_or(0.0, |curve| {
                    curve.half(facing_out.sqrt().min(1.0)) * curve.half(facing_back.sqrt().min(1.0))
                }),
            };
            let amplitude = level
                * law
                * self.one_way.amplitude(ray.out_range_m)
                * self.one_way.amplitude(ray.back_range_m);
            let energy = weight * amplitude * amplitude * scatterers.strength[i].norm_sqr();
            let echo = self.motion(&ray);
            let first = &mut parts[begins as usize];
            first.echoes += weight;
            first.begun += energy;
            first.begun2 += energy * energy;
            let mut from = 0.0;
            for (k, part) in parts.iter_mut().enumerate().skip(begins as usize) {
                if from >= 1.0 {
                    break;
                }
                let to = (((k + 1) as f64 - begins) / length).min(1.0);
                part.add(energy, energy / weight, (from, to), &echo);
                from = to;
            }
        }
    }
}

/// Of all pairs of scatterer and element.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Shares {
    /// Above the floor as the transmitter sees them: these are walked.
    pub transmit_leg: f64,
    /// ... and as the element hears them: these are summed.
    pub kept: f64,
}

impl Shares {
    pub(crate) const ALL: Self = Self {
        transmit_leg: 1.0,
        kept: 1.0,
    };
}

/// What the pattern floors leave. `cull_db`: the one of the model.
pub(crate) fn kept_shares(
    spec: &SonarSpec,
    plan: &PingPlan,
    scatterers: &Scatterers,
    cull_db: f64,
) -> Shares {
    let floor = amplitude_from_db(cull_db);
    let (mut all, mut transmit_leg, mut kept) = (0.0, 0.0, 0.0);
    let stride = scatterers.len().div_ceil(SAMPLE_SIZE).max(1);
    for array in &spec.receive {
        let transmit = &spec.transmit[array.transmit];
        let receiver = ReceivingElement::new(spec, plan, transmit, (array, 0), 1);
        let at = &receiver.at[0];
        let pairs = array.elements as f64;
        for i in (0..scatterers.len()).step_by(stride) {
            let place_m = scatterers.position_m(i);
            let out_m = scatterers.transmit_m(i) - receiver.transmit_m;
            let out = receiver.transmit_from_world * out_m.normalize_or_zero();
            let back = at.array_from_world * (place_m - at.position_m).normalize_or_zero();
            let loud = f64::from(scatterers.loud[i]);
            let sent = (receiver.transmit_leg.towards(out.x, out.y, out.z) * loud).abs();
            let level = (sent * receiver.element.towards(back.x, back.y, back.z)).abs();
            let floor = plan
                .range_floors
                .at(floor, half_path_m(scatterers, i, receiver.transmit_m));
            all += pairs;
            transmit_leg += if sent >= floor { pairs } else { 0.0 };
            kept += if level >= floor { pairs } else { 0.0 };
        }
    }
    let share = |sum: f64| if all > 0.0 { sum / all } else { 0.0 };
    Shares {
        transmit_leg: share(transmit_leg),
        kept: share(kept),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::f64::consts::TAU;

    use num_complex::Complex64;
    use rand_chacha::ChaCha8Rng;
    use rand_chacha::rand_core::{Rng, SeedableRng};

    /// Samples of a window.
    const SAMPLES: usize = 6;

    /// Windows of so many echoes at random phases, with amplitudes from `amplitudes` and errors that differ from echo to echo: the largest error of
    /// many windows is below the prediction, and not far below. Independent of the model: samples are drawn and summed.
    #[test]
    fn the_worst_of_many_windows_is_predicted() {
        let trials = 20_000;
        let mut chance = ChaCha8Rng::seed_from_u64(7);
        let mut turn = || TAU * f64::from(chance.next_u32()) / 2f64.powi(32);
        for amplitudes in [
            &[1.0][..],
            &[1.0, 0.3],
            &[1.0, 0.8],
            &[1.0, 0.7, 0.5],
            &[1.0; 40],
        ] {
            let phases: Vec<f64> = (0..amplitudes.len())
                .map(|i| 1e-3 * (1.0 + (i as f64 * 0.618).fract()))
                .collect();
            let mut worst = 0.0f64;
            for _ in 0..trials {
                let mut got = [Complex64::ZERO; SAMPLES];
                let mut off = [Complex64::ZERO; SAMPLES];
                for (amplitude, phase) in amplitudes.iter().zip(&phases) {
                    for k in 0..SAMPLES {
                        let sample = Complex64::from_polar(*amplitude, turn());
                        got[k] += sample;
                        off[k] += sample * phase;
                    }
                }
                let energy = |all: &[Complex64]| all.iter().map(|x| x.norm_sqr()).sum::<f64>();
                worst = worst.max((energy(&off) / energy(&got)).sqrt());
            }
            let mut window = Part::default();
            for _ in 0..PARTS {
                let mut part = Part::default();
                for (amplitude, phase) in amplitudes.iter().zip(&phases) {
                    let energy = amplitude * amplitude / PARTS as f64;
                    part.energy += energy;
                    part.loudest = part.loudest.max(amplitude * amplitude);
                    part.loudest_here = part.loudest_here.max(energy);
                    part.sums[0] += energy * phase;
                    part.squares[0] += energy * phase * phase;
                }
                window = window.and(&part);
            }
            let looks = f64::from(trials).ln();
            let (amounts, _) = window.amounts(1e-9, looks, SAMPLES as f64);
            println!("{amplitudes:?}: {worst:.2e}, predicted {:.2e}", amounts[0]);
            // A lone echo is predicted exactly.
            assert!(
                worst <= amounts[0] * (1.0 + 1e-9),
                "{amplitudes:?}: {worst:e} > {:e}",
                amounts[0]
            );
            assert!(
                amounts[0] <= 6.0 * worst,
                "{amplitudes:?}: {:e} of {worst:e}",
                amounts[0]
            );
        }
    }
}

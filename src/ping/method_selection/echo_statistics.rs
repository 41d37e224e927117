//! Motion along the rays of a ping, weighted with the energy of their echoes. The closed forms of the error models hold for echoes from any
//! direction, but a beam to the side receives none from ahead.
//!
//! In: a ping's plan and scatterers. Out: [`EchoStatistics`]. Of a seabed, only an even sample of the scatterers is used;
//! points and targets are all used.

use glam::{DMat3, DVec3};

use echotank_config::spec::SonarSpec;
use echotank_core::arrays::{ArrayGeometry, TransmitArray};
use echotank_core::ping::PingPlan;
use echotank_core::scene::{ScatterLaw, Scatterers};
use echotank_synthesis::echo::levels::{Directivity, OneWay, amplitude_from_db};
use echotank_synthesis::error_model::EchoStatistics;

/// Approximate number of seabed scatterers in the sample. In each of a hundred windows they give root mean squares within a tenth.
pub const SAMPLE_SIZE: usize = 20_000;
/// Instants at which an element's motion is tabled.
const INSTANTS: usize = 64;
/// A window is a pulse long, but so many samples at least, as error checks have it.
pub(super) const MIN_WINDOW: usize = 32;
/// Rounding of finite differences of velocities, m/s^2.
const STILL_M_PER_S2: f64 = 1e-9;
/// What a sample of the echoes and of the elements, and motion tabled at instants, may leave out of a root mean square.
const SAMPLED: f64 = 1.1;

/// A window may begin anywhere, and cut an echo anywhere: it is put together of so many parts, and looked at from each of them on.
const PARTS: usize = 4;

/// Quantities of [`EchoStatistics`] that are root mean squares.
const QUANTITIES: usize = 7;

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

/// What sounds in a part of a window: energy, and the weighted squares of [`EchoStatistics`]'s quantities.
#[derive(Clone, Copy, Default)]
struct Part {
    energy: f64,
    squares: [f64; QUANTITIES],
    /// Of the loudest echo, all of it.
    loudest: f64,
    /// Of the echoes that begin here: how many, their energy, and the sum of its squares.
    echoes: f64,
    begun: f64,
    begun2: f64,
}

impl Part {
    fn and(mut self, other: &Self) -> Self {
        self.energy += other.energy;
        for (sum, square) in self.squares.iter_mut().zip(other.squares) {
            *sum += square;
        }
        self.loudest = self.loudest.max(other.loudest);
        self.echoes += other.echoes;
        self.begun += other.begun;
        self.begun2 += other.begun2;
        self
    }

    /// Of an echo what sounds here, `from` and `to` in pulses.
    fn add(&mut self, energy: f64, whole: f64, (from, to): (f64, f64), values: [f64; QUANTITIES]) {
        let share = energy * (to - from);
        self.energy += share;
        self.loudest = self.loudest.max(whole);
        // Phases of Doppler grow with time, those of its change with the square: the end of a pulse has more of them than its beginning.
        let grown = |power: i32| energy * (to.powi(power) - f64::powi(from, power));
        let shares = [share, grown(3), grown(5), share, share, share, share];
        for ((sum, value), share) in self.squares.iter_mut().zip(values).zip(shares) {
            *sum += share * value * value;
        }
    }
}

/// Statistics of the received echoes; `None` without echoes.
pub fn echo_statistics(
    spec: &SonarSpec,
    plan: &PingPlan,
    scatterers: &Scatterers,
) -> Option<EchoStatistics> {
    let rate_hz = spec.receiver.sample_rate_hz;
    let window_s = plan.pulse.duration_s.max(MIN_WINDOW as f64 / rate_hz);
    let windows = (plan.window_s(rate_hz) / window_s).ceil().max(1.0) as usize;
    let part_s = window_s / PARTS as f64;
    let mut worst = [0.0f64; QUANTITIES];
    let mut sounded = false;
    // Echoes in a loud window that count, at most; the loudest of a window; all of them.
    let mut crowd = 1.0f64;
    let (mut strongest_share, mut echoes) = (0.0f64, 0.0);
    let mut parts = vec![Part::default(); windows * PARTS];
    for array in &spec.receive {
        let transmit = &spec.transmit[array.transmit];
        let ends = [0, array.elements - 1];
        let ends = &ends[..array.elements.min(2)];
        let each = array.elements as f64 / ends.len() as f64;
        for &element in ends {
            parts.fill(Part::default());
            let receiver = ReceivingElement::new(spec, plan, transmit, array, element);
            receiver.accumulate(plan, scatterers, part_s, &mut parts);
            echoes += each * parts.iter().map(|part| part.echoes).sum::<f64>();
            let mean = parts.iter().map(|part| part.energy).sum::<f64>() / windows as f64;
            if mean == 0.0 {
                continue;
            }
            sounded = true;
            for window in parts.windows(PARTS) {
                let window = window.iter().fold(Part::default(), Part::and);
                if window.energy > mean && window.begun > 0.0 {
                    crowd = crowd.max(window.begun.powi(2) / window.begun2);
                }
                let against = window.energy.max(mean);
                strongest_share = strongest_share.max(window.loudest / against);
                for (worst, square) in worst.iter_mut().zip(window.squares) {
                    *worst = worst.max((square / against).sqrt());
                }
            }
        }
    }
    let [
        displacement,
        closing,
        range_acceleration,
        acceleration,
        turning,
        across,
        of_echoes,
    ] = worst;
    let elements: usize = spec.receive.iter().map(|array| array.elements).sum();
    sounded.then(|| EchoStatistics {
        displacement_m: displacement,
        closing_m_per_s: closing,
        closing_of_echoes_m_per_s: of_echoes,
        range_acceleration_m_per_s2: range_acceleration,
        acceleration_m_per_s2: acceleration,
        turning_m_per_s: turning,
        across_m_per_s: across,
        spread: 1.0
            + (spread(plan, window_s, windows * elements, crowd) - 1.0) * (1.0 - 1.0 / crowd),
        strongest_share,
        echoes,
    })
}

/// Of many echoes at random phases. Mean squares of n independent samples of Gaussian noise: the greatest of `looks` is 1 + 2 sqrt(L/n) + 2 L/n times the mean, L = ln looks
/// (Laurent and Massart 2000, Lemma 1, in its sharper form for two degrees of freedom each: 1 + sqrt(2L/n) + L/n). A window has no more
/// independent samples than echoes.
fn spread(plan: &PingPlan, window_s: f64, looks: usize, crowd: f64) -> f64 {
    let independent = (1.0 + plan.pulse.bandwidth_hz * window_s).min(crowd);
    let l = (looks.max(2) as f64).ln() / independent;
    SAMPLED * (1.0 + (2.0 * l).sqrt() + l).sqrt()
}

/// One element with its transmitter, through a ping.
struct ReceivingElement {
    transmit_m: DVec3,
    transmit_m_per_s: DVec3,
    transmit_m_per_s2: DVec3,
    transmit_from_world: DMat3,
    transmit_leg: Directivity,
    element: Directivity,
    one_way: OneWay,
    step_s: f64,
    at: Vec<At>,
}

/// The element at one instant.
#[derive(Clone, Copy)]
struct At {
    position_m: DVec3,
    velocity_m_per_s: DVec3,
    acceleration_m_per_s2: DVec3,
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
        array: &ArrayGeometry,
        element: usize,
    ) -> Self {
        let wavelength_m = plan.sound_speed_m_per_s / plan.pulse.center_frequency_hz;
        let step_s = plan.window_s(spec.receiver.sample_rate_hz) / INSTANTS as f64;
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
        Self {
            transmit_m: start.point_m(place),
            transmit_m_per_s: start.point_velocity_m_per_s(place),
            transmit_m_per_s2: acceleration(0.0, place),
            transmit_from_world: DMat3::from_quat(
                (start.world_from_body * transmit.mounting.body_from_array).inverse(),
            ),
            transmit_leg: Directivity::new(&transmit.pattern, wavelength_m),
            element: Directivity::new(&array.element_pattern, wavelength_m),
            one_way: OneWay::new(wavelength_m, plan.absorption_db_per_m),
            step_s,
            at: (0..=INSTANTS)
                .map(|k| {
                    let t_s = k as f64 * step_s;
                    let pose = plan.trajectory.pose_at(t_s);
                    let velocity = pose.point_velocity_m_per_s(arm_m);
                    At {
                        position_m: pose.point_m(arm_m),
                        velocity_m_per_s: velocity,
                        acceleration_m_per_s2: acceleration(t_s, arm_m),
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
            let out_m = place_m - self.transmit_m;
            let out_range_m = out_m.length().max(f64::MIN_POSITIVE);
            let out = out_m / out_range_m;
            let per_c = 1.0 / plan.sound_speed_m_per_s;
            let about_s = per_c * (out_range_m + place_m.distance(self.at[0].position_m));
            let k = ((about_s / self.step_s) as usize).min(self.at.len() - 1);
            let at = &self.at[k];
            let since_s = (about_s - k as f64 * self.step_s).clamp(0.0, self.step_s);
            let here_m = at.position_m + at.velocity_m_per_s * since_s;
            let back_m = place_m - here_m;
            let back_range_m = back_m.length().max(f64::MIN_POSITIVE);
            let back = back_m / back_range_m;
            let u_s = per_c * (out_range_m + back_range_m);
            let begins = u_s / part_s;
            if begins as usize >= parts.len() {
                continue;
            }
            let towards = |d: &Directivity, m: &DMat3, ray: DVec3| {
                let u = *m * ray;
                d.towards(u.x, u.y, u.z)
            };
            let level = towards(&self.transmit_leg, &self.transmit_from_world, out)
                * towards(&self.element, &at.array_from_world, back);
            if level.abs() * f64::from(scatterers.loud[i]) < floor {
                continue;
            }
            let [a, b, c] = scatterers.normal[i].map(f64::from);
            let normal = DVec3::new(a, b, c);
            let facing = |ray: DVec3| (-normal.dot(ray)).max(0.0);
            let law = match law {
                ScatterLaw::Point => 1.0,
                ScatterLaw::Lambert => (facing(out) * facing(back)).sqrt(),
                ScatterLaw::LambertOneWay => facing(out),
                ScatterLaw::Curve => curve.map_or(0.0, |curve| {
                    curve.half(facing(out).sqrt().min(1.0))
                        * curve.half(facing(back).sqrt().min(1.0))
                }),
            };
            let amplitude = level
                * law
                * self.one_way.amplitude(out_range_m)
                * self.one_way.amplitude(back_range_m);
            let energy = weight * amplitude * amplitude * scatterers.strength[i].norm_sqr();
            let (v_out, v_back) = (self.transmit_m_per_s, at.velocity_m_per_s);
            let (closing_out, closing_back) = (v_out.dot(out), v_back.dot(back));
            let leg_acceleration = |v: DVec3, closing: f64, a: DVec3, ray: DVec3, range_m: f64| {
                (v.length_squared() - closing * closing) / range_m - a.dot(ray)
            };
            let range_acceleration = 0.5
                * (leg_acceleration(v_out, closing_out, self.transmit_m_per_s2, out, out_range_m)
                    + leg_acceleration(
                        v_back,
                        closing_back,
                        at.acceleration_m_per_s2,
                        back,
                        back_range_m,
                    ));
            let closing = 0.5 * (closing_out + closing_back);
            let values = [
                (here_m - self.at[0].position_m).dot(back),
                closing,
                range_acceleration,
                at.acceleration_m_per_s2.dot(back),
                at.turning_m_per_s.dot(back),
                v_back.dot(back) - v_back.dot(at.axis) * at.axis.dot(back),
                closing,
            ];
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
                part.add(energy, energy / weight, (from, to), values);
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

/// What each floor (dB; none is no floor) leaves.
pub(crate) fn kept_shares(
    spec: &SonarSpec,
    plan: &PingPlan,
    scatterers: &Scatterers,
    floors_db: &[Option<f64>],
) -> Vec<Shares> {
    let floors: Vec<f64> = floors_db
        .iter()
        .map(|db| db.map_or(f64::MIN_POSITIVE, amplitude_from_db))
        .collect();
    let (mut all, mut sums) = (0.0, vec![(0.0, 0.0); floors.len()]);
    let stride = scatterers.len().div_ceil(SAMPLE_SIZE).max(1);
    for array in &spec.receive {
        let receiver = ReceivingElement::new(spec, plan, &spec.transmit[array.transmit], array, 0);
        let at = &receiver.at[0];
        let pairs = array.elements as f64;
        for i in (0..scatterers.len()).step_by(stride) {
            let place_m = scatterers.position_m(i);
            let out =
                receiver.transmit_from_world * (place_m - receiver.transmit_m).normalize_or_zero();
            let back = at.array_from_world * (place_m - at.position_m).normalize_or_zero();
            let loud = f64::from(scatterers.loud[i]);
            let sent = (receiver.transmit_leg.towards(out.x, out.y, out.z) * loud).abs();
            let level = (sent * receiver.element.towards(back.x, back.y, back.z)).abs();
            all += pairs;
            for ((transmit_leg, kept), floor) in sums.iter_mut().zip(&floors) {
                *transmit_leg += if sent >= *floor { pairs } else { 0.0 };
                *kept += if level >= *floor { pairs } else { 0.0 };
            }
        }
    }
    let share = |sum: f64| if all > 0.0 { sum / all } else { 0.0 };
    sums.into_iter()
        .map(|(transmit_leg, kept)| Shares {
            transmit_leg: share(transmit_leg),
            kept: share(kept),
        })
        .collect()
}

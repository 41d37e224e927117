//! Reference solution: the retarded-time sum, sample by sample, on the continuous trajectory.
//!
//! A sample received at t was transmitted at t' with c (t - t') = |S - p_T(t')| + |S - r_e(t)|. The
//! samples are x_e(t) = sum A a(t') exp(j 2pi f_c (t' - t)). Newton's iteration solves t' for every
//! sample and scatterer.
//!
//! Transmitter and receiver follow the [`Trajectory`], including rotation, during the pulse and
//! during the echo. A has its value at the leading edge. The sum uses f64 without linearisation,
//! pattern culling or segments, and ignores the plan's path and Doppler models. It shares only the
//! sonar equation with the fast walk.

use glam::{DMat3, DQuat, DVec3};
use num_complex::Complex64;

use crate::array::filter::Decimator;
use crate::array::quadrature::Quadrature;
use echotank_core::arrays::{ArrayGeometry, TransmitArray};
use echotank_core::frames::Trajectory;
use echotank_core::ping::{EchoCounts, PingPlan};
use echotank_core::scene::{LawCurve, ScatterLaw, Scatterers};

use super::levels::{Directivity, OneWay, amplitude_from_db};

/// Maximum number of Newton steps. A step that leaves the bracket is replaced by bisection, and 60
/// bisections reach the last bit of f64.
const MAX_STEPS: usize = 80;

/// Overwrites `out` with the echoes of all scatterers at one element: complex envelope, volts
/// (rms), after the receiver filter if there is one.
///
/// Sample k is `first_sample_s + k / rate_hz` seconds after the start of the pulse. An echo covers
/// 0 <= t' <= T, both ends inclusive. With a filter, `rate_hz` must be its sample rate.
#[expect(
    clippy::too_many_arguments,
    reason = "the whole problem, each part a noun of its own"
)]
pub fn reference(
    plan: &PingPlan,
    tx: &TransmitArray,
    array: &ArrayGeometry,
    element: usize,
    scatterers: &Scatterers,
    filter: Option<&Decimator>,
    rate_hz: f64,
    first_sample_s: f64,
    out: &mut [Complex64],
) -> EchoCounts {
    out.fill(Complex64::ZERO);
    let mut counts = EchoCounts::default();
    let c = plan.sound_speed_m_per_s;
    let carrier_hz = plan.pulse.center_frequency_hz;
    let duration_s = plan.pulse.duration_s;

    let (track, origin_m) = near_origin(&plan.trajectory);
    let transmitter = BodyPoint {
        track: &track,
        body_m: tx.mounting.position_m,
    };
    let receiver = BodyPoint {
        track: &track,
        body_m: array.element_body_m(element),
    };
    let time_s = |k: usize| first_sample_s + k as f64 / rate_hz;
    let mut quadrature = filter.map(|filter| Quadrature::new(filter, first_sample_s, out.len()));
    let shared_s: Vec<f64> = match &quadrature {
        Some(quadrature) => quadrature.shared_s().collect(),
        None => (0..out.len()).map(time_s).collect(),
    };
    let receiver_m: Vec<DVec3> = shared_s.iter().map(|&t_s| receiver.at(t_s).0).collect();
    let sonar = Sonar::new(plan, tx, (array, element), &track);
    let transmit_m = transmitter.at(0.0).0;
    let last_transmit_m = transmitter.at(duration_s).0;
    let tail_s = filter.map_or(0.0, Decimator::response_half_s);
    let flank_s = 0.5 * plan.pulse.taper * duration_s;
    let breaks_s = [0.0, flank_s, duration_s - flank_s, duration_s];

    for i in 0..scatterers.len() {
        let at_m = scatterers.position_m(i) - origin_m;
        // The same point, unless the echo is reflected on one leg.
        let sent_m = scatterers.transmit_m(i) - origin_m;
        // Time at which the sound of an emission time arrives.
        let received_s = |emitted_s: f64, from_m: DVec3| {
            receive_time_s(c, c * emitted_s + sent_m.distance(from_m), at_m, &receiver)
        };
        let first_leg_m = sent_m.distance(transmit_m);
        let leading_s = received_s(0.0, transmit_m);
        let trailing_s = received_s(duration_s, last_transmit_m);
        // The range has one spare sample at either end. The condition on t' decides whether a
        // sample is in the echo.
        let first = ((leading_s - tail_s - first_sample_s) * rate_hz).floor() - 1.0;
        let end = ((trailing_s + tail_s - first_sample_s) * rate_hz).ceil() + 2.0;
        let range = (first.max(0.0) as usize)..(end.max(0.0) as usize).min(out.len());
        if range.is_empty() {
            counts.outside_window += 1;
            continue;
        }
        counts.used += 1;
        let receive_m = receiver.at(leading_s).0;
        let second_leg_m = at_m.distance(receive_m);
        counts.too_close += u64::from(first_leg_m.min(second_leg_m) < sonar.one_way.wavelength_m);
        let amplitude = scatterers.strength[i]
            * sonar.amplitude(
                sent_m - transmit_m,
                at_m - receive_m,
                leading_s,
                facing(scatterers, i),
            );
        let mut guess_s = 0.0;
        let mut value = |t_s: f64, second_leg_m: f64| {
            let emitted_s = newton(0.0, duration_s, guess_s, |emitted_s| {
                let (place_m, velocity) = transmitter.at(emitted_s);
                let ray_m = sent_m - place_m;
                let leg_m = ray_m.length();
                let residual = c * (t_s - emitted_s) - leg_m - second_leg_m;
                let slope = velocity.dot(ray_m) / leg_m.max(f64::MIN_POSITIVE) - c;
                (-residual, -slope)
            });
            guess_s = emitted_s + 1.0 / rate_hz;
            let cycles = carrier_hz * (emitted_s - t_s);
            let (sin, cos) = libm::sincos(std::f64::consts::TAU * (cycles - cycles.round()));
            // Newton may end slightly outside the pulse, so t' is clamped.
            let sent = plan.pulse.envelope(emitted_s.clamp(0.0, duration_s));
            amplitude * sent * Complex64::new(cos, sin)
        };
        if let Some(quadrature) = &mut quadrature {
            for ends_s in breaks_s.windows(2).filter(|ends_s| ends_s[1] > ends_s[0]) {
                let [begin_s, end_s] = [ends_s[0], ends_s[1]]
                    .map(|emitted_s| received_s(emitted_s, transmitter.at(emitted_s).0));
                quadrature.add((begin_s, end_s), |t_s, shared| {
                    let place_m = shared.map_or_else(|| receiver.at(t_s).0, |k| receiver_m[k]);
                    value(t_s, at_m.distance(place_m))
                });
            }
            continue;
        }
        for k in range {
            let t_s = time_s(k);
            let second_leg_m = at_m.distance(receiver_m[k]);
            // c (t - t') - |S - p_T(t')| - second leg decreases with t', so its signs at the ends
            // of the pulse show whether t' is in the pulse.
            let before = c * t_s - first_leg_m - second_leg_m;
            let after = c * (t_s - duration_s) - sent_m.distance(last_transmit_m) - second_leg_m;
            if before >= 0.0 && after <= 0.0 {
                out[k] += value(t_s, second_leg_m);
            }
        }
    }
    if let Some(quadrature) = quadrature {
        quadrature.finish(out);
    }
    counts
}

/// Moves the trajectory so that its first knot is at zero, and returns the original position of
/// that knot. This keeps precision far from the world's origin.
fn near_origin(trajectory: &Trajectory) -> (Trajectory, DVec3) {
    let mut track = trajectory.clone();
    let origin_m = track.position.first().map_or(DVec3::ZERO, |k| k.value);
    for knot in &mut track.position {
        knot.value -= origin_m;
    }
    (track, origin_m)
}

/// A body-fixed point on the trajectory.
struct BodyPoint<'a> {
    track: &'a Trajectory,
    body_m: DVec3,
}

impl BodyPoint<'_> {
    /// Position and velocity in world axes.
    fn at(&self, time_s: f64) -> (DVec3, DVec3) {
        let pose = self.track.pose_at(time_s);
        (
            pose.point_m(self.body_m),
            pose.point_velocity_m_per_s(self.body_m),
        )
    }
}

/// Time at which the sound reaches the receiver, seconds: c t = travelled + |S - r(t)|.
/// `travelled_m` is the path up to the scatterer, in metres since t = 0.
fn receive_time_s(c: f64, travelled_m: f64, at_m: DVec3, receiver: &BodyPoint) -> f64 {
    let residual = |t_s: f64| {
        let (place_m, velocity) = receiver.at(t_s);
        let ray_m = at_m - place_m;
        let leg_m = ray_m.length();
        (
            c * t_s - travelled_m - leg_m,
            c + velocity.dot(ray_m) / leg_m.max(f64::MIN_POSITIVE),
        )
    };
    let low_s = travelled_m / c;
    let leg_s = at_m.distance(receiver.at(low_s).0) / c;
    // The receiver is slower than 0.1 c, so twice the leg is an upper bound. The margin guarantees
    // that the search ends for any trajectory.
    let mut high_s = low_s + 2.0 * leg_s + 1e-6;
    for _ in 0..60 {
        if residual(high_s).0 >= 0.0 {
            break;
        }
        high_s = low_s + 2.0 * (high_s - low_s);
    }
    newton(low_s, high_s, low_s + leg_s, residual)
}

/// Root of an increasing function between `low` and `high`, accurate to the last bits. The method
/// is Newton's iteration, with bisection if a step leaves the bracket.
fn newton(mut low: f64, mut high: f64, start: f64, f: impl Fn(f64) -> (f64, f64)) -> f64 {
    let mut x = start.clamp(low, high);
    for _ in 0..MAX_STEPS {
        let (value, slope) = f(x);
        if value < 0.0 {
            low = x;
        } else {
            high = x;
        }
        let mut next = x - value / slope;
        if !(next >= low && next <= high) {
            next = 0.5 * (low + high);
        }
        let step = (next - x).abs();
        x = next;
        if step <= f64::EPSILON * x.abs().max(1e-3) {
            break;
        }
    }
    x
}

/// Orientation and scattering law of a scatterer: law, normals as the transmit and the receive leg see them, and the curve of a curved law.
pub(super) type Facing<'a> = (ScatterLaw, [[f32; 3]; 2], Option<&'a LawCurve>);

pub(super) fn facing(scatterers: &Scatterers, i: usize) -> Facing<'_> {
    (
        scatterers.law[i],
        [scatterers.transmit_normal(i), scatterers.normal[i]],
        scatterers.curve.as_deref(),
    )
}

/// The sonar equation for one element.
pub(super) struct Sonar<'a> {
    track: &'a Trajectory,
    tx: &'a TransmitArray,
    body_from_element: DQuat,
    transmit_pattern: Directivity,
    element_pattern: Directivity,
    one_way: OneWay,
    /// Product of source level and sensitivity.
    gain: f64,
}

impl<'a> Sonar<'a> {
    pub(super) fn new(
        plan: &PingPlan,
        tx: &'a TransmitArray,
        (array, element): (&ArrayGeometry, usize),
        track: &'a Trajectory,
    ) -> Self {
        let wavelength_m = plan.sound_speed_m_per_s / plan.pulse.center_frequency_hz;
        Self {
            track,
            tx,
            body_from_element: array.element_mounting(element).body_from_array,
            transmit_pattern: Directivity::new(&tx.pattern, wavelength_m),
            element_pattern: Directivity::new(&array.element_pattern, wavelength_m),
            one_way: OneWay::new(wavelength_m, plan.absorption_db_per_m),
            gain: amplitude_from_db(
                plan.settings.source_level_db + tx.level_offset_db + array.sensitivity_db,
            ),
        }
    }

    /// Amplitude of a unit scatterer, volts. Rays point from the sonar to the scatterer.
    fn amplitude(
        &self,
        transmit_ray_m: DVec3,
        receive_ray_m: DVec3,
        leading_s: f64,
        facing: Facing,
    ) -> f64 {
        let attitude = |time_s: f64| self.track.pose_at(time_s).world_from_body;
        self.amplitude_seen_from(
            (transmit_ray_m, attitude(0.0)),
            (receive_ray_m, attitude(leading_s)),
            facing,
        )
    }

    /// As [`Self::amplitude`], for given attitudes of the platform at transmission and reception.
    pub(super) fn amplitude_seen_from(
        &self,
        (transmit_ray_m, transmit_attitude): (DVec3, DQuat),
        (receive_ray_m, receive_attitude): (DVec3, DQuat),
        (law, normals, curve): Facing,
    ) -> f64 {
        let towards = |pattern: &Directivity, ray_m: DVec3, world_from_body: DQuat, mounting| {
            let array_from_world = DMat3::from_quat(world_from_body * mounting).transpose();
            let u = array_from_world * ray_m.normalize_or_zero();
            pattern.towards(u.x, u.y, u.z)
        };
        let transmit = towards(
            &self.transmit_pattern,
            transmit_ray_m,
            transmit_attitude,
            self.tx.mounting.body_from_array,
        );
        let receive = towards(
            &self.element_pattern,
            receive_ray_m,
            receive_attitude,
            self.body_from_element,
        );
        let [of_transmit, of_receive] = normals.map(|n| DVec3::from_array(n.map(f64::from)));
        let facing =
            |ray_m: DVec3, normal: DVec3| (-normal.dot(ray_m.normalize_or_zero())).max(0.0);
        let transmit_facing = facing(transmit_ray_m, of_transmit);
        let receive_facing = facing(receive_ray_m, of_receive);
        let law = match (law, curve) {
            (ScatterLaw::Point | ScatterLaw::Water, _) => 1.0,
            (ScatterLaw::Lambert, _) => (transmit_facing * receive_facing).sqrt(),
            (ScatterLaw::LambertOneWay, _) => transmit_facing,
            (ScatterLaw::Curve, Some(curve)) => {
                let half = |facing: f64| match facing {
                    0.0 => 0.0,
                    cosine => curve.half(cosine.sqrt()),
                };
                half(transmit_facing) * half(receive_facing)
            }
            (ScatterLaw::Curve, None) => 0.0,
        };
        self.gain
            * transmit
            * self.one_way.amplitude(transmit_ray_m.length())
            * law
            * self.one_way.amplitude(receive_ray_m.length())
            * receive
    }
}

//! Echoes of moving scatterers, by the exact times of emission, hit and reception.
//!
//! A scatterer S moves with a constant acceleration during the echo, the transmitter p and the element r on the trajectory of the platform. For sound
//! emitted at t'
//!
//! ```text
//! hit        c (t1 - t') = |S(t1) - p(t')|        in closed form without acceleration, and Newton's iteration
//! reception  c (t - t1) = |S(t1) - r(t)|          by Newton's iteration
//! ```
//!
//! (of a reflected echo whose legs differ, S is the image that the transmitter sees in the first line, and the one that the receiver sees in the second)
//! solved for the beginning, the middle and the end of the pulse. The parabola through the three gives the delay of the leading edge, the Doppler and its
//! change as in [`ArrivalChunk`]; its error is of third order in the pulse length. The element's own track around the echo is the parabola through three poses;
//! its error is of third order in the pulse length and the time that sound takes along the array.
//!
//! Nothing depends on the plan's path and Doppler models, and no echo is culled: moving scatterers are few. Amplitudes follow
//! [`levels`](super::levels) at the leading edge.
//!
//! [`MovingEchoes::checked`] solves sound between these instants on the whole trajectory and tells how far the parabola is off.

use std::f64::consts::TAU;

use glam::{DMat3, DQuat, DVec3};
use num_complex::Complex64;
use rayon::prelude::*;

use super::levels::{Directivity, OneWay, amplitude_from_db};
use crate::arrivals::{ArrivalChunk, ArrivalSink, CHUNK};
use echotank_core::arrays::{ArrayGeometry, Pattern, TransmitArray};
use echotank_core::ping::{EchoCounts, PingPlan};
use echotank_core::scene::{MovingScatterer, ScatterLaw};

/// Instants of the pulse for which the times are solved, as shares of its length.
const INSTANTS: [f64; 3] = [0.0, 0.5, 1.0];
/// Greatest ratio of the length of an echo to that of the pulse.
const LONGEST_ECHO: f64 = 1.3;
/// Instants at which the parabola is compared, as shares of the pulse: a cubic that is 0 at 0, 1/2 and 1 is largest within 4 % of those at 1/4 and 3/4.
const BETWEEN: [f64; 5] = [0.0, 0.25, 0.5, 0.75, 1.0];
const LARGEST_BETWEEN: f64 = 1.04;
/// Steps of Newton's iteration: the error falls with the square of the ratio of the speeds at least.
const STEPS: usize = 4;
/// Margin of the time around an echo in which the element's track is a parabola, seconds.
const MARGIN_S: f64 = 1e-5;

/// Echoes of the moving scatterers of one pulse.
#[derive(Debug, Default)]
pub struct MovingEchoes {
    /// Of each receive array.
    arrays: Vec<Vec<Hit>>,
    /// Instants between which all echoes arrive at each array, seconds.
    spans_s: Vec<(f64, f64)>,
}

/// One scatterer as the sound of one pulse finds it.
#[derive(Clone, Copy, Debug)]
struct Hit {
    /// Times of the hits, and places of the scatterer then.
    time_s: [f64; 3],
    at_m: [DVec3; 3],
    /// Estimated reception of the leading edge at the centre of the array.
    received_s: f64,
    /// Three instants of the track, evenly: the first, and the step.
    track_s: (f64, f64),
    /// Centre of the array, and its axes along the line and the boresight, at these instants.
    center_m: [DVec3; 3],
    along: [DVec3; 3],
    ahead: [DVec3; 3],
    array_from_world: DMat3,
    /// Pressure at 1 m from the scatterer, with the transmit half of its law.
    amplitude: Complex64,
    /// Outward normal of a law with a receive half; zero without one.
    normal: DVec3,
}

/// An echo, and how far it is off.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct CheckedEcho {
    /// Of the leading edge, seconds.
    pub delay_s: f64,
    /// Square of the amplitude.
    pub energy: f64,
    /// Largest error of the delay at any instant of the pulse, seconds.
    pub off_s: f64,
}

/// Motion of a point, counted from the reference point at the start of the pulse.
#[derive(Clone, Copy)]
struct Motion {
    start_m: DVec3,
    velocity: DVec3,
    acceleration: DVec3,
    hit_s: f64,
}

impl Motion {
    fn at(&self, time_s: f64) -> (DVec3, DVec3) {
        let since_s = time_s - self.hit_s;
        (
            self.start_m + self.velocity * time_s + self.acceleration * (0.5 * since_s * since_s),
            self.velocity + self.acceleration * since_s,
        )
    }

    /// Instant at which the sound emitted at `from_m` at an instant finds the point.
    fn hit_s(&self, c: f64, (emitted_s, from_m): (f64, DVec3)) -> f64 {
        let velocity = self.velocity;
        let apart_m = self.start_m + velocity * emitted_s - from_m;
        // |apart + v tau| = c tau
        let (dot, left) = (apart_m.dot(velocity), c * c - velocity.length_squared());
        let leg_s = (dot + (dot * dot + left * apart_m.length_squared()).sqrt()) / left;
        let mut time_s = emitted_s + leg_s;
        if self.acceleration != DVec3::ZERO {
            for _ in 0..2 {
                let (at_m, velocity) = self.at(time_s);
                let ray_m = at_m - from_m;
                let leg_m = ray_m.length().max(f64::MIN_POSITIVE);
                let late_s = time_s - emitted_s - leg_m / c;
                time_s -= late_s / (1.0 - ray_m.dot(velocity) / (leg_m * c));
            }
        }
        time_s
    }
}

impl MovingEchoes {
    /// The echoes of every `stride`-th scatterer at one element, compared with sound solved on the whole trajectory. A scatterer whose echo has no level
    /// there is left out.
    pub fn checked<'a>(
        plan: &'a PingPlan,
        transmit: &'a TransmitArray,
        (array, element): (&'a ArrayGeometry, usize),
        scatterers: &'a [MovingScatterer],
        stride: usize,
        late_s: f64,
    ) -> impl Iterator<Item = CheckedEcho> + 'a {
        let path = Path::new(plan, transmit, array, late_s);
        let receiver = Receiver::new(plan, array);
        let own = Element::new(array, element);
        let body_m = array.element_body_m(element);
        let (c, duration_s) = (plan.sound_speed_m_per_s, plan.pulse.duration_s);
        let one = move |scatterer: &MovingScatterer| {
            let pose_at = |time_s: f64| plan.trajectory.pose_from(path.origin_m, time_s);
            let echo = receiver.echo(&path.hit(scatterer), own);
            let energy = echo.amplitude.norm_sqr();
            let (seen, sent) = path.motions(scatterer);
            let off_s = |share: f64| {
                let emitted_s = share * duration_s;
                let from_m = pose_at(emitted_s).point_m(transmit.mounting.position_m);
                let hit_s = sent.hit_s(c, (emitted_s, from_m));
                let at_m = seen.at(hit_s).0;
                let mut received_s = echo.delay_s + emitted_s;
                for _ in 0..STEPS {
                    let pose = pose_at(received_s);
                    let ray_m = at_m - pose.point_m(body_m);
                    let leg_m = ray_m.length().max(f64::MIN_POSITIVE);
                    let closing = ray_m.dot(pose.point_velocity_m_per_s(body_m)) / (leg_m * c);
                    received_s -= (received_s - hit_s - leg_m / c) / (1.0 + closing);
                }
                let s = received_s - echo.delay_s;
                (s + (echo.doppler + echo.curvature_per_s * s) * s - emitted_s).abs()
            };
            CheckedEcho {
                delay_s: echo.delay_s,
                energy,
                off_s: LARGEST_BETWEEN * BETWEEN.map(off_s).into_iter().fold(0.0, f64::max),
            }
        };
        let echoes = scatterers.iter().step_by(stride.max(1)).map(one);
        echoes.filter(|echo| echo.energy > 0.0)
    }

    /// Solves the hits of a pulse that starts `late_s` after the start of the ping, to which the positions of the scatterers refer.
    pub fn prepare(
        &mut self,
        plan: &PingPlan,
        transmit: &[TransmitArray],
        receive: &[ArrayGeometry],
        scatterers: &[MovingScatterer],
        late_s: f64,
    ) {
        self.arrays.resize_with(receive.len(), Vec::new);
        self.spans_s.clear();
        for (hits, array) in self.arrays.iter_mut().zip(receive) {
            let path = Path::new(plan, &transmit[array.transmit], array, late_s);
            let solve = scatterers.par_iter().with_min_len(64);
            solve.map(|s| path.hit(s)).collect_into_vec(hits);
            let none = (f64::INFINITY, f64::NEG_INFINITY);
            let spans = hits.iter().map(Hit::span_s);
            let span = spans.fold(none, |(a, b), (from, to)| (a.min(from), b.max(to)));
            self.spans_s.push(span);
        }
    }

    /// Whether nothing moves.
    pub fn is_empty(&self) -> bool {
        self.arrays.iter().all(Vec::is_empty)
    }

    /// Instants between which all echoes arrive at a receive array, seconds; none without echoes.
    pub fn span_s(&self, array: usize) -> Option<(f64, f64)> {
        let span = self.spans_s.get(array).copied()?;
        (span.0 <= span.1).then_some(span)
    }

    /// Emits the echoes at one element of receive array `index`.
    pub fn arrivals(
        &self,
        plan: &PingPlan,
        (index, array): (usize, &ArrayGeometry),
        element: usize,
        sink: &mut impl ArrivalSink,
    ) -> EchoCounts {
        let hits = self.arrays.get(index).map_or(&[][..], |hits| hits);
        let receiver = Receiver::new(plan, array);
        let own = Element::new(array, element);
        let mut chunk = ArrivalChunk::new();
        chunk.element = element;
        let mut counts = EchoCounts::default();
        for hits in hits.chunks(CHUNK) {
            chunk.len = hits.len();
            for (i, hit) in hits.iter().enumerate() {
                let echo = receiver.echo(hit, own);
                chunk.delay_s[i] = echo.delay_s;
                chunk.doppler[i] = echo.doppler;
                chunk.curvature_per_s[i] = echo.curvature_per_s;
                chunk.amplitude[i] = echo.amplitude;
                counts.too_close += u64::from(echo.range_m < receiver.one_way.wavelength_m);
            }
            counts.used += hits.len() as u64;
            sink.accept(&chunk);
        }
        counts
    }
}

impl Hit {
    /// Instants between which the echo arrives anywhere on the array.
    fn span_s(&self) -> (f64, f64) {
        (self.track_s.0, self.track_s.0 + 2.0 * self.track_s.1)
    }
}

/// What the hits of one pulse share, from one transmit array to one receive array.
struct Path<'a> {
    plan: &'a PingPlan,
    array: &'a ArrayGeometry,
    late_s: f64,
    /// Reference point at the start of the pulse, from which places are counted.
    origin_m: DVec3,
    /// Transmitter at the three instants.
    transmit_m: [DVec3; 3],
    transmit_from_world: DMat3,
    pattern: Directivity,
    one_way: OneWay,
    source: f64,
    /// Time that sound takes along half the array, with a margin.
    half_array_s: f64,
}

impl<'a> Path<'a> {
    fn new(
        plan: &'a PingPlan,
        transmit: &TransmitArray,
        array: &'a ArrayGeometry,
        late_s: f64,
    ) -> Self {
        let origin_m = plan.trajectory.pose_at(0.0).position_m;
        let start = plan.trajectory.pose_from(origin_m, 0.0);
        let wavelength_m = plan.sound_speed_m_per_s / plan.pulse.center_frequency_hz;
        let mounting = &transmit.mounting;
        let transmit_m = INSTANTS.map(|share| {
            let pose = plan
                .trajectory
                .pose_from(origin_m, share * plan.pulse.duration_s);
            pose.point_m(mounting.position_m)
        });
        let half_m = 0.5 * array.elements as f64 * array.spacing_m.abs();
        Self {
            plan,
            array,
            late_s,
            origin_m,
            transmit_m,
            transmit_from_world: DMat3::from_quat(
                (start.world_from_body * mounting.body_from_array).inverse(),
            ),
            pattern: Directivity::new(&transmit.pattern, wavelength_m),
            one_way: OneWay::new(wavelength_m, plan.absorption_db_per_m),
            source: amplitude_from_db(plan.settings.source_level_db + transmit.level_offset_db),
            half_array_s: LONGEST_ECHO * half_m / plan.sound_speed_m_per_s + MARGIN_S,
        }
    }

    /// Motion of the point that the receiver sees, and of the one that the transmitter sees.
    fn motions(&self, scatterer: &MovingScatterer) -> (Motion, Motion) {
        let motion = |position_m: DVec3, velocity: DVec3, acceleration: DVec3| Motion {
            start_m: (position_m - self.origin_m) + velocity * self.late_s,
            velocity,
            acceleration,
            hit_s: scatterer.hit_s - self.late_s,
        };
        let seen = motion(
            scatterer.position_m,
            scatterer.velocity_m_per_s,
            scatterer.acceleration_m_per_s2,
        );
        let sent = scatterer.transmit.map_or(seen, |transmit| {
            motion(
                transmit.position_m,
                transmit.velocity_m_per_s,
                transmit.acceleration_m_per_s2,
            )
        });
        (seen, sent)
    }

    fn hit(&self, scatterer: &MovingScatterer) -> Hit {
        let (plan, c) = (self.plan, self.plan.sound_speed_m_per_s);
        let duration_s = plan.pulse.duration_s;
        let (seen, sent) = self.motions(scatterer);
        let (mut time_s, mut at_m) = ([0.0; 3], [DVec3::ZERO; 3]);
        for k in 0..3 {
            let emitted_s = INSTANTS[k] * duration_s;
            time_s[k] = sent.hit_s(c, (emitted_s, self.transmit_m[k]));
            at_m[k] = sent.at(time_s[k]).0;
        }
        let ray_m = at_m[0] - self.transmit_m[0];
        if scatterer.transmit.is_some() {
            at_m = time_s.map(|time_s| seen.at(time_s).0);
        }
        let pose_at = |time_s: f64| plan.trajectory.pose_from(self.origin_m, time_s);
        let mounting = &self.array.mounting;
        let mut received_s = time_s[0] + at_m[0].distance(self.transmit_m[0]) / c;
        let mut pose = pose_at(received_s);
        for _ in 0..3 {
            received_s = time_s[0] + at_m[0].distance(pose.point_m(mounting.position_m)) / c;
            pose = pose_at(received_s);
        }
        let first_s = received_s - self.half_array_s;
        let step_s = self.half_array_s + 0.5 * LONGEST_ECHO * duration_s;
        let poses = [0.0, 1.0, 2.0].map(|k| pose_at(first_s + k * step_s));
        let range_m = ray_m.length().max(f64::MIN_POSITIVE);
        let ray = self.transmit_from_world * (ray_m / range_m);
        let normal = DVec3::from_array(scatterer.normal.map(f64::from));
        let facing = (-normal.dot(ray_m / range_m)).max(0.0);
        let (law, normal) = match scatterer.law {
            ScatterLaw::Point | ScatterLaw::Water => (1.0, DVec3::ZERO),
            ScatterLaw::LambertOneWay => (facing, DVec3::ZERO),
            // Targets have no curve.
            ScatterLaw::Lambert | ScatterLaw::Curve => (facing.sqrt(), normal),
        };
        let level = self.source
            * self.pattern.towards(ray.x, ray.y, ray.z)
            * self.one_way.amplitude(range_m)
            * law;
        Hit {
            time_s,
            at_m,
            received_s,
            track_s: (first_s, step_s),
            center_m: poses.map(|pose| pose.point_m(mounting.position_m)),
            along: poses.map(|pose| pose.world_from_body * (mounting.body_from_array * DVec3::X)),
            ahead: poses.map(|pose| pose.world_from_body * (mounting.body_from_array * DVec3::Z)),
            array_from_world: DMat3::from_quat(
                (pose.world_from_body * mounting.body_from_array).inverse(),
            ),
            amplitude: scatterer.strength * level,
            normal,
        }
    }
}

/// The receive half of one array.
struct Receiver {
    c: f64,
    carrier_hz: f64,
    duration_s: f64,
    pattern: Directivity,
    one_way: OneWay,
    sensitivity: f64,
    /// Elements of a part of the array, and their spacing, metres.
    part: Option<(usize, f64)>,
}

/// An echo at one element, as in [`ArrivalChunk`].
struct Echo {
    delay_s: f64,
    doppler: f64,
    curvature_per_s: f64,
    amplitude: Complex64,
    range_m: f64,
}

/// One element of an array.
#[derive(Clone, Copy)]
struct Element {
    /// In array axes, metres.
    at_m: DVec3,
    /// Rotation from array axes to its own.
    from_array: DQuat,
}

impl Element {
    fn new(array: &ArrayGeometry, element: usize) -> Self {
        let (at_m, turn) = array.place(array.along_m(element));
        Self {
            at_m,
            from_array: turn.inverse(),
        }
    }
}

/// Track of an element around an echo: a parabola over (t - first) / step.
struct Parabola {
    track_s: (f64, f64),
    terms: [DVec3; 3],
}

impl Parabola {
    /// `element_m`: in array axes; an element has no place across the plane of x and z.
    fn new(hit: &Hit, element_m: DVec3) -> Self {
        let [a, b, c] = [0, 1, 2]
            .map(|k| hit.center_m[k] + hit.along[k] * element_m.x + hit.ahead[k] * element_m.z);
        Self {
            track_s: hit.track_s,
            terms: [a, 2.0 * b - 1.5 * a - 0.5 * c, 0.5 * (a + c) - b],
        }
    }

    /// Position and velocity.
    fn at(&self, time_s: f64) -> (DVec3, DVec3) {
        let s = (time_s - self.track_s.0) / self.track_s.1;
        let [a, b, c] = self.terms;
        (a + (b + c * s) * s, (b + c * (2.0 * s)) / self.track_s.1)
    }

    /// Instant at which the sound from `from_m` at `time_s` arrives, from an estimate.
    fn received_s(&self, c: f64, (time_s, from_m): (f64, DVec3), mut at_s: f64) -> f64 {
        for _ in 0..3 {
            let (place_m, velocity) = self.at(at_s);
            let ray_m = from_m - place_m;
            let leg_m = ray_m.length().max(f64::MIN_POSITIVE);
            let late_s = at_s - time_s - leg_m / c;
            at_s -= late_s / (1.0 + ray_m.dot(velocity) / (leg_m * c));
        }
        at_s
    }
}

impl Receiver {
    fn new(plan: &PingPlan, array: &ArrayGeometry) -> Self {
        let c = plan.sound_speed_m_per_s;
        let wavelength_m = c / plan.pulse.center_frequency_hz;
        Self {
            c,
            carrier_hz: plan.pulse.center_frequency_hz,
            duration_s: plan.pulse.duration_s,
            pattern: Directivity::new(&array.element_pattern, wavelength_m),
            one_way: OneWay::new(wavelength_m, plan.absorption_db_per_m),
            sensitivity: amplitude_from_db(array.sensitivity_db),
            part: match array.element_pattern {
                Pattern::Part {
                    elements,
                    spacing_m,
                    ..
                } => Some((elements, spacing_m)),
                _ => None,
            },
        }
    }

    fn echo(&self, hit: &Hit, element: Element) -> Echo {
        let track = Parabola::new(hit, element.at_m);
        let mut guess_s = hit.received_s;
        let times_s = [0, 1, 2].map(|k| {
            let time_s = track.received_s(self.c, (hit.time_s[k], hit.at_m[k]), guess_s);
            guess_s = time_s + 0.5 * self.duration_s;
            time_s
        });
        let [delay_s, middle_s, end_s] = times_s;
        // The parabola t' = eta s + q s^2 through (middle, T/2) and (end, T).
        let (middle_s, end_s) = (middle_s - delay_s, end_s - delay_s);
        let curvature_per_s = (self.duration_s / end_s - 0.5 * self.duration_s / middle_s)
            / (end_s - middle_s).max(f64::MIN_POSITIVE);
        let doppler = (self.duration_s - end_s) / end_s - curvature_per_s * end_s;
        let ray_m = hit.at_m[0] - track.at(delay_s).0;
        let range_m = ray_m.length().max(f64::MIN_POSITIVE);
        let ray = ray_m / range_m;
        let u = element.from_array * (hit.array_from_world * ray);
        let law = match hit.normal == DVec3::ZERO {
            true => 1.0,
            false => (-hit.normal.dot(ray)).max(0.0).sqrt(),
        };
        let gain = self.pattern.towards(u.x, u.y, u.z)
            * self.one_way.amplitude(range_m)
            * law
            * self.sensitivity;
        Echo {
            delay_s,
            doppler,
            curvature_per_s,
            amplitude: hit.amplitude * gain * self.array_factor(hit, element.at_m, delay_s),
            range_m,
        }
    }

    /// Mean over the elements of a part of the array, at the carrier, relative to its middle; 1 for a single element.
    fn array_factor(&self, hit: &Hit, element_m: DVec3, delay_s: f64) -> Complex64 {
        let Some((elements, spacing_m)) = self.part else {
            return Complex64::ONE;
        };
        let of_each = (0..elements).map(|e| {
            let beside_m = (e as f64 - 0.5 * (elements as f64 - 1.0)) * spacing_m;
            let track = Parabola::new(hit, element_m + DVec3::X * beside_m);
            let own_s = track.received_s(self.c, (hit.time_s[0], hit.at_m[0]), delay_s);
            let cycles = self.carrier_hz * (own_s - delay_s);
            let (sin, cos) = libm::sincos(-TAU * (cycles - cycles.round()));
            Complex64::new(cos, sin)
        });
        of_each.sum::<Complex64>() / elements.max(1) as f64
    }
}

//! Echoes around one instant from the reference equation. The error check uses them at random
//! samples of a ping.
//!
//! The inputs are a plan, the scatterers that may be received at the instant, and an element. The
//! results are their echoes as [`ArrivalChunk`]s. The emission time is exact at the instant and
//! shortly before and after it, with a parabola between. The neglected third derivative is below
//! 1e-6 rad within half a millisecond.
//!
//! As in [`reference()`](super::reference::reference()), c (t - t') = |S - p_T(t')| + |S - r_e(t)|
//! is solved on the continuous trajectory. Path model, Doppler model and culling are not used.

use glam::{DQuat, DVec3};
use num_complex::Complex64;

use crate::arrivals::{ArrivalChunk, ArrivalSink, CHUNK};
use echotank_core::arrays::{ArrayGeometry, TransmitArray};
use echotank_core::frames::Pose;
use echotank_core::ping::PingPlan;
use echotank_core::scene::Scatterers;

use super::reference::{Sonar, facing};

/// Number of pieces of the transmitter's track during the pulse. Each piece is the Hermite cubic of
/// the positions and velocities at its ends. The error is below 1e-10 m for a step in acceleration
/// of 1 m/s^2 within a piece.
const PIECES: usize = 64;

/// Number of Newton steps for an emission time. From a guess within 1e-6 s the second step reaches
/// 1e-18 s.
const STEPS: usize = 3;

/// Element and time of a check.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Instant {
    /// Index of the element in the receive array.
    pub element: usize,
    /// Seconds after the start of the pulse.
    pub time_s: f64,
    /// Half the span of the receiver filter, seconds.
    pub half_span_s: f64,
}

/// Slant ranges of the scatterers that can be received at an instant: minimum and maximum, metres.
/// They are measured from the reference point at the start of the pulse.
pub fn receivable_ranges_m(
    plan: &PingPlan,
    tx: &TransmitArray,
    array: &ArrayGeometry,
    at: Instant,
) -> (f64, f64) {
    let c = plan.sound_speed_m_per_s;
    let origin_m = plan.segments[0].position_m;
    let latest_s = at.time_s + at.half_span_s;
    let moved_m = plan.trajectory.pose_from(origin_m, latest_s).position_m;
    // Each leg differs from the range by at most this distance.
    let reach_m = tx.mounting.position_m.length()
        + array.element_body_m(at.element).length()
        + moved_m.length();
    let earliest_s = at.time_s - at.half_span_s - plan.pulse.duration_s;
    (0.5 * c * earliest_s - reach_m, 0.5 * c * latest_s + reach_m)
}

/// Number of slant range bins of [`receivable`].
const BINS: usize = 1024;

/// Scatterers that can be received at any of up to 64 instants, in order, as (index, mask) with bit
/// k for instant k. `ranges_m` are those of [`receivable_ranges_m`].
///
/// The list may have scatterers up to one bin outside the ranges. No scatterer inside is missing.
pub fn receivable(
    plan: &PingPlan,
    scatterers: &Scatterers,
    ranges_m: &[(f64, f64)],
    out: &mut Vec<(u32, u64)>,
) {
    assert!(ranges_m.len() <= 64, "one bit each");
    out.clear();
    // All memory is reserved at once, because the next instants may receive more scatterers.
    out.reserve(scatterers.len());
    let farthest_m = ranges_m.iter().map(|r| r.1).fold(0.0, f64::max);
    if farthest_m <= 0.0 || farthest_m.is_nan() {
        return;
    }
    let per_m = (BINS - 1) as f64 / farthest_m;
    let mut masks = [0u64; BINS];
    for (k, &(near_m, far_m)) in ranges_m.iter().enumerate() {
        let first = (near_m.max(0.0) * per_m) as usize;
        let last = ((far_m.max(0.0) * per_m) as usize).min(BINS - 1);
        // Before the first echo the interval is empty or one bin wide.
        for mask in masks.iter_mut().take(last + 1).skip(first) {
            *mask |= 1 << k;
        }
    }
    let origin_m = plan.segments[0].position_m;
    if !scatterers.transmit.is_empty() {
        for i in 0..scatterers.len() {
            let sent_m = scatterers.transmit_m(i).distance(origin_m);
            let half_path_m = 0.5 * (sent_m + scatterers.position_m(i).distance(origin_m));
            let mask = masks.get((half_path_m * per_m) as usize).copied();
            out.extend(mask.filter(|mask| *mask != 0).map(|mask| (i as u32, mask)));
        }
        return;
    }
    for i in 0..scatterers.len() {
        let (x, y, z) = (
            scatterers.north_m[i] - origin_m.x,
            scatterers.east_m[i] - origin_m.y,
            scatterers.down_m[i] - origin_m.z,
        );
        let bin = ((x * x + y * y + z * z).sqrt() * per_m) as usize;
        let mask = masks.get(bin).copied().unwrap_or(0);
        if mask != 0 {
            out.push((i as u32, mask));
        }
    }
}

/// Passes the echoes of `indices` about an instant to `sink`.
pub fn echoes_at(
    plan: &PingPlan,
    tx: &TransmitArray,
    array: &ArrayGeometry,
    at: Instant,
    scatterers: &Scatterers,
    indices: impl Iterator<Item = usize>,
    sink: &mut impl ArrivalSink,
) {
    let prober = Prober::new(plan, tx, array, at);
    let mut chunk = ArrivalChunk::new();
    chunk.element = at.element;
    for i in indices {
        let Some(echo) = prober.echo(scatterers, i) else {
            continue;
        };
        let n = chunk.len;
        chunk.delay_s[n] = echo.delay_s;
        chunk.doppler[n] = echo.doppler;
        chunk.curvature_per_s[n] = echo.curvature_per_s;
        chunk.amplitude[n] = echo.amplitude;
        chunk.len = n + 1;
        if chunk.len == CHUNK {
            sink.accept(&chunk);
            chunk.len = 0;
        }
    }
    if chunk.len > 0 {
        sink.accept(&chunk);
    }
}

struct Echo {
    delay_s: f64,
    doppler: f64,
    curvature_per_s: f64,
    amplitude: Complex64,
}

/// Terms that all scatterers of one instant share.
struct Prober<'a> {
    plan: &'a PingPlan,
    sonar: Sonar<'a>,
    origin_m: DVec3,
    /// Position and velocity of the transmitter at the ends of the pieces, from `-spare_s` to
    /// `spare_s` after the end of the pulse.
    way: [(DVec3, DVec3); PIECES + 1],
    spare_s: f64,
    piece_s: f64,
    transmit_m: DVec3,
    transmit_attitude: DQuat,
    /// Positions of the element before, at and after the instant.
    receive_m: [DVec3; 3],
    velocity_m_per_s: DVec3,
    step_s: f64,
    at: Instant,
    /// Attitudes at the earliest and the latest leading edge that can be received at the instant.
    attitudes: [(f64, DQuat); 2],
}

impl<'a> Prober<'a> {
    fn new(
        plan: &'a PingPlan,
        tx: &'a TransmitArray,
        array: &'a ArrayGeometry,
        at: Instant,
    ) -> Self {
        let origin_m = plan.segments[0].position_m;
        let pose = |time_s: f64| plan.trajectory.pose_from(origin_m, time_s);
        let place = |pose: &Pose, body_m: DVec3| {
            (pose.point_m(body_m), pose.point_velocity_m_per_s(body_m))
        };
        // Emission times outside the pulse but inside the filter only change the parabola slightly,
        // so they need no accuracy.
        let spare_s = 2.5 * at.half_span_s + 1e-6;
        let duration_s = plan.pulse.duration_s;
        let piece_s = (duration_s + 2.0 * spare_s) / PIECES as f64;
        let way = std::array::from_fn(|k| {
            place(&pose(k as f64 * piece_s - spare_s), tx.mounting.position_m)
        });
        let element_m = array.element_body_m(at.element);
        let step_s = at.half_span_s.max(1e-5);
        let receive = [-1.0, 0.0, 1.0].map(|n| place(&pose(at.time_s + n * step_s), element_m));
        let start = pose(0.0);
        let earliest_s = at.time_s - at.half_span_s - duration_s;
        let attitudes = [earliest_s, at.time_s + at.half_span_s]
            .map(|time_s| (time_s, pose(time_s).world_from_body));
        Self {
            sonar: Sonar::new(plan, tx, (array, at.element), &plan.trajectory),
            plan,
            origin_m,
            way,
            spare_s,
            piece_s,
            transmit_m: start.point_m(tx.mounting.position_m),
            transmit_attitude: start.world_from_body,
            receive_m: receive.map(|r| r.0),
            velocity_m_per_s: receive[1].1,
            step_s,
            at,
            attitudes,
        }
    }

    /// Position and velocity of the transmitter at an emission time, extrapolated linearly after
    /// the pulse.
    fn transmitter(&self, emitted_s: f64) -> (DVec3, DVec3) {
        let x = (emitted_s + self.spare_s) / self.piece_s;
        let k = (x.max(0.0) as usize).min(PIECES - 1);
        let (a, b) = (&self.way[k], &self.way[k + 1]);
        let h = self.piece_s;
        let s = x - k as f64;
        if !(0.0..=1.0).contains(&s) {
            let end = if s < 0.0 { a } else { b };
            let since_s = if s < 0.0 { s * h } else { (s - 1.0) * h };
            return (end.0 + end.1 * since_s, end.1);
        }
        let step = b.0 - a.0;
        let (s2, s3) = (s * s, s * s * s);
        (
            a.0 + step * (3.0 * s2 - 2.0 * s3)
                + a.1 * (h * (s - 2.0 * s2 + s3))
                + b.1 * (h * (s3 - s2)),
            step * (6.0 * (s - s2) / h)
                + a.1 * (1.0 - 4.0 * s + 3.0 * s2)
                + b.1 * (3.0 * s2 - 2.0 * s),
        )
    }

    /// Emission time of the sound that the element receives from a scatterer at its position `n`. `sent_m` is the scatterer as the transmitter sees it.
    fn emitted_s(&self, sent_m: DVec3, at_m: DVec3, n: usize, guess_s: f64) -> f64 {
        let c = self.plan.sound_speed_m_per_s;
        let time_s = self.at.time_s + (n as f64 - 1.0) * self.step_s;
        let second_m = at_m.distance(self.receive_m[n]);
        let mut emitted_s = guess_s;
        for _ in 0..STEPS {
            let (place_m, velocity) = self.transmitter(emitted_s);
            let ray_m = sent_m - place_m;
            let leg_m = ray_m.length();
            let residual_m = c * (time_s - emitted_s) - leg_m - second_m;
            emitted_s += residual_m / (c - velocity.dot(ray_m) / leg_m.max(f64::MIN_POSITIVE));
        }
        emitted_s
    }

    /// The echo of scatterer `i`; `None` if it is outside the span.
    fn echo(&self, scatterers: &Scatterers, i: usize) -> Option<Echo> {
        let c = self.plan.sound_speed_m_per_s;
        let at_m = scatterers.position_m(i) - self.origin_m;
        let sent_m = scatterers.transmit_m(i) - self.origin_m;
        // The transmitter hardly moves during the pulse, so the error of this guess is
        // microseconds.
        let first_m = sent_m.distance(self.transmit_m);
        let guess_s = self.at.time_s - (first_m + at_m.distance(self.receive_m[1])) / c;
        let span_s = 1.1 * self.at.half_span_s + 1e-4;
        if !(-span_s..=self.plan.pulse.duration_s + span_s).contains(&guess_s) {
            return None;
        }
        let now_s = self.emitted_s(sent_m, at_m, 1, guess_s);
        let before_s = self.emitted_s(sent_m, at_m, 0, now_s - self.step_s);
        let after_s = self.emitted_s(sent_m, at_m, 2, now_s + self.step_s);
        // t' = now + rate x + curvature x^2, with x counted from the instant.
        let rate = (after_s - before_s) / (2.0 * self.step_s);
        let curvature_per_s =
            ((after_s - now_s) - (now_s - before_s)) / (2.0 * self.step_s * self.step_s);
        let root = (rate * rate - 4.0 * now_s * curvature_per_s)
            .max(0.0)
            .sqrt();
        let edge_s = -2.0 * now_s / (rate + root);
        let leading_s = self.at.time_s + edge_s;
        let receive_m = self.receive_m[1] + self.velocity_m_per_s * edge_s;
        let [(early_s, early), (late_s, late)] = self.attitudes;
        let attitude = early.slerp(late, (leading_s - early_s) / (late_s - early_s));
        let amplitude = self.sonar.amplitude_seen_from(
            (sent_m - self.transmit_m, self.transmit_attitude),
            (at_m - receive_m, attitude),
            facing(scatterers, i),
        );
        Some(Echo {
            delay_s: leading_s,
            doppler: (rate - 1.0) + 2.0 * curvature_per_s * edge_s,
            curvature_per_s,
            amplitude: scatterers.strength[i] * amplitude,
        })
    }
}

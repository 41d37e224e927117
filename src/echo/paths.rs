//! Where the receiver is when an echo arrives: stop-and-hop and polyline delays, in closed form.
//!
//! Sound leaves the transmitter (the origin here) at t = 0 and reaches the scatterer S at t1 = r_T/c. A receiver at R + v (t - t_k) on
//! segment k then sees S at D = S - R - v (t1 - t_k), and the second leg tau solves |D - v tau| = c tau, so
//! (c^2 - v^2) tau^2 + 2 (D.v) tau - D.D = 0. Its one positive root, written without cancellation, is
//!
//! ```text
//! q   = sqrt((D.v)^2 + (c^2 - v^2) D.D)
//! tau = D.D / (q + D.v)            D.v >= 0
//!     = (q - D.v) / (c^2 - v^2)    D.v <  0
//! ```
//!
//! The same root as Meng et al. 2023, Eqs. 5-7 (there with v in the denominator). It holds for every |v| < c, v = 0 and D = 0 included.

use glam::{DMat3, DQuat, DVec3};

use crate::flow::{ArrayGeometry, CHUNK, DopplerModel, PathModel, PingPlan, TransmitArray};

/// Guard, in metres, on the bounds by which whole segments are passed over: far above the rounding of ranges, far below any range.
const BOUND_GUARD_M: f64 = 1e-6;

/// Where a ping is transmitted: the origin of everything below.
#[derive(Clone, Copy, Debug, Default)]
pub struct Transmit {
    /// The platform's reference point at the start of the pulse, world, metres, and the transmitter's arm from it. Kept apart: their sum
    /// would round the arm at the size of the world.
    reference_m: DVec3,
    arm_m: DVec3,
    pub array_from_world: DMat3,
    /// As Doppler needs it: zero under [`DopplerModel::None`].
    pub velocity_m_per_s: DVec3,
}

impl Transmit {
    /// From the first segment of the plan.
    pub fn new(plan: &PingPlan, tx: &TransmitArray) -> Self {
        let first = &plan.segments[0];
        Self {
            reference_m: first.position_m,
            arm_m: first.world_from_body * tx.mounting.position_m,
            array_from_world: array_from_world(first.world_from_body, tx.mounting.body_from_array),
            velocity_m_per_s: doppler_velocity(plan, first.velocity_m_per_s),
        }
    }

    /// A world position relative to where this ping is transmitted.
    pub fn relative_m(&self, world_m: DVec3) -> DVec3 {
        (world_m - self.reference_m) - self.arm_m
    }
}

fn array_from_world(world_from_body: DQuat, body_from_array: DQuat) -> DMat3 {
    DMat3::from_quat((world_from_body * body_from_array).inverse())
}

fn doppler_velocity(plan: &PingPlan, velocity_m_per_s: DVec3) -> DVec3 {
    match plan.model.doppler {
        DopplerModel::None => DVec3::ZERO,
        DopplerModel::Stretch => velocity_m_per_s,
    }
}

/// One element on one segment of the polyline.
#[derive(Clone, Copy, Debug)]
pub struct Leg {
    start_s: f64,
    /// Infinite on the last.
    end_s: f64,
    /// Element at `start_s`, relative to the transmit position.
    origin_m: DVec3,
    /// In the path: zero for stop-and-hop.
    velocity_m_per_s: DVec3,
    /// In the Doppler term.
    doppler_velocity_m_per_s: DVec3,
    array_from_world: DMat3,
}

impl Leg {
    fn at_m(&self, time_s: f64) -> DVec3 {
        self.origin_m + self.velocity_m_per_s * (time_s - self.start_s)
    }
}

/// A line array on one segment of the polyline.
#[derive(Clone, Copy, Debug)]
pub struct LineMotion {
    /// Unit, world.
    pub axis: DVec3,
    /// In the path, and in the Doppler term.
    pub velocity_m_per_s: DVec3,
    pub doppler_velocity_m_per_s: DVec3,
    /// Where the segment ends; infinite on the last.
    pub until_s: f64,
}

/// The way of one element through one ping. Its buffer is kept between uses.
#[derive(Debug, Default)]
pub struct ElementTrack {
    legs: Vec<Leg>,
    /// Where the polyline was meant to end; echoes from here on are counted.
    end_s: f64,
}

impl ElementTrack {
    /// Sets out the legs of `element` under the plan's path and Doppler models.
    pub fn lay(
        &mut self,
        plan: &PingPlan,
        transmit: &Transmit,
        array: &ArrayGeometry,
        element: usize,
    ) {
        self.lay_at(plan, transmit, array, array.element_x_m(element));
    }

    /// As [`Self::lay`], for a point `along_m` from the array's centre.
    pub fn lay_at(
        &mut self,
        plan: &PingPlan,
        transmit: &Transmit,
        array: &ArrayGeometry,
        along_m: f64,
    ) {
        let point_m = array.mounting.position_m
            + array.mounting.body_from_array * DVec3::new(along_m, 0.0, 0.0);
        let (segments, moving) = match plan.model.path {
            PathModel::StopAndHop => (&plan.segments[..1], 0.0),
            PathModel::Polyline => (&plan.segments[..], 1.0),
        };
        self.legs.clear();
        for (k, segment) in segments.iter().enumerate() {
            self.legs.push(Leg {
                start_s: segment.start_s,
                end_s: segments.get(k + 1).map_or(f64::INFINITY, |s| s.start_s),
                origin_m: transmit.relative_m(segment.position_m)
                    + segment.world_from_body * point_m,
                velocity_m_per_s: segment.velocity_m_per_s * moving,
                doppler_velocity_m_per_s: doppler_velocity(plan, segment.velocity_m_per_s),
                array_from_world: array_from_world(
                    segment.world_from_body,
                    array.mounting.body_from_array,
                ),
            });
        }
        self.end_s = match (plan.model.path, segments.last()) {
            (PathModel::Polyline, Some(last)) => last.start_s + plan.model.segment_s,
            _ => f64::INFINITY,
        };
    }

    pub fn end_s(&self) -> f64 {
        self.end_s
    }

    /// How the line moves where an echo arrives at `time_s`.
    pub fn motion_at(&self, time_s: f64) -> LineMotion {
        let leg = self
            .legs
            .iter()
            .rfind(|leg| leg.start_s <= time_s)
            .unwrap_or(&self.legs[0]);
        let axis = leg.array_from_world.row(0);
        LineMotion {
            axis,
            velocity_m_per_s: leg.velocity_m_per_s,
            doppler_velocity_m_per_s: leg.doppler_velocity_m_per_s,
            until_s: leg.end_s,
        }
    }

    /// The farthest this element gets from the transmit position up to `time_s`, metres.
    pub fn reach_m(&self, time_s: f64) -> f64 {
        let mut reach_m: f64 = 0.0;
        for leg in self.legs.iter().filter(|leg| leg.start_s <= time_s) {
            reach_m = reach_m
                .max(leg.origin_m.length())
                .max(leg.at_m(leg.end_s.min(time_s)).length());
        }
        reach_m
    }
}

/// Up to [`CHUNK`] scatterers relative to the transmit position, metres; `range_m` is their distance from it.
#[derive(Clone, Copy)]
pub struct Batch<'a> {
    pub x_m: &'a [f64],
    pub y_m: &'a [f64],
    pub z_m: &'a [f64],
    pub range_m: &'a [f64],
    pub least_range_m: f64,
    pub greatest_range_m: f64,
}

/// How a batch meets one element: the delay, and the receive ray at reception.
pub struct Rays {
    /// Leading edge, seconds after the start of the pulse.
    pub delay_s: [f64; CHUNK],
    /// From the element to the scatterer, world, metres.
    pub x_m: [f64; CHUNK],
    pub y_m: [f64; CHUNK],
    pub z_m: [f64; CHUNK],
    /// The same in array axes.
    pub array_x_m: [f64; CHUNK],
    pub array_y_m: [f64; CHUNK],
    pub array_z_m: [f64; CHUNK],
    /// Receiver's velocity times that vector, m^2/s: the closing speed times the range.
    pub closing_m2_per_s: [f64; CHUNK],
}

impl Default for Rays {
    fn default() -> Self {
        let zero = [0.0; CHUNK];
        Self {
            delay_s: zero,
            x_m: zero,
            y_m: zero,
            z_m: zero,
            array_x_m: zero,
            array_y_m: zero,
            array_z_m: zero,
            closing_m2_per_s: zero,
        }
    }
}

impl Rays {
    /// Nothing placed yet.
    fn begin(&mut self) {
        *self = Self {
            delay_s: [f64::INFINITY; CHUNK],
            ..Self::default()
        };
    }
}

/// What went other than plainly while a batch was solved.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Oddities {
    pub no_root: u64,
    pub two_roots: u64,
}

/// Second leg, seconds, from the scatterer to a receiver that saw it at `(x, y, z)` when the sound reached it. See the module's head.
#[inline(always)]
fn second_leg_s(x: f64, y: f64, z: f64, v: DVec3, c2_minus_v2: f64) -> f64 {
    let along = x * v.x + y * v.y + z * v.z;
    let square = x * x + y * y + z * z;
    let root = (along * along + c2_minus_v2 * square).sqrt();
    let sum = along.abs() + root;
    let ahead = along >= 0.0;
    let over = if ahead { square } else { sum };
    // Not 0/0 where the receiver sits on the scatterer.
    let under = if ahead {
        sum.max(f64::MIN_POSITIVE)
    } else {
        c2_minus_v2
    };
    over / under
}

/// Solves one leg for a whole batch and keeps what falls on it. Returns how many were placed.
#[inline(always)]
fn solve_leg(leg: &Leg, c: f64, batch: Batch, rays: &mut Rays, odd: &mut Oddities) -> u64 {
    let n = batch.range_m.len().min(CHUNK);
    let (x_m, y_m, z_m) = (&batch.x_m[..n], &batch.y_m[..n], &batch.z_m[..n]);
    let range_m = &batch.range_m[..n];
    let (o, v, w) = (
        leg.origin_m,
        leg.velocity_m_per_s,
        leg.doppler_velocity_m_per_s,
    );
    let m = leg.array_from_world;
    let c2_minus_v2 = c * c - v.length_squared();
    let (mut placed, mut none, mut two) = (0, 0, 0);
    for i in 0..n {
        let (x, y, z) = (x_m[i] - o.x, y_m[i] - o.y, z_m[i] - o.z);
        let first_leg_s = range_m[i] / c;
        let waited_s = first_leg_s - leg.start_s;
        let second_s = second_leg_s(
            x - v.x * waited_s,
            y - v.y * waited_s,
            z - v.z * waited_s,
            v,
            c2_minus_v2,
        );
        let root_s = first_leg_s + second_s;

        let open = rays.delay_s[i] == f64::INFINITY;
        let early = root_s < leg.start_s;
        let on_time = root_s < leg.end_s;
        let take = open & on_time;
        // Wrapping: a check for overflow would be a branch. They count to 256.
        placed = u64::wrapping_add(placed, take as u64);
        none = u64::wrapping_add(none, (open & early) as u64);
        two = u64::wrapping_add(two, (!open & !early & on_time) as u64);

        // Early means that every earlier leg found its root late: the element jumped at the vertex, and the vertex it is.
        let delay_s = root_s.max(leg.start_s);
        let after_s = delay_s - leg.start_s;
        let (x, y, z) = (x - v.x * after_s, y - v.y * after_s, z - v.z * after_s);
        // Each scatterer is placed once, on arrays that began as zeros: adding 0 or 1 times is a choice that still vectorises, where an
        // `if` would become a branch around the stores.
        let chosen = if take { 1.0 } else { 0.0 };
        rays.delay_s[i] = rays.delay_s[i].min(if take { delay_s } else { f64::INFINITY });
        rays.x_m[i] += chosen * x;
        rays.y_m[i] += chosen * y;
        rays.z_m[i] += chosen * z;
        rays.array_x_m[i] += chosen * (m.x_axis.x * x + m.y_axis.x * y + m.z_axis.x * z);
        rays.array_y_m[i] += chosen * (m.x_axis.y * x + m.y_axis.y * y + m.z_axis.y * z);
        rays.array_z_m[i] += chosen * (m.x_axis.z * x + m.y_axis.z * y + m.z_axis.z * z);
        rays.closing_m2_per_s[i] += chosen * (w.x * x + w.y * y + w.z * z);
    }
    odd.no_root += none;
    odd.two_roots += two;
    placed
}

/// The AVX2 build of [`solve_leg`]: the same arithmetic in the same order, so the same bits.
#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2")]
fn solve_leg_avx2(leg: &Leg, c: f64, batch: Batch, rays: &mut Rays, odd: &mut Oddities) -> u64 {
    solve_leg(leg, c, batch, rays, odd)
}

/// Delays and receive rays of a batch: per scatterer the first leg k with t_k <= u < t_{k+1}.
pub fn solve(track: &ElementTrack, c: f64, batch: Batch, rays: &mut Rays) -> Oddities {
    let n = batch.range_m.len();
    let mut odd = Oddities::default();
    rays.begin();
    let mut placed = 0;
    for leg in &track.legs {
        // c (t - t1) - |S - r(t)| grows along a leg, so its sign at the ends says whether the root lies between. Two triangle
        // inequalities settle that for the whole batch: here "every root is past the end" ...
        if leg.end_s.is_finite() {
            let end_m = leg.at_m(leg.end_s).length();
            if 2.0 * batch.least_range_m > c * leg.end_s + end_m + BOUND_GUARD_M {
                continue;
            }
        }
        // ... and here "every root is before the start", where only scatterers not yet placed matter.
        let before_all =
            2.0 * batch.greatest_range_m + leg.origin_m.length() + BOUND_GUARD_M < c * leg.start_s;
        if placed == n as u64 && before_all {
            break;
        }
        #[cfg(target_arch = "x86_64")]
        if is_x86_feature_detected!("avx2") {
            // SAFETY: the processor has AVX2, asked on the line above; the function needs nothing else.
            placed += unsafe { solve_leg_avx2(leg, c, batch, rays, &mut odd) };
            continue;
        }
        placed += solve_leg(leg, c, batch, rays, &mut odd);
    }
    debug_assert_eq!(placed, n as u64, "the last leg has no end");
    odd
}

#[cfg(all(test, target_arch = "x86_64"))]
mod tests {
    use super::*;

    #[test]
    fn the_avx2_build_gives_the_same_bits() {
        if !is_x86_feature_detected!("avx2") {
            return;
        }
        let turn = DQuat::from_rotation_x(0.3) * DQuat::from_rotation_z(1.1);
        let leg = Leg {
            start_s: 0.04,
            end_s: 0.08,
            origin_m: DVec3::new(0.4, -0.2, 0.1),
            velocity_m_per_s: DVec3::new(5.0, -1.0, 0.3),
            doppler_velocity_m_per_s: DVec3::new(5.0, -1.0, 0.3),
            array_from_world: DMat3::from_quat(turn),
        };
        let place = |step: f64| -> Vec<f64> {
            (0..CHUNK)
                .map(|k| 150.0 * ((k as f64 * step).fract() - 0.5))
                .collect()
        };
        let (x, y, z) = (place(0.618), place(0.755), place(0.57));
        let range: Vec<f64> = (0..CHUNK)
            .map(|i| DVec3::new(x[i], y[i], z[i]).length())
            .collect();
        let batch = Batch {
            x_m: &x,
            y_m: &y,
            z_m: &z,
            range_m: &range,
            least_range_m: 0.0,
            greatest_range_m: 300.0,
        };
        let run = |wide: bool| {
            let mut rays = Rays::default();
            rays.begin();
            let mut odd = Oddities::default();
            let placed = if wide {
                // SAFETY: asked above.
                unsafe { solve_leg_avx2(&leg, 1500.0, batch, &mut rays, &mut odd) }
            } else {
                solve_leg(&leg, 1500.0, batch, &mut rays, &mut odd)
            };
            assert!(placed > 20, "{placed}");
            let bits = |a: &[f64; CHUNK]| a.map(f64::to_bits);
            (
                placed,
                odd,
                [
                    bits(&rays.delay_s),
                    bits(&rays.z_m),
                    bits(&rays.array_x_m),
                    bits(&rays.closing_m2_per_s),
                ],
            )
        };
        assert!(run(true) == run(false));
    }
}

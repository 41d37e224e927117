//! Second-order Doppler, and Eq. 21 of Meng et al. 2023.
//!
//! Sound received at t was transmitted at t' with c (t - t') = R_T(t') + R_R(t), where R_T and R_R
//! are the two legs. With a and b the closing speeds of transmitter and receiver towards the
//! scatterer, the first two derivatives are
//!
//! ```text
//! dt'/dt   = (c + b) / (c - a)
//! d2t'/dt2 = -(R_T'' (dt'/dt)^2 + R_R'') / (c - a),     R'' = (v.v - (v.e)^2)/R - acceleration.e
//! ```
//!
//! The first derivative alone, at the leading edge (Meng et al. 2023, Eqs. 19-20), leaves a phase
//! of 2 pi f v^2 sin^2 s^2 / (r c) at s seconds into the pulse, with f up to f_c + B/2. Both
//! derivatives at mid-pulse leave the third-order term: about v/r T/12 of that phase.

use glam::DVec3;

use super::paths::Motion;

/// One leg at the leading edge: the ray from the sonar to the scatterer, and the motion of the
/// sonar end of the ray.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Leg {
    pub ray_m: DVec3,
    pub motion: Motion,
}

impl Leg {
    /// Length and its first two derivatives, `later_s` after the leading edge.
    #[inline(always)]
    fn at(&self, later_s: f64) -> (f64, f64, f64) {
        let Motion {
            velocity_m_per_s: velocity,
            acceleration_m_per_s2: acceleration,
        } = self.motion;
        let ray_m = self.ray_m - (velocity + acceleration * (0.5 * later_s)) * later_s;
        let velocity = velocity + acceleration * later_s;
        let range_m = ray_m.length();
        let per_m = 1.0 / range_m.max(f64::MIN_POSITIVE);
        let e = ray_m * per_m;
        let closing = velocity.dot(e);
        let across2 = (velocity.length_squared() - closing * closing).max(0.0);
        let second = across2 * per_m - acceleration.dot(e);
        (range_m, -closing, second)
    }
}

/// Second-order emission time. The sample received s seconds after `delay_s` was transmitted at
/// `(1 + doppler) s + curvature s^2`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Stretched {
    pub delay_s: f64,
    pub doppler: f64,
    pub curvature_per_s: f64,
}

/// Minimum length of a leg for a Taylor series about mid-pulse, in distances that either end moves
/// during a pulse.
const NEAREST_LEG: f64 = 5.0;

/// Expands about mid-pulse and expresses the result relative to the leading edge. `delay_s` and
/// `doppler` are those of the leading edge, and `half_s` is T/2.
///
/// A scatterer too close to the sonar keeps the stretch of its leading edge. The code has no
/// branch, so batches vectorise.
#[inline(always)]
pub(crate) fn about_mid_pulse(
    c: f64,
    half_s: f64,
    transmit: Leg,
    receive: Leg,
    delay_s: f64,
    doppler: f64,
) -> Stretched {
    // Squares are compared, because the leg lengths are computed later.
    let moved2_m2 =
        |leg: &Leg| 4.0 * half_s * half_s * leg.motion.velocity_m_per_s.length_squared();
    let nearest2_m2 = transmit
        .ray_m
        .length_squared()
        .min(receive.ray_m.length_squared());
    let most2_m2 = moved2_m2(&transmit).max(moved2_m2(&receive));
    let near = nearest2_m2 < NEAREST_LEG * NEAREST_LEG * most2_m2;

    let (transmit_m, transmit_rate, transmit_second) = transmit.at(half_s);
    // Arrival of mid-pulse: a Newton step from the stretch at the leading edge, corrected by the
    // second derivative. The error is below 1e-14 s.
    let guess_s = half_s * (1.0 - doppler * (1.0 - doppler));
    let (receive_m, rate, receive_second) = receive.at(guess_s);
    let per_closing = 1.0 / (c - rate);
    let residual_m = c * ((delay_s - half_s) + guess_s) - transmit_m - receive_m;
    let step_s = -residual_m * per_closing;
    let later_s = step_s + 0.5 * receive_second * step_s * step_s * per_closing;
    let since_s = guess_s + later_s;
    let receive_rate = rate + receive_second * later_s;
    let per_speed = 1.0 / (c + transmit_rate);
    let middle = -(receive_rate + transmit_rate) * per_speed;
    let eta = 1.0 + middle;
    let curvature_per_s = -0.5 * (transmit_second * eta * eta + receive_second) * per_speed;
    // The reference is moved back to t' = 0: half + eta s + curvature s^2 = 0.
    let root = (eta * eta - 4.0 * curvature_per_s * half_s).max(0.0).sqrt();
    let edge_s = -2.0 * half_s / (eta + root);
    let pick = |at_edge: f64, expanded: f64| if near { at_edge } else { expanded };
    Stretched {
        delay_s: pick(delay_s, delay_s + (since_s + edge_s)),
        doppler: pick(doppler, middle + 2.0 * curvature_per_s * edge_s),
        curvature_per_s: pick(0.0, curvature_per_s),
    }
}

/// Delay of Eq. 21 of Meng et al. 2023 as printed, with f_S of Eq. 20 read as f_{m,T}. The
/// frequency ratio is c/(c - a) on the first leg and (c + b)/(c - a) on the second leg. Each ratio
/// multiplies the delay of its leg. The result is an unstretched pulse at this delay. `closing` has
/// a and b, m/s.
pub(crate) fn paper_eq21_delay_s(
    c: f64,
    first_leg_s: f64,
    delay_s: f64,
    closing: (f64, f64),
) -> f64 {
    let (a, b) = closing;
    delay_s + (first_leg_s * a + (delay_s - first_leg_s) * (a + b)) / (c - a)
}

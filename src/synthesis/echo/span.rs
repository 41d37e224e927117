//! Bounds on the Doppler stretches of the echoes of a ping, computed before any echo.
//!
//! The inputs are the insonified scatterers and a receive array. The result is the smallest and
//! largest eta - 1 over all its elements. eta - 1 = (v_R.e_R + v_T.e_T)/(c - v_T.e_T), and v_T.e_T
//! is known for every scatterer. v_R.e_R differs from it by at most |v_R - v_T| + |v_T| |e_R -
//! e_T|. Two unit vectors to one point differ by at most 2 |a - b|/(|a| + |b|) (Dunkl and Williams
//! 1964).

use echotank_core::arrays::ArrayGeometry;
use echotank_core::model::DopplerModel;
use echotank_core::ping::PingPlan;

use super::walk::{TransmitLeg, Workspace};

/// Smallest and largest eta - 1 that [`arrivals`](super::walk::arrivals) can emit for any element
/// of `array`. `work` is a buffer for temporary values.
pub fn doppler_span(
    plan: &PingPlan,
    array: &ArrayGeometry,
    transmit_leg: &TransmitLeg,
    work: &mut Workspace,
) -> (f64, f64) {
    if transmit_leg.is_empty() || plan.model.doppler == DopplerModel::None {
        return (0.0, 0.0);
    }
    let c = plan.sound_speed_m_per_s;
    let transmit_m_per_s = transmit_leg.transmit.motion.velocity_m_per_s;
    // Positions and velocities are linear along the line, so those of its two ends bound the rest.
    let (mut arm_m, mut speed, mut change) = (0.0f64, transmit_m_per_s.length(), 0.0f64);
    for element in [0, array.elements - 1] {
        let track = &mut work.track;
        track.compute(plan, transmit_leg.sent(), array, element);
        arm_m = arm_m.max(track.reach_m(0.0));
        track.bound_velocities(plan, |velocity_m_per_s, beside| {
            speed = speed.max(velocity_m_per_s.length() + beside);
            change = change.max((velocity_m_per_s - transmit_m_per_s).length() + beside);
        });
    }
    let per_range = 2.0 * speed / c;
    let still_m = arm_m * (1.0 + speed / c);
    let transmit_speed = transmit_m_per_s.length();
    let (mut least, mut greatest) = (f64::INFINITY, f64::NEG_INFINITY);
    let batches = transmit_leg
        .batch_closing_m_per_s
        .iter()
        .zip(&transmit_leg.batch_range_m);
    for (&(leaving, closing), &(nearest_m, farthest_m)) in batches {
        // Distance of the element from the transmit position when an echo arrives, relative to the
        // range of the scatterer; largest at the nearest range.
        // Where the legs differ, a late echo may have a short receive leg.
        let (path_m, receive_m) = match transmit_leg.nearest_receive_m {
            None => (nearest_m, nearest_m),
            Some(receive_m) => (farthest_m, receive_m),
        };
        let apart_m = still_m + per_range * path_m;
        let turned = (2.0 * apart_m / (2.0 * receive_m - apart_m).max(0.0)).min(2.0);
        let beside = change + transmit_speed * turned;
        if transmit_leg.has_images() {
            // The speeds are means over both legs: (v_R.e_R + v_T.e_T) differs from twice them by `beside`, and the divisor from c by
            // at most the transmitter's speed.
            let (low, high) = (2.0 * leaving - beside, 2.0 * closing + beside);
            for divisor in [c - transmit_speed, c + transmit_speed] {
                least = least.min(low / divisor);
                greatest = greatest.max(high / divisor);
            }
            continue;
        }
        // Both bounds are monotonic in the transmitter's part below c.
        least = least.min((2.0 * leaving - beside) / (c - leaving));
        greatest = greatest.max((2.0 * closing + beside) / (c - closing));
    }
    (least, greatest)
}

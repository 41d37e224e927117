//! The walk for stretches of a line array: the echoes at one point of the line, with their derivatives along it and during the pulse.
//!
//! c (w + u) = c w + |S - p_T - V_T w| + |S - r - a y - v (w + u)|, differentiated at the leading edge. With e the receive ray's unit
//! vector, R its length, a the line's axis, v the velocity in the path and V that of the Doppler term (the same, or zero in one of them):
//!
//! ```text
//! u_y       = -(e.a) / (c + v.e)                     q = a + v u_y,  q.e = -c u_y
//! u_yy      = (q.q - (q.e)^2) / (R (c + v.e))
//! u_yw      = (1 + u_w) (V.q - (V.e)(q.e)) / (R (c + V.e))
//! u_ww      = [(V_T.V_T - (V_T.e_T)^2) / r_T + (1 + u_w)^2 (V.V - (V.e)^2) / R] / (c + V.e)
//! 1 + u_w   = 1 / (1 + doppler)
//! ```

use crate::flow::{ArrayGeometry, CHUNK, EchoCounts, LineChunk, LineSink, PingPlan};

use super::{Batch, Complex64, Heard, Illuminated, Rays, ReceiveLeg, pattern_floor, solve, weigh};
use super::{Directivity, ElementTrack, OneWay, amplitude_from_db, wavelength_m};

/// Scratch of one thread of [`line_arrivals`].
#[derive(Default)]
pub struct LineWorkspace {
    track: ElementTrack,
    rays: Rays,
    heard: Heard,
    chunk: LineChunk,
}

/// A stretch of the line, by its middle, and the leading edges that are asked for.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Stretch {
    /// From the array's centre.
    pub middle_m: f64,
    /// Elements in it, for the counts.
    pub elements: u64,
    /// From `earliest_s` up to, not including, `latest_s`.
    pub earliest_s: f64,
    pub latest_s: f64,
}

/// Echoes of everything lit at the middle of a stretch of the line, in chunks of at most [`CHUNK`], in the order of the scatterers.
///
/// What [`illuminate`](super::illuminate) was told of the window does not count here: `stretch` does. Counts are of scatterer-element
/// pairs; an echo outside the delays asked for is not counted at all, since another call asks for it.
pub fn line_arrivals(
    plan: &PingPlan,
    array: &ArrayGeometry,
    stretch: Stretch,
    lit: &Illuminated,
    work: &mut LineWorkspace,
    sink: &mut impl LineSink,
) -> EchoCounts {
    let mut counts = EchoCounts::default();
    if lit.window.is_none() {
        return counts;
    }
    let c = plan.sound_speed_m_per_s;
    let receive = ReceiveLeg {
        c,
        pattern: Directivity::new(&array.element_pattern, wavelength_m(plan)),
        one_way: OneWay::new(wavelength_m(plan), plan.absorption_db_per_m),
        sensitivity: amplitude_from_db(array.sensitivity_db),
    };
    let floor = pattern_floor(plan);
    let LineWorkspace {
        track,
        rays,
        heard,
        chunk,
    } = work;
    track.lay_at(plan, &lit.transmit, array, stretch.middle_m);
    // 2 r_T - reach <= c u <= 2 r_T + reach.
    let reach_m = track.reach_m(stretch.latest_s) * (1.0 + 1e-9);
    let nearest_m = 0.5 * (c * stretch.earliest_s - reach_m) * (1.0 - 1e-12);
    let farthest_m = 0.5 * (c * stretch.latest_s + reach_m) * (1.0 + 1e-12);
    let transmit_v2 = lit.transmit.velocity_m_per_s.length_squared();
    let mut motion = track.motion_at(stretch.earliest_s);
    let mut since_s = stretch.earliest_s;
    chunk.len = 0;

    for (b, &(least_range_m, greatest_range_m)) in lit.batch_range_m.iter().enumerate() {
        if least_range_m > farthest_m || greatest_range_m < nearest_m {
            continue;
        }
        let span = b * CHUNK..((b + 1) * CHUNK).min(lit.len());
        let batch = Batch {
            x_m: &lit.x_m[span.clone()],
            y_m: &lit.y_m[span.clone()],
            z_m: &lit.z_m[span.clone()],
            range_m: &lit.range_m[span.clone()],
            least_range_m,
            greatest_range_m,
        };
        let odd = solve(track, c, batch, rays);
        counts.no_root += odd.no_root * stretch.elements;
        counts.two_roots += odd.two_roots * stretch.elements;
        weigh(&receive, lit, span.clone(), rays, heard);

        for (i, m) in span.enumerate() {
            let delay_s = rays.delay_s[i];
            if !(stretch.earliest_s..stretch.latest_s).contains(&delay_s) {
                continue;
            }
            let amplitude = lit.amplitude[m] * heard.gain[i];
            if heard.level[i] < floor || amplitude == Complex64::ZERO {
                counts.culled += stretch.elements;
                continue;
            }
            counts.used += stretch.elements;
            if heard.range_m[i] < receive.one_way.wavelength_m {
                counts.too_close += stretch.elements;
            }
            if delay_s >= track.end_s() {
                counts.beyond_track += stretch.elements;
            }
            if delay_s < since_s || delay_s >= motion.until_s {
                motion = track.motion_at(delay_s);
                since_s = delay_s;
            }
            let doppler = heard.doppler[i];
            let per_m = 1.0 / heard.range_m[i].max(f64::MIN_POSITIVE);
            let ray = glam::DVec3::new(rays.x_m[i], rays.y_m[i], rays.z_m[i]) * per_m;
            let stretched = 1.0 / (1.0 + doppler);
            let (v, w) = (motion.velocity_m_per_s, motion.doppler_velocity_m_per_s);
            let per_s = 1.0 / (c + v.dot(ray));
            let u_y = -rays.array_x_m[i] * per_m * per_s;
            let q = motion.axis + v * u_y;
            let slope = -c * u_y;
            let closing = w.dot(ray);
            let per_w = c / (c + closing);
            let at = chunk.len;
            chunk.delay_s[at] = delay_s;
            chunk.doppler[at] = doppler;
            chunk.amplitude[at] = amplitude;
            chunk.slope[at] = slope;
            chunk.bend_per_m[at] = (q.length_squared() - slope * slope) * per_m * c * per_s;
            chunk.twist_per_s[at] = stretched * (w.dot(q) - closing * slope) * per_m * per_w;
            chunk.swing_m_per_s2[at] = ((transmit_v2 - lit.closing_m_per_s[m].powi(2))
                / lit.range_m[m].max(f64::MIN_POSITIVE)
                + stretched * stretched * (w.length_squared() - closing * closing) * per_m)
                * per_w;
            chunk.len = at + 1;
            if chunk.len == CHUNK {
                sink.accept(chunk);
                chunk.len = 0;
            }
        }
    }
    if chunk.len > 0 {
        sink.accept(chunk);
        chunk.len = 0;
    }
    counts
}

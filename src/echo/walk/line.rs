//! The walk for stretches of a line array: the echoes at one point of the line, with their derivatives along it and during the pulse.
//!
//! c (w + u) = c w + |S - p_T - V_T w| + |S - r - a y - v (w + u)|, differentiated at the leading edge. With e the receive ray's unit
//! vector, R its length, a the line's axis and a' how it turns, v the velocity in the path and V that of the Doppler term (the same, or zero
//! in one of them), V_y how V differs along the line, A accelerations:
//!
//! ```text
//! u_y       = -(e.a) / (c + v.e)                     q = a + v u_y,  q.e = -c u_y
//! u_yy      = ((q.q - (q.e)^2) / R - 2 u_y a'.e) / (c + v.e)
//! u_yw      = (1 + u_w) [(V.q - (V.e)(q.e)) / R - V_y.e] / (c + V.e)
//! u_ww      = [(V_T.V_T - (V_T.e_T)^2) / r_T - A_T.e_T + (1 + u_w)^2 ((V.V - (V.e)^2) / R - A.e)] / (c + V.e)
//! 1 + u_w   = 1 / (1 + doppler)
//! ```

use std::sync::{Mutex, PoisonError};

use crate::flow::{
    ArrayGeometry, CHUNK, EchoCounts, LineChunk, LineSink, LineSource, LineStretch, PathModel,
    PingPlan,
};

use glam::DVec3;

use super::{
    Batch, Complex64, Heard, Illuminated, Rays, ReceiveLeg, pattern_floor, refine, solve, weigh,
};
use super::{Directivity, ElementTrack, Motion, OneWay, amplitude_from_db, wavelength_m};

/// Scratch of one thread of [`line_arrivals`].
#[derive(Default)]
pub struct LineWorkspace {
    track: LineTrack,
    rays: Rays,
    heard: Heard,
    chunk: LineChunk,
}

impl LineWorkspace {
    /// With room for a polyline of so many segments, so that no ping allocates.
    pub fn with_room_for(segments: usize) -> Self {
        Self {
            track: LineTrack {
                middle: ElementTrack::with_room_for(segments),
                ahead: ElementTrack::with_room_for(segments),
            },
            ..Self::default()
        }
    }
}

/// The way of a stretch through one ping: that of its middle and that of a point one metre along. A rigid line's places and velocities
/// differ evenly along it, so that two points tell all.
#[derive(Debug, Default)]
struct LineTrack {
    middle: ElementTrack,
    ahead: ElementTrack,
}

/// How a line moves while its middle is on one leg.
#[derive(Clone, Copy, Debug, Default)]
struct LineMotion {
    start_s: f64,
    until_s: f64,
    /// At `start_s`, and how it turns.
    axis: DVec3,
    turning_per_s: DVec3,
    /// In the path.
    velocity_m_per_s: DVec3,
    /// Of Doppler, at `start_s`; and how it differs along the line.
    heard: Motion,
    heard_along_per_s: DVec3,
}

impl LineTrack {
    fn motion_at(&self, time_s: f64) -> LineMotion {
        let (number, leg) = self.middle.leg_at(time_s);
        let ahead = self.ahead.leg(number);
        LineMotion {
            start_s: leg.start_s,
            until_s: leg.end_s,
            axis: ahead.origin_m - leg.origin_m,
            turning_per_s: ahead.velocity_m_per_s - leg.velocity_m_per_s,
            velocity_m_per_s: leg.velocity_m_per_s,
            heard: leg.doppler,
            heard_along_per_s: ahead.doppler.velocity_m_per_s - leg.doppler.velocity_m_per_s,
        }
    }
}

/// The echoes of one ping at one line array, for whoever synthesises whole stretches of it.
pub struct LineEchoes<'a> {
    pub plan: &'a PingPlan,
    pub array: &'a ArrayGeometry,
    pub lit: &'a Illuminated,
    /// One per thread of the pool: no lock ever waits.
    pub work: &'a [Mutex<LineWorkspace>],
}

impl LineSource for LineEchoes<'_> {
    fn scatterers(&self) -> u64 {
        self.lit.len() as u64
    }

    fn walk(&self, stretch: LineStretch, sink: &mut impl LineSink) -> EchoCounts {
        let thread = rayon::current_thread_index().unwrap_or(0);
        // A panic in another ping leaves the scratch as good as any: every use overwrites it.
        let mut work = self.work[thread]
            .lock()
            .unwrap_or_else(PoisonError::into_inner);
        line_arrivals(self.plan, self.array, stretch, self.lit, &mut work, sink)
    }
}

/// Echoes of everything lit at the middle of a stretch of the line, in chunks of at most [`CHUNK`], in the order of the scatterers.
///
/// What [`illuminate`](super::illuminate) was told of the window does not count here: `stretch` does. Counts are of scatterer-element
/// pairs; an echo outside the delays asked for is not counted at all, since another call asks for it.
pub fn line_arrivals(
    plan: &PingPlan,
    array: &ArrayGeometry,
    stretch: LineStretch,
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
    track
        .middle
        .lay_at(plan, &lit.transmit, array, stretch.middle_m);
    track
        .ahead
        .lay_at(plan, &lit.transmit, array, stretch.middle_m + 1.0);
    // 2 r_T - reach <= c u <= 2 r_T + reach.
    let reach_m = track.middle.reach_m(stretch.latest_s) * (1.0 + 1e-9);
    let nearest_m = 0.5 * (c * stretch.earliest_s - reach_m) * (1.0 - 1e-12);
    let farthest_m = 0.5 * (c * stretch.latest_s + reach_m) * (1.0 + 1e-12);
    let transmit_v2 = lit.transmit.motion.velocity_m_per_s.length_squared();
    let transmit_a = lit.transmit.motion.acceleration_m_per_s2;
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
        let odd = solve(&track.middle, c, batch, rays);
        counts.no_root += odd.no_root * stretch.elements;
        counts.two_roots += odd.two_roots * stretch.elements;
        if plan.model.path == PathModel::Continuous {
            refine(plan, &lit.transmit, &track.middle, batch, rays);
        }
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
            if delay_s >= track.middle.end_s() {
                counts.beyond_track += stretch.elements;
            }
            if delay_s < since_s || delay_s >= motion.until_s {
                motion = track.motion_at(delay_s);
                since_s = delay_s;
            }
            let doppler = heard.doppler[i];
            let per_m = 1.0 / heard.range_m[i].max(f64::MIN_POSITIVE);
            let ray = DVec3::new(rays.x_m[i], rays.y_m[i], rays.z_m[i]) * per_m;
            let stretched = 1.0 / (1.0 + doppler);
            let since_start_s = delay_s - motion.start_s;
            let v = motion.velocity_m_per_s;
            let acceleration = motion.heard.acceleration_m_per_s2;
            let w = motion.heard.velocity_m_per_s + acceleration * since_start_s;
            let axis = motion.axis + motion.turning_per_s * since_start_s;
            let per_s = 1.0 / (c + v.dot(ray));
            let u_y = -axis.dot(ray) * per_s;
            let q = axis + v * u_y;
            let slope = -c * u_y;
            let closing = w.dot(ray);
            let per_w = c / (c + closing);
            let turned = 2.0 * u_y * motion.turning_per_s.dot(ray);
            let along = motion.heard_along_per_s.dot(ray);
            let transmit_ray = DVec3::new(lit.x_m[m], lit.y_m[m], lit.z_m[m]);
            let transmit_per_m = 1.0 / lit.range_m[m].max(f64::MIN_POSITIVE);
            let at = chunk.len;
            chunk.delay_s[at] = delay_s;
            chunk.doppler[at] = doppler;
            chunk.amplitude[at] = amplitude;
            chunk.slope[at] = slope;
            chunk.bend_per_m[at] =
                ((q.length_squared() - slope * slope) * per_m - turned) * c * per_s;
            chunk.twist_per_s[at] =
                stretched * ((w.dot(q) - closing * slope) * per_m - along) * per_w;
            chunk.swing_m_per_s2[at] = ((transmit_v2
                - lit.closing_m_per_s[m].powi(2)
                - transmit_a.dot(transmit_ray))
                * transmit_per_m
                + stretched
                    * stretched
                    * ((w.length_squared() - closing * closing) * per_m - acceleration.dot(ray)))
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

//! Walk for sections of a line array: echoes at one point of the line, with their derivatives along the line
//! and during the pulse.
//!
//! The derivatives follow from implicit differentiation of the two-way delay equation at the
//! leading edge:
//!
//! ```text
//! c (w + u) = c w + |S - p_T - V_T w| + |S - r - a y - v (w + u)|
//!
//! u_y       = -(e.a) / (c + v.e)                     q = a + v u_y,  q.e = -c u_y
//! u_yy      = ((q.q - (q.e)^2) / R - 2 u_y a'.e) / (c + v.e)
//! u_yw      = (1 + u_w) [(V.q - (V.e)(q.e)) / R - V_y.e] / (c + V.e)
//! u_ww      = [(V_T.V_T - (V_T.e_T)^2) / r_T - A_T.e_T + (1 + u_w)^2 ((V.V - (V.e)^2) / R - A.e)] / (c + V.e)
//! 1 + u_w   = 1 / (1 + doppler)
//! ```
//!
//! Here u is the delay, w the emission time and y the coordinate along the line. e is the unit vector of the
//! receive ray and R its length. a is the axis of the line and a' its rate of turn. v is the velocity in the
//! path and V the velocity in the Doppler term. They are equal, or one of them is zero. V_y is the gradient of
//! V along the line and A denotes accelerations.
//!
//! Consecutive scatterers are usually close together. The corners of a batch's bounding box therefore bound
//! the echoes of the batch, and [`LineSource::survey`] emits these corners.

use std::sync::{Mutex, PoisonError};

use glam::DVec3;

use crate::arrivals::{CHUNK, LineChunk, LineSection, LineSink, LineSource};
use echotank_core::arrays::ArrayGeometry;
use echotank_core::model::{DopplerModel, PathModel};
use echotank_core::ping::{EchoCounts, PingPlan};
use echotank_core::simd::widest;

use super::{
    Batch, Complex64, Rays, ReceiveLeg, ReceivedBatch, TransmitLeg, pattern_floor, receive_gains,
    refine, solve,
};
use super::{ElementTrack, Motion};

/// Number of corners of a box.
const CORNERS: usize = 8;
/// Maximum ratio of the size of a box to its range. A larger box is surveyed point by point.
const SMALL_BOX: f64 = 0.25;

/// Minimum gain in the middle of a section, relative to the gains at its ends.
const NULL: f64 = 1e-6;
/// Approximate number of batches with echoes in a survey.
const SAMPLED: usize = 16;

/// Per-thread buffers of [`line_arrivals`].
pub struct LineWorkspace {
    track: LineTrack,
    rays: Rays,
    received: ReceivedBatch,
    /// Rays to one end of the section; `end_gain` has the gains at both ends.
    end_rays: Rays,
    end_received: ReceivedBatch,
    gains: Box<[[f64; CHUNK]; 2]>,
    chunk: Box<LineChunk>,
    /// Points collected by a survey.
    points: Box<SurveyPoints>,
}

impl Default for LineWorkspace {
    fn default() -> Self {
        Self {
            track: LineTrack::default(),
            rays: Rays::default(),
            received: ReceivedBatch::default(),
            end_rays: Rays::default(),
            end_received: ReceivedBatch::default(),
            gains: Box::new([[0.0; CHUNK]; 2]),
            chunk: Box::default(),
            points: Box::default(),
        }
    }
}

impl LineWorkspace {
    /// Buffers with capacity for a polyline of `segments` segments, so that no ping allocates.
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

/// Up to [`CHUNK`] points in the layout of [`TransmitLeg`], without strengths.
struct SurveyPoints {
    len: usize,
    x_m: [f64; CHUNK],
    y_m: [f64; CHUNK],
    z_m: [f64; CHUNK],
    range_m: [f64; CHUNK],
    transmit_m: [[f64; CHUNK]; 3],
    half_path_m: [f64; CHUNK],
    closing_m_per_s: [f64; CHUNK],
}

impl Default for SurveyPoints {
    fn default() -> Self {
        let zero = [0.0; CHUNK];
        Self {
            len: 0,
            x_m: zero,
            y_m: zero,
            z_m: zero,
            range_m: zero,
            transmit_m: [zero; 3],
            half_path_m: zero,
            closing_m_per_s: zero,
        }
    }
}

/// Motion of a section through one ping, given by its middle and a point one metre along the line. Positions
/// and velocities on a rigid line are linear along it, so two points suffice.
#[derive(Debug, Default)]
struct LineTrack {
    middle: ElementTrack,
    ahead: ElementTrack,
}

/// Motion of a line while its middle is on one leg of the polyline.
#[derive(Clone, Copy, Debug, Default)]
struct LineMotion {
    start_s: f64,
    until_s: f64,
    /// Axis at `start_s`; `turning_per_s` is its rate of change.
    axis: DVec3,
    turning_per_s: DVec3,
    /// Quadratic term of the axis, the factor of (t - start)(end - t). On the continuous path the line follows
    /// its attitude instead of the chord between vertices. Zero for other paths.
    arc_per_s2: DVec3,
    length_s: f64,
    /// Velocity in the path equation; `velocity_in_array_m_per_s` is the same in array axes.
    velocity_m_per_s: DVec3,
    velocity_in_array_m_per_s: DVec3,
    /// True if the velocity of the path equals the Doppler velocity at every instant.
    exact: bool,
    /// Motion in the Doppler term at `start_s`; `doppler_along_per_s` is its velocity gradient along the line.
    doppler: Motion,
    doppler_along_per_s: DVec3,
}

impl LineTrack {
    fn motion_at(&self, plan: &PingPlan, array: &ArrayGeometry, time_s: f64) -> LineMotion {
        let (number, leg) = self.middle.leg_at(time_s);
        let ahead = self.ahead.leg(number);
        let axis = ahead.origin_m - leg.origin_m;
        let turning_per_s = ahead.velocity_m_per_s - leg.velocity_m_per_s;
        let continuous = plan.model.path == PathModel::Continuous;
        let length_s = match leg.end_s.is_finite() {
            true => leg.end_s - leg.start_s,
            false => plan.model.segment_s,
        };
        let arc_per_s2 = if continuous && length_s > 0.0 {
            let pose = plan.trajectory.pose_at(leg.start_s + 0.5 * length_s);
            let there = pose.world_from_body * (array.mounting.body_from_array * DVec3::X);
            (there - axis - turning_per_s * (0.5 * length_s)) * (4.0 / (length_s * length_s))
        } else {
            DVec3::ZERO
        };
        LineMotion {
            start_s: leg.start_s,
            until_s: leg.end_s,
            axis,
            turning_per_s,
            arc_per_s2,
            length_s,
            exact: continuous && plan.model.doppler != DopplerModel::None,
            velocity_m_per_s: leg.velocity_m_per_s,
            velocity_in_array_m_per_s: leg.velocity_in_array_m_per_s(),
            doppler: leg.doppler,
            doppler_along_per_s: ahead.doppler.velocity_m_per_s - leg.doppler.velocity_m_per_s,
        }
    }
}

/// Echoes of one ping at one line array, the input of engines that synthesise whole sections.
pub struct LineEchoes<'a> {
    /// Geometry, pulse and model of the ping.
    pub plan: &'a PingPlan,
    /// The line array.
    pub array: &'a ArrayGeometry,
    /// Insonified scatterers of the ping.
    pub transmit_leg: &'a TransmitLeg,
    /// One workspace per thread of the pool, so no lock is contended.
    pub work: &'a [Mutex<LineWorkspace>],
}

impl LineEchoes<'_> {
    fn with_work<R>(&self, f: impl FnOnce(&mut LineWorkspace) -> R) -> R {
        let thread = rayon::current_thread_index().unwrap_or(0);
        // The lock may be poisoned by a panic in another ping. The buffers remain valid, because every use
        // overwrites them.
        let mut work = self.work[thread]
            .lock()
            .unwrap_or_else(PoisonError::into_inner);
        f(&mut work)
    }
}

impl LineSource for LineEchoes<'_> {
    fn scatterers(&self) -> u64 {
        self.transmit_leg.len() as u64
    }

    fn earliest_s(&self) -> f64 {
        let nearest_m = self.transmit_leg.batch_range_m.iter();
        let nearest_m =
            nearest_m.fold(f64::INFINITY, |least, &(nearest_m, _)| least.min(nearest_m));
        if !nearest_m.is_finite() {
            return f64::INFINITY;
        }
        let c = self.plan.sound_speed_m_per_s;
        self.with_work(|work| {
            let track = &mut work.track;
            track
                .middle
                .compute_at(self.plan, self.transmit_leg.sent(), self.array, 0.0);
            let half_m = 0.5 * (self.array.elements.max(1) - 1) as f64 * self.array.spacing_m;
            // The motion after the delay from the transmitter's own position has no effect.
            let reach_m = track.middle.reach_m(2.0 * nearest_m / c) + half_m;
            (2.0 * nearest_m - reach_m * (1.0 + 1e-9)) * (1.0 - 1e-9) / c
        })
    }

    fn survey(&self, section: LineSection, sink: &mut impl LineSink) {
        self.with_work(|work| {
            line_survey(
                self.plan,
                self.array,
                section,
                self.transmit_leg,
                work,
                sink,
            )
        });
    }

    fn walk(&self, section: LineSection, sink: &mut impl LineSink) -> EchoCounts {
        self.with_work(|work| {
            line_arrivals(
                self.plan,
                self.array,
                section,
                self.transmit_leg,
                work,
                sink,
            )
        })
    }
}

/// Emits the echoes of all insonified scatterers at the middle of a section to `sink`, in chunks of at most
/// [`CHUNK`] and in a fixed order.
///
/// `section` sets the delays, and the window given to [`insonify`](super::insonify) is ignored. Counts are in
/// scatterer-element pairs. Echoes outside the delays of `section` are not counted, because another call
/// covers them.
pub fn line_arrivals(
    plan: &PingPlan,
    array: &ArrayGeometry,
    section: LineSection,
    transmit_leg: &TransmitLeg,
    work: &mut LineWorkspace,
    sink: &mut impl LineSink,
) -> EchoCounts {
    walk_batches(plan, array, section, transmit_leg, 1, work, sink)
}

/// [`line_arrivals`] of every `step`-th batch.
fn walk_batches(
    plan: &PingPlan,
    array: &ArrayGeometry,
    section: LineSection,
    transmit_leg: &TransmitLeg,
    every: usize,
    work: &mut LineWorkspace,
    sink: &mut impl LineSink,
) -> EchoCounts {
    let mut counts = EchoCounts::default();
    if transmit_leg.window.is_none() {
        return counts;
    }
    let c = plan.sound_speed_m_per_s;
    let receive = ReceiveLeg::new(plan, array);
    let floor = pattern_floor(plan);
    let (nearest_m, farthest_m) =
        compute_track(plan, array, section, transmit_leg, &mut work.track);
    let LineWorkspace {
        track,
        rays,
        received,
        end_rays,
        end_received,
        gains,
        chunk,
        ..
    } = work;
    let requested = section.earliest_s..section.latest_s;

    for (b, &(min_range_m, max_range_m)) in
        transmit_leg.batch_range_m.iter().enumerate().step_by(every)
    {
        if min_range_m > farthest_m || max_range_m < nearest_m {
            continue;
        }
        let (span, batch) = transmit_leg.batch(b);
        let odd = solve(&track.middle, c, batch, rays);
        if plan.model.path == PathModel::Continuous {
            refine(plan, &transmit_leg.transmit, &track.middle, batch, rays);
        }
        let n = span.len();
        let (first_s, last_s) = rays.delay_s[..n]
            .iter()
            .fold((f64::INFINITY, f64::NEG_INFINITY), |(a, b), &u| {
                (a.min(u), b.max(u))
            });
        if first_s >= section.latest_s || last_s < section.earliest_s {
            continue;
        }
        counts.no_root += odd.no_root * section.elements;
        counts.two_roots += odd.two_roots * section.elements;
        receive_gains(&receive, transmit_leg, span.clone(), rays, received);

        let whole = requested.contains(&first_s) && requested.contains(&last_s);
        let mut since_s = first_s;
        while since_s <= last_s {
            let motion = track.motion_at(plan, array, since_s);
            let derivation = Derivation {
                c,
                motion: &motion,
                transmit: transmit_leg.transmit.motion,
                batch,
                closing_m_per_s: &transmit_leg.closing_m_per_s[span.clone()],
                rays,
            };
            derivation.run(&received.doppler, chunk);
            if section.gain_terms {
                let half_m = section.half_m;
                for (end_m, gains) in [-half_m, half_m].into_iter().zip(gains.iter_mut()) {
                    rays_from(rays, end_m, &motion, &chunk.slope[..n], c, end_rays);
                    receive_gains(&receive, transmit_leg, span.clone(), end_rays, end_received);
                    gains[..n].copy_from_slice(&end_received.gain[..n]);
                }
                set_gain_terms(&mut received.gain[..n], gains, half_m, chunk);
            } else {
                chunk.gain_slope_per_m[..n].fill(0.0);
                chunk.gain_curvature_per_m2[..n].fill(0.0);
            }
            let one_leg = since_s == first_s && last_s < motion.until_s;
            let mut used = 0;
            for i in 0..n {
                let delay_s = rays.delay_s[i];
                let here = one_leg || (since_s..motion.until_s).contains(&delay_s);
                if !(whole || requested.contains(&delay_s)) || !here {
                    continue;
                }
                let amplitude = transmit_leg.amplitude[span.start + i] * received.gain[i];
                if received.level[i] < floor || amplitude == Complex64::ZERO {
                    counts.culled += section.elements;
                    continue;
                }
                if received.range_m[i] < receive.one_way.wavelength_m {
                    counts.too_close += section.elements;
                }
                if delay_s >= track.middle.end_s() {
                    counts.beyond_track += section.elements;
                }
                chunk.delay_s[used] = delay_s;
                chunk.doppler[used] = received.doppler[i];
                chunk.amplitude[used] = amplitude;
                if used < i {
                    chunk.move_derivatives(i, used);
                }
                used += 1;
            }
            counts.used += used as u64 * section.elements;
            if used > 0 {
                chunk.len = used;
                sink.accept(chunk);
            }
            since_s = motion.until_s;
        }
    }
    counts
}

/// Rays of a batch to the point `end_m` along the line, at the instant when the echoes arrive there. While the
/// line moves, that instant differs from the arrival at the middle.
fn rays_from(rays: &Rays, end_m: f64, motion: &LineMotion, slope: &[f64], c: f64, to: &mut Rays) {
    let offset_m = motion.axis * end_m;
    let (v, in_array) = (motion.velocity_m_per_s, motion.velocity_in_array_m_per_s);
    for (i, slope) in slope.iter().take(CHUNK).enumerate() {
        let later_s = -slope * end_m / c;
        to.x_m[i] = rays.x_m[i] - (offset_m.x + v.x * later_s);
        to.y_m[i] = rays.y_m[i] - (offset_m.y + v.y * later_s);
        to.z_m[i] = rays.z_m[i] - (offset_m.z + v.z * later_s);
        to.array_x_m[i] = rays.array_x_m[i] - (end_m + in_array.x * later_s);
        to.array_y_m[i] = rays.array_y_m[i] - in_array.y * later_s;
        to.array_z_m[i] = rays.array_z_m[i] - in_array.z * later_s;
    }
}

/// First and second derivative of the gain along the line, from the gains at both ends. In a null, the middle
/// has 1e-6 of the end gains, so that the derivatives remain relative to a non-zero gain.
fn set_gain_terms(gain: &mut [f64], ends: &[[f64; CHUNK]; 2], half_m: f64, chunk: &mut LineChunk) {
    // A single element has no extent.
    let per_m = if half_m > 0.0 { 0.5 / half_m } else { 0.0 };
    let per_m2 = 2.0 * per_m * per_m;
    for (i, gain) in gain.iter_mut().enumerate() {
        let (before, after, here) = (ends[0][i], ends[1][i], *gain);
        let least = NULL * before.abs().max(after.abs());
        if here.abs() < least {
            *gain = least.copysign(here);
        }
        let per_gain = if *gain == 0.0 { 0.0 } else { 1.0 / *gain };
        chunk.gain_slope_per_m[i] = (after - before) * per_m * per_gain;
        chunk.gain_curvature_per_m2[i] = (after + before - 2.0 * here) * per_m2 * per_gain;
    }
}

/// Computes the motion of the section. Returns the smallest and largest range from the transmitter at which a
/// scatterer arrives in time, metres: 2 r_T - reach <= c u <= 2 r_T + reach.
fn compute_track(
    plan: &PingPlan,
    array: &ArrayGeometry,
    section: LineSection,
    transmit_leg: &TransmitLeg,
    track: &mut LineTrack,
) -> (f64, f64) {
    let c = plan.sound_speed_m_per_s;
    let (middle_m, ahead_m) = (section.middle_m, section.middle_m + 1.0);
    track
        .middle
        .compute_at(plan, transmit_leg.sent(), array, middle_m);
    track
        .ahead
        .compute_at(plan, transmit_leg.sent(), array, ahead_m);
    let reach_m = track.middle.reach_m(section.latest_s) * (1.0 + 1e-9);
    (
        0.5 * (c * section.earliest_s - reach_m) * (1.0 - 1e-12),
        0.5 * (c * section.latest_s + reach_m) * (1.0 + 1e-12),
    )
}

/// Emits points with amplitude 0 that bound the echoes of [`line_arrivals`]: the corners of small boxes and
/// every point of large ones. Also emits the echoes of a regular subset of the batches.
pub(crate) fn line_survey(
    plan: &PingPlan,
    array: &ArrayGeometry,
    section: LineSection,
    transmit_leg: &TransmitLeg,
    work: &mut LineWorkspace,
    sink: &mut impl LineSink,
) {
    if transmit_leg.window.is_none() {
        return;
    }
    let (nearest_m, farthest_m) =
        compute_track(plan, array, section, transmit_leg, &mut work.track);
    work.points.len = 0;
    for (b, &(min_range_m, max_range_m)) in transmit_leg.batch_range_m.iter().enumerate() {
        if min_range_m > farthest_m || max_range_m < nearest_m {
            continue;
        }
        // Echoes whose legs differ have no box: they are surveyed point by point.
        let (low_m, high_m) = match transmit_leg.batch_box_m.get(b) {
            Some(own) => *own,
            None => (DVec3::ZERO, DVec3::splat(f64::INFINITY)),
        };
        if work.points.len > CHUNK - CORNERS {
            survey_points(plan, array, section, None, transmit_leg, work, sink);
        }
        if (high_m - low_m).length() < SMALL_BOX * min_range_m {
            for corner in 0..CORNERS {
                let pick = |bit: usize, low: f64, high: f64| {
                    if corner >> bit & 1 == 0 { low } else { high }
                };
                let at_m = DVec3::new(
                    pick(0, low_m.x, high_m.x),
                    pick(1, low_m.y, high_m.y),
                    pick(2, low_m.z, high_m.z),
                );
                let range_m = at_m.length();
                let closing = transmit_leg.transmit.motion.velocity_m_per_s.dot(at_m) / range_m;
                work.points.push(at_m, range_m, (at_m, range_m), closing);
            }
            continue;
        }
        survey_points(plan, array, section, None, transmit_leg, work, sink);
        let (span, batch) = transmit_leg.batch(b);
        for (i, of_batch) in span.zip(0..) {
            let [x_m, y_m, z_m] = batch.transmit_m.map(|axis| axis[of_batch]);
            let transmit_m = DVec3::new(x_m, y_m, z_m);
            let at_m = DVec3::new(
                transmit_leg.x_m[i],
                transmit_leg.y_m[i],
                transmit_leg.z_m[i],
            );
            work.points.push(
                at_m,
                transmit_leg.range_m[i],
                (transmit_m, batch.half_path_m[of_batch]),
                transmit_leg.closing_m_per_s[i],
            );
        }
        let requested = section.earliest_s..section.latest_s;
        survey_points(
            plan,
            array,
            section,
            Some(requested),
            transmit_leg,
            work,
            sink,
        );
    }
    survey_points(plan, array, section, None, transmit_leg, work, sink);
    let in_reach =
        |&&(min_m, greatest_m): &&(f64, f64)| min_m <= farthest_m && greatest_m >= nearest_m;
    let every = transmit_leg.batch_range_m.iter().filter(in_reach).count() / SAMPLED;
    let gain_terms = true;
    let sampled = LineSection {
        gain_terms,
        ..section
    };
    walk_batches(plan, array, sampled, transmit_leg, every.max(1), work, sink);
}

impl SurveyPoints {
    fn push(
        &mut self,
        at_m: DVec3,
        range_m: f64,
        (transmit_m, half_path_m): (DVec3, f64),
        closing_m_per_s: f64,
    ) {
        let at = self.len;
        let [x_m, y_m, z_m] = &mut self.transmit_m;
        (x_m[at], y_m[at], z_m[at]) = transmit_m.into();
        self.half_path_m[at] = half_path_m;
        (self.x_m[at], self.y_m[at], self.z_m[at]) = at_m.into();
        self.range_m[at] = range_m;
        self.closing_m_per_s[at] = closing_m_per_s;
        self.len = at + 1;
    }
}

/// Emits the collected points and clears them. Of surveyed echoes, only those within `requested` are emitted.
fn survey_points(
    plan: &PingPlan,
    array: &ArrayGeometry,
    section: LineSection,
    requested: Option<std::ops::Range<f64>>,
    transmit_leg: &TransmitLeg,
    work: &mut LineWorkspace,
    sink: &mut impl LineSink,
) {
    let LineWorkspace {
        track,
        rays,
        received,
        chunk,
        points,
        ..
    } = work;
    let n = std::mem::take(&mut points.len);
    if n == 0 {
        return;
    }
    let c = plan.sound_speed_m_per_s;
    let ranges = points.half_path_m[..n].iter().copied();
    let batch = Batch {
        x_m: &points.x_m[..n],
        y_m: &points.y_m[..n],
        z_m: &points.z_m[..n],
        range_m: &points.range_m[..n],
        transmit_m: points.transmit_m.each_ref().map(|axis| &axis[..n]),
        half_path_m: &points.half_path_m[..n],
        min_range_m: ranges.clone().fold(f64::INFINITY, f64::min),
        max_range_m: ranges.fold(0.0, f64::max),
    };
    solve(&track.middle, c, batch, rays);
    for i in 0..n {
        let ray_m = DVec3::new(rays.x_m[i], rays.y_m[i], rays.z_m[i]).length();
        let closing = points.closing_m_per_s[i];
        received.doppler[i] =
            (rays.closing_m2_per_s[i] / ray_m.max(f64::MIN_POSITIVE) + closing) / (c - closing);
    }
    let mut since_s = f64::NEG_INFINITY;
    loop {
        let motion = track.motion_at(plan, array, since_s.max(section.earliest_s));
        let derivation = Derivation {
            c,
            motion: &motion,
            transmit: transmit_leg.transmit.motion,
            batch,
            closing_m_per_s: &points.closing_m_per_s[..n],
            rays,
        };
        derivation.run(&received.doppler, chunk);
        // Corners beyond the requested delays are assigned to the first or last leg.
        let last = motion.until_s >= section.latest_s;
        let until_s = if last { f64::INFINITY } else { motion.until_s };
        let mut used = 0;
        for i in 0..n {
            let delay_s = rays.delay_s[i];
            let wanted = requested
                .as_ref()
                .is_none_or(|requested| requested.contains(&delay_s));
            if !wanted || delay_s < since_s || delay_s >= until_s {
                continue;
            }
            chunk.delay_s[used] = delay_s;
            chunk.doppler[used] = received.doppler[i];
            chunk.amplitude[used] = Complex64::ZERO;
            if used < i {
                chunk.move_derivatives(i, used);
            }
            used += 1;
        }
        if used > 0 {
            chunk.len = used;
            sink.accept(chunk);
        }
        if last {
            return;
        }
        since_s = until_s;
    }
}

/// Minimum range at which derivatives are evaluated, metres. Closer scatterers are on the array. Their
/// derivatives are large but finite, and engines count them as beyond their design range.
const TOUCHING_M: f64 = 1e-6;

/// Inputs to the derivatives of a batch's echoes.
struct Derivation<'a> {
    c: f64,
    motion: &'a LineMotion,
    transmit: Motion,
    batch: Batch<'a>,
    closing_m_per_s: &'a [f64],
    rays: &'a Rays,
}

impl Derivation<'_> {
    /// Computes slope, curvature, rate gradient and acceleration of every echo of the batch, as if all arrived
    /// on this leg.
    fn run(&self, doppler: &[f64; CHUNK], chunk: &mut LineChunk) {
        widest(
            #[inline(always)]
            || self.run_plain(doppler, chunk),
        );
    }

    #[inline(always)]
    fn run_plain(&self, doppler: &[f64; CHUNK], chunk: &mut LineChunk) {
        let n = self.batch.range_m.len().min(CHUNK);
        let [tx, ty, tz] = self.batch.transmit_m.map(|axis| &axis[..n]);
        let transmit_m = &self.batch.range_m[..n];
        let transmit_closing = &self.closing_m_per_s[..n];
        let (rx, ry, rz) = (
            &self.rays.x_m[..n],
            &self.rays.y_m[..n],
            &self.rays.z_m[..n],
        );
        let delay_s = &self.rays.delay_s[..n];
        let doppler = &doppler[..n];
        let (slope, curvature) = (&mut chunk.slope[..n], &mut chunk.curvature_per_m[..n]);
        let (rate_gradient, acceleration) = (
            &mut chunk.rate_gradient_per_s[..n],
            &mut chunk.acceleration_m_per_s2[..n],
        );
        let c = self.c;
        let LineMotion {
            start_s,
            axis: a0,
            turning_per_s: turning,
            arc_per_s2: arc,
            length_s,
            velocity_m_per_s: v,
            exact,
            doppler:
                Motion {
                    velocity_m_per_s: w0,
                    acceleration_m_per_s2: dw,
                },
            doppler_along_per_s: along,
            ..
        } = *self.motion;
        let transmit_v2 = self.transmit.velocity_m_per_s.length_squared();
        let transmit_a = self.transmit.acceleration_m_per_s2;
        for i in 0..n {
            let (x, y, z) = (rx[i], ry[i], rz[i]);
            let per_m = 1.0 / (x * x + y * y + z * z).sqrt().max(TOUCHING_M);
            let (x, y, z) = (x * per_m, y * per_m, z * per_m);
            let dot = |a: DVec3| a.x * x + a.y * y + a.z * z;
            let after_s = delay_s[i] - start_s;
            let (wx, wy, wz) = (
                w0.x + dw.x * after_s,
                w0.y + dw.y * after_s,
                w0.z + dw.z * after_s,
            );
            let within = after_s * (length_s - after_s);
            let (ax, ay, az) = (
                a0.x + turning.x * after_s + arc.x * within,
                a0.y + turning.y * after_s + arc.y * within,
                a0.z + turning.z * after_s + arc.z * within,
            );
            let (vx, vy, vz) = if exact { (wx, wy, wz) } else { (v.x, v.y, v.z) };
            let per_s = 1.0 / (c + (vx * x + vy * y + vz * z));
            let u_y = -(ax * x + ay * y + az * z) * per_s;
            let (qx, qy, qz) = (ax + vx * u_y, ay + vy * u_y, az + vz * u_y);
            let s = -c * u_y;
            let closing = wx * x + wy * y + wz * z;
            let per_w = c / (c + closing);
            let stretched = 1.0 / (1.0 + doppler[i]);
            slope[i] = s;
            curvature[i] = ((qx * qx + qy * qy + qz * qz - s * s) * per_m
                - 2.0 * u_y * dot(turning))
                * c
                * per_s;
            rate_gradient[i] = stretched
                * ((wx * qx + wy * qy + wz * qz - closing * s) * per_m - dot(along))
                * per_w;
            let transmit_per_m = 1.0 / transmit_m[i].max(TOUCHING_M);
            let pulled = transmit_a.x * tx[i] + transmit_a.y * ty[i] + transmit_a.z * tz[i];
            acceleration[i] = ((transmit_v2 - transmit_closing[i] * transmit_closing[i] - pulled)
                * transmit_per_m
                + stretched
                    * stretched
                    * ((wx * wx + wy * wy + wz * wz - closing * closing) * per_m - dot(dw)))
                * per_w;
        }
    }
}

//! Ground truth of each sample of a side-scan line: targets by the energy of their echoes, shadow and depth along the ground below the
//! beam's axis. Used for masks, never on the ping path.
//!
//! Echo energy includes both element patterns, the line's array factor, and the scattering law and spreading of every scatterer in the
//! ping, at its two-way range. Absorption and gains are equal for all contributions to a sample. A target counts within the beam's main
//! lobe ([`MAIN_LOBE_DB`]); its side-lobe echoes count as other energy.
//!
//! The ground is traced in the plane normal to the transmitter's axis, through the midpoint between transmission and reception, in steps of
//! half a sample.

use std::borrow::Cow;

use glam::{DQuat, DVec2, DVec3};

use crate::rig::{PingSlot, Rig};
use echotank_config::spec::{LineSpec, SonarSpec};
use echotank_core::arrays::{ArrayGeometry, Mounting};
use echotank_core::frames::Pose;
use echotank_core::ping::{GroundSeen, LineTruth, PingPlan, Side};
use echotank_core::scene::{MovingScatterer, ScatterLaw, Scatterers};
use echotank_imaging::beam::conventional::line_array_response;
use echotank_synthesis::echo::levels::Directivity;

/// Two-way pattern along the track, relative to its centre, above which an echo shows its target.
pub(crate) const MAIN_LOBE_DB: f64 = -12.0;
/// Number of poses stored for a reception window: between two of them a platform moves by millimetres.
const POSES: usize = 128;

/// Poses of the platform during reception.
pub(super) struct Motion {
    poses: Vec<Pose>,
    step_s: f64,
}

impl Motion {
    pub(super) fn of(plan: &PingPlan, rate_hz: f64) -> Self {
        let step_s = plan.window_s(rate_hz) / (POSES - 1) as f64;
        let poses = (0..POSES).map(|k| plan.trajectory.pose_at(k as f64 * step_s));
        Self {
            poses: poses.collect(),
            step_s,
        }
    }
    pub(super) fn at(&self, time_s: f64) -> &Pose {
        &self.poses[self.place(time_s)]
    }
    fn place(&self, time_s: f64) -> usize {
        ((time_s / self.step_s).round().max(0.0) as usize).min(POSES - 1)
    }
}

/// A face (transmitter or element) in world coordinates at one time.
pub(super) struct Face<'a> {
    pub(super) at_m: DVec3,
    array_from_world: DQuat,
    directivity: &'a Directivity,
}

impl<'a> Face<'a> {
    pub(super) fn new(pose: &Pose, mounting: &Mounting, directivity: &'a Directivity) -> Self {
        Self {
            at_m: pose.point_m(mounting.position_m),
            array_from_world: (pose.world_from_body * mounting.body_from_array).inverse(),
            directivity,
        }
    }
    /// Range, direction in face axes, response, and the response for a zero sine along the face.
    pub(super) fn towards(&self, at_m: DVec3) -> (f64, DVec3, f64, f64) {
        let way = at_m - self.at_m;
        let range_m = way.length().max(1e-6);
        let u = self.array_from_world * (way / range_m);
        let middle = self.directivity.towards(0.0, u.y, u.z);
        (range_m, u, self.directivity.towards(u.x, u.y, u.z), middle)
    }
}

/// Ground truth of every line of the last ping that `rig` computed in `slot`.
pub fn line_truths(rig: &Rig, slot: &PingSlot) -> Vec<LineTruth> {
    let plan = &slot.plan;
    let spec = &rig.sonars[plan.sonar].spec;
    let motion = Motion::of(plan, spec.receiver.sample_rate_hz);
    let (scatterers, labels) = labelled_scatterers(rig, plan);
    let lines = spec.beams.lines.iter().zip(&slot.output.lines);
    lines
        .map(|(line, computed)| {
            let mut truth = blank(line.side, computed.amplitude.len());
            let geometry = LineGeometry {
                spec,
                plan,
                motion: &motion,
                line,
            };
            geometry.energies(&scatterers, &labels, &mut truth);
            geometry.ground(rig, &mut truth);
            truth
        })
        .collect()
}

/// Scatterers of the last ping, those that move where the sound found them, with the target number of each.
pub(super) fn labelled_scatterers<'a>(
    rig: &'a Rig,
    plan: &PingPlan,
) -> (Cow<'a, Scatterers>, Vec<u16>) {
    let mut labels = Vec::new();
    let mut scatterers = Cow::Borrowed(rig.scatterers());
    rig.scene.target_of_each(&scatterers, &mut labels);
    if !rig.scatterers().moving.is_empty() {
        let all = scatterers.to_mut();
        // The labels are of these.
        all.truncate_to_scene();
        let from_m = plan.trajectory.pose_at(0.0).position_m;
        let direct = rig.scatterers().moving.iter();
        for moving in direct.filter(|moving| moving.transmit.is_none()) {
            let hit_s = moving.position_m.distance(from_m) / plan.sound_speed_m_per_s;
            let at_m = moving.position_m + moving.velocity_m_per_s * hit_s;
            all.push(at_m, moving.normal, moving.strength, moving.law);
            labels.push(match moving.target {
                MovingScatterer::OF_SURFACE => 0,
                target => u16::try_from(target + 1).unwrap_or(u16::MAX),
            });
        }
    }
    (scatterers, labels)
}

pub(super) fn blank(side: Side, samples: usize) -> LineTruth {
    LineTruth {
        side,
        target: vec![0; samples],
        target_energy: vec![0.0; samples],
        other_energy: vec![0.0; samples],
        ground: vec![GroundSeen::None; samples],
        down_m: vec![f32::NAN; samples],
    }
}

struct LineGeometry<'a> {
    spec: &'a SonarSpec,
    plan: &'a PingPlan,
    motion: &'a Motion,
    line: &'a LineSpec,
}

impl LineGeometry<'_> {
    fn array(&self) -> &ArrayGeometry {
        &self.spec.receive[self.line.array]
    }

    fn energies(&self, scatterers: &Scatterers, labels: &[u16], truth: &mut LineTruth) {
        let (array, c) = (self.array(), self.plan.sound_speed_m_per_s);
        let rate_hz = self.spec.receiver.sample_rate_hz;
        let wavelength_m = c / self.plan.pulse.center_frequency_hz;
        let transmit = &self.spec.transmit[array.transmit];
        let sent = Directivity::new(&transmit.pattern, wavelength_m);
        let received = Directivity::new(&array.element_pattern, wavelength_m);
        let transmitter = Face::new(self.motion.at(0.0), &transmit.mounting, &sent);
        let receivers: Vec<Face> = (self.motion.poses.iter())
            .map(|pose| Face::new(pose, &array.mounting, &received))
            .collect();
        let spacing = array.spacing_m / wavelength_m;
        let lobe = 10f64.powf(MAIN_LOBE_DB / 20.0);
        let half = half_cell(self.plan, rate_hz);
        let samples = truth.target.len();
        let mut own = vec![0.0f32; samples];
        let mut first = 0;
        while first < labels.len() {
            let label = labels[first];
            let end = first + labels[first..].iter().take_while(|l| **l == label).count();
            let mut touched = (usize::MAX, 0);
            for i in first..end {
                let at_m = scatterers.position_m(i);
                let (out_m, u, sent, sent_middle) = transmitter.towards(at_m);
                let receiver = &receivers[self.motion.place(2.0 * out_m / c)];
                let (back_m, w, received, received_middle) = receiver.towards(at_m);
                let factor = line_array_response(array.elements, spacing, w.x);
                let middle = sent_middle * received_middle;
                let law = law_of(scatterers, i, &transmitter, &receiver.at_m);
                let amplitude = sent * received * factor * law / (out_m * back_m);
                let strength = scatterers.strength[i].norm_sqr();
                let energy = (amplitude * amplitude * strength) as f32;
                let k = ((out_m + back_m) / c * rate_hz).round() as usize;
                if k >= samples || energy <= 0.0 || u.z.is_nan() {
                    continue;
                }
                let shown = label != 0 && (sent * received * factor).abs() >= lobe * middle.abs();
                let (from, to) = (k.saturating_sub(half), (k + half + 1).min(samples));
                let part = energy / (to - from) as f32;
                let into = match shown {
                    true => &mut own,
                    false => &mut truth.other_energy,
                };
                into[from..to].iter_mut().for_each(|e| *e += part);
                if shown {
                    touched = (touched.0.min(from), touched.1.max(to));
                }
            }
            let from = touched.0.min(touched.1);
            for (k, energy) in own[from..touched.1].iter_mut().enumerate() {
                truth.claim(from + k, label, std::mem::take(energy));
            }
            first = end;
        }
    }

    fn ground(&self, rig: &Rig, truth: &mut LineTruth) {
        let rate_hz = self.spec.receiver.sample_rate_hz;
        let mut sums = Depths::of(truth.target.len());
        let end_s = truth.target.len() as f64 / rate_hz;
        let trace = (self.spec, self.plan, self.motion);
        trace_ground(
            rig,
            trace,
            self.line.array,
            self.line.side,
            end_s,
            |point| {
                sums.add(truth, (point.two_way_s * rate_hz).round() as usize, point);
            },
        );
        sums.store_depths(truth);
    }
}

/// Half the number of samples, without the middle one, that a compressed echo covers.
pub(super) fn half_cell(plan: &PingPlan, rate_hz: f64) -> usize {
    let resolved_hz = plan.pulse.bandwidth_hz.max(1.0 / plan.pulse.duration_s);
    (0.5 * (rate_hz / resolved_hz - 1.0)).round().max(0.0) as usize
}

/// A ground point with its geometry relative to an array.
pub(super) struct GroundPoint {
    pub(super) at_m: DVec3,
    /// Where the array sees it: see [`Rig::virtual_m`].
    pub(super) seen_m: DVec3,
    pub(super) two_way_s: f64,
    pub(super) seen: bool,
}

/// Depth sums of the ground, by sample.
pub(super) struct Depths(Vec<(f64, u32)>);

impl Depths {
    pub(super) fn of(samples: usize) -> Self {
        Self(vec![(0.0, 0); samples])
    }
    /// Adds a ground point to sample `k`: visibility and depth. Samples beyond the record are ignored.
    pub(super) fn add(&mut self, truth: &mut LineTruth, k: usize, point: &GroundPoint) {
        let Some(sum) = self.0.get_mut(k) else {
            return;
        };
        if point.seen {
            truth.ground[k] = GroundSeen::Seen;
        } else if truth.ground[k] == GroundSeen::None {
            truth.ground[k] = GroundSeen::Hidden;
        }
        *sum = (sum.0 + point.at_m.z, sum.1 + 1);
    }
    pub(super) fn store_depths(self, truth: &mut LineTruth) {
        for (down, sum) in truth.down_m.iter_mut().zip(self.0) {
            if sum.1 > 0 {
                *down = (sum.0 / f64::from(sum.1)) as f32;
            }
        }
    }
}

/// Traces the ground to one side of receive array `array` until its echo arrives after `end_s`. Passes each point to `add`.
pub(super) fn trace_ground(
    rig: &Rig,
    (spec, plan, motion): (&SonarSpec, &PingPlan, &Motion),
    array: usize,
    side: Side,
    end_s: f64,
    mut add: impl FnMut(&GroundPoint),
) {
    let c = plan.sound_speed_m_per_s;
    let receive = &spec.receive[array].mounting;
    let transmit = &spec.transmit[spec.receive[array].transmit].mounting;
    let start = motion.at(0.0);
    let transmitter_m = start.point_m(transmit.position_m);
    let mut along = start.world_from_body * (transmit.body_from_array * DVec3::X);
    if along.dot(start.world_from_body * DVec3::X) < 0.0 {
        along = -along;
    }
    let level = along.truncate();
    let Some(ahead) = level.try_normalize() else {
        return;
    };
    let sideways = match side {
        Side::Starboard => DVec2::new(-ahead.y, ahead.x),
        Side::Port => DVec2::new(ahead.y, -ahead.x),
    };
    let step_m = 0.25 * c / spec.receiver.sample_rate_hz;
    let Some(mut down_m) = rig.scene.seabed_down_m(transmitter_m.x, transmitter_m.y) else {
        return;
    };
    let mut two_way_m = 2.0 * (down_m - transmitter_m.z).max(0.0);
    let mut across_m = 0.0;
    let fastest = plan.refraction.as_ref();
    let fastest = fastest.map_or(c, |water| water.profile.range_m_per_s().1);
    while across_m < 0.5 * end_s * fastest {
        across_m += step_m;
        let receiver_m = motion.at(two_way_m / c).point_m(receive.position_m);
        let midpoint_m = 0.5 * (transmitter_m + receiver_m);
        // Two iterations: the position depends weakly on the depth.
        let mut seen = None;
        let mut at = DVec2::ZERO;
        for _ in 0..2 {
            let ahead_m = -(down_m - midpoint_m.z) * along.z / level.length();
            at = midpoint_m.truncate() + sideways * across_m + ahead * ahead_m;
            seen = rig.scene.ground_seen(array, at.x, at.y);
            if let Some((there_m, _)) = seen {
                down_m = there_m;
            }
        }
        let Some((there_m, seen)) = seen else {
            continue;
        };
        let at_m = at.extend(there_m);
        let Some(seen_m) = rig.virtual_m(plan, at_m) else {
            continue;
        };
        two_way_m = seen_m.distance(transmitter_m) + seen_m.distance(receiver_m);
        add(&GroundPoint {
            at_m,
            seen_m,
            two_way_s: two_way_m / c,
            seen,
        });
    }
}

/// Pressure factor of the scattering law of scatterer `i` from transmitter to receiver.
pub(super) fn law_of(
    scatterers: &Scatterers,
    i: usize,
    transmitter: &Face,
    receiver_m: &DVec3,
) -> f64 {
    let at_m = scatterers.position_m(i);
    let normal = DVec3::from_array(scatterers.normal[i].map(f64::from));
    let cosine = |from_m: DVec3| ((from_m - at_m).normalize_or_zero().dot(normal)).max(0.0);
    let (incoming, outgoing) = (cosine(transmitter.at_m), cosine(*receiver_m));
    match scatterers.law[i] {
        ScatterLaw::Point | ScatterLaw::Water => 1.0,
        ScatterLaw::Lambert => (incoming * outgoing).sqrt(),
        ScatterLaw::LambertOneWay => incoming,
        ScatterLaw::Curve => scatterers.curve.as_ref().map_or(0.0, |curve| {
            curve.half(incoming.sqrt()) * curve.half(outgoing.sqrt())
        }),
    }
}

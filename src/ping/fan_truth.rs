//! Ground truth of each sample of each beam of a fan: as [`line_truth`](super::line_truth), beam by beam. Used for masks, never on the ping
//! path.
//!
//! Echo energy includes both element patterns, the beam's array factor with the fan's shading (far field), and the scattering law and
//! spreading of every scatterer in the ping. A target counts within the main lobe of transmitter and beam together ([`MAIN_LOBE_DB`]). The
//! ground is that of the plane normal to the transmitter's axis. Each ground point belongs to the nearest beam.

use std::f64::consts::TAU;

use glam::DVec3;

use super::line_truth::{
    Depths, Face, MAIN_LOBE_DB, Motion, blank, half_cell, labelled_scatterers, law_of, trace_ground,
};
use crate::rig::{PingSlot, Rig};
use echotank_config::spec::{FanSpec, SonarSpec};
use echotank_core::arrays::ArrayGeometry;
use echotank_core::ping::{BeamFrame, LineTruth, Side};
use echotank_core::scene::Scatterers;
use echotank_imaging::beam::weights;
use echotank_imaging::image::water_column::beam_at;
use echotank_synthesis::echo::levels::Directivity;

/// Beams that receive less than this share of an echo's energy are omitted.
const MIN_SHARE: f64 = 1e-8;
/// Number of table entries of the array factor per period.
const FACTOR_STEPS: usize = 8192;

/// Returns one truth per beam of the fan for the last ping that `rig` computed in `slot`, sample for sample with the beams. Empty without a
/// fan.
pub fn fan_truth(rig: &Rig, slot: &PingSlot) -> Vec<LineTruth> {
    let spec = &rig.sonars[slot.plan.sonar].spec;
    let (Some(fan), Some(beams)) = (&spec.beams.fan, slot.output.beams.first()) else {
        return Vec::new();
    };
    let side = |angle: &f64| match *angle < 0.0 {
        true => Side::Port,
        false => Side::Starboard,
    };
    let angles = beams.angle_rad.iter();
    let mut truths: Vec<LineTruth> = angles.map(|a| blank(side(a), beams.samples)).collect();
    let geometry = FanGeometry {
        spec,
        slot,
        fan,
        beams,
        motion: Motion::of(&slot.plan, spec.receiver.sample_rate_hz),
    };
    let (scatterers, labels) = labelled_scatterers(rig, &slot.plan);
    geometry.energies(&scatterers, &labels, &mut truths);
    geometry.ground(rig, &mut truths);
    truths
}

struct FanGeometry<'a> {
    spec: &'a SonarSpec,
    slot: &'a PingSlot,
    fan: &'a FanSpec,
    beams: &'a BeamFrame,
    motion: Motion,
}

/// |sum_e w_e exp(j 2pi e d s)|^2 for the sine offset s, tabulated over one period; of an arc, of a whole aperture by the angle from the beam.
struct ArrayFactor {
    /// Spacing of a line, wavelengths; `None` for an arc, whose table is by angle from the beam over a full turn.
    spacing: Option<f64>,
    power: Vec<f64>,
}

impl ArrayFactor {
    fn new(fan: &FanSpec, array: &ArrayGeometry, wavelength_m: f64) -> Self {
        let elements = match array.radius_m {
            None => array.elements,
            // Those of a whole aperture.
            Some(radius_m) => (fan.form.aperture_rad * radius_m / array.spacing_m) as usize + 1,
        };
        let mut weights = vec![0.0; elements];
        weights::fill(fan.shading, &mut weights);
        let sum: f64 = weights.iter().sum();
        let phase_rad = |turn: f64, e: usize| match array.radius_m {
            None => turn * e as f64,
            Some(radius_m) => {
                let normal = (e as f64 - 0.5 * (elements - 1) as f64) * array.spacing_m / radius_m;
                let late_m = radius_m * ((normal - turn).cos() - normal.cos());
                TAU * late_m / wavelength_m
            }
        };
        let power = (0..FACTOR_STEPS).map(|i| {
            let turn = TAU * i as f64 / FACTOR_STEPS as f64;
            let parts = weights.iter().enumerate().map(|(e, w)| {
                let (sin, cos) = phase_rad(turn, e).sin_cos();
                (w * cos, w * sin)
            });
            let (re, im) = parts.fold((0.0, 0.0), |a, b| (a.0 + b.0, a.1 + b.1));
            (re * re + im * im) / (sum * sum)
        });
        Self {
            spacing: match array.radius_m {
                None => Some(array.spacing_m / wavelength_m),
                Some(_) => None,
            },
            power: power.collect(),
        }
    }

    /// Power of a beam for an echo from `direction` in array axes.
    fn power(&self, direction: DVec3, beam_sine: f64) -> f64 {
        let turns = match self.spacing {
            Some(spacing) => spacing * (direction.x - beam_sine),
            None => (direction.x.atan2(direction.z) - beam_sine.asin()) / TAU,
        };
        let position = turns.rem_euclid(1.0) * FACTOR_STEPS as f64;
        self.power[position.round() as usize % FACTOR_STEPS]
    }
}

impl FanGeometry<'_> {
    fn first_s(&self) -> f64 {
        self.slot.plan.first_sample_s
    }

    /// Sine of every beam towards the array's +x.
    fn sines(&self) -> Vec<f64> {
        let towards_x = self.towards_x();
        let angles = self.beams.angle_rad.iter();
        angles.map(|angle| towards_x * angle.sin()).collect()
    }

    /// Angles are positive to starboard, whichever way the array's x axis points.
    fn towards_x(&self) -> f64 {
        let x_in_body = self.spec.receive[self.fan.array].mounting.body_from_array * DVec3::X;
        if x_in_body.y < -1e-9 { -1.0 } else { 1.0 }
    }

    fn energies(&self, scatterers: &Scatterers, labels: &[u16], truths: &mut [LineTruth]) {
        let (plan, samples) = (&self.slot.plan, self.beams.samples);
        let (c, rate_hz) = (plan.sound_speed_m_per_s, self.spec.receiver.sample_rate_hz);
        let array = &self.spec.receive[self.fan.array];
        let wavelength_m = c / plan.pulse.center_frequency_hz;
        let transmit = &self.spec.transmit[array.transmit];
        let sent = Directivity::new(&transmit.pattern, wavelength_m);
        let received = Directivity::new(&array.element_pattern, wavelength_m);
        let transmitter = Face::new(self.motion.at(0.0), &transmit.mounting, &sent);
        let factor = ArrayFactor::new(self.fan, array, wavelength_m);
        let lobe = 10f64.powf(MAIN_LOBE_DB / 10.0);
        let half = half_cell(plan, rate_hz);
        let sines = self.sines();
        // Energy of the current target in each beam.
        let mut own = vec![0.0f32; samples * sines.len()];
        let mut first = 0;
        while first < labels.len() {
            let label = labels[first];
            let end = first + labels[first..].iter().take_while(|l| **l == label).count();
            let mut touched = (samples, 0);
            for i in first..end {
                let at_m = scatterers.position_m(i);
                let (out_m, _, sent, sent_middle) = transmitter.towards(at_m);
                let pose = self.motion.at(2.0 * out_m / c);
                let receiver = Face::new(pose, &array.mounting, &received);
                let (back_m, w, received, received_middle) = receiver.towards(at_m);
                // The elements in use on an arc look along their beam.
                let received = match array.radius_m {
                    None => received,
                    Some(_) => received_middle,
                };
                let law = law_of(scatterers, i, &transmitter, &receiver.at_m);
                let amplitude = sent * received * law / (out_m * back_m);
                let energy = amplitude * amplitude * scatterers.strength[i].norm_sqr();
                let k = (((out_m + back_m) / c - self.first_s()) * rate_hz).round();
                if !(0.0..samples as f64).contains(&k) || energy.is_nan() || energy <= 0.0 {
                    continue;
                }
                let k = k as usize;
                let (from, to) = (k.saturating_sub(half), (k + half + 1).min(samples));
                let sent_share = (sent / sent_middle).powi(2);
                for (b, sine) in sines.iter().enumerate() {
                    let share = factor.power(w, *sine);
                    if share < MIN_SHARE {
                        continue;
                    }
                    let part = (energy * share) as f32 / (to - from) as f32;
                    let shown = label != 0 && sent_share * share >= lobe;
                    let into = match shown {
                        true => &mut own[b * samples..][from..to],
                        false => &mut truths[b].other_energy[from..to],
                    };
                    into.iter_mut().for_each(|e| *e += part);
                    if shown {
                        touched = (touched.0.min(from), touched.1.max(to));
                    }
                }
            }
            for (truth, own) in truths.iter_mut().zip(own.chunks_exact_mut(samples)) {
                let from = touched.0.min(touched.1);
                for (k, energy) in (from..).zip(&mut own[from..touched.1]) {
                    truth.claim(k, label, std::mem::take(energy));
                }
            }
            first = end;
        }
    }

    fn ground(&self, rig: &Rig, truths: &mut [LineTruth]) {
        let (plan, samples) = (&self.slot.plan, self.beams.samples);
        let rate_hz = self.spec.receiver.sample_rate_hz;
        let mounting = &self.spec.receive[self.fan.array].mounting;
        let towards_x = self.towards_x();
        let mut depths: Vec<Depths> = truths.iter().map(|_| Depths::of(samples)).collect();
        let end_s = self.first_s() + samples as f64 / rate_hz;
        let trace = (self.spec, plan, &self.motion);
        for side in [Side::Port, Side::Starboard] {
            trace_ground(rig, trace, self.fan.array, side, end_s, |point| {
                let pose = self.motion.at(point.two_way_s);
                let way = point.seen_m - pose.point_m(mounting.position_m);
                let line = pose.world_from_body * (mounting.body_from_array * DVec3::X);
                let sine = towards_x * way.normalize_or_zero().dot(line);
                let k = ((point.two_way_s - self.first_s()) * rate_hz).round();
                let beam = beam_at(&self.beams.angle_rad, sine.clamp(-1.0, 1.0).asin());
                if let Some(b) = beam.filter(|_| k >= 0.0) {
                    depths[b].add(&mut truths[b], k as usize, point);
                }
            });
        }
        for (truth, depths) in truths.iter_mut().zip(depths) {
            depths.store_depths(truth);
        }
    }
}

//! What each sample of each beam of a fan shows, by the scene's own knowledge: as [`line_truth`](super::line_truth), beam by beam. For masks; never
//! on the ping path.
//!
//! Echo energy: both patterns, the beam's array factor with the fan's shading (far field), the law of scattering and spreading of every scatterer
//! that the ping heard. A target counts as far as the main lobe of transmitter and beam together reaches ([`MAIN_LOBE_DB`]). The ground is that of
//! the plane square to the transmitter; a beam has what of it lies nearer to its axis than to its neighbours'.

use glam::DVec3;

use super::line_truth::{
    Depths, Face, MAIN_LOBE_DB, Motion, blank, half_cell, law_of, walk_ground,
};
use crate::rig::{PingSlot, Rig};
use echotank_config::spec::{FanSpec, SonarSpec};
use echotank_core::flow::{BeamFrame, LineTruth, Scatterers, Side};
use echotank_imaging::beam::weights;
use echotank_imaging::image::water_column::beam_at;
use echotank_synthesis::echo::levels::Directivity;

/// Beams that hear less than this of an echo's energy are left out.
const MIN_SHARE: f64 = 1e-8;
/// Steps of the table of the array factor in one period of it.
const FACTOR_STEPS: usize = 8192;

/// One truth for each beam of the fan of the ping that `rig` made last in `slot`, sample for sample with the beams. Empty without a fan.
pub fn fan_truth(rig: &Rig, slot: &PingSlot) -> Vec<LineTruth> {
    let spec = &rig.sonars[slot.plan.sonar].spec;
    let (Some(fan), Some(made)) = (&spec.beams.fan, slot.output.beams.first()) else {
        return Vec::new();
    };
    let side = |angle: &f64| match *angle < 0.0 {
        true => Side::Port,
        false => Side::Starboard,
    };
    let angles = made.angle_rad.iter();
    let mut truths: Vec<LineTruth> = angles.map(|a| blank(side(a), made.samples)).collect();
    let view = View {
        spec,
        slot,
        fan,
        made,
        motion: Motion::of(&slot.plan, spec.receiver.sample_rate_hz),
    };
    let mut labels = Vec::new();
    rig.scene.target_of_each(rig.scatterers(), &mut labels);
    view.energies(rig.scatterers(), &labels, &mut truths);
    view.ground(rig, &mut truths);
    truths
}

struct View<'a> {
    spec: &'a SonarSpec,
    slot: &'a PingSlot,
    fan: &'a FanSpec,
    made: &'a BeamFrame,
    motion: Motion,
}

/// |sum_e w_e exp(j 2pi e d s)|^2, s the sine's offset: tabulated over one period.
struct Factor {
    spacing: f64,
    power: Vec<f64>,
}

impl Factor {
    fn new(fan: &FanSpec, elements: usize, spacing_wavelengths: f64) -> Self {
        let mut weights = vec![0.0; elements];
        weights::fill(fan.shading, &mut weights);
        let sum: f64 = weights.iter().sum();
        let power = (0..FACTOR_STEPS).map(|i| {
            let turn = std::f64::consts::TAU * i as f64 / FACTOR_STEPS as f64;
            let parts = weights.iter().enumerate().map(|(e, w)| {
                let (sin, cos) = (turn * e as f64).sin_cos();
                (w * cos, w * sin)
            });
            let (re, im) = parts.fold((0.0, 0.0), |a, b| (a.0 + b.0, a.1 + b.1));
            (re * re + im * im) / (sum * sum)
        });
        Self {
            spacing: spacing_wavelengths,
            power: power.collect(),
        }
    }

    fn power(&self, sine: f64) -> f64 {
        let place = (self.spacing * sine).rem_euclid(1.0) * FACTOR_STEPS as f64;
        self.power[place.round() as usize % FACTOR_STEPS]
    }
}

impl View<'_> {
    fn first_s(&self) -> f64 {
        self.slot.plan.first_sample_s
    }

    /// Of every beam, towards the array's +x.
    fn sines(&self) -> Vec<f64> {
        let towards_x = self.towards_x();
        let angles = self.made.angle_rad.iter();
        angles.map(|angle| towards_x * angle.sin()).collect()
    }

    /// Angles count to starboard whichever way the array's x points.
    fn towards_x(&self) -> f64 {
        let x_in_body = self.spec.receive[self.fan.array].mounting.body_from_array * DVec3::X;
        if x_in_body.y < -1e-9 { -1.0 } else { 1.0 }
    }

    fn energies(&self, scatterers: &Scatterers, labels: &[u16], truths: &mut [LineTruth]) {
        let (plan, samples) = (&self.slot.plan, self.made.samples);
        let (c, rate_hz) = (plan.sound_speed_m_per_s, self.spec.receiver.sample_rate_hz);
        let array = &self.spec.receive[self.fan.array];
        let wavelength_m = c / plan.pulse.center_frequency_hz;
        let transmit = &self.spec.transmit[array.transmit];
        let sent = Directivity::new(&transmit.pattern, wavelength_m);
        let heard = Directivity::new(&array.element_pattern, wavelength_m);
        let sender = Face::new(self.motion.at(0.0), &transmit.mounting, &sent);
        let factor = Factor::new(self.fan, array.elements, array.spacing_m / wavelength_m);
        let lobe = 10f64.powf(MAIN_LOBE_DB / 10.0);
        let half = half_cell(plan, rate_hz);
        let sines = self.sines();
        // Of the target at hand, beam by beam.
        let mut own = vec![0.0f32; samples * sines.len()];
        let mut first = 0;
        while first < labels.len() {
            let label = labels[first];
            let end = first + labels[first..].iter().take_while(|l| **l == label).count();
            let mut touched = (samples, 0);
            for i in first..end {
                let at_m = scatterers.position_m(i);
                let (out_m, _, sent, sent_middle) = sender.towards(at_m);
                let pose = self.motion.at(2.0 * out_m / c);
                let hearer = Face::new(pose, &array.mounting, &heard);
                let (back_m, w, heard, _) = hearer.towards(at_m);
                let law = law_of(scatterers, i, &sender, &hearer.at_m);
                let amplitude = sent * heard * law / (out_m * back_m);
                let energy = amplitude * amplitude * scatterers.strength[i].norm_sqr();
                let k = (((out_m + back_m) / c - self.first_s()) * rate_hz).round();
                if !(0.0..samples as f64).contains(&k) || energy.is_nan() || energy <= 0.0 {
                    continue;
                }
                let k = k as usize;
                let (from, to) = (k.saturating_sub(half), (k + half + 1).min(samples));
                let sent_share = (sent / sent_middle).powi(2);
                for (b, sine) in sines.iter().enumerate() {
                    let share = factor.power(w.x - sine);
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
        let (plan, samples) = (&self.slot.plan, self.made.samples);
        let rate_hz = self.spec.receiver.sample_rate_hz;
        let mounting = &self.spec.receive[self.fan.array].mounting;
        let towards_x = self.towards_x();
        let mut depths: Vec<Depths> = truths.iter().map(|_| Depths::of(samples)).collect();
        let end_s = self.first_s() + samples as f64 / rate_hz;
        let walk = (self.spec, plan, &self.motion);
        for side in [Side::Port, Side::Starboard] {
            walk_ground(rig, walk, self.fan.array, side, end_s, |met| {
                let pose = self.motion.at(met.two_way_s);
                let way = met.at_m - pose.point_m(mounting.position_m);
                let line = pose.world_from_body * (mounting.body_from_array * DVec3::X);
                let sine = towards_x * way.normalize_or_zero().dot(line);
                let k = ((met.two_way_s - self.first_s()) * rate_hz).round();
                let beam = beam_at(&self.made.angle_rad, sine.clamp(-1.0, 1.0).asin());
                if let Some(b) = beam.filter(|_| k >= 0.0) {
                    depths[b].meet(&mut truths[b], k as usize, met);
                }
            });
        }
        for (truth, depths) in truths.iter_mut().zip(depths) {
            depths.keep(truth);
        }
    }
}

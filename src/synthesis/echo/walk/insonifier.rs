//! Transmit leg of all scatterers, computed in parallel parts.
//!
//! Each part moves the scatterers that it keeps to its front. The parts are then joined, so the
//! order is that of the scatterers for any number of threads.

use super::*;
use echotank_core::ping::RangeFloors;

/// Number of scatterers of one task.
const PART: usize = 32 * CHUNK;

/// Output slices of one part, as long as its scatterers.
struct LegSlices<'a> {
    /// Position, range, level and closing speed.
    doubles: [&'a mut [f64]; 6],
    /// Transmit point and half path, empty where no legs differ.
    images: [&'a mut [f64]; 4],
    /// Bias and normal.
    singles: [&'a mut [f32]; 4],
    amplitude: &'a mut [Complex64],
    curved: &'a mut [bool],
}

impl<'a> LegSlices<'a> {
    fn of(leg: &'a mut TransmitLeg) -> Self {
        let [x_m, y_m, z_m] = &mut leg.transmit_m;
        Self {
            images: [x_m, y_m, z_m, &mut leg.half_path_m],
            doubles: [
                &mut leg.x_m,
                &mut leg.y_m,
                &mut leg.z_m,
                &mut leg.range_m,
                &mut leg.level,
                &mut leg.closing_m_per_s,
            ],
            singles: [
                &mut leg.bias,
                &mut leg.normal_x,
                &mut leg.normal_y,
                &mut leg.normal_z,
            ],
            amplitude: &mut leg.amplitude,
            curved: &mut leg.curved,
        }
    }

    fn split(&mut self, at: usize) -> (LegSlices<'_>, LegSlices<'_>) {
        let (doubles, high_doubles) = halves(&mut self.doubles, at);
        let (singles, high_singles) = halves(&mut self.singles, at);
        let (images, high_images) = halves(&mut self.images, at);
        let (amplitude, high_amplitude) = self.amplitude.split_at_mut(at);
        let (curved, high_curved) = self.curved.split_at_mut(at);
        let low = LegSlices {
            doubles,
            images,
            singles,
            amplitude,
            curved,
        };
        let high = LegSlices {
            doubles: high_doubles,
            images: high_images,
            singles: high_singles,
            amplitude: high_amplitude,
            curved: high_curved,
        };
        (low, high)
    }

    fn move_to(&mut self, from: std::ops::Range<usize>, to: usize) {
        let Self {
            doubles,
            images,
            singles,
            amplitude,
            curved,
        } = self;
        let all = || from.clone();
        // About half of the bytes each.
        rayon::join(
            || {
                for values in doubles {
                    values.copy_within(all(), to);
                }
            },
            || {
                for values in images.iter_mut().filter(|values| !values.is_empty()) {
                    values.copy_within(all(), to);
                }
                for values in singles {
                    values.copy_within(all(), to);
                }
                amplitude.copy_within(all(), to);
                curved.copy_within(all(), to);
            },
        );
    }
}

/// The slices before `at` and from `at` on; empty ones stay empty.
fn halves<'a, T, const N: usize>(
    slices: &'a mut [&mut [T]; N],
    at: usize,
) -> ([&'a mut [T]; N], [&'a mut [T]; N]) {
    let mut parts = slices
        .each_mut()
        .map(|values| values.split_at_mut(at.min(values.len())));
    (
        parts.each_mut().map(|part| std::mem::take(&mut part.0)),
        parts.each_mut().map(|part| std::mem::take(&mut part.1)),
    )
}

/// Insonification of a scene: geometry and culling limits.
pub(super) struct Insonifier<'a> {
    pub leg: TransmitLegTerms<'a>,
    pub scatterers: &'a Scatterers,
    pub floor: f64,
    pub range_floors: &'a RangeFloors,
    pub farthest_m: f64,
}

impl Insonifier<'_> {
    /// Fills `transmit_leg` and truncates it to the scatterers that are kept.
    pub(crate) fn insonify_all(&self, transmit_leg: &mut TransmitLeg) -> EchoCounts {
        let images = !self.scatterers.transmit.is_empty();
        transmit_leg.resize(self.scatterers.len(), images);
        let (kept, counts) = self.part(0, &mut LegSlices::of(transmit_leg));
        transmit_leg.resize(kept, images);
        counts
    }

    /// Processes scatterers from index `first`, as many as `slots` has room for. Returns the number
    /// of scatterers that are kept.
    fn part(&self, first: usize, slots: &mut LegSlices) -> (usize, EchoCounts) {
        let len = slots.curved.len();
        if len <= PART {
            return self.batches(first, slots);
        }
        let middle = (len / 2).next_multiple_of(CHUNK);
        let (mut low, mut high) = slots.split(middle);
        let ((kept, mut counts), (more, others)) = rayon::join(
            || self.part(first, &mut low),
            || self.part(first + middle, &mut high),
        );
        counts += others;
        if kept < middle {
            slots.move_to(middle..middle + more, kept);
        }
        (kept + more, counts)
    }

    fn batches(&self, first: usize, slots: &mut LegSlices) -> (usize, EchoCounts) {
        let mut counts = EchoCounts::default();
        let mut batch = TransmitBatch::default();
        let mut kept = 0;
        let end = first + slots.curved.len();
        for first in (first..end).step_by(CHUNK) {
            let n = CHUNK.min(end - first);
            widest(
                #[inline(always)]
                || compute_transmit_leg(&self.leg, self.scatterers, first, n, &mut batch),
            );
            for j in 0..n {
                kept += usize::from(self.store(first + j, j, &batch, kept, slots, &mut counts));
            }
        }
        (kept, counts)
    }

    /// Stores scatterer `i`, number `j` of its batch, in slot `to`. Returns false if it is culled.
    #[inline(always)]
    fn store(
        &self,
        i: usize,
        j: usize,
        batch: &TransmitBatch,
        to: usize,
        slots: &mut LegSlices,
        counts: &mut EchoCounts,
    ) -> bool {
        let scatterers = self.scatterers;
        let range_m = batch.range_m[j];
        if range_m > self.farthest_m || range_m.is_nan() {
            counts.outside_window += 1;
            return false;
        }
        let facing = batch.facing[j].max(0.0);
        // Where the legs differ, the position is that of the receive leg.
        let images = !slots.images[0].is_empty();
        let position_m = |i: usize| self.leg.transmit.relative_m(scatterers.position_m(i));
        let receive_m = if images { position_m(i) } else { DVec3::ZERO };
        let half_path_m = 0.5 * (range_m + receive_m.length());
        if images && (half_path_m > self.farthest_m || half_path_m.is_nan()) {
            counts.outside_window += 1;
            return false;
        }
        // Behind the baffle.
        if batch.amplitude[j] == 0.0 {
            counts.culled += 1;
            return false;
        }
        let (law, bias, normal) = match scatterers.law[i] {
            ScatterLaw::Point | ScatterLaw::Water => (1.0, 1.0, [0.0; 3]),
            ScatterLaw::Lambert => (facing.sqrt(), 0.0, scatterers.normal[i]),
            ScatterLaw::LambertOneWay => (facing, 1.0, [0.0; 3]),
            ScatterLaw::Curve => {
                let curve = scatterers.curve.as_deref();
                (
                    one_leg_of_curve(curve, facing.sqrt()),
                    0.0,
                    scatterers.normal[i],
                )
            }
        };
        let amplitude = scatterers.strength[i] * (batch.amplitude[j] * law);
        let mut level = batch.level[j] * f64::from(scatterers.loud[i]);
        if self.floor > 0.0 {
            // All further comparisons are with the floor of the model.
            let range_m = if images { half_path_m } else { range_m };
            level *= self.floor / self.range_floors.at(self.floor, range_m);
        }
        if level < self.floor || amplitude == Complex64::ZERO {
            counts.culled += 1;
            return false;
        }
        counts.too_close += u64::from(range_m < self.leg.one_way.wavelength_m);
        let [x_m, y_m, z_m, to_range_m, to_level, closing] = &mut slots.doubles;
        (x_m[to], y_m[to], z_m[to]) = (batch.x_m[j], batch.y_m[j], batch.z_m[j]);
        if images {
            let [from_x_m, from_y_m, from_z_m, to_half_path_m] = &mut slots.images;
            (from_x_m[to], from_y_m[to], from_z_m[to]) = (x_m[to], y_m[to], z_m[to]);
            (x_m[to], y_m[to], z_m[to]) = receive_m.into();
            to_half_path_m[to] = half_path_m;
        }
        (to_range_m[to], to_level[to]) = (range_m, level);
        closing[to] = batch.closing_m_per_s[j];
        let [to_bias, x, y, z] = &mut slots.singles;
        to_bias[to] = bias;
        (x[to], y[to], z[to]) = normal.into();
        slots.amplitude[to] = amplitude;
        slots.curved[to] = scatterers.law[i] == ScatterLaw::Curve;
        true
    }
}

//! The transmit leg of all scatterers, computed in parallel parts.
//!
//! Each part packs the scatterers it keeps to its front. Neighbouring parts are then moved
//! together, so the order is that of the scatterers for any thread count.

use super::*;

/// Scatterers that one task processes.
const PART: usize = 32 * CHUNK;

/// Output slices of one part, as long as its scatterers.
struct LegSlices<'a> {
    x_m: &'a mut [f64],
    y_m: &'a mut [f64],
    z_m: &'a mut [f64],
    range_m: &'a mut [f64],
    amplitude: &'a mut [Complex64],
    level: &'a mut [f64],
    bias: &'a mut [f32],
    curved: &'a mut [bool],
    normal_x: &'a mut [f32],
    normal_y: &'a mut [f32],
    normal_z: &'a mut [f32],
    closing_m_per_s: &'a mut [f64],
}

impl<'a> LegSlices<'a> {
    fn of(transmit_leg: &'a mut TransmitLeg, len: usize) -> Self {
        transmit_leg.x_m.resize(len, 0.0);
        transmit_leg.y_m.resize(len, 0.0);
        transmit_leg.z_m.resize(len, 0.0);
        transmit_leg.range_m.resize(len, 0.0);
        transmit_leg.amplitude.resize(len, Complex64::ZERO);
        transmit_leg.level.resize(len, 0.0);
        transmit_leg.bias.resize(len, 0.0);
        transmit_leg.curved.resize(len, false);
        transmit_leg.normal_x.resize(len, 0.0);
        transmit_leg.normal_y.resize(len, 0.0);
        transmit_leg.normal_z.resize(len, 0.0);
        transmit_leg.closing_m_per_s.resize(len, 0.0);
        Self {
            x_m: &mut transmit_leg.x_m,
            y_m: &mut transmit_leg.y_m,
            z_m: &mut transmit_leg.z_m,
            range_m: &mut transmit_leg.range_m,
            amplitude: &mut transmit_leg.amplitude,
            level: &mut transmit_leg.level,
            bias: &mut transmit_leg.bias,
            curved: &mut transmit_leg.curved,
            normal_x: &mut transmit_leg.normal_x,
            normal_y: &mut transmit_leg.normal_y,
            normal_z: &mut transmit_leg.normal_z,
            closing_m_per_s: &mut transmit_leg.closing_m_per_s,
        }
    }

    fn split(&mut self, at: usize) -> (LegSlices<'_>, LegSlices<'_>) {
        let x_m = self.x_m.split_at_mut(at);
        let y_m = self.y_m.split_at_mut(at);
        let z_m = self.z_m.split_at_mut(at);
        let range_m = self.range_m.split_at_mut(at);
        let amplitude = self.amplitude.split_at_mut(at);
        let level = self.level.split_at_mut(at);
        let bias = self.bias.split_at_mut(at);
        let curved = self.curved.split_at_mut(at);
        let normal_x = self.normal_x.split_at_mut(at);
        let normal_y = self.normal_y.split_at_mut(at);
        let normal_z = self.normal_z.split_at_mut(at);
        let closing = self.closing_m_per_s.split_at_mut(at);
        let low = LegSlices {
            x_m: x_m.0,
            y_m: y_m.0,
            z_m: z_m.0,
            range_m: range_m.0,
            amplitude: amplitude.0,
            level: level.0,
            bias: bias.0,
            curved: curved.0,
            normal_x: normal_x.0,
            normal_y: normal_y.0,
            normal_z: normal_z.0,
            closing_m_per_s: closing.0,
        };
        let high = LegSlices {
            x_m: x_m.1,
            y_m: y_m.1,
            z_m: z_m.1,
            range_m: range_m.1,
            amplitude: amplitude.1,
            level: level.1,
            bias: bias.1,
            curved: curved.1,
            normal_x: normal_x.1,
            normal_y: normal_y.1,
            normal_z: normal_z.1,
            closing_m_per_s: closing.1,
        };
        (low, high)
    }

    fn move_to(&mut self, from: std::ops::Range<usize>, to: usize) {
        self.x_m.copy_within(from.clone(), to);
        self.y_m.copy_within(from.clone(), to);
        self.z_m.copy_within(from.clone(), to);
        self.range_m.copy_within(from.clone(), to);
        self.amplitude.copy_within(from.clone(), to);
        self.level.copy_within(from.clone(), to);
        self.bias.copy_within(from.clone(), to);
        self.curved.copy_within(from.clone(), to);
        self.normal_x.copy_within(from.clone(), to);
        self.normal_y.copy_within(from.clone(), to);
        self.normal_z.copy_within(from.clone(), to);
        self.closing_m_per_s.copy_within(from, to);
    }
}

/// Insonification of a scene: geometry and culling limits.
pub(super) struct Insonifier<'a> {
    pub leg: TransmitLegTerms<'a>,
    pub scatterers: &'a Scatterers,
    pub floor: f64,
    pub farthest_m: f64,
}

impl Insonifier<'_> {
    /// Fills `transmit_leg` and truncates it to the scatterers that are kept.
    pub(crate) fn insonify_all(&self, transmit_leg: &mut TransmitLeg) -> EchoCounts {
        let mut slots = LegSlices::of(transmit_leg, self.scatterers.len());
        let (kept, counts) = self.part(0, &mut slots);
        transmit_leg.x_m.truncate(kept);
        transmit_leg.y_m.truncate(kept);
        transmit_leg.z_m.truncate(kept);
        transmit_leg.range_m.truncate(kept);
        transmit_leg.amplitude.truncate(kept);
        transmit_leg.level.truncate(kept);
        transmit_leg.bias.truncate(kept);
        transmit_leg.curved.truncate(kept);
        transmit_leg.normal_x.truncate(kept);
        transmit_leg.normal_y.truncate(kept);
        transmit_leg.normal_z.truncate(kept);
        transmit_leg.closing_m_per_s.truncate(kept);
        counts
    }

    /// Processes scatterers from `first` on, as many as `slots` holds. Returns how many are kept.
    fn part(&self, first: usize, slots: &mut LegSlices) -> (usize, EchoCounts) {
        let len = slots.x_m.len();
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
        let end = first + slots.x_m.len();
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

    /// Stores scatterer `i`, the `j`-th of its batch, in slot `to`. Returns false if it is culled.
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
        let (law, bias, normal) = match scatterers.law[i] {
            ScatterLaw::Point => (1.0, 1.0, [0.0; 3]),
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
        let level = batch.level[j] * f64::from(scatterers.loud[i]);
        if level < self.floor || amplitude == Complex64::ZERO {
            counts.culled += 1;
            return false;
        }
        counts.too_close += u64::from(range_m < self.leg.one_way.wavelength_m);
        slots.x_m[to] = batch.x_m[j];
        slots.y_m[to] = batch.y_m[j];
        slots.z_m[to] = batch.z_m[j];
        slots.range_m[to] = range_m;
        slots.amplitude[to] = amplitude;
        slots.level[to] = level;
        slots.bias[to] = bias;
        slots.curved[to] = scatterers.law[i] == ScatterLaw::Curve;
        slots.normal_x[to] = normal[0];
        slots.normal_y[to] = normal[1];
        slots.normal_z[to] = normal[2];
        slots.closing_m_per_s[to] = batch.closing_m_per_s[j];
        true
    }
}

//! Ground-truth masks: target, shadow and depth for each pixel of a picture.
//!
//! A pixel belongs to a target if more than half of its energy comes from the target. It is shadow if the ground at its range on the beam's
//! axis exists but returns no echo, and no target does. Its depth is that of the ground on the axis, including shadow.

use echotank_core::ping::{GroundSeen, LineTruth, PingPlan, Side};

use super::line::{Projection, RangeAxis};

/// Ground truth of one pixel.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Mask {
    /// Number of the target: 1 is the scene's first target, 0 is none.
    pub target: u16,
    /// True if the ground is hidden and no target covers the pixel.
    pub shadow: bool,
    /// Depth of the seabed in world coordinates, metres, positive down; NaN if the pixel shows none.
    pub down_m: f32,
}

impl Mask {
    /// A pixel without data.
    pub const EMPTY: Self = Self {
        target: 0,
        shadow: false,
        down_m: f32::NAN,
    };
}

/// Maximum number of targets distinguished in one pixel.
const TARGETS_PER_PIXEL: usize = 8;

/// Computes the masks of a line's cells, which are the cells of [`super::line::cell_intensity`].
pub(crate) fn cell_masks(
    truth: &LineTruth,
    axis: RangeAxis,
    projection: Projection,
    metres_per_cell: f64,
    cells: &mut [Mask],
) {
    for (i, cell) in cells.iter_mut().enumerate() {
        let samples = projection.samples(axis, metres_per_cell, i);
        let end = samples.end.min(truth.target.len());
        *cell = mask_of(truth, samples.start.min(end)..end);
    }
}

/// Mask of a range of samples of a line or a beam.
pub(super) fn mask_of(truth: &LineTruth, samples: std::ops::Range<usize>) -> Mask {
    let mut energies = [(0u16, 0.0f64); TARGETS_PER_PIXEL];
    let mut total = 0.0;
    let (mut seen, mut hidden, mut down_m, mut grounds) = (false, false, 0.0, 0);
    for k in samples {
        let energy = f64::from(truth.target_energy[k]);
        total += energy + f64::from(truth.other_energy[k]);
        let target = truth.target[k];
        if target != 0
            && let Some(own) = energies.iter_mut().find(|e| e.0 == target || e.0 == 0)
        {
            *own = (target, own.1 + energy);
        }
        seen |= truth.ground[k] == GroundSeen::Seen;
        hidden |= truth.ground[k] == GroundSeen::Hidden;
        if truth.down_m[k].is_finite() {
            down_m += truth.down_m[k];
            grounds += 1;
        }
    }
    let strongest = energies
        .iter()
        .fold((0, 0.0), |a, e| if e.1 > a.1 { *e } else { a });
    let target = match strongest.1 > 0.5 * total {
        true => strongest.0,
        false => 0,
    };
    Mask {
        target,
        shadow: hidden && !seen && target == 0,
        down_m: match grounds {
            0 => f32::NAN,
            n => down_m / n as f32,
        },
    }
}

/// Masks of a waterfall; they are filled with the same pings and have the same size.
pub struct WaterfallMasks {
    metres_per_pixel: f64,
    rows_per_ping: usize,
    columns_per_side: usize,
    max_pings: usize,
    sample_rate_hz: f64,
    first_ping: Option<u32>,
    /// Row-major, oldest ping first.
    rows: Vec<Mask>,
}

impl WaterfallMasks {
    /// Masks with the geometry of `waterfall`.
    pub fn of(waterfall: &super::waterfall::Waterfall, sample_rate_hz: f64) -> Self {
        let spec = waterfall.spec();
        Self {
            metres_per_pixel: spec.metres_per_pixel,
            rows_per_ping: spec.rows_per_ping.max(1) as usize,
            columns_per_side: waterfall.width() / 2,
            max_pings: spec.max_pings,
            sample_rate_hz,
            first_ping: None,
            rows: Vec::new(),
        }
    }

    /// Adds one ping; `truths` has one entry per line. Without a projection, the ping's row stays empty.
    pub fn push(&mut self, plan: &PingPlan, truths: &[LineTruth], projection: Option<Projection>) {
        let first = *self.first_ping.get_or_insert(plan.ping_number);
        let place = plan.ping_number.checked_sub(first).map(|p| p as usize);
        let Some(place) = place.filter(|&p| p < self.max_pings) else {
            return;
        };
        let width = self.width();
        let end = (place + 1) * width;
        if self.rows.len() < end {
            self.rows.resize(end, Mask::EMPTY);
        }
        let (port, starboard) = self.rows[place * width..end].split_at_mut(self.columns_per_side);
        let axis = RangeAxis::new(plan.sound_speed_m_per_s, self.sample_rate_hz);
        let Some(projection) = projection else {
            return;
        };
        for truth in truths {
            let half = match truth.side {
                Side::Port => &mut *port,
                Side::Starboard => &mut *starboard,
            };
            cell_masks(truth, axis, projection, self.metres_per_pixel, half);
            if truth.side == Side::Port {
                half.reverse();
            }
        }
    }

    /// Width in pixels.
    pub fn width(&self) -> usize {
        2 * self.columns_per_side
    }

    /// Height in pixels.
    pub fn height(&self) -> usize {
        self.rows.len() / self.width() * self.rows_per_ping
    }

    /// Masks row-major from the top, in the order of the picture's pixels.
    pub fn pixels(&self) -> impl Iterator<Item = Mask> + '_ {
        let rows = self.rows.chunks_exact(self.width()).rev();
        rows.flat_map(|row| std::iter::repeat_n(row, self.rows_per_ping))
            .flatten()
            .copied()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn truth(samples: usize) -> LineTruth {
        LineTruth {
            side: Side::Starboard,
            target: vec![0; samples],
            target_energy: vec![0.0; samples],
            other_energy: vec![1.0; samples],
            ground: vec![GroundSeen::Seen; samples],
            down_m: vec![20.0; samples],
        }
    }

    #[test]
    fn a_pixel_belongs_to_the_target_with_more_than_half_of_its_energy() {
        let mut truth = truth(8);
        (truth.target[1], truth.target_energy[1]) = (3, 3.9);
        (truth.target[5], truth.target_energy[5]) = (3, 4.1);
        // Two targets, neither of which exceeds the sum of the other and the ground.
        let mut cells = [Mask::EMPTY; 2];
        let axis = RangeAxis {
            metres_per_sample: 0.25,
        };
        cell_masks(&truth, axis, Projection::Slant, 1.0, &mut cells);
        assert_eq!(cells.map(|c| c.target), [0, 3]);
        (truth.target[6], truth.target_energy[6]) = (2, 3.0);
        cell_masks(&truth, axis, Projection::Slant, 1.0, &mut cells);
        assert_eq!(cells[1].target, 0);
    }

    #[test]
    fn shadow_is_hidden_ground_without_a_target() {
        let mut truth = truth(16);
        truth.ground[4..12].fill(GroundSeen::Hidden);
        truth.ground[12..].fill(GroundSeen::None);
        truth.down_m[12..].fill(f32::NAN);
        truth.ground[7] = GroundSeen::Seen;
        let axis = RangeAxis {
            metres_per_sample: 0.25,
        };
        let mut cells = [Mask::EMPTY; 5];
        cell_masks(&truth, axis, Projection::Slant, 1.0, &mut cells);
        assert_eq!(cells.map(|c| c.shadow), [false, false, true, false, false]);
        assert_eq!(
            cells.map(|c| c.down_m.is_nan()),
            [false, false, false, true, true]
        );
        (truth.target[9], truth.target_energy[9]) = (1, 9.0);
        cell_masks(&truth, axis, Projection::Slant, 1.0, &mut cells);
        assert!(!cells[2].shadow && cells[2].target == 1);
    }
}

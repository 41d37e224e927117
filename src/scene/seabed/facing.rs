//! Finds ground that may face away from an eye.
//!
//! Over a height field, the elevation of the line of sight rises outward as long as the ground faces the eye. Ground that faces the eye throughout
//! therefore hides nothing behind it.
//!
//! With x and y from the point below the eye, the tangent of the elevation rises outward where `depth - eye - x slope_x - y slope_y > 0`. On a
//! bilinear square this is `a - eye - twist x y`, whose least value lies on a corner.

use glam::{DVec2, DVec3};

use super::blocks::Block;
use super::{GridSurface, Surface};

/// Ground that faces the eye by less than this (metres of the expression above) counts as facing away, to cover rounding.
const EDGE_ON_M: f64 = 1e-6;

/// Consecutive intervals between cell centres along one side of a grid, or of one of its mirror images.
#[derive(Clone, Copy, Debug)]
struct Strip {
    /// Index of the first interval in the grid.
    first: usize,
    count: usize,
    /// Position, metres from the eye.
    low_m: f64,
    high_m: f64,
    /// -1 in a reversed mirror image, else 1.
    sign: f64,
}

/// One side of a grid: number and length of its intervals, position of the first in metres from the eye, and whether mirror images continue it.
#[derive(Clone, Copy)]
struct Side {
    intervals: usize,
    cell_m: f64,
    first_m: f64,
    mirror: bool,
}

impl Side {
    /// Strips of up to `together` intervals that meet the range low_m..=high_m.
    fn strips(
        self,
        together: usize,
        (low_m, high_m): (f64, f64),
    ) -> impl Iterator<Item = Strip> + Clone {
        let extent_m = self.intervals as f64 * self.cell_m;
        let image = |m: f64| ((m - self.first_m) / extent_m).floor() as i64;
        let images = match self.mirror {
            true => image(low_m)..=image(high_m),
            false => 0..=0,
        };
        images.flat_map(move |image| {
            let from_m = self.first_m + image as f64 * extent_m;
            let back = image.rem_euclid(2) == 1;
            let sign = if back { -1.0 } else { 1.0 };
            // Position in intervals from the grid's first one in this image.
            let place = move |m: f64| match back {
                false => (m - from_m) / self.cell_m,
                true => (from_m + extent_m - m) / self.cell_m,
            };
            let (a, b) = (place(low_m), place(high_m));
            // The cast maps negative numbers to 0.
            let first = (a.min(b) as usize).min(self.intervals) / together;
            let end = (a.max(b).ceil() as usize)
                .min(self.intervals)
                .div_ceil(together);
            (first..end).map(move |group| {
                let first = group * together;
                let count = together.min(self.intervals - first);
                let ends_m = [first, first + count].map(|k| match back {
                    false => from_m + k as f64 * self.cell_m,
                    true => from_m + extent_m - k as f64 * self.cell_m,
                });
                Strip {
                    first,
                    count,
                    low_m: ends_m[0].min(ends_m[1]),
                    high_m: ends_m[0].max(ends_m[1]),
                    sign,
                }
            })
        })
    }

    /// The single intervals of a strip.
    fn single(self, strip: Strip) -> impl Iterator<Item = Strip> + Clone {
        (0..strip.count).map(move |k| {
            let from_low = if strip.sign < 0.0 {
                strip.count - 1 - k
            } else {
                k
            };
            let low_m = strip.low_m + from_low as f64 * self.cell_m;
            Strip {
                first: strip.first + k,
                count: 1,
                low_m,
                high_m: low_m + self.cell_m,
                sign: strip.sign,
            }
        })
    }
}

impl Surface {
    /// Reports rectangles that cover all ground between `low_m` and `high_m` that may face away from the eye, and all holes in it.
    pub(crate) fn turned_away(
        &self,
        eye_m: DVec3,
        low_m: DVec2,
        high_m: DVec2,
        mut away: impl FnMut(DVec2, DVec2),
    ) {
        match self {
            Self::Plane { .. } => {}
            // Scanning every ray is cheaper than testing the shape.
            Self::Paper(_) => away(low_m, high_m),
            Self::Grid(surface) => surface.turned_away(eye_m, low_m, high_m, away),
        }
    }
}

impl GridSurface {
    fn turned_away(
        &self,
        eye_m: DVec3,
        low_m: DVec2,
        high_m: DVec2,
        mut away: impl FnMut(DVec2, DVec2),
    ) {
        let grid = &self.grid;
        let north = Side {
            intervals: grid.rows - 1,
            cell_m: grid.cell_north_m,
            first_m: self.south_m - eye_m.x,
            mirror: self.mirror,
        };
        let east = Side {
            intervals: grid.cols - 1,
            cell_m: grid.cell_east_m,
            first_m: self.west_m - eye_m.y,
            mirror: self.mirror,
        };
        let (rows_m, cols_m) = (
            (low_m.x - eye_m.x, high_m.x - eye_m.x),
            (low_m.y - eye_m.y, high_m.y - eye_m.y),
        );
        let at_m = eye_m.truncate();
        let columns = east.strips(self.blocks.intervals_east, cols_m);
        for v in north.strips(self.blocks.intervals_north, rows_m) {
            for u in columns.clone() {
                let row = v.first / self.blocks.intervals_north;
                let col = u.first / self.blocks.intervals_east;
                if all_faces(self.blocks.at(row, col), eye_m.z, v, u) {
                    continue;
                }
                for v in north.single(v) {
                    for u in east.single(u) {
                        if !self.square_faces(eye_m.z, v, u) {
                            away(
                                at_m + DVec2::new(v.low_m, u.low_m),
                                at_m + DVec2::new(v.high_m, u.high_m),
                            );
                        }
                    }
                }
            }
        }
    }

    /// Whether a square faces the eye. A hole does not.
    fn square_faces(&self, eye_down_m: f64, v: Strip, u: Strip) -> bool {
        let (row, col) = (v.first, u.first);
        let h = |r: usize, c: usize| self.grid.cell_down_m(row + r, col + c);
        let (sw, se, nw, ne) = (h(0, 0), h(0, 1), h(1, 0), h(1, 1));
        // South-western corner of the square in the grid, which in a mirror image may be another.
        let (x, step_x) = match v.sign < 0.0 {
            true => (v.high_m, -self.grid.cell_north_m),
            false => (v.low_m, self.grid.cell_north_m),
        };
        let (y, step_y) = match u.sign < 0.0 {
            true => (u.high_m, -self.grid.cell_east_m),
            false => (u.low_m, self.grid.cell_east_m),
        };
        let faces = |depth_m: f64, x: f64, rise_x: f64, y: f64, rise_y: f64| {
            depth_m - eye_down_m - x * rise_x / step_x - y * rise_y / step_y
        };
        // One hole among the four corners yields NaN, which fails every comparison.
        faces(sw, x, nw - sw, y, se - sw) > EDGE_ON_M
            && faces(se, x, ne - se, y + step_y, se - sw) > EDGE_ON_M
            && faces(nw, x + step_x, nw - sw, y, ne - nw) > EDGE_ON_M
            && faces(ne, x + step_x, ne - se, y + step_y, ne - nw) > EDGE_ON_M
    }
}

/// False if part of the block may face away or is a hole.
fn all_faces(block: &Block, eye_down_m: f64, v: Strip, u: Strip) -> bool {
    let most = |strip: Strip, slope: (f64, f64)| {
        let ends = [strip.low_m, strip.high_m];
        let products = ends.map(|m| (m * slope.0 * strip.sign).max(m * slope.1 * strip.sign));
        products[0].max(products[1])
    };
    !block.holes
        && block.down_m.0 - eye_down_m - most(v, block.slope_north) - most(u, block.slope_east)
            > EDGE_ON_M
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::read::HeightField;

    /// Rough ground with a hole, mirrored. Ground outside the rectangles faces the eye, and every rectangle holds some ground that does not.
    #[test]
    fn ground_outside_the_rectangles_faces_the_eye_and_no_rectangle_faces_it_throughout() {
        let (rows, cols) = (24, 31);
        let mut down_m: Vec<f32> = (0..rows * cols)
            .map(|k| {
                let (r, c) = ((k / cols) as f32, (k % cols) as f32);
                18.0 + 1.5 * (r / 2.0).sin() * (c / 3.0).cos() + 0.5 * (1.7 * r + 0.9 * c).sin()
            })
            .collect();
        down_m[7 * cols + 11] = f32::NAN;
        let field = HeightField {
            rows,
            cols,
            cell_north_m: 2.0,
            cell_east_m: 1.5,
            south_m: 0.0,
            west_m: 0.0,
            down_m,
        };
        for (mirror, block_m) in [(false, 5.0), (true, 5.0), (true, 1.0)] {
            let surface = Surface::from_grid(field.clone(), mirror, -10.0, -20.0, block_m);
            for eye_m in [DVec3::new(3.0, -2.0, 8.0), DVec3::new(41.0, 33.0, 2.0)] {
                let (low_m, high_m) = (DVec2::splat(-45.0), DVec2::splat(50.0));
                let mut away = Vec::new();
                surface.turned_away(eye_m, low_m, high_m, |low_m, high_m| {
                    away.push((low_m, high_m, false));
                });
                let mut facing = 0;
                for k in 0..200_000_u32 {
                    let share = |step: f64| (f64::from(k) * step).fract();
                    let p = low_m
                        + (high_m - low_m) * DVec2::new(share(0.754_877_666), share(0.569_840_291));
                    let d = p - eye_m.truncate();
                    let faces = surface.sample(p.x, p.y).is_none_or(|g| {
                        g.down_m - eye_m.z - d.x * g.slope_north - d.y * g.slope_east > 0.0
                    });
                    let named = away
                        .iter_mut()
                        .find(|(low_m, high_m, _)| p.cmpge(*low_m).all() && p.cmple(*high_m).all());
                    match named {
                        Some((_, _, seen)) => *seen |= !faces || surface.sample(p.x, p.y).is_none(),
                        None => assert!(faces, "{p} from {eye_m}, mirror {mirror}"),
                    }
                    facing += u32::from(faces);
                }
                let all_faced = away.iter().filter(|(_, _, seen)| !seen).count();
                println!(
                    "mirror {mirror}: {} squares named, {all_faced} of them seen to face; {facing} places face",
                    away.len()
                );
                assert!(away.len() > 50 && facing > 50_000, "nothing was tried");
                // The sampled positions may miss small corners that face away.
                assert!(all_faced * 5 < away.len(), "{all_faced} of {}", away.len());
            }
        }
    }
}

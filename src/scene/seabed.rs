//! The seabed's surface: depth, slope and bounds at any place of the scene.
//!
//! Coordinates are the scene's own: metres north and east of its zero, down positive.

use glam::DVec2;

use super::SceneError;
use super::ascii_grid::Grid;
use super::occlusion::Piece;
use super::paper;
use crate::config::spec::{MosaicSpec, PaperShape, SeabedShape};

/// The surface at one place.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Depth {
    pub down_m: f64,
    /// d down / d north and d down / d east.
    pub slope_north: f64,
    pub slope_east: f64,
}

impl Depth {
    /// Unit normal away from the solid (up: its down component is negative).
    pub fn normal(&self) -> [f64; 3] {
        let cos = self.slope_cos();
        [self.slope_north * cos, self.slope_east * cos, -cos]
    }
    /// Cosine of the angle between the surface and the horizontal.
    pub fn slope_cos(&self) -> f64 {
        1.0 / (1.0 + self.slope_north * self.slope_north + self.slope_east * self.slope_east).sqrt()
    }
}

/// The seabed as a function of place.
#[derive(Clone, Debug)]
pub enum Surface {
    /// `down = depth_m + slope_north * north + slope_east * east`, everywhere.
    Plane {
        depth_m: f64,
        slope_north: f64,
        slope_east: f64,
    },
    Grid(GridSurface),
    Paper(PaperShape),
}

/// A grid whose centre lies at the scene's zero, moved by an offset.
#[derive(Clone, Debug)]
pub struct GridSurface {
    /// Heights are depths: positive down.
    grid: Grid,
    /// Beyond its outer cell centres the surface goes on as its mirror image, without end; otherwise it stops there.
    mirror: bool,
    /// South-western cell's centre in the scene, metres.
    south_m: f64,
    west_m: f64,
    blocks: Blocks,
}

/// Least and greatest depth of blocks of cells, so that the bounds of a tile cost a few look-ups.
#[derive(Clone, Debug)]
struct Blocks {
    /// Intervals between cell centres on a block's side.
    intervals: usize,
    rows: usize,
    cols: usize,
    /// Least and greatest, south-western block first; (inf, -inf) where all is a hole.
    bounds_m: Vec<(f64, f64)>,
}

const NOTHING: (f64, f64) = (f64::INFINITY, f64::NEG_INFINITY);

fn united(a: (f64, f64), b: (f64, f64)) -> (f64, f64) {
    (a.0.min(b.0), a.1.max(b.1))
}

impl Surface {
    /// Opens the shape; `block_m` is the size of the areas [`Surface::bounds_m`] will be asked about.
    pub fn open(shape: &SeabedShape, mirror: bool, block_m: f64) -> Result<Self, SceneError> {
        match shape {
            SeabedShape::Plane {
                depth_m,
                slope_north,
                slope_east,
            } => Ok(Self::Plane {
                depth_m: *depth_m,
                slope_north: *slope_north,
                slope_east: *slope_east,
            }),
            SeabedShape::Paper(shape) => Ok(Self::Paper(*shape)),
            SeabedShape::EsriAscii {
                path,
                positive_up,
                offset_north_m,
                offset_east_m,
            } => {
                let mut grid = super::read(path, Grid::parse)?;
                if *positive_up {
                    grid.negate();
                }
                Ok(Self::from_grid(
                    grid,
                    mirror,
                    *offset_north_m,
                    *offset_east_m,
                    block_m,
                ))
            }
        }
    }

    /// Opens a mosaic: decibels take the place of depths.
    pub fn open_mosaic(
        mosaic: &MosaicSpec,
        mirror: bool,
        block_m: f64,
    ) -> Result<Self, SceneError> {
        let grid = super::read(&mosaic.path, Grid::parse)?;
        let (north_m, east_m) = (mosaic.offset_north_m, mosaic.offset_east_m);
        Ok(Self::from_grid(grid, mirror, north_m, east_m, block_m))
    }

    /// A surface of a grid of depths (positive down), its centre at the offset.
    pub fn from_grid(
        grid: Grid,
        mirror: bool,
        offset_north_m: f64,
        offset_east_m: f64,
        block_m: f64,
    ) -> Self {
        Self::Grid(GridSurface {
            mirror,
            south_m: offset_north_m - grid.extent_north_m() / 2.0,
            west_m: offset_east_m - grid.extent_east_m() / 2.0,
            blocks: Blocks::new(&grid, block_m),
            grid,
        })
    }

    /// The surface at a place; none in a hole and beyond the end.
    pub fn sample(&self, north_m: f64, east_m: f64) -> Option<Depth> {
        match self {
            Self::Plane {
                depth_m,
                slope_north,
                slope_east,
            } => Some(Depth {
                down_m: depth_m + slope_north * north_m + slope_east * east_m,
                slope_north: *slope_north,
                slope_east: *slope_east,
            }),
            Self::Grid(surface) => surface.sample(north_m, east_m),
            Self::Paper(shape) => paper::sample(*shape, north_m, east_m),
        }
    }

    /// Bounds of the depth over a rectangle (may be wider than need be); none where it holds no seabed.
    pub fn bounds_m(&self, north_m: (f64, f64), east_m: (f64, f64)) -> Option<(f64, f64)> {
        match self {
            Self::Plane {
                depth_m,
                slope_north,
                slope_east,
            } => {
                let n = (slope_north * north_m.0, slope_north * north_m.1);
                let e = (slope_east * east_m.0, slope_east * east_m.1);
                Some((
                    depth_m + n.0.min(n.1) + e.0.min(e.1),
                    depth_m + n.0.max(n.1) + e.0.max(e.1),
                ))
            }
            Self::Grid(surface) => surface.bounds_m(north_m, east_m),
            Self::Paper(shape) => Some(paper::bounds_m(*shape, east_m)),
        }
    }
}

impl Surface {
    /// Whether one part of it could hide another.
    pub fn is_hilly(&self) -> bool {
        matches!(self, Self::Grid(_) | Self::Paper(_))
    }

    /// The ground along a ray from `from_m` in the horizontal unit direction `along`, out to `reach_m`, piece by piece. Holes give none.
    pub fn profile(&self, from_m: DVec2, along: DVec2, reach_m: f64, mut piece: impl FnMut(Piece)) {
        let surface = match self {
            Self::Plane { .. } => return,
            Self::Paper(shape) => return paper::profile(*shape, from_m, along, reach_m, piece),
            Self::Grid(surface) => surface,
        };
        let grid = &surface.grid;
        let mut north = Crossings::new(from_m.x, along.x, surface.south_m, grid.cell_m);
        let mut east = Crossings::new(from_m.y, along.y, surface.west_m, grid.cell_m);
        let mut here_m = 0.0;
        while here_m < reach_m {
            let next_m = north.next_m.min(east.next_m).min(reach_m);
            if next_m > here_m {
                let at = Piece::AT.map(|share| {
                    let place_m = from_m + along * (here_m + share * (next_m - here_m));
                    let depth = surface.sample(place_m.x, place_m.y);
                    depth.map_or(f64::NAN, |d| d.down_m)
                });
                if !at.iter().any(|down_m| down_m.is_nan()) {
                    piece(Piece::through(here_m, next_m, at));
                }
                here_m = next_m;
            }
            north.pass(here_m);
            east.pass(here_m);
        }
    }
}

/// Where a ray crosses the lines of a lattice along one coordinate.
struct Crossings {
    next_m: f64,
    /// Between crossings.
    step_m: f64,
}

impl Crossings {
    fn new(from_m: f64, along: f64, origin_m: f64, cell_m: f64) -> Self {
        if along == 0.0 {
            return Self {
                next_m: f64::INFINITY,
                step_m: f64::INFINITY,
            };
        }
        let cells = (from_m - origin_m) / cell_m;
        let to_line = match along > 0.0 {
            true => cells.floor() + 1.0 - cells,
            false => cells - (cells.ceil() - 1.0),
        };
        Self {
            next_m: to_line * cell_m / along.abs(),
            step_m: cell_m / along.abs(),
        }
    }

    fn pass(&mut self, here_m: f64) {
        while self.next_m <= here_m {
            self.next_m += self.step_m;
        }
    }
}

impl GridSurface {
    fn sample(&self, north_m: f64, east_m: f64) -> Option<Depth> {
        let (mut v, mut u) = (north_m - self.south_m, east_m - self.west_m);
        let (mut sign_v, mut sign_u) = (1.0, 1.0);
        if self.mirror {
            (v, sign_v) = fold(v, self.grid.extent_north_m());
            (u, sign_u) = fold(u, self.grid.extent_east_m());
        }
        self.grid.sample(v, u).map(|h| Depth {
            down_m: h.height_m,
            slope_north: sign_v * h.slope_north,
            slope_east: sign_u * h.slope_east,
        })
    }

    fn bounds_m(&self, north_m: (f64, f64), east_m: (f64, f64)) -> Option<(f64, f64)> {
        let side = |ends: (f64, f64), first: f64, extent: f64| {
            let ends = (ends.0 - first, ends.1 - first);
            if self.mirror {
                Some(fold_interval(ends, extent))
            } else {
                (ends.1 >= 0.0 && ends.0 <= extent).then_some(ends)
            }
        };
        let v = side(north_m, self.south_m, self.grid.extent_north_m())?;
        let u = side(east_m, self.west_m, self.grid.extent_east_m())?;
        let rows = self.blocks.reach(v, self.grid.cell_m, self.blocks.rows);
        let cols = self.blocks.reach(u, self.grid.cell_m, self.blocks.cols);
        let mut bounds = NOTHING;
        for row in rows {
            for col in cols.clone() {
                bounds = united(bounds, self.blocks.bounds_m[row * self.blocks.cols + col]);
            }
        }
        (bounds.0 <= bounds.1).then_some(bounds)
    }
}

/// A coordinate reflected into 0 ..= extent, and the sign its slope takes.
fn fold(x: f64, extent: f64) -> (f64, f64) {
    let there_and_back = x.rem_euclid(2.0 * extent);
    if there_and_back <= extent {
        (there_and_back, 1.0)
    } else {
        (2.0 * extent - there_and_back, -1.0)
    }
}

/// An interval that holds all the reflections of an interval.
fn fold_interval(ends: (f64, f64), extent: f64) -> (f64, f64) {
    if ends.1 - ends.0 >= extent {
        return (0.0, extent);
    }
    // Shorter than the extent: at most one seam lies inside.
    let ((a, sign_a), (b, sign_b)) = (fold(ends.0, extent), fold(ends.1, extent));
    match (sign_a > 0.0, sign_b > 0.0) {
        (true, false) => (a.min(b), extent),
        (false, true) => (0.0, a.max(b)),
        _ => (a.min(b), a.max(b)),
    }
}

impl Blocks {
    fn new(grid: &Grid, block_m: f64) -> Self {
        let intervals = ((block_m / grid.cell_m).ceil() as usize).max(1);
        let rows = (grid.rows - 1).div_ceil(intervals);
        let cols = (grid.cols - 1).div_ceil(intervals);
        let mut bounds_m = Vec::with_capacity(rows * cols);
        for row in 0..rows {
            for col in 0..cols {
                let mut bounds = NOTHING;
                // The centres on a block's edge belong to both neighbours: a bilinear surface has its extremes at centres.
                for r in row * intervals..=((row + 1) * intervals).min(grid.rows - 1) {
                    for c in col * intervals..=((col + 1) * intervals).min(grid.cols - 1) {
                        let h = grid.cell_height_m(r, c);
                        if !h.is_nan() {
                            bounds = united(bounds, (h, h));
                        }
                    }
                }
                bounds_m.push(bounds);
            }
        }
        Self {
            intervals,
            rows,
            cols,
            bounds_m,
        }
    }

    /// The blocks along one side that an interval (metres from the first centre) touches.
    fn reach(
        &self,
        ends_m: (f64, f64),
        cell_m: f64,
        count: usize,
    ) -> std::ops::RangeInclusive<usize> {
        let side_m = self.intervals as f64 * cell_m;
        // Negative numbers become 0 in the cast.
        let block = |m: f64| ((m / side_m) as usize).min(count - 1);
        block(ends_m.0)..=block(ends_m.1)
    }
}

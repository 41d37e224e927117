//! Surface of the seabed: depth, slope and bounds at any position.
//!
//! Coordinates are the scene's: metres north and east of its origin, depth positive down.

mod blocks;
mod facing;

use std::ops::Range;

use glam::DVec2;

use super::SceneError;
use super::paper;
use super::piece::Piece;
pub(crate) use super::read::Depth;
use super::read::{Files, FormatError, Georeference, HeightField, Survey};
use blocks::{Blocks, NOTHING, united};
use echotank_config::spec::{MosaicSpec, PaperShape, SeabedShape};

impl Depth {
    /// Unit normal away from the solid. Its down component is negative.
    pub fn normal(&self) -> [f64; 3] {
        let cos = self.slope_cos();
        [self.slope_north * cos, self.slope_east * cos, -cos]
    }
    /// Cosine of the angle between the surface and the horizontal.
    pub(crate) fn slope_cos(&self) -> f64 {
        1.0 / (1.0 + self.slope_north * self.slope_north + self.slope_east * self.slope_east).sqrt()
    }
}

/// Depth of the seabed as a function of position.
#[derive(Clone, Debug)]
pub(crate) enum Surface {
    /// `down = depth_m + slope_north * north + slope_east * east`, everywhere.
    Plane {
        depth_m: f64,
        slope_north: f64,
        slope_east: f64,
    },
    Grid(Box<GridSurface>),
    Paper(PaperShape),
}

/// A grid whose centre lies at an offset from the scene's origin.
#[derive(Clone, Debug)]
pub(crate) struct GridSurface {
    /// Height field with its origin at the centre of the south-western cell.
    grid: HeightField,
    /// Whether the surface continues beyond its outer cell centres as its mirror image. Otherwise it ends there.
    mirror: bool,
    /// Centre of the south-western cell in the scene, metres.
    south_m: f64,
    west_m: f64,
    blocks: Blocks,
    /// Geodetic position of the file's middle.
    place: Option<GeodeticPlace>,
    /// Georeference of the file, and the position of its origin in the scene, metres north and east.
    reference: Option<(Georeference, DVec2)>,
}

/// A point of the scene with a known geodetic position.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct GeodeticPlace {
    /// Latitude, WGS84, radians.
    pub latitude_rad: f64,
    /// Longitude, WGS84, radians.
    pub longitude_rad: f64,
    /// Position in the scene, metres north.
    pub north_m: f64,
    /// Position in the scene, metres east.
    pub east_m: f64,
}

impl Surface {
    /// Opens a seabed shape. `block_m` is the typical size of the areas that [`Surface::bounds_m`] is called with.
    pub(crate) fn open(
        files: &dyn Files,
        shape: &SeabedShape,
        mirror: bool,
        block_m: f64,
    ) -> Result<Self, SceneError> {
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
            SeabedShape::File {
                file,
                offset_north_m,
                offset_east_m,
            } => {
                let survey = Survey::open(files, file)?;
                let place = survey
                    .zero_geodetic_rad()
                    .map(|(latitude_rad, longitude_rad)| GeodeticPlace {
                        latitude_rad,
                        longitude_rad,
                        north_m: *offset_north_m,
                        east_m: *offset_east_m,
                    });
                let (north_m, east_m) = (*offset_north_m, *offset_east_m);
                let reference = (survey.georeference(), DVec2::new(north_m, east_m));
                let mut surface = GridSurface::new(survey.field, mirror, north_m, east_m, block_m);
                surface.place = place;
                surface.reference = Some(reference);
                Ok(Self::Grid(Box::new(surface)))
            }
        }
    }

    /// Opens a backscatter mosaic over this surface; its values are decibels instead of depths.
    ///
    /// Over a surface from a file the mosaic lies where its coordinates put it, and must be sampled at [`Self::unmirrored`]. Over other surfaces its
    /// centre lies at the scene's origin.
    pub(crate) fn open_mosaic(
        &self,
        files: &dyn Files,
        mosaic: &MosaicSpec,
        mirror: bool,
        block_m: f64,
    ) -> Result<Self, SceneError> {
        let survey = Survey::open_layer(files, &mosaic.path, mosaic.crs)?;
        let refused = |error: FormatError| SceneError::Format {
            path: mosaic.path.clone(),
            error,
        };
        let offset_m = DVec2::new(mosaic.offset_north_m, mosaic.offset_east_m);
        let Self::Grid(ground) = self else {
            let (north_m, east_m) = (offset_m.x, offset_m.y);
            let laid = Self::from_grid(survey.field, mirror, north_m, east_m, block_m);
            return Ok(laid);
        };
        let mut zero_m = offset_m;
        if let Some((reference, at_m)) = &ground.reference {
            let (north_m, east_m) = reference.locate(&survey.georeference()).map_err(refused)?;
            zero_m += *at_m + DVec2::new(north_m, east_m);
        }
        let laid = GridSurface::new(survey.field, false, zero_m.x, zero_m.y, block_m);
        if !laid.overlaps(ground) {
            return Err(refused(FormatError::new(
                "coordinates",
                format!(
                    "{:.0} m north, {:.0} m east of the scene's zero",
                    zero_m.x, zero_m.y
                ),
                "does not overlap the seabed's file",
            )));
        }
        Ok(Self::Grid(Box::new(laid)))
    }

    /// The position in the file that a position in the scene shows. The two differ only in mirror images.
    pub(crate) fn unmirrored(&self, north_m: f64, east_m: f64) -> (f64, f64) {
        match self {
            Self::Grid(surface) if surface.mirror => {
                let v = fold(north_m - surface.south_m, surface.grid.extent_north_m()).0;
                let u = fold(east_m - surface.west_m, surface.grid.extent_east_m()).0;
                (surface.south_m + v, surface.west_m + u)
            }
            _ => (north_m, east_m),
        }
    }

    /// A surface of depths with its origin at an offset.
    pub(crate) fn from_grid(
        grid: HeightField,
        mirror: bool,
        offset_north_m: f64,
        offset_east_m: f64,
        block_m: f64,
    ) -> Self {
        let surface = GridSurface::new(grid, mirror, offset_north_m, offset_east_m, block_m);
        Self::Grid(Box::new(surface))
    }

    /// A point of the surface with a known geodetic position; none without a georeferenced file.
    pub(crate) fn geodetic_place(&self) -> Option<GeodeticPlace> {
        match self {
            Self::Plane { .. } | Self::Paper(_) => None,
            Self::Grid(surface) => surface.place,
        }
    }

    /// Depth and slope at a position; none in a hole and beyond the edge.
    pub(crate) fn sample(&self, north_m: f64, east_m: f64) -> Option<Depth> {
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

    /// Bounds of the depth over a rectangle, metres, and of the slope; may be wider than necessary. None where the rectangle holds no seabed.
    pub(crate) fn bounds_m(
        &self,
        north_m: (f64, f64),
        east_m: (f64, f64),
    ) -> Option<((f64, f64), f64)> {
        match self {
            Self::Plane {
                depth_m,
                slope_north,
                slope_east,
            } => {
                let n = (slope_north * north_m.0, slope_north * north_m.1);
                let e = (slope_east * east_m.0, slope_east * east_m.1);
                let down_m = (
                    depth_m + n.0.min(n.1) + e.0.min(e.1),
                    depth_m + n.0.max(n.1) + e.0.max(e.1),
                );
                Some((down_m, slope_north.hypot(*slope_east)))
            }
            Self::Grid(surface) => surface.bounds_m(north_m, east_m),
            Self::Paper(shape) => Some((paper::bounds_m(*shape, east_m), f64::INFINITY)),
        }
    }
}

impl Surface {
    /// Whether one part of the surface could hide another.
    pub(crate) fn is_hilly(&self) -> bool {
        matches!(self, Self::Grid(_) | Self::Paper(_))
    }

    /// Reports the pieces of ground along a ray from `from_m` in the horizontal unit direction `along`, over a range of distances. Holes yield none.
    pub(crate) fn profile(
        &self,
        from_m: DVec2,
        along: DVec2,
        stretch_m: Range<f64>,
        mut piece: impl FnMut(Piece),
    ) {
        let surface = match self {
            Self::Plane { .. } => return,
            Self::Paper(shape) => return paper::profile(*shape, from_m, along, stretch_m, piece),
            Self::Grid(surface) => surface,
        };
        let grid = &surface.grid;
        let mut north = Crossings::new(from_m.x, along.x, surface.south_m, grid.cell_north_m);
        let mut east = Crossings::new(from_m.y, along.y, surface.west_m, grid.cell_east_m);
        let (mut here_m, reach_m) = (stretch_m.start, stretch_m.end);
        while here_m < reach_m {
            north.pass(here_m);
            east.pass(here_m);
            let next_m = north.next_m.min(east.next_m).min(reach_m);
            // Sampled in the middle of the piece: on the edge of a square, a neighbouring square or hole could answer.
            let middle_m = from_m + along * (0.5 * (here_m + next_m));
            if let Some((depth, twist)) = surface.sample_with_twist(middle_m.x, middle_m.y) {
                let slope = depth.slope_north * along.x + depth.slope_east * along.y;
                let bend = twist * along.x * along.y;
                piece(Piece::new(here_m, next_m, [depth.down_m, slope, bend]));
            }
            here_m = next_m;
        }
    }
}

/// Distances at which a ray crosses the grid lines of one coordinate.
struct Crossings {
    next_m: f64,
    /// Distance between crossings.
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
    fn new(
        mut grid: HeightField,
        mirror: bool,
        offset_north_m: f64,
        offset_east_m: f64,
        block_m: f64,
    ) -> Self {
        let south_m = std::mem::take(&mut grid.south_m) + offset_north_m;
        let west_m = std::mem::take(&mut grid.west_m) + offset_east_m;
        Self {
            mirror,
            south_m,
            west_m,
            blocks: Blocks::new(&grid, block_m),
            grid,
            place: None,
            reference: None,
        }
    }

    fn overlaps(&self, other: &Self) -> bool {
        let ends = |s: &Self| {
            let low = DVec2::new(s.south_m, s.west_m);
            let size = DVec2::new(s.grid.extent_north_m(), s.grid.extent_east_m());
            (low, low + size)
        };
        let (own, others) = (ends(self), ends(other));
        own.0.cmple(others.1).all() && others.0.cmple(own.1).all()
    }

    fn sample(&self, north_m: f64, east_m: f64) -> Option<Depth> {
        self.sample_with_twist(north_m, east_m).map(|s| s.0)
    }

    /// Depth and slope, and d^2 down / d north d east.
    #[inline]
    fn sample_with_twist(&self, north_m: f64, east_m: f64) -> Option<(Depth, f64)> {
        let (mut v, mut u) = (north_m - self.south_m, east_m - self.west_m);
        let (mut sign_v, mut sign_u) = (1.0, 1.0);
        if self.mirror {
            (v, sign_v) = fold(v, self.grid.extent_north_m());
            (u, sign_u) = fold(u, self.grid.extent_east_m());
        }
        self.grid.sample_with_twist(v, u).map(|(h, twist)| {
            let depth = Depth {
                down_m: h.down_m,
                slope_north: sign_v * h.slope_north,
                slope_east: sign_u * h.slope_east,
            };
            (depth, sign_v * sign_u * twist)
        })
    }

    fn bounds_m(&self, north_m: (f64, f64), east_m: (f64, f64)) -> Option<((f64, f64), f64)> {
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
        let rows = self.blocks.reach(
            v,
            (self.blocks.intervals_north, self.grid.cell_north_m),
            self.blocks.rows,
        );
        let cols = self.blocks.reach(
            u,
            (self.blocks.intervals_east, self.grid.cell_east_m),
            self.blocks.cols,
        );
        let (mut down_m, mut north, mut east) = (NOTHING, NOTHING, NOTHING);
        for row in rows {
            for col in cols.clone() {
                let block = self.blocks.at(row, col);
                down_m = united(down_m, block.down_m);
                north = united(north, block.slope_north);
                east = united(east, block.slope_east);
            }
        }
        let steepest = |(least, most): (f64, f64)| most.max(-least).max(0.0);
        let max_slope = steepest(north).hypot(steepest(east));
        (down_m.0 <= down_m.1).then_some((down_m, max_slope))
    }
}

/// A coordinate reflected into 0 ..= extent, and the sign of its slope.
fn fold(x: f64, extent: f64) -> (f64, f64) {
    let there_and_back = x.rem_euclid(2.0 * extent);
    if there_and_back <= extent {
        (there_and_back, 1.0)
    } else {
        (2.0 * extent - there_and_back, -1.0)
    }
}

/// An interval that contains the reflections of all points of an interval.
fn fold_interval(ends: (f64, f64), extent: f64) -> (f64, f64) {
    if ends.1 - ends.0 >= extent {
        return (0.0, extent);
    }
    // The interval is shorter than the extent, so at most one seam lies inside.
    let ((a, sign_a), (b, sign_b)) = (fold(ends.0, extent), fold(ends.1, extent));
    match (sign_a > 0.0, sign_b > 0.0) {
        (true, false) => (a.min(b), extent),
        (false, true) => (0.0, a.max(b)),
        _ => (a.min(b), a.max(b)),
    }
}

//! Seabed scatterers on demand: rectangular tiles, each made from its own number alone.
//!
//! A tile is 32 x 32 cells with one scatterer in each, anywhere in its cell with equal probability (a stratified sample). The mean density
//! is exact, the tile always has the same size in memory, and no lattice is left: the jitter fills its cell, so that the structure
//! factor's Bragg lines, which it multiplies by sinc^2, vanish.
//!
//! Levels: cells of level 0 are square; from each level to the next two cells become one, in turn side by side northward and eastward, so
//! that the density halves. The scatterer of a cell is that of one of its two halves, by a fair coin, with sqrt(2) times its pressure: the
//! mean intensity of an area is the same at every level, and where the level changes half of the scatterers stay as they were, so that
//! the speckle's intensity before and after has a correlation of 1/2 rather than none.
//!
//! The random numbers are addressed by seed and cell (`draws`) and the elementary functions are those of `libm`: a tile has the same bits
//! on every machine, whenever and in whatever order it is made.
//! Not modelled: correlation of the reflectivity from place to place, change in time.

use std::sync::Arc;

use glam::{DVec2, DVec3};
use num_complex::Complex32;

use super::bottoms::Bottom;
use super::draws;
use super::seabed::{Depth, Surface};
use echotank_config::spec::{Density, IncidenceSpec, MosaicValues, SeabedSpec};
use echotank_core::flow::Footprint;

/// Cells on a tile's side. 1024 scatterers: enough that a tile's upkeep is small beside them, few enough that little is made in vain.
pub(crate) const CELLS_ON_SIDE: usize = 32;
pub(crate) const SCATTERERS_PER_TILE: usize = CELLS_ON_SIDE * CELLS_ON_SIDE;

/// What a full tile takes: place, normal, strength, and a place in the list of those a ping keeps.
pub const TILE_BYTES: u64 = (SCATTERERS_PER_TILE
    * (3 * size_of::<f32>() + size_of::<[f32; 3]>() + size_of::<Complex32>() + size_of::<u16>()))
    as u64;

/// Nearer than this the automatic density grows no further, metres: few hulls and fewer towed bodies come so close to the ground.
pub(crate) const NEAREST_M: f64 = 2.0;

/// A tile: its level, and row (north) and column (east) among those of its level.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub(crate) struct TileId {
    pub level: u32,
    pub row: i64,
    pub col: i64,
}

impl TileId {
    /// The two tiles of the next finer level that cover the same area.
    pub(crate) fn halves(self) -> [Self; 2] {
        let level = self.level - 1;
        let along = |half: i64| match self.level % 2 {
            1 => Self {
                level,
                row: 2 * self.row + half,
                col: self.col,
            },
            _ => Self {
                level,
                row: self.row,
                col: 2 * self.col + half,
            },
        };
        [along(0), along(1)]
    }
}

/// How densely the seabed is sampled at which distance.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Levels {
    /// Side of a cell of level 0.
    cell_m: f64,
    /// The coarsest in use.
    top: u32,
    /// Level k serves distances from 2^k times this on.
    near_m: f64,
}

impl Levels {
    pub(crate) fn new(density: &Density) -> Self {
        match *density {
            Density::PerM2(density_per_m2) => {
                debug_assert!(density_per_m2 > 0.0 && density_per_m2.is_finite());
                Self {
                    cell_m: 1.0 / density_per_m2.sqrt(),
                    top: 0,
                    near_m: 1.0,
                }
            }
            Density::Auto {
                per_cell,
                range_m,
                beam_rad,
                longest_range_m,
            } => Self {
                cell_m: (range_m * beam_rad * NEAREST_M / per_cell).sqrt(),
                top: (longest_range_m / NEAREST_M).log2().floor().max(0.0) as u32,
                near_m: NEAREST_M,
            },
        }
    }

    /// The level that serves a distance.
    pub(crate) fn at(&self, distance_m: f64) -> u32 {
        match self.top {
            0 => 0,
            top => ((distance_m / self.near_m).log2().floor().max(0.0) as u32).min(top),
        }
    }

    /// Northern and eastern side of a cell.
    pub(crate) fn cell_m(&self, level: u32) -> DVec2 {
        DVec2::new(
            self.cell_m * (1_u64 << level.div_ceil(2)) as f64,
            self.cell_m * (1_u64 << (level / 2)) as f64,
        )
    }

    pub(crate) fn tile_m(&self, level: u32) -> DVec2 {
        self.cell_m(level) * CELLS_ON_SIDE as f64
    }

    pub(crate) fn density_per_m2(&self, level: u32) -> f64 {
        let cell_m = self.cell_m(level);
        1.0 / (cell_m.x * cell_m.y)
    }

    /// Between neighbouring scatterers at a distance, on average.
    pub(crate) fn spacing_m(&self, distance_m: f64) -> f64 {
        1.0 / self.density_per_m2(self.at(distance_m)).sqrt()
    }

    /// The coarsest level whose tiles are no wider than `side_m`, or 0; levels above [`Self::at`] serve only to find tiles.
    pub(crate) fn no_wider_than(&self, side_m: f64) -> u32 {
        let doublings = (side_m / (self.cell_m * CELLS_ON_SIDE as f64)).log2();
        // 2 levels to a doubling of both sides; 80 of them hold any seabed on Earth.
        (2.0 * doublings).floor().clamp(0.0, 80.0) as u32
    }

    /// The middle of the sides of tiles in use, metres.
    pub(crate) fn typical_side_m(&self) -> f64 {
        let tile_m = self.tile_m(self.top / 2);
        tile_m.x.max(tile_m.y)
    }
}

/// How tiles are made.
#[derive(Clone, Debug)]
pub(crate) struct Recipe {
    surface: Arc<Surface>,
    seed: u64,
    levels: Levels,
    bottom: Bottom,
    mosaic: Option<Mosaic>,
    incidence: IncidenceSpec,
    speckle: bool,
}

/// How the bottom's strength changes from place to place.
#[derive(Clone, Debug)]
pub(crate) struct Mosaic {
    /// dB in place of depths.
    pub surface: Surface,
    /// dB of the bottom's own strength that the values take the place of; 0 where they are added to it.
    own_db: f64,
}

impl Mosaic {
    pub(crate) fn new(surface: Surface, values: MosaicValues, bottom: &Bottom) -> Self {
        let own_db = match values {
            MosaicValues::Relative => 0.0,
            MosaicValues::Absolute { incidence_rad } => {
                10.0 * libm::log10(bottom.strength(incidence_rad))
            }
        };
        Self { surface, own_db }
    }

    /// Factor on pressures; 1 in holes and beyond the edges.
    fn factor(&self, north_m: f64, east_m: f64) -> f64 {
        match self.surface.sample(north_m, east_m) {
            None => 1.0,
            Some(here) => libm::pow(10.0, (here.down_m - self.own_db) / 20.0),
        }
    }
}

/// The scatterers of one tile, structure of arrays.
#[derive(Clone, Debug, Default)]
pub(crate) struct Tile {
    /// What the places count from, in the scene's own coordinates, metres.
    pub(crate) zero_m: DVec3,
    pub north_m: Vec<f32>,
    pub east_m: Vec<f32>,
    pub down_m: Vec<f32>,
    pub normal: Vec<[f32; 3]>,
    pub strength: Vec<Complex32>,
    /// Those that the ping under way keeps.
    pub(super) kept: Vec<u16>,
}

impl Tile {
    /// An empty tile that can be filled without allocating.
    pub(crate) fn with_room() -> Self {
        Self {
            zero_m: DVec3::ZERO,
            north_m: Vec::with_capacity(SCATTERERS_PER_TILE),
            east_m: Vec::with_capacity(SCATTERERS_PER_TILE),
            down_m: Vec::with_capacity(SCATTERERS_PER_TILE),
            normal: Vec::with_capacity(SCATTERERS_PER_TILE),
            strength: Vec::with_capacity(SCATTERERS_PER_TILE),
            kept: Vec::with_capacity(SCATTERERS_PER_TILE),
        }
    }

    pub(crate) fn len(&self) -> usize {
        self.north_m.len()
    }

    pub(crate) fn is_empty(&self) -> bool {
        self.north_m.is_empty()
    }

    pub(crate) fn position_m(&self, i: usize) -> DVec3 {
        let from_zero = [self.north_m[i], self.east_m[i], self.down_m[i]];
        self.zero_m + DVec3::from(from_zero.map(f64::from))
    }

    fn clear(&mut self) {
        self.north_m.clear();
        self.east_m.clear();
        self.down_m.clear();
        self.normal.clear();
        self.strength.clear();
    }
}

impl Recipe {
    pub(crate) fn new(surface: Surface, spec: &SeabedSpec, seed: u64) -> Self {
        Self {
            surface: Arc::new(surface),
            seed,
            levels: Levels::new(&spec.density),
            bottom: Bottom::new(&spec.bottom),
            mosaic: None,
            incidence: spec.incidence,
            speckle: spec.speckle,
        }
    }

    pub(crate) fn with_mosaic(mut self, surface: Surface, values: MosaicValues) -> Self {
        self.mosaic = Some(Mosaic::new(surface, values, &self.bottom));
        self
    }

    pub(crate) fn surface(&self) -> &Surface {
        &self.surface
    }

    pub(crate) fn shared_surface(&self) -> Arc<Surface> {
        Arc::clone(&self.surface)
    }

    pub(crate) fn levels(&self) -> &Levels {
        &self.levels
    }

    /// The law that all scatterers of the seabed obey.
    pub(crate) fn bottom(&self) -> &Bottom {
        &self.bottom
    }

    /// Row or column of the tile at a coordinate.
    pub(crate) fn index_at(coordinate_m: f64, side_m: f64) -> i64 {
        (coordinate_m / side_m).floor() as i64
    }

    /// The box of a tile; none where it holds no seabed.
    pub(crate) fn bounds(&self, id: TileId) -> Option<TileBox> {
        let side_m = self.levels.tile_m(id.level);
        let edges = |index: i64, side_m: f64| (index as f64 * side_m, (index + 1) as f64 * side_m);
        let (north, east) = (edges(id.row, side_m.x), edges(id.col, side_m.y));
        let down = self.surface.bounds_m(north, east)?;
        Some(TileBox {
            low_m: DVec3::new(north.0, east.0, down.0),
            high_m: DVec3::new(north.1, east.1, down.1),
        })
    }

    /// Fills `tile` with the scatterers of one tile, cells in the order of [`cell_at`]. Holes give none.
    pub(crate) fn make(&self, id: TileId, tile: &mut Tile) {
        tile.clear();
        let side_m = self.levels.tile_m(id.level);
        let middle_m = DVec2::new(
            (id.row as f64 + 0.5) * side_m.x,
            (id.col as f64 + 0.5) * side_m.y,
        );
        let down_m = self.bounds(id).map_or(0.0, |b| b.low_m.z);
        tile.zero_m = middle_m.extend(down_m);
        // Intensity goes with the area of the patch, not of its horizontal projection: a cosine to come.
        let mu_area_m2 = self.bottom.mu / self.levels.density_per_m2(id.level);
        let first = |index: i64| index * CELLS_ON_SIDE as i64;
        for place in 0..SCATTERERS_PER_TILE {
            let (north, east) = cell_at(place);
            let (north, east) = (first(id.row) + north, first(id.col) + east);
            let (north, east) = self.representative_cell(id.level, north, east);
            let [a, b, c, d] = draws::of_cell(self.seed, north, east);
            let from_middle = |cell: i64, jitter: u32, middle_m: f64| {
                ((cell as f64 + draws::fraction(jitter)) * self.levels.cell_m - middle_m) as f32
            };
            let north_m = from_middle(north, a, middle_m.x);
            let east_m = from_middle(east, b, middle_m.y);
            let (at_north_m, at_east_m) = (
                middle_m.x + f64::from(north_m),
                middle_m.y + f64::from(east_m),
            );
            let Some(depth) = self.surface.sample(at_north_m, at_east_m) else {
                continue;
            };
            let mut amplitude = (mu_area_m2 / depth.slope_cos()).sqrt();
            if let Some(mosaic) = &self.mosaic {
                let (north_m, east_m) = self.surface.unmirrored(at_north_m, at_east_m);
                amplitude *= mosaic.factor(north_m, east_m);
            }
            let reflectivity = match self.speckle {
                true => draws::circular_gaussian(c, d),
                false => Complex32::ONE,
            };
            tile.north_m.push(north_m);
            tile.east_m.push(east_m);
            tile.down_m.push((depth.down_m - down_m) as f32);
            tile.normal.push(self.normal(&depth));
            tile.strength.push(amplitude as f32 * reflectivity);
        }
    }

    /// What the law measures angles from.
    fn normal(&self, depth: &Depth) -> [f32; 3] {
        match self.incidence {
            IncidenceSpec::Normal => depth.normal().map(|x| x as f32),
            IncidenceSpec::Flat => super::UP,
        }
    }

    /// The cell of level 0 whose scatterer speaks for a cell.
    #[inline(always)]
    fn representative_cell(&self, level: u32, mut north: i64, mut east: i64) -> (i64, i64) {
        for level in (1..=level).rev() {
            let half = draws::half_of(self.seed, level, north, east);
            match level % 2 {
                1 => north = 2 * north + half,
                _ => east = 2 * east + half,
            }
        }
        (north, east)
    }
}

/// Row and column in a tile of the cell at a place of its list: along Morton's curve (1966), on which what is near in the list is near on the bottom.
/// Whoever takes some of them at a time then finds their echoes close together.
fn cell_at(place: usize) -> (i64, i64) {
    let every_other = |bits: usize| {
        let bit = |k: u32| (bits >> (2 * k) & 1) << k;
        (0..CELLS_ON_SIDE.ilog2()).map(bit).sum::<usize>() as i64
    };
    (every_other(place >> 1), every_other(place))
}

/// A box that holds all scatterers of a tile.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct TileBox {
    pub low_m: DVec3,
    pub high_m: DVec3,
}

/// Boxes are grown by this, metres, so that rounding never leaves a scatterer outside its tile's box: places within a tile are f32.
const BOX_MARGIN_M: f64 = 1e-3;

impl TileBox {
    /// From a point in the box's coordinates to the nearest point of the box, metres.
    pub(crate) fn distance_m(&self, from_m: DVec3) -> f64 {
        let (low, high) = (self.low_m - BOX_MARGIN_M, self.high_m + BOX_MARGIN_M);
        from_m.clamp(low, high).distance(from_m)
    }

    /// False only where no point of the box is in the footprint. `apex_m` is the footprint's apex in the box's coordinates.
    pub(crate) fn may_meet(&self, footprint: &Footprint, apex_m: DVec3) -> bool {
        let (low, high) = (self.low_m - BOX_MARGIN_M, self.high_m + BOX_MARGIN_M);
        if self.distance_m(apex_m) > footprint.max_range_m {
            return false;
        }
        let center = (low + high) / 2.0 - apex_m;
        let half = (high - low) / 2.0;
        // |d| is at most the farthest corner's; |d . axis| at least |centre . axis| less the box's half width along the axis, and d . normal at
        // most centre . normal and that much.
        let farthest_m = (center.abs() + half).length().min(footprint.max_range_m);
        footprint.faces.iter().all(|face| {
            let max_m = center.dot(face.normal) + half.dot(face.normal.abs());
            face.may_face(max_m, farthest_m)
        }) && footprint
            .sides
            .iter()
            .map(|side| {
                let min_m = center.dot(side.axis).abs() - half.dot(side.axis.abs());
                side.below(min_m.max(0.0), farthest_m)
            })
            .product::<f64>()
            <= footprint.depth
    }
}

//! Seabed scatterers on demand, in rectangular tiles. Each tile is made from its index alone.
//!
//! A tile has 32 x 32 cells with one scatterer in each, at a uniformly random position in its cell (a stratified sample). The mean density is exact
//! and every tile has the same size in memory. The jitter fills the cell and multiplies the Bragg lines of the structure factor by sinc^2, which is
//! zero at each of them.
//!
//! Levels: cells of level 0 are square. From each level to the next, two cells become one, alternately northward and eastward, which halves the
//! density. The scatterer of a cell is that of one of its two halves, chosen by a fair coin, with sqrt(2) times its pressure. The mean intensity of
//! an area is thus the same at every level. Where the level changes, half of the scatterers stay, so the speckle intensities of the two levels have a
//! correlation of 1/2.
//!
//! Random numbers are addressed by seed and cell (`draws`), and elementary functions come from `libm`. A tile therefore has the same bits on every
//! machine and in any order of making. Not modelled: spatial correlation of the reflectivity, change in time.

use std::sync::Arc;

use glam::{DVec2, DVec3};
use num_complex::Complex32;

use super::bottoms::Bottom;
use super::draws;
use super::seabed::{Depth, Surface};
use super::thinning::Thinning;
use echotank_config::spec::{Density, IncidenceSpec, MosaicValues, SeabedSpec};
use echotank_core::scene::Footprint;

/// Cells on a side of a tile. With 1024 scatterers the overhead of a tile is small, and few scatterers are made in vain.
pub(crate) const CELLS_ON_SIDE: usize = 32;
pub(crate) const SCATTERERS_PER_TILE: usize = CELLS_ON_SIDE * CELLS_ON_SIDE;

/// Size of a full tile, bytes: position, rank, normal, strength, index and gain in the list of kept scatterers.
pub const TILE_BYTES: u64 = (SCATTERERS_PER_TILE
    * (5 * size_of::<f32>() + size_of::<[f32; 3]>() + size_of::<Complex32>() + size_of::<u16>()))
    as u64;

/// Distance below which the automatic density is constant, metres.
pub(crate) const NEAREST_M: f64 = 2.0;

/// Coarsest level.
const MAX_LEVEL: u32 = 80;

/// Index of a tile: its level, and its row (north) and column (east) in that level.
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

/// Levels of the tiles, and the density that an array needs.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Levels {
    /// Side of a cell of level 0, metres.
    cell_m: f64,
    /// Longest range of any sonar, metres.
    longest_m: f64,
    /// None where the density is constant.
    thinning: Option<Thinning>,
}

impl Levels {
    pub(crate) fn new(density: &Density) -> Self {
        match *density {
            Density::PerM2(density_per_m2) => {
                debug_assert!(density_per_m2 > 0.0 && density_per_m2.is_finite());
                Self {
                    cell_m: 1.0 / density_per_m2.sqrt(),
                    longest_m: NEAREST_M,
                    thinning: None,
                }
            }
            Density::Auto {
                per_cell,
                cell,
                longest_range_m,
                lobes,
            } => Self {
                cell_m: (cell.range_m * cell.beam_rad * NEAREST_M / per_cell).sqrt(),
                longest_m: longest_range_m.max(NEAREST_M),
                thinning: Some(Thinning {
                    finest: cell,
                    lobes,
                }),
            },
        }
    }

    /// How scatterers are left out; none where the density is constant.
    pub(crate) fn thinning(&self) -> Option<&Thinning> {
        self.thinning.as_ref()
    }

    /// Northward and eastward side of a cell, metres.
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

    /// Mean spacing of scatterers in the beam of the finest sonar at a distance, metres.
    pub(crate) fn spacing_m(&self, distance_m: f64) -> f64 {
        match self.thinning {
            None => self.cell_m,
            Some(_) => self.cell_m * (distance_m.max(NEAREST_M) / NEAREST_M).sqrt(),
        }
    }

    /// Coarsest level whose tiles are at most `side_m` wide, at least 0.
    pub(crate) fn no_wider_than(&self, side_m: f64) -> u32 {
        let doublings = (side_m / (self.cell_m * CELLS_ON_SIDE as f64)).log2();
        // Two levels double both sides; 80 levels cover any seabed on earth.
        (2.0 * doublings).floor().clamp(0.0, f64::from(MAX_LEVEL)) as u32
    }

    /// Longer side of the tiles halfway to the longest range on a scale of logarithms, metres.
    pub(crate) fn typical_side_m(&self) -> f64 {
        let octaves = (self.longest_m / NEAREST_M).log2();
        let tile_m = self.tile_m((octaves / 2.0) as u32);
        tile_m.x.max(tile_m.y)
    }
}

/// Everything that determines the scatterers of a tile.
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

/// Backscatter mosaic: local strength of the bottom.
#[derive(Clone, Debug)]
pub(crate) struct Mosaic {
    /// Surface whose depth values are decibels.
    pub surface: Surface,
    /// Strength of the bottom that absolute values replace, dB; 0 for relative values.
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

/// Scatterers of one tile, as a structure of arrays.
#[derive(Clone, Debug, Default)]
pub(crate) struct Tile {
    /// Origin of the positions in scene coordinates, metres.
    pub(crate) zero_m: DVec3,
    pub north_m: Vec<f32>,
    pub east_m: Vec<f32>,
    pub down_m: Vec<f32>,
    pub normal: Vec<[f32; 3]>,
    pub strength: Vec<Complex32>,
    /// Permanent random numbers in (0, 1], uniform within the tile's level; empty where the density is constant.
    pub rank: Vec<f32>,
    /// Indices of the scatterers that the current ping keeps, and the factors on their strengths.
    pub(super) kept: Vec<u16>,
    pub(super) gain: Vec<f32>,
}

impl Tile {
    /// An empty tile with capacity for all of its scatterers.
    pub(crate) fn with_room() -> Self {
        Self {
            zero_m: DVec3::ZERO,
            north_m: Vec::with_capacity(SCATTERERS_PER_TILE),
            east_m: Vec::with_capacity(SCATTERERS_PER_TILE),
            down_m: Vec::with_capacity(SCATTERERS_PER_TILE),
            normal: Vec::with_capacity(SCATTERERS_PER_TILE),
            strength: Vec::with_capacity(SCATTERERS_PER_TILE),
            rank: Vec::with_capacity(SCATTERERS_PER_TILE),
            kept: Vec::with_capacity(SCATTERERS_PER_TILE),
            gain: Vec::with_capacity(SCATTERERS_PER_TILE),
        }
    }

    pub(crate) fn len(&self) -> usize {
        self.north_m.len()
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
        self.rank.clear();
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

    /// Scattering law of all scatterers of the seabed.
    pub(crate) fn bottom(&self) -> &Bottom {
        &self.bottom
    }

    /// Row or column of the tile at a coordinate.
    pub(crate) fn index_at(coordinate_m: f64, side_m: f64) -> i64 {
        (coordinate_m / side_m).floor() as i64
    }

    /// Bounding box of a tile; none where it holds no seabed.
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

    /// Fills `tile` with the scatterers of one tile, cells in the order of [`cell_at`]. A hole yields no scatterer.
    pub(crate) fn make(&self, id: TileId, tile: &mut Tile) {
        tile.clear();
        let side_m = self.levels.tile_m(id.level);
        let middle_m = DVec2::new(
            (id.row as f64 + 0.5) * side_m.x,
            (id.col as f64 + 0.5) * side_m.y,
        );
        let down_m = self.bounds(id).map_or(0.0, |b| b.low_m.z);
        tile.zero_m = middle_m.extend(down_m);
        // Intensity is proportional to the area of the sloping patch, not of its horizontal projection. The cosine follows below.
        let mu_area_m2 = self.bottom.mu / self.levels.density_per_m2(id.level);
        let first = |index: i64| index * CELLS_ON_SIDE as i64;
        for place in 0..SCATTERERS_PER_TILE {
            let (north, east) = cell_at(place);
            let own = (first(id.row) + north, first(id.col) + east);
            let (north, east) = self.representative_cell(id.level, own.0, own.1);
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
            if self.levels.thinning.is_some() {
                let fraction = draws::rank(self.seed, north, east);
                tile.rank
                    .push(self.rank(id.level, own.0, own.1, fraction) as f32);
            }
        }
    }

    /// Permanent random number of the scatterer of a cell, among those of the cell's level. The scatterer is in the next level with probability 1/2.
    /// Those in k further levels and no more have ranks in 2^-k (1/2, 1]; `fraction`, in [0, 1), gives the place in that interval.
    fn rank(&self, level: u32, mut north: i64, mut east: i64, fraction: f64) -> f64 {
        let mut rank = 1.0 - fraction / 2.0;
        for level in level + 1..=MAX_LEVEL {
            let index = match level % 2 {
                1 => &mut north,
                _ => &mut east,
            };
            let half = *index & 1;
            *index >>= 1;
            if draws::half_of(self.seed, level, north, east) != half {
                break;
            }
            rank *= 0.5;
        }
        rank
    }

    /// Normal from which the scattering law measures angles.
    fn normal(&self, depth: &Depth) -> [f32; 3] {
        match self.incidence {
            IncidenceSpec::Normal => depth.normal().map(|x| x as f32),
            IncidenceSpec::Flat => super::UP,
        }
    }

    /// The cell of level 0 whose scatterer represents a cell of a level.
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

/// Row and column of the cell at a position of the tile's list, along Morton's curve (1966). Scatterers that are near in the list are near on the
/// bottom, and so are their echoes.
fn cell_at(place: usize) -> (i64, i64) {
    let every_other = |bits: usize| {
        let bit = |k: u32| (bits >> (2 * k) & 1) << k;
        (0..CELLS_ON_SIDE.ilog2()).map(bit).sum::<usize>() as i64
    };
    (every_other(place >> 1), every_other(place))
}

/// Bounding box of the scatterers of a tile.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct TileBox {
    pub low_m: DVec3,
    pub high_m: DVec3,
}

/// Margin of the boxes, metres. Positions in a tile are f32; the margin covers their rounding.
const BOX_MARGIN_M: f64 = 1e-3;

impl TileBox {
    /// Distance from a point in the box's coordinates to the nearest point of the box, metres.
    pub(crate) fn distance_m(&self, from_m: DVec3) -> f64 {
        let (low, high) = (self.low_m - BOX_MARGIN_M, self.high_m + BOX_MARGIN_M);
        from_m.clamp(low, high).distance(from_m)
    }

    /// A lower bound of [`Footprint::below_maximum`] in the box, with the margins of motion; none if no point of the box lies within range and in
    /// front of the faces. `apex_m` is the footprint's apex in the box's coordinates.
    pub(crate) fn below(&self, footprint: &Footprint, apex_m: DVec3) -> Option<f64> {
        let (low, high) = (self.low_m - BOX_MARGIN_M, self.high_m + BOX_MARGIN_M);
        if self.distance_m(apex_m) > footprint.max_range_m {
            return None;
        }
        let center = (low + high) / 2.0 - apex_m;
        let half = (high - low) / 2.0;
        // |d| is at most that of the farthest corner. |d . axis| is at least |centre . axis| less the half width of the box along the axis. d . normal is at most centre . normal plus that half width.
        let farthest_m = (center.abs() + half).length().min(footprint.max_range_m);
        let below = || {
            let sides = footprint.sides.iter().map(|side| {
                let min_m = center.dot(side.axis).abs() - half.dot(side.axis.abs());
                side.below(min_m.max(0.0), farthest_m)
            });
            sides.product::<f64>()
        };
        let faces = footprint.faces.iter().all(|face| {
            let max_m = center.dot(face.normal) + half.dot(face.normal.abs());
            face.may_face(max_m, farthest_m)
        });
        faces.then(below)
    }

    /// Least and greatest cosine from the downward vertical of the rays from a point in the box's coordinates.
    pub(crate) fn down_cosines(&self, from_m: DVec3) -> (f64, f64) {
        let (low, high) = (self.low_m - BOX_MARGIN_M, self.high_m + BOX_MARGIN_M);
        let nearest_m = self.distance_m(from_m);
        let farthest_m = (low - from_m).abs().max((high - from_m).abs()).length();
        let cosine = |down_m: f64, positive: f64, negative: f64| {
            let range_m = if down_m > 0.0 { positive } else { negative };
            (down_m / range_m.max(f64::MIN_POSITIVE)).clamp(-1.0, 1.0)
        };
        (
            cosine(low.z - from_m.z, farthest_m, nearest_m),
            cosine(high.z - from_m.z, nearest_m, farthest_m),
        )
    }
}

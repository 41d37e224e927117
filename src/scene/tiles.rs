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
//! Scatterers are made when a ping first needs them. A tile has 16 blocks of 8 x 8 cells, in the order of Morton's curve (1966), so that scatterers
//! that are near in the list are near on the bottom. Where the density is automatic, the scatterers of a block are sorted by rank (`thinning`). Those
//! that a ping may keep are then the first ones of the block, and only these are made.
//!
//! Random numbers are addressed by seed and cell (`draws`), and elementary functions are computed without the machine's library. A scatterer
//! therefore has the same bits on every machine and in any order of making. Not modelled: spatial correlation of the reflectivity, change in time.

use std::ops::Range;
use std::sync::Arc;

use glam::{DVec2, DVec3};
use num_complex::Complex32;

use super::bottoms::Bottom;
use super::draws;
use super::seabed::{Depth, Surface};
use super::thinning::{Grounds, LANES, Thinning};
use echotank_config::spec::{Density, IncidenceSpec, MosaicValues, SeabedSpec};
use echotank_core::scene::Footprint;
use echotank_core::simd::widest;

/// Cells on a side of a tile. With 1024 scatterers the overhead of a tile is small, and few scatterers are made in vain.
pub(crate) const CELLS_ON_SIDE: usize = 32;
pub(crate) const SCATTERERS_PER_TILE: usize = CELLS_ON_SIDE * CELLS_ON_SIDE;

/// Cells of a block, a square of them.
pub(crate) const CELLS_PER_BLOCK: usize = 64;
pub(crate) const BLOCKS_PER_TILE: usize = SCATTERERS_PER_TILE / CELLS_PER_BLOCK;

/// Size of a full tile, bytes: position, slope, rank, strength, cell, and index and gain in the list of kept scatterers.
pub const TILE_BYTES: u64 = (SCATTERERS_PER_TILE
    * (7 * size_of::<f32>() + size_of::<Complex32>() + size_of::<u8>() + size_of::<u16>()))
    as u64;

/// Cells whose ranks are drawn together: each draw waits for the one before, and those of other cells fill the time.
const RANKED_TOGETHER: usize = 16;

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

/// Scatterers of one tile, as a structure of arrays. Each block has [`CELLS_PER_BLOCK`] rows, the first ones of which are made.
#[derive(Clone, Debug)]
pub(crate) struct Tile {
    /// Origin of the positions in scene coordinates, metres.
    pub(crate) zero_m: DVec3,
    pub(crate) north_m: Vec<f32>,
    pub(crate) east_m: Vec<f32>,
    /// Not a number in a hole of the seabed.
    pub(crate) down_m: Vec<f32>,
    /// Slope of the seabed northward and eastward.
    slope_north: Vec<f32>,
    slope_east: Vec<f32>,
    incidence: IncidenceSpec,
    pub(crate) strength: Vec<Complex32>,
    /// Permanent random numbers in (0, 1], uniform within the tile's level, ascending in each block; 0 where the density is constant.
    pub(crate) rank: Vec<f32>,
    /// Place of the cell in its block, along Morton's curve.
    cell: Vec<u8>,
    /// Whether any scatterer made so far lies in a hole.
    has_holes: bool,
    /// Bit of each block whose ranks and cells are known.
    sorted: u16,
    /// Number of scatterers of each block that are made.
    made: [u8; BLOCKS_PER_TILE],
    /// Rows of the scatterers that the current ping keeps, and the factors on their strengths.
    pub(super) kept: Vec<u16>,
    pub(super) gain: Vec<f32>,
}

impl Tile {
    /// An empty tile without memory for scatterers, which [`Recipe::start`] allocates.
    pub(crate) fn without_room() -> Self {
        Self::with_room(0)
    }

    fn with_room(scatterers: usize) -> Self {
        Self {
            zero_m: DVec3::ZERO,
            north_m: vec![0.0; scatterers],
            east_m: vec![0.0; scatterers],
            down_m: vec![0.0; scatterers],
            slope_north: vec![0.0; scatterers],
            slope_east: vec![0.0; scatterers],
            incidence: IncidenceSpec::Normal,
            strength: vec![Complex32::ZERO; scatterers],
            rank: vec![0.0; scatterers],
            cell: vec![0; scatterers],
            has_holes: false,
            sorted: 0,
            made: [0; BLOCKS_PER_TILE],
            kept: Vec::with_capacity(scatterers),
            gain: Vec::with_capacity(scatterers),
        }
    }

    pub(crate) fn position_m(&self, i: usize) -> DVec3 {
        let from_zero = [self.north_m[i], self.east_m[i], self.down_m[i]];
        self.zero_m + DVec3::from(from_zero.map(f64::from))
    }

    /// Places and ranks of some rows.
    #[inline(always)]
    pub(crate) fn grounds(&self, rows: Range<usize>) -> (Grounds<'_>, &[f32]) {
        let grounds = Grounds {
            north_m: &self.north_m[rows.clone()],
            east_m: &self.east_m[rows.clone()],
            down_m: &self.down_m[rows.clone()],
            slope_north: &self.slope_north[rows.clone()],
            slope_east: &self.slope_east[rows.clone()],
        };
        (grounds, &self.rank[rows])
    }

    /// Number of scatterers in a range of rows, less those in holes.
    pub(crate) fn on_seabed(&self, rows: Range<usize>) -> u32 {
        let holes = match self.has_holes {
            true => self.down_m[rows.clone()]
                .iter()
                .filter(|m| m.is_nan())
                .count(),
            false => 0,
        };
        (rows.len() - holes) as u32
    }

    /// Normal from which the scattering law measures angles at a scatterer, a unit vector away from the solid.
    #[inline(always)]
    pub(crate) fn normal(&self, i: usize) -> [f32; 3] {
        if self.incidence == IncidenceSpec::Flat {
            return super::UP;
        }
        let (north, east) = (self.slope_north[i], self.slope_east[i]);
        let cos = 1.0 / (1.0 + north * north + east * east).sqrt();
        [north * cos, east * cos, -cos]
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
        let (down, max_slope) = self.surface.bounds_m(north, east)?;
        Some(TileBox {
            low_m: DVec3::new(north.0, east.0, down.0),
            high_m: DVec3::new(north.1, east.1, down.1),
            max_slope,
        })
    }

    /// Makes `tile` the one with this index, without any scatterer.
    pub(crate) fn start(&self, id: TileId, tile: &mut Tile) {
        if tile.cell.is_empty() {
            *tile = Tile::with_room(SCATTERERS_PER_TILE);
        }
        let side_m = self.levels.tile_m(id.level);
        let middle_m = DVec2::new(
            (id.row as f64 + 0.5) * side_m.x,
            (id.col as f64 + 0.5) * side_m.y,
        );
        let down_m = self.bounds(id).map_or(0.0, |b| b.low_m.z);
        tile.zero_m = middle_m.extend(down_m);
        tile.incidence = self.incidence;
        tile.has_holes = false;
        tile.sorted = 0;
        tile.made = [0; BLOCKS_PER_TILE];
    }

    /// Makes the scatterers of a block whose ranks are below `max_rank`, and further ones up to a multiple of [`LANES`]. Returns the number of those
    /// scatterers, the first ones of the block, and how many of them were not made before.
    pub(crate) fn make(
        &self,
        id: TileId,
        block: usize,
        max_rank: f64,
        tile: &mut Tile,
    ) -> (usize, usize) {
        let first = block * CELLS_PER_BLOCK;
        if tile.sorted & 1 << block == 0 {
            self.sort(id, block, tile);
            tile.sorted |= 1 << block;
        }
        let ranks = &tile.rank[first..first + CELLS_PER_BLOCK];
        // Counts all of them, which is faster than a search.
        let count = widest(
            #[inline(always)]
            || {
                ranks
                    .iter()
                    .filter(|rank| f64::from(**rank) < max_rank)
                    .count()
            },
        );
        let count = count.next_multiple_of(LANES);
        let made = usize::from(tile.made[block]);
        for from in (made..count).step_by(LANES) {
            self.make_lanes(id, block, from, tile);
        }
        tile.made[block] = made.max(count) as u8;
        (count, count.saturating_sub(made))
    }

    /// Orders the cells of a block by rank.
    fn sort(&self, id: TileId, block: usize, tile: &mut Tile) {
        let rows = block * CELLS_PER_BLOCK..(block + 1) * CELLS_PER_BLOCK;
        let cells: [u8; CELLS_PER_BLOCK] = std::array::from_fn(|cell| cell as u8);
        let (to_ranks, to_cells) = (&mut tile.rank[rows.clone()], &mut tile.cell[rows]);
        if self.levels.thinning.is_none() {
            to_ranks.fill(0.0);
            to_cells.copy_from_slice(&cells);
            return;
        }
        let mut ranks = [0.0; CELLS_PER_BLOCK];
        let (together, _) = cells.as_chunks::<RANKED_TOGETHER>();
        let (to, _) = ranks.as_chunks_mut::<RANKED_TOGETHER>();
        for (ranks, cells) in to.iter_mut().zip(together) {
            *ranks = widest(
                #[inline(always)]
                || {
                    let own = Cells::of_block(id, block, cells);
                    let mut finest = own;
                    finest.represent(self.seed, id.level);
                    own.ranks(self.seed, id.level, &finest)
                },
            );
        }
        for (cell, place) in places_in_order(&ranks).into_iter().enumerate() {
            to_ranks[place as usize] = ranks[cell];
            to_cells[place as usize] = cell as u8;
        }
    }

    /// Makes [`LANES`] scatterers of a block from row `from` of the block on.
    fn make_lanes(&self, id: TileId, block: usize, from: usize, tile: &mut Tile) {
        let first = block * CELLS_PER_BLOCK + from;
        let (cells, _) = tile.cell[first..].as_chunks::<LANES>();
        let cells = cells[0];
        // Intensity is proportional to the area of the sloping patch, not of its horizontal projection. The cosine follows below.
        let mu_area_m2 = self.bottom.mu / self.levels.density_per_m2(id.level);
        let amplitude = |depth: &Depth| (mu_area_m2 / depth.slope_cos()).sqrt();
        let zero_m = tile.zero_m;
        let mut drawn = Drawn::NOTHING;
        let rows = first..first + LANES;
        if let (
            &Surface::Plane {
                depth_m,
                slope_north,
                slope_east,
            },
            None,
        ) = (&*self.surface, &self.mosaic)
        {
            let amplitude = amplitude(&Depth {
                down_m: depth_m,
                slope_north,
                slope_east,
            }) as f32;
            let mut down_m = [0.0; LANES];
            widest(
                #[inline(always)]
                || {
                    self.draw(id, block, &cells, zero_m, &mut drawn);
                    let places = drawn.north_m.iter().zip(&drawn.east_m);
                    for (down_m, (north_m, east_m)) in down_m.iter_mut().zip(places) {
                        let at_north_m = zero_m.x + f64::from(*north_m);
                        let at_east_m = zero_m.y + f64::from(*east_m);
                        let at_down_m = depth_m + slope_north * at_north_m + slope_east * at_east_m;
                        *down_m = (at_down_m - zero_m.z) as f32;
                    }
                },
            );
            tile.north_m[rows.clone()].copy_from_slice(&drawn.north_m);
            tile.east_m[rows.clone()].copy_from_slice(&drawn.east_m);
            tile.down_m[rows.clone()].copy_from_slice(&down_m);
            tile.slope_north[rows.clone()].fill(slope_north as f32);
            tile.slope_east[rows.clone()].fill(slope_east as f32);
            for (strength, reflectivity) in tile.strength[rows].iter_mut().zip(drawn.reflectivity) {
                *strength = amplitude * reflectivity;
            }
            return;
        }
        widest(
            #[inline(always)]
            || self.draw(id, block, &cells, zero_m, &mut drawn),
        );
        for (i, row) in rows.enumerate() {
            let (north_m, east_m) = (drawn.north_m[i], drawn.east_m[i]);
            let (at_north_m, at_east_m) =
                (zero_m.x + f64::from(north_m), zero_m.y + f64::from(east_m));
            let Some(depth) = self.surface.sample(at_north_m, at_east_m) else {
                tile.down_m[row] = f32::NAN;
                tile.has_holes = true;
                continue;
            };
            let mut amplitude = amplitude(&depth);
            if let Some(mosaic) = &self.mosaic {
                let (north_m, east_m) = self.surface.unmirrored(at_north_m, at_east_m);
                amplitude *= mosaic.factor(north_m, east_m);
            }
            tile.north_m[row] = north_m;
            tile.east_m[row] = east_m;
            tile.down_m[row] = (depth.down_m - zero_m.z) as f32;
            tile.slope_north[row] = depth.slope_north as f32;
            tile.slope_east[row] = depth.slope_east as f32;
            tile.strength[row] = amplitude as f32 * drawn.reflectivity[i];
        }
    }

    /// Draws the scatterers at places of a block. Loops without branches.
    #[inline(always)]
    fn draw(
        &self,
        id: TileId,
        block: usize,
        places: &[u8; LANES],
        zero_m: DVec3,
        drawn: &mut Drawn,
    ) {
        let mut words = [[0; LANES]; 4];
        let mut finest = Cells::of_block(id, block, places);
        finest.represent(self.seed, id.level);
        for i in 0..LANES {
            let own = draws::of_cell(self.seed, finest.north[i], finest.east[i]);
            for (words, own) in words.iter_mut().zip(own) {
                words[i] = own;
            }
        }
        let [to_north, to_east, a, b] = &words;
        if self.speckle {
            for (reflectivity, (a, b)) in drawn.reflectivity.iter_mut().zip(a.iter().zip(b)) {
                *reflectivity = draws::circular_gaussian(*a, *b);
            }
        }
        let cell_m = self.levels.cell_m;
        let from_middle = |cell: i64, jitter: u32, middle_m: f64| {
            ((cell as f64 + draws::fraction(jitter)) * cell_m - middle_m) as f32
        };
        for (north_m, (cell, jitter)) in drawn
            .north_m
            .iter_mut()
            .zip(finest.north.iter().zip(to_north))
        {
            *north_m = from_middle(*cell, *jitter, zero_m.x);
        }
        for (east_m, (cell, jitter)) in drawn.east_m.iter_mut().zip(finest.east.iter().zip(to_east))
        {
            *east_m = from_middle(*cell, *jitter, zero_m.y);
        }
    }
}

/// Random properties of scatterers that are made together.
struct Drawn {
    /// From the origin of the tile.
    north_m: [f32; LANES],
    east_m: [f32; LANES],
    reflectivity: [Complex32; LANES],
}

impl Drawn {
    const NOTHING: Self = Self {
        north_m: [0.0; LANES],
        east_m: [0.0; LANES],
        reflectivity: [Complex32::ONE; LANES],
    };
}

/// Indices of cells of a block in a level. The functions are loops without branches over the cells.
#[derive(Clone, Copy)]
struct Cells<const N: usize> {
    north: [i64; N],
    east: [i64; N],
}

impl<const N: usize> Cells<N> {
    /// Cells at places of a block.
    #[inline(always)]
    fn of_block(id: TileId, block: usize, places: &[u8; N]) -> Self {
        let first = |index: i64| index * CELLS_ON_SIDE as i64;
        let zero = (first(id.row), first(id.col));
        let mut cells = Self {
            north: [0; N],
            east: [0; N],
        };
        for (i, place) in places.iter().enumerate() {
            let (north, east) = cell_at(block * CELLS_PER_BLOCK + usize::from(*place));
            (cells.north[i], cells.east[i]) = (zero.0 + north, zero.1 + east);
        }
        cells
    }

    /// The halves that represent the cells, which are of a level: 0 or 1.
    #[inline(always)]
    fn halves(&self, seed: u64, level: u32) -> [i64; N] {
        let mut halves = [0; N];
        let cells = self.north.iter().zip(&self.east);
        for (half, (north, east)) in halves.iter_mut().zip(cells) {
            *half = draws::half_of(seed, level, *north, *east);
        }
        halves
    }

    /// By how many bits the indices north and east of a cell of a level are shorter than those of its halves. Both directions are shifted at every level,
    /// so that the indices stay in registers.
    #[inline(always)]
    const fn shifts(level: u32) -> (i64, i64) {
        let north = (level % 2) as i64;
        (north, 1 - north)
    }

    /// Replaces cells of a level by the cells of level 0 whose scatterers represent them.
    #[inline(always)]
    fn represent(&mut self, seed: u64, level: u32) {
        for level in (1..=level).rev() {
            let halves = self.halves(seed, level);
            let (by_north, by_east) = Self::shifts(level);
            for (i, half) in halves.iter().enumerate() {
                self.north[i] = (self.north[i] << by_north) + (half & -by_north);
                self.east[i] = (self.east[i] << by_east) + (half & -by_east);
            }
        }
    }

    /// Permanent random numbers of the scatterers of cells, among those of the cells' level. The scatterer is in the next level with probability 1/2.
    /// Those in k further levels and no more have ranks in 2^-k (1/2, 1]; the representing cell of level 0 gives the place in that interval.
    #[inline(always)]
    fn ranks(&self, seed: u64, level: u32, finest: &Self) -> [f32; N] {
        let mut cells = *self;
        // 1 while the scatterer is in every level so far, and the number of these levels.
        let (mut represents, mut further) = ([1; N], [0; N]);
        for level in level + 1..=MAX_LEVEL {
            let mut own = [0; N];
            let (by_north, by_east) = Self::shifts(level);
            for (i, own) in own.iter_mut().enumerate() {
                *own = (cells.north[i] & by_north) | (cells.east[i] & by_east);
                cells.north[i] >>= by_north;
                cells.east[i] >>= by_east;
            }
            let halves = cells.halves(seed, level);
            let mut any = 0;
            for i in 0..N {
                represents[i] &= 1 ^ own[i] ^ halves[i];
                further[i] += represents[i];
                any |= represents[i];
            }
            if any == 0 {
                break;
            }
        }
        let mut ranks = [0.0; N];
        for i in 0..N {
            let place = 1.0 - draws::rank(seed, finest.north[i], finest.east[i]) / 2.0;
            // 2^-k.
            let factor = f64::from_bits((1023 - further[i] as u64) << 52);
            ranks[i] = (place * factor) as f32;
        }
        ranks
    }
}

/// The place of each rank in ascending order; equal ones keep their order. Counts the smaller ones: 64 vector operations for each 16 ranks, and none of
/// the branches of a sort that are predicted wrong.
pub(crate) fn places_in_order(ranks: &[f32; CELLS_PER_BLOCK]) -> [u32; CELLS_PER_BLOCK] {
    // The bits of positive numbers have the order of the numbers.
    let bits = ranks.map(|rank| rank.to_bits() as i32);
    let places = widest(
        #[inline(always)]
        || {
            let mut places = [0; CELLS_PER_BLOCK];
            for other in bits {
                for (place, own) in places.iter_mut().zip(&bits) {
                    *place += u32::from(other < *own);
                }
            }
            places
        },
    );
    const ALL_DIFFERENT: u32 = (CELLS_PER_BLOCK * (CELLS_PER_BLOCK - 1) / 2) as u32;
    if places.iter().sum::<u32>() == ALL_DIFFERENT {
        return places;
    }
    std::array::from_fn(|i| {
        let equal_before = bits[..i].iter().filter(|other| **other == bits[i]);
        places[i] + equal_before.count() as u32
    })
}

/// Row and column of the cell at a place of the tile, along Morton's curve.
#[inline(always)]
const fn cell_at(place: usize) -> (i64, i64) {
    (every_other(place >> 1), every_other(place))
}

/// The even bits of a number below 2^10.
const fn every_other(bits: usize) -> i64 {
    let bits = bits & 0x155;
    let bits = (bits | bits >> 1) & 0x133;
    let bits = (bits | bits >> 2) & 0x10F;
    ((bits | bits >> 4) & 0x1F) as i64
}

/// Bounding box of the scatterers of a tile.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct TileBox {
    pub low_m: DVec3,
    pub high_m: DVec3,
    /// Bound of the seabed's slope; infinite where it is not known.
    pub max_slope: f64,
}

/// Margin of the boxes, metres. Positions in a tile are f32; the margin covers their rounding.
const BOX_MARGIN_M: f64 = 1e-3;

impl TileBox {
    /// The part of a tile's box that holds a block.
    pub(crate) fn of_block(&self, block: usize) -> Self {
        let (north, east) = cell_at(block * CELLS_PER_BLOCK);
        let size_m = (self.high_m - self.low_m).truncate();
        let cell_m = size_m / CELLS_ON_SIDE as f64;
        let low_m = self.low_m.truncate() + cell_m * DVec2::new(north as f64, east as f64);
        let high_m = low_m + cell_m * (CELLS_PER_BLOCK as f64).sqrt();
        Self {
            low_m: low_m.extend(self.low_m.z),
            high_m: high_m.extend(self.high_m.z),
            max_slope: self.max_slope,
        }
    }

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

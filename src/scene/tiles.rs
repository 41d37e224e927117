//! Seabed scatterers on demand: square tiles, each made from its own number alone, in a bounded pool.
//!
//! A tile is 32 x 32 square cells of 1/density each, with one scatterer in every cell, anywhere in it with equal probability (a stratified
//! sample). The mean density is exact, the tile always has the same size in memory, and no lattice is left: the jitter fills its cell, so
//! that the structure factor's Bragg lines, which it multiplies by sinc^2, vanish.
//! The random numbers are those of ChaCha8 keyed by the scene's seed, with the tile's number as the stream, and the elementary functions
//! are those of `libm`: a tile has the same bits on every machine, whenever and in whatever order it is made.
//! Not modelled: occlusion, correlation of the reflectivity from place to place, change in time.

use std::collections::HashMap;

use glam::DVec3;
use num_complex::Complex64;
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::{Rng, SeedableRng};

use super::seabed::Surface;
use crate::config::spec::SeabedSpec;
use crate::flow::{Footprint, ScatterLaw, Scatterers};

/// Cells on a tile's side. 1024 scatterers: enough that a tile's upkeep is small beside them, few enough that little is made in vain.
pub const CELLS_ON_SIDE: usize = 32;
pub const SCATTERERS_PER_TILE: usize = CELLS_ON_SIDE * CELLS_ON_SIDE;

/// What a full tile takes: three coordinates, normal, strength and law of each scatterer.
pub const TILE_BYTES: u64 = (SCATTERERS_PER_TILE
    * (3 * size_of::<f64>()
        + size_of::<[f32; 3]>()
        + size_of::<Complex64>()
        + size_of::<ScatterLaw>())) as u64;

/// Keeps these streams apart from other uses of the same seed; a change of the recipe needs a new version here.
const KEY_LABEL: &[u8; 24] = b"echotank seabed tiles v1";

/// Row (north) and column (east) of a tile.
pub type TileId = (i32, i32);

/// How tiles are made.
#[derive(Clone, Debug)]
pub struct Recipe {
    surface: Surface,
    key: [u8; 32],
    cell_m: f64,
    /// Lambert's mu times the horizontal area of a cell.
    mu_area_m2: f64,
    speckle: bool,
}

/// Side of a tile, metres.
pub fn side_m(density_per_m2: f64) -> f64 {
    CELLS_ON_SIDE as f64 / density_per_m2.sqrt()
}

impl Recipe {
    pub fn new(surface: Surface, spec: &SeabedSpec, seed: u64) -> Self {
        debug_assert!(spec.density_per_m2 > 0.0 && spec.density_per_m2.is_finite());
        let mut key = [0; 32];
        key[..8].copy_from_slice(&seed.to_le_bytes());
        key[8..].copy_from_slice(KEY_LABEL);
        Self {
            surface,
            key,
            cell_m: 1.0 / spec.density_per_m2.sqrt(),
            mu_area_m2: libm::pow(10.0, spec.lambert_db / 10.0) / spec.density_per_m2,
            speckle: spec.speckle,
        }
    }

    pub fn surface(&self) -> &Surface {
        &self.surface
    }

    /// Edges of the `index`th tile along one side, metres from the scene's zero.
    fn edges_m(&self, index: i32) -> (f64, f64) {
        let edge = |i: f64| i * CELLS_ON_SIDE as f64 * self.cell_m;
        (edge(f64::from(index)), edge(f64::from(index) + 1.0))
    }

    /// The tile at a coordinate; the outermost where there is none.
    pub fn index_at(&self, coordinate_m: f64) -> i32 {
        (coordinate_m / (CELLS_ON_SIDE as f64 * self.cell_m)).floor() as i32
    }

    /// The box of a tile; none where it holds no seabed.
    pub fn bounds(&self, (row, col): TileId) -> Option<TileBox> {
        let (north, east) = (self.edges_m(row), self.edges_m(col));
        let down = self.surface.bounds_m(north, east)?;
        Some(TileBox {
            low_m: DVec3::new(north.0, east.0, down.0),
            high_m: DVec3::new(north.1, east.1, down.1),
        })
    }

    /// Fills `tile` with the scatterers of one tile, cell after cell eastward, then northward. Holes give none.
    pub fn make(&self, (row, col): TileId, tile: &mut Scatterers) {
        tile.clear();
        let mut rng = ChaCha8Rng::from_seed(self.key);
        rng.set_stream(u64::from(row as u32) << 32 | u64::from(col as u32));
        let first = |index: i32| f64::from(index) * CELLS_ON_SIDE as f64;
        for cell_north in 0..CELLS_ON_SIDE {
            for cell_east in 0..CELLS_ON_SIDE {
                // Four draws for every cell, used or not: holes, shape and speckle move nobody else's numbers.
                let [a, b, c, d] = std::array::from_fn(|_| uniform(&mut rng));
                let north_m = (first(row) + cell_north as f64 + a) * self.cell_m;
                let east_m = (first(col) + cell_east as f64 + b) * self.cell_m;
                let Some(depth) = self.surface.sample(north_m, east_m) else {
                    continue;
                };
                // Intensity goes with the area of the patch, not of its horizontal projection.
                let amplitude = (self.mu_area_m2 / depth.slope_cos()).sqrt();
                let reflectivity = match self.speckle {
                    true => circular_gaussian(c, d),
                    false => Complex64::ONE,
                };
                tile.push(
                    DVec3::new(north_m, east_m, depth.down_m),
                    depth.normal().map(|x| x as f32),
                    amplitude * reflectivity,
                    ScatterLaw::Lambert,
                );
            }
        }
    }
}

/// In 0 .. 1, from the upper 53 bits.
fn uniform(rng: &mut ChaCha8Rng) -> f64 {
    const STEP: f64 = 1.0 / (1_u64 << 53) as f64;
    (rng.next_u64() >> 11) as f64 * STEP
}

/// Box and Muller 1958: E|z|^2 = 1 and uniform phase from two numbers in 0 .. 1.
fn circular_gaussian(a: f64, b: f64) -> Complex64 {
    // 1 - a is never 0.
    let radius = (-libm::log(1.0 - a)).sqrt();
    let (sin, cos) = libm::sincos(std::f64::consts::TAU * b);
    Complex64::new(radius * cos, radius * sin)
}

/// A box that holds all scatterers of a tile.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct TileBox {
    pub low_m: DVec3,
    pub high_m: DVec3,
}

/// Boxes are grown by this, metres, so that rounding never leaves a scatterer outside its tile's box (coordinates up to 1e9 m).
const BOX_MARGIN_M: f64 = 1e-3;

impl TileBox {
    /// False only where no point of the box is in the footprint. `apex_m` is the footprint's apex in the box's coordinates.
    pub fn may_meet(&self, footprint: &Footprint, apex_m: DVec3) -> bool {
        let (low, high) = (self.low_m - BOX_MARGIN_M, self.high_m + BOX_MARGIN_M);
        let nearest_m = apex_m.clamp(low, high).distance(apex_m);
        if nearest_m > footprint.max_range_m {
            return false;
        }
        // |d . axis| is at least |centre . axis| less the box's half width along the axis, and |d| at most the farthest corner's.
        let center = (low + high) / 2.0 - apex_m;
        let half = (high - low) / 2.0;
        let least_along_m = center.dot(footprint.axis).abs() - half.dot(footprint.axis.abs());
        let farthest_m = (center.abs() + half).length().min(footprint.max_range_m);
        footprint.max_axis_sine >= 1.0 || least_along_m <= footprint.max_axis_sine * farthest_m
    }
}

/// Tiles kept for the next ping; the one not used for longest makes room. Allocates while it grows to its capacity, and not after.
#[derive(Debug)]
pub struct TilePool {
    capacity: usize,
    place: HashMap<TileId, usize>,
    ids: Vec<TileId>,
    tiles: Vec<Scatterers>,
    /// When each was last asked for, counted in questions.
    last_used: Vec<u64>,
    questions: u64,
}

impl TilePool {
    /// Room for `capacity` tiles, at least one.
    pub fn new(capacity: usize) -> Self {
        assert!(capacity > 0, "a pool without room");
        Self {
            capacity,
            place: HashMap::new(),
            ids: Vec::new(),
            tiles: Vec::new(),
            last_used: Vec::new(),
            questions: 0,
        }
    }

    /// The tile, and whether it had to be made.
    pub fn tile(&mut self, recipe: &Recipe, id: TileId) -> (&Scatterers, bool) {
        self.questions += 1;
        if let Some(&place) = self.place.get(&id) {
            self.last_used[place] = self.questions;
            return (&self.tiles[place], false);
        }
        let place = if self.tiles.len() < self.capacity {
            // An index at most half full tidies itself up in place, however often tiles come and go.
            self.place.reserve(self.tiles.len() + 2);
            self.ids.push(id);
            self.tiles.push(with_room_for_a_tile());
            self.last_used.push(self.questions);
            self.tiles.len() - 1
        } else {
            // Looking through all costs less than making one.
            let oldest = (0..self.capacity)
                .min_by_key(|i| self.last_used[*i])
                .unwrap_or(0);
            self.place.remove(&self.ids[oldest]);
            self.ids[oldest] = id;
            self.last_used[oldest] = self.questions;
            oldest
        };
        self.place.insert(id, place);
        recipe.make(id, &mut self.tiles[place]);
        (&self.tiles[place], true)
    }
}

fn with_room_for_a_tile() -> Scatterers {
    Scatterers {
        north_m: Vec::with_capacity(SCATTERERS_PER_TILE),
        east_m: Vec::with_capacity(SCATTERERS_PER_TILE),
        down_m: Vec::with_capacity(SCATTERERS_PER_TILE),
        normal: Vec::with_capacity(SCATTERERS_PER_TILE),
        strength: Vec::with_capacity(SCATTERERS_PER_TILE),
        law: Vec::with_capacity(SCATTERERS_PER_TILE),
    }
}

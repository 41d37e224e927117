//! Seabed shapes of Meng et al. 2023 as functions of position.
//!
//! The paper shows the shapes as pictures without dimensions. The dimensions below are chosen so that its sonars (400 kHz, 0.56 degrees, 30 m above
//! the bottom) see what the pictures show.
//!
//! | shape | paper | content |
//! |---|---|---|
//! | [`PaperShape::Curves`] | Fig. 6 | a level bottom with five parallel ridges along sine curves, 12 m apart |
//! | [`PaperShape::Relief`] | Fig. 12 | a level bottom with raised letters K and I, flat on top with round edges |
//! | [`PaperShape::Lake`] | Fig. 17 | a sloping lake bottom and an oblique bank; the piers are targets, `hil-configs/data/lake_piers.toml` |
//!
//! The bottom lies 30 m (the lake: 20 m) below the scene's origin, east of a northward track.

use std::f64::consts::TAU;
use std::ops::Range;

use glam::{DVec2, DVec3};

use super::piece::Piece;
use super::read::Depth;
use super::targets::random::KeyedRandom;
use echotank_config::spec::PaperShape;
use echotank_core::scene::{ScatterLaw, Scatterers};

/// Depth of the level bottoms, metres.
pub const DEPTH_M: f64 = 30.0;

// Fig. 6.
const CURVES: usize = 5;
const FIRST_CURVE_EAST_M: f64 = 20.0;
const CURVE_SPACING_M: f64 = 12.0;
/// Amplitude and wavelength of the sine curves, metres.
const CURVE_SWING_M: f64 = 2.0;
const CURVE_LENGTH_M: f64 = 20.0;
const RIDGE_HEIGHT_M: f64 = 1.0;
/// Standard deviation of the Gaussian cross-section.
const RIDGE_SIGMA_M: f64 = 0.35;

// Fig. 12.
const RELIEF_HEIGHT_M: f64 = 1.5;
/// Half width of the strokes at half their height, and the width of their edges.
const STROKE_HALF_M: f64 = 1.2;
const EDGE_M: f64 = 1.0;
/// Ends of the strokes (north, east): K, then I farther east.
const STROKES: [[DVec2; 2]; 4] = [
    [DVec2::new(3.0, 28.0), DVec2::new(17.0, 28.0)],
    [DVec2::new(10.0, 28.0), DVec2::new(17.0, 42.0)],
    [DVec2::new(10.0, 28.0), DVec2::new(3.0, 42.0)],
    [DVec2::new(3.0, 58.0), DVec2::new(17.0, 58.0)],
];

// Fig. 17.
const LAKE_DEPTH_M: f64 = 20.0;
/// Depth gradient eastward.
const LAKE_SLOPE: f64 = 0.06;
/// Easting of the bank's foot at north 0, and its change per metre northward.
const BANK_EAST_M: f64 = 55.0;
const BANK_OBLIQUE: f64 = 0.25;
const BANK_HEIGHT_M: f64 = 5.0;
const BANK_WIDTH_M: f64 = 10.0;

/// Step of the central differences. Their relative error is about 1e-9.
const STEP_M: f64 = 1e-4;

/// Depth and slope at a position in scene coordinates, metres; none for coordinates that are not finite.
pub fn sample(shape: PaperShape, north_m: f64, east_m: f64) -> Option<Depth> {
    if !(north_m.is_finite() && east_m.is_finite()) {
        return None;
    }
    let down = |n: f64, e: f64| down_m(shape, n, e);
    Some(Depth {
        down_m: down(north_m, east_m),
        slope_north: (down(north_m + STEP_M, east_m) - down(north_m - STEP_M, east_m))
            / (2.0 * STEP_M),
        slope_east: (down(north_m, east_m + STEP_M) - down(north_m, east_m - STEP_M))
            / (2.0 * STEP_M),
    })
}

/// Bounds of the depth over a strip of eastings, metres; may be wider than necessary.
pub(crate) fn bounds_m(shape: PaperShape, east_m: (f64, f64)) -> (f64, f64) {
    match shape {
        PaperShape::Curves => (DEPTH_M - RIDGE_HEIGHT_M, DEPTH_M),
        PaperShape::Relief => (DEPTH_M - RELIEF_HEIGHT_M, DEPTH_M),
        PaperShape::Lake => (
            lake_slope_m(east_m.0) - BANK_HEIGHT_M,
            lake_slope_m(east_m.1),
        ),
    }
}

/// Step of [`profile`], metres: a third of the narrowest feature. The quadratic pieces follow the features within a millimetre.
const PIECE_M: f64 = 0.1;

/// Pieces of the surface along a ray; see `Surface::profile`.
pub(super) fn profile(
    shape: PaperShape,
    from_m: DVec2,
    along: DVec2,
    stretch_m: Range<f64>,
    mut piece: impl FnMut(Piece),
) {
    let mut here_m = stretch_m.start;
    while here_m < stretch_m.end {
        let next_m = (here_m + PIECE_M).min(stretch_m.end);
        let at = Piece::AT.map(|share| {
            let place_m = from_m + along * (here_m + share * (next_m - here_m));
            down_m(shape, place_m.x, place_m.y)
        });
        piece(Piece::through(here_m, next_m, at));
        here_m = next_m;
    }
}

fn down_m(shape: PaperShape, north_m: f64, east_m: f64) -> f64 {
    match shape {
        PaperShape::Curves => {
            let swing_m = CURVE_SWING_M * libm::sin(TAU * north_m / CURVE_LENGTH_M);
            let height_m: f64 = (0..CURVES)
                .map(|k| {
                    let crest_m = FIRST_CURVE_EAST_M + k as f64 * CURVE_SPACING_M + swing_m;
                    let across = (east_m - crest_m) / RIDGE_SIGMA_M;
                    libm::exp(-0.5 * across * across)
                })
                .sum();
            DEPTH_M - RIDGE_HEIGHT_M * height_m
        }
        PaperShape::Relief => {
            let at = DVec2::new(north_m, east_m);
            let from_stroke_m = STROKES
                .iter()
                .map(|[a, b]| {
                    let along = ((at - a).dot(b - a) / a.distance_squared(*b)).clamp(0.0, 1.0);
                    at.distance(a.lerp(*b, along))
                })
                .fold(f64::INFINITY, f64::min);
            let outside = (from_stroke_m - STROKE_HALF_M) / EDGE_M + 0.5;
            DEPTH_M - RELIEF_HEIGHT_M * (1.0 - smooth(outside))
        }
        PaperShape::Lake => {
            let foot_m = BANK_EAST_M + BANK_OBLIQUE * north_m;
            let bank_m = BANK_HEIGHT_M * smooth((east_m - foot_m) / BANK_WIDTH_M);
            lake_slope_m(east_m) - bank_m
        }
    }
}

fn lake_slope_m(east_m: f64) -> f64 {
    LAKE_DEPTH_M + LAKE_SLOPE * east_m
}

/// Smooth step from 0 to 1 with continuous curvature (Perlin 2002).
fn smooth(x: f64) -> f64 {
    let x = x.clamp(0.0, 1.0);
    x * x * x * (x * (6.0 * x - 15.0) + 10.0)
}

// Point cloud of Figs. 12-16.

/// Number of points of the paper's original model.
pub(crate) const CLOUD_POINTS: usize = 42_936;
/// Rows (northward) and columns (eastward) of the lattice. It has 144 cells more than points; the last row lacks them.
const CLOUD_ROWS: usize = 120;
const CLOUD_COLS: usize = 359;
/// Area: 20 m along the track, from 15 to 75 m to its side.
pub(crate) const CLOUD_NORTH_M: (f64, f64) = (0.0, 20.0);
pub(crate) const CLOUD_EAST_M: (f64, f64) = (15.0, 75.0);
/// Jitter of a point about its cell's middle, as a share of the cell's side. It is below one half, so that no triangle folds.
const CLOUD_JITTER: f64 = 0.49;

/// Separates these random numbers from other uses of the seed.
const KEY_LABEL: &[u8; 24] = b"echotank paper cloud v01";

/// A bottom as scatterers with a triangulation.
#[derive(Clone, Debug)]
pub struct Cloud {
    /// Scatterers in scene coordinates.
    pub scatterers: Scatterers,
    /// Triangles as indices of scatterers.
    pub triangles: Vec<[u32; 3]>,
}

/// Samples a shape with 42,936 scatterers, evenly distributed in the horizontal plane.
///
/// `seed` determines positions, `speckle_seed` the circular Gaussian reflectivities. `lambert_db` is Lambert's mu, dB. The shape and the size follow
/// Meng et al. 2023, Figs. 12-16.
pub fn cloud(shape: PaperShape, seed: u64, speckle_seed: u64, lambert_db: f64) -> Cloud {
    let (height_m, width_m) = (
        CLOUD_NORTH_M.1 - CLOUD_NORTH_M.0,
        CLOUD_EAST_M.1 - CLOUD_EAST_M.0,
    );
    let (row_m, col_m) = (height_m / CLOUD_ROWS as f64, width_m / CLOUD_COLS as f64);
    let mu_area_m2 = libm::pow(10.0, lambert_db / 10.0) * row_m * col_m;
    let mut place = KeyedRandom::new(seed, KEY_LABEL, 0);
    let mut speckle = KeyedRandom::new(speckle_seed, KEY_LABEL, 1);
    let mut scatterers = Scatterers::default();
    for cell in 0..CLOUD_POINTS {
        let mut inside = |k: usize| k as f64 + 0.5 + CLOUD_JITTER * (2.0 * place.uniform() - 1.0);
        let north_m = CLOUD_NORTH_M.0 + row_m * inside(cell / CLOUD_COLS);
        let east_m = CLOUD_EAST_M.0 + col_m * inside(cell % CLOUD_COLS);
        let Some(depth) = sample(shape, north_m, east_m) else {
            continue;
        };
        let amplitude = (mu_area_m2 / depth.slope_cos()).sqrt();
        scatterers.push(
            DVec3::new(north_m, east_m, depth.down_m),
            depth.normal().map(|x| x as f32),
            amplitude * speckle.circular_gaussian(),
            ScatterLaw::Lambert,
        );
    }
    Cloud {
        triangles: lattice_triangles(&scatterers),
        scatterers,
    }
}

/// Two triangles for every four neighbours of the lattice, split along the shorter diagonal.
fn lattice_triangles(s: &Scatterers) -> Vec<[u32; 3]> {
    let mut triangles = Vec::with_capacity(2 * CLOUD_POINTS);
    for row in 0..CLOUD_ROWS - 1 {
        for col in 0..CLOUD_COLS - 1 {
            let at = |r: usize, c: usize| (r * CLOUD_COLS + c) as u32;
            let (sw, se) = (at(row, col), at(row, col + 1));
            let (nw, ne) = (at(row + 1, col), at(row + 1, col + 1));
            let place = |i: u32| s.position_m(i as usize);
            if ne as usize >= s.len() {
                continue;
            }
            if place(sw).distance_squared(place(ne)) <= place(se).distance_squared(place(nw)) {
                triangles.extend([[sw, se, ne], [sw, ne, nw]]);
            } else {
                triangles.extend([[sw, se, nw], [se, ne, nw]]);
            }
        }
    }
    triangles
}

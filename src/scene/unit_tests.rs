//! Tests of the scene as a whole. Readers have tests in their own files.

use std::f64::consts::{PI, TAU};
use std::path::{Path, PathBuf};

use glam::{DVec2, DVec3};
use num_complex::Complex64;
use proptest::prelude::*;

use super::pool::TilePool;
use super::read::HeightField;
use super::seabed::Surface;
use super::thinning::{self, KeepProbability};
use super::tiles::{
    CELLS_PER_BLOCK, Levels, Recipe, SCATTERERS_PER_TILE, TILE_BYTES, Tile, TileId, places_in_order,
};
use super::{Files, Scene, SceneError};
use echotank_config::spec::{
    AnchorSpec, BottomSpec, CrsSpec, Density, HeightSign, IncidenceSpec, MosaicSpec, MosaicValues,
    OcclusionSpec, SceneSpec, SeabedFileSpec, SeabedShape, SeabedSpec, Sediment,
};
use echotank_core::ping::SceneCounts;
use echotank_core::scene::{
    BaffledFace, Footprint, PatternSide, ResolutionCell, ScatterLaw, Scatterers,
};

/// The file system, as the runtime passes it.
pub(crate) struct Disk;

impl Files for Disk {
    fn open(&self, path: &Path) -> std::io::Result<Box<dyn std::io::Read>> {
        Ok(Box::new(std::fs::File::open(path)?))
    }
}

const FLAT: SeabedShape = SeabedShape::Plane {
    depth_m: 50.0,
    slope_north: 0.0,
    slope_east: 0.0,
};
/// dB.
const MU: f64 = -27.0;

pub(crate) fn seabed(shape: SeabedShape, density_per_m2: f64, speckle: bool) -> SeabedSpec {
    SeabedSpec {
        shape,
        density: Density::PerM2(density_per_m2),
        bottom: BottomSpec::BistaticLambert { mu_db: MU },
        incidence: IncidenceSpec::Normal,
        mosaic: None,
        speckle,
    }
}

pub(crate) fn spec(seabed: Option<SeabedSpec>, tiles: u64) -> SceneSpec {
    SceneSpec {
        seed: 42,
        anchor: AnchorSpec::FirstFix,
        mirror: false,
        seabed,
        points: None,
        targets: None,
        occlusion: OcclusionSpec::Horizon,
        memory_limit_bytes: tiles * TILE_BYTES,
        simplify: None,
    }
}

/// The recipe of a seabed's own surface.
fn recipe(seabed: &SeabedSpec, seed: u64) -> Recipe {
    let surface = Surface::open(&Disk, &seabed.shape, false, 1.0).unwrap();
    Recipe::new(surface, seabed, seed)
}

/// What a scene gathers in one footprint, and its counts.
fn gathered(spec: &SceneSpec, footprint: Footprint) -> (Scatterers, SceneCounts) {
    let mut out = Scatterers::default();
    let counts = Scene::open(&Disk, spec)
        .unwrap()
        .gather(&[footprint], &mut out);
    (out, counts)
}

fn plane_recipe(slope_north: f64, slope_east: f64, density_per_m2: f64, speckle: bool) -> Recipe {
    let shape = SeabedShape::Plane {
        depth_m: 50.0,
        slope_north,
        slope_east,
    };
    recipe(&seabed(shape, density_per_m2, speckle), 42)
}

fn id((row, col): (i64, i64)) -> TileId {
    TileId { level: 0, row, col }
}

/// All scatterers of a tile, holes left out.
struct Whole {
    place_m: Vec<DVec3>,
    strength: Vec<Complex64>,
    normal: Vec<[f32; 3]>,
    rank: Vec<f32>,
}

impl Whole {
    fn make(recipe: &Recipe, id: TileId, tile: &mut Tile) -> Self {
        for block in 0..super::tiles::BLOCKS_PER_TILE {
            let made = recipe.make(id, block, f64::INFINITY, tile);
            assert_eq!(made.0, super::tiles::CELLS_PER_BLOCK);
        }
        let rows = 0..super::tiles::SCATTERERS_PER_TILE;
        let rows: Vec<usize> = rows.filter(|i| !tile.down_m[*i].is_nan()).collect();
        let strength = |i: usize| {
            let s = tile.strength[i];
            Complex64::new(s.re.into(), s.im.into())
        };
        Self {
            place_m: rows.iter().map(|i| tile.position_m(*i)).collect(),
            strength: rows.iter().map(|i| strength(*i)).collect(),
            normal: rows.iter().map(|i| tile.normal(*i)).collect(),
            rank: rows.iter().map(|i| tile.rank[*i]).collect(),
        }
    }

    fn len(&self) -> usize {
        self.place_m.len()
    }

    fn position_m(&self, i: usize) -> DVec3 {
        self.place_m[i]
    }
}

fn make_id(recipe: &Recipe, id: TileId) -> Whole {
    let mut tile = Tile::without_room();
    recipe.start(id, &mut tile);
    Whole::make(recipe, id, &mut tile)
}

fn make(recipe: &Recipe, at: (i64, i64)) -> Whole {
    make_id(recipe, id(at))
}

fn side_m(density_per_m2: f64) -> f64 {
    Levels::new(&Density::PerM2(density_per_m2)).tile_m(0).x
}

fn strengths(tile: &Whole) -> impl Iterator<Item = Complex64> {
    tile.strength.iter().copied()
}

fn all_round(apex_m: DVec3, max_range_m: f64) -> Footprint {
    Footprint::all_round(apex_m, max_range_m)
}

type Bits = Vec<[u64; 5]>;

fn bits_of(at_m: DVec3, strength: Complex64) -> [u64; 5] {
    [at_m.x, at_m.y, at_m.z, strength.re, strength.im].map(f64::to_bits)
}

fn bits(s: &Scatterers) -> Bits {
    (0..s.len())
        .map(|i| bits_of(s.position_m(i), s.strength[i]))
        .collect()
}

fn tile_bits(tile: &Whole) -> Bits {
    strengths(tile)
        .enumerate()
        .map(|(i, strength)| bits_of(tile.position_m(i), strength))
        .collect()
}

/// Sorts lists that were made in different orders.
fn sorted(mut bits: Bits) -> Bits {
    bits.sort();
    bits
}

/// A grid of the given heights (northern row first) with 2 m cells.
fn grid(rows: usize, cols: usize, heights: &[f64]) -> HeightField {
    let value = |h: &f64| if *h == -9999.0 { f32::NAN } else { *h as f32 };
    HeightField {
        rows,
        cols,
        cell_north_m: 2.0,
        cell_east_m: 2.0,
        south_m: 1.0 - rows as f64,
        west_m: 1.0 - cols as f64,
        down_m: heights
            .chunks(cols)
            .rev()
            .flat_map(|row| row.iter().map(value))
            .collect(),
    }
}

/// A seabed from a file with its middle at the scene's origin.
pub(crate) fn surveyed(path: PathBuf) -> SeabedShape {
    SeabedShape::File {
        file: SeabedFileSpec::of(path),
        offset_north_m: 0.0,
        offset_east_m: 0.0,
    }
}

/// Rough but reproducible heights: multiples of the golden ratio.
fn rough(rows: usize, cols: usize) -> Vec<f64> {
    (0..rows * cols)
        .map(|i| 40.0 + 5.0 * (i as f64 * 0.618_033_988_749_895).fract())
        .collect()
}

// The generator

/// Values of an independent calculation: Philox 4x32-10 after Salmon et al. 2011, in double precision.
#[test]
fn a_tile_equals_an_independent_calculation_from_the_counter_up() {
    let tile = make(&plane_recipe(0.1, -0.2, 4.0, true), (-3, 5));
    for (i, north, east, down, re, im) in [
        (
            0,
            -47.54981681879144,
            80.47614950372372,
            29.14978841737611,
            -0.024020358841567013,
            -0.0002671544120588489,
        ),
        (
            1,
            -47.95539595268201,
            80.72313598461915,
            29.059833207807966,
            0.0184666207225399,
            -0.011515826882138631,
        ),
        (
            21, // the first row's eighth
            -47.90157032595016,
            83.89568225946277,
            28.430706515512426,
            0.011677412509702025,
            -0.006073603458321611,
        ),
        (
            26, // the fourth row's fifth
            -46.25174694729503,
            82.4470168191474,
            28.88542194144102,
            0.03181422686989878,
            -0.01377684166942741,
        ),
    ] {
        let moved = tile.position_m(i).distance(DVec3::new(north, east, down));
        let strength = strengths(&tile).nth(i).unwrap();
        let changed = (strength - Complex64::new(re, im)).norm();
        // Positions and strengths are single precision: 1e-6 of 8 m and of 0.02.
        assert!(
            moved < 2e-6 && changed < 2e-8,
            "scatterer {i}: {moved:e} m, {changed:e}"
        );
    }
}

#[test]
fn a_tile_has_the_same_bits_after_eviction_and_in_any_order() {
    let recipe = plane_recipe(0.05, 0.02, 4.0, true);
    let ids: Vec<TileId> = (-2..2)
        .flat_map(|r| (-3..1).map(move |c| id((r, c))))
        .collect();
    let fresh: Vec<Bits> = ids
        .iter()
        .map(|id| tile_bits(&make_id(&recipe, *id)))
        .collect();
    for (i, a) in fresh.iter().enumerate() {
        assert!(fresh[..i].iter().all(|b| a != b), "no two tiles are alike");
    }
    for capacity in [1, 3, 16] {
        let mut pool = TilePool::new(capacity);
        let mut made = 0;
        // Forward, backward, and with a stride that visits all 16 in another order.
        let order = (0..16)
            .chain((0..16).rev())
            .chain((0..16).map(|i| i * 7 % 16));
        for i in order {
            let (tile, new) = requested(&mut pool, &recipe, &[ids[i]]).remove(0);
            assert_eq!(tile, fresh[i], "tile {:?}, room for {capacity}", ids[i]);
            made += usize::from(new);
        }
        println!("room for {capacity}: {made} made for 48 questions");
        assert_eq!(made == 16, capacity == 16, "only a large pool keeps all");
    }
}

/// Requests tiles from a pool. Returns their content and whether each had to be made.
fn requested(pool: &mut TilePool, recipe: &Recipe, ids: &[TileId]) -> Vec<(Bits, bool)> {
    let mut places = Vec::new();
    pool.slots(ids.iter().copied(), &mut places);
    places
        .iter()
        .map(|place| {
            (
                pool.work(place, recipe, |tile| {
                    tile_bits(&Whole::make(recipe, place.id, tile))
                }),
                place.stale,
            )
        })
        .collect()
}

#[test]
fn the_least_recently_used_tile_is_replaced() {
    let recipe = plane_recipe(0.0, 0.0, 4.0, true);
    let mut pool = TilePool::new(2);
    let mut made = |at| requested(&mut pool, &recipe, &[id(at)])[0].1;
    assert!(made((0, 0)) && made((0, 1)));
    assert!(!made((0, 0)), "still there");
    assert!(made((0, 2)), "takes the room of (0, 1)");
    assert!(!made((0, 0)), "used since (0, 1)");
    assert!(made((0, 1)));
    // Of two tiles requested together, the present one is not replaced by the other, whatever the order.
    let both = requested(&mut pool, &recipe, &[id((5, 5)), id((0, 0))]);
    assert_eq!((both[0].1, both[1].1), (true, false));
}

#[test]
fn a_tile_that_no_request_used_for_a_while_is_replaced_before_the_pool_is_full() {
    let recipe = plane_recipe(0.0, 0.0, 4.0, true);
    let mut pool = TilePool::new(1000);
    // A platform that moves on: each tile is used by three requests.
    for step in 0..200 {
        let group = [step, step + 1, step + 2].map(|row| id((row, 0)));
        for (id, (got, _)) in group.iter().zip(requested(&mut pool, &recipe, &group)) {
            assert_eq!(
                got,
                tile_bits(&make_id(&recipe, *id)),
                "step {step}, {id:?}"
            );
        }
    }
    println!("{} tiles in memory", pool.len());
    assert!((10..30).contains(&pool.len()), "{}", pool.len());
    // One that stays, and one that goes round, each at every third request.
    let mut made = 0;
    for step in 0..60 {
        let group = [id((0, 1)), id((step % 3, 2))];
        let all = requested(&mut pool, &recipe, &group);
        made += all.iter().filter(|(_, new)| *new).count();
    }
    assert_eq!(made, 4);
}

#[test]
fn a_full_pool_returns_the_right_tiles() {
    let recipe = plane_recipe(0.0, 0.0, 4.0, true);
    let mut pool = TilePool::new(7);
    // A walk over a torus of 11 x 5 tiles in groups of up to 7 that overlap.
    for step in 0..200_i64 {
        let group: Vec<TileId> = (0..=step % 7)
            .map(|k| id(((step * 3 + k) % 11, (step + 2 * k) % 5)))
            .collect();
        for (id, (got, _)) in group.iter().zip(requested(&mut pool, &recipe, &group)) {
            assert_eq!(
                got,
                tile_bits(&make_id(&recipe, *id)),
                "step {step}, {id:?}"
            );
        }
    }
}

#[test]
fn seeds_give_different_tiles() {
    let with = |seed, id| tile_bits(&make(&recipe(&seabed(FLAT, 4.0, true), seed), id));
    assert_ne!(with(1, (0, 0)), with(2, (0, 0)));
    assert_eq!(with(1, (0, 0)), with(1, (0, 0)));
}

/// Scatterers of 10 x 10 tiles.
fn places_of_level(recipe: &Recipe, level: u32) -> Vec<DVec3> {
    (0..10)
        .flat_map(|row| (0..10).map(move |col| TileId { level, row, col }))
        .map(|id| make_id(recipe, id))
        .flat_map(|t| (0..t.len()).map(|i| t.position_m(i)).collect::<Vec<_>>())
        .collect()
}

/// Structure factor |sum exp(i k.x)|^2 / N at k = 2 pi (p, q) / cell.
fn structure_db(places: &[DVec3], cell_m: DVec2, p: f64, q: f64) -> f64 {
    let sum: Complex64 = places
        .iter()
        .map(|at| Complex64::cis(TAU * (p * at.x / cell_m.x + q * at.y / cell_m.y)))
        .sum();
    10.0 * (sum.norm_sqr() / places.len() as f64).log10()
}

#[test]
fn the_pattern_has_no_bragg_lines_where_a_half_jittered_lattice_has() {
    // Structure factor |sum exp(i k.x)|^2 / N over 10 x 10 tiles. For random positions its mean is 1, and it exceeds 10 dB once in 22 000. A lattice
    // jittered over half its cell has N sinc^2(1/2), here 46 dB.
    const LIMIT_DB: f64 = 10.0;
    let recipe = plane_recipe(0.0, 0.0, 4.0, true);
    let cell_m = DVec2::splat(0.5);
    let places = places_of_level(&recipe, 0);
    let half_jittered: Vec<DVec3> = places
        .iter()
        .map(|at| {
            let cell = (at / cell_m.x).floor();
            (cell + 0.5 * (at / cell_m.x - cell)) * cell_m.x
        })
        .collect();
    for (p, q) in [
        (1.0, 0.0),
        (0.0, 1.0),
        (1.0, 1.0),
        (1.0, -1.0),
        (2.0, 0.0),
        (0.0, 2.0),
        (2.0, 1.0),
        // The lattice of the tiles.
        (1.0 / 32.0, 0.0),
        (0.0, 1.0 / 32.0),
        (3.0 / 32.0, 2.0 / 32.0),
    ] {
        let got_db = structure_db(&places, cell_m, p, q);
        println!("k = ({p}, {q}) / cell: {got_db:.1} dB");
        assert!(got_db < LIMIT_DB, "a line of {got_db:.1} dB at ({p}, {q})");
    }
    let control_db = structure_db(&half_jittered, cell_m, 1.0, 0.0);
    assert!(
        control_db > 40.0,
        "the half jittered lattice shows only {control_db:.1} dB"
    );
}

#[test]
fn every_tile_of_a_plane_holds_its_area_times_the_density_and_scatterers_stay_inside() {
    for density in [0.25, 3.0, 40.0] {
        let recipe = plane_recipe(0.1, 0.0, density, true);
        for at in [(0, 0), (-1, 4), (1000, -1000)] {
            let tile = make(&recipe, at);
            let b = recipe.bounds(id(at)).unwrap();
            let area_m2 = (b.high_m.x - b.low_m.x) * (b.high_m.y - b.low_m.y);
            let want = area_m2 * density;
            assert!(
                (tile.len() as f64 - want).abs() < 1e-6 * want,
                "{} against {want}",
                tile.len()
            );
            for i in 0..tile.len() {
                let p = tile.position_m(i);
                assert!(
                    p.cmpge(b.low_m - 1e-4).all() && p.cmple(b.high_m + 1e-4).all(),
                    "{p} outside {b:?}"
                );
            }
        }
    }
}

#[test]
fn a_footprints_count_is_density_times_its_area() {
    // A slant range of 120 m over 50 m of water is a circle. Only the cells on its rim are uncertain (standard deviation below 1/2 each).
    let radius_m = (120.0_f64.powi(2) - 50.0_f64.powi(2)).sqrt();
    let footprint = all_round(DVec3::new(3.0, -7.0, 0.0), 120.0);
    let (out, counts) = gathered(&spec(Some(seabed(FLAT, 4.0, true)), 400), footprint);
    let want = 4.0 * PI * radius_m * radius_m;
    let rim_cells = 2.0 * 4.0 * radius_m / 0.5;
    let sigma = 0.5 * rim_cells.sqrt();
    println!("{} against {want:.0} +- {sigma:.0}", out.len());
    assert!(
        (out.len() as f64 - want).abs() < 4.0 * sigma,
        "{} against {want}",
        out.len()
    );
    assert_eq!(counts.scatterers, out.len() as u64);
}

/// Sum of |strength|^2 over a square of tiles, and the number of scatterers.
fn intensity(recipe: &Recipe, level: u32, tiles: i64) -> (f64, usize) {
    let ids = (0..tiles).flat_map(|row| (0..tiles).map(move |col| TileId { level, row, col }));
    let made = ids.map(|id| make_id(recipe, id));
    made.fold((0.0, 0), |(sum, count), tile| {
        let own: f64 = strengths(&tile).map(|s| s.norm_sqr()).sum();
        (sum + own, count + tile.len())
    })
}

#[test]
fn the_mean_intensity_does_not_depend_on_the_density() {
    // Sum |strength|^2 over a slope of 20 degrees against mu times its true area. Each |r|^2 is exponential with mean 1, so the relative standard
    // error of the sum is 1/sqrt(N). Four of them are allowed.
    let slope = 20.0_f64.to_radians().tan();
    let mu = 10.0_f64.powf(MU / 10.0);
    for (density, tiles) in [(0.25, 2), (4.0, 8), (64.0, 32)] {
        let recipe = plane_recipe(slope, 0.0, density, true);
        let (sum, count) = intensity(&recipe, 0, tiles);
        let side_m = tiles as f64 * side_m(density);
        let want = mu * side_m * side_m / 20.0_f64.to_radians().cos();
        let (error, allowed) = (sum / want - 1.0, 4.0 / (count as f64).sqrt());
        println!(
            "{density} per m2: {side_m} m, {count} scatterers, off by {error:+.4}, allowed {allowed:.4}"
        );
        assert!(
            error.abs() < allowed,
            "{density} per m2: off by {error:+.4}, allowed {allowed:.4}"
        );
    }
}

#[test]
fn without_speckle_every_strength_is_the_root_of_mu_times_the_patch() {
    let tile = make(&plane_recipe(0.3, -0.4, 2.0, false), (7, 7));
    let want = (10.0_f64.powf(MU / 10.0) * 0.5 * 1.25_f64.sqrt()).sqrt();
    for s in strengths(&tile) {
        assert!((s - want).norm() < 1e-7 * want, "{s} against {want}");
    }
    let noisy = make(&plane_recipe(0.3, -0.4, 2.0, true), (7, 7));
    assert_eq!(noisy.place_m, tile.place_m, "speckle moves nothing");
}

/// Kolmogorov-Smirnov statistic sqrt(n) D against a distribution function.
fn smirnov(mut values: Vec<f64>, distribution: impl Fn(f64) -> f64) -> f64 {
    values.sort_by(f64::total_cmp);
    let n = values.len() as f64;
    let distance = values.iter().enumerate().fold(0.0_f64, |worst, (i, x)| {
        let f = distribution(*x);
        worst
            .max((f - i as f64 / n).abs())
            .max((f - (i as f64 + 1.0) / n).abs())
    });
    n.sqrt() * distance
}

#[test]
fn reflectivities_are_rayleigh_in_amplitude_and_uniform_in_phase() {
    // p = 0.01 (Smirnov 1948).
    const CRITICAL: f64 = 1.628;
    let recipe = plane_recipe(0.0, 0.0, 4.0, true);
    let scale = (10.0_f64.powf(MU / 10.0) / 4.0).sqrt();
    let mut r = Vec::new();
    for col in 0..50 {
        r.extend(strengths(&make(&recipe, (0, col))).map(|s| s / scale));
    }
    let amplitude = smirnov(r.iter().map(|z| z.norm()).collect(), |a| {
        1.0 - (-a * a).exp()
    });
    let phase = smirnov(r.iter().map(|z| z.arg()).collect(), |p| (p + PI) / TAU);
    println!(
        "{} draws: amplitude {amplitude:.3}, phase {phase:.3}",
        r.len()
    );
    assert!(
        amplitude < CRITICAL && phase < CRITICAL,
        "{amplitude} {phase}"
    );
    // The statistic is sensitive: a mean intensity 5 % off fails.
    let off = smirnov(r.iter().map(|z| z.norm()).collect(), |a| {
        1.0 - (-a * a / 1.05).exp()
    });
    assert!(off > 2.0 * CRITICAL, "{off}");
}

#[test]
fn normals_are_perpendicular_to_the_plane_and_point_up() {
    let (slope_north, slope_east) = (0.25, -0.6);
    let tile = make(&plane_recipe(slope_north, slope_east, 4.0, true), (2, -2));
    for normal in &tile.normal {
        let n = DVec3::from(normal.map(f64::from));
        assert!(n.z < 0.0, "up is negative down");
        assert!((n.length() - 1.0).abs() < 1e-6, "unit: {}", n.length());
        for along in [
            DVec3::new(1.0, 0.0, slope_north),
            DVec3::new(0.0, 1.0, slope_east),
        ] {
            assert!(n.dot(along).abs() < 1e-6, "{n} against {along}");
        }
    }
    assert_eq!(
        plane_recipe(0.0, 0.0, 1.0, true).bottom().law,
        ScatterLaw::Lambert
    );
}

// Surfaces

#[test]
fn the_mirrored_surface_is_continuous_over_its_seams_and_periodic() {
    // 5 x 6 cells of 2 m: seams at +-4 m north and +-5 m east, moved by the offset.
    let surface = Surface::from_grid(grid(5, 6, &rough(5, 6)), true, 1.0, -2.0, 3.0);
    let at = |n, e| surface.sample(n, e).unwrap();
    for east in [-30.3, -2.2, 0.1, 17.9] {
        for seam in [5.0, -3.0, 13.0, -11.0] {
            for d in [1e-9, 0.3, 1.7] {
                let (below, above) = (at(seam - d, east), at(seam + d, east));
                assert!(
                    (below.down_m - above.down_m).abs() < 1e-12,
                    "seam {seam}, {d} m aside: {below:?} {above:?}"
                );
                assert!((below.slope_north + above.slope_north).abs() < 1e-12);
                assert!((below.slope_east - above.slope_east).abs() < 1e-9);
            }
        }
    }
    // Along an oblique path no step is steeper than the steepest slope of cells that differ by 5 m in depth over 2 m.
    let mut last = at(-100.0, -100.0).down_m;
    for i in 1..40_000 {
        let (n, e) = (-100.0 + 0.005 * f64::from(i), -100.0 + 0.003 * f64::from(i));
        let now = at(n, e).down_m;
        assert!(
            (now - last).abs() <= 2.5 * 0.008 + 1e-12,
            "a step of {} at {n} {e}",
            now - last
        );
        last = now;
    }
    for (n, e) in [(0.3, 0.4), (-2.9, -6.9)] {
        let far = at(n + 16.0 * 1000.0, e - 20.0 * 999.0);
        assert!((far.down_m - at(n, e).down_m).abs() < 1e-9);
    }
}

#[test]
fn the_speckle_is_not_mirrored_with_the_surface() {
    let surface = Surface::from_grid(grid(5, 6, &rough(5, 6)), true, 0.0, 0.0, 16.0);
    let recipe = Recipe::new(surface, &seabed(FLAT, 4.0, true), 42);
    // The seam north = 4 m lies inside tile (0, 0).
    let tile = make(&recipe, (0, 0));
    assert_eq!(tile.len(), SCATTERERS_PER_TILE);
    for i in 0..tile.len() {
        let at = tile.position_m(i);
        let image = DVec3::new(8.0 - at.x, at.y, at.z);
        let twin = (0..tile.len()).find(|j| tile.position_m(*j).distance(image) < 1e-3 && *j != i);
        assert_eq!(twin, None, "scatterer {i} has a mirror image");
    }
}

#[test]
fn without_mirror_the_seabed_ends_at_the_outer_centres_and_holes_yield_nothing() {
    let mut heights = rough(30, 40);
    for row in 10..20 {
        heights[row * 40 + 5..row * 40 + 25].fill(-9999.0);
    }
    let surface = Surface::from_grid(grid(30, 40, &heights), false, 0.0, 0.0, 16.0);
    assert!(surface.sample(29.0, 39.0).is_some() && surface.sample(-29.0, -39.0).is_some());
    assert!(surface.sample(29.1, 0.0).is_none() && surface.sample(0.0, -39.1).is_none());
    assert!(surface.sample(0.0, -10.0).is_none(), "the hole");
    let recipe = Recipe::new(surface, &seabed(FLAT, 4.0, true), 42);
    assert_eq!(recipe.bounds(id((5, 0))), None, "beyond the end");
    let (mut count, mut inside) = (0, 0);
    for row in -3..3 {
        for col in -4..4 {
            let tile = make(&recipe, (row, col));
            count += tile.len();
            for i in 0..tile.len() {
                let (n, e) = (tile.position_m(i).x, tile.position_m(i).y);
                inside += usize::from(n.abs() <= 29.0 + 1e-5 && e.abs() <= 39.0 + 1e-5);
                // Rows 10..20 and columns 5..25 of centres, and the squares around them, from north 29 and east -39.
                let hole =
                    n > -11.0 + 1e-5 && n < 11.0 - 1e-5 && e > -31.0 + 1e-5 && e < 11.0 - 1e-5;
                assert!(!hole, "a scatterer in the hole at {n} {e}");
            }
        }
    }
    assert_eq!(inside, count);
    // The edges of the grid and of the hole coincide with edges of cells, so the count is exact.
    assert_eq!(count, 4 * (58 * 78 - 22 * 42));
}

proptest! {
    #[test]
    fn a_tiles_box_holds_its_scatterers_on_any_grid(
        rows in 2usize..12, cols in 2usize..12, density in 0.05..20.0_f64, mirror: bool,
        holes in prop::collection::vec(0usize..144, 0..20), row in -6i64..6, col in -6i64..6,
        offset in -30.0..30.0_f64,
    ) {
        let mut heights = rough(rows, cols);
        for hole in holes {
            let count = heights.len();
            heights[hole % count] = -9999.0;
        }
        let block_m = side_m(density);
        let surface = Surface::from_grid(grid(rows, cols, &heights), mirror, offset, -offset, block_m);
        let recipe = Recipe::new(surface, &seabed(FLAT, density, true), 1);
        let tile = make(&recipe, (row, col));
        match recipe.bounds(id((row, col))) {
            None => prop_assert!(tile.len() == 0),
            Some(b) => for i in 0..tile.len() {
                let p = tile.position_m(i);
                prop_assert!(p.cmpge(b.low_m - 1e-4).all() && p.cmple(b.high_m + 1e-4).all(), "{} outside {:?}", p, b);
            },
        }
    }
}

#[test]
fn the_recorded_seabed_has_the_depths_of_an_independent_read() {
    let path = PathBuf::from(concat!(env!("CARGO_MANIFEST_DIR"), "/../.."))
        .join("hil-configs/data/jd211_crop_400x400_2m.asc");
    let shape = surveyed(path);
    let mut scene = Scene::open(&Disk, &spec(Some(seabed(shape, 4.0, true)), 10)).unwrap();
    /// Half the resolution of f32 depths, metres.
    const F32_AT_52_M: f64 = 2e-6;
    // Metres from the grid's centre, and depth, read and interpolated by an independent script. The first six are cell centres.
    let places = [
        (-399.0, -399.0, 51.623),
        (399.0, -399.0, 51.594),
        (399.0, 399.0, 51.959),
        (-399.0, 399.0, 51.634),
        (1.0, 1.0, 51.422),
        (-101.0, 33.0, 51.340),
        (0.0, 0.0, 51.422),
        (123.4, -56.7, 51.479_53),
        (-250.25, 310.6, 51.512_05),
        (398.9, -12.3, 51.895_12),
    ];
    for (anchor_north_m, anchor_east_m) in [(0.0, 0.0), (1234.5, -98.25)] {
        scene.place(anchor_north_m, anchor_east_m);
        for (north_m, east_m, want_m) in places {
            let got_m = scene
                .seabed_down_m(anchor_north_m + north_m, anchor_east_m + east_m)
                .unwrap();
            assert!(
                (got_m - want_m).abs() < F32_AT_52_M,
                "({north_m}, {east_m}): {got_m} against {want_m}"
            );
        }
    }
    assert_eq!(scene.seabed_down_m(0.0, 500.0), None, "beyond the end");
}

// Gathering

proptest! {
    #![proptest_config(ProptestConfig::with_cases(64))]
    #[test]
    fn gathering_finds_exactly_the_scatterers_in_any_footprint(
        at in prop::array::uniform3(-40.0..40.0_f64), to in prop::array::uniform3(-1.0..1.0_f64),
        sine in 0.0..1.1_f64, range_m in 0.0..90.0_f64, second_range_m in 0.0..60.0_f64,
        anchor in prop::array::uniform2(-1e4..1e4_f64), density in prop::sample::select(vec![0.5, 2.0, 9.0]),
    ) {
        prop_assume!(DVec3::from(to).length() > 0.1);
        let shape = SeabedShape::Plane { depth_m: 30.0, slope_north: 0.3, slope_east: -0.1 };
        let mut spec = spec(Some(seabed(shape, density, true)), 1000);
        let mut scene = Scene::open(&Disk, &spec).unwrap();
        scene.place(anchor[0], anchor[1]);
        let apex_m = DVec3::from(at) + DVec3::new(anchor[0], anchor[1], 0.0);
        let footprints = [
            Footprint::fan(apex_m, range_m, DVec3::from(to).normalize(), sine),
            Footprint::fan(apex_m + DVec3::new(5.0, 0.0, 2.0), second_range_m, DVec3::Y, 0.2),
        ];
        let mut got = Scatterers::default();
        let counts = scene.gather(&footprints, &mut got);
        // All scatterers of a large footprint, then each footprint by itself. The gathering tests positions in f32: those nearer to an edge than its
        // rounding may fall on either side.
        let mut all = Scatterers::default();
        scene.gather(&[all_round(apex_m, 150.0)], &mut all);
        let within = |margin: f64| {
            let moved = footprints.map(|mut footprint| {
                footprint.max_range_m *= 1.0 + margin;
                footprint.sides[0].knee += margin;
                footprint
            });
            let mut found = Scatterers::default();
            for i in 0..all.len() {
                let p = all.position_m(i);
                if moved.iter().any(|f| f.contains(p)) {
                    found.push(p, all.normal[i], all.strength[i], all.law[i]);
                }
            }
            sorted(bits(&found))
        };
        let found = sorted(bits(&got));
        let (surely, perhaps) = (within(-1e-6), within(1e-6));
        prop_assert!(surely.iter().all(|own| found.binary_search(own).is_ok()));
        prop_assert!(found.iter().all(|own| perhaps.binary_search(own).is_ok()));
        prop_assert_eq!(counts.scatterers, got.len() as u64);
        // A pool with capacity for one tile gives the same.
        spec.memory_limit_bytes = TILE_BYTES;
        let mut poor = Scene::open(&Disk, &spec).unwrap();
        poor.place(anchor[0], anchor[1]);
        poor.gather(&footprints, &mut got);
        prop_assert_eq!(&sorted(bits(&got)), &found);
    }
}

pub(crate) fn written(name: &str, text: &str) -> (tempfile::TempDir, PathBuf) {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join(name);
    std::fs::write(&path, text).unwrap();
    (folder, path)
}

#[test]
fn the_seabed_comes_first_then_points_always_then_targets_within_range() {
    let (_keep_points, points) = written(
        "points.csv",
        "north_m,east_m,down_m,amplitude,amplitude_imag\n1,2,3,0.5,-0.25\n9000,0,10,1,0\n",
    );
    let (_keep_targets, targets) = written(
        "targets.csv",
        "name,north_m,east_m,height_above_seabed_m,target_strength_db\nnear,10,0,1,20\nfar,500,0,0,0\n",
    );
    let mut spec = spec(Some(seabed(FLAT, 4.0, true)), 100);
    spec.points = Some(points);
    spec.targets = Some(targets);
    let mut scene = Scene::open(&Disk, &spec).unwrap();
    scene.place(1000.0, -2000.0);
    let names: Vec<_> = scene
        .targets()
        .iter()
        .map(|t| (t.name.as_str(), t.position_m))
        .collect();
    assert_eq!(
        names,
        [
            ("near", DVec3::new(1010.0, -2000.0, 49.0)),
            ("far", DVec3::new(1500.0, -2000.0, 50.0))
        ]
    );
    let mut out = Scatterers::default();
    let footprint = all_round(DVec3::new(1000.0, -2000.0, 0.0), 60.0);
    let counts = scene.gather(&[footprint], &mut out);
    assert_eq!((counts.points, counts.targets), (2, 1));
    assert_eq!(out.len() as u64, 3 + counts.scatterers);
    assert!(counts.scatterers > 1000 && counts.tiles_made == counts.tiles_used);
    let n = counts.scatterers as usize;
    assert!(out.law[..n].iter().all(|l| *l == ScatterLaw::Lambert));
    assert_eq!(out.position_m(n), DVec3::new(1001.0, -1998.0, 3.0));
    assert_eq!(out.strength[n], Complex64::new(0.5, -0.25));
    assert_eq!(out.position_m(n + 1), DVec3::new(10_000.0, -2000.0, 10.0));
    assert_eq!(out.position_m(n + 2), DVec3::new(1010.0, -2000.0, 49.0));
    assert_eq!(out.strength[n + 2], Complex64::from(10.0));
    assert_eq!(out.law[n + 2], ScatterLaw::Point);
    let again = scene.gather(&[footprint], &mut out);
    assert_eq!(
        again,
        SceneCounts {
            tiles_made: 0,
            made: 0,
            ..counts
        },
        "nothing is made twice"
    );
    // No footprint: the points alone.
    for f in [
        Footprint {
            apex_m: DVec3::NAN,
            ..footprint
        },
        Footprint {
            max_range_m: f64::INFINITY,
            ..footprint
        },
        Footprint {
            depth: f64::NAN,
            ..footprint
        },
    ] {
        let counts = scene.gather(&[f], &mut out);
        assert_eq!(
            counts,
            SceneCounts {
                points: 2,
                ..Default::default()
            },
            "{f:?}"
        );
    }
    // Beyond all tile indices: no seabed and no panic.
    let counts = scene.gather(&[all_round(DVec3::splat(1e30), 60.0)], &mut out);
    assert_eq!((counts.scatterers, out.len()), (0, 2));
}

#[test]
fn the_seabed_moves_with_its_anchor_unless_it_lies_at_the_origin() {
    let mut spec = spec(Some(seabed(FLAT, 4.0, true)), 100);
    let gathered = |spec: &SceneSpec, at: DVec3| {
        let mut scene = Scene::open(&Disk, spec).unwrap();
        scene.place(64.0, -32.0);
        let mut out = Scatterers::default();
        scene.gather(&[all_round(at, 60.0)], &mut out);
        out
    };
    let at_zero = gathered(&spec, DVec3::new(64.0, -32.0, 0.0));
    spec.anchor = AnchorSpec::Origin;
    let fixed = gathered(&spec, DVec3::ZERO);
    assert_eq!(at_zero.strength, fixed.strength);
    let moved = |x: &[f64], by: f64| x.iter().map(|v| v + by).collect::<Vec<_>>();
    assert_eq!(at_zero.north_m, moved(&fixed.north_m, 64.0));
    assert_eq!(at_zero.east_m, moved(&fixed.east_m, -32.0));
}

#[test]
fn an_empty_scene_yields_nothing() {
    let mut scene = Scene::open(&Disk, &spec(None, 0)).unwrap();
    let mut out = Scatterers::default();
    let counts = scene.gather(&[all_round(DVec3::ZERO, 100.0)], &mut out);
    assert_eq!((counts, out.len()), (SceneCounts::default(), 0));
    assert_eq!(scene.seabed_down_m(0.0, 0.0), None);
    assert!(scene.targets().is_empty());
}

#[test]
fn errors_name_the_file_or_the_key() {
    let (_keep, path) = written("bad.asc", "ncols x\n");
    let shape = surveyed(path.clone());
    let message = |spec: &SceneSpec| Scene::open(&Disk, spec).unwrap_err().to_string();
    assert_eq!(
        message(&spec(Some(seabed(shape, 4.0, true)), 1)),
        format!(
            "{}: line 1: `x`: ncols must be a whole number of at least 2",
            path.display()
        )
    );
    let mut missing = spec(None, 1);
    missing.points = Some(path.with_file_name("absent.csv"));
    assert!(matches!(
        Scene::open(&Disk, &missing),
        Err(SceneError::Read { path, .. }) if path.ends_with("absent.csv")
    ));
    let mut poor = spec(Some(seabed(FLAT, 4.0, true)), 1);
    poor.memory_limit_bytes -= 1;
    assert_eq!(
        message(&poor),
        format!(
            "scene.memory_limit_bytes = {}: must be at least {TILE_BYTES}, one tile of the seabed",
            TILE_BYTES - 1
        )
    );
}

#[test]
fn the_quickstart_targets_open_over_the_recorded_seabed() {
    let data =
        PathBuf::from(concat!(env!("CARGO_MANIFEST_DIR"), "/../..")).join("hil-configs/data");
    let shape = surveyed(data.join("jd211_crop_400x400_2m.asc"));
    let mut spec = spec(Some(seabed(shape, 1.0, true)), 10);
    spec.mirror = true;
    spec.targets = Some(data.join("quickstart_targets.csv"));
    let scene = Scene::open(&Disk, &spec).unwrap();
    assert!(scene.targets().len() >= 12);
    for t in scene.targets() {
        assert!((48.0..52.3).contains(&t.position_m.z), "{t:?}");
    }
}

// Levels

/// A resolution cell of 5 cm x 1 degree with 5 scatterers at every range up to 200 m.
const AUTO: Density = Density::Auto {
    per_cell: 5.0,
    cell: ResolutionCell {
        range_m: 0.05,
        beam_rad: 0.017_453_292_519_943_295,
        across_rad: 1.0,
    },
    longest_range_m: 200.0,
    lobes: 2.0,
};

fn auto_recipe(slope_north: f64) -> Recipe {
    let shape = SeabedShape::Plane {
        depth_m: 10.0,
        slope_north,
        slope_east: 0.0,
    };
    let spec = SeabedSpec {
        density: AUTO,
        ..seabed(shape, 1.0, true)
    };
    recipe(&spec, 42)
}

/// An array that looks to both sides of the track, rolled and pitched, with a wide element and motion while it listens.
fn side_looking(apex_m: DVec3, max_range_m: f64) -> Footprint {
    let turn = glam::DQuat::from_euler(glam::EulerRot::ZYX, 0.4, 0.05, 0.3);
    let side = |axis, knee, shift_m| PatternSide {
        axis: turn * axis,
        knee,
        reach: 1.0,
        turn: 0.01,
        shift_m,
    };
    Footprint {
        sides: [
            side(DVec3::X, 0.01, 0.0),
            side(DVec3::Y, 0.4, 0.0),
            side(DVec3::X, 0.1, 0.2),
            PatternSide::OPEN,
        ],
        depth: 3e3,
        cell: ResolutionCell {
            range_m: 0.1,
            beam_rad: 0.03,
            across_rad: 0.1,
        },
        ..all_round(apex_m, max_range_m)
    }
}

#[test]
fn coarse_tiles_hold_every_scatterer_that_the_finest_would_give_and_no_other() {
    let recipe = auto_recipe(0.1);
    let seabed = SeabedSpec {
        density: AUTO,
        ..seabed(
            SeabedShape::Plane {
                depth_m: 10.0,
                slope_north: 0.1,
                slope_east: 0.0,
            },
            1.0,
            true,
        )
    };
    let mut scene = Scene::open(&Disk, &spec(Some(seabed), 4000)).unwrap();
    let apex_m = DVec3::new(3.0, -4.0, 1.0);
    let both = [
        side_looking(apex_m, 40.0),
        Footprint {
            faces: [
                BaffledFace {
                    normal: DVec3::Y,
                    ..BaffledFace::OPEN
                },
                BaffledFace::OPEN,
            ],
            ..side_looking(apex_m + 0.3, 35.0)
        },
    ];
    let mut out = Scatterers::default();
    let counts = scene.gather(&both, &mut out);
    let thinning = recipe.levels().thinning().unwrap();
    let probabilities = both.map(|f| KeepProbability::new(thinning, &f));
    let mut want: Vec<(DVec3, Complex64)> = Vec::new();
    let side_m = recipe.levels().tile_m(0).x;
    let reach = (45.0 / side_m).ceil() as i64;
    let mut all = 0;
    for row in -reach..=reach {
        for col in -reach..=reach {
            let tile = make(&recipe, (row, col));
            for (i, strength) in strengths(&tile).enumerate() {
                let at_m = tile.position_m(i);
                let of = |(f, h): (&Footprint, &KeepProbability)| {
                    h.probability(f, at_m - f.apex_m, glam::DVec2::new(0.1, 0.0))
                };
                let p = both
                    .iter()
                    .zip(&probabilities)
                    .filter_map(of)
                    .reduce(f64::max);
                all += i32::from(p.is_some());
                let gain = p.map_or(0.0, |p| thinning::gain(tile.rank[i].into(), p, 0));
                if gain > 0.0 && both.iter().any(|f| f.contains(at_m)) {
                    want.push((at_m, strength * gain));
                }
            }
        }
    }
    println!("{} of {all} kept, {} made", want.len(), counts.made);
    // Fades reach zero: a position rounded differently at two levels may leave out one of the weakest.
    let strongest = want.iter().map(|w| w.1.norm()).fold(0.0, f64::max);
    let mut got: Vec<(DVec3, Complex64)> = (0..out.len())
        .map(|i| (out.position_m(i), out.strength[i]))
        .collect();
    for list in [&mut got, &mut want] {
        list.retain(|w| w.1.norm() > 1e-3 * strongest);
        list.sort_by(|a, b| a.0.x.total_cmp(&b.0.x));
    }
    assert_eq!(got.len(), want.len());
    for (got, want) in got.iter().zip(&want) {
        assert!(got.0.distance(want.0) < 1e-4, "{got:?}, {want:?}");
        assert!(
            (got.1 - want.1).norm() < 1e-3 * strongest,
            "{got:?}, {want:?}"
        );
    }
    assert!(got.len() > 2000 && 20 * got.len() < all as usize);
    assert!(counts.made < all as u64 / 4, "{}", counts.made);
}

#[test]
fn weights_keep_the_mean_intensity_at_every_probability_and_level() {
    const STEPS: u32 = 100_000;
    for probability in [1e-6, 0.01, 0.3, 0.7, 0.9, 1.0, 1.2, 1.5, 40.0] {
        let coarsest = thinning::level(probability);
        for level in coarsest.saturating_sub(4)..=coarsest {
            let power = (0..STEPS).map(|k| {
                let rank = (f64::from(k) + 0.5) / f64::from(STEPS);
                thinning::gain(rank, probability, level).powi(2)
            });
            let mean = power.sum::<f64>() / f64::from(STEPS);
            assert!(
                (mean - 1.0).abs() < 1e-3,
                "{probability}, level {level}: {mean}"
            );
        }
    }
    // Far from the fade nothing is changed.
    assert!((thinning::gain(0.99, 1.5, 0) - 1.0).abs() < 1e-12);
    assert!(thinning::level(0.8) == 0 && thinning::level(0.399) == 1);
}

#[test]
fn ranks_are_uniform_and_halve_with_every_level_that_a_scatterer_is_in() {
    let recipe = auto_recipe(0.0);
    for level in [0, 1, 4] {
        let mut ranks = Vec::new();
        for at in 0..16 {
            let id = TileId {
                level,
                row: at / 4,
                col: at % 4,
            };
            ranks.extend(make_id(&recipe, id).rank);
        }
        ranks.sort_by(f32::total_cmp);
        let n = ranks.len() as f64;
        let off = ranks
            .iter()
            .enumerate()
            .map(|(i, rank)| (f64::from(*rank) - i as f64 / n).abs());
        let worst = off.fold(0.0, f64::max) * n.sqrt();
        // Kolmogorov and Smirnov at p = 0.01.
        assert!(worst < 1.63, "level {level}: {worst}");
    }
}

#[test]
fn cells_are_ordered_by_rank_and_equal_ones_by_place() {
    for different in [2, 7, 1 << 20] {
        for seed in 0..20_u32 {
            let ranks: [f32; CELLS_PER_BLOCK] = std::array::from_fn(|i| {
                let word = (i as u32 + 64 * seed).wrapping_mul(2_654_435_761) >> 8;
                (1 + word % different) as f32 / different as f32
            });
            let mut want: Vec<usize> = (0..CELLS_PER_BLOCK).collect();
            want.sort_by(|a, b| ranks[*a].total_cmp(&ranks[*b]));
            let places = places_in_order(&ranks);
            let mut got = [0; CELLS_PER_BLOCK];
            for (cell, place) in places.into_iter().enumerate() {
                got[place as usize] = cell;
            }
            assert_eq!(got[..], want[..], "{different} ranks, seed {seed}");
        }
    }
}

#[test]
fn two_halves_cover_a_tile_and_each_of_its_scatterers_is_one_of_theirs_or_of_their_halves() {
    let recipe = auto_recipe(0.1);
    for level in 1..6 {
        for (row, col) in [(0, 0), (-1, 3), (-7, -2)] {
            let whole = TileId { level, row, col };
            let [a, b] = whole.halves();
            let boxes = [whole, a, b].map(|id| recipe.bounds(id).unwrap());
            let area =
                |b: &super::tiles::TileBox| (b.high_m.x - b.low_m.x) * (b.high_m.y - b.low_m.y);
            assert!((area(&boxes[0]) - area(&boxes[1]) - area(&boxes[2])).abs() < 1e-9);
            for half in &boxes[1..] {
                assert!(half.low_m.cmpge(boxes[0].low_m - 1e-9).all());
                assert!(half.high_m.cmple(boxes[0].high_m + 1e-9).all());
            }
            let (tile, finer) = (
                make_id(&recipe, whole),
                [a, b].map(|id| make_id(&recipe, id)),
            );
            let places: Vec<(DVec3, Complex64, f32)> = finer
                .iter()
                .flat_map(|t| {
                    let each = strengths(t).enumerate();
                    each.map(|(i, s)| (t.position_m(i), s, t.rank[i]))
                })
                .collect();
            assert_eq!((tile.len(), places.len()), (1024, 2048));
            for (i, strength) in strengths(&tile).enumerate() {
                let at = tile.position_m(i);
                let twin = places.iter().find(|(p, ..)| p.distance(at) < 1e-5);
                let (_, finer, finer_rank) = twin.expect("a scatterer of the finer level");
                let ratio = strength / finer;
                assert!((ratio - 2.0_f64.sqrt()).norm() < 1e-6, "{ratio}");
                let ranks = tile.rank[i] / finer_rank;
                assert!((ranks - 2.0).abs() < 1e-5, "{ranks}");
            }
        }
    }
}

#[test]
fn the_mean_intensity_is_the_same_at_every_level() {
    let mu = 10.0_f64.powf(MU / 10.0);
    let recipe = auto_recipe(0.0);
    for level in 0..7 {
        let (sum, count) = intensity(&recipe, level, 4);
        let tile_m = recipe.levels().tile_m(level);
        let (want, allowed) = (16.0 * mu * tile_m.x * tile_m.y, 4.0 / (count as f64).sqrt());
        let error = sum / want - 1.0;
        println!("level {level}: {count} scatterers, off by {error:+.4}");
        assert!(
            error.abs() < allowed,
            "level {level}: {error}, allowed {allowed}"
        );
    }
}

#[test]
fn coarse_levels_have_no_bragg_lines_either() {
    // As above: 10 dB is exceeded by chance once in 22 000.
    let recipe = auto_recipe(0.0);
    for level in [1, 2, 5] {
        let cell_m = recipe.levels().cell_m(level);
        let places = places_of_level(&recipe, level);
        // Lattice lines of the level's cells, of their halves, and of the tiles.
        for (p, q) in [
            (1.0, 0.0),
            (0.0, 1.0),
            (2.0, 0.0),
            (0.0, 2.0),
            (1.0, 1.0),
            (1.0 / 32.0, 0.0),
        ] {
            let db = structure_db(&places, cell_m, p, q);
            assert!(db < 10.0, "level {level}: {db:.1} dB at ({p}, {q})");
        }
    }
}

#[test]
fn an_automatic_seabed_covers_every_range_once_and_threads_do_not_matter() {
    let spec = SceneSpec {
        seabed: Some(SeabedSpec {
            density: AUTO,
            ..seabed(FLAT, 1.0, true)
        }),
        ..spec(None, 4000)
    };
    let footprint = all_round(DVec3::new(3.0, -4.0, 0.0), 120.0);
    let [(one, ..), (two, counts, out)] = [1, 2].map(|threads| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads);
        let (out, counts) = pool.build().unwrap().install(|| gathered(&spec, footprint));
        (bits(&out), counts, out)
    });
    assert_eq!(one, two, "threads");
    println!("{counts:?}");
    assert_eq!(counts.made, counts.culled + counts.scatterers);
    // For each ring of 10 m: at least five scatterers a cell, and the intensity of the ring's area.
    let mu = 10.0_f64.powf(MU / 10.0);
    for ring in 5..12 {
        let (near_m, far_m) = (10.0 * f64::from(ring), 10.0 * f64::from(ring) + 10.0);
        let (mut count, mut sum) = (0.0, 0.0);
        for i in 0..out.len() {
            let range_m = out.position_m(i).distance(footprint.apex_m);
            if (near_m..far_m).contains(&range_m) {
                count += 1.0;
                sum += out.strength[i].norm_sqr();
            }
        }
        // Slant-range rings on a plane: pi (far^2 - near^2), whatever the depth.
        let area_m2 = PI * (far_m * far_m - near_m * near_m);
        let per_cell = count / area_m2 * 0.05 * near_m * 0.017_453_292_519_943_295;
        let (error, allowed) = (sum / (mu * area_m2) - 1.0, 5.0 / f64::sqrt(count));
        println!(
            "{near_m} m: {count} scatterers, {per_cell:.1} per cell, intensity off by {error:+.4}"
        );
        assert!(
            (4.4..10.5).contains(&per_cell),
            "{near_m} m: {per_cell} per cell"
        );
        assert!(
            error.abs() < allowed,
            "{near_m} m: {error}, allowed {allowed}"
        );
    }
}

// Bottoms

#[test]
fn flat_incidence_turns_the_normals_up_and_changes_nothing_else() {
    let shape = SeabedShape::Plane {
        depth_m: 50.0,
        slope_north: 0.3,
        slope_east: 0.2,
    };
    let made = |incidence| {
        let spec = SeabedSpec {
            incidence,
            ..seabed(shape.clone(), 2.0, true)
        };
        make(&recipe(&spec, 42), (0, 0))
    };
    let (own, flat) = (made(IncidenceSpec::Normal), made(IncidenceSpec::Flat));
    assert_eq!(tile_bits(&own), tile_bits(&flat));
    assert!(flat.normal.iter().all(|n| *n == [0.0, 0.0, -1.0]));
    assert!(own.normal.iter().all(|n| n[0] > 0.2));
}

#[test]
fn a_mosaic_sets_the_strength_at_its_incidence_and_holes_keep_the_bottoms_own() {
    // 4 x 4 cells of 2 m: -20 dB in the south, -40 dB in the north, a hole in the north-east.
    let values = [
        -40.0, -40.0, -40.0, -9999.0, -40.0, -40.0, -40.0, -40.0, -20.0, -20.0, -20.0, -20.0,
        -20.0, -20.0, -20.0, -20.0,
    ];
    let text: Vec<String> = values.iter().map(|v: &f64| v.to_string()).collect();
    let (_keep, path) = written(
        "mosaic.asc",
        &format!(
            "ncols 4 nrows 4 xllcorner 0 yllcorner 0 cellsize 2 {}",
            text.join(" ")
        ),
    );
    let incidence_rad = 30.0_f64.to_radians();
    for (values, bottom) in [
        (
            MosaicValues::Absolute { incidence_rad },
            BottomSpec::Sediment(Sediment::Sand),
        ),
        (
            MosaicValues::Absolute { incidence_rad },
            BottomSpec::Lambert { mu_db: -27.0 },
        ),
        (
            MosaicValues::Relative,
            BottomSpec::Sediment(Sediment::Gravel),
        ),
    ] {
        let mosaic = MosaicSpec {
            path: path.clone(),
            crs: None,
            values,
            offset_north_m: 0.0,
            offset_east_m: 0.0,
        };
        let mut seabed = SeabedSpec {
            bottom: bottom.clone(),
            mosaic: Some(mosaic),
            ..seabed(FLAT, 4.0, false)
        };
        let of = |seabed: &SeabedSpec| {
            let spec = SceneSpec {
                anchor: AnchorSpec::Origin,
                ..spec(Some(seabed.clone()), 100)
            };
            gathered(&spec, all_round(DVec3::ZERO, 51.0)).0
        };
        let with = of(&seabed);
        seabed.mosaic = None;
        let without = of(&seabed);
        assert_eq!(with.law, without.law);
        let own = super::bottoms::Bottom::new(&bottom);
        let own_db = 10.0 * own.strength(incidence_rad).log10();
        let (mut south, mut north, mut outside) = (0, 0, 0);
        for i in 0..with.len() {
            let at = with.position_m(i);
            let got_db = 20.0 * (with.strength[i] / without.strength[i]).norm().log10();
            let set_db = |db: f64| match values {
                MosaicValues::Absolute { .. } => db - own_db,
                MosaicValues::Relative => db,
            };
            let inside = at.x.abs() <= 3.0 && at.y.abs() <= 3.0;
            let (want_db, count) = match inside {
                true if at.x < -1.0 => (set_db(-20.0), &mut south),
                true if at.x > 1.0 && at.y < 1.0 => (set_db(-40.0), &mut north),
                true if at.x > 1.0 => (0.0, &mut outside),
                true => continue,
                false => (0.0, &mut outside),
            };
            *count += 1;
            assert!(
                (got_db - want_db).abs() < 1e-5,
                "{at}: {got_db} dB against {want_db}"
            );
        }
        assert!(
            south > 30 && north > 20 && outside > 100,
            "{south} {north} {outside}"
        );
    }
}

/// A survey in UTM coordinates with itself as mosaic. Everywhere, in mirror images too, the strength must equal the file's number at that position.
/// Moving either moves the strengths.
#[test]
fn a_mosaic_over_a_file_lies_where_its_coordinates_put_it() {
    let folder = Path::new(concat!(env!("CARGO_MANIFEST_DIR"), "/../..")).join("tests/data/bathy");
    let file = SeabedFileSpec::of(folder.join("laparguera_hitw_bathy.tif"));
    let survey = crate::read::Survey::open(&Disk, &file).unwrap();
    let extent_m = (survey.field.extent_north_m(), survey.field.extent_east_m());
    let (shift_north_m, shift_east_m) = (0.2 * extent_m.0, -0.1 * extent_m.1);
    let opened = |mosaic: Option<MosaicSpec>| {
        let shape = SeabedShape::File {
            file: file.clone(),
            offset_north_m: 30.0,
            offset_east_m: -40.0,
        };
        let seabed = SeabedSpec {
            mosaic,
            ..seabed(shape, 400.0 / (extent_m.0 * extent_m.1), false)
        };
        Scene::open(
            &Disk,
            &SceneSpec {
                anchor: AnchorSpec::Origin,
                mirror: true,
                ..spec(Some(seabed), 1000)
            },
        )
    };
    let mosaic = |path: &Path, crs| MosaicSpec {
        path: path.to_owned(),
        crs,
        values: MosaicValues::Relative,
        offset_north_m: shift_north_m,
        offset_east_m: shift_east_m,
    };
    let reach_m = 1.5 * extent_m.0.max(extent_m.1);
    let gathered = |mosaic| {
        let mut scene = opened(mosaic).unwrap();
        let mut out = Scatterers::default();
        scene.gather(&[all_round(DVec3::ZERO, reach_m)], &mut out);
        out
    };
    let without = gathered(None);
    let with = gathered(Some(mosaic(&file.path, None)));
    assert_eq!(with.len(), without.len());
    let fold = |x: f64, extent: f64| {
        let there = x.rem_euclid(2.0 * extent);
        there.min(2.0 * extent - there)
    };
    let (mut inside, mut outside) = (0, 0);
    for i in 0..with.len() {
        let at = with.position_m(i);
        // Position in the file, whose middle lies at the offset; then the position in the moved mosaic.
        let v = fold(at.x - 30.0 + extent_m.0 / 2.0, extent_m.0) - extent_m.0 / 2.0;
        let u = fold(at.y + 40.0 + extent_m.1 / 2.0, extent_m.1) - extent_m.1 / 2.0;
        let there = survey.field.sample(v - shift_north_m, u - shift_east_m);
        // A layer's numbers are used as they are; heights are converted to depths.
        let sign = match survey.sign {
            HeightSign::Elevation => -1.0,
            HeightSign::Depth => 1.0,
        };
        let want_db = there.map_or(0.0, |d| sign * d.down_m);
        let got_db = 20.0 * (with.strength[i] / without.strength[i]).norm().log10();
        assert!((got_db - want_db).abs() < 1e-4, "{at}: {got_db}, {want_db}");
        match there {
            Some(_) => inside += 1,
            None => outside += 1,
        }
    }
    println!("{inside} under the mosaic, {outside} beside it");
    assert!(inside > 200 && outside > 50, "{inside} {outside}");
    // Another coordinate system, the same with a configured override, and a file that lies elsewhere.
    let grid = "ncols 2 nrows 2 xllcorner {x} yllcorner {y} cellsize {c} -20 -20 -20 -20";
    let written_at = |x: f64, y: f64| {
        let cell = extent_m.0.to_string();
        let (x, y) = (x.to_string(), y.to_string());
        written(
            "mosaic.asc",
            &grid
                .replace("{x}", &x)
                .replace("{y}", &y)
                .replace("{c}", &cell),
        )
    };
    let message = |path: &Path, crs| match opened(Some(mosaic(path, crs))) {
        Ok(_) => panic!("was taken"),
        Err(error) => error.to_string(),
    };
    let projected = CrsSpec::Projected;
    let [x, y] = survey.zero;
    let (_keep, path) = written_at(x - extent_m.0, y - extent_m.0);
    let error = message(&path, None);
    assert!(
        error.contains("local metres")
            && error.contains("seabed's file, projected metres (EPSG:32161)"),
        "{error}"
    );
    assert!(opened(Some(mosaic(&path, Some(projected)))).is_ok());
    let (_keep, path) = written_at(x + 9.0 * extent_m.0, y);
    let error = message(&path, Some(projected));
    assert!(
        error.contains("does not overlap the seabed's file"),
        "{error}"
    );
}

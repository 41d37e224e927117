//! Seabed reverberation: level against the integral of the sonar equation, and speckle.
//!
//! A CW pulse of one range cell, sampled once per cell by a collocated transmitter and element. Every sample is the sum of the scatterers
//! of its own ring, so samples are independent and depend only on scene and transmit leg.

use std::f64::consts::{FRAC_PI_2, PI, TAU};

use echotank_config::spec::*;
use echotank_core::arrays::{Pattern, TransmitArray};
use echotank_core::frames::Trajectory;
use echotank_core::ping::PingPlan;
use echotank_core::scene::{Footprint, PatternSide, ResolutionCell, Scatterers};
use echotank_runtime::io::files::FileSystem;
use echotank_scene::Scene;
use echotank_synthesis::arrivals::{ArrivalChunk, ArrivalSink};
use echotank_synthesis::echo::{TransmitLeg, Window, Workspace, arrivals, insonify};
use echotank_testing::echo::{C, CARRIER_HZ, WAVELENGTH_M, ahead, cw, element, transmitter};
use glam::{DQuat, DVec3};
use num_complex::Complex64;

/// Metres: height over the bottom, length of a range cell, range of the first cell.
const HEIGHT: f64 = 15.0;
const CELL: f64 = 0.1;
const FIRST: f64 = 30.0;
const CELLS: usize = 200;
/// Length of the transmitter: a beam 3 degrees wide.
const APERTURE: f64 = 17.0 * WAVELENGTH_M;
const BEAM: f64 = 0.886 / 17.0;
/// Directions with a greater sine off broadside are left out, here and in the integral.
const MAX_SINE: f64 = 0.12;
const MU_DB: f64 = -27.0;
const ABSORPTION_DB_PER_M: f64 = 0.05;

fn sinc(x: f64) -> f64 {
    if x == 0.0 {
        1.0
    } else {
        (PI * x).sin() / (PI * x)
    }
}

/// Integrals over a cell's ring of the n-th power of the two-way power pattern and spreading, times (cos^2)^n: n = 1 is the mean intensity over mu,
/// n = 2 what its fluctuation is made of.
fn ring(cell: usize, power: i32) -> f64 {
    const RANGES: usize = 8;
    const AZIMUTHS: usize = 4000;
    let mut sum = 0.0;
    for i in 0..RANGES {
        let r = FIRST + CELL * (cell as f64 + (i as f64 + 0.5) / RANGES as f64);
        let sin = (1.0 - (HEIGHT / r).powi(2)).sqrt();
        let loss = 10f64.powf(-ABSORPTION_DB_PER_M * r / 20.0) / r;
        let cos_squared = (HEIGHT / r).powi(2);
        for k in 0..AZIMUTHS {
            // A quarter of the circle from broadside; the other three are like it.
            let azimuth = (k as f64 + 0.5) / AZIMUTHS as f64 * FRAC_PI_2;
            let u = sin * azimuth.sin();
            if u <= MAX_SINE {
                let pattern = sinc(APERTURE / WAVELENGTH_M * u).powi(2);
                sum += (pattern * loss.powi(4) * cos_squared).powi(power) * r;
            }
        }
    }
    // dA = r dr d(azimuth) on a flat bottom.
    sum * CELL / RANGES as f64 * 4.0 * FRAC_PI_2 / AZIMUTHS as f64
}

fn mu() -> f64 {
    10f64.powf(MU_DB / 10.0)
}

fn scene(density: Density) -> Scene {
    Scene::open(
        &FileSystem,
        &SceneSpec {
            seed: 20_260_101,
            anchor: AnchorSpec::Origin,
            mirror: false,
            seabed: Some(SeabedSpec {
                shape: SeabedShape::Plane {
                    depth_m: HEIGHT,
                    slope_north: 0.0,
                    slope_east: 0.0,
                },
                density,
                bottom: BottomSpec::BistaticLambert { mu_db: MU_DB },
                incidence: IncidenceSpec::Normal,
                mosaic: None,
                speckle: true,
            }),
            points: None,
            targets: None,
            occlusion: OcclusionSpec::Horizon,
            memory_limit_bytes: 1 << 26,
            simplify: None,
        },
    )
    .expect("a plane")
}

/// Adds up what arrives in each cell.
struct Cells(Vec<Complex64>);

impl ArrivalSink for Cells {
    fn accept(&mut self, chunk: &ArrivalChunk) {
        for i in 0..chunk.len {
            let cell = ((0.5 * C * chunk.delay_s[i] - FIRST) / CELL).floor();
            if (0.0..CELLS as f64).contains(&cell) {
                let turns = CARRIER_HZ * chunk.delay_s[i];
                let phase = -TAU * (turns - turns.round());
                self.0[cell as usize] += chunk.amplitude[i] * Complex64::cis(phase);
            }
        }
    }
}

/// A ping of a platform at rest at `at_m`, with a pulse of one range cell.
fn plan_at(at_m: DVec3) -> PingPlan {
    let mut plan = ahead(0.0);
    plan.pulse = cw(2.0 * CELL / C);
    plan.absorption_db_per_m = ABSORPTION_DB_PER_M;
    plan.trajectory = Trajectory::uniform(at_m, DVec3::ZERO, DQuat::IDENTITY);
    plan.segments[0].position_m = at_m;
    plan
}

/// Samples of `pings` pings at places of their own, cell by cell, and the scatterers of a ping.
fn samples(density: Density, pings: usize) -> (Vec<Vec<Complex64>>, u64) {
    let mut scene = scene(density);
    let range_m = FIRST + CELL * CELLS as f64;
    let (tx, rx) = (
        TransmitArray {
            pattern: Pattern::Rectangle {
                length_m: APERTURE,
                width_m: 0.0,
                baffled: false,
            },
            ..transmitter(DVec3::ZERO)
        },
        element(DVec3::ZERO),
    );
    let (mut leg, mut work) = (TransmitLeg::default(), Workspace::default());
    let mut scatterers = Scatterers::default();
    let mut used = 0;
    let all = (0..pings)
        .map(|ping| {
            // Nothing within reach of two pings, either way along the beam.
            let at_m = DVec3::new(30.0 * (ping / 20) as f64, 130.0 * (ping % 20) as f64, 0.0);
            let plan = plan_at(at_m);
            let footprint = Footprint::fan(at_m, range_m, DVec3::X, MAX_SINE);
            used += scene.gather(&[footprint], &mut scatterers).scatterers;
            let window = Window {
                first_s: 0.0,
                last_s: 2.0 * (range_m + 1.0) / C,
            };
            insonify(&plan, &tx, window, &scatterers, &mut leg);
            let mut cells = Cells(vec![Complex64::ZERO; CELLS]);
            arrivals(&plan, &rx, 0, &leg, &mut work, &mut cells);
            cells.0
        })
        .collect();
    (all, used / pings as u64)
}

const AUTO: Density = auto(2.0);

const fn auto(lobes: f64) -> Density {
    Density::Auto {
        per_cell: 5.0,
        cell: ResolutionCell {
            range_m: CELL,
            beam_rad: BEAM,
            across_rad: 1.0,
        },
        longest_range_m: 50.0,
        lobes,
    }
}

#[test]
fn the_mean_level_is_the_sonar_equations_integral_within_0p2_db_at_three_densities() {
    // 20 cells of 440 pings: 8800 independent samples, whose mean intensity has a standard error of 0.05 dB. (4300 would be enough for one
    // bin; here 30 are looked at, and 0.2 dB must be more than four standard errors.)
    const BIN: usize = 20;
    const PINGS: usize = 440;
    const ALLOWED_DB: f64 = 0.2;
    let want: Vec<f64> = (0..CELLS).map(|cell| mu() * ring(cell, 1)).collect();
    for density in [AUTO, Density::PerM2(15.0), Density::PerM2(100.0)] {
        let (pings, used) = samples(density, PINGS);
        let mut worst = 0.0_f64;
        for bin in 0..CELLS / BIN {
            let cells = bin * BIN..(bin + 1) * BIN;
            let got: f64 = pings
                .iter()
                .flat_map(|ping| &ping[cells.clone()])
                .map(|x| x.norm_sqr())
                .sum::<f64>()
                / PINGS as f64;
            let off_db = 10.0 * (got / want[cells.clone()].iter().sum::<f64>()).log10();
            worst = worst.max(off_db.abs());
            let near_m = FIRST + CELL * cells.start as f64;
            assert!(
                off_db.abs() < ALLOWED_DB,
                "{density:?}, {near_m} m: off by {off_db:+.3} dB"
            );
        }
        println!("{density:?}: {used} scatterers a ping, at most {worst:.3} dB off");
    }
}

/// Intensities over their known local means, of the cells from `first` on, every one of them its own.
fn normalised(density: Density, count: usize, first: usize) -> Vec<f64> {
    let per_ping = CELLS - first;
    let (pings, _) = samples(density, count.div_ceil(per_ping));
    let want: Vec<f64> = (0..CELLS).map(|cell| mu() * ring(cell, 1)).collect();
    pings
        .iter()
        .flat_map(|ping| (first..CELLS).map(|cell| ping[cell].norm_sqr() / want[cell]))
        .take(count)
        .collect()
}

/// Kolmogorov and Smirnov's sqrt(n) D against the exponential distribution.
fn smirnov(mut values: Vec<f64>) -> f64 {
    values.sort_by(f64::total_cmp);
    let n = values.len() as f64;
    let distance = values.iter().enumerate().fold(0.0_f64, |worst, (i, x)| {
        let f = 1.0 - (-x).exp();
        worst
            .max((f - i as f64 / n).abs())
            .max((f - (i as f64 + 1.0) / n).abs())
    });
    n.sqrt() * distance
}

fn mean(values: &[f64]) -> f64 {
    values.iter().sum::<f64>() / values.len() as f64
}

fn variance(values: &[f64]) -> f64 {
    let (n, mean) = (values.len() as f64, mean(values));
    values.iter().map(|x| (x - mean).powi(2)).sum::<f64>() / n
}

#[test]
fn speckle_is_rayleigh_with_an_automatic_density_and_k_like_with_two_scatterers_a_cell() {
    // p = 0.01 (Smirnov 1948).
    const CRITICAL: f64 = 1.628;
    const COUNT: usize = 10_000;
    let auto = normalised(AUTO, COUNT, 0);
    let (statistic, spread) = (smirnov(auto.clone()), variance(&auto));
    println!("automatic: sqrt(n) D {statistic:.3}, variance {spread:.3}");
    assert!(statistic < CRITICAL, "sqrt(n) D = {statistic}");
    // From 40 m on: two in a resolution cell at 45 m. A cell is what the sonar cannot tell apart, the -3 dB width of the beam on both sides:
    // a line hears to port as well as to starboard.
    let first = 100;
    let few = 2.0 / (2.0 * CELL * BEAM * 45.0);
    let sparse = normalised(Density::PerM2(few), COUNT, first);
    let (statistic, spread) = (smirnov(sparse.clone()), variance(&sparse));
    let want = 1.0 + 2.0 * crowding(few, first);
    println!(
        "two a cell: sqrt(n) D {statistic:.3}, variance {spread:.3}, of places by chance in a lattice {want:.3}"
    );
    assert!(statistic > CRITICAL, "two a cell pass for Rayleigh");
    // The variance of 10,000 intensities scatters by 0.03 if they are Rayleigh's and about twice that here.
    assert!((spread - want).abs() < 0.2, "{spread} against {want}");
    assert!(spread > 1.3, "{spread}: hardly more than Rayleigh's 1");
}

/// Of the power in a cell, S = sum of the weights of the scatterers that lie in it, variance over the mean's square.
///
/// Given S the sample is a circular Gaussian of power S, so that its intensity has mean E S and second moment 2 E S^2: normalised variance
/// 1 + 2 Var S / (E S)^2. With places by chance (Poisson) that is 1 + 2 / n, n = density (integral of w)^2 / integral of w^2. For a weight
/// sinc^2 along the line n is 1.5 / 0.886 times what lies in its -3 dB width: two give 1 + 2 / 3.39 = 1.59, the 1.6 of the closed forms. Here
/// every scatterer keeps to a square of a lattice; of each square one adds the variance of what it gives, E w^2 - (E w)^2.
fn crowding(density_per_m2: f64, first: usize) -> f64 {
    const PARTS: i64 = 16;
    const SHIFTS_M: [[f64; 2]; 3] = [[0.0, 0.0], [30.0, 130.0], [60.0, 390.0]];
    let side_m = 1.0 / density_per_m2.sqrt();
    let range_m = |cell: usize| FIRST + CELL * cell as f64;
    let reach = (range_m(CELLS) / side_m).ceil() as i64;
    let beam = (MAX_SINE * range_m(CELLS) / side_m).ceil() as i64;
    let nearest = ((range_m(first).powi(2) - HEIGHT * HEIGHT).sqrt() * 0.9 / side_m) as i64;
    let mut power = vec![[0.0; 2]; CELLS];
    // A few pings, at other places of the lattice.
    for shift_m in SHIFTS_M {
        let at = shift_m.map(|m: f64| (m / side_m).floor() as i64);
        for row in at[0] - beam..=at[0] + beam {
            for col in (-reach..=-nearest).chain(nearest..=reach) {
                let mut square = [[0.0; 2]; CELLS];
                for part in 0..PARTS * PARTS {
                    let place = |index: i64, part: i64| {
                        (index as f64 + (part as f64 + 0.5) / PARTS as f64) * side_m
                    };
                    let north_m = place(row, part / PARTS) - shift_m[0];
                    let east_m = place(col + at[1], part % PARTS) - shift_m[1];
                    let r = (north_m * north_m + east_m * east_m + HEIGHT * HEIGHT).sqrt();
                    let cell = ((r - FIRST) / CELL).floor();
                    let u = (north_m / r).abs();
                    if u > MAX_SINE || cell < first as f64 || cell >= CELLS as f64 {
                        continue;
                    }
                    let pattern = sinc(APERTURE / WAVELENGTH_M * u).powi(2);
                    let loss = 10f64.powf(-ABSORPTION_DB_PER_M * r / 20.0) / r;
                    let w = pattern * loss.powi(4) * (HEIGHT / r).powi(2);
                    square[cell as usize][0] += w / (PARTS * PARTS) as f64;
                    square[cell as usize][1] += w * w / (PARTS * PARTS) as f64;
                }
                for (sum, [mean, squares]) in power.iter_mut().zip(square) {
                    sum[0] += mean;
                    sum[1] += squares - mean * mean;
                }
            }
        }
    }
    // Sums over the pings: their number comes out of the mean, squared, once too often.
    let cells = power[first..]
        .iter()
        .map(|[mean, spread]| SHIFTS_M.len() as f64 * spread / (mean * mean));
    cells.sum::<f64>() / (CELLS - first) as f64
}

/// The closed form's 1.6, by the integrals of this sonar.
#[test]
fn two_a_cell_by_chance_placement_have_an_intensity_variance_of_1p6() {
    let cell = 150; // at 45 m
    let few = 2.0 / (2.0 * CELL * BEAM * 45.0);
    let crowding = ring(cell, 2) / (few * ring(cell, 1).powi(2));
    let want = 1.0 + 2.0 * crowding;
    println!("by chance placement: {want:.3}");
    assert!((want - 1.6).abs() < 0.05, "{want}");
}

/// What is received of the ground around a ping: the whole ring, or all but a strip of [`SHADOW`] to either side of the broadside.
const SHADOW: f64 = 1.5;
/// Pings of a run, and the advance between two of them that are compared.
const RUN: usize = 240;
const ADVANCE: f64 = APERTURE / 10.0;

/// Samples of one density, with the side lobes: [element, beam][open, shadow][ping][cell]. A beam is as long as the transmitter.
struct Runs {
    samples: [[Vec<Vec<Complex64>>; 2]; 2],
    scatterers: u64,
}

impl Runs {
    /// Pings in pairs [`ADVANCE`] apart.
    fn new(lobes: f64, shadows: std::ops::Range<usize>) -> Self {
        let mut scene = scene(auto(lobes));
        let range_m = FIRST + CELL * CELLS as f64;
        let line = Pattern::Rectangle {
            length_m: APERTURE,
            width_m: 0.0,
            baffled: false,
        };
        let tx = TransmitArray {
            pattern: line,
            ..transmitter(DVec3::ZERO)
        };
        let (mut leg, mut work) = (TransmitLeg::default(), Workspace::default());
        let mut scatterers = Scatterers::default();
        let mut runs = Self {
            samples: Default::default(),
            scatterers: 0,
        };
        for ping in 0..RUN {
            let (pair, second) = (ping / 2, (ping % 2) as f64);
            let north_m = 13.0 * (pair / 20) as f64 + ADVANCE * second;
            let at_m = DVec3::new(north_m, 130.0 * (pair % 20) as f64, 0.0);
            let plan = plan_at(at_m);
            let mut footprint = Footprint::all_round(at_m, range_m);
            footprint.sides[0] = PatternSide {
                axis: DVec3::X,
                knee: WAVELENGTH_M / (PI * APERTURE),
                ..PatternSide::OPEN
            };
            footprint.cell = ResolutionCell {
                range_m: CELL,
                beam_rad: BEAM,
                across_rad: 1.0,
            };
            runs.scatterers += scene.gather(&[footprint], &mut scatterers).scatterers;
            let window = Window {
                first_s: 0.0,
                last_s: 2.0 * (range_m + 1.0) / C,
            };
            for shadow in shadows.clone() {
                for i in 0..scatterers.len() {
                    if shadow == 1 && (scatterers.north_m[i] - at_m.x).abs() < SHADOW {
                        scatterers.strength[i] = Complex64::ZERO;
                    }
                }
                insonify(&plan, &tx, window, &scatterers, &mut leg);
                for (beam, pattern) in [Pattern::Omnidirectional, line].into_iter().enumerate() {
                    let mut rx = element(DVec3::ZERO);
                    rx.element_pattern = pattern;
                    let mut cells = Cells(vec![Complex64::ZERO; CELLS]);
                    arrivals(&plan, &rx, 0, &leg, &mut work, &mut cells);
                    runs.samples[beam][shadow].push(cells.0);
                }
            }
        }
        runs.scatterers /= RUN as u64;
        runs
    }

    /// Correlation of the pings of a pair.
    fn correlation(&self, beam: usize) -> f64 {
        let (mut common, mut powers) = (Complex64::ZERO, [0.0; 2]);
        for pair in self.samples[beam][0].chunks(2) {
            for (a, b) in pair[0].iter().zip(&pair[1]) {
                common += a * b.conj();
                powers[0] += a.norm_sqr();
                powers[1] += b.norm_sqr();
            }
        }
        common.norm() / (powers[0] * powers[1]).sqrt()
    }
}

/// Mean intensity of a cell over mu where the beam is the element's (power 1) or the line's (2), of the ring or of what a shadow leaves.
fn thinned_ring(cell: usize, power: i32, shadow: bool) -> f64 {
    const AZIMUTHS: usize = 20_000;
    let r = FIRST + CELL * (cell as f64 + 0.5);
    let sin = (1.0 - (HEIGHT / r).powi(2)).sqrt();
    let loss = 10f64.powf(-ABSORPTION_DB_PER_M * r / 20.0) / r;
    let of = |k: usize| {
        let azimuth = (k as f64 + 0.5) / AZIMUTHS as f64 * FRAC_PI_2;
        let u = sin * azimuth.sin();
        match shadow && u * r < SHADOW {
            true => 0.0,
            false => sinc(APERTURE / WAVELENGTH_M * u).powi(2 * power),
        }
    };
    let sum: f64 = (0..AZIMUTHS).map(of).sum();
    sum * loss.powi(4) * (HEIGHT / r).powi(2) * r * CELL * 4.0 * FRAC_PI_2 / AZIMUTHS as f64
}

/// With k = 2, and with a k for which side lobes are left out more than in proportion to their pressure.
#[test]
fn thinned_side_lobes_keep_level_speckle_and_correlation() {
    let all = Runs::new(1e9, 0..1);
    // k, and most kurtosis in a shadow: of an element, which `check` prints, and of a beam.
    for (lobes, in_shadow) in [(2.0, [2.5, 2.5]), (0.5, [2.5, 3.0])] {
        compare(&all, lobes, in_shadow);
    }
}

fn compare(all: &Runs, lobes: f64, in_shadow: [f64; 2]) {
    // 40 cells of 240 pings, half of which are nearly alike: 4,800 independent samples a bin or more.
    const BIN: usize = 40;
    let thinned = Runs::new(lobes, 0..2);
    println!(
        "k = {lobes}: {} of {} scatterers",
        thinned.scatterers, all.scatterers
    );
    assert!(3 * thinned.scatterers < all.scatterers);
    for (beam, name) in ["element", "beam"].into_iter().enumerate() {
        for (shadow, place) in ["open", "shadow"].into_iter().enumerate() {
            let kurtosis = |runs: &Runs| {
                let pings = &runs.samples[beam][shadow];
                let mut normalised = Vec::new();
                let mut worst = 0.0_f64;
                for bin in 0..CELLS / BIN {
                    let mut sum = 0.0;
                    for cell in bin * BIN..(bin + 1) * BIN {
                        let want = mu() * thinned_ring(cell, 1 + beam as i32, shadow == 1);
                        let of = pings.iter().map(|ping| ping[cell].norm_sqr() / want);
                        normalised.extend(of.clone());
                        sum += of.sum::<f64>();
                    }
                    let off_db = 10.0 * (sum / (BIN * pings.len()) as f64).log10();
                    worst = worst.max(off_db.abs());
                }
                let kurtosis = 1.0 + variance(&normalised) / mean(&normalised).powi(2);
                let statistic = smirnov(normalised);
                println!(
                    "{name}, {place}: at most {worst:.3} dB off, kurtosis {kurtosis:.3}, sqrt(n) D {statistic:.2}"
                );
                assert!(worst < 0.2, "{name}, {place}: {worst} dB");
                kurtosis
            };
            let of_thinned = kurtosis(&thinned);
            match shadow {
                0 => {
                    let of_all = kurtosis(all);
                    assert!(
                        (of_thinned - of_all).abs() < 0.1,
                        "{name}: {of_thinned}, all {of_all}"
                    );
                }
                _ => assert!(
                    of_thinned < in_shadow[beam],
                    "{name}: {of_thinned} in a shadow"
                ),
            }
        }
        let [a, b] = [all, &thinned].map(|runs| runs.correlation(beam));
        println!("{name}: correlation {b:.4}, of all {a:.4}");
        assert!((a - b).abs() < 0.02, "{name}: {b} against {a}");
    }
}

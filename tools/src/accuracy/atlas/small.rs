//! Maps of effects outside the synthesis: simplification of surfaces without curvature, and positions near the limits of
//! longitude.

use echotank_core::geodesy::LocalTangentPlane;
use echotank_core::scene::{ScatterLaw, Scatterers};
use echotank_scene::simplify::collapse::collapse;
use echotank_scene::simplify::energy::{Energies, View};
use echotank_scene::simplify::{Method, Selection, Settings, Weights};
use glam::DVec3;
use num_complex::Complex64;

use super::picture::{Map, Mark, Panel, Sign};

/// Allowed level error, dB.
const LEVEL_DB: f64 = 0.5;
/// Allowed position error after a round trip, metres.
const PLACE_M: f64 = 1e-3;

/// Name, map and sentence of each map.
pub(crate) fn maps() -> Vec<(&'static str, Map, &'static str)> {
    vec![
        ("curvature", curvature(), CURVATURE_SAYS),
        ("places", places(), PLACES_SAYS),
    ]
}

pub(crate) const CURVATURE_SAYS: &str = "On flat ground, behind a wall, on one point and on three in a line the paper's energies are\n\
    undefined (0/0). Those of Echotank have a floor. `acoustic` loses the level of removed points by\n\
    design; `acoustic-unbiased` and inherited areas keep it.";
pub(crate) const PLACES_SAYS: &str = "Positions converted over a kilometre return to the same latitude and longitude within a micrometre.\n\
    This holds across the antimeridian and both poles.";

fn ratio(value: f64, tolerance: f64) -> Mark {
    match value.is_finite() {
        true => Mark::Ratio {
            log10: (value.abs().max(1e-30) / tolerance).log10(),
            sign: Sign::None,
        },
        false => Mark::Shout,
    }
}

/// A bottom of points with its triangulation.
struct Ground {
    scatterers: Scatterers,
    triangles: Vec<[u32; 3]>,
}

/// 21 by 21 points spaced 0.5 m, 20 m to starboard.
fn patch(down_m: impl Fn(f64, f64) -> f64) -> Ground {
    const SIDE: u32 = 21;
    let mut scatterers = Scatterers::default();
    let mut triangles = Vec::new();
    for r in 0..SIDE {
        for c in 0..SIDE {
            let (n, e) = (0.5 * f64::from(r) - 5.0, 0.5 * f64::from(c) - 5.0);
            let at_m = DVec3::new(n, 20.0 + e, down_m(n, e));
            push(&mut scatterers, at_m);
            let at = r * SIDE + c;
            if r + 1 < SIDE && c + 1 < SIDE {
                triangles.push([at, at + 1, at + SIDE + 1]);
                triangles.push([at, at + SIDE + 1, at + SIDE]);
            }
        }
    }
    Ground {
        scatterers,
        triangles,
    }
}

fn few(count: u32) -> Ground {
    let mut scatterers = Scatterers::default();
    for k in 0..count {
        push(&mut scatterers, DVec3::new(f64::from(k), 20.0, 10.0));
    }
    Ground {
        scatterers,
        triangles: Vec::new(),
    }
}

fn push(scatterers: &mut Scatterers, at_m: DVec3) {
    let turn = 2.4 * scatterers.len() as f64;
    let strength = Complex64::from_polar(1.0, turn);
    scatterers.push(at_m, [0.0, 0.0, -1.0], strength, ScatterLaw::Lambert);
}

fn curvature() -> Map {
    let grounds: Vec<(&str, Ground)> = vec![
        ("flat", patch(|_, _| 10.0)),
        ("slope", patch(|n, e| 10.0 + 0.2 * n - 0.1 * e)),
        ("ridge", patch(|n, _| 10.0 + 0.3 * n.abs())),
        ("cylinder", patch(|n, _| 30.0 - (400.0 - n * n).sqrt())),
        (
            "sphere",
            patch(|n, e| 30.0 - (400.0 - n * n - e * e).sqrt()),
        ),
        ("saddle", patch(|n, e| 10.0 + 0.02 * n * e)),
        (
            "rough",
            patch(|n, e| 10.0 + 0.1 * (7.0 * n).sin() * (5.0 * e).cos()),
        ),
        // The first row hides all others.
        (
            "behind a wall",
            patch(|_, e| if e < -4.9 { -30.0 } else { 10.0 }),
        ),
        ("one point", few(1)),
        ("a line of three", few(3)),
        ("nothing", few(0)),
    ];
    let methods: [(&str, Option<Method>); 4] = [
        ("acoustic", Some(Method::Acoustic)),
        ("as printed", Some(Method::Paper)),
        ("acoustic-unbiased", Some(Method::Unbiased)),
        ("conventional, inheriting area", None),
    ];
    let marks = methods
        .iter()
        .map(|(_, method)| grounds.iter().map(|(_, g)| level(g, *method)).collect())
        .collect();
    Map {
        title: "Simplification to half the points, where curvature is zero or cannot be told"
            .into(),
        about: format!(
            "error: how far the level of what is kept lies from that of all that is visible (unbiased: mean of 16 draws), over {LEVEL_DB} dB"
        ),
        axis: "shape of the bottom".into(),
        columns: grounds.iter().map(|(name, _)| (*name).to_owned()).collect(),
        rows: methods.iter().map(|(name, _)| (*name).to_owned()).collect(),
        gaps: Vec::new(),
        framed: Vec::new(),
        panels: vec![Panel {
            title: String::new(),
            marks,
            rings: Vec::new(),
        }],
        plan: None,
    }
}

/// Mark of the level error of a method. NaN energies are marked.
fn level(ground: &Ground, method: Option<Method>) -> Mark {
    let Ground {
        scatterers,
        triangles,
    } = ground;
    let count = scatterers.len();
    let keep = count.div_ceil(2);
    let energy = |i: usize| scatterers.strength[i].norm_sqr();
    let db = |kept: f64, all: f64| 10.0 * (kept / all).log10();
    let Some(method) = method else {
        let places: Vec<DVec3> = (0..count).map(|i| scatterers.position_m(i)).collect();
        let left = collapse(&places, triangles, keep);
        let kept = left.kept.iter().zip(&left.area_share);
        let sum: f64 = kept.map(|(&i, share)| share * energy(i as usize)).sum();
        let all: f64 = (0..count).map(energy).sum();
        return if all == 0.0 {
            Mark::Silence
        } else {
            ratio(db(sum, all), LEVEL_DB)
        };
    };
    let view = View {
        apex_m: DVec3::ZERO,
        beams: Vec::new(),
        slack_m: 0.0,
        slack_rad: 0.0,
        shadows: true,
    };
    let mut levels = Vec::new();
    let draws = if method == Method::Unbiased { 16 } else { 1 };
    for seed in 0..draws {
        let settings = Settings {
            method,
            keep,
            weights: Weights::default_of(method),
            seed,
        };
        let mut energies = Energies::default();
        energies.evaluate(scatterers, count, &view, &settings, None);
        if energies.energy.iter().any(|e| e.is_nan()) {
            return Mark::Shout;
        }
        let visible: f64 = (0..count)
            .filter(|&i| !energies.hidden[i])
            .map(energy)
            .sum();
        if visible == 0.0 {
            return Mark::Silence;
        }
        let mut selection = Selection::default();
        let rule = selection.rule(&energies, count, &settings);
        selection.apply(rule, scatterers, &energies, count, seed);
        let kept = selection.kept.iter().zip(&selection.gain);
        let kept: f64 = kept
            .filter(|(i, _)| !energies.hidden[**i as usize])
            .map(|(&i, gain)| gain * gain * energy(i as usize))
            .sum();
        levels.push(kept / visible);
    }
    ratio(
        db(levels.iter().sum::<f64>() / levels.len() as f64, 1.0),
        LEVEL_DB,
    )
}

/// Largest error of a round trip of points 1 km away through latitude and longitude, metres. NaN if an error is NaN.
pub(crate) fn place_error_m(latitude_deg: f64, longitude_deg: f64) -> f64 {
    let plane = LocalTangentPlane::new(latitude_deg.to_radians(), longitude_deg.to_radians());
    let error_m = |k: i32| {
        let (sin, cos) = (std::f64::consts::TAU * f64::from(k) / 16.0).sin_cos();
        let (latitude, longitude) = plane.geodetic_rad(1000.0 * cos, 1000.0 * sin);
        let (north_m, east_m) = plane.local_m(latitude, longitude);
        (north_m - 1000.0 * cos).hypot(east_m - 1000.0 * sin)
    };
    let worse = |worst: f64, e: f64| if e > worst || e.is_nan() { e } else { worst };
    (0..16).map(error_m).fold(0.0, worse)
}

fn places() -> Map {
    let latitudes_deg = [
        0.0, 30.0, 60.0, 80.0, 85.0, 89.0, 89.9, 89.99, 89.999, 90.0, -89.99, -90.0,
    ];
    let longitudes: [(&str, f64); 3] = [
        ("at 18 E", 18.0),
        ("at 179.9999 E", 179.9999),
        ("at 180 W", -180.0),
    ];
    let marks = longitudes
        .iter()
        .map(|(_, longitude)| {
            let row = latitudes_deg.iter();
            row.map(|&latitude| ratio(place_error_m(latitude, *longitude), PLACE_M))
                .collect()
        })
        .collect();
    Map {
        title: "Places near the poles and over the antimeridian".into(),
        about: "error: metres by which points 1 km away come back from latitude and longitude, over 1 mm".into(),
        axis: "latitude of the origin, degrees".into(),
        columns: latitudes_deg.iter().map(|l| format!("{l}")).collect(),
        rows: longitudes.iter().map(|(name, _)| (*name).to_owned()).collect(),
        gaps: Vec::new(),
        framed: Vec::new(),
        panels: vec![Panel {
            title: String::new(),
            marks,
            rings: Vec::new(),
        }],
        plan: None,
    }
}

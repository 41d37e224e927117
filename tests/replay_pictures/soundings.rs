//! Bottom detection through the whole pipeline: navigation, scene, echoes, elements, beams. The long form is `tools/soundings`.

use echotank::config::spec::Density;

use super::measure::{Case, Soundings, agreement, measure, spec};

/// Of a short line: beams of 2.4 degrees instead of 0.8.
const ELEMENTS: usize = 48;
const BEAMS: usize = 41;

fn soundings(case: Case, pings: usize, every_s: f64) -> Soundings {
    let folder = tempfile::tempdir().expect("a folder");
    let mut spec = spec(case, folder.path(), ELEMENTS, BEAMS).expect("a rig");
    // 60 degrees reach the bottom, 47 m below, at 94 m.
    spec.sonars[0].settings.range_m = 95.0;
    if let Some(seabed) = &mut spec.scene.seabed {
        seabed.density = Density::PerM2(4.0);
    }
    let found = measure(case, &spec, pings, every_s).expect("soundings");
    print!("{}", found.table(20.0));
    found
}

fn holds(found: &Soundings, mean_m: f64, p95_m: f64) {
    let rows = found.rows(20.0);
    assert_eq!(rows.len(), 3, "0 to 60 degrees");
    for row in &rows {
        assert!(row.share > 0.9, "found {:.2} of the beams", row.share);
        assert!(
            row.mean_m.abs() < mean_m,
            "mean {} m, want {mean_m}",
            row.mean_m
        );
        assert!(row.p95_m < p95_m, "95 % {} m, want {p95_m}", row.p95_m);
    }
    let (inner, outer) = (rows[0].by_phase, rows[2].by_phase);
    assert!(
        inner < 0.7 && outer > 0.8,
        "by phase: {inner} inside, {outer} outside"
    );
}

/// Means within 0.2 % of the depth and 95 % within 1 % of it (IHO S-44 order 1a allows 0.5 m + 1.3 %), from nadir to 60 degrees.
#[test]
fn soundings_lie_on_a_flat_bottom_and_on_a_slope() {
    holds(&soundings(Case::Flat, 3, 2.0), 0.1, 0.5);
    let slope = soundings(Case::Slope, 3, 2.0);
    for row in slope.rows(20.0) {
        assert!(
            row.share > 0.8 && row.mean_m.abs() < 0.15 && row.p95_m < 0.7,
            "{row:?}"
        );
    }
}

/// The survey's relief, tens of centimetres over hundreds of metres, is in the soundings: no slope that backscatter could show.
#[test]
fn soundings_show_the_relief_of_a_real_survey() {
    let found = soundings(Case::Survey, 8, 28.0);
    holds(&found, 0.1, 0.5);
    let (correlation, relief_m, apart_m) = agreement(&found.relief(30.0, 5));
    println!(
        "relief {relief_m:.3} m, soundings off by {apart_m:.3} m, correlation {correlation:.2}"
    );
    assert!(correlation > 0.8, "{correlation}");
    assert!(apart_m < 0.6 * relief_m, "{apart_m} of {relief_m}");
}

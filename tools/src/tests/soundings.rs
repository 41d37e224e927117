//! Tests of bottom detection through the whole pipeline: navigation, scene, echoes, elements, beams. `tools/accuracy soundings` is
//! the long form, with a slope, a survey and a swell.

use crate::accuracy::soundings::measure::{Case, Soundings, agreement, measure, spec};

/// Number of elements of a short line: beams of 2.4 degrees instead of 0.8.
const ELEMENTS: usize = 48;
const BEAMS: usize = 41;

/// Soundings of a case, printed: consecutive pings, `every_s` apart.
fn soundings(case: Case, range_m: f64, pings: usize, every_s: f64) -> Soundings {
    let folder = tempfile::tempdir().expect("a folder");
    let mut spec = spec(case, folder.path(), ELEMENTS, BEAMS).expect("a rig");
    spec.sonars[0].settings.range_m = range_m;
    let found = measure(case, &spec, pings, every_s).expect("soundings");
    print!("{}", found.table(20.0));
    found
}

/// Checks the soundings. In every 20 degrees, nearly all beams detect the bottom, and the mean error is at most 0.2 % of 50 m. 95 %
/// of the soundings are within `allowed_m` of the depth.
fn within(found: &Soundings, allowed_m: fn(f64) -> f64) {
    let rows = found.rows(20.0);
    assert_eq!(rows.len(), 3, "0 to 60 degrees");
    for row in &rows {
        assert!(row.share > 0.9, "found {:.2} of the beams", row.share);
        assert!(row.mean_m.abs() < 0.1, "mean {} m", row.mean_m);
        let allowed_m = allowed_m(row.depth_m);
        assert!(row.p95_m < allowed_m, "95 % {} of {allowed_m} m", row.p95_m);
    }
}

fn one_percent(depth_m: f64) -> f64 {
    0.01 * depth_m
}

/// IHO S-44 (2022) limit of order 1a, 95 %.
fn order_1a(depth_m: f64) -> f64 {
    f64::hypot(0.5, 0.013 * depth_m)
}

#[test]
fn soundings_lie_on_a_flat_bottom_within_one_percent_of_the_depth_at_every_angle() {
    // At 60 degrees, the bottom, 46 m below, is 92 m away.
    let found = soundings(Case::Flat, 95.0, 4, 2.0);
    within(&found, one_percent);
    let rows = found.rows(20.0);
    let (inner, outer) = (rows[0].by_phase, rows[2].by_phase);
    assert!(
        inner < 0.7 && outer > 0.8,
        "by phase: {inner} inside, {outer} outside"
    );
}

/// The bottom slopes down to starboard by 10 degrees. The outermost beams have 25 degrees of grazing there, and 45 to port. The
/// footprint of this short line spans more depth than on a level bottom.
#[test]
fn soundings_lie_on_a_slope_within_order_1a_at_every_angle() {
    within(&soundings(Case::Slope, 120.0, 3, 2.0), order_1a);
}

/// The survey of the quickstart, 375 m of it. Soundings show its relief, which is too gentle to appear in echo strength.
#[test]
fn soundings_lie_on_a_survey_and_show_its_relief() {
    let found = soundings(Case::Survey, 100.0, 6, 25.0);
    within(&found, one_percent);
    let (correlation, relief_m, apart_m) = agreement(&found.relief(20.0, 4));
    println!(
        "relief {relief_m:.3} m, soundings off by {apart_m:.3} m, correlation {correlation:.3}"
    );
    assert!(correlation > 0.9, "correlation {correlation}");
}

//! Bottom detection through the whole pipeline: navigation, scene, echoes, elements, beams. The long form, with a slope, a survey and a swell, is
//! `tools/soundings`.

use super::measure::{Case, measure, spec};

/// Of a short line: beams of 2.4 degrees instead of 0.8.
const ELEMENTS: usize = 48;
const BEAMS: usize = 41;

/// Means within 0.2 % of the depth and 95 % within 1 % of it (IHO S-44 order 1a allows 0.5 m + 1.3 %), from nadir to 60 degrees.
#[test]
fn soundings_lie_on_a_flat_bottom_within_one_percent_of_the_depth_at_every_angle() {
    let folder = tempfile::tempdir().expect("a folder");
    let mut spec = spec(Case::Flat, folder.path(), ELEMENTS, BEAMS).expect("a rig");
    // 60 degrees reach the bottom, 46 m below, at 92 m.
    spec.sonars[0].settings.range_m = 95.0;
    let found = measure(Case::Flat, &spec, 4, 2.0).expect("soundings");
    print!("{}", found.table(20.0));
    let rows = found.rows(20.0);
    assert_eq!(rows.len(), 3, "0 to 60 degrees");
    for row in &rows {
        assert!(row.share > 0.9, "found {:.2} of the beams", row.share);
        assert!(row.mean_m.abs() < 0.1, "mean {} m", row.mean_m);
        assert!(row.p95_m < 0.5, "95 % {} m", row.p95_m);
    }
    let (inner, outer) = (rows[0].by_phase, rows[2].by_phase);
    assert!(
        inner < 0.7 && outer > 0.8,
        "by phase: {inner} inside, {outer} outside"
    );
}

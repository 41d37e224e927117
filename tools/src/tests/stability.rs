//! Tests that recompute stored tables of errors: pass or fail, and two digits.

use crate::accuracy::errors::table::{Case, METHODS, measure};
use crate::accuracy::errors::{images, table};

/// Compares every fourth of the last rows of a kept table; `tools/accuracy errors --keep` computes all rows.
fn holds<C>(name: &str, heading: &str, cases: Vec<C>, row: impl Fn(C) -> String) {
    let kept = std::fs::read_to_string(crate::report::kept(name)).expect("a kept table");
    assert!(kept.contains(heading));
    let rows: Vec<&str> = kept.lines().collect();
    let rows = &rows[rows.len() - cases.len()..];
    let mut different = Vec::new();
    for (case, kept) in cases.into_iter().zip(rows).step_by(4) {
        let got = row(case);
        if got != *kept {
            different.push(format!("kept {kept}\ngot  {got}"));
        }
    }
    assert!(different.is_empty(), "{}", different.join("\n"));
}

#[test]
fn the_kept_tables_of_errors_still_hold() {
    let samples = |case| table::row(case, &METHODS.each_ref().map(|m| measure(m, case)));
    holds("errors.txt", &table::heading(), table::cases(), samples);
    let pictures = |case: (f64, f64)| images::row(case, &images::measure(case.0, case.1));
    holds("images.txt", &images::heading(), images::cases(), pictures);
}

/// Case of the design document: 5.144 m/s (10 knots), 250 m, 60 degrees from the track, closing.
#[test]
fn eq_21_is_worse_than_no_motion_and_only_stretch_follows_the_samples() {
    let case = Case {
        speed_m_per_s: 5.144,
        range_m: 250.0,
        angle_deg: 60.0,
    };
    let errors: Vec<_> = METHODS
        .iter()
        .map(|method| (method.name, measure(method, case)))
        .collect();
    println!("{errors:?}");
    let range_m = |k: usize| errors[k].1.0;
    assert!((range_m(0) - 0.64).abs() < 0.005, "{errors:?}");
    assert!((range_m(1) - 0.42).abs() < 0.01, "{errors:?}");
    assert!(
        range_m(2).abs() < 1e-9 && range_m(3).abs() < 1e-9,
        "{errors:?}"
    );
    // Only a stretched pulse correlates with the samples.
    assert!(errors[..3].iter().all(|e| e.1.1 > 1.0), "{errors:?}");
    assert!(errors[3].1.1 < 3e-3 && errors[4].1.1 < 1e-5, "{errors:?}");
}

/// 2.572 m/s (5 knots), 75 m: samples and images have different tolerances and errors.
#[test]
fn images_tolerate_errors_that_samples_do_not_as_predicted() {
    let found = images::measure(2.572, 75.0);
    let [hop, none, stretch] = &found[..] else {
        panic!("three methods")
    };
    let near = |(want, got): (f64, f64), part: f64| (got.abs() / want - 1.0).abs() < part;
    assert!(near(hop.along_m, 0.05), "{:?}", hop.along_m);
    assert!(near(hop.ahead_m, 0.05), "{:?}", hop.ahead_m);
    assert!(near(none.ahead_m, 0.05), "{:?}", none.ahead_m);
    let stretched = [stretch.along_m.1, stretch.edge_m.1, stretch.ahead_m.1];
    assert!(stretched.iter().all(|m| m.abs() < 1e-3), "{stretched:?}");
    // Without Doppler the image passes by prediction and measurement, while the samples hardly correlate with the
    // reference.
    assert_eq!(none.passes(75.0), (true, true));
    assert!(none.element_error > 0.1, "{}", none.element_error);
}

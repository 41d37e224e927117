//! Stored tables of errors, computed again: pass or fail, and two digits.

use crate::errors::table::{Case, METHODS, measure, row};
use crate::errors::{images, table};

fn kept(name: &str) -> String {
    std::fs::read_to_string(crate::kept(name)).expect("tools/errors --keep writes it")
}

/// Every fourth row; `tools/errors --keep` makes the whole table.
#[test]
fn the_kept_table_of_errors_still_holds() {
    let kept = kept("errors.txt");
    assert!(kept.contains(&table::heading()));
    let rows: Vec<&str> = kept
        .lines()
        .filter(|l| l.contains("ass") || l.contains("fail"))
        .collect();
    let rows = &rows[rows.len() - table::cases().len()..];
    let mut different = Vec::new();
    for (case, kept) in table::cases().into_iter().zip(rows).step_by(4) {
        let got = row(case);
        if got != *kept {
            different.push(format!("kept {kept}\ngot  {got}"));
        }
    }
    assert!(different.is_empty(), "{}", different.join("\n"));
}

/// The design's own figures: 5.144 m/s (10 knots), 250 m, 60 degrees from the track, closing.
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

/// Every fourth row.
#[test]
fn the_kept_table_of_pictures_still_holds() {
    let kept = kept("images.txt");
    assert!(kept.contains(&images::heading()));
    let cases = images::cases();
    let rows: Vec<&str> = kept.lines().collect();
    let rows = &rows[rows.len() - cases.len()..];
    let mut different = Vec::new();
    for (case, kept) in cases.into_iter().zip(rows).step_by(4) {
        let got = images::row(case);
        if got != *kept {
            different.push(format!("kept {kept}\ngot  {got}"));
        }
    }
    assert!(different.is_empty(), "{}", different.join("\n"));
}

/// 2.572 m/s (5 knots), 75 m: two tolerances, two numbers.
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
    // Without Doppler the image passes by prediction and measurement, while the samples hardly correlate with the truth.
    assert_eq!(none.passes(75.0), (true, true));
    assert!(none.element_error > 0.1, "{}", none.element_error);
}

//! Kept tables of errors, made anew: pass or fail and two digits.

#[path = "../tools/src/errors/table.rs"]
mod table;

use std::path::Path;

use table::{Case, METHODS, measure, row};

fn kept() -> String {
    let file = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/stability/errors.txt");
    std::fs::read_to_string(file).expect("tools/errors --keep writes it")
}

/// Every fourth row; `tools/errors --keep` makes the whole table.
#[test]
fn the_kept_table_of_errors_still_holds() {
    let kept = kept();
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
    // Nothing but a stretched pulse has anything in common with the samples.
    assert!(errors[..3].iter().all(|e| e.1.1 > 1.0), "{errors:?}");
    assert!(errors[3].1.1 < 3e-3 && errors[4].1.1 < 1e-5, "{errors:?}");
}

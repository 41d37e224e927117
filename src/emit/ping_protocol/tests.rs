use super::*;

#[test]
fn a_stretch_of_many_samples_has_their_mean_power_and_one_between_two_is_read_between_them() {
    let mut levels = Vec::new();
    let line = [1.0, 3.0, 1.0, 3.0];
    mean_levels_db(&line, 0.0, 2.0, 2, &mut levels);
    for level in &levels {
        assert!(
            (level - (10.0 * 5.0_f64.log10() + 120.0)).abs() < 1e-9,
            "{level}"
        );
    }
    // Around 0.5: half of 1 and half of 9.
    mean_levels_db(&line, 0.25, 0.5, 1, &mut levels);
    assert!(
        (levels[0] - (10.0 * 5.0_f64.log10() + 120.0)).abs() < 1e-9,
        "{}",
        levels[0]
    );
    mean_levels_db(&line, 10.0, 1.0, 1, &mut levels);
    assert_eq!(levels[0], f64::NEG_INFINITY, "nothing is beyond the end");
}

#[test]
fn a_scale_spans_what_there_is_and_a_line_of_one_level_has_one_too() {
    assert_eq!(scale(&[60.0, 100.0, f64::NEG_INFINITY]), (60.0, 100.0));
    assert_eq!(scale(&[-60.0, 100.0]), (0.0, 100.0), "no more than 100 dB");
    assert_eq!(scale(&[50.0]), (49.0, 50.0));
    assert_eq!(scale(&[f64::NEG_INFINITY]), (0.0, 1.0));
}

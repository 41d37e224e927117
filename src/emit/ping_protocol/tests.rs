use super::*;

#[test]
fn an_interval_has_the_mean_power_of_its_samples_or_an_interpolated_power() {
    let mut levels = Vec::new();
    let line = [1.0, 3.0, 1.0, 3.0];
    mean_levels_db(&line, 0.0, 2.0, 2, &mut levels);
    for level in &levels {
        assert!(
            (level - (10.0 * 5.0_f64.log10() + 120.0)).abs() < 1e-9,
            "{level}"
        );
    }
    // The interval around 0.5 has half the power of 1 and half that of 9.
    mean_levels_db(&line, 0.25, 0.5, 1, &mut levels);
    assert!(
        (levels[0] - (10.0 * 5.0_f64.log10() + 120.0)).abs() < 1e-9,
        "{}",
        levels[0]
    );
    mean_levels_db(&line, 10.0, 1.0, 1, &mut levels);
    assert_eq!(
        levels[0],
        f64::NEG_INFINITY,
        "no power beyond the end of the line"
    );
}

#[test]
fn the_scale_spans_the_levels_and_is_never_empty() {
    assert_eq!(scale(&[60.0, 100.0, f64::NEG_INFINITY]), (60.0, 100.0));
    assert_eq!(scale(&[-60.0, 100.0]), (0.0, 100.0), "no more than 100 dB");
    assert_eq!(scale(&[50.0]), (49.0, 50.0));
    assert_eq!(scale(&[f64::NEG_INFINITY]), (0.0, 1.0));
}

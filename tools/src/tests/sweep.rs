//! Tests of tolerances. Every method that answers meets the requested tolerance in every window, with noise 55 dB below the
//! strongest. `tools/accuracy sweep` is the long form.

use crate::accuracy::sweep::case::{self, Case, MOTIONS, SCENES};
use crate::accuracy::sweep::measure::{self, Truth, worst_window};
use crate::accuracy::sweep::methods::{Method, Reason};
use crate::accuracy::sweep::table::{Row, TOLERANCES};
use echotank_core::model::Synthesis;
use echotank_core::pulse::FLOOR_BELOW_STRONGEST_DB;
use num_complex::Complex64;

/// Number of echoes of a case: a few per window, so that a test takes seconds.
const SCATTERERS: usize = 30;

/// Sweep over the first element of a few, or both ends of a line.
fn sweep(scene: usize, motion: usize) -> (usize, Vec<String>) {
    let mut case = SCENES[scene].case(&MOTIONS[motion], SCATTERERS);
    case.looked_at = match case.rx.elements {
        1..=8 => vec![0],
        elements => vec![0, elements - 1],
    };
    let truth = measure::truth(&case);
    let (mut answers, mut broken) = (0, Vec::new());
    for method in Method::of(&case) {
        let row = Row::of(method, &case, &truth, &TOLERANCES);
        print!("{}", row.text(&case));
        for cell in &row.cells {
            let outcome = &cell.outcome;
            assert!(cell.holds(|e| e.beside), "beside its echoes: {outcome:?}");
        }
        answers += row.cells.iter().filter(|c| c.outcome.is_ok()).count();
        broken.extend(row.broken().map(|cell| {
            format!(
                "{}, {}, {}: {:?} asked for {:e}",
                case.scene,
                case.motion,
                method.name(),
                cell.outcome,
                cell.tolerance
            )
        }));
    }
    (answers, broken)
}

#[test]
fn a_sonar_at_rest_meets_its_tolerance() {
    let (answers, broken) = sweep(1, 0);
    assert!(broken.is_empty(), "{broken:#?}");
    // direct answers to 1e-4, spectral to 1e-5, gridded-1d to 1e-8.
    assert!(answers >= 4 + 5 + 8, "{answers}");
}

#[test]
fn a_moving_line_meets_its_tolerance() {
    let (answers, broken) = sweep(4, 3);
    assert!(broken.is_empty(), "{broken:#?}");
    assert!(answers >= 4 + 1 + 3, "{answers}");
}

/// Checks every answer of a method, in noise and beside its echoes. Returns the number of answers.
fn held(method: Method, case: &Case, truth: &Truth, tolerances: &[f64]) -> usize {
    let cells = Row::of(method, case, truth, tolerances).cells;
    for cell in &cells {
        assert!(
            cell.holds(|e| e.in_noise) && cell.holds(|e| e.beside),
            "{}: {:?} asked for {:e}: {}",
            method.name(),
            cell.outcome,
            cell.tolerance,
            case::describe(case)
        );
    }
    cells.iter().filter(|cell| cell.outcome.is_ok()).count()
}

/// Random pulse, filter, arrays, ranges and motion. The seeds include past failures:
/// - short tapers with the filter of `direct` (2, 25);
/// - a pure tone without a filter, with the phase error of a model at the ends of echoes (9);
/// - tones on samples (16);
/// - edges that cross the end of the filter (12);
/// - two echoes that begin or end together and almost cancel in a window without others (48, 103, 120);
/// - echoes near the null of a turning element (75).
#[test]
fn random_scenes_meet_their_tolerance_with_noise_floor() {
    let mut answers = 0;
    for seed in [0, 2, 9, 12, 16, 25, 48, 75, 103, 120] {
        let mut case = case::random(seed);
        case.looked_at = match seed {
            75 => case.looked_at[2..].to_vec(),
            _ => vec![0],
        };
        let truth = measure::truth(&case);
        for method in Method::of(&case) {
            answers += held(method, &case, &truth, &TOLERANCES[..5]);
        }
    }
    println!("{answers} answers");
    assert!(answers > 20, "{answers}");
}

/// Random scenes at rest, in windows with only the end of an echo. The seeds include past failures:
/// - truncation of the spectrum of sharp edges in the stop band of the receiver filter (4.0e-6 of scene 61, which is refused at 1e-6, 2.6e-6 of 92);
/// - a kernel over delay that extends beyond echoes (1.5e-4 of 188).
#[test]
fn random_ends_of_echoes_meet_their_tolerance() {
    let mut answers = 0;
    for (seed, tolerance) in [(61, 1e-6), (61, 3e-6), (92, 1e-6), (188, 1e-4)] {
        let case = case::random(seed);
        let truth = measure::truth(&case);
        for cell in Row::of(Method(Synthesis::Gridded1d), &case, &truth, &[tolerance]).cells {
            answers += usize::from(cell.outcome.is_ok());
            assert!(
                cell.holds(|e| e.in_noise),
                "{:?}: {}",
                cell.outcome,
                case::describe(&case)
            );
        }
    }
    assert_eq!(answers, 3);
}

/// Random line arrays: patterns, Lambert bottoms, near scatterers, and weak ends of a record. Motion across the line is refused.
/// The seeds include past failures:
/// - image echoes of piecewise linear templates (2, 120, 141, 149);
/// - extrapolated dilation over a narrow span of slopes (68, 117);
/// - out-of-band energy (32);
/// - tones that cancel (172);
/// - echoes near the null of elements that then move out of the null (47);
/// - a window with the starts of three echoes that cancel (170).
#[test]
fn random_lines_meet_their_tolerance_with_noise_floor() {
    let mut answers = 0;
    for seed in [18, 32, 47, 68, 106, 117, 120, 141, 142, 149, 170, 172] {
        let mut case = case::random(seed);
        // Both seeds failed at other elements than the first.
        if ![47, 170].contains(&seed) {
            case.looked_at.truncate(1);
        }
        let truth = measure::truth(&case);
        let method = Method(Synthesis::Gridded2d);
        answers += held(method, &case, &truth, &TOLERANCES[..4]);
    }
    println!("{answers} answers");
    assert!(answers >= 20, "{answers}");
}

#[test]
fn unreachable_tolerances_are_refused_with_their_cause() {
    let refused = |motion: usize, method: Method, tolerance| {
        let case = SCENES[0].case(&MOTIONS[motion], 5);
        let truth = measure::truth(&case);
        match method.within(tolerance, &case, &truth) {
            Ok((chosen, _)) => panic!("{} answers: {}", method.name(), chosen.text()),
            Err(refused) => refused,
        }
    };
    let model = refused(2, Method(Synthesis::Linear), 1e-3);
    assert_eq!(model.by, Reason::Model);
    assert!(
        model.message.contains("none has an error of"),
        "{}",
        model.message
    );
    let sum = refused(0, Method(Synthesis::Direct), 1e-7);
    assert_eq!(sum.by, Reason::Sum);
    assert!(
        sum.message.contains("direct has an error of"),
        "{}",
        sum.message
    );
}

/// Three elements with 400 samples. All are 1 except those of the third element from 300 on, which are 1e-9.
fn level() -> Vec<Vec<Complex64>> {
    let weak = |k: usize| if k < 300 { 1.0 } else { 1e-9 };
    let record = |value: &dyn Fn(usize) -> f64| (0..400).map(|k| value(k).into()).collect();
    vec![record(&|_| 1.0), record(&|_| 1.0), record(&weak)]
}

#[test]
fn a_windows_error_refers_to_itself_or_a_millionth_of_its_median() {
    let want = level();
    let mut got = want.clone();
    // One wrong sample of a full window of 100.
    got[0][50] += 1e-2;
    let error = worst_window(&got, &want, 100);
    assert!((error.without_noise / 1e-3 - 1.0).abs() < 1e-9, "{error:?}");
    assert!((error.in_noise / 1e-3 - 1.0).abs() < 1e-9, "{error:?}");
    // The last window of the third element has 1e-9. The median of the three elements is 1.
    let mut got = want.clone();
    got[2][399] += 1e-7;
    let error = worst_window(&got, &want, 100);
    assert!((error.without_noise / 1e-2 - 1.0).abs() < 1e-6, "{error:?}");
    // 55 dB is a factor of 562.
    let in_noise = 1e-8 * 10f64.powf(FLOOR_BELOW_STRONGEST_DB / 20.0);
    assert!((error.in_noise / in_noise - 1.0).abs() < 1e-6, "{error:?}");
    // A window beside it has 100 samples of full level.
    assert!((error.beside / 1e-8 - 1.0).abs() < 1e-6, "{error:?}");
}

#[test]
fn a_signal_where_none_is_received_is_an_infinite_error() {
    let mut want = level();
    want.iter_mut()
        .for_each(|record| record[250..].fill(Complex64::ZERO));
    assert_eq!(worst_window(&want, &want, 100).without_noise, 0.0);
    let mut got = want.clone();
    got[1][390] += 1e-12;
    let error = worst_window(&got, &want, 100);
    assert!(
        error.without_noise.is_infinite() && error.in_noise < 1e-9,
        "{error:?}"
    );
    got[1][390] = f64::NAN.into();
    assert!(worst_window(&got, &want, 100).beside.is_infinite());
}

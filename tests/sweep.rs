//! The tolerance contract in short: every method that answers is as good as was asked. `tools/sweep` is the long form.

#[allow(dead_code, reason = "shared with tools/sweep")]
#[path = "../tools/src/sweep/mod.rs"]
mod sweep;

use sweep::case::{self, MOTIONS, SCENES};
use sweep::measure;
use sweep::methods::{Method, Reason};
use sweep::table::{Row, TOLERANCES};

/// Echoes of a case: a few in every window, so that it takes seconds.
const SCATTERERS: usize = 30;

fn sweep(scene: usize, motion: usize) -> (usize, Vec<String>) {
    let case = SCENES[scene].case(&MOTIONS[motion], SCATTERERS);
    let truth = measure::truth(&case);
    let (mut answers, mut broken) = (0, Vec::new());
    for method in Method::of(&case) {
        let row = Row::of(method, &case, &truth, &TOLERANCES);
        println!("{}", row.text(&case));
        answers += row.cells.iter().filter(|c| c.outcome.is_ok()).count();
        // So few echoes leave windows that hold nothing but the end of one.
        broken.extend(
            row.broken()
                .filter(|cell| !cell.holds_beside())
                .map(|cell| {
                    format!(
                        "{}, {}, {}: {:?} asked for {:e}",
                        case.scene,
                        case.motion,
                        method.name(),
                        cell.outcome,
                        cell.tolerance
                    )
                }),
        );
    }
    (answers, broken)
}

#[test]
fn a_still_sonar_is_as_good_as_asked() {
    let (answers, broken) = sweep(1, 0);
    assert!(broken.is_empty(), "{broken:#?}");
    // direct to 1e-4, spectral to 1e-5, gridded-1d to 1e-8.
    assert!(answers >= 4 + 5 + 8, "{answers}");
}

#[test]
fn a_line_under_way_is_as_good_as_asked() {
    let (answers, broken) = sweep(4, 3);
    assert!(broken.is_empty(), "{broken:#?}");
    assert!(answers >= 4 + 1 + 3, "{answers}");
}

/// Pulse, filter, arrays, ranges and motion by chance, each window against those that share samples with it.
#[test]
fn chance_finds_no_answer_worse_than_asked() {
    let mut answers = 0;
    for seed in [0, 2, 12, 25, 31, 40, 142, 154] {
        let case = case::random(seed);
        let truth = measure::truth(&case);
        for method in Method::of(&case) {
            for cell in Row::of(method, &case, &truth, &TOLERANCES[..4]).cells {
                answers += usize::from(cell.outcome.is_ok());
                assert!(
                    cell.holds_beside(),
                    "{}: {:?} asked for {:e}: {}",
                    method.name(),
                    cell.outcome,
                    cell.tolerance,
                    case::describe(&case)
                );
            }
        }
    }
    assert!(answers > 20, "{answers}");
}

#[test]
fn what_cannot_be_reached_is_refused_with_what_stands_in_the_way() {
    let case = SCENES[0].case(&MOTIONS[2], 5);
    let truth = measure::truth(&case);
    let refused = |method: Method, tolerance| match method.within(tolerance, &case, &truth) {
        Ok((chosen, _)) => panic!("{} answers: {}", method.name(), chosen.text()),
        Err(refused) => refused,
    };
    let model = refused(Method::Linear, 1e-3);
    assert_eq!(model.by, Reason::Model);
    assert!(
        model.message.contains("none is off by"),
        "{}",
        model.message
    );
    let sum = refused(Method::Direct, 1e-4);
    assert_eq!(sum.by, Reason::Sum);
    assert!(sum.message.contains("direct is off by"), "{}", sum.message);
}

//! Tests of the measurements of `echotank chart` on a small random rig with automatic method
//! selection.

use echotank_runtime::chart::{ChartOptions, measure};

use crate::accuracy::rigs::case;

#[test]
fn a_chart_has_one_selected_method_and_a_pareto_front() {
    let folder = tempfile::tempdir().expect("folder");
    let (spec, about) = case::random(8, folder.path(), true);
    let options = ChartOptions {
        pings: 1,
        span_pings: 1,
        repeats: 1,
        threads: 1,
        sonar: 0,
        quick: true,
    };
    let chart = measure(&spec, &options, |_, _| {}).unwrap_or_else(|why| panic!("{about}: {why}"));
    let planned: Vec<_> = chart
        .rows
        .iter()
        .filter(|r| r.planned_ms.is_some())
        .collect();
    assert_eq!(planned.len(), 1, "{about}");
    assert!(
        planned[0].configured,
        "the plan is what is configured: {about}"
    );
    let measured = planned[0]
        .outcome
        .as_ref()
        .expect("the plan's choice can be made");
    assert!(
        measured.errors.elements <= planned[0].predicted_error,
        "{:.1e} of {:.1e} promised: {about}",
        measured.errors.elements,
        planned[0].predicted_error
    );
    let front: Vec<_> = chart.rows.iter().filter(|r| r.pareto).collect();
    assert!(!front.is_empty());
    for best in front {
        let best = best.outcome.as_ref().expect("measured");
        for other in chart.rows.iter().filter_map(|r| r.outcome.as_ref().ok()) {
            let beaten = other.times.median_ms < best.times.median_ms
                && other.errors.elements < best.errors.elements;
            assert!(!beaten, "{:?} beats {:?}: {about}", other, best);
        }
    }
}

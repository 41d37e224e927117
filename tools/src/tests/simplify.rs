//! Tests of the simplification levels of the paper; `tools/paper 12` is the long form.

use crate::paper::thinning::measure::{Figures, POINT_COUNTS, SelectionTime, Simplifier, Thinning};

/// 4 pings and 2 seeds; `tools/paper 12` has 48 and 64.
#[test]
fn simplification_levels_match_the_paper_in_short() {
    let rows = Thinning::new(4).measure(2);
    let row = |points: usize, once: SelectionTime, simplifier: Simplifier| -> Figures {
        *rows
            .iter()
            .find(|r| (r.points, r.once, r.simplifier) == (points, once, simplifier))
            .unwrap()
    };
    for points in POINT_COUNTS {
        let unbiased = row(points, SelectionTime::EachPing, Simplifier::Unbiased);
        let acoustic = row(points, SelectionTime::EachPing, Simplifier::Acoustic);
        let conventional = row(points, SelectionTime::Pass, Simplifier::Conventional);
        let paper = row(points, SelectionTime::EachPing, Simplifier::Paper);
        println!("{unbiased:?}\n{acoustic:?}\n{conventional:?}\n{paper:?}");
        assert!(unbiased.level_db.abs() < 0.5, "{unbiased:?}");
        assert!(
            acoustic.image_db < conventional.image_db,
            "{acoustic:?} {conventional:?}"
        );
        assert!(
            paper.level_db < -20.0,
            "as printed it keeps the worthless: {paper:?}"
        );
        // If the selection is made once for the pass, the whole bottom is thinned. Without the weights, the
        // level falls.
        let once = row(points, SelectionTime::Pass, Simplifier::Unbiased);
        let falls = row(points, SelectionTime::Pass, Simplifier::Acoustic);
        assert!(
            falls.level_db < -2.0 && once.level_db > falls.level_db + 2.0,
            "{once:?} {falls:?}"
        );
    }
    for points in [3000, 1000] {
        for once in SelectionTime::ALL {
            let unbiased = row(points, once, Simplifier::Unbiased);
            let acoustic = row(points, once, Simplifier::Acoustic);
            assert!(
                unbiased.image_db < acoustic.image_db,
                "{unbiased:?} {acoustic:?}"
            );
        }
    }
}

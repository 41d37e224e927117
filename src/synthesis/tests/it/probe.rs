//! Tests of the error check's samples against the reference solution.

use glam::DVec3;
use num_complex::Complex64;

use echotank_core::model::{DopplerModel, PathModel};
use echotank_core::ping::PingPlan;
use echotank_synthesis::array::filter::grid_ahead;
use echotank_synthesis::array::{Decimator, Direct};
use echotank_synthesis::echo::probe::{Instant, echoes_at, receivable, receivable_ranges_m};
use echotank_synthesis::echo::reference;

use crate::paths::restless;
use crate::synthesis::busy;
use echotank_testing::echo::*;

/// One sample: value of the error check, value of the reference, and rms around the sample.
fn both(
    plan: &PingPlan,
    filter: Option<&Decimator>,
    rate_hz: f64,
    element: usize,
    time_s: f64,
) -> (Complex64, Complex64) {
    let (tx, rx, scatterers) = busy();
    let (first_s, dense_rate_hz, len) = grid_ahead(filter, time_s, rate_hz, 1);
    let sampled = |dense: &[Complex64]| match filter {
        Some(d) => {
            let mut out = [Complex64::ZERO];
            d.apply(dense, &mut out);
            out[0]
        }
        None => dense[0],
    };
    let at = Instant {
        element,
        time_s,
        half_span_s: 0.5 * len as f64 / dense_rate_hz,
    };
    let mut candidates = Vec::new();
    let ranges_m = [receivable_ranges_m(plan, &tx, &rx, at)];
    receivable(plan, &scatterers, &ranges_m, &mut candidates);
    let mut dense = vec![Complex64::ZERO; len];
    echoes_at(
        plan,
        &tx,
        &rx,
        at,
        &scatterers,
        candidates.iter().map(|(i, _)| *i as usize),
        &mut Direct::new(plan, dense_rate_hz, first_s, &mut dense)
            .with_ends(filter.map(Decimator::ends)),
    );
    let got = sampled(&dense);
    let mut want = [Complex64::ZERO];
    reference(
        plan,
        &tx,
        &rx,
        element,
        &scatterers,
        filter,
        rate_hz,
        time_s,
        &mut want,
    );
    (got, want[0])
}

#[test]
fn a_probed_sample_is_the_references_to_1e_6_of_the_rms() {
    for taper in [0.0, 0.1] {
        let mut plan = restless();
        plan.pulse.taper = taper;
        // The error check must not use the selected models.
        chords(&mut plan, 0.256, 2);
        plan.model.path = PathModel::StopAndHop;
        plan.model.doppler = DopplerModel::None;
        plan.model.cull_db = Some(-3.0);
        // At low density both sum the same points, and the slow reference is affordable.
        let filter = Decimator::new(&plan.pulse, 40e3, 300.0, 6).expect("40 kHz is enough");
        for filter in [None, Some(&filter)] {
            let pairs: Vec<_> = (0..20)
                .map(|k| {
                    let time_s = 0.03 + 0.09 * weyl(k, 0);
                    both(&plan, filter, 40e3, k % 8, time_s)
                })
                .collect();
            let (got, want): (Vec<_>, Vec<_>) = pairs.into_iter().unzip();
            let error = relative_l2(&got, &want);
            println!("taper {taper}, filter {}: {error:.1e}", filter.is_some());
            assert!(error < 1e-6, "{error:e}");
        }
    }
}

/// Points excluded by range do not contribute: all scatterers give the same samples.
#[test]
fn finding_scatterers_by_range_misses_none() {
    let mut plan = restless();
    chords(&mut plan, 0.256, 4);
    let (tx, rx, scatterers) = busy();
    let instants: Vec<Instant> = (0..64)
        .map(|k| Instant {
            element: k % 8,
            time_s: 0.15 * weyl(k, 0),
            half_span_s: 5e-4,
        })
        .collect();
    let ranges_m: Vec<_> = instants
        .iter()
        .map(|at| receivable_ranges_m(&plan, &tx, &rx, *at))
        .collect();
    let mut found = Vec::new();
    receivable(&plan, &scatterers, &ranges_m, &mut found);
    let mut left_out = 0;
    for (k, at) in instants.iter().enumerate() {
        let echoes = |indices: &mut dyn Iterator<Item = usize>| {
            let mut sink = Collected::default();
            echoes_at(&plan, &tx, &rx, *at, &scatterers, indices, &mut sink);
            sink.arrivals
        };
        let mut among = found
            .iter()
            .filter(|(_, mask)| mask >> k & 1 == 1)
            .map(|(i, _)| *i as usize);
        let by_range = echoes(&mut among);
        assert_eq!(by_range, echoes(&mut (0..scatterers.len())), "instant {k}");
        left_out += scatterers.len() - by_range.len();
    }
    assert!(left_out > 64 * 150, "{left_out}");
    // Invalid and very distant positions.
    let mut odd = points([DVec3::NAN, DVec3::splat(1e300), DVec3::ZERO]);
    odd.north_m[1] = f64::INFINITY;
    receivable(&plan, &odd, &ranges_m, &mut found);
    let mut sink = Collected::default();
    echoes_at(&plan, &tx, &rx, instants[3], &odd, 0..3, &mut sink);
    assert!(sink.arrivals.iter().all(|a| a.delay_s.is_finite()));
    receivable(&plan, &odd, &[], &mut found);
    assert!(found.is_empty());
}

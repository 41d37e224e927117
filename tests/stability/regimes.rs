//! Where methods fail, held on either side of the boundary: no number that is none, no panic, no wrong answer that was promised to be right, no plan
//! inside a failing region. A short pulse and two elements, four regimes of twenty: each takes seconds. `tools/atlas` draws the long form.

use std::f64::consts::TAU;

use echotank::flow::{DopplerModel, PathModel, ScatterLaw, Scatterers, Synthesis};
use echotank::geodesy::LocalTangentPlane;
use echotank::run::rig::pool;
use echotank::scene::simplify::energy::{Energies, View};
use echotank::scene::simplify::{Method, Selection, Settings, Weights};
use glam::DVec3;
use num_complex::Complex64;

use crate::atlas::measure::{Bench, Column, DOPPLERS, Outcome, SUMS};
use crate::atlas::regimes::{ALL, Regime};
use crate::atlas::spot::{Base, Size};

fn regime(name: &str) -> &'static Regime {
    let found = ALL.iter().find(|regime| regime.name == name);
    found.unwrap_or_else(|| panic!("no regime {name}"))
}

fn columns(regime: &Regime) -> Vec<(f64, Column)> {
    let base = Base::new(Size::SMALL);
    let pool = pool(1).expect("threads");
    let mut bench = Bench::default();
    let values = regime.few.iter();
    pool.install(|| {
        values
            .map(|&v| (v, bench.column(&(regime.spot)(&base, v))))
            .collect()
    })
}

/// What holds everywhere. Hands on the columns for what holds here.
fn swept(name: &str) -> Vec<(f64, Column)> {
    let regime = regime(name);
    let columns = columns(regime);
    for (value, column) in &columns {
        let label = regime.label(*value);
        for (method, outcome) in column.named() {
            let said = format!("{name}, {label}: {method}: {outcome:?}");
            assert!(
                !matches!(outcome, Outcome::NoNumber | Outcome::Panic(_)),
                "{said}"
            );
            assert!(
                regime.is_blind() || !outcome.is_silently_wrong(column.tolerance),
                "promised {:e}: {said}",
                column.tolerance
            );
            if let Outcome::Refused(why) = outcome {
                assert!(why.len() > 10, "a refusal says why: {said}");
            }
        }
        if let Some(plan) = &column.plan {
            let said = format!("{name}, {label}: plan {}: {:?}", plan.text, plan.outcome);
            assert!(
                regime.is_blind() || plan.out_of_reach || plan.outcome.is_within(column.tolerance),
                "{said}"
            );
            assert!(
                !matches!(
                    plan.outcome,
                    Outcome::Refused(_) | Outcome::NoNumber | Outcome::Panic(_)
                ),
                "{said}"
            );
        }
    }
    columns
}

fn cell(column: &Column, synthesis: Synthesis, path: PathModel, doppler: DopplerModel) -> &Outcome {
    let at = |of: Option<usize>| of.expect("in the lists");
    column.cell(
        at(SUMS.iter().position(|s| *s == synthesis)),
        at(DOPPLERS.iter().position(|d| *d == doppler)),
        at(PathModel::ALL.iter().position(|p| *p == path)),
    )
}

fn best(column: &Column) -> &Outcome {
    cell(
        column,
        Synthesis::Direct,
        PathModel::Continuous,
        DopplerModel::StretchQuadratic,
    )
}

fn error(outcome: &Outcome) -> f64 {
    match outcome {
        Outcome::Answer { error, .. } => *error,
        other => panic!("no answer: {other:?}"),
    }
}

fn at(columns: &[(f64, Column)], value: f64) -> &Column {
    let found = columns.iter().find(|(v, _)| *v == value);
    &found.unwrap_or_else(|| panic!("{value} is no column")).1
}

#[test]
fn tolerance() {
    assert!(!swept("tolerance").is_empty());
}

#[test]
fn speed() {
    let columns = swept("speed");
    assert!(matches!(best(at(&columns, 151.0)), Outcome::Refused(why) if why.contains("151 m/s")));
    assert!(at(&columns, 151.0).plan.is_none());
    let cruise = at(&columns, 2.572);
    let printed = cell(
        cruise,
        Synthesis::Spectral,
        PathModel::Polyline,
        DopplerModel::PaperEq21,
    );
    assert!(error(printed) > 0.5, "{printed:?}");
    assert!(best(cruise).is_within(1e-3), "{:?}", best(cruise));
}

#[test]
fn navigation_faults() {
    let columns = swept("navigation-faults");
    // A jump of 500 m in a tenth of a second; a gap that is no gap; another clock.
    for refused in [5.0, 8.0] {
        let outcome = best(at(&columns, refused));
        assert!(
            matches!(outcome, Outcome::Refused(_)),
            "{refused}: {outcome:?}"
        );
    }
    for answered in [0.0, 1.0, 2.0] {
        let outcome = best(at(&columns, answered));
        assert!(outcome.is_within(1e-2), "{answered}: {outcome:?}");
    }
}

#[test]
fn scatterers() {
    let columns = swept("scatterers");
    for (method, outcome) in at(&columns, 0.0).named() {
        let quiet = matches!(
            outcome,
            Outcome::Silence | Outcome::NotTaken | Outcome::Refused(_)
        );
        assert!(quiet, "{method}: {outcome:?}");
    }
}

#[test]
fn places_come_back_over_poles_and_antimeridian() {
    for latitude_deg in [0.0, 60.0, 89.9999, 90.0, -90.0] {
        for longitude_deg in [0.0f64, 179.99999, -180.0] {
            let plane =
                LocalTangentPlane::new(f64::to_radians(latitude_deg), longitude_deg.to_radians());
            for k in 0..8 {
                let (sin, cos) = (TAU * f64::from(k) / 8.0).sin_cos();
                let (want_n, want_e) = (1000.0 * cos, 1000.0 * sin);
                let (latitude, longitude) = plane.geodetic_rad(want_n, want_e);
                let (got_n, got_e) = plane.local_m(latitude, longitude);
                let off_m = (got_n - want_n).hypot(got_e - want_e);
                assert!(off_m < 1e-6, "{latitude_deg} {longitude_deg}: {off_m} m");
            }
        }
    }
}

#[test]
fn simplification_has_a_number_for_every_surface() {
    let ground = |count: u32, down_m: fn(f64, f64) -> f64| {
        let mut scatterers = Scatterers::default();
        for k in 0..count {
            let (n, e) = (0.5 * f64::from(k % 11), 0.5 * f64::from(k / 11));
            let strength = Complex64::from_polar(1.0, f64::from(k));
            let at_m = DVec3::new(n, 20.0 + e, down_m(n, e));
            scatterers.push(at_m, [0.0, 0.0, -1.0], strength, ScatterLaw::Lambert);
        }
        scatterers
    };
    let view = View {
        apex_m: DVec3::ZERO,
        shadows: true,
        ..View::default()
    };
    for scatterers in [
        ground(121, |_, _| 10.0),
        ground(121, |n, e| 10.0 + 0.2 * n - 0.1 * e),
        ground(121, |n, _| 10.0 + 0.3 * (n - 2.5).abs()),
        ground(1, |_, _| 10.0),
        ground(3, |_, _| 10.0),
        ground(0, |_, _| 10.0),
    ] {
        let count = scatterers.len();
        for method in [Method::Acoustic, Method::Unbiased, Method::Paper] {
            let settings = Settings {
                method,
                keep: count.div_ceil(2),
                weights: Weights::default_of(method),
                seed: 3,
            };
            let mut energies = Energies::default();
            energies.evaluate(&scatterers, count, &view, &settings, None);
            let numbers = energies.energy.iter().all(|e| e.is_finite());
            assert!(numbers || method == Method::Paper, "{method:?} of {count}");
            let mut selection = Selection::default();
            let rule = selection.rule(&energies, count, &settings);
            selection.apply(rule, &scatterers, &energies, count, 3);
            assert!(selection.gain.iter().all(|g| g.is_finite() && *g > 0.0));
            assert!(method == Method::Unbiased || selection.kept.len() == count.div_ceil(2));
        }
    }
}

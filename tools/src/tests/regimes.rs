//! Tests of the limits of the methods on both sides: no NaN, no panic, no error above its prediction, and no selection inside a
//! failing region. They use a short pulse and two elements; `tools/accuracy atlas` is the long form.

use echotank_core::model::{DopplerModel, PathModel, Synthesis};
use echotank_core::scene::{ScatterLaw, Scatterers};
use echotank_ping::threads::pool;
use echotank_scene::simplify::energy::{Energies, View};
use echotank_scene::simplify::{Method, Selection, Settings, Weights};
use glam::DVec3;
use num_complex::Complex64;

use crate::accuracy::atlas::measure::{Bench, Column, DOPPLERS, Outcome, SUMS};
use crate::accuracy::atlas::regimes::{ALL, Regime};
use crate::accuracy::atlas::small::place_error_m;
use crate::accuracy::atlas::spot::{Base, Size};

/// Columns of the tests of one sweep, by their values.
struct Swept(&'static Regime, Vec<(f64, Column)>);

/// Checks the conditions that are common to all sweeps.
fn swept(bench: &mut Bench, name: &str) -> Swept {
    let found = ALL.iter().find(|regime| regime.name == name);
    let regime = found.unwrap_or_else(|| panic!("no regime {name}"));
    let base = Base::new(Size::SMALL);
    let values = regime.few.iter();
    let columns: Vec<_> = values
        .map(|&v| (v, bench.column(&(regime.spot)(&base, v))))
        .collect();
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
            let answered = !matches!(
                plan.outcome,
                Outcome::Refused(_) | Outcome::NoNumber | Outcome::Panic(_)
            );
            assert!(answered, "{said}");
            let within = plan.outcome.is_within(column.tolerance);
            assert!(regime.is_blind() || plan.out_of_reach || within, "{said}");
        }
    }
    Swept(regime, columns)
}

impl Swept {
    fn at(&self, value: f64) -> &Column {
        let found = self.1.iter().find(|(v, _)| *v == value);
        &found
            .unwrap_or_else(|| panic!("{}: {value} is no column", self.0.name))
            .1
    }

    /// Checks that no method gives a signal at this value.
    fn silent_at(&self, value: f64) {
        for (method, outcome) in self.at(value).named() {
            let quiet = matches!(
                outcome,
                Outcome::Silence | Outcome::NotTaken | Outcome::Refused(_)
            );
            assert!(quiet, "{}, {value}: {method}: {outcome:?}", self.0.name);
        }
    }
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

/// Runs `work` in one thread pool, with engines shared by all sweeps.
fn on_a_bench(whole_plans: bool, work: impl FnOnce(&mut Bench) + Send) {
    let pool = pool(1).expect("threads");
    pool.install(|| work(&mut Bench::new(whole_plans)));
}

/// One sonar: speed, range, grazing, endfire, ends of the window, grid positions, empty scenes, distant positions.
#[test]
fn no_echo_position_gives_an_undetected_error() {
    on_a_bench(false, |bench| {
        let speed = swept(bench, "speed");
        let fast = best(speed.at(151.0));
        assert!(matches!(fast, Outcome::Refused(why) if why.contains("151 m/s")));
        assert!(speed.at(151.0).plan.is_none());
        let cruise = speed.at(2.572);
        let printed = cell(
            cruise,
            Synthesis::Spectral,
            PathModel::Polyline,
            DopplerModel::PaperEq21,
        );
        assert!(error(printed) > 0.5, "{printed:?}");
        assert!(best(cruise).is_within(1e-3), "{:?}", best(cruise));

        for (value, column) in &swept(bench, "range").1 {
            // Echoes closer than a wavelength are counted.
            if let Outcome::Answer { counted, .. } = *best(column) {
                assert_eq!(
                    counted > 0,
                    *value < 3.7e-3,
                    "{value} m: {:?}",
                    best(column)
                );
            }
        }
        swept(bench, "grazing").silent_at(91.0);
        swept(bench, "scatterers").silent_at(0.0);
        for (away_m, column) in &swept(bench, "far-from-origin").1 {
            assert!(
                best(column).is_within(1e-3),
                "{away_m} m: {:?}",
                best(column)
            );
        }
        let step = swept(bench, "frequency-step");
        let hop = |share: f64| {
            error(cell(
                step.at(share),
                Synthesis::Spectral,
                PathModel::StopAndHop,
                DopplerModel::None,
            ))
        };
        assert!(
            hop(0.5) < 1e-3 && hop(2.0) > 0.5,
            "{} {}",
            hop(0.5),
            hop(2.0)
        );
        for name in ["endfire", "window-end", "window-start", "grid-edge"] {
            swept(bench, name);
        }
    });
}

/// Manoeuvres, attitudes, and sparse or wrong navigation.
#[test]
fn no_motion_gives_an_undetected_error() {
    on_a_bench(false, |bench| {
        let faults = swept(bench, "navigation-faults");
        // A jump of 500 m in a tenth of a second, and another clock.
        for refused in [5.0, 8.0] {
            let outcome = best(faults.at(refused));
            assert!(
                matches!(outcome, Outcome::Refused(_)),
                "{refused}: {outcome:?}"
            );
        }
        // Repeated timestamps are dropped and late samples inserted in order.
        for answered in [0.0, 1.0, 2.0] {
            let outcome = best(faults.at(answered));
            assert!(outcome.is_within(1e-3), "{answered}: {outcome:?}");
        }
        for name in ["attitude", "navigation-rate", "segments", "manoeuvre"] {
            swept(bench, name);
        }
    });
}

/// Spacings, pulses, sample rates, tolerances and floors.
#[test]
fn no_sonar_gives_an_undetected_error() {
    on_a_bench(false, |bench| {
        let rate = swept(bench, "sample-rate");
        let low = best(rate.at(0.5));
        assert!(matches!(low, Outcome::Refused(why) if why.contains("at least")));
        assert!(best(rate.at(1.1)).is_within(1e-3));
        assert!(error(best(swept(bench, "culling").at(-3.0))) > 1e-3);
        for name in ["elements", "pulse-stretch", "tolerance"] {
            swept(bench, name);
        }
    });
}

#[test]
fn places_come_back_over_poles_and_antimeridian() {
    for latitude_deg in [0.0, 60.0, 89.9999, 90.0, -90.0] {
        for longitude_deg in [0.0f64, 179.99999, -180.0] {
            let off_m = place_error_m(latitude_deg, longitude_deg);
            assert!(off_m < 1e-6, "{latitude_deg} {longitude_deg}: {off_m} m");
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

#[test]
fn every_regime_has_a_figure_and_its_sentence_on_the_page() {
    let folder = crate::repository().join("hil-configs/atlas");
    let page = std::fs::read_to_string(folder.join("README.md")).expect("the page");
    for regime in &ALL {
        let picture = format!("{}.png", regime.name);
        let bytes = std::fs::metadata(folder.join(&picture)).map_or(0, |m| m.len());
        assert!(bytes > 10_000, "{picture}: {bytes} bytes");
        let section = format!("![{}]({picture})\n\n{}", regime.title, regime.says);
        assert!(page.contains(&section), "not on the page: {section}");
    }
}

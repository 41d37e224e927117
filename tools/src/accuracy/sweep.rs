//! Measures whether methods meet their tolerance; see `tools/accuracy sweep --help`.

pub(crate) mod case;
pub(crate) mod measure;
pub(crate) mod methods;
pub(crate) mod table;

use clap::Args;
use rayon::prelude::*;

use crate::report::{Common, Report};
use case::{Case, MOTIONS, SCENES};
use methods::{Method, Reason};
use table::{Cell, MEASURES, Measured, Row, TOLERANCES, heading};

const ABOUT: &str = "\
Each method has three lines: the largest error in any window of a pulse length (at least 32 samples), over all samples of three elements. First line:
the error that tolerances apply to, |x - x_ref| over max(|x_ref|, noise) in the window. The noise of a scene is 55 dB below its strongest window. x_ref
is the retarded-time sum on the continuous motion through the receiver filter, by quadrature. \"beside\": a looser measure without
guarantee, a window's error over the strongest window that shares samples with it, or over the strongest of all where that is below the noise.
\"no noise\": over max(|x_ref|, 1e-6 of the median over the elements); inf if a residual remains where no element receives anything. These scenes are
sparse: some windows contain only the end of a taper or of the filter's tail, which this measure compares with itself.
Scenes: 36 m to 150 m (75 m, 60 m) slant range, 400 kHz, 30 kHz, 5 ms, 48 kHz sample rate. \"paper\"
has a rectangular pulse, the others taper half of it. For each tolerance a method takes the cheapest path and Doppler models whose error models leave
it a share, and answers with samples or refuses. \"model\": no supported Doppler or path model is accurate enough. \"sum\": its synthesis is not accurate
enough. \"as it is\": continuous path and the best supported Doppler model, without a tolerance. Errors above the tolerance are marked !.
";

#[derive(Args)]
#[command(
    about = "Measure every method at every tolerance on fixed and random scenes, against the reference"
)]
pub(crate) struct Arguments {
    #[command(flatten)]
    common: Common,
    /// Only scenes whose name or motion contains this
    #[arg(long)]
    only: Option<String>,
    /// Only these methods
    #[arg(long, value_delimiter = ',', conflicts_with = "keep")]
    method: Vec<String>,
    /// Number of random scenes
    #[arg(long, default_value_t = 200, default_value_if("quick", "true", "4"))]
    random: u64,
    /// First random scene
    #[arg(long, default_value_t = 0, conflicts_with = "keep")]
    first: u64,
    /// Write tools/kept/tolerances.txt
    #[arg(long, conflicts_with = "quick")]
    keep: bool,
    /// Print the models chosen for each cell, or why the method refused
    #[arg(long)]
    why: bool,
}

pub(crate) fn run(given: Arguments) -> Result<(), Box<dyn std::error::Error>> {
    let mut report = Report::new();
    report.print(&format!("{ABOUT}\n{}\n", heading()));
    // Results are written unordered to standard error when they are ready, and in order to standard output.
    let mut broken = 0;
    let cases: Vec<Case> = SCENES
        .iter()
        .flat_map(|scene| MOTIONS.iter().map(|m| scene.case(m, SCATTERERS)))
        .filter(|case| {
            let all = if given.common.quick { "+-60 still" } else { "" };
            let wanted = given.only.as_deref().unwrap_or(all);
            format!("{} {}", case.scene, case.motion).contains(wanted)
        })
        .collect();
    let tables: Vec<Vec<Row>> = cases
        .par_iter()
        .map(|case| {
            let truth = measure::truth(case);
            let rows: Vec<Row> = Method::of(case)
                .filter(|m| asked(*m, &given))
                .map(|m| Row::of(m, case, &truth, &TOLERANCES))
                .collect();
            for row in &rows {
                eprint!("{}", row.text(case));
            }
            rows
        })
        .collect();
    for (case, rows) in cases.iter().zip(&tables) {
        for row in rows {
            report.print(&row.text(case));
            row.cells
                .iter()
                .for_each(|cell| report.keep(cell.json(case, row.method)));
            broken += row.broken().count();
            if given.why {
                report.print(&reasons(row));
            }
        }
    }
    report.print(&format!("above their tolerance: {broken}\n\n"));
    let rows: Vec<&Row> = tables.iter().flatten().collect();
    let cells = rows
        .iter()
        .flat_map(|row| row.cells.iter().map(|cell| (row.method, cell)));
    report.print(&counts(&cells.collect::<Vec<_>>()));
    let (more, above) = random(&given, &mut report);
    report.print(&more);
    broken += above;
    if given.keep {
        report.keep_text("tolerances.txt")?;
    }
    report.finish(given.common.json.as_deref())?;
    if broken > 0 {
        return Err(format!("{broken} errors above their tolerance").into());
    }
    Ok(())
}

/// Number of scatterers of a fixed scene.
const SCATTERERS: usize = 40;

fn asked(method: Method, given: &Arguments) -> bool {
    given.method.is_empty() || given.method.iter().any(|name| name == method.name())
}

fn reasons(row: &Row) -> String {
    let line = |cell: &Cell| {
        let said = match &cell.outcome {
            Ok(m) => format!(
                "{:.1e}, beside {:.1e}, without noise {:.1e}, predicted {:.1e}: {}",
                m.error.in_noise,
                m.error.beside,
                m.error.without_noise,
                m.predicted,
                m.chosen.text()
            ),
            Err(refused) => refused.message.clone(),
        };
        format!("    {:.0e}: {said}\n", cell.tolerance)
    };
    row.cells.iter().map(line).collect()
}

/// Measures methods over random scenes. The result states how often each method answered, its worst ratio of error to tolerance,
/// and the scene. It also counts errors with noise floor that exceed the tolerance.
fn random(given: &Arguments, report: &mut Report) -> (String, usize) {
    let count = given.random;
    struct One {
        json: serde_json::Value,
        method: Method,
        cell: Cell,
        about: String,
    }
    // f32 and f64, with sharp and tapered pulses.
    let tolerances = &TOLERANCES[..6];
    let all: Vec<One> = (given.first..given.first + count)
        .into_par_iter()
        .flat_map_iter(|seed| {
            let case = case::random(seed);
            let truth = measure::truth(&case);
            let about = case::describe(&case);
            eprintln!("{about}");
            let mut found = Vec::new();
            for method in Method::of(&case).filter(|m| asked(*m, given)) {
                for cell in Row::of(method, &case, &truth, tolerances).cells {
                    found.push(One {
                        json: cell.json(&case, method),
                        method,
                        cell,
                        about: about.clone(),
                    });
                }
            }
            found
        })
        .collect();
    all.iter().for_each(|one| report.keep(one.json.clone()));
    let mut text = format!(
        "\n{count} random scenes (pulse, filter, arrays, ranges, motion; the number is the seed), tolerances 1e-1 to 1e-6.\n\n"
    );
    let cells: Vec<(Method, &Cell)> = all.iter().map(|one| (one.method, &one.cell)).collect();
    text += &counts(&cells);
    let misses = |method| {
        let of = move |one: &&One| one.method == method && !one.cell.holds(|e| e.in_noise);
        all.iter()
            .filter(of)
            .filter_map(|one| Some((one.cell.outcome.as_ref().ok()?, one)))
    };
    text += "\nabove the tolerance:";
    let mut all_above = 0;
    for method in Method::ALL {
        let above = misses(method).count();
        all_above += above;
        if above > 0 {
            text += &format!(" {} {above};", method.name());
        }
    }
    if all_above == 0 {
        text += " none";
    }
    text += "\nthe worst of each method and tolerance:\n";
    for method in Method::ALL {
        for &tolerance in tolerances {
            let here = |found: &(&Measured, &One)| found.1.cell.tolerance == tolerance;
            let misses: Vec<(&Measured, &One)> = misses(method).filter(here).collect();
            let count = misses.len();
            let in_noise = |m: &Measured| m.error.in_noise;
            let worst = misses
                .iter()
                .max_by(|a, b| in_noise(a.0).total_cmp(&in_noise(b.0)));
            let shown = match given.why {
                true => &misses[..],
                false => worst.map_or(&[][..], std::slice::from_ref),
            };
            for (m, one) in shown {
                text += &format!(
                    "{} at {tolerance:.0e}, {count} answers: {:.1e}, {:.1e} beside, predicted {:.1e}: {}\n    {}\n",
                    method.name(),
                    m.error.in_noise,
                    m.error.beside,
                    m.predicted,
                    m.chosen.text(),
                    one.about
                );
            }
        }
    }
    (text, all_above)
}

/// How often each method answered, and how often its error exceeded the tolerance by each measure, with the worst ratio.
fn counts(cells: &[(Method, &Cell)]) -> String {
    let mut text = format!("{:<10}", "method");
    for column in ["answers", "model", "sum"] {
        text += &format!(" {column:>9}");
    }
    text += " | above, worst over tolerance | above beside, worst | no noise: above, of it inf\n";
    for method in Method::ALL {
        let of: Vec<&Cell> = cells
            .iter()
            .filter(|c| c.0 == method)
            .map(|c| c.1)
            .collect();
        let refused = |by| {
            let is = |c: &&&Cell| c.outcome.as_ref().is_err_and(|r| r.by == by);
            of.iter().filter(is).count()
        };
        let answers = of.iter().filter(|c| c.outcome.is_ok()).count();
        if answers == 0 {
            continue;
        }
        let above = |error| of.iter().filter(|c| !c.holds(error)).count();
        let silent = |c: &&&Cell| {
            c.outcome
                .as_ref()
                .is_ok_and(|m| m.error.without_noise.is_infinite())
        };
        text += &format!("{:<10}", method.name());
        for number in [answers, refused(Reason::Model), refused(Reason::Sum)] {
            text += &format!(" {number:>9}");
        }
        for ((_, error), width) in MEASURES.iter().zip([20, 12]) {
            let ratio = |c: &&Cell| Some(error(&c.outcome.as_ref().ok()?.error) / c.tolerance);
            let worst = of.iter().filter_map(ratio).fold(0.0, f64::max);
            text += &format!(" | {:>5}  {worst:>width$.2}", above(*error));
        }
        text += &format!(
            " | {:>15}  {:>9}",
            above(|e| e.without_noise),
            of.iter().filter(silent).count()
        );
        text += "\n";
    }
    text
}

//! Prints the tolerance contract as measured; see `tools/sweep --help`.

#[path = "sweep/mod.rs"]
mod sweep;

use std::path::Path;

use clap::Parser;
use rayon::prelude::*;

use sweep::case::{self, Case, MOTIONS, SCENES};
use sweep::measure;
use sweep::methods::Method;
use sweep::table::{Cell, KNOWN, Row, TOLERANCES, heading};

const ABOUT: &str = "\
Worst window of a pulse's length, over the elements at the ends, of |x - x_ref| / |x_ref|: x_ref is the retarded-time sum on the continuous motion
through the receiver filter, 64 points per width of the band; windows more than 55 dB below the strongest count against that level. Scenes: 36 m to
150 m (75 m, 60 m) slant, 400 kHz, 30 kHz, 5 ms, 48 kHz samples; \"paper\" is rectangular, the others have half the pulse under flanks.
A method is asked for a tolerance, takes the cheapest path and Doppler models whose cards leave room for it, and answers with samples or with
a refusal: \"model\" where no Doppler or path model that it takes is close enough, \"sum\" where its way to sum is not. \"as it is\": continuous
path, the best Doppler model it takes, whatever comes of it. A cell above its tolerance is marked !.
";

#[derive(Parser)]
#[command(
    about = "Every method, scene, motion and tolerance against the reference; and random scenes"
)]
struct Arguments {
    /// Scatterers of the table's scenes.
    #[arg(long, default_value_t = 40)]
    scatterers: usize,
    /// Only scenes whose name or motion contains this.
    #[arg(long)]
    only: Option<String>,
    /// Random scenes.
    #[arg(long, default_value_t = 200)]
    random: u64,
    /// Write tests/stability/tolerances.txt.
    #[arg(long)]
    keep: bool,
    /// Say for each cell what was chosen, or why it was refused.
    #[arg(long)]
    why: bool,
}

fn main() -> std::io::Result<()> {
    let given = Arguments::parse();
    let mut text = format!("{ABOUT}\n{}\n", heading());
    // As they come, on standard error; in order, on standard output.
    let mut broken = 0;
    let cases: Vec<Case> = SCENES
        .iter()
        .flat_map(|scene| MOTIONS.iter().map(|m| scene.case(m, given.scatterers)))
        .filter(|case| {
            let wanted = given.only.as_deref().unwrap_or("");
            case.scene.contains(wanted) || case.motion.contains(wanted)
        })
        .collect();
    let tables: Vec<Vec<Row>> = cases
        .par_iter()
        .map(|case| {
            let truth = measure::truth(case);
            let rows: Vec<Row> = Method::of(case)
                .map(|m| Row::of(m, case, &truth, &TOLERANCES))
                .collect();
            for row in &rows {
                eprintln!("{}", row.text(case));
            }
            rows
        })
        .collect();
    for (case, rows) in cases.iter().zip(&tables) {
        for row in rows {
            text += &row.text(case);
            text += "\n";
            broken += row.broken().count();
            if given.why {
                text += &reasons(row);
            }
        }
    }
    for (method, tolerance, why) in KNOWN {
        text += &format!("known: {} at {tolerance:.0e}: {why}\n", method.name());
    }
    text += &format!("others above their tolerance: {broken}\n");
    text += &random(given.random);
    print!("{text}");
    if given.keep {
        let file = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/stability/tolerances.txt");
        std::fs::write(file, &text)?;
    }
    if broken > 0 {
        std::process::exit(1);
    }
    Ok(())
}

fn reasons(row: &Row) -> String {
    let line = |cell: &Cell| {
        let said = match &cell.outcome {
            Ok(m) => format!(
                "by itself {:.1e}, beside {:.1e}, silence {:.1e}, predicted {:.1e}: {}",
                m.error.itself,
                m.error.beside,
                m.error.silence,
                m.predicted,
                m.chosen.text()
            ),
            Err(refused) => refused.message.clone(),
        };
        format!("    {:.0e}: {said}\n", cell.tolerance)
    };
    row.cells.iter().map(line).collect()
}

/// Methods over random scenes: how often each answered, its worst error over its tolerance, and where.
fn random(count: u64) -> String {
    struct One {
        method: Method,
        cell: Cell,
        seed: u64,
        about: String,
    }
    // f32 and f64, sharp and smooth; the truth itself is good to 4e-8.
    let tolerances = &TOLERANCES[..6];
    let all: Vec<One> = (0..count)
        .into_par_iter()
        .flat_map_iter(|seed| {
            let case = case::random(seed);
            let truth = measure::truth(&case);
            let about = case::describe(&case);
            let mut found = Vec::new();
            for method in Method::of(&case) {
                for cell in Row::of(method, &case, &truth, tolerances).cells {
                    found.push(One {
                        method,
                        cell,
                        seed,
                        about: about.clone(),
                    });
                }
            }
            found
        })
        .collect();
    let broken = all.iter().filter(|one| !one.cell.holds_beside()).count();
    let ends = all.iter().filter(|one| !one.cell.holds()).count() - broken;
    let mut text = format!(
        "\n{count} random scenes (pulse, filter, arrays, ranges, motion; their seeds are their numbers), tolerances 1e-1 to 1e-6\n\n"
    );
    text += &format!(
        "{:<10} {:>8} {:>8} {:>8} {:>8}  worst error beside / tolerance\n",
        "method", "answers", "model", "sum", "above"
    );
    for method in Method::ALL {
        let of: Vec<&One> = all.iter().filter(|one| one.method == method).collect();
        let count = |what: &str| of.iter().filter(|one| one.cell.text() == what).count();
        let (model, sum) = (count("model"), count("sum"));
        let above = of.iter().filter(|one| !one.cell.holds_beside()).count();
        text += &format!(
            "{:<10} {:>8} {model:>8} {sum:>8} {above:>8}",
            method.name(),
            of.len() - model - sum
        );
        let ratio = |one: &&&One| {
            let error = one.cell.outcome.as_ref().map_or(0.0, |m| m.error.beside);
            error / one.cell.tolerance
        };
        let worst = of
            .iter()
            .filter(|one| one.cell.outcome.is_ok())
            .max_by(|a, b| ratio(a).total_cmp(&ratio(b)));
        if let Some(worst) = worst {
            text += &format!(
                "  {:.2} at {:.0e} (random {})",
                ratio(&worst),
                worst.cell.tolerance,
                worst.seed
            );
        }
        text += "\n";
    }
    text += &format!(
        "\n{ends} answers are above their tolerance in a window by itself, but not beside those that share samples with it; {broken} are:\n"
    );
    for one in all.iter().filter(|one| !one.cell.holds_beside()) {
        if let Ok(m) = &one.cell.outcome {
            text += &format!(
                "{} at {:.0e}: {:.1e}, predicted {:.1e}: {}\n    {}\n",
                one.method.name(),
                one.cell.tolerance,
                m.error.beside.max(m.error.silence),
                m.predicted,
                m.chosen.text(),
                one.about
            );
        }
    }
    text
}

//! Compares automatic method selection with measurements, on random rigs and on configurations; see `tools/accuracy rigs --help`.

pub(crate) mod case;
pub(crate) mod measure;
mod reference;

use std::fmt::Write as _;
use std::fs;
use std::path::{Path, PathBuf};

use clap::Args;
use serde::{Deserialize, Serialize};

use crate::machine::load;
use crate::report::{Common, Report};
use echotank_config as config;
use echotank_ping::method_selection::costs::Costs;
use echotank_ping::threads::pool;
use measure::{CandidateResult, Measured, NEAR_COST, measure};

/// Computing time of a ping below which the cost limit does not apply, ms.
const MIN_MS: f64 = 1.0;
/// Minimum number of scatterers of a ping for its spare tolerance to count.
const MANY: usize = 1000;

#[derive(Args)]
#[command(
    about = "Measure automatic method selection on random rigs and on configurations: predicted and measured errors and costs, on one thread",
    long_about = "Makes the first ping of each rig with the selected methods and with other candidates. The error is the largest in any window of a \
pulse length (at least 32 samples) of any element, over the level of that window or 55 dB below the strongest window of the ping, whichever is higher. The reference solution is the \
direct sum on the exact trajectory with second-order Doppler, sampled as densely behind the filter as the reference; its own error, at 128 random samples by \
the reference's equation, stands under \"ref. err\". The four worst windows of the selected methods are computed again by the reference's equation, and that error \
counts. A candidate that undercuts the selection by more than a factor of 1.3 without being predicted to keep the tolerance is measured on nine later pings too, and \
must keep it on all. If the reference solution's error exceeds a tenth of the tolerance, the measured error is that of 128 random samples, marked c. \
Times: minimum of 5 runs in turn, one thread."
)]
pub(crate) struct Arguments {
    #[command(flatten)]
    common: Common,
    /// Number of random rigs
    #[arg(long, default_value_t = 200, default_value_if("quick", "true", "5"))]
    random: u64,
    /// First seed
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// Configurations; path, doppler and synthesis of sonars with fixed methods are set to "auto"
    configs: Vec<PathBuf>,
    /// Cost table of this machine
    #[arg(long)]
    costs: Option<PathBuf>,
    /// Measure nothing; report on what --json wrote before
    #[arg(long)]
    from: Vec<PathBuf>,
    /// Print every rig's details on standard error
    #[arg(long)]
    why: bool,
    /// Write tools/kept/rigs.txt
    #[arg(long)]
    keep: bool,
}

#[derive(Serialize, Deserialize)]
struct Row {
    name: String,
    about: String,
    of: Measured,
}

pub(crate) fn run(given: Arguments) -> Result<(), Box<dyn std::error::Error>> {
    let costs = echotank_runtime::rig::costs_of(given.costs.as_deref())?;
    let load_before = load();
    let mut rows = Vec::new();
    let mut failed = Vec::new();
    for path in &given.from {
        let kept: serde_json::Value = serde_json::from_str(&fs::read_to_string(path)?)?;
        rows.extend(serde_json::from_value::<Vec<Row>>(kept["rows"].clone())?);
    }
    let random = if given.from.is_empty() {
        given.random
    } else {
        0
    };
    let pool = pool(1)?;
    let folder = tempfile::tempdir()?;
    let mut keep = |name: &str, about: &str, measured: Result<Vec<Measured>, String>| {
        let (name, about) = (name.to_owned(), about.to_owned());
        let row = |of| Row {
            name: name.clone(),
            about: about.clone(),
            of,
        };
        match measured {
            Ok(measured) => rows.extend(measured.into_iter().map(row)),
            Err(why) => failed.push(format!("{name}: {why}: {about}")),
        }
    };
    for path in &given.configs {
        let name = path
            .file_stem()
            .map_or_else(String::new, |n| n.to_string_lossy().into_owned());
        let measured = configuration(path)
            .and_then(|spec| Ok(pool.install(|| measure(&spec, &costs, true))?))
            .map_err(|why| why.to_string());
        keep(&name, "", measured);
        eprintln!("{name}");
    }
    for seed in given.seed..given.seed + random {
        let (spec, about) = case::random(seed, folder.path(), false);
        let measured = pool.install(|| measure(&spec, &costs, true));
        let measured = measured.map_err(|why| why.to_string());
        keep(&format!("rig {seed}"), &about, measured);
        eprint!("\r{seed} ");
    }
    if given.why {
        for row in &rows {
            eprintln!("{} {}: {}", row.name, row.about, row.of.said());
        }
    }
    let mut results = Report::new();
    results.print(&report(&rows, &failed, &costs, (load_before, load())));
    for row in &rows {
        results.keep(serde_json::to_value(row)?);
    }
    if given.keep {
        results.keep_text("rigs.txt")?;
    }
    Ok(results.finish(given.common.json.as_deref())?)
}

/// The configuration, changed only in what the selection may choose.
fn configuration(path: &Path) -> Result<config::spec::RigSpec, Box<dyn std::error::Error>> {
    let mut table: toml::Table = fs::read_to_string(path)?.parse()?;
    if let Some(sonars) = table.get_mut("sonar").and_then(|s| s.as_array_mut()) {
        for sonar in sonars.iter_mut().filter_map(|s| s.as_table_mut()) {
            let model = sonar
                .entry("model")
                .or_insert_with(|| toml::Table::new().into())
                .as_table_mut()
                .ok_or("sonar.model is no table")?;
            // Every element is compared. `tools/src/tests/plan/parts.rs` covers side-scan lines without elements.
            model.insert("output".into(), "elements".into());
            if model.values().any(|value| value.as_str() == Some("auto")) {
                continue;
            }
            for key in ["path", "doppler", "synthesis"] {
                model.insert(key.into(), "auto".into());
            }
            for key in ["segment_ms", "nearest_m", "frequency_step_hz"] {
                model.remove(key);
            }
        }
    }
    let folder = path.parent().unwrap_or(Path::new("."));
    Ok(echotank_runtime::config_files::parse(
        &toml::to_string(&table)?,
        folder,
    )?)
}

/// Cost of the selected methods over the minimum cost of the methods that predict, and of those that reach, the same error.
fn ratios(of: &Measured) -> (f64, f64) {
    let least = |good: &dyn Fn(&&CandidateResult) -> bool| {
        let others = of.others.iter().filter(good);
        others.map(|did| did.ms).fold(of.plan.ms, f64::min)
    };
    (
        of.plan.ms / least(&|did| did.promised),
        of.plan.ms / least(&|did| did.keeps(of.tolerance)),
    )
}

fn report(rows: &[Row], failed: &[String], costs: &Costs, load: (String, String)) -> String {
    let mut text = String::from(
        "Selected methods compared with measurements; see tools/accuracy rigs --help.\n\n",
    );
    let _ = writeln!(
        text,
        "{:<16} {:>8} {:>8} {:>8}  {:>8} | {:>8} {:>8} | {:>6} {:>6} | {:>7} {:>4} selected methods; rig",
        "rig",
        "toler.",
        "pred.",
        "measured",
        "ref. err",
        "pred. ms",
        "ms",
        "best p",
        "best m",
        "scatt.",
        "el."
    );
    for row in rows {
        let (best_promised, best_measured) = ratios(&row.of);
        let of = &row.of;
        let _ = writeln!(
            text,
            "{:<16} {:>8.1e} {:>8.1e} {:>8.1e}{} {:>8} | {:>8.2} {:>8.2} | {best_promised:>6.2} {best_measured:>6.2} | {:>7} {:>4} {}{}; {}",
            row.name,
            of.tolerance,
            of.plan.predicted_error,
            of.plan.error,
            if of.plan.by_error_check { "c" } else { " " },
            of.reference.map_or("-".into(), |e| format!("{e:.0e}")),
            of.plan.predicted_ms,
            of.plan.ms,
            of.scatterers,
            of.elements,
            if of.out_of_reach {
                "OUT OF REACH: "
            } else {
                ""
            },
            of.plan.text,
            row.about,
        );
    }
    let reach: Vec<&Row> = rows.iter().filter(|row| !row.of.out_of_reach).collect();
    let count = |of: &dyn Fn(&&&Row) -> bool| reach.iter().filter(of).count();
    let all = reach.len();
    let percent = |n: usize, of: usize| 100.0 * n as f64 / of.max(1) as f64;
    let within = count(&|row| row.of.plan.error <= row.of.tolerance);
    let bound = count(&|row| row.of.plan.error <= row.of.plan.predicted_error);
    let tight = count(&|row| row.of.plan.predicted_error <= 10.0 * row.of.plan.error);
    let long: Vec<&&Row> = reach.iter().filter(|row| row.of.plan.ms > MIN_MS).collect();
    let near = |which: fn((f64, f64)) -> f64| {
        long.iter()
            .filter(|row| which(ratios(&row.of)) <= NEAR_COST)
            .count()
    };
    let _ = writeln!(
        text,
        "\n{} rows, {} of them predicted to be out of reach; load {} to {}; costs: {}",
        rows.len(),
        rows.len() - all,
        load.0,
        load.1,
        costs.machine
    );
    let _ = writeln!(
        text,
        "measured error within the tolerance: {within} of {all}"
    );
    let _ = writeln!(
        text,
        "predicted error an upper bound: {bound} of {all}; within 10 times the measured: {tight} of {all} ({:.0} %)",
        percent(tight, all)
    );
    let _ = writeln!(
        text,
        "cost within {NEAR_COST} times the cheapest predicted within the tolerance, pings above {MIN_MS} ms: {} of {} ({:.0} %); the cheapest measured within: {} ({:.0} %)",
        near(|r| r.0),
        long.len(),
        percent(near(|r| r.0), long.len()),
        near(|r| r.1),
        percent(near(|r| r.1), long.len())
    );
    let mut spare: Vec<f64> = reach
        .iter()
        .filter(|row| row.of.scatterers >= MANY)
        .map(|row| row.of.tolerance / row.of.plan.error)
        .collect();
    spare.sort_by(f64::total_cmp);
    if let Some(median) = spare.get(spare.len() / 2) {
        let _ = writeln!(
            text,
            "tolerance over measured error, median of {} pings with {MANY} scatterers and more: {median:.1}",
            spare.len()
        );
    }
    let mut worst: Vec<&&&Row> = long.iter().collect();
    worst.sort_by(|a, b| ratios(&b.of).0.total_cmp(&ratios(&a.of).0));
    text += "\nlargest cost ratio to the cheapest predicted within the tolerance:\n";
    for row in worst.iter().take(5) {
        let best = row
            .of
            .others
            .iter()
            .filter(|d| d.promised)
            .min_by(|a, b| a.ms.total_cmp(&b.ms));
        if let Some(best) = best {
            let _ = writeln!(
                text,
                "{}: {:.2} ms ({:.2} predicted) with {}; {:.2} ms ({:.2} predicted) with {}",
                row.name,
                row.of.plan.ms,
                row.of.plan.predicted_ms,
                row.of.plan.text,
                best.ms,
                best.predicted_ms,
                best.text
            );
        }
    }
    let mut over: Vec<&&Row> = reach
        .iter()
        .filter(|row| row.of.plan.error > row.of.plan.predicted_error)
        .collect();
    over.sort_by(|a, b| {
        (b.of.plan.error / b.of.plan.predicted_error)
            .total_cmp(&(a.of.plan.error / a.of.plan.predicted_error))
    });
    text += "\nmeasured above predicted, worst first:\n";
    for row in over.iter().take(20) {
        let _ = writeln!(
            text,
            "{}: {:.1e} measured, {:.1e} predicted, reference solution {:.0e}: {}; {}",
            row.name,
            row.of.plan.error,
            row.of.plan.predicted_error,
            row.of.reference.unwrap_or(f64::NAN),
            row.of.plan.text,
            row.about
        );
    }
    for line in failed {
        let _ = writeln!(text, "failed: {line}");
    }
    text
}

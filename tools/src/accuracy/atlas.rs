//! Draws the maps of method failures; see `tools/accuracy atlas --help`.

pub(crate) mod measure;
mod page;
mod picture;
pub(crate) mod regimes;
pub(crate) mod small;
pub(crate) mod spot;

use std::path::PathBuf;
use std::time::Instant;

use clap::Args;
use echotank_core::model::{PathModel, Synthesis};
use serde_json::json;

use self::measure::{Bench, Column, DOPPLERS, Outcome, SUMS};
use self::regimes::{ALL, Regime};
use self::spot::{Base, Size};
use crate::report::{Common, Report};
use picture::{Map, Mark, Panel, Sign};

#[derive(Args)]
#[command(
    about = "Sweep every regime in which methods fail: figures, a page of them, and a table of every cell"
)]
pub(crate) struct Arguments {
    /// Draw only maps whose name contains this; leave the page unchanged
    #[arg(long)]
    only: Option<String>,
    /// Folder for the images and their page
    #[arg(long, default_value = "hil-configs/atlas")]
    out: PathBuf,
    /// Write SVG besides PNG
    #[arg(long)]
    svg: bool,
    #[command(flatten)]
    common: Common,
    /// Write only the page; draw nothing
    #[arg(long)]
    page: bool,
    #[arg(long, default_value_t = 2)]
    threads: usize,
}

pub(crate) fn run(given: Arguments) -> Result<(), Box<dyn std::error::Error>> {
    std::fs::create_dir_all(&given.out)?;
    let page = given.out.join("README.md");
    if given.page {
        return Ok(std::fs::write(page, page::page())?);
    }
    // A panic is recorded as a cell of a map.
    std::panic::set_hook(Box::new(|_| {}));
    let pool = echotank_ping::threads::pool(given.threads)?;
    let size = if given.common.quick {
        Size::SMALL
    } else {
        Size::PAPER
    };
    let wanted = |name: &str| given.only.as_deref().is_none_or(|part| name.contains(part));
    let base = Base::new(size);
    let mut bench = Bench::new(true);
    let mut report = Report::new();
    for regime in ALL.iter().filter(|r| wanted(r.name)) {
        let began = Instant::now();
        let columns: Vec<Column> = pool.install(|| {
            let values = regime.values.iter();
            values
                .map(|&v| bench.column(&(regime.spot)(&base, v)))
                .collect()
        });
        write(&given, regime.name, &map(regime, &columns).svg())?;
        summary(regime, &columns, began.elapsed().as_secs_f64());
        cells(regime, &columns, &mut report);
    }
    for (name, map, says) in small::maps() {
        if wanted(name) {
            write(&given, name, &map.svg())?;
            println!("{name}: {says}");
        }
    }
    if given.only.is_none() {
        std::fs::write(page, page::page())?;
    }
    Ok(report.finish(given.common.json.as_deref())?)
}

fn write(given: &Arguments, name: &str, svg: &str) -> Result<(), Box<dyn std::error::Error>> {
    std::fs::write(
        given.out.join(format!("{name}.png")),
        echotank_drawing::png(svg)?,
    )?;
    if given.svg {
        std::fs::write(given.out.join(format!("{name}.svg")), svg)?;
    }
    Ok(())
}

fn mark(outcome: &Outcome, tolerance: f64, blind: bool) -> Mark {
    match outcome {
        Outcome::NotTaken => Mark::Blank,
        Outcome::Refused(_) => Mark::Refused,
        Outcome::Silence => Mark::Silence,
        Outcome::NoNumber | Outcome::Panic(_) => Mark::Shout,
        Outcome::Answer { error, counted, .. } => Mark::Ratio {
            log10: (error.max(1e-30) / tolerance).log10(),
            sign: match outcome.is_silently_wrong(tolerance) && !blind {
                true => Sign::Silent,
                false if *counted > 0 && *error > tolerance => Sign::Counted,
                false => Sign::None,
            },
        },
    }
}

fn map(regime: &Regime, columns: &[Column]) -> Map {
    let blind = regime.is_blind();
    let mut rows = Vec::new();
    for doppler in DOPPLERS {
        for path in PathModel::ALL {
            let name = match doppler {
                echotank_core::model::DopplerModel::None => "no Doppler",
                doppler => doppler.name(),
            };
            rows.push(format!("{}, {name}", path.name()));
        }
    }
    let panels = SUMS.iter().enumerate().map(|(sum, synthesis)| {
        let mut marks = Vec::new();
        let mut rings = Vec::new();
        for (d, &doppler) in DOPPLERS.iter().enumerate() {
            for (p, &path) in PathModel::ALL.iter().enumerate() {
                let row = columns
                    .iter()
                    .map(|c| mark(c.cell(sum, d, p), c.tolerance, blind));
                marks.push(row.collect());
                for (column, c) in columns.iter().enumerate() {
                    let of_it = |plan: &measure::Planned| {
                        (plan.synthesis, plan.doppler, plan.path) == (*synthesis, doppler, path)
                    };
                    if c.plan.as_ref().is_some_and(of_it) {
                        rings.push((column, d * PathModel::ALL.len() + p));
                    }
                }
            }
        }
        Panel {
            title: synthesis.name().to_owned(),
            marks,
            rings,
        }
    });
    let spectral = SUMS.iter().position(|s| *s == Synthesis::Spectral);
    let planned = columns.iter().map(|c| match &c.plan {
        Some(plan) => mark(&plan.outcome, c.tolerance, blind),
        None => Mark::Refused,
    });
    let tolerance = match regime.name {
        "tolerance" => "tolerance: the column's".to_owned(),
        _ => format!("tolerance {:.0e}", columns[0].tolerance),
    };
    Map {
        title: regime.title.to_owned(),
        about: format!(
            "400 kHz, 30 kHz, 5 ms, a line of 8 elements half a wavelength apart unless the column says otherwise; {tolerance}; error: the worst window of a pulse's length of any element, against the retarded-time sum"
        ),
        axis: regime.axis.to_owned(),
        columns: regime.values.iter().map(|&v| regime.label(v)).collect(),
        rows,
        gaps: vec![3, 7, 11],
        framed: spectral
            .map(|k| (k, 5, "the paper's Eq. 21".to_owned()))
            .into_iter()
            .collect(),
        panels: panels.collect(),
        plan: Some((planned.collect(), choices(regime, columns))),
    }
}

/// Text of the selected method of each column. Adjacent columns with the same choice share a line.
fn choices(regime: &Regime, columns: &[Column]) -> Vec<String> {
    let mut runs: Vec<(String, usize, usize)> = Vec::new();
    for (k, column) in columns.iter().enumerate() {
        let text = match &column.plan {
            None => "no ping".to_owned(),
            Some(plan) => {
                let parts: Vec<&str> = plan.text.split(", ").collect();
                // The tolerance of the engine is the same for all columns and is omitted.
                let mut text = parts[..3.min(parts.len())].join(", ");
                if let Some((name, _)) = text.rsplit_once(' ').filter(|_| text.contains("gridded"))
                {
                    text = name.to_owned();
                }
                match plan.out_of_reach {
                    true => format!("{text}: reports that no method meets the tolerance"),
                    false => text,
                }
            }
        };
        match runs.last_mut() {
            Some((same, _, last)) if *same == text => *last = k,
            _ => runs.push((text, k, k)),
        }
    }
    let label = |k: usize| regime.label(regime.values[k]);
    let line = |(text, first, last): (String, usize, usize)| match first == last {
        true => format!("{}: {text}", label(first)),
        false => format!("{} to {}: {text}", label(first), label(last)),
    };
    runs.into_iter().map(line).collect()
}

fn summary(regime: &Regime, columns: &[Column], seconds: f64) {
    let blind = regime.is_blind();
    println!("{} ({seconds:.1} s)", regime.name);
    for (column, &value) in columns.iter().zip(regime.values) {
        let label = regime.label(value);
        for (name, outcome) in column.named() {
            if outcome.is_silently_wrong(column.tolerance) && !blind {
                println!("  UNDETECTED ERROR at {label}: {name}: {outcome:?}");
            }
        }
        if let Some(plan) = &column.plan {
            let wrong = !plan.out_of_reach && !plan.outcome.is_within(column.tolerance) && !blind;
            if wrong || matches!(plan.outcome, Outcome::NoNumber | Outcome::Panic(_)) {
                println!("  SELECTION at {label}: {}: {:?}", plan.text, plan.outcome);
            }
        }
    }
}

fn cells(regime: &Regime, columns: &[Column], report: &mut Report) {
    for (column, &value) in columns.iter().zip(regime.values) {
        let plan = column.plan.as_ref();
        let plan = plan.map(|plan| (format!("selection: {}", plan.text), &plan.outcome));
        for (method, outcome) in column.named().chain(plan) {
            let value = regime.label(value);
            report.keep(
                json!({ "map": regime.name, "value": value, "method": method, "outcome": outcome }),
            );
        }
    }
}

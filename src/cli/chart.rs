//! `echotank chart`: accuracy against run time, measured on the configured scene and this machine.

mod page;
mod peers;
mod plot;
mod table;

use std::fs;
use std::path::PathBuf;

use clap::Args;
use indicatif::{ProgressBar, ProgressStyle};

use super::{ConfigArgs, Failure, load};
use echotank_runtime::chart::work::{self, Work};
use echotank_runtime::chart::{self, ChartOptions};

/// Number of timed runs of each ping and method, and of each point of the cost chart.
const REPEATS: usize = 3;

#[derive(Args, Clone, Debug)]
pub(crate) struct ChartArgs {
    #[command(flatten)]
    pub(crate) config: ConfigArgs,
    /// Folder for chart.svg, chart.png, chart.html, chart.csv, chart.json, work.svg, work.png; created if absent
    #[arg(long, value_name = "DIR")]
    pub(crate) out: PathBuf,
    /// Name of the sonar (default: the first)
    #[arg(long, value_name = "NAME")]
    pub(crate) sonar: Option<String>,
    /// Number of pings measured, spread over the first `--span`
    #[arg(long, default_value_t = 2, value_parser = clap::value_parser!(u32).range(1..=100))]
    pub(crate) pings: u32,
    /// Number of the last ping measured
    #[arg(long, default_value_t = 40, value_parser = clap::value_parser!(u32).range(1..=1_000_000))]
    pub(crate) span: u32,
    /// Threads; 0 means one per core (default: the configuration's)
    #[arg(long)]
    pub(crate) threads: Option<usize>,
    /// Fewer methods, one ping, one repeat, no cost chart
    #[arg(long)]
    pub(crate) quick: bool,
    /// Measurements of other software by `tools/peers` (default: out/peers/points.json, if present)
    #[arg(long, value_name = "FILE")]
    pub(crate) peers: Option<PathBuf>,
    /// Hide the progress bar
    #[arg(long)]
    pub(crate) quiet: bool,
}

pub(crate) fn main(args: &ChartArgs) -> Result<(), Failure> {
    let spec = load(&args.config.config, &args.config.set)?;
    let sonar = match &args.sonar {
        None => 0,
        Some(name) => spec
            .sonars
            .iter()
            .position(|sonar| sonar.name == *name)
            .ok_or_else(|| {
                let names: Vec<&str> = spec.sonars.iter().map(|s| s.name.as_str()).collect();
                Failure::Configuration(format!(
                    "--sonar = {name}: must be one of {}",
                    names.join(", ")
                ))
            })?,
    };
    let peers = peers::read(args.peers.as_deref())?;
    fs::create_dir_all(&args.out)
        .map_err(|why| Failure::Configuration(format!("--out = {}: {why}", args.out.display())))?;
    let options = ChartOptions {
        pings: if args.quick { 1 } else { args.pings },
        span_pings: args.span.max(args.pings),
        repeats: if args.quick { 1 } else { REPEATS },
        threads: args.threads.unwrap_or(spec.run.threads),
        sonar,
        quick: args.quick,
    };
    let bar = match args.quiet {
        true => ProgressBar::hidden(),
        false => ProgressBar::new(1),
    };
    bar.set_style(
        ProgressStyle::with_template("{bar:30} {pos}/{len} {elapsed}, {msg}")
            .unwrap_or_else(|_| ProgressStyle::default_bar()),
    );
    let load_before = load_average();
    let chart = chart::measure(&spec, &options, |what, most| {
        if most > 0 {
            bar.set_length(most as u64);
        } else {
            bar.inc(1);
        }
        bar.set_message(what.to_owned());
    })
    .map_err(Failure::running)?;
    let about = table::ChartContext {
        machine: machine(),
        load: (load_before, load_average()),
        period_ms: 1e3 / spec.sonars[sonar].settings.max_ping_rate_hz.max(1e-9),
    };
    let curves = match args.quick {
        true => Vec::new(),
        false => {
            bar.set_length(bar.length().unwrap_or(0) + Work::ALL.len() as u64);
            let bare = chart::bare(&spec.sonars[sonar]);
            let one = ChartOptions {
                pings: 1,
                ..options.clone()
            };
            let pool = echotank_ping::threads::pool(options.threads).map_err(Failure::running)?;
            pool.install(|| -> Result<Vec<work::Curve>, Failure> {
                let (scenes, _) = chart::scenes(&spec, &one).map_err(Failure::running)?;
                let mut curves = Vec::new();
                for work in Work::ALL {
                    bar.inc(1);
                    bar.set_message(format!("cost against {}", work.name()));
                    for method in work_methods(&chart) {
                        curves.push(work::curve(
                            &bare,
                            &spec.medium,
                            &scenes[0],
                            &method,
                            work,
                            REPEATS,
                        ));
                    }
                }
                Ok(curves)
            })?
        }
    };
    bar.finish_and_clear();
    let mut written = Vec::new();
    let mut write = |name: &str, bytes: &[u8]| -> Result<(), Failure> {
        let path = args.out.join(name);
        fs::write(&path, bytes)
            .map_err(|why| Failure::Configuration(format!("--out: {}: {why}", path.display())))?;
        written.push(path);
        Ok(())
    };
    let svg = plot::chart(&chart, &peers, &about);
    write("chart.svg", svg.as_bytes())?;
    write(
        "chart.png",
        &echotank_drawing::png(&svg).map_err(Failure::running)?,
    )?;
    write("chart.csv", table::csv(&chart, &peers).as_bytes())?;
    write(
        "chart.json",
        table::json(&chart, &curves, &peers, &about).as_bytes(),
    )?;
    let work_svg = (!curves.is_empty()).then(|| plot::work(&curves, &about));
    write(
        "chart.html",
        page::html(&chart, &svg, work_svg.as_deref(), &about).as_bytes(),
    )?;
    if let Some(svg) = &work_svg {
        write("work.svg", svg.as_bytes())?;
        write(
            "work.png",
            &echotank_drawing::png(svg).map_err(Failure::running)?,
        )?;
    }
    print!("{}", table::text(&chart, &curves, &about));
    for peer in &peers {
        println!("   {}", peer.description(&chart).replace('\n', ": "));
    }
    for path in written {
        println!("wrote {}", path.display());
    }
    Ok(())
}

/// Methods of the cost chart: the configured method and the fastest method within the tolerance.
fn work_methods(chart: &chart::Chart) -> Vec<chart::methods::Method> {
    let mut methods: Vec<_> = chart
        .rows
        .iter()
        .filter(|row| row.configured)
        .map(|row| row.method)
        .collect();
    let within = chart.rows.iter().filter_map(|row| {
        let measured = row.outcome.as_ref().ok()?;
        (measured.errors.elements <= chart.tolerance)
            .then_some((measured.times.median_ms, row.method))
    });
    if let Some((_, method)) = within.min_by(|a, b| a.0.total_cmp(&b.0))
        && !methods.contains(&method)
    {
        methods.push(method);
    }
    methods
}

/// One-minute load average on Linux; `None` on other systems.
pub(super) fn load_average() -> Option<f64> {
    let text = fs::read_to_string("/proc/loadavg").ok()?;
    text.split_whitespace().next()?.parse().ok()
}

/// Processor name from the kernel, and number of cores.
pub(super) fn machine() -> String {
    let cores = std::thread::available_parallelism().map_or(1, |n| n.get());
    let name = fs::read_to_string("/proc/cpuinfo")
        .ok()
        .and_then(|text| {
            let line = text.lines().find(|line| line.starts_with("model name"))?;
            Some(line.split_once(':')?.1.trim().to_owned())
        })
        .unwrap_or_else(|| std::env::consts::ARCH.to_owned());
    format!("{name}, {cores} cores")
}

//! `echotank check`: validates a configuration, reports derived values and ends in a verdict: whether the rig does what is meant, and what to change where
//! it does not. The selected methods and their costs are reported on request.

mod selection;

use std::path::PathBuf;

use clap::Args;

use super::{Failure, load};
use echotank_config::spec::{DeliverySpec, MediumSpec, RigSpec, RunSpec, SeabedShape, SonarSpec};
use echotank_config::{self as config, Finding};
use echotank_core::model::Synthesis;
use echotank_ping::element_synthesis::engine_error_models;
use echotank_ping::method_selection::costs::Costs;
use echotank_ping::method_selection::with_choice;
use echotank_runtime::check::{
    self as verdict, CheckError, SonarSelection, select_for_pictures, select_methods,
};
use echotank_runtime::io::files::FileSystem;
use echotank_runtime::io::nav::ReadNav;
use echotank_scene::read::survey::Survey;
use echotank_synthesis::echo::culling::left_out_share;
use echotank_synthesis::error_model::ErrorModel;

#[derive(Args, Clone, Debug)]
pub(crate) struct CheckArgs {
    /// Configuration file (TOML)
    #[arg(required_unless_present_any = ["template", "schema"])]
    pub(crate) config: Option<PathBuf>,
    /// Change a value before checking (see `run --help`)
    #[arg(long = "set", value_name = "KEY=VALUE")]
    pub(crate) set: Vec<String>,
    /// Print a commented configuration with every key to start from
    #[arg(long)]
    pub(crate) template: bool,
    /// Print the JSON Schema of a configuration
    #[arg(long, conflicts_with = "template")]
    pub(crate) schema: bool,
    /// Print only the verdict, its findings and the selected methods, as JSON
    #[arg(long, requires = "config")]
    pub(crate) json: bool,
    /// Also print the engines, culling, the selected methods with their costs, and alternatives
    #[arg(long, requires = "config")]
    pub(crate) verbose: bool,
    /// As --verbose, with every candidate method, cheapest first
    #[arg(long, requires = "config")]
    pub(crate) all: bool,
    /// Only validate the configuration; do not select methods, and give a verdict of the configuration alone
    #[arg(long, conflicts_with_all = ["json", "all"])]
    pub(crate) quick: bool,
    /// Cost table of this machine, as --calibrate writes it (default: run.costs, or the built-in table)
    #[arg(long, value_name = "FILE")]
    pub(crate) costs: Option<PathBuf>,
    /// Time the methods on this machine with this configuration's sonars and scene; write the cost table to FILE
    #[arg(long, value_name = "FILE", requires = "config")]
    pub(crate) calibrate: Option<PathBuf>,
}

pub(crate) fn main(args: &CheckArgs) -> Result<(), Failure> {
    if args.template {
        print!("{}", config::template());
    } else if args.schema {
        println!("{}", config::schema());
    } else if let Some(path) = &args.config {
        let mut spec = load(path, &args.set)?;
        spec.run.costs = args.costs.clone().or(spec.run.costs);
        if let Some(file) = &args.calibrate {
            return selection::calibrate(&spec, file);
        }
        let is_verbose = args.verbose || args.all;
        if args.json {
            let (costs, mut selections) = selected(&spec)?;
            select_for_pictures(&spec, &costs, &mut selections).map_err(Failure::running)?;
            let findings = verdict::findings(&spec, &selections);
            print!("{}", selection::json(&costs, &selections, &findings)?);
            return end(&findings);
        }
        let warnings = match args.quick || !spec.nav.sources.iter().any(|s| s.is_recorded()) {
            true => Vec::new(),
            false => read_logs(&mut spec)?,
        };
        print!("{}", config::summary(&spec));
        for warning in warnings {
            println!("warning      navigation: {warning}");
        }
        let engines = |sonar: &SonarSpec| {
            let text = engines(&spec, sonar)
                .map_err(|why| Failure::Configuration(format!("{}: {why}", path.display())))?;
            if is_verbose {
                print!("{text}");
            }
            Ok::<_, Failure>(())
        };
        let is_selected = |sonar: &SonarSpec| sonar.synthesis.auto.synthesis;
        for sonar in spec.sonars.iter().filter(|sonar| !is_selected(sonar)) {
            engines(sonar)?;
        }
        for sonar in spec.sonars.iter().filter(|_| is_verbose) {
            print!("{}", culling(sonar, &spec.medium));
        }
        let mut selections = Vec::new();
        if !args.quick {
            print!("{}", guesses(&spec)?);
            let costs;
            (costs, selections) = selected(&spec)?;
            let is_streamed = matches!(spec.run.delivery, DeliverySpec::Streaming { .. });
            for selection in selections.iter().filter(|s| is_selected(s.sonar)) {
                if let Some(ranking) = &selection.first.ranking
                    && (is_verbose || is_streamed)
                {
                    engines(&with_choice(selection.sonar, &ranking.chosen().choice))?;
                }
            }
            if is_verbose {
                select_for_pictures(&spec, &costs, &mut selections).map_err(Failure::running)?;
                print!("{}", selection::text(&costs, &selections, args.all));
            }
        }
        let findings = verdict::findings(&spec, &selections);
        print!("{}", verdict::text(&spec, &selections, &findings));
        return end(&findings);
    }
    Ok(())
}

/// The engines of a sonar with their errors and costs, one line each. Refuses engines that cannot be made, or are too slow for a streamed delivery.
fn engines(spec: &RigSpec, sonar: &SonarSpec) -> Result<String, String> {
    let name = &sonar.name;
    let error_models = engine_error_models(sonar, &spec.medium)
        .map_err(|why| why.to_string())
        .and_then(|models| check_streaming_time(&spec.run, sonar, &models).map(|()| models))
        .map_err(|why| format!("sonar {name}: {why}"))?;
    let line = |error_model: &ErrorModel| {
        let cost = match error_model.cost_ms > 0.0 {
            true => format!(
                ", {:.2} ms on one core per {}",
                error_model.cost_ms,
                cost_unit(error_model)
            ),
            false => String::new(),
        };
        format!(
            "engine       {name}: {} within {:.1e}{cost} ({})\n",
            error_model.name, error_model.error, error_model.why
        )
    };
    Ok(error_models.iter().map(line).collect())
}

fn selected(spec: &RigSpec) -> Result<(Costs, Vec<SonarSelection<'_>>), Failure> {
    select_methods(spec).map_err(|error| match error {
        CheckError::Threads(_) => Failure::running(error),
        CheckError::Costs(_) | CheckError::First(_) => Failure::Configuration(error.to_string()),
    })
}

fn end(findings: &[Finding]) -> Result<(), Failure> {
    match findings.is_empty() {
        true => Ok(()),
        false => Err(Failure::Findings),
    }
}

/// Reads the recorded navigation and completes `spec` with the quantities found in each log. Returns warnings about missing, ignored or replaced
/// parts.
fn read_logs(spec: &mut RigSpec) -> Result<Vec<String>, Failure> {
    let read = ReadNav::read(&spec.nav).map_err(|e| Failure::Configuration(e.to_string()))?;
    spec.nav = read.spec;
    Ok(read.warnings)
}

/// Warnings about properties that the seabed file does not state, with extent and depths; empty if it states all properties.
fn guesses(spec: &RigSpec) -> Result<String, Failure> {
    let Some(SeabedShape::File { file, .. }) = spec.scene.seabed.as_ref().map(|s| &s.shape) else {
        return Ok(String::new());
    };
    let survey =
        Survey::open(&FileSystem, file).map_err(|e| Failure::Configuration(e.to_string()))?;
    if survey.guesses.is_empty() {
        return Ok(String::new());
    }
    let lines = survey.guesses.iter();
    let mut text: String = lines
        .map(|guess| format!("warning      seabed, guessed: {guess}\n"))
        .collect();
    let field = &survey.field;
    let depths = field.percentiles_m(&[0.0, 1.0]);
    text += &format!(
        "warning      seabed as read: {:.1} m north x {:.1} m east, depths {:.2} to {:.2} m; compare with `scene info {}`\n",
        field.extent_north_m(),
        field.extent_east_m(),
        depths[0],
        depths[1],
        file.path.display()
    );
    Ok(text)
}

/// Refuses a streaming configuration whose cost estimate exceeds the time available.
///
/// A streamed ping is computed completely before its first block is sent. The estimate, divided by the number of cores, is a lower bound of that
/// time. Engines without a cost estimate pass.
fn check_streaming_time(
    run: &RunSpec,
    sonar: &SonarSpec,
    error_models: &[ErrorModel],
) -> Result<(), String> {
    let DeliverySpec::Streaming { block_s, latency_s } = run.delivery else {
        return Ok(());
    };
    let cost_ms: f64 = error_models
        .iter()
        .map(|error_model| error_model.cost_ms * times(sonar, error_model))
        .sum();
    let cores = match run.threads {
        0 => std::thread::available_parallelism().map_or(1, usize::from),
        threads => threads,
    };
    let min_ms = cost_ms / cores as f64;
    let period_ms = 1e3 / sonar.settings.max_ping_rate_hz;
    if min_ms > period_ms {
        return Err(format!(
            "run.delivery = \"streaming\": a ping takes an estimated {min_ms:.0} ms or more on {cores} cores and the ping period is {period_ms:.0} ms: no latency is long enough"
        ));
    }
    let (ahead_ms, latency_ms) = (run.ahead_s * 1e3, latency_s * 1e3);
    let first_ms = (block_s + latency_s) * 1e3;
    if sonar.trigger.from.is_wired() && min_ms > first_ms {
        return Err(format!(
            "run.stream_latency_ms = {latency_ms}: must be longer: a ping takes an estimated {min_ms:.0} ms or more on {cores} cores and starts at its external trigger"
        ));
    }
    if min_ms > ahead_ms + first_ms {
        return Err(format!(
            "run.ahead_ms = {ahead_ms}: must be longer, or run.stream_latency_ms must be: a ping takes an estimated {min_ms:.0} ms or more on {cores} cores"
        ));
    }
    Ok(())
}

/// Unit of work to which the cost of an error model refers.
fn cost_unit(error_model: &ErrorModel) -> &'static str {
    match is_of_line(error_model) {
        true => "array and ping",
        false => "element and ping",
    }
}

fn is_of_line(error_model: &ErrorModel) -> bool {
    let lines = Synthesis::ALL.into_iter().filter(|s| s.makes_lines());
    lines
        .map(Synthesis::name)
        .any(|name| name == error_model.name)
}

/// Number of units of work in a ping.
fn times(sonar: &SonarSpec, error_model: &ErrorModel) -> f64 {
    // Beside line engines only single elements are made one by one.
    let lines = sonar.model.synthesis == Synthesis::GriddedLines;
    let arrays = sonar.receive.iter().filter(|a| !lines || a.elements == 1);
    match is_of_line(error_model) {
        true => 1.0,
        false => arrays.map(|array| array.elements as f64).sum(),
    }
}

/// Error of each array's reverberation due to a configured `cull_db`; empty without one.
fn culling(sonar: &SonarSpec, medium: &MediumSpec) -> String {
    let configured = |_: &f64| !sonar.synthesis.culls_by_window;
    let Some(cull_db) = sonar.model.cull_db.filter(configured) else {
        return String::new();
    };
    let wavelength_m = medium.sound_speed_m_per_s / sonar.pulse.center_frequency_hz;
    let mut text = String::new();
    for (array, name) in sonar.receive.iter().zip(&sonar.receive_names) {
        let transmit = &sonar.transmit[array.transmit];
        let share = |incidence_deg: u32| {
            let incidence_rad = f64::from(incidence_deg).to_radians();
            left_out_share(transmit, array, wavelength_m, cull_db, incidence_rad)
        };
        let at = |deg: u32| format!("{:.1e} at {deg}", share(deg).sqrt());
        text += &format!(
            "culling      {} {name}: below {cull_db} dB; relative windowed error on a flat bottom {}, {}, {}, {} degrees of incidence\n",
            sonar.name,
            at(20),
            at(45),
            at(70),
            at(85)
        );
    }
    text
}

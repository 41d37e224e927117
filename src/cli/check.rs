//! `echotank check`: is a configuration right, and what follows from it.

mod plan;

use std::path::PathBuf;

use clap::Args;

use super::{Failure, load};
use echotank_config as config;
use echotank_config::spec::{DeliverySpec, MediumSpec, RunSpec, SonarSpec};
use echotank_core::flow::{ErrorModel, Synthesis};
use echotank_ping::element_synthesis::engine_error_models;
use echotank_ping::pipeline::PipelineError;
use echotank_synthesis::echo::culling::left_out_share;

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
    /// Print the plan of methods, and nothing else, as JSON
    #[arg(long, requires = "config")]
    pub(crate) json: bool,
    /// Print every candidate of the plan too, cheapest first
    #[arg(long, requires = "config")]
    pub(crate) all: bool,
    /// Do not plan: say only whether the configuration is right
    #[arg(long, conflicts_with_all = ["json", "all"])]
    pub(crate) quick: bool,
    /// What methods cost on this machine, as --calibrate writes it (default: run.costs, or the table that comes with the program)
    #[arg(long, value_name = "FILE")]
    pub(crate) costs: Option<PathBuf>,
    /// Measure what methods cost on this machine, on this configuration's sonars and scene, and write FILE
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
            return plan::calibrate(&spec, file);
        }
        if args.json {
            print!("{}", plan::json(&spec)?);
            return Ok(());
        }
        print!("{}", config::summary(&spec));
        for sonar in &spec.sonars {
            let refuse_text = |why: String| {
                Failure::Configuration(format!("{}: sonar {}: {why}", path.display(), sonar.name))
            };
            let refuse = |why: PipelineError| refuse_text(why.to_string());
            let error_models = engine_error_models(sonar, &spec.medium).map_err(refuse)?;
            refuse_what_cannot_stream(&spec.run, sonar, &error_models).map_err(refuse_text)?;
            for error_model in error_models {
                let cost = match error_model.cost_ms > 0.0 {
                    true => format!(
                        ", {:.2} ms on one core per {}",
                        error_model.cost_ms,
                        whole(sonar)
                    ),
                    false => String::new(),
                };
                println!(
                    "engine       {}: {} within {:.1e}{cost} ({})",
                    sonar.name, error_model.name, error_model.error, error_model.why
                );
            }
        }
        for sonar in &spec.sonars {
            print!("{}", culling(sonar, &spec.medium));
        }
        if !args.quick {
            print!("{}", plan::text(&spec, args.all)?);
        }
        println!("{}: ok", path.display());
    }
    Ok(())
}

/// A ping that streams is computed whole before its first block leaves: what its engine is foreseen to take on all cores together, at the least,
/// must lie between, from when its pulse is known. An engine that foresees nothing is taken at its word.
fn refuse_what_cannot_stream(
    run: &RunSpec,
    sonar: &SonarSpec,
    error_models: &[ErrorModel],
) -> Result<(), String> {
    let DeliverySpec::Streaming { block_s, latency_s } = run.delivery else {
        return Ok(());
    };
    let each = match sonar.model.synthesis {
        Synthesis::Gridded2d => 1,
        _ => sonar.receive.iter().map(|array| array.elements).sum(),
    };
    let cost_ms: f64 = error_models
        .iter()
        .map(|error_model| error_model.cost_ms * each as f64)
        .sum();
    let cores = match run.threads {
        0 => std::thread::available_parallelism().map_or(1, usize::from),
        threads => threads,
    };
    let min_ms = cost_ms / cores as f64;
    let period_ms = 1e3 / sonar.settings.max_ping_rate_hz;
    if min_ms > period_ms {
        return Err(format!(
            "run.delivery = \"streaming\": a ping is foreseen to take {min_ms:.0} ms or more on {cores} cores and comes every {period_ms:.0} ms: no latency is long enough"
        ));
    }
    let (ahead_ms, latency_ms) = (run.ahead_s * 1e3, latency_s * 1e3);
    let first_ms = (block_s + latency_s) * 1e3;
    if sonar.trigger.from.is_wired() && min_ms > first_ms {
        return Err(format!(
            "run.stream_latency_ms = {latency_ms}: a ping is foreseen to take {min_ms:.0} ms or more on {cores} cores, and nobody knows of a trigger before it comes: must be longer"
        ));
    }
    if min_ms > ahead_ms + first_ms {
        return Err(format!(
            "run.ahead_ms = {ahead_ms}: a ping is foreseen to take {min_ms:.0} ms or more on {cores} cores; must be longer, or run.stream_latency_ms"
        ));
    }
    Ok(())
}

/// What an error model's cost is for.
fn whole(sonar: &SonarSpec) -> &'static str {
    match sonar.model.synthesis {
        Synthesis::Gridded2d => "array and ping",
        _ => "element and ping",
    }
}

/// What `cull_db` leaves out of each array's reverberation; empty where nothing is culled.
fn culling(sonar: &SonarSpec, medium: &MediumSpec) -> String {
    let Some(cull_db) = sonar.model.cull_db else {
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
            "culling      {} {name}: what lies below {cull_db} dB; error of a flat bottom's windows {}, {}, {}, {} degrees of incidence\n",
            sonar.name,
            at(20),
            at(45),
            at(70),
            at(85)
        );
    }
    text
}

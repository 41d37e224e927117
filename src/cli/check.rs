//! `echotank check`: is a configuration right, and what follows from it.

mod plan;

use std::path::PathBuf;

use clap::Args;

use super::{Failure, load};
use crate::config;
use crate::config::spec::{MediumSpec, SonarSpec};
use crate::echo::culling::left_out_share;
use crate::flow::Synthesis;
use crate::run::pipeline::engine_cards;

#[derive(Args, Clone, Debug)]
pub struct CheckArgs {
    /// Configuration file (TOML)
    #[arg(required_unless_present_any = ["template", "schema"])]
    pub config: Option<PathBuf>,
    /// Change a value before checking (see `run --help`)
    #[arg(long = "set", value_name = "KEY=VALUE")]
    pub set: Vec<String>,
    /// Print a commented configuration with every key to start from
    #[arg(long)]
    pub template: bool,
    /// Print the JSON Schema of a configuration
    #[arg(long, conflicts_with = "template")]
    pub schema: bool,
    /// Print the plan of methods, and nothing else, as JSON
    #[arg(long, requires = "config")]
    pub json: bool,
    /// Print every candidate of the plan too, cheapest first
    #[arg(long, requires = "config")]
    pub all: bool,
    /// Do not plan: say only whether the configuration is right
    #[arg(long, conflicts_with_all = ["json", "all"])]
    pub quick: bool,
    /// What methods cost on this machine, as --calibrate writes it (default: run.costs, or the table that comes with the program)
    #[arg(long, value_name = "FILE")]
    pub costs: Option<PathBuf>,
    /// Measure what methods cost on this machine, on this configuration's sonars and scene, and write FILE
    #[arg(long, value_name = "FILE", requires = "config")]
    pub calibrate: Option<PathBuf>,
}

pub fn main(args: &CheckArgs) -> Result<(), Failure> {
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
            let refuse = |why| {
                Failure::Configuration(format!("{}: sonar {}: {why}", path.display(), sonar.name))
            };
            for card in engine_cards(sonar, &spec.medium).map_err(refuse)? {
                let cost = match card.cost_ms > 0.0 {
                    true => format!(", {:.2} ms on one core per {}", card.cost_ms, whole(sonar)),
                    false => String::new(),
                };
                println!(
                    "engine       {}: {} within {:.1e}{cost} ({})",
                    sonar.name, card.name, card.error, card.why
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

/// What a card's cost is for.
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

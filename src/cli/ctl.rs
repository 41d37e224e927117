//! `echotank ctl`: controls and queries a running daemon over HTTP.

use std::net::SocketAddr;

use clap::{Args, Subcommand};
use serde_json::{Value, json};

use super::Failure;
use echotank_runtime::io::control::{Command, Settings, TriggerName, client};

#[derive(Args, Clone, Debug)]
pub(crate) struct CtlArgs {
    /// Address of the daemon's control server: `control.listen` of its configuration
    #[arg(long, default_value = "127.0.0.1:7780")]
    pub(crate) address: SocketAddr,
    /// `control.token` of its configuration, if set
    #[arg(long, env = "ECHOTANK_TOKEN", hide_env_values = true)]
    pub(crate) token: Option<String>,
    #[command(subcommand)]
    pub(crate) what: CtlCommand,
}

#[derive(Subcommand, Clone, Debug)]
pub(crate) enum CtlCommand {
    /// Stop the simulation clock
    Pause,
    /// Restart the simulation clock
    Resume,
    /// Send this many pings, then pause
    Step {
        #[arg(default_value_t = 1)]
        pings: u64,
    },
    /// Change sonar settings; others keep their values
    Set(SetArgs),
    /// Request pings of an externally triggered sonar; they start at its ping period
    Trigger {
        #[arg(default_value_t = 1)]
        pings: u64,
        /// Name of the sonar, required if there are several
        #[arg(long)]
        sonar: Option<String>,
    },
    /// Inject a fault: kind and keys as in [[fault]] of a configuration, e.g. gain element=3 value=-6 for_s=10
    Fault {
        kind: String,
        #[arg(value_name = "KEY=VALUE")]
        keys: Vec<String>,
    },
    /// Remove the fault with this number, or all faults
    ClearFaults { fault: Option<u32> },
    /// Set the clock mode: realtime or scaled (with a rate), or fast or lockstep. Only switching within either pair is allowed
    Clock { mode: String, rate: Option<f64> },
    /// Send a command as JSON, e.g. '{"do": "step", "pings": 3}'
    Send { json: String },
    /// Print the complete status as JSON
    Status,
    /// Print counters and quantiles as Prometheus text
    Metrics,
}

#[derive(Args, Clone, Debug)]
pub(crate) struct SetArgs {
    /// Name of the sonar, required if there are several
    #[arg(long)]
    pub(crate) sonar: Option<String>,
    #[arg(long)]
    pub(crate) range_m: Option<f64>,
    /// Maximum ping rate; 0 stops pinging
    #[arg(long)]
    pub(crate) rate_hz: Option<f64>,
    #[arg(long)]
    pub(crate) source_level_db: Option<f64>,
    #[arg(long)]
    pub(crate) gain_db: Option<f64>,
    #[arg(long)]
    pub(crate) pulse_ms: Option<f64>,
    #[arg(long)]
    pub(crate) pinging: Option<bool>,
    /// internal: pings at the sonar's own rate; external: only when triggered
    #[arg(long, value_parser = trigger_name)]
    pub(crate) trigger: Option<TriggerName>,
}

fn trigger_name(text: &str) -> Result<TriggerName, String> {
    match text {
        "internal" => Ok(TriggerName::Internal),
        "external" => Ok(TriggerName::External),
        _ => Err("must be internal or external".to_owned()),
    }
}

pub(crate) fn main(args: &CtlArgs) -> Result<(), Failure> {
    let command = match &args.what {
        CtlCommand::Pause => Command::Pause,
        CtlCommand::Resume => Command::Resume,
        CtlCommand::Step { pings } => Command::Step { pings: *pings },
        CtlCommand::Set(set) => Command::Set(Settings {
            sonar: set.sonar.clone(),
            range_m: set.range_m,
            rate_hz: set.rate_hz,
            source_level_db: set.source_level_db,
            gain_db: set.gain_db,
            pulse_ms: set.pulse_ms,
            pinging: set.pinging,
            trigger: set.trigger,
        }),
        CtlCommand::Trigger { pings, sonar } => Command::Trigger {
            sonar: sonar.clone(),
            pings: *pings,
        },
        CtlCommand::Fault { kind, keys } => return send(args, &fault(kind, keys)?),
        CtlCommand::ClearFaults { fault } => Command::ClearFaults { fault: *fault },
        CtlCommand::Clock { mode, rate } => {
            return send(args, &json!({ "do": "clock", "mode": mode, "rate": rate }));
        }
        CtlCommand::Send { json } => {
            let body = serde_json::from_str(json)
                .map_err(|why| Failure::Configuration(format!("{json}: {why}")))?;
            return send(args, &body);
        }
        CtlCommand::Status => return show(args, "/status"),
        CtlCommand::Metrics => return show(args, "/metrics"),
    };
    send(args, &json!(command))
}

/// Converts `KEY=VALUE` pairs to JSON. A value that parses as JSON keeps its type.
fn fault(kind: &str, keys: &[String]) -> Result<Value, Failure> {
    let mut body = json!({ "do": "fault", "kind": kind });
    for pair in keys {
        let Some((key, value)) = pair.split_once('=') else {
            return Err(Failure::Configuration(format!(
                "{pair}: expected KEY=VALUE"
            )));
        };
        body[key] = serde_json::from_str(value).unwrap_or_else(|_| json!(value));
    }
    Ok(body)
}

fn send(args: &CtlArgs, body: &Value) -> Result<(), Failure> {
    let reply = client::command(args.address, body, args.token.as_deref());
    print(args, reply)
}

fn show(args: &CtlArgs, path: &str) -> Result<(), Failure> {
    print(args, client::get(args.address, path, args.token.as_deref()))
}

fn print(args: &CtlArgs, reply: std::io::Result<client::Reply>) -> Result<(), Failure> {
    let (status, body) =
        reply.map_err(|why| Failure::Running(format!("{}: {why}", args.address)))?;
    let text = match serde_json::from_str::<Value>(&body) {
        Ok(value) => serde_json::to_string_pretty(&value).unwrap_or(body),
        Err(_) => body.trim_end().to_owned(),
    };
    if status != 200 {
        return Err(Failure::Running(format!("{}: {text}", args.address)));
    }
    println!("{text}");
    Ok(())
}

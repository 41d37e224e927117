//! `echotank ctl`: controls and queries a running daemon over HTTP.

use std::net::SocketAddr;
use std::path::{Path, PathBuf};

use clap::{Args, Subcommand};
use serde_json::{Value, json};

use super::Failure;
use echotank_runtime::io::control::{Command, client, words};

#[derive(Args, Clone, Debug)]
pub(crate) struct CtlArgs {
    /// Address of the daemon's control server: `control.listen` of its configuration
    #[arg(long, global = true, default_value = "127.0.0.1:7780")]
    pub(crate) address: SocketAddr,
    /// `control.token` of its configuration, if set
    #[arg(long, global = true, env = "ECHOTANK_TOKEN", hide_env_values = true)]
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
    /// Change settings of a sonar, e.g. range_m=75 gain_db=3; others keep their values
    ///
    /// Keys: sonar (its name, required if there are several), range_m, rate_hz (maximum ping rate; 0 stops pinging), source_level_db, gain_db,
    /// pulse_ms, pinging (true or false), trigger (internal: pings at the sonar's own rate; external: only when triggered).
    Set {
        #[arg(value_name = "KEY=VALUE", required = true, allow_hyphen_values = true)]
        keys: Vec<String>,
    },
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
        #[arg(value_name = "KEY=VALUE", allow_hyphen_values = true)]
        keys: Vec<String>,
    },
    /// Remove the fault with this number, or all faults
    ClearFaults { fault: Option<u32> },
    /// Start or stop recording: on or off. A start opens new files
    Record {
        #[arg(value_parser = ["on", "off"])]
        state: String,
        /// Name of the sonar (default: all)
        #[arg(long)]
        sonar: Option<String>,
    },
    /// Replace the sound-speed profile from the next ping, by a cast: .asvp, .svp, .vel or lines of depth and sound speed
    Profile { cast: PathBuf },
    /// Set the clock mode: realtime or scaled (with a rate), or fast or lockstep. Only switching within either pair is allowed
    Clock {
        #[arg(value_parser = ["realtime", "scaled", "fast", "lockstep"])]
        mode: String,
        rate: Option<f64>,
    },
    /// Send a command as JSON, e.g. '{"do": "step", "pings": 3}'
    Send { json: String },
    /// Print the complete status as JSON
    Status,
    /// Print counters and quantiles as Prometheus text
    Metrics,
}

pub(crate) fn main(args: &CtlArgs) -> Result<(), Failure> {
    let command = match &args.what {
        CtlCommand::Pause => Command::Pause,
        CtlCommand::Resume => Command::Resume,
        CtlCommand::Step { pings } => Command::Step { pings: *pings },
        CtlCommand::Set { keys } => {
            let body = words::from_pairs("set", keys).map_err(Failure::Configuration)?;
            return send(args, &Value::Object(body));
        }
        CtlCommand::Trigger { pings, sonar } => Command::Trigger {
            sonar: sonar.clone(),
            pings: *pings,
        },
        CtlCommand::Fault { kind, keys } => return send(args, &fault(kind, keys)?),
        CtlCommand::ClearFaults { fault } => Command::ClearFaults { fault: *fault },
        CtlCommand::Record { state, sonar } => Command::Record {
            sonar: sonar.clone(),
            on: state == "on",
        },
        CtlCommand::Profile { cast } => Command::Profile {
            points: points(cast)?,
        },
        CtlCommand::Clock { mode, rate } => {
            return send(args, &json!({ "do": "clock", "mode": mode, "rate": rate }));
        }
        CtlCommand::Send { json } => {
            let body: Value = serde_json::from_str(json)
                .map_err(|_| Failure::Configuration(format!("{json}: is not valid JSON")))?;
            words::parse(&body).map_err(Failure::Configuration)?;
            return send(args, &body);
        }
        CtlCommand::Status => return show(args, "/status"),
        CtlCommand::Metrics => return show(args, "/metrics"),
    };
    send(args, &json!(command))
}

/// The points of a cast.
fn points(cast: &Path) -> Result<Vec<(f64, f64)>, Failure> {
    let read = std::fs::read(cast).map_err(|why| format!("cannot be read: {why}"));
    let profile = read.and_then(|bytes| echotank_config::read_profile(cast, &bytes));
    let profile =
        profile.map_err(|why| Failure::Configuration(format!("{}: {why}", cast.display())))?;
    Ok(profile.points().to_vec())
}

/// The command of a fault, whose kind and values are checked.
fn fault(kind: &str, keys: &[String]) -> Result<Value, Failure> {
    let mut body = words::from_pairs("fault", keys).map_err(Failure::Configuration)?;
    if body.contains_key("kind") {
        let why = format!("{kind}: the kind is given twice");
        return Err(Failure::Configuration(why));
    }
    body.insert("kind".to_owned(), json!(kind));
    let body = Value::Object(body);
    let command = words::parse(&body).map_err(Failure::Configuration)?;
    if let Command::Fault(request) = command
        && let Err(refused) = request.checked()
    {
        let given = match &body[refused.key] {
            Value::Null => String::new(),
            value => format!(" = {value}"),
        };
        return Err(Failure::Configuration(format!(
            "{}{given}: {}",
            refused.key, refused.rule
        )));
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
    let (status, body) = reply.map_err(|why| no_answer(args.address, &why))?;
    let value = serde_json::from_str::<Value>(&body);
    if status != 200 {
        let why = value.ok().and_then(|v| Some(v["why"].as_str()?.to_owned()));
        let why = why.unwrap_or_else(|| body.trim_end().to_owned());
        return Err(Failure::Running(format!("{} refused: {why}", args.address)));
    }
    let text = match value {
        Ok(value) => serde_json::to_string_pretty(&value).unwrap_or(body),
        Err(_) => body.trim_end().to_owned(),
    };
    println!("{text}");
    Ok(())
}

/// The failure to reach the daemon.
fn no_answer(address: SocketAddr, why: &std::io::Error) -> Failure {
    use std::io::ErrorKind::{ConnectionRefused, TimedOut, WouldBlock};
    let remedy = "start one with `echotank run RIG`, or give its control.listen with --address";
    Failure::Running(match why.kind() {
        ConnectionRefused => format!("no daemon listens at {address}: {remedy}"),
        TimedOut | WouldBlock => format!("no daemon answers at {address} in time: {remedy}"),
        _ => format!("no daemon answers at {address}: {why}"),
    })
}

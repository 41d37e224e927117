//! Control over HTTP: JSON commands and replies. [`router`] holds the routes; [`ControlPort`] executes the commands.
//!
//! One thread with its own tokio runtime runs the server, separate from pings and protocols. The server listens on the loopback interface by
//! default, and requires a token elsewhere. [`router`] describes the protection against pages of other sites.
//!
//! The server also provides the operator's page: [`assets`] holds the files, [`socket`] the WebSocket, [`feed`] the data of the pings.

mod assets;
mod attempts;
pub mod client;
mod connections;
pub mod feed;
pub mod frame;
mod router;
pub mod socket;
pub mod words;

use std::net::SocketAddr;
use std::sync::Arc;
use std::thread::JoinHandle;
use std::time::Duration;

use axum::Json;
pub use axum::body::Bytes;
use axum::extract::FromRef;
use axum::http::StatusCode;
use axum::response::{IntoResponse, Response};
use serde::{Deserialize, Serialize};
use serde_json::{Value, json};
use tokio::sync::watch;

use crate::io::listening::Listening;
use echotank_config::spec::FaultRequest;
use echotank_core::settings::{Requester, SettingChange, TriggerSource};
use feed::Feed;
use socket::{Pages, ReliefTile};

/// Time limit for sending replies when the server stops.
const DRAIN: Duration = Duration::from_millis(500);

/// A command, such as `{"do": "step", "pings": 3}`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(tag = "do", rename_all = "kebab-case", deny_unknown_fields)]
pub enum Command {
    /// Stops rig time; recorded navigation only.
    Pause,
    /// Resumes rig time.
    Resume,
    /// Delivers this many pings and pauses.
    Step {
        /// Number of pings.
        #[serde(default = "one")]
        pings: u64,
    },
    /// Changes settings.
    Set(Settings),
    /// Starts this many pings at the configured rate, for a sonar that has an external trigger or does not ping.
    Trigger {
        /// Sonar name; optional with one sonar.
        #[serde(default, skip_serializing_if = "Option::is_none")]
        sonar: Option<String>,
        /// Number of pings.
        #[serde(default = "one")]
        pings: u64,
    },
    /// Injects a fault from the next ping, or `at_s` after the first.
    Fault(FaultRequest),
    /// Clears one fault, or all.
    ClearFaults {
        /// Number of the fault; `None`: all.
        #[serde(default, skip_serializing_if = "Option::is_none")]
        fault: Option<u32>,
    },
    /// Stops or starts the recordings from the next ping. A start opens new files.
    Record {
        /// Sonar name; `None`: every sonar that records.
        #[serde(default, skip_serializing_if = "Option::is_none")]
        sonar: Option<String>,
        /// Whether pings are recorded.
        on: bool,
    },
    /// Replaces the sound-speed profile from the next ping of each sonar.
    Profile {
        /// Depth in metres and sound speed in metres per second, the shallowest first.
        points: Vec<(f64, f64)>,
    },
    /// Changes how rig time passes.
    Clock {
        /// The new mode.
        mode: ClockMode,
        /// Rig time per machine time, for `scaled`.
        #[serde(default, skip_serializing_if = "Option::is_none")]
        rate: Option<f64>,
    },
}

/// Clock mode, with the values of `run.clock` in the configuration.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum ClockMode {
    /// Machine time.
    RealTime,
    /// Machine time times a rate.
    Scaled,
    /// Rig time that advances as fast as pings are computed.
    Fast,
    /// Steps by command.
    Lockstep,
}

/// Trigger source, with the values of [`TriggerSource`].
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum TriggerName {
    /// The sonar's own rate.
    Internal,
    /// An external trigger.
    External,
}

fn one() -> u64 {
    1
}

/// Settings of one sonar; `None` keeps the present value.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Settings {
    /// Sonar name; optional with one sonar.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub sonar: Option<String>,
    /// Range, m.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub range_m: Option<f64>,
    /// Maximum ping rate, Hz.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub rate_hz: Option<f64>,
    /// Source level, dB re 1 uPa at 1 m.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub source_level_db: Option<f64>,
    /// Receiver gain, dB.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub gain_db: Option<f64>,
    /// Pulse duration, ms.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub pulse_ms: Option<f64>,
    /// Whether the sonar pings.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub pinging: Option<bool>,
    /// Trigger source of its pings.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub trigger: Option<TriggerName>,
}

impl Settings {
    /// The changes in the order in which they are applied.
    pub fn changes(&self) -> Vec<SettingChange> {
        let start_or_stop = |pinging| match pinging {
            true => SettingChange::Start,
            false => SettingChange::Stop,
        };
        [
            self.range_m.map(SettingChange::RangeM),
            self.rate_hz.map(SettingChange::MaxPingRateHz),
            self.source_level_db.map(SettingChange::SourceLevelDb),
            self.gain_db.map(SettingChange::GainDb),
            self.pulse_ms
                .map(|ms| SettingChange::PulseDurationS(ms * 1e-3)),
            self.trigger.map(|trigger| {
                SettingChange::Trigger(match trigger {
                    TriggerName::Internal => TriggerSource::Internal,
                    TriggerName::External => TriggerSource::External,
                })
            }),
            self.pinging.map(start_or_stop),
        ]
        .into_iter()
        .flatten()
        .collect()
    }
}

/// Reply to a command.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Answer {
    /// Whether the command was accepted.
    pub accepted: bool,
    /// The command as parsed.
    pub asked: Value,
    /// Reason of a refusal.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub why: Option<String>,
    /// State after the command.
    #[serde(default, skip_serializing_if = "Value::is_null")]
    pub now: Value,
}

impl Answer {
    fn to(command: &Command) -> Value {
        // A command is plain data, so serialisation succeeds.
        serde_json::to_value(command).unwrap_or(Value::Null)
    }

    /// A reply to an accepted command.
    pub fn accepted(command: &Command, now: Value) -> Self {
        Self {
            accepted: true,
            asked: Self::to(command),
            why: None,
            now,
        }
    }

    /// A reply to a refused command.
    pub fn refused(command: &Command, why: String) -> Self {
        Self {
            accepted: false,
            asked: Self::to(command),
            why: Some(why),
            now: Value::Null,
        }
    }
}

/// The daemon's interface for this server; no method waits.
pub trait ControlPort: Send + Sync {
    /// Carries out or refuses a command.
    fn command(&self, command: &Command, by: Requester) -> Answer;
    /// Full state as JSON, for GET /status.
    fn status(&self) -> Value;
    /// Prometheus text, version 0.0.4.
    fn metrics(&self) -> String;
    /// Reason why the daemon is unhealthy; `None` if it is healthy.
    fn health_problem(&self) -> Option<String> {
        None
    }
    /// Frames of the pings for the page.
    fn feed(&self) -> &Arc<Feed>;
    /// Description of the rig, which does not change while the daemon runs, for the page.
    fn hello(&self) -> Value;
    /// State that belongs to no ping, for the page.
    fn page_state(&self) -> Value;
    /// Number that changes whenever settings or commands change the state.
    fn revision(&self) -> u64;
    /// Targets, once their positions are known, for the page.
    fn world(&self) -> Value;
    /// A frame of seabed depths; `None` without a seabed, or before the tile is available.
    fn relief(&self, tile: ReliefTile) -> Option<Bytes>;
}

/// Errors of starting the control server.
#[derive(Debug, thiserror::Error)]
pub enum OpenError {
    /// The address could not be bound.
    #[error("cannot listen on TCP {address}: {source}")]
    Listen {
        /// The address that the configuration names.
        address: SocketAddr,
        /// The cause.
        source: std::io::Error,
    },
    /// The thread or its runtime could not start.
    #[error("cannot start the server's thread: {0}")]
    Thread(std::io::Error),
}

/// State of the routes.
#[derive(Clone)]
struct Shared {
    port: Arc<dyn ControlPort>,
    pages: Arc<Pages>,
    /// Becomes true when the server stops.
    stopped: watch::Receiver<bool>,
}

impl FromRef<Shared> for Arc<dyn ControlPort> {
    fn from_ref(shared: &Shared) -> Self {
        Arc::clone(&shared.port)
    }
}

fn refusal(status: StatusCode, why: &str) -> Response {
    (status, Json(json!({ "accepted": false, "why": why }))).into_response()
}

/// The running control server; stops when dropped.
pub(crate) struct ControlServer {
    local_addr: SocketAddr,
    stop: watch::Sender<bool>,
    thread: Option<JoinHandle<()>>,
    _listening: Listening,
}

impl ControlServer {
    /// Starts the server. `token` is required from clients. `or_any_port` allows any free port if the port of `address` is in use.
    pub(crate) fn start(
        address: SocketAddr,
        or_any_port: bool,
        token: Option<String>,
        port: Arc<dyn ControlPort>,
    ) -> Result<Self, OpenError> {
        let failed = |source| OpenError::Listen { address, source };
        let listener = match std::net::TcpListener::bind(address) {
            Err(error) if or_any_port && error.kind() == std::io::ErrorKind::AddrInUse => {
                std::net::TcpListener::bind((address.ip(), 0)).map_err(failed)?
            }
            bound => bound.map_err(failed)?,
        };
        listener.set_nonblocking(true).map_err(failed)?;
        let local_addr = listener.local_addr().map_err(failed)?;
        let runtime = tokio::runtime::Builder::new_current_thread()
            .enable_all()
            .build()
            .map_err(OpenError::Thread)?;
        let listening = Listening::at("control", local_addr);
        let (stop, stopped) = watch::channel(false);
        let shared = Shared {
            port,
            pages: Arc::new(Pages::new()),
            stopped: stopped.clone(),
        };
        let thread = std::thread::Builder::new()
            .name("control".into())
            .spawn(move || runtime.block_on(serve(listener, shared, token, stopped)))
            .map_err(OpenError::Thread)?;
        Ok(Self {
            local_addr,
            stop,
            thread: Some(thread),
            _listening: listening,
        })
    }

    pub(crate) fn local_addr(&self) -> SocketAddr {
        self.local_addr
    }
}

impl Drop for ControlServer {
    fn drop(&mut self) {
        self.stop.send_replace(true);
        if let Some(thread) = self.thread.take() {
            // The panic hook has reported a panic of the thread.
            let _ = thread.join();
        }
    }
}

async fn serve(
    listener: std::net::TcpListener,
    shared: Shared,
    token: Option<String>,
    stopped: watch::Receiver<bool>,
) {
    let Ok(listener) = tokio::net::TcpListener::from_std(listener) else {
        return; // fails only outside of a runtime, and this function runs inside one
    };
    let wait = |mut stopped: watch::Receiver<bool>| async move {
        let _ = stopped.wait_for(|&stop| stop).await;
    };
    let (pages, port) = (Arc::clone(&shared.pages), Arc::clone(&shared.port));
    let served = connections::serve(listener, router::router(shared, token), stopped.clone());
    tokio::select! {
        () = async {
            served.await;
            pages.closed().await;
        } => {}
        () = pages.renew(port.as_ref()) => {}
        () = async { wait(stopped).await; tokio::time::sleep(DRAIN).await } => {}
    }
}

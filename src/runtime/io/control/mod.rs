//! Control over HTTP: commands in, answers out, as JSON. The routes are in [`router`]; what a command does is behind [`ControlPort`].
//!
//! One thread with a tokio runtime of its own, apart from pings and protocols. It listens on this machine alone unless told otherwise, and
//! then asks for a token. A page of another site cannot reach it: see [`router`].
//!
//! It also serves the operator's page: [`assets`] are its files, [`socket`] is its WebSocket, [`feed`] brings it what the pings made.

mod assets;
pub mod client;
pub mod feed;
pub mod frame;
mod router;
pub mod socket;

use std::net::SocketAddr;
use std::sync::Arc;
use std::thread::JoinHandle;
use std::time::Duration;

pub use axum::body::Bytes;
use serde::{Deserialize, Serialize};
use serde_json::Value;
use tokio::sync::watch;

use echotank_config::spec::FaultRequest;
use echotank_core::flow::{Asker, SettingChange, TriggerSource};
use feed::Feed;
use socket::{Pages, ReliefTile};

/// For answers on their way when the server stops.
const DRAIN: Duration = Duration::from_millis(500);

/// What may be asked. `{"do": "step", "pings": 3}`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(tag = "do", rename_all = "kebab-case", deny_unknown_fields)]
pub enum Command {
    Pause,
    Resume,
    /// Lets so many pings out and pauses.
    Step {
        #[serde(default = "one")]
        pings: u64,
    },
    Set(Settings),
    /// Starts so many pings of a sonar, on its beat; for one whose trigger is external, or that does not ping.
    Trigger {
        #[serde(default, skip_serializing_if = "Option::is_none")]
        sonar: Option<String>,
        #[serde(default = "one")]
        pings: u64,
    },
    /// From the next ping on, or `at_s` after the first.
    Fault(FaultRequest),
    /// Takes a fault away, or all.
    ClearFaults {
        #[serde(default, skip_serializing_if = "Option::is_none")]
        fault: Option<u32>,
    },
    /// How time goes from now on.
    Clock {
        mode: ClockMode,
        /// Of `scaled`: times as fast as the machine's.
        #[serde(default, skip_serializing_if = "Option::is_none")]
        rate: Option<f64>,
    },
}

/// As `run.clock` of the configuration.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum ClockMode {
    RealTime,
    Scaled,
    Fast,
    Lockstep,
}

/// As [`TriggerSource`].
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum TriggerName {
    Internal,
    External,
}

fn one() -> u64 {
    1
}

/// Settings of one sonar; what is left out stays.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Settings {
    /// May be left out where there is one sonar.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub sonar: Option<String>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub range_m: Option<f64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub rate_hz: Option<f64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub source_level_db: Option<f64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub gain_db: Option<f64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub pulse_ms: Option<f64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub pinging: Option<bool>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub trigger: Option<TriggerName>,
}

impl Settings {
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

/// What became of a command.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Answer {
    pub accepted: bool,
    /// The command as it was understood.
    pub asked: Value,
    /// Why it was refused.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub why: Option<String>,
    /// What holds now.
    #[serde(default, skip_serializing_if = "Value::is_null")]
    pub now: Value,
}

impl Answer {
    fn to(command: &Command) -> Value {
        // A command is plain data: it can always be written.
        serde_json::to_value(command).unwrap_or(Value::Null)
    }

    pub fn accepted(command: &Command, now: Value) -> Self {
        Self {
            accepted: true,
            asked: Self::to(command),
            why: None,
            now,
        }
    }

    pub fn refused(command: &Command, why: String) -> Self {
        Self {
            accepted: false,
            asked: Self::to(command),
            why: Some(why),
            now: Value::Null,
        }
    }
}

/// The daemon as the server sees it. Nothing here waits.
pub trait ControlPort: Send + Sync {
    fn command(&self, command: &Command, by: Asker) -> Answer;
    fn status(&self) -> Value;
    /// Prometheus text, version 0.0.4.
    fn metrics(&self) -> String;
    /// Why the daemon is not well, if it is not.
    fn ailment(&self) -> Option<String> {
        None
    }
    /// What the pings have for the page.
    fn feed(&self) -> &Arc<Feed>;
    /// What does not change while the daemon runs, for the page.
    fn hello(&self) -> Value;
    /// What is not of one ping, for the page.
    fn page_state(&self) -> Value;
    /// Another whenever somebody has changed something.
    fn revision(&self) -> u64;
    /// Where the targets lie, once that is known.
    fn world(&self) -> Value;
    /// A frame of the seabed's depths; none where there is no seabed, or not yet.
    fn relief(&self, tile: ReliefTile) -> Option<Bytes>;
}

#[derive(Debug, thiserror::Error)]
pub enum OpenError {
    #[error("cannot listen on TCP {address}: {source}")]
    Listen {
        address: SocketAddr,
        source: std::io::Error,
    },
    #[error("cannot start the server's thread: {0}")]
    Thread(std::io::Error),
}

/// Stops when dropped.
pub(crate) struct ControlServer {
    local_addr: SocketAddr,
    stop: watch::Sender<bool>,
    thread: Option<JoinHandle<()>>,
}

impl ControlServer {
    /// `token`: asked for where there is one. `or_any_port`: where the port is somebody else's, any other will do.
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
        let (stop, stopped) = watch::channel(false);
        let shared = router::Shared {
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
            // A panic in it was printed where it happened.
            let _ = thread.join();
        }
    }
}

async fn serve(
    listener: std::net::TcpListener,
    shared: router::Shared,
    token: Option<String>,
    stopped: watch::Receiver<bool>,
) {
    let Ok(listener) = tokio::net::TcpListener::from_std(listener) else {
        return; // no runtime, no server: cannot happen inside one
    };
    let wait = |mut stopped: watch::Receiver<bool>| async move {
        let _ = stopped.wait_for(|&stop| stop).await;
    };
    let (pages, port) = (Arc::clone(&shared.pages), Arc::clone(&shared.port));
    let routes = router::router(shared, token).into_make_service_with_connect_info::<SocketAddr>();
    let server = axum::serve(listener, routes).with_graceful_shutdown(wait(stopped.clone()));
    tokio::select! {
        _ = server => {}
        () = pages.renew(port.as_ref()) => {}
        () = async { wait(stopped).await; tokio::time::sleep(DRAIN).await } => {}
    }
}

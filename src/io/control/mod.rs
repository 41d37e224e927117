//! Control over HTTP: commands in, answers out, as JSON. The routes are in [`router`]; what a command does is behind [`ControlPort`].
//!
//! One thread with a tokio runtime of its own, apart from pings and protocols. It listens on this machine alone unless told otherwise, and
//! then asks for a token. A page of another site cannot reach it: see [`router`].

pub mod client;
mod router;

use std::net::SocketAddr;
use std::sync::Arc;
use std::thread::JoinHandle;
use std::time::Duration;

use serde::{Deserialize, Serialize};
use serde_json::Value;
use tokio::sync::watch;

use crate::config::spec::FaultRequest;
use crate::flow::SettingChange;

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
    ClearFaults,
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
    fn command(&self, command: &Command) -> Answer;
    fn status(&self) -> Value;
    /// Prometheus text, version 0.0.4.
    fn metrics(&self) -> String;
    /// Why the daemon is not well, if it is not.
    fn ailment(&self) -> Option<String> {
        None
    }
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
pub struct ControlServer {
    local_addr: SocketAddr,
    stop: watch::Sender<bool>,
    thread: Option<JoinHandle<()>>,
}

impl ControlServer {
    /// `token`: asked for where there is one.
    pub fn start(
        address: SocketAddr,
        token: Option<String>,
        port: Arc<dyn ControlPort>,
    ) -> Result<Self, OpenError> {
        let failed = |source| OpenError::Listen { address, source };
        let listener = std::net::TcpListener::bind(address).map_err(failed)?;
        listener.set_nonblocking(true).map_err(failed)?;
        let local_addr = listener.local_addr().map_err(failed)?;
        let runtime = tokio::runtime::Builder::new_current_thread()
            .enable_all()
            .build()
            .map_err(OpenError::Thread)?;
        let (stop, stopped) = watch::channel(false);
        let routes = router::router(port, token);
        let thread = std::thread::Builder::new()
            .name("control".into())
            .spawn(move || runtime.block_on(serve(listener, routes, stopped)))
            .map_err(OpenError::Thread)?;
        Ok(Self {
            local_addr,
            stop,
            thread: Some(thread),
        })
    }

    pub fn local_addr(&self) -> SocketAddr {
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
    routes: axum::Router,
    stopped: watch::Receiver<bool>,
) {
    let Ok(listener) = tokio::net::TcpListener::from_std(listener) else {
        return; // no runtime, no server: cannot happen inside one
    };
    let wait = |mut stopped: watch::Receiver<bool>| async move {
        let _ = stopped.wait_for(|&stop| stop).await;
    };
    let server = axum::serve(listener, routes).with_graceful_shutdown(wait(stopped.clone()));
    tokio::select! {
        _ = server => {}
        () = async { wait(stopped).await; tokio::time::sleep(DRAIN).await } => {}
    }
}

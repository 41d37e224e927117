//! The daemon: pings paced in real time on absolute deadlines.
//!
//! ```text
//! pipeline thread                          a delivery thread per sonar        server threads (tokio)
//!   nav in -> orders at t_tx -> compute ->   records -> wait for deadline ->    clients, each with its own queue
//!        ^------------- free slots ------------'
//! ```
//!
//! A ping is ordered at its transmit instant `t_tx` with the settings then active. It is computed when the navigation covers its window, or
//! from predicted navigation. It is delivered at `t_tx + window + latency`. A later delivery is a deadline miss. A ping that cannot be
//! delivered is skipped: a counter records the reason, and its number is not reused.
//!
//! This timing applies to the clocks `realtime` and `scaled`. With `fast` and `lockstep` the pipeline advances time from pulse to pulse
//! (`stepped`), so no ping is late or skipped for lateness. The samples are the same bits with every clock.

mod delivery;
mod event_log;
mod machine;
mod pacer;
mod scheduler;
mod stepped;
mod triggers;

use std::collections::VecDeque;
use std::net::SocketAddr;
use std::path::Path;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, OnceLock};
use std::thread::{self};

use self::delivery::{DeliveryContext, open_lane};
use self::event_log::{EventLog, SkippedPing};
use self::machine::{answer_time, clock_of, preference, request_real_time};
use self::pacer::{MAX_ORDERS, Pacer};
use self::triggers::{Triggers, at_first};
use thiserror::Error;

use crate::clock::{Clock, SystemClock};
use crate::control::{RunControl, SonarControl};
use crate::counters::PingCounters;
use crate::faults::nav::NavFaults;
use crate::histograms::Histograms;
use crate::io::control::feed::Feed;
use crate::io::control::{ControlServer, OpenError as ControlOpenError};
use crate::io::nav::output::{ClockFaults, NavOutputError, NavOutputs};
use crate::io::nav::{NavInputs, ReadNav};
use crate::io::notify::Notify;
use crate::io::record::RecordError;
use crate::io::record::recover::recover_folder;
use crate::io::trigger::ListenerError;
use crate::io::trigger::out::TriggerOutputError;
use crate::outputs::{OutputError, Outputs, PageContext};
use crate::overload::{Backlog, DegradationLevels};
use crate::page::PageSource;
use crate::rig::OpenError;
use crate::rig::pool_of;
use crate::settings::SettingsStore;
use crate::triggers::TriggerCounts;
use echotank_config::spec::{NavInputSpec, NavSourceSpec, OverloadSpec, RigSpec};
use echotank_core::time::{MonoNs, NS_PER_S, Timeline};
use echotank_nav::health::State as NavState;
use echotank_ping::faults::Faults;
use echotank_ping::rig::Rig;

/// Errors of starting or running the daemon.
#[derive(Debug, Error)]
pub enum DaemonError {
    /// The scene, the navigation or the rig cannot be opened.
    #[error(transparent)]
    Rig(#[from] OpenError),
    /// An output cannot be opened, or its recorder cannot be closed.
    #[error(transparent)]
    Output(#[from] OutputError),
    /// A navigation output cannot be opened.
    #[error(transparent)]
    NavOutput(#[from] NavOutputError),
    /// The system refused a thread.
    #[error("could not start a thread: {0}")]
    Thread(std::io::Error),
    /// The system refused the threads that compute pings.
    #[error("could not start the threads that compute pings: {0}")]
    Pool(#[from] rayon::ThreadPoolBuildError),
    /// The log of injected faults cannot be written.
    #[error("the log of faults: {0}")]
    FaultLog(#[from] RecordError),
    /// The recording of the live navigation cannot be created.
    #[error("--record-nav: {0}")]
    NavRecording(RecordError),
    /// The trigger input cannot be opened.
    #[error(transparent)]
    Trigger(#[from] ListenerError),
    /// The trigger output cannot be opened.
    #[error(transparent)]
    TriggerOut(#[from] TriggerOutputError),
    /// The control server cannot listen.
    #[error("control: {0}")]
    Control(#[from] ControlOpenError),
    /// A channel that every ping needs is missing from the recorded sources; the text names it.
    #[error(
        "the recorded navigation lacks a quantity that every ping needs: {0}; list in `provides` only what a source sends"
    )]
    NoNav(String),
    /// A thread panicked.
    #[error("a thread of the daemon ended in a panic; this is a bug")]
    Panic,
}

/// Addresses of navigation, outputs and triggers, one line each.
fn addresses(
    spec: &RigSpec,
    inputs: &NavInputs,
    nav_out: &NavOutputs,
    outputs: &[Outputs],
    triggers: &Triggers,
) -> Vec<String> {
    let transport = |name: &str| {
        let tcp =
            |s: &NavSourceSpec| s.name == name && matches!(s.input, NavInputSpec::TcpListen { .. });
        if spec.nav.sources.iter().any(tcp) {
            "tcp"
        } else {
            "udp"
        }
    };
    let listening = inputs.listening();
    let mut lines: Vec<String> = listening
        .iter()
        .map(|(name, address)| format!("nav {name} {} {address}", transport(name)))
        .collect();
    lines.extend(nav_out.addresses());
    lines.extend(outputs.iter().flat_map(Outputs::addresses));
    lines.extend(triggers.addresses(spec));
    lines
}

/// A daemon that has opened everything it needs.
pub struct Daemon {
    clock: Arc<dyn Clock>,
    pool: rayon::ThreadPool,
    rig: Rig,
    inputs: NavInputs,
    nav_out: NavOutputs,
    /// One per sonar.
    outputs: Vec<Outputs>,
    settings: Vec<Arc<SettingsStore>>,
    triggers: Triggers,
    timeline: Arc<OnceLock<Timeline>>,
    stop: Arc<AtomicBool>,
    control: Arc<RunControl>,
    server: Option<ControlServer>,
    /// One line each on repaired records and on the scheduling that the system allowed.
    remarks: Vec<String>,
}

impl Daemon {
    /// Opens the scene, the navigation and the outputs. [`Daemon::run`] ends when `stop` becomes true. `threads` is the number of threads that
    /// compute pings.
    ///
    /// # Errors
    /// A file, socket, serial port or thread cannot be opened; see [`DaemonError`].
    pub fn open(
        spec: &RigSpec,
        threads: usize,
        stop: Arc<AtomicBool>,
    ) -> Result<Self, DaemonError> {
        let (clock, gate) = clock_of(spec.run.clock);
        let mut remarks = match &spec.record {
            Some(record) => recover_folder(&record.directory),
            None => Vec::new(),
        };
        remarks.push(request_real_time(spec.run.priority));
        remarks.extend(preference(spec.run.compute_nice));
        for remark in &remarks {
            match remark.strip_prefix("warning: ") {
                Some(warning) => tracing::warn!("{warning}"),
                None => tracing::debug!("{remark}"),
            }
        }
        let nav = ReadNav::read(&spec.nav).map_err(OpenError::Nav)?;
        for warning in &nav.warnings {
            tracing::warn!("navigation: {warning}");
        }
        remarks.extend(nav.warnings.iter().map(|w| format!("warning: {w}")));
        let spec = &RigSpec {
            nav: nav.spec.clone(),
            ..spec.clone()
        };
        let pool = pool_of(threads, spec.run.compute_nice)?;
        let rig = pool.install(|| {
            let mut rig = crate::rig::open(spec)?;
            if spec.run.overload == OverloadSpec::Degrade && !spec.run.clock.is_own() {
                rig.make_looser()?;
            }
            Ok::<_, OpenError>(rig)
        })?;
        let mut inputs = NavInputs::start(nav, clock.clone()).map_err(OpenError::Nav)?;
        let nav_faults = NavFaults::new(rig.faults.clone(), &spec.nav.sources);
        inputs.set_fault_filter(Box::new(nav_faults));
        let settings: Vec<_> = spec
            .sonars
            .iter()
            .map(|sonar| {
                Arc::new(SettingsStore::triggered(
                    sonar.settings,
                    at_first(&sonar.trigger.from, spec.run.clock),
                    sonar.limits,
                    clock.clone(),
                ))
            })
            .collect();
        let timeline = Arc::new(OnceLock::new());
        let answer_time = answer_time(spec.nav.stamp, &clock, &timeline);
        let nav_out = {
            let faults: Arc<dyn ClockFaults> = rig.faults.clone();
            NavOutputs::open_with(&spec.nav.outputs, &clock, &answer_time, Some(&faults))?
        };
        let feed = Arc::new(Feed::new(spec.sonars.len()));
        let mut outputs = Vec::new();
        let mut histograms = Vec::new();
        for (unit, settings) in rig.sonars.iter().zip(&settings) {
            let own = Arc::<Histograms>::default();
            let page = spec.control.listen.map(|_| PageContext {
                feed: feed.clone(),
                sonar: outputs.len() as u16,
                world: rig.world.clone(),
            });
            let opened =
                Outputs::open(&rig.spec, unit, settings, &answer_time, &clock, &own, page)?;
            outputs.push(opened);
            histograms.push(own);
        }
        let trigger_counts: Vec<_> = spec
            .sonars
            .iter()
            .map(|_| Arc::new(TriggerCounts::default()))
            .collect();
        let triggers = Triggers::open(spec, &clock, &gate, &trigger_counts)?;
        let ports = addresses(spec, &inputs, &nav_out, &outputs, &triggers);
        let mut trigger_counts = trigger_counts.into_iter();
        let sonars = spec.sonars.iter().zip(&settings).zip(&outputs);
        let sonars = sonars.zip(histograms);
        let sonars = sonars.map(|(((sonar, settings), outputs), histograms)| SonarControl {
            name: sonar.name.clone(),
            settings: settings.clone(),
            counters: Arc::new(PingCounters::default()),
            triggers: trigger_counts.next().unwrap_or_default(),
            histograms,
            reports: outputs.reports(),
        });
        let control = Arc::new(RunControl::new(
            spec.run.clock,
            gate,
            spec.nav.is_recorded(),
            sonars.collect(),
            rig.faults.clone(),
            answer_time,
            PageSource {
                feed,
                spec: spec.clone(),
                world: rig.world.clone(),
                ports,
            },
        ));
        let server = match spec.control.listen {
            Some(listen) => Some(ControlServer::start(
                listen,
                spec.control.or_any_port,
                spec.control.token.clone(),
                control.clone(),
            )?),
            None => None,
        };
        Ok(Self {
            clock,
            pool,
            rig,
            inputs,
            nav_out,
            outputs,
            settings,
            triggers,
            timeline,
            stop,
            control,
            server,
            remarks,
        })
    }

    /// Writes what the live navigation sources receive, and the pings, to a new file that `replay --nav` reads. Call before [`Daemon::run`].
    ///
    /// # Errors
    /// The file exists or cannot be created.
    pub fn record_navigation(&mut self, path: &Path) -> Result<(), DaemonError> {
        let first = self.control.sonars().first();
        let recordings = first.map(|sonar| sonar.reports.recordings().clone());
        let spec = &self.rig.spec.nav;
        self.inputs
            .record(path, spec, recordings.unwrap_or_default())
            .map_err(DaemonError::NavRecording)
    }

    /// Address of the operator's page, if one is served.
    pub fn page(&self) -> Option<SocketAddr> {
        Some(self.server.as_ref()?.local_addr())
    }

    /// Handle that pauses, steps and observes the run.
    pub fn control(&self) -> Arc<RunControl> {
        self.control.clone()
    }

    /// Listening addresses and links, one line each.
    pub fn describe(&self) -> Vec<String> {
        let mut lines = self.control.ports().to_vec();
        if let Some(server) = &self.server {
            let address = server.local_addr();
            lines.push(format!("control http {address}"));
            lines.push(format!("page http://{address}/"));
            let asked = self.rig.spec.control.listen.map(|asked| asked.port());
            if let Some(asked) = asked.filter(|&port| port != 0 && port != address.port()) {
                lines.push(format!(
                    "warning: port {asked} is used by another program; page and control are at {address} instead"
                ));
            }
        }
        lines.extend(self.remarks.iter().cloned());
        lines
    }

    /// Pings until `stop` is set or every recorded source has ended. `status` receives the counters as lines of text, every
    /// `run.status_interval_s` and once at the end.
    ///
    /// # Errors
    /// A recorder fails, recorded navigation lacks a required quantity, or a thread cannot start or panics.
    pub fn run(self, mut status: impl FnMut(&str)) -> Result<(), DaemonError> {
        let (rig, control, stop, pool) = (self.rig, self.control, self.stop, self.pool);
        let notify = Notify::from_environment();
        notify.ready();
        let faults = rig.faults.clone();
        let said = rig.spec.run.fault_directory.clone();
        let beside = rig.spec.record.as_ref().map(|r| r.directory.clone());
        let recordings = control
            .sonars()
            .first()
            .map(|s| s.reports.recordings().clone());
        let recordings = recordings.unwrap_or_default();
        let directory = said.clone().or(beside.clone());
        let mut fault_log = EventLog::new("faults", directory, &recordings);
        // With `overload = "skip"`, missing ping numbers in the records already show the skipped pings.
        let beside = beside.filter(|_| rig.spec.run.overload != OverloadSpec::Skip);
        let mut overload_log = EventLog::new("overload", said.or(beside), &recordings);
        let latency_s = rig.spec.run.latency_s;
        let status_interval_ns = (rig.spec.run.status_interval_s * NS_PER_S as f64) as i64;
        let own_time = rig.spec.run.clock.is_own();
        let mut lanes = Vec::new();
        let mut deliveries = Vec::new();
        for (sonar, outputs) in self.outputs.into_iter().enumerate() {
            let context = DeliveryContext {
                sonar: control.sonars()[sonar].name.clone(),
                clock: self.clock.clone(),
                counters: control.sonars()[sonar].counters.clone(),
                histograms: control.sonars()[sonar].histograms.clone(),
                gate: control.gate().clone(),
                priority: rig.spec.run.priority,
            };
            let (lane, threads) = open_lane(&rig, sonar, outputs, context)?;
            lanes.push(lane);
            deliveries.extend(threads);
        }
        let backlog = Arc::new(Backlog::new(self.settings.len()));
        let levels = rig
            .sonars
            .iter()
            .map(|unit| DegradationLevels::new(unit.levels()));
        let pacer = Pacer {
            levels: levels.collect(),
            backlog,
            has_rested: true,
            skipped: vec![false; self.settings.len()],
            unexamined: vec![VecDeque::with_capacity(MAX_ORDERS); self.settings.len()],
            first_ready: None,
            first: None,
            triggers: Some(self.triggers),
            expected: vec![0; self.settings.len()],
            waiting: VecDeque::with_capacity(MAX_ORDERS),
            rig,
            inputs: self.inputs,
            nav_out: self.nav_out,
            settings: self.settings,
            control: control.clone(),
            clock: self.clock,
            machine: SystemClock::new(),
            stop: stop.clone(),
            lanes,
            timeline: self.timeline,
            next_nav_lines: MonoNs(0),
        };
        let pipeline = thread::Builder::new()
            .name("pipeline".into())
            .spawn(move || {
                // The loop runs inside the pool, so that parallel work of a ping starts without a hand-over to the pool's queue.
                pool.install(move || match own_time {
                    true => pacer.run_stepped(),
                    false => pacer.run(),
                })
            })
            .map_err(DaemonError::Thread)?;
        // Status and watchdog use real time, whatever the clock of the rig.
        let machine = SystemClock::new();
        let (mut nav_states, mut is_well) = (NavStates::default(), true);
        tracing::info!(sonars = control.sonars().len(), "pinging");
        let mut next_status = machine.mono().plus_ns(status_interval_ns);
        while !pipeline.is_finished() {
            machine.sleep_until(machine.mono().plus_ns(20_000_000).min(next_status));
            if stop.load(Ordering::Acquire) {
                control.gate().close();
            }
            write_events(&mut fault_log, &mut overload_log, &faults, &control);
            nav_states.report(&control);
            // A stopped recorder does not make the daemon unhealthy, because a restart would not repair it.
            match control.pipeline_problem() {
                None => {
                    notify.alive();
                    is_well = true;
                }
                Some(why) => {
                    if std::mem::replace(&mut is_well, false) {
                        tracing::error!("{why}");
                    }
                }
            }
            if machine.mono() >= next_status {
                let lines = control.lines(latency_s);
                notify.status(lines.first().map_or("", String::as_str));
                status(&lines.join("\n"));
                next_status = next_status.plus_ns(status_interval_ns);
            }
        }
        notify.stopping();
        tracing::info!("pipeline ended");
        let pinged = pipeline.join().map_err(|_| DaemonError::Panic)?;
        let mut closed = Ok(());
        for thread in deliveries {
            let this = thread.join().map_err(|_| DaemonError::Panic)?;
            closed = closed.and(this);
        }
        write_events(&mut fault_log, &mut overload_log, &faults, &control);
        status(&control.lines(latency_s).join("\n"));
        drop(self.server);
        pinged.and(closed.map_err(DaemonError::Output))
    }
}

/// Writes the injected faults, the signs of overload and, among the faults, the pings that were skipped: a device cannot tell them from lost ones.
fn write_events(
    fault_log: &mut EventLog,
    overload_log: &mut EventLog,
    faults: &Faults,
    control: &RunControl,
) {
    fault_log.write(&faults.take_injections(), control.sonars());
    let overloaded = control.overload_states().take();
    if faults.scheduled() > 0 || faults.injected() > 0 {
        let skipped: Vec<_> = overloaded.iter().filter_map(SkippedPing::of).collect();
        fault_log.write(&skipped, control.sonars());
    }
    overload_log.write(&overloaded, control.sonars());
}

/// The states of the navigation sources when they were last reported.
#[derive(Default)]
struct NavStates {
    reported: Vec<NavState>,
}

impl NavStates {
    /// Logs each source whose state differs from the one reported last.
    fn report(&mut self, control: &RunControl) {
        let sources = control.nav_states();
        self.reported.resize(sources.len(), NavState::default());
        for (index, (&state, reported)) in sources.iter().zip(&mut self.reported).enumerate() {
            if state == *reported {
                continue;
            }
            let (source, from, to) = (control.nav_name(index), reported.name(), state.name());
            match state {
                NavState::Ok => tracing::info!(source, from, to, "navigation source recovered"),
                _ => tracing::warn!(source, from, to, "navigation source degraded"),
            }
            *reported = state;
        }
    }
}

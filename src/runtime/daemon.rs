//! The daemon: pings paced in real time on absolute deadlines.
//!
//! ```text
//! pipeline thread                          a delivery thread per sonar        server threads (tokio)
//!   nav in -> orders at t_tx -> compute ->   records -> wait for deadline ->    clients, each with its own queue
//!        ^------------- free slots ------------'
//! ```
//!
//! The life of a ping: ordered at its instant `t_tx` with the settings then in force; computed when the navigation covers its window (or
//! by prediction); delivered at `t_tx + window + latency`. What comes later than that is a deadline miss; what cannot come at all is
//! skipped, with a reason and a counter, and keeps its number.
//!
//! So it is where time is the machine's (`realtime`, `scaled`). In `fast` and `lockstep` the pipeline moves time itself from pulse to pulse
//! (`stepped`): nothing is late there and nothing skipped for it. The samples are the same bits in all.

mod beat;
mod stepped;
mod triggers;

use std::collections::VecDeque;
use std::net::SocketAddr;
use std::ops::Range;
use std::path::PathBuf;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, OnceLock};
use std::thread::{self, JoinHandle};

use self::beat::{Beat, Company, Ordered};
use self::triggers::{Triggers, at_first};
use chrono::DateTime;
use crossbeam_channel::{Receiver, Sender, TrySendError, bounded};
use serde::Serialize;
use thiserror::Error;

use crate::clock::{Clock, PacedClock, SystemClock, VirtualClock};
use crate::control::{RunControl, SonarControl};
use crate::counters::{PingCounters, add, worst};
use crate::faults::nav::NavFaults;
use crate::gate::Gate;
use crate::histograms::Histograms;
use crate::io::control::feed::Feed;
use crate::io::control::{ControlPort, ControlServer, OpenError as ControlOpenError};
use crate::io::nav::NavInputs;
use crate::io::nav::output::{ClockFaults, NavOutputError, NavOutputs};
use crate::io::notify::Notify;
use crate::io::priority;
use crate::io::record::faults::FaultLog;
use crate::io::record::recover::recover_folder;
use crate::io::record::{RecordError, make_folder};
use crate::io::sonar::RigTime;
use crate::io::trigger::ListenerError;
use crate::io::trigger::out::OutError;
use crate::outputs::{OutputError, Outputs, PageOpening};
use crate::overload::{Backlog, DegradationLevels, OverloadRecord};
use crate::page::PageSource;
use crate::rig::OpenError;
use crate::rig::pool_of;
use crate::settings::SettingsStore;
use crate::tiles::tile_ends;
use crate::triggers::TriggerCounts;
use crate::waiting;
use echotank_config::spec::{
    ClockSpec, DeliverySpec, NavInputSpec, NavMode, NavSourceSpec, OverloadSpec, RigSpec, StampSpec,
};
use echotank_core::flow::OverloadState;
use echotank_core::time::{MonoNs, NS_PER_S, Timeline, UtcNs};
use echotank_nav::Coverage;
use echotank_nav::health::State as NavState;
use echotank_ping::PingOrder;
use echotank_ping::rig::{PingSlot, Rig};

/// Longest the pipeline sleeps when it waits for something that no clock announces (a live sample, a free slot).
const POLL_NS: i64 = 2_000_000;
/// With recorded navigation the first ping is due this long after the start: time to open the doors and to compute it.
const FIRST_PING_AFTER_NS: i64 = 500_000_000;

/// How often the navigation's counters and states are written down for whoever prints.
const NAV_LINES_EVERY_NS: i64 = NS_PER_S / 4;
/// Tiles of a sonar's pings that may be on their way at a time.
const TILE_SLOTS: usize = 4;
/// Orders that may wait for their navigation: 50 pings/s over 20 s of latency.
const MAX_ORDERS: usize = 1000;

#[derive(Debug, Error)]
pub enum DaemonError {
    #[error(transparent)]
    Rig(#[from] OpenError),
    #[error(transparent)]
    Output(#[from] OutputError),
    #[error(transparent)]
    NavOutput(#[from] NavOutputError),
    #[error("could not start a thread: {0}")]
    Thread(std::io::Error),
    #[error("could not start the threads that compute pings: {0}")]
    Pool(#[from] rayon::ThreadPoolBuildError),
    #[error("the log of faults: {0}")]
    FaultLog(#[from] RecordError),
    #[error(transparent)]
    Trigger(#[from] ListenerError),
    #[error(transparent)]
    TriggerOut(#[from] OutError),
    #[error("control: {0}")]
    Control(#[from] ControlOpenError),
    #[error(
        "the recorded navigation does not hold what every ping needs: {0}; what a source never sends must not stand in its `provides`"
    )]
    NoNav(String),
    #[error("a thread of the daemon ended in a panic; this is a bug")]
    Panic,
}

/// A ping on its way out.
struct Delivery {
    slot: Box<PingSlot>,
    /// None where time is the pipeline's own: at once.
    due: Option<Due>,
    /// Its samples that stream; those before have left already.
    samples: Range<usize>,
    /// There is more of the ping to come: when these samples have left the slot goes back.
    is_tile: bool,
}

/// When what a ping makes is due.
#[derive(Clone, Copy, Debug)]
struct Due {
    /// The start of its pulse.
    pulse: MonoNs,
    /// The last instant at which it is of use: the first block's where samples stream, else the deadline.
    ready_by: MonoNs,
    /// All that leaves at the end of the ping.
    deadline: MonoNs,
}

/// What of a ping has left before it was whole.
#[derive(Clone, Copy, Default)]
struct Streamed {
    /// The first of them that have not.
    samples: usize,
    /// Whole blocks that have.
    blocks: u32,
    /// Something can be heard in what has.
    is_heard: bool,
    /// When the first tile was made.
    first_ready: Option<MonoNs>,
}

/// How a ping is made where time is the machine's.
#[derive(Clone, Copy)]
struct Paced {
    due: Due,
    /// How loose it is.
    level: usize,
    put_off_s: f64,
    /// Not before then, rehearsed.
    least: MonoNs,
}

/// What a delivery thread works with besides its outputs.
#[derive(Clone)]
struct Way {
    /// The sonar's name.
    sonar: String,
    clock: Arc<dyn Clock>,
    counters: Arc<PingCounters>,
    histograms: Arc<Histograms>,
    gate: Arc<Gate>,
    /// SCHED_FIFO; 0: ordinary.
    priority: u8,
}

/// The pipeline's end of one sonar's way out. Each sonar has its own, with its own thread: a ping that waits for its deadline holds up no
/// other sonar's.
struct Lane {
    free: Receiver<Box<PingSlot>>,
    /// A slot whose ping was skipped.
    spare: Option<Box<PingSlot>>,
    to_delivery: Sender<Delivery>,
    /// For tiles of pings that stream.
    tiles: Receiver<Box<PingSlot>>,
    spare_tile: Option<Box<PingSlot>>,
}

impl Lane {
    fn slot(&mut self) -> Option<Box<PingSlot>> {
        self.spare.take().or_else(|| self.free.try_recv().ok())
    }

    fn tile(&mut self) -> Option<Box<PingSlot>> {
        self.spare_tile
            .take()
            .or_else(|| self.tiles.try_recv().ok())
    }
}

/// A thread that owns outputs, and what became of their recorders.
type OutputThread = JoinHandle<Result<(), OutputError>>;

/// Makes the slots of a sonar and starts its delivery thread, which ends when the lane is dropped.
fn open_lane(
    rig: &Rig,
    sonar: usize,
    outputs: Outputs,
    way: Way,
) -> Result<(Lane, Vec<OutputThread>), DaemonError> {
    let slots = rig.spec.run.queue_pings;
    let (outputs, streams) = outputs.split();
    let (mut to_delivery, deliveries) = bounded::<Delivery>(slots);
    let mut threads = Vec::new();
    let tile_slots = match rig.spec.run.stream_tiles && !streams.is_empty() {
        true => TILE_SLOTS,
        false => 0,
    };
    let (to_tiles, tiles) = bounded::<Box<PingSlot>>(tile_slots);
    for _ in 0..tile_slots {
        let _ = to_tiles.try_send(Box::new(rig.slot(sonar)));
    }
    if !streams.is_empty() {
        // Ahead of the delivery thread, which waits for the end of the ping before.
        let (to_streams, pings) = bounded::<Delivery>(slots + tile_slots);
        let on = std::mem::replace(&mut to_delivery, to_streams);
        let way = way.clone();
        let thread = thread::Builder::new()
            .name(format!("streams {sonar}"))
            .spawn(move || stream(streams, &pings, (&on, &to_tiles), &way))
            .map_err(DaemonError::Thread)?;
        threads.push(thread);
    }
    let (to_free, free) = bounded::<Box<PingSlot>>(slots);
    for _ in 0..slots {
        // Cannot fail: the channel holds exactly this many.
        let _ = to_free.try_send(Box::new(rig.slot(sonar)));
    }
    let thread = thread::Builder::new()
        .name(format!("delivery {sonar}"))
        .spawn(move || deliver(outputs, &deliveries, &to_free, &way))
        .map_err(DaemonError::Thread)?;
    threads.push(thread);
    let lane = Lane {
        free,
        spare: None,
        to_delivery,
        tiles,
        spare_tile: None,
    };
    Ok((lane, threads))
}

/// An order with its sonar and when its ping is due.
#[derive(Clone, Copy, Debug)]
struct Waiting {
    sonar: usize,
    order: PingOrder,
    /// How much later its pulse is than the beat had it.
    put_off_s: f64,
    window_s: f64,
    due: Due,
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
    /// What was mended of earlier records, and how punctual it can be, a line each.
    remarks: Vec<String>,
}

impl Daemon {
    /// Opens the scene, the navigation and the outputs. `stop` ends [`Daemon::run`] when it becomes true.
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
        remarks.push(punctuality(spec.run.priority));
        remarks.extend(preference(spec.run.compute_nice));
        for remark in &remarks {
            match remark.strip_prefix("warning: ") {
                Some(warning) => tracing::warn!("{warning}"),
                None => tracing::debug!("{remark}"),
            }
        }
        let pool = pool_of(threads, spec.run.compute_nice)?;
        let rig = pool.install(|| {
            let mut rig = crate::rig::open(spec)?;
            if spec.run.overload == OverloadSpec::Degrade && !spec.run.clock.is_own() {
                rig.make_looser()?;
            }
            Ok::<_, OpenError>(rig)
        })?;
        let mut inputs = NavInputs::open(&spec.nav, clock.clone()).map_err(OpenError::Nav)?;
        let nav_faults = NavFaults::new(rig.faults.clone(), &spec.nav.sources);
        inputs.spoil_with(Box::new(nav_faults));
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
        let wire_time = wire_time(spec.nav.stamp, &clock, &timeline);
        let nav_out = {
            let faults: Arc<dyn ClockFaults> = rig.faults.clone();
            NavOutputs::open_with(&spec.nav.outputs, &clock, &wire_time, Some(&faults))?
        };
        let feed = Arc::new(Feed::new(spec.sonars.len()));
        let mut outputs = Vec::new();
        let mut histograms = Vec::new();
        for (unit, settings) in rig.sonars.iter().zip(&settings) {
            let own = Arc::new(Histograms::new());
            let page = spec.control.listen.map(|_| PageOpening {
                feed: feed.clone(),
                sonar: outputs.len() as u16,
                world: rig.world.clone(),
            });
            let opened = Outputs::open(&rig.spec, unit, settings, &wire_time, &clock, &own, page)?;
            outputs.push(opened);
            histograms.push(own);
        }
        let trigger_counts: Vec<_> = spec
            .sonars
            .iter()
            .map(|_| Arc::new(TriggerCounts::default()))
            .collect();
        let triggers = Triggers::open(spec, &clock, &gate, &trigger_counts)?;
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
            wire_time,
            PageSource {
                feed,
                spec: spec.clone(),
                world: rig.world.clone(),
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

    /// Where the operator's page is served, if it is.
    pub fn page(&self) -> Option<SocketAddr> {
        Some(self.server.as_ref()?.local_addr())
    }

    /// How it is paused, stepped and told.
    pub fn control(&self) -> Arc<RunControl> {
        self.control.clone()
    }

    /// What it listens to and where to connect, a line each.
    pub fn describe(&self) -> Vec<String> {
        let sources = &self.rig.spec.nav.sources;
        let transport = |name: &str| {
            let tcp = |s: &NavSourceSpec| {
                s.name == name && matches!(s.input, NavInputSpec::TcpListen { .. })
            };
            if sources.iter().any(tcp) {
                "tcp"
            } else {
                "udp"
            }
        };
        let listening = self.inputs.listening();
        let mut lines: Vec<String> = listening
            .iter()
            .map(|(name, address)| format!("nav {name} {} {address}", transport(name)))
            .collect();
        lines.extend(self.nav_out.addresses());
        lines.extend(self.outputs.iter().flat_map(Outputs::addresses));
        lines.extend(self.triggers.addresses(&self.rig.spec));
        if let Some(server) = &self.server {
            let address = server.local_addr();
            lines.push(format!("control http {address}"));
            lines.push(format!("page http://{address}/"));
            let asked = self.rig.spec.control.listen.map(|asked| asked.port());
            if let Some(asked) = asked.filter(|&port| port != 0 && port != address.port()) {
                lines.push(format!(
                    "warning: port {asked} is another program's; page and control are at {address} this time"
                ));
            }
        }
        lines.extend(self.remarks.iter().cloned());
        lines
    }

    /// Pings until `stop`, or until every recorded source has ended. `status` gets the counters, a few lines of text, every
    /// `run.status_interval_s` and once at the end.
    pub fn run(self, mut status: impl FnMut(&str)) -> Result<(), DaemonError> {
        let Self {
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
            remarks: _,
        } = self;
        let notify = Notify::from_environment();
        notify.ready();
        let faults = rig.faults.clone();
        let said = rig.spec.run.fault_directory.clone();
        let beside = rig.spec.record.as_ref().map(|r| r.directory.clone());
        let mut fault_log = EventLog::new("faults", said.clone().or(beside.clone()));
        // A ping that is skipped misses its number in the records themselves.
        let beside = beside.filter(|_| rig.spec.run.overload != OverloadSpec::Skip);
        let mut overload_log = EventLog::new("overload", said.or(beside));
        let latency_s = rig.spec.run.latency_s;
        let status_interval_ns = (rig.spec.run.status_interval_s * NS_PER_S as f64) as i64;
        let own_time = rig.spec.run.clock.is_own();
        let mut lanes = Vec::new();
        let mut deliveries = Vec::new();
        for (sonar, outputs) in outputs.into_iter().enumerate() {
            let way = Way {
                sonar: control.sonars()[sonar].name.clone(),
                clock: clock.clone(),
                counters: control.sonars()[sonar].counters.clone(),
                histograms: control.sonars()[sonar].histograms.clone(),
                gate: control.gate().clone(),
                priority: rig.spec.run.priority,
            };
            let (lane, threads) = open_lane(&rig, sonar, outputs, way)?;
            lanes.push(lane);
            deliveries.extend(threads);
        }
        let backlog = Arc::new(Backlog::new(settings.len()));
        let levels = rig
            .sonars
            .iter()
            .map(|unit| DegradationLevels::new(unit.levels()));
        let pacer = Pacer {
            levels: levels.collect(),
            backlog,
            has_rested: true,
            skipped: vec![false; settings.len()],
            first_ready: None,
            first: None,
            triggers: Some(triggers),
            foreseen: vec![0; settings.len()],
            waiting: VecDeque::with_capacity(MAX_ORDERS),
            rig,
            inputs,
            nav_out,
            settings,
            control: control.clone(),
            clock,
            machine: SystemClock::new(),
            stop: stop.clone(),
            lanes,
            timeline,
            next_nav_lines: MonoNs(0),
        };
        let pipeline = thread::Builder::new()
            .name("pipeline".into())
            .spawn(move || {
                // The loop runs inside the pool, so that a ping's parallel parts never pass through the pool's front door.
                pool.install(move || match own_time {
                    true => pacer.run_stepped(),
                    false => pacer.run(),
                })
            })
            .map_err(DaemonError::Thread)?;
        // Whoever looks lives in the machine's time, whatever the rig's does.
        let machine = SystemClock::new();
        let (mut nav_states, mut is_well) = (NavStates::default(), true);
        tracing::info!(sonars = control.sonars().len(), "pinging");
        let mut next_status = machine.mono().plus_ns(status_interval_ns);
        while !pipeline.is_finished() {
            machine.sleep_until(machine.mono().plus_ns(20_000_000).min(next_status));
            if stop.load(Ordering::Acquire) {
                control.gate().close();
            }
            fault_log.write(&faults.take_injections(), control.sonars());
            overload_log.write(&control.overload_states().take(), control.sonars());
            nav_states.report(&control);
            match control.ailment() {
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
        fault_log.write(&faults.take_injections(), control.sonars());
        overload_log.write(&control.overload_states().take(), control.sonars());
        status(&control.lines(latency_s).join("\n"));
        drop(server);
        pinged.and(closed.map_err(DaemonError::Output))
    }
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

/// A log of what befell single pings, JSON lines; begun with the first of them.
struct EventLog {
    stem: &'static str,
    directory: Option<PathBuf>,
    log: Option<FaultLog>,
}

impl EventLog {
    fn new(stem: &'static str, directory: Option<PathBuf>) -> Self {
        Self {
            stem,
            directory,
            log: None,
        }
    }

    /// Writes what happened since the last time. An error is told once, ends the log, and counts as a recording that stopped.
    fn write<T: Serialize>(&mut self, events: &[T], sonars: &[SonarControl]) {
        for event in events {
            tracing::debug!(log = self.stem, event = %AsJson(event), "ping event");
        }
        if events.is_empty() || self.directory.is_none() {
            return;
        }
        if let Err(error) = self.append(events) {
            tracing::error!(log = self.stem, %error, "event log stopped");
            if let Some(first) = sonars.first() {
                add(&first.counters.recordings_stopped, 1);
            }
            (self.directory, self.log) = (None, None);
        }
    }

    fn append<T: Serialize>(&mut self, events: &[T]) -> Result<(), DaemonError> {
        let Some(directory) = &self.directory else {
            return Ok(());
        };
        let log = match &mut self.log {
            Some(log) => log,
            none => {
                make_folder(directory)?;
                let now = DateTime::from_timestamp_nanos(SystemClock::new().host_utc().0);
                let name = format!("{}-{}.jsonl", self.stem, now.format("%Y%m%dT%H%M%S"));
                none.insert(FaultLog::create(&directory.join(name))?)
            }
        };
        Ok(log.write(events)?)
    }
}

/// Writes a value as JSON.
struct AsJson<'a, T>(&'a T);

impl<T: Serialize> std::fmt::Display for AsJson<'_, T> {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let text = serde_json::to_string(self.0).map_err(|_| std::fmt::Error)?;
        f.write_str(&text)
    }
}

/// Locks memory and tries a priority, and says what came of it.
fn punctuality(priority: u8) -> String {
    if priority == 0 {
        return "ordinary scheduling (run.priority = 0)".to_owned();
    }
    let locked = priority::lock_memory();
    // On a thread of its own: this one stays ordinary.
    let tried = thread::spawn(move || priority::first_in_first_out(priority)).join();
    let real_time = tried.unwrap_or_else(|_| Err(std::io::ErrorKind::Other.into()));
    match (real_time, locked) {
        (Ok(()), Ok(())) => {
            format!("pings are handed over under SCHED_FIFO {priority}, memory is locked")
        }
        (real_time, locked) => {
            let why = |what, result: std::io::Result<()>| {
                result.err().map(|error| format!("{what}: {error}"))
            };
            let why: Vec<_> = [why("SCHED_FIFO", real_time), why("locked memory", locked)]
                .into_iter()
                .flatten()
                .collect();
            format!(
                "warning: pings may be late: {} (echotank doctor says more)",
                why.join("; ")
            )
        }
    }
}

/// Tries the nice value of the threads that compute, where one is asked for, and says what came of it.
fn preference(nice: i8) -> Option<String> {
    if nice == 0 {
        return None;
    }
    // On a thread of its own: this one stays ordinary.
    let tried = thread::spawn(move || priority::nice(nice)).join();
    Some(match tried {
        Ok(Ok(())) => format!("pings are computed at nice {nice}"),
        Ok(Err(error)) => format!(
            "warning: pings are computed like any other program: nice {nice}: {error} (echotank doctor says more)"
        ),
        Err(_) => "warning: pings are computed like any other program".to_owned(),
    })
}

/// The clock of a mode, and the gate that stops it.
fn clock_of(mode: ClockSpec) -> (Arc<dyn Clock>, Arc<Gate>) {
    let rate = match mode {
        ClockSpec::RealTime => 1.0,
        ClockSpec::Scaled(rate) => rate,
        ClockSpec::Fast | ClockSpec::Lockstep => {
            let now = SystemClock::new().host_utc();
            let gate = Gate::new(None, mode == ClockSpec::Lockstep);
            return (Arc::new(VirtualClock::starting_at(now)), Arc::new(gate));
        }
    };
    let clock = Arc::new(PacedClock::at_rate(rate));
    (clock.clone(), Arc::new(Gate::new(Some(clock), false)))
}

/// What answers are stamped with: the same clock as the pings.
fn wire_time(
    stamp: StampSpec,
    clock: &Arc<dyn Clock>,
    timeline: &Arc<OnceLock<Timeline>>,
) -> RigTime {
    let (clock, timeline) = (clock.clone(), timeline.clone());
    Arc::new(move || match (stamp, timeline.get()) {
        (StampSpec::Log, Some(timeline)) => timeline.utc(clock.mono()),
        _ => clock.host_utc(),
    })
}

/// Turns the passing of time into orders, and orders into pings.
struct Pacer {
    rig: Rig,
    /// What pings cost and how loose they are, one per sonar.
    levels: Vec<DegradationLevels>,
    /// What the beat is told of that.
    backlog: Arc<Backlog>,
    /// It has had nothing to do since the last ping: no ping before it is to blame for what is late now.
    has_rested: bool,
    /// Of each sonar: its last ping was skipped before its time.
    skipped: Vec<bool>,
    /// Of a ping that was made tile by tile: when the first was.
    first_ready: Option<MonoNs>,
    inputs: NavInputs,
    nav_out: NavOutputs,
    settings: Vec<Arc<SettingsStore>>,
    /// Versions of the settings that the pipelines have been told of.
    foreseen: Vec<u64>,
    control: Arc<RunControl>,
    clock: Arc<dyn Clock>,
    /// Tells how long computing took.
    machine: SystemClock,
    stop: Arc<AtomicBool>,
    /// Of the first ping, once it is known.
    first: Option<UtcNs>,
    /// Until the beat has them.
    triggers: Option<Triggers>,
    /// In order of `t_tx`.
    waiting: VecDeque<Waiting>,
    /// One per sonar.
    lanes: Vec<Lane>,
    /// Read by whoever stamps answers.
    timeline: Arc<OnceLock<Timeline>>,
    /// When the navigation's counters are next renewed for whoever looks, in the machine's time.
    next_nav_lines: MonoNs,
}

/// What became of the order at the front.
enum Step {
    /// It was made or skipped.
    Done,
    /// Something must come first; look again at this instant at the latest.
    Wait(MonoNs),
}

impl Pacer {
    fn run(mut self) -> Result<(), DaemonError> {
        let Some(timeline) = self.start()? else {
            return Ok(());
        };
        // Set once, here; whoever asked before got the host's time.
        let timeline = *self.timeline.get_or_init(|| timeline);
        self.inputs.set_timeline(timeline);
        let Some(beat) = self.beat(timeline) else {
            return Ok(());
        };
        let (sender, orders) = bounded(MAX_ORDERS);
        let coming = beat.coming();
        let priority = self.rig.spec.run.priority;
        let _beat = match beat.start(sender, priority) {
            Ok(thread) => thread,
            Err(why) => {
                tracing::error!(error = %why, "could not start the thread that orders pings");
                self.stop.store(true, Ordering::Release);
                return Ok(());
            }
        };
        while !self.stop.load(Ordering::Acquire) {
            let now = self.clock.mono();
            let utc = timeline.utc(now);
            // Read first: an order that is not among those taken now is not before it.
            let next = coming.next();
            self.take_orders(&orders, &timeline);
            let known = self.known_until(utc, next);
            self.inputs.pull(known, &mut self.rig.history);
            self.renew_nav_lines();
            self.nav_out.publish(&mut self.rig.history, now, utc);
            self.estimate_cost();
            let wait_until = match self.waiting.front().copied() {
                Some(front) => match self.step(&front, now, &timeline) {
                    Step::Done => {
                        self.waiting.pop_front();
                        self.backlog.done(front.sonar);
                        continue;
                    }
                    Step::Wait(until) => until,
                },
                None if self.inputs.finished() => return Ok(()),
                None => now.plus_ns(50 * POLL_NS),
            };
            let wait_until = wait_until.min(self.nav_out.next_publish());
            self.has_rested = true;
            self.clock.wait_until(wait_until, &coming.wake_up);
        }
        Ok(())
    }

    /// How long before its pulse a ping is ordered and computed.
    fn ahead_ns(&self) -> i64 {
        self.rig.spec.run.ahead_ns()
    }

    /// How far recorded navigation may be read: what was not known yet when a ping had to be foreseen must not be known to it, however late it
    /// is computed. `next`: the next pulse that may still be ordered.
    fn known_until(&self, utc: UtcNs, next: UtcNs) -> UtcNs {
        if self.rig.spec.nav.mode == NavMode::Settle {
            return utc;
        }
        let ordered = self.waiting.iter().map(|w| w.order.transmit_utc);
        let first = ordered.chain([next]).min();
        first.map_or(utc, |at| utc.min(at.plus_ns(-self.ahead_ns())))
    }

    /// When the recorded logs first hold what a ping needs of them (the rest is live); none where the daemon is stopped.
    fn first_recorded(&mut self) -> Result<Option<UtcNs>, DaemonError> {
        let sources = self.rig.spec.nav.sources.clone();
        let is_live = |channel| {
            let gives = |s: &NavSourceSpec| s.provides.contains(&channel) && !s.is_recorded();
            sources.iter().any(gives)
        };
        if self.rig.history.silent().into_iter().all(is_live) {
            return Ok(self.inputs.recorded_start());
        }
        loop {
            let history = &self.rig.history;
            if let Some(first) = history.first_usable_utc_of(|channel| !is_live(channel)) {
                return Ok(Some(first));
            }
            if self.stop.load(Ordering::Acquire) {
                return Ok(None);
            }
            if self.inputs.is_all_known() {
                let lacking = waiting::lacking(&self.rig.spec.nav, history);
                return Err(DaemonError::NoNav(lacking));
            }
            self.inputs.pull_next(&mut self.rig.history);
        }
    }

    fn begin_schedules(&mut self, first: UtcNs) -> UtcNs {
        // Known for long enough to foresee it.
        let first = first.plus_ns(self.ahead_ns());
        self.first = Some(first);
        self.rig.faults.begin(first);
        first
    }

    /// To be asked once, after [`Self::begin_schedules`].
    fn beat(&mut self, timeline: Timeline) -> Option<Beat> {
        let company = Company {
            settings: self.settings.clone(),
            control: self.control.clone(),
            faults: self.rig.faults.clone(),
            clock: self.clock.clone(),
            backlog: self.backlog.clone(),
        };
        let triggers = self.triggers.take()?;
        let spec = &self.rig.spec;
        Some(Beat::new(spec, self.first?, timeline, company, triggers))
    }

    /// Waits for the first navigation and lays rig time over the clock. None: stopped before there was any.
    fn start(&mut self) -> Result<Option<Timeline>, DaemonError> {
        if self.inputs.recorded_start().is_some() {
            // A recorded log: as though the daemon had been listening for as long as a ping takes to be delivered, so that the first one
            // leaves at once.
            let Some(first) = self.first_recorded()? else {
                return Ok(None);
            };
            let first = self.begin_schedules(first);
            crate::rig::plan_all(&mut self.rig, &mut self.inputs, first);
            if let DeliverySpec::Streaming { .. } = self.rig.spec.run.delivery {
                // Nothing of it may leave before its pulse, which is foreseen before that.
                let ordered = self.clock.mono().plus_ns(FIRST_PING_AFTER_NS);
                let first = first.plus_ns(-self.ahead_ns());
                return Ok(Some(Timeline::through(ordered, first)));
            }
            let latency_ns = (self.rig.spec.run.latency_s * NS_PER_S as f64) as i64;
            let sound_speed_m_per_s = self.rig.medium().sound_speed_m_per_s;
            let units = self.rig.sonars.iter();
            let window_s = units
                .map(|unit| echotank_ping::window_s(&unit.spec.settings, sound_speed_m_per_s))
                .fold(0.0, f64::max);
            let window_ns = (window_s * NS_PER_S as f64) as i64;
            return Ok(Some(Timeline::through(
                self.clock.mono().plus_ns(FIRST_PING_AFTER_NS),
                first.plus_ns(window_ns + latency_ns),
            )));
        }
        while !self.stop.load(Ordering::Acquire) {
            let now = self.clock.mono();
            let rig_time = self.inputs.timeline();
            let utc = rig_time.map_or(UtcNs(i64::MAX), |timeline| timeline.utc(now));
            self.inputs.pull(utc, &mut self.rig.history);
            if let (Some(timeline), Some(first)) =
                (self.inputs.timeline(), self.rig.history.first_usable_utc())
            {
                self.begin_schedules(first.max(timeline.utc(now)));
                self.next_nav_lines = MonoNs(0);
                return Ok(Some(timeline));
            }
            self.renew_nav_lines_with(|pacer| {
                let reason =
                    waiting::reason(&pacer.rig.spec.nav, &mut pacer.inputs, &pacer.rig.history);
                vec![reason]
            });
            self.clock.sleep_until(now.plus_ns(POLL_NS));
        }
        Ok(None)
    }

    fn renew_nav_lines(&mut self) {
        self.renew_nav_lines_with(|_| Vec::new());
    }

    fn renew_nav_lines_with(&mut self, first: impl FnOnce(&mut Self) -> Vec<String>) {
        self.control.beat();
        let now = self.machine.mono();
        if now >= self.next_nav_lines {
            self.next_nav_lines = now.plus_ns(NAV_LINES_EVERY_NS);
            let lines = [first(self), self.inputs.lines(), self.nav_out.lines()].concat();
            self.control.set_nav(lines, self.inputs.sources());
        }
    }

    /// Tells the pipelines of settings that a topside has changed: what they need is made before the first ping that obeys them.
    fn estimate_cost(&mut self) {
        for (sonar, settings) in self.settings.iter().enumerate() {
            if settings.version() != self.foreseen[sonar] {
                let (settings, version) = settings.snapshot();
                self.rig.sonars[sonar].expect(&settings);
                self.foreseen[sonar] = version;
            }
        }
    }

    /// Puts down every ping whose instant has come.
    fn take_orders(&mut self, orders: &Receiver<Ordered>, timeline: &Timeline) {
        let ended = match self.inputs.finished() {
            true => self.inputs.recorded_end(),
            false => None,
        };
        for ordered in orders.try_iter() {
            let Ordered {
                sonar,
                order,
                put_off_s,
            } = ordered;
            // A log that has ended makes no more pings; the beat may have gone on a little.
            if ended.is_some_and(|end| order.transmit_utc >= end) {
                self.backlog.done(sonar);
                continue;
            }
            if self.waiting.len() >= MAX_ORDERS {
                self.backlog.done(sonar);
                add(&self.counters(sonar).skipped_queue, 1);
                continue;
            }
            let window_s = self.rig.window_s(sonar, &order);
            let run = &self.rig.spec.run;
            let due = Due {
                pulse: timeline.mono(order.transmit_utc),
                ready_by: timeline.mono(order.transmit_utc.plus_s(run.ready_after_s(window_s))),
                deadline: timeline.mono(order.transmit_utc.plus_s(window_s + run.latency_s)),
            };
            let place = self
                .waiting
                .partition_point(|w| w.order.transmit_utc <= order.transmit_utc);
            self.waiting.insert(
                place,
                Waiting {
                    sonar,
                    order,
                    put_off_s,
                    window_s,
                    due,
                },
            );
        }
    }

    fn step(&mut self, front: &Waiting, now: MonoNs, timeline: &Timeline) -> Step {
        let Waiting {
            sonar,
            order,
            window_s,
            due,
            put_off_s,
        } = *front;
        let deadline = due.ready_by;
        let mode = self.rig.spec.nav.mode;
        let covered = match mode {
            NavMode::Predict => true,
            NavMode::Settle => {
                matches!(
                    self.rig
                        .history
                        .coverage(order.transmit_utc, order.transmit_utc.plus_s(window_s)),
                    Coverage::Ready
                )
            }
        };
        if now >= deadline {
            if covered {
                add(&self.counters(sonar).skipped_late, 1);
                self.overloaded("skipped", sonar, &order);
            } else {
                add(&self.counters(sonar).skipped_nav, 1);
            }
            return Step::Done;
        }
        if !covered {
            return Step::Wait(now.plus_ns(POLL_NS).min(deadline));
        }
        let Some(slot) = self.lanes[sonar].slot() else {
            return Step::Wait(now.plus_ns(POLL_NS).min(deadline));
        };
        // Never two in a row: with several sonars each would find the pipeline busy with another's, and one of them be skipped for ever.
        let waited = !self.has_rested && !std::mem::take(&mut self.skipped[sonar]);
        let Some(level) = self.levels[sonar].choose(deadline.0 - now.0, waited) else {
            add(&self.counters(sonar).skipped_late, 1);
            self.overloaded("skipped", sonar, &order);
            self.skipped[sonar] = true;
            self.lanes[sonar].spare = Some(slot);
            return Step::Done;
        };
        self.has_rested = false;
        self.backlog.begun(now.0);
        let simulated_s = self.rig.spec.run.simulated_compute_s * 0.5_f64.powi(level as i32);
        let paced = Paced {
            due,
            level,
            put_off_s,
            least: now.plus_s(simulated_s),
        };
        self.compute(sonar, &order, Some(paced), slot, timeline);
        let whole = self.clock.mono();
        let ready = self.first_ready.take().unwrap_or(whole);
        let levels = &mut self.levels[sonar];
        levels.note(ready.0 - now.0, ready <= deadline);
        self.backlog.costs(sonar, levels.now_ns());
        Step::Done
    }

    /// When the block that begins with a sample leaves.
    fn block_due(&self, sonar: usize, due: Due, sample: usize) -> MonoNs {
        let rate_hz = self.rig.sonars[sonar].spec.receiver.sample_rate_hz;
        due.ready_by.plus_s(sample as f64 / rate_hz)
    }

    /// Makes tiles of a ping and lets them leave, as long as they are in time and there is room: those in which nothing can be heard (`quiet`), of a
    /// ping that is planned; the others of one that is prepared.
    fn send_tiles(
        &mut self,
        sonar: usize,
        slot: &mut PingSlot,
        due: Due,
        quiet: bool,
        streamed: &mut Streamed,
    ) {
        let DeliverySpec::Streaming { block_s, .. } = self.rig.spec.run.delivery else {
            return;
        };
        let rate_hz = self.rig.sonars[sonar].spec.receiver.sample_rate_hz;
        let samples = slot.plan.sample_count;
        for (blocks, end) in tile_ends(streamed.blocks, samples, rate_hz, block_s) {
            let Some(mut tile) = self.lanes[sonar].tile() else {
                return;
            };
            let made = match quiet {
                true => self.rig.begin_quiet(sonar, slot, end, &mut tile),
                false => {
                    let is_first = !std::mem::replace(&mut streamed.is_heard, true);
                    self.rig.begin(sonar, slot, (end, is_first), &mut tile)
                }
            };
            let now = self.clock.mono();
            if !made || now > self.block_due(sonar, due, streamed.samples) {
                self.lanes[sonar].spare_tile = Some(tile);
                return;
            }
            streamed.first_ready.get_or_insert(now);
            let delivery = Delivery {
                slot: tile,
                due: Some(due),
                samples: streamed.samples..end,
                is_tile: true,
            };
            // The queue has room for every slot there is.
            let _ = self.lanes[sonar].to_delivery.try_send(delivery);
            (streamed.samples, streamed.blocks) = (end, blocks);
        }
    }

    fn overloaded(&self, what: &'static str, sonar: usize, order: &PingOrder) {
        self.overloaded_as(what, sonar, order, OverloadState::NONE);
    }

    fn overloaded_as(
        &self,
        what: &'static str,
        sonar: usize,
        order: &PingOrder,
        overload_state: OverloadState,
    ) {
        let put_off = Some(overload_state.put_off_s).filter(|put_off_s| *put_off_s > 0.0);
        self.control.overload_states().note(OverloadRecord {
            what,
            sonar: self.control.sonars()[sonar].name.clone(),
            ping_number: order.ping_number,
            utc_ns: order.transmit_utc.0,
            tolerance: overload_state.tolerance,
            put_off_ms: put_off.map(|put_off_s| put_off_s * 1e3),
        });
    }

    fn counters(&self, sonar: usize) -> &PingCounters {
        &self.control.sonars()[sonar].counters
    }

    /// Makes a ping and hands it on; false where the navigation lacked something, which is counted.
    fn compute(
        &mut self,
        sonar: usize,
        order: &PingOrder,
        paced: Option<Paced>,
        mut slot: Box<PingSlot>,
        timeline: &Timeline,
    ) -> bool {
        let due = paced.map(|paced| paced.due);
        let level = paced.map_or(0, |paced| paced.level);
        let began = self.machine.mono();
        let mode = self.rig.spec.nav.mode;
        let host_now = self.clock.host_utc();
        let host_utc = host_now.plus_ns(timeline.mono(order.transmit_utc).0 - self.clock.mono().0);
        let mut streamed = Streamed::default();
        let made = match due.filter(|_| self.rig.spec.run.stream_tiles) {
            Some(due) => {
                let planned = echotank_ping::make_ping::motion(
                    &mut self.rig,
                    sonar,
                    order,
                    mode,
                    host_utc,
                    &mut slot,
                );
                planned.map(|()| {
                    self.send_tiles(sonar, &mut slot, due, true, &mut streamed);
                    echotank_ping::make_ping::gather(&mut self.rig, sonar, &mut slot);
                    self.send_tiles(sonar, &mut slot, due, false, &mut streamed);
                    self.first_ready = streamed.first_ready;
                    echotank_ping::finish_ping(&mut self.rig, sonar, &mut slot);
                    slot.output.overload_state = OverloadState::NONE;
                })
            }
            None => echotank_ping::make_degraded_ping(
                &mut self.rig,
                level,
                sonar,
                order,
                mode,
                host_utc,
                &mut slot,
            ),
        };
        if let Some(paced) = paced {
            self.clock.sleep_until(paced.least);
        }
        let SonarControl {
            counters,
            histograms,
            ..
        } = &self.control.sonars()[sonar];
        if made.is_err() {
            add(&counters.skipped_nav, 1);
            self.lanes[sonar].spare = Some(slot);
            return false;
        }
        if let Some(put_off_s) = paced.map(|paced| paced.put_off_s).filter(|s| *s > 0.0) {
            slot.output.overload_state.put_off_s = put_off_s;
            // The rate actually kept.
            slot.plan.ping_rate_hz = 1.0 / (1.0 / slot.plan.ping_rate_hz + put_off_s);
        }
        let is_stream = self.rig.spec.run.delivery != DeliverySpec::PingEnd;
        let total = slot.plan.sample_count;
        let mut samples = streamed.samples..total;
        if let Some(due) = due.filter(|_| streamed.samples > 0) {
            // What has begun to leave goes on in time or not at all.
            if self.clock.mono() > self.block_due(sonar, due, streamed.samples) {
                samples = total..total;
                add(&counters.truncated, 1);
                self.overloaded("truncated", sonar, order);
            }
        } else if is_stream && due.is_some_and(|due| self.clock.mono() > due.ready_by) {
            // Its first samples cannot leave in time: none do, or the latency would not be constant.
            add(&counters.skipped_late, 1);
            self.overloaded("skipped", sonar, order);
            self.lanes[sonar].spare = Some(slot);
            return false;
        }
        let overload_state = slot.output.overload_state;
        if overload_state.tolerance.is_some() {
            self.overloaded_as("degraded", sonar, order, overload_state);
        }
        if overload_state.put_off_s > 0.0 {
            self.overloaded_as("stretched", sonar, order, overload_state);
        }
        let first_ready = streamed.first_ready.unwrap_or_else(|| self.clock.mono());
        if due.is_some_and(|due| first_ready > due.ready_by) {
            self.overloaded_as("late", sonar, order, overload_state);
        }
        let output = &slot.output;
        let saturated = output.elements.iter().map(|frame| frame.saturated).sum();
        let took_us = (self.machine.mono().0 - began.0).max(0) as u64 / 1000;
        counters.ping(&output.counts, saturated, took_us);
        counters.scene(&output.scene);
        counters.error_check(output.error_check.as_ref());
        counters.overload_state(level, &output.overload_state);
        if let Some(planner) = &self.rig.sonars[sonar].planner {
            counters.plan(output.methods.as_ref(), &planner.counts);
        }
        counters.nav(&slot.plan.nav);
        if let Some(due) = due {
            histograms.margin_us(due.ready_by.0 - first_ready.0);
            histograms.nav_to_samples_us(first_ready.0 - due.pulse.0);
        }
        // The queue holds as many as there are slots, so it is never full; a delivery thread that is gone ends the daemon.
        if let Err(TrySendError::Disconnected(_)) =
            self.lanes[sonar].to_delivery.try_send(Delivery {
                slot,
                due,
                samples,
                is_tile: false,
            })
        {
            self.stop.store(true, Ordering::Release);
        }
        true
    }
}

/// Lets the samples of each ping leave as they would be heard, and hands it on at once; a tile goes back.
fn stream(
    mut outputs: Outputs,
    pings: &Receiver<Delivery>,
    (on, back): (&Sender<Delivery>, &Sender<Box<PingSlot>>),
    way: &Way,
) -> Result<(), OutputError> {
    if way.priority > 0 {
        // What is not allowed was said when the daemon started.
        let _ = priority::first_in_first_out(way.priority);
    }
    for ping in pings {
        let pulse = ping.due.map(|due| due.pulse);
        outputs.stream(&ping.slot, ping.samples.clone(), pulse);
        if ping.is_tile {
            // Its place in the channel is free: it came from there.
            let _ = back.try_send(ping.slot);
            continue;
        }
        // It holds as many as there are slots. Nobody there: the daemon ends.
        if on.send(ping).is_err() {
            break;
        }
    }
    outputs.close()
}

/// Encodes each ping while it waits, and hands its records over at the deadline.
fn deliver(
    mut outputs: Outputs,
    deliveries: &Receiver<Delivery>,
    free: &Sender<Box<PingSlot>>,
    way: &Way,
) -> Result<(), OutputError> {
    if way.priority > 0 {
        // What is not allowed was said when the daemon started.
        let _ = priority::first_in_first_out(way.priority);
    }
    let mut first_error = None;
    for Delivery { slot, due, .. } in deliveries {
        let deadline = due.map(|due| due.deadline);
        outputs.encode(&slot);
        // Its place in the channel is free: it came from there.
        let _ = free.try_send(slot);
        if let Some(deadline) = deadline {
            way.clock.sleep_until(deadline);
            let late_us = (way.clock.mono().0 - deadline.0).max(0) as u64 / 1000;
            way.histograms.start_error_us(late_us);
            worst(&way.counters.worst_late_us, late_us);
            way.counters.drift_us.store(late_us, Ordering::Relaxed);
            if late_us > DEADLINE_TOLERANCE_US {
                add(&way.counters.deadline_misses, 1);
            }
        }
        // A recorder that fails (a full disk) is reported once; the topsides go on.
        outputs.deliver(|error| {
            tracing::error!(sonar = way.sonar, %error, "recorder stopped");
            add(&way.counters.recordings_stopped, 1);
            first_error.get_or_insert(error);
        });
        if let Some(deadline) = deadline {
            way.histograms
                .handed_over_us(way.clock.mono().0 - deadline.0);
        }
        way.gate.delivered();
    }
    outputs.close()?;
    first_error.map_or(Ok(()), Err)
}

/// Later than this is a miss, microseconds: what an ordinary kernel's timers may be late under load (p99 measured 3.2 ms) without
/// anything being wrong with the ping.
const DEADLINE_TOLERANCE_US: u64 = 5_000;

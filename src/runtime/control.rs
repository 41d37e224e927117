//! Control of a running daemon, behind the HTTP routes and `echotank ctl`: commands and state.

use std::collections::VecDeque;
use std::sync::atomic::{AtomicI64, AtomicU64, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use serde_json::{Value, json};

use crate::clock::{Clock, SystemClock};
use crate::counters::PingCounters;
use crate::gate::Gate;
use crate::histograms::Histograms;
use crate::io::control::feed::Feed;
use crate::io::control::socket::ReliefTile;
use crate::io::control::{Answer, Bytes, ClockMode, Command, ControlPort};
use crate::io::nav::SourceCounters;
use crate::io::sonar::RigTime;
use crate::metrics::{self, Family, Kind};
use crate::outputs::OutputReports;
use crate::overload::OverloadLog;
use crate::page::{PageSource, ReliefCache, changes, nav_source, settings_json, trigger_name};
use crate::settings::SettingsStore;
use crate::triggers::TriggerCounts;
use echotank_config::spec::{ClockSpec, NavChannel};
use echotank_core::settings::{ChangeOrigin, Requester, SettingChange, SettingsPort};
use echotank_core::sound_speed::SoundSpeedProfile;
use echotank_core::time::{MonoNs, UtcNs};
use echotank_nav::health::State;
use echotank_ping::faults::Faults;

/// Maximum number of steps per command, which guards against typing errors.
const MAX_STEPS: u64 = 1_000_000;

/// Index of the active source, by quantity.
pub(crate) type NavOwners = [Option<u16>; NavChannel::ALL.len()];

/// Time without an iteration after which the pipeline counts as stuck, s; no ping takes as long.
const MAX_ITERATION_S: f64 = 15.0;

/// Limits of `run.clock_rate`, as in the configuration.
const CLOCK_RATES: std::ops::RangeInclusive<f64> = 0.1..=1000.0;

/// Number of commands other than settings kept for the page.
const MAX_RECENT_COMMANDS: usize = 64;

/// Number of profiles kept for pings that are ordered late.
const MAX_PROFILES: usize = 8;

/// Control and state of one sonar.
pub struct SonarControl {
    /// Name in the configuration.
    pub name: String,
    /// Current settings.
    pub settings: Arc<SettingsStore>,
    /// Counters of its pings.
    pub counters: Arc<PingCounters>,
    /// Counters of its triggers.
    pub triggers: Arc<TriggerCounts>,
    /// Histograms of its timing.
    pub histograms: Arc<Histograms>,
    /// Counters of its outputs.
    pub reports: OutputReports,
}

impl SonarControl {
    /// Metric name, help text and value of each counter.
    fn all_counters(&self) -> impl Iterator<Item = (&'static str, &'static str, u64)> + '_ {
        self.counters.all().chain(self.triggers.all())
    }
}

/// Control and state of the daemon.
pub struct RunControl {
    clock: Mutex<ClockSpec>,
    gate: Arc<Gate>,
    /// Whether all navigation is recorded.
    recorded: bool,
    sonars: Vec<SonarControl>,
    faults: Arc<Faults>,
    rig_time: RigTime,
    overload_states: OverloadLog,
    /// Status lines of the navigation, renewed by the pipeline.
    nav_lines: Mutex<Vec<String>>,
    nav_sources: Mutex<Vec<(State, SourceCounters)>>,
    nav_owners: Mutex<NavOwners>,
    page: PageSource,
    relief: ReliefCache,
    /// Sound-speed profiles set by commands, with their instants, the newest last.
    profiles: Mutex<VecDeque<(MonoNs, Arc<SoundSpeedProfile>)>>,
    /// Commands other than settings, the newest last.
    recent_commands: Mutex<VecDeque<Value>>,
    commands_done: AtomicU64,
    /// Start of the daemon, machine UTC; it identifies the run.
    opened: UtcNs,
    machine: SystemClock,
    /// Time of the pipeline's last iteration, on `machine`.
    last_iteration_ns: AtomicI64,
}

impl RunControl {
    /// Creates the control of a daemon that is being opened.
    pub fn new(
        clock: ClockSpec,
        gate: Arc<Gate>,
        recorded: bool,
        sonars: Vec<SonarControl>,
        faults: Arc<Faults>,
        rig_time: RigTime,
        page: PageSource,
    ) -> Self {
        let machine = SystemClock::new();
        Self {
            clock: Mutex::new(clock),
            gate,
            recorded,
            sonars,
            faults,
            rig_time,
            overload_states: OverloadLog::default(),
            nav_lines: Mutex::default(),
            nav_sources: Mutex::default(),
            nav_owners: Mutex::default(),
            page,
            relief: ReliefCache::default(),
            profiles: Mutex::default(),
            recent_commands: Mutex::default(),
            commands_done: AtomicU64::new(0),
            opened: machine.host_utc(),
            machine,
            last_iteration_ns: AtomicI64::new(0),
        }
    }

    /// Events of overload, for the log.
    pub(crate) fn overload_states(&self) -> &OverloadLog {
        &self.overload_states
    }

    /// The sonars, in the configuration's order.
    pub fn sonars(&self) -> &[SonarControl] {
        &self.sonars
    }

    /// Addresses of the rig, one line each.
    pub(crate) fn ports(&self) -> &[String] {
        &self.page.ports
    }

    /// The gate that pauses and steps rig time.
    pub fn gate(&self) -> &Arc<Gate> {
        &self.gate
    }

    /// Records an iteration of the pipeline.
    pub fn note_iteration(&self) {
        self.last_iteration_ns
            .store(self.machine.mono().0, Ordering::Relaxed);
    }

    /// Sets the status of the navigation. `owners` is the index of the active source, by quantity.
    pub(crate) fn set_nav(
        &self,
        lines: Vec<String>,
        sources: Vec<(State, SourceCounters)>,
        owners: NavOwners,
    ) {
        *lock(&self.nav_lines) = lines;
        *lock(&self.nav_sources) = sources;
        *lock(&self.nav_owners) = owners;
    }

    /// Name of the active source, by quantity.
    fn nav_owners(&self) -> Value {
        let owners = *lock(&self.nav_owners);
        let all = NavChannel::ALL.into_iter().zip(owners);
        let named = all.filter_map(|(channel, owner)| {
            let name = self.nav_name(usize::from(owner?))?;
            Some((channel.name().to_owned(), Value::from(name)))
        });
        Value::Object(named.collect())
    }

    /// Reason to restart the daemon; `None` while the pipeline advances.
    pub(crate) fn pipeline_problem(&self) -> Option<String> {
        let last = MonoNs(self.last_iteration_ns.load(Ordering::Relaxed));
        let silent_s = self.machine.mono().seconds_since(last);
        // A paused pipeline is not stuck.
        (silent_s > MAX_ITERATION_S && !self.gate.is_paused())
            .then(|| format!("the pipeline has not advanced for {silent_s:.0} s"))
    }

    /// States of the navigation sources, in the configuration's order.
    pub(crate) fn nav_states(&self) -> Vec<State> {
        let sources = lock(&self.nav_sources);
        sources.iter().map(|(state, _)| *state).collect()
    }

    /// Name of a navigation source.
    pub(crate) fn nav_name(&self, index: usize) -> Option<&str> {
        let source = self.page.spec.nav.sources.get(index)?;
        Some(&source.name)
    }

    fn nav_lines(&self) -> Vec<String> {
        lock(&self.nav_lines).clone()
    }

    /// Status lines of all counters.
    pub fn lines(&self, latency_s: f64) -> Vec<String> {
        let mut lines = Vec::new();
        for sonar in &self.sonars {
            lines.push(format!("sonar {}: {}", sonar.name, sonar.counters));
            lines.extend(sonar.counters.advice(latency_s));
            lines.extend(sonar.triggers.line(&sonar.name));
        }
        lines.extend(self.nav_lines());
        lines.extend(self.sonars.iter().flat_map(|sonar| sonar.reports.lines()));
        lines
    }

    /// Sonar with this name, or the only sonar if no name is given.
    fn sonar(&self, name: Option<&str>) -> Result<&SonarControl, String> {
        let names = || {
            let names: Vec<_> = self.sonars.iter().map(|s| s.name.as_str()).collect();
            names.join(", ")
        };
        match (name, self.sonars.as_slice()) {
            (None, [only]) => Ok(only),
            (None, _) => Err(format!("`sonar` must be one of {}", names())),
            (Some(name), all) => all
                .iter()
                .find(|sonar| sonar.name == name)
                .ok_or_else(|| format!("no sonar is named {name}; known are {}", names())),
        }
    }

    fn answer(&self, command: &Command, by: Requester) -> Result<Value, String> {
        let state = || json!({ "paused": self.gate.is_paused(), "pings_delivered": self.gate.pings_delivered() });
        match command {
            Command::Pause => {
                self.refuse_without_own_nav()?;
                self.gate.pause();
                Ok(state())
            }
            Command::Resume if *lock(&self.clock) == ClockSpec::Lockstep => Err(
                "run.clock = \"lockstep\": rig time advances by steps; send \"step\"".to_owned(),
            ),
            Command::Resume => {
                self.gate.resume();
                Ok(state())
            }
            Command::Step { pings } => {
                self.refuse_without_own_nav()?;
                if !(1..=MAX_STEPS).contains(pings) {
                    return Err(format!("pings = {pings}: must be from 1 to {MAX_STEPS}"));
                }
                let before = self.gate.pings_delivered();
                self.gate.step(*pings);
                Ok(json!({ "paused": true, "pings_delivered": before }))
            }
            Command::Set(wanted) => {
                let sonar = self.sonar(wanted.sonar.as_deref())?;
                let changes = wanted.changes();
                if changes.is_empty() {
                    return Err("the command names no setting".to_owned());
                }
                self.set(sonar, &changes, by)
            }
            Command::Trigger { sonar, pings } => {
                let sonar = self.sonar(sonar.as_deref())?;
                if !(1..=MAX_STEPS).contains(pings) {
                    return Err(format!("pings = {pings}: must be from 1 to {MAX_STEPS}"));
                }
                self.set(sonar, &[SettingChange::PingTimes(*pings as u32)], by)
            }
            Command::Fault(request) => {
                let id = self
                    .faults
                    .add(request)
                    .map_err(|refused| refused.to_string())?;
                Ok(json!({ "fault": id, "scheduled": self.faults.scheduled() }))
            }
            Command::ClearFaults { fault: None } => {
                let cleared = self.faults.clear();
                Ok(json!({ "cleared": cleared, "scheduled": self.faults.scheduled() }))
            }
            Command::ClearFaults { fault: Some(id) } => match self.faults.remove(*id) {
                true => Ok(json!({ "cleared": 1, "scheduled": self.faults.scheduled() })),
                false => Err(format!("fault = {id}: no such fault")),
            },
            Command::Record { sonar, on } => self.record(sonar.as_deref(), *on),
            Command::Profile { points } => self.set_profile(points),
            Command::Clock { mode, rate } => self.set_clock(*mode, *rate),
        }
    }

    /// Stops or starts the recordings of one sonar, or of all.
    fn record(&self, sonar: Option<&str>, on: bool) -> Result<Value, String> {
        if self.page.spec.record.is_none() {
            return Err(
                "the configuration names no folder of recordings: set record.directory and restart the daemon"
                    .to_owned(),
            );
        }
        let wanted: Vec<_> = match sonar {
            Some(name) => vec![self.sonar(Some(name))?],
            None => self.sonars.iter().collect(),
        };
        let recording = |s: &&SonarControl| s.reports.recordings().has_switched();
        let switched: Vec<_> = wanted.into_iter().filter(recording).collect();
        if switched.is_empty() {
            return Err(format!(
                "{} has no output that records: 7k, Ping, XTF, SigMF, MCAP, WAV, or JSF with record = true",
                sonar.map_or("the rig".to_owned(), |name| format!("sonar {name}"))
            ));
        }
        for sonar in &switched {
            sonar.reports.recordings().switch(on);
        }
        let names: Vec<_> = switched.iter().map(|s| s.name.as_str()).collect();
        Ok(json!({ "recording": on, "sonars": names }))
    }

    /// Replaces the sound-speed profile for pulses from now on.
    fn set_profile(&self, points: &[(f64, f64)]) -> Result<Value, String> {
        if self.page.spec.medium.profile.is_none() {
            return Err(
                "the configuration has one sound speed: add [medium.profile] and restart the daemon"
                    .to_owned(),
            );
        }
        let profile = SoundSpeedProfile::new(points.to_vec());
        let profile = profile.map_err(|refused| refused.to_string())?;
        let now = self.sonars.first().map(|sonar| sonar.settings.now());
        let now = now.ok_or("the rig has no sonar")?;
        let mut profiles = lock(&self.profiles);
        if profiles.len() == MAX_PROFILES {
            profiles.pop_front();
        }
        profiles.push_back((now, Arc::new(profile)));
        Ok(json!({ "points": points.len() }))
    }

    /// The newest profile that a command set before a pulse; `None` while that of the configuration is in force.
    pub(crate) fn profile_at(&self, pulse: MonoNs) -> Option<Arc<SoundSpeedProfile>> {
        let profiles = lock(&self.profiles);
        let mut newest = profiles.iter().rev();
        let (_, profile) = newest.find(|(since, _)| *since < pulse)?;
        Some(profile.clone())
    }

    /// Changes the clock. Machine time can run at any rate; simulated time runs freely or by steps. A change between the two requires a restart.
    fn set_clock(&self, mode: ClockMode, rate: Option<f64>) -> Result<Value, String> {
        self.refuse_without_own_nav()?;
        let rate = match (mode, rate) {
            (ClockMode::Scaled, Some(rate)) if CLOCK_RATES.contains(&rate) => rate,
            (ClockMode::Scaled, _) => {
                let (least, most) = (CLOCK_RATES.start(), CLOCK_RATES.end());
                return Err(format!("rate: must be from {least} to {most}"));
            }
            (_, Some(_)) => return Err("rate: only with mode = \"scaled\"".to_owned()),
            (_, None) => 1.0,
        };
        let wanted = match mode {
            ClockMode::RealTime => ClockSpec::RealTime,
            ClockMode::Scaled => ClockSpec::Scaled(rate),
            ClockMode::Fast => ClockSpec::Fast,
            ClockMode::Lockstep => ClockSpec::Lockstep,
        };
        let mut clock = lock(&self.clock);
        if wanted.is_own() != clock.is_own() {
            return Err(format!(
                "run.clock = \"{}\" cannot be set while the daemon runs with the present clock: restart the daemon with it",
                clock_name(wanted)
            ));
        }
        *clock = wanted;
        match mode {
            ClockMode::Lockstep => self.gate.pause(),
            ClockMode::Fast => self.gate.resume(),
            ClockMode::RealTime | ClockMode::Scaled => {
                self.gate.set_rate(rate);
            }
        }
        Ok(json!({ "clock": clock_name(wanted), "rate": rate }))
    }

    /// Refuses to pause rig time if live navigation is used.
    fn refuse_without_own_nav(&self) -> Result<(), String> {
        match self.recorded {
            true => Ok(()),
            false => Err(
                "needs recorded navigation; {\"do\": \"set\", \"pinging\": false} stops the pings"
                    .to_owned(),
            ),
        }
    }

    /// Stores a command for the page and logs it. Settings have their own journal and log entries.
    fn note(&self, command: &Command, answer: &Answer, by: Requester) {
        let is_setting = matches!(command, Command::Set(_) | Command::Trigger { .. });
        // A request refused before the journal has no entry there.
        let is_journaled = is_setting
            && (answer.accepted || answer.why.as_deref().is_some_and(|w| w.contains(" = ")));
        if is_journaled {
            return;
        }
        let (via, peer) = (by.via, by.peer.map(|peer| peer.to_string()));
        let command = &answer.asked;
        match &answer.why {
            None => tracing::info!(via, client = peer, %command, "command accepted"),
            Some(why) => tracing::warn!(via, client = peer, %command, why, "command refused"),
        }
        let mut recent = lock(&self.recent_commands);
        if recent.len() == MAX_RECENT_COMMANDS {
            recent.pop_front();
        }
        recent.push_back(json!({
            "utc_ms": (self.rig_time)().0 as f64 / 1e6,
            "via": by.via,
            "peer": by.peer.map(|peer| peer.to_string()),
            "command": answer.asked,
            "accepted": answer.accepted,
            "why": answer.why,
        }));
        self.commands_done.fetch_add(1, Ordering::Relaxed);
    }

    fn origin(&self, by: Requester) -> ChangeOrigin {
        ChangeOrigin {
            utc: (self.rig_time)(),
            by,
        }
    }

    /// Applies changes in order. Changes before a refusal remain.
    fn set(
        &self,
        sonar: &SonarControl,
        changes: &[SettingChange],
        by: Requester,
    ) -> Result<Value, String> {
        for (done, change) in changes.iter().enumerate() {
            if let Err(refused) = sonar.settings.apply(*change, self.origin(by)) {
                return Err(match done {
                    0 => refused.to_string(),
                    _ => format!("{refused}; the settings before it were applied"),
                });
            }
        }
        let (settings, version) = sonar.settings.snapshot();
        Ok(json!({ "sonar": sonar.name, "settings": settings_json(&settings), "version": version }))
    }

    fn sonar_status(&self, sonar: &SonarControl) -> Value {
        let (settings, version) = sonar.settings.snapshot();
        let counts = sonar.settings.counts();
        let counters: serde_json::Map<_, _> = sonar
            .all_counters()
            .map(|(name, _, value)| (name.to_owned(), value.into()))
            .collect();
        let histograms: serde_json::Map<_, _> = sonar
            .histograms
            .all()
            .map(|(name, _, figures)| (name.to_owned(), json!(figures)))
            .into_iter()
            .collect();
        json!({
            "name": sonar.name,
            "settings": settings_json(&settings),
            "settings_version": version,
            "changes": { "applied": counts.applied, "refused": counts.refused },
            "overload": self.page.spec.run.overload.name(),
            "counters": counters,
            "methods": sonar.counters.methods_json(),
            "microseconds": histograms,
            "outputs": sonar.reports.lines(),
            "recording": {
                "on": sonar.reports.recordings().is_on(),
                "files": sonar.reports.recordings().files(),
            },
        })
    }
}

fn clock_name(clock: ClockSpec) -> &'static str {
    match clock {
        ClockSpec::RealTime => "realtime",
        ClockSpec::Scaled(_) => "scaled",
        ClockSpec::Fast => "fast",
        ClockSpec::Lockstep => "lockstep",
    }
}

/// Every statement under these locks leaves consistent data.
fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

impl ControlPort for RunControl {
    fn command(&self, command: &Command, by: Requester) -> Answer {
        let answer = match self.answer(command, by) {
            Ok(result) => Answer::accepted(command, result),
            Err(why) => Answer::refused(command, why),
        };
        self.note(command, &answer, by);
        answer
    }

    fn feed(&self) -> &Arc<Feed> {
        &self.page.feed
    }

    fn hello(&self) -> Value {
        let mut hello = self.page.hello(self.opened.0);
        let set = lock(&self.profiles)
            .back()
            .map(|(_, profile)| profile.clone());
        let configured = self.page.spec.medium.profile.as_deref();
        hello["profile"] = json!(set.as_deref().or(configured).map(SoundSpeedProfile::points));
        hello
    }

    fn world(&self) -> Value {
        self.page.world()
    }

    fn relief(&self, tile: ReliefTile) -> Option<Bytes> {
        self.page.relief(tile, &self.relief)
    }

    fn revision(&self) -> u64 {
        // Settings and commands only increase the number; the gate toggles its last bit.
        let settings = self.sonars.iter().map(|sonar| {
            let counts = sonar.settings.counts();
            sonar.settings.version() + counts.applied + counts.refused
        });
        let paused = u64::from(self.gate.is_paused());
        settings.sum::<u64>() * 2 + self.commands_done.load(Ordering::Relaxed) * 4 + paused
    }

    fn page_state(&self) -> Value {
        let sonars = self.sonars.iter().map(|sonar| {
            let mut state = self.sonar_status(sonar);
            let bins = sonar.histograms.bins();
            state["bins"] = bins
                .into_iter()
                .map(|(name, bins)| (name.to_owned(), json!(bins)))
                .collect::<serde_json::Map<_, _>>()
                .into();
            state["trigger"] = trigger_name(sonar.settings.trigger()).into();
            state["journal"] = changes(&sonar.settings);
            state["streams"] = json!(sonar.reports.streams());
            state
        });
        let clock = *lock(&self.clock);
        json!({
            "clock": clock_name(clock),
            "rate": self.gate.rate(),
            "paused": self.gate.is_paused(),
            "delivered": self.gate.pings_delivered(),
            "rig_utc_ms": (self.rig_time)().0 as f64 / 1e6,
            "up_s": self.machine.mono().0 as f64 / 1e9,
            "pipeline_problem": self.pipeline_problem(),
            "sonars": sonars.collect::<Value>(),
            "faults": self.faults.list(),
            "faults_injected": self.faults.injected(),
            "nav": lock(&self.nav_sources).iter().map(nav_source).collect::<Value>(),
            "nav_owners": self.nav_owners(),
            "nav_lines": self.nav_lines(),
            "commands": lock(&self.recent_commands).iter().collect::<Vec<_>>(),
            "feed": self.page.feed.counts(),
        })
    }

    fn status(&self) -> Value {
        let clock = match *lock(&self.clock) {
            ClockSpec::RealTime => json!("realtime"),
            ClockSpec::Scaled(rate) => json!({ "scaled": rate }),
            ClockSpec::Fast => json!("fast"),
            ClockSpec::Lockstep => json!("lockstep"),
        };
        json!({
            "echotank": env!("CARGO_PKG_VERSION"),
            "clock": clock,
            "paused": self.gate.is_paused(),
            "pings_delivered": self.gate.pings_delivered(),
            "rig_utc_ns": (self.rig_time)().0,
            "sonars": self.sonars.iter().map(|s| self.sonar_status(s)).collect::<Vec<_>>(),
            "faults": {
                "scheduled": self.faults.scheduled(),
                "injected": self.faults.injected(),
                "unlogged": self.faults.unwritten(),
            },
            "overload_unlogged": self.overload_states.unwritten(),
            "nav": self.nav_lines(),
            "nav_owners": self.nav_owners(),
            "page": self.page.feed.counts(),
        })
    }

    fn health_problem(&self) -> Option<String> {
        let stopped = self
            .sonars
            .iter()
            .flat_map(|s| s.reports.recordings().lines());
        let all: Vec<_> = self.pipeline_problem().into_iter().chain(stopped).collect();
        (!all.is_empty()).then(|| all.join("; "))
    }

    /// Prometheus text, version 0.0.4.
    fn metrics(&self) -> String {
        let Some(first) = self.sonars.first() else {
            return String::new();
        };
        let mut families = Vec::new();
        for (k, (name, help, _)) in first.all_counters().enumerate() {
            let is_gauge = name.starts_with("worst_")
                || matches!(name, "nav_age_ms" | "plan" | "looser_now" | "drift_us");
            let kind = match is_gauge {
                true => Kind::Gauge,
                false => Kind::Counter,
            };
            let mut family = Family::new(name, help, kind);
            for sonar in &self.sonars {
                if let Some((_, _, value)) = sonar.all_counters().nth(k) {
                    family.push(&[("sonar", &sonar.name)], value as f64);
                }
            }
            families.push(family);
        }
        for (k, (name, help, _)) in first.counters.errors().into_iter().enumerate() {
            let mut family = Family::new(name, help, Kind::Gauge);
            for sonar in &self.sonars {
                if let Some(value) = sonar.counters.errors()[k].2 {
                    family.push(&[("sonar", &sonar.name)], value);
                }
            }
            families.push(family);
        }
        for (k, (name, help, _)) in first.histograms.all().into_iter().enumerate() {
            let mut family = Family::summary(&format!("{name}_seconds"), help);
            for sonar in &self.sonars {
                let figures = sonar.histograms.all()[k].2;
                let quantiles = [
                    (0.5, figures.p50_us),
                    (0.99, figures.p99_us),
                    (0.999, figures.p999_us),
                    (1.0, figures.max_us),
                ];
                family.push_summary(
                    &[("sonar", &sonar.name)],
                    &quantiles.map(|(quantile, us)| (quantile, us as f64 / 1e6)),
                    figures.sum_us as f64 / 1e6,
                    figures.count,
                );
            }
            families.push(family);
        }
        let mut faults = Family::new("faults_injected", "Faults injected", Kind::Counter);
        faults.push(&[], self.faults.injected() as f64);
        families.push(faults);
        for (key, kind, help) in STREAM_METRICS {
            let mut family = Family::new(&format!("client_{key}"), help, *kind);
            for sonar in &self.sonars {
                for stream in sonar.reports.streams() {
                    let value = match *key {
                        "bytes_sent" => stream.bytes_sent,
                        "records_sent" => stream.records_sent,
                        "records_dropped" => stream.records_dropped,
                        _ => stream.queued_bytes,
                    };
                    let labels = [
                        ("sonar", sonar.name.as_str()),
                        ("family", stream.family),
                        ("peer", &stream.peer),
                    ];
                    family.push(&labels, value as f64);
                }
            }
            families.push(family);
        }
        metrics::text(families)
    }
}

const STREAM_METRICS: &[(&str, Kind, &str)] = &[
    ("bytes_sent", Kind::Counter, "Bytes written to a client"),
    ("records_sent", Kind::Counter, "Records written to a client"),
    (
        "records_dropped",
        Kind::Counter,
        "Records that did not fit a client's queue",
    ),
    ("queued_bytes", Kind::Gauge, "Bytes waiting for a client"),
];

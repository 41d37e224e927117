//! Navigation outputs: ZDA, GGA and HDT sentences on the clock of the pings, so that a device under test shares this clock.
//!
//! ```text
//! pipeline thread: predicted motion -> shared state -> a thread per output: tick -> pulse, ZDA, GGA, HDT -> UDP, TCP, serial
//! ```
//! At every whole second the output sends the pulse and then the ZDA with the time of the pulse. GGA and HDT can follow after `latency_ms`, as with
//! real receivers. GGA holds the reference point. Its quality is that of the source while the position may be extrapolated. The quality is then 6
//! (estimated) until the position is stale, and 0 with empty fields afterwards. HDT is empty once the heading is stale.

mod transports;

use std::collections::VecDeque;
use std::net::SocketAddr;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering::Relaxed};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread::JoinHandle;

use thiserror::Error;

use self::transports::Transport;
use crate::clock::Clock;
use echotank_config::spec::{NavOutputSpec, NavSentence, PulseSpec};
use echotank_core::frames::{Trajectory, angles_from_rotation};
use echotank_core::navigation::{FixQuality, NavState};
use echotank_core::time::{MonoNs, NS_PER_S, UtcNs};
use echotank_nav::encode::{self, Fix};
use echotank_nav::{LocalTangentPlane, NavHistory};

/// Interval at which the motion is published, ns.
const PUBLISH_EVERY_NS: i64 = 10_000_000;
/// Length of a pulse, ns.
const PULSE_NS: i64 = 100_000_000;
/// Interval between checks of the stop flag, ns.
const STOP_CHECK_NS: i64 = 100_000_000;
/// Lateness beyond which a tick is skipped, ns, because its sentences are useless as a clock.
const TOO_LATE_NS: i64 = NS_PER_S / 2;

/// Reads the clock of the pings, which is the time in outgoing sentences.
pub type OutputTime = Arc<dyn Fn() -> UtcNs + Send + Sync>;

/// Faults of the outgoing clock.
pub trait ClockFaults: Send + Sync {
    /// Whether the pulse of this second is suppressed.
    fn pulse_is_lost(&self, second: UtcNs) -> bool;
    /// Offset of the time in the ZDA sentence of this second, s.
    fn zda_is_off_s(&self, second: UtcNs) -> f64;
}

/// Error of opening a navigation output.
#[derive(Debug, Error)]
#[error("nav output `{name}`: cannot open {target}: {reason}")]
pub struct NavOutputError {
    /// Name of the output.
    pub name: String,
    /// Configured target.
    pub target: String,
    /// Cause.
    pub reason: String,
}

/// Predicted motion of the rig.
struct Prediction {
    zero: MonoNs,
    trajectory: Trajectory,
    state: NavState,
    heading_age_s: f64,
    plane: Option<LocalTangentPlane>,
    /// Age up to which a value is extrapolated, s, and age beyond which the value is stale, s.
    carried_s: f64,
    stale_s: f64,
    /// Whether any motion is known.
    known: bool,
}

type SharedPrediction = Arc<Mutex<Option<Prediction>>>;

#[derive(Default)]
struct Counts {
    sentences: AtomicU64,
    pulses: AtomicU64,
    late: AtomicU64,
    errors: AtomicU64,
    clients: AtomicU64,
}

struct Running {
    name: String,
    address: Option<SocketAddr>,
    transport: &'static str,
    counts: Arc<Counts>,
}

/// Navigation outputs of a rig. Their threads run until the value is dropped and send nothing before the first `publish`.
pub struct NavOutputs {
    shared: SharedPrediction,
    /// Scratch, swapped with the shared prediction.
    trajectory: Trajectory,
    next: MonoNs,
    running: Vec<Running>,
    stop: Arc<AtomicBool>,
    threads: Vec<JoinHandle<()>>,
}

impl NavOutputs {
    /// Opens the outputs without faults.
    ///
    /// # Errors
    /// A socket, serial port or thread is not available.
    pub fn open(
        specs: &[NavOutputSpec],
        clock: &Arc<dyn Clock>,
        time: &OutputTime,
    ) -> Result<Self, NavOutputError> {
        Self::open_with(specs, clock, time, None)
    }

    /// Like [`NavOutputs::open`], with faults of the outgoing clock.
    ///
    /// # Errors
    /// A socket, serial port or thread is not available.
    pub fn open_with(
        specs: &[NavOutputSpec],
        clock: &Arc<dyn Clock>,
        time: &OutputTime,
        faults: Option<&Arc<dyn ClockFaults>>,
    ) -> Result<Self, NavOutputError> {
        let mut outputs = Self {
            shared: Arc::default(),
            trajectory: Trajectory::default(),
            next: MonoNs(i64::MIN),
            running: Vec::new(),
            stop: Arc::default(),
            threads: Vec::new(),
        };
        for spec in specs {
            let refused = |reason: String| NavOutputError {
                name: spec.name.clone(),
                target: transports::name(&spec.target),
                reason,
            };
            let counts = Arc::new(Counts::default());
            let (transport, address) =
                transports::open(&spec.target, spec.pulse).map_err(|e| refused(e.to_string()))?;
            let sender = Sender {
                spec: spec.clone(),
                transport,
                shared: outputs.shared.clone(),
                clock: clock.clone(),
                time: time.clone(),
                stop: outputs.stop.clone(),
                faults: faults.cloned(),
                counts: counts.clone(),
                text: Vec::new(),
            };
            let thread = std::thread::Builder::new()
                .name(format!("nav out {}", spec.name))
                .spawn(move || sender.run())
                .map_err(|e| refused(e.to_string()))?;
            outputs.threads.push(thread);
            outputs.running.push(Running {
                name: spec.name.clone(),
                transport: transports::transport(&spec.target),
                address,
                counts,
            });
        }
        Ok(outputs)
    }

    /// Whether no output is configured.
    pub fn is_empty(&self) -> bool {
        self.running.is_empty()
    }

    /// Addresses as `nav out NAME TRANSPORT ADDRESS`, one line each.
    pub fn addresses(&self) -> Vec<String> {
        let line = |r: &Running| match r.address {
            Some(address) => format!("nav out {} {} {address}", r.name, r.transport),
            None => format!("nav out {} {}", r.name, r.transport),
        };
        self.running.iter().map(line).collect()
    }

    /// Status text, one line per output.
    pub fn lines(&self) -> Vec<String> {
        let line = |r: &Running| {
            let c = &r.counts;
            format!(
                "nav out {}: {} sentences, {} pulses, {} ticks too late, {} errors, {} clients",
                r.name,
                c.sentences.load(Relaxed),
                c.pulses.load(Relaxed),
                c.late.load(Relaxed),
                c.errors.load(Relaxed),
                c.clients.load(Relaxed)
            )
        };
        self.running.iter().map(line).collect()
    }

    /// Instant of the next publication.
    pub(crate) fn next_publish(&self) -> MonoNs {
        match self.is_empty() {
            true => MonoNs(i64::MAX),
            false => self.next,
        }
    }

    /// Publishes the predicted motion around `utc` if publication is due at `now`.
    pub fn publish(&mut self, history: &mut NavHistory, now: MonoNs, utc: UtcNs) {
        if self.is_empty() || now < self.next {
            return;
        }
        self.next = now.plus_ns(PUBLISH_EVERY_NS);
        let state = history.predict(utc, &mut self.trajectory);
        let mut shared = self.shared.lock().unwrap_or_else(PoisonError::into_inner);
        let prediction = shared.get_or_insert_with(|| Prediction {
            zero: now,
            trajectory: Trajectory::default(),
            state: NavState::default(),
            heading_age_s: f64::INFINITY,
            plane: None,
            carried_s: history.max_extrapolation_s(),
            stale_s: history.stale_s(),
            known: false,
        });
        prediction.known = state.is_ok();
        if let Ok(state) = state {
            std::mem::swap(&mut prediction.trajectory, &mut self.trajectory);
            prediction.zero = now;
            prediction.state = state;
            prediction.heading_age_s = history.heading_age_s(utc);
            prediction.plane = history.origin();
        }
    }
}

impl Drop for NavOutputs {
    fn drop(&mut self) {
        self.stop.store(true, Relaxed);
        for thread in self.threads.drain(..) {
            // The panic hook has reported a panic of the thread.
            let _ = thread.join();
        }
    }
}

impl Prediction {
    fn position(&self, at: MonoNs) -> Option<Fix> {
        let ahead_s = at.seconds_since(self.zero);
        let age_s = self.state.position_age_s + ahead_s;
        if !self.known || age_s > self.stale_s {
            return None;
        }
        let pose = self
            .trajectory
            .pose_at(self.within(ahead_s, self.state.position_age_s));
        let (latitude_rad, longitude_rad) = self
            .plane?
            .geodetic_rad(pose.position_m.x, pose.position_m.y);
        let estimated = age_s > self.carried_s && self.state.fix != FixQuality::None;
        Some(Fix {
            latitude_rad,
            longitude_rad,
            height_m: -pose.position_m.z,
            quality: match estimated {
                true => FixQuality::DeadReckoning,
                false => self.state.fix,
            },
        })
    }

    fn heading_rad(&self, at: MonoNs) -> Option<f64> {
        let ahead_s = at.seconds_since(self.zero);
        if !self.known || self.heading_age_s + ahead_s > self.stale_s {
            return None;
        }
        let pose = self
            .trajectory
            .pose_at(self.within(ahead_s, self.heading_age_s));
        Some(angles_from_rotation(pose.world_from_body).2)
    }

    /// Limits a prediction to the age up to which a value is extrapolated. The trajectory itself holds older values constant.
    fn within(&self, ahead_s: f64, age_s: f64) -> f64 {
        match age_s > self.carried_s {
            true => ahead_s,
            false => ahead_s.min(self.carried_s - age_s),
        }
    }
}

/// State of one output's thread.
struct Sender {
    spec: NavOutputSpec,
    transport: Box<dyn Transport>,
    shared: SharedPrediction,
    clock: Arc<dyn Clock>,
    time: OutputTime,
    stop: Arc<AtomicBool>,
    faults: Option<Arc<dyn ClockFaults>>,
    counts: Arc<Counts>,
    text: Vec<u8>,
}

/// Time in the sentences of a tick, and the instant at which they are due.
#[derive(Clone, Copy)]
struct Tick {
    utc: UtcNs,
    at: MonoNs,
}

impl Sender {
    fn run(mut self) {
        let latency_ns = (self.spec.latency_s * NS_PER_S as f64) as i64;
        let mut waiting: VecDeque<Tick> = VecDeque::new();
        let mut pulse_ends: Option<MonoNs> = None;
        let mut last = UtcNs(i64::MIN);
        while !self.stop.load(Relaxed) {
            let now = self.clock.mono();
            if !self.has_begun() {
                self.clock.sleep_until(now.plus_ns(STOP_CHECK_NS / 10));
                continue;
            }
            let tick = self.next_tick(now, last);
            let late = waiting.front().map(|t| t.at.plus_ns(latency_ns));
            let events = [Some(tick.at), late, pulse_ends].into_iter().flatten();
            let next = events.min().unwrap_or(tick.at);
            if next > now.plus_ns(STOP_CHECK_NS) {
                self.clock.sleep_until(now.plus_ns(STOP_CHECK_NS));
                self.counts.clients.store(self.transport.clients(), Relaxed);
                continue;
            }
            self.clock.sleep_until(next);
            if Some(next) == pulse_ends {
                pulse_ends = None;
                self.pulse(false);
            } else if Some(next) == late {
                let tick = waiting.pop_front();
                if let Some(tick) = tick {
                    self.say(&tick, &[NavSentence::Gga, NavSentence::Hdt]);
                }
            } else {
                last = tick.utc;
                if self.clock.mono().0 - tick.at.0 > TOO_LATE_NS {
                    self.counts.late.fetch_add(1, Relaxed);
                    continue;
                }
                let whole = tick.utc.0 % NS_PER_S == 0;
                let lost = |faults: &Arc<dyn ClockFaults>| faults.pulse_is_lost(tick.utc);
                if whole
                    && self.spec.pulse != PulseSpec::None
                    && !self.faults.as_ref().is_some_and(lost)
                {
                    self.pulse(true);
                    pulse_ends = Some(tick.at.plus_ns(PULSE_NS));
                }
                let first = if whole { &[NavSentence::Zda][..] } else { &[] };
                if latency_ns > 0 {
                    self.say(&tick, first);
                    waiting.push_back(tick);
                } else {
                    let all = [NavSentence::Zda, NavSentence::Gga, NavSentence::Hdt];
                    self.say(&tick, if whole { &all } else { &all[1..] });
                }
            }
        }
    }

    fn has_begun(&self) -> bool {
        self.shared
            .lock()
            .unwrap_or_else(PoisonError::into_inner)
            .is_some()
    }

    /// Next tick after `last`. The clock can be set back at any time; a `last` far ahead is then ignored.
    fn next_tick(&self, now: MonoNs, last: UtcNs) -> Tick {
        let utc_now = (self.time)();
        // If the clock was set back, `last` can be more than a tick ahead.
        let period_ns = (NS_PER_S as f64 / self.spec.rate_hz) as i64;
        let ahead = last.0.saturating_sub(utc_now.0) > period_ns;
        let from = if ahead { utc_now } else { last };
        // A missed tick is sent late unless it is too old.
        let oldest = utc_now.plus_ns(-period_ns.min(TOO_LATE_NS));
        let utc = encode::next_tick(from.max(oldest), self.spec.rate_hz);
        Tick {
            utc,
            at: now.plus_ns(utc.0 - utc_now.0),
        }
    }

    fn pulse(&mut self, high: bool) {
        match self.transport.pulse(high) {
            Ok(()) => self.counts.pulses.fetch_add(u64::from(high), Relaxed),
            Err(_) => self.counts.errors.fetch_add(1, Relaxed),
        };
    }

    /// Sends those of the sentences `which` that are configured, in one write.
    fn say(&mut self, tick: &Tick, which: &[NavSentence]) {
        let (fix, heading_rad) = {
            let shared = self.shared.lock().unwrap_or_else(PoisonError::into_inner);
            let prediction = shared.as_ref();
            (
                prediction.and_then(|o| o.position(tick.at)),
                prediction.and_then(|o| o.heading_rad(tick.at)),
            )
        };
        self.text.clear();
        let mut count = 0;
        for sentence in which.iter().filter(|s| self.spec.sentences.contains(s)) {
            let talker = &self.spec.talker;
            match sentence {
                NavSentence::Zda => {
                    let off = self.faults.as_ref().map(|f| f.zda_is_off_s(tick.utc));
                    encode::zda(&mut self.text, talker, tick.utc.plus_s(off.unwrap_or(0.0)));
                }
                NavSentence::Gga => encode::gga(&mut self.text, talker, tick.utc, fix.as_ref()),
                NavSentence::Hdt => encode::hdt(&mut self.text, talker, heading_rad),
            }
            count += 1;
        }
        if count == 0 {
            return;
        }
        match self.transport.send(&self.text) {
            Ok(()) => self.counts.sentences.fetch_add(count, Relaxed),
            Err(_) => self.counts.errors.fetch_add(1, Relaxed),
        };
        self.counts.clients.store(self.transport.clients(), Relaxed);
    }
}

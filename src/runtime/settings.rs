//! Settings of a sonar. Every change passes through this module.
//!
//! A [`SettingChange`] comes from a protocol, the page or a command. The store applies it to the next scheduled ping, or refuses it. A
//! refusal names key, value and rule, and changes nothing.
//!
//! The store applies a change before its acknowledgement is written. A ping whose settings are read after the acknowledgement uses the change. Device
//! settings that the model does not use are stored and reported. A journal lists every change with its requester. The other protocols report changes
//! from the journal. The settling time of the hardware is not modelled.

use std::collections::{BTreeMap, VecDeque};
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use crate::clock::Clock;
use echotank_config::spec::LimitsSpec;
use echotank_core::settings::{
    ChangeOrigin, Changed, JournalEntry, SettingApplied, SettingChange, SettingRefused,
    SettingRule, SettingsPort, SonarSettings, StoredKey, StoredValue, TriggerSource,
};
use echotank_core::time::MonoNs;
use echotank_ping::rig_schedule::SettingsInForce;

/// Number of changes kept for the operator and the other protocols; older changes are only counted.
pub(crate) const RECENT_CHANGES: usize = 64;

/// Maximum number of settings stored without effect on the model. Devices have far fewer. The limit prevents a client from exhausting memory.
pub const MAX_STORED: usize = 4096;

/// Maximum number of pings in one request.
const MAX_PINGS_ASKED: f64 = u32::MAX as f64;

/// Relative tolerance of the limits. A limit of 0.1 ms becomes smaller by 2.5e-8 of its value when sent as f32.
///
/// A value outside a limit by no more than the precision of an f32 counts as the limit.
const WIRE_PRECISION: f64 = f32::EPSILON as f64;

/// Settings of one sonar, shared by all threads that read or change them.
pub struct SettingsStore {
    limits: LimitsSpec,
    /// Clock that gives the time of changes.
    clock: Arc<dyn Clock>,
    /// Version of `state`, readable without the lock.
    version: AtomicU64,
    state: Mutex<State>,
}

struct State {
    requested: RequestedSettings,
    stored: BTreeMap<StoredKey, StoredValue>,
    counts: SettingCounts,
    recent: VecDeque<RecentChange>,
    journal: VecDeque<JournalEntry>,
    /// Settings with the instant from which they apply, oldest first. The first entry also covers all earlier time.
    past: VecDeque<(MonoNs, SettingsInForce)>,
}

/// Requested settings, before the rules of [`RequestedSettings::effective`].
#[derive(Clone, Copy)]
struct RequestedSettings {
    /// Here `pinging` is the last start or stop request, independent of rate and trigger.
    settings: SonarSettings,
    trigger: TriggerSource,
    /// Remaining pings of a request for a number of pings.
    pings_left: u32,
}

impl RequestedSettings {
    fn in_force(&self) -> SettingsInForce {
        let obeys = self.settings.pinging && self.trigger == TriggerSource::External;
        SettingsInForce {
            settings: self.effective(),
            armed: obeys && self.settings.max_ping_rate_hz > 0.0,
        }
    }

    /// Settings that apply to pings. A rate of 0 or an external trigger stops the internal schedule of a started sonar.
    fn effective(&self) -> SonarSettings {
        let is_scheduled = self.settings.pinging && self.trigger == TriggerSource::Internal;
        SonarSettings {
            pinging: (is_scheduled || self.pings_left > 0) && self.settings.max_ping_rate_hz > 0.0,
            ..self.settings
        }
    }
}

/// Counts of setting changes since the start.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct SettingCounts {
    /// Changes accepted, including settings stored without effect.
    pub applied: u64,
    /// Changes refused.
    pub refused: u64,
}

/// One entry of the list of recent changes.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct RecentChange {
    /// Time and requester of the change.
    pub origin: ChangeOrigin,
    /// Requested change.
    pub change: SettingChange,
    /// First version that contains the change, or the reason for the refusal.
    pub outcome: Result<u64, SettingRefused>,
}

impl SettingsStore {
    /// Creates a store with an internal trigger. `start` must come from the checked configuration and lie within `limits`.
    pub fn new(start: SonarSettings, limits: LimitsSpec, clock: Arc<dyn Clock>) -> Self {
        Self::triggered(start, TriggerSource::Internal, limits, clock)
    }

    /// Like [`SettingsStore::new`], with the initial trigger source.
    pub fn triggered(
        start: SonarSettings,
        trigger: TriggerSource,
        limits: LimitsSpec,
        clock: Arc<dyn Clock>,
    ) -> Self {
        let requested = RequestedSettings {
            settings: start,
            trigger,
            pings_left: 0,
        };
        let mut past = VecDeque::with_capacity(RECENT_CHANGES);
        past.push_back((clock.mono(), requested.in_force()));
        Self {
            limits,
            clock,
            version: AtomicU64::new(0),
            state: Mutex::new(State {
                requested,
                stored: BTreeMap::new(),
                counts: SettingCounts::default(),
                recent: VecDeque::with_capacity(RECENT_CHANGES),
                journal: VecDeque::with_capacity(RECENT_CHANGES),
                past,
            }),
        }
    }

    /// Present instant, on the clock that decides which pulses obey a change.
    pub(crate) fn now(&self) -> MonoNs {
        self.clock.mono()
    }

    /// Settings of a ping scheduled now, and their version. If `pinging` is true, `max_ping_rate_hz` is above 0.
    pub fn snapshot(&self) -> (SonarSettings, u64) {
        let state = self.lock();
        (
            state.requested.effective(),
            self.version.load(Ordering::Acquire),
        )
    }

    /// Settings at an instant, for a ping whose order is written shortly after its pulse.
    ///
    /// A change applies only to pulses after its acknowledgement.
    pub fn at(&self, instant: MonoNs) -> SonarSettings {
        self.in_force(instant).settings
    }

    /// Like [`SettingsStore::at`], with whether external triggers were accepted at that instant.
    pub fn in_force(&self, instant: MonoNs) -> SettingsInForce {
        let state = self.lock();
        let held = state
            .past
            .iter()
            .rev()
            .find(|(since, _)| *since < instant)
            .or(state.past.front());
        held.map_or(state.requested.in_force(), |&(_, in_force)| in_force)
    }

    /// Records a ping transmitted at `instant`. Decrements the remaining pings of a request for a number of pings; the last one stops
    /// pinging.
    pub fn note_ping(&self, instant: MonoNs) {
        let mut state = self.lock();
        if state.requested.pings_left == 0 {
            return;
        }
        state.requested.pings_left -= 1;
        if state.requested.pings_left == 0 {
            let in_force = state.requested.in_force();
            state.remember(instant, in_force);
            self.next_version();
        }
    }

    /// Number that increases with every change. A ping plan made from an older version is out of date.
    pub fn version(&self) -> u64 {
        self.version.load(Ordering::Acquire)
    }

    /// Configured limits of the settings.
    pub fn limits(&self) -> &LimitsSpec {
        &self.limits
    }

    /// Applies or refuses one change, and counts it. `origin` is stored in the journal and the list of recent changes.
    ///
    /// # Errors
    /// The change violates a rule; the settings stay unchanged.
    pub fn apply(
        &self,
        change: SettingChange,
        origin: impl Into<ChangeOrigin>,
    ) -> Result<SettingApplied, SettingRefused> {
        let origin = origin.into();
        let mut state = self.lock();
        let outcome = apply_change(state.requested, change, &self.limits).map(|settings| {
            state.requested = settings;
            state.remember(self.clock.mono(), settings.in_force());
            let settings = settings.effective();
            let version = self.next_version();
            state.note(JournalEntry {
                version,
                origin,
                changed: Changed::Setting(change),
            });
            SettingApplied { settings, version }
        });
        match outcome {
            Ok(_) => state.counts.applied += 1,
            Err(_) => state.counts.refused += 1,
        }
        push_bounded(
            &mut state.recent,
            RecentChange {
                origin,
                change,
                outcome: outcome.map(|applied| applied.version),
            },
        );
        drop(state);
        let (via, peer) = (origin.by.via, origin.by.peer.map(|peer| peer.to_string()));
        match &outcome {
            Ok(applied) => {
                let version = applied.version;
                tracing::info!(via, client = peer, ?change, version, "setting applied");
            }
            Err(why) => tracing::warn!(via, client = peer, ?change, %why, "setting refused"),
        }
        outcome
    }

    /// Number of applied and refused changes so far.
    pub fn counts(&self) -> SettingCounts {
        self.lock().counts
    }

    /// The last [`RECENT_CHANGES`] changes, oldest first.
    pub fn recent(&self) -> Vec<RecentChange> {
        self.lock().recent.iter().copied().collect()
    }

    /// Increments the version and returns it. Call with `state` locked.
    fn next_version(&self) -> u64 {
        let version = self.version.load(Ordering::Acquire) + 1;
        self.version.store(version, Ordering::Release);
        version
    }

    /// Ignores poisoning: settings are written in one assignment, so they are never partly updated.
    fn lock(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl State {
    fn remember(&mut self, since: MonoNs, in_force: SettingsInForce) {
        push_bounded(&mut self.past, (since, in_force));
    }

    fn note(&mut self, entry: JournalEntry) {
        push_bounded(&mut self.journal, entry);
    }
}

fn push_bounded<T>(queue: &mut VecDeque<T>, item: T) {
    if queue.len() == RECENT_CHANGES {
        queue.pop_front();
    }
    queue.push_back(item);
}

impl SettingsPort for SettingsStore {
    fn settings(&self) -> SonarSettings {
        self.snapshot().0
    }
    fn trigger(&self) -> TriggerSource {
        self.lock().requested.trigger
    }
    fn limits(&self) -> LimitsSpec {
        self.limits
    }
    fn version(&self) -> u64 {
        SettingsStore::version(self)
    }
    fn apply(
        &self,
        change: SettingChange,
        origin: ChangeOrigin,
    ) -> Result<SettingApplied, SettingRefused> {
        SettingsStore::apply(self, change, origin)
    }
    fn store(
        &self,
        key: StoredKey,
        value: StoredValue,
        origin: ChangeOrigin,
    ) -> Result<(), SettingRefused> {
        let mut state = self.lock();
        if state.stored.len() >= MAX_STORED && !state.stored.contains_key(&key) {
            state.counts.refused += 1;
            return Err(SettingRefused {
                key: key.name,
                value: f64::from(key.place),
                rule: SettingRule::TooMany { most: MAX_STORED },
            });
        }
        state.stored.insert(key, value.clone());
        state.counts.applied += 1;
        let version = self.next_version();
        state.note(JournalEntry {
            version,
            origin,
            changed: Changed::Stored(key, value),
        });
        Ok(())
    }
    fn stored(&self, key: StoredKey) -> Option<StoredValue> {
        self.lock().stored.get(&key).cloned()
    }
    fn changes_since(&self, version: u64) -> Vec<JournalEntry> {
        let state = self.lock();
        let newer = state.journal.iter().filter(|entry| entry.version > version);
        newer.cloned().collect()
    }
}

/// `settings` after one change, for a sonar that no client controls.
///
/// # Errors
/// The value is outside the limits.
pub(crate) fn changed(
    settings: SonarSettings,
    change: SettingChange,
    limits: &LimitsSpec,
) -> Result<SonarSettings, SettingRefused> {
    let requested = RequestedSettings {
        settings,
        trigger: TriggerSource::Internal,
        pings_left: 0,
    };
    Ok(apply_change(requested, change, limits)?.settings)
}

fn apply_change(
    mut requested: RequestedSettings,
    change: SettingChange,
    limits: &LimitsSpec,
) -> Result<RequestedSettings, SettingRefused> {
    let settings = &mut requested.settings;
    match change {
        SettingChange::RangeM(value) => {
            settings.range_m = within("range_m", value, limits.range_m)?;
        }
        SettingChange::MaxPingRateHz(0.0) => settings.max_ping_rate_hz = 0.0,
        SettingChange::MaxPingRateHz(value) => {
            settings.max_ping_rate_hz = within("max_ping_rate_hz", value, limits.ping_rate_hz)
                .map_err(|refused| match refused.rule {
                    SettingRule::Between { min, max } => SettingRefused {
                        rule: SettingRule::ZeroOrBetween { min, max },
                        ..refused
                    },
                    _ => refused,
                })?;
        }
        SettingChange::SourceLevelDb(value) => {
            settings.source_level_db = within("source_level_db", value, limits.source_level_db)?;
        }
        SettingChange::GainDb(value) => {
            settings.gain_db = within("gain_db", value, limits.gain_db)?;
        }
        SettingChange::PulseDurationS(value) => {
            settings.pulse_duration_s = within("pulse_duration_s", value, limits.pulse_duration_s)?;
        }
        SettingChange::Start => (settings.pinging, requested.pings_left) = (true, 0),
        SettingChange::Stop => (settings.pinging, requested.pings_left) = (false, 0),
        SettingChange::PingTimes(times) => {
            within("ping_times", f64::from(times), (1.0, MAX_PINGS_ASKED))?;
            (settings.pinging, requested.pings_left) = (false, times);
        }
        SettingChange::Trigger(source) => requested.trigger = source,
    }
    Ok(requested)
}

/// Returns `value` clamped to the limits, or refuses it if it is outside by more than the precision of an f32.
fn within(key: &'static str, value: f64, (min, max): (f64, f64)) -> Result<f64, SettingRefused> {
    let refused = |rule| Err(SettingRefused { key, value, rule });
    if !value.is_finite() {
        return refused(SettingRule::Finite);
    }
    let held = value.clamp(min, max);
    if (value - held).abs() > WIRE_PRECISION * held.abs() {
        return refused(SettingRule::Between { min, max });
    }
    Ok(held)
}

#[cfg(test)]
mod tests {
    use super::SettingChange::*;
    use super::*;
    use crate::clock::VirtualClock;
    use echotank_core::time::UtcNs;
    use proptest::prelude::*;

    const LIMITS: LimitsSpec = LimitsSpec {
        range_m: (5.0, 200.0),
        ping_rate_hz: (0.1, 20.0),
        source_level_db: (160.0, 220.0),
        gain_db: (0.0, 60.0),
        pulse_duration_s: (1e-4, 1e-2),
    };
    const START: SonarSettings = SonarSettings {
        pinging: true,
        range_m: 50.0,
        max_ping_rate_hz: 10.0,
        source_level_db: 200.0,
        gain_db: 20.0,
        pulse_duration_s: 1e-3,
    };
    const NOW: UtcNs = UtcNs(1_700_000_000_000_000_000);

    fn store() -> SettingsStore {
        SettingsStore::new(START, LIMITS, Arc::new(VirtualClock::default()))
    }

    fn counts(store: &SettingsStore) -> (u64, u64) {
        let counts = store.counts();
        (counts.applied, counts.refused)
    }

    #[test]
    fn an_accepted_change_is_in_the_next_snapshot_under_a_new_version() {
        let store = store();
        assert_eq!(store.snapshot(), (START, 0));
        let applied = store.apply(RangeM(75.5), NOW).unwrap();
        let want = SonarSettings {
            range_m: 75.5,
            ..START
        };
        assert_eq!(applied.settings, want);
        assert_eq!(store.snapshot(), (want, applied.version));
        assert_eq!((applied.version, store.version()), (1, 1));
    }

    #[test]
    fn a_refusal_names_key_value_and_rule_and_changes_nothing() {
        let store = store();
        for (change, words) in [
            (RangeM(4.9), "range_m = 4.9: must be from 5 to 200"),
            (RangeM(f64::NAN), "range_m = NaN: must be a finite number"),
            (
                MaxPingRateHz(-1.0),
                "max_ping_rate_hz = -1: must be 0 or from 0.1 to 20",
            ),
            (
                MaxPingRateHz(21.0),
                "max_ping_rate_hz = 21: must be 0 or from 0.1 to 20",
            ),
            (
                SourceLevelDb(221.0),
                "source_level_db = 221: must be from 160 to 220",
            ),
            (
                GainDb(f64::INFINITY),
                "gain_db = inf: must be a finite number",
            ),
            (GainDb(-0.1), "gain_db = -0.1: must be from 0 to 60"),
            (
                PulseDurationS(0.0),
                "pulse_duration_s = 0: must be from 0.0001 to 0.01",
            ),
        ] {
            let refused = store.apply(change, NOW).unwrap_err();
            assert_eq!(refused.to_string(), words);
            assert_eq!(store.snapshot(), (START, 0), "{change:?}");
        }
        assert_eq!(counts(&store), (0, 8));
    }

    #[test]
    fn limits_sent_as_f32_are_accepted_and_clamped() {
        let store = store();
        for value in [f64::from(1e-4_f32), f64::from(1e-2_f32)] {
            let applied = store.apply(PulseDurationS(value), NOW).unwrap();
            let got = applied.settings.pulse_duration_s;
            assert!(
                (LIMITS.pulse_duration_s.0..=LIMITS.pulse_duration_s.1).contains(&got),
                "{got}"
            );
        }
        assert!(store.apply(PulseDurationS(0.999e-4), NOW).is_err());
    }

    #[test]
    fn a_rate_of_zero_stops_pinging_until_a_positive_rate() {
        let store = store();
        let held = store.apply(MaxPingRateHz(0.0), NOW).unwrap();
        assert!(!held.settings.pinging && held.settings.max_ping_rate_hz == 0.0);
        let started = store.apply(Start, NOW).unwrap();
        assert!(
            !started.settings.pinging,
            "a rate of 0 stops pinging from starting"
        );
        let going = store.apply(MaxPingRateHz(4.0), NOW).unwrap();
        assert!(going.settings.pinging && going.settings.max_ping_rate_hz == 4.0);
        store.apply(Stop, NOW).unwrap();
        let stopped = store.apply(MaxPingRateHz(5.0), NOW).unwrap();
        assert!(!stopped.settings.pinging, "a rate does not cancel a stop");
    }

    #[test]
    fn recent_changes_are_bounded_and_the_newest_are_kept() {
        let store = store();
        for k in 0..(RECENT_CHANGES + 10) {
            let _ = store.apply(GainDb(k as f64), NOW.plus_ns(k as i64));
        }
        let recent = store.recent();
        assert_eq!(recent.len(), RECENT_CHANGES);
        assert_eq!(recent[0].change, GainDb(10.0));
        assert_eq!(recent[0].outcome, Ok(11));
        let last = recent.last().unwrap();
        assert_eq!(last.origin.utc, NOW.plus_ns(RECENT_CHANGES as i64 + 9));
        assert!(last.outcome.is_err(), "73 dB is over the limit");
        assert_eq!(counts(&store), (61, 13));
    }

    #[test]
    fn changes_from_many_threads_are_each_counted_once() {
        let store = store();
        std::thread::scope(|scope| {
            for _ in 0..4 {
                scope.spawn(|| {
                    for k in 0..500 {
                        let _ = store.apply(RangeM(f64::from(k)), NOW);
                    }
                });
            }
        });
        assert_eq!(counts(&store), (4 * 196, 4 * 304));
        assert_eq!(store.version(), 4 * 196);
    }

    proptest! {
        #[test]
        fn settings_stay_within_their_limits_after_any_change(values in proptest::collection::vec((0..7_u8, any::<f64>()), 1..50)) {
            let store = store();
            for (kind, value) in values {
                let change = match kind {
                    0 => RangeM(value),
                    1 => MaxPingRateHz(value),
                    2 => SourceLevelDb(value),
                    3 => GainDb(value),
                    4 => PulseDurationS(value),
                    5 => Start,
                    _ => Stop,
                };
                let _ = store.apply(change, NOW);
                let (s, _) = store.snapshot();
                prop_assert!((5.0..=200.0).contains(&s.range_m));
                prop_assert!((160.0..=220.0).contains(&s.source_level_db));
                prop_assert!((0.0..=60.0).contains(&s.gain_db));
                prop_assert!((1e-4..=1e-2).contains(&s.pulse_duration_s));
                prop_assert!((0.1..=20.0).contains(&s.max_ping_rate_hz) || (s.max_ping_rate_hz == 0.0 && !s.pinging));
            }
        }
    }

    #[test]
    fn a_request_for_a_number_of_pings_ends_after_the_last_and_a_start_cancels_it() {
        let clock = Arc::new(VirtualClock::default());
        let store = SettingsStore::new(START, LIMITS, clock.clone());
        store.apply(PingTimes(2), NOW).unwrap();
        let at = |k: i64| MonoNs(k * 1_000_000_000);
        assert!(store.at(at(1)).pinging);
        store.note_ping(at(1));
        assert!(store.at(at(2)).pinging);
        store.note_ping(at(2));
        assert!(!store.at(at(3)).pinging, "two were requested");
        assert!(!store.snapshot().0.pinging);
        assert_eq!(store.version(), 2, "the end is a change too");
        store.apply(PingTimes(1), NOW).unwrap();
        store.apply(Start, NOW).unwrap();
        store.note_ping(at(4));
        assert!(store.snapshot().0.pinging, "started, not counted");
        let refused = store.apply(PingTimes(0), NOW).unwrap_err();
        assert_eq!(
            refused.to_string(),
            "ping_times = 0: must be from 1 to 4294967295"
        );
    }

    #[test]
    fn an_external_trigger_stops_the_schedule_but_not_a_request_for_pings() {
        let store = store();
        let external = Trigger(TriggerSource::External);
        assert!(!store.apply(external, NOW).unwrap().settings.pinging);
        let once = store.apply(PingTimes(1), NOW).unwrap();
        assert!(once.settings.pinging);
        let internal = Trigger(TriggerSource::Internal);
        store.apply(Start, NOW).unwrap();
        assert!(store.apply(internal, NOW).unwrap().settings.pinging);
    }

    #[test]
    fn settings_that_the_model_does_not_use_are_kept_journaled_and_bounded() {
        let store = store();
        let key = |place| StoredKey {
            via: "jsf",
            name: "adc_gain",
            place,
        };
        let origin = ChangeOrigin::from(NOW);
        assert_eq!(store.stored(key(0)), None);
        for place in 0..MAX_STORED as u32 {
            store
                .store(key(place), StoredValue::Integer(7), origin)
                .unwrap();
        }
        let text = StoredValue::Text("a.spf".into());
        store.store(key(3), text.clone(), origin).unwrap();
        assert_eq!(store.stored(key(3)), Some(text.clone()), "the newest");
        assert!(store.store(key(u32::MAX), text.clone(), origin).is_err());
        let version = store.version();
        let newest = store.changes_since(version - 1);
        let want = JournalEntry {
            version,
            origin,
            changed: Changed::Stored(key(3), text),
        };
        assert_eq!(newest, [want]);
        assert_eq!(store.changes_since(0).len(), RECENT_CHANGES, "bounded");
        assert_eq!(store.snapshot().0, START, "pings are unaffected");
    }

    #[test]
    fn only_a_pulse_later_than_the_acknowledgement_obeys_a_change() {
        let clock = Arc::new(VirtualClock::default());
        let store = SettingsStore::new(START, LIMITS, clock.clone());
        let acknowledged = MonoNs(5_000_000_000);
        clock.sleep_until(acknowledged);
        let range_m = LIMITS.range_m.0;
        store.apply(RangeM(range_m), UtcNs(0)).unwrap();
        // The order of an earlier ping can be written after the change.
        assert_eq!(store.at(acknowledged.plus_ns(-1)).range_m, START.range_m);
        assert_eq!(store.at(acknowledged).range_m, START.range_m);
        assert_eq!(store.at(acknowledged.plus_ns(1)).range_m, range_m);
    }
}

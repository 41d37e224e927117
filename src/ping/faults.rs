//! Fault injection: active faults, the pings that they affect, and the log for scoring the report of a device.
//!
//! Whether a fault affects a ping depends only on its seed, its number and the ping. For faults of the link the type of the record counts too. The
//! same scenario therefore affects the same pings in every clock mode. `echotank_synthesis::array` applies faults of elements. The runtime applies
//! faults of the link, of navigation and of the clock.

use std::collections::VecDeque;
use std::sync::atomic::{AtomicU32, AtomicU64, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, OnceLock, PoisonError};

use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::{Rng, SeedableRng};
use serde::Serialize;

use crate::PingOrder;
use echotank_config::spec::{
    FaultKind, FaultRefused, FaultRequest, FaultSpec, NavInputSpec, NavSourceSpec, SonarSpec,
};
use echotank_core::time::UtcNs;
use echotank_synthesis::array::faults::ActiveFault;

/// Maximum number of active faults.
const MAX_FAULTS: usize = 256;
/// Maximum number of injections waiting to be written; further injections are only counted.
const MAX_WAITING: usize = 65_536;
/// Separates these random draws from all others.
const TAG: [u8; 8] = *b"faultrun";

/// One injected fault: a line of `faults-*.jsonl`.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct Injection {
    /// Number of the fault in the log.
    pub fault: u32,
    /// Kind of the fault, as in the configuration.
    pub kind: &'static str,
    /// Name of the sonar; `None` for navigation faults.
    #[serde(serialize_with = "as_text", skip_serializing_if = "Option::is_none")]
    pub sonar: Option<Arc<str>>,
    /// Number of the ping. For navigation faults, the last ping ordered before, of any sonar; 0 before the first.
    pub ping_number: u32,
    /// Start of the pulse, arrival of the sample, or affected second; rig time, ns since 1970 UTC.
    pub utc_ns: i64,
    /// Navigation faults: name of the source.
    #[serde(serialize_with = "as_text", skip_serializing_if = "Option::is_none")]
    pub source: Option<Arc<str>>,
    /// Navigation faults: quantity of the sample.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub quantity: Option<&'static str>,
    /// Link faults: protocol family.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub line: Option<&'static str>,
    /// Link faults: record type, or number of the packet.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub record_type: Option<u32>,
    /// Link faults: location in a stream of packets.
    #[serde(flatten)]
    pub place: Place,
    /// Element faults: index of the receive array.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub array: Option<usize>,
    /// Element faults: index of the element in its array.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub element: Option<usize>,
    /// Growth of the fault, 0 to 1.
    pub strength: f64,
}

/// Location of a packet, from its header.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize)]
pub struct Place {
    /// Frame number of an element stream.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub frame_number: Option<u32>,
    /// Stream identifier of VITA 49.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub stream: Option<u32>,
    /// Whether the VITA 49 packet is a context packet.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub context: Option<bool>,
    /// Time stamp of the VITA 49 packet, nanoseconds since 1970.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub packet_utc_ns: Option<i64>,
}

fn as_text<S: serde::Serializer>(
    name: &Option<Arc<str>>,
    serializer: S,
) -> Result<S::Ok, S::Error> {
    serializer.serialize_str(name.as_deref().unwrap_or_default())
}

/// Identification of a ping for fault injection.
#[derive(Clone, Copy, Debug)]
pub struct PingMark {
    /// Index of the sonar.
    pub sonar: usize,
    /// Number of the ping.
    pub number: u32,
    /// Start of the pulse.
    pub utc: UtcNs,
}

impl PingMark {
    /// Identification of an ordered ping of a sonar.
    pub fn of(sonar: usize, order: &PingOrder) -> Self {
        Self {
            sonar,
            number: order.ping_number,
            utc: order.transmit_utc,
        }
    }
}

/// A fault that was added and not removed, with its counts.
pub struct ScheduledFault {
    /// Number of the fault in the log.
    pub id: u32,
    /// Effect, start and duration of the fault.
    pub spec: FaultSpec,
    /// Index of the sonar; `None` means all sonars.
    sonar: Option<usize>,
    /// Index of the navigation source; `None` means all sources.
    pub source: Option<usize>,
    /// Start of a fault without `at_s`: the first ping, sample or second that is checked after the fault was added.
    since: OnceLock<UtcNs>,
    /// Original request.
    request: FaultRequest,
    /// Number of pings or records with an injection, and number of the last such ping.
    injected: AtomicU64,
    last_ping: AtomicU32,
}

/// State of a scheduled fault, for the status.
#[derive(Clone, Debug, Serialize)]
pub struct FaultStatus {
    /// Number of the fault in the log.
    pub fault: u32,
    /// Request that added the fault.
    #[serde(flatten)]
    pub request: FaultRequest,
    /// Start in rig time, ns since 1970 UTC; `None` before the first affected ping.
    pub from_utc_ns: Option<i64>,
    /// Pings or records into which it was injected.
    pub injected: u64,
    /// Number of the last of those pings; 0 before the first.
    pub last_ping: u32,
}

/// Properties of a sonar that limit the possible faults.
struct Head {
    name: Arc<str>,
    /// Number of elements of each receive array.
    elements: Vec<usize>,
    has_converter: bool,
}

/// All faults of a rig, shared by every thread that applies faults.
pub struct Faults {
    heads: Vec<Head>,
    /// Names of the navigation sources.
    pub sources: Vec<Arc<str>>,
    /// Per source: whether its bytes arrive while the rig runs.
    live_sources: Vec<bool>,
    /// Number of the last ping that was ordered.
    last_ping: AtomicU32,
    /// Rig time of the first ping, from which `at_s` counts.
    first: OnceLock<UtcNs>,
    scheduled: Mutex<Vec<Arc<ScheduledFault>>>,
    /// Length of `scheduled`, which avoids the lock for pings without faults.
    count: AtomicU64,
    next_id: AtomicU64,
    waiting: Mutex<VecDeque<Injection>>,
    injected: AtomicU64,
    unwritten: AtomicU64,
}

impl Faults {
    /// Creates an empty set of faults. `sonars` and `sources` are those of the rig, against which requests are checked.
    pub fn new(sonars: &[SonarSpec], sources: &[NavSourceSpec]) -> Self {
        let heads = sonars.iter().map(|sonar| Head {
            name: sonar.name.as_str().into(),
            elements: sonar.receive.iter().map(|a| a.elements).collect(),
            has_converter: sonar.receiver.adc_bits.is_some(),
        });
        Self {
            heads: heads.collect(),
            sources: sources.iter().map(|s| s.name.as_str().into()).collect(),
            live_sources: sources.iter().map(|s| is_live(&s.input)).collect(),
            last_ping: AtomicU32::new(0),
            first: OnceLock::new(),
            scheduled: Mutex::default(),
            count: AtomicU64::new(0),
            next_id: AtomicU64::new(1),
            waiting: Mutex::new(VecDeque::with_capacity(1024)),
            injected: AtomicU64::new(0),
            unwritten: AtomicU64::new(0),
        }
    }

    /// Adds a fault and returns its number in the log.
    ///
    /// # Errors
    /// The fault does not fit the rig, or too many faults are active.
    pub fn add(&self, request: &FaultRequest) -> Result<u32, FaultRefused> {
        let spec = request.checked()?;
        let refused = |key, rule: String| Err(FaultRefused { key, rule });
        let sonars: Vec<_> = self.heads.iter().map(|head| head.name.clone()).collect();
        let sonar = index_of("sonar", spec.sonar.as_deref(), &sonars)?;
        let source = index_of("source", spec.source.as_deref(), &self.sources)?;
        if let FaultKind::NavBytes(_) = spec.kind {
            let live = self.live_sources.iter().enumerate();
            let mut meant = live.filter(|(k, _)| source.is_none_or(|source| source == *k));
            if !meant.any(|(_, live)| *live) {
                let rule = "is a recording, which is decoded before the first ping: this fault needs a live source";
                return refused("source", rule.to_owned());
            }
        }
        if let FaultKind::Element { array, element, .. } = spec.kind {
            let heads = self.heads.iter().enumerate();
            let mut meant = heads.filter(|(k, _)| sonar.is_none_or(|sonar| sonar == *k));
            let fits = |elements: &[usize], wanted: usize| match array {
                Some(array) => elements.get(array).is_some_and(|&n| wanted < n),
                None => elements.iter().any(|&n| wanted < n),
            };
            let wanted = element.unwrap_or(0).max(request.other.unwrap_or(0));
            if !meant.clone().any(|(_, head)| fits(&head.elements, wanted)) {
                return refused("element", "there is no such element".to_owned());
            }
            let of_converter = request.kind.starts_with("adc-bit");
            if of_converter && !meant.any(|(_, head)| head.has_converter) {
                return refused("kind", "needs sonar.receiver.adc_bits".to_owned());
            }
        }
        let mut scheduled = self.lock();
        if scheduled.len() >= MAX_FAULTS {
            return refused("kind", format!("at most {MAX_FAULTS} faults at once"));
        }
        // The number of requests is far below 2^32.
        let id = self.next_id.fetch_add(1, Ordering::Relaxed) as u32;
        scheduled.push(Arc::new(ScheduledFault {
            id,
            spec,
            sonar,
            source,
            since: OnceLock::new(),
            request: request.clone(),
            injected: AtomicU64::new(0),
            last_ping: AtomicU32::new(0),
        }));
        self.count.store(scheduled.len() as u64, Ordering::Release);
        Ok(id)
    }

    /// Removes all faults. Returns how many were removed.
    pub fn clear(&self) -> usize {
        let mut scheduled = self.lock();
        let were = scheduled.len();
        scheduled.clear();
        self.count.store(0, Ordering::Release);
        were
    }

    /// Removes one fault. Returns whether a fault had this number.
    pub fn remove(&self, id: u32) -> bool {
        let mut scheduled = self.lock();
        let were = scheduled.len();
        scheduled.retain(|fault| fault.id != id);
        self.count.store(scheduled.len() as u64, Ordering::Release);
        scheduled.len() < were
    }

    /// All faults that were added and not removed, including pending and finished ones.
    pub fn list(&self) -> Vec<FaultStatus> {
        let first = self.first.get();
        let scheduled = self.lock();
        let list = scheduled.iter().map(|fault| {
            let from = match fault.spec.at_s {
                Some(at_s) => first.map(|first| first.plus_s(at_s)),
                None => fault.since.get().copied(),
            };
            FaultStatus {
                fault: fault.id,
                request: fault.request.clone(),
                from_utc_ns: from.map(|utc| utc.0),
                injected: fault.injected.load(Ordering::Relaxed),
                last_ping: fault.last_ping.load(Ordering::Relaxed),
            }
        });
        list.collect()
    }

    /// Number of faults that were added and not removed.
    pub fn scheduled(&self) -> usize {
        self.count.load(Ordering::Acquire) as usize
    }

    /// Number of injections since the start.
    pub fn injected(&self) -> u64 {
        self.injected.load(Ordering::Relaxed)
    }

    /// Number of injections without a line in the log.
    pub fn unwritten(&self) -> u64 {
        self.unwritten.load(Ordering::Relaxed)
    }

    /// Takes the injections since the last call.
    pub fn take_injections(&self) -> Vec<Injection> {
        let mut waiting = self.waiting.lock().unwrap_or_else(PoisonError::into_inner);
        waiting.drain(..).collect()
    }

    fn lock(&self) -> MutexGuard<'_, Vec<Arc<ScheduledFault>>> {
        self.scheduled
            .lock()
            .unwrap_or_else(PoisonError::into_inner)
    }

    /// Sets the instant from which `at_s` counts. Later calls have no effect.
    pub fn begin(&self, first: UtcNs) {
        self.first.get_or_init(|| first);
    }

    /// Calls `apply` with the strength of every fault that affects this ping.
    pub fn inject(
        &self,
        ping: PingMark,
        record_type: u32,
        wanted: impl Fn(&FaultKind) -> bool,
        mut apply: impl FnMut(&FaultSpec, f64, &mut Injection),
    ) {
        if self.scheduled() == 0 {
            return;
        }
        self.first.get_or_init(|| ping.utc);
        let point = InjectionPoint {
            utc: ping.utc,
            number: ping.number,
            key: record_type,
        };
        let meant = |fault: &ScheduledFault| {
            fault.sonar.is_none_or(|sonar| sonar == ping.sonar) && wanted(&fault.spec.kind)
        };
        self.for_each_active(point, meant, |fault, _, strength| {
            let mut injection = Injection {
                sonar: Some(self.heads[ping.sonar].name.clone()),
                ping_number: ping.number,
                record_type: (record_type != 0).then_some(record_type),
                ..self.injection(fault, point, strength)
            };
            apply(&fault.spec, strength, &mut injection);
            self.log(fault, injection);
        });
    }

    /// Calls `apply` for every fault that affects `point`, with its age, s, and its strength.
    pub fn for_each_active(
        &self,
        point: InjectionPoint,
        wanted: impl Fn(&ScheduledFault) -> bool,
        mut apply: impl FnMut(&ScheduledFault, f64, f64),
    ) {
        if self.scheduled() == 0 {
            return;
        }
        for fault in self.lock().iter().filter(|fault| wanted(fault)) {
            let spec = &fault.spec;
            let from = match (spec.at_s, self.first.get()) {
                (Some(at_s), Some(first)) => first.plus_s(at_s),
                // Before the first ping, `at_s` has no reference instant.
                (Some(_), None) => continue,
                (None, _) => *fault.since.get_or_init(|| point.utc),
            };
            let age_s = point.utc.seconds_since(from);
            let is_active = age_s >= 0.0 && age_s < spec.for_s;
            if !is_active || !begins(fault, point.number, point.key) {
                continue;
            }
            let strength = match spec.ramp_s > 0.0 {
                true => (age_s / spec.ramp_s).min(1.0),
                false => 1.0,
            };
            apply(fault, age_s, strength);
        }
    }

    /// Log entry for a fault that is injected at `point`. `strength` is from 0 to 1.
    pub fn injection(
        &self,
        fault: &ScheduledFault,
        point: InjectionPoint,
        strength: f64,
    ) -> Injection {
        Injection {
            fault: fault.id,
            kind: fault.spec.name,
            ping_number: self.last_ping.load(Ordering::Relaxed),
            utc_ns: point.utc.0,
            strength,
            ..Injection::default()
        }
    }

    /// Counts an injection and adds it to the log.
    pub fn log(&self, fault: &ScheduledFault, injection: Injection) {
        fault.injected.fetch_add(1, Ordering::Relaxed);
        fault
            .last_ping
            .store(injection.ping_number, Ordering::Relaxed);
        self.injected.fetch_add(1, Ordering::Relaxed);
        let mut waiting = self.waiting.lock().unwrap_or_else(PoisonError::into_inner);
        if waiting.len() < MAX_WAITING {
            waiting.push_back(injection);
        } else {
            self.unwritten.fetch_add(1, Ordering::Relaxed);
        }
    }

    /// Collects the element faults of this ping into `active`.
    pub fn elements(&self, ping: PingMark, active: &mut Vec<ActiveFault>) {
        active.clear();
        let of_elements = |kind: &FaultKind| matches!(kind, FaultKind::Element { .. });
        self.inject(ping, 0, of_elements, |spec, strength, injection| {
            if let FaultKind::Element {
                fault,
                array,
                element,
            } = spec.kind
            {
                (injection.array, injection.element) = (array, element);
                active.push(ActiveFault {
                    fault,
                    array,
                    element,
                    strength,
                    seed: spec.seed,
                });
            }
        });
    }

    /// Whether a fault suppresses the pulse of this ping.
    pub fn trigger_missed(&self, ping: PingMark) -> bool {
        self.last_ping.store(ping.number, Ordering::Relaxed);
        let mut missed = false;
        let of_trigger = |kind: &FaultKind| matches!(kind, FaultKind::TriggerMissed);
        self.inject(ping, 0, of_trigger, |_, _, _| missed = true);
        missed
    }

    /// Delay of an injected second trigger after the pulse, s; `None` without such a fault.
    pub fn trigger_double_s(&self, ping: PingMark) -> Option<f64> {
        let mut after_s = None;
        let of_trigger = |kind: &FaultKind| matches!(kind, FaultKind::TriggerDouble { .. });
        self.inject(ping, 0, of_trigger, |spec, _, _| {
            if let FaultKind::TriggerDouble { s } = spec.kind {
                after_s = Some(s);
            }
        });
        after_s
    }

    /// Error of the time stamp of this ping, s; positive is late.
    pub(crate) fn stamp_error_s(&self, ping: PingMark) -> f64 {
        let mut error_s = 0.0;
        let of_stamp = |kind: &FaultKind| matches!(kind, FaultKind::WrongSecond { .. });
        self.inject(ping, 0, of_stamp, |spec, strength, _| {
            if let FaultKind::WrongSecond { s } = spec.kind {
                error_s += s * strength;
            }
        });
        error_s
    }
}

/// Instant and random draw of a possible injection.
#[derive(Clone, Copy)]
pub struct InjectionPoint {
    /// Rig time.
    pub utc: UtcNs,
    /// Number of the ping, sample or second. Bursts count in these numbers.
    pub number: u32,
    /// Distinguishes several draws of the same number.
    pub key: u32,
}

impl InjectionPoint {
    /// A whole second, for faults of pulses per second.
    pub fn of_second(second: UtcNs) -> Self {
        Self {
            utc: second,
            // Seconds since 1970 fit until 2106.
            number: second.0.div_euclid(echotank_core::time::NS_PER_S) as u32,
            key: 0,
        }
    }
}

/// Index of `name` in `names`; `None` without a name.
fn index_of(
    key: &'static str,
    name: Option<&str>,
    names: &[Arc<str>],
) -> Result<Option<usize>, FaultRefused> {
    let Some(name) = name else {
        return Ok(None);
    };
    let at = names.iter().position(|known| **known == *name);
    at.map(Some).ok_or_else(|| FaultRefused {
        key,
        rule: format!("must be one of {}", names.join(", ")),
    })
}

fn is_live(input: &NavInputSpec) -> bool {
    !matches!(input, NavInputSpec::Log { .. } | NavInputSpec::Csv { .. })
}

/// Whether a fault affects a ping. The draw of this ping, or of a previous ping within a burst, is then below the probability.
fn begins(fault: &ScheduledFault, ping_number: u32, record_type: u32) -> bool {
    let spec = &fault.spec;
    if spec.probability >= 1.0 {
        return true;
    }
    (0..spec.burst)
        .take_while(|back| *back < ping_number)
        .any(|back| chance(fault, ping_number - back, record_type) < spec.probability)
}

fn chance(fault: &ScheduledFault, ping_number: u32, record_type: u32) -> f64 {
    unit(fault.spec.seed, fault.id, ping_number, record_type, TAG)
}

/// Uniform draw in [0, 1), a function of the arguments only.
pub fn unit(seed: u64, fault: u32, number: u32, place: u32, tag: [u8; 8]) -> f64 {
    let mut key = [0; 32];
    key[..8].copy_from_slice(&seed.to_le_bytes());
    key[8..12].copy_from_slice(&fault.to_le_bytes());
    key[12..16].copy_from_slice(&number.to_le_bytes());
    key[16..20].copy_from_slice(&place.to_le_bytes());
    key[24..].copy_from_slice(&tag);
    let draw = ChaCha8Rng::from_seed(key).next_u64() >> 11;
    draw as f64 / (1u64 << 53) as f64
}

#[cfg(test)]
mod tests {
    use super::*;

    fn faults() -> Faults {
        Faults {
            heads: vec![Head {
                name: "main".into(),
                elements: vec![8, 4],
                has_converter: false,
            }],
            sources: vec!["gnss".into(), "mru".into()],
            live_sources: vec![true, false],
            ..Faults::new(&[], &[])
        }
    }

    fn mark(number: u32) -> PingMark {
        PingMark {
            sonar: 0,
            number,
            utc: UtcNs(i64::from(number) * 100_000_000),
        }
    }

    fn request(json: &str) -> FaultRequest {
        serde_json::from_str(json).expect("JSON")
    }

    /// Ping number and strength of the faults in pings 1 to 100.
    fn strengths(json: &str) -> Vec<(u32, f64)> {
        let faults = faults();
        faults.begin(mark(1).utc);
        faults.add(&request(json)).expect("sound");
        let mut injected = Vec::new();
        let mut active = Vec::new();
        for number in 1..=100 {
            faults.elements(mark(number), &mut active);
            injected.extend(active.iter().map(|a| (number, a.strength)));
        }
        let log = faults.take_injections();
        let logged: Vec<_> = log.iter().map(|i| (i.ping_number, i.strength)).collect();
        assert_eq!(logged, injected, "every injection is logged");
        injected
    }

    #[test]
    fn a_timeline_begins_ends_and_grows_when_it_says() {
        let got = strengths(
            r#"{"kind": "gain", "value": -6, "element": 3, "at_s": 1, "for_s": 2, "ramp_s": 1}"#,
        );
        let numbers: Vec<_> = got.iter().map(|(number, _)| *number).collect();
        assert_eq!(numbers, (11..=30).collect::<Vec<_>>());
        for (number, strength) in got {
            let want = (f64::from(number - 11) * 0.1).min(1.0);
            assert!((strength - want).abs() < 1e-9, "{number}: {strength}");
        }
    }

    #[test]
    fn chance_is_that_of_the_probability_and_the_same_again() {
        let json = r#"{"kind": "dead", "element": 0, "probability": 0.3, "seed": 4}"#;
        let got = strengths(json);
        // 100 draws of 0.3: 30 with a standard deviation of 4.6.
        assert!((14..=46).contains(&got.len()), "{}", got.len());
        assert_eq!(got, strengths(json));
        let other = strengths(&json.replace('4', "5"));
        assert_ne!(got, other, "another seed strikes other pings");
    }

    #[test]
    fn a_burst_lasts_so_many_pings() {
        let one = strengths(r#"{"kind": "dead", "element": 0, "probability": 0.03, "seed": 1}"#);
        let long = strengths(
            r#"{"kind": "dead", "element": 0, "probability": 0.03, "seed": 1, "burst": 5}"#,
        );
        let mut want: Vec<u32> = one
            .iter()
            .flat_map(|(number, _)| *number..(*number + 5).min(101))
            .collect();
        want.dedup();
        want.sort_unstable();
        want.dedup();
        let got: Vec<_> = long.iter().map(|(number, _)| *number).collect();
        assert!(!got.is_empty());
        assert_eq!(got, want);
    }

    #[test]
    fn what_the_rig_does_not_have_is_refused() {
        let faults = faults();
        for (json, key) in [
            (r#"{"kind": "dead", "sonar": "other"}"#, "sonar"),
            (r#"{"kind": "dead", "element": 8}"#, "element"),
            (r#"{"kind": "dead", "array": 1, "element": 4}"#, "element"),
            (r#"{"kind": "dead", "array": 2}"#, "element"),
            (
                r#"{"kind": "crosstalk", "value": -20, "other": 8}"#,
                "element",
            ),
            (r#"{"kind": "adc-bit-stuck-low", "value": 3}"#, "kind"),
            (r#"{"kind": "nav-cut", "source": "mru"}"#, "source"),
        ] {
            let refused = faults.add(&request(json)).expect_err(json);
            assert_eq!(refused.key, key, "{json}: {refused}");
        }
        for _ in 0..MAX_FAULTS {
            faults.add(&request(r#"{"kind": "dead"}"#)).expect("room");
        }
        assert!(faults.add(&request(r#"{"kind": "dead"}"#)).is_err());
        let last = faults.list().last().map(|fault| fault.fault);
        assert_eq!(last, Some(MAX_FAULTS as u32));
        assert!(faults.remove(MAX_FAULTS as u32) && !faults.remove(MAX_FAULTS as u32));
        assert_eq!((faults.clear(), faults.scheduled()), (MAX_FAULTS - 1, 0));
    }
}

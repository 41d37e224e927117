//! Faults of navigation samples: missing, stuck, wrong or late samples.
//!
//! The faults alter decoded samples, as from a faulty sensor with correct sentences. [`super::nav_bytes`] alters the sentences. Each source and
//! quantity counts its own samples while any fault is active. Random draws depend only on that count.

use std::collections::VecDeque;
use std::sync::Arc;

use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::{Rng, SeedableRng};

use super::nav_bytes::NavByteFaults;
use echotank_config::spec::{FaultKind, NavChannel, NavFault, NavSourceSpec, TimePolicy};
use echotank_core::navigation::{NavQuantity, NavSample};
use echotank_core::time::UtcNs;
use echotank_nav::fault::NavFaultFilter;
use echotank_ping::faults::{Faults, InjectionPoint, ScheduledFault};

/// Mean radius of the earth, for offsets of latitude.
const MEAN_RADIUS_M: f64 = 6_371_000.0;
/// Maximum number of delayed samples; further samples are lost, as in a device with a full buffer.
const MAX_HELD: usize = 100_000;
/// Separates this random stream from all others.
const TAG: [u8; 8] = *b"faultnav";

/// Injects the navigation faults of all sources.
pub struct NavFaults {
    faults: Arc<Faults>,
    /// Per source: whether samples are valid at their arrival.
    by_arrival: Vec<bool>,
    channels: Vec<ChannelState>,
    /// Delayed samples with their new arrival, earliest first.
    held: VecDeque<(UtcNs, NavSample)>,
    bytes: NavByteFaults,
}

/// State of one quantity of one source.
struct ChannelState {
    source: u16,
    channel: NavChannel,
    samples: u32,
    /// Value repeated by a stuck channel.
    stuck: Option<NavQuantity>,
}

impl NavFaults {
    /// Creates an injector of `faults` for `sources`, in the order of their indices.
    pub fn new(faults: Arc<Faults>, sources: &[NavSourceSpec]) -> Self {
        let by_arrival = |s: &NavSourceSpec| matches!(s.time, TimePolicy::Arrival { .. });
        Self {
            by_arrival: sources.iter().map(by_arrival).collect(),
            channels: Vec::new(),
            held: VecDeque::new(),
            bytes: NavByteFaults::new(faults.clone(), sources.len()),
            faults,
        }
    }

    fn channel(&mut self, source: u16, channel: NavChannel) -> &mut ChannelState {
        let same = |state: &ChannelState| state.source == source && state.channel == channel;
        let at = self.channels.iter().position(same).unwrap_or_else(|| {
            self.channels.push(ChannelState {
                source,
                channel,
                samples: 0,
                stuck: None,
            });
            self.channels.len() - 1
        });
        &mut self.channels[at]
    }

    /// Delays a sample by `late_s`.
    fn hold(&mut self, mut sample: NavSample, late_s: f64) {
        let by_arrival = self.by_arrival.get(usize::from(sample.source));
        if by_arrival == Some(&true) {
            sample.valid_utc = sample.valid_utc.plus_s(late_s);
        }
        sample.arrival_utc = sample.arrival_utc.plus_s(late_s);
        if self.held.len() < MAX_HELD {
            let due = sample.arrival_utc;
            let at = self.held.partition_point(|(other, _)| *other <= due);
            self.held.insert(at, (due, sample));
        }
    }
}

/// Channel of a quantity, and its name in the log.
fn channel_of(quantity: &NavQuantity) -> (NavChannel, &'static str) {
    match quantity {
        NavQuantity::Position { .. } | NavQuantity::LocalPosition { .. } => {
            (NavChannel::Position, "position")
        }
        NavQuantity::CourseSpeed { .. } => (NavChannel::CourseSpeed, "course-speed"),
        NavQuantity::Heading { .. } => (NavChannel::Heading, "heading"),
        NavQuantity::RollPitch { .. } => (NavChannel::RollPitch, "roll-pitch"),
        NavQuantity::Heave { .. } => (NavChannel::Heave, "heave"),
        NavQuantity::Depth { .. } => (NavChannel::Depth, "depth"),
    }
}

impl NavFaultFilter for NavFaults {
    fn modify_bytes(&mut self, source: usize, arrival: UtcNs, bytes: &mut Vec<u8>) {
        self.bytes.inject(source, arrival, bytes);
    }

    fn modify_sample(&mut self, sample: NavSample) -> Option<NavSample> {
        if self.faults.scheduled() == 0 {
            self.channels.clear();
            return Some(sample);
        }
        let (channel, name) = channel_of(&sample.quantity);
        let source = usize::from(sample.source);
        let faults = Arc::clone(&self.faults);
        let state = self.channel(sample.source, channel);
        state.samples += 1;
        let point = InjectionPoint {
            utc: sample.arrival_utc,
            number: state.samples,
            key: u32::from(sample.source) << 8 | channel as u32,
        };
        let (mut passes, mut late_s, mut is_stuck) = (true, 0.0, false);
        let mut altered = sample;
        let wanted = |scheduled: &ScheduledFault| match scheduled.spec.kind {
            FaultKind::Nav { quantity, .. } => {
                scheduled.source.is_none_or(|wanted| wanted == source)
                    && quantity.is_none_or(|wanted| wanted == channel)
            }
            _ => false,
        };
        faults.for_each_active(point, wanted, |scheduled, age_s, strength| {
            let FaultKind::Nav { fault, .. } = scheduled.spec.kind else {
                return;
            };
            match fault {
                NavFault::Off => passes = false,
                NavFault::Stuck => {
                    is_stuck = true;
                    altered.quantity = *state.stuck.get_or_insert(altered.quantity);
                }
                NavFault::Garbage => altered.quantity = garbage(altered.quantity, scheduled, point),
                NavFault::Wrong { by } => {
                    altered.quantity = offset(altered.quantity, by * strength)
                }
                NavFault::Slow { one_in } if state.samples.is_multiple_of(one_in) => return,
                NavFault::Slow { .. } => passes = false,
                NavFault::Delayed { s } => late_s += s * strength,
                NavFault::Intermittent { s } if (age_s / s) as u64 % 2 == 1 => return,
                NavFault::Intermittent { .. } => passes = false,
            }
            let mut injection = faults.injection(scheduled, point, strength);
            injection.source = faults.sources.get(source).cloned();
            injection.quantity = Some(name);
            faults.log(scheduled, injection);
        });
        if !is_stuck {
            state.stuck = None;
        }
        match (passes, late_s == 0.0) {
            (false, _) => None,
            (true, true) => Some(altered),
            (true, false) => {
                self.hold(altered, late_s);
                None
            }
        }
    }

    fn take_delayed(&mut self, until: UtcNs) -> Option<NavSample> {
        let due = self.held.front().is_some_and(|(due, _)| *due <= until);
        let (_, sample) = due.then(|| self.held.pop_front()).flatten()?;
        Some(sample)
    }
}

/// Adds `by` to a quantity, in metres (positions: to the north), metres per second or radians.
fn offset(quantity: NavQuantity, by: f64) -> NavQuantity {
    let mut offset = quantity;
    match &mut offset {
        NavQuantity::Position { latitude_rad, .. } => *latitude_rad += by / MEAN_RADIUS_M,
        NavQuantity::LocalPosition { north_m, .. } => *north_m += by,
        NavQuantity::CourseSpeed { speed_m_per_s, .. } => *speed_m_per_s += by,
        NavQuantity::Heading { heading_rad } => {
            *heading_rad = (*heading_rad + by).rem_euclid(std::f64::consts::TAU);
        }
        NavQuantity::RollPitch {
            roll_rad,
            pitch_rad,
        } => (*roll_rad, *pitch_rad) = (*roll_rad + by, *pitch_rad + by),
        NavQuantity::Heave { heave_down_m } => *heave_down_m += by,
        NavQuantity::Depth { depth_m } => *depth_m += by,
    }
    offset
}

/// Uniform random value in the range of the quantity.
fn garbage(
    quantity: NavQuantity,
    scheduled: &ScheduledFault,
    point: InjectionPoint,
) -> NavQuantity {
    use std::f64::consts::{FRAC_PI_2, PI, TAU};
    let mut key = [0; 32];
    key[..8].copy_from_slice(&scheduled.spec.seed.to_le_bytes());
    key[8..12].copy_from_slice(&scheduled.id.to_le_bytes());
    key[12..16].copy_from_slice(&point.number.to_le_bytes());
    key[16..20].copy_from_slice(&point.key.to_le_bytes());
    key[24..].copy_from_slice(&TAG);
    let mut rng = ChaCha8Rng::from_seed(key);
    let mut within = |max: f64| {
        let unit = (rng.next_u64() >> 11) as f64 / (1u64 << 53) as f64;
        (2.0 * unit - 1.0) * max
    };
    match quantity {
        NavQuantity::Position { fix, .. } => NavQuantity::Position {
            latitude_rad: within(FRAC_PI_2),
            longitude_rad: within(PI),
            height_m: Some(within(10_000.0)),
            fix,
        },
        NavQuantity::LocalPosition { .. } => NavQuantity::LocalPosition {
            north_m: within(1e5),
            east_m: within(1e5),
            down_m: within(1e4),
        },
        NavQuantity::CourseSpeed { .. } => NavQuantity::CourseSpeed {
            course_rad: within(PI).rem_euclid(TAU),
            speed_m_per_s: within(50.0).abs(),
        },
        NavQuantity::Heading { .. } => NavQuantity::Heading {
            heading_rad: within(PI).rem_euclid(TAU),
        },
        NavQuantity::RollPitch { .. } => NavQuantity::RollPitch {
            roll_rad: within(PI),
            pitch_rad: within(FRAC_PI_2),
        },
        NavQuantity::Heave { .. } => NavQuantity::Heave {
            heave_down_m: within(20.0),
        },
        NavQuantity::Depth { .. } => NavQuantity::Depth {
            depth_m: within(1e4).abs(),
        },
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use echotank_config::spec::FaultRequest;

    const MS: i64 = 1_000_000;

    /// Sends a hundred headings of the first source, 10 ms apart; heading k is k degrees. Returns the arrival (ms) and value (degrees) of the
    /// headings that pass.
    fn passed(json: &str) -> Vec<(i64, f64)> {
        let faults = Arc::new(super::super::testing::faults());
        faults.begin(UtcNs(0));
        let request: FaultRequest = serde_json::from_str(json).expect("JSON");
        faults.add(&request).expect("sound");
        let mut nav_faults = NavFaults::new(faults.clone(), &[]);
        let mut came = Vec::new();
        let mut note = |sample: NavSample| {
            let NavQuantity::Heading { heading_rad } = sample.quantity else {
                panic!("a heading");
            };
            came.push((sample.arrival_utc.0 / MS, heading_rad.to_degrees()));
        };
        let mut injected = 0;
        for k in 0..100 {
            let at = UtcNs(k * 10 * MS);
            while let Some(sample) = nav_faults.take_delayed(at) {
                note(sample);
            }
            let sample = NavSample {
                source: 0,
                valid_utc: at,
                arrival_utc: at,
                quantity: NavQuantity::Heading {
                    heading_rad: (k as f64).to_radians(),
                },
            };
            match nav_faults.modify_sample(sample) {
                Some(same) if same == sample => note(same),
                Some(other) => {
                    injected += 1;
                    note(other);
                }
                None => injected += 1,
            }
        }
        let log = faults.take_injections();
        assert!(log.len() >= injected, "{} of {injected}", log.len());
        assert!(
            log.iter()
                .all(|i| i.source.as_deref() == Some("gnss") && i.quantity == Some("heading"))
        );
        came
    }

    fn numbers(came: &[(i64, f64)]) -> Vec<i64> {
        came.iter().map(|(_, deg)| deg.round() as i64).collect()
    }

    #[test]
    fn a_source_that_is_off_slow_or_intermittent_sends_fewer_samples() {
        let off = passed(r#"{"kind": "nav-off", "at_s": 0.2, "for_s": 0.5}"#);
        assert_eq!(numbers(&off), (0..20).chain(70..100).collect::<Vec<_>>());
        let slow = passed(r#"{"kind": "nav-slow", "value": 10, "source": "gnss"}"#);
        assert_eq!(
            numbers(&slow),
            (0..10).map(|k| 10 * k + 9).collect::<Vec<_>>()
        );
        let now_and_then = passed(r#"{"kind": "nav-intermittent", "value": 250}"#);
        assert_eq!(
            numbers(&now_and_then),
            (25..50).chain(75..100).collect::<Vec<_>>()
        );
        let other = passed(r#"{"kind": "nav-off", "source": "mru"}"#);
        assert_eq!(other.len(), 100, "another source");
        let other = passed(r#"{"kind": "nav-off", "quantity": "heave"}"#);
        assert_eq!(other.len(), 100, "another quantity");
    }

    #[test]
    fn a_source_that_is_stuck_wrong_or_sends_garbage_keeps_its_rate() {
        let stuck = passed(r#"{"kind": "nav-stuck", "at_s": 0.3, "for_s": 0.2}"#);
        let want = (0..30).chain([30; 20]).chain(50..100);
        assert_eq!(numbers(&stuck), want.collect::<Vec<_>>());
        let wrong = passed(
            r#"{"kind": "nav-wrong", "quantity": "heading", "value": -3, "at_s": 0.5, "ramp_s": 0.3}"#,
        );
        for (k, (_, deg)) in wrong.iter().enumerate() {
            let grown = ((k as f64 * 0.01 - 0.5) / 0.3).clamp(0.0, 1.0);
            let want = (k as f64 - 3.0 * grown).rem_euclid(360.0);
            assert!((deg - want).abs() < 1e-9, "{k}: {deg} {want}");
        }
        let json = r#"{"kind": "nav-garbage", "seed": 4}"#;
        let garbage = passed(json);
        assert_eq!(garbage, passed(json), "the same again");
        let far = garbage.iter().enumerate();
        let far = far.filter(|(k, (_, deg))| (deg - *k as f64).abs() > 5.0);
        assert!(far.count() > 80 && garbage.len() == 100);
        assert!(garbage.iter().all(|(_, deg)| (0.0..360.0).contains(deg)));
    }

    #[test]
    fn a_delayed_source_sends_the_same_samples_later_and_loses_none() {
        let late = passed(r#"{"kind": "nav-delayed", "value": 45, "for_s": 0.6}"#);
        // Samples after the fault overtake the last five delayed ones.
        let mut got = numbers(&late);
        let arrivals: Vec<_> = late.iter().map(|(ms, _)| *ms).collect();
        let firsts: Vec<_> = late[..50]
            .iter()
            .map(|(ms, deg)| ms - 10 * deg.round() as i64)
            .collect();
        assert!(firsts.iter().all(|ms| *ms == 45), "{firsts:?}");
        got.sort_unstable();
        assert_eq!(got, (0..100).collect::<Vec<_>>(), "{arrivals:?}");
    }
}

//! One source's bytes to samples: framing, checksum policy, time policy, and which sentence speaks for which quantity.

use super::framing::{Checksum, Framing, RawSentence};
use super::message_time::{MessageClock, Stamp};
use super::sentence::{Kind, Reading, Refusal, decode};
use crate::config::spec::{ChecksumPolicy, NavChannel, NavSourceSpec, TimePolicy};
use crate::flow::{NavQuantity, NavSample};
use crate::time::{NS_PER_S, UtcNs};

/// A lesser sentence speaks for a quantity only after the better one has been silent this long.
const SILENCE_NS: i64 = 5 * NS_PER_S;

/// What a source sent. Every sentence is counted in exactly one of `used`, `refused_checksum`, `malformed`, `unsupported`,
/// `empty_fields`, `not_taken` and `time_jumps`; `bad_checksum` and `missing_checksum` count what was seen, refused or not.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct NavCounters {
    pub bytes: u64,
    pub sentences: u64,
    pub used: u64,
    pub refused_checksum: u64,
    pub malformed: u64,
    pub unsupported: u64,
    /// Known sentences with nothing in them: no fix, empty fields.
    pub empty_fields: u64,
    /// Good sentences that give nothing this source provides, or whose quantities come from a better sentence.
    pub not_taken: u64,
    /// Message time not believed.
    pub time_jumps: u64,
    pub bad_checksum: u64,
    pub missing_checksum: u64,
    pub resync_bytes: u64,
    /// Sentences without a time that found none in their burst and took their arrival.
    pub undated: u64,
    pub samples: u64,
}

/// Which sentence last spoke for a channel.
#[derive(Clone, Copy, Debug)]
struct Speaker {
    rank: u8,
    arrival: UtcNs,
}

pub struct NavDecoder {
    framing: Framing,
    reader: Reader,
}

/// Everything behind the framing.
struct Reader {
    source: u16,
    time: TimePolicy,
    checksum: ChecksumPolicy,
    provides: Vec<NavChannel>,
    clock: MessageClock,
    speakers: [Option<Speaker>; 5],
    scratch: String,
    counters: NavCounters,
}

impl NavDecoder {
    /// `source` is the index of `spec` in `NavSpec::sources`.
    pub fn new(source: u16, spec: &NavSourceSpec) -> Self {
        Self {
            framing: Framing::new(),
            reader: Reader {
                source,
                time: spec.time,
                checksum: spec.checksum,
                provides: spec.provides.clone(),
                clock: MessageClock::default(),
                speakers: [None; 5],
                scratch: String::new(),
                counters: NavCounters::default(),
            },
        }
    }

    /// Decodes bytes, cut anywhere, of which the first arrived at `arrival` (rig time); samples are appended to `out`.
    pub fn push(&mut self, mut bytes: &[u8], arrival: UtcNs, out: &mut Vec<NavSample>) {
        self.reader.counters.bytes += bytes.len() as u64;
        while let Some(sentence) = self.framing.next(&mut bytes, arrival) {
            self.reader.take(&sentence, out);
        }
        self.reader.counters.resync_bytes = self.framing.resync_bytes();
    }

    /// A datagram or a file ends here: a sentence still open ends too.
    pub fn flush(&mut self, out: &mut Vec<NavSample>) {
        if let Some(sentence) = self.framing.flush() {
            self.reader.take(&sentence, out);
        }
        self.reader.counters.resync_bytes = self.framing.resync_bytes();
    }

    pub fn counters(&self) -> &NavCounters {
        &self.reader.counters
    }

    /// The last believed message time and its arrival.
    pub fn last_message_time(&self) -> Option<(UtcNs, UtcNs)> {
        self.reader.clock.last()
    }

    /// A full date (ZDA, RMC) has been seen; until then message times lean on the arrival's date.
    pub fn is_dated(&self) -> bool {
        self.reader.clock.is_dated()
    }
}

impl Reader {
    fn take(&mut self, sentence: &RawSentence, out: &mut Vec<NavSample>) {
        let arrival = sentence.arrival;
        self.clock.arrived(arrival);
        self.counters.sentences += 1;
        if !self.checksum_allows(sentence.checksum) {
            self.counters.refused_checksum += 1;
            return;
        }
        let reading = match decode(sentence.body, &mut self.scratch) {
            Ok(reading) => reading,
            Err(Refusal::Unsupported) => {
                self.counters.unsupported += 1;
                return;
            }
            Err(Refusal::Malformed) => {
                self.counters.malformed += 1;
                return;
            }
        };
        if reading.is_empty() {
            self.counters.empty_fields += 1;
            return;
        }
        let stamp = self.clock.stamp(&reading, arrival);
        if stamp == Stamp::Jumped {
            self.counters.time_jumps += 1;
            return;
        }
        let before = out.len();
        self.emit(&reading, stamp, arrival, out);
        let emitted = (out.len() - before) as u64;
        let counters = &mut self.counters;
        counters.samples += emitted;
        if emitted > 0 || reading.kind == Kind::Zda {
            counters.used += 1;
        } else {
            counters.not_taken += 1;
        }
    }

    fn checksum_allows(&mut self, checksum: Checksum) -> bool {
        match checksum {
            Checksum::Right => true,
            Checksum::Wrong => {
                self.counters.bad_checksum += 1;
                self.checksum == ChecksumPolicy::Ignore
            }
            Checksum::Missing => {
                self.counters.missing_checksum += 1;
                self.checksum != ChecksumPolicy::Require
            }
        }
    }

    fn emit(&mut self, r: &Reading, stamp: Stamp, arrival: UtcNs, out: &mut Vec<NavSample>) {
        let position = r
            .position_rad
            .map(|(latitude_rad, longitude_rad)| NavQuantity::Position {
                latitude_rad,
                longitude_rad,
                height_m: r.height_m,
                fix: r.fix,
            });
        let course = r
            .course_speed
            .map(|(course_rad, speed_m_per_s)| NavQuantity::CourseSpeed {
                course_rad,
                speed_m_per_s,
            });
        let heading = r
            .heading_rad
            .map(|heading_rad| NavQuantity::Heading { heading_rad });
        let roll_pitch = r
            .roll_pitch_rad
            .map(|(roll_rad, pitch_rad)| NavQuantity::RollPitch {
                roll_rad,
                pitch_rad,
            });
        let heave = r
            .heave_down_m
            .map(|heave_down_m| NavQuantity::Heave { heave_down_m });
        let candidates = [
            (NavChannel::Position, position),
            (NavChannel::CourseSpeed, course),
            (NavChannel::Heading, heading),
            (NavChannel::RollPitch, roll_pitch),
            (NavChannel::Heave, heave),
        ];
        let mut valid = None;
        for (i, (channel, quantity)) in candidates.into_iter().enumerate() {
            let Some(quantity) = quantity else { continue };
            if !self.provides.contains(&channel) || !self.speaks(i, rank(r.kind), arrival) {
                continue;
            }
            let valid_utc = *valid.get_or_insert_with(|| self.validity(stamp, arrival));
            out.push(NavSample {
                source: self.source,
                valid_utc,
                arrival_utc: arrival,
                quantity,
            });
        }
    }

    fn validity(&mut self, stamp: Stamp, arrival: UtcNs) -> UtcNs {
        match (self.time, stamp) {
            (TimePolicy::Arrival { latency_s }, _) => arrival.plus_s(-latency_s),
            (_, Stamp::At(message)) => message,
            (TimePolicy::Burst, _) if self.clock.burst().is_some() => {
                self.clock.burst().unwrap_or(arrival)
            }
            (TimePolicy::Burst | TimePolicy::Message, _) => {
                self.counters.undated += 1;
                arrival
            }
        }
    }

    /// Two sentences of one source that say the same thing may hold at different times; mixing them would shake the track, so the
    /// better one has the word as long as it comes.
    fn speaks(&mut self, channel: usize, rank: u8, arrival: UtcNs) -> bool {
        let speaker = &mut self.speakers[channel];
        let outranked = speaker
            .is_some_and(|s| s.rank > rank && arrival.0.saturating_sub(s.arrival.0) < SILENCE_NS);
        if !outranked {
            *speaker = Some(Speaker { rank, arrival });
        }
        !outranked
    }
}

/// Own time beats borrowed time; GGA has height and quality, which RMC lacks.
fn rank(kind: Kind) -> u8 {
    match kind {
        Kind::Gga | Kind::Pashr => 3,
        Kind::Rmc | Kind::Psxn23 => 2,
        Kind::Vtg | Kind::Hdt => 1,
        Kind::Zda => 0,
    }
}

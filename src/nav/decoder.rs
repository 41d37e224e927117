//! Decodes the bytes of one source to samples. The stages are framing, checksum policy, time policy, and the choice of a sentence
//! for each quantity.

use super::framing::{Checksum, Framing, RawSentence};
pub use super::message_time::ClockState;
use super::message_time::{MessageClock, Stamp};
use super::reading::{DecodeError, Decoded, InvalidQuantities, Reading};
use super::records::{Record, Records};
use super::sentence::decode;
use echotank_config::spec::{ChecksumPolicy, NavChannel, NavDialect, NavSourceSpec, TimePolicy};
use echotank_core::navigation::{NavQuantity, NavSample};
use echotank_core::time::{NS_PER_S, UtcNs};

/// Time without a higher-ranked sentence after which a lower-ranked sentence provides its quantity.
const SILENCE_NS: i64 = 5 * NS_PER_S;

/// Maximum number of untimed sentence names per source that take the time of a burst. About fifteen untimed sentences exist.
const MAX_UNTIMED: usize = 32;

/// Maximum number of clock events between two calls of [`NavDecoder::take_clock_events`].
pub const MAX_CLOCK_EVENTS: usize = 1000;

/// Counters of one source. Every sentence counts in exactly one of `used`, `refused_checksum`, `malformed`, `unsupported`,
/// `empty_fields`, `not_taken` and `time_jumps`. `bad_checksum` and `missing_checksum` also count accepted sentences.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct NavCounters {
    /// Bytes received.
    pub bytes: u64,
    /// Sentences and records found.
    pub sentences: u64,
    /// Sentences that gave a sample, a time or a quality.
    pub used: u64,
    /// Sentences that the checksum policy refuses.
    pub refused_checksum: u64,
    /// Known sentences with invalid fields.
    pub malformed: u64,
    /// Sentences that have no decoder.
    pub unsupported: u64,
    /// Known sentences without values: the receiver has no fix, or the fields are empty.
    pub empty_fields: u64,
    /// Valid sentences whose quantities are not wanted from this source or come from a higher-ranked sentence.
    pub not_taken: u64,
    /// Sentences with values that the instrument flags as invalid (PSXN,20).
    pub flagged_invalid: u64,
    /// Message times corrected by a multiple of 1024 GPS weeks to match the arrival date.
    pub week_rollovers: u64,
    /// Sentences rejected because of a jump of their time.
    pub time_jumps: u64,
    /// Changes of the state of the source's clock: jumps, corrections and returns to the arrival time.
    pub clock_changes: u64,
    /// Current correction of the message times of the source, seconds.
    pub corrected_by_s: i64,
    /// Sentences with a wrong checksum.
    pub bad_checksum: u64,
    /// Sentences without a checksum.
    pub missing_checksum: u64,
    /// Bytes outside any sentence and record.
    pub resync_bytes: u64,
    /// Untimed sentences without a burst. Their time of validity is the arrival.
    pub undated: u64,
    /// Samples produced.
    pub samples: u64,
}

/// Change of the state of a source's clock.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ClockEvent {
    /// Arrival of the sentence that shows the change.
    pub arrival: UtcNs,
    /// The new state.
    pub state: ClockState,
}

/// Result of decoding one sentence, named like the counters of [`NavCounters`].
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub enum Outcome {
    /// The sentence gave a sample, a time or a quality.
    Used,
    /// The checksum policy refuses the sentence.
    RefusedChecksum,
    /// A field is invalid.
    Malformed,
    /// The sentence has no decoder.
    Unsupported,
    /// The sentence holds no values.
    EmptyFields,
    /// The configuration does not select the quantities, or a higher-ranked sentence provides them.
    NotTaken,
    /// The time of the sentence jumps.
    TimeJump,
}

/// One sentence or record and its result, for reports.
#[derive(Clone, Copy, Debug)]
pub struct SentenceEvent<'a> {
    /// Address of the sentence, followed by the next field for proprietary sentences: `INGGA`, `PSXN,23`.
    pub name: &'a str,
    /// Result of decoding.
    pub outcome: Outcome,
    /// Result of the checksum test.
    pub checksum: Checksum,
    /// Arrival of the first byte.
    pub arrival: UtcNs,
    /// Message time.
    pub(crate) message_utc: Option<UtcNs>,
    /// Quantities taken from the sentence, one bit per [`NavChannel`].
    pub taken: u8,
    /// Quantities that a higher-ranked sentence of this source provides, one bit per [`NavChannel`].
    pub outranked: u8,
    /// Quantities that the configuration does not select from this source, one bit per [`NavChannel`].
    pub(crate) unwanted: u8,
    /// Decoded values, if the sentence decodes and its time is accepted.
    pub reading: Option<&'a Reading>,
}

/// The sentence that provides a channel.
#[derive(Clone, Copy, Debug)]
struct ActiveSentence {
    rank: u8,
    /// Hash of the sentence name. The name includes the talker, so sentences of two talkers are not mixed.
    name: u64,
    arrival: UtcNs,
}

/// An untimed sentence and the burst whose time it last took.
#[derive(Clone, Copy, Debug)]
struct UntimedSentence {
    name: u64,
    burst: UtcNs,
    /// True after the sentence occurred twice in one burst: its rate is independent of the bursts.
    independent: bool,
}

enum Finder {
    Sentences(Framing),
    Records(Records),
}

/// Decodes the byte stream of one source to samples.
pub struct NavDecoder {
    finder: Finder,
    reader: Reader,
}

/// Decoder stages after the framing.
struct Reader {
    source: u16,
    time: TimePolicy,
    checksum: ChecksumPolicy,
    dialect: NavDialect,
    provides: Vec<NavChannel>,
    clock: MessageClock,
    active: [Option<ActiveSentence>; NavChannel::ALL.len()],
    untimed: Vec<UntimedSentence>,
    /// Changes of the clock since the last call of [`NavDecoder::take_clock_events`].
    clock_events: Vec<ClockEvent>,
    clock_state: ClockState,
    /// Quality flags of the last PSXN,20.
    invalid: InvalidQuantities,
    scratch: String,
    counters: NavCounters,
}

/// A `watch` callback that does nothing.
pub fn ignore_events(_: &SentenceEvent) {}

impl NavDecoder {
    /// Decoder of the source that `spec` describes; `source` is the index of the source in the configuration.
    pub fn new(source: u16, spec: &NavSourceSpec) -> Self {
        let finder = match Records::new(spec.dialect.format) {
            Some(records) => Finder::Records(records),
            None => Finder::Sentences(Framing::new()),
        };
        Self {
            finder,
            reader: Reader {
                source,
                time: spec.time,
                checksum: spec.checksum,
                dialect: spec.dialect.clone(),
                provides: spec.provides.clone(),
                clock: MessageClock::default(),
                active: [None; NavChannel::ALL.len()],
                untimed: Vec::with_capacity(MAX_UNTIMED),
                clock_events: Vec::new(),
                clock_state: ClockState::Right,
                invalid: InvalidQuantities::default(),
                scratch: String::new(),
                counters: NavCounters::default(),
            },
        }
    }

    /// Decodes the next bytes of the stream and appends samples to `out`. `arrival` is the rig time of the first byte.
    pub fn push(&mut self, bytes: &[u8], arrival: UtcNs, out: &mut Vec<NavSample>) {
        self.push_paced(bytes, arrival, 0, out, &mut ignore_events);
    }

    /// Like [`Self::push`], with `byte_ns` nanoseconds between bytes on the link. The arrival of a sentence is that of its first
    /// byte. Calls `watch` for every sentence.
    pub fn push_paced(
        &mut self,
        bytes: &[u8],
        arrival: UtcNs,
        byte_ns: i64,
        out: &mut Vec<NavSample>,
        watch: &mut impl FnMut(&SentenceEvent),
    ) {
        let reader = &mut self.reader;
        reader.counters.bytes += bytes.len() as u64;
        let mut left = bytes;
        let mut now = arrival;
        let at = |left: &[u8]| arrival.plus_ns((bytes.len() - left.len()) as i64 * byte_ns);
        match &mut self.finder {
            Finder::Sentences(framing) => {
                while let Some(s) = framing.next(&mut left, now, byte_ns) {
                    reader.take(&s, out, watch);
                    now = at(left);
                }
                reader.counters.resync_bytes = framing.resync_bytes();
            }
            Finder::Records(records) => {
                let name = reader.dialect.format.name();
                while let Some(r) = records.next(&mut left, now, byte_ns) {
                    reader.take_record(name, &r, out, watch);
                    now = at(left);
                }
                reader.counters.resync_bytes = records.resync_bytes();
            }
        }
    }

    /// Ends a datagram or file. An open sentence counts as complete.
    pub fn flush(&mut self, out: &mut Vec<NavSample>) {
        self.flush_watched(out, &mut ignore_events);
    }

    pub(crate) fn flush_watched(
        &mut self,
        out: &mut Vec<NavSample>,
        watch: &mut impl FnMut(&SentenceEvent),
    ) {
        match &mut self.finder {
            Finder::Sentences(framing) => {
                if let Some(sentence) = framing.flush() {
                    self.reader.take(&sentence, out, watch);
                }
                self.reader.counters.resync_bytes = framing.resync_bytes();
            }
            Finder::Records(records) => {
                records.flush();
                self.reader.counters.resync_bytes = records.resync_bytes();
            }
        }
    }

    /// Accepts a message that another module has framed and decoded (MAVLink).
    pub(crate) fn push_record(
        &mut self,
        name: &str,
        record: &Record,
        out: &mut Vec<NavSample>,
        watch: &mut impl FnMut(&SentenceEvent),
    ) {
        self.reader.take_record(name, record, out, watch);
    }

    /// Adds bytes that another module has framed to the counters.
    pub(crate) fn count_bytes(&mut self, bytes: u64, resync_bytes: u64) {
        self.reader.counters.bytes += bytes;
        self.reader.counters.resync_bytes += resync_bytes;
    }

    /// Shifts the stored arrivals by `by_ns`, because later arrivals have moved by as much (a log without stamps whose clock
    /// steps).
    pub(crate) fn arrivals_moved(&mut self, by_ns: i64) {
        self.reader.clock.arrivals_moved(by_ns);
    }

    /// Accepts dates without comparison to the arrivals, for a log whose arrivals are not clock time (no stamps).
    pub(crate) fn ignore_arrival_dates(&mut self) {
        self.reader.clock.ignore_arrival_dates();
    }

    /// Counters since the construction of the decoder.
    pub fn counters(&self) -> &NavCounters {
        &self.reader.counters
    }

    /// Removes and returns the changes of the source's clock since the last call, at most [`MAX_CLOCK_EVENTS`].
    pub fn take_clock_events(&mut self) -> Vec<ClockEvent> {
        std::mem::take(&mut self.reader.clock_events)
    }

    /// The last accepted message time and its arrival.
    pub fn last_message_time(&self) -> Option<(UtcNs, UtcNs)> {
        self.reader.clock.last()
    }

    /// Whether a full date (ZDA, RMC) has been received. Without a date, the date of the arrival is used.
    pub fn is_dated(&self) -> bool {
        self.reader.clock.is_dated()
    }
}

impl Reader {
    fn begin(&mut self, arrival: UtcNs) {
        self.clock.arrived(arrival);
        self.counters.sentences += 1;
    }

    fn take(
        &mut self,
        sentence: &RawSentence,
        out: &mut Vec<NavSample>,
        watch: &mut impl FnMut(&SentenceEvent),
    ) {
        self.begin(sentence.arrival);
        let decoded = match self.checksum_allows(sentence) {
            true => Some(decode(sentence.body, &self.dialect, &mut self.scratch)),
            false => None,
        };
        let (name, checksum, arrival) =
            (name_of(sentence.body), sentence.checksum, sentence.arrival);
        match decoded {
            Some(decoded) => self.finish(name, decoded, checksum, arrival, out, watch),
            None => {
                self.counters.refused_checksum += 1;
                watch(&SentenceEvent::new(
                    name,
                    Outcome::RefusedChecksum,
                    checksum,
                    arrival,
                ));
            }
        }
    }

    fn take_record(
        &mut self,
        name: &str,
        record: &Record,
        out: &mut Vec<NavSample>,
        watch: &mut impl FnMut(&SentenceEvent),
    ) {
        self.begin(record.arrival);
        let arrival = record.arrival;
        if record.checksum == Checksum::Wrong {
            self.counters.bad_checksum += 1;
            self.counters.refused_checksum += 1;
            watch(&SentenceEvent::new(
                name,
                Outcome::RefusedChecksum,
                record.checksum,
                arrival,
            ));
            return;
        }
        self.finish(name, record.reading, record.checksum, arrival, out, watch);
    }

    fn finish(
        &mut self,
        name: &str,
        decoded: Decoded,
        checksum: Checksum,
        arrival: UtcNs,
        out: &mut Vec<NavSample>,
        watch: &mut impl FnMut(&SentenceEvent),
    ) {
        let mut event = SentenceEvent::new(name, Outcome::Malformed, checksum, arrival);
        let mut reading = match decoded {
            Ok(reading) => reading,
            Err(refusal) => {
                event.outcome = match refusal {
                    DecodeError::Unsupported => Outcome::Unsupported,
                    DecodeError::Malformed => Outcome::Malformed,
                };
                self.count(event.outcome);
                return watch(&event);
            }
        };
        if reading.is_empty() {
            self.count(Outcome::EmptyFields);
            event.outcome = Outcome::EmptyFields;
            return watch(&event);
        }
        let stamp = self.clock.stamp(&reading, arrival);
        self.note_clock(arrival);
        self.counters.week_rollovers = self.clock.week_rollovers();
        if let Stamp::At(utc) = stamp {
            event.message_utc = Some(utc);
        }
        if stamp == Stamp::Jumped {
            self.count(Outcome::TimeJump);
            event.outcome = Outcome::TimeJump;
            return watch(&event);
        }
        self.apply_flags_and_signs(&mut reading);
        event.reading = Some(&reading);
        self.emit(&reading, stamp, &mut event, out);
        self.counters.samples += u64::from(event.taken.count_ones());
        event.outcome = if event.taken != 0 || reading.kind.is_auxiliary() {
            Outcome::Used
        } else {
            Outcome::NotTaken
        };
        self.count(event.outcome);
        watch(&event);
    }

    /// Records a change of the state of the source's clock.
    fn note_clock(&mut self, arrival: UtcNs) {
        let state = self.clock.state();
        if state == self.clock_state {
            return;
        }
        self.clock_state = state;
        self.counters.clock_changes += 1;
        self.counters.corrected_by_s = match state {
            ClockState::Corrected { by_s } => by_s,
            ClockState::Right | ClockState::Jumping => 0,
        };
        if self.clock_events.len() == MAX_CLOCK_EVENTS {
            self.clock_events.pop();
        }
        self.clock_events.push(ClockEvent { arrival, state });
    }

    fn count(&mut self, outcome: Outcome) {
        let c = &mut self.counters;
        *match outcome {
            Outcome::Used => &mut c.used,
            Outcome::RefusedChecksum => &mut c.refused_checksum,
            Outcome::Malformed => &mut c.malformed,
            Outcome::Unsupported => &mut c.unsupported,
            Outcome::EmptyFields => &mut c.empty_fields,
            Outcome::NotTaken => &mut c.not_taken,
            Outcome::TimeJump => &mut c.time_jumps,
        } += 1;
    }

    /// Stores the flags of PSXN,20, drops values flagged as invalid, and reverses the configured signs.
    fn apply_flags_and_signs(&mut self, r: &mut Reading) {
        if let Some(invalid) = r.invalid {
            self.invalid = invalid;
        }
        let (before, flags) = (*r, self.invalid);
        if flags.position {
            r.position_rad = None;
        }
        if flags.heading {
            r.heading_rad = None;
        }
        if flags.roll_pitch {
            r.roll_pitch_rad = None;
        }
        self.counters.flagged_invalid += u64::from(*r != before);
        let reversed = &self.dialect.reversed;
        let sign = |back: bool| if back { -1.0 } else { 1.0 };
        r.roll_pitch_rad = r
            .roll_pitch_rad
            .map(|(roll, pitch)| (roll * sign(reversed.roll), pitch * sign(reversed.pitch)));
        r.heave_down_m = r.heave_down_m.map(|h| h * sign(reversed.heave));
    }

    fn checksum_allows(&mut self, sentence: &RawSentence) -> bool {
        match sentence.checksum {
            Checksum::Right => true,
            Checksum::Wrong => {
                self.counters.bad_checksum += 1;
                self.checksum == ChecksumPolicy::Ignore || self.ignores(sentence.body)
            }
            Checksum::Missing => {
                self.counters.missing_checksum += 1;
                self.checksum != ChecksumPolicy::Require || self.ignores(sentence.body)
            }
        }
    }

    /// Whether the configuration ignores the checksum of this sentence. The sentence matches by its address or by its last three
    /// letters.
    fn ignores(&self, body: &str) -> bool {
        let address = body.split(',').next().unwrap_or("");
        let mut names = self.dialect.ignore_checksum_for.iter();
        names.any(|name| address == name || (name.len() == 3 && address.ends_with(name.as_str())))
    }

    fn emit(
        &mut self,
        r: &Reading,
        stamp: Stamp,
        event: &mut SentenceEvent,
        out: &mut Vec<NavSample>,
    ) {
        let arrival = event.arrival;
        let who = fnv(event.name);
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
        let depth = r.own_depth_m.map(|depth_m| NavQuantity::Depth { depth_m });
        let candidates = [
            (NavChannel::Position, position),
            (NavChannel::CourseSpeed, course),
            (NavChannel::Heading, heading),
            (NavChannel::RollPitch, roll_pitch),
            (NavChannel::Heave, heave),
            (NavChannel::Depth, depth),
        ];
        let mut valid = None;
        for (i, (channel, quantity)) in candidates.into_iter().enumerate() {
            let Some(quantity) = quantity else { continue };
            if !self.provides.contains(&channel) {
                event.unwanted |= 1 << i;
                continue;
            }
            if !self.is_active(i, r.kind.rank(), who, arrival) {
                event.outranked |= 1 << i;
                continue;
            }
            event.taken |= 1 << i;
            let valid_utc = *valid.get_or_insert_with(|| self.validity(stamp, who, arrival));
            out.push(NavSample {
                source: self.source,
                valid_utc,
                arrival_utc: arrival,
                quantity,
            });
        }
    }

    fn validity(&mut self, stamp: Stamp, name: u64, arrival: UtcNs) -> UtcNs {
        match (self.time, stamp) {
            (TimePolicy::Arrival { latency_s }, _) => return arrival.plus_s(-latency_s),
            (_, Stamp::At(message)) => return message,
            (TimePolicy::Burst, _) => {
                if let Some(burst) = self
                    .clock
                    .burst()
                    .filter(|b| self.belongs_to_burst(name, *b))
                {
                    return burst;
                }
            }
            (TimePolicy::Message, _) => {}
        }
        self.counters.undated += 1;
        arrival
    }

    /// Whether an untimed sentence takes the time of `burst`. A sentence that occurs twice in one burst has an independent rate and
    /// never takes a burst time again.
    fn belongs_to_burst(&mut self, name: u64, burst: UtcNs) -> bool {
        if let Some(sentence) = self.untimed.iter_mut().find(|s| s.name == name) {
            sentence.independent |= sentence.burst == burst;
            sentence.burst = burst;
            return !sentence.independent;
        }
        let room = self.untimed.len() < MAX_UNTIMED;
        if room {
            self.untimed.push(UntimedSentence {
                name,
                burst,
                independent: false,
            });
        }
        room
    }

    /// Whether this sentence provides the channel. Two sentences with the same quantity can have different times of validity, and a
    /// mix of both would distort the track. The higher rank wins; among equal ranks the first sentence wins.
    fn is_active(&mut self, channel: usize, rank: u8, name: u64, arrival: UtcNs) -> bool {
        let active = &mut self.active[channel];
        let outranked = active.is_some_and(|s| {
            (s.rank > rank || (s.rank == rank && s.name != name))
                && arrival.0.saturating_sub(s.arrival.0) < SILENCE_NS
        });
        if !outranked {
            *active = Some(ActiveSentence {
                rank,
                name,
                arrival,
            });
        }
        !outranked
    }
}

impl<'a> SentenceEvent<'a> {
    fn new(name: &'a str, outcome: Outcome, checksum: Checksum, arrival: UtcNs) -> Self {
        Self {
            name,
            outcome,
            checksum,
            arrival,
            message_utc: None,
            taken: 0,
            outranked: 0,
            unwanted: 0,
            reading: None,
        }
    }
}

/// Address of a sentence, followed by the next field if several sentences share the address.
fn name_of(body: &str) -> &str {
    let mut commas = body.match_indices(',').map(|(at, _)| at);
    let first = commas.next().unwrap_or(body.len());
    let second = commas.next().unwrap_or(body.len());
    let word = body.get(first + 1..second).unwrap_or("");
    let several = match &body[..first] {
        "PSXN" => true,
        "PASHR" | "PIXSE" | "PTNL" | "PSAT" => word.starts_with(|c: char| c.is_ascii_alphabetic()),
        _ => false,
    };
    if several && !word.is_empty() {
        &body[..second]
    } else {
        &body[..first]
    }
}

/// 64-bit FNV-1a hash (Fowler, Noll and Vo).
fn fnv(text: &str) -> u64 {
    text.bytes().fold(0xcbf2_9ce4_8422_2325, |hash, byte| {
        (hash ^ u64::from(byte)).wrapping_mul(0x100_0000_01b3)
    })
}

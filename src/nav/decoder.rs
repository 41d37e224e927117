//! One source's bytes to samples: framing, checksum policy, time policy, and which sentence speaks for which quantity.

use super::framing::{Checksum, Framing, RawSentence};
use super::message_time::{MessageClock, Stamp};
use super::reading::{Decoded, Invalid, Reading, Refusal};
use super::records::{Record, Records};
use super::sentence::decode;
use echotank_config::spec::{ChecksumPolicy, NavChannel, NavDialect, NavSourceSpec, TimePolicy};
use echotank_core::flow::{NavQuantity, NavSample};
use echotank_core::time::{NS_PER_S, UtcNs};

/// Of [`NavChannel`].
const CHANNEL_COUNT: usize = 6;
/// A lesser sentence speaks for a quantity only after the better one has been silent this long.
const SILENCE_NS: i64 = 5 * NS_PER_S;

/// Kinds of sentences of one source that may borrow a burst's time; there are some fifteen that have none.
const MAX_FOLLOWERS: usize = 32;

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
    /// Of those: the instrument itself says that its values are invalid (PSXN,20).
    pub flagged_invalid: u64,
    /// Message times moved by whole GPS weeks' rollovers (1024 weeks) onto the host's or recorder's date.
    pub week_rollovers: u64,
    /// Message time not believed.
    pub time_jumps: u64,
    pub bad_checksum: u64,
    pub missing_checksum: u64,
    pub resync_bytes: u64,
    /// Sentences without a time that found none in their burst, or run on their own, and took their arrival.
    pub undated: u64,
    pub samples: u64,
}

/// What became of one sentence; the names are those of the counters.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub enum Outcome {
    Used,
    RefusedChecksum,
    Malformed,
    Unsupported,
    EmptyFields,
    NotTaken,
    TimeJump,
}

/// One sentence or record, and what became of it: for reports.
#[derive(Clone, Copy, Debug)]
pub struct Heard<'a> {
    /// Address and, where a maker's sentences need it, the word behind it: `INGGA`, `PSXN,23`.
    pub name: &'a str,
    pub outcome: Outcome,
    pub checksum: Checksum,
    pub arrival: UtcNs,
    /// The time in the message itself.
    pub(crate) message_utc: Option<UtcNs>,
    /// One bit per [`NavChannel`]: quantities taken.
    pub taken: u8,
    /// Quantities that a better sentence of this source gives.
    pub outspoken: u8,
    /// Quantities that the source is not to provide.
    pub(crate) unwanted: u8,
    pub reading: Option<&'a Reading>,
}

/// Which sentence last spoke for a channel.
#[derive(Clone, Copy, Debug)]
struct Speaker {
    rank: u8,
    /// Of the sentence's name: two talkers that say the same are not mixed.
    name: u64,
    arrival: UtcNs,
}

/// A sentence without a time, and the burst that it last borrowed one of.
#[derive(Clone, Copy, Debug)]
struct Follower {
    name: u64,
    burst: UtcNs,
    /// It came twice in one burst.
    free: bool,
}

enum Finder {
    Sentences(Framing),
    Records(Records),
}

pub struct NavDecoder {
    finder: Finder,
    reader: Reader,
}

/// Everything behind the framing.
struct Reader {
    source: u16,
    time: TimePolicy,
    checksum: ChecksumPolicy,
    dialect: NavDialect,
    provides: Vec<NavChannel>,
    clock: MessageClock,
    speakers: [Option<Speaker>; CHANNEL_COUNT],
    followers: Vec<Follower>,
    /// By the last PSXN,20.
    invalid: Invalid,
    scratch: String,
    counters: NavCounters,
}

/// What happens at one sentence, beside its samples: nothing, in the ping path.
pub fn unwatched(_: &Heard) {}

impl NavDecoder {
    /// `source` is the index of `spec` in `NavSpec::sources`.
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
                speakers: [None; CHANNEL_COUNT],
                followers: Vec::with_capacity(MAX_FOLLOWERS),
                invalid: Invalid::default(),
                scratch: String::new(),
                counters: NavCounters::default(),
            },
        }
    }

    /// Decodes bytes, cut anywhere, of which the first arrived at `arrival` (rig time); samples are appended to `out`.
    pub fn push(&mut self, bytes: &[u8], arrival: UtcNs, out: &mut Vec<NavSample>) {
        self.push_paced(bytes, arrival, 0, out, &mut unwatched);
    }

    /// The same with `byte_ns` between two bytes on the wire, so that each sentence has the arrival of its own first byte; `watch` is told of
    /// every sentence.
    pub fn push_paced(
        &mut self,
        bytes: &[u8],
        arrival: UtcNs,
        byte_ns: i64,
        out: &mut Vec<NavSample>,
        watch: &mut impl FnMut(&Heard),
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

    /// A datagram or a file ends here: a sentence still open ends too.
    pub fn flush(&mut self, out: &mut Vec<NavSample>) {
        self.flush_watched(out, &mut unwatched);
    }

    pub(crate) fn flush_watched(
        &mut self,
        out: &mut Vec<NavSample>,
        watch: &mut impl FnMut(&Heard),
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

    /// Takes a message that somebody else has found and decoded (MAVLink).
    pub(crate) fn push_record(
        &mut self,
        name: &str,
        record: &Record,
        out: &mut Vec<NavSample>,
        watch: &mut impl FnMut(&Heard),
    ) {
        self.reader.take_record(name, record, out, watch);
    }

    /// Bytes that the finder of such messages has looked at, and those of them that belonged to none.
    pub(crate) fn count_bytes(&mut self, bytes: u64, resync_bytes: u64) {
        self.reader.counters.bytes += bytes;
        self.reader.counters.resync_bytes += resync_bytes;
    }

    /// The arrivals are not clock time (a log without stamps): dates are taken as they come.
    pub(crate) fn distrust_arrivals(&mut self) {
        self.reader.clock.distrust_arrivals();
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
    fn begin(&mut self, arrival: UtcNs) {
        self.clock.arrived(arrival);
        self.counters.sentences += 1;
    }

    fn take(
        &mut self,
        sentence: &RawSentence,
        out: &mut Vec<NavSample>,
        watch: &mut impl FnMut(&Heard),
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
                watch(&Heard::new(
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
        watch: &mut impl FnMut(&Heard),
    ) {
        self.begin(record.arrival);
        let arrival = record.arrival;
        if record.checksum == Checksum::Wrong {
            self.counters.bad_checksum += 1;
            self.counters.refused_checksum += 1;
            watch(&Heard::new(
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
        watch: &mut impl FnMut(&Heard),
    ) {
        let mut heard = Heard::new(name, Outcome::Malformed, checksum, arrival);
        let mut reading = match decoded {
            Ok(reading) => reading,
            Err(refusal) => {
                heard.outcome = match refusal {
                    Refusal::Unsupported => Outcome::Unsupported,
                    Refusal::Malformed => Outcome::Malformed,
                };
                self.count(heard.outcome);
                return watch(&heard);
            }
        };
        if reading.is_empty() {
            self.count(Outcome::EmptyFields);
            heard.outcome = Outcome::EmptyFields;
            return watch(&heard);
        }
        let stamp = self.clock.stamp(&reading, arrival);
        self.counters.week_rollovers = self.clock.week_rollovers();
        if let Stamp::At(utc) = stamp {
            heard.message_utc = Some(utc);
        }
        if stamp == Stamp::Jumped {
            self.count(Outcome::TimeJump);
            heard.outcome = Outcome::TimeJump;
            return watch(&heard);
        }
        self.respect(&mut reading);
        heard.reading = Some(&reading);
        self.emit(&reading, stamp, &mut heard, out);
        self.counters.samples += u64::from(heard.taken.count_ones());
        heard.outcome = if heard.taken != 0 || reading.kind.guides() {
            Outcome::Used
        } else {
            Outcome::NotTaken
        };
        self.count(heard.outcome);
        watch(&heard);
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

    /// Keeps what PSXN,20 says, drops what it called invalid, and turns round what the operator says is the other way round.
    fn respect(&mut self, r: &mut Reading) {
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

    /// The operator named this sentence, by its whole address or by its last three letters.
    fn ignores(&self, body: &str) -> bool {
        let address = body.split(',').next().unwrap_or("");
        let mut names = self.dialect.ignore_checksum_for.iter();
        names.any(|name| address == name || (name.len() == 3 && address.ends_with(name.as_str())))
    }

    fn emit(&mut self, r: &Reading, stamp: Stamp, heard: &mut Heard, out: &mut Vec<NavSample>) {
        let arrival = heard.arrival;
        let who = fnv(heard.name);
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
                heard.unwanted |= 1 << i;
                continue;
            }
            if !self.speaks(i, r.kind.rank(), who, arrival) {
                heard.outspoken |= 1 << i;
                continue;
            }
            heard.taken |= 1 << i;
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
                if let Some(burst) = self.clock.burst().filter(|b| self.belongs(name, *b)) {
                    return burst;
                }
            }
            (TimePolicy::Message, _) => {}
        }
        self.counters.undated += 1;
        arrival
    }

    /// A sentence belongs to a burst that it comes in once. One that comes twice in the same runs on its own: no burst is its time, then or later.
    fn belongs(&mut self, name: u64, burst: UtcNs) -> bool {
        if let Some(follower) = self.followers.iter_mut().find(|f| f.name == name) {
            follower.free |= follower.burst == burst;
            follower.burst = burst;
            return !follower.free;
        }
        let room = self.followers.len() < MAX_FOLLOWERS;
        if room {
            self.followers.push(Follower {
                name,
                burst,
                free: false,
            });
        }
        room
    }

    /// Two sentences of one source that say the same thing may hold at different times; mixing them would shake the track, so the
    /// better one has the word as long as it comes, and among equals the first.
    fn speaks(&mut self, channel: usize, rank: u8, name: u64, arrival: UtcNs) -> bool {
        let speaker = &mut self.speakers[channel];
        let outranked = speaker.is_some_and(|s| {
            (s.rank > rank || (s.rank == rank && s.name != name))
                && arrival.0.saturating_sub(s.arrival.0) < SILENCE_NS
        });
        if !outranked {
            *speaker = Some(Speaker {
                rank,
                name,
                arrival,
            });
        }
        !outranked
    }
}

impl<'a> Heard<'a> {
    fn new(name: &'a str, outcome: Outcome, checksum: Checksum, arrival: UtcNs) -> Self {
        Self {
            name,
            outcome,
            checksum,
            arrival,
            message_utc: None,
            taken: 0,
            outspoken: 0,
            unwanted: 0,
            reading: None,
        }
    }
}

/// Address, and the next word where one address stands for several sentences.
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

/// Fowler, Noll and Vo's hash (1a), 64 bits.
fn fnv(text: &str) -> u64 {
    text.bytes().fold(0xcbf2_9ce4_8422_2325, |hash, byte| {
        (hash ^ u64::from(byte)).wrapping_mul(0x100_0000_01b3)
    })
}

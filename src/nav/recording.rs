//! Recording of live navigation: what each source received, and the pings that used it, as one pcapng file.
//!
//! - Each live source is an interface of the file, with the source's name as `if_name`. Received bytes are UDP datagrams in raw IP, so
//!   other programs read them as well. Their time is the arrival in rig time.
//! - The interface [`ORDERS`] holds the start of the run and every ping as text: `ping sonar=0 number=12 utc_ns=…`. An entry precedes
//!   a ping in the file exactly if the ping used it, so a replay computes each ping from the same samples. `skipped` in place of `ping`
//!   marks a ping that was not made, whose motion the method selection has seen.
//!
//! The section's `shb_userappl` option is [`APPLICATION`]. Source of the format: IETF draft-tuexen-opsawg-pcapng.

use super::capture::{Packets, RAW_IP_LINK, USER_LINK};
use echotank_core::settings::SonarSettings;
use echotank_core::time::UtcNs;
use thiserror::Error;

/// Application and version of the format, in the section header.
const APPLICATION: &str = "echotank navigation recording 1";
/// Name of the interface that holds the start and the pings.
const ORDERS: &str = "echotank orders";
/// Maximum payload of a UDP datagram over IPv4, bytes. A longer read of a stream is divided.
const MAX_PAYLOAD: usize = 65_507;

/// Entry of a recording, in the order in which the run used it.
#[derive(Clone, Debug, PartialEq)]
pub enum Entry {
    /// Bytes that a source received.
    Bytes {
        /// Index into [`NavRecording::sources`].
        source: usize,
        /// Arrival of the first byte, rig time.
        arrival: UtcNs,
        /// One datagram, or one read of a stream.
        bytes: Vec<u8>,
    },
    /// Start of the schedules.
    Start(RecordedStart),
    /// A ping, computed from the entries before it.
    Ping(RecordedPing),
    /// A ping that was not made. The method selection has seen its motion, from the entries before it.
    Skipped(RecordedPing),
}

/// Start of the schedules of a run.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct RecordedStart {
    /// Instant of the first ping.
    pub first_utc: UtcNs,
    /// Rig time up to which navigation had been taken.
    pub known_utc: UtcNs,
}

/// A ping of a run.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct RecordedPing {
    /// Index of the sonar in the configuration.
    pub sonar: usize,
    /// Number of the ping, from 1.
    pub number: u32,
    /// Start of the pulse.
    pub transmit_utc: UtcNs,
    /// Time since the previous order, seconds.
    pub period_s: f64,
    /// Settings at the pulse. [`SonarSettings::pinging`] is true.
    pub settings: SonarSettings,
    /// Rig time up to which navigation had been taken.
    pub known_utc: UtcNs,
    /// Degradation level: 0 is the configured tolerance.
    pub level: usize,
}

/// A recording in memory.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct NavRecording {
    /// Names of the sources.
    pub sources: Vec<String>,
    /// Entries in file order.
    pub entries: Vec<Entry>,
}

/// Errors of reading a recording.
#[derive(Clone, Debug, PartialEq, Eq, Error)]
pub enum RecordingError {
    /// The file is not a recording of live navigation.
    #[error("is not a navigation recording of this program")]
    Other,
    /// An entry has an unknown or malformed text.
    #[error("entry {entry}: malformed: {text}")]
    Malformed {
        /// Number of the entry, from 1.
        entry: usize,
        /// Text of the entry.
        text: String,
    },
}

/// Whether a file begins as a recording of live navigation.
pub fn is_recording(bytes: &[u8]) -> bool {
    let head = &bytes[..bytes.len().min(256)];
    super::capture::is_capture(bytes)
        && head
            .windows(APPLICATION.len())
            .any(|w| w == APPLICATION.as_bytes())
}

impl NavRecording {
    /// Reads a recording. A truncated last entry is ignored.
    ///
    /// # Errors
    /// The bytes are not a recording, or an entry is malformed.
    pub fn read(bytes: &[u8]) -> Result<Self, RecordingError> {
        if !is_recording(bytes) {
            return Err(RecordingError::Other);
        }
        let mut recording = Self::default();
        let mut packets = Packets::of(bytes);
        while let Some(frame) = packets.next_frame() {
            let name = packets.interface_name(frame.interface).unwrap_or_default();
            if name == ORDERS {
                let text = String::from_utf8_lossy(frame.data);
                let entry = parse_order(&text).ok_or_else(|| RecordingError::Malformed {
                    entry: recording.entries.len() + 1,
                    text: text.into_owned(),
                })?;
                recording.entries.push(entry);
            } else if let Some(payload) = frame.packet.payload {
                let known = recording.sources.iter().position(|s| s == name);
                let source = known.unwrap_or_else(|| {
                    recording.sources = sources_of(&packets);
                    let place = recording.sources.iter().position(|s| s == name);
                    place.unwrap_or_default()
                });
                recording.entries.push(Entry::Bytes {
                    source,
                    arrival: frame.packet.arrival,
                    bytes: payload.to_vec(),
                });
            }
        }
        recording.sources = sources_of(&packets);
        Ok(recording)
    }

    /// Number of pings.
    pub fn pings(&self) -> usize {
        let is_ping = |entry: &&Entry| matches!(entry, Entry::Ping(_));
        self.entries.iter().filter(is_ping).count()
    }
}

/// Names of the sources in the order of their interfaces.
fn sources_of(packets: &Packets) -> Vec<String> {
    let names = packets.interface_names().filter(|name| *name != ORDERS);
    names.map(str::to_owned).collect()
}

/// Writes the blocks of a recording.
#[derive(Clone, Debug)]
pub struct RecordingWriter {
    /// UDP port of each source.
    ports: Vec<u16>,
}

impl RecordingWriter {
    /// Appends the head of a file to `out`. `sources` are name, description and port of each source.
    pub fn begin(sources: &[(String, String, u16)], out: &mut Vec<u8>) -> Self {
        block(0x0A0D_0D0A, out, |out| {
            out.extend(0x1A2B_3C4D_u32.to_le_bytes());
            out.extend([1, 0, 0, 0]);
            out.extend((-1_i64).to_le_bytes());
            option(4, APPLICATION.as_bytes(), out);
            option(0, &[], out);
        });
        let mut interface = |link: u32, name: &str, description: &str| {
            block(1, out, |out| {
                out.extend((link as u16).to_le_bytes());
                out.extend([0; 6]);
                option(2, name.as_bytes(), out);
                option(3, description.as_bytes(), out);
                // Nanoseconds.
                option(9, &[9], out);
                option(0, &[], out);
            });
        };
        for (name, description, _) in sources {
            interface(RAW_IP_LINK, name, description);
        }
        interface(USER_LINK, ORDERS, "start and pings of the run");
        Self {
            ports: sources.iter().map(|(_, _, port)| *port).collect(),
        }
    }

    /// Appends an entry to `out`.
    pub fn write(&self, entry: &Entry, out: &mut Vec<u8>) {
        match entry {
            Entry::Bytes {
                source,
                arrival,
                bytes,
            } => {
                let port = self.ports.get(*source).copied().unwrap_or(0);
                for payload in bytes.chunks(MAX_PAYLOAD) {
                    packet(*source, *arrival, &datagram(port, payload), out);
                }
                if bytes.is_empty() {
                    packet(*source, *arrival, &datagram(port, &[]), out);
                }
            }
            Entry::Start(start) => {
                let text = format!(
                    "start first_utc_ns={} known_utc_ns={}",
                    start.first_utc.0, start.known_utc.0
                );
                packet(self.ports.len(), start.first_utc, text.as_bytes(), out);
            }
            Entry::Ping(ping) | Entry::Skipped(ping) => {
                let what = match entry {
                    Entry::Ping(_) => "ping",
                    _ => "skipped",
                };
                let s = &ping.settings;
                let text = format!(
                    "{what} sonar={} number={} utc_ns={} period_s={} range_m={} max_ping_rate_hz={} source_level_db={} gain_db={} \
                     pulse_duration_s={} known_utc_ns={} level={}",
                    ping.sonar,
                    ping.number,
                    ping.transmit_utc.0,
                    ping.period_s,
                    s.range_m,
                    s.max_ping_rate_hz,
                    s.source_level_db,
                    s.gain_db,
                    s.pulse_duration_s,
                    ping.known_utc.0,
                    ping.level
                );
                packet(self.ports.len(), ping.transmit_utc, text.as_bytes(), out);
            }
        }
    }
}

/// Value of `key=` in a text of `key=value` words.
fn value<T: std::str::FromStr>(text: &str, key: &str) -> Option<T> {
    let mut words = text.split_ascii_whitespace();
    let value = words.find_map(|word| word.strip_prefix(key)?.strip_prefix('='))?;
    value.parse().ok()
}

fn parse_order(text: &str) -> Option<Entry> {
    let utc = |key| value(text, key).map(UtcNs);
    match text.split_ascii_whitespace().next()? {
        "start" => Some(Entry::Start(RecordedStart {
            first_utc: utc("first_utc_ns")?,
            known_utc: utc("known_utc_ns")?,
        })),
        "ping" => parse_ping(text).map(Entry::Ping),
        "skipped" => parse_ping(text).map(Entry::Skipped),
        _ => None,
    }
}

fn parse_ping(text: &str) -> Option<RecordedPing> {
    let utc = |key| value(text, key).map(UtcNs);
    let number = |key| value::<f64>(text, key).filter(|v| v.is_finite());
    Some(RecordedPing {
        sonar: value(text, "sonar")?,
        number: value(text, "number")?,
        transmit_utc: utc("utc_ns")?,
        period_s: number("period_s")?,
        settings: SonarSettings {
            pinging: true,
            range_m: number("range_m")?,
            max_ping_rate_hz: number("max_ping_rate_hz")?,
            source_level_db: number("source_level_db")?,
            gain_db: number("gain_db")?,
            pulse_duration_s: number("pulse_duration_s")?,
        },
        known_utc: utc("known_utc_ns")?,
        level: value(text, "level")?,
    })
}

/// Appends a block with the content that `fill` writes.
fn block(kind: u32, out: &mut Vec<u8>, fill: impl FnOnce(&mut Vec<u8>)) {
    let begin = out.len();
    out.extend(kind.to_le_bytes());
    out.extend([0; 4]);
    fill(out);
    pad(begin, out);
    let len = (out.len() - begin + 4) as u32;
    out[begin + 4..begin + 8].copy_from_slice(&len.to_le_bytes());
    out.extend(len.to_le_bytes());
}

fn pad(begin: usize, out: &mut Vec<u8>) {
    let len = (out.len() - begin).next_multiple_of(4);
    out.resize(begin + len, 0);
}

fn option(code: u16, bytes: &[u8], out: &mut Vec<u8>) {
    let bytes = &bytes[..bytes.len().min(1024)];
    let begin = out.len();
    out.extend(code.to_le_bytes());
    out.extend((bytes.len() as u16).to_le_bytes());
    out.extend(bytes);
    pad(begin, out);
}

/// Appends an Enhanced Packet Block. Times before 1970 are written as 1970.
fn packet(interface: usize, at: UtcNs, data: &[u8], out: &mut Vec<u8>) {
    block(6, out, |out| {
        let ticks = at.0.max(0) as u64;
        out.extend((interface as u32).to_le_bytes());
        out.extend(((ticks >> 32) as u32).to_le_bytes());
        out.extend((ticks as u32).to_le_bytes());
        out.extend((data.len() as u32).to_le_bytes());
        out.extend((data.len() as u32).to_le_bytes());
        out.extend(data);
    });
}

/// IPv4 and UDP headers around a payload, from and to 127.0.0.1.
fn datagram(port: u16, payload: &[u8]) -> Vec<u8> {
    const LOCALHOST: [u8; 4] = [127, 0, 0, 1];
    let mut b = vec![0x45, 0];
    b.extend((28 + payload.len() as u16).to_be_bytes());
    b.extend([0, 0, 0, 0, 64, 17, 0, 0]);
    b.extend(LOCALHOST);
    b.extend(LOCALHOST);
    let words = b.chunks_exact(2);
    let sum: u32 = words
        .map(|w| u32::from(u16::from_be_bytes([w[0], w[1]])))
        .sum();
    let sum = (sum & 0xFFFF) + (sum >> 16);
    let sum = !((sum & 0xFFFF) + (sum >> 16)) as u16;
    b[10..12].copy_from_slice(&sum.to_be_bytes());
    b.extend(port.to_be_bytes());
    b.extend(port.to_be_bytes());
    b.extend((8 + payload.len() as u16).to_be_bytes());
    // The checksum of UDP over IPv4 is optional.
    b.extend([0, 0]);
    b.extend(payload);
    b
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::capture::packets;

    fn entries() -> Vec<Entry> {
        let bytes = |source, at: i64, bytes: &[u8]| Entry::Bytes {
            source,
            arrival: UtcNs(1_700_000_000_123_456_789 + at),
            bytes: bytes.to_vec(),
        };
        vec![
            bytes(0, 0, b"$GPGGA"),
            bytes(1, 1, b"$HEHDT,1.5,T*2E\r\n"),
            Entry::Start(RecordedStart {
                first_utc: UtcNs(1_700_000_001_000_000_000),
                known_utc: UtcNs(1_700_000_000_123_456_790),
            }),
            bytes(1, 2, &[0, 255, 10]),
            Entry::Ping(RecordedPing {
                sonar: 1,
                number: 7,
                transmit_utc: UtcNs(1_700_000_001_000_000_000),
                period_s: 0.1 + 0.2,
                settings: SonarSettings {
                    pinging: true,
                    range_m: 1.0 / 3.0,
                    max_ping_rate_hz: 10.0,
                    source_level_db: 205.7,
                    gain_db: -0.0,
                    pulse_duration_s: 1.1e-4,
                },
                known_utc: UtcNs(1_700_000_000_500_000_001),
                level: 2,
            }),
            bytes(0, 3, &[]),
            Entry::Skipped(RecordedPing {
                sonar: 0,
                number: 8,
                transmit_utc: UtcNs(1_700_000_001_100_000_000),
                period_s: 0.1,
                settings: SonarSettings {
                    pinging: true,
                    range_m: 30.0,
                    max_ping_rate_hz: 10.0,
                    source_level_db: 200.0,
                    gain_db: 0.0,
                    pulse_duration_s: 1e-3,
                },
                known_utc: UtcNs(1_700_000_000_500_000_001),
                level: 0,
            }),
        ]
    }

    fn sources() -> Vec<(String, String, u16)> {
        let source = |name: &str, port| (name.to_owned(), format!("udp port {port}"), port);
        vec![source("gnss", 10_110), source("gyro", 0), source("mute", 5)]
    }

    fn written(entries: &[Entry]) -> Vec<u8> {
        let mut file = Vec::new();
        let writer = RecordingWriter::begin(&sources(), &mut file);
        for entry in entries {
            writer.write(entry, &mut file);
        }
        file
    }

    #[test]
    fn a_recording_returns_every_entry_bit_for_bit() {
        let file = written(&entries());
        assert!(is_recording(&file));
        let read = NavRecording::read(&file).expect("reads");
        assert_eq!(read.entries, entries());
        assert_eq!(read.sources, ["gnss", "gyro", "mute"]);
        assert_eq!(read.pings(), 1);
        let Entry::Ping(ping) = read.entries[4] else {
            panic!("{:?}", read.entries[4]);
        };
        assert!(ping.settings.gain_db.is_sign_negative());
    }

    #[test]
    fn other_readers_find_the_datagrams_and_pass_over_the_orders() {
        let file = written(&entries());
        let found: Vec<_> = packets(&file).map(|p| (p.port, p.payload)).collect();
        assert_eq!(found.len(), 7);
        assert_eq!(found[0], (10_110, Some(&b"$GPGGA"[..])));
        assert_eq!((found[2].1, found[4].1), (None, None));
    }

    #[test]
    fn a_long_read_of_a_stream_is_divided_and_a_cut_file_read_to_its_last_whole_entry() {
        let long = vec![b'a'; 65_536];
        let entry = Entry::Bytes {
            source: 0,
            arrival: UtcNs(5),
            bytes: long.clone(),
        };
        let file = written(&[entry]);
        let read = NavRecording::read(&file).expect("reads");
        let joined: Vec<u8> = read.entries.iter().flat_map(bytes_of).collect();
        assert!(joined == long && read.entries.len() == 2);
        let file = written(&entries());
        for cut in 0..file.len() {
            if let Ok(read) = NavRecording::read(&file[..cut]) {
                assert!(entries().starts_with(&read.entries), "cut at {cut}");
            }
        }
    }

    fn bytes_of(entry: &Entry) -> Vec<u8> {
        match entry {
            Entry::Bytes { bytes, .. } => bytes.clone(),
            _ => Vec::new(),
        }
    }

    #[test]
    fn malformed_orders_and_other_files_are_refused() {
        assert_eq!(
            NavRecording::read(b"$GPGGA"),
            Err(RecordingError::Other),
            "text"
        );
        let mut file = Vec::new();
        RecordingWriter::begin(&sources(), &mut file);
        packet(3, UtcNs(0), b"ping sonar=0 number=x", &mut file);
        let error = NavRecording::read(&file).expect_err("malformed");
        assert!(
            error.to_string().starts_with("entry 1: malformed"),
            "{error}"
        );
    }
}

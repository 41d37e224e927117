//! Decodes records of fixed length: EM1000/EM3000, Seapath binary 26, #KMB and TSS1. The stream must not carry other data.
//!
//! Only the Seapath record has a checksum. The other records are found by their fixed bytes. EM3000 has only two fixed bytes, so
//! several consecutive records are required. Source of layouts and signs: SBG Systems, sbgECom `doc/thirdPartyMessages.md`.

use super::framing::Checksum;
use super::reading::DecodeError::Malformed;
use super::reading::{Decoded, Kind, Reading, StatedTime, ensure};
use echotank_config::spec::NavFormat;
use echotank_core::navigation::FixQuality;
use echotank_core::time::{NS_PER_S, UtcNs};

const EM3000_BYTES: usize = 10;
const SEAPATH_BYTES: usize = 52;
const KMB_BYTES: usize = 132;
const TSS1_BYTES: usize = 27;
/// Number of consecutive EM3000 records that are required. Random bytes match one record with probability 33/2^16.
const EM3000_ROW: usize = 3;

/// Result of matching the front of the buffer with a record.
enum Match {
    /// More bytes are needed.
    Incomplete,
    /// No record; this many bytes are discarded.
    NoRecord(usize),
    /// A record with a wrong checksum.
    BadChecksum,
    /// Valid record of this length, bytes.
    Record(usize),
}

/// Decoded record of fixed length.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Record {
    /// Decoded values, or the reason why there are none.
    pub reading: Decoded,
    /// Result of the checksum test; `Missing` for formats without one.
    pub checksum: Checksum,
    /// Arrival of the first byte.
    pub arrival: UtcNs,
}

/// Incremental detector of the records of one format.
#[derive(Debug)]
pub struct Records {
    find: fn(&[u8], bool) -> Match,
    decode: fn(&[u8]) -> Decoded,
    checksum: Checksum,
    buffer: Vec<u8>,
    arrivals: Vec<UtcNs>,
    /// True if the last record ended at the start of the buffer.
    locked: bool,
    resync_bytes: u64,
}

impl Records {
    /// Detector for a format; `None` if the format is text.
    pub fn new(format: NavFormat) -> Option<Self> {
        type Parts = (fn(&[u8], bool) -> Match, fn(&[u8]) -> Decoded, Checksum);
        let (find, decode, checksum): Parts = match format {
            NavFormat::Nmea => return None,
            NavFormat::Tss1 => (find_tss1, tss1, Checksum::Missing),
            NavFormat::Em3000 => (find_em3000, em3000, Checksum::Missing),
            NavFormat::Seapath26 => (find_seapath, seapath_26, Checksum::Right),
            NavFormat::Kmb => (find_kmb, kmb, Checksum::Missing),
        };
        Some(Self {
            find,
            decode,
            checksum,
            buffer: Vec::with_capacity(2 * KMB_BYTES),
            arrivals: Vec::with_capacity(2 * KMB_BYTES),
            locked: false,
            resync_bytes: 0,
        })
    }

    /// Number of bytes outside any record.
    pub fn resync_bytes(&self) -> u64 {
        self.resync_bytes
    }

    /// Consumes `bytes` from the front until a record is complete. `arrival` is the arrival of the first byte. `byte_ns` is the
    /// time between bytes.
    pub fn next(&mut self, bytes: &mut &[u8], arrival: UtcNs, byte_ns: i64) -> Option<Record> {
        let mut at = arrival;
        loop {
            match (self.find)(&self.buffer, self.locked) {
                Match::Incomplete => {
                    let (&byte, rest) = bytes.split_first()?;
                    *bytes = rest;
                    self.buffer.push(byte);
                    self.arrivals.push(at);
                    at = at.plus_ns(byte_ns);
                }
                Match::NoRecord(n) => self.skip(n),
                Match::BadChecksum => {
                    let arrival = self.arrivals[0];
                    // Only the first byte is skipped, because a valid record may begin in the rest.
                    self.skip(1);
                    return Some(Record {
                        reading: Err(Malformed),
                        checksum: Checksum::Wrong,
                        arrival,
                    });
                }
                Match::Record(n) => {
                    let record = Record {
                        reading: (self.decode)(&self.buffer[..n]),
                        checksum: self.checksum,
                        arrival: self.arrivals[0],
                    };
                    self.drop_front(n);
                    self.locked = true;
                    return Some(record);
                }
            }
        }
    }

    /// Ends the stream. The remaining bytes are counted as resync bytes.
    pub fn flush(&mut self) {
        self.skip(self.buffer.len());
    }

    fn skip(&mut self, n: usize) {
        self.resync_bytes += n as u64;
        self.locked = false;
        self.drop_front(n);
    }

    fn drop_front(&mut self, n: usize) {
        self.buffer.drain(..n);
        self.arrivals.drain(..n);
    }
}

fn u16_le(b: &[u8], at: usize) -> u16 {
    u16::from_le_bytes([b[at], b[at + 1]])
}
fn i16_le(b: &[u8], at: usize) -> f64 {
    f64::from(i16::from_le_bytes([b[at], b[at + 1]]))
}
fn i16_be(b: &[u8], at: usize) -> f64 {
    f64::from(i16::from_be_bytes([b[at], b[at + 1]]))
}
fn i32_be(b: &[u8], at: usize) -> f64 {
    f64::from(i32::from_be_bytes([b[at], b[at + 1], b[at + 2], b[at + 3]]))
}
fn u32_le(b: &[u8], at: usize) -> u32 {
    u32::from_le_bytes([b[at], b[at + 1], b[at + 2], b[at + 3]])
}
fn f32_le(b: &[u8], at: usize) -> Result<f64, super::reading::DecodeError> {
    let value = f64::from(f32::from_bits(u32_le(b, at)));
    ensure(value.is_finite()).map(|()| value)
}
fn f64_le(b: &[u8], at: usize) -> Result<f64, super::reading::DecodeError> {
    let low = u64::from(u32_le(b, at));
    let value = f64::from_bits(low | u64::from(u32_le(b, at + 4)) << 32);
    ensure(value.is_finite()).map(|()| value)
}

// ---------------------------------------------------------------- EM1000, EM3000

fn is_em3000(b: &[u8]) -> bool {
    b[1] == 0x90 && matches!(b[0], 0x00 | 0x90..=0xAF)
}

fn find_em3000(b: &[u8], locked: bool) -> Match {
    let row = if locked { 1 } else { EM3000_ROW };
    for record in b.chunks(EM3000_BYTES).take(row) {
        if record.len() >= 2 && !is_em3000(record) {
            return Match::NoRecord(1);
        }
    }
    if b.len() < row * EM3000_BYTES {
        return Match::Incomplete;
    }
    Match::Record(EM3000_BYTES)
}

/// Status, 0x90, roll and pitch (0.01 degrees, positive port up and bow up), heave (cm, positive up), heading (0.01 degrees),
/// little-endian. A value outside its range means that the quantity is unavailable.
fn em3000(b: &[u8]) -> Decoded {
    let mut r = Reading::new(Kind::Em3000);
    // 0x00 (EM1000) and 0x90 mean full accuracy, 0x91 reduced accuracy. Other states are alignment or errors.
    if !matches!(b[0], 0x00 | 0x90 | 0x91) {
        return Ok(r);
    }
    let within = |value: f64, limit: f64| Some(value).filter(|v| v.abs() <= limit);
    let roll = within(i16_le(b, 2), 17_999.0).map(|v| v / 100.0);
    let pitch = within(i16_le(b, 4), 8_999.0).map(|v| v / 100.0);
    let heave = within(i16_le(b, 6), 9_999.0).map(|v| -v / 100.0);
    let heading = within(f64::from(u16_le(b, 8)), 35_999.0).map(|v| v / 100.0);
    r.set_heading(heading)?;
    r.set_roll_pitch(roll, pitch)?;
    r.set_heave_down(heave)?;
    Ok(r)
}

// ---------------------------------------------------------------- Seapath binary 26

/// Checksum of Seapath binary 26: CRC-16, polynomial 0x8408 (reflected), start 0xFFFF, no final exclusive or.
pub fn seapath_crc(bytes: &[u8]) -> u16 {
    bytes.iter().fold(0xFFFF, |crc, byte| {
        (0..8).fold(crc ^ u16::from(*byte), |crc, _| {
            (crc >> 1) ^ if crc & 1 == 1 { 0x8408 } else { 0 }
        })
    })
}

fn find_seapath(b: &[u8], _: bool) -> Match {
    match b {
        [] | [0xAA] => Match::Incomplete,
        [0xAA, 0x55, ..] if b.len() < SEAPATH_BYTES => Match::Incomplete,
        [0xAA, 0x55, ..] => {
            let crc = seapath_crc(&b[2..SEAPATH_BYTES - 2]);
            // The manual does not state the order of these two bytes. Big-endian is the order of all Kongsberg fields.
            if b[SEAPATH_BYTES - 2..SEAPATH_BYTES] == crc.to_be_bytes() {
                Match::Record(SEAPATH_BYTES)
            } else {
                Match::BadChecksum
            }
        }
        _ => Match::NoRecord(1),
    }
}

fn seapath_26(b: &[u8]) -> Decoded {
    let mut r = Reading::new(Kind::Seapath26);
    let status = i16_be(b, 48) as i16;
    let invalid = |bit: u32| status & (1 << bit) != 0;
    let seconds = i64::from(i32_be(b, 2) as i32);
    let fraction_ns = i64::from(u16::from_be_bytes([b[6], b[7]])) * 100_000;
    r.when = Some(StatedTime::Instant(UtcNs(seconds * NS_PER_S + fraction_ns)));
    let angle = |raw: f64| raw * 90.0 / 16_384.0;
    if !invalid(1) {
        let degrees = |at: usize| i32_be(b, at) * 90.0 / f64::from(1 << 30);
        r.fix = FixQuality::Autonomous;
        r.height_m = Some(i32_be(b, 16) / 100.0);
        r.set_position(Some((degrees(8), degrees(12))))?;
        r.set_velocity(i16_be(b, 22) / 100.0, i16_be(b, 24) / 100.0)?;
    }
    if !invalid(3) {
        r.set_heave_down(Some(i16_be(b, 20) / 100.0))?;
    }
    if !invalid(5) {
        r.set_roll_pitch(Some(angle(i16_be(b, 28))), Some(angle(i16_be(b, 30))))?;
    }
    if !invalid(7) {
        let raw = u16::from_be_bytes([b[32], b[33]]);
        r.set_heading(Some(angle(f64::from(raw))))?;
    }
    Ok(r)
}

// ---------------------------------------------------------------- #KMB

fn find_kmb(b: &[u8], _: bool) -> Match {
    const HEAD: [u8; 8] = [b'#', b'K', b'M', b'B', 132, 0, 1, 0];
    let known = b.len().min(HEAD.len());
    if b[..known] != HEAD[..known] {
        return Match::NoRecord(1);
    }
    if b.len() < KMB_BYTES {
        return Match::Incomplete;
    }
    Match::Record(KMB_BYTES)
}

fn kmb(b: &[u8]) -> Decoded {
    let mut r = Reading::new(Kind::Kmb);
    let nanos = u32_le(b, 12);
    ensure(i64::from(nanos) < NS_PER_S)?;
    let utc_ns = i64::from(u32_le(b, 8)) * NS_PER_S + i64::from(nanos);
    r.when = Some(StatedTime::Instant(UtcNs(utc_ns)));
    let status = u32_le(b, 16);
    let invalid = |bit: u32| status & (1 << bit) != 0;
    if !invalid(0) {
        r.fix = FixQuality::Autonomous;
        r.height_m = Some(f32_le(b, 36)?);
        r.set_position(Some((f64_le(b, 20)?, f64_le(b, 28)?)))?;
        r.set_velocity(f32_le(b, 68)?, f32_le(b, 72)?)?;
    }
    if !invalid(1) {
        r.set_roll_pitch(Some(f32_le(b, 40)?), Some(f32_le(b, 44)?))?;
    }
    if !invalid(2) {
        r.set_heading(Some(f32_le(b, 48)?))?;
    }
    if !invalid(3) {
        r.set_heave_down(Some(f32_le(b, 52)?))?;
    }
    Ok(r)
}

// ---------------------------------------------------------------- TSS1

/// `:XXAAAA SHHHHQSRRRR SPPPP<CR><LF>`: x hexadecimal, d decimal, s sign (space or minus), q quality.
const TSS1_FORM: &[u8; TSS1_BYTES] = b":xxxxxx sddddqsdddd sdddd\r\n";

fn find_tss1(b: &[u8], _: bool) -> Match {
    let fits = |(&byte, &form): (&u8, &u8)| match form {
        b'x' => byte.is_ascii_hexdigit(),
        b'd' => byte.is_ascii_digit(),
        b's' => matches!(byte, b' ' | b'-' | b'+'),
        b'q' => b"UuGgHhFf".contains(&byte),
        fixed => byte == fixed,
    };
    if !b.iter().zip(TSS1_FORM).all(fits) {
        return Match::NoRecord(1);
    }
    if b.len() < TSS1_BYTES {
        return Match::Incomplete;
    }
    Match::Record(TSS1_BYTES)
}

/// Heave in cm, positive up; roll (positive port up) and pitch (positive bow up) in 0.01 degrees. Heave is valid when the filter
/// has settled (capital letter).
fn tss1(b: &[u8]) -> Decoded {
    let mut r = Reading::new(Kind::Tss1);
    let value = |at: usize| {
        let digits = b[at + 1..at + 5]
            .iter()
            .fold(0.0, |v, d| v * 10.0 + f64::from(d - b'0'));
        (if b[at] == b'-' { -digits } else { digits }) / 100.0
    };
    r.set_roll_pitch(Some(value(14)), Some(value(20)))?;
    let settled = b[13].is_ascii_uppercase();
    r.set_heave_down(settled.then(|| -value(8)))?;
    Ok(r)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn all(format: NavFormat, bytes: &[u8], cut: usize) -> (Vec<Record>, u64) {
        let mut records = Records::new(format).expect("binary");
        let mut found = Vec::new();
        for mut piece in bytes.chunks(cut) {
            while let Some(r) = records.next(&mut piece, UtcNs(0), 0) {
                found.push(r);
            }
        }
        records.flush();
        (found, records.resync_bytes())
    }

    #[test]
    fn decodes_the_tss1_example_of_the_manual() {
        let bytes = b"noise:1A4770 -0016H 0429 -0680\r\n:1A4770 -0016h 0429 -0680\r\n:12";
        for cut in [1, 5, 100] {
            let (found, resync) = all(NavFormat::Tss1, bytes, cut);
            assert_eq!((found.len(), resync), (2, 8));
            let r = found[0].reading.expect("decodes");
            assert_eq!(r.heave_down_m, Some(0.16), "heave -16 cm up is 16 cm down");
            let (roll, pitch) = r.roll_pitch_rad.expect("attitude");
            assert!((roll.to_degrees() - 4.29).abs() < 1e-12);
            assert!((pitch.to_degrees() + 6.80).abs() < 1e-12);
            let unsettled = found[1].reading.expect("decodes");
            assert_eq!(unsettled.heave_down_m, None);
        }
    }

    #[test]
    fn em3000_needs_three_records_in_a_row_to_lock() {
        let record = |status: u8, roll: i16| {
            let mut b = vec![status, 0x90];
            for v in [roll, -680, -16, 9000] {
                b.extend(v.to_le_bytes());
            }
            b
        };
        let mut bytes = vec![0x90, 0x90, 1];
        for roll in [429, 430, 431, 432] {
            bytes.extend(record(0x90, roll));
        }
        bytes.extend(record(0x9A, 433));
        bytes.extend([7, 7]);
        for cut in [1, 3, 100] {
            let (found, resync) = all(NavFormat::Em3000, &bytes, cut);
            assert_eq!((found.len(), resync), (5, 5), "cut {cut}");
            let r = found[0].reading.expect("decodes");
            let (roll, pitch) = r.roll_pitch_rad.expect("attitude");
            assert!((roll.to_degrees() - 4.29).abs() < 1e-12);
            assert!((pitch.to_degrees() + 6.80).abs() < 1e-12);
            assert_eq!(r.heave_down_m, Some(0.16));
            assert!((r.heading_rad.expect("heading").to_degrees() - 90.0).abs() < 1e-12);
            let aligning = found[4].reading.expect("known");
            assert!(aligning.is_empty(), "0x9A: invalid");
        }
    }

    #[test]
    fn crc_of_the_usual_check_string() {
        // CRC-16/MCRF4XX: reflected 0x1021, start 0xFFFF, no final exclusive or.
        assert_eq!(seapath_crc(b"123456789"), 0x6F91);
    }
}

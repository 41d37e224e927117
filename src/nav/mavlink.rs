//! Reads MAVLink telemetry logs (`.tlog`): eight bytes of ground-station UTC, big-endian microseconds, before every message.
//!
//! Frame versions 1 and 2 are read. ATTITUDE, GLOBAL_POSITION_INT, GPS_RAW_INT and SYSTEM_TIME are decoded; all others count as
//! unsupported. Message times are milliseconds from the start of the vehicle. SYSTEM_TIME of the same component gives the UTC of
//! that start. For a vehicle without a date, the message with the least delay relates its clock to the ground station. Signs agree
//! with this crate: roll positive right side down, pitch positive nose up. Source: MAVLink `common.xml` and its serialisation
//! guide.

use std::borrow::Cow;
use std::collections::HashMap;

use super::framing::Checksum;
use super::reading::DecodeError::{Malformed, Unsupported};
use super::reading::{Decoded, Kind, Reading, StatedTime};
use super::records::Record;
use echotank_core::navigation::FixQuality;
use echotank_core::time::UtcNs;

const STAMP_BYTES: usize = 8;
/// Accepted stamps lie between 2001 and 2100.
const PLAUSIBLE_US: std::ops::Range<u64> = 978_307_200_000_000..4_102_444_800_000_000;
/// Number of consecutive frames at the start that identify a telemetry log.
const MIN_FRAMES: usize = 3;

/// Message number, name, and the extra byte of its checksum (CRC_EXTRA).
const KNOWN: [(u32, &str, u8); 5] = [
    (0, "HEARTBEAT", 50),
    (2, "SYSTEM_TIME", 137),
    (24, "GPS_RAW_INT", 24),
    (30, "ATTITUDE", 39),
    (33, "GLOBAL_POSITION_INT", 104),
];

/// One message of a telemetry log.
pub struct Message {
    /// MAVLink name, or `MAVLINK_` and the number.
    pub name: Cow<'static, str>,
    /// Decoded values and arrival.
    pub record: Record,
}

struct Frame<'a> {
    /// Length including the stamp, bytes.
    len: usize,
    arrival: UtcNs,
    id: u32,
    sender: (u8, u8),
    payload: &'a [u8],
    checksum: Checksum,
}

/// The frame at the front of `bytes`, which starts with its stamp.
fn frame(bytes: &[u8]) -> Option<Frame<'_>> {
    let stamp_us = u64::from_be_bytes(bytes.get(..STAMP_BYTES)?.try_into().ok()?);
    if !PLAUSIBLE_US.contains(&stamp_us) {
        return None;
    }
    let b = &bytes[STAMP_BYTES..];
    let payload_len = usize::from(*b.get(1)?);
    let (head, tail, sender, id) = match b[0] {
        0xFE => (6, 2, (*b.get(3)?, *b.get(4)?), u32::from(*b.get(5)?)),
        0xFD => {
            let id = u32::from_le_bytes([*b.get(7)?, *b.get(8)?, *b.get(9)?, 0]);
            // Signed messages have a 13-byte signature.
            let tail = if b[2] & 1 == 1 { 15 } else { 2 };
            (10, tail, (b[5], b[6]), id)
        }
        _ => return None,
    };
    let end = head + payload_len;
    let sum = u16::from_le_bytes([*b.get(end)?, *b.get(end + 1)?]);
    b.get(..end + tail)?;
    let extra = KNOWN.iter().find(|(known, ..)| *known == id);
    let checksum = match extra {
        Some((.., extra)) if x25(&b[1..end], *extra) == sum => Checksum::Right,
        Some(_) => Checksum::Wrong,
        None => Checksum::Missing,
    };
    Some(Frame {
        len: STAMP_BYTES + end + tail,
        arrival: UtcNs(i64::try_from(stamp_us).unwrap_or(0) * 1000),
        id,
        sender,
        payload: &b[head..end],
        checksum,
    })
}

/// CRC-16/MCRF4XX over the bytes and `extra`.
fn x25(bytes: &[u8], extra: u8) -> u16 {
    bytes.iter().chain([&extra]).fold(0xFFFF, |crc, byte| {
        (0..8).fold(crc ^ u16::from(*byte), |crc, _| {
            (crc >> 1) ^ if crc & 1 == 1 { 0x8408 } else { 0 }
        })
    })
}

pub(crate) fn is_tlog(bytes: &[u8]) -> bool {
    let mut at = 0;
    for _ in 0..MIN_FRAMES {
        match frame(&bytes[at..]) {
            Some(frame) => at += frame.len,
            None => return false,
        }
        if at == bytes.len() {
            break;
        }
    }
    true
}

/// Iterator over the messages of a telemetry log in file order. Bytes between messages are counted.
pub(crate) struct Messages<'a> {
    rest: &'a [u8],
    /// UTC of the start of each sender, microseconds.
    boots_us: HashMap<(u8, u8), i64>,
    resync_bytes: u64,
}

impl<'a> Messages<'a> {
    pub(crate) fn new(bytes: &'a [u8]) -> Self {
        let mut messages = Self {
            rest: bytes,
            boots_us: HashMap::new(),
            resync_bytes: 0,
        };
        // Start by the sender's own clock; used if the sender has no SYSTEM_TIME. Messages before the first SYSTEM_TIME use the first one.
        let mut earliest_start_us: HashMap<(u8, u8), i64> = HashMap::new();
        while let Some(frame) = messages.next_frame() {
            if let Some(boot_us) = boot_us(&frame) {
                messages.boots_us.entry(frame.sender).or_insert(boot_us);
            }
            if let Some(own_us) = own_clock_us(&frame) {
                let start_us = frame.arrival.0 / 1000 - own_us;
                let earliest = earliest_start_us.entry(frame.sender).or_insert(start_us);
                *earliest = start_us.min(*earliest);
            }
        }
        for (sender, start_us) in earliest_start_us {
            messages.boots_us.entry(sender).or_insert(start_us);
        }
        messages.rest = bytes;
        messages.resync_bytes = 0;
        messages
    }

    pub(crate) fn resync_bytes(&self) -> u64 {
        self.resync_bytes
    }

    fn next_frame(&mut self) -> Option<Frame<'a>> {
        while !self.rest.is_empty() {
            if let Some(frame) = frame(self.rest) {
                self.rest = &self.rest[frame.len..];
                return Some(frame);
            }
            self.rest = &self.rest[1..];
            self.resync_bytes += 1;
        }
        None
    }
}

impl Iterator for Messages<'_> {
    type Item = Message;

    fn next(&mut self) -> Option<Message> {
        let frame = self.next_frame()?;
        if let Some(boot_us) = boot_us(&frame) {
            self.boots_us.insert(frame.sender, boot_us);
        }
        let known = KNOWN.iter().find(|(id, ..)| *id == frame.id);
        let name = match known {
            Some((_, name, _)) => Cow::Borrowed(*name),
            None => Cow::Owned(format!("MAVLINK_{}", frame.id)),
        };
        let boot_us = self.boots_us.get(&frame.sender).copied();
        Some(Message {
            name,
            record: Record {
                reading: decode(&frame, boot_us),
                checksum: frame.checksum,
                arrival: frame.arrival,
            },
        })
    }
}

/// UTC of the start of the sender from a valid SYSTEM_TIME, microseconds.
fn boot_us(frame: &Frame) -> Option<i64> {
    if frame.id != 2 || frame.checksum != Checksum::Right {
        return None;
    }
    let payload = padded(frame.payload);
    let unix_us = u64_at(&payload, 0);
    let known = PLAUSIBLE_US.contains(&unix_us);
    let boot_us = i64::from(u32_at(&payload, 8)) * 1000;
    known.then(|| i64::try_from(unix_us).unwrap_or(0) - boot_us)
}

/// Clock of the sender at the start of the message, if it has one, microseconds.
fn own_clock_us(frame: &Frame) -> Option<i64> {
    let timed = matches!(frame.id, 30 | 33) && frame.checksum == Checksum::Right;
    timed.then(|| i64::from(u32_at(&padded(frame.payload), 0)) * 1000)
}

/// Restores the trailing zeros that version 2 omits.
fn padded(payload: &[u8]) -> [u8; 64] {
    let mut out = [0; 64];
    let len = payload.len().min(64);
    out[..len].copy_from_slice(&payload[..len]);
    out
}
fn u64_at(b: &[u8; 64], at: usize) -> u64 {
    u64::from(u32_at(b, at)) | u64::from(u32_at(b, at + 4)) << 32
}
fn u32_at(b: &[u8; 64], at: usize) -> u32 {
    u32::from_le_bytes([b[at], b[at + 1], b[at + 2], b[at + 3]])
}
fn i32_at(b: &[u8; 64], at: usize) -> f64 {
    f64::from(u32_at(b, at) as i32)
}
fn f32_at(b: &[u8; 64], at: usize) -> Option<f64> {
    let value = f64::from(f32::from_bits(u32_at(b, at)));
    value.is_finite().then_some(value)
}
fn u16_at(b: &[u8; 64], at: usize) -> u16 {
    u16::from_le_bytes([b[at], b[at + 1]])
}

fn decode(frame: &Frame, boot_us: Option<i64>) -> Decoded {
    let b = padded(frame.payload);
    let instant = |us: i64| StatedTime::Instant(UtcNs(us.saturating_mul(1000)));
    let since_boot = |ms: u32| boot_us.map(|boot| instant(boot + i64::from(ms) * 1000));
    match frame.id {
        2 => {
            let mut r = Reading::new(Kind::MavTime);
            r.when = since_boot(u32_at(&b, 8));
            Ok(r)
        }
        24 => {
            let mut r = Reading::new(Kind::MavGps);
            let us = u64_at(&b, 0);
            r.when = match PLAUSIBLE_US.contains(&us) {
                true => Some(instant(i64::try_from(us).unwrap_or(0))),
                false => since_boot(u32::try_from(us / 1000).unwrap_or(0)),
            };
            r.fix = match b[28] {
                0..=1 => FixQuality::None,
                2..=3 => FixQuality::Autonomous,
                4 => FixQuality::Differential,
                5 => FixQuality::RtkFloat,
                6 => FixQuality::RtkFixed,
                _ => FixQuality::Autonomous,
            };
            r.height_m = Some(i32_at(&b, 16) / 1000.0);
            r.set_position(Some((i32_at(&b, 8) / 1e7, i32_at(&b, 12) / 1e7)))?;
            Ok(r)
        }
        30 => {
            let mut r = Reading::new(Kind::MavAttitude);
            r.when = since_boot(u32_at(&b, 0));
            let angle = |at: usize| f32_at(&b, at).map(f64::to_degrees).ok_or(Malformed);
            r.set_roll_pitch(Some(angle(4)?), Some(angle(8)?))?;
            r.set_heading(Some(angle(12)?))?;
            Ok(r)
        }
        33 => {
            let mut r = Reading::new(Kind::MavPosition);
            r.when = since_boot(u32_at(&b, 0));
            let (latitude, longitude) = (i32_at(&b, 4), i32_at(&b, 8));
            // Exactly zero means unknown.
            if latitude != 0.0 || longitude != 0.0 {
                r.fix = FixQuality::Autonomous;
                r.height_m = Some(i32_at(&b, 12) / 1000.0);
                r.set_position(Some((latitude / 1e7, longitude / 1e7)))?;
                let velocity = |at: usize| f64::from(u16_at(&b, at) as i16) / 100.0;
                r.set_velocity(velocity(20), velocity(22))?;
            }
            // Height above home; below water it is the negative depth.
            let depth_m = -i32_at(&b, 16) / 1000.0;
            r.set_own_depth(Some(depth_m).filter(|d| *d > -1.0))?;
            Ok(r)
        }
        _ => Err(Unsupported),
    }
}

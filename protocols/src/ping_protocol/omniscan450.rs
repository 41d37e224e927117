//! Messages of the Omniscan 450 side-scan sonar, with one line per ping. Source: `omniscan450.json` of bluerobotics/ping-protocol;
//! 169 and 170 from brping 0.2.5.
//!
//! A port and starboard pair consists of two devices, synchronised by message 170.

use std::ops::Range;

use binrw::{BinRead, BinWrite};

use super::{emit_frame, message_id, ping_message};
use crate::WireError;
use crate::layout::{data_at, layout};
use crate::sevenk::frame::extend_encoded;

/// Message 116: sets the speed of sound.
#[derive(Debug, Clone, Copy, PartialEq, Eq, BinRead, BinWrite)]
pub struct SetSpeedOfSound {
    /// Speed of sound.
    pub speed_of_sound_mm_per_s: u32,
}

ping_message!(
    SetSpeedOfSound,
    4,
    "Ping 116",
    message_id::SET_SPEED_OF_SOUND
);

/// Messages 169 and 170: position of this device among the synchronised devices.
#[derive(Debug, Clone, Copy, PartialEq, Eq, BinRead, BinWrite)]
pub struct SyncChannel {
    /// Index of the device.
    pub channel_number: u8,
    /// Number of synchronised devices.
    pub number_of_channels: u8,
}

ping_message!(SyncChannel, 2, "Ping 169", message_id::SYNC_CHANNEL);

/// Message 2197: ping settings.
#[derive(Debug, Clone, Copy, PartialEq, BinRead, BinWrite)]
pub struct OsPingParams {
    /// Range of the first result.
    pub start_mm: u32,
    /// Range from the first to the last result.
    pub length_mm: u32,
    /// Time between pings; 0 means as fast as possible.
    #[brw(pad_after = 8)]
    pub msec_per_ping: u32,
    /// Pulse length as a fraction of the ping's reception time; 0.002 is usual.
    pub pulse_len_percent: f32,
    /// Filter length as a fraction; 0.0015 is usual.
    pub filter_duration_percent: f32,
    /// Gain index, 0 to 7; -1 is automatic.
    pub gain_index: i16,
    /// Number of results, 200 to 1200.
    pub num_results: u16,
    /// 1 starts pinging, 0 stops it.
    #[brw(pad_after = 3)]
    pub enable: u8,
}

ping_message!(OsPingParams, 36, "Ping 2197", message_id::OS_PING_PARAMS);

/// Head of message 2198 (mono profile) before its results. Their number is set when the message is emitted.
#[derive(Debug, Clone, Copy, PartialEq, Default, BinRead, BinWrite)]
pub struct OsMonoProfileHead {
    /// Counter from power-up.
    pub ping_number: u32,
    /// Range of the first result.
    pub start_mm: u32,
    /// Range from the first to the last result.
    pub length_mm: u32,
    /// Time since power-up.
    pub timestamp_ms: u32,
    /// Centre frequency.
    pub ping_hz: u32,
    /// Gain index, 0 to 7.
    pub gain_index: u16,
    /// Number of results.
    pub num_results: u16,
    /// Speed of sound, 0.1 m/s.
    pub sos_dmps: u16,
    #[brw(pad_after = 1)]
    /// Index of the device.
    pub channel_number: u8,
    /// Pulse length.
    pub pulse_duration_s: f32,
    /// Receiver gain as a factor.
    pub analog_gain: f32,
    /// Level of the result 65535.
    pub max_pwr_db: f32,
    /// Level of the result 0.
    pub min_pwr_db: f32,
    /// Heading of the beam.
    pub transducer_heading_deg: f32,
    /// Heading of the vehicle.
    pub vehicle_heading_deg: f32,
}

layout!(OsMonoProfileHead, 52, "Ping 2198", Little);

/// Parsed message 2198 (mono profile): one line.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct OsMonoProfile<'a> {
    /// Head of the message.
    pub head: OsMonoProfileHead,
    results: &'a [u8],
}

impl<'a> OsMonoProfile<'a> {
    /// Parses the payload of the message. Returns an error if the payload is too short.
    pub fn parse(payload: &'a [u8]) -> Result<Self, WireError> {
        let head = OsMonoProfileHead::parse(payload)?;
        let results = data_at(
            payload,
            OsMonoProfileHead::SIZE_BYTES,
            2 * u64::from(head.num_results),
            "Ping 2198 results",
        )?;
        Ok(Self { head, results })
    }

    /// Results on the scale of the head, 0 to 65535.
    pub fn results(&self) -> impl ExactSizeIterator<Item = u16> + 'a {
        self.results
            .chunks_exact(2)
            .map(|bytes| u16::from_le_bytes([bytes[0], bytes[1]]))
    }

    /// The results in dB.
    pub fn results_db(&self) -> impl ExactSizeIterator<Item = f64> + 'a {
        let (low, high) = (
            f64::from(self.head.min_pwr_db),
            f64::from(self.head.max_pwr_db),
        );
        self.results()
            .map(move |result| low + f64::from(result) / 65_535.0 * (high - low))
    }
}

/// Maps dB to 0..65535 between the ends of the scale. Values beyond the ends are clipped, and NaN becomes 0.
pub fn quantise_db(db: f32, min_pwr_db: f32, max_pwr_db: f32) -> u16 {
    let span = f64::from(max_pwr_db) - f64::from(min_pwr_db);
    ((f64::from(db) - f64::from(min_pwr_db)) / span * 65_535.0).round() as u16
}

/// Appends message 2198 (mono profile) and returns its byte range.
///
/// # Panics
/// If there are more than 1200 results, the maximum of the device.
pub fn emit_2198(
    buf: &mut Vec<u8>,
    source: u8,
    destination: u8,
    head: &OsMonoProfileHead,
    results: &[u16],
) -> Range<usize> {
    assert!(results.len() <= 1200, "{} results", results.len());
    let head = OsMonoProfileHead {
        num_results: results.len() as u16,
        ..*head
    };
    emit_frame(
        buf,
        message_id::OS_MONO_PROFILE,
        source,
        destination,
        |buf| {
            head.emit(buf);
            extend_encoded(buf, results, u16::to_le_bytes);
        },
    )
}

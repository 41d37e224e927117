//! Context packets: properties of the samples of a stream. Source: ANSI/VITA 49.2-2017, sections 9.1 (indicator field 0), 9.5
//! (frequencies and rates: 64 bits, radix point 20 bits from the right) and 9.13.3 (payload format).
//!
//! Fields follow the order of the bits of indicator field 0, from 31 down. Other fields of fixed length are skipped. Further indicator
//! fields and fields of variable length are errors.

use std::ops::Range;

use super::{PacketType, VrtTime, emit_packet, two_words_at, word_at};
use crate::WireError;

/// Number type of the payload.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum SampleKind {
    /// Signed integers.
    Fixed {
        /// Number of bits.
        bits: u8,
    },
    /// IEEE 754, 32 bits.
    Float,
}

/// Format of the payload of data packets.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct PayloadFormat {
    /// True for I and Q, false for real samples.
    pub is_complex: bool,
    /// Number type of the samples.
    pub kind: SampleKind,
    /// Number of interleaved samples, one per element: 1 to 65536.
    pub vector_size: u32,
}

impl PayloadFormat {
    fn to_words(self) -> u64 {
        let (format, bits) = match self.kind {
            SampleKind::Fixed { bits } => (0, u64::from(bits)),
            SampleKind::Float => (0b01110, 32),
        };
        let first = u64::from(self.is_complex) << 29 | format << 24 | (bits - 1) << 6 | (bits - 1);
        first << 32 | u64::from(self.vector_size - 1)
    }

    fn from_words(words: u64) -> Result<Self, WireError> {
        let first = words >> 32;
        let (kind, format) = (first >> 29 & 3, first >> 24 & 0x1F);
        let (field_bits, bits) = ((first >> 6 & 0x3F) + 1, (first & 0x3F) + 1);
        if kind > 1 {
            return Err(WireError::unsupported("VRT sample type", kind));
        }
        let kind_of_number = match format {
            0 if bits == field_bits => SampleKind::Fixed { bits: bits as u8 },
            0b01110 if bits == 32 && field_bits == 32 => SampleKind::Float,
            _ => return Err(WireError::unsupported("VRT payload format", first)),
        };
        Ok(Self {
            is_complex: kind == 1,
            kind: kind_of_number,
            vector_size: (words & 0xFFFF) as u32 + 1,
        })
    }
}

/// Properties of a stream. `None` means that the packet does not state the property.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Context {
    /// True if a field differs from the stream's last context packet.
    pub is_change: bool,
    /// Bandwidth of the signal.
    pub bandwidth_hz: Option<f64>,
    /// Frequency at the transducer of the middle of the band, which is 0 Hz of complex samples.
    pub rf_reference_hz: Option<f64>,
    /// Frequency of the middle of the band within the samples; 0 or not stated for complex samples.
    pub if_reference_hz: Option<f64>,
    /// Level of a full-scale sample, in steps of 1/128 dB.
    pub reference_level_dbm: Option<f64>,
    /// Sample rate.
    pub sample_rate_hz: Option<f64>,
    /// Format of the payload.
    pub payload_format: Option<PayloadFormat>,
}

/// Supported bits of indicator field 0.
const CHANGE: u32 = 31;
const BANDWIDTH: u32 = 29;
const IF_REFERENCE: u32 = 28;
const RF_REFERENCE: u32 = 27;
const REFERENCE_LEVEL: u32 = 24;
const SAMPLE_RATE: u32 = 21;
const PAYLOAD_FORMAT: u32 = 15;
/// Number of words of the fields of bits 30 to 10. Bit 31 has no field.
const FIELD_WORDS: [(u32, usize); 21] = [
    (30, 1),
    (29, 2),
    (28, 2),
    (27, 2),
    (26, 2),
    (25, 2),
    (24, 1),
    (23, 1),
    (22, 1),
    (21, 2),
    (20, 2),
    (19, 1),
    (18, 1),
    (17, 2),
    (16, 1),
    (15, 2),
    (14, 11),
    (13, 11),
    (12, 13),
    (11, 13),
    (10, 1),
];
/// Unit of frequencies: radix point 20 bits from the right (2^-20 Hz, at most 8.8 THz).
const RADIX_20: f64 = (1 << 20) as f64;
/// Unit of levels: radix point 7 bits from the right.
const RADIX_7: f64 = 128.0;

impl Context {
    /// Parses the payload of a context packet.
    pub fn parse(payload: &[u8]) -> Result<Self, WireError> {
        const WHAT: &str = "VRT context";
        let indicators = word_at(payload, 0, WHAT)?;
        // Bits 9 to 0: lists, texts and further indicator fields.
        if indicators & 0x3FF != 0 {
            return Err(WireError::unsupported(
                "VRT context fields",
                indicators & 0x3FF,
            ));
        }
        let hz =
            |word| two_words_at(payload, word, WHAT).map(|value| value as i64 as f64 / RADIX_20);
        let mut context = Self {
            is_change: indicators >> CHANGE & 1 == 1,
            ..Self::default()
        };
        let mut word = 1;
        for (bit, words) in FIELD_WORDS {
            if indicators >> bit & 1 == 0 {
                continue;
            }
            // Skipped fields must be complete as well.
            word_at(payload, word + words - 1, WHAT)?;
            match bit {
                BANDWIDTH => context.bandwidth_hz = Some(hz(word)?),
                IF_REFERENCE => context.if_reference_hz = Some(hz(word)?),
                RF_REFERENCE => context.rf_reference_hz = Some(hz(word)?),
                SAMPLE_RATE => context.sample_rate_hz = Some(hz(word)?),
                REFERENCE_LEVEL => {
                    let level = word_at(payload, word, WHAT)? as u16 as i16;
                    context.reference_level_dbm = Some(f64::from(level) / RADIX_7);
                }
                PAYLOAD_FORMAT => {
                    let words = two_words_at(payload, word, WHAT)?;
                    context.payload_format = Some(PayloadFormat::from_words(words)?);
                }
                _ => {}
            }
            word += words;
        }
        Ok(context)
    }

    /// Appends the context packet of a stream and returns its byte range.
    pub fn emit(
        &self,
        buf: &mut Vec<u8>,
        stream_id: u32,
        count: u8,
        time: VrtTime,
    ) -> Range<usize> {
        emit_packet(
            buf,
            PacketType::Context,
            stream_id,
            count,
            time,
            None,
            |buf| self.emit_fields(buf),
        )
    }

    fn emit_fields(&self, buf: &mut Vec<u8>) {
        let bits = [
            (CHANGE, self.is_change),
            (BANDWIDTH, self.bandwidth_hz.is_some()),
            (IF_REFERENCE, self.if_reference_hz.is_some()),
            (RF_REFERENCE, self.rf_reference_hz.is_some()),
            (REFERENCE_LEVEL, self.reference_level_dbm.is_some()),
            (SAMPLE_RATE, self.sample_rate_hz.is_some()),
            (PAYLOAD_FORMAT, self.payload_format.is_some()),
        ];
        let indicators = bits
            .iter()
            .fold(0, |word, &(bit, is_set)| word | u32::from(is_set) << bit);
        // The cast saturates and makes NaN 0.
        let hz = |value: f64| ((value * RADIX_20).round() as i64).to_be_bytes();
        buf.extend(indicators.to_be_bytes());
        for value in [
            self.bandwidth_hz,
            self.if_reference_hz,
            self.rf_reference_hz,
        ] {
            buf.extend(value.into_iter().flat_map(hz));
        }
        if let Some(level) = self.reference_level_dbm {
            buf.extend(u32::from((level * RADIX_7).round() as i16 as u16).to_be_bytes());
        }
        buf.extend(self.sample_rate_hz.into_iter().flat_map(hz));
        if let Some(format) = self.payload_format {
            buf.extend(format.to_words().to_be_bytes());
        }
    }
}

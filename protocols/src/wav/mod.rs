//! Multichannel WAV for test benches that play samples: RIFF below 4 GiB, RF64 above.
//!
//! Sources: Microsoft, "Multiple channel audio data and WAVE files" (WAVE_FORMAT_EXTENSIBLE); EBU Tech 3306 v1.1 (2009), RF64. In
//! RF64, a size beyond 32 bits is 0xFFFFFFFF, and its 64-bit value is in the `ds64` chunk, which is always the first. A `JUNK`
//! chunk of the same length reserves its space, so that any file can become RF64 when it is closed. Numbers are little endian.
//!
//! ```text
//!  0 RIFF or RF64, size, WAVE      48 fmt , 40 bytes
//! 12 JUNK or ds64, 28 bytes        96 data, size          104 samples, of all channels side by side
//! ```

use crate::WireError;
use crate::layout::data_at;

/// Offset of the samples in a file written by this module.
pub const HEADER_BYTES: usize = 104;
const EXTENSIBLE: u16 = 0xFFFE;
/// Last bytes of the identifiers of integer and float samples: {0000000N-0000-0010-8000-00AA00389B71}.
const SUBFORMAT_END: [u8; 14] = [
    0x00, 0x00, 0x00, 0x00, 0x10, 0x00, 0x80, 0x00, 0x00, 0xAA, 0x00, 0x38, 0x9B, 0x71,
];
const IN_DS64: u32 = u32::MAX;
/// Maximum number of chunks before the samples. A larger number indicates an invalid file.
const MAX_CHUNKS: usize = 64;

/// Type of one sample of one channel.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum WavSample {
    /// Signed 16-bit integers.
    I16,
    /// Signed 32-bit integers.
    I32,
    /// 32-bit floats.
    F32,
}

impl WavSample {
    /// Size of a sample.
    pub fn bytes(self) -> usize {
        match self {
            Self::I16 => 2,
            Self::I32 | Self::F32 => 4,
        }
    }
}

/// Channels, sample rate and sample type of a WAV file.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct WavFormat {
    /// Number of channels.
    pub channels: u16,
    /// Sample rate.
    pub sample_rate_hz: u32,
    /// Type of the samples.
    pub sample: WavSample,
}

/// Container format of a WAV file.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Container {
    /// RIFF if the sizes fit 32 bits, otherwise RF64.
    AsNeeded,
    /// Always RF64.
    Rf64,
}

impl WavFormat {
    /// Size of one sample of all channels.
    pub fn frame_bytes(&self) -> u64 {
        u64::from(self.channels) * self.sample.bytes() as u64
    }

    /// Appends the header of a file with this many samples per channel. Its length is always [`HEADER_BYTES`], so that it can be
    /// overwritten when the number is known.
    ///
    /// # Panics
    /// If there is no channel, or the size of one sample of all channels exceeds 16 bits.
    pub fn emit_header(&self, buf: &mut Vec<u8>, sample_times: u64, container: Container) {
        let frame_bytes =
            u16::try_from(self.frame_bytes()).expect("bytes of a sample time in 16 bits");
        assert!(frame_bytes > 0, "WAV without a channel");
        let data_bytes = sample_times.saturating_mul(u64::from(frame_bytes));
        // Chunks are padded to an even length.
        let riff_bytes = (HEADER_BYTES as u64 - 8)
            .saturating_add(data_bytes)
            .saturating_add(data_bytes % 2);
        let is_64 = container == Container::Rf64 || riff_bytes >= u64::from(IN_DS64);
        let size = |bytes: u64| if is_64 { IN_DS64 } else { bytes as u32 }.to_le_bytes();
        let start = buf.len();
        buf.extend(if is_64 { b"RF64" } else { b"RIFF" });
        buf.extend(size(riff_bytes));
        buf.extend(b"WAVE");
        buf.extend(if is_64 { b"ds64" } else { b"JUNK" });
        buf.extend(28_u32.to_le_bytes());
        let sizes = if is_64 {
            [riff_bytes, data_bytes, sample_times]
        } else {
            [0; 3]
        };
        buf.extend(sizes.map(u64::to_le_bytes).as_flattened());
        // No further chunk needs a 64-bit length.
        buf.extend([0; 4]);
        buf.extend(b"fmt ");
        buf.extend(40_u32.to_le_bytes());
        let bits = 8 * self.sample.bytes() as u16;
        buf.extend(EXTENSIBLE.to_le_bytes());
        buf.extend(self.channels.to_le_bytes());
        buf.extend(self.sample_rate_hz.to_le_bytes());
        buf.extend(
            self.sample_rate_hz
                .saturating_mul(frame_bytes.into())
                .to_le_bytes(),
        );
        buf.extend(frame_bytes.to_le_bytes());
        buf.extend(bits.to_le_bytes());
        // Size of the extension, valid bits, and no loudspeaker positions.
        buf.extend(22_u16.to_le_bytes());
        buf.extend(bits.to_le_bytes());
        buf.extend(0_u32.to_le_bytes());
        let code: u16 = match self.sample {
            WavSample::I16 | WavSample::I32 => 1,
            WavSample::F32 => 3,
        };
        buf.extend(code.to_le_bytes());
        buf.extend(SUBFORMAT_END);
        buf.extend(b"data");
        buf.extend(size(data_bytes));
        debug_assert_eq!(buf.len() - start, HEADER_BYTES);
    }
}

/// Contents of a file's header.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct WavHeader {
    /// Format of the samples.
    pub format: WavFormat,
    /// True for RF64, false for RIFF.
    pub is_rf64: bool,
    /// Offset of the samples in the file.
    pub data_at: usize,
    /// Size of the samples.
    pub data_bytes: u64,
}

impl WavHeader {
    /// Number of samples per channel.
    pub fn sample_times(&self) -> u64 {
        self.data_bytes / self.format.frame_bytes()
    }

    /// Parses the front of a file up to its samples; unknown chunks are skipped.
    pub fn parse(bytes: &[u8]) -> Result<Self, WireError> {
        let is_rf64 = match data_at(bytes, 0, 4, "WAV")? {
            b"RIFF" => false,
            b"RF64" => true,
            other => {
                return Err(WireError::mark(
                    "WAV mark",
                    u32::from_be_bytes(*b"RIFF"),
                    number(other).swap_bytes() >> 32,
                ));
            }
        };
        let wave = data_at(bytes, 8, 4, "WAV")?;
        if wave != b"WAVE" {
            return Err(WireError::unsupported("RIFF form", number(wave)));
        }
        let (mut at, mut format, mut long_data) = (12, None, None);
        for _ in 0..MAX_CHUNKS {
            let name = data_at(bytes, at, 4, "WAV chunk")?;
            let size = number(data_at(bytes, at + 4, 4, "WAV chunk")?);
            at += 8;
            match name {
                b"data" => {
                    let early = "WAV data before the format chunk, at byte";
                    let format = format.ok_or(WireError::unsupported(early, at as u64))?;
                    let data_bytes = match long_data {
                        Some(bytes) if size == u64::from(IN_DS64) => bytes,
                        _ => size,
                    };
                    return Ok(Self {
                        format,
                        is_rf64,
                        data_at: at,
                        data_bytes,
                    });
                }
                b"fmt " => format = Some(parse_format(data_at(bytes, at, size, "WAV fmt")?)?),
                b"ds64" => long_data = Some(number(data_at(bytes, at + 8, 8, "WAV ds64")?)),
                _ => {}
            }
            data_at(bytes, at, size, "WAV chunk")?;
            at += (size + size % 2) as usize;
        }
        Err(WireError::unsupported("WAV chunk count", MAX_CHUNKS as u64))
    }
}

/// Up to eight bytes as a little-endian number.
fn number(bytes: &[u8]) -> u64 {
    bytes
        .iter()
        .rev()
        .fold(0, |sum, &byte| sum << 8 | u64::from(byte))
}

fn parse_format(chunk: &[u8]) -> Result<WavFormat, WireError> {
    let field = |at, len| data_at(chunk, at, len, "WAV fmt").map(number);
    let code = match field(0, 2)? {
        code if code == u64::from(EXTENSIBLE) => field(24, 2)?,
        code => code,
    };
    let bits = field(14, 2)?;
    let sample = match (code, bits) {
        (1, 16) => WavSample::I16,
        (1, 32) => WavSample::I32,
        (3, 32) => WavSample::F32,
        _ => return Err(WireError::unsupported("WAV bits per sample", bits)),
    };
    let channels = field(2, 2)? as u16;
    if channels == 0 {
        return Err(WireError::unsupported("WAV channel count", 0u8));
    }
    Ok(WavFormat {
        channels,
        sample_rate_hz: field(4, 4)? as u32,
        sample,
    })
}

//! Common parts of the formats other than 7k: layouts of fixed length, and parse errors.

use std::io::Cursor;

use binrw::io::NoSeek;
use binrw::{BinRead, BinWrite, Endian};

/// Parse error. Every variant names the checked item and the values that disagree.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum WireError {
    #[error("{what} needs {need_bytes} bytes, only {got_bytes} are available")]
    /// Bytes are missing.
    Truncated {
        /// The checked item.
        what: &'static str,
        /// Required number of bytes.
        need_bytes: u64,
        /// Available number of bytes.
        got_bytes: u64,
    },
    #[error("{what} of {got_bytes} bytes exceeds the limit of {limit_bytes}")]
    /// A length exceeds its limit.
    Oversized {
        /// The checked item.
        what: &'static str,
        /// Stated number of bytes.
        got_bytes: u64,
        /// Permitted number of bytes.
        limit_bytes: u64,
    },
    #[error("{what} is {got:#x}, not {expected:#x}")]
    /// A constant field has the wrong value.
    Mark {
        /// The checked field.
        what: &'static str,
        /// Required value.
        expected: u64,
        /// Value found.
        got: u64,
    },
    #[error("checksum of {what} is {stored:#x}, computed {computed:#x}")]
    /// The checksum does not match the bytes.
    Checksum {
        /// The checked message.
        what: &'static str,
        /// Checksum in the message.
        stored: u64,
        /// Checksum of the bytes.
        computed: u64,
    },
    #[error("{what} {got} is not supported")]
    /// The value is not supported.
    Unsupported {
        /// The checked field.
        what: &'static str,
        /// Value found.
        got: u64,
    },
}

impl WireError {
    pub(crate) fn truncated(what: &'static str, need: impl Into<u64>, got: usize) -> Self {
        let (need_bytes, got_bytes) = (need.into(), got as u64);
        Self::Truncated {
            what,
            need_bytes,
            got_bytes,
        }
    }

    pub(crate) fn unsupported(what: &'static str, got: impl Into<u64>) -> Self {
        let got = got.into();
        Self::Unsupported { what, got }
    }

    pub(crate) fn oversized(what: &'static str, got_bytes: u32, limit_bytes: u32) -> Self {
        Self::Oversized {
            what,
            got_bytes: got_bytes.into(),
            limit_bytes: limit_bytes.into(),
        }
    }

    pub(crate) fn mark(what: &'static str, expected: impl Into<u64>, got: impl Into<u64>) -> Self {
        Self::Mark {
            what,
            expected: expected.into(),
            got: got.into(),
        }
    }

    pub(crate) fn checksum(
        what: &'static str,
        stored: impl Into<u64>,
        computed: impl Into<u64>,
    ) -> Self {
        Self::Checksum {
            what,
            stored: stored.into(),
            computed: computed.into(),
        }
    }
}

/// Layout of fixed length with a fixed byte order.
pub(crate) trait Layout:
    for<'a> BinRead<Args<'a> = ()> + for<'a> BinWrite<Args<'a> = ()>
{
    const SIZE_BYTES: usize;
    const NAME: &'static str;
    const ENDIAN: Endian;
}

/// Reads a layout from the front of `bytes`; further bytes are ignored.
pub(crate) fn read_layout<T: Layout>(bytes: &[u8]) -> Result<T, WireError> {
    let truncated = WireError::truncated(T::NAME, T::SIZE_BYTES as u64, bytes.len());
    let front = bytes.get(..T::SIZE_BYTES).ok_or(truncated)?;
    // After the length check, a layout of plain numbers cannot fail.
    T::read_options(&mut Cursor::new(front), T::ENDIAN, ()).map_err(|_| truncated)
}

pub(crate) fn write_layout<T: Layout>(value: &T, buf: &mut Vec<u8>) {
    let start = buf.len();
    value
        .write_options(&mut NoSeek::new(&mut *buf), T::ENDIAN, ())
        .expect("writing to a Vec cannot fail");
    debug_assert_eq!(buf.len() - start, T::SIZE_BYTES, "{}", T::NAME);
}

/// Implements [`Layout`] for a struct of plain numbers.
macro_rules! layout_of {
    ($type:ty, $size:expr, $name:literal, $endian:ident) => {
        impl crate::layout::Layout for $type {
            const SIZE_BYTES: usize = $size;
            const NAME: &'static str = $name;
            const ENDIAN: binrw::Endian = binrw::Endian::$endian;
        }
    };
}
pub(crate) use layout_of;

/// Implements [`Layout`], `parse` and `emit` for a struct of plain numbers.
macro_rules! layout {
    ($type:ty, $size:expr, $name:literal, $endian:ident) => {
        crate::layout::layout_of!($type, $size, $name, $endian);

        impl $type {
            /// Size of the layout.
            #[allow(unreachable_pub, reason = "some of the types are private to the crate")]
            pub const SIZE_BYTES: usize = $size;

            /// Parses the fields at the front of `bytes`, without checking values.
            #[allow(unreachable_pub, reason = "some of the types are private to the crate")]
            pub fn parse(bytes: &[u8]) -> Result<Self, crate::WireError> {
                crate::layout::read_layout(bytes)
            }

            /// Appends the fields.
            #[allow(unreachable_pub, reason = "some of the types are private to the crate")]
            pub fn emit(&self, buf: &mut Vec<u8>) {
                crate::layout::write_layout(self, buf);
            }
        }
    };
}
pub(crate) use layout;

/// The `len` bytes from offset `at`, or an error with the number of missing bytes.
pub(crate) fn data_at<'a>(
    bytes: &'a [u8],
    at: usize,
    len: u64,
    what: &'static str,
) -> Result<&'a [u8], WireError> {
    let data = bytes.get(at..).unwrap_or_default();
    // A length in a message may exceed usize on a 32-bit machine, so it is compared as u64 before the
    // conversion.
    if (data.len() as u64) < len {
        let need_bytes = (at as u64).saturating_add(len);
        return Err(WireError::truncated(what, need_bytes, bytes.len()));
    }
    Ok(&data[..len as usize])
}

/// Text of a field up to its first NUL. Bytes other than printable ASCII become `?`.
pub(crate) fn text_of(field: &[u8]) -> String {
    field
        .iter()
        .take_while(|&&byte| byte != 0)
        .map(|&byte| {
            if byte.is_ascii() && !byte.is_ascii_control() {
                char::from(byte)
            } else {
                '?'
            }
        })
        .collect()
}

/// Text as a field of `N` bytes, padded with at least one NUL. Characters other than printable ASCII become `?`.
pub(crate) fn text_field<const N: usize>(text: &str) -> [u8; N] {
    let mut field = [0; N];
    for (byte, character) in field.iter_mut().zip(text.chars()).take(N.saturating_sub(1)) {
        *byte = if character.is_ascii() && !character.is_ascii_control() {
            character as u8
        } else {
            b'?'
        };
    }
    field
}

/// Nearest integer within the bounds of the field; NaN becomes 0.
pub(crate) fn rounded(value: f64, low: f64, high: f64) -> f64 {
    if value.is_nan() {
        0.0
    } else {
        value.round().clamp(low, high)
    }
}

pub(crate) fn to_i16(value: f64) -> i16 {
    rounded(value, f64::from(i16::MIN), f64::from(i16::MAX)) as i16
}

pub(crate) fn to_u16(value: f64) -> u16 {
    rounded(value, 0.0, f64::from(u16::MAX)) as u16
}

pub(crate) fn to_i32(value: f64) -> i32 {
    rounded(value, f64::from(i32::MIN), f64::from(i32::MAX)) as i32
}

pub(crate) fn to_u32(value: f64) -> u32 {
    rounded(value, 0.0, f64::from(u32::MAX)) as u32
}

/// Angle in 0..360 degrees, in steps of 1/`per_degree`. A value that rounds to a full turn becomes 0.
pub(crate) fn turn_counts(angle_rad: f64, per_degree: f64) -> f64 {
    let counts = (angle_rad.to_degrees().rem_euclid(360.0) * per_degree).round();
    if counts >= 360.0 * per_degree {
        0.0
    } else {
        counts
    }
}

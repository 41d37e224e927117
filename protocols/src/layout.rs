//! What the formats beside 7k share: layouts of fixed length, and what can be wrong with bytes.

use std::io::Cursor;

use binrw::io::NoSeek;
use binrw::{BinRead, BinWrite, Endian};

/// What is wrong with bytes that should be of a format. Every variant names what was looked at and the numbers that disagree.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum WireError {
    #[error("{what} needs {need_bytes} bytes, {got_bytes} are there")]
    Truncated {
        what: &'static str,
        need_bytes: u64,
        got_bytes: u64,
    },
    #[error("{what} of {got_bytes} bytes is over the limit of {limit_bytes}")]
    Oversized {
        what: &'static str,
        got_bytes: u64,
        limit_bytes: u64,
    },
    #[error("{what} is {got:#x}, not {expected:#x}")]
    Mark {
        what: &'static str,
        expected: u64,
        got: u64,
    },
    #[error("checksum of {what} is {stored:#x}, the bytes give {computed:#x}")]
    Checksum {
        what: &'static str,
        stored: u64,
        computed: u64,
    },
    #[error("{what} of {got} is not one we read")]
    Unsupported { what: &'static str, got: u64 },
}

/// Bytes of fixed length with a fixed order.
pub(crate) trait Layout:
    for<'a> BinRead<Args<'a> = ()> + for<'a> BinWrite<Args<'a> = ()>
{
    const SIZE_BYTES: usize;
    const NAME: &'static str;
    const ENDIAN: Endian;
}

/// Reads a layout from the front of `bytes`; what is behind it is left alone.
pub(crate) fn read_layout<T: Layout>(bytes: &[u8]) -> Result<T, WireError> {
    let truncated = WireError::Truncated {
        what: T::NAME,
        need_bytes: T::SIZE_BYTES as u64,
        got_bytes: bytes.len() as u64,
    };
    let front = bytes.get(..T::SIZE_BYTES).ok_or(truncated)?;
    // With the length seen to, a layout of plain numbers has nothing else that could fail.
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
            pub const SIZE_BYTES: usize = $size;

            /// Reads the fields as they are from the front of `bytes`.
            pub fn parse(bytes: &[u8]) -> Result<Self, crate::WireError> {
                crate::layout::read_layout(bytes)
            }

            /// Appends the fields.
            pub fn emit(&self, buf: &mut Vec<u8>) {
                crate::layout::write_layout(self, buf);
            }
        }
    };
}
pub(crate) use layout;

/// The `len` bytes from `at`, or what is missing.
pub(crate) fn data_at<'a>(
    bytes: &'a [u8],
    at: usize,
    len: u64,
    what: &'static str,
) -> Result<&'a [u8], WireError> {
    let data = bytes.get(at..).unwrap_or_default();
    // A length from the wire may be beyond usize on a 32-bit machine: compare as u64 before it becomes one.
    if (data.len() as u64) < len {
        return Err(WireError::Truncated {
            what,
            need_bytes: (at as u64).saturating_add(len),
            got_bytes: bytes.len() as u64,
        });
    }
    Ok(&data[..len as usize])
}

/// A text field: cut at its first NUL, bytes that are no ASCII shown as `?`.
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

/// A text field of `N` bytes, NUL padded, at least one NUL at its end; characters beyond ASCII become `?`.
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

/// Nearest whole number within the bounds of the field; NaN becomes 0.
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

/// An angle folded to 0..360 degrees and counted in steps of 1/`per_degree`; what rounds up to a whole turn is 0.
pub(crate) fn turn_counts(angle_rad: f64, per_degree: f64) -> f64 {
    let counts = (angle_rad.to_degrees().rem_euclid(360.0) * per_degree).round();
    if counts >= 360.0 * per_degree {
        0.0
    } else {
        counts
    }
}

//! Golden bytes from published tables, and 7k records with one timestamp.

use std::ops::Range;

use echotank_protocols::WireError;
use echotank_protocols::framing::{Framing, Splitter};
use echotank_protocols::sevenk::records::Heading1013;
use echotank_protocols::sevenk::{OpenRecord, Record, RecordStamp, SevenKTime};

/// 2025-06-15 15:06:40.5
pub(crate) const STAMP: RecordStamp = RecordStamp {
    time: SevenKTime {
        year: 2025,
        day_of_year: 166,
        seconds: 40.5,
        hours: 15,
        minutes: 6,
    },
    device_id: 7125,
    system_enumerator: 1,
};

/// Bytes made of `(offset, value)` pairs, independent of the order of fields in a struct.
pub(crate) fn table(len: usize, fields: &[(usize, &[u8])]) -> Vec<u8> {
    let mut bytes = vec![0; len];
    for (at, value) in fields {
        bytes[*at..at + value.len()].copy_from_slice(value);
    }
    bytes
}

/// A number of a published table.
pub(crate) trait Number {
    fn put(&self, bytes: &mut Vec<u8>);
}

macro_rules! numbers {
    ($($type:ty),*) => {
        $(impl Number for $type {
            fn put(&self, bytes: &mut Vec<u8>) {
                bytes.extend(self.to_le_bytes());
            }
        })*
    };
}

numbers!(u16, i16, u32, i32, f32, u64, f64);

/// Consecutive fields of one type, little endian.
pub(crate) fn le<T: Number>(values: &[T]) -> Vec<u8> {
    bytes_of(|bytes| values.iter().for_each(|value| value.put(bytes)))
}

/// Asserts equality and names the first difference.
pub(crate) fn assert_same(got: &[u8], want: &[u8], what: &str) {
    for (at, (g, w)) in got.iter().zip(want).enumerate() {
        assert_eq!(
            g, w,
            "{what}: byte {at} is {g:#04x}, the table says {w:#04x}"
        );
    }
    assert_eq!(got.len(), want.len(), "{what}: length");
}

/// A whole 7k record with this body.
pub(crate) fn record_of(record_type_id: u32, body: &[u8]) -> Vec<u8> {
    let mut record = Vec::new();
    let open = OpenRecord::begin(&mut record, record_type_id, &STAMP);
    record.extend_from_slice(body);
    open.finish(&mut record);
    record
}

/// A whole record 1013.
pub(crate) fn heading(heading_rad: f32) -> Vec<u8> {
    let mut record = Vec::new();
    Heading1013 { heading_rad }.emit(&mut record, &STAMP);
    record
}

/// Body of the record that `emit` appended, after validation of the whole record.
pub(crate) fn emitted_body(emit: impl FnOnce(&mut Vec<u8>) -> Range<usize>) -> Vec<u8> {
    let mut buf = vec![0xAA; 3];
    let range = emit(&mut buf);
    assert_eq!(
        range,
        3..buf.len(),
        "a record goes to the end of the buffer"
    );
    Record::parse(&buf[range])
        .expect("emitted records are right")
        .body()
        .to_vec()
}

/// The bytes that `emit` appends to an empty buffer.
pub(crate) fn bytes_of<T>(emit: impl FnOnce(&mut Vec<u8>) -> T) -> Vec<u8> {
    let mut bytes = Vec::new();
    emit(&mut bytes);
    bytes
}

/// Feeds all of `bytes` in pieces of `cut` bytes, ends the stream and asserts that every byte belongs to a message or was skipped.
pub(crate) fn feed_to_end<F: Framing>(
    framing: F,
    bytes: &[u8],
    cut: usize,
    mut look: impl FnMut(Result<&[u8], WireError>),
) {
    let mut stream = Splitter::new(framing);
    let mut seen = 0;
    let mut look = |message: Result<&[u8], WireError>| {
        seen += message.map_or(0, <[u8]>::len) as u64;
        look(message);
    };
    for piece in bytes.chunks(cut) {
        stream.feed(piece, &mut look);
    }
    stream.finish();
    stream.feed(&[], &mut look);
    assert_eq!(seen + stream.skipped_bytes(), bytes.len() as u64);
}

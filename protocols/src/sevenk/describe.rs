//! Any record in words, one line. Nothing here can fail: what is wrong with a record is part of the words.

use std::fmt;

use super::frame::{DataRecordFrame, Record};
use super::records::RecordBody;

/// Words for a record; write it with `{}`.
#[derive(Debug, Clone, Copy)]
pub struct Description<'a> {
    record_bytes: &'a [u8],
}

/// Words for the whole record in `record_bytes` (no network frame), right or wrong.
pub fn describe(record_bytes: &[u8]) -> Description<'_> {
    Description { record_bytes }
}

impl fmt::Display for Description<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match Record::parse(self.record_bytes) {
            Ok(record) => {
                write!(f, "{}: ", record.frame)?;
                match RecordBody::parse(&record) {
                    Ok(body) => body.fmt(f),
                    Err(error) => write!(f, "body wrong: {error}"),
                }
            }
            Err(error) => match DataRecordFrame::parse(self.record_bytes) {
                Ok(frame) if frame.check().is_ok() => write!(f, "{frame}: record wrong: {error}"),
                _ => write!(
                    f,
                    "{} B that are no record: {error}",
                    self.record_bytes.len()
                ),
            },
        }
    }
}

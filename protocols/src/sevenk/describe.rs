//! Description of any record in one line of text. It never fails: errors in a record are part of the
//! text.

use std::fmt;

use super::frame::{DataRecordFrame, Record};
use super::record_body::RecordBody;

/// Description of a record, for use with `{}`.
#[derive(Debug, Clone, Copy)]
pub struct Description<'a> {
    record_bytes: &'a [u8],
}

/// Description of the whole record in `record_bytes` (without network frame), valid or not.
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
                    Err(error) => write!(f, "invalid body: {error}"),
                }
            }
            Err(error) => match DataRecordFrame::parse(self.record_bytes) {
                Ok(frame) if frame.check().is_ok() => write!(f, "{frame}: invalid record: {error}"),
                _ => write!(
                    f,
                    "{} B that are not a record: {error}",
                    self.record_bytes.len()
                ),
            },
        }
    }
}

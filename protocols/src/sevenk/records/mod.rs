//! Contents of 7k records: one file per family, each record a plain struct of the wire's fields. `parse` reads the body of a [`Record`]
//! (RTH and RD) and ignores further bytes, because later versions append fields. `emit` appends a whole record including frame and
//! checksum, and returns its byte range. Reserved bytes are written as 0 and ignored when read.
//!
//! Records with samples parse to views that borrow the body. `emit_NNNN` emits them from slices of wire numbers; the caller quantises.
//! Inconsistent slices are programming errors and panic.

mod attitude;
mod beamformed;
mod calibrated;
mod configuration;
mod detections;
mod geometry;
mod platform;
mod raw_iq;
mod settings;
mod side_scan;
mod snippets;
mod water_column;

pub(crate) use configuration::{text_field, text_of};

pub use attitude::{Attitude1016, AttitudeSet, emit_1016};
pub use beamformed::{BeamSample, Beamformed7018, PHASE_COUNTS_PER_RAD, Rth7018, emit_7018};
pub use calibrated::{
    CalibratedSide, CalibratedSideScan7057, Rth7057, Rth10038, SingleBeamIq10038, emit_7057,
    emit_10038,
};
pub use configuration::{Configuration7001, Module, emit_7001};
pub use detections::{Detection7027, RawDetections7027, Rth7027, emit_7027};
pub use geometry::{BeamAngles, BeamGeometry7004, emit_7004};
pub use platform::{
    Heading1013, Navigation1015, Position1003, RollPitchHeave1012, SoundVelocity7610,
};
pub use raw_iq::{RawIq7038, Rth7038, SAMPLE_TYPE_I16, emit_7038, emit_7038_element_major};
pub use settings::{RemoteSettings7503, SonarSettings7000};
pub use side_scan::{Rth7007, SideSamples, SideScan7007, emit_7007};
pub use snippets::{
    Rth7028, Rth7058, SnippetDescriptor, SnippetSamples, SnippetStrengths7058, Snippets7028,
    emit_7028, emit_7058,
};
pub use water_column::{
    BeamSamples, CompressedBeam, Rth7042, WaterColumn7042, emit_7042, flags_7042,
};

use std::fmt;

use super::control::{Ack7501, CommandError, ControlRequest, Nack7502};
use super::file::{Catalogue7300, FileHeader7200};
use super::frame::Record;
use super::{WireError, record_id};

/// Implements parsing, emission and constants for a record without data after its RTH.
macro_rules! rth_record {
    ($record:ty, $id:expr, $size:expr, $name:literal) => {
        impl crate::sevenk::frame::Fixed for $record {
            const SIZE_BYTES: usize = $size;
            const NAME: &'static str = $name;
        }

        impl $record {
            /// Record type.
            pub const RECORD_TYPE_ID: u32 = $id;
            /// Size of the RTH.
            pub const RTH_BYTES: usize = $size;

            /// Parses a record's body.
            pub fn parse(body: &[u8]) -> Result<Self, crate::sevenk::WireError> {
                crate::sevenk::frame::read_fixed(body)
            }

            /// Appends the whole record and returns its byte range.
            pub fn emit(
                &self,
                buf: &mut Vec<u8>,
                stamp: &crate::sevenk::RecordStamp,
            ) -> std::ops::Range<usize> {
                let open = crate::sevenk::OpenRecord::begin(buf, $id, stamp);
                crate::sevenk::frame::write_fixed(self, buf);
                open.finish(buf)
            }
        }
    };
}
pub(crate) use rth_record;

/// Implements length and name for the RTH of a record with data.
macro_rules! rth {
    ($rth:ty, $size:expr, $name:literal) => {
        impl crate::sevenk::frame::Fixed for $rth {
            const SIZE_BYTES: usize = $size;
            const NAME: &'static str = $name;
        }

        impl $rth {
            /// Size of the RTH.
            #[allow(unreachable_pub, reason = "some of the types are private to the crate")]
            pub const RTH_BYTES: usize = $size;
        }
    };
}
pub(crate) use rth;

/// The `len` bytes of record data from `at`, or an error that states the missing bytes.
pub(crate) fn data_at<'a>(
    body: &'a [u8],
    at: usize,
    len: u64,
    what: &'static str,
) -> Result<&'a [u8], WireError> {
    let data = body.get(at..).unwrap_or_default();
    // A length from the wire may exceed usize on a 32-bit machine, so it is compared as u64 before conversion.
    if (data.len() as u64) < len {
        return Err(WireError::Truncated {
            what,
            need_bytes: at as u64 + len,
            got_bytes: body.len() as u64,
        });
    }
    Ok(&data[..len as usize])
}

/// Declares each parsed record once, for parsing by record type and for display. Long records without data are boxed.
macro_rules! record_bodies {
    (
        plain { $($id:ident => $variant:ident($body:ty),)* }
        boxed { $($boxed_id:ident => $boxed_variant:ident($boxed_body:ty),)* }
    ) => {
        /// A parsed record body, by record type.
        #[derive(Debug, Clone, PartialEq)]
        #[allow(missing_docs, reason = "the names are those of the record types")]
        pub enum RecordBody<'a> {
            $($variant($body),)*
            $($boxed_variant(Box<$boxed_body>),)*
            /// Any other record type.
            Other(&'a [u8]),
        }

        impl<'a> RecordBody<'a> {
            /// Parses the body of a record.
            pub fn parse(record: &Record<'a>) -> Result<Self, BodyError> {
                let body = record.body();
                Ok(match record.frame.record_type_id {
                    $(record_id::$id => Self::$variant(<$body>::parse(body)?),)*
                    $(record_id::$boxed_id => Self::$boxed_variant(Box::new(<$boxed_body>::parse(body)?)),)*
                    _ => Self::Other(body),
                })
            }
        }

        impl fmt::Display for RecordBody<'_> {
            fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
                match self {
                    $(Self::$variant(record) => record.fmt(f),)*
                    $(Self::$boxed_variant(record) => record.fmt(f),)*
                    Self::Other(body) => {
                        write!(f, "an unsupported record type, {} B of data", body.len())
                    }
                }
            }
        }
    };
}

record_bodies! {
    plain {
        POSITION => Position(Position1003),
        ROLL_PITCH_HEAVE => RollPitchHeave(RollPitchHeave1012),
        HEADING => Heading(Heading1013),
        CONFIGURATION => Configuration(Configuration7001),
        BEAM_GEOMETRY => BeamGeometry(BeamGeometry7004<'a>),
        SIDE_SCAN => SideScan(SideScan7007<'a>),
        BEAMFORMED => Beamformed(Beamformed7018<'a>),
        RAW_IQ => RawIq(RawIq7038<'a>),
        FILE_CATALOGUE => FileCatalogue(Catalogue7300<'a>),
        REMOTE_CONTROL => RemoteControl(ControlRequest),
        REMOTE_CONTROL_ACK => Ack(Ack7501),
        REMOTE_CONTROL_NACK => Nack(Nack7502),
        SOUND_VELOCITY => SoundVelocity(SoundVelocity7610),
        NAVIGATION => Navigation(Navigation1015),
        ATTITUDE => Attitude(Attitude1016<'a>),
        RAW_DETECTIONS => RawDetections(RawDetections7027<'a>),
        SNIPPETS => Snippets(Snippets7028<'a>),
        COMPRESSED_WATER_COLUMN => WaterColumn(WaterColumn7042<'a>),
        CALIBRATED_SIDE_SCAN => CalibratedSideScan(CalibratedSideScan7057<'a>),
        SNIPPET_STRENGTHS => SnippetStrengths(SnippetStrengths7058<'a>),
        SINGLE_BEAM_IQ => SingleBeamIq(SingleBeamIq10038<'a>),
    }
    boxed {
        SONAR_SETTINGS => SonarSettings(SonarSettings7000),
        FILE_HEADER => FileHeader(FileHeader7200),
        REMOTE_CONTROL_SETTINGS => RemoteSettings(RemoteSettings7503),
    }
}

/// Why a record body is invalid.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum BodyError {
    /// The bytes do not fit the layout.
    #[error(transparent)]
    Wire(#[from] WireError),
    /// The command is malformed.
    #[error(transparent)]
    Command(#[from] CommandError),
}

//! Contents of 7k records, one file per family. Each record is a plain struct of its fields. `parse` reads the body of a
//! [`Record`](super::frame::Record) (record type header and data). It ignores further bytes, because later versions append fields.
//! `emit` appends a complete record with frame and checksum, and returns its byte range. Reserved bytes are written as 0 and
//! ignored when read.
//!
//! Records with samples parse to views that borrow the body. `emit_NNNN` writes such a record from slices of the numbers in the
//! record; the caller quantises. Inconsistent slices are programming errors and panic.

mod attitude;
mod beamformed;
mod calibrated;
mod configuration;
mod detections;
mod geometry;
mod installation;
mod platform;
mod profile;
mod raw_iq;
mod settings;
mod side_scan;
mod snippets;
mod water_column;

pub(crate) use configuration::{text_field, text_of};

pub use attitude::{Attitude1016, AttitudeSet, emit_1016};
pub use beamformed::{
    BeamSample, Beamformed7018, PHASE_COUNTS_PER_RAD, Rth7018, emit_7018, emit_7018_beam_major,
};
pub use calibrated::{
    CalibratedSide, CalibratedSideScan7057, Rth7057, Rth10038, SingleBeamIq10038, emit_7057,
    emit_10038,
};
pub use configuration::{Configuration7001, Module, emit_7001};
pub use detections::{Detection7027, RawDetections7027, Rth7027, emit_7027};
pub use geometry::{BeamAngles, BeamGeometry7004, emit_7004};
pub use installation::{Installation7030, MountingOffset, Version};
pub use platform::{
    Depth1008, Heading1013, Navigation1015, Position1003, RollPitchHeave1012, SoundVelocity7610,
};
pub use profile::{Rth1009, SoundVelocityProfile1009, VelocityAtDepth, emit_1009};
pub use raw_iq::{RawIq7038, Rth7038, SAMPLE_TYPE_I16, emit_7038, emit_7038_element_major};
pub use settings::{RemoteSettings7503, SonarSettings7000};
pub use side_scan::{Rth7007, SideSamples, SideScan7007, emit_7007};
pub use snippets::{
    Rth7028, Rth7058, SnippetDescriptor, SnippetSamples, SnippetStrengths7058, Snippets7028,
    emit_7028, emit_7058,
};
pub use water_column::{
    BeamSamples, CompressedBeam, Rth7042, WaterColumn7042, emit_7042, emit_7042_of_16_bits,
    flags_7042,
};

use super::WireError;

/// Implements parsing, emission and constants for a record without data after its RTH.
macro_rules! rth_record {
    ($record:ty, $id:expr, $size:expr, $name:literal) => {
        crate::layout::layout_of!($record, $size, $name, Little);

        impl $record {
            /// Record type.
            pub const RECORD_TYPE_ID: u32 = $id;
            /// Size of the record type header, bytes.
            pub const RTH_BYTES: usize = $size;

            /// Parses the body of the record. Returns an error if the body is too short.
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
                crate::layout::write_layout(self, buf);
                open.finish(buf)
            }
        }
    };
}
pub(crate) use rth_record;

/// Implements length and name for the RTH of a record with data.
macro_rules! rth {
    ($rth:ty, $size:expr, $name:literal) => {
        crate::layout::layout_of!($rth, $size, $name, Little);

        impl $rth {
            /// Size of the record type header, bytes.
            #[allow(unreachable_pub, reason = "some of the types are private to the crate")]
            pub const RTH_BYTES: usize = $size;
        }
    };
}
pub(crate) use rth;

/// The `len` bytes of record data from offset `at`, or an error with the number of missing bytes.
pub(crate) fn data_at<'a>(
    body: &'a [u8],
    at: usize,
    len: u64,
    what: &'static str,
) -> Result<&'a [u8], WireError> {
    let data = body.get(at..).unwrap_or_default();
    // A length in a record may exceed usize on a 32-bit machine, so it is compared as u64 before the conversion.
    if (data.len() as u64) < len {
        return Err(WireError::truncated(what, at as u64 + len, body.len()));
    }
    Ok(&data[..len as usize])
}

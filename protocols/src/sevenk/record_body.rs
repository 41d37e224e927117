//! Body of any record, parsed by record type.

use std::fmt;

use super::control::{Ack7501, CommandError, ControlRequest, Nack7502};
use super::file::{Catalogue7300, FileHeader7200};
use super::frame::Record;
use super::records::*;
use super::{WireError, record_id};

/// Declares each parsed record once, for parsing by record type and for display. Large records without data are
/// boxed.
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
        DEPTH => Depth(Depth1008),
        SOUND_VELOCITY_PROFILE => SoundVelocityProfile(SoundVelocityProfile1009<'a>),
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
        INSTALLATION => Installation(Installation7030),
        FILE_HEADER => FileHeader(FileHeader7200),
        REMOTE_CONTROL_SETTINGS => RemoteSettings(RemoteSettings7503),
    }
}

/// Error of an invalid record body.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum BodyError {
    /// The bytes do not fit the layout.
    #[error(transparent)]
    Wire(#[from] WireError),
    /// The command is malformed.
    #[error(transparent)]
    Command(#[from] CommandError),
}

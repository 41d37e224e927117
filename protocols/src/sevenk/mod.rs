//! Teledyne RESON 7k: overview, and common numbers.
//!
//! Source: "DATA FORMAT DEFINITION - 7k Data Format" v3.12, Drawing 20723, 5 May 2020, marked for public use. Record 7038 follows
//! the MIT licensed reader pyread7k, which calls the record a draft. Numbers are little endian. Angles are in rad, lengths in m,
//! times in UTC.
//!
//! A record consists of a data record frame ([`DataRecordFrame`], 64 bytes), a record type header (RTH), record data (RD), optional
//! data (OD) and a checksum. On the network each record is divided into packets, each after a [`NetworkFrame`] (36 bytes). In a
//! file, records are consecutive without network frames.
//!
//! - [`records`]: contents of records; each parses from a record's body and emits a whole record
//! - [`control`]: commands (7500) and their answers (7501, 7502)
//! - [`packet`]: division of records into packets and reassembly, for datagrams
//! - [`stream`]: bytes of a TCP connection to records, with resynchronisation
//! - [`file`](mod@file): header, catalogue and records of a `.s7k` file
//! - [`describe`](fn@describe): any record as text

pub mod control;
mod describe;
pub mod file;
pub mod frame;
pub mod packet;
mod record_body;
pub mod records;
pub mod stream;
pub mod time;

pub use control::{Command, CommandError, CommandErrorKind, ControlRequest, ErrorCode};
pub use describe::{Description, describe};
pub use frame::{DataRecordFrame, NetworkFrame, OpenRecord, Record, RecordStamp, checksum};
pub use packet::{Packetiser, Reassembler};
pub use record_body::{BodyError, RecordBody};
pub use stream::StreamDecoder;
pub use time::{SevenKTime, TimeError};

/// TCP and UDP port of a 7k Center.
pub const PORT: u16 = 7000;

/// Version in network frames and in data record frames.
pub const PROTOCOL_VERSION: u16 = 5;

/// Device identifiers of the record frame.
pub mod device_id {
    /// SeaBat T20.
    pub const SEABAT_T20: u32 = 20;
    /// SeaBat T50.
    pub const SEABAT_T50: u32 = 50;
    /// Any multibeam sonar.
    pub const GENERIC_MULTIBEAM: u32 = 103;
    /// Any side-scan sonar.
    pub const GENERIC_SIDE_SCAN: u32 = 104;
    /// The 7k Center. A client uses this address before it knows the sonar.
    pub const SONAR_SOURCE: u32 = 7000;
    /// User interface.
    pub const USER_INTERFACE: u32 = 7001;
    /// Recorder.
    pub const LOGGER: u32 = 7004;
    /// SeaBat 7125. Enumerator 0 is 200 kHz, 1 is 400 kHz.
    pub const SEABAT_7125: u32 = 7125;
    /// NORBIT sonar, type 13003.
    pub const NORBIT_13003: u32 = 13003;
    /// NORBIT sonar, type 13016.
    pub const NORBIT_13016: u32 = 13016;
}

/// Record type identifiers of the supported records.
pub mod record_id {
    /// Position.
    pub const POSITION: u32 = 1003;
    /// Depth.
    pub const DEPTH: u32 = 1008;
    /// Sound velocity profile.
    pub const SOUND_VELOCITY_PROFILE: u32 = 1009;
    /// Roll, pitch and heave.
    pub const ROLL_PITCH_HEAVE: u32 = 1012;
    /// Heading.
    pub const HEADING: u32 = 1013;
    /// Navigation.
    pub const NAVIGATION: u32 = 1015;
    /// Attitude.
    pub const ATTITUDE: u32 = 1016;
    /// Sonar settings of a ping.
    pub const SONAR_SETTINGS: u32 = 7000;
    /// Configuration: description of the sonar.
    pub const CONFIGURATION: u32 = 7001;
    /// Directions and widths of the beams.
    pub const BEAM_GEOMETRY: u32 = 7004;
    /// Side-scan line.
    pub const SIDE_SCAN: u32 = 7007;
    /// Beamformed samples.
    pub const BEAMFORMED: u32 = 7018;
    /// Raw detections.
    pub const RAW_DETECTIONS: u32 = 7027;
    /// Snippets: samples around detections.
    pub const SNIPPETS: u32 = 7028;
    /// Installation parameters: mounting of arrays and sensors.
    pub const INSTALLATION: u32 = 7030;
    /// Raw I and Q of the receive elements.
    pub const RAW_IQ: u32 = 7038;
    /// Compressed water column.
    pub const COMPRESSED_WATER_COLUMN: u32 = 7042;
    /// Calibrated side-scan line.
    pub const CALIBRATED_SIDE_SCAN: u32 = 7057;
    /// Snippet scattering strengths.
    pub const SNIPPET_STRENGTHS: u32 = 7058;
    /// Header of a file.
    pub const FILE_HEADER: u32 = 7200;
    /// Catalogue of a file.
    pub const FILE_CATALOGUE: u32 = 7300;
    /// Command.
    pub const REMOTE_CONTROL: u32 = 7500;
    /// Accepted command.
    pub const REMOTE_CONTROL_ACK: u32 = 7501;
    /// Refused command.
    pub const REMOTE_CONTROL_NACK: u32 = 7502;
    /// Settings for remote control.
    pub const REMOTE_CONTROL_SETTINGS: u32 = 7503;
    /// Sound velocity.
    pub const SOUND_VELOCITY: u32 = 7610;
    /// I and Q of a single beam.
    pub const SINGLE_BEAM_IQ: u32 = 10_038;
}

/// Bits of `control_flags` in 7000 and 7503.
pub mod control_flags {
    /// The sonar is active.
    pub const SYSTEM_ACTIVE: u32 = 1 << 15;
    /// Position of the timestamp state.
    pub const TIMESTAMP_STATE_SHIFT: u32 = 27;
    /// Bits of the timestamp state.
    pub const TIMESTAMP_STATE_MASK: u32 = 0b11 << TIMESTAMP_STATE_SHIFT;
    /// Timestamps are synchronised.
    pub const TIMESTAMP_STATE_OK: u32 = 3 << TIMESTAMP_STATE_SHIFT;
    /// The data come from a simulator.
    pub const SIMULATOR: u32 = 1 << 31;

    /// State of the timestamps, 0 to 3.
    pub const fn timestamp_state(flags: u32) -> u32 {
        (flags & TIMESTAMP_STATE_MASK) >> TIMESTAMP_STATE_SHIFT
    }
}

/// Order of the records of one ping. Readers assign the records of a file to the preceding 7000. Therefore 7000 is first, after the
/// sound velocity (7610), which readers need before the first detections.
pub const PING_RECORD_ORDER: [u32; 30] = [
    7610, 7000, 7503, 1750, 7002, 7004, 7017, 7006, 7027, 7007, 7008, 7010, 7011, 7012, 7013, 7018,
    7019, 7028, 7029, 7037, 7038, 7039, 7041, 7042, 7048, 7049, 7057, 7058, 7068, 7070,
];

/// Sort key of a record within its ping; records without a ping (navigation, answers) come last.
pub fn ping_order_rank(record_type_id: u32) -> usize {
    PING_RECORD_ORDER
        .iter()
        .position(|&id| id == record_type_id)
        .unwrap_or(PING_RECORD_ORDER.len())
}

/// Parse error of 7k. Every variant names the checked item and the values that disagree.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum WireError {
    #[error("{what} needs {need_bytes} bytes, only {got_bytes} are available")]
    /// Bytes are missing.
    Truncated {
        /// The checked item.
        what: &'static str,
        /// Required bytes.
        need_bytes: u64,
        /// Available bytes.
        got_bytes: u64,
    },
    #[error("network frame has protocol version {got}, not 5")]
    /// Unsupported version in the network frame.
    NetworkVersion {
        /// Value found.
        got: u16,
    },
    #[error("network frame has offset {got}, not 36")]
    /// Wrong offset in the network frame.
    NetworkOffset {
        /// Value found.
        got: u16,
    },
    #[error("record of {total_bytes} bytes exceeds the limit of {limit_bytes}")]
    /// The record is too long.
    Oversized {
        /// Size of the record.
        total_bytes: u32,
        /// Permitted size.
        limit_bytes: u32,
    },
    #[error(
        "network frame is inconsistent: packet {sequence_number} of {total_packets}, {packet_bytes} bytes of a record of {total_bytes}"
    )]
    /// Inconsistent network frame.
    PacketSizes {
        /// Size of the packet.
        packet_bytes: u32,
        /// Size of the record.
        total_bytes: u32,
        /// Index of the packet.
        sequence_number: u32,
        /// Number of packets.
        total_packets: u32,
    },
    #[error("packet {got} received, packet {expected} of the record expected")]
    /// A packet is out of order.
    FragmentSequence {
        /// Index required.
        expected: u32,
        /// Index found.
        got: u32,
    },
    #[error("data record frame has protocol version {got}, not 5")]
    /// Unsupported version in the data record frame.
    DataVersion {
        /// Value found.
        got: u16,
    },
    #[error("data record frame has sync pattern {got:#010x}, not 0x0000ffff")]
    /// Wrong sync pattern.
    SyncPattern {
        /// Value found.
        got: u32,
    },
    #[error("data record frame has offset {got}, neither 60 nor 64")]
    /// Wrong offset in the data record frame.
    RecordOffset {
        /// Value found.
        got: u16,
    },
    #[error("data record frame states {stated_bytes} bytes, the record has {got_bytes}")]
    /// The stated size differs from the record.
    RecordSize {
        /// Size in the frame.
        stated_bytes: u32,
        /// Size of the record.
        got_bytes: u64,
    },
    #[error("optional data at {offset_bytes} are outside the record of {size_bytes} bytes")]
    /// The optional data are outside the record.
    OptionalData {
        /// Offset in the frame.
        offset_bytes: u32,
        /// Size of the record.
        size_bytes: u32,
    },
    #[error("checksum is {stored:#010x}, computed {computed:#010x}")]
    /// The checksum does not match the bytes.
    Checksum {
        /// Checksum in the record.
        stored: u32,
        /// Sum of the bytes.
        computed: u32,
    },
    #[error("{what} {got} is not supported")]
    /// The value is not supported.
    Unsupported {
        /// The checked item.
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

    /// Error code of the answer to a malformed command.
    pub fn nack_code(&self) -> ErrorCode {
        match self {
            Self::NetworkVersion { .. } => ErrorCode::NetworkProtocolVersion,
            Self::NetworkOffset { .. } => ErrorCode::NetworkOffset,
            Self::DataVersion { .. } => ErrorCode::DataProtocolVersion,
            Self::SyncPattern { .. } => ErrorCode::DataSyncPattern,
            Self::Checksum { .. } => ErrorCode::DataChecksum,
            Self::Truncated { .. }
            | Self::Oversized { .. }
            | Self::PacketSizes { .. }
            | Self::FragmentSequence { .. }
            | Self::RecordOffset { .. }
            | Self::RecordSize { .. }
            | Self::OptionalData { .. }
            | Self::Unsupported { .. } => ErrorCode::InvalidParameter,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn settings_come_first_in_a_ping_and_navigation_after_it() {
        let mut ids = [1003, 7038, 7018, 7004, 7000, 7007, 7503];
        ids.sort_by_key(|&id| ping_order_rank(id));
        assert_eq!(ids, [7000, 7503, 7004, 7007, 7018, 7038, 1003]);
    }

    #[test]
    fn timestamp_state_is_bits_27_and_28() {
        assert_eq!(control_flags::timestamp_state(0x1800_0000), 3);
        assert_eq!(control_flags::timestamp_state(0x0800_0000), 1);
        assert_eq!(
            control_flags::SIMULATOR
                | control_flags::SYSTEM_ACTIVE
                | control_flags::TIMESTAMP_STATE_OK,
            0x9800_8000
        );
    }
}

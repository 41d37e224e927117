//! Records of a sonar protocol.

// ---------------------------------------------------------------- out

/// One complete protocol record, ready for framing.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Datagram {
    /// Record number in the protocol (7038, 7018, ...).
    pub record_type: u32,
    /// Bytes of the record.
    pub bytes: Vec<u8>,
}

//! Output record of a sonar protocol.

// ---------------------------------------------------------------- out

/// One complete protocol record, ready for framing.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Datagram {
    /// Record number in the protocol, for example 7038 or 7018.
    pub record_type: u32,
    /// Bytes of the record.
    pub bytes: Vec<u8>,
}

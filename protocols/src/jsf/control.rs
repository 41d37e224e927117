//! JSF commands and their answers. Source: the messages of LSTS DUNE's `Sensors.Edgetech2205`. For numbers that it does not use,
//! the sources are the public file-format manual and the names in DUNE's list.
//!
//! A client sends SET or GET. A successful SET has no answer. The answer to GET is a REPLY with the same message type, subsystem,
//! channel and sequence. The answer to a command that fails is an ERROR with a code. The body of a GET is ignored, because a widely
//! used client leaves stale bytes there.
//!
//! Most values are one i32. Message 22 has two, 129 has three u32, 123 a text of up to 256 bytes.

use std::fmt;
use std::ops::Range;

use super::{Message, MessageHeader, PROTOCOL_VERSION, command_type, emit_message, message_type};
use crate::WireError;
use crate::layout::{data_at, text_of};

/// Codes in the body of an ERROR.
pub mod error_code {
    /// The command failed.
    pub const FAILED: i32 = 1;
    /// The body has the wrong size.
    pub const WRONG_SIZE: i32 = 2;
    /// The subsystem does not exist.
    pub const UNKNOWN_SUBSYSTEM: i32 = 3;
    /// The channel does not exist.
    pub const UNKNOWN_CHANNEL: i32 = 4;
    /// The message type is not supported.
    pub const UNKNOWN_MESSAGE: i32 = 5;
    /// The pulse file does not exist.
    pub const UNKNOWN_PULSE: i32 = 6;
}

/// Values of message 44, and of the first field of message 182.
pub mod system_type {
    /// Side-scan with two frequencies.
    pub const DUAL_FREQUENCY_SIDE_SCAN: i32 = 4;
    /// Side-scan with one frequency.
    pub const SINGLE_FREQUENCY_SIDE_SCAN: i32 = 8;
    /// Bathymetric sonar with one pulse.
    pub const BATHYMETRIC_SINGLE_PULSE: i32 = 13;
}

/// Values of message 125.
pub mod trigger {
    /// The sonar's own clock starts pings.
    pub const INTERNAL: i32 = 0;
    /// An input signal starts pings.
    pub const EXTERNAL: i32 = 1;
    /// Another subsystem starts pings.
    pub const COUPLED: i32 = 2;
}

/// Length of the text of message 123 including its final NUL.
pub const MAX_PULSE_NAME_BYTES: usize = 256;

/// Value of a command or an answer.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Value {
    /// No value: a GET, or a body without meaning.
    None,
    /// One i32, for example alive, system type, data active, ping, gain (x 1000), rate (x 1000), trigger or range (mm).
    Number(i32),
    /// Message 22: time of the sonar's clock.
    Time {
        /// Seconds since 1970.
        seconds: i32,
        /// Milliseconds within the second.
        milliseconds: i32,
    },
    /// Message 129: coupling of subsystems.
    Coupling {
        /// Subsystem that starts the pings.
        master_subsystem: u32,
        /// Number of the master's pings per ping.
        divisor: u32,
        /// Delay after the master's ping, microseconds.
        delay_us: u32,
    },
    /// Message 123: name of a pulse file.
    PulseName(String),
    /// Code of an ERROR from [`error_code`].
    Error(i32),
}

/// A command or an answer.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Control {
    /// Message type, one of [`super::message_type`].
    pub message_type: u16,
    /// Purpose of the message, one of [`super::command_type`].
    pub command_type: u8,
    /// Subsystem number, one of [`super::subsystem`].
    pub subsystem: u8,
    /// Channel within the subsystem.
    pub channel: u8,
    /// Session number, not interpreted.
    pub session: u8,
    /// Sequence number; a reply repeats that of its command.
    pub sequence: u8,
    /// Contents of the body.
    pub value: Value,
}

fn i32_at(body: &[u8], at: usize) -> Result<i32, WireError> {
    let bytes = data_at(body, at, 4, "JSF command value")?;
    Ok(i32::from_le_bytes([bytes[0], bytes[1], bytes[2], bytes[3]]))
}

/// True if a message type is a supported command.
pub fn is_command(message_type: u16) -> bool {
    use message_type::*;
    matches!(
        message_type,
        SYSTEM_TIME
            | SHUTDOWN
            | ALIVE
            | SYSTEM_TYPE
            | OPERATIONAL
            | DATA_ACTIVE
            | PING..=PING_TRIGGER
            | PING_RANGE
            | PING_COUPLING
            | PING_AUTO_SELECT
            | ADC_GAIN..=ADC_RATE
    )
}

impl Control {
    /// Parses a message of the command connection.
    ///
    /// Errors: `Unsupported` for an unknown type (answered by [`error_code::UNKNOWN_MESSAGE`]). `Truncated` for a short body
    /// (answered by [`error_code::WRONG_SIZE`]).
    pub fn parse(message: &Message<'_>) -> Result<Self, WireError> {
        let (header, body) = (&message.header, message.body);
        let value = match (header.command_type, header.message_type) {
            (command_type::ERROR, _) => Value::Error(i32_at(body, 0)?),
            (_, kind) if !is_command(kind) => {
                return Err(WireError::unsupported("JSF command", kind));
            }
            (command_type::GET, _) => Value::None,
            (command_type::SET | command_type::REPLY, kind) => match kind {
                message_type::SYSTEM_TIME => Value::Time {
                    seconds: i32_at(body, 0)?,
                    milliseconds: i32_at(body, 4)?,
                },
                message_type::PING_COUPLING => Value::Coupling {
                    master_subsystem: i32_at(body, 0)? as u32,
                    divisor: i32_at(body, 4)? as u32,
                    delay_us: i32_at(body, 8)? as u32,
                },
                message_type::PING_SELECT => {
                    // One byte of the field is the final NUL.
                    Value::PulseName(text_of(&body[..body.len().min(MAX_PULSE_NAME_BYTES - 1)]))
                }
                _ => Value::Number(i32_at(body, 0)?),
            },
            (other, _) => return Err(WireError::unsupported("JSF command type", other)),
        };
        Ok(Self {
            message_type: header.message_type,
            command_type: header.command_type,
            subsystem: header.subsystem,
            channel: header.channel,
            session: header.session,
            sequence: header.sequence,
            value,
        })
    }

    /// Reply to this GET.
    pub fn reply(&self, value: Value) -> Self {
        Self {
            command_type: command_type::REPLY,
            value,
            ..self.clone()
        }
    }

    /// Error answer to this command.
    pub fn refuse(&self, code: i32) -> Self {
        Self {
            command_type: command_type::ERROR,
            value: Value::Error(code),
            ..self.clone()
        }
    }

    /// Appends the message and returns its byte range.
    pub fn emit(&self, buf: &mut Vec<u8>) -> Range<usize> {
        let header = MessageHeader {
            protocol_version: PROTOCOL_VERSION,
            session: self.session,
            command_type: self.command_type,
            sequence: self.sequence,
            ..MessageHeader::data(self.message_type, self.subsystem, self.channel)
        };
        emit_message(buf, &header, |buf| match &self.value {
            Value::None => {}
            Value::Number(number) | Value::Error(number) => buf.extend(number.to_le_bytes()),
            Value::Time {
                seconds,
                milliseconds,
            } => buf.extend(
                [*seconds, *milliseconds]
                    .map(i32::to_le_bytes)
                    .as_flattened(),
            ),
            Value::Coupling {
                master_subsystem,
                divisor,
                delay_us,
            } => buf.extend(
                [*master_subsystem, *divisor, *delay_us]
                    .map(u32::to_le_bytes)
                    .as_flattened(),
            ),
            Value::PulseName(name) => {
                buf.extend(crate::layout::text_field::<MAX_PULSE_NAME_BYTES>(name));
            }
        })
    }
}

/// Code of the ERROR that answers a parse error.
pub fn error_code_for(error: &WireError) -> i32 {
    match error {
        WireError::Unsupported { .. } => error_code::UNKNOWN_MESSAGE,
        WireError::Truncated { .. } | WireError::Oversized { .. } => error_code::WRONG_SIZE,
        WireError::Mark { .. } | WireError::Checksum { .. } => error_code::FAILED,
    }
}

impl fmt::Display for Control {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let what = match self.command_type {
            command_type::SET => "set",
            command_type::GET => "get",
            command_type::REPLY => "reply",
            _ => "error",
        };
        write!(
            f,
            "{what} {} of subsystem {} channel {}: {:?}",
            self.message_type, self.subsystem, self.channel, self.value
        )
    }
}

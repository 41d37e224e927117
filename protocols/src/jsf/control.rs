//! Commands and what is answered to them. Source: the messages that LSTS DUNE's `Sensors.Edgetech2205` sends and reads; numbers that it does
//! not use, from the public file-format manual and the names in its own list.
//!
//! A client sends SET, which is not answered where all is well, or GET, which is answered by a REPLY of the same message type, subsystem,
//! channel and sequence. A command that cannot be carried out is answered by an ERROR with a code. The body of a GET means nothing: a
//! client in wide use leaves stale bytes there.
//!
//! Most values are one i32. Message 22 is two, 129 three u32, 123 a text of up to 256 bytes.

use std::fmt;
use std::ops::Range;

use super::{Message, MessageHeader, PROTOCOL_VERSION, command_type, emit_message, message_type};
use crate::WireError;
use crate::layout::{data_at, text_of};

/// Codes in the body of an ERROR.
pub mod error_code {
    pub const FAILED: i32 = 1;
    pub const WRONG_SIZE: i32 = 2;
    pub const UNKNOWN_SUBSYSTEM: i32 = 3;
    pub const UNKNOWN_CHANNEL: i32 = 4;
    pub const UNKNOWN_MESSAGE: i32 = 5;
    pub const UNKNOWN_PULSE: i32 = 6;
}

/// Values of message 44, and of the first field of message 182.
pub mod system_type {
    pub const DUAL_FREQUENCY_SIDE_SCAN: i32 = 4;
    pub const SINGLE_FREQUENCY_SIDE_SCAN: i32 = 8;
    pub const BATHYMETRIC_SINGLE_PULSE: i32 = 13;
}

/// Values of message 125.
pub mod trigger {
    pub const INTERNAL: i32 = 0;
    pub const EXTERNAL: i32 = 1;
    pub const COUPLED: i32 = 2;
}

/// Length of the text of message 123, with the NUL that closes it.
pub const MAX_PULSE_NAME_BYTES: usize = 256;

/// What a command or an answer says.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Value {
    /// A GET, or a body that means nothing.
    None,
    /// One i32: alive, system type, data active, ping, gain (x 1000), rate (x 1000), trigger, range (mm), ...
    Number(i32),
    /// 22: the sonar's clock.
    Time { seconds: i32, milliseconds: i32 },
    /// 129
    Coupling {
        master_subsystem: u32,
        divisor: u32,
        delay_us: u32,
    },
    /// 123: the name of a pulse file.
    PulseName(String),
    /// An ERROR: see [`error_code`].
    Error(i32),
}

/// A command or an answer.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Control {
    pub message_type: u16,
    /// See [`command_type`].
    pub command_type: u8,
    pub subsystem: u8,
    pub channel: u8,
    pub session: u8,
    pub sequence: u8,
    pub value: Value,
}

fn i32_at(body: &[u8], at: usize) -> Result<i32, WireError> {
    let bytes = data_at(body, at, 4, "JSF command value")?;
    Ok(i32::from_le_bytes([bytes[0], bytes[1], bytes[2], bytes[3]]))
}

/// Whether a message type is a command of this list.
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
    /// Reads a message of the command connection. A type that is not in the list is `Unsupported`, which a sonar answers by
    /// [`error_code::UNKNOWN_MESSAGE`]; a body too short is `Truncated`, answered by [`error_code::WRONG_SIZE`].
    pub fn parse(message: &Message<'_>) -> Result<Self, WireError> {
        let (header, body) = (&message.header, message.body);
        let value = match (header.command_type, header.message_type) {
            (command_type::ERROR, _) => Value::Error(i32_at(body, 0)?),
            (_, kind) if !is_command(kind) => {
                return Err(WireError::Unsupported {
                    what: "JSF command",
                    got: kind.into(),
                });
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
                    // One byte of the field is its closing NUL.
                    Value::PulseName(text_of(&body[..body.len().min(MAX_PULSE_NAME_BYTES - 1)]))
                }
                _ => Value::Number(i32_at(body, 0)?),
            },
            (other, _) => {
                return Err(WireError::Unsupported {
                    what: "JSF command type",
                    got: other.into(),
                });
            }
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

    /// The answer to this GET.
    pub fn reply(&self, value: Value) -> Self {
        Self {
            command_type: command_type::REPLY,
            value,
            ..self.clone()
        }
    }

    /// The answer to this command where it cannot be carried out.
    pub fn refuse(&self, code: i32) -> Self {
        Self {
            command_type: command_type::ERROR,
            value: Value::Error(code),
            ..self.clone()
        }
    }

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

/// What an error in a command is answered by.
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

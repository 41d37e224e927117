//! Remote control: commands (7500), and the answers 7501 (accepted) and 7502 (refused). Source: DFD 3.12.
//!
//! ```text
//! 7500 RTH   0 u32 remote_control_id   4 u32 ticket   8 u64 x 2 tracking_number        24 bytes, then the arguments
//! 7501 RTH   0 u32 ticket   4 u64 x 2 tracking_number                                  20 bytes
//! 7502 RTH   0 u32 ticket   4 u64 x 2 tracking_number   20 u32 error_code              24 bytes
//! ```
//!
//! A command without arguments is sent with one empty byte and accepted with any number of bytes. Arguments beyond the known ones
//! are ignored. An answer repeats ticket and tracking number. Accepted commands are echoed to the clients that subscribe to 7500.

use std::fmt;
use std::ops::Range;

use binrw::{BinRead, BinWrite};

use super::frame::{Layout, OpenRecord, RecordStamp, read_fixed, write_layout};
use super::record_id;
use super::records::{rth, rth_record};

/// Identification of a command and its answer.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, BinRead, BinWrite)]
pub struct ControlHeader {
    /// Number of a [`Command`], or another number.
    pub remote_control_id: u32,
    /// Number chosen by the client.
    pub ticket: u32,
    /// Identifier chosen by the client.
    pub tracking_number: [u64; 2],
}

rth!(ControlHeader, 24, "7500 remote control");

/// Record 7501 (acknowledge): a command is accepted.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, BinRead, BinWrite)]
pub struct Ack7501 {
    /// Ticket of the command.
    pub ticket: u32,
    /// Tracking number of the command.
    pub tracking_number: [u64; 2],
}

/// Record 7502 (not acknowledge): a command is refused.
#[derive(Debug, Clone, Copy, PartialEq, Eq, BinRead, BinWrite)]
pub struct Nack7502 {
    /// Ticket of the command.
    pub ticket: u32,
    /// Tracking number of the command.
    pub tracking_number: [u64; 2],
    #[br(map = |code: u32| ErrorCode::from_code(code))]
    #[bw(map = |error: &ErrorCode| error.code())]
    /// Reason for the refusal.
    pub error: ErrorCode,
}

rth_record!(
    Ack7501,
    record_id::REMOTE_CONTROL_ACK,
    20,
    "7501 acknowledgement"
);
rth_record!(Nack7502, record_id::REMOTE_CONTROL_NACK, 24, "7502 refusal");

impl ControlHeader {
    /// Answer that accepts this command.
    pub fn ack(&self) -> Ack7501 {
        Ack7501 {
            ticket: self.ticket,
            tracking_number: self.tracking_number,
        }
    }

    /// Answer that refuses this command.
    pub fn nack(&self, error: ErrorCode) -> Nack7502 {
        Nack7502 {
            ticket: self.ticket,
            tracking_number: self.tracking_number,
            error,
        }
    }
}

/// Declares each error code once, for both directions and for display.
macro_rules! error_codes {
    ($($name:ident = $code:literal, $words:literal;)*) => {
        /// Reason for refusing a command.
        #[derive(Debug, Clone, Copy, PartialEq, Eq)]
        #[allow(missing_docs, reason = "the names are those of the DFD")]
pub enum ErrorCode {
            $(#[doc = $words] $name,)*
            /// A code that is not in the DFD.
            Unlisted(u32),
        }

        impl ErrorCode {
            /// All listed codes.
            pub const LISTED: &'static [Self] = &[$(Self::$name),*];

            /// Code in the record.
            pub const fn code(self) -> u32 {
                match self {
                    $(Self::$name => $code,)*
                    Self::Unlisted(code) => code,
                }
            }

            /// The error with this code.
            pub const fn from_code(code: u32) -> Self {
                match code {
                    $($code => Self::$name,)*
                    _ => Self::Unlisted(code),
                }
            }
        }

        impl fmt::Display for ErrorCode {
            fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
                let words = match self {
                    $(Self::$name => $words,)*
                    Self::Unlisted(_) => "unlisted error",
                };
                write!(f, "{words} ({:#06x})", self.code())
            }
        }
    };
}

error_codes! {
    SystemNotReady = 0x7000, "system not ready";
    ParameterOutOfRange = 0x7001, "parameter out of range";
    RecordNotAvailable = 0x7002, "record not available";
    ExternalRecordNotAvailable = 0x7005, "external record not available";
    FeatureNotAvailable = 0x7006, "feature not available";
    RemoteCommandNotFound = 0x7007, "remote command not found";
    InvalidParameter = 0x7008, "invalid parameter";
    InvalidDeviceId = 0x7009, "invalid device id";
    RecordIsSubscriptionOnly = 0x700A, "record is subscription only";
    ParameterValueClipped = 0x700B, "parameter value clipped";
    RemoteCommandDenied = 0x700C, "remote command denied";
    NetworkProtocolVersion = 0x7050, "network protocol version";
    NetworkOffset = 0x7051, "network offset";
    DataProtocolVersion = 0x7052, "data protocol version";
    DataSyncPattern = 0x7053, "data sync pattern";
    DataChecksum = 0x7054, "data checksum";
}

/// Declares the values of an argument once, for both directions and for display.
macro_rules! listed {
    ($(#[$doc:meta])* $name:ident($wire:ident, $argument:literal) { $($(#[$value_doc:meta])* $value:ident = $number:literal, $words:literal;)* }) => {
        $(#[$doc])*
        #[derive(Debug, Clone, Copy, PartialEq, Eq)]
        pub enum $name {
            $($(#[$value_doc])* $value,)*
        }

        impl fmt::Display for $name {
            fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
                f.write_str(match self { $(Self::$value => $words,)* })
            }
        }

        impl Argument for $name {
            fn parse(a: &mut Arguments<'_>, _: &'static str) -> Result<Self, CommandErrorKind> {
                match $wire::parse(a, $argument)? {
                    $($number => Ok(Self::$value),)*
                    other => Err(a.not_listed($argument, u32::from(other))),
                }
            }

            fn emit(&self, buf: &mut Vec<u8>) {
                let number: $wire = match self { $(Self::$value => $number,)* };
                number.emit(buf);
            }
        }
    };
}

listed! {
    /// Type of the transmitted pulse.
    PulseType(u32, "pulse type") {
        /// Continuous wave.
        ContinuousWave = 0, "continuous wave";
        /// Linear frequency modulation.
        LinearChirp = 1, "linear chirp";
    }
}

listed! {
    /// Type of the receiver gain.
    GainType(u32, "gain type") {
        /// Time-varying gain.
        Tvg = 0, "TVG";
        /// Constant gain.
        Fixed = 2, "fixed";
    }
}

listed! {
    /// Envelope of the transmitted pulse.
    PulseEnvelope(u32, "pulse envelope") {
        /// Tapered rectangle.
        Rectangle = 0, "Rectangle";
        /// Tukey window.
        Tukey = 1, "Tukey";
    }
}

listed! {
    /// Transport of a third-party connection.
    Transport(u16, "transport") {
        /// Datagrams.
        Udp = 0, "Udp";
        /// Stream.
        Tcp = 1, "Tcp";
    }
}

/// Destination of a third-party connection.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct ThirdParty {
    /// Address as in the record. The DFD does not define the byte order, and no client has confirmed it.
    pub ipv4: u32,
    /// Port of the third party.
    pub port: u16,
    /// Transport to use.
    pub transport: Transport,
}

/// Declares each command once. A declaration has the number, the arguments in their order in the record with their names in errors,
/// reserved bytes after them, and a text.
macro_rules! commands {
    ($(
        $(#[$doc:meta])*
        $id:literal $command:ident
        $({ $($(#[$field_doc:meta])* $field:ident: $kind:ty $(as $argument:literal)?,)* })?
        $(($value:ident: $value_kind:ty))?
        $(reserved $reserved_bytes:literal)?
        => $words:literal $(, $word:expr)?;
    )*) => {
        /// Command with its arguments. Numbers are finite; the server determines whether the sonar supports the values.
        #[derive(Debug, Clone, PartialEq)]
        pub enum Command {
            $($(#[$doc])* $command $({ $($(#[$field_doc])* $field: $kind,)* })? $(($value_kind))?,)*
            /// Any other remote control identifier. The answer is [`ErrorCode::RemoteCommandNotFound`]. Its arguments are not
            /// stored.
            Unknown(u32),
        }

        impl Command {
            /// Parses the arguments of a command.
            pub fn parse(remote_control_id: u32, arguments: &[u8]) -> Result<Self, CommandErrorKind> {
                let a = &mut Arguments { remote_control_id, bytes: arguments, at: 0 };
                Ok(match remote_control_id {
                    $($id => Self::$command
                        $({ $($field: Argument::parse(a, concat!($($argument)?))?,)* })?
                        $((<$value_kind>::parse(a, "")?))?,)*
                    other => Self::Unknown(other),
                })
            }

            /// Identifier of the command.
            pub fn remote_control_id(&self) -> u32 {
                match self {
                    $(Self::$command { .. } => $id,)*
                    Self::Unknown(id) => *id,
                }
            }

            /// Appends the arguments, with reserved arguments as 0. A command without arguments has one empty byte.
            pub fn emit_arguments(&self, buf: &mut Vec<u8>) {
                match self {
                    $(Self::$command $({ $($field),* })? $(($value))? => {
                        $($($field.emit(buf);)*)?
                        $($value.emit(buf);)?
                        $(buf.extend([0; $reserved_bytes]);)?
                    })*
                    Self::Unknown(_) => buf.push(0),
                }
            }
        }

        impl fmt::Display for Command {
            fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
                match self {
                    $(Self::$command $({ $($field),* })? $(($value))? => write!(f, $words $(, $word)?),)*
                    Self::Unknown(_) => f.write_str("not a known command"),
                }
            }
        }
    };
}

commands! {
    /// Sets the range.
    1003 Range {
        /// Slant range.
        range_m: f32 as "range",
    } => "range {range_m} m";
    /// Sets the maximum ping rate; 0 inhibits pinging.
    1004 MaxPingRate {
        /// Maximum rate.
        pings_per_s: f32 as "ping rate",
    } => "at most {pings_per_s} pings/s";
    /// Sets the source level.
    1005 Power {
        /// Source level, dB re 1 uPa at 1 m.
        power_db: f32 as "power",
    } => "power {power_db} dB re 1 uPa at 1 m";
    /// Sets the pulse length.
    1006 PulseLength {
        /// Pulse length.
        pulse_length_s: f32 as "pulse length",
    } => "pulse length {pulse_length_s} s";
    /// Sets the pulse type.
    1007 PulseType(pulse_type: PulseType) => "pulse type {pulse_type}";
    /// Sets the receiver gain.
    1008 Gain {
        /// Gain.
        gain_db: f32 as "gain",
    } => "gain {gain_db} dB";
    /// Sets the flags of the bottom detection.
    1009 BottomDetectionMask {
        /// Flags: bit 8 range filter, bit 9 depth filter, bits 10 to 13 adaptive gate.
        flags: u32,
    } => "bottom detection mask {flags:#x}";
    /// Sets the limits of the bottom detection.
    1010 BottomDetectionFilter {
        /// Minimum range.
        min_range_m: f32 as "minimum range",
        /// Maximum range.
        max_range_m: f32 as "maximum range",
        /// Minimum depth.
        min_depth_m: f32 as "minimum depth",
        /// Maximum depth.
        max_depth_m: f32 as "maximum depth",
        /// Tilt of the gates; older clients omit it.
        gate_tilt_rad: Option<f32> as "gate tilt",
    } =>
        "bottom detection range {min_range_m}..{max_range_m} m, depth {min_depth_m}..{max_depth_m} m{}",
        gate_tilt_rad.map_or(String::new(), |tilt| format!(", gate tilt {tilt} rad"));
    /// Sets the type of the receiver gain.
    1017 GainType(gain_type: GainType) reserved 16 => "gain type {gain_type}";
    /// Sets the envelope of the pulse.
    1020 PulseEnvelope {
        /// Envelope.
        envelope: PulseEnvelope,
        /// Parameter of the envelope.
        shading: f32 as "shading",
    } reserved 16 => "pulse envelope {envelope}, shading {shading}";
    /// Sets the direction of the transmit beam.
    1021 ProjectorSteering {
        /// Along-track angle.
        vertical_rad: f32 as "vertical angle",
        /// Across-track angle.
        horizontal_rad: f32 as "horizontal angle",
    } => "projector steering {vertical_rad} rad vertical, {horizontal_rad} rad horizontal";
    /// Sets the widths of the transmit beam.
    1022 ProjectorBeamWidths {
        /// Along-track width, -3 dB.
        vertical_rad: f32 as "vertical width",
        /// Across-track width, -3 dB.
        horizontal_rad: f32 as "horizontal width",
    } => "projector beam widths {vertical_rad} rad vertical, {horizontal_rad} rad horizontal";
    /// Sets the centre frequency.
    1026 CenterFrequency {
        /// Centre frequency.
        frequency_hz: f32 as "frequency",
    } => "centre frequency {frequency_hz} Hz";
    /// Sets the band of the chirp.
    1027 ChirpBand {
        /// Frequency at the start of the pulse.
        start_hz: f32 as "start frequency",
        /// Frequency at the end of the pulse.
        stop_hz: f32 as "stop frequency",
    } => "chirp {start_hz} to {stop_hz} Hz";
    /// Sets the motion stabilisation.
    1033 MotionCompensation {
        /// Roll stabilisation; 0 is off.
        roll: u8,
        /// Pitch stabilisation; 0 is off.
        pitch: u8,
    } reserved 10 => "motion compensation roll {roll}, pitch {pitch}";
    /// Sets the window of the matched filter.
    1034 MatchFilter {
        /// Number of the window.
        window: u32,
        /// Parameter of the window.
        shading: f32 as "shading",
    } reserved 16 => "match filter window {window}, shading {shading}";
    /// Sets the swath.
    1035 CoverageSector {
        /// Width of the swath.
        sector_rad: f32 as "sector",
        /// Direction of its centre, positive to starboard.
        rx_steering_rad: f32 as "receiver steering",
    } => "coverage sector {sector_rad} rad, steered {rx_steering_rad} rad to starboard";
    /// Requests a record once; answered by 7501, then the record.
    1050 SingleRecord {
        /// Record type.
        record_type_id: u32,
    } => "send record {record_type_id} once";
    /// Adds to the subscription.
    1051 Subscribe {
        /// Record types.
        record_type_ids: Vec<u32>,
    } => "subscribe to {record_type_ids:?}";
    /// Ends the subscription.
    1052 EndSubscriptions reserved 1 => "end all subscriptions";
    /// Sends records to a third party.
    1053 ConnectThirdParty {
        /// Destination.
        party: ThirdParty,
        /// Record types.
        record_type_ids: Vec<u32>,
    } => "send {record_type_ids:?} to {party}";
    /// Stops sending to a third party.
    1054 DisconnectThirdParty {
        /// Destination.
        party: ThirdParty,
    } => "stop sending to {party}";
    /// Adds a range of record types to the subscription, both ends included.
    1055 SubscribeRange {
        /// First record type.
        first: u32,
        /// Last record type.
        last: u32,
    } => "subscribe to {first}..={last}";
    /// Removes from the subscription.
    1056 Unsubscribe {
        /// Record types.
        record_type_ids: Vec<u32>,
    } => "unsubscribe from {record_type_ids:?}";
    /// Starts continuous pinging.
    1100 StartPinging reserved 1 => "start pinging";
    /// Stops pinging.
    1101 StopPinging reserved 1 => "stop pinging";
    /// Transmits one ping and stops continuous pinging.
    1107 SinglePing reserved 1 => "ping once";
    /// Selects the external trigger.
    1114 ExternalTrigger reserved 1 => "ping by external trigger";
    /// Sets the trigger output.
    1115 TriggerOut {
        /// Mode of the output.
        flags: u32,
        /// Length of the signal.
        length_s: f64 as "length",
        /// Delay after the ping.
        offset_s: f64 as "offset",
    } => "trigger out flags {flags:#x}, length {length_s} s, offset {offset_s} s";
    /// Sets the edge of the pulse per second.
    1116 PpsEdge {
        /// Number of the edge.
        edge: u32,
    } => "PPS edge {edge}";
    /// Sets the limits on snippets.
    1118 SnippetControl {
        /// Flags: bit 0 automatic, bit 1 minimum window, bit 2 maximum window.
        flags: u32,
        /// Minimum length of a snippet.
        min_window_samples: u32,
        /// Maximum length of a snippet.
        max_window_samples: u32,
    } => "snippets flags {flags:#x}, window {min_window_samples}..{max_window_samples} samples";
    /// Transmits a number of pings.
    1121 PingTimes {
        /// Number of pings.
        count: u32,
    } => "ping {count} times";
    /// Sets up record 7042.
    7042 CompressedWaterColumn {
        /// Flags of the record.
        flags: u32,
    } => "compressed water column flags {flags:#x}";
    /// Sets the sound velocity.
    7610 SoundVelocity {
        /// Flags: bit 0 override, bit 1 settings only, bit 2 filter.
        flags: u16,
        /// Sound velocity.
        sound_velocity_m_per_s: f32 as "sound velocity",
        /// Parameter of the filter.
        filter: u8,
    } reserved 3 => "sound velocity {sound_velocity_m_per_s} m/s, flags {flags:#x}, filter {filter}";
}

/// Error of a malformed command. It has the header if the header is complete, so that the command can be answered.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[error("{kind}")]
pub struct CommandError {
    /// Header of the command.
    pub header: Option<ControlHeader>,
    /// Reason.
    pub kind: CommandErrorKind,
}

/// Reason why a command is malformed.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum CommandErrorKind {
    #[error("a command needs a header of 24 bytes, only {got_bytes} are available")]
    /// The header is incomplete.
    HeaderTruncated {
        /// Available bytes.
        got_bytes: usize,
    },
    #[error(
        "command {remote_control_id} needs at least {need_bytes} bytes of arguments, only {got_bytes} are available"
    )]
    /// The arguments are incomplete.
    ArgumentsTruncated {
        /// Identifier of the command.
        remote_control_id: u32,
        /// Required bytes.
        need_bytes: u64,
        /// Available bytes.
        got_bytes: usize,
    },
    #[error("command {remote_control_id} has {argument}, which is not a finite number")]
    /// An argument is NaN or infinite.
    NotFinite {
        /// Identifier of the command.
        remote_control_id: u32,
        /// Name of the argument.
        argument: &'static str,
    },
    #[error("command {remote_control_id} has {argument} {value}, which is not a listed value")]
    /// An argument is not one of the listed values.
    NotListed {
        /// Identifier of the command.
        remote_control_id: u32,
        /// Name of the argument.
        argument: &'static str,
        /// Value found.
        value: u32,
    },
}

impl CommandError {
    /// Error code of the refusal.
    pub fn nack_code(&self) -> ErrorCode {
        match self.kind {
            CommandErrorKind::NotListed { .. } => ErrorCode::ParameterOutOfRange,
            CommandErrorKind::HeaderTruncated { .. }
            | CommandErrorKind::ArgumentsTruncated { .. }
            | CommandErrorKind::NotFinite { .. } => ErrorCode::InvalidParameter,
        }
    }

    /// Refusal of the command. Ticket and tracking number are 0 without a complete header.
    pub fn nack(&self) -> Nack7502 {
        self.header.unwrap_or_default().nack(self.nack_code())
    }
}

// ------------------------------------------------------------------------------------------------------------------------------- parse

/// Reader of the arguments of one command, in order.
struct Arguments<'a> {
    remote_control_id: u32,
    bytes: &'a [u8],
    at: usize,
}

impl<'a> Arguments<'a> {
    fn take<const N: usize>(&mut self) -> Result<[u8; N], CommandErrorKind> {
        let taken = self
            .rest()
            .first_chunk()
            .copied()
            .ok_or_else(|| self.truncated(N as u64))?;
        self.at += N;
        Ok(taken)
    }

    fn rest(&self) -> &'a [u8] {
        self.bytes.get(self.at..).unwrap_or_default()
    }

    fn truncated(&self, more_bytes: u64) -> CommandErrorKind {
        CommandErrorKind::ArgumentsTruncated {
            remote_control_id: self.remote_control_id,
            need_bytes: self.at as u64 + more_bytes,
            got_bytes: self.bytes.len(),
        }
    }

    fn not_finite(&self, argument: &'static str) -> CommandErrorKind {
        CommandErrorKind::NotFinite {
            remote_control_id: self.remote_control_id,
            argument,
        }
    }

    fn not_listed(&self, argument: &'static str, value: u32) -> CommandErrorKind {
        CommandErrorKind::NotListed {
            remote_control_id: self.remote_control_id,
            argument,
            value,
        }
    }
}

/// Argument in both directions. `argument` is its name in errors.
trait Argument: Sized {
    fn parse(a: &mut Arguments<'_>, argument: &'static str) -> Result<Self, CommandErrorKind>;
    fn emit(&self, buf: &mut Vec<u8>);
}

macro_rules! number_argument {
    ($($number:ident $(finite $is_finite:ident)?),*) => {$(
        impl Argument for $number {
            fn parse(a: &mut Arguments<'_>, _argument: &'static str) -> Result<Self, CommandErrorKind> {
                let value = Self::from_le_bytes(a.take()?);
                $(if !value.$is_finite() {
                    return Err(a.not_finite(_argument));
                })?
                Ok(value)
            }

            fn emit(&self, buf: &mut Vec<u8>) {
                buf.extend(self.to_le_bytes());
            }
        }
    )*};
}

number_argument!(u8, u16, u32, f32 finite is_finite, f64 finite is_finite);

/// Last argument, which older clients omit.
impl Argument for Option<f32> {
    fn parse(a: &mut Arguments<'_>, argument: &'static str) -> Result<Self, CommandErrorKind> {
        if a.rest().len() < 4 {
            return Ok(None);
        }
        f32::parse(a, argument).map(Some)
    }

    fn emit(&self, buf: &mut Vec<u8>) {
        self.iter().for_each(|value| value.emit(buf));
    }
}

/// List of record types after its length. The length is used only after the number of bytes is checked.
impl Argument for Vec<u32> {
    fn parse(a: &mut Arguments<'_>, argument: &'static str) -> Result<Self, CommandErrorKind> {
        let count = u32::parse(a, argument)?;
        if (a.rest().len() as u64) < 4 * u64::from(count) {
            return Err(a.truncated(4 * u64::from(count)));
        }
        (0..count).map(|_| u32::parse(a, argument)).collect()
    }

    fn emit(&self, buf: &mut Vec<u8>) {
        (self.len() as u32).emit(buf);
        self.iter().for_each(|id| id.emit(buf));
    }
}

impl Argument for ThirdParty {
    fn parse(a: &mut Arguments<'_>, argument: &'static str) -> Result<Self, CommandErrorKind> {
        Ok(Self {
            ipv4: Argument::parse(a, argument)?,
            port: Argument::parse(a, argument)?,
            transport: Argument::parse(a, argument)?,
        })
    }

    fn emit(&self, buf: &mut Vec<u8>) {
        self.ipv4.emit(buf);
        self.port.emit(buf);
        self.transport.emit(buf);
    }
}

impl fmt::Display for ThirdParty {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(
            f,
            "{} {:#010x} port {}",
            self.transport, self.ipv4, self.port
        )
    }
}

/// Record 7500 (remote control): a command, and the values that its answer repeats.
#[derive(Debug, Clone, PartialEq)]
pub struct ControlRequest {
    /// Number chosen by the client.
    pub ticket: u32,
    /// Identifier chosen by the client.
    pub tracking_number: [u64; 2],
    /// The command.
    pub command: Command,
}

impl ControlRequest {
    /// Size of the record type header, bytes.
    pub const RTH_BYTES: usize = ControlHeader::SIZE_BYTES;

    /// Parses the body of a 7500 record.
    pub fn parse(body: &[u8]) -> Result<Self, CommandError> {
        let header: ControlHeader = read_fixed(body).map_err(|_| CommandError {
            header: None,
            kind: CommandErrorKind::HeaderTruncated {
                got_bytes: body.len(),
            },
        })?;
        let command = Command::parse(header.remote_control_id, &body[ControlHeader::SIZE_BYTES..])
            .map_err(|kind| CommandError {
                header: Some(header),
                kind,
            })?;
        Ok(Self {
            ticket: header.ticket,
            tracking_number: header.tracking_number,
            command,
        })
    }

    /// Header of the command.
    pub fn header(&self) -> ControlHeader {
        ControlHeader {
            remote_control_id: self.command.remote_control_id(),
            ticket: self.ticket,
            tracking_number: self.tracking_number,
        }
    }

    /// Appends the 7500 record.
    pub fn emit(&self, buf: &mut Vec<u8>, stamp: &RecordStamp) -> Range<usize> {
        let open = OpenRecord::begin(buf, record_id::REMOTE_CONTROL, stamp);
        write_layout(&self.header(), buf);
        self.command.emit_arguments(buf);
        open.finish(buf)
    }
}

// ------------------------------------------------------------------------------------------------------------------------------- print

impl fmt::Display for ControlRequest {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(
            f,
            "command {}, ticket {}: {}",
            self.command.remote_control_id(),
            self.ticket,
            self.command
        )
    }
}

impl fmt::Display for Ack7501 {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "accepted, ticket {}", self.ticket)
    }
}

impl fmt::Display for Nack7502 {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "refused, ticket {}: {}", self.ticket, self.error)
    }
}

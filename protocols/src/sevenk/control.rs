//! Remote control: 7500 commands, and the answers 7501 (accepted) and 7502 (refused). Source: DFD 3.12.
//!
//! ```text
//! 7500 RTH   0 u32 remote_control_id   4 u32 ticket   8 u64 x 2 tracking_number        24 bytes, then the arguments
//! 7501 RTH   0 u32 ticket   4 u64 x 2 tracking_number                                  20 bytes
//! 7502 RTH   0 u32 ticket   4 u64 x 2 tracking_number   20 u32 error_code              24 bytes
//! ```
//!
//! A command without arguments is sent with one empty byte after it, and accepted with any number of bytes. Arguments beyond the known ones
//! are ignored. An answer repeats ticket and tracking number. Accepted commands are echoed to the clients subscribed to 7500.

use std::fmt;
use std::ops::Range;

use binrw::{BinRead, BinWrite};

use super::frame::{Fixed, OpenRecord, RecordStamp, read_fixed, write_fixed};
use super::record_id;
use super::records::{rth, rth_record};

/// Identification of a command and its answer.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, BinRead, BinWrite)]
pub struct ControlHeader {
    /// One of [`command_id`], or another number.
    pub remote_control_id: u32,
    /// Number chosen by the client.
    pub ticket: u32,
    /// Identifier chosen by the client.
    pub tracking_number: [u64; 2],
}

rth!(ControlHeader, 24, "7500 remote control");

/// 7501: the command was accepted.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, BinRead, BinWrite)]
pub struct Ack7501 {
    /// Ticket of the command.
    pub ticket: u32,
    /// Tracking number of the command.
    pub tracking_number: [u64; 2],
}

/// 7502: the command was refused.
#[derive(Debug, Clone, Copy, PartialEq, Eq, BinRead, BinWrite)]
pub struct Nack7502 {
    /// Ticket of the command.
    pub ticket: u32,
    /// Tracking number of the command.
    pub tracking_number: [u64; 2],
    #[br(map = |code: u32| ErrorCode::from_code(code))]
    #[bw(map = |error: &ErrorCode| error.code())]
    /// Reason.
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

/// Declares each error code once for both directions and for display.
macro_rules! error_codes {
    ($($name:ident = $code:literal, $words:literal;)*) => {
        /// Reason for refusing a command.
        #[derive(Debug, Clone, Copy, PartialEq, Eq)]
        #[allow(missing_docs, reason = "the names are those of the DFD")]
pub enum ErrorCode {
            $(#[doc = $words] $name,)*
            /// A code that the DFD does not list.
            Unlisted(u32),
        }

        impl ErrorCode {
            /// All listed codes.
            pub const LISTED: &'static [Self] = &[$(Self::$name),*];

            /// Code on the wire.
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

/// Remote control identifiers.
pub mod command_id {
    /// Range.
    pub const RANGE: u32 = 1003;
    /// Maximum ping rate.
    pub const MAX_PING_RATE: u32 = 1004;
    /// Source level.
    pub const POWER: u32 = 1005;
    /// Pulse length.
    pub const PULSE_LENGTH: u32 = 1006;
    /// Pulse type.
    pub const PULSE_TYPE: u32 = 1007;
    /// Receiver gain.
    pub const GAIN: u32 = 1008;
    /// Flags of the bottom detection.
    pub const BOTTOM_DETECTION_MASK: u32 = 1009;
    /// Limits of the bottom detection.
    pub const BOTTOM_DETECTION_FILTER: u32 = 1010;
    /// Type of the receiver gain.
    pub const GAIN_TYPE: u32 = 1017;
    /// Envelope of the pulse.
    pub const PULSE_ENVELOPE: u32 = 1020;
    /// Direction of the transmit beam.
    pub const PROJECTOR_STEERING: u32 = 1021;
    /// Widths of the transmit beam.
    pub const PROJECTOR_BEAM_WIDTHS: u32 = 1022;
    /// Centre frequency.
    pub const CENTER_FREQUENCY: u32 = 1026;
    /// Band of the chirp.
    pub const CHIRP_BAND: u32 = 1027;
    /// Motion stabilisation.
    pub const MOTION_COMPENSATION: u32 = 1033;
    /// Window of the matched filter.
    pub const MATCH_FILTER: u32 = 1034;
    /// Width and direction of the swath.
    pub const COVERAGE_SECTOR: u32 = 1035;
    /// Requests a record once.
    pub const SINGLE_RECORD: u32 = 1050;
    /// Adds records to the subscription.
    pub const SUBSCRIBE: u32 = 1051;
    /// Ends the subscription.
    pub const END_SUBSCRIPTIONS: u32 = 1052;
    /// Sends records to a third party.
    pub const CONNECT_THIRD_PARTY: u32 = 1053;
    /// Stops sending to a third party.
    pub const DISCONNECT_THIRD_PARTY: u32 = 1054;
    /// Adds a range of record types to the subscription.
    pub const SUBSCRIBE_RANGE: u32 = 1055;
    /// Removes records from the subscription.
    pub const UNSUBSCRIBE: u32 = 1056;
    /// Starts continuous pinging.
    pub const START_PINGING: u32 = 1100;
    /// Stops pinging.
    pub const STOP_PINGING: u32 = 1101;
    /// Transmits one ping.
    pub const SINGLE_PING: u32 = 1107;
    /// Selects the external trigger.
    pub const EXTERNAL_TRIGGER: u32 = 1114;
    /// Trigger output.
    pub const TRIGGER_OUT: u32 = 1115;
    /// Edge of the pulse per second.
    pub const PPS_EDGE: u32 = 1116;
    /// Limits on snippets.
    pub const SNIPPET_CONTROL: u32 = 1118;
    /// Transmits a number of pings.
    pub const PING_TIMES: u32 = 1121;
    /// Flags of record 7042.
    pub const COMPRESSED_WATER_COLUMN: u32 = 7042;
    /// Sound velocity.
    pub const SOUND_VELOCITY: u32 = 7610;
}

/// Type of the transmitted pulse.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum PulseType {
    /// Continuous wave.
    ContinuousWave,
    /// Linear frequency modulation.
    LinearChirp,
}

/// Type of the receiver gain.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum GainType {
    /// Time-varying gain.
    Tvg,
    /// Constant gain.
    Fixed,
}

/// Envelope of the transmitted pulse.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum PulseEnvelope {
    /// Tapered rectangle.
    Rectangle,
    /// Tukey window.
    Tukey,
}

/// Transport of a third-party connection.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Transport {
    /// Datagrams.
    Udp,
    /// Stream.
    Tcp,
}

/// Destination of a third-party connection.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct ThirdParty {
    /// Address as on the wire. The DFD does not define the byte order; not verified with a client.
    pub ipv4: u32,
    /// Port of the third party.
    pub port: u16,
    /// Transport to use.
    pub transport: Transport,
}

/// A command with its arguments. Numbers are finite; the server decides whether the sonar supports the values.
#[derive(Debug, Clone, PartialEq)]
pub enum Command {
    /// Sets the range.
    Range {
        /// Slant range.
        range_m: f32,
    },
    /// Sets the maximum ping rate; 0 inhibits pinging.
    MaxPingRate {
        /// Maximum rate.
        pings_per_s: f32,
    },
    /// Sets the source level.
    Power {
        /// dB re 1 uPa at 1 m.
        power_db: f32,
    },
    /// Sets the pulse length.
    PulseLength {
        /// Pulse length.
        pulse_length_s: f32,
    },
    /// Sets the pulse type.
    PulseType(PulseType),
    /// Sets the receiver gain.
    Gain {
        /// Gain.
        gain_db: f32,
    },
    /// Sets the flags of the bottom detection.
    BottomDetectionMask {
        /// Bit 8 range filter, bit 9 depth filter, bits 10 to 13 adaptive gate.
        flags: u32,
    },
    /// Sets the limits of the bottom detection.
    BottomDetectionFilter {
        /// Minimum range.
        min_range_m: f32,
        /// Maximum range.
        max_range_m: f32,
        /// Minimum depth.
        min_depth_m: f32,
        /// Maximum depth.
        max_depth_m: f32,
        /// Tilt of the gates; older clients omit it.
        gate_tilt_rad: Option<f32>,
    },
    /// Sets the type of the receiver gain.
    GainType(GainType),
    /// Sets the envelope of the pulse.
    PulseEnvelope {
        /// Envelope.
        envelope: PulseEnvelope,
        /// Parameter of the envelope.
        shading: f32,
    },
    /// Sets the direction of the transmit beam.
    ProjectorSteering {
        /// Along-track angle.
        vertical_rad: f32,
        /// Across-track angle.
        horizontal_rad: f32,
    },
    /// Sets the widths of the transmit beam.
    ProjectorBeamWidths {
        /// Along-track width, -3 dB.
        vertical_rad: f32,
        /// Across-track width, -3 dB.
        horizontal_rad: f32,
    },
    /// Sets the centre frequency.
    CenterFrequency {
        /// Centre frequency.
        frequency_hz: f32,
    },
    /// Sets the band of the chirp.
    ChirpBand {
        /// Frequency at the start of the pulse.
        start_hz: f32,
        /// Frequency at the end of the pulse.
        stop_hz: f32,
    },
    /// Sets the motion stabilisation.
    MotionCompensation {
        /// 0 is off.
        roll: u8,
        /// 0 is off.
        pitch: u8,
    },
    /// Sets the window of the matched filter.
    MatchFilter {
        /// Number of the window.
        window: u32,
        /// Parameter of the window.
        shading: f32,
    },
    /// Sets the swath.
    CoverageSector {
        /// Width of the swath.
        sector_rad: f32,
        /// Direction of its centre, positive to starboard.
        rx_steering_rad: f32,
    },
    /// Requests a record once; answered by 7501, then the record.
    SingleRecord {
        /// Record type.
        record_type_id: u32,
    },
    /// Adds to the subscription.
    Subscribe {
        /// Record types.
        record_type_ids: Vec<u32>,
    },
    /// Ends the subscription.
    EndSubscriptions,
    /// Sends records to a third party.
    ConnectThirdParty {
        /// Destination.
        party: ThirdParty,
        /// Record types.
        record_type_ids: Vec<u32>,
    },
    /// Stops sending to a third party.
    DisconnectThirdParty {
        /// Destination.
        party: ThirdParty,
    },
    /// Adds a range of record types to the subscription, both ends included.
    SubscribeRange {
        /// First record type.
        first: u32,
        /// Last record type.
        last: u32,
    },
    /// Removes from the subscription.
    Unsubscribe {
        /// Record types.
        record_type_ids: Vec<u32>,
    },
    /// Starts continuous pinging.
    StartPinging,
    /// Stops pinging.
    StopPinging,
    /// Transmits one ping and stops continuous pinging.
    SinglePing,
    /// Selects the external trigger.
    ExternalTrigger,
    /// Sets the trigger output.
    TriggerOut {
        /// Mode of the output.
        flags: u32,
        /// Length of the signal.
        length_s: f64,
        /// Delay after the ping.
        offset_s: f64,
    },
    /// Sets the edge of the pulse per second.
    PpsEdge {
        /// Number of the edge.
        edge: u32,
    },
    /// Sets the limits on snippets.
    SnippetControl {
        /// Bit 0 automatic, bit 1 minimum window, bit 2 maximum window.
        flags: u32,
        /// Minimum length of a snippet.
        min_window_samples: u32,
        /// Maximum length of a snippet.
        max_window_samples: u32,
    },
    /// Transmits a number of pings.
    PingTimes {
        /// Number of pings.
        count: u32,
    },
    /// Sets up record 7042.
    CompressedWaterColumn {
        /// Flags of the record.
        flags: u32,
    },
    /// Sets the sound velocity.
    SoundVelocity {
        /// Bit 0 override, bit 1 settings only, bit 2 filter.
        flags: u16,
        /// Sound velocity.
        sound_velocity_m_per_s: f32,
        /// Parameter of the filter.
        filter: u8,
    },
    /// Any other remote control identifier, to be answered by [`ErrorCode::RemoteCommandNotFound`]. Its arguments are not stored.
    Unknown(u32),
}

/// A malformed command, with the header if it is complete, so that the command can be answered.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[error("{kind}")]
pub struct CommandError {
    /// Header of the command.
    pub header: Option<ControlHeader>,
    /// Reason.
    pub kind: CommandErrorKind,
}

/// Why a command is malformed.
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

    /// The refusal to send; ticket and tracking number are 0 without a complete header.
    pub fn nack(&self) -> Nack7502 {
        self.header.unwrap_or_default().nack(self.nack_code())
    }
}

// ------------------------------------------------------------------------------------------------------------------------------- parse

/// Reads the arguments of one command in order.
struct Arguments<'a> {
    remote_control_id: u32,
    bytes: &'a [u8],
    at: usize,
}

impl<'a> Arguments<'a> {
    fn take<const N: usize>(&mut self) -> Result<[u8; N], CommandErrorKind> {
        let rest = self.bytes.get(self.at..).unwrap_or_default();
        let taken = rest
            .first_chunk()
            .copied()
            .ok_or_else(|| self.truncated(N as u64))?;
        self.at += N;
        Ok(taken)
    }

    fn truncated(&self, more_bytes: u64) -> CommandErrorKind {
        CommandErrorKind::ArgumentsTruncated {
            remote_control_id: self.remote_control_id,
            need_bytes: self.at as u64 + more_bytes,
            got_bytes: self.bytes.len(),
        }
    }

    fn u8(&mut self) -> Result<u8, CommandErrorKind> {
        Ok(self.take::<1>()?[0])
    }

    fn u16(&mut self) -> Result<u16, CommandErrorKind> {
        self.take().map(u16::from_le_bytes)
    }

    fn u32(&mut self) -> Result<u32, CommandErrorKind> {
        self.take().map(u32::from_le_bytes)
    }

    fn f32(&mut self, argument: &'static str) -> Result<f32, CommandErrorKind> {
        let value = f32::from_le_bytes(self.take()?);
        if value.is_finite() {
            Ok(value)
        } else {
            Err(self.not_finite(argument))
        }
    }

    fn f64(&mut self, argument: &'static str) -> Result<f64, CommandErrorKind> {
        let value = f64::from_le_bytes(self.take()?);
        if value.is_finite() {
            Ok(value)
        } else {
            Err(self.not_finite(argument))
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

    /// A count and this number of record types. The count is used only after the length check.
    fn record_types(&mut self) -> Result<Vec<u32>, CommandErrorKind> {
        let count = self.u32()?;
        let rest = self.bytes.get(self.at..).unwrap_or_default();
        if (rest.len() as u64) < 4 * u64::from(count) {
            return Err(self.truncated(4 * u64::from(count)));
        }
        (0..count).map(|_| self.u32()).collect()
    }

    fn third_party(&mut self) -> Result<ThirdParty, CommandErrorKind> {
        let (ipv4, port) = (self.u32()?, self.u16()?);
        let transport = match self.u16()? {
            0 => Transport::Udp,
            1 => Transport::Tcp,
            other => return Err(self.not_listed("transport", u32::from(other))),
        };
        Ok(ThirdParty {
            ipv4,
            port,
            transport,
        })
    }
}

impl Command {
    /// Parses the arguments of a command.
    pub fn parse(remote_control_id: u32, arguments: &[u8]) -> Result<Self, CommandErrorKind> {
        let mut a = Arguments {
            remote_control_id,
            bytes: arguments,
            at: 0,
        };
        Ok(match remote_control_id {
            command_id::RANGE => Self::Range {
                range_m: a.f32("range")?,
            },
            command_id::MAX_PING_RATE => Self::MaxPingRate {
                pings_per_s: a.f32("ping rate")?,
            },
            command_id::POWER => Self::Power {
                power_db: a.f32("power")?,
            },
            command_id::PULSE_LENGTH => Self::PulseLength {
                pulse_length_s: a.f32("pulse length")?,
            },
            command_id::PULSE_TYPE => Self::PulseType(match a.u32()? {
                0 => PulseType::ContinuousWave,
                1 => PulseType::LinearChirp,
                other => return Err(a.not_listed("pulse type", other)),
            }),
            command_id::GAIN => Self::Gain {
                gain_db: a.f32("gain")?,
            },
            command_id::BOTTOM_DETECTION_MASK => Self::BottomDetectionMask { flags: a.u32()? },
            command_id::BOTTOM_DETECTION_FILTER => Self::BottomDetectionFilter {
                min_range_m: a.f32("minimum range")?,
                max_range_m: a.f32("maximum range")?,
                min_depth_m: a.f32("minimum depth")?,
                max_depth_m: a.f32("maximum depth")?,
                gate_tilt_rad: if arguments.len() >= 20 {
                    Some(a.f32("gate tilt")?)
                } else {
                    None
                },
            },
            command_id::GAIN_TYPE => Self::GainType(match a.u32()? {
                0 => GainType::Tvg,
                2 => GainType::Fixed,
                other => return Err(a.not_listed("gain type", other)),
            }),
            command_id::PULSE_ENVELOPE => Self::PulseEnvelope {
                envelope: match a.u32()? {
                    0 => PulseEnvelope::Rectangle,
                    1 => PulseEnvelope::Tukey,
                    other => return Err(a.not_listed("pulse envelope", other)),
                },
                shading: a.f32("shading")?,
            },
            command_id::PROJECTOR_STEERING => Self::ProjectorSteering {
                vertical_rad: a.f32("vertical angle")?,
                horizontal_rad: a.f32("horizontal angle")?,
            },
            command_id::PROJECTOR_BEAM_WIDTHS => Self::ProjectorBeamWidths {
                vertical_rad: a.f32("vertical width")?,
                horizontal_rad: a.f32("horizontal width")?,
            },
            command_id::CENTER_FREQUENCY => Self::CenterFrequency {
                frequency_hz: a.f32("frequency")?,
            },
            command_id::CHIRP_BAND => Self::ChirpBand {
                start_hz: a.f32("start frequency")?,
                stop_hz: a.f32("stop frequency")?,
            },
            command_id::MOTION_COMPENSATION => Self::MotionCompensation {
                roll: a.u8()?,
                pitch: a.u8()?,
            },
            command_id::MATCH_FILTER => Self::MatchFilter {
                window: a.u32()?,
                shading: a.f32("shading")?,
            },
            command_id::COVERAGE_SECTOR => Self::CoverageSector {
                sector_rad: a.f32("sector")?,
                rx_steering_rad: a.f32("receiver steering")?,
            },
            command_id::SINGLE_RECORD => Self::SingleRecord {
                record_type_id: a.u32()?,
            },
            command_id::SUBSCRIBE => Self::Subscribe {
                record_type_ids: a.record_types()?,
            },
            command_id::END_SUBSCRIPTIONS => Self::EndSubscriptions,
            command_id::CONNECT_THIRD_PARTY => Self::ConnectThirdParty {
                party: a.third_party()?,
                record_type_ids: a.record_types()?,
            },
            command_id::DISCONNECT_THIRD_PARTY => Self::DisconnectThirdParty {
                party: a.third_party()?,
            },
            command_id::SUBSCRIBE_RANGE => Self::SubscribeRange {
                first: a.u32()?,
                last: a.u32()?,
            },
            command_id::UNSUBSCRIBE => Self::Unsubscribe {
                record_type_ids: a.record_types()?,
            },
            command_id::START_PINGING => Self::StartPinging,
            command_id::STOP_PINGING => Self::StopPinging,
            command_id::SINGLE_PING => Self::SinglePing,
            command_id::EXTERNAL_TRIGGER => Self::ExternalTrigger,
            command_id::TRIGGER_OUT => Self::TriggerOut {
                flags: a.u32()?,
                length_s: a.f64("length")?,
                offset_s: a.f64("offset")?,
            },
            command_id::PPS_EDGE => Self::PpsEdge { edge: a.u32()? },
            command_id::SNIPPET_CONTROL => Self::SnippetControl {
                flags: a.u32()?,
                min_window_samples: a.u32()?,
                max_window_samples: a.u32()?,
            },
            command_id::PING_TIMES => Self::PingTimes { count: a.u32()? },
            command_id::COMPRESSED_WATER_COLUMN => Self::CompressedWaterColumn { flags: a.u32()? },
            command_id::SOUND_VELOCITY => Self::SoundVelocity {
                flags: a.u16()?,
                sound_velocity_m_per_s: a.f32("sound velocity")?,
                filter: a.u8()?,
            },
            other => Self::Unknown(other),
        })
    }

    /// Identifier of the command.
    pub fn remote_control_id(&self) -> u32 {
        match self {
            Self::Range { .. } => command_id::RANGE,
            Self::MaxPingRate { .. } => command_id::MAX_PING_RATE,
            Self::Power { .. } => command_id::POWER,
            Self::PulseLength { .. } => command_id::PULSE_LENGTH,
            Self::PulseType(_) => command_id::PULSE_TYPE,
            Self::Gain { .. } => command_id::GAIN,
            Self::BottomDetectionMask { .. } => command_id::BOTTOM_DETECTION_MASK,
            Self::BottomDetectionFilter { .. } => command_id::BOTTOM_DETECTION_FILTER,
            Self::GainType(_) => command_id::GAIN_TYPE,
            Self::PulseEnvelope { .. } => command_id::PULSE_ENVELOPE,
            Self::ProjectorSteering { .. } => command_id::PROJECTOR_STEERING,
            Self::ProjectorBeamWidths { .. } => command_id::PROJECTOR_BEAM_WIDTHS,
            Self::CenterFrequency { .. } => command_id::CENTER_FREQUENCY,
            Self::ChirpBand { .. } => command_id::CHIRP_BAND,
            Self::MotionCompensation { .. } => command_id::MOTION_COMPENSATION,
            Self::MatchFilter { .. } => command_id::MATCH_FILTER,
            Self::CoverageSector { .. } => command_id::COVERAGE_SECTOR,
            Self::SingleRecord { .. } => command_id::SINGLE_RECORD,
            Self::Subscribe { .. } => command_id::SUBSCRIBE,
            Self::EndSubscriptions => command_id::END_SUBSCRIPTIONS,
            Self::ConnectThirdParty { .. } => command_id::CONNECT_THIRD_PARTY,
            Self::DisconnectThirdParty { .. } => command_id::DISCONNECT_THIRD_PARTY,
            Self::SubscribeRange { .. } => command_id::SUBSCRIBE_RANGE,
            Self::Unsubscribe { .. } => command_id::UNSUBSCRIBE,
            Self::StartPinging => command_id::START_PINGING,
            Self::StopPinging => command_id::STOP_PINGING,
            Self::SinglePing => command_id::SINGLE_PING,
            Self::ExternalTrigger => command_id::EXTERNAL_TRIGGER,
            Self::TriggerOut { .. } => command_id::TRIGGER_OUT,
            Self::PpsEdge { .. } => command_id::PPS_EDGE,
            Self::SnippetControl { .. } => command_id::SNIPPET_CONTROL,
            Self::PingTimes { .. } => command_id::PING_TIMES,
            Self::CompressedWaterColumn { .. } => command_id::COMPRESSED_WATER_COLUMN,
            Self::SoundVelocity { .. } => command_id::SOUND_VELOCITY,
            Self::Unknown(id) => *id,
        }
    }

    // --------------------------------------------------------------------------------------------------------------------------- emit

    /// Appends the arguments, with reserved ones as 0, or one empty byte if there are none.
    pub fn emit_arguments(&self, buf: &mut Vec<u8>) {
        fn f32s(buf: &mut Vec<u8>, values: &[f32]) {
            values
                .iter()
                .for_each(|value| buf.extend_from_slice(&value.to_le_bytes()));
        }
        fn u32s(buf: &mut Vec<u8>, values: &[u32]) {
            values
                .iter()
                .for_each(|value| buf.extend_from_slice(&value.to_le_bytes()));
        }
        fn counted(buf: &mut Vec<u8>, ids: &[u32]) {
            u32s(buf, &[ids.len() as u32]);
            u32s(buf, ids);
        }
        fn third_party(buf: &mut Vec<u8>, party: &ThirdParty) {
            u32s(buf, &[party.ipv4]);
            buf.extend_from_slice(&party.port.to_le_bytes());
            let transport: u16 = match party.transport {
                Transport::Udp => 0,
                Transport::Tcp => 1,
            };
            buf.extend_from_slice(&transport.to_le_bytes());
        }
        match self {
            Self::Range { range_m } => f32s(buf, &[*range_m]),
            Self::MaxPingRate { pings_per_s } => f32s(buf, &[*pings_per_s]),
            Self::Power { power_db } => f32s(buf, &[*power_db]),
            Self::PulseLength { pulse_length_s } => f32s(buf, &[*pulse_length_s]),
            Self::PulseType(PulseType::ContinuousWave) => u32s(buf, &[0]),
            Self::PulseType(PulseType::LinearChirp) => u32s(buf, &[1]),
            Self::Gain { gain_db } => f32s(buf, &[*gain_db]),
            Self::BottomDetectionMask { flags } => u32s(buf, &[*flags]),
            Self::BottomDetectionFilter {
                min_range_m,
                max_range_m,
                min_depth_m,
                max_depth_m,
                gate_tilt_rad,
            } => {
                f32s(
                    buf,
                    &[*min_range_m, *max_range_m, *min_depth_m, *max_depth_m],
                );
                f32s(buf, gate_tilt_rad.as_slice());
            }
            Self::GainType(GainType::Tvg) => u32s(buf, &[0, 0, 0, 0, 0]),
            Self::GainType(GainType::Fixed) => u32s(buf, &[2, 0, 0, 0, 0]),
            Self::PulseEnvelope { envelope, shading } => {
                let envelope = match envelope {
                    PulseEnvelope::Rectangle => 0,
                    PulseEnvelope::Tukey => 1,
                };
                u32s(buf, &[envelope, shading.to_bits(), 0, 0, 0, 0]);
            }
            Self::ProjectorSteering {
                vertical_rad,
                horizontal_rad,
            }
            | Self::ProjectorBeamWidths {
                vertical_rad,
                horizontal_rad,
            } => {
                f32s(buf, &[*vertical_rad, *horizontal_rad]);
            }
            Self::CenterFrequency { frequency_hz } => f32s(buf, &[*frequency_hz]),
            Self::ChirpBand { start_hz, stop_hz } => f32s(buf, &[*start_hz, *stop_hz]),
            Self::MotionCompensation { roll, pitch } => {
                buf.extend_from_slice(&[*roll, *pitch]);
                buf.extend_from_slice(&[0; 10]);
            }
            Self::MatchFilter { window, shading } => {
                u32s(buf, &[*window, shading.to_bits(), 0, 0, 0, 0])
            }
            Self::CoverageSector {
                sector_rad,
                rx_steering_rad,
            } => f32s(buf, &[*sector_rad, *rx_steering_rad]),
            Self::SingleRecord { record_type_id } => u32s(buf, &[*record_type_id]),
            Self::Subscribe { record_type_ids } | Self::Unsubscribe { record_type_ids } => {
                counted(buf, record_type_ids)
            }
            Self::ConnectThirdParty {
                party,
                record_type_ids,
            } => {
                third_party(buf, party);
                counted(buf, record_type_ids);
            }
            Self::DisconnectThirdParty { party } => third_party(buf, party),
            Self::SubscribeRange { first, last } => u32s(buf, &[*first, *last]),
            Self::TriggerOut {
                flags,
                length_s,
                offset_s,
            } => {
                u32s(buf, &[*flags]);
                buf.extend_from_slice(&length_s.to_le_bytes());
                buf.extend_from_slice(&offset_s.to_le_bytes());
            }
            Self::PpsEdge { edge } => u32s(buf, &[*edge]),
            Self::SnippetControl {
                flags,
                min_window_samples,
                max_window_samples,
            } => {
                u32s(buf, &[*flags, *min_window_samples, *max_window_samples]);
            }
            Self::PingTimes { count } => u32s(buf, &[*count]),
            Self::CompressedWaterColumn { flags } => u32s(buf, &[*flags]),
            Self::SoundVelocity {
                flags,
                sound_velocity_m_per_s,
                filter,
            } => {
                buf.extend_from_slice(&flags.to_le_bytes());
                f32s(buf, &[*sound_velocity_m_per_s]);
                buf.extend_from_slice(&[*filter, 0, 0, 0]);
            }
            Self::EndSubscriptions
            | Self::StartPinging
            | Self::StopPinging
            | Self::SinglePing
            | Self::ExternalTrigger
            | Self::Unknown(_) => buf.push(0),
        }
    }
}

/// 7500: a command and the values that its answer repeats.
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
    /// Record type.
    pub const RECORD_TYPE_ID: u32 = record_id::REMOTE_CONTROL;
    /// Size of the RTH.
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
        write_fixed(&self.header(), buf);
        self.command.emit_arguments(buf);
        open.finish(buf)
    }
}

// ------------------------------------------------------------------------------------------------------------------------------- print

impl fmt::Display for Command {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Range { range_m } => write!(f, "range {range_m} m"),
            Self::MaxPingRate { pings_per_s } => write!(f, "at most {pings_per_s} pings/s"),
            Self::Power { power_db } => write!(f, "power {power_db} dB re 1 uPa at 1 m"),
            Self::PulseLength { pulse_length_s } => write!(f, "pulse length {pulse_length_s} s"),
            Self::PulseType(PulseType::ContinuousWave) => f.write_str("pulse type continuous wave"),
            Self::PulseType(PulseType::LinearChirp) => f.write_str("pulse type linear chirp"),
            Self::Gain { gain_db } => write!(f, "gain {gain_db} dB"),
            Self::BottomDetectionMask { flags } => write!(f, "bottom detection mask {flags:#x}"),
            Self::BottomDetectionFilter {
                min_range_m,
                max_range_m,
                min_depth_m,
                max_depth_m,
                gate_tilt_rad,
            } => {
                write!(
                    f,
                    "bottom detection range {min_range_m}..{max_range_m} m, depth {min_depth_m}..{max_depth_m} m"
                )?;
                gate_tilt_rad.map_or(Ok(()), |tilt| write!(f, ", gate tilt {tilt} rad"))
            }
            Self::GainType(GainType::Tvg) => f.write_str("gain type TVG"),
            Self::GainType(GainType::Fixed) => f.write_str("gain type fixed"),
            Self::PulseEnvelope { envelope, shading } => {
                write!(f, "pulse envelope {envelope:?}, shading {shading}")
            }
            Self::ProjectorSteering {
                vertical_rad,
                horizontal_rad,
            } => {
                write!(
                    f,
                    "projector steering {vertical_rad} rad vertical, {horizontal_rad} rad horizontal"
                )
            }
            Self::ProjectorBeamWidths {
                vertical_rad,
                horizontal_rad,
            } => {
                write!(
                    f,
                    "projector beam widths {vertical_rad} rad vertical, {horizontal_rad} rad horizontal"
                )
            }
            Self::CenterFrequency { frequency_hz } => {
                write!(f, "centre frequency {frequency_hz} Hz")
            }
            Self::ChirpBand { start_hz, stop_hz } => write!(f, "chirp {start_hz} to {stop_hz} Hz"),
            Self::MotionCompensation { roll, pitch } => {
                write!(f, "motion compensation roll {roll}, pitch {pitch}")
            }
            Self::MatchFilter { window, shading } => {
                write!(f, "match filter window {window}, shading {shading}")
            }
            Self::CoverageSector {
                sector_rad,
                rx_steering_rad,
            } => {
                write!(
                    f,
                    "coverage sector {sector_rad} rad, steered {rx_steering_rad} rad to starboard"
                )
            }
            Self::SingleRecord { record_type_id } => write!(f, "send record {record_type_id} once"),
            Self::Subscribe { record_type_ids } => write!(f, "subscribe to {record_type_ids:?}"),
            Self::EndSubscriptions => f.write_str("end all subscriptions"),
            Self::ConnectThirdParty {
                party,
                record_type_ids,
            } => {
                write!(
                    f,
                    "send {record_type_ids:?} to {:?} {:#010x} port {}",
                    party.transport, party.ipv4, party.port
                )
            }
            Self::DisconnectThirdParty { party } => {
                write!(
                    f,
                    "stop sending to {:?} {:#010x} port {}",
                    party.transport, party.ipv4, party.port
                )
            }
            Self::SubscribeRange { first, last } => write!(f, "subscribe to {first}..={last}"),
            Self::Unsubscribe { record_type_ids } => {
                write!(f, "unsubscribe from {record_type_ids:?}")
            }
            Self::StartPinging => f.write_str("start pinging"),
            Self::StopPinging => f.write_str("stop pinging"),
            Self::SinglePing => f.write_str("ping once"),
            Self::ExternalTrigger => f.write_str("ping by external trigger"),
            Self::TriggerOut {
                flags,
                length_s,
                offset_s,
            } => {
                write!(
                    f,
                    "trigger out flags {flags:#x}, length {length_s} s, offset {offset_s} s"
                )
            }
            Self::PpsEdge { edge } => write!(f, "PPS edge {edge}"),
            Self::SnippetControl {
                flags,
                min_window_samples,
                max_window_samples,
            } => {
                write!(
                    f,
                    "snippets flags {flags:#x}, window {min_window_samples}..{max_window_samples} samples"
                )
            }
            Self::PingTimes { count } => write!(f, "ping {count} times"),
            Self::CompressedWaterColumn { flags } => {
                write!(f, "compressed water column flags {flags:#x}")
            }
            Self::SoundVelocity {
                flags,
                sound_velocity_m_per_s,
                filter,
            } => {
                write!(
                    f,
                    "sound velocity {sound_velocity_m_per_s} m/s, flags {flags:#x}, filter {filter}"
                )
            }
            Self::Unknown(_) => f.write_str("not a known command"),
        }
    }
}

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

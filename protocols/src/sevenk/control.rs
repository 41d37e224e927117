//! Remote control: 7500 commands, and the answers 7501 (done) and 7502 (refused). Source: DFD 3.12.
//!
//! ```text
//! 7500 RTH   0 u32 remote_control_id   4 u32 ticket   8 u64 x 2 tracking_number        24 bytes, then the arguments
//! 7501 RTH   0 u32 ticket   4 u64 x 2 tracking_number                                  20 bytes
//! 7502 RTH   0 u32 ticket   4 u64 x 2 tracking_number   20 u32 error_code              24 bytes
//! ```
//!
//! A command without arguments is sent with one empty byte behind it, and read with any number. Arguments longer than we know are read as
//! far as we know them. An answer repeats ticket and tracking number; accepted commands are echoed to the clients subscribed to 7500.

use std::fmt;
use std::ops::Range;

use binrw::{BinRead, BinWrite};

use super::frame::{Fixed, OpenRecord, RecordStamp, read_fixed, write_fixed};
use super::record_id;
use super::records::{rth, rth_record};

/// What names a command and its answer.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, BinRead, BinWrite)]
pub struct ControlHeader {
    /// Which command: see [`command_id`].
    pub remote_control_id: u32,
    pub ticket: u32,
    pub tracking_number: [u64; 2],
}

rth!(ControlHeader, 24, "7500 remote control");

/// 7501: the command was accepted.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, BinRead, BinWrite)]
pub struct Ack7501 {
    pub ticket: u32,
    pub tracking_number: [u64; 2],
}

/// 7502: the command was refused.
#[derive(Debug, Clone, Copy, PartialEq, Eq, BinRead, BinWrite)]
pub struct Nack7502 {
    pub ticket: u32,
    pub tracking_number: [u64; 2],
    #[br(map = |code: u32| ErrorCode::from_code(code))]
    #[bw(map = |error: &ErrorCode| error.code())]
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
    pub fn ack(&self) -> Ack7501 {
        Ack7501 {
            ticket: self.ticket,
            tracking_number: self.tracking_number,
        }
    }

    pub fn nack(&self, error: ErrorCode) -> Nack7502 {
        Nack7502 {
            ticket: self.ticket,
            tracking_number: self.tracking_number,
            error,
        }
    }
}

/// Declares the error codes once, for both directions and for print.
macro_rules! error_codes {
    ($($name:ident = $code:literal, $words:literal;)*) => {
        /// Why a command was refused.
        #[derive(Debug, Clone, Copy, PartialEq, Eq)]
        pub enum ErrorCode {
            $(#[doc = $words] $name,)*
            /// A code that the DFD does not list.
            Unlisted(u32),
        }

        impl ErrorCode {
            /// All listed codes.
            pub const LISTED: &'static [Self] = &[$(Self::$name),*];

            pub const fn code(self) -> u32 {
                match self {
                    $(Self::$name => $code,)*
                    Self::Unlisted(code) => code,
                }
            }

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
    pub const RANGE: u32 = 1003;
    pub const MAX_PING_RATE: u32 = 1004;
    pub const POWER: u32 = 1005;
    pub const PULSE_LENGTH: u32 = 1006;
    pub const PULSE_TYPE: u32 = 1007;
    pub const GAIN: u32 = 1008;
    pub const BOTTOM_DETECTION_MASK: u32 = 1009;
    pub const BOTTOM_DETECTION_FILTER: u32 = 1010;
    pub const GAIN_TYPE: u32 = 1017;
    pub const PULSE_ENVELOPE: u32 = 1020;
    pub const PROJECTOR_STEERING: u32 = 1021;
    pub const PROJECTOR_BEAM_WIDTHS: u32 = 1022;
    pub const CENTER_FREQUENCY: u32 = 1026;
    pub const CHIRP_BAND: u32 = 1027;
    pub const MOTION_COMPENSATION: u32 = 1033;
    pub const MATCH_FILTER: u32 = 1034;
    pub const COVERAGE_SECTOR: u32 = 1035;
    pub const SINGLE_RECORD: u32 = 1050;
    pub const SUBSCRIBE: u32 = 1051;
    pub const END_SUBSCRIPTIONS: u32 = 1052;
    pub const CONNECT_THIRD_PARTY: u32 = 1053;
    pub const DISCONNECT_THIRD_PARTY: u32 = 1054;
    pub const SUBSCRIBE_RANGE: u32 = 1055;
    pub const UNSUBSCRIBE: u32 = 1056;
    pub const START_PINGING: u32 = 1100;
    pub const STOP_PINGING: u32 = 1101;
    pub const SINGLE_PING: u32 = 1107;
    pub const EXTERNAL_TRIGGER: u32 = 1114;
    pub const TRIGGER_OUT: u32 = 1115;
    pub const PPS_EDGE: u32 = 1116;
    pub const SNIPPET_CONTROL: u32 = 1118;
    pub const PING_TIMES: u32 = 1121;
    pub const COMPRESSED_WATER_COLUMN: u32 = 7042;
    pub const SOUND_VELOCITY: u32 = 7610;
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum PulseType {
    ContinuousWave,
    LinearChirp,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum GainType {
    Tvg,
    Fixed,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum PulseEnvelope {
    Rectangle,
    Tukey,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Transport {
    Udp,
    Tcp,
}

/// Where a third-party connection leads.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct ThirdParty {
    /// As on the wire. The DFD does not say which end comes first; not tried with a client.
    pub ipv4: u32,
    pub port: u16,
    pub transport: Transport,
}

/// A command with its arguments. Numbers are finite; whether the sonar can do what they say is the server's to judge.
#[derive(Debug, Clone, PartialEq)]
pub enum Command {
    Range {
        range_m: f32,
    },
    /// 0 keeps pinging from starting.
    MaxPingRate {
        pings_per_s: f32,
    },
    /// Source level, dB re 1 uPa at 1 m.
    Power {
        power_db: f32,
    },
    PulseLength {
        pulse_length_s: f32,
    },
    PulseType(PulseType),
    Gain {
        gain_db: f32,
    },
    /// Bit 8 range filter, bit 9 depth filter, bits 10..=13 adaptive gate.
    BottomDetectionMask {
        flags: u32,
    },
    BottomDetectionFilter {
        min_range_m: f32,
        max_range_m: f32,
        min_depth_m: f32,
        max_depth_m: f32,
        /// Older clients leave it out.
        gate_tilt_rad: Option<f32>,
    },
    GainType(GainType),
    PulseEnvelope {
        envelope: PulseEnvelope,
        shading: f32,
    },
    ProjectorSteering {
        vertical_rad: f32,
        horizontal_rad: f32,
    },
    ProjectorBeamWidths {
        vertical_rad: f32,
        horizontal_rad: f32,
    },
    CenterFrequency {
        frequency_hz: f32,
    },
    ChirpBand {
        start_hz: f32,
        stop_hz: f32,
    },
    MotionCompensation {
        roll: u8,
        pitch: u8,
    },
    MatchFilter {
        window: u32,
        shading: f32,
    },
    CoverageSector {
        sector_rad: f32,
        /// Starboard is positive.
        rx_steering_rad: f32,
    },
    /// Answered by 7501, then the record.
    SingleRecord {
        record_type_id: u32,
    },
    Subscribe {
        record_type_ids: Vec<u32>,
    },
    EndSubscriptions,
    ConnectThirdParty {
        party: ThirdParty,
        record_type_ids: Vec<u32>,
    },
    DisconnectThirdParty {
        party: ThirdParty,
    },
    /// Both ends included.
    SubscribeRange {
        first: u32,
        last: u32,
    },
    Unsubscribe {
        record_type_ids: Vec<u32>,
    },
    StartPinging,
    StopPinging,
    /// Halts continuous pinging.
    SinglePing,
    ExternalTrigger,
    TriggerOut {
        flags: u32,
        length_s: f64,
        offset_s: f64,
    },
    PpsEdge {
        edge: u32,
    },
    /// Bit 0 automatic, bit 1 minimum window, bit 2 maximum window.
    SnippetControl {
        flags: u32,
        min_window_samples: u32,
        max_window_samples: u32,
    },
    PingTimes {
        count: u32,
    },
    /// The flags of record 7042.
    CompressedWaterColumn {
        flags: u32,
    },
    /// Bit 0 override, bit 1 settings only, bit 2 filter.
    SoundVelocity {
        flags: u16,
        sound_velocity_m_per_s: f32,
        filter: u8,
    },
    /// Any other remote control id; to be answered with [`ErrorCode::RemoteCommandNotFound`]. Its arguments are not kept.
    Unknown(u32),
}

/// A command that could not be read, with as much of its header as there was: with one, it can be answered.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[error("{kind}")]
pub struct CommandError {
    pub header: Option<ControlHeader>,
    pub kind: CommandErrorKind,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum CommandErrorKind {
    #[error("a command needs a header of 24 bytes, {got_bytes} are there")]
    HeaderTruncated { got_bytes: usize },
    #[error(
        "command {remote_control_id} needs at least {need_bytes} bytes of arguments, {got_bytes} are there"
    )]
    ArgumentsTruncated {
        remote_control_id: u32,
        need_bytes: u64,
        got_bytes: usize,
    },
    #[error("command {remote_control_id} has {argument} that is not a finite number")]
    NotFinite {
        remote_control_id: u32,
        argument: &'static str,
    },
    #[error("command {remote_control_id} has {argument} {value}, which is not one of the listed")]
    NotListed {
        remote_control_id: u32,
        argument: &'static str,
        value: u32,
    },
}

impl CommandError {
    /// The code that the refusal carries.
    pub fn nack_code(&self) -> ErrorCode {
        match self.kind {
            CommandErrorKind::NotListed { .. } => ErrorCode::ParameterOutOfRange,
            CommandErrorKind::HeaderTruncated { .. }
            | CommandErrorKind::ArgumentsTruncated { .. }
            | CommandErrorKind::NotFinite { .. } => ErrorCode::InvalidParameter,
        }
    }

    /// The refusal to send; ticket and tracking number are 0 if not even the header was whole.
    pub fn nack(&self) -> Nack7502 {
        self.header.unwrap_or_default().nack(self.nack_code())
    }
}

// ------------------------------------------------------------------------------------------------------------------------------- parse

/// Walks through the arguments of one command.
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

    /// A count and as many record types. The count is believed only after the bytes are seen to be there.
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
    /// Reads the arguments of a command.
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

    /// Appends the arguments, reserved ones as 0; one empty byte if there are none.
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

/// 7500: a command and what its answer will repeat.
#[derive(Debug, Clone, PartialEq)]
pub struct ControlRequest {
    pub ticket: u32,
    pub tracking_number: [u64; 2],
    pub command: Command,
}

impl ControlRequest {
    pub const RECORD_TYPE_ID: u32 = record_id::REMOTE_CONTROL;
    pub const RTH_BYTES: usize = ControlHeader::SIZE_BYTES;

    /// Reads the body of a 7500 record.
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
            Self::Unknown(_) => f.write_str("not one we know"),
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

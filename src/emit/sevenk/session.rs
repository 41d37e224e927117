//! The 7k session of one client: its bytes in, answers out, and what it subscribed to. Sans I/O.
//!
//! What we decided where the DFD (3.12) leaves room:
//! - 1051 and 1055 add to what is subscribed; 1056 takes away, 1052 ends all. Record types that this sonar does not send are passed over, as
//!   clients ask for all they know; only a list without a single one that it does send is refused (0x7002).
//! - 1050 of 7001 or 7503 is answered at once. Of a record that belongs to a ping, the next ping's is sent, once; while the sonar does not
//!   ping it is refused (0x7002). 7500 is for subscribers only (0x700A).
//! - Commands addressed to nobody (0), to the Center (7000), to 7125 or to 50 are taken as addressed to us: clients in wide use send those
//!   to any sonar. Other devices, and enumerators neither 0 nor ours, are refused (0x7009).
//! - A command whose checksum is wrong is refused (0x7054) if its frame is otherwise right. Anything else that is no record is counted and
//!   passed over without an answer: there is no ticket to answer to.
//! - Records other than 7500 are counted and not answered.

use echotank_protocols::sevenk::control::ControlHeader;
use echotank_protocols::sevenk::frame::{DATA_RECORD_FRAME_BYTES, NETWORK_FRAME_BYTES};
use echotank_protocols::sevenk::{
    Command, ControlRequest, DataRecordFrame, ErrorCode, Reassembler, Record, StreamDecoder,
    WireError,
};

use super::records::DeviceSheet;
use super::{RECORDS, RecordSet};
pub use crate::emit::session::{Outgoing, SessionCounts};
use crate::flow::{Asked, Asker, Datagram, SettingChange, SettingsPort};
use crate::time::UtcNs;

/// The longest record a client may send: a command with some thousands of record types.
pub const MAX_COMMAND_BYTES: u32 = 64 * 1024;

const REMOTE_CONTROL: u32 = 7500;
const ACK: u32 = 7501;
const NACK: u32 = 7502;

/// What a session needs of the world while it answers.
#[derive(Clone, Copy)]
pub struct SessionContext<'a> {
    pub sheet: &'a DeviceSheet,
    pub settings: &'a dyn SettingsPort,
    /// Rig time: stamps the answers.
    pub now: UtcNs,
    pub by: Asker,
}

/// One client.
pub struct Session {
    input: Input,
    client: Client,
}

enum Input {
    Stream(StreamDecoder),
    Datagrams(Reassembler),
}

/// What a session is apart from its bytes.
#[derive(Default)]
struct Client {
    subscribed: RecordSet,
    requested: RecordSet,
    counts: SessionCounts,
}

impl Session {
    /// Over TCP.
    pub fn stream() -> Self {
        Self {
            input: Input::Stream(StreamDecoder::new(MAX_COMMAND_BYTES)),
            client: Client::default(),
        }
    }

    /// Over UDP.
    pub fn datagrams() -> Self {
        Self {
            input: Input::Datagrams(Reassembler::new(MAX_COMMAND_BYTES)),
            client: Client::default(),
        }
    }

    pub fn counts(&self) -> SessionCounts {
        self.client.counts
    }

    pub fn subscribed(&self) -> RecordSet {
        self.client.subscribed
    }

    /// Records of the next ping that were asked for since the last call.
    pub fn take_requested(&mut self) -> RecordSet {
        std::mem::take(&mut self.client.requested)
    }

    /// Part of a record is there and waits for the rest.
    pub fn is_waiting(&self) -> bool {
        match &self.input {
            Input::Stream(decoder) => decoder.held_bytes() > 0,
            Input::Datagrams(_) => false,
        }
    }

    /// Takes what came from the client (over UDP: one datagram) and appends the answers to `out`, in order.
    pub fn receive(&mut self, bytes: &[u8], context: &SessionContext<'_>, out: &mut Vec<Outgoing>) {
        match &mut self.input {
            Input::Stream(decoder) => {
                let mut rest = bytes;
                loop {
                    self.client.drain(decoder, context, out);
                    if rest.is_empty() {
                        return;
                    }
                    let taken = decoder.push(rest);
                    rest = &rest[taken..];
                }
            }
            Input::Datagrams(reassembler) => match reassembler.push_datagram(bytes) {
                Ok(None) => {}
                Ok(Some(record)) => self.client.record(&record, context, out),
                Err(error) => {
                    let record = bytes.get(NETWORK_FRAME_BYTES..).unwrap_or_default();
                    self.client.framing_error(&error, record, context, out);
                }
            },
        }
    }

    /// Says that the record begun will not go on: the client closed, or stalled. What it hid comes to light.
    pub fn give_up_waiting(&mut self, context: &SessionContext<'_>, out: &mut Vec<Outgoing>) {
        if let Input::Stream(decoder) = &mut self.input {
            decoder.finish();
            self.client.drain(decoder, context, out);
        }
    }
}

impl Client {
    fn drain(
        &mut self,
        decoder: &mut StreamDecoder,
        context: &SessionContext<'_>,
        out: &mut Vec<Outgoing>,
    ) {
        loop {
            let error = match decoder.next_record() {
                None => return,
                Some(Ok(record)) => {
                    self.record(&record, context, out);
                    continue;
                }
                Some(Err(error)) => error,
            };
            let record = decoder.refused_bytes().get(NETWORK_FRAME_BYTES..);
            self.framing_error(&error, record.unwrap_or_default(), context, out);
        }
    }

    /// `record`: what stands where the wrong record began, behind its network frame.
    fn framing_error(
        &mut self,
        error: &WireError,
        record: &[u8],
        context: &SessionContext<'_>,
        out: &mut Vec<Outgoing>,
    ) {
        self.counts.framing_errors += 1;
        let is_checksum = matches!(error, WireError::Checksum { .. });
        if is_checksum && let Some(header) = command_header(record) {
            self.counts.commands += 1;
            self.refuse(&header, ErrorCode::DataChecksum, context, out);
        }
    }

    fn record(
        &mut self,
        record: &Record<'_>,
        context: &SessionContext<'_>,
        out: &mut Vec<Outgoing>,
    ) {
        if record.frame.record_type_id != REMOTE_CONTROL {
            self.counts.other_records += 1;
            return;
        }
        self.counts.commands += 1;
        let request = match ControlRequest::parse(record.body()) {
            Ok(request) => request,
            Err(error) => {
                let header = error.header.unwrap_or_default();
                return self.refuse(&header, error.nack_code(), context, out);
            }
        };
        let header = request.header();
        let (device, enumerator) = (record.frame.device_id, record.frame.system_enumerator);
        if !context.sheet.accepts(device, enumerator) {
            return self.refuse(&header, ErrorCode::InvalidDeviceId, context, out);
        }
        match self.obey(&request.command, context) {
            Err(code) => self.refuse(&header, code, context, out),
            Ok(answer) => {
                let stamp = context.sheet.stamp(context.now);
                out.push(Outgoing::Reply(datagram(ACK, |buf| {
                    header.ack().emit(buf, &stamp);
                })));
                out.extend(answer.map(Outgoing::Reply));
                out.push(Outgoing::Echo(datagram(REMOTE_CONTROL, |buf| {
                    request.emit(buf, &stamp);
                })));
            }
        }
    }

    /// Does what was asked. A record, if one was asked for that can be had at once.
    fn obey(
        &mut self,
        command: &Command,
        context: &SessionContext<'_>,
    ) -> Result<Option<Datagram>, ErrorCode> {
        let change = match command {
            Command::Range { range_m } => SettingChange::RangeM(f64::from(*range_m)),
            Command::MaxPingRate { pings_per_s } => {
                SettingChange::MaxPingRateHz(f64::from(*pings_per_s))
            }
            Command::Power { power_db } => SettingChange::SourceLevelDb(f64::from(*power_db)),
            Command::Gain { gain_db } => SettingChange::GainDb(f64::from(*gain_db)),
            Command::PulseLength { pulse_length_s } => {
                SettingChange::PulseDurationS(f64::from(*pulse_length_s))
            }
            Command::StartPinging => SettingChange::Start,
            Command::StopPinging => SettingChange::Stop,
            Command::SingleRecord { record_type_id } => {
                return self.single_record(*record_type_id, context);
            }
            Command::Subscribe { record_type_ids } => {
                if record_type_ids.is_empty() {
                    return Err(ErrorCode::InvalidParameter);
                }
                return self.subscribe(RecordSet::of(record_type_ids), context);
            }
            Command::SubscribeRange { first, last } => {
                if first > last {
                    return Err(ErrorCode::InvalidParameter);
                }
                let mut set = RecordSet::EMPTY;
                for id in RECORDS.iter().filter(|id| (first..=last).contains(id)) {
                    set.insert(*id);
                }
                return self.subscribe(set, context);
            }
            Command::Unsubscribe { record_type_ids } => {
                self.subscribed = self.subscribed.without(RecordSet::of(record_type_ids));
                return Ok(None);
            }
            Command::EndSubscriptions => {
                self.subscribed = RecordSet::EMPTY;
                return Ok(None);
            }
            Command::Unknown(_) => return Err(ErrorCode::RemoteCommandNotFound),
            // Everything that a SeaBat can do and we cannot.
            Command::PulseType(_)
            | Command::BottomDetectionMask { .. }
            | Command::BottomDetectionFilter { .. }
            | Command::GainType(_)
            | Command::PulseEnvelope { .. }
            | Command::ProjectorSteering { .. }
            | Command::ProjectorBeamWidths { .. }
            | Command::CenterFrequency { .. }
            | Command::ChirpBand { .. }
            | Command::MotionCompensation { .. }
            | Command::MatchFilter { .. }
            | Command::CoverageSector { .. }
            | Command::ConnectThirdParty { .. }
            | Command::DisconnectThirdParty { .. }
            | Command::SinglePing
            | Command::ExternalTrigger
            | Command::TriggerOut { .. }
            | Command::PpsEdge { .. }
            | Command::SnippetControl { .. }
            | Command::PingTimes { .. }
            | Command::CompressedWaterColumn { .. }
            | Command::SoundVelocity { .. } => return Err(ErrorCode::FeatureNotAvailable),
        };
        let asked = Asked {
            utc: context.now,
            by: context.by,
        };
        match context.settings.apply(change, asked) {
            Ok(_) => Ok(None),
            Err(_) => Err(ErrorCode::ParameterOutOfRange),
        }
    }

    fn subscribe(
        &mut self,
        asked: RecordSet,
        context: &SessionContext<'_>,
    ) -> Result<Option<Datagram>, ErrorCode> {
        let sent = context
            .sheet
            .ping_records()
            .union(RecordSet::of(&[REMOTE_CONTROL]));
        let ours = asked.intersection(sent);
        if ours.is_empty() {
            return Err(ErrorCode::RecordNotAvailable);
        }
        self.subscribed = self.subscribed.union(ours);
        Ok(None)
    }

    fn single_record(
        &mut self,
        id: u32,
        context: &SessionContext<'_>,
    ) -> Result<Option<Datagram>, ErrorCode> {
        let settings = context.settings.settings();
        match id {
            7001 => Ok(Some(context.sheet.configuration_7001(context.now))),
            7503 => Ok(Some(
                context.sheet.current_settings_7503(&settings, context.now),
            )),
            REMOTE_CONTROL => Err(ErrorCode::RecordIsSubscriptionOnly),
            id if context.sheet.ping_records().contains(id) && settings.pinging => {
                self.requested.insert(id);
                Ok(None)
            }
            _ => Err(ErrorCode::RecordNotAvailable),
        }
    }

    fn refuse(
        &mut self,
        header: &ControlHeader,
        code: ErrorCode,
        context: &SessionContext<'_>,
        out: &mut Vec<Outgoing>,
    ) {
        self.counts.nacks += 1;
        let stamp = context.sheet.stamp(context.now);
        out.push(Outgoing::Reply(datagram(NACK, |buf| {
            header.nack(code).emit(buf, &stamp);
        })));
    }
}

/// The header of a 7500 that stands at the front of `record`, if that is what it says it is.
fn command_header(record: &[u8]) -> Option<ControlHeader> {
    let frame = DataRecordFrame::parse(record).ok()?;
    if frame.check().is_err() || frame.record_type_id != REMOTE_CONTROL {
        return None;
    }
    match ControlRequest::parse(record.get(DATA_RECORD_FRAME_BYTES..)?) {
        Ok(request) => Some(request.header()),
        Err(error) => error.header,
    }
}

fn datagram(record_type: u32, fill: impl FnOnce(&mut Vec<u8>)) -> Datagram {
    let mut bytes = Vec::new();
    fill(&mut bytes);
    Datagram { record_type, bytes }
}

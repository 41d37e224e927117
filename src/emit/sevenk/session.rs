//! 7k session of one client: commands, answers and subscriptions. Sans I/O.
//!
//! The DFD (3.12) leaves some behaviour open:
//! - 1051 and 1055 add to the subscription, 1056 removes from it, 1052 ends it. Record types that this sonar does not send are
//!   ignored, because clients request all types that they support. A list without any available type is refused (0x7002).
//! - 7030 and 1009 are sent once to a client that subscribes to them.
//! - 1050 for 7001, 7503, 7030 or 1009 is answered at once. For a ping record, the record of the next ping is sent once. While the
//!   sonar is not pinging, the request is refused (0x7002). 7500 is available by subscription only (0x700A).
//! - Settings of a SeaBat that the model does not use are stored and reported in 7503 ([`super::stored_settings`]). Values that the
//!   configuration fixes (pulse type, frequency, band) are accepted if they match and refused (0x7006) otherwise.
//! - 1114, 1100 and 1101 stop the internal trigger. 1107 and 1121 stop continuous pinging.
//! - The four bytes of an address in 1053 and 1054 are in the order a.b.c.d.
//! - The address in 1053 must be that of the client or one that the configuration permits, and not a port of the server. Otherwise
//!   a client could send records to any address, or commands to the server in the name of the server. Other addresses are refused
//!   (0x700C).
//! - Commands to device 0, to the Center (7000), to 7125 or to 50 are accepted, because widely used clients send these to any
//!   sonar. Other devices, and enumerators other than 0 and the sonar's own, are refused (0x7009).
//! - A command with a wrong checksum in an otherwise valid frame is refused (0x7054). Other malformed bytes are counted and get no
//!   answer, because they have no ticket.
//! - Records other than 7500 are counted and get no answer.

use std::net::{Ipv4Addr, SocketAddr};

use echotank_protocols::sevenk::control::{self, ControlHeader, ThirdParty};
use echotank_protocols::sevenk::frame::{DATA_RECORD_FRAME_BYTES, NETWORK_FRAME_BYTES};
use echotank_protocols::sevenk::{
    Command, ControlRequest, DataRecordFrame, ErrorCode, Reassembler, Record, StreamDecoder,
    WireError,
};

use super::bottom::can_compress;
use super::records::DeviceSheet;
use super::stored_settings;
use super::{RECORDS, RecordSet};
use crate::session::Transport;
pub use crate::session::{Outgoing, SessionCounts};
use echotank_core::records::Datagram;
use echotank_core::settings::{
    ChangeOrigin, Requester, SettingChange, SettingsPort, StoredValue, TriggerSource,
};
use echotank_core::time::UtcNs;

/// Maximum size of a record from a client, bytes. A command with some thousands of record types has this size.
pub(crate) const MAX_COMMAND_BYTES: u32 = 64 * 1024;

const REMOTE_CONTROL: u32 = 7500;
const ACK: u32 = 7501;
const NACK: u32 = 7502;

/// State outside the session that the answers depend on.
#[derive(Clone, Copy)]
pub struct SessionContext<'a> {
    /// Properties of the sonar.
    pub sheet: &'a DeviceSheet,
    /// Settings that commands change.
    pub settings: &'a dyn SettingsPort,
    /// Rig time of the answers.
    pub now: UtcNs,
    /// True for an address of the server itself.
    pub is_own: fn(SocketAddr) -> bool,
    /// Origin of the commands, recorded with setting changes.
    pub by: Requester,
}

/// 7k session of one client, over TCP or UDP.
pub struct Session {
    input: Input,
    client: Client,
}

enum Input {
    Stream(StreamDecoder),
    Datagrams(Reassembler),
}

/// Session state except for the input bytes.
#[derive(Default)]
struct Client {
    subscribed: RecordSet,
    requested: RecordSet,
    counts: SessionCounts,
}

impl Session {
    /// Session of a client over TCP.
    pub fn stream() -> Self {
        Self {
            input: Input::Stream(StreamDecoder::new(MAX_COMMAND_BYTES)),
            client: Client::default(),
        }
    }

    /// Session of a client over UDP.
    pub fn datagrams() -> Self {
        Self {
            input: Input::Datagrams(Reassembler::new(MAX_COMMAND_BYTES)),
            client: Client::default(),
        }
    }

    /// Counters of the session so far.
    pub fn counts(&self) -> SessionCounts {
        self.client.counts
    }

    /// Records that the client receives from every ping.
    pub fn subscribed(&self) -> RecordSet {
        self.client.subscribed
    }

    /// Removes and returns the ping records requested once since the last call.
    pub fn take_requested(&mut self) -> RecordSet {
        std::mem::take(&mut self.client.requested)
    }

    /// True if only a part of a record has arrived.
    pub fn is_waiting(&self) -> bool {
        match &self.input {
            Input::Stream(decoder) => decoder.held_bytes() > 0,
            Input::Datagrams(_) => false,
        }
    }

    /// Processes bytes from the client (over UDP: one datagram) and appends the answers to `out` in order.
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

    /// Ends the wait for the rest of a record, because the client closed the connection or stalled. Records after the first byte of
    /// the incomplete record are then processed.
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

    /// `record` is the data at the start of the malformed record, after its network frame.
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
        let before = self.subscribed;
        match self.execute(&request.command, context) {
            Err(code) => self.refuse(&header, code, context, out),
            Ok(answer) => {
                let stamp = context.sheet.stamp(context.now);
                out.push(Outgoing::Reply(datagram(ACK, |buf| {
                    header.ack().emit(buf, &stamp)
                })));
                out.extend(answer);
                let new = self.subscribed.without(before);
                let described = context.sheet.descriptions(context.now).into_iter();
                out.extend(
                    described
                        .filter(|record| new.contains(record.record_type))
                        .map(Outgoing::Reply),
                );
                out.push(Outgoing::Echo(datagram(REMOTE_CONTROL, |buf| {
                    request.emit(buf, &stamp)
                })));
            }
        }
    }

    /// Executes a command. Returns the remaining action: a record that is available at once, or a third party as a destination.
    fn execute(
        &mut self,
        command: &Command,
        context: &SessionContext<'_>,
    ) -> Result<Option<Outgoing>, ErrorCode> {
        let origin = ChangeOrigin {
            utc: context.now,
            by: context.by,
        };
        if let Some((name, numbers)) = stored_settings::stored_setting(command) {
            check_kept(command)?;
            let value = StoredValue::Numbers(numbers);
            let stored = context
                .settings
                .store(stored_settings::key(name), value, origin);
            return stored
                .map(|()| None)
                .map_err(|_| ErrorCode::RemoteCommandDenied);
        }
        let apply = |change| {
            let applied = context.settings.apply(change, origin);
            applied
                .map(|_| None)
                .map_err(|_| ErrorCode::ParameterOutOfRange)
        };
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
            Command::StartPinging | Command::StopPinging => {
                if context.settings.trigger() == TriggerSource::External {
                    apply(SettingChange::Trigger(TriggerSource::Internal))?;
                }
                match command {
                    Command::StartPinging => SettingChange::Start,
                    _ => SettingChange::Stop,
                }
            }
            Command::SinglePing => SettingChange::PingTimes(1),
            Command::PingTimes { count } => SettingChange::PingTimes(*count),
            Command::ExternalTrigger => SettingChange::Trigger(TriggerSource::External),
            Command::PulseType(kind) => return context.sheet.confirms_pulse(*kind).map(|()| None),
            Command::CenterFrequency { frequency_hz } => {
                return context
                    .sheet
                    .confirms_band(*frequency_hz, 0.0)
                    .map(|()| None);
            }
            Command::ChirpBand { start_hz, stop_hz } => {
                let (middle, width) = (0.5 * (start_hz + stop_hz), stop_hz - start_hz);
                return context.sheet.confirms_band(middle, width).map(|()| None);
            }
            Command::ConnectThirdParty {
                party,
                record_type_ids,
            } => {
                let ours = Self::available(RecordSet::of(record_type_ids), context)?;
                let (peer, transport) = address(party);
                check_third_party(peer, context)?;
                return Ok(Some(Outgoing::Dial {
                    peer,
                    transport,
                    wants: ours.into(),
                }));
            }
            Command::DisconnectThirdParty { party } => {
                let (peer, transport) = address(party);
                return Ok(Some(Outgoing::HangUp { peer, transport }));
            }
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
            // The setting is stored above.
            _ => return Err(ErrorCode::FeatureNotAvailable),
        };
        apply(change)
    }

    /// The requested records that this sonar sends. An error if there is none.
    fn available(asked: RecordSet, context: &SessionContext<'_>) -> Result<RecordSet, ErrorCode> {
        let sent = context
            .sheet
            .ping_records()
            .union(RecordSet::of(&[REMOTE_CONTROL, 7030, 1009]));
        let ours = asked.intersection(sent);
        if ours.is_empty() {
            return Err(ErrorCode::RecordNotAvailable);
        }
        Ok(ours)
    }

    fn subscribe(
        &mut self,
        asked: RecordSet,
        context: &SessionContext<'_>,
    ) -> Result<Option<Outgoing>, ErrorCode> {
        self.subscribed = self.subscribed.union(Self::available(asked, context)?);
        Ok(None)
    }

    fn single_record(
        &mut self,
        id: u32,
        context: &SessionContext<'_>,
    ) -> Result<Option<Outgoing>, ErrorCode> {
        let (sheet, now) = (context.sheet, context.now);
        let settings = context.settings.settings();
        match id {
            7001 => Ok(Some(Outgoing::Reply(sheet.configuration_7001(now)))),
            7503 => {
                let record = sheet.current_settings_7503(context.settings, now);
                Ok(Some(Outgoing::Reply(record)))
            }
            7030 | 1009 => {
                let mut described = sheet.descriptions(now).into_iter();
                let record = described.find(|record| record.record_type == id);
                Ok(record.map(Outgoing::Reply))
            }
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
            header.nack(code).emit(buf, &stamp)
        })));
    }
}

/// Checks a stored setting. Its values must be within bounds, and the model must support a set-up of 7042.
fn check_kept(command: &Command) -> Result<(), ErrorCode> {
    use std::f32::consts::{FRAC_PI_2, PI};
    let is_right = match *command {
        Command::BottomDetectionFilter {
            min_range_m,
            max_range_m,
            min_depth_m,
            max_depth_m,
            ..
        } => min_range_m >= 0.0 && min_range_m <= max_range_m && min_depth_m <= max_depth_m,
        Command::PulseEnvelope { shading, .. } => (0.0..=1.0).contains(&shading),
        Command::ProjectorSteering {
            vertical_rad,
            horizontal_rad,
        } => vertical_rad.abs() <= FRAC_PI_2 && horizontal_rad.abs() <= FRAC_PI_2,
        Command::ProjectorBeamWidths {
            vertical_rad,
            horizontal_rad,
        } => vertical_rad > 0.0 && horizontal_rad > 0.0,
        Command::CoverageSector {
            sector_rad,
            rx_steering_rad,
        } => sector_rad > 0.0 && sector_rad <= PI && rx_steering_rad.abs() <= FRAC_PI_2,
        Command::TriggerOut { length_s, .. } => length_s >= 0.0,
        Command::SnippetControl {
            min_window_samples,
            max_window_samples,
            ..
        } => min_window_samples <= max_window_samples && max_window_samples > 0,
        Command::SoundVelocity {
            sound_velocity_m_per_s,
            ..
        } => (1000.0..=2000.0).contains(&sound_velocity_m_per_s),
        Command::CompressedWaterColumn { flags } => {
            return if can_compress(flags) {
                Ok(())
            } else {
                Err(ErrorCode::FeatureNotAvailable)
            };
        }
        _ => true,
    };
    is_right.then_some(()).ok_or(ErrorCode::ParameterOutOfRange)
}

/// Checks whether the configuration permits records to a third party.
fn check_third_party(peer: SocketAddr, context: &SessionContext<'_>) -> Result<(), ErrorCode> {
    let client = context.by.peer.map(|client| client.ip().to_canonical());
    let is_permitted =
        client == Some(peer.ip()) || context.sheet.third_parties().contains(&peer.ip());
    let is_refused = peer.port() == 0 || (context.is_own)(peer);
    match is_permitted && !is_refused {
        true => Ok(()),
        false => Err(ErrorCode::RemoteCommandDenied),
    }
}

fn address(party: &ThirdParty) -> (SocketAddr, Transport) {
    let peer = SocketAddr::from((Ipv4Addr::from(party.ipv4.to_le_bytes()), party.port));
    let transport = match party.transport {
        control::Transport::Udp => Transport::Udp,
        control::Transport::Tcp => Transport::Tcp,
    };
    (peer, transport)
}

/// Header of the 7500 at the start of `record`; `None` if the record is not a 7500.
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

fn datagram<R>(record_type: u32, fill: impl FnOnce(&mut Vec<u8>) -> R) -> Datagram {
    let mut bytes = Vec::new();
    fill(&mut bytes);
    Datagram { record_type, bytes }
}

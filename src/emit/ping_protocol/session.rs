//! Client sessions of the Ping protocol: commands and answers.
//!
//! - A request for messages 4, 5 or 169 is answered at once. Requested ping messages are sent with the next ping. A message that
//!   the device does not have is refused (2) with a reason.
//! - A command is acknowledged (1), or refused (2) with a reason and without effect. The ping rate is a maximum, so values above
//!   the limit of the sonar are clamped. The pulse length follows from the range and is also clamped. All other values must be
//!   within the limits.
//! - Automatic gain (-1) and automatic range (0) are not modelled and leave the values of the sonar unchanged. Speed of sound,
//!   filter, frequency and network settings are stored without effect.
//! - A client receives all messages after it connects, or over UDP after it sends a valid frame.

use std::net::SocketAddr;
use std::sync::Arc;

use echotank_protocols::ping_protocol::common::{
    AckMessage, DeviceInformation, ProtocolVersion, emit_nack,
};
use echotank_protocols::ping_protocol::omniscan450::OsPingParams;
use echotank_protocols::ping_protocol::surveyor240::{SetPingParameters, emit_utc_request};
use echotank_protocols::ping_protocol::{Frame, Message, PingFraming, PingStream, message_id};

use super::{Device, GAIN_PERCENT, GAIN_STEPS};
use crate::changes::{apply_all, at_part};
use crate::session::{Outgoing, Protocol, Session, SessionCounts, Transport, Wants};
use echotank_config::spec::PingDevice;
use echotank_core::records::Datagram;
use echotank_core::settings::{
    ChangeOrigin, Requester, SettingChange, SettingLimits, SettingsPort, StoredKey, StoredValue,
};
use echotank_core::time::UtcNs;

/// Name under which this protocol changes settings.
pub(crate) const VIA: &str = "ping";

/// Version of this program, reported as the firmware version.
const FIRMWARE: [u8; 3] = [
    part(env!("CARGO_PKG_VERSION_MAJOR")),
    part(env!("CARGO_PKG_VERSION_MINOR")),
    part(env!("CARGO_PKG_VERSION_PATCH")),
];

const fn part(text: &str) -> u8 {
    match u8::from_str_radix(text, 10) {
        Ok(part) => part,
        Err(_) => panic!("a part of the version is a number below 256"),
    }
}

const PROTOCOL_VERSION: [u8; 3] = [1, 0, 0];

/// One device on one port.
pub struct PingPort {
    device: Arc<Device>,
    settings: Arc<dyn SettingsPort>,
}

impl PingPort {
    /// Port that changes `settings` and the requested settings of `device`.
    pub fn new(device: Arc<Device>, settings: Arc<dyn SettingsPort>) -> Self {
        Self { device, settings }
    }

    /// Creates the session of a client without a network address, such as a serial line.
    pub fn connect_line(&self) -> Box<dyn Session> {
        self.client(false, None)
    }

    fn client(&self, datagrams: bool, peer: Option<SocketAddr>) -> Box<dyn Session> {
        Box::new(Client {
            device: Arc::clone(&self.device),
            settings: Arc::clone(&self.settings),
            by: Requester { via: VIA, peer },
            stream: PingStream::new(PingFraming),
            datagrams,
            counts: SessionCounts::default(),
        })
    }
}

impl Protocol for PingPort {
    fn name(&self) -> &'static str {
        VIA
    }
    fn connect(&self, transport: Transport, peer: SocketAddr) -> Box<dyn Session> {
        self.client(transport == Transport::Udp, Some(peer))
    }
    fn class(&self, _record_type: u32) -> Wants {
        Wants::ALL
    }
    fn recognises(&self, datagram: &[u8]) -> bool {
        Frame::parse(datagram).is_ok()
    }
}

struct Client {
    device: Arc<Device>,
    settings: Arc<dyn SettingsPort>,
    by: Requester,
    stream: PingStream,
    /// Each datagram begins with a frame.
    datagrams: bool,
    counts: SessionCounts,
}

impl Session for Client {
    /// The Surveyor requests the time from a new client.
    fn greet(&mut self, _now: UtcNs, out: &mut Vec<Outgoing>) {
        if self.device.spec.device == PingDevice::Surveyor240 {
            let id = self.device.requested().device_id;
            out.push(reply(message_id::UTC_REQUEST, |buf| {
                emit_utc_request(buf, id, 0)
            }));
        }
    }

    fn receive(&mut self, bytes: &[u8], now: UtcNs, out: &mut Vec<Outgoing>) {
        let mut stream = std::mem::replace(&mut self.stream, PingStream::new(PingFraming));
        if self.datagrams {
            stream = PingStream::new(PingFraming);
        }
        stream.feed(bytes, |item| self.process_item(item, now, out));
        self.stream = stream;
        if self.datagrams {
            self.give_up_waiting(now, out);
        }
    }

    fn is_waiting(&self) -> bool {
        self.stream.held_bytes() > 0
    }

    fn give_up_waiting(&mut self, now: UtcNs, out: &mut Vec<Outgoing>) {
        let mut stream = std::mem::replace(&mut self.stream, PingStream::new(PingFraming));
        stream.finish();
        stream.feed(&[], |item| self.process_item(item, now, out));
        self.stream = stream;
    }

    fn wants(&self) -> Wants {
        Wants::ALL
    }

    fn counts(&self) -> SessionCounts {
        self.counts
    }
}

/// Reason for refusing a command.
type Refusal = String;

impl Client {
    fn process_item(
        &mut self,
        item: Result<&[u8], echotank_protocols::WireError>,
        now: UtcNs,
        out: &mut Vec<Outgoing>,
    ) {
        let Ok(frame) = item.and_then(Frame::parse) else {
            self.counts.framing_errors += 1;
            return;
        };
        let id = frame.message_id;
        let outcome = match Message::parse(&frame) {
            Ok(message) => self.execute(&message, frame.source, now, out),
            Err(error) => Err(error.to_string()),
        };
        let (from, to) = (self.device.requested().device_id, frame.source);
        match outcome {
            Ok(Outcome::Command) => {
                self.counts.commands += 1;
                out.push(reply(message_id::ACK, |buf| {
                    AckMessage { acked_id: id }.emit_frame(buf, from, to);
                }));
            }
            Ok(Outcome::Answered) => self.counts.commands += 1,
            Ok(Outcome::NoCommand) => self.counts.other_records += 1,
            Err(words) => {
                self.counts.commands += 1;
                self.counts.nacks += 1;
                out.push(reply(message_id::NACK, |buf| {
                    emit_nack(buf, from, to, id, &words)
                }));
            }
        }
    }

    fn execute(
        &mut self,
        message: &Message<'_>,
        to: u8,
        now: UtcNs,
        out: &mut Vec<Outgoing>,
    ) -> Result<Outcome, Refusal> {
        let is_omniscan = self.device.spec.device != PingDevice::Surveyor240;
        let origin = ChangeOrigin {
            utc: now,
            by: self.by,
        };
        match message {
            Message::GeneralRequest(request) => {
                return self.request(request.requested_id, to, out);
            }
            Message::SetDeviceId(set) => {
                if set.device_id == 0 || set.device_id == u8::MAX {
                    return Err("device_id must be from 1 to 254".into());
                }
                self.device.lock().device_id = set.device_id;
            }
            Message::OsPingParams(params) if is_omniscan => self.os_ping_params(params, origin)?,
            Message::SetSpeedOfSound(set) if is_omniscan => {
                let m_per_s = f64::from(set.speed_of_sound_mm_per_s) / 1e3;
                self.store(
                    "speed_of_sound",
                    StoredValue::Numbers(vec![m_per_s]),
                    origin,
                )?;
            }
            Message::SetSyncChannel(sync) if is_omniscan => {
                if sync.channel_number >= sync.number_of_channels {
                    return Err("channel_number must be below number_of_channels".into());
                }
                self.device.lock().sync = *sync;
            }
            Message::SetPingParameters(params) if !is_omniscan => {
                self.set_ping_parameters(params, origin)?;
            }
            Message::SetNetInfo(info) if !is_omniscan => {
                let numbers = [info.ntp_ip_address, info.subnet_mask, info.gateway_ip];
                let value = StoredValue::Numbers(numbers.map(f64::from).into());
                self.store("net_info", value, origin)?;
            }
            // The device uses rig time instead of the time of the client.
            Message::UtcResponse(_)
            | Message::Ack(_)
            | Message::Nack { .. }
            | Message::AsciiText(_)
            | Message::Json(_)
            | Message::DeviceInformation(_)
            | Message::ProtocolVersion(_) => return Ok(Outcome::NoCommand),
            _ => return Err("not a command of this device".into()),
        }
        Ok(Outcome::Command)
    }

    fn request(&mut self, id: u16, to: u8, out: &mut Vec<Outgoing>) -> Result<Outcome, Refusal> {
        let requested = self.device.requested();
        let from = requested.device_id;
        let is_omniscan = self.device.spec.device != PingDevice::Surveyor240;
        match id {
            message_id::DEVICE_INFORMATION => {
                let information = DeviceInformation {
                    // The manufacturers publish no number for either field.
                    device_type: 0,
                    device_revision: 1,
                    firmware: FIRMWARE,
                };
                out.push(reply(id, |buf| information.emit_frame(buf, from, to)));
            }
            message_id::PROTOCOL_VERSION => {
                let version = ProtocolVersion {
                    version: PROTOCOL_VERSION,
                };
                out.push(reply(id, |buf| version.emit_frame(buf, from, to)));
            }
            message_id::SYNC_CHANNEL if is_omniscan => {
                out.push(reply(id, |buf| requested.sync.emit_frame(buf, from, to)))
            }
            // The message is sent with every ping anyway.
            message_id::OS_MONO_PROFILE if is_omniscan => {}
            message_id::ATTITUDE_REPORT if !is_omniscan => {}
            message_id::ATOF_POINT_DATA if !is_omniscan => self.device.lock().wants_atof = true,
            message_id::YZ_POINT_DATA if !is_omniscan => self.device.lock().wants_yz = true,
            _ => return Err(format!("this device has no message {id}")),
        }
        Ok(Outcome::Answered)
    }

    /// Applies message 2197 (Omniscan ping parameters).
    fn os_ping_params(
        &mut self,
        params: &OsPingParams,
        origin: ChangeOrigin,
    ) -> Result<(), Refusal> {
        let (start_m, length_m) = (
            f64::from(params.start_mm) / 1e3,
            f64::from(params.length_mm) / 1e3,
        );
        if !(200..=1200).contains(&params.num_results) {
            return Err("num_results must be from 200 to 1200".into());
        }
        if length_m == 0.0 {
            return Err("length_mm must be above 0".into());
        }
        let limits = self.settings.limits();
        let range_m = start_m + length_m;
        let mut changes = vec![SettingChange::RangeM(range_m)];
        changes.push(rate(i64::from(params.msec_per_ping), &limits));
        changes.extend(gain(params.gain_index, GAIN_STEPS, &limits)?);
        let c = self.device.sound_speed_m_per_s;
        changes.push(pulse(
            f64::from(params.pulse_len_percent) * 2.0 * length_m / c,
            &limits,
        )?);
        changes.push(start_or_stop(params.enable != 0));
        apply_all(&*self.settings, &changes, origin).map_err(|refused| refused.to_string())?;
        let filter = f64::from(params.filter_duration_percent);
        self.store(
            "filter_duration_percent",
            StoredValue::Numbers(vec![filter]),
            origin,
        )?;
        let mut requested = self.device.lock();
        requested.start_m = start_m;
        requested.num_results = params.num_results;
        Ok(())
    }

    /// Applies message 3023 (Surveyor ping parameters).
    fn set_ping_parameters(
        &mut self,
        params: &SetPingParameters,
        origin: ChangeOrigin,
    ) -> Result<(), Refusal> {
        if !(200..=800).contains(&params.n_range_steps) {
            return Err("n_range_steps must be from 200 to 800".into());
        }
        if params.reserved_for_raw_data != 0 {
            return Err("reserved_for_raw_data must be false".into());
        }
        if params.enable_channel_data != 0 {
            return Err("channel data have no public layout".into());
        }
        if params.diagnostic_injected_signal != 0 {
            return Err("diagnostic_injected_signal must be 0".into());
        }
        if params.end_mm < 0 || params.start_mm < 0 {
            return Err("start_mm and end_mm must not be below 0".into());
        }
        let limits = self.settings.limits();
        let mut changes = Vec::new();
        let end_m = match params.end_mm {
            // Automatic range (bottom tracking) is not modelled.
            0 => self.settings.settings().range_m,
            mm => f64::from(mm) / 1e3,
        };
        if params.end_mm > 0 {
            if params.start_mm >= params.end_mm {
                return Err("start_mm must be below end_mm".into());
            }
            changes.push(SettingChange::RangeM(end_m));
        }
        changes.push(rate(params.msec_per_ping.into(), &limits));
        changes.extend(gain(params.gain_index, GAIN_PERCENT, &limits)?);
        let step_s =
            2.0 * end_m / self.device.sound_speed_m_per_s / f64::from(params.n_range_steps);
        changes.push(pulse(f64::from(params.pulse_len_steps) * step_s, &limits)?);
        changes.push(start_or_stop(params.ping_enable != 0));
        apply_all(&*self.settings, &changes, origin).map_err(|refused| refused.to_string())?;
        let numbers = |value: f64| StoredValue::Numbers(vec![value]);
        self.store("sos_mps", numbers(f64::from(params.sos_mps)), origin)?;
        let frequency = StoredValue::Integer(params.target_ping_hz.into());
        self.store("target_ping_hz", frequency, origin)?;
        let mut requested = self.device.lock();
        // The device starts at 5 % of the range or more. Automatic range starts at 0.
        requested.start_m = match params.end_mm {
            0 => 0.0,
            _ => (f64::from(params.start_mm) / 1e3).max(0.05 * end_m),
        };
        requested.num_results = params.n_range_steps;
        requested.wants_atof = params.enable_atof_data != 0;
        requested.wants_yz = params.enable_yz_point_data != 0;
        Ok(())
    }

    fn store(
        &self,
        name: &'static str,
        value: StoredValue,
        origin: ChangeOrigin,
    ) -> Result<(), Refusal> {
        let key = StoredKey {
            via: VIA,
            name,
            place: 0,
        };
        self.settings
            .store(key, value, origin)
            .map_err(|refused| refused.to_string())
    }
}

/// Outcome of an accepted message.
enum Outcome {
    /// A command, which is acknowledged.
    Command,
    Answered,
    NoCommand,
}

/// Maximum ping rate. A period of 0 or less selects the maximum rate of the sonar.
fn rate(msec_per_ping: i64, limits: &SettingLimits) -> SettingChange {
    let (_, max_hz) = limits.ping_rate_hz;
    SettingChange::MaxPingRateHz(match msec_per_ping {
        ..=0 => max_hz,
        msec => (1e3 / msec as f64).min(max_hz),
    })
}

/// Gain of an index. Automatic gain (-1) leaves the gain unchanged.
fn gain(index: i16, steps: f64, limits: &SettingLimits) -> Result<Option<SettingChange>, Refusal> {
    match f64::from(index) {
        -1.0 => Ok(None),
        index if (0.0..=steps).contains(&index) => Ok(Some(SettingChange::GainDb(at_part(
            limits.gain_db,
            index / steps,
        )))),
        _ => Err(format!("gain_index must be -1 or from 0 to {steps}")),
    }
}

fn pulse(duration_s: f64, limits: &SettingLimits) -> Result<SettingChange, Refusal> {
    if !(duration_s >= 0.0 && duration_s.is_finite()) {
        return Err("the pulse length must be finite and not below 0".into());
    }
    let (shortest_s, longest_s) = limits.pulse_duration_s;
    Ok(SettingChange::PulseDurationS(
        duration_s.clamp(shortest_s, longest_s),
    ))
}

fn start_or_stop(enable: bool) -> SettingChange {
    match enable {
        true => SettingChange::Start,
        false => SettingChange::Stop,
    }
}

fn reply<R>(id: u16, write: impl FnOnce(&mut Vec<u8>) -> R) -> Outgoing {
    let mut bytes = Vec::new();
    write(&mut bytes);
    Outgoing::Reply(Datagram {
        record_type: id.into(),
        bytes,
    })
}

//! Sessions for the two connections of a JSF client: commands and answers, and data. Sans I/O.
//!
//! No manual defines the following behaviour:
//! - A successful SET has no answer, a GET has a REPLY, and every failure has an ERROR. Message 41 is always echoed.
//! - Settings, including 83, belong to the sonar and not to a connection. A client that reconnects finds the stored values. Data
//!   are active by default.
//! - Message 121 is the transmit amplitude relative to its maximum, times 1000. The upper limit of the source level plus 20 log10
//!   of the ratio gives the source level. Message 140 is the receiver gain as a factor, times 1000.
//! - Subsystems in `silent_subsystems` do not exist in the sonar. They store and report all settings without effect.
//! - The subsystems of further pulses in the same ping share the sonar's settings. Only 83 is set per channel.
//! - Message 25 stops pinging, because a widely used client sends it before it disconnects. The program continues.
//! - Message 22 is refused, because the time comes from the navigation.

use std::net::SocketAddr;
use std::sync::Arc;

use echotank_protocols::jsf::control::{error_code, error_code_for, trigger};
use echotank_protocols::jsf::sensors::SensorTime;
use echotank_protocols::jsf::{
    Control, JsfFraming, JsfStream, Message, Value, command_type, message_type,
};

use super::{JsfSheet, record_type};
use crate::session::{Outgoing, Protocol, Session, SessionCounts, Transport, Wants};
use echotank_core::records::Datagram;
use echotank_core::settings::{
    ChangeOrigin, Requester, SettingChange, SettingsPort, StoredKey, StoredValue, TriggerSource,
};
use echotank_core::time::UtcNs;

/// Name under which JSF changes settings.
pub(crate) const VIA: &str = "jsf";

/// Maximum length of a client's message body, bytes.
const MAX_COMMAND_BODY_BYTES: u32 = 4096;

/// Protocol of the command connection.
pub struct JsfCommands {
    /// Properties of the sonar.
    pub sheet: Arc<JsfSheet>,
    /// Settings that commands change.
    pub settings: Arc<dyn SettingsPort>,
}

/// Protocol of the data connection: every client receives all active data.
pub struct JsfData {
    /// Properties of the sonar.
    pub sheet: Arc<JsfSheet>,
}

fn key(message_type: u16, subsystem: u8, channel: u8) -> StoredKey {
    StoredKey {
        via: VIA,
        name: "message",
        place: record_type(message_type, subsystem, channel),
    }
}

/// True if data of a channel are active (83). Data are active until a client disables them.
pub fn is_active(settings: &dyn SettingsPort, subsystem: u8, channel: u8) -> bool {
    let value = settings.stored(key(message_type::DATA_ACTIVE, subsystem, channel));
    value != Some(StoredValue::Integer(0))
}

impl Protocol for JsfCommands {
    fn name(&self) -> &'static str {
        VIA
    }
    fn connect(&self, _transport: Transport, peer: SocketAddr) -> Box<dyn Session> {
        let framing = JsfFraming {
            max_body_bytes: MAX_COMMAND_BODY_BYTES,
        };
        Box::new(CommandSession {
            stream: JsfStream::new(framing),
            client: Client {
                sheet: Arc::clone(&self.sheet),
                settings: Arc::clone(&self.settings),
                by: Requester {
                    via: VIA,
                    peer: Some(peer),
                },
                counts: SessionCounts::default(),
            },
        })
    }
    /// This connection carries answers only.
    fn class(&self, _record_type: u32) -> Wants {
        Wants::NONE
    }
}

impl Protocol for JsfData {
    fn name(&self) -> &'static str {
        "jsf data"
    }
    fn connect(&self, _transport: Transport, _peer: SocketAddr) -> Box<dyn Session> {
        Box::new(DataSession {
            sheet: Arc::clone(&self.sheet),
            counts: SessionCounts::default(),
        })
    }
    fn class(&self, _record_type: u32) -> Wants {
        Wants::class(0)
    }
}

struct DataSession {
    sheet: Arc<JsfSheet>,
    counts: SessionCounts,
}

impl Session for DataSession {
    fn greet(&mut self, _now: UtcNs, out: &mut Vec<Outgoing>) {
        out.push(Outgoing::Reply(self.sheet.information()));
    }
    /// Input on this connection has no effect.
    fn receive(&mut self, _bytes: &[u8], _now: UtcNs, _out: &mut Vec<Outgoing>) {
        self.counts.other_records += 1;
    }
    fn wants(&self) -> Wants {
        Wants::class(0)
    }
    fn counts(&self) -> SessionCounts {
        self.counts
    }
}

struct CommandSession {
    stream: JsfStream,
    client: Client,
}

struct Client {
    sheet: Arc<JsfSheet>,
    settings: Arc<dyn SettingsPort>,
    by: Requester,
    counts: SessionCounts,
}

impl Session for CommandSession {
    fn receive(&mut self, bytes: &[u8], now: UtcNs, out: &mut Vec<Outgoing>) {
        self.stream.feed(bytes, |item| match item {
            Ok(bytes) => self.client.message(bytes, now, out),
            Err(_) => self.client.counts.framing_errors += 1,
        });
    }
    fn is_waiting(&self) -> bool {
        self.stream.held_bytes() > 0
    }
    fn give_up_waiting(&mut self, now: UtcNs, out: &mut Vec<Outgoing>) {
        self.stream.finish();
        self.receive(&[], now, out);
    }
    fn wants(&self) -> Wants {
        Wants::NONE
    }
    fn counts(&self) -> SessionCounts {
        self.client.counts
    }
}

impl Client {
    fn message(&mut self, bytes: &[u8], now: UtcNs, out: &mut Vec<Outgoing>) {
        let Ok(message) = Message::parse(bytes) else {
            self.counts.framing_errors += 1;
            return;
        };
        self.counts.commands += 1;
        let header = &message.header;
        let answer = match Control::parse(&message) {
            Ok(control) => self.answer(&control, now),
            Err(error) => {
                let control = Control {
                    message_type: header.message_type,
                    command_type: header.command_type,
                    subsystem: header.subsystem,
                    channel: header.channel,
                    session: header.session,
                    sequence: header.sequence,
                    value: Value::None,
                };
                Some(control.refuse(error_code_for(&error)))
            }
        };
        let Some(answer) = answer else {
            return;
        };
        if answer.command_type == command_type::ERROR {
            self.counts.nacks += 1;
        }
        let mut bytes = Vec::new();
        answer.emit(&mut bytes);
        out.push(Outgoing::Reply(Datagram {
            record_type: record_type(answer.message_type, answer.subsystem, answer.channel),
            bytes,
        }));
    }

    fn answer(&self, control: &Control, now: UtcNs) -> Option<Control> {
        let done = match control.command_type {
            command_type::SET => self.set(control, now).map(|()| {
                (control.message_type == message_type::ALIVE).then(|| control.value.clone())
            }),
            command_type::GET => self.get(control, now).map(Some),
            // Answers from another device are ignored.
            _ => return None,
        };
        match done {
            Ok(value) => value.map(|value| control.reply(value)),
            Err(code) => Some(control.refuse(code)),
        }
    }

    /// True if the command addresses a subsystem that the sonar has. An error if the sonar does not answer for the subsystem.
    fn addresses_sonar(&self, control: &Control) -> Result<bool, i32> {
        let output = &self.sheet.output;
        let kind = control.message_type;
        let for_the_whole = matches!(
            kind,
            message_type::SYSTEM_TIME
                | message_type::SHUTDOWN
                | message_type::ALIVE
                | message_type::SYSTEM_TYPE
                | message_type::OPERATIONAL
        );
        let has_data = self.sheet.subsystems().any(|its| its == control.subsystem);
        if for_the_whole || has_data {
            if kind == message_type::DATA_ACTIVE
                && usize::from(control.channel) >= self.sheet.channels().max(2)
            {
                return Err(error_code::UNKNOWN_CHANNEL);
            }
            return Ok(true);
        }
        if output.silent_subsystems.contains(&control.subsystem) {
            return Ok(false);
        }
        Err(error_code::UNKNOWN_SUBSYSTEM)
    }

    fn set(&self, control: &Control, now: UtcNs) -> Result<(), i32> {
        let origin = ChangeOrigin {
            utc: now,
            by: self.by,
        };
        let ours = self.addresses_sonar(control)?;
        let value = match &control.value {
            Value::Number(number) => StoredValue::Integer(i64::from(*number)),
            Value::Coupling {
                master_subsystem,
                divisor,
                delay_us,
            } => StoredValue::Numbers(vec![
                f64::from(*master_subsystem),
                f64::from(*divisor),
                f64::from(*delay_us),
            ]),
            Value::PulseName(name) if name.is_empty() => return Err(error_code::UNKNOWN_PULSE),
            Value::PulseName(name) => StoredValue::Text(name.clone()),
            _ => return Err(error_code::FAILED),
        };
        if ours && let StoredValue::Integer(number) = value {
            self.execute(control.message_type, number, origin)?;
        }
        let key = key(control.message_type, control.subsystem, control.channel);
        self.settings
            .store(key, value, origin)
            .map_err(|_| error_code::FAILED)
    }

    /// Applies a setting that the model has. Any other setting is only stored.
    fn execute(&self, message_type: u16, number: i64, origin: ChangeOrigin) -> Result<(), i32> {
        let value = number as f64;
        let changes: &[SettingChange] = match message_type {
            message_type::PING_RANGE => &[SettingChange::RangeM(value * 1e-3)],
            message_type::PING_RATE => &[SettingChange::MaxPingRateHz(value * 1e-3)],
            message_type::PING_GAIN => &[SettingChange::SourceLevelDb(
                self.sheet.full_level_db() + 20.0 * (value * 1e-3).log10(),
            )],
            message_type::ADC_GAIN => &[SettingChange::GainDb(20.0 * (value * 1e-3).log10())],
            message_type::PING => match number {
                0 => &[SettingChange::Stop],
                1 => &[SettingChange::Start],
                2 => &[SettingChange::PingTimes(1)],
                _ => return Err(error_code::FAILED),
            },
            message_type::SHUTDOWN if number != 0 => &[SettingChange::Stop],
            message_type::PING_TRIGGER => match i32::try_from(number) {
                // A subsystem without its own pings is coupled. The sonar keeps its internal trigger.
                Ok(trigger::INTERNAL | trigger::COUPLED) => {
                    &[SettingChange::Trigger(TriggerSource::Internal)]
                }
                Ok(trigger::EXTERNAL) => &[SettingChange::Trigger(TriggerSource::External)],
                _ => return Err(error_code::FAILED),
            },
            message_type::DATA_ACTIVE if !(0..=1).contains(&number) => {
                return Err(error_code::FAILED);
            }
            _ => &[],
        };
        for &change in changes {
            let applied = self.settings.apply(change, origin);
            applied.map_err(|_| error_code::FAILED)?;
        }
        Ok(())
    }

    fn get(&self, control: &Control, now: UtcNs) -> Result<Value, i32> {
        let ours = self.addresses_sonar(control)?;
        let kind = control.message_type;
        if kind == message_type::SYSTEM_TIME {
            let time = SensorTime::from_utc_ns(now.0);
            return Ok(Value::Time {
                seconds: time.seconds,
                milliseconds: time.milliseconds,
            });
        }
        let settings = self.settings.settings();
        let thousandths = |value: f64| Value::Number((value * 1e3).round() as i32);
        if ours {
            let now = match kind {
                message_type::SYSTEM_TYPE => Some(Value::Number(self.sheet.system_type())),
                message_type::OPERATIONAL => Some(Value::Number(0)),
                message_type::PING => Some(Value::Number(i32::from(settings.pinging))),
                message_type::PING_RANGE => Some(thousandths(settings.range_m)),
                message_type::PING_RATE => Some(thousandths(settings.max_ping_rate_hz)),
                message_type::PING_GAIN => Some(thousandths(
                    10_f64.powf((settings.source_level_db - self.sheet.full_level_db()) / 20.0),
                )),
                message_type::ADC_GAIN => Some(thousandths(10_f64.powf(settings.gain_db / 20.0))),
                message_type::PING_TRIGGER
                    if self.settings.trigger() == TriggerSource::External =>
                {
                    Some(Value::Number(trigger::EXTERNAL))
                }
                _ => None,
            };
            if let Some(value) = now {
                return Ok(value);
            }
        }
        let key = key(kind, control.subsystem, control.channel);
        Ok(match (kind, self.settings.stored(key)) {
            // Another protocol has since selected the internal trigger.
            (message_type::PING_TRIGGER, Some(StoredValue::Integer(was)))
                if ours && was == i64::from(trigger::EXTERNAL) =>
            {
                Value::Number(trigger::INTERNAL)
            }
            (_, Some(StoredValue::Integer(number))) => Value::Number(number as i32),
            (_, Some(StoredValue::Text(name))) => Value::PulseName(name),
            (_, Some(StoredValue::Numbers(n))) if n.len() == 3 => Value::Coupling {
                master_subsystem: n[0] as u32,
                divisor: n[1] as u32,
                delay_us: n[2] as u32,
            },
            (message_type::PING_COUPLING, _) => Value::Coupling {
                master_subsystem: control.subsystem.into(),
                divisor: 1,
                delay_us: 0,
            },
            (message_type::PING_SELECT, _) => Value::PulseName(self.sheet.sonar.name.clone()),
            (message_type::DATA_ACTIVE, _) => Value::Number(i32::from(ours)),
            (message_type::ADC_RATE, _) if ours => {
                Value::Number(self.sheet.sonar.receiver.sample_rate_hz.round() as i32)
            }
            _ => Value::Number(0),
        })
    }
}

//! Text control protocol of WBMS, and the three data ports, which only send.
//!
//! Each line is a command. An unterminated line is a command if it parses as one, or if no more bytes arrive, because a widely used
//! client sends no line ends. Every answer repeats the command with the current values. After a refusal, the reason follows `#`.
//!
//! These commands change the sonar: ping rate, end of the range, gain, pulse amplitude, pulse length, power and trigger. The pulse
//! amplitude is 0 to 15, in equal steps over the limits of the source level. The snippet and water-column rates set how often these
//! packets are sent. All other values are stored without effect.

use std::net::SocketAddr;
use std::sync::Arc;

use echotank_protocols::wbms::control::{Command, answer};

use super::{Device, RequestedSettings};
use crate::changes::{apply_all, at_part, part_of};
use crate::session::{Outgoing, Protocol, Session, SessionCounts, Transport, Wants};
use echotank_core::records::Datagram;
use echotank_core::settings::{
    ChangeOrigin, Requester, SettingChange, SettingLimits, SettingsPort, StoredKey, StoredValue,
    TriggerSource,
};
use echotank_core::time::UtcNs;

/// Name under which this protocol changes settings.
pub(crate) const VIA: &str = "wbms";
/// Maximum pulse amplitude.
const MAX_AMPLITUDE: f64 = 15.0;
/// Maximum length of an unterminated line. A longer line is rejected.
const MAX_HELD_BYTES: usize = echotank_protocols::wbms::control::MAX_LINE_BYTES;
const READY: &str = "# Echotank, simulated WBMS, ready\r\n";

/// Pulse amplitude setting for a source level.
pub(crate) fn amplitude_of(limits: &SettingLimits, source_level_db: f64) -> u8 {
    (part_of(limits.source_level_db, source_level_db) * MAX_AMPLITUDE).round() as u8
}

/// One of the three data ports. Every client receives all its packets.
pub struct DataPort {
    /// Name for threads and counters.
    pub name: &'static str,
}

impl Protocol for DataPort {
    fn name(&self) -> &'static str {
        self.name
    }
    fn connect(&self, _transport: Transport, _peer: SocketAddr) -> Box<dyn Session> {
        Box::new(Listener::default())
    }
    fn class(&self, _record_type: u32) -> Wants {
        Wants::ALL
    }
}

#[derive(Default)]
struct Listener {
    counts: SessionCounts,
}

impl Session for Listener {
    fn receive(&mut self, _bytes: &[u8], _now: UtcNs, _out: &mut Vec<Outgoing>) {
        self.counts.other_records += 1;
    }
    fn wants(&self) -> Wants {
        Wants::ALL
    }
    fn counts(&self) -> SessionCounts {
        self.counts
    }
}

/// Control port of WBMS: text commands and their answers.
pub struct ControlPort {
    device: Arc<Device>,
    settings: Arc<dyn SettingsPort>,
}

impl ControlPort {
    /// Port that changes `settings` and the requested settings of `device`.
    pub fn new(device: Arc<Device>, settings: Arc<dyn SettingsPort>) -> Self {
        Self { device, settings }
    }
}

impl Protocol for ControlPort {
    fn name(&self) -> &'static str {
        "wbms control"
    }
    fn connect(&self, _transport: Transport, peer: SocketAddr) -> Box<dyn Session> {
        Box::new(Client {
            device: Arc::clone(&self.device),
            settings: Arc::clone(&self.settings),
            by: Requester {
                via: VIA,
                peer: Some(peer),
            },
            held: String::new(),
            is_over: false,
            counts: SessionCounts::default(),
        })
    }
    fn class(&self, _record_type: u32) -> Wants {
        Wants::NONE
    }
}

struct Client {
    device: Arc<Device>,
    settings: Arc<dyn SettingsPort>,
    by: Requester,
    /// Start of a line whose end has not arrived.
    held: String,
    is_over: bool,
    counts: SessionCounts,
}

impl Session for Client {
    fn greet(&mut self, _now: UtcNs, out: &mut Vec<Outgoing>) {
        out.push(text(READY.into()));
    }

    fn receive(&mut self, bytes: &[u8], now: UtcNs, out: &mut Vec<Outgoing>) {
        self.held.push_str(&String::from_utf8_lossy(bytes));
        let held = std::mem::take(&mut self.held);
        let (lines, tail) = match held.rfind(['\r', '\n']) {
            Some(end) => held.split_at(end + 1),
            None => ("", held.as_str()),
        };
        for line in lines.split(['\r', '\n']) {
            self.line(line, now, out);
        }
        if Command::parse(tail.trim()).is_ok() || tail.len() > MAX_HELD_BYTES {
            self.line(tail, now, out);
        } else {
            self.held = tail.to_owned();
        }
    }

    fn is_waiting(&self) -> bool {
        !self.held.trim().is_empty()
    }

    fn give_up_waiting(&mut self, now: UtcNs, out: &mut Vec<Outgoing>) {
        let held = std::mem::take(&mut self.held);
        self.line(&held, now, out);
    }

    fn is_over(&self) -> bool {
        self.is_over
    }

    fn wants(&self) -> Wants {
        Wants::NONE
    }

    fn counts(&self) -> SessionCounts {
        self.counts
    }
}

impl Client {
    fn line(&mut self, line: &str, now: UtcNs, out: &mut Vec<Outgoing>) {
        let line = line.trim();
        if line.is_empty() {
            return;
        }
        self.counts.commands += 1;
        let word = line.split_ascii_whitespace().next().unwrap_or_default();
        let origin = ChangeOrigin {
            utc: now,
            by: self.by,
        };
        let outcome = Command::parse(line)
            .map_err(|error| error.to_string())
            .and_then(|command| self.execute(word, command, origin));
        let comment = outcome.err().unwrap_or_default();
        self.counts.nacks += u64::from(!comment.is_empty());
        let comment = match comment.as_str() {
            "" => String::new(),
            why => format!("refused: {why}"),
        };
        // An unknown command word is shortened before it is repeated.
        let word: String = word
            .chars()
            .filter(char::is_ascii_graphic)
            .take(32)
            .collect();
        out.push(text(self.answer(&word, &comment)));
    }

    fn execute(
        &mut self,
        word: &str,
        command: Command,
        origin: ChangeOrigin,
    ) -> Result<(), String> {
        let limits = self.settings.limits();
        let changes: Vec<SettingChange> = match command {
            Command::Query(_) => return Ok(()),
            Command::Exit => {
                self.is_over = true;
                return Ok(());
            }
            Command::RangeM { start, stop, .. } if start >= stop => {
                return Err(format!("the range must end beyond its start, {start}"));
            }
            Command::RangeM { stop, .. } => vec![SettingChange::RangeM(stop)],
            Command::RateHz(-1.0) => vec![SettingChange::MaxPingRateHz(limits.ping_rate_hz.1)],
            Command::RateHz(hz) => vec![SettingChange::MaxPingRateHz(hz)],
            Command::GainDb(db) => vec![SettingChange::GainDb(db)],
            Command::Tx {
                amplitude,
                length_us,
                ..
            } => vec![
                SettingChange::SourceLevelDb(at_part(
                    limits.source_level_db,
                    f64::from(amplitude) / MAX_AMPLITUDE,
                )),
                SettingChange::PulseDurationS(length_us * 1e-6),
            ],
            Command::Power(true) => vec![SettingChange::Start],
            Command::Power(false) => vec![SettingChange::Stop],
            Command::TriggerMode(4 | 5) => vec![SettingChange::Trigger(TriggerSource::External)],
            Command::TriggerMode(_) => vec![SettingChange::Trigger(TriggerSource::Internal)],
            Command::Default => {
                let start = self.device.sonar.settings;
                vec![
                    SettingChange::RangeM(start.range_m),
                    SettingChange::MaxPingRateHz(start.max_ping_rate_hz),
                    SettingChange::SourceLevelDb(start.source_level_db),
                    SettingChange::GainDb(start.gain_db),
                    SettingChange::PulseDurationS(start.pulse_duration_s),
                ]
            }
            _ => Vec::new(),
        };
        apply_all(&*self.settings, &changes, origin).map_err(|refused| refused.to_string())?;
        let mut requested = self.device.lock();
        match command {
            Command::RangeM { start, .. } => requested.start_m = start,
            Command::SidescanMode(mode) => requested.sidescan_mode = mode,
            Command::SnippetRateHz(hz) => requested.snippet_rate_hz = hz,
            Command::WaterColumnRateHz(hz) => requested.water_column_rate_hz = hz,
            Command::Default => *requested = RequestedSettings::of(&self.device.sonar),
            _ => {}
        }
        drop(requested);
        self.store(word, &command, origin)
    }

    /// Stores values without an effect in the model.
    fn store(&self, word: &str, command: &Command, origin: ChangeOrigin) -> Result<(), String> {
        if let (Command::NtpServer(server), Some(key)) = (command, key_of(word)) {
            let stored = self
                .settings
                .store(key, StoredValue::Text(server.clone()), origin);
            return stored.map_err(|refused| refused.to_string());
        }
        let numbers = match *command {
            Command::Mode(value)
            | Command::GateMode(value)
            | Command::AutogatePreset(value)
            | Command::TxBeams(value)
            | Command::MfDecimation(value)
            | Command::TimeSource(value)
            | Command::TriggerMode(value) => vec![f64::from(value)],
            Command::Flip(value) => vec![f64::from(u8::from(value))],
            Command::GateTiltDeg(value)
            | Command::DirectionDeg(value)
            | Command::OpeningAngleDeg(value)
            | Command::VgaDb(value)
            | Command::TxDirectionDeg(value)
            | Command::TxOpeningAngleDeg(value) => vec![value],
            Command::Resolution {
                vertical,
                horizontal,
            } => vec![vertical, horizontal],
            Command::SoundVelocity(value) => vec![value.unwrap_or(-1.0)],
            Command::Tx {
                frequency_khz,
                bandwidth_khz,
                ..
            } => vec![frequency_khz, bandwidth_khz],
            _ => return Ok(()),
        };
        let Some(key) = key_of(word) else {
            return Ok(());
        };
        self.settings
            .store(key, StoredValue::Numbers(numbers), origin)
            .map_err(|refused| refused.to_string())
    }

    /// The command with the current values.
    fn answer(&self, word: &str, comment: &str) -> String {
        let settings = self.settings.settings();
        let requested = self.device.requested();
        let sonar = &self.device.sonar;
        let limits = self.settings.limits();
        let pulse = &sonar.pulse;
        let fan = sonar.beams.fan.as_ref();
        let values = match word {
            "set_range" => vec![requested.start_m, settings.range_m],
            "set_rate" => vec![settings.max_ping_rate_hz],
            "set_tx" => vec![
                pulse.center_frequency_hz / 1e3,
                pulse.bandwidth_hz / 1e3,
                f64::from(amplitude_of(&limits, settings.source_level_db)),
                // The value is rounded to a nanosecond, which removes digits that come only from the conversion of units.
                (settings.pulse_duration_s * 1e9).round() / 1e3,
            ],
            "set_power" => vec![f64::from(u8::from(settings.pinging))],
            "set_sidescan_mode" => vec![f64::from(requested.sidescan_mode)],
            "set_snippet_rate" => vec![requested.snippet_rate_hz],
            "set_tp_rate" => vec![requested.water_column_rate_hz],
            "set_gain" => vec![settings.gain_db],
            "set_trigger_mode" => vec![match (self.settings.trigger(), self.stored(word)) {
                (TriggerSource::External, Some(stored)) => stored.first().copied().unwrap_or(4.0),
                (TriggerSource::External, None) => 4.0,
                (TriggerSource::Internal, stored) => stored
                    .and_then(|stored| stored.first().copied())
                    .filter(|&mode| mode < 4.0)
                    .unwrap_or(0.0),
            }],
            "serial" => vec![sonar.serial as f64],
            "set_opening_angle" => self.stored(word).unwrap_or_else(|| {
                vec![fan.map_or(0.0, |fan| fan.sector_rad.to_degrees().round())]
            }),
            "set_direction" => self.stored(word).unwrap_or_else(|| {
                vec![fan.map_or(0.0, |fan| fan.form.center_rad.to_degrees().round())]
            }),
            "sound_velocity" => self
                .stored(word)
                .filter(|stored| stored.first().is_some_and(|&c| c > 0.0))
                .unwrap_or_else(|| vec![self.device.sound_speed_m_per_s]),
            "set_mode" | "set_tx_beam_number" | "set_mf_decimation" => {
                self.stored(word).unwrap_or_else(|| vec![1.0])
            }
            "set_ntp_server" => Vec::new(),
            "set_resolution" => self.stored(word).unwrap_or_else(|| vec![0.0, 0.0]),
            _ if key_of(word).is_some() => self.stored(word).unwrap_or_else(|| vec![0.0]),
            _ => Vec::new(),
        };
        let comment = match (word, comment) {
            ("revision", "") => concat!("echotank ", env!("CARGO_PKG_VERSION")),
            ("partno", "") => "simulator",
            ("temperature", "") => "not modelled",
            ("bit_log" | "ntp_log", "") => "empty",
            (_, comment) => comment,
        };
        match key_of(word).and_then(|key| self.settings.stored(key)) {
            Some(StoredValue::Text(text)) => answer(&format!("{word} {text}"), &values, comment),
            _ => answer(word, &values, comment),
        }
    }

    fn stored(&self, word: &str) -> Option<Vec<f64>> {
        match self.settings.stored(key_of(word)?) {
            Some(StoredValue::Numbers(numbers)) => Some(numbers),
            _ => None,
        }
    }
}

/// Commands whose values, all or some, are only stored.
const KEPT: [&str; 18] = [
    "set_mode",
    "set_flip",
    "set_gate_mode",
    "set_gate_tilt",
    "set_direction",
    "set_opening_angle",
    "set_resolution",
    "set_tx",
    "set_trigger_mode",
    "sound_velocity",
    "set_autogate_preset",
    "set_vga",
    "set_tx_direction",
    "set_tx_opening_angle",
    "set_tx_beam_number",
    "set_mf_decimation",
    "set_time_source",
    "set_ntp_server",
];

fn key_of(word: &str) -> Option<StoredKey> {
    let name = KEPT.into_iter().find(|&known| known == word)?;
    Some(StoredKey {
        via: VIA,
        name,
        place: 0,
    })
}

fn text(line: String) -> Outgoing {
    Outgoing::Reply(Datagram {
        record_type: 0,
        bytes: line.into_bytes(),
    })
}

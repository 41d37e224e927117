//! Server interface of 7k: sessions, packets, and notices of setting changes by other protocols.

use std::net::SocketAddr;
use std::ops::Range;
use std::sync::Arc;

use echotank_protocols::sevenk::packet::{MAX_DATAGRAM_BYTES, PacketLimitError};
use echotank_protocols::sevenk::{Command, ControlRequest, Packetiser, Reassembler};

use super::RecordSet;
use super::records::DeviceSheet;
use super::session::{MAX_COMMAND_BYTES, Session as Inner, SessionContext};
use super::stored_settings::VIA;
use crate::session::{Framer, Outgoing, Protocol, Session, SessionCounts, Transport, Wants};
use echotank_core::records::Datagram;
use echotank_core::settings::{Changed, Requester, SettingChange, SettingsPort, TriggerSource};
use echotank_core::time::UtcNs;

/// 7k on one port, over TCP and UDP.
pub struct SevenKProtocol {
    sheet: Arc<DeviceSheet>,
    settings: Arc<dyn SettingsPort>,
    /// Maximum size of a TCP packet including the network frame, bytes.
    max_packet_bytes: u32,
    /// True for an address of the server itself.
    is_own: fn(SocketAddr) -> bool,
}

impl SevenKProtocol {
    /// Returns an error if `max_packet_bytes` is too small for a packet.
    pub fn new(
        sheet: Arc<DeviceSheet>,
        settings: Arc<dyn SettingsPort>,
        max_packet_bytes: u32,
    ) -> Result<Self, PacketLimitError> {
        Packetiser::new(max_packet_bytes)?;
        Ok(Self {
            sheet,
            settings,
            max_packet_bytes,
            is_own: |_| false,
        })
    }

    /// Refuses to send records to addresses for which `is_own` is true: those of the server itself.
    #[must_use]
    pub fn refusing(self, is_own: fn(SocketAddr) -> bool) -> Self {
        Self { is_own, ..self }
    }
}

impl From<RecordSet> for Wants {
    fn from(set: RecordSet) -> Self {
        Self(u64::from(set.bits()))
    }
}

impl From<Wants> for RecordSet {
    fn from(wants: Wants) -> Self {
        Self::from_bits(wants.0 as u32)
    }
}

impl Protocol for SevenKProtocol {
    fn name(&self) -> &'static str {
        VIA
    }

    fn connect(&self, transport: Transport, peer: SocketAddr) -> Box<dyn Session> {
        Box::new(Client {
            inner: match transport {
                Transport::Tcp => Inner::stream(),
                Transport::Udp => Inner::datagrams(),
            },
            sheet: Arc::clone(&self.sheet),
            settings: Arc::clone(&self.settings),
            is_own: self.is_own,
            by: Requester {
                via: VIA,
                peer: Some(peer),
            },
        })
    }

    fn framer(&self, transport: Transport) -> Box<dyn Framer> {
        let limit = match transport {
            Transport::Tcp => self.max_packet_bytes,
            Transport::Udp => self.max_packet_bytes.min(MAX_DATAGRAM_BYTES),
        };
        Box::new(Packets(Packetiser::new(limit).expect("checked by new")))
    }

    fn class(&self, record_type: u32) -> Wants {
        RecordSet::of(&[record_type]).into()
    }

    /// A first command that is split over several datagrams cannot start a session.
    fn recognises(&self, datagram: &[u8]) -> bool {
        matches!(
            Reassembler::new(MAX_COMMAND_BYTES).push_datagram(datagram),
            Ok(Some(_))
        )
    }

    fn version(&self) -> u64 {
        self.settings.version()
    }

    /// Returns the 7k command equivalent to each change, for clients that subscribe to echoes, and the current settings.
    fn notices(&self, version: u64, now: UtcNs) -> Vec<Datagram> {
        let stamp = self.sheet.stamp(now);
        let changes = self.settings.changes_since(version);
        let foreign = changes.iter().filter(|entry| entry.origin.by.via != VIA);
        let mut out: Vec<_> = foreign
            .filter_map(|entry| command_for(&entry.changed))
            .map(|command| {
                let request = ControlRequest {
                    ticket: 0,
                    tracking_number: [0; 2],
                    command,
                };
                let mut bytes = Vec::new();
                request.emit(&mut bytes, &stamp);
                Datagram {
                    record_type: 7500,
                    bytes,
                }
            })
            .collect();
        if !out.is_empty() {
            let port = self.settings.as_ref();
            out.push(self.sheet.current_settings_7503(port, now));
        }
        out
    }
}

/// The 7k command equivalent to a change; `None` if 7k has no such command.
fn command_for(changed: &Changed) -> Option<Command> {
    let Changed::Setting(change) = changed else {
        return None;
    };
    Some(match *change {
        SettingChange::RangeM(v) => Command::Range { range_m: v as f32 },
        SettingChange::MaxPingRateHz(v) => Command::MaxPingRate {
            pings_per_s: v as f32,
        },
        SettingChange::SourceLevelDb(v) => Command::Power { power_db: v as f32 },
        SettingChange::GainDb(v) => Command::Gain { gain_db: v as f32 },
        SettingChange::PulseDurationS(v) => Command::PulseLength {
            pulse_length_s: v as f32,
        },
        SettingChange::Start => Command::StartPinging,
        SettingChange::Stop => Command::StopPinging,
        SettingChange::PingTimes(1) => Command::SinglePing,
        SettingChange::PingTimes(count) => Command::PingTimes { count },
        SettingChange::Trigger(TriggerSource::External) => Command::ExternalTrigger,
        SettingChange::Trigger(TriggerSource::Internal) => return None,
    })
}

struct Packets(Packetiser);

impl Framer for Packets {
    fn frame(&mut self, record: &[u8], wire: &mut Vec<u8>, packets: &mut Vec<Range<usize>>) {
        packets.extend(self.0.packetise(record, wire));
    }
}

struct Client {
    inner: Inner,
    sheet: Arc<DeviceSheet>,
    settings: Arc<dyn SettingsPort>,
    is_own: fn(SocketAddr) -> bool,
    by: Requester,
}

impl Client {
    fn work(&mut self, now: UtcNs, step: impl FnOnce(&mut Inner, &SessionContext<'_>)) {
        let context = SessionContext {
            sheet: &self.sheet,
            settings: self.settings.as_ref(),
            now,
            is_own: self.is_own,
            by: self.by,
        };
        step(&mut self.inner, &context);
    }
}

impl Session for Client {
    fn receive(&mut self, bytes: &[u8], now: UtcNs, out: &mut Vec<Outgoing>) {
        self.work(now, |inner, context| inner.receive(bytes, context, out));
    }
    fn is_waiting(&self) -> bool {
        self.inner.is_waiting()
    }
    fn give_up_waiting(&mut self, now: UtcNs, out: &mut Vec<Outgoing>) {
        self.work(now, |inner, context| inner.give_up_waiting(context, out));
    }
    fn wants(&self) -> Wants {
        self.inner.subscribed().into()
    }
    fn take_requested(&mut self) -> Wants {
        self.inner.take_requested().into()
    }
    fn counts(&self) -> SessionCounts {
        self.inner.counts()
    }
}

//! NORBIT WBMS: one TCP server for control and three for data.

use std::sync::Arc;

use super::server_counts::ServersReport;
use super::{Output, OutputContext, OutputError, Report, Spread};
use crate::faults::link::RecordLayout;
use crate::io::sonar::SonarServer;
use echotank_config::spec::WbmsSpec;
use echotank_core::records::Datagram;
use echotank_core::settings::SettingsPort;
use echotank_emit::session::Protocol;
use echotank_emit::wbms::control::{ControlPort, DataPort};
use echotank_emit::wbms::{Device, SubscribedPackets, WbmsEmitter};
use echotank_ping::rig::PingSlot;

/// Names of the servers, in the order of their ports.
const SERVERS: [&str; 4] = ["control", "bathymetry", "water column", "side-scan"];

pub(super) struct Wbms {
    name: String,
    emitter: WbmsEmitter,
    /// In the order of [`SERVERS`].
    servers: Vec<Arc<SonarServer>>,
    pending: Vec<Arc<Datagram>>,
    spread: Spread,
    /// Seconds over which the pending ping is sent.
    over_s: f64,
}

impl Wbms {
    pub(super) fn open(output: &WbmsSpec, context: &OutputContext) -> Result<Self, OutputError> {
        let OutputContext {
            spec,
            unit,
            settings,
            ..
        } = context;
        let device = Arc::new(Device::new(&unit.spec, spec.medium.sound_speed_m_per_s));
        let settings: Arc<dyn SettingsPort> = Arc::clone(settings) as _;
        let protocols: [Arc<dyn Protocol>; 4] = [
            Arc::new(ControlPort::new(Arc::clone(&device), settings)),
            Arc::new(DataPort {
                name: "wbms bathymetry",
            }),
            Arc::new(DataPort {
                name: "wbms water column",
            }),
            Arc::new(DataPort {
                name: "wbms side-scan",
            }),
        ];
        let servers = (0..)
            .zip(protocols)
            .map(|(number, protocol)| {
                let listen = output.address(number);
                let (queue_bytes, clients) = (output.client_queue_bytes, output.max_clients);
                let server = context.serve(protocol, listen, false, queue_bytes, clients)?;
                Ok(Arc::new(server))
            })
            .collect::<Result<Vec<_>, OutputError>>()?;
        for server in servers.iter().skip(1) {
            context.configure(server, RecordLayout::WBMS);
        }
        Ok(Self {
            name: unit.spec.name.clone(),
            emitter: WbmsEmitter::new(device, spec.run.queue_pings),
            servers,
            pending: Vec::new(),
            spread: context.spread,
            over_s: 0.0,
        })
    }
}

impl Output for Wbms {
    fn addresses(&self) -> Vec<String> {
        SERVERS
            .iter()
            .zip(&self.servers)
            .map(|(what, server)| format!("wbms {} {what} tcp {}", self.name, server.local_addr()))
            .collect()
    }

    fn report(&self) -> Arc<dyn Report> {
        let servers = SERVERS.iter().zip(&self.servers);
        let servers = servers
            .map(|(what, server)| ("wbms", format!("{} {what}", self.name), Arc::clone(server)));
        Arc::new(ServersReport(servers.collect()))
    }

    fn encode(&mut self, slot: &PingSlot) {
        self.pending.clear();
        self.over_s = self.spread.over_s(&slot.plan);
        let [_, bathymetry, water_column, side_scan] = &self.servers[..] else {
            unreachable!("four servers are opened");
        };
        let wanted = SubscribedPackets {
            bathymetry: !bathymetry.wanted().is_empty(),
            water_column: !water_column.wanted().is_empty(),
            side_scan: !side_scan.wanted().is_empty(),
        };
        self.emitter
            .emit_ping(&slot.plan, &slot.output, wanted, &mut self.pending);
    }

    fn deliver(&mut self) -> Result<(), OutputError> {
        use echotank_protocols::wbms::packet_type;
        for packet in self.pending.drain(..) {
            let server = match packet.record_type {
                packet_type::BATHYMETRY => 1,
                packet_type::WATER_COLUMN => 2,
                _ => 3,
            };
            self.servers[server].deliver_over(&[packet], self.over_s);
        }
        Ok(())
    }
}

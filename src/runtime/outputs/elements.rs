//! Element samples without a device protocol: a TCP server and datagrams to fixed addresses.

use std::net::{Ipv4Addr, SocketAddr};
use std::ops::Range;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use super::server_counts::{server_lines, server_streams};
use super::{Output, OutputContext, OutputError, Report, Spread, StreamCounts};
use crate::faults::link::RecordLayout;
use crate::io::datagrams::{DatagramCounts, DatagramSender, Route, SendTimes};
use crate::io::sonar::SonarServer;
use echotank_config::spec::ElementStreamSpec;
use echotank_core::time::MonoNs;
use echotank_emit::element_stream::{ElementStreamEmitter, ElementsProtocol};
use echotank_emit::packets::Packets;
use echotank_ping::rig::PingSlot;

/// Maximum length of a TCP frame, bytes. The length limits the receive buffer of a client.
const TCP_FRAME_BYTES: usize = 256 * 1024;

pub(super) struct Elements {
    name: String,
    send_to: Vec<SocketAddr>,
    server: Arc<SonarServer>,
    spread: Spread,
    transports: Vec<Transport>,
    saturated: Arc<AtomicU64>,
}

/// TCP or UDP, each with its own frame length.
struct Transport {
    emitter: ElementStreamEmitter,
    sender: DatagramSender,
    is_tcp: bool,
    /// Packets of the encoded ping, and the seconds over which they are sent after the deadline.
    pending: Option<(Packets, f64)>,
}

impl Elements {
    pub(super) fn open(
        output: &ElementStreamSpec,
        context: &OutputContext,
    ) -> Result<Self, OutputError> {
        let (unit, spread) = (context.unit, context.spread);
        let name = unit.spec.name.clone();
        let queue = context.queue();
        let server = context.serve(
            Arc::new(ElementsProtocol),
            output.listen,
            false,
            output.client_queue_bytes,
            output.max_clients,
        )?;
        if spread.streaming.is_some() {
            // One below the priority of the delivery threads that feed the server.
            server.set_priority(context.sending.priority.saturating_sub(1));
        }
        let server = Arc::new(server);
        let (clock, sending) = (|| Arc::clone(context.clock), || context.sending.clone());
        let mut senders = vec![(
            DatagramSender::serve(Arc::clone(&server), queue, clock(), sending()),
            TCP_FRAME_BYTES,
            true,
        )];
        if !output.send_to.is_empty() {
            let route = Route {
                send_to: output.send_to.clone(),
                multicast_interface: Ipv4Addr::UNSPECIFIED,
                multicast_ttl: 1,
                pace_bytes_per_s: output.pace_bytes_per_s,
                queue,
            };
            let sender = DatagramSender::open(route, clock(), sending());
            senders.push((sender, output.max_packet, false));
        }
        let mut transports = Vec::new();
        for (sender, max_frame_bytes, is_tcp) in senders {
            let block_s = spread.block_s();
            let sender = sender.map_err(|source| OutputError::Sender {
                name: name.clone(),
                source,
            })?;
            sender.set_line(context.line(RecordLayout::ELEMENTS));
            transports.push(Transport {
                emitter: ElementStreamEmitter::new(output, &unit.spec, max_frame_bytes, block_s),
                sender,
                is_tcp,
                pending: None,
            });
        }
        Ok(Self {
            name,
            send_to: output.send_to.clone(),
            server,
            spread,
            transports,
            saturated: Arc::default(),
        })
    }

    fn emit(&mut self, slot: &PingSlot, samples: Range<usize>) {
        let no_clients = self.server.wanted().is_empty();
        for transport in &mut self.transports {
            if transport.is_tcp && no_clients {
                continue;
            }
            let mut packets = match transport.pending.take() {
                Some((packets, _)) => packets,
                None => transport.sender.buffer(),
            };
            let saturated = transport.emitter.emit_rows(
                &slot.plan,
                &slot.output,
                samples.clone(),
                &mut packets,
            );
            if samples.end == slot.plan.sample_count {
                self.saturated.fetch_add(saturated, Ordering::Relaxed);
            }
            transport.pending = Some((packets, self.spread.over_s(&slot.plan)));
        }
    }
}

impl Output for Elements {
    fn addresses(&self) -> Vec<String> {
        let tcp = format!("elements {} tcp {}", self.name, self.server.local_addr());
        let udp = self.send_to.iter();
        let udp = udp.map(|to| format!("elements {} udp {to}", self.name));
        std::iter::once(tcp).chain(udp).collect()
    }

    fn report(&self) -> Arc<dyn Report> {
        let counts = self.transports.iter();
        Arc::new(ElementsReport {
            name: self.name.clone(),
            server: Arc::clone(&self.server),
            counts: counts
                .map(|transport| (transport.is_tcp, Arc::clone(transport.sender.counts())))
                .collect(),
            saturated: Arc::clone(&self.saturated),
        })
    }

    fn encode(&mut self, slot: &PingSlot) {
        self.emit(slot, 0..slot.plan.sample_count);
    }

    fn deliver(&mut self) -> Result<(), OutputError> {
        for transport in &mut self.transports {
            if let Some((packets, over_s)) = transport.pending.take() {
                // The sender counts packets that find its queue full.
                transport.sender.send(packets, SendTimes::Over(over_s));
            }
        }
        Ok(())
    }

    fn is_stream(&self) -> bool {
        self.spread.streaming.is_some()
    }

    fn stream(&mut self, slot: &PingSlot, samples: Range<usize>, pulse: Option<MonoNs>) {
        self.emit(slot, samples);
        for transport in &mut self.transports {
            if let Some((packets, _)) = transport.pending.take() {
                transport
                    .sender
                    .send(packets, self.spread.send_times(pulse));
            }
        }
    }
}

struct ElementsReport {
    name: String,
    server: Arc<SonarServer>,
    counts: Vec<(bool, Arc<DatagramCounts>)>,
    saturated: Arc<AtomicU64>,
}

impl Report for ElementsReport {
    fn lines(&self) -> Vec<String> {
        let mut lines = server_lines("elements", &self.name, &self.server.report());
        let read = |count: &AtomicU64| count.load(Ordering::Relaxed);
        lines.extend(self.counts.iter().map(|(is_tcp, counts)| {
            let transport = if *is_tcp { "TCP" } else { "UDP" };
            format!(
                "  {transport}: {} frames, {} failed, {} pings dropped",
                counts.packets(),
                counts.failed(),
                read(&counts.dropped_pings),
            )
        }));
        let saturated = read(&self.saturated);
        lines.push(format!("  {saturated} values clipped at full scale"));
        lines
    }

    fn streams(&self) -> Vec<StreamCounts> {
        server_streams("elements", &self.server.report())
    }
}

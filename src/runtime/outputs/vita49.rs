//! VITA 49.2: element samples sent as datagrams to fixed addresses.

use std::ops::Range;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use super::{Output, OutputContext, OutputError, Report, Spread, StreamCounts};
use crate::faults::link::RecordLayout;
use crate::io::datagrams::{DatagramCounts, DatagramSender, Route, SendTimes};
use echotank_config::spec::Vita49Spec;
use echotank_core::time::MonoNs;
use echotank_emit::packets::Packets;
use echotank_emit::vita49::Vita49Emitter;
use echotank_ping::rig::PingSlot;

pub(super) struct Vita49 {
    name: String,
    send_to: Vec<std::net::SocketAddr>,
    emitter: Vita49Emitter,
    sender: DatagramSender,
    saturated: Arc<AtomicU64>,
    spread: Spread,
    /// Packets of the encoded ping, and the seconds over which they are sent after the deadline.
    pending: Option<(Packets, f64)>,
    /// Whether the previous ping was dropped.
    lost: bool,
}

impl Vita49 {
    pub(super) fn open(output: &Vita49Spec, context: &OutputContext) -> Result<Self, OutputError> {
        let unit = context.unit;
        let route = Route {
            send_to: output.send_to.clone(),
            multicast_interface: output.multicast_interface,
            multicast_ttl: output.multicast_ttl,
            pace_bytes_per_s: output.pace_bytes_per_s,
            queue: context.queue(),
        };
        let clock = Arc::clone(context.clock);
        let sender = DatagramSender::open(route, clock, context.sending.clone());
        let sender = sender.map_err(|source| OutputError::Sender {
            name: unit.spec.name.clone(),
            source,
        })?;
        sender.set_line(context.line(RecordLayout::VITA49));
        Ok(Self {
            name: unit.spec.name.clone(),
            send_to: output.send_to.clone(),
            emitter: Vita49Emitter::new(output, &unit.spec).in_blocks_of(context.spread.block_s()),
            sender,
            saturated: Arc::default(),
            spread: context.spread,
            pending: None,
            lost: false,
        })
    }
}

impl Vita49 {
    fn emit(&mut self, slot: &PingSlot, samples: Range<usize>) {
        let mut packets = match self.pending.take() {
            Some((packets, _)) => packets,
            None => self.sender.buffer(),
        };
        self.emitter
            .emit_rows(&slot.plan, &slot.output, samples, self.lost, &mut packets);
        self.saturated
            .store(self.emitter.totals().saturated, Ordering::Relaxed);
        self.pending = Some((packets, self.spread.over_s(&slot.plan)));
    }
}

impl Output for Vita49 {
    fn addresses(&self) -> Vec<String> {
        self.send_to
            .iter()
            .map(|to| format!("vita49 {} udp {to}", self.name))
            .collect()
    }

    fn report(&self) -> Arc<dyn Report> {
        Arc::new(Vita49Report {
            name: self.name.clone(),
            counts: Arc::clone(self.sender.counts()),
            saturated: Arc::clone(&self.saturated),
        })
    }

    fn encode(&mut self, slot: &PingSlot) {
        self.emit(slot, 0..slot.plan.sample_count);
    }

    fn deliver(&mut self) -> Result<(), OutputError> {
        if let Some((packets, over_s)) = self.pending.take() {
            self.lost = !self.sender.send(packets, SendTimes::Over(over_s));
        }
        Ok(())
    }

    fn is_stream(&self) -> bool {
        self.spread.streaming.is_some()
    }

    fn stream(&mut self, slot: &PingSlot, samples: Range<usize>, pulse: Option<MonoNs>) {
        self.emit(slot, samples);
        if let Some((packets, _)) = self.pending.take() {
            self.lost = !self.sender.send(packets, self.spread.send_times(pulse));
        }
    }
}

struct Vita49Report {
    name: String,
    counts: Arc<DatagramCounts>,
    saturated: Arc<AtomicU64>,
}

impl Report for Vita49Report {
    /// One line for the sonar and one per receiver.
    fn lines(&self) -> Vec<String> {
        let read = |count: &AtomicU64| count.load(Ordering::Relaxed);
        let mut lines = vec![format!(
            "vita49 {}: {} pings dropped, {} values clipped at full scale",
            self.name,
            read(&self.counts.dropped_pings),
            read(&self.saturated),
        )];
        lines.extend(self.counts.receivers.iter().map(|receiver| {
            format!(
                "  UDP {}: {:.1} MB, {} packets sent, {} failed",
                receiver.to,
                read(&receiver.bytes) as f64 / 1e6,
                read(&receiver.packets),
                read(&receiver.failed),
            )
        }));
        lines
    }

    fn streams(&self) -> Vec<StreamCounts> {
        let read = |count: &AtomicU64| count.load(Ordering::Relaxed);
        let receivers = self.counts.receivers.iter();
        let counts = receivers.map(|receiver| StreamCounts {
            family: "vita49",
            peer: format!("UDP {}", receiver.to),
            receives: String::new(),
            bytes_sent: read(&receiver.bytes),
            records_sent: read(&receiver.packets),
            records_dropped: read(&receiver.failed),
            queued_bytes: 0,
        });
        counts.collect()
    }
}

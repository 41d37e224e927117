//! Blue Robotics Ping protocol: one device over TCP, UDP and an optional serial port, with a `.svlog` recorder.

use std::sync::Arc;
use std::sync::atomic::Ordering;

use super::recording::Recording;
use super::server_counts::{server_lines, server_streams};
use super::{
    Output, OutputContext, OutputError, Report, Spread, StreamCounts, close, is_recorded, record,
};
use crate::faults::link::RecordLayout;
use crate::io::record::stream::StreamRecorder;
use crate::io::record::svlog;
use crate::io::serial_line::{LineCounts, SerialLine};
use crate::io::sonar::SonarServer;
use echotank_config::spec::PingProtocolSpec;
use echotank_core::records::Datagram;
use echotank_core::settings::SettingsPort;
use echotank_emit::ping_protocol::session::PingPort;
use echotank_emit::ping_protocol::{Device, PingEmitter};
use echotank_ping::rig::PingSlot;

pub(super) struct PingProtocol {
    name: String,
    spec: PingProtocolSpec,
    emitter: PingEmitter,
    server: Arc<SonarServer>,
    line: Option<SerialLine>,
    recorder: Option<Recording<StreamRecorder>>,
    /// Frames of the encoded ping, sent at its deadline.
    pending: Vec<Arc<Datagram>>,
    spread: Spread,
    /// Seconds over which the pending ping is sent.
    over_s: f64,
}

impl PingProtocol {
    pub(super) fn open(
        output: &PingProtocolSpec,
        context: &OutputContext,
    ) -> Result<Self, OutputError> {
        let OutputContext {
            spec,
            unit,
            settings,
            rig_time,
            ..
        } = context;
        let name = unit.spec.name.clone();
        let now = rig_time();
        let c = spec.medium.sound_speed_m_per_s;
        let device = Arc::new(Device::new(output, &unit.spec, c, now));
        let settings: Arc<dyn SettingsPort> = Arc::clone(settings) as _;
        let port = Arc::new(PingPort::new(Arc::clone(&device), settings));
        let server = context.serve(
            Arc::clone(&port) as _,
            output.listen,
            true,
            output.client_queue_bytes,
            output.max_clients,
        )?;
        context.configure(&server, RecordLayout::PING);
        let line = match &output.serial {
            None => None,
            Some((path, baud)) => {
                let connect = move || port.connect_line();
                let line = SerialLine::open(path, *baud, connect, Arc::clone(rig_time));
                let line = line.map_err(|source| OutputError::Line {
                    name: name.clone(),
                    path: path.clone(),
                    source,
                })?;
                line.set_line(context.line(RecordLayout::PING_SERIAL));
                Some(line)
            }
        };
        let url = format!("tcp://{}", server.local_addr());
        let kind = output.device;
        let recorder = context.recording(
            "svlog",
            move |path, utc| svlog::create(path, kind, &url, utc),
            |recorder, _| recorder.close(&[]),
        )?;
        Ok(Self {
            name,
            spec: output.clone(),
            emitter: PingEmitter::new(device, spec.run.queue_pings),
            server: Arc::new(server),
            line,
            recorder,
            pending: Vec::new(),
            spread: context.spread,
            over_s: 0.0,
        })
    }
}

impl Output for PingProtocol {
    fn addresses(&self) -> Vec<String> {
        let mut lines: Vec<String> = ["tcp", "udp"]
            .map(|transport| {
                let address = self.server.local_addr();
                format!("ping {} {transport} {address}", self.name)
            })
            .into();
        if let Some((path, baud)) = &self.spec.serial {
            lines.push(format!("ping {} serial {path} {baud}", self.name));
        }
        lines
    }

    fn report(&self) -> Arc<dyn Report> {
        Arc::new(PingReport {
            name: self.name.clone(),
            server: Arc::clone(&self.server),
            line: self.line.as_ref().map(|line| Arc::clone(line.counts())),
        })
    }

    fn encode(&mut self, slot: &PingSlot) {
        self.pending.clear();
        self.over_s = self.spread.over_s(&slot.plan);
        let is_recorded = is_recorded(&mut self.recorder);
        let no_clients = self.server.wanted().is_empty();
        if no_clients && self.line.is_none() && !is_recorded {
            return;
        }
        self.emitter
            .emit_ping(&slot.plan, &slot.output, &mut self.pending);
    }

    fn deliver(&mut self) -> Result<(), OutputError> {
        self.server.deliver_over(&self.pending, self.over_s);
        if let Some(line) = &self.line {
            line.deliver(&self.pending);
        }
        let mut pending = self.pending.drain(..);
        record(&mut self.recorder, |recorder| {
            pending.try_for_each(|frame| recorder.write(&frame.bytes))
        })
    }

    fn close(self: Box<Self>) -> Result<(), OutputError> {
        close(self.recorder)
    }
}

struct PingReport {
    name: String,
    server: Arc<SonarServer>,
    line: Option<Arc<LineCounts>>,
}

impl Report for PingReport {
    fn lines(&self) -> Vec<String> {
        let mut lines = server_lines("ping", &self.name, &self.server.report());
        lines.extend(self.line.as_ref().map(|line| {
            format!(
                "  serial: {:.1} MB sent, {} records dropped, {} commands, {} refused, {} failures",
                line.bytes_sent.load(Ordering::Relaxed) as f64 / 1e6,
                line.records_dropped.load(Ordering::Relaxed),
                line.commands.load(Ordering::Relaxed),
                line.nacks.load(Ordering::Relaxed),
                line.failures.load(Ordering::Relaxed),
            )
        }));
        lines
    }

    fn streams(&self) -> Vec<StreamCounts> {
        server_streams("ping", &self.server.report())
    }
}

//! Imagenex 872: a TCP server that answers switch commands with echo data.

use std::sync::Arc;

use super::server_counts::{server_lines, server_streams};
use super::{Output, OutputContext, OutputError, Report, StreamCounts};
use crate::faults::link::RecordLayout;
use crate::io::sonar::{ServerSpec, ServerTimes, SonarServer, WhenFull};
use echotank_config::spec::ImagenexSpec;
use echotank_core::records::Datagram;
use echotank_emit::imagenex872::{Head, ImagenexProtocol, emit_ping};
use echotank_ping::rig::PingSlot;

pub(super) struct Imagenex872 {
    name: String,
    head: Arc<Head>,
    /// Sample rate, Hz, and full scale, V.
    scale: (f64, f64),
    server: Arc<SonarServer>,
    /// Answers of the encoded ping, sent at its deadline.
    pending: Vec<Arc<Datagram>>,
}

impl Imagenex872 {
    pub(super) fn open(
        output: &ImagenexSpec,
        context: &OutputContext,
    ) -> Result<Self, OutputError> {
        let head = Arc::new(Head::default());
        let listener = ServerSpec {
            listen: output.listen,
            tcp: true,
            udp: false,
            client_queue_bytes: output.client_queue_bytes,
            when_full: WhenFull::Skip,
            max_clients: output.max_clients,
        };
        let protocol = ImagenexProtocol {
            settings: Arc::clone(context.settings) as _,
            head: Arc::clone(&head),
        };
        let sonar = &context.unit.spec;
        let server = SonarServer::start(
            &listener,
            Arc::new(protocol),
            Arc::clone(context.rig_time),
            ServerTimes::default(),
        )
        .map_err(|source| OutputError::Server {
            name: sonar.name.clone(),
            source,
        })?;
        server.set_link(context.line(RecordLayout::IMAGENEX872));
        Ok(Self {
            name: sonar.name.clone(),
            head,
            scale: (sonar.receiver.sample_rate_hz, sonar.receiver.full_scale_v),
            server: Arc::new(server),
            pending: Vec::new(),
        })
    }
}

impl Output for Imagenex872 {
    fn addresses(&self) -> Vec<String> {
        vec![format!(
            "imagenex872 {} tcp {}",
            self.name,
            self.server.local_addr()
        )]
    }

    fn report(&self) -> Arc<dyn Report> {
        Arc::new(ImagenexReport {
            name: self.name.clone(),
            server: Arc::clone(&self.server),
        })
    }

    fn encode(&mut self, slot: &PingSlot) {
        self.pending.clear();
        let wanted = self.server.wanted();
        emit_ping(
            &self.head,
            &slot.plan,
            &slot.output,
            self.scale,
            wanted,
            &mut self.pending,
        );
    }

    fn deliver(&mut self) -> Result<(), OutputError> {
        self.server.deliver(&self.pending);
        self.pending.clear();
        Ok(())
    }

    fn close(self: Box<Self>) -> Result<(), OutputError> {
        Ok(())
    }
}

struct ImagenexReport {
    name: String,
    server: Arc<SonarServer>,
}

impl Report for ImagenexReport {
    fn lines(&self) -> Vec<String> {
        server_lines("imagenex872", &self.name, &self.server.report())
    }

    fn streams(&self) -> Vec<StreamCounts> {
        server_streams("imagenex872", &self.server.report())
    }
}

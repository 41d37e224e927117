//! Imagenex 872: a TCP server that answers switch commands with echo data.

use std::sync::Arc;

use super::server_counts::ServersReport;
use super::{Output, OutputContext, OutputError, Report};
use crate::faults::link::RecordLayout;
use crate::io::sonar::SonarServer;
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
        let protocol = ImagenexProtocol {
            settings: Arc::clone(context.settings) as _,
            head: Arc::clone(&head),
        };
        let sonar = &context.unit.spec;
        let server = context.serve(
            Arc::new(protocol),
            output.listen,
            false,
            output.client_queue_bytes,
            output.max_clients,
        )?;
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
        let server = Arc::clone(&self.server);
        Arc::new(ServersReport(vec![(
            "imagenex872",
            self.name.clone(),
            server,
        )]))
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
}

//! EdgeTech JSF: a command server, a data server and a `.jsf` recorder.

use std::sync::Arc;

use super::recording::Recording;
use super::server_counts::ServersReport;
use super::{Output, OutputContext, OutputError, Report, Spread, close, is_recorded, record};
use crate::faults::link::RecordLayout;
use crate::io::record::stream::StreamRecorder;
use crate::io::sonar::SonarServer;
use crate::settings::SettingsStore;
use echotank_config::spec::{JsfSpec, MediumSpec, SonarSpec};
use echotank_core::records::Datagram;
use echotank_emit::jsf::session::{JsfCommands, JsfData, is_active};
use echotank_emit::jsf::{JsfEmitter, JsfSheet, RowFilter, file_time};
use echotank_imaging::beam::RowLimits;
use echotank_imaging::beam::matched::MatchedFilter;
use echotank_ping as ping;
use echotank_ping::rig::PingSlot;

pub(super) struct Jsf {
    name: String,
    emitter: JsfEmitter,
    commands: Arc<SonarServer>,
    data: Arc<SonarServer>,
    settings: Arc<SettingsStore>,
    recorder: Option<Recording<StreamRecorder>>,
    /// Messages of the encoded ping, sent at its deadline.
    pending: Vec<Arc<Datagram>>,
    spread: Spread,
    /// Seconds over which the pending ping is sent.
    over_s: f64,
}

/// Matched filter for the samples of JSF data formats 0 and 1.
pub(crate) fn row_filter(sonar: &SonarSpec, medium: &MediumSpec) -> RowFilter {
    let limits = RowLimits {
        sample_rate_hz: sonar.receiver.sample_rate_hz,
        samples: ping::max_samples(sonar, medium.sound_speed_m_per_s),
        pulse_s: sonar.limits.pulse_duration_s.1,
    };
    let mut filter = MatchedFilter::new(&sonar.pulse, limits, sonar.beams.weighting);
    Box::new(move |plan, row| {
        filter.set_pulse(&plan.pulse);
        filter.apply(row);
    })
}

impl Jsf {
    pub(super) fn open(output: &JsfSpec, context: &OutputContext) -> Result<Self, OutputError> {
        let OutputContext {
            spec,
            unit,
            settings,
            ..
        } = context;
        let sheet = Arc::new(JsfSheet {
            output: output.clone(),
            sonar: unit.spec.clone(),
        });
        let serve = |protocol, listen| {
            let (queue_bytes, clients) = (output.client_queue_bytes, output.max_clients);
            context.serve(protocol, listen, false, queue_bytes, clients)
        };
        let commands = JsfCommands {
            sheet: Arc::clone(&sheet),
            settings: Arc::clone(settings) as _,
        };
        let commands = serve(Arc::new(commands), output.listen)?;
        let data = JsfData {
            sheet: Arc::clone(&sheet),
        };
        let data = serve(Arc::new(data), output.listen_data)?;
        context.configure(&data, RecordLayout::JSF);
        let recorder = match output.record {
            true => {
                let sheet = Arc::clone(&sheet);
                context.recording(
                    "jsf",
                    move |path, utc| StreamRecorder::create(path, &sheet.file_head(utc)),
                    |recorder, utc| recorder.close(&file_time(utc)),
                )?
            }
            false => None,
        };
        Ok(Self {
            name: unit.spec.name.clone(),
            emitter: JsfEmitter::new(sheet, row_filter(&unit.spec, &spec.medium)),
            commands: Arc::new(commands),
            data: Arc::new(data),
            settings: Arc::clone(settings),
            recorder,
            pending: Vec::new(),
            spread: context.spread,
            over_s: 0.0,
        })
    }
}

impl Output for Jsf {
    fn addresses(&self) -> Vec<String> {
        vec![
            format!("jsf {} tcp {}", self.name, self.commands.local_addr()),
            format!("jsf-data {} tcp {}", self.name, self.data.local_addr()),
        ]
    }

    fn report(&self) -> Arc<dyn Report> {
        Arc::new(ServersReport(vec![
            ("jsf", self.name.clone(), Arc::clone(&self.commands)),
            ("jsf-data", self.name.clone(), Arc::clone(&self.data)),
        ]))
    }

    fn encode(&mut self, slot: &PingSlot) {
        self.pending.clear();
        self.over_s = self.spread.over_s(&slot.plan);
        let is_recorded = is_recorded(&mut self.recorder);
        if self.data.wanted().is_empty() && !is_recorded {
            return;
        }
        let settings = Arc::clone(&self.settings);
        let active = |subsystem, channel| is_active(settings.as_ref(), subsystem, channel);
        self.emitter
            .emit_ping(&slot.plan, &slot.output, active, &mut self.pending);
    }

    fn deliver(&mut self) -> Result<(), OutputError> {
        self.data.deliver_over(&self.pending, self.over_s);
        let mut pending = self.pending.drain(..);
        record(&mut self.recorder, |recorder| {
            pending.try_for_each(|message| recorder.write(&message.bytes))
        })
    }

    fn close(self: Box<Self>) -> Result<(), OutputError> {
        close(self.recorder)
    }
}

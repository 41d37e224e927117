//! Records of a ping for every output of a sonar, for one client that subscribes to all records.

use std::sync::Arc;

use echotank_config::spec::{OutputSpec, RigSpec, SonarSpec};
use echotank_core::records::Datagram;
use echotank_core::time::UtcNs;
use echotank_emit::jsf::{JsfEmitter, JsfSheet};
use echotank_emit::packets::Packets;
use echotank_emit::ping_protocol::{Device as PingDevice, PingEmitter};
use echotank_emit::sevenk::records::DeviceSheet;
use echotank_emit::sevenk::{RecordSet, SevenKEmitter};
use echotank_emit::vita49::Vita49Emitter;
use echotank_emit::wbms::{Device as WbmsDevice, SubscribedPackets, WbmsEmitter};
use echotank_ping::rig::PingSlot;

enum Encoder {
    SevenK(Box<SevenKEmitter>),
    Jsf(JsfEmitter),
    Ping(PingEmitter),
    Vita49(Box<(Vita49Emitter, Packets)>),
    Wbms(WbmsEmitter),
}

/// Encoders of one sonar.
pub(super) struct Encoders {
    of: Vec<Encoder>,
    records: Vec<Arc<Datagram>>,
}

impl Encoders {
    /// Encoders of the outputs of a sonar. Outputs without a client (files) are excluded.
    pub(super) fn new(rig: &RigSpec, sonar: &SonarSpec, absorption_db_per_m: f64) -> Self {
        let c = rig.medium.sound_speed_m_per_s;
        let encoder = |output: &OutputSpec| match output {
            OutputSpec::SevenK(spec) => {
                let sheet = DeviceSheet::new(spec, sonar, c, absorption_db_per_m);
                let emitter = SevenKEmitter::new(Arc::new(sheet), 1);
                Some(Encoder::SevenK(Box::new(emitter)))
            }
            OutputSpec::Jsf(spec) => {
                let sheet = JsfSheet {
                    output: spec.clone(),
                    sonar: sonar.clone(),
                };
                // Envelopes come from lines, which are already matched filtered.
                let filter = Box::new(|_: &_, _: &mut _| {});
                Some(Encoder::Jsf(JsfEmitter::new(Arc::new(sheet), filter)))
            }
            OutputSpec::Ping(spec) => {
                let device = PingDevice::new(spec, sonar, c, UtcNs(0));
                Some(Encoder::Ping(PingEmitter::new(Arc::new(device), 1)))
            }
            OutputSpec::Vita49(spec) => {
                let emitter = Vita49Emitter::new(spec, sonar);
                Some(Encoder::Vita49(Box::new((emitter, Packets::default()))))
            }
            OutputSpec::Wbms(_) => {
                let device = WbmsDevice::new(sonar, c);
                Some(Encoder::Wbms(WbmsEmitter::new(Arc::new(device), 1)))
            }
            OutputSpec::Xtf(_)
            | OutputSpec::Imagenex872(_)
            | OutputSpec::Elements(_)
            | OutputSpec::Sigmf(_)
            | OutputSpec::Mcap(_)
            | OutputSpec::Wav(_) => None,
        };
        Self {
            of: sonar.outputs.iter().filter_map(encoder).collect(),
            records: Vec::new(),
        }
    }

    /// Encodes a ping. Returns the number of bytes.
    pub(super) fn encode(&mut self, slot: &PingSlot) -> usize {
        let PingSlot { plan, output } = slot;
        self.records.clear();
        let into = &mut self.records;
        let mut packet_bytes = 0;
        for encoder in &mut self.of {
            match encoder {
                Encoder::SevenK(emitter) => {
                    emitter.emit_ping(plan, output, RecordSet::ALL, into);
                }
                Encoder::Jsf(emitter) => {
                    emitter.emit_ping(plan, output, |_, _| true, into);
                }
                Encoder::Ping(emitter) => emitter.emit_ping(plan, output, into),
                Encoder::Vita49(of) => {
                    let (emitter, packets) = &mut **of;
                    emitter.emit_ping(plan, output, false, packets);
                    packet_bytes += packets.len_bytes();
                }
                Encoder::Wbms(emitter) => {
                    let wanted = SubscribedPackets {
                        bathymetry: true,
                        water_column: true,
                        side_scan: true,
                    };
                    emitter.emit_ping(plan, output, wanted, into);
                }
            }
        }
        packet_bytes + self.records.iter().map(|r| r.bytes.len()).sum::<usize>()
    }
}

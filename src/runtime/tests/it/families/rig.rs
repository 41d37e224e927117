//! JSF, XTF and Imagenex outputs of the small sonar, and messages of their clients.

use std::sync::Arc;

use echotank_config::spec::{JsfChannels, JsfFormat, JsfSpec, SonarSpec, XtfSpec};
use echotank_core::ping::{PingOutput, PingPlan};
use echotank_core::records::Datagram;
use echotank_core::time::UtcNs;
use echotank_emit::imagenex872::{Head, ImagenexProtocol};
use echotank_emit::jsf::session::JsfCommands;
use echotank_emit::jsf::{JsfEmitter, JsfSheet};
use echotank_emit::session::{Outgoing, Protocol, Session, Transport};
use echotank_emit::xtf::XtfEmitter;
use echotank_protocols::jsf::{Control, Message, Value, command_type};
use echotank_runtime::settings::SettingsStore;

use echotank_testing::wire::*;

pub(crate) fn jsf_spec(channels: JsfChannels, format: JsfFormat) -> JsfSpec {
    JsfSpec {
        listen: "127.0.0.1:0".parse().expect("an address"),
        listen_data: "127.0.0.1:0".parse().expect("an address"),
        subsystem: 20,
        silent_subsystems: vec![21],
        channels,
        arrays: vec![0, 1],
        format,
        record: false,
        client_queue_bytes: 1 << 20,
        max_clients: 4,
    }
}

pub(crate) fn jsf_sheet(channels: JsfChannels, format: JsfFormat) -> Arc<JsfSheet> {
    Arc::new(JsfSheet {
        output: jsf_spec(channels, format),
        sonar: sonar(),
    })
}

/// Messages of a ping. The matched filter doubles the samples, so that its use is visible.
pub(crate) fn jsf_ping(
    channels: JsfChannels,
    format: JsfFormat,
    plan: &PingPlan,
    output: &PingOutput,
) -> Vec<Arc<Datagram>> {
    let filter = Box::new(|_: &PingPlan, row: &mut [num_complex::Complex64]| {
        row.iter_mut().for_each(|v| *v *= 2.0);
    });
    let mut emitter = JsfEmitter::new(jsf_sheet(channels, format), filter);
    let mut messages = Vec::new();
    assert_eq!(
        emitter.emit_ping(plan, output, |_, _| true, &mut messages),
        0
    );
    messages
}

pub(crate) fn jsf_message(datagram: &Datagram) -> Message<'_> {
    let message = Message::parse(&datagram.bytes).expect("a whole message");
    assert_eq!(message.size_bytes(), datagram.bytes.len());
    message
}

pub(crate) fn xtf_emitter(sonar: &SonarSpec) -> XtfEmitter {
    XtfEmitter::new(&XtfSpec { is_float: false }, sonar, SOUND_M_PER_S)
}

/// Command connection of one JSF client.
pub(crate) struct JsfClient {
    pub(crate) store: Arc<SettingsStore>,
    pub(crate) session: Box<dyn Session>,
    pub(crate) now: UtcNs,
}

impl JsfClient {
    pub(crate) fn new() -> Self {
        Self::over(store())
    }

    pub(crate) fn over(store: Arc<SettingsStore>) -> Self {
        let protocol = JsfCommands {
            sheet: jsf_sheet(JsfChannels::Sides, JsfFormat::Envelope),
            settings: store.clone(),
        };
        let peer = "127.0.0.1:4711".parse().expect("an address");
        Self {
            store,
            session: protocol.connect(Transport::Tcp, peer),
            now: TRANSMIT_UTC,
        }
    }

    /// Sends bytes to the session. Returns the replies in order.
    pub(crate) fn send(&mut self, bytes: &[u8]) -> Vec<Control> {
        let mut out = Vec::new();
        self.session.receive(bytes, self.now, &mut out);
        answers(&out)
    }

    pub(crate) fn command(&mut self, control: &Control) -> Vec<Control> {
        let mut bytes = Vec::new();
        control.emit(&mut bytes);
        self.send(&bytes)
    }

    /// Sends a SET command. `None` if the command is accepted without a reply.
    pub(crate) fn set(&mut self, message_type: u16, channel: u8, value: Value) -> Option<Value> {
        let control = control(command_type::SET, message_type, 20, channel, value);
        let mut answers = self.command(&control);
        assert!(answers.len() <= 1);
        answers.pop().map(|answer| {
            assert_eq!(answer.sequence, control.sequence);
            answer.value
        })
    }

    pub(crate) fn get(&mut self, message_type: u16, channel: u8) -> Value {
        let control = control(command_type::GET, message_type, 20, channel, Value::None);
        let answers = self.command(&control);
        let [answer] = &answers[..] else {
            panic!("{answers:?}")
        };
        assert_eq!(
            (answer.message_type, answer.subsystem, answer.channel),
            (message_type, 20, channel)
        );
        assert_eq!(answer.sequence, control.sequence);
        answer.value.clone()
    }
}

pub(crate) fn control(
    command_type: u8,
    message_type: u16,
    subsystem: u8,
    channel: u8,
    value: Value,
) -> Control {
    Control {
        message_type,
        command_type,
        subsystem,
        channel,
        session: 3,
        sequence: 77,
        value,
    }
}

pub(crate) fn answers(out: &[Outgoing]) -> Vec<Control> {
    out.iter()
        .map(|item| {
            let Outgoing::Reply(datagram) = item else {
                panic!("{item:?}")
            };
            Control::parse(&jsf_message(datagram)).expect("an answer")
        })
        .collect()
}

/// A head with the given settings, and one client.
pub(crate) fn imagenex(store: &Arc<SettingsStore>) -> (Arc<Head>, Box<dyn Session>) {
    let head = Arc::new(Head::default());
    let protocol = ImagenexProtocol {
        settings: store.clone(),
        head: head.clone(),
    };
    let peer = "127.0.0.1:4711".parse().expect("an address");
    (head, protocol.connect(Transport::Tcp, peer))
}

//! The newer parts of the navigation's configuration: towing, and what is sent out.

use std::net::SocketAddr;

use super::{Listener, address, all, needed_with, only_with, unique_names};
use crate::raw::{Problems, RawTable};
use crate::spec::{
    NavOutputSpec, NavSentence, NavTargetSpec, ParitySpec, PulseSpec, SerialLine, TowSpec,
};

pub(super) fn tow(table: &RawTable) -> Option<TowSpec> {
    Some(TowSpec {
        point_m: table.vector("point_m")?,
        cable_out_m: table.number("cable_out_m")?,
        cable_scope: table.number("cable_scope")?,
    })
}

pub(super) fn outputs<'t>(
    tables: &'t [RawTable],
    listeners: &mut Vec<Listener<'t>>,
    problems: &mut Problems,
) -> Option<Vec<NavOutputSpec>> {
    unique_names(tables, problems);
    let outputs: Vec<_> = tables
        .iter()
        .map(|t| output(t, listeners, problems))
        .collect();
    all(outputs)
}

fn output<'t>(
    table: &'t RawTable,
    listeners: &mut Vec<Listener<'t>>,
    problems: &mut Problems,
) -> Option<NavOutputSpec> {
    let kind = table.text("kind");
    let is = |wanted: &str| kind.map(|k| k == wanted);
    only_with(table, &["to"], is("udp"), "kind = \"udp\"", problems);
    needed_with(table, "to", is("udp"), "kind = \"udp\"", problems);
    only_with(table, &["listen"], is("tcp"), "kind = \"tcp\"", problems);
    needed_with(table, "listen", is("tcp"), "kind = \"tcp\"", problems);
    let serial = "kind = \"serial\"";
    only_with(
        table,
        &["port", "baud", "line"],
        is("serial"),
        serial,
        problems,
    );
    needed_with(table, "port", is("serial"), serial, problems);
    needed_with(table, "baud", is("serial"), serial, problems);

    let talker = table.text("talker");
    let two_capitals = |t: &&str| t.len() == 2 && t.bytes().all(|b| b.is_ascii_uppercase());
    if talker.is_some() && talker.filter(two_capitals).is_none() {
        problems.refuse(table.entry("talker"), "must be two capital letters");
    }
    let pulse = match table.text("pulse") {
        Some("rts") => PulseSpec::Rts,
        Some("dtr") => PulseSpec::Dtr,
        Some("byte") => PulseSpec::Byte,
        _ => PulseSpec::None,
    };
    if matches!(pulse, PulseSpec::Rts | PulseSpec::Dtr) && is("serial") == Some(false) {
        let rule =
            "needs kind = \"serial\": elsewhere there is no such line, \"byte\" stands for it";
        problems.refuse(table.entry("pulse"), rule);
    }
    let rate_hz = table.number("rate_hz")?;
    let per_s = if rate_hz < 1.0 {
        1.0 / rate_hz
    } else {
        rate_hz
    };
    if (per_s - per_s.round()).abs() > 1e-9 {
        let rule = "must be a whole number, or one over a whole number, so that ticks fall on whole seconds";
        problems.refuse(table.entry("rate_hz"), rule);
    }
    let target = target(table, listeners, problems);
    Some(NavOutputSpec {
        name: table.text("name")?.to_owned(),
        target: target?,
        sentences: table
            .texts("sentences")?
            .iter()
            .map(|s| match s.as_str() {
                "ZDA" => NavSentence::Zda,
                "GGA" => NavSentence::Gga,
                _ => NavSentence::Hdt,
            })
            .collect(),
        talker: talker.filter(two_capitals)?.to_owned(),
        rate_hz,
        latency_s: table.scaled("latency_ms", -3)?,
        pulse,
    })
}

fn target<'t>(
    table: &'t RawTable,
    listeners: &mut Vec<Listener<'t>>,
    problems: &mut Problems,
) -> Option<NavTargetSpec> {
    match table.text("kind")? {
        "udp" => {
            table.text("to")?;
            let to: SocketAddr = address(table, "to", problems)?;
            Some(NavTargetSpec::Udp { to })
        }
        "tcp" => {
            table.text("listen")?;
            let listen = address(table, "listen", problems)?;
            listeners.push(Listener {
                entry: table.entry("listen"),
                protocol: "TCP",
                address: listen,
                multicast: false,
            });
            Some(NavTargetSpec::TcpListen { listen })
        }
        _ => Some(NavTargetSpec::Serial {
            port: table.text("port")?.to_owned(),
            baud: u32::try_from(table.integer("baud")?).ok()?,
            line: serial_line(table)?,
        }),
    }
}

/// `8N1` and its kin.
pub(super) fn serial_line(table: &RawTable) -> Option<SerialLine> {
    let text = table.text("line")?.as_bytes();
    let digit = |at: usize| text.get(at).map(|b| b.wrapping_sub(b'0'));
    Some(SerialLine {
        parity: match text.get(1) {
            Some(b'E') => ParitySpec::Even,
            Some(b'O') => ParitySpec::Odd,
            _ => ParitySpec::None,
        },
        data_bits: digit(0)?,
        stop_bits: digit(2)?,
    })
}

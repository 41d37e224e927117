//! Checks towing and navigation outputs.

use super::{Listener, address, all, listen, unique_names};
use crate::keys;
use crate::raw::{Field, Problems};
use crate::spec::{NavOutputSpec, NavTargetSpec, ParitySpec, SerialLine, TowSpec};

pub(super) fn tow(table: &keys::NavTow) -> Option<TowSpec> {
    Some(TowSpec {
        point_m: table.point_m.get()?,
        cable_out_m: table.cable_out_m.get()?,
        cable_scope: table.cable_scope.get()?,
    })
}

pub(super) fn outputs<'t>(
    tables: &'t [keys::NavOutput],
    listeners: &mut Vec<Listener<'t>>,
    problems: &mut Problems,
) -> Option<Vec<NavOutputSpec>> {
    unique_names(tables.iter().map(|t| &t.name), problems);
    let outputs: Vec<_> = tables
        .iter()
        .map(|t| output(t, listeners, problems))
        .collect();
    all(outputs)
}

fn output<'t>(
    table: &'t keys::NavOutput,
    listeners: &mut Vec<Listener<'t>>,
    problems: &mut Problems,
) -> Option<NavOutputSpec> {
    let talker = table.talker.text();
    let two_capitals = |t: &&str| t.len() == 2 && t.bytes().all(|b| b.is_ascii_uppercase());
    if talker.is_some() && talker.filter(two_capitals).is_none() {
        problems.refuse(&table.talker, "must be two capital letters");
    }
    let on_line = matches!(table.pulse.text(), Some("rts" | "dtr"));
    if on_line && table.kind.is("serial") == Some(false) {
        let rule =
            "needs kind = \"serial\": only a serial port has that line; use \"byte\" elsewhere";
        problems.refuse(&table.pulse, rule);
    }
    let rate_hz = table.rate_hz.get()?;
    let per_s = if rate_hz < 1.0 {
        1.0 / rate_hz
    } else {
        rate_hz
    };
    if (per_s - per_s.round()).abs() > 1e-9 {
        let rule = "must be a whole number, or one over a whole number, so that ticks fall on whole seconds";
        problems.refuse(&table.rate_hz, rule);
    }
    let target = target(table, listeners, problems);
    Some(NavOutputSpec {
        name: table.name.text()?.to_owned(),
        target: target?,
        sentences: table.sentences.all_named()?,
        talker: talker.filter(two_capitals)?.to_owned(),
        rate_hz,
        latency_s: table.latency_ms.get()?,
        pulse: table.pulse.named()?,
    })
}

fn target<'t>(
    table: &'t keys::NavOutput,
    listeners: &mut Vec<Listener<'t>>,
    problems: &mut Problems,
) -> Option<NavTargetSpec> {
    match table.kind.text()? {
        "udp" => Some(NavTargetSpec::Udp {
            to: address(&table.to, problems)?,
        }),
        "tcp" => Some(NavTargetSpec::TcpListen {
            listen: listen(&table.listen, "TCP", listeners, problems)?,
        }),
        _ => Some(NavTargetSpec::Serial {
            port: table.port.text()?.to_owned(),
            baud: table.baud.to()?,
            line: serial_line(&table.line)?,
        }),
    }
}

/// Parses a serial frame format such as `8N1`.
pub(super) fn serial_line(line: &Field<String>) -> Option<SerialLine> {
    let text = line.text()?.as_bytes();
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

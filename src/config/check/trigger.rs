//! `[sonar.trigger]` and `[sonar.trigger_out]`.

use super::super::raw::{Problems, RawTable};
use super::super::spec::*;
use super::{Listener, address, index_of, needed_with, only_with};

/// `sonar` is the one whose table this is, `names` are those of all.
pub(super) fn trigger<'t>(
    table: &'t RawTable,
    sonar: usize,
    names: &[Option<&str>],
    listeners: &mut Vec<Listener<'t>>,
    problems: &mut Problems,
) -> Option<TriggerSpec> {
    let source = table.text("source");
    let is = |wanted: &[&str]| source.map(|s| wanted.contains(&s));
    for (keys, needed, sources) in [
        (&["listen"][..], "listen", &["udp", "tcp"][..]),
        (&["port", "edge"], "port", &["serial-cts", "serial-dcd"]),
        (&["follow", "delay_ms"], "follow", &["sonar"]),
    ] {
        let quoted: Vec<_> = sources.iter().map(|s| format!("\"{s}\"")).collect();
        let condition = format!("source = {}", quoted.join(" or "));
        only_with(table, keys, is(sources), &condition, problems);
        needed_with(table, needed, is(sources), &condition, problems);
    }
    let triggered = source.map(|s| s != "internal");
    let condition = "a source other than \"internal\"";
    let keys = ["early", "min_interval_ms", "watchdog_ms"];
    only_with(table, &keys, triggered, condition, problems);
    let from = match source? {
        "udp" => TriggerFrom::Udp {
            listen: listener(table, "UDP", listeners, problems)?,
        },
        "tcp" => TriggerFrom::Tcp {
            listen: listener(table, "TCP", listeners, problems)?,
        },
        "serial-cts" => modem_line(table, ModemLine::ClearToSend)?,
        "serial-dcd" => modem_line(table, ModemLine::CarrierDetect)?,
        "protocol" => TriggerFrom::Protocol,
        "sonar" => {
            let entry = table.entry("follow");
            let whom = index_of(table.text("follow")?, entry, names, "sonar", problems)?;
            if whom == sonar {
                problems.refuse(entry, "must be another sonar");
                return None;
            }
            TriggerFrom::Sonar {
                sonar: whom,
                delay_s: table.scaled("delay_ms", -3)?,
            }
        }
        _ => TriggerFrom::Internal,
    };
    Some(TriggerSpec {
        from,
        early: match table.text("early")? {
            "queue" => EarlyTrigger::Queue,
            _ => EarlyTrigger::Refuse,
        },
        min_interval_s: table.scaled("min_interval_ms", -3)?,
        watchdog_s: match table.given("watchdog_ms") {
            true => Some(table.scaled("watchdog_ms", -3)?),
            false => None,
        },
    })
}

fn listener<'t>(
    table: &'t RawTable,
    protocol: &'static str,
    listeners: &mut Vec<Listener<'t>>,
    problems: &mut Problems,
) -> Option<std::net::SocketAddr> {
    if !table.given("listen") {
        return None; // missed by name already
    }
    let listen = address(table, "listen", problems)?;
    listeners.push(Listener {
        entry: table.entry("listen"),
        protocol,
        address: listen,
        multicast: false,
    });
    Some(listen)
}

fn modem_line(table: &RawTable, line: ModemLine) -> Option<TriggerFrom> {
    Some(TriggerFrom::Serial {
        port: table.text("port")?.to_owned(),
        line,
        rising: table.text("edge")? == "rising",
    })
}

pub(super) fn trigger_out(table: &RawTable, problems: &mut Problems) -> Option<TriggerOutSpec> {
    let has_port = Some(table.given("port"));
    only_with(table, &["line", "pulse_ms"], has_port, "port", problems);
    let to = match table.given("to") {
        true => Some(address(table, "to", problems)?),
        false => None,
    };
    let serial = match table.given("port") {
        true => Some(TriggerLineSpec {
            port: table.text("port")?.to_owned(),
            line: match table.text("line")? {
                "dtr" => OutLine::DataTerminalReady,
                _ => OutLine::RequestToSend,
            },
            pulse_s: table.scaled("pulse_ms", -3)?,
        }),
        false => None,
    };
    Some(TriggerOutSpec { to, serial })
}

/// Rules that need the whole rig: who follows does not lead, and triggers come in somebody's time.
pub(crate) fn refuse_what_nobody_can_trigger(
    tables: &[RawTable],
    sonars: &[Option<SonarSpec>],
    run: Option<&RunSpec>,
    problems: &mut Problems,
) {
    let from = |sonar: usize| Some(&sonars.get(sonar)?.as_ref()?.trigger.from);
    for (sonar, table) in tables.iter().enumerate() {
        let Some(trigger) = table.table("trigger") else {
            continue;
        };
        match from(sonar) {
            Some(TriggerFrom::Sonar { sonar: whom, .. }) => {
                if matches!(from(*whom), Some(TriggerFrom::Sonar { .. })) {
                    let rule = "must be a sonar that does not follow another";
                    problems.refuse(trigger.entry("follow"), rule);
                }
            }
            Some(own) if own.is_wired() && run.is_some_and(|r| r.clock == ClockSpec::Fast) => {
                let rule = "needs another run.clock than \"fast\", which waits for nobody";
                problems.refuse(trigger.entry("source"), rule);
            }
            _ => {}
        }
    }
}

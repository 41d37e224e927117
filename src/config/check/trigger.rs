//! Checks `[sonar.trigger]` and `[sonar.trigger_out]`.

use super::super::spec::*;
use super::{Listener, address, index_of, listen};
use crate::keys;
use crate::raw::{Entry, Problems};

/// Checks the trigger of the sonar with index `sonar`. `names` has the names of all sonars.
pub(super) fn trigger<'t>(
    table: &'t keys::trigger::Trigger,
    sonar: usize,
    names: &[Option<&str>],
    listeners: &mut Vec<Listener<'t>>,
    problems: &mut Problems,
) -> Option<TriggerSpec> {
    let source = table.source.text();
    let triggered = source.map(|s| s != "internal");
    let of_triggers: [&Entry; 3] = [&table.early, &table.min_interval_ms, &table.watchdog_ms];
    problems.only_with(&of_triggers, triggered, "a source other than \"internal\"");
    let from = match source? {
        "udp" => TriggerFrom::Udp {
            listen: listen(&table.listen, "UDP", listeners, problems)?,
        },
        "tcp" => TriggerFrom::Tcp {
            listen: listen(&table.listen, "TCP", listeners, problems)?,
        },
        "serial-cts" => modem_line(table, ModemLine::ClearToSend)?,
        "serial-dcd" => modem_line(table, ModemLine::CarrierDetect)?,
        "protocol" => TriggerFrom::Protocol,
        "sonar" => {
            let entry = &table.follow;
            let whom = index_of(table.follow.text()?, entry, names, "sonar", problems)?;
            if whom == sonar {
                problems.refuse(entry, "must be another sonar");
                return None;
            }
            TriggerFrom::Sonar {
                sonar: whom,
                delay_s: table.delay_ms.get()?,
            }
        }
        _ => TriggerFrom::Internal,
    };
    Some(TriggerSpec {
        from,
        early: table.early.named()?,
        min_interval_s: table.min_interval_ms.get()?,
        watchdog_s: table.watchdog_ms.if_given()?,
    })
}

fn modem_line(table: &keys::trigger::Trigger, line: ModemLine) -> Option<TriggerFrom> {
    Some(TriggerFrom::Serial {
        port: table.port.text()?.to_owned(),
        line,
        rising: table.edge.text()? == "rising",
    })
}

pub(super) fn trigger_out(
    table: &keys::trigger::TriggerOut,
    problems: &mut Problems,
) -> Option<TriggerOutSpec> {
    let to = table.to.given_and_then(|_| address(&table.to, problems))?;
    let serial = table.port.given_and_then(|port| {
        Some(TriggerLineSpec {
            port: port.clone(),
            line: table.line.named()?,
            pulse_s: table.pulse_ms.get()?,
        })
    })?;
    Some(TriggerOutSpec { to, serial })
}

/// Refuses chains of sonars that follow one another, and external triggers with the fast clock.
pub(crate) fn refuse_trigger_conflicts(
    tables: &[keys::Sonar],
    sonars: &[Option<SonarSpec>],
    run: Option<&RunSpec>,
    problems: &mut Problems,
) {
    let from = |sonar: usize| Some(&sonars.get(sonar)?.as_ref()?.trigger.from);
    for (sonar, table) in tables.iter().enumerate() {
        let Some(trigger) = table.trigger.as_ref() else {
            continue;
        };
        match from(sonar) {
            Some(TriggerFrom::Sonar { sonar: whom, .. }) => {
                if matches!(from(*whom), Some(TriggerFrom::Sonar { .. })) {
                    let rule = "must be a sonar that does not follow another";
                    problems.refuse(&trigger.follow, rule);
                }
            }
            Some(own) if own.is_wired() && run.is_some_and(|r| r.clock == ClockSpec::Fast) => {
                let rule =
                    "needs a run.clock other than \"fast\", which does not wait for triggers";
                problems.refuse(&trigger.source, rule);
            }
            _ => {}
        }
    }
}

//! Explains why a rig has not made its first ping.

use crate::io::nav::NavInputs;
use echotank_config::spec::{NavChannel, NavSourceSpec, NavSpec};
use echotank_nav::NavHistory;

/// Quantities that every ping needs and no source has sent, with the sources that should send them.
pub(crate) fn missing_quantities(spec: &NavSpec, history: &NavHistory) -> String {
    let from = |channel: NavChannel| {
        let gives = |s: &&NavSourceSpec| s.provides.contains(&channel);
        let names: Vec<_> = spec.sources.iter().filter(gives).collect();
        let names: Vec<_> = names.iter().map(|s| s.name.as_str()).collect();
        match names.is_empty() {
            true => format!("no {} (no source provides it)", channel.name()),
            false => format!("no {} from {}", channel.name(), names.join(" or ")),
        }
    };
    let all: Vec<_> = history.silent().into_iter().map(from).collect();
    all.join(", ")
}

/// Reason why a daemon with live navigation has not made its first ping yet.
pub fn reason(spec: &NavSpec, inputs: &mut NavInputs, history: &NavHistory) -> String {
    let received: u64 = inputs.counters().iter().map(|s| s.live.received).sum();
    let why = if received == 0 {
        "no source has sent anything".to_owned()
    } else if inputs.timeline().is_none() {
        "the received sentences have no date; after 5 s the computer's clock is used".to_owned()
    } else if history.silent().is_empty() && history.is_detecting() {
        "still detecting which quantities the sources send".to_owned()
    } else {
        let missing = missing_quantities(spec, history);
        format!("{missing} yet; list in `provides` only what a source sends")
    };
    format!("waiting for navigation: {why}")
}

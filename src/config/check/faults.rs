//! `[[fault]]` to requests that make sense.

use super::Problems;
use crate::raw::RawTable;
use crate::spec::FaultRequest;

/// Checked against the catalogue here, and against the sonars when the rig is opened.
pub(super) fn faults(tables: &[RawTable], problems: &mut Problems) -> Vec<FaultRequest> {
    let mut requests = Vec::new();
    for table in tables {
        let Some(kind) = table.text("kind") else {
            continue; // on the list already
        };
        let request = FaultRequest {
            kind: kind.to_owned(),
            sonar: table.text("sonar").map(str::to_owned),
            array: table.count("array"),
            element: table.count("element"),
            other: table.count("other"),
            source: table.text("source").map(str::to_owned),
            quantity: table.text("quantity").map(str::to_owned),
            value: table.number("value"),
            at_s: Some(table.number("at_s").unwrap_or(0.0)),
            for_s: table.number("for_s"),
            ramp_s: table.number("ramp_s"),
            probability: table.number("probability"),
            burst: table.integer("burst").and_then(|n| u32::try_from(n).ok()),
            seed: table.integer("seed").and_then(|n| u64::try_from(n).ok()),
        };
        match request.checked() {
            Ok(_) => requests.push(request),
            Err(refused) => problems.refuse(table.entry(refused.key), refused.rule),
        }
    }
    requests
}

//! Converts `[[fault]]` tables to checked requests.

use super::Problems;
use crate::keys;
use crate::raw::Entry;
use crate::spec::FaultRequest;

/// Requests checked against the catalogue. The sonars are checked when the rig is opened.
pub(super) fn faults(tables: &[keys::faults::Fault], problems: &mut Problems) -> Vec<FaultRequest> {
    let mut requests = Vec::new();
    for table in tables {
        let Some(kind) = table.kind.text() else {
            continue; // the problem is already listed
        };
        let request = FaultRequest {
            kind: kind.to_owned(),
            sonar: table.sonar.text().map(str::to_owned),
            array: table.array.to(),
            element: table.element.to(),
            other: table.other.to(),
            source: table.source.text().map(str::to_owned),
            quantity: table.quantity.text().map(str::to_owned),
            value: table.value.get(),
            at_s: Some(table.at_s.get().unwrap_or(0.0)),
            for_s: table.for_s.get(),
            ramp_s: table.ramp_s.get(),
            probability: table.probability.get(),
            burst: table.burst.get().and_then(|n| u32::try_from(n).ok()),
            seed: table.seed.get().and_then(|n| u64::try_from(n).ok()),
        };
        match request.checked() {
            Ok(_) => requests.push(request),
            Err(refused) => {
                let keys: [&Entry; 9] = [
                    &table.value,
                    &table.source,
                    &table.quantity,
                    &table.sonar,
                    &table.array,
                    &table.element,
                    &table.other,
                    &table.burst,
                    &table.at_s,
                ];
                let entry = keys.into_iter().find(|entry| entry.key() == refused.key);
                problems.refuse(entry.unwrap_or(&table.kind), refused.rule);
            }
        }
    }
    requests
}

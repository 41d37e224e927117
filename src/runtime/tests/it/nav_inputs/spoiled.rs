//! Faults injected into live navigation bytes: the decoder counts exactly their effects.

use std::sync::Arc;
use std::time::{Duration, Instant};

use echotank_config::spec::FaultRequest;
use echotank_core::time::UtcNs;
use echotank_nav::decoder::NavCounters;
use echotank_ping::faults::Faults;
use echotank_runtime::faults::nav::NavFaults;

use super::{PATIENCE, nav_spec, opened, send, sentences, source, udp};

/// Sends all sentences of the log over UDP, split anywhere, through a fault. Returns the decoder's counts and the number of faulty sentences.
fn heard(fault: Option<&str>) -> (NavCounters, u64) {
    let spec = nav_spec(vec![source("s330", udp())]);
    let (mut inputs, mut history) = opened(&spec);
    let faults = Arc::new(Faults::new(&[], &spec.sources));
    if let Some(json) = fault {
        let request: FaultRequest = serde_json::from_str(json).expect("JSON");
        faults.add(&request).expect("sound");
    }
    inputs.set_fault_filter(Box::new(NavFaults::new(faults.clone(), &spec.sources)));
    send(&mut inputs, 0, sentences().concat().chunks(301));
    let begun = Instant::now();
    let (mut before, mut same) = (0, 0);
    while same < 5 && begun.elapsed() < PATIENCE {
        inputs.pull(UtcNs(0), &mut history);
        let now = inputs.counters()[0].decoder.bytes;
        same = if now == before && now > 0 {
            same + 1
        } else {
            0
        };
        before = now;
        std::thread::sleep(Duration::from_millis(2));
    }
    let counters = inputs.counters()[0].decoder;
    let log = faults.take_injections();
    assert!(log.iter().all(|i| i.source.as_deref() == Some("s330")));
    assert_eq!(log.len() as u64, faults.injected());
    (counters, faults.injected())
}

#[test]
fn the_decoder_counts_the_corrupted_sentences() {
    let (clean, none) = heard(None);
    assert_eq!((clean.sentences, clean.bad_checksum, none), (720, 0, 0));
    assert_eq!((clean.missing_checksum, clean.refused_checksum), (0, 0));

    let (got, struck) = heard(Some(
        r#"{"kind": "nav-checksum", "probability": 0.2, "seed": 3}"#,
    ));
    assert!((100..200).contains(&struck), "{struck} of 720");
    assert_eq!((got.sentences, got.bad_checksum), (720, struck));
    assert_eq!(got.refused_checksum, struck);
    assert_eq!(got.bytes, clean.bytes);

    let (got, struck) = heard(Some(
        r#"{"kind": "nav-noise", "value": 3, "probability": 0.2, "source": "s330"}"#,
    ));
    assert!((100..200).contains(&struck), "{struck} of 720");
    assert_eq!((got.sentences, got.bad_checksum), (720, 0));
    assert_eq!(got.resync_bytes, clean.resync_bytes + 3 * struck);
    assert_eq!(got.used, clean.used);

    let (got, struck) = heard(Some(
        r#"{"kind": "nav-cut", "probability": 0.2, "seed": 9}"#,
    ));
    assert!((100..200).contains(&struck), "{struck} of 720");
    assert_eq!((got.sentences, got.missing_checksum), (720, struck));
    assert_eq!(got.refused_checksum, struck);
    assert!(
        got.resync_bytes > clean.resync_bytes + 10 * struck,
        "{got:?}"
    );
}

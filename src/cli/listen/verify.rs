//! `echotank listen --verify`: counts lost, duplicated, late and damaged records of any protocol.

use std::net::ToSocketAddrs;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use super::ListenArgs;
use crate::cli::Failure;
use echotank_runtime::io::signals::stop_on_signals;
use echotank_runtime::io::sonar::verification::accounting::{checksums_text, parse_checksums};
use echotank_runtime::io::sonar::verification::decode::Sequence;
use echotank_runtime::io::sonar::verification::listener::{Listener, ListenerSpec};
use echotank_runtime::io::{text_of, write_text};

pub(crate) fn main(args: &ListenArgs, record_types: &[u32]) -> Result<(), Failure> {
    let family = args.family;
    let no_address = |why: String| Failure::Configuration(format!("{}: {why}", args.address));
    let mut addresses = args
        .address
        .to_socket_addrs()
        .map_err(|why| no_address(why.to_string()))?;
    let address = addresses
        .next()
        .ok_or_else(|| no_address("no such address".into()))?;
    let against = match &args.against {
        None => None,
        Some(path) => {
            let text = text_of(path).map_err(Failure::running)?;
            let sums = parse_checksums(&text).map_err(|line| {
                Failure::Configuration(format!(
                    "{}: line {line}: expected a checksum as --sums writes it",
                    path.display()
                ))
            })?;
            Some(sums)
        }
    };
    let what = ListenerSpec {
        family,
        address,
        record_types: record_types.to_vec(),
        range_m: args.range_m,
        silence: args
            .silence_ms
            .map(|ms| Duration::from_secs_f64(ms.clamp(1.0, 1e9) * 1e-3)),
    };
    let mut listener =
        Listener::open(what, against, args.sums.is_some()).map_err(Failure::running)?;
    println!("listening to {} at {}", family.name(), args.address);
    let stop = Arc::new(AtomicBool::new(false));
    stop_on_signals(&stop).map_err(Failure::running)?;
    let began = Instant::now();
    let end = args
        .seconds
        .map(|s| began + Duration::from_secs_f64(s.clamp(0.0, 1e9)));
    let mut is_over =
        || stop.load(Ordering::Acquire) || end.is_some_and(|end| Instant::now() >= end);
    let ended = listener.run(&mut is_over);
    let early = end.is_some() && !is_over();
    let lost = print(&listener, began.elapsed());
    for (path, text) in [
        (&args.report, listener.accounting.report().text()),
        (&args.sums, checksums_text(listener.accounting.checksums())),
    ] {
        if let Some(path) = path {
            write_text(path, &text).map_err(Failure::running)?;
        }
    }
    ended.map_err(Failure::running)?;
    match (early, lost) {
        // The connection closed before `--seconds` had passed.
        (true, _) => Err(Failure::Running("the server closed the connection".into())),
        (_, 0) => Ok(()),
        (_, lost) => Err(Failure::Running(format!("{lost} records lost"))),
    }
}

/// Prints the counts. Returns the number of lost records.
fn print(listener: &Listener, took: Duration) -> u64 {
    let mut lost = 0;
    for (sequence, tally) in listener.accounting.tallies() {
        lost += tally.lost;
        let name = match sequence {
            Sequence::Records(record_type) => record_type.to_string(),
            Sequence::Packets { stream, context } => {
                let what = if context { "contexts" } else { "data" };
                format!("stream {stream} {what}")
            }
            Sequence::Frames => "frames".to_owned(),
            Sequence::Answers => "answers".to_owned(),
        };
        println!(
            "{name}: {} sent, {} received, {} lost, {} duplicate, {} late (out of order)",
            tally.sent, tally.received, tally.lost, tally.duplicate, tally.late
        );
    }
    let report = listener.accounting.report();
    let mut kinds = std::collections::BTreeMap::new();
    for finding in &report.findings {
        *kinds.entry(finding.kind.as_str()).or_insert(0_u64) += 1;
    }
    if !kinds.is_empty() {
        let words: Vec<_> = kinds.iter().map(|(k, n)| format!("{n} {k}")).collect();
        println!("findings: {}", words.join(", "));
    }
    if listener.requests > 0 {
        println!(
            "{} requests, {} replies",
            listener.requests, listener.answers
        );
    }
    println!(
        "{} bytes in {:.1} s; {} transmission errors, {} records without a number, {} resets, {} silences",
        listener.bytes,
        took.as_secs_f64(),
        listener.errors(),
        listener.unnumbered(),
        listener.resets,
        listener.silences
    );
    lost
}

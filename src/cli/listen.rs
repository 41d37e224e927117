//! `echotank listen`: a small topside for people.

use std::time::{Duration, Instant};

use clap::Args;
use echotank_protocols::sevenk::describe;

use super::Failure;
use crate::io::sonar::client::SevenKClient;
use crate::io::sonar::verify::Verifier;

/// What is subscribed to when nothing is named: everything a ping makes.
const EVERYTHING: [u32; 10] = [7000, 7503, 7004, 7007, 7018, 7038, 7610, 1003, 1012, 1013];

#[derive(Args, Clone, Debug)]
pub struct ListenArgs {
    /// 7k server, e.g. 127.0.0.1:7000
    pub address: String,
    /// Record types to subscribe to, separated by commas [default: all that a ping makes]
    #[arg(long, value_delimiter = ',', value_name = "TYPE")]
    pub records: Vec<u32>,
    /// Stop after this many seconds (default: listen until the server closes)
    #[arg(long, value_name = "S")]
    pub seconds: Option<f64>,
    /// Do not print records; account at the end for those sent, lost, duplicated and late, by their ping numbers
    #[arg(long)]
    pub verify: bool,
}

pub fn main(args: &ListenArgs) -> Result<(), Failure> {
    let mut client = SevenKClient::connect(args.address.as_str()).map_err(Failure::running)?;
    let configuration = client.request(7001).map_err(Failure::running)?;
    println!("{}", describe(configuration.bytes()));
    let wanted = if args.records.is_empty() {
        EVERYTHING.to_vec()
    } else {
        args.records.clone()
    };
    client.subscribe(&wanted).map_err(Failure::running)?;
    let end = args
        .seconds
        .map(|s| Instant::now() + Duration::from_secs_f64(s.clamp(0.0, 1e9)));
    let mut verifier = Verifier::default();
    let mut bytes = 0u64;
    let began = Instant::now();
    let closed = loop {
        let left = end.map_or(Duration::from_secs(1), |end| {
            end.saturating_duration_since(Instant::now())
                .min(Duration::from_secs(1))
        });
        if left.is_zero() {
            break None;
        }
        match client.next_record(left) {
            Ok(Some(record)) => {
                bytes += record.bytes().len() as u64;
                verifier.note(record.record_type(), record.body());
                if !args.verify {
                    println!("{}", describe(record.bytes()));
                }
            }
            Ok(None) => {}
            Err(error) => break Some(error),
        }
    };
    let mut lost = 0;
    for (record_type, tally) in verifier.tallies() {
        lost += tally.lost;
        println!(
            "{record_type}: {} sent, {} received, {} lost, {} duplicate, {} late (out of order)",
            tally.sent, tally.received, tally.lost, tally.duplicate, tally.late
        );
    }
    println!(
        "{bytes} bytes in {:.1} s; {} spoiled on the way: {:?}",
        began.elapsed().as_secs_f64(),
        client.counters().errors(),
        client.counters()
    );
    match closed {
        // The server's end of the conversation is an end, not a fault, unless something was to come.
        Some(error) if end.is_some() => Err(Failure::running(error)),
        _ if args.verify && lost > 0 => Err(Failure::Running(format!("{lost} records lost"))),
        _ => Ok(()),
    }
}

//! `echotank listen`: a minimal topside for tests and diagnosis.

mod pulses;
mod verify;
mod vita49;

use std::path::PathBuf;
use std::time::{Duration, Instant};

use clap::Args;
use clap::builder::{PossibleValuesParser, TypedValueParser};
use echotank_protocols::sevenk::describe;

use super::Failure;
use echotank_core::time::UtcNs;
use echotank_runtime::histograms::LatencyHistogram;
use echotank_runtime::io::sonar::client::SevenKClient;
use echotank_runtime::io::sonar::elements::{ElementClient, FrameTally};
use echotank_runtime::io::sonar::verification::decode::Family;
use pulses::{Pulses, TriggerTo};

/// Default subscription: every record type of a ping.
const PING_RECORDS: [u32; 10] = [7000, 7503, 7004, 7007, 7018, 7038, 7610, 1003, 1012, 1013];

/// Parser for the name of a protocol family.
fn families() -> impl TypedValueParser<Value = Family> {
    let named = |name: String| Family::ALL.into_iter().find(|f| f.name() == name);
    PossibleValuesParser::new(Family::ALL.map(Family::name))
        .map(move |name| named(name).expect("one of the possible values"))
}

#[derive(Args, Clone, Debug)]
pub(crate) struct ListenArgs {
    /// Address of the 7k server, e.g. 127.0.0.1:7000; with --family that protocol's (data) server; for VITA 49 the local address to receive at
    pub(crate) address: String,
    /// Record types to subscribe to, separated by commas [default: all of a ping]
    #[arg(long, value_delimiter = ',', value_name = "TYPE")]
    pub(crate) records: Vec<u32>,
    /// Stop after this many seconds (default: listen until the server closes)
    #[arg(long, value_name = "S")]
    pub(crate) seconds: Option<f64>,
    /// Do not print records; report at the end how many were sent, lost, duplicated, late and damaged, by their sequence numbers. Reconnects
    /// after a reset
    #[arg(long)]
    pub(crate) verify: bool,
    /// Protocol of the server. Imagenex 872 replies carry no sequence numbers and are only counted
    #[arg(long, value_parser = families(), default_value = "7k", requires = "verify")]
    pub(crate) family: Family,
    /// Write every finding as JSON lines, for `echotank score`
    #[arg(long, value_name = "FILE", requires = "verify")]
    pub(crate) report: Option<PathBuf>,
    /// Write a checksum of every record, for --against; use a run without faults
    #[arg(long, value_name = "FILE", requires = "verify")]
    pub(crate) sums: Option<PathBuf>,
    /// Compare every record with the checksums of the same run without faults; finds changes with valid checksums
    #[arg(long, value_name = "FILE", requires = "verify")]
    pub(crate) against: Option<PathBuf>,
    /// Report a silence when nothing arrives for this long, ms
    #[arg(long, value_name = "MS", requires = "verify")]
    pub(crate) silence_ms: Option<f64>,
    /// Range requested from an Imagenex 872, m
    #[arg(long, value_name = "M", default_value_t = 50)]
    pub(crate) range_m: u8,
    /// Receive an element stream (sonar.output.elements): count its frames and print latencies, from the pulse to a ping's first sample and
    /// from a frame's last sample to its arrival; needs nav.stamp = "host"
    #[arg(long, conflicts_with_all = ["records", "verify"])]
    pub(crate) elements: bool,
    /// Receive VITA 49 datagrams at the address (sonar.output.vita49.send_to), e.g. 127.0.0.1:4991; prints the same as --elements
    #[arg(long, conflicts_with_all = ["records", "verify", "elements"])]
    pub(crate) vita49: bool,
    /// Trigger pings at random times and print the latency to their first sample; needs --elements or --vita49. udp=ADDRESS or tcp=ADDRESS of
    /// [sonar.trigger], or ctl=ADDRESS of [control]
    #[arg(long, value_name = "KIND=ADDRESS")]
    pub(crate) trigger: Option<TriggerTo>,
    /// Mean interval between triggers, ms, varied by half; must be longer than the receive window
    #[arg(long, value_name = "MS", default_value_t = 200.0, requires = "trigger")]
    pub(crate) every_ms: f64,
}

impl ListenArgs {
    fn pulses(&self) -> Result<Option<Pulses>, Failure> {
        let every = Duration::from_secs_f64(self.every_ms.clamp(1.0, 1e9) * 1e-3);
        self.trigger.map(|to| Pulses::start(to, every)).transpose()
    }
}

/// Bin width of the printed histograms, microseconds.
const BIN_US: u64 = 100;

/// Prints percentiles, and the counts by upper bin edge.
fn print_spread(what: &str, spread: &LatencyHistogram) {
    let f = spread.figures();
    let ms = [f.p50_us, f.p99_us, f.p999_us, f.max_us].map(|us| us as f64 / 1e3);
    println!(
        "{what}: p50 {:.3} ms, p99 {:.3}, p99.9 {:.3}, max {:.3} ({} samples)",
        ms[0], ms[1], ms[2], ms[3], f.count
    );
    let bins = spread.bins_of(BIN_US);
    let bins = bins.iter().filter(|(_, count)| *count > 0);
    let bins = bins.map(|(end_us, count)| format!("{:.1} ms {count}", *end_us as f64 / 1e3));
    println!("  no later than: {}", bins.collect::<Vec<_>>().join(", "));
}

/// Receives an element stream to its end and prints the latencies.
fn elements(args: &ListenArgs) -> Result<(), Failure> {
    let mut client = ElementClient::connect(args.address.as_str()).map_err(Failure::running)?;
    let end = args
        .seconds
        .map(|s| Instant::now() + Duration::from_secs_f64(s.clamp(0.0, 1e9)));
    let mut tally = FrameTally::default();
    let (first_sample, frames) = (LatencyHistogram::new(), LatencyHistogram::new());
    let mut bytes = 0;
    let pulses = args.pulses()?;
    loop {
        let left = end.map_or(Duration::from_secs(1), |end| {
            end.saturating_duration_since(Instant::now())
                .min(Duration::from_secs(1))
        });
        let is_open = !left.is_zero()
            && client
                .read(left, |frame, now| {
                    bytes += frame.size_bytes() as u64;
                    let head = &frame.head;
                    let since_ns =
                        |after_s: f64| now.0 - UtcNs(head.pulse_utc_ns).plus_s(after_s).0;
                    let us = |ns: i64| (ns.max(0) / 1000) as u64;
                    if tally.note(frame) {
                        first_sample.note(us(since_ns(head.first_sample_s)));
                        if let Some(pulses) = &pulses {
                            pulses.first_sample(now.0);
                        }
                    }
                    let last = head.first_sample + frame.sample_times.saturating_sub(1);
                    let received_s = head.first_sample_s + f64::from(last) / head.sample_rate_hz;
                    frames.note(us(since_ns(received_s)));
                })
                .map_err(Failure::running)?;
        if !is_open {
            break;
        }
    }
    println!(
        "{} pings, {} incomplete; {} frames, {} lost; {bytes} bytes, {} outside frames",
        tally.pings,
        tally.incomplete_pings,
        tally.frames,
        tally.lost_frames,
        client.skipped_bytes()
    );
    if let Some(pulses) = &pulses {
        pulses.print();
    }
    print_spread("first sample after the pulse", &first_sample);
    print_spread("frame after its last sample", &frames);
    match tally.lost_frames {
        0 => Ok(()),
        lost => Err(Failure::Running(format!("{lost} frames lost"))),
    }
}

pub(crate) fn main(args: &ListenArgs) -> Result<(), Failure> {
    if args.trigger.is_some() && !(args.elements || args.vita49) {
        let rule = "--trigger: only with --elements or --vita49";
        return Err(Failure::Configuration(rule.into()));
    }
    if args.elements {
        return elements(args);
    }
    if args.vita49 {
        return vita49::main(args);
    }
    let wanted = if args.records.is_empty() {
        PING_RECORDS.to_vec()
    } else {
        args.records.clone()
    };
    if args.verify {
        return verify::main(args, &wanted);
    }
    let mut client = SevenKClient::connect(args.address.as_str()).map_err(Failure::running)?;
    let configuration = client.request(7001).map_err(Failure::running)?;
    println!("{}", describe(configuration.bytes()));
    client.subscribe(&wanted).map_err(Failure::running)?;
    let end = args
        .seconds
        .map(|s| Instant::now() + Duration::from_secs_f64(s.clamp(0.0, 1e9)));
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
                println!("{}", describe(record.bytes()));
            }
            Ok(None) => {}
            Err(error) => break Some(error),
        }
    };
    let counters = client.counters();
    println!(
        "{} records, {bytes} bytes in {:.1} s; {} transmission errors",
        counters.records,
        began.elapsed().as_secs_f64(),
        counters.errors()
    );
    if counters.errors() > 0 {
        println!("{counters:?}");
    }
    match closed {
        // A closed connection is an error only if `--seconds` have not passed.
        Some(error) if end.is_some() => Err(Failure::running(error)),
        _ => Ok(()),
    }
}

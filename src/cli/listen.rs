//! `echotank listen`: a small topside for people.

mod pulses;
mod verify;
mod vita49;

use std::path::PathBuf;
use std::time::{Duration, Instant};

use clap::Args;
use echotank_protocols::sevenk::describe;

use super::Failure;
use echotank_core::time::UtcNs;
use echotank_runtime::histograms::LatencyHistogram;
use echotank_runtime::io::sonar::client::SevenKClient;
use echotank_runtime::io::sonar::elements::{ElementClient, FrameTally};
use pulses::{Pulses, TriggerTo};
use verify::FamilyName;

/// What is subscribed to when nothing is named: everything a ping makes.
const EVERYTHING: [u32; 10] = [7000, 7503, 7004, 7007, 7018, 7038, 7610, 1003, 1012, 1013];

#[derive(Args, Clone, Debug)]
pub(crate) struct ListenArgs {
    /// 7k server, e.g. 127.0.0.1:7000; with --family the address of its server (of its data), of VITA 49 where its datagrams come to
    pub(crate) address: String,
    /// Record types to subscribe to, separated by commas [default: all that a ping makes]
    #[arg(long, value_delimiter = ',', value_name = "TYPE")]
    pub(crate) records: Vec<u32>,
    /// Stop after this many seconds (default: listen until the server closes)
    #[arg(long, value_name = "S")]
    pub(crate) seconds: Option<f64>,
    /// Do not print records; account at the end for those sent, lost, duplicated, late and damaged, by whatever numbers they carry. A client
    /// that was reset connects again
    #[arg(long)]
    pub(crate) verify: bool,
    /// What is spoken there. Imagenex 872 carries no numbers: its answers are only counted
    #[arg(long, value_enum, default_value = "7k", requires = "verify")]
    pub(crate) family: FamilyName,
    /// Write every finding as a line of JSON, for `echotank score`
    #[arg(long, value_name = "FILE", requires = "verify")]
    pub(crate) report: Option<PathBuf>,
    /// Write a sum of every record: of a run without faults, for --against
    #[arg(long, value_name = "FILE", requires = "verify")]
    pub(crate) sums: Option<PathBuf>,
    /// Compare every record with these sums of the same run without faults: what no checksum tells
    #[arg(long, value_name = "FILE", requires = "verify")]
    pub(crate) against: Option<PathBuf>,
    /// Find a silence where nothing comes for so long, ms
    #[arg(long, value_name = "MS", requires = "verify")]
    pub(crate) silence_ms: Option<f64>,
    /// The range that an Imagenex 872 is asked for, m
    #[arg(long, value_name = "M", default_value_t = 50)]
    pub(crate) range_m: u8,
    /// The address is an element stream (sonar.output.elements): account for its frames, and tell how long after its pulse each ping's first
    /// sample came, and each frame after the instant its last sample was heard; needs nav.stamp = "host"
    #[arg(long, conflicts_with_all = ["records", "verify"])]
    pub(crate) elements: bool,
    /// The address is where datagrams of VITA 49 come to (sonar.output.vita49.send_to), e.g. 127.0.0.1:4991: as --elements, of its packets
    #[arg(long, conflicts_with_all = ["records", "verify", "elements"])]
    pub(crate) vita49: bool,
    /// Trigger the pings itself, at random instants (with --elements or --vita49), and tell how long after that their first samples came: where
    /// [sonar.trigger] listens, udp=ADDRESS or tcp=ADDRESS; or ctl=ADDRESS of [control], for pings asked for by number
    #[arg(long, value_name = "WAY=ADDRESS")]
    pub(crate) trigger: Option<TriggerTo>,
    /// Half to one and a half times so long from trigger to trigger, ms; longer than a ping's window
    #[arg(long, value_name = "MS", default_value_t = 200.0, requires = "trigger")]
    pub(crate) every_ms: f64,
}

impl ListenArgs {
    fn pulses(&self) -> Result<Option<Pulses>, Failure> {
        let every = Duration::from_secs_f64(self.every_ms.clamp(1.0, 1e9) * 1e-3);
        self.trigger.map(|to| Pulses::start(to, every)).transpose()
    }
}

/// Of the histograms printed: fine where pings are prompt, and there are few bins where they are.
const BIN_US: u64 = 100;

/// A histogram in a line of percentiles and a line of how many were no later than so many milliseconds.
fn print_spread(what: &str, spread: &LatencyHistogram) {
    let f = spread.figures();
    let ms = [f.p50_us, f.p99_us, f.p999_us, f.max_us].map(|us| us as f64 / 1e3);
    println!(
        "{what}: p50 {:.3} ms, p99 {:.3}, p99.9 {:.3}, max {:.3} ({} of them)",
        ms[0], ms[1], ms[2], ms[3], f.count
    );
    let bins = spread.bins_of(BIN_US);
    let bins = bins.iter().filter(|(_, count)| *count > 0);
    let bins = bins.map(|(end_us, count)| format!("{:.1} ms {count}", *end_us as f64 / 1e3));
    println!("  no later than: {}", bins.collect::<Vec<_>>().join(", "));
}

/// Takes an element stream to the end.
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
                        first_sample.note(us(since_ns(head.first_moment_s)));
                        if let Some(pulses) = &pulses {
                            pulses.first_sample(now.0);
                        }
                    }
                    let last = head.first_moment + frame.moments.saturating_sub(1);
                    let heard_s = head.first_moment_s + f64::from(last) / head.moments_per_s;
                    frames.note(us(since_ns(heard_s)));
                })
                .map_err(Failure::running)?;
        if !is_open {
            break;
        }
    }
    println!(
        "{} pings, {} incomplete; {} frames, {} lost; {bytes} bytes, {} of no frame",
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
        EVERYTHING.to_vec()
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
    println!(
        "{bytes} bytes in {:.1} s; {} spoiled on the way: {:?}",
        began.elapsed().as_secs_f64(),
        client.counters().errors(),
        client.counters()
    );
    match closed {
        // The server's end of the conversation is an end, not a fault, unless something was to come.
        Some(error) if end.is_some() => Err(Failure::running(error)),
        _ => Ok(()),
    }
}

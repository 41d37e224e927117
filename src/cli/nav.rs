//! `echotank nav`: reports the contents of a recorded log, the quantities in use, and reasons for unused data.

mod plot;

use std::path::PathBuf;

use clap::{Args, ValueEnum};
use glam::DVec3;
use serde_json::{Value, json};

use super::{Failure, choice};
use echotank_config::spec::{
    ChecksumPolicy, NavChannel, NavDialect, NavFormat, NavInputSpec, NavSourceSpec, Reversed,
    SensorMounting, TimePolicy,
};
use echotank_core::time::UtcNs;
use echotank_nav::decoder::Outcome;
use echotank_nav::log::LogKind;
use echotank_nav::passes::{Pass, PassKind};
use echotank_nav::report::{CHANNEL_COUNT, LogReport, SentenceReport, Spread, report};
use echotank_runtime::config_files::read_bounded;
use echotank_runtime::io::nav::MAX_LOG_BYTES;

/// Names of the quantities in the output.
fn channel_names() -> impl Iterator<Item = &'static str> {
    NavChannel::ALL.into_iter().map(NavChannel::name)
}

/// Number of printed gaps and jumps per quantity.
const SHOWN: usize = 5;

#[derive(Args, Clone, Debug)]
pub(crate) struct NavArgs {
    /// A recorded log: text, pcap or pcapng, MAVLink tlog, or a manufacturer's binary records
    pub(crate) log: PathBuf,
    /// Plot track, attitude and heave as PNG
    #[arg(long, value_name = "FILE")]
    pub(crate) png: Option<PathBuf>,
    /// Print JSON
    #[arg(long)]
    pub(crate) json: bool,
    /// Format, if the file does not identify it
    #[arg(long, value_parser = choice::<NavFormat>(), default_value = "nmea")]
    pub(crate) format: NavFormat,
    /// Treatment of checksums
    #[arg(long, value_parser = choice::<ChecksumPolicy>(), default_value = "require")]
    pub(crate) checksum: ChecksumPolicy,
    /// Sentences whose checksum is ignored, e.g. PTNTHPR or HDT
    #[arg(long, value_name = "NAME")]
    pub(crate) ignore_checksum_for: Vec<String>,
    /// Time of validity of a measurement: its own, its burst's, or its arrival
    #[arg(long, value_enum, default_value = "burst")]
    pub(crate) time: Time,
    /// Latency subtracted from the arrival, ms; with --time arrival
    #[arg(long, default_value_t = 0.0)]
    pub(crate) latency_ms: f64,
    /// Heave in PASHR is positive up
    #[arg(long)]
    pub(crate) pashr_heave_up: bool,
    /// DPT, DBT, DBS and DBK give the platform's own depth
    #[arg(long)]
    pub(crate) own_depth: bool,
    /// Quantities whose sign is opposite to their format's documentation
    #[arg(long, value_enum)]
    pub(crate) reverse: Vec<Reverse>,
    /// Magnetic variation, east positive; converts magnetic headings to true if the sentence has none
    #[arg(long, allow_hyphen_values = true)]
    pub(crate) magnetic_variation_deg: Option<f64>,
    /// Sentences per second, if neither lines nor messages carry a time
    #[arg(long, default_value_t = 10.0)]
    pub(crate) plain_rate_hz: f64,
}

#[derive(ValueEnum, Clone, Copy, Debug)]
pub(crate) enum Time {
    Message,
    Burst,
    Arrival,
}

#[derive(ValueEnum, Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Reverse {
    Roll,
    Pitch,
    Heave,
}

pub(crate) fn main(args: &NavArgs) -> Result<(), Failure> {
    let rate_ok = args.plain_rate_hz.is_finite() && args.plain_rate_hz > 0.0;
    if !rate_ok || !args.latency_ms.is_finite() {
        let text = "--plain-rate-hz must be finite and above 0, and --latency-ms finite";
        return Err(Failure::Configuration(text.to_owned()));
    }
    let bytes = read_bounded(&args.log, MAX_LOG_BYTES)
        .map_err(|why| Failure::Configuration(format!("{}: {why}", args.log.display())))?;
    let refused = |why: &str| Failure::Configuration(format!("{} {why}", args.log.display()));
    if let Some(why) = echotank_nav::log::refusal(&bytes) {
        return Err(refused(why));
    }
    let report = report(&bytes, &spec(args), args.plain_rate_hz);
    if report.counters.used == 0
        && let Some(why) = echotank_nav::log::unknown_binary(&bytes, report.log.kind)
    {
        return Err(refused(&why));
    }
    if args.json {
        println!("{:#}", json_of(args, &report));
    } else {
        print!("{}", text_of(args, &report));
    }
    if let Some(path) = &args.png {
        plot::write(path, &report)
            .map_err(|e| Failure::running(format!("{}: {e}", path.display())))?;
    }
    Ok(())
}

fn spec(args: &NavArgs) -> NavSourceSpec {
    NavSourceSpec {
        name: "log".to_owned(),
        input: NavInputSpec::Log {
            path: args.log.clone(),
            plain_rate_hz: args.plain_rate_hz,
        },
        time: match args.time {
            Time::Message => TimePolicy::Message,
            Time::Burst => TimePolicy::Burst,
            Time::Arrival => TimePolicy::Arrival {
                latency_s: args.latency_ms / 1000.0,
            },
        },
        checksum: args.checksum,
        lever_arm_m: DVec3::ZERO,
        mounting: SensorMounting::default(),
        dialect: NavDialect {
            format: args.format,
            ignore_checksum_for: args.ignore_checksum_for.clone(),
            pashr_heave_up: args.pashr_heave_up,
            depth_is_own: args.own_depth,
            reversed: Reversed {
                roll: args.reverse.contains(&Reverse::Roll),
                pitch: args.reverse.contains(&Reverse::Pitch),
                heave: args.reverse.contains(&Reverse::Heave),
            },
            magnetic_variation_rad: args.magnetic_variation_deg.map(f64::to_radians),
        },
        provides: NavChannel::ALL.to_vec(),
        detect: false,
    }
}

/// Formats a time in ISO 8601 to the millisecond.
fn iso(utc: UtcNs) -> String {
    let time = chrono::DateTime::from_timestamp_nanos(utc.0);
    time.format("%Y-%m-%dT%H:%M:%S%.3fZ").to_string()
}

fn outcome_name(outcome: Outcome) -> &'static str {
    match outcome {
        Outcome::Used => "used",
        Outcome::RefusedChecksum => "refused_checksum",
        Outcome::Malformed => "malformed",
        Outcome::Unsupported => "unsupported",
        Outcome::EmptyFields => "empty_fields",
        Outcome::NotTaken => "not_taken",
        Outcome::TimeJump => "time_jump",
    }
}

fn shift_s(pass: &Pass) -> f64 {
    pass.shift_ns as f64 / 1e9
}

/// Quantities that a sentence supplied, and reasons for the unused ones.
fn usage(s: &SentenceReport, report: &LogReport) -> String {
    let count = |outcome| s.outcomes.get(&outcome).copied().unwrap_or(0);
    let mut parts = Vec::new();
    for (i, name) in channel_names().enumerate() {
        if s.gave[i] > 0 {
            parts.push(format!("{name} {}", s.gave[i]));
        }
    }
    if parts.is_empty() && count(Outcome::Used) > 0 {
        parts.push(format!("time or quality {}", count(Outcome::Used)));
    }
    for (i, name) in channel_names().enumerate() {
        if s.outranked[i] > 0 {
            let others = report
                .sentences
                .iter()
                .filter(|o| o.name != s.name && o.gave[i] > 0);
            let from = others
                .max_by_key(|o| o.gave[i])
                .map_or("another", |o| o.name.as_str());
            parts.push(format!(
                "{} not taken: {name} comes from {from}",
                s.outranked[i]
            ));
        }
    }
    if s.magnetic > 0 {
        parts.push(format!(
            "{} magnetic with unknown variation (magnetic_variation_deg)",
            s.magnetic
        ));
    }
    if s.depths > 0 {
        parts.push(format!("{} water depths, not used for motion", s.depths));
    }
    let spoken = s.outranked.iter().any(|n| *n > 0) || s.magnetic > 0 || s.depths > 0;
    if count(Outcome::NotTaken) > 0 && !spoken {
        parts.push(format!("{} decoded but not used", count(Outcome::NotTaken)));
    }
    let reasons = [
        (
            Outcome::RefusedChecksum,
            "rejected by checksum (checksum, ignore_checksum_for)",
        ),
        (Outcome::Malformed, "with invalid fields"),
        (Outcome::Unsupported, "of an unsupported type"),
        (Outcome::EmptyFields, "without a fix or with empty fields"),
        (Outcome::TimeJump, "with a time jump"),
    ];
    for (outcome, why) in reasons {
        if count(outcome) > 0 {
            parts.push(format!("{} {why}", count(outcome)));
        }
    }
    parts.join("; ")
}

fn text_of(args: &NavArgs, r: &LogReport) -> String {
    use std::fmt::Write;
    let mut out = String::new();
    let (c, log) = (&r.counters, &r.log);
    let _ = writeln!(out, "{:9} {}", "file", args.log.display());
    let kind = match log.kind {
        LogKind::Text => "lines of text",
        LogKind::Binary => "records",
        LogKind::Capture => "packet capture, UDP datagrams",
        LogKind::Tlog => "MAVLink telemetry log, messages",
    };
    let _ = writeln!(
        out,
        "{:9} {kind}: {}, {} with a stamp, {} with a stamp earlier than the previous, {} without a sentence ({} of them JSON, which is not read), {} packets skipped",
        "log", log.lines, log.stamped, log.backward, log.no_sentence, log.json, log.passed_over
    );
    for (pass, number) in log.passes.iter().zip(1..) {
        let how = match pass.kind {
            PassKind::Own => "by its own times".to_owned(),
            PassKind::Shifted => format!("after the pass before: {:+.3} s", shift_s(pass)),
            PassKind::WrongClock => format!("time jumped, corrected by {:+.3} s", shift_s(pass)),
        };
        let _ = writeln!(
            out,
            "pass {number:<4} from line {}, {} .. {}, played {how}",
            pass.line,
            iso(pass.first),
            iso(pass.last)
        );
    }
    if let Some((first, last)) = r.span {
        let seconds = last.seconds_since(first);
        let _ = writeln!(
            out,
            "{:9} {} .. {} ({seconds:.3} s)",
            "arrivals",
            iso(first),
            iso(last)
        );
    }
    let _ = writeln!(
        out,
        "{:9} {} midnights, {} week rollovers corrected, {} time jumps, {} without a time of validity",
        "time", r.midnights, c.week_rollovers, c.time_jumps, c.undated
    );
    let _ = writeln!(
        out,
        "{:9} {}, of which {} outside sentences",
        "bytes", c.bytes, c.resync_bytes
    );
    let _ = writeln!(
        out,
        "{:9} {}: {} used, {} not taken, {} unsupported, {} malformed, {} empty, {} rejected by checksum (in total {} wrong, {} missing)",
        "sentences",
        c.sentences,
        c.used,
        c.not_taken,
        c.unsupported,
        c.malformed,
        c.empty_fields,
        c.refused_checksum,
        c.bad_checksum,
        c.missing_checksum
    );
    let _ = writeln!(
        out,
        "\n{:20} {:>7} {:>9} {:>9} {:>26}  use",
        "sentence", "count", "every s", "gap s", "latency ms min/median/max"
    );
    for s in &r.sentences {
        let seconds = |v: Option<f64>| v.map_or("-".to_owned(), |v| format!("{v:.3}"));
        // Without time stamps, arrival times are derived from the messages, so latency is meaningless.
        let stamped = s.latency_s.filter(|_| log.stamped > 0);
        let latency = stamped.map_or("-".to_owned(), |l| {
            let ms = |v: f64| format!("{:.0}", v * 1e3);
            format!("{}/{}/{}", ms(l.min), ms(l.median), ms(l.max))
        });
        let _ = writeln!(
            out,
            "{:20} {:>7} {:>9} {:>9} {latency:>26}  {}",
            s.name,
            s.count,
            seconds(s.interval_s.map(|i| i.median)),
            seconds(s.interval_s.map(|i| i.max)),
            usage(s, r)
        );
    }
    let _ = writeln!(out);
    for (name, channel) in channel_names().zip(&r.channels) {
        if channel.samples == 0 {
            let _ = writeln!(out, "{name:13} no samples");
            continue;
        }
        let every = channel
            .interval_s
            .map_or(String::new(), |i| format!(", every {:.3} s", i.median));
        let _ = write!(
            out,
            "{name:13} {} samples{every}, {} gaps, {} jumps, {} not later than the previous",
            channel.samples,
            channel.gaps.len(),
            channel.jumps.len(),
            channel.backward
        );
        for (start, seconds) in channel.gaps.iter().take(SHOWN) {
            let _ = write!(
                out,
                "\n{:13}   gap of {seconds:.3} s from {}",
                "",
                iso(*start)
            );
        }
        for at in channel.jumps.iter().take(SHOWN) {
            let _ = write!(out, "\n{:13}   jump at {}", "", iso(*at));
        }
        let _ = writeln!(out);
    }
    out
}

fn spread_json(spread: Option<Spread>) -> Value {
    spread.map_or(
        Value::Null,
        |s| json!({ "least": s.min, "median": s.median, "most": s.max }),
    )
}

fn json_of(args: &NavArgs, r: &LogReport) -> Value {
    let c = &r.counters;
    let by_channel = |counts: &[u64; CHANNEL_COUNT]| {
        let pairs = channel_names().zip(counts).filter(|(_, n)| **n > 0);
        Value::Object(pairs.map(|(name, n)| (name.to_owned(), json!(n))).collect())
    };
    let sentences: Vec<Value> = r
        .sentences
        .iter()
        .map(|s| {
            let outcomes = s
                .outcomes
                .iter()
                .map(|(o, n)| (outcome_name(*o).to_owned(), json!(n)));
            json!({
                "name": s.name,
                "count": s.count,
                "bad_checksum": s.bad_checksum,
                "missing_checksum": s.missing_checksum,
                "outcomes": Value::Object(outcomes.collect()),
                "interval_s": spread_json(s.interval_s),
                "latency_s": spread_json(s.latency_s.filter(|_| r.log.stamped > 0)),
                "gave": by_channel(&s.gave),
                "left_to_another": by_channel(&s.outranked),
                "what_comes_of_it": usage(s, r),
            })
        })
        .collect();
    let channels = channel_names().zip(&r.channels).map(|(name, ch)| {
        let gaps: Vec<Value> = ch
            .gaps
            .iter()
            .map(|(at, s)| json!({ "from": iso(*at), "seconds": s }))
            .collect();
        let jumps: Vec<String> = ch.jumps.iter().map(|at| iso(*at)).collect();
        let value = json!({
            "samples": ch.samples,
            "interval_s": spread_json(ch.interval_s),
            "gaps": gaps,
            "jumps": jumps,
            "not_after_the_one_before": ch.backward,
        });
        (name.to_owned(), value)
    });
    json!({
        "file": args.log.display().to_string(),
        "kind": format!("{:?}", r.log.kind).to_lowercase(),
        "lines": r.log.lines,
        "stamped": r.log.stamped,
        "stamped_backward": r.log.backward,
        "lines_without_a_sentence": r.log.no_sentence,
        "lines_of_json": r.log.json,
        "packets_passed_over": r.log.passed_over,
        "passes": r.log.passes.iter().map(|pass| json!({
            "line": pass.line,
            "first": iso(pass.first),
            "last": iso(pass.last),
            "shift_s": shift_s(pass),
        })).collect::<Value>(),
        "first_arrival": r.span.map(|s| iso(s.0)),
        "last_arrival": r.span.map(|s| iso(s.1)),
        "midnights": r.midnights,
        "counters": {
            "bytes": c.bytes,
            "resync_bytes": c.resync_bytes,
            "sentences": c.sentences,
            "used": c.used,
            "not_taken": c.not_taken,
            "flagged_invalid": c.flagged_invalid,
            "unsupported": c.unsupported,
            "malformed": c.malformed,
            "empty_fields": c.empty_fields,
            "refused_checksum": c.refused_checksum,
            "bad_checksum": c.bad_checksum,
            "missing_checksum": c.missing_checksum,
            "time_jumps": c.time_jumps,
            "week_rollovers": c.week_rollovers,
            "undated": c.undated,
            "samples": c.samples,
        },
        "sentences": sentences,
        "quantities": Value::Object(channels.collect()),
    })
}

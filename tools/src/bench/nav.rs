//! Sentences per second of framing and decoding, compared with the crate `nmea` and pynmea2 for the same sentences.
//!
//! This program finds the sentences in the bytes, checks and timestamps them. The other programs get one sentence at
//! a time.

use std::path::Path;
use std::process::{Command, Stdio};
use std::time::Instant;

use echotank_config::spec::{
    ChecksumPolicy, NavChannel, NavDialect, NavInputSpec, NavSourceSpec, TimePolicy,
};
use echotank_core::time::UtcNs;
use echotank_nav::NavDecoder;
use echotank_nav::stamp::split_line;
use glam::DVec3;

use crate::report::Report;

/// Number of rounds. The fastest and the median are printed.
const ROUNDS: usize = 7;

pub(crate) fn run(
    log: &Path,
    python: Option<&Path>,
    quick: bool,
    json: Option<&Path>,
) -> Result<(), String> {
    let bytes = std::fs::read(log).map_err(|e| format!("{}: {e}", log.display()))?;
    let sentences: Vec<String> = bytes
        .split_inclusive(|b| *b == b'\n')
        .map(|line| {
            String::from_utf8_lossy(split_line(line).1)
                .trim()
                .to_owned()
        })
        .filter(|sentence| !sentence.is_empty())
        .collect();
    if sentences.is_empty() {
        return Err(format!("{}: no sentences", log.display()));
    }
    let wanted = if quick { 20_000 } else { 200_000 };
    let repeats = (wanted / sentences.len()).max(1);
    let count = sentences.len() * repeats;
    let stream: Vec<u8> = sentences
        .iter()
        .flat_map(|s| [s.as_bytes(), b"\r\n"].concat())
        .collect();
    let mut report = Report::new();
    println!("{}: {count} sentences, {ROUNDS} rounds", log.display());

    let spec = NavSourceSpec {
        name: "bench".into(),
        input: NavInputSpec::Log {
            path: log.to_owned(),
            plain_rate_hz: 10.0,
        },
        time: TimePolicy::Arrival { latency_s: 0.0 },
        checksum: ChecksumPolicy::Require,
        lever_arm_m: DVec3::ZERO,
        mounting: Default::default(),
        dialect: NavDialect::default(),
        provides: vec![
            NavChannel::Position,
            NavChannel::CourseSpeed,
            NavChannel::Heading,
            NavChannel::RollPitch,
            NavChannel::Heave,
        ],
        detect: false,
    };
    let mut samples = Vec::with_capacity(count);
    let ours = rounds(count, || {
        let mut decoder = NavDecoder::new(0, &spec);
        samples.clear();
        for i in 0..repeats {
            decoder.push(&stream, UtcNs(i as i64), &mut samples);
        }
        let c = decoder.counters();
        (c.used + c.not_taken + c.empty_fields) / repeats as u64
    });
    row(
        &mut report,
        "echotank, bytes to samples",
        &ours,
        sentences.len(),
    );
    let crate_alone = rounds(count, || {
        let mut accepted = 0;
        for _ in 0..repeats {
            for s in &sentences {
                let parsed = nmea::parse_str(std::hint::black_box(s));
                let understood =
                    parsed.is_ok_and(|p| !matches!(p, nmea::ParseResult::Unsupported(_)));
                accepted += u64::from(understood);
            }
        }
        accepted / repeats as u64
    });
    row(
        &mut report,
        "crate nmea 0.8, parse_str",
        &crate_alone,
        sentences.len(),
    );
    if let Some(python) = python {
        let line = pynmea2(python, &sentences, if quick { 10_000 } else { 50_000 })?;
        let mut parts = line
            .split_whitespace()
            .map(|p| p.parse::<f64>().unwrap_or(f64::NAN));
        let mut next = || parts.next().unwrap_or(f64::NAN);
        let theirs = Rounds {
            best_per_s: next(),
            median_per_s: next(),
            understood: next() as u64,
        };
        row(&mut report, "pynmea2, parse", &theirs, sentences.len());
        println!(
            "ours over the crate {:.2}, over pynmea2 {:.0} (medians)",
            ours.median_per_s / crate_alone.median_per_s,
            ours.median_per_s / theirs.median_per_s
        );
    }
    report.finish(json)
}

struct Rounds {
    best_per_s: f64,
    median_per_s: f64,
    /// Mean length of the log's sentences.
    understood: u64,
}

fn rounds(count: usize, mut work: impl FnMut() -> u64) -> Rounds {
    let mut understood = 0;
    let mut rates: Vec<f64> = (0..ROUNDS)
        .map(|_| {
            let start = Instant::now();
            understood = work();
            count as f64 / start.elapsed().as_secs_f64()
        })
        .collect();
    rates.sort_by(f64::total_cmp);
    Rounds {
        best_per_s: rates[ROUNDS - 1],
        median_per_s: rates[ROUNDS / 2],
        understood,
    }
}

fn row(report: &mut Report, name: &str, r: &Rounds, of: usize) {
    report.row(
        &format!(
            "{name:28} understood {:5} of {of}, {:9.0} sentences/s median, {:9.0} best",
            r.understood, r.median_per_s, r.best_per_s
        ),
        serde_json::json!({
            "name": name,
            "understood": r.understood,
            "of": of,
            "median_per_s": r.median_per_s,
            "best_per_s": r.best_per_s,
        }),
    );
}

/// Best and median sentences per second, and the number decoded, from `tools/peers_nav.py`.
fn pynmea2(python: &Path, sentences: &[String], count: usize) -> Result<String, String> {
    let failed = |e: std::io::Error| format!("{}: {e}", python.display());
    let script = crate::repository().join("tools/peers_nav.py");
    let mut child = Command::new(python)
        .arg(script)
        .args([count.to_string(), ROUNDS.to_string()])
        .stdin(Stdio::piped())
        .stdout(Stdio::piped())
        .spawn()
        .map_err(failed)?;
    let mut input = child.stdin.take().ok_or("no pipe")?;
    std::io::Write::write_all(&mut input, sentences.join("\n").as_bytes()).map_err(failed)?;
    drop(input);
    let output = child.wait_with_output().map_err(failed)?;
    if !output.status.success() {
        return Err(format!("{}: {}", python.display(), output.status));
    }
    Ok(String::from_utf8_lossy(&output.stdout).trim().to_owned())
}

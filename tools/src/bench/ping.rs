//! Pings of a configuration through the whole pipeline: percentiles of the run time, and the result of the error check.
//!
//! Timed: from the ping request to its element samples, beams and side-scan lines (`Rig::make`). Not timed: records and delivery.
//! Pings follow each other without pacing, on the virtual time of the navigation.

use std::path::Path;
use std::time::Instant;

use echotank_config as config;
use echotank_ping::threads::pool;
use echotank_testing::pings::LoggedPings;

use crate::report::Report;

/// Number of untimed first pings, in which buffers grow and tiles are generated.
const WARM_UP: usize = 5;

/// Prints and records one line per number of threads.
pub(crate) fn run(file: &Path, quick: bool, json: Option<&Path>) -> Result<(), String> {
    let mut report = Report::new();
    let mut spec = echotank_runtime::config_files::load(file)
        .map_err(|e| format!("{}: {e:?}", file.display()))?;
    for sonar in &mut spec.sonars {
        sonar.synthesis.error_check = true;
    }
    let pings = if quick { 20 } else { 100 };
    for threads in [1, 2] {
        let line = pool(threads)
            .map_err(|e| e.to_string())?
            .install(|| pinged(&spec, pings))?;
        let PingTimes {
            mut ms,
            error,
            echoes,
        } = line;
        ms.sort_by(f64::total_cmp);
        let at = |share: f64| ms[((ms.len() - 1) as f64 * share).round() as usize];
        let synthesis = spec.sonars[0].model.synthesis.name();
        let error_text = error.map_or("no error check".into(), |e| format!("error {e:.1e}"));
        let line = format!(
            "{}, {synthesis}, {threads} threads, {} pings: {error_text}, ms median {:.1}, 95 % {:.1}, greatest {:.1}; {echoes} echoes in the last",
            file.display(),
            ms.len(),
            at(0.5),
            at(0.95),
            at(1.0)
        );
        let kept = serde_json::json!({
            "config": file.display().to_string(), "synthesis": synthesis, "threads": threads, "pings": ms.len(), "error": error,
            "ms_median": at(0.5), "ms_95": at(0.95), "ms_greatest": at(1.0), "echoes": echoes,
        });
        report.row(&line, kept);
    }
    report.finish(json)
}

struct PingTimes {
    ms: Vec<f64>,
    error: Option<f64>,
    echoes: u64,
}

fn pinged(spec: &config::spec::RigSpec, pings: usize) -> Result<PingTimes, String> {
    let ended = || "the navigation log ends before the pings do".to_string();
    let mut log = LoggedPings::open(spec)?.ok_or_else(ended)?;
    let mut done = PingTimes {
        ms: Vec::new(),
        error: None,
        echoes: 0,
    };
    for ping in 0..pings + WARM_UP {
        let order = log.next_order()?;
        if !log.cover(&order) {
            return Err(ended());
        }
        let start = Instant::now();
        log.make(&order)?;
        if ping >= WARM_UP {
            done.ms.push(start.elapsed().as_secs_f64() * 1e3);
        }
        done.error = log.slot.output.error_check.map(|c| c.error).or(done.error);
        done.echoes = log.slot.output.counts.used;
    }
    Ok(done)
}

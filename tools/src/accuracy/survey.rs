//! Stress test of streamed scenes. The seabed is 10 km x 1 km with 10 scatterers per 0.02 m^2, far beyond memory. Pings are 100 m
//! apart along it.
//!
//! For every tenth ping, the test prints:
//! - scatterers generated, used and in shadow;
//! - milliseconds to gather them and to synthesise;
//! - processor time of the whole ping, which other load affects less;
//! - peak memory so far;
//! - an error check.
//!
//! The error check repeats the ping and computes 64 random samples by the reference. It prints the error of these and of the
//! previous 64 samples. The exit code is 1 if the peak exceeds 2 GiB or an error check fails.

use std::fmt::Write as _;
use std::path::Path;
use std::time::Instant;

use clap::Args;

use echotank_core::frames::Trajectory;
use echotank_core::navigation::NavState;
use echotank_core::ping::PingOutput;
use echotank_core::scene::Scatterers;
use echotank_core::time::UtcNs;
use echotank_ping::pipeline::SonarPipeline;
use echotank_ping::{self as ping, PingOrder};
use echotank_runtime::io::files::FileSystem;
use echotank_scene::Scene;
use glam::{DQuat, DVec3};
use serde_json::json;

use crate::report::{Common, Report};

const LENGTH_M: f64 = 10_000.0;
const WIDTH_M: f64 = 1_000.0;
/// Cell of the height field.
const CELL_M: f64 = 4.0;
const DENSITY_PER_M2: f64 = 10.0 / 0.02;
const LIMIT_BYTES: u64 = 2 << 30;

#[derive(Args)]
#[command(
    about = "A survey of 10 km x 1 km at 10 points per 0.02 m^2 (5e9 scatterers): memory and milliseconds per ping along it"
)]
pub(crate) struct Arguments {
    #[command(flatten)]
    common: Common,
}

pub(crate) fn run(given: Arguments) -> Result<(), Box<dyn std::error::Error>> {
    let pings = if given.common.quick { 10 } else { 100 };
    let mut report = Report::new();
    let (peak, faults) = survey(tempfile::tempdir()?.path(), pings, &mut report)?;
    report.finish(given.common.json.as_deref())?;
    if peak.is_some_and(|bytes| bytes > LIMIT_BYTES) {
        return Err("peak memory above 2 GiB".into());
    }
    if faults > 0 {
        return Err(format!("{faults} error checks above 1.3 times the tolerance").into());
    }
    Ok(())
}

/// Returns the peak memory in bytes, if the system reports it, and the number of failed error checks.
fn survey(
    folder: &Path,
    pings: usize,
    report: &mut Report,
) -> Result<(Option<u64>, u32), Box<dyn std::error::Error>> {
    std::fs::write(folder.join("ground.asc"), ground())?;
    let spec = echotank_runtime::config_files::parse(&configuration(), folder)
        .map_err(|e| e.to_string())?;
    let sonar = &spec.sonars[0];
    let mut scene = Scene::open(&FileSystem, &spec.scene)?;
    let mut pipeline = SonarPipeline::new(sonar, &spec.medium)?;
    let mut plan = ping::blank(0, sonar, &spec.medium, 0.096);
    let (mut scatterers, mut output) = (Scatterers::default(), pipeline.blank_output());
    println!(
        "{LENGTH_M} m x {WIDTH_M} m, {:.1e} scatterers, {} threads, {:?}, tolerance {:e}, culled below {:.1} dB",
        LENGTH_M * WIDTH_M * DENSITY_PER_M2,
        rayon::current_num_threads(),
        sonar.model.synthesis,
        sonar.synthesis.tolerance,
        sonar.model.cull_db.unwrap_or(f64::NEG_INFINITY),
    );
    println!(
        " ping  north m      made      used  shadowed  gather ms  samples ms    CPU ms  peak MiB  error (95 %)"
    );
    let (mut times_ms, mut cpu_times_ms, mut faults) = (Vec::new(), Vec::new(), 0);
    pipeline.allow_error_checks(0.0);
    for ping in 0..pings {
        let north_m = LENGTH_M * ((ping as f64 + 0.5) / pings as f64 - 0.5);
        let order = PingOrder {
            ping_number: ping as u32 + 1,
            transmit_utc: UtcNs(0),
            settings: sonar.settings,
            period_s: 1.0,
        };
        plan.trajectory = Trajectory::uniform(
            DVec3::new(north_m, 0.0, 0.0),
            DVec3::new(2.5, 0.0, 0.0),
            DQuat::IDENTITY,
        );
        ping::fill(&mut plan, sonar, &order, NavState::default(), UtcNs(0));
        let cpu_begun_ms = cpu_ms();
        let begun = Instant::now();
        output.scene = scene.gather(pipeline.footprints(&plan), &mut scatterers);
        let gathered = Instant::now();
        pipeline.compute_ping(&plan, &scatterers, &mut output);
        let gather_ms = (gathered - begun).as_secs_f64() * 1e3;
        let samples_ms = gathered.elapsed().as_secs_f64() * 1e3;
        let spent_ms = cpu_ms() - cpu_begun_ms;
        times_ms.push(gather_ms + samples_ms);
        cpu_times_ms.push(spent_ms);
        if ping % (pings / 10).max(1) == 0 {
            pipeline.allow_error_checks(f64::INFINITY);
            pipeline.compute_ping(&plan, &scatterers, &mut output);
            pipeline.allow_error_checks(0.0);
            faults += u32::from(output.error_check.is_some_and(|c| c.fault));
            let times_ms = [gather_ms, samples_ms, spent_ms];
            report.row(
                &line(ping, north_m, &output, times_ms),
                json!({
                    "north_m": north_m, "scatterers": output.scene.scatterers, "gather_samples_cpu_ms": times_ms,
                    "peak_bytes": peak_bytes(), "error": output.error_check.map(|c| c.error),
                }),
            );
        }
    }
    let mean = |part: &[f64]| part.iter().sum::<f64>() / part.len() as f64;
    for (what, times_ms) in [
        ("ms per ping", &times_ms),
        ("CPU ms per ping", &cpu_times_ms),
    ] {
        // The first ping also designs the engine.
        let steady = &times_ms[1..];
        let third = steady.len() / 3;
        println!(
            "{what}: first third {:.0}, last third {:.0}, worst {:.0}",
            mean(&steady[..third]),
            mean(&steady[steady.len() - third..]),
            steady.iter().copied().fold(0.0, f64::max)
        );
    }
    Ok((peak_bytes(), faults))
}

fn line(
    ping: usize,
    north_m: f64,
    output: &PingOutput,
    [gather_ms, samples_ms, cpu_ms]: [f64; 3],
) -> String {
    let counts = &output.scene;
    format!(
        "{:5} {north_m:8.0} {:9} {:9} {:9} {gather_ms:10.1} {samples_ms:11.1} {cpu_ms:9.0} {:9}  {}",
        ping + 1,
        counts.made,
        counts.scatterers,
        counts.shadowed,
        peak_bytes().map_or("?".to_owned(), |b| (b >> 20).to_string()),
        output.error_check.map_or("none".to_owned(), |c| {
            format!("{:.1e} ({:.1e} to {:.1e})", c.error, c.low, c.high)
        }),
    )
}

/// Hills of one or two metres over tens of metres at 20 m depth, as an ESRI ASCII grid. At long range the hills cast shadows on one
/// another.
fn ground() -> String {
    let (rows, cols) = ((LENGTH_M / CELL_M) as usize, (WIDTH_M / CELL_M) as usize);
    let mut text = format!("ncols {cols} nrows {rows} xllcorner 0 yllcorner 0 cellsize {CELL_M}\n");
    for row in 0..rows {
        for col in 0..cols {
            let (n, e) = (row as f64 * CELL_M, col as f64 * CELL_M);
            let depth_m = 20.0
                + 0.6 * (n / 31.0).sin() * (e / 23.0).cos()
                + 0.4 * ((n + 2.0 * e) / 57.0).sin()
                + 0.8 * (n / 8.0).sin() * (e / 6.0).sin();
            let _ = write!(text, "{depth_m:.3} ");
        }
        text.push('\n');
    }
    text
}

fn configuration() -> String {
    let sides: String = [("port", 60), ("starboard", -60)]
        .map(|(name, roll_deg)| {
            format!(
                r#"[[sonar.transmit]]
name = "{name}"
roll_deg = {roll_deg}.0
pattern = "rectangle"
length_m = 0.24
width_m = 0.004
[[sonar.receive]]
name = "{name}"
transmit = "{name}"
elements = 1
spacing_m = 0.24
roll_deg = {roll_deg}.0
element_pattern = "rectangle"
element_length_m = 0.24
element_width_m = 0.004
"#
            )
        })
        .concat();
    format!(
        r#"
[[nav.source]]
name = "none"
kind = "udp"
listen = "127.0.0.1:10110"

[scene]
memory_mib = 512

[scene.seabed]
shape = "esri-ascii"
path = "ground.asc"
values = "depth"
density_per_m2 = {DENSITY_PER_M2}
bottom = "sand"

[[sonar]]
name = "side-scan"

[sonar.pulse]
kind = "lfm"
center_frequency_khz = 400.0
bandwidth_khz = 30.0
duration_ms = 2.0
taper = 0.1

{sides}[sonar.receiver]
sample_rate_khz = 60.0
rx_filter = "fir"
noise_db = "none"

[sonar.ping]
range_m = 150.0
rate_hz = 1.0
source_level_db = 210.0

[sonar.model]
path = "polyline"
doppler = "stretch"
synthesis = "gridded-1d"
tolerance = 1e-2
error_check = true
"#
    )
}

/// Peak resident memory of the process (Linux).
fn peak_bytes() -> Option<u64> {
    let status = std::fs::read_to_string("/proc/self/status").ok()?;
    let line = status.lines().find(|l| l.starts_with("VmHWM:"))?;
    let kib: u64 = line.split_whitespace().nth(1)?.parse().ok()?;
    Some(kib << 10)
}

/// Processor time of all threads of the process (Linux; 0 elsewhere), in steps of 10 ms.
fn cpu_ms() -> f64 {
    let ticks = || -> Option<f64> {
        let stat = std::fs::read_to_string("/proc/self/stat").ok()?;
        // Fields from 3 follow the name, which may contain blanks. User and system time are fields 14 and 15.
        let fields: Vec<&str> = stat.rsplit_once(')')?.1.split_whitespace().collect();
        Some(fields.get(11)?.parse::<f64>().ok()? + fields.get(12)?.parse::<f64>().ok()?)
    };
    10.0 * ticks().unwrap_or(0.0)
}

//! Rigs at the rates of their devices: the cost of a ping by stage, and its error against the reference.
//!
//! Timed: from the order of a ping to the records for a client of each output. Not timed: delivery and the operator's page, which
//! `tools/soak --rates` adds. Pings follow each other without pacing, on recorded navigation.

mod error;
mod picture;
mod records;

use std::path::Path;
use std::time::Instant;

use clap::Args;
use echotank_config::spec::RigSpec;
use echotank_core::simd::{Kind, SimdLevel};
use echotank_ping::make_ping::{choose_path, form, insonify, learn, predict, receive, synthesise};
use echotank_ping::ping_cost::{PingCost, speedup};
use echotank_ping::rig::{PingSlot, Rig};
use echotank_ping::threads::pool;
use echotank_ping::{PingOrder, period_ns};
use echotank_runtime::recorded::RecordedRig;
use echotank_runtime::rig::costs_of;
use serde::{Deserialize, Serialize};

use crate::report::{Common, Report, kept};
use records::Encoders;

/// Number of untimed first pings of each sonar, in which buffers grow and tiles are generated.
const WARM_UP: u32 = 2;
/// Minimum number of timed pings of each sonar.
const MIN_PINGS: usize = 3;
/// Maximum number of timed pings of each sonar.
const MAX_PINGS: u32 = 24;
/// Time after which no further ping is timed, seconds.
const MAX_TIME_S: f64 = 2.5;
/// Minimum headroom of real time. Delivery, page and system use the rest.
const REAL_TIME: f64 = 1.25;

#[derive(Args)]
pub(crate) struct Selection {
    #[command(flatten)]
    common: Common,
    /// Only these rigs
    #[arg(long)]
    rig: Vec<String>,
    /// Only ranges of this index, from 0
    #[arg(long)]
    range: Option<usize>,
    /// Computing threads
    #[arg(long, default_value_t = 2)]
    threads: usize,
    /// Leave out the comparison with the reference
    #[arg(long)]
    no_error: bool,
    /// Further overrides of every configuration
    #[arg(long, value_name = "KEY=VALUE")]
    set: Vec<String>,
    /// Write the rows to tools/kept/rates.json, in place of those of the same rigs and ranges, and draw hil-configs/rates.png; without AVX-512, to
    /// rates-avx2.json or rates-portable.json
    #[arg(long)]
    keep: bool,
}

/// The file `tools/rates.toml`.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Rates {
    rig: Vec<RigRates>,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct RigRates {
    name: String,
    #[serde(default)]
    set: Vec<String>,
    range: Vec<RangeRate>,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct RangeRate {
    range_m: f64,
    rate_hz: f64,
    #[serde(default)]
    set: Vec<String>,
}

impl Rates {
    fn read() -> Result<Self, String> {
        let path = crate::repository().join("tools/rates.toml");
        let told = |why: String| format!("{}: {why}", path.display());
        let text = std::fs::read_to_string(&path).map_err(|e| told(e.to_string()))?;
        toml::from_str(&text).map_err(|e| told(e.to_string()))
    }
}

impl RigRates {
    /// Configuration at one of the ranges. Buffers are sized for that range only.
    fn spec(&self, at: &RangeRate, more: &[String]) -> Result<RigSpec, String> {
        let path = crate::repository().join(format!("tools/rates/{}.toml", self.name));
        let RangeRate {
            range_m, rate_hz, ..
        } = at;
        let mut set = vec![
            format!("sonar.ping.range_m={range_m}"),
            format!("sonar.ping.rate_hz={rate_hz}"),
            format!("sonar.limits.range_m=[1.0, {range_m}]"),
            format!("sonar.limits.ping_rate_hz=[0.1, {rate_hz}]"),
        ];
        for further in [&self.set, &at.set, more] {
            set.extend(further.iter().cloned());
        }
        echotank_runtime::config_files::load_with(&path, &set).map_err(|e| e.to_string())
    }
}

/// Separately timed parts of a ping.
const STAGES: [&str; 7] = [
    "gather", "methods", "insonify", "echoes", "receiver", "beams", "records",
];
/// Choosing the path model, predicting the error, and learning from the ping.
const METHODS: usize = 1;

/// Times of the pings of one sonar.
struct Timed {
    period_ms: f64,
    /// Milliseconds of each ping, by stage.
    ms: Vec<[f64; STAGES.len()]>,
    scatterers: usize,
    record_bytes: usize,
    /// Cost estimate of the last ping.
    estimate: Option<PingCost>,
}

impl Timed {
    /// Median and 95 % quantile of whole pings, milliseconds.
    fn whole(&self) -> (f64, f64) {
        let mut whole: Vec<f64> = self.ms.iter().map(|ms| ms.iter().sum()).collect();
        whole.sort_by(f64::total_cmp);
        let at = |share: f64| whole[((whole.len() - 1) as f64 * share).round() as usize];
        (at(0.5), at(0.95))
    }

    fn stage_median(&self, stage: usize) -> f64 {
        let mut of: Vec<f64> = self.ms.iter().map(|ms| ms[stage]).collect();
        of.sort_by(f64::total_cmp);
        of[(of.len() - 1) / 2]
    }
}

/// Computes a ping that its navigation covers, with the time of each stage. `None` in a gap of the navigation.
fn timed_ping(
    rig: &mut Rig,
    sonar: usize,
    order: &PingOrder,
    slot: &mut PingSlot,
    encoders: &mut Encoders,
) -> Option<([f64; STAGES.len()], usize)> {
    let mode = rig.spec.nav.mode;
    let mut last = Instant::now();
    let mut lap = || {
        let now = Instant::now();
        let took = now.duration_since(std::mem::replace(&mut last, now));
        took.as_secs_f64() * 1e3
    };
    rig.prepare(sonar, order, mode, order.transmit_utc, slot)
        .ok()?;
    let mut ms = [0.0; STAGES.len()];
    ms[0] = lap();
    type Step = fn(&mut Rig, usize, &mut PingSlot);
    let steps: [(usize, Step); 7] = [
        (METHODS, choose_path),
        (2, insonify),
        (3, synthesise),
        (METHODS, predict),
        (4, receive),
        (5, form),
        (METHODS, learn),
    ];
    for (stage, step) in steps {
        step(rig, sonar, slot);
        ms[stage] += lap();
    }
    let bytes = encoders.encode(slot);
    ms[6] = lap();
    Some((ms, bytes))
}

/// Times pings of every sonar. Call inside the pool.
fn time(spec: &RigSpec, quick: bool) -> Result<Vec<Timed>, String> {
    let mut recorded = RecordedRig::open(spec).map_err(|e| e.to_string())?;
    let costs = costs_of(spec.run.costs.as_deref()).map_err(|e| e.to_string())?;
    let c = spec.medium.sound_speed_m_per_s;
    let mut sonars = Vec::new();
    for sonar in 0..spec.sonars.len() {
        let unit = &recorded.rig.sonars[sonar];
        let slot = recorded.rig.slot(sonar);
        let encoders = Encoders::new(spec, &unit.spec, unit.absorption_db_per_m);
        let timed = Timed {
            period_ms: period_ns(&unit.spec.settings, c) as f64 * 1e-6,
            ms: Vec::new(),
            scatterers: 0,
            record_bytes: 0,
            estimate: None,
        };
        sonars.push((slot, encoders, timed));
    }
    let pings = if quick { MIN_PINGS as u32 } else { MAX_PINGS };
    let start = Instant::now();
    while let Some((sonar, order)) = recorded.next_order(WARM_UP + pings) {
        let enough = sonars
            .iter()
            .all(|(_, _, timed)| timed.ms.len() >= MIN_PINGS);
        if enough && start.elapsed().as_secs_f64() > MAX_TIME_S {
            break;
        }
        recorded.record_pulse(sonar, &order);
        if !recorded.settle(sonar, &order) {
            break;
        }
        let (slot, encoders, timed) = &mut sonars[sonar];
        let Some((ms, bytes)) = timed_ping(&mut recorded.rig, sonar, &order, slot, encoders) else {
            continue;
        };
        if order.ping_number > WARM_UP {
            timed.ms.push(ms);
        }
        timed.scatterers = recorded.rig.scatterers().len();
        timed.record_bytes = bytes;
        let PingSlot { plan, output } = &*slot;
        let predicted_ms = output.methods.map(|mark| mark.predicted_ms);
        timed.estimate = predicted_ms.filter(|ms| ms.is_finite()).map(|ms| {
            let sonar = &recorded.rig.sonars[sonar].spec;
            PingCost::new(sonar, plan, &output.scene, ms, &costs)
        });
    }
    let timed: Vec<Timed> = sonars.into_iter().map(|(_, _, timed)| timed).collect();
    match timed.iter().any(|timed| timed.ms.is_empty()) {
        true => Err("the navigation log ends before the pings do".into()),
        false => Ok(timed),
    }
}

/// Part of a ping with its time.
#[derive(Serialize, Deserialize)]
struct Stage {
    name: String,
    ms: f64,
    /// Cost estimate; none for insonification, which is in that of the echoes, and for the methods.
    #[serde(default)]
    estimate_ms: Option<f64>,
}

/// Results of a rig at one range.
#[derive(Serialize, Deserialize)]
struct Row {
    rig: String,
    range_m: f64,
    threads: usize,
    elements: usize,
    beams: usize,
    scatterers: usize,
    /// Ping period of the first sonar.
    period_ms: f64,
    /// Median times of all sonars in one period of the first sonar, as all times in this type.
    stages: Vec<Stage>,
    ms: f64,
    ms_95: f64,
    headroom: f64,
    record_bytes: usize,
    /// Cost estimate on these threads.
    estimate_ms: Option<f64>,
    /// Largest error of the sampled windows, in this norm of docs/accuracy.md.
    error: Option<f64>,
    norm: String,
    tolerance: f64,
    processor: String,
}

impl Row {
    fn new(
        rig: &RigRates,
        at: &RangeRate,
        spec: &RigSpec,
        threads: usize,
        timed: &[Timed],
    ) -> Self {
        let period_ms = timed[0].period_ms;
        // Times refer to one period of the first sonar.
        let share = |timed: &Timed| period_ms / timed.period_ms;
        let sum = |of: &dyn Fn(&Timed) -> f64| timed.iter().map(|t| share(t) * of(t)).sum::<f64>();
        let ms = sum(&|t| t.whole().0);
        let estimate = |of: &dyn Fn(&PingCost) -> f64| -> Option<f64> {
            let each = timed.iter();
            each.map(|t| Some(share(t) * of(t.estimate.as_ref()?)))
                .sum()
        };
        let parallel = |of: fn(&PingCost) -> f64| estimate(&|cost| of(cost) / speedup(threads));
        let stage = |(stage, name): (usize, &&str)| Stage {
            name: (*name).to_owned(),
            ms: sum(&|t| t.stage_median(stage)),
            estimate_ms: match *name {
                "gather" => parallel(|cost| cost.gather_ms),
                // With insonification.
                "echoes" => parallel(|cost| cost.methods_ms),
                "receiver" => parallel(|cost| cost.receiver_ms),
                "beams" => parallel(|cost| cost.beams_ms),
                "records" => estimate(&|cost| cost.records_ms),
                _ => None,
            },
        };
        Self {
            rig: rig.name.clone(),
            range_m: at.range_m,
            threads,
            elements: spec
                .sonars
                .iter()
                .flat_map(|s| &s.receive)
                .map(|array| array.elements)
                .sum(),
            beams: spec
                .sonars
                .iter()
                .map(|s| s.beams.lines.len() + s.beams.fan.as_ref().map_or(0, |fan| fan.beams))
                .sum(),
            scatterers: timed.iter().map(|t| t.scatterers).sum(),
            period_ms,
            stages: STAGES.iter().enumerate().map(stage).collect(),
            ms,
            ms_95: sum(&|t| t.whole().1),
            headroom: period_ms / ms,
            record_bytes: timed.iter().map(|t| t.record_bytes).sum(),
            estimate_ms: estimate(&|cost| cost.wall_ms(threads)),
            error: None,
            norm: "W".to_owned(),
            tolerance: spec
                .sonars
                .iter()
                .map(|s| s.synthesis.tolerance)
                .fold(f64::INFINITY, f64::min),
            processor: crate::machine::processor(),
        }
    }

    fn line(&self) -> String {
        let estimate = self.estimate_ms;
        let told = |value: Option<f64>, form: fn(f64) -> String| value.map_or("-".into(), form);
        let stages: Vec<String> = self
            .stages
            .iter()
            .map(|stage| format!("{:>9.2}", stage.ms))
            .collect();
        format!(
            "{:<12} {:>5} {:>5} {:>5} {:>9} {} | {:>7.1} {:>7.1} {:>7.1} {:>6.2} | {:>7} {:>5} | {:>7} {:>7.0e}",
            self.rig,
            self.range_m,
            self.elements,
            self.beams,
            self.scatterers,
            stages.join(" "),
            self.ms,
            self.ms_95,
            self.period_ms,
            self.headroom,
            told(estimate, |ms| format!("{ms:.1}")),
            told(estimate.map(|ms| self.ms / ms), |ratio| format!(
                "{ratio:.1}"
            )),
            told(self.error, |error| format!("{error:.1e}")),
            self.tolerance,
        )
    }
}

fn head() -> String {
    let stages: Vec<String> = STAGES.iter().map(|name| format!("{name:>9}")).collect();
    format!(
        "{:<12} {:>5} {:>5} {:>5} {:>9} {} | {:>7} {:>7} {:>7} {:>6} | {:>7} {:>5} | {:>7} {:>7}",
        "rig",
        "m",
        "el.",
        "beams",
        "scatt.",
        stages.join(" "),
        "ms",
        "95 %",
        "period",
        "head.",
        "est. ms",
        "ratio",
        "error W",
        "toler."
    )
}

/// Prints and records one line per rig and range.
pub(crate) fn run(selection: &Selection) -> Result<(), String> {
    let rates = Rates::read()?;
    if let Some(unknown) = selection
        .rig
        .iter()
        .find(|name| !rates.rig.iter().any(|rig| rig.name == **name))
    {
        let known: Vec<&str> = rates.rig.iter().map(|rig| rig.name.as_str()).collect();
        return Err(format!(
            "--rig {unknown}: must be one of {}",
            known.join(", ")
        ));
    }
    let quick = selection.common.quick;
    let mut report = Report::new();
    println!(
        "ms of one period of each rig, medians, {} threads; \"est.\": of `echotank check`",
        selection.threads
    );
    println!("{}", head());
    let pool = pool(selection.threads).map_err(|e| e.to_string())?;
    let mut rows = Vec::new();
    for rig in &rates.rig {
        if !selection.rig.is_empty() && !selection.rig.contains(&rig.name) {
            continue;
        }
        for (index, at) in rig.range.iter().enumerate() {
            // The short form only tests that the command works.
            if selection.range.unwrap_or(if quick { 0 } else { index }) != index {
                continue;
            }
            let told = |why: String| format!("{} at {} m: {why}", rig.name, at.range_m);
            let spec = rig.spec(at, &selection.set).map_err(told)?;
            let row = pool.install(|| -> Result<Row, String> {
                let timed = time(&spec, quick)?;
                let mut row = Row::new(rig, at, &spec, selection.threads, &timed);
                if !selection.no_error {
                    row.error = error::largest(&spec, if quick { 1 } else { 3 })?;
                }
                Ok(row)
            });
            let row = row.map_err(told)?;
            let kept = serde_json::to_value(&row).map_err(|e| e.to_string())?;
            report.row(&row.line(), kept);
            rows.push(row);
        }
    }
    summarise(&rows);
    report.finish(selection.common.json.as_deref())?;
    match selection.keep {
        true => keep(rows, &rates, &mut report),
        false => Ok(()),
    }
}

/// Replaces the kept rows of the same rigs and ranges, in the order of the file, and draws all rows.
fn keep(rows: Vec<Row>, rates: &Rates, report: &mut Report) -> Result<(), String> {
    #[derive(Deserialize)]
    struct Table {
        rows: Vec<Row>,
    }
    // Times with different vectors do not compare.
    let name = match SimdLevel::best().kind() {
        Kind::Avx512 => "rates.json",
        Kind::Avx2 => "rates-avx2.json",
        Kind::Portable => "rates-portable.json",
    };
    let path = kept(name);
    let mut all = match std::fs::read_to_string(&path) {
        Ok(text) => {
            let before: Table = serde_json::from_str(&text)
                .map_err(|e| format!("{}: {e}; remove it", path.display()))?;
            before.rows
        }
        Err(_) => Vec::new(),
    };
    let place = |row: &Row| {
        let rig = rates.rig.iter().position(|rig| rig.name == row.rig)?;
        let of = &rates.rig[rig].range;
        Some((rig, of.iter().position(|at| at.range_m == row.range_m)?))
    };
    all.retain(|old| rows.iter().all(|new| place(new) != place(old)));
    all.extend(rows);
    // Rows that the file no longer lists are removed.
    all.retain(|row| place(row).is_some());
    all.sort_by_key(place);
    report.rows_anew(&all)?;
    report.finish(Some(&path))?;
    match name {
        "rates.json" => draw(&all, &crate::repository().join("hil-configs/rates.png")),
        _ => Ok(()),
    }
}

fn summarise(rows: &[Row]) {
    let count = |of: &dyn Fn(&&Row) -> bool| rows.iter().filter(of).count();
    let near = |row: &&Row| {
        let ratio = row.estimate_ms.map(|ms| row.ms / ms);
        ratio.is_some_and(|ratio| (1.0 / 1.5..=1.5).contains(&ratio))
    };
    let within = |row: &&Row| row.error.is_some_and(|error| error <= row.tolerance);
    println!(
        "headroom {REAL_TIME} or more: {} of {}; time within 1.5 times the estimate: {}; error within the tolerance: {}",
        count(&|row| row.headroom >= REAL_TIME),
        rows.len(),
        count(&near),
        count(&within)
    );
}

fn draw(rows: &[Row], path: &Path) -> Result<(), String> {
    let png = echotank_drawing::png(&picture::svg(rows)).map_err(|e| e.to_string())?;
    std::fs::write(path, png).map_err(|e| format!("{}: {e}", path.display()))?;
    println!("{}", path.display());
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Fraction of the period with echoes. A sonar pauses for a twentieth of the period.
    const SOUND_SHARE: f64 = 0.95;

    #[test]
    fn every_rate_is_kept_and_leaves_the_sound_its_time() {
        for rig in &Rates::read().expect("readable").rig {
            assert_eq!(rig.range.len(), 3, "{}", rig.name);
            for at in &rig.range {
                let spec = rig.spec(at, &[]).expect("a good configuration");
                let c = spec.medium.sound_speed_m_per_s;
                let limit_hz = SOUND_SHARE * c / (2.0 * at.range_m);
                let told = format!("{} at {} m: {} pings/s", rig.name, at.range_m, at.rate_hz);
                assert!(at.rate_hz <= limit_hz, "{told}, at most {limit_hz:.2}");
                for sonar in &spec.sonars {
                    let kept_hz = 1e9 / period_ns(&sonar.settings, c) as f64;
                    assert!(
                        (kept_hz / at.rate_hz - 1.0).abs() < 1e-6,
                        "{told}, {kept_hz:.2} kept"
                    );
                }
            }
        }
    }
}

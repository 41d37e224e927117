//! The chart as a text table, CSV and JSON.

use std::fmt::Write;

use serde_json::json;

use echotank_runtime::chart::work::Curve;
use echotank_runtime::chart::{Chart, Row};

use super::peers::Peer;

/// The machine and ping period of a chart.
pub(crate) struct ChartContext {
    pub(crate) machine: String,
    /// Load average before and after the measurement.
    pub(crate) load: (Option<f64>, Option<f64>),
    /// Ping period at the configured rate, milliseconds.
    pub(crate) period_ms: f64,
}

impl ChartContext {
    pub(crate) fn load_text(&self) -> String {
        match self.load {
            (Some(before), Some(after)) => format!("load {before:.1} to {after:.1}"),
            _ => "load unknown".to_owned(),
        }
    }
}

/// One line with the values that are common to all methods.
pub(crate) fn subtitle(chart: &Chart, about: &ChartContext) -> String {
    let reference = match chart.reference_error {
        Some((error, samples)) => {
            format!("reference solution within {error:.1e} of the reference at {samples} samples")
        }
        None => "reference solution not checked".to_owned(),
    };
    format!(
        "{} scatterers, {} elements, {} pings, {} threads; {reference}; {}, {}",
        chart.scatterers,
        chart.elements,
        chart.pings,
        chart.threads,
        about.machine,
        about.load_text()
    )
}

/// Marks of a row: configured, selected, on the Pareto front.
pub(crate) fn note(row: &Row) -> String {
    let words = [
        (row.configured, "configured"),
        (row.planned_ms.is_some(), "selected"),
        (row.pareto, "front"),
    ];
    let words: Vec<&str> = words.iter().filter(|w| w.0).map(|w| w.1).collect();
    words.join(", ")
}

pub(crate) fn text(chart: &Chart, curves: &[Curve], about: &ChartContext) -> String {
    let mut out = String::new();
    let _ = writeln!(out, "{}: {}", chart.sonar, subtitle(chart, about));
    let _ = writeln!(
        out,
        "gathering the scatterers takes {:.1} ms per ping with every method; ping period {:.0} ms",
        chart.gather_ms, about.period_ms
    );
    let _ = writeln!(
        out,
        "{:>10} {:>9} {:>9} {:>9} {:>8} {:>8}  method",
        "ms", "elements", "predicted", "lines", "image dB", "level dB"
    );
    let mut rows: Vec<&Row> = chart.rows.iter().collect();
    rows.sort_by(|a, b| {
        let ms = |row: &Row| {
            row.outcome
                .as_ref()
                .map_or(f64::INFINITY, |m| m.times.median_ms)
        };
        ms(a).total_cmp(&ms(b))
    });
    for row in rows {
        let _ = match &row.outcome {
            Ok(m) => writeln!(
                out,
                "{:>10.2} {:>9.1e} {:>9.1e} {:>9} {:>8} {:>8.3}  {}{}",
                m.times.median_ms,
                m.errors.elements,
                row.predicted_error,
                m.errors.lines.map_or("-".into(), |e| format!("{e:.1e}")),
                m.errors.image_db.map_or("-".into(), |e| format!("{e:.3}")),
                m.errors.level_db,
                row.method,
                match note(row) {
                    note if note.is_empty() => note,
                    note => format!("  <- {note}"),
                },
            ),
            Err(_) => Ok(()),
        };
    }
    for (methods, why) in refusals(chart) {
        let _ = writeln!(out, "   refused {methods}: {why}");
    }
    for curve in curves {
        let points: Vec<String> = curve
            .points
            .iter()
            .map(|(x, ms)| format!("{x}: {ms:.2} ms"))
            .collect();
        let exponent = curve
            .exponent
            .map_or("no exponent".into(), |p| format!("exponent {p:.2}"));
        let _ = writeln!(
            out,
            "cost against {} ({}): {exponent} ({})",
            curve.work.name(),
            curve.method,
            points.join(", ")
        );
    }
    out
}

/// Methods that do not apply, grouped by reason.
fn refusals(chart: &Chart) -> Vec<(String, &str)> {
    let mut reasons: Vec<(&str, Vec<String>)> = Vec::new();
    for row in &chart.rows {
        let Err(why) = &row.outcome else { continue };
        let engine = match row.method.tolerance > 0.0 {
            true => format!(
                "{} {:.0e}",
                row.method.synthesis.name(),
                row.method.tolerance
            ),
            false => row.method.synthesis.name().to_owned(),
        };
        match reasons.iter_mut().find(|(known, _)| known == why) {
            Some((_, engines)) if !engines.contains(&engine) => engines.push(engine),
            Some(_) => {}
            None => reasons.push((why, vec![engine])),
        }
    }
    reasons
        .into_iter()
        .map(|(why, engines)| (engines.join(", "), why))
        .collect()
}

pub(crate) fn csv(chart: &Chart, peers: &[Peer]) -> String {
    let mut out = String::from(
        "synthesis,tolerance,path,segment_s,doppler,configured,planned,front,median_ms,least_ms,greatest_ms,making_ms,predicted_error,element_error,worst_element_error,line_error,image_db,level_db,refused\n",
    );
    for row in &chart.rows {
        let method = &row.method;
        let _ = write!(
            out,
            "{},{},{},{},{},{},{},{},",
            method.synthesis.name(),
            method.tolerance,
            method.path.name(),
            method.segment_s,
            method.doppler.name(),
            row.configured,
            row.planned_ms.is_some(),
            row.pareto,
        );
        let option = |x: Option<f64>| x.map_or(String::new(), |x| format!("{x:e}"));
        let _ = match &row.outcome {
            Ok(m) => writeln!(
                out,
                "{:.4},{:.4},{:.4},{:.3},{:e},{:e},{:e},{},{},{:e},",
                m.times.median_ms,
                m.times.min_ms,
                m.times.max_ms,
                m.setup_ms,
                row.predicted_error,
                m.errors.elements,
                m.errors.worst_element,
                option(m.errors.lines),
                option(m.errors.image_db),
                m.errors.level_db,
            ),
            Err(why) => writeln!(
                out,
                ",,,,{:e},,,,,,\"{}\"",
                row.predicted_error,
                why.replace('"', "'")
            ),
        };
    }
    for peer in peers {
        let _ = writeln!(
            out,
            "\"peer: {}\",,,,,false,false,false,{:.4},,,,,{:e},,,,,",
            peer.name.replace('"', "'"),
            peer.here_ms(chart),
            peer.error
        );
    }
    out
}

pub(crate) fn json(
    chart: &Chart,
    curves: &[Curve],
    peers: &[Peer],
    about: &ChartContext,
) -> String {
    let rows: Vec<_> = chart.rows.iter().map(row).collect();
    let curves: Vec<_> = curves
        .iter()
        .map(|curve| {
            json!({
                "method": curve.method.to_string(),
                "work": curve.work.name(),
                "points": curve.points,
                "exponent": curve.exponent,
            })
        })
        .collect();
    let peers: Vec<_> = peers
        .iter()
        .map(|peer| {
            json!({
                "name": peer.name,
                "scatterers": peer.scatterers,
                "elements": peer.elements,
                "threads": peer.threads,
                "load": peer.load,
                "milliseconds": peer.milliseconds,
                "milliseconds_here": peer.here_ms(chart),
                "error": peer.error,
            })
        })
        .collect();
    let value = json!({
        "sonar": chart.sonar,
        "machine": about.machine,
        "load": [about.load.0, about.load.1],
        "scatterers": chart.scatterers,
        "elements": chart.elements,
        "pings": chart.pings,
        "threads": chart.threads,
        "tolerance": chart.tolerance,
        "period_ms": about.period_ms,
        "gather_ms": chart.gather_ms,
        "reference": chart.reference_error.map(|(error, samples)| json!({"error": error, "samples": samples})),
        "methods": rows,
        "work": curves,
        "peers": peers,
    });
    format!("{value:#}\n")
}

fn row(row: &Row) -> serde_json::Value {
    let method = &row.method;
    let mut value = json!({
        "name": method.to_string(),
        "synthesis": method.synthesis.name(),
        "tolerance": method.tolerance,
        "path": method.path.name(),
        "segment_s": method.segment_s,
        "doppler": method.doppler.name(),
        "configured": row.configured,
        "planned_ms": row.planned_ms,
        "front": row.pareto,
        "predicted_error": row.predicted_error,
    });
    match &row.outcome {
        Ok(m) => {
            value["median_ms"] = json!(m.times.median_ms);
            value["min_ms"] = json!(m.times.min_ms);
            value["greatest_ms"] = json!(m.times.max_ms);
            value["making_ms"] = json!(m.setup_ms);
            value["element_error"] = json!(m.errors.elements);
            value["worst_element_error"] = json!(m.errors.worst_element);
            value["line_error"] = json!(m.errors.lines);
            value["image_db"] = json!(m.errors.image_db);
            value["level_db"] = json!(m.errors.level_db);
        }
        Err(why) => value["refused"] = json!(why),
    }
    value
}

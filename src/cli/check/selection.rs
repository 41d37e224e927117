//! Report of the selected methods in `echotank check`, and calibration of costs.

use std::fmt::Write;
use std::path::Path;

use serde_json::{Value, json};

use crate::cli::Failure;
use crate::cli::chart::{load_average, machine};
use echotank_config::Finding;
use echotank_config::spec::{RigSpec, SonarSpec, SynthesisOutput};
use echotank_ping::method_selection::costs::Costs;
use echotank_ping::methods::{ALONG_PER_RANGE, Candidate, Family, Ranking};
use echotank_runtime::calibrate::{self, Calibration};
use echotank_runtime::check::{IMAGE_CELLS, SonarSelection, verdict};

/// Formats the report as text, a few lines per sonar. `all` adds every candidate.
pub(super) fn text(costs: &Costs, selections: &[SonarSelection], all: bool) -> String {
    let mut text = String::new();
    for selection in selections {
        let _ = write_sonar(&mut text, selection, all);
    }
    let _ = writeln!(text, "costs        {}", costs.machine);
    text
}

fn write_sonar(out: &mut String, selection: &SonarSelection, all: bool) -> std::fmt::Result {
    let name = &selection.sonar.name;
    let Some(ranking) = &selection.first.ranking else {
        return writeln!(out, "methods      {name}: no method suits this model");
    };
    let supposed = match selection.first.is_supposed {
        true => ", assumed motion: 5 knots, level (no recorded navigation)",
        false => "",
    };
    writeln!(
        out,
        "methods      {name}: ping {}, {} scatterers, {} samples of {} elements{supposed}",
        selection.first.plan.ping_number,
        selection.first.scatterers.len(),
        selection.first.plan.sample_count,
        elements(selection.sonar),
    )?;
    let chosen = ranking.chosen();
    let is_moving = !selection.first.scatterers.moving.is_empty();
    let families = Family::ALL.into_iter();
    for family in families.filter(|family| is_moving || *family != Family::Moving) {
        let part = chosen.part(family);
        writeln!(
            out,
            "  {:<10} {}{}: {:.1e}, {:.2} ms; {}{}",
            family.name(),
            part.choice,
            if is_auto(selection.sonar, family) {
                ""
            } else {
                " (as configured)"
            },
            part.error,
            part.cost_ms,
            match is_auto(selection.sonar, family) {
                true => ranking.reason(family),
                false => part.why.clone(),
            },
            match family {
                Family::Output => output(selection),
                _ => String::new(),
            }
        )?;
    }
    let asked = match ranking.goal.image_cells {
        None => format!("tolerance {:.1e}", ranking.goal.tolerance),
        Some(cells) => format!(
            "an image displacement of {cells} cells in range and {} along track, and {:.1e} of samples for synthesis and culling,",
            ALONG_PER_RANGE * cells,
            ranking.goal.tolerance
        ),
    };
    let verdict = match ranking.is_within() {
        true => "met",
        false => "NOT MET",
    };
    writeln!(
        out,
        "  {:<10} at most {:.1e} of element samples, {:.0} % of what {asked} allows: {verdict}{}",
        "error",
        chosen.error(),
        100.0 * ranking.goal.share(chosen),
        displaced(ranking, chosen)
    )?;
    if let Some(cost) = &selection.first.cost {
        let wall_ms = cost.wall_ms(selection.threads);
        writeln!(
            out,
            "  {:<10} {:.2} ms on one core, {wall_ms:.2} ms on {} threads; ping period {:.1} ms, margin {:.1} times",
            "cost",
            cost.core_ms(),
            selection.threads,
            selection.period_ms,
            selection.period_ms / wall_ms
        )?;
        let stages = cost.stages().map(|(name, ms)| format!("{name} {ms:.2}"));
        writeln!(out, "  {:<10} {} ms on one core", "", stages.join(", "))?;
    }
    if let Some(other) = ranking.next_cheaper() {
        writeln!(out, "  {:<10} {}", "cheaper", ranking.change(other))?;
    }
    if let Some(other) = ranking.next_costlier() {
        writeln!(out, "  {:<10} {}", "costlier", ranking.change(other))?;
    }
    if let Some(other) = ranking.other_output() {
        writeln!(out, "  {:<10} {}", "alternative", ranking.change(other))?;
    }
    for (what, why) in &ranking.refused {
        writeln!(out, "  {:<10} {what}: {why}", "refused")?;
    }
    if all {
        for candidate in &ranking.candidates {
            writeln!(
                out,
                "  {:>9.2} ms {:.1e} {} {}",
                candidate.cost_ms(),
                candidate.error(),
                if ranking.goal.meets(candidate) {
                    "+"
                } else {
                    "-"
                },
                candidate.text()
            )?;
        }
    }
    Ok(())
}

fn elements(sonar: &SonarSpec) -> usize {
    sonar.receive.iter().map(|array| array.elements).sum()
}

fn is_auto(sonar: &SonarSpec, family: Family) -> bool {
    let auto = sonar.synthesis.auto;
    match family {
        Family::Path => auto.path,
        Family::Doppler => auto.doppler,
        Family::Sum => auto.synthesis,
        Family::Culling => sonar.synthesis.culls_by_window,
        Family::Output => sonar.synthesis.output != SynthesisOutput::Elements,
        Family::Moving => false,
    }
}

fn displaced(ranking: &Ranking, candidate: &Candidate) -> String {
    match ranking.goal.image_cells {
        None => String::new(),
        Some(_) => format!(
            "; image displacement {:.2e} cells in range and {:.2e} along track",
            candidate.displaced.range_cells, candidate.displaced.along_cells
        ),
    }
}

/// Outputs that carry element samples, and the saving of a cheaper output.
fn output(selection: &SonarSelection) -> String {
    let sonar = selection.sonar;
    let lines = &sonar.beams.lines;
    let fans = usize::from(sonar.beams.fan.is_some());
    let readers = match sonar.element_readers() {
        of if of.is_empty() => "no output carries element samples".to_owned(),
        of => format!("element samples go to {}", of.join(", ")),
    };
    let mut text = format!("; {readers}; {} lines, {fans} fans", lines.len());
    if sonar.synthesis.output == SynthesisOutput::Elements && sonar.synthesis.elements_for.is_none()
    {
        text += "; output = \"auto\" would synthesise only side-scan lines where that is cheaper";
    }
    if let Some(ranking) = &selection.for_pictures {
        let _ = write!(
            text,
            "; with tolerance_image = {IMAGE_CELLS}, for images only, the choice is {}: {:.2} ms",
            ranking.chosen().text(),
            ranking.chosen().cost_ms()
        );
    }
    text
}

/// Formats the report as JSON.
pub(super) fn json(
    costs: &Costs,
    selections: &[SonarSelection],
    findings: &[Finding],
) -> Result<String, Failure> {
    let sonars: Vec<Value> = selections.iter().map(sonar_json).collect();
    let findings_json = findings.iter().map(|finding| {
        json!({
            "finding": finding.kind.name(),
            "text": finding.text,
            "remedy": finding.remedy,
        })
    });
    let value = json!({
        "verdict": verdict(findings),
        "findings": findings_json.collect::<Vec<_>>(),
        "costs": costs.machine,
        "sonars": sonars,
    });
    let text = serde_json::to_string_pretty(&value).map_err(Failure::running)?;
    Ok(text + "\n")
}

fn sonar_json(selection: &SonarSelection) -> Value {
    let mut value = json!({
        "name": selection.sonar.name,
        "motion": if selection.first.is_supposed { "supposed" } else { "recorded" },
        "ping_number": selection.first.plan.ping_number,
        "scatterers": selection.first.scatterers.len(),
        "elements": elements(selection.sonar),
        "samples": selection.first.plan.sample_count,
        "period_ms": selection.period_ms,
        "threads": selection.threads,
    });
    let Some(ranking) = &selection.first.ranking else {
        return value;
    };
    let families: Vec<Value> = Family::ALL
        .into_iter()
        .map(|family| {
            let part = ranking.chosen().part(family);
            json!({
                "family": family.name(),
                "choice": part.choice,
                "auto": is_auto(selection.sonar, family),
                "reason": ranking.reason(family),
                "error": part.error,
                "cost_ms": part.cost_ms,
            })
        })
        .collect();
    let one = |candidate: &Candidate| {
        json!({
            "choice": candidate.text(),
            "error": candidate.error(),
            "cost_ms": candidate.cost_ms(),
            "share": ranking.goal.share(candidate),
            "range_cells": candidate.displaced.range_cells,
            "along_cells": candidate.displaced.along_cells,
        })
    };
    value["element_readers"] = json!(selection.sonar.element_readers());
    value["elements_for"] = json!(selection.sonar.synthesis.elements_for);
    value["for_pictures"] = json!(selection.for_pictures.as_ref().map(|r| one(r.chosen())));
    value["tolerance"] = json!(ranking.goal.tolerance);
    value["tolerance_image"] = json!(ranking.goal.image_cells);
    value["within"] = json!(ranking.is_within());
    value["families"] = json!(families);
    value["chosen"] = one(ranking.chosen());
    if let Some(cost) = &selection.first.cost {
        let wall_ms = cost.wall_ms(selection.threads);
        value["cost_ms"] = json!({ "core": cost.core_ms(), "wall": wall_ms });
        value["cost_ms"]["stages"] = cost.stages().into_iter().collect();
        value["margin"] = json!(selection.period_ms / wall_ms);
    }
    value["next_cheaper"] = json!(ranking.next_cheaper().map(one));
    value["next_costlier"] = json!(ranking.next_costlier().map(one));
    value["other_output"] = json!(ranking.other_output().map(one));
    value["refused"] = json!(ranking.refused);
    value["candidates"] = json!(ranking.candidates.iter().map(one).collect::<Vec<_>>());
    value
}

/// Times the methods on this machine and writes the cost table.
pub(crate) fn calibrate(spec: &RigSpec, file: &Path) -> Result<(), Failure> {
    let costs = echotank_runtime::rig::costs_of(spec.run.costs.as_deref())
        .map_err(|why| Failure::Configuration(why.to_string()))?;
    let load = load_average().map_or("unknown".into(), |load| format!("{load:.1}"));
    let Calibration {
        costs,
        methods,
        before,
        after,
    } = calibrate::calibrate(spec, &costs, &format!("{}, load {load}", machine()))
        .map_err(Failure::running)?;
    std::fs::write(file, costs.text())
        .map_err(|why| Failure::Configuration(format!("{}: {why}", file.display())))?;
    let near = |(_, predicted_ms, took_ms): &&(String, f64, f64)| {
        (1.0 / 1.5..=1.5).contains(&(predicted_ms / took_ms))
    };
    let within = methods.iter().filter(near).count();
    println!(
        "{} methods timed on one thread. Ratio of predicted to measured cost (root mean square): {before:.2} with the previous table, {after:.2} with this one; {within} within 1.5",
        methods.len()
    );
    let mut worst: Vec<_> = methods.iter().collect();
    let off = |(_, predicted_ms, took_ms): &(String, f64, f64)| (predicted_ms / took_ms).ln().abs();
    worst.sort_by(|a, b| off(b).total_cmp(&off(a)));
    for (name, predicted_ms, took_ms) in worst.iter().take(12) {
        println!("  {took_ms:>8.2} ms, {predicted_ms:>8.2} predicted: {name}");
    }
    println!("wrote {}", file.display());
    Ok(())
}

//! What `echotank check` says of the plan of methods.

use std::fmt::Write;
use std::path::Path;

use serde_json::{Value, json};

use crate::cli::Failure;
use crate::cli::chart::{load_average, machine};
use echotank_config::spec::{MadeOutput, RigSpec, SonarSpec};
use echotank_ping::method_selection::costs::Costs;
use echotank_ping::method_selection::{Scene, Swell, rank};
use echotank_ping::methods::{ALONG_PER_RANGE, Candidate, Family, Ranking};
use echotank_ping::period_ns;
use echotank_ping::rig::pool;
use echotank_runtime::calibrate::{self, Calibration};
use echotank_runtime::first_pings::{FirstPing, first};

/// A tenth of a cell in range: what a picture bears where nobody looks at samples.
const PICTURE_CELLS: f64 = 0.1;

/// What is said about one sonar.
struct Told<'a> {
    sonar: &'a SonarSpec,
    first: FirstPing,
    /// The plan for pictures, where no output carries element samples and the tolerance is asked of them all the same.
    for_pictures: Option<Ranking>,
    period_ms: f64,
    threads: usize,
}

fn tell(spec: &RigSpec) -> Result<(Costs, Vec<Told<'_>>), Failure> {
    let refuse = |why: &dyn std::fmt::Display| Failure::Configuration(why.to_string());
    let costs =
        echotank_runtime::rig::costs_of(spec.run.costs.as_deref()).map_err(|why| refuse(&why))?;
    let pool = pool(spec.run.threads).map_err(Failure::running)?;
    let found = pool
        .install(|| first(spec, &costs))
        .map_err(|why| refuse(&why))?;
    let for_pictures: Vec<_> = spec
        .sonars
        .iter()
        .zip(&found)
        .map(|(sonar, first)| pool.install(|| for_pictures(spec, sonar, first, &costs)))
        .collect();
    let threads = pool.current_num_threads();
    let found = found.into_iter().zip(for_pictures);
    let told = spec.sonars.iter().zip(found);
    let told = told.map(|(sonar, (first, for_pictures))| Told {
        for_pictures,
        period_ms: 1e-6 * period_ns(&first.plan.settings, spec.medium.sound_speed_m_per_s) as f64,
        sonar,
        first,
        threads,
    });
    Ok((costs, told.collect()))
}

fn for_pictures(
    rig: &RigSpec,
    sonar: &SonarSpec,
    first: &FirstPing,
    costs: &Costs,
) -> Option<Ranking> {
    let synthesis = &sonar.synthesis;
    let asked = synthesis.auto.any() && synthesis.image_cells.is_none() && !synthesis.error_check;
    if !asked || !sonar.element_readers().is_empty() {
        return None;
    }
    let mut spec = sonar.clone();
    spec.synthesis.image_cells = Some(PICTURE_CELLS);
    let scene = Scene {
        spec: &spec,
        medium: &rig.medium,
        plan: &first.plan,
        scatterers: &first.scatterers,
        count: first.scatterers.len(),
        costs,
        swell: Swell::NONE,
    };
    rank(&scene, &[])
}

/// A few lines for each sonar.
pub(crate) fn text(spec: &RigSpec, all: bool) -> Result<String, Failure> {
    let (costs, told) = tell(spec)?;
    let mut text = String::new();
    for told in &told {
        let _ = write_sonar(&mut text, told, all);
    }
    let _ = writeln!(text, "costs        {}", costs.machine);
    Ok(text)
}

fn write_sonar(out: &mut String, told: &Told, all: bool) -> std::fmt::Result {
    let name = &told.sonar.name;
    let Some(ranking) = &told.first.ranking else {
        return writeln!(
            out,
            "plan         {name}: nothing can be made of this model"
        );
    };
    let supposed = match told.first.is_supposed {
        true => ", at 5 knots on a level keel, for want of recorded navigation",
        false => "",
    };
    writeln!(
        out,
        "plan         {name}: ping {}, {} scatterers, {} samples of {} elements{supposed}",
        told.first.plan.ping_number,
        told.first.scatterers.len(),
        told.first.plan.sample_count,
        elements(told.sonar),
    )?;
    let chosen = ranking.chosen();
    for family in Family::ALL {
        let part = chosen.part(family);
        writeln!(
            out,
            "  {:<10} {}{}: {:.1e}, {:.2} ms; {}{}",
            family.name(),
            part.choice,
            if is_auto(told.sonar, family) {
                ""
            } else {
                " (as configured)"
            },
            part.error,
            part.cost_ms,
            match is_auto(told.sonar, family) {
                true => ranking.reason(family),
                false => part.why.clone(),
            },
            match family {
                Family::Output => output(told),
                _ => String::new(),
            }
        )?;
    }
    let asked = match ranking.goal.image_cells {
        None => format!("tolerance {:.1e}", ranking.goal.tolerance),
        Some(cells) => format!(
            "a picture's {cells} cells in range and {} along the track, and {:.1e} of samples for synthesis and culling",
            ALONG_PER_RANGE * cells,
            ranking.goal.tolerance
        ),
    };
    let verdict = match ranking.is_within() {
        true => "within it",
        false => "NOT WITHIN IT",
    };
    writeln!(
        out,
        "  {:<10} {:.1e} of element samples at most, {:.0} % of what {asked} allows: {verdict}{}",
        "error",
        chosen.error(),
        100.0 * ranking.goal.share(chosen),
        displaced(ranking, chosen)
    )?;
    let wall_ms = chosen.cost_ms() / told.threads as f64;
    writeln!(
        out,
        "  {:<10} {:.2} ms of one core, {wall_ms:.2} ms on {} threads of {:.1} ms from ping to ping: {:.1} times as fast as it must be",
        "cost",
        chosen.cost_ms(),
        told.threads,
        told.period_ms,
        told.period_ms / wall_ms
    )?;
    if let Some(other) = ranking.next_cheaper() {
        writeln!(out, "  {:<10} {}", "cheaper", ranking.change(other))?;
    }
    if let Some(other) = ranking.next_dearer() {
        writeln!(out, "  {:<10} {}", "dearer", ranking.change(other))?;
    }
    if let Some(other) = ranking.other_output() {
        writeln!(out, "  {:<10} {}", "otherwise", ranking.change(other))?;
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
        Family::Culling => auto.cull,
        Family::Output => sonar.synthesis.output != MadeOutput::Elements,
    }
}

fn displaced(ranking: &Ranking, candidate: &Candidate) -> String {
    match ranking.goal.image_cells {
        None => String::new(),
        Some(_) => format!(
            "; things are displaced by {:.2e} cells in range and {:.2e} along the track",
            candidate.displaced.range_cells, candidate.displaced.along_cells
        ),
    }
}

/// Who reads what is made, and what would come of making less; behind the reason.
fn output(told: &Told) -> String {
    let sonar = told.sonar;
    let lines = &sonar.beams.lines;
    let fans = usize::from(sonar.beams.fan.is_some());
    let readers = match sonar.element_readers() {
        of if of.is_empty() => "no output carries elements".to_owned(),
        of => format!("elements are carried by {}", of.join(", ")),
    };
    let mut text = format!("; {readers}; {} lines, {fans} fans", lines.len());
    if sonar.synthesis.output == MadeOutput::Elements && sonar.synthesis.elements_for.is_none() {
        text += "; output = \"auto\" would make lines alone where that is cheaper";
    }
    if let Some(ranking) = &told.for_pictures {
        let _ = write!(
            text,
            "; for those who read pictures alone tolerance_image = {PICTURE_CELLS} would do with {}: {:.2} ms",
            ranking.chosen().text(),
            ranking.chosen().cost_ms()
        );
    }
    text
}

/// The same for programs.
pub(crate) fn json(spec: &RigSpec) -> Result<String, Failure> {
    let (costs, told) = tell(spec)?;
    let sonars: Vec<Value> = told.iter().map(sonar_json).collect();
    let value = json!({ "costs": costs.machine, "sonars": sonars });
    let text = serde_json::to_string_pretty(&value).map_err(Failure::running)?;
    Ok(text + "\n")
}

fn sonar_json(told: &Told) -> Value {
    let mut value = json!({
        "name": told.sonar.name,
        "motion": if told.first.is_supposed { "supposed" } else { "recorded" },
        "ping_number": told.first.plan.ping_number,
        "scatterers": told.first.scatterers.len(),
        "elements": elements(told.sonar),
        "samples": told.first.plan.sample_count,
        "period_ms": told.period_ms,
        "threads": told.threads,
    });
    let Some(ranking) = &told.first.ranking else {
        return value;
    };
    let families: Vec<Value> = Family::ALL
        .into_iter()
        .map(|family| {
            let part = ranking.chosen().part(family);
            json!({
                "family": family.name(),
                "choice": part.choice,
                "auto": is_auto(told.sonar, family),
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
    value["element_readers"] = json!(told.sonar.element_readers());
    value["elements_for"] = json!(told.sonar.synthesis.elements_for);
    value["for_pictures"] = json!(told.for_pictures.as_ref().map(|r| one(r.chosen())));
    value["tolerance"] = json!(ranking.goal.tolerance);
    value["tolerance_image"] = json!(ranking.goal.image_cells);
    value["within"] = json!(ranking.is_within());
    value["families"] = json!(families);
    value["chosen"] = one(ranking.chosen());
    value["margin"] = json!(told.period_ms * told.threads as f64 / ranking.chosen().cost_ms());
    value["next_cheaper"] = json!(ranking.next_cheaper().map(one));
    value["next_dearer"] = json!(ranking.next_dearer().map(one));
    value["other_output"] = json!(ranking.other_output().map(one));
    value["refused"] = json!(ranking.refused);
    value["candidates"] = json!(ranking.candidates.iter().map(one).collect::<Vec<_>>());
    value
}

/// Measures this machine and writes the table.
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
        "{} methods timed on one thread: costs predicted within a factor of {before:.2} by the table before, of {after:.2} by this one (root mean square), {within} of them within 1.5",
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

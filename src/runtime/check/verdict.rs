//! The verdict on a rig: whether it does what is meant, and what to change where it does not.

use echotank_config::spec::{ClockSpec, Density, OutputSpec, RigSpec};
use echotank_config::{self as config, Finding, FindingKind};
use echotank_ping::ping_cost::speedup;

use super::SonarSelection;

/// Least margin of real time: delivery, page and system use the rest.
const MIN_MARGIN: f64 = 1.25;
/// Least share of the scatterers that is proposed as a remedy.
const MIN_SHARE: f64 = 0.05;

/// Findings of the configuration, and of its first pings where they are planned.
pub fn findings(spec: &RigSpec, selections: &[SonarSelection]) -> Vec<Finding> {
    let mut found = Vec::new();
    found.extend(too_slow(spec, selections));
    found.extend(selections.iter().filter_map(inaccurate));
    if spec.scene.seabed.is_some() {
        found.extend(selections.iter().filter_map(no_seabed));
    }
    found.extend(selections.iter().filter_map(saturates));
    found.extend(config::findings(spec));
    found
}

/// The verdict in words.
pub fn verdict(findings: &[Finding]) -> String {
    let mut names: Vec<&str> = findings.iter().map(|f| f.kind.name()).collect();
    names.sort_unstable();
    names.dedup();
    match names.is_empty() {
        true => "works".to_owned(),
        false => names.join(", "),
    }
}

/// The findings with their remedies, and the verdict with its numbers.
pub fn text(spec: &RigSpec, selections: &[SonarSelection], findings: &[Finding]) -> String {
    let mut text = String::new();
    for Finding {
        kind,
        text: what,
        remedy,
    } in findings
    {
        text += &format!(
            "finding      {}: {what}\n  remedy     {remedy}\n",
            kind.name()
        );
    }
    let mut verdict = verdict(findings);
    if let Some(load) = load(spec, selections).filter(|_| findings.is_empty()) {
        let threads = selections.first().map_or(1, |s| s.threads);
        verdict += &format!(
            ": pings take {:.0} % of the time on {threads} threads",
            100.0 * load
        );
    }
    text + &format!("verdict      {verdict}\n")
}

/// Seconds of the rig for each second of the computer; none where pings are computed as fast as they can be.
fn speed(spec: &RigSpec) -> Option<f64> {
    match spec.run.clock {
        ClockSpec::RealTime => Some(1.0),
        ClockSpec::Scaled(speed) => Some(speed),
        ClockSpec::Fast | ClockSpec::Lockstep => None,
    }
}

/// Share of the time that the pings of all sonars take; none without real time or without a cost.
fn load(spec: &RigSpec, selections: &[SonarSelection]) -> Option<f64> {
    let speed = speed(spec)?;
    let of = |s: &SonarSelection| Some(s.first.cost.as_ref()?.wall_ms(s.threads) / s.period_ms);
    let load: Option<f64> = selections.iter().map(of).sum();
    load.filter(|_| !selections.is_empty())
        .map(|load| speed * load)
}

fn too_slow(spec: &RigSpec, selections: &[SonarSelection]) -> Option<Finding> {
    let load = load(spec, selections)?;
    let excess = MIN_MARGIN * load;
    if excess <= 1.0 {
        return None;
    }
    let (mut pings, mut rates, mut of_scatterers) = (Vec::new(), Vec::new(), 0.0);
    for selection in selections {
        let (cost, name) = (selection.first.cost?, &selection.sonar.name);
        let (threads, period_ms) = (selection.threads, selection.period_ms);
        pings.push(format!(
            "{name}: a ping takes {:.1} ms on {threads} threads, its period is {period_ms:.1} ms",
            cost.wall_ms(threads)
        ));
        rates.push(format!("{:.2}", 1e3 / period_ms / excess));
        of_scatterers += (cost.gather_ms + cost.methods_ms) / speedup(threads) / period_ms;
    }
    // What grows with the number of scatterers may take what the rest leaves.
    let of_scatterers = of_scatterers * speed(spec)?;
    let share = (1.0 / MIN_MARGIN - (load - of_scatterers)) / of_scatterers;
    let density = match spec.scene.seabed.as_ref().map(|seabed| seabed.density) {
        Some(Density::PerM2(per_m2)) if share > MIN_SHARE => {
            format!(
                ", or scene.seabed.density_per_m2 of at most {:.3}",
                share * per_m2
            )
        }
        _ => String::new(),
    };
    Some(Finding {
        kind: FindingKind::TooSlow,
        text: format!(
            "{}; {:.1} times what leaves a margin of {MIN_MARGIN}",
            pings.join("; "),
            excess
        ),
        remedy: format!(
            "sonar.ping.rate_hz of at most {}{density}, a shorter range, fewer elements or beams, or more cores",
            rates.join(" and ")
        ),
    })
}

fn inaccurate(selection: &SonarSelection) -> Option<Finding> {
    let sonar = selection.sonar;
    let (text, least) = match &selection.first.ranking {
        None => ("no method suits this model".to_owned(), None),
        Some(ranking) if ranking.is_within() => return None,
        Some(ranking) => {
            let (chosen, goal) = (ranking.chosen(), ranking.goal);
            let text = format!(
                "{} errs by up to {:.1e}, {:.1} times what a tolerance of {:.1e} allows",
                chosen.text(),
                chosen.error(),
                goal.share(chosen),
                goal.tolerance
            );
            (text, Some(goal.share(chosen) * goal.tolerance))
        }
    };
    let auto = sonar.synthesis.auto;
    let is_open = auto.path && auto.doppler && auto.synthesis;
    let remedy = match (is_open, least) {
        (true, Some(least)) => format!("sonar.model.tolerance of at least {least:.1e}"),
        _ => "path, doppler and synthesis = \"auto\" in [sonar.model]".to_owned(),
    };
    Some(Finding {
        kind: FindingKind::Inaccurate,
        text: format!("{}: {text}", sonar.name),
        remedy,
    })
}

/// Samples beyond the full scale of the converter, or of an output whose words have a fixed scale: JSF scales every ping, XTF every line, and the Ping
/// protocol sends decibels.
fn saturates(selection: &SonarSelection) -> Option<Finding> {
    let (sonar, peaks) = (selection.sonar, selection.peaks?);
    let has_fan = sonar.beams.fan.is_some();
    let has_lines = !sonar.beams.lines.is_empty();
    let mut levels = Vec::new();
    if sonar.receiver.adc_bits.is_some() {
        levels.push((peaks.element_v, "element samples", "the converter"));
    }
    for output in &sonar.outputs {
        match output {
            OutputSpec::SevenK(sevenk) => {
                if !sevenk.arrays.is_empty() {
                    levels.push((peaks.element_v, "element samples", "the words of 7k 7038"));
                }
                if has_fan {
                    levels.push((peaks.beam_v, "beams", "the words of 7k beams"));
                }
                if has_lines {
                    levels.push((peaks.line_v, "side-scan lines", "the words of 7k 7007"));
                }
            }
            OutputSpec::Wbms(_) => levels.push((peaks.beam_v, "beams", "the words of WBMS")),
            OutputSpec::Imagenex872(_) => {
                levels.push((peaks.line_v, "side-scan lines", "the bytes of Imagenex"));
            }
            OutputSpec::Vita49(_) => {
                levels.push((peaks.element_v, "element samples", "the words of VITA 49"));
            }
            OutputSpec::Elements(output) if !output.is_float => {
                levels.push((
                    peaks.element_v,
                    "element samples",
                    "the words of the element stream",
                ));
            }
            OutputSpec::Wav(output) if !output.is_float => {
                levels.push((peaks.element_v, "element samples", "the words of WAV"));
            }
            OutputSpec::Elements(_)
            | OutputSpec::Wav(_)
            | OutputSpec::Sigmf(_)
            | OutputSpec::Mcap(_)
            | OutputSpec::Jsf(_)
            | OutputSpec::Xtf(_)
            | OutputSpec::Ping(_) => {}
        }
    }
    let (peak_v, what, words) = levels.into_iter().max_by(|a, b| a.0.total_cmp(&b.0))?;
    let full_scale_v = sonar.receiver.full_scale_v;
    let excess_db = 20.0 * (peak_v / full_scale_v).log10();
    let gain_db = selection.first.plan.settings.gain_db;
    (excess_db > 0.0).then(|| Finding {
        kind: FindingKind::Saturates,
        text: format!(
            "{}: the {what} of the first ping reach {peak_v:.3} V, {excess_db:.1} dB above the full scale of {words} ({full_scale_v} V)",
            sonar.name
        ),
        remedy: format!(
            "sonar.ping.gain_db of at most {:.0}, a source level lower by {:.0} dB, or sonar.receiver.full_scale_v of at least {:.3}",
            (gain_db - excess_db).floor(),
            excess_db.ceil(),
            (1e3 * peak_v).ceil() / 1e3
        ),
    })
}

fn no_seabed(selection: &SonarSelection) -> Option<Finding> {
    let first = &selection.first;
    if first.scene.scatterers > 0 {
        return None;
    }
    let range_m = first.plan.settings.range_m;
    let (text, remedy) = match first.plan.sensor.altitude_m {
        Some(altitude_m) if altitude_m > range_m => (
            format!("it lies {altitude_m:.1} m below the sonar, the range is {range_m} m"),
            format!("sonar.ping.range_m above {altitude_m:.0}, or a shallower seabed"),
        ),
        Some(altitude_m) => (
            format!("it lies {altitude_m:.1} m below the sonar, within the range of {range_m} m, but the arrays do not look at it"),
            "roll_deg, pitch_deg and yaw_deg of the arrays; compare the lines `signs`".to_owned(),
        ),
        None => (
            "there is none below the sonar at the first ping".to_owned(),
            "scene.anchor and the offsets of the seabed; compare its extent with `echotank scene info`".to_owned(),
        ),
    };
    Some(Finding {
        kind: FindingKind::NoSeabed,
        text: format!("{}: {text}", selection.sonar.name),
        remedy,
    })
}

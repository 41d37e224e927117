//! From a campaign file to the manifest of its shards.

use std::path::Path;

use super::{CampaignError, CampaignFile, MANIFEST, Manifest, Run, Shard};
use super::{digest, json, own_simd, own_version, write_whole};
use crate::check::select_methods;
use crate::config_files::read_text;
use crate::replay::{Formats, use_navigation};

/// Maximum number of shards: more than the job arrays of schedulers take.
const MAX_SHARDS: u64 = 1_000_000;

/// Plans the campaign of a file and writes its manifest into `folder`. A folder with another manifest is refused; the same plan again is not.
///
/// # Errors
/// See [`CampaignError`].
pub fn plan(file: &Path, folder: &Path) -> Result<Manifest, CampaignError> {
    let name = file.display();
    let refuse = |why: String| CampaignError::Refused(format!("{name}: {why}"));
    let text = read_text(file).map_err(|why| refuse(format!("cannot be read: {why}")))?;
    let campaign: CampaignFile =
        toml::from_str(&text).map_err(|why| refuse(why.to_string().trim_end().to_owned()))?;
    let (first, last) = campaign.pings;
    if first == 0 || last < first {
        return Err(refuse(format!(
            "pings = [{first}, {last}]: pings are numbered from 1, and the last must not be below the first"
        )));
    }
    if campaign.shard_pings == 0 {
        return Err(refuse("shard_pings = 0: must be at least 1".into()));
    }
    let formats = Formats::of_names(&campaign.formats).map_err(refuse)?;
    let base = file.parent().unwrap_or(Path::new("."));
    let absolute = |path: &Path| {
        let path = base.join(path);
        path.canonicalize()
            .map_err(|why| refuse(format!("{}: {why}", path.display())))
    };
    let rig = absolute(&campaign.rig)?;
    let sets = combinations(&campaign)?;
    let logs = match campaign.logs.is_empty() {
        true => vec![None],
        false => campaign
            .logs
            .iter()
            .map(|log| absolute(log).map(Some))
            .collect::<Result<_, _>>()?,
    };
    let runs = (sets.len() * logs.len()) as u64;
    let each = u64::from((last - first) / campaign.shard_pings) + 1;
    if runs.saturating_mul(each) > MAX_SHARDS {
        return Err(refuse(format!(
            "{runs} runs of {each} shards: at most {MAX_SHARDS} shards; raise shard_pings"
        )));
    }
    let mut manifest = Manifest {
        version: own_version().to_owned(),
        simd: own_simd(),
        rig,
        formats: campaign.formats.clone(),
        runs: Vec::new(),
        shards: Vec::new(),
    };
    for (set, log) in sets
        .iter()
        .flat_map(|set| logs.iter().map(move |log| (set, log)))
    {
        let run = manifest.runs.len();
        let name = format!("run-{:04}", run + 1);
        let wrong = |error| CampaignError::Configuration {
            run: format!("{name} ({})", described(set, log.as_deref())),
            error,
        };
        let (mut spec, configuration) =
            digest::of_configuration(&manifest.rig, set, log.as_deref()).map_err(wrong)?;
        if let Some((format, lacks)) = formats.unfit(&spec) {
            return Err(refuse(format!(
                "formats: {format} would write nothing, because no sonar of {name} {lacks}"
            )));
        }
        if let Some(log) = log {
            use_navigation(&mut spec, log)
                .map_err(|why| refuse(format!("{}: {why}", log.display())))?;
        }
        let (_, selections) =
            select_methods(&spec).map_err(|why| refuse(format!("{name}: {why}")))?;
        let costs = selections.iter().filter_map(|s| s.first.cost.as_ref());
        let ping_s = costs.map(|cost| 1e-3 * cost.core_ms()).sum::<f64>();
        for from in (first..=last).step_by(campaign.shard_pings as usize) {
            let to = last.min(from.saturating_add(campaign.shard_pings - 1));
            manifest.shards.push(Shard {
                run,
                pings: (from, to),
                cost_s: ping_s * f64::from(to - from + 1),
            });
        }
        manifest.runs.push(Run {
            name,
            set: set.clone(),
            nav: log.clone(),
            configuration,
            pings: (first, last),
        });
    }
    let (path, text) = (folder.join(MANIFEST), json(&manifest)?);
    if path.exists() {
        let before = std::fs::read_to_string(&path).map_err(CampaignError::io(&path, "read"))?;
        if before == text {
            return Ok(manifest);
        }
        return Err(CampaignError::Refused(format!(
            "{}: is the manifest of another campaign, or the configuration has changed: use another folder",
            path.display()
        )));
    }
    std::fs::create_dir_all(folder).map_err(CampaignError::io(folder, "create"))?;
    write_whole(&path, &text)?;
    Ok(manifest)
}

/// Overrides of a run in words.
fn described(set: &[String], log: Option<&Path>) -> String {
    let log = log.map(|log| format!("log {}", log.display()));
    let all: Vec<String> = set.iter().cloned().chain(log).collect();
    match all.is_empty() {
        true => "no overrides".to_owned(),
        false => all.join(", "),
    }
}

/// Overrides of every run: each combination of the grid, and each seed.
fn combinations(campaign: &CampaignFile) -> Result<Vec<Vec<String>>, CampaignError> {
    let assign = |key: &str, value: &toml::Value| format!("{key}={value}");
    let mut sets = vec![
        campaign
            .set
            .iter()
            .map(|(key, value)| assign(key, value))
            .collect::<Vec<_>>(),
    ];
    let seeds = campaign.seeds.iter();
    let seeds: Vec<Vec<String>> = seeds
        .map(|seed| {
            vec![
                format!("scene.seed={seed}"),
                format!("sonar.receiver.seed={seed}"),
            ]
        })
        .collect();
    let grid = campaign.grid.iter().map(|(key, values)| {
        let each = values.iter().map(|value| vec![assign(key, value)]);
        (key.as_str(), each.collect::<Vec<_>>())
    });
    let seeds = (!seeds.is_empty()).then_some(("seeds", seeds));
    for (key, choices) in grid.chain(seeds) {
        if choices.is_empty() {
            return Err(CampaignError::Refused(format!(
                "grid: {key} has no value: give at least one"
            )));
        }
        let one = |set: &Vec<String>| {
            let with = |choice: &Vec<String>| [set.clone(), choice.clone()].concat();
            choices.iter().map(with).collect::<Vec<_>>()
        };
        sets = sets.iter().flat_map(one).collect();
    }
    Ok(sets)
}

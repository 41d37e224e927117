//! Joins the shards of each run.

use std::collections::BTreeMap;
use std::fmt;
use std::fs::File;
use std::io::{self, BufRead, BufReader, Read, Write};
use std::path::{Path, PathBuf};

use super::{CampaignError, Manifest, Run, shard, shard_folder};
use crate::io::record::{make_folder, npz_join, zarr};
use crate::replay::{Formats, Replay, ReplayOptions};

/// What a merge has written and compared.
#[derive(Clone, Debug, Default)]
pub struct Merged {
    /// Joined files.
    pub files: Vec<PathBuf>,
    /// Number of files that remain in their shards, because their format is not joined.
    pub left: usize,
    /// Results of the comparison with one replay of each run; empty without a check.
    pub compared: Vec<Compared>,
}

/// A joined file against that of one replay of the whole run.
#[derive(Clone, Debug)]
pub struct Compared {
    /// The joined file.
    pub file: PathBuf,
    /// First place that differs, such as `byte 12` or `line 3`; `None` if the files are equal.
    pub differs_at: Option<String>,
}

/// A joined file or store of a run.
struct Joined<'a> {
    /// Path below the folder of the run.
    name: &'a str,
    file: PathBuf,
    /// Files of a store; empty for a file.
    inner: Vec<PathBuf>,
}

impl fmt::Display for Merged {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        for file in &self.files {
            writeln!(f, "wrote {}", file.display())?;
        }
        if self.left > 0 {
            let left = self.left;
            writeln!(f, "{left} files of other formats remain in the shards")?;
        }
        for Compared { file, differs_at } in &self.compared {
            let name = file.display();
            match differs_at {
                None => writeln!(f, "{name}: equal to one replay")?,
                Some(at) => writeln!(f, "{name}: differs from one replay at {at}")?,
            }
        }
        Ok(())
    }
}

/// Joins truth.jsonl, pings.npz, pings.zarr and the masks of every run into `merged/RUN`. Verifies the checksums of all shards before. With `check_threads`,
/// replays every run as a whole on so many threads and compares: arrays byte for byte, and the truth line for line.
///
/// # Errors
/// Shards are missing, damaged, or of another version, processor or configuration: one line each, and nothing is written.
pub fn merge(
    folder: &Path,
    manifest: &Manifest,
    check_threads: Option<usize>,
) -> Result<Merged, CampaignError> {
    let damage: Vec<String> = (0..manifest.shards.len())
        .filter_map(|number| {
            let path = shard_folder(folder, number);
            match path.is_dir() {
                true => shard::damage(&path, manifest, number),
                false => Some(format!("shard {number}: is missing")),
            }
        })
        .collect();
    if !damage.is_empty() {
        return Err(CampaignError::Unfit(damage.join("\n")));
    }
    let mut merged = Merged::default();
    for (index, run) in manifest.runs.iter().enumerate() {
        let mut parts: BTreeMap<String, Vec<PathBuf>> = BTreeMap::new();
        for (number, part) in manifest.shards.iter().enumerate() {
            if part.run != index {
                continue;
            }
            let path = shard_folder(folder, number);
            let record = shard::record(&path).map_err(CampaignError::Unfit)?;
            for file in record.files {
                // The files of a store are joined together.
                let name = match file.name.split_once(".zarr/") {
                    Some((store, _)) => format!("{store}.zarr"),
                    None => file.name,
                };
                let of = path.join(&name);
                let parts = parts.entry(name).or_default();
                if parts.last() != Some(&of) {
                    parts.push(of);
                }
            }
        }
        let out = folder.join("merged").join(&run.name);
        let mut joined = Vec::new();
        for (name, parts) in &parts {
            let target = out.join(name);
            let paths: Vec<&Path> = parts.iter().map(PathBuf::as_path).collect();
            let mut inner = Vec::new();
            make_folder(target.parent().unwrap_or(&out))?;
            if name.ends_with(".npz") {
                npz_join::join(&paths, &target)?;
            } else if name.ends_with(".zarr") {
                inner = zarr::join(&paths, &target)?;
            } else if name.ends_with(".jsonl") {
                concatenate(parts, &target)?;
            } else {
                merged.left += parts.len();
                continue;
            }
            joined.push(Joined {
                name,
                file: target,
                inner,
            });
        }
        if let Some(threads) = check_threads {
            let whole = out.with_extension("check");
            let compared = compare(manifest, run, &joined, &whole, threads);
            // The replay is of no use after the comparison.
            let _ = std::fs::remove_dir_all(&whole);
            merged.compared.extend(compared?);
        }
        merged
            .files
            .extend(joined.into_iter().map(|joined| joined.file));
    }
    Ok(merged)
}

fn concatenate(parts: &[PathBuf], target: &Path) -> Result<(), CampaignError> {
    let beside = target.with_extension("partial");
    let mut whole = File::create(&beside).map_err(CampaignError::io(&beside, "create"))?;
    for part in parts {
        let mut file = File::open(part).map_err(CampaignError::io(part, "open"))?;
        io::copy(&mut file, &mut whole).map_err(CampaignError::io(&beside, "write"))?;
    }
    whole.flush().map_err(CampaignError::io(&beside, "write"))?;
    std::fs::rename(&beside, target).map_err(CampaignError::io(target, "rename"))
}

/// Replays a run as a whole into `whole` and compares the joined files.
fn compare(
    manifest: &Manifest,
    run: &Run,
    joined: &[Joined],
    whole: &Path,
    threads: usize,
) -> Result<Vec<Compared>, CampaignError> {
    let spec = shard::specification(manifest, run)?;
    let options = ReplayOptions {
        out: whole.to_owned(),
        formats: Formats::of_names(&manifest.formats).map_err(CampaignError::Refused)?,
        f64: false,
        pings: Some(run.pings),
        threads,
    };
    Replay::open(spec, options)
        .and_then(|replay| replay.run(|_| ()).map(|_| ()))
        .map_err(|error| CampaignError::Replay {
            what: run.name.clone(),
            error: Box::new(error),
        })?;
    joined
        .iter()
        .map(|Joined { name, file, inner }| {
            let other = whole.join(name);
            let differs_at = match name.ends_with(".jsonl") {
                true => first_other_line(file, &other).map(|at| at.map(|at| format!("line {at}"))),
                false if inner.is_empty() => {
                    first_other_byte(file, &other).map(|at| at.map(|at| format!("byte {at}")))
                }
                false => first_other_inner(file, &other, inner),
            };
            Ok(Compared {
                differs_at: differs_at.map_err(CampaignError::io(file, "compare"))?,
                file: file.clone(),
            })
        })
        .collect()
}

/// File and place of the first byte of a store that differs.
fn first_other_inner(one: &Path, other: &Path, inner: &[PathBuf]) -> io::Result<Option<String>> {
    for name in inner {
        if let Some(at) = first_other_byte(&one.join(name), &other.join(name))? {
            return Ok(Some(format!("byte {at} of {}", name.display())));
        }
    }
    Ok(None)
}

/// Number of the first line of ground truth that differs. Left out is what depends on the pings that the same process computed before: the tiles
/// of the seabed that were made, and the error check, whose windows it collects.
fn first_other_line(one: &Path, other: &Path) -> io::Result<Option<usize>> {
    let lines = |path: &Path| -> io::Result<Vec<serde_json::Value>> {
        let mut truths = Vec::new();
        for line in BufReader::new(File::open(path)?).lines() {
            let mut truth: serde_json::Value = serde_json::from_str(&line?)?;
            for (table, key) in [
                ("scene", "made"),
                ("scene", "culled"),
                ("scene", "tiles_made"),
                ("methods", "margin"),
            ] {
                if let Some(table) = truth.get_mut(table).and_then(|t| t.as_object_mut()) {
                    table.remove(key);
                }
            }
            if let Some(truth) = truth.as_object_mut() {
                truth.remove("error_check");
            }
            truths.push(truth);
        }
        Ok(truths)
    };
    let (one, other) = (lines(one)?, lines(other)?);
    let longest = one.len().max(other.len());
    Ok((0..longest)
        .find(|&k| one.get(k) != other.get(k))
        .map(|k| k + 1))
}

/// Place of the first byte that differs.
fn first_other_byte(one: &Path, other: &Path) -> io::Result<Option<u64>> {
    let mut one = BufReader::new(File::open(one)?).bytes();
    let mut other = BufReader::new(File::open(other)?).bytes();
    let mut at = 0;
    loop {
        match (one.next().transpose()?, other.next().transpose()?) {
            (None, None) => return Ok(None),
            (a, b) if a == b => at += 1,
            _ => return Ok(Some(at)),
        }
    }
}

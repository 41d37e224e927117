//! One shard: computed beside, then renamed.

use std::fs::{File, TryLockError};
use std::path::{Path, PathBuf};
use std::thread;
use std::time::Duration;

use super::{
    CampaignError, FileRecord, Manifest, RECORD, Run, ShardRecord, digest, json, own_simd,
    own_version, shard_folder, sync_folder, write_whole,
};
use crate::replay::{Formats, Replay, ReplayError, ReplayOptions, use_navigation};
use echotank_config::spec::RigSpec;

/// Tries to lock a shard before another worker counts as computing it, and time between them.
const LOCK_TRIES: u32 = 10;
const LOCK_INTERVAL: Duration = Duration::from_millis(50);

/// Whether a shard was computed or was there.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Computed {
    /// It has been computed.
    Now,
    /// It was complete, with the recorded checksums.
    Before,
}

/// Computes a shard, unless it is complete. `progress` is called with the number of every ping.
///
/// A worker that ends before leaves a folder with the suffix `.partial`, which the next worker replaces. A complete shard whose files have other
/// checksums is computed again.
///
/// # Errors
/// Another worker computes the shard; program, processor or configuration are not those of the plan; the disk is full.
pub fn compute(
    folder: &Path,
    manifest: &Manifest,
    number: usize,
    threads: usize,
    progress: impl FnMut(u32) + Send,
) -> Result<Computed, CampaignError> {
    let shard = manifest.shard(number)?;
    let run = &manifest.runs[shard.run];
    manifest.check_machine("this program", own_version(), &own_simd())?;
    let shards = folder.join("shards");
    std::fs::create_dir_all(&shards).map_err(CampaignError::io(&shards, "create"))?;
    let _lock = lock_for_work(folder, number)?;
    let target = shard_folder(folder, number);
    if target.exists() {
        if damage(&target, manifest, number).is_none() {
            return Ok(Computed::Before);
        }
        remove(&target)?;
    }
    let spec = specification(manifest, run)?;
    let beside = target.with_extension("partial");
    remove(&beside)?;
    let failed = |error: ReplayError| CampaignError::Replay {
        what: format!(
            "shard {number} ({}, pings {} to {})",
            run.name, shard.pings.0, shard.pings.1
        ),
        error: Box::new(error),
    };
    let options = ReplayOptions {
        out: beside.clone(),
        formats: Formats::of_names(&manifest.formats).map_err(CampaignError::Refused)?,
        f64: false,
        pings: Some(shard.pings),
        threads,
    };
    let replayed = Replay::open(spec, options).and_then(|replay| replay.run(progress).map(|_| ()));
    match replayed {
        // The navigation has a gap at every ping: a shard without files.
        Ok(()) | Err(ReplayError::NoPing(_)) => {}
        Err(error) => return Err(failed(error)),
    }
    std::fs::create_dir_all(&beside).map_err(CampaignError::io(&beside, "create"))?;
    let files = recorded(&beside)?;
    let record = ShardRecord {
        shard: number,
        version: own_version().to_owned(),
        simd: own_simd(),
        configuration: run.configuration.clone(),
        pings: shard.pings,
        files,
    };
    write_whole(&beside.join(RECORD), &json(&record)?)?;
    std::fs::rename(&beside, &target).map_err(CampaignError::io(&target, "rename"))?;
    sync_folder(&shards)?;
    Ok(Computed::Now)
}

/// The configuration of a run, as it was planned.
pub(super) fn specification(manifest: &Manifest, run: &Run) -> Result<RigSpec, CampaignError> {
    let wrong = |error| CampaignError::Configuration {
        run: run.name.clone(),
        error,
    };
    let (mut spec, configuration) =
        digest::of_configuration(&manifest.rig, &run.set, run.nav.as_deref()).map_err(wrong)?;
    if configuration != run.configuration {
        return Err(CampaignError::Unfit(format!(
            "{}: {} or a file that it names has changed since the campaign was planned: restore it, or plan a new campaign",
            run.name,
            manifest.rig.display()
        )));
    }
    if let Some(log) = &run.nav {
        use_navigation(&mut spec, log).map_err(|why| {
            CampaignError::Refused(format!("{}: {}: {why}", run.name, log.display()))
        })?;
    }
    Ok(spec)
}

/// Locks a shard for this process; `None` if another has it. The lock ends with its file or with the process.
fn lock(folder: &Path, number: usize) -> Result<Option<File>, CampaignError> {
    let path = shard_folder(folder, number).with_extension("lock");
    let file = File::create(&path).map_err(CampaignError::io(&path, "create"))?;
    match file.try_lock() {
        Ok(()) => Ok(Some(file)),
        Err(TryLockError::WouldBlock) => Ok(None),
        Err(TryLockError::Error(source)) => Err(CampaignError::io(&path, "lock")(source)),
    }
}

/// Locks a shard to compute it. A test of the lock by [`is_busy`] ends within the time that this waits.
fn lock_for_work(folder: &Path, number: usize) -> Result<File, CampaignError> {
    for _ in 0..LOCK_TRIES {
        if let Some(lock) = lock(folder, number)? {
            return Ok(lock);
        }
        thread::sleep(LOCK_INTERVAL);
    }
    Err(CampaignError::Busy(number))
}

/// Whether a worker computes a shard now.
pub(super) fn is_busy(folder: &Path, number: usize) -> Result<bool, CampaignError> {
    let path = shard_folder(folder, number).with_extension("lock");
    match path.exists() {
        true => lock(folder, number).map(|lock| lock.is_none()),
        false => Ok(false),
    }
}

fn remove(folder: &Path) -> Result<(), CampaignError> {
    match folder.exists() {
        true => std::fs::remove_dir_all(folder).map_err(CampaignError::io(folder, "remove")),
        false => Ok(()),
    }
}

/// Flushes the files of a folder and lists them with their checksums.
fn recorded(folder: &Path) -> Result<Vec<FileRecord>, CampaignError> {
    let mut files = Vec::new();
    for path in files_below(folder)? {
        let synced = File::open(&path).and_then(|file| file.sync_all());
        synced.map_err(CampaignError::io(&path, "flush"))?;
        let (bytes, sha256) = digest::of_file(&path).map_err(CampaignError::io(&path, "read"))?;
        let inner = path.strip_prefix(folder).unwrap_or(&path);
        let parts = inner.iter().map(|part| part.to_string_lossy());
        files.push(FileRecord {
            name: parts.collect::<Vec<_>>().join("/"),
            bytes,
            sha256,
        });
    }
    Ok(files)
}

/// Paths of the files of a folder and of those below it, sorted.
fn files_below(folder: &Path) -> Result<Vec<PathBuf>, CampaignError> {
    let list = |source| CampaignError::io(folder, "list")(source);
    let mut paths = Vec::new();
    for entry in std::fs::read_dir(folder).map_err(list)? {
        let path = entry.map_err(list)?.path();
        match path.is_dir() {
            true => paths.extend(files_below(&path)?),
            false => paths.push(path),
        }
    }
    paths.sort();
    Ok(paths)
}

/// Reads the record of a shard.
pub(super) fn record(folder: &Path) -> Result<ShardRecord, String> {
    let path = folder.join(RECORD);
    let text =
        std::fs::read_to_string(&path).map_err(|why| format!("{}: {why}", path.display()))?;
    serde_json::from_str(&text).map_err(|why| format!("{}: {why}", path.display()))
}

/// What is wrong with a complete shard; `None` if it has the pins of the manifest and its checksums.
pub(super) fn damage(folder: &Path, manifest: &Manifest, number: usize) -> Option<String> {
    let shard = manifest.shards[number];
    let found = match record(folder) {
        Ok(found) => found,
        Err(why) => return Some(why),
    };
    let what = format!("shard {number}");
    if let Err(why) = manifest.check_machine(&what, &found.version, &found.simd) {
        return Some(why.to_string());
    }
    let run = &manifest.runs[shard.run];
    if found.configuration != run.configuration
        || (found.shard, found.pings) != (number, shard.pings)
    {
        return Some(format!("{what}: is of another campaign or configuration"));
    }
    found.files.iter().find_map(|file| {
        let path = folder.join(&file.name);
        match digest::of_file(&path) {
            Ok((bytes, sha256)) if (bytes, &sha256) == (file.bytes, &file.sha256) => None,
            Ok(_) => Some(format!(
                "{}: has another checksum than recorded",
                path.display()
            )),
            Err(why) => Some(format!("{}: {why}", path.display())),
        }
    })
}

//! Campaigns: many replays of one rig, divided into shards that any scheduler can compute.
//!
//! A [`CampaignFile`] lists overrides, seeds, logs and pings. [`plan`] writes the [`Manifest`] of its shards. [`shard`] computes one of them:
//! it writes beside, flushes, renames, and records checksums, so that a shard exists whole or not at all and can be computed again at any time.
//! [`status`] counts them. [`merge`](merge::merge) joins the shards of each run.
//!
//! The manifest pins the version of the program, the vector instructions and a hash of each configuration with the files that it names. A shard of
//! another version, processor or configuration is refused. The program distributes nothing itself: see [`jobs`].

mod digest;
pub mod jobs;
pub mod merge;
pub mod plan;
pub mod shard;

use std::collections::BTreeMap;
use std::fs::File;
use std::io::{self, Write};
use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};
use thiserror::Error;

use crate::config_files::LoadError;
use crate::io::record::RecordError;
use crate::replay::ReplayError;
use echotank_core::simd::SimdLevel;

/// Name of the manifest in the folder of a campaign.
pub const MANIFEST: &str = "campaign.json";
/// Name of the record of a complete shard, in the folder of the shard.
const RECORD: &str = "shard.json";

/// Errors of a campaign.
#[derive(Debug, Error)]
pub enum CampaignError {
    /// The campaign file, the manifest or the request is wrong.
    #[error("{0}")]
    Refused(String),
    /// A configuration is wrong.
    #[error("run {run}: {error}")]
    Configuration {
        /// Name of the run.
        run: String,
        /// The cause.
        error: LoadError,
    },
    /// A replay cannot be opened, or fails.
    #[error("{what}: {error}")]
    Replay {
        /// Name of the run or number of the shard.
        what: String,
        /// The cause.
        error: Box<ReplayError>,
    },
    /// Another worker computes the shard.
    #[error("shard {0} is being computed by another worker")]
    Busy(usize),
    /// Shards are missing or do not fit together; one line each.
    #[error("{0}")]
    Unfit(String),
    /// A file of the campaign cannot be read or written.
    #[error("{}: cannot {action}: {source}", path.display())]
    Io {
        /// The file or folder.
        path: PathBuf,
        /// What failed, such as `write`.
        action: &'static str,
        /// The cause.
        source: io::Error,
    },
    /// A merged file cannot be written.
    #[error(transparent)]
    Record(#[from] RecordError),
}

impl CampaignError {
    fn io(path: &Path, action: &'static str) -> impl FnOnce(io::Error) -> Self {
        let path = path.to_owned();
        move |source| Self::Io {
            path,
            action,
            source,
        }
    }
}

/// A campaign as its author writes it (TOML).
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct CampaignFile {
    /// The configuration of the rig, relative to the campaign file.
    pub rig: PathBuf,
    /// First and last ping of each run, both included, from 1.
    pub pings: (u32, u32),
    /// Pings of each shard.
    #[serde(default = "CampaignFile::usual_shard_pings")]
    pub shard_pings: u32,
    /// What each shard writes, as `replay --formats`; truth.jsonl is always written.
    pub formats: Vec<String>,
    /// One set of runs for each seed of the scene and of the receiver noise.
    #[serde(default)]
    pub seeds: Vec<u64>,
    /// One set of runs for each navigation log, relative to the campaign file.
    #[serde(default)]
    pub logs: Vec<PathBuf>,
    /// Overrides of every run: key and value.
    #[serde(default)]
    pub set: BTreeMap<String, toml::Value>,
    /// One run for each combination of these values: key and values.
    #[serde(default)]
    pub grid: BTreeMap<String, Vec<toml::Value>>,
}

impl CampaignFile {
    fn usual_shard_pings() -> u32 {
        100
    }
}

/// A planned campaign.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Manifest {
    /// Version of the program that planned it.
    pub version: String,
    /// Vector instructions of the processor that planned it.
    pub simd: String,
    /// The configuration of the rig.
    pub rig: PathBuf,
    /// What each shard writes.
    pub formats: Vec<String>,
    /// Replays with overrides of their own.
    pub runs: Vec<Run>,
    /// Parts of the runs; a shard's number is its place.
    pub shards: Vec<Shard>,
}

/// A replay of a campaign.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Run {
    /// Name of its folder.
    pub name: String,
    /// Overrides `KEY=VALUE`.
    pub set: Vec<String>,
    /// Navigation in place of the configured one.
    pub nav: Option<PathBuf>,
    /// SHA-256 of the configuration with its overrides and of the files that it names.
    pub configuration: String,
    /// First and last ping, both included.
    pub pings: (u32, u32),
}

/// A range of pings of a run.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Shard {
    /// Index of its run.
    pub run: usize,
    /// First and last ping, both included.
    pub pings: (u32, u32),
    /// Estimated core time, seconds; 0 where no method suits the rig.
    pub cost_s: f64,
}

/// What a complete shard says of itself.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
struct ShardRecord {
    shard: usize,
    version: String,
    simd: String,
    configuration: String,
    pings: (u32, u32),
    files: Vec<FileRecord>,
}

/// A file of a shard.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
struct FileRecord {
    /// Path from the folder of the shard, with slashes.
    name: String,
    bytes: u64,
    sha256: String,
}

/// Version of this program.
fn own_version() -> &'static str {
    env!("CARGO_PKG_VERSION")
}

/// Vector instructions of this processor.
fn own_simd() -> String {
    format!("{:?}", SimdLevel::best().kind()).to_lowercase()
}

impl Manifest {
    /// Reads the manifest of a campaign.
    ///
    /// # Errors
    /// The file cannot be read or is not a manifest.
    pub fn read(folder: &Path) -> Result<Self, CampaignError> {
        let path = folder.join(MANIFEST);
        let text = std::fs::read_to_string(&path).map_err(CampaignError::io(&path, "read"))?;
        serde_json::from_str(&text).map_err(|why| {
            let name = path.display();
            CampaignError::Refused(format!("{name}: is not a manifest of this version: {why}"))
        })
    }

    /// The shard of a number.
    fn shard(&self, number: usize) -> Result<Shard, CampaignError> {
        self.shards.get(number).copied().ok_or_else(|| {
            let most = self.shards.len().saturating_sub(1);
            CampaignError::Refused(format!("shard {number}: must be from 0 to {most}"))
        })
    }

    /// Refuses a program or processor other than the one that planned the campaign: samples could differ in their last bits.
    fn check_machine(&self, what: &str, version: &str, simd: &str) -> Result<(), CampaignError> {
        for (of, own, planned) in [
            ("version", version, &self.version),
            ("vector instructions", simd, &self.simd),
        ] {
            if own != planned {
                return Err(CampaignError::Unfit(format!(
                    "{what}: {of} {own}, but the campaign was planned with {planned}: plan it anew, or use the same"
                )));
            }
        }
        Ok(())
    }
}

fn shard_folder(folder: &Path, number: usize) -> PathBuf {
    folder.join("shards").join(format!("{number:06}"))
}

/// Writes a file that appears whole or not at all.
fn write_whole(path: &Path, text: &str) -> Result<(), CampaignError> {
    let beside = path.with_extension("partial");
    let mut file = File::create(&beside).map_err(CampaignError::io(&beside, "create"))?;
    file.write_all(text.as_bytes())
        .and_then(|()| file.sync_all())
        .map_err(CampaignError::io(&beside, "write"))?;
    std::fs::rename(&beside, path).map_err(CampaignError::io(path, "rename"))?;
    match path.parent() {
        Some(parent) => sync_folder(parent),
        None => Ok(()),
    }
}

/// Makes new names in a folder survive a loss of power.
fn sync_folder(folder: &Path) -> Result<(), CampaignError> {
    let synced = File::open(folder).and_then(|folder| folder.sync_all());
    synced.map_err(CampaignError::io(folder, "flush"))
}

fn json<T: Serialize>(value: &T) -> Result<String, CampaignError> {
    serde_json::to_string_pretty(value)
        .map(|text| text + "\n")
        .map_err(|why| CampaignError::Refused(why.to_string()))
}

/// State of the shards of a campaign.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Status {
    /// Complete shards.
    pub complete: Vec<usize>,
    /// Shards that a worker computes now.
    pub busy: Vec<usize>,
    /// Shards that no worker computes.
    pub missing: Vec<usize>,
}

/// Counts the shards of a campaign by their state. Checksums are left to [`merge::merge`].
///
/// # Errors
/// A lock cannot be tested.
pub fn status(folder: &Path, manifest: &Manifest) -> Result<Status, CampaignError> {
    let mut status = Status::default();
    for number in 0..manifest.shards.len() {
        let list = match shard_folder(folder, number).join(RECORD).is_file() {
            true => &mut status.complete,
            false if shard::is_busy(folder, number)? => &mut status.busy,
            false => &mut status.missing,
        };
        list.push(number);
    }
    Ok(status)
}

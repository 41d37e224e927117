//! `echotank campaign`: many replays of one rig, in shards for a scheduler.

use std::path::PathBuf;
use std::process::Command;
use std::sync::atomic::{AtomicUsize, Ordering};

use clap::{Args, Subcommand};
use indicatif::ProgressBar;

use super::Failure;
use echotank_runtime::campaign::merge::merge;
use echotank_runtime::campaign::plan::plan;
use echotank_runtime::campaign::shard::{Computed, compute};
use echotank_runtime::campaign::{CampaignError, Manifest, jobs, status};

#[derive(Args, Clone, Debug)]
pub(crate) struct CampaignArgs {
    #[command(subcommand)]
    command: CampaignCommand,
}

#[derive(Subcommand, Clone, Debug)]
enum CampaignCommand {
    /// Divide a campaign into shards and write its manifest, campaign.json
    Plan(PlanArgs),
    /// Compute one shard, or all that are missing
    Run(RunArgs),
    /// Count complete, running and missing shards; exit status 1 unless all are complete
    Status {
        /// Folder of the campaign
        folder: PathBuf,
    },
    /// Join the shards of each run: truth.jsonl, pings.npz and masks
    Merge(MergeArgs),
}

#[derive(Args, Clone, Debug)]
struct PlanArgs {
    /// Campaign file (TOML)
    campaign: PathBuf,
    /// Folder for the manifest, the shards and the results
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
    /// Also write a batch script for Slurm: a job array, one task for each shard
    #[arg(long, value_name = "FILE")]
    slurm: Option<PathBuf>,
    /// Also write an Indexed Job for Kubernetes
    #[arg(long, value_name = "FILE")]
    kubernetes: Option<PathBuf>,
    /// Cores of each task of a scheduler
    #[arg(long, default_value_t = 1, value_parser = clap::value_parser!(u16).range(1..))]
    cores: u16,
}

#[derive(Args, Clone, Debug)]
struct RunArgs {
    /// Folder of the campaign
    folder: PathBuf,
    /// Only this shard, from 0
    #[arg(long, value_name = "K")]
    shard: Option<usize>,
    /// Shards computed at a time on this computer
    #[arg(long, default_value_t = 1, conflicts_with = "shard", value_parser = clap::value_parser!(u16).range(1..))]
    jobs: u16,
    /// Threads of each shard; 0 means one per core divided by --jobs
    #[arg(long, default_value_t = 0)]
    threads: usize,
}

#[derive(Args, Clone, Debug)]
struct MergeArgs {
    /// Folder of the campaign
    folder: PathBuf,
    /// Replay every run as a whole and compare: arrays byte for byte, truth.jsonl line for line; exit status 1 if they differ
    #[arg(long)]
    check: bool,
}

pub(crate) fn main(args: &CampaignArgs) -> Result<(), Failure> {
    match &args.command {
        CampaignCommand::Plan(args) => plan_main(args),
        CampaignCommand::Run(args) => run_main(args),
        CampaignCommand::Status { folder } => {
            let manifest = Manifest::read(folder).map_err(failure)?;
            let found = status(folder, &manifest).map_err(failure)?;
            println!(
                "{} of {} shards complete, {} running, {} missing",
                found.complete.len(),
                manifest.shards.len(),
                found.busy.len(),
                found.missing.len()
            );
            match found.complete.len() == manifest.shards.len() {
                true => Ok(()),
                false => Err(Failure::Findings),
            }
        }
        CampaignCommand::Merge(args) => {
            let manifest = Manifest::read(&args.folder).map_err(failure)?;
            let merged =
                merge(&args.folder, &manifest, args.check.then_some(0)).map_err(failure)?;
            print!("{merged}");
            match merged.compared.iter().any(|one| one.differs_at.is_some()) {
                true => Err(Failure::Findings),
                false => Ok(()),
            }
        }
    }
}

fn failure(error: CampaignError) -> Failure {
    match error {
        CampaignError::Refused(_) | CampaignError::Configuration { .. } => {
            Failure::Configuration(error.to_string())
        }
        _ => Failure::running(error),
    }
}

fn plan_main(args: &PlanArgs) -> Result<(), Failure> {
    let manifest = plan(&args.campaign, &args.out).map_err(failure)?;
    let cost_s: f64 = manifest.shards.iter().map(|shard| shard.cost_s).sum();
    println!(
        "{} runs, {} shards, an estimated {cost_s:.0} s on one core",
        manifest.runs.len(),
        manifest.shards.len()
    );
    let write = |path: &PathBuf, text: String| {
        std::fs::write(path, text)
            .map_err(|why| Failure::running(format!("{}: {why}", path.display())))?;
        println!("wrote {}", path.display());
        Ok(())
    };
    let cores = usize::from(args.cores);
    let folder = std::path::absolute(&args.out).map_err(Failure::running)?;
    if let Some(path) = &args.slurm {
        let program = std::env::current_exe().map_err(Failure::running)?;
        write(path, jobs::slurm(&manifest, &folder, &program, cores))?;
    }
    if let Some(path) = &args.kubernetes {
        write(path, jobs::kubernetes(&manifest, &folder, cores))?;
    }
    Ok(())
}

fn run_main(args: &RunArgs) -> Result<(), Failure> {
    let manifest = Manifest::read(&args.folder).map_err(failure)?;
    if let Some(number) = args.shard {
        let computed = compute(&args.folder, &manifest, number, args.threads, |_| ());
        let words = match computed.map_err(failure)? {
            Computed::Now => "computed",
            Computed::Before => "complete already",
        };
        println!("shard {number}: {words}");
        return Ok(());
    }
    let missing = status(&args.folder, &manifest).map_err(failure)?.missing;
    let jobs = usize::from(args.jobs);
    let threads = match args.threads {
        0 => std::thread::available_parallelism().map_or(1, |n| n.get().div_ceil(jobs)),
        threads => threads,
    };
    let program = std::env::current_exe().map_err(Failure::running)?;
    let bar = ProgressBar::new(missing.len() as u64);
    let next = AtomicUsize::new(0);
    // Each shard is a process of its own, as under a scheduler: one that fails or is killed leaves the others alone.
    let worker = || {
        let mut failed = Vec::new();
        while let Some(number) = missing.get(next.fetch_add(1, Ordering::Relaxed)) {
            let done = Command::new(&program)
                .args(["campaign", "run"])
                .arg(&args.folder)
                .args([
                    "--shard",
                    &number.to_string(),
                    "--threads",
                    &threads.to_string(),
                ])
                .output();
            match done {
                Ok(done) if done.status.success() => {}
                Ok(done) => {
                    failed.push(String::from_utf8_lossy(&done.stderr).trim().to_owned());
                }
                Err(why) => failed.push(format!("shard {number}: {why}")),
            }
            bar.inc(1);
        }
        failed
    };
    let failed: Vec<String> = std::thread::scope(|scope| {
        let workers: Vec<_> = (0..jobs).map(|_| scope.spawn(worker)).collect();
        let joined = workers.into_iter().filter_map(|worker| worker.join().ok());
        joined.flatten().collect()
    });
    bar.finish_and_clear();
    println!("{} shards computed", missing.len() - failed.len());
    match failed.is_empty() {
        true => Ok(()),
        false => Err(Failure::Running(failed.join("\n"))),
    }
}

//! tools/fuzz: feeds corrupted files to the readers until stopped. A panic or an excessive allocation ends it and keeps the file.

use std::collections::BTreeMap;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::process::ExitCode;
use std::time::{Duration, Instant};

use clap::{Parser, ValueEnum};
use echotank_testing::{allocations, seeds};

#[global_allocator]
static COUNTING: allocations::Counting = allocations::Counting;

/// Limit on allocation: the largest grid as f64 and f32, plus the memory for decoding.
const MAX_BYTES: usize = 1 << 30;

#[derive(Parser)]
#[command(
    about = "Feed corrupted files to the readers and check that they are read or refused without a panic and within the memory limit"
)]
struct Args {
    #[arg(value_enum)]
    what: FuzzCommand,
    #[arg(long, default_value_t = 60.0)]
    seconds: f64,
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// Only files whose name contains this
    #[arg(long, default_value = "")]
    only: String,
}

#[derive(Clone, ValueEnum)]
enum FuzzCommand {
    /// Readers of seabeds and models
    Scene,
}

fn main() -> ExitCode {
    let args = Args::parse();
    let FuzzCommand::Scene = args.what;
    let mut files = seeds::small();
    files.push(seeds::bag());
    files.retain(|f| f.name.contains(&args.only));
    let mut random = seeds::Random(args.seed.wrapping_mul(0x9e37_79b9_7f4a_7c15) | 1);
    let end = Instant::now() + Duration::from_secs_f64(args.seconds.clamp(0.0, 1e7));
    let mut counts: BTreeMap<&str, [u64; 2]> = BTreeMap::new();
    let mut most = 0;
    while Instant::now() < end {
        for file in &files {
            // The large file takes as long as a hundred small files.
            let rounds = if file.bytes.len() > 1 << 20 { 1 } else { 100 };
            for _ in 0..rounds {
                let bytes = seeds::spoiled(&file.bytes, &mut random);
                let before = allocations::in_use();
                allocations::reset();
                let copy = bytes.clone();
                let done = catch_unwind(AssertUnwindSafe(|| seeds::open(file.name, copy)));
                let taken = allocations::highest().saturating_sub(before);
                most = most.max(taken);
                let (Ok(result), true) = (done, taken <= MAX_BYTES) else {
                    let path = std::env::temp_dir().join(format!("fuzz-found-{}", file.name));
                    let kept = std::fs::write(&path, bytes);
                    println!(
                        "FOUND in {}: {taken} bytes allocated; file kept as {} ({kept:?})",
                        file.name,
                        path.display()
                    );
                    return ExitCode::FAILURE;
                };
                counts.entry(file.name).or_default()[usize::from(result.is_err())] += 1;
            }
        }
    }
    for (name, [read, refused]) in counts {
        println!("{name:16} {read:8} read {refused:8} refused");
    }
    println!("no panic; peak allocation {most} bytes");
    ExitCode::SUCCESS
}

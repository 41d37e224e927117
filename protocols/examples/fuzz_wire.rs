//! `tools/fuzz wire`: corrupts messages for every decoder. A panic ends the run, and the message is kept in a file.

#[path = "../tests/it/fuzz/cases.rs"]
mod cases;

use std::panic::{AssertUnwindSafe, catch_unwind};
use std::process::ExitCode;
use std::time::Instant;

use cases::{Random, decoders};

fn main() -> ExitCode {
    let mut cases: u64 = 100_000;
    let mut seed: u64 = 1;
    let mut only = String::new();
    let mut words = std::env::args().skip(1);
    while let Some(word) = words.next() {
        let value = words.next().unwrap_or_default();
        let read = match word.as_str() {
            "--cases" => value.replace('_', "").parse().map(|n| cases = n).is_ok(),
            "--seed" => value.parse().map(|n| seed = n).is_ok(),
            "--only" => {
                only = value;
                true
            }
            _ => false,
        };
        if !read {
            eprintln!("usage: tools/fuzz wire [--cases N] [--seed N] [--only DECODER]");
            return ExitCode::from(2);
        }
    }
    for decoder in decoders().into_iter().filter(|d| d.name.contains(&only)) {
        let seeds = decoder.seeds();
        let mut random = Random(seed.wrapping_mul(0x9E37_79B9_7F4A_7C15) | 1);
        let (began, mut lines, mut longest) = (Instant::now(), 0, 0);
        for case in 0..cases {
            let bytes = decoder.corrupted(&seeds, &mut random);
            longest = longest.max(bytes.len());
            match catch_unwind(AssertUnwindSafe(|| decoder.decode(&bytes))) {
                Ok(n) => lines += n,
                Err(_) => {
                    let path = std::env::temp_dir().join(format!("fuzz-found-{}", decoder.name));
                    let kept = std::fs::write(&path, &bytes);
                    println!(
                        "FOUND in {} at case {case}; left in {} ({kept:?})",
                        decoder.name,
                        path.display()
                    );
                    return ExitCode::FAILURE;
                }
            }
        }
        println!(
            "{:12} {cases} cases, {lines} messages and gaps, up to {longest} bytes, {:.0} s, no panic",
            decoder.name,
            began.elapsed().as_secs_f64()
        );
    }
    ExitCode::SUCCESS
}

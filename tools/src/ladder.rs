//! Simplification levels of Meng et al. 2023, Figs. 12-16: effect of simplifying a seabed on the image, the mean level and the run time of
//! a ping.

#[path = "bench/machine.rs"]
mod machine;
#[path = "ladder/measure.rs"]
mod measure;
#[path = "ladder/picture.rs"]
mod picture;

use std::path::PathBuf;
use std::time::Instant;

use measure::{Figures, Ladder, Once, POINT_COUNTS, Simplifier};

const HELP: &str = "\
tools/ladder [--quick] [--seeds N] [--json FILE] [--picture FILE] [--times]

  --quick         4 seeds and 12 pings instead of 64 and 48
  --seeds N       number of scenes with different speckle and random numbers
  --json FILE     write the results as JSON
  --picture FILE  the images of one scene as PNG: the original on top, then a row of simplifiers for each level
  --times         only run times on one thread: of the selection and of computing a ping

scene     42,936 points over 20 m x 60 m of the raised letters of Fig. 12, 30 m below the sonar; scatterers in shadow are excluded for all simplifiers
sonar     one beam of 0.56 degrees each way, 400 kHz, 30 kHz LFM of 5 ms, 30 degrees down, 3 knots, a ping every 0.25 m
level dB  energy of all images over the original's, both with a gain of 40 log r + 2 alpha r: mean over the seeds, and standard deviation of one seed
image dB  rms over blocks of 4 pings x 64 samples (192 resolution cells) of the ratio of energies, clipped at 20 dB
l2        relative l2 difference of the complex element samples
chosen    `each ping`: selected for each ping, as the paper's axis energy requires; `once`: for the whole pass, from its middle
";

fn main() {
    let mut quick = false;
    let mut times = false;
    let mut seeds = None;
    let (mut json, mut picture): (Option<PathBuf>, Option<PathBuf>) = (None, None);
    let mut arguments = std::env::args().skip(1);
    while let Some(argument) = arguments.next() {
        let mut value = || {
            arguments
                .next()
                .unwrap_or_else(|| refuse(&format!("{argument} needs a value")))
        };
        match argument.as_str() {
            "--quick" => quick = true,
            "--times" => times = true,
            "--seeds" => {
                let text = value();
                seeds = Some(
                    text.parse()
                        .unwrap_or_else(|_| refuse(&format!("--seeds {text}: must be a number"))),
                );
            }
            "--json" => json = Some(value().into()),
            "--picture" => picture = Some(value().into()),
            "--help" | "-h" => {
                print!("{HELP}");
                return;
            }
            other => refuse(&format!("{other}: unknown option")),
        }
    }
    println!("{}", machine::describe());
    let pings = if quick { 12 } else { 48 };
    let ladder = Ladder::new(pings);
    if let Some(file) = &picture {
        keep(file, || picture::draw(&ladder, file));
    }
    if times {
        print_times(&ladder);
        return;
    }
    let seeds = seeds.unwrap_or(if quick { 4 } else { 64 });
    let began = Instant::now();
    let rows = ladder.measure(seeds);
    println!(
        "{pings} pings, {seeds} seeds, {:.0} s",
        began.elapsed().as_secs_f64()
    );
    print_table(&rows);
    if let Some(file) = &json {
        let text = serde_json::json!({
            "machine": machine::describe(),
            "pings": pings,
            "seeds": seeds,
            "rows": rows.iter().map(Figures::json).collect::<Vec<_>>(),
        });
        keep(file, || std::fs::write(file, format!("{text:#}\n")));
    }
}

fn refuse(why: &str) -> ! {
    eprintln!("{why}\n\n{HELP}");
    std::process::exit(2);
}

fn keep<E: std::fmt::Display>(file: &std::path::Path, write: impl FnOnce() -> Result<(), E>) {
    if let Err(error) = write() {
        eprintln!("{}: {error}", file.display());
        std::process::exit(1);
    }
}

fn print_table(rows: &[Figures]) {
    println!(
        "{:>6} {:<10} {:<22} {:>8} {:>17} {:>9} {:>7}",
        "points", "chosen", "simplifier", "kept", "level dB", "image dB", "l2"
    );
    for row in rows {
        println!(
            "{:>6} {:<10} {:<22} {:>8.0} {:>+8.2} +- {:>5.2} {:>9.2} {:>7.2}",
            row.points,
            row.once.name(),
            row.simplifier.name(),
            row.kept,
            row.level_db,
            row.level_scatter_db,
            row.image_db,
            row.l2
        );
    }
}

fn print_times(ladder: &Ladder) {
    println!(
        "{:>6} {:<22} {:>12} {:>12} {:>12}",
        "points", "simplifier", "choose ms", "ping ms", "level dB"
    );
    let (choose_ms, ping_ms, _) = ladder.time(None);
    println!(
        "{:>6} {:<22} {:>12.2} {:>12.2} {:>12}",
        "all", "-", choose_ms, ping_ms, "0"
    );
    for points in POINT_COUNTS {
        for simplifier in Simplifier::ALL {
            let (choose_ms, ping_ms, level_db) = ladder.time(Some((simplifier, points)));
            println!(
                "{points:>6} {:<22} {choose_ms:>12.2} {ping_ms:>12.2} {level_db:>+12.2}",
                simplifier.name()
            );
        }
    }
    println!(
        "conventional selects once for all pings; the others for each ping, with curvatures fitted beforehand"
    );
    let _ = Once::ALL;
}

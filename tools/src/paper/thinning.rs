//! Simplification levels of Meng et al. 2023, Figs. 12-16: effect of simplifying a seabed on the image, the mean level and the run
//! time of a ping.

pub(crate) mod measure;
mod picture;

use std::path::Path;

use clap::Args;
use serde_json::{Value, json};

use crate::machine;
use measure::{Figures, POINT_COUNTS, Simplifier, Thinning};

pub(super) const ABOUT: &str = "\
Figures 12 to 16: the paper's simplified seabeds (42,936 -> 5125 -> 3000 -> 1000 -> 176 points) with every simplifier
scene     42,936 points over 20 m x 60 m of the raised letters of Fig. 12, 30 m below the sonar; scatterers in shadow are excluded for all simplifiers
sonar     one beam of 0.56 degrees each way, 400 kHz, 30 kHz LFM of 5 ms, 30 degrees down, 3 knots, a ping every 0.25 m
level dB  energy of all images over the original's, both with a gain of 40 log r + 2 alpha r: mean over the seeds, and standard deviation of one seed
image dB  rms over blocks of 4 pings x 64 samples (192 resolution cells) of the ratio of energies, clipped at 20 dB
l2        relative l2 difference of the complex element samples
chosen    `each ping`: selected for each ping, as the paper's axis energy requires; `once`: for the whole pass, from its middle";

#[derive(Args)]
pub(super) struct Options {
    /// 12 to 16: number of pings, 0.25 m apart; 48 for the whole scene
    #[arg(long, default_value_t = 12)]
    pings: usize,
    /// 12 to 16: number of scenes with different speckle and random numbers
    #[arg(long, default_value_t = 4)]
    seeds: u64,
    /// 12 to 16: only run times on one thread, of the selection and of computing a ping
    #[arg(long)]
    times: bool,
}

/// Draws the images of one scene and measures all levels. The original is on top, with a row of simplifiers for each level below.
pub(super) fn figure(options: &Options, file: &Path) -> Result<Value, String> {
    let Options {
        pings,
        seeds,
        times,
    } = *options;
    let thinning = Thinning::new(pings);
    if times {
        print_times(&thinning);
        return Ok(json!({ "machine": machine::describe(), "pings": pings }));
    }
    picture::draw(&thinning, file)?;
    let rows = thinning.measure(seeds);
    print_table(&rows);
    Ok(json!({
        "machine": machine::describe(), "pings": pings, "seeds": seeds,
        "rows": rows.iter().map(Figures::json).collect::<Vec<_>>(),
    }))
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

fn print_times(thinning: &Thinning) {
    println!(
        "{:>6} {:<22} {:>12} {:>12} {:>12}",
        "points", "simplifier", "choose ms", "ping ms", "level dB"
    );
    let (choose_ms, ping_ms, _) = thinning.time(None);
    println!(
        "{:>6} {:<22} {:>12.2} {:>12.2} {:>12}",
        "all", "-", choose_ms, ping_ms, "0"
    );
    for points in POINT_COUNTS {
        for simplifier in Simplifier::ALL {
            let (choose_ms, ping_ms, level_db) = thinning.time(Some((simplifier, points)));
            println!(
                "{points:>6} {:<22} {choose_ms:>12.2} {ping_ms:>12.2} {level_db:>+12.2}",
                simplifier.name()
            );
        }
    }
    println!(
        "conventional selects once for all pings; the others for each ping, with curvatures fitted beforehand"
    );
}

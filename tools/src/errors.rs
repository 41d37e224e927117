//! Prints the errors of path and Doppler models against the reference: of samples over speed and angle, of images over speed and range.
//!
//! `tools/errors` prints the tables of tests/stability/errors.txt and images.txt; `tools/errors --keep` rewrites these files.

#[path = "errors/images.rs"]
mod images;
#[path = "errors/table.rs"]
mod table;

use std::path::Path;

const ABOUT: &str = "\
One point, one element, LFM 400 kHz / 30 kHz / 5 ms (ends tapered by a twentieth each), 1500 m/s, uniform motion along the track.
range m: where a method puts the leading edge less where it truly is, one way. error: relative l2 of the element's samples at 80 kHz
against the retarded-time sum on the continuous motion; pass up to 1e-3. An error of 1.4 is that of two signals with nothing in common.
paper-eq21: Eq. 21 of Meng et al. 2023 as printed, on the polyline. stop-and-hop: without Doppler. The others: on the polyline.
";

const ABOUT_IMAGES: &str = "\
What the same models cost a picture. One point, the pulse of errors.txt, transmitter and receiver of 0.2 m each; truth is the retarded-time sum.
Each pair: what the criterion says, and what was measured. along m: how far along the track the strongest line moves the point (abeam); criterion
v r / c where the way during the ping is left out. edge m, 60 deg m: how far its compressed line moves it in range at the edge of the beam (0.48
degrees ahead of abeam) and 60 degrees from the track; criterion v r cos / c of the way left out plus |d| f_c T / B of the Doppler left out. picture:
of a side-scan, pass where along is below a quarter of the cell (0.64 lambda r / L) and edge below a tenth of its own (c / 2B = 0.025 m), by the
criterion and by what was measured. samples: the relative error of the element's samples at the edge, ! above 1e-3: what a picture may do without,
whoever beamforms may not.
";

fn main() -> std::io::Result<()> {
    let mut samples = format!("{ABOUT}\n{}\n", table::heading());
    for case in table::cases() {
        samples += &table::row(case);
        samples += "\n";
    }
    let mut pictures = format!("{ABOUT_IMAGES}\n{}\n", images::heading());
    for case in images::cases() {
        pictures += &images::row(case);
        pictures += "\n";
    }
    print!("{samples}\n{pictures}");
    match std::env::args().nth(1).as_deref() {
        None => Ok(()),
        Some("--keep") => {
            let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/stability");
            std::fs::write(folder.join("errors.txt"), samples)?;
            std::fs::write(folder.join("images.txt"), pictures)
        }
        Some(other) => {
            eprintln!("{other}: only --keep is known");
            std::process::exit(2);
        }
    }
}

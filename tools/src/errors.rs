//! Prints the errors of path and Doppler models against the reference: of samples over speed and angle, of images over speed and range.
//!
//! `tools/errors` prints the tables of tests/stability/errors.txt and images.txt; `tools/errors --keep` rewrites these files.

#[path = "errors/images.rs"]
mod images;
#[path = "errors/table.rs"]
mod table;

use std::path::Path;

const ABOUT: &str = "\
One point, one element, LFM 400 kHz / 30 kHz / 5 ms (tapered by a twentieth at each end), 1500 m/s, uniform motion along the track.
range m: one-way range error of the leading edge. error: relative l2 error of the element's samples at 80 kHz against the retarded-time sum on
the continuous motion; pass up to 1e-3. Uncorrelated signals have an error of 1.4.
paper-eq21: Eq. 21 of Meng et al. 2023 as printed, on the polyline. stop-and-hop: without Doppler. The others: on the polyline.
";

const ABOUT_IMAGES: &str = "\
Image errors of the same models. One point, the pulse of errors.txt, transmit and receive apertures of 0.2 m each; truth is the retarded-time sum.
Each pair: predicted and measured. along m: displacement of the point along the track by the strongest line (abeam); predicted v r / c where motion
during the ping is ignored. edge m, 60 deg m: displacement in range of the compressed line at the edge of the beam (0.48 degrees ahead of abeam) and
60 degrees from the track; predicted v r cos / c of the ignored motion plus |d| f_c T / B of the ignored Doppler. picture: a side-scan image passes if
along is below a quarter of its cell (0.64 lambda r / L) and edge below a tenth of its cell (c / 2B = 0.025 m); predicted, measured. samples: relative
error of the element's samples at the edge, ! above 1e-3; this matters to beamforming but not to the image.
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
            eprintln!("{other}: unknown option; the only option is --keep");
            std::process::exit(2);
        }
    }
}

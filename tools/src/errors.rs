//! Prints the errors of path and Doppler models against the reference: of samples over speed and angle, of images over speed and range.
//!
//! `tools/errors` prints the tables of tools/kept/errors.txt and images.txt; `tools/errors --keep` rewrites these files.

pub(crate) mod images;
pub(crate) mod table;

use clap::Args;

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

#[derive(Args)]
#[command(
    about = "Errors of path and Doppler models over speed, range and angle, of samples and of images"
)]
pub(crate) struct Arguments {
    /// Write tools/kept/errors.txt and images.txt
    #[arg(long)]
    keep: bool,
}

pub(crate) fn run(given: Arguments) -> Result<(), Box<dyn std::error::Error>> {
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
    if given.keep {
        std::fs::write(crate::kept("errors.txt"), samples)?;
        std::fs::write(crate::kept("images.txt"), pictures)?;
    }
    Ok(())
}

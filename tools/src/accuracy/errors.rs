//! Errors of path and Doppler models against the reference: errors of samples over speed and angle, and of images over speed
//! and range.
//!
//! `tools/accuracy errors --keep` rewrites tools/kept/errors.txt and images.txt.

pub(crate) mod images;
pub(crate) mod table;

use clap::Args;
use serde_json::json;

use crate::report::{Common, Report};

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
    #[command(flatten)]
    common: Common,
    /// Write tools/kept/errors.txt and images.txt
    #[arg(long, conflicts_with = "quick")]
    keep: bool,
}

pub(crate) fn run(given: Arguments) -> Result<(), Box<dyn std::error::Error>> {
    let step = if given.common.quick { 8 } else { 1 };
    let mut samples = Report::new();
    samples.print(&format!("{ABOUT}\n{}\n", table::heading()));
    for case in table::cases().into_iter().step_by(step) {
        let measured = table::METHODS.each_ref().map(|m| table::measure(m, case));
        samples.print(&format!("{}\n", table::row(case, &measured)));
        let names = table::METHODS.each_ref().map(|method| method.name);
        samples
            .keep(json!({ "case": case, "methods": names, "range_error_m_and_error": measured }));
    }
    let mut pictures = Report::new();
    pictures.print(&format!("{ABOUT_IMAGES}\n{}\n", images::heading()));
    for case in images::cases().into_iter().step_by(step) {
        let measured = images::measure(case.0, case.1);
        pictures.print(&format!("{}\n", images::row(case, &measured)));
        samples.keep(json!({ "speed_m_per_s": case.0, "range_m": case.1, "images": measured }));
    }
    if given.keep {
        samples.keep_text("errors.txt")?;
        pictures.keep_text("images.txt")?;
    }
    Ok(samples.finish(given.common.json.as_deref())?)
}

//! Figures of Meng et al. 2023, each from its configuration in `hil-configs/paper`.

mod beams;
mod footprint;
mod lake;
mod pings;
mod single;
mod strip;
pub(crate) mod thinning;

use std::path::PathBuf;

use clap::Args;

#[derive(Args)]
#[command(
    about = "The figures of Meng et al. 2023 from hil-configs/paper, as PNG and numbers",
    after_help = thinning::ABOUT
)]
pub(crate) struct Arguments {
    /// 6: footprints of stop-and-hop and polyline, and the propagation distance; 7: incidence and direction of arrival in the polyline's
    /// footprint; 10: single-beam side-scan at 3 and 10 knots, with its gaps; 11: five subarrays at 10 knots, conventional beams and dynamic
    /// focus; 12 to 16: the simplified seabeds, one measurement; 17: the lake with its bridge piers; 18: the same with a deviation of the
    /// motion; all: all but 12 to 16
    #[arg(value_parser = ["6", "7", "10", "11", "12", "13", "14", "15", "16", "17", "18", "all"])]
    figure: String,
    /// Folder for PNG and JSON
    #[arg(long, default_value = "out/paper")]
    out: PathBuf,
    #[command(flatten)]
    seabeds: thinning::Options,
}

pub(crate) fn run(given: Arguments) -> Result<(), Box<dyn std::error::Error>> {
    let out = &given.out;
    std::fs::create_dir_all(out).map_err(|error| format!("{}: {error}", out.display()))?;
    let chosen: &[&str] = match given.figure.as_str() {
        "all" => &["6", "7", "10", "11", "17", "18"],
        name => &[name],
    };
    for name in chosen {
        let done = match *name {
            "6" => footprint::figure_6(out),
            "7" => footprint::figure_7(out),
            "10" => single::figure_10(out),
            "11" => beams::figure_11(out),
            "17" => lake::figure_17(out),
            "18" => lake::figure_18(out),
            _ => thinning::figure(&given.seabeds, &out.join(format!("fig{name}.png"))),
        };
        let numbers = done.map_err(|error| format!("figure {name}: {error}"))?;
        let file = out.join(format!("fig{name}.json"));
        let text = format!("{numbers:#}\n");
        print!("figure {name}: {text}");
        std::fs::write(&file, text).map_err(|error| format!("{}: {error}", file.display()))?;
    }
    Ok(())
}

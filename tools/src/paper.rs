//! The figures of Meng et al. 2023, each from its configuration in `hil-configs/paper`. See `tools/paper --help`.

#[path = "paper/beams.rs"]
mod beams;
#[path = "paper/footprint.rs"]
mod footprint;
#[path = "paper/lake.rs"]
mod lake;
#[path = "paper/picture.rs"]
mod picture;
#[path = "paper/pings.rs"]
mod pings;
#[path = "paper/single.rs"]
mod single;

use std::path::PathBuf;

const HELP: &str = "\
tools/paper FIG [--out DIR]

  6    footprints of stop-and-hop and polyline, and the propagation distance
  7    incidence and direction of arrival in the polyline's footprint
  10   single-beam side-scan at 3 and 10 knots, with its gaps
  11   five subarrays at 10 knots: conventional beams and dynamic focus
  17   the lake with its bridge piers
  18   the same with a deviation of the motion
  all  all of these

  --out DIR   folder for PNG and JSON; default out/paper

  12 to 16  the simplified seabeds: the short form of tools/ladder (called by the script tools/paper)
";

fn main() -> std::process::ExitCode {
    let mut figure = None;
    let mut out = PathBuf::from("out/paper");
    let mut arguments = std::env::args().skip(1);
    while let Some(argument) = arguments.next() {
        match argument.as_str() {
            "--out" => match arguments.next() {
                Some(folder) => out = folder.into(),
                None => return refuse("--out needs a folder"),
            },
            "--help" | "-h" => {
                print!("{HELP}");
                return std::process::ExitCode::SUCCESS;
            }
            _ if figure.is_none() => figure = Some(argument),
            other => return refuse(&format!("{other}: one figure at a time")),
        }
    }
    let Some(figure) = figure else {
        return refuse("which figure?");
    };
    if let Err(error) = std::fs::create_dir_all(&out) {
        return refuse(&format!("{}: {error}", out.display()));
    }
    let chosen: &[&str] = match figure.as_str() {
        "all" => &["6", "7", "10", "11", "17", "18"],
        name => &[name],
    };
    for name in chosen {
        let done = match *name {
            "6" => footprint::figure_6(&out),
            "7" => footprint::figure_7(&out),
            "10" => single::figure_10(&out),
            "11" => beams::figure_11(&out),
            "17" => lake::figure_17(&out),
            "18" => lake::figure_18(&out),
            "12" | "13" | "14" | "15" | "16" => {
                return refuse(
                    "figures 12 to 16: tools/ladder --picture FILE --json FILE, which the script tools/paper calls",
                );
            }
            other => return refuse(&format!("{other}: no such figure")),
        };
        match done {
            Ok(numbers) => {
                let file = out.join(format!("fig{name}.json"));
                let text = format!("{numbers:#}\n");
                print!("figure {name}: {text}");
                if let Err(error) = std::fs::write(&file, text) {
                    return refuse(&format!("{}: {error}", file.display()));
                }
            }
            Err(error) => {
                eprintln!("figure {name}: {error}");
                return std::process::ExitCode::FAILURE;
            }
        }
    }
    std::process::ExitCode::SUCCESS
}

fn refuse(why: &str) -> std::process::ExitCode {
    eprintln!("{why}\n\n{HELP}");
    std::process::ExitCode::from(2)
}

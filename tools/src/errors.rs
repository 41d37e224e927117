//! Prints what path and Doppler models are off by against the reference, over speed and angle.
//!
//! `tools/errors` prints the table that tests/stability/errors.txt keeps; `tools/errors --keep` writes it there.

#[path = "errors/table.rs"]
mod table;

use std::path::Path;

const ABOUT: &str = "\
One point, one element, LFM 400 kHz / 30 kHz / 5 ms (ends tapered by a twentieth each), 1500 m/s, uniform motion along the track.
range m: where a method puts the leading edge less where it truly is, one way. error: relative l2 of the element's samples at 80 kHz
against the retarded-time sum on the continuous motion; pass up to 1e-3. An error of 1.4 is that of two signals with nothing in common.
paper-eq21: Eq. 21 of Meng et al. 2023 as printed, on the polyline. stop-and-hop: without Doppler. The others: on the polyline.
";

fn main() -> std::io::Result<()> {
    let mut text = format!("{ABOUT}\n{}\n", table::heading());
    for case in table::cases() {
        text += &table::row(case);
        text += "\n";
    }
    print!("{text}");
    match std::env::args().nth(1).as_deref() {
        None => Ok(()),
        Some("--keep") => {
            let file = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/stability/errors.txt");
            std::fs::write(file, text)
        }
        Some(other) => {
            eprintln!("{other}: only --keep is known");
            std::process::exit(2);
        }
    }
}

//! The page that shows the figures.

use std::fmt::Write;

use super::regimes::ALL;
use super::small::{CURVATURE_SAYS, PLACES_SAYS};

const HEAD: &str = "\
# The failure atlas

This page shows where the methods of this program fail, and how. Each figure sweeps one regime (left to right) over every synthesis method (six panels)
with every path and Doppler model (rows). The colour is the error of the samples against the retarded-time sum on the continuous motion, in tolerances.
Blue is within the tolerance, orange is not; hatched cells were refused with a reason. Rings mark the selected methods of each column, and the strip below
shows their errors. The frame marks the paper's own formula, Eq. 21 of Meng et al. 2023 with the sum of Eq. 18, as printed.

`tools/atlas` draws all figures (an hour on a busy machine), `--only NAME` one of them; `--page` writes this page. `tools/src/tests/regimes.rs` tests the
boundaries of every regime in the first part of the table on a short pulse, with two to six columns each: no NaN, no panic, no error above its prediction
and no selection inside a failing region.

";

const OTHERS: [[&str; 4]; 6] = [
    [
        "curvature on planes",
        "0/0 on flat ground, on few points and if all are in shadow (Eqs. 27 and 28)",
        "a floor of -30 dB under the curvature; undefined energies rank last",
        "[picture](curvature.png); `simplification_has_a_number_for_every_surface` (`tools/src/tests/regimes.rs`)",
    ],
    [
        "poles, antimeridian",
        "not considered: positions are in metres",
        "via earth-centred coordinates: accurate to a micrometre anywhere",
        "[picture](places.png); `places_come_back_over_poles_and_antimeridian` (`tools/src/tests/regimes.rs`)",
    ],
    [
        "ping period below the two-way time",
        "not considered",
        "the range takes precedence: the rate is lowered, and the records hold the actual rate",
        "`a_range_too_long_for_the_rate_lowers_the_rate` (`ping`)",
    ],
    [
        "all points in shadow",
        "shadowed points tie with the best (Eq. 26's modulus)",
        "shadowed points are excluded: a ping without echoes, counted in `shadowed`",
        "`scene::occlusion`",
    ],
    [
        "first bottom return",
        "not considered",
        "nadir needs no special case (`grazing`, 0 degrees)",
        "[grazing](grazing.png)",
    ],
    [
        "speed near that of sound",
        "divides by c^2 - v^2",
        "refused above 150 m/s: \"two positions imply 151 m/s\"",
        "[speed](speed.png)",
    ],
];

pub(crate) fn page() -> String {
    let mut text = HEAD.to_owned();
    for regime in &ALL {
        let _ = write!(
            text,
            "## {}\n\n![{}]({}.png)\n\n{}\n\n",
            regime.title, regime.title, regime.name, regime.says
        );
    }
    let _ = write!(
        text,
        "## Simplification where curvature is zero\n\n![Simplification](curvature.png)\n\n{CURVATURE_SAYS}\n\n## Poles and the antimeridian\n\n![Places](places.png)\n\n{PLACES_SAYS}\n\n"
    );
    text += "## Summary\n\n| regime | the paper's formula | ours | shown by |\n|---|---|---|---|\n";
    for regime in &ALL {
        let _ = writeln!(
            text,
            "| {} | {} | {} | [picture]({}.png), `tools/src/tests/regimes.rs` |",
            regime.name, regime.paper, regime.ours, regime.name
        );
    }
    for [regime, paper, ours, test] in OTHERS {
        let _ = writeln!(text, "| {regime} | {paper} | {ours} | {test} |");
    }
    text
}

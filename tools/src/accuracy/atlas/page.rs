//! Page that shows the figures.

use std::fmt::Write;

use super::regimes::ALL;
use super::small::{CURVATURE_SAYS, PLACES_SAYS};

const HEAD: &str = "\
# Where methods fail

This page shows the conditions under which the methods of Echotank fail. Each figure varies one condition
from left to right.

| in a figure | meaning |
|---|---|
| panel | one synthesis method; seven in all |
| row | one path model with one Doppler model |
| colour | error of the element samples against the reference, in tolerances |
| blue | within the tolerance |
| orange | above the tolerance |
| hatched | refused, with a reason |
| ring | selected methods of the column |
| strip below | error of the selected methods |
| frame | Eq. 21 of Meng et al. 2023 with the sum of Eq. 18, as printed |

The reference is the retarded-time sum on the continuous motion. In the summary, \"the paper\" is Meng et al.
2023.

| command | result |
|---|---|
| `tools/accuracy atlas` | all figures; about half an hour |
| `tools/accuracy atlas --only NAME` | one figure |
| `tools/accuracy atlas --page` | this page |

`tools/src/tests/regimes.rs` tests the limits of the conditions in the first part of the summary, on a short
pulse. It finds no NaN, no panic, no error above its prediction and no selection in a failing region.

";

const OTHERS: [[&str; 4]; 6] = [
    [
        "curvature on planes",
        "0/0 on flat ground, on few points and if all are in shadow (Eqs. 27 and 28)",
        "curvature has a floor of -30 dB; undefined energies rank last",
        "[picture](curvature.png); `simplification_has_a_number_for_every_surface` (`tools/src/tests/regimes.rs`)",
    ],
    [
        "poles, antimeridian",
        "not considered: positions are in metres",
        "conversion by earth-centred coordinates, accurate to a micrometre everywhere",
        "[picture](places.png); `places_come_back_over_poles_and_antimeridian` (`tools/src/tests/regimes.rs`)",
    ],
    [
        "ping period below the two-way time",
        "not considered",
        "the range takes precedence; the rate is lowered, and records hold the actual rate",
        "`a_range_too_long_for_the_rate_lowers_the_rate` (`ping`)",
    ],
    [
        "all points in shadow",
        "shadowed points tie with the best (Eq. 26's modulus)",
        "shadowed points are excluded and counted in `shadowed`; the ping has no echoes",
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
    text +=
        "## Summary\n\n| regime | the paper's formula | Echotank | shown by |\n|---|---|---|---|\n";
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

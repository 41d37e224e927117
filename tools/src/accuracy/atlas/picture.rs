//! Maps of errors as SVG.

use std::fmt::Write;

use echotank_drawing::{Anchor, GREY, INK, Svg, escaped};

/// One cell of a map.
#[derive(Clone, Debug, PartialEq)]
pub(crate) enum Mark {
    /// The row does not have this method.
    Blank,
    Refused,
    Silence,
    /// NaN, infinity or a panic.
    Shout,
    /// log10 of the error over the tolerance, and the text of the cell.
    Ratio {
        log10: f64,
        sign: Sign,
    },
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Sign {
    None,
    /// Wrong result without a warning.
    Silent,
    /// Some echoes were counted as outside the limits of the method.
    Counted,
}

pub(crate) struct Panel {
    pub(crate) title: String,
    /// Marks by row, then column.
    pub(crate) marks: Vec<Vec<Mark>>,
    /// Cells of the selected methods, (column, row).
    pub(crate) rings: Vec<(usize, usize)>,
}

pub(crate) struct Map {
    pub(crate) title: String,
    pub(crate) about: String,
    pub(crate) axis: String,
    pub(crate) columns: Vec<String>,
    /// Names of the rows, and indices of the rows before a gap.
    pub(crate) rows: Vec<String>,
    pub(crate) gaps: Vec<usize>,
    /// A highlighted row.
    pub(crate) framed: Vec<(usize, usize, String)>,
    pub(crate) panels: Vec<Panel>,
    /// Result of the selection in each column, with its choices as text.
    pub(crate) plan: Option<(Vec<Mark>, Vec<String>)>,
}

const CELL: f64 = 15.0;
const GAP: f64 = 6.0;
const LEFT: f64 = 208.0;
const TOP: f64 = 104.0;
const PANEL_GAP: f64 = 16.0;
/// Maximum total width of the columns of all panels.
const WIDEST: f64 = 14.0;
const PANELS_WIDTH: f64 = 1380.0;
/// Limits of the colour scale, decades from the tolerance.
const ENDS: f64 = 4.0;

/// Colour of a ratio: blue below the tolerance, orange and brown above. The shades differ for all types of colour vision and in
/// greyscale, and are palest at the tolerance (ColorBrewer's PuOr and Blues, Brewer 2003).
fn colour(log10: f64) -> String {
    const WITHIN: [[f64; 3]; 3] = [
        [222.0, 235.0, 247.0],
        [107.0, 174.0, 214.0],
        [8.0, 69.0, 148.0],
    ];
    const BEYOND: [[f64; 3]; 3] = [
        [254.0, 224.0, 182.0],
        [230.0, 133.0, 30.0],
        [110.0, 48.0, 4.0],
    ];
    let stops = if log10 <= 0.0 { WITHIN } else { BEYOND };
    let along = 2.0 * (log10.abs() / ENDS).clamp(0.0, 1.0);
    let (k, part) = if along >= 1.0 {
        (1, along - 1.0)
    } else {
        (0, along)
    };
    let mixed: Vec<u8> = (0..3)
        .map(|c| (stops[k][c] + part * (stops[k + 1][c] - stops[k][c])).round() as u8)
        .collect();
    format!("#{:02x}{:02x}{:02x}", mixed[0], mixed[1], mixed[2])
}

fn square(svg: &mut Svg, (x, y): (f64, f64), (wide, high): (f64, f64), mark: &Mark) {
    let rect = |fill: &str, extra: &str| {
        format!(
            "<rect x=\"{x:.1}\" y=\"{y:.1}\" width=\"{:.1}\" height=\"{:.1}\" fill=\"{fill}\"{extra}/>",
            wide - 0.8,
            high - 0.8
        )
    };
    let middle = (x + 0.5 * wide - 0.4, y + 0.5 * high - 0.4);
    match mark {
        Mark::Blank => {}
        Mark::Refused => {
            svg.raw(&rect("url(#refused)", ""));
        }
        Mark::Silence => {
            svg.raw(&rect("white", " stroke=\"#c4c9d0\" stroke-width=\"0.7\""));
            svg.raw(&format!(
                "<circle cx=\"{:.1}\" cy=\"{:.1}\" r=\"1.4\" fill=\"{GREY}\"/>",
                middle.0, middle.1
            ));
        }
        Mark::Shout => {
            svg.raw(&rect("#ff00c8", " stroke=\"black\" stroke-width=\"2\""));
            svg.label(
                (middle.0, middle.1 + 4.0),
                9.0,
                Anchor::Middle,
                "black",
                "NaN",
            );
        }
        Mark::Ratio { log10, sign } => {
            svg.raw(&rect(&colour(*log10), ""));
            let ink = if log10.abs() > 2.2 { "white" } else { INK };
            match sign {
                Sign::None => {}
                Sign::Silent => {
                    svg.raw(&rect("none", " stroke=\"#d0006f\" stroke-width=\"2.2\""));
                    svg.label((middle.0, middle.1 + 4.5), 12.0, Anchor::Middle, ink, "!");
                }
                Sign::Counted => {
                    svg.raw(&format!(
                        "<path d=\"M{:.1} {:.1}l3 5h-6z\" fill=\"none\" stroke=\"{ink}\" stroke-width=\"0.9\"/>",
                        middle.0,
                        middle.1 - 2.8
                    ));
                }
            }
        }
    }
}

fn upright(svg: &mut Svg, (x, y): (f64, f64), size: f64, text: &str) {
    svg.raw(&format!(
        "<text transform=\"translate({x:.1} {y:.1}) rotate(-90)\" font-size=\"{size}\" text-anchor=\"end\" fill=\"{INK}\">{}</text>",
        escaped(text)
    ));
}

impl Map {
    fn row_top(&self, row: usize) -> f64 {
        let gaps = self.gaps.iter().filter(|g| **g < row).count();
        TOP + row as f64 * CELL + gaps as f64 * GAP
    }

    pub(crate) fn svg(&self) -> String {
        let columns = self.columns.len() as f64;
        let panels = self.panels.len() as f64;
        let cell = ((PANELS_WIDTH - panels * PANEL_GAP) / (panels * columns)).min(WIDEST * 2.0);
        let cell = if self.panels.len() > 1 {
            cell.min(WIDEST)
        } else {
            cell
        };
        let panel_width = cell * columns + PANEL_GAP;
        let longest = self.columns.iter().map(|c| c.chars().count()).max();
        let label = 5.2 * longest.unwrap_or(1) as f64;
        let bottom = self.row_top(self.rows.len() - 1) + CELL;
        let words = self.plan.as_ref().map_or(0, |(_, words)| words.len());
        let width = (LEFT + panels * panel_width + 24.0).max(1240.0);
        let plan_top = bottom + label + 44.0;
        let height = plan_top
            + self
                .plan
                .as_ref()
                .map_or(0.0, |_| 34.0 + 14.0 * words as f64)
            + 78.0;
        let mut svg = Svg::new(width, height);
        svg.raw(
            "<defs><pattern id=\"refused\" width=\"5\" height=\"5\" patternUnits=\"userSpaceOnUse\"><rect width=\"5\" height=\"5\" fill=\"#e9ebee\"/><path d=\"M-1 6L6 -1M-1 1L1 -1M4 6L6 4\" stroke=\"#9aa1ab\" stroke-width=\"0.9\"/></pattern></defs>",
        );
        svg.label((20.0, 32.0), 19.0, Anchor::Start, INK, &self.title);
        svg.label((20.0, 52.0), 11.5, Anchor::Start, GREY, &self.about);
        for (row, name) in self.rows.iter().enumerate() {
            let y = self.row_top(row) + 0.5 * CELL + 3.6;
            svg.label((LEFT - 8.0, y), 10.5, Anchor::End, INK, name);
        }
        for (k, panel) in self.panels.iter().enumerate() {
            let left = LEFT + k as f64 * panel_width;
            svg.label((left, TOP - 9.0), 12.5, Anchor::Start, INK, &panel.title);
            let mut last = 0;
            for (row, marks) in panel.marks.iter().enumerate() {
                for (column, mark) in marks.iter().enumerate() {
                    let x = left + column as f64 * cell;
                    square(&mut svg, (x, self.row_top(row)), (cell, CELL), mark);
                    if *mark != Mark::Blank {
                        last = last.max(row);
                    }
                }
            }
            for &(column, row) in &panel.rings {
                let (x, y) = (
                    left + (column as f64 + 0.5) * cell,
                    self.row_top(row) + 0.5 * CELL,
                );
                svg.raw(&format!(
                    "<circle cx=\"{:.1}\" cy=\"{:.1}\" r=\"4.2\" fill=\"white\" stroke=\"{INK}\" stroke-width=\"1.7\"/>",
                    x - 0.4,
                    y - 0.4
                ));
            }
            let under = self.row_top(last) + CELL + 6.0;
            for (column, name) in self.columns.iter().enumerate() {
                let x = left + (column as f64 + 0.5) * cell + 3.2;
                upright(&mut svg, (x, under), 9.0, name);
            }
            for (_, row, text) in self.framed.iter().filter(|(panel, ..)| *panel == k) {
                let y = self.row_top(*row);
                svg.raw(&format!(
                    "<rect x=\"{:.1}\" y=\"{:.1}\" width=\"{:.1}\" height=\"{:.1}\" fill=\"none\" stroke=\"{INK}\" stroke-width=\"1.6\"/>",
                    left - 2.2,
                    y - 2.2,
                    cell * columns + 3.6,
                    CELL + 3.6
                ));
                svg.label((left, TOP - 24.0), 10.5, Anchor::Start, INK, text);
            }
        }
        let middle = LEFT + 0.5 * (panels * panel_width - PANEL_GAP);
        svg.label(
            (middle, bottom + label + 24.0),
            12.0,
            Anchor::Middle,
            INK,
            &self.axis,
        );
        let mut y = plan_top;
        if let Some((marks, words)) = &self.plan {
            svg.label(
                (LEFT - 8.0, y + 12.0),
                11.5,
                Anchor::End,
                INK,
                "selected methods",
            );
            for (column, mark) in marks.iter().enumerate() {
                let x = LEFT + column as f64 * cell;
                square(&mut svg, (x, y), (cell, CELL), mark);
            }
            let beside = LEFT + cell * columns + PANEL_GAP;
            for (k, line) in words.iter().enumerate() {
                svg.label(
                    (beside, y + 11.0 + 14.0 * k as f64),
                    10.5,
                    Anchor::Start,
                    INK,
                    line,
                );
            }
            y += 34.0 + 14.0 * words.len() as f64;
        }
        legend(
            &mut svg,
            y + 10.0,
            self.plan.is_some(),
            !self.framed.is_empty(),
        );
        svg.finish()
    }
}

fn legend(svg: &mut Svg, y: f64, plan: bool, framed: bool) {
    const STEPS: usize = 48;
    let (left, wide) = (LEFT, 240.0);
    for k in 0..STEPS {
        let log10 = ENDS * (2.0 * (k as f64 + 0.5) / STEPS as f64 - 1.0);
        svg.raw(&format!(
            "<rect x=\"{:.1}\" y=\"{y:.1}\" width=\"{:.1}\" height=\"12\" fill=\"{}\"/>",
            left + wide * k as f64 / STEPS as f64,
            wide / STEPS as f64 + 0.3,
            colour(log10)
        ));
    }
    for (part, text) in [
        (0.0, "1e-4"),
        (0.25, "0.01"),
        (0.5, "1"),
        (0.75, "100"),
        (1.0, "1e4"),
    ] {
        svg.label(
            (left + wide * part, y + 25.0),
            10.0,
            Anchor::Middle,
            INK,
            text,
        );
    }
    svg.label(
        (left + 0.5 * wide, y + 41.0),
        10.5,
        Anchor::Middle,
        INK,
        "error over tolerance: blue within, orange beyond",
    );
    let mut x = left + wide + 36.0;
    let entries: [(Mark, &str); 5] = [
        (Mark::Refused, "refused with a reason"),
        (Mark::Silence, "no echo, no signal"),
        (
            Mark::Ratio {
                log10: 1.5,
                sign: Sign::Counted,
            },
            "echoes counted as outside limits",
        ),
        (
            Mark::Ratio {
                log10: 1.5,
                sign: Sign::Silent,
            },
            "undetected error",
        ),
        (Mark::Shout, "NaN or panic"),
    ];
    for (mark, text) in &entries {
        square(svg, (x, y - 1.0), (CELL, CELL), mark);
        svg.label((x + 20.0, y + 10.5), 10.5, Anchor::Start, INK, text);
        x += 34.0 + 5.6 * text.len() as f64;
    }
    let mut rest = String::new();
    if plan {
        let _ = write!(rest, "ring: selected methods of the column");
    }
    if framed {
        let _ = write!(rest, "; frame: the paper's Eq. 21 as printed");
    }
    svg.label(
        (left + wide + 36.0, y + 32.0),
        10.5,
        Anchor::Start,
        INK,
        &rest,
    );
}

//! Picture of ping period against computing time of every rig, on logarithmic axes.

use echotank_drawing::{Anchor, GREY, INK, PALE, Svg};

use super::Row;

const WIDTH: f64 = 760.0;
const HEIGHT: f64 = 520.0;
const LEFT: f64 = 60.0;
const RIGHT: f64 = 150.0;
const TOP: f64 = 40.0;
const BOTTOM: f64 = 50.0;
const COLOURS: [&str; 8] = [
    "#1f6fb2", "#c8452f", "#2e8b57", "#8a5cc2", "#d08a1d", "#3aa6a6", "#7a5230", "#b0407a",
];
/// Lines of equal headroom.
const HEADROOMS: [f64; 3] = [1.0, 1.25, 2.5];

/// A logarithmic axis over whole decades and their halves.
struct Axis {
    low: f64,
    high: f64,
    from: f64,
    to: f64,
}

impl Axis {
    fn over(values: impl Iterator<Item = f64> + Clone, (from, to): (f64, f64)) -> Self {
        let low = values.clone().fold(f64::INFINITY, f64::min);
        let high = values.fold(0.0, f64::max);
        Self {
            low: low / 1.5,
            high: high * 1.5,
            from,
            to,
        }
    }

    fn at(&self, value: f64) -> f64 {
        let share = (value / self.low).ln() / (self.high / self.low).ln();
        self.from + share * (self.to - self.from)
    }

    fn ticks(&self) -> Vec<f64> {
        let decades = self.low.log10().floor() as i32..=self.high.log10().ceil() as i32;
        decades
            .flat_map(|decade| [1.0, 2.0, 5.0].map(|step| step * 10f64.powi(decade)))
            .filter(|tick| (self.low..=self.high).contains(tick))
            .collect()
    }
}

/// The picture as an SVG document.
pub(super) fn svg(rows: &[Row]) -> String {
    let mut svg = Svg::new(WIDTH, HEIGHT);
    let x = Axis::over(rows.iter().map(|r| r.period_ms), (LEFT, WIDTH - RIGHT));
    let y = Axis::over(rows.iter().map(|r| r.ms), (HEIGHT - BOTTOM, TOP));
    let title = "Time of a ping on two threads against the period of its device";
    svg.label((LEFT, 22.0), 15.0, Anchor::Start, INK, title);
    for tick in x.ticks() {
        let at = x.at(tick);
        svg.line((at, TOP), (at, HEIGHT - BOTTOM), PALE, "");
        let text = format!("{tick}");
        svg.label(
            (at, HEIGHT - BOTTOM + 16.0),
            11.0,
            Anchor::Middle,
            INK,
            &text,
        );
    }
    for tick in y.ticks() {
        let at = y.at(tick);
        svg.line((LEFT, at), (WIDTH - RIGHT, at), PALE, "");
        svg.label(
            (LEFT - 6.0, at + 4.0),
            11.0,
            Anchor::End,
            INK,
            &format!("{tick}"),
        );
    }
    let middle = (LEFT + WIDTH - RIGHT) / 2.0;
    svg.label(
        (middle, HEIGHT - 12.0),
        12.0,
        Anchor::Middle,
        INK,
        "period, ms",
    );
    svg.label((8.0, TOP - 6.0), 12.0, Anchor::Start, INK, "time, ms");
    for headroom in HEADROOMS {
        let low = x.low.max(y.low * headroom);
        let high = x.high.min(y.high * headroom);
        if low < high {
            let end = |period: f64| (x.at(period), y.at(period / headroom));
            svg.line(end(low), end(high), GREY, "5 4");
            // Beside the axis of time, where no points are.
            let (at_x, at_y) = end(low);
            let text = format!("headroom {headroom}");
            svg.label((at_x + 4.0, at_y + 12.0), 10.0, Anchor::Start, GREY, &text);
        }
    }
    let mut names: Vec<&str> = rows.iter().map(|r| r.rig.as_str()).collect();
    names.dedup();
    for (k, name) in names.iter().enumerate() {
        let colour = COLOURS[k % COLOURS.len()];
        let of: Vec<&Row> = rows.iter().filter(|r| r.rig == **name).collect();
        let points: Vec<(f64, f64)> = of.iter().map(|r| (x.at(r.period_ms), y.at(r.ms))).collect();
        svg.polyline(&points, colour, 1.5);
        for (row, (px, py)) in of.iter().zip(&points) {
            svg.raw(&format!(
                "<circle cx=\"{px:.1}\" cy=\"{py:.1}\" r=\"4\" fill=\"{colour}\"/>"
            ));
            let text = format!("{} m", row.range_m);
            svg.label((px + 6.0, py - 5.0), 9.0, Anchor::Start, colour, &text);
        }
        let at = TOP + 14.0 + 18.0 * k as f64;
        svg.line(
            (WIDTH - RIGHT + 14.0, at - 4.0),
            (WIDTH - RIGHT + 34.0, at - 4.0),
            colour,
            "",
        );
        svg.label((WIDTH - RIGHT + 40.0, at), 12.0, Anchor::Start, INK, name);
    }
    svg.finish()
}

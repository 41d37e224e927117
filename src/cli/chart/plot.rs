//! Plots of error against run time, and of run time against work.
//!
//! SVG is written directly, because plotters supports neither `data-` attributes on marks nor labels that avoid each other.

use std::fmt::Write;

use echotank_core::model::Synthesis;
use echotank_runtime::chart::methods::Method;
use echotank_runtime::chart::work::{Curve, Work};
use echotank_runtime::chart::{Chart, Measured, Row};

use super::peers::Peer;
use super::table::{ChartContext, subtitle};
use echotank_drawing::{Anchor, GREY, INK, PALE, Svg, escaped, width_of};

const WIDTH: f64 = 1200.0;
const HEIGHT: f64 = 768.0;
const LABEL: f64 = 11.0;

/// Colours that people with any colour vision can distinguish (Okabe and Ito 2008).
fn colour(synthesis: Synthesis) -> &'static str {
    match synthesis {
        Synthesis::Reference => "#000000",
        Synthesis::Direct => "#0072b2",
        Synthesis::Gridded1d => "#d55e00",
        Synthesis::Gridded2d => "#009e73",
        Synthesis::GriddedLines => "#999999",
        Synthesis::Spectral => "#cc79a7",
        Synthesis::Nearest => "#e69f00",
        Synthesis::Linear => "#56b4e9",
    }
}

/// A rectangle with two logarithmic axes.
struct Axes {
    left: f64,
    top: f64,
    width: f64,
    height: f64,
    /// Lower and upper limit of an axis, decades.
    x: (f64, f64),
    y: (f64, f64),
}

impl Axes {
    fn at(&self, x: f64, y: f64) -> (f64, f64) {
        let part = |v: f64, (low, high): (f64, f64)| {
            (v.max(f64::MIN_POSITIVE).log10() - low) / (high - low)
        };
        (
            self.left + self.width * part(x, self.x).clamp(0.0, 1.0),
            self.top + self.height * (1.0 - part(y, self.y).clamp(0.0, 1.0)),
        )
    }

    fn draw(&self, svg: &mut Svg, x_title: &str, y_title: &str, size: f64) {
        let (right, bottom) = (self.left + self.width, self.top + self.height);
        let label = |svg: &mut Svg, upright: bool, value: f64, text: &str| {
            let (x, y) = self.at(value, value);
            let (at, anchor) = match upright {
                true => ((x, bottom + size + 4.0), Anchor::Middle),
                false => ((self.left - 6.0, y + 0.35 * size), Anchor::End),
            };
            svg.label(at, size, anchor, INK, text);
        };
        for (low, high, upright) in [(self.x.0, self.x.1, true), (self.y.0, self.y.1, false)] {
            let every = (((high - low) / 8.0).ceil() as i32).max(1);
            for decade in low.ceil() as i32..=high.floor() as i32 {
                let value = 10f64.powi(decade);
                let (x, y) = self.at(value, value);
                match upright {
                    true => svg.line((x, self.top), (x, bottom), PALE, ""),
                    false => svg.line((self.left, y), (right, y), PALE, ""),
                }
                if decade.rem_euclid(every) == 0 {
                    label(svg, upright, value, &power(decade));
                }
            }
            // An axis with fewer than two decades is labelled at its ends.
            if high.floor() - low.ceil() < 1.0 {
                for value in [10f64.powf(low), 10f64.powf(high)] {
                    label(svg, upright, value, &short(value));
                }
            }
        }
        svg.raw(&format!(
            "<rect x=\"{}\" y=\"{}\" width=\"{}\" height=\"{}\" fill=\"none\" stroke=\"{GREY}\"/>",
            self.left, self.top, self.width, self.height
        ));
        let middle = self.left + 0.5 * self.width;
        svg.label(
            (middle, bottom + 2.6 * size),
            size + 1.0,
            Anchor::Middle,
            INK,
            x_title,
        );
        svg.label(
            (self.left, self.top - 7.0),
            size + 1.0,
            Anchor::Start,
            INK,
            y_title,
        );
    }
}

fn power(decade: i32) -> String {
    match decade {
        -2..=4 => short(10f64.powi(decade)),
        _ => format!("1e{decade}"),
    }
}

fn short(value: f64) -> String {
    match value {
        v if !(1e-2..1e4).contains(&v) => format!("{v:.0e}"),
        v if v >= 10.0 => format!("{v:.0}"),
        v => format!("{}", (v * 100.0).round() / 100.0),
    }
}

/// Limits in whole decades around the values, with a margin.
fn decades(values: impl Iterator<Item = f64>, least: f64) -> (f64, f64) {
    let (mut low, mut high) = (f64::INFINITY, f64::NEG_INFINITY);
    for value in values.filter(|v| *v > 0.0 && v.is_finite()) {
        low = low.min(value.max(least).log10());
        high = high.max(value.max(least).log10());
    }
    if low > high {
        return (-1.0, 1.0);
    }
    ((low - 0.15).floor(), (high + 0.15).ceil())
}

fn measured(chart: &Chart) -> impl Iterator<Item = (usize, &Row, &Measured)> {
    chart
        .rows
        .iter()
        .enumerate()
        .filter_map(|(k, row)| Some((k, row, row.outcome.as_ref().ok()?)))
}

/// Limits at which smaller errors are drawn, relative and dB.
const MIN_ERROR: f64 = 1e-8;
const MIN_DB: f64 = 1e-4;

pub(crate) fn chart(chart: &Chart, peers: &[Peer], about: &ChartContext) -> String {
    let mut svg = Svg::new(WIDTH, HEIGHT);
    let title = format!("{}: accuracy against speed", chart.sonar);
    svg.label((24.0, 32.0), 20.0, Anchor::Start, INK, &title);
    svg.label(
        (24.0, 51.0),
        11.5,
        Anchor::Start,
        GREY,
        &subtitle(chart, about),
    );
    let times = || measured(chart).map(|(_, _, m)| m.times.median_ms);
    let theirs = || peers.iter().map(|peer| peer.here_ms(chart));
    let x = decades(times().chain([about.period_ms]).chain(theirs()), 1e-6);
    let elements = |m: &Measured| Some(m.errors.elements);
    let main = Axes {
        left: 70.0,
        top: 86.0,
        width: 700.0,
        height: 560.0,
        x,
        y: decades(
            measured(chart)
                .map(|(_, _, m)| m.errors.elements)
                .chain([chart.tolerance])
                .chain(peers.iter().map(|peer| peer.error)),
            MIN_ERROR,
        ),
    };
    main.draw(
        &mut svg,
        "milliseconds per ping (median; whiskers: minimum and maximum)",
        "relative error of element samples",
        12.0,
    );
    // Errors below the error of the reference solution are not significant.
    if let Some((error, _)) = chart.reference_error {
        let (_, y) = main.at(1.0, error);
        let bottom = main.top + main.height;
        if y < bottom {
            svg.raw(&format!(
                "<rect x=\"{}\" y=\"{y:.1}\" width=\"{}\" height=\"{:.1}\" fill=\"{GREY}\" fill-opacity=\"0.12\"/>",
                main.left,
                main.width,
                bottom - y
            ));
            svg.label(
                (main.left + 6.0, bottom - 6.0),
                11.0,
                Anchor::Start,
                GREY,
                "within the reference solution's own error",
            );
        }
    }
    let (_, tolerance_y) = main.at(1.0, chart.tolerance);
    svg.line(
        (main.left, tolerance_y),
        (main.left + main.width, tolerance_y),
        INK,
        "5 4",
    );
    svg.label(
        (main.left + main.width - 6.0, tolerance_y - 5.0),
        11.0,
        Anchor::End,
        INK,
        &format!("tolerance {:.0e}", chart.tolerance),
    );
    let (period_x, _) = main.at(about.period_ms, 1.0);
    svg.line(
        (period_x, main.top),
        (period_x, main.top + main.height),
        INK,
        "2 4",
    );
    svg.label(
        (period_x - 5.0, main.top + 14.0),
        11.0,
        Anchor::End,
        INK,
        &format!("ping period {:.0} ms", about.period_ms),
    );
    front(&mut svg, &main, chart);
    points(&mut svg, &main, chart, elements, MIN_ERROR, 5.5);
    let mut taken = occupied(&main, chart, peers, about.period_ms);
    labels(&mut svg, &main, chart, &mut taken);
    draw_peers(&mut svg, &main, chart, peers, &mut taken);
    type Metric = fn(&Measured) -> Option<f64>;
    let small: [(&str, f64, Metric); 3] = [
        ("relative error of side-scan lines", MIN_ERROR, |m| {
            m.errors.lines
        }),
        ("rms error of image pixels, dB", MIN_DB, |m| {
            m.errors.image_db
        }),
        ("mean level: |error|, dB", MIN_DB, |m| {
            Some(m.errors.level_db.abs())
        }),
    ];
    for (k, (title, least, metric)) in small.into_iter().enumerate() {
        let axes = Axes {
            left: 850.0,
            top: 86.0 + 204.0 * k as f64,
            width: 325.0,
            height: 152.0,
            x,
            y: decades(measured(chart).filter_map(|(_, _, m)| metric(m)), least),
        };
        axes.draw(
            &mut svg,
            if k == 2 { "milliseconds per ping" } else { "" },
            title,
            10.5,
        );
        points(&mut svg, &axes, chart, metric, least, 3.5);
    }
    legend(&mut svg, chart, !peers.is_empty());
    svg.finish()
}

/// A rectangle: left, top, right, bottom.
type Rectangle = (f64, f64, f64, f64);

/// Rectangles covered by points, marks and lines.
fn occupied(axes: &Axes, chart: &Chart, peers: &[Peer], period_ms: f64) -> Vec<Rectangle> {
    let ours = measured(chart).map(|(_, _, m)| (m.times.median_ms, m.errors.elements));
    let theirs = peers.iter().map(|peer| (peer.here_ms(chart), peer.error));
    let around = |(ms, error): (f64, f64)| {
        let (x, y) = axes.at(ms, error.max(MIN_ERROR));
        (x - 5.0, y - 5.0, x + 5.0, y + 5.0)
    };
    let (right, bottom) = (axes.left + axes.width, axes.top + axes.height);
    let (_, tolerance_y) = axes.at(1.0, chart.tolerance);
    let tolerance = (axes.left, tolerance_y - 2.0, right, tolerance_y + 2.0);
    let words = (right - 100.0, tolerance_y - 18.0, right, tolerance_y);
    let (period_x, _) = axes.at(period_ms, 1.0);
    let period = (period_x - 2.0, axes.top, period_x + 2.0, bottom);
    let lines = [tolerance, words, period];
    ours.chain(theirs).map(around).chain(lines).collect()
}

/// Draws the measurements of other software at their times scaled to this scene.
fn draw_peers(
    svg: &mut Svg,
    axes: &Axes,
    chart: &Chart,
    peers: &[Peer],
    taken: &mut Vec<Rectangle>,
) {
    for peer in peers {
        let (x, y) = axes.at(peer.here_ms(chart), peer.error.max(MIN_ERROR));
        let tip = peer.description(chart);
        svg.raw(&format!(
            "<path d=\"M{x:.1} {:.1}l5.5 5.5l-5.5 5.5l-5.5 -5.5z\" fill=\"white\" stroke=\"{INK}\" stroke-width=\"1.3\" data-row=\"peer\" data-tip=\"{}\"/>",
            y - 5.5,
            escaped(&tip).replace('\n', "&#10;")
        ));
        label(svg, axes, (x, y), &peer.name, taken);
    }
}

fn front(svg: &mut Svg, axes: &Axes, chart: &Chart) {
    let mut front: Vec<(f64, f64)> = measured(chart)
        .filter(|(_, row, _)| row.pareto)
        .map(|(_, _, m)| (m.times.median_ms, m.errors.elements.max(MIN_ERROR)))
        .collect();
    front.sort_by(|a, b| a.0.total_cmp(&b.0));
    // The front is a step function: a smaller error is reached only at the time of the next point.
    let mut steps: Vec<(f64, f64)> = Vec::new();
    for &(ms, error) in &front {
        if let Some(&(_, last)) = steps.last() {
            steps.push((axes.at(ms, error).0, last));
        }
        steps.push(axes.at(ms, error));
    }
    svg.polyline(&steps, GREY, 1.5);
}

fn points(
    svg: &mut Svg,
    axes: &Axes,
    chart: &Chart,
    metric: impl Fn(&Measured) -> Option<f64>,
    least: f64,
    radius: f64,
) {
    for (k, row, m) in measured(chart) {
        let Some(value) = metric(m) else { continue };
        let value = value.max(least);
        let (x, y) = axes.at(m.times.median_ms, value);
        if radius > 4.0 {
            let (from, _) = axes.at(m.times.min_ms, value);
            let (to, _) = axes.at(m.times.max_ms, value);
            svg.line((from, y), (to, y), colour(row.method.synthesis), "");
        }
        if row.configured {
            svg.raw(&format!(
                "<circle cx=\"{x:.1}\" cy=\"{y:.1}\" r=\"{:.1}\" fill=\"none\" stroke=\"{INK}\" stroke-width=\"1.6\"/>",
                radius + 4.0
            ));
        }
        if row.planned_ms.is_some() {
            let r = radius + 6.0;
            svg.raw(&format!(
                "<path d=\"M{x:.1} {:.1}l{r:.1} {r:.1}l-{r:.1} {r:.1}l-{r:.1} -{r:.1}z\" fill=\"none\" stroke=\"{INK}\" stroke-width=\"1.6\"/>",
                y - r
            ));
        }
        let mut tip = String::new();
        let _ = write!(
            tip,
            "{}\n{:.2} ms ({:.2} to {:.2})\nelements {:.1e} (predicted {:.1e})",
            row.method,
            m.times.median_ms,
            m.times.min_ms,
            m.times.max_ms,
            m.errors.elements,
            row.predicted_error
        );
        if let Some(lines) = m.errors.lines {
            let _ = write!(tip, "\nlines {lines:.1e}");
        }
        if let Some(image) = m.errors.image_db {
            let _ = write!(tip, ", image {image:.3} dB");
        }
        let _ = write!(tip, "\nlevel {:+.3} dB", m.errors.level_db);
        if let Some(ms) = row.planned_ms {
            let _ = write!(tip, "\nselected: {ms:.2} ms on one core predicted");
        }
        let opacity = if row.pareto { 1.0 } else { 0.55 };
        svg.raw(&format!(
            "<circle cx=\"{x:.1}\" cy=\"{y:.1}\" r=\"{radius}\" fill=\"{}\" fill-opacity=\"{opacity}\" stroke=\"white\" stroke-width=\"0.8\" data-row=\"{k}\" data-tip=\"{}\"/>",
            colour(row.method.synthesis),
            escaped(&tip).replace('\n', "&#10;")
        ));
    }
}

/// Labels the configured and selected methods and the methods on the front, if space permits.
fn labels(svg: &mut Svg, axes: &Axes, chart: &Chart, taken: &mut Vec<Rectangle>) {
    // The configured and the selected method are placed first.
    let chosen = |row: &Row| row.configured || row.planned_ms.is_some();
    let first = measured(chart).filter(|(_, row, _)| chosen(row));
    let rest = measured(chart).filter(|(_, row, _)| row.pareto && !chosen(row));
    for (_, row, m) in first.chain(rest) {
        let at = axes.at(m.times.median_ms, m.errors.elements.max(MIN_ERROR));
        let text = match (row.configured, row.planned_ms.is_some()) {
            (true, true) => format!("{} (selected, as configured)", row.method),
            (true, false) => format!("{} (configured)", row.method),
            (false, true) => format!("{} (selected)", row.method),
            (false, false) => row.method.to_string(),
        };
        label(svg, axes, at, &text, taken);
    }
}

fn label(svg: &mut Svg, axes: &Axes, (x, y): (f64, f64), text: &str, taken: &mut Vec<Rectangle>) {
    let wide = width_of(text, LABEL);
    let places = [
        (x + 10.0, y - 6.0),
        (x + 10.0, y + 14.0),
        (x - 10.0 - wide, y + 14.0),
        (x - 10.0 - wide, y - 6.0),
        (x + 10.0, y - 20.0),
        (x + 10.0, y + 28.0),
        (x - 10.0 - wide, y + 28.0),
        (x - 0.5 * wide, y - 22.0),
        (x + 10.0, y + 42.0),
        (x - 10.0 - wide, y + 42.0),
        (x + 10.0, y - 36.0),
        (x - 10.0 - wide, y - 36.0),
        (x - 0.5 * wide, y + 44.0),
        (x + 10.0, y + 58.0),
    ];
    let free = places.into_iter().find(|&(left, base)| {
        let this = (left, base - LABEL, left + wide, base + 3.0);
        this.0 > axes.left
            && this.2 < axes.left + axes.width
            && this.1 > axes.top
            && this.3 < axes.top + axes.height
            && !taken
                .iter()
                .any(|t| this.0 < t.2 && t.0 < this.2 && this.1 < t.3 && t.1 < this.3)
    });
    if let Some((left, base)) = free {
        svg.label((left, base), LABEL, Anchor::Start, INK, text);
        taken.push((left, base - LABEL, left + wide, base + 3.0));
    }
}

fn legend(svg: &mut Svg, chart: &Chart, peers: bool) {
    let mut seen: Vec<Synthesis> = Vec::new();
    for (_, row, _) in measured(chart) {
        if !seen.contains(&row.method.synthesis) {
            seen.push(row.method.synthesis);
        }
    }
    let (mut x, y) = (70.0, 722.0);
    for synthesis in seen {
        svg.raw(&format!(
            "<circle cx=\"{x:.1}\" cy=\"{:.1}\" r=\"5.5\" fill=\"{}\"/>",
            y - 4.0,
            colour(synthesis)
        ));
        svg.label((x + 10.0, y), 12.0, Anchor::Start, INK, synthesis.name());
        x += 26.0 + width_of(synthesis.name(), 12.0);
    }
    let rest = "ring: configured; large diamond: selected; grey line: Pareto front; labels: synthesis, its tolerance, path, Doppler, culling";
    svg.label((70.0, y + 20.0), 11.0, Anchor::Start, GREY, rest);
    if peers {
        let rest = "small white diamonds: other software (tools/peers) on its own scatterers, static platform, sum only; time scaled to this scene's scatterer-element pairs and threads";
        svg.label((70.0, y + 35.0), 11.0, Anchor::Start, GREY, rest);
    }
}

/// Colours of the methods in the cost chart, which can share a synthesis.
const CURVES: [&str; 3] = ["#0072b2", "#d55e00", "#009e73"];

fn nth_colour(methods: &[Method], curve: &Curve) -> &'static str {
    let k = methods.iter().position(|m| *m == curve.method);
    CURVES[k.unwrap_or(0) % CURVES.len()]
}

/// Plots run time against four kinds of work.
pub(crate) fn work(curves: &[Curve], about: &ChartContext) -> String {
    let mut svg = Svg::new(WIDTH, 420.0);
    svg.label(
        (24.0, 32.0),
        20.0,
        Anchor::Start,
        INK,
        "Cost of a ping against the work in it",
    );
    let about = format!("{}, {}", about.machine, about.load_text());
    svg.label((24.0, 51.0), 11.5, Anchor::Start, GREY, &about);
    let y = decades(
        curves.iter().flat_map(|c| c.points.iter().map(|p| p.1)),
        1e-6,
    );
    let mut methods: Vec<Method> = Vec::new();
    for curve in curves {
        if !methods.contains(&curve.method) {
            methods.push(curve.method);
        }
    }
    for (k, work) in Work::ALL.into_iter().enumerate() {
        let these = || curves.iter().filter(move |curve| curve.work == work);
        let amounts = these().flat_map(|curve| curve.points.iter().map(|p| p.0));
        let (mut low, mut high) = (f64::INFINITY, 0.0f64);
        for amount in amounts {
            (low, high) = (low.min(amount), high.max(amount));
        }
        if high == 0.0 {
            continue;
        }
        let axes = Axes {
            left: 62.0 + 288.0 * k as f64,
            top: 86.0,
            width: 240.0,
            height: 230.0,
            x: (low.log10() - 0.1, high.log10() + 0.1),
            y,
        };
        axes.draw(
            &mut svg,
            work.name(),
            if k == 0 { "milliseconds per ping" } else { "" },
            11.0,
        );
        for (row, curve) in these().enumerate() {
            let colour = nth_colour(&methods, curve);
            let points: Vec<_> = curve.points.iter().map(|&(x, ms)| axes.at(x, ms)).collect();
            svg.polyline(&points, colour, 1.8);
            for (x, y) in points {
                svg.raw(&format!(
                    "<circle cx=\"{x:.1}\" cy=\"{y:.1}\" r=\"3.5\" fill=\"{colour}\"/>"
                ));
            }
            if let Some(p) = curve.exponent {
                let text = format!("exponent {p:.2}");
                let place = (axes.left + 10.0, axes.top + 18.0 + 15.0 * row as f64);
                svg.label(place, 11.5, Anchor::Start, colour, &text);
            }
        }
    }
    for (k, method) in methods.iter().enumerate() {
        let y = 382.0 + 18.0 * k as f64;
        svg.raw(&format!(
            "<circle cx=\"70\" cy=\"{:.1}\" r=\"5\" fill=\"{}\"/>",
            y - 4.0,
            colour(method.synthesis)
        ));
        svg.label((80.0, y), 12.0, Anchor::Start, INK, &method.to_string());
    }
    svg.finish()
}

//! Plot of a navigation log: the track on the left, attitude and heave over time on the right.

use std::path::Path;

use echotank_core::geodesy::LocalTangentPlane;
use echotank_core::navigation::{NavQuantity, NavSample};
use echotank_core::time::UtcNs;
use echotank_nav::report::LogReport;
use plotters::coord::Shift;
use plotters::prelude::*;

use echotank_drawing::{FAMILY, png};

const SIZE: (u32, u32) = (1400, 800);
const LINE: RGBColor = RGBColor(20, 80, 160);
const START: RGBColor = RGBColor(0, 150, 60);
const END: RGBColor = RGBColor(200, 40, 30);
const GRID: RGBColor = RGBColor(228, 228, 228);
/// Distance between samples, in median intervals, beyond which they are not joined.
const GAP_INTERVALS: f64 = 5.0;
/// Number of columns on the time axis. Each column keeps its first, extreme and last samples.
const COLUMNS: f64 = 1200.0;

type Area<'a> = DrawingArea<SVGBackend<'a>, Shift>;
type PlotError = Box<dyn std::error::Error>;
/// Horizontal and vertical value of a point.
type Point = (f64, f64);

/// Writes the plot as PNG.
pub(crate) fn write(path: &Path, report: &LogReport) -> Result<(), PlotError> {
    let mut svg = String::new();
    draw(&mut svg, report)?;
    Ok(std::fs::write(path, png(&svg)?)?)
}

fn draw(svg: &mut String, report: &LogReport) -> Result<(), PlotError> {
    let root = SVGBackend::with_string(svg, SIZE).into_drawing_area();
    root.fill(&WHITE)?;
    let (left, right) = root.split_horizontally(SIZE.0 / 2);
    track(&left, &report.samples)?;
    let mut samples: Vec<&NavSample> = report.samples.iter().collect();
    samples.sort_by_key(|s| s.valid_utc);
    let zero = samples.first().map_or(UtcNs(0), |s| s.valid_utc);
    let series = |of: fn(&NavQuantity) -> Option<f64>| -> Vec<Point> {
        let points = samples
            .iter()
            .filter_map(|s| Some((s.valid_utc.seconds_since(zero), of(&s.quantity)?)));
        points.collect()
    };
    let heading = series(|q| match q {
        NavQuantity::Heading { heading_rad } => Some(heading_rad.to_degrees()),
        _ => None,
    });
    let roll = series(|q| match q {
        NavQuantity::RollPitch { roll_rad, .. } => Some(roll_rad.to_degrees()),
        _ => None,
    });
    let pitch = series(|q| match q {
        NavQuantity::RollPitch { pitch_rad, .. } => Some(pitch_rad.to_degrees()),
        _ => None,
    });
    let heave = series(|q| match q {
        NavQuantity::Heave { heave_down_m } => Some(*heave_down_m),
        _ => None,
    });
    let span_s = samples
        .last()
        .map_or(1.0, |s| s.valid_utc.seconds_since(zero));
    let panels = [
        ("Heading, degrees", heading, true),
        ("Roll, degrees, starboard down", roll, false),
        ("Pitch, degrees, bow up", pitch, false),
        ("Heave, metres, down", heave, false),
    ];
    for (area, (title, points, wraps)) in right.split_evenly((4, 1)).iter().zip(&panels) {
        panel(area, title, points, span_s.max(1e-3), *wraps)?;
    }
    root.present()?;
    Ok(())
}

/// Draws one quantity over seconds since the first sample. With `wraps`, steps over 180 are not joined.
fn panel(
    area: &Area,
    title: &str,
    points: &[Point],
    span_s: f64,
    wraps: bool,
) -> Result<(), PlotError> {
    if points.is_empty() {
        area.titled(&format!("{title}: no samples"), (FAMILY, 16))?;
        return Ok(());
    }
    let low = points.iter().fold(f64::INFINITY, |m, p| m.min(p.1));
    let high = points.iter().fold(f64::NEG_INFINITY, |m, p| m.max(p.1));
    let (middle, half) = ((low + high) / 2.0, ((high - low) / 2.0).max(0.05) * 1.05);
    let mut chart = ChartBuilder::on(area)
        .caption(title, (FAMILY, 16))
        .margin_right(24)
        .x_label_area_size(36)
        .y_label_area_size(70)
        .build_cartesian_2d(0.0..span_s, middle - half..middle + half)?;
    chart
        .configure_mesh()
        .x_labels(8)
        .y_labels(5)
        .x_desc("seconds since the first sample")
        .label_style((FAMILY, 12))
        .bold_line_style(GRID)
        .light_line_style(TRANSPARENT)
        .draw()?;
    let mut intervals: Vec<f64> = points.windows(2).map(|w| w[1].0 - w[0].0).collect();
    intervals.sort_by(f64::total_cmp);
    let median = intervals.get(intervals.len() / 2).copied().unwrap_or(0.0);
    let joined = |a: &Point, b: &Point| {
        !(wraps && (b.1 - a.1).abs() > 180.0) && b.0 - a.0 <= median * GAP_INTERVALS + 1e-3
    };
    let column = |p: &Point| (p.0 / span_s * COLUMNS) as i64;
    for run in points.chunk_by(joined) {
        // A run of one sample has no line, so the start of every run is marked.
        chart.draw_series(run.first().map(|p| Circle::new(*p, 1, LINE.filled())))?;
        let kept = run
            .chunk_by(|a, b| column(a) == column(b))
            .flat_map(extremes);
        chart.draw_series(LineSeries::new(kept, LINE))?;
    }
    Ok(())
}

/// First, lowest, highest and last point of a pixel column.
fn extremes(points: &[Point]) -> impl Iterator<Item = Point> {
    let by_value = |a: &&Point, b: &&Point| a.1.total_cmp(&b.1);
    let lowest = points.iter().min_by(by_value);
    let highest = points.iter().max_by(by_value);
    let kept = [points.first(), lowest, highest, points.last()];
    kept.into_iter().flatten().copied()
}

/// Draws north over east, metres, with equal scales.
fn track(area: &Area, samples: &[NavSample]) -> Result<(), PlotError> {
    let mut plane = None;
    let mut points: Vec<Point> = Vec::new();
    for s in samples {
        if let NavQuantity::Position {
            latitude_rad,
            longitude_rad,
            ..
        } = s.quantity
        {
            let plane =
                plane.get_or_insert_with(|| LocalTangentPlane::new(latitude_rad, longitude_rad));
            let (north, east) = plane.local_m(latitude_rad, longitude_rad);
            points.push((east, north));
        }
    }
    let (Some(first), Some(last)) = (points.first().copied(), points.last().copied()) else {
        area.titled("Track: no samples", (FAMILY, 16))?;
        return Ok(());
    };
    let title = "Track, metres, north up (green: start, red: end)";
    let area = area.titled(title, (FAMILY, 16))?;
    let range = |of: fn(&Point) -> f64| {
        let (low, high) = points
            .iter()
            .map(of)
            .fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), v| {
                (low.min(v), high.max(v))
            });
        ((low + high) / 2.0, high - low)
    };
    let ((east, width), (north, height)) = (range(|p| p.0), range(|p| p.1));
    let (x_label_size, y_label_size, margin) = (40, 80, 16);
    let pixels = area.dim_in_pixel();
    let across = f64::from(pixels.0 - y_label_size - 2 * margin);
    let down = f64::from(pixels.1 - x_label_size);
    let metres_per_pixel = 1.08 * (width / across).max(height / down).max(1e-5);
    let (half_x, half_y) = (
        across * metres_per_pixel / 2.0,
        down * metres_per_pixel / 2.0,
    );
    let mut chart = ChartBuilder::on(&area)
        .margin_left(margin)
        .margin_right(margin)
        .x_label_area_size(x_label_size)
        .y_label_area_size(y_label_size)
        .build_cartesian_2d(east - half_x..east + half_x, north - half_y..north + half_y)?;
    chart
        .configure_mesh()
        .x_labels(6)
        .y_labels(8)
        .x_desc("east")
        .y_desc("north")
        .label_style((FAMILY, 12))
        .bold_line_style(GRID)
        .light_line_style(TRANSPARENT)
        .draw()?;
    // Steps shorter than half a pixel are not drawn, because a vessel at rest logs many of them.
    points.dedup_by(|b, a| (b.0 - a.0).hypot(b.1 - a.1) < metres_per_pixel / 2.0);
    chart.draw_series(LineSeries::new(points, LINE))?;
    chart.draw_series([
        Circle::new(first, 4, START.filled()),
        Circle::new(last, 4, END.filled()),
    ])?;
    Ok(())
}

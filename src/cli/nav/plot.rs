//! A picture of a log: the track on the left, attitude and heave over time on the right.

use std::io::Write;
use std::path::Path;

use echotank_core::flow::{NavQuantity, NavSample};
use echotank_core::geodesy::LocalTangentPlane;
use echotank_core::time::UtcNs;
use echotank_nav::report::LogReport;

const WIDTH: usize = 1400;
const HEIGHT: usize = 800;
const BACKGROUND: [u8; 3] = [255, 255, 255];
const FRAME: [u8; 3] = [120, 120, 120];
const GRID: [u8; 3] = [228, 228, 228];
const INK: [u8; 3] = [20, 20, 20];
const LINE: [u8; 3] = [20, 80, 160];
const START: [u8; 3] = [0, 150, 60];
const END: [u8; 3] = [200, 40, 30];
/// Samples farther apart than this many usual steps are not joined.
const BREAK_STEPS: f64 = 5.0;
/// A font pixel is so many of the picture's.
const SCALE: usize = 2;

/// A rectangle of the picture, pixels, for the drawing inside its frame.
#[derive(Clone, Copy)]
struct Area {
    left: usize,
    top: usize,
    width: usize,
    height: usize,
}

struct Picture {
    pixels: Vec<u8>,
}

/// Draws what the log gave.
pub(crate) fn write(path: &Path, report: &LogReport) -> std::io::Result<()> {
    let mut picture = Picture {
        pixels: BACKGROUND.repeat(WIDTH * HEIGHT),
    };
    picture.track(&report.samples);
    let mut samples: Vec<&NavSample> = report.samples.iter().collect();
    samples.sort_by_key(|s| s.valid_utc);
    let zero = samples.first().map_or(UtcNs(0), |s| s.valid_utc);
    let series = |of: fn(&NavQuantity) -> Option<f64>| -> Vec<(f64, f64)> {
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
    let panels = [
        ("HEADING DEG", heading, true),
        ("ROLL DEG, STARBOARD DOWN", roll, false),
        ("PITCH DEG, BOW UP", pitch, false),
        ("HEAVE M, DOWN", heave, false),
    ];
    let span_s = samples
        .last()
        .map_or(1.0, |s| s.valid_utc.seconds_since(zero));
    for (i, (title, points, is_heading)) in panels.iter().enumerate() {
        let area = Area {
            left: 760,
            top: 30 + i * 192,
            width: 610,
            height: 140,
        };
        picture.panel(area, title, points, span_s.max(1e-3), *is_heading);
    }
    picture.save(path)
}

impl Picture {
    fn dot(&mut self, x: i64, y: i64, colour: [u8; 3]) {
        if (0..WIDTH as i64).contains(&x) && (0..HEIGHT as i64).contains(&y) {
            let at = (y as usize * WIDTH + x as usize) * 3;
            self.pixels[at..at + 3].copy_from_slice(&colour);
        }
    }

    fn line(&mut self, from: (f64, f64), to: (f64, f64), colour: [u8; 3]) {
        let steps = (to.0 - from.0)
            .abs()
            .max((to.1 - from.1).abs())
            .ceil()
            .max(1.0);
        for i in 0..=steps as usize {
            let u = i as f64 / steps;
            let x = from.0 + (to.0 - from.0) * u;
            let y = from.1 + (to.1 - from.1) * u;
            self.dot(x.round() as i64, y.round() as i64, colour);
        }
    }

    fn blob(&mut self, (x, y): (f64, f64), colour: [u8; 3]) {
        for dy in -4..=4_i64 {
            for dx in -4..=4_i64 {
                if dx * dx + dy * dy <= 17 {
                    self.dot(x as i64 + dx, y as i64 + dy, colour);
                }
            }
        }
    }

    /// What would run over the edge is moved in from it.
    fn text(&mut self, left: usize, top: usize, text: &str) {
        let left = left.min(WIDTH.saturating_sub(text.len() * 4 * SCALE));
        for (i, letter) in text.chars().enumerate() {
            for (row, bits) in glyph(letter).into_iter().enumerate() {
                for column in 0..3 {
                    if bits >> (2 - column) & 1 == 0 {
                        continue;
                    }
                    for (dx, dy) in [(0, 0), (0, 1), (1, 0), (1, 1)] {
                        let x = left + (i * 4 + column) * SCALE + dx;
                        let y = top + row * SCALE + dy;
                        self.dot(x as i64, y as i64, INK);
                    }
                }
            }
        }
    }

    fn frame(&mut self, a: Area) {
        let (left, top) = (a.left as f64, a.top as f64);
        let (right, bottom) = (left + a.width as f64, top + a.height as f64);
        for (from, to) in [
            ((left, top), (right, top)),
            ((left, bottom), (right, bottom)),
            ((left, top), (left, bottom)),
            ((right, top), (right, bottom)),
        ] {
            self.line(from, to, FRAME);
        }
    }

    fn panel(
        &mut self,
        a: Area,
        title: &str,
        points: &[(f64, f64)],
        span_s: f64,
        is_heading: bool,
    ) {
        self.text(a.left, a.top - 16, title);
        if points.is_empty() {
            self.frame(a);
            self.text(a.left + 12, a.top + 12, "NOTHING");
            return;
        }
        let low = points.iter().fold(f64::INFINITY, |m, p| m.min(p.1));
        let high = points.iter().fold(f64::NEG_INFINITY, |m, p| m.max(p.1));
        // A flat line lies in the middle of its panel.
        let half = ((high - low) / 2.0).max(0.05) * 1.05;
        let (low, high) = ((low + high) / 2.0 - half, (low + high) / 2.0 + half);
        let x = |t: f64| a.left as f64 + t / span_s * a.width as f64;
        let y = |v: f64| a.top as f64 + (high - v) / (high - low) * a.height as f64;
        let (right, bottom) = ((a.left + a.width) as f64, (a.top + a.height) as f64);
        for v in ticks(low, high, 4) {
            self.line((a.left as f64, y(v)), (right, y(v)), GRID);
            self.text(a.left - 78, y(v) as usize - 5, &format!("{:>9}", label(v)));
        }
        for t in ticks(0.0, span_s, 6) {
            self.line((x(t), a.top as f64), (x(t), bottom), GRID);
            self.text(
                x(t) as usize,
                a.top + a.height + 6,
                &format!("{} S", label(t)),
            );
        }
        self.frame(a);
        let mut steps: Vec<f64> = points.windows(2).map(|w| w[1].0 - w[0].0).collect();
        steps.sort_by(f64::total_cmp);
        let usual = steps.get(steps.len() / 2).copied().unwrap_or(0.0);
        for w in points.windows(2) {
            let wraps = is_heading && (w[1].1 - w[0].1).abs() > 180.0;
            if !wraps && w[1].0 - w[0].0 <= usual * BREAK_STEPS + 1e-3 {
                self.line((x(w[0].0), y(w[0].1)), (x(w[1].0), y(w[1].1)), LINE);
            }
        }
        for (t, v) in points {
            self.dot(x(*t).round() as i64, y(*v).round() as i64, LINE);
        }
    }

    fn track(&mut self, samples: &[NavSample]) {
        let area = Area {
            left: 90,
            top: 30,
            width: 560,
            height: 716,
        };
        self.text(
            area.left,
            area.top - 16,
            "TRACK M, NORTH UP, GREEN START, RED END",
        );
        let mut plane = None;
        let mut points: Vec<(f64, f64)> = Vec::new();
        for s in samples {
            if let NavQuantity::Position {
                latitude_rad,
                longitude_rad,
                ..
            } = s.quantity
            {
                let plane = plane
                    .get_or_insert_with(|| LocalTangentPlane::new(latitude_rad, longitude_rad));
                let (north, east) = plane.local_m(latitude_rad, longitude_rad);
                points.push((east, north));
            }
        }
        let (Some(first), Some(last)) = (points.first().copied(), points.last().copied()) else {
            self.frame(area);
            self.text(area.left + 12, area.top + 12, "NOTHING");
            return;
        };
        let fold = |pick: fn(&(f64, f64)) -> f64, start: f64, keep: fn(f64, f64) -> f64| {
            points.iter().map(pick).fold(start, keep)
        };
        let (west, east) = (
            fold(|p| p.0, f64::INFINITY, f64::min),
            fold(|p| p.0, f64::NEG_INFINITY, f64::max),
        );
        let (south, north) = (
            fold(|p| p.1, f64::INFINITY, f64::min),
            fold(|p| p.1, f64::NEG_INFINITY, f64::max),
        );
        // One scale for both axes.
        let per_pixel = ((east - west) / area.width as f64)
            .max((north - south) / area.height as f64)
            .max(1e-5)
            * 1.08;
        let (mid_e, mid_n) = ((west + east) / 2.0, (south + north) / 2.0);
        let (half_w, half_h) = (area.width as f64 / 2.0, area.height as f64 / 2.0);
        let x = |e: f64| area.left as f64 + half_w + (e - mid_e) / per_pixel;
        let y = |n: f64| area.top as f64 + half_h - (n - mid_n) / per_pixel;
        let (reach_e, reach_n) = (half_w * per_pixel, half_h * per_pixel);
        for n in ticks(mid_n - reach_n, mid_n + reach_n, 6) {
            let right = (area.left + area.width) as f64;
            self.line((area.left as f64, y(n)), (right, y(n)), GRID);
            self.text(
                area.left - 78,
                y(n) as usize - 5,
                &format!("{:>9}", label(n)),
            );
        }
        for e in ticks(mid_e - reach_e, mid_e + reach_e, 5) {
            let bottom = (area.top + area.height) as f64;
            self.line((x(e), area.top as f64), (x(e), bottom), GRID);
            let text = label(e);
            let left = x(e) as usize - text.len() * 2 * SCALE;
            self.text(left, area.top + area.height + 6, &text);
        }
        self.frame(area);
        for w in points.windows(2) {
            self.line((x(w[0].0), y(w[0].1)), (x(w[1].0), y(w[1].1)), LINE);
        }
        self.blob((x(first.0), y(first.1)), START);
        self.blob((x(last.0), y(last.1)), END);
    }

    fn save(&self, path: &Path) -> std::io::Result<()> {
        let mut bytes = Vec::new();
        let mut encoder = png::Encoder::new(&mut bytes, WIDTH as u32, HEIGHT as u32);
        encoder.set_color(png::ColorType::Rgb);
        encoder.set_depth(png::BitDepth::Eight);
        let mut writer = encoder.write_header().map_err(std::io::Error::other)?;
        writer
            .write_image_data(&self.pixels)
            .map_err(std::io::Error::other)?;
        writer.finish().map_err(std::io::Error::other)?;
        std::fs::File::create(path)?.write_all(&bytes)
    }
}

/// Round numbers between `low` and `high`, at most `most` + 1 of them.
fn ticks(low: f64, high: f64, most: usize) -> Vec<f64> {
    let rough = (high - low) / most as f64;
    let ten = 10_f64.powf(rough.log10().floor());
    let step = [1.0, 2.0, 5.0, 10.0]
        .into_iter()
        .map(|m| m * ten)
        .find(|step| *step >= rough * 0.999)
        .unwrap_or(ten * 10.0);
    let first = (low / step).ceil() as i64;
    let last = (high / step).floor() as i64;
    (first..=last).map(|i| i as f64 * step).collect()
}

/// Without noise behind the point.
fn label(value: f64) -> String {
    let text = format!("{value:.4}");
    let text = text.trim_end_matches('0').trim_end_matches('.');
    match text {
        "-0" => "0".to_owned(),
        _ => text.to_owned(),
    }
}

/// Five rows of three pixels, the left one in bit 2.
fn glyph(letter: char) -> [u8; 5] {
    match letter.to_ascii_uppercase() {
        '0' => [7, 5, 5, 5, 7],
        '1' => [2, 6, 2, 2, 7],
        '2' => [7, 1, 7, 4, 7],
        '3' => [7, 1, 7, 1, 7],
        '4' => [5, 5, 7, 1, 1],
        '5' => [7, 4, 7, 1, 7],
        '6' => [7, 4, 7, 5, 7],
        '7' => [7, 1, 1, 2, 2],
        '8' => [7, 5, 7, 5, 7],
        '9' => [7, 5, 7, 1, 7],
        '-' => [0, 0, 7, 0, 0],
        '.' => [0, 0, 0, 0, 2],
        ',' => [0, 0, 0, 2, 4],
        'A' => [2, 5, 7, 5, 5],
        'B' => [6, 5, 6, 5, 6],
        'C' => [7, 4, 4, 4, 7],
        'D' => [6, 5, 5, 5, 6],
        'E' => [7, 4, 6, 4, 7],
        'F' => [7, 4, 6, 4, 4],
        'G' => [7, 4, 5, 5, 7],
        'H' => [5, 5, 7, 5, 5],
        'I' => [7, 2, 2, 2, 7],
        'K' => [5, 5, 6, 5, 5],
        'L' => [4, 4, 4, 4, 7],
        'M' => [5, 7, 7, 5, 5],
        'N' => [6, 5, 5, 5, 5],
        'O' => [7, 5, 5, 5, 7],
        'P' => [7, 5, 7, 4, 4],
        'R' => [6, 5, 6, 5, 5],
        'S' => [3, 4, 2, 1, 6],
        'T' => [7, 2, 2, 2, 2],
        'U' => [5, 5, 5, 5, 7],
        'V' => [5, 5, 5, 5, 2],
        'W' => [5, 5, 7, 7, 5],
        _ => [0; 5],
    }
}

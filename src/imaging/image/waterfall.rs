//! The waterfall: side-scan lines stacked into a picture, in slant range or ground range.
//!
//! Port is on the left and mirrored, starboard on the right, so that the start of the pulse lies in the middle. The newest ping is at the
//! top, as on a chart with the ship's heading up. A missing ping number keeps its rows, in the background colour.
//!
//! Memory: one f32 per column and ping, or 4 (2 range / metres-per-pixel) bytes per ping (16 kB for 200 m at 0.1 m). At most
//! [`WaterfallSpec::max_pings`] pings are stored; further pings are counted and omitted.

use echotank_core::ping::{Line, PingPlan, Side};

use super::line::{Projection, RangeAxis, cell_intensity};
use crate::image::colour;
use echotank_config::spec::ColourMap;
pub use echotank_config::spec::Contrast as Scale;

/// Settings of a waterfall.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct WaterfallSpec {
    /// Maximum range on each side, in the columns' projection.
    pub range_m: f64,
    /// Width of a column.
    pub metres_per_pixel: f64,
    /// Picture rows per ping; see [`rows_that_keep_the_aspect`].
    pub rows_per_ping: u32,
    /// Mapping from level to brightness.
    pub scale: Scale,
    /// Colour map.
    pub colours: ColourMap,
    /// Divides out the mean level at each range (a moving mean in dB over all pings, for each side), as survey viewers do.
    pub normalise_range: bool,
    /// Distance between faint range lines.
    pub range_ticks_m: Option<f64>,
    /// Maximum number of stored pings.
    pub max_pings: usize,
}

impl Default for WaterfallSpec {
    fn default() -> Self {
        Self {
            range_m: 100.0,
            metres_per_pixel: 0.1,
            rows_per_ping: 1,
            scale: Scale::Percentiles {
                low: 0.02,
                high: 0.998,
            },
            colours: ColourMap::Copper,
            normalise_range: false,
            range_ticks_m: Some(50.0),
            max_pings: 20_000,
        }
    }
}

/// Picture rows that make one ping as tall as the ship's advance between pings, at least one.
pub fn rows_that_keep_the_aspect(advance_m: f64, metres_per_pixel: f64) -> u32 {
    (advance_m / metres_per_pixel).round().clamp(1.0, 1000.0) as u32
}

/// Half the width, in pixels, of the moving mean that determines the level at a range. It is wide enough that one strong target does not
/// dim its surroundings, and narrow enough for the first bottom return.
const NORMALISE_HALF_WIDTH: usize = 8;
/// Minimum span of a picture's scale, dB, so that an even seabed is not stretched into noise.
const MIN_SPAN_DB: f64 = 12.0;
/// Opacity of a range line.
const TICK_SHARE: f64 = 0.25;
/// Colour of pixels without data.
const BACKGROUND: [u8; 3] = [16, 24, 48];

/// Histogram of levels for the percentiles: finer than visible steps and wider than any receiver's range.
const HISTOGRAM_LOW_DB: f64 = -400.0;
const HISTOGRAM_STEP_DB: f64 = 0.1;
const HISTOGRAM_BINS: usize = 8000;

/// Accumulates lines and draws the picture.
pub struct Waterfall {
    spec: WaterfallSpec,
    sample_rate_hz: f64,
    columns_per_side: usize,
    first_ping: Option<u32>,
    /// Intensities, row-major, oldest ping first; NaN without data.
    rows: Vec<f32>,
    left_out: u64,
}

impl Waterfall {
    /// An empty waterfall; `sample_rate_hz` is that of the lines.
    pub fn new(spec: WaterfallSpec, sample_rate_hz: f64) -> Self {
        let columns = (spec.range_m / spec.metres_per_pixel - 1e-9).ceil();
        Self {
            columns_per_side: columns.clamp(1.0, 100_000.0) as usize,
            spec,
            sample_rate_hz,
            first_ping: None,
            rows: Vec::new(),
            left_out: 0,
        }
    }

    /// Adds one ping's lines in slant range. Of two lines of one side, the later is used.
    pub fn push(&mut self, plan: &PingPlan, lines: &[Line]) {
        self.push_with(plan, lines, Some(Projection::Slant));
    }

    /// Adds one ping's lines in any projection. Without a projection, the ping's rows stay empty.
    pub fn push_with(&mut self, plan: &PingPlan, lines: &[Line], projection: Option<Projection>) {
        let ping_number = plan.ping_number;
        let first = *self.first_ping.get_or_insert(ping_number);
        let place = ping_number
            .checked_sub(first)
            .map(|p| p as usize)
            .filter(|&p| p < self.spec.max_pings);
        let Some(place) = place else {
            self.left_out += 1;
            return;
        };
        let width = self.width();
        let end = (place + 1) * width;
        if self.rows.len() < end {
            self.rows.resize(end, f32::NAN);
        }
        let row = &mut self.rows[place * width..end];
        let (port, starboard) = row.split_at_mut(self.columns_per_side);
        let axis = RangeAxis::new(plan.sound_speed_m_per_s, self.sample_rate_hz);
        let Some(projection) = projection else {
            return;
        };
        for line in lines {
            let half = match line.side {
                Side::Port => &mut *port,
                Side::Starboard => &mut *starboard,
            };
            let cell_m = self.spec.metres_per_pixel;
            cell_intensity(&line.amplitude, axis, projection, cell_m, 0.0, half);
            if line.side == Side::Port {
                half.reverse();
            }
        }
    }

    /// Settings of the waterfall.
    pub fn spec(&self) -> &WaterfallSpec {
        &self.spec
    }

    /// Number of pings omitted: before the first or beyond [`WaterfallSpec::max_pings`].
    pub fn left_out(&self) -> u64 {
        self.left_out
    }

    /// Number of pings in the picture, including missing ones.
    pub fn pings(&self) -> usize {
        self.rows.len() / self.width()
    }

    /// Width in pixels.
    pub fn width(&self) -> usize {
        2 * self.columns_per_side
    }

    /// Height in pixels.
    pub fn height(&self) -> usize {
        self.pings() * self.spec.rows_per_ping.max(1) as usize
    }

    /// Draws the picture from top to bottom. `row_out` receives each row once, as `width() * 3` bytes red-green-blue; its first error stops
    /// the drawing.
    pub fn render<E>(&self, mut row_out: impl FnMut(&[u8]) -> Result<(), E>) -> Result<(), E> {
        let width = self.width();
        let level_db = self.column_levels_db();
        let (low_db, high_db) = self.span_db(&level_db);
        let tick = self.tick_columns();
        let mut rgb = vec![0; width * 3];
        for row in self.rows.chunks_exact(width).rev() {
            for x in 0..width {
                let mut color = if row[x].is_nan() {
                    BACKGROUND
                } else {
                    let db = decibels(row[x]) - level_db[x];
                    colour::rgb(
                        self.spec.colours,
                        ((db - low_db) / (high_db - low_db)) as f32,
                    )
                };
                if tick[x] {
                    color = color
                        .map(|c| (f64::from(c) * (1.0 - TICK_SHARE) + 255.0 * TICK_SHARE) as u8);
                }
                rgb[3 * x..3 * x + 3].copy_from_slice(&color);
            }
            for _ in 0..self.spec.rows_per_ping.max(1) {
                row_out(&rgb)?;
            }
        }
        Ok(())
    }

    /// Level subtracted from every pixel of a column, dB; zero without range normalisation.
    fn column_levels_db(&self) -> Vec<f64> {
        let width = self.width();
        if !self.spec.normalise_range {
            return vec![0.0; width];
        }
        // Sums over pings of finite levels, then a moving mean over columns of the same side.
        let mut sum = vec![(0.0, 0_u64); width];
        for row in self.rows.chunks_exact(width) {
            for (s, &p) in sum.iter_mut().zip(row) {
                if p > 0.0 {
                    s.0 += decibels(p);
                    s.1 += 1;
                }
            }
        }
        (0..width)
            .map(|x| {
                let side = if x < self.columns_per_side {
                    0..self.columns_per_side
                } else {
                    self.columns_per_side..width
                };
                let near = x.saturating_sub(NORMALISE_HALF_WIDTH).max(side.start)
                    ..(x + NORMALISE_HALF_WIDTH + 1).min(side.end);
                let (total, count) = sum[near]
                    .iter()
                    .fold((0.0, 0), |(t, n), s| (t + s.0, n + s.1));
                if count == 0 {
                    0.0
                } else {
                    total / count as f64
                }
            })
            .collect()
    }

    fn span_db(&self, level_db: &[f64]) -> (f64, f64) {
        let (low_db, high_db) = match self.spec.scale {
            Scale::Fixed { low_db, high_db } => return (low_db, high_db.max(low_db + 1e-3)),
            Scale::Percentiles { low, high } => {
                let mut histogram = vec![0_u64; HISTOGRAM_BINS];
                let mut count = 0;
                for row in self.rows.chunks_exact(self.width()) {
                    for (&p, level) in row.iter().zip(level_db) {
                        if p > 0.0 {
                            let bin = (decibels(p) - level - HISTOGRAM_LOW_DB) / HISTOGRAM_STEP_DB;
                            histogram[(bin.max(0.0) as usize).min(HISTOGRAM_BINS - 1)] += 1;
                            count += 1;
                        }
                    }
                }
                let at = |share: f64| {
                    let wanted = share * count as f64;
                    let mut below = 0;
                    let bin = histogram.iter().position(|n| {
                        below += n;
                        below as f64 >= wanted && below > 0
                    });
                    HISTOGRAM_LOW_DB + (bin.unwrap_or(0) as f64 + 0.5) * HISTOGRAM_STEP_DB
                };
                (at(low), at(high))
            }
        };
        (low_db.min(high_db - MIN_SPAN_DB), high_db)
    }

    fn tick_columns(&self) -> Vec<bool> {
        let mut tick = vec![false; self.width()];
        if let Some(every_m) = self.spec.range_ticks_m.filter(|m| *m > 0.0) {
            for i in 1.. {
                let column = (f64::from(i) * every_m / self.spec.metres_per_pixel).floor();
                if column >= self.columns_per_side as f64 {
                    break;
                }
                tick[self.columns_per_side - 1 - column as usize] = true;
                tick[self.columns_per_side + column as usize] = true;
            }
        }
        tick
    }
}

fn decibels(intensity: f32) -> f64 {
    10.0 * f64::from(intensity).log10()
}

#[cfg(test)]
mod tests {
    use super::*;
    use echotank_core::pulse::{Pulse, PulseKind};
    use echotank_core::testing::plan_at_rest;
    use std::convert::Infallible;

    const RATE_HZ: f64 = 40e3;
    const C: f64 = 1500.0;

    fn plan(ping_number: u32) -> PingPlan {
        let pulse = Pulse {
            kind: PulseKind::Cw,
            center_frequency_hz: 400e3,
            bandwidth_hz: 0.0,
            duration_s: 1e-3,
            taper: 0.0,
        };
        PingPlan {
            ping_number,
            ..plan_at_rest(&pulse, 3200, C)
        }
    }

    fn line(side: Side, amplitude: Vec<f32>) -> Line {
        Line { side, amplitude }
    }

    fn spec() -> WaterfallSpec {
        WaterfallSpec {
            range_m: 60.0,
            metres_per_pixel: 0.15,
            range_ticks_m: None,
            ..WaterfallSpec::default()
        }
    }

    fn picture(w: &Waterfall) -> Vec<Vec<u8>> {
        let mut rows = Vec::new();
        let Ok(()) = w.render(|row| {
            rows.push(row.to_vec());
            Ok::<_, Infallible>(())
        });
        rows
    }

    fn brightness(rows: &[Vec<u8>], x: u32, y: u32) -> u32 {
        let at = 3 * x as usize;
        rows[y as usize][at..at + 3]
            .iter()
            .map(|&c| u32::from(c))
            .sum()
    }

    #[test]
    fn an_echo_is_the_brightest_pixel_at_its_range_and_ping() {
        let axis = RangeAxis::new(C, RATE_HZ);
        let mut w = Waterfall::new(
            WaterfallSpec {
                rows_per_ping: 3,
                scale: Scale::Fixed {
                    low_db: -50.0,
                    high_db: 0.0,
                },
                ..spec()
            },
            RATE_HZ,
        );
        let (echo_m, echo_ping) = (37.4, 12);
        for ping in 10..=20 {
            let mut port = vec![0.01_f32; 3200];
            if ping == echo_ping {
                port[axis.sample(echo_m)] = 1.0;
            }
            let lines = [
                line(Side::Starboard, vec![0.01; 3200]),
                line(Side::Port, port),
            ];
            w.push(&plan(ping), &lines);
        }
        let rows = picture(&w);
        assert_eq!((rows.len(), rows[0].len()), (33, 3 * 800));
        // Eight newer pings of three rows each are above it; it is 249 columns left of the middle.
        let (x, y) = (399 - 249, 24);
        let peak = brightness(&rows, x, y);
        for (py, row) in rows.iter().enumerate() {
            for px in 0..row.len() / 3 {
                let mine = px as u32 == x && (24..27).contains(&py);
                let got = brightness(&rows, px as u32, py as u32);
                assert!(
                    if mine { got == peak } else { got < peak },
                    "{px} {py}: {got} {peak}"
                );
            }
        }
    }

    #[test]
    fn port_is_left_and_mirrored_starboard_is_right() {
        let mut w = Waterfall::new(spec(), RATE_HZ);
        let ramp: Vec<f32> = (0..3200).map(|k| 1e-3 * (1.0 + k as f32)).collect();
        let lines = [line(Side::Port, ramp.clone()), line(Side::Starboard, ramp)];
        w.push(&plan(1), &lines);
        let rows = picture(&w);
        for x in 0..400 {
            assert_eq!(
                brightness(&rows, x, 0),
                brightness(&rows, 799 - x, 0),
                "column {x}"
            );
        }
        assert!(brightness(&rows, 0, 0) > brightness(&rows, 380, 0));
    }

    #[test]
    fn missing_pings_and_missing_sides_stay_empty() {
        let mut w = Waterfall::new(spec(), RATE_HZ);
        w.push(&plan(5), &[line(Side::Port, vec![1.0; 3200])]);
        w.push(&plan(8), &[line(Side::Port, vec![1.0; 3200])]);
        let rows = picture(&w);
        assert_eq!(rows.len(), 4);
        for y in [1, 2] {
            assert_eq!(rows[y][..3], BACKGROUND, "ping {} is missing", 8 - y);
        }
        assert_eq!(rows[0][3 * 500..][..3], BACKGROUND, "starboard has no line");
        assert_ne!(rows[0][..3], BACKGROUND);
    }

    #[test]
    fn pings_beyond_the_memory_are_counted() {
        let mut w = Waterfall::new(
            WaterfallSpec {
                max_pings: 2,
                ..spec()
            },
            RATE_HZ,
        );
        for ping in [7, 8, 9, 6, u32::MAX] {
            w.push(&plan(ping), &[]);
        }
        assert_eq!((w.pings(), w.left_out()), (2, 3));
    }

    #[test]
    fn range_normalisation_flattens_a_falling_level_within_half_a_db() {
        let make = |normalise_range| {
            let mut w = Waterfall::new(
                WaterfallSpec {
                    normalise_range,
                    scale: Scale::Fixed {
                        low_db: -60.0,
                        high_db: 60.0,
                    },
                    ..spec()
                },
                RATE_HZ,
            );
            for ping in 1..40 {
                // 40 log r, from 6 m on.
                let amplitude: Vec<f32> = (0..3200)
                    .map(|k| 10.0 / (1.0 + k as f32 / 320.0).powi(2))
                    .collect();
                w.push(&plan(ping), &[line(Side::Starboard, amplitude)]);
            }
            let rows = picture(&w);
            let level = |x| brightness(&rows, x, 20);
            (level(440), level(780))
        };
        let (near, far) = make(false);
        assert!(near > far + 60, "{near} {far}");
        let (near, far) = make(true);
        // One step of the 765 is 0.2 dB here.
        assert!(near.abs_diff(far) <= 3, "{near} {far}");
    }

    #[test]
    fn empty_silent_and_invalid_pictures_are_drawn_without_panic() {
        for amplitude in [
            vec![],
            vec![0.0; 100],
            vec![f32::NAN; 100],
            vec![f32::INFINITY; 3000],
        ] {
            for normalise_range in [false, true] {
                let mut w = Waterfall::new(
                    WaterfallSpec {
                        normalise_range,
                        ..WaterfallSpec::default()
                    },
                    RATE_HZ,
                );
                w.push(&plan(1), &[line(Side::Port, amplitude.clone())]);
                assert_eq!(picture(&w).len(), 1);
            }
        }
        assert_eq!(picture(&Waterfall::new(spec(), RATE_HZ)).len(), 0);
    }

    #[test]
    fn rows_per_ping_keep_the_aspect() {
        assert_eq!(rows_that_keep_the_aspect(0.5, 0.1), 5);
        assert_eq!(rows_that_keep_the_aspect(0.01, 0.1), 1);
    }
}

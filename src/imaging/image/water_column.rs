//! Pictures of a fan of beams: the polar fan of one ping, and all pings stacked along the track.
//!
//! The polar fan lies in the plane of its array, with the boresight down, starboard right, and ranges and angles marked. A pixel takes the
//! mean intensity of its samples in the beam nearest in angle; soundings are dots. The stack has a column per ping, with slant range
//! downwards. A pixel takes the strongest beam at its range, so that targets in the water column stay visible above the bottom. Masks use
//! the same samples as the pixels ([`polar_masks`], [`Stack::masks`]).
//!
//! Not modelled: refraction. The picture is not rotated with the roll.

use std::ops::Range;

use crate::image::colour::rgb;
use echotank_config::spec::{ColourMap, Contrast};
use echotank_core::ping::{BeamFrame, LineTruth, PingPlan, Sounding};

use super::labels;
use super::masks::{Mask, mask_of};

/// Pixels along the longest range of a fan or stack.
const PIXELS: usize = 480;
/// Margin for the labels, pixels.
const MARGIN: usize = 40;
/// Left margin of a stack, for its labels and marks, pixels.
const LEFT: usize = MARGIN + 16;
const BACKGROUND: [u8; 3] = [0, 0, 0];
const MARK: [u8; 3] = [150, 150, 150];
const SOUNDING: [u8; 3] = [255, 64, 32];
/// Dynamic range of automatic contrast.
const SPAN_DB: f64 = 60.0;

/// Red-green-blue picture.
pub struct Picture {
    /// Width in pixels.
    pub width: usize,
    /// Height in pixels.
    pub height: usize,
    /// Three bytes per pixel, row-major from the top.
    pub rgb: Vec<u8>,
}

impl Picture {
    fn new(width: usize, height: usize) -> Self {
        Self {
            width,
            height,
            rgb: BACKGROUND.repeat(width * height),
        }
    }

    fn set(&mut self, x: usize, y: usize, colour: [u8; 3]) {
        if x < self.width && y < self.height {
            let at = 3 * (y * self.width + x);
            self.rgb[at..at + 3].copy_from_slice(&colour);
        }
    }

    fn write(&mut self, x: usize, y: usize, text: &str) {
        for (dx, dy) in labels::pixels(text) {
            self.set(x + dx, y + dy, MARK);
        }
    }
}

/// Levels of the darkest and the brightest colour, dB.
fn span_db(contrast: Contrast, largest: f64) -> (f64, f64) {
    match contrast {
        Contrast::Fixed { low_db, high_db } => (low_db, high_db),
        Contrast::Percentiles { .. } => {
            let high_db = 10.0 * largest.max(1e-300).log10();
            (high_db - SPAN_DB, high_db)
        }
    }
}

/// Sample index (fractional) of a slant range.
fn sample_of(plan: &PingPlan, rate_hz: f64, range_m: f64) -> f64 {
    (2.0 * range_m / plan.sound_speed_m_per_s - plan.first_sample_s) * rate_hz
}

/// Samples of a beam between two sample positions, or the nearest if there are none between; none beyond the beam.
fn samples_between(fan: &BeamFrame, from: f64, to: f64) -> Option<Range<usize>> {
    if to < 0.0 {
        return None;
    }
    let (mut first, mut end) = (from.ceil().max(0.0) as usize, to.ceil().max(0.0) as usize);
    if first >= end {
        first = (0.5 * (from + to)).round().max(0.0) as usize;
        end = first + 1;
    }
    let end = end.min(fan.samples);
    (first < end).then_some(first..end)
}

/// Mean intensity of these samples.
fn intensity(fan: &BeamFrame, beam: usize, samples: Range<usize>) -> f64 {
    let count = samples.len() as f64;
    let inside = fan.beam(beam)[samples].iter();
    let square = |x: f32| f64::from(x) * f64::from(x);
    inside.map(|y| square(y.re) + square(y.im)).sum::<f64>() / count
}

/// The beam nearest to an angle; none more than half a step outside the fan.
pub fn beam_at(angle_rad: &[f64], angle: f64) -> Option<usize> {
    let (first, last) = (angle_rad.first()?, angle_rad.last()?);
    let edge = half_step(angle_rad);
    if !(first - edge..=last + edge).contains(&angle) {
        return None;
    }
    Some(match angle_rad.partition_point(|a| *a < angle) {
        0 => 0,
        b if b == angle_rad.len() => b - 1,
        b if angle - angle_rad[b - 1] < angle_rad[b] - angle => b - 1,
        b => b,
    })
}

/// Half of a fan's mean angular step.
fn half_step(angle_rad: &[f64]) -> f64 {
    match (angle_rad.first(), angle_rad.last()) {
        (Some(first), Some(last)) => {
            0.5 * (last - first) / angle_rad.len().saturating_sub(1).max(1) as f64
        }
        _ => 0.0,
    }
}

/// Mapping from the pixels of a fan's picture to its samples.
struct Polar<'a> {
    plan: &'a PingPlan,
    fan: &'a BeamFrame,
    rate_hz: f64,
    /// Size of a pixel, metres.
    metres: f64,
    /// Number of columns on each side of the sonar.
    half: usize,
    /// Row of the sonar.
    top: usize,
}

impl<'a> Polar<'a> {
    fn new(plan: &'a PingPlan, fan: &'a BeamFrame, rate_hz: f64) -> Self {
        let reach = |angle: &f64| match angle.abs() >= std::f64::consts::FRAC_PI_2 {
            true => PIXELS,
            false => (angle.sin().abs() * PIXELS as f64).ceil() as usize,
        };
        let ends = [fan.angle_rad.first(), fan.angle_rad.last()];
        let widest = ends.into_iter().flatten().map(reach).max().unwrap_or(0);
        Self {
            plan,
            fan,
            rate_hz,
            metres: plan.settings.range_m / PIXELS as f64,
            half: widest + MARGIN,
            top: labels::HEIGHT,
        }
    }

    fn size(&self) -> (usize, usize) {
        (2 * self.half, PIXELS + MARGIN)
    }

    /// Beam and samples of a pixel.
    fn samples(&self, x: usize, y: usize) -> Option<(usize, Range<usize>)> {
        let across = x as f64 + 0.5 - self.half as f64;
        let down = y.checked_sub(self.top)? as f64 + 0.5;
        let (pixels, angle) = (across.hypot(down), across.atan2(down));
        if pixels > PIXELS as f64 {
            return None;
        }
        let beam = beam_at(&self.fan.angle_rad, angle)?;
        let at = |pixels: f64| sample_of(self.plan, self.rate_hz, pixels * self.metres);
        let samples = samples_between(self.fan, at(pixels - 0.5), at(pixels + 0.5))?;
        Some((beam, samples))
    }

    /// Pixel at a distance (in pixels) and an angle from the sonar.
    fn place(&self, pixels: f64, angle: f64) -> (usize, usize) {
        let x = self.half as f64 + pixels * angle.sin();
        let y = self.top as f64 + pixels * angle.cos();
        (x.max(0.0) as usize, y.max(0.0) as usize)
    }
}

/// Masks and size of the picture by [`polar`], row-major from the top. `truths` has one entry per beam.
pub fn polar_masks(
    plan: &PingPlan,
    fan: &BeamFrame,
    truths: &[LineTruth],
    rate_hz: f64,
) -> ((usize, usize), Vec<Mask>) {
    let polar = Polar::new(plan, fan, rate_hz);
    let (width, height) = polar.size();
    let masks = (0..width * height).map(|p| {
        let found = polar.samples(p % width, p / width);
        found.map_or(Mask::EMPTY, |(beam, samples)| {
            mask_of(&truths[beam], samples)
        })
    });
    ((width, height), masks.collect())
}

/// Draws the fan of one ping. With `percentiles` contrast, the scale spans 60 dB down from the brightest pixel.
pub fn polar(
    plan: &PingPlan,
    fan: &BeamFrame,
    soundings: &[Sounding],
    rate_hz: f64,
    contrast: Contrast,
) -> Picture {
    let polar = Polar::new(plan, fan, rate_hz);
    let (range_m, metres) = (plan.settings.range_m, polar.metres);
    let (first, last) = match (fan.angle_rad.first(), fan.angle_rad.last()) {
        (Some(first), Some(last)) => (*first, *last),
        _ => (0.0, 0.0),
    };
    let (width, height) = polar.size();
    let mut picture = Picture::new(width, height);
    let edge = half_step(&fan.angle_rad);
    let mut levels = vec![f64::NAN; width * height];
    let mut largest = 0.0_f64;
    for (p, into) in levels.iter_mut().enumerate() {
        if let Some((beam, samples)) = polar.samples(p % width, p / width) {
            *into = intensity(fan, beam, samples);
            largest = largest.max(*into);
        }
    }
    let (low_db, high_db) = span_db(contrast, largest);
    for y in 0..picture.height {
        for x in 0..picture.width {
            let level = levels[y * picture.width + x];
            if !level.is_nan() {
                let share = (10.0 * level.log10() - low_db) / (high_db - low_db);
                picture.set(x, y, rgb(ColourMap::Blue, share as f32));
            }
        }
    }
    let place = |pixels, angle| polar.place(pixels, angle);
    // Dotted range arcs, with their ranges at the starboard end.
    let step_m = labels::round_step(range_m, 5.0);
    let mut mark_m = step_m;
    while mark_m <= range_m * 1.000_001 {
        let pixels = mark_m / metres;
        let dots = (pixels * (last - first)).max(1.0) as usize;
        for dot in (0..=dots).step_by(3) {
            let angle = first + (last - first) * dot as f64 / dots as f64;
            let (x, y) = place(pixels, angle);
            picture.set(x, y, MARK);
        }
        let (x, y) = place(pixels, last + edge);
        picture.write(
            x + 4,
            y.saturating_sub(labels::HEIGHT / 2),
            &format!("{mark_m}m"),
        );
        mark_m += step_m;
    }
    // Rays of angle over the outer half of the range.
    let mut angle_deg = (first.to_degrees() / 30.0).ceil() * 30.0;
    while angle_deg.to_radians() <= last {
        for pixels in (PIXELS / 2..PIXELS).step_by(4) {
            let (x, y) = place(pixels as f64, angle_deg.to_radians());
            picture.set(x, y, MARK);
        }
        let (x, y) = place(PIXELS as f64 + 4.0, angle_deg.to_radians());
        let text = format!("{angle_deg}\u{b0}");
        picture.write(x.saturating_sub(labels::ADVANCE), y, &text);
        angle_deg += 30.0;
    }
    for sounding in soundings {
        let pixels = 0.5 * sounding.twtt_s * plan.sound_speed_m_per_s / metres;
        let (x, y) = place(pixels, sounding.angle_rad);
        picture.set(x, y, SOUNDING);
        picture.set(x + 1, y, SOUNDING);
    }
    picture
}

/// All pings of a fan along the track.
pub struct Stack {
    range_m: f64,
    rate_hz: f64,
    first_ping: Option<u32>,
    max_pings: usize,
    /// A column of [`PIXELS`] intensities per ping; NaN without data.
    columns: Vec<f32>,
    /// Ground truth of the intensities; empty without truths.
    masks: Vec<Mask>,
}

impl Stack {
    /// A stack down to `range_m`. Pings beyond `max_pings` are omitted.
    pub fn new(range_m: f64, rate_hz: f64, max_pings: usize) -> Self {
        Self {
            range_m,
            rate_hz,
            first_ping: None,
            max_pings,
            columns: Vec::new(),
            masks: Vec::new(),
        }
    }

    /// Adds a ping. `truths` has one entry per beam, or is empty.
    pub fn push(&mut self, plan: &PingPlan, fan: &BeamFrame, truths: &[LineTruth]) {
        let first = *self.first_ping.get_or_insert(plan.ping_number);
        let place = plan.ping_number.checked_sub(first).map(|p| p as usize);
        let Some(place) = place.filter(|&p| p < self.max_pings) else {
            return;
        };
        let end = (place + 1) * PIXELS;
        if self.columns.len() < end {
            self.columns.resize(end, f32::NAN);
        }
        if !truths.is_empty() && self.masks.len() < end {
            self.masks.resize(end, Mask::EMPTY);
        }
        let metres = self.range_m / PIXELS as f64;
        let at = |y: usize| sample_of(plan, self.rate_hz, y as f64 * metres);
        for y in 0..PIXELS {
            let Some(samples) = samples_between(fan, at(y), at(y + 1)) else {
                continue;
            };
            let levels = (0..fan.beams).map(|b| (intensity(fan, b, samples.clone()), b));
            let Some((level, beam)) = levels.reduce(|a, b| if b.0 > a.0 { b } else { a }) else {
                continue;
            };
            self.columns[place * PIXELS + y] = level as f32;
            if let Some(truth) = truths.get(beam) {
                self.masks[place * PIXELS + y] = mask_of(truth, samples);
            }
        }
    }

    /// Number of pings.
    pub fn pings(&self) -> usize {
        self.columns.len() / PIXELS
    }

    /// Columns per ping: a few pings are widened.
    fn wide(&self) -> usize {
        (PIXELS / 2).div_ceil(self.pings().max(1)).max(1)
    }

    fn size(&self) -> (usize, usize) {
        (LEFT + self.pings() * self.wide(), PIXELS)
    }

    /// Masks and size of [`Stack::picture`], row-major from the top; each pixel has the mask of the beam that it shows. None without
    /// truths.
    pub fn masks(&self) -> Option<((usize, usize), Vec<Mask>)> {
        if self.masks.is_empty() {
            return None;
        }
        let ((width, height), wide) = (self.size(), self.wide());
        let of = |p: usize| {
            let (x, y) = (p % width, p / width);
            let ping = x.checked_sub(LEFT)? / wide;
            self.masks.get(ping * PIXELS + y).copied()
        };
        let masks = (0..width * height).map(|p| of(p).unwrap_or(Mask::EMPTY));
        Some(((width, height), masks.collect()))
    }

    /// Draws the stack: oldest ping on the left, slant range downwards, with marks on the left.
    pub fn picture(&self, contrast: Contrast) -> Picture {
        let wide = self.wide();
        let (width, height) = self.size();
        let mut picture = Picture::new(width, height);
        let largest = self.columns.iter().copied().filter(|l| l.is_finite());
        let (low_db, high_db) = span_db(contrast, f64::from(largest.fold(0.0, f32::max)));
        for (ping, column) in self.columns.chunks_exact(PIXELS).enumerate() {
            for (y, level) in column.iter().enumerate().filter(|c| !c.1.is_nan()) {
                let db = 10.0 * f64::from(*level).log10();
                let colour = rgb(ColourMap::Blue, ((db - low_db) / (high_db - low_db)) as f32);
                for x in 0..wide {
                    picture.set(LEFT + ping * wide + x, y, colour);
                }
            }
        }
        let step_m = labels::round_step(self.range_m, 8.0);
        let mut mark_m = 0.0;
        while mark_m < self.range_m {
            let y = (mark_m / self.range_m * PIXELS as f64) as usize;
            for x in LEFT - 8..LEFT {
                picture.set(x, y, MARK);
            }
            picture.write(
                0,
                y.saturating_sub(labels::HEIGHT / 2),
                &format!("{mark_m}m"),
            );
            mark_m += step_m;
        }
        picture
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use echotank_core::ping::Detection;
    use echotank_core::pulse::{Pulse, PulseKind};
    use echotank_core::testing::plan_at_rest;
    use num_complex::Complex32;

    const C: f64 = 1500.0;
    const RATE_HZ: f64 = 15e3;
    const WHOLE_RANGE: Contrast = Contrast::Percentiles {
        low: 0.0,
        high: 1.0,
    };

    fn plan() -> PingPlan {
        let pulse = Pulse {
            kind: PulseKind::Cw,
            center_frequency_hz: 200e3,
            bandwidth_hz: 0.0,
            duration_s: 1e-3,
            taper: 0.0,
        };
        let mut plan = plan_at_rest(&pulse, 1000, C);
        plan.settings.range_m = 48.0;
        plan
    }

    fn fan(echo: (usize, usize)) -> BeamFrame {
        let (beams, samples) = (61, 1000);
        let mut iq = vec![Complex32::new(1e-3, 0.0); beams * samples];
        iq[echo.0 * samples + echo.1] = Complex32::ONE;
        BeamFrame {
            beams,
            samples,
            angle_rad: (0..61)
                .map(|b| (f64::from(b) * 2.0 - 60.0).to_radians())
                .collect(),
            width_rad: vec![0.03; beams],
            iq,
        }
    }

    #[test]
    fn an_echo_is_brightest_and_its_sounding_a_dot_at_its_range_and_angle() {
        // Beam 50 points 40 degrees to starboard; sample 600 is at 30 m, with 0.1 m per pixel.
        let mut picture = polar(&plan(), &fan((50, 600)), &[], RATE_HZ, WHOLE_RANGE);
        let half = picture.width as f64 / 2.0;
        let white = |p: &Picture| -> Vec<(usize, usize)> {
            (0..p.width * p.height)
                .filter(|k| p.rgb[3 * k..3 * k + 3] == [255, 255, 255])
                .map(|k| (k % p.width, k / p.width))
                .collect()
        };
        let found = white(&picture);
        assert!(!found.is_empty());
        let (sin, cos) = 40f64.to_radians().sin_cos();
        for (x, y) in found {
            let (across_m, down_m) = ((x as f64 + 0.5 - half) * 0.1, (y as f64 - 9.5) * 0.1);
            let (want_x, want_y) = (30.0 * sin, 30.0 * cos);
            // A beam is two degrees wide there: half a metre to each side.
            assert!(
                (across_m - want_x).hypot(down_m - want_y) < 0.65,
                "{across_m} {down_m}, want {want_x} {want_y}"
            );
        }
        let sounding = Sounding {
            beam: 50,
            angle_rad: 40f64.to_radians(),
            twtt_s: 0.04,
            error_s: 0.0,
            detection: Detection::Phase,
            level_v: 1.0,
        };
        picture = polar(
            &plan(),
            &fan((50, 600)),
            &[sounding],
            RATE_HZ,
            Contrast::Fixed {
                low_db: -60.0,
                high_db: 0.0,
            },
        );
        let dots = picture
            .rgb
            .chunks_exact(3)
            .filter(|c| *c == SOUNDING)
            .count();
        assert_eq!(dots, 2);
    }

    #[test]
    fn the_stack_shows_an_echo_at_its_ping_and_range_and_missing_pings_empty() {
        let mut stack = Stack::new(48.0, RATE_HZ, 100);
        for (ping, sample) in [(3, 300), (5, 700)] {
            let plan = PingPlan {
                ping_number: ping,
                ..plan()
            };
            stack.push(&plan, &fan((10, sample)), &[]);
        }
        assert_eq!(stack.pings(), 3);
        let picture = stack.picture(WHOLE_RANGE);
        let left = LEFT;
        let wide = (picture.width - left) / 3;
        let at = |ping: usize, y: usize| {
            let k = 3 * (y * picture.width + left + ping * wide);
            let rgb = picture.rgb[k..k + 3].iter();
            rgb.map(|c| u32::from(*c)).sum::<u32>()
        };
        // 15 m and 35 m at 0.1 m per pixel.
        // An echo on the edge of a pixel may be shared with a neighbour: 3 dB of the 60.
        assert!(at(0, 150) > 700 && at(2, 350) > 700);
        assert!(at(0, 350) < 100, "{}", at(0, 350));
        assert_eq!(at(1, 150), 0);
    }

    #[test]
    fn masks_match_the_picture_pixel_for_pixel() {
        let fan = fan((50, 600));
        let blank = LineTruth {
            side: echotank_core::ping::Side::Starboard,
            target: vec![0; 1000],
            target_energy: vec![0.0; 1000],
            other_energy: vec![1.0; 1000],
            ground: vec![echotank_core::ping::GroundSeen::None; 1000],
            down_m: vec![f32::NAN; 1000],
        };
        let mut truths = vec![blank; 61];
        (truths[50].target[600], truths[50].target_energy[600]) = (7, 5.0);
        truths[20].ground[400] = echotank_core::ping::GroundSeen::Hidden;
        truths[20].down_m[400] = 18.0;
        let picture = polar(&plan(), &fan, &[], RATE_HZ, WHOLE_RANGE);
        let (size, masks) = polar_masks(&plan(), &fan, &truths, RATE_HZ);
        assert_eq!(size, (picture.width, picture.height));
        // The echo's pixels are white except under marks, and belong to the target.
        let pixels = picture.rgb.chunks_exact(3);
        let white: Vec<bool> = pixels.map(|p| p == [255, 255, 255]).collect();
        let own: Vec<bool> = masks.iter().map(|m| m.target == 7).collect();
        assert!(white.iter().any(|w| *w));
        assert!(white.iter().zip(&own).all(|(white, own)| !white || *own));
        let both = |v: &[bool]| v.iter().filter(|x| **x).count();
        assert!(
            both(&own) <= both(&white) + 12,
            "{} {}",
            both(&own),
            both(&white)
        );
        let shadow = masks.iter().filter(|m| m.shadow && m.down_m == 18.0);
        assert!(shadow.count() > 0);

        // 48 m over 480 rows, one ping: the strongest beam at 30 m is the target's.
        let mut stack = Stack::new(48.0, RATE_HZ, 10);
        stack.push(&plan(), &fan, &truths);
        let (size, masks) = stack.masks().expect("masks");
        let picture = stack.picture(WHOLE_RANGE);
        assert_eq!(size, (picture.width, picture.height));
        for (p, mask) in masks.iter().enumerate() {
            let (x, y) = (p % size.0, p / size.0);
            // Sample 600 is at 30 m.
            let at_echo = x >= LEFT && y == 300;
            assert_eq!(mask.target == 7, at_echo, "{x} {y}");
        }
    }

    #[test]
    fn empty_fans_are_drawn_without_panic() {
        for fan in [
            BeamFrame::default(),
            BeamFrame {
                beams: 1,
                angle_rad: vec![0.3],
                ..BeamFrame::default()
            },
        ] {
            assert!(polar(&plan(), &fan, &[], RATE_HZ, WHOLE_RANGE).width > 0);
            let mut stack = Stack::new(48.0, RATE_HZ, 10);
            stack.push(&plan(), &fan, &[]);
            assert_eq!(stack.picture(WHOLE_RANGE).height, PIXELS);
        }
        assert!(
            Stack::new(1.0, RATE_HZ, 10)
                .picture(Contrast::Fixed {
                    low_db: 0.0,
                    high_db: 1.0
                })
                .width
                > 0
        );
    }
}

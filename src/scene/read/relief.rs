//! Picture of a height field: colour-coded depth with hill shading from the north-west, a depth legend and a scale bar.

use super::HeightField;

/// Longer side of the relief, pixels. Smaller fields are interpolated, larger ones averaged.
const LONG_SIDE: usize = 900;
const MARGIN: usize = 12;
/// Width of the depth legend, pixels.
const LEGEND: usize = 130;
/// Height of the scale bar and its text, pixels.
const FOOT: usize = 54;
/// Direction of the light: azimuth from north, and elevation (Imhof 1982: from the north-west).
const LIGHT_AZIMUTH_DEG: f64 = 315.0;
const LIGHT_HEIGHT_DEG: f64 = 45.0;
/// Slopes are exaggerated until this share of them is just below 45 degrees.
const STEEP_SHARE: f64 = 0.98;
/// Greatest exaggeration. A flatter seabed would show only its noise.
const MAX_EXAGGERATION: f64 = 1000.0;
/// Colours from deep to shallow, with evenly increasing lightness.
const RAMP: [[f64; 3]; 6] = [
    [32.0, 24.0, 84.0],
    [36.0, 72.0, 140.0],
    [32.0, 122.0, 150.0],
    [58.0, 168.0, 140.0],
    [146.0, 208.0, 120.0],
    [244.0, 238.0, 166.0],
];
const PAPER: [u8; 3] = [250, 250, 248];
const HOLE: [u8; 3] = [214, 214, 212];
const INK: [u8; 3] = [30, 30, 34];

/// RGB image: rows from the top, three bytes a pixel.
pub struct Picture {
    /// Width, pixels.
    pub width: usize,
    /// Height, pixels.
    pub height: usize,
    /// Pixels, three bytes each, rows from the top.
    pub rgb: Vec<u8>,
    /// Text of the picture: scale and exaggeration.
    pub caption: String,
}

/// Draws a field with north up. The depth scale spans the 1st to the 99th percentile.
pub fn draw(field: &HeightField) -> Picture {
    let view = View::of(field);
    let mut sorted: Vec<f32> = view
        .down_m
        .iter()
        .copied()
        .filter(|d| !d.is_nan())
        .collect();
    sorted.sort_unstable_by(f32::total_cmp);
    let at = |share: f64| match sorted.len() {
        0 => 0.0,
        n => f64::from(sorted[((n - 1) as f64 * share).round() as usize]),
    };
    let (shallow_m, deep_m) = (at(0.01), at(0.99));
    let span_m = (deep_m - shallow_m).max(1e-3);
    let slopes = view.slopes();
    let exaggeration = exaggeration(&slopes);

    let mut canvas = Canvas::new(
        view.width + LEGEND + 2 * MARGIN,
        view.height + FOOT + 2 * MARGIN,
    );
    let (sin_azimuth, cos_azimuth) = LIGHT_AZIMUTH_DEG.to_radians().sin_cos();
    let (sin_height, cos_height) = LIGHT_HEIGHT_DEG.to_radians().sin_cos();
    for row in 0..view.height {
        for col in 0..view.width {
            let down_m = f64::from(view.down_m[row * view.width + col]);
            let colour = if down_m.is_nan() {
                HOLE
            } else {
                let light = match slopes[row * view.width + col] {
                    None => sin_height,
                    // Where the seabed rises to the north, its upward normal leans south.
                    Some((north, east)) => {
                        let (n, e) = (-north * exaggeration, -east * exaggeration);
                        let towards = n * cos_azimuth + e * sin_azimuth;
                        (towards * cos_height + sin_height) / (1.0 + n * n + e * e).sqrt()
                    }
                };
                // Level ground keeps its colour.
                let shade = 0.35 + 0.65 * (light / sin_height).clamp(0.0, 1.35);
                ramp((deep_m - down_m) / span_m).map(|c| (c * shade).clamp(0.0, 255.0) as u8)
            };
            canvas.dot(MARGIN + col, MARGIN + row, colour);
        }
    }
    let bar_m = round_down(0.4 * view.width as f64 * view.east_m_per_pixel);
    canvas.depth_legend(&view, shallow_m, deep_m);
    canvas.length_bar(&view, bar_m);
    let caption = format!(
        "{} long bar, slopes x{exaggeration:.1}, light from the north-west",
        metres(bar_m)
    );
    let words = format!("slopes x{exaggeration:.1}  north up  grey: no data");
    canvas.draw_text(MARGIN, MARGIN + view.height + 40, &words);
    Picture {
        width: canvas.width,
        height: canvas.height,
        rgb: canvas.rgb,
        caption,
    }
}

/// Depths at the picture's pixels, northern row first.
struct View {
    width: usize,
    height: usize,
    north_m_per_pixel: f64,
    east_m_per_pixel: f64,
    down_m: Vec<f32>,
}

impl View {
    /// Samples a field. Pixels are square on the ground. Pixels smaller than the cells interpolate between the centres; larger ones average their
    /// cells.
    fn of(field: &HeightField) -> Self {
        let (north_m, east_m) = (field.extent_north_m(), field.extent_east_m());
        let pixel_m = north_m.max(east_m) / LONG_SIDE as f64;
        let size = |m: f64| ((m / pixel_m).round() as usize).clamp(1, LONG_SIDE);
        let (height, width) = (size(north_m), size(east_m));
        let north_m_per_pixel = north_m / height as f64;
        let east_m_per_pixel = east_m / width as f64;
        let finer =
            north_m_per_pixel <= field.cell_north_m && east_m_per_pixel <= field.cell_east_m;
        let mut down_m = Vec::with_capacity(width * height);
        for row in 0..height {
            let from_south = height - 1 - row;
            let rows = cells(from_south, height, field.rows);
            let at_north_m = field.south_m + (from_south as f64 + 0.5) * north_m_per_pixel;
            for col in 0..width {
                let at_east_m = field.west_m + (col as f64 + 0.5) * east_m_per_pixel;
                down_m.push(if finer {
                    let at = field.sample(at_north_m, at_east_m);
                    at.map_or(f32::NAN, |d| d.down_m as f32)
                } else {
                    mean(field, rows.clone(), cells(col, width, field.cols))
                });
            }
        }
        Self {
            width,
            height,
            north_m_per_pixel,
            east_m_per_pixel,
            down_m,
        }
    }

    /// Northward and eastward gradient of the height at every pixel, by central differences; none beside holes and edges.
    fn slopes(&self) -> Vec<Option<(f64, f64)>> {
        let at = |row: usize, col: usize| f64::from(self.down_m[row * self.width + col]);
        let mut slopes = Vec::with_capacity(self.down_m.len());
        for row in 0..self.height {
            for col in 0..self.width {
                let inner = row > 0 && col > 0 && row + 1 < self.height && col + 1 < self.width;
                slopes.push(
                    inner
                        .then(|| {
                            let north = (at(row + 1, col) - at(row - 1, col))
                                / (2.0 * self.north_m_per_pixel);
                            let east = (at(row, col - 1) - at(row, col + 1))
                                / (2.0 * self.east_m_per_pixel);
                            (north, east)
                        })
                        .filter(|(n, e)| !(n + e).is_nan()),
                );
            }
        }
        slopes
    }
}

/// Range of cells that a pixel covers along one side, at least one.
fn cells(pixel: usize, pixels: usize, cells: usize) -> std::ops::Range<usize> {
    let from = pixel * cells / pixels;
    from..((pixel + 1) * cells / pixels).max(from + 1).min(cells)
}

/// Mean depth of the filled cells; NaN where all are holes.
fn mean(field: &HeightField, rows: std::ops::Range<usize>, cols: std::ops::Range<usize>) -> f32 {
    let (mut sum, mut count) = (0.0, 0_u32);
    for row in rows {
        for col in cols.clone() {
            let down_m = field.cell_down_m(row, col);
            if !down_m.is_nan() {
                (sum, count) = (sum + down_m, count + 1);
            }
        }
    }
    match count {
        0 => f32::NAN,
        n => (sum / f64::from(n)) as f32,
    }
}

fn exaggeration(slopes: &[Option<(f64, f64)>]) -> f64 {
    let mut steepness: Vec<f64> = slopes.iter().flatten().map(|(n, e)| n.hypot(*e)).collect();
    steepness.sort_unstable_by(f64::total_cmp);
    let steep = match steepness.len() {
        0 => 1.0,
        n => steepness[((n - 1) as f64 * STEEP_SHARE) as usize],
    };
    (1.0 / steep).clamp(1.0, MAX_EXAGGERATION)
}

/// Colour of a share from 0 (deep) to 1 (shallow).
fn ramp(share: f64) -> [f64; 3] {
    let place = share.clamp(0.0, 1.0) * (RAMP.len() - 1) as f64;
    let index = (place as usize).min(RAMP.len() - 2);
    let mix = place - index as f64;
    std::array::from_fn(|k| RAMP[index][k] * (1.0 - mix) + RAMP[index + 1][k] * mix)
}

/// The largest value of 1, 2 or 5 times a power of ten that does not exceed `length`.
fn round_down(length: f64) -> f64 {
    let decade = 10_f64.powf(length.max(1e-6).log10().floor());
    let steps = [5.0, 2.0, 1.0];
    let step = steps
        .into_iter()
        .find(|s| s * decade <= length)
        .unwrap_or(1.0);
    step * decade
}

fn metres(length_m: f64) -> String {
    if length_m >= 1000.0 {
        format!("{} km", length_m / 1000.0)
    } else {
        format!("{length_m} m")
    }
}

struct Canvas {
    width: usize,
    height: usize,
    rgb: Vec<u8>,
}

impl Canvas {
    fn new(width: usize, height: usize) -> Self {
        // Wide enough for the text below the narrowest relief.
        let width = width.max(360);
        Self {
            width,
            height,
            rgb: PAPER.repeat(width * height),
        }
    }

    fn dot(&mut self, x: usize, y: usize, colour: [u8; 3]) {
        if x < self.width && y < self.height {
            let at = 3 * (y * self.width + x);
            self.rgb[at..at + 3].copy_from_slice(&colour);
        }
    }

    fn depth_legend(&mut self, view: &View, shallow_m: f64, deep_m: f64) {
        let (x, top) = (MARGIN + view.width + 16, MARGIN + 30);
        let height = view.height.saturating_sub(30).clamp(100, 320);
        self.draw_text(x, MARGIN, "depth m");
        for row in 0..height {
            let share = row as f64 / (height - 1) as f64;
            let colour = ramp(1.0 - share).map(|c| c as u8);
            for col in 0..16 {
                self.dot(x + col, top + row, colour);
            }
        }
        let decimals = if deep_m - shallow_m < 10.0 { 2 } else { 1 };
        for tick in 0..5 {
            let share = f64::from(tick) / 4.0;
            let y = top + (share * (height - 1) as f64).round() as usize;
            for col in 16..21 {
                self.dot(x + col, y, INK);
            }
            let down_m = shallow_m + share * (deep_m - shallow_m);
            self.draw_text(x + 25, y.saturating_sub(5), &format!("{down_m:.decimals$}"));
        }
    }

    fn length_bar(&mut self, view: &View, bar_m: f64) {
        let y = MARGIN + view.height + 14;
        let pixels = (bar_m / view.east_m_per_pixel).round() as usize;
        for x in 0..=pixels {
            for thick in 0..3 {
                self.dot(MARGIN + x, y + thick, INK);
            }
        }
        for end in [0, pixels] {
            for rise in 0..9 {
                self.dot(MARGIN + end, y + 1 + rise - 4.min(rise), INK);
            }
        }
        self.draw_text(MARGIN + pixels + 10, y - 4, &metres(bar_m));
    }

    /// Draws text at twice the size of the glyphs.
    fn draw_text(&mut self, x: usize, y: usize, text: &str) {
        for (index, letter) in text.chars().enumerate() {
            let glyph = glyph(letter);
            for (row, bits) in glyph.iter().enumerate() {
                for col in 0..5 {
                    if bits & (0b1_0000 >> col) != 0 {
                        for (dx, dy) in [(0, 0), (1, 0), (0, 1), (1, 1)] {
                            self.dot(x + index * 12 + 2 * col + dx, y + 2 * row + dy, INK);
                        }
                    }
                }
            }
        }
    }
}

/// Bitmap of a glyph: seven rows of five bits. It covers the lower-case letters in use, digits and signs; anything else is blank.
fn glyph(letter: char) -> [u8; 7] {
    match letter {
        '0' => [0x0e, 0x11, 0x13, 0x15, 0x19, 0x11, 0x0e],
        '1' => [0x04, 0x0c, 0x04, 0x04, 0x04, 0x04, 0x0e],
        '2' => [0x0e, 0x11, 0x01, 0x02, 0x04, 0x08, 0x1f],
        '3' => [0x1f, 0x02, 0x04, 0x02, 0x01, 0x11, 0x0e],
        '4' => [0x02, 0x06, 0x0a, 0x12, 0x1f, 0x02, 0x02],
        '5' => [0x1f, 0x10, 0x1e, 0x01, 0x01, 0x11, 0x0e],
        '6' => [0x06, 0x08, 0x10, 0x1e, 0x11, 0x11, 0x0e],
        '7' => [0x1f, 0x01, 0x02, 0x04, 0x08, 0x08, 0x08],
        '8' => [0x0e, 0x11, 0x11, 0x0e, 0x11, 0x11, 0x0e],
        '9' => [0x0e, 0x11, 0x11, 0x0f, 0x01, 0x02, 0x0c],
        '.' => [0, 0, 0, 0, 0, 0x0c, 0x0c],
        ':' => [0, 0x0c, 0x0c, 0, 0x0c, 0x0c, 0],
        '-' => [0, 0, 0, 0x1f, 0, 0, 0],
        'a' => [0, 0, 0x0e, 0x01, 0x0f, 0x11, 0x0f],
        'd' => [0x01, 0x01, 0x0d, 0x13, 0x11, 0x11, 0x0f],
        'e' => [0, 0, 0x0e, 0x11, 0x1f, 0x10, 0x0e],
        'g' => [0, 0x0f, 0x11, 0x11, 0x0f, 0x01, 0x0e],
        'h' => [0x10, 0x10, 0x16, 0x19, 0x11, 0x11, 0x11],
        'k' => [0x10, 0x10, 0x12, 0x14, 0x18, 0x14, 0x12],
        'l' => [0x0c, 0x04, 0x04, 0x04, 0x04, 0x04, 0x0e],
        'm' => [0, 0, 0x1a, 0x15, 0x15, 0x11, 0x11],
        'n' => [0, 0, 0x16, 0x19, 0x11, 0x11, 0x11],
        'o' => [0, 0, 0x0e, 0x11, 0x11, 0x11, 0x0e],
        'p' => [0, 0, 0x1e, 0x11, 0x1e, 0x10, 0x10],
        'r' => [0, 0, 0x16, 0x19, 0x10, 0x10, 0x10],
        's' => [0, 0, 0x0e, 0x10, 0x0e, 0x01, 0x1e],
        't' => [0x08, 0x08, 0x1c, 0x08, 0x08, 0x09, 0x06],
        'u' => [0, 0, 0x11, 0x11, 0x11, 0x13, 0x0d],
        'x' => [0, 0, 0x11, 0x0a, 0x04, 0x0a, 0x11],
        'y' => [0, 0, 0x11, 0x11, 0x0f, 0x01, 0x0e],
        _ => [0; 7],
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn ramp_to_north(rows: usize, cols: usize) -> HeightField {
        HeightField {
            rows,
            cols,
            cell_north_m: 2.0,
            cell_east_m: 4.0,
            south_m: 0.0,
            west_m: 0.0,
            down_m: (0..rows * cols)
                .map(|k| 50.0 - (k / cols) as f32 * 0.1)
                .collect(),
        }
    }

    #[test]
    fn shallow_is_light_and_deep_dark_and_north_is_up() {
        let picture = draw(&ramp_to_north(120, 30));
        let at = |x: usize, y: usize| -> u32 {
            let k = 3 * (y * picture.width + x);
            picture.rgb[k..k + 3].iter().map(|c| u32::from(*c)).sum()
        };
        assert!(at(MARGIN + 200, MARGIN + 60) > 2 * at(MARGIN + 200, MARGIN + 840));
        assert_eq!(picture.rgb.len(), 3 * picture.width * picture.height);
    }

    #[test]
    fn any_field_can_be_drawn() {
        let mut holes = ramp_to_north(3, 5);
        holes.down_m.fill(f32::NAN);
        draw(&holes);
        draw(&ramp_to_north(2, 2));
        draw(&ramp_to_north(2, 3000));
        draw(&ramp_to_north(3000, 2));
    }
}

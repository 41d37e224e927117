//! The mosaic: side-scan lines projected onto a map in the survey's UTM zone, north up.
//!
//! A sample of slant range r lies at ground range sqrt(r^2 - h^2) to its side, where h is the altitude (flat bottom across the ping). Each
//! ping covers the track half way to its neighbours, so that no gap opens on curves. [`Overlap`] resolves pixels that several pings cover.
//! The water column is omitted. `nadir_rad` also omits the area below the sonar, where resolution is poor and other lines may fill in. A
//! towed body is `layback_m` behind the navigation's reference point, along the heading. Pitch and the sonar's motion during the echo shift
//! the beam forwards. With [`LineTruth`]s the map has a [`Mask`] for each pixel.
//!
//! Rows of pixels run from north to south. [`Mosaic::write_geotiff`] writes intensity in dB as 32-bit floats with the coordinate system.
//! [`Mosaic::write_png`] writes it with a colour map.
//!
//! Not modelled: slope of the bottom across the ping, refraction, beam width (a pixel takes the line's value for any beam width).

use std::io::{self, Seek, Write};

use glam::DVec2;
use tiff::encoder::{TiffEncoder, colortype};
use tiff::tags::Tag;

use super::line::{Projection, RangeAxis, cell_intensity};
use super::masks::{Mask, cell_masks};
use crate::image::colour::rgb;
pub use echotank_config::spec::Overlap;
use echotank_config::spec::{ColourMap, Contrast};
use echotank_core::ping::{Line, LineTruth, Side};
use echotank_core::utm::UtmZone;

/// Settings of a mosaic.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct MosaicSpec {
    /// Pixel size, metres of the UTM grid.
    pub metres_per_pixel: f64,
    /// Rule for pixels that several pings cover.
    pub overlap: Overlap,
    /// Maximum ground range on each side.
    pub range_m: f64,
    /// Directions closer to the vertical than this are omitted.
    pub nadir_rad: f64,
    /// Distance of the sonar behind the reference point.
    pub layback_m: f64,
    /// Maximum number of pixels of the whole picture.
    pub max_pixels: usize,
}

impl Default for MosaicSpec {
    fn default() -> Self {
        Self {
            metres_per_pixel: 0.25,
            overlap: Overlap::Mean,
            range_m: 100.0,
            nadir_rad: 0.0,
            layback_m: 0.0,
            max_pixels: 100_000_000,
        }
    }
}

/// Position and attitude of the sonar at one ping.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SonarPose {
    /// WGS 84 latitude, positive north.
    pub latitude_rad: f64,
    /// WGS 84 longitude, positive east.
    pub longitude_rad: f64,
    /// Clockwise from true north.
    pub heading_rad: f64,
    /// Height above the bottom.
    pub altitude_m: f64,
    /// Positive bow up.
    pub pitch_rad: f64,
    /// Forward speed divided by sound speed: forward shift of the beam centre per metre of range.
    pub drift: f64,
    /// Lateral positions of the port and the starboard array, positive to starboard.
    pub starboard_m: [f64; 2],
}

impl SonarPose {
    /// Pose of a level sonar at rest at the given position.
    pub fn level(latitude_rad: f64, longitude_rad: f64, heading_rad: f64, altitude_m: f64) -> Self {
        Self {
            latitude_rad,
            longitude_rad,
            heading_rad,
            altitude_m,
            pitch_rad: 0.0,
            drift: 0.0,
            starboard_m: [0.0; 2],
        }
    }
}

/// One ping, kept until the next determines its along-track extent.
struct Ping {
    /// East and north in the zone, metres.
    at_m: DVec2,
    ahead: DVec2,
    altitude_m: f64,
    pitch_tan: f64,
    drift: f64,
    starboard_m: [f64; 2],
    /// Intensity in cells of half a pixel of ground range, port and starboard; NaN without data.
    sides: [Vec<f32>; 2],
    /// Ground truth of the cells; empty without labels.
    masks: [Vec<Mask>; 2],
}

impl Ping {
    /// Map position (east, north) of a point `across_m` to one side (0 port, 1 starboard).
    fn at_m(&self, side: usize, across_m: f64) -> DVec2 {
        let ahead_m =
            self.altitude_m * self.pitch_tan + self.drift * across_m.hypot(self.altitude_m);
        let starboard_m = match side {
            0 => self.starboard_m[0] - across_m,
            _ => self.starboard_m[1] + across_m,
        };
        self.at_m + self.ahead * ahead_m + DVec2::new(self.ahead.y, -self.ahead.x) * starboard_m
    }
}

/// Errors of making or writing a mosaic.
#[derive(Debug, thiserror::Error)]
pub enum MosaicError {
    /// No ping was added.
    #[error("no ping in the mosaic area")]
    Empty,
    /// The mosaic exceeds [`MosaicSpec::max_pixels`].
    #[error(
        "the mosaic has {pixels} pixels, at most {max} are allowed: use larger pixels or fewer pings"
    )]
    TooLarge {
        /// Number of pixels required.
        pixels: usize,
        /// Number of pixels allowed.
        max: usize,
    },
    /// Writing failed.
    #[error(transparent)]
    Io(#[from] io::Error),
    /// The TIFF encoder failed.
    #[error("TIFF: {0}")]
    Tiff(#[from] tiff::TiffError),
    /// The PNG encoder failed.
    #[error("PNG: {0}")]
    Png(#[from] png::EncodingError),
}

/// Ranges whose ratio is above this count as equal: pings of one pass.
const SAME_RANGE_RATIO: f32 = 0.98;

/// Accumulated values of one pixel.
#[derive(Clone, Copy)]
struct Pixel {
    sum: f32,
    weight: f32,
    nearest_m: f32,
}

impl Pixel {
    const EMPTY: Self = Self {
        sum: 0.0,
        weight: 0.0,
        nearest_m: f32::INFINITY,
    };

    fn intensity(&self) -> f32 {
        match self.weight > 0.0 {
            true => self.sum / self.weight,
            false => f32::NAN,
        }
    }
}

/// Accumulates pings and makes the map.
pub struct MosaicBuilder {
    spec: MosaicSpec,
    zone: Option<UtmZone>,
    pings: Vec<Ping>,
}

/// Mean intensities on a grid, north up.
pub struct Mosaic {
    /// UTM zone of the coordinates.
    pub zone: UtmZone,
    /// Pixel size, metres of the UTM grid.
    pub metres_per_pixel: f64,
    /// Easting of the western edge of the picture.
    pub west_m: f64,
    /// Northing of the northern edge of the picture.
    pub north_m: f64,
    /// Number of columns.
    pub width: usize,
    /// Number of rows.
    pub height: usize,
    /// Mean intensities, row-major from the north; NaN without data.
    pub intensity: Vec<f32>,
    /// Masks of the same pixels; empty if no ping has labels.
    pub masks: Vec<Mask>,
}

impl MosaicBuilder {
    /// An empty mosaic.
    pub fn new(spec: MosaicSpec) -> Self {
        Self {
            spec,
            zone: None,
            pings: Vec::new(),
        }
    }

    /// Adds one ping's lines (envelopes). The first ping sets the zone.
    pub fn push(&mut self, pose: &SonarPose, axis: RangeAxis, lines: &[Line]) {
        self.push_labelled(pose, axis, lines, &[]);
    }

    /// Adds one ping's lines with their ground truth.
    pub fn push_labelled(
        &mut self,
        pose: &SonarPose,
        axis: RangeAxis,
        lines: &[Line],
        truths: &[LineTruth],
    ) {
        let zone = *self
            .zone
            .get_or_insert_with(|| UtmZone::of(pose.latitude_rad, pose.longitude_rad));
        let (east_m, north_m) = zone.project_m(pose.latitude_rad, pose.longitude_rad);
        // Heading in the map: one metre ahead, projected, which includes grid convergence and scale.
        let (sin, cos) = pose.heading_rad.sin_cos();
        const METRE_RAD: f64 = 1e-6;
        let (e1, n1) = zone.project_m(
            pose.latitude_rad + METRE_RAD * cos,
            pose.longitude_rad + METRE_RAD * sin / pose.latitude_rad.cos(),
        );
        let ahead = DVec2::new(e1 - east_m, n1 - north_m).normalize_or(DVec2::new(sin, cos));
        let cell_m = 0.5 * self.spec.metres_per_pixel;
        let cells = (self.spec.range_m / cell_m).ceil() as usize;
        let projection = Projection::Ground {
            altitude_m: pose.altitude_m,
        };
        let min_m = pose.altitude_m / self.spec.nadir_rad.cos();
        let mut sides = [vec![f32::NAN; cells], vec![f32::NAN; cells]];
        for line in lines {
            let side = &mut sides[usize::from(line.side == Side::Starboard)];
            cell_intensity(&line.amplitude, axis, projection, cell_m, min_m, side);
        }
        let mut masks = [Vec::new(), Vec::new()];
        for truth in truths {
            let side = &mut masks[usize::from(truth.side == Side::Starboard)];
            side.resize(cells, Mask::EMPTY);
            cell_masks(truth, axis, projection, cell_m, side);
        }
        self.pings.push(Ping {
            at_m: DVec2::new(east_m, north_m) - ahead * self.spec.layback_m,
            ahead,
            altitude_m: pose.altitude_m,
            pitch_tan: pose.pitch_rad.tan(),
            drift: pose.drift,
            starboard_m: pose.starboard_m,
            sides,
            masks,
        });
    }

    /// Projects all pings and returns the map. Returns an error without pings or beyond the maximum size.
    pub fn finish(self) -> Result<Mosaic, MosaicError> {
        let (Some(zone), false) = (self.zone, self.pings.is_empty()) else {
            return Err(MosaicError::Empty);
        };
        let cell_m = self.spec.metres_per_pixel;
        let reach = DVec2::splat(self.spec.range_m + cell_m);
        let (mut low, mut high) = (DVec2::INFINITY, DVec2::NEG_INFINITY);
        for ping in &self.pings {
            for side in 0..2 {
                let at_m = ping.at_m(side, 0.0);
                low = low.min(at_m - reach);
                high = high.max(at_m + reach);
            }
        }
        // The origin is a multiple of the pixel size, so that maps of one survey align.
        let low = (low / cell_m).floor() * cell_m;
        let size = ((high - low) / cell_m).ceil();
        let area = size.x * size.y;
        if area.is_nan() || area > self.spec.max_pixels as f64 {
            return Err(MosaicError::TooLarge {
                pixels: area as usize,
                max: self.spec.max_pixels,
            });
        }
        let (width, height) = (size.x as usize, size.y as usize);
        let north_m = low.y + height as f64 * cell_m;
        let mut pixels = vec![Pixel::EMPTY; width * height];
        let labelled = self
            .pings
            .iter()
            .flat_map(|p| &p.masks)
            .any(|m| !m.is_empty());
        let mut masks = match labelled {
            true => vec![Mask::EMPTY; width * height],
            false => Vec::new(),
        };
        for i in 0..self.pings.len() {
            self.project_ping(i, |at, value, range_m, mask| {
                let x = (at.x - low.x) / cell_m;
                let y = (north_m - at.y) / cell_m;
                if x < 0.0 || y < 0.0 || x >= width as f64 || y >= height as f64 {
                    return;
                }
                let p = y as usize * width + x as usize;
                let update = self.update_pixel(value, range_m, &mut pixels[p]);
                if let (Some(mask), Some(there)) = (mask, masks.get_mut(p)) {
                    update.label(*mask, there);
                }
            });
        }
        let intensity = pixels.iter().map(Pixel::intensity).collect();
        Ok(Mosaic {
            zone,
            metres_per_pixel: cell_m,
            west_m: low.x,
            north_m,
            width,
            height,
            intensity,
            masks,
        })
    }

    /// Passes the points of one ping's strip to `put`, half way to its neighbours, in steps of half a pixel: position, intensity, range and
    /// mask. Between pings more than a pixel apart, the intensity is interpolated: a constant one would show an echo anywhere in the strip.
    fn project_ping(&self, i: usize, mut put: impl FnMut(DVec2, f32, f32, Option<&Mask>)) {
        let ping = &self.pings[i];
        let step_m = 0.5 * self.spec.metres_per_pixel;
        // A jump of the track is not filled.
        let longest_m = 50.0 * self.spec.metres_per_pixel;
        let neighbours = [
            i.checked_sub(1).map(|k| &self.pings[k]),
            self.pings.get(i + 1),
        ];
        for (side, cells) in ping.sides.iter().enumerate() {
            for (k, value) in cells.iter().enumerate().filter(|c| !c.1.is_nan()) {
                let across_m = (k as f64 + 0.5) * step_m;
                // The points between the two arrays show the first bottom echo.
                if k == 0 {
                    let inward = ping.starboard_m[side] * [-1.0, 1.0][side];
                    for back in 0..(inward / step_m).ceil().max(0.0) as usize {
                        let here = ping.at_m(side, -(back as f64 + 0.5) * step_m);
                        put(
                            here,
                            *value,
                            ping.altitude_m as f32,
                            ping.masks[side].first(),
                        );
                    }
                }
                let range_m = across_m.hypot(ping.altitude_m) as f32;
                let here = ping.at_m(side, across_m);
                let mask = ping.masks[side].get(k);
                for other in neighbours {
                    let to = other.map_or(DVec2::ZERO, |o| 0.5 * (o.at_m(side, across_m) - here));
                    let way = match to.length() <= longest_m {
                        true => to,
                        false => DVec2::ZERO,
                    };
                    let steps = (way.length() / step_m).ceil().max(1.0) as usize;
                    let next = other.and_then(|other| other.sides[side].get(k));
                    let next = next.filter(|next| steps > 1 && !next.is_nan());
                    let slope = 0.5 * (next.unwrap_or(value) - value);
                    for s in 0..steps {
                        let part = (s as f64 + 0.5) / steps as f64;
                        let at = here + way * part;
                        put(at, value + slope * part as f32, range_m, mask);
                    }
                }
            }
        }
    }

    fn update_pixel(&self, value: f32, range_m: f32, pixel: &mut Pixel) -> PixelUpdate {
        let Pixel {
            sum,
            weight,
            nearest_m,
        } = pixel;
        match self.spec.overlap {
            Overlap::Mean => {
                *sum += value;
                *weight += 1.0;
                match *weight > 1.0 {
                    true => PixelUpdate::Added,
                    false => PixelUpdate::Replaced,
                }
            }
            Overlap::Last => {
                (*sum, *weight) = (value, 1.0);
                PixelUpdate::Replaced
            }
            Overlap::Nearest if range_m < *nearest_m * SAME_RANGE_RATIO => {
                (*sum, *weight, *nearest_m) = (value, 1.0, range_m);
                PixelUpdate::Replaced
            }
            Overlap::Nearest if range_m * SAME_RANGE_RATIO <= *nearest_m => {
                *sum += value;
                *weight += 1.0;
                PixelUpdate::Added
            }
            Overlap::Nearest => PixelUpdate::Passed,
        }
    }
}

/// Effect of a value on a pixel.
#[derive(Clone, Copy)]
enum PixelUpdate {
    Replaced,
    Added,
    Passed,
}

impl PixelUpdate {
    /// In a mean over pings, a target in any ping labels the pixel; shadow requires that all pings show it.
    fn label(self, mask: Mask, there: &mut Mask) {
        match self {
            Self::Replaced => *there = mask,
            Self::Passed => {}
            Self::Added => {
                if there.target == 0 {
                    there.target = mask.target;
                }
                there.shadow &= mask.shadow && there.target == 0;
                if there.down_m.is_nan() {
                    there.down_m = mask.down_m;
                }
            }
        }
    }
}

/// GeoTIFF keys (OGC 19-008r4): projected model, area pixels, the projected system by its EPSG number, metres.
const MODEL_TYPE: u16 = 1024;
const RASTER_TYPE: u16 = 1025;
const PROJECTED_CRS: u16 = 3072;
const LINEAR_UNITS: u16 = 3076;
const METRE: u16 = 9001;

impl Mosaic {
    /// Pixel (column, row) at an easting and a northing; none outside the map.
    pub fn pixel(&self, east_m: f64, north_m: f64) -> Option<(usize, usize)> {
        let x = (east_m - self.west_m) / self.metres_per_pixel;
        let y = (self.north_m - north_m) / self.metres_per_pixel;
        let inside = x >= 0.0 && y >= 0.0 && x < self.width as f64 && y < self.height as f64;
        inside.then_some((x as usize, y as usize))
    }

    fn db(&self) -> impl Iterator<Item = f32> + '_ {
        self.intensity.iter().map(|i| 10.0 * i.log10())
    }

    /// Writes the intensity in dB as 32-bit floats, with the coordinate system; NaN without data.
    pub fn write_geotiff(&self, to: impl Write + Seek) -> Result<(), MosaicError> {
        let mut encoder = TiffEncoder::new(to)?;
        let mut image =
            encoder.new_image::<colortype::Gray32Float>(self.width as u32, self.height as u32)?;
        let tags = image.encoder();
        let m = self.metres_per_pixel;
        tags.write_tag(Tag::ModelPixelScaleTag, &[m, m, 0.0][..])?;
        tags.write_tag(
            Tag::ModelTiepointTag,
            &[0.0, 0.0, 0.0, self.west_m, self.north_m, 0.0][..],
        )?;
        let keys: [[u16; 4]; 5] = [
            [1, 1, 0, 4],
            [MODEL_TYPE, 0, 1, 1],
            [RASTER_TYPE, 0, 1, 1],
            [PROJECTED_CRS, 0, 1, self.zone.epsg()],
            [LINEAR_UNITS, 0, 1, METRE],
        ];
        tags.write_tag(Tag::GeoKeyDirectoryTag, &keys.concat()[..])?;
        tags.write_tag(Tag::GdalNodata, "nan")?;
        let db: Vec<f32> = self.db().collect();
        image.write_data(&db)?;
        Ok(())
    }

    /// Writes the intensity as a colour picture, transparent without data.
    pub fn write_png(
        &self,
        to: impl Write,
        map: ColourMap,
        contrast: Contrast,
    ) -> Result<(), MosaicError> {
        let mut levels: Vec<f32> = self.db().filter(|x| x.is_finite()).collect();
        if levels.is_empty() {
            return Err(MosaicError::Empty);
        }
        levels.sort_by(f32::total_cmp);
        let at = |share: f64| levels[((levels.len() - 1) as f64 * share.clamp(0.0, 1.0)) as usize];
        let (low, high) = match contrast {
            Contrast::Percentiles { low, high } => (at(low), at(high)),
            Contrast::Fixed { low_db, high_db } => (low_db as f32, high_db as f32),
        };
        let mut pixels = Vec::with_capacity(4 * self.intensity.len());
        for level in self.db() {
            if level.is_nan() {
                pixels.extend([0, 0, 0, 0]);
            } else {
                let [r, g, b] = rgb(map, (level - low) / (high - low).max(1e-6));
                pixels.extend([r, g, b, 255]);
            }
        }
        let mut encoder = png::Encoder::new(to, self.width as u32, self.height as u32);
        encoder.set_color(png::ColorType::Rgba);
        encoder.set_depth(png::BitDepth::Eight);
        let mut writer = encoder.write_header()?;
        writer.write_image_data(&pixels)?;
        writer.finish()?;
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use echotank_core::geodesy::LocalTangentPlane;

    const AXIS: RangeAxis = RangeAxis {
        metres_per_sample: 0.02,
    };

    /// A straight line at 40 degrees above a flat bottom at 12 m with a bright point, and the same track in the opposite direction.
    fn survey(spec: MosaicSpec, ways: &[f64]) -> (Mosaic, (f64, f64)) {
        let plane = LocalTangentPlane::new(0.6, -1.2);
        let mut builder = MosaicBuilder::new(spec);
        let altitude_m = 12.0;
        let target = DVec2::new(37.3, 61.8); // north, east
        for (way, turn) in ways.iter().enumerate() {
            for ping in 0..400 {
                let heading = 40f64.to_radians() + turn;
                let ahead = DVec2::new(heading.cos(), heading.sin());
                let along_m = 0.2 * f64::from(ping) - if *turn == 0.0 { 0.0 } else { 80.0 };
                let at = ahead * along_m + DVec2::new(-1.0, 3.0) * way as f64;
                let to = target - at;
                let (along, across) = (to.dot(ahead), to.dot(DVec2::new(-ahead.y, ahead.x)));
                let lines = [(Side::Port, -1.0), (Side::Starboard, 1.0)].map(|(side, sign)| {
                    let mut amplitude = vec![0.1f32; 4000];
                    if along.abs() <= 0.1001 && across * sign > 0.0 {
                        amplitude[AXIS.sample(across.hypot(altitude_m))] = 30.0;
                    }
                    Line { side, amplitude }
                });
                let fish = at + ahead * spec.layback_m;
                let (latitude_rad, longitude_rad) = plane.geodetic_rad(fish.x, fish.y);
                let pose = SonarPose::level(latitude_rad, longitude_rad, heading, altitude_m);
                builder.push(&pose, AXIS, &lines);
            }
        }
        let (latitude, longitude) = plane.geodetic_rad(target.x, target.y);
        let mosaic = builder.finish().expect("a map");
        let pose = mosaic.zone.project_m(latitude, longitude);
        (mosaic, pose)
    }

    fn brightest(mosaic: &Mosaic) -> (usize, usize) {
        let p = (0..mosaic.intensity.len())
            .filter(|&p| !mosaic.intensity[p].is_nan())
            .max_by(|&a, &b| mosaic.intensity[a].total_cmp(&mosaic.intensity[b]))
            .expect("pixels");
        (p % mosaic.width, p / mosaic.width)
    }

    #[test]
    fn a_target_lies_within_a_pixel_with_layback_and_from_both_directions() {
        use std::f64::consts::PI;
        for (layback_m, ways) in [
            (0.0, &[0.0][..]),
            (25.0, &[0.0]),
            (0.0, &[PI]),
            (0.0, &[0.0, PI]),
        ] {
            let spec = MosaicSpec {
                layback_m,
                range_m: 70.0,
                overlap: Overlap::Nearest,
                ..MosaicSpec::default()
            };
            let (mosaic, (east, north)) = survey(spec, ways);
            let (x, y) = brightest(&mosaic);
            let want = mosaic.pixel(east, north).expect("inside");
            assert!(
                x.abs_diff(want.0) <= 1 && y.abs_diff(want.1) <= 1,
                "layback {layback_m}, {ways:?}: {x} {y}, want {want:?}"
            );
        }
    }

    /// Pings five pixels apart, of which one passes abeam of the target.
    #[test]
    fn a_target_lies_within_a_pixel_where_pings_are_far_apart() {
        let plane = LocalTangentPlane::new(0.6, -1.2);
        let (altitude_m, across_m): (f64, f64) = (12.0, 30.3);
        for overlap in [Overlap::Nearest, Overlap::Mean] {
            for hit in [11, 12] {
                let spec = MosaicSpec {
                    range_m: 60.0,
                    overlap,
                    ..MosaicSpec::default()
                };
                let spacing_m = 5.2 * spec.metres_per_pixel;
                let mut builder = MosaicBuilder::new(spec);
                for ping in 0..24 {
                    let (latitude_rad, longitude_rad) =
                        plane.geodetic_rad(spacing_m * f64::from(ping), 0.0);
                    let mut amplitude = vec![0.1f32; 4000];
                    if ping == hit {
                        amplitude[AXIS.sample(across_m.hypot(altitude_m))] = 30.0;
                    }
                    let line = Line {
                        side: Side::Starboard,
                        amplitude,
                    };
                    let pose = SonarPose::level(latitude_rad, longitude_rad, 0.0, altitude_m);
                    builder.push(&pose, AXIS, &[line]);
                }
                let (latitude, longitude) =
                    plane.geodetic_rad(spacing_m * f64::from(hit), across_m);
                let mosaic = builder.finish().expect("a map");
                let (east, north) = mosaic.zone.project_m(latitude, longitude);
                let want = mosaic.pixel(east, north).expect("inside");
                let (x, y) = brightest(&mosaic);
                assert!(
                    x.abs_diff(want.0) <= 1 && y.abs_diff(want.1) <= 1,
                    "{overlap:?}, ping {hit}: {x} {y}, want {want:?}"
                );
            }
        }
    }

    /// A pitching, moving body with off-centre arrays: the ping whose beam passes the target receives it, not the ping abeam of it.
    #[test]
    fn pitch_drift_and_lever_arms_place_target_and_mask_correctly() {
        let plane = LocalTangentPlane::new(0.6, -1.2);
        let altitude_m = 20.0;
        let spec = MosaicSpec {
            range_m: 60.0,
            ..MosaicSpec::default()
        };
        let mut builder = MosaicBuilder::new(spec);
        // Due north; the target is 30 m to starboard of the track.
        let (target_north, target_east) = (41.2, 30.3);
        for ping in 0..400 {
            let north = 0.2 * f64::from(ping);
            let pitch_rad = 4f64.to_radians() * (0.05 * f64::from(ping)).sin();
            let drift = 0.004;
            let starboard_m = [-1.0, 1.5];
            let across_m: f64 = target_east - starboard_m[1];
            let slant_m = across_m.hypot(altitude_m);
            let beam_north = north + altitude_m * pitch_rad.tan() + drift * slant_m;
            let mut amplitude = vec![0.1f32; 4000];
            let mut truth = LineTruth {
                side: Side::Starboard,
                target: vec![0; 4000],
                target_energy: vec![0.0; 4000],
                other_energy: vec![0.01; 4000],
                ground: vec![echotank_core::ping::GroundSeen::Seen; 4000],
                down_m: vec![20.0; 4000],
            };
            if (beam_north - target_north).abs() < 0.15 {
                let k = AXIS.sample(slant_m);
                amplitude[k] = 30.0;
                (truth.target[k], truth.target_energy[k]) = (7, 900.0);
            }
            let (latitude_rad, longitude_rad) = plane.geodetic_rad(north, 0.0);
            let pose = SonarPose {
                pitch_rad,
                drift,
                starboard_m,
                ..SonarPose::level(latitude_rad, longitude_rad, 0.0, altitude_m)
            };
            let line = Line {
                side: Side::Starboard,
                amplitude,
            };
            builder.push_labelled(&pose, AXIS, &[line], &[truth]);
        }
        let (latitude, longitude) = plane.geodetic_rad(target_north, target_east);
        let mosaic = builder.finish().expect("a map");
        let (east, north) = mosaic.zone.project_m(latitude, longitude);
        let want = mosaic.pixel(east, north).expect("inside");
        let (x, y) = brightest(&mosaic);
        assert!(
            x.abs_diff(want.0) <= 1 && y.abs_diff(want.1) <= 1,
            "{x} {y}, want {want:?}"
        );
        let labelled: Vec<usize> = (0..mosaic.masks.len())
            .filter(|&p| mosaic.masks[p].target == 7)
            .collect();
        assert!(!labelled.is_empty());
        for p in labelled {
            let (x, y) = (p % mosaic.width, p / mosaic.width);
            assert!(
                x.abs_diff(want.0) <= 1 && y.abs_diff(want.1) <= 2,
                "labelled {x} {y}, want {want:?}"
            );
        }
        // Masks have ground exactly where the picture has data.
        for (mask, intensity) in mosaic.masks.iter().zip(&mosaic.intensity) {
            assert_eq!(mask.down_m.is_nan(), intensity.is_nan());
        }
    }

    #[test]
    fn the_swath_has_no_gaps_and_the_nadir_is_omitted_on_request() {
        for nadir_deg in [0.0, 30.0_f64] {
            let spec = MosaicSpec {
                range_m: 60.0,
                nadir_rad: nadir_deg.to_radians(),
                ..MosaicSpec::default()
            };
            let (mosaic, _) = survey(spec, &[0.0]);
            let laid = mosaic.intensity.iter().filter(|i| !i.is_nan()).count();
            let area_m2 = laid as f64 * mosaic.metres_per_pixel.powi(2);
            let nadir_m = 12.0 * nadir_deg.to_radians().tan();
            let want_m2 = 79.8 * 2.0 * (60.0 - nadir_m);
            // Edges of the swath: half a pixel all round.
            assert!(
                (area_m2 / want_m2 - 1.0).abs() < 0.02,
                "{area_m2} want {want_m2}"
            );
        }
    }

    #[test]
    fn the_geotiff_reads_back_with_its_position_and_values() {
        let (mosaic, _) = survey(
            MosaicSpec {
                range_m: 30.0,
                ..MosaicSpec::default()
            },
            &[0.0],
        );
        let mut bytes = io::Cursor::new(Vec::new());
        mosaic.write_geotiff(&mut bytes).expect("written");
        bytes.set_position(0);
        let mut decoder = tiff::decoder::Decoder::new(bytes).expect("a TIFF");
        assert_eq!(
            decoder.dimensions().expect("a size"),
            (mosaic.width as u32, mosaic.height as u32)
        );
        let tie = decoder
            .get_tag_f64_vec(Tag::ModelTiepointTag)
            .expect("a tie point");
        assert_eq!(tie[3..5], [mosaic.west_m, mosaic.north_m]);
        let keys = decoder
            .get_tag_u16_vec(Tag::GeoKeyDirectoryTag)
            .expect("keys");
        assert!(
            keys.chunks(4)
                .any(|k| k[0] == PROJECTED_CRS && k[3] == mosaic.zone.epsg())
        );
    }

    #[test]
    fn too_many_pixels_and_no_pings_are_errors() {
        let none = MosaicBuilder::new(MosaicSpec::default()).finish();
        assert!(matches!(none, Err(MosaicError::Empty)));
        let spec = MosaicSpec {
            max_pixels: 1000,
            ..MosaicSpec::default()
        };
        let mut builder = MosaicBuilder::new(spec);
        let pose = SonarPose::level(0.5, 0.1, 0.0, 5.0);
        builder.push(&pose, AXIS, &[]);
        assert!(matches!(
            builder.finish(),
            Err(MosaicError::TooLarge { .. })
        ));
    }
}

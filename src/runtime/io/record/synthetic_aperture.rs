//! Files of a synthetic-aperture image: `sas.png` (dB below the peak), `sas.npy` (complex64, rows north to south, columns west to east) and `sas.json`
//! (position, peak and -3 dB widths).

use std::path::{Path, PathBuf};

use ::png::{BitDepth, ColorType, Encoder, EncodingError};
use num_complex::Complex64;
use serde_json::json;

use super::{PartialFile, RecordError};
use echotank_config::spec::ColourMap;
use echotank_imaging::image::colour::rgb;

/// Level shown as black, dB below the peak.
const FLOOR_DB: f64 = 40.0;

/// An image of a patch of the world, rows north to south, columns west to east.
pub(crate) struct Patch {
    /// Columns of `image`.
    pub columns: usize,
    /// Rows of `image`.
    pub rows: usize,
    /// North coordinate of the north-west corner, m.
    pub north_m: f64,
    /// West edge, m east of the world's origin.
    pub west_m: f64,
    /// Depth of the image plane, m, positive down.
    pub down_m: f64,
    /// Edge of a cell, m.
    pub cell_m: f64,
    /// Number of pings in the image.
    pub pings: u64,
    /// Length of the track from the first ping to the last, m.
    pub(crate) track_m: f64,
    /// Complex image, row by row.
    pub image: Vec<Complex64>,
}

impl Patch {
    fn peak(&self) -> (usize, f64) {
        let level = self.image.iter().map(|x| x.norm());
        level.enumerate().fold(
            (0, 0.0),
            |best, now| if now.1 > best.1 { now } else { best },
        )
    }

    /// Full -3 dB width through the peak, m; `None` if the patch ends within the main lobe.
    fn width_m(&self, at: usize, step: usize, inside: impl Fn(usize) -> bool) -> Option<f64> {
        let half = self.image[at].norm() * 0.5_f64.sqrt();
        let reach = |forward: bool| {
            let (mut here, mut steps) = (at, 0.0);
            loop {
                let next = match forward {
                    true => here.checked_add(step).filter(|&n| n < self.image.len()),
                    false => here.checked_sub(step),
                }
                .filter(|&n| inside(n))?;
                let (a, b) = (self.image[here].norm(), self.image[next].norm());
                if b <= half {
                    return Some(steps + (a - half) / (a - b));
                }
                (here, steps) = (next, steps + 1.0);
            }
        };
        Some((reach(true)? + reach(false)?) * self.cell_m)
    }

    fn summary(&self) -> serde_json::Value {
        let (at, level) = self.peak();
        let (row, column) = (at / self.columns, at % self.columns);
        json!({
            "rows": self.rows,
            "columns": self.columns,
            "north_m": self.north_m,
            "west_m": self.west_m,
            "down_m": self.down_m,
            "cell_m": self.cell_m,
            "pings": self.pings,
            "track_m": self.track_m,
            "peak": {
                "level_v": level,
                "north_m": self.north_m - (row as f64 + 0.5) * self.cell_m,
                "east_m": self.west_m + (column as f64 + 0.5) * self.cell_m,
                "width_north_m": self.width_m(at, self.columns, |_| true),
                "width_east_m": self.width_m(at, 1, |n| n / self.columns == row),
            },
        })
    }

    fn encode(&self, to: impl std::io::Write) -> Result<(), EncodingError> {
        let size = |n: usize| u32::try_from(n).map_err(std::io::Error::other);
        let mut encoder = Encoder::new(to, size(self.columns)?, size(self.rows)?);
        encoder.set_color(ColorType::Rgb);
        encoder.set_depth(BitDepth::Eight);
        encoder.add_text_chunk(
            "Description".into(),
            format!(
                "Synthetic aperture: north up, {} m a pixel, {FLOOR_DB} dB from black to brightest",
                self.cell_m
            ),
        )?;
        let (_, peak) = self.peak();
        let pixels: Vec<u8> = self
            .image
            .iter()
            .flat_map(|x| {
                let db = 20.0 * (x.norm() / peak.max(f64::MIN_POSITIVE)).log10();
                rgb(ColourMap::Copper, (1.0 + db / FLOOR_DB) as f32)
            })
            .collect();
        encoder.write_header()?.write_image_data(&pixels)
    }

    /// Encodes the image in NumPy format 1.0.
    fn npy(&self) -> Vec<u8> {
        let mut header = format!(
            "{{'descr': '<c8', 'fortran_order': False, 'shape': ({}, {}), }}",
            self.rows, self.columns
        );
        const LEAD: usize = 10;
        let padded = (LEAD + header.len() + 1).next_multiple_of(64);
        header.push_str(&" ".repeat(padded - LEAD - header.len() - 1));
        header.push('\n');
        let mut bytes = b"\x93NUMPY\x01\x00".to_vec();
        bytes.extend((header.len() as u16).to_le_bytes());
        bytes.extend(header.as_bytes());
        for x in &self.image {
            bytes.extend((x.re as f32).to_le_bytes());
            bytes.extend((x.im as f32).to_le_bytes());
        }
        bytes
    }

    /// Writes the three files into `folder` and returns their paths.
    pub(crate) fn write(&self, folder: &Path) -> Result<Vec<PathBuf>, RecordError> {
        let [png, npy, json] = ["sas.png", "sas.npy", "sas.json"].map(|name| folder.join(name));
        let mut file = PartialFile::create(&png)?;
        self.encode(&mut file.file).map_err(|e| {
            RecordError::io(&file.partial, "write")(match e {
                EncodingError::IoError(e) => e,
                other => std::io::Error::other(other),
            })
        })?;
        file.keep(&png)?;
        let summary = format!("{:#}\n", self.summary());
        for (path, bytes) in [(&npy, self.npy()), (&json, summary.into_bytes())] {
            let mut file = PartialFile::create(path)?;
            file.write(&bytes)?;
            file.keep(path)?;
        }
        Ok(vec![png, npy, json])
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn patch() -> Patch {
        let wake_up = |x: f64, width: f64| (-(x / width).powi(2)).exp();
        Patch {
            columns: 41,
            rows: 31,
            north_m: 5.0,
            west_m: -2.0,
            down_m: 10.0,
            cell_m: 0.1,
            pings: 3,
            track_m: 2.0,
            image: (0..31 * 41)
                .map(|i| {
                    wake_up((i / 41) as f64 - 12.0, 3.0) * wake_up((i % 41) as f64 - 20.0, 6.0)
                })
                .map(Complex64::from)
                .collect(),
        }
    }

    #[test]
    fn the_files_hold_the_image_and_say_where_its_peak_lies_and_how_wide_it_is() {
        let dir = tempfile::tempdir().expect("dir");
        let files = patch().write(dir.path()).expect("written");
        assert_eq!(files.len(), 3);
        let text = std::fs::read_to_string(&files[2]).expect("json");
        let said: serde_json::Value = serde_json::from_str(&text).expect("json");
        let number = |key: &str| said["peak"][key].as_f64().expect("a number");
        assert!((number("north_m") - 3.75).abs() < 1e-9);
        assert!((number("east_m") - 0.05).abs() < 1e-9);
        // A Gaussian exp(-(x/w)^2) falls to half its power at w sqrt(ln 2 / 2).
        let half = (0.5 * 2.0_f64.ln()).sqrt();
        assert!((number("width_north_m") / (0.6 * half) - 1.0).abs() < 0.02);
        assert!((number("width_east_m") / (1.2 * half) - 1.0).abs() < 0.02);
        let npy = std::fs::read(&files[1]).expect("npy");
        assert_eq!(npy.len(), 128 + 8 * 31 * 41);
        let decoder = ::png::Decoder::new(std::io::BufReader::new(
            std::fs::File::open(&files[0]).expect("png"),
        ));
        let reader = decoder.read_info().expect("png");
        assert_eq!((reader.info().width, reader.info().height), (41, 31));
    }

    #[test]
    fn a_peak_at_the_edge_has_no_width_and_an_empty_image_no_picture_of_noise() {
        let mut patch = patch();
        patch.image.fill(Complex64::ZERO);
        patch.image[0] = Complex64::ONE;
        let said = patch.summary();
        assert!(said["peak"]["width_north_m"].is_null());
        patch.image[0] = Complex64::ZERO;
        let mut bytes = Vec::new();
        patch.encode(&mut bytes).expect("encoded");
    }
}

//! Writes pictures and their masks.

use std::path::{Path, PathBuf};

use ::png::{BitDepth, ColorType, Encoder, EncodingError};
use serde_json::{Map, Value, json};

use super::{PartialFile, RecordError};
use echotank_config::spec::{ColourMap, Contrast};
use echotank_imaging::image::masks::Mask;
use echotank_imaging::image::mosaic::{Mosaic, MosaicError};
use echotank_imaging::image::water_column::Picture;

/// Number of values of a depth mask; 0 means no depth.
const DEPTH_COUNTS: f64 = 65_534.0;
/// Finest step of a depth mask, m.
const FINEST_DEPTH_M: f64 = 1e-3;

fn write_png(
    path: &Path,
    (width, height): (usize, usize),
    (colour, depth): (ColorType, BitDepth),
    bytes: &[u8],
) -> Result<(), RecordError> {
    let mut target = PartialFile::create(path)?;
    let size = |n: usize| u32::try_from(n).map_err(std::io::Error::other);
    let written = || -> Result<(), EncodingError> {
        let mut encoder = Encoder::new(&mut target.file, size(width)?, size(height)?);
        encoder.set_color(colour);
        encoder.set_depth(depth);
        let mut writer = encoder.write_header()?;
        writer.write_image_data(bytes)?;
        writer.finish()
    };
    let mut written = written;
    written().map_err(|e| {
        RecordError::io(&target.partial, "write")(match e {
            EncodingError::IoError(e) => e,
            other => std::io::Error::other(other),
        })
    })?;
    target.keep(path)
}

pub(crate) fn write_picture(path: &Path, picture: &Picture) -> Result<(), RecordError> {
    let size = (picture.width, picture.height);
    write_png(path, size, (ColorType::Rgb, BitDepth::Eight), &picture.rgb)
}

/// Writes `NAME.tif` and `NAME.png` of a mosaic. Returns false and writes nothing if the mosaic is empty.
///
/// # Errors
/// A file cannot be written.
pub fn write_mosaic(
    tiff: &Path,
    png: &Path,
    mosaic: &Mosaic,
    colours: ColourMap,
    contrast: Contrast,
) -> Result<bool, RecordError> {
    if mosaic.intensity.iter().all(|i| i.is_nan()) {
        return Ok(false);
    }
    let of = |path: &Path, e: MosaicError| {
        RecordError::io(path, "write")(match e {
            MosaicError::Io(e) => e,
            other => std::io::Error::other(other),
        })
    };
    let mut target = PartialFile::create(tiff)?;
    (mosaic.write_geotiff(&mut target.file)).map_err(|e| of(tiff, e))?;
    target.keep(tiff)?;
    let mut target = PartialFile::create(png)?;
    (mosaic.write_png(&mut target.file, colours, contrast)).map_err(|e| of(png, e))?;
    target.keep(png)?;
    Ok(true)
}

/// Writes the masks of `STEM.png`, pixel for pixel, and `STEM_masks.json`, which describes them. The masks are `STEM_target.png` (16 bits, 0 none),
/// `STEM_shadow.png` (8 bits, 255 shadow) and `STEM_depth.png` (16 bits, 0 none). `names` are the names of the targets, from 1.
pub(crate) fn write_masks<M: Iterator<Item = Mask> + Clone>(
    folder: &Path,
    stem: &str,
    (width, height): (usize, usize),
    masks: M,
    names: &[String],
) -> Result<Vec<PathBuf>, RecordError> {
    let path = |what: &str| folder.join(format!("{stem}_{what}"));
    let size = (width, height);
    let deep = (ColorType::Grayscale, BitDepth::Sixteen);
    let targets: Vec<u8> = masks.clone().flat_map(|m| m.target.to_be_bytes()).collect();
    write_png(&path("target.png"), size, deep, &targets)?;
    let shadow: Vec<u8> = masks.clone().map(|m| 255 * u8::from(m.shadow)).collect();
    let plain = (ColorType::Grayscale, BitDepth::Eight);
    write_png(&path("shadow.png"), size, plain, &shadow)?;
    let depths = masks.clone().map(|m| f64::from(m.down_m));
    let (least, most) = depths
        .filter(|d| d.is_finite())
        .fold((f64::INFINITY, f64::NEG_INFINITY), |(a, b), d| {
            (a.min(d), b.max(d))
        });
    let least = if least.is_finite() { least } else { 0.0 };
    let step = ((most - least) / DEPTH_COUNTS).max(FINEST_DEPTH_M);
    let count = |down_m: f32| match down_m.is_nan() {
        true => 0,
        false => 1 + ((f64::from(down_m) - least) / step).round() as u16,
    };
    let depth: Vec<u8> = masks.flat_map(|m| count(m.down_m).to_be_bytes()).collect();
    write_png(&path("depth.png"), size, deep, &depth)?;
    let numbered: Map<String, Value> = (1..)
        .zip(names)
        .map(|(number, name): (usize, _)| (number.to_string(), Value::from(name.as_str())))
        .collect();
    let text = json!({
        "picture": format!("{stem}.png"), "width": width, "height": height,
        "target": { "file": format!("{stem}_target.png"), "none": 0, "names": numbered },
        "shadow": { "file": format!("{stem}_shadow.png"), "shadow": 255 },
        "depth": {
            "file": format!("{stem}_depth.png"), "none": 0, "metres_per_count": step, "count_0_m": least - step,
            "meaning": "metres below the world's zero = count_0_m + count * metres_per_count",
        },
    });
    let file = path("masks.json");
    let mut target = PartialFile::create(&file)?;
    target.write(format!("{text:#}\n").as_bytes())?;
    target.keep(&file)?;
    Ok(["target.png", "shadow.png", "depth.png", "masks.json"]
        .map(path)
        .to_vec())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn read(path: &Path) -> (::png::OutputInfo, Vec<u8>) {
        let file = std::io::BufReader::new(std::fs::File::open(path).expect("file"));
        let mut reader = ::png::Decoder::new(file).read_info().expect("PNG");
        let mut pixels = vec![0; reader.output_buffer_size().expect("size")];
        let info = reader.next_frame(&mut pixels).expect("pixels");
        (info, pixels)
    }

    #[test]
    fn masks_are_read_back_with_their_scale_and_names() {
        let dir = tempfile::tempdir().expect("dir");
        let masks = [
            Mask {
                target: 300,
                shadow: false,
                down_m: 12.345,
            },
            Mask::EMPTY,
            Mask {
                target: 0,
                shadow: true,
                down_m: 4012.0,
            },
        ];
        let names = ["a".to_owned(), "b".to_owned()];
        let files =
            write_masks(dir.path(), "w", (3, 1), masks.into_iter(), &names).expect("written");
        assert_eq!(files.len(), 4);
        let (info, bytes) = read(&files[0]);
        assert_eq!(
            (info.bit_depth, &bytes[..2]),
            (BitDepth::Sixteen, &300u16.to_be_bytes()[..])
        );
        assert_eq!(read(&files[1]).1, [0, 0, 255]);
        let text = std::fs::read_to_string(&files[3]).expect("json");
        let json: Value = serde_json::from_str(&text).expect("json");
        assert_eq!(json["target"]["names"]["2"], "b");
        let number = |key: &str| json["depth"][key].as_f64().expect("a number");
        let (_, bytes) = read(&files[2]);
        for (mask, count) in masks.iter().zip(bytes.chunks(2)) {
            let count = u16::from_be_bytes([count[0], count[1]]);
            assert_eq!(count == 0, mask.down_m.is_nan());
            if count > 0 {
                let got = number("count_0_m") + f64::from(count) * number("metres_per_count");
                let want = f64::from(mask.down_m);
                assert!(
                    (got - want).abs() <= 0.51 * number("metres_per_count"),
                    "{got} {want}"
                );
            }
        }
    }
}

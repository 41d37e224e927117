//! GeoTIFF: one band of heights in tiles or strips, uncompressed, deflate or LZW, any predictor, with GeoKeys.
//!
//! Source: Adobe, TIFF revision 6.0 and Technical Note 3 (predictor 3); OGC 19-008r4 (GeoTIFF 1.1): tags ModelPixelScale, ModelTiepoint,
//! GeoKeyDirectory. GDAL's tags 42112 and 42113 (GDAL documentation, GTiff driver) state scale, offset and unit of the values, and the hole value.
//! Rotated grids and several bands are rejected.

use std::io::Cursor;

use tiff::ColorType;
use tiff::decoder::{Decoder, DecodingResult, Limits};
use tiff::tags::Tag;

use super::format_error::{At, refuse};
use super::units::{self, Units};
use super::{
    Crs, Facts, FormatError, MAX_CELLS, Raw, RawGrid, RawShape, Reader, checked_size, crs,
    south_first,
};
use echotank_config::spec::{FirstRow, SeabedFileSpec, SeabedFormat};

/// Largest strip or tile held besides the image, bytes.
const MAX_CHUNK_BYTES: usize = 64 << 20;
/// Largest value of a tag, bytes: the offsets of a million tiles.
const MAX_TAG_BYTES: usize = 8 << 20;

/// GeoKeys (OGC 19-008r4, annex B).
const MODEL_TYPE: u16 = 1024;
const RASTER_TYPE: u16 = 1025;
const CITATION: u16 = 1026;
const GEODETIC_CRS: u16 = 2048;
const ANGULAR_UNIT: u16 = 2054;
const PROJECTED_CRS: u16 = 3072;
const PROJECTED_CITATION: u16 = 3073;
const LINEAR_UNIT: u16 = 3076;
const VERTICAL_UNIT: u16 = 4099;

/// GDAL's metadata, XML.
const GDAL_METADATA: u16 = 42112;
/// Compressions of TIFF that are known and not read (libtiff, tiff.h).
const UNREAD_COMPRESSIONS: [(u16, &str); 8] = [
    (6, "JPEG"),
    (7, "JPEG"),
    (34_712, "JPEG 2000"),
    (34_887, "LERC"),
    (34_925, "LZMA"),
    (50_000, "ZSTD"),
    (50_001, "WebP"),
    (50_002, "JPEG XL"),
];

const DEGREE: u16 = 9102;
const RASTER_PIXEL_IS_POINT: u16 = 2;
/// The parameters are in the file instead of the EPSG register.
const USER_DEFINED: u16 = 32_767;

pub(super) const READER: Reader = Reader {
    format: SeabedFormat::GeoTiff,
    name: "GeoTIFF",
    recognises: |head, _| {
        [&b"II*\0"[..], b"MM\0*", b"II+\0", b"MM\0+"]
            .iter()
            .any(|magic| head.starts_with(magic))
    },
    read,
};

fn read(bytes: Vec<u8>, spec: &SeabedFileSpec) -> Result<Raw, FormatError> {
    let mut limits = Limits::default();
    limits.decoding_buffer_size = MAX_CELLS * size_of::<f64>();
    limits.intermediate_buffer_size = MAX_CHUNK_BYTES;
    limits.ifd_value_size = MAX_TAG_BYTES;
    let mut tiff = Decoder::new(Cursor::new(bytes))
        .at("TIFF header")?
        .with_limits(limits);
    let (width, height) = tiff.dimensions().at("tag ImageWidth")?;
    let (rows, cols) = checked_size(height.into(), width.into(), "tag ImageWidth")?;
    let place = "tag SamplesPerPixel";
    let kind = tiff.colortype().at(place)?;
    if !matches!(kind, ColorType::Gray(8..=64)) {
        let rule = "must be one band of heights, of 8 to 64 bits";
        return refuse(place, format!("{kind:?}"), rule);
    }
    if let Ok(Some(value)) = tiff.find_tag(Tag::Compression)
        && let Ok(code) = value.into_u16()
        && let Some((_, name)) = UNREAD_COMPRESSIONS.iter().find(|(c, _)| *c == code)
    {
        let rule = format!("not supported: {name}; rewrite the file with deflate or LZW");
        return refuse("tag Compression", code, rule);
    }
    let keys = GeoKeys::read(&mut tiff)?;
    let band_is = BandMetadata::read(&mut tiff)?;
    let place = Georeference::read(&mut tiff, &keys)?;
    let nodata = match tiff.find_tag(Tag::GdalNodata) {
        Ok(Some(value)) => {
            let place = "tag GDAL_NODATA";
            let text = value.into_string().at(place)?;
            let text = text.trim_matches(['\0', ' ']);
            let value = text.parse::<f64>();
            Some(value.map_err(|_| FormatError::new(place, text, "must be a number"))? as f32)
        }
        _ => None,
    };
    let mut values = band(tiff.read_image().at("image")?);
    if values.len() != rows * cols {
        let rule = format!("holds {} cells, not {rows} x {cols}", values.len());
        return refuse("image", "", rule);
    }
    let first_row = spec.first_row.unwrap_or(place.first_row);
    let also = spec.nodata.map(|v| v as f32);
    // Holes are marked in the stored numbers.
    for value in &mut values {
        *value = match Some(*value) == nodata || Some(*value) == also {
            true => f32::NAN,
            false => (f64::from(*value) * band_is.scale + band_is.offset) as f32,
        };
    }
    // The tie point refers to the file's first pixel. If the first row is the northern one, the south-western pixel lies one grid extent south.
    let y_south = match place.first_row {
        FirstRow::North => place.first_y - (rows - 1) as f64 * place.y_step,
        FirstRow::South => place.first_y,
    };
    Ok(Raw {
        shape: RawShape::Grid(RawGrid {
            rows,
            cols,
            x_west: place.first_x,
            y_south,
            x_step: place.x_step,
            y_step: place.y_step,
            values: south_first(values, cols, first_row, |_| false, "image")?,
            first_row,
            from_corners: place.from_corners,
        }),
        facts: Facts {
            crs: keys.crs()?,
            units: Units {
                vertical_m: band_is.unit_m.or(keys.units()?.vertical_m),
                ..keys.units()?
            },
            notes: keys.citation.into_iter().chain(band_is.note()).collect(),
            ..Facts::default()
        },
    })
}

/// What GDAL's metadata state of the band.
struct BandMetadata {
    scale: f64,
    offset: f64,
    unit_m: Option<f64>,
}

impl BandMetadata {
    fn read(tiff: &mut Tiff) -> Result<Self, FormatError> {
        const PLACE: &str = "tag GDAL_METADATA";
        let mut found = Self {
            scale: 1.0,
            offset: 0.0,
            unit_m: None,
        };
        let Ok(Some(value)) = tiff.find_tag(Tag::Unknown(GDAL_METADATA)) else {
            return Ok(found);
        };
        let text = value.into_string().at(PLACE)?;
        let document =
            roxmltree::Document::parse(text.trim_matches(['\0', ' ', '\n'])).at(PLACE)?;
        for item in document.descendants().filter(|n| n.has_tag_name("Item")) {
            // Items without a sample are of the file.
            if item.attribute("sample") != Some("0") {
                continue;
            }
            let text = item.text().unwrap_or("").trim();
            let number = |rule: &str| {
                let value = text.parse::<f64>().ok().filter(|v| v.is_finite());
                value.ok_or_else(|| FormatError::new(PLACE, text, rule))
            };
            match item.attribute("role") {
                Some("scale") => found.scale = number("must be a finite scale")?,
                Some("offset") => found.offset = number("must be a finite offset")?,
                Some("unittype") => {
                    found.unit_m = units::of_word(text);
                    if found.unit_m.is_none() && !text.is_empty() {
                        return refuse(PLACE, text, "is not a supported unit of length");
                    }
                }
                _ => {}
            }
        }
        if found.scale == 0.0 {
            return refuse(PLACE, found.scale, "must be a scale other than 0");
        }
        Ok(found)
    }

    fn note(&self) -> Option<String> {
        (self.scale != 1.0 || self.offset != 0.0).then(|| {
            format!(
                "heights are the stored numbers times {} plus {}, as the file states",
                self.scale, self.offset
            )
        })
    }
}

/// Converts heights to f32. Integers of more than 24 bits are no heights and are rejected later by their size.
fn band(image: DecodingResult) -> Vec<f32> {
    fn all<T: Copy>(from: Vec<T>, to_f32: impl Fn(T) -> f32) -> Vec<f32> {
        from.into_iter().map(to_f32).collect()
    }
    match image {
        DecodingResult::F32(v) => v,
        DecodingResult::F64(v) => all(v, |x| x as f32),
        DecodingResult::F16(v) => all(v, |x| x.to_f32()),
        DecodingResult::U8(v) => all(v, f32::from),
        DecodingResult::I8(v) => all(v, f32::from),
        DecodingResult::U16(v) => all(v, f32::from),
        DecodingResult::I16(v) => all(v, f32::from),
        DecodingResult::U32(v) => all(v, |x| x as f32),
        DecodingResult::I32(v) => all(v, |x| x as f32),
        DecodingResult::U64(v) => all(v, |x| x as f32),
        DecodingResult::I64(v) => all(v, |x| x as f32),
    }
}

type Tiff = Decoder<Cursor<Vec<u8>>>;

fn numbers(tiff: &mut Tiff, tag: Tag, place: &str) -> Result<Option<Vec<f64>>, FormatError> {
    let value = tiff.find_tag(tag).at(place)?;
    value
        .map(|value| value.into_f64_vec().at(place))
        .transpose()
}

pub(super) struct Georeference {
    /// Centre of the file's first pixel.
    first_x: f64,
    first_y: f64,
    x_step: f64,
    y_step: f64,
    first_row: FirstRow,
    from_corners: bool,
}

impl Georeference {
    fn read(tiff: &mut Tiff, keys: &GeoKeys) -> Result<Self, FormatError> {
        const SCALE: &str = "tag ModelPixelScale";
        const TIEPOINT: &str = "tag ModelTiepoint";
        const TRANSFORMATION: &str = "tag ModelTransformation";
        let (x0, y0, dx, dy);
        if let Some(scale) = numbers(tiff, Tag::ModelPixelScaleTag, SCALE)? {
            let [sx, sy, ..] = scale[..] else {
                return refuse(SCALE, format!("{scale:?}"), "must be 3 numbers");
            };
            let tie = numbers(tiff, Tag::ModelTiepointTag, TIEPOINT)?.unwrap_or_default();
            let [i, j, _, x, y, _] = tie[..] else {
                let rule = "must be one tie point of 6 numbers";
                return refuse(TIEPOINT, format!("{tie:?}"), rule);
            };
            // With positive scales, columns run east and rows run south.
            (dx, dy) = (sx, -sy);
            (x0, y0) = (x - i * dx, y - j * dy);
        } else if let Some(m) = numbers(tiff, Tag::ModelTransformationTag, TRANSFORMATION)? {
            let [a, b, _, x, c, d, _, y, ..] = m[..] else {
                return refuse(TRANSFORMATION, format!("{m:?}"), "must be 16 numbers");
            };
            if b != 0.0 || c != 0.0 {
                let rule = "rotates the grid: resample it north-up first";
                return refuse(TRANSFORMATION, format!("{b}, {c}"), rule);
            }
            (dx, dy, x0, y0) = (a, d, x, y);
        } else {
            let rule =
                "is missing: an image without georeference is not a seabed (a GeoTIFF has it)";
            return refuse(SCALE, "", rule);
        }
        let sound = [x0, y0, dx, dy].iter().all(|v| v.is_finite()) && dx > 0.0 && dy != 0.0;
        if !sound {
            let rule = "must be finite, and the columns must run east";
            return refuse(SCALE, format!("{dx}, {dy} from {x0}, {y0}"), rule);
        }
        let from_corners = keys.short(RASTER_TYPE) != Some(RASTER_PIXEL_IS_POINT);
        let half = if from_corners { 0.5 } else { 0.0 };
        Ok(Self {
            first_x: x0 + half * dx,
            first_y: y0 + half * dy,
            x_step: dx,
            y_step: dy.abs(),
            first_row: if dy < 0.0 {
                FirstRow::North
            } else {
                FirstRow::South
            },
            from_corners,
        })
    }
}

/// GeoKeys that the reader uses.
struct GeoKeys {
    shorts: Vec<(u16, u16)>,
    citation: Option<String>,
}

impl GeoKeys {
    fn read(tiff: &mut Tiff) -> Result<Self, FormatError> {
        const PLACE: &str = "tag GeoKeyDirectory";
        let mut shorts = Vec::new();
        let mut citation = None;
        let directory = match tiff.find_tag(Tag::GeoKeyDirectoryTag).at(PLACE)? {
            None => Vec::new(),
            Some(value) => value.into_u16_vec().at(PLACE)?,
        };
        let text = match tiff.find_tag(Tag::GeoAsciiParamsTag) {
            Ok(Some(value)) => value.into_string().unwrap_or_default(),
            _ => String::new(),
        };
        // A header of four numbers, then four for each key: key, location of the value, count, and the value or its offset.
        for entry in directory.chunks_exact(4).skip(1) {
            let [key, location, count, value] = *entry else {
                continue;
            };
            if location == 0 {
                shorts.push((key, value));
            } else if location == 34737 && matches!(key, CITATION | PROJECTED_CITATION) {
                let (from, to) = (usize::from(value), usize::from(value) + usize::from(count));
                let message = text.get(from..to.min(text.len())).unwrap_or("");
                let message = message.trim_end_matches(['|', '\0']).trim();
                if !message.is_empty() {
                    citation = Some(format!("name of the system in the file: {message}"));
                }
            }
        }
        Ok(Self { shorts, citation })
    }

    fn short(&self, key: u16) -> Option<u16> {
        self.shorts.iter().find(|(k, _)| *k == key).map(|(_, v)| *v)
    }

    fn units(&self) -> Result<Units, FormatError> {
        let unit = |key: u16| match self.short(key) {
            None | Some(0 | USER_DEFINED) => Ok(None),
            Some(code) => match units::of_epsg(code.into()) {
                Some(unit_m) => Ok(Some(unit_m)),
                None => refuse(
                    format!("GeoKey {key}"),
                    code,
                    "is not a supported unit of length",
                ),
            },
        };
        let code = self.short(PROJECTED_CRS).map(u32::from);
        Ok(Units {
            horizontal_m: unit(LINEAR_UNIT)?.or_else(|| crs::unit_of_epsg_system(code?)),
            vertical_m: unit(VERTICAL_UNIT)?,
        })
    }

    fn crs(&self) -> Result<Option<Crs>, FormatError> {
        let must = |key: u16, wanted: u16, rule: &str| match self.short(key) {
            Some(v) if v != wanted && v != 0 => refuse(format!("GeoKey {key}"), v, rule),
            _ => Ok(()),
        };
        must(ANGULAR_UNIT, DEGREE, "must be 9102, degree")?;
        let named = |key: u16| self.short(key).filter(|v| *v != 0);
        let unregistered = || {
            let message = self.citation.clone();
            message.unwrap_or_else(|| "defined in the file".to_owned())
        };
        match (
            self.short(MODEL_TYPE),
            named(PROJECTED_CRS),
            named(GEODETIC_CRS),
        ) {
            (Some(3), _, _) => refuse(
                "GeoKey 1024",
                "3",
                "is earth-centred: only projected (1) and geographic (2) grids are read",
            ),
            (Some(2), _, Some(code)) if code != USER_DEFINED => {
                Crs::from_epsg(code.into(), "GeoKey 2048").map(Some)
            }
            (Some(2), _, _) => Ok(Some(Crs::Geographic(unregistered()))),
            (_, Some(code), _) if code != USER_DEFINED => {
                Crs::from_epsg(code.into(), "GeoKey 3072").map(Some)
            }
            (Some(1), _, _) | (_, Some(_), _) => Ok(Some(Crs::Projected(unregistered()))),
            _ => Ok(None),
        }
    }
}

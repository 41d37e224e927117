//! Bathymetric attributed grids (BAG): HDF5 with `/BAG_root/{elevation, uncertainty, metadata}`.
//!
//! Source: Open Navigation Surface Working Group, "Format Specification Document, Description of Bathymetric Attributed Grid Object (BAG)" 1.0 to
//! 2.0. Elevations are positive up, the first row is the southern one, and coordinates refer to cell centres. The metadata are XML in one of two
//! schemas: BAG's own up to 1.4, ISO 19139 with well-known text from 1.5. Both share the local names by which elements are found. A
//! variable-resolution BAG is read at its base resolution.

use hdf5_reader::{Hdf5File, OpenOptions};
use roxmltree::{Document, Node};

use super::format_error::{At, refuse};
use super::units::Units;
use super::{
    Crs, Facts, FormatError, MAX_CELLS, Raw, RawGrid, RawShape, Reader, checked_size, south_first,
};
use echotank_config::spec::{FirstRow, HeightSign, SeabedFileSpec, SeabedFormat};

const ELEVATION: &str = "/BAG_root/elevation";
const UNCERTAINTY: &str = "/BAG_root/uncertainty";
const METADATA: &str = "/BAG_root/metadata";
const REFINEMENTS: &str = "/BAG_root/varres_metadata";

/// Hole value of both layers (specification, section 3).
const NULL: f32 = 1e6;
/// Largest decoded chunk: a quarter of the largest grid.
const MAX_CHUNK_BYTES: usize = MAX_CELLS;
/// Largest metadata. Those of a survey take some ten kilobytes.
const MAX_METADATA_BYTES: u64 = 16 << 20;
/// Producers put the north-eastern corner at the last centre or a cell beyond it.
const CORNER_TOLERANCE_CELLS: f64 = 1.5;

pub(super) const READER: Reader = Reader {
    format: SeabedFormat::Bag,
    name: "BAG",
    recognises: |head, _| head.starts_with(b"\x89HDF\r\n\x1a\n"),
    read,
};

fn read(bytes: Vec<u8>, spec: &SeabedFileSpec) -> Result<Raw, FormatError> {
    let options = OpenOptions::default()
        .with_chunk_cache_bytes(0)
        .with_max_chunk_bytes(MAX_CHUNK_BYTES)
        .with_max_read_bytes(MAX_CELLS * size_of::<f32>());
    let file = Hdf5File::from_vec_with_options(bytes, options).at("HDF5")?;
    if file.dataset(METADATA).is_err() && file.dataset(ELEVATION).is_err() {
        let rule = "not supported: HDF5 without /BAG_root, such as netCDF; convert it to GeoTIFF";
        return refuse("file", "", rule);
    }
    let metadata = Metadata::read(&file)?;
    let (rows, cols, values) = layer(&file, ELEVATION)?;
    for (what, announced, got) in [
        ("row", metadata.rows, rows),
        ("column", metadata.cols, cols),
    ] {
        if announced.size.is_some_and(|size| size != got as u64) {
            let rule = format!("differs from the number of {what}s in {ELEVATION}, {got}");
            let message = announced.size.unwrap_or_default().to_string();
            return refuse(METADATA, &message, rule);
        }
    }
    let [west, south, east, north] = metadata.corners;
    let mut guesses = Vec::new();
    let steps = [
        ("column", metadata.cols.step, east - west, cols),
        ("row", metadata.rows.step, north - south, rows),
    ];
    for (what, step, extent, count) in steps {
        // Samples of the format's own authors have such corners.
        let off_cells = extent / step - (count - 1) as f64;
        if off_cells.abs() > CORNER_TOLERANCE_CELLS {
            guesses.push(format!(
                "the corners are {extent} apart, but {count} {what}s of {step} span {}: the south-western corner and the cell size are used",
                (count - 1) as f64 * step
            ));
        }
    }
    let mut notes = metadata.notes;
    if let Ok((_, _, uncertainty)) = layer(&file, UNCERTAINTY) {
        notes.push(spread_of(&uncertainty));
    }
    if file.dataset(REFINEMENTS).is_ok() {
        notes.push("variable resolution: read at its base resolution only".to_owned());
    }
    let first_row = spec.first_row.unwrap_or(FirstRow::South);
    let also = spec.nodata.map(|v| v as f32);
    let is_hole = |v: f32| v == NULL || Some(v) == also;
    Ok(Raw {
        shape: RawShape::Grid(RawGrid {
            rows,
            cols,
            x_west: west,
            y_south: south,
            x_step: metadata.cols.step,
            y_step: metadata.rows.step,
            values: south_first(values, cols, first_row, is_hole, ELEVATION)?,
            first_row,
            from_corners: false,
        }),
        facts: Facts {
            crs: metadata.crs,
            values: Some((HeightSign::Elevation, "BAG holds elevations")),
            units: metadata.units,
            guesses,
            notes,
            covers_deg: metadata.covers_deg,
        },
    })
}

/// Rows, columns and values of a layer.
fn layer(file: &Hdf5File, path: &str) -> Result<(usize, usize, Vec<f32>), FormatError> {
    let dataset = file.dataset(path).at(path)?;
    let &[rows, cols] = dataset.shape() else {
        let rule = format!("must have 2 dimensions, not {}", dataset.shape().len());
        return refuse(path, "", rule);
    };
    let (rows, cols) = checked_size(rows, cols, path)?;
    let values = dataset.read_array::<f32>().at(path)?;
    let (values, offset) = values.into_raw_vec_and_offset();
    if values.len() != rows * cols || offset.unwrap_or(0) != 0 {
        return refuse(
            path,
            "",
            "damaged: contains fewer values than its shape states",
        );
    }
    Ok((rows, cols, values))
}

fn spread_of(uncertainty: &[f32]) -> String {
    let filled = uncertainty
        .iter()
        .filter(|v| v.is_finite() && **v != NULL)
        .map(|v| f64::from(*v));
    let (mut low, mut high, mut sum, mut count) = (f64::INFINITY, f64::NEG_INFINITY, 0.0, 0_u64);
    for v in filled {
        (low, high, sum, count) = (low.min(v), high.max(v), sum + v, count + 1);
    }
    match count {
        0 => "vertical uncertainty: none given".to_owned(),
        _ => format!(
            "vertical uncertainty {low:.3} to {high:.3} m, mean {:.3} m",
            sum / count as f64
        ),
    }
}

#[derive(Clone, Copy)]
struct Axis {
    size: Option<u64>,
    step: f64,
}

struct Metadata {
    rows: Axis,
    cols: Axis,
    /// West, south, east, north in the file's coordinates.
    corners: [f64; 4],
    crs: Option<Crs>,
    units: Units,
    covers_deg: Option<[f64; 4]>,
    notes: Vec<String>,
}

impl Metadata {
    fn read(file: &Hdf5File) -> Result<Self, FormatError> {
        let dataset = file.dataset(METADATA).at(METADATA)?;
        if dataset.num_elements().at(METADATA)? > MAX_METADATA_BYTES {
            let rule = format!("may have {MAX_METADATA_BYTES} bytes at most");
            return refuse(METADATA, "", rule);
        }
        let bytes = dataset.read_raw_bytes().at(METADATA)?;
        let text = std::str::from_utf8(&bytes)
            .map_err(|_| FormatError::new(METADATA, "", "must be UTF-8 text"))?
            .trim_start_matches(['\u{feff}', ' ', '\n', '\r']);
        // Writers pad the array with zeros and line ends.
        let end = text.rfind('>').map_or(0, |at| at + 1);
        Self::parse(&text[..end])
    }

    fn parse(text: &str) -> Result<Self, FormatError> {
        let document = Document::parse(text).at(METADATA)?;
        let root = document.root_element();
        let missing = |what: &str| {
            FormatError::new(
                METADATA,
                what,
                "is missing: the position of the grid depends on it",
            )
        };
        let axis = |name: &str| {
            descendants_named(root, "MD_Dimension")
                .find(|d| {
                    descendants_named(*d, "dimensionName").any(|n| {
                        element_text(n).eq_ignore_ascii_case(name)
                            || n.descendants()
                                .any(|c| c.attribute("codeListValue") == Some(name))
                    })
                })
                .and_then(|d| {
                    let step = descendants_named(d, "resolution").find_map(number)?;
                    (step.is_finite() && step > 0.0).then(|| Axis {
                        size: descendants_named(d, "dimensionSize")
                            .find_map(|n| element_text(n).parse().ok()),
                        step,
                    })
                })
                .ok_or_else(|| missing(&format!("resolution of the {name}s")))
        };
        let (rows, cols) = (axis("row")?, axis("column")?);
        let corners = descendants_named(root, "cornerPoints")
            .find_map(|c| descendants_named(c, "coordinates").next())
            .map(element_text)
            .ok_or_else(|| missing("cornerPoints"))?;
        let numbers: Vec<f64> = corners
            .split([',', ' ', '\n', '\t'])
            .filter(|s| !s.is_empty())
            .map_while(|s| s.parse().ok().filter(|v: &f64| v.is_finite()))
            .collect();
        let Ok(corners) = <[f64; 4]>::try_from(numbers) else {
            let rule = "must be the coordinates of two corners";
            return refuse(METADATA, &corners, rule);
        };
        let mut notes = Vec::new();
        if let Some(vertical) = descendants_named(root, "verticalDatum")
            .map(element_text)
            .find(|w| !w.is_empty())
        {
            notes.push(format!("vertical datum: {vertical}"));
        }
        let (crs, units) = system(root)?.unzip();
        Ok(Self {
            rows,
            cols,
            corners,
            crs,
            units: units.unwrap_or_default(),
            covers_deg: covered_deg(root),
            notes,
        })
    }
}

/// The horizontal coordinate system: well-known text, a code of the EPSG register, or projection and zone of the older schema.
fn system(root: Node) -> Result<Option<(Crs, Units)>, FormatError> {
    const PLACE: &str = "/BAG_root/metadata, referenceSystemInfo";
    for info in descendants_named(root, "referenceSystemInfo") {
        let text = info.descendants().filter_map(|n| n.text()).map(str::trim);
        for text in text {
            let head = text.get(..8).unwrap_or("").to_ascii_uppercase();
            if ["PROJC", "GEOGC", "GEODC", "COMPD", "COMPO"]
                .iter()
                .any(|k| head.starts_with(k))
            {
                let (crs, units) = Crs::from_wkt(text, PLACE)?;
                // The layers are in metres by the specification.
                let vertical_m = None;
                return Ok(Some((
                    crs,
                    Units {
                        vertical_m,
                        ..units
                    },
                )));
            }
        }
        let metric = |crs| Ok(Some((crs, Units::default())));
        let value = |name: &str| {
            descendants_named(info, name)
                .map(element_text)
                .find(|w| !w.is_empty())
        };
        if value("codeSpace").is_some_and(|space| space.eq_ignore_ascii_case("EPSG"))
            && let Some(code) = value("code").and_then(|code| code.parse().ok())
        {
            return metric(Crs::from_epsg(code, PLACE)?);
        }
        let Some(projection) = value("projection") else {
            continue;
        };
        let upper = projection.to_ascii_uppercase();
        if upper.contains("GEOGRAPHIC") || upper.contains("GEODETIC") {
            return metric(Crs::Geographic(projection));
        }
        if !upper.contains("UTM") {
            return metric(Crs::Projected(projection));
        }
        let zone = value("zone").unwrap_or_default();
        let Ok(number) = zone.parse::<i8>() else {
            return refuse(PLACE, &zone, "must be the number of a UTM zone");
        };
        if !(1..=60).contains(&number.unsigned_abs()) {
            return refuse(PLACE, &zone, "must be a UTM zone, 1 to 60");
        }
        let false_northing: f64 = value("falseNorthing")
            .and_then(|v| v.parse().ok())
            .unwrap_or(0.0);
        let datum = value("datum").unwrap_or_else(|| "datum not stated".to_owned());
        return metric(Crs::Utm {
            zone: number.unsigned_abs(),
            north: number > 0 && false_northing == 0.0,
            name: datum,
        });
    }
    Ok(None)
}

fn covered_deg(root: Node) -> Option<[f64; 4]> {
    let side = |name: &str| descendants_named(root, name).find_map(number);
    let sides = [
        side("westBoundLongitude")?,
        side("southBoundLatitude")?,
        side("eastBoundLongitude")?,
        side("northBoundLatitude")?,
    ];
    // Producers leave a box of zeros.
    let is_box = sides.iter().all(|v| v.is_finite()) && sides[0] != sides[2];
    is_box.then_some(sides)
}

/// Descendants with a local name.
fn descendants_named<'a>(
    node: Node<'a, 'a>,
    name: &'a str,
) -> impl Iterator<Item = Node<'a, 'a>> + use<'a> {
    node.descendants()
        .filter(move |n| n.is_element() && n.tag_name().name() == name)
}

/// Text of an element with normalised white space.
fn element_text(node: Node) -> String {
    let text: String = node
        .descendants()
        .filter(|n| n.is_text())
        .filter_map(|n| n.text())
        .collect::<Vec<_>>()
        .join(" ");
    text.split_whitespace().collect::<Vec<_>>().join(" ")
}

fn number(node: Node) -> Option<f64> {
    element_text(node).parse().ok()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Metadata as from BAG version 1.5 on.
    const ISO: &str = r#"<gmi:MI_Metadata xmlns:gmi="i" xmlns:gmd="d" xmlns:gco="c" xmlns:gml="g">
<gmd:spatialRepresentationInfo><gmd:MD_Georectified>
<gmd:axisDimensionProperties><gmd:MD_Dimension><gmd:dimensionName><gmd:MD_DimensionNameTypeCode codeListValue="row">row</gmd:MD_DimensionNameTypeCode></gmd:dimensionName>
<gmd:dimensionSize><gco:Integer>10</gco:Integer></gmd:dimensionSize><gmd:resolution><gco:Measure uom="Metres">4</gco:Measure></gmd:resolution></gmd:MD_Dimension></gmd:axisDimensionProperties>
<gmd:axisDimensionProperties><gmd:MD_Dimension><gmd:dimensionName><gmd:MD_DimensionNameTypeCode codeListValue="column"/></gmd:dimensionName>
<gmd:dimensionSize><gco:Integer>20</gco:Integer></gmd:dimensionSize><gmd:resolution><gco:Measure uom="Metres">2.5</gco:Measure></gmd:resolution></gmd:MD_Dimension></gmd:axisDimensionProperties>
<gmd:cornerPoints><gml:Point><gml:coordinates>687910.0,5554620.0 687957.5,5554656.0</gml:coordinates></gml:Point></gmd:cornerPoints>
</gmd:MD_Georectified></gmd:spatialRepresentationInfo>
<gmd:referenceSystemInfo><gmd:MD_ReferenceSystem><gmd:code><gco:CharacterString>PROJCS["UTM-19N-Nad83",GEOGCS["unnamed"],UNIT["metre",1.0]]</gco:CharacterString></gmd:code></gmd:MD_ReferenceSystem></gmd:referenceSystemInfo>
</gmi:MI_Metadata>"#;

    #[test]
    fn both_schemas_of_the_metadata_are_read() {
        let metadata = Metadata::parse(ISO).unwrap();
        assert_eq!((metadata.rows.size, metadata.rows.step), (Some(10), 4.0));
        assert_eq!((metadata.cols.size, metadata.cols.step), (Some(20), 2.5));
        assert_eq!(
            metadata.corners,
            [687_910.0, 5_554_620.0, 687_957.5, 5_554_656.0]
        );
        assert_eq!(
            metadata.crs,
            Some(Crs::Projected("UTM-19N-Nad83".to_owned()))
        );
    }

    #[test]
    fn metadata_without_a_position_are_rejected_by_the_missing_element() {
        let message = |text: &str| Metadata::parse(text).map(|_| ()).unwrap_err().to_string();
        assert_eq!(
            message(&ISO.replace("cornerPoints", "corner")),
            "/BAG_root/metadata: `cornerPoints`: is missing: the position of the grid depends on it"
        );
        assert_eq!(
            message(&ISO.replace(">4<", ">-4<")),
            "/BAG_root/metadata: `resolution of the rows`: is missing: the position of the grid depends on it"
        );
        assert_eq!(
            message(&ISO.replace("687957.5,5554656.0", "1")),
            "/BAG_root/metadata: `687910.0,5554620.0 1`: must be the coordinates of two corners"
        );
        assert!(message("<a>").starts_with("/BAG_root/metadata: damaged or cut short"));
    }
}

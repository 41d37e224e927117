//! A surveyed seabed: georeferencing of a file, and its surface in local metres about a stated origin.
//!
//! - Projected and local grids are used as they are. Geographic grids are resampled (bilinear) to metres of the tangent plane at their middle, with the file's cell size there. Soundings are converted to metres, triangulated, and sampled at the cells of a grid.
//! - The origin is the middle of the area covered.
//! - Lengths in other units are converted to metres; all coordinates below are metres or degrees.
//! - Properties that the file does not state are guessed. Coordinates are degrees if they fit longitudes and latitudes and the heights vary more than the coordinates; as metres, the whole survey would be steeper than 45 degrees. Otherwise they are metres. If 19 in 20 numbers are negative they are elevations, if positive they are depths.

use std::io::Read;
use std::path::Path;

use glam::DVec3;

use super::format_error::refuse;
use super::text::{self, MAX_HORIZONTAL_M};
use super::triangulate::{Tin, merge_duplicates};
use super::units;
use super::{
    Crs, Facts, Files, FormatError, HeightField, MAX_POINTS, READERS, Raw, RawGrid, RawPoints,
    RawShape, Reader, mesh,
};
use crate::SceneError;
use echotank_config::spec::{CrsSpec, FirstRow, HeightSign, SeabedFileSpec};
use echotank_core::geodesy::LocalTangentPlane;

/// Bytes at the beginning of a file that identify its format.
const HEAD_BYTES: usize = 512;
/// Share of heights on one side of zero that determines the sign convention.
const ONE_SIDED: f64 = 0.95;
/// Accepted cell sizes in metres. The lower end also rejects most grids in degrees that are taken as metres.
const CELL_SIZES_M: std::ops::RangeInclusive<f64> = 0.01..=1e5;
/// Largest cell of a grid in degrees, some 50 km; larger ones are no seabed for a sonar.
const MAX_CELL_DEG: f64 = 0.5;
/// Tolerance at the outer centres of a grid in degrees, cells.
const EDGE_CELLS: f64 = 0.05;
/// Tolerance of the bounding box in the metadata, degrees.
const COVER_TOLERANCE_DEG: f64 = 0.02;

/// Physical quantity of a file's values.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Quantity {
    Heights,
    Other,
}

/// Origin of a property of the file.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Source {
    /// Stated by the file or its format; the text says how.
    Stated(&'static str),
    /// Guessed from the numbers; the text gives the reason.
    Guessed(&'static str),
    /// Stated by the configuration.
    Configured,
}

impl std::fmt::Display for Source {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::Stated(why) => write!(f, "stated: {why}"),
            Self::Guessed(why) => write!(f, "guessed: {why}"),
            Self::Configured => f.write_str("configured"),
        }
    }
}

/// Layout of the heights in the file.
#[derive(Clone, Debug, PartialEq)]
pub enum Layout {
    /// A regular grid; steps are in the file's units (metres or degrees).
    Grid {
        /// Number of rows.
        rows: usize,
        /// Number of columns.
        cols: usize,
        /// Eastward step.
        x_step: f64,
        /// Northward step.
        y_step: f64,
        /// First row in the file.
        first_row: FirstRow,
        /// Origin of `first_row`.
        first_row_source: Source,
        /// The file gives the corners of its cells, not their centres.
        from_corners: bool,
    },
    /// Soundings or vertices.
    Points {
        /// Number of points after merging.
        count: usize,
        /// Number of soundings merged with others at the same position.
        merged: u64,
        /// Number of triangles.
        triangles: usize,
        /// The triangles come from the file.
        own_triangles: bool,
    },
}

/// A georeferenced seabed file.
pub struct Survey {
    /// Name of the format.
    pub format: &'static str,
    /// Size of the file, bytes.
    pub bytes: u64,
    /// Coordinate system.
    pub crs: Crs,
    /// Origin of `crs`.
    pub crs_source: Source,
    /// Sign convention of the heights.
    pub sign: HeightSign,
    /// Origin of `sign`.
    pub sign_source: Source,
    /// Layout of the heights in the file.
    pub layout: Layout,
    /// Local origin in the file's coordinates (x east, y north).
    pub zero: [f64; 2],
    /// Area covered, in the file's coordinates: west, south, east, north of the outer cell centres.
    pub covers: [f64; 4],
    /// What the file does not state and the reader assumed, one sentence each.
    pub guesses: Vec<String>,
    /// Further findings, one sentence each.
    pub notes: Vec<String>,
    /// Depths in metres about the origin.
    pub field: HeightField,
    original: Original,
}

/// Source of [`Survey::at`], if it is not the field.
enum Original {
    Field,
    /// Depths in a grid of degrees.
    Degrees(RawGrid),
    Triangles(Tin),
}

/// The seabed at one position of the file.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Lookup {
    /// Northing from the origin, metres.
    pub north_m: f64,
    /// Easting from the origin, metres.
    pub east_m: f64,
    /// Row and column of the cell that contains the position, southern row first; none for soundings.
    pub cell: Option<(usize, usize)>,
    /// Depth of that cell, equal to the file's value to the bit; for soundings, the triangulated surface. None in a hole.
    pub down_m: Option<f64>,
    /// Depth interpolated between the cell centres (bilinear), or on the triangles.
    pub surface_down_m: Option<f64>,
}

/// Coordinate system of a file and the origin of its surface.
#[derive(Clone, Debug, PartialEq)]
pub struct Georeference {
    /// Coordinate system of the file.
    pub crs: Crs,
    /// Origin: x east, y north.
    pub zero: [f64; 2],
}

impl Georeference {
    /// Northing and easting of another georeference's origin from this one, metres.
    ///
    /// # Errors
    /// Rejects another coordinate system.
    pub fn locate(&self, other: &Self) -> Result<(f64, f64), FormatError> {
        if !self.crs.agrees(&other.crs) {
            let rule = format!(
                "must equal that of the seabed's file, {} (mosaic_crs overrides the file)",
                self.crs
            );
            return refuse("coordinate system", &other.crs, rule);
        }
        Ok(local_m(&self.crs, self.zero, other.zero[0], other.zero[1]))
    }
}

fn local_m(crs: &Crs, zero: [f64; 2], x: f64, y: f64) -> (f64, f64) {
    match crs {
        Crs::Geographic(_) => plane_at(zero).local_m(y.to_radians(), x.to_radians()),
        _ => (y - zero[1], x - zero[0]),
    }
}

impl Survey {
    /// Reads and georeferences a file.
    ///
    /// # Errors
    /// Returns the path with the error of the file system or the rule that the file breaks.
    pub fn open(files: &dyn Files, spec: &SeabedFileSpec) -> Result<Self, SceneError> {
        let bytes = text::read_file(files, &spec.path)?;
        let system = system_beside(files, &spec.path);
        Self::parse_as(bytes, spec, Quantity::Heights, system).map_err(|error| SceneError::Format {
            path: spec.path.clone(),
            error,
        })
    }

    /// Reads a layer over the seabed, such as a backscatter mosaic in dB. Its values take the place of depths, and nothing is guessed from them.
    pub(crate) fn open_layer(
        files: &dyn Files,
        path: &Path,
        crs: Option<CrsSpec>,
    ) -> Result<Self, SceneError> {
        let spec = SeabedFileSpec {
            values: Some(HeightSign::Depth),
            crs,
            ..SeabedFileSpec::of(path.to_owned())
        };
        let bytes = text::read_file(files, path)?;
        let system = system_beside(files, path);
        Self::parse_as(bytes, &spec, Quantity::Other, system).map_err(|error| SceneError::Format {
            path: path.to_owned(),
            error,
        })
    }

    /// Reads the bytes of a file. Only the extension of `spec.path` is used.
    ///
    /// # Errors
    /// Returns the location, the value and the rule it breaks.
    pub fn parse(bytes: Vec<u8>, spec: &SeabedFileSpec) -> Result<Self, FormatError> {
        Self::parse_as(bytes, spec, Quantity::Heights, None)
    }

    fn parse_as(
        bytes: Vec<u8>,
        spec: &SeabedFileSpec,
        numbers: Quantity,
        beside: Option<String>,
    ) -> Result<Self, FormatError> {
        let reader = reader_of(&bytes, spec)?;
        let length = bytes.len() as u64;
        let Raw {
            mut shape,
            mut facts,
        } = (reader.read)(bytes, spec)?;
        let mut stated = "in the file";
        if facts.crs.is_none()
            && let Some(text) = beside
        {
            let (crs, units) = Crs::from_wkt(&text, "file .prj beside it")?;
            facts.crs = Some(crs).filter(|_| spec.crs.is_none());
            facts.units.horizontal_m = facts.units.horizontal_m.or(units.horizontal_m);
            facts.units.vertical_m = facts.units.vertical_m.or(units.vertical_m);
            stated = "in the file .prj beside it";
        }
        let (crs, crs_source) = system(&shape, &mut facts, spec, numbers, stated)?;
        in_metres(&mut shape, &mut facts, &crs, numbers);
        let (sign, sign_source) = sign(&shape, &facts, spec);
        let mut guesses = std::mem::take(&mut facts.guesses);
        if let Source::Guessed(why) = &crs_source {
            guesses.push(format!("coordinates are {crs}: {why}"));
        }
        if let Source::Guessed(why) = &sign_source
            && numbers == Quantity::Heights
        {
            let sign = match sign {
                HeightSign::Elevation => "elevations, positive up",
                HeightSign::Depth => "depths, positive down",
            };
            guesses.push(format!("heights are {sign}: {why}"));
        }
        let mut notes = std::mem::take(&mut facts.notes);
        let covers = covered(&shape)?;
        check_place(&crs, &covers)?;
        let zero = [(covers[0] + covers[2]) / 2.0, (covers[1] + covers[3]) / 2.0];
        if spec.crs.is_none()
            && let Some(box_deg) = facts.covers_deg
        {
            check_cover(&crs, zero, box_deg)?;
        }
        let plane = match &crs {
            Crs::Geographic(_) => Some(plane_at(zero)),
            _ => None,
        };
        let (field, layout, original) = match shape {
            RawShape::Grid(grid) => from_grid(grid, sign, plane.as_ref(), zero, spec, &mut notes)?,
            RawShape::Points(points) => from_points(points, sign, plane.as_ref(), zero, spec)?,
        };
        if field.down_m.iter().all(|d| d.is_nan()) {
            return refuse("heights", "", "are all holes");
        }
        let dry = field.down_m.iter().all(|d| d.is_nan() || *d <= 0.0);
        if dry && numbers == Quantity::Heights {
            notes.push("all heights lie above zero: values = \"depth\" may be required".to_owned());
        }
        Ok(Self {
            format: reader.name,
            bytes: length,
            crs,
            crs_source,
            sign,
            sign_source,
            layout,
            zero,
            covers,
            guesses,
            notes,
            field,
            original,
        })
    }

    /// Latitude and longitude of the local origin, radians; none without a known system.
    pub fn zero_geodetic_rad(&self) -> Option<(f64, f64)> {
        self.crs.geodetic_rad(self.zero[0], self.zero[1])
    }

    /// Northing and easting from the origin, metres, of a position in the file's coordinates.
    pub fn local_m(&self, x: f64, y: f64) -> (f64, f64) {
        local_m(&self.crs, self.zero, x, y)
    }

    pub(crate) fn georeference(&self) -> Georeference {
        Georeference {
            crs: self.crs.clone(),
            zero: self.zero,
        }
    }

    /// The seabed at a position in the file's coordinates.
    pub fn at(&self, x: f64, y: f64) -> Lookup {
        let (north_m, east_m) = self.local_m(x, y);
        let mut found = Lookup {
            north_m,
            east_m,
            cell: None,
            down_m: None,
            surface_down_m: None,
        };
        match &self.original {
            Original::Triangles(tin) => {
                found.down_m = tin.sample(north_m, east_m);
                found.surface_down_m = found.down_m;
            }
            Original::Field => {
                let field = &self.field;
                let row = (north_m - field.south_m) / field.cell_north_m;
                let col = (east_m - field.west_m) / field.cell_east_m;
                found.cell = nearest(row, col, field.rows, field.cols);
                found.down_m = found.cell.map(|(r, c)| field.cell_down_m(r, c));
                found.surface_down_m = field.sample(north_m, east_m).map(|d| d.down_m);
            }
            Original::Degrees(grid) => {
                let (row, col) = grid_place(grid, x, y);
                found.cell = nearest(row, col, grid.rows, grid.cols);
                found.down_m = found
                    .cell
                    .map(|(r, c)| f64::from(grid.values[r * grid.cols + c]));
                found.surface_down_m = bilinear(grid, row, col);
            }
        }
        found.down_m = found.down_m.filter(|d| !d.is_nan());
        found
    }
}

/// Largest `.prj` file, bytes.
const MAX_SYSTEM_BYTES: u64 = 1 << 16;

/// Text of the file with the extension `.prj` beside a seabed, if there is one: its coordinate system as well-known text.
fn system_beside(files: &dyn Files, path: &Path) -> Option<String> {
    let mut found = ["prj", "PRJ"].into_iter().filter_map(|extension| {
        let beside = path.with_extension(extension);
        let file = (beside != path)
            .then(|| files.open(&beside).ok())
            .flatten()?;
        let mut text = String::new();
        file.take(MAX_SYSTEM_BYTES).read_to_string(&mut text).ok()?;
        Some(text)
    });
    found.next()
}

/// Converts the coordinates and heights of a file to metres.
fn in_metres(shape: &mut RawShape, facts: &mut Facts, crs: &Crs, numbers: Quantity) {
    let horizontal_m = match crs {
        Crs::Geographic(_) => 1.0,
        _ => facts.units.horizontal_m.unwrap_or(1.0),
    };
    let vertical_m = match (numbers, facts.units.vertical_m) {
        (Quantity::Other, _) => 1.0,
        (Quantity::Heights, Some(vertical_m)) => vertical_m,
        (Quantity::Heights, None) => {
            if horizontal_m != 1.0 {
                facts.guesses.push(format!(
                    "heights are {}, like the coordinates: the file does not state their unit",
                    units::name(horizontal_m)
                ));
            }
            horizontal_m
        }
    };
    if (horizontal_m, vertical_m) == (1.0, 1.0) {
        return;
    }
    facts.notes.push(format!(
        "converted to metres: coordinates from {}, heights from {}",
        units::name(horizontal_m),
        units::name(vertical_m)
    ));
    match shape {
        RawShape::Grid(grid) => {
            for length in [
                &mut grid.x_west,
                &mut grid.y_south,
                &mut grid.x_step,
                &mut grid.y_step,
            ] {
                *length *= horizontal_m;
            }
            for value in &mut grid.values {
                *value = (f64::from(*value) * vertical_m) as f32;
            }
        }
        RawShape::Points(points) => {
            let metres = DVec3::new(horizontal_m, horizontal_m, vertical_m);
            for point in &mut points.points {
                *point *= metres;
            }
        }
    }
}

fn reader_of(bytes: &[u8], spec: &SeabedFileSpec) -> Result<&'static Reader, FormatError> {
    let head = &bytes[..bytes.len().min(HEAD_BYTES)];
    let extension = spec
        .path
        .extension()
        .and_then(|e| e.to_str())
        .unwrap_or("")
        .to_ascii_lowercase();
    let found = READERS.iter().find(|r| match spec.format {
        Some(format) => r.format == format,
        None => (r.recognises)(head, &extension),
    });
    if spec.format.is_none() && head.starts_with(b"CDF") {
        return refuse("file", "", "not supported: netCDF; convert it to GeoTIFF");
    }
    found.ok_or_else(|| {
        let names: Vec<&str> = READERS.iter().map(|r| r.name).collect();
        let rule = format!(
            "has no supported format ({}), by its first bytes or its extension",
            names.join(", ")
        );
        FormatError::new(
            "file",
            String::from_utf8_lossy(&head[..head.len().min(16)]),
            rule,
        )
    })
}

/// West, south, east and north of the outer points.
fn covered(shape: &RawShape) -> Result<[f64; 4], FormatError> {
    match shape {
        RawShape::Grid(g) => Ok([
            g.x_west,
            g.y_south,
            g.x_west + (g.cols - 1) as f64 * g.x_step,
            g.y_south + (g.rows - 1) as f64 * g.y_step,
        ]),
        RawShape::Points(p) => {
            if p.points.len() < 3 {
                let rule = "soundings: at least three are required";
                return refuse("file", p.points.len(), rule);
            }
            if p.points.len() > MAX_POINTS {
                let rule = format!("at most {MAX_POINTS} soundings are read");
                return refuse("file", p.points.len(), rule);
            }
            let start = DVec3::splat(f64::INFINITY);
            let low = p.points.iter().fold(start, |m, v| m.min(*v));
            let high = p.points.iter().fold(-start, |m, v| m.max(*v));
            for (k, v) in p.points.iter().enumerate() {
                if !v.is_finite() || v.z.abs() > text::MAX_VERTICAL_M {
                    let rule = format!(
                        "must be finite, and its height {} m at most",
                        text::MAX_VERTICAL_M
                    );
                    return refuse(format!("point {k}"), v, rule);
                }
            }
            Ok([low.x, low.y, high.x, high.y])
        }
    }
}

/// Least and greatest height, and the sign convention if 19 in 20 lie on one side of zero.
fn heights(shape: &RawShape) -> (f64, f64, Option<HeightSign>) {
    let (mut low, mut high) = (f64::INFINITY, f64::NEG_INFINITY);
    let (mut below, mut above, mut count) = (0_u64, 0_u64, 0_u64);
    let mut take = |v: f64| {
        if !v.is_nan() {
            (low, high) = (low.min(v), high.max(v));
            below += u64::from(v <= 0.0);
            above += u64::from(v >= 0.0);
            count += 1;
        }
    };
    match shape {
        RawShape::Grid(g) => g.values.iter().for_each(|v| take(f64::from(*v))),
        RawShape::Points(p) => p.points.iter().for_each(|v| take(v.z)),
    }
    let most = |n: u64| n as f64 >= ONE_SIDED * count as f64;
    let sign = match (most(below), most(above)) {
        (true, _) => Some(HeightSign::Elevation),
        (_, true) => Some(HeightSign::Depth),
        _ => None,
    };
    (low, high, sign)
}

fn system(
    shape: &RawShape,
    facts: &mut Facts,
    spec: &SeabedFileSpec,
    numbers: Quantity,
    stated: &'static str,
) -> Result<(Crs, Source), FormatError> {
    if let Some(crs) = spec.crs {
        return Ok((crs.into(), Source::Configured));
    }
    if let Some(crs) = facts.crs.take() {
        return Ok((crs, Source::Stated(stated)));
    }
    let [west, south, east, north] = covered(shape)?;
    let (low, high, _) = heights(shape);
    let fits = (-180.0..=360.0).contains(&west) && east <= 360.0 && south >= -90.0 && north <= 90.0;
    let fine = match shape {
        RawShape::Grid(g) => g.x_step.max(g.y_step) <= MAX_CELL_DEG,
        RawShape::Points(_) => true,
    };
    let steep = numbers == Quantity::Heights && high - low > (east - west).max(north - south);
    if fits && fine && steep {
        let why = "the coordinates fit longitudes and latitudes, and as metres the seabed would be impossibly steep";
        return Ok((
            Crs::Geographic("datum not stated".to_owned()),
            Source::Guessed(why),
        ));
    }
    let why = "the file states no system, and the numbers fit metres";
    Ok((Crs::Local, Source::Guessed(why)))
}

fn sign(shape: &RawShape, facts: &Facts, spec: &SeabedFileSpec) -> (HeightSign, Source) {
    if let Some(sign) = spec.values {
        return (sign, Source::Configured);
    }
    let (_, _, looks) = heights(shape);
    use HeightSign::{Depth, Elevation};
    let (sign, why) = match (facts.values, looks) {
        // A column named depth whose numbers are negative holds elevations.
        (Some((Depth, _)), Some(Elevation)) => (Elevation, "named depths, but negative"),
        (Some((sign, why)), _) => return (sign, Source::Stated(why)),
        (None, Some(Elevation)) => (Elevation, "most numbers are negative"),
        (None, Some(Depth)) => (Depth, "most numbers are positive"),
        (None, None) => (Elevation, "both signs occur, as over land and sea"),
    };
    (sign, Source::Guessed(why))
}

/// Rejects coordinates that are impossible in a system.
fn check_place(crs: &Crs, covers: &[f64; 4]) -> Result<(), FormatError> {
    let [west, south, east, north] = *covers;
    let shown = format!("{west} .. {east}, {south} .. {north}");
    let wrong = |rule: &str| refuse(format!("coordinates as {crs}"), &shown, rule);
    match crs {
        Crs::Geographic(_) => {
            if west < -180.0 || east > 360.0 || south < -90.0 || north > 90.0 {
                return wrong(
                    "are not longitudes (-180 to 360) and latitudes (-90 to 90): the coordinate system is wrong",
                );
            }
        }
        Crs::Utm { north: side, .. } => {
            // Eastings of a zone with a margin into its neighbours; northings to the pole.
            let northings = if *side { -1e6..=1e7 } else { 0.0..=1.1e7 };
            if west < -5e5
                || east > 1.5e6
                || !northings.contains(&south)
                || !northings.contains(&north)
            {
                return wrong(
                    "are not eastings and northings of a UTM zone: the coordinate system is wrong",
                );
            }
        }
        Crs::Local | Crs::Projected(_) => {}
    }
    Ok(())
}

/// Checks that the middle of the data lies in the area that the metadata state.
fn check_cover(crs: &Crs, zero: [f64; 2], box_deg: [f64; 4]) -> Result<(), FormatError> {
    let Some((lat, lon)) = crs.geodetic_rad(zero[0], zero[1]) else {
        return Ok(());
    };
    let (lat, lon) = (lat.to_degrees(), lon.to_degrees());
    let [west, south, east, north] = box_deg;
    let inside = |v: f64, low: f64, high: f64| {
        (low - COVER_TOLERANCE_DEG..=high + COVER_TOLERANCE_DEG).contains(&v)
    };
    // Longitudes may differ by a full turn.
    let turns = [-360.0, 0.0, 360.0];
    let fits = inside(lat, south, north) && turns.iter().any(|t| inside(lon + t, west, east));
    if fits {
        return Ok(());
    }
    let rule = format!(
        "puts its middle at latitude {lat:.3}, longitude {lon:.3}, outside the {south} .. {north}, {west} .. {east} of its metadata: one of them is wrong (seabed.crs overrides)"
    );
    refuse("coordinate system", crs, rule)
}

fn plane_at(zero: [f64; 2]) -> LocalTangentPlane {
    LocalTangentPlane::new(zero[1].to_radians(), zero[0].to_radians())
}

type Converted = (HeightField, Layout, Original);

fn check_extent(extent_m: f64) -> Result<(), FormatError> {
    if extent_m <= 2.0 * MAX_HORIZONTAL_M {
        return Ok(());
    }
    let rule = format!(
        "m are covered: a local plane is valid within {} km of its middle; crop the file",
        MAX_HORIZONTAL_M / 1e3
    );
    refuse("coordinates", extent_m, rule)
}

fn from_grid(
    mut grid: RawGrid,
    sign: HeightSign,
    plane: Option<&LocalTangentPlane>,
    zero: [f64; 2],
    spec: &SeabedFileSpec,
    notes: &mut Vec<String>,
) -> Result<Converted, FormatError> {
    if sign == HeightSign::Elevation {
        for v in &mut grid.values {
            *v = -*v;
        }
    }
    let layout = Layout::Grid {
        rows: grid.rows,
        cols: grid.cols,
        x_step: grid.x_step,
        y_step: grid.y_step,
        first_row: grid.first_row,
        first_row_source: match spec.first_row {
            Some(_) => Source::Configured,
            None => Source::Stated("by the format"),
        },
        from_corners: grid.from_corners,
    };
    let Some(plane) = plane else {
        for step in [grid.x_step, grid.y_step] {
            if !CELL_SIZES_M.contains(&step) {
                let rule = format!(
                    "must lie in {} ..= {} as metres; if the file is in degrees, say crs = \"geographic\"",
                    CELL_SIZES_M.start(),
                    CELL_SIZES_M.end()
                );
                return refuse("cell size", step, rule);
            }
        }
        let field = HeightField {
            rows: grid.rows,
            cols: grid.cols,
            cell_north_m: grid.y_step,
            cell_east_m: grid.x_step,
            south_m: grid.y_south - zero[1],
            west_m: grid.x_west - zero[0],
            down_m: grid.values,
        };
        check_extent(field.extent_north_m().max(field.extent_east_m()))?;
        return Ok((field, layout, Original::Field));
    };
    let field = resampled(&grid, plane, zero)?;
    notes.push(format!(
        "degrees resampled (bilinear) to cells of {:.3} m north, {:.3} m east",
        field.cell_north_m, field.cell_east_m
    ));
    Ok((field, layout, Original::Degrees(grid)))
}

/// Resamples a grid of degrees to the tangent plane at its middle.
fn resampled(
    grid: &RawGrid,
    plane: &LocalTangentPlane,
    zero: [f64; 2],
) -> Result<HeightField, FormatError> {
    let [x, y] = zero;
    let half_x = grid.x_step / 2.0;
    let half_y = grid.y_step / 2.0;
    let local = |x: f64, y: f64| plane.local_m(y.to_radians(), x.to_radians());
    let cell_north_m = local(x, y + half_y).0 - local(x, y - half_y).0;
    let cell_east_m = local(x + half_x, y).1 - local(x - half_x, y).1;
    if !(cell_north_m > 0.0 && cell_east_m > 0.0) {
        let rule = "cannot be resampled to a local plane at this latitude";
        return refuse(
            "cell size",
            format!("{} x {}", grid.x_step, grid.y_step),
            rule,
        );
    }
    let (rows, cols) = (grid.rows, grid.cols);
    let extents_m = [
        (rows - 1) as f64 * cell_north_m,
        (cols - 1) as f64 * cell_east_m,
    ];
    check_extent(extents_m[0].max(extents_m[1]))?;
    let (south_m, west_m) = (-extents_m[0] / 2.0, -extents_m[1] / 2.0);
    let mut down_m = Vec::with_capacity(rows * cols);
    for row in 0..rows {
        for col in 0..cols {
            let (lat, lon) = plane.geodetic_rad(
                south_m + row as f64 * cell_north_m,
                west_m + col as f64 * cell_east_m,
            );
            // The plane's longitudes and the file's may differ by a full turn.
            let lon = lon.to_degrees();
            let lon = lon + 360.0 * ((x - lon) / 360.0).round();
            let (r, c) = grid_place(grid, lon, lat.to_degrees());
            let (r, c) = (at_edge(r, grid.rows), at_edge(c, grid.cols));
            down_m.push(bilinear(grid, r, c).map_or(f32::NAN, |d| d as f32));
        }
    }
    Ok(HeightField {
        rows,
        cols,
        cell_north_m,
        cell_east_m,
        south_m,
        west_m,
        down_m,
    })
}

fn from_points(
    raw: RawPoints,
    sign: HeightSign,
    plane: Option<&LocalTangentPlane>,
    zero: [f64; 2],
    spec: &SeabedFileSpec,
) -> Result<Converted, FormatError> {
    let flip = match sign {
        HeightSign::Elevation => -1.0,
        HeightSign::Depth => 1.0,
    };
    let local = |p: &DVec3| {
        let (north_m, east_m) = match plane {
            Some(plane) => plane.local_m(p.y.to_radians(), p.x.to_radians()),
            None => (p.y - zero[1], p.x - zero[0]),
        };
        DVec3::new(north_m, east_m, flip * p.z)
    };
    let points: Vec<DVec3> = raw.points.iter().map(local).collect();
    drop(raw.points);
    if let Some(far) = points
        .iter()
        .find(|p| p.x.abs().max(p.y.abs()) > MAX_HORIZONTAL_M)
    {
        check_extent(2.0 * far.x.abs().max(far.y.abs()))?;
    }
    let own_triangles = raw.triangles.is_some();
    let (tin, merged) = match raw.triangles {
        Some(triangles) => {
            mesh::check_triangles(&triangles, points.len())?;
            let tin = Tin {
                points_m: points,
                triangles,
            };
            (tin.without_long_edges(spec.max_edge_m)?, 0)
        }
        None => {
            let (points, merged) = merge_duplicates(points);
            (Tin::new(points, spec.max_edge_m)?, merged)
        }
    };
    let field = tin.grid(spec.cell_m)?;
    let layout = Layout::Points {
        count: tin.points_m.len(),
        merged,
        triangles: tin.triangles.len(),
        own_triangles,
    };
    Ok((field, layout, Original::Triangles(tin)))
}

/// Row and column coordinates in cells from the south-western centre.
fn grid_place(grid: &RawGrid, x: f64, y: f64) -> (f64, f64) {
    (
        (y - grid.y_south) / grid.y_step,
        (x - grid.x_west) / grid.x_step,
    )
}

/// Moves a position slightly outside the outer centres onto them: meridians and parallels are curved on the plane.
fn at_edge(cells: f64, count: usize) -> f64 {
    let edge = cells.clamp(0.0, (count - 1) as f64);
    if (cells - edge).abs() <= EDGE_CELLS {
        edge
    } else {
        cells
    }
}

/// The cell that contains a position; none outside.
fn nearest(row: f64, col: f64, rows: usize, cols: usize) -> Option<(usize, usize)> {
    let inside = |v: f64, count: usize| (-0.5..=count as f64 - 0.5).contains(&v);
    (inside(row, rows) && inside(col, cols)).then(|| {
        let index = |v: f64, count: usize| (v.round().max(0.0) as usize).min(count - 1);
        (index(row, rows), index(col, cols))
    })
}

/// Bilinear interpolation between four centres; none outside and next to a hole.
fn bilinear(grid: &RawGrid, row: f64, col: f64) -> Option<f64> {
    let inside = |v: f64, count: usize| (0.0..=(count - 1) as f64).contains(&v);
    if !inside(row, grid.rows) || !inside(col, grid.cols) {
        return None;
    }
    let split = |v: f64, count: usize| {
        let index = (v as usize).min(count - 2);
        (index, v - index as f64)
    };
    let ((r, v), (c, u)) = (split(row, grid.rows), split(col, grid.cols));
    let cell = |r: usize, c: usize| f64::from(grid.values[r * grid.cols + c]);
    let south = cell(r, c) * (1.0 - u) + cell(r, c + 1) * u;
    let north = cell(r + 1, c) * (1.0 - u) + cell(r + 1, c + 1) * u;
    let down_m = south * (1.0 - v) + north * v;
    (!down_m.is_nan()).then_some(down_m)
}

//! Readers of seabeds and models: bytes to [`HeightField`]s and [`TriangleMesh`]es in local metres.
//!
//! ```text
//! bytes -> a Reader (one per format) -> Raw: the file's coordinates -> Survey: north, east, down in metres about a stated origin
//! ```
//!
//! Each format has one [`Reader`]. [`survey::Survey`] georeferences the result of all of them: coordinate system, sign of the heights, origin. Where
//! a file does not state a property, it is guessed from the numbers and reported as a guess. The configuration can override it.
//!
//! Bounds: a file of at most [`MAX_FILE_BYTES`](text::MAX_FILE_BYTES) is read into memory whole. It yields at most [`MAX_CELLS`] cells or
//! [`MAX_POINTS`] points. A header that announces more is rejected before memory is allocated.
//!
//! Not modelled: grid convergence, datum shifts, vertical datums (heights refer to the datum of the file).

mod bag;
mod crs;
mod esri_ascii;
mod files;
mod format_error;
mod geotiff;
mod las;
pub mod mesh;
mod ply;
pub mod relief;
mod shapes;
pub mod survey;
pub(crate) mod text;
mod triangulate;
mod units;
mod xyz;

pub use crs::Crs;
pub use files::Files;
pub use format_error::FormatError;
pub use shapes::{Depth, HeightField, TriangleMesh};
pub use survey::{Georeference, Survey};

use glam::DVec3;

use echotank_config::spec::{FirstRow, HeightSign, SeabedFileSpec, SeabedFormat};
use format_error::refuse;

/// Greatest number of cells: 256 MiB of f32.
pub(crate) const MAX_CELLS: usize = 1 << 26;
/// Greatest number of soundings or vertices: their triangulation takes some 250 bytes each.
pub(crate) const MAX_POINTS: usize = 1 << 22;

/// Reader of one format of seabed files.
pub(crate) struct Reader {
    pub(crate) format: SeabedFormat,
    pub(crate) name: &'static str,
    /// Whether a file with these first bytes, or with this extension in lower case, has this format.
    pub(crate) recognises: fn(&[u8], &str) -> bool,
    /// Reads a file in its own coordinates. Of the specification it uses `nodata`, `first_row` and `crs` only.
    pub(crate) read: fn(Vec<u8>, &SeabedFileSpec) -> Result<Raw, FormatError>,
}

/// All readers in the order in which they are tried: formats with a signature first, text last.
pub(crate) static READERS: [Reader; 6] = [
    geotiff::READER,
    bag::READER,
    las::READER,
    ply::READER,
    esri_ascii::READER,
    xyz::READER,
];

/// Result of a reader.
pub(crate) struct Raw {
    pub shape: RawShape,
    pub(crate) facts: Facts,
}

pub(crate) enum RawShape {
    Grid(RawGrid),
    Points(RawPoints),
}

/// A grid in the coordinates of its file.
pub(crate) struct RawGrid {
    pub rows: usize,
    pub cols: usize,
    /// Centre of the south-western cell.
    pub(crate) x_west: f64,
    pub(crate) y_south: f64,
    /// Cell size, positive.
    pub x_step: f64,
    pub y_step: f64,
    /// Values with the southern row first; NaN is a hole.
    pub values: Vec<f32>,
    /// First row in the file.
    pub first_row: FirstRow,
    /// The file gives corners of cells, so half a cell was added.
    pub from_corners: bool,
}

/// Soundings in the coordinates of their file: x, y and height or depth.
pub(crate) struct RawPoints {
    pub points: Vec<DVec3>,
    /// Triangles of the file, if it has any. Otherwise the points are triangulated.
    pub triangles: Option<Vec<[u32; 3]>>,
}

/// Metadata of a file.
#[derive(Default)]
pub(crate) struct Facts {
    pub crs: Option<Crs>,
    /// Sign convention of the heights, and the reason.
    pub values: Option<(HeightSign, &'static str)>,
    /// Units of length. Coordinates and heights are those of the file.
    pub(crate) units: units::Units,
    /// What the reader had to assume, one sentence each.
    pub(crate) guesses: Vec<String>,
    /// Further findings, one sentence each.
    pub notes: Vec<String>,
    /// Area that the metadata state, degrees: west, south, east, north.
    pub(crate) covers_deg: Option<[f64; 4]>,
}

/// Rejects a grid that is too small for a surface or too large for memory.
fn checked_size(rows: u64, cols: u64, place: &str) -> Result<(usize, usize), FormatError> {
    let size = format!("{rows} x {cols}");
    if rows < 2 || cols < 2 {
        return refuse(place, &size, "must have at least 2 rows and 2 columns");
    }
    let cells = rows.checked_mul(cols);
    if cells.is_none_or(|cells| cells > MAX_CELLS as u64) {
        let rule = format!("may have {MAX_CELLS} cells at most");
        return refuse(place, &size, rule);
    }
    Ok((rows as usize, cols as usize))
}

/// Reorders rows to southern row first, and replaces hole values by NaN. Rejects values that are neither a height nor a hole.
fn south_first(
    mut values: Vec<f32>,
    cols: usize,
    first_row: FirstRow,
    is_hole: impl Fn(f32) -> bool,
    place: &str,
) -> Result<Vec<f32>, FormatError> {
    for (k, value) in values.iter_mut().enumerate() {
        if value.is_nan() || is_hole(*value) {
            *value = f32::NAN;
        } else if f64::from(value.abs()) > text::MAX_VERTICAL_M {
            let (row, col) = (k / cols, k % cols);
            let rule = format!(
                "must be a height in metres, {} at most, or the value of a hole (nodata)",
                text::MAX_VERTICAL_M
            );
            return refuse(format!("{place}, row {row}, column {col}"), value, rule);
        }
    }
    if first_row == FirstRow::North {
        let rows = values.len() / cols;
        for row in 0..rows / 2 {
            let (south, north) = values.split_at_mut((rows - 1 - row) * cols);
            south[row * cols..(row + 1) * cols].swap_with_slice(&mut north[..cols]);
        }
    }
    Ok(values)
}

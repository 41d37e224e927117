//! Readers of seabeds and models: files in, [`HeightField`]s and [`TriangleMesh`]es in the scene's own metres out.
//!
//! ```text
//! bytes -> a Reader (one per format) -> Raw: the file's own coordinates -> Survey: north, east, down metres about a stated zero
//! ```
//!
//! Every format is read by one [`Reader`]; [`survey::Survey`] does for all of them alike what georeferencing needs: what the coordinates are, which
//! way heights are positive, where the zero lies. What the file does not say is taken from the look of its numbers, said so, and can be
//! laid down in the configuration.
//!
//! Bounds: a file of at most [`MAX_FILE_BYTES`](text::MAX_FILE_BYTES) is held in memory whole, and makes at most [`MAX_CELLS`] cells or
//! [`MAX_POINTS`] points; what promises more is refused before memory is taken for it.
//!
//! Not modelled: grid convergence, datum shifts, vertical datums (heights are counted from whatever the file counts them from).

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
mod xyz;

pub use crs::Crs;
pub use files::Files;
pub use format_error::FormatError;
pub use shapes::{Depth, HeightField, TriangleMesh};
pub use survey::{Georeference, Survey};

use glam::DVec3;

use echotank_config::spec::{FirstRow, HeightSign, SeabedFileSpec, SeabedFormat};

/// Cells at most: 256 MiB of f32.
pub(crate) const MAX_CELLS: usize = 1 << 26;
/// Soundings or vertices at most: their triangulation takes some 250 bytes each.
pub(crate) const MAX_POINTS: usize = 1 << 22;

/// One format of seabed files.
pub(crate) trait Reader: Sync {
    fn format(&self) -> SeabedFormat;
    fn name(&self) -> &'static str;
    /// Whether a file that begins so, or has this extension (small letters), is of this format.
    fn recognises(&self, head: &[u8], extension: &str) -> bool;
    /// The file in its own coordinates. Of `asked` only what changes the reading itself is looked at (`nodata`, `first_row`, `crs`).
    fn read(&self, bytes: Vec<u8>, asked: &SeabedFileSpec) -> Result<Raw, FormatError>;
}

/// In the order in which they are asked: those with a signature first, text last.
pub(crate) static READERS: [&dyn Reader; 6] = [
    &geotiff::GeoTiff,
    &bag::Bag,
    &las::Las,
    &ply::Ply,
    &esri_ascii::EsriAscii,
    &xyz::Xyz,
];

/// What a reader found.
pub(crate) struct Raw {
    pub shape: RawShape,
    pub(crate) facts: Facts,
}

pub(crate) enum RawShape {
    Grid(RawGrid),
    Points(RawPoints),
}

/// A grid in its file's own coordinates.
pub(crate) struct RawGrid {
    pub rows: usize,
    pub cols: usize,
    /// Centre of the south-western cell.
    pub(crate) x_west: f64,
    pub(crate) y_south: f64,
    /// Positive.
    pub x_step: f64,
    pub y_step: f64,
    /// The southern row first; NaN is a hole.
    pub values: Vec<f32>,
    /// Which row came first in the file.
    pub first_row: FirstRow,
    /// Half a cell was added to what the file gives, which are corners.
    pub from_corners: bool,
}

/// Soundings in their file's own coordinates: x, y and height or depth.
pub(crate) struct RawPoints {
    pub points: Vec<DVec3>,
    /// Where the file has them; otherwise they are made.
    pub triangles: Option<Vec<[u32; 3]>>,
}

/// What a file says about itself, besides its numbers.
#[derive(Default)]
pub(crate) struct Facts {
    pub crs: Option<Crs>,
    /// Which way its heights are positive, and why.
    pub values: Option<(HeightSign, &'static str)>,
    /// Anything else worth knowing, a sentence each.
    pub notes: Vec<String>,
    /// Longitude and latitude, degrees, that the file says it covers: west, south, east, north.
    pub(crate) covers_deg: Option<[f64; 4]>,
}

/// Refuses a grid that is too small to be a surface or too large to be held.
fn checked_size(rows: u64, cols: u64, place: &str) -> Result<(usize, usize), FormatError> {
    let size = format!("{rows} x {cols}");
    if rows < 2 || cols < 2 {
        return Err(FormatError::new(
            place,
            &size,
            "must have at least 2 rows and 2 columns",
        ));
    }
    let cells = rows.checked_mul(cols);
    if cells.is_none_or(|cells| cells > MAX_CELLS as u64) {
        let rule = format!("may have {MAX_CELLS} cells at most");
        return Err(FormatError::new(place, &size, rule));
    }
    Ok((rows as usize, cols as usize))
}

/// Values of rows that came northern row first, southern row first; numbers that stand for a hole become NaN. Refuses what is neither
/// height nor hole.
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
            return Err(FormatError::new(
                format!("{place}, row {row}, column {col}"),
                &value.to_string(),
                rule,
            ));
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

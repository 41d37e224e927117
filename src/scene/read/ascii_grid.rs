//! ESRI ASCII grids: text to [`Grid`].
//!
//! Header keys in any case and order: `ncols nrows xllcorner|xllcenter yllcorner|yllcenter cellsize [NODATA_value]`, then `nrows * ncols`
//! numbers, the northern row first, separated by any white space. Source: ESRI, ArcGIS documentation, "Esri ASCII raster format".
//! Metres only: a grid in degrees must be projected first.

use super::HeightField;
use super::text::{self, MAX_VERTICAL_M, Misread};

/// Cells at most: 512 MiB of f64.
pub const MAX_CELLS: usize = 1 << 26;

/// Cell sizes, metres. The lower end also refuses most grids in degrees.
const CELL_SIZES_M: std::ops::RangeInclusive<f64> = 0.01..=1e5;
/// Coordinates of the lower left corner, metres: any projection's numbers.
const CORNERS_M: std::ops::RangeInclusive<f64> = -1e9..=1e9;
/// Where the header names none (ESRI's own default).
const DEFAULT_NODATA: f64 = -9999.0;

/// Heights at the centres of square cells, with holes. Between the centres the surface is bilinear; it ends at the outer centres.
#[derive(Clone, Debug, PartialEq)]
pub struct Grid {
    /// At least 2.
    pub rows: usize,
    /// At least 2.
    pub cols: usize,
    pub cell_m: f64,
    /// Centre of the south-western cell in the file's own coordinates, metres.
    pub west_m: f64,
    pub south_m: f64,
    /// As in the file: the northern row first. NaN is a hole.
    heights_m: Vec<f64>,
}

/// The surface at one place.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Height {
    pub height_m: f64,
    /// d height / d north and d height / d east.
    pub slope_north: f64,
    pub slope_east: f64,
}

impl Grid {
    /// Height at a cell's centre, counted from the south-western cell; NaN is a hole.
    pub fn cell_height_m(&self, row_from_south: usize, col: usize) -> f64 {
        self.heights_m[(self.rows - 1 - row_from_south) * self.cols + col]
    }

    /// From the southern to the northern outer centres, metres.
    pub fn extent_north_m(&self) -> f64 {
        (self.rows - 1) as f64 * self.cell_m
    }
    /// From the western to the eastern outer centres, metres.
    pub fn extent_east_m(&self) -> f64 {
        (self.cols - 1) as f64 * self.cell_m
    }

    /// The surface `north_m` and `east_m` of the south-western cell's centre; none outside the outer centres and where any of the four
    /// cells around is a hole.
    pub fn sample(&self, north_m: f64, east_m: f64) -> Option<Height> {
        let inside = (0.0..=self.extent_north_m()).contains(&north_m)
            && (0.0..=self.extent_east_m()).contains(&east_m);
        if !inside {
            return None;
        }
        let (row, v) = split(north_m / self.cell_m, self.rows);
        let (col, u) = split(east_m / self.cell_m, self.cols);
        let sw = self.cell_height_m(row, col);
        let se = self.cell_height_m(row, col + 1);
        let nw = self.cell_height_m(row + 1, col);
        let ne = self.cell_height_m(row + 1, col + 1);
        let south = sw * (1.0 - u) + se * u;
        let north = nw * (1.0 - u) + ne * u;
        let height_m = south * (1.0 - v) + north * v;
        // One hole among the four makes the sum NaN, whatever its weight.
        (!height_m.is_nan()).then_some(Height {
            height_m,
            slope_north: (north - south) / self.cell_m,
            slope_east: ((se - sw) * (1.0 - v) + (ne - nw) * v) / self.cell_m,
        })
    }

    /// Elevations become depths, and depths elevations.
    pub fn negate(&mut self) {
        for h in &mut self.heights_m {
            *h = -*h;
        }
    }

    /// Reads the text of a grid file.
    pub fn parse(bytes: &[u8]) -> Result<Self, Misread> {
        let mut tokens = Tokens {
            rest: text::without_mark(bytes),
            line: 1,
        };
        let mut header = Header::default();
        while let Some(key) = tokens.peek()
            && is_key(key)
        {
            let (line, key) = (tokens.line, key.to_owned());
            tokens.next();
            let value = tokens
                .next()
                .ok_or_else(|| Misread::new(line, &key, "must be followed by its value"))?;
            header
                .set(&key, value)
                .map_err(|(wrong, rule)| Misread::new(tokens.line, &wrong, rule))?;
        }
        let Header {
            cols,
            rows,
            x,
            y,
            cell_m,
            nodata,
        } = header;
        let missing = |key: &str| Misread::new(tokens.line, key, "is missing in the header");
        let cols = cols.ok_or_else(|| missing("ncols"))?;
        let rows = rows.ok_or_else(|| missing("nrows"))?;
        let cell_m = cell_m.ok_or_else(|| missing("cellsize"))?;
        let west_m = x.ok_or_else(|| missing("xllcorner"))?.center_m(cell_m);
        let south_m = y.ok_or_else(|| missing("yllcorner"))?.center_m(cell_m);
        let cells = rows
            .checked_mul(cols)
            .filter(|cells| *cells <= MAX_CELLS)
            .ok_or_else(|| {
                let rule = format!("nrows times ncols may be {MAX_CELLS} at most");
                Misread::new(tokens.line, &format!("{rows} x {cols}"), rule)
            })?;
        let nodata = nodata.unwrap_or(DEFAULT_NODATA);
        // A number and its blank take two bytes: a header that promises more cells than the text can hold reserves nothing for them.
        let mut heights_m = Vec::with_capacity(cells.min(tokens.rest.len() / 2 + 1));
        while let Some(token) = tokens.next() {
            if heights_m.len() == cells {
                let rule = format!("is one number too many: {rows} x {cols} were announced");
                return Err(Misread::new(tokens.line, token, rule));
            }
            heights_m.push(
                height(token, nodata).map_err(|rule| Misread::new(tokens.line, token, rule))?,
            );
        }
        if heights_m.len() < cells {
            let rule = format!(
                "comes after {} numbers; {rows} x {cols} were announced",
                heights_m.len()
            );
            return Err(Misread::new(tokens.line, "end of file", rule));
        }
        Ok(Self {
            rows,
            cols,
            cell_m,
            west_m,
            south_m,
            heights_m,
        })
    }
}

/// Cell index and fraction of a coordinate in cells; the last centre belongs to the last interval.
fn split(cells: f64, count: usize) -> (usize, f64) {
    let index = (cells as usize).min(count - 2);
    (index, cells - index as f64)
}

/// A height, NaN for a hole, or the rule that the text breaks.
fn height(token: &str, nodata: f64) -> Result<f64, String> {
    let value: f64 = token.parse().map_err(|_| "must be a number".to_owned())?;
    if value == nodata || (value.is_nan() && nodata.is_nan()) {
        return Ok(f64::NAN);
    }
    if value.abs() <= MAX_VERTICAL_M {
        return Ok(value);
    }
    Err(format!(
        "must be a height in metres, {MAX_VERTICAL_M} at most, or the hole value {nodata}"
    ))
}

/// Numbers begin with a digit, a sign or a point, apart from NaN and infinity.
fn is_key(token: &str) -> bool {
    token.starts_with(|c: char| c.is_ascii_alphabetic()) && token.parse::<f64>().is_err()
}

#[derive(Clone, Copy)]
enum Corner {
    Corner(f64),
    Center(f64),
}

impl Corner {
    fn center_m(self, cell_m: f64) -> f64 {
        match self {
            Corner::Corner(m) => m + cell_m / 2.0,
            Corner::Center(m) => m,
        }
    }
}

#[derive(Default)]
struct Header {
    cols: Option<usize>,
    rows: Option<usize>,
    x: Option<Corner>,
    y: Option<Corner>,
    cell_m: Option<f64>,
    nodata: Option<f64>,
}

impl Header {
    /// Takes one key; otherwise the text that is wrong and the rule it breaks.
    fn set(&mut self, key: &str, value: &str) -> Result<(), (String, String)> {
        let wrong = |rule: String| (value.to_owned(), format!("{key} {rule}"));
        let count = || match value.parse() {
            Ok(n) if n >= 2 => Ok(n),
            _ => Err(wrong("must be a whole number of at least 2".into())),
        };
        let metres = |allowed| text::number(value, allowed).map_err(wrong);
        let known = match key.to_ascii_lowercase().as_str() {
            "ncols" => self.cols.replace(count()?).is_none(),
            "nrows" => self.rows.replace(count()?).is_none(),
            "cellsize" => self.cell_m.replace(metres(CELL_SIZES_M)?).is_none(),
            "xllcorner" => self.x.replace(Corner::Corner(metres(CORNERS_M)?)).is_none(),
            "yllcorner" => self.y.replace(Corner::Corner(metres(CORNERS_M)?)).is_none(),
            "xllcenter" => self.x.replace(Corner::Center(metres(CORNERS_M)?)).is_none(),
            "yllcenter" => self.y.replace(Corner::Center(metres(CORNERS_M)?)).is_none(),
            "nodata_value" => {
                let nodata = value
                    .parse()
                    .map_err(|_| wrong("must be a number".into()))?;
                self.nodata.replace(nodata).is_none()
            }
            _ => {
                let rule = "is no key of an ESRI ASCII grid (ncols, nrows, xllcorner or xllcenter, yllcorner or yllcenter, cellsize, NODATA_value)";
                return Err((key.to_owned(), rule.to_owned()));
            }
        };
        match known {
            true => Ok(()),
            false => Err((key.to_owned(), "must be there once".to_owned())),
        }
    }
}

/// Words separated by white space, with the line of the last one handed out.
struct Tokens<'a> {
    rest: &'a [u8],
    line: usize,
}

impl<'a> Tokens<'a> {
    /// The next word, without going past it. Bytes that are not UTF-8 come as a word that is neither number nor key.
    fn peek(&mut self) -> Option<&'a str> {
        while let [first, rest @ ..] = self.rest
            && first.is_ascii_whitespace()
        {
            self.line += usize::from(*first == b'\n');
            self.rest = rest;
        }
        let end = self
            .rest
            .iter()
            .position(u8::is_ascii_whitespace)
            .unwrap_or(self.rest.len());
        let word = &self.rest[..end];
        (end > 0).then(|| std::str::from_utf8(word).unwrap_or("\u{fffd}"))
    }

    fn next(&mut self) -> Option<&'a str> {
        let word = self.peek()?;
        let end = self
            .rest
            .iter()
            .position(u8::is_ascii_whitespace)
            .unwrap_or(self.rest.len());
        self.rest = &self.rest[end..];
        Some(word)
    }
}

impl From<Grid> for HeightField {
    /// The field's zero is the grid's centre. The grid's values are taken for depths.
    fn from(grid: Grid) -> Self {
        let mut down_m = Vec::with_capacity(grid.heights_m.len());
        for row in grid.heights_m.chunks_exact(grid.cols).rev() {
            down_m.extend(row.iter().map(|h| *h as f32));
        }
        Self {
            rows: grid.rows,
            cols: grid.cols,
            cell_north_m: grid.cell_m,
            cell_east_m: grid.cell_m,
            south_m: -grid.extent_north_m() / 2.0,
            west_m: -grid.extent_east_m() / 2.0,
            down_m,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const HEAD: &str = "ncols 3\nnrows 2\nxllcorner 100\nyllcorner 200\ncellsize 10\n";

    fn said(text: &str) -> String {
        Grid::parse(text.as_bytes()).unwrap_err().to_string()
    }

    #[test]
    fn the_first_row_is_north_and_corner_and_centre_forms_lie_half_a_cell_apart() {
        let corner = Grid::parse(format!("{HEAD}1 2 3\n4 5 6\n").as_bytes()).unwrap();
        assert_eq!((corner.west_m, corner.south_m), (105.0, 205.0));
        assert_eq!(corner.cell_height_m(0, 0), 4.0, "south-west");
        assert_eq!(corner.cell_height_m(1, 2), 3.0, "north-east");
        assert_eq!(
            (corner.extent_north_m(), corner.extent_east_m()),
            (10.0, 20.0)
        );
        let center = "NROWS 2\r\nNCOLS 3\r\nCELLSIZE 10\r\nXLLCENTER 105\r\nyllCenter 205\r\n1 2\r\n3 4 5\r\n\r\n 6";
        assert_eq!(
            Grid::parse(center.as_bytes()).unwrap(),
            corner,
            "any order, case and line breaks"
        );
    }

    #[test]
    fn heights_are_bilinear_between_centres_and_slopes_are_their_derivatives() {
        let grid = Grid::parse(format!("{HEAD}1 2 7\n4 8 6\n").as_bytes()).unwrap();
        assert_eq!(grid.sample(0.0, 0.0).unwrap().height_m, 4.0);
        assert_eq!(
            grid.sample(10.0, 20.0).unwrap().height_m,
            7.0,
            "the last corner is inside"
        );
        // By hand at v = 0.3, u = 0.5 of the western cells: 4 .7 .5 + 8 .7 .5 + 1 .3 .5 + 2 .3 .5.
        let at = grid.sample(3.0, 5.0).unwrap();
        assert!((at.height_m - 4.65).abs() < 1e-14, "{at:?}");
        assert!((at.slope_north - (1.5 - 6.0) / 10.0).abs() < 1e-14);
        assert!((at.slope_east - (0.7 * 4.0 + 0.3 * 1.0) / 10.0).abs() < 1e-14);
        for (north, east) in [(-1e-9, 0.0), (0.0, 20.1), (10.1, 5.0), (f64::NAN, 1.0)] {
            assert_eq!(grid.sample(north, east), None, "{north} {east}");
        }
    }

    #[test]
    fn a_hole_takes_away_the_four_squares_about_it_and_no_more() {
        let text = "ncols 4\nnrows 3\nxllcorner 0\nyllcorner 0\ncellsize 1\nNODATA_value -1\n1 1 1 1\n1 -1 1 1\n1 1 1 1";
        let grid = Grid::parse(text.as_bytes()).unwrap();
        assert_eq!(grid.sample(0.5, 0.5), None);
        assert_eq!(grid.sample(1.9, 1.9), None);
        assert_eq!(grid.sample(0.5, 2.5).unwrap().height_m, 1.0);
        for hole in ["-9999", "nan"] {
            let named = text.replace("-1", hole);
            assert_eq!(
                Grid::parse(named.as_bytes()).unwrap().sample(0.5, 0.5),
                None,
                "{hole}"
            );
        }
    }

    #[test]
    fn every_fault_names_its_line_its_value_and_the_rule() {
        for (text, want) in [
            (
                format!("{HEAD}1 2 3\n4 5,5 6\n"),
                "line 7: `5,5`: must be a number",
            ),
            (
                format!("{HEAD}1 2 3\n4 5\n"),
                "line 8: `end of file`: comes after 5 numbers; 2 x 3 were announced",
            ),
            (
                format!("{HEAD}1 2 3\n4 5 6\n7\n"),
                "line 8: `7`: is one number too many: 2 x 3 were announced",
            ),
            (
                format!("{HEAD}1 2 3\n4 1e6 6\n"),
                "line 7: `1e6`: must be a height in metres, 20000 at most, or the hole value -9999",
            ),
            (
                format!("{HEAD}1 2 3\n4 nan 6\n"),
                "line 7: `nan`: must be a height in metres, 20000 at most, or the hole value -9999",
            ),
            (
                "ncols 3\nnrows 1\n".into(),
                "line 2: `1`: nrows must be a whole number of at least 2",
            ),
            (
                "ncols 3\nncols 3\n".into(),
                "line 2: `ncols`: must be there once",
            ),
            (
                "ncols\n".into(),
                "line 1: `ncols`: must be followed by its value",
            ),
            (
                "ncols 3\nnrows 2\n1 2 3\n".into(),
                "line 3: `cellsize`: is missing in the header",
            ),
            (
                "cellsize 0.008333\n".into(),
                "line 1: `0.008333`: cellsize must lie in 0.01 ..= 100000",
            ),
            (
                "dx 3\n".into(),
                "line 1: `dx`: is no key of an ESRI ASCII grid (ncols, nrows, xllcorner or xllcenter, yllcorner or yllcenter, cellsize, NODATA_value)",
            ),
            (
                HEAD.replace("ncols 3", "ncols 99999999"),
                "line 6: `2 x 99999999`: nrows times ncols may be 67108864 at most",
            ),
            ("".into(), "line 1: `ncols`: is missing in the header"),
        ] {
            assert_eq!(said(&text), want);
        }
    }

    proptest::proptest! {
        #[test]
        fn any_bytes_give_a_grid_or_a_misread(bytes in proptest::collection::vec(proptest::num::u8::ANY, 0..300)) {
            let _ = Grid::parse(&bytes);
        }

        #[test]
        fn a_grid_with_any_damage_gives_a_grid_or_a_misread(
            place in 0usize..80, cut in 0usize..80, damage in "[-+0-9.eE a-z\n\u{fffd}]{0,12}",
        ) {
            let mut text = format!("{HEAD}NODATA_value -9999\n1 2 -9999\n4.5 5e0 6\n").into_bytes();
            let place = place.min(text.len());
            let end = (place + cut).min(text.len());
            text.splice(place..end, damage.bytes());
            if let Ok(grid) = Grid::parse(&text) {
                let _ = grid.sample(grid.extent_north_m() / 2.0, grid.extent_east_m());
            }
        }
    }
}

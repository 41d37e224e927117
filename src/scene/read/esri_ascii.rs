//! ESRI ASCII grids: text to [`RawGrid`].
//!
//! Header keys in any case and order: `ncols nrows xllcorner|xllcenter yllcorner|yllcenter cellsize [NODATA_value]`, or GDAL's `dx` and `dy` instead
//! of `cellsize`. Then follow `nrows * ncols` numbers, northern row first, separated by white space. Source: ESRI, ArcGIS documentation, "Esri ASCII
//! raster format". The format does not state its coordinate system.

use super::text::{self, TextError};
use super::{Facts, FormatError, Raw, RawGrid, RawShape, Reader, checked_size, south_first};
use echotank_config::spec::{FirstRow, SeabedFileSpec, SeabedFormat};

/// Accepted cell sizes, metres or degrees.
const CELL_SIZES: std::ops::RangeInclusive<f64> = 1e-7..=1e5;
/// Accepted coordinates of the lower left corner, in any projection.
const CORNERS: std::ops::RangeInclusive<f64> = -1e9..=1e9;
/// Hole value if the header states none (ESRI's default).
const DEFAULT_NODATA: f64 = -9999.0;

pub(super) const READER: Reader = Reader {
    format: SeabedFormat::EsriAscii,
    name: "ESRI ASCII grid",
    recognises,
    read,
};

fn recognises(head: &[u8], _extension: &str) -> bool {
    let mut tokens = Tokens {
        rest: text::without_mark(head),
        line: 1,
    };
    const KEYS: [&str; 9] = [
        "ncols",
        "nrows",
        "xllcorner",
        "xllcenter",
        "yllcorner",
        "yllcenter",
        "cellsize",
        "dx",
        "nodata_value",
    ];
    tokens
        .peek()
        .is_some_and(|word| KEYS.contains(&word.to_ascii_lowercase().as_str()))
}

fn read(bytes: Vec<u8>, spec: &SeabedFileSpec) -> Result<Raw, FormatError> {
    Ok(Raw {
        shape: RawShape::Grid(parse(&bytes, spec)?),
        facts: Facts::default(),
    })
}

fn parse(bytes: &[u8], spec: &SeabedFileSpec) -> Result<RawGrid, FormatError> {
    let mut tokens = Tokens {
        rest: text::without_mark(bytes),
        line: 1,
    };
    let header = Header::read(&mut tokens)?;
    let missing = |key: &str| TextError::new(tokens.line, key, "is missing in the header");
    let cols = header.cols.ok_or_else(|| missing("ncols"))?;
    let rows = header.rows.ok_or_else(|| missing("nrows"))?;
    let x_step = header.x_step.ok_or_else(|| missing("cellsize"))?;
    let y_step = header.y_step.ok_or_else(|| missing("dy"))?;
    let x = header.x.ok_or_else(|| missing("xllcorner"))?;
    let y = header.y.ok_or_else(|| missing("yllcorner"))?;
    let (rows, cols) = checked_size(rows as u64, cols as u64, "nrows x ncols")?;
    let cells = rows * cols;
    let nodata = header.nodata.unwrap_or(DEFAULT_NODATA);
    // A number and its separator take two bytes. A header that announces more cells than the text can hold reserves no memory for them.
    let mut values = Vec::with_capacity(cells.min(tokens.rest.len() / 2 + 1));
    while let Some(token) = tokens.next() {
        if values.len() == cells {
            let rule = format!("is one number too many; the header declares {rows} x {cols}");
            return Err(TextError::new(tokens.line, token, rule).into());
        }
        let value: f64 = token
            .parse()
            .map_err(|_| TextError::new(tokens.line, token, "must be a number"))?;
        let hole = value == nodata || spec.nodata == Some(value) || value.is_nan();
        if !hole && value.abs() > text::MAX_VERTICAL_M {
            let rule = format!(
                "must be a height in metres, {} at most, or the hole value {nodata}",
                text::MAX_VERTICAL_M
            );
            return Err(TextError::new(tokens.line, token, rule).into());
        }
        values.push(if hole { f32::NAN } else { value as f32 });
    }
    if values.len() < cells {
        let rule = format!(
            "reached after {} numbers; the header declares {rows} x {cols}",
            values.len()
        );
        return Err(TextError::new(tokens.line, "end of file", rule).into());
    }
    let first_row = spec.first_row.unwrap_or(FirstRow::North);
    Ok(RawGrid {
        rows,
        cols,
        x_west: x.center(x_step),
        y_south: y.center(y_step),
        x_step,
        y_step,
        values: south_first(values, cols, first_row, |_| false, "cells")?,
        first_row,
        from_corners: matches!(x, Corner::Corner(_)),
    })
}

/// Whether a token is a key: numbers begin with a digit, a sign or a point, except NaN and infinity.
fn is_key(token: &str) -> bool {
    token.starts_with(|c: char| c.is_ascii_alphabetic()) && token.parse::<f64>().is_err()
}

#[derive(Clone, Copy)]
enum Corner {
    Corner(f64),
    Center(f64),
}

impl Corner {
    fn center(self, step: f64) -> f64 {
        match self {
            Corner::Corner(at) => at + step / 2.0,
            Corner::Center(at) => at,
        }
    }
}

#[derive(Default)]
struct Header {
    cols: Option<usize>,
    rows: Option<usize>,
    x: Option<Corner>,
    y: Option<Corner>,
    x_step: Option<f64>,
    y_step: Option<f64>,
    nodata: Option<f64>,
}

impl Header {
    fn read(tokens: &mut Tokens) -> Result<Self, TextError> {
        let mut header = Self::default();
        while let Some(key) = tokens.peek()
            && is_key(key)
        {
            let (line, key) = (tokens.line, key.to_owned());
            tokens.next();
            let value = tokens
                .next()
                .ok_or_else(|| TextError::new(line, &key, "must be followed by its value"))?;
            header
                .set(&key, value)
                .map_err(|(wrong, rule)| TextError::new(tokens.line, &wrong, rule))?;
        }
        Ok(header)
    }

    /// Stores one key. The error is the wrong text and the rule it breaks.
    fn set(&mut self, key: &str, value: &str) -> Result<(), (String, String)> {
        let wrong = |rule: String| (value.to_owned(), format!("{key} {rule}"));
        let count = || match value.parse() {
            Ok(n) if n >= 2 => Ok(n),
            _ => Err(wrong("must be a whole number of at least 2".into())),
        };
        let number = |allowed| text::number(value, allowed).map_err(wrong);
        let new = match key.to_ascii_lowercase().as_str() {
            "ncols" => self.cols.replace(count()?).is_none(),
            "nrows" => self.rows.replace(count()?).is_none(),
            "cellsize" => {
                let step = number(CELL_SIZES)?;
                self.x_step.replace(step).is_none() & self.y_step.replace(step).is_none()
            }
            "dx" => self.x_step.replace(number(CELL_SIZES)?).is_none(),
            "dy" => self.y_step.replace(number(CELL_SIZES)?).is_none(),
            "xllcorner" => self.x.replace(Corner::Corner(number(CORNERS)?)).is_none(),
            "yllcorner" => self.y.replace(Corner::Corner(number(CORNERS)?)).is_none(),
            "xllcenter" => self.x.replace(Corner::Center(number(CORNERS)?)).is_none(),
            "yllcenter" => self.y.replace(Corner::Center(number(CORNERS)?)).is_none(),
            "nodata_value" => {
                let nodata = value
                    .parse()
                    .map_err(|_| wrong("must be a number".into()))?;
                self.nodata.replace(nodata).is_none()
            }
            _ => {
                let rule = "is not a key of an ESRI ASCII grid (ncols, nrows, xllcorner or xllcenter, yllcorner or yllcenter, cellsize or dx and dy, NODATA_value)";
                return Err((key.to_owned(), rule.to_owned()));
            }
        };
        match new {
            true => Ok(()),
            false => Err((key.to_owned(), "must be given once".to_owned())),
        }
    }
}

/// Tokens separated by white space, with the line of the last one.
struct Tokens<'a> {
    rest: &'a [u8],
    line: usize,
}

impl<'a> Tokens<'a> {
    /// The next token, without consuming it. Bytes that are not UTF-8 yield a token that is neither number nor key.
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

#[cfg(test)]
mod tests {
    use super::*;

    const HEAD: &str = "ncols 3\nnrows 2\nxllcorner 100\nyllcorner 200\ncellsize 10\n";

    fn spec() -> SeabedFileSpec {
        SeabedFileSpec::of("grid.asc".into())
    }

    fn grid(text: &str) -> RawGrid {
        parse(text.as_bytes(), &spec()).unwrap()
    }

    fn message(text: &str) -> String {
        match parse(text.as_bytes(), &spec()) {
            Ok(_) => "ok".to_owned(),
            Err(error) => error.to_string(),
        }
    }

    #[test]
    fn the_first_row_is_north_and_corner_and_centre_forms_lie_half_a_cell_apart() {
        let corner = grid(&format!("{HEAD}1 2 3\n4 5 6\n"));
        assert_eq!((corner.x_west, corner.y_south), (105.0, 205.0));
        assert_eq!(corner.values, [4.0, 5.0, 6.0, 1.0, 2.0, 3.0], "south first");
        let center = grid(
            "NROWS 2\r\nNCOLS 3\r\nCELLSIZE 10\r\nXLLCENTER 105\r\nyllCenter 205\r\n1 2\r\n3 4 5\r\n\r\n 6",
        );
        assert_eq!(
            (center.x_west, center.y_south, &center.values),
            (105.0, 205.0, &corner.values),
            "any order, case and line breaks"
        );
        let oblong =
            grid("ncols 3\nnrows 2\nxllcorner 100\nyllcorner 200\ndx 10\ndy 4\n1 2 3 4 5 6");
        assert_eq!((oblong.x_west, oblong.y_south), (105.0, 202.0));
        let upside_down = parse(
            format!("{HEAD}1 2 3\n4 5 6\n").as_bytes(),
            &SeabedFileSpec {
                first_row: Some(FirstRow::South),
                ..spec()
            },
        );
        assert_eq!(upside_down.unwrap().values, [1.0, 2.0, 3.0, 4.0, 5.0, 6.0]);
    }

    #[test]
    fn holes_are_what_the_header_or_the_configuration_names_and_nan() {
        let text =
            format!("{HEAD}1 -9999 3\nnan 5 7\n").replace("ncols 3", "ncols 3\nnodata_value 5");
        assert_eq!(
            message(&text),
            "ok",
            "-9999 is no hole where another is named, and a height that can be"
        );
        let values = grid(&text).values;
        assert!(values[0].is_nan() && values[1].is_nan() && values[4] == -9999.0);
        let spec = SeabedFileSpec {
            nodata: Some(7.0),
            ..spec()
        };
        assert!(parse(text.as_bytes(), &spec).unwrap().values[2].is_nan());
    }

    #[test]
    fn every_error_names_line_value_and_rule() {
        for (text, want) in [
            (
                format!("{HEAD}1 2 3\n4 5,5 6\n"),
                "line 7: `5,5`: must be a number",
            ),
            (
                format!("{HEAD}1 2 3\n4 5\n"),
                "line 8: `end of file`: reached after 5 numbers; the header declares 2 x 3",
            ),
            (
                format!("{HEAD}1 2 3\n4 5 6\n7\n"),
                "line 8: `7`: is one number too many; the header declares 2 x 3",
            ),
            (
                format!("{HEAD}1 2 3\n4 1e6 6\n"),
                "line 7: `1e6`: must be a height in metres, 20000 at most, or the hole value -9999",
            ),
            (
                "ncols 3\nnrows 1\n".into(),
                "line 2: `1`: nrows must be a whole number of at least 2",
            ),
            (
                "ncols 3\nncols 3\n".into(),
                "line 2: `ncols`: must be given once",
            ),
            (
                "dx 3\ncellsize 3\n".into(),
                "line 2: `cellsize`: must be given once",
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
                "cellsize 0\n".into(),
                "line 1: `0`: cellsize must lie in 0.0000001 ..= 100000",
            ),
            (
                "dz 3\n".into(),
                "line 1: `dz`: is not a key of an ESRI ASCII grid (ncols, nrows, xllcorner or xllcenter, yllcorner or yllcenter, cellsize or dx and dy, NODATA_value)",
            ),
            (
                HEAD.replace("ncols 3", "ncols 1000000")
                    .replace("nrows 2", "nrows 1000000"),
                "nrows x ncols: `1000000 x 1000000`: may have 67108864 cells at most",
            ),
        ] {
            assert_eq!(message(&text), want);
        }
    }

    proptest::proptest! {
        #[test]
        fn any_bytes_yield_a_grid_or_an_error(tail in proptest::collection::vec(proptest::num::u8::ANY, 0..200)) {
            let _ = parse(&tail, &spec());
            let mut bytes = HEAD.as_bytes().to_vec();
            bytes.extend(&tail);
            let _ = parse(&bytes, &spec());
        }
    }
}

//! Common parts of the text readers: bounded reading, tables with named columns, and errors with line and column.

use std::io::Read;
use std::ops::RangeInclusive;
use std::path::Path;

use super::Files;
use crate::SceneError;

/// Largest scene file, bytes. A file is held in memory whole while it is parsed.
pub const MAX_FILE_BYTES: u64 = 1 << 30;

/// Largest horizontal coordinate, metres: the range of validity of the tangent plane.
pub(crate) const MAX_HORIZONTAL_M: f64 = 1e6;
/// Largest depth or height, metres. The sea is 11 km deep.
pub(crate) const MAX_VERTICAL_M: f64 = 2e4;

/// Greatest number of characters of a value in an error.
const SHOWN_CHARACTERS: usize = 40;

/// Error in a line of a text file.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("line {line}{}: `{value}`: {rule}", column.as_ref().map(|c| format!(", column `{c}`")).unwrap_or_default())]
pub struct TextError {
    /// Line number, from 1.
    pub line: usize,
    /// Name of the table's column, if the error concerns one.
    pub column: Option<String>,
    /// The value, shortened.
    pub value: String,
    /// The rule that the value breaks.
    pub rule: String,
}

impl TextError {
    pub(crate) fn new(line: usize, value: &str, rule: impl Into<String>) -> Self {
        Self {
            line,
            column: None,
            value: value.chars().take(SHOWN_CHARACTERS).collect(),
            rule: rule.into(),
        }
    }
    pub(crate) fn in_column(mut self, column: &str) -> Self {
        self.column = Some(column.chars().take(SHOWN_CHARACTERS).collect());
        self
    }
}

/// Reads a file of at most [`MAX_FILE_BYTES`] into memory.
pub(crate) fn read_file(files: &dyn Files, path: &Path) -> Result<Vec<u8>, SceneError> {
    let unreadable = |source| SceneError::Read {
        path: path.to_owned(),
        source,
    };
    let file = files.open(path).map_err(unreadable)?;
    let mut bytes = Vec::new();
    // One byte above the limit shows that a file is too large, also where the file (a pipe) reports no length.
    file.take(MAX_FILE_BYTES + 1)
        .read_to_end(&mut bytes)
        .map_err(unreadable)?;
    if bytes.len() as u64 > MAX_FILE_BYTES {
        return Err(SceneError::TooLarge {
            path: path.to_owned(),
        });
    }
    Ok(bytes)
}

/// Removes a byte order mark, which spreadsheets write.
pub(crate) fn without_mark(bytes: &[u8]) -> &[u8] {
    bytes.strip_prefix(b"\xef\xbb\xbf").unwrap_or(bytes)
}

/// The text of a file, without its byte order mark.
pub(crate) fn utf8(bytes: &[u8]) -> Result<&str, TextError> {
    let bytes = without_mark(bytes);
    std::str::from_utf8(bytes).map_err(|e| {
        let before = &bytes[..e.valid_up_to()];
        let line = before.iter().filter(|b| **b == b'\n').count() + 1;
        TextError::new(line, "", "must be UTF-8 text")
    })
}

/// Parses a number in a range. The error is the rule that it breaks.
pub(crate) fn number(text: &str, allowed: RangeInclusive<f64>) -> Result<f64, String> {
    let value: f64 = text.parse().map_err(|_| "must be a number".to_owned())?;
    if allowed.contains(&value) {
        Ok(value)
    } else {
        Err(format!(
            "must lie in {} ..= {}",
            allowed.start(),
            allowed.end()
        ))
    }
}

/// Column of a table, found by its name in the header.
pub(crate) struct Column {
    pub name: &'static str,
    pub required: bool,
}

pub(crate) const fn required(name: &'static str) -> Column {
    Column {
        name,
        required: true,
    }
}
pub(crate) const fn optional(name: &'static str) -> Column {
    Column {
        name,
        required: false,
    }
}

/// One line of a table. Columns are numbered in the order of the `columns` given to [`read_table`].
pub(crate) struct Row<'a> {
    pub line: usize,
    columns: &'a [Column],
    places: &'a [Option<usize>],
    fields: &'a [&'a str],
}

impl Row<'_> {
    /// Text of a field, trimmed; none where an optional column is absent.
    pub(crate) fn text(&self, column: usize) -> Option<&str> {
        self.places[column].map(|place| self.fields[place])
    }
    /// Number in a field; `absent` where an optional column is absent.
    pub(crate) fn number(
        &self,
        column: usize,
        allowed: RangeInclusive<f64>,
        absent: f64,
    ) -> Result<f64, TextError> {
        match self.text(column) {
            None => Ok(absent),
            Some(text) => number(text, allowed).map_err(|rule| self.text_error(column, rule)),
        }
    }
    pub(crate) fn text_error(&self, column: usize, rule: impl Into<String>) -> TextError {
        TextError::new(self.line, self.text(column).unwrap_or(""), rule)
            .in_column(self.columns[column].name)
    }
}

/// Reads comma-separated text: a header of column names in any order, then rows. There is no quoting. Blank lines and lines that begin with `#` are
/// skipped. Calls `take` with each row.
pub(crate) fn read_table(
    bytes: &[u8],
    columns: &[Column],
    mut take: impl FnMut(&Row) -> Result<(), TextError>,
) -> Result<(), TextError> {
    let text = utf8(bytes)?;
    let mut header: Option<(usize, Vec<Option<usize>>)> = None;
    let mut fields: Vec<&str> = Vec::new();
    let mut lines = 0;
    for (index, content) in text.lines().enumerate() {
        let line = index + 1;
        lines = line;
        if content.trim().is_empty() || content.starts_with('#') {
            continue;
        }
        fields.clear();
        fields.extend(content.split(',').map(str::trim));
        let Some((width, places)) = &header else {
            header = Some((fields.len(), read_header(line, &fields, columns)?));
            continue;
        };
        if fields.len() != *width {
            let rule = format!(
                "must have {width} fields as the header has, not {}",
                fields.len()
            );
            return Err(TextError::new(line, content, rule));
        }
        take(&Row {
            line,
            columns,
            places,
            fields: &fields,
        })?;
    }
    if header.is_none() {
        let rule = format!("must begin with a header: {}", listed(columns));
        return Err(TextError::new(lines + 1, "", rule));
    }
    Ok(())
}

/// Position of every known column among the fields.
fn read_header(
    line: usize,
    fields: &[&str],
    columns: &[Column],
) -> Result<Vec<Option<usize>>, TextError> {
    let mut places = vec![None; columns.len()];
    for (place, field) in fields.iter().enumerate() {
        let Some(known) = columns.iter().position(|c| c.name == *field) else {
            let rule = format!(
                "is not a column of this table; the columns are {}",
                listed(columns)
            );
            return Err(TextError::new(line, field, rule));
        };
        if places[known].replace(place).is_some() {
            return Err(TextError::new(line, field, "must be given once"));
        }
    }
    for (column, place) in columns.iter().zip(&places) {
        if column.required && place.is_none() {
            let rule = format!("is missing; the header must name {}", listed(columns));
            return Err(TextError::new(line, column.name, rule));
        }
    }
    Ok(places)
}

fn listed(columns: &[Column]) -> String {
    let names: Vec<String> = columns
        .iter()
        .map(|c| match c.required {
            true => c.name.to_owned(),
            false => format!("[{}]", c.name),
        })
        .collect();
    names.join(",")
}

//! What a declared key consists of: its kind, unit, range and default.

/// A TOML table.
pub(crate) struct Table {
    pub doc: &'static str,
    pub keys: &'static [Key],
    /// Names that the design knows and this version does not build: refused with those words.
    pub later: &'static [&'static str],
}

/// One key of a table.
pub(crate) struct Key {
    pub name: &'static str,
    pub kind: Kind,
    pub(crate) presence: Presence,
    pub(crate) with: Option<With>,
    pub doc: &'static str,
}

/// Longest list of names.
pub(crate) const MAX_NAMES: usize = 256;
/// Longest list of pairs of numbers.
pub(crate) const MAX_ROWS: usize = 10_000;

/// The values that a key takes.
pub(crate) enum Kind {
    Bool,
    /// A finite number, and its way to SI.
    Number(Range, Unit),
    /// A whole number, both ends included; then what it is multiplied by.
    Integer(i64, i64, i64),
    /// 1 to 32 letters, digits, '-' or '_': fit for file names.
    Name,
    /// Text that is not empty.
    Text,
    /// The name of a file that must exist, relative to the configuration's folder.
    File,
    /// The name of a folder that is there or can be made, relative to the configuration's folder.
    Folder,
    /// One of the names; then the names that the design knows and this version does not build.
    Choice(&'static [&'static str], &'static [&'static str]),
    /// An array of this many numbers.
    Numbers(usize, Range, Unit),
    /// Pairs of numbers, at most [`MAX_ROWS`].
    Rows,
    /// At least one name, at most [`MAX_NAMES`].
    Names,
    /// At least one of the choices, at most [`MAX_NAMES`].
    Choices(&'static [&'static str]),
    Table(&'static Table),
    /// One or more tables, at most this many.
    Tables(&'static Table, usize),
    /// The first kind whose TOML type fits.
    Either(&'static Kind, &'static Kind),
}

/// How a number in the file becomes one in SI units.
#[derive(Clone, Copy)]
pub(crate) enum Unit {
    /// Times ten to this power.
    Power(i32),
    Degrees,
}

/// Whether a key may be left out.
pub(crate) enum Presence {
    /// Must be there. With an example for the template (tables have none).
    Required(&'static str),
    /// May be left out: this TOML text then stands in its place.
    Default(&'static str),
    /// May be left out, and then does nothing. Commented out in the template.
    Optional(&'static str),
    /// As `Default`; the template has the second text in its place.
    Set(&'static str, &'static str),
    /// Whether it must be there depends on other keys; the template has it.
    Shown(&'static str),
}

/// Refuses a key unless a key of the same table is given, or has one of the values.
pub(crate) struct With {
    /// The key must then be there.
    pub(crate) needed: bool,
    pub(crate) key: &'static str,
    /// As TOML. None of them: any value.
    pub(crate) values: &'static [&'static str],
}

/// Numbers from `min` (itself only if `min_included`) to `max`.
#[derive(Clone, Copy)]
pub(crate) struct Range {
    pub min: f64,
    pub(crate) min_included: bool,
    pub max: f64,
}

pub(crate) const fn from(min: f64, max: f64) -> Range {
    Range {
        min,
        min_included: true,
        max,
    }
}

pub(crate) const fn above(min: f64, max: f64) -> Range {
    Range {
        min,
        min_included: false,
        max,
    }
}

//! Declaration of a key: kind, unit, range and default.

/// Declaration of a TOML table.
pub(crate) struct Table {
    pub doc: &'static str,
    pub keys: &'static [Key],
    /// Names of planned keys. They are refused with a message that the version does not support them.
    pub later: &'static [&'static str],
}

/// Declaration of one key of a table.
pub(crate) struct Key {
    pub name: &'static str,
    pub kind: Kind,
    pub(crate) presence: Presence,
    pub(crate) with: Option<KeyCondition>,
    pub doc: &'static str,
}

/// Maximum length of a list of names.
pub(crate) const MAX_NAMES: usize = 256;
/// Maximum length of a list of pairs of numbers.
pub(crate) const MAX_ROWS: usize = 10_000;

/// Kind of the values of a key.
pub(crate) enum Kind {
    Bool,
    /// A finite number, and its conversion to SI.
    Number(Range, Unit),
    /// A whole number: minimum, maximum (both inclusive) and factor.
    Integer(i64, i64, i64),
    /// 1 to 32 letters, digits, '-' or '_', valid in file names.
    Name,
    /// Non-empty text.
    Text,
    /// Name of an existing file, relative to the folder of the configuration.
    File,
    /// Name of a folder that exists or can be created, relative to the folder of the configuration.
    Folder,
    /// One of the first names. The second list has planned names, which are refused with a message.
    Choice(&'static [&'static str], &'static [&'static str]),
    /// Array of this many numbers.
    Numbers(usize, Range, Unit),
    /// Pairs of numbers, at most [`MAX_ROWS`], and the names of the two columns.
    Rows(&'static str),
    /// One to [`MAX_NAMES`] names.
    Names,
    /// One to [`MAX_NAMES`] of the choices.
    Choices(&'static [&'static str]),
    Table(&'static Table),
    /// One or more tables; the number is the maximum.
    Tables(&'static Table, usize),
    /// The first of two kinds with a matching TOML type.
    Either(&'static Kind, &'static Kind),
}

/// Conversion of a number in the file to SI units.
#[derive(Clone, Copy)]
pub(crate) enum Unit {
    /// Multiplication by ten to this power.
    Power(i32),
    Degrees,
}

/// Whether a key may be absent.
pub(crate) enum Presence {
    /// The key is required. The text is an example for the template (tables have none).
    Required(&'static str),
    /// The key is optional. The TOML text is the default.
    Default(&'static str),
    /// The key is optional and has no effect if absent. The template has it as a comment with this text.
    Optional(&'static str),
    /// As `Default`, but the template has the second text as the value.
    Set(&'static str, &'static str),
    /// Other keys determine whether the key is required. The template has the key with this text.
    Shown(&'static str),
}

/// Condition on another key of the same table. The key is refused unless the other key is given, or has one of the values.
pub(crate) struct KeyCondition {
    /// True if the key is required when the condition holds.
    pub(crate) needed: bool,
    pub(crate) key: &'static str,
    /// Accepted values of the other key as TOML. Empty: any value.
    pub(crate) values: &'static [&'static str],
}

/// Range of numbers from `min` to `max`. `min` belongs to the range only if `min_included`.
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

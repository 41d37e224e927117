//! Reads TOML text against the declarations in [`keys`] and lists every problem.
//!
//! The result is a [`Declared`] struct with a [`Field`] for every key. A key that is unknown, missing, of the wrong type or outside
//! its range is listed as a problem. A field without a value is either absent or already listed, so `check` skips it.

use std::collections::HashMap;
use std::ops::Deref;
use std::path::{Path, PathBuf};

use glam::DVec3;
use toml::Spanned;
use toml::de::{DeTable, DeValue};

use super::declaration::{
    Key, KeyCondition, Kind, MAX_NAMES, MAX_ROWS, Presence, Range, Table, Unit,
};
use super::files::Files;
use super::problem::Problem;
use super::spec::words::NamedChoice;

/// Minimum similarity of a name that is proposed as a correction; 1 means equal.
const LIKENESS: f64 = 0.5;
/// Maximum number of listed unknown keys of a table.
const MAX_UNKNOWN_KEYS: usize = 20;
/// Maximum number of listed syntax errors. Later errors are consequences of the first.
const MAX_SYNTAX_ERRORS: usize = 20;
/// Maximum number of characters of a quoted value.
const QUOTED_CHARACTERS: usize = 60;

/// Table before its conversion to a [`Declared`] struct.
#[derive(Debug)]
pub(crate) struct RawTable(HashMap<&'static str, (Entry, Option<RawValue>)>);

/// Position of a key in the file.
#[derive(Debug)]
pub(crate) struct Entry {
    /// Path of the key, for example `sonar[0].pulse.kind`.
    pub path: String,
    pub line: Option<usize>,
    /// Value as written in the file, shortened.
    pub text: String,
    /// True if the key is in the file, false for a default.
    pub given: bool,
    /// True if the value satisfies the rule of the key.
    pub sound: bool,
}

/// A key and its value. A key without a value is absent or already listed as a problem.
#[derive(Debug)]
pub(crate) struct Field<T> {
    entry: Entry,
    value: Option<T>,
}

/// A struct with a [`Field`] for every key of a table. The macro `table!` generates such structs.
pub(crate) trait Declared: Sized {
    const TABLE: Table;

    fn from_raw(raw: RawTable) -> Self;
}

/// A name, or a value of another type.
#[derive(Debug)]
pub(crate) enum ChoiceOr<T> {
    Choice(String),
    Other(T),
}

#[derive(Debug)]
pub(crate) enum RawValue {
    Bool(bool),
    Integer(i64),
    /// Number in SI units.
    Number(f64),
    Text(String),
    /// File or folder, joined to the folder of the configuration.
    Path(PathBuf),
    /// Numbers in SI units.
    Numbers(Vec<f64>),
    Rows(Vec<(f64, f64)>),
    Texts(Vec<String>),
    Table(RawTable),
    Tables(Vec<RawTable>),
}

/// Type of the value of a [`Field`].
pub(crate) trait Value: Sized {
    /// Converts a value. `None` if the value has another type, which the declaration excludes.
    fn from_raw(value: RawValue) -> Option<Self>;
}

macro_rules! values {
    ($($type:ty: $pattern:pat => $value:expr;)*) => {
        $(impl Value for $type {
            fn from_raw(value: RawValue) -> Option<Self> {
                match value {
                    $pattern => Some($value),
                    _ => None,
                }
            }
        })*
    };
}

values! {
    bool: RawValue::Bool(value) => value;
    i64: RawValue::Integer(value) => value;
    f64: RawValue::Number(value) => value;
    String: RawValue::Text(value) => value;
    PathBuf: RawValue::Path(value) => value;
    Vec<(f64, f64)>: RawValue::Rows(value) => value;
    Vec<String>: RawValue::Texts(value) => value;
}

impl Value for (f64, f64) {
    fn from_raw(value: RawValue) -> Option<Self> {
        match value {
            RawValue::Numbers(n) => Some((*n.first()?, *n.get(1)?)),
            _ => None,
        }
    }
}

impl Value for DVec3 {
    fn from_raw(value: RawValue) -> Option<Self> {
        match value {
            RawValue::Numbers(n) if n.len() == 3 => Some(DVec3::from_slice(&n)),
            _ => None,
        }
    }
}

impl<T: Declared> Value for T {
    fn from_raw(value: RawValue) -> Option<Self> {
        match value {
            RawValue::Table(table) => Some(Declared::from_raw(table)),
            _ => None,
        }
    }
}

impl<T: Declared> Value for Vec<T> {
    fn from_raw(value: RawValue) -> Option<Self> {
        match value {
            RawValue::Tables(tables) => Some(tables.into_iter().map(T::from_raw).collect()),
            _ => None,
        }
    }
}

impl<T: Value> Value for ChoiceOr<T> {
    fn from_raw(value: RawValue) -> Option<Self> {
        match value {
            RawValue::Text(text) => Some(Self::Choice(text)),
            other => T::from_raw(other).map(Self::Other),
        }
    }
}

impl RawTable {
    /// Removes and returns the field of a declared key.
    pub(crate) fn take<T: Value>(&mut self, key: &str) -> Field<T> {
        let (entry, value) = self.0.remove(key).expect("every declared key is walked");
        Field {
            entry,
            value: value.and_then(T::from_raw),
        }
    }
}

impl Entry {
    /// Name of the key without the path of its table.
    pub(crate) fn key(&self) -> &str {
        self.path.rsplit('.').next().unwrap_or_default()
    }
}

/// A field of any type dereferences to its entry.
impl<T> Deref for Field<T> {
    type Target = Entry;

    fn deref(&self) -> &Entry {
        &self.entry
    }
}

impl<T> Field<T> {
    pub(crate) fn as_ref(&self) -> Option<&T> {
        self.value.as_ref()
    }

    /// Result of `read` for the value; `None` without a value.
    pub(crate) fn and_then<'t, R>(&'t self, read: impl FnOnce(&'t T) -> Option<R>) -> Option<R> {
        self.value.as_ref().and_then(read)
    }

    /// As [`Field::and_then`], with `Some(None)` if the key is absent.
    pub(crate) fn given_and_then<'t, R>(
        &'t self,
        read: impl FnOnce(&'t T) -> Option<R>,
    ) -> Option<Option<R>> {
        match self.given {
            true => self.and_then(read).map(Some),
            false => Some(None),
        }
    }
}

impl<T: Clone> Field<T> {
    pub(crate) fn get(&self) -> Option<T> {
        self.value.clone()
    }

    /// `Some(None)` if the key is absent; `None` if its value is refused.
    pub(crate) fn if_given(&self) -> Option<Option<T>> {
        self.given_and_then(|value| Some(value.clone()))
    }
}

impl Field<i64> {
    /// The number in another integer type, which must cover the declared range.
    pub(crate) fn to<T: TryFrom<i64>>(&self) -> Option<T> {
        T::try_from(self.value?).ok()
    }
}

impl Field<String> {
    /// The value of a choice, a name or a text.
    pub(crate) fn text(&self) -> Option<&str> {
        self.value.as_deref()
    }

    /// The choice that the value names.
    pub(crate) fn named<T: NamedChoice>(&self) -> Option<T> {
        T::from_word(self.text()?)
    }

    /// Whether the value is `text`; `None` without a value.
    pub(crate) fn is(&self, text: &str) -> Option<bool> {
        self.text().map(|own| own == text)
    }
}

impl Field<Vec<String>> {
    /// The choices that the values name.
    pub(crate) fn all_named<T: NamedChoice>(&self) -> Option<Vec<T>> {
        self.as_ref()?
            .iter()
            .map(|word| T::from_word(word))
            .collect()
    }
}

impl<T> Field<Vec<T>> {
    /// The values; empty if the field has no value.
    pub(crate) fn all(&self) -> &[T] {
        self.value.as_deref().unwrap_or_default()
    }
}

impl<T> Field<ChoiceOr<T>> {
    /// The name, if the value is a name.
    pub(crate) fn text(&self) -> Option<&str> {
        match self.as_ref()? {
            ChoiceOr::Choice(text) => Some(text),
            ChoiceOr::Other(_) => None,
        }
    }

    /// The value, if the value is not a name.
    pub(crate) fn other(&self) -> Option<&T> {
        match self.as_ref()? {
            ChoiceOr::Choice(_) => None,
            ChoiceOr::Other(other) => Some(other),
        }
    }
}

/// List of problems.
#[derive(Debug, Default)]
pub(crate) struct Problems(pub Vec<Problem>);

impl Problems {
    /// Adds a problem: `entry` violates `rule`.
    pub(crate) fn refuse(&mut self, entry: &Entry, rule: impl Into<String>) {
        self.0.push(Problem {
            path: entry.path.clone(),
            line: entry.line,
            value: entry.text.clone(),
            rule: rule.into(),
            hint: None,
        });
    }

    /// Refuses `keys` that are given if `holds` is false.
    pub(crate) fn only_with(&mut self, keys: &[&Entry], holds: Option<bool>, condition: &str) {
        // A key without a valid value is already listed.
        let misplaced = |e: &&&Entry| holds == Some(false) && e.given && e.sound;
        for entry in keys.iter().filter(misplaced) {
            self.refuse(entry, format!("only with {condition}"));
        }
    }

    /// Refuses a missing `key` if `holds` is true.
    pub(crate) fn needed_with(&mut self, key: &Entry, holds: Option<bool>, condition: &str) {
        if holds == Some(true) && !key.given {
            self.refuse(key, format!("missing: needed with {condition}"));
        }
    }

    /// As [`Problems::refuse`], with the most similar of `names` as a hint.
    pub(crate) fn refuse_name<'a>(
        &mut self,
        entry: &Entry,
        rule: impl Into<String>,
        name: &str,
        names: impl Iterator<Item = &'a str>,
    ) {
        self.refuse(entry, rule);
        if let Some(last) = self.0.last_mut() {
            last.hint = did_you_mean(name, names);
        }
    }
}

/// Keys renamed since an earlier version: old name and new name.
const RENAMED: &[(&str, &str)] = &[
    ("certificate", "error_check"),
    ("rehearse_ms", "simulated_compute_ms"),
    ("straightness", "cable_scope"),
];

/// `did you mean "…"?` with the most similar of `names`, if the similarity is sufficient.
pub fn did_you_mean<'a>(name: &str, names: impl Iterator<Item = &'a str>) -> Option<String> {
    names
        .map(|n| (strsim::normalized_damerau_levenshtein(name, n), n))
        .filter(|(likeness, _)| *likeness >= LIKENESS)
        .max_by(|a, b| a.0.total_cmp(&b.0))
        .map(|(_, n)| format!("did you mean \"{n}\"?"))
}

/// Value of `text` times 10^`power`, rounded once, as if the number were written in the other unit.
fn scaled(text: &str, power: i32) -> f64 {
    let (mantissa, exponent) = text.split_once(['e', 'E']).unwrap_or((text, "0"));
    exponent
        .parse::<i32>()
        .ok()
        .and_then(|e| {
            format!("{mantissa}e{}", e.saturating_add(power))
                .parse()
                .ok()
        })
        .unwrap_or_else(|| text.parse().unwrap_or(f64::NAN) * 10f64.powi(power))
}

impl Unit {
    /// Value of the digits in SI units, rounded once.
    fn si(self, digits: &str) -> f64 {
        match self {
            Unit::Power(power) => scaled(digits, power),
            Unit::Degrees => scaled(digits, 0).to_radians(),
        }
    }
}

/// Reads the text as a declared table and lists its problems. `None` if the text is not TOML.
pub(crate) fn read<T: Declared>(
    text: &str,
    base_dir: &Path,
    files: &dyn Files,
    problems: &mut Problems,
) -> Option<T> {
    let (document, errors) = DeTable::parse_recoverable(text);
    let line_starts: Vec<usize> = std::iter::once(0)
        .chain(text.match_indices('\n').map(|(at, _)| at + 1))
        .collect();
    let walk = Walk {
        text,
        line_starts: &line_starts,
        base_dir,
        files,
    };
    if !errors.is_empty() {
        // The recovered part of an invalid text would cause false problems, so only syntax errors are listed.
        let listed = errors.iter().take(MAX_SYNTAX_ERRORS);
        problems.0.extend(listed.map(|e| Problem {
            line: e.span().map(|span| walk.line(span.start)),
            rule: format!("not TOML: {}", e.message().replace('\n', ", ")),
            ..Problem::default()
        }));
        return None;
    }
    let table = walk.table(&T::TABLE, document.get_ref(), "", None, problems);
    Some(T::from_raw(table))
}

impl KeyCondition {
    /// Refuses a key without the `other` key of its condition, and the absence of a required key.
    fn check(&self, own: &Entry, other: &(Entry, Option<RawValue>), problems: &mut Problems) {
        let holds = match other {
            (entry, _) if self.values.is_empty() => entry.given,
            (_, Some(RawValue::Text(text))) => {
                self.values.iter().any(|v| v.trim_matches('"') == text)
            }
            (_, Some(RawValue::Bool(value))) => self.values.contains(&value.to_string().as_str()),
            // The key is absent or already listed.
            (entry, _) if problems.0.iter().any(|p| p.path == entry.path) => return,
            _ => false,
        };
        let condition = match self.values {
            [] => self.key.to_owned(),
            values => format!("{} = {}", self.key, values.join(" or ")),
        };
        if self.needed {
            problems.needed_with(own, Some(holds), &condition);
        }
        problems.only_with(&[own], Some(holds), &condition);
    }
}

struct Walk<'t> {
    text: &'t str,
    /// Byte offset of each line.
    line_starts: &'t [usize],
    base_dir: &'t Path,
    files: &'t dyn Files,
}

fn joined(path: &str, key: &str) -> String {
    if path.is_empty() {
        key.to_owned()
    } else {
        format!("{path}.{key}")
    }
}

impl Walk<'_> {
    fn line(&self, offset: usize) -> usize {
        self.line_starts.partition_point(|&start| start <= offset)
    }

    /// The value as written, on one line, shortened.
    fn quote(&self, value: &Spanned<DeValue<'_>>) -> String {
        // The path of a table is sufficient, because a table spans many lines.
        let is_table = |value: &Spanned<DeValue<'_>>| value.get_ref().is_table();
        let items = value.get_ref().as_array();
        if is_table(value) || items.is_some_and(|a| a.iter().any(is_table)) {
            return String::new();
        }
        let written = self.text.get(value.span()).unwrap_or_default();
        let words = written.split_whitespace().collect::<Vec<_>>().join(" ");
        match words.char_indices().nth(QUOTED_CHARACTERS) {
            Some((end, _)) => format!("{}...", &words[..end]),
            None => words,
        }
    }

    fn table(
        &self,
        declared: &Table,
        table: &DeTable<'_>,
        path: &str,
        line: Option<usize>,
        problems: &mut Problems,
    ) -> RawTable {
        let is_unknown = |name: &str| !declared.keys.iter().any(|k| k.name == name);
        let mut unknown = table.iter().filter(|(name, _)| is_unknown(name.get_ref()));
        for (name, value) in unknown.by_ref().take(MAX_UNKNOWN_KEYS) {
            problems.0.push(self.unknown(declared, name, value, path));
        }
        let more = unknown.count();
        if more > 0 {
            problems.0.push(Problem {
                path: path.to_owned(),
                line,
                rule: format!("{more} more unknown keys"),
                ..Problem::default()
            });
        }
        let entries: HashMap<_, _> = declared
            .keys
            .iter()
            .map(|key| {
                let found = table.iter().find(|(name, _)| name.get_ref() == key.name);
                let mut entry = Entry {
                    path: joined(path, key.name),
                    line,
                    text: String::new(),
                    given: false,
                    sound: false,
                };
                let value = match found {
                    Some((name, value)) => {
                        entry.line = Some(self.line(name.span().start));
                        entry.text = self.quote(value);
                        entry.given = true;
                        self.value(&key.kind, value, &entry, problems)
                    }
                    None => self.absent(key, &entry, problems),
                };
                entry.sound = value.is_some();
                (key.name, (entry, value))
            })
            .collect();
        for key in declared.keys {
            if let Some(with) = &key.with {
                with.check(&entries[key.name].0, &entries[with.key], problems);
            }
        }
        RawTable(entries)
    }

    fn unknown(
        &self,
        declared: &Table,
        name: &Spanned<std::borrow::Cow<'_, str>>,
        value: &Spanned<DeValue<'_>>,
        path: &str,
    ) -> Problem {
        let later = declared.later.contains(&name.get_ref().as_ref());
        let names = declared.keys.iter().map(|k| k.name);
        let renamed = RENAMED
            .iter()
            .find(|(old, new)| {
                old == name.get_ref() && declared.keys.iter().any(|k| k.name == *new)
            })
            .map(|(_, new)| new);
        Problem {
            path: joined(path, &name.get_ref().escape_default().to_string()),
            line: Some(self.line(name.span().start)),
            value: self.quote(value),
            rule: match (later, renamed) {
                (true, _) => "not supported yet".to_owned(),
                (false, Some(new)) => format!("renamed: write {new} instead"),
                (false, None) => "unknown key".to_owned(),
            },
            hint: match later || renamed.is_some() {
                true => None,
                false => did_you_mean(name.get_ref(), names).or_else(|| {
                    let place = place_of(declared, name.get_ref()).filter(|_| path.is_empty())?;
                    Some(format!("did you mean \"{place}\"?"))
                }),
            },
        }
    }

    /// The default of an absent key.
    fn absent(&self, key: &Key, entry: &Entry, problems: &mut Problems) -> Option<RawValue> {
        match key.presence {
            Presence::Required(_) => {
                let place = entry.path.replace("[0]", "");
                let rule = match key.kind {
                    Kind::Table(_) => format!("missing: the table [{place}]"),
                    Kind::Tables(..) => format!("missing: at least one [[{place}]]"),
                    _ => format!("missing: {}", rule(&key.kind)),
                };
                problems.refuse(entry, rule);
                None
            }
            Presence::Default(text) | Presence::Set(text, _) => {
                // A test checks that each default satisfies its own rule.
                let written = format!("v = {text}");
                let parsed = DeTable::parse(&written).ok();
                let value = parsed.as_ref().and_then(|t| t.get_ref().get("v"));
                let walk = Walk {
                    text: &written,
                    ..*self
                };
                let mut own = Problems::default();
                let value = value.and_then(|v| walk.value(&key.kind, v, entry, &mut own));
                debug_assert!(own.0.is_empty(), "{}: {:?}", entry.path, own.0);
                value
            }
            Presence::Optional(_) | Presence::Shown(_) => None,
        }
    }

    /// The value of a key. `None`, with a problem, if the value violates the declaration.
    fn value(
        &self,
        kind: &Kind,
        value: &Spanned<DeValue<'_>>,
        entry: &Entry,
        problems: &mut Problems,
    ) -> Option<RawValue> {
        let found = value.get_ref().as_array().map_or(0, |items| items.len());
        if max_items(kind).is_some_and(|max| found > max) {
            problems.refuse(
                entry,
                format!("has {found} entries; must be {}", rule(kind)),
            );
            return None;
        }
        let read =
            match (kind, value.get_ref()) {
                (Kind::Table(declared), DeValue::Table(table)) => Some(RawValue::Table(
                    self.table(declared, table, &entry.path, entry.line, problems),
                )),
                (Kind::Tables(declared, _), DeValue::Array(items)) if !items.is_empty() => {
                    let mut tables = Vec::with_capacity(items.len());
                    for (i, item) in items.iter().enumerate() {
                        let DeValue::Table(table) = item.get_ref() else {
                            problems.refuse(entry, format!("must be {}", rule(kind)));
                            return None;
                        };
                        let path = format!("{}[{i}]", entry.path);
                        let line = Some(self.line(item.span().start));
                        tables.push(self.table(declared, table, &path, line, problems));
                    }
                    Some(RawValue::Tables(tables))
                }
                (Kind::Either(first, second), _) => {
                    let kind = if type_fits(first, value.get_ref()) {
                        first
                    } else if type_fits(second, value.get_ref()) {
                        second
                    } else {
                        problems.refuse(entry, format!("must be {}", rule(kind)));
                        return None;
                    };
                    return self.value(kind, value, entry, problems);
                }
                (Kind::Choice(built, later), DeValue::String(text)) => {
                    if built.contains(&text.as_ref()) {
                        Some(RawValue::Text(text.to_string()))
                    } else if later.contains(&text.as_ref()) {
                        let rule = format!("not supported yet; must be {}", rule(kind));
                        problems.refuse(entry, rule);
                        return None;
                    } else {
                        let must = format!("must be {}", rule(kind));
                        problems.refuse_name(entry, must, text, built.iter().copied());
                        return None;
                    }
                }
                (Kind::Choices(built), DeValue::Array(items)) => {
                    let wrong = items
                        .iter()
                        .filter_map(|i| i.get_ref().as_str())
                        .find(|text| !built.contains(text));
                    if let Some(wrong) = wrong {
                        let must = format!("must be {}", rule(kind));
                        problems.refuse_name(entry, must, wrong, built.iter().copied());
                        return None;
                    }
                    texts(items).map(RawValue::Texts)
                }
                (Kind::File, DeValue::String(name)) => {
                    let path = self.base_dir.join(name.as_ref());
                    match self.files.check_readable(&path) {
                        Ok(()) => Some(RawValue::Path(path)),
                        Err(why) => {
                            problems
                                .refuse(entry, format!("must be a file that can be read: {why}"));
                            return None;
                        }
                    }
                }
                (Kind::Folder, DeValue::String(name)) if !name.is_empty() => {
                    let path = self.base_dir.join(name.as_ref());
                    self.files
                        .is_folder_or_free(&path)
                        .then_some(RawValue::Path(path))
                }
                (_, value) => simple(kind, value),
            };
        if read.is_none() {
            problems.refuse(entry, format!("must be {}", rule(kind)));
            let is_number = matches!(kind, Kind::Number(..) | Kind::Integer(..));
            let begins_with_digit = |text: &str| {
                text.trim_start_matches(['-', '+', ' '])
                    .starts_with(|c: char| c.is_ascii_digit())
            };
            if is_number
                && value.get_ref().as_str().is_some_and(begins_with_digit)
                && let Some(last) = problems.0.last_mut()
            {
                last.hint = Some("write the number alone, without quotes and unit".to_owned());
            }
        }
        read
    }
}

/// A value of a kind without context. `None` if the value is not of the kind.
fn simple(kind: &Kind, value: &DeValue<'_>) -> Option<RawValue> {
    match (kind, value) {
        (Kind::Bool, DeValue::Boolean(b)) => Some(RawValue::Bool(*b)),
        (Kind::Integer(min, max, unit), DeValue::Integer(_)) => integer(value)
            .filter(|i| (min..=max).contains(&i))
            .map(|i| RawValue::Integer(i * unit)),
        (Kind::Number(range, unit), value) => {
            number(value, range).map(|digits| RawValue::Number(unit.si(&digits)))
        }
        (Kind::Name, DeValue::String(text)) => {
            is_name(text).then(|| RawValue::Text(text.to_string()))
        }
        (Kind::Text, DeValue::String(text)) => {
            (!text.trim().is_empty()).then(|| RawValue::Text(text.to_string()))
        }
        (Kind::Numbers(count, range, unit), DeValue::Array(items)) if items.len() == *count => {
            items
                .iter()
                .map(|i| number(i.get_ref(), range).map(|digits| unit.si(&digits)))
                .collect::<Option<_>>()
                .map(RawValue::Numbers)
        }
        (Kind::Rows(_), DeValue::Array(items)) if !items.is_empty() => items
            .iter()
            .map(|row| {
                let row = row.get_ref().as_array().filter(|r| r.len() == 2)?;
                let cell = |i: usize| Some(scaled(&number(row.get(i)?.get_ref(), &ROW_CELL)?, 0));
                Some((cell(0)?, cell(1)?))
            })
            .collect::<Option<_>>()
            .map(RawValue::Rows),
        (Kind::Names, DeValue::Array(items)) => texts(items)
            .filter(|names| names.iter().all(|n| is_name(n)))
            .map(RawValue::Texts),
        _ => None,
    }
}

/// Range of metres, decibels and metres per second in a table of pairs.
const ROW_CELL: Range = Range {
    min: -1.0e5,
    min_included: true,
    max: 1.0e5,
};

/// Maximum length of a list of this kind.
pub(crate) fn max_items(kind: &Kind) -> Option<usize> {
    match kind {
        Kind::Rows(_) => Some(MAX_ROWS),
        Kind::Names | Kind::Choices(_) => Some(MAX_NAMES),
        Kind::Tables(_, max) => Some(*max),
        _ => None,
    }
}

fn type_fits(kind: &Kind, value: &DeValue<'_>) -> bool {
    match kind {
        Kind::Choice(..) => value.is_str(),
        Kind::Table(_) => value.is_table(),
        Kind::Rows(_) => value.is_array(),
        Kind::Number(..) => value.is_float() || value.is_integer(),
        _ => false,
    }
}

fn integer(value: &DeValue<'_>) -> Option<i64> {
    let integer = value.as_integer()?;
    i64::from_str_radix(integer.as_str(), integer.radix()).ok()
}

/// Digits of a number within `range`.
fn number(value: &DeValue<'_>, range: &Range) -> Option<String> {
    let digits = match value {
        DeValue::Float(float) => float.as_str().to_owned(),
        value => integer(value)?.to_string(),
    };
    let number: f64 = digits.parse().ok()?;
    // NaN fails every comparison, and infinity exceeds the finite limits.
    let above = number > range.min || (range.min_included && number == range.min);
    (above && number <= range.max).then_some(digits)
}

fn texts(items: &toml::de::DeArray<'_>) -> Option<Vec<String>> {
    let texts: Option<Vec<String>> = items
        .iter()
        .map(|i| i.get_ref().as_str().map(str::to_owned))
        .collect();
    texts.filter(|t| !t.is_empty())
}

fn is_name(text: &str) -> bool {
    (1..=32).contains(&text.len())
        && text
            .bytes()
            .all(|b| b.is_ascii_alphanumeric() || b == b'-' || b == b'_')
}

/// The rule of a kind as text that follows "must be".
pub(crate) fn rule(kind: &Kind) -> String {
    let quoted = |choices: &[&str], last: &str| {
        let all: Vec<_> = choices.iter().map(|c| format!("\"{c}\"")).collect();
        match all.split_last() {
            Some((end, rest)) if !rest.is_empty() => format!("{} {last} {end}", rest.join(", ")),
            _ => all.join(""),
        }
    };
    match kind {
        Kind::Bool => "true or false".to_owned(),
        Kind::Number(range, _) => format!("a number {}", between(range)),
        Kind::Integer(min, i64::MAX, _) => format!("a whole number from {min} to 2^63 - 1"),
        Kind::Integer(min, max, _) => format!("a whole number from {min} to {max}"),
        Kind::Name => "a name in quotes: 1 to 32 letters, digits, '-' or '_'".to_owned(),
        Kind::Text => "text in quotes".to_owned(),
        Kind::File => "the name of a file in quotes".to_owned(),
        Kind::Folder => "the name of a folder in quotes; the folder need not exist".to_owned(),
        Kind::Choice(built, _) => quoted(built, "or"),
        Kind::Numbers(2, range, _) => {
            format!("two numbers [lowest, highest] {}", between(range))
        }
        Kind::Numbers(count, range, _) => format!("{count} numbers in brackets {}", between(range)),
        Kind::Rows(columns) => format!("1 to {MAX_ROWS} pairs of numbers [[{columns}], ...]"),
        Kind::Names => format!("1 to {MAX_NAMES} names in brackets"),
        Kind::Choices(built) => format!("in brackets some of {}", quoted(built, "and")),
        Kind::Table(table) => format!("a table of {}", key_names(table)),
        Kind::Tables(_, max) => format!("1 to {max} tables, each under its own [[...]]"),
        Kind::Either(first, second) => format!("{}, or {}", rule(first), rule(second)),
    }
}

fn between(range: &Range) -> String {
    match range.min_included {
        true => format!("from {} to {}", range.min, range.max),
        false => format!("above {}, at most {}", range.min, range.max),
    }
}

/// Path of the first key of this name in the tables below `table`.
fn place_of(table: &Table, name: &str) -> Option<String> {
    let tables = |kind: &Kind| match kind {
        Kind::Table(table) | Kind::Tables(table, _) => Some(*table),
        Kind::Either(_, Kind::Table(table) | Kind::Tables(table, _)) => Some(*table),
        _ => None,
    };
    let below = table.keys.iter();
    let mut below = below.filter_map(|key| Some((key.name, tables(&key.kind)?)));
    below.find_map(|(outer, table)| {
        if table.keys.iter().any(|key| key.name == name) {
            return Some(format!("{outer}.{name}"));
        }
        Some(format!("{outer}.{}", place_of(table, name)?))
    })
}

fn key_names(table: &Table) -> String {
    let names: Vec<_> = table.keys.iter().map(|k| k.name).collect();
    match names.is_empty() {
        true => "no keys".to_owned(),
        false => names.join(", "),
    }
}

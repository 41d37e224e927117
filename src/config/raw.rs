//! Text to raw tables: walks the TOML against the declarations in [`keys`], with everything that is wrong put on one list.
//!
//! In: the text. Out: a [`RawTable`] in which every declared key has an entry, and problems for what is unknown, missing, of the wrong
//! type or outside its range. An entry without a value is either absent by right or already on the list, so `check` passes it over.

use std::collections::HashMap;
use std::path::{Path, PathBuf};

use glam::DVec3;
use toml::Spanned;
use toml::de::{DeTable, DeValue};

use super::keys::{Key, Kind, Presence, Range, Table};
use super::problem::Problem;

/// A name this like a declared one (1: the same) is offered as what was meant.
const LIKENESS: f64 = 0.5;
/// Syntax errors that are listed: beyond the first few they follow from one another.
const MAX_SYNTAX_ERRORS: usize = 20;
/// Characters of a value that a problem quotes.
const QUOTED_CHARACTERS: usize = 60;

/// A table as read.
#[derive(Debug)]
pub(crate) struct RawTable {
    /// `sonar[0].pulse`; empty for the whole file.
    pub path: String,
    entries: HashMap<&'static str, RawEntry>,
}

/// One declared key as read.
#[derive(Debug)]
pub(crate) struct RawEntry {
    pub path: String,
    pub line: Option<usize>,
    /// As written, shortened.
    pub text: String,
    /// It stands in the file (a default does not).
    pub given: bool,
    pub value: Option<RawValue>,
}

#[derive(Debug)]
pub(crate) enum RawValue {
    Bool(bool),
    Integer(i64),
    /// The digits as written, so that units can be shifted without rounding twice.
    Number(String),
    Text(String),
    /// A file or a folder, under the configuration's own.
    Path(PathBuf),
    Numbers(Vec<String>),
    Rows(Vec<(f64, f64)>),
    Texts(Vec<String>),
    Table(RawTable),
    Tables(Vec<RawTable>),
}

/// The list everything wrong goes on.
#[derive(Debug, Default)]
pub(crate) struct Problems(pub Vec<Problem>);

impl Problems {
    /// `rule` does not hold for what stands at `entry`.
    pub(crate) fn refuse(&mut self, entry: &RawEntry, rule: impl Into<String>) {
        self.0.push(Problem {
            path: entry.path.clone(),
            line: entry.line,
            value: entry.text.clone(),
            rule: rule.into(),
            hint: None,
        });
    }

    /// As [`Problems::refuse`], with a name of `names` offered in place of `name`.
    pub(crate) fn refuse_name<'a>(
        &mut self,
        entry: &RawEntry,
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

/// Keys that had another name in an earlier version, old and new.
const RENAMED: &[(&str, &str)] = &[
    ("certificate", "error_check"),
    ("rehearse_ms", "simulated_compute_ms"),
    ("straightness", "cable_scope"),
];

/// `did you mean "…"?` with the likest of `names`, if any is like enough.
fn did_you_mean<'a>(name: &str, names: impl Iterator<Item = &'a str>) -> Option<String> {
    names
        .map(|n| (strsim::normalized_damerau_levenshtein(name, n), n))
        .filter(|(likeness, _)| *likeness >= LIKENESS)
        .max_by(|a, b| a.0.total_cmp(&b.0))
        .map(|(_, n)| format!("did you mean \"{n}\"?"))
}

/// `text` times 10^`power`, rounded once, as if it had been written in the other unit.
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

impl RawTable {
    /// The entry of a declared key; an undeclared one is the programmer's mistake.
    pub(crate) fn entry(&self, key: &str) -> &RawEntry {
        let entry = self.entries.get(key);
        entry.unwrap_or_else(|| panic!("{}.{key} is not declared in keys.rs", self.path))
    }

    fn value(&self, key: &str) -> Option<&RawValue> {
        self.entry(key).value.as_ref()
    }

    pub(crate) fn given(&self, key: &str) -> bool {
        self.entry(key).given
    }

    pub(crate) fn bool(&self, key: &str) -> Option<bool> {
        match self.value(key)? {
            RawValue::Bool(b) => Some(*b),
            _ => None,
        }
    }

    pub(crate) fn integer(&self, key: &str) -> Option<i64> {
        match self.value(key)? {
            RawValue::Integer(i) => Some(*i),
            _ => None,
        }
    }

    /// A count; its declared range keeps it from being negative.
    pub(crate) fn count(&self, key: &str) -> Option<usize> {
        usize::try_from(self.integer(key)?).ok()
    }

    pub(crate) fn number(&self, key: &str) -> Option<f64> {
        self.scaled(key, 0)
    }

    /// The number times 10^`power`: `scaled("duration_ms", -3)` is in seconds.
    pub(crate) fn scaled(&self, key: &str, power: i32) -> Option<f64> {
        match self.value(key)? {
            RawValue::Number(text) => Some(scaled(text, power)),
            _ => None,
        }
    }

    pub(crate) fn angle_rad(&self, key: &str) -> Option<f64> {
        self.number(key).map(f64::to_radians)
    }

    /// A choice, a name or a text.
    pub(crate) fn text(&self, key: &str) -> Option<&str> {
        match self.value(key)? {
            RawValue::Text(text) => Some(text),
            _ => None,
        }
    }

    pub(crate) fn path(&self, key: &str) -> Option<PathBuf> {
        match self.value(key)? {
            RawValue::Path(path) => Some(path.clone()),
            _ => None,
        }
    }

    pub(crate) fn vector(&self, key: &str) -> Option<DVec3> {
        match self.value(key)? {
            RawValue::Numbers(n) if n.len() == 3 => Some(DVec3::new(
                scaled(&n[0], 0),
                scaled(&n[1], 0),
                scaled(&n[2], 0),
            )),
            _ => None,
        }
    }

    /// Two numbers, each times 10^`power`.
    pub(crate) fn pair(&self, key: &str, power: i32) -> Option<(f64, f64)> {
        match self.value(key)? {
            RawValue::Numbers(n) if n.len() == 2 => {
                Some((scaled(&n[0], power), scaled(&n[1], power)))
            }
            _ => None,
        }
    }

    pub(crate) fn rows(&self, key: &str) -> Option<&[(f64, f64)]> {
        match self.value(key)? {
            RawValue::Rows(rows) => Some(rows),
            _ => None,
        }
    }

    pub(crate) fn texts(&self, key: &str) -> Option<&[String]> {
        match self.value(key)? {
            RawValue::Texts(texts) => Some(texts),
            _ => None,
        }
    }

    pub(crate) fn table(&self, key: &str) -> Option<&RawTable> {
        match self.value(key)? {
            RawValue::Table(table) => Some(table),
            _ => None,
        }
    }

    pub(crate) fn tables(&self, key: &str) -> &[RawTable] {
        match self.value(key) {
            Some(RawValue::Tables(tables)) => tables,
            _ => &[],
        }
    }
}

/// The text as a table of `declared`, all problems on the list. A text that is no TOML gives none.
pub(crate) fn read(
    text: &str,
    base_dir: &Path,
    declared: &'static Table,
    problems: &mut Problems,
) -> Option<RawTable> {
    let (document, errors) = DeTable::parse_recoverable(text);
    let walk = Walk { text, base_dir };
    if !errors.is_empty() {
        // What could be rescued of a broken text would only bring problems that are not there.
        let listed = errors.iter().take(MAX_SYNTAX_ERRORS);
        problems.0.extend(listed.map(|e| Problem {
            line: e.span().map(|span| walk.line(span.start)),
            rule: format!("not TOML: {}", e.message().replace('\n', ", ")),
            ..Problem::default()
        }));
        return None;
    }
    Some(walk.table(declared, document.get_ref(), String::new(), None, problems))
}

struct Walk<'t> {
    text: &'t str,
    base_dir: &'t Path,
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
        let before = &self.text.as_bytes()[..offset.min(self.text.len())];
        1 + before.iter().filter(|&&b| b == b'\n').count()
    }

    /// The value as written, on one line, shortened.
    fn quote(&self, value: &Spanned<DeValue<'_>>) -> String {
        // Of what goes over many lines the path says enough.
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
        declared: &'static Table,
        table: &DeTable<'_>,
        path: String,
        line: Option<usize>,
        problems: &mut Problems,
    ) -> RawTable {
        for (name, value) in table.iter() {
            let known = |k: &Key| k.name == name.get_ref().as_ref();
            if !declared.keys.iter().any(known) {
                problems.0.push(self.unknown(declared, name, value, &path));
            }
        }
        let entries = declared
            .keys
            .iter()
            .map(|key| {
                let found = table.iter().find(|(name, _)| name.get_ref() == key.name);
                let mut entry = RawEntry {
                    path: joined(&path, key.name),
                    line,
                    text: String::new(),
                    given: false,
                    value: None,
                };
                match found {
                    Some((name, value)) => {
                        entry.line = Some(self.line(name.span().start));
                        entry.text = self.quote(value);
                        entry.given = true;
                        entry.value = self.value(&key.kind, value, &entry, problems);
                    }
                    None => self.absent(key, &mut entry, problems),
                }
                (key.name, entry)
            })
            .collect();
        RawTable { path, entries }
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
                (true, _) => "known, not yet built".to_owned(),
                (false, Some(new)) => format!("renamed: write {new} instead"),
                (false, None) => "unknown key".to_owned(),
            },
            hint: match later || renamed.is_some() {
                true => None,
                false => did_you_mean(name.get_ref(), names),
            },
        }
    }

    /// Puts the default in the place of what is not there.
    fn absent(&self, key: &Key, entry: &mut RawEntry, problems: &mut Problems) {
        match key.presence {
            Presence::Required(_) => {
                let place = entry.path.replace("[0]", "");
                let rule = match key.kind {
                    Kind::Table(_) => format!("missing: the table [{place}]"),
                    Kind::Tables(_) => format!("missing: at least one [[{place}]]"),
                    _ => format!("missing: {}", rule(&key.kind)),
                };
                problems.refuse(entry, rule);
            }
            Presence::Default(text) | Presence::Set(text, _) => {
                // Ours, not the operator's: a default that breaks its own rule is found by a test.
                let written = format!("v = {text}");
                let parsed = DeTable::parse(&written).ok();
                let value = parsed.as_ref().and_then(|t| t.get_ref().get("v"));
                let walk = Walk {
                    text: &written,
                    ..*self
                };
                let mut own = Problems::default();
                entry.value = value.and_then(|v| walk.value(&key.kind, v, entry, &mut own));
                debug_assert!(own.0.is_empty(), "{}: {:?}", entry.path, own.0);
            }
            Presence::Optional(_) | Presence::Shown(_) => {}
        }
    }

    /// What stands behind a key, if it is what the declaration wants.
    fn value(
        &self,
        kind: &Kind,
        value: &Spanned<DeValue<'_>>,
        entry: &RawEntry,
        problems: &mut Problems,
    ) -> Option<RawValue> {
        let read =
            match (kind, value.get_ref()) {
                (Kind::Table(declared), DeValue::Table(table)) => Some(RawValue::Table(
                    self.table(declared, table, entry.path.clone(), entry.line, problems),
                )),
                (Kind::Tables(declared), DeValue::Array(items)) if !items.is_empty() => {
                    let mut tables = Vec::with_capacity(items.len());
                    for (i, item) in items.iter().enumerate() {
                        let DeValue::Table(table) = item.get_ref() else {
                            problems.refuse(entry, format!("must be {}", rule(kind)));
                            return None;
                        };
                        let path = format!("{}[{i}]", entry.path);
                        let line = Some(self.line(item.span().start));
                        tables.push(self.table(declared, table, path, line, problems));
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
                        problems.refuse(
                            entry,
                            format!("known, not yet built; must be {}", rule(kind)),
                        );
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
                    match readable(&path) {
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
                    (path.is_dir() || !path.exists()).then_some(RawValue::Path(path))
                }
                (_, value) => simple(kind, value),
            };
        if read.is_none() {
            problems.refuse(entry, format!("must be {}", rule(kind)));
        }
        read
    }
}

/// Values that need nothing but themselves; none where the kind does not hold.
fn simple(kind: &Kind, value: &DeValue<'_>) -> Option<RawValue> {
    match (kind, value) {
        (Kind::Bool, DeValue::Boolean(b)) => Some(RawValue::Bool(*b)),
        (Kind::Integer(min, max), DeValue::Integer(_)) => integer(value)
            .filter(|i| (min..=max).contains(&i))
            .map(RawValue::Integer),
        (Kind::Number(range), value) => number(value, range).map(RawValue::Number),
        (Kind::Name, DeValue::String(text)) => {
            is_name(text).then(|| RawValue::Text(text.to_string()))
        }
        (Kind::Text, DeValue::String(text)) => {
            (!text.trim().is_empty()).then(|| RawValue::Text(text.to_string()))
        }
        (Kind::Numbers(count, range), DeValue::Array(items)) if items.len() == *count => items
            .iter()
            .map(|i| number(i.get_ref(), range))
            .collect::<Option<_>>()
            .map(RawValue::Numbers),
        (Kind::Rows, DeValue::Array(items)) if !items.is_empty() => items
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

/// Metres and decibels of a table alike.
const ROW_CELL: Range = Range {
    min: -1.0e5,
    min_included: true,
    max: 1.0e5,
};

fn type_fits(kind: &Kind, value: &DeValue<'_>) -> bool {
    match kind {
        Kind::Choice(..) => value.is_str(),
        Kind::Table(_) => value.is_table(),
        Kind::Rows => value.is_array(),
        _ => false,
    }
}

fn integer(value: &DeValue<'_>) -> Option<i64> {
    let integer = value.as_integer()?;
    i64::from_str_radix(integer.as_str(), integer.radix()).ok()
}

/// The digits of a number within `range`.
fn number(value: &DeValue<'_>, range: &Range) -> Option<String> {
    let digits = match value {
        DeValue::Float(float) => float.as_str().to_owned(),
        value => integer(value)?.to_string(),
    };
    let number: f64 = digits.parse().ok()?;
    // Written so that NaN falls through; the ends are finite, so infinity does too.
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

fn readable(path: &Path) -> Result<(), String> {
    let metadata = std::fs::metadata(path).map_err(|e| plain(&e))?;
    if !metadata.is_file() {
        return Err("not a file".to_owned());
    }
    std::fs::File::open(path).map(|_| ()).map_err(|e| plain(&e))
}

/// The error in words that are the same on every system.
pub(crate) fn plain(error: &std::io::Error) -> String {
    match error.kind() {
        std::io::ErrorKind::NotFound => "not found".to_owned(),
        std::io::ErrorKind::PermissionDenied => "no permission".to_owned(),
        _ => error.to_string(),
    }
}

/// The rule of a kind in words, fit after "must be".
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
        Kind::Number(range) => format!("a number {}", between(range)),
        Kind::Integer(min, i64::MAX) => format!("a whole number from {min} to 2^63 - 1"),
        Kind::Integer(min, max) => format!("a whole number from {min} to {max}"),
        Kind::Name => "a name in quotes: 1 to 32 letters, digits, '-' or '_'".to_owned(),
        Kind::Text => "text in quotes".to_owned(),
        Kind::File => "the name of a file in quotes".to_owned(),
        Kind::Folder => "the name of a folder in quotes, there or not".to_owned(),
        Kind::Choice(built, _) => quoted(built, "or"),
        Kind::Numbers(2, range) => {
            format!("two numbers [lowest, highest] {}", between(range))
        }
        Kind::Numbers(count, range) => format!("{count} numbers in brackets {}", between(range)),
        Kind::Rows => "pairs of numbers [[range_m, db], ...]".to_owned(),
        Kind::Names => "at least one name in brackets".to_owned(),
        Kind::Choices(built) => format!("in brackets some of {}", quoted(built, "and")),
        Kind::Table(table) => format!("a table of {}", key_names(table)),
        Kind::Tables(_) => "one or more tables, each under its own [[...]]".to_owned(),
        Kind::Either(first, second) => format!("{}, or {}", rule(first), rule(second)),
    }
}

fn between(range: &Range) -> String {
    match range.min_included {
        true => format!("from {} to {}", range.min, range.max),
        false => format!("above {}, at most {}", range.min, range.max),
    }
}

fn key_names(table: &Table) -> String {
    let names: Vec<_> = table.keys.iter().map(|k| k.name).collect();
    match names.is_empty() {
        true => "no keys".to_owned(),
        false => names.join(", "),
    }
}

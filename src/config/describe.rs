//! The template of a configuration, and its JSON Schema. Both are written from `keys`.

use std::sync::OnceLock;

use serde_json::{Map, Value, json};

use super::declaration::{Key, Kind, Presence, Range, Table};
use super::keys::Rig;
use super::raw::{Declared, max_items, rule};

/// Maximum number of columns of a line of the template.
const COLUMNS: usize = 110;
/// Column of the rule that follows a key.
const RULE_COLUMN: usize = 34;

/// A commented configuration with every key. Required keys have an example. The other keys are comments with their defaults.
pub fn template() -> &'static str {
    static TEXT: OnceLock<String> = OnceLock::new();
    TEXT.get_or_init(|| {
        let mut text = String::new();
        comment(&mut text, Rig::TABLE.doc);
        comment(
            &mut text,
            "All keys with their rules. A commented key shows its default, or an example if it has no default. \
             Names of keys end in the unit. Check with: echotank check FILE",
        );
        table(&mut text, &Rig::TABLE, "", false);
        text
    })
}

/// Writes `text` wrapped into comment lines.
fn comment(out: &mut String, text: &str) {
    let mut column = 0;
    for word in text.split_whitespace() {
        if column > 0 && column + 1 + word.len() > COLUMNS {
            out.push('\n');
            column = 0;
        }
        if column == 0 {
            out.push('#');
            column = 1;
        }
        out.push(' ');
        out.push_str(word);
        column += 1 + word.len();
    }
    if column > 0 {
        out.push('\n');
    }
}

/// Writes the keys of a table: values before tables, as TOML requires.
fn table(out: &mut String, declared: &Table, path: &str, commented_out: bool) {
    let is_table = |key: &&Key| matches!(key.kind, Kind::Table(_) | Kind::Tables(..));
    for key in declared.keys.iter().filter(|k| !is_table(k)) {
        value(out, key, commented_out);
    }
    for key in declared.keys.iter().filter(is_table) {
        let path = match path {
            "" => key.name.to_owned(),
            path => format!("{path}.{}", key.name),
        };
        let (inner, header) = match &key.kind {
            Kind::Table(inner) => (inner, format!("[{path}]")),
            Kind::Tables(inner, _) => (inner, format!("[[{path}]]")),
            _ => continue,
        };
        let commented_out = commented_out || matches!(key.presence, Presence::Optional(_));
        out.push('\n');
        comment(out, inner.doc);
        let mark = if commented_out { "# " } else { "" };
        out.push_str(&format!("{mark}{header}\n"));
        table(out, inner, &path, commented_out);
    }
}

fn value(out: &mut String, key: &Key, commented_out: bool) {
    let (shown, text, presence) = match key.presence {
        Presence::Required(example) => (true, example, "; required".to_owned()),
        Presence::Shown(example) => (true, example, String::new()),
        Presence::Optional(example) => (false, example, "; an example".to_owned()),
        Presence::Default(text) => (false, text, "; the default".to_owned()),
        Presence::Set(text, example) => (true, example, format!("; default {text}")),
    };
    let mark = if shown && !commented_out { "" } else { "# " };
    let assignment = format!("{mark}{} = {text}", key.name);
    let rule = format!("{}{presence}", rule(&key.kind));
    let one_line = format!("{assignment:RULE_COLUMN$} # {rule}");
    if one_line.len() <= COLUMNS {
        comment(out, key.doc);
        out.push_str(&one_line);
    } else {
        comment(out, &format!("{} [{rule}]", key.doc));
        out.push_str(&assignment);
    }
    out.push('\n');
}

/// JSON Schema (draft 2020-12) of a configuration. The schema does not cover rules between keys.
pub fn schema() -> String {
    let mut root = table_schema(&Rig::TABLE);
    root["$schema"] = json!("https://json-schema.org/draft/2020-12/schema");
    root["title"] = json!("echotank configuration");
    serde_json::to_string_pretty(&root).expect("text and finite numbers")
}

fn table_schema(declared: &Table) -> Value {
    let mut properties = Map::new();
    let mut required = Vec::new();
    for key in declared.keys {
        let mut schema = kind_schema(&key.kind);
        if !key.doc.is_empty() {
            schema["description"] = json!(key.doc.trim());
        }
        match key.presence {
            Presence::Required(_) => required.push(key.name),
            Presence::Default(text) | Presence::Set(text, _) => {
                schema["default"] = default_value(text);
            }
            _ => {}
        }
        properties.insert(key.name.to_owned(), schema);
    }
    json!({
        "type": "object",
        "description": declared.doc.trim(),
        "properties": properties,
        "required": required,
        "additionalProperties": false,
    })
}

fn kind_schema(kind: &Kind) -> Value {
    let array_of = |count: usize, items: Value| json!({ "type": "array", "items": items, "minItems": count, "maxItems": count });
    let some_of = |items: Value| json!({ "type": "array", "minItems": 1, "maxItems": max_items(kind), "items": items });
    match kind {
        Kind::Bool => json!({ "type": "boolean" }),
        Kind::Number(range, _) => range_schema(range),
        Kind::Integer(min, max, _) => json!({ "type": "integer", "minimum": min, "maximum": max }),
        Kind::Name => json!({ "type": "string", "pattern": "^[A-Za-z0-9_-]{1,32}$" }),
        Kind::Text | Kind::File | Kind::Folder => json!({ "type": "string", "minLength": 1 }),
        Kind::Choice(built, _) => json!({ "enum": built }),
        Kind::Numbers(count, range, _) => array_of(*count, range_schema(range)),
        Kind::Rows(_) => some_of(array_of(2, json!({ "type": "number" }))),
        Kind::Names => some_of(kind_schema(&Kind::Name)),
        Kind::Choices(built) => some_of(json!({ "enum": built })),
        Kind::Table(inner) => table_schema(inner),
        Kind::Tables(inner, _) => some_of(table_schema(inner)),
        Kind::Either(first, second) => {
            json!({ "anyOf": [kind_schema(first), kind_schema(second)] })
        }
    }
}

fn range_schema(range: &Range) -> Value {
    let least = match range.min_included {
        true => "minimum",
        false => "exclusiveMinimum",
    };
    json!({ "type": "number", least: range.min, "maximum": range.max })
}

/// Converts the TOML text of a default to JSON.
fn default_value(text: &str) -> Value {
    let parsed: Option<toml::Table> = format!("v = {text}").parse().ok();
    let value = parsed.and_then(|mut table| table.remove("v"));
    serde_json::to_value(value).expect("a default is plain data")
}

//! Keys of the commands, and refusals in the words of their user: from JSON ([`parse`]) or from `KEY=VALUE` pairs ([`from_pairs`]).

use serde_json::{Map, Value, json};

use super::Command;
use echotank_config::did_you_mean;

/// Type of a value.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum ValueType {
    Number,
    /// Whole number from 0.
    Count,
    Bool,
    Text,
    Word(&'static [&'static str]),
    /// Pairs of numbers.
    Pairs,
}

use ValueType::{Bool, Count, Number, Pairs, Text, Word};

type Keys = &'static [(&'static str, ValueType)];

/// The commands and their keys.
const COMMANDS: [(&str, Keys); 10] = [
    ("pause", &[]),
    ("resume", &[]),
    ("step", &[("pings", Count)]),
    (
        "set",
        &[
            ("sonar", Text),
            ("range_m", Number),
            ("rate_hz", Number),
            ("source_level_db", Number),
            ("gain_db", Number),
            ("pulse_ms", Number),
            ("pinging", Bool),
            ("trigger", Word(&["internal", "external"])),
        ],
    ),
    ("trigger", &[("sonar", Text), ("pings", Count)]),
    (
        "fault",
        &[
            ("kind", Text),
            ("sonar", Text),
            ("array", Count),
            ("element", Count),
            ("other", Count),
            ("source", Text),
            ("quantity", Text),
            ("value", Number),
            ("at_s", Number),
            ("for_s", Number),
            ("ramp_s", Number),
            ("probability", Number),
            ("burst", Count),
            ("seed", Count),
        ],
    ),
    ("clear-faults", &[("fault", Count)]),
    ("record", &[("sonar", Text), ("on", Bool)]),
    ("profile", &[("points", Pairs)]),
    (
        "clock",
        &[
            ("mode", Word(&["realtime", "scaled", "fast", "lockstep"])),
            ("rate", Number),
        ],
    ),
];

impl ValueType {
    fn rule(self) -> String {
        match self {
            Number => "must be a finite number, without a unit".to_owned(),
            Count => "must be a whole number from 0".to_owned(),
            Bool => "must be true or false".to_owned(),
            Text => "must be a name".to_owned(),
            Word(words) => format!("must be one of {}", words.join(", ")),
            Pairs => "must be pairs of numbers [[depth_m, m_per_s], ...]".to_owned(),
        }
    }

    /// Whether a JSON value has this type. `null` stands for an absent key.
    fn takes(self, value: &Value) -> bool {
        match self {
            _ if value.is_null() => true,
            Number => value.as_f64().is_some_and(f64::is_finite),
            Count => value.is_u64(),
            Bool => value.is_boolean(),
            Text => value.is_string(),
            Word(words) => value.as_str().is_some_and(|word| words.contains(&word)),
            Pairs => value.as_array().is_some_and(|rows| {
                let is_pair = |row: &Value| {
                    let row = row.as_array().filter(|row| row.len() == 2);
                    row.is_some_and(|row| row.iter().all(Value::is_number))
                };
                rows.iter().all(is_pair)
            }),
        }
    }

    /// The JSON value of a text.
    fn read(self, text: &str) -> Value {
        match self {
            Number => text.parse::<f64>().map_or(Value::Null, Value::from),
            Count => text.parse::<u64>().map_or(Value::Null, Value::from),
            Bool => text.parse::<bool>().map_or(Value::Null, Value::from),
            Text | Word(_) => json!(text),
            Pairs => serde_json::from_str(text).unwrap_or(Value::Null),
        }
    }
}

/// The refusal of a name that is not one of `names`.
fn unknown<'a>(what: &str, name: &str, names: impl Iterator<Item = &'a str> + Clone) -> String {
    let known: Vec<_> = names.clone().collect();
    let hint = did_you_mean(name, names).map_or(String::new(), |hint| format!("{hint} "));
    format!("{what}; {hint}Known are {}", known.join(", "))
}

fn keys_of(command: &str) -> Result<Keys, String> {
    let known = COMMANDS.iter().find(|(name, _)| *name == command);
    known.map(|(_, keys)| *keys).ok_or_else(|| {
        let what = format!("do = {}: unknown command", json!(command));
        unknown(&what, command, COMMANDS.iter().map(|(name, _)| *name))
    })
}

fn type_of(command: &str, keys: Keys, key: &str) -> Result<ValueType, String> {
    let known = keys.iter().find(|(name, _)| *name == key);
    known.map(|(_, value_type)| *value_type).ok_or_else(|| {
        let what = format!("{key}: \"{command}\" has no such key");
        match keys.is_empty() {
            true => what,
            false => unknown(&what, key, keys.iter().map(|(name, _)| *name)),
        }
    })
}

/// Refuses a value of another type, or a word that is not one of the type's.
fn refuse_other_type(key: &str, value_type: ValueType, text: &str) -> String {
    let hint = match value_type {
        Word(words) => did_you_mean(text.trim_matches('"'), words.iter().copied()),
        _ => None,
    };
    let hint = hint.map_or(String::new(), |hint| format!("; {hint}"));
    format!("{key} = {text}: {}{hint}", value_type.rule())
}

/// Reads a command.
///
/// # Errors
/// What is wrong, and what is possible.
pub fn parse(value: &Value) -> Result<Command, String> {
    const EXAMPLE: &str = "for example {\"do\": \"step\", \"pings\": 3}";
    let Some(table) = value.as_object() else {
        return Err(format!("a command is a JSON object, {EXAMPLE}"));
    };
    let command = match table.get("do") {
        Some(Value::String(command)) => command.as_str(),
        Some(other) => return Err(format!("do = {other}: must be the name of a command")),
        None => return Err(format!("`do` is missing, {EXAMPLE}")),
    };
    let keys = keys_of(command)?;
    for (key, value) in table.iter().filter(|(key, _)| *key != "do") {
        let value_type = type_of(command, keys, key)?;
        if !value_type.takes(value) {
            return Err(refuse_other_type(key, value_type, &value.to_string()));
        }
    }
    for (of, key) in [
        ("clock", "mode"),
        ("fault", "kind"),
        ("record", "on"),
        ("profile", "points"),
    ] {
        if command == of && table.get(key).is_none_or(Value::is_null) {
            let rule = type_of(command, keys, key)?.rule();
            return Err(format!("{key} is missing: {rule}"));
        }
    }
    let mut given = table.clone();
    given.retain(|_, value| !value.is_null());
    serde_json::from_value(Value::Object(given)).map_err(|error| format!("{command}: {error}"))
}

/// A command with `KEY=VALUE` pairs.
///
/// # Errors
/// The pair, what is wrong with it, and what is possible.
pub fn from_pairs(command: &str, pairs: &[String]) -> Result<Map<String, Value>, String> {
    let keys = keys_of(command)?;
    let mut table = Map::from_iter([("do".to_owned(), json!(command))]);
    for pair in pairs {
        let Some((key, text)) = pair.split_once('=') else {
            let key = pair.trim_start_matches('-').replace('-', "_");
            let hint = did_you_mean(&key, keys.iter().map(|(name, _)| *name));
            let hint = hint.map_or(String::new(), |hint| format!("; {hint}"));
            return Err(format!("{pair}: expected KEY=VALUE{hint}"));
        };
        let value_type = type_of(command, keys, key)?;
        let value = value_type.read(text);
        if value.is_null() || !value_type.takes(&value) {
            return Err(refuse_other_type(key, value_type, text));
        }
        if table.insert(key.to_owned(), value).is_some() {
            return Err(format!("{pair}: {key} is given twice"));
        }
    }
    Ok(table)
}

#[cfg(test)]
mod tests {
    use super::super::Settings;
    use super::*;

    fn refusal(value: Value) -> String {
        parse(&value).expect_err("refused")
    }

    #[test]
    fn commands_are_read_and_wrong_ones_answered_in_own_words() {
        let set = parse(&json!({"do": "set", "range_m": 40, "gain_db": null}));
        let wanted = Settings {
            range_m: Some(40.0),
            ..Settings::default()
        };
        assert_eq!(set, Ok(Command::Set(wanted)));
        assert_eq!(
            parse(&json!({"do": "step"})),
            Ok(Command::Step { pings: 1 })
        );
        for (value, words) in [
            (json!([1]), "a command is a JSON object"),
            (json!({"pings": 3}), "`do` is missing"),
            (json!({"do": 3}), "do = 3: must be the name"),
            (
                json!({"do": "stop"}),
                "did you mean \"step\"? Known are pause,",
            ),
            (
                json!({"do": "set", "rang_m": 40}),
                "did you mean \"range_m\"?",
            ),
            (
                json!({"do": "pause", "pings": 1}),
                "\"pause\" has no such key",
            ),
            (
                json!({"do": "set", "range_m": "40"}),
                "range_m = \"40\": must be a finite number",
            ),
            (
                json!({"do": "step", "pings": -1}),
                "pings = -1: must be a whole number",
            ),
            (
                json!({"do": "set", "trigger": "externl"}),
                "must be one of internal, external; did you mean \"external\"?",
            ),
            (
                json!({"do": "record"}),
                "on is missing: must be true or false",
            ),
            (
                json!({"do": "profile", "points": [[0, 1500], [5]]}),
                "points = [[0,1500],[5]]: must be pairs of numbers",
            ),
            (json!({"do": "profile"}), "points is missing: must be pairs"),
            (
                json!({"do": "clock"}),
                "mode is missing: must be one of realtime, scaled",
            ),
        ] {
            let said = refusal(value.clone());
            assert!(said.contains(words), "{value}: {said}");
        }
    }

    #[test]
    fn pairs_have_the_types_of_their_keys() {
        let pairs = |pairs: &[&str]| {
            let pairs: Vec<_> = pairs.iter().map(|&pair| pair.to_owned()).collect();
            from_pairs("set", &pairs)
        };
        let table = pairs(&["sonar=7", "range_m=75", "pinging=true"]).expect("reads");
        let wanted = json!({"do": "set", "sonar": "7", "range_m": 75.0, "pinging": true});
        assert_eq!(Value::Object(table), wanted);
        for (pair, words) in [
            ("--range-m", "expected KEY=VALUE; did you mean \"range_m\"?"),
            ("rnage_m=3", "did you mean \"range_m\"?"),
            (
                "range_m=75m",
                "range_m = 75m: must be a finite number, without a unit",
            ),
            ("range_m=nan", "must be a finite number"),
            ("pinging=yes", "must be true or false"),
        ] {
            let said = pairs(&[pair]).expect_err("refused");
            assert!(said.contains(words), "{pair}: {said}");
        }
        let twice = pairs(&["gain_db=1", "gain_db=2"]).expect_err("twice");
        assert!(twice.contains("given twice"), "{twice}");
    }

    /// The table here has every key that the types of the commands have, and no other.
    #[test]
    fn every_key_of_a_setting_and_of_a_fault_is_known() {
        let value_of = |value_type| match value_type {
            Number => json!(1.5),
            Count => json!(1),
            Bool => json!(true),
            Text => json!("a"),
            Word(words) => json!(words[0]),
            Pairs => json!([[0.0, 1500.0]]),
        };
        for (command, keys) in COMMANDS {
            let all = keys.iter().map(|&(key, t)| (key.to_owned(), value_of(t)));
            let mut table = Map::from_iter(all);
            table.insert("do".to_owned(), json!(command));
            let read = parse(&Value::Object(table.clone())).expect(command);
            let written = serde_json::to_value(read).expect("JSON");
            assert_eq!(written, Value::Object(table), "{command}");
        }
    }
}

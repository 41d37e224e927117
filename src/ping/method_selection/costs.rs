//! Cost model of the stages: a table of figures of one core, either the one that comes with the program or one that `echotank check --calibrate`
//! has measured.
//!
//! A method's cost is the sum of its amounts of work ([`Work`]), each times its figure in nanoseconds. The engines' own cost estimates are work too,
//! in their own nanoseconds; their figures are near 1.

use std::collections::BTreeMap;
use std::fmt::Write;

use serde::Deserialize;
use thiserror::Error;

use crate::work::{Figure, Work};

/// The table that comes with the program.
const COMMITTED: &str = include_str!("costs.toml");

/// A table of costs that cannot be used. `path` names the file, `key` the figure.
#[derive(Debug, Error)]
pub enum CostsError {
    /// The text is not TOML of the expected form.
    #[error("{path}: {why}")]
    Parse {
        /// The file.
        path: String,
        /// The message of the TOML parser.
        why: Box<toml::de::Error>,
    },
    /// A figure is missing.
    #[error("{path}: ns.{key} is missing")]
    Missing {
        /// The file.
        path: String,
        /// The figure.
        key: &'static str,
    },
    /// A key is no figure.
    #[error("{path}: ns.{key}: unknown cost; must be one of {}", names())]
    Unknown {
        /// The file.
        path: String,
        /// The key that is no figure.
        key: String,
    },
    /// A figure is not a positive, finite number.
    #[error("{path}: ns.{key} = {value}: must be above 0 and finite")]
    Value {
        /// The file.
        path: String,
        /// The figure.
        key: &'static str,
        /// Its value, nanoseconds.
        value: f64,
    },
}

fn names() -> String {
    let all: Vec<&str> = Figure::ALL.iter().map(|figure| figure.name()).collect();
    all.join(", ")
}

/// A table of costs.
#[derive(Clone, Debug, PartialEq)]
pub struct Costs {
    /// The machine of the measurement, and how it was measured.
    pub machine: String,
    /// Nanoseconds of one core for each unit of work.
    pub ns: Work,
}

/// As the file has it.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Table {
    machine: String,
    ns: BTreeMap<String, f64>,
}

impl Costs {
    /// The table that comes with the program.
    pub fn committed() -> Self {
        Self::parse(COMMITTED, "the committed table of costs")
            .expect("costs.toml is checked by a test")
    }

    /// The table in `text`; `path` names it in errors.
    pub fn parse(text: &str, path: &str) -> Result<Self, CostsError> {
        let path = || path.to_owned();
        let mut table: Table = toml::from_str(text).map_err(|why| CostsError::Parse {
            path: path(),
            why: Box::new(why),
        })?;
        let mut ns = Work::NONE;
        for &figure in Figure::ALL {
            let key = figure.name();
            let value = table.ns.remove(key);
            let value = value.ok_or_else(|| CostsError::Missing { path: path(), key })?;
            if !(value > 0.0 && value.is_finite()) {
                let path = path();
                return Err(CostsError::Value { path, key, value });
            }
            ns[figure] = value;
        }
        if let Some((key, _)) = table.ns.pop_first() {
            return Err(CostsError::Unknown { path: path(), key });
        }
        Ok(Self {
            machine: table.machine,
            ns,
        })
    }

    /// Milliseconds of one core.
    pub fn ms(&self, work: &Work) -> f64 {
        let ns = Figure::ALL.iter().map(|&f| self.ns[f] * work[f]);
        1e-6 * ns.sum::<f64>()
    }

    /// As a file.
    pub fn text(&self) -> String {
        let mut text = format!(
            "# What the stages cost: nanoseconds of one core for each unit of work. Written by `echotank check CONFIG --calibrate FILE`; used with\n\
             # `--costs FILE` or run.costs.\nmachine = {}\n\n[ns]\n",
            toml::Value::from(self.machine.as_str())
        );
        for &figure in Figure::ALL {
            let (name, value) = (figure.name(), self.ns[figure]);
            let _ = writeln!(text, "{name} = {value:?} # {}", figure.meaning());
        }
        text
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_committed_table_is_whole_and_a_table_reads_back_as_it_was_written() {
        let committed = Costs::committed();
        assert_eq!(
            Costs::parse(&committed.text(), "text").expect("reads back"),
            committed
        );
        let said = |ns: &str| {
            let text = committed.text();
            let (head, tail) = text.split_once("chord = ").expect("there");
            let (_, tail) = tail.split_once(' ').expect("a meaning follows");
            let text = format!("{head}{ns} {tail}");
            let broken = Costs::parse(&text, "costs.toml");
            broken.expect_err("broken").to_string()
        };
        assert_eq!(
            said("chord = 0.0"),
            "costs.toml: ns.chord = 0: must be above 0 and finite"
        );
        assert_eq!(said("#"), "costs.toml: ns.chord is missing");
        let unknown = said("chord = 1.0\nchords = 1.0");
        assert!(
            unknown
                .starts_with("costs.toml: ns.chords: unknown cost; must be one of ping, element,"),
            "{unknown}"
        );
    }

    #[test]
    fn every_figure_has_a_name_of_its_own() {
        let mut names: Vec<&str> = Figure::ALL.iter().map(|f| f.name()).collect();
        names.sort_unstable();
        names.dedup();
        assert_eq!(names.len(), crate::work::FIGURES);
    }
}

//! Results of a measurement: text as it is printed, and rows that are kept as JSON.

use std::path::{Path, PathBuf};

use clap::Args;

use super::machine;

/// Options of every measurement.
#[derive(Args)]
pub(crate) struct Common {
    /// The short form, to keep the command working.
    #[arg(long)]
    pub(crate) quick: bool,
    /// Also write the results as JSON.
    #[arg(long, value_name = "FILE")]
    pub(crate) json: Option<PathBuf>,
}

/// One measurement's results.
pub(crate) struct Report {
    machine: String,
    text: String,
    rows: Vec<serde_json::Value>,
}

impl Report {
    /// Prints the machine and its load.
    pub(crate) fn new() -> Self {
        let machine = machine::describe();
        println!("{machine}");
        Self {
            machine,
            text: String::new(),
            rows: Vec::new(),
        }
    }

    /// Text as it is printed and may be kept; a line ends where it says so.
    pub(crate) fn print(&mut self, text: &str) {
        print!("{text}");
        self.text += text;
    }

    /// A row of the JSON without a line of text.
    pub(crate) fn keep(&mut self, row: serde_json::Value) {
        self.rows.push(row);
    }

    /// A line as it is printed, and as it is kept; the load is added to that.
    pub(crate) fn row(&mut self, line: &str, mut kept: serde_json::Value) {
        println!("{line}");
        kept["load"] = machine::load().into();
        self.rows.push(kept);
    }

    /// Other rows for the JSON.
    pub(crate) fn rows_anew(&mut self, rows: &[impl serde::Serialize]) -> Result<(), String> {
        let values = rows.iter().map(serde_json::to_value);
        self.rows = values
            .collect::<Result<_, _>>()
            .map_err(|e| e.to_string())?;
        Ok(())
    }

    /// Writes the rows, if a file was asked for, with the command, the machine and the day.
    pub(crate) fn finish(&self, json: Option<&Path>) -> Result<(), String> {
        let Some(path) = json else {
            return Ok(());
        };
        let document = serde_json::json!({
            "command": command(), "machine": self.machine, "date": machine::today(), "rows": self.rows,
        });
        std::fs::write(path, format!("{document:#}\n"))
            .map_err(|e| format!("{}: {e}", path.display()))
    }

    /// Writes the text to a table in tools/kept, under the command, the machine and the day.
    pub(crate) fn keep_text(&self, name: &str) -> Result<(), String> {
        let path = kept(name);
        let head = format!("# {}; {}; {}\n", command(), self.machine, machine::today());
        std::fs::write(&path, head + &self.text).map_err(|e| format!("{}: {e}", path.display()))
    }
}

/// A table of results that the repository keeps and that tests compare with.
pub(crate) fn kept(name: &str) -> PathBuf {
    crate::repository().join("tools/kept").join(name)
}

fn command() -> String {
    let given: Vec<String> = std::env::args().skip(1).collect();
    format!("tools/{}", given.join(" "))
}

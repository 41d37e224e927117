//! Results of a measurement: printed text, and rows for JSON.

use std::path::{Path, PathBuf};

use clap::Args;

use super::machine;

/// Options of all measurements.
#[derive(Args)]
pub(crate) struct Common {
    /// The short form, to keep the command working.
    #[arg(long)]
    pub(crate) quick: bool,
    /// Also write the results as JSON.
    #[arg(long, value_name = "FILE")]
    pub(crate) json: Option<PathBuf>,
}

/// Results of one measurement.
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

    /// Prints text, and stores it for a table. The text includes its line ends.
    pub(crate) fn print(&mut self, text: &str) {
        print!("{text}");
        self.text += text;
    }

    /// Adds a row to the JSON without printing a line.
    pub(crate) fn keep(&mut self, row: serde_json::Value) {
        self.rows.push(row);
    }

    /// Prints a line, and adds a row to the JSON with the load of the machine.
    pub(crate) fn row(&mut self, line: &str, mut kept: serde_json::Value) {
        println!("{line}");
        kept["load"] = machine::load().into();
        self.rows.push(kept);
    }

    /// Replaces the rows of the JSON.
    pub(crate) fn rows_anew(&mut self, rows: &[impl serde::Serialize]) -> Result<(), String> {
        let values = rows.iter().map(serde_json::to_value);
        self.rows = values
            .collect::<Result<_, _>>()
            .map_err(|e| e.to_string())?;
        Ok(())
    }

    /// Writes the rows, if a file is given, with the command, the machine and the day.
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

    /// Writes the text to a table in tools/kept, below the command, the machine and the day.
    pub(crate) fn keep_text(&self, name: &str) -> Result<(), String> {
        let path = kept(name);
        let head = format!("# {}; {}; {}\n", command(), self.machine, machine::today());
        std::fs::write(&path, head + &self.text).map_err(|e| format!("{}: {e}", path.display()))
    }
}

/// Path of a table of results that the repository keeps and that tests compare with.
pub(crate) fn kept(name: &str) -> PathBuf {
    crate::repository().join("tools/kept").join(name)
}

fn command() -> String {
    let given: Vec<String> = std::env::args().skip(1).collect();
    format!("tools/{}", given.join(" "))
}

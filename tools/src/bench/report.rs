//! Rows of a table, printed as they come and kept as JSON.

use std::path::Path;

use super::machine;

/// One benchmark's outcome.
pub(crate) struct Report {
    machine: String,
    rows: Vec<serde_json::Value>,
}

impl Report {
    /// Prints the machine and its load.
    pub(crate) fn new() -> Self {
        let machine = machine::describe();
        println!("{machine}");
        Self {
            machine,
            rows: Vec::new(),
        }
    }

    /// A line as it is printed, and as it is kept; the load is added to that.
    pub(crate) fn row(&mut self, line: &str, mut kept: serde_json::Value) {
        println!("{line}");
        kept["load"] = machine::load().into();
        self.rows.push(kept);
    }

    /// Writes the rows, if a file was asked for.
    pub(crate) fn keep(self, json: Option<&Path>) -> Result<(), String> {
        let Some(path) = json else {
            return Ok(());
        };
        let document = serde_json::json!({ "machine": self.machine, "rows": self.rows });
        std::fs::write(path, format!("{document:#}\n"))
            .map_err(|e| format!("{}: {e}", path.display()))
    }
}

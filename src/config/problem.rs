//! Problems of a configuration.

use std::fmt;
use std::path::PathBuf;

/// One problem of a configuration. It prints as one line.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Problem {
    /// Path of the key, such as `sonar[0].pulse.duration_ms`. Empty for a file that is not TOML or cannot be read.
    pub path: String,
    /// Line in the file, from 1; `None` if the problem has no line.
    pub line: Option<usize>,
    /// Value as written in the file, shortened; empty without a value.
    pub value: String,
    /// The violated rule.
    pub rule: String,
    /// Proposed correction.
    pub hint: Option<String>,
}

impl fmt::Display for Problem {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        if let Some(line) = self.line {
            write!(f, "line {line}: ")?;
        }
        f.write_str(&self.path)?;
        if !self.value.is_empty() {
            let equals = if self.path.is_empty() { "" } else { " = " };
            write!(f, "{equals}{}", self.value)?;
        }
        if !(self.path.is_empty() && self.value.is_empty()) {
            f.write_str(": ")?;
        }
        f.write_str(&self.rule)?;
        if let Some(hint) = &self.hint {
            write!(f, "; {hint}")?;
        }
        Ok(())
    }
}

/// All problems of one configuration. They print as one line each.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ConfigErrors {
    /// The configuration file, printed first.
    pub file: Option<PathBuf>,
    /// Problems in the order of their lines.
    pub problems: Vec<Problem>,
}

impl ConfigErrors {
    /// The problems without their lines, for a text that is not the file's.
    pub fn without_lines(mut self) -> Self {
        for problem in &mut self.problems {
            problem.line = None;
        }
        self
    }
}

impl fmt::Display for ConfigErrors {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        if let Some(file) = &self.file {
            let count = self.problems.len();
            let plural = if count == 1 { "" } else { "s" };
            writeln!(f, "{}: {count} problem{plural}", file.display())?;
        }
        for (i, problem) in self.problems.iter().enumerate() {
            if i > 0 {
                f.write_str("\n")?;
            }
            write!(f, "{problem}")?;
        }
        Ok(())
    }
}

impl std::error::Error for ConfigErrors {}

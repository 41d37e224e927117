//! Findings of a listener or another device, as JSON lines. `echotank score` compares the findings with the fault log.
//!
//! ```text
//! {"report": "my topside", "line": "7k", "covers": [7000, 7038], "detects": ["drop", "duplicate"], "first_ping": 1, "last_ping": 900}
//! {"kind": "lost", "ping_number": 17, "record_type": 7038}
//! {"kind": "silent", "ping_number": 40, "to_ping": 46}
//! {"kind": "dead", "ping_number": 100, "to_ping": 180, "array": 0, "element": 3}
//! ```
//!
//! A line with `report` is a head; without a head the report covers everything. Every other line is a finding. A report claims only the listed
//! faults; unknown keys are ignored.

use crate::io::json_problem;
use serde::{Deserialize, Serialize};

/// Scope of a report.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct ReportHead {
    /// Name of the reporter.
    pub report: String,
    /// Protocol family, as in the fault log; `None`: all.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub line: Option<String>,
    /// Sonar name; `None`: all.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub sonar: Option<String>,
    /// Record types covered; `None`: all.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub covers: Option<Vec<u32>>,
    /// Kinds of faults that the reporter can detect; `None` means all.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub detects: Option<Vec<String>>,
    /// First ping received.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub first_ping: Option<u32>,
    /// Last ping received.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub last_ping: Option<u32>,
    /// VITA 49: time of the first packet, ns since 1970 UTC.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub from_utc_ns: Option<i64>,
    /// VITA 49: time of the last packet, ns since 1970 UTC.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub to_utc_ns: Option<i64>,
}

/// One observed fault.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct Finding {
    /// `lost`, `duplicate`, `late`, `damaged` (by its own checksum or length), `different` (from the reference run), `reset`, `silent`, or the name of a
    /// kind of fault.
    pub kind: String,
    /// Sonar name.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub sonar: Option<String>,
    /// The ping, or the first of several up to `to_ping`.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub ping_number: Option<u32>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) to_ping: Option<u32>,
    /// Record type, as in the fault log.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub record_type: Option<u32>,
    /// Frame number of an element stream.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub frame_number: Option<u32>,
    /// VITA 49 stream identifier.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub stream: Option<u32>,
    /// VITA 49: whether it is a context packet.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub context: Option<bool>,
    /// VITA 49: packet time or lower bound, ns since 1970 UTC.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub from_utc_ns: Option<i64>,
    /// VITA 49: packet time or upper bound, ns since 1970 UTC.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub to_utc_ns: Option<i64>,
    /// Index of the receive array.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub array: Option<usize>,
    /// Index of the element within its array.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub element: Option<usize>,
    /// Name of the navigation source.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub source: Option<String>,
    /// Name of the navigation quantity.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub quantity: Option<String>,
}

/// A parsed report.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Report {
    /// Scope.
    pub head: ReportHead,
    /// Findings in the order of their lines.
    pub findings: Vec<Finding>,
}

/// A line that is neither a head nor a finding.
#[derive(Debug, thiserror::Error)]
#[error("line {line}: {why}")]
pub struct ReportError {
    /// Line number, from 1.
    pub line: usize,
    /// Error of the line.
    pub why: String,
}

impl Report {
    /// Parses JSON lines; empty lines are skipped.
    ///
    /// # Errors
    /// [`ReportError`] for the first malformed line.
    pub fn parse(text: &str) -> Result<Self, ReportError> {
        let mut report = Self::default();
        for (at, line) in text.lines().enumerate() {
            if line.trim().is_empty() {
                continue;
            }
            let refused = |why: String| ReportError { line: at + 1, why };
            let value: serde_json::Value =
                serde_json::from_str(line).map_err(|why| refused(json_problem(&why)))?;
            let has = |key| value.get(key).is_some();
            let done = if has("report") {
                serde_json::from_value(value).map(|head| report.head = head)
            } else if has("kind") {
                serde_json::from_value(value).map(|finding| report.findings.push(finding))
            } else {
                return Err(refused("neither `report` nor `kind`".into()));
            };
            done.map_err(|why| refused(json_problem(&why)))?;
        }
        Ok(report)
    }

    /// Formats the report as JSON lines.
    pub fn text(&self) -> String {
        let mut text = serde_json::json!(self.head).to_string() + "\n";
        for finding in &self.findings {
            text += &serde_json::json!(finding).to_string();
            text.push('\n');
        }
        text
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_report_survives_its_own_text_and_says_where_it_is_wrong() {
        let report = Report {
            head: ReportHead {
                report: "a topside".into(),
                covers: Some(vec![7038]),
                ..ReportHead::default()
            },
            findings: vec![Finding {
                kind: "lost".into(),
                ping_number: Some(3),
                record_type: Some(7038),
                ..Finding::default()
            }],
        };
        assert_eq!(Report::parse(&report.text()).expect("sound"), report);
        let more = "{\"kind\": \"late\", \"ping_number\": 9, \"mine\": true}\n\n";
        let findings = Report::parse(more).expect("keys of unnumbered").findings;
        assert_eq!((findings.len(), findings[0].ping_number), (1, Some(9)));
        for (text, line) in [
            ("{}", 1),
            ("\n{\"kind\": 3}", 2),
            ("nothing", 1),
            ("{\"kind\": \"lost\", \"ping_number\": -1}", 1),
        ] {
            let error = Report::parse(text).expect_err(text);
            assert_eq!(error.line, line, "{text}: {error}");
        }
    }
}

//! Cells and lines of the tables.

use super::case::Case;
use super::measure::{self, Truth, WorstWindow};
use super::methods::{Chosen, Method, Ready, Reason, Refused};

/// Requested tolerances.
pub(crate) const TOLERANCES: [f64; 8] = [1e-1, 1e-2, 1e-3, 1e-4, 1e-5, 1e-6, 1e-7, 1e-8];

/// Result of one method at one tolerance.
pub(crate) struct Cell {
    pub(crate) tolerance: f64,
    pub(crate) outcome: Result<Measured, Refused>,
}

#[derive(Clone, Debug)]
pub(crate) struct Measured {
    pub(crate) error: WorstWindow,
    pub(crate) predicted: f64,
    pub(crate) chosen: Chosen,
}

impl Cell {
    /// Whether the method refused, or is within the tolerance by this measure.
    pub(crate) fn holds(&self, error: Measure) -> bool {
        let good = |m: &Measured| error(&m.error) <= self.tolerance;
        self.outcome.as_ref().map_or(true, good)
    }

    pub(crate) fn json(&self, case: &Case, method: Method) -> serde_json::Value {
        let measured = self.outcome.as_ref();
        serde_json::json!({
            "scene": case.scene, "motion": case.motion, "method": method.name(), "tolerance": self.tolerance,
            "error": measured.ok().map(|m| m.error.in_noise), "beside": measured.ok().map(|m| m.error.beside),
            "predicted": measured.ok().map(|m| m.predicted), "models": measured.ok().map(|m| m.chosen.text()),
            "refused": measured.err().map(|refused| &refused.message),
        })
    }

    /// The error by this measure, marked if above the tolerance, or the reason of refusal.
    pub(crate) fn text(&self, error: Measure) -> String {
        match &self.outcome {
            Ok(m) if self.holds(error) => figure(error(&m.error)),
            Ok(m) => format!("!{}", figure(error(&m.error))),
            Err(refused) => match refused.by {
                Reason::Model => "model",
                Reason::Sum => "sum",
            }
            .to_string(),
        }
    }
}

pub(crate) fn figure(error: f64) -> String {
    format!("{error:.1e}")
}

/// One of the three measures of an error.
pub(crate) type Measure = fn(&WorstWindow) -> f64;

/// Printed measures, line by line.
pub(crate) const MEASURES: [(&str, Measure); 3] = [
    ("", |e| e.in_noise),
    ("  beside", |e| e.beside),
    ("  no noise", |e| e.without_noise),
];

/// Results of one method for one case, by tolerance.
pub(crate) struct Row {
    pub(crate) method: Method,
    pub(crate) cells: Vec<Cell>,
    /// Error without a requested tolerance.
    pub(crate) as_it_is: Option<WorstWindow>,
}

impl Row {
    pub(crate) fn of(method: Method, case: &Case, truth: &Truth, tolerances: &[f64]) -> Self {
        let mut known: Vec<(Chosen, WorstWindow)> = Vec::new();
        // A synthesis without a tolerance has the same error at all tolerances.
        let mut error_of = |(chosen, ready): (Chosen, Ready)| {
            let of = known.iter().find(|(c, _)| *c == chosen).map(|k| k.1);
            let error = of.unwrap_or_else(|| {
                let records = method.records(case, &chosen, ready);
                measure::error(case, truth, &records)
            });
            known.push((chosen.clone(), error));
            Measured {
                error,
                predicted: chosen.predicted,
                chosen,
            }
        };
        let cells = tolerances
            .iter()
            .map(|&tolerance| Cell {
                tolerance,
                outcome: method.within(tolerance, case, truth).map(&mut error_of),
            })
            .collect();
        let as_it_is = method.as_it_is(case, truth).map(|c| error_of(c).error);
        Self {
            method,
            cells,
            as_it_is,
        }
    }

    /// Cells above their tolerance with noise floor.
    pub(crate) fn broken(&self) -> impl Iterator<Item = &Cell> {
        self.cells.iter().filter(|cell| !cell.holds(|e| e.in_noise))
    }

    /// A line for each of [`MEASURES`].
    pub(crate) fn text(&self, case: &Case) -> String {
        let mut text = String::new();
        for (k, (name, error)) in MEASURES.into_iter().enumerate() {
            let (scene, motion, method) = match k {
                0 => (
                    case.scene.as_str(),
                    case.motion.as_str(),
                    self.method.name(),
                ),
                _ => ("", "", name),
            };
            let as_it_is = self
                .as_it_is
                .as_ref()
                .map_or("-".into(), |e| figure(error(e)));
            text += &format!("{scene:<18} {motion:<22} {method:<10} {as_it_is:>8}");
            for cell in &self.cells {
                // A refusal is printed only once.
                let shown = if k == 0 || cell.outcome.is_ok() {
                    cell.text(error)
                } else {
                    String::new()
                };
                text += &format!(" {shown:>8}");
            }
            text.truncate(text.trim_end().len());
            text += "\n";
        }
        text
    }
}

pub(crate) fn heading() -> String {
    let mut line = format!(
        "{:<18} {:<22} {:<10} {:>8}",
        "scene", "motion", "method", "as it is"
    );
    for tolerance in TOLERANCES {
        line += &format!(" {:>8}", format!("{tolerance:.0e}"));
    }
    line
}

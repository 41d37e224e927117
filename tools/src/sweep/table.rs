//! Cells and lines of the tables.

use super::case::Case;
use super::measure::{self, Truth, WorstWindow};
use super::methods::{Chosen, Method, Reason, Refused};

/// Tolerances asked for.
pub const TOLERANCES: [f64; 8] = [1e-1, 1e-2, 1e-3, 1e-4, 1e-5, 1e-6, 1e-7, 1e-8];

/// One method asked for one tolerance.
pub struct Cell {
    pub tolerance: f64,
    pub outcome: Result<Measured, Refused>,
}

#[derive(Clone, Debug)]
pub struct Measured {
    pub error: WorstWindow,
    pub predicted: f64,
    pub chosen: Chosen,
}

impl Cell {
    /// Refused, or as good as asked.
    pub fn holds(&self) -> bool {
        self.outcome.as_ref().map_or(true, |m| {
            m.error.itself.max(m.error.silence) <= self.tolerance
        })
    }

    /// The same, each window against those beside it.
    pub fn holds_beside(&self) -> bool {
        self.outcome.as_ref().map_or(true, |m| {
            m.error.beside.max(m.error.silence) <= self.tolerance
        })
    }

    pub fn text(&self) -> String {
        match &self.outcome {
            Ok(m) if self.holds() => format!("{:.1e}", m.error.itself),
            Ok(m) => format!("!{:.1e}", m.error.itself),
            Err(refused) => match refused.by {
                Reason::Model => "model",
                Reason::Sum => "sum",
            }
            .to_string(),
        }
    }
}

/// One method on one case, tolerance by tolerance.
pub struct Row {
    pub method: Method,
    pub cells: Vec<Cell>,
    /// Its error where nothing is asked of it.
    pub as_it_is: WorstWindow,
}

impl Row {
    pub fn of(method: Method, case: &Case, truth: &Truth, tolerances: &[f64]) -> Self {
        let mut known: Vec<(Chosen, WorstWindow)> = Vec::new();
        let mut error_of = |chosen: &Chosen| {
            if let Some((_, error)) = known.iter().find(|(c, _)| c == chosen) {
                return *error;
            }
            let error = measure::error(case, truth, &method.records(case, truth, chosen));
            known.push((chosen.clone(), error));
            error
        };
        let cells = tolerances
            .iter()
            .map(|&tolerance| Cell {
                tolerance,
                outcome: method
                    .within(tolerance, case, truth)
                    .map(|chosen| Measured {
                        error: error_of(&chosen),
                        predicted: chosen.predicted,
                        chosen,
                    }),
            })
            .collect();
        let as_it_is = error_of(&method.as_it_is(case, truth));
        Self {
            method,
            cells,
            as_it_is,
        }
    }

    pub fn text(&self, case: &Case) -> String {
        let mut line = format!(
            "{:<18} {:<22} {:<10} {:>8}",
            case.scene,
            case.motion,
            self.method.name(),
            format!("{:.1e}", self.as_it_is.itself),
        );
        for cell in &self.cells {
            line += &format!(" {:>8}", cell.text());
        }
        line
    }
}

pub fn heading() -> String {
    let mut line = format!(
        "{:<18} {:<22} {:<10} {:>8}",
        "scene", "motion", "method", "as it is"
    );
    for tolerance in TOLERANCES {
        line += &format!(" {:>8}", format!("{tolerance:.0e}"));
    }
    line
}

//! Cells and lines of the tables.

use super::case::Case;
use super::measure::{self, Truth, WorstWindow};
use super::methods::{Chosen, Method, Ready, Reason, Refused};

/// Tolerances asked for.
pub const TOLERANCES: [f64; 8] = [1e-1, 1e-2, 1e-3, 1e-4, 1e-5, 1e-6, 1e-7, 1e-8];

/// Where a method is known to miss what it was asked for, and why.
pub const KNOWN: [(Method, f64, &str); 1] = [(
    Method::Gridded2d,
    1e-4,
    "the strength of a Lambert bottom is held along a stretch of the line",
)];

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
    pub as_it_is: Option<WorstWindow>,
}

impl Row {
    pub fn of(method: Method, case: &Case, truth: &Truth, tolerances: &[f64]) -> Self {
        let mut known: Vec<(Chosen, WorstWindow)> = Vec::new();
        // A sum without a tolerance of its own is the same for all.
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

    /// Cells above their tolerance that are not [`KNOWN`].
    pub fn broken(&self) -> impl Iterator<Item = &Cell> {
        self.cells.iter().filter(|cell| {
            let known = |k: &(Method, f64, &str)| (k.0, k.1) == (self.method, cell.tolerance);
            !cell.holds() && !KNOWN.iter().any(known)
        })
    }

    pub fn text(&self, case: &Case) -> String {
        let mut line = format!(
            "{:<18} {:<22} {:<10} {:>8}",
            case.scene,
            case.motion,
            self.method.name(),
            self.as_it_is
                .map_or("-".into(), |e| format!("{:.1e}", e.itself)),
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

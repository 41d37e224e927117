//! What the stages cost: a table of figures of one core, the one that comes with the program or one that `echotank check --calibrate` has measured.
//!
//! A method's cost is the sum of its amounts of work, each times its figure. Figures are nanoseconds; those of the engines with a tolerance
//! are factors on what the engines themselves predict.

use std::path::Path;

use serde::{Deserialize, Serialize};
use thiserror::Error;

use crate::io::text_of;
use crate::ping::fidelity::{FIGURES, Work};

/// The table that comes with the program.
const COMMITTED: &str = include_str!("costs.toml");

#[derive(Debug, Error)]
pub enum CostsError {
    #[error("{path}: {why}")]
    Read { path: String, why: std::io::Error },
    #[error("{path}: {why}")]
    Parse {
        path: String,
        why: Box<toml::de::Error>,
    },
    #[error("{path}: {key} = {value}: must be above 0 and finite")]
    Value {
        path: String,
        key: &'static str,
        value: f64,
    },
}

/// As the file has it.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Costs {
    /// Whose figures these are, and how they were got.
    pub machine: String,
    /// Nanoseconds of one core.
    pub ns: Figures,
    /// On what engines predict of themselves.
    pub factor: Factors,
}

#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Figures {
    /// A scatterer as a transmitter sees it.
    pub transmit_leg: f64,
    /// A scatterer as an element sees it, by path model.
    pub stop_and_hop: f64,
    pub chords: f64,
    pub continuous: f64,
    /// The second order of its Doppler.
    pub quadratic: f64,
    /// A point of an echo in `direct`, and in `reference`.
    pub direct_point: f64,
    pub reference_point: f64,
    /// A bin of an echo in `spectral`.
    pub spectral_bin: f64,
    /// A sample of an echo in `nearest`; `linear` has two.
    pub replica_sample: f64,
    /// A point ahead of the receiver filter.
    pub filter_point: f64,
    /// A sample of an element, whatever made it.
    pub sample: f64,
    /// An echo's own Doppler.
    pub stretch: f64,
    /// A scatterer as an element sees it, once more for each segment of the whole window.
    pub segment: f64,
}

#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Factors {
    pub gridded_1d: f64,
    pub gridded_2d: f64,
}

impl Costs {
    pub fn committed() -> Self {
        Self::parse(COMMITTED, "the committed table of costs")
            .expect("costs.toml is checked by a test")
    }

    /// The file, or without one the committed table.
    pub fn of(path: Option<&Path>) -> Result<Self, CostsError> {
        let Some(path) = path else {
            return Ok(Self::committed());
        };
        let name = path.display().to_string();
        let text = text_of(path).map_err(|why| CostsError::Read {
            path: name.clone(),
            why,
        })?;
        Self::parse(&text, &name)
    }

    fn parse(text: &str, name: &str) -> Result<Self, CostsError> {
        let costs: Self = toml::from_str(text).map_err(|why| CostsError::Parse {
            path: name.to_owned(),
            why: Box::new(why),
        })?;
        for (key, value) in NAMES.into_iter().zip(costs.values()) {
            if !(value > 0.0 && value.is_finite()) {
                return Err(CostsError::Value {
                    path: name.to_owned(),
                    key,
                    value,
                });
            }
        }
        Ok(costs)
    }

    /// Figures in ns, then factors in ns per predicted ns.
    pub fn values(&self) -> [f64; FIGURES] {
        let Figures {
            transmit_leg,
            stop_and_hop,
            chords,
            continuous,
            quadratic,
            direct_point,
            reference_point,
            spectral_bin,
            replica_sample,
            filter_point,
            sample,
            stretch,
            segment,
        } = self.ns;
        [
            transmit_leg,
            stop_and_hop,
            chords,
            continuous,
            quadratic,
            direct_point,
            reference_point,
            spectral_bin,
            replica_sample,
            filter_point,
            sample,
            self.factor.gridded_1d,
            self.factor.gridded_2d,
            stretch,
            segment,
        ]
    }

    pub fn with_values(&self, v: [f64; FIGURES]) -> Self {
        Self {
            machine: self.machine.clone(),
            ns: Figures {
                transmit_leg: v[0],
                stop_and_hop: v[1],
                chords: v[2],
                continuous: v[3],
                quadratic: v[4],
                direct_point: v[5],
                reference_point: v[6],
                spectral_bin: v[7],
                replica_sample: v[8],
                filter_point: v[9],
                sample: v[10],
                stretch: v[13],
                segment: v[14],
            },
            factor: Factors {
                gridded_1d: v[11],
                gridded_2d: v[12],
            },
        }
    }

    /// Milliseconds of one core.
    pub fn ms(&self, work: &Work) -> f64 {
        let ns = self.values().into_iter().zip(work).map(|(ns, n)| ns * n);
        1e-6 * ns.sum::<f64>()
    }

    /// As a file.
    pub fn text(&self) -> String {
        let body = toml::to_string(self).unwrap_or_default();
        format!(
            "# What the stages cost: nanoseconds of one core for each unit of work ([ns]), and factors on what engines predict of themselves\n\
             # ([factor]). Written by `echotank check CONFIG --calibrate FILE`; used with `--costs FILE` or run.costs.\n{body}"
        )
    }
}

pub const NAMES: [&str; FIGURES] = [
    "ns.transmit_leg",
    "ns.stop_and_hop",
    "ns.chords",
    "ns.continuous",
    "ns.quadratic",
    "ns.direct_point",
    "ns.reference_point",
    "ns.spectral_bin",
    "ns.replica_sample",
    "ns.filter_point",
    "ns.sample",
    "factor.gridded_1d",
    "factor.gridded_2d",
    "ns.stretch",
    "ns.segment",
];

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
        assert_eq!(committed.with_values(committed.values()), committed);
        let mut broken = committed.clone();
        broken.ns.chords = 0.0;
        let said = Costs::parse(&broken.text(), "costs.toml").expect_err("0 ns");
        assert_eq!(
            said.to_string(),
            "costs.toml: ns.chords = 0: must be above 0 and finite"
        );
    }
}

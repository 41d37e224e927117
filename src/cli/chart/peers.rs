//! Measurements of other software, written by `tools/peers`.

use std::path::Path;

use serde::Deserialize;

use echotank_runtime::chart::Chart;
use echotank_runtime::io::json_problem;

use super::super::Failure;

/// Default output of `tools/peers`, relative to the working folder.
pub(crate) const FILE: &str = "out/peers/points.json";

/// Measurement of one program at one setting on its own scatterers.
#[derive(Clone, Debug, Deserialize, PartialEq)]
pub(crate) struct Peer {
    pub(crate) name: String,
    pub(crate) scatterers: f64,
    pub(crate) elements: f64,
    pub(crate) milliseconds: f64,
    /// Error relative to the exact value of the sum that the program approximates.
    pub(crate) error: f64,
    pub(crate) threads: f64,
    pub(crate) load: f64,
}

/// Reads the measurements. Returns an empty list if no file is named and the default file does not exist.
pub(crate) fn read(asked: Option<&Path>) -> Result<Vec<Peer>, Failure> {
    let path = match asked {
        Some(path) => path,
        None if Path::new(FILE).exists() => Path::new(FILE),
        None => return Ok(Vec::new()),
    };
    let refuse =
        |why: String| Failure::Configuration(format!("--peers = {}: {why}", path.display()));
    let text = std::fs::read_to_string(path).map_err(|why| refuse(why.to_string()))?;
    parse(&text).map_err(refuse)
}

fn parse(text: &str) -> Result<Vec<Peer>, String> {
    let peers: Vec<Peer> = serde_json::from_str(text).map_err(|why| json_problem(&why))?;
    for peer in &peers {
        let amounts = [
            peer.scatterers,
            peer.elements,
            peer.milliseconds,
            peer.error,
            peer.threads,
        ];
        if !amounts.iter().all(|x| x.is_finite() && *x > 0.0) {
            return Err(format!(
                "{}: scatterers, elements, milliseconds, error and threads must be above 0",
                peer.name
            ));
        }
    }
    Ok(peers)
}

impl Peer {
    /// Time scaled to this scene's scatterer-element pairs and threads, milliseconds.
    pub(crate) fn here_ms(&self, chart: &Chart) -> f64 {
        let here = (chart.scatterers * chart.elements) as f64 / chart.threads as f64;
        self.milliseconds * here * self.threads / (self.scatterers * self.elements)
    }

    /// Text of the tooltip and the report.
    pub(crate) fn description(&self, chart: &Chart) -> String {
        format!(
            "{}\n{:.2} ms for {} scatterers and {} elements on {} threads, load {:.1}; scaled to this scene {:.1} ms\nerror {:.1e} of its own sum, static platform",
            self.name,
            self.milliseconds,
            self.scatterers,
            self.elements,
            self.threads,
            self.load,
            self.here_ms(chart),
            self.error
        )
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn peer_measurements_are_read_and_invalid_ones_are_refused_by_name() {
        let point = |ms: &str| {
            format!(
                r#"[{{"name": "any", "scatterers": 1000, "elements": 2, "milliseconds": {ms}, "error": 1e-3, "threads": 1, "load": 0.5}}]"#
            )
        };
        let peers = parse(&point("4.0")).expect("a point");
        assert_eq!(
            (peers[0].name.as_str(), peers[0].milliseconds),
            ("any", 4.0)
        );
        let why = parse(&point("0")).expect_err("no time at all");
        assert!(why.contains("any") && why.contains("above 0"), "{why}");
        assert!(parse("{").is_err());
    }
}

//! Simplification as a stage of the ping.
//!
//! The rule is made from a held view. While the sonar stays within the slack of that view, the same rule applies to all scatterers, including new
//! ones, so that the selection does not flicker. When the sonar has moved or turned farther, a new rule is made from its current view.

use super::energy::{Energies, EnergyScale, View};
use super::{Rule, Selection, Settings};
use echotank_config::spec::SimplifySpec;
use echotank_core::scene::Scatterers;

/// Counts of one call of [`Stage::thin`].
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct StageCounts {
    /// Scatterers before selection.
    pub offered: u64,
    /// Scatterers after selection.
    pub kept: u64,
    /// Rules that were renewed.
    pub chosen: u64,
}

/// Simplification of each ping's scatterers. It allocates only while the number of scatterers grows.
#[derive(Debug)]
pub struct Stage {
    settings: Settings,
    held: Option<HeldRule>,
    energies: Energies,
    selection: Selection,
}

impl Stage {
    /// A stage with the settings of a configuration. `seed` is the seed of the scene.
    pub fn of_spec(spec: &SimplifySpec, seed: u64) -> Self {
        let settings = Settings {
            method: spec.method,
            keep: spec.keep,
            weights: spec.weights,
            seed,
        };
        Self::new(settings)
    }

    /// A stage with the given settings.
    pub fn new(settings: Settings) -> Self {
        Self {
            settings,
            held: None,
            energies: Energies::default(),
            selection: Selection::default(),
        }
    }

    /// Keeps only the selected scatterers, in their order and with their gain. Those from index `free` on are deterministic and stay.
    pub fn thin(&mut self, scatterers: &mut Scatterers, free: usize, view: &View) -> StageCounts {
        let free = free.min(scatterers.len());
        let mut counts = StageCounts {
            offered: scatterers.len() as u64,
            ..StageCounts::default()
        };
        let serves = |held: &HeldRule| still_serves(&held.view, view);
        let chosen = !self.held.as_ref().is_some_and(serves);
        let held = self.held.get_or_insert_default();
        if chosen {
            // Copied in place to reuse the memory of the beams.
            held.view.clone_from(view);
            counts.chosen = 1;
        }
        let scale = (!chosen).then_some(held.scale);
        self.energies
            .evaluate(scatterers, free, &held.view, &self.settings, scale);
        if chosen {
            held.rule = self.selection.rule(&self.energies, free, &self.settings);
            held.scale = self.energies.scale;
        }
        let rule = held.rule;
        let seed = self.settings.seed;
        self.selection
            .apply(rule, scatterers, &self.energies, free, seed);
        keep(scatterers, &self.selection);
        counts.kept = scatterers.len() as u64;
        counts
    }
}

/// A rule and the view from which it was made.
#[derive(Debug)]
struct HeldRule {
    view: View,
    scale: EnergyScale,
    rule: Rule,
}

impl Default for HeldRule {
    fn default() -> Self {
        Self {
            view: View::default(),
            scale: EnergyScale::default(),
            rule: Rule::All,
        }
    }
}

fn still_serves(held: &View, now: &View) -> bool {
    let turned = |a: glam::DVec3, b: glam::DVec3| a.angle_between(b) > now.slack_rad;
    held.apex_m.distance(now.apex_m) <= now.slack_m
        && (held.slack_m, held.slack_rad) == (now.slack_m, now.slack_rad)
        && held.beams.len() == now.beams.len()
        && held
            .beams
            .iter()
            .zip(&now.beams)
            .all(|(a, b)| !turned(a.along, b.along) && !turned(a.boresight, b.boresight))
}

/// Moves the kept scatterers to the front and drops the rest.
fn keep(s: &mut Scatterers, selection: &Selection) {
    for (to, (&from, gain)) in selection.kept.iter().zip(&selection.gain).enumerate() {
        let from = from as usize;
        s.north_m[to] = s.north_m[from];
        s.east_m[to] = s.east_m[from];
        s.down_m[to] = s.down_m[from];
        s.normal[to] = s.normal[from];
        s.strength[to] = s.strength[from] * *gain;
        s.law[to] = s.law[from];
        s.loud[to] = s.loud[from];
    }
    s.truncate(selection.kept.len());
}

//! Simplification: selects the scatterers that a ping needs (Meng et al. 2023, section 4).
//!
//! Input: scatterers, the sonar's [`View`] of them, a [`Method`] and the number to keep. Output: the indices of the kept scatterers and a factor on
//! the amplitude of each.
//!
//! | method | keeps | level |
//! |---|---|---|
//! | [`Method::Acoustic`] | the highest energies (Eqs. 26-29 corrected, [`energy`]) | falls by the discarded energy |
//! | [`Method::Paper`] | the highest energies as printed, for comparison | falls |
//! | [`Method::Unbiased`] | each with a probability p that follows its energy, amplitude divided by sqrt(p) (Horvitz and Thompson 1952) | unchanged on average |
//! | [`collapse`] | corners that matter to the shape of the triangulated surface (Garland and Heckbert 1997) | falls, unless the kept corners inherit the area |
//!
//! The selection depends on the scatterers' positions, the view and the seed alone. In `Unbiased` every scatterer has one permanent random number,
//! drawn from its position. Smaller selections are therefore subsets of larger ones, and selections of neighbouring views overlap as far as possible.
//! Not modelled: merging scatterers into stronger ones.

pub mod collapse;
pub mod curvature;
pub mod energy;
pub mod field;
pub mod shadow;
pub mod stage;

#[cfg(test)]
mod tests;

pub use echotank_config::spec::{EnergyWeights as Weights, SimplifyMethod as Method};
use echotank_core::scene::Scatterers;
use energy::{Energies, View};

/// Parameters of a selection.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Settings {
    /// Selection method.
    pub method: Method,
    /// Number of scatterers to keep besides the deterministic ones; `Unbiased` keeps this number on average.
    pub keep: usize,
    /// Weights of the energies.
    pub weights: Weights,
    /// Seed of the permanent random numbers.
    pub seed: u64,
}

/// Least energy in `Unbiased`, relative to a greatest of order one. Every scatterer in the beam keeps a positive probability.
const MIN_ENERGY: f64 = 1e-9;

/// Selection rule. It applies to any scatterer, so it can be held while the sonar moves.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Rule {
    /// Keeps all scatterers.
    All,
    /// `Acoustic` and `Paper`: keeps visible scatterers above an energy. Hidden ones count as below all visible ones. At the threshold, the first
    /// `ties` of the list are kept.
    Above {
        /// Threshold energy.
        energy: f64,
        /// Whether the threshold lies among the hidden scatterers.
        hidden_too: bool,
        /// Number of scatterers to keep at the threshold.
        ties: usize,
    },
    /// `Unbiased`: keeps each scatterer with probability p = min(1, per_energy * energy).
    Probability {
        /// Probability per unit of energy.
        per_energy: f64,
    },
}

/// Result and scratch memory of a selection. It allocates only while the number of scatterers grows.
#[derive(Debug, Default)]
pub struct Selection {
    /// Indices of the kept scatterers, ascending.
    pub kept: Vec<u32>,
    /// Factor on the amplitude of each kept scatterer.
    pub gain: Vec<f64>,
    order: Vec<u32>,
}

/// Rank of one scatterer. Hidden scatterers come after all visible ones.
#[derive(Clone, Copy, Debug)]
struct Rank {
    hidden: bool,
    energy: f64,
}

impl Rank {
    fn of(energies: &Energies, i: usize) -> Self {
        let energy = energies.energy[i];
        Self {
            hidden: energies.hidden[i],
            // NaN ranks last. Only the energies as printed produce it, from 0/0.
            energy: if energy.is_nan() {
                f64::NEG_INFINITY
            } else {
                energy
            },
        }
    }
    /// Lesser ranks are kept first.
    fn cmp(&self, other: &Self) -> std::cmp::Ordering {
        self.hidden
            .cmp(&other.hidden)
            .then(other.energy.total_cmp(&self.energy))
    }
}

impl Selection {
    /// A selection made elsewhere: ascending indices, and a gain for each.
    pub fn of(kept: Vec<u32>, gain: Vec<f64>) -> Self {
        Self {
            kept,
            gain,
            order: Vec::new(),
        }
    }

    /// Rule that keeps `settings.keep` of the first `free` scatterers. The scatterers after them are deterministic and always kept.
    pub fn rule(&mut self, energies: &Energies, free: usize, settings: &Settings) -> Rule {
        let free = free.min(energies.energy.len());
        if settings.keep >= free {
            return Rule::All;
        }
        match settings.method {
            Method::Unbiased => Rule::Probability {
                per_energy: per_energy(energies, free, settings.keep),
            },
            Method::Acoustic | Method::Paper => {
                if settings.keep == 0 {
                    return Rule::Above {
                        energy: f64::INFINITY,
                        hidden_too: false,
                        ties: 0,
                    };
                }
                self.order.clear();
                self.order.extend(0..free as u32);
                let by_rank = |a: &u32, b: &u32| {
                    Rank::of(energies, *a as usize)
                        .cmp(&Rank::of(energies, *b as usize))
                        .then(a.cmp(b))
                };
                let (before, last, _) = self
                    .order
                    .select_nth_unstable_by(settings.keep - 1, by_rank);
                let threshold = Rank::of(energies, *last as usize);
                let equal = |i: &&u32| Rank::of(energies, **i as usize).cmp(&threshold).is_eq();
                Rule::Above {
                    energy: threshold.energy,
                    hidden_too: threshold.hidden,
                    ties: 1 + before.iter().filter(equal).count(),
                }
            }
        }
    }

    /// Applies a rule: fills `kept` and `gain`.
    pub fn apply(
        &mut self,
        rule: Rule,
        scatterers: &Scatterers,
        energies: &Energies,
        free: usize,
        seed: u64,
    ) {
        self.kept.clear();
        self.gain.clear();
        let mut ties_left = match rule {
            Rule::Above { ties, .. } => ties,
            _ => 0,
        };
        for i in 0..scatterers.len() {
            let gain = if i >= free {
                Some(1.0)
            } else {
                match rule {
                    Rule::All => Some(1.0),
                    Rule::Above {
                        energy, hidden_too, ..
                    } => {
                        let threshold = Rank {
                            hidden: hidden_too,
                            energy,
                        };
                        match Rank::of(energies, i).cmp(&threshold) {
                            std::cmp::Ordering::Less => Some(1.0),
                            std::cmp::Ordering::Equal if ties_left > 0 => {
                                ties_left -= 1;
                                Some(1.0)
                            }
                            _ => None,
                        }
                    }
                    Rule::Probability { per_energy } => {
                        let p = probability(per_energy, energies, i);
                        (permanent_number(scatterers, i, seed) < p).then(|| 1.0 / p.sqrt())
                    }
                }
            };
            if let Some(gain) = gain {
                self.kept.push(i as u32);
                self.gain.push(gain);
            }
        }
    }

    /// Copies the kept scatterers of `all`, with their gains, into `out`.
    pub fn gather(&self, all: &Scatterers, out: &mut Scatterers) {
        out.clear();
        out.curve.clone_from(&all.curve);
        for (&i, gain) in self.kept.iter().zip(&self.gain) {
            let i = i as usize;
            out.push(
                all.position_m(i),
                all.normal[i],
                all.strength[i] * *gain,
                all.law[i],
            );
        }
    }
}

/// Inclusion probability of a scatterer; 0 for hidden ones.
fn probability(per_energy: f64, energies: &Energies, i: usize) -> f64 {
    if energies.hidden[i] {
        return 0.0;
    }
    let energy = energies.energy[i].max(MIN_ENERGY);
    (per_energy * energy).min(1.0)
}

/// The k for which the probabilities min(1, k E) of the first `free` scatterers add up to `keep`, or to the number of visible ones.
fn per_energy(energies: &Energies, free: usize, keep: usize) -> f64 {
    let mut per_energy = 0.0;
    // Each round fixes the scatterers whose p reaches 1 and distributes the rest among the others. k grows and converges after a few rounds.
    loop {
        let (mut certain, mut rest) = (0usize, 0.0);
        for i in 0..free {
            let p = probability(per_energy, energies, i);
            if p >= 1.0 {
                certain += 1;
            } else if !energies.hidden[i] {
                rest += energies.energy[i].max(MIN_ENERGY);
            }
        }
        if rest <= 0.0 || certain >= keep {
            // All visible scatterers are certain, or none has any energy.
            return if certain > 0 {
                f64::INFINITY
            } else {
                per_energy
            };
        }
        let next = (keep - certain) as f64 / rest;
        if next <= per_energy {
            return per_energy;
        }
        per_energy = next;
    }
}

/// Permanent random number of a scatterer in [0, 1): a hash of the seed and the bits of its position (the finaliser of Steele, Lea and Flood 2014, in
/// sequence).
pub(crate) fn permanent_number(scatterers: &Scatterers, i: usize, seed: u64) -> f64 {
    const STEP: f64 = 1.0 / (1_u64 << 53) as f64;
    let mut state = seed ^ 0x9e37_79b9_7f4a_7c15;
    for place in [
        scatterers.north_m[i],
        scatterers.east_m[i],
        scatterers.down_m[i],
    ] {
        // -0 and 0 are the same position.
        state = mixed(state.wrapping_add(0x9e37_79b9_7f4a_7c15) ^ (place + 0.0).to_bits());
    }
    (mixed(state) >> 11) as f64 * STEP
}

fn mixed(mut x: u64) -> u64 {
    x = (x ^ (x >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    x = (x ^ (x >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
    x ^ (x >> 31)
}

/// Evaluates, ranks and selects the scatterers of `all` for one view in a single call.
pub fn select(all: &Scatterers, free: usize, view: &View, settings: &Settings) -> Selection {
    let mut energies = Energies::default();
    energies.evaluate(all, free, view, settings, None);
    let mut selection = Selection::default();
    let rule = selection.rule(&energies, free, settings);
    selection.apply(rule, all, &energies, free, settings.seed);
    selection
}

//! Simplification: which scatterers a ping can do without (Meng et al. 2023, section 4).
//!
//! In: scatterers, the sonar's [`View`] of them, a [`Method`] and how many to keep. Out: which are kept, and a factor on each one's amplitude.
//!
//! | method | keeps | level |
//! |---|---|---|
//! | [`Method::Acoustic`] | the highest energies (Eqs. 26-29 mended, [`energy`]) | falls by what is left out |
//! | [`Method::Paper`] | the highest energies as printed: for comparison | falls |
//! | [`Method::Unbiased`] | each with a probability p that follows its energy, its amplitude over sqrt(p) (Horvitz and Thompson 1952) | that of all, on average |
//! | [`collapse`] | corners of the triangulated surface that matter to its shape (Garland and Heckbert 1997) | falls, unless the kept inherit the area |
//!
//! What is chosen depends on the scatterers' places, the view and the seed alone. In `Unbiased` every scatterer has one random number for
//! ever, drawn from its place, so that sets for fewer are parts of sets for more, and sets for neighbouring views overlap as far as
//! they can.
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
use echotank_core::flow::Scatterers;
use energy::{Energies, View};

#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Settings {
    pub method: Method,
    /// Scatterers to keep besides the deterministic ones; `Unbiased` keeps this many on average.
    pub keep: usize,
    pub weights: Weights,
    /// Of the permanent random numbers.
    pub seed: u64,
}

/// The least energy in `Unbiased` (the greatest is of order one): whatever can be heard keeps a chance.
const MIN_ENERGY: f64 = 1e-9;

/// Which scatterers pass: a rule that holds for any scatterer, so that it can be kept while the sonar moves.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Rule {
    All,
    /// `Acoustic` and `Paper`: the visible with more than this energy; the hidden only where `hidden_too`. With just this energy: the
    /// first `ties` of the list.
    Above {
        energy: f64,
        hidden_too: bool,
        ties: usize,
    },
    /// `Unbiased`: p = min(1, per_energy * energy).
    Probability {
        per_energy: f64,
    },
}

/// Scratch and result of a selection; nothing is allocated once it has been as full.
#[derive(Debug, Default)]
pub struct Selection {
    /// Indices of the kept, ascending.
    pub kept: Vec<u32>,
    /// What each kept one's amplitude is multiplied with.
    pub gain: Vec<f64>,
    order: Vec<u32>,
}

/// What decides on one scatterer: hidden ones come after all visible ones.
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
            // Not a number (only as printed, where 0/0 is one) ranks last.
            energy: if energy.is_nan() {
                f64::NEG_INFINITY
            } else {
                energy
            },
        }
    }
    /// Less is kept first.
    fn cmp(&self, other: &Self) -> std::cmp::Ordering {
        self.hidden
            .cmp(&other.hidden)
            .then(other.energy.total_cmp(&self.energy))
    }
}

impl Selection {
    /// A choice made elsewhere: indices ascending, a gain each.
    pub fn of(kept: Vec<u32>, gain: Vec<f64>) -> Self {
        Self {
            kept,
            gain,
            order: Vec::new(),
        }
    }

    /// The rule that keeps `settings.keep` of the first `free` scatterers (those after are deterministic and always kept).
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

    /// The kept scatterers of `all` with their gains, into `out`.
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

/// Inclusion probability of a scatterer; 0 for the hidden.
fn probability(per_energy: f64, energies: &Energies, i: usize) -> f64 {
    if energies.hidden[i] {
        return 0.0;
    }
    let energy = energies.energy[i].max(MIN_ENERGY);
    (per_energy * energy).min(1.0)
}

/// The k for which the probabilities min(1, k E) of the first `free` scatterers add up to `keep`, or to all that are visible.
fn per_energy(energies: &Energies, free: usize, keep: usize) -> f64 {
    let mut per_energy = 0.0;
    // Each round makes certain those whose p reaches 1 and shares the rest out among the others: k grows, and ends after a few rounds.
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
            // All that is visible is certain; or nothing has any energy, and nothing would be heard.
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

/// A scatterer's own number in 0 .. 1 for ever: a hash of the seed and its place's bits (the finaliser of Steele, Lea and Flood 2014, in sequence).
pub(crate) fn permanent_number(scatterers: &Scatterers, i: usize, seed: u64) -> f64 {
    const STEP: f64 = 1.0 / (1_u64 << 53) as f64;
    let mut state = seed ^ 0x9e37_79b9_7f4a_7c15;
    for place in [
        scatterers.north_m[i],
        scatterers.east_m[i],
        scatterers.down_m[i],
    ] {
        // -0 and 0 are one place.
        state = mixed(state.wrapping_add(0x9e37_79b9_7f4a_7c15) ^ (place + 0.0).to_bits());
    }
    (mixed(state) >> 11) as f64 * STEP
}

fn mixed(mut x: u64) -> u64 {
    x = (x ^ (x >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    x = (x ^ (x >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
    x ^ (x >> 31)
}

/// Everything in one call, for tools: the scatterers of `all` to keep for one view.
pub fn select(all: &Scatterers, free: usize, view: &View, settings: &Settings) -> Selection {
    let mut energies = Energies::default();
    energies.evaluate(all, free, view, settings, None);
    let mut selection = Selection::default();
    let rule = selection.rule(&energies, free, settings);
    selection.apply(rule, all, &energies, free, settings.seed);
    selection
}

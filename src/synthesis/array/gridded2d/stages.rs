//! Where the time of a ping goes: core seconds by stage.

use std::time::{Duration, Instant};

/// What a task does, in the order it is done.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Stage {
    /// Going over the scatterers for what their echoes have in common, and the fits to that.
    Survey,
    /// How many terms each series needs.
    Orders,
    /// Delays and strengths of all echoes at the middle of the stretch.
    Walk,
    /// From echoes onto the grid.
    Spread,
    /// The grid's columns to frequency.
    Transform,
    /// Templates for the motion.
    Templates,
    /// Channels, pulse and templates into powers along the stretch.
    Combine,
    /// Powers along the stretch to elements.
    Elements,
    /// Elements back to time samples.
    Return,
}

impl Stage {
    pub const ALL: [Self; 9] = [
        Self::Survey,
        Self::Orders,
        Self::Walk,
        Self::Spread,
        Self::Transform,
        Self::Templates,
        Self::Combine,
        Self::Elements,
        Self::Return,
    ];

    pub fn name(self) -> &'static str {
        match self {
            Self::Survey => "survey",
            Self::Orders => "orders",
            Self::Walk => "walk",
            Self::Spread => "spread",
            Self::Transform => "transform",
            Self::Templates => "templates",
            Self::Combine => "combine",
            Self::Elements => "elements",
            Self::Return => "return",
        }
    }
}

/// Time spent in each stage, summed over tasks.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Stages {
    spent: [Duration; Stage::ALL.len()],
}

impl Stages {
    pub fn spent(&self, stage: Stage) -> Duration {
        self.spent[stage as usize]
    }

    pub fn total(&self) -> Duration {
        self.spent.iter().sum()
    }

    /// Books what has passed since `start` and starts anew.
    pub(super) fn lap(&mut self, stage: Stage, start: &mut Instant) {
        let now = Instant::now();
        self.spent[stage as usize] += now - *start;
        *start = now;
    }

    /// Books part of one stage under another instead.
    pub(super) fn transfer(&mut self, from: Stage, to: Stage, time: Duration) {
        let time = time.min(self.spent[from as usize]);
        self.spent[from as usize] -= time;
        self.spent[to as usize] += time;
    }

    pub fn add(&mut self, other: &Self) {
        for (sum, spent) in self.spent.iter_mut().zip(other.spent) {
            *sum += spent;
        }
    }
}

//! Core time of a ping by stage.

use std::sync::OnceLock;
use std::time::Duration;

static CLOCK: OnceLock<fn() -> Duration> = OnceLock::new();

/// Measures the stages from now on with `clock`, which gives the time since any fixed instant. The first call holds; without one all stage times
/// are zero and no clock is read.
pub fn measure_stages(clock: fn() -> Duration) {
    CLOCK.get_or_init(|| clock);
}

/// The time of the clock, zero without one.
pub(super) fn now() -> Duration {
    CLOCK.get().map_or(Duration::ZERO, |clock| clock())
}

/// Stages of a task, in order.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Stage {
    /// Passing over the scatterers to find common parameters of their echoes, and fitting them.
    Survey,
    /// Choosing the number of terms of each series.
    Orders,
    /// Computing delays and amplitudes of all echoes at the middle of the section.
    Walk,
    /// Spreading echoes onto the grid.
    Spread,
    /// Transforming the columns of the grid to frequency.
    Transform,
    /// Computing the templates for the motion.
    Templates,
    /// Combining channels, pulse and templates into powers along the section.
    Combine,
    /// Evaluating powers along the section at the elements.
    Elements,
    /// Transforming the elements back to time samples.
    Return,
}

impl Stage {
    /// All stages, in order.
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

    /// Name of the stage in reports.
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

/// Core time spent in each stage, summed over tasks.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Stages {
    spent: [Duration; Stage::ALL.len()],
}

impl Stages {
    /// Time spent in `stage`.
    pub fn spent(&self, stage: Stage) -> Duration {
        self.spent[stage as usize]
    }

    /// Time spent in all stages.
    pub fn total(&self) -> Duration {
        self.spent.iter().sum()
    }

    /// Adds the time since `start` to `stage`, and resets `start`.
    pub(super) fn lap(&mut self, stage: Stage, start: &mut Duration) {
        let now = now();
        self.spent[stage as usize] += now.saturating_sub(*start);
        *start = now;
    }

    /// Moves time from one stage to another.
    pub(super) fn transfer(&mut self, from: Stage, to: Stage, time: Duration) {
        let time = time.min(self.spent[from as usize]);
        self.spent[from as usize] -= time;
        self.spent[to as usize] += time;
    }

    /// Adds the times of another task.
    pub fn add(&mut self, other: &Self) {
        for (sum, spent) in self.spent.iter_mut().zip(other.spent) {
            *sum += spent;
        }
    }
}

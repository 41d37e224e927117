//! Engines on a grid, made for a pulse and a length of record before the pings that need them: `gridded-1d`, one for all elements of a sonar,
//! and `gridded-lines`, one for each line array. A sonar with `gridded-lines` has arrays of a single element and of parts made by `gridded-1d`.
//!
//! Making one takes milliseconds to seconds, the more the longer the pulse and the finer the tolerance. So [`Engines::expect`] makes the
//! engine for settings that are about to be used on a thread of its own; [`Engines::ready`] waits for it or, where nobody expected it, makes
//! it. What an engine computes depends on pulse and length alone, never on who made it and when: the same bits either way.

use std::f64::consts::FRAC_1_SQRT_2;
use std::sync::Arc;
use std::thread::{self, JoinHandle};

use crate::plan;
use crate::threads::run_in_background;
use echotank_config::spec::SonarSpec;
use echotank_core::arrays::{ArrayGeometry, Pattern};
use echotank_core::model::{DopplerModel, Synthesis};
use echotank_core::ping::PingPlan;
use echotank_core::pulse::Pulse;
use echotank_core::settings::SonarSettings;
use echotank_core::simd::SimdLevel;
use echotank_synthesis::array::filter::Decimator;
use echotank_synthesis::array::gridded::{DopplerSpan, GriddedError, one_dimensional};
use echotank_synthesis::array::lines::{self, GriddedLines};
use echotank_synthesis::error_model::ErrorModel;
use echotank_synthesis::slabs::{SlabDesign, SlabEngine};
use thiserror::Error;

/// What the weakest window of a ping may lie below the strongest, dB: from the first bottom echo to the end of a long range.
pub const LEVEL_RANGE_DB: f64 = 80.0;

/// Echoes of one element for which an engine's sizes are chosen; with fewer or more it is as right, and nearly as fast.
pub(crate) const NOMINAL_ARRIVALS: usize = 30_000;

/// Acceleration of an array along its rays that the engines have room for, m/s^2: a small boat in a steep sea.
pub(crate) const HARDEST_M_PER_S2: f64 = 5.0;

/// Engines kept: the one in use, and those that pings ordered before the latest changes still need.
const KEPT: usize = 4;

/// Engines being made at a time, at most: a topside that turns a knob leaves most of its settings unused.
const MAX_PENDING: usize = 2;

/// The least record that an engine is made for, samples.
const SHORTEST: usize = 256;

/// Dense rate of the receiver filter, at least, in sample rates: an engine's band is up to nine of them wide, and the filter's response
/// repeats with its dense rate.
pub(crate) const MIN_DENSITY: usize = 20;

/// The tolerance of a sonar cannot be kept.
#[derive(Debug, Error)]
pub enum EngineRefusal {
    /// By `gridded-1d`.
    #[error(transparent)]
    Elements(#[from] GriddedError),
    /// By `gridded-lines`.
    #[error(transparent)]
    Lines(#[from] lines::Refusal),
}

/// Which engine: made for this pulse, and for records of at most so many samples.
#[derive(Clone, Copy, PartialEq)]
struct Key {
    duration_s: f64,
    samples: usize,
}

/// The engines of one pulse and length of record.
pub(crate) struct PulseEngines {
    /// For the elements of arrays without an engine of their own; none where all have one.
    elements: Option<SlabEngine>,
    /// One per receive array: `gridded-lines`, where it makes the array.
    lines: Vec<Option<GriddedLines>>,
}

impl PulseEngines {
    /// The engine for single elements, of arrays that [`Self::line`] has none for.
    pub(crate) fn elements(&self) -> Option<&SlabEngine> {
        self.elements.as_ref()
    }

    /// The engine of a whole array.
    pub(crate) fn line(&mut self, array: usize) -> Option<&mut GriddedLines> {
        self.lines[array].as_mut()
    }

    /// Predicted errors; milliseconds of one core per element of `gridded-1d`, per ping of `gridded-lines`.
    pub(crate) fn error_models(&self) -> impl Iterator<Item = ErrorModel> {
        let lines = self.lines.iter().flatten();
        let elements = self.elements.iter().map(SlabEngine::error_model);
        elements
            .cloned()
            .chain(lines.map(|line| line.error_model().clone()))
    }
}

/// Whether `gridded-lines` makes this array.
pub(crate) fn is_line(array: &ArrayGeometry) -> bool {
    array.elements > 1 && !matches!(array.element_pattern, Pattern::Part { .. })
}

/// What all engines of a sonar have in common.
struct EngineRequirements {
    /// One per receive array, where `gridded-lines` is to make it.
    lines: Vec<Option<ArrayGeometry>>,
    sound_speed_m_per_s: f64,
    fastest_m_per_s: f64,
    nearest_m: f64,
    pulse: Pulse,
    sample_rate_hz: f64,
    filter: Option<Decimator>,
    doppler: DopplerModel,
    span: DopplerSpan,
    curvature_per_s: f64,
    tolerance: f64,
    /// Of the largest array made element by element; 0 without one.
    elements: usize,
    threads: usize,
}

/// The engines of one sonar.
pub(crate) struct Engines {
    requirements: Arc<EngineRequirements>,
    sound_speed_m_per_s: f64,
    max_samples: usize,
    /// The latest used first.
    kept: Vec<(Key, PulseEngines)>,
    pending: Vec<(Key, JoinHandle<Result<PulseEngines, EngineRefusal>>)>,
}

impl Engines {
    /// Makes the engine of the starting settings, if those of the ends of the limits could be made too. To be called inside the pool that will
    /// run it. `fastest_m_per_s`: of the platform.
    pub(crate) fn new(
        spec: &SonarSpec,
        sound_speed_m_per_s: f64,
        fastest_m_per_s: f64,
        filter: Option<&Decimator>,
    ) -> Result<Self, EngineRefusal> {
        let requirements =
            EngineRequirements::of(spec, sound_speed_m_per_s, fastest_m_per_s, filter);
        let mut engines = Self {
            requirements: Arc::new(requirements),
            sound_speed_m_per_s,
            max_samples: plan::max_samples(spec, sound_speed_m_per_s),
            kept: Vec::with_capacity(KEPT + 1),
            pending: Vec::with_capacity(MAX_PENDING),
        };
        let key = engines.key(&spec.settings);
        let most = engines.max_samples;
        engines.requirements.can_be_made(spec, key, most)?;
        let first = engines.requirements.make(key)?;
        engines.kept.push((key, first));
        Ok(engines)
    }

    /// Of the engines in use.
    pub(crate) fn error_models(&self) -> impl Iterator<Item = ErrorModel> {
        self.kept[0].1.error_models()
    }

    /// Whether `gridded-lines` makes receive array `index`.
    pub(crate) fn makes_line(&self, index: usize) -> bool {
        self.requirements.lines[index].is_some()
    }

    /// Dopplers that every engine takes.
    pub(crate) fn span(&self) -> DopplerSpan {
        self.requirements.span
    }

    fn key(&self, settings: &SonarSettings) -> Key {
        let (c, rate_hz) = (self.sound_speed_m_per_s, self.requirements.sample_rate_hz);
        let count = plan::sample_count(settings, c, rate_hz);
        self.key_of(settings.pulse_duration_s, count)
    }

    fn key_of(&self, duration_s: f64, count: usize) -> Key {
        Key {
            duration_s,
            samples: record_class(count, self.max_samples.max(count)),
        }
    }

    /// Begins to make the engine of these settings, unless it is there or under way. Returns at once.
    pub(crate) fn expect(&mut self, settings: &SonarSettings) {
        let key = self.key(settings);
        let under_way = self.pending.iter().any(|(pending, _)| *pending == key);
        if under_way || self.kept.iter().any(|(kept, _)| *kept == key) {
            return;
        }
        // What is done and was never asked for gives way.
        if self.pending.len() == MAX_PENDING {
            match self
                .pending
                .iter()
                .position(|(_, thread)| thread.is_finished())
            {
                Some(done) => drop(self.pending.remove(done)),
                None => return,
            }
        }
        let requirements = self.requirements.clone();
        let spawned = thread::Builder::new().name("engine".into()).spawn(move || {
            run_in_background();
            requirements.make(key)
        });
        // Where there is no thread to be had, `ready` makes it.
        if let Ok(thread) = spawned {
            self.pending.push((key, thread));
        }
    }

    /// Has the engine of this ping at hand as [`Engines::current`]. False where the ends of the limits could be made and this one could not:
    /// the direct sum then takes its place, which is exact, and slow.
    pub(crate) fn ready(&mut self, plan: &PingPlan) -> bool {
        let key = self.key_of(plan.pulse.duration_s, plan.sample_count);
        match self.kept.iter().position(|(kept, _)| *kept == key) {
            Some(0) => return true,
            Some(at) => self.kept[..=at].rotate_right(1),
            None => {
                let Ok(made) = self.coming_or_made(key) else {
                    return false;
                };
                self.kept.insert(0, (key, made));
            }
        }
        // The buffers go with the engine in use.
        if let [(_, now), (_, before), ..] = &mut self.kept[..] {
            let lines = now.lines.iter_mut().flatten();
            lines
                .zip(before.lines.iter_mut().flatten())
                .for_each(|(now, before)| now.swap_buffers(before));
        }
        self.kept.truncate(KEPT);
        true
    }

    /// What [`Engines::ready`] found last.
    pub(crate) fn current(&self) -> &PulseEngines {
        &self.kept[0].1
    }

    /// The same, for engines that keep their buffers from ping to ping.
    pub(crate) fn current_mut(&mut self) -> &mut PulseEngines {
        &mut self.kept[0].1
    }

    fn coming_or_made(&mut self, key: Key) -> Result<PulseEngines, EngineRefusal> {
        if let Some(at) = self.pending.iter().position(|(pending, _)| *pending == key) {
            let (_, thread) = self.pending.remove(at);
            if let Ok(made) = thread.join() {
                return made;
            }
        }
        self.requirements.make(key)
    }
}

/// The engines that a ping would be made with, without their work: for error models and costs.
pub(crate) struct Sketch {
    /// As [`PulseEngines`] has them.
    pub(crate) elements: Option<SlabDesign>,
    pub(crate) lines: Vec<Option<lines::Design>>,
}

impl Sketch {
    /// Whether the lines of this sonar interpolate the echoes of scatterers at `nearest_m`.
    pub(crate) fn reaches(&self, spec: &SonarSpec, nearest_m: f64) -> bool {
        let arrays = self.lines.iter().zip(&spec.receive);
        let mut lines = arrays.filter_map(|(line, array)| Some((line.as_ref()?, array)));
        lines.all(|(line, array)| line.nodes(array, nearest_m).is_some())
    }
}

/// The sketch of a ping's engines.
pub(crate) fn sketch(
    spec: &SonarSpec,
    sound_speed_m_per_s: f64,
    fastest_m_per_s: f64,
    filter: Option<&Decimator>,
    plan: &PingPlan,
) -> Result<Sketch, EngineRefusal> {
    let requirements = EngineRequirements::of(spec, sound_speed_m_per_s, fastest_m_per_s, filter);
    let most = plan::max_samples(spec, sound_speed_m_per_s);
    let key = Key {
        duration_s: plan.pulse.duration_s,
        samples: record_class(plan.sample_count, most.max(plan.sample_count)),
    };
    requirements.can_be_made(spec, key, most)?;
    requirements.sketch(key)
}

impl EngineRequirements {
    fn of(
        spec: &SonarSpec,
        sound_speed_m_per_s: f64,
        fastest_m_per_s: f64,
        filter: Option<&Decimator>,
    ) -> Self {
        // The wider end: eta - 1 = 2 v/(c - v) of a platform that closes.
        let greatest = 2.0 * fastest_m_per_s / (sound_speed_m_per_s - fastest_m_per_s);
        let by_lines = spec.model.synthesis == Synthesis::GriddedLines;
        let lines: Vec<_> = spec
            .receive
            .iter()
            .map(|array| (by_lines && is_line(array)).then(|| array.clone()))
            .collect();
        let others = spec.receive.iter().zip(&lines);
        let others = others.filter(|(_, line)| line.is_none());
        Self {
            elements: others.map(|(a, _)| a.elements).fold(0, usize::max),
            lines,
            sound_speed_m_per_s,
            fastest_m_per_s,
            nearest_m: spec.synthesis.nearest_m,
            pulse: spec.pulse,
            sample_rate_hz: spec.receiver.sample_rate_hz,
            filter: filter.cloned(),
            doppler: spec.model.doppler,
            span: DopplerSpan {
                least: -greatest,
                greatest,
            },
            curvature_per_s: (fastest_m_per_s.powi(2) / spec.synthesis.nearest_m
                + HARDEST_M_PER_S2)
                / sound_speed_m_per_s,
            tolerance: spec.synthesis.design_tolerance(),
            threads: rayon::current_num_threads(),
        }
    }

    /// That the ends of the limits are within reach, where one might not be: how far a spectrum spreads depends on the pulse's length; behind
    /// the receiver filter nothing of `gridded-1d` does. `gridded-lines` takes short pulses only.
    fn can_be_made(&self, spec: &SonarSpec, key: Key, samples: usize) -> Result<(), EngineRefusal> {
        let (shortest_s, longest_s) = spec.limits.pulse_duration_s;
        let ends_s = [shortest_s, longest_s].into_iter();
        let any_line = self.lines.iter().any(Option::is_some);
        let depends = any_line || self.filter.is_none();
        for duration_s in ends_s.filter(|&end_s| depends && end_s != key.duration_s) {
            let end = Key {
                duration_s,
                samples,
            };
            let pulse = self.pulse(end);
            self.sketch_elements(end)?;
            for array in self.lines.iter().flatten() {
                lines::Design::exists(&self.line(end, &pulse, array))?;
            }
        }
        Ok(())
    }

    fn pulse(&self, key: Key) -> Pulse {
        Pulse {
            duration_s: key.duration_s,
            ..self.pulse
        }
    }

    fn line<'a>(&'a self, key: Key, pulse: &'a Pulse, array: &'a ArrayGeometry) -> lines::Spec<'a> {
        lines::Spec {
            array,
            pulse,
            sound_speed_m_per_s: self.sound_speed_m_per_s,
            sample_rate_hz: self.sample_rate_hz,
            filter: self.filter.as_ref(),
            doppler: self.doppler,
            nearest_m: self.nearest_m,
            fastest_m_per_s: self.fastest_m_per_s,
            tolerance: self.tolerance,
            samples: key.samples,
            scatterers: NOMINAL_ARRIVALS,
            min_scatterers: 1,
            simd_level: SimdLevel::best(),
        }
    }

    fn sketch(&self, key: Key) -> Result<Sketch, EngineRefusal> {
        let pulse = self.pulse(key);
        let line = |array: &Option<ArrayGeometry>| {
            let design = |array| lines::Design::new(&self.line(key, &pulse, array));
            array.as_ref().map(design).transpose()
        };
        Ok(Sketch {
            elements: self.sketch_elements(key)?,
            lines: self.lines.iter().map(line).collect::<Result<_, _>>()?,
        })
    }

    fn sketch_elements(&self, key: Key) -> Result<Option<SlabDesign>, GriddedError> {
        if self.elements == 0 {
            return Ok(None);
        }
        let pulse = self.pulse(key);
        let spec = one_dimensional::Spec {
            pulse: &pulse,
            sample_rate_hz: self.sample_rate_hz,
            samples: key.samples,
            filter: self.filter.as_ref(),
            doppler: self.doppler,
            span: self.span,
            curvature_per_s: self.curvature_per_s,
            tolerance: self.tolerance,
            level_range_db: LEVEL_RANGE_DB,
            arrivals: NOMINAL_ARRIVALS,
            simd_level: SimdLevel::best(),
        };
        SlabDesign::new(&spec, self.elements).map(Some)
    }

    fn make(&self, key: Key) -> Result<PulseEngines, EngineRefusal> {
        let pulse = self.pulse(key);
        let Sketch { elements, lines } = self.sketch(key)?;
        let line = |(array, design): (&Option<ArrayGeometry>, _)| {
            let both = array.as_ref().zip(design);
            let engine =
                |(array, design)| GriddedLines::of_design(&self.line(key, &pulse, array), design);
            both.map(engine).transpose()
        };
        let lines = self.lines.iter().zip(lines).map(line);
        Ok(PulseEngines {
            elements: elements.map(|design| design.build(self.threads)),
            lines: lines.collect::<Result<_, _>>()?,
        })
    }
}

/// The length of record that an engine for `count` samples is made for: steps of the square root of two below `most`, so that a range that
/// changes by a little needs no other engine, and none is twice as long as needed.
fn record_class(count: usize, most: usize) -> usize {
    let mut class = most;
    loop {
        let shorter = (class as f64 * FRAC_1_SQRT_2).ceil() as usize;
        if shorter < count.max(SHORTEST) || shorter >= class {
            return class;
        }
        class = shorter;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_class_holds_its_records_and_is_less_than_half_as_long_again() {
        for most in [1, 255, 256, 1000, 3217, 100_000] {
            for count in (1..=most).step_by(1 + most / 300) {
                let class = record_class(count, most);
                assert!(
                    (count..=most).contains(&class),
                    "{count} of {most}: {class}"
                );
                if class > 2 * SHORTEST {
                    assert!(
                        (class as f64) < 1.42 * count as f64 + 2.0,
                        "{count}: {class}"
                    );
                }
            }
        }
        let classes: std::collections::HashSet<_> =
            (1..=100_000).map(|n| record_class(n, 100_000)).collect();
        assert!(classes.len() < 20, "{}", classes.len());
    }
}

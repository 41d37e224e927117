//! Named targets: points above the seabed (CSV) and solids anywhere in the water (TOML), as scatterers.
//!
//! CSV columns: `name,north_m,east_m,height_above_seabed_m,target_strength_db`, metres from the scene's origin. Each row is a point scatterer with
//! pressure 10^(TS/20) and phase 0. TS is the ratio of intensities at 1 m (Urick 1983, Principles of Underwater Sound, 9.1). TOML: [`file`].
//!
//! The surface of a solid scatters by Lambert's law. Its scatterers are spread evenly over its area, each with a fixed circular Gaussian
//! reflectivity. The mean target strength over all directions is mu area / 6 for any convex shape: the mean of cos^2 over the facing half sphere, by
//! Cauchy's argument. A sphere has this strength in every direction. Normals silence the far side; the occlusion finds shadows through
//! [`Targets::hits`]. Not modelled: resonance, the coherent glint of smooth bodies, elastic waves, echoes between targets.

mod file;
pub(crate) mod mesh;
pub(crate) mod random;
pub(crate) mod solid;
mod surface;
pub(crate) mod swarm;
mod track;

#[cfg(test)]
mod tests;

use std::ops::{Range, RangeInclusive};
use std::path::Path;

use glam::DVec3;
use num_complex::Complex64;

use super::text::{self, Column, MAX_HORIZONTAL_M, MAX_VERTICAL_M, TextError, required};
use crate::Files;
use echotank_core::frames::VectorKnot;
use echotank_core::scene::{Course, MovingScatterer, ScatterLaw, Scatterers, Target};
use echotank_core::time::UtcNs;
use random::KeyedRandom;
use solid::Solid;
use swarm::{Swarm, SwarmShape};

/// Greatest number of targets. The truth record of every ping carries all of them.
pub(crate) const MAX_TARGETS: usize = 10_000;
/// Greatest number of scatterers of all targets together: 4 million take some 300 MiB.
pub(crate) const MAX_TARGET_SCATTERERS: usize = 1 << 22;
/// Least number of scatterers of a solid, so that its strength varies little with the direction.
const MIN_SCATTERERS: usize = 64;
/// Time over which the acceleration of a target is measured, to both sides, seconds.
const TRACK_STEP_S: f64 = 2e-3;

const MAX_NAME_CHARACTERS: usize = 64;
/// Accepted target strengths, dB. A krill has -90 dB, a submarine +30 dB.
const STRENGTHS_DB: RangeInclusive<f64> = -150.0..=100.0;

const COLUMNS: [Column; 5] = [
    required("name"),
    required("north_m"),
    required("east_m"),
    required("height_above_seabed_m"),
    required("target_strength_db"),
];

/// Separates these random numbers from other uses of the scene's seed. A change of the algorithm needs a new version here.
const KEY_LABEL: &[u8; 24] = b"echotank targets    v001";

/// A target as its file describes it, in scene coordinates.
#[derive(Clone, Debug)]
pub struct ParsedTarget {
    pub target: Target,
    pub body: Body,
    /// Its motion, if it moves as a whole.
    course: Option<ParsedCourse>,
    /// Line of the file.
    line: usize,
}

/// Motion of a target as its file describes it, in scene coordinates.
#[derive(Clone, Debug)]
pub(crate) struct ParsedCourse {
    knots: Vec<VectorKnot>,
    /// Instant from which the knots count; the first fix if there is none.
    origin: Option<UtcNs>,
}

/// The folder that mesh names in a target table are relative to, and the access to its files.
#[derive(Clone, Copy)]
pub struct MeshFolder<'a> {
    /// Opens the mesh files.
    pub files: &'a dyn Files,
    /// The folder of the target table.
    pub path: &'a Path,
}

#[derive(Clone, Debug)]
pub enum Body {
    Point,
    Solid {
        solid: Solid,
        /// Lambert's mu of its surface, linear.
        lambert: f64,
        density_per_m2: f64,
    },
    /// A school or a plume: shape, number, and target strength of each individual.
    Swarm {
        shape: SwarmShape,
        count: usize,
        each_db: f64,
    },
}

/// All targets of a scene with their scatterers, in scene coordinates.
#[derive(Clone, Debug, Default)]
pub struct Targets {
    named: Vec<Target>,
    /// Solid of each target, if it has one.
    solids: Vec<Option<Solid>>,
    /// Centre and radius of a bounding sphere of each target, metres.
    balls_m: Vec<(DVec3, f64)>,
    scatterers: Scatterers,
    /// Area that each scatterer represents, square metres; 0 for a point.
    area_m2: Vec<f64>,
    /// Range of scatterers of each target.
    spans: Vec<Range<usize>>,
    /// Echo pressure at 1 m of all scatterers of each target, summed with random phases as if all faced the sonar.
    strengths: Vec<f64>,
    /// Individuals of each target that is a swarm.
    swarms: Vec<Option<Swarm>>,
    /// Time of the first fix, from which motion without a date counts.
    epoch: UtcNs,
    /// Without a date in its file.
    undated: Vec<bool>,
}

impl Targets {
    /// Reads a CSV table, or a TOML table if `toml` names its folder.
    ///
    /// `seabed_down_m` returns the depth of the seabed at (north, east), metres, or none where there is no seabed.
    ///
    /// # Errors
    /// Returns the line, the value and the rule it breaks.
    pub fn parse(
        bytes: &[u8],
        toml: Option<MeshFolder>,
        seed: u64,
        seabed_down_m: impl Fn(f64, f64) -> Option<f64>,
    ) -> Result<Self, TextError> {
        let placed = match toml {
            Some(folder) => file::parse(bytes, folder, &seabed_down_m)?,
            None => parse(bytes, seabed_down_m)?
                .into_iter()
                .map(|target| ParsedTarget {
                    target,
                    body: Body::Point,
                    course: None,
                    line: 0,
                })
                .collect(),
        };
        Self::new(placed, seed)
    }

    /// Makes the scatterers. Rejects more than [`MAX_TARGET_SCATTERERS`].
    pub fn new(placed: Vec<ParsedTarget>, seed: u64) -> Result<Self, TextError> {
        let mut all = Self::default();
        for (index, parsed) in placed.into_iter().enumerate() {
            let ParsedTarget {
                mut target,
                body,
                course,
                line,
            } = parsed;
            let first = all.scatterers.len();
            all.undated
                .push(course.as_ref().is_some_and(|c| c.origin.is_none()));
            target.course = course.map(|course| Course {
                knots: course.knots.into(),
                origin: course.origin.unwrap_or_default(),
                offset_m: DVec3::ZERO,
            });
            let mut swarm = None;
            match body {
                Body::Swarm {
                    shape,
                    count,
                    each_db,
                } => {
                    let made = Swarm::new(shape, count, linear(each_db), seed, index);
                    let (middle_m, radius_m) = made.ball_m();
                    all.balls_m.push((target.position_m + middle_m, radius_m));
                    all.solids.push(None);
                    if !made.is_moving() && target.course.is_none() {
                        if first + count > MAX_TARGET_SCATTERERS {
                            let rule = format!(
                                "all targets together may take {MAX_TARGET_SCATTERERS} scatterers"
                            );
                            return Err(TextError::new(line, &target.name, rule).in_column("name"));
                        }
                        for k in 0..count {
                            let one = made.individual(k, 0.0);
                            let at_m = target.position_m + one.offset_m;
                            all.scatterers
                                .push(at_m, super::UP, one.strength, ScatterLaw::Point);
                            all.area_m2.push(0.0);
                        }
                    }
                    swarm = Some(made);
                }
                Body::Point => {
                    all.balls_m.push((target.position_m, 0.0));
                    all.scatterers.push(
                        target.position_m,
                        super::UP,
                        strength(&target),
                        ScatterLaw::Point,
                    );
                    all.area_m2.push(0.0);
                    all.solids.push(None);
                }
                Body::Solid {
                    solid,
                    lambert,
                    density_per_m2,
                } => {
                    let area_m2 = solid.area_m2();
                    let wanted = (area_m2 * density_per_m2).ceil().max(MIN_SCATTERERS as f64);
                    if first as f64 + wanted > MAX_TARGET_SCATTERERS as f64 {
                        let rule = format!(
                            "has an area of {area_m2:.1} m2 and would take {wanted:.0} scatterers; all targets together may take {MAX_TARGET_SCATTERERS}: lower its density_per_m2"
                        );
                        return Err(TextError::new(line, &target.name, rule).in_column("name"));
                    }
                    let mut chance = KeyedRandom::new(seed, KEY_LABEL, index as u64);
                    let share_m2 = area_m2 / wanted;
                    let amplitude = (lambert * share_m2).sqrt();
                    solid.sample(wanted as usize, &mut chance, |point, chance| {
                        let reflectivity = amplitude * chance.circular_gaussian();
                        let normal = point.normal.as_vec3().to_array();
                        all.scatterers.push(
                            point.position_m,
                            normal,
                            reflectivity,
                            ScatterLaw::Lambert,
                        );
                        all.area_m2.push(share_m2);
                    });
                    let (low, high) = solid.bounds_m();
                    all.balls_m
                        .push(((low + high) / 2.0, low.distance(high) / 2.0));
                    // What moves casts no shadow.
                    all.solids.push(target.course.is_none().then_some(solid));
                }
            }
            let own = &all.scatterers.strength[first..];
            all.strengths
                .push(own.iter().map(|s| s.norm_sqr()).sum::<f64>().sqrt());
            all.spans.push(first..all.scatterers.len());
            all.swarms.push(swarm);
            all.named.push(target);
        }
        Ok(all)
    }

    /// Number of targets.
    pub fn len(&self) -> usize {
        self.named.len()
    }
    /// Whether there are no targets.
    pub fn is_empty(&self) -> bool {
        self.named.is_empty()
    }
    /// Targets in the order of their file, scene coordinates.
    pub fn named(&self) -> &[Target] {
        &self.named
    }
    /// Whether a target moves, as a whole or in itself.
    pub(crate) fn is_moving(&self, target: usize) -> bool {
        let swarm = self.swarms[target].as_ref();
        self.named[target].course.is_some() || swarm.is_some_and(Swarm::is_moving)
    }
    /// Sets the time of the first fix.
    pub(crate) fn start(&mut self, epoch: UtcNs) {
        self.epoch = epoch;
        for (target, undated) in self.named.iter_mut().zip(&self.undated) {
            if let (Some(course), true) = (&mut target.course, *undated) {
                course.origin = epoch;
            }
        }
    }
    /// Place and velocity of a target, scene coordinates, `after_s` seconds after an instant.
    fn state(&self, target: usize, utc: UtcNs, after_s: f64) -> (DVec3, DVec3) {
        let named = &self.named[target];
        let course = named.course.as_ref();
        course.map_or((named.position_m, DVec3::ZERO), |c| c.at(utc, after_s))
    }
    /// Centre and radius of a bounding sphere of a target at an instant, metres.
    pub(crate) fn ball_at(&self, target: usize, utc: UtcNs) -> (DVec3, f64) {
        let (center_m, radius_m) = self.balls_m[target];
        let moved_m = self.state(target, utc, 0.0).0 - self.named[target].position_m;
        (center_m + moved_m, radius_m)
    }
    /// Passes the scatterers of a moving target to `take`, in scene coordinates, as the sound of a pulse at `utc` from `eye_m` finds them.
    pub(crate) fn moving(
        &self,
        target: usize,
        utc: UtcNs,
        (eye_m, c): (DVec3, f64),
        mut take: impl FnMut(MovingScatterer),
    ) {
        let since_s = (utc.0 - self.epoch.0) as f64 * 1e-9;
        // The place where the sound meets the scatterer; each round is better by the ratio of the speeds.
        let at_hit = |place: &dyn Fn(f64) -> (DVec3, DVec3)| {
            let mut hit_s = 0.0;
            for _ in 0..3 {
                hit_s = place(hit_s).0.distance(eye_m) / c;
            }
            let (at_m, velocity) = place(hit_s);
            (at_m - velocity * hit_s, velocity, hit_s)
        };
        // Of the target as a whole: its velocity is linear between the rows of a track.
        let accelerates = |hit_s: f64| {
            let [before, after] = [-TRACK_STEP_S, TRACK_STEP_S]
                .map(|step_s| self.state(target, utc, hit_s + step_s).1);
            (after - before) / (2.0 * TRACK_STEP_S)
        };
        if let Some(swarm) = &self.swarms[target] {
            for k in 0..swarm.count {
                let place = |after_s: f64| {
                    let (at_m, velocity) = self.state(target, utc, after_s);
                    let one = swarm.individual(k, since_s + after_s);
                    (at_m + one.offset_m, velocity + one.velocity_m_per_s)
                };
                let (position_m, velocity_m_per_s, hit_s) = at_hit(&place);
                let one = swarm.individual(k, since_s + hit_s);
                take(MovingScatterer {
                    position_m,
                    velocity_m_per_s,
                    acceleration_m_per_s2: accelerates(hit_s) + one.acceleration_m_per_s2,
                    hit_s,
                    normal: super::UP,
                    strength: swarm.individual(k, since_s).strength,
                    law: ScatterLaw::Point,
                    target: target as u32,
                    transmit: None,
                });
            }
            return;
        }
        let from_m = self.named[target].position_m;
        for i in self.span(target) {
            let offset_m = self.scatterers.position_m(i) - from_m;
            let place = |after_s: f64| {
                let (at_m, velocity) = self.state(target, utc, after_s);
                (at_m + offset_m, velocity)
            };
            let (position_m, velocity_m_per_s, hit_s) = at_hit(&place);
            take(MovingScatterer {
                position_m,
                velocity_m_per_s,
                acceleration_m_per_s2: accelerates(hit_s),
                hit_s,
                normal: self.scatterers.normal[i],
                strength: self.scatterers.strength[i],
                law: self.scatterers.law[i],
                target: target as u32,
                transmit: None,
            });
        }
    }
    /// Solid of a target; none for a point.
    pub fn solid(&self, target: usize) -> Option<&Solid> {
        self.solids[target].as_ref()
    }
    /// Centre and radius of a bounding sphere of a target, metres.
    pub(crate) fn ball_m(&self, target: usize) -> (DVec3, f64) {
        self.balls_m[target]
    }
    /// Scatterers of all targets, scene coordinates.
    pub fn scatterers(&self) -> &Scatterers {
        &self.scatterers
    }
    /// Area that a scatterer represents, square metres; 0 for a point.
    pub fn area_m2(&self, scatterer: usize) -> f64 {
        self.area_m2[scatterer]
    }
    /// Range of scatterers of a target.
    pub fn span(&self, target: usize) -> Range<usize> {
        self.spans[target].clone()
    }
    /// Index of the target that a scatterer belongs to.
    pub(crate) fn target_of(&self, scatterer: usize) -> usize {
        self.spans.partition_point(|span| span.end <= scatterer)
    }

    /// Whether a ray meets any of the solids `which` nearer than `max_m`.
    ///
    /// `origin_m` is in scene coordinates, `direction` is a unit vector. A ray that starts on a solid's surface and points outward does not meet that
    /// solid.
    pub fn hits(&self, which: &[usize], origin_m: DVec3, direction: DVec3, max_m: f64) -> bool {
        which.iter().any(|&target| {
            let Some(solid) = &self.solids[target] else {
                return false;
            };
            let (center_m, radius_m) = self.balls_m[target];
            let to_m = center_m - origin_m;
            let along_m = to_m.dot(direction).clamp(0.0, max_m.max(0.0));
            let nearest_m = (to_m - direction * along_m).length_squared();
            nearest_m <= radius_m * radius_m && solid.hits(origin_m, direction, max_m)
        })
    }

    /// Echo pressure at 1 m of all scatterers of a target together, as if all faced the sonar.
    pub fn strength(&self, target: usize) -> f64 {
        self.strengths[target]
    }

    /// Appends the scatterers of one target to `out`, moved by `anchor_m`, with the pattern-floor factor `loud`.
    pub fn gather(&self, target: usize, anchor_m: DVec3, loud: f32, out: &mut Scatterers) {
        let span = self.span(target);
        let own = &self.scatterers;
        out.north_m
            .extend(own.north_m[span.clone()].iter().map(|n| n + anchor_m.x));
        out.east_m
            .extend(own.east_m[span.clone()].iter().map(|e| e + anchor_m.y));
        out.down_m
            .extend(own.down_m[span.clone()].iter().map(|d| d + anchor_m.z));
        out.normal.extend_from_slice(&own.normal[span.clone()]);
        out.strength.extend_from_slice(&own.strength[span.clone()]);
        out.law.extend_from_slice(&own.law[span]);
        out.loud.resize(out.len(), loud);
    }
}

/// Lambert's mu of a convex surface whose target strength averaged over all directions is `mean_db`.
///
/// A patch dA returns mu cos^2 dA if it faces the sonar. The mean of cos^2 over all directions, half of which face it, is 1/6.
pub(crate) fn lambert_of_mean(mean_db: f64, area_m2: f64) -> f64 {
    6.0 * libm::pow(10.0, mean_db / 10.0) / area_m2
}

/// Mean target strength of a convex surface, dB: the inverse of [`lambert_of_mean`].
pub(crate) fn mean_strength_db(lambert: f64, area_m2: f64) -> f64 {
    10.0 * libm::log10(lambert * area_m2 / 6.0)
}

/// Checks a target's name. The error is the rule that it breaks.
fn check_name(name: &str) -> Result<(), String> {
    if name.is_empty() || name.chars().count() > MAX_NAME_CHARACTERS {
        return Err(format!("must have 1 to {MAX_NAME_CHARACTERS} characters"));
    }
    if name.chars().any(char::is_control) {
        return Err("must hold no control characters".to_owned());
    }
    Ok(())
}

/// Reads the point targets of a CSV table, in scene coordinates. `seabed_down_m` returns the depth of the seabed at (north, east), or none.
pub(crate) fn parse(
    bytes: &[u8],
    seabed_down_m: impl Fn(f64, f64) -> Option<f64>,
) -> Result<Vec<Target>, TextError> {
    let mut targets: Vec<Target> = Vec::new();
    text::read_table(bytes, &COLUMNS, |row| {
        if targets.len() == MAX_TARGETS {
            return Err(row.text_error(0, format!("at most {MAX_TARGETS} targets are read")));
        }
        let name = row.text(0).unwrap_or("");
        check_name(name).map_err(|rule| row.text_error(0, rule))?;
        if targets.iter().any(|t| t.name == name) {
            return Err(row.text_error(0, "must be unique among the targets"));
        }
        let north_m = row.number(1, -MAX_HORIZONTAL_M..=MAX_HORIZONTAL_M, 0.0)?;
        let east_m = row.number(2, -MAX_HORIZONTAL_M..=MAX_HORIZONTAL_M, 0.0)?;
        let height_m = row.number(3, 0.0..=MAX_VERTICAL_M, 0.0)?;
        let Some(seabed_m) = seabed_down_m(north_m, east_m) else {
            let rule = format!(
                "needs a seabed below it; at north {north_m}, east {east_m} the scene has none"
            );
            return Err(row.text_error(0, rule));
        };
        targets.push(Target {
            name: name.to_owned(),
            position_m: DVec3::new(north_m, east_m, seabed_m - height_m),
            target_strength_db: row.number(4, STRENGTHS_DB, 0.0)?,
            course: None,
        });
        Ok(())
    })?;
    Ok(targets)
}

/// Echo pressure of a target at 1 m for unit incident pressure.
pub(crate) fn strength(target: &Target) -> Complex64 {
    Complex64::from(linear(target.target_strength_db))
}

fn linear(strength_db: f64) -> f64 {
    libm::pow(10.0, strength_db / 20.0)
}

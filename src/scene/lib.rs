//! The virtual seabed: scatterers of the bottom, of explicit points and of targets, made on demand for each ping.
//!
//! Input: a checked [`SceneSpec`] and, for each ping, the footprints of its arrays. Output: [`Scatterers`] in world coordinates. The scene has an
//! origin of its own. [`Scene::place`] moves that origin in the world. All data are made and kept in scene coordinates, so the seabed does not depend
//! on where the scene lies. The crate opens no file. The caller passes [`Files`]. The sea surface is a scene of its own, a plane (`echotank_ping`).

#![warn(missing_docs)]
#![cfg_attr(not(test), deny(clippy::disallowed_methods))]

mod bottoms;
pub mod draws;
mod gather;
mod occlusion;
pub mod paper;
mod pattern_floor;
mod piece;
pub mod points;
mod pool;
pub mod read;
mod seabed;
pub mod simplify;
mod targets;
mod thinning;
mod tiles;
pub mod volume;

#[cfg(test)]
mod unit_tests;

use std::path::{Path, PathBuf};
use std::sync::Arc;

use glam::DVec2;
use rayon::prelude::*;

pub use bottoms::{ReflectingBottom, reflecting_bottom};
use echotank_config::spec::{AnchorSpec, SceneSpec, SeabedShape};
use echotank_core::ping::SceneCounts;
use echotank_core::scene::{Footprint, Scatterers, Target};
use echotank_core::time::UtcNs;
use gather::{GatherContext, Gatherer};
pub use occlusion::legs::{BottomWay, DirectSight, LegShadows};
use occlusion::{Occluders, Occlusion};
use pattern_floor::FloorReference;
use pool::TilePool;
pub use read::Files;
use read::{FormatError, text};
use seabed::{GeodeticPlace, Surface};
pub use targets::{MeshFolder, Targets};
pub use text::{MAX_FILE_BYTES, TextError};
pub use tiles::TILE_BYTES;
use tiles::{Levels, Recipe};
use volume::{VolumeDirections, VolumeField, VolumePing};

/// Surface normal of scatterers that have none.
const UP: [f32; 3] = [0.0, 0.0, -1.0];

/// Points and scatterers of targets that one task tests for shadows, at least.
const MIN_SEEN: usize = 128;

/// Error in a scene's files or limits.
#[derive(Debug, thiserror::Error)]
pub enum SceneError {
    /// The file cannot be opened or read.
    #[error("{}: cannot be read: {source}", path.display())]
    Read {
        /// Path of the file.
        path: PathBuf,
        /// Error of the file system.
        source: std::io::Error,
    },
    /// The file exceeds [`MAX_FILE_BYTES`].
    #[error("{}: exceeds the limit of {MAX_FILE_BYTES} bytes", path.display())]
    TooLarge {
        /// Path of the file.
        path: PathBuf,
    },
    /// A line of a text file breaks a rule.
    #[error("{}: {error}", path.display())]
    Text {
        /// Path of the file.
        path: PathBuf,
        /// Line, value and rule.
        error: TextError,
    },
    /// A seabed, mosaic or mesh file breaks a rule of its format.
    #[error("{}: {error}", path.display())]
    Format {
        /// Path of the file.
        path: PathBuf,
        /// Location, value and rule.
        error: FormatError,
    },
    /// The configured memory limit is smaller than one tile.
    #[error(
        "scene.memory_limit_bytes = {limit_bytes}: must be at least {TILE_BYTES}, one tile of the seabed"
    )]
    MemoryLimit {
        /// The configured limit, bytes.
        limit_bytes: u64,
    },
    /// The scene is to be anchored by its file, but the file gives no geodetic position.
    #[error(
        "scene.anchor = \"file\": {what} has no geodetic position (its coordinates must be latitude and longitude or UTM)"
    )]
    NotGeoreferenced {
        /// The seabed's file, or the statement that there is none.
        what: String,
    },
}

/// Shape of the seabed in world coordinates, for use on other threads.
#[derive(Clone, Debug)]
pub struct Ground {
    surface: Arc<Surface>,
    anchor_m: DVec2,
}

impl Ground {
    /// Depth of the seabed at a position in the world, metres. See [`Scene::seabed_down_m`].
    pub fn down_m(&self, north_m: f64, east_m: f64) -> Option<f64> {
        let own = DVec2::new(north_m, east_m) - self.anchor_m;
        Some(self.surface.sample(own.x, own.y)?.down_m)
    }
}

/// Seabed, explicit points and targets around the platform.
#[derive(Debug)]
pub struct Scene {
    /// Origin of the scene in the world, metres north and east.
    anchor_m: DVec2,
    anchor: AnchorSpec,
    seabed: Option<(Recipe, TilePool)>,
    /// Scene coordinates.
    points: Scatterers,
    own_targets: Targets,
    floor_reference: FloorReference,
    /// World coordinates.
    targets: Vec<Target>,
    /// The finite footprints of the current call.
    footprints: Vec<Footprint>,
    gatherer: Gatherer,
    occlusion: Occlusion,
    /// What the sonar does not see directly, and reflected legs may: the first `hidden_ground` lie on the ground.
    hidden: Scatterers,
    hidden_ground: usize,
    /// Index of each target scatterer that the last ping kept.
    target_rows: Vec<usize>,
    /// Whether the arrays of any footprint see each point and each scatterer of a target in range.
    seen: Vec<bool>,
}

impl Scene {
    /// Reads the files of a scene. The origin of the scene lies at the world's origin until [`Scene::place`] is called.
    ///
    /// `memory_limit_bytes` of the specification bounds the tiles. In addition, a grid takes 4 bytes a cell. An explicit point takes about 53 bytes,
    /// and so does every scatterer of a ping.
    ///
    /// # Errors
    /// Returns [`SceneError`] with the path if a file cannot be read or breaks a rule, and if the memory limit is below one tile.
    pub fn open(files: &dyn Files, spec: &SceneSpec) -> Result<Self, SceneError> {
        let seabed = match &spec.seabed {
            None => None,
            Some(seabed) => {
                let block_m = Levels::new(&seabed.density).typical_side_m();
                let surface = Surface::open(files, &seabed.shape, spec.mirror, block_m)?;
                let capacity = spec.memory_limit_bytes / TILE_BYTES;
                if capacity == 0 {
                    return Err(SceneError::MemoryLimit {
                        limit_bytes: spec.memory_limit_bytes,
                    });
                }
                let capacity = usize::try_from(capacity).unwrap_or(usize::MAX);
                let mosaic = match &seabed.mosaic {
                    None => None,
                    Some(mosaic) => {
                        let laid = surface.open_mosaic(files, mosaic, spec.mirror, block_m)?;
                        Some((laid, mosaic.values))
                    }
                };
                let mut recipe = Recipe::new(surface, seabed, spec.seed);
                if let Some((laid, values)) = mosaic {
                    recipe = recipe.with_mosaic(laid, values);
                }
                Some((recipe, TilePool::new(capacity)))
            }
        };
        let placed = seabed
            .as_ref()
            .is_some_and(|(recipe, _)| recipe.surface().geodetic_place().is_some());
        if spec.anchor == AnchorSpec::File && !placed {
            let what = match spec.seabed.as_ref().map(|s| &s.shape) {
                Some(SeabedShape::File { file, .. }) => file.path.display().to_string(),
                _ => "a scene without a seabed from a file".to_owned(),
            };
            return Err(SceneError::NotGeoreferenced { what });
        }
        let mut points = match &spec.points {
            None => Scatterers::default(),
            Some(path) => read(files, path, points::parse)?,
        };
        let recipe = seabed.as_ref().map(|(recipe, _)| recipe);
        let floor_reference = FloorReference::new(recipe, &points);
        for (loud, strength) in points.loud.iter_mut().zip(&points.strength) {
            // The factor is computed for the nearest range, where the scatterers of the seabed are weakest.
            *loud = floor_reference.factor(strength.norm(), recipe, 0.0);
        }
        let targets = match &spec.targets {
            None => Targets::default(),
            Some(path) => read(files, path, |bytes| {
                let toml = path.extension().is_some_and(|e| e == "toml");
                let folder = toml.then(|| MeshFolder {
                    files,
                    path: path.parent().unwrap_or(Path::new(".")),
                });
                Targets::parse(bytes, folder, spec.seed, |north_m, east_m| {
                    let (recipe, _) = seabed.as_ref()?;
                    Some(recipe.surface().sample(north_m, east_m)?.down_m)
                })
            })?,
        };
        Ok(Self {
            target_rows: Vec::with_capacity(targets.scatterers().len()),
            seen: Vec::with_capacity(points.len() + targets.scatterers().len()),
            anchor_m: DVec2::ZERO,
            anchor: spec.anchor,
            seabed,
            points,
            targets: targets.named().to_vec(),
            own_targets: targets,
            floor_reference,
            footprints: Vec::new(),
            gatherer: Gatherer::default(),
            occlusion: Occlusion::new(spec.occlusion),
            hidden: Scatterers::default(),
            hidden_ground: 0,
        })
    }

    /// A point of the scene whose geodetic position follows from the seabed's file; none without such a file.
    pub fn geodetic_place(&self) -> Option<GeodeticPlace> {
        self.seabed.as_ref()?.0.surface().geodetic_place()
    }

    /// Moves the scene's origin to a position in the world, metres.
    ///
    /// The position is that of the first fix, or the position that the seabed's file gives. A scene with the anchor "origin" stays at the world's
    /// origin.
    pub fn place(&mut self, anchor_north_m: f64, anchor_east_m: f64) {
        debug_assert!(anchor_north_m.is_finite() && anchor_east_m.is_finite());
        if self.anchor == AnchorSpec::Origin {
            return;
        }
        self.anchor_m = DVec2::new(anchor_north_m, anchor_east_m);
        for (target, own) in self.targets.iter_mut().zip(self.own_targets.named()) {
            target.position_m = own.position_m + self.anchor_m.extend(0.0);
        }
    }

    /// Targets in world coordinates, in the order of their file.
    pub fn targets(&self) -> &[Target] {
        &self.targets
    }

    /// Depth of the seabed at a position in the world, metres. None in a hole, beyond the edge and without a seabed.
    pub fn seabed_down_m(&self, north_m: f64, east_m: f64) -> Option<f64> {
        let (recipe, _) = self.seabed.as_ref()?;
        let own = DVec2::new(north_m, east_m) - self.anchor_m;
        Some(recipe.surface().sample(own.x, own.y)?.down_m)
    }

    /// The seabed at its current position, for use on other threads; none without a seabed.
    pub fn ground(&self) -> Option<Ground> {
        let (recipe, _) = self.seabed.as_ref()?;
        Some(Ground {
            surface: recipe.shared_surface(),
            anchor_m: self.anchor_m,
        })
    }

    /// Depth of the seabed at a position in the world, and whether the arrays of a footprint of the last [`Scene::gather`] see it. None where there
    /// is no seabed.
    pub fn ground_seen(&self, footprint: usize, north_m: f64, east_m: f64) -> Option<(f64, bool)> {
        let (recipe, _) = self.seabed.as_ref()?;
        let own = DVec2::new(north_m, east_m) - self.anchor_m;
        let down_m = recipe.surface().sample(own.x, own.y)?.down_m;
        let around = Occluders {
            ground: Some(recipe.surface()),
            solids: Some(&self.own_targets),
            on_ground: true,
        };
        let seen = self.occlusion.sees(footprint, own.extend(down_m), around);
        Some((down_m, seen))
    }

    /// Has every [`Scene::gather`] to come keep what the sonar does not see, and prepare the shadows of legs by a surface at this depth.
    pub fn reflect(&mut self, surface_down_m: f64) {
        self.occlusion.reflect(surface_down_m);
    }

    /// Shadows of reflected legs in the last [`Scene::gather`]; none where nothing hides anything, and without [`Scene::reflect`].
    pub fn leg_shadows(&self) -> Option<LegShadows<'_>> {
        let surface_m = self.occlusion.reflecting_m()?;
        let surface = self.seabed.as_ref().map(|(recipe, _)| recipe.surface());
        Some(LegShadows {
            occlusion: &self.occlusion,
            ground: surface.filter(|surface| surface.is_hilly()),
            targets: &self.own_targets,
            anchor_m: self.anchor_m.extend(0.0),
            surface_m,
        })
    }

    /// Scatterers in the footprints of the last [`Scene::gather`] that no array sees directly, and how many of them, the first, lie on the ground. None without
    /// [`Scene::reflect`].
    pub fn hidden(&self) -> (&Scatterers, usize) {
        (&self.hidden, self.hidden_ground)
    }

    /// Fills `labels` with the target number of each scatterer of the last [`Scene::gather`]: 1 is the first target, 0 is no target.
    ///
    /// Scatterers of targets come last. Those that are not of the scene have no label.
    pub fn target_of_each(&self, scatterers: &Scatterers, labels: &mut Vec<u16>) {
        labels.clear();
        labels.resize(scatterers.of_scene(), 0);
        let first = labels.len().saturating_sub(self.target_rows.len());
        for (label, &row) in labels[first..].iter_mut().zip(&self.target_rows) {
            let number = self.own_targets.target_of(row) + 1;
            *label = u16::try_from(number).unwrap_or(u16::MAX);
        }
    }

    /// Whether no scatterer lies within a distance of the apex of any footprint. Returns false if no footprint is finite. Makes no tile.
    pub fn is_clear_within(&mut self, footprints: &[Footprint], within_m: f64) -> bool {
        self.footprints.clear();
        let near = footprints.iter().filter(|f| f.is_finite());
        self.footprints.extend(near.map(|f| Footprint {
            max_range_m: within_m.min(f.max_range_m),
            ..*f
        }));
        if self.footprints.is_empty() {
            return false;
        }
        let anchor_m = self.anchor_m.extend(0.0);
        let is_near = |at_m: glam::DVec3, radius_m: f64| {
            let mut footprints = self.footprints.iter();
            footprints.any(|f| (f.apex_m - anchor_m).distance(at_m) - radius_m <= within_m)
        };
        let points = (0..self.points.len()).any(|k| is_near(self.points.position_m(k), 0.0));
        let targets = (0..self.own_targets.len()).any(|k| {
            let (center_m, radius_m) = self.own_targets.ball_m(k);
            is_near(center_m, radius_m)
        });
        if points || targets {
            return false;
        }
        match &self.seabed {
            None => true,
            Some((recipe, _)) => {
                let mut counts = SceneCounts::default();
                self.gatherer
                    .find(recipe, anchor_m, &self.footprints, &mut counts);
                self.gatherer.boxes().next().is_none()
            }
        }
    }

    /// Fills `out` with the scatterers that the footprints may contain, in an order that depends on the scene and the footprints alone.
    ///
    /// The order is: seabed scatterers that any footprint contains, all explicit points, targets within range of any footprint. Explicit points are
    /// not culled, so an external calculation can use the same ones.
    ///
    /// Runs on all threads of the current pool. Allocates only while `out` or the pool of tiles grows; remaking a tile does not allocate.
    pub fn gather(&mut self, footprints: &[Footprint], out: &mut Scatterers) -> SceneCounts {
        self.footprints.clear();
        // Where scatterers are thinned, those of the faintest directions are few. They are all that a shadow's window has. A depth of 1 is the edge of a fan.
        let thinned = self.seabed.as_ref().map(|(recipe, _)| recipe);
        let thinned = thinned.is_some_and(|recipe| recipe.levels().thinning().is_some());
        let finite = footprints.iter().filter(|f| f.is_finite());
        self.footprints.extend(finite.map(|f| Footprint {
            depth: match thinned && f.depth > 1.0 {
                true => f64::INFINITY,
                false => f.depth,
            },
            ..*f
        }));
        let mut counts = SceneCounts::default();
        let seabed = self.gather_seabed(out, &mut counts);
        self.hidden_ground = match self.occlusion.reflecting_m() {
            Some(_) => counts.shadowed as usize,
            None => 0,
        };
        self.hidden.truncate(self.hidden_ground);
        // Truncated after filling rather than cleared before, so that nothing is written twice.
        out.truncate(seabed);
        self.gather_points(out, &mut counts);
        self.gather_targets(out, &mut counts);
        self.drop_shadowed(seabed, out, &mut counts);
        counts
    }

    /// Appends the scatterers of the water to those of the last [`Scene::gather`]. Returns their number. Only the seabed below them hides them.
    pub fn append_volume(
        &mut self,
        field: &VolumeField,
        directions: &VolumeDirections,
        ping: VolumePing,
        out: &mut Scatterers,
    ) -> u64 {
        let recipe = self.seabed.as_ref().map(|(recipe, _)| recipe);
        let ground = recipe.map(|recipe| (recipe.surface(), self.anchor_m));
        let made = field.append(directions, ping, &self.footprints, ground, out);
        out.appended += made;
        made as u64
    }

    /// Whether targets move.
    pub fn has_moving_targets(&self) -> bool {
        (0..self.own_targets.len()).any(|target| self.own_targets.is_moving(target))
    }

    /// Sets the time from which motion without a date counts, that of the first fix.
    pub fn start_motion(&mut self, epoch: UtcNs) {
        self.own_targets.start(epoch);
        let anchor_m = self.anchor_m.extend(0.0);
        for (target, own) in self.targets.iter_mut().zip(self.own_targets.named()) {
            target.course.clone_from(&own.course);
            if let Some(course) = &mut target.course {
                course.offset_m = anchor_m;
            }
        }
    }

    /// Fills `out.moving` with the scatterers of moving targets within range of any footprint of the last [`Scene::gather`], as the sound of a pulse at
    /// `utc` finds them. Returns their number. The seabed and solids at rest hide them.
    pub fn append_moving(
        &mut self,
        utc: UtcNs,
        sound_speed_m_per_s: f64,
        out: &mut Scatterers,
    ) -> u64 {
        out.moving.clear();
        let Some(around) = self.footprints.first() else {
            return 0;
        };
        let anchor_m = self.anchor_m.extend(0.0);
        let eye = (around.apex_m - anchor_m, sound_speed_m_per_s);
        let surface = self.seabed.as_ref().map(|(recipe, _)| recipe.surface());
        let around = Occluders {
            ground: surface,
            solids: Some(&self.own_targets),
            on_ground: false,
        };
        let targets = &self.own_targets;
        for target in (0..targets.len()).filter(|target| targets.is_moving(*target)) {
            let (center_m, radius_m) = targets.ball_at(target, utc);
            let mut footprints = self.footprints.iter();
            let is_near = footprints
                .any(|f| f.apex_m.distance(center_m + anchor_m) - radius_m <= f.max_range_m);
            if !is_near {
                continue;
            }
            targets.moving(target, utc, eye, |mut scatterer| {
                let own_m = scatterer.position_m;
                let below = surface.and_then(|surface| surface.sample(own_m.x, own_m.y));
                let is_buried = below.is_some_and(|below| own_m.z > below.down_m);
                let sees = |f| self.occlusion.sees(f, own_m, around);
                if !is_buried && (0..self.footprints.len()).any(sees) {
                    scatterer.position_m += anchor_m;
                    out.moving.push(scatterer);
                }
            });
        }
        out.moving.len() as u64
    }

    fn gather_seabed(&mut self, out: &mut Scatterers, counts: &mut SceneCounts) -> usize {
        let (anchor_m, footprints) = (self.anchor_m.extend(0.0), &self.footprints[..]);
        let Some((recipe, pool)) = &mut self.seabed else {
            self.occlusion
                .start(footprints, anchor_m, None, &self.own_targets);
            return 0;
        };
        self.gatherer.find(recipe, anchor_m, footprints, counts);
        let longest_m = footprints.iter().map(|f| f.max_range_m).fold(0.0, f64::max);
        let spacing_m = recipe.levels().spacing_m(longest_m);
        let hilly = recipe.surface().is_hilly().then_some(spacing_m);
        self.occlusion
            .start(footprints, anchor_m, hilly, &self.own_targets);
        for tile_box in self.gatherer.boxes() {
            self.occlusion.mark(tile_box.low_m, tile_box.high_m);
        }
        for point in 0..self.points.len() {
            let at_m = self.points.position_m(point);
            self.occlusion.mark(at_m, at_m);
        }
        for target in 0..self.own_targets.len() {
            let (center_m, radius_m) = self.own_targets.ball_m(target);
            self.occlusion
                .mark(center_m - radius_m, center_m + radius_m);
        }
        self.occlusion.scan(recipe.surface());
        let context = GatherContext {
            anchor_m,
            footprints,
            occlusion: &self.occlusion,
            surface: recipe.surface(),
            targets: &self.own_targets,
            hidden: self.occlusion.reflecting_m().is_some(),
        };
        self.gatherer
            .collect(recipe, pool, context, out, &mut self.hidden, counts)
    }

    /// Removes points and targets that no footprint's arrays see from `out`, from index `first` on.
    fn drop_shadowed(&mut self, first: usize, out: &mut Scatterers, counts: &mut SceneCounts) {
        let anchor_m = self.anchor_m.extend(0.0);
        let around = Occluders {
            ground: self.seabed.as_ref().map(|(recipe, _)| recipe.surface()),
            solids: Some(&self.own_targets),
            on_ground: false,
        };
        let first_target = out.len() - self.target_rows.len();
        let (mut kept, mut kept_targets) = (first, 0);
        self.seen.clear();
        self.seen.resize(out.len() - first, true);
        let footprints = 0..self.footprints.len();
        if !footprints.is_empty() {
            let occlusion = &self.occlusion;
            let each = self.seen.par_iter_mut().with_min_len(MIN_SEEN).enumerate();
            each.for_each(|(i, seen)| {
                let at_m = out.position_m(first + i) - anchor_m;
                *seen = footprints.clone().any(|f| occlusion.sees(f, at_m, around));
            });
        }
        let keep_hidden = self.occlusion.reflecting_m().is_some();
        for (i, seen) in (first..).zip(&self.seen) {
            if !seen && keep_hidden {
                self.hidden.push_copy(out, i, 1.0);
            }
            if *seen {
                out.copy_within(i, kept);
                kept += 1;
                if i >= first_target {
                    self.target_rows[kept_targets] = self.target_rows[i - first_target];
                    kept_targets += 1;
                }
            }
        }
        self.target_rows.truncate(kept_targets);
        counts.shadowed += (out.len() - kept) as u64;
        out.truncate(kept);
    }

    fn gather_points(&self, out: &mut Scatterers, counts: &mut SceneCounts) {
        let points = &self.points;
        out.north_m
            .extend(points.north_m.iter().map(|n| n + self.anchor_m.x));
        out.east_m
            .extend(points.east_m.iter().map(|e| e + self.anchor_m.y));
        out.down_m.extend_from_slice(&points.down_m);
        out.normal.extend_from_slice(&points.normal);
        out.strength.extend_from_slice(&points.strength);
        out.law.extend_from_slice(&points.law);
        out.loud.extend_from_slice(&points.loud);
        counts.points = points.len() as u64;
    }

    fn gather_targets(&mut self, out: &mut Scatterers, counts: &mut SceneCounts) {
        let anchor_m = self.anchor_m.extend(0.0);
        self.target_rows.clear();
        for target in 0..self.own_targets.len() {
            if self.own_targets.is_moving(target) {
                continue;
            }
            let (center_m, radius_m) = self.own_targets.ball_m(target);
            let center_m = center_m + anchor_m;
            let away_m = |f: &Footprint| f.apex_m.distance(center_m) - radius_m;
            if self.footprints.iter().any(|f| away_m(f) <= f.max_range_m) {
                let nearest_m = self
                    .footprints
                    .iter()
                    .map(away_m)
                    .fold(f64::INFINITY, f64::min);
                let strength = self.own_targets.strength(target);
                let recipe = self.seabed.as_ref().map(|(recipe, _)| recipe);
                let loud = self
                    .floor_reference
                    .factor(strength, recipe, nearest_m.max(0.0));
                self.own_targets.gather(target, anchor_m, loud, out);
                self.target_rows.extend(self.own_targets.span(target));
                counts.targets += 1;
            }
        }
    }
}

/// Reads and parses a file, and adds the path to an error.
fn read<T>(
    files: &dyn Files,
    path: &Path,
    parse: impl FnOnce(&[u8]) -> Result<T, TextError>,
) -> Result<T, SceneError> {
    parse(&text::read_file(files, path)?).map_err(|error| SceneError::Text {
        path: path.to_owned(),
        error,
    })
}

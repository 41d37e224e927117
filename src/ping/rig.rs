//! A complete rig: navigation history, scene, and one [`SonarUnit`] per sonar. The daemon and `replay` use the same rig.

use std::sync::Arc;

use thiserror::Error;

use crate::PingOrder;
use crate::element_synthesis::response_half_s;
use crate::faults::Faults;
use crate::method_selection::costs::Costs;
use crate::method_selection::live::MethodSelector;
use crate::multipath::Multipath;
use crate::pipeline::{PipelineError, SonarPipeline};
use crate::plan;
use crate::range_floors::RangeFloorFinder;
use crate::sea_surface::SurfaceSheet;
use crate::volume::VolumeWater;
use crate::world::{SceneSummary, SharedSceneSummary};
use echotank_config::spec::{AnchorSpec, FaultRefused, MediumSpec, RigSpec, SonarSpec};
use echotank_core::arrays::TimeVaryingGain;
use echotank_core::frames::Pose;
use echotank_core::ping::{PingOutput, PingPlan};
use echotank_core::scene::{Scatterers, Target};
use echotank_core::settings::SonarSettings;
use echotank_nav::NavHistory;
use echotank_scene::simplify::energy::View;
use echotank_scene::simplify::stage::{Stage, StageCounts};
use echotank_scene::{Files, Scene, SceneError};
use echotank_synthesis::echo::absorption::absorption_db_per_m;
use echotank_synthesis::echo::rays::VirtualPoints;
use glam::DVec3;

/// Errors of opening a rig.
#[derive(Debug, Error)]
pub enum RigError {
    /// The scene cannot be opened.
    #[error("scene: {0}")]
    Scene(#[from] SceneError),
    /// The pipeline of a sonar cannot be created.
    #[error("sonar {name}: {why}")]
    Sonar {
        /// Name of the sonar.
        name: String,
        /// Cause.
        why: PipelineError,
    },
    /// A configured fault does not fit the rig.
    #[error("fault {number}: {why}")]
    Fault {
        /// Number of the fault among the `[[fault]]` tables, from 1.
        number: usize,
        /// Cause.
        why: FaultRefused,
    },
}

/// A ping with its results, in reusable buffers.
#[derive(Clone, Debug)]
pub struct PingSlot {
    /// The plan of the ping.
    pub plan: PingPlan,
    /// Element samples, beams, lines and counts.
    pub output: PingOutput,
}

/// One sonar of a rig.
pub struct SonarUnit {
    /// Configuration of the sonar.
    pub spec: SonarSpec,
    /// Pipeline from scatterers to beams and lines.
    pub pipeline: SonarPipeline,
    /// Simplification of the scene, which omits scatterers that the ping does not need.
    pub(crate) simplify: Option<(Stage, View)>,
    /// Finds the pattern floors of each ping.
    pub(crate) range_floors: RangeFloorFinder,
    /// One-way absorption at the centre frequency, dB/m.
    pub absorption_db_per_m: f64,
    /// Faults of the rig.
    pub faults: Arc<Faults>,
    /// Selects the methods that the configuration leaves open.
    pub method_selector: Option<MethodSelector>,
    /// With `run.overload = "degrade"`: alternatives to pipeline and method selector, in order of increasing tolerance.
    pub(crate) looser: Vec<DegradationLevel>,
}

/// Pipeline and method selector for a larger tolerance under overload.
pub(crate) struct DegradationLevel {
    tolerance: f64,
    pub(crate) pipeline: SonarPipeline,
    pub(crate) method_selector: Option<MethodSelector>,
}

impl SonarUnit {
    /// Place of the sonar in the world, metres: the mean of its receive arrays.
    pub(crate) fn center_m(&self, pose: &Pose) -> DVec3 {
        let arrays = &self.spec.receive;
        let arms: DVec3 = arrays.iter().map(|array| array.mounting.position_m).sum();
        pose.point_m(arms / arrays.len().max(1) as f64)
    }

    /// Number of tolerance levels: the configured one and the looser ones.
    pub fn levels(&self) -> usize {
        1 + self.looser.len()
    }

    /// Exchanges the pipeline and method selector with those of a level; a second call exchanges them back. Returns the tolerance of a looser level.
    pub(crate) fn swap(&mut self, level: usize) -> Option<f64> {
        let looser = self.looser.get_mut(level.checked_sub(1)?)?;
        std::mem::swap(&mut self.pipeline, &mut looser.pipeline);
        std::mem::swap(&mut self.method_selector, &mut looser.method_selector);
        Some(looser.tolerance)
    }

    /// Prepares the pipelines for pings with these settings.
    pub fn expect(&mut self, settings: &SonarSettings) {
        self.pipeline.expect(settings);
        for level in &mut self.looser {
            level.pipeline.expect(settings);
        }
    }
}

/// State shared by all pings of a rig.
pub struct Rig {
    /// Configuration of the rig.
    pub spec: RigSpec,
    /// Navigation samples.
    pub history: NavHistory,
    /// Virtual seabed and its targets.
    pub scene: Scene,
    /// Sonars, in the order of the configuration.
    pub sonars: Vec<SonarUnit>,
    /// Configured faults and faults of the control API.
    pub faults: Arc<Faults>,
    costs: Arc<Costs>,
    placed: bool,
    /// Summary of the scene for threads other than those of the pings.
    pub world: SharedSceneSummary,
    pub(crate) scatterers: Scatterers,
    /// With a sound-speed profile.
    pub(crate) virtual_points: Option<VirtualPoints>,
    /// Where the sea surface scatters.
    pub(crate) surface: Option<SurfaceSheet>,
    /// Where surface and bottom reflect.
    pub(crate) multipath: Option<Multipath>,
    pub(crate) simplify_counts: StageCounts,
    /// Whether targets move.
    pub(crate) has_moving: bool,
    /// With volume reverberation.
    pub(crate) volume: Option<VolumeWater>,
}

impl Rig {
    /// Opens the scene and allocates every buffer. `costs` is the cost table of the method selection; `files` opens the scene's files. Call inside
    /// the pool that runs the pings.
    ///
    /// # Errors
    /// The scene or a pipeline cannot be opened, or a configured fault does not fit the rig.
    pub fn open(spec: &RigSpec, costs: Costs, files: &dyn Files) -> Result<Self, RigError> {
        let faults = Arc::new(Faults::new(&spec.sonars, &spec.nav.sources));
        for (number, request) in (1..).zip(&spec.faults) {
            let added = faults.add(request);
            added.map_err(|why| RigError::Fault { number, why })?;
        }
        let costs = Arc::new(costs);
        let mut sonars = Vec::new();
        for sonar in &spec.sonars {
            let absorption_db_per_m =
                absorption_db_per_m(&spec.medium.absorption, sonar.pulse.center_frequency_hz);
            let mut sonar = sonar.clone();
            if let TimeVaryingGain::Law {
                absorption_db_per_m: law,
                ..
            } = &mut sonar.receiver.tvg
            {
                // The law compensates the absorption of the medium, whose value is known only here.
                *law = absorption_db_per_m;
            }
            let pipeline = unselected(&sonar, &spec.medium)?;
            sonars.push(SonarUnit {
                simplify: spec.scene.simplify.as_ref().map(|simplify| {
                    let view = View {
                        slack_m: simplify.hold_m,
                        slack_rad: simplify.hold_rad,
                        shadows: simplify.shadows,
                        ..View::default()
                    };
                    (Stage::of_spec(simplify, spec.scene.seed), view)
                }),
                pipeline,
                method_selector: MethodSelector::new(&sonar, &spec.medium, costs.clone()),
                looser: Vec::new(),
                spec: sonar,
                range_floors: RangeFloorFinder::default(),
                absorption_db_per_m,
                faults: faults.clone(),
            });
        }
        let mut scene = Scene::open(files, &spec.scene)?;
        let multipath = Multipath::of(spec);
        if let Some(multipath) = &multipath {
            scene.reflect(multipath.surface_down_m());
        }
        Ok(Self {
            spec: spec.clone(),
            history: NavHistory::new(&spec.nav),
            has_moving: scene.has_moving_targets(),
            scene,
            sonars,
            faults,
            costs,
            placed: false,
            world: SharedSceneSummary::default(),
            scatterers: Scatterers::default(),
            surface: SurfaceSheet::open(files, spec)?,
            multipath,
            virtual_points: spec.medium.profile.clone().map(VirtualPoints::new),
            simplify_counts: StageCounts::default(),
            volume: spec.medium.volume.as_ref().map(|volume| {
                VolumeWater::new(volume, spec.scene.seed, &spec.sonars, &spec.medium)
            }),
        })
    }

    /// Creates the pipelines with looser tolerances for overload. Call inside the pool that runs the pings.
    ///
    /// # Errors
    /// A pipeline cannot be created.
    pub fn make_looser(&mut self) -> Result<(), RigError> {
        for unit in &mut self.sonars {
            for tolerance in unit.spec.looser_tolerances() {
                let mut spec = unit.spec.clone();
                spec.synthesis.tolerance = tolerance;
                let medium = &self.spec.medium;
                let pipeline = unselected(&spec, medium)?;
                let method_selector = MethodSelector::new(&spec, medium, self.costs.clone());
                unit.looser.push(DegradationLevel {
                    tolerance,
                    pipeline,
                    method_selector,
                });
            }
        }
        Ok(())
    }

    /// Creates the engines of the configured starting methods for sonars whose synthesis is selected, but without navigation for a first selection. A
    /// sonar whose starting engine is refused keeps the direct sum until a selection. Call inside the pool that runs the pings.
    pub fn make_starting_engines(&mut self) {
        let medium = &self.spec.medium;
        for unit in &mut self.sonars {
            let own = (&mut unit.pipeline, &mut unit.method_selector);
            let looser = unit.looser.iter_mut();
            let looser = looser.map(|level| (&mut level.pipeline, &mut level.method_selector));
            for (pipeline, method_selector) in std::iter::once(own).chain(looser) {
                if let Some(method_selector) = method_selector {
                    method_selector.start(medium, pipeline);
                }
            }
        }
    }

    /// Properties of the water.
    pub fn medium(&self) -> &MediumSpec {
        &self.spec.medium
    }

    /// Allocates a slot for the largest ping of this sonar.
    pub fn slot(&self, sonar: usize) -> PingSlot {
        let unit = &self.sonars[sonar];
        PingSlot {
            plan: plan::blank(
                sonar,
                &unit.spec,
                &self.spec.medium,
                unit.absorption_db_per_m,
            ),
            output: unit.pipeline.blank_output(),
        }
    }

    /// Receive window of an order, s.
    pub fn window_s(&self, sonar: usize, order: &PingOrder) -> f64 {
        let c = self.spec.medium.sound_speed_m_per_s;
        let rate_hz = self.sonars[sonar].spec.receiver.sample_rate_hz;
        plan::sample_count(&order.settings, c, rate_hz) as f64 / rate_hz
    }

    /// How long an order needs the motion of the platform, s: in the receive window, and as far as the receiver filter looks ahead.
    pub fn motion_s(&self, sonar: usize, order: &PingOrder) -> f64 {
        let c = self.spec.medium.sound_speed_m_per_s;
        self.window_s(sonar, order) + response_half_s(&self.sonars[sonar].spec, c)
    }

    /// Scatterers used by the last ping.
    pub fn scatterers(&self) -> &Scatterers {
        &self.scatterers
    }

    /// Named targets in the world; empty until the scene is placed.
    pub fn targets(&self) -> &[Target] {
        if self.placed {
            self.scene.targets()
        } else {
            &[]
        }
    }

    /// Places the scene once the first fix is known.
    pub(crate) fn place_scene(&mut self) {
        if self.placed {
            return;
        }
        if let Some(first) = self.history.first_fix_local() {
            let (north_m, east_m) = match self.spec.scene.anchor {
                AnchorSpec::Origin => (0.0, 0.0),
                AnchorSpec::FirstFix => (first.x, first.y),
                AnchorSpec::File => self.where_the_file_lies(),
            };
            self.scene.place(north_m, east_m);
            if let (true, Some(epoch)) = (self.has_moving, self.history.first_fix_utc()) {
                self.scene.start_motion(epoch);
            }
            self.placed = true;
            self.world.get_or_init(|| SceneSummary::of(&self.scene));
        }
    }

    /// Position of the scene's origin on the plane of the world, from the geodetic position in the seabed's file. The scene is not rotated: 10 km
    /// east of the world's origin, at latitude 45, its north is off by 0.09 degrees (meridian convergence).
    fn where_the_file_lies(&self) -> (f64, f64) {
        match (self.scene.geodetic_place(), self.history.origin()) {
            (Some(place), Some(plane)) => {
                let (north_m, east_m) = plane.local_m(place.latitude_rad, place.longitude_rad);
                (north_m - place.north_m, east_m - place.east_m)
            }
            // The scene requires a geodetic position when it is opened, and a first fix defines the plane.
            _ => (0.0, 0.0),
        }
    }

    /// Computes the first samples of a prepared ping, up to `end`, into `tile`. Returns false if the ping can only be computed as a whole.
    pub fn begin(
        &mut self,
        sonar: usize,
        slot: &mut PingSlot,
        (end, is_first): (usize, bool),
        tile: &mut PingSlot,
    ) -> bool {
        let scatterers = std::mem::take(&mut self.scatterers);
        let made = self.begin_of(sonar, slot, (end, is_first), &scatterers, tile);
        self.scatterers = scatterers;
        made
    }

    /// Like [`Rig::begin`], for a ping that is only planned. Returns false if an echo is possible before `end`.
    pub fn begin_quiet(
        &mut self,
        sonar: usize,
        slot: &mut PingSlot,
        end: usize,
        tile: &mut PingSlot,
    ) -> bool {
        let unit = &mut self.sonars[sonar];
        // A simplified scatterer can be nearer than each of the scatterers that it represents, and a virtual point nearer than its scatterer. Scatterers of the
        // water are everywhere, what moves is not in its place before it is gathered, and the scene does not hold the sea surface.
        let changes = self.volume.is_some() || self.has_moving || self.surface.is_some();
        if changes || unit.simplify.is_some() || slot.plan.refraction.is_some() {
            return false;
        }
        let pipeline = &mut unit.pipeline;
        let within_m = pipeline.max_echo_range_m(&mut slot.plan, end);
        self.scene
            .is_clear_within(pipeline.footprints(&slot.plan), within_m)
            && self.begin_of(sonar, slot, (end, true), &Scatterers::default(), tile)
    }

    fn begin_of(
        &mut self,
        sonar: usize,
        slot: &mut PingSlot,
        (end, is_first): (usize, bool),
        scatterers: &Scatterers,
        tile: &mut PingSlot,
    ) -> bool {
        let unit = &mut self.sonars[sonar];
        if !unit.pipeline.faults_mut().is_empty() {
            return false;
        }
        let elements = &mut tile.output.elements;
        let plan = &mut slot.plan;
        unit.pipeline
            .begin_ping(plan, end, is_first, scatterers, elements);
        tile.plan.clone_from(&slot.plan);
        true
    }
}

/// The pipeline of a sonar before any selection: without an engine where the synthesis is selected.
fn unselected(spec: &SonarSpec, medium: &MediumSpec) -> Result<SonarPipeline, RigError> {
    let mut start = spec.clone();
    start.model = MethodSelector::start_model(spec);
    SonarPipeline::new(&start, medium).map_err(|why| RigError::Sonar {
        name: spec.name.clone(),
        why,
    })
}

//! Summary of the scene for threads beside the ping path: positions of targets and depth of the seabed.

use std::sync::{Arc, OnceLock};

use echotank_core::scene::Target;
use echotank_scene::{Ground, Scene};

/// Targets and ground of a scene after placement.
pub struct SceneSummary {
    /// Targets in world coordinates.
    pub targets: Vec<Target>,
    /// Seabed, if the scene has one.
    pub ground: Option<Ground>,
}

/// Set once, when the scene is placed at the first position fix.
pub type SharedSceneSummary = Arc<OnceLock<SceneSummary>>;

impl SceneSummary {
    /// Copies the targets and the ground of `scene`.
    pub fn of(scene: &Scene) -> Self {
        Self {
            targets: scene.targets().to_vec(),
            ground: scene.ground(),
        }
    }
}

//! What the scene is to those who look on: where its targets lie and how deep the seabed is, for threads beside the pings.

use std::sync::{Arc, OnceLock};

use echotank_core::flow::Target;
use echotank_scene::{Ground, Scene};

/// The scene where it was placed.
pub struct World {
    pub targets: Vec<Target>,
    pub ground: Option<Ground>,
}

/// Filled once, when the scene is placed under the first fix.
pub type Placed = Arc<OnceLock<World>>;

impl World {
    pub fn of(scene: &Scene) -> Self {
        Self {
            targets: scene.targets().to_vec(),
            ground: scene.ground(),
        }
    }
}

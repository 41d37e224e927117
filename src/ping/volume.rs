//! Volume reverberation in a ping: directions of every sonar, and the scatterers of the water behind those of the scene.

use glam::{DQuat, DVec3};

use crate::footprints::footprints;
use crate::plan;
use crate::rig::Rig;
use crate::schedule::PingOrder;
use echotank_config::spec::{MediumSpec, SonarSpec, VolumeSpec};
use echotank_core::frames::Trajectory;
use echotank_core::ping::{PingPlan, SceneCounts};
use echotank_core::scene::Scatterers;
use echotank_core::time::UtcNs;
use echotank_scene::volume::{VolumeAperture, VolumeDirections, VolumeField, VolumePing};

/// Cosine between the boresights of two arrays above which they look the same way.
const SAME_WAY: f64 = 0.9;

/// Water with volume reverberation.
pub(crate) struct VolumeWater {
    field: VolumeField,
    /// Of each sonar.
    directions: Vec<VolumeDirections>,
}

impl VolumeWater {
    /// Divides the directions of every sonar.
    pub(crate) fn new(
        spec: &VolumeSpec,
        seed: u64,
        sonars: &[SonarSpec],
        medium: &MediumSpec,
    ) -> Self {
        let of = |sonar: &SonarSpec| volume_directions(spec, sonar, medium);
        Self {
            field: VolumeField::new(spec, seed),
            directions: sonars.iter().map(of).collect(),
        }
    }
}

/// Directions in which the pings of a sonar draw scatterers of the water.
pub fn volume_directions(
    spec: &VolumeSpec,
    sonar: &SonarSpec,
    medium: &MediumSpec,
) -> VolumeDirections {
    let mut plan = plan::blank(0, sonar, medium, 0.0);
    plan.trajectory = Trajectory::uniform(DVec3::ZERO, DVec3::ZERO, DQuat::IDENTITY);
    let order = PingOrder {
        ping_number: 1,
        transmit_utc: UtcNs(0),
        settings: sonar.settings,
        period_s: 0.0,
    };
    plan::fill(&mut plan, sonar, &order, Default::default(), UtcNs(0));
    let mut areas = Vec::new();
    footprints(sonar, &plan, &mut areas);
    let wavelength_m = plan.sound_speed_m_per_s / plan.pulse.center_frequency_hz;
    let aperture = aperture(sonar, wavelength_m);
    VolumeDirections::new(&areas, aperture, spec.scatterers_per_cell)
}

fn aperture(sonar: &SonarSpec, wavelength_m: f64) -> VolumeAperture {
    let arrays = sonar.receive.iter().map(|array| {
        let turn = array.mounting.body_from_array;
        // The transmitter resolves like a line of its own length along the receive array.
        let transmit = &sonar.transmit[array.transmit];
        let [sent_m, _] = transmit.pattern.sides_m();
        let sent = transmit.mounting.body_from_array * DVec3::X * sent_m;
        let own_m = array.length_m();
        let element_m = array.element_pattern.sides_m()[0];
        let along = turn * DVec3::X;
        let length_m = own_m.max(element_m).max(sent.dot(along).abs());
        (array, along, turn * DVec3::Z, length_m)
    });
    let arrays: Vec<_> = arrays.collect();
    let longest = arrays.iter().max_by(|a, b| a.3.total_cmp(&b.3));
    let (axis, length_m) = longest.map_or((DVec3::X, 0.0), |a| (a.1, a.3));
    let mut across_m = 0.0_f64;
    for (array, along, ahead, own_m) in &arrays {
        across_m = across_m.max(own_m * along.cross(axis).length());
        for (other, _, other_ahead, _) in &arrays {
            if ahead.dot(*other_ahead) > SAME_WAY {
                let apart_m = array.mounting.position_m - other.mounting.position_m;
                across_m = across_m.max(apart_m.cross(axis).length());
            }
        }
    }
    VolumeAperture {
        axis,
        length: length_m / wavelength_m,
        across: across_m / wavelength_m,
    }
}

impl Rig {
    /// Sets the moving scatterers of a ping.
    pub fn append_moving(
        &mut self,
        plan: &PingPlan,
        scatterers: &mut Scatterers,
        counts: &mut SceneCounts,
    ) {
        scatterers.moving.clear();
        if self.has_moving {
            let c = plan.sound_speed_m_per_s;
            counts.moving = self.scene.append_moving(plan.transmit_utc, c, scatterers);
        }
    }

    /// Appends the scatterers of the water to those of the scene that the ping has gathered.
    pub fn append_volume(
        &mut self,
        plan: &PingPlan,
        scatterers: &mut Scatterers,
        counts: &mut SceneCounts,
    ) {
        let Some(water) = &self.volume else { return };
        let ping = VolumePing {
            sonar: plan.sonar as u32,
            ping_number: plan.ping_number,
            world_from_body: plan.trajectory.pose_at(0.0).world_from_body,
        };
        let directions = &water.directions[plan.sonar];
        counts.volume = self
            .scene
            .append_volume(&water.field, directions, ping, scatterers);
    }
}

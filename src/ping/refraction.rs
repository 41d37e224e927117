//! Refraction in a ping: the water of its plan, and virtual points instead of scatterers.
//!
//! The scatterers of a ping are replaced once, after they are gathered. Path models, Doppler, engines and the truth of a ping then work with the virtual
//! points, in water of the sound speed at the sonar.

use std::sync::Arc;

use glam::DVec3;

use crate::rig::Rig;
use echotank_core::ping::{PingPlan, Refraction};
use echotank_core::scene::Scatterers;
use echotank_core::sound_speed::SoundSpeedProfile;
use echotank_synthesis::echo::rays::{self, VirtualPoints};

impl Rig {
    /// Replaces the sound-speed profile of the pings to come. Windows and buffers stay those of the configured one.
    pub fn set_profile(&mut self, profile: Arc<SoundSpeedProfile>) {
        let held = self.virtual_points.as_ref();
        if !held.is_some_and(|points| Arc::ptr_eq(points.profile(), &profile)) {
            self.virtual_points = Some(VirtualPoints::new(profile));
        }
    }

    /// Sets the water of a filled plan at the place of the sonar, from `plan.trajectory` and `plan.sensor`.
    pub fn set_water(&self, plan: &mut PingPlan) {
        plan.refraction = self.virtual_points.as_ref().map(|points| {
            let array_m = self.sonars[plan.sonar].center_m(&plan.trajectory.pose_at(0.0));
            let altitude_m = plan.sensor.altitude_m;
            Refraction {
                profile: points.profile().clone(),
                array_m,
                floor_m: altitude_m.map_or(SoundSpeedProfile::MAX_DEPTH_M, |up_m| array_m.z + up_m),
            }
        });
        if let Some(water) = &plan.refraction {
            plan.sound_speed_m_per_s = water.sound_speed_m_per_s();
        }
    }

    /// Replaces scatterers by the virtual points of a ping, if its water bends sound. Returns the number of scatterers that no ray reaches.
    pub fn bend(&mut self, plan: &PingPlan, scatterers: &mut Scatterers) -> u64 {
        let (Some(water), Some(points)) = (&plan.refraction, &mut self.virtual_points) else {
            return 0;
        };
        let depths_m = scatterers.down_m.iter();
        let deepest_m = depths_m.fold(f64::NEG_INFINITY, |deepest, down| deepest.max(*down));
        points.aim(water, plan.absorption_db_per_m, deepest_m);
        points.replace(scatterers)
    }

    /// The virtual point of a place in the last ping that was gathered; the place itself in water of one sound speed. None in a shadow of the water.
    pub(crate) fn virtual_m(&self, plan: &PingPlan, at_m: DVec3) -> Option<DVec3> {
        match (&plan.refraction, &self.virtual_points) {
            (Some(_), Some(points)) => Some(points.seen(at_m)?.position_m),
            _ => Some(at_m),
        }
    }
}

/// The virtual point of a place in a ping; the place itself in water of one sound speed. None in a shadow of the water.
pub fn virtual_point_m(plan: &PingPlan, at_m: DVec3) -> Option<DVec3> {
    match &plan.refraction {
        Some(water) => Some(rays::seen(water, 0.0, at_m)?.position_m),
        None => Some(at_m),
    }
}

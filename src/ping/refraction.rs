//! Refraction in a ping: the water of its plan, and virtual points instead of scatterers.
//!
//! The scatterers of a ping are replaced once, after they are gathered. Path models, Doppler, engines and the truth of a ping then work with the virtual
//! points, in water of the sound speed at the sonar.

use std::sync::Arc;

use glam::DVec3;

use crate::multipath::Multipath;
use crate::rig::Rig;
use echotank_config::spec::SonarSpec;
use echotank_core::ping::{PingPlan, Refraction};
use echotank_core::scene::{MovingScatterer, Scatterers};
use echotank_core::sound_speed::SoundSpeedProfile;
use echotank_synthesis::echo::rays::{self, VirtualPoints, place_error, virtual_point_error};
use echotank_synthesis::error_model::Conditions;

impl Rig {
    /// Replaces the sound-speed profile of the pings to come. Windows and buffers stay those of the configured one.
    pub fn set_profile(&mut self, profile: Arc<SoundSpeedProfile>) {
        let held = self.virtual_points.as_ref();
        if !held.is_some_and(|points| Arc::ptr_eq(points.profile(), &profile)) {
            if let Some(multipath) = &mut self.multipath {
                multipath.set_profile(&profile);
            }
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
                reflections: self.multipath.as_ref().map(Multipath::reflections),
                places: Default::default(),
            }
        });
        if let Some(water) = &plan.refraction {
            plan.sound_speed_m_per_s = water.sound_speed_m_per_s();
        }
    }

    /// Tabulates the rays of a ping and notes some of its scatterers, if its water bends sound.
    pub(crate) fn aim(&mut self, plan: &mut PingPlan, scatterers: &Scatterers) {
        let (Some(water), Some(points)) = (&mut plan.refraction, &mut self.virtual_points) else {
            return;
        };
        let at_rest = scatterers.len();
        let moving = &scatterers.moving;
        water
            .places
            .sample(at_rest + moving.len(), |i| match i.checked_sub(at_rest) {
                None => scatterers.position_m(i),
                Some(k) => moving[k].position_m,
            });
        let depths_m = scatterers.down_m.iter();
        let deepest_m = depths_m.fold(f64::NEG_INFINITY, |deepest, down| deepest.max(*down));
        let moving = scatterers.moving.iter();
        let deepest_m = moving.fold(deepest_m, |deepest, s| deepest.max(s.position_m.z));
        points.aim(water, plan.absorption_db_per_m, deepest_m);
    }

    /// Replaces scatterers by the virtual points of a ping, if its water bends sound. Returns the number of scatterers that no ray reaches. After [`Self::aim`].
    pub(crate) fn bend(&self, plan: &PingPlan, scatterers: &mut Scatterers) -> u64 {
        let (Some(water), Some(points)) = (&plan.refraction, &self.virtual_points) else {
            return 0;
        };
        let c = plan.sound_speed_m_per_s;
        let bend = |s: &mut MovingScatterer| bend_moving(points, (water.array_m, c), s);
        let moving = scatterers.moving.len();
        scatterers.moving.retain_mut(bend);
        (moving - scatterers.moving.len()) as u64 + points.replace(scatterers)
    }

    /// The virtual point of a place in the last ping that was gathered; the place itself in water of one sound speed. None in a shadow of the water.
    pub(crate) fn virtual_m(&self, plan: &PingPlan, at_m: DVec3) -> Option<DVec3> {
        match (&plan.refraction, &self.virtual_points) {
            (Some(_), Some(points)) => Some(points.seen(at_m)?.position_m),
            _ => Some(at_m),
        }
    }
}

/// Length along which the motion of a virtual point is measured, metres.
const ALONG_M: f64 = 0.25;

/// Replaces a moving scatterer by a virtual point in motion: the virtual points of two places of its way, about the place where the sound finds it. Returns
/// false in a shadow of the water.
fn bend_moving(
    points: &VirtualPoints,
    (array_m, c): (DVec3, f64),
    scatterer: &mut MovingScatterer,
) -> bool {
    let velocity = scatterer.velocity_m_per_s;
    if scatterer.target == MovingScatterer::OF_SURFACE {
        return bend_surface(points, (array_m, c), scatterer);
    }
    let mut hit_s = 0.0;
    for _ in 0..3 {
        let at_m = scatterer.position_m + velocity * hit_s;
        let Some(seen) = points.seen(at_m) else {
            return false;
        };
        hit_s = seen.position_m.distance(array_m) / c;
    }
    let at_m = scatterer.position_m + velocity * hit_s;
    let acceleration = scatterer.acceleration_m_per_s2;
    let step_s = ALONG_M / velocity.length().max(1e-3);
    let [before, seen, after] =
        [-step_s, 0.0, step_s].map(|step_s| points.seen(at_m + velocity * step_s));
    let (Some(before), Some(seen), Some(after)) = (before, seen, after) else {
        return false;
    };
    scatterer.velocity_m_per_s = (after.position_m - before.position_m) / (2.0 * step_s);
    // The way bends with the water; an acceleration of its own appears turned with the ray.
    let bends_m = (after.position_m - seen.position_m) + (before.position_m - seen.position_m);
    let turned = seen.normal(acceleration.as_vec3().to_array());
    let there = points.profile().at_m_per_s(at_m.z);
    scatterer.acceleration_m_per_s2 =
        bends_m / (step_s * step_s) + DVec3::from_array(turned.map(f64::from)) * (c / there);
    scatterer.hit_s = hit_s;
    scatterer.position_m = seen.position_m - scatterer.velocity_m_per_s * hit_s;
    scatterer.normal = seen.normal(scatterer.normal);
    scatterer.strength *= seen.gain;
    true
}

/// As [`bend_moving`], of one that moves by far less than a wave is long while the sound is on its way: it has one ray, and the velocity that gives the same
/// Doppler along it.
fn bend_surface(
    points: &VirtualPoints,
    (array_m, c): (DVec3, f64),
    scatterer: &mut MovingScatterer,
) -> bool {
    let velocity = scatterer.velocity_m_per_s;
    let hit_s = scatterer.position_m.distance(array_m) / c;
    let at_m = scatterer.position_m + velocity * hit_s;
    let Some(seen) = points.seen(at_m) else {
        return false;
    };
    // Along the ray, u . v / c is the same at both ends.
    let turned = seen.normal(velocity.as_vec3().to_array());
    let there = points.profile().at_m_per_s(at_m.z);
    scatterer.velocity_m_per_s = DVec3::from_array(turned.map(f64::from)) * (c / there);
    let turned = seen.normal(scatterer.acceleration_m_per_s2.as_vec3().to_array());
    scatterer.acceleration_m_per_s2 = DVec3::from_array(turned.map(f64::from)) * (c / there);
    let hit_s = seen.position_m.distance(array_m) / c;
    scatterer.hit_s = hit_s;
    scatterer.position_m = seen.position_m - scatterer.velocity_m_per_s * hit_s;
    scatterer.normal = seen.normal(scatterer.normal);
    scatterer.strength *= seen.gain;
    true
}

/// The virtual point of a place in a ping; the place itself in water of one sound speed. None in a shadow of the water.
pub fn virtual_point_m(plan: &PingPlan, at_m: DVec3) -> Option<DVec3> {
    match &plan.refraction {
        Some(water) => Some(rays::seen(water, 0.0, at_m)?.position_m),
        None => Some(at_m),
    }
}

/// A sample of the scatterers may miss the worst, except at the depth of the seabed, of which all rays are looked at.
const MARGIN: f64 = 1.2;

/// Bound of the relative error of element samples by virtual points, at the seabed below the sonar or the deepest scatterer, and at a sample of the
/// scatterers, wherever they lie: of both legs, for the transmitter and the ends of the arrays, and how far these move while the sonar listens.
pub(crate) fn refraction_error(spec: &SonarSpec, plan: &PingPlan, scatterers: &Scatterers) -> f64 {
    let Some(water) = &plan.refraction else {
        return 0.0;
    };
    let depths_m = scatterers.down_m.iter().copied();
    let depth_m = depths_m.fold(water.array_m.z, f64::max).min(water.floor_m);
    let pose = plan.trajectory.pose_at(0.0);
    let moved_m = pose.velocity_m_per_s * plan.window_s(spec.receiver.sample_rate_hz);
    let leg = |arms_m: &mut dyn Iterator<Item = DVec3>, moved_m: DVec3| {
        let (mut level_m, mut vertical_m) = (0.0f64, 0.0f64);
        for arm_m in arms_m {
            let offset_m = pose.point_m(arm_m) - water.array_m;
            level_m = level_m.max(offset_m.truncate().length());
            vertical_m = vertical_m.max(offset_m.z.abs());
        }
        let offsets_m = (
            level_m + moved_m.truncate().length(),
            vertical_m + moved_m.z.abs(),
        );
        let carrier_hz = plan.pulse.center_frequency_hz;
        let of_seabed = virtual_point_error(water, carrier_hz, offsets_m, depth_m);
        let places_m = water.places.at_m().iter();
        let of_places = places_m.map(|at_m| {
            let is_on_seabed = (at_m.z - depth_m).abs() < 0.1 * (depth_m - water.array_m.z);
            let margin = if is_on_seabed { 1.0 } else { MARGIN };
            margin * place_error(water, carrier_hz, offsets_m, *at_m)
        });
        of_places.fold(of_seabed, f64::max)
    };
    let transmit = &mut spec.transmit.iter().map(|t| t.mounting.position_m);
    let receive = &mut spec
        .receive
        .iter()
        .flat_map(|array| array.outermost().map(|e| array.element_body_m(e)));
    Conditions::error_of_phase(leg(transmit, DVec3::ZERO) + leg(receive, moved_m))
}

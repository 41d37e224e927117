//! Echoes by way of the sea surface and the bottom, as mirror images of the scatterers.
//!
//! A leg leads from the sonar to a scatterer: D directly, S by the surface, SB by the bottom and the surface (from the scatterer: up to the surface, down to the
//! bottom, up to the sonar). In water of one sound speed a reflected leg is a straight line to the mirror image of the scatterer, at the mean surface, and then
//! at the local mean plane of the bottom. An echo is a pair of legs, and becomes a scatterer of its own: its position is the image that the receiver sees, its
//! transmit point the one that the transmitter sees.
//!
//! Each reflection has a coherent and an incoherent part (`boundaries`). A pair gives up to two scatterers:
//!
//! * the coherent one, at the mirror images, with the product of the mean coefficients;
//! * the incoherent one, with the rest of the mean square and a circular Gaussian factor. Facets with random slopes reflect it, so a path bends where it is
//!   reflected, arrives from beside the image, and is longer.
//!
//! A leg of length L that bends at the distances r_1 .. r_n from the sonar by twice the slopes s_1 .. s_n leaves the straight line by rho_i, with
//!
//! ```text
//! (rho_i - rho_(i-1)) / (r_i - r_(i-1)) - (rho_(i+1) - rho_i) / (r_(i+1) - r_i) = 2 s_i,    rho_0 = rho_(n+1) = 0
//! ```
//!
//! in the plane of incidence, and by the sine of the grazing angle times that across it (geometric optics of small slopes). The random numbers depend on seed,
//! ping, scatterer and pair alone. A pair and its reverse have the same, because the surface hardly changes during a ping.
//!
//! With waves, the facets of the surface move with the orbital velocity of a wind sea (`wind_sea`), and with them the images of incoherent legs. The mean
//! surface, and so the coherent image, stays at rest. Echoes with such images are moving scatterers. This is the limit of a rough surface of the spectrum that
//! Kirchhoff's approximation gives for the specular direction, exp(-4 g^2 (1 - rho(t))) in time, with g = k sigma sin psi and rho the correlation of the height
//! (Beckmann and Spizzichino 1963). Where the pulse does not resolve the Doppler, it is left out.
//!
//! With heights, the waves longer than [`LONG`] depths of the sonar lift the surface, as a level plane at the place and the time of each reflection, and the
//! images with it. What is left of the roughness makes the coefficients. That the surface is a plane neglects the slope of these waves: for an amplitude a
//! and a wavelength L, the path is off by 2 (2 pi a / L)^2 d at most, with d the depth of the sonar, or 0.6 a / d of what the height makes.
//!
//! In water whose sound speed changes with depth, the images are the virtual points of reflected rays (`reflected_rays`), with the grazing angles, levels and
//! times of the rays.
//!
//! Relief and solids hide a scatterer from each leg on its own (`LegShadows`, along the mirror path). Scatterers that the sonar does not see directly have
//! reflected legs only.
//!
//! A pair is left out where its pattern, coefficients included, is below the floor of the ping (`ModelChoice::cull_db`), or its path beyond the window. Not
//! modelled: legs with more reflections.

use glam::DVec3;
use num_complex::Complex64;
use rayon::prelude::*;
use std::f64::consts::{FRAC_1_SQRT_2, TAU};
use std::sync::Arc;

use crate::image_thinning::{Echo, ImageThinning, facing, is_single, law_factor};
use crate::rig::Rig;
use crate::sea_surface::{heights, sea_surface, wind_sea};
use echotank_config::spec::{Density, RigSpec};
use echotank_core::ping::{PingPlan, Reflections, SceneCounts};
use echotank_core::scene::{
    BaffledFace, Footprint, LawCurve, MovingPoint, MovingScatterer, PatternSide, ScatterLaw,
    Scatterers,
};
use echotank_core::sound_speed::SoundSpeedProfile;
use echotank_scene::draws::{circular_gaussian, fraction, philox};
use echotank_scene::{BottomWay, DirectSight, Ground, LegShadows, reflecting_bottom};
use echotank_synthesis::echo::boundaries::{FluidBottom, Reflection, SeaSurface};
use echotank_synthesis::echo::rays::VirtualPoints;
use echotank_synthesis::echo::reflected_rays::{BottomPlane, Bounce, ReflectedRays};
use echotank_synthesis::echo::wind_sea::{WindSea, vertical_velocity_variance};

/// Separates these numbers from other uses of the same seed.
const IMAGES: u32 = 0x1A6E_5EED;
/// Scatterers of a task.
const TOGETHER: usize = 1024;
/// Reflections of a leg, at most.
const BENDS: usize = 2;
/// Legs of a scatterer: the direct one and
const LEGS: usize = 3;
const BY_SURFACE: usize = 1;
const BY_BOTTOM: usize = 2;
/// Share of the mean square below which a part of an echo is left out.
const LEAST_SHARE: f64 = 1e-6;
/// Half length of the patch whose mean plane reflects, in depths of water, and at least, metres.
const PATCH: f64 = 0.05;
const LEAST_PATCH_M: f64 = 0.5;
/// Least rms Doppler that counts, over the bandwidth of the pulse. The peak of a tone behind its matched filter is 0.1 dB lower then.
const LEAST_SPREAD: f64 = 1.0 / 12.0;
/// Waves longer than so many depths of the sonar lift reflections.
const LONG: f64 = 8.0;
/// Deviations of the direction for which scatterers are gathered.
const DEVIATIONS: f64 = 2.0;

/// Pairs of legs by their numbers, the direct one left out. A pair of different legs stands for both orders.
const PAIRS: [(usize, usize); 5] = [(0, 1), (1, 1), (0, 2), (1, 2), (2, 2)];
/// Of which these are without the bottom.
const PAIRS_OF_SURFACE: usize = 2;

/// Makes the reflected echoes of pings.
pub(crate) struct Multipath {
    surface: SeaSurface,
    surface_down_m: f64,
    /// None without legs by the bottom.
    bottom: Option<FluidBottom>,
    /// Where the surface moves.
    sea: Option<WindSea>,
    /// Where its height moves the images, and whether its roughness follows from the wind.
    heights: Option<WindSea>,
    by_wind: bool,
    /// In water that bends sound.
    rays: Option<ReflectedRays>,
    /// Where the seabed is thinned too.
    thinning: Option<ImageThinning>,
    seed: u64,
    /// Those of the direct legs, and those that hold every scatterer with a reflected echo.
    areas: Vec<Footprint>,
    wide: Vec<Footprint>,
    blocks: Vec<Block>,
    /// Blocks of the last ping.
    made: usize,
}

/// A task.
#[derive(Default)]
struct Block {
    legs: Vec<[Option<Leg>; LEGS]>,
    /// Whether the sonar sees the scatterer by each leg, as far as known; empty where nothing hides anything.
    seen: Vec<[Option<bool>; LEGS]>,
    images: Scatterers,
    /// Echoes with the Doppler of the waves.
    moving: Vec<MovingScatterer>,
}

/// A way between the sonar and a scatterer.
#[derive(Clone, Copy, Debug)]
struct Leg {
    /// The image of the scatterer.
    image_m: DVec3,
    normal: [f32; 3],
    reflection: Reflection,
    /// Factor on the pressure by refraction; 1 in water of one sound speed.
    gain: f64,
    /// Distances from the sonar, sines of the grazing angle, and rms slopes of the reflections, the first from the sonar on.
    bends: [Bend; BENDS],
    count: usize,
    /// Shift of the image for each metre that the surface rises.
    per_height: DVec3,
}

/// The straight path by bottom and surface, unfolded at the planes that reflect.
#[derive(Clone, Copy, Debug)]
struct MirrorPath {
    plane: BottomPlane,
    /// Half length of the patch of that plane, metres.
    patch_m: f64,
    image_m: DVec3,
    /// Places of the reflections at bottom and surface.
    bottom_m: DVec3,
    surface_m: DVec3,
    /// Their distances from the sonar along the path, metres, and the sines of their grazing angles.
    along_m: [f64; 2],
    sines: [f64; 2],
}

/// One end of an echo.
#[derive(Clone, Copy, Debug)]
struct Image {
    at_m: DVec3,
    normal: [f32; 3],
    /// Metres per second, and per second squared.
    velocity: DVec3,
    acceleration: DVec3,
    rise: Rise,
}

/// How the height of the surface moves an image.
#[derive(Clone, Copy, Debug)]
struct Rise {
    /// Shift for each metre; zero without a reflection at the surface.
    per_height: DVec3,
    /// Place of that reflection in the unfolded path, and its distance from the sonar.
    at_m: DVec3,
    along_m: f64,
}

#[derive(Clone, Copy, Debug, Default)]
struct Bend {
    along_m: f64,
    sine: f64,
    slope: f64,
}

impl Multipath {
    /// None where it is not asked for.
    pub(crate) fn of(spec: &RigSpec) -> Option<Self> {
        let given = spec.medium.multipath.as_ref()?;
        let (surface, surface_down_m) = sea_surface(spec);
        let seabed = spec.scene.seabed.as_ref();
        let own = reflecting_bottom(seabed.map(|seabed| &seabed.bottom));
        let slope = libm::tan(given.bottom_slope_rad);
        Some(Self {
            surface,
            surface_down_m,
            bottom: given.surface_bottom.then(|| FluidBottom {
                density_ratio: given.bottom_density_ratio.unwrap_or(own.density_ratio),
                speed_ratio: given.bottom_speed_ratio.unwrap_or(own.speed_ratio),
                loss: own.loss,
                rms_m: given.bottom_roughness_m.unwrap_or(own.rms_m),
                slope2: slope * slope,
            }),
            sea: wind_sea(spec),
            heights: heights(spec),
            by_wind: (spec.medium.surface.as_ref()).is_some_and(|s| s.roughness_m.is_none()),
            rays: spec.medium.profile.clone().map(ReflectedRays::new),
            thinning: seabed
                .is_some_and(|seabed| matches!(seabed.density, Density::Auto { .. }))
                .then(ImageThinning::default),
            seed: spec.scene.seed,
            areas: Vec::new(),
            wide: Vec::new(),
            blocks: Vec::new(),
            made: 0,
        })
    }

    /// Replaces the sound-speed profile of the pings to come.
    pub(crate) fn set_profile(&mut self, profile: &Arc<SoundSpeedProfile>) {
        self.rays = Some(ReflectedRays::new(profile.clone()));
    }

    /// Depth of the mean surface, metres.
    pub(crate) fn surface_down_m(&self) -> f64 {
        self.surface_down_m
    }

    /// Whether the waves spread the Doppler of reflections so far that a ping shows it: twice by the vertical, the most that they do.
    fn is_spread(&self, plan: &PingPlan) -> bool {
        let c = plan.sound_speed_m_per_s;
        let bandwidth_hz = 0.5 * c / plan.pulse.range_resolution_m(c);
        let velocity = vertical_velocity_variance(self.surface.wind_m_per_s).sqrt();
        let spread_hz = 4.0 * plan.pulse.center_frequency_hz * velocity / c;
        spread_hz > LEAST_SPREAD * bandwidth_hz
    }

    /// The boundaries that reflect.
    pub(crate) fn reflections(&self) -> Reflections {
        Reflections {
            surface_m: self.surface_down_m,
            by_bottom: self.bottom.is_some(),
        }
    }

    /// Footprints that hold every scatterer with an echo of any pair of legs, from those of the direct legs. An image lies in the same vertical plane as its
    /// scatterer and farther away, and incoherent echoes arrive from beside it.
    pub(crate) fn widen(&mut self, plan: &PingPlan, direct: &[Footprint]) -> &[Footprint] {
        self.areas.clear();
        self.areas.extend_from_slice(direct);
        self.wide.clear();
        self.wide.extend_from_slice(direct);
        let Some(altitude_m) = plan.sensor.altitude_m else {
            // Without a seabed below there are only a few scatterers.
            for area in &mut self.wide {
                area.sides = [PatternSide::OPEN; 4];
                area.faces = [BaffledFace::OPEN; 2];
            }
            return &self.wide;
        };
        let slope2 = self.surface.slope2 + self.bottom.map_or(0.0, |bottom| bottom.slope2);
        let wavenumber_per_m = TAU * plan.pulse.center_frequency_hz / plan.sound_speed_m_per_s;
        let rough = wavenumber_per_m * self.surface.rms_m.max(self.bottom.map_or(0.0, |b| b.rms_m));
        let beside = match rough > 0.05 {
            true => DEVIATIONS * 2.0 * FRAC_1_SQRT_2 * slope2.sqrt(),
            false => 0.0,
        };
        for area in &mut self.wide {
            let depth_m = (area.apex_m.z - self.surface_down_m).max(0.0);
            let farther_m = match self.bottom {
                None => 2.0 * depth_m,
                Some(_) => 2.0 * (altitude_m + depth_m),
            };
            let farther = 1.0 + farther_m / altitude_m;
            for side in &mut area.sides {
                side.reach *= farther;
                side.turn += (1.0 + farther) * side.axis.z.abs() + beside;
            }
            for face in &mut area.faces {
                face.turn += (1.0 + farther) * face.normal.z.abs() + beside;
            }
        }
        &self.wide
    }

    /// Makes the reflected echoes of the scene's scatterers, after [`Self::widen`]. `array_m`: place of the sonar. `direct`: the virtual points of the ping, in
    /// water that bends sound; the scatterers are still in their own places. `shadows`: those of its legs, with the scatterers that have no direct leg and the
    /// number of those on the ground.
    pub(crate) fn make(
        &mut self,
        plan: &PingPlan,
        array_m: DVec3,
        ground: Option<&Ground>,
        direct: Option<&VirtualPoints>,
        scatterers: &Scatterers,
        shadows: Option<(LegShadows, (&Scatterers, usize))>,
    ) {
        let count = scatterers.of_scene();
        let tasks_seen = count.div_ceil(TOGETHER);
        let hidden = shadows.map_or(0, |(_, (hidden, _))| hidden.len());
        let tasks = tasks_seen + hidden.div_ceil(TOGETHER);
        let mut blocks = std::mem::take(&mut self.blocks);
        if blocks.len() < tasks {
            blocks.resize_with(tasks, Block::default);
        }
        if let (Some(rays), Some(water)) = (&mut self.rays, &plan.refraction) {
            let below = scatterers.down_m[..count].iter().copied();
            let mut deepest_m = below.fold(array_m.z, f64::max);
            if let Some((_, (hidden, _))) = shadows {
                deepest_m = hidden.down_m.iter().copied().fold(deepest_m, f64::max);
            }
            if let Some(altitude_m) = plan.sensor.altitude_m {
                deepest_m = deepest_m.max(array_m.z + altitude_m);
            }
            let db_per_m = plan.absorption_db_per_m;
            rays.aim(water, db_per_m, self.surface_down_m, deepest_m);
        }
        if let Some(thinning) = &mut self.thinning {
            thinning.look(&self.areas, &[(scatterers, count, None)]);
        }
        let refracted = match (&self.rays, direct) {
            (Some(rays), Some(direct)) if plan.refraction.is_some() => Some((rays, direct)),
            _ => None,
        };
        let utc_s = plan.transmit_utc.0 as f64 * 1e-9;
        let mut surface = self.surface;
        let longer_m = LONG * (array_m.z - self.surface_down_m).max(0.0);
        if let (Some(sea), true) = (&self.heights, self.by_wind) {
            let rest_m2 = surface.rms_m * surface.rms_m - sea.height_variance_m2(longer_m);
            surface.rms_m = rest_m2.max(0.0).sqrt();
        }
        let ping = PingGeometry {
            of: self,
            surface,
            heights: self.heights.as_ref().map(|sea| (sea, utc_s, longer_m)),
            plan,
            array_m,
            refracted,
            wavenumber_per_m: TAU * plan.pulse.center_frequency_hz / plan.sound_speed_m_per_s,
            ground: ground.filter(|_| self.bottom.is_some()),
            shadows: shadows.map(|(shadows, _)| shadows),
            sea: self
                .sea
                .as_ref()
                .filter(|_| self.is_spread(plan))
                .map(|sea| (sea, utc_s)),
            key: [
                self.seed as u32,
                (self.seed >> 32) as u32 ^ plan.ping_number,
            ],
        };
        blocks[..tasks]
            .par_iter_mut()
            .enumerate()
            .for_each(|(task, block)| {
                let rows_of =
                    |task: usize, count: usize| task * TOGETHER..((task + 1) * TOGETHER).min(count);
                match task.checked_sub(tasks_seen).zip(shadows) {
                    None => {
                        let list = Listed {
                            scatterers,
                            first: 0,
                            hidden_ground: None,
                        };
                        ping.fill(list, rows_of(task, count), block);
                    }
                    Some((task, (_, (scatterers, on_ground)))) => {
                        let list = Listed {
                            scatterers,
                            first: count,
                            hidden_ground: Some(on_ground),
                        };
                        ping.fill(list, rows_of(task, hidden), block);
                    }
                }
            });
        self.blocks = blocks;
        self.made = tasks;
    }

    /// Appends the reflected echoes of the last ping. Returns their number.
    pub(crate) fn append(&self, scatterers: &mut Scatterers) -> u64 {
        let mut appended = 0;
        for block in &self.blocks[..self.made] {
            if !block.images.is_empty() {
                scatterers.append(&block.images);
                appended += block.images.len() as u64;
            }
            scatterers.moving.extend_from_slice(&block.moving);
            appended += block.moving.len() as u64;
        }
        appended
    }
}

/// Everything that the echoes of a ping share.
struct PingGeometry<'a> {
    of: &'a Multipath,
    /// With the roughness of the waves that do not lift reflections.
    surface: SeaSurface,
    /// Waves that lift reflections, the time of the pulse, seconds, and their least length, metres.
    heights: Option<(&'a WindSea, f64, f64)>,
    plan: &'a PingPlan,
    array_m: DVec3,
    /// In water that bends sound: reflected rays, and direct ones.
    refracted: Option<(&'a ReflectedRays, &'a VirtualPoints)>,
    wavenumber_per_m: f64,
    ground: Option<&'a Ground>,
    /// Where something may hide a scatterer.
    shadows: Option<LegShadows<'a>>,
    /// Waves whose Doppler the pulse resolves, and the time of the pulse, seconds.
    sea: Option<(&'a WindSea, f64)>,
    key: [u32; 2],
}

/// Scatterers that a task looks at.
#[derive(Clone, Copy)]
struct Listed<'a> {
    scatterers: &'a Scatterers,
    /// Number of scatterers in the lists before it.
    first: usize,
    /// Of those that have no direct leg: how many, the first, lie on the ground.
    hidden_ground: Option<usize>,
}

impl Listed<'_> {
    fn sight(&self, i: usize) -> DirectSight {
        match self.hidden_ground {
            None => DirectSight::Seen,
            Some(on_ground) if i < on_ground => DirectSight::HiddenGround,
            Some(_) => DirectSight::HiddenObject,
        }
    }
}

impl PingGeometry<'_> {
    fn fill(&self, list: Listed, rows: std::ops::Range<usize>, block: &mut Block) {
        let given = list.scatterers;
        let Block {
            legs,
            seen,
            images,
            moving,
        } = block;
        legs.clear();
        moving.clear();
        seen.clear();
        images.truncate(0);
        if self.shadows.is_some() {
            seen.resize(rows.len(), [Some(true), None, None]);
        }
        for i in rows.clone() {
            let (at_m, normal) = (given.position_m(i), given.normal[i]);
            let direct = match list.hidden_ground {
                None => self.direct(at_m, normal),
                Some(_) => None,
            };
            let by_surface = self.by_surface(at_m, normal);
            let by_bottom = self.by_bottom(at_m, normal);
            legs.push([direct, by_surface, by_bottom]);
        }
        let pairs = match self.ground {
            None => &PAIRS[..PAIRS_OF_SURFACE],
            Some(_) => &PAIRS[..],
        };
        for &(low, high) in pairs {
            for (row, (i, legs)) in rows.clone().zip(&*legs).enumerate() {
                if let (Some(a), Some(b)) = (&legs[low], &legs[high]) {
                    let seen = seen.get_mut(row);
                    let made = (&mut *images, &mut *moving);
                    self.pair(list, i, (low, high), (a, b), seen, made);
                }
            }
        }
    }

    /// Appends the echoes of one pair of legs, in both orders.
    fn pair(
        &self,
        list: Listed,
        i: usize,
        (low, high): (usize, usize),
        (a, b): (&Leg, &Leg),
        mut seen: Option<&mut [Option<bool>; LEGS]>,
        (images, moving): (&mut Scatterers, &mut Vec<MovingScatterer>),
    ) {
        let given = list.scatterers;
        let both = a.reflection.and(b.reflection);
        let loud = f64::from(given.loud[i]);
        let strength = given.strength[i] * (a.gain * b.gain);
        let mut add = |(a, b): (Image, Image), rms: f64, factor: Complex64, chance: f64| {
            let orders = [(a, b), (b, a)];
            let orders = &orders[..1 + usize::from(low != high)];
            let received =
                [0, 1].map(|k| matches!(orders.get(k), Some((out, back)) if self.is_received(out.at_m, back.at_m, rms * loud)));
            if received == [false; 2] {
                return;
            }
            let mut factor = factor;
            if let Some(thinning) = &self.of.thinning
                && chance < 1.0
                && !is_single(given, i)
            {
                let share = |(out, back): &(Image, Image)| {
                    let echo = Echo {
                        at_m: [out.at_m, back.at_m],
                        normals: [out.normal, back.normal],
                        strength: strength.norm() * rms,
                        law: given.law[i],
                    };
                    thinning.share(&self.of.areas, &echo, given.curve.as_deref())
                };
                let share = orders.iter().map(share).fold(0.0, f64::max);
                if chance >= share {
                    return;
                }
                factor /= share.sqrt();
            }
            if let Some(seen) = &mut seen
                && [low, high]
                    .into_iter()
                    .any(|leg| !*seen[leg].get_or_insert_with(|| self.is_seen(list, i, leg)))
            {
                return;
            }
            for ((out, back), received) in orders.iter().zip(received) {
                if !received {
                    continue;
                }
                let (out, back) = &self.risen((*out, *back));
                if out.velocity != DVec3::ZERO || back.velocity != DVec3::ZERO {
                    let curve = given.curve.as_deref();
                    let echo = (strength * factor, given.law[i]);
                    moving.push(self.in_motion(out, back, echo, curve));
                    continue;
                }
                images.push(back.at_m, back.normal, strength * factor, given.law[i]);
                images.push_transmit(out.at_m, out.normal);
                if let Some(last) = images.loud.last_mut() {
                    *last = (rms * loud) as f32;
                }
            }
        };
        let coherent = both.coherent.norm_sqr();
        if coherent > LEAST_SHARE * both.power {
            let images = (a.image(self.array_m), b.image(self.array_m));
            add(images, coherent.sqrt(), both.coherent, 1.0);
        }
        let incoherent = both.incoherent();
        if incoherent <= LEAST_SHARE * both.power {
            return;
        }
        let rms = incoherent.sqrt();
        if self.is_left_out(a.image_m, b.image_m, rms * loud) {
            return;
        }
        let pair = (LEGS * low + high) as u32;
        let draw = |part: u32| {
            philox(
                [
                    (list.first + i) as u32,
                    pair << 8 | part,
                    self.plan.sonar as u32,
                    IMAGES,
                ],
                self.key,
            )
        };
        let gaussian = |a: u32, b: u32| {
            let z = circular_gaussian(a, b);
            Complex64::new(z.re.into(), z.im.into())
        };
        let [x, y, of_low, of_high] = draw(0);
        let factor = gaussian(x, y) * rms;
        // A path of both parts bends where its part is incoherent.
        let displaced = |leg: &Leg, part: u32, chance: u32| {
            let share = leg.reflection.incoherent() / leg.reflection.power.max(f64::MIN_POSITIVE);
            if leg.count == 0 || fraction(chance) >= share {
                return leg.image(self.array_m);
            }
            let words = draw(part);
            let (velocity, acceleration) = self.image_motion(leg);
            let draws = [0, 2].map(|k| gaussian(words[k], words[k + 1]));
            Image {
                at_m: leg.bent(self.array_m, draws),
                normal: leg.normal,
                velocity,
                acceleration,
                rise: leg.rise(self.array_m),
            }
        };
        // Two paths by the same boundary differ.
        let images = (displaced(a, 1, of_low), displaced(b, 2, of_high));
        let chance = match &self.of.thinning {
            Some(_) => fraction(draw(3)[0]),
            None => 1.0,
        };
        add(images, rms, factor, chance);
    }

    /// Velocity and acceleration of the image of an incoherent leg: a facet of the surface that rises by dz lengthens the path by 2 dz times the sine of
    /// the grazing angle.
    fn image_motion(&self, leg: &Leg) -> (DVec3, DVec3) {
        let (Some((sea, utc_s)), Some(last)) = (self.sea, leg.count.checked_sub(1)) else {
            return (DVec3::ZERO, DVec3::ZERO);
        };
        let bend = &leg.bends[last];
        let ray_m = leg.image_m - self.array_m;
        let length_m = ray_m.length();
        let ray = ray_m / length_m;
        let at_m = self.array_m + ray * bend.along_m;
        let hit_s = length_m / self.plan.sound_speed_m_per_s;
        let facet = sea.motion(at_m.x, at_m.y, utc_s + hit_s);
        let lengthens = ray * (-2.0 * bend.sine);
        (
            lengthens * facet.velocity_m_per_s.z,
            lengthens * facet.acceleration_m_per_s2.z,
        )
    }

    /// The images of both legs of an echo, lifted by the surface at the time of each reflection.
    fn risen(&self, (out, back): (Image, Image)) -> (Image, Image) {
        let Some((sea, utc_s, longer_m)) = self.heights else {
            return (out, back);
        };
        let c = self.plan.sound_speed_m_per_s;
        let [out_m, back_m] = [&out, &back].map(|image| image.at_m.distance(self.array_m));
        let lifted = |mut image: Image, along_m: f64| {
            let Rise {
                per_height, at_m, ..
            } = image.rise;
            if per_height != DVec3::ZERO {
                let time_s = utc_s + along_m / c;
                let (height_m, rises) = sea.height_m(at_m.x, at_m.y, time_s, longer_m);
                image.at_m += per_height * height_m;
                if self.sea.is_some() && image.velocity == DVec3::ZERO {
                    image.velocity = per_height * rises;
                }
            }
            image
        };
        (
            lifted(out, out.rise.along_m),
            lifted(back, out_m + back_m - back.rise.along_m),
        )
    }

    /// An echo between two images, of which at least one moves. They are at their places when the sound finds the scatterer.
    fn in_motion(
        &self,
        out: &Image,
        back: &Image,
        (strength, law): (Complex64, ScatterLaw),
        curve: Option<&LawCurve>,
    ) -> MovingScatterer {
        let incidence = [out, back].map(|image| {
            let ray_m = image.at_m - self.array_m;
            facing(image.normal, ray_m, ray_m.length())
        });
        let hit_s = out.at_m.distance(self.array_m) / self.plan.sound_speed_m_per_s;
        MovingScatterer {
            position_m: back.at_m - back.velocity * hit_s,
            velocity_m_per_s: back.velocity,
            acceleration_m_per_s2: back.acceleration,
            hit_s,
            normal: back.normal,
            strength: strength * law_factor(law, curve, incidence),
            law: ScatterLaw::Point,
            target: MovingScatterer::OF_SURFACE,
            transmit: Some(MovingPoint {
                position_m: out.at_m - out.velocity * hit_s,
                velocity_m_per_s: out.velocity,
                acceleration_m_per_s2: out.acceleration,
            }),
        }
    }

    /// Whether the sonar sees a scatterer by a reflected leg.
    fn is_seen(&self, list: Listed, i: usize, leg: usize) -> bool {
        let Some(shadows) = &self.shadows else {
            return true;
        };
        let (at_m, sight) = (list.scatterers.position_m(i), list.sight(i));
        match leg {
            BY_SURFACE => shadows.by_surface(at_m, sight),
            BY_BOTTOM => {
                let way = self.bottom_way(at_m).map(|way| BottomWay {
                    places_m: [self.array_m, way.bottom_m, way.surface_m, at_m],
                    patch_m: way.patch_m,
                });
                way.is_some_and(|way| shadows.by_bottom(&way, sight))
            }
            _ => true,
        }
    }

    /// Whether an echo arrives after the window of every array, or is below the floor whatever its directions.
    fn is_left_out(&self, out_m: DVec3, back_m: DVec3, level: f64) -> bool {
        let beyond = |area: &Footprint| {
            let half_m = 0.5 * (out_m.distance(area.apex_m) + back_m.distance(area.apex_m));
            half_m > area.max_range_m + area.apex_m.distance(area.receiver_m)
        };
        let mut areas = self.of.areas.iter();
        areas.all(|area| area.depth * level < 1.0 || beyond(area))
    }

    /// Whether any array may receive an echo whose coefficients have the magnitude `level`.
    fn is_received(&self, out_m: DVec3, back_m: DVec3, level: f64) -> bool {
        self.of.areas.iter().any(|area| {
            let (out_m, back_m) = (out_m - area.apex_m, back_m - area.apex_m);
            let (out_range_m, back_range_m) = (out_m.length(), back_m.length());
            let half_m = 0.5 * (out_range_m + back_range_m);
            if half_m > area.max_range_m + area.apex_m.distance(area.receiver_m) {
                return false;
            }
            let [sent, received] = &area.faces;
            if !sent.may_face(out_m.dot(sent.normal), out_range_m)
                || !received.may_face(back_m.dot(received.normal), back_range_m)
            {
                return false;
            }
            let [a, b, c, d] = &area.sides;
            let below = a.below(out_m.dot(a.axis), out_range_m)
                * b.below(out_m.dot(b.axis), out_range_m)
                * c.below(back_m.dot(c.axis), back_range_m)
                * d.below(back_m.dot(d.axis), back_range_m);
            below <= area.depth * level
        })
    }

    /// The leg without reflections. None in a shadow of the water.
    fn direct(&self, at_m: DVec3, normal: [f32; 3]) -> Option<Leg> {
        let mut leg = Leg::direct(at_m, normal);
        if let Some((_, direct)) = &self.refracted {
            let seen = direct.seen(at_m)?;
            leg.image_m = seen.position_m;
            leg.normal = seen.normal(normal);
            leg.gain = seen.gain.sqrt();
        }
        Some(leg)
    }

    /// A reflection of a refracted leg `length_m` long.
    fn bend(length_m: f64, bounce: &Bounce, slope2: f64) -> Bend {
        Bend {
            along_m: length_m * bounce.time_share,
            sine: bounce.sine,
            slope: slope2.sqrt(),
        }
    }

    /// The leg by the surface. None where sonar or scatterer is not below it, and in a shadow of the water.
    fn by_surface(&self, at_m: DVec3, normal: [f32; 3]) -> Option<Leg> {
        let surface_m = self.of.surface_down_m;
        let (sonar_m, scatterer_m) = (self.array_m.z - surface_m, at_m.z - surface_m);
        if sonar_m <= 0.0 || scatterer_m <= 0.0 {
            return None;
        }
        let (image_m, normal) = mirrored_at_surface(at_m, normal, surface_m);
        if let Some((rays, _)) = &self.refracted {
            let seen = rays.by_surface(at_m)?;
            let length_m = seen.position_m.distance(self.array_m);
            let slope2 = self.of.surface.slope2;
            return Some(Leg {
                image_m: seen.position_m,
                per_height: self.lengthened(seen.position_m, &seen.bounces[0]),
                normal: seen.normal(normal),
                reflection: self.at_surface(&seen.bounces[0]),
                gain: seen.gain,
                bends: [
                    Self::bend(length_m, &seen.bounces[0], slope2),
                    Bend::default(),
                ],
                count: 1,
            });
        }
        let length_m = image_m.distance(self.array_m);
        let sine = (sonar_m + scatterer_m) / length_m;
        Some(Leg {
            image_m,
            // Towards the air.
            per_height: DVec3::new(0.0, 0.0, -2.0),
            normal,
            reflection: self.at_surface(&self.straight(sine)),
            gain: 1.0,
            bends: [
                Bend {
                    along_m: length_m * sonar_m / (sonar_m + scatterer_m),
                    sine,
                    slope: self.of.surface.slope2.sqrt(),
                },
                Bend::default(),
            ],
            count: 1,
        })
    }

    /// The mirror path by bottom and surface. None where there is no bottom, or no such path.
    fn bottom_way(&self, at_m: DVec3) -> Option<MirrorPath> {
        let ground = self.ground?;
        let surface_m = self.of.surface_down_m;
        if self.array_m.z <= surface_m || at_m.z <= surface_m {
            return None;
        }
        let above_m = DVec3::new(at_m.x, at_m.y, 2.0 * surface_m - at_m.z);
        // The place of the reflection on the bottom, as if it were level there.
        let down_m = ground
            .down_m(self.array_m.x, self.array_m.y)
            .unwrap_or(at_m.z);
        let sonar_up_m = (down_m - self.array_m.z).max(0.0);
        let share = sonar_up_m / (sonar_up_m + down_m - above_m.z).max(f64::MIN_POSITIVE);
        let place = self.array_m.lerp(at_m, share.clamp(0.0, 1.0));
        let (plane, patch_m) = mean_plane(ground, place, surface_m)?;
        let BottomPlane { up, .. } = plane;
        let side = |p_m: DVec3| (p_m - plane.at_m).dot(up);
        let (sonar_m, source_m) = (side(self.array_m), side(above_m));
        if sonar_m <= 0.0 || source_m <= 0.0 {
            return None;
        }
        let image_m = above_m - 2.0 * source_m * up;
        let ray_m = image_m - self.array_m;
        let length_m = ray_m.length();
        let ray = ray_m / length_m;
        let bottom_sine = -ray.dot(up);
        let reflected = ray + 2.0 * bottom_sine * up;
        let surface_sine = -reflected.z;
        let to_bottom_m = length_m * sonar_m / (sonar_m + source_m);
        if bottom_sine <= 0.0 || surface_sine <= 0.0 {
            return None;
        }
        let bottom_m = self.array_m + ray * to_bottom_m;
        let rise_m = (bottom_m.z - surface_m) / surface_sine;
        let to_surface_m = to_bottom_m + rise_m;
        if bottom_m.z <= surface_m || to_surface_m >= length_m {
            return None;
        }
        Some(MirrorPath {
            plane,
            patch_m,
            image_m,
            bottom_m,
            surface_m: bottom_m + reflected * rise_m,
            along_m: [to_bottom_m, to_surface_m],
            sines: [bottom_sine, surface_sine],
        })
    }

    /// The leg by bottom and surface. None where there is no bottom, or no such path.
    fn by_bottom(&self, at_m: DVec3, [x, y, z]: [f32; 3]) -> Option<Leg> {
        let bottom = self.of.bottom.as_ref()?;
        let MirrorPath {
            plane,
            image_m,
            bottom_m,
            along_m: [to_bottom_m, to_surface_m],
            sines: [bottom_sine, surface_sine],
            ..
        } = self.bottom_way(at_m)?;
        let n = DVec3::from_array([x, y, -z].map(f64::from));
        let normal = (n - 2.0 * n.dot(plane.up) * plane.up).as_vec3().to_array();
        if let Some((rays, _)) = &self.refracted {
            let seen = rays.by_bottom(at_m, &plane, bottom_m)?;
            let length_m = seen.position_m.distance(self.array_m);
            let [low, high] = &seen.bounces;
            let at_bottom = bottom.reflection(self.wavenumber_per_m(low), low.sine);
            return Some(Leg {
                image_m: seen.position_m,
                per_height: self.lengthened(seen.position_m, high),
                normal: seen.normal(normal),
                reflection: at_bottom.and(self.at_surface(high)),
                gain: seen.gain,
                bends: [
                    Self::bend(length_m, low, bottom.slope2),
                    Self::bend(length_m, high, self.of.surface.slope2),
                ],
                count: 2,
            });
        }
        let at_bottom = bottom.reflection(self.wavenumber_per_m, bottom_sine);
        let rise = DVec3::new(0.0, 0.0, -2.0);
        Some(Leg {
            image_m,
            per_height: rise - 2.0 * rise.dot(plane.up) * plane.up,
            normal,
            reflection: at_bottom.and(self.at_surface(&self.straight(surface_sine))),
            gain: 1.0,
            bends: [
                Bend {
                    along_m: to_bottom_m,
                    sine: bottom_sine,
                    slope: bottom.slope2.sqrt(),
                },
                Bend {
                    along_m: to_surface_m,
                    sine: surface_sine,
                    slope: self.of.surface.slope2.sqrt(),
                },
            ],
            count: 2,
        })
    }

    /// Shift of a refracted image for each metre that the surface rises: upright, by the time that the path takes longer, and along a ray that is almost
    /// level.
    fn lengthened(&self, image_m: DVec3, bounce: &Bounce) -> DVec3 {
        let ray = (image_m - self.array_m).normalize_or_zero();
        let longer = 2.0 * bounce.sine * self.plan.sound_speed_m_per_s / bounce.speed_m_per_s;
        match ray.z.abs() > 0.1 * bounce.sine {
            true => DVec3::Z * (longer / ray.z),
            false => ray * longer,
        }
    }

    /// A reflection in water of one sound speed.
    fn straight(&self, sine: f64) -> Bounce {
        Bounce {
            time_share: 0.0,
            sine,
            speed_m_per_s: self.plan.sound_speed_m_per_s,
        }
    }

    fn wavenumber_per_m(&self, bounce: &Bounce) -> f64 {
        self.wavenumber_per_m * (self.plan.sound_speed_m_per_s / bounce.speed_m_per_s)
    }

    fn at_surface(&self, bounce: &Bounce) -> Reflection {
        let carrier_hz = self.plan.pulse.center_frequency_hz;
        let wavenumber_per_m = self.wavenumber_per_m(bounce);
        self.surface
            .reflection(carrier_hz, wavenumber_per_m, bounce.sine)
    }
}

impl Leg {
    /// The image at rest.
    fn image(&self, array_m: DVec3) -> Image {
        Image {
            at_m: self.image_m,
            normal: self.normal,
            velocity: DVec3::ZERO,
            acceleration: DVec3::ZERO,
            rise: self.rise(array_m),
        }
    }

    fn rise(&self, array_m: DVec3) -> Rise {
        // The surface reflects last from the sonar on.
        let along_m = match self.count {
            0 => 0.0,
            count => self.bends[count - 1].along_m,
        };
        Rise {
            per_height: self.per_height,
            at_m: array_m + (self.image_m - array_m).normalize_or_zero() * along_m,
            along_m,
        }
    }

    fn direct(at_m: DVec3, normal: [f32; 3]) -> Self {
        Self {
            image_m: at_m,
            normal,
            reflection: Reflection::NONE,
            gain: 1.0,
            bends: [Bend::default(); BENDS],
            count: 0,
            per_height: DVec3::ZERO,
        }
    }

    /// The point from which the echo arrives on a path that facets bend. `draws`: circular Gaussians, one for each reflection.
    fn bent(&self, array_m: DVec3, draws: [Complex64; BENDS]) -> DVec3 {
        let ray_m = self.image_m - array_m;
        let length_m = ray_m.length();
        let ray = ray_m / length_m;
        let across = match ray.cross(DVec3::Z).try_normalize() {
            Some(across) => across,
            None => DVec3::X,
        };
        let along = across.cross(ray);
        let bends = &self.bends[..self.count];
        // Kinks in both directions, radians: across the plane of incidence a facet turns a grazing ray less.
        let kink = |k: usize| {
            let (bend, draw) = (&bends[k], draws[k]);
            along * (2.0 * bend.slope * draw.re) + across * (2.0 * bend.slope * bend.sine * draw.im)
        };
        let (first_m, first) = (bends[0].along_m, kink(0));
        let mut points_m = [array_m + ray * first_m; BENDS];
        match bends.get(1) {
            None => {
                let later_m = length_m - first_m;
                points_m[0] += first * (first_m * later_m / length_m);
            }
            Some(bend) => {
                let second = kink(1);
                let second_m = bend.along_m;
                // Each kink alone moves both points; their sum solves both equations.
                let after_first = first * ((length_m - first_m) / length_m);
                let after_second = second * ((length_m - second_m) / length_m);
                points_m[0] += (after_first + after_second) * first_m;
                points_m[1] = array_m + ray * second_m;
                points_m[1] +=
                    first * (first_m * (length_m - second_m) / length_m) + after_second * second_m;
            }
        }
        let mut path_m = 0.0;
        let mut from_m = array_m;
        for &point_m in points_m[..self.count].iter().chain([&self.image_m]) {
            path_m += from_m.distance(point_m);
            from_m = point_m;
        }
        array_m + (points_m[0] - array_m).normalize_or_zero() * path_m
    }
}

/// A position and a normal in the mirror of the mean surface.
fn mirrored_at_surface(at_m: DVec3, [a, b, c]: [f32; 3], surface_m: f64) -> (DVec3, [f32; 3]) {
    (
        DVec3::new(at_m.x, at_m.y, 2.0 * surface_m - at_m.z),
        [a, b, -c],
    )
}

/// Mean plane of the bottom around a place, and half the length of its patch. None at a hole or an edge.
fn mean_plane(ground: &Ground, place_m: DVec3, surface_m: f64) -> Option<(BottomPlane, f64)> {
    let down_m = |north_m: f64, east_m: f64| ground.down_m(place_m.x + north_m, place_m.y + east_m);
    let here_m = down_m(0.0, 0.0)?;
    let half_m = (PATCH * (here_m - surface_m)).max(LEAST_PATCH_M);
    let (north_m, south_m) = (down_m(half_m, 0.0)?, down_m(-half_m, 0.0)?);
    let (east_m, west_m) = (down_m(0.0, half_m)?, down_m(0.0, -half_m)?);
    let mean_m = (here_m + north_m + south_m + east_m + west_m) / 5.0;
    let slope_north = (north_m - south_m) / (2.0 * half_m);
    let slope_east = (east_m - west_m) / (2.0 * half_m);
    let plane = BottomPlane {
        at_m: DVec3::new(place_m.x, place_m.y, mean_m),
        up: DVec3::new(slope_north, slope_east, -1.0).normalize(),
    };
    Some((plane, half_m))
}

impl Rig {
    /// Appends the scatterers of the sea surface to those of a ping, if it scatters, and counts them.
    pub fn add_surface(
        &mut self,
        plan: &PingPlan,
        scatterers: &mut Scatterers,
        counts: &mut SceneCounts,
    ) {
        let Some(surface) = &mut self.surface else {
            return;
        };
        let unit = &mut self.sonars[plan.sonar];
        let array_m = unit.center_m(&plan.trajectory.pose_at(0.0));
        let footprints = unit.pipeline.footprints(plan);
        surface.append(plan, footprints, array_m, scatterers, counts);
    }

    /// Replaces the scatterers of a ping by what the sonar hears of them: virtual points where the water bends sound, and reflected echoes besides. The
    /// footprints of its scene have been widened.
    pub fn propagate(
        &mut self,
        plan: &mut PingPlan,
        scatterers: &mut Scatterers,
        counts: &mut SceneCounts,
    ) {
        self.aim(plan, scatterers);
        if let Some(multipath) = &mut self.multipath {
            let array_m = self.sonars[plan.sonar].center_m(&plan.trajectory.pose_at(0.0));
            let ground = self.scene.ground();
            let direct = self.virtual_points.as_ref();
            let shadows = self.scene.leg_shadows();
            let shadows = shadows.map(|shadows| (shadows, self.scene.hidden()));
            let ground = ground.as_ref();
            multipath.make(plan, array_m, ground, direct, scatterers, shadows);
            let hidden = shadows.map_or(0, |(_, (hidden, _))| hidden.len());
            let (from, legs, pairs) = match ground.is_some() && multipath.bottom.is_some() {
                true => (scatterers.of_scene() + hidden, LEGS, PAIRS.len()),
                false => (scatterers.of_scene() + hidden, LEGS - 1, PAIRS_OF_SURFACE),
            };
            counts.reflected_pairs = (from * pairs) as u64;
            if multipath.sea.is_some() && multipath.is_spread(plan) {
                counts.waves += counts.reflected_pairs;
            }
            if plan.refraction.is_some() {
                counts.rays = (from * legs) as u64;
            }
        }
        if plan.refraction.is_some() {
            counts.rays += (scatterers.len() + scatterers.moving.len()) as u64;
        }
        counts.unreached = self.bend(plan, scatterers);
        if let Some(multipath) = &self.multipath {
            counts.images = multipath.append(scatterers);
            // Both legs rise.
            counts.waves += 2 * u64::from(multipath.heights.is_some()) * counts.images;
        }
    }

    /// Footprints for the scatterers of direct and reflected echoes of a ping.
    pub fn widen<'a>(&'a mut self, plan: &PingPlan, direct: &'a [Footprint]) -> &'a [Footprint] {
        match &mut self.multipath {
            Some(multipath) => multipath.widen(plan, direct),
            None => direct,
        }
    }
}

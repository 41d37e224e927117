//! The sea surface as scatterers: a flat scene at the waterline, drawn anew with a correlation time.
//!
//! The scatterers are those of a plane below the sonar, mirrored at a horizontal plane. Density, thinning and tiles are therefore the seabed's. Each has
//! the backscattering strength of its grazing angle at the sonar (`boundaries`), and a circular Gaussian reflectivity that changes: between two
//! independent values a correlation time apart it turns from the one to the other, with a constant mean square. The values depend on seed, place and time
//! alone.
//!
//! With waves, each scatterer moves with the orbital velocity of a wind sea at its place ([`wind_sea`](echotank_synthesis::echo::wind_sea)) and is one of the
//! moving scatterers of the ping. With automatic density, those that are weak beside the other echoes of their range are thinned (`image_thinning`).

use rayon::prelude::*;

use crate::image_thinning::{Echo, ImageThinning};
use echotank_config::spec::{
    AnchorSpec, BottomSpec, Density, IncidenceSpec, OcclusionSpec, RigSpec, SceneSpec, SeabedShape,
    SeabedSpec, SurfaceSpec,
};
use echotank_core::ping::{PingPlan, SceneCounts};
use echotank_core::scene::{Footprint, LawCurve, MovingScatterer, ScatterLaw, Scatterers};
use echotank_core::time::UtcNs;
use echotank_scene::draws::{circular_gaussian, fraction, philox};
use echotank_scene::{Files, Scene, SceneError};
use echotank_synthesis::echo::boundaries::SeaSurface;
use echotank_synthesis::echo::wind_sea::{SurfaceMotion, WindSea};
use glam::DVec3;
use num_complex::Complex64;

/// Separates these numbers from other uses of the same seed.
const SURFACE: u32 = 0x5EA5_0FAC;
/// Separates the waves from the reflectivities.
const WAVES: u32 = 0x3A7E;
/// Places are told apart to this length, metres.
const PLACE_M: f64 = 1e-3;
/// Scatterers of a task.
const TOGETHER: usize = 4096;

/// The surface of a configuration, by the wind where it does not say otherwise.
pub(crate) fn sea_surface(spec: &RigSpec) -> (SeaSurface, f64) {
    let Some(given) = &spec.medium.surface else {
        return (SeaSurface::of_wind(0.0), 0.0);
    };
    let mut surface = SeaSurface::of_wind(given.wind_m_per_s);
    if let Some(rms_m) = given.roughness_m {
        surface.rms_m = rms_m;
    }
    if let Some(slope_rad) = given.slope_rad {
        surface.slope2 = libm::tan(slope_rad) * libm::tan(slope_rad);
    }
    (surface, given.down_m)
}

/// The waves of a configuration, if the surface moves.
pub(crate) fn wind_sea(spec: &RigSpec) -> Option<WindSea> {
    let given = spec.medium.surface.as_ref()?;
    let moves = given.scattering.as_ref().is_some_and(|s| s.waves);
    moves.then(|| sea(spec, given))
}

/// The same waves, if their height moves reflections.
pub(crate) fn heights(spec: &RigSpec) -> Option<WindSea> {
    let given = spec.medium.surface.as_ref()?;
    given.heights.then(|| sea(spec, given))
}

fn sea(spec: &RigSpec, given: &SurfaceSpec) -> WindSea {
    let key = [spec.scene.seed as u32, (spec.scene.seed >> 32) as u32];
    let draw = |i: u32| fraction(philox([i, 0, WAVES, SURFACE], key)[0]);
    WindSea::new(given.wind_m_per_s, given.wind_from_rad, draw)
}

/// The scatterers of the surface around a sonar.
pub(crate) struct SurfaceSheet {
    scene: Scene,
    down_m: f64,
    seed: u64,
    correlation_time_s: f64,
    /// Of each sonar.
    curves: Vec<LawCurve>,
    areas: Vec<Footprint>,
    made: Scatterers,
    /// Where the surface moves.
    sea: Option<WindSea>,
    /// Where it moves, and its density is automatic.
    thinning: Option<ImageThinning>,
    moving: Vec<MovingScatterer>,
}

impl SurfaceSheet {
    /// None where the surface does not scatter.
    pub(crate) fn open(files: &dyn Files, spec: &RigSpec) -> Result<Option<Self>, SceneError> {
        let given = spec.medium.surface.as_ref();
        let Some(scattering) = given.and_then(|surface| surface.scattering.as_ref()) else {
            return Ok(None);
        };
        let (surface, down_m) = sea_surface(spec);
        let plane = SceneSpec {
            seed: spec.scene.seed,
            anchor: AnchorSpec::Origin,
            mirror: false,
            seabed: Some(SeabedSpec {
                shape: SeabedShape::Plane {
                    depth_m: 0.0,
                    slope_north: 0.0,
                    slope_east: 0.0,
                },
                density: scattering.density,
                bottom: BottomSpec::BistaticLambert { mu_db: 0.0 },
                incidence: IncidenceSpec::Flat,
                mosaic: None,
                speckle: false,
            }),
            points: None,
            targets: None,
            occlusion: OcclusionSpec::None,
            memory_limit_bytes: spec.scene.memory_limit_bytes,
            simplify: None,
        };
        let curve = |frequency_hz: f64| LawCurve::new(|sine| surface.strength(frequency_hz, sine));
        let sonars = spec.sonars.iter();
        Ok(Some(Self {
            scene: Scene::open(files, &plane)?,
            down_m,
            seed: spec.scene.seed,
            correlation_time_s: scattering.correlation_time_s,
            curves: sonars
                .map(|sonar| curve(sonar.pulse.center_frequency_hz))
                .collect(),
            areas: Vec::new(),
            made: Scatterers::default(),
            sea: wind_sea(spec),
            thinning: (scattering.waves && matches!(scattering.density, Density::Auto { .. }))
                .then(ImageThinning::default),
            moving: Vec::new(),
        }))
    }

    /// Appends the scatterers that the footprints may contain, and counts them. `array_m`: place of the sonar.
    pub(crate) fn append(
        &mut self,
        plan: &PingPlan,
        footprints: &[Footprint],
        array_m: DVec3,
        scatterers: &mut Scatterers,
        counts: &mut SceneCounts,
    ) {
        let down_m = self.down_m;
        if array_m.z <= down_m {
            return;
        }
        let mirrored = |v: DVec3| DVec3::new(v.x, v.y, -v.z);
        let place = |v: DVec3| DVec3::new(v.x, v.y, down_m - v.z);
        self.areas.clear();
        self.areas.extend(footprints.iter().map(|f| {
            let mut area = *f;
            area.apex_m = place(f.apex_m);
            area.receiver_m = place(f.receiver_m);
            for side in &mut area.sides {
                side.axis = mirrored(side.axis);
            }
            for face in &mut area.faces {
                face.normal = mirrored(face.normal);
            }
            area
        }));
        let gathered = self.scene.gather(&self.areas, &mut self.made);
        counts.surface_tested = gathered.culled + gathered.scatterers;
        counts.surface_made = gathered.scatterers;
        let curve = &self.curves[plan.sonar];
        let made = &mut self.made;
        made.down_m.fill(down_m);
        made.normal.fill([0.0, 0.0, 1.0]);
        if let Some(thinning) = &mut self.thinning {
            let ground = (&*scatterers, scatterers.of_scene(), None);
            let surface = (&*made, made.len(), Some(curve));
            thinning.look(footprints, &[ground, surface]);
        }
        let thinning = self.thinning.as_ref();
        let draws = Draws::at(self.seed, plan.transmit_utc, self.correlation_time_s);
        let places = made
            .north_m
            .par_chunks(TOGETHER)
            .zip(made.east_m.par_chunks(TOGETHER));
        places.zip(made.strength.par_chunks_mut(TOGETHER)).for_each(
            |((north_m, east_m), strength)| {
                for i in 0..strength.len() {
                    let ray_m = DVec3::new(north_m[i], east_m[i], down_m) - array_m;
                    let sine = (-ray_m.z / ray_m.length()).clamp(f64::MIN_POSITIVE, 1.0);
                    let half = curve.half(sine.sqrt());
                    // Lambert's factor of both legs is the sine.
                    let mut pressure = strength[i].norm() * half * half / sine;
                    if let Some(thinning) = thinning {
                        let echo = Echo {
                            at_m: [array_m + ray_m; 2],
                            normals: [[0.0, 0.0, 1.0]; 2],
                            strength: pressure,
                            law: ScatterLaw::Lambert,
                        };
                        let share = thinning.share(footprints, &echo, None);
                        pressure = match draws.chance(north_m[i], east_m[i]) < share {
                            true => pressure / share.sqrt(),
                            false => 0.0,
                        };
                    }
                    strength[i] = draws.reflectivity(north_m[i], east_m[i]) * pressure;
                }
            },
        );
        counts.surface = match &self.sea {
            Some(sea) => {
                set_in_motion(sea, plan, array_m, made, &mut self.moving);
                let before = scatterers.moving.len();
                let kept = self.moving.iter().filter(|s| s.strength != Complex64::ZERO);
                scatterers.moving.extend(kept);
                (scatterers.moving.len() - before) as u64
            }
            None => {
                scatterers.append(made);
                made.len() as u64
            }
        };
        counts.waves = u64::from(self.sea.is_some()) * counts.surface;
    }
}

/// The scatterers of the surface in motion, where the sound of a pulse finds them.
fn set_in_motion(
    sea: &WindSea,
    plan: &PingPlan,
    array_m: DVec3,
    made: &Scatterers,
    moving: &mut Vec<MovingScatterer>,
) {
    let utc_s = plan.transmit_utc.0 as f64 * 1e-9;
    let one = |i: usize| {
        let at_m = made.position_m(i);
        let hit_s = at_m.distance(array_m) / plan.sound_speed_m_per_s;
        let motion = match made.strength[i] == Complex64::ZERO {
            true => SurfaceMotion::default(),
            false => sea.motion(at_m.x, at_m.y, utc_s + hit_s),
        };
        MovingScatterer {
            position_m: at_m - motion.velocity_m_per_s * hit_s,
            velocity_m_per_s: motion.velocity_m_per_s,
            acceleration_m_per_s2: motion.acceleration_m_per_s2,
            hit_s,
            normal: made.normal[i],
            strength: made.strength[i],
            law: made.law[i],
            target: MovingScatterer::OF_SURFACE,
            transmit: None,
        }
    };
    let rows = (0..made.len()).into_par_iter().with_min_len(TOGETHER / 16);
    rows.map(one).collect_into_vec(moving);
}

/// Reflectivities of one instant.
struct Draws {
    key: [u32; 2],
    step: i64,
    /// Weights of the values before and after the instant.
    weights: [f64; 2],
}

impl Draws {
    fn at(seed: u64, utc: UtcNs, correlation_time_s: f64) -> Self {
        let steps_ns = ((correlation_time_s * 1e9).round() as i64).max(1);
        let (step, rest) = (utc.0.div_euclid(steps_ns), utc.0.rem_euclid(steps_ns));
        let turn = std::f64::consts::FRAC_PI_2 * rest as f64 / steps_ns as f64;
        let (after, before) = libm::sincos(turn);
        Self {
            key: [seed as u32, (seed >> 32) as u32],
            step,
            weights: [before, after],
        }
    }

    /// Random numbers of a place.
    fn place(&self, north_m: f64, east_m: f64, use_of: u32) -> [u32; 4] {
        let [north, east] = [north_m, east_m].map(|m| (m / PLACE_M).round() as i64);
        let high = (north >> 32) as u32 & 0xFFFF | ((east >> 32) as u32) << 16;
        philox([north as u32, east as u32, high, use_of], self.key)
    }

    /// From 0 to 1, the same at every instant.
    fn chance(&self, north_m: f64, east_m: f64) -> f64 {
        fraction(self.place(north_m, east_m, WAVES)[0])
    }

    /// Circular Gaussian with a mean square of 1.
    fn reflectivity(&self, north_m: f64, east_m: f64) -> Complex64 {
        let place = self.place(north_m, east_m, SURFACE);
        let value = |step: i64| {
            let [a, b, ..] = philox(
                [place[0], place[1], step as u32, (step >> 32) as u32],
                [place[2], place[3]],
            );
            let z = circular_gaussian(a, b);
            Complex64::new(z.re.into(), z.im.into())
        };
        value(self.step) * self.weights[0] + value(self.step + 1) * self.weights[1]
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Mean square 1 at every instant; the correlation over a time t is zero from two correlation times on.
    #[test]
    fn the_surface_is_drawn_anew_with_its_correlation_time() {
        const TAU_S: f64 = 0.05;
        let at = |ms: i64| Draws::at(7, UtcNs(1_700_000_000_000_000_000 + ms * 1_000_000), TAU_S);
        let mean = |a: &Draws, b: &Draws| {
            let n = 20_000;
            let of = |k: i32| {
                let (north, east) = (0.37 * f64::from(k % 200), -0.41 * f64::from(k / 200));
                a.reflectivity(north, east) * b.reflectivity(north, east).conj()
            };
            (0..n).map(of).sum::<Complex64>() / f64::from(n)
        };
        // The standard deviation of a mean is 0.007.
        for ms in [0, 7, 25, 49] {
            let now = at(ms);
            assert!((mean(&now, &now) - 1.0).norm() < 0.03, "{ms} ms");
            assert!(mean(&now, &at(ms + 100)).norm() < 0.03, "{ms} ms");
            // Within a step the correlation is the cosine of the turn.
            let turn = std::f64::consts::FRAC_PI_2 * f64::from(49 - ms as i32) / 50.0;
            assert!((mean(&now, &at(49)) - turn.cos()).norm() < 0.03, "{ms} ms");
        }
    }
}

//! Rays that surface and bottom reflect, in water whose sound speed changes with depth, and the points where an array sees scatterers along them.
//!
//! A level boundary keeps the ray parameter p. A reflected ray is therefore a sum of spans between two depths each, every one without a turn: unfolded at the
//! boundaries, it is a ray through the profile and its mirror images. With the sums A(z) over the layers from the surface to the depth z,
//!
//! ```text
//! by the surface               A(sonar) + A(scatterer)
//! by the bottom and surface    2 A(bottom) - A(sonar) + A(scatterer)
//! ```
//!
//! Their ranges are increasing functions of p as that of a direct ray, so the same table, interpolation and iteration apply ([`rays`](super::rays)).
//!
//! A sloping bottom changes p and bearing. The place of reflection b is then where the travel time of both parts, sonar to b and b to scatterer by the
//! surface, is stationary (Fermat), found by Newton's method. With the horizontal slowness p_i e_i and the vertical one q_i of both parts at b, and the
//! slope g of the bottom, the gradient of the time along the bottom is
//!
//! ```text
//! p_1 e_1 + p_2 e_2 + (q_1 + q_2) g
//! ```
//!
//! At a sloping bottom a tube keeps its width and its divergence; that the sound speed changes across its width there is left out.
//!
//! Rays that turn between two reflections are not followed.

use std::sync::Arc;

use glam::{DQuat, DVec2, DVec3};

use super::rays::{
    CLOSED, Knot, MAX_FOCUS, MAX_STEPS, MIN_TABLE_SINE, Node, RAYS, SAME_DEPTH_M, Sums,
    between_rays, curvature_error_s, spreading_per_m, table_tangents,
};
use echotank_core::ping::Refraction;
use echotank_core::sound_speed::SoundSpeedProfile;

/// Steps to the place of reflection on a sloping bottom, at most.
const SLOPE_STEPS: usize = 12;
/// A shorter step ends them, metres. The error of the time is of second order in it.
const SETTLED_M: f64 = 1e-5;
/// Spans of a ray: by the depths of sonar, bottom and scatterer.
const SPANS: usize = 3;

/// A plane that reflects.
#[derive(Clone, Copy, Debug)]
pub struct BottomPlane {
    /// A point of it, world, metres.
    pub at_m: DVec3,
    /// Unit normal, away from the bottom.
    pub up: DVec3,
}

/// A reflection on the way of a ray.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Bounce {
    /// Share of the travel time from the sonar to it.
    pub time_share: f64,
    /// Sine of the grazing angle.
    pub sine: f64,
    /// Sound speed, metres per second.
    pub speed_m_per_s: f64,
}

/// A scatterer as seen along a reflected ray, in water of the array's own sound speed.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Reflected {
    /// Place from which sound would arrive with the time and the direction of the ray, world, metres.
    pub position_m: DVec3,
    /// Factor on the pressure of this leg: spreading and absorption of the ray relative to those of the virtual point, without the boundaries.
    pub gain: f64,
    /// The reflections, the first from the sonar on; the second is the default where there is one only.
    pub bounces: [Bounce; 2],
    /// Rotation from the end of the ray, in the mirrors of the boundaries, to its start.
    turn: DQuat,
}

impl Reflected {
    /// A normal at the scatterer, already mirrored as the image is, rotated so that its angle with the ray is the same at the virtual point.
    pub fn normal(&self, mirrored: [f32; 3]) -> [f32; 3] {
        let n = DVec3::from_array(mirrored.map(f64::from));
        (self.turn * n).as_vec3().to_array()
    }
}

/// A depth in the table.
#[derive(Clone, Copy, Debug)]
struct Place {
    depth_m: f64,
    c: f64,
    knot: usize,
    thick_m: f64,
    is_tabulated: bool,
}

/// A ray as a sum of spans from the surface down, with weights.
#[derive(Clone, Copy, Debug)]
struct Unfolded {
    spans: [(f64, Place); SPANS],
    /// Sound speeds at its ends.
    ends: (f64, f64),
}

/// A ray that was found.
#[derive(Clone, Copy, Debug)]
struct Found {
    p: f64,
    /// Of all spans. Between tabulated rays only the time is interpolated to a high order.
    sums: Sums,
    /// Of each span, without its weight.
    span_time_s: [f64; SPANS],
    spreading_per_m: f64,
}

/// The reflected rays of one array.
#[derive(Clone, Debug)]
pub struct ReflectedRays {
    water: Refraction,
    surface_m: f64,
    /// The table ends here.
    deepest_m: f64,
    c0: f64,
    nepers_per_m: f64,
    tangents: [f64; RAYS],
    p: [f64; RAYS],
    /// From the surface down, with the depth of the array among them.
    knots: Vec<Knot>,
    nodes: Vec<Node>,
    array: Place,
}

impl ReflectedRays {
    /// Allocates the table for `profile`.
    pub fn new(profile: Arc<SoundSpeedProfile>) -> Self {
        let knots = profile.points().len() + 2;
        Self {
            water: Refraction {
                profile,
                array_m: DVec3::ZERO,
                floor_m: 0.0,
                reflections: None,
                places: Default::default(),
            },
            surface_m: 0.0,
            c0: f64::NAN,
            nepers_per_m: 0.0,
            tangents: table_tangents(),
            p: [0.0; RAYS],
            knots: Vec::with_capacity(knots),
            nodes: Vec::with_capacity((knots + 1) * RAYS),
            array: Place {
                depth_m: 0.0,
                c: f64::NAN,
                knot: 0,
                thick_m: 0.0,
                is_tabulated: true,
            },
            deepest_m: f64::NEG_INFINITY,
        }
    }

    /// The profile of the rays.
    pub fn profile(&self) -> &Arc<SoundSpeedProfile> {
        &self.water.profile
    }

    /// Tabulates the rays of `water` from the surface at `surface_m` down to the deepest point of the profile above `deepest_m`. `absorption_db_per_m`: one way.
    pub fn aim(
        &mut self,
        water: &Refraction,
        absorption_db_per_m: f64,
        surface_m: f64,
        deepest_m: f64,
    ) {
        self.water.clone_from(water);
        self.surface_m = surface_m;
        self.c0 = water.sound_speed_m_per_s();
        self.nepers_per_m = absorption_db_per_m * std::f64::consts::LN_10 / 20.0;
        self.knots.clear();
        self.nodes.clear();
        for (p, tangent) in self.p.iter_mut().zip(self.tangents) {
            *p = tangent / (1.0 + tangent * tangent).sqrt() / self.c0;
        }
        let (knots, nodes, p) = (&mut self.knots, &mut self.nodes, &self.p);
        let sine = |p: f64, c: f64| (1.0 - p * p * c * c).max(0.0).sqrt();
        let c_surface = water.profile.at_m_per_s(surface_m);
        nodes.extend(p.iter().map(|p| Node {
            sums: Sums::default(),
            sine: sine(*p, c_surface),
        }));
        let mut rays = p.partition_point(|p| sine(*p, c_surface) >= MIN_TABLE_SINE);
        let array_m = water.array_m.z.max(surface_m);
        let mut visit = |(z1, c1): (f64, f64), (z2, c2): (f64, f64)| {
            let layer = (z2 - z1, (c2 - c1) / (z2 - z1));
            knots.push(Knot {
                depth_m: z1,
                c: c1,
                gradient_per_s: layer.1,
                rays,
            });
            let reached = p[..rays].partition_point(|p| sine(*p, c2) >= MIN_TABLE_SINE);
            rays = reached;
            let begin = nodes.len() - RAYS;
            for j in 0..RAYS {
                let mut node = nodes[begin + j];
                if j < rays {
                    let s2 = sine(p[j], c2);
                    node.sums.add(p[j], layer, (c1, node.sine), (c2, s2));
                    node.sine = s2;
                }
                nodes.push(node);
            }
        };
        water.profile.layers(surface_m, array_m, &mut visit);
        let deepest_m = deepest_m.max(array_m + SAME_DEPTH_M);
        water.profile.layers(array_m, deepest_m, &mut visit);
        self.deepest_m = deepest_m;
        self.array = self.place(array_m);
    }

    fn place(&self, depth_m: f64) -> Place {
        let below = self.knots.partition_point(|knot| knot.depth_m <= depth_m);
        let knot = below.saturating_sub(1);
        let first = &self.knots[knot];
        let thick_m = (depth_m - first.depth_m).max(0.0);
        let is_tabulated = depth_m <= self.deepest_m;
        Place {
            depth_m,
            c: match is_tabulated {
                true => first.c + first.gradient_per_s * thick_m,
                false => self.water.profile.at_m_per_s(depth_m),
            },
            knot,
            thick_m,
            is_tabulated,
        }
    }

    /// Sums of tabulated ray `j` from the surface down to a place.
    #[inline(always)]
    fn sums(&self, j: usize, place: &Place) -> Sums {
        let (knot, node) = (&self.knots[place.knot], &self.nodes[place.knot * RAYS + j]);
        let mut sums = node.sums;
        if place.thick_m > 0.0 {
            let s = self.sine(self.p[j], place.c);
            let layer = (place.thick_m, knot.gradient_per_s);
            sums.add(self.p[j], layer, (knot.c, node.sine), (place.c, s));
        }
        sums
    }

    #[inline(always)]
    fn sine(&self, p: f64, c: f64) -> f64 {
        (1.0 - (p * c) * (p * c)).max(0.0).sqrt()
    }

    fn find(&self, ray: &Unfolded, range_m: f64) -> Option<Found> {
        self.tabulated(ray, range_m)
            .or_else(|| self.solved(ray, range_m))
    }

    /// Range over p of tabulated ray `j`.
    #[inline(always)]
    fn range_per_p(&self, ray: &Unfolded, j: usize) -> f64 {
        let p = self.p[j];
        let span = |(weight, place): &(f64, Place)| {
            if *weight == 0.0 {
                return 0.0;
            }
            let (knot, node) = (&self.knots[place.knot], &self.nodes[place.knot * RAYS + j]);
            let last = match place.thick_m > 0.0 {
                true => (knot.c + place.c) * place.thick_m / (node.sine + self.sine(p, place.c)),
                false => 0.0,
            };
            weight * (node.sums.range_per_p + last)
        };
        ray.spans.iter().map(span).sum()
    }

    /// The ray by the table.
    fn tabulated(&self, ray: &Unfolded, range_m: f64) -> Option<Found> {
        let used = ray.spans.iter().filter(|(weight, _)| *weight != 0.0);
        let (mut rays, mut fastest, mut height_m) = (RAYS, 0.0f64, 0.0);
        for (weight, place) in used {
            if !place.is_tabulated {
                return None;
            }
            rays = rays.min(self.knots[place.knot].rays);
            fastest = fastest.max(place.c);
            height_m += weight * (place.depth_m - self.surface_m);
        }
        let range_of = |j: usize| self.p[j] * self.range_per_p(ray, j);
        let straight = range_m / height_m;
        let mut j = self.tangents.partition_point(|t| *t <= straight);
        j = j.saturating_sub(1).min(rays.checked_sub(2)?);
        while j > 0 && range_of(j) > range_m {
            j -= 1;
        }
        while j + 2 < rays && range_of(j + 1) <= range_m {
            j += 1;
        }
        if self.sine(self.p[j + 1], fastest) < MIN_TABLE_SINE {
            return None;
        }
        let (a, a_times_s) = self.sums_of(ray, |place| self.sums(j, place));
        let (b, b_times_s) = self.sums_of(ray, |place| self.sums(j + 1, place));
        let (x, time_s, p) = between_rays((self.p[j], &a), (self.p[j + 1], &b), range_m)?;
        let between = |a: f64, b: f64| a + (b - a) * x;
        let excess = |sums: &Sums| sums.length_m - self.c0 * sums.time_s;
        let spread = |p: f64, sums: &Sums| {
            let (c1, c2) = ray.ends;
            let ends = ((c1, self.sine(p, c1)), (c2, self.sine(p, c2)));
            (self.c0 * sums.time_s * spreading_per_m(sums, ends.0, ends.1)).powi(2)
        };
        let spread = between(spread(self.p[j], &a), spread(self.p[j + 1], &b));
        Some(Found {
            p,
            sums: Sums {
                range_per_p: between(a.range_per_p, b.range_per_p),
                range_by_p: between(a.range_by_p, b.range_by_p),
                time_s,
                length_m: self.c0 * time_s + between(excess(&a), excess(&b)),
            },
            span_time_s: std::array::from_fn(|k| between(a_times_s[k], b_times_s[k])),
            spreading_per_m: spread.sqrt() / (self.c0 * time_s),
        })
    }

    /// Sums of all spans, and the time of each.
    #[inline(always)]
    fn sums_of(&self, ray: &Unfolded, of: impl Fn(&Place) -> Sums) -> (Sums, [f64; SPANS]) {
        let (mut all, mut times_s) = (Sums::default(), [0.0; SPANS]);
        for ((weight, place), time_s) in ray.spans.iter().zip(&mut times_s) {
            if *weight != 0.0 {
                let one = of(place);
                all.range_per_p += weight * one.range_per_p;
                all.range_by_p += weight * one.range_by_p;
                all.time_s += weight * one.time_s;
                all.length_m += weight * one.length_m;
                *time_s = one.time_s;
            }
        }
        (all, times_s)
    }

    /// The ray by Newton's method, as for a direct one: with m = p / sqrt(1 - p^2 c^2), c the highest speed on the way, the range is an increasing and concave
    /// function of m.
    fn solved(&self, ray: &Unfolded, range_m: f64) -> Option<Found> {
        let profile = &self.water.profile;
        let used = ray.spans.iter().filter(|(weight, _)| *weight != 0.0);
        let (mut deepest_m, mut height_m) = (self.surface_m, 0.0);
        for (weight, place) in used {
            deepest_m = deepest_m.max(place.depth_m);
            height_m += weight * (place.depth_m - self.surface_m);
        }
        let (mut fastest, mut throughout) = (0.0f64, false);
        profile.layers(self.surface_m, deepest_m, |(_, c1), (_, c2)| {
            let c = c1.max(c2);
            throughout = (throughout && c <= fastest) || (c1 == c2 && c >= fastest);
            fastest = fastest.max(c);
        });
        if height_m < SAME_DEPTH_M || fastest == 0.0 {
            return None;
        }
        let of = |p: f64, sine: &dyn Fn(f64) -> f64| {
            self.sums_of(ray, |place| {
                let mut sums = Sums::default();
                profile.layers(self.surface_m, place.depth_m, |(z1, c1), (z2, c2)| {
                    let layer = (z2 - z1, (c2 - c1) / (z2 - z1));
                    sums.add(p, layer, (c1, sine(c1)), (c2, sine(c2)));
                });
                sums
            })
        };
        if !throughout {
            let level_sine = |c: f64| ((fastest - c) * (fastest + c)).sqrt() / fastest;
            let p = 1.0 / fastest;
            if range_m >= p * of(p, &level_sine).0.range_per_p {
                return None;
            }
        }
        let mut m = range_m / (height_m * fastest);
        let mut steps = 0;
        loop {
            let s_fastest = 1.0 / (1.0 + m * m * fastest * fastest).sqrt();
            let p = m * s_fastest;
            let sine = |c: f64| s_fastest * (1.0 + m * m * (fastest - c) * (fastest + c)).sqrt();
            let (sums, span_time_s) = of(p, &sine);
            let short_m = range_m - p * sums.range_per_p;
            steps += 1;
            if short_m.abs() <= CLOSED * range_m || steps >= MAX_STEPS {
                let (c1, c2) = ray.ends;
                return Some(Found {
                    p,
                    sums,
                    span_time_s,
                    spreading_per_m: spreading_per_m(&sums, (c1, sine(c1)), (c2, sine(c2))),
                });
            }
            let next = m + short_m / (sums.range_by_p * s_fastest.powi(3));
            // Rounding decides the last digits.
            if next == m {
                steps = MAX_STEPS - 1;
            }
            m = next.max(0.0);
        }
    }

    /// The scatterer at `at_m` (world, metres) by way of the surface. None in a shadow of the water, or where an end does not lie below the surface.
    pub fn by_surface(&self, at_m: DVec3) -> Option<Reflected> {
        let array_m = self.water.array_m;
        if array_m.z <= self.surface_m || at_m.z <= self.surface_m {
            return None;
        }
        let scatterer = self.place(at_m.z);
        let ray = Unfolded {
            spans: [(1.0, self.array), (0.0, self.array), (1.0, scatterer)],
            ends: (self.array.c, scatterer.c),
        };
        let (range_m, outward) = horizontal(at_m - array_m);
        let found = self.find(&ray, range_m)?;
        let up = Bounce {
            time_share: found.span_time_s[0] / found.sums.time_s,
            ..self.at_surface(found.p)
        };
        let start = self.direction(found.p, self.c0, outward, -1.0);
        let end = self.direction(found.p, scatterer.c, outward, -1.0);
        Some(self.seen(&found, [up, Bounce::default()], start, end))
    }

    /// The scatterer at `at_m` (world, metres) by way of the bottom, and then the surface. `near_m`: about where the bottom reflects. None as for
    /// [`Self::by_surface`], and where the sonar is not above the bottom.
    pub fn by_bottom(&self, at_m: DVec3, plane: &BottomPlane, near_m: DVec3) -> Option<Reflected> {
        let slope = DVec2::new(-plane.up.x, -plane.up.y) / plane.up.z;
        match slope == DVec2::ZERO {
            true => self.by_level_bottom(at_m, plane.at_m.z),
            false => self.by_sloping_bottom(at_m, plane, slope, near_m.truncate()),
        }
    }

    fn by_level_bottom(&self, at_m: DVec3, bottom_m: f64) -> Option<Reflected> {
        let array_m = self.water.array_m;
        if array_m.z <= self.surface_m || at_m.z <= self.surface_m || bottom_m <= array_m.z {
            return None;
        }
        let (bottom, scatterer) = (self.place(bottom_m), self.place(at_m.z));
        let ray = Unfolded {
            spans: [(-1.0, self.array), (2.0, bottom), (1.0, scatterer)],
            ends: (self.array.c, scatterer.c),
        };
        let (range_m, outward) = horizontal(at_m - array_m);
        let found = self.find(&ray, range_m)?;
        let [to_array_s, to_bottom_s, _] = found.span_time_s;
        let down_s = to_bottom_s - to_array_s;
        let bounces = [
            Bounce {
                time_share: down_s / found.sums.time_s,
                sine: self.sine(found.p, bottom.c),
                speed_m_per_s: bottom.c,
            },
            Bounce {
                time_share: (down_s + to_bottom_s) / found.sums.time_s,
                ..self.at_surface(found.p)
            },
        ];
        let start = self.direction(found.p, self.c0, outward, 1.0);
        let end = self.direction(found.p, scatterer.c, outward, 1.0);
        Some(self.seen(&found, bounces, start, end))
    }

    fn by_sloping_bottom(
        &self,
        at_m: DVec3,
        plane: &BottomPlane,
        slope: DVec2,
        near_m: DVec2,
    ) -> Option<Reflected> {
        let array_m = self.water.array_m;
        if array_m.z <= self.surface_m || at_m.z <= self.surface_m {
            return None;
        }
        let scatterer = self.place(at_m.z);
        let mut bounce_m = near_m;
        for _ in 0..SLOPE_STEPS {
            let down_m = plane.at_m.z + slope.dot(bounce_m - plane.at_m.truncate());
            if down_m <= self.surface_m || down_m <= array_m.z {
                return None;
            }
            let bottom = self.place(down_m);
            let down = Unfolded {
                spans: [(-1.0, self.array), (1.0, bottom), (0.0, bottom)],
                ends: (self.array.c, bottom.c),
            };
            let on = Unfolded {
                spans: [(0.0, bottom), (1.0, bottom), (1.0, scatterer)],
                ends: (bottom.c, scatterer.c),
            };
            let (first_m, e1) = horizontal((bounce_m - array_m.truncate()).extend(0.0));
            let (second_m, e2) = horizontal((bounce_m - at_m.truncate()).extend(0.0));
            let (first, second) = (self.find(&down, first_m)?, self.find(&on, second_m)?);
            // Gradient of the time along the bottom, and its derivative.
            let mut gradient = DVec2::ZERO;
            let [mut xx, mut xy, mut yy] = [0.0; 3];
            for (part, e) in [(&first, e1), (&second, e2)] {
                let q = self.sine(part.p, bottom.c) / bottom.c;
                gradient += part.p * e + q * slope;
                let along = e - (part.p / q) * slope;
                let across = e.perp();
                for (v, weight) in [
                    (along, 1.0 / part.sums.range_by_p),
                    (across, 1.0 / part.sums.range_per_p),
                ] {
                    xx += weight * v.x * v.x;
                    xy += weight * v.x * v.y;
                    yy += weight * v.y * v.y;
                }
            }
            let determinant = xx * yy - xy * xy;
            let step_m = DVec2::new(
                (xy * gradient.y - yy * gradient.x) / determinant,
                (xy * gradient.x - xx * gradient.y) / determinant,
            );
            if !step_m.is_finite() {
                return None;
            }
            if step_m.length() >= SETTLED_M {
                bounce_m += step_m;
                continue;
            }
            let start = self.direction(first.p, self.c0, e1, 1.0);
            let at_bottom = self.direction(first.p, bottom.c, e1, 1.0);
            let at_scatterer = self.direction(second.p, scatterer.c, -e2, 1.0);
            let time_s = first.sums.time_s + second.sums.time_s;
            let bounces = [
                Bounce {
                    time_share: first.sums.time_s / time_s,
                    sine: -at_bottom.dot(plane.up),
                    speed_m_per_s: bottom.c,
                },
                Bounce {
                    time_share: (first.sums.time_s + second.span_time_s[1]) / time_s,
                    ..self.at_surface(second.p)
                },
            ];
            let turned = self.sine(first.p, bottom.c) / self.sine(second.p, bottom.c);
            let sums = Sums {
                range_per_p: first.sums.range_per_p + second.sums.range_per_p,
                range_by_p: first.sums.range_by_p * turned + second.sums.range_by_p / turned,
                time_s,
                length_m: first.sums.length_m + second.sums.length_m,
            };
            let ends = [(first.p, self.c0), (second.p, scatterer.c)];
            let [a, b] = ends.map(|(p, c)| (c, self.sine(p, c)));
            let found = Found {
                p: first.p,
                sums,
                span_time_s: [0.0; SPANS],
                spreading_per_m: spreading_per_m(&sums, a, b),
            };
            // The end of the ray in the mirrors of surface and bottom.
            let mut end = at_scatterer;
            end.z = -end.z;
            end -= 2.0 * end.dot(plane.up) * plane.up;
            return Some(self.seen(&found, bounces, start, end));
        }
        None
    }

    fn at_surface(&self, p: f64) -> Bounce {
        let c = self.knots[0].c;
        Bounce {
            time_share: 0.0,
            sine: self.sine(p, c),
            speed_m_per_s: c,
        }
    }

    /// Direction of a ray of parameter `p` at a sound speed, world.
    fn direction(&self, p: f64, c: f64, outward: DVec2, down: f64) -> DVec3 {
        (outward * (p * c)).extend(down * self.sine(p, c))
    }

    /// `start` and `end`: directions of the ray at both ends, the end in the mirrors of the boundaries.
    fn seen(&self, found: &Found, bounces: [Bounce; 2], start: DVec3, end: DVec3) -> Reflected {
        let distance_m = self.c0 * found.sums.time_s;
        let excess_m = found.sums.length_m - distance_m;
        let spread = (distance_m * found.spreading_per_m).min(MAX_FOCUS.sqrt());
        Reflected {
            position_m: self.water.array_m + distance_m * start,
            gain: spread * libm::exp(-self.nepers_per_m * excess_m),
            bounces,
            turn: DQuat::from_rotation_arc(end.normalize_or(start), start.normalize()),
        }
    }
}

/// Length and direction of the horizontal part of an offset; north where there is none.
fn horizontal(offset_m: DVec3) -> (f64, DVec2) {
    let level_m = offset_m.truncate();
    let range_m = level_m.length();
    match range_m > 0.0 {
        true => (range_m, level_m / range_m),
        false => (0.0, DVec2::X),
    }
}

/// As [`virtual_point_error`](super::rays::virtual_point_error), of reflected rays, in seconds; zero where there are none.
pub(super) fn reflected_point_error_s(
    water: &Refraction,
    offsets_m: (f64, f64),
    depth_m: f64,
) -> f64 {
    let Some(reflections) = water.reflections else {
        return 0.0;
    };
    let bottom_m = match reflections.by_bottom {
        true => water.floor_m.min(SoundSpeedProfile::MAX_DEPTH_M),
        false => depth_m,
    };
    let (surface_m, array_m) = (reflections.surface_m, water.array_m.z);
    if array_m <= surface_m || depth_m <= surface_m || bottom_m <= array_m {
        return 0.0;
    }
    let mut table = ReflectedRays::new(water.profile.clone());
    table.aim(water, 0.0, surface_m, depth_m.max(bottom_m));
    let (bottom, scatterer) = (table.place(bottom_m), table.place(depth_m));
    let legs = [
        [(1.0, table.array), (0.0, bottom), (1.0, scatterer)],
        [(-1.0, table.array), (2.0, bottom), (1.0, scatterer)],
    ];
    let legs = match reflections.by_bottom {
        true => &legs[..],
        false => &legs[..1],
    };
    let gradient_per_s = water.profile.max_gradient_per_s();
    let mut worst_s = 0.0f64;
    for spans in legs {
        let ray = Unfolded {
            spans: *spans,
            ends: (table.c0, scatterer.c),
        };
        let used = spans.iter().filter(|(weight, _)| *weight != 0.0);
        let rays = used.clone().map(|(_, place)| table.knots[place.knot].rays);
        let rays = rays.min().unwrap_or(0);
        let fastest = used.map(|(_, place)| place.c).fold(0.0, f64::max);
        for j in 1..rays {
            if table.sine(table.p[j], fastest) < MIN_TABLE_SINE {
                break;
            }
            let (sums, _) = table.sums_of(&ray, |place| table.sums(j, place));
            let at = (table.c0, table.p[j]);
            worst_s = worst_s.max(curvature_error_s(at, &sums, gradient_per_s, offsets_m));
        }
    }
    worst_s
}

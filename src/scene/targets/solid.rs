//! Solid shapes: intersection with rays, and scatterers spread evenly over the surface.
//!
//! Coordinates are north-east-down metres about any origin. Every ray test is exact for the shape as described. Ray directions are unit vectors. Ray
//! tests follow Ericson 2005, Real-Time Collision Detection, ch. 5 (boxes by slabs, cylinders by the quadratic of the distance from the axis).

use glam::{DMat3, DVec3};

use super::mesh::Mesh;
use super::random::KeyedRandom;
use super::surface::{SKIN_M, SurfacePoint};

/// Geometry of a solid.
#[derive(Clone, Debug)]
pub enum Solid {
    Sphere {
        center_m: DVec3,
        radius_m: f64,
    },
    /// A cylinder with flat ends.
    Cylinder {
        /// Centres of the two ends.
        ends_m: [DVec3; 2],
        radius_m: f64,
    },
    Box {
        center_m: DVec3,
        /// Unit axes of the box as columns, in world coordinates.
        axes: DMat3,
        half_m: DVec3,
    },
    /// A polyline of round cylinders with spheres at its joints: ropes, chains, pipelines.
    Rope {
        /// At least two vertices; neighbours differ.
        vertices_m: Vec<DVec3>,
        radius_m: f64,
    },
    Mesh(Mesh),
}

impl Solid {
    /// Distance along the ray to the first intersection beyond [`SKIN_M`]; none if the ray misses. From inside, the distance at which the ray leaves.
    pub(crate) fn first_hit_m(&self, origin_m: DVec3, direction: DVec3) -> Option<f64> {
        match self {
            Self::Sphere { center_m, radius_m } => {
                sphere_hit_m(origin_m - center_m, direction, *radius_m)
            }
            Self::Cylinder { ends_m, radius_m } => {
                cylinder_hit_m(*ends_m, *radius_m, origin_m, direction)
            }
            Self::Box {
                center_m,
                axes,
                half_m,
            } => {
                let to_box = axes.transpose();
                box_hit_m(to_box * (origin_m - center_m), to_box * direction, *half_m)
            }
            Self::Rope {
                vertices_m,
                radius_m,
            } => {
                let links = vertices_m.windows(2).filter_map(|pair| {
                    cylinder_hit_m([pair[0], pair[1]], *radius_m, origin_m, direction)
                });
                let joints = vertices_m.iter().skip(1).take(vertices_m.len() - 2);
                let joints =
                    joints.filter_map(|joint| sphere_hit_m(origin_m - joint, direction, *radius_m));
                links.chain(joints).reduce(f64::min)
            }
            Self::Mesh(mesh) => mesh.first_hit_m(origin_m, direction),
        }
    }

    /// Whether the ray meets the shape between its start and `max_m`.
    pub fn hits(&self, origin_m: DVec3, direction: DVec3, max_m: f64) -> bool {
        self.first_hit_m(origin_m, direction)
            .is_some_and(|met_m| met_m < max_m)
    }

    /// Corners of the axis-parallel bounding box.
    pub(crate) fn bounds_m(&self) -> (DVec3, DVec3) {
        match self {
            Self::Sphere { center_m, radius_m } => (*center_m - *radius_m, *center_m + *radius_m),
            Self::Cylinder { ends_m, radius_m } => {
                // A disc of radius r about the unit axis a extends r sqrt(1 - a_i^2) along each coordinate.
                let axis = (ends_m[1] - ends_m[0]).normalize();
                let reach = (DVec3::ONE - axis * axis).max(DVec3::ZERO);
                let reach = DVec3::new(reach.x.sqrt(), reach.y.sqrt(), reach.z.sqrt()) * *radius_m;
                (
                    ends_m[0].min(ends_m[1]) - reach,
                    ends_m[0].max(ends_m[1]) + reach,
                )
            }
            Self::Box {
                center_m,
                axes,
                half_m,
            } => {
                let reach = axes.x_axis.abs() * half_m.x
                    + axes.y_axis.abs() * half_m.y
                    + axes.z_axis.abs() * half_m.z;
                (center_m - reach, center_m + reach)
            }
            Self::Rope {
                vertices_m,
                radius_m,
            } => {
                let mut ends = (vertices_m[0], vertices_m[0]);
                for vertex in vertices_m {
                    ends = (ends.0.min(*vertex), ends.1.max(*vertex));
                }
                (ends.0 - *radius_m, ends.1 + *radius_m)
            }
            Self::Mesh(mesh) => mesh.bounds_m(),
        }
    }

    /// Scattering area, square metres. A rope has its lateral surfaces only.
    pub fn area_m2(&self) -> f64 {
        use std::f64::consts::{PI, TAU};
        match self {
            Self::Sphere { radius_m, .. } => 4.0 * PI * radius_m * radius_m,
            Self::Cylinder { ends_m, radius_m } => {
                TAU * radius_m * (ends_m[0].distance(ends_m[1]) + radius_m)
            }
            Self::Box { half_m, .. } => {
                8.0 * (half_m.x * half_m.y + half_m.y * half_m.z + half_m.z * half_m.x)
            }
            Self::Rope {
                vertices_m,
                radius_m,
            } => TAU * radius_m * length_m(vertices_m),
            Self::Mesh(mesh) => mesh.area_m2(),
        }
    }

    /// The point of the surface below which, in a fixed order, the share `share` (0..1) of the area lies. Even shares give even points. `across`
    /// (0..1) is the coordinate transverse to the order.
    pub(crate) fn surface_point(&self, share: f64, across: f64) -> SurfacePoint {
        use std::f64::consts::TAU;
        match self {
            Self::Sphere { center_m, radius_m } => {
                // Equal slices of a sphere have equal areas (Archimedes).
                let z = 1.0 - 2.0 * share;
                let (sin, cos) = libm::sincos(TAU * across);
                let ring = (1.0 - z * z).max(0.0).sqrt();
                let normal = DVec3::new(ring * cos, ring * sin, z);
                SurfacePoint {
                    position_m: *center_m + normal * *radius_m,
                    normal,
                }
            }
            Self::Cylinder { ends_m, radius_m } => {
                let axis = (ends_m[1] - ends_m[0]).normalize();
                let length_m = ends_m[0].distance(ends_m[1]);
                let caps = *radius_m / (length_m + *radius_m);
                if share >= caps {
                    let along = (share - caps) / (1.0 - caps);
                    return mantle_point(ends_m[0], axis, length_m, *radius_m, along, across);
                }
                let second = share >= caps / 2.0;
                let within = share / (caps / 2.0) - f64::from(u8::from(second));
                let (sin, cos) = libm::sincos(TAU * across);
                let (u, v) = axis.any_orthonormal_pair();
                let outward = if second { axis } else { -axis };
                SurfacePoint {
                    position_m: ends_m[usize::from(second)]
                        + (u * cos + v * sin) * (within.max(0.0).sqrt() * *radius_m),
                    normal: outward,
                }
            }
            Self::Box {
                center_m,
                axes,
                half_m,
            } => box_point(*center_m, axes, *half_m, share, across),
            Self::Rope {
                vertices_m,
                radius_m,
            } => {
                let mut along_m = share * length_m(vertices_m);
                let mut link = 0;
                while link + 2 < vertices_m.len()
                    && along_m >= vertices_m[link].distance(vertices_m[link + 1])
                {
                    along_m -= vertices_m[link].distance(vertices_m[link + 1]);
                    link += 1;
                }
                let (from, to) = (vertices_m[link], vertices_m[link + 1]);
                let link_m = from.distance(to);
                let axis = (to - from) / link_m;
                let along = (along_m / link_m).min(1.0);
                mantle_point(from, axis, link_m, *radius_m, along, across)
            }
            Self::Mesh(mesh) => mesh.surface_point(share, across),
        }
    }

    /// The shape translated by `by_m`, metres.
    pub fn moved(mut self, by_m: DVec3) -> Self {
        match &mut self {
            Self::Sphere { center_m, .. } | Self::Box { center_m, .. } => *center_m += by_m,
            Self::Cylinder { ends_m, .. } => ends_m.iter_mut().for_each(|end| *end += by_m),
            Self::Rope { vertices_m, .. } => vertices_m.iter_mut().for_each(|v| *v += by_m),
            Self::Mesh(mesh) => mesh.shift(by_m),
        }
        self
    }

    /// Samples `count` points, each at random in an equal share of the area.
    pub(super) fn sample(
        &self,
        count: usize,
        chance: &mut KeyedRandom,
        mut take: impl FnMut(SurfacePoint, &mut KeyedRandom),
    ) {
        for k in 0..count {
            let share = (k as f64 + chance.uniform()) / count as f64;
            let across = chance.uniform();
            take(self.surface_point(share, across), chance);
        }
    }
}

fn length_m(vertices_m: &[DVec3]) -> f64 {
    vertices_m
        .windows(2)
        .map(|pair| pair[0].distance(pair[1]))
        .sum()
}

/// The smaller root of t^2 + 2 b t + c = 0 that exceeds [`SKIN_M`]; none if neither does.
fn first_root(half_b: f64, c: f64) -> Option<f64> {
    let discriminant = half_b * half_b - c;
    if discriminant < 0.0 {
        return None;
    }
    let root = discriminant.sqrt();
    [-half_b - root, -half_b + root]
        .into_iter()
        .find(|t| *t > SKIN_M)
}

/// `from_m` is the start of the ray relative to the centre.
fn sphere_hit_m(from_m: DVec3, direction: DVec3, radius_m: f64) -> Option<f64> {
    first_root(
        from_m.dot(direction),
        from_m.length_squared() - radius_m * radius_m,
    )
}

fn cylinder_hit_m(
    ends_m: [DVec3; 2],
    radius_m: f64,
    origin_m: DVec3,
    direction: DVec3,
) -> Option<f64> {
    let length_m = ends_m[0].distance(ends_m[1]);
    let axis = (ends_m[1] - ends_m[0]) / length_m;
    let from_m = origin_m - ends_m[0];
    let (along, rise) = (from_m.dot(axis), direction.dot(axis));
    let (flat_from, flat_direction) = (from_m - axis * along, direction - axis * rise);
    let mut first: Option<f64> = None;
    let mut consider = |t: f64| {
        if t > SKIN_M && first.is_none_or(|best| t < best) {
            first = Some(t);
        }
    };
    let flat_squared = flat_direction.length_squared();
    if flat_squared > 0.0 {
        let half_b = flat_from.dot(flat_direction) / flat_squared;
        let c = (flat_from.length_squared() - radius_m * radius_m) / flat_squared;
        let discriminant = half_b * half_b - c;
        if discriminant >= 0.0 {
            for t in [-half_b - discriminant.sqrt(), -half_b + discriminant.sqrt()] {
                if (0.0..=length_m).contains(&(along + t * rise)) {
                    consider(t);
                }
            }
        }
    }
    if rise != 0.0 {
        for level_m in [0.0, length_m] {
            let t = (level_m - along) / rise;
            if (flat_from + flat_direction * t).length_squared() <= radius_m * radius_m {
                consider(t);
            }
        }
    }
    first
}

/// Intersection with a box, in the axes of the box.
fn box_hit_m(from_m: DVec3, direction: DVec3, half_m: DVec3) -> Option<f64> {
    let (mut enter, mut leave) = (f64::NEG_INFINITY, f64::INFINITY);
    for axis in 0..3 {
        if direction[axis] == 0.0 {
            if from_m[axis].abs() > half_m[axis] {
                return None;
            }
            continue;
        }
        let a = (-half_m[axis] - from_m[axis]) / direction[axis];
        let b = (half_m[axis] - from_m[axis]) / direction[axis];
        enter = enter.max(a.min(b));
        leave = leave.min(a.max(b));
    }
    if enter > leave {
        return None;
    }
    [enter, leave].into_iter().find(|t| *t > SKIN_M)
}

/// A point on the lateral surface of a cylinder: `along` (0..=1) of its length, `across` (0..1) of its circumference.
fn mantle_point(
    from_m: DVec3,
    axis: DVec3,
    length_m: f64,
    radius_m: f64,
    along: f64,
    across: f64,
) -> SurfacePoint {
    let (u, v) = axis.any_orthonormal_pair();
    let (sin, cos) = libm::sincos(std::f64::consts::TAU * across);
    let normal = u * cos + v * sin;
    SurfacePoint {
        position_m: from_m + axis * (along * length_m) + normal * radius_m,
        normal,
    }
}

fn box_point(
    center_m: DVec3,
    axes: &DMat3,
    half_m: DVec3,
    share: f64,
    across: f64,
) -> SurfacePoint {
    // Pairs of faces by their normal axis. On each face, `share` runs along one side and `across` along the other.
    let faces = [
        half_m.y * half_m.z,
        half_m.z * half_m.x,
        half_m.x * half_m.y,
    ];
    let mut left = share * 2.0 * (faces[0] + faces[1] + faces[2]);
    let mut face = (2, 1.0);
    'search: for (axis, area) in faces.into_iter().enumerate() {
        for side in [-1.0, 1.0] {
            face = (axis, side);
            if left < area {
                break 'search;
            }
            left -= area;
        }
    }
    let (axis, side) = face;
    let along = (left / faces[axis]).clamp(0.0, 1.0);
    let (b, c) = ((axis + 1) % 3, (axis + 2) % 3);
    let mut own_m = DVec3::ZERO;
    own_m[axis] = side * half_m[axis];
    own_m[b] = (2.0 * along - 1.0) * half_m[b];
    own_m[c] = (2.0 * across - 1.0) * half_m[c];
    SurfacePoint {
        position_m: center_m + *axes * own_m,
        normal: axes.col(axis) * side,
    }
}

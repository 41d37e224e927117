//! A [`TriangleMesh`] as a solid: ray tests through a bounding-volume hierarchy, and points spread evenly over the area.
//!
//! Triangles of negligible area are dropped, since no ray test is sound for them. Vertices run anticlockwise seen from outside. A closed mesh with
//! the opposite order throughout is reversed.

use glam::DVec3;

use super::surface::{SKIN_M, SurfacePoint};
use crate::read::TriangleMesh;

/// Greatest number of triangles in a leaf of the tree.
const LEAF: usize = 8;
/// Least area of a triangle, as a share of the squared longest side: below it lies the rounding of f32 coordinates.
const SLIVER: f64 = 1e-9;
/// Tolerance of the triangle test at the edges, as a share of the triangle. It prevents rays from passing between two triangles.
const EDGE: f64 = 1e-9;
/// A mesh is closed if the sum of its area vectors is below this share of its area. The tolerance covers the rounding of f32 coordinates.
const CLOSED: f64 = 1e-5;

#[derive(Clone, Debug)]
pub struct Mesh {
    triangles: Vec<Triangle>,
    /// Cumulative area, square metres.
    area_up_to_m2: Vec<f64>,
    nodes: Vec<Node>,
}

#[derive(Clone, Copy, Debug)]
struct Triangle {
    a_m: DVec3,
    ab_m: DVec3,
    ac_m: DVec3,
}

/// Bounding box of the triangles `first .. first + count` in the order of the tree (a leaf), or of two children. The children are the next node and
/// the node after its subtree; `second` is the node after this subtree.
#[derive(Clone, Copy, Debug)]
struct Node {
    low_m: DVec3,
    high_m: DVec3,
    first: u32,
    count: u32,
    second: u32,
}

impl Mesh {
    /// Builds the tree. None if no triangle has an area. Every index must name a vertex and every coordinate must be finite; the readers check both.
    pub fn new(mesh: &TriangleMesh) -> Option<Self> {
        let mut kept: Vec<Triangle> = mesh
            .triangles
            .iter()
            .map(|corners| {
                let [a_m, b, c] = corners.map(|i| mesh.vertices_m[i as usize]);
                Triangle {
                    a_m,
                    ab_m: b - a_m,
                    ac_m: c - a_m,
                }
            })
            .filter(|triangle| !triangle.is_sliver())
            .collect();
        if kept.is_empty() {
            return None;
        }
        if is_inside_out(&kept) {
            for triangle in &mut kept {
                std::mem::swap(&mut triangle.ab_m, &mut triangle.ac_m);
            }
        }
        let mut nodes = Vec::with_capacity(2 * kept.len() / LEAF + 1);
        build(&mut kept, 0, &mut nodes);
        let mut sum = 0.0;
        let area_up_to_m2 = kept
            .iter()
            .map(|t| {
                sum += t.area_m2();
                sum
            })
            .collect();
        Some(Self {
            triangles: kept,
            area_up_to_m2,
            nodes,
        })
    }

    pub(super) fn shift(&mut self, by_m: DVec3) {
        for triangle in &mut self.triangles {
            triangle.a_m += by_m;
        }
        for node in &mut self.nodes {
            node.low_m += by_m;
            node.high_m += by_m;
        }
    }

    pub fn area_m2(&self) -> f64 {
        self.area_up_to_m2.last().copied().unwrap_or(0.0)
    }

    pub(crate) fn bounds_m(&self) -> (DVec3, DVec3) {
        (self.nodes[0].low_m, self.nodes[0].high_m)
    }

    pub(crate) fn first_hit_m(&self, origin_m: DVec3, direction: DVec3) -> Option<f64> {
        let mut nearest: Option<f64> = None;
        let inverse = direction.recip();
        let mut at = 0;
        // Depth-first traversal without a stack. After a missed node or a leaf comes the node after its subtree.
        while let Some(node) = self.nodes.get(at) {
            let limit_m = nearest.unwrap_or(f64::INFINITY);
            let missed = !node.may_be_met(origin_m, inverse, limit_m);
            if missed || node.count > 0 {
                let span = node.first as usize..(node.first + node.count) as usize;
                if !missed {
                    for triangle in &self.triangles[span] {
                        if let Some(met_m) = triangle.hit_m(origin_m, direction)
                            && nearest.is_none_or(|best| met_m < best)
                        {
                            nearest = Some(met_m);
                        }
                    }
                }
                at = node.second as usize;
            } else {
                at += 1;
            }
        }
        nearest
    }

    pub(crate) fn surface_point(&self, share: f64, across: f64) -> SurfacePoint {
        let wanted_m2 = share * self.area_m2();
        let index = self
            .area_up_to_m2
            .partition_point(|area| *area <= wanted_m2)
            .min(self.triangles.len() - 1);
        let triangle = &self.triangles[index];
        let before_m2 = if index == 0 {
            0.0
        } else {
            self.area_up_to_m2[index - 1]
        };
        let within = ((wanted_m2 - before_m2) / triangle.area_m2()).clamp(0.0, 1.0);
        // The square root spreads points evenly between the corner and the opposite side (Turk 1990, Graphics Gems).
        let reach = within.sqrt();
        SurfacePoint {
            position_m: triangle.a_m
                + (triangle.ab_m * (1.0 - across) + triangle.ac_m * across) * reach,
            normal: triangle.ab_m.cross(triangle.ac_m).normalize_or_zero(),
        }
    }
}

impl Triangle {
    fn area_m2(&self) -> f64 {
        self.ab_m.cross(self.ac_m).length() / 2.0
    }
    fn is_sliver(&self) -> bool {
        let bc_m = self.ac_m - self.ab_m;
        let sides = [self.ab_m, self.ac_m, bc_m].map(DVec3::length_squared);
        self.area_m2() <= SLIVER * sides.into_iter().fold(0.0, f64::max)
    }
    fn bounds_m(&self) -> (DVec3, DVec3) {
        let (b, c) = (self.a_m + self.ab_m, self.a_m + self.ac_m);
        (self.a_m.min(b).min(c), self.a_m.max(b).max(c))
    }
    fn center_m(&self) -> DVec3 {
        self.a_m + (self.ab_m + self.ac_m) / 3.0
    }
    /// Two-sided ray test of Moller and Trumbore 1997.
    fn hit_m(&self, origin_m: DVec3, direction: DVec3) -> Option<f64> {
        let p = direction.cross(self.ac_m);
        let determinant = self.ab_m.dot(p);
        if determinant == 0.0 {
            return None;
        }
        let from = origin_m - self.a_m;
        let u = from.dot(p) / determinant;
        let q = from.cross(self.ab_m);
        let v = direction.dot(q) / determinant;
        if u < -EDGE || v < -EDGE || u + v > 1.0 + EDGE {
            return None;
        }
        let t = self.ac_m.dot(q) / determinant;
        (t > SKIN_M).then_some(t)
    }
}

impl Node {
    fn may_be_met(&self, origin_m: DVec3, inverse: DVec3, limit_m: f64) -> bool {
        let (mut enter, mut leave) = (0.0_f64, limit_m);
        for axis in 0..3 {
            if inverse[axis].is_infinite() {
                // Parallel to the slab: 0 times infinity below would be NaN.
                if !(self.low_m[axis]..=self.high_m[axis]).contains(&origin_m[axis]) {
                    return false;
                }
                continue;
            }
            let a = (self.low_m[axis] - origin_m[axis]) * inverse[axis];
            let b = (self.high_m[axis] - origin_m[axis]) * inverse[axis];
            enter = enter.max(a.min(b));
            leave = leave.min(a.max(b));
        }
        enter <= leave
    }
}

/// Whether the triangles enclose a volume that they face.
fn is_inside_out(triangles: &[Triangle]) -> bool {
    let (mut area_m2, mut sum_m2, mut volume_m3) = (0.0, DVec3::ZERO, 0.0);
    // Relative to a corner of the mesh, which avoids cancellation far from the origin.
    let from_m = triangles[0].a_m;
    for triangle in triangles {
        let twice_m2 = triangle.ab_m.cross(triangle.ac_m);
        area_m2 += triangle.area_m2();
        sum_m2 += twice_m2 / 2.0;
        volume_m3 += (triangle.a_m - from_m).dot(twice_m2) / 6.0;
    }
    sum_m2.length() < CLOSED * area_m2 && volume_m3 < 0.0
}

/// Appends the tree of `triangles`, which begin at index `offset` of all, to `nodes` in depth-first order.
fn build(triangles: &mut [Triangle], offset: usize, nodes: &mut Vec<Node>) {
    let everywhere = (DVec3::INFINITY, DVec3::NEG_INFINITY);
    let union = |ends: (DVec3, DVec3), low: DVec3, high: DVec3| (ends.0.min(low), ends.1.max(high));
    let (low_m, high_m) = triangles.iter().fold(everywhere, |ends, t| {
        let (low, high) = t.bounds_m();
        union(ends, low, high)
    });
    let place = nodes.len();
    nodes.push(Node {
        low_m,
        high_m,
        first: offset as u32,
        count: 0,
        second: 0,
    });
    if triangles.len() <= LEAF {
        nodes[place].count = triangles.len() as u32;
    } else {
        let (low, high) = triangles.iter().fold(everywhere, |ends, t| {
            union(ends, t.center_m(), t.center_m())
        });
        let size = high - low;
        let axis = (0..3)
            .max_by(|a, b| size[*a].total_cmp(&size[*b]))
            .unwrap_or(0);
        let middle = triangles.len() / 2;
        triangles.select_nth_unstable_by(middle, |a, b| {
            a.center_m()[axis].total_cmp(&b.center_m()[axis])
        });
        let (left, right) = triangles.split_at_mut(middle);
        build(left, offset, nodes);
        build(right, offset + middle, nodes);
    }
    nodes[place].second = nodes.len() as u32;
}

//! Edge collapse by quadric error on a triangulated surface (Garland and Heckbert 1997), as a comparison method.
//!
//! It replaces the optimisation of Meng et al. 2023, Eqs. 22-25. The quadrics measure its distance energy; its springs only break ties here.
//!
//! Collapses are half-edge collapses: the kept corners are corners of the original surface at their original positions. The caller decides whether a
//! kept corner inherits the area of the corners that collapsed into it; see [`Collapsed::area_share`].

use std::cmp::Reverse;
use std::collections::BinaryHeap;

use glam::DVec3;

/// Weight of the rim of an open surface relative to the area of its triangles (Garland and Heckbert 1997, section 6).
const RIM_WEIGHT: f64 = 10.0;
/// A collapse may turn a remaining triangle by 78 degrees at most (cosine 0.2); beyond that the surface folds over.
const MIN_TURN_COSINE: f64 = 0.2;
/// Spring constant: squared metres of error per square metre of edge. It decides only where the surface is flat.
const SPRING: f64 = 1e-9;

/// Squared distance from a set of planes: x' A x + 2 b'x + c.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(crate) struct Quadric {
    /// Upper triangle of A, row by row.
    a: [f64; 6],
    b: DVec3,
    c: f64,
}

impl Quadric {
    /// `weight` times the squared distance from the plane through `point` with the unit `normal`.
    pub(crate) fn of_plane(point: DVec3, normal: DVec3, weight: f64) -> Self {
        let (n, d) = (normal, -normal.dot(point));
        Self {
            a: [
                n.x * n.x,
                n.x * n.y,
                n.x * n.z,
                n.y * n.y,
                n.y * n.z,
                n.z * n.z,
            ]
            .map(|v| v * weight),
            b: n * (d * weight),
            c: d * d * weight,
        }
    }
    pub(crate) fn at(&self, p: DVec3) -> f64 {
        let [xx, xy, xz, yy, yz, zz] = self.a;
        let ap = DVec3::new(
            xx * p.x + xy * p.y + xz * p.z,
            xy * p.x + yy * p.y + yz * p.z,
            xz * p.x + yz * p.y + zz * p.z,
        );
        // Rounding may yield slightly negative values on the plane itself.
        (p.dot(ap) + 2.0 * self.b.dot(p) + self.c).max(0.0)
    }
    fn add(&mut self, o: &Self) {
        for (mine, other) in self.a.iter_mut().zip(o.a) {
            *mine += other;
        }
        self.b += o.b;
        self.c += o.c;
    }
}

/// Result of [`collapse`].
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Collapsed {
    /// Indices of the kept corners, ascending.
    pub kept: Vec<u32>,
    /// Number of original corners that each kept corner represents, itself included.
    pub area_share: Vec<f64>,
    /// Remaining triangles, by original indices.
    pub triangles: Vec<[u32; 3]>,
}

struct Surface<'a> {
    places: &'a [DVec3],
    triangles: Vec<[u32; 3]>,
    alive: Vec<bool>,
    /// Triangles at each corner. Dead ones are removed when met.
    around: Vec<Vec<u32>>,
    quadrics: Vec<Quadric>,
    /// Version of each corner. Queue entries with an older version are stale.
    version: Vec<u32>,
    gone: Vec<bool>,
}

/// Collapses edges in order of cost until `keep` corners are left, or until every further collapse would fold the surface.
///
/// `places` are the corners' positions relative to a nearby point, since quadrics square them. Corners in no triangle are dropped first.
pub fn collapse(places: &[DVec3], triangles: &[[u32; 3]], keep: usize) -> Collapsed {
    let count = places.len();
    let center = places.iter().filter(|p| p.is_finite()).sum::<DVec3>() / count.max(1) as f64;
    let places: Vec<DVec3> = places.iter().map(|p| p - center).collect();
    let mut surface = Surface::new(&places, triangles);
    let mut area_share = vec![1.0; count];
    let mut left = count;
    for i in 0..count {
        if left > keep && surface.around[i].is_empty() {
            surface.gone[i] = true;
            left -= 1;
        }
    }
    let mut queue = BinaryHeap::new();
    for a in 0..count as u32 {
        for b in surface.neighbours(a) {
            if a < b {
                queue.push(surface.candidate(a, b));
                queue.push(surface.candidate(b, a));
            }
        }
    }
    while left > keep {
        let Some(Reverse(next)) = queue.pop() else {
            break;
        };
        let (from, to) = (next.from as usize, next.to as usize);
        let stale = surface.gone[from]
            || surface.gone[to]
            || next.versions != (surface.version[from], surface.version[to]);
        if stale || !surface.may_collapse(next.from, next.to) {
            continue;
        }
        surface.collapse(next.from, next.to);
        area_share[to] += area_share[from];
        left -= 1;
        for other in surface.neighbours(next.to) {
            queue.push(surface.candidate(next.to, other));
            queue.push(surface.candidate(other, next.to));
        }
    }
    let kept: Vec<u32> = (0..count as u32)
        .filter(|i| !surface.gone[*i as usize])
        .collect();
    Collapsed {
        area_share: kept.iter().map(|i| area_share[*i as usize]).collect(),
        triangles: (0..surface.triangles.len())
            .filter(|t| surface.alive[*t])
            .map(|t| surface.triangles[t])
            .collect(),
        kept,
    }
}

/// A possible collapse of `from` into `to`, ordered by cost. Ties are ordered by index, so that the order is deterministic.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Candidate {
    cost: f64,
    from: u32,
    to: u32,
    versions: (u32, u32),
}
impl Eq for Candidate {}
impl PartialOrd for Candidate {
    fn partial_cmp(&self, o: &Self) -> Option<std::cmp::Ordering> {
        Some(self.cmp(o))
    }
}
impl Ord for Candidate {
    fn cmp(&self, o: &Self) -> std::cmp::Ordering {
        self.cost
            .total_cmp(&o.cost)
            .then(self.from.cmp(&o.from))
            .then(self.to.cmp(&o.to))
            .then(self.versions.cmp(&o.versions))
    }
}

impl<'a> Surface<'a> {
    /// Drops triangles with repeated or missing corners or positions that are not finite.
    fn new(places: &'a [DVec3], triangles: &[[u32; 3]]) -> Self {
        let count = places.len();
        let sound = |t: &&[u32; 3]| {
            let [a, b, c] = **t;
            a != b
                && b != c
                && c != a
                && t.iter()
                    .all(|i| places.get(*i as usize).is_some_and(|p| p.is_finite()))
        };
        let triangles: Vec<[u32; 3]> = triangles.iter().filter(sound).copied().collect();
        let mut surface = Self {
            places,
            alive: vec![true; triangles.len()],
            around: vec![Vec::new(); count],
            quadrics: vec![Quadric::default(); count],
            version: vec![0; count],
            gone: vec![false; count],
            triangles,
        };
        for t in 0..surface.triangles.len() {
            for corner in surface.triangles[t] {
                surface.around[corner as usize].push(t as u32);
            }
        }
        surface.lay_quadrics();
        surface
    }

    fn lay_quadrics(&mut self) {
        for t in 0..self.triangles.len() {
            let corners = self.triangles[t];
            let [a, b, c] = corners.map(|i| self.places[i as usize]);
            let cross = (b - a).cross(c - a);
            let (area, normal) = (cross.length() / 2.0, cross.normalize_or_zero());
            let plane = Quadric::of_plane(a, normal, area);
            for corner in corners {
                self.quadrics[corner as usize].add(&plane);
            }
            for k in 0..3 {
                let (i, j) = (corners[k], corners[(k + 1) % 3]);
                if self.shared(i, j) > 1 {
                    continue;
                }
                // Rim: a plane perpendicular to the triangle along its free side.
                let (from, edge) = (
                    self.places[i as usize],
                    self.places[j as usize] - self.places[i as usize],
                );
                let upright = edge.cross(normal).normalize_or_zero();
                let rim = Quadric::of_plane(from, upright, RIM_WEIGHT * area);
                self.quadrics[i as usize].add(&rim);
                self.quadrics[j as usize].add(&rim);
            }
        }
    }

    /// Number of triangles that contain both corners.
    fn shared(&self, i: u32, j: u32) -> usize {
        self.around[i as usize]
            .iter()
            .filter(|t| self.alive[**t as usize] && self.triangles[**t as usize].contains(&j))
            .count()
    }

    fn neighbours(&self, i: u32) -> Vec<u32> {
        let mut all: Vec<u32> = self.around[i as usize]
            .iter()
            .filter(|t| self.alive[**t as usize])
            .flat_map(|t| self.triangles[*t as usize])
            .filter(|j| *j != i)
            .collect();
        all.sort_unstable();
        all.dedup();
        all
    }

    fn candidate(&self, from: u32, to: u32) -> Reverse<Candidate> {
        let (f, t) = (from as usize, to as usize);
        let mut joint = self.quadrics[f];
        joint.add(&self.quadrics[t]);
        let spring = SPRING * self.places[f].distance_squared(self.places[t]);
        Reverse(Candidate {
            cost: joint.at(self.places[t]) + spring,
            from,
            to,
            versions: (self.version[f], self.version[t]),
        })
    }

    /// Whether the collapse keeps the surface a manifold (link condition) and does not fold it over.
    fn may_collapse(&self, from: u32, to: u32) -> bool {
        let (mine, others) = (self.neighbours(from), self.neighbours(to));
        let common = mine
            .iter()
            .filter(|i| others.binary_search(i).is_ok())
            .count();
        if common != self.shared(from, to) {
            return false;
        }
        let target = self.places[to as usize];
        self.around[from as usize].iter().all(|t| {
            let corners = self.triangles[*t as usize];
            if !self.alive[*t as usize] || corners.contains(&to) {
                return true;
            }
            let place = |moved: bool| {
                corners.map(|i| match moved && i == from {
                    true => target,
                    false => self.places[i as usize],
                })
            };
            let normal = |[a, b, c]: [DVec3; 3]| (b - a).cross(c - a);
            let (before, after) = (normal(place(false)), normal(place(true)));
            before.dot(after) > MIN_TURN_COSINE * before.length() * after.length()
        })
    }

    fn collapse(&mut self, from: u32, to: u32) {
        let (f, t) = (from as usize, to as usize);
        let quadric = self.quadrics[f];
        self.quadrics[t].add(&quadric);
        for triangle in std::mem::take(&mut self.around[f]) {
            let index = triangle as usize;
            if !self.alive[index] {
                continue;
            }
            if self.triangles[index].contains(&to) {
                self.alive[index] = false;
                continue;
            }
            for corner in &mut self.triangles[index] {
                if *corner == from {
                    *corner = to;
                }
            }
            self.around[t].push(triangle);
        }
        let mut around = std::mem::take(&mut self.around[t]);
        around.retain(|triangle| self.alive[*triangle as usize]);
        self.around[t] = around;
        self.gone[f] = true;
        self.version[t] += 1;
    }
}

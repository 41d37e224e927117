//! Triangulation of soundings (Delaunay 1934, by the sweep of Sinclair 2010), linear interpolation on triangles, and resampling to a grid.

use delaunator::{Point, triangulate};
use glam::{DVec2, DVec3};

use super::format_error::refuse;
use super::{FormatError, HeightField, MAX_CELLS};

/// A triangulated surface over the horizontal plane, linear on each triangle.
pub(crate) struct Tin {
    /// Points: north, east, down from the origin, metres.
    pub points_m: Vec<DVec3>,
    pub triangles: Vec<[u32; 3]>,
}

/// Replaces soundings at the same position by their mean. Returns the remaining soundings in order of first appearance, and the number removed.
pub(crate) fn merge_duplicates(points: Vec<DVec3>) -> (Vec<DVec3>, u64) {
    let mut order: Vec<u32> = (0..points.len() as u32).collect();
    let key = |i: &u32| {
        let p = points[*i as usize];
        (p.x, p.y, *i)
    };
    order.sort_unstable_by(|a, b| {
        let (a, b) = (key(a), key(b));
        a.0.total_cmp(&b.0)
            .then(a.1.total_cmp(&b.1))
            .then(a.2.cmp(&b.2))
    });
    // Sum and count at the first sounding of each position; zero at the others.
    let mut counts = vec![0_u32; points.len()];
    let mut sums = vec![0.0; points.len()];
    let mut first = None;
    for i in order {
        let here = points[i as usize].truncate();
        let same = first.filter(|f: &u32| points[*f as usize].truncate() == here);
        let owner = same.unwrap_or(i);
        first = Some(owner);
        counts[owner as usize] += 1;
        sums[owner as usize] += points[i as usize].z;
    }
    let merged: Vec<DVec3> = points
        .iter()
        .enumerate()
        .filter(|(i, _)| counts[*i] > 0)
        .map(|(i, p)| match counts[i] {
            1 => *p,
            n => DVec3::new(p.x, p.y, sums[i] / f64::from(n)),
        })
        .collect();
    let gone = (points.len() - merged.len()) as u64;
    (merged, gone)
}

impl Tin {
    /// Triangulates points without duplicates. Drops triangles with an edge longer than `max_edge_m`.
    pub(super) fn new(points_m: Vec<DVec3>, max_edge_m: Option<f64>) -> Result<Self, FormatError> {
        let flat: Vec<Point> = points_m.iter().map(|p| Point { x: p.x, y: p.y }).collect();
        let corners = triangulate(&flat).triangles;
        let triangles: Vec<[u32; 3]> = corners
            .chunks_exact(3)
            .map(|t| [t[0] as u32, t[1] as u32, t[2] as u32])
            .collect();
        let tin = Self {
            points_m,
            triangles,
        };
        tin.without_long_edges(max_edge_m)
    }

    /// Drops triangles with an edge longer than `max_edge_m`. Rejects a surface without triangles.
    pub(crate) fn without_long_edges(
        mut self,
        max_edge_m: Option<f64>,
    ) -> Result<Self, FormatError> {
        if self.triangles.is_empty() {
            let count = self.points_m.len();
            let rule = "soundings span no surface: at least three must not be collinear";
            return refuse("soundings", count, rule);
        }
        if let Some(longest) = max_edge_m {
            let points = &self.points_m;
            self.triangles.retain(|t| {
                let [a, b, c] = t.map(|i| points[i as usize].truncate());
                a.distance(b) <= longest && b.distance(c) <= longest && c.distance(a) <= longest
            });
            if self.triangles.is_empty() {
                let rule = "removes every triangle: the soundings lie farther apart";
                return refuse("max_edge_m", longest, rule);
            }
        }
        Ok(self)
    }

    /// Depth at a position; none outside. At a sounding it equals the sounding to the bit. Tests every triangle.
    pub(super) fn sample(&self, north_m: f64, east_m: f64) -> Option<f64> {
        let at = DVec2::new(north_m, east_m);
        self.triangles.iter().find_map(|t| {
            let corners = t.map(|i| self.points_m[i as usize]);
            let low = corners[0].min(corners[1]).min(corners[2]);
            let high = corners[0].max(corners[1]).max(corners[2]);
            if at.x < low.x || at.x > high.x || at.y < low.y || at.y > high.y {
                return None;
            }
            let (b, c) = weights(corners, at)?;
            (b >= 0.0 && c >= 0.0 && b + c <= 1.0).then(|| mixed(corners, b, c))
        })
    }

    /// Samples the surface at the cell centres of a grid. The cell size is `cell_m`, or the mean spacing of the soundings.
    pub(super) fn grid(&self, cell_m: Option<f64>) -> Result<HeightField, FormatError> {
        let start = DVec3::splat(f64::INFINITY);
        let low = self.points_m.iter().fold(start, |m, p| m.min(*p));
        let high = self.points_m.iter().fold(-start, |m, p| m.max(*p));
        let extent = (high - low).truncate();
        let cell_m = match cell_m {
            Some(cell_m) => cell_m,
            None => (extent.x * extent.y / self.points_m.len() as f64).sqrt(),
        };
        let (rows, cols) = (
            (extent.x / cell_m).floor() + 1.0,
            (extent.y / cell_m).floor() + 1.0,
        );
        if !(rows >= 2.0 && cols >= 2.0 && rows * cols <= MAX_CELLS as f64) {
            let rule = format!(
                "makes {rows} rows and {cols} columns over {:.1} x {:.1} m: at least 2 of each, and {MAX_CELLS} cells at most",
                extent.x, extent.y
            );
            return refuse("cell_m", cell_m, rule);
        }
        let (rows, cols) = (rows as usize, cols as usize);
        let spare = extent - DVec2::new((rows - 1) as f64, (cols - 1) as f64) * cell_m;
        let mut field = HeightField {
            rows,
            cols,
            cell_north_m: cell_m,
            cell_east_m: cell_m,
            south_m: low.x + spare.x / 2.0,
            west_m: low.y + spare.y / 2.0,
            down_m: vec![f32::NAN; rows * cols],
        };
        for triangle in &self.triangles {
            fill(&mut field, triangle.map(|i| self.points_m[i as usize]));
        }
        Ok(field)
    }
}

/// Barycentric weights of the second and the third corner; none in a triangle without area. They are exact at the corners.
fn weights(corners: [DVec3; 3], at: DVec2) -> Option<(f64, f64)> {
    let [a, b, c] = corners.map(DVec3::truncate);
    let (ab, ac, ap) = (b - a, c - a, at - a);
    let area = ab.perp_dot(ac);
    (area != 0.0).then(|| (ap.perp_dot(ac) / area, ab.perp_dot(ap) / area))
}

fn mixed(corners: [DVec3; 3], b: f64, c: f64) -> f64 {
    corners[0].z * (1.0 - b - c) + corners[1].z * b + corners[2].z * c
}

/// Writes the depths of a triangle to the cells whose centres it covers, row by row between its edges.
fn fill(field: &mut HeightField, corners: [DVec3; 3]) {
    let cell = DVec2::new(field.cell_north_m, field.cell_east_m);
    let zero = DVec2::new(field.south_m, field.west_m);
    // In cells from the south-western centre: x is the row coordinate, y the column coordinate.
    let at = corners.map(|p| (p.truncate() - zero) / cell);
    let low = at[0].x.min(at[1].x).min(at[2].x).ceil().max(0.0);
    let high = at[0]
        .x
        .max(at[1].x)
        .max(at[2].x)
        .min((field.rows - 1) as f64);
    let mut row = low;
    while row <= high {
        let (mut from, mut to) = (f64::INFINITY, f64::NEG_INFINITY);
        for (a, b) in [(at[0], at[1]), (at[1], at[2]), (at[2], at[0])] {
            if (a.x <= row && b.x >= row) || (b.x <= row && a.x >= row) {
                for y in if a.x == b.x {
                    [a.y, b.y]
                } else {
                    [a.y + (b.y - a.y) * ((row - a.x) / (b.x - a.x)); 2]
                } {
                    (from, to) = (from.min(y), to.max(y));
                }
            }
        }
        let mut col = from.ceil().max(0.0);
        while col <= to.min((field.cols - 1) as f64) {
            let place = zero + DVec2::new(row, col) * cell;
            if let Some((b, c)) = weights(corners, place) {
                // Rounding may put a centre slightly outside an edge.
                let (b, c) = (b.clamp(0.0, 1.0), c.clamp(0.0, 1.0));
                let c = c.min(1.0 - b);
                field.down_m[row as usize * field.cols + col as usize] =
                    mixed(corners, b, c) as f32;
            }
            col += 1.0;
        }
        row += 1.0;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Irregular positions on a plane.
    fn soundings(count: u32) -> Vec<DVec3> {
        (0..count)
            .map(|k| {
                let (u, v) = (
                    f64::from(k) * 0.618_033_988_75,
                    f64::from(k) * 0.754_877_666,
                );
                let (n, e) = (u.fract() * 100.0, v.fract() * 60.0);
                DVec3::new(n, e, 20.0 + 0.1 * n - 0.05 * e)
            })
            .collect()
    }

    #[test]
    fn a_plane_of_soundings_is_a_plane_everywhere_inside() {
        let tin = Tin::new(soundings(500), None).unwrap();
        let field = tin.grid(Some(1.5)).unwrap();
        let (mut worst, mut filled) = (0.0_f64, 0);
        for row in 0..field.rows {
            for col in 0..field.cols {
                let n = field.south_m + row as f64 * field.cell_north_m;
                let e = field.west_m + col as f64 * field.cell_east_m;
                let got = field.cell_down_m(row, col);
                if !got.is_nan() {
                    filled += 1;
                    worst = worst.max((got - (20.0 + 0.1 * n - 0.05 * e)).abs());
                }
                assert_eq!(got.is_nan(), tin.sample(n, e).is_none(), "{n} {e}");
            }
        }
        println!(
            "{filled} of {} cells, worst {worst:.1e} m",
            field.down_m.len()
        );
        // Resolution of f32 at 30 m.
        assert!(worst < 2e-6, "{worst}");
        assert!(filled * 10 > field.down_m.len() * 9);
    }

    #[test]
    fn at_a_sounding_the_surface_is_the_sounding() {
        let mut points = soundings(300);
        for (k, p) in points.iter_mut().enumerate() {
            p.z = f64::from(k as u32) * 0.1;
        }
        let tin = Tin::new(points.clone(), None).unwrap();
        for p in points {
            assert_eq!(tin.sample(p.x, p.y), Some(p.z));
        }
    }

    #[test]
    fn soundings_at_one_position_become_their_mean() {
        let p = DVec3::new;
        let (merged, gone) = merge_duplicates(vec![
            p(1.0, 2.0, 10.0),
            p(0.0, 0.0, 5.0),
            p(1.0, 2.0, 20.0),
            p(1.0, 3.0, 1.0),
            p(1.0, 2.0, 60.0),
        ]);
        assert_eq!(
            merged,
            [p(1.0, 2.0, 30.0), p(0.0, 0.0, 5.0), p(1.0, 3.0, 1.0)]
        );
        assert_eq!(gone, 2);
    }

    #[test]
    fn collinear_soundings_and_long_edges_are_rejected() {
        let line: Vec<DVec3> = (0..9).map(|k| DVec3::splat(f64::from(k))).collect();
        let message = |r: Result<Tin, FormatError>| r.map(|_| ()).unwrap_err().to_string();
        assert_eq!(
            message(Tin::new(line, None)),
            "soundings: `9`: soundings span no surface: at least three must not be collinear"
        );
        assert_eq!(
            message(Tin::new(soundings(20), Some(0.1))),
            "max_edge_m: `0.1`: removes every triangle: the soundings lie farther apart"
        );
        assert!(
            Tin::new(soundings(20), None)
                .unwrap()
                .grid(Some(1e-6))
                .is_err()
        );
        let gap = Tin::new(soundings(500), Some(8.0)).unwrap();
        let all = Tin::new(soundings(500), None).unwrap();
        assert!(gap.triangles.len() < all.triangles.len());
    }
}

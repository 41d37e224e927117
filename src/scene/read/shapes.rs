//! Results of the readers: height fields and triangle meshes, in local metres.

use glam::DVec3;

/// Depths at the centres of the cells of a grid whose rows run east and whose columns run north.
///
/// The surface is bilinear between the centres and ends at the outer ones. Depths are f32, as in the files: the resolution is 4 um at 50 m and 0.5 mm
/// at 6 km.
#[derive(Clone, Debug, PartialEq)]
pub struct HeightField {
    /// At least 2.
    pub rows: usize,
    /// At least 2.
    pub cols: usize,
    /// Northward size of a cell, metres.
    pub cell_north_m: f64,
    /// Eastward size of a cell, metres.
    pub cell_east_m: f64,
    /// Northing of the south-western cell's centre from the field's origin, metres.
    pub south_m: f64,
    /// Easting of the south-western cell's centre from the field's origin, metres.
    pub west_m: f64,
    /// Depths, positive down, southern row first: `down_m[row * cols + col]`. NaN is a hole.
    pub down_m: Vec<f32>,
}

/// Depth and slope of a surface at one position.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Depth {
    /// Depth, metres, positive down.
    pub down_m: f64,
    /// Northward slope, d down / d north.
    pub slope_north: f64,
    /// Eastward slope, d down / d east.
    pub slope_east: f64,
}

impl HeightField {
    /// Depth at the centre of a cell; NaN is a hole.
    pub(crate) fn cell_down_m(&self, row: usize, col: usize) -> f64 {
        f64::from(self.down_m[row * self.cols + col])
    }

    /// Distance from the southern to the northern outer centres, metres.
    pub fn extent_north_m(&self) -> f64 {
        (self.rows - 1) as f64 * self.cell_north_m
    }

    /// Distance from the western to the eastern outer centres, metres.
    pub fn extent_east_m(&self) -> f64 {
        (self.cols - 1) as f64 * self.cell_east_m
    }

    /// Fraction of the cells that are holes, 0 to 1.
    pub fn hole_share(&self) -> f64 {
        let holes = self.down_m.iter().filter(|d| d.is_nan()).count();
        holes as f64 / self.down_m.len() as f64
    }

    /// Quantiles of the depths of the filled cells, metres: share 0 is the shallowest, 1 the deepest. Empty if all cells are holes.
    pub fn percentiles_m(&self, shares: &[f64]) -> Vec<f64> {
        let mut depths: Vec<f32> = self
            .down_m
            .iter()
            .copied()
            .filter(|d| !d.is_nan())
            .collect();
        if depths.is_empty() {
            return Vec::new();
        }
        depths.sort_unstable_by(f32::total_cmp);
        let last = (depths.len() - 1) as f64;
        let at = |share: &f64| f64::from(depths[(last * share).round() as usize]);
        shares.iter().map(at).collect()
    }

    /// Depth and slope at a position relative to the field's origin. None outside the outer centres, and where any of the four surrounding cells is a
    /// hole.
    pub fn sample(&self, north_m: f64, east_m: f64) -> Option<Depth> {
        self.sample_with_twist(north_m, east_m).map(|s| s.0)
    }

    /// Depth and slope, and d^2 down / d north d east, which is constant over a square.
    #[inline]
    pub(crate) fn sample_with_twist(&self, north_m: f64, east_m: f64) -> Option<(Depth, f64)> {
        let (from_south_m, from_west_m) = (north_m - self.south_m, east_m - self.west_m);
        let inside = (0.0..=self.extent_north_m()).contains(&from_south_m)
            && (0.0..=self.extent_east_m()).contains(&from_west_m);
        if !inside {
            return None;
        }
        let (row, v) = split(from_south_m / self.cell_north_m, self.rows);
        let (col, u) = split(from_west_m / self.cell_east_m, self.cols);
        let sw = self.cell_down_m(row, col);
        let se = self.cell_down_m(row, col + 1);
        let nw = self.cell_down_m(row + 1, col);
        let ne = self.cell_down_m(row + 1, col + 1);
        let south = sw * (1.0 - u) + se * u;
        let north = nw * (1.0 - u) + ne * u;
        let down_m = south * (1.0 - v) + north * v;
        // A hole among the four corners makes the sum NaN, whatever its weight.
        (!down_m.is_nan()).then(|| {
            let depth = Depth {
                down_m,
                slope_north: (north - south) / self.cell_north_m,
                slope_east: ((se - sw) * (1.0 - v) + (ne - nw) * v) / self.cell_east_m,
            };
            let twist = (ne - nw - se + sw) / (self.cell_north_m * self.cell_east_m);
            (depth, twist)
        })
    }
}

/// Index and fraction of a coordinate in cells. The last centre belongs to the last interval.
fn split(cells: f64, count: usize) -> (usize, f64) {
    let index = (cells as usize).min(count - 2);
    (index, cells - index as f64)
}

/// A surface of triangles in metres north, east and down of the mesh's origin.
///
/// Every index lies inside `vertices_m`. Vertices run anticlockwise seen from outside, by the convention of the formats.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct TriangleMesh {
    /// Vertices: north, east, down, metres.
    pub vertices_m: Vec<DVec3>,
    /// Triangles as indices of vertices.
    pub triangles: Vec<[u32; 3]>,
}

impl TriangleMesh {
    /// Total area of the triangles, square metres.
    pub fn area_m2(&self) -> f64 {
        let area = |t: &[u32; 3]| {
            let [a, b, c] = t.map(|i| self.vertices_m[i as usize]);
            (b - a).cross(c - a).length() / 2.0
        };
        self.triangles.iter().map(area).sum()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn field() -> HeightField {
        HeightField {
            rows: 2,
            cols: 3,
            cell_north_m: 10.0,
            cell_east_m: 5.0,
            south_m: 100.0,
            west_m: -5.0,
            down_m: vec![4.0, 8.0, 6.0, 1.0, 2.0, 7.0],
        }
    }

    #[test]
    fn depths_are_bilinear_between_centres_and_slopes_are_their_derivatives() {
        let field = field();
        assert_eq!(field.sample(100.0, -5.0).unwrap().down_m, 4.0);
        assert_eq!(
            field.sample(110.0, 5.0).unwrap().down_m,
            7.0,
            "the last corner is inside"
        );
        // Computed by hand at v = 0.3, u = 0.5 of the western cells: 4 .7 .5 + 8 .7 .5 + 1 .3 .5 + 2 .3 .5.
        let at = field.sample(103.0, -2.5).unwrap();
        assert!((at.down_m - 4.65).abs() < 1e-14, "{at:?}");
        assert!((at.slope_north - (1.5 - 6.0) / 10.0).abs() < 1e-14);
        assert!((at.slope_east - (0.7 * 4.0 + 0.3 * 1.0) / 5.0).abs() < 1e-14);
        for (north, east) in [(99.999, 0.0), (100.0, 5.1), (110.1, 0.0), (f64::NAN, 0.0)] {
            assert_eq!(field.sample(north, east), None, "{north} {east}");
        }
    }

    #[test]
    fn a_hole_removes_only_the_squares_around_it() {
        let mut field = field();
        field.down_m[0] = f32::NAN;
        assert_eq!(field.sample(105.0, -2.5), None);
        assert!(field.sample(105.0, 2.5).is_some());
    }
}

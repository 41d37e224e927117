//! Gaussian curvature of a bottom known by points: a quadratic fitted to the neighbourhood of each point.
//!
//! z = a + b x + c y + d x^2/2 + e x y + f y^2/2 is fitted by least squares to a point and its nearest [`NEIGHBOURS`]. Then K = (d f - e^2) / (1 +
//! b^2 + c^2)^2 (do Carmo 1976, 3-3, example 5). Eq. 28 of Meng et al. 2023 prints the denominator unsquared.

use glam::DVec2;

use echotank_core::scene::Scatterers;

/// Number of neighbours: twice the number of coefficients, to average out jitter.
const NEIGHBOURS: usize = 12;
/// Unknowns of the quadratic.
const TERMS: usize = 6;

/// Curvatures of a set of scatterers. It allocates only while the number of scatterers grows.
#[derive(Debug, Default)]
pub struct Curvatures {
    /// Gaussian curvature, 1/m^2; 0 with too few or collinear neighbours.
    pub per_m2: Vec<f64>,
    /// Curvature with the denominator of Eq. 28, 1/m^2.
    pub(crate) as_printed_per_m2: Vec<f64>,
    bins: Bins,
    near: Vec<(f64, u32)>,
}

/// Points sorted into square bins.
#[derive(Debug, Default)]
struct Bins {
    low_m: DVec2,
    side_m: f64,
    rows: usize,
    cols: usize,
    /// Index of the first point of each bin in `order`, and the end.
    starts: Vec<u32>,
    order: Vec<u32>,
}

/// Mean number of points in a bin.
const BIN_POINTS: f64 = 3.0;

impl Curvatures {
    /// Copies the curvatures of another fit to the same positions.
    pub fn clone_values(&mut self, other: &Self) {
        self.per_m2.clone_from(&other.per_m2);
        self.as_printed_per_m2.clone_from(&other.as_printed_per_m2);
    }

    /// Fits the first `free` scatterers. The others get no curvature and are no neighbours.
    pub fn fit(&mut self, scatterers: &Scatterers, free: usize) {
        let count = scatterers.len();
        self.per_m2.clear();
        self.per_m2.resize(count, 0.0);
        self.as_printed_per_m2.clear();
        self.as_printed_per_m2.resize(count, 0.0);
        if !self.bins.sort(scatterers, free) {
            return;
        }
        for i in 0..free {
            self.bins.nearest(scatterers, i, &mut self.near);
            let Some([_, b, c, d, e, f]) = quadratic(scatterers, i, &self.near) else {
                continue;
            };
            let metric = 1.0 + b * b + c * c;
            self.per_m2[i] = (d * f - e * e) / (metric * metric);
            self.as_printed_per_m2[i] = (d * f - e * e) / metric;
        }
    }
}

impl Bins {
    /// Returns false if there is nothing to sort.
    fn sort(&mut self, scatterers: &Scatterers, free: usize) -> bool {
        let at = |i: usize| DVec2::new(scatterers.north_m[i], scatterers.east_m[i]);
        let everywhere = (DVec2::INFINITY, DVec2::NEG_INFINITY);
        let (low, high) = (0..free)
            .map(at)
            .filter(|p| p.is_finite())
            .fold(everywhere, |ends, p| (ends.0.min(p), ends.1.max(p)));
        let size = high - low;
        if free <= TERMS || !size.is_finite() || size.max_element() <= 0.0 {
            return false;
        }
        let points = free as f64;
        let side_m = (size.x * size.y * BIN_POINTS / points)
            .sqrt()
            // Points on a line have no area.
            .max(size.max_element() * BIN_POINTS / points);
        (self.low_m, self.side_m) = (low, side_m);
        self.rows = (size.x / side_m) as usize + 1;
        self.cols = (size.y / side_m) as usize + 1;
        self.starts.clear();
        self.starts.resize(self.rows * self.cols + 1, 0);
        for i in 0..free {
            if let Some(bin) = self.bin(at(i)) {
                self.starts[bin + 1] += 1;
            }
        }
        for bin in 1..self.starts.len() {
            self.starts[bin] += self.starts[bin - 1];
        }
        self.order.clear();
        self.order
            .resize(self.starts[self.rows * self.cols] as usize, 0);
        // Filled from the back, so that the starts end at their final values.
        for i in (0..free).rev() {
            if let Some(bin) = self.bin(at(i)) {
                self.starts[bin + 1] -= 1;
                self.order[self.starts[bin + 1] as usize] = i as u32;
            }
        }
        // Each start has moved to the beginning of its bin, one entry too far: restore the order.
        let total = self.order.len() as u32;
        self.starts.rotate_left(1);
        self.starts[self.rows * self.cols] = total;
        true
    }

    fn bin(&self, at_m: DVec2) -> Option<usize> {
        let cell = (at_m - self.low_m) / self.side_m;
        cell.is_finite().then(|| {
            (cell.x as usize).min(self.rows - 1) * self.cols + (cell.y as usize).min(self.cols - 1)
        })
    }

    /// Nearest points to point `i` (itself included) in the horizontal, nearest first, with their squared distances.
    fn nearest(&self, scatterers: &Scatterers, i: usize, near: &mut Vec<(f64, u32)>) {
        near.clear();
        let center = DVec2::new(scatterers.north_m[i], scatterers.east_m[i]);
        let Some(bin) = self.bin(center) else {
            return;
        };
        let (row, col) = (bin / self.cols, bin % self.cols);
        for ring in 0..self.rows.max(self.cols) {
            // All points within `ring` bin sides of the point lie in the square of that many bins around it.
            let rows = row.saturating_sub(ring)..=(row + ring).min(self.rows - 1);
            for r in rows {
                let edge = r.abs_diff(row) == ring;
                let step = if edge || ring == 0 { 1 } else { 2 * ring };
                for c in (col as isize - ring as isize..=(col + ring) as isize).step_by(step) {
                    if c < 0 || c >= self.cols as isize {
                        continue;
                    }
                    let bin = r * self.cols + c as usize;
                    let span = self.starts[bin] as usize..self.starts[bin + 1] as usize;
                    for &other in &self.order[span] {
                        let o = other as usize;
                        let at = DVec2::new(scatterers.north_m[o], scatterers.east_m[o]);
                        near.push((at.distance_squared(center), other));
                    }
                }
            }
            if near.len() > NEIGHBOURS {
                near.select_nth_unstable_by(NEIGHBOURS, |a, b| {
                    a.0.total_cmp(&b.0).then(a.1.cmp(&b.1))
                });
                near.truncate(NEIGHBOURS + 1);
                let reach_m = ring as f64 * self.side_m;
                if near.iter().all(|(d2, _)| *d2 <= reach_m * reach_m) {
                    break;
                }
            }
        }
        // A fixed order, so that sums over the neighbours do not depend on the other points.
        near.sort_unstable_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
    }
}

/// Coefficients a..f about point `i`, z upward; none if the neighbours do not determine them.
fn quadratic(scatterers: &Scatterers, i: usize, near: &[(f64, u32)]) -> Option<[f64; TERMS]> {
    if near.len() < TERMS {
        return None;
    }
    // Scaled to the size of the neighbourhood, so that the pivots have the same order of magnitude.
    let scale_m = near.iter().map(|n| n.0).fold(0.0, f64::max).sqrt();
    if scale_m <= 0.0 || scale_m.is_nan() {
        return None;
    }
    let mut matrix = [[0.0; TERMS + 1]; TERMS];
    for (_, other) in near {
        let o = *other as usize;
        let x = (scatterers.north_m[o] - scatterers.north_m[i]) / scale_m;
        let y = (scatterers.east_m[o] - scatterers.east_m[i]) / scale_m;
        let z = (scatterers.down_m[i] - scatterers.down_m[o]) / scale_m;
        let row = [1.0, x, y, x * x / 2.0, x * y, y * y / 2.0];
        for (r, line) in matrix.iter_mut().enumerate() {
            for (c, value) in row.iter().chain([&z]).enumerate() {
                line[c] += row[r] * value;
            }
        }
    }
    let mut s = solved(matrix)?;
    for second in &mut s[3..] {
        *second /= scale_m;
    }
    Some(s)
}

/// Gaussian elimination with partial pivoting.
fn solved(mut m: [[f64; TERMS + 1]; TERMS]) -> Option<[f64; TERMS]> {
    /// Least pivot of a sum of a dozen terms of order one. Below it the points lie on a conic or a line.
    const MIN_PIVOT: f64 = 1e-9;
    for k in 0..TERMS {
        let pivot = (k..TERMS).max_by(|a, b| m[*a][k].abs().total_cmp(&m[*b][k].abs()))?;
        m.swap(k, pivot);
        if m[k][k].abs() <= MIN_PIVOT || m[k][k].is_nan() {
            return None;
        }
        let eliminating = m[k];
        for line in &mut m[k + 1..] {
            let factor = line[k] / eliminating[k];
            for (value, above) in line[k..].iter_mut().zip(&eliminating[k..]) {
                *value -= factor * above;
            }
        }
    }
    let mut s = [0.0; TERMS];
    for k in (0..TERMS).rev() {
        let known: f64 = (k + 1..TERMS).map(|c| m[k][c] * s[c]).sum();
        s[k] = (m[k][TERMS] - known) / m[k][k];
    }
    s.iter().all(|v| v.is_finite()).then_some(s)
}

//! Which points of a bottom the sonar cannot see, from the points alone: a horizon scan per azimuth.
//!
//! Seen from the sonar, a point is hidden when a nearer one in its direction stands higher in the view. The points are sorted into
//! sectors as wide as their spacing at the middle range, and each sector is scanned outward with the running maximum of the slope
//! (down - down_sonar) / horizontal range, upward counted positive. It knows height fields only. Against
//! rays, 1 % of the points of a bottom with letters 1.5 m high come out otherwise, next to shadows' edges and on walls steeper than 45 degrees.

use std::f64::consts::PI;

use glam::DVec3;

use super::energy::incidence_from_vertical;
use echotank_core::flow::Scatterers;

#[derive(Debug, Default)]
pub struct Horizon {
    /// Sector, horizontal range, index.
    order: Vec<(u32, f64, u32)>,
    /// Of a sector in the last scan.
    pub width_rad: f64,
}

impl Horizon {
    /// Marks the hidden among the first `free` scatterers. `held_rad`: sectors of an earlier scan, so that points that come and go elsewhere
    /// change nobody's sector.
    pub fn hide(
        &mut self,
        s: &Scatterers,
        free: usize,
        apex_m: DVec3,
        held_rad: Option<f64>,
        hidden: &mut [bool],
    ) {
        self.sort(s, free, apex_m, held_rad);
        let (mut sector, mut horizon) = (u32::MAX, f64::NEG_INFINITY);
        for &(own, range_m, i) in &self.order {
            if own != sector {
                (sector, horizon) = (own, f64::NEG_INFINITY);
            }
            let slope = (apex_m.z - s.down_m[i as usize]) / range_m;
            hidden[i as usize] = slope < horizon;
            horizon = horizon.max(slope);
        }
    }

    /// Eq. 27 as printed: hidden is what has a smaller angle of incidence (from the vertical, Eq. 9) than something nearer in its sector. On one
    /// vertical slice that is the same rule, by the ray's angle in place of its slope.
    pub(crate) fn hide_by_incidence(
        &mut self,
        s: &Scatterers,
        free: usize,
        apex_m: DVec3,
        held_rad: Option<f64>,
        hidden: &mut [bool],
    ) {
        self.sort(s, free, apex_m, held_rad);
        let (mut sector, mut greatest) = (u32::MAX, f64::NEG_INFINITY);
        for &(own, _, i) in &self.order {
            if own != sector {
                (sector, greatest) = (own, f64::NEG_INFINITY);
            }
            let incidence = incidence_from_vertical(s, i as usize, apex_m);
            hidden[i as usize] = incidence < greatest;
            greatest = greatest.max(incidence);
        }
    }

    fn sort(&mut self, s: &Scatterers, free: usize, apex_m: DVec3, held_rad: Option<f64>) {
        self.order.clear();
        let (mut north, mut east) = (
            (f64::INFINITY, f64::NEG_INFINITY),
            (f64::INFINITY, f64::NEG_INFINITY),
        );
        let (mut farthest_m, mut nearest_m) = (0.0_f64, f64::INFINITY);
        for i in 0..free {
            let (n, e) = (s.north_m[i] - apex_m.x, s.east_m[i] - apex_m.y);
            let range_m = n.hypot(e);
            // What is straight below, or nowhere, hides nothing.
            if range_m == 0.0 || !range_m.is_finite() || !s.down_m[i].is_finite() {
                continue;
            }
            north = (north.0.min(n), north.1.max(n));
            east = (east.0.min(e), east.1.max(e));
            farthest_m = farthest_m.max(range_m);
            nearest_m = nearest_m.min(range_m);
            self.order.push((0, range_m, i as u32));
        }
        if self.order.is_empty() {
            return;
        }
        let area_m2 = (north.1 - north.0) * (east.1 - east.0);
        let spacing_m = (area_m2 / self.order.len() as f64).sqrt();
        let middle_m = 0.5 * (nearest_m + farthest_m);
        // Between a degree and the smallest angle that keeps the sector's number in range.
        let own_rad = (spacing_m / middle_m).clamp(1e-6, PI / 180.0);
        let width_rad = held_rad.unwrap_or(own_rad);
        self.width_rad = width_rad;
        for (sector, _, i) in &mut self.order {
            let i = *i as usize;
            let azimuth = libm::atan2(s.east_m[i] - apex_m.y, s.north_m[i] - apex_m.x) + PI;
            *sector = (azimuth / width_rad) as u32;
        }
        self.order
            .sort_unstable_by(|a, b| a.0.cmp(&b.0).then(a.1.total_cmp(&b.1)).then(a.2.cmp(&b.2)));
    }
}

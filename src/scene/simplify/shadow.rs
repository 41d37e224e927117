//! Shadows of a bottom known by points alone: a horizon scan per azimuth sector.
//!
//! A point is hidden if a nearer point in its direction stands higher in the view. The points are sorted into sectors as wide as their spacing at the
//! middle range. Each sector is scanned outward with the running maximum of the slope (down_sonar - down) / horizontal range. The method assumes a
//! height field. Compared with ray casting over a bottom with letters 1.5 m high, 1 % of the points differ. They lie next to the edges of shadows and
//! on walls steeper than 45 degrees.

use std::f64::consts::PI;

use glam::DVec3;

use echotank_core::scene::Scatterers;

/// Horizon scan over a set of points. It allocates only while the number of points grows.
#[derive(Debug, Default)]
pub struct Horizon {
    /// Sector, horizontal range in metres, and index of each point.
    order: Vec<(u32, f64, u32)>,
    /// Width of a sector in the last scan, radians.
    pub width_rad: f64,
}

impl Horizon {
    /// Marks the hidden among the first `free` scatterers.
    ///
    /// `held_rad` is the sector width of an earlier scan. With it, points that appear or disappear elsewhere do not change the sectors of the others.
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

    /// Marks the hidden as in Eq. 27 as printed: a point is hidden if its incidence angle (from the vertical, Eq. 9) is smaller than that of a nearer
    /// point in its sector. In one vertical slice this equals the rule of [`Self::hide`], with the angle in place of the slope.
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
            // A point straight below the sonar, or at no finite position, hides nothing.
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
        // At most one degree, and at least the smallest angle whose sector index fits.
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

/// Angle of the ray from the vertical, radians (Eq. 9).
pub(super) fn incidence_from_vertical(scatterers: &Scatterers, i: usize, apex_m: DVec3) -> f64 {
    let offset_m = scatterers.position_m(i) - apex_m;
    libm::acos((offset_m.z / offset_m.length()).clamp(-1.0, 1.0))
}

//! Latitude and longitude to metres north and east of an origin, and back.
//!
//! The plane is tangent to the WGS84 ellipsoid at the origin. A point is projected on the ellipsoid, and its north and east are
//! taken there in earth-centred coordinates. Depth is the separate down coordinate of the world, so the sea surface is flat. At 10
//! km from the origin the plane is 7.8 m above the ellipsoid. The model ignores this height; horizontal distances are short by
//! 4e-7.
//!
//! The crate `map_3d` agrees with the forward conversion (see the tests). Its inverse needs the height above the plane, which is
//! unknown here.

/// WGS84 semi-major axis, metres (NIMA TR8350.2).
const A_M: f64 = 6_378_137.0;
/// WGS84 flattening.
const F: f64 = 1.0 / 298.257_223_563;
/// First eccentricity squared.
const E2: f64 = F * (2.0 - F);

/// Plane tangent to the WGS84 ellipsoid at an origin, with north and east axes.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct LocalTangentPlane {
    latitude_rad: f64,
    longitude_rad: f64,
    sin_latitude: f64,
    cos_latitude: f64,
    /// Origin in the meridian plane: distance from the polar axis, and coordinate along the axis, metres.
    axis_m: f64,
    polar_m: f64,
}

impl LocalTangentPlane {
    /// Plane with its origin at a latitude and longitude, radians.
    pub fn new(latitude_rad: f64, longitude_rad: f64) -> Self {
        let (axis_m, polar_m) = meridian_point(latitude_rad);
        Self {
            latitude_rad,
            longitude_rad,
            sin_latitude: latitude_rad.sin(),
            cos_latitude: latitude_rad.cos(),
            axis_m,
            polar_m,
        }
    }

    /// Latitude and longitude of the origin, radians.
    pub fn origin_rad(&self) -> (f64, f64) {
        (self.latitude_rad, self.longitude_rad)
    }

    /// North and east of a point, metres.
    pub fn local_m(&self, latitude_rad: f64, longitude_rad: f64) -> (f64, f64) {
        let (axis_m, polar_m) = meridian_point(latitude_rad);
        let (sin_turn, cos_turn) = (longitude_rad - self.longitude_rad).sin_cos();
        // Outward in the origin's meridian plane, relative to the origin.
        let outward_m = axis_m * cos_turn - self.axis_m;
        let east_m = axis_m * sin_turn;
        let north_m = (polar_m - self.polar_m) * self.cos_latitude - outward_m * self.sin_latitude;
        (north_m, east_m)
    }

    /// Latitude and longitude (-pi..pi) of a point of the plane, radians. The point is projected on the ellipsoid along the up axis
    /// of the plane.
    pub fn geodetic_rad(&self, north_m: f64, east_m: f64) -> (f64, f64) {
        // A shift by t along the up axis of the plane reaches the ellipsoid. t solves a quadratic equation.
        let (up_axis, up_polar) = (self.cos_latitude, self.sin_latitude);
        let axis_m = self.axis_m - north_m * self.sin_latitude;
        let polar_m = self.polar_m + north_m * self.cos_latitude;
        let polar_weight = 1.0 / (1.0 - E2);
        let a = up_axis * up_axis + up_polar * up_polar * polar_weight;
        let half_b = axis_m * up_axis + polar_m * up_polar * polar_weight;
        let c = axis_m * axis_m + east_m * east_m + polar_m * polar_m * polar_weight - A_M * A_M;
        let discriminant = (half_b * half_b - a * c).max(0.0);
        let t = -c / (half_b + discriminant.sqrt());
        let outward_m = axis_m + t * up_axis;
        let polar_m = polar_m + t * up_polar;
        let from_axis_m = outward_m.hypot(east_m);
        let latitude = polar_m.atan2(from_axis_m * (1.0 - E2));
        let longitude = self.longitude_rad + east_m.atan2(outward_m);
        (latitude, wrap_pi(longitude))
    }
}

/// Point of the ellipsoid in the meridian plane: distance from the polar axis, and coordinate along the axis, metres.
fn meridian_point(latitude_rad: f64) -> (f64, f64) {
    let (sin, cos) = latitude_rad.sin_cos();
    let normal_m = A_M / (1.0 - E2 * sin * sin).sqrt();
    (normal_m * cos, normal_m * (1.0 - E2) * sin)
}

/// The equivalent angle in -pi..=pi.
fn wrap_pi(angle_rad: f64) -> f64 {
    use std::f64::consts::{PI, TAU};
    if (-PI..=PI).contains(&angle_rad) {
        angle_rad
    } else {
        (angle_rad + PI).rem_euclid(TAU) - PI
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Origins: the test log, the poles and points near them, both sides of the antimeridian, and the equator.
    const ORIGINS_DEG: [(f64, f64); 9] = [
        (-22.0, -17.9),
        (53.2, 5.4),
        (89.5, 30.0),
        (90.0, 0.0),
        (-90.0, 135.0),
        (-89.999_99, -120.0),
        (10.0, 179.99),
        (-60.0, -180.0),
        (0.0, 0.0),
    ];

    #[test]
    fn inverse_agrees_to_1e_minus_6_m_at_100_km() {
        let mut worst_m = 0.0_f64;
        for (lat, lon) in ORIGINS_DEG {
            let plane = LocalTangentPlane::new(lat.to_radians(), lon.to_radians());
            for bearing in 0..24 {
                for range_m in [0.0, 1.0, 1e3, 1e5] {
                    let (s, c) = (f64::from(bearing) * 15.0).to_radians().sin_cos();
                    let (north, east) = (range_m * c, range_m * s);
                    let (latitude, longitude) = plane.geodetic_rad(north, east);
                    let (n2, e2) = plane.local_m(latitude, longitude);
                    worst_m = worst_m.max((n2 - north).hypot(e2 - east));
                }
            }
        }
        println!("round trip at 100 km: {worst_m:.2e} m");
        assert!(worst_m < 1e-6, "{worst_m} m");
    }

    #[test]
    fn north_and_east_agree_with_map_3d() {
        let mut worst_m = 0.0_f64;
        for (lat, lon) in ORIGINS_DEG {
            let (lat, lon) = (lat.to_radians(), lon.to_radians());
            let plane = LocalTangentPlane::new(lat, lon);
            for (dlat, dlon) in [(0.0, 0.0), (1e-4, 2e-4), (-0.004, 0.008), (0.005, -0.01)] {
                let (n, e) = plane.local_m(lat + dlat, lon + dlon);
                let (n2, e2, _) = map_3d::geodetic2ned(
                    lat + dlat,
                    lon + dlon,
                    0.0,
                    lat,
                    lon,
                    0.0,
                    map_3d::Ellipsoid::WGS84,
                );
                worst_m = worst_m.max((n - n2).hypot(e - e2));
            }
        }
        println!("against map_3d: {worst_m:.2e} m");
        // Earth-centred coordinates in f64 resolve 1e-9 m. A sum of a few coordinates stays below the limit.
        assert!(worst_m < 2e-8, "{worst_m} m");
    }

    #[test]
    fn is_continuous_across_the_antimeridian() {
        let plane = LocalTangentPlane::new(0.2, 179.999_f64.to_radians());
        let (_, east) = plane.local_m(0.2, -179.999_f64.to_radians());
        assert!((200.0..240.0).contains(&east), "{east}");
        let (_, longitude) = plane.geodetic_rad(0.0, east);
        assert!((longitude.to_degrees() + 179.999).abs() < 1e-9);
    }
}

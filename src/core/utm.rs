//! WGS84 latitude and longitude to universal transverse Mercator (UTM) coordinates and back.
//!
//! Krueger's series to the fourth order in the third flattening is accurate to a micrometre within 2000 km of the central
//! meridian. Source: Karney, C. F. F. (2011), "Transverse Mercator with an accuracy of a few nanometers", J. Geodesy 85, 475-485,
//! equations 7 to 20 and 35, 36.
//!
//! This module replaces three crates. `utm` uses a series in the longitude difference, which is accurate only near its zone.
//! `geographiclib-rs` has no transverse Mercator projection. `proj4rs` and `geodesy` are general projection engines configured by
//! strings.

const A_M: f64 = 6_378_137.0;
const F: f64 = 1.0 / 298.257_223_563;
/// Third flattening.
const N: f64 = F / (2.0 - F);
/// Radius of the sphere whose meridian has the length of the ellipsoid's, metres.
const RECTIFYING_M: f64 = A_M / (1.0 + N) * (1.0 + N * N / 4.0 + N * N * N * N / 64.0);
const K0: f64 = 0.9996;
const FALSE_EASTING_M: f64 = 500_000.0;
const FALSE_NORTHING_SOUTH_M: f64 = 10_000_000.0;

const ALPHA: [f64; 4] = [
    N / 2.0 - 2.0 / 3.0 * N * N + 5.0 / 16.0 * N * N * N + 41.0 / 180.0 * N * N * N * N,
    13.0 / 48.0 * N * N - 3.0 / 5.0 * N * N * N + 557.0 / 1440.0 * N * N * N * N,
    61.0 / 240.0 * N * N * N - 103.0 / 140.0 * N * N * N * N,
    49_561.0 / 161_280.0 * N * N * N * N,
];
const BETA: [f64; 4] = [
    N / 2.0 - 2.0 / 3.0 * N * N + 37.0 / 96.0 * N * N * N - 1.0 / 360.0 * N * N * N * N,
    1.0 / 48.0 * N * N + 1.0 / 15.0 * N * N * N - 437.0 / 1440.0 * N * N * N * N,
    17.0 / 480.0 * N * N * N - 37.0 / 840.0 * N * N * N * N,
    4397.0 / 161_280.0 * N * N * N * N,
];

/// Maximum number of Newton steps for the latitude. Two steps reach machine precision (Karney 2011, section 2).
const LATITUDE_STEPS: usize = 4;

fn eccentricity() -> f64 {
    (F * (2.0 - F)).sqrt()
}

fn central_meridian_rad(zone: u8) -> f64 {
    (f64::from(zone) * 6.0 - 183.0).to_radians()
}

fn false_northing_m(north: bool) -> f64 {
    if north { 0.0 } else { FALSE_NORTHING_SOUTH_M }
}

/// Tangent of the conformal latitude from the tangent of the latitude (Karney 2011, equations 7 to 9).
fn conformal_tangent(tangent: f64) -> f64 {
    let e = eccentricity();
    let sigma = (e * (e * tangent / tangent.hypot(1.0)).atanh()).sinh();
    tangent * sigma.hypot(1.0) - sigma * tangent.hypot(1.0)
}

/// UTM zone and hemisphere.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct UtmZone {
    /// Zone number, 1 to 60.
    pub zone: u8,
    /// Northern hemisphere: false northing zero.
    pub north: bool,
}

impl UtmZone {
    /// Zone of a position (radians) by its longitude, without the exceptions of Norway and Svalbard.
    pub fn of(latitude_rad: f64, longitude_rad: f64) -> Self {
        let zone = ((longitude_rad.to_degrees() + 180.0) / 6.0).floor() as i64;
        Self {
            zone: (zone.rem_euclid(60) + 1) as u8,
            north: latitude_rad >= 0.0,
        }
    }

    /// EPSG code of the projected WGS84 system.
    pub fn epsg(self) -> u16 {
        let first = if self.north { 32_600 } else { 32_700 };
        first + u16::from(self.zone)
    }

    /// Easting and northing, metres, of a position in radians.
    pub fn project_m(self, latitude_rad: f64, longitude_rad: f64) -> (f64, f64) {
        let (sin, cos) = (longitude_rad - central_meridian_rad(self.zone)).sin_cos();
        let tangent = conformal_tangent(latitude_rad.tan());
        let xi = tangent.atan2(cos);
        let eta = (sin / tangent.hypot(cos)).asinh();
        let (mut x, mut y) = (eta, xi);
        for (k, alpha) in ALPHA.iter().enumerate() {
            let twice = 2.0 * (k + 1) as f64;
            y += alpha * (twice * xi).sin() * (twice * eta).cosh();
            x += alpha * (twice * xi).cos() * (twice * eta).sinh();
        }
        (
            FALSE_EASTING_M + K0 * RECTIFYING_M * x,
            false_northing_m(self.north) + K0 * RECTIFYING_M * y,
        )
    }
}

/// Latitude and longitude, radians, of an easting and northing in metres.
pub fn geodetic_rad(zone: u8, north: bool, easting_m: f64, northing_m: f64) -> (f64, f64) {
    let y = (northing_m - false_northing_m(north)) / (K0 * RECTIFYING_M);
    let x = (easting_m - FALSE_EASTING_M) / (K0 * RECTIFYING_M);
    let (mut xi, mut eta) = (y, x);
    for (k, beta) in BETA.iter().enumerate() {
        let twice = 2.0 * (k + 1) as f64;
        xi -= beta * (twice * y).sin() * (twice * x).cosh();
        eta -= beta * (twice * y).cos() * (twice * x).sinh();
    }
    let wanted = xi.sin() / eta.sinh().hypot(xi.cos());
    let e2 = F * (2.0 - F);
    let mut tangent = wanted / (1.0 - e2);
    for _ in 0..LATITUDE_STEPS {
        let got = conformal_tangent(tangent);
        let slope = (1.0 - e2) * got.hypot(1.0) * tangent.hypot(1.0)
            / (1.0 + (1.0 - e2) * tangent * tangent);
        tangent += (wanted - got) / slope;
    }
    let longitude = central_meridian_rad(zone) + eta.sinh().atan2(xi.cos());
    (tangent.atan(), longitude)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn projected_m(zone: u8, north: bool, latitude_rad: f64, longitude_rad: f64) -> (f64, f64) {
        UtmZone { zone, north }.project_m(latitude_rad, longitude_rad)
    }

    #[test]
    fn positions_are_in_their_zone() {
        let zone = |lat: f64, lon: f64| UtmZone::of(lat.to_radians(), lon.to_radians()).epsg();
        assert_eq!(zone(51.4779, 0.0), 32_631);
        assert_eq!(zone(-22.0, -17.9), 32_728);
        assert_eq!(zone(10.0, 180.0), 32_601);
    }

    /// Positions on the central meridian and at and beyond the edges of a zone, at all latitudes.
    fn places() -> impl Iterator<Item = (f64, f64)> {
        (-8..=8).flat_map(|i| {
            (-3..=3).map(move |j| {
                let (lat, lon) = (f64::from(i) * 10.0, -171.0 + f64::from(j) * 1.7);
                (lat.to_radians(), lon.to_radians())
            })
        })
    }

    #[test]
    fn round_trip_is_accurate_to_a_micrometre() {
        let mut worst_m = 0.0_f64;
        for (lat, lon) in places() {
            let (e, n) = projected_m(2, lat >= 0.0, lat, lon);
            let (lat2, lon2) = geodetic_rad(2, lat >= 0.0, e, n);
            let off = A_M * (lat2 - lat).hypot((lon2 - lon) * lat.cos());
            worst_m = worst_m.max(off);
        }
        println!("round trip {worst_m:.2e} m");
        assert!(worst_m < 1e-6, "{worst_m} m");
    }

    /// The only conformal projection with a central meridian of constant scale K0 is transverse Mercator. The test verifies both
    /// properties without the series, by an integral of the meridian curvature and by differences.
    #[test]
    fn central_meridian_has_scale_k0_and_the_projection_is_conformal() {
        let e2 = F * (2.0 - F);
        let curvature_m = |lat: f64| A_M * (1.0 - e2) / (1.0 - e2 * lat.sin().powi(2)).powf(1.5);
        let top = 65.3_f64.to_radians();
        // Simpson's rule; its error at 2000 steps is below 1e-9 m.
        let steps = 2000;
        let h = top / f64::from(steps);
        let sum: f64 = (0..=steps)
            .map(|k| {
                let weight = match k {
                    0 => 1.0,
                    k if k == steps => 1.0,
                    k if k % 2 == 1 => 4.0,
                    _ => 2.0,
                };
                weight * curvature_m(f64::from(k) * h)
            })
            .sum();
        let arc_m = sum * h / 3.0;
        let (e, n) = projected_m(2, true, top, (-171.0_f64).to_radians());
        assert!(
            (n - K0 * arc_m).abs() < 1e-6 && (e - 500_000.0).abs() < 1e-6,
            "{e} {n} {arc_m}"
        );

        let step = 1e-5;
        for (lat, lon) in places() {
            let at = |lat: f64, lon: f64| projected_m(2, true, lat, lon);
            let (north, south) = (at(lat + step, lon), at(lat - step, lon));
            let (east, west) = (at(lat, lon + step), at(lat, lon - step));
            let meridian_m = curvature_m(lat);
            let parallel_m = A_M * lat.cos() / (1.0 - e2 * lat.sin().powi(2)).sqrt();
            let u = (
                (north.0 - south.0) / meridian_m,
                (north.1 - south.1) / meridian_m,
            );
            let v = (
                (east.0 - west.0) / parallel_m,
                (east.1 - west.1) / parallel_m,
            );
            // Conformal: the eastward image is the northward image rotated by a quarter turn.
            let off = (v.0 - u.1).hypot(v.1 + u.0) / u.0.hypot(u.1);
            assert!(off < 1e-8, "{lat} {lon}: {off:.1e}");
        }
    }
}

//! Latitude and longitude to universal transverse Mercator on WGS84, by Krueger's series to the fourth order in the third flattening: better than
//! a micrometre in and near a zone. Source: Karney 2011, "Transverse Mercator with an accuracy of a few nanometers", J. Geodesy 85,
//! equations 7 to 10 and 35.

const A_M: f64 = 6_378_137.0;
const F: f64 = 1.0 / 298.257_223_563;
/// Third flattening.
const N: f64 = F / (2.0 - F);
/// Radius of the sphere with the ellipsoid's meridian.
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

/// One zone, on one side of the equator.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct UtmZone {
    pub zone: u8,
    pub north: bool,
}

impl UtmZone {
    /// That a place lies in by its longitude; Norway's and Svalbard's exceptions are not made.
    pub fn of(latitude_rad: f64, longitude_rad: f64) -> Self {
        let zone = ((longitude_rad.to_degrees() + 180.0) / 6.0).floor() as i64;
        Self {
            zone: (zone.rem_euclid(60) + 1) as u8,
            north: latitude_rad >= 0.0,
        }
    }

    /// EPSG's number.
    pub fn epsg(self) -> u16 {
        let first = if self.north { 32_600 } else { 32_700 };
        first + u16::from(self.zone)
    }

    /// Easting and northing, metres.
    pub fn project_m(self, latitude_rad: f64, longitude_rad: f64) -> (f64, f64) {
        let central_rad = (f64::from(self.zone) * 6.0 - 183.0).to_radians();
        let (sin, cos) = (longitude_rad - central_rad).sin_cos();
        let e = (F * (2.0 - F)).sqrt();
        let tangent = latitude_rad.tan();
        let sigma = (e * (e * tangent / tangent.hypot(1.0)).atanh()).sinh();
        let conformal = tangent * sigma.hypot(1.0) - sigma * tangent.hypot(1.0);
        let xi = conformal.atan2(cos);
        let eta = (sin / conformal.hypot(cos)).asinh();
        let (mut x, mut y) = (eta, xi);
        for (k, alpha) in ALPHA.iter().enumerate() {
            let twice = 2.0 * (k + 1) as f64;
            y += alpha * (twice * xi).sin() * (twice * eta).cosh();
            x += alpha * (twice * xi).cos() * (twice * eta).sinh();
        }
        let false_northing_m = if self.north {
            0.0
        } else {
            FALSE_NORTHING_SOUTH_M
        };
        (
            FALSE_EASTING_M + K0 * RECTIFYING_M * x,
            false_northing_m + K0 * RECTIFYING_M * y,
        )
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_central_meridian_is_true_to_scale() {
        let greenwich = UtmZone::of(51.4779_f64.to_radians(), 0.0);
        assert_eq!((greenwich.zone, greenwich.epsg()), (31, 32_631));
        // On the central meridian the easting is exact and the northing K0 times the meridian's arc, by Simpson's rule.
        let (zone, latitude) = (
            UtmZone {
                zone: 31,
                north: true,
            },
            0.9_f64,
        );
        let (e, n) = zone.project_m(latitude, 3f64.to_radians());
        let e2 = F * (2.0 - F);
        let curvature = |lat: f64| A_M * (1.0 - e2) / (1.0 - e2 * lat.sin().powi(2)).powf(1.5);
        let steps = 2000;
        let h = latitude / f64::from(steps);
        let arc: f64 = (0..=steps)
            .map(|i| {
                let weight = match i {
                    0 => 1.0,
                    i if i == steps => 1.0,
                    i if i % 2 == 1 => 4.0,
                    _ => 2.0,
                };
                weight * curvature(f64::from(i) * h)
            })
            .sum::<f64>()
            * h
            / 3.0;
        assert!((e - FALSE_EASTING_M).abs() < 1e-6);
        assert!((n - K0 * arc).abs() < 1e-5, "{n} want {}", K0 * arc);
    }
}

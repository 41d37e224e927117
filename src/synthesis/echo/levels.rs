//! The sonar equation (Meng et al. 2023, Eqs. 11-14) as linear amplitudes, one factor per leg.
//!
//! A = 10^((SL + offset)/20) tx_pattern g(r_T) strength law g(r_R) element_pattern
//! 10^(sensitivity/20), with g(r) = 10^(-alpha r/20) / r. The two one-way losses are separate
//! factors, and r is at least one wavelength. All factors are evaluated at the leading edge.

use echotank_core::arrays::Pattern;

use super::elementary::{exp_decay, sinc};

/// Converts dB to a linear amplitude.
pub fn amplitude_from_db(db: f64) -> f64 {
    10f64.powf(db / 20.0)
}

/// A [`Pattern`] prepared for one wavelength.
#[derive(Clone, Copy, Debug)]
pub struct Directivity {
    /// Length of the sides in wavelengths; 0 is omnidirectional along that axis.
    length: f64,
    width: f64,
    /// Minimum u_z that the baffle passes.
    baffle_z: f64,
}

impl Directivity {
    /// Prepares `pattern` for a wavelength in metres.
    pub fn new(pattern: &Pattern, wavelength_m: f64) -> Self {
        match *pattern {
            Pattern::Omnidirectional => Self {
                length: 0.0,
                width: 0.0,
                baffle_z: f64::NEG_INFINITY,
            },
            Pattern::Rectangle {
                length_m,
                width_m,
                baffled,
            }
            | Pattern::Part {
                length_m,
                width_m,
                baffled,
                ..
            } => Self {
                length: length_m / wavelength_m,
                width: width_m / wavelength_m,
                baffle_z: if baffled { 0.0 } else { f64::NEG_INFINITY },
            },
        }
    }

    /// Length and width of the face, wavelengths, and whether it has a baffle; an omnidirectional face is (0, 0, false).
    pub fn face(&self) -> (f64, f64, bool) {
        (self.length, self.width, self.baffle_z == 0.0)
    }

    /// Whether the response is 1 in every direction.
    pub fn is_omnidirectional(&self) -> bool {
        self.length == 0.0 && self.width == 0.0 && self.baffle_z == f64::NEG_INFINITY
    }

    /// Response towards the unit vector (x, y, z) in array axes: 1 on the boresight. Side lobes have a sign.
    #[inline(always)]
    pub fn towards(&self, x: f64, y: f64, z: f64) -> f64 {
        let open = if z < self.baffle_z { 0.0 } else { 1.0 };
        open * sinc(self.length * x) * sinc(self.width * y)
    }
}

/// One-way transmission loss: spherical spreading from 1 m and absorption.
#[derive(Clone, Copy, Debug)]
pub struct OneWay {
    /// Minimum range at which the far-field amplitude is valid, metres. The amplitude is constant at shorter ranges.
    pub wavelength_m: f64,
    /// 1 / `wavelength_m`.
    max_per_m: f64,
    nepers_per_m: f64,
}

impl OneWay {
    /// Loss at a wavelength in metres and a one-way absorption in dB/m.
    pub fn new(wavelength_m: f64, absorption_db_per_m: f64) -> Self {
        Self {
            wavelength_m,
            max_per_m: 1.0 / wavelength_m,
            nepers_per_m: absorption_db_per_m * std::f64::consts::LN_10 / 20.0,
        }
    }

    /// Pressure at `range_m` relative to pressure at 1 m.
    #[inline(always)]
    pub fn amplitude(&self, range_m: f64) -> f64 {
        self.amplitude_at(range_m, 1.0 / range_m)
    }

    /// As [`Self::amplitude`], with `per_m` = 1 / `range_m` given, which avoids a division.
    #[inline(always)]
    pub(crate) fn amplitude_at(&self, range_m: f64, per_m: f64) -> f64 {
        exp_decay(-self.nepers_per_m * range_m.max(self.wavelength_m)) * per_m.min(self.max_per_m)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const WAVELENGTH_M: f64 = 0.00375;

    fn line(length_m: f64) -> Directivity {
        Directivity::new(
            &Pattern::Rectangle {
                length_m,
                width_m: 0.0,
                baffled: false,
            },
            WAVELENGTH_M,
        )
    }

    /// Response of a line at `angle_rad` off its broadside.
    fn level(d: &Directivity, angle_rad: f64) -> f64 {
        d.towards(angle_rad.sin(), 0.0, angle_rad.cos())
    }

    /// Meng et al. 2023, Eq. 1: the -3 dB width of a line of length L is 0.886 lambda / L.
    #[test]
    fn the_3_db_width_is_equation_1_within_1_percent() {
        for length_m in [0.03, 0.1, 0.5, 2.0] {
            let d = line(length_m);
            let (mut low, mut high) = (0.0, WAVELENGTH_M / length_m);
            for _ in 0..60 {
                let middle = 0.5 * (low + high);
                if level(&d, middle).powi(2) > 0.5 {
                    low = middle;
                } else {
                    high = middle;
                }
            }
            let (got, want) = (2.0 * low, 0.886 * WAVELENGTH_M / length_m);
            assert!(
                (got / want - 1.0).abs() < 0.01,
                "L = {length_m} m: {got} rad, Eq. 1 {want} rad"
            );
        }
    }

    #[test]
    fn the_first_side_lobe_of_a_continuous_line_is_minus_13_26_db_and_negative() {
        let d = line(1.0);
        let peak = (0..10_000)
            .map(|i| {
                let u = WAVELENGTH_M * (1.0 + i as f64 / 10_000.0);
                d.towards(u, 0.0, 1.0)
            })
            .min_by(f64::total_cmp)
            .expect("not empty");
        let db = 20.0 * peak.abs().log10();
        assert!(peak < 0.0 && (db + 13.26).abs() < 0.01, "{peak}, {db} dB");
    }

    #[test]
    fn a_baffle_blocks_everything_behind_and_nothing_in_front() {
        let pattern = Pattern::Rectangle {
            length_m: 0.0,
            width_m: 0.0,
            baffled: true,
        };
        let d = Directivity::new(&pattern, WAVELENGTH_M);
        assert_eq!(d.towards(0.0, 0.8, -0.6), 0.0);
        assert_eq!(d.towards(0.0, 0.8, 0.6), 1.0);
        assert_eq!(d.towards(1.0, 0.0, 0.0), 1.0);
        let open = Directivity::new(&Pattern::Omnidirectional, WAVELENGTH_M);
        assert_eq!(open.towards(0.0, 0.8, -0.6), 1.0);
    }

    #[test]
    fn a_leg_loses_20_log_r_plus_alpha_r_and_stops_growing_within_a_wavelength() {
        let leg = OneWay::new(WAVELENGTH_M, 0.096);
        for range_m in [0.01, 1.0, 30.0, 150.0] {
            let got = 20.0 * leg.amplitude(range_m).log10();
            let want = -20.0 * f64::log10(range_m) - 0.096 * range_m;
            assert!((got - want).abs() < 1e-12, "{range_m} m: {got}, {want} dB");
        }
        assert_eq!(leg.amplitude(0.0), leg.amplitude(WAVELENGTH_M));
    }
}

//! One-way absorption of sound in water.
//!
//! Absorption is the sum of three parts: the relaxation of boric acid, the relaxation of magnesium
//! sulphate, and the viscosity of pure water. The formulas are those of Francois and Garrison
//! (1982) and of Ainslie and McColm (1998).

use echotank_config::spec::{AbsorptionSpec, Water};

/// Absorption at one frequency, dB per metre, one way.
///
/// Both sea-water formulas are valid from about 100 Hz to 1 MHz and agree within 10 % there.
/// Salinity 0 gives the absorption of fresh water.
pub fn absorption_db_per_m(spec: &AbsorptionSpec, frequency_hz: f64) -> f64 {
    let frequency_khz = frequency_hz / 1e3;
    let db_per_km = match spec {
        AbsorptionSpec::None => 0.0,
        AbsorptionSpec::Fixed { db_per_m } => return *db_per_m,
        AbsorptionSpec::FrancoisGarrison(water) => francois_garrison(water, frequency_khz),
        AbsorptionSpec::AinslieMcColm(water) => ainslie_mccolm(water, frequency_khz),
    };
    db_per_km / 1e3
}

/// Frequency dependence of one chemical relaxation, f_r f^2 / (f_r^2 + f^2), kHz. Zero for a zero
/// relaxation frequency.
fn relaxation(relaxation_khz: f64, frequency_khz: f64) -> f64 {
    if relaxation_khz <= 0.0 {
        return 0.0;
    }
    let f2 = frequency_khz * frequency_khz;
    relaxation_khz * f2 / (relaxation_khz * relaxation_khz + f2)
}

/// Francois and Garrison (1982), J. Acoust. Soc. Am. 72(6), 1879-1890: boric acid, magnesium
/// sulphate, pure water. dB/km.
fn francois_garrison(water: &Water, frequency_khz: f64) -> f64 {
    let Water {
        temperature_c: t,
        salinity: s,
        depth_m: d,
        ph,
    } = *water;
    let kelvin = 273.0 + t;
    // The sound speed is that of the formula, which its coefficients were fitted with, not that of
    // the medium.
    let c = 1412.0 + 3.21 * t + 1.19 * s + 0.0167 * d;

    let boric_a = 8.86 / c * 10f64.powf(0.78 * ph - 5.0);
    let boric_khz = 2.8 * (s / 35.0).sqrt() * 10f64.powf(4.0 - 1245.0 / kelvin);

    let sulphate_a = 21.44 * s / c * (1.0 + 0.025 * t);
    let sulphate_p = 1.0 - 1.37e-4 * d + 6.2e-9 * d * d;
    let sulphate_khz = 8.17 * 10f64.powf(8.0 - 1990.0 / kelvin) / (1.0 + 0.0018 * (s - 35.0));

    let water_a = if t <= 20.0 {
        4.937e-4 - 2.59e-5 * t + 9.11e-7 * t * t - 1.50e-8 * t * t * t
    } else {
        3.964e-4 - 1.146e-5 * t + 1.45e-7 * t * t - 6.5e-10 * t * t * t
    };
    let water_p = 1.0 - 3.83e-5 * d + 4.9e-10 * d * d;

    boric_a * relaxation(boric_khz, frequency_khz)
        + sulphate_a * sulphate_p * relaxation(sulphate_khz, frequency_khz)
        + water_a * water_p * frequency_khz * frequency_khz
}

/// Ainslie and McColm (1998), J. Acoust. Soc. Am. 103(3), 1671-1672. dB/km.
fn ainslie_mccolm(water: &Water, frequency_khz: f64) -> f64 {
    let Water {
        temperature_c: t,
        salinity: s,
        depth_m,
        ph,
    } = *water;
    let z_km = depth_m / 1e3;
    let boric_khz = 0.78 * (s / 35.0).sqrt() * (t / 26.0).exp();
    let sulphate_khz = 42.0 * (t / 17.0).exp();
    0.106 * relaxation(boric_khz, frequency_khz) * ((ph - 8.0) / 0.56).exp()
        + 0.52
            * (1.0 + t / 43.0)
            * (s / 35.0)
            * relaxation(sulphate_khz, frequency_khz)
            * (-z_km / 6.0).exp()
        + 0.00049 * frequency_khz * frequency_khz * (-(t / 27.0 + z_km / 17.0)).exp()
}

#[cfg(test)]
mod tests {
    use super::*;

    const SEA: Water = Water {
        temperature_c: 10.0,
        salinity: 35.0,
        depth_m: 0.0,
        ph: 8.0,
    };

    fn db_per_km(spec: AbsorptionSpec, frequency_hz: f64) -> f64 {
        absorption_db_per_m(&spec, frequency_hz) * 1e3
    }

    #[test]
    fn sea_water_at_400_khz_and_10_c_absorbs_96_0_db_per_km_and_fresh_water_49_7() {
        let fresh = Water {
            salinity: 0.0,
            ..SEA
        };
        // The formula gives 96.0 at about 10 m depth, and 0.1 more at the surface.
        for (water, want, tolerance) in [(SEA, 96.0, 0.15), (fresh, 49.7, 0.05)] {
            let got = db_per_km(AbsorptionSpec::FrancoisGarrison(water), 400e3);
            assert!(
                (got - want).abs() < tolerance,
                "got {got}, want {want} +- {tolerance} dB/km"
            );
        }
    }

    /// Ainslie and McColm state agreement within 10 % for 100 Hz to 1 MHz, -6..35 C, salinity
    /// 5..50, pH 7.7..8.3 and 0..7 km. Their statement is for co-varying (oceanic) values. This
    /// test uses pH 8, salinity 35 and the upper kilometre.
    #[test]
    fn the_two_formulas_agree_within_their_stated_10_percent() {
        let mut worst: f64 = 0.0;
        for frequency_hz in [1e3, 10e3, 30e3, 100e3, 200e3, 400e3, 1e6] {
            for temperature_c in [0.0, 4.0, 10.0, 15.0, 20.0, 30.0] {
                for depth_m in [0.0, 100.0, 1000.0] {
                    let water = Water {
                        temperature_c,
                        depth_m,
                        ..SEA
                    };
                    let fg = db_per_km(AbsorptionSpec::FrancoisGarrison(water), frequency_hz);
                    let am = db_per_km(AbsorptionSpec::AinslieMcColm(water), frequency_hz);
                    let error = (am / fg - 1.0).abs();
                    worst = worst.max(error);
                    assert!(
                        error < 0.10,
                        "{frequency_hz} Hz, {temperature_c} C, {depth_m} m: F-G {fg}, A-M {am} dB/km, {error:.3} apart"
                    );
                }
            }
        }
        assert!(
            worst > 1e-3,
            "two independent fits cannot agree to {worst}: one calls the other"
        );
    }

    #[test]
    fn fixed_and_none_do_not_depend_on_frequency() {
        assert_eq!(
            absorption_db_per_m(&AbsorptionSpec::Fixed { db_per_m: 0.05 }, 1e6),
            0.05
        );
        assert_eq!(absorption_db_per_m(&AbsorptionSpec::None, 1e6), 0.0);
        let fresh = Water {
            salinity: 0.0,
            ..SEA
        };
        for spec in [
            AbsorptionSpec::FrancoisGarrison(fresh),
            AbsorptionSpec::AinslieMcColm(fresh),
        ] {
            assert_eq!(absorption_db_per_m(&spec, 0.0), 0.0);
        }
    }
}

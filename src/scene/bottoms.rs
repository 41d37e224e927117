//! Bottoms: how much a square metre of seabed scatters back, over the angle of incidence.
//!
//! | `bottom` | backscattering strength at incidence i | two directions |
//! |---|---|---|
//! | `bistatic-lambert` | mu cos^2 i | mu cos i cos s |
//! | `lambert` | mu cos^2 i (Meng et al. 2023, Eq. 13) | mu cos^2 i, whatever the direction of the receiver |
//! | `three-term` | A exp(-i^2 / 2 B^2) + C cos^D i + E exp(-i^2 / 2 F^2) | the geometric mean of the two directions' values |
//! | a preset | `three-term` with the values below | the same |
//!
//! The three terms: facets that mirror, the Lambert-like rest, and the slope between them (G. Lamarche, X. Lurton, A.-L. Verdier, J.-M. Augustin
//! 2011, "Quantitative characterisation of seafloor substrate and bedforms using advanced processing of multibeam backscatter", Continental
//! Shelf Research 31; the form that multibeam processing fits to its angular responses). The geometric mean is reciprocal and is
//! Lambert's own cos i cos s where only the second term with D = 2 is left.
//!
//! The presets are sediments of APL-UW TR 9407 (1994), section IV, table 2 (page IV-6): clay, silt, medium sand, sandy gravel and rock, with its
//! density ratio, sound-speed ratio, loss parameter, volume parameter and spectral strength of roughness. Their second and third terms are fitted
//! to what these give at 100 kHz, the top of that handbook's range, between 10 and 60 degrees of grazing: first-order perturbation by the roughness
//! and scattering by the volume (D. R. Jackson, K. B. Briggs 1992, "High-frequency bottom backscattering: roughness versus sediment volume
//! scattering", JASA 92(2)). A test computes that anew and holds the fit to it within 1.5 dB. **The steeper part is not the handbook's**: its Kirchhoff and composite-
//! roughness forms are not computed here. A = V^2 / (8 pi tan^2 B), what facets with rms slope tan B mirror straight back in the
//! high-frequency limit, V from the impedance; **B is a round number of ours**. Measured bottoms of one name differ by 5 dB and more.
//! Not modelled: frequency dependence (over rock and gravel some 2 dB for every doubling, over mud none), ripples, penetration, gas.

use std::sync::Arc;

use crate::config::spec::{BottomSpec, Sediment, ThreeTerm};
use crate::flow::{LawCurve, ScatterLaw};

/// What is known of a sediment: the handbook's values, and the terms fitted to them.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Preset {
    /// Density and sound speed of the sediment over those of the water.
    pub density_ratio: f64,
    pub speed_ratio: f64,
    /// Loss parameter delta: imaginary over real wavenumber.
    pub loss: f64,
    /// Volume parameter sigma_2.
    pub volume: f64,
    /// Spectral strength w_2 of the roughness, cm^4; the exponent is 3.25.
    pub roughness_cm4: f64,
    /// B: rms slope of the facets, degrees.
    pub facets_deg: f64,
    /// C at normal incidence, dB, and D.
    pub lambert_db: f64,
    pub lambert_exponent: f64,
    /// E, dB, and F, degrees.
    pub intermediate_db: f64,
    pub intermediate_deg: f64,
}

/// What a sediment scatters by.
pub fn preset(sediment: Sediment) -> Preset {
    match sediment {
        // Clay, mean grain size 9 phi.
        Sediment::Mud => Preset {
            density_ratio: 1.145,
            speed_ratio: 0.9801,
            loss: 0.00148,
            volume: 0.001,
            roughness_cm4: 0.000518,
            facets_deg: 3.0,
            lambert_db: -26.4,
            lambert_exponent: 1.28,
            intermediate_db: -45.0,
            intermediate_deg: 35.0,
        },
        // Silt, 6 phi.
        Sediment::Silt => Preset {
            density_ratio: 1.149,
            speed_ratio: 0.9873,
            loss: 0.00386,
            volume: 0.001,
            roughness_cm4: 0.000518,
            facets_deg: 4.0,
            lambert_db: -26.4,
            lambert_exponent: 1.19,
            intermediate_db: -49.0,
            intermediate_deg: 38.0,
        },
        // Medium sand, 1.5 phi.
        Sediment::Sand => Preset {
            density_ratio: 1.845,
            speed_ratio: 1.1782,
            loss: 0.01624,
            volume: 0.002,
            roughness_cm4: 0.004446,
            facets_deg: 6.0,
            lambert_db: -17.3,
            lambert_exponent: 1.91,
            intermediate_db: -35.0,
            intermediate_deg: 30.0,
        },
        // Sandy gravel, -1 phi.
        Sediment::Gravel => Preset {
            density_ratio: 2.492,
            speed_ratio: 1.3370,
            loss: 0.01705,
            volume: 0.002,
            roughness_cm4: 0.012937,
            facets_deg: 10.0,
            lambert_db: -11.1,
            lambert_exponent: 1.84,
            intermediate_db: -37.0,
            intermediate_deg: 25.0,
        },
        Sediment::Rock => Preset {
            density_ratio: 2.5,
            speed_ratio: 2.5,
            loss: 0.01374,
            volume: 0.002,
            roughness_cm4: 0.01862,
            facets_deg: 18.0,
            lambert_db: -6.8,
            lambert_exponent: 2.76,
            intermediate_db: -8.0,
            intermediate_deg: 15.0,
        },
    }
}

impl Preset {
    /// Amplitude that a smooth bottom mirrors at normal incidence.
    pub fn reflection(&self) -> f64 {
        let ratio = self.density_ratio * self.speed_ratio;
        (ratio - 1.0) / (ratio + 1.0)
    }

    pub fn terms(&self) -> ThreeTerm {
        let slope = libm::tan(self.facets_deg.to_radians());
        let mirrored = self.reflection().powi(2);
        let specular = mirrored / (8.0 * std::f64::consts::PI * slope * slope);
        ThreeTerm {
            specular_db: 10.0 * libm::log10(specular),
            specular_rad: self.facets_deg.to_radians(),
            lambert_db: self.lambert_db,
            lambert_exponent: self.lambert_exponent,
            intermediate_db: self.intermediate_db,
            intermediate_rad: self.intermediate_deg.to_radians(),
        }
    }
}

fn power(db: f64) -> f64 {
    libm::pow(10.0, db / 10.0)
}

/// Backscattering strength of the three terms, a power, at an incidence of at most a right angle.
pub fn three_term(t: &ThreeTerm, incidence_rad: f64) -> f64 {
    let bell = |db: f64, width_rad: f64| {
        let x = incidence_rad / width_rad;
        power(db) * libm::exp(-0.5 * x * x)
    };
    bell(t.specular_db, t.specular_rad)
        + power(t.lambert_db) * libm::pow(libm::cos(incidence_rad).max(0.0), t.lambert_exponent)
        + bell(t.intermediate_db, t.intermediate_rad)
}

/// A bottom ready for the scatterers: what their strengths hold and what their law leaves to the angles.
#[derive(Clone, Debug)]
pub struct Bottom {
    pub law: ScatterLaw,
    /// For [`ScatterLaw::Curve`].
    pub curve: Option<Arc<LawCurve>>,
    /// Power per square metre that goes into the strengths.
    pub mu: f64,
    terms: Option<ThreeTerm>,
}

impl Bottom {
    pub fn new(spec: &BottomSpec) -> Self {
        let (law, mu, terms) = match *spec {
            BottomSpec::BistaticLambert { mu_db } => (ScatterLaw::Lambert, power(mu_db), None),
            BottomSpec::Lambert { mu_db } => (ScatterLaw::LambertOneWay, power(mu_db), None),
            BottomSpec::ThreeTerm(terms) => (ScatterLaw::Curve, 1.0, Some(terms)),
            BottomSpec::Sediment(sediment) => {
                (ScatterLaw::Curve, 1.0, Some(preset(sediment).terms()))
            }
        };
        let of_cosine = |t: ThreeTerm| LawCurve::new(|cosine| three_term(&t, libm::acos(cosine)));
        Self {
            law,
            curve: terms.map(|t| Arc::new(of_cosine(t))),
            mu,
            terms,
        }
    }

    /// Backscattering strength, a power per square metre.
    pub fn strength(&self, incidence_rad: f64) -> f64 {
        match &self.terms {
            None => self.mu * libm::cos(incidence_rad).powi(2),
            Some(terms) => three_term(terms, incidence_rad),
        }
    }
}

#[cfg(test)]
mod tests {
    use num_complex::Complex64;

    use super::*;

    /// The handbook's regressions on the mean grain size, phi, section IV, give its own table: density, sound speed, roughness and volume.
    #[test]
    fn the_presets_values_are_those_of_the_handbooks_regressions() {
        for (sediment, phi) in [
            (Sediment::Mud, 9.0_f64),
            (Sediment::Silt, 6.0),
            (Sediment::Sand, 1.5),
            (Sediment::Gravel, -1.0),
        ] {
            let p = preset(sediment);
            let (density, speed) = if phi < 1.0 {
                (
                    2.3139 - 0.17057 * phi + 0.007797 * phi * phi,
                    1.2778 - 0.056452 * phi + 0.002709 * phi * phi,
                )
            } else if phi < 5.3 {
                (
                    3.0455 - 1.1069031 * phi + 0.2290201 * phi.powi(2) - 0.0165406 * phi.powi(3),
                    1.3425 - 0.1382798 * phi + 0.0213937 * phi.powi(2) - 0.0014881 * phi.powi(3),
                )
            } else {
                (1.1565 - 0.0012973 * phi, 1.0019 - 0.0024324 * phi)
            };
            // rms relief over 100 cm in cm, and the spectral strength that goes with it.
            let relief = match phi < 5.0 {
                true => (2.03846 - 0.26923 * phi) / (1.0 + 0.076923 * phi),
                false => 0.5,
            };
            let volume = if phi < 5.5 { 0.002 } else { 0.001 };
            for (what, got, want) in [
                ("density", p.density_ratio, density),
                ("speed", p.speed_ratio, speed),
                ("roughness", p.roughness_cm4, 0.00207 * relief * relief),
                ("volume", p.volume, volume),
            ] {
                assert!(
                    (got / want - 1.0).abs() < 1e-3,
                    "{sediment:?} {what}: {got}, {want}"
                );
            }
        }
    }

    /// Backscattering strength by Jackson and Briggs 1992, a power: roughness and volume.
    fn handbook(p: &Preset, grazing_rad: f64, frequency_hz: f64) -> [f64; 2] {
        const EXPONENT: f64 = 3.25;
        let (sin, cos) = grazing_rad.sin_cos();
        let per_m = std::f64::consts::TAU * frequency_hz / 1500.0;
        let kappa = Complex64::new(1.0, p.loss) / p.speed_ratio;
        let root = (kappa * kappa - cos * cos).sqrt();
        let mirrored = (p.density_ratio * sin - root) / (p.density_ratio * sin + root);
        let through = (p.density_ratio - 1.0).powi(2) * cos * cos + p.density_ratio.powi(2);
        let factor = (through - kappa * kappa) / (p.density_ratio * sin + root).powi(2);
        // w_2 (h_0 K)^-3.25 with h_0 = 1 cm, from cm^4 to m^4.
        let spectrum = p.roughness_cm4 * 1e-8 * (0.01 * 2.0 * per_m * cos).powf(-EXPONENT);
        let roughness = 4.0 * (per_m * sin).powi(4) * factor.norm_sqr() * spectrum;
        let volume = 5.0 * p.loss * p.volume * (1.0 - mirrored * mirrored).norm_sqr() * sin * sin
            / (p.speed_ratio * std::f64::consts::LN_10 * root.norm_sqr() * root.im);
        [roughness, volume]
    }

    #[test]
    fn sediments_scatter_as_the_handbooks_parameters_do_at_100_khz_within_1p5_db() {
        let db = |power: f64| 10.0 * power.log10();
        for s in Sediment::ALL {
            let (p, mut worst_db, mut text) = (preset(s), 0.0_f64, String::new());
            let terms = p.terms();
            for grazing_deg in (10..=60).step_by(5) {
                let grazing_rad = f64::from(grazing_deg).to_radians();
                let want_db = db(handbook(&p, grazing_rad, 100e3).iter().sum());
                let got_db = db(three_term(
                    &terms,
                    std::f64::consts::FRAC_PI_2 - grazing_rad,
                ));
                worst_db = worst_db.max((got_db - want_db).abs());
                if grazing_deg % 10 == 0 {
                    text += &format!(" {grazing_deg}: {got_db:.1} ({want_db:.1})");
                }
            }
            println!("{:6}{text}; worst {worst_db:.2} dB", s.name());
            assert!(worst_db < 1.5, "{s:?}: {worst_db} dB");
        }
    }

    #[test]
    fn sediments_fall_with_the_incidence_and_rise_from_silt_to_rock() {
        let db =
            |s: Sediment, deg: f64| 10.0 * three_term(&preset(s).terms(), deg.to_radians()).log10();
        for s in Sediment::ALL {
            let curve: Vec<f64> = (0..90).map(|deg| db(s, f64::from(deg))).collect();
            assert!(curve.windows(2).all(|w| w[1] < w[0]), "{s:?}");
        }
        // Mud and silt are alike: both scatter by their volume.
        for pair in Sediment::ALL[1..].windows(2) {
            assert!(db(pair[1], 45.0) > db(pair[0], 45.0) + 2.0, "{pair:?}");
        }
    }

    #[test]
    fn three_terms_with_the_second_alone_are_lamberts_law() {
        let terms = ThreeTerm {
            specular_db: -300.0,
            specular_rad: 0.1,
            lambert_db: -27.0,
            lambert_exponent: 2.0,
            intermediate_db: -300.0,
            intermediate_rad: 0.1,
        };
        let bottom = Bottom::new(&BottomSpec::ThreeTerm(terms));
        let lambert = Bottom::new(&BottomSpec::BistaticLambert { mu_db: -27.0 });
        let curve = bottom.curve.unwrap();
        for k in 1..1000 {
            let (cos_in, cos_out) = (f64::from(k) / 1000.0, f64::from(k * 7 % 1000) / 1000.0);
            let got = curve.half(cos_in.sqrt()) * curve.half(cos_out.sqrt());
            let want = (lambert.mu * cos_in * cos_out).sqrt();
            assert!(
                (got - want).abs() < 1e-12,
                "{cos_in} {cos_out}: {got}, {want}"
            );
        }
    }

    /// The table between its nodes: within 0.01 dB of the formula for every sediment, to within 0.1 degrees of grazing.
    #[test]
    fn the_curve_in_use_is_the_formula_within_a_hundredth_of_a_decibel() {
        for sediment in Sediment::ALL {
            let bottom = Bottom::new(&BottomSpec::Sediment(sediment));
            let curve = bottom.curve.as_ref().unwrap();
            let worst = (0..89_900)
                .map(|k| {
                    let incidence_rad = (f64::from(k) / 1000.0).to_radians();
                    let half = curve.half(incidence_rad.cos().sqrt());
                    (40.0 * half.log10() - 10.0 * bottom.strength(incidence_rad).log10()).abs()
                })
                .fold(0.0, f64::max);
            println!("{sediment:?}: {worst:.4} dB");
            assert!(worst < 0.01, "{sediment:?}: {worst} dB");
        }
    }
}

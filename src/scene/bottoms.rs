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
//! The presets: A = V^2 / (8 pi tan^2 B), what facets with rms slope tan B mirror straight back in the high-frequency limit (Kirchhoff), V from
//! the mean grain size by the regressions of APL-UW TR 9407 (1994), section IV, rock from its table. B, C, E and F are round numbers within
//! what is measured from place to place, which spreads by 5 dB and more; they are no measurement of one bottom.
//! Not modelled: frequency dependence, ripples, penetration, gas.

use std::sync::Arc;

use crate::config::spec::{BottomSpec, Sediment, ThreeTerm};
use crate::flow::{LawCurve, ScatterLaw};

/// What is known of a sediment.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Preset {
    /// Density and sound speed of the sediment over those of the water.
    pub impedance: Impedance,
    /// B: rms slope of the facets, degrees.
    pub facets_deg: f64,
    /// C at normal incidence, dB; D is 2.
    pub lambert_db: f64,
    /// E over C, dB, and F, degrees.
    pub intermediate_db: f64,
    pub intermediate_deg: f64,
}

#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Impedance {
    /// Mean grain size, phi units (minus the binary logarithm of the diameter in millimetres).
    GrainSize(f64),
    /// Density ratio times sound-speed ratio.
    Ratio(f64),
}

/// What a sediment scatters by.
pub fn preset(sediment: Sediment) -> Preset {
    match sediment {
        Sediment::Mud => Preset {
            impedance: Impedance::GrainSize(9.0),
            facets_deg: 3.0,
            lambert_db: -35.0,
            intermediate_db: 3.0,
            intermediate_deg: 12.0,
        },
        Sediment::Silt => Preset {
            impedance: Impedance::GrainSize(6.0),
            facets_deg: 4.0,
            lambert_db: -31.0,
            intermediate_db: 3.0,
            intermediate_deg: 14.0,
        },
        Sediment::Sand => Preset {
            impedance: Impedance::GrainSize(1.5),
            facets_deg: 6.0,
            lambert_db: -27.0,
            intermediate_db: 4.0,
            intermediate_deg: 18.0,
        },
        Sediment::Gravel => Preset {
            impedance: Impedance::GrainSize(-1.0),
            facets_deg: 10.0,
            lambert_db: -20.0,
            intermediate_db: 3.0,
            intermediate_deg: 25.0,
        },
        Sediment::Rock => Preset {
            impedance: Impedance::Ratio(2.5 * 2.5),
            facets_deg: 18.0,
            lambert_db: -15.0,
            intermediate_db: 2.0,
            intermediate_deg: 35.0,
        },
    }
}

impl Impedance {
    /// Density ratio times sound-speed ratio.
    pub fn ratio(self) -> f64 {
        match self {
            Self::Ratio(ratio) => ratio,
            Self::GrainSize(phi) => {
                // APL-UW TR 9407 (1994), section IV: three ranges of grain size.
                let (density, speed) = if phi < 1.0 {
                    (
                        2.3139 - 0.17057 * phi + 0.007797 * phi * phi,
                        1.2778 - 0.056452 * phi + 0.002709 * phi * phi,
                    )
                } else if phi < 5.3 {
                    (
                        3.0455 - 1.1069031 * phi + 0.2290201 * phi * phi
                            - 0.0165406 * phi * phi * phi,
                        1.3425 - 0.1382798 * phi + 0.0213937 * phi * phi
                            - 0.0014881 * phi * phi * phi,
                    )
                } else {
                    (1.1565 - 0.0012973 * phi, 1.0019 - 0.0024324 * phi)
                };
                density * speed
            }
        }
    }

    /// Amplitude that a smooth bottom mirrors at normal incidence.
    pub fn reflection(self) -> f64 {
        let ratio = self.ratio();
        (ratio - 1.0) / (ratio + 1.0)
    }
}

impl Preset {
    pub fn terms(&self) -> ThreeTerm {
        let slope = libm::tan(self.facets_deg.to_radians());
        let mirrored = self.impedance.reflection().powi(2);
        let specular = mirrored / (8.0 * std::f64::consts::PI * slope * slope);
        ThreeTerm {
            specular_db: 10.0 * libm::log10(specular),
            specular_rad: self.facets_deg.to_radians(),
            lambert_db: self.lambert_db,
            lambert_exponent: 2.0,
            intermediate_db: self.lambert_db + self.intermediate_db,
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
    use super::*;

    /// APL-UW TR 9407's own table: density and sound-speed ratio of clay, silt, medium sand and sandy gravel.
    #[test]
    fn impedances_are_those_of_the_handbooks_table() {
        for (phi, density, speed) in [
            (9.0, 1.145, 0.9801),
            (6.0, 1.149, 0.9873),
            (1.5, 1.845, 1.1782),
            (-1.0, 2.492, 1.3370),
        ] {
            let (got, want) = (Impedance::GrainSize(phi).ratio(), density * speed);
            assert!((got / want - 1.0).abs() < 1e-3, "{phi}: {got}, {want}");
        }
    }

    #[test]
    fn sediments_rise_from_mud_to_rock_at_oblique_incidence_and_fall_with_it() {
        let db =
            |s: Sediment, deg: f64| 10.0 * three_term(&preset(s).terms(), deg.to_radians()).log10();
        for s in Sediment::ALL {
            let curve: Vec<f64> = (0..90).map(|deg| db(s, f64::from(deg))).collect();
            println!(
                "{:6} 0: {:.1}, 10: {:.1}, 20: {:.1}, 45: {:.1}, 60: {:.1} dB",
                s.name(),
                curve[0],
                curve[10],
                curve[20],
                curve[45],
                curve[60]
            );
            assert!(curve.windows(2).all(|w| w[1] < w[0]), "{s:?}");
        }
        for pair in Sediment::ALL.windows(2) {
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

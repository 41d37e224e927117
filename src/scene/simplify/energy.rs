//! Energies that rank the scatterers (Meng et al. 2023, Eqs. 26-29).
//!
//! Corrected form: E = visible * (w_curvature E_curvature + w_scattering E_scattering + w_axis E_axis + w_echo E_scattering E_axis), with each part
//! linear in 0..=1:
//! - `curvature`: |Gaussian curvature| relative to its greatest value, with a floor, since flat bottoms, ridges and cylinders have none;
//! - `scattering`: backscattered energy, |strength|^2 times the scattering law at the angle between ray and surface normal (Lambert: cos^2);
//! - `axis`: two-way pattern power towards the scatterer, the largest of all beams;
//! - `echo`: the product of the last two, the expected received energy without spreading. It is not in the paper. It is the default of `Unbiased`: the variance of an estimated sum is least if each term is sampled in proportion to its expected size.
//!
//! Form as printed: the modulus of the weighted sum of decibels, times 0 for points that Eq. 27 calls shadowed. The decibels are those of signed
//! curvature (with an unsquared denominator, Eq. 28) and of the incidence angle itself (Eq. 29; from the vertical, Eq. 9). All decibels are <= 0, so
//! the modulus ranks the weakest first. Decibels of a negative number have the modulus of the complex logarithm; those of zero are infinite.

use std::f64::consts::{LN_10, PI};

use glam::DVec3;

use super::curvature::Curvatures;
use super::shadow::{Horizon, incidence_from_vertical};
use super::{Method, Settings, Weights};
use echotank_core::scene::{ScatterLaw, Scatterers};

/// One beam: transmit and receive apertures with common axes.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Beam {
    /// Unit vector along the array, world coordinates.
    pub along: DVec3,
    /// Unit vector across the face, world coordinates.
    pub across: DVec3,
    /// Unit vector of the boresight, world coordinates.
    pub boresight: DVec3,
    /// Lengths of the transmit and the receive aperture, wavelengths; 0 is omnidirectional.
    pub lengths: [f64; 2],
    /// Widths of the transmit and the receive aperture, wavelengths; 0 is omnidirectional.
    pub widths: [f64; 2],
    /// Whether a baffle suppresses directions behind the face.
    pub baffled: bool,
}

impl Beam {
    /// Two-way pattern power towards the unit vector `ray`, or towards the best direction within `slack` of its sine along the array.
    fn power(&self, ray: DVec3, slack: f64) -> f64 {
        if self.baffled && ray.dot(self.boresight) < 0.0 {
            return 0.0;
        }
        let along = (ray.dot(self.along).abs() - slack).max(0.0);
        let across = ray.dot(self.across);
        let mut amplitude = 1.0;
        for (length, width) in self.lengths.into_iter().zip(self.widths) {
            amplitude *= sinc(length * along) * sinc(width * across);
        }
        amplitude * amplitude
    }
}

fn sinc(x: f64) -> f64 {
    let y = PI * x;
    if y.abs() < 1e-4 {
        1.0 - y * y / 6.0
    } else {
        libm::sin(y) / y
    }
}

/// Position and beams of the sonar.
#[derive(Debug, Default, PartialEq)]
pub struct View {
    /// Position of the sonar, world coordinates, metres.
    pub apex_m: DVec3,
    /// Beams of the sonar; empty for an omnidirectional one.
    pub beams: Vec<Beam>,
    /// Greatest displacement for which a held selection stays valid, metres.
    pub slack_m: f64,
    /// Greatest rotation for which a held selection stays valid, radians.
    pub slack_rad: f64,
    /// Whether to search for shadows; false if another stage removes shadowed scatterers.
    pub shadows: bool,
}

impl Clone for View {
    fn clone(&self) -> Self {
        Self {
            beams: self.beams.clone(),
            ..*self
        }
    }
    /// Reuses the memory of the beams.
    fn clone_from(&mut self, other: &Self) {
        self.beams.clone_from(&other.beams);
        self.apex_m = other.apex_m;
        (self.slack_m, self.slack_rad) = (other.slack_m, other.slack_rad);
        self.shadows = other.shadows;
    }
}

impl View {
    fn axis_power(&self, ray: DVec3, range_m: f64) -> f64 {
        if self.beams.is_empty() {
            return 1.0;
        }
        let slack = if range_m > 0.0 {
            self.slack_m / range_m + self.slack_rad
        } else {
            1.0
        };
        self.beams
            .iter()
            .map(|beam| beam.power(ray, slack))
            .fold(0.0, f64::max)
    }
}

/// Number of parts of an energy: curvature, scattering, axis.
pub const PARTS: usize = 3;

/// Floor of the curvature energy relative to its greatest value: -30 dB, the range of the paper's figure.
const CURVATURE_FLOOR: f64 = 1e-3;

/// Normalisation of the energies of a set. With the same scale, another set yields the same energy for the same scatterer.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct EnergyScale {
    /// The greatest of each part.
    pub parts: [f64; PARTS],
    /// Sector width of the search for shadows, radians.
    pub sector_rad: f64,
}

/// Energies of a set of scatterers. It allocates only while the number of scatterers grows.
#[derive(Debug, Default)]
pub struct Energies {
    /// Energy of each scatterer, dimensionless.
    pub energy: Vec<f64>,
    /// Whether each scatterer lies in shadow.
    pub hidden: Vec<bool>,
    /// Normalisation of this set.
    pub(crate) scale: EnergyScale,
    /// Curvatures of the scatterers.
    pub curvatures: Curvatures,
    horizon: Horizon,
    parts: Vec<[f64; PARTS]>,
}

impl Energies {
    /// Evaluates the energies of all scatterers.
    ///
    /// Scatterers from index `free` on are deterministic: they hide nothing, are never hidden, and do not enter the normalisation. `held` is the
    /// normalisation of an earlier set, under which its rule keeps its meaning.
    pub fn evaluate(
        &mut self,
        scatterers: &Scatterers,
        free: usize,
        view: &View,
        settings: &Settings,
        held: Option<EnergyScale>,
    ) {
        if settings.weights.curvature > 0.0 {
            self.curvatures.fit(scatterers, free);
        }
        self.evaluate_with_curvatures(scatterers, free, view, settings, held);
    }

    /// Evaluates the energies with the curvatures of an earlier fit. Curvatures do not depend on the view; see [`Energies::evaluate`].
    pub fn evaluate_with_curvatures(
        &mut self,
        scatterers: &Scatterers,
        free: usize,
        view: &View,
        settings: &Settings,
        held: Option<EnergyScale>,
    ) {
        let count = scatterers.len();
        self.hidden.clear();
        self.hidden.resize(count, false);
        if view.shadows {
            let hide = match settings.method {
                Method::Paper => Horizon::hide_by_incidence,
                Method::Acoustic | Method::Unbiased => Horizon::hide,
            };
            hide(
                &mut self.horizon,
                scatterers,
                free,
                view.apex_m,
                held.map(|h| h.sector_rad),
                &mut self.hidden,
            );
        }
        let weights = &settings.weights;
        match settings.method {
            Method::Paper => self.printed_parts(scatterers, view, weights),
            Method::Acoustic | Method::Unbiased => self.acoustic_parts(scatterers, view, weights),
        }
        self.scale = held.unwrap_or_else(|| EnergyScale {
            parts: self.scale(free),
            sector_rad: self.horizon.width_rad,
        });
        let scale = self.scale.parts;
        match settings.method {
            Method::Paper => self.combine_as_printed(scale, weights),
            Method::Acoustic | Method::Unbiased => self.combine(scale, weights),
        }
    }

    fn acoustic_parts(&mut self, scatterers: &Scatterers, view: &View, weights: &Weights) {
        self.parts.clear();
        for i in 0..scatterers.len() {
            let offset_m = scatterers.position_m(i) - view.apex_m;
            let range_m = offset_m.length();
            let ray = if range_m > 0.0 {
                offset_m / range_m
            } else {
                DVec3::Z
            };
            let law = match scatterers.law[i] {
                ScatterLaw::Point | ScatterLaw::Water => 1.0,
                law => {
                    let normal = DVec3::from_array(scatterers.normal[i].map(f64::from));
                    let cos = (-normal.dot(ray)).clamp(0.0, 1.0);
                    match (law, &scatterers.curve) {
                        (ScatterLaw::Curve, Some(curve)) => curve.half(cos.sqrt()).powi(4),
                        (ScatterLaw::Curve, None) => 0.0,
                        _ => cos * cos,
                    }
                }
            };
            let curvature = match weights.curvature > 0.0 {
                true => self.curvatures.per_m2[i].abs(),
                false => 0.0,
            };
            let scattering = scatterers.strength[i].norm_sqr() * law;
            self.parts
                .push([curvature, scattering, view.axis_power(ray, range_m)]);
        }
    }

    /// The greatest of each part among the visible of the first `free`.
    fn scale(&self, free: usize) -> [f64; PARTS] {
        let mut greatest = [0.0_f64; PARTS];
        for (part, hidden) in self.parts.iter().zip(&self.hidden).take(free) {
            if !hidden {
                for (most, value) in greatest.iter_mut().zip(part) {
                    // `f64::max` ignores NaN.
                    *most = most.max(*value);
                }
            }
        }
        greatest
    }

    fn combine(&mut self, scale: [f64; PARTS], weights: &Weights) {
        let share = |value: f64, most: f64| if most > 0.0 { value / most } else { 0.0 };
        self.energy.clear();
        self.energy.extend(self.parts.iter().map(|part| {
            let curvature = share(part[0], scale[0]).max(CURVATURE_FLOOR);
            let (scattering, axis) = (share(part[1], scale[1]), share(part[2], scale[2]));
            let energy = weights.curvature * curvature
                + weights.scattering * scattering
                + weights.axis * axis
                + weights.echo * scattering * axis;
            if energy.is_nan() { 0.0 } else { energy }
        }));
    }

    fn printed_parts(&mut self, scatterers: &Scatterers, view: &View, weights: &Weights) {
        self.parts.clear();
        for i in 0..scatterers.len() {
            let offset_m = scatterers.position_m(i) - view.apex_m;
            let range_m = offset_m.length();
            let curvature = match weights.curvature > 0.0 {
                true => self.curvatures.as_printed_per_m2[i],
                false => 1.0,
            };
            self.parts.push([
                curvature,
                incidence_from_vertical(scatterers, i, view.apex_m),
                view.axis_power(offset_m / range_m, range_m),
            ]);
        }
    }

    fn combine_as_printed(&mut self, scale: [f64; PARTS], weights: &Weights) {
        self.energy.clear();
        for (part, hidden) in self.parts.iter().zip(&self.hidden) {
            // 10 log10 x of x < 0 is 10 log10 |x| + j 10 pi / ln 10. Only curvature can be negative.
            let ratio = part[0] / scale[0];
            let real = weights.curvature * decibels(ratio.abs())
                + weights.scattering * decibels(part[1] / scale[1])
                + weights.axis * decibels(part[2]);
            let imaginary = match ratio < 0.0 {
                true => weights.curvature * 10.0 * PI / LN_10,
                false => 0.0,
            };
            // 0 times infinity is NaN as well.
            let seen = if *hidden { 0.0 } else { 1.0 };
            self.energy.push(seen * real.hypot(imaginary));
        }
        // Shadow is a factor here, not a rank: a shadowed point ties with the best, whose decibels are 0 as well.
        self.hidden.fill(false);
    }
}

fn decibels(ratio: f64) -> f64 {
    10.0 * libm::log10(ratio)
}

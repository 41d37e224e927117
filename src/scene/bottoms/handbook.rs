//! Backscattering model of APL-UW TR 9407 (1994), IV.C, equations 34 to 66. Tests fit the presets to it.
//!
//! Equation numbers are the handbook's. Wavenumbers are in 1/cm, since the roughness spectrum is w_2 (h_0 K)^-gamma with h_0 = 1 cm.
//!
//! **One exponent differs from the print.** In the Kirchhoff form, b = a^(1/2 + 1/(2 alpha)) Gamma(1/alpha) / (2 alpha). The print has a minus sign.
//! The strength at the vertical must be the Kirchhoff integral k^2 |R|^2 / (2 pi) int exp(-2 k^2 C_h^2 r^(2 alpha)) r dr. With the minus sign it is
//! not, and lies 3.6 dB below the handbook's table 3. With the plus sign it agrees with both.

use std::f64::consts::{FRAC_PI_2, LN_10, PI, TAU};

use num_complex::Complex64;

use super::Preset;

/// gamma (Eq. 8), and alpha = gamma / 2 - 1.
const EXPONENT: f64 = 3.25;
const ALPHA: f64 = 0.625;

/// Reflection coefficient, and the ratio of the vertical wavenumbers in sediment and water (Eqs. 30 to 33).
fn rayleigh(p: &Preset, grazing_rad: f64) -> (Complex64, Complex64) {
    let (sin, cos) = grazing_rad.sin_cos();
    let kappa = Complex64::new(1.0, p.loss) / p.speed_ratio;
    let root = (kappa * kappa - cos * cos).sqrt();
    let y = p.density_ratio * sin / root;
    ((y - 1.0) / (y + 1.0), root)
}

/// Perturbation by the roughness (Eqs. 50 to 52).
fn perturbed(p: &Preset, k: f64, grazing_rad: f64) -> f64 {
    let (sin, cos) = grazing_rad.sin_cos();
    let kappa = Complex64::new(1.0, p.loss) / p.speed_ratio;
    let (_, root) = rayleigh(p, grazing_rad);
    let through = (p.density_ratio - 1.0).powi(2) * cos * cos + p.density_ratio.powi(2);
    let factor = (through - kappa * kappa) / (p.density_ratio * sin + root).powi(2);
    let bragg = (4.0 * k * k * cos * cos + (k / 10.0).powi(2)).sqrt();
    let spectrum = p.roughness_cm4 * bragg.powf(-EXPONENT);
    4.0 * (k * sin).powi(4) * factor.norm_sqr() * spectrum
}

/// Scattering by the sediment volume (Eqs. 65 and 66).
fn within(p: &Preset, grazing_rad: f64) -> f64 {
    let (mirrored, root) = rayleigh(p, grazing_rad);
    let sin = grazing_rad.sin();
    5.0 * p.loss * p.volume * (1.0 - mirrored * mirrored).norm_sqr() * sin * sin
        / (p.speed_ratio * LN_10 * root.norm_sqr() * root.im)
}

/// Mean over the large-scale slopes by three-point quadrature (Eqs. 46 to 49).
fn over_slopes(grazing_rad: f64, slope: f64, strength: impl Fn(f64) -> f64) -> f64 {
    // The strengths vanish at zero grazing, so angles are clamped there.
    let at = |node: f64| strength((grazing_rad - node * slope).clamp(1e-9, FRAC_PI_2));
    (0.295_410 * (at(1.224_745) + at(-1.224_745)) + 1.181_636 * at(0.0)) / PI.sqrt()
}

/// Blending function (Eq. 57).
fn blend(x: f64) -> f64 {
    1.0 / (1.0 + x.clamp(-40.0, 40.0).exp())
}

/// Backscattering strength per square metre, a linear power, at a positive grazing angle.
pub(super) fn strength(p: &Preset, grazing_rad: f64, frequency_hz: f64, water_m_per_s: f64) -> f64 {
    let gamma = libm::tgamma;
    let k = TAU * frequency_hz / (100.0 * water_m_per_s);
    let (sin, cos) = grazing_rad.sin_cos();
    let grazing_deg = grazing_rad.to_degrees();
    let upright = rayleigh(p, FRAC_PI_2).0.norm_sqr();

    // Kirchhoff approximation, Eqs. 35 to 40.
    let structure = TAU * p.roughness_cm4 * gamma(2.0 - ALPHA) * 2.0_f64.powf(-2.0 * ALPHA)
        / (ALPHA * (1.0 - ALPHA) * gamma(1.0 + ALPHA));
    let q = structure * 2.0_f64.powf(1.0 - 2.0 * ALPHA) * k.powf(2.0 * (1.0 - ALPHA));
    let half = 0.5 / ALPHA;
    let a = (8.0 * ALPHA * ALPHA * gamma(half + 0.5)
        / (gamma(0.5) * gamma(1.0 / ALPHA) * gamma(half)))
    .powf(2.0 * ALPHA);
    let b = a.powf(0.5 + half) * gamma(1.0 / ALPHA) * half;
    let kirchhoff = match grazing_deg >= 40.0 {
        true => {
            let spread = cos.powf(4.0 * ALPHA) + a * q * q * sin.powi(4);
            b * q * upright / (8.0 * PI * spread.powf((1.0 + ALPHA) * half))
        }
        false => 0.0,
    };

    // Composite roughness with shadowing, Eqs. 41 to 49.
    let slope_squared = (TAU * p.roughness_cm4).powf(1.0 / ALPHA) / (2.0 * (1.0 - ALPHA))
        * (k * k / ALPHA).powf((1.0 - ALPHA) / ALPHA);
    let slope = slope_squared.sqrt();
    let t = grazing_rad.tan() / slope;
    let insonified = match t > 2.0 {
        true => 1.0,
        false => {
            let q = ((-t * t).exp() / PI.sqrt() - t * (1.0 - libm::erf(t))) / (4.0 * t);
            (1.0 - (-2.0 * q).exp()) / (2.0 * q)
        }
    };
    let composite = insonified * over_slopes(grazing_rad, slope, |at| perturbed(p, k, at));
    let volume = insonified * over_slopes(grazing_rad, slope, |at| within(p, at));

    // Large roughness, Eqs. 53 to 56.
    let slope_deg = slope.to_degrees();
    let critical_deg = match p.speed_ratio >= 1.001 {
        true => (1.0 / p.speed_ratio).acos().to_degrees(),
        false => 2.5613,
    };
    let low = 0.04682
        * slope.powf(1.25)
        * p.speed_ratio.powf(3.25)
        * ((1.0 - 2.0 / p.density_ratio) / p.speed_ratio.powi(2) + 1.0).powi(2)
        / (1.0 + 3.54 * slope_deg / critical_deg);
    let beyond = 1.0 + 0.81 * (critical_deg / grazing_deg).powi(2);
    let gaussian = 1.0 + ((grazing_deg - 90.0) / slope_deg).powi(2) / 2.6;
    let rough = low * (PI / beyond).sin().powf(0.7263 * slope.powf(-1.0 / 3.0))
        + 0.0260 * upright / (slope_squared * gaussian.powf(1.9) * beyond);

    // Transitions, Eqs. 57 to 64.
    let fallen = 1000.0_f64.powf(1.0 / (1.0 + ALPHA)) * (a * q * q).powf(1.0 / ALPHA);
    let steep = blend((cos - (1.0 / fallen + 4.0).powf(-0.25)) / 0.0125);
    let moderate = steep * kirchhoff + (1.0 - steep) * composite;
    let smooth = blend((slope.atan().to_degrees() - 7.0) / 0.5);
    smooth * moderate + (1.0 - smooth) * rough + volume
}

//! Reflection and scattering by the sea surface, and reflection by the bottom.
//!
//! A boundary with the rms height sigma reflects the coherent part exp(-2 (k sigma sin psi)^2) of the pressure, psi the grazing
//! angle (Rayleigh roughness parameter; Eckart 1953). The energy that it takes from the coherent part stays in the water: it goes
//! forward as the incoherent part, around the mirror direction, by facets with the rms slope of the boundary.
//!
//! | quantity | source |
//! |---|---|
//! | bottom, flat | Rayleigh reflection at a fluid with loss, from the ratios of density and sound speed |
//! | surface, flat | -1 |
//! | bubbles below the surface: loss of a reflection | APL-UW TR 9407 (1994), section II, surface bubble loss |
//! | slopes and backscattering strength of the surface | APL-UW TR 9407, section II: facets, small-scale roughness, bubbles |
//! | rms height from the wind | Pierson and Moskowitz 1964: a quarter of the significant height 0.0213 U^2 |
//!
//! The handbook holds from 10 to 100 kHz. Frequencies outside are taken as the nearer end: above 100 kHz the strength and the loss
//! are those at 100 kHz. Coefficients of TR 9407 as in O. C. Rodriguez, "Fundamentos de Acustica Submarina" (apl_surface_sigma,
//! apl_bub_sigma).

use num_complex::Complex64;
use std::f64::consts::{FRAC_PI_2, PI};

/// Frequencies of the handbook, kHz.
const HANDBOOK_KHZ: (f64, f64) = (10.0, 100.0);
/// Re-radiation damping at resonance of bubbles near the surface.
const RADIATION_DAMPING: f64 = 0.0136;
/// Facets end at this grazing angle for the small-scale roughness, radians: 85 degrees.
const STEEPEST_SMALL_SCALE_RAD: f64 = 85.0 * PI / 180.0;
/// Smallest sine of a grazing angle; keeps all values finite.
const LEAST_SINE: f64 = 1e-3;

/// A boundary's reflection of pressure at one grazing angle.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Reflection {
    /// Mean coefficient: the mirror image.
    pub coherent: Complex64,
    /// Mean square of the whole coefficient, coherent and incoherent.
    pub power: f64,
}

impl Reflection {
    /// No boundary.
    pub const NONE: Self = Self {
        coherent: Complex64::ONE,
        power: 1.0,
    };

    /// Both of two reflections.
    pub fn and(self, other: Self) -> Self {
        Self {
            coherent: self.coherent * other.coherent,
            power: self.power * other.power,
        }
    }

    /// Mean square of the incoherent part.
    pub fn incoherent(&self) -> f64 {
        (self.power - self.coherent.norm_sqr()).max(0.0)
    }

    fn rough(smooth: Complex64, wavenumber_per_m: f64, rms_m: f64, sine: f64) -> Self {
        let g = wavenumber_per_m * rms_m * sine;
        Self {
            coherent: smooth * libm::exp(-2.0 * g * g),
            power: smooth.norm_sqr(),
        }
    }
}

/// The sea surface.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SeaSurface {
    /// Wind speed 10 m above it, m/s.
    pub wind_m_per_s: f64,
    /// Rms height, metres.
    pub rms_m: f64,
    /// Mean square of the slope, both directions together.
    pub slope2: f64,
}

impl SeaSurface {
    /// Height and slopes of a fully developed sea.
    pub fn of_wind(wind_m_per_s: f64) -> Self {
        Self {
            wind_m_per_s,
            rms_m: 0.25 * 0.0213 * wind_m_per_s * wind_m_per_s,
            slope2: wind_slope2(wind_m_per_s),
        }
    }

    /// Reflection at a grazing angle with this sine. `wavenumber_per_m` is 2 pi / wavelength.
    pub fn reflection(&self, frequency_hz: f64, wavenumber_per_m: f64, sine: f64) -> Reflection {
        let loss_db = bubble_loss_db(self.wind_m_per_s, frequency_hz, sine);
        let smooth = -libm::exp10(-loss_db / 20.0);
        Reflection::rough(smooth.into(), wavenumber_per_m, self.rms_m, sine)
    }

    /// Backscattering strength per square metre as a linear power, at a grazing angle with this sine.
    pub fn strength(&self, frequency_hz: f64, sine: f64) -> f64 {
        let sine = sine.clamp(LEAST_SINE, 1.0);
        let grazing_rad = libm::asin(sine);
        let cotangent2 = (1.0 - sine * sine) / (sine * sine);
        let facets = |cotangent2: f64, sine: f64| {
            libm::pow(sine, -4.0) / (4.0 * PI * self.slope2) * libm::exp(-cotangent2 / self.slope2)
        };
        let small = match grazing_rad <= STEEPEST_SMALL_SCALE_RAD {
            true => 1.3e-5 * self.wind_m_per_s / (cotangent2 * cotangent2),
            false => 0.0,
        };
        // From facets to small-scale roughness where the facets have fallen by 15 dB from the vertical.
        let crossover_rad = crossover_rad(self.slope2);
        let apart_deg = (crossover_rad - grazing_rad).to_degrees();
        let share = 1.0 / (1.0 + libm::exp(0.524 * apart_deg));
        let interface = share * facets(cotangent2, sine) + (1.0 - share) * small;
        let loss_db = bubble_loss_db(self.wind_m_per_s, frequency_hz, sine);
        interface * libm::exp10(-loss_db / 10.0)
            + bubble_strength(self.wind_m_per_s, frequency_hz, sine)
    }
}

/// Mean square of the slope of the surface.
pub fn wind_slope2(wind_m_per_s: f64) -> f64 {
    match wind_m_per_s >= 1.0 {
        true => 4.6e-3 * libm::log(2.1 * wind_m_per_s * wind_m_per_s),
        false => 0.0034,
    }
}

fn handbook_khz(frequency_hz: f64) -> f64 {
    (1e-3 * frequency_hz).clamp(HANDBOOK_KHZ.0, HANDBOOK_KHZ.1)
}

/// Loss of a reflection by the bubbles below the surface, dB.
pub fn bubble_loss_db(wind_m_per_s: f64, frequency_hz: f64, sine: f64) -> f64 {
    if wind_m_per_s <= 0.0 {
        return 0.0;
    }
    let of_wind = match wind_m_per_s >= 6.0 {
        true => libm::pow(wind_m_per_s, 1.57),
        false => libm::pow(6.0, 1.57) * libm::exp(1.2 * (wind_m_per_s - 6.0)),
    };
    1.26e-3 / sine.max(LEAST_SINE) * of_wind * libm::pow(handbook_khz(frequency_hz), 0.85)
}

/// Strength of the bubbles.
fn bubble_strength(wind_m_per_s: f64, frequency_hz: f64, sine: f64) -> f64 {
    let khz = handbook_khz(frequency_hz);
    let column = |wind: f64| libm::exp10(-5.2577 + 0.4701 * wind) * libm::pow(khz / 25.0, 0.85);
    let depth = match wind_m_per_s < 11.0 {
        true => column(wind_m_per_s),
        false => column(11.0) * libm::pow(wind_m_per_s / 11.0, 3.5),
    };
    let beta = depth / sine;
    let damping = 2.55e-2 * libm::cbrt(khz);
    let paths = (1.0 + 8.0 * beta * libm::exp(-2.0 * beta) - libm::exp(-4.0 * beta)) / (2.0 * beta);
    depth * RADIATION_DAMPING / (4.0 * PI * damping) * paths
}

/// Grazing angle at which the facets are 15 dB below the vertical.
fn crossover_rad(slope2: f64) -> f64 {
    let fall = |steep: f64| {
        // tan^2 of the angle from the vertical, and -ln of the fall.
        let tangent2 = steep * steep;
        tangent2 / slope2 - 2.0 * libm::log1p(tangent2)
    };
    let want = 1.5 * std::f64::consts::LN_10;
    // The fall grows up to slopes far above the crossover.
    let (mut low, mut high) = (0.0, libm::sqrt(8.0 * slope2));
    for _ in 0..60 {
        let middle = 0.5 * (low + high);
        match fall(middle) < want {
            true => low = middle,
            false => high = middle,
        }
    }
    FRAC_PI_2 - libm::atan(low)
}

/// A bottom as a fluid with a rough surface.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct FluidBottom {
    /// Density relative to the water's.
    pub density_ratio: f64,
    /// Sound speed relative to the water's.
    pub speed_ratio: f64,
    /// Imaginary over real part of the wavenumber.
    pub loss: f64,
    /// Rms height, metres.
    pub rms_m: f64,
    /// Mean square of the slope, both directions together.
    pub slope2: f64,
}

impl FluidBottom {
    /// Reflection at a grazing angle with this sine.
    pub fn reflection(&self, wavenumber_per_m: f64, sine: f64) -> Reflection {
        let kappa = Complex64::new(1.0, self.loss) / self.speed_ratio;
        let inside = (kappa * kappa - (1.0 - sine * sine)).sqrt();
        let impedance = self.density_ratio * sine;
        let smooth = (impedance - inside) / (impedance + inside);
        Reflection::rough(smooth, wavenumber_per_m, self.rms_m, sine)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_rough_boundary_keeps_its_energy() {
        let surface = SeaSurface {
            wind_m_per_s: 0.0,
            rms_m: 1e-3,
            slope2: 0.01,
        };
        let k = std::f64::consts::TAU * 400e3 / 1500.0;
        let vertical = surface.reflection(400e3, k, 1.0);
        // exp(-2 (k sigma)^2): -48.8 dB for 1 mm at 400 kHz.
        let db = 20.0 * vertical.coherent.norm().log10();
        assert!((db + 48.77).abs() < 0.1, "{db}");
        assert!(vertical.coherent.re < 0.0);
        assert!((vertical.power - 1.0).abs() < 1e-15);
        assert!((vertical.incoherent() + vertical.coherent.norm_sqr() - 1.0).abs() < 1e-12);
        let grazing = surface.reflection(400e3, k, 0.01);
        assert!(grazing.coherent.norm() > 0.99);
    }

    /// Closed forms: at the vertical (Z - 1)/(Z + 1) with Z the ratio of impedances, total reflection below the critical angle, and the angle of intromission
    /// of a slow bottom.
    #[test]
    fn bottoms_reflect_as_fluids() {
        let bottom = |density_ratio: f64, speed_ratio: f64| FluidBottom {
            density_ratio,
            speed_ratio,
            loss: 0.0,
            rms_m: 0.0,
            slope2: 0.0,
        };
        let sand = bottom(1.845, 1.1782);
        let z = 1.845 * 1.1782;
        let vertical = sand.reflection(1.0, 1.0).coherent;
        assert!((vertical - (z - 1.0) / (z + 1.0)).norm() < 1e-12);
        let critical = (1.0 - 1.0 / (1.1782f64 * 1.1782)).sqrt();
        assert!((sand.reflection(1.0, critical - 0.01).power - 1.0).abs() < 1e-12);
        assert!(sand.reflection(1.0, critical + 0.05).power < 0.6);
        // Mud: sin^2 psi = (1/nu^2 - 1) / (m^2 - 1) has no reflection.
        let mud = bottom(1.145, 0.9801);
        let quiet = ((1.0 / (0.9801f64 * 0.9801) - 1.0) / (1.145f64 * 1.145 - 1.0)).sqrt();
        assert!(mud.reflection(1.0, quiet).power < 1e-20);
    }

    /// At the vertical facets alone: 1/(4 pi s^2), less the loss by bubbles. At 20 degrees in a breeze bubbles alone, whose saturated form is
    /// delta_r sin psi / (8 pi delta).
    #[test]
    fn the_surface_scatters_as_facets_at_the_vertical_and_as_bubbles_at_grazing_angles() {
        for wind in [3.0, 10.0] {
            let surface = SeaSurface::of_wind(wind);
            let want = 1.0 / (4.0 * PI * wind_slope2(wind));
            let loss_db = bubble_loss_db(wind, 30e3, 1.0);
            let got_db = 10.0 * surface.strength(30e3, 1.0).log10();
            assert!(
                (got_db - (10.0 * want.log10() - loss_db)).abs() < 0.1,
                "{got_db}"
            );
        }
        let surface = SeaSurface::of_wind(15.0);
        let sine = 20f64.to_radians().sin();
        let damping = 2.55e-2 * 30f64.cbrt();
        let saturated = RADIATION_DAMPING * sine / (8.0 * PI * damping);
        let got = surface.strength(30e3, sine);
        assert!(
            (10.0 * (got / saturated).log10()).abs() < 1.0,
            "{got:e} {saturated:e}"
        );
        // Constant above the handbook's frequencies.
        assert_eq!(surface.strength(100e3, sine), surface.strength(400e3, sine));
        // More wind never makes it quieter below the crossover.
        let at = |wind: f64| SeaSurface::of_wind(wind).strength(30e3, sine);
        for pair in [2.0, 4.0, 6.0, 8.0, 10.0].windows(2) {
            assert!(at(pair[0]) < at(pair[1]), "{pair:?}");
        }
    }

    #[test]
    fn facets_are_15_db_below_the_vertical_at_the_crossover() {
        for wind in [0.0, 5.0, 15.0, 40.0] {
            let s2 = wind_slope2(wind);
            let tangent2 = libm::tan(FRAC_PI_2 - crossover_rad(s2)).powi(2);
            let fall_db = 10.0 * ((1.0 + tangent2).powi(2) * (-tangent2 / s2).exp()).log10();
            assert!((fall_db + 15.0).abs() < 1e-6, "{wind}: {fall_db}");
        }
    }
}

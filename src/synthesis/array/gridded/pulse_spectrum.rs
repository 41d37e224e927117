//! Spectrum of the transmitted pulse at any frequency, and its energy outside a band.
//!
//! ```text
//! S(g) = integral over -T/2..T/2 of a(w + T/2) exp(-j 2pi g w) dw
//! ```
//!
//! Here w counts from the middle of the pulse. Further tables have the spectra of the pulse times
//! powers of 2w/T, for echoes with a changing stretch.
//!
//! The inputs are a pulse and the largest |g|. Gauss-Legendre quadrature gives weighted points. Its
//! panels are a few cycles long and end at the flanks of the taper. The nonuniform transform sums
//! the points onto a uniform table, and the same kernel interpolates between its entries. The error
//! is 1e-11 of the rms of the spectrum.

use std::sync::LazyLock;

use echotank_fft::Planned;
use num_complex::Complex64;

use echotank_core::pulse::Pulse;

use super::kernel::Kernel;
use super::transform::{Transform1d, grid_size};
use echotank_core::simd::SimdLevel;

const WIDTH: usize = 14;
const OVERSAMPLING: f64 = 2.0;
const MOMENTS: usize = 12;

/// Number of nodes of a panel.
const PANEL_NODES: usize = 16;
/// Number of cycles that these nodes resolve to rounding.
const PANEL_CYCLES: f64 = 1.5;

/// Tables of the spectrum of one pulse.
pub struct PulseSpectrum {
    kernel: &'static Reading,
    /// Tables, one for each power. Entry k is at (k - middle) / period.
    tables: Vec<Vec<Complex64>>,
    period_s: f64,
    energy: f64,
}

/// Interpolation kernel of the tables, designed once.
struct Reading {
    kernel: Kernel,
    /// Weight of tap i for power k: `[k][i]`.
    weights: [[f64; WIDTH]; MOMENTS],
}

static READING: LazyLock<Reading> = LazyLock::new(|| {
    let kernel = Kernel::new(WIDTH, OVERSAMPLING, MOMENTS);
    let weights = std::array::from_fn(|k| std::array::from_fn(|i| kernel.weight(k, i)));
    Reading { kernel, weights }
});

impl PulseSpectrum {
    /// Tabulates the spectrum for |g| <= `highest_hz`.
    pub fn new(pulse: &Pulse, highest_hz: f64) -> Self {
        Self::with_powers(pulse, highest_hz, 0)
    }

    /// As [`Self::new`], with the spectra of a (2w/T)^n for n up to `highest_power`.
    pub(crate) fn with_powers(pulse: &Pulse, highest_hz: f64, highest_power: usize) -> Self {
        let kernel = &READING.kernel;
        let period_s = OVERSAMPLING * pulse.duration_s;
        let entries = 2 * ((highest_hz * period_s).ceil() as usize + WIDTH + 2);
        let bins = grid_size(entries);
        let (mut delay_s, mut weight) = (Vec::new(), Vec::new());
        let mut energy = 0.0;
        for (at_s, length_s) in nodes(pulse, highest_hz) {
            let value = pulse.envelope(at_s);
            energy += length_s * value.norm_sqr();
            let from_middle_s = at_s - 0.5 * pulse.duration_s;
            // The transform needs non-negative delays; `at` accounts for the half period.
            delay_s.push(from_middle_s + 0.5 * period_s);
            weight.push(value * (length_s / kernel.window_gain(from_middle_s / period_s)));
        }
        let transform =
            Transform1d::<f64>::new(bins, period_s, WIDTH, OVERSAMPLING, SimdLevel::best());
        let mut work = transform.workspace();
        let mut tables = Vec::with_capacity(highest_power + 1);
        for power in 0..=highest_power {
            if power > 0 {
                for (weight, delay_s) in weight.iter_mut().zip(&delay_s) {
                    *weight *= (delay_s - 0.5 * period_s) / (0.5 * pulse.duration_s);
                }
            }
            let mut table = vec![Complex64::ZERO; bins];
            transform.execute(&mut work, &delay_s, &weight, &mut table);
            // A shift by half a period is a factor of -1 in every odd entry.
            let middle = bins / 2;
            for (k, value) in table.iter_mut().enumerate() {
                if (k + middle) % 2 == 1 {
                    *value = -*value;
                }
            }
            tables.push(table);
        }
        Self {
            kernel: &READING,
            tables,
            period_s,
            energy,
        }
    }

    /// S at `g_hz`, which must lie within the tables.
    #[inline(always)]
    pub fn at(&self, g_hz: f64) -> Complex64 {
        let (first, weight) = self.place(g_hz);
        read(&self.tables[0][first..first + WIDTH], &weight)
    }

    /// Spectra of a (2w/T)^n for n = 0, 1, ..., up to the number of tables and the length of `out`.
    #[inline(always)]
    pub(crate) fn powers_at(&self, g_hz: f64, out: &mut [Complex64]) {
        let (first, weight) = self.place(g_hz);
        for (out, table) in out.iter_mut().zip(&self.tables) {
            *out = read(&table[first..first + WIDTH], &weight);
        }
    }

    /// First entry and interpolation weights for `g_hz`.
    #[inline(always)]
    fn place(&self, g_hz: f64) -> (usize, [f64; WIDTH]) {
        let Reading { kernel, weights } = self.kernel;
        let middle = (self.tables[0].len() / 2) as f64;
        let position = g_hz * self.period_s + middle + kernel.shift();
        let cell = position.floor();
        let x = 2.0 * (position - cell) - 1.0;
        let first = (cell as isize + kernel.first()) as usize;
        let mut weight = [0.0; WIDTH];
        for weights in weights.iter().rev() {
            for (sum, weight) in weight.iter_mut().zip(weights) {
                *sum = *sum * x + weight;
            }
        }
        (first, weight)
    }

    /// Integral of |S|^2 over all frequencies (of |a|^2 over the pulse).
    pub fn energy(&self) -> f64 {
        self.energy
    }
}

#[inline(always)]
fn read(entries: &[Complex64], weight: &[f64; WIDTH]) -> Complex64 {
    let pairs = entries.iter().zip(weight);
    pairs.fold(Complex64::ZERO, |sum, (value, weight)| sum + value * weight)
}

/// Nodes and weights of the integral of a over the pulse, times waves of up to `highest_hz`.
fn nodes(pulse: &Pulse, highest_hz: f64) -> Vec<(f64, f64)> {
    let duration_s = pulse.duration_s;
    let flank_s = 0.5 * pulse.taper * duration_s;
    let mut ends = vec![0.0, flank_s, duration_s - flank_s, duration_s];
    ends.dedup_by(|b, a| *b - *a <= 1e-12 * duration_s);
    let (places, weights) = gauss_legendre();
    let mut all = Vec::new();
    for pair in ends.windows(2) {
        let length_s = pair[1] - pair[0];
        let cycles = length_s * (highest_hz + 0.5 * pulse.bandwidth_hz + 2.0 / duration_s);
        let panels = (cycles / PANEL_CYCLES).ceil().max(1.0);
        let half_s = 0.5 * length_s / panels;
        for p in 0..panels as usize {
            let middle_s = pair[0] + (2 * p + 1) as f64 * half_s;
            for (x, weight) in places.iter().zip(&weights) {
                all.push((middle_s + half_s * x, half_s * weight));
            }
        }
    }
    all
}

/// Nodes and weights on -1..1 by Newton's iteration on the Legendre polynomial.
fn gauss_legendre() -> ([f64; PANEL_NODES], [f64; PANEL_NODES]) {
    let n = PANEL_NODES;
    let (mut places, mut weights) = ([0.0; PANEL_NODES], [0.0; PANEL_NODES]);
    for i in 0..n {
        let mut x = libm::cos(std::f64::consts::PI * (i as f64 + 0.75) / (n as f64 + 0.5));
        let mut slope = 1.0;
        for _ in 0..10 {
            let (mut before, mut now) = (1.0, x);
            for k in 2..=n {
                let next = ((2 * k - 1) as f64 * x * now - (k - 1) as f64 * before) / k as f64;
                (before, now) = (now, next);
            }
            slope = n as f64 * (x * now - before) / (x * x - 1.0);
            x -= now / slope;
        }
        places[i] = x;
        weights[i] = 2.0 / ((1.0 - x * x) * slope * slope);
    }
    (places, weights)
}

/// Energies of the samples of a spectrum's signal in windows of `window` samples, cyclic over its period. The signal has `density` values for each
/// sample, and a window begins at each of them: samples may lie anywhere on an onset.
pub fn energies(mut spectrum: Vec<Complex64>, window: usize, density: usize) -> Vec<f64> {
    f64::plan_inverse(spectrum.len()).process(&mut spectrum);
    let count = spectrum.len();
    let length = window.min(count / density) * density;
    // Over every `density`-th value before one.
    let mut sums = vec![0.0; density];
    sums.reserve(count + length);
    for k in 0..count + length {
        sums.push(sums[k] + spectrum[k % count].norm_sqr());
    }
    (0..count)
        .map(|k| (sums[k + length] - sums[k]).max(0.0))
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use echotank_core::pulse::PulseKind;
    use std::f64::consts::{PI, TAU};

    fn pulse(kind: PulseKind, taper: f64) -> Pulse {
        Pulse {
            kind,
            center_frequency_hz: 400e3,
            bandwidth_hz: if kind == PulseKind::Cw { 0.0 } else { 30e3 },
            duration_s: 1e-3,
            taper,
        }
    }

    #[test]
    fn a_rectangular_cw_is_a_sinc_to_1e_11() {
        let spectrum = PulseSpectrum::new(&pulse(PulseKind::Cw, 0.0), 50e3);
        for i in -500..=500 {
            let g_hz = 99.7 * f64::from(i);
            let x = PI * g_hz * 1e-3;
            let want = if i == 0 { 1e-3 } else { 1e-3 * x.sin() / x };
            let got = spectrum.at(g_hz);
            assert!((got - want).norm() < 1e-14, "{g_hz} Hz: {got} {want}");
        }
        assert!((spectrum.energy() / 1e-3 - 1.0).abs() < 1e-13);
    }

    /// Expected value: Simpson's rule with 20 000 steps in each of the three parts.
    #[test]
    fn a_tapered_sweep_meets_a_dense_integral_to_1e_9() {
        for kind in [PulseKind::LfmUp, PulseKind::LfmDown, PulseKind::Cw] {
            let pulse = pulse(kind, 0.2);
            let spectrum = PulseSpectrum::new(&pulse, 40e3);
            for g_hz in [-39_999.0, -15_000.0, -3.3, 0.0, 7_777.7, 20_000.0, 40e3] {
                let mut want = Complex64::ZERO;
                for (from, to) in [(0.0, 0.1e-3), (0.1e-3, 0.9e-3), (0.9e-3, 1e-3)] {
                    let step = (to - from) / 20_000.0;
                    for k in 0..=20_000 {
                        let t_s: f64 = (from + f64::from(k) * step).min(1e-3);
                        let weight = match k {
                            0 | 20_000 => 1.0,
                            _ if k % 2 == 1 => 4.0,
                            _ => 2.0,
                        };
                        let turn = Complex64::from_polar(step / 3.0, -TAU * g_hz * (t_s - 0.5e-3));
                        want += pulse.envelope(t_s) * turn * weight;
                    }
                }
                let error = (spectrum.at(g_hz) - want).norm() / 1e-4;
                assert!(error < 1e-9, "{kind:?} {g_hz} Hz: {error:e}");
            }
        }
    }
}

//! Spectra of the pulse as seen from a few instants of its emission.
//!
//! Whatever varies smoothly while the pulse is emitted is a short Chebyshev series in the time of emission x = 2w/T, w from mid-pulse. So
//! all that the pulse contributes is S_n(g) = integral of a(w) T_n(x) exp(-j 2pi g w) dw, n = 0, 1, ... They depend on the pulse alone: a
//! ping's motion only says where they are read (at the Doppler-shifted frequency), which is what makes templates cheap to make anew for
//! every ping. [`Instants`] turns them into the spectra of Lagrange's polynomials of any number of instants.

use std::f64::consts::{PI, TAU};

use num_complex::Complex64;

use crate::flow::Pulse;

/// Samples per 1/T of the tables: with [`POINTS`] points of interpolation 2e-11 of the spectrum's peak is left.
const DENSITY: f64 = 16.0;
/// Points of the interpolation.
const POINTS: usize = 10;
/// Nodes of one panel of the quadrature, for at most [`CYCLES_PER_PANEL`] of the fastest phase: exact to rounding.
const PANEL: usize = 16;
const CYCLES_PER_PANEL: f64 = 2.0;

/// Chebyshev's points of the first kind, -1..1.
pub fn chebyshev_nodes(count: usize) -> impl Iterator<Item = f64> {
    (0..count).map(move |i| -libm::cos(PI * (i as f64 + 0.5) / count as f64))
}

/// Terms in the tables, and so the most instants there can be.
pub const MOST_INSTANTS: usize = 24;

/// A number of instants of the emission, and what turns Chebyshev's series into values at them.
#[derive(Clone, Debug)]
pub struct Instants {
    /// 2w/T.
    pub x: Vec<f64>,
    /// L_n = sum_j share[n * count + j] T_j.
    pub share: Vec<f64>,
}

impl Instants {
    pub fn new(count: usize) -> Self {
        let x: Vec<f64> = chebyshev_nodes(count).collect();
        let share = x
            .iter()
            .flat_map(|&x| {
                (0..count).map(move |j| {
                    let scale = if j == 0 { 1.0 } else { 2.0 };
                    scale / count as f64 * chebyshev(j, x)
                })
            })
            .collect();
        Self { x, share }
    }

    pub fn len(&self) -> usize {
        self.x.len()
    }

    pub fn is_empty(&self) -> bool {
        self.x.is_empty()
    }
}

/// T_n(x) for -1 <= x <= 1.
pub fn chebyshev(n: usize, x: f64) -> f64 {
    libm::cos(n as f64 * libm::acos(x.clamp(-1.0, 1.0)))
}

/// Tables of S_n. Seconds and hertz.
#[derive(Clone, Debug)]
pub struct PulseSpectra {
    pulse: Pulse,
    first_hz: f64,
    step_hz: f64,
    /// `[sample * MOST_INSTANTS + n]`.
    table: Vec<Complex64>,
    /// 1 / prod (i - j) of the interpolation.
    barycentric: [f64; POINTS],
}

impl PulseSpectra {
    /// For frequencies from -`reach_hz` to `reach_hz` about the centre.
    pub fn new(pulse: &Pulse, reach_hz: f64) -> Self {
        let half_s = 0.5 * pulse.duration_s;
        let step_hz = 1.0 / (DENSITY * pulse.duration_s);
        let margin = POINTS as f64;
        let count = (2.0 * reach_hz / step_hz + 2.0 * margin).ceil() as usize;
        let first_hz = -0.5 * (count - 1) as f64 * step_hz;
        let mut table = vec![Complex64::ZERO; count * MOST_INSTANTS];
        let fastest_hz = -first_hz + 0.5 * pulse.bandwidth_hz;
        for (w_s, weight) in quadrature(pulse, fastest_hz) {
            let value = pulse.envelope(w_s + half_s) * weight;
            let shares: [Complex64; MOST_INSTANTS] =
                std::array::from_fn(|n| value * chebyshev(n, w_s / half_s));
            // Forty steps of the recurrence between sines: rounding stays at 1e-14.
            let turn = Complex64::from_polar(1.0, -TAU * step_hz * w_s);
            let mut phasor = Complex64::ONE;
            for (i, row) in table.chunks_exact_mut(MOST_INSTANTS).enumerate() {
                if i % 40 == 0 {
                    let g_hz = first_hz + i as f64 * step_hz;
                    phasor = Complex64::from_polar(1.0, -TAU * g_hz * w_s);
                }
                for (sum, share) in row.iter_mut().zip(&shares) {
                    *sum += share * phasor;
                }
                phasor *= turn;
            }
        }
        let barycentric = std::array::from_fn(|i| {
            let product: f64 = (0..POINTS)
                .filter(|&j| j != i)
                .map(|j| i as f64 - j as f64)
                .product();
            1.0 / product
        });
        Self {
            pulse: *pulse,
            first_hz,
            step_hz,
            table,
            barycentric,
        }
    }

    /// Whether these are of that pulse, as far out.
    pub fn is_of(&self, pulse: &Pulse, reach_hz: f64) -> bool {
        self.pulse == *pulse && -self.first_hz >= reach_hz + 0.5 * POINTS as f64 * self.step_hz
    }

    /// S_n(g) of the first n into `out`; zero beyond the tables.
    #[inline]
    pub fn read(&self, g_hz: f64, out: &mut [Complex64]) {
        let at = (g_hz - self.first_hz) / self.step_hz;
        let first = at.floor() - (POINTS / 2 - 1) as f64;
        let last = first + (POINTS - 1) as f64;
        out.fill(Complex64::ZERO);
        if first.is_nan() || first < 0.0 || last >= (self.table.len() / MOST_INSTANTS) as f64 {
            return;
        }
        let x = at - first;
        let mut weights = self.barycentric;
        let mut before = 1.0;
        for (j, weight) in weights.iter_mut().enumerate() {
            *weight *= before;
            before *= x - j as f64;
        }
        let mut after = 1.0;
        for (j, weight) in weights.iter_mut().enumerate().rev() {
            *weight *= after;
            after *= x - j as f64;
        }
        let rows = &self.table[first as usize * MOST_INSTANTS..][..POINTS * MOST_INSTANTS];
        for (row, weight) in rows.chunks_exact(MOST_INSTANTS).zip(weights) {
            for (sum, value) in out.iter_mut().zip(row) {
                *sum += value * weight;
            }
        }
    }
}

/// Points (seconds from mid-pulse) and weights of an integral over the pulse: panels that no corner of the taper crosses.
fn quadrature(pulse: &Pulse, fastest_hz: f64) -> Vec<(f64, f64)> {
    let half_s = 0.5 * pulse.duration_s;
    let flank_s = 0.5 * pulse.taper * pulse.duration_s;
    let corners = [-half_s, flank_s - half_s, half_s - flank_s, half_s];
    let rule = gauss_legendre();
    let mut all = Vec::new();
    for piece in corners.windows(2) {
        let length_s = piece[1] - piece[0];
        if length_s <= 0.0 {
            continue;
        }
        let panels = (length_s * fastest_hz / CYCLES_PER_PANEL).ceil().max(1.0) as usize;
        let panel_s = length_s / panels as f64;
        for p in 0..panels {
            let middle_s = piece[0] + (p as f64 + 0.5) * panel_s;
            all.extend(
                rule.iter()
                    .map(|(x, w)| (middle_s + 0.5 * panel_s * x, 0.5 * panel_s * w)),
            );
        }
    }
    all
}

/// Gauss and Legendre's points and weights on -1..1, by Newton's method on the polynomial's recurrence.
fn gauss_legendre() -> [(f64, f64); PANEL] {
    let n = PANEL as f64;
    std::array::from_fn(|i| {
        let mut x = libm::cos(PI * (i as f64 + 0.75) / (n + 0.5));
        let mut slope = 0.0;
        for _ in 0..8 {
            let (mut before, mut now) = (1.0, x);
            for k in 2..=PANEL {
                let k = k as f64;
                (before, now) = (now, ((2.0 * k - 1.0) * x * now - (k - 1.0) * before) / k);
            }
            slope = n * (x * now - before) / (x * x - 1.0);
            x -= now / slope;
        }
        (x, 2.0 / ((1.0 - x * x) * slope * slope))
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::flow::PulseKind;

    fn pulse(kind: PulseKind, taper: f64) -> Pulse {
        Pulse {
            kind,
            center_frequency_hz: 400e3,
            bandwidth_hz: if kind == PulseKind::Cw { 0.0 } else { 30e3 },
            duration_s: 5e-3,
            taper,
        }
    }

    #[test]
    fn a_plain_burst_has_its_sinc_to_1e_10_and_so_have_its_moments() {
        let duration_s = 5e-3;
        let spectra = PulseSpectra::new(&pulse(PulseKind::Cw, 0.0), 20e3);
        let mut got = [Complex64::ZERO; 2];
        let mut worst: f64 = 0.0;
        for k in 1..4000 {
            let g_hz = -20e3 + 10.01 * k as f64;
            spectra.read(g_hz, &mut got);
            // The burst, and its first moment.
            let (burst, moment) = (got[0], got[1] * 0.5 * duration_s);
            let x = PI * g_hz * duration_s;
            let want = duration_s * x.sin() / x;
            let want_moment =
                Complex64::I * duration_s * duration_s * 0.5 / x * (x.cos() - x.sin() / x);
            worst = worst
                .max((burst - want).norm() / duration_s)
                .max((moment - want_moment).norm() / duration_s.powi(2));
        }
        println!("worst {worst:.1e}");
        assert!(worst < 1e-10, "{worst:e}");
    }

    #[test]
    fn a_chirp_meets_the_plain_sum_to_1e_9() {
        for (kind, taper) in [
            (PulseKind::LfmUp, 0.0),
            (PulseKind::LfmDown, 0.1),
            (PulseKind::LfmUp, 1.0),
        ] {
            let pulse = pulse(kind, taper);
            let spectra = PulseSpectra::new(&pulse, 20e3);
            let instants = Instants::new(3);
            let mut got = [Complex64::ZERO; 3];
            let mut worst: f64 = 0.0;
            for g_hz in [-19.9e3, -15.003e3, -3.3e3, 0.1, 7.77e3, 15e3] {
                spectra.read(g_hz, &mut got);
                // Midpoints: their error is that of the edges, quadratic in the step.
                let steps = 400_000;
                let step_s = pulse.duration_s / f64::from(steps);
                let want: Complex64 = (0..steps)
                    .map(|k| {
                        let t_s = (f64::from(k) + 0.5) * step_s;
                        let turns = -g_hz * (t_s - 0.5 * pulse.duration_s);
                        pulse.envelope(t_s) * Complex64::from_polar(step_s, TAU * turns)
                    })
                    .sum();
                // Lagrange's polynomials add up to 1.
                let burst: Complex64 = (0..9).map(|i| got[i % 3] * instants.share[i]).sum();
                worst = worst.max((burst - want).norm() / pulse.duration_s);
            }
            println!("{kind:?} {taper}: {worst:.1e}");
            assert!(worst < 1e-9, "{kind:?}, taper {taper}: {worst:e}");
        }
    }

    #[test]
    fn beyond_the_tables_there_is_nothing_and_no_panic() {
        let spectra = PulseSpectra::new(&pulse(PulseKind::Cw, 0.0), 1e3);
        let mut got = [Complex64::ONE];
        for g_hz in [1e9, -1e9, f64::NAN, f64::INFINITY] {
            spectra.read(g_hz, &mut got);
            assert_eq!(got[0], Complex64::ZERO);
        }
    }
}

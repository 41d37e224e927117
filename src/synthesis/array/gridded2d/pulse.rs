//! Spectra of the pulse weighted by Chebyshev polynomials of the emission time.
//!
//! Any quantity that varies smoothly during the emission is a short Chebyshev series in the
//! emission time x = 2w/T, with w from mid-pulse. The pulse therefore enters only through S_n(g) =
//! integral of a(w) T_n(x) exp(-j 2pi g w) dw, n = 0, 1, ... These tables depend on the pulse
//! alone. The motion of a ping only changes the Doppler-shifted frequency at which they are read,
//! so templates are cheap to compute for every ping.

use std::f64::consts::{PI, TAU};

use num_complex::Complex64;

use echotank_core::pulse::Pulse;

use super::sample::Sample;

/// Nodes of one quadrature panel, for at most [`CYCLES_PER_PANEL`] cycles of the fastest phase;
/// exact to rounding.
const PANEL: usize = 16;
const CYCLES_PER_PANEL: f64 = 2.0;

/// Chebyshev points of the first kind, -1..1.
pub(crate) fn chebyshev_nodes(count: usize) -> impl Iterator<Item = f64> {
    (0..count).map(move |i| -libm::cos(PI * (i as f64 + 0.5) / count as f64))
}

/// Terms in the tables, which is also the maximum number of emission instants.
pub(crate) const MAX_INSTANTS: usize = 24;

/// Chebyshev polynomial T_n(x) for -1 <= x <= 1.
pub fn chebyshev(n: usize, x: f64) -> f64 {
    libm::cos(n as f64 * libm::acos(x.clamp(-1.0, 1.0)))
}

/// Tables of S_n, interpolated for many neighbouring bins at once (Farrow 1988).
///
/// The step of the tables is the bin spacing over a whole number, `phases`. Apart from the Doppler
/// stretch of the bins, a thousandth, all bins of a block therefore lie at the same fraction x of a
/// step. There S_n is a polynomial in x, and the tables hold its coefficients: Lagrange
/// interpolation through [`Reading::POINTS`] neighbours.
pub(crate) struct PulseSpectra<T> {
    pulse: Pulse,
    bin_hz: f64,
    phases: usize,
    first_hz: f64,
    /// Entries of one phase.
    count: usize,
    /// `[n][phase][power][entry]`, real and imaginary parts apart.
    re: Vec<T>,
    im: Vec<T>,
}

/// Interpolation accuracy for one precision.
pub trait Reading: Copy + Default {
    /// Table entries per 1/T.
    const DENSITY: f64;
    /// Points of interpolation.
    const POINTS: usize;
}

/// Error 6e-7 of the peak of the spectrum.
impl Reading for f32 {
    const DENSITY: f64 = 8.0;
    const POINTS: usize = 8;
}

/// Error 2e-11 of the peak of the spectrum.
impl Reading for f64 {
    const DENSITY: f64 = 16.0;
    const POINTS: usize = 10;
}

impl<T: Sample> PulseSpectra<T> {
    /// Tables for frequencies from -`reach_hz` to `reach_hz` about the centre, read at bins
    /// `bin_hz` apart.
    pub(crate) fn new(pulse: &Pulse, reach_hz: f64, bin_hz: f64) -> Self {
        let half_s = 0.5 * pulse.duration_s;
        let phases = (T::DENSITY * pulse.duration_s * bin_hz).ceil().max(1.0) as usize;
        let step_hz = bin_hz / phases as f64;
        // Margin for a block beyond either end.
        let margin = 2 * (T::POINTS + phases * MAX_LANES);
        let steps = (2.0 * reach_hz / step_hz).ceil() as usize + margin;
        let count = steps.div_ceil(phases);
        let steps = count * phases;
        let first_hz = -0.5 * steps as f64 * step_hz;
        let mut samples = vec![Complex64::ZERO; (steps + T::POINTS) * MAX_INSTANTS];
        let before = (T::POINTS / 2 - 1) as f64;
        let fastest_hz = -first_hz + 0.5 * pulse.bandwidth_hz;
        for (w_s, weight) in quadrature(pulse, fastest_hz) {
            let value = pulse.envelope(w_s + half_s) * weight;
            let shares: [Complex64; MAX_INSTANTS] =
                std::array::from_fn(|n| value * chebyshev(n, w_s / half_s));
            // Restarting the recurrence every forty steps keeps rounding at 1e-14.
            let turn = Complex64::from_polar(1.0, -TAU * step_hz * w_s);
            let mut phasor = Complex64::ONE;
            for (i, row) in samples.chunks_exact_mut(MAX_INSTANTS).enumerate() {
                if i % 40 == 0 {
                    let g_hz = first_hz + (i as f64 - before) * step_hz;
                    phasor = Complex64::from_polar(1.0, -TAU * g_hz * w_s);
                }
                for (sum, share) in row.iter_mut().zip(&shares) {
                    *sum += share * phasor;
                }
                phasor *= turn;
            }
        }
        let lagrange = lagrange_powers(T::POINTS);
        let len = MAX_INSTANTS * phases * T::POINTS * count;
        let (mut re, mut im) = (Vec::with_capacity(len), Vec::with_capacity(len));
        for n in 0..MAX_INSTANTS {
            for phase in 0..phases {
                for powers in &lagrange {
                    for entry in 0..count {
                        let at = entry * phases + phase;
                        let sum: Complex64 = powers
                            .iter()
                            .enumerate()
                            .map(|(j, share)| samples[(at + j) * MAX_INSTANTS + n] * share)
                            .sum();
                        re.push(T::narrow(sum.re));
                        im.push(T::narrow(sum.im));
                    }
                }
            }
        }
        Self {
            pulse: *pulse,
            bin_hz,
            phases,
            first_hz,
            count,
            re,
            im,
        }
    }

    /// Whether the tables are those of `pulse` and reach as far.
    pub(crate) fn is_of(&self, pulse: &Pulse, reach_hz: f64) -> bool {
        self.pulse == *pulse
            && -self.first_hz >= reach_hz + self.bin_hz * (MAX_LANES + T::POINTS) as f64
    }

    /// Position in the tables of `LANES` bins that are `stretch` bins apart, with their middle
    /// (between the central lanes) at `middle_hz`. None beyond the tables.
    #[inline(always)]
    pub(crate) fn place<const LANES: usize>(
        &self,
        middle_hz: f64,
        stretch: f64,
    ) -> Option<Place<T, LANES>> {
        let half = 0.5 * (LANES as f64 - 1.0);
        let per_bin = self.phases as f64;
        let at = (middle_hz - self.first_hz) / self.bin_hz * per_bin;
        // The fraction of a step at the middle, and the first step of lane 0.
        let first = (at - half * per_bin).floor();
        let fraction = at - half * per_bin - first;
        let end = (self.count * self.phases) as f64 - per_bin * LANES as f64;
        if first.is_nan() || first < 0.0 || first >= end {
            return None;
        }
        let first = first as usize;
        let x = std::array::from_fn(|lane| {
            T::narrow(fraction - 0.5 + (lane as f64 - half) * (stretch - 1.0) * per_bin)
        });
        Some(Place {
            phase: first % self.phases,
            entry: first / self.phases,
            x,
        })
    }

    /// S_n at this position.
    #[inline(always)]
    pub(crate) fn read<const LANES: usize, const FUSED: bool>(
        &self,
        n: usize,
        place: &Place<T, LANES>,
        re: &mut [T; LANES],
        im: &mut [T; LANES],
    ) {
        let table = (n * self.phases + place.phase) * T::POINTS * self.count + place.entry;
        for power in (0..T::POINTS).rev() {
            let at = table + power * self.count;
            let (of_re, of_im) = (&self.re[at..][..LANES], &self.im[at..][..LANES]);
            for j in 0..LANES {
                re[j] = re[j].times_plus::<FUSED>(place.x[j], of_re[j]);
                im[j] = im[j].times_plus::<FUSED>(place.x[j], of_im[j]);
            }
        }
    }
}

/// Maximum number of bins read at once.
const MAX_LANES: usize = 32;

/// Position of a block of bins in the tables.
pub struct Place<T, const LANES: usize> {
    phase: usize,
    entry: usize,
    x: [T; LANES],
}

/// Lagrange polynomials of the points -(P/2 - 1) ... P/2 in powers of x - 1/2: `[power][point]`.
fn lagrange_powers(points: usize) -> Vec<Vec<f64>> {
    let place = |j: usize| j as f64 - (points / 2 - 1) as f64 - 0.5;
    let mut all = vec![vec![0.0; points]; points];
    for j in 0..points {
        let mut powers = vec![0.0; points];
        powers[0] = 1.0;
        for i in (0..points).filter(|&i| i != j) {
            // Multiplies by (x - place(i)) / (place(j) - place(i)).
            let scale = 1.0 / (place(j) - place(i));
            for k in (0..points).rev() {
                let lower = if k > 0 { powers[k - 1] } else { 0.0 };
                powers[k] = (lower - place(i) * powers[k]) * scale;
            }
        }
        for (row, power) in all.iter_mut().zip(powers) {
            row[j] = power;
        }
    }
    all
}

/// Points (seconds from mid-pulse) and weights of an integral over the pulse, on panels bounded at
/// the corners of the taper.
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

/// Gauss-Legendre points and weights on -1..1, by Newton's method on the polynomial's recurrence.
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
    use echotank_core::pulse::PulseKind;

    const BIN_HZ: f64 = 25.4;

    fn pulse(kind: PulseKind, taper: f64) -> Pulse {
        Pulse {
            kind,
            center_frequency_hz: 400e3,
            bandwidth_hz: if kind == PulseKind::Cw { 0.0 } else { 30e3 },
            duration_s: 5e-3,
            taper,
        }
    }

    /// S_0 ... at bins from -20 to 20 kHz, stretched by a thousandth: (frequency, values).
    fn read<T: Sample>(spectra: &PulseSpectra<T>) -> Vec<(f64, [Complex64; 3])> {
        const STRETCH: f64 = 1.001;
        let mut all = Vec::new();
        for block in -49..49 {
            let middle_hz = (f64::from(block) * 16.0 + 0.37) * BIN_HZ * STRETCH;
            let place = spectra.place::<16>(middle_hz, STRETCH).expect("in reach");
            let mut values = [[[T::ZERO; 16]; 2]; 3];
            for (n, [re, im]) in values.iter_mut().enumerate() {
                spectra.read::<16, false>(n, &place, re, im);
            }
            for lane in 0..16 {
                let g_hz = middle_hz + (lane as f64 - 7.5) * BIN_HZ * STRETCH;
                let at = |n: usize| {
                    let [re, im] = &values[n];
                    Complex64::new(re[lane].widen(), im[lane].widen())
                };
                all.push((g_hz, [at(0), at(1), at(2)]));
            }
        }
        all
    }

    #[test]
    fn a_rectangular_burst_has_a_sinc_spectrum_and_its_first_moment() {
        fn worst<T: Sample>() -> f64 {
            let duration_s = 5e-3;
            let spectra = PulseSpectra::<T>::new(&pulse(PulseKind::Cw, 0.0), 21e3, BIN_HZ);
            let mut worst: f64 = 0.0;
            for (g_hz, [burst, moment, _]) in read(&spectra) {
                let x = PI * g_hz * duration_s;
                let want = x.sin() / x;
                let want_moment = Complex64::I / x * (x.cos() - x.sin() / x);
                worst = worst
                    .max((burst / duration_s - want).norm())
                    .max((moment / duration_s - want_moment).norm());
            }
            worst
        }
        let (narrow, wide) = (worst::<f32>(), worst::<f64>());
        println!("f32 {narrow:.1e}, f64 {wide:.1e}");
        assert!(
            narrow < 2e-6 && wide < 2e-10,
            "f32 {narrow:e}, f64 {wide:e}"
        );
    }

    #[test]
    fn a_chirp_matches_the_plain_sum_to_1e_9() {
        for (kind, taper) in [
            (PulseKind::LfmUp, 0.0),
            (PulseKind::LfmDown, 0.1),
            (PulseKind::LfmUp, 1.0),
        ] {
            let pulse = pulse(kind, taper);
            let spectra = PulseSpectra::<f64>::new(&pulse, 21e3, BIN_HZ);
            let mut worst: f64 = 0.0;
            for (g_hz, [burst, ..]) in read(&spectra).into_iter().step_by(131) {
                // Midpoint rule; its error is that of the edges, quadratic in the step.
                let steps = 400_000;
                let step_s = pulse.duration_s / f64::from(steps);
                let want: Complex64 = (0..steps)
                    .map(|k| {
                        let t_s = (f64::from(k) + 0.5) * step_s;
                        let turns = -g_hz * (t_s - 0.5 * pulse.duration_s);
                        pulse.envelope(t_s) * Complex64::from_polar(step_s, TAU * turns)
                    })
                    .sum();
                worst = worst.max((burst - want).norm() / pulse.duration_s);
            }
            println!("{kind:?} {taper}: {worst:.1e}");
            assert!(worst < 1e-9, "{kind:?}, taper {taper}: {worst:e}");
        }
    }

    #[test]
    fn positions_beyond_the_tables_are_none() {
        let spectra = PulseSpectra::<f64>::new(&pulse(PulseKind::Cw, 0.0), 1e3, BIN_HZ);
        for g_hz in [1e9, -1e9, f64::NAN, f64::INFINITY] {
            assert!(spectra.place::<32>(g_hz, 1.0).is_none());
        }
        assert!(spectra.place::<32>(1e3, 1.0).is_some());
        assert!(spectra.place::<32>(-1e3, 1.0).is_some());
    }
}

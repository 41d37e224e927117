//! Fan of far-field beams from a uniform line array: matched-filtered delay-and-sum in the frequency domain.
//!
//! A plane wave from angle theta arrives at element e at t - x_e sin(theta)/c, where t is the arrival at the array's centre. Its envelope
//! about f_c therefore has the spectrum S(f) exp(j 2pi (f + f_c) x_e sin(theta)/c). Beam b removes this phase at every frequency of the
//! pulse:
//!
//! ```text
//! Y_b(f) = conj(A(f)) sum_e w_e X_e(f) exp(-j 2pi (f + f_c) x_e sin(theta_b)/c),    sum_e w_e = 1
//! ```
//!
//! This is a true time delay: beams do not squint over the band, and sample k of a beam is the leading edge at the *array's centre*. Each
//! element needs one forward transform and each beam one inverse transform. The sum over equally spaced elements is a polynomial in z =
//! exp(-j 2pi (f + f_c) d sin(theta_b)/c). It is evaluated by Horner's rule on tiles of a few frequencies that stay in the first-level
//! cache.
//!
//! Angles are measured from the boresight and are positive to starboard, whichever way the array's x axis points. An array whose +x end is
//! to port is processed in reverse order. (An array without an across-track component keeps +x positive.)
//!
//! Not modelled: near-field focus, motion between transmission and reception. The samples contain the element patterns.

use std::f64::consts::{PI, TAU};

use num_complex::{Complex32, Complex64};
use rayon::prelude::*;

use super::steered::{Band, SteeredArray};
use echotank_core::ping::{BeamFrame, ElementFrame, PingPlan};

/// Number of frequencies processed together in the inner loop: their sums and phasors fit sixteen 128-bit registers.
const TILE: usize = 4;
/// Number of beams that share one gathering of the elements' spectra.
const GROUP: usize = 16;
/// Phasors are advanced by multiplication and recomputed after this many tiles, which keeps their rounding error below 1e-13.
const RESEED_TILES: usize = 128;
/// Far-field fan of one receive array.
pub struct FanFormer {
    steered: SteeredArray,
    /// Element-major spectra, weighted and matched-filtered.
    spectra: Vec<Complex64>,
    workers: Vec<Worker>,
}

/// Buffers of one share of the work.
struct Worker {
    /// [`GROUP`] beam spectra in sequence.
    beams: Vec<Complex64>,
    /// One tile of all elements: real parts, then imaginary parts of each.
    tile: Vec<[[f64; TILE]; 2]>,
    scratch: Vec<Complex64>,
}

impl FanFormer {
    /// Work is shared among the threads of the current pool.
    pub(super) fn new(steered: SteeredArray) -> Self {
        let length = steered.correlator.length();
        let (elements, beams) = (steered.elements(), steered.beams());
        let workers = rayon::current_num_threads().clamp(1, beams);
        Self {
            spectra: vec![Complex64::ZERO; length * elements],
            workers: (0..workers)
                .map(|_| Worker {
                    beams: vec![Complex64::ZERO; length * GROUP.min(beams)],
                    tile: vec![[[0.0; TILE]; 2]; elements],
                    scratch: steered.correlator.make_scratch(),
                })
                .collect(),
            steered,
        }
    }

    /// Index of the fan's receive array.
    pub fn array(&self) -> usize {
        self.steered.array()
    }

    /// Forms the beams of one ping. `frame` holds the samples of the fan's array; `out` grows once to its maximum size and is reused.
    pub fn form(&mut self, plan: &PingPlan, frame: &ElementFrame, out: &mut BeamFrame) {
        self.steered.begin(plan, frame);
        self.steered.size(frame.samples, out);
        if frame.samples == 0 {
            return;
        }
        self.transform_elements(frame);
        self.sum_beams(frame.samples, &mut out.iq);
    }

    fn transform_elements(&mut self, frame: &ElementFrame) {
        let (correlator, weights) = (&self.steered.correlator, &self.steered.weights);
        let length = correlator.length();
        let share = weights.len().div_ceil(self.workers.len());
        self.spectra
            .par_chunks_mut(share * length)
            .zip(&mut self.workers)
            .enumerate()
            .for_each(|(w, (spectra, worker))| {
                for (i, spectrum) in spectra.chunks_exact_mut(length).enumerate() {
                    let e = w * share + i;
                    let (head, tail) = spectrum.split_at_mut(frame.samples);
                    for (to, from) in head.iter_mut().zip(frame.element(e)) {
                        *to = from * weights[e];
                    }
                    tail.fill(Complex64::ZERO);
                    correlator.forward(spectrum, &mut worker.scratch);
                }
            });
    }

    fn sum_beams(&mut self, samples: usize, out: &mut [Complex32]) {
        let (correlator, spectra) = (&self.steered.correlator, &self.spectra);
        let (length, band) = (correlator.length(), self.steered.band());
        let sines = &self.steered.directions.sine;
        let share = sines.len().div_ceil(self.workers.len());
        // Cycles per element spacing, per unit of sine and hertz.
        let spacing_s = self.steered.spacing_m() / self.steered.sound_speed_m_per_s;
        out.par_chunks_mut(share * samples)
            .zip(sines.par_chunks(share))
            .zip(&mut self.workers)
            .for_each(|((rows, sines), worker)| {
                for (rows, sines) in rows.chunks_mut(GROUP * samples).zip(sines.chunks(GROUP)) {
                    steer(&band, spectra, spacing_s, sines, worker);
                    for (row, beam) in rows
                        .chunks_exact_mut(samples)
                        .zip(worker.beams.chunks_exact_mut(length))
                    {
                        correlator.inverse(beam, &mut worker.scratch);
                        for (to, y) in row.iter_mut().zip(&beam[..samples]) {
                            *to = Complex32::new(y.re as f32, y.im as f32);
                        }
                    }
                }
            });
    }
}

/// Phasors of one beam over one tile of frequencies.
#[derive(Clone, Copy)]
struct Steering {
    /// From one element to the next.
    next: Phasors,
    /// From the first element to the array's centre.
    center: Phasors,
}

#[derive(Clone, Copy)]
struct Phasors {
    now: [Complex64; TILE],
    /// From one tile to the next.
    step: Complex64,
}

impl Phasors {
    /// exp(-j 2pi f delay) for the tile that begins with bin `first`.
    fn at(band: &Band, first: usize, delay_s: f64) -> Self {
        let turn = |hz: f64| {
            let cycles = hz * delay_s;
            Complex64::from_polar(1.0, -TAU * (cycles - cycles.round()))
        };
        Self {
            now: std::array::from_fn(|i| turn(band.frequency_hz(first + i))),
            step: turn(band.step_hz * TILE as f64),
        }
    }
    fn advance(&mut self) {
        for z in &mut self.now {
            *z *= self.step;
        }
    }
}

/// Sums the elements' spectra for up to [`GROUP`] beams into `worker.beams`.
fn steer(band: &Band, spectra: &[Complex64], spacing_s: f64, sines: &[f64], worker: &mut Worker) {
    let length = band.length;
    let to_center = -(worker.tile.len() as f64 - 1.0) / 2.0;
    let idle = Phasors {
        now: [Complex64::ZERO; TILE],
        step: Complex64::ZERO,
    };
    let mut steering = [Steering {
        next: idle,
        center: idle,
    }; GROUP];
    for t in 0..length / TILE {
        let first = t * TILE;
        let seed = t % RESEED_TILES == 0 || first == length / 2;
        for (e, tile) in worker.tile.iter_mut().enumerate() {
            let from = &spectra[e * length + first..][..TILE];
            *tile = [
                std::array::from_fn(|i| from[i].re),
                std::array::from_fn(|i| from[i].im),
            ];
        }
        for (b, &sine) in sines.iter().enumerate() {
            let s = &mut steering[b];
            if seed {
                let delay_s = spacing_s * sine;
                s.next = Phasors::at(band, first, delay_s);
                s.center = Phasors::at(band, first, delay_s * to_center);
            } else {
                s.next.advance();
                s.center.advance();
            }
            let [re, im] = polynomial(&worker.tile, &s.next.now);
            let beam = &mut worker.beams[b * length + first..][..TILE];
            for i in 0..TILE {
                beam[i] = Complex64::new(re[i], im[i]) * s.center.now[i];
            }
        }
    }
}

/// sum_e tile[e] z^e for [`TILE`] values of z by Horner's rule: real parts, imaginary parts.
#[inline]
fn polynomial(tile: &[[[f64; TILE]; 2]], z: &[Complex64; TILE]) -> [[f64; TILE]; 2] {
    let z_re: [f64; TILE] = std::array::from_fn(|i| z[i].re);
    let z_im: [f64; TILE] = std::array::from_fn(|i| z[i].im);
    let mut re = [0.0; TILE];
    let mut im = [0.0; TILE];
    for [x_re, x_im] in tile.iter().rev() {
        for i in 0..TILE {
            let turned = re[i] * z_re[i] - im[i] * z_im[i];
            im[i] = re[i] * z_im[i] + im[i] * z_re[i] + x_im[i];
            re[i] = turned + x_re[i];
        }
    }
    [re, im]
}

/// |sin(N x) / (N sin x)|, x = pi d sine / lambda: response of N equal elements (Dirichlet kernel).
pub fn line_array_response(elements: usize, spacing_wavelengths: f64, sine: f64) -> f64 {
    let n = elements as f64;
    let x = PI * spacing_wavelengths * sine;
    let x = x - PI * (x / PI).round();
    if x.abs() < 1e-9 {
        return 1.0;
    }
    ((n * x).sin() / (n * x.sin())).abs()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::beam::test_rig::{self, C, array, elements_of_plane_wave, limits, on_threads, tone};
    use echotank_config::spec::{FanSpec, Former, Shading};
    use echotank_core::arrays::ArrayGeometry;
    use echotank_core::pulse::{Pulse, PulseKind};
    use echotank_core::testing::plan_at_rest as plan;

    fn pulse(kind: PulseKind, center_hz: f64, bandwidth_hz: f64, duration_s: f64) -> Pulse {
        Pulse {
            center_frequency_hz: center_hz,
            ..test_rig::pulse(kind, bandwidth_hz, duration_s, 0.0)
        }
    }

    fn fan(beams: usize, sector_rad: f64, shading: Shading) -> FanSpec {
        test_rig::fan(beams, sector_rad, shading, Former::Exact)
    }

    struct Rig {
        rate_hz: f64,
        samples: usize,
        pulse: Pulse,
        array: ArrayGeometry,
    }

    impl Rig {
        fn former(&self, fan: &FanSpec) -> FanFormer {
            let limits = limits(self.rate_hz, self.samples, self.pulse.duration_s);
            let (array, weighting) = (&self.array, Shading::Uniform);
            let steered = SteeredArray::far_field(array, fan, limits, &self.pulse, weighting, C);
            FanFormer::new(steered)
        }
        fn beams(&self, fan: &FanSpec, frame: &ElementFrame) -> BeamFrame {
            let mut out = BeamFrame::default();
            self.former(fan)
                .form(&plan(&self.pulse, self.samples, C), frame, &mut out);
            out
        }
        fn tone(&self, sine: f64) -> ElementFrame {
            let hz = self.pulse.center_frequency_hz;
            tone(&self.array, self.samples, hz, sine)
        }
        /// Echo of the pulse from `sine` (array axes) whose leading edge arrives at the array's centre at `edge_s`.
        fn echo(&self, sine: f64, edge_s: f64) -> ElementFrame {
            elements_of_plane_wave(&self.array, self.rate_hz, self.samples, |e| {
                let delay = edge_s - self.array.along_m(e) * sine / C;
                (self.pulse, delay)
            })
        }
    }

    /// Elements half a wavelength apart at 300 kHz, across the track, x to starboard.
    fn narrow(elements: usize) -> Rig {
        let center_hz = 300e3;
        Rig {
            rate_hz: 20e3,
            samples: 1200,
            pulse: pulse(PulseKind::Cw, center_hz, 0.0, 20e-3),
            array: array(elements, 0.5 * C / center_hz, 90.0),
        }
    }

    /// Long tones from many directions, compared with the closed form sin(Nx)/(N sin x).
    #[test]
    fn beam_pattern_is_the_dirichlet_kernel_to_0p2_percent() {
        for (elements, beam_deg) in [(8, 0.0), (32, 0.0), (32, 35.0), (33, -50.0), (256, 0.0)] {
            let rig = narrow(elements);
            let spec = fan(3, 2.0 * f64::to_radians(beam_deg), Shading::Uniform);
            let beam_sine = f64::to_radians(beam_deg).sin();
            let mut former = rig.former(&spec);
            let mut out = BeamFrame::default();
            let mut worst = 0.0_f64;
            for i in 0..81 {
                let sine = -0.99 + i as f64 * 0.0247;
                let frame = rig.tone(sine);
                former.form(&plan(&rig.pulse, rig.samples, C), &frame, &mut out);
                let got = out.sample(2, 400).norm();
                let want = line_array_response(elements, 0.5, sine - beam_sine);
                worst = worst.max((got - want).abs());
            }
            println!("{elements} elements, {beam_deg} deg: worst {worst:.2e} of the peak");
            assert!(
                worst < 2e-3,
                "{elements} elements, beam at {beam_deg} deg: {worst:.2e}"
            );
        }
    }

    #[test]
    fn a_unit_plane_wave_on_a_beam_axis_peaks_at_one_on_its_leading_edge() {
        for shading in [Shading::Uniform, Shading::Hann] {
            let rig = wide();
            let spec = fan(5, f64::to_radians(120.0), shading);
            for (b, angle_deg) in [(0, -60.0), (1, -30.0), (2, 0.0), (4, 60.0)] {
                let edge = 200;
                let frame = rig.echo(f64::to_radians(angle_deg).sin(), edge as f64 / rig.rate_hz);
                let out = rig.beams(&spec, &frame);
                assert!((out.angle_rad[b].to_degrees() - angle_deg).abs() < 1e-12);
                let peak = out.sample(b, edge).norm();
                // The loss is the part of the pulse spectrum outside the sampled band, which fractional shifts cannot preserve.
                assert!((peak - 1.0).abs() < 0.01, "{shading:?} beam {b}: {peak}");
                let top = (0..out.samples)
                    .max_by(|&i, &j| out.sample(b, i).norm().total_cmp(&out.sample(b, j).norm()));
                assert_eq!(top, Some(edge), "{shading:?} beam {b}");
            }
        }
    }

    /// 100 kHz sweep about 200 kHz, 48 elements: off axis the echo needs seven samples to travel along the array.
    fn wide() -> Rig {
        let center_hz = 200e3;
        Rig {
            rate_hz: 160e3,
            samples: 900,
            pulse: pulse(PulseKind::LfmUp, center_hz, 100e3, 2e-3),
            array: array(48, 0.5 * C / 250e3, 90.0),
        }
    }

    /// A phase-steered beam would be smeared: at 60 degrees the ends of the band would appear 16 degrees apart.
    #[test]
    fn wideband_beams_do_not_squint() {
        let rig = wide();
        let spec = fan(3, f64::to_radians(120.0), Shading::Uniform);
        let edge = 300;
        let edge_s = edge as f64 / rig.rate_hz;
        let broadside = rig.beams(&spec, &rig.echo(0.0, edge_s));
        let slanted = rig.beams(&spec, &rig.echo(f64::to_radians(60.0).sin(), edge_s));
        let worst = (edge - 40..edge + 40)
            .map(|k| (broadside.sample(1, k) - slanted.sample(2, k)).norm())
            .fold(0.0, f64::max);
        println!("compressed pulse at 60 deg against broadside: {worst:.2e}");
        assert!(worst < 0.01, "{worst:.2e}");
    }

    #[test]
    fn the_strongest_beam_points_at_the_echo_and_negative_angles_are_port() {
        for (yaw_deg, sign) in [(90.0, 1.0), (-90.0, -1.0)] {
            let mut rig = wide();
            rig.array = array(48, 0.5 * C / 250e3, yaw_deg);
            let spec = fan(121, f64::to_radians(120.0), Shading::Hann);
            for starboard_deg in [-47.0, -3.0, 20.0, 58.0] {
                let sine = sign * f64::to_radians(starboard_deg).sin();
                let out = rig.beams(&spec, &rig.echo(sine, 300.0 / rig.rate_hz));
                let strongest = (0..out.beams)
                    .max_by(|&i, &j| {
                        out.sample(i, 300)
                            .norm()
                            .total_cmp(&out.sample(j, 300).norm())
                    })
                    .unwrap_or(0);
                let got_deg = out.angle_rad[strongest].to_degrees();
                assert!(
                    (got_deg - starboard_deg).abs() < 0.6,
                    "yaw {yaw_deg}: echo at {starboard_deg} deg, strongest beam at {got_deg:.2}"
                );
                assert!(out.angle_rad[0] < 0.0, "beam 0 is the most port beam");
            }
        }
    }

    /// Meng et al. 2023, Eq. 1: 50.8 deg lambda/(N d) (0.886 lambda/L) at broadside, wider by 1/cos off it.
    #[test]
    fn widths_match_equation_1_within_1_percent_for_16_elements_or_more() {
        for elements in [16, 64, 256] {
            let rig = narrow(elements);
            let out = rig.beams(
                &fan(3, f64::to_radians(80.0), Shading::Uniform),
                &rig.echo(0.0, 0.01),
            );
            let want = 0.886 / (elements as f64 * 0.5);
            assert!(
                (out.width_rad[1] / want - 1.0).abs() < 0.01,
                "{} {want}",
                out.width_rad[1]
            );
            let slanted = want / f64::to_radians(40.0).cos();
            assert!(
                (out.width_rad[2] / slanted - 1.0).abs() < 0.02,
                "{} {slanted}",
                out.width_rad[2]
            );
            // At the edges the response is half the power.
            let edge = (0.5 * out.width_rad[1]).sin();
            let level = line_array_response(elements, 0.5, edge);
            assert!((level - 0.5_f64.sqrt()).abs() < 1e-9, "{level}");
        }
    }

    #[test]
    fn widths_stay_finite_at_endfire_and_for_a_single_element() {
        for elements in [1, 2, 16] {
            let rig = narrow(elements);
            let out = rig.beams(&fan(3, PI, Shading::Uniform), &rig.echo(0.0, 0.01));
            for w in &out.width_rad {
                assert!(
                    w.is_finite() && *w > 0.0 && *w <= PI,
                    "{elements} elements: {w}"
                );
            }
        }
    }

    #[test]
    fn beams_are_bit_identical_on_one_thread_and_on_five() {
        let rig = wide();
        let spec = fan(37, 2.0, Shading::Hann);
        let frame = rig.echo(0.4, 0.001_234);
        let on = |threads: usize| on_threads(threads, || rig.beams(&spec, &frame));
        assert_eq!(on(1), on(5));
    }

    /// Delay-and-sum directly from the definition, for a pulse within the sampled band (a tapered, oversampled sweep).
    #[test]
    fn equals_delayed_sums_computed_from_the_definition() {
        let center_hz = 120e3;
        let rig = Rig {
            rate_hz: 200e3,
            samples: 700,
            pulse: Pulse {
                taper: 0.5,
                ..pulse(PulseKind::LfmDown, center_hz, 30e3, 1e-3)
            },
            array: array(12, 0.011, 90.0),
        };
        let spec = fan(7, 1.4, Shading::Hann);
        let sine = 0.31;
        let edge_s = 0.001_3;
        let out = rig.beams(&spec, &rig.echo(sine, edge_s));
        // Correlation of the pulse with itself at a lag, on the same samples.
        let n = (rig.pulse.duration_s * rig.rate_hz).round() as usize + 1;
        let energy: f64 = (0..n)
            .map(|i| rig.pulse.envelope(i as f64 / rig.rate_hz).norm_sqr())
            .sum();
        let auto = |lag_s: f64| -> Complex64 {
            (0..n)
                .map(|i| {
                    let t = i as f64 / rig.rate_hz;
                    rig.pulse.envelope(t + lag_s) * rig.pulse.envelope(t).conj()
                })
                .sum::<Complex64>()
                / energy
        };
        let weights: Vec<f64> = (0..12)
            .map(|e| (PI * (e as f64 + 0.5) / 12.0).sin().powi(2))
            .collect();
        let total: f64 = weights.iter().sum();
        let mut worst = 0.0_f64;
        for (b, angle) in out.angle_rad.iter().enumerate() {
            for k in 230..290 {
                let t = k as f64 / rig.rate_hz;
                let want: Complex64 = (0..12)
                    .map(|e| {
                        let shift = rig.array.along_m(e) * (sine - angle.sin()) / C;
                        let delay = edge_s - shift;
                        auto(t - delay)
                            * Complex64::from_polar(weights[e] / total, -TAU * center_hz * delay)
                    })
                    .sum();
                worst = worst.max((out.sample(b, k) - want).norm());
            }
        }
        println!("against the definition: {worst:.2e}");
        assert!(worst < 1e-4, "{worst:.2e}");
    }

    #[test]
    fn shorter_rows_and_pulses_need_no_new_memory() {
        let rig = wide();
        let spec = fan(9, 1.0, Shading::Uniform);
        let mut former = rig.former(&spec);
        let mut out = BeamFrame::default();
        let frame = rig.echo(0.2, 0.001);
        former.form(&plan(&rig.pulse, rig.samples, C), &frame, &mut out);
        let (place, room) = (out.iq.as_ptr(), out.iq.capacity());
        let short = Rig {
            samples: 300,
            pulse: Pulse {
                duration_s: 0.5e-3,
                ..rig.pulse
            },
            ..wide()
        };
        former.form(
            &plan(&short.pulse, 300, C),
            &short.echo(0.2, 0.0005),
            &mut out,
        );
        assert_eq!(out.iq.len(), 9 * 300);
        former.form(&plan(&rig.pulse, rig.samples, C), &frame, &mut out);
        assert_eq!((out.iq.as_ptr(), out.iq.capacity()), (place, room));
        assert_eq!(out, rig.beams(&spec, &frame));
    }
}

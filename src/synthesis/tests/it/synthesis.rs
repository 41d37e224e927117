use std::f64::consts::{PI, TAU};

use glam::{DQuat, DVec3};
use num_complex::Complex64;

use echotank_core::arrays::{ArrayGeometry, Pattern, TransmitArray};
use echotank_core::frames::{AttitudeKnot, Trajectory, VectorKnot};
use echotank_core::model::{DopplerModel, PathModel, Synthesis};
use echotank_core::ping::{EchoCounts, PingPlan};
use echotank_core::pulse::{Pulse, PulseKind};
use echotank_core::scene::{ScatterLaw, Scatterers};
use echotank_synthesis::array::{Decimator, Direct, oversample};
use echotank_synthesis::arrivals::{ArrivalChunk, ArrivalSink};
use echotank_synthesis::comparison::linear::Linear;
use echotank_synthesis::comparison::nearest::Nearest;
use echotank_synthesis::comparison::replica::Replica;
use echotank_synthesis::comparison::spectral::Bins;
use echotank_synthesis::comparison::spectral::Spectral;
use echotank_synthesis::comparison::spectral::Spectrum;
use echotank_synthesis::echo::Window;
use echotank_synthesis::echo::reference;
use echotank_synthesis::edges::EndWeights;

use crate::paths::restless;
use echotank_testing::echo::*;

/// Sample grid. Sample k is at `first_s + k / rate_hz`.
#[derive(Clone, Copy)]
struct Grid {
    rate_hz: f64,
    first_s: f64,
    count: usize,
}

impl Grid {
    /// Grid from slightly before an echo at `range_m` to slightly after it.
    fn around(range_m: f64, rate_hz: f64) -> Self {
        // The start time is odd, so that no edge is on a sample.
        Self {
            rate_hz,
            first_s: 2.0 * range_m / C - 1.234_567e-3,
            count: (8e-3 * rate_hz) as usize,
        }
    }
    /// Dense grid from which `filter` computes `count` samples.
    fn behind(filter: &Decimator, first_s: f64, count: usize) -> Self {
        Self {
            rate_hz: filter.dense_rate_hz(),
            first_s: filter.dense_first_s(first_s),
            count: filter.dense_len(count),
        }
    }
    fn time_s(&self, k: usize) -> f64 {
        self.first_s + k as f64 / self.rate_hz
    }
}

/// Transmitter, receiver and scatterers.
type Setup = (TransmitArray, ArrayGeometry, Scatterers);

/// One point in front of a transmitter and an element at the reference point.
fn one_point(at_m: DVec3) -> Setup {
    (
        transmitter(DVec3::ZERO),
        element(DVec3::ZERO),
        points([at_m]),
    )
}

type Sum = (Vec<Complex64>, EchoCounts);

/// Sum at one element without a filter.
type Method = fn(&PingPlan, &Setup, usize, Grid) -> Sum;

fn direct_with(
    plan: &PingPlan,
    (tx, rx, scatterers): &Setup,
    element: usize,
    grid: Grid,
    ends: Option<&EndWeights>,
) -> Sum {
    let mut out = vec![Complex64::ZERO; grid.count];
    let window = Window::of_samples(grid.first_s, grid.rate_hz, grid.count);
    let mut sink = Direct::new(plan, grid.rate_hz, grid.first_s, &mut out).with_ends(ends);
    let counts = walk(plan, tx, rx, element, window, scatterers, &mut sink);
    (out, counts)
}

fn direct(plan: &PingPlan, setup: &Setup, element: usize, grid: Grid) -> Sum {
    direct_with(plan, setup, element, grid, None)
}

/// Direct sum after a filter.
fn direct_behind(
    filter: &Decimator,
    plan: &PingPlan,
    setup: &Setup,
    element: usize,
    (first_s, count): (f64, usize),
) -> Vec<Complex64> {
    let grid = Grid::behind(filter, first_s, count);
    let (dense, _) = direct_with(plan, setup, element, grid, Some(filter.ends()));
    let mut out = vec![Complex64::ZERO; count];
    filter.apply(&dense, &mut out);
    out
}

fn truth(plan: &PingPlan, (tx, rx, scatterers): &Setup, element: usize, grid: Grid) -> Sum {
    let mut out = vec![Complex64::ZERO; grid.count];
    let (rate_hz, first_s) = (grid.rate_hz, grid.first_s);
    let counts = reference(
        plan, tx, rx, element, scatterers, None, rate_hz, first_s, &mut out,
    );
    (out, counts)
}

/// Reference after a filter for 40 kHz.
fn truth_behind(
    filter: &Decimator,
    plan: &PingPlan,
    (tx, rx, scatterers): &Setup,
    element: usize,
    (first_s, count): (f64, usize),
) -> Vec<Complex64> {
    let mut out = vec![Complex64::ZERO; count];
    let filter = Some(filter);
    reference(
        plan, tx, rx, element, scatterers, filter, 40e3, first_s, &mut out,
    );
    out
}

/// Largest phase difference. A sample at an edge may be on either side of the edge, so only samples that are non-zero in both are
/// compared.
fn max_phase_difference_rad(a: &[Complex64], b: &[Complex64]) -> f64 {
    a.iter()
        .zip(b)
        .filter(|(a, b)| a.norm() > 0.0 && b.norm() > 0.0)
        .map(|(a, b)| (a / b).arg().abs())
        .fold(0.0, f64::max)
}

fn peak(x: &[Complex64]) -> f64 {
    x.iter().map(|s| s.norm()).fold(0.0, f64::max)
}

fn worst_difference(a: &[Complex64], b: &[Complex64]) -> f64 {
    a.iter()
        .zip(b)
        .map(|(a, b)| (a - b).norm())
        .fold(0.0, f64::max)
}

/// Comparison with an independent implementation that uses only the types of the crate: one point, no motion.
#[test]
fn one_static_point_matches_the_direct_formula_in_both_methods() {
    let mut plan = ahead(0.0);
    let (tx_m, rx_m) = (DVec3::new(0.4, 0.0, 0.0), DVec3::new(-0.3, 0.1, 0.0));
    let at_m = DVec3::new(11.0, 70.0, 25.0);
    let (r1, r2) = ((at_m - tx_m).length(), (at_m - rx_m).length());
    let delay_s = (r1 + r2) / C;
    let amplitude = 10f64.powf(-0.05 * (r1 + r2) / 20.0) / (r1 * r2);
    let grid = Grid::around(at_m.length(), 100e3);
    for (kind, taper) in [
        (PulseKind::LfmUp, 0.0),
        (PulseKind::LfmDown, 0.3),
        (PulseKind::Cw, 0.1),
    ] {
        plan.pulse.kind = kind;
        plan.pulse.taper = taper;
        let (b, t) = (30e3, 5e-3);
        let want: Vec<Complex64> = (0..grid.count)
            .map(|k| {
                let s = grid.time_s(k) - delay_s;
                if !(0.0..=t).contains(&s) {
                    return Complex64::ZERO;
                }
                let sweep = match kind {
                    PulseKind::LfmUp => 1.0,
                    PulseKind::LfmDown => -1.0,
                    PulseKind::Cw => 0.0,
                };
                let near_end = s.min(t - s) / (0.5 * taper * t);
                let level = if near_end < 1.0 {
                    0.5 - 0.5 * (PI * near_end).cos()
                } else {
                    1.0
                };
                let phase = sweep * PI * (b / t) * (s - t / 2.0).powi(2)
                    - TAU * (CARRIER_HZ * delay_s).fract();
                Complex64::from_polar(amplitude * level, phase)
            })
            .collect();
        for (name, got) in [("direct", direct as Method), ("reference", truth as Method)] {
            let setup = (transmitter(tx_m), element(rx_m), points([at_m]));
            let (got, counts) = got(&plan, &setup, 0, grid);
            let error = worst_difference(&got, &want) / amplitude;
            assert!(error < 1e-9, "{name}, {kind:?}: {error:e}");
            assert_eq!(counts.used, 1);
        }
    }
}

/// A few hundred points, and two arrays with patterns, normals and both scattering laws.
pub(crate) fn busy() -> Setup {
    let mut tx = transmitter(DVec3::new(0.4, 0.0, 0.0));
    tx.pattern = Pattern::Rectangle {
        length_m: 0.01,
        width_m: 0.004,
        baffled: true,
    };
    tx.mounting.body_from_array = starboard();
    let mut rx = line(DVec3::new(-0.3, 0.1, 0.0), 8);
    rx.element_pattern = Pattern::Rectangle {
        length_m: 0.002,
        width_m: 0.004,
        baffled: true,
    };
    rx.mounting.body_from_array = starboard();
    let mut scatterers = points([]);
    for k in 0..300 {
        let at_m = DVec3::new(
            40.0 * (weyl(k, 0) - 0.5),
            20.0 + 60.0 * weyl(k, 1),
            25.0 + 3.0 * weyl(k, 2),
        );
        let strength = Complex64::from_polar(0.5 + weyl(k, 3), TAU * weyl(k, 2));
        let law = [ScatterLaw::Point, ScatterLaw::Lambert][k % 2];
        scatterers.push(at_m, [0.0, -0.28, -0.96], strength, law);
    }
    (tx, rx, scatterers)
}

#[test]
fn without_motion_direct_is_the_reference_to_1e_9() {
    let setup = busy();
    let mut plan = ahead(0.0);
    plan.pulse.taper = 0.1;
    let grid = Grid {
        rate_hz: 40e3,
        first_s: 0.0301,
        count: 4000,
    };
    let mut worst: f64 = 0.0;
    for element in [0, 3, 7] {
        let (got, counts) = direct(&plan, &setup, element, grid);
        let (want, want_counts) = truth(&plan, &setup, element, grid);
        assert_eq!(counts.outside_window, want_counts.outside_window);
        worst = worst.max(relative_l2(&got, &want));
    }
    println!("worst {worst:e}");
    assert!(worst < 1e-9, "{worst:e}");
}

/// The linear form leaves a phase of exactly 2 pi f v^2 sin^2(theta) s^2 / (r c) at time s into the pulse, with f the frequency
/// there.
#[test]
fn in_uniform_motion_direct_differs_from_the_reference_by_the_residual_phase() {
    for (v, r, theta_deg) in [
        (5.1, 75.0, 90.0),
        (5.0, 36.0, 60.0),
        (1.0, 20.0, 120.0),
        (10.0, 100.0, 20.0_f64),
    ] {
        let plan = ahead(v);
        let (sin, cos) = theta_deg.to_radians().sin_cos();
        let at_m = DVec3::new(r * cos, 0.8 * r * sin, 0.6 * r * sin);
        let grid = Grid::around(r, 200e3);
        let setup = one_point(at_m);
        let (got, _) = direct(&plan, &setup, 0, grid);
        let (want, _) = truth(&plan, &setup, 0, grid);
        // f is f_c + B/2 at the end of an up sweep. With f_c alone, the error exceeds the bound by 1.4 to 5 %.
        let bound = TAU * (CARRIER_HZ + 15e3) * (v * sin).powi(2) * 5e-3_f64.powi(2) / (r * C);
        let error = max_phase_difference_rad(&got, &want);
        println!("v {v}, r {r}, theta {theta_deg}: {error:.3e} rad, bound {bound:.3e}");
        assert!(
            error < 1.02 * bound && error > 0.95 * bound,
            "v {v}, r {r}, theta {theta_deg}: {error:e} rad, residual phase {bound:e}"
        );
        let sounding = want.iter().filter(|s| s.norm() > 0.0).count();
        assert!(sounding > 900, "{sounding}");
        let lone = got
            .iter()
            .zip(&want)
            .filter(|(a, b)| (a.norm() > 0.0) != (b.norm() > 0.0))
            .count();
        assert!(lone <= 1, "{lone} samples sound in one only");
    }
}

#[test]
fn near_a_tenth_of_the_speed_of_sound_delays_edges_and_amplitudes_still_agree() {
    let plan = ahead(148.0);
    let at_m = DVec3::new(60.0, 40.0, 20.0);
    let grid = Grid {
        rate_hz: 400e3,
        first_s: 0.0801,
        count: 12_000,
    };
    let setup = (
        transmitter(DVec3::ZERO),
        element(DVec3::new(-1.0, 0.0, 0.0)),
        points([at_m]),
    );
    let (got, counts) = direct(&plan, &setup, 0, grid);
    let (want, _) = truth(&plan, &setup, 0, grid);
    assert_eq!(counts.used, 1);
    let first = |x: &[Complex64]| x.iter().position(|s| s.norm() > 0.0).expect("an echo");
    let k = first(&want);
    assert_eq!(first(&got), k);
    assert!((got[k].norm() / want[k].norm() - 1.0).abs() < 1e-9);
    // Within microseconds of the leading edge, the linear form is exact.
    let phase = (got[k] / want[k]).arg().abs();
    assert!(phase < 1e-3, "{phase} rad");
    assert!(got.iter().all(|s| s.re.is_finite() && s.im.is_finite()));
}

/// Mean frequency of an echo: total phase over total time, on samples that are dense enough to unwrap.
fn mean_frequency_hz(x: &[Complex64], rate_hz: f64) -> f64 {
    let echo: Vec<_> = x.iter().filter(|s| s.norm() > 0.0).collect();
    let turned: f64 = echo.windows(2).map(|w| (w[1] / w[0]).arg()).sum();
    turned * rate_hz / (TAU * (echo.len() - 1) as f64)
}

#[test]
fn a_cw_echo_has_the_doppler_shift_of_mid_pulse_within_0p1_hz() {
    let v = 5.144;
    let mut plan = ahead(v);
    plan.pulse = cw(5e-3);
    for at_m in [
        DVec3::new(60.0, 50.0, 30.0),
        DVec3::new(-20.0, 70.0, 20.0),
        DVec3::new(150.0, 1.0, 1.0),
    ] {
        let grid = Grid::around(at_m.length(), 100e3);
        let setup = one_point(at_m);
        // eta at a time: transmitted at t', received near t' + 2 r / c.
        let eta = |emitted_s: f64| {
            let x_t = v * emitted_s;
            let r_t = (at_m - DVec3::X * x_t).length();
            let mut u = emitted_s + 2.0 * r_t / C;
            for _ in 0..50 {
                u = emitted_s + (r_t + (at_m - DVec3::X * (v * u)).length()) / C;
            }
            let cos_t = (at_m.x - x_t) / r_t;
            let cos_r = (at_m.x - v * u) / (at_m - DVec3::X * (v * u)).length();
            (C + v * cos_r) / (C - v * cos_t)
        };
        let (exact, _) = truth(&plan, &setup, 0, grid);
        let want = CARRIER_HZ * (eta(2.5e-3) - 1.0);
        let got = mean_frequency_hz(&exact, grid.rate_hz);
        println!("{at_m}: mid-pulse {want} Hz, reference {got} Hz");
        assert!((got - want).abs() < 0.1, "{at_m}: {got}, {want} Hz");
        let (linear, _) = direct(&plan, &setup, 0, grid);
        let want = CARRIER_HZ * (eta(0.0) - 1.0);
        let got = mean_frequency_hz(&linear, grid.rate_hz);
        assert!(
            (got - want).abs() < 1e-6,
            "{at_m}: direct {got}, leading edge {want} Hz"
        );
    }
}

/// Rotation alone moves an element on a lever arm by omega x arm. The reference includes this motion.
#[test]
fn a_turning_platform_shifts_the_echo_at_an_element_on_an_arm() {
    let mut plan = ahead(0.0);
    plan.pulse = cw(5e-3);
    let rate_rad_per_s = 0.2;
    plan.trajectory = Trajectory {
        position: vec![VectorKnot {
            time_s: 0.0,
            value: DVec3::ZERO,
            rate_per_s: DVec3::ZERO,
        }],
        heave: Vec::new(),
        attitude: vec![AttitudeKnot {
            time_s: 0.0,
            world_from_body: DQuat::IDENTITY,
            body_rate_rad_per_s: DVec3::Z * rate_rad_per_s,
        }],
        lever_arm_m: DVec3::ZERO,
    };
    let at_m = DVec3::new(0.0, 75.0, 0.0);
    let grid = Grid::around(75.0, 100e3);
    // One metre ahead, a turn to starboard moves the element towards the point. The speed is 0.2 m/s times the cosine of a tenth of
    // 0.2 rad.
    let setup = (transmitter(DVec3::ZERO), element(DVec3::X), points([at_m]));
    let (got, _) = truth(&plan, &setup, 0, grid);
    let received_s = 0.1 + 2.5e-3;
    let angle = rate_rad_per_s * received_s;
    let place = DVec3::new(angle.cos(), angle.sin(), 0.0);
    let velocity = rate_rad_per_s * DVec3::new(-angle.sin(), angle.cos(), 0.0);
    let want = CARRIER_HZ * velocity.dot((at_m - place).normalize()) / C;
    let got = mean_frequency_hz(&got, grid.rate_hz);
    assert!((got - want).abs() < 0.1, "{got}, {want} Hz");
    assert!(want > 50.0);
}

/// A compressed pulse moves by -(eta - 1) f_end T / (+-B), f_end = f_c +- B/2.
#[test]
fn doppler_moves_a_compressed_lfm_by_the_stated_range_within_1_percent() {
    let (v, r) = (5.2, 75.0);
    let rate_hz = 400e3;
    for (kind, sign) in [(PulseKind::LfmUp, 1.0), (PulseKind::LfmDown, -1.0)] {
        for along in [0.9, -0.5, 0.2] {
            let mut plan = ahead(v);
            plan.pulse.kind = kind;
            let (b, t) = (plan.pulse.bandwidth_hz, plan.pulse.duration_s);
            let at_m = DVec3::new(along, (1.0_f64 - along * along).sqrt(), 0.0) * r;
            let grid = Grid::around(r, rate_hz);
            let setup = one_point(at_m);
            let (sink, _) = collect(&plan, &setup.0, &setup.1, 0, ALWAYS, &setup.2);
            let arrival = sink.arrivals[0];
            let (x, _) = direct(&plan, &setup, 0, grid);
            // Correlation with the replica that starts `lag` seconds into the grid.
            let level = |start_s: f64| {
                let sum: Complex64 = x
                    .iter()
                    .enumerate()
                    .map(|(k, s)| s * plan.pulse.envelope(grid.time_s(k) - start_s).conj())
                    .sum();
                sum.norm()
            };
            let want_s = -arrival.doppler * (CARRIER_HZ + sign * b / 2.0) * t / (sign * b);
            let mut best = (0.0, 0.0);
            for i in -400..=400 {
                let shift_s = want_s + 1e-4 * i as f64 / 400.0;
                let got = level(arrival.delay_s + shift_s);
                if got > best.0 {
                    best = (got, shift_s);
                }
            }
            let error = (best.1 / want_s - 1.0).abs();
            println!("{kind:?} {along}: {} s, {want_s} s, {error:.2e}", best.1);
            assert!(error < 0.01, "{kind:?} {along}: {} s, {want_s} s", best.1);
        }
    }
}

#[test]
fn shorter_segments_reduce_the_error_on_a_moving_platform() {
    let mut plan = restless();
    // Transmitter and element are at the reference point. Attitude moves neither, so only the track has an effect.
    let at_m = DVec3::new(20.0, 90.0, 30.0);
    let setup = one_point(at_m);
    let grid = Grid::around(at_m.length(), 100e3);
    let (want, _) = truth(&plan, &setup, 0, grid);
    let errors = [2, 8, 32].map(|count| {
        chords(&mut plan, 0.256, count);
        let (got, _) = direct(&plan, &setup, 0, grid);
        worst_difference(&got[200..500], &want[200..500]) / peak(&want)
    });
    println!("{errors:?}");
    assert!(
        errors[1] < errors[0] / 4.0 && errors[2] < 0.05,
        "{errors:?}"
    );
}

#[test]
fn the_edges_of_the_record_cut_echoes_and_nothing_else() {
    let plan = ahead(3.0);
    let setup = busy();
    let long = Grid {
        rate_hz: 50e3,
        first_s: 0.03,
        count: 6000,
    };
    let (whole, _) = direct(&plan, &setup, 2, long);
    let (from, count) = (1500, 900);
    let part = Grid {
        first_s: long.time_s(from),
        count,
        ..long
    };
    let (cut, counts) = direct(&plan, &setup, 2, part);
    assert!(counts.outside_window > 50 && counts.used > 50, "{counts:?}");
    let error = worst_difference(&cut, &whole[from..from + count]) / peak(&whole);
    assert!(error < 1e-10, "{error:e}");
    // After the last echo the samples are zero.
    let after = Grid {
        first_s: 0.5,
        ..part
    };
    let (silent, counts) = direct(&plan, &setup, 2, after);
    assert!(peak(&silent) == 0.0 && counts.used == 0);
}

/// Largest error of any window of a pulse, or 32 samples, over that window or a floor 55 dB below the strongest window.
fn windowed(got: &[Complex64], want: &[Complex64], pulse: &Pulse) -> f64 {
    let window = ((pulse.duration_s * 40e3).ceil() as usize).max(32);
    let energies = |samples: Vec<Complex64>| -> Vec<f64> {
        let windows = samples.windows(window);
        windows
            .map(|w| w.iter().map(|x| x.norm_sqr()).sum())
            .collect()
    };
    let off = energies(got.iter().zip(want).map(|(g, w)| g - w).collect());
    let all = energies(want.to_vec());
    let floor = all.iter().copied().fold(0.0, f64::max) * 10f64.powf(-5.5);
    let shares = off.iter().zip(&all).map(|(off, all)| off / all.max(floor));
    shares.fold(0.0, f64::max).sqrt()
}

/// A point at rest after the filter: `reference` and `direct` against the integral in a form of its own, with hundreds of panels for every sample.
#[test]
fn reference_and_direct_meet_the_integral_of_the_filter_in_every_window() {
    let cw = |duration_s: f64| Pulse {
        kind: PulseKind::Cw,
        bandwidth_hz: 0.0,
        ..lfm(0.0, duration_s)
    };
    for (pulse, taper) in [
        (lfm(24e3, 1e-3), 0.0),
        (lfm(20e3, 0.27e-3), 0.1),
        (lfm(20e3, 2e-3), 0.1),
        (cw(10e-3), 0.0),
        (cw(1.1e-3), 0.5),
    ] {
        let pulse = Pulse { taper, ..pulse };
        let mut plan = ahead(0.0);
        plan.pulse = pulse;
        let points = oversample(&pulse, 40e3, Synthesis::Direct);
        let filter = Decimator::new(&pulse, 40e3, 300.0, points).expect("40 kHz is enough");
        let setup = one_point(DVec3::Y * 37.123_4);
        let delay_s = 2.0 * 37.123_4 / C;
        let count = (pulse.duration_s * 40e3) as usize + 6 * filter.dense_len(1) / points;
        let first_s = delay_s - 2.0 * filter.half_s();
        let want: Vec<_> = (0..count)
            .map(|n| independent::sample(&pulse, 300.0, first_s + n as f64 / 40e3 - delay_s))
            .collect();
        let scale = {
            let exact = truth_behind(&filter, &plan, &setup, 0, (first_s, count));
            let k = (0..count).max_by(|&i, &j| want[i].norm().total_cmp(&want[j].norm()));
            let k = k.expect("samples");
            exact[k] / want[k]
        };
        let want: Vec<_> = want.iter().map(|x| x * scale).collect();
        let exact = truth_behind(&filter, &plan, &setup, 0, (first_s, count));
        let direct = direct_behind(&filter, &plan, &setup, 0, (first_s, count));
        let errors = [&exact, &direct].map(|got| windowed(got, &want, &pulse));
        println!(
            "{points} points a sample, {pulse:?}: reference {:.1e}, direct {:.1e}",
            errors[0], errors[1]
        );
        assert!(errors[0] < 1e-8 && errors[1] < 1e-4, "{errors:?}");
    }
}

/// The integral of the filter's response times an echo at rest, from their definitions.
mod independent {
    use super::*;

    /// Modified Bessel function of order 0, by its integral over half a turn: the trapezoidal rule converges geometrically.
    fn bessel_i0(x: f64) -> f64 {
        let terms = (0..64).map(|k| (x * (PI * (f64::from(k) + 0.5) / 64.0).cos()).exp());
        terms.sum::<f64>() / 64.0
    }

    /// Sample at `t_s` after the leading edge.
    pub(super) fn sample(pulse: &Pulse, doppler_hz: f64, t_s: f64) -> Complex64 {
        let pass_hz = 0.5 * pulse.bandwidth_hz.max(4.0 / pulse.duration_s) + doppler_hz;
        let (stop_hz, rejection_db) = (20e3, 84.5);
        let half_s = 0.5 * (rejection_db - 7.95) / (2.285 * TAU * (stop_hz - pass_hz));
        let beta = 0.1102 * (rejection_db - 8.7);
        let response = |t_s: f64| {
            let window = bessel_i0(beta * (1.0 - (t_s / half_s).powi(2)).max(0.0).sqrt());
            let x = PI * (pass_hz + stop_hz) * t_s;
            (window - 1.0) / (bessel_i0(beta) - 1.0) * if x == 0.0 { 1.0 } else { x.sin() / x }
        };
        let flank_s = 0.5 * pulse.taper * pulse.duration_s;
        let breaks = [0.0, flank_s, pulse.duration_s - flank_s, pulse.duration_s];
        // Three nodes of Gauss and Legendre in panels of a sixteenth of a sample.
        let nodes = [(-0.6f64.sqrt(), 5.0), (0.0, 8.0), (0.6f64.sqrt(), 5.0)];
        let mut sum = Complex64::ZERO;
        for ends in breaks.windows(2) {
            let (from, to) = (ends[0].max(t_s - half_s), ends[1].min(t_s + half_s));
            let panels = (16.0 * 40e3 * (to - from)).ceil().max(0.0) as usize;
            let panel_s = (to - from) / panels as f64;
            for panel in 0..panels {
                for (x, weight) in nodes {
                    let emitted_s = from + panel_s * (panel as f64 + 0.5 + 0.5 * x);
                    sum +=
                        pulse.envelope(emitted_s) * (response(t_s - emitted_s) * weight * panel_s);
                }
            }
        }
        sum
    }
}

/// Rounding decides the side of edges on samples. Such edges do not affect the weighted sum.
#[test]
fn an_edge_that_falls_on_a_sample_is_weighted_like_any_other() {
    let pulse = lfm(30e3, 5e-3);
    let filter = Decimator::new(&pulse, 40e3, 300.0, 24).expect("40 kHz is enough");
    let plan = ahead(0.0);
    // 960 kHz: a step is 0.78125 mm of range.
    let step_m = 0.5 * C / filter.dense_rate_hz();
    let count = 400;
    let at = |shift: f64| {
        let range_m = (48_000.0 + shift) * step_m;
        let setup = one_point(DVec3::Y * range_m);
        let direct = direct_behind(&filter, &plan, &setup, 0, (0.049, count));
        let exact = truth_behind(&filter, &plan, &setup, 0, (0.049, count));
        let error = windowed(&direct, &exact, &pulse);
        assert!(
            error < 1e-6,
            "{shift}: direct and reference {error:e} apart"
        );
        // The carrier is removed, because its phase advances by a third of a cycle per step.
        let turn = Complex64::from_polar(1.0, TAU * (CARRIER_HZ * 2.0 * range_m / C).fract());
        direct.iter().map(|x| x * turn).collect::<Vec<_>>()
    };
    let on = at(0.0);
    for shift in [-1e-6, 1e-6] {
        let error = relative_l2(&at(shift), &on);
        assert!(error < 1e-6, "{shift} of a step makes {error:e}");
    }
}

/// The production chain: both methods after the same filter, over many echoes without motion.
#[test]
fn direct_is_the_reference_behind_the_filter_without_motion() {
    let setup = busy();
    for taper in [0.0, 0.1] {
        let mut plan = ahead(0.0);
        plan.pulse.taper = taper;
        for (points, most) in [(4, 1e-5), (24, 1e-7)] {
            let filter =
                Decimator::new(&plan.pulse, 40e3, 300.0, points).expect("40 kHz is enough");
            let of_window = (0.0601, 600);
            let got = direct_behind(&filter, &plan, &setup, 5, of_window);
            let want = truth_behind(&filter, &plan, &setup, 5, of_window);
            let error = windowed(&got, &want, &plan.pulse);
            println!("taper {taper}, {points} points a sample: {error:.1e}");
            assert!(error < most, "{error:e}");
        }
    }
}

/// With the second derivative about mid-pulse, the residual phase is that of the third derivative: v cos(theta)/r T/12 of the
/// first-order phase, and a small remainder.
#[test]
fn the_quadratic_term_takes_the_residual_phase_of_uniform_motion_away() {
    for (v, r, theta_deg) in [
        (5.1, 75.0, 90.0),
        (5.0, 36.0, 60.0),
        (10.0, 36.0, 45.0),
        (1.0, 20.0, 120.0),
        (10.0, 100.0, 20.0_f64),
    ] {
        let (sin, cos) = theta_deg.to_radians().sin_cos();
        let at_m = DVec3::new(r * cos, 0.8 * r * sin, 0.6 * r * sin);
        let setup = one_point(at_m);
        let grid = Grid::around(r, 200e3);
        let linear = TAU * (CARRIER_HZ + 15e3) * (v * sin).powi(2) * 5e-3_f64.powi(2) / (r * C);
        for path in &PathModel::ALL[1..] {
            let mut plan = ahead(v);
            plan.model.path = *path;
            plan.model.doppler = DopplerModel::StretchQuadratic;
            let (got, _) = direct(&plan, &setup, 0, grid);
            let (want, _) = truth(&plan, &setup, 0, grid);
            let error = max_phase_difference_rad(&got, &want);
            println!(
                "{path:?} v {v}, r {r}, theta {theta_deg}: {error:.1e} rad, linear {linear:.1e}"
            );
            // Phase of the third derivative at T/2 from the middle, and the cubic part of the chirp that the recurrence neglects.
            let bound = linear * v / r * 5e-3 + 7e-7;
            assert!(
                error < bound,
                "v {v}, r {r}, theta {theta_deg}: {error:e} rad, {bound:e}"
            );
        }
    }
}

/// Remaining error of each path model with each Doppler model, on a platform that surges, heaves, rolls and yaws, with arrays on
/// long lever arms.
#[test]
fn continuous_with_the_quadratic_term_is_the_reference_on_a_restless_platform() {
    let scatterers = points(
        (0..40).map(|k| DVec3::new(60.0 * (weyl(k, 0) - 0.5), 50.0 + 12.0 * weyl(k, 1), 30.0)),
    );
    let setup = (
        transmitter(DVec3::new(1.5, 0.2, 0.8)),
        element(DVec3::new(-3.0, 0.4, 0.2)),
        scatterers,
    );
    let mut plan = restless();
    plan.pulse.taper = 0.1;
    let grid = Grid::around(65.0, 100e3);
    let (want, _) = truth(&plan, &setup, 0, grid);
    let mut error = |path: PathModel, doppler: DopplerModel, count: usize| {
        chords(&mut plan, 0.256, count);
        plan.model.path = path;
        plan.model.doppler = doppler;
        let (got, _) = direct(&plan, &setup, 0, grid);
        let error = relative_l2(&got, &want);
        println!(
            "{} of {count}, {}: {error:.1e}",
            path.name(),
            doppler.name()
        );
        error
    };
    use {DopplerModel::*, PathModel::*};
    let hop = error(StopAndHop, Stretch, 5);
    assert!(hop > 0.5, "{hop}");
    let still = error(Continuous, None, 5);
    assert!(still > 0.3, "{still}");
    let polyline = error(Polyline, Stretch, 5);
    let chords = [5, 50].map(|count| error(KSegment, StretchQuadratic, count));
    let linear = error(Continuous, Stretch, 5);
    let all = error(Continuous, StretchQuadratic, 5);
    // 50 ms chords of a rolling and heaving platform are useless for interferometry. Chords of the elements are more accurate and
    // converge.
    assert!(polyline > 2.0 * chords[0], "{polyline}, {chords:?}");
    assert!(chords[1] < chords[0] / 50.0, "{chords:?}");
    assert!(linear < 0.05 && linear > 1e-3, "{linear}");
    // The acceleration of the trajectory steps at its knots, which two derivatives cannot represent.
    assert!(all < 1e-4, "{all}");
}

/// One static scene after the receiver filter, by every method that preserves the pulse.
struct Shared {
    plan: PingPlan,
    filter: Decimator,
    setup: Setup,
    element: usize,
    first_s: f64,
    count: usize,
}

impl Shared {
    fn new() -> Self {
        let mut plan = ahead(0.0);
        plan.model.doppler = DopplerModel::None;
        Self {
            filter: Decimator::new(&plan.pulse, 40e3, 300.0, 24).expect("40 kHz is enough"),
            plan,
            setup: busy(),
            element: 3,
            first_s: 0.0401,
            count: 2500,
        }
    }
    fn walk(&self, sink: &mut impl ArrivalSink) {
        let grid = Grid::behind(&self.filter, self.first_s, self.count);
        let window = Window::of_samples(grid.first_s, grid.rate_hz, grid.count);
        let (tx, rx, scatterers) = &self.setup;
        walk(&self.plan, tx, rx, self.element, window, scatterers, sink);
    }
    fn direct(&self) -> Vec<Complex64> {
        let of_window = (self.first_s, self.count);
        direct_behind(
            &self.filter,
            &self.plan,
            &self.setup,
            self.element,
            of_window,
        )
    }
    /// Samples of the methods `nearest` and `linear`.
    fn laid_down(&self) -> [Vec<Complex64>; 2] {
        let mut replica = Replica::default();
        replica.prepare(&self.plan, 40e3, Some(&self.filter));
        let mut out = [(); 2].map(|()| vec![Complex64::ZERO; self.count]);
        let (plan, first_s) = (&self.plan, self.first_s);
        self.walk(&mut Nearest::new(
            plan,
            &replica,
            40e3,
            first_s,
            &mut out[0],
        ));
        self.walk(&mut Linear::new(plan, &replica, 40e3, first_s, &mut out[1]));
        out
    }
    fn spectral(&self, step_hz: Option<f64>) -> (Vec<Complex64>, f64) {
        let record_s = self.count as f64 / 40e3 + 5e-3 - 2.0 * self.filter.dense_first_s(0.0);
        let mut spectrum = Spectrum::new(40e3, record_s, step_hz, Some(&self.filter));
        spectrum.prepare(&self.plan);
        let mut bins = Bins::default();
        let mut sink = Spectral::new(&self.plan, &spectrum, self.first_s, &mut bins);
        self.walk(&mut sink);
        let mut out = vec![Complex64::ZERO; self.count];
        sink.finish(&mut out);
        (out, spectrum.step_hz())
    }
}

/// The sum by frequency of the paper gives the same result: Eq. 18 without Doppler, Eq. 21 with its Doppler.
#[test]
fn spectral_is_direct_behind_the_filter_to_1e_6() {
    let mut shared = Shared::new();
    for (doppler, v) in [(DopplerModel::None, 0.0), (DopplerModel::PaperEq21, 5.0)] {
        shared.plan = ahead(v);
        for kind in [PulseKind::LfmDown, PulseKind::Cw] {
            shared.plan.pulse.kind = kind;
            shared.plan.model.doppler = doppler;
            let (got, step_hz) = shared.spectral(None);
            let error = relative_l2(&got, &shared.direct());
            println!("{doppler:?}, {kind:?}: {error:.1e}, step {step_hz:.2} Hz");
            assert!(error < 2e-6, "{doppler:?}: {error:e}");
            assert!(step_hz < 40e3 / 2500.0);
        }
    }
}

/// Without a receiver filter the pulse is limited to the sampled band. The error is the out-of-band fraction of the pulse, as the
/// error model predicts.
#[test]
fn spectral_without_a_filter_misses_the_pulses_out_of_band_share() {
    let mut shared = Shared::new();
    shared.first_s = 0.0401;
    let at_m = DVec3::Y * 45.0;
    let (tx, rx) = (transmitter(DVec3::ZERO), element(DVec3::ZERO));
    // 1.25 B, where point-sampled and band-limited pulses differ by 5.5e-2 at BT = 150.
    let (rate_hz, count) = (37.5e3, 1500);
    let window = Window::of_samples(shared.first_s, rate_hz, count);
    let mut spectrum = Spectrum::new(rate_hz, count as f64 / rate_hz + 0.1, None, None);
    spectrum.prepare(&shared.plan);
    let mut bins = Bins::default();
    // The position of edges between samples matters, so the rms is over several positions.
    let (mut difference, mut size) = (0.0, 0.0);
    for k in 0..16 {
        let at_m = at_m * (1.0 + 1e-4 * weyl(k, 0));
        let scatterer = points([at_m]);
        let mut sink = Spectral::new(&shared.plan, &spectrum, shared.first_s, &mut bins);
        walk(&shared.plan, &tx, &rx, 0, window, &scatterer, &mut sink);
        let mut got = vec![Complex64::ZERO; count];
        sink.finish(&mut got);
        let mut want = vec![Complex64::ZERO; count];
        let mut sink = Direct::new(&shared.plan, rate_hz, shared.first_s, &mut want);
        walk(&shared.plan, &tx, &rx, 0, window, &scatterer, &mut sink);
        for (g, w) in got.iter().zip(&want) {
            difference += (g - w).norm_sqr();
            size += w.norm_sqr();
        }
    }
    let error = f64::sqrt(difference / size);
    println!("{error:.3e}");
    assert!((error - 5.5e-2).abs() < 0.5e-2, "{error:e}");
}

/// "A narrow interval improves fidelity": with a step above the reciprocal of the record length, late echoes appear one period
/// early.
#[test]
fn a_frequency_step_that_is_too_coarse_wraps_late_echoes_around() {
    let shared = Shared::new();
    let (fine, _) = shared.spectral(None);
    // 1000 samples: the record with its tails is folded into a third of its length.
    let (coarse, step_hz) = shared.spectral(Some(40.0));
    assert_eq!(step_hz, 40.0);
    let error = relative_l2(&coarse, &fine);
    assert!(error > 1.0, "{error}");
    // The folded samples are the sum of the periods of a record that is long enough.
    let long = Shared {
        first_s: 0.0301,
        count: 5000,
        ..Shared::new()
    };
    let ((coarse, _), (fine, _)) = (long.spectral(Some(40.0)), long.spectral(None));
    let folded: Vec<Complex64> = (0..1000)
        .map(|k| (0..5).map(|period| fine[period * 1000 + k]).sum())
        .collect();
    let error = relative_l2(&coarse[..1000], &folded);
    assert!(error < 1e-5, "{error:e}");
    assert_eq!(coarse[..1000], coarse[1000..2000]);
}

/// Methods of other simulators at the sample rate. For a band of 30 kHz, a shift of half a sample is a large error.
#[test]
fn nearest_and_linear_have_their_predicted_errors() {
    let shared = Shared::new();
    let want = shared.direct();
    let [nearest, linear] = shared.laid_down();
    let errors = (relative_l2(&nearest, &want), relative_l2(&linear, &want));
    println!("nearest {:.2e}, linear {:.2e}", errors.0, errors.1);
    // Closed forms for a pulse with a flat band, root mean squares over the band and all positions between two samples: 0.393 and 0.198 for 30 kHz
    // at 40 kHz.
    for (got, mean) in [(errors.0, 0.393), (errors.1, 0.198)] {
        assert!((got / mean - 1.0).abs() < 0.05, "{got}, {mean}");
    }
    // An echo that begins on a sample is exact in both methods.
    let at_m = DVec3::Y * (0.5 * C * (shared.first_s + 500.0 / 40e3));
    let one = Shared {
        setup: one_point(at_m),
        element: 0,
        ..shared
    };
    let want = one.direct();
    for got in one.laid_down() {
        assert!(relative_l2(&got, &want) < 1e-6);
    }
}

#[test]
fn echoes_outside_the_record_change_no_sample_in_any_method() {
    let shared = Shared::new();
    let mut replica = Replica::default();
    replica.prepare(&shared.plan, 40e3, Some(&shared.filter));
    let mut chunk = ArrivalChunk::new();
    for (i, delay_s) in [
        -1e300,
        -1.0,
        0.0,
        10.0,
        1e300,
        f64::INFINITY,
        f64::NEG_INFINITY,
    ]
    .into_iter()
    .enumerate()
    {
        chunk.delay_s[i] = delay_s;
        chunk.amplitude[i] = Complex64::ONE;
        chunk.len = i + 1;
    }
    let mut out = vec![Complex64::ZERO; 100];
    Nearest::new(&shared.plan, &replica, 40e3, 0.5, &mut out).accept(&chunk);
    Linear::new(&shared.plan, &replica, 40e3, 0.5, &mut out).accept(&chunk);
    assert!(out.iter().all(|x| x.norm() == 0.0), "{out:?}");
}

use std::f64::consts::{PI, TAU};

use glam::{DQuat, DVec3};
use num_complex::Complex64;

use echotank::array::filter::occupied_hz;
use echotank::array::{Decimator, Direct, oversample};
use echotank::echo::{Window, reference};
use echotank::flow::*;
use echotank::frames::{AttitudeKnot, Trajectory, VectorKnot};

use crate::paths::restless;
use crate::rig::*;

/// Sample k lies at `first_s + k / rate_hz`.
#[derive(Clone, Copy)]
struct Grid {
    rate_hz: f64,
    first_s: f64,
    count: usize,
}

impl Grid {
    /// From just before an echo of `range_m` to just after it.
    fn around(range_m: f64, rate_hz: f64) -> Self {
        // An odd start, so that no edge falls on a sample.
        Self {
            rate_hz,
            first_s: 2.0 * range_m / C - 1.234_567e-3,
            count: (8e-3 * rate_hz) as usize,
        }
    }
    fn time_s(&self, k: usize) -> f64 {
        self.first_s + k as f64 / self.rate_hz
    }
}

fn direct(
    plan: &PingPlan,
    tx: &TransmitArray,
    rx: &ArrayGeometry,
    element: usize,
    scatterers: &Scatterers,
    grid: Grid,
) -> (Vec<Complex64>, EchoCounts) {
    let mut out = vec![Complex64::ZERO; grid.count];
    let window = Window::of_samples(grid.first_s, grid.rate_hz, grid.count);
    let mut sink = Direct::new(plan, grid.rate_hz, grid.first_s, &mut out);
    let counts = walk(plan, tx, rx, element, window, scatterers, &mut sink);
    (out, counts)
}

fn truth(
    plan: &PingPlan,
    tx: &TransmitArray,
    rx: &ArrayGeometry,
    element: usize,
    scatterers: &Scatterers,
    grid: Grid,
) -> (Vec<Complex64>, EchoCounts) {
    let mut out = vec![Complex64::ZERO; grid.count];
    let counts = reference(
        plan,
        tx,
        rx,
        element,
        scatterers,
        grid.rate_hz,
        grid.first_s,
        &mut out,
    );
    (out, counts)
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

/// Everything written out again, with nothing of the crate but its nouns: one point, nothing moves.
#[test]
fn one_still_point_is_the_plain_formula_in_both_methods() {
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
            let (got, counts) = got(
                &plan,
                &transmitter(tx_m),
                &element(rx_m),
                0,
                &points([at_m]),
                grid,
            );
            let error = worst_difference(&got, &want) / amplitude;
            assert!(error < 1e-9, "{name}, {kind:?}: {error:e}");
            assert_eq!(counts.used, 1);
        }
    }
}

type Method = fn(
    &PingPlan,
    &TransmitArray,
    &ArrayGeometry,
    usize,
    &Scatterers,
    Grid,
) -> (Vec<Complex64>, EchoCounts);

/// A few hundred points, two arrays with patterns, normals and laws of both kinds.
fn busy() -> (TransmitArray, ArrayGeometry, Scatterers) {
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
    let (tx, rx, scatterers) = busy();
    let mut plan = ahead(0.0);
    plan.pulse.taper = 0.1;
    let grid = Grid {
        rate_hz: 40e3,
        first_s: 0.0301,
        count: 4000,
    };
    let mut worst: f64 = 0.0;
    for element in [0, 3, 7] {
        let (got, counts) = direct(&plan, &tx, &rx, element, &scatterers, grid);
        let (want, want_counts) = truth(&plan, &tx, &rx, element, &scatterers, grid);
        assert_eq!(counts.outside_window, want_counts.outside_window);
        worst = worst.max(relative_l2(&got, &want));
    }
    println!("worst {worst:e}");
    assert!(worst < 1e-9, "{worst:e}");
}

/// The linear form leaves a phase 2 pi f v^2 sin^2(theta) s^2 / (r c) at time s into the pulse, f the frequency there, and nothing else.
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
        let tools = (transmitter(DVec3::ZERO), element(DVec3::ZERO));
        let (got, _) = direct(&plan, &tools.0, &tools.1, 0, &points([at_m]), grid);
        let (want, _) = truth(&plan, &tools.0, &tools.1, 0, &points([at_m]), grid);
        let bound = TAU * (CARRIER_HZ + 15e3) * (v * sin).powi(2) * 5e-3_f64.powi(2) / (r * C);
        // Both of an edge's samples may disagree on which side they fall: compare where both sound.
        let error = got
            .iter()
            .zip(&want)
            .filter(|(a, b)| a.norm() > 0.0 && b.norm() > 0.0)
            .map(|(a, b)| (a / b).arg().abs())
            .fold(0.0, f64::max);
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
    let tools = (
        transmitter(DVec3::ZERO),
        element(DVec3::new(-1.0, 0.0, 0.0)),
    );
    let (got, counts) = direct(&plan, &tools.0, &tools.1, 0, &points([at_m]), grid);
    let (want, _) = truth(&plan, &tools.0, &tools.1, 0, &points([at_m]), grid);
    assert_eq!(counts.used, 1);
    let first = |x: &[Complex64]| x.iter().position(|s| s.norm() > 0.0).expect("an echo");
    let k = first(&want);
    assert_eq!(first(&got), k);
    assert!((got[k].norm() / want[k].norm() - 1.0).abs() < 1e-9);
    // Within microseconds of the leading edge the linear form is still exact.
    let phase = (got[k] / want[k]).arg().abs();
    assert!(phase < 1e-3, "{phase} rad");
    assert!(got.iter().all(|s| s.re.is_finite() && s.im.is_finite()));
}

/// Mean frequency of an echo: total phase over total time, on samples dense enough to unwrap.
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
        let tools = (transmitter(DVec3::ZERO), element(DVec3::ZERO));
        // eta at a moment: transmitted at t', received near t' + 2 r / c.
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
        let (exact, _) = truth(&plan, &tools.0, &tools.1, 0, &points([at_m]), grid);
        let want = CARRIER_HZ * (eta(2.5e-3) - 1.0);
        let got = mean_frequency_hz(&exact, grid.rate_hz);
        println!("{at_m}: mid-pulse {want} Hz, reference {got} Hz");
        assert!((got - want).abs() < 0.1, "{at_m}: {got}, {want} Hz");
        let (linear, _) = direct(&plan, &tools.0, &tools.1, 0, &points([at_m]), grid);
        let want = CARRIER_HZ * (eta(0.0) - 1.0);
        let got = mean_frequency_hz(&linear, grid.rate_hz);
        assert!(
            (got - want).abs() < 1e-6,
            "{at_m}: direct {got}, leading edge {want} Hz"
        );
    }
}

/// A platform that only turns moves an element on an arm by omega x arm: the reference hears that.
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
    // One metre ahead, a turn to starboard carries it to starboard, towards the point: by 0.2 m/s times the cosine of a tenth of 0.2 rad.
    let (got, _) = truth(
        &plan,
        &transmitter(DVec3::ZERO),
        &element(DVec3::X),
        0,
        &points([at_m]),
        grid,
    );
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
            let tools = (transmitter(DVec3::ZERO), element(DVec3::ZERO));
            let (sink, _) = collect(&plan, &tools.0, &tools.1, 0, ALWAYS, &points([at_m]));
            let arrival = sink.arrivals[0];
            let (x, _) = direct(&plan, &tools.0, &tools.1, 0, &points([at_m]), grid);
            // Correlation with the replica that starts at `lag` seconds into the grid.
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
fn shorter_segments_bring_a_restless_platform_closer_to_the_reference() {
    let mut plan = restless();
    // Transmitter and element at the reference point: attitude moves neither, so what is left is the track itself.
    let tools = (transmitter(DVec3::ZERO), element(DVec3::ZERO));
    let at_m = DVec3::new(20.0, 90.0, 30.0);
    let grid = Grid::around(at_m.length(), 100e3);
    let (want, _) = truth(&plan, &tools.0, &tools.1, 0, &points([at_m]), grid);
    let errors = [2, 8, 32].map(|count| {
        chords(&mut plan, 0.256, count);
        let (got, _) = direct(&plan, &tools.0, &tools.1, 0, &points([at_m]), grid);
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
    let (tx, rx, scatterers) = busy();
    let long = Grid {
        rate_hz: 50e3,
        first_s: 0.03,
        count: 6000,
    };
    let (whole, _) = direct(&plan, &tx, &rx, 2, &scatterers, long);
    let (from, count) = (1500, 900);
    let part = Grid {
        first_s: long.time_s(from),
        count,
        ..long
    };
    let (cut, counts) = direct(&plan, &tx, &rx, 2, &scatterers, part);
    assert!(counts.outside_window > 50 && counts.used > 50, "{counts:?}");
    let error = worst_difference(&cut, &whole[from..from + count]) / peak(&whole);
    assert!(error < 1e-10, "{error:e}");
    // Past everything there is nothing.
    let after = Grid {
        first_s: 0.5,
        ..part
    };
    let (silent, counts) = direct(&plan, &tx, &rx, 2, &scatterers, after);
    assert!(peak(&silent) == 0.0 && counts.used == 0);
}

/// What is left of the sum's finite density behind the receiver filter, against four times that density.
fn density_error(taper: f64, speed: f64, density: usize) -> f64 {
    let (tx, rx, scatterers) = busy();
    let mut plan = ahead(speed);
    plan.pulse.taper = taper;
    let filtered = |factor: usize| {
        let filter = Decimator::new(&plan.pulse, 40e3, 300.0, factor).expect("40 kHz is enough");
        let count = 2500;
        let grid = Grid {
            rate_hz: filter.dense_rate_hz(),
            first_s: filter.dense_first_s(0.0401),
            count: filter.dense_len(count),
        };
        let (dense, _) = direct(&plan, &tx, &rx, 3, &scatterers, grid);
        let mut out = vec![Complex64::ZERO; count];
        filter.apply(&dense, &mut out);
        out
    };
    relative_l2(&filtered(density), &filtered(4 * density))
}

#[test]
fn the_density_of_the_filtered_sum_leaves_the_documented_error() {
    let at = |taper: f64, synthesis: Synthesis| {
        let pulse = Pulse {
            taper,
            ..lfm(30e3, 5e-3)
        };
        let factor = oversample(&pulse, 40e3, synthesis);
        let error = density_error(taper, 2.0, factor);
        println!("taper {taper}, {synthesis:?}, {factor} x 40 kHz: {error:.2e}");
        error
    };
    let dense_hz = 40e3 * oversample(&lfm(30e3, 5e-3), 40e3, Synthesis::Reference) as f64;
    assert!(dense_hz >= 32.0 * occupied_hz(&lfm(30e3, 5e-3)));
    // Sharp edges: first order in the dense step, whatever is done. Flanks of 5 % of the pulse each: next to nothing.
    assert!(at(0.0, Synthesis::Reference) < 1.5e-3);
    assert!(at(0.0, Synthesis::Direct) < 6e-3);
    assert!(at(0.1, Synthesis::Reference) < 1e-6);
    assert!(at(0.1, Synthesis::Direct) < 1e-5);
    let (coarse, fine) = (density_error(0.0, 2.0, 12), density_error(0.0, 2.0, 24));
    assert!(
        fine < 0.75 * coarse,
        "doubling: {coarse:e} to {fine:e} must shrink"
    );
}

/// The product's chain: both methods behind the same filter at the same density.
#[test]
fn behind_the_same_filter_direct_is_the_reference_to_1e_9_without_motion() {
    let (tx, rx, scatterers) = busy();
    let plan = ahead(0.0);
    let filter = Decimator::new(&plan.pulse, 40e3, 300.0, 6).expect("40 kHz is enough");
    let count = 600;
    let grid = Grid {
        rate_hz: filter.dense_rate_hz(),
        first_s: filter.dense_first_s(0.0601),
        count: filter.dense_len(count),
    };
    let through = |method: Method| {
        let (dense, _) = method(&plan, &tx, &rx, 5, &scatterers, grid);
        let mut out = vec![Complex64::ZERO; count];
        filter.apply(&dense, &mut out);
        out
    };
    let error = relative_l2(&through(direct), &through(truth));
    assert!(error < 1e-9, "{error:e}");
}

//! Echoes of moving scatterers against a solution of the moving geometry of its own, sample by sample.

use std::f64::consts::TAU;
use std::slice::from_ref;

use glam::DVec3;
use num_complex::Complex64;

use echotank_core::ping::PingPlan;
use echotank_core::pulse::Pulse;
use echotank_core::scene::{MovingScatterer, ScatterLaw};
use echotank_synthesis::array::Direct;
use echotank_synthesis::array::filter::{Decimator, FilterDesign};
use echotank_synthesis::echo::moving::MovingEchoes;

use crate::paths::restless;
use echotank_testing::echo::*;

const RATE_HZ: f64 = 120e3;

fn mover(position_m: DVec3, velocity_m_per_s: DVec3) -> MovingScatterer {
    MovingScatterer {
        position_m,
        velocity_m_per_s,
        acceleration_m_per_s2: DVec3::ZERO,
        hit_s: 0.0,
        normal: [0.0; 3],
        strength: Complex64::new(3.0, -4.0),
        law: ScatterLaw::Point,
        target: 0,
        transmit: None,
    }
}

/// Smallest root of a function that grows from below 0, by bisection to the last bits.
fn root(mut low: f64, mut high: f64, f: impl Fn(f64) -> f64) -> f64 {
    for _ in 0..200 {
        let middle = 0.5 * (low + high);
        match f(middle) < 0.0 {
            true => low = middle,
            false => high = middle,
        }
    }
    0.5 * (low + high)
}

/// The wave at an element: for the sound at `time_s`, when it hit the target and when it was emitted, by bisection on the whole trajectory.
struct Exact<'a> {
    plan: &'a PingPlan,
    scatterer: &'a MovingScatterer,
    transmit_body_m: DVec3,
    receive_body_m: DVec3,
}

impl Exact<'_> {
    fn target_m(&self, time_s: f64) -> DVec3 {
        let since_s = time_s - self.scatterer.hit_s;
        self.scatterer.position_m
            + self.scatterer.velocity_m_per_s * time_s
            + self.scatterer.acceleration_m_per_s2 * (0.5 * since_s * since_s)
    }

    fn emitted_s(&self, time_s: f64) -> f64 {
        let c = self.plan.sound_speed_m_per_s;
        let pose = |time_s: f64| self.plan.trajectory.pose_at(time_s);
        let receive_m = pose(time_s).point_m(self.receive_body_m);
        let back_m = |hit_s: f64| self.target_m(hit_s).distance(receive_m);
        let hit_s = root(0.0, time_s, |hit_s| hit_s + back_m(hit_s) / c - time_s);
        let hit_m = self.target_m(hit_s);
        let out_m = |sent_s: f64| pose(sent_s).point_m(self.transmit_body_m).distance(hit_m);
        root(-0.1, hit_s, |sent_s| sent_s + out_m(sent_s) / c - hit_s)
    }

    /// Ranges of the leading edge, out and back.
    fn ranges_m(&self, delay_s: f64) -> (f64, f64) {
        let pose = |time_s: f64| self.plan.trajectory.pose_at(time_s);
        let c = self.plan.sound_speed_m_per_s;
        let receive_m = pose(delay_s).point_m(self.receive_body_m);
        let back_m = |hit_s: f64| self.target_m(hit_s).distance(receive_m);
        let hit_s = root(0.0, delay_s, |hit_s| hit_s + back_m(hit_s) / c - delay_s);
        (c * hit_s, back_m(hit_s))
    }
}

fn amplitude(exact: &Exact, delay_s: f64) -> Complex64 {
    let (out_m, back_m) = exact.ranges_m(delay_s);
    let decay = exact.plan.absorption_db_per_m * (out_m + back_m) / 20.0;
    exact.scatterer.strength * 10f64.powf(-decay) / (out_m * back_m)
}

fn plans() -> [(&'static str, PingPlan); 3] {
    let still = ahead(0.0);
    let tilted = glam::DQuat::from_rotation_y(0.2);
    let fast = uniform(
        DVec3::new(4e5, -3e5, 2.0),
        DVec3::new(6.0, -3.0, 0.5),
        tilted,
    );
    [("still", still), ("fast", fast), ("restless", restless())]
}

/// Envelope, delay, phase and Doppler of echoes of fast and slow targets agree with the exact wave in every sample.
#[test]
fn echoes_of_moving_targets_agree_with_an_exact_wave() {
    let pulses: [(&str, Pulse); 3] = [
        ("cw 0.1 ms", cw(1e-4)),
        ("cw 2 ms", cw(2e-3)),
        ("lfm 5 ms", lfm(30e3, 5e-3)),
    ];
    for (motion, mut plan) in plans() {
        for (name, pulse) in &pulses {
            plan.pulse = *pulse;
            let transmit = transmitter(DVec3::new(0.1, 0.2, -0.1));
            let array = line(DVec3::new(-0.2, 0.4, 0.3), 128);
            let start_m = plan.trajectory.pose_at(0.0).position_m;
            let (mut worst, mut loosest) = (0.0_f64, 0.0_f64);
            for (offset_m, velocity, acceleration) in [
                (
                    DVec3::new(5.0, 20.0, 12.0),
                    DVec3::new(0.3, -0.2, 0.1),
                    DVec3::new(1.5, 3.0, -2.0),
                ),
                (
                    DVec3::new(-2.0, 7.0, 3.0),
                    DVec3::new(-4.0, 9.0, 1.0),
                    DVec3::ZERO,
                ),
                (
                    DVec3::new(30.0, 40.0, 3.0),
                    DVec3::new(25.0, 20.0, 0.0),
                    DVec3::new(-6.0, 2.0, 4.0),
                ),
            ] {
                let scatterer = MovingScatterer {
                    acceleration_m_per_s2: acceleration,
                    hit_s: offset_m.length() / C,
                    ..mover(start_m + offset_m, velocity)
                };
                let mut echoes = MovingEchoes::default();
                let of = from_ref(&scatterer);
                echoes.prepare(&plan, from_ref(&transmit), from_ref(&array), of, 0.0);
                for element in [0, 71, 127] {
                    let exact = Exact {
                        plan: &plan,
                        scatterer: &scatterer,
                        transmit_body_m: transmit.mounting.position_m,
                        receive_body_m: array.element_body_m(element),
                    };
                    let (from_s, to_s) = echoes.span_s(0).expect("an echo");
                    let samples = ((to_s - from_s) * RATE_HZ).ceil() as usize + 1;
                    let mut got = vec![Complex64::ZERO; samples];
                    let mut sink = Direct::new(&plan, RATE_HZ, from_s, &mut got);
                    let counts = echoes.arrivals(&plan, (0, &array), element, &mut sink);
                    assert_eq!(counts.used, 1);
                    let delay_s = root(from_s, to_s, |t| exact.emitted_s(t));
                    let amplitude = amplitude(&exact, delay_s);
                    let (mut off, mut all) = (0.0, 0.0);
                    for (k, got) in got.iter().enumerate() {
                        let t = from_s + k as f64 / RATE_HZ;
                        let sent_s = exact.emitted_s(t);
                        // A sample within a thousandth of a sample of an edge may lie on either side.
                        let edge = sent_s.abs().min((sent_s - pulse.duration_s).abs());
                        if edge * RATE_HZ < 1e-3 {
                            continue;
                        }
                        let cycles = pulse.center_frequency_hz * (sent_s - t);
                        let turn = Complex64::cis(TAU * (cycles - cycles.round()));
                        let want = amplitude * pulse.envelope(sent_s) * turn;
                        off += (got - want).norm_sqr();
                        all += want.norm_sqr();
                    }
                    assert!(all > 0.0);
                    // A parabola through three points misses a cubic by (sqrt 3)/216 of its third derivative times the cube of the length.
                    let step_s = pulse.duration_s / 3.0;
                    let [a, b, c, d] =
                        [0.0, 1.0, 2.0, 3.0].map(|k| exact.emitted_s(delay_s + k * step_s));
                    let third_s = (d - 3.0 * c + 3.0 * b - a).abs() * 27.0 * 3f64.sqrt() / 216.0;
                    let bound = TAU * pulse.center_frequency_hz * third_s;
                    let error = (off / all).sqrt();
                    worst = worst.max(error);
                    let at = (&array, element);
                    let checked = MovingEchoes::checked(&plan, &transmit, at, of, 1, 0.0).next();
                    let checked = checked.expect("an echo");
                    let highest_hz = pulse.center_frequency_hz + 0.5 * pulse.bandwidth_hz;
                    let predicted = TAU * highest_hz * checked.off_s;
                    loosest = loosest.max(predicted / error);
                    assert!((checked.delay_s - delay_s).abs() < 1e-9);
                    // Of the worst window: the whole echo has less.
                    assert!(
                        error < predicted + 1e-6,
                        "{motion}, {name}: {error:.1e}, predicted {predicted:.1e}"
                    );
                    assert!(
                        error < 1e-6 || predicted < 4.0 * error,
                        "{motion}, {name}: {error:.1e}, predicted {predicted:.1e}"
                    );
                    // Bisection far from the world's origin is good to 1e-10 m, or 2e-7 rad.
                    let allowed = 1.5 * bound + 1e-6;
                    assert!(
                        error < allowed,
                        "{motion}, {name}: {error:.1e} {allowed:.1e}"
                    );
                }
            }
            println!("{motion}, {name}: {worst:.1e}, at most {loosest:.1} times predicted");
        }
    }
}

/// The Doppler of a radial target is (c - v)/(c + v), and -2 v/c to first order.
#[test]
fn the_doppler_of_a_radial_target_is_that_of_its_range_rate() {
    let (plan, tx, rx) = (ahead(0.0), transmitter(DVec3::ZERO), element(DVec3::ZERO));
    for speed in [-9.0, -0.2, 0.0, 0.5, 20.0] {
        let ray = DVec3::new(0.6, 0.0, 0.8);
        let mut echoes = MovingEchoes::default();
        let scatterer = mover(ray * 30.0, ray * speed);
        let of = from_ref(&scatterer);
        echoes.prepare(&plan, from_ref(&tx), from_ref(&rx), of, 0.0);
        let mut arrivals = Received::default();
        echoes.arrivals(&plan, (0, &rx), 0, &mut arrivals);
        let got = arrivals.0[0];
        let exact = (C - speed) / (C + speed) - 1.0;
        assert!(
            (got.doppler - exact).abs() < 1e-11,
            "{speed}: {got:?} {exact}"
        );
        let second_order = 2.0 * (speed / C).powi(2);
        assert!((got.doppler + 2.0 * speed / C).abs() <= 1.01 * second_order + 1e-11);
        assert!(got.curvature_per_s.abs() < 1e-6);
        // Out to where the target is when the sound arrives, and back.
        let delay_s = 2.0 * 30.0 / (C - speed);
        assert!((got.delay_s - delay_s).abs() < 1e-14, "{speed}");
    }
}

#[derive(Default)]
struct Received(Vec<Arrival>);

impl echotank_synthesis::arrivals::ArrivalSink for Received {
    fn accept(&mut self, chunk: &echotank_synthesis::arrivals::ArrivalChunk) {
        for i in 0..chunk.len {
            self.0.push(Arrival {
                delay_s: chunk.delay_s[i],
                doppler: chunk.doppler[i],
                curvature_per_s: chunk.curvature_per_s[i],
                amplitude: chunk.amplitude[i],
            });
        }
    }
}

/// A scatterer without velocity has the echoes of the walk.
#[test]
fn a_target_at_rest_has_the_echoes_of_one_that_cannot_move() {
    let mut plan = uniform(
        DVec3::new(100.0, 50.0, 2.0),
        DVec3::new(3.0, 1.0, 0.0),
        glam::DQuat::from_rotation_z(0.3),
    );
    plan.pulse = cw(5e-4);
    let tx = transmitter(DVec3::new(0.0, 0.2, 0.0));
    let array = line(DVec3::ZERO, 16);
    let at_m = DVec3::new(120.0, 60.0, 14.0);
    let mut fixed = points([at_m]);
    fixed.strength[0] = Complex64::new(3.0, -4.0);
    let scatterer = mover(at_m, DVec3::ZERO);
    let mut echoes = MovingEchoes::default();
    let of = from_ref(&scatterer);
    echoes.prepare(&plan, from_ref(&tx), from_ref(&array), of, 0.0);
    for element in [0, 9] {
        let want = collect(&plan, &tx, &array, element, ALWAYS, &fixed)
            .0
            .arrivals[0];
        let mut got = Received::default();
        echoes.arrivals(&plan, (0, &array), element, &mut got);
        let got = got.0[0];
        assert!((got.delay_s - want.delay_s).abs() < 1e-14);
        assert!(
            (got.doppler - want.doppler).abs() < 1e-6,
            "{got:?} {want:?}"
        );
        assert!((got.amplitude / want.amplitude - 1.0).norm() < 1e-9);
    }
    // A pulse that starts later finds the same target.
    let later = mover(at_m - DVec3::X, DVec3::X * 10.0);
    let late_s = 0.1;
    echoes.prepare(&plan, from_ref(&tx), from_ref(&array), &[later], late_s);
    let mut got = Received::default();
    echoes.arrivals(&plan, (0, &array), 0, &mut got);
    let moved = mover(at_m, DVec3::X * 10.0);
    echoes.prepare(&plan, &[tx], from_ref(&array), &[moved], 0.0);
    echoes.arrivals(&plan, (0, &array), 0, &mut got);
    assert!((got.0[0].delay_s - got.0[1].delay_s).abs() < 1e-13);
}

/// Echoes behind the receiver filter: that of a target in motion differs from that of its place at rest by its Doppler.
#[test]
fn a_filtered_echo_is_that_of_the_dense_sum() {
    let plan = PingPlan {
        pulse: cw(1e-3),
        ..ahead(0.0)
    };
    let design = FilterDesign {
        pulse: plan.pulse,
        sample_rate_hz: 30e3,
        doppler_hz: 6e3,
        oversample: 8,
    };
    let filter: Decimator = design.decimator().expect("a filter");
    let scatterer = mover(DVec3::new(0.0, 0.0, 30.0), DVec3::new(0.0, 0.0, -3.0));
    let (tx, rx) = (transmitter(DVec3::ZERO), element(DVec3::ZERO));
    let mut echoes = MovingEchoes::default();
    let of = from_ref(&scatterer);
    echoes.prepare(&plan, &[tx], from_ref(&rx), of, 0.0);
    let (from_s, to_s) = echoes.span_s(0).expect("an echo");
    let count = ((to_s - from_s) * 30e3).ceil() as usize;
    let mut dense = vec![Complex64::ZERO; filter.dense_len(count)];
    let first_s = filter.dense_first_s(from_s);
    let mut sink = Direct::new(&plan, filter.dense_rate_hz(), first_s, &mut dense)
        .with_ends(Some(filter.ends()));
    echoes.arrivals(&plan, (0, &rx), 0, &mut sink);
    let mut out = vec![Complex64::ZERO; count];
    filter.apply(&dense, &mut out);
    // The phase turns by the Doppler from sample to sample in the middle of the echo.
    let k = ((2.0 * 30.0 / C + 0.5e-3 - from_s) * 30e3) as usize;
    let turned = (out[k + 1] / out[k]).arg() / TAU * 30e3;
    let want = ((C + 3.0) / (C - 3.0) - 1.0) * CARRIER_HZ;
    assert!((turned - want).abs() < 0.5, "{turned} Hz, {want} Hz");
}

use glam::{DQuat, DVec3};
use proptest::prelude::*;

use echotank_core::frames::{AttitudeKnot, Trajectory, VectorKnot, rotation_from_angles};
use echotank_core::model::{DopplerModel, PathModel};
use echotank_core::ping::{PingPlan, Segment};
use echotank_core::scene::ScatterLaw;

use echotank_testing::echo::*;

fn one(plan: &PingPlan, tx_m: DVec3, rx_m: DVec3, at_m: DVec3) -> Arrival {
    let (sink, _) = collect(
        plan,
        &transmitter(tx_m),
        &element(rx_m),
        0,
        ALWAYS,
        &points([at_m]),
    );
    assert_eq!(sink.arrivals.len(), 1, "one scatterer, one echo");
    sink.arrivals[0]
}

/// Root of an increasing function by bisection, accurate to the last bit.
fn bisect(mut low: f64, mut high: f64, f: impl Fn(f64) -> f64) -> f64 {
    for _ in 0..200 {
        let middle = 0.5 * (low + high);
        if f(middle) < 0.0 {
            low = middle;
        } else {
            high = middle;
        }
    }
    0.5 * (low + high)
}

/// For a transmitter and receiver at the same position: dL = 2 r (beta^2 - beta cos theta) / (1 - beta^2).
#[test]
fn exact_minus_stop_and_hop_is_the_closed_form_to_1e_12_m() {
    let mut worst: f64 = 0.0;
    let moving_models = &PathModel::ALL[1..];
    for (v, path) in [0.0, 1e-9, 1e-3, 1.0, 5.144, 20.0, 150.0]
        .into_iter()
        .flat_map(|v| moving_models.iter().map(move |&path| (v, path)))
    {
        let mut moving = ahead(v);
        moving.model.path = path;
        let mut hopping = ahead(v);
        hopping.model.path = PathModel::StopAndHop;
        for r in [0.01, 1.0, 36.0, 75.0, 150.0] {
            for theta_deg in [0.0, 1.0, 30.0, 60.0, 90.0, 135.0, 180.0_f64] {
                let (sin, cos) = theta_deg.to_radians().sin_cos();
                let at_m = DVec3::new(r * cos, 0.6 * r * sin, 0.8 * r * sin);
                let exact = one(&moving, DVec3::ZERO, DVec3::ZERO, at_m).delay_s;
                let still = one(&hopping, DVec3::ZERO, DVec3::ZERO, at_m).delay_s;
                let beta = v / C;
                // r and the cosine are those of the rounded coordinates.
                let r = at_m.length();
                let want = 2.0 * r * (beta * beta - beta * at_m.x / r) / (1.0 - beta * beta);
                let error = (C * exact - C * still - want).abs();
                worst = worst.max(error);
                assert!(
                    error < 1e-12,
                    "{path:?}, v {v}, r {r}, theta {theta_deg}: {error:e} m"
                );
            }
        }
    }
    println!("worst {worst:e} m");
}

#[test]
fn a_delay_solves_its_equation_even_1_mm_from_the_receiver() {
    for (v, path) in [0.0, 1e-6, 5.0, 150.0]
        .into_iter()
        .flat_map(|v| PathModel::ALL[1..].iter().map(move |&path| (v, path)))
    {
        let mut plan = uniform(
            DVec3::ZERO,
            DVec3::new(0.6 * v, -0.64 * v, 0.48 * v),
            DQuat::IDENTITY,
        );
        plan.model.path = path;
        let velocity = plan.segments[0].velocity_m_per_s;
        for rx_m in [DVec3::new(-1.5, 0.3, 0.2), DVec3::new(0.0, 0.0, 1e-4)] {
            for offset_m in [1e-3, 1.0, 100.0] {
                let at_m = rx_m + DVec3::new(0.0, 0.6 * offset_m, 0.8 * offset_m);
                let range_m = at_m.length();
                let got = one(&plan, DVec3::ZERO, rx_m, at_m).delay_s;
                let want = bisect(0.0, 1.0, |u| {
                    C * u - range_m - (at_m - rx_m - velocity * u).length()
                });
                assert!(
                    (got - want).abs() < 2e-16,
                    "{path:?}, v {v}, {offset_m} m off: {got} s, halving says {want} s, {:e} apart",
                    got - want
                );
            }
        }
    }
}

#[test]
fn a_world_of_utm_size_changes_no_delay_by_1e_16_s() {
    let home = uniform(DVec3::ZERO, DVec3::new(3.0, 4.0, 0.5), starboard());
    let away_m = DVec3::new(6_543_210.0, 512_345.0, -75.0);
    let away = uniform(away_m, DVec3::new(3.0, 4.0, 0.5), starboard());
    // Coordinates on a grid of 2^-10 m, so the motion causes no rounding.
    let at_m = DVec3::new(17.25, 80.5, 30.125);
    for path in PathModel::ALL {
        let [near, far] = [(&home, at_m), (&away, at_m + away_m)].map(|(plan, at_m)| {
            let mut plan = plan.clone();
            plan.model.path = path;
            one(&plan, DVec3::X, DVec3::Y, at_m)
        });
        let error_s = (near.delay_s - far.delay_s).abs();
        assert!(error_s < 1e-16, "{path:?}: {error_s:e} s apart");
        assert!((near.doppler - far.doppler).abs() < 1e-17, "{path:?}");
    }
}

/// The stretch eta - 1 is the derivative of transmission time over reception time. The expected value is a difference quotient of
/// the exact two-leg equation.
#[test]
fn doppler_is_the_derivative_of_the_emission_time() {
    let velocity = DVec3::new(4.0, -1.5, 0.7);
    let plan = uniform(DVec3::ZERO, velocity, DQuat::IDENTITY);
    let (tx_m, rx_m) = (DVec3::new(0.5, 0.0, 0.1), DVec3::new(-0.5, 0.2, 0.0));
    for at_m in [
        DVec3::new(30.0, 60.0, 25.0),
        DVec3::new(-90.0, 10.0, 30.0),
        DVec3::new(0.0, 0.0, 20.0),
    ] {
        let got = one(&plan, tx_m, rx_m, at_m);
        let emitted_s = |t: f64| {
            let second_m = (at_m - rx_m - velocity * t).length();
            bisect(-1e-3, 1e-3, |e| {
                (at_m - tx_m - velocity * e).length() + second_m - C * (t - e)
            })
        };
        let step_s = 1e-5;
        let slope =
            (emitted_s(got.delay_s + step_s) - emitted_s(got.delay_s - step_s)) / (2.0 * step_s);
        assert!(
            (got.doppler - (slope - 1.0)).abs() < 1e-9,
            "{at_m}: {} against {}",
            got.doppler,
            slope - 1.0
        );
    }
}

#[test]
fn models_without_doppler_or_motion_give_zero() {
    let at_m = DVec3::new(50.0, 20.0, 30.0);
    let mut plan = ahead(5.0);
    plan.model.doppler = DopplerModel::None;
    assert_eq!(one(&plan, DVec3::ZERO, DVec3::X, at_m).doppler, 0.0);
    plan.model.path = PathModel::StopAndHop;
    let hop = one(&plan, DVec3::ZERO, DVec3::X, at_m);
    assert_eq!(hop.doppler, 0.0);
    let want = (at_m.length() + (at_m - DVec3::X).length()) / C;
    assert!((hop.delay_s - want).abs() < 1e-16);
    assert_eq!(one(&ahead(0.0), DVec3::ZERO, DVec3::X, at_m).doppler, 0.0);
}

/// Solves every leg of the polyline independently. Returns the delay on the first leg that contains its root (or at the vertex
/// between legs if none does), and the number of legs that contain their root.
fn by_hand(plan: &PingPlan, tx_m: DVec3, rx_m: DVec3, at_m: DVec3) -> (f64, usize) {
    let first = &plan.segments[0];
    let transmit_m = first.position_m + first.world_from_body * tx_m;
    let range_m = at_m.distance(transmit_m);
    let mut found = Vec::new();
    let mut late_before = 0;
    for (k, s) in plan.segments.iter().enumerate() {
        let end_s = plan
            .segments
            .get(k + 1)
            .map_or(f64::INFINITY, |n| n.start_s);
        let place_m = s.position_m + s.world_from_body * rx_m;
        let root_s = bisect(-1.0, 2.0, |u| {
            C * u - range_m - (at_m - place_m - s.velocity_m_per_s * (u - s.start_s)).length()
        });
        if root_s >= s.start_s && root_s < end_s {
            found.push(root_s);
        } else if root_s >= end_s {
            late_before = k + 1;
        }
    }
    match found.first() {
        Some(&u) => (u, found.len()),
        None => (plan.segments[late_before].start_s, 0),
    }
}

#[test]
fn on_a_polyline_the_first_leg_that_holds_its_root_is_taken_and_jumps_are_counted() {
    let (tx_m, rx_m) = (DVec3::new(0.3, 0.0, 0.0), DVec3::new(-1.0, 0.0, 0.2));
    // A quarter of a second in eight legs. The heading steps by half a degree back and forth, so the element steps 8.7 mm both
    // ways.
    let mut plan = ahead(5.0);
    plan.model.segment_s = 1.0 / 32.0;
    plan.segments = (0..8)
        .map(|k| Segment {
            start_s: k as f64 / 32.0,
            position_m: DVec3::new(5.0 * k as f64 / 32.0, 0.02 * (k % 3) as f64, 0.0),
            velocity_m_per_s: DVec3::new(5.0, 0.3 * (k as f64 - 4.0), -0.2),
            world_from_body: rotation_from_angles(0.0, 0.0, [0.0, 0.01, -0.01][k % 3]),
        })
        .collect();
    // Random points, and a dense line to one side with echoes around every vertex.
    let anywhere = (0..2000).map(|k| {
        let (a, r) = (6.3 * weyl(k, 0), 1.0 + 190.0 * weyl(k, 1));
        DVec3::new(r * a.cos(), r * a.sin(), 20.0 * weyl(k, 2))
    });
    let aside = (0..4000).map(|k| {
        DVec3::new(
            0.5,
            23.4375 * (k / 500 + 1) as f64 + 1e-3 * ((k % 500) as f64 - 250.0),
            1.0,
        )
    });
    let scatterers = points(anywhere.chain(aside));
    let (sink, counts) = collect(
        &plan,
        &transmitter(tx_m),
        &element(rx_m),
        0,
        ALWAYS,
        &scatterers,
    );
    assert_eq!(sink.arrivals.len(), scatterers.len());
    let (mut gaps, mut doubles, mut beyond) = (0, 0, 0);
    for (i, arrival) in sink.arrivals.iter().enumerate() {
        let (want, roots) = by_hand(&plan, tx_m, rx_m, scatterers.position_m(i));
        gaps += u64::from(roots == 0);
        doubles += u64::from(roots > 1);
        beyond += u64::from(want >= 0.25);
        assert!(
            (arrival.delay_s - want).abs() < 2e-16,
            "scatterer {i}, {roots} roots: {} s, by hand {want} s",
            arrival.delay_s
        );
    }
    println!("{gaps} without a root, {doubles} with two, {beyond} beyond");
    assert!(
        gaps > 10 && doubles > 10 && beyond > 10,
        "the scene must show all three"
    );
    assert_eq!(
        (counts.no_root, counts.two_roots, counts.beyond_track),
        (gaps, doubles, beyond)
    );
}

/// A platform that surges, heaves, rolls and yaws.
pub(crate) fn restless() -> PingPlan {
    let mut plan = ahead(0.0);
    let swing = |t: f64| (1.3 * t).sin_cos();
    plan.trajectory = Trajectory {
        position: (-2..8)
            .map(|k| {
                let t = 0.1 * k as f64;
                VectorKnot {
                    time_s: t,
                    value: DVec3::new(3.0 * t + 0.4 * t * t, 0.2 * swing(t).0, 0.0),
                    rate_per_s: DVec3::new(3.0 + 0.8 * t, 0.26 * swing(t).1, 0.0),
                }
            })
            .collect(),
        heave: (-2..8)
            .map(|k| {
                let t = 0.1 * k as f64;
                VectorKnot {
                    time_s: t,
                    value: DVec3::Z * swing(t).1,
                    rate_per_s: DVec3::Z * (-1.3 * swing(t).0),
                }
            })
            .collect(),
        attitude: (-2..8)
            .map(|k| {
                let t = 0.1 * k as f64;
                AttitudeKnot {
                    time_s: t,
                    world_from_body: rotation_from_angles(0.1 * swing(t).0, 0.0, 0.05 * t),
                    body_rate_rad_per_s: DVec3::new(0.13 * swing(t).1, 0.0, 0.05),
                }
            })
            .collect(),
        lever_arm_m: DVec3::ZERO,
    };
    plan
}

/// Largest delay error of a path model on the moving platform over a set of scatterers, seconds. The error of a chord depends on
/// the position of an echo in the chord. `tx_m` and `rx_m` are in body coordinates.
fn worst_delay_error_s(path: PathModel, (tx_m, rx_m): (DVec3, DVec3), count: usize) -> f64 {
    let mut plan = restless();
    plan.model.path = path;
    chords(&mut plan, 0.256, count);
    let transmit_m = plan.trajectory.pose_at(0.0).point_m(tx_m);
    (0..50)
        .map(|k| {
            let at_m = DVec3::new(30.0, 20.0 + 2.7 * k as f64, 35.0);
            let want = bisect(0.0, 1.0, |u| {
                C * u
                    - at_m.distance(transmit_m)
                    - at_m.distance(plan.trajectory.pose_at(u).point_m(rx_m))
            });
            (one(&plan, tx_m, rx_m, at_m).delay_s - want).abs()
        })
        .fold(0.0, f64::max)
}

const ARM_M: DVec3 = DVec3::new(-0.5, 0.4, 0.2);

/// The result is independent of the initial segments.
#[test]
fn continuous_delays_are_those_of_the_track_itself_to_2e_16_s() {
    for count in [1, 4, 64] {
        for ends in [(DVec3::ZERO, ARM_M), (DVec3::new(1.5, 0.2, 0.8), ARM_M)] {
            let error_s = worst_delay_error_s(PathModel::Continuous, ends, count);
            assert!(error_s < 2e-16, "{count} segments: {error_s:e} s");
        }
    }
}

/// Chords of the element itself have a second-order error also on a lever arm, without steps.
#[test]
fn k_segment_delays_converge_to_the_second_order_even_on_an_arm() {
    let ends = (DVec3::new(1.5, 0.2, 0.8), ARM_M);
    let errors =
        [4, 16, 64, 256].map(|count| worst_delay_error_s(PathModel::KSegment, ends, count));
    println!("{errors:?} s");
    for k in 0..3 {
        assert!(errors[k + 1] < errors[k] / 12.0, "{errors:?}");
    }
    let mut plan = restless();
    plan.model.path = PathModel::KSegment;
    chords(&mut plan, 0.256, 16);
    let fine = points((0..20_000).map(|k| DVec3::new(30.0, 20.0 + 0.005 * k as f64, 35.0)));
    let (sink, counts) = collect(
        &plan,
        &transmitter(ends.0),
        &element(ends.1),
        0,
        ALWAYS,
        &fine,
    );
    assert_eq!((counts.no_root, counts.two_roots), (0, 0));
    // Delays increase uniformly from scatterer to scatterer, across every vertex.
    let steps: Vec<f64> = sink
        .arrivals
        .windows(2)
        .map(|w| w[1].delay_s - w[0].delay_s)
        .collect();
    let uneven = steps
        .windows(2)
        .map(|w| (w[1] - w[0]).abs())
        .fold(0.0, f64::max);
    assert!(uneven < 1e-8, "a jump of {uneven:e} s");
}

/// Emission times at the end of pulses that are longer than a chord. With the acceleration of the chord alone they were off
/// about three times as far as those of the exact trajectory.
#[test]
fn chords_shorter_than_the_pulse_have_its_mean_acceleration() {
    let (tx_m, rx_m) = (DVec3::new(1.5, 0.2, 0.8), DVec3::new(-3.0, 0.4, 0.2));
    let truth = restless().trajectory;
    let pulse_s = 0.04;
    let worst_s = |path: PathModel| {
        let mut plan = restless();
        plan.model.path = path;
        plan.model.doppler = DopplerModel::StretchQuadratic;
        plan.pulse.duration_s = pulse_s;
        chords(&mut plan, 0.256, 64);
        (0..50)
            .map(|k| {
                let at_m = DVec3::new(-20.0, 20.0 + 2.7 * k as f64, 35.0);
                let got = one(&plan, tx_m, rx_m, at_m);
                let t = got.delay_s + pulse_s;
                let second_m = at_m.distance(truth.pose_at(t).point_m(rx_m));
                let emitted_s = bisect(0.0, 2.0 * pulse_s, |e| {
                    at_m.distance(truth.pose_at(e).point_m(tx_m)) + second_m - C * (t - e)
                });
                let want_s = (1.0 + got.doppler + got.curvature_per_s * pulse_s) * pulse_s;
                (emitted_s - want_s).abs()
            })
            .fold(0.0, f64::max)
    };
    let [chords_s, exact_s] = [PathModel::KSegment, PathModel::Continuous].map(worst_s);
    println!("{chords_s:.2e} s with chords, {exact_s:.2e} s");
    assert!(
        exact_s > 1e-10 && chords_s < 1.5 * exact_s,
        "{chords_s:e} {exact_s:e}"
    );
}

/// Compares the stretch eta - 1 of every model with the derivative of the true transmission time on a turning and moving platform.
#[test]
fn doppler_on_an_arm_holds_what_turning_adds() {
    let (tx_m, rx_m) = (DVec3::new(1.5, 0.2, 0.8), DVec3::new(-3.0, 0.4, 0.2));
    let truth = restless().trajectory;
    let emitted_s = |at_m: DVec3, t: f64| {
        let second_m = at_m.distance(truth.pose_at(t).point_m(rx_m));
        bisect(-1e-3, 1e-3, |e| {
            at_m.distance(truth.pose_at(e).point_m(tx_m)) + second_m - C * (t - e)
        })
    };
    let worst = |path: PathModel, count: usize| {
        let mut plan = restless();
        plan.model.path = path;
        chords(&mut plan, 0.256, count);
        (0..50)
            .map(|k| {
                let at_m = DVec3::new(-20.0, 20.0 + 2.7 * k as f64, 35.0);
                let got = one(&plan, tx_m, rx_m, at_m);
                let (u, h) = (got.delay_s, 1e-5);
                let slope = (emitted_s(at_m, u + h) - emitted_s(at_m, u - h)) / (2.0 * h);
                (got.doppler - (slope - 1.0)).abs()
            })
            .fold(0.0, f64::max)
    };
    let polyline = worst(PathModel::Polyline, 64);
    let k_segment = [4, 16, 64].map(|count| worst(PathModel::KSegment, count));
    let continuous = worst(PathModel::Continuous, 4);
    println!("polyline {polyline:.1e}, k-segment {k_segment:?}, continuous {continuous:.1e}");
    // The turn adds 0.13 rad/s times metres over c: 3e-4. The acceleration over half a 4 ms segment adds 1e-6.
    assert!(polyline < 1e-5, "{polyline:e}");
    assert!(
        k_segment[2] < k_segment[0] / 100.0 && k_segment[2] < 1e-8,
        "{k_segment:?}"
    );
    assert!(continuous < 1e-9, "{continuous:e}");
}

/// Direct evaluation of Eq. 21: the ratios of Eqs. 19 and 20 times the legs. At 5.144 m/s, 250 m and 60 degrees, closing, its error
/// exceeds the error of ignoring motion.
#[test]
fn eq_21_moves_an_echo_by_0p64_m_where_stop_and_hop_errs_by_0p43_m() {
    let (v, r, theta_deg) = (5.144, 250.0, 60.0_f64);
    let (sin, cos) = theta_deg.to_radians().sin_cos();
    let at_m = DVec3::new(r * cos, r * sin, 0.0);
    let exact_s = one(&ahead(v), DVec3::ZERO, DVec3::ZERO, at_m).delay_s;
    let mut plan = ahead(v);
    plan.model.doppler = DopplerModel::PaperEq21;
    let got = one(&plan, DVec3::ZERO, DVec3::ZERO, at_m);
    let back_m = at_m - DVec3::X * (v * exact_s);
    let (cos_t, cos_e) = (cos, back_m.x / back_m.length());
    let out = C / (C - v * cos_t);
    let want_s = out * (r / C) + out * (1.0 + v * cos_e / C) * (back_m.length() / C);
    assert!((got.delay_s - want_s).abs() < 1e-15, "{got:?}, {want_s} s");
    assert_eq!((got.doppler, got.amplitude.im), (0.0, 0.0));
    plan.model.path = PathModel::StopAndHop;
    plan.model.doppler = DopplerModel::None;
    let still_s = one(&plan, DVec3::ZERO, DVec3::ZERO, at_m).delay_s;
    let (eq21_m, hop_m) = (
        0.5 * C * (got.delay_s - exact_s),
        0.5 * C * (still_s - exact_s),
    );
    println!("Eq. 21 {eq21_m:+.3} m, stop-and-hop {hop_m:+.3} m");
    assert!((eq21_m - 0.64).abs() < 0.005, "{eq21_m} m");
    assert!((hop_m - 0.426).abs() < 0.001, "{hop_m} m");
}

#[test]
fn polyline_delays_converge_on_the_continuous_track() {
    let worst_s = |rx_m: DVec3, count: usize| {
        worst_delay_error_s(PathModel::Polyline, (DVec3::ZERO, rx_m), count)
    };
    let centre = [4, 16, 64].map(|count| worst_s(DVec3::ZERO, count));
    let arm = [4, 16, 64, 256].map(|count| worst_s(ARM_M, count));
    println!("reference point {centre:?} s, element on an arm {arm:?} s");
    // Chords have a second-order error. A constant attitude per segment has a first-order error for elements on a lever arm.
    assert!(
        centre[1] < centre[0] / 12.0 && centre[2] < centre[1] / 12.0,
        "{centre:?}"
    );
    assert!(arm[2] < arm[1] / 3.0 && arm[3] < arm[2] / 3.0, "{arm:?}");
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 2000, ..ProptestConfig::default() })]

    #[test]
    fn no_geometry_and_no_speed_up_to_a_tenth_of_c_gives_a_nan(
        range_exponent in -8.0..2.4f64,
        direction in (-1.0..1.0f64, -1.0..1.0f64, -1.0..1.0f64),
        around_receiver in any::<bool>(),
        speed in prop_oneof![Just(0.0), 0.0..10.0f64, 140.0..150.0f64],
        course in 0.0..6.3f64,
        arm in (-2.0..2.0f64, -1.0..1.0f64, -1.0..1.0f64),
        lambert in any::<bool>(),
        path in 0..4usize,
        doppler in 0..4usize,
    ) {
        let velocity = DVec3::new(speed * course.cos(), speed * course.sin(), 0.0);
        let mut plan = uniform(DVec3::ZERO, velocity, DQuat::IDENTITY);
        chords(&mut plan, 0.3, 3);
        plan.model.path = PathModel::ALL[path];
        plan.model.doppler = DopplerModel::ALL[doppler];
        let rx_m = DVec3::new(arm.0, arm.1, arm.2);
        let offset_m = DVec3::new(direction.0, direction.1, direction.2) * 10f64.powf(range_exponent);
        let at_m = if around_receiver { rx_m + offset_m } else { offset_m };
        let mut scatterers = points([]);
        let law = if lambert { ScatterLaw::Lambert } else { ScatterLaw::Point };
        for at_m in [at_m, rx_m, DVec3::ZERO] {
            scatterers.push(at_m, [0.0, 0.0, -1.0], num_complex::Complex64::ONE, law);
        }
        let (sink, counts) = collect(&plan, &transmitter(DVec3::ZERO), &element(rx_m), 0, ALWAYS, &scatterers);
        prop_assert_eq!(counts.used + counts.culled, 3);
        prop_assert!(lambert || counts.used == 3);
        for (i, a) in sink.arrivals.iter().enumerate() {
            prop_assert!(a.delay_s.is_finite() && a.delay_s >= 0.0, "{i} {a:?}");
            prop_assert!(a.doppler.is_finite() && a.doppler.abs() < 0.25, "{i} {a:?}");
            prop_assert!(a.curvature_per_s.is_finite(), "{i} {a:?}");
            prop_assert!(a.amplitude.norm().is_finite(), "{i} {a:?}");
        }
        let exact = [DopplerModel::None, DopplerModel::Stretch].contains(&plan.model.doppler);
        if !lambert && exact && plan.model.path != PathModel::StopAndHop {
            let u = sink.arrivals[0].delay_s;
            let gone_m = C * u - at_m.length() - (at_m - rx_m - velocity * u).length();
            prop_assert!(gone_m.abs() < 1e-12 * (1.0 + C * u), "residual {gone_m:e} m");
        }
    }
}

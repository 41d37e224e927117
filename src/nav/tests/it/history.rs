//! Tests of the history: samples to motion, compared with analytic motions, across wraps, gaps and loops of a log.

use std::f64::consts::TAU;

use echotank_config::spec::{ChecksumPolicy, NavChannel, NavInputSpec, NavMode, VerticalSpec};
use echotank_core::frames::{Trajectory, angles_from_rotation, rotation_from_angles};
use echotank_core::navigation::{FixQuality, NavQuantity, NavState};
use echotank_nav::{Coverage, LocalTangentPlane, NavGap, NavHistory};
use glam::DVec3;

use crate::{T0, log_source, nav_spec, sample};

const FULL: [NavChannel; 4] = [
    NavChannel::Position,
    NavChannel::Heading,
    NavChannel::RollPitch,
    NavChannel::Heave,
];

fn local(north_m: f64, east_m: f64, down_m: f64) -> NavQuantity {
    NavQuantity::LocalPosition {
        north_m,
        east_m,
        down_m,
    }
}
fn heading(deg: f64) -> NavQuantity {
    NavQuantity::Heading {
        heading_rad: deg.to_radians().rem_euclid(TAU),
    }
}
fn roll_pitch(roll_deg: f64, pitch_deg: f64) -> NavQuantity {
    NavQuantity::RollPitch {
        roll_rad: roll_deg.to_radians(),
        pitch_rad: pitch_deg.to_radians(),
    }
}
fn heave(heave_down_m: f64) -> NavQuantity {
    NavQuantity::Heave { heave_down_m }
}

/// All four channels of a motion, at `rate_hz` over `0..=seconds`.
fn feed(
    history: &mut NavHistory,
    rate_hz: f64,
    seconds: f64,
    motion: impl Fn(f64) -> [NavQuantity; 4],
) {
    for k in 0..=(seconds * rate_hz).round() as usize {
        let t = k as f64 / rate_hz;
        for quantity in motion(t) {
            history.insert(&sample(0, t, quantity));
        }
    }
}

fn steady(t: f64) -> [NavQuantity; 4] {
    [
        local(2.0 * t, 0.0, 0.0),
        heading(0.0),
        roll_pitch(0.0, 0.0),
        heave(0.0),
    ]
}

fn settle(history: &mut NavHistory, time_s: f64, window_s: f64) -> Result<NavState, NavGap> {
    let mut trajectory = Trajectory::default();
    history.motion(
        T0.plus_s(time_s),
        window_s,
        NavMode::Settle,
        &mut trajectory,
    )
}

/// Swell: heave 1 m with period 6 s, roll 8 deg with 7 s, pitch 5 deg with 6 s, yaw 3 deg with 11 s about heading 10 deg.
fn swell(t: f64) -> [NavQuantity; 4] {
    let wave = |amplitude: f64, period_s: f64| amplitude * (TAU * t / period_s).sin();
    [
        local(5.0 * t, wave(2.0, 20.0), 0.0),
        heading(10.0 + wave(3.0, 11.0)),
        roll_pitch(wave(8.0, 7.0), wave(5.0, 6.0)),
        heave(wave(1.0, 6.0)),
    ]
}

/// Largest errors (heave m, rotation deg, position m, vertical speed m/s, turn rate deg/s) over 10 s of pings with a 0.5 s window.
fn swell_errors(rate_hz: f64) -> [f64; 5] {
    let mut history = NavHistory::new(&nav_spec(vec![log_source(&FULL)]));
    feed(&mut history, rate_hz, 20.0, swell);
    let mut worst = [0.0_f64; 5];
    let mut trajectory = Trajectory::default();
    for k in 0..100 {
        let ping_s = 4.0 + 0.1037 * f64::from(k);
        history
            .motion(T0.plus_s(ping_s), 0.5, NavMode::Settle, &mut trajectory)
            .expect("settled");
        for within_s in [0.0, 0.13, 0.29, 0.5] {
            let t = ping_s + within_s;
            let pose = trajectory.pose_at(within_s);
            let truth_at = |t: f64| {
                let [position, head, attitude, lift] = swell(t);
                let (
                    NavQuantity::LocalPosition {
                        north_m, east_m, ..
                    },
                    NavQuantity::Heading { heading_rad },
                    NavQuantity::RollPitch {
                        roll_rad,
                        pitch_rad,
                    },
                    NavQuantity::Heave { heave_down_m },
                ) = (position, head, attitude, lift)
                else {
                    panic!("the four quantities of swell()")
                };
                (
                    DVec3::new(north_m, east_m, 2.0 + heave_down_m),
                    rotation_from_angles(roll_rad, pitch_rad, heading_rad),
                )
            };
            let (position, rotation) = truth_at(t);
            let step_s = 1e-4;
            let (after, rotation_after) = truth_at(t + step_s);
            let (before, rotation_before) = truth_at(t - step_s);
            let sink_m_per_s = (after.z - before.z) / (2.0 * step_s);
            let turn =
                (rotation_after * rotation_before.inverse()).to_scaled_axis() / (2.0 * step_s);
            let errors = [
                (pose.position_m.z - position.z).abs(),
                (pose.world_from_body.inverse() * rotation)
                    .to_scaled_axis()
                    .length()
                    .to_degrees(),
                (pose.position_m - position).truncate().length(),
                (pose.velocity_m_per_s.z - sink_m_per_s).abs(),
                (pose.angular_velocity_rad_per_s - turn)
                    .length()
                    .to_degrees(),
            ];
            for (w, e) in worst.iter_mut().zip(errors) {
                *w = w.max(e);
            }
        }
    }
    worst
}

/// The bounds are about twice the observed errors. Interpolation is cubic, so a tenth of the rate increases the errors about a
/// thousandfold.
#[test]
fn swell_at_10_hz_is_interpolated_to_0p1_mm_and_0p001_deg() {
    for (rate_hz, limit) in [
        (10.0, [1e-4, 1e-3, 1e-4, 4e-3, 0.04]),
        (1.0, [0.08, 0.6, 0.01, 0.3, 2.5]),
    ] {
        let worst = swell_errors(rate_hz);
        println!(
            "{rate_hz} Hz: heave {:.2e} m, attitude {:.2e} deg, horizontal {:.2e} m, sink {:.2e} m/s, turn {:.2e} deg/s",
            worst[0], worst[1], worst[2], worst[3], worst[4]
        );
        for (w, l) in worst.iter().zip(limit) {
            assert!(*w < l, "{rate_hz} Hz: got {worst:?}, limit {limit:?}");
        }
    }
}

#[test]
fn heading_goes_through_north_the_short_way() {
    let mut history = NavHistory::new(&nav_spec(vec![log_source(&FULL)]));
    feed(&mut history, 1.0, 8.0, |t| {
        let [position, _, attitude, lift] = steady(t);
        [position, heading(352.0 + 2.0 * t), attitude, lift]
    });
    for time_s in [3.2, 3.5, 4.0, 4.6] {
        let state = settle(&mut history, time_s, 0.1).expect("settled");
        let want_deg = (352.0 + 2.0 * time_s).rem_euclid(360.0);
        let error_deg =
            (state.heading_rad.to_degrees() - want_deg + 180.0).rem_euclid(360.0) - 180.0;
        assert!(error_deg.abs() < 1e-9, "t {time_s}: {error_deg}");
        let rate = state.pose.angular_velocity_rad_per_s.z.to_degrees();
        assert!((rate - 2.0).abs() < 1e-9, "turn rate {rate}");
    }
}

/// PSXN,23 and PASHR define port up as positive. With positive roll, a starboard transducer goes down.
#[test]
fn roll_to_starboard_puts_the_starboard_side_deeper_and_heave_down_sinks() {
    use echotank_nav::NavDecoder;
    for sentence in [
        "$PSXN,23,10.00,5.00,90.00,1.50",
        "$PASHR,000000.500,90.00,T,10.00,5.00,1.50,,,,1,0",
    ] {
        let mut source = log_source(&FULL);
        source.checksum = ChecksumPolicy::AcceptMissing;
        let mut decoder = NavDecoder::new(0, &source);
        let mut samples = Vec::new();
        decoder.push(sentence.as_bytes(), T0, &mut samples);
        decoder.flush(&mut samples);
        assert_eq!(samples.len(), 3, "{sentence}");
        let mut history = NavHistory::new(&nav_spec(vec![source]));
        for k in 0..6 {
            let t = f64::from(k) * 0.5;
            history.insert(&sample(0, t, local(0.0, 0.0, 0.0)));
            for s in &samples {
                history.insert(&sample(0, t, s.quantity));
            }
        }
        let state = settle(&mut history, 1.2, 0.1).expect("settled");
        assert!(
            (state.pose.position_m.z - 3.5).abs() < 1e-12,
            "2 m + 1.5 m heave"
        );
        assert!((state.height_m + 3.5).abs() < 1e-12);
        let starboard = state.pose.point_m(DVec3::Y).z - state.pose.position_m.z;
        let bow = state.pose.point_m(DVec3::X) - state.pose.position_m;
        assert!(starboard > 0.17, "{sentence}: starboard {starboard}");
        assert!(bow.z < -0.08 && bow.y > 0.99, "{sentence}: bow {bow}");
    }
}

#[test]
fn an_antennas_lever_arm_is_applied_at_its_own_time() {
    let arm = DVec3::new(4.0, -1.0, -20.0);
    let attitude = |t: f64| ((8.0 * (TAU * t / 7.0).sin()), 5.0 * (TAU * t / 6.0).sin());
    let rotation = |t: f64| {
        let (roll, pitch) = attitude(t);
        rotation_from_angles(roll.to_radians(), pitch.to_radians(), 0.5)
    };
    let truth = |t: f64| DVec3::new(3.0 * t, -t, 2.0);
    for vertical in [
        VerticalSpec::Waterline {
            reference_down_m: 2.0,
        },
        VerticalSpec::Depth,
    ] {
        let mut spec = nav_spec(vec![log_source(&FULL)]);
        spec.sources[0].lever_arm_m = arm;
        spec.vertical = vertical;
        let mut history = NavHistory::new(&spec);
        for k in 0..=200 {
            let t = f64::from(k) * 0.05;
            let (roll, pitch) = attitude(t);
            history.insert(&sample(0, t, roll_pitch(roll, pitch)));
            history.insert(&sample(0, t, heading(0.5_f64.to_degrees())));
            history.insert(&sample(0, t, heave(0.0)));
            // Fixes arrive once a second, while roll moves the antenna by metres.
            if k % 20 == 0 {
                let antenna = truth(t) + rotation(t) * arm;
                history.insert(&sample(0, t, local(antenna.x, antenna.y, antenna.z)));
            }
        }
        for time_s in [3.0, 4.4, 5.7] {
            let state = settle(&mut history, time_s, 0.2).expect("settled");
            let error = (state.pose.position_m - truth(time_s)).length();
            assert!(error < 1e-5, "{vertical:?} t {time_s}: {error} m");
            let drift = (state.pose.velocity_m_per_s - DVec3::new(3.0, -1.0, 0.0)).length();
            assert!(drift < 1e-5, "{vertical:?} t {time_s}: {drift} m/s");
        }
    }
}

#[test]
fn vertical_comes_from_waterline_and_heave_or_the_height_or_the_depth() {
    let position = |height_m| NavQuantity::Position {
        latitude_rad: -0.384,
        longitude_rad: -0.313,
        height_m,
        fix: FixQuality::RtkFixed,
    };
    for (vertical, height_m, want) in [
        (
            VerticalSpec::Waterline {
                reference_down_m: 1.0,
            },
            None,
            1.5,
        ),
        (
            VerticalSpec::Gnss {
                datum_offset_m: 4.0,
            },
            Some(3.0),
            1.0,
        ),
    ] {
        let mut spec = nav_spec(vec![log_source(&FULL)]);
        spec.vertical = vertical;
        let mut history = NavHistory::new(&spec);
        feed(&mut history, 1.0, 8.0, |_| {
            [
                position(height_m),
                heading(0.0),
                roll_pitch(0.0, 0.0),
                heave(0.5),
            ]
        });
        let state = settle(&mut history, 3.5, 0.1).expect("settled");
        assert!(
            (state.pose.position_m.z - want).abs() < 1e-12,
            "{vertical:?}"
        );
        assert_eq!(state.fix, FixQuality::RtkFixed);
        assert!((state.latitude_rad + 0.384).abs() < 1e-15);
        assert!((state.longitude_rad + 0.313).abs() < 1e-15);
        assert_eq!(
            history.origin(),
            Some(LocalTangentPlane::new(-0.384, -0.313))
        );
        assert_eq!(
            history.first_fix_local().map(|p| p.truncate().length()),
            Some(0.0)
        );
    }
    // A fix without a height gives no depth.
    for vertical in [
        VerticalSpec::Gnss {
            datum_offset_m: 0.0,
        },
        VerticalSpec::Depth,
    ] {
        let mut spec = nav_spec(vec![log_source(&FULL)]);
        spec.vertical = vertical;
        let mut history = NavHistory::new(&spec);
        history.insert(&sample(0, 0.0, position(None)));
        assert_eq!(history.counts().no_vertical, 1);
    }
}

#[test]
fn a_settled_state_does_not_change_when_more_samples_come() {
    // Heading from another source at another rate, from the track, or with everything else in one sentence. The antenna is on a
    // lever arm, so every channel depends on another.
    for (course_only, together) in [(false, false), (true, false), (false, true), (true, true)] {
        let mut spec = nav_spec(vec![
            log_source(&[
                NavChannel::Position,
                NavChannel::RollPitch,
                NavChannel::Heave,
            ]),
            log_source(if course_only {
                &[]
            } else {
                &[NavChannel::Heading]
            }),
        ]);
        spec.sources[0].lever_arm_m = DVec3::new(1.0, 2.0, -10.0);
        spec.heading_from_course = Some(true);
        let mut samples = Vec::new();
        for k in 0..400 {
            let t = f64::from(k) * 0.05;
            let [position, head, attitude, lift] = swell(t);
            if together {
                if k % 10 == 0 {
                    samples.push(sample(0, t, position));
                    samples.push(sample(0, t, attitude));
                    samples.push(sample(1, t, head));
                    samples.push(sample(0, t, lift));
                }
                continue;
            }
            if k % 20 == 3 {
                samples.push(sample(0, t, position));
            }
            if k % 4 == 1 {
                samples.push(sample(0, t, attitude));
            }
            if k % 7 == 0 {
                samples.push(sample(1, t, head));
            }
            if k % 5 == 0 {
                samples.push(sample(0, t, lift));
            }
        }
        let mut pings = 0;
        let mut history = NavHistory::new(&spec);
        let mut ping_s = 0.31;
        let mut early = Vec::new();
        for s in &samples {
            history.insert(s);
            while ping_s < 15.0 {
                let (from, to) = (T0.plus_s(ping_s), T0.plus_s(ping_s + 0.4));
                match history.coverage(from, to) {
                    Coverage::Waiting => break,
                    Coverage::Missing(_) => {}
                    Coverage::Ready => {
                        let state = settle(&mut history, ping_s, 0.4).expect("ready means settled");
                        assert!(!state.extrapolated);
                        assert!(state.position_age_s < 0.0 && state.attitude_age_s < 0.0);
                        early.push((ping_s, state));
                        pings += 1;
                    }
                }
                ping_s += 0.37;
            }
        }
        assert!(pings > 30, "{pings}");
        for (ping_s, state) in early {
            assert_eq!(
                settle(&mut history, ping_s, 0.4),
                Ok(state),
                "ping at {ping_s}, {course_only} {together}"
            );
        }
    }
}

#[test]
fn coverage_is_ready_waiting_or_names_what_is_missing() {
    let mut history = NavHistory::new(&nav_spec(vec![log_source(&FULL)]));
    let at = |s: f64| T0.plus_s(s);
    assert_eq!(history.coverage(at(1.0), at(1.5)), Coverage::Waiting);
    feed(&mut history, 1.0, 2.0, steady);
    assert_eq!(history.coverage(at(0.5), at(1.0)), Coverage::Ready);
    assert_eq!(history.coverage(at(0.5), at(1.01)), Coverage::Waiting);
    assert_eq!(
        history.coverage(at(-0.5), at(0.5)),
        Coverage::Missing(NavChannel::Position)
    );
}

#[test]
fn prediction_extrapolates_the_last_rates_up_to_its_limit() {
    let mut history = NavHistory::new(&nav_spec(vec![log_source(&FULL)]));
    feed(&mut history, 10.0, 5.0, |t| {
        [
            local(3.0 * t, -2.0 * t, 0.0),
            heading(20.0 + 4.0 * t),
            roll_pitch(1.0, 0.0),
            heave(0.2 * t),
        ]
    });
    let mut trajectory = Trajectory::default();
    let mut at = |time_s: f64, window_s: f64| {
        history.motion(
            T0.plus_s(time_s),
            window_s,
            NavMode::Predict,
            &mut trajectory,
        )
    };
    let state = at(5.1, 0.1).expect("0.2 s past the newest");
    assert!(state.extrapolated);
    assert!((state.position_age_s - 0.1).abs() < 1e-9);
    assert!((state.pose.position_m - DVec3::new(15.3, -10.2, 3.02)).length() < 1e-9);
    assert!((state.heading_rad.to_degrees() - 40.4).abs() < 1e-6);
    assert!(!at(4.8, 0.1).expect("inside").extrapolated);
    let NavGap::Stale { channel, age_s } = at(5.1, 0.2).expect_err("0.3 s past the newest") else {
        panic!("stale")
    };
    assert_eq!(channel, NavChannel::Position);
    assert!((age_s - 0.3).abs() < 1e-9);
    assert_eq!(history.counts().stale, 1);
}

/// A roll sinusoid with the resolution of a real sensor. The slope at the end must not amplify the last digit to degrees.
#[test]
fn prediction_at_100_hz_is_not_shaken_by_the_sensor_s_resolution() {
    let roll_deg = |t: f64| 6.0 * (TAU * t / 8.0).sin();
    let mut trajectory = Trajectory::default();
    let mut worst_deg = 0.0_f64;
    for k in 0..150 {
        let newest_s = 3.0 + 0.01 * f64::from(k);
        let mut past = NavHistory::new(&nav_spec(vec![log_source(&FULL)]));
        feed(&mut past, 100.0, newest_s, |t| {
            let [position, head, _, lift] = steady(t);
            let resolved = (roll_deg(t) * 100.0).round() / 100.0;
            [position, head, roll_pitch(resolved, 0.0), lift]
        });
        let state = past
            .motion(
                T0.plus_s(newest_s + 0.1),
                0.1,
                NavMode::Predict,
                &mut trajectory,
            )
            .expect("0.2 s past the newest");
        worst_deg = worst_deg.max((state.roll_rad.to_degrees() - roll_deg(newest_s + 0.1)).abs());
    }
    println!("roll 0.1 s ahead: worst {worst_deg:.3} deg");
    assert!(worst_deg < 0.1, "{worst_deg} deg");
}

#[test]
fn gaps_are_refused_by_name_and_counted() {
    let mut history = NavHistory::new(&nav_spec(vec![log_source(&FULL)]));
    assert_eq!(
        settle(&mut history, 1.0, 0.1),
        Err(NavGap::NoData(NavChannel::Position))
    );
    feed(&mut history, 1.0, 4.0, steady);
    assert_eq!(
        settle(&mut history, -1.0, 0.1),
        Err(NavGap::NoData(NavChannel::Position))
    );
    assert!(matches!(
        settle(&mut history, 4.5, 0.1),
        Err(NavGap::Stale { .. })
    ));
    for t in [10.5, 11.5, 12.5] {
        for quantity in steady(t) {
            history.insert(&sample(0, t, quantity));
        }
    }
    assert_eq!(
        settle(&mut history, 6.0, 0.1),
        Err(NavGap::Hole {
            channel: NavChannel::Position,
            gap_s: 6.5
        })
    );
    assert!(settle(&mut history, 3.5, 0.4).is_ok(), "before the hole");
    assert!(
        settle(&mut history, 3.5, 0.6).is_err(),
        "its window runs into the hole"
    );
    assert!(settle(&mut history, 10.6, 0.5).is_ok(), "after the hole");
    history.insert(&sample(0, 13.0, local(500.0, 0.0, 0.0)));
    history.insert(&sample(0, 14.0, local(502.0, 0.0, 0.0)));
    let NavGap::TooFast { speed_m_per_s } = settle(&mut history, 12.1, 0.2).expect_err("a jump")
    else {
        panic!("too fast")
    };
    assert!((speed_m_per_s - 950.0).abs() < 1.0, "{speed_m_per_s}");
    let c = history.counts();
    assert_eq!((c.no_data, c.stale, c.holes, c.too_fast), (2, 1, 2, 1));
}

#[test]
fn nothing_is_interpolated_across_the_loop_of_a_log() {
    let mut history = NavHistory::new(&nav_spec(vec![log_source(&FULL)]));
    feed(&mut history, 1.0, 9.0, steady);
    history.seam(T0.plus_s(9.5));
    for k in 10..20 {
        let t = f64::from(k);
        for quantity in steady(t - 10.0) {
            history.insert(&sample(0, t, quantity));
        }
    }
    for (time_s, window_s, ok) in [
        (8.5, 0.4, true),
        (8.5, 0.5, true),
        (8.5, 0.6, false),
        (9.2, 0.1, false),
        (9.7, 0.1, false),
        (9.7, 0.6, false),
        (10.0, 0.5, true),
        (10.2, 0.5, true),
    ] {
        match settle(&mut history, time_s, window_s) {
            Ok(state) => {
                assert!(ok, "{time_s}");
                let speed = state.pose.velocity_m_per_s;
                assert!(
                    (speed - DVec3::new(2.0, 0.0, 0.0)).length() < 1e-9,
                    "{speed}"
                );
            }
            Err(gap) => assert!(!ok && gap == NavGap::Seam, "{time_s}: {gap:?}"),
        }
    }
    assert_eq!(history.counts().seams, 4);
}

#[test]
fn heading_comes_from_the_course_or_the_track_where_no_source_gives_it() {
    // Circle with a radius of 50 m, once in 100 s, clockwise from heading north.
    let angle = |t: f64| TAU * t / 100.0;
    for with_course in [true, false] {
        let mut provides = vec![NavChannel::Position, NavChannel::RollPitch];
        if with_course {
            provides.push(NavChannel::CourseSpeed);
        }
        let mut spec = nav_spec(vec![log_source(&provides)]);
        let nowhere = settle(&mut NavHistory::new(&spec), 1.0, 0.1);
        assert!(nowhere.is_err());
        spec.heading_from_course = Some(true);
        let mut history = NavHistory::new(&spec);
        for k in 0..20 {
            let t = f64::from(k);
            let a = angle(t);
            history.insert(&sample(0, t, local(50.0 * a.sin(), -50.0 * a.cos(), 0.0)));
            history.insert(&sample(0, t, roll_pitch(1.0, 2.0)));
            history.insert(&sample(
                0,
                t,
                NavQuantity::CourseSpeed {
                    course_rad: a,
                    speed_m_per_s: 3.0,
                },
            ));
        }
        for time_s in [5.0, 8.3, 12.9] {
            let state = settle(&mut history, time_s, 0.2).expect("settled");
            let error_deg = (state.heading_rad - angle(time_s)).to_degrees().abs();
            let limit_deg = if with_course { 1e-9 } else { 0.01 };
            assert!(error_deg < limit_deg, "{with_course} {time_s}: {error_deg}");
            assert!((state.roll_rad.to_degrees() - 1.0).abs() < 1e-9);
        }
    }
}

#[test]
fn without_roll_and_pitch_the_platform_is_level() {
    let spec = nav_spec(vec![log_source(&[
        NavChannel::Position,
        NavChannel::Heading,
    ])]);
    let mut history = NavHistory::new(&spec);
    feed(&mut history, 1.0, 8.0, steady);
    let state = settle(&mut history, 4.2, 0.1).expect("settled");
    assert_eq!(
        angles_from_rotation(state.pose.world_from_body),
        (0.0, 0.0, 0.0)
    );
    assert_eq!(history.counts().not_owned, 18);
    assert_eq!(state.heave_down_m, 0.0);
}

/// Straight motion at 5 m/s over the antimeridian, and 3 m beside either pole. Longitudes jump, but the track does not.
#[test]
fn a_track_over_the_dateline_and_by_the_poles_is_straight() {
    for (latitude_deg, longitude_deg) in [
        (0.0, 180.0),
        (65.0, -180.0),
        (90.0, 0.0),
        (-90.0, 77.0),
        (-16.0, 179.9999),
    ] {
        let plane = LocalTangentPlane::new(
            f64::to_radians(latitude_deg),
            f64::to_radians(longitude_deg),
        );
        let mut history = NavHistory::new(&nav_spec(vec![log_source(&FULL)]));
        let mut longitudes = Vec::new();
        for k in 0..=100 {
            let t = f64::from(k) * 0.1;
            // From 25 m on one side to 25 m on the other.
            let (latitude_rad, longitude_rad) = plane.geodetic_rad(3.0, 5.0 * t - 25.0);
            longitudes.push(longitude_rad);
            let position = NavQuantity::Position {
                latitude_rad,
                longitude_rad,
                height_m: None,
                fix: FixQuality::Autonomous,
            };
            for quantity in [position, heading(0.0), roll_pitch(0.0, 0.0), heave(0.0)] {
                history.insert(&sample(0, t, quantity));
            }
        }
        let turns = longitudes.windows(2).map(|w| (w[1] - w[0]).abs());
        let max_deg = turns.fold(0.0, f64::max).to_degrees();
        assert!(max_deg > 1.0, "it does pass an edge: {max_deg} deg");
        let start = settle(&mut history, 1.0, 0.1).expect("settled");
        for t in [2.0, 4.95, 5.0, 5.05, 9.0] {
            let state = settle(&mut history, t, 0.1).expect("settled");
            let way = (state.pose.position_m - start.pose.position_m).length();
            let speed = state.pose.velocity_m_per_s.length();
            // The origin is the first fix, 25 m from the plane at the edge: 4e-6 rad.
            assert!(
                (way - 5.0 * (t - 1.0)).abs() < 1e-5 && (speed - 5.0).abs() < 1e-5,
                "({latitude_deg}, {longitude_deg}) at {t}: {way} m, {speed} m/s"
            );
            let (latitude, longitude) = plane.geodetic_rad(3.0, 5.0 * t - 25.0);
            let east_m = (longitude - state.longitude_rad).sin() * 6.4e6 * latitude.cos();
            let north_m = (latitude - state.latitude_rad) * 6.4e6;
            assert!(
                east_m.hypot(north_m) < 1e-4,
                "({latitude_deg}, {longitude_deg}) at {t}: {north_m} m north, {east_m} m east"
            );
        }
    }
}

#[test]
fn duplicates_late_and_foreign_samples_are_counted() {
    let mut history = NavHistory::new(&nav_spec(vec![log_source(&FULL), log_source(&FULL)]));
    feed(&mut history, 1.0, 6.0, steady);
    history.insert(&sample(0, 2.0, heave(9.0)));
    history.insert(&sample(1, 2.5, heave(9.0)));
    settle(&mut history, 3.0, 0.1).expect("settled");
    history.insert(&sample(0, 2.5, heave(0.0)));
    let c = history.counts();
    assert_eq!(
        (c.duplicates, c.not_owned, c.late, c.out_of_order),
        (1, 1, 1, 1)
    );
    assert_eq!(c.inserted, 4 * 7 + 1);
}

#[test]
fn a_track_of_two_points_is_a_straight_line_however_long() {
    let mut source = log_source(&[
        NavChannel::Position,
        NavChannel::Heading,
        NavChannel::RollPitch,
    ]);
    source.input = NavInputSpec::Csv {
        path: "line.csv".into(),
    };
    let mut spec = nav_spec(vec![source]);
    spec.vertical = VerticalSpec::Depth;
    spec.history_s = 4000.0;
    let mut history = NavHistory::new(&spec);
    for t in [0.0, 3600.0] {
        history.insert(&sample(0, t, local(1.5 * t, 0.0, 7.0)));
        history.insert(&sample(0, t, heading(0.0)));
        history.insert(&sample(0, t, roll_pitch(0.0, 0.0)));
    }
    let state = settle(&mut history, 1000.0, 1.0).expect("settled");
    assert!((state.pose.position_m - DVec3::new(1500.0, 0.0, 7.0)).length() < 1e-9);
    assert_eq!(history.origin().map(|p| p.origin_rad()), Some((0.0, 0.0)));
}

#[test]
fn a_source_without_configured_channels_provides_what_it_sends() {
    let open = || {
        let mut source = log_source(&NavChannel::ALL);
        source.detect = true;
        source
    };
    let mut first = open();
    first.lever_arm_m = DVec3::new(10.0, 0.0, 0.0);
    let mut history = NavHistory::new(&nav_spec(vec![first, open()]));
    assert!(history.is_detecting() && history.first_usable_utc().is_none());
    for k in 0..=20 {
        let t = 0.1 * f64::from(k);
        assert!(history.first_usable_utc().is_none(), "{t}");
        history.insert(&sample(1, t, local(2.0 * t, 0.0, 0.0)));
        history.insert(&sample(1, t, heading(0.0)));
    }
    // After two seconds the channels of a source are known.
    assert_eq!(history.first_usable_utc(), Some(T0));
    assert_eq!(history.active_source(NavChannel::Heading), Some(1));
    assert_eq!(history.active_source(NavChannel::RollPitch), None);
    let state = settle(&mut history, 1.0, 0.2).expect("level without attitude");
    // The lever arm of the first source, which sends no sample, has no effect.
    assert!((state.pose.position_m.x - 2.0).abs() < 1e-9);

    // From its first sample on, a quantity counts and is needed.
    history.insert(&sample(0, 2.1, roll_pitch(3.0, 0.0)));
    assert_eq!(history.active_source(NavChannel::RollPitch), Some(0));
    assert!(settle(&mut history, 1.5, 0.2).is_err());
}

#[test]
fn after_warm_up_a_state_allocates_nothing() {
    let mut spec = nav_spec(vec![log_source(&FULL)]);
    spec.sources[0].lever_arm_m = DVec3::new(1.0, 0.0, -5.0);
    let mut history = NavHistory::new(&spec);
    feed(&mut history, 50.0, 20.0, swell);
    let mut trajectory = Trajectory::default();
    let mut ping = |k: u32| {
        history
            .motion(
                T0.plus_s(3.0 + 0.1 * f64::from(k)),
                0.4,
                NavMode::Settle,
                &mut trajectory,
            )
            .expect("settled");
    };
    (0..20).for_each(&mut ping);
    let before = echotank_testing::allocations::on_this_thread();
    (20..100).for_each(&mut ping);
    assert_eq!(echotank_testing::allocations::on_this_thread() - before, 0);
}

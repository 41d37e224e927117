//! Tests of lever arms, mounting angles, depth sensors, towing and silent sources against closed forms.

use std::f64::consts::TAU;

use echotank_config::spec::{
    ChecksumPolicy, NavChannel, NavMode, NavSourceSpec, NavSpec, OnLost, TowSpec, VerticalSpec,
};
use echotank_core::frames::{Trajectory, angles_from_rotation, rotation_from_angles};
use echotank_core::navigation::{FixQuality, NavInvalid, NavQuantity, NavState};
use echotank_nav::{Coverage, NavDecoder, NavGap, NavHistory};
use glam::DVec3;

use crate::{T0, log_source, nav_spec, sample};

use NavChannel::{Depth, Heading, Heave, Position, RollPitch};

fn source(provides: &[NavChannel]) -> NavSourceSpec {
    NavSourceSpec {
        checksum: ChecksumPolicy::AcceptMissing,
        ..log_source(provides)
    }
}

fn spec(vertical: VerticalSpec, sources: Vec<NavSourceSpec>) -> NavSpec {
    NavSpec {
        vertical,
        on_lost: OnLost::Hold,
        ..nav_spec(sources)
    }
}

const WATERLINE: VerticalSpec = VerticalSpec::Waterline {
    reference_down_m: 2.0,
};

fn put(history: &mut NavHistory, source: u16, time_s: f64, quantity: NavQuantity) {
    history.insert(&sample(source, time_s, quantity));
}

fn local(at: DVec3) -> NavQuantity {
    NavQuantity::LocalPosition {
        north_m: at.x,
        east_m: at.y,
        down_m: at.z,
    }
}

/// Roll, pitch and heading of a platform in a swell, radians.
fn angles(t: f64) -> (f64, f64, f64) {
    let wave = |deg: f64, period_s: f64| (deg * (TAU * t / period_s).sin()).to_radians();
    (wave(8.0, 7.0), wave(5.0, 6.0), 0.7 + wave(3.0, 11.0))
}

fn settle(history: &mut NavHistory, time_s: f64) -> NavState {
    let mut trajectory = Trajectory::default();
    let utc = T0.plus_s(time_s);
    assert_eq!(history.coverage(utc, utc.plus_s(0.2)), Coverage::Ready);
    history
        .motion(utc, 0.2, NavMode::Settle, &mut trajectory)
        .expect("settled")
}

fn predict(history: &mut NavHistory, time_s: f64) -> Result<NavState, NavGap> {
    let mut trajectory = Trajectory::default();
    history.motion(T0.plus_s(time_s), 0.1, NavMode::Predict, &mut trajectory)
}

/// A heave sensor 12 m ahead and 3 m to port of the reference point measures pitch as heave. A sensor 20 m up the mast measures a
/// small induced heave.
#[test]
fn heave_induced_by_a_lever_arm_is_removed() {
    for arm in [
        DVec3::new(12.0, -3.0, 1.0),
        DVec3::new(0.0, 0.0, -20.0),
        DVec3::ZERO,
    ] {
        let mut mru = source(&[Position, Heading, RollPitch, Heave]);
        mru.mounting.heave_arm_m = arm;
        let mut history = NavHistory::new(&spec(WATERLINE, vec![mru]));
        let truth = |t: f64| 0.8 * (TAU * t / 6.5).sin();
        let mut induced_most = 0.0_f64;
        for k in 0..=400 {
            let t = f64::from(k) * 0.02;
            let (roll_rad, pitch_rad, heading_rad) = angles(t);
            // Heave induced by roll and pitch, from Rz Ry Rx.
            let induced = -arm.x * pitch_rad.sin()
                + pitch_rad.cos() * (arm.y * roll_rad.sin() + arm.z * roll_rad.cos())
                - arm.z;
            induced_most = induced_most.max(induced.abs());
            put(&mut history, 0, t, local(DVec3::ZERO));
            put(&mut history, 0, t, NavQuantity::Heading { heading_rad });
            put(
                &mut history,
                0,
                t,
                NavQuantity::RollPitch {
                    roll_rad,
                    pitch_rad,
                },
            );
            let heave_down_m = truth(t) + induced;
            put(&mut history, 0, t, NavQuantity::Heave { heave_down_m });
        }
        for t in [1.513, 3.07, 5.555] {
            let state = settle(&mut history, t);
            let error = state.heave_down_m - truth(t);
            assert!(
                error.abs() < 1e-4,
                "{arm} at {t}: off by {error} m of {induced_most} m"
            );
            assert!((state.pose.position_m.z - 2.0 - state.heave_down_m).abs() < 1e-12);
        }
        assert!(arm == DVec3::ZERO || induced_most > 0.2, "{induced_most}");
    }
}

/// A misaligned instrument gives the angles of its own axes. A separate compass gives the heading plus its mounting error.
#[test]
fn mounting_angles_of_motion_sensor_and_compass_are_removed() {
    let askew = DVec3::new(2.0, -3.0, 30.0).map(f64::to_radians);
    for separate_compass in [false, true] {
        let mut mru = source(&[Position, Heading, RollPitch]);
        mru.mounting.angles_rad = askew;
        let mut compass = source(&[Heading]);
        compass.mounting.angles_rad = DVec3::new(0.0, 0.0, 4.0_f64.to_radians());
        let mut sources = vec![mru];
        if separate_compass {
            sources[0].provides = vec![Position, RollPitch];
            sources.push(compass);
        }
        let mut history = NavHistory::new(&spec(WATERLINE, sources));
        for k in 0..=400 {
            let t = f64::from(k) * 0.02;
            let (roll, pitch, heading) = angles(t);
            let sensor = rotation_from_angles(roll, pitch, heading)
                * rotation_from_angles(askew.x, askew.y, askew.z);
            let (roll_rad, pitch_rad, heading_rad) = angles_from_rotation(sensor);
            put(&mut history, 0, t, local(DVec3::ZERO));
            put(
                &mut history,
                0,
                t,
                NavQuantity::RollPitch {
                    roll_rad,
                    pitch_rad,
                },
            );
            let heading = match separate_compass {
                true => (1, heading + 4.0_f64.to_radians()),
                false => (0, heading_rad),
            };
            let quantity = NavQuantity::Heading {
                heading_rad: heading.1,
            };
            put(&mut history, heading.0, t, quantity);
        }
        for t in [1.513, 3.07, 5.555] {
            let state = settle(&mut history, t);
            let (roll, pitch, heading) = angles(t);
            let got = [state.roll_rad, state.pitch_rad, state.heading_rad];
            for (got, want) in got.into_iter().zip([roll, pitch, heading]) {
                let error_deg = (got - want).to_degrees();
                assert!(
                    error_deg.abs() < 1e-3,
                    "compass {separate_compass}, {t}: {error_deg} deg"
                );
            }
        }
    }
}

#[test]
fn a_depth_sensor_on_an_arm_gives_the_depth_and_heave_is_not_counted_twice() {
    let arm = DVec3::new(-2.0, 0.5, 1.5);
    let mut pressure = source(&[Depth]);
    pressure.lever_arm_m = arm;
    let sources = vec![source(&[Position, Heading, RollPitch, Heave]), pressure];
    let mut history = NavHistory::new(&spec(VerticalSpec::Depth, sources));
    let depth = |t: f64| 40.0 + 2.0 * (TAU * t / 9.0).sin();
    for k in 0..=160 {
        let t = f64::from(k) * 0.05;
        let (roll_rad, pitch_rad, heading_rad) = angles(t);
        let position = NavQuantity::Position {
            latitude_rad: 0.9,
            longitude_rad: 0.1,
            height_m: None,
            fix: FixQuality::DeadReckoning,
        };
        put(&mut history, 0, t, position);
        put(&mut history, 0, t, NavQuantity::Heading { heading_rad });
        put(
            &mut history,
            0,
            t,
            NavQuantity::RollPitch {
                roll_rad,
                pitch_rad,
            },
        );
        // The depth already contains the heave of a heave sensor beside it.
        put(
            &mut history,
            0,
            t,
            NavQuantity::Heave {
                heave_down_m: depth(t) - 40.0,
            },
        );
        if k % 2 == 0 {
            let turned = rotation_from_angles(roll_rad, pitch_rad, heading_rad) * arm;
            put(
                &mut history,
                1,
                t,
                NavQuantity::Depth {
                    depth_m: depth(t) + turned.z,
                },
            );
        }
    }
    for t in [1.513, 3.07, 5.555] {
        let state = settle(&mut history, t);
        let error = state.pose.position_m.z - depth(t);
        assert!(error.abs() < 5e-4, "{t}: {error} m");
        assert_eq!(
            (state.heave_down_m, state.height_m),
            (0.0, -state.pose.position_m.z)
        );
    }
    assert_eq!(history.counts().no_vertical, 0);
}

#[test]
fn depth_comes_from_the_configured_sentences() {
    let mut own = source(&[Depth]);
    own.dialect.depth_is_own = true;
    let decode = |spec: &NavSourceSpec, text: &str| {
        let mut decoder = NavDecoder::new(0, spec);
        let mut samples = Vec::new();
        decoder.push(text.as_bytes(), T0, &mut samples);
        decoder.flush(&mut samples);
        samples
            .iter()
            .map(|s| (s.quantity, s.valid_utc))
            .collect::<Vec<_>>()
    };
    let depth = |depth_m: f64| NavQuantity::Depth { depth_m };
    let plain = source(&[Depth]);
    let at = T0.plus_s(32_312.643_253);
    assert_eq!(
        decode(&plain, "$PIXSE,DEPIN_,732.811,085832.643253*7D\r\n"),
        [(depth(732.811), at)]
    );
    assert_eq!(decode(&plain, "$PIPS,0001.00,M*78\r\n"), [(depth(1.0), T0)]);
    assert_eq!(
        decode(&plain, "$PIPS,0001.00,*19\r\n"),
        [],
        "pressure, perhaps"
    );
    for text in [
        "$SDDPT,12.5,0.0\r\n",
        "$SDDBT,,f,12.5,M,,F\r\n",
        "$SDDBS,,f,12.5,M,,F\r\n",
    ] {
        assert_eq!(decode(&plain, text), [], "of the water: {text}");
        assert_eq!(decode(&own, text), [(depth(12.5), T0)], "{text}");
    }
}

/// The towfish is on 50 m of cable, 30 m below the tow point and 40 m behind it. The antenna is 10 m ahead of the tow point.
#[test]
fn a_towfish_is_astern_by_its_layback_from_cable_and_depth() {
    let heading = 30.0_f64.to_radians();
    let ahead = DVec3::new(heading.cos(), heading.sin(), 0.0);
    let starboard = DVec3::new(-heading.sin(), heading.cos(), 0.0);
    for by_sensor in [true, false] {
        let mut gnss = source(&[Position, Heading]);
        gnss.lever_arm_m = DVec3::new(4.0, 1.0, -15.0);
        let vertical = match by_sensor {
            true => VerticalSpec::Depth,
            false => VerticalSpec::Waterline {
                reference_down_m: 28.0,
            },
        };
        let mut sources = vec![gnss];
        if by_sensor {
            sources.push(source(&[Depth]));
        }
        let mut spec = spec(vertical, sources);
        spec.tow = Some(TowSpec {
            point_m: DVec3::new(-6.0, -2.0, -2.0),
            cable_out_m: 62.5,
            cable_scope: 0.8,
        });
        let mut history = NavHistory::new(&spec);
        // The cable length is constant. From 28 to 48 m depth the layback decreases from 40 m to 0.
        let depth = |t: f64| if by_sensor { 28.0 + t } else { 28.0 };
        for k in 0..=200 {
            let t = f64::from(k) * 0.1;
            put(
                &mut history,
                0,
                t,
                NavQuantity::Heading {
                    heading_rad: heading,
                },
            );
            if k % 10 == 0 {
                put(&mut history, 0, t, local(ahead * (2.0 * t)));
            }
            if by_sensor {
                put(&mut history, 1, t, NavQuantity::Depth { depth_m: depth(t) });
            }
        }
        for t in [3.0, 6.0, 12.0] {
            let state = settle(&mut history, t);
            let under = depth(t) + 2.0;
            let behind = (50.0 * 50.0 - under * under).sqrt();
            let want = ahead * (2.0 * t - 10.0 - behind) - starboard * 3.0 + DVec3::Z * depth(t);
            let error = (state.pose.position_m - want).length();
            assert!(error < 1e-6, "{t}, by sensor {by_sensor}: {error} m");
        }
    }
}

/// Attitude and position at 10 Hz until `until_s[0]` and `until_s[1]`; the heading does not end.
fn silenced(on_lost: OnLost, until_s: [f64; 2]) -> NavHistory {
    let sources = vec![
        source(&[Position]),
        source(&[Heading]),
        source(&[RollPitch, Heave]),
    ];
    let mut spec = spec(WATERLINE, sources);
    spec.on_lost = on_lost;
    let mut history = NavHistory::new(&spec);
    for k in 0..=600 {
        let t = f64::from(k) * 0.1;
        let heading_rad = (0.01 * t).rem_euclid(TAU);
        put(&mut history, 1, t, NavQuantity::Heading { heading_rad });
        if t <= until_s[0] {
            put(&mut history, 0, t, local(DVec3::new(3.0 * t, 0.0, 0.0)));
        }
        if t <= until_s[1] {
            let tilt = NavQuantity::RollPitch {
                roll_rad: 0.02 * t,
                pitch_rad: 0.05,
            };
            put(&mut history, 2, t, tilt);
            put(
                &mut history,
                2,
                t,
                NavQuantity::Heave {
                    heave_down_m: 0.1 * t,
                },
            );
        }
        if k == 0 {
            // An early first fix.
            history
                .motion(T0, 0.0, NavMode::Settle, &mut Trajectory::default())
                .ok();
        }
    }
    history
}

#[test]
fn during_silence_pings_continue_at_rest_and_flag_invalid_channels() {
    let mut history = silenced(OnLost::Hold, [5.0, 8.0]);
    let valid = NavInvalid::default();
    // The window of 0.1 s ends within the 0.25 s.
    let fresh = predict(&mut history, 60.0);
    let lost = fresh.expect("pings go on");
    assert_eq!(
        lost.invalid,
        NavInvalid {
            position: true,
            roll_pitch: true,
            vertical: true,
            ..valid
        }
    );
    assert!(lost.extrapolated);
    assert!(
        (lost.position_age_s - 55.0).abs() < 1e-6,
        "{}",
        lost.position_age_s
    );
    assert!(
        (lost.attitude_age_s - 52.0).abs() < 1e-6,
        "{}",
        lost.attitude_age_s
    );
    // The motion is extrapolated for 0.25 s. Half of that distance is added while it comes to rest.
    let north = 15.0 + 3.0 * 0.25 * 1.5;
    let at = lost.pose.position_m;
    assert!(
        (at - DVec3::new(north, 0.0, 2.8 + 0.1 * 0.25 * 1.5)).length() < 1e-6,
        "{at}"
    );
    assert!(lost.pose.velocity_m_per_s.length() < 1e-9);
    let (roll, heading) = (lost.roll_rad, lost.heading_rad);
    assert!((roll - 0.16).abs() < 1e-6, "as last known: {roll}");
    assert!(
        (heading - 0.6).abs() < 1e-6,
        "the compass goes on: {heading}"
    );

    let mut history = silenced(OnLost::Skip, [5.0, 8.0]);
    assert!(matches!(
        predict(&mut history, 60.0),
        Err(NavGap::Stale {
            channel: Position,
            ..
        })
    ));
}

#[test]
fn a_value_is_extrapolated_and_valid_up_to_the_limit() {
    for (time_s, invalid) in [(60.0, false), (60.14, false), (60.16, true)] {
        let mut history = silenced(OnLost::Hold, [60.0, 60.0]);
        let state = predict(&mut history, time_s).expect("a state");
        assert_eq!(state.invalid.any(), invalid, "{time_s}");
        let error = state.pose.position_m.x - 3.0 * time_s;
        assert!(error.abs() < 1e-6, "{time_s}: {error} m");
    }
}

//! An invented track for rigs without navigation: an oval, so that it can repeat without a jump.

use std::f64::consts::{PI, TAU};
use std::fmt::Write;

use echotank_nav::track::HEADER;

/// Geographic position of north = east = 0, degrees.
pub(super) const ORIGIN_DEG: [f64; 2] = [54.3, 10.2];
/// 2026-11-01 00:00:00 UTC, seconds since 1970.
const START_S: f64 = 1_793_491_200.0;
const STEP_S: f64 = 0.2;
const STEPS: usize = 1000;
/// The radius of the turns, and the length of the straight legs that makes the speed 2.5 m/s.
const TURN_M: f64 = 30.0;
const LEG_M: f64 = 0.5 * 2.5 * STEP_S * STEPS as f64 - PI * TURN_M;
/// Amplitudes of the swell: heave, roll and pitch.
const HEAVE_M: f64 = 0.1;
const ROLL_DEG: f64 = 2.0;
const PITCH_DEG: f64 = 1.0;
/// Whole numbers of swings along the oval: periods of 8, 6.25 and 5 s.
const SWINGS: [f64; 3] = [25.0, 32.0, 40.0];

/// North and east, metres, and heading, degrees, so far along the oval.
fn place(along_m: f64) -> (f64, f64, f64) {
    let turn_m = PI * TURN_M;
    let half = along_m % (LEG_M + turn_m);
    let back = along_m >= LEG_M + turn_m;
    // On the way north; the way back is the same, rotated by half a turn about the centre.
    let (north_m, east_m, turned) = match half < LEG_M {
        true => (half, 0.0, 0.0),
        false => {
            let angle = (half - LEG_M) / TURN_M;
            let (sine, cosine) = libm::sincos(angle);
            (LEG_M + TURN_M * sine, TURN_M * (1.0 - cosine), angle)
        }
    };
    match back {
        true => (
            LEG_M - north_m,
            2.0 * TURN_M - east_m,
            turned.to_degrees() + 180.0,
        ),
        false => (north_m, east_m, turned.to_degrees()),
    }
}

/// The text of the track.
pub(super) fn text() -> String {
    let mut text = format!(
        "# An invented oval at 2.5 m/s with a slight swell, written by `echotank new`. It ends where it begins.\n{HEADER}\n"
    );
    for step in 0..=STEPS {
        let share = step as f64 / STEPS as f64;
        let (north_m, east_m, heading_deg) = match step {
            STEPS => (0.0, 0.0, 0.0),
            _ => place(share * 2.0 * (LEG_M + PI * TURN_M)),
        };
        let [heave, roll, pitch] = SWINGS.map(|swings| libm::sin(TAU * swings * share));
        let _ = writeln!(
            text,
            "{:.2},{north_m:.3},{east_m:.3},{:.3},{:.3},{:.3},{heading_deg:.3}",
            START_S + STEP_S * step as f64,
            HEAVE_M * heave,
            ROLL_DEG * roll,
            PITCH_DEG * pitch,
        );
    }
    text
}

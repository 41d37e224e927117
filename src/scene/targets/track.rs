//! CSV tracks of moving targets: `utc_s` or `elapsed_s`, `north_m`, `east_m`, `down_m`.
//!
//! `utc_s` counts from 1970, `elapsed_s` from the first fix of the navigation. Positions are the scene's. Between the rows the track is a cubic through the
//! positions, with the velocities of the parabola through each row and its neighbours.

use glam::DVec3;

use super::ParsedCourse;
use crate::text::{
    Column, MAX_HORIZONTAL_M, MAX_VERTICAL_M, TextError, optional, read_table, required,
};
use echotank_core::frames::VectorKnot;
use echotank_core::time::UtcNs;

const COLUMNS: [Column; 5] = [
    required("north_m"),
    required("east_m"),
    required("down_m"),
    optional("utc_s"),
    optional("elapsed_s"),
];
const MAX_ROWS: usize = 1 << 20;
/// Times from 1970 to 2200, seconds.
const UTC_S: (f64, f64) = (0.0, 7.3e9);
/// Greatest speed of a target, metres per second.
pub(super) const MAX_SPEED_M_PER_S: f64 = 100.0;

/// Reads a track.
///
/// # Errors
/// The line, the column, the value and the rule it breaks.
pub(super) fn parse(bytes: &[u8]) -> Result<ParsedCourse, TextError> {
    let mut origin: Option<UtcNs> = None;
    let mut knots: Vec<VectorKnot> = Vec::new();
    let mut last_line = 1;
    read_table(bytes, &COLUMNS, |row| {
        last_line = row.line;
        let dated = row.text(3).is_some();
        if dated == row.text(4).is_some() {
            let rule = "the header must name either utc_s or elapsed_s";
            return Err(TextError::new(row.line, "", rule));
        }
        let column = if dated { 3 } else { 4 };
        let range = if dated { UTC_S.0 } else { -UTC_S.1 }..=UTC_S.1;
        let mut time_s = row.number(column, range, 0.0)?;
        if dated {
            // Whole nanoseconds; the rest is the time after the first row.
            let utc = UtcNs((time_s * 1e9).round() as i64);
            let first = *origin.get_or_insert(utc);
            time_s = (utc.0 - first.0) as f64 * 1e-9;
        }
        if knots.last().is_some_and(|before| time_s <= before.time_s) {
            return Err(row.text_error(column, "must be later than in the row before"));
        }
        if knots.len() == MAX_ROWS {
            return Err(row.text_error(column, format!("at most {MAX_ROWS} rows are read")));
        }
        let level = -MAX_HORIZONTAL_M..=MAX_HORIZONTAL_M;
        let at_m = DVec3::new(
            row.number(0, level.clone(), 0.0)?,
            row.number(1, level, 0.0)?,
            row.number(2, -MAX_VERTICAL_M..=MAX_VERTICAL_M, 0.0)?,
        );
        if let Some(before) = knots.last() {
            let speed = at_m.distance(before.value) / (time_s - before.time_s);
            if speed > MAX_SPEED_M_PER_S {
                let rule = format!(
                    "the target moves at {speed:.1} m/s; at most {MAX_SPEED_M_PER_S} m/s is allowed"
                );
                return Err(row.text_error(column, rule));
            }
        }
        knots.push(VectorKnot {
            time_s,
            value: at_m,
            rate_per_s: DVec3::ZERO,
        });
        Ok(())
    })?;
    if knots.len() < 2 {
        let rule = format!("{} rows: a track must have at least two", knots.len());
        return Err(TextError::new(last_line, "", rule));
    }
    set_rates(&mut knots);
    Ok(ParsedCourse { knots, origin })
}

/// Velocities at the knots: of the parabola through a knot and its neighbours, at the ends through the three last.
fn set_rates(knots: &mut [VectorKnot]) {
    let slope = |a: &VectorKnot, b: &VectorKnot| (b.value - a.value) / (b.time_s - a.time_s);
    let last = knots.len() - 1;
    for k in 0..=last {
        let middle = k.clamp(1, last.max(2) - 1).min(last);
        knots[k].rate_per_s = match knots.get(middle + 1) {
            None => slope(&knots[0], &knots[1]),
            Some(after) => {
                let (before, at) = (&knots[middle - 1], &knots[middle]);
                let (left, right) = (slope(before, at), slope(at, after));
                let bend = (right - left) / (after.time_s - before.time_s);
                left + bend * (2.0 * knots[k].time_s - before.time_s - at.time_s)
            }
        };
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use echotank_core::frames::hermite;

    /// A cubic through three points of a parabola is the parabola.
    #[test]
    fn a_parabola_is_followed() {
        let mut text = "elapsed_s,north_m,east_m,down_m\n".to_owned();
        for t in [0.0, 1.0, 2.5, 4.0, 7.0] {
            text += &format!("{t},{},{},{}\n", 3.0 * t, 0.5 * t * t, 10.0 - t);
        }
        let track = parse(text.as_bytes()).expect("a track");
        assert!(track.origin.is_none());
        for t in [0.2, 1.7, 3.0, 6.9] {
            let (at_m, v) = hermite(&track.knots, t);
            let want = DVec3::new(3.0 * t, 0.5 * t * t, 10.0 - t);
            assert!(at_m.distance(want) < 1e-12, "{t}: {at_m}");
            assert!(v.distance(DVec3::new(3.0, t, -1.0)) < 1e-12, "{t}: {v}");
        }
    }

    #[test]
    fn two_rows_are_a_straight_track_with_a_date() {
        let text = "utc_s,north_m,east_m,down_m\n1700000000.5,0,0,5\n1700000010.5,20,-10,5\n";
        let track = parse(text.as_bytes()).expect("a track");
        assert_eq!(track.origin, Some(UtcNs(1_700_000_000_500_000_000)));
        for knot in &track.knots {
            assert_eq!(knot.rate_per_s, DVec3::new(2.0, -1.0, 0.0));
        }
    }

    #[test]
    fn a_bad_track_is_refused_with_line_and_rule() {
        let head = "elapsed_s,north_m,east_m,down_m\n";
        for (text, words) in [
            (
                format!("{head}0,0,0,0\n"),
                "line 2: ``: 1 rows: a track must have at least two",
            ),
            (
                format!("{head}0,0,0,0\n0,1,0,0\n"),
                "line 3, column `elapsed_s`: `0`: must be later than in the row before",
            ),
            (
                format!("{head}0,0,0,0\n1,101,0,0\n"),
                "line 3, column `elapsed_s`: `1`: the target moves at 101.0 m/s; at most 100",
            ),
            (
                "north_m,east_m,down_m\n0,0,0\n".to_owned(),
                "line 2: ``: the header must name either utc_s or elapsed_s",
            ),
        ] {
            let Err(error) = parse(text.as_bytes()) else {
                panic!("{text}");
            };
            assert!(error.to_string().starts_with(words), "{error}");
        }
    }
}

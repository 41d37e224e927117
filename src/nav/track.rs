//! Reads CSV tracks with the header `HEADER` to local positions, attitudes and headings.
//!
//! `time_s` is UTC in seconds since 1970, in plain decimals. The decimal digits are converted to nanoseconds without rounding.
//! Times increase strictly. Empty lines and lines that start with `#` are skipped.

use thiserror::Error;

use super::fields::fraction_ns;
use echotank_config::spec::NavChannel;
use echotank_core::navigation::{NavQuantity, NavSample};
use echotank_core::time::{NS_PER_S, UtcNs};

/// First line of a track.
pub const HEADER: &str = "time_s,north_m,east_m,down_m,roll_deg,pitch_deg,heading_deg";
const COLUMNS: [&str; 7] = [
    "time_s",
    "north_m",
    "east_m",
    "down_m",
    "roll_deg",
    "pitch_deg",
    "heading_deg",
];

/// Maximum number of points: 29 hours at 20 Hz. The samples of so many points take about 500 MB.
const MAX_POINTS: usize = 1 << 21;

/// Reason why a track is refused, with file and line.
#[derive(Debug, Error, PartialEq, Eq)]
pub enum TrackError {
    /// The first line is not the header.
    #[error("{file}:{line}: the header must be `{HEADER}`, found `{found}`")]
    Header {
        /// Name of the file.
        file: String,
        /// Line number, from 1.
        line: usize,
        /// Text of the line.
        found: String,
    },
    /// A value is not a number, out of range, or out of order.
    #[error("{file}:{line}: column `{column}`: `{value}` {rule}")]
    Value {
        /// Name of the file.
        file: String,
        /// Line number, from 1.
        line: usize,
        /// Name of the column.
        column: &'static str,
        /// Text of the value.
        value: String,
        /// Violated rule.
        rule: &'static str,
    },
    /// A line has the wrong number of columns.
    #[error("{file}:{line}: {found} columns, the header has 7")]
    Columns {
        /// Name of the file.
        file: String,
        /// Line number, from 1.
        line: usize,
        /// Number of columns.
        found: usize,
    },
    /// The track has too many points.
    #[error("{file}:{line}: at most {MAX_POINTS} points are read: cut or thin the track")]
    TooLong {
        /// Name of the file.
        file: String,
        /// Line number, from 1.
        line: usize,
    },
    /// The track has fewer than two points.
    #[error("{file}: a track needs at least two points, found {found}")]
    TooShort {
        /// Name of the file.
        file: String,
        /// Number of points.
        found: usize,
    },
}

/// Samples of a track. Each line gives position, attitude and heading, as far as `provides` lists them. The arrival is equal to the
/// time of validity. `file` names the file in errors.
pub fn read_track(
    text: &str,
    file: &str,
    source: u16,
    provides: &[NavChannel],
) -> Result<Vec<NavSample>, TrackError> {
    let mut lines = text
        .lines()
        .enumerate()
        .map(|(i, line)| (i + 1, line.trim_start_matches('\u{feff}').trim()))
        .filter(|(_, line)| !line.is_empty() && !line.starts_with('#'));
    let (header_line, header) = lines.next().unwrap_or((1, ""));
    if !header.split(',').map(str::trim).eq(COLUMNS) {
        return Err(TrackError::Header {
            file: file.to_string(),
            line: header_line,
            found: header.to_string(),
        });
    }
    let mut samples = Vec::new();
    let mut points = 0;
    let mut before = None;
    for (line, text) in lines {
        let (time, row) = read_row(text, file, line)?;
        if before.is_some_and(|b| time <= b) {
            return Err(TrackError::Value {
                file: file.to_string(),
                line,
                column: COLUMNS[0],
                value: text.split(',').next().unwrap_or("").to_string(),
                rule: "is not after the line before",
            });
        }
        before = Some(time);
        if points == MAX_POINTS {
            return Err(TrackError::TooLong {
                file: file.to_string(),
                line,
            });
        }
        points += 1;
        push_row(time, &row, source, provides, &mut samples);
    }
    if points < 2 {
        return Err(TrackError::TooShort {
            file: file.to_string(),
            found: points,
        });
    }
    Ok(samples)
}

fn push_row(
    time: UtcNs,
    row: &[f64; 6],
    source: u16,
    provides: &[NavChannel],
    samples: &mut Vec<NavSample>,
) {
    let [north_m, east_m, down_m, roll_deg, pitch_deg, heading_deg] = *row;
    let quantities = [
        (
            NavChannel::Position,
            NavQuantity::LocalPosition {
                north_m,
                east_m,
                down_m,
            },
        ),
        (
            NavChannel::RollPitch,
            NavQuantity::RollPitch {
                roll_rad: roll_deg.to_radians(),
                pitch_rad: pitch_deg.to_radians(),
            },
        ),
        (
            NavChannel::Heading,
            NavQuantity::Heading {
                heading_rad: heading_deg.rem_euclid(360.0).to_radians(),
            },
        ),
    ];
    for (channel, quantity) in quantities {
        if provides.contains(&channel) {
            samples.push(NavSample {
                source,
                valid_utc: time,
                arrival_utc: time,
                quantity,
            });
        }
    }
}

fn read_row(text: &str, file: &str, line: usize) -> Result<(UtcNs, [f64; 6]), TrackError> {
    let found = text.split(',').count();
    if found != COLUMNS.len() {
        return Err(TrackError::Columns {
            file: file.to_string(),
            line,
            found,
        });
    }
    let refuse = |column: usize, value: &str, rule| TrackError::Value {
        file: file.to_string(),
        line,
        column: COLUMNS[column],
        value: value.to_string(),
        rule,
    };
    let mut time = UtcNs(0);
    let mut row = [0.0; 6];
    for (column, value) in text.split(',').map(str::trim).enumerate() {
        if column == 0 {
            time = seconds_to_ns(value).ok_or_else(|| {
                refuse(
                    0,
                    value,
                    "is not a time: UTC seconds since 1970 in plain decimals",
                )
            })?;
            continue;
        }
        let number = value.parse::<f64>().ok().filter(|v| v.is_finite());
        let number = number.ok_or_else(|| refuse(column, value, "is not a finite number"))?;
        if let Some(rule) = out_of_range(column, number) {
            return Err(refuse(column, value, rule));
        }
        row[column - 1] = number;
    }
    Ok((time, row))
}

fn out_of_range(column: usize, number: f64) -> Option<&'static str> {
    let (limit, rule) = match column {
        1 | 2 => (1.0e6, "is beyond the local plane (1000 km)"),
        3 => (12_000.0, "is beyond any ocean (12 km)"),
        4 => (180.0, "is not a roll (-180..180 degrees)"),
        5 => (90.0, "is not a pitch (-90..90 degrees)"),
        _ => (720.0, "is not a heading (degrees)"),
    };
    (number.abs() > limit).then_some(rule)
}

/// Nanoseconds of plain decimal seconds. The digits are converted without rounding; digits beyond the ninth decimal are ignored.
fn seconds_to_ns(text: &str) -> Option<UtcNs> {
    let (negative, digits) = match text.strip_prefix('-') {
        Some(rest) => (true, rest),
        None => (false, text),
    };
    let (whole, fraction) = digits.split_once('.').unwrap_or((digits, ""));
    let plain = |t: &str| t.bytes().all(|b| b.is_ascii_digit());
    if whole.is_empty() || !plain(whole) || !plain(fraction) {
        return None;
    }
    let ns = whole
        .parse::<i64>()
        .ok()?
        .checked_mul(NS_PER_S)?
        .checked_add(fraction_ns(fraction))?;
    Some(UtcNs(if negative { -ns } else { ns }))
}

#[cfg(test)]
mod tests {
    use super::*;

    const ALL: [NavChannel; 3] = [
        NavChannel::Position,
        NavChannel::RollPitch,
        NavChannel::Heading,
    ];
    fn read(rows: &str) -> Result<Vec<NavSample>, TrackError> {
        read_track(&format!("{HEADER}\n{rows}"), "t.csv", 3, &ALL)
    }

    #[test]
    fn times_are_exact_to_the_nanosecond() {
        let samples =
            read("1406851200.123456789,1,2,3,0,0,90\n1406851200.2,1,2,3,0,0,-90\n").expect("reads");
        assert_eq!(samples[0].valid_utc, UtcNs(1_406_851_200_123_456_789));
        assert_eq!(samples[3].valid_utc, UtcNs(1_406_851_200_200_000_000));
        assert_eq!(samples.len(), 6);
        let NavQuantity::Heading { heading_rad } = samples[5].quantity else {
            panic!("a heading")
        };
        assert!((heading_rad.to_degrees() - 270.0).abs() < 1e-12);
    }

    #[test]
    fn a_track_with_too_many_points_is_refused_with_its_line() {
        let rows = (0..=MAX_POINTS).map(|k| format!("{k},0,0,0,0,0,0\n"));
        let text: String = std::iter::once(format!("{HEADER}\n")).chain(rows).collect();
        let error = read_track(&text, "t.csv", 0, &[])
            .expect_err("refused")
            .to_string();
        let want = format!(
            "t.csv:{}: at most {MAX_POINTS} points are read: cut or thin the track",
            MAX_POINTS + 2
        );
        assert_eq!(error, want);
    }

    #[test]
    fn errors_name_file_line_column_value_and_rule() {
        let message = |rows: &str| read(rows).expect_err("refused").to_string();
        assert_eq!(
            message("0,1,2,3,0,0,0\n1,1,x,3,0,0,0\n"),
            "t.csv:3: column `east_m`: `x` is not a finite number"
        );
        assert_eq!(
            message("1e3,1,2,3,0,0,0\n"),
            "t.csv:2: column `time_s`: `1e3` is not a time: UTC seconds since 1970 in plain decimals"
        );
        assert_eq!(
            message("# a note\n1,1,2,3,0,0,0\n1,1,2,3,0,0,0\n"),
            "t.csv:4: column `time_s`: `1` is not after the line before"
        );
        assert_eq!(
            message("1,1,2,3,0,91,0\n"),
            "t.csv:2: column `pitch_deg`: `91` is not a pitch (-90..90 degrees)"
        );
        assert_eq!(message("1,1,2,3\n"), "t.csv:2: 4 columns, the header has 7");
        assert_eq!(
            message("1,1,2,3,0,0,0\n"),
            "t.csv: a track needs at least two points, found 1"
        );
        let header = read_track("time,north\n", "t.csv", 0, &ALL).expect_err("refused");
        assert_eq!(
            header.to_string(),
            format!("t.csv:1: the header must be `{HEADER}`, found `time,north`")
        );
    }
}

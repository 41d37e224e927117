//! Files of sound-speed profiles.
//!
//! | name ends in | format | before the points |
//! |---|---|---|
//! | `.asvp` | Kongsberg: SIS operator manual, "Sound speed profile format" | a header in parentheses, over one line or more |
//! | `.svp` | CARIS HIPS: "SVP Files"; SonarWiz writes the same | `[SVP_VERSION_2]`, a name, and `Section` with the time and place of the cast |
//! | `.vel` | Hypack | `FTP NEW` with the place and time of the cast |
//! | anything else | text | at most one line of column names |
//!
//! Each further line holds a depth in metres and a sound speed in metres per second, separated by spaces, tabs, commas or semicolons. Further columns, empty
//! lines and lines that begin with `#` are ignored.

use std::path::Path;

use echotank_core::sound_speed::SoundSpeedProfile;

/// Reads a profile. The end of the name tells the format.
///
/// # Errors
/// The line, the value and the rule, to follow the name of the file.
pub fn read_profile(name: &Path, bytes: &[u8]) -> Result<SoundSpeedProfile, String> {
    let text = String::from_utf8_lossy(bytes);
    let text = text.trim_start_matches('\u{feff}');
    let lines = (1..).zip(text.lines().map(str::trim));
    let mut lines = lines
        .filter(|(_, line)| !line.is_empty() && !line.starts_with('#'))
        .peekable();
    let ending = name.extension().map(|e| e.to_ascii_lowercase());
    let first = lines.peek().map_or("", |(_, line)| *line);
    match ending.as_ref().and_then(|e| e.to_str()) {
        Some("asvp") if first.starts_with('(') => {
            for (_, line) in lines.by_ref() {
                if line.ends_with(')') {
                    break;
                }
            }
        }
        Some("asvp") => {
            return Err(format!(
                "line 1: {first:?}: an .asvp file must begin with a header in parentheses"
            ));
        }
        Some("svp") if first.starts_with("[SVP_VERSION") => {
            lines.nth(1);
        }
        Some("vel") if first.starts_with("FTP") => {
            lines.next();
        }
        _ if point(first).is_none() => {
            lines.next();
        }
        _ => {}
    }
    let (mut points, mut numbers) = (Vec::new(), Vec::new());
    for (number, line) in lines {
        if line.starts_with("Section") {
            if !points.is_empty() {
                return Err(format!(
                    "line {number}: a second section: must hold one cast; copy the section of your choice to a file of its own"
                ));
            }
            continue;
        }
        let Some(point) = point(line) else {
            return Err(format!(
                "line {number}: {line:?}: must be a depth in metres and a sound speed in m/s"
            ));
        };
        points.push(point);
        numbers.push(number);
    }
    SoundSpeedProfile::new(points).map_err(|refused| {
        let number = refused.point.and_then(|point| numbers.get(point - 1));
        match number {
            Some(number) => format!("line {number}: {}", refused.why),
            None => refused.why,
        }
    })
}

/// The first two numbers of a line.
fn point(line: &str) -> Option<(f64, f64)> {
    let cells = line.split([' ', '\t', ',', ';']);
    let mut cells = cells.filter(|cell| !cell.is_empty());
    let mut number = || cells.next()?.parse().ok();
    Some((number()?, number()?))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn read(name: &str, text: &str) -> Result<Vec<(f64, f64)>, String> {
        let profile = read_profile(Path::new(name), text.as_bytes())?;
        Ok(profile.points().to_vec())
    }

    #[test]
    fn casts_of_the_field_are_read() {
        let points = Ok(vec![(0.5, 1483.6), (7.0, 1485.3), (40.0, 1479.5)]);
        for (name, text) in [
            (
                "a.asvp",
                "( SoundVelocity 1.00 12 202605290813 54.3452678\n10.4483298 4500 202605290813 202605301210 SVP-16 PE 3 )\n0.5 1483.6\n7.0 1485.3\n40.0 1479.5\n",
            ),
            (
                "a.SVP",
                "[SVP_VERSION_2]\nbay.svp\nSection 2026-149 08:13:00 54:20:42 010:26:53 by boat\n 0.50 1483.6\n7 1485.3\r\n40\t1479.5",
            ),
            (
                "a.vel",
                "FTP NEW 3 54.34 10.44 08:13 05/29/2026\n0.5 1483.6\n7.0 1485.3\n40.0 1479.5",
            ),
            (
                "a.csv",
                "depth_m,speed,temperature\n# by boat\n0.5,1483.6,11.2\n7.0,1485.3,11.4\n\n40.0;1479.5;9.1\n",
            ),
            ("cast", "\u{feff}0.5 1483.6\n7.0 1485.3\n40.0 1479.5"),
        ] {
            assert_eq!(read(name, text), points, "{name}");
        }
    }

    #[test]
    fn a_bad_cast_is_refused_with_line_value_and_rule() {
        for (name, text, words) in [
            ("a.csv", "0 1500\n5 x\n", "line 2: \"5 x\": must be a depth"),
            (
                "a.csv",
                "depth speed\n0 1500\n\n5 1490\n4 1490",
                "line 5: depth 4 m: must be greater than 5 m",
            ),
            ("a.csv", "0 1500", "1 points: must be 2 to 1000"),
            ("a.csv", "", "0 points: must be 2 to 1000"),
            (
                "a.csv",
                "0 1500\n5 nan\n",
                "line 2: 5 m, NaN m/s: must be finite numbers",
            ),
            (
                "a.csv",
                "-1 1500\n5 1490\n",
                "line 1: depth -1 m: must not lie above the surface",
            ),
            (
                "a.vel",
                "FTP NEW 3 1 2 08:13 05/29/2026\n0 4921\n30 4900",
                "line 2: sound speed 4921 m/s: must be from 1300 to 1700 m/s",
            ),
            (
                "a.asvp",
                "0 1500\n5 1490\n",
                "line 1: \"0 1500\": an .asvp file must begin with a header",
            ),
            (
                "a.svp",
                "[SVP_VERSION_2]\nx\nSection 1\n0 1500\n9 1490\nSection 2\n0 1500\n",
                "line 6: a second section: must hold one cast",
            ),
        ] {
            let why = read(name, text).expect_err("refused");
            assert!(why.starts_with(words), "{name} {text:?}: {why}");
        }
    }
}

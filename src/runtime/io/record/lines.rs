//! Reads the side-scan lines of `.s7k` and `pings.npz` files that this program wrote.
//!
//! - `.s7k`: 7000 (sample rate, sound speed, pulse), 7007 (lines), and 1003, 1012 and 1013 (position, pitch, heading), linearly interpolated to the
//!   start of the pulse. No recorded 7k record holds the arrays' lever arms, so positions are those of the reference point.
//!
//! - `.npz`: `lines`, `line_side`, `line_position_m`, `position_m`, `attitude_deg`, `geodetic_deg`, `velocity_m_per_s` and the scalars. Members must
//!   be stored, little-endian, in C order.
//!
//! Of a multi-pulse ping only one pulse is read: from 7000 and 7007 by their multi-ping sequence, from an `.npz` by `more_lines`.

use std::collections::HashMap;
use std::io::Read;
use std::path::{Path, PathBuf};

use echotank_protocols::sevenk::file::FileReader;
use echotank_protocols::sevenk::frame::Record;
use echotank_protocols::sevenk::records::{
    Heading1013, Position1003, RollPitchHeave1012, SideScan7007, SonarSettings7000,
};
use glam::DVec3;

use echotank_core::ping::{Line, Side};
use echotank_imaging::image::line::RangeAxis;

/// Side-scan lines of one recorded ping.
#[derive(Clone, Debug, PartialEq)]
pub struct RecordedPing {
    /// Ping number.
    pub ping_number: u32,
    /// Latitude of the reference point at the start of the pulse, rad, north positive.
    pub latitude_rad: f64,
    /// Longitude, rad, east positive.
    pub longitude_rad: f64,
    /// Heading, rad, clockwise from true north.
    pub heading_rad: f64,
    /// Pitch, rad, bow up positive.
    pub pitch_rad: f64,
    /// Lever arms from the reference point to the transmit arrays of the port and the starboard line, m, north-east-down.
    pub arms_m: [DVec3; 2],
    /// Sound speed, m/s.
    pub sound_speed_m_per_s: f64,
    /// Range axis of the line samples.
    pub axis: RangeAxis,
    /// The side-scan lines of the pulse.
    pub lines: Vec<Line>,
    /// Start of the pulse, ns since 1970 UTC.
    pub utc_ns: i64,
}

/// Errors of reading side-scan lines.
#[derive(Debug, thiserror::Error)]
pub enum LinesError {
    /// The file cannot be read.
    #[error("{}: cannot be read: {source}", path.display())]
    Unreadable {
        /// The file.
        path: PathBuf,
        /// The cause.
        source: std::io::Error,
    },
    /// The content differs from the format that this program writes.
    #[error("{}: {why}", path.display())]
    Unfit {
        /// The file.
        path: PathBuf,
        /// Cause.
        why: String,
    },
}

/// Reads the pings that have a position and lines of `pulse` (1 is the first), in file order.
///
/// # Errors
/// The file cannot be read or has not been written by this program.
pub fn read(path: &Path, pulse: u16) -> Result<Vec<RecordedPing>, LinesError> {
    let bytes = std::fs::read(path).map_err(|source| LinesError::Unreadable {
        path: path.to_owned(),
        source,
    })?;
    let pings = match bytes.starts_with(b"PK") {
        true => of_npz(bytes, pulse),
        false => of_s7k(&bytes, pulse),
    };
    pings.map_err(|why| LinesError::Unfit {
        path: path.to_owned(),
        why,
    })
}

// ---------------------------------------------------------------- .s7k

/// Samples of a quantity at increasing times, ns.
#[derive(Default)]
struct Track<const N: usize> {
    points: Vec<(i64, [f64; N])>,
    /// Whether components are angles, which are interpolated along the shorter arc.
    angles: bool,
}

impl<const N: usize> Track<N> {
    /// Linear interpolation at `utc_ns`; the nearest value beyond the ends.
    fn at(&self, utc_ns: i64) -> Option<[f64; N]> {
        let after = self.points.partition_point(|p| p.0 < utc_ns);
        let (before, next) = (
            after.checked_sub(1).map(|k| self.points[k]),
            self.points.get(after),
        );
        let (Some((t0, a)), Some(&(t1, b))) = (before, next) else {
            return before.or(next.copied()).map(|p| p.1);
        };
        let share = (utc_ns - t0) as f64 / ((t1 - t0) as f64).max(1.0);
        Some(std::array::from_fn(|i| {
            let mut change = b[i] - a[i];
            if self.angles {
                change -= std::f64::consts::TAU * (change / std::f64::consts::TAU).round();
            }
            a[i] + share * change
        }))
    }

    fn sort(&mut self) {
        self.points.sort_by_key(|p| p.0);
    }
}

/// Whether a multi-ping sequence belongs to `pulse`. A ping with a single pulse has sequence 0.
fn is_of(pulse: u16, multi_ping_sequence: u16) -> bool {
    multi_ping_sequence.max(1) == pulse
}

fn of_s7k(bytes: &[u8], pulse: u16) -> Result<Vec<RecordedPing>, String> {
    let mut settings: HashMap<u32, SonarSettings7000> = HashMap::new();
    let mut places = Track::<2>::default();
    let mut pitches = Track::<1>::default();
    let mut headings = Track::<1> {
        angles: true,
        ..Track::default()
    };
    let mut lines: Vec<(i64, SideScan7007)> = Vec::new();
    let mut records = 0;
    let mut faults = 0;
    let mut first_fault = None;
    for found in FileReader::new(bytes) {
        let record = match found {
            Ok(found) => found.record,
            Err(fault) => {
                faults += 1;
                first_fault.get_or_insert(fault);
                continue;
            }
        };
        records += 1;
        let id = record.frame.record_type_id;
        let body = record.body();
        let Ok(utc_ns) = utc_ns(&record) else {
            continue;
        };
        // Malformed records are skipped.
        match id {
            7000 => {
                if let Ok(found) = SonarSettings7000::parse(body)
                    && is_of(pulse, found.multi_ping_sequence)
                {
                    settings.insert(found.ping_number, found);
                }
            }
            7007 => {
                let line = SideScan7007::parse(body).ok();
                let its = line.filter(|line| is_of(pulse, line.rth.multi_ping_sequence));
                lines.extend(its.map(|line| (utc_ns, line)));
            }
            1003 => {
                if let Ok(p) = Position1003::parse(body)
                    && p.position_type == Position1003::GEOGRAPHIC
                {
                    let place = [p.latitude_rad_or_northing_m, p.longitude_rad_or_easting_m];
                    places.points.push((utc_ns, place));
                }
            }
            1012 => {
                if let Ok(a) = RollPitchHeave1012::parse(body) {
                    pitches.points.push((utc_ns, [f64::from(a.pitch_rad)]));
                }
            }
            1013 => {
                if let Ok(h) = Heading1013::parse(body) {
                    headings.points.push((utc_ns, [f64::from(h.heading_rad)]));
                }
            }
            _ => {}
        }
    }
    if records == 0 {
        return Err(match first_fault {
            Some(fault) => format!(
                "holds no 7k record ({fault}); expected a .s7k or pings.npz of this program"
            ),
            None => "is empty; expected a .s7k or pings.npz of this program".into(),
        });
    }
    if lines.is_empty() {
        return Err(format!(
            "{records} records and no side-scan line (7007) of pulse {pulse} among them; {faults} faults"
        ));
    }
    places.sort();
    pitches.sort();
    headings.sort();
    let mut pings = Vec::new();
    for (utc_ns, line) in lines {
        let number = line.rth.ping_number;
        let Some(set) = settings.get(&number) else {
            continue;
        };
        // The time stamp of ping records is the end of transmission.
        let utc_ns = utc_ns - (f64::from(set.tx_pulse_width_s) * 1e9) as i64;
        let (Some(place), Some(heading)) = (places.at(utc_ns), headings.at(utc_ns)) else {
            return Err(
                "no position (1003) or no heading (1013): the lines cannot be positioned".into(),
            );
        };
        let (c, rate_hz) = (
            f64::from(set.sound_velocity_m_per_s),
            f64::from(set.sample_rate_hz),
        );
        if !(c > 0.0 && rate_hz > 0.0) {
            continue;
        }
        let each = [
            (
                Side::Port,
                line.port().map(|a| a as f32).collect::<Vec<_>>(),
            ),
            (
                Side::Starboard,
                line.starboard().map(|a| a as f32).collect(),
            ),
        ];
        pings.push(RecordedPing {
            ping_number: number,
            latitude_rad: place[0],
            longitude_rad: place[1],
            heading_rad: heading[0],
            pitch_rad: pitches.at(utc_ns).map_or(0.0, |p| p[0]),
            arms_m: [DVec3::ZERO; 2],
            sound_speed_m_per_s: c,
            axis: RangeAxis::new(c, rate_hz),
            // A missing side is all zeros in the record.
            lines: each
                .into_iter()
                .filter(|(_, amplitude)| amplitude.iter().any(|a| *a > 0.0))
                .map(|(side, amplitude)| Line { side, amplitude })
                .collect(),
            utc_ns,
        });
    }
    if pings.is_empty() {
        return Err("no line has its settings record (7000)".into());
    }
    Ok(pings)
}

fn utc_ns(record: &Record<'_>) -> Result<i64, ()> {
    record.frame.time.to_utc_ns().map_err(|_| ())
}

// ---------------------------------------------------------------- .npz

/// Maximum length of a member's header, bytes.
const HEADER_BYTES: usize = 65_536;

/// A parsed array of numbers.
struct Array {
    shape: Vec<usize>,
    numbers: Vec<f64>,
}

fn of_npz(bytes: Vec<u8>, pulse: u16) -> Result<Vec<RecordedPing>, String> {
    let mut zip = zip::ZipArchive::new(std::io::Cursor::new(bytes))
        .map_err(|e| format!("not a complete .npz file: {e}"))?;
    let mut array = |name: &str| -> Result<Array, String> {
        let mut member = zip
            .by_name(&format!("{name}.npy"))
            .map_err(|e| format!("{name}: {e}; expected a pings.npz of `echotank replay`"))?;
        let mut bytes = Vec::new();
        member
            .read_to_end(&mut bytes)
            .map_err(|e| format!("{name}: {e}"))?;
        npy(&bytes).map_err(|why| format!("{name}: {why}"))
    };
    // The lines of further pulses are in a member of their own.
    let more = usize::from(pulse).saturating_sub(2);
    let (lines, delay_s) = match pulse {
        0 | 1 => (array("lines")?, 0.0),
        _ => {
            let lines = array("more_lines")?;
            let delays = array("more_pulse_delay_s")?;
            (lines, delays.numbers.get(more).copied().unwrap_or(0.0))
        }
    };
    let (pings, pulses, sides, samples) = match (pulse, lines.shape.as_slice()) {
        (0 | 1, &[pings, sides, samples]) => (pings, 1, sides, samples),
        (2.., &[pings, pulses, sides, samples]) => (pings, pulses, sides, samples),
        (_, shape) => return Err(format!("lines: {} dimensions", shape.len())),
    };
    if more >= pulses {
        return Err(format!("lines: {} pulses, not {pulse}", pulses + 1));
    }
    if pings * sides * samples == 0 {
        return Err("lines: the recording has no side-scan line".into());
    }
    let mut shaped = |name: &str, shape: &[usize]| -> Result<Vec<f64>, String> {
        let found = array(name)?;
        match found.shape == shape {
            true => Ok(found.numbers),
            false => Err(format!(
                "{name}: shape {:?}, expected {shape:?}",
                found.shape
            )),
        }
    };
    let side = shaped("line_side", &[sides])?;
    let places = shaped("line_position_m", &[pings, sides, 3])?;
    let reference = shaped("position_m", &[pings, 3])?;
    let attitude = shaped("attitude_deg", &[pings, 3])?;
    let geodetic = shaped("geodetic_deg", &[pings, 2])?;
    let numbers = shaped("ping_number", &[pings])?;
    let utc_ns = shaped("ping_utc_ns", &[pings])?;
    let velocity = match delay_s > 0.0 {
        true => shaped("velocity_m_per_s", &[pings, 3])?,
        false => vec![0.0; 3 * pings],
    };
    let c = shaped("sound_speed_m_per_s", &[])?[0];
    let rate_hz = shaped("sample_rate_hz", &[])?[0];
    if !(c > 0.0 && rate_hz > 0.0) {
        return Err(format!(
            "sound speed {c} m/s and sample rate {rate_hz} Hz: both must be above 0"
        ));
    }
    let triple = |of: &[f64], k: usize| DVec3::new(of[3 * k], of[3 * k + 1], of[3 * k + 2]);
    Ok((0..pings)
        .map(|p| {
            let mut arms_m = [DVec3::ZERO; 2];
            let mut made = Vec::new();
            for (s, side) in side.iter().enumerate() {
                let starboard = *side > 0.0;
                // The arrays move between the start of the ping and the transmission of this pulse.
                let ahead_m = delay_s * triple(&velocity, p);
                arms_m[usize::from(starboard)] =
                    triple(&places, p * sides + s) - triple(&reference, p) + ahead_m;
                let row = (p * pulses + more) * sides + s;
                let amplitude = &lines.numbers[row * samples..(row + 1) * samples];
                made.push(Line {
                    side: if starboard {
                        Side::Starboard
                    } else {
                        Side::Port
                    },
                    amplitude: amplitude.iter().map(|&a| a as f32).collect(),
                });
            }
            let angle = |k: usize| attitude[3 * p + k].to_radians();
            RecordedPing {
                ping_number: numbers[p] as u32,
                latitude_rad: geodetic[2 * p].to_radians(),
                longitude_rad: geodetic[2 * p + 1].to_radians(),
                heading_rad: angle(2),
                pitch_rad: angle(1),
                arms_m,
                sound_speed_m_per_s: c,
                axis: RangeAxis::new(c, rate_hz),
                lines: made,
                utc_ns: (utc_ns[p] as i64).saturating_add((delay_s * 1e9) as i64),
            }
        })
        .collect())
}

/// Parses NumPy's `.npy` format (NEP 1) for the types that this program writes.
fn npy(bytes: &[u8]) -> Result<Array, String> {
    const NONE: &str = "is not a .npy array";
    if bytes.get(..6) != Some(b"\x93NUMPY") {
        return Err(NONE.into());
    }
    let (length, from) = match bytes.get(6) {
        Some(1) => {
            let n = bytes.get(8..10).ok_or(NONE)?;
            (usize::from(n[0]) | usize::from(n[1]) << 8, 10)
        }
        _ => {
            let n = bytes
                .get(8..)
                .and_then(|b| b.first_chunk::<4>())
                .ok_or(NONE)?;
            (u32::from_le_bytes(*n) as usize, 12)
        }
    };
    if length > HEADER_BYTES {
        return Err(NONE.into());
    }
    let header = bytes.get(from..from + length).ok_or("is truncated")?;
    let header = std::str::from_utf8(header).map_err(|_| NONE)?;
    if header.contains("'fortran_order': True") {
        return Err("is in Fortran order".into());
    }
    let after = |key: &str| header.split_once(key).map(|(_, rest)| rest);
    let kind = after("'descr':")
        .and_then(|rest| rest.split('\'').nth(1))
        .ok_or(NONE)?;
    let shape = after("'shape': (")
        .and_then(|rest| rest.split(')').next())
        .ok_or(NONE)?;
    let shape: Vec<usize> = shape
        .split(',')
        .map(str::trim)
        .filter(|n| !n.is_empty())
        .map(|n| n.parse().map_err(|_| NONE))
        .collect::<Result<_, _>>()?;
    let data = &bytes[from + length..];
    fn all<const N: usize>(data: &[u8], number: fn([u8; N]) -> f64) -> Vec<f64> {
        data.as_chunks::<N>().0.iter().map(|b| number(*b)).collect()
    }
    let numbers = match kind {
        "<f4" => all(data, |b| f64::from(f32::from_le_bytes(b))),
        "<f8" => all(data, f64::from_le_bytes),
        "<i4" => all(data, |b| f64::from(i32::from_le_bytes(b))),
        "<i8" => all(data, |b| i64::from_le_bytes(b) as f64),
        other => {
            return Err(format!("holds {other}, expected one of <f4, <f8, <i4, <i8"));
        }
    };
    let wanted = shape.iter().try_fold(1usize, |a, n| a.checked_mul(*n));
    match wanted == Some(numbers.len()) {
        true => Ok(Array { shape, numbers }),
        false => Err(format!(
            "shape {shape:?} and {} numbers: the file is truncated",
            numbers.len()
        )),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn error(bytes: &[u8]) -> String {
        let dir = tempfile::tempdir().expect("dir");
        let path = dir.path().join("rec");
        std::fs::write(&path, bytes).expect("written");
        read(&path, 1).expect_err("refused").to_string()
    }

    #[test]
    fn what_is_no_recording_is_refused_with_the_reason() {
        assert!(error(b"").contains("is empty"));
        assert!(error(b"hello, world; this is a text file\n").contains("holds no 7k record"));
        assert!(error(b"PK\x03\x04 and then nothing").contains("not a complete .npz file"));
        let missing = read(Path::new("/no/such/file.s7k"), 1).expect_err("refused");
        assert!(
            missing
                .to_string()
                .starts_with("/no/such/file.s7k: cannot be read")
        );
    }

    #[test]
    fn an_npy_that_is_cut_off_or_lies_about_its_shape_is_refused() {
        let text = "{'descr': '<f8', 'fortran_order': False, 'shape': (2,)}\n";
        let mut good = b"\x93NUMPY\x01\x00".to_vec();
        good.extend((text.len() as u16).to_le_bytes());
        good.extend(text.bytes());
        good.extend([0; 16]);
        assert_eq!(npy(&good).expect("good").numbers, [0.0, 0.0]);
        let end = good.len();
        assert!(npy(&good[..end - 1]).is_err());
        assert!(npy(&good[..20]).is_err());
        for (from, to) in [("(2,)", "(3,)"), ("<f8", "<c8"), ("False", "True ")] {
            let mut bad = good[..10].to_vec();
            bad.extend(text.replace(from, to).bytes());
            bad.extend([0; 16]);
            assert!(npy(&bad).is_err(), "{from} -> {to}");
        }
    }

    #[test]
    fn headings_go_the_shorter_way_round() {
        let mut track = Track::<1> {
            angles: true,
            ..Track::default()
        };
        track.points = vec![(0, [6.2]), (10, [0.1])];
        let got = track.at(5).expect("between")[0];
        let want = 0.5 * (6.2 + 0.1 + std::f64::consts::TAU);
        assert!((got - want).abs() < 1e-12, "{got} want {want}");
        assert_eq!((track.at(-5), track.at(99)), (Some([6.2]), Some([0.1])));
    }

    proptest! {
        #[test]
        fn no_bytes_make_it_panic(bytes in proptest::collection::vec(any::<u8>(), 0..400), npz: bool, pulse in 0..4_u16) {
            let mut bytes = bytes;
            if npz {
                bytes.splice(0..0, *b"PK\x03\x04");
            }
            let _ = match bytes.starts_with(b"PK") {
                true => of_npz(bytes.clone(), pulse),
                false => of_s7k(&bytes, pulse),
            };
            let _ = npy(&bytes);
        }
    }
}

//! Encodes ZDA, GGA and HDT sentences with checksum and line end.
//!
//! Unknown values are empty fields, as receivers send them: GGA has quality 0, HDT has an empty heading. The number of satellites,
//! the dilution of precision and the geoid separation are always empty. Layouts: NMEA 0183.

use std::io::Write;

use super::framing::checksum_of;
use echotank_core::navigation::FixQuality;
use echotank_core::time::{NS_PER_S, UtcNs};

/// Resolution of a coordinate, steps per minute of arc; one step is 0.2 mm.
const MINUTE_STEPS: i64 = 10_000_000;

/// Position, height and quality of a GGA sentence.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Fix {
    /// Geodetic latitude, radians, positive north.
    pub latitude_rad: f64,
    /// Longitude, radians, positive east.
    pub longitude_rad: f64,
    /// Height above the datum of the source, metres.
    pub height_m: f64,
    /// Fix quality; [`FixQuality::None`] encodes as no fix.
    pub quality: FixQuality,
}

/// Appends `$GPZDA,hhmmss.ss,dd,mm,yyyy,00,00*hh`; the time zone is UTC.
pub fn zda(out: &mut Vec<u8>, talker: &str, utc: UtcNs) {
    let date = chrono::DateTime::from_timestamp_nanos(utc.0).format("%d,%m,%Y");
    sentence(out, &format!("{talker}ZDA,{},{date},00,00", clock(utc)));
}

/// Appends `$GPGGA,hhmmss.ss,llll.lllllll,N,yyyyy.yyyyyyy,E,q,,,h.hhh,M,,M,,*hh`.
pub fn gga(out: &mut Vec<u8>, talker: &str, utc: UtcNs, fix: Option<&Fix>) {
    let time = clock(utc);
    let fix = fix.filter(|f| f.quality != FixQuality::None);
    let body = match fix {
        None => format!("{talker}GGA,{time},,,,,0,,,,M,,M,,"),
        Some(f) => format!(
            "{talker}GGA,{time},{},{},{},,,{:.3},M,,M,,",
            arc(f.latitude_rad, 2, ['N', 'S']),
            arc(f.longitude_rad, 3, ['E', 'W']),
            quality(f.quality),
            // Adding zero turns -0.000 into 0.000.
            (f.height_m * 1e3).round() / 1e3 + 0.0
        ),
    };
    sentence(out, &body);
}

/// Appends `$GPHDT,ddd.ddd,T*hh`.
pub fn hdt(out: &mut Vec<u8>, talker: &str, heading_rad: Option<f64>) {
    let body = match heading_rad {
        None => format!("{talker}HDT,,T"),
        Some(rad) => {
            // 359.9996 becomes 0.000, neither 360.000 nor -0.000.
            let steps = (rad.to_degrees() * 1e3).round().rem_euclid(360_000.0) + 0.0;
            format!("{talker}HDT,{:07.3},T", steps / 1e3)
        }
    };
    sentence(out, &body);
}

fn quality(fix: FixQuality) -> u8 {
    match fix {
        FixQuality::None => 0,
        FixQuality::Autonomous => 1,
        FixQuality::Differential => 2,
        FixQuality::RtkFixed => 4,
        FixQuality::RtkFloat => 5,
        FixQuality::DeadReckoning => 6,
    }
}

/// Time of day as hhmmss with hundredths of a second, or with milliseconds if the instant is not a whole hundredth.
fn clock(utc: UtcNs) -> String {
    let ms = (utc.0 + 500_000).div_euclid(1_000_000);
    let of_day = ms.rem_euclid(86_400_000);
    let (h, m, s) = (of_day / 3_600_000, of_day / 60_000 % 60, of_day / 1000 % 60);
    match of_day % 1000 {
        f if f % 10 == 0 => format!("{h:02}{m:02}{s:02}.{:02}", f / 10),
        f => format!("{h:02}{m:02}{s:02}.{f:03}"),
    }
}

/// Angle as degrees with `digits` digits, followed by minutes. Rounding to whole steps keeps the minutes below 60.
fn arc(angle_rad: f64, digits: usize, letters: [char; 2]) -> String {
    let steps = (angle_rad.to_degrees().abs() * 60.0 * MINUTE_STEPS as f64).round() as i64;
    let (degrees, rest) = (steps / (60 * MINUTE_STEPS), steps % (60 * MINUTE_STEPS));
    let letter = letters[usize::from(angle_rad < 0.0)];
    format!(
        "{degrees:0digits$}{:02}.{:07},{letter}",
        rest / MINUTE_STEPS,
        rest % MINUTE_STEPS
    )
}

fn sentence(out: &mut Vec<u8>, body: &str) {
    // Writing to a vector cannot fail.
    let _ = write!(out, "${body}*{:02X}\r\n", checksum_of(body));
}

/// First tick after `utc`. The rate is a whole number of hertz or the reciprocal of a whole number. Ticks include every whole
/// second, or every multiple of a longer period.
pub fn next_tick(utc: UtcNs, rate_hz: f64) -> UtcNs {
    if rate_hz < 1.0 {
        let period_ns = (1.0 / rate_hz).round() as i64 * NS_PER_S;
        return UtcNs((utc.0.div_euclid(period_ns) + 1) * period_ns);
    }
    let per_s = rate_hz.round().max(1.0) as i64;
    let (second, rest) = (utc.0.div_euclid(NS_PER_S), utc.0.rem_euclid(NS_PER_S));
    // Rounding to the nanosecond may give the tick at `rest` itself. The loop then takes the next tick.
    let at = |k: i64| (k * NS_PER_S + per_s / 2) / per_s;
    let mut k = rest * per_s / NS_PER_S;
    while at(k) <= rest {
        k += 1;
    }
    UtcNs(second * NS_PER_S + at(k))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::sentence::decode;
    use echotank_config::spec::NavDialect;

    const T: i64 = 1_406_851_199; // 2014-07-31T23:59:59Z

    fn text(write: impl Fn(&mut Vec<u8>)) -> String {
        let mut out = Vec::new();
        write(&mut out);
        String::from_utf8(out).expect("ASCII")
    }

    #[test]
    fn sentences_are_those_of_the_standard_to_the_byte() {
        let utc = UtcNs(T * NS_PER_S + 250_000_000);
        assert_eq!(
            text(|out| zda(out, "GP", utc)),
            "$GPZDA,235959.25,31,07,2014,00,00*62\r\n"
        );
        let fix = Fix {
            latitude_rad: -22.001_75_f64.to_radians(),
            longitude_rad: (-17.0 - 59.999_999_99 / 60.0_f64).to_radians(),
            height_m: -2.76,
            quality: FixQuality::RtkFixed,
        };
        let got = text(|out| gga(out, "IN", utc, Some(&fix)));
        let body = "INGGA,235959.25,2200.1050000,S,01800.0000000,W,4,,,-2.760,M,,M,,";
        assert_eq!(got, format!("${body}*{:02X}\r\n", checksum_of(body)));
        let level = Fix {
            height_m: -4e-4,
            ..fix
        };
        let got = text(|out| gga(out, "IN", utc, Some(&level)));
        assert!(got.contains(",,0.000,M,"), "{got}");
        assert!(
            text(|out| gga(out, "GP", utc, None)).starts_with("$GPGGA,235959.25,,,,,0,,,,M,,M,,*")
        );
        assert!(text(|out| hdt(out, "HE", Some(-1e-9))).starts_with("$HEHDT,000.000,T*"));
        assert!(text(|out| hdt(out, "HE", Some(1.0))).starts_with("$HEHDT,057.296,T*"));
        assert!(text(|out| hdt(out, "HE", None)).starts_with("$HEHDT,,T*"));
    }

    #[test]
    fn decoding_inverts_encoding() {
        for i in 0..2000_i64 {
            let turn = |k: f64| (i as f64 * k).rem_euclid(2.0) - 1.0;
            let utc = UtcNs(T * NS_PER_S + i * 1_010_000_000);
            let fix = Fix {
                latitude_rad: turn(0.137) * std::f64::consts::FRAC_PI_2,
                longitude_rad: turn(0.713) * std::f64::consts::PI,
                height_m: turn(0.31) * 100.0,
                quality: FixQuality::RtkFloat,
            };
            let heading = turn(0.519) * std::f64::consts::PI;
            let lines = [
                text(|out| zda(out, "GP", utc)),
                text(|out| gga(out, "GP", utc, Some(&fix))),
                text(|out| hdt(out, "GP", Some(heading))),
            ];
            for (k, line) in lines.iter().enumerate() {
                let body = &line[1..line.len() - 5];
                let r = decode(body, &NavDialect::default(), &mut String::new()).expect(line);
                let when_ms = r
                    .time_of_day_ns()
                    .map(|ns| (ns as f64 / 1e6).round() as i64);
                let want_ms = (utc.0 / 1_000_000).rem_euclid(86_400_000);
                if k < 2 {
                    assert_eq!(when_ms, Some(want_ms), "{line}");
                }
                match k {
                    0 => assert_eq!(
                        r.instant().map(|t| (t.0 + 500_000) / 1_000_000),
                        Some(utc.0 / 1_000_000),
                        "{line}"
                    ),
                    1 => {
                        let (latitude, longitude) = r.position_rad.expect(line);
                        // Tolerance: half a step of 1e-7 minutes, plus rounding.
                        let most = 2e-11;
                        assert!((latitude - fix.latitude_rad).abs() < most, "{line}");
                        assert!((longitude - fix.longitude_rad).abs() < most, "{line}");
                        assert!(
                            (r.height_m.expect(line) - fix.height_m).abs() < 6e-4,
                            "{line}"
                        );
                        assert_eq!(r.fix, FixQuality::RtkFloat);
                    }
                    _ => {
                        let off = (r.heading_rad.expect(line) - heading).to_degrees();
                        let off = off - 360.0 * (off / 360.0).round();
                        assert!(off.abs() < 5.2e-4, "{line}: {off}");
                    }
                }
            }
        }
    }

    #[test]
    fn ticks_fall_on_whole_seconds_and_evenly_between_them() {
        for (rate_hz, want) in [(1.0, 1), (3.0, 3), (50.0, 50), (200.0, 200)] {
            let mut at = UtcNs(T * NS_PER_S);
            let mut count = 0;
            while at.0 < (T + 1) * NS_PER_S {
                let next = next_tick(at, rate_hz);
                assert!(next > at);
                at = next;
                count += 1;
            }
            assert_eq!((at.0, count), ((T + 1) * NS_PER_S, want), "{rate_hz}");
        }
        assert_eq!(next_tick(UtcNs(7 * NS_PER_S), 0.2), UtcNs(10 * NS_PER_S));
        assert_eq!(next_tick(UtcNs(10 * NS_PER_S), 0.2), UtcNs(15 * NS_PER_S));
    }
}

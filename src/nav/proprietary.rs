//! Decoders of proprietary sentences, most of them for attitude. Each sentence has its own field order and signs.
//!
//! Sources: SBG Systems, sbgECom `doc/nmeaMessages.md` (PASHR, PRDID, PHTRO, PHLIN, PHOCT, PHINF, PSBGA, PSBGB, GGK); Kongsberg
//! Seapath (PSXN); Ashtech (ATT, AT2, HPR, POS); iXblue (PIXSE); Valeport (PIPS); Trimble (AVR, VHD, GGK); VectorNav (VNYMR,
//! VNINS); Hemisphere (PSAT). If a status is T, E or I, only values with T are used.

use super::fields::Fields;
use super::reading::DecodeError::{self, Malformed, Unsupported};
use super::reading::{Decoded, Kind, Reading, StatedTime, date_ns, ensure, seconds_ns};
use echotank_config::spec::NavDialect;
use echotank_core::navigation::FixQuality;
use echotank_core::time::UtcNs;

/// Start of GPS time, 1980-01-06T00:00:00Z, seconds since 1970.
const GPS_EPOCH_S: i64 = 315_964_800;
const WEEK_S: i64 = 604_800;

pub(crate) fn decode(f: &Fields, dialect: &NavDialect) -> Decoded {
    match (f.text(0), f.text(1)) {
        ("PASHR", "ATT" | "AT2") => pashr_att(f),
        ("PASHR", "HPR") => hpr(Kind::PashrAshtech, f),
        ("PASHR", "POS") => pashr_pos(f),
        ("PASHR", first) if first.starts_with(|c: char| c.is_ascii_alphabetic()) => {
            Err(Unsupported)
        }
        ("PASHR", _) => pashr(f, dialect),
        ("PSXN", "20") => psxn_20(f),
        // The units of sentence 10 are a setting of the instrument, and the sentence does not state them.
        ("PSXN", "10" | "22" | "24") => Ok(Reading::information()),
        ("PSXN", "23") => psxn_23(f),
        // PRDID has pitch before roll.
        ("PRDID", _) => attitude(Kind::Prdid, f, 4, [3, 2, 1]),
        ("PHTRO", _) => phtro(f),
        ("PHLIN", _) => heave_up(Kind::Phlin, f, 3),
        ("PHOCT", _) => phoct(f),
        ("PHINF", _) => Ok(Reading::information()),
        ("PIXSE", "ATITUD") => pixse_attitude(f),
        ("PIXSE", "POSITI") => pixse_position(f),
        ("PIXSE", "HEAVE_") => heave_up(Kind::PixseHeave, f, 4),
        ("PIXSE", "DEPIN_") => pixse_depth(f),
        ("PIXSE", "TIME__") => {
            let mut r = Reading::new(Kind::Zda);
            r.set_time(f.time_of_day(2)?, None);
            Ok(r)
        }
        ("PIXSE", word) if word == "SPEED_" || word.starts_with("STD") => {
            Ok(Reading::information())
        }
        ("PIPS", _) => pips(f),
        ("PTNL", "AVR") => avr(f),
        ("PTNL", "VHD") => Ok(Reading::information()),
        ("PTNL", "GGK") => ggk(f),
        ("PTNTHPR", _) => ptnthpr(f),
        ("PSAT", "HPR") => hpr(Kind::Psat, f),
        ("PSBGA", _) => psbg(f, 1, None),
        ("PSBGB", _) => psbg(f, 2, Some(12)),
        _ => Err(Unsupported),
    }
}

/// `hhmmss.sss,heading,T,roll,pitch,heave,sigmas...`. Heave is positive down from SBG and OxTS, positive up from WASSP.
fn pashr(f: &Fields, dialect: &NavDialect) -> Decoded {
    let mut r = Reading::new(Kind::Pashr);
    if f.count < 7 || !matches!(f.text(3), "T" | "") {
        return Err(Malformed);
    }
    r.set_time(f.time_of_day(1)?, None);
    r.set_heading(f.number(2)?)?;
    r.set_roll_pitch(f.number(4)?, f.number(5)?)?;
    let sign = if dialect.pashr_heave_up { -1.0 } else { 1.0 };
    r.set_heave_down(f.number(6)?.map(|h| h * sign))?;
    Ok(r)
}

/// `ATT,GPS seconds of week,heading,pitch,roll,...`: pitch before roll.
fn pashr_att(f: &Fields) -> Decoded {
    let mut r = attitude(Kind::PashrAshtech, f, 6, [3, 5, 4])?;
    if let Some(seconds) = f.number(2)? {
        ensure((0.0..WEEK_S as f64).contains(&seconds))?;
        r.when = Some(StatedTime::GpsOfWeek(seconds_ns(seconds)));
    }
    Ok(r)
}

/// `HPR,hhmmss.ss,heading,pitch,roll,...`: pitch before roll.
fn hpr(kind: Kind, f: &Fields) -> Decoded {
    let mut r = attitude(kind, f, 6, [3, 5, 4])?;
    r.set_time(f.time_of_day(2)?, None);
    Ok(r)
}

/// `POS,mode,satellites,hhmmss.ss,lat,N,lon,E,height,age,course,knots,...`.
fn pashr_pos(f: &Fields) -> Decoded {
    let mut r = Reading::new(Kind::PashrPos);
    ensure(f.count >= 13)?;
    r.fix = match f.text(2) {
        "0" => FixQuality::Autonomous,
        "1" => FixQuality::Differential,
        "2" => FixQuality::RtkFloat,
        "3" => FixQuality::RtkFixed,
        "" => FixQuality::None,
        _ => FixQuality::Autonomous,
    };
    r.set_time(f.time_of_day(4)?, None);
    r.height_m = f.number(9)?;
    let course_speed = f.number(11)?.zip(f.number(12)?);
    r.set_position(f.position(5)?)?;
    r.set_course_knots(course_speed.filter(|_| r.fix != FixQuality::None))?;
    Ok(r)
}

/// `20,horizontal,height,heading,roll and pitch`, each 0 normal, 1 reduced or 2 invalid.
fn psxn_20(f: &Fields) -> Decoded {
    let mut r = Reading::new(Kind::Psxn20);
    let bad = |i: usize| match f.text(i) {
        "2" => Ok(true),
        "0" | "1" | "" => Ok(false),
        _ => Err(Malformed),
    };
    r.invalid = Some(super::reading::InvalidQuantities {
        position: bad(2)?,
        heading: bad(4)?,
        roll_pitch: bad(5)?,
    });
    Ok(r)
}

/// `23,roll,pitch,heading,heave`: heave positive down.
fn psxn_23(f: &Fields) -> Decoded {
    let mut r = attitude(Kind::Psxn23, f, 6, [4, 2, 3])?;
    r.set_heave_down(f.number(5)?)?;
    Ok(r)
}

/// Reading of a sentence with at least `count` fields. The array gives the fields of heading, roll and pitch.
fn attitude(kind: Kind, f: &Fields, count: usize, [heading, roll, pitch]: [usize; 3]) -> Decoded {
    let mut r = Reading::new(kind);
    ensure(f.count >= count)?;
    r.set_heading(f.number(heading)?)?;
    r.set_roll_pitch(f.number(roll)?, f.number(pitch)?)?;
    Ok(r)
}

/// `pitch,M/P,roll,B/T`. Values are unsigned: M is bow up, P bow down, B port down, T port up.
fn phtro(f: &Fields) -> Decoded {
    let mut r = Reading::new(Kind::Phtro);
    let pitch = f.signed_by(1, "M", "P")?;
    let roll = f.signed_by(3, "T", "B")?;
    r.set_roll_pitch(roll, pitch)?;
    Ok(r)
}

/// A sentence whose only useful value is the heave in field `i`, positive up.
fn heave_up(kind: Kind, f: &Fields, i: usize) -> Decoded {
    let mut r = Reading::new(kind);
    ensure(f.count > i)?;
    r.set_heave_down(f.number(i)?.map(|h| -h))?;
    Ok(r)
}

/// `01,hhmmss.sss,T/E,latency,heading,s,roll,s,pitch,s,primary heave,s,...`: pitch positive bow down, heave positive up.
fn phoct(f: &Fields) -> Decoded {
    let mut r = Reading::new(Kind::Phoct);
    ensure(f.count >= 13)?;
    let valid = |value: usize, status: usize| -> Result<Option<f64>, DecodeError> {
        let value = f.number(value)?;
        match f.text(status) {
            "T" => Ok(value),
            "E" | "I" => Ok(None),
            _ => Err(Malformed),
        }
    };
    let time = f.time_of_day(2)?;
    r.set_time(time.filter(|_| f.text(3) == "T"), None);
    r.set_heading(valid(5, 6)?)?;
    r.set_roll_pitch(valid(7, 8)?, valid(9, 10)?.map(|p| -p))?;
    r.set_heave_down(valid(11, 12)?.map(|h| -h))?;
    Ok(r)
}

/// `ATITUD,roll,pitch`: roll positive port up; pitch positive bow down, as in every iXblue sentence.
fn pixse_attitude(f: &Fields) -> Decoded {
    let mut r = Reading::new(Kind::PixseAttitude);
    ensure(f.count >= 4)?;
    r.set_roll_pitch(f.number(2)?, f.number(3)?.map(|p| -p))?;
    Ok(r)
}

/// `POSITI,latitude,longitude,altitude`: degrees, metres.
fn pixse_position(f: &Fields) -> Decoded {
    let mut r = Reading::new(Kind::PixsePosition);
    ensure(f.count >= 5)?;
    r.fix = FixQuality::Autonomous;
    r.height_m = f.number(4)?;
    // Longitudes may extend to 360 degrees east.
    let longitude = f.number(3)?.map(|l| if l > 180.0 { l - 360.0 } else { l });
    r.set_position(f.number(2)?.zip(longitude))?;
    Ok(r)
}

/// `DEPIN_,depth,hhmmss.ssss`: depth from the depth sensor of the unit, metres, and time of the depth.
fn pixse_depth(f: &Fields) -> Decoded {
    let mut r = Reading::new(Kind::OwnDepth);
    ensure(f.count >= 3)?;
    r.set_time(f.time_of_day(3)?, None);
    r.set_own_depth(f.number(2)?)?;
    Ok(r)
}

/// `depth,M`. Other units are ignored because they can be pressures.
fn pips(f: &Fields) -> Decoded {
    if f.text(2) != "M" {
        return Ok(Reading::information());
    }
    let mut r = Reading::new(Kind::OwnDepth);
    r.set_own_depth(f.number(1)?)?;
    Ok(r)
}

/// `AVR,hhmmss.ss,yaw,Yaw,tilt,Tilt,roll,Roll,range,quality,...`: tilt is positive bow up. An antenna pair gives either tilt or
/// roll.
fn avr(f: &Fields) -> Decoded {
    let mut r = Reading::new(Kind::Avr);
    r.set_time(f.time_of_day(2)?, None);
    let mut angles = [None; 3];
    for i in [3, 5, 7] {
        match f.text(i + 1) {
            "Yaw" => angles[0] = f.number(i)?,
            "Tilt" => angles[1] = f.number(i)?,
            "Roll" => angles[2] = f.number(i)?,
            _ => {}
        }
    }
    // Quality 0 means no fix.
    if f.text(10) == "0" {
        angles = [None; 3];
    }
    r.set_heading(angles[0])?;
    r.set_roll_pitch(angles[2], angles[1])?;
    Ok(r)
}

/// `GGK,hhmmss.ss,mmddyy,lat,N,lon,E,quality,satellites,DOP,EHTheight,M`.
fn ggk(f: &Fields) -> Decoded {
    let mut r = Reading::new(Kind::Ggk);
    ensure(f.count >= 12)?;
    let mut day_ns = None;
    if !f.text(3).is_empty() {
        let (month, day, year) = f.day_month_year(3)?;
        day_ns = Some(date_ns(day, month, year)?);
    }
    r.set_time(f.time_of_day(2)?, day_ns);
    r.fix = match f.text(8) {
        "0" | "" => FixQuality::None,
        "2" | "5" => FixQuality::RtkFloat,
        "3" => FixQuality::RtkFixed,
        "4" => FixQuality::Differential,
        _ => FixQuality::Autonomous,
    };
    let height = f.text(11).trim_start_matches("EHT");
    if !height.is_empty() {
        let height = height.parse::<f64>().ok().filter(|h| h.is_finite());
        r.height_m = Some(height.ok_or(Malformed)?);
    }
    r.set_position(f.position(4)?)?;
    Ok(r)
}

/// `heading,s,pitch,s,roll,s`. Status N is normal; L, H, C, M, P and O are outside the range of the instrument. The sentence does
/// not tell whether the heading is magnetic or true.
fn ptnthpr(f: &Fields) -> Decoded {
    let mut r = Reading::new(Kind::Ptnthpr);
    ensure(f.count >= 7)?;
    let normal = |i: usize| -> Result<Option<f64>, DecodeError> {
        let value = f.number(i)?;
        Ok(value.filter(|_| f.text(i + 1) == "N"))
    };
    r.set_heading(normal(1)?)?;
    r.set_roll_pitch(normal(5)?, normal(3)?)?;
    Ok(r)
}

/// PSBGA `time,s,roll,pitch,heading,...,i/v`; PSBGB `version,time,s,roll,pitch,heading,...,heave`. Heave is positive down.
fn psbg(f: &Fields, time: usize, heave: Option<usize>) -> Decoded {
    let mut r = Reading::new(Kind::Psbg);
    ensure(f.count >= time + 5)?;
    r.set_time(f.time_of_day(time)?, None);
    r.set_roll_pitch(f.number(time + 2)?, f.number(time + 3)?)?;
    r.set_heading(f.number(time + 4)?)?;
    // Flags: PSBGA i or v at 10 and 11, PSBGB 0 at 10, 11 and 14.
    let invalid = |i: usize| matches!(f.text(i), "i" | "0");
    if invalid(10) {
        r.roll_pitch_rad = None;
    }
    if invalid(11) {
        r.heading_rad = None;
    }
    if let Some(heave) = heave {
        r.set_heave_down(f.number(heave)?.filter(|_| !invalid(14)))?;
    }
    Ok(r)
}

/// VectorNav: `VNYMR,yaw,pitch,roll,...` and `VNINS,seconds of week,week,status,yaw,pitch,roll,lat,lon,alt,vN,vE,...`.
pub(crate) fn vectornav(f: &Fields) -> Decoded {
    let heading = |yaw: Option<f64>| yaw.map(|y| y.rem_euclid(360.0));
    match f.text(0) {
        "VNYMR" => {
            let mut r = Reading::new(Kind::Vnymr);
            ensure(f.count >= 4)?;
            r.set_heading(heading(f.number(1)?))?;
            r.set_roll_pitch(f.number(3)?, f.number(2)?)?;
            Ok(r)
        }
        "VNINS" => {
            let mut r = Reading::new(Kind::Vnins);
            ensure(f.count >= 12)?;
            let status = u16::from_str_radix(f.text(3).trim_start_matches("0x"), 16)
                .map_err(|_| Malformed)?;
            // Mode 0: the filter is not tracking.
            if status & 3 == 0 {
                return Ok(r);
            }
            if let (Some(seconds), Some(week)) = (f.number(1)?, f.number(2)?) {
                ensure((0.0..WEEK_S as f64).contains(&seconds) && (0.0..10_000.0).contains(&week))?;
                let gps_s = GPS_EPOCH_S + week as i64 * WEEK_S;
                let gps_ns = gps_s * echotank_core::time::NS_PER_S + seconds_ns(seconds);
                r.when = Some(StatedTime::Instant(UtcNs(super::message_time::utc_of_gps(
                    gps_ns,
                ))));
            }
            r.set_heading(heading(f.number(4)?))?;
            r.set_roll_pitch(f.number(6)?, f.number(5)?)?;
            r.fix = FixQuality::Autonomous;
            r.height_m = f.number(9)?;
            r.set_position(f.number(7)?.zip(f.number(8)?))?;
            if let (Some(north), Some(east)) = (f.number(10)?, f.number(11)?) {
                r.set_velocity(north, east)?;
            }
            Ok(r)
        }
        _ => Err(Unsupported),
    }
}

//! Sentences to readings. Comes in: a framed sentence. Goes out: a [`Reading`] in SI with our signs, or why not.
//!
//! The crate `nmea` 0.8 decodes GGA, RMC, VTG, ZDA and HDT, after [`decode`] has given it back what it insists on (checksum, HDT's `T`).
//! Own decoders take what it lacks (PASHR, PSXN,23) or refuses (two-digit years, leap seconds, GGA quality 9, long sentences) or would
//! misread (longitudes not padded with zeros: it takes three digits of degrees whatever comes).
//!
//! Signs: roll + port up (= starboard down) and pitch + bow up in both PASHR and PSXN,23, as ours. Heave is + down in PSXN,23 and taken
//! as + down in PASHR too: so SBG Systems' manual has it, but the sign is no standard, and some instruments of other makers send + up.
//! The flags at the end of PASHR mean different things by maker and are not looked at.

use std::fmt::Write;

use chrono::{NaiveDate, NaiveTime, Timelike};
use nmea::ParseResult;
use nmea::sentences::{FixType, rmc::RmcStatusOfFix};

use super::fields::Fields;
use super::framing::checksum_of;
use crate::flow::FixQuality;
use crate::time::NS_PER_S;

const KNOT_M_PER_S: f64 = 1852.0 / 3600.0;
/// No heave, metres, is larger; the tallest ocean wave recorded stands 30 m.
const MAX_HEAVE_M: f64 = 50.0;
/// The longest sentence the crate `nmea` looks at.
const NMEA_CRATE_MAX: usize = nmea::SENTENCE_MAX_LEN;

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Kind {
    Gga,
    Rmc,
    Vtg,
    Zda,
    Hdt,
    Pashr,
    Psxn23,
}

/// What one sentence said; empty fields are `None`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Reading {
    pub kind: Kind,
    /// UTC since midnight, nanoseconds; a leap second counts as the first second of the next day.
    pub time_of_day_ns: Option<i64>,
    /// UTC midnight of the day, nanoseconds since 1970.
    pub day_ns: Option<i64>,
    /// Latitude and longitude, radians; only from a valid fix.
    pub position_rad: Option<(f64, f64)>,
    pub height_m: Option<f64>,
    pub fix: FixQuality,
    /// Course over ground (radians) and speed (metres per second).
    pub course_speed: Option<(f64, f64)>,
    pub heading_rad: Option<f64>,
    /// Roll + starboard down, pitch + bow up, radians.
    pub roll_pitch_rad: Option<(f64, f64)>,
    pub heave_down_m: Option<f64>,
}

impl Reading {
    fn new(kind: Kind) -> Self {
        Self {
            kind,
            time_of_day_ns: None,
            day_ns: None,
            position_rad: None,
            height_m: None,
            fix: FixQuality::None,
            course_speed: None,
            heading_rad: None,
            roll_pitch_rad: None,
            heave_down_m: None,
        }
    }

    /// Every field that matters was empty, or there was no fix.
    pub fn is_empty(&self) -> bool {
        *self == Self::new(self.kind)
    }
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Refusal {
    /// A sentence that is not decoded here.
    Unsupported,
    /// A known sentence whose fields make no sense.
    Malformed,
}
use Refusal::{Malformed, Unsupported};

type Decoded = Result<Reading, Refusal>;

/// Decodes the body of a sentence (without `$` and `*hh`). `scratch` is overwritten.
pub fn decode(body: &str, scratch: &mut String) -> Decoded {
    let fields = Fields::split(body);
    let address = fields.text(0);
    match address {
        "PASHR" => return pashr(&fields),
        "PSXN" => return psxn(&fields),
        _ => {}
    }
    if address.len() != 5 || address.starts_with('P') {
        return Err(Unsupported);
    }
    let kind = match &address[2..] {
        "GGA" => Kind::Gga,
        "RMC" => Kind::Rmc,
        "VTG" => Kind::Vtg,
        "ZDA" => Kind::Zda,
        "HDT" => Kind::Hdt,
        _ => return Err(Unsupported),
    };
    restore(kind, body, &fields, scratch);
    if scratch.len() <= NMEA_CRATE_MAX
        && padded(kind, &fields)
        && let Some(decoded) = by_crate(kind, scratch)
    {
        return decoded;
    }
    match kind {
        Kind::Gga => gga(&fields),
        Kind::Rmc => rmc(&fields),
        Kind::Zda => zda(&fields),
        Kind::Vtg | Kind::Hdt | Kind::Pashr | Kind::Psxn23 => Err(Malformed),
    }
}

/// Writes the sentence as the crate wants it: with a checksum, and HDT with its `T`.
fn restore(kind: Kind, body: &str, fields: &Fields, out: &mut String) {
    out.clear();
    out.push('$');
    if kind == Kind::Hdt && fields.text(2).is_empty() {
        let _ = write!(out, "{},{},T", fields.text(0), fields.text(1));
    } else {
        out.push_str(body);
    }
    let sum = checksum_of(&out[1..]);
    let _ = write!(out, "*{sum:02X}");
}

/// Latitude has two digits of degrees and longitude three, or neither is there.
fn padded(kind: Kind, fields: &Fields) -> bool {
    let first = match kind {
        Kind::Gga => 2,
        Kind::Rmc => 3,
        _ => return true,
    };
    let whole = |text: &str| text.find('.').unwrap_or(text.len());
    let (latitude, longitude) = (fields.text(first), fields.text(first + 2));
    (latitude.is_empty() && longitude.is_empty()) || (whole(latitude) == 4 && whole(longitude) == 5)
}

// ---------------------------------------------------------------- by the crate

/// `None`: the crate would not take it.
fn by_crate(kind: Kind, text: &str) -> Option<Decoded> {
    let mut r = Reading::new(kind);
    let sound = match nmea::parse_str(text).ok()? {
        ParseResult::GGA(d) => {
            r.time_of_day_ns = d.fix_time.map(of_naive_time);
            r.fix = d.fix_type.map_or(FixQuality::None, of_fix_type);
            r.height_m = d.altitude.map(f64::from);
            set_position(&mut r, d.latitude.zip(d.longitude))
        }
        ParseResult::RMC(d) => {
            r.time_of_day_ns = d.fix_time.map(of_naive_time);
            r.fix = match d.status_of_fix {
                RmcStatusOfFix::Autonomous => FixQuality::Autonomous,
                RmcStatusOfFix::Differential => FixQuality::Differential,
                RmcStatusOfFix::Invalid => FixQuality::None,
            };
            // A receiver without a fix may also be wrong about the date.
            r.day_ns = d
                .fix_date
                .filter(|_| r.fix != FixQuality::None)
                .and_then(day_ns);
            let course_speed = d.true_course.zip(d.speed_over_ground);
            set_position(&mut r, d.lat.zip(d.lon)) && set_course_speed(&mut r, course_speed)
        }
        ParseResult::VTG(d) => {
            r.fix = FixQuality::Autonomous;
            let sound = set_course_speed(&mut r, d.true_course.zip(d.speed_over_ground));
            r.fix = FixQuality::None;
            sound
        }
        ParseResult::ZDA(d) => {
            r.time_of_day_ns = d.utc_time.map(of_naive_time);
            r.day_ns = d.utc_date().and_then(day_ns);
            r.day_ns.is_some() || d.day.or(d.month).is_none()
        }
        ParseResult::HDT(d) => {
            r.heading_rad = d.heading.map(|deg| wrapped(f64::from(deg)));
            d.heading.is_none_or(|deg| sane_heading(f64::from(deg)))
        }
        _ => false,
    };
    Some(if sound { Ok(r) } else { Err(Malformed) })
}

fn of_naive_time(time: NaiveTime) -> i64 {
    // The crate rounds fractions on its own: nanosecond() may be 1e9.
    i64::from(time.num_seconds_from_midnight()) * NS_PER_S + i64::from(time.nanosecond())
}

fn of_fix_type(fix: FixType) -> FixQuality {
    match fix {
        FixType::Invalid => FixQuality::None,
        // Manual and simulated positions are what a bench feeds us.
        FixType::Gps | FixType::Pps | FixType::Manual | FixType::Simulation => {
            FixQuality::Autonomous
        }
        FixType::DGps => FixQuality::Differential,
        FixType::Rtk => FixQuality::RtkFixed,
        FixType::FloatRtk => FixQuality::RtkFloat,
        FixType::Estimated => FixQuality::DeadReckoning,
    }
}

/// UTC midnight in nanoseconds since 1970; `None` outside what 64 bits hold.
fn day_ns(date: NaiveDate) -> Option<i64> {
    date.and_time(NaiveTime::MIN)
        .and_utc()
        .timestamp_nanos_opt()
}

// ---------------------------------------------------------------- shared rules

/// Takes a position in degrees if there is a fix. False: out of range.
fn set_position(r: &mut Reading, position_deg: Option<(f64, f64)>) -> bool {
    if r.fix == FixQuality::None {
        r.height_m = None;
        return true;
    }
    let Some((latitude, longitude)) = position_deg else {
        r.fix = FixQuality::None;
        r.height_m = None;
        return true;
    };
    r.position_rad = Some((latitude.to_radians(), longitude.to_radians()));
    latitude.abs() <= 90.0
        && longitude.abs() <= 180.0
        && r.height_m.is_none_or(|h| h.abs() < 100_000.0)
}

/// Takes course (degrees) and speed (knots) if there is a fix. False: out of range.
fn set_course_speed(r: &mut Reading, course_speed: Option<(f32, f32)>) -> bool {
    let Some((course, speed)) = course_speed.filter(|_| r.fix != FixQuality::None) else {
        return true;
    };
    let (course, speed) = (f64::from(course), f64::from(speed) * KNOT_M_PER_S);
    r.course_speed = Some((wrapped(course), speed));
    sane_heading(course) && (0.0..1000.0).contains(&speed)
}

fn sane_heading(degrees: f64) -> bool {
    (-360.0..=720.0).contains(&degrees)
}

/// Degrees to radians in 0..2 pi.
fn wrapped(degrees: f64) -> f64 {
    degrees.rem_euclid(360.0).to_radians()
}

// ---------------------------------------------------------------- our own

/// `$PASHR,hhmmss.sss,heading,T,roll,pitch,heave,...` (the inertial form; Ashtech's ATT, POS and HPR forms are not decoded).
fn pashr(f: &Fields) -> Decoded {
    let mut r = Reading::new(Kind::Pashr);
    if f.text(1).starts_with(|c: char| c.is_ascii_alphabetic()) {
        return Err(Unsupported);
    }
    if f.count < 7 || !matches!(f.text(3), "T" | "") {
        return Err(Malformed);
    }
    r.time_of_day_ns = f.time_of_day(1)?;
    set_attitude(&mut r, f.number(2)?, f.number(4)?, f.number(5)?)?;
    set_heave(&mut r, f.number(6)?)?;
    Ok(r)
}

/// `$PSXN,23,roll,pitch,heading,heave`; the other PSXN messages carry quality and rates.
fn psxn(f: &Fields) -> Decoded {
    if f.text(1) != "23" {
        return Err(Unsupported);
    }
    let mut r = Reading::new(Kind::Psxn23);
    if f.count < 6 {
        return Err(Malformed);
    }
    set_attitude(&mut r, f.number(4)?, f.number(2)?, f.number(3)?)?;
    set_heave(&mut r, f.number(5)?)?;
    Ok(r)
}

fn set_attitude(
    r: &mut Reading,
    heading_deg: Option<f64>,
    roll_deg: Option<f64>,
    pitch_deg: Option<f64>,
) -> Result<(), Refusal> {
    let sane = heading_deg.is_none_or(sane_heading)
        && roll_deg.is_none_or(|a| a.abs() <= 180.0)
        && pitch_deg.is_none_or(|a| a.abs() <= 90.0);
    r.heading_rad = heading_deg.map(wrapped);
    r.roll_pitch_rad = roll_deg
        .zip(pitch_deg)
        .map(|(roll, pitch)| (roll.to_radians(), pitch.to_radians()));
    sane.then_some(()).ok_or(Malformed)
}

fn set_heave(r: &mut Reading, heave_down_m: Option<f64>) -> Result<(), Refusal> {
    r.heave_down_m = heave_down_m;
    let sane = heave_down_m.is_none_or(|h| h.abs() <= MAX_HEAVE_M);
    sane.then_some(()).ok_or(Malformed)
}

fn gga(f: &Fields) -> Decoded {
    let mut r = Reading::new(Kind::Gga);
    r.time_of_day_ns = f.time_of_day(1)?;
    r.fix = match f.text(6) {
        "0" | "" => FixQuality::None,
        "1" | "3" | "7" | "8" => FixQuality::Autonomous,
        "2" | "9" => FixQuality::Differential,
        "4" => FixQuality::RtkFixed,
        "5" => FixQuality::RtkFloat,
        "6" => FixQuality::DeadReckoning,
        _ => return Err(Malformed),
    };
    r.height_m = f.number(9)?;
    let position = f.position(2)?;
    let sound = set_position(&mut r, position);
    sound.then_some(r).ok_or(Malformed)
}

fn rmc(f: &Fields) -> Decoded {
    let mut r = Reading::new(Kind::Rmc);
    r.time_of_day_ns = f.time_of_day(1)?;
    r.fix = match f.text(2) {
        "A" => FixQuality::Autonomous,
        "D" => FixQuality::Differential,
        "V" | "" => FixQuality::None,
        _ => return Err(Malformed),
    };
    if r.fix != FixQuality::None && !f.text(9).is_empty() {
        let (day, month, year) = f.day_month_year(9)?;
        r.day_ns = Some(date(day, month, year)?);
    }
    let course_speed = f.number(8)?.zip(f.number(7)?);
    let position = f.position(3)?;
    let sound = set_position(&mut r, position)
        && set_course_speed(&mut r, course_speed.map(|(c, s)| (c as f32, s as f32)));
    sound.then_some(r).ok_or(Malformed)
}

fn zda(f: &Fields) -> Decoded {
    let mut r = Reading::new(Kind::Zda);
    r.time_of_day_ns = f.time_of_day(1)?;
    if let (Some(day), Some(month), Some(year)) = (f.number(2)?, f.number(3)?, f.number(4)?) {
        r.day_ns = Some(date(day as u32, month as u32, year as i32)?);
    }
    Ok(r)
}

/// Midnight of a date; a year below 100 lies in 1983..2082, as the crate has it.
fn date(day: u32, month: u32, year: i32) -> Result<i64, Refusal> {
    let year = match year {
        0..=82 => year + 2000,
        83..=99 => year + 1900,
        _ => year,
    };
    NaiveDate::from_ymd_opt(year, month, day)
        .and_then(day_ns)
        .ok_or(Malformed)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn read(body: &str) -> Decoded {
        decode(body, &mut String::new())
    }
    fn near(got: f64, want_deg: f64, tolerance_deg: f64) {
        let error = got.to_degrees() - want_deg;
        assert!(
            error.abs() < tolerance_deg,
            "got {} want {want_deg}",
            got.to_degrees()
        );
    }

    #[test]
    fn pashr_gives_roll_before_pitch_and_heave_down() {
        let r = read("PASHR,204132.040,010.99,T,+00.41,-00.75,-00.84,0.151,0.088,0.569,1,0")
            .expect("decodes");
        let (roll, pitch) = r.roll_pitch_rad.expect("attitude");
        near(roll, 0.41, 1e-12);
        near(pitch, -0.75, 1e-12);
        near(r.heading_rad.expect("heading"), 10.99, 1e-12);
        assert_eq!(r.heave_down_m, Some(-0.84));
        assert_eq!(
            r.time_of_day_ns,
            Some((20 * 3600 + 41 * 60 + 32) * NS_PER_S + 40_000_000)
        );
    }

    #[test]
    fn pashr_of_a_dual_antenna_unit_has_no_pitch_and_still_a_heading() {
        let r = read("PASHR,114835.60,027.23,T,-75.83,,,3.158,,4.831,1,").expect("decodes");
        assert_eq!(r.roll_pitch_rad, None);
        assert_eq!(r.heave_down_m, None);
        near(r.heading_rad.expect("heading"), 27.23, 1e-12);
        assert_eq!(
            read("PASHR,ATT,1,2,3,4,5,6,7"),
            Err(Unsupported),
            "Ashtech's form has pitch first"
        );
    }

    #[test]
    fn psxn_23_gives_roll_pitch_heading_heave_in_this_order() {
        let r = read("PSXN,23,0.35,-1.74,218.26,0.58").expect("decodes");
        let (roll, pitch) = r.roll_pitch_rad.expect("attitude");
        near(roll, 0.35, 1e-12);
        near(pitch, -1.74, 1e-12);
        near(r.heading_rad.expect("heading"), 218.26, 1e-12);
        assert_eq!(r.heave_down_m, Some(0.58), "down is plus");
        assert_eq!(
            read("PSXN,23,0.35,-1.74,218.26,")
                .expect("decodes")
                .heave_down_m,
            None
        );
        assert_eq!(read("PSXN,20,1,0,0,0"), Err(Unsupported));
        assert_eq!(read("PSXN,23,0.35,-91.74,218.26,0.58"), Err(Malformed));
        assert_eq!(read("PSXN,23,nan,-1.74,218.26,0.58"), Err(Malformed));
    }

    #[test]
    fn what_the_crate_refuses_or_misreads_is_taken_here() {
        let zda = read("GPZDA,195719,16,04,14,-02,00").expect("two-digit year");
        assert_eq!(zda.day_ns, Some(1_397_606_400 * NS_PER_S), "2014-04-16");
        let padded = read("GPGGA,195719,5310.8115,N,00516.0606,E,9,00,1.10,-2,M,,M,,")
            .expect("quality 9")
            .position_rad;
        let bare = read("GPGGA,195719,5310.8115,N,516.0606,E,1,00,1.10,-2,M,,M,,")
            .expect("unpadded")
            .position_rad;
        assert!(padded.is_some());
        assert_eq!(bare, padded);
        // The crate would read 175 deg 6.36 min.
        let two =
            read("INGGA,000000.16,2200.11,S,1756.36,W,1,12,0.7,-2.76,M,4.67,M,,").expect("ok");
        near(
            two.position_rad.expect("position").1,
            -(17.0 + 56.36 / 60.0),
            1e-12,
        );
        let leap = read("GPZDA,235960,30,06,2015,00,00").expect("leap second");
        assert_eq!(leap.time_of_day_ns, Some(86_400 * NS_PER_S));
        assert_eq!(
            read("GPHDT,123.4").expect("no T").heading_rad,
            read("GPHDT,123.4,T").expect("T").heading_rad
        );
        assert!(read("GPHDT,,").expect("empty").is_empty());
    }

    #[test]
    fn a_receiver_without_a_fix_says_nothing_but_the_time() {
        let gga = read("GPGGA,133605.0,5521.75946,N,03731.93769,E,0,00,,,M,,M,,").expect("decodes");
        assert_eq!(gga.position_rad, None);
        let rmc = read("GPRMC,133605.0,V,,,,,,,060180,,").expect("decodes");
        assert_eq!((rmc.day_ns, rmc.course_speed), (None, None));
        assert!(rmc.time_of_day_ns.is_some());
    }
}

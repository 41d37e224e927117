//! Decodes a framed NMEA 0183 sentence into a [`Reading`] in SI units.
//!
//! Each sentence type has one decoder. The crate `nmea` 0.8 decodes VTG and HDT. Its `f32` values resolve angles to 1.5e-5 degrees
//! and speeds to a relative 1e-6, which is finer than the text of either sentence. Functions of this module decode the other
//! sentences, because the crate:
//! - refuses leap seconds (GGA, RMC, ZDA), GGA quality 9, two-digit years (ZDA) and GLL without a mode;
//! - misreads longitudes without leading zeros, because it always takes three digits of degrees (GGA, RMC, GLL);
//! - rounds GGA heights and RMC courses and speeds to `f32`;
//! - has no decoders of HDG, HDM, THS, DBT and the proprietary sentences.
//!
//! Signs: roll is positive port up (starboard down), pitch bow up, heading clockwise from true north, heave down. Each decoder
//! converts the signs of its sentence to this convention. The flags at the end of PASHR differ between manufacturers and are
//! ignored.

use nmea::sentences::{parse_hdt, parse_vtg};
use nmea::{NmeaSentence, SentenceType};

use super::fields::Fields;
use super::proprietary;
use super::reading::DecodeError::{self, Malformed, Unsupported};
use super::reading::{Decoded, Kind, Reading, date_ns, ensure};
use echotank_config::spec::NavDialect;
use echotank_core::navigation::FixQuality;

const FATHOM_M: f64 = 1.8288;
const FOOT_M: f64 = 0.3048;

/// Decodes the body of a sentence, without `$` and `*hh`. `scratch` is overwritten.
pub fn decode(body: &str, dialect: &NavDialect, scratch: &mut String) -> Decoded {
    let f = Fields::split(body);
    if f.text(0).starts_with('P') {
        return proprietary::decode(&f, dialect);
    }
    match sentence_type(&f).ok_or(Unsupported)? {
        "GGA" => gga(&f),
        "RMC" => rmc(&f),
        "GLL" => gll(&f),
        "VTG" => vtg(&f, scratch),
        "ZDA" => zda(&f),
        "HDT" => hdt(&f, scratch),
        "THS" => ths(&f),
        "HDG" => hdg(&f, dialect),
        "HDM" => magnetic(f.number(1)?, None, dialect),
        "DBT" | "DBS" | "DBK" => depth_below(&f).and_then(|r| own_depth(r, dialect)),
        "DPT" => dpt(&f).and_then(|r| own_depth(r, dialect)),
        "YMR" | "INS" => proprietary::vectornav(&f),
        "GST" | "ROT" => Ok(match f.text(1).is_empty() {
            true => Reading::new(Kind::Information),
            false => Reading::information(),
        }),
        _ => Err(Unsupported),
    }
}

/// The three letters after a two-letter talker.
fn sentence_type<'a>(fields: &Fields<'a>) -> Option<&'a str> {
    let address = fields.text(0);
    let standard = address.len() == 5 && address.is_ascii() && !address.starts_with('P');
    standard.then(|| &address[2..])
}

/// Writes fields 1 to `count` to `out`. Absent fields are written empty, because the crate `nmea` requires a fixed number of
/// fields.
fn join_fields(f: &Fields, count: usize, out: &mut String) {
    out.clear();
    for i in 1..=count {
        if i > 1 {
            out.push(',');
        }
        out.push_str(f.text(i));
    }
}

/// Sentence in the form of the crate `nmea`. The framing has already verified the checksum.
fn crate_sentence(message_id: SentenceType, data: &str) -> NmeaSentence<'_> {
    NmeaSentence {
        talker_id: "",
        message_id,
        data,
        checksum: 0,
    }
}

fn gga(f: &Fields) -> Decoded {
    let mut r = Reading::new(Kind::Gga);
    r.set_time(f.time_of_day(1)?, None);
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
    r.set_position(f.position(2)?)?;
    Ok(r)
}

fn rmc(f: &Fields) -> Decoded {
    let mut r = Reading::new(Kind::Rmc);
    r.fix = match f.text(2) {
        "A" => FixQuality::Autonomous,
        "D" => FixQuality::Differential,
        "V" | "" => FixQuality::None,
        _ => return Err(Malformed),
    };
    let mut day_ns = None;
    if r.fix != FixQuality::None && !f.text(9).is_empty() {
        let (day, month, year) = f.day_month_year(9)?;
        day_ns = Some(date_ns(day, month, year)?);
    }
    r.set_time(f.time_of_day(1)?, day_ns);
    let course_speed = f.number(8)?.zip(f.number(7)?);
    r.set_position(f.position(3)?)?;
    r.set_course_knots(course_speed.filter(|_| r.fix != FixQuality::None))?;
    Ok(r)
}

/// `lat,N,lon,E[,hhmmss.ss,status[,mode]]`: NMEA 2.0 added the time, 2.3 the mode.
fn gll(f: &Fields) -> Decoded {
    let mut r = Reading::new(Kind::Gll);
    r.set_time(f.time_of_day(5)?, None);
    r.fix = match (f.text(6), f.text(7)) {
        ("V", _) | (_, "N") => FixQuality::None,
        (_, "D") => FixQuality::Differential,
        (_, "E") => FixQuality::DeadReckoning,
        ("A" | "", _) => FixQuality::Autonomous,
        _ => return Err(Malformed),
    };
    r.set_position(f.position(1)?)?;
    Ok(r)
}

/// `course,T,magnetic,M,knots,N,km/h,K[,mode]`.
fn vtg(f: &Fields, scratch: &mut String) -> Decoded {
    let mut r = Reading::new(Kind::Vtg);
    join_fields(f, 8, scratch);
    let data = parse_vtg(crate_sentence(SentenceType::VTG, scratch)).map_err(|_| Malformed)?;
    let course_speed = data.true_course.zip(data.speed_over_ground);
    // The crate ignores mode N: not valid.
    let course_speed = course_speed.filter(|_| f.text(9) != "N");
    r.set_course_knots(course_speed.map(|(course, knots)| (course.into(), knots.into())))?;
    Ok(r)
}

fn zda(f: &Fields) -> Decoded {
    let mut r = Reading::new(Kind::Zda);
    let time = f.time_of_day(1)?;
    let mut day_ns = None;
    if let (Some(day), Some(month), Some(year)) = (f.number(2)?, f.number(3)?, f.number(4)?) {
        day_ns = Some(date_ns(day as u32, month as u32, year as i32)?);
    }
    r.set_time(time, day_ns);
    Ok(r)
}

/// `heading,T`. The crate requires the `T`, which some senders omit.
fn hdt(f: &Fields, scratch: &mut String) -> Decoded {
    let mut r = Reading::new(Kind::Hdt);
    join_fields(f, 2, scratch);
    if f.text(2).is_empty() {
        scratch.push('T');
    }
    let data = parse_hdt(crate_sentence(SentenceType::HDT, scratch)).map_err(|_| Malformed)?;
    r.set_heading(data.heading.map(f64::from))?;
    Ok(r)
}

/// `heading,mode`; mode V means not valid.
fn ths(f: &Fields) -> Decoded {
    let mut r = Reading::new(Kind::Ths);
    ensure(matches!(f.text(2), "A" | "E" | "M" | "S" | "V" | ""))?;
    r.set_heading(f.number(1)?.filter(|_| f.text(2) != "V"))?;
    Ok(r)
}

/// `heading,deviation,E/W,variation,E/W`. True heading = magnetic + deviation + variation, with east positive.
fn hdg(f: &Fields, dialect: &NavDialect) -> Decoded {
    let east = |value: usize| -> Result<Option<f64>, DecodeError> {
        match (f.number(value)?, f.text(value + 1)) {
            (None, _) => Ok(None),
            (Some(v), "E") => Ok(Some(v)),
            (Some(v), "W") => Ok(Some(-v)),
            _ => Err(Malformed),
        }
    };
    let deviation = east(2)?.unwrap_or(0.0);
    magnetic(f.number(1)?.map(|m| m + deviation), east(4)?, dialect)
}

fn magnetic(degrees: Option<f64>, variation: Option<f64>, dialect: &NavDialect) -> Decoded {
    let mut r = Reading::new(Kind::Magnetic);
    let variation = variation.or(dialect.magnetic_variation_rad.map(f64::to_degrees));
    match variation {
        Some(variation) => r.set_heading(degrees.map(|d| d + variation))?,
        None => {
            r.set_heading(degrees)?;
            r.magnetic_rad = r.heading_rad.take();
        }
    }
    Ok(r)
}

/// `feet,f,metres,M,fathoms,F`.
fn depth_below(f: &Fields) -> Decoded {
    let mut r = Reading::new(Kind::Depth);
    let feet = f.number(1)?.map(|d| d * FOOT_M);
    let fathoms = f.number(5)?.map(|d| d * FATHOM_M);
    r.water_depth_m = f.number(3)?.or(feet).or(fathoms);
    Ok(r)
}

/// Converts a water depth to the platform's own depth if the configuration says that the sensor measures it.
fn own_depth(water: Reading, dialect: &NavDialect) -> Decoded {
    if !dialect.depth_is_own {
        return Ok(water);
    }
    let mut r = Reading::new(Kind::OwnDepth);
    r.set_own_depth(water.water_depth_m)?;
    Ok(r)
}

/// `depth,offset[,range]`: depth below the transducer.
fn dpt(f: &Fields) -> Decoded {
    let mut r = Reading::new(Kind::Depth);
    r.water_depth_m = f.number(1)?;
    f.number(2)?;
    Ok(r)
}

#[cfg(test)]
mod tests {
    use super::*;
    use echotank_core::time::NS_PER_S;

    fn read(body: &str) -> Decoded {
        decode(body, &NavDialect::default(), &mut String::new())
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
    fn decodes_what_the_nmea_crate_refuses_or_misreads() {
        let zda = read("GPZDA,195719,16,04,14,-02,00").expect("two-digit year");
        assert_eq!(zda.day_ns(), Some(1_397_606_400 * NS_PER_S), "2014-04-16");
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
        assert_eq!(leap.time_of_day_ns(), Some(86_400 * NS_PER_S));
        assert_eq!(
            read("GPHDT,123.4").expect("no T").heading_rad,
            read("GPHDT,123.4,T").expect("T").heading_rad
        );
        assert!(read("GPHDT,,").expect("empty").is_empty());
    }

    #[test]
    fn gll_with_and_without_time_mode_and_padding() {
        let full = read("GPGLL,5310.8115,N,00525.7025,E,195719,A,A").expect("full");
        let bare = read("GPGLL,5310.8115,N,525.7025,E").expect("bare");
        assert_eq!(full.position_rad, bare.position_rad);
        assert_eq!((full.when.is_some(), bare.when), (true, None));
        let lost = read("GPGLL,5310.8115,N,00525.7025,E,195719,V,N").expect("no fix");
        assert_eq!(lost.position_rad, None);
    }

    #[test]
    fn magnetic_headings_need_a_variation_to_become_true() {
        let heading = |body: &str, variation_deg: Option<f64>| {
            let dialect = NavDialect {
                magnetic_variation_rad: variation_deg.map(f64::to_radians),
                ..NavDialect::default()
            };
            let r = decode(body, &dialect, &mut String::new()).expect("decodes");
            (
                r.heading_rad.map(f64::to_degrees),
                r.magnetic_rad.map(f64::to_degrees),
            )
        };
        let close = |got: Option<f64>, want: f64| {
            assert!((got.expect("some") - want).abs() < 1e-9, "{got:?} {want}");
        };
        close(heading("SDHDG,229.8,,,1.3,E", None).0, 231.1);
        close(heading("SDHDG,0.5,2.0,W,1.0,W", None).0, 357.5);
        let (true_deg, magnetic_deg) = heading("SDHDG,229.8,,,,", None);
        assert_eq!(true_deg, None);
        close(magnetic_deg, 229.8);
        close(heading("BKHDM,277.5,M", Some(-3.0)).0, 274.5);
        // The variation in the sentence takes precedence over the configured one.
        close(heading("SDHDG,229.8,,,1.3,E", Some(-3.0)).0, 231.1);
    }

    #[test]
    fn depths_convert_to_metres() {
        let depth = |body: &str| read(body).expect("decodes").water_depth_m;
        assert_eq!(depth("SDDBT,12.3,f,3.75,M,2.05,F"), Some(3.75));
        let feet = depth("SDDBT,10.0,f,,M,,F").expect("feet");
        assert!((feet - 3.048).abs() < 1e-12);
        assert_eq!(depth("KIDPT,4674.70,8.62,12000.0"), Some(4674.70));
        assert_eq!(depth("SDDPT,,"), None);
    }

    #[test]
    fn ths_in_mode_v_has_no_heading() {
        let heading = |body: &str| read(body).expect("decodes").heading_rad;
        near(heading("HETHS,77.5,A").expect("valid"), 77.5, 1e-12);
        assert_eq!(heading("HETHS,77.5,V"), None);
        assert_eq!(read("HETHS,77.5,Q"), Err(Malformed));
    }

    #[test]
    fn a_receiver_without_a_fix_gives_only_the_time() {
        let gga = read("GPGGA,133605.0,5521.75946,N,03731.93769,E,0,00,,,M,,M,,").expect("decodes");
        assert_eq!(gga.position_rad, None);
        let rmc = read("GPRMC,133605.0,V,,,,,,,060180,,").expect("decodes");
        assert_eq!((rmc.day_ns(), rmc.course_speed), (None, None));
        assert!(rmc.time_of_day_ns().is_some());
    }
}

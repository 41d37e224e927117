//! Tests of all formats: a known motion is encoded and decoded unchanged; signs; corrupted bytes; comparison of the decoders with
//! the crate `nmea`.

use std::f64::consts::TAU;

use echotank_config::spec::{
    ChecksumPolicy, NavChannel, NavDialect, NavFormat, NavSourceSpec, Reversed, TimePolicy,
};
use echotank_core::navigation::{NavQuantity, NavSample};
use echotank_core::time::{NS_PER_S, UtcNs};
use echotank_nav::framing::checksum_of;
use echotank_nav::log::{LogKind, read_log};
use echotank_nav::records::seapath_crc;
use echotank_nav::sentence::decode;
use echotank_nav::{NavCounters, NavDecoder};
use proptest::prelude::*;

use crate::{ALL, log_source, sum_of_classes};

/// 2014-08-01T00:00:00Z; GPS week 1803, 432016 s.
const DAY_S: i64 = 1_406_851_200;
/// Delay of the attitude of a Seapath on a serial link, seconds.
const LATENCY_S: f64 = 0.36;

fn source(dialect: NavDialect, time: TimePolicy) -> NavSourceSpec {
    NavSourceSpec {
        dialect,
        time,
        ..log_source(&ALL)
    }
}

// ---------------------------------------------------------------- the known motion

/// Attitude in degrees, heave in metres, in our sign convention, at `t` seconds past midnight.
#[derive(Clone, Copy)]
struct Motion {
    t: f64,
    roll: f64,
    pitch: f64,
    heading: f64,
    heave_down: f64,
    latitude: f64,
    longitude: f64,
    height: f64,
    north_m_s: f64,
    east_m_s: f64,
}

/// Sines of different periods, and a heading that passes through north.
fn motion(t: f64) -> Motion {
    Motion {
        t,
        roll: 12.34 * (TAU * t / 7.1).sin() + 1.0,
        pitch: 5.67 * (TAU * t / 5.3).sin() - 0.5,
        heading: (20.0 * (TAU * t / 31.0).sin()).rem_euclid(360.0),
        heave_down: 2.5 * (TAU * t / 9.7).sin(),
        latitude: -22.0 + 0.0003 * t,
        longitude: -17.9 - 0.0002 * t,
        height: 3.5 * (TAU * t / 9.7).sin(),
        north_m_s: 3.0,
        east_m_s: -4.0,
    }
}

fn nmea(body: String) -> Vec<u8> {
    echotank_testing::nav::sentence(&body)
}
fn clock(t: f64) -> String {
    let ms = (t * 1000.0).round() as i64;
    let s = ms / 1000;
    format!(
        "{:02}{:02}{:02}.{:03}",
        s / 3600,
        s / 60 % 60,
        s % 60,
        ms % 1000
    )
}
fn ddmm(degrees: f64, width: usize, letters: [&str; 2]) -> String {
    let (whole, minutes) = (degrees.abs().floor(), degrees.abs().fract() * 60.0);
    let letter = letters[usize::from(degrees < 0.0)];
    format!("{whole:0width$.0}{minutes:09.6},{letter}")
}
fn latlon(m: &Motion) -> String {
    format!(
        "{},{}",
        ddmm(m.latitude, 2, ["N", "S"]),
        ddmm(m.longitude, 3, ["E", "W"])
    )
}
fn letter(value: f64, plus: char, minus: char) -> char {
    if value < 0.0 { minus } else { plus }
}

fn gga(m: &Motion) -> Vec<u8> {
    let (time, place) = (clock(m.t), latlon(m));
    nmea(format!(
        "GPGGA,{time},{place},1,12,0.7,{:.2},M,4.67,M,,",
        m.height
    ))
}
fn course_and_knots(m: &Motion) -> (f64, f64) {
    let course = m.east_m_s.atan2(m.north_m_s).to_degrees();
    let knots = m.north_m_s.hypot(m.east_m_s) * 3600.0 / 1852.0;
    (course.rem_euclid(360.0), knots)
}
fn rmc(m: &Motion) -> Vec<u8> {
    let (time, place) = (clock(m.t), latlon(m));
    let (course, knots) = course_and_knots(m);
    nmea(format!(
        "GPRMC,{time},A,{place},{knots:.3},{course:.2},010814,,,A"
    ))
}
fn gll(m: &Motion) -> Vec<u8> {
    nmea(format!("GPGLL,{},{},A", latlon(m), clock(m.t)))
}
fn ggk(m: &Motion) -> Vec<u8> {
    let (time, place) = (clock(m.t), latlon(m));
    nmea(format!(
        "PTNL,GGK,{time},080114,{place},3,07,1.2,EHT{:.3},M",
        m.height
    ))
}
fn hdt(m: &Motion) -> Vec<u8> {
    nmea(format!("HEHDT,{:.2},T", m.heading))
}
fn ths(m: &Motion) -> Vec<u8> {
    nmea(format!("HETHS,{:.2},A", m.heading))
}
fn hdg(m: &Motion) -> Vec<u8> {
    let magnetic = (m.heading - 1.5 + 24.7).rem_euclid(360.0);
    nmea(format!("HCHDG,{magnetic:.2},1.5,E,24.7,W"))
}
fn pashr(m: &Motion) -> Vec<u8> {
    nmea(format!(
        "PASHR,{},{:.2},T,{:+.2},{:+.2},{:+.2},0.1,0.1,0.5,1,0",
        clock(m.t),
        m.heading,
        m.roll,
        m.pitch,
        m.heave_down
    ))
}
fn pashr_heave_up(m: &Motion) -> Vec<u8> {
    pashr(&Motion {
        heave_down: -m.heave_down,
        ..*m
    })
}
fn pashr_att(m: &Motion) -> Vec<u8> {
    nmea(format!(
        "PASHR,ATT,{:.3},{:.3},{:.3},{:.3},0.001,0.001,0",
        432_016.0 + m.t,
        m.heading,
        m.pitch,
        m.roll
    ))
}
fn pashr_hpr(m: &Motion) -> Vec<u8> {
    nmea(format!(
        "PASHR,HPR,{},{:.3},{:.3},{:.3},0.001,0.001,0,1,1,1.2",
        clock(m.t),
        m.heading,
        m.pitch,
        m.roll
    ))
}
fn pashr_pos(m: &Motion) -> Vec<u8> {
    let (time, place) = (clock(m.t), latlon(m));
    let (course, knots) = course_and_knots(m);
    nmea(format!(
        "PASHR,POS,0,12,{time},{place},{:.2},,{course:.3},{knots:.3},0.1,1.0,1.0,1.0,1.0,ABCD",
        m.height
    ))
}
fn psxn_23(m: &Motion) -> Vec<u8> {
    nmea(format!(
        "PSXN,23,{:.2},{:.2},{:.2},{:.2}",
        m.roll, m.pitch, m.heading, m.heave_down
    ))
}
fn prdid(m: &Motion) -> Vec<u8> {
    nmea(format!(
        "PRDID,{:+07.2},{:+07.2},{:06.2}",
        m.pitch, m.roll, m.heading
    ))
}
fn phtro(m: &Motion) -> Vec<u8> {
    nmea(format!(
        "PHTRO,{:.2},{},{:.2},{}",
        m.pitch.abs(),
        letter(m.pitch, 'M', 'P'),
        m.roll.abs(),
        letter(m.roll, 'T', 'B')
    ))
}
fn phlin(m: &Motion) -> Vec<u8> {
    nmea(format!("PHLIN,0.030,0.220,{:.3}", -m.heave_down))
}
fn phoct(m: &Motion) -> Vec<u8> {
    let heave_up = -m.heave_down;
    nmea(format!(
        "PHOCT,01,{},T,00,{:07.3},T,{:+08.3},T,{:+07.3},T,{heave_up:+07.3},T,{heave_up:+07.3},+00.016,+00.003,+00.002,-00.001,+00.000,+0001.96",
        clock(m.t),
        m.heading,
        m.roll,
        -m.pitch
    ))
}
fn pixse(m: &Motion) -> Vec<u8> {
    [
        nmea(format!("PIXSE,ATITUD,{:.3},{:.3}", m.roll, -m.pitch)),
        nmea(format!("PIXSE,HEAVE_,0.1,0.2,{:.3}", -m.heave_down)),
        nmea(format!(
            "PIXSE,POSITI,{:.8},{:.8},{:.3}",
            m.latitude,
            m.longitude.rem_euclid(360.0),
            m.height
        )),
    ]
    .concat()
}
fn avr(m: &Motion) -> Vec<u8> {
    nmea(format!(
        "PTNL,AVR,{},{:+.4},Yaw,{:+.4},Tilt,{:+.4},Roll,12.575,3,1.4,16",
        clock(m.t),
        m.heading,
        m.pitch,
        m.roll
    ))
}
fn ptnthpr(m: &Motion) -> Vec<u8> {
    nmea(format!(
        "PTNTHPR,{:.1},N,{:.1},N,{:.1},N",
        m.heading, m.pitch, m.roll
    ))
}
fn psat(m: &Motion) -> Vec<u8> {
    nmea(format!(
        "PSAT,HPR,{},{:.3},{:.3},{:.3},N",
        clock(m.t),
        m.heading,
        m.pitch,
        m.roll
    ))
}
/// Heading in -180 to 180 degrees.
fn signed_heading(m: &Motion) -> f64 {
    (m.heading + 180.0).rem_euclid(360.0) - 180.0
}
fn vnymr(m: &Motion) -> Vec<u8> {
    let yaw = signed_heading(m);
    nmea(format!(
        "VNYMR,{yaw:+08.3},{:+08.3},{:+08.3},+1,+2,+3,+0,+0,-9.8,0,0,0",
        m.pitch, m.roll
    ))
}
fn vnins(m: &Motion) -> Vec<u8> {
    let yaw = signed_heading(m);
    nmea(format!(
        "VNINS,{:.6},1803,0002,{yaw:+08.3},{:+08.3},{:+08.3},{:+012.8},{:+013.8},{:+010.3},{:+08.3},{:+08.3},+000.000,01.0,0.5,0.02",
        432_016.0 + m.t,
        m.pitch,
        m.roll,
        m.latitude,
        m.longitude,
        m.height,
        m.north_m_s,
        m.east_m_s
    ))
}
fn psbgb(m: &Motion) -> Vec<u8> {
    nmea(format!(
        "PSBGB,1,{},1,{:.3},{:.3},{:.3},0.1,0.1,0.1,1,1,{:.3},0.05,1,0.7,0,0,1,4,0.1,0.1,1,",
        clock(m.t),
        m.roll,
        m.pitch,
        m.heading,
        m.heave_down
    ))
}

fn hundredths(value: f64) -> i16 {
    (value * 100.0).round() as i16
}
fn tss1(m: &Motion) -> Vec<u8> {
    let signed = |v: f64| {
        format!(
            "{}{:04}",
            letter(v, ' ', '-'),
            (v * 100.0).abs().round() as u32
        )
    };
    let (heave, roll, pitch) = (signed(-m.heave_down), signed(m.roll), signed(m.pitch));
    format!(":1AFFEE {heave}H{roll} {pitch}\r\n").into_bytes()
}
fn em(status: u8, m: &Motion) -> Vec<u8> {
    let mut b = vec![status, 0x90];
    for v in [m.roll, m.pitch, -m.heave_down] {
        b.extend(hundredths(v).to_le_bytes());
    }
    let heading = (m.heading * 100.0).round() as u32 % 36_000;
    b.extend((heading as u16).to_le_bytes());
    b
}
fn em1000(m: &Motion) -> Vec<u8> {
    em(0x00, m)
}
fn em3000(m: &Motion) -> Vec<u8> {
    em(0x90, m)
}
fn seapath_26(m: &Motion) -> Vec<u8> {
    let mut b = vec![0xAA, 0x55];
    let second = m.t.floor();
    b.extend((DAY_S as i32 + second as i32).to_be_bytes());
    b.extend((((m.t - second) * 1e4).round() as u16).to_be_bytes());
    for degrees in [m.latitude, m.longitude] {
        b.extend(((degrees / 90.0 * f64::from(1 << 30)).round() as i32).to_be_bytes());
    }
    b.extend(((m.height * 100.0).round() as i32).to_be_bytes());
    for v in [m.heave_down, m.north_m_s, m.east_m_s, 0.0] {
        b.extend(hundredths(v).to_be_bytes());
    }
    for degrees in [m.roll, m.pitch, m.heading] {
        let raw = (degrees / 90.0 * 16_384.0).round() as i32;
        b.extend((raw as u16).to_be_bytes());
    }
    b.extend([0; 16]);
    let crc = seapath_crc(&b[2..]);
    b.extend(crc.to_be_bytes());
    b
}
fn kmb(m: &Motion) -> Vec<u8> {
    let mut b = b"#KMB".to_vec();
    b.extend(132_u16.to_le_bytes());
    b.extend(1_u16.to_le_bytes());
    let ns = (m.t * 1e9).round() as i64;
    b.extend(((DAY_S + ns / NS_PER_S) as u32).to_le_bytes());
    b.extend(((ns % NS_PER_S) as u32).to_le_bytes());
    b.extend(0_u32.to_le_bytes());
    b.extend(m.latitude.to_le_bytes());
    b.extend(m.longitude.to_le_bytes());
    let floats = [m.height, m.roll, m.pitch, m.heading, m.heave_down];
    let speeds = [0.0, 0.0, 0.0, m.north_m_s, m.east_m_s, 0.0];
    for v in floats.into_iter().chain(speeds) {
        b.extend((v as f32).to_le_bytes());
    }
    b.resize(132, 0);
    b
}

fn x25(bytes: &[u8]) -> u16 {
    // Bitwise computation on the reflected message polynomial; the library uses a table.
    let mut crc: u16 = 0xFFFF;
    for byte in bytes {
        let tmp = byte ^ (crc as u8);
        let tmp = tmp ^ (tmp << 4);
        let wide = u16::from(tmp);
        crc = (crc >> 8) ^ (wide << 8) ^ (wide << 3) ^ (wide >> 4);
    }
    crc
}
fn mavlink(m: &Motion, version: u8, id: u8, extra: u8, payload: &[u8]) -> Vec<u8> {
    let us = ((DAY_S as f64 + m.t + LATENCY_S) * 1e6).round() as u64;
    let mut frame = if version == 1 {
        vec![payload.len() as u8, 0, 1, 1, id]
    } else {
        vec![payload.len() as u8, 0, 0, 0, 1, 1, id, 0, 0]
    };
    frame.extend(payload);
    let crc = x25(&[&frame[..], &[extra]].concat());
    let mark = if version == 1 { 0xFE } else { 0xFD };
    [&us.to_be_bytes()[..], &[mark], &frame, &crc.to_le_bytes()].concat()
}
fn tlog(m: &Motion, version: u8) -> Vec<u8> {
    let boot_ms = ((m.t + 1000.0) * 1000.0).round() as u32;
    let unix_us = ((DAY_S as f64 + m.t) * 1e6).round() as u64;
    let time = [&unix_us.to_le_bytes()[..], &boot_ms.to_le_bytes()].concat();
    let mut attitude = boot_ms.to_le_bytes().to_vec();
    for degrees in [m.roll, m.pitch, m.heading, 0.0, 0.0, 0.0] {
        attitude.extend((degrees.to_radians() as f32).to_le_bytes());
    }
    let mut position = boot_ms.to_le_bytes().to_vec();
    for v in [m.latitude * 1e7, m.longitude * 1e7, m.height * 1000.0, 0.0] {
        position.extend((v.round() as i32).to_le_bytes());
    }
    for v in [m.north_m_s, m.east_m_s, 0.0] {
        position.extend(hundredths(v).to_le_bytes());
    }
    position.extend(((m.heading * 100.0) as u16).to_le_bytes());
    [
        mavlink(m, version, 2, 137, &time),
        mavlink(m, version, 30, 39, &attitude),
        mavlink(m, version, 33, 104, &position),
    ]
    .concat()
}

/// Half a resolution step of a format: (roll and pitch deg, heading deg, heave m, latitude and longitude deg, height m).
type Steps = (f64, f64, f64, f64, f64);

/// A format under test, with the quantities that its decoder must return.
struct Format {
    name: &'static str,
    format: NavFormat,
    encode: fn(&Motion) -> Vec<u8>,
    steps: Steps,
    channels: &'static [NavChannel],
    /// True if the message has its own time.
    timed: bool,
}

fn formats() -> Vec<Format> {
    use NavChannel::{CourseSpeed, Heading, Heave, Position, RollPitch};
    const MINUTE_STEP: f64 = 0.5e-6 / 60.0;
    let place = |height: f64| (0.0, 0.0, 0.0, MINUTE_STEP, height);
    let angles = |step: f64| (step, step, 0.0, 0.0, 0.0);
    let all = |step: f64, heave: f64| (step, step, heave, 0.0, 0.0);
    const HPRH: &[NavChannel] = &[Heading, RollPitch, Heave];
    const HPR: &[NavChannel] = &[Heading, RollPitch];
    let binary = |name, format, encode, channels, steps, timed| Format {
        name,
        format,
        encode,
        steps,
        channels,
        timed,
    };
    let f = |name, encode, channels, steps, timed| {
        binary(name, NavFormat::Nmea, encode, channels, steps, timed)
    };
    let angle_16 = 45.0 / 16_384.0;
    let step_32 = 45.0 / f64::from(1 << 30);
    vec![
        f("GGA", gga, &[Position], place(0.005), true),
        f("RMC", rmc, &[Position, CourseSpeed], place(1e9), true),
        f("GLL", gll, &[Position], place(1e9), true),
        f("GGK", ggk, &[Position], place(0.0005), true),
        f("HDT", hdt, &[Heading], angles(0.005), false),
        f("THS", ths, &[Heading], angles(0.005), false),
        f("HDG", hdg, &[Heading], angles(0.005), false),
        f("PASHR", pashr, HPRH, all(0.005, 0.005), true),
        f(
            "PASHR heave up",
            pashr_heave_up,
            HPRH,
            all(0.005, 0.005),
            true,
        ),
        f("PASHR,ATT", pashr_att, HPR, angles(0.0005), true),
        f("PASHR,HPR", pashr_hpr, HPR, angles(0.0005), true),
        f(
            "PASHR,POS",
            pashr_pos,
            &[Position, CourseSpeed],
            place(0.005),
            true,
        ),
        f("PSXN,23", psxn_23, HPRH, all(0.005, 0.005), false),
        f("PRDID", prdid, HPR, angles(0.005), false),
        f("PHTRO", phtro, &[RollPitch], angles(0.005), false),
        f("PHLIN", phlin, &[Heave], all(0.0, 0.0005), false),
        f("PHOCT", phoct, HPRH, all(0.0005, 0.0005), true),
        f(
            "PIXSE",
            pixse,
            &[RollPitch, Heave, Position],
            (0.0005, 0.0, 0.0005, 0.5e-8, 0.0005),
            false,
        ),
        f("AVR", avr, HPR, angles(0.00005), true),
        f("PTNTHPR", ptnthpr, HPR, angles(0.05), false),
        f("PSAT,HPR", psat, HPR, angles(0.0005), true),
        f("VNYMR", vnymr, HPR, angles(0.0005), false),
        f(
            "VNINS",
            vnins,
            &[Heading, RollPitch, Position, CourseSpeed],
            (0.0005, 0.0005, 0.0, 0.5e-8, 0.0005),
            true,
        ),
        f("PSBGB", psbgb, HPRH, all(0.0005, 0.0005), true),
        binary(
            "TSS1",
            NavFormat::Tss1,
            tss1,
            &[RollPitch, Heave],
            all(0.005, 0.005),
            false,
        ),
        binary(
            "EM1000",
            NavFormat::Em3000,
            em1000,
            HPRH,
            all(0.005, 0.005),
            false,
        ),
        binary(
            "EM3000",
            NavFormat::Em3000,
            em3000,
            HPRH,
            all(0.005, 0.005),
            false,
        ),
        binary(
            "Seapath 26",
            NavFormat::Seapath26,
            seapath_26,
            &ALL,
            (angle_16, angle_16, 0.005, step_32, 0.005),
            true,
        ),
        binary(
            "#KMB",
            NavFormat::Kmb,
            kmb,
            &ALL,
            // Resolution of f32 near 359 degrees.
            (1e-6, 2e-5, 2e-7, 1e-13, 2e-7),
            true,
        ),
    ]
}

/// Compares one sample with the motion at its time of validity.
fn check(name: &str, sample: &NavSample, steps: &Steps) {
    let t = sample.valid_utc.seconds_since(UtcNs(DAY_S * NS_PER_S));
    let want = motion(t);
    let near = |what: &str, got: f64, want: f64, step: f64| {
        // Half steps are exact bounds. A millionth more allows for rounding.
        let error = (got - want).abs();
        assert!(
            error <= step * (1.0 + 1e-6) + 1e-9,
            "{name} {what} at {t}: got {got} want {want}, error {error} > {step}"
        );
    };
    match sample.quantity {
        NavQuantity::RollPitch {
            roll_rad,
            pitch_rad,
        } => {
            near("roll", roll_rad.to_degrees(), want.roll, steps.0);
            near("pitch", pitch_rad.to_degrees(), want.pitch, steps.0);
        }
        NavQuantity::Heading { heading_rad } => {
            let got = heading_rad.to_degrees();
            let off = (got - want.heading + 180.0).rem_euclid(360.0) - 180.0;
            near("heading", off, 0.0, steps.1);
        }
        NavQuantity::Heave { heave_down_m } => {
            near("heave", heave_down_m, want.heave_down, steps.2);
        }
        NavQuantity::Position {
            latitude_rad,
            longitude_rad,
            height_m,
            ..
        } => {
            near(
                "latitude",
                latitude_rad.to_degrees(),
                want.latitude,
                steps.3,
            );
            near(
                "longitude",
                longitude_rad.to_degrees(),
                want.longitude,
                steps.3,
            );
            if let Some(height_m) = height_m {
                // The crate reads the height of GGA as f32.
                near("height", height_m, want.height, steps.4 + 3e-7);
            }
        }
        NavQuantity::CourseSpeed {
            course_rad,
            speed_m_per_s,
        } => {
            let (sin, cos) = course_rad.sin_cos();
            near("north speed", speed_m_per_s * cos, want.north_m_s, 1.5e-3);
            near("east speed", speed_m_per_s * sin, want.east_m_s, 1.5e-3);
        }
        NavQuantity::LocalPosition { .. } | NavQuantity::Depth { .. } => {
            panic!("{name}: {:?}", sample.quantity)
        }
    }
}

#[test]
fn a_known_motion_comes_back_within_half_a_step_of_every_format() {
    for f in formats() {
        let dialect = NavDialect {
            format: f.format,
            pashr_heave_up: f.name.ends_with("heave up"),
            ..NavDialect::default()
        };
        let time = match f.timed {
            true => TimePolicy::Message,
            false => TimePolicy::Arrival {
                latency_s: LATENCY_S,
            },
        };
        let mut decoder = NavDecoder::new(0, &source(dialect, time));
        let mut samples = Vec::new();
        // EM3000 records are accepted in threes, so two more records than compared are needed.
        for i in 0..602 {
            let t = f64::from(i) * 0.1;
            let arrival = UtcNs(DAY_S * NS_PER_S).plus_s(t + LATENCY_S);
            decoder.push(&(f.encode)(&motion(t)), arrival, &mut samples);
        }
        let counters = *decoder.counters();
        assert_eq!(
            (
                counters.malformed,
                counters.bad_checksum,
                counters.time_jumps,
                counters.undated
            ),
            (0, 0, 0, 0),
            "{}: {counters:?}",
            f.name
        );
        let mut turns = 0;
        for channel in ALL {
            let of: Vec<&NavSample> = samples
                .iter()
                .filter(|s| NavChannel::of(&s.quantity) == channel)
                .collect();
            let wanted = f.channels.contains(&channel);
            assert_eq!(
                of.len() >= 600,
                wanted,
                "{} {channel:?}: {}",
                f.name,
                of.len()
            );
            for s in &of {
                check(f.name, s, &f.steps);
            }
            turns += of
                .windows(2)
                .filter(|w| match (w[0].quantity, w[1].quantity) {
                    (
                        NavQuantity::Heading { heading_rad: a },
                        NavQuantity::Heading { heading_rad: b },
                    ) => (a - b).abs() > 6.0,
                    _ => false,
                })
                .count();
        }
        let has_heading = f.channels.contains(&NavChannel::Heading);
        assert_eq!(
            turns >= 3,
            has_heading,
            "{}: passes north {turns} times",
            f.name
        );
    }
}

#[test]
fn a_tlog_of_either_version_gives_the_motion_at_the_vehicle_s_own_time() {
    for version in [1, 2] {
        let mut bytes = Vec::new();
        for i in 0..100 {
            bytes.extend(tlog(&motion(f64::from(i) * 0.05), version));
            if i == 50 {
                bytes.extend(b"truncated");
            }
        }
        let spec = source(NavDialect::default(), TimePolicy::Message);
        let (samples, counters, log) = read_log(&bytes, 0, &spec, 1.0);
        assert_eq!(log.kind, LogKind::Tlog);
        assert_eq!(
            (log.lines, counters.used, counters.resync_bytes),
            (300, 300, 9)
        );
        // Four quantities: position, course, heading and attitude. f32 radians have a relative error of 1e-7.
        assert_eq!(samples.len(), 400);
        for s in &samples {
            check("tlog", s, &(2e-5, 2e-5, 0.0, 0.5e-7, 0.0005));
            let late = s.arrival_utc.seconds_since(s.valid_utc);
            assert!((late - LATENCY_S).abs() < 1e-3, "{late}");
        }
        // A corrupted byte in a known message is detected.
        let at = bytes.len() - 10;
        bytes[at] ^= 0x10;
        let (_, spoiled, _) = read_log(&bytes, 0, &spec, 1.0);
        assert_eq!((spoiled.refused_checksum, spoiled.bad_checksum), (1, 1));
    }
}

// ---------------------------------------------------------------- signs, by hand

/// Sentences from manuals and logs, with the motion of the platform that they describe.
#[test]
fn the_sign_table() {
    // (name, format, bytes without checksum, roll, pitch, heave down)
    type Row = (&'static str, NavFormat, &'static str, [Option<f64>; 3]);
    let n = NavFormat::Nmea;
    let rows: [Row; 12] = [
        (
            "PASHR: roll first, heave down",
            n,
            "PASHR,123816.80,312.95,T,-000.83,-000.42,-000.01,0.234,0.224,0.298,1,0",
            [Some(-0.83), Some(-0.42), Some(-0.01)],
        ),
        (
            "PASHR,ATT: pitch first",
            n,
            "PASHR,ATT,432017.0,218.0,1.00,2.00,0.001,0.001,0",
            [Some(2.0), Some(1.0), None],
        ),
        (
            "PASHR,HPR: pitch first",
            n,
            "PASHR,HPR,000001.00,218.0,1.00,2.00,0.001,0.001,0,1,1,1",
            [Some(2.0), Some(1.0), None],
        ),
        (
            "PSXN,23: heave down",
            n,
            "PSXN,23,0.35,-1.74,218.26,0.58",
            [Some(0.35), Some(-1.74), Some(0.58)],
        ),
        (
            "PRDID: pitch first",
            n,
            "PRDID,-012.39,+002.14,066.91",
            [Some(2.14), Some(-12.39), None],
        ),
        (
            "PHTRO: P bow down, T port up",
            n,
            "PHTRO,0.03,P,0.22,T",
            [Some(0.22), Some(-0.03), None],
        ),
        (
            "PHTRO: M bow up, B port down",
            n,
            "PHTRO,0.03,M,0.22,B",
            [Some(-0.22), Some(0.03), None],
        ),
        (
            "PHOCT: pitch bow down, heave up",
            n,
            "PHOCT,01,000201.000,T,00,356.592,T,+000.225,T,+00.039,T,+00.023,T,+00.023,+00.016,+00.003,+00.002,-00.001,+00.000,+0001.96",
            [Some(0.225), Some(-0.039), Some(-0.023)],
        ),
        (
            "PHLIN: heave up",
            n,
            "PHLIN,0.03,0.22,-0.15",
            [None, None, Some(0.15)],
        ),
        (
            "PTNTHPR: pitch first",
            n,
            "PTNTHPR,35.2,N,-58.1,N,-14.1,N",
            [Some(-14.1), Some(-58.1), None],
        ),
        (
            "PIXSE,ATITUD: roll first, pitch bow down",
            n,
            "PIXSE,ATITUD,-1.641,-0.490",
            [Some(-1.641), Some(0.49), None],
        ),
        (
            "TSS1: heave up",
            NavFormat::Tss1,
            ":1A4770 -0016H 0429 -0680\r\n",
            [Some(4.29), Some(-6.80), Some(0.16)],
        ),
    ];
    for (name, format, text, want) in rows {
        for back in [false, true] {
            let dialect = NavDialect {
                format,
                reversed: Reversed {
                    roll: back,
                    pitch: back,
                    heave: back,
                },
                ..NavDialect::default()
            };
            let mut decoder = NavDecoder::new(0, &source(dialect, TimePolicy::Message));
            let bytes = match format {
                NavFormat::Nmea => nmea(text.to_string()),
                _ => text.as_bytes().to_vec(),
            };
            let mut samples = Vec::new();
            decoder.push(&bytes, UtcNs(DAY_S * NS_PER_S), &mut samples);
            let mut got = [None; 3];
            for s in &samples {
                match s.quantity {
                    NavQuantity::RollPitch {
                        roll_rad,
                        pitch_rad,
                    } => {
                        got[0] = Some(roll_rad.to_degrees());
                        got[1] = Some(pitch_rad.to_degrees());
                    }
                    NavQuantity::Heave { heave_down_m } => got[2] = Some(heave_down_m),
                    _ => {}
                }
            }
            let sign = if back { -1.0 } else { 1.0 };
            for (g, w) in got.into_iter().zip(want) {
                let same = match (g, w) {
                    (Some(g), Some(w)) => (g - w * sign).abs() < 1e-9,
                    (None, None) => true,
                    _ => false,
                };
                assert!(same, "{name}, reversed {back}: got {got:?} want {want:?}");
            }
        }
    }
}

#[test]
fn values_that_psxn_20_flags_invalid_are_not_used() {
    let mut decoder = NavDecoder::new(
        0,
        &source(
            NavDialect::default(),
            TimePolicy::Arrival { latency_s: 0.0 },
        ),
    );
    let mut taken = Vec::new();
    for (quality, want) in [
        ("0,0,0,0", 3),
        ("1,1,1,1", 3),
        ("0,0,2,0", 2),
        ("0,0,0,2", 2),
        ("2,0,0,0", 3),
    ] {
        taken.clear();
        decoder.push(
            &nmea(format!("PSXN,20,{quality}")),
            UtcNs(DAY_S * NS_PER_S),
            &mut taken,
        );
        decoder.push(&psxn_23(&motion(1.0)), UtcNs(DAY_S * NS_PER_S), &mut taken);
        assert_eq!(taken.len(), want, "{quality}");
    }
    assert_eq!(decoder.counters().flagged_invalid, 2);
}

// ---------------------------------------------------------------- policies

#[test]
fn checksums_are_ignored_for_the_sentences_named_and_for_no_others() {
    let lines =
        b"$PTNTHPR,35.2,N,-58.1,N,-14.1,N*00\r\n$HEHDT,218.19,T*00\r\n$PRDID,1.0,2.0,3.0\r\n";
    let take = |names: &[&str]| {
        let dialect = NavDialect {
            ignore_checksum_for: names.iter().map(|n| n.to_string()).collect(),
            ..NavDialect::default()
        };
        let mut decoder = NavDecoder::new(0, &source(dialect, TimePolicy::Message));
        decoder.push(lines, UtcNs(0), &mut Vec::new());
        let c = *decoder.counters();
        assert_eq!((c.sentences, c.bad_checksum, c.missing_checksum), (3, 2, 1));
        c.refused_checksum
    };
    assert_eq!(take(&[]), 3);
    assert_eq!(take(&["PTNTHPR"]), 2);
    assert_eq!(take(&["PTNTHPR", "HDT"]), 1);
    assert_eq!(take(&["PTNTHPR", "HDT", "PRDID"]), 0);
}

#[test]
fn two_talkers_of_the_same_quantity_are_not_mixed() {
    let mut decoder = NavDecoder::new(
        0,
        &source(
            NavDialect::default(),
            TimePolicy::Arrival { latency_s: 0.0 },
        ),
    );
    let mut samples = Vec::new();
    for i in 0..20 {
        let at = UtcNs(DAY_S * NS_PER_S).plus_s(f64::from(i));
        // The first talker stops permanently after ten seconds.
        if i < 10 {
            decoder.push(&nmea("HEHDT,10.0,T".into()), at, &mut samples);
        }
        decoder.push(&nmea("GPHDT,20.0,T".into()), at.plus_s(0.1), &mut samples);
    }
    let headings: Vec<i64> = samples
        .iter()
        .map(|s| match s.quantity {
            NavQuantity::Heading { heading_rad } => heading_rad.to_degrees().round() as i64,
            _ => panic!("a heading"),
        })
        .collect();
    let want: Vec<i64> = [vec![10; 10], vec![20; 6]].concat();
    assert_eq!(
        headings, want,
        "the second speaks when the first has been silent for 5 s"
    );
}

/// Attitude at 8 Hz between fixes at 1 Hz, without a pause. The time of a fix is up to a second old and is not the time of the
/// attitude.
#[test]
fn a_sentence_repeated_in_a_burst_is_valid_at_its_arrival() {
    let mut decoder = NavDecoder::new(0, &source(NavDialect::default(), TimePolicy::Burst));
    let mut samples = Vec::new();
    for i in 0..80 {
        let t = f64::from(i) / 8.0;
        let at = UtcNs(DAY_S * NS_PER_S).plus_s(t);
        if i % 8 == 0 {
            decoder.push(&gga(&motion(t)), at, &mut samples);
        }
        decoder.push(&ptnthpr(&motion(t)), at.plus_s(0.01), &mut samples);
    }
    let attitude = samples
        .iter()
        .filter(|s| NavChannel::of(&s.quantity) == NavChannel::RollPitch);
    let borrowed = attitude.filter(|s| s.valid_utc != s.arrival_utc).count();
    assert_eq!(borrowed, 1, "only the very first, before it was known");
    assert_eq!(decoder.counters().undated, 79);
}

#[test]
fn paced_bytes_give_every_sentence_the_arrival_of_its_own_first_byte() {
    // Byte time at 4800 Bd with 10 bits per byte.
    let byte_ns = NS_PER_S * 10 / 4800;
    for f in formats().iter().filter(|f| !f.timed) {
        let dialect = NavDialect {
            format: f.format,
            ..NavDialect::default()
        };
        let spec = source(dialect, TimePolicy::Arrival { latency_s: 0.0 });
        let one = (f.encode)(&motion(0.0)).len();
        let sentences = (f.encode)(&motion(0.0))
            .iter()
            .filter(|b| **b == b'$')
            .count();
        if sentences > 1 {
            continue;
        }
        let bytes: Vec<u8> = (0..5).flat_map(|_| (f.encode)(&motion(0.0))).collect();
        let mut samples = Vec::new();
        let mut decoder = NavDecoder::new(0, &spec);
        let quiet = &mut |_: &echotank_nav::decoder::SentenceEvent| {};
        decoder.push_paced(&bytes, UtcNs(0), byte_ns, &mut samples, quiet);
        let mut arrivals: Vec<i64> = samples.iter().map(|s| s.arrival_utc.0).collect();
        arrivals.dedup();
        let want: Vec<i64> = (0..5).map(|i| i * one as i64 * byte_ns).collect();
        assert_eq!(arrivals, want, "{}", f.name);
    }
}

// ---------------------------------------------------------------- any bytes

fn digest(format: NavFormat, bytes: &[u8], cuts: &[usize]) -> (Vec<NavSample>, NavCounters) {
    let dialect = NavDialect {
        format,
        ..NavDialect::default()
    };
    let mut spec = source(dialect, TimePolicy::Burst);
    spec.checksum = ChecksumPolicy::Ignore;
    let mut decoder = NavDecoder::new(0, &spec);
    let mut out = Vec::new();
    let mut rest = bytes;
    for cut in cuts.iter().cycle() {
        if rest.is_empty() {
            break;
        }
        let (piece, after) = rest.split_at((*cut).clamp(1, rest.len()));
        decoder.push(piece, UtcNs(DAY_S * NS_PER_S), &mut out);
        rest = after;
    }
    decoder.flush(&mut out);
    (out, *decoder.counters())
}

/// Records of all formats, some corrupted, with noise between.
fn stream() -> impl Strategy<Value = Vec<u8>> {
    let piece = (
        0..formats().len(),
        0.0..1000.0_f64,
        any::<u16>(),
        0u8..4,
        any::<u8>(),
    );
    let record = piece.prop_map(|(i, t, at, how, byte)| {
        let mut b = (formats()[i].encode)(&motion(t));
        let at = usize::from(at) % b.len();
        match how {
            0 => b[at] ^= byte,
            1 => b.truncate(at),
            2 => b.insert(at, byte),
            _ => {}
        }
        b
    });
    prop::collection::vec(record, 1..12).prop_map(|v| v.concat())
}

const FORMATS: [NavFormat; 5] = [
    NavFormat::Nmea,
    NavFormat::Tss1,
    NavFormat::Em3000,
    NavFormat::Seapath26,
    NavFormat::Kmb,
];

fn sentence_body() -> impl Strategy<Value = String> {
    // Sentences that both decoders support, some with a corrupted field.
    let list: [fn(&Motion) -> Vec<u8>; 4] = [gga, rmc, hdt, gll];
    let spoil = (any::<u8>(), "[0-9.,A-Z-]{0,8}");
    (0..list.len() + 2, 0.0..86_000.0_f64, spoil, 0u8..3).prop_map(
        move |(i, t, (at, text), how)| {
            let bytes = match i {
                4 => nmea(format!("GPZDA,{},01,08,2014,00,00", clock(t))),
                5 => nmea(format!(
                    "GPVTG,{:.1},T,,M,{:.1},N,,K,A",
                    t % 360.0,
                    t % 20.0
                )),
                i => (list[i])(&motion(t)),
            };
            let text_of = String::from_utf8(bytes).expect("ASCII");
            let body = text_of[1..text_of.len() - 5].to_string();
            if how > 0 {
                return body;
            }
            let mut fields: Vec<&str> = body.split(',').collect();
            let at = 1 + usize::from(at) % (fields.len() - 1);
            fields[at] = &text;
            fields.join(",")
        },
    )
}

proptest! {
    #[test]
    fn any_stream_of_any_format_is_read_the_same_in_any_pieces(bytes in stream(), cuts in prop::collection::vec(1usize..60, 1..20)) {
        for format in FORMATS {
            let whole = digest(format, &bytes, &[usize::MAX]);
            let pieces = digest(format, &bytes, &cuts);
            prop_assert_eq!(&whole, &pieces, "{:?}", format);
            let c = whole.1;
            prop_assert_eq!(sum_of_classes(&c), c.sentences);
            prop_assert!(c.resync_bytes <= c.bytes);
        }
    }

    #[test]
    fn random_bytes_never_panic_in_any_format_or_container(mut bytes in prop::collection::vec(any::<u8>(), 0..1500), head in 0usize..6, cut in 1usize..200) {
        let heads: [&[u8]; 6] = [&[], &[0xD4, 0xC3, 0xB2, 0xA1], &[0xA1, 0xB2, 0x3C, 0x4D], &[0x0A, 0x0D, 0x0D, 0x0A, 0, 0, 0, 28, 0x1A, 0x2B, 0x3C, 0x4D], b"#KMB\x84\0\x01\0", b"\xAA\x55"];
        bytes.splice(0..0, heads[head].iter().copied());
        for format in FORMATS {
            digest(format, &bytes, &[cut]);
            let dialect = NavDialect { format, ..NavDialect::default() };
            read_log(&bytes, 0, &source(dialect, TimePolicy::Burst), 1.0);
        }
    }

    #[test]
    fn a_corrupted_tlog_never_panics(version in 1u8..3, at in any::<u16>(), byte in any::<u8>(), n in 4usize..20) {
        let mut bytes: Vec<u8> = (0..n).flat_map(|i| tlog(&motion(i as f64), version)).collect();
        let at = usize::from(at) % bytes.len();
        bytes[at] = byte;
        let spec = source(NavDialect::default(), TimePolicy::Message);
        let (_, c, _) = read_log(&bytes, 0, &spec, 1.0);
        prop_assert!(c.resync_bytes <= c.bytes);
    }

    #[test]
    fn the_nmea_crate_and_our_decoders_agree_where_both_accept(body in sentence_body()) {
        let ours = decode(&body, &NavDialect::default(), &mut String::new());
        let text = format!("${body}*{:02X}", checksum_of(&body));
        if let (Ok(ours), Ok(theirs)) = (ours, nmea::parse_str(&text)) {
            let close = |a: f64, b: f64, tolerance: f64| (a - b).abs() <= tolerance * a.abs().max(1.0);
            let (time, position_deg, height_m) = match theirs {
                nmea::ParseResult::GGA(d) => (d.fix_time, d.latitude.zip(d.longitude), d.altitude),
                nmea::ParseResult::RMC(d) => (d.fix_time, d.lat.zip(d.lon), None),
                nmea::ParseResult::ZDA(d) => (d.utc_time, None, None),
                _ => return Ok(()),
            };
            if let (Some(ns), Some(time)) = (ours.time_of_day_ns(), time) {
                let midnight = chrono::NaiveTime::MIN;
                let theirs_ns = (time - midnight).num_nanoseconds().expect("a day");
                prop_assert!((ns - theirs_ns).abs() <= 1, "{:?} {:?}", ours, time);
            }
            // The crate takes three digits of degrees even if the longitude has fewer.
            let digits = |i: usize| body.split(',').nth(i).and_then(|t| t.find('.'));
            let first = if body.contains("GGA") { 2 } else { 3 };
            let padded = digits(first) == Some(4) && digits(first + 2) == Some(5);
            if let (Some((lat, lon)), Some((lat_deg, lon_deg)), true) = (ours.position_rad, position_deg, padded) {
                prop_assert!(close(lat, lat_deg.to_radians(), 1e-15), "{:?} {}", ours, lat_deg);
                prop_assert!(close(lon, lon_deg.to_radians(), 1e-15), "{:?} {}", ours, lon_deg);
            }
            // Heights of the crate are f32.
            if let (Some(ours_m), Some(theirs_m)) = (ours.height_m, height_m) {
                prop_assert!(close(ours_m, f64::from(theirs_m), 1e-6), "{:?} {}", ours, theirs_m);
            }
        }
    }
}

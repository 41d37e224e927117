//! Values of one message of any format, in SI units and the sign convention of this crate, and the range checks of all decoders.

use chrono::{NaiveDate, NaiveTime};

use echotank_core::navigation::FixQuality;
use echotank_core::time::{NS_PER_S, UtcNs};

const KNOT_M_PER_S: f64 = 1852.0 / 3600.0;
/// Maximum accepted heave, metres: the largest that a format can express. The tallest ocean wave recorded is 30 m.
const MAX_HEAVE_M: f64 = 99.99;
/// Maximum accepted height, metres.
const MAX_HEIGHT_M: f64 = 100_000.0;
/// Maximum accepted depth, metres.
const MAX_DEPTH_M: f64 = 12_000.0;
/// Maximum accepted speed over ground, metres per second.
const MAX_SPEED_M_PER_S: f64 = 1000.0;

/// Type of a message. Variants are named after the sentence or record.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Kind {
    /// GGA: position, height and fix quality.
    Gga,
    /// RMC: position, course, speed and date.
    Rmc,
    /// GLL: position.
    Gll,
    /// VTG: course and speed over ground.
    Vtg,
    /// ZDA: time and date.
    Zda,
    /// HDT: true heading.
    Hdt,
    /// THS: true heading with a mode.
    Ths,
    /// HDG and HDM: magnetic heading.
    Magnetic,
    /// DBT, DBS, DBK and DPT: water depth.
    Depth,
    /// Depth of the platform: PIPS; PIXSE,DEPIN_; and [`Self::Depth`] sentences if so configured.
    OwnDepth,
    /// Known message without values for the motion: GST, ROT, PSXN 10, 22 and 24, PHINF, speeds of PIXSE.
    Information,
    /// PASHR of SBG, OxTS and WASSP: heading, roll, pitch and heave.
    Pashr,
    /// PASHR,ATT, AT2 and HPR of Ashtech: heading, pitch and roll.
    PashrAshtech,
    /// PASHR,POS: position, course and speed.
    PashrPos,
    /// PSXN,20: quality of the other sentences of the burst.
    Psxn20,
    /// PSXN,23: roll, pitch, heading and heave.
    Psxn23,
    /// PRDID: pitch, roll and heading.
    Prdid,
    /// PHTRO: pitch and roll.
    Phtro,
    /// PHLIN: heave.
    Phlin,
    /// PHOCT: attitude and heave.
    Phoct,
    /// PIXSE,ATITUD: roll and pitch.
    PixseAttitude,
    /// PIXSE,POSITI: position and height.
    PixsePosition,
    /// PIXSE,HEAVE_: heave.
    PixseHeave,
    /// PTNL,AVR: antenna-pair attitude.
    Avr,
    /// PTNL,GGK: position with date.
    Ggk,
    /// PTNTHPR: heading, pitch and roll.
    Ptnthpr,
    /// PSAT,HPR: heading, pitch and roll.
    Psat,
    /// VNYMR: heading, pitch and roll.
    Vnymr,
    /// VNINS: full inertial solution.
    Vnins,
    /// PSBGA and PSBGB: attitude, and heave in the latter.
    Psbg,
    /// TSS1 record: heave, roll and pitch.
    Tss1,
    /// EM1000 or EM3000 record: attitude and heave.
    Em3000,
    /// Seapath binary 26 record: full solution.
    Seapath26,
    /// #KMB record: full solution.
    Kmb,
    /// MAVLink ATTITUDE.
    MavAttitude,
    /// MAVLink GLOBAL_POSITION_INT.
    MavPosition,
    /// MAVLink GPS_RAW_INT.
    MavGps,
    /// MAVLink SYSTEM_TIME.
    MavTime,
}

impl Kind {
    /// Priority among messages of one source with the same quantity; the higher rank wins. A message with its own time ranks above
    /// one with a burst time, and a true heading above a magnetic one. GGA ranks above RMC because GGA has height and quality.
    pub fn rank(self) -> u8 {
        use Kind::*;
        match self {
            Gga | Ggk | Pashr | PashrAshtech | Phoct | PixsePosition | Avr | Psat | Vnins
            | Psbg | Em3000 | Seapath26 | Kmb | Tss1 | MavAttitude | MavPosition | OwnDepth => 3,
            Rmc | PashrPos | Psxn23 | Prdid | Phtro | Phlin | PixseAttitude | PixseHeave
            | Ptnthpr | Vnymr | MavGps => 2,
            Vtg | Hdt | Ths | Gll => 1,
            Magnetic | Zda | Depth | Information | Psxn20 | MavTime => 0,
        }
    }

    /// Whether the message is used for time or quality, although it gives no quantity.
    pub(crate) fn is_auxiliary(self) -> bool {
        matches!(self, Kind::Zda | Kind::Psxn20 | Kind::MavTime)
    }
}

/// Time of validity that a message states.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum StatedTime {
    /// UTC since midnight, nanoseconds. A leap second counts as the first second of the next day.
    TimeOfDay(i64),
    /// Time of day with a date.
    Dated {
        /// UTC midnight, nanoseconds since 1970.
        day_ns: i64,
        /// UTC since midnight, nanoseconds.
        time_of_day_ns: i64,
    },
    /// GPS time since the start of the week, nanoseconds.
    GpsOfWeek(i64),
    /// Full UTC instant.
    Instant(UtcNs),
}

/// Quantities that PSXN,20 flags as invalid.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct InvalidQuantities {
    /// Horizontal position.
    pub position: bool,
    /// Heading.
    pub heading: bool,
    /// Roll and pitch.
    pub roll_pitch: bool,
}

/// Values of one message. A field is `None` if the message does not have it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Reading {
    /// Type of the message.
    pub kind: Kind,
    /// Time of validity.
    pub when: Option<StatedTime>,
    /// Latitude (positive north) and longitude (positive east), radians. Present only with a valid fix.
    pub position_rad: Option<(f64, f64)>,
    /// Height, metres, above mean sea level. Above the ellipsoid for Seapath 26, KMB, GGK and VNINS.
    pub height_m: Option<f64>,
    /// Quality of the position.
    pub fix: FixQuality,
    /// Course over ground (radians) and speed (metres per second).
    pub course_speed: Option<(f64, f64)>,
    /// True heading, radians, clockwise from north.
    pub heading_rad: Option<f64>,
    /// Magnetic heading, radians, with deviation applied; its variation is unknown.
    pub(crate) magnetic_rad: Option<f64>,
    /// Roll (positive starboard down) and pitch (positive bow up), radians.
    pub(crate) roll_pitch_rad: Option<(f64, f64)>,
    /// Heave, metres, positive down.
    pub heave_down_m: Option<f64>,
    /// Water depth from an echo sounder, metres.
    pub(crate) water_depth_m: Option<f64>,
    /// Depth of the platform below the surface, metres.
    pub(crate) own_depth_m: Option<f64>,
    /// Flags of PSXN,20.
    pub invalid: Option<InvalidQuantities>,
    /// True if the message holds values, but none with a field in this type.
    pub has_other_values: bool,
}

impl Reading {
    /// Reading without values.
    pub fn new(kind: Kind) -> Self {
        Self {
            kind,
            when: None,
            position_rad: None,
            height_m: None,
            fix: FixQuality::None,
            course_speed: None,
            heading_rad: None,
            magnetic_rad: None,
            roll_pitch_rad: None,
            heave_down_m: None,
            water_depth_m: None,
            own_depth_m: None,
            invalid: None,
            has_other_values: false,
        }
    }

    /// Reading of a known message without a value that this type has a field for.
    pub fn information() -> Self {
        Self {
            has_other_values: true,
            ..Self::new(Kind::Information)
        }
    }

    /// Whether the message has no values: all fields empty, or no fix.
    pub fn is_empty(&self) -> bool {
        *self == Self::new(self.kind)
    }

    /// UTC since midnight, nanoseconds, if the message has it.
    pub fn time_of_day_ns(&self) -> Option<i64> {
        match self.when? {
            StatedTime::TimeOfDay(ns)
            | StatedTime::Dated {
                time_of_day_ns: ns, ..
            } => Some(ns),
            StatedTime::GpsOfWeek(_) | StatedTime::Instant(_) => None,
        }
    }

    /// UTC midnight of the date, nanoseconds since 1970, if the message has it.
    pub fn day_ns(&self) -> Option<i64> {
        match self.when? {
            StatedTime::Dated { day_ns, .. } => Some(day_ns),
            _ => None,
        }
    }

    /// The full UTC instant, if the message has time and date.
    pub fn instant(&self) -> Option<UtcNs> {
        match self.when? {
            StatedTime::Instant(utc) => Some(utc),
            StatedTime::Dated {
                day_ns,
                time_of_day_ns,
            } => Some(UtcNs(day_ns.saturating_add(time_of_day_ns))),
            StatedTime::TimeOfDay(_) | StatedTime::GpsOfWeek(_) => None,
        }
    }

    pub(super) fn set_time(&mut self, time_of_day_ns: Option<i64>, day_ns: Option<i64>) {
        self.when = time_of_day_ns.map(|time_of_day_ns| match day_ns {
            Some(day_ns) => StatedTime::Dated {
                day_ns,
                time_of_day_ns,
            },
            None => StatedTime::TimeOfDay(time_of_day_ns),
        });
    }

    /// Stores a position in degrees, unless there is no fix.
    pub(super) fn set_position(&mut self, position_deg: Option<(f64, f64)>) -> Checked {
        let position = position_deg.filter(|_| self.fix != FixQuality::None);
        let Some((latitude, longitude)) = position else {
            self.fix = FixQuality::None;
            self.height_m = None;
            return Ok(());
        };
        self.position_rad = Some((latitude.to_radians(), longitude.to_radians()));
        let valid = latitude.abs() <= 90.0
            && longitude.abs() <= 180.0
            && self.height_m.is_none_or(|h| h.abs() < MAX_HEIGHT_M);
        ensure(valid)
    }

    /// Stores course (degrees) and speed (knots).
    pub(super) fn set_course_knots(&mut self, course_speed: Option<(f64, f64)>) -> Checked {
        let Some((course, knots)) = course_speed else {
            return Ok(());
        };
        let speed = knots * KNOT_M_PER_S;
        self.course_speed = Some((wrapped(course), speed));
        ensure(is_valid_heading(course) && (0.0..MAX_SPEED_M_PER_S).contains(&speed))
    }

    /// Stores a velocity over ground, metres per second, as course and speed.
    pub(super) fn set_velocity(&mut self, north: f64, east: f64) -> Checked {
        let speed = north.hypot(east);
        self.course_speed = Some((wrapped(east.atan2(north).to_degrees()), speed));
        ensure(speed < MAX_SPEED_M_PER_S)
    }

    pub(super) fn set_heading(&mut self, heading_deg: Option<f64>) -> Checked {
        self.heading_rad = heading_deg.map(wrapped);
        ensure(heading_deg.is_none_or(is_valid_heading))
    }

    /// Stores roll and pitch in degrees if both are present.
    pub(super) fn set_roll_pitch(&mut self, roll: Option<f64>, pitch: Option<f64>) -> Checked {
        self.roll_pitch_rad = roll
            .zip(pitch)
            .map(|(roll, pitch)| (roll.to_radians(), pitch.to_radians()));
        ensure(roll.is_none_or(|r| r.abs() <= 180.0) && pitch.is_none_or(|p| p.abs() <= 90.0))
    }

    /// Stores the depth of the platform, metres. The depth of a sensor at the surface may be slightly negative.
    pub(super) fn set_own_depth(&mut self, depth_m: Option<f64>) -> Checked {
        self.own_depth_m = depth_m;
        ensure(depth_m.is_none_or(|d| (-MAX_HEAVE_M..MAX_DEPTH_M).contains(&d)))
    }

    pub(super) fn set_heave_down(&mut self, heave_down_m: Option<f64>) -> Checked {
        self.heave_down_m = heave_down_m;
        ensure(heave_down_m.is_none_or(|h| h.abs() <= MAX_HEAVE_M))
    }
}

/// Reason why a message has no reading.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum DecodeError {
    /// The message type has no decoder.
    Unsupported,
    /// A field of a known message is invalid.
    Malformed,
}

pub(crate) type Decoded = Result<Reading, DecodeError>;
pub(super) type Checked = Result<(), DecodeError>;

/// `Err(Malformed)` unless `valid` is true.
pub(super) fn ensure(valid: bool) -> Checked {
    valid.then_some(()).ok_or(DecodeError::Malformed)
}

pub(super) fn is_valid_heading(degrees: f64) -> bool {
    (-360.0..=720.0).contains(&degrees)
}

/// Degrees to radians in 0..2 pi.
pub(super) fn wrapped(degrees: f64) -> f64 {
    degrees.rem_euclid(360.0).to_radians()
}

/// UTC midnight of a date, nanoseconds since 1970; `None` if it exceeds 64 bits.
pub(super) fn midnight_ns(date: NaiveDate) -> Option<i64> {
    date.and_time(NaiveTime::MIN)
        .and_utc()
        .timestamp_nanos_opt()
}

/// UTC midnight of a date, nanoseconds since 1970. A two-digit year is in 1983..2082, as in the crate `nmea`.
pub(super) fn date_ns(day: u32, month: u32, year: i32) -> Result<i64, DecodeError> {
    let year = match year {
        0..=82 => year + 2000,
        83..=99 => year + 1900,
        _ => year,
    };
    NaiveDate::from_ymd_opt(year, month, day)
        .and_then(midnight_ns)
        .ok_or(DecodeError::Malformed)
}

/// Seconds to nanoseconds, rounded.
pub(super) fn seconds_ns(seconds: f64) -> i64 {
    (seconds * NS_PER_S as f64).round() as i64
}

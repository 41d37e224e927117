//! What one message says, whatever its format, in SI with our signs; and the rules that every decoder applies to it.

use chrono::{NaiveDate, NaiveTime};

use echotank_core::flow::FixQuality;
use echotank_core::time::{NS_PER_S, UtcNs};

const KNOT_M_PER_S: f64 = 1852.0 / 3600.0;
/// Largest heave that a format can say, metres; the tallest ocean wave recorded stands 30 m.
const MAX_HEAVE_M: f64 = 99.99;
/// No height above the sea or the ellipsoid, metres, is larger where boats go.
const MAX_HEIGHT_M: f64 = 100_000.0;
/// No platform dives deeper, metres.
const MAX_DEPTH_M: f64 = 12_000.0;
/// No speed over ground, metres per second, is larger.
const MAX_SPEED_M_PER_S: f64 = 1000.0;

/// Which message it was. Names are those of the sentences.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Kind {
    Gga,
    Rmc,
    Gll,
    Vtg,
    Zda,
    Hdt,
    Ths,
    /// HDG and HDM: magnetic.
    Magnetic,
    /// DBT, DBS, DBK and DPT.
    Depth,
    /// A depth sensor's: PIPS, PIXSE,DEPIN_, and the kinds above where the operator says so.
    OwnDepth,
    /// Understood, and of no use for the motion: GST, ROT, PSXN 10, 22 and 24, PHINF, PIXSE's speeds.
    Information,
    Pashr,
    /// Ashtech's forms ATT, AT2 and HPR: heading, pitch, roll.
    PashrAshtech,
    PashrPos,
    /// Quality of what follows in the burst.
    Psxn20,
    Psxn23,
    Prdid,
    Phtro,
    Phlin,
    Phoct,
    PixseAttitude,
    PixsePosition,
    PixseHeave,
    Avr,
    Ggk,
    Ptnthpr,
    Psat,
    Vnymr,
    Vnins,
    Psbg,
    Tss1,
    Em3000,
    Seapath26,
    Kmb,
    MavAttitude,
    MavPosition,
    MavGps,
    MavTime,
}

impl Kind {
    /// Where two messages of one source say the same thing, the higher has the word: own time beats borrowed time, true beats magnetic,
    /// and GGA has height and quality, which RMC lacks.
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

    /// Of use although it gives no quantity: time and quality.
    pub(crate) fn guides(self) -> bool {
        matches!(self, Kind::Zda | Kind::Psxn20 | Kind::MavTime)
    }
}

/// When a message says it holds.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum When {
    /// UTC since midnight, nanoseconds; a leap second counts as the first second of the next day.
    TimeOfDay(i64),
    /// The same, and UTC midnight of its day, nanoseconds since 1970.
    Dated {
        day_ns: i64,
        time_of_day_ns: i64,
    },
    /// GPS time, nanoseconds since the week began.
    GpsOfWeek(i64),
    Instant(UtcNs),
}

/// What PSXN,20 says is invalid.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Invalid {
    pub position: bool,
    pub heading: bool,
    pub roll_pitch: bool,
}

/// What one message said; empty fields are `None`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Reading {
    pub kind: Kind,
    pub when: Option<When>,
    /// Latitude and longitude, radians; only from a valid fix.
    pub position_rad: Option<(f64, f64)>,
    /// Above mean sea level, except where only the ellipsoid's is given (Seapath 26, KMB, GGK, VNINS).
    pub height_m: Option<f64>,
    pub fix: FixQuality,
    /// Course over ground (radians) and speed (metres per second).
    pub course_speed: Option<(f64, f64)>,
    /// True.
    pub heading_rad: Option<f64>,
    /// A magnetic heading, deviation applied, whose variation is not known.
    pub(crate) magnetic_rad: Option<f64>,
    /// Roll + starboard down, pitch + bow up, radians.
    pub(crate) roll_pitch_rad: Option<(f64, f64)>,
    pub heave_down_m: Option<f64>,
    /// Of water, as the sounder says it.
    pub(crate) water_depth_m: Option<f64>,
    /// Of the platform's own depth sensor below the surface.
    pub(crate) own_depth_m: Option<f64>,
    pub invalid: Option<Invalid>,
    /// Something was said, though nothing of the above.
    pub said: bool,
}

impl Reading {
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
            said: false,
        }
    }

    /// Known, but of no use.
    pub fn information() -> Self {
        Self {
            said: true,
            ..Self::new(Kind::Information)
        }
    }

    /// Every field that matters was empty, or there was no fix.
    pub fn is_empty(&self) -> bool {
        *self == Self::new(self.kind)
    }

    pub fn time_of_day_ns(&self) -> Option<i64> {
        match self.when? {
            When::TimeOfDay(ns)
            | When::Dated {
                time_of_day_ns: ns, ..
            } => Some(ns),
            When::GpsOfWeek(_) | When::Instant(_) => None,
        }
    }

    pub fn day_ns(&self) -> Option<i64> {
        match self.when? {
            When::Dated { day_ns, .. } => Some(day_ns),
            _ => None,
        }
    }

    /// The instant, where the message knows it whole.
    pub fn instant(&self) -> Option<UtcNs> {
        match self.when? {
            When::Instant(utc) => Some(utc),
            When::Dated {
                day_ns,
                time_of_day_ns,
            } => Some(UtcNs(day_ns.saturating_add(time_of_day_ns))),
            When::TimeOfDay(_) | When::GpsOfWeek(_) => None,
        }
    }

    pub(super) fn set_time(&mut self, time_of_day_ns: Option<i64>, day_ns: Option<i64>) {
        self.when = time_of_day_ns.map(|time_of_day_ns| match day_ns {
            Some(day_ns) => When::Dated {
                day_ns,
                time_of_day_ns,
            },
            None => When::TimeOfDay(time_of_day_ns),
        });
    }

    /// Takes a position in degrees if there is a fix.
    pub(super) fn set_position(&mut self, position_deg: Option<(f64, f64)>) -> Sound {
        let position = position_deg.filter(|_| self.fix != FixQuality::None);
        let Some((latitude, longitude)) = position else {
            self.fix = FixQuality::None;
            self.height_m = None;
            return Ok(());
        };
        self.position_rad = Some((latitude.to_radians(), longitude.to_radians()));
        let sane = latitude.abs() <= 90.0
            && longitude.abs() <= 180.0
            && self.height_m.is_none_or(|h| h.abs() < MAX_HEIGHT_M);
        sound(sane)
    }

    /// Takes course (degrees) and speed (knots).
    pub(super) fn set_course_knots(&mut self, course_speed: Option<(f64, f64)>) -> Sound {
        let Some((course, knots)) = course_speed else {
            return Ok(());
        };
        let speed = knots * KNOT_M_PER_S;
        self.course_speed = Some((wrapped(course), speed));
        sound(sane_heading(course) && (0.0..MAX_SPEED_M_PER_S).contains(&speed))
    }

    /// Takes a velocity over ground, metres per second.
    pub(super) fn set_velocity(&mut self, north: f64, east: f64) -> Sound {
        let speed = north.hypot(east);
        self.course_speed = Some((wrapped(east.atan2(north).to_degrees()), speed));
        sound(speed < MAX_SPEED_M_PER_S)
    }

    pub(super) fn set_heading(&mut self, heading_deg: Option<f64>) -> Sound {
        self.heading_rad = heading_deg.map(wrapped);
        sound(heading_deg.is_none_or(sane_heading))
    }

    /// Takes degrees; both or neither, since half an attitude is none.
    pub(super) fn set_roll_pitch(&mut self, roll: Option<f64>, pitch: Option<f64>) -> Sound {
        self.roll_pitch_rad = roll
            .zip(pitch)
            .map(|(roll, pitch)| (roll.to_radians(), pitch.to_radians()));
        sound(roll.is_none_or(|r| r.abs() <= 180.0) && pitch.is_none_or(|p| p.abs() <= 90.0))
    }

    /// Takes the depth of the platform, metres; a sensor at the surface may say a little less than nothing.
    pub(super) fn set_own_depth(&mut self, depth_m: Option<f64>) -> Sound {
        self.own_depth_m = depth_m;
        sound(depth_m.is_none_or(|d| (-MAX_HEAVE_M..MAX_DEPTH_M).contains(&d)))
    }

    pub(super) fn set_heave_down(&mut self, heave_down_m: Option<f64>) -> Sound {
        self.heave_down_m = heave_down_m;
        sound(heave_down_m.is_none_or(|h| h.abs() <= MAX_HEAVE_M))
    }
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Refusal {
    /// A message that is not decoded here.
    Unsupported,
    /// A known message whose fields make no sense.
    Malformed,
}

pub(crate) type Decoded = Result<Reading, Refusal>;
pub(super) type Sound = Result<(), Refusal>;

/// `Malformed` unless the values make sense.
pub(super) fn sound(sane: bool) -> Sound {
    sane.then_some(()).ok_or(Refusal::Malformed)
}

pub(super) fn sane_heading(degrees: f64) -> bool {
    (-360.0..=720.0).contains(&degrees)
}

/// Degrees to radians in 0..2 pi.
pub(super) fn wrapped(degrees: f64) -> f64 {
    degrees.rem_euclid(360.0).to_radians()
}

/// UTC midnight in nanoseconds since 1970; `None` outside what 64 bits hold.
pub(super) fn midnight_ns(date: NaiveDate) -> Option<i64> {
    date.and_time(NaiveTime::MIN)
        .and_utc()
        .timestamp_nanos_opt()
}

/// Midnight of a date; a year below 100 lies in 1983..2082, as the crate `nmea` has it.
pub(super) fn date_ns(day: u32, month: u32, year: i32) -> Result<i64, Refusal> {
    let year = match year {
        0..=82 => year + 2000,
        83..=99 => year + 1900,
        _ => year,
    };
    NaiveDate::from_ymd_opt(year, month, day)
        .and_then(midnight_ns)
        .ok_or(Refusal::Malformed)
}

/// Seconds to nanoseconds, rounded.
pub(super) fn seconds_ns(seconds: f64) -> i64 {
    (seconds * NS_PER_S as f64).round() as i64
}

//! Message 80: one channel of one ping. Source: Rev. 1.20, tables 2-1 to 2-9.
//!
//! ```text
//! header 240 bytes, see SonarDataHeader
//! data   samples x 1 or 2 i16, block floating point: value = sample x 2^-weighting
//! ```
//!
//! Numbers of 20 bits (samples, start and end frequency, mark) have their upper four bits in [`SonarDataHeader::msb`]. Unknown
//! fields are 0, with their bit of `validity` cleared. The manual does not state the unit of the eight fraction bits of the
//! sampling interval. They are written as 0, so the interval is a whole number of nanoseconds.

use std::f64::consts::PI;
use std::ops::Range;

use binrw::{BinRead, BinWrite};

use super::{MessageHeader, block_float, emit_message, message_type};
use crate::WireError;
use crate::calendar::DateTime;
use crate::layout::{data_at, layout, to_i16, to_i32, to_u16, to_u32, turn_counts};

/// Format of the samples of a message.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum DataFormat {
    /// One i16 per sample.
    Envelope,
    /// Real and imaginary i16, after the matched filter.
    Analytic,
    /// One i16 per sample, before the matched filter.
    Real,
    /// Real and imaginary i16, before the matched filter: the received signal of an element.
    AnalyticUnfiltered,
}

impl DataFormat {
    /// Code in the message.
    pub fn code(self) -> i16 {
        match self {
            Self::Envelope => 0,
            Self::Analytic => 1,
            Self::Real => 2,
            Self::AnalyticUnfiltered => 9,
        }
    }

    /// Format of a code in a message.
    pub fn from_code(code: i16) -> Result<Self, WireError> {
        match code {
            0 => Ok(Self::Envelope),
            1 => Ok(Self::Analytic),
            2 => Ok(Self::Real),
            9 => Ok(Self::AnalyticUnfiltered),
            _ => Err(WireError::unsupported("JSF data format", code as u16)),
        }
    }

    /// Number of i16 per sample.
    pub fn shorts_per_sample(self) -> usize {
        match self {
            Self::Envelope | Self::Real => 1,
            Self::Analytic | Self::AnalyticUnfiltered => 2,
        }
    }
}

/// Bits of [`SonarDataHeader::validity`].
pub mod validity {
    /// Position.
    pub const POSITION: u16 = 1;
    /// Course over ground.
    pub const COURSE: u16 = 1 << 1;
    /// Speed over ground.
    pub const SPEED: u16 = 1 << 2;
    /// Heading.
    pub const HEADING: u16 = 1 << 3;
    /// Pressure.
    pub const PRESSURE: u16 = 1 << 4;
    /// Pitch and roll.
    pub const PITCH_ROLL: u16 = 1 << 5;
    /// Altitude above the bottom.
    pub const ALTITUDE: u16 = 1 << 6;
    /// Water temperature.
    pub const WATER_TEMPERATURE: u16 = 1 << 8;
    /// Depth.
    pub const DEPTH: u16 = 1 << 9;
    /// Annotation.
    pub const ANNOTATION: u16 = 1 << 10;
    /// Length of cable.
    pub const CABLE: u16 = 1 << 11;
    /// Distance along a pipe.
    pub const KILOMETRES_OF_PIPE: u16 = 1 << 12;
    /// The position is that of the sonar at the time of the ping.
    pub const POSITION_INTERPOLATED: u16 = 1 << 13;
    /// Sound speed.
    pub const SOUND_SPEED: u16 = 1 << 14;
}

/// Maximum number of samples: samples and marks have 20 bits.
pub const MAX_SAMPLES: usize = (1 << 20) - 1;
const COORDINATES_LAT_LON: i16 = 2;
/// Minutes of arc x 10000 per radian.
const ARC_COUNTS_PER_RAD: f64 = 180.0 / PI * 60.0 * 1e4;
/// Counts of pitch and roll per radian.
const TILT_COUNTS_PER_RAD: f64 = 32_768.0 / PI;
const MPS_PER_KNOT: f64 = 1852.0 / 3600.0;

/// Header of message 80: the 240 bytes before the samples.
#[derive(Debug, Clone, Copy, PartialEq, BinRead, BinWrite)]
pub struct SonarDataHeader {
    /// Offset 0: start of the ping in seconds since 1970.
    pub ping_time_s: i32,
    /// Offset 4: number of samples from the ping to the first sample.
    pub starting_depth_samples: u32,
    /// Offset 8: counter of pings.
    #[brw(pad_after = 4)]
    pub ping_number: u32,
    /// Offset 16: upper bits of start frequency (0-3), end frequency (4-7), samples (8-11), mark (12-15).
    pub msb: u16,
    /// Offset 18: fractions of sampling interval (0-7) and course (8-15).
    pub lsb: u16,
    /// Offset 20: hundredths of knots (0-3), microseconds of the sweep (4-13).
    #[brw(pad_after = 6)]
    pub lsb2: u16,
    /// Offset 28: identification code; always 1.
    pub id_code: i16,
    /// Offset 30: bits of [`validity`].
    #[brw(pad_after = 2)]
    pub validity: u16,
    /// Offset 34: code of [`DataFormat`].
    pub data_format: i16,
    /// Offset 36: distance from antenna to tow point, positive aft.
    pub antenna_aft_cm: i16,
    /// Offset 38: distance from antenna to tow point, positive to starboard.
    #[brw(pad_after = 4)]
    pub antenna_starboard_cm: i16,
    /// Offset 44: distance along a pipe.
    #[brw(pad_after = 32)]
    pub kilometres_of_pipe: f32,
    /// Offset 80: longitude in minutes of arc x 10000, or x.
    pub longitude: i32,
    /// Offset 84: latitude in minutes of arc x 10000, or y.
    pub latitude: i32,
    /// Offset 88: unit of the coordinates: 1 mm, 2 latitude and longitude, 3 dm.
    pub coordinate_units: i16,
    /// Offset 90: annotation text, padded with NUL.
    pub annotation: [u8; 24],
    /// Offset 114: number of samples, lower 16 bits.
    pub samples_lsb: u16,
    /// Offset 116: time between samples.
    pub sample_interval_ns: u32,
    /// Offset 120: gain of the converter.
    pub adc_gain_factor: u16,
    /// Offset 122: transmit level, 0 to 100.
    #[brw(pad_after = 2)]
    pub transmit_level_percent: i16,
    /// Offset 126: start frequency, lower 16 bits, steps of 10 Hz.
    pub start_frequency_dahz: u16,
    /// Offset 128: end frequency, lower 16 bits, steps of 10 Hz.
    pub end_frequency_dahz: u16,
    /// Offset 130: length of the sweep, whole milliseconds; see `lsb2`.
    pub sweep_length_ms: u16,
    /// Offset 132: pressure, thousandths of a pound per square inch.
    pub pressure_mpsi: i32,
    /// Offset 136: depth of the sonar.
    pub depth_mm: i32,
    /// Offset 140: sample frequency, modulo 65536; half the rate for [`DataFormat::Real`].
    pub sample_frequency_hz: u16,
    /// Offset 142: number of the pulse file.
    pub pulse_id: u16,
    /// Offset 144: altitude above the bottom.
    pub altitude_mm: i32,
    /// Offset 148: sound speed.
    pub sound_speed_m_per_s: f32,
    /// Offset 152: frequency of the mixer.
    pub mixer_frequency_hz: f32,
    /// Offset 156: year of the ping.
    pub year: i16,
    /// Offset 158: day of the year.
    pub day_of_year: i16,
    /// Offset 160: hour of the ping.
    pub hour: i16,
    /// Offset 162: minute of the ping.
    pub minute: i16,
    /// Offset 164: second of the ping.
    pub second: i16,
    /// Offset 166: basis of the time; always 3.
    pub time_basis: i16,
    /// Offset 168: N of value = sample x 2^-N.
    pub weighting: i16,
    /// Offset 170: number of pulses travelling at the same time.
    pub pulses_in_water: i16,
    /// Offset 172: heading, 0.01 degrees.
    pub heading_cdeg: u16,
    /// Offset 174: pitch, positive bow up, 180 degrees = 32768.
    pub pitch: i16,
    /// Offset 176: roll, positive port up, 180 degrees = 32768.
    #[brw(pad_after = 4)]
    pub roll: i16,
    /// Offset 182: trigger source: 0 internal, 1 external, 2 coupled.
    pub trigger_source: i16,
    /// Offset 184: mark number, lower 16 bits; 0 means no mark.
    pub mark_number: u16,
    /// Offset 186: hour of the position.
    pub fix_hour: i16,
    /// Offset 188: minute of the position.
    pub fix_minute: i16,
    /// Offset 190: second of the position.
    pub fix_second: i16,
    /// Offset 192: course over ground, whole degrees; hundredths in `lsb`.
    pub course_deg: i16,
    /// Offset 194: speed over ground, tenths of a knot; hundredths in `lsb2`.
    pub speed_dkn: i16,
    /// Offset 196: day of the year of the position.
    pub fix_day_of_year: i16,
    /// Offset 198: year of the position.
    pub fix_year: i16,
    /// Offset 200: time of the ping, milliseconds since midnight.
    pub milliseconds_today: u32,
    /// Offset 204: largest magnitude of the converter's samples.
    #[brw(pad_after = 4)]
    pub adc_largest: u16,
    /// Offset 210: version of the software, ASCII.
    pub software_version: [u8; 6],
    /// Offset 216: correction for spherical spreading, 0.01 samples; -1 is off.
    pub spherical_correction_csamples: i32,
    /// Offset 220: packet number; always 1.
    pub packet_number: u16,
    /// Offset 222: decimation of the converter, x 100.
    #[brw(pad_after = 2)]
    pub adc_decimation_percent: i16,
    /// Offset 226: water temperature, 0.1 degrees Celsius.
    pub water_temperature_dc: i16,
    /// Offset 228: distance of the sonar behind the tow point.
    #[brw(pad_after = 4)]
    pub layback_m: f32,
    /// Offset 236: length of cable, 0.1 m.
    #[brw(pad_after = 2)]
    pub cable_out_dm: u16,
}

layout!(SonarDataHeader, 240, "JSF 80 header", Little);

impl Default for SonarDataHeader {
    /// Unknown values: all fields 0 except constants.
    fn default() -> Self {
        let zeros = Self::parse(&[0; Self::SIZE_BYTES]).expect("240 bytes are a header");
        Self {
            id_code: 1,
            time_basis: 3,
            pulses_in_water: 1,
            spherical_correction_csamples: -1,
            packet_number: 1,
            adc_decimation_percent: 100,
            ..zeros
        }
    }
}

/// Writes `bits` to the bits of `word` that `mask` selects.
fn put_bits(word: &mut u16, mask: u16, bits: u16) {
    *word = (*word & !mask) | ((bits << mask.trailing_zeros()) & mask);
}

fn bits_of(word: u16, mask: u16) -> u16 {
    (word & mask) >> mask.trailing_zeros()
}

const START_FREQUENCY_BITS: u16 = 0x000F;
const END_FREQUENCY_BITS: u16 = 0x00F0;
const SAMPLES_BITS: u16 = 0x0F00;
const COURSE_BITS: u16 = 0xFF00;
const SPEED_BITS: u16 = 0x000F;
const SWEEP_BITS: u16 = 0x3FF0;

/// Largest 20-bit number.
const MAX_20_BITS: f64 = 1_048_575.0;

impl SonarDataHeader {
    /// Number of samples.
    pub fn samples(&self) -> usize {
        usize::from(bits_of(self.msb, SAMPLES_BITS)) << 16 | usize::from(self.samples_lsb)
    }

    /// Sets the number of samples.
    ///
    /// # Panics
    /// If there are more than [`MAX_SAMPLES`].
    pub fn set_samples(&mut self, samples: usize) {
        assert!(samples <= MAX_SAMPLES, "JSF 80 of {samples} samples");
        self.samples_lsb = samples as u16;
        put_bits(&mut self.msb, SAMPLES_BITS, (samples >> 16) as u16);
    }

    /// Start and end of the pulse's band.
    pub fn frequencies_hz(&self) -> (f64, f64) {
        let hz = |mask, low: u16| {
            f64::from(u32::from(bits_of(self.msb, mask)) << 16 | u32::from(low)) * 10.0
        };
        (
            hz(START_FREQUENCY_BITS, self.start_frequency_dahz),
            hz(END_FREQUENCY_BITS, self.end_frequency_dahz),
        )
    }

    /// Sets start and end of the pulse's band, with a resolution of 10 Hz and a maximum of 10.5 MHz.
    pub fn set_frequencies_hz(&mut self, start_hz: f64, end_hz: f64) {
        let counts = |hz: f64| to_u32((hz / 10.0).min(MAX_20_BITS));
        let (start, end) = (counts(start_hz), counts(end_hz));
        (self.start_frequency_dahz, self.end_frequency_dahz) = (start as u16, end as u16);
        put_bits(&mut self.msb, START_FREQUENCY_BITS, (start >> 16) as u16);
        put_bits(&mut self.msb, END_FREQUENCY_BITS, (end >> 16) as u16);
    }

    /// Duration of the sweep.
    pub fn sweep_length_s(&self) -> f64 {
        f64::from(self.sweep_length_ms) * 1e-3 + f64::from(bits_of(self.lsb2, SWEEP_BITS)) * 1e-6
    }

    /// Sets the duration of the sweep, with a resolution of one microsecond.
    pub fn set_sweep_length_s(&mut self, seconds: f64) {
        let us = to_u32((seconds * 1e6).min(65_535_999.0));
        self.sweep_length_ms = (us / 1000) as u16;
        put_bits(&mut self.lsb2, SWEEP_BITS, (us % 1000) as u16);
    }

    /// Time of the ping in nanoseconds since 1970, with millisecond resolution.
    pub fn utc_ns(&self) -> i64 {
        i64::from(self.ping_time_s) * 1_000_000_000
            + i64::from(self.milliseconds_today % 1000) * 1_000_000
    }

    /// Sets all time fields of the ping, with millisecond resolution; valid until 2038.
    pub fn set_utc_ns(&mut self, utc_ns: i64) {
        let date_time = DateTime::from_utc_ns(utc_ns);
        self.ping_time_s = utc_ns.div_euclid(1_000_000_000).clamp(0, i32::MAX.into()) as i32;
        self.milliseconds_today = date_time.milliseconds_of_day();
        self.year = date_time.year as i16;
        self.day_of_year = date_time.day_of_year as i16;
        self.hour = date_time.hour.into();
        self.minute = date_time.minute.into();
        self.second = date_time.second.into();
    }

    /// Latitude and longitude in radians, if the position is valid and geographic.
    pub fn position_rad(&self) -> Option<(f64, f64)> {
        let is_there =
            self.validity & validity::POSITION != 0 && self.coordinate_units == COORDINATES_LAT_LON;
        is_there.then(|| {
            (
                f64::from(self.latitude) / ARC_COUNTS_PER_RAD,
                f64::from(self.longitude) / ARC_COUNTS_PER_RAD,
            )
        })
    }

    /// Sets the sonar's position at the time of the ping, with a resolution of 1e-4 minutes of arc (0.19 m of latitude). The time of the
    /// position is that of the ping.
    pub fn set_position_rad(&mut self, latitude_rad: f64, longitude_rad: f64) {
        self.latitude = to_i32(latitude_rad * ARC_COUNTS_PER_RAD);
        self.longitude = to_i32(longitude_rad * ARC_COUNTS_PER_RAD);
        self.coordinate_units = COORDINATES_LAT_LON;
        self.validity |= validity::POSITION | validity::POSITION_INTERPOLATED;
        (self.fix_hour, self.fix_minute, self.fix_second) = (self.hour, self.minute, self.second);
        (self.fix_day_of_year, self.fix_year) = (self.day_of_year, self.year);
    }

    /// Heading, clockwise from north.
    pub fn heading_rad(&self) -> Option<f64> {
        (self.validity & validity::HEADING != 0)
            .then(|| (f64::from(self.heading_cdeg) / 100.0).to_radians())
    }

    /// Sets the heading, with a resolution of 0.01 degrees.
    pub fn set_heading_rad(&mut self, heading_rad: f64) {
        self.heading_cdeg = to_u16(turn_counts(heading_rad, 100.0));
        self.validity |= validity::HEADING;
    }

    /// Pitch (positive bow up) and roll (positive port up).
    pub fn pitch_roll_rad(&self) -> Option<(f64, f64)> {
        (self.validity & validity::PITCH_ROLL != 0).then(|| {
            (
                f64::from(self.pitch) / TILT_COUNTS_PER_RAD,
                f64::from(self.roll) / TILT_COUNTS_PER_RAD,
            )
        })
    }

    /// Sets pitch (positive bow up) and roll (positive port up), with a resolution of 0.0055 degrees.
    pub fn set_pitch_roll_rad(&mut self, pitch_rad: f64, roll_rad: f64) {
        self.pitch = to_i16(pitch_rad * TILT_COUNTS_PER_RAD);
        self.roll = to_i16(roll_rad * TILT_COUNTS_PER_RAD);
        self.validity |= validity::PITCH_ROLL;
    }

    /// Height above the seabed.
    pub fn altitude_m(&self) -> Option<f64> {
        (self.validity & validity::ALTITUDE != 0).then(|| f64::from(self.altitude_mm) * 1e-3)
    }

    /// Sets the height above the seabed, with a resolution of one millimetre.
    pub fn set_altitude_m(&mut self, altitude_m: f64) {
        self.altitude_mm = to_i32(altitude_m * 1e3);
        self.validity |= validity::ALTITUDE;
    }

    /// Depth below the surface.
    pub fn depth_m(&self) -> Option<f64> {
        (self.validity & validity::DEPTH != 0).then(|| f64::from(self.depth_mm) * 1e-3)
    }

    /// Sets the depth below the surface, with a resolution of one millimetre.
    pub fn set_depth_m(&mut self, depth_m: f64) {
        self.depth_mm = to_i32(depth_m * 1e3);
        self.validity |= validity::DEPTH;
    }

    /// Sets the sound speed and its validity bit.
    pub fn set_sound_speed_m_per_s(&mut self, sound_speed_m_per_s: f32) {
        self.sound_speed_m_per_s = sound_speed_m_per_s;
        self.validity |= validity::SOUND_SPEED;
    }

    /// Course over ground, clockwise from north.
    pub fn course_rad(&self) -> Option<f64> {
        (self.validity & validity::COURSE != 0).then(|| {
            (f64::from(self.course_deg) + f64::from(bits_of(self.lsb, COURSE_BITS)) * 1e-2)
                .to_radians()
        })
    }

    /// Sets the course in whole degrees and hundredths, as the manual defines. Some readers interpret the whole degrees as tenths.
    pub fn set_course_rad(&mut self, course_rad: f64) {
        let counts = to_u16(turn_counts(course_rad, 100.0));
        self.course_deg = (counts / 100) as i16;
        put_bits(&mut self.lsb, COURSE_BITS, counts % 100);
        self.validity |= validity::COURSE;
    }

    /// Speed over ground.
    pub fn speed_m_per_s(&self) -> Option<f64> {
        (self.validity & validity::SPEED != 0).then(|| {
            (f64::from(self.speed_dkn) * 0.1 + f64::from(bits_of(self.lsb2, SPEED_BITS)) * 0.01)
                * MPS_PER_KNOT
        })
    }

    /// Sets the speed over ground, with a resolution of 0.01 knots.
    pub fn set_speed_m_per_s(&mut self, speed_m_per_s: f64) {
        let counts = to_u32((speed_m_per_s / MPS_PER_KNOT * 100.0).clamp(0.0, 327_679.0));
        self.speed_dkn = (counts / 10) as i16;
        put_bits(&mut self.lsb2, SPEED_BITS, (counts % 10) as u16);
        self.validity |= validity::SPEED;
    }
}

/// Parsed message 80 that borrows its samples.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SonarData80<'a> {
    /// Header of the message.
    pub header: SonarDataHeader,
    /// Format of the samples.
    pub format: DataFormat,
    data: &'a [u8],
}

impl<'a> SonarData80<'a> {
    /// Parses the body of the message. Returns an error if the body is too short or has an unsupported value.
    pub fn parse(body: &'a [u8]) -> Result<Self, WireError> {
        let header = SonarDataHeader::parse(body)?;
        let format = DataFormat::from_code(header.data_format)?;
        let len = 2 * header.samples() as u64 * format.shorts_per_sample() as u64;
        let data = data_at(body, SonarDataHeader::SIZE_BYTES, len, "JSF 80 samples")?;
        Ok(Self {
            header,
            format,
            data,
        })
    }

    /// Integers of the message; pairs of real and imaginary part in the analytic formats.
    pub fn shorts(&self) -> impl ExactSizeIterator<Item = i16> + 'a {
        self.data
            .chunks_exact(2)
            .map(|bytes| i16::from_le_bytes([bytes[0], bytes[1]]))
    }

    /// Integers scaled by the exponent of the block.
    pub fn values(&self) -> impl ExactSizeIterator<Item = f64> + 'a {
        let weighting = self.header.weighting;
        self.shorts()
            .map(move |sample| block_float::value(sample, weighting))
    }
}

/// Appends message 80 for a subsystem and a channel and returns its byte range. Format, number of samples and weighting are those
/// of the header.
///
/// # Panics
/// If the header's format is not supported, or the number of `shorts` differs from the header.
pub fn emit_80(
    buf: &mut Vec<u8>,
    subsystem: u8,
    channel: u8,
    header: &SonarDataHeader,
    shorts: &[i16],
) -> Range<usize> {
    let format = DataFormat::from_code(header.data_format).expect("a data format that we write");
    assert_eq!(
        shorts.len(),
        header.samples() * format.shorts_per_sample(),
        "JSF 80 of {} samples, {format:?}",
        header.samples()
    );
    let message = MessageHeader::data(message_type::SONAR_DATA, subsystem, channel);
    emit_message(buf, &message, |buf| {
        buf.reserve(SonarDataHeader::SIZE_BYTES + 2 * shorts.len());
        header.emit(buf);
        crate::sevenk::frame::extend_encoded(buf, shorts, i16::to_le_bytes);
    })
}

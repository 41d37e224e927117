//! Sonar packet: one side-scan ping. Source: Rev. X41, tables H (XTFPINGHEADER) and I (XTFPINGCHANHEADER).
//!
//! ```text
//! ping header 256 | per channel: header 64, samples | zeros up to a multiple of 64 bytes
//! ```

use std::ops::Range;

use binrw::{BinRead, BinWrite};

use super::{
    FileHeader, MARK, PACKET_STEP_BYTES, PacketStart, SampleFormat, packet_of, packet_type,
};
use crate::WireError;
use crate::calendar::{DateTime, days_from_epoch};
use crate::layout::{data_at, layout};
use crate::sevenk::frame::extend_encoded;

const NS_PER_HUNDREDTH: i64 = 10_000_000;

/// Header of a ping: the 256 bytes before the channels. Byte and channel counts are set when the packet is emitted.
#[derive(Debug, Clone, Copy, PartialEq, BinRead, BinWrite)]
pub struct PingHeader {
    /// Common start of a packet.
    pub start: PacketStart,
    /// Offset 14: UTC time of the ping.
    pub year: u16,
    /// Month, from 1.
    pub month: u8,
    /// Day of the month, from 1.
    pub day: u8,
    /// Hour.
    pub hour: u8,
    /// Minute.
    pub minute: u8,
    /// Second.
    pub second: u8,
    /// Hundredths of a second.
    pub hundredths: u8,
    /// Offset 22: day of the year.
    pub julian_day: u16,
    /// Offset 24: event number.
    pub event_number: u32,
    /// Offset 28: ping number.
    pub ping_number: u32,
    /// Offset 32: half the speed of sound, for two-way times.
    pub sound_velocity_one_way_m_per_s: f32,
    /// Offset 36: height of the tide.
    #[brw(pad_after = 24)]
    pub ocean_tide_m: f32,
    /// Offset 64: water temperature.
    pub water_temperature_c: f32,
    /// Offset 68: water pressure.
    pub pressure_psi: f32,
    /// Offset 72: speed of sound.
    #[brw(pad_after = 44)]
    pub computed_sound_velocity_m_per_s: f32,
    /// Offset 120: speed of the ship.
    pub ship_speed_kn: f32,
    /// Offset 124: heading of the ship's gyro.
    pub ship_gyro_deg: f32,
    /// Offset 128: latitude or northing, in the unit of the file header.
    pub ship_y: f64,
    /// Offset 136: longitude or easting.
    pub ship_x: f64,
    /// Offset 144: altitude of the ship.
    pub ship_altitude_dm: u16,
    /// Offset 146: depth of the ship.
    pub ship_depth_dm: u16,
    /// Offset 148: hour, minute, second, hundredths of the position.
    pub fix_time: [u8; 4],
    /// Offset 152: speed of the sensor.
    #[brw(pad_after = 4)]
    pub sensor_speed_kn: f32,
    /// Offset 160: latitude or northing, in the unit of the file header.
    pub sensor_y: f64,
    #[brw(pad_after = 8)]
    /// Longitude or easting.
    pub sensor_x: f64,
    /// Offset 184: distance of the sensor behind the reference point.
    #[brw(pad_after = 4)]
    pub layback_m: f32,
    /// Offset 192: depth of the sensor.
    pub sensor_depth_m: f32,
    /// Offset 196: height of the sensor above the seabed.
    #[brw(pad_after = 4)]
    pub sensor_altitude_m: f32,
    /// Offset 204: pitch of the sensor, positive nose up.
    pub sensor_pitch_deg: f32,
    /// Offset 208: roll of the sensor, positive to starboard (port up).
    pub sensor_roll_deg: f32,
    /// Offset 212: heading of the sensor.
    pub sensor_heading_deg: f32,
    /// Offset 216: heave, positive up.
    pub heave_up_m: f32,
    /// Offset 220: yaw, positive to the right.
    pub yaw_deg: f32,
    /// Offset 224: time of a clock shared with attitude packets, milliseconds.
    #[brw(pad_after = 4)]
    pub attitude_time_tag_ms: u32,
    /// Offset 232: time of the position, milliseconds.
    #[brw(pad_after = 20)]
    pub nav_fix_ms: u32,
}

layout!(PingHeader, 256, "XTF ping header", Little);

impl Default for PingHeader {
    /// Unknown values: all fields 0 except mark and type.
    fn default() -> Self {
        let zeros = Self::parse(&[0; Self::SIZE_BYTES]).expect("256 bytes are a header");
        Self {
            start: PacketStart {
                mark: MARK,
                packet_type: packet_type::SONAR,
                ..zeros.start
            },
            ..zeros
        }
    }
}

impl PingHeader {
    /// Time of the ping in nanoseconds since 1970, to 0.01 s; `None` if the fields are not a time between 1970 and 2262.
    pub fn utc_ns(&self) -> Option<i64> {
        let is_moment = (1970..2262).contains(&self.year)
            && (1..=12).contains(&self.month)
            && (1..=31).contains(&self.day)
            && self.hour < 24
            && self.minute < 60
            && self.second < 61
            && self.hundredths < 100;
        is_moment.then(|| {
            let days = days_from_epoch(self.year.into(), self.month.into(), self.day.into());
            let minutes = i64::from(self.hour) * 60 + i64::from(self.minute);
            let seconds = days * 86_400 + minutes * 60 + i64::from(self.second);
            seconds * 1_000_000_000 + i64::from(self.hundredths) * NS_PER_HUNDREDTH
        })
    }

    /// Sets the time of the ping and of the position, rounded to the resolution of 0.01 s, and the same time in whole milliseconds.
    pub fn set_utc_ns(&mut self, utc_ns: i64) {
        let milliseconds = DateTime::from_utc_ns(utc_ns).milliseconds_of_day();
        let date_time = DateTime::from_utc_ns(utc_ns.saturating_add(NS_PER_HUNDREDTH / 2));
        self.year = date_time.year as u16;
        (self.month, self.day) = (date_time.month, date_time.day);
        (self.hour, self.minute, self.second) =
            (date_time.hour, date_time.minute, date_time.second);
        self.hundredths = (i64::from(date_time.nanosecond) / NS_PER_HUNDREDTH) as u8;
        self.julian_day = date_time.day_of_year;
        self.fix_time = [self.hour, self.minute, self.second, self.hundredths];
        self.nav_fix_ms = milliseconds;
        self.attitude_time_tag_ms = milliseconds;
    }
}

/// Header of a channel: the 64 bytes before its samples.
#[derive(Debug, Clone, Copy, PartialEq, Default, BinRead, BinWrite)]
pub struct ChannelHeader {
    /// Index of the channel in the file header.
    pub channel: u16,
    /// Offset 2: downsampling: 2 largest value, 4 root mean square.
    pub downsample_method: u16,
    /// Offset 4: slant range.
    pub slant_range_m: f32,
    /// Offset 8: ground range; 0 for data in slant range.
    pub ground_range_m: f32,
    /// Offset 12: time from the ping to the first sample.
    pub time_delay_s: f32,
    /// Offset 16: recorded duration.
    pub time_duration_s: f32,
    /// Offset 20: period between pings.
    pub seconds_per_ping: f32,
    /// Offset 24: processing: 4 TVG, 8 angle and gain correction, 16 filter.
    pub processing_flags: u16,
    /// Offset 26: centre frequency.
    pub frequency_khz: u16,
    /// Gain at the start, in the sonar's code.
    pub initial_gain_code: u16,
    /// Gain in the sonar's code.
    pub gain_code: u16,
    #[brw(pad_after = 8)]
    /// Bandwidth.
    pub bandwidth_khz: u16,
    /// Offset 42: number of samples, set when the packet is emitted.
    pub samples: u32,
    /// Offset 46: scale of the samples.
    #[brw(pad_after = 10)]
    pub millivolt_scale: u16,
    /// Offset 58: N of value = sample x 2^-N, for sonars that have it.
    #[brw(pad_after = 4)]
    pub weight: i16,
}

layout!(ChannelHeader, 64, "XTF channel header", Little);

/// Samples of a channel to emit.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Samples<'a> {
    /// 8-bit integers.
    U8(&'a [u8]),
    /// 16-bit integers.
    U16(&'a [u16]),
    /// 32-bit integers.
    U32(&'a [u32]),
    /// 32-bit floats.
    F32(&'a [f32]),
}

impl Samples<'_> {
    /// Type of the samples.
    pub fn format(&self) -> SampleFormat {
        match self {
            Self::U8(_) => SampleFormat::U8,
            Self::U16(_) => SampleFormat::U16,
            Self::U32(_) => SampleFormat::U32,
            Self::F32(_) => SampleFormat::F32,
        }
    }

    /// Number of samples.
    pub fn count(&self) -> usize {
        match self {
            Self::U8(samples) => samples.len(),
            Self::U16(samples) => samples.len(),
            Self::U32(samples) => samples.len(),
            Self::F32(samples) => samples.len(),
        }
    }
}

/// Appends a ping with all channels of the file and returns its byte range.
///
/// # Panics
/// If number or formats of the channels differ from the file header.
pub fn emit_ping(
    buf: &mut Vec<u8>,
    file: &FileHeader,
    header: &PingHeader,
    channels: &[(ChannelHeader, Samples<'_>)],
) -> Range<usize> {
    assert_eq!(channels.len(), file.channels.len(), "XTF ping's channels");
    let start = buf.len();
    header.emit(buf);
    for (index, (channel, samples)) in channels.iter().enumerate() {
        assert_eq!(
            samples.format(),
            file.channels[index].format,
            "XTF channel {index}"
        );
        let header = ChannelHeader {
            samples: samples.count() as u32,
            ..*channel
        };
        header.emit(buf);
        match samples {
            Samples::U8(samples) => buf.extend_from_slice(samples),
            Samples::U16(samples) => extend_encoded(buf, samples, u16::to_le_bytes),
            Samples::U32(samples) => extend_encoded(buf, samples, u32::to_le_bytes),
            Samples::F32(samples) => extend_encoded(buf, samples, f32::to_le_bytes),
        }
    }
    let bytes = (buf.len() - start).next_multiple_of(PACKET_STEP_BYTES);
    buf.resize(start + bytes, 0);
    buf[start + 4..start + 6].copy_from_slice(&(channels.len() as u16).to_le_bytes());
    buf[start + 10..start + 14].copy_from_slice(&(bytes as u32).to_le_bytes());
    start..buf.len()
}

/// Parsed channel of a ping that borrows its samples.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ChannelSamples<'a> {
    /// Channel header.
    pub header: ChannelHeader,
    /// Type of the samples.
    pub format: SampleFormat,
    data: &'a [u8],
}

impl<'a> ChannelSamples<'a> {
    /// The samples converted to f64.
    pub fn values(&self) -> impl ExactSizeIterator<Item = f64> + 'a {
        let format = self.format;
        self.data
            .chunks_exact(format.bytes())
            .map(move |bytes| match (format, bytes) {
                (SampleFormat::U8, &[a]) => a.into(),
                (SampleFormat::U16, &[a, b]) => u16::from_le_bytes([a, b]).into(),
                (SampleFormat::U32, &[a, b, c, d]) => u32::from_le_bytes([a, b, c, d]).into(),
                (SampleFormat::F32, &[a, b, c, d]) => f32::from_le_bytes([a, b, c, d]).into(),
                _ => f64::NAN,
            })
    }
}

/// Parsed side-scan ping of all channels.
#[derive(Debug, Clone, PartialEq)]
pub struct Ping<'a> {
    /// Ping header.
    pub header: PingHeader,
    /// Channels of the ping, at most those of the file header.
    pub channels: Vec<ChannelSamples<'a>>,
}

impl<'a> Ping<'a> {
    /// Parses the packet at the front of `bytes`, which belongs to a file with this header.
    pub fn parse(bytes: &'a [u8], file: &FileHeader) -> Result<Self, WireError> {
        let (start, packet) = packet_of(bytes, packet_type::SONAR)?;
        let header = PingHeader::parse(packet)?;
        let count = usize::from(start.channels_to_follow);
        let infos = file.channels.get(..count).ok_or(WireError::unsupported(
            "XTF channels in a ping",
            start.channels_to_follow,
        ))?;
        let mut at = PingHeader::SIZE_BYTES;
        let mut channels = Vec::with_capacity(count);
        for info in infos {
            let header = ChannelHeader::parse(packet.get(at..).unwrap_or_default())?;
            at += ChannelHeader::SIZE_BYTES;
            let len = u64::from(header.samples) * info.format.bytes() as u64;
            let data = data_at(packet, at, len, "XTF samples")?;
            at += data.len();
            channels.push(ChannelSamples {
                header,
                format: info.format,
                data,
            });
        }
        Ok(Self { header, channels })
    }
}

//! Header of an XTF file. Source: Rev. X41, tables C (XTFFILEHEADER) and D (CHANINFO).
//!
//! At most six channels are supported. With more channels the header grows in steps of 1024 bytes, which few readers
//! support.

use binrw::{BinRead, BinWrite};

use crate::WireError;
use crate::layout::{layout_of, read_layout, text_field, text_of, write_layout};

/// Maximum number of channels.
pub const MAX_CHANNELS: usize = 6;
/// Value of byte 0 of a file.
const FILE_FORMAT: u8 = 0x7B;
/// Value that old viewers expect in the former field for the number of samples.
const SAMPLES_OF_OLD_VIEWERS: u32 = 1024;

/// Kind of data in a channel.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ChannelKind {
    /// Sub-bottom profile.
    SubBottom,
    /// Port side-scan.
    Port,
    /// Starboard side-scan.
    Starboard,
    /// Bathymetry.
    Bathymetry,
}

/// Type of one sample of a channel. Integers are unsigned.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum SampleFormat {
    /// 8-bit integer.
    U8,
    /// 16-bit integer.
    U16,
    /// 32-bit integer.
    U32,
    /// 32-bit float.
    F32,
}

impl SampleFormat {
    /// Size of a sample.
    pub fn bytes(self) -> usize {
        match self {
            Self::U8 => 1,
            Self::U16 => 2,
            Self::U32 | Self::F32 => 4,
        }
    }

    fn code(self) -> u8 {
        match self {
            Self::U32 => 2,
            Self::U16 => 3,
            Self::F32 => 5,
            Self::U8 => 8,
        }
    }
}

/// Unit of positions.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum NavUnits {
    /// Projected coordinates, metres.
    Metres,
    /// Geographic coordinates, degrees.
    LatitudeLongitude,
}

/// Description of one channel in the file header (128 bytes).
#[derive(Debug, Clone, PartialEq)]
pub struct ChannelInfo {
    /// Kind of data.
    pub kind: ChannelKind,
    /// Type of the samples.
    pub format: SampleFormat,
    /// Name of the channel, at most 15 ASCII characters.
    pub name: String,
    /// Centre frequency.
    pub frequency_khz: f32,
    /// Along-track beam width.
    pub horizontal_beam_deg: f32,
    /// Angle of the beam axis below the horizontal.
    pub tilt_deg: f32,
    /// Across-track beam width, -3 dB.
    pub beam_width_deg: f32,
    /// Volts of a full-scale sample.
    pub volt_scale: f32,
    /// Position of the sonar: starboard, forward, down.
    pub offset_m: [f32; 3],
    /// Orientation of the sonar: positive to the right, nose up, to starboard.
    pub offset_yaw_pitch_roll_deg: [f32; 3],
}

#[derive(Debug, Clone, Copy, PartialEq, BinRead, BinWrite)]
struct RawChannel {
    kind: u8,
    index: u8,
    correction: u16,
    unipolar: u16,
    bytes_per_sample: u16,
    reserved: u32,
    name: [u8; 16],
    volt_scale: f32,
    frequency_khz: f32,
    horizontal_beam_deg: f32,
    tilt_deg: f32,
    beam_width_deg: f32,
    offset_m: [f32; 3],
    offset_yaw_pitch_roll_deg: [f32; 3],
    beams_per_array: u16,
    #[brw(pad_after = 53)]
    sample_format: u8,
}

layout_of!(RawChannel, 128, "XTF channel", Little);

/// Header of a side-scan file.
#[derive(Debug, Clone, PartialEq)]
pub struct FileHeader {
    /// Name of the recording program, at most 7 ASCII characters.
    pub program: String,
    /// Version of the recording program, at most 7 ASCII characters.
    pub program_version: String,
    /// Name of the sonar, at most 15 characters.
    pub sonar_name: String,
    /// Type of the sonar from table C; 0 is unspecified.
    pub sonar_type: u16,
    /// Note, at most 63 characters.
    pub note: String,
    /// Name of the file, at most 63 characters.
    pub file_name: String,
    /// Unit of positions.
    pub nav_units: NavUnits,
    /// Latency of the navigation.
    pub nav_latency_ms: i32,
    /// Side-scan and sub-bottom channels, at most six.
    pub channels: Vec<ChannelInfo>,
}

#[derive(Debug, Clone, Copy, PartialEq, BinRead, BinWrite)]
struct RawHeader {
    file_format: u8,
    system_type: u8,
    program: [u8; 8],
    program_version: [u8; 8],
    sonar_name: [u8; 16],
    sonar_type: u16,
    note: [u8; 64],
    file_name: [u8; 64],
    nav_units: u16,
    sonar_channels: u16,
    bathymetry_channels: u16,
    snippet_channels: u8,
    forward_look_arrays: u8,
    echo_strength_channels: u16,
    #[brw(pad_after = 3)]
    interferometry_channels: u8,
    #[brw(pad_after = 22)]
    reference_height_m: f32,
    #[brw(pad_after = 48)]
    nav_latency_ms: i32,
    channels: [RawChannel; MAX_CHANNELS],
}

layout_of!(RawHeader, 1024, "XTF file header", Little);

impl FileHeader {
    /// Size of the header.
    pub const SIZE_BYTES: usize = 1024;

    /// Parses the header at the front of `bytes`.
    pub fn parse(bytes: &[u8]) -> Result<Self, WireError> {
        let raw: RawHeader = read_layout(bytes)?;
        if raw.file_format != FILE_FORMAT {
            return Err(WireError::mark(
                "XTF file format",
                FILE_FORMAT,
                raw.file_format,
            ));
        }
        let sonar_channels = usize::from(raw.sonar_channels);
        if sonar_channels > MAX_CHANNELS {
            return Err(WireError::unsupported(
                "XTF channel count",
                raw.sonar_channels,
            ));
        }
        let nav_units = match raw.nav_units {
            0 => NavUnits::Metres,
            3 => NavUnits::LatitudeLongitude,
            other => return Err(WireError::unsupported("XTF navigation units", other)),
        };
        let channels = raw.channels[..sonar_channels]
            .iter()
            .map(ChannelInfo::from_raw)
            .collect::<Result<_, _>>()?;
        Ok(Self {
            program: text_of(&raw.program),
            program_version: text_of(&raw.program_version),
            sonar_name: text_of(&raw.sonar_name),
            sonar_type: raw.sonar_type,
            note: text_of(&raw.note),
            file_name: text_of(&raw.file_name),
            nav_units,
            nav_latency_ms: raw.nav_latency_ms,
            channels,
        })
    }

    /// Appends the header; texts are truncated to their fields.
    ///
    /// # Panics
    /// With more than six channels.
    pub fn emit(&self, buf: &mut Vec<u8>) {
        assert!(
            self.channels.len() <= MAX_CHANNELS,
            "XTF header of {} channels",
            self.channels.len()
        );
        let mut channels: [RawChannel; MAX_CHANNELS] =
            [read_layout(&[0; 128]).expect("128 bytes are a channel"); MAX_CHANNELS];
        for (index, (raw, channel)) in channels.iter_mut().zip(&self.channels).enumerate() {
            *raw = channel.to_raw(index as u8);
        }
        let raw = RawHeader {
            file_format: FILE_FORMAT,
            system_type: 1,
            program: text_field(&self.program),
            program_version: text_field(&self.program_version),
            sonar_name: text_field(&self.sonar_name),
            sonar_type: self.sonar_type,
            note: text_field(&self.note),
            file_name: text_field(&self.file_name),
            nav_units: match self.nav_units {
                NavUnits::Metres => 0,
                NavUnits::LatitudeLongitude => 3,
            },
            sonar_channels: self.channels.len() as u16,
            bathymetry_channels: 0,
            snippet_channels: 0,
            forward_look_arrays: 0,
            echo_strength_channels: 0,
            interferometry_channels: 0,
            reference_height_m: 0.0,
            nav_latency_ms: self.nav_latency_ms,
            channels,
        };
        write_layout(&raw, buf);
    }
}

impl ChannelInfo {
    fn from_raw(raw: &RawChannel) -> Result<Self, WireError> {
        let kind = match raw.kind {
            0 => ChannelKind::SubBottom,
            1 => ChannelKind::Port,
            2 => ChannelKind::Starboard,
            3 => ChannelKind::Bathymetry,
            other => return Err(WireError::unsupported("XTF channel type", other)),
        };
        // Files from before Rev. X41 state only the size of a sample.
        let format = match (raw.sample_format, raw.bytes_per_sample) {
            (8, _) | (0, 1) => SampleFormat::U8,
            (3, _) | (0, 2) => SampleFormat::U16,
            (2, _) | (0, 4) => SampleFormat::U32,
            (5, _) => SampleFormat::F32,
            (code, width) => {
                let got = if code == 0 { width } else { code.into() };
                return Err(WireError::unsupported("XTF sample format", got));
            }
        };
        Ok(Self {
            kind,
            format,
            name: text_of(&raw.name),
            frequency_khz: raw.frequency_khz,
            horizontal_beam_deg: raw.horizontal_beam_deg,
            tilt_deg: raw.tilt_deg,
            beam_width_deg: raw.beam_width_deg,
            volt_scale: raw.volt_scale,
            offset_m: raw.offset_m,
            offset_yaw_pitch_roll_deg: raw.offset_yaw_pitch_roll_deg,
        })
    }

    fn to_raw(&self, index: u8) -> RawChannel {
        RawChannel {
            kind: match self.kind {
                ChannelKind::SubBottom => 0,
                ChannelKind::Port => 1,
                ChannelKind::Starboard => 2,
                ChannelKind::Bathymetry => 3,
            },
            index,
            // The range is slant range, never negative.
            correction: 1,
            unipolar: 1,
            bytes_per_sample: self.format.bytes() as u16,
            reserved: SAMPLES_OF_OLD_VIEWERS,
            name: text_field(&self.name),
            volt_scale: self.volt_scale,
            frequency_khz: self.frequency_khz,
            horizontal_beam_deg: self.horizontal_beam_deg,
            tilt_deg: self.tilt_deg,
            beam_width_deg: self.beam_width_deg,
            offset_m: self.offset_m,
            offset_yaw_pitch_roll_deg: self.offset_yaw_pitch_roll_deg,
            beams_per_array: 0,
            sample_format: self.format.code(),
        }
    }
}

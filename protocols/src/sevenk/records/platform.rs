//! Records of the navigation of the platform: 1003 (position), 1008 (depth), 1012 (roll, pitch and heave), 1013 (heading), 1015
//! (navigation) and 7610 (sound velocity). Source: DFD 3.12.
//!
//! Signs: roll is positive port up, pitch bow up, heave up. Some readers require 7610 for bathymetry, so a server must send it.

use std::fmt;

use binrw::{BinRead, BinWrite};

use super::rth_record;
use crate::sevenk::record_id;

/// Record 1003 (position): geographic or grid position.
#[derive(Debug, Clone, Copy, PartialEq, Default, BinRead, BinWrite)]
pub struct Position1003 {
    /// Geodetic datum; 0 means WGS84.
    pub datum_id: u32,
    /// Age of the position at the record's timestamp.
    pub latency_s: f32,
    /// Latitude in radians if geographic, northing in metres on a grid.
    pub latitude_rad_or_northing_m: f64,
    /// Longitude in radians if geographic, easting in metres on a grid.
    pub longitude_rad_or_easting_m: f64,
    /// Height above the datum.
    pub height_m: f64,
    /// Type of the position: [`Position1003::GEOGRAPHIC`] or [`Position1003::GRID`].
    pub position_type: u8,
    /// Zone of a grid position.
    pub utm_zone: u8,
    /// Quality of the position: 0 navigation, 1 dead reckoning.
    pub quality_flag: u8,
    /// Positioning method: 0 GPS, 1 DGPS, 15 RTK fixed, 16 RTK float.
    pub positioning_method: u8,
    /// Number of satellites in use.
    pub satellites: u8,
}

impl Position1003 {
    /// Type of a position in latitude and longitude.
    pub const GEOGRAPHIC: u8 = 0;
    /// Type of a position in northing and easting.
    pub const GRID: u8 = 1;
}

/// Record 1008 (depth) of the platform or of the water.
#[derive(Debug, Clone, Copy, PartialEq, Default, BinRead, BinWrite)]
pub struct Depth1008 {
    /// Measured depth: 0 of the sensor, 1 of the water.
    pub descriptor: u8,
    /// Reference of the depth: 0 as measured, 1 mean sea level.
    #[brw(pad_after = 2)]
    pub correction: u8,
    /// Depth, positive down.
    pub depth_m: f32,
}

/// Record 1012 (roll, pitch and heave): attitude and heave.
#[derive(Debug, Clone, Copy, PartialEq, Default, BinRead, BinWrite)]
pub struct RollPitchHeave1012 {
    /// Roll, positive port up.
    pub roll_rad: f32,
    /// Pitch, positive bow up.
    pub pitch_rad: f32,
    /// Heave, positive up.
    pub heave_up_m: f32,
}

/// Record 1013 (heading): true heading of the platform.
#[derive(Debug, Clone, Copy, PartialEq, Default, BinRead, BinWrite)]
pub struct Heading1013 {
    /// Heading, clockwise from true north.
    pub heading_rad: f32,
}

/// Record 1015 (navigation): position, velocity and heading.
#[derive(Debug, Clone, Copy, PartialEq, Default, BinRead, BinWrite)]
pub struct Navigation1015 {
    /// Reference of the height: 1 ellipsoid, 2 geoid, 3 chart datum.
    pub vertical_reference: u8,
    /// Latitude, positive north.
    pub latitude_rad: f64,
    /// Longitude, positive east.
    pub longitude_rad: f64,
    /// Horizontal accuracy; 0 means unknown.
    pub horizontal_accuracy_m: f32,
    /// Height of the vessel's reference point.
    pub height_m: f32,
    /// Vertical accuracy; 0 means unknown.
    pub height_accuracy_m: f32,
    /// Horizontal speed.
    pub speed_over_ground_m_per_s: f32,
    /// Course over ground, clockwise from true north.
    pub course_over_ground_rad: f32,
    /// Heading, clockwise from true north.
    pub heading_rad: f32,
}

/// Record 7610 (sound velocity) at the sonar head.
#[derive(Debug, Clone, Copy, PartialEq, Default, BinRead, BinWrite)]
pub struct SoundVelocity7610 {
    /// Sound velocity.
    pub sound_velocity_m_per_s: f32,
    /// Water temperature; 0 means unknown.
    pub temperature_k: f32,
    /// Water pressure; 0 means unknown.
    pub pressure_pa: f32,
}

rth_record!(Position1003, record_id::POSITION, 37, "1003 position");
rth_record!(Depth1008, record_id::DEPTH, 8, "1008 depth");
rth_record!(
    RollPitchHeave1012,
    record_id::ROLL_PITCH_HEAVE,
    12,
    "1012 roll pitch heave"
);
rth_record!(Heading1013, record_id::HEADING, 4, "1013 heading");
rth_record!(Navigation1015, record_id::NAVIGATION, 41, "1015 navigation");
rth_record!(
    SoundVelocity7610,
    record_id::SOUND_VELOCITY,
    12,
    "7610 sound velocity"
);

impl fmt::Display for Position1003 {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let (a, b) = (
            self.latitude_rad_or_northing_m,
            self.longitude_rad_or_easting_m,
        );
        if self.position_type == Self::GEOGRAPHIC {
            write!(
                f,
                "position: latitude {:.8} deg, longitude {:.8} deg",
                a.to_degrees(),
                b.to_degrees()
            )?;
        } else {
            write!(
                f,
                "position: northing {a:.3} m, easting {b:.3} m, zone {}",
                self.utm_zone
            )?;
        }
        write!(
            f,
            ", height {:.3} m, latency {:.3} s, method {}, {} satellites",
            self.height_m, self.latency_s, self.positioning_method, self.satellites
        )
    }
}

impl fmt::Display for Depth1008 {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let of = if self.descriptor == 1 {
            "the water"
        } else {
            "the sensor"
        };
        write!(f, "depth of {of}: {:.3} m", self.depth_m)
    }
}

impl fmt::Display for RollPitchHeave1012 {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(
            f,
            "attitude: roll {:.3} deg port up, pitch {:.3} deg bow up, heave {:.3} m up",
            self.roll_rad.to_degrees(),
            self.pitch_rad.to_degrees(),
            self.heave_up_m
        )
    }
}

impl fmt::Display for Heading1013 {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "heading: {:.3} deg", self.heading_rad.to_degrees())
    }
}

impl fmt::Display for Navigation1015 {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(
            f,
            "navigation: latitude {:.8} deg, longitude {:.8} deg, height {:.3} m, {:.2} m/s towards {:.2} deg, heading {:.2} deg",
            self.latitude_rad.to_degrees(),
            self.longitude_rad.to_degrees(),
            self.height_m,
            self.speed_over_ground_m_per_s,
            self.course_over_ground_rad.to_degrees(),
            self.heading_rad.to_degrees()
        )
    }
}

impl fmt::Display for SoundVelocity7610 {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(
            f,
            "sound velocity: {:.2} m/s, temperature {:.2} K, pressure {:.0} Pa",
            self.sound_velocity_m_per_s, self.temperature_k, self.pressure_pa
        )
    }
}

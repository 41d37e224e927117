//! Samples of navigation sensors, and the platform at one instant.

use crate::frames::Pose;
use crate::time::UtcNs;

/// One decoded measurement of a navigation source.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct NavSample {
    /// Index of the source in the list of navigation sources of the configuration.
    pub source: u16,
    /// Time of validity, rig time.
    pub valid_utc: UtcNs,
    /// Arrival time of the first byte, rig time. For a recorded log it is the time stamp of the recorder.
    pub arrival_utc: UtcNs,
    /// Measured values.
    pub quantity: NavQuantity,
}

/// Measured values of one sample. Angles are in radians: roll positive starboard down, pitch positive bow up, heading clockwise
/// from true north. Heave is positive down.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum NavQuantity {
    /// Antenna position on WGS84.
    Position {
        /// Geodetic latitude, positive north.
        latitude_rad: f64,
        /// Longitude, positive east.
        longitude_rad: f64,
        /// Height above the datum of the source (mean sea level for GGA), metres; `None` if the source gives no height.
        height_m: Option<f64>,
        /// Quality of the position.
        fix: FixQuality,
    },
    /// Position in world coordinates, from a CSV track.
    LocalPosition {
        /// World north, metres.
        north_m: f64,
        /// World east, metres.
        east_m: f64,
        /// World down, metres.
        down_m: f64,
    },
    /// Course and speed over ground.
    CourseSpeed {
        /// Course, clockwise from true north.
        course_rad: f64,
        /// Horizontal speed, metres per second.
        speed_m_per_s: f64,
    },
    /// True heading.
    Heading {
        /// Heading, clockwise from true north.
        heading_rad: f64,
    },
    /// Roll and pitch of the sensor.
    RollPitch {
        /// Roll, positive starboard down.
        roll_rad: f64,
        /// Pitch, positive bow up.
        pitch_rad: f64,
    },
    /// Heave of the sensor.
    Heave {
        /// Heave, metres, positive down.
        heave_down_m: f64,
    },
    /// Depth of the platform's depth sensor.
    Depth {
        /// Depth below the surface, metres.
        depth_m: f64,
    },
}

/// Quality of a GNSS position.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum FixQuality {
    /// No fix.
    #[default]
    None,
    /// GNSS without corrections; also manual and simulated positions.
    Autonomous,
    /// Differential GNSS.
    Differential,
    /// Real-time kinematic, integer ambiguities.
    RtkFixed,
    /// Real-time kinematic, float ambiguities.
    RtkFloat,
    /// Estimated position.
    DeadReckoning,
}

/// State of the platform at one instant, for output records. The echo model uses
/// [`PingPlan::trajectory`](crate::ping::PingPlan::trajectory) instead.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct NavState {
    /// Rig time.
    pub utc: UtcNs,
    /// Pose of the reference point.
    pub pose: Pose,
    /// Roll, positive starboard down, radians.
    pub roll_rad: f64,
    /// Pitch, positive bow up, radians.
    pub pitch_rad: f64,
    /// Heading, clockwise from true north, radians.
    pub heading_rad: f64,
    /// Heave, metres, positive down; zero if heave is not used.
    pub heave_down_m: f64,
    /// WGS84 latitude of the reference point, radians.
    pub latitude_rad: f64,
    /// WGS84 longitude of the reference point, radians.
    pub longitude_rad: f64,
    /// Height, metres: the negative of world down.
    pub height_m: f64,
    /// Quality of the newest position.
    pub fix: FixQuality,
    /// Age of the newest position used, seconds. Negative if the position is interpolated to a later sample.
    pub position_age_s: f64,
    /// Age of the newest attitude used, seconds. Negative if the attitude is interpolated to a later sample.
    pub attitude_age_s: f64,
    /// True if at least one quantity is extrapolated.
    pub extrapolated: bool,
    /// Quantities that are out of date.
    pub invalid: NavInvalid,
    /// True if the clock of an active source jumped shortly before, or its times are corrected.
    pub time_jumped: bool,
}

/// Flags of quantities that are too old. The last known value of a flagged quantity is held.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct NavInvalid {
    /// Horizontal position.
    pub position: bool,
    /// Heading.
    pub heading: bool,
    /// Roll and pitch.
    pub roll_pitch: bool,
    /// Heave or depth, if used.
    pub vertical: bool,
}

impl NavInvalid {
    /// Whether any quantity is invalid.
    pub fn any(&self) -> bool {
        self.position || self.heading || self.roll_pitch || self.vertical
    }
}

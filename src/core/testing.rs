//! Test values for all crates.

use glam::DQuat;
use glam::DVec3;

use crate::frames::Trajectory;
use crate::model::{DopplerModel, ModelChoice, PathModel, Synthesis};
use crate::navigation::{FixQuality, NavState};
use crate::ping::{PingPlan, SensorState};
use crate::pulse::Pulse;
use crate::settings::SonarSettings;
use crate::time::UtcNs;

/// Plan of a ping from a platform at rest at the origin.
pub fn plan_at_rest(pulse: &Pulse, sample_count: usize, sound_speed_m_per_s: f64) -> PingPlan {
    let trajectory = Trajectory::uniform(DVec3::ZERO, DVec3::ZERO, DQuat::IDENTITY);
    PingPlan {
        sonar: 0,
        ping_number: 1,
        transmit_utc: UtcNs(0),
        stamp_utc: UtcNs(0),
        ping_period_s: 0.0,
        settings: SonarSettings {
            pinging: true,
            range_m: 10.0,
            max_ping_rate_hz: 1.0,
            source_level_db: 220.0,
            gain_db: 0.0,
            pulse_duration_s: pulse.duration_s,
        },
        ping_rate_hz: 1.0,
        pulse: *pulse,
        sound_speed_m_per_s,
        refraction: None,
        absorption_db_per_m: 0.0,
        sample_count,
        first_sample_s: 0.0,
        model: ModelChoice {
            path: PathModel::Polyline,
            doppler: DopplerModel::Stretch,
            synthesis: Synthesis::Direct,
            segment_s: 1.0,
            cull_db: None,
        },
        range_floors: crate::ping::RangeFloors::default(),
        nav: NavState {
            utc: UtcNs(0),
            pose: trajectory.pose_at(0.0),
            roll_rad: 0.0,
            pitch_rad: 0.0,
            heading_rad: 0.0,
            heave_down_m: 0.0,
            latitude_rad: 0.0,
            longitude_rad: 0.0,
            height_m: 0.0,
            fix: FixQuality::None,
            position_age_s: 0.0,
            attitude_age_s: 0.0,
            extrapolated: false,
            invalid: Default::default(),
            time_jumped: false,
        },
        sensor: SensorState::default(),
        trajectory,
        segments: Vec::new(),
    }
}

//! Arrays, plans and plane waves for the tests of this stage.

use std::f64::consts::TAU;

use glam::DVec3;
use num_complex::Complex64;

use super::matched::envelope;
use crate::flow::{
    ArrayGeometry, DopplerModel, ElementFrame, FixQuality, ModelChoice, Mounting, NavState,
    PathModel, Pattern, PingPlan, Pulse, SonarSettings, Synthesis,
};
use crate::frames::{Trajectory, rotation_from_angles};
use crate::time::UtcNs;

/// A line array in the body's origin, looking down, turned by `yaw_deg` (0: fore and aft, 90: x to starboard).
pub fn array(elements: usize, spacing_m: f64, yaw_deg: f64) -> ArrayGeometry {
    ArrayGeometry {
        mounting: Mounting {
            position_m: DVec3::ZERO,
            body_from_array: rotation_from_angles(0.0, 0.0, yaw_deg.to_radians()),
        },
        elements,
        spacing_m,
        element_pattern: Pattern::Omnidirectional,
        sensitivity_db: 0.0,
        transmit: 0,
    }
}

/// Each element hears the pulse that `echo` gives it, with its leading edge's delay: exp(-j 2pi f_c u) a(t - u).
pub fn elements_of_plane_wave(
    array: &ArrayGeometry,
    rate_hz: f64,
    samples: usize,
    echo: impl Fn(usize) -> (Pulse, f64),
) -> ElementFrame {
    let mut iq = Vec::new();
    for e in 0..array.elements {
        let (pulse, delay_s) = echo(e);
        let carrier = Complex64::from_polar(1.0, -TAU * pulse.center_frequency_hz * delay_s);
        iq.extend((0..samples).map(|k| carrier * envelope(&pulse, k as f64 / rate_hz - delay_s)));
    }
    ElementFrame {
        array: 0,
        elements: array.elements,
        samples,
        iq,
        saturated: 0,
    }
}

/// An endless tone from `sine` towards the array's +x.
pub fn tone(
    array: &ArrayGeometry,
    samples: usize,
    frequency_hz: f64,
    sine: f64,
    sound_speed_m_per_s: f64,
) -> ElementFrame {
    let iq = (0..array.elements)
        .flat_map(|e| {
            let early_s = array.element_x_m(e) * sine / sound_speed_m_per_s;
            std::iter::repeat_n(
                Complex64::from_polar(1.0, TAU * frequency_hz * early_s),
                samples,
            )
        })
        .collect();
    ElementFrame {
        array: 0,
        elements: array.elements,
        samples,
        iq,
        saturated: 0,
    }
}

/// A ping of a platform at rest in the origin.
pub fn plan(pulse: &Pulse, sample_count: usize, sound_speed_m_per_s: f64) -> PingPlan {
    let trajectory = Trajectory::uniform(DVec3::ZERO, DVec3::ZERO, glam::DQuat::IDENTITY);
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
        },
        trajectory,
        segments: Vec::new(),
    }
}

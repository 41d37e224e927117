//! Pulses of another sonar: instants of arrival on its own clock, and plane waves over the elements.

use glam::DVec3;
use num_complex::Complex64;

use super::super::filter::Decimator;
use super::waveform::{SampleClock, Timing, Waveform, WaveformSource};
use crate::echo::levels::{Directivity, amplitude_from_db};
use echotank_core::arrays::ArrayGeometry;
use echotank_core::frames::Pose;
use echotank_core::instrument::SecondSonar;
use echotank_core::ping::PingPlan;
use echotank_core::pulse::Pulse;

const ATTOSECONDS: f64 = 1e18;
const ATTOSECONDS_PER_NS: i128 = 1_000_000_000;

/// A pulse that arrives during a ping.
#[derive(Clone, Copy, Debug)]
pub(super) struct Arrival {
    /// Index of the second sonar.
    pub(super) sonar: usize,
    /// Arrival at the reference point, seconds after the start of the pulse.
    time_s: f64,
    /// Pose at that instant.
    pose: Pose,
}

/// A second sonar, prepared for the sonar that receives it.
pub(super) struct SecondSonarWaves {
    spec: SecondSonar,
    /// Period and offset in UTC, attoseconds.
    period_as: i128,
    offset_as: i128,
    /// Unit vector towards it, world axes.
    direction: DVec3,
    /// Frequency in UTC, hertz.
    frequency_hz: f64,
    waveform: Waveform,
}

impl SecondSonarWaves {
    pub(super) fn new(
        spec: &SecondSonar,
        carrier_hz: f64,
        filter: Option<&Decimator>,
        rate_hz: f64,
    ) -> Self {
        let slow = 1.0 + 1e-6 * spec.drift_ppm;
        let frequency_hz = spec.pulse.center_frequency_hz / slow;
        let source = WaveformSource {
            pulse: Pulse {
                center_frequency_hz: frequency_hz,
                ..spec.pulse
            },
            apart_hz: frequency_hz - carrier_hz,
            ringing: None,
            until_s: f64::INFINITY,
        };
        let mut waveform = Waveform::with_room_for(&source, filter, rate_hz);
        waveform.set(&source, filter);
        let (sin_bearing, cos_bearing) = libm::sincos(spec.bearing_rad);
        let (sin_down, cos_down) = libm::sincos(spec.depression_rad);
        Self {
            spec: *spec,
            period_as: (spec.period_s * slow * ATTOSECONDS).round() as i128,
            offset_as: (spec.offset_s * ATTOSECONDS).round() as i128,
            direction: DVec3::new(cos_down * cos_bearing, cos_down * sin_bearing, sin_down),
            frequency_hz,
            waveform,
        }
    }

    /// Number of pulses within `window_s`, at most.
    pub(super) fn max_arrivals(&self, window_s: f64) -> usize {
        let (from_s, to_s) = self.waveform.span_s();
        let period_s = self.period_as as f64 / ATTOSECONDS;
        ((window_s + to_s - from_s) / period_s).ceil() as usize + 2
    }

    /// Adds the pulses of a ping to `arrivals`. `reach_s`: longest way of sound from the reference point to an element. `window_s`: end of the samples.
    pub(super) fn arrivals(
        &self,
        sonar: usize,
        plan: &PingPlan,
        window_s: f64,
        reach_s: f64,
        arrivals: &mut Vec<Arrival>,
    ) {
        let (from_s, to_s) = self.waveform.span_s();
        let earliest_s = plan.first_sample_s - to_s - reach_s;
        let latest_s = window_s - from_s + reach_s;
        let start_as = i128::from(plan.transmit_utc.0) * ATTOSECONDS_PER_NS;
        let earliest_as = start_as - self.offset_as + (earliest_s * ATTOSECONDS) as i128;
        let mut at_as =
            (earliest_as.div_euclid(self.period_as) + 1) * self.period_as + self.offset_as;
        loop {
            let time_s = (at_as - start_as) as f64 / ATTOSECONDS;
            if time_s > latest_s {
                return;
            }
            let pose = plan.trajectory.pose_at(time_s);
            arrivals.push(Arrival {
                sonar,
                time_s,
                pose,
            });
            at_as += self.period_as;
        }
    }

    /// Adds a pulse to the samples of one element.
    pub(super) fn add(
        &self,
        arrival: &Arrival,
        sound_speed_m_per_s: f64,
        array: &ArrayGeometry,
        element: usize,
        clock: SampleClock,
        iq: &mut [Complex64],
    ) {
        let pose = &arrival.pose;
        let mounting = array.element_mounting(element);
        let arm_m = mounting.position_m;
        let facing = pose.world_from_body * mounting.body_from_array;
        let direction = facing.inverse() * self.direction;
        let wavelength_m = sound_speed_m_per_s / self.frequency_hz;
        let pattern = Directivity::new(&array.element_pattern, wavelength_m);
        let pattern = pattern.towards(direction.x, direction.y, direction.z);
        if pattern == 0.0 {
            return;
        }
        let ahead_m = self.direction.dot(pose.world_from_body * arm_m);
        let closing_m_per_s = self.direction.dot(pose.point_velocity_m_per_s(arm_m));
        let drift = closing_m_per_s / sound_speed_m_per_s;
        let timing = Timing {
            offset_s: ahead_m / sound_speed_m_per_s - (1.0 + drift) * arrival.time_s,
            drift,
        };
        let volts = amplitude_from_db(self.spec.level_db + array.sensitivity_db);
        self.waveform.add(pattern * volts, timing, clock, iq);
    }
}

//! Ping protocol of Blue Robotics and Cerulean: Omniscan 450 and Surveyor 240.
//!
//! - [`Device`]: a device and its requested settings; shared by its emitter and its clients' sessions
//! - [`PingEmitter`]: converts a ping into frames
//! - [`session`]: processes commands
//!
//! The protocol definitions leave some behaviour open:
//! - Gain indices cover the gain limits of the sonar in equal steps.
//! - `timestamp_ms` counts from the opening of the output.
//! - Results are dB re 1 uV (rms) at the receiver. Each result is the mean power of its range interval. Results are scaled between
//!   the maximum of the ping and [`RANGE_OF_RESULTS_DB`] below it.
//! - Angles of points are positive to port, as in the axes of the device.

pub mod session;

use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use echotank_protocols::ping_protocol::message_id;
use echotank_protocols::ping_protocol::omniscan450::{
    OsMonoProfileHead, SyncChannel, emit_2198, quantise_db,
};
use echotank_protocols::ping_protocol::surveyor240::{
    AtofHead, AtofPoint, AttitudeReport, YzHead, emit_3011, emit_3012,
};

use crate::changes::part_of;
use crate::pool::DatagramPool;
use echotank_config::spec::{PingDevice, PingProtocolSpec, SonarSpec};
use echotank_core::ping::{Line, PingOutput, PingPlan, Side};
use echotank_core::records::Datagram;
use echotank_core::time::UtcNs;

/// Maximum span of the 16-bit results, dB.
const RANGE_OF_RESULTS_DB: f64 = 100.0;
/// 1 V in dB re 1 uV.
const VOLT_IN_MICROVOLT_DB: f64 = 120.0;
/// Maximum gain index of the Omniscan. The gain of the Surveyor is in percent.
const GAIN_STEPS: f64 = 7.0;
const GAIN_PERCENT: f64 = 100.0;
/// Initial device identifier. Every frame carries the identifier of its source.
const FIRST_DEVICE_ID: u8 = 1;

/// Simulated device with its requested settings, shared by the emitter and the sessions.
pub struct Device {
    /// Configuration of the output.
    pub spec: PingProtocolSpec,
    /// Sonar that the device simulates.
    pub sonar: SonarSpec,
    /// Sound speed for the conversion of time to range.
    pub sound_speed_m_per_s: f64,
    /// Time of power-up, rig time.
    power_up: UtcNs,
    requested: Mutex<RequestedSettings>,
}

/// Client settings that are not part of the settings of the sonar.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct RequestedSettings {
    /// Slant range of the first result, metres.
    pub start_m: f64,
    /// Number of results per profile.
    pub num_results: u16,
    /// Synchronisation channel of the device and the number of channels.
    pub sync: SyncChannel,
    /// True if angles and times of flight (3012) are sent with each ping.
    pub wants_atof: bool,
    /// True if points in the vertical plane (3011) are sent with each ping.
    pub wants_yz: bool,
    /// Identifier in the source field of frames.
    pub device_id: u8,
}

impl Device {
    /// A device with default settings; `power_up` is rig time.
    pub fn new(
        spec: &PingProtocolSpec,
        sonar: &SonarSpec,
        sound_speed_m_per_s: f64,
        power_up: UtcNs,
    ) -> Self {
        let (channel_number, number_of_channels) = spec.channel;
        Self {
            spec: spec.clone(),
            sonar: sonar.clone(),
            sound_speed_m_per_s,
            power_up,
            requested: Mutex::new(RequestedSettings {
                start_m: 0.0,
                num_results: 600,
                sync: SyncChannel {
                    channel_number,
                    number_of_channels,
                },
                wants_atof: true,
                wants_yz: false,
                device_id: FIRST_DEVICE_ID,
            }),
        }
    }

    /// A copy of the current requested settings.
    pub fn requested(&self) -> RequestedSettings {
        *self.lock()
    }

    fn lock(&self) -> MutexGuard<'_, RequestedSettings> {
        // A poisoned lock is usable: each field is written in one step.
        self.requested
            .lock()
            .unwrap_or_else(PoisonError::into_inner)
    }

    fn uptime_ms(&self, utc: UtcNs) -> u32 {
        // The value wraps after 49 days, as the field does.
        ((utc.0 - self.power_up.0) / 1_000_000) as u32
    }
}

/// Converter of pings into the frames of one device. It serves one thread.
pub struct PingEmitter {
    device: Arc<Device>,
    pools: [DatagramPool; 4],
    results_db: Vec<f64>,
    results: Vec<u16>,
    points: Vec<AtofPoint>,
    yz: Vec<[f32; 2]>,
}

/// Messages of a ping in the order in which they are sent.
const PER_PING: [u16; 4] = [
    message_id::OS_MONO_PROFILE,
    message_id::ATTITUDE_REPORT,
    message_id::ATOF_POINT_DATA,
    message_id::YZ_POINT_DATA,
];

impl PingEmitter {
    /// `waiting_pings` is the number of pings whose frames may wait in queues without a new buffer.
    pub fn new(device: Arc<Device>, waiting_pings: usize) -> Self {
        Self {
            device,
            pools: PER_PING.map(|id| DatagramPool::new(id.into(), waiting_pings + 1)),
            results_db: Vec::new(),
            results: Vec::new(),
            points: Vec::new(),
            yz: Vec::new(),
        }
    }

    /// Appends the frames of one ping.
    pub fn emit_ping(
        &mut self,
        plan: &PingPlan,
        output: &PingOutput,
        into: &mut Vec<Arc<Datagram>>,
    ) {
        match self.device.spec.device {
            PingDevice::Omniscan450 { side } => {
                if let Some(line) = output.lines.iter().find(|line| line.side == side) {
                    into.push(self.profile(plan, line, side));
                }
            }
            PingDevice::Surveyor240 => {
                let requested = self.device.requested();
                into.push(self.attitude(plan, &requested));
                if requested.wants_atof {
                    into.push(self.atof(plan, output, &requested));
                }
                if requested.wants_yz {
                    into.push(self.yz(plan, output, &requested));
                }
            }
        }
    }

    /// Message 2198 (mono profile) of one side-scan line.
    fn profile(&mut self, plan: &PingPlan, line: &Line, side: Side) -> Arc<Datagram> {
        let device = Arc::clone(&self.device);
        let requested = device.requested();
        let range_m = plan.settings.range_m;
        let start_m = requested.start_m.min(0.95 * range_m);
        let length_m = range_m - start_m;
        let samples_per_m = 2.0 * device.sonar.receiver.sample_rate_hz / plan.sound_speed_m_per_s;
        let count = usize::from(requested.num_results);
        mean_levels_db(
            &line.amplitude,
            start_m * samples_per_m,
            length_m * samples_per_m / count as f64,
            count,
            &mut self.results_db,
        );
        let (min_db, max_db) = scale(&self.results_db);
        self.results.clear();
        self.results.extend(
            self.results_db
                .iter()
                .map(|&db| quantise_db(db as f32, min_db, max_db)),
        );
        let heading_deg = plan.nav.heading_rad.to_degrees();
        let across_deg = match side {
            Side::Port => -90.0,
            Side::Starboard => 90.0,
        };
        let limits = &device.sonar.limits;
        let head = OsMonoProfileHead {
            // The device counts from 0 at power-up.
            ping_number: plan.ping_number.wrapping_sub(1),
            start_mm: (start_m * 1e3).round() as u32,
            length_mm: (length_m * 1e3).round() as u32,
            timestamp_ms: device.uptime_ms(plan.transmit_utc),
            ping_hz: plan.pulse.center_frequency_hz.round() as u32,
            gain_index: (part_of(limits.gain_db, plan.settings.gain_db) * GAIN_STEPS).round()
                as u16,
            num_results: 0,
            sos_dmps: (plan.sound_speed_m_per_s * 10.0).round() as u16,
            channel_number: requested.sync.channel_number,
            pulse_duration_s: plan.pulse.duration_s as f32,
            analog_gain: 10f64.powf(plan.settings.gain_db / 20.0) as f32,
            max_pwr_db: max_db,
            min_pwr_db: min_db,
            transducer_heading_deg: (heading_deg + across_deg).rem_euclid(360.0) as f32,
            vehicle_heading_deg: heading_deg.rem_euclid(360.0) as f32,
        };
        let results = &self.results;
        self.pools[0].write(|buf| emit_2198(buf, requested.device_id, 0, &head, results))
    }

    /// Message 504 (attitude report).
    fn attitude(&mut self, plan: &PingPlan, requested: &RequestedSettings) -> Arc<Datagram> {
        let report = AttitudeReport {
            up: up(plan),
            utc_msec: utc_ms(plan),
            pwr_up_msec: self.device.uptime_ms(plan.transmit_utc),
        };
        self.pools[1].write(|buf| report.emit_frame(buf, requested.device_id, 0))
    }

    /// Message 3012 (angles and times of flight of the soundings).
    fn atof(
        &mut self,
        plan: &PingPlan,
        output: &PingOutput,
        requested: &RequestedSettings,
    ) -> Arc<Datagram> {
        self.points.clear();
        self.points
            .extend(output.soundings.iter().map(|sounding| AtofPoint {
                angle_rad: -sounding.angle_rad as f32,
                two_way_time_s: sounding.twtt_s as f32,
            }));
        let rate_hz = self.device.sonar.receiver.sample_rate_hz;
        let head = AtofHead {
            pwr_up_msec: self.device.uptime_ms(plan.transmit_utc),
            utc_msec: utc_ms(plan),
            listening_s: plan.window_s(rate_hz) as f32,
            sos_mps: plan.sound_speed_m_per_s as f32,
            ping_number: plan.ping_number,
            ping_hz: plan.pulse.center_frequency_hz.round() as u32,
            pulse_s: plan.pulse.duration_s as f32,
            flags: 0,
            num_points: 0,
        };
        let points = &self.points;
        self.pools[2].write(|buf| emit_3012(buf, requested.device_id, 0, &head, points))
    }

    /// Message 3011 (points in the vertical plane).
    fn yz(
        &mut self,
        plan: &PingPlan,
        output: &PingOutput,
        requested: &RequestedSettings,
    ) -> Arc<Datagram> {
        let c = plan.sound_speed_m_per_s;
        self.yz.clear();
        self.yz.extend(output.soundings.iter().map(|sounding| {
            let (sin, cos) = sounding.angle_rad.sin_cos();
            let range_m = 0.5 * c * sounding.twtt_s;
            [(-range_m * sin) as f32, (-range_m * cos) as f32]
        }));
        let head = YzHead {
            timestamp_msec: self.device.uptime_ms(plan.transmit_utc),
            ping_number: plan.ping_number,
            sos_mps: c as f32,
            up: up(plan),
            // The device has no sensor for these quantities.
            water_c: -1000.0,
            water_bar: -1000.0,
            heave_m: -plan.nav.heave_down_m as f32,
            start_m: requested.start_m as f32,
            end_m: plan.settings.range_m as f32,
            num_points: 0,
        };
        let points = &self.yz;
        self.pools[3].write(|buf| emit_3011(buf, requested.device_id, 0, &head, points))
    }
}

/// Time of the ping, milliseconds since 1970.
fn utc_ms(plan: &PingPlan) -> u64 {
    (plan.stamp_utc.0.max(0) / 1_000_000) as u64
}

/// The up vector in body axes. Roll here is positive starboard down, that is, port up.
fn up(plan: &PingPlan) -> [f32; 3] {
    AttitudeReport::up_from(plan.nav.roll_rad, plan.nav.pitch_rad)
}

/// Mean power in `count` intervals of a line, dB re 1 uV. Each interval is `width` samples long; the first begins at sample
/// `first`. An interval without a sample is interpolated. Samples beyond the end of the line are zero.
fn mean_levels_db(line: &[f32], first: f64, width: f64, count: usize, into: &mut Vec<f64>) {
    let power_at = |sample: usize| line.get(sample).map_or(0.0, |&v| f64::from(v).powi(2));
    into.clear();
    into.extend((0..count).map(|n| {
        let begin = first + n as f64 * width;
        let end = begin + width;
        let inside = begin.ceil() as usize..(end.ceil() as usize).min(line.len());
        let power = if inside.is_empty() {
            let middle = 0.5 * (begin + end);
            let (before, part) = (middle.floor() as usize, middle.fract());
            power_at(before) * (1.0 - part) + power_at(before + 1) * part
        } else {
            let len = inside.len() as f64;
            inside.map(power_at).sum::<f64>() / len
        };
        10.0 * power.log10() + VOLT_IN_MICROVOLT_DB
    }));
}

/// Levels for 0 and 65535. The upper level is the maximum. The lower level is the smallest finite level, at most
/// [`RANGE_OF_RESULTS_DB`] below the maximum.
fn scale(results_db: &[f64]) -> (f32, f32) {
    let finite = || results_db.iter().copied().filter(|db| db.is_finite());
    let max = finite().fold(f64::NEG_INFINITY, f64::max);
    if !max.is_finite() {
        return (0.0, 1.0);
    }
    let min = finite().fold(max, f64::min).max(max - RANGE_OF_RESULTS_DB);
    // A line of constant level also needs a non-zero span.
    (min.min(max - 1.0) as f32, max as f32)
}

#[cfg(test)]
mod tests;

//! The Ping protocol of Blue Robotics and Cerulean: the Omniscan 450 and the Surveyor 240.
//!
//! - [`Device`]: what a device is and how it was told to ping; shared by its emitter and its clients' sessions
//! - [`PingEmitter`]: a ping to frames
//! - [`session`]: the commands
//!
//! What the definitions leave open, and what we made of it: gain indices run evenly over the sonar's own limits of gain; `timestamp_ms` counts
//! from when the output was opened; results are dB re 1 uV (rms) at the receiver, each the mean power of its stretch of range, scaled between
//! the loudest of the ping and [`RANGE_OF_RESULTS_DB`] below it; angles of points are positive to port, as the device's axes are.

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
use echotank_core::flow::{Datagram, Line, PingOutput, PingPlan, Side};
use echotank_core::time::UtcNs;

/// What 16 bits of a result span at most, dB.
const RANGE_OF_RESULTS_DB: f64 = 100.0;
/// dB re 1 uV of 1 V.
const VOLT_IN_MICROVOLT_DB: f64 = 120.0;
/// The Omniscan's highest gain index, and the Surveyor's.
const GAIN_STEPS: f64 = 7.0;
const GAIN_PERCENT: f64 = 100.0;
/// Frames are signed with the device's identifier.
const FIRST_DEVICE_ID: u8 = 1;

/// A device, to its clients.
pub struct Device {
    pub spec: PingProtocolSpec,
    pub sonar: SonarSpec,
    pub sound_speed_m_per_s: f64,
    /// When it was switched on, rig time.
    power_up: UtcNs,
    told: Mutex<Told>,
}

/// How it was told to ping, beyond the sonar's settings.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Told {
    pub start_m: f64,
    pub num_results: u16,
    pub sync: SyncChannel,
    pub wants_atof: bool,
    pub wants_yz: bool,
    pub device_id: u8,
}

impl Device {
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
            told: Mutex::new(Told {
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

    pub fn told(&self) -> Told {
        *self.lock()
    }

    fn lock(&self) -> MutexGuard<'_, Told> {
        // Each field is written whole.
        self.told.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn uptime_ms(&self, utc: UtcNs) -> u32 {
        // Counts around after 49 days, as the field does.
        ((utc.0 - self.power_up.0) / 1_000_000) as u32
    }
}

/// Turns pings into the frames of one device. One thread's.
pub struct PingEmitter {
    device: Arc<Device>,
    pools: [DatagramPool; 4],
    results_db: Vec<f64>,
    results: Vec<u16>,
    points: Vec<AtofPoint>,
    yz: Vec<[f32; 2]>,
}

/// What a device sends of a ping, in this order.
const PER_PING: [u16; 4] = [
    message_id::OS_MONO_PROFILE,
    message_id::ATTITUDE_REPORT,
    message_id::ATOF_POINT_DATA,
    message_id::YZ_POINT_DATA,
];

impl PingEmitter {
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
                let told = self.device.told();
                into.push(self.attitude(plan, &told));
                if told.wants_atof {
                    into.push(self.atof(plan, output, &told));
                }
                if told.wants_yz {
                    into.push(self.yz(plan, output, &told));
                }
            }
        }
    }

    /// 2198
    fn profile(&mut self, plan: &PingPlan, line: &Line, side: Side) -> Arc<Datagram> {
        let device = Arc::clone(&self.device);
        let told = device.told();
        let range_m = plan.settings.range_m;
        let start_m = told.start_m.min(0.95 * range_m);
        let length_m = range_m - start_m;
        let samples_per_m = 2.0 * device.sonar.receiver.sample_rate_hz / plan.sound_speed_m_per_s;
        let count = usize::from(told.num_results);
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
            // From 0 at power-up.
            ping_number: plan.ping_number.wrapping_sub(1),
            start_mm: (start_m * 1e3).round() as u32,
            length_mm: (length_m * 1e3).round() as u32,
            timestamp_ms: device.uptime_ms(plan.transmit_utc),
            ping_hz: plan.pulse.center_frequency_hz.round() as u32,
            gain_index: (part_of(limits.gain_db, plan.settings.gain_db) * GAIN_STEPS).round()
                as u16,
            num_results: 0,
            sos_dmps: (plan.sound_speed_m_per_s * 10.0).round() as u16,
            channel_number: told.sync.channel_number,
            pulse_duration_s: plan.pulse.duration_s as f32,
            analog_gain: 10f64.powf(plan.settings.gain_db / 20.0) as f32,
            max_pwr_db: max_db,
            min_pwr_db: min_db,
            transducer_heading_deg: (heading_deg + across_deg).rem_euclid(360.0) as f32,
            vehicle_heading_deg: heading_deg.rem_euclid(360.0) as f32,
        };
        let results = &self.results;
        self.pools[0].write(|buf| {
            emit_2198(buf, told.device_id, 0, &head, results);
        })
    }

    /// 504
    fn attitude(&mut self, plan: &PingPlan, told: &Told) -> Arc<Datagram> {
        let report = AttitudeReport {
            up: up(plan),
            utc_msec: utc_ms(plan),
            pwr_up_msec: self.device.uptime_ms(plan.transmit_utc),
        };
        self.pools[1].write(|buf| {
            report.emit_frame(buf, told.device_id, 0);
        })
    }

    /// 3012
    fn atof(&mut self, plan: &PingPlan, output: &PingOutput, told: &Told) -> Arc<Datagram> {
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
        self.pools[2].write(|buf| {
            emit_3012(buf, told.device_id, 0, &head, points);
        })
    }

    /// 3011
    fn yz(&mut self, plan: &PingPlan, output: &PingOutput, told: &Told) -> Arc<Datagram> {
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
            // No sensors.
            water_c: -1000.0,
            water_bar: -1000.0,
            heave_m: -plan.nav.heave_down_m as f32,
            start_m: told.start_m as f32,
            end_m: plan.settings.range_m as f32,
            num_points: 0,
        };
        let points = &self.yz;
        self.pools[3].write(|buf| {
            emit_3011(buf, told.device_id, 0, &head, points);
        })
    }
}

/// Of the ping, milliseconds since 1970.
fn utc_ms(plan: &PingPlan) -> u64 {
    (plan.stamp_utc.0.max(0) / 1_000_000) as u64
}

/// Our roll is positive starboard down, which is port up.
fn up(plan: &PingPlan) -> [f32; 3] {
    AttitudeReport::up_from(plan.nav.roll_rad, plan.nav.pitch_rad)
}

/// dB re 1 uV of the mean power of `count` stretches of a line, each `width` samples long, from sample `first` on. A stretch between two
/// samples is read between them; nothing is beyond the line's end.
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

/// What 0 and 65535 stand for: the quietest, but not too far below the loudest, and the loudest.
fn scale(results_db: &[f64]) -> (f32, f32) {
    let finite = || results_db.iter().copied().filter(|db| db.is_finite());
    let max = finite().fold(f64::NEG_INFINITY, f64::max);
    if !max.is_finite() {
        return (0.0, 1.0);
    }
    let min = finite().fold(max, f64::min).max(max - RANGE_OF_RESULTS_DB);
    // A line of one level has to have a scale too.
    (min.min(max - 1.0) as f32, max as f32)
}

#[cfg(test)]
mod tests;

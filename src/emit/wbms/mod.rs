//! NORBIT WBMS: bathymetry, water column, side-scan and snippets of a ping, and the text control.
//!
//! - [`Device`]: what the sonar is and how it was told to work; shared by the emitter and the control's clients
//! - [`WbmsEmitter`]: a ping to packets
//! - [`control`]: the text commands
//!
//! Angles are positive to starboard, beam 0 is port-most. Samples are i16 on a fixed scale (`receiver.full_scale_v` is 32767), and the header's
//! gain is 1. Sample numbers count from the start of the pulse at the receiver's rate. Not modelled: gates (stated as the range), the voltage.

pub mod control;

use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use echotank_protocols::wbms::{
    BackscatterHead, BathymetryHead, Detection as WireDetection, Tail, emit_backscatter,
    emit_bathymetry, packet_type,
};
use num_complex::Complex64;

use crate::elements::counts;
use crate::pool::DatagramPool;
use echotank_config::spec::{BeamSpacing, SonarSpec};
use echotank_core::flow::{
    BeamFrame, Datagram, Detection, Line, PingOutput, PingPlan, Side, Sounding,
};
use echotank_core::time::UtcNs;

/// Samples of a snippet before and after its detection.
const SNIPPET_HALF: usize = 16;
const SNIPPET_SAMPLES: usize = 2 * SNIPPET_HALF + 1;

/// A sonar, to its clients.
pub struct Device {
    pub sonar: SonarSpec,
    pub sound_speed_m_per_s: f64,
    told: Mutex<Told>,
}

/// How it was told to work, beyond the sonar's settings.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Told {
    pub start_m: f64,
    /// Side-scan on the fourth port; snippets otherwise.
    pub(crate) sidescan_mode: u8,
    /// -1 with every ping, 0 none.
    pub(crate) snippet_rate_hz: f64,
    pub(crate) water_column_rate_hz: f64,
}

impl Device {
    pub fn new(sonar: &SonarSpec, sound_speed_m_per_s: f64) -> Self {
        let told = Told::of(sonar);
        Self {
            sonar: sonar.clone(),
            sound_speed_m_per_s,
            told: Mutex::new(told),
        }
    }

    pub fn told(&self) -> Told {
        *self.lock()
    }

    fn lock(&self) -> MutexGuard<'_, Told> {
        // Each field is written whole.
        self.told.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Told {
    /// As the sonar starts.
    fn of(sonar: &SonarSpec) -> Self {
        Self {
            start_m: 0.0,
            sidescan_mode: u8::from(!sonar.beams.lines.is_empty()),
            snippet_rate_hz: -1.0,
            water_column_rate_hz: -1.0,
        }
    }
}

/// Which packets somebody wants.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Wanted {
    pub bathymetry: bool,
    pub water_column: bool,
    /// Side-scan or snippets.
    pub side_scan: bool,
}

/// Turns pings into packets. One thread's.
pub struct WbmsEmitter {
    device: Arc<Device>,
    pools: [DatagramPool; 3],
    detections: Vec<WireDetection>,
    samples: Vec<i16>,
    angles: Vec<f32>,
    starts: Vec<u16>,
    centres: Vec<u16>,
    last_snippets: Option<UtcNs>,
    last_water_column: Option<UtcNs>,
    saturated: u64,
}

impl WbmsEmitter {
    pub fn new(device: Arc<Device>, waiting_pings: usize) -> Self {
        let pool = |record_type| DatagramPool::new(record_type, waiting_pings + 1);
        Self {
            device,
            pools: [
                pool(packet_type::BATHYMETRY),
                pool(packet_type::WATER_COLUMN),
                pool(packet_type::SIDE_SCAN),
            ],
            detections: Vec::new(),
            samples: Vec::new(),
            angles: Vec::new(),
            starts: Vec::new(),
            centres: Vec::new(),
            last_snippets: None,
            last_water_column: None,
            saturated: 0,
        }
    }

    /// Values that did not fit, since the start.
    pub fn saturated(&self) -> u64 {
        self.saturated
    }

    /// Appends the packets of one ping that are wanted and that it has: by [`Datagram::record_type`] 1, 2, and 5 for both side-scan and snippets,
    /// which share a port.
    pub fn emit_ping(
        &mut self,
        plan: &PingPlan,
        output: &PingOutput,
        wanted: Wanted,
        into: &mut Vec<Arc<Datagram>>,
    ) {
        let told = self.device.told();
        if wanted.bathymetry && self.device.sonar.beams.fan.is_some() {
            into.push(self.bathymetry(plan, &output.soundings, &told));
        }
        if let (true, Some(fan)) = (wanted.water_column, output.beams.first())
            && is_time(plan, told.water_column_rate_hz, &mut self.last_water_column)
        {
            into.push(self.water_column(plan, fan));
        }
        if !wanted.side_scan {
            return;
        }
        if told.sidescan_mode != 0 && !output.lines.is_empty() {
            into.push(self.side_scan(plan, &output.lines));
        } else if let Some(fan) = output.beams.first()
            && is_time(plan, told.snippet_rate_hz, &mut self.last_snippets)
            && !output.soundings.is_empty()
        {
            into.push(self.snippets(plan, fan, &output.soundings));
        }
    }

    /// Type 1.
    fn bathymetry(
        &mut self,
        plan: &PingPlan,
        soundings: &[Sounding],
        told: &Told,
    ) -> Arc<Datagram> {
        let rate_hz = self.device.sonar.receiver.sample_rate_hz;
        let sample_of = |range_m: f64| {
            // The cast holds what the gates' 16 bits cannot count.
            (2.0 * range_m / plan.sound_speed_m_per_s * rate_hz).round() as u16
        };
        let (upper_gate, lower_gate) = (sample_of(told.start_m), sample_of(plan.settings.range_m));
        self.detections.clear();
        self.detections
            .extend(soundings.iter().map(|sounding| WireDetection {
                sample_number: (sounding.twtt_s * rate_hz).round() as u32,
                angle_rad: sounding.angle_rad as f32,
                upper_gate,
                lower_gate,
                intensity: sounding.level_v as f32,
                flags: match sounding.detection {
                    Detection::Amplitude => 1,
                    Detection::Phase => 2,
                },
                // Signal to noise, and colinearity.
                quality_flags: 3,
                quality: 3,
            }));
        let time_s = stamp_s(plan);
        let form = self.device.sonar.beams.fan.as_ref();
        let pulse = &plan.pulse;
        let head = BathymetryHead {
            sound_velocity_m_per_s: plan.sound_speed_m_per_s as f32,
            sample_rate_hz: rate_hz as f32,
            detections: 0,
            ping_number: plan.ping_number,
            time_s,
            time_net_s: time_s + plan.window_s(rate_hz),
            ping_rate_hz: plan.ping_rate_hz as f32,
            sub_type: 0,
            beam_distribution: match form.map(|fan| fan.form.spacing) {
                Some(BeamSpacing::EquiDistant) => 3,
                _ => 1,
            },
            sonar_mode: 1,
            time_uncertainty_s: 0.0,
            multiping: 0,
            multiping_sequence: 0,
            tx_angle_rad: 0.0,
            gain: 1.0,
            tx_frequency_hz: pulse.center_frequency_hz as f32,
            tx_bandwidth_hz: pulse.bandwidth_hz as f32,
            tx_length_s: pulse.duration_s as f32,
            sound_velocity_raw_m_per_s: plan.sound_speed_m_per_s as f32,
            tx_voltage: f32::NAN,
            swath_direction_rad: form.map_or(0.0, |fan| fan.form.center_rad) as f32,
            swath_opening_rad: form.map_or(0.0, |fan| fan.sector_rad) as f32,
            gate_tilt_rad: 0.0,
        };
        let detections = &self.detections;
        self.pools[0].write(|buf| {
            emit_bathymetry(buf, &head, detections);
        })
    }

    /// What the heads of types 2, 4 and 5 have in common.
    fn head(&self, plan: &PingPlan, first_sample: i32) -> BackscatterHead {
        let sonar = &self.device.sonar;
        let rate_hz = sonar.receiver.sample_rate_hz;
        let (pulse, fan) = (&plan.pulse, sonar.beams.fan.as_ref());
        let time_s = stamp_s(plan);
        let amplitude = control::amplitude_of(&sonar.limits, plan.settings.source_level_db);
        BackscatterHead {
            sound_velocity_m_per_s: plan.sound_speed_m_per_s as f32,
            sample_rate_hz: rate_hz as f32,
            time_s,
            t0_samples: first_sample,
            gain: 1.0,
            swath_direction_rad: fan.map_or(0.0, |fan| fan.form.center_rad) as f32,
            swath_opening_rad: fan.map_or(0.0, |fan| fan.sector_rad) as f32,
            tx_frequency_hz: pulse.center_frequency_hz as f32,
            tx_bandwidth_hz: pulse.bandwidth_hz as f32,
            tx_length_s: pulse.duration_s as f32,
            tx_amplitude: u32::from(amplitude),
            ping_rate_hz: plan.ping_rate_hz as f32,
            ping_number: plan.ping_number,
            time_net_s: time_s + plan.window_s(rate_hz),
            beams_of_former: fan.map_or(2, |fan| fan.beams) as u32,
            vga_g0_db: plan.settings.gain_db as f32,
            vga_t1: plan.sample_count as i32,
            vga_g1_db: plan.settings.gain_db as f32,
            beam_distribution: 1,
            sonar_mode: 1,
            ..BackscatterHead::default()
        }
    }

    /// The number of a ping's first sample, from the start of the pulse.
    fn first_sample(&self, plan: &PingPlan) -> i32 {
        (plan.first_sample_s * self.device.sonar.receiver.sample_rate_hz).round() as i32
    }

    /// Type 2.
    fn water_column(&mut self, plan: &PingPlan, fan: &BeamFrame) -> Arc<Datagram> {
        let full_scale_v = self.device.sonar.receiver.full_scale_v;
        self.samples.clear();
        self.samples.resize(fan.beams * fan.samples, 0);
        let mut saturated = 0;
        for beam in 0..fan.beams {
            let column = self.samples.iter_mut().skip(beam).step_by(fan.beams);
            for (out, v) in column.zip(fan.beam(beam)) {
                *out = magnitude(*v, full_scale_v, &mut saturated);
            }
        }
        self.saturated += saturated;
        self.angles.clear();
        self.angles
            .extend(fan.angle_rad.iter().map(|&angle| angle as f32));
        let head = self.head(plan, self.first_sample(plan));
        let (samples, angles_rad) = (&self.samples, &self.angles[..]);
        self.pools[1].write(|buf| {
            emit_backscatter(buf, &head, samples, Tail::WaterColumn { angles_rad });
        })
    }

    /// Type 5. A side that is not there is silent.
    fn side_scan(&mut self, plan: &PingPlan, lines: &[Line]) -> Arc<Datagram> {
        let full_scale_v = self.device.sonar.receiver.full_scale_v;
        let len = lines.iter().map(|line| line.amplitude.len()).max();
        self.samples.clear();
        self.samples.resize(2 * len.unwrap_or(0), 0);
        for line in lines {
            let column = match line.side {
                Side::Port => 0,
                Side::Starboard => 1,
            };
            let into = self.samples.iter_mut().skip(column).step_by(2);
            for (out, &v) in into.zip(&line.amplitude) {
                let (value, held) = counts(f64::from(v) / full_scale_v);
                self.saturated += u64::from(held);
                *out = value;
            }
        }
        let head = self.head(plan, 0);
        let samples = &self.samples;
        self.pools[2].write(|buf| {
            emit_backscatter(buf, &head, samples, Tail::SideScan);
        })
    }

    /// Type 4: the same number of samples around every detection.
    fn snippets(
        &mut self,
        plan: &PingPlan,
        fan: &BeamFrame,
        soundings: &[Sounding],
    ) -> Arc<Datagram> {
        let (rate_hz, full_scale_v) = {
            let receiver = &self.device.sonar.receiver;
            (receiver.sample_rate_hz, receiver.full_scale_v)
        };
        let first = self.first_sample(plan).max(0) as usize;
        let count = soundings.len();
        self.samples.clear();
        self.samples.resize(count * SNIPPET_SAMPLES, 0);
        self.angles.clear();
        self.starts.clear();
        self.centres.clear();
        let mut saturated = 0;
        for (n, sounding) in soundings.iter().enumerate() {
            let centre = (sounding.twtt_s * rate_hz).round().max(0.0) as usize;
            let start = centre.saturating_sub(SNIPPET_HALF);
            for m in 0..SNIPPET_SAMPLES {
                // Before the first sample and behind the last there is nothing.
                let sample = (start + m).checked_sub(first);
                if let Some(v) = sample.and_then(|k| fan.beam(sounding.beam).get(k)) {
                    self.samples[m * count + n] = magnitude(*v, full_scale_v, &mut saturated);
                }
            }
            self.angles.push(sounding.angle_rad as f32);
            self.starts.push(u16::try_from(start).unwrap_or(u16::MAX));
            self.centres.push(u16::try_from(centre).unwrap_or(u16::MAX));
        }
        self.saturated += saturated;
        let head = self.head(plan, self.first_sample(plan));
        let tail = Tail::Snippets {
            angles_rad: &self.angles,
            start_samples: &self.starts,
            detection_samples: &self.centres,
        };
        let samples = &self.samples;
        self.pools[2].write(|buf| {
            emit_backscatter(buf, &head, samples, tail);
        })
    }
}

/// Whether a ping's packet goes out at a rate: -1 with every ping, 0 never.
fn is_time(plan: &PingPlan, rate_hz: f64, last: &mut Option<UtcNs>) -> bool {
    let is_time = match *last {
        _ if rate_hz == 0.0 => false,
        Some(last) if rate_hz > 0.0 => plan.transmit_utc.seconds_since(last) * rate_hz >= 1.0,
        _ => true,
    };
    if is_time {
        *last = Some(plan.transmit_utc);
    }
    is_time
}

/// Of the ping, seconds since 1970.
fn stamp_s(plan: &PingPlan) -> f64 {
    plan.stamp_utc.0 as f64 * 1e-9
}

fn magnitude(v: Complex64, full_scale_v: f64, saturated: &mut u64) -> i16 {
    let (value, held) = counts(v.norm() / full_scale_v);
    *saturated += u64::from(held);
    value
}

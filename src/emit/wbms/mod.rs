//! NORBIT WBMS: bathymetry, water column, side-scan and snippet packets of a ping, and the text control protocol.
//!
//! - [`Device`]: the sonar and its requested settings; shared by the emitter and the control clients
//! - [`WbmsEmitter`]: converts a ping into packets
//! - [`control`]: processes text commands
//!
//! Angles are positive to starboard; beam 0 is the most port beam. Samples are i16 on a fixed scale (`receiver.full_scale_v` is
//! 32767), and the gain in the header is 1. Sample numbers count from the start of the pulse at the rate of the receiver. Not
//! modelled: gates (reported as the range) and the transmitter voltage.

pub mod control;

use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use echotank_protocols::wbms::{
    BackscatterHead, BathymetryHead, Detection as WireDetection, Tail, emit_backscatter,
    emit_backscatter_beam_major, emit_bathymetry, packet_type,
};
use num_complex::Complex32;

use crate::elements::counts;
use crate::pool::DatagramPool;
use crate::sevenk::quantise::{self, IQ_FULL_SCALE};
use echotank_config::spec::{BeamSpacing, SonarSpec};
use echotank_core::ping::{BeamFrame, Detection, Line, PingOutput, PingPlan, Side, Sounding};
use echotank_core::records::Datagram;
use echotank_core::simd::widest;
use echotank_core::time::UtcNs;

/// Number of snippet samples on each side of a detection.
const SNIPPET_HALF: usize = 16;
const SNIPPET_SAMPLES: usize = 2 * SNIPPET_HALF + 1;

/// Simulated sonar with its requested settings, shared by the emitter and the control sessions.
pub struct Device {
    /// Sonar that the device simulates.
    pub sonar: SonarSpec,
    /// Current sound speed, metres per second.
    pub sound_speed_m_per_s: f64,
    requested: Mutex<RequestedSettings>,
}

/// Client settings that are not part of the settings of the sonar.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct RequestedSettings {
    /// Start of the range gate, metres of slant range.
    pub start_m: f64,
    /// Content of the fourth port: side-scan if not 0, otherwise snippets.
    pub(crate) sidescan_mode: u8,
    /// Maximum rate of snippets, hertz: -1 with every ping, 0 never.
    pub(crate) snippet_rate_hz: f64,
    pub(crate) water_column_rate_hz: f64,
}

impl Device {
    /// Sonar with its initial settings.
    pub fn new(sonar: &SonarSpec, sound_speed_m_per_s: f64) -> Self {
        let requested = RequestedSettings::of(sonar);
        Self {
            sonar: sonar.clone(),
            sound_speed_m_per_s,
            requested: Mutex::new(requested),
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
}

impl RequestedSettings {
    /// Initial requested settings.
    fn of(sonar: &SonarSpec) -> Self {
        Self {
            start_m: 0.0,
            sidescan_mode: u8::from(!sonar.beams.lines.is_empty()),
            snippet_rate_hz: -1.0,
            water_column_rate_hz: -1.0,
        }
    }
}

/// Types of packets that have a subscriber.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct SubscribedPackets {
    /// Detections of the fan.
    pub bathymetry: bool,
    /// Magnitudes of all beams.
    pub water_column: bool,
    /// Side-scan lines or snippets.
    pub side_scan: bool,
}

/// Converter of pings into packets. It serves one thread.
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
    /// `waiting_pings` is the number of pings with packets in queues for which buffers are reused.
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

    /// Number of clipped values since the start.
    pub fn saturated(&self) -> u64 {
        self.saturated
    }

    /// Appends the wanted packets that this ping has data for. [`Datagram::record_type`] is 1 for bathymetry and 2 for the water
    /// column. It is 5 for both side-scan and snippets, which share a port.
    pub fn emit_ping(
        &mut self,
        plan: &PingPlan,
        output: &PingOutput,
        wanted: SubscribedPackets,
        into: &mut Vec<Arc<Datagram>>,
    ) {
        let requested = self.device.requested();
        if wanted.bathymetry && self.device.sonar.beams.fan.is_some() {
            into.push(self.bathymetry(plan, &output.soundings, &requested));
        }
        if let (true, Some(fan)) = (wanted.water_column, output.beams.first())
            && is_time(
                plan,
                requested.water_column_rate_hz,
                &mut self.last_water_column,
            )
        {
            into.push(self.water_column(plan, fan));
        }
        if !wanted.side_scan {
            return;
        }
        if requested.sidescan_mode != 0 && !output.lines.is_empty() {
            into.push(self.side_scan(plan, &output.lines));
        } else if let Some(fan) = output.beams.first()
            && is_time(plan, requested.snippet_rate_hz, &mut self.last_snippets)
            && !output.soundings.is_empty()
        {
            into.push(self.snippets(plan, fan, &output.soundings));
        }
    }

    /// Packet type 1 (bathymetry).
    fn bathymetry(
        &mut self,
        plan: &PingPlan,
        soundings: &[Sounding],
        requested: &RequestedSettings,
    ) -> Arc<Datagram> {
        let rate_hz = self.device.sonar.receiver.sample_rate_hz;
        let sample_of = |range_m: f64| {
            // The cast clamps values that exceed the 16 bits of the gates.
            (2.0 * range_m / plan.sound_speed_m_per_s * rate_hz).round() as u16
        };
        let (upper_gate, lower_gate) = (
            sample_of(requested.start_m),
            sample_of(plan.settings.range_m),
        );
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
                // Signal-to-noise ratio and colinearity are good.
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
        self.pools[0].write(|buf| emit_bathymetry(buf, &head, detections))
    }

    /// Header fields common to types 2, 4 and 5.
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

    /// Number of a ping's first sample, counted from the start of the pulse.
    fn first_sample(&self, plan: &PingPlan) -> i32 {
        (plan.first_sample_s * self.device.sonar.receiver.sample_rate_hz).round() as i32
    }

    /// Packet type 2 (water column).
    fn water_column(&mut self, plan: &PingPlan, fan: &BeamFrame) -> Arc<Datagram> {
        let counts_per_v = (IQ_FULL_SCALE / self.device.sonar.receiver.full_scale_v) as f32;
        self.samples.resize(fan.iq.len(), 0);
        let samples = &mut self.samples;
        self.saturated += widest(
            #[inline(always)]
            move || {
                let mut saturated = 0;
                for (out, v) in samples.iter_mut().zip(&fan.iq) {
                    *out = magnitude(*v, counts_per_v, &mut saturated);
                }
                saturated
            },
        );
        self.angles.clear();
        self.angles
            .extend(fan.angle_rad.iter().map(|&angle| angle as f32));
        let head = self.head(plan, self.first_sample(plan));
        let (samples, angles_rad) = (&self.samples, &self.angles[..]);
        self.pools[1].write(|buf| {
            let tail = Tail::WaterColumn { angles_rad };
            emit_backscatter_beam_major(buf, &head, samples, tail);
        })
    }

    /// Packet type 5 (side-scan). A missing side is filled with zeros.
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
        self.pools[2].write(|buf| emit_backscatter(buf, &head, samples, Tail::SideScan))
    }

    /// Packet type 4 (snippets), with the same number of samples around every detection.
    fn snippets(
        &mut self,
        plan: &PingPlan,
        fan: &BeamFrame,
        soundings: &[Sounding],
    ) -> Arc<Datagram> {
        let receiver = &self.device.sonar.receiver;
        let (rate_hz, counts_per_v) = (
            receiver.sample_rate_hz,
            (IQ_FULL_SCALE / receiver.full_scale_v) as f32,
        );
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
                // Samples outside the record stay zero.
                let sample = (start + m).checked_sub(first);
                if let Some(v) = sample.and_then(|k| fan.beam(sounding.beam).get(k)) {
                    self.samples[m * count + n] = magnitude(*v, counts_per_v, &mut saturated);
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
        self.pools[2].write(|buf| emit_backscatter(buf, &head, samples, tail))
    }
}

/// True if a packet is due with this ping at the given rate, hertz: -1 with every ping, 0 never.
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

/// Time of the ping, seconds since 1970.
fn stamp_s(plan: &PingPlan) -> f64 {
    plan.stamp_utc.0 as f64 * 1e-9
}

#[inline(always)]
fn magnitude(v: Complex32, counts_per_v: f32, saturated: &mut u64) -> i16 {
    // Scaled first: squares of weak volts are too small for single precision.
    let (re, im) = (v.re * counts_per_v, v.im * counts_per_v);
    let (value, held) = quantise::magnitude((re * re + im * im).sqrt(), IQ_FULL_SCALE);
    *saturated += u64::from(held);
    value as i16
}

//! EdgeTech JSF messages of a ping, and the sessions of the command and data connections.
//!
//! - [`JsfEmitter`]: converts a ping's plan and output into messages 80, 2002, 2020, 2060, 2080, 2091
//! - [`JsfSheet`]: properties of the sonar for JSF clients
//! - [`session`]: commands in, answers out
//!
//! A message 80 carries one channel: a side (0 port, 1 starboard) or an element. Its samples are block floating point, so none is
//! clipped. The error is at most 2^-15 of the largest sample of the message. Times are those of the start of the pulse. Depth and
//! altitude are those of the sonar ([`SensorState`](echotank_core::ping::SensorState)). The altitude comes from the scene and is
//! not detected in the echo. If a ping has several pulses, each pulse is a subsystem. Subsystem numbers increase from that of the
//! sonar's own pulse, as for EdgeTech's frequencies. Not modelled: pulse files, the clock of the sonar, coupled subsystems.

pub mod session;

use std::f64::consts::PI;
use std::fmt::Write;
use std::sync::Arc;

use num_complex::Complex64;

use echotank_protocols::calendar::DateTime;
use echotank_protocols::jsf::block_float;
use echotank_protocols::jsf::control::system_type;
use echotank_protocols::jsf::sensors::SensorTime;
use echotank_protocols::jsf::sonar_data::validity;
use echotank_protocols::jsf::{
    DataFormat, Dvl2080, FileTime426, Nmea2002, PitchRoll2020, Pressure2060, Situation2091,
    SonarDataHeader, SystemInformation182, emit_80, message_type,
};

use echotank_config::spec::{JsfChannels, JsfFormat, JsfSpec, SonarSpec};
use echotank_core::navigation::NavState;
use echotank_core::ping::{Line, PingOutput, PingPlan, Side};
use echotank_core::pulse::{Pulse, PulseKind};
use echotank_core::records::Datagram;
use echotank_core::time::{NS_PER_S, UtcNs};

/// Pressure of a metre of sea water in thousandths of a pound per square inch: 1025 kg/m^3 x 9.81 m/s^2 over 6.894757 Pa.
const MPSI_PER_M: f64 = 1025.0 * 9.81 / 6.894_757;
/// One atmosphere in the same unit; pressures are absolute.
const SURFACE_MPSI: f64 = 14_695.9;
/// Counts of pitch and roll per radian.
const TILT_COUNTS_PER_RAD: f64 = 32_768.0 / PI;
/// Unit of angular rates: 500 x 1.5 / 32768 deg/s.
const RATE_STEP_RAD_PER_S: f64 = 500.0 * 1.5 / 32_768.0 * PI / 180.0;
/// Annotation text in the pings.
const ANNOTATION: [u8; 24] = *b"ECHOTANK SIMULATION\0\0\0\0\0";
const SOFTWARE_VERSION: [u8; 6] = *b"ETANK\0";

/// Matched filter that acts on a row of samples in place.
pub type RowFilter = Box<dyn FnMut(&PingPlan, &mut [Complex64]) + Send>;

/// [`Datagram::record_type`] of a message, from its type, subsystem and channel.
pub fn record_type(message_type: u16, subsystem: u8, channel: u8) -> u32 {
    u32::from(message_type) | u32::from(subsystem) << 16 | u32::from(channel) << 24
}

/// Properties of one sonar for JSF clients, constant during a run.
#[derive(Clone, Debug)]
pub struct JsfSheet {
    /// Configuration of the output.
    pub output: JsfSpec,
    /// Sonar that the output represents.
    pub sonar: SonarSpec,
}

impl JsfSheet {
    /// Number of channels of messages 80, at most 256.
    pub fn channels(&self) -> usize {
        match self.output.channels {
            JsfChannels::Sides => self.sonar.beams.lines.len(),
            JsfChannels::Staves => self
                .output
                .arrays
                .iter()
                .map(|&array| self.sonar.receive[array].elements)
                .sum(),
        }
    }

    /// Subsystems that send data: the sonar's own and, for side-scan lines, one per further pulse.
    pub fn subsystems(&self) -> impl Iterator<Item = u8> {
        let own = self.output.subsystem;
        let further = match (self.output.channels, self.output.format) {
            (JsfChannels::Sides, JsfFormat::Envelope) => self.sonar.more_pulses.len(),
            _ => 0,
        };
        (0..=further).map(move |pulse| own.wrapping_add(pulse as u8))
    }

    /// JSF code of the sonar type.
    pub fn system_type(&self) -> i32 {
        match self.output.channels {
            JsfChannels::Sides if self.subsystems().nth(1).is_some() => {
                system_type::DUAL_FREQUENCY_SIDE_SCAN
            }
            JsfChannels::Sides => system_type::SINGLE_FREQUENCY_SIDE_SCAN,
            JsfChannels::Staves => system_type::BATHYMETRIC_SINGLE_PULSE,
        }
    }

    /// Source level at full transmit gain, dB.
    fn full_level_db(&self) -> f64 {
        self.sonar.limits.source_level_db.1
    }

    /// Message 182 (system information) of the sonar.
    pub fn information(&self) -> Datagram {
        let mut bytes = Vec::new();
        SystemInformation182 {
            system_type: self.system_type(),
            low_rate_io: 0,
            software_version: 0,
            subsystems: (self.subsystems().count() + self.output.silent_subsystems.len()) as i32,
            serial_ports: 0,
            serial_number: (self.sonar.serial & 0x7FFF_FFFF) as i32,
        }
        .emit_message(&mut bytes);
        Datagram {
            record_type: record_type(message_type::SYSTEM_INFORMATION, 0, 0),
            bytes,
        }
    }

    /// The messages at the start of a file: 182 and 426.
    pub fn file_head(&self, now: UtcNs) -> Vec<u8> {
        let mut bytes = self.information().bytes;
        bytes.extend(file_time(now));
        bytes
    }
}

/// Message 426: time at which a file starts or ends.
pub fn file_time(now: UtcNs) -> Vec<u8> {
    let mut bytes = Vec::new();
    let time = SensorTime::from_utc_ns(now.0);
    FileTime426 { time }.emit_message(&mut bytes);
    bytes
}

/// Converter of pings into JSF messages. It owns its buffers and serves one thread.
pub struct JsfEmitter {
    sheet: Arc<JsfSheet>,
    /// Matched filter of the formats with filtered samples.
    filter: RowFilter,
    /// UTC second of the last ping.
    second: Option<i64>,
    row: Vec<Complex64>,
    floats: Vec<f32>,
    shorts: Vec<i16>,
}

impl JsfEmitter {
    /// `filter` compresses the rows of the formats that carry matched-filtered samples.
    pub fn new(sheet: Arc<JsfSheet>, filter: RowFilter) -> Self {
        Self {
            sheet,
            filter,
            second: None,
            row: Vec::new(),
            floats: Vec::new(),
            shorts: Vec::new(),
        }
    }

    /// Properties of the sonar.
    pub fn sheet(&self) -> &Arc<JsfSheet> {
        &self.sheet
    }

    /// Appends the messages of one ping: sensor messages, then message 80 for every channel of a subsystem for which `active` returns true.
    /// Returns the number of samples that were NaN or infinite.
    pub fn emit_ping(
        &mut self,
        plan: &PingPlan,
        output: &PingOutput,
        active: impl Fn(u8, u8) -> bool,
        into: &mut Vec<Arc<Datagram>>,
    ) -> u64 {
        let second = plan.stamp_utc.0.div_euclid(NS_PER_S);
        let is_new_second = self.second != Some(second);
        self.second = Some(second);
        sensors(plan, is_new_second, into);
        let sheet = Arc::clone(&self.sheet);
        let own = sheet.output.subsystem;
        let header = header(&sheet, plan, &plan.pulse, 0.0);
        let mut not_finite = 0;
        let mut channel: usize = 0;
        match sheet.output.channels {
            JsfChannels::Sides => {
                for line in &sheet.sonar.beams.lines {
                    let number = channel_of(line.side);
                    if active(own, number) {
                        not_finite +=
                            self.side(plan, output, line.side, line.array, number, header, into);
                    }
                }
                let pulses = sheet.sonar.more_pulses.iter().zip(&output.more_lines);
                for (subsystem, (more, made)) in sheet.subsystems().skip(1).zip(pulses) {
                    let pulse = Pulse {
                        duration_s: plan.pulse.duration_s,
                        ..more.pulse
                    };
                    let header = self::header(&sheet, plan, &pulse, made.delay_s);
                    for line in &made.lines {
                        let channel = channel_of(line.side);
                        if active(subsystem, channel) {
                            not_finite += self.line(line, (subsystem, channel), header, into);
                        }
                    }
                }
            }
            JsfChannels::Staves => {
                for &array in &sheet.output.arrays {
                    let Some(frame) = output.elements.iter().find(|f| f.array == array) else {
                        continue;
                    };
                    for e in 0..frame.elements {
                        // The configuration limits the number of channels to 256.
                        let number = channel as u8;
                        channel += 1;
                        if active(own, number) {
                            self.row.clear();
                            self.row.extend_from_slice(frame.element(e));
                            not_finite += self.row_message(plan, number, header, into);
                        }
                    }
                }
            }
        }
        not_finite
    }

    #[allow(clippy::too_many_arguments)] // called once, above
    fn side(
        &mut self,
        plan: &PingPlan,
        output: &PingOutput,
        side: Side,
        array: usize,
        number: u8,
        header: SonarDataHeader,
        into: &mut Vec<Arc<Datagram>>,
    ) -> u64 {
        if self.sheet.output.format == JsfFormat::Envelope {
            let Some(line) = output.lines.iter().find(|line| line.side == side) else {
                return 0;
            };
            let subsystem = self.sheet.output.subsystem;
            return self.line(line, (subsystem, number), header, into);
        }
        // The whole array is one hydrophone: the mean of its elements.
        let Some(frame) = output.elements.iter().find(|frame| frame.array == array) else {
            return 0;
        };
        self.row.clear();
        self.row.resize(frame.samples, Complex64::ZERO);
        let weight = 1.0 / frame.elements as f64;
        for e in 0..frame.elements {
            for (sum, sample) in self.row.iter_mut().zip(frame.element(e)) {
                *sum += sample * weight;
            }
        }
        self.row_message(plan, number, header, into)
    }

    /// Envelope of one side.
    fn line(
        &mut self,
        line: &Line,
        to: (u8, u8),
        header: SonarDataHeader,
        into: &mut Vec<Arc<Datagram>>,
    ) -> u64 {
        self.floats.clear();
        self.floats.extend_from_slice(&line.amplitude);
        // A line begins at the start of the pulse.
        let header = SonarDataHeader {
            starting_depth_samples: 0,
            ..header
        };
        self.message(to, header, DataFormat::Envelope, into)
    }

    /// Message 80 with `self.row` in the configured format.
    fn row_message(
        &mut self,
        plan: &PingPlan,
        number: u8,
        header: SonarDataHeader,
        into: &mut Vec<Arc<Datagram>>,
    ) -> u64 {
        let format = match self.sheet.output.format {
            JsfFormat::Envelope => DataFormat::Envelope,
            JsfFormat::Analytic => DataFormat::Analytic,
            JsfFormat::Unfiltered => DataFormat::AnalyticUnfiltered,
        };
        if format != DataFormat::AnalyticUnfiltered {
            (self.filter)(plan, &mut self.row);
        }
        self.floats.clear();
        if format == DataFormat::Envelope {
            self.floats.extend(self.row.iter().map(|v| v.norm() as f32));
        } else {
            self.floats
                .extend(self.row.iter().flat_map(|v| [v.re as f32, v.im as f32]));
        }
        let subsystem = self.sheet.output.subsystem;
        self.message((subsystem, number), header, format, into)
    }

    /// Message 80 of a subsystem's channel with the samples in `self.floats`.
    fn message(
        &mut self,
        (subsystem, channel): (u8, u8),
        mut header: SonarDataHeader,
        format: DataFormat,
        into: &mut Vec<Arc<Datagram>>,
    ) -> u64 {
        self.shorts.clear();
        let scaled = block_float::quantise(&self.floats, &mut self.shorts);
        header.data_format = format.code();
        header.weighting = scaled.weighting;
        header.adc_largest = scaled.largest;
        header.set_samples(self.shorts.len() / format.shorts_per_sample());
        push(into, message_type::SONAR_DATA, subsystem, channel, |buf| {
            emit_80(buf, subsystem, channel, &header, &self.shorts)
        });
        scaled.not_finite as u64
    }
}

fn push<R>(
    into: &mut Vec<Arc<Datagram>>,
    kind: u16,
    subsystem: u8,
    channel: u8,
    fill: impl FnOnce(&mut Vec<u8>) -> R,
) {
    let mut bytes = Vec::new();
    fill(&mut bytes);
    into.push(Arc::new(Datagram {
        record_type: record_type(kind, subsystem, channel),
        bytes,
    }));
}

fn channel_of(side: Side) -> u8 {
    match side {
        Side::Port => 0,
        Side::Starboard => 1,
    }
}

/// Header for a pulse that starts `late_s` after the sonar's own.
fn header(sheet: &JsfSheet, plan: &PingPlan, pulse: &Pulse, late_s: f64) -> SonarDataHeader {
    let rate_hz = sheet.sonar.receiver.sample_rate_hz;
    let nav = &plan.nav;
    let mut h = SonarDataHeader {
        starting_depth_samples: (plan.first_sample_s * rate_hz).round().max(0.0) as u32,
        ping_number: plan.ping_number,
        annotation: ANNOTATION,
        validity: validity::ANNOTATION,
        sample_interval_ns: (1e9 / rate_hz).round() as u32,
        adc_gain_factor: 10_f64
            .powf(plan.settings.gain_db / 20.0)
            .clamp(0.0, 65_535.0)
            .round() as u16,
        transmit_level_percent: (100.0
            * 10_f64.powf((plan.settings.source_level_db - sheet.full_level_db()) / 20.0))
        .round()
        .clamp(0.0, 100.0) as i16,
        sample_frequency_hz: (rate_hz.round() as u64 % 65_536) as u16,
        software_version: SOFTWARE_VERSION,
        ..SonarDataHeader::default()
    };
    h.set_utc_ns(plan.stamp_utc.plus_s(late_s).0);
    let half = 0.5 * pulse.bandwidth_hz;
    let center = pulse.center_frequency_hz;
    let (start, end) = match pulse.kind {
        PulseKind::LfmUp => (center - half, center + half),
        PulseKind::LfmDown => (center + half, center - half),
        PulseKind::Cw => (center, center),
    };
    h.set_frequencies_hz(start, end);
    h.set_sweep_length_s(pulse.duration_s);
    h.set_position_rad(nav.latitude_rad, nav.longitude_rad);
    h.set_heading_rad(nav.heading_rad);
    h.set_pitch_roll_rad(nav.pitch_rad, nav.roll_rad);
    h.set_sound_speed_m_per_s(plan.sound_speed_m_per_s as f32);
    h.set_depth_m(plan.sensor.depth_m.max(0.0));
    let velocity = nav.pose.velocity_m_per_s;
    h.set_course_rad(course_rad(nav));
    h.set_speed_m_per_s(velocity.truncate().length());
    if let Some(altitude_m) = plan.sensor.altitude_m {
        h.set_altitude_m(altitude_m);
    }
    h
}

/// Messages 2020, 2060, 2080 and 2091 of one ping, from the navigation of the ping and the depth and altitude of the sonar. Message
/// 2002 precedes the first ping of every second.
fn sensors(plan: &PingPlan, is_new_second: bool, into: &mut Vec<Arc<Datagram>>) {
    const RAW: u8 = echotank_protocols::jsf::subsystem::RAW_SERIAL;
    const PARSED: u8 = echotank_protocols::jsf::subsystem::PARSED_SERIAL;
    let nav = &plan.nav;
    let after_transmit_ns = nav.utc.0.saturating_sub(plan.transmit_utc.0);
    let utc = plan.stamp_utc.plus_ns(after_transmit_ns);
    let time = SensorTime::from_utc_ns(utc.0);
    if is_new_second {
        let sentence = position_sentence(nav, utc);
        push(into, message_type::NMEA, RAW, 0, |buf| {
            Nmea2002 {
                time,
                source: 1,
                sentence: sentence.as_bytes(),
            }
            .emit_message(buf, 0);
        });
    }
    let body_from_world = nav.pose.world_from_body.inverse();
    let rate = body_from_world * nav.pose.angular_velocity_rad_per_s;
    let counts = |value: f64| value.round().clamp(-32_767.0, 32_767.0) as i16;
    let tilt = |rad: f64| counts(rad * TILT_COUNTS_PER_RAD);
    let heading_cdeg = (nav.heading_rad.to_degrees() * 100.0)
        .round()
        .rem_euclid(36_000.0) as u16;
    push(into, message_type::PITCH_ROLL, PARSED, 0, |buf| {
        PitchRoll2020 {
            time,
            rate: [rate.x, rate.y, rate.z].map(|r| counts(r / RATE_STEP_RAD_PER_S)),
            pitch: tilt(nav.pitch_rad),
            roll: tilt(nav.roll_rad),
            heave_down_mm: counts(nav.heave_down_m * 1e3),
            heading_cdeg,
            // Valid fields: rates, pitch, roll, heave, heading.
            validity: 0b11_1111_1000,
            ..PitchRoll2020::default()
        }
        .emit_message(buf, 0);
    });
    let depth = plan.sensor.depth_m.max(0.0);
    push(into, message_type::PRESSURE, PARSED, 0, |buf| {
        Pressure2060 {
            time,
            pressure_mpsi: (SURFACE_MPSI + depth * MPSI_PER_M).round() as i32,
            sound_velocity_mm_per_s: (plan.sound_speed_m_per_s * 1e3).round() as i32,
            depth_m: depth.round() as i32,
            // Valid fields: pressure, sound velocity, depth.
            validity: 0b11_0001,
            ..Pressure2060::default()
        }
        .emit_message(buf, 0);
    });
    let altitude = plan.sensor.altitude_m;
    let v = nav.pose.velocity_m_per_s;
    let v_body = body_from_world * v;
    push(into, message_type::DVL, PARSED, 0, |buf| {
        let distance_cm = altitude.map_or(0, |m| (m * 100.0).round() as i32);
        Dvl2080 {
            time,
            distance_cm: [distance_cm; 4],
            // Axes in this order: starboard, forward, up.
            velocity_mm_per_s: [v_body.y, v_body.x, -v_body.z].map(|v| counts(v * 1e3)),
            depth_dm: (depth * 10.0).round().min(65_535.0) as u16,
            pitch_cdeg: counts(nav.pitch_rad.to_degrees() * 100.0),
            roll_cdeg: counts(nav.roll_rad.to_degrees() * 100.0),
            heading_cdeg,
            sound_velocity_m_per_s: counts(plan.sound_speed_m_per_s),
            // Valid fields: velocities in ship axes, heading, pitch, roll, depth, sound velocity, and the altitude if known.
            validity: 0b1_0101_1100_0111 | u32::from(altitude.is_some()) << 5,
            ..Dvl2080::default()
        }
        .emit_message(buf, 0);
    });
    push(into, message_type::SITUATION, PARSED, 0, |buf| {
        Situation2091 {
            time,
            // Valid fields: all except the water temperature; the altitude only if known.
            validity: 0b1111_1110_1111 | u32::from(altitude.is_some()) << 4,
            velocity_axes: 0,
            source_time_100ns: (utc.0 / 100).max(0) as u64,
            latitude_deg: nav.latitude_rad.to_degrees(),
            longitude_deg: nav.longitude_rad.to_degrees(),
            depth_m: depth as f32,
            altitude_m: altitude.unwrap_or(0.0) as f32,
            heave_down_m: nav.heave_down_m as f32,
            velocity_1_m_per_s: v.x as f32,
            velocity_2_m_per_s: v.y as f32,
            velocity_down_m_per_s: v.z as f32,
            pitch_deg: nav.pitch_rad.to_degrees() as f32,
            roll_deg: nav.roll_rad.to_degrees() as f32,
            heading_deg: nav.heading_rad.to_degrees() as f32,
            sound_speed_m_per_s: plan.sound_speed_m_per_s as f32,
            water_temperature_c: 0.0,
        }
        .emit_message(buf, 0);
    });
}

/// Position, speed and course as an RMC sentence, with a resolution of 1e-5 minutes of arc (2 cm).
fn position_sentence(nav: &NavState, utc: UtcNs) -> String {
    let date_time = DateTime::from_utc_ns(utc.0);
    let parts = |rad: f64| {
        let hundred_thousandths = (rad.to_degrees().abs() * 60.0 * 1e5).round() as u64;
        (
            hundred_thousandths / 6_000_000,
            (hundred_thousandths % 6_000_000) as f64 / 1e5,
        )
    };
    let (lat_deg, lat_min) = parts(nav.latitude_rad);
    let (lon_deg, lon_min) = parts(nav.longitude_rad);
    let velocity = nav.pose.velocity_m_per_s;
    let mut text = format!(
        "GPRMC,{:02}{:02}{:02}.{:02},{},{lat_deg:02}{lat_min:08.5},{},{lon_deg:03}{lon_min:08.5},{},{:.2},{:.2},{:02}{:02}{:02},,,A",
        date_time.hour,
        date_time.minute,
        date_time.second,
        // Seconds are truncated, so 59.999 s does not round to the next minute.
        date_time.nanosecond / 10_000_000,
        if nav.invalid.position { 'V' } else { 'A' },
        if nav.latitude_rad < 0.0 { 'S' } else { 'N' },
        if nav.longitude_rad < 0.0 { 'W' } else { 'E' },
        velocity.truncate().length() * 3600.0 / 1852.0,
        course_rad(nav).to_degrees(),
        date_time.day,
        date_time.month,
        date_time.year.rem_euclid(100),
    );
    let checksum = text.bytes().fold(0, |sum, byte| sum ^ byte);
    text.insert(0, '$');
    // Writing to a String cannot fail.
    let _ = write!(text, "*{checksum:02X}");
    text
}

/// Course over ground, radians, 0 to 2 pi.
fn course_rad(nav: &NavState) -> f64 {
    let velocity = nav.pose.velocity_m_per_s;
    velocity.y.atan2(velocity.x).rem_euclid(2.0 * PI)
}

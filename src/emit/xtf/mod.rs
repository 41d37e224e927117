//! XTF packets of a ping: side-scan lines with navigation in their header, and attitude. XTF is written to files only.
//!
//! A sample is the envelope of a line. It is a u16 with the receiver's full scale as 65535 and clipped values counted, or an f32 in
//! volts. Sample 0 is the start of the pulse. If a ping has several pulses, each has its own channels ("port 2", ...), like a sonar
//! with two frequencies. A file has six channels, so pulses beyond the third (with two sides) are omitted. Not modelled: notes,
//! bathymetry, and a towed sensor apart from its ship (both have one position).

use echotank_protocols::xtf::file_header::MAX_CHANNELS;
use echotank_protocols::xtf::{
    Attitude, ChannelHeader, ChannelInfo, ChannelKind, FileHeader, NavUnits, PingHeader,
    SampleFormat, Samples, emit_ping,
};

use super::sevenk::quantise;
use echotank_config::spec::{LineSpec, SonarSpec, XtfSpec};
use echotank_core::arrays::Pattern;
use echotank_core::frames::angles_from_rotation;
use echotank_core::ping::{PingOutput, PingPlan, Side};
use echotank_core::pulse::Pulse;

const KNOTS_PER_M_PER_S: f64 = 3600.0 / 1852.0;

/// Converter of pings into XTF packets. It owns its buffers and serves one thread.
pub struct XtfEmitter {
    output: XtfSpec,
    sonar: SonarSpec,
    header: FileHeader,
    /// Integer samples by channel.
    scaled: Vec<Scaled>,
}

/// Integer samples of a channel.
#[derive(Clone, Debug, Default)]
struct Scaled {
    counts: Vec<u16>,
    /// Full scale of this ping, millivolts; 0 if it is that of the file header.
    millivolts: u16,
}

impl XtfEmitter {
    /// Emitter of a sonar with one or two side-scan lines (the configuration checks this). `sound_speed_m_per_s` determines the
    /// beam widths in the header.
    pub fn new(output: &XtfSpec, sonar: &SonarSpec, sound_speed_m_per_s: f64) -> Self {
        let format = if output.is_float {
            SampleFormat::F32
        } else {
            SampleFormat::U16
        };
        let pulses =
            std::iter::once(&sonar.pulse).chain(sonar.more_pulses.iter().map(|m| &m.pulse));
        let channels = (1..)
            .zip(pulses)
            .take(pulses_written(sonar))
            .flat_map(|(number, pulse)| {
                let lines = sonar.beams.lines.iter();
                lines.map(move |line| {
                    channel(sonar, line, (number, pulse), format, sound_speed_m_per_s)
                })
            });
        let header = FileHeader {
            program: "etank".into(),
            program_version: env!("CARGO_PKG_VERSION").into(),
            sonar_name: ascii(&sonar.name, 15),
            sonar_type: 0,
            note: "Simulated by Echotank".into(),
            file_name: String::new(),
            nav_units: NavUnits::LatitudeLongitude,
            nav_latency_ms: 0,
            channels: channels.collect(),
        };
        Self {
            scaled: vec![Scaled::default(); header.channels.len()],
            output: *output,
            sonar: sonar.clone(),
            header,
        }
    }

    /// The header at the start of a file.
    pub fn file_head(&self) -> Vec<u8> {
        let mut bytes = Vec::new();
        self.header.emit(&mut bytes);
        bytes
    }

    /// Appends the packets of one ping, if it has side-scan lines. Returns the number of clipped samples.
    pub fn emit_ping(&mut self, plan: &PingPlan, output: &PingOutput, buf: &mut Vec<u8>) -> u64 {
        let specs = &self.sonar.beams.lines;
        let pulses = pulses_written(&self.sonar);
        let of_each =
            std::iter::once(&output.lines).chain(output.more_lines.iter().map(|m| &m.lines));
        let found: Vec<_> = of_each
            .take(pulses)
            .flat_map(|made| {
                let lines = specs.iter();
                lines.filter_map(move |spec| made.iter().find(|line| line.side == spec.side))
            })
            .collect();
        if found.len() != self.header.channels.len() || found.is_empty() {
            return 0;
        }
        let nav = &plan.nav;
        let after_transmit_ns = nav.utc.0.saturating_sub(plan.transmit_utc.0);
        Attitude {
            utc_ns: plan.stamp_utc.plus_ns(after_transmit_ns).0,
            pitch_deg: nav.pitch_rad.to_degrees() as f32,
            roll_deg: nav.roll_rad.to_degrees() as f32,
            heave_up_m: -nav.heave_down_m as f32,
            heading_deg: nav.heading_rad.to_degrees() as f32,
        }
        .emit(buf);
        let rate_hz = self.sonar.receiver.sample_rate_hz;
        let mut saturated = 0;
        let full_scale_v = self.sonar.receiver.full_scale_v;
        for (scaled, line) in self.scaled.iter_mut().zip(&found) {
            scaled.counts.clear();
            scaled.millivolts = 0;
            if !self.output.is_float {
                let full_scale_mv = full_scale_millivolts(&line.amplitude, full_scale_v);
                scaled.millivolts = full_scale_mv.unwrap_or(0);
                let scale_v = full_scale_mv.map_or(full_scale_v, |mv| f64::from(mv) / 1e3);
                saturated += quantise::line(&line.amplitude, scale_v, &mut scaled.counts);
            }
        }
        let channels: Vec<_> = found
            .iter()
            .zip(&self.scaled)
            .enumerate()
            .map(|(index, (line, scaled))| {
                let pulse = match (index / specs.len()).checked_sub(1) {
                    None => &plan.pulse,
                    Some(more) => &self.sonar.more_pulses[more].pulse,
                };
                let duration_s = line.amplitude.len() as f64 / rate_hz;
                let header = ChannelHeader {
                    channel: index as u16,
                    slant_range_m: (0.5 * plan.sound_speed_m_per_s * duration_s) as f32,
                    time_duration_s: duration_s as f32,
                    seconds_per_ping: (1.0 / plan.ping_rate_hz) as f32,
                    frequency_khz: (pulse.center_frequency_hz / 1e3).round() as u16,
                    bandwidth_khz: (pulse.bandwidth_hz / 1e3).round() as u16,
                    millivolt_scale: scaled.millivolts,
                    ..ChannelHeader::default()
                };
                let samples = if self.output.is_float {
                    Samples::F32(&line.amplitude)
                } else {
                    Samples::U16(&scaled.counts)
                };
                (header, samples)
            })
            .collect();
        emit_ping(buf, &self.header, &ping_header(plan), &channels);
        saturated
    }
}

/// Full scale of a line that exceeds `full_scale_v`, millivolts. The scale is doubled until it holds the line or reaches the
/// maximum of the field. `None` if the line does not exceed the scale or no doubled scale fits the field.
fn full_scale_millivolts(line: &[f32], full_scale_v: f64) -> Option<u16> {
    let max_mv = f64::from(u16::MAX);
    let largest_mv = 1e3 * f64::from(line.iter().fold(0.0_f32, |largest, &v| largest.max(v)));
    let own_mv = 1e3 * full_scale_v;
    let mut double_mv = own_mv;
    while double_mv < largest_mv && 2.0 * double_mv <= max_mv {
        double_mv *= 2.0;
    }
    let is_larger = double_mv > own_mv;
    is_larger.then_some(double_mv.ceil() as u16)
}

/// Number of pulses per ping whose lines fit into the channels of a file.
fn pulses_written(sonar: &SonarSpec) -> usize {
    let fit = MAX_CHANNELS / sonar.beams.lines.len().max(1);
    fit.min(1 + sonar.more_pulses.len())
}

/// Channel of one line and one pulse; `number` counts pulses from 1.
fn channel(
    sonar: &SonarSpec,
    line: &LineSpec,
    (number, pulse): (usize, &Pulse),
    format: SampleFormat,
    sound_speed_m_per_s: f64,
) -> ChannelInfo {
    let wavelength_m = sound_speed_m_per_s / pulse.center_frequency_hz;
    let array = &sonar.receive[line.array];
    let p = array.mounting.position_m;
    let (_, pitch_rad, yaw_rad) = angles_from_rotation(array.mounting.body_from_array);
    let length_m = array.elements as f64 * array.spacing_m;
    let across_m = match array.element_pattern {
        Pattern::Rectangle { width_m, .. } | Pattern::Part { width_m, .. } => width_m,
        Pattern::Omnidirectional => 0.0,
    };
    // Beam width of 0.886 wavelengths per length; 0 without a length.
    let width_deg = |length_m: f64| {
        if length_m > 0.0 {
            (0.886 * wavelength_m / length_m).to_degrees().min(360.0) as f32
        } else {
            0.0
        }
    };
    let boresight = array.mounting.body_from_array * glam::DVec3::Z;
    let (kind, side) = match line.side {
        Side::Port => (ChannelKind::Port, "port"),
        Side::Starboard => (ChannelKind::Starboard, "starboard"),
    };
    ChannelInfo {
        kind,
        format,
        name: match number {
            1 => side.into(),
            more => format!("{side} {more}"),
        },
        frequency_khz: (pulse.center_frequency_hz / 1e3) as f32,
        horizontal_beam_deg: width_deg(length_m),
        // Tilt is positive down from the horizontal.
        tilt_deg: boresight.z.clamp(-1.0, 1.0).asin().to_degrees() as f32,
        beam_width_deg: width_deg(across_m),
        volt_scale: sonar.receiver.full_scale_v as f32,
        offset_m: [p.y as f32, p.x as f32, p.z as f32],
        offset_yaw_pitch_roll_deg: [
            yaw_rad.to_degrees() as f32,
            pitch_rad.to_degrees() as f32,
            0.0,
        ],
    }
}

fn ping_header(plan: &PingPlan) -> PingHeader {
    let (nav, sensor) = (&plan.nav, &plan.sensor);
    let speed_kn = nav.pose.velocity_m_per_s.truncate().length() * KNOTS_PER_M_PER_S;
    let (y_deg, x_deg) = (
        nav.latitude_rad.to_degrees(),
        nav.longitude_rad.to_degrees(),
    );
    let mut header = PingHeader {
        ping_number: plan.ping_number,
        event_number: plan.ping_number,
        sound_velocity_one_way_m_per_s: (0.5 * plan.sound_speed_m_per_s) as f32,
        computed_sound_velocity_m_per_s: plan.sound_speed_m_per_s as f32,
        ship_speed_kn: speed_kn as f32,
        sensor_speed_kn: speed_kn as f32,
        ship_gyro_deg: nav.heading_rad.to_degrees() as f32,
        sensor_heading_deg: nav.heading_rad.to_degrees() as f32,
        ship_y: y_deg,
        ship_x: x_deg,
        sensor_y: sensor.latitude_rad.to_degrees(),
        sensor_x: sensor.longitude_rad.to_degrees(),
        sensor_depth_m: sensor.depth_m.max(0.0) as f32,
        sensor_altitude_m: sensor.altitude_m.unwrap_or(0.0) as f32,
        sensor_pitch_deg: nav.pitch_rad.to_degrees() as f32,
        sensor_roll_deg: nav.roll_rad.to_degrees() as f32,
        heave_up_m: -nav.heave_down_m as f32,
        ..PingHeader::default()
    };
    header.set_utc_ns(plan.stamp_utc.0);
    header
}

fn ascii(text: &str, max_len: usize) -> String {
    text.chars()
        .filter(|c| c.is_ascii_graphic() || *c == ' ')
        .take(max_len)
        .collect()
}

//! Pings of protocol recordings: `.s7k`, `.jsf`, `.xtf` and `.svlog`.
//!
//! Each record adds what it holds to the ping of its number. Records that hold no samples, malformed records and further pulses of a ping are skipped.

use std::path::PathBuf;

use numpy::{Complex32, IntoPyArray};
use pyo3::prelude::*;
use pyo3::types::{PyDict, PyList};

use echotank_core::ping::{Detection, Side, Sounding};
use echotank_protocols::framing::{Framing, Splitter};
use echotank_protocols::jsf::{self, DataFormat, JsfFraming, SonarData80, message_type, subsystem};
use echotank_protocols::ping_protocol::{Frame, Message, PingFraming};
use echotank_protocols::sevenk::file::FileReader;
use echotank_protocols::sevenk::records::{
    BeamGeometry7004, Beamformed7018, PHASE_COUNTS_PER_RAD, RawDetections7027, RawIq7038,
    SideScan7007, SonarSettings7000,
};
use echotank_protocols::xtf::{self, ChannelKind, FileHeader, SampleFormat, XtfFraming};

use crate::errors::{Kind, error, released};
use crate::ping::{Soundings, rows, side_name};

/// Level of one volt, dB re 1 uV.
const VOLT_IN_MICROVOLT_DB: f64 = 120.0;

/// What a file holds of one ping.
#[derive(Default)]
struct FilePing {
    number: u32,
    utc_ns: Option<i64>,
    sample_rate_hz: f64,
    first_sample_s: f64,
    sound_speed_m_per_s: f64,
    /// Name, rows, samples of all rows.
    elements: Vec<(&'static str, usize, Vec<Complex32>)>,
    /// Beams, samples of all beams.
    beams: Option<(usize, Vec<Complex32>)>,
    beam_angle_rad: Vec<f64>,
    lines: Vec<(Side, Vec<f32>)>,
    soundings: Vec<Sounding>,
}

/// Pings in the order of their first records.
#[derive(Default)]
struct FilePings(Vec<FilePing>);

impl FilePings {
    fn of(&mut self, number: u32) -> &mut FilePing {
        // Records of a ping follow each other.
        let at = self.0.iter().rposition(|ping| ping.number == number);
        let at = at.unwrap_or_else(|| {
            self.0.push(FilePing {
                number,
                ..FilePing::default()
            });
            self.0.len() - 1
        });
        &mut self.0[at]
    }
}

/// Reads the pings of a recording of a protocol: dictionaries for `echotank._read`.
#[pyfunction]
pub(crate) fn read_records<'py>(
    py: Python<'py>,
    path: PathBuf,
    format: &str,
) -> PyResult<Bound<'py, PyList>> {
    let read = released(py, || {
        let bytes = std::fs::read(&path).map_err(|why| format!("cannot be read: {why}"))?;
        match format {
            "s7k" => Ok(of_s7k(&bytes)),
            "jsf" => Ok(of_jsf(&bytes)),
            "svlog" => Ok(of_svlog(&bytes)),
            _ => of_xtf(&bytes),
        }
    })?;
    let name = path.display();
    let FilePings(pings) =
        read.map_err(|why| error(py, Kind::Recording, format!("{name}: {why}")))?;
    if pings.is_empty() {
        let why = format!("{name}: holds no ping of format {format}");
        return Err(error(py, Kind::Recording, why));
    }
    let dicts = pings.into_iter().map(|ping| dictionary(py, ping));
    PyList::new(py, dicts.collect::<PyResult<Vec<_>>>()?)
}

fn dictionary(py: Python<'_>, ping: FilePing) -> PyResult<Bound<'_, PyDict>> {
    let dict = PyDict::new(py);
    dict.set_item("number", ping.number)?;
    dict.set_item("utc_ns", ping.utc_ns)?;
    dict.set_item("sample_rate_hz", ping.sample_rate_hz)?;
    dict.set_item("first_sample_s", ping.first_sample_s)?;
    dict.set_item("sound_speed_m_per_s", ping.sound_speed_m_per_s)?;
    let elements = PyDict::new(py);
    for (name, count, iq) in ping.elements {
        elements.set_item(name, rows(py, (count, iq.len() / count.max(1)), iq)?)?;
    }
    dict.set_item("elements", elements)?;
    let (beams, iq) = ping.beams.unwrap_or_default();
    dict.set_item("beams", rows(py, (beams, iq.len() / beams.max(1)), iq)?)?;
    dict.set_item("beam_angle_rad", ping.beam_angle_rad.into_pyarray(py))?;
    let lines = PyDict::new(py);
    for (side, line) in ping.lines {
        lines.set_item(side_name(side), line.into_pyarray(py))?;
    }
    dict.set_item("lines", lines)?;
    dict.set_item(
        "soundings",
        Py::new(py, Soundings::of(py, &ping.soundings))?,
    )?;
    Ok(dict)
}

/// Rows of samples that come sample by sample.
fn transposed(count: usize, samples: impl ExactSizeIterator<Item = Complex32>) -> Vec<Complex32> {
    let each = samples.len() / count.max(1);
    let mut iq = vec![Complex32::default(); count * each];
    for (k, sample) in samples.enumerate().take(count * each) {
        iq[(k % count) * each + k / count] = sample;
    }
    iq
}

fn of_s7k(bytes: &[u8]) -> FilePings {
    let mut pings = FilePings::default();
    // 7004 holds no ping number: it belongs to the 7000 before it.
    let mut current = None;
    for record in FileReader::new(bytes).flatten().map(|found| found.record) {
        let body = record.body();
        match record.frame.record_type_id {
            7000 => {
                let Ok(set) = SonarSettings7000::parse(body) else {
                    continue;
                };
                if set.multi_ping_sequence > 1 {
                    continue;
                }
                current = Some(set.ping_number);
                let ping = pings.of(set.ping_number);
                // The time stamp of ping records is the end of the transmission.
                let pulse_ns = (f64::from(set.tx_pulse_width_s) * 1e9) as i64;
                let utc_ns = record.frame.time.to_utc_ns().ok();
                ping.utc_ns = utc_ns.map(|utc_ns| utc_ns - pulse_ns);
                ping.sample_rate_hz = f64::from(set.sample_rate_hz);
                ping.sound_speed_m_per_s = f64::from(set.sound_velocity_m_per_s);
            }
            7004 => {
                if let (Ok(angles), Some(number)) = (BeamGeometry7004::parse(body), current) {
                    let across = (0..angles.beams).filter_map(|b| angles.across_track_rad(b));
                    pings.of(number).beam_angle_rad = across.map(f64::from).collect();
                }
            }
            7007 => {
                if let Ok(line) = SideScan7007::parse(body)
                    && line.rth.multi_ping_sequence <= 1
                {
                    let ping = pings.of(line.rth.ping_number);
                    let port: Vec<f32> = line.port().map(|a| a as f32).collect();
                    let starboard: Vec<f32> = line.starboard().map(|a| a as f32).collect();
                    for (side, line) in [(Side::Port, port), (Side::Starboard, starboard)] {
                        // A missing side is all zeros in the record.
                        if line.iter().any(|a| *a > 0.0) {
                            ping.lines.push((side, line));
                        }
                    }
                }
            }
            7018 => {
                if let Ok(beams) = Beamformed7018::parse(body)
                    && beams.rth.multi_ping_sequence <= 1
                {
                    let iq = beams.samples().map(|s| {
                        let angle = f32::from(s.phase) / PHASE_COUNTS_PER_RAD;
                        Complex32::from_polar(f32::from(s.amplitude), angle)
                    });
                    let count = usize::from(beams.rth.beams);
                    let iq = transposed(count, iq);
                    pings.of(beams.rth.ping_number).beams = Some((count, iq));
                }
            }
            7027 => {
                if let Ok(found) = RawDetections7027::parse(body)
                    && found.rth.multi_ping_sequence <= 1
                {
                    let rate_hz = f64::from(found.rth.sampling_rate_hz);
                    let soundings = found.detections().map(|d| {
                        let twtt_s = f64::from(d.detection_sample) / rate_hz;
                        Sounding {
                            beam: d.beam.into(),
                            angle_rad: d.rx_angle_rad.into(),
                            twtt_s,
                            error_s: f64::from(d.uncertainty) * twtt_s,
                            detection: match d.flags & 2 {
                                0 => Detection::Amplitude,
                                _ => Detection::Phase,
                            },
                            level_v: d.intensity.into(),
                        }
                    });
                    pings.of(found.rth.ping_number).soundings = soundings.collect();
                }
            }
            7038 => {
                if let Ok(raw) = RawIq7038::parse(body) {
                    let count = usize::from(raw.rth.elements);
                    let iq = raw.iq_sample_major();
                    let iq = iq.map(|[i, q]| Complex32::new(f32::from(i), f32::from(q)));
                    let iq = transposed(count, iq);
                    let ping = pings.of(raw.rth.ping_number);
                    if ping.sample_rate_hz > 0.0 {
                        ping.first_sample_s = f64::from(raw.rth.start_sample) / ping.sample_rate_hz;
                    }
                    ping.elements.push(("receive", count, iq));
                }
            }
            _ => {}
        }
    }
    pings
}

/// Passes every message of a stream to `each`.
fn messages<F: Framing>(framing: F, bytes: &[u8], mut each: impl FnMut(&[u8])) {
    Splitter::new(framing).feed(bytes, |message| {
        if let Ok(message) = message {
            each(message);
        }
    });
}

fn of_jsf(bytes: &[u8]) -> FilePings {
    let mut pings = FilePings::default();
    // The first subsystem is the sonar's own pulse.
    let mut own = None;
    messages(JsfFraming::default(), bytes, |message| {
        let Ok(message) = jsf::Message::parse(message) else {
            return;
        };
        let header = message.header;
        if header.message_type != message_type::SONAR_DATA
            || *own.get_or_insert(header.subsystem) != header.subsystem
        {
            return;
        }
        let Ok(data) = SonarData80::parse(message.body) else {
            return;
        };
        let rate_hz = 1e9 / f64::from(data.header.sample_interval_ns.max(1));
        let ping = pings.of(data.header.ping_number);
        ping.utc_ns = Some(data.header.utc_ns());
        ping.sample_rate_hz = rate_hz;
        ping.first_sample_s = f64::from(data.header.starting_depth_samples) / rate_hz;
        ping.sound_speed_m_per_s = data.header.sound_speed_m_per_s.into();
        let is_side = header.subsystem < subsystem::BATHYMETRY_LOW;
        let side = match header.channel {
            0 => Side::Port,
            _ => Side::Starboard,
        };
        let values: Vec<f32> = data.values().map(|v| v as f32).collect();
        let iq: Vec<Complex32> = match data.format {
            DataFormat::Envelope | DataFormat::Real if is_side => {
                ping.lines.push((side, values));
                return;
            }
            DataFormat::Envelope | DataFormat::Real => {
                values.iter().map(|v| Complex32::new(*v, 0.0)).collect()
            }
            DataFormat::Analytic | DataFormat::AnalyticUnfiltered => {
                let pairs = values.as_chunks::<2>().0.iter();
                pairs.map(|[re, im]| Complex32::new(*re, *im)).collect()
            }
        };
        match ping.elements.last_mut() {
            _ if is_side => ping.elements.push((side_name(side), 1, iq)),
            Some((_, count, all)) if all.len() == *count * iq.len() => {
                *count += 1;
                all.extend(iq);
            }
            // A row of another length does not belong to the array.
            Some(_) => {}
            None => ping.elements.push(("receive", 1, iq)),
        }
    });
    pings
}

fn of_xtf(bytes: &[u8]) -> Result<FilePings, String> {
    let file = FileHeader::parse(bytes).map_err(|why| why.to_string())?;
    let mut pings = FilePings::default();
    let packets = bytes.get(FileHeader::SIZE_BYTES..).unwrap_or_default();
    messages(XtfFraming::default(), packets, |packet| {
        let Ok(found) = xtf::Ping::parse(packet, &file) else {
            return;
        };
        let header = found.header;
        let ping = pings.of(header.ping_number);
        ping.utc_ns = header.utc_ns();
        ping.sound_speed_m_per_s = header.computed_sound_velocity_m_per_s.into();
        for (channel, info) in found.channels.iter().zip(&file.channels) {
            let side = match info.kind {
                ChannelKind::Port => Side::Port,
                ChannelKind::Starboard => Side::Starboard,
                ChannelKind::SubBottom | ChannelKind::Bathymetry => continue,
            };
            // The channels of further pulses follow those of the sonar's own.
            if ping.lines.iter().any(|(other, _)| *other == side) {
                continue;
            }
            let full_scale_v = match channel.header.millivolt_scale {
                0 => f64::from(info.volt_scale),
                millivolts => f64::from(millivolts) * 1e-3,
            };
            let scale = match channel.format {
                SampleFormat::U8 => full_scale_v / f64::from(u8::MAX),
                SampleFormat::U16 => full_scale_v / f64::from(u16::MAX),
                SampleFormat::U32 => full_scale_v / f64::from(u32::MAX),
                SampleFormat::F32 => 1.0,
            };
            let line: Vec<f32> = channel.values().map(|v| (v * scale) as f32).collect();
            let duration_s = f64::from(channel.header.time_duration_s);
            if duration_s > 0.0 {
                ping.sample_rate_hz = line.len() as f64 / duration_s;
            }
            ping.first_sample_s = channel.header.time_delay_s.into();
            ping.lines.push((side, line));
        }
    });
    Ok(pings)
}

fn of_svlog(bytes: &[u8]) -> FilePings {
    let mut pings = FilePings::default();
    messages(PingFraming, bytes, |frame| {
        let message = Frame::parse(frame).and_then(|frame| Message::parse(&frame));
        match message {
            Ok(Message::OsMonoProfile(profile)) => {
                let head = profile.head;
                // The device counts from 0 at power-up.
                let ping = pings.of(head.ping_number.wrapping_add(1));
                let c = f64::from(head.sos_dmps) / 10.0;
                let amplitude = profile.results_db();
                let amplitude = amplitude
                    .map(|db| 10f64.powf((db - VOLT_IN_MICROVOLT_DB) / 20.0) as f32)
                    .collect::<Vec<_>>();
                ping.sound_speed_m_per_s = c;
                ping.first_sample_s = 2e-3 * f64::from(head.start_mm) / c;
                let length_s = 2e-3 * f64::from(head.length_mm) / c;
                ping.sample_rate_hz = amplitude.len() as f64 / length_s;
                let across_deg = head.transducer_heading_deg - head.vehicle_heading_deg;
                let side = match across_deg.rem_euclid(360.0) > 180.0 {
                    true => Side::Port,
                    false => Side::Starboard,
                };
                ping.lines.push((side, amplitude));
            }
            Ok(Message::AtofPointData(data)) => {
                let ping = pings.of(data.head.ping_number);
                ping.utc_ns = i64::try_from(data.head.utc_msec)
                    .ok()
                    .and_then(|ms| ms.checked_mul(1_000_000));
                ping.sound_speed_m_per_s = data.head.sos_mps.into();
                // The message holds neither the beam nor the method nor the level.
                let soundings = data.points().enumerate().map(|(beam, point)| Sounding {
                    beam,
                    angle_rad: -f64::from(point.angle_rad),
                    twtt_s: point.two_way_time_s.into(),
                    error_s: f64::NAN,
                    detection: Detection::Amplitude,
                    level_v: f64::NAN,
                });
                ping.soundings = soundings.collect();
            }
            _ => {}
        }
    });
    pings
}

//! A flat bottom through the whole pipeline (navigation, echoes, elements, beams, detection), written by every family and read back.
//!
//! Samples agree with the depth to one sample, detections with those of the pipeline to one sample. The bottom consists of points, one per beam, so
//! that the position of every echo is known. It is deeper to starboard, so that an exchanged side or sign is detected.

use std::fmt::Write as _;
use std::path::Path;
use std::sync::Arc;

use echotank_config::spec::{
    JsfChannels, JsfFormat, NavMode, PingDevice, PingProtocolSpec, RigSpec, SonarSpec, Vita49Spec,
    XtfSpec,
};
use echotank_core::ping::{PingOutput, PingPlan, Side, Sounding};
use echotank_core::records::Datagram;
use echotank_emit::imagenex872::emit_ping as emit_imagenex;
use echotank_emit::jsf::{JsfEmitter, JsfSheet};
use echotank_emit::packets::Packets;
use echotank_emit::ping_protocol::{Device as PingDeviceState, PingEmitter};
use echotank_emit::session::Wants;
use echotank_emit::sevenk::records::DeviceSheet;
use echotank_emit::sevenk::{RecordSet, SevenKEmitter};
use echotank_emit::vita49::Vita49Emitter;
use echotank_emit::wbms::{Device as WbmsDevice, SubscribedPackets, WbmsEmitter};
use echotank_emit::xtf::XtfEmitter;
use echotank_ping::threads::pool;
use echotank_protocols::imagenex872::{Side as HeadSide, SwitchCommand, parse_answer};
use echotank_protocols::jsf::{Message as JsfMessage, SonarData80, message_type};
use echotank_protocols::ping_protocol::{Frame, Message as PingMessage};
use echotank_protocols::sevenk::Record;
use echotank_protocols::sevenk::records::{
    Beamformed7018, CalibratedSideScan7057, RawDetections7027, RawIq7038, SideScan7007,
    SingleBeamIq10038, SnippetStrengths7058, Snippets7028, WaterColumn7042,
};
use echotank_protocols::vita49::{Packet, PacketType, complex_samples};
use echotank_protocols::wbms::{Backscatter, Bathymetry, Packet as WbmsPacket, packet_type};
use echotank_protocols::xtf::{FileHeader, Ping};
use echotank_runtime::recorded::RecordedRig;

use super::rig::{imagenex, jsf_spec};
use echotank_testing::wire::{output_spec, store};

const SOUND_M_PER_S: f64 = 1500.0;
const RATE_HZ: f64 = 40e3;
/// One sample of range.
const STEP_M: f64 = 0.5 * SOUND_M_PER_S / RATE_HZ;
/// Depth below the arrays, between samples.
const DEPTH_M: f64 = 20.0034;
/// Additional depth to starboard.
const SHELF_M: f64 = 1.0;
const BEAM_STEP_DEG: f64 = 6.0;
/// Number of beams to each side of the vertical.
const BEAMS: i32 = 8;
/// Strength of every point except the one straight below, which is twice as strong.
const LEVEL_V: f64 = 0.002;
const FULL_SCALE_V: f64 = 0.02;

const RIG: &str = r#"
[medium]
sound_speed_m_per_s = 1500.0
absorption = "none"
[nav]
origin = { latitude_deg = -54.4, longitude_deg = -10.3 }
mode = "settle"
vertical = "depth"
[[nav.source]]
name = "track"
kind = "csv"
path = "track.csv"
provides = ["position", "heading", "roll-pitch"]
[scene]
points = "points.csv"
[[sonar]]
name = "flat"
[sonar.pulse]
kind = "lfm"
center_frequency_khz = 200.0
bandwidth_khz = 20.0
duration_ms = 1.0
taper = 0.0
[[sonar.transmit]]
name = "tx"
pattern = "omnidirectional"
[[sonar.receive]]
name = "port"
transmit = "tx"
elements = 1
spacing_m = 0.00375
sensitivity_db = 0.0
[[sonar.receive]]
name = "starboard"
transmit = "tx"
elements = 1
spacing_m = 0.00375
sensitivity_db = 0.0
[[sonar.receive]]
name = "fan"
transmit = "tx"
elements = 96
spacing_m = 0.00375
element_pattern = "omnidirectional"
yaw_deg = 90.0
sensitivity_db = 0.0
[sonar.receiver]
sample_rate_khz = 40.0
rx_filter = "none"
tvg = "none"
noise_db = "none"
full_scale_v = 0.02
[sonar.ping]
range_m = 45.0
rate_hz = 2.0
source_level_db = 0.0
gain_db = 0.0
[sonar.model]
path = "polyline"
doppler = "stretch"
synthesis = "direct"
error_check = false
[sonar.beams]
port = "port"
starboard = "starboard"
[sonar.beams.fan]
array = "fan"
beams = 17
sector_deg = 96.0
spacing = "equi-angle"
shading = "hann"
bottom_detection = true
[sonar.output.sevenk]
id = 103
arrays = ["port", "starboard"]
listen = "127.0.0.1:0"
"#;

/// Slant range of the point at this angle, starboard positive.
fn range_of(angle_rad: f64) -> f64 {
    let deeper = if angle_rad > 1e-6 { SHELF_M } else { 0.0 };
    (DEPTH_M + deeper) / angle_rad.cos()
}

/// Computes a ping of `rig`. The platform rests with heading east, so port is to the north.
fn made(rig: &str, folder: &Path) -> (RigSpec, PingPlan, PingOutput) {
    let mut points = "north_m,east_m,down_m,amplitude\n".to_owned();
    for beam in -BEAMS..=BEAMS {
        let angle = (f64::from(beam) * BEAM_STEP_DEG).to_radians();
        let range_m = range_of(angle);
        let louder = if beam == 0 { 2.0 } else { 1.0 };
        let _ = writeln!(
            points,
            "{},0,{},{}",
            -range_m * angle.sin(),
            range_m * angle.cos(),
            louder * LEVEL_V * range_m * range_m
        );
    }
    let mut track = "time_s,north_m,east_m,down_m,roll_deg,pitch_deg,heading_deg\n".to_owned();
    for k in 0..20 {
        let _ = writeln!(track, "{},0,0,0,0,0,90", 1_793_611_200 + k);
    }
    std::fs::write(folder.join("points.csv"), points).expect("written");
    std::fs::write(folder.join("track.csv"), track).expect("written");
    let spec = echotank_runtime::config_files::parse(rig, folder).unwrap_or_else(|e| panic!("{e}"));
    let (plan, output) = pool(1).expect("a thread").install(|| {
        let mut recorded = RecordedRig::open(&spec).unwrap_or_else(|e| panic!("{e}"));
        let (sonar, order) = recorded.next_order(1).expect("a ping");
        assert!(recorded.settle(sonar, &order));
        let mut slot = recorded.rig.slot(sonar);
        echotank_ping::make_ping(
            &mut recorded.rig,
            sonar,
            &order,
            NavMode::Settle,
            order.transmit_utc,
            &mut slot,
        )
        .unwrap_or_else(|gap| panic!("{gap:?}"));
        (slot.plan, slot.output)
    });
    (spec, plan, output)
}

/// Expected location of the bottom in a ping.
#[derive(Clone, Copy)]
pub(crate) struct Bottom {
    /// Slant range at an angle from the vertical, metres; starboard positive.
    pub(crate) range_of: fn(f64) -> f64,
    /// One sample of range.
    pub(crate) step_m: f64,
}

const SHELVING: Bottom = Bottom {
    range_of,
    step_m: STEP_M,
};

impl Bottom {
    pub(crate) fn holds(self, family: &str, range_m: f64, angle_rad: f64, step_m: f64) {
        let off_m = range_m - (self.range_of)(angle_rad);
        assert!(
            off_m.abs() <= step_m,
            "{family} at {:.1} degrees: {range_m} m, off by {off_m} m, a step is {step_m} m",
            angle_rad.to_degrees()
        );
    }

    /// Checks the records that state the location of their first sample.
    pub(crate) fn sevenk(self, records: &[Arc<Datagram>], output: &PingOutput) {
        let body = |id: u32| body(records, id);
        let angles = &output.beams[0].angle_rad;
        let at = |family: &str, sample: usize, angle_rad: f64| {
            self.holds(family, sample as f64 * self.step_m, angle_rad, self.step_m);
        };
        let detections = RawDetections7027::parse(body(7027)).expect("7027");
        assert_eq!(detections.detections().count(), angles.len());
        for d in detections.detections() {
            let range_m = 0.5 * SOUND_M_PER_S * f64::from(d.detection_sample)
                / f64::from(detections.rth.sampling_rate_hz);
            as_found(
                "7k 7027",
                output,
                range_m,
                d.rx_angle_rad.into(),
                self.step_m,
            );
        }
        let beams = Beamformed7018::parse(body(7018)).expect("7018");
        for (beam, &angle) in angles.iter().enumerate() {
            let row = (0..beams.rth.samples)
                .map(|k| f64::from(beams.sample(k, beam as u16).expect("there").amplitude));
            at("7k 7018", peak(row), angle);
        }
        let column = WaterColumn7042::parse(body(7042)).expect("7042");
        assert_eq!(column.beams().count(), angles.len());
        for beam in column.beams() {
            let sample =
                peak(beam.samples().map(|(m, _)| m.into())) + column.rth.first_sample as usize;
            at("7k 7042", sample, angles[usize::from(beam.beam)]);
        }
        let snippets = Snippets7028::parse(body(7028)).expect("7028");
        assert_eq!(snippets.snippets().count(), angles.len());
        for (d, samples) in snippets.snippets() {
            let sample = d.start_sample as usize + peak(samples.map(f64::from));
            at("7k 7028", sample, angles[usize::from(d.beam)]);
        }
        let strengths = SnippetStrengths7058::parse(body(7058)).expect("7058");
        for (d, samples) in strengths.strengths_db() {
            let sample = d.start_sample as usize + peak(samples.map(f64::from));
            at("7k 7058", sample, angles[usize::from(d.beam)]);
        }
        let lines = SideScan7007::parse(body(7007)).expect("7007");
        at("7k 7007", peak(lines.port().map(f64::from)), 0.0);
        at("7k 7007", peak(lines.starboard().map(f64::from)), 0.0);
        let lines = CalibratedSideScan7057::parse(body(7057)).expect("7057");
        at("7k 7057", peak(lines.port().map(|s| s.0)), 0.0);
        at("7k 7057", peak(lines.starboard().map(|s| s.0)), 0.0);
        let single = SingleBeamIq10038::parse(body(10_038)).expect("10038");
        let onset = onset(single.iq().map(|[i, q]| f64::from(i).hypot(f64::from(q))));
        let after_s = f64::from(single.rth.start_sample_delay_s)
            + onset as f64 / f64::from(single.rth.sample_rate_hz);
        self.holds("7k 10038", 0.5 * SOUND_M_PER_S * after_s, 0.0, self.step_m);
    }

    pub(crate) fn xtf(self, mut emitter: XtfEmitter, plan: &PingPlan, output: &PingOutput) {
        let file = FileHeader::parse(&emitter.file_head()).expect("a header");
        let mut packets = Vec::new();
        emitter.emit_ping(plan, output, &mut packets);
        let ping = Ping::parse(&packets[64..], &file).expect("a ping");
        assert_eq!(ping.channels.len(), 2);
        for channel in &ping.channels {
            let step_m =
                f64::from(channel.header.slant_range_m) / f64::from(channel.header.samples);
            assert!((step_m / self.step_m - 1.0).abs() < 1e-3);
            let at = peak(channel.values()) as f64;
            self.holds("xtf", at * step_m, 0.0, self.step_m);
        }
    }

    /// Checks the answer to a switch command to the starboard head. `scale` is the sample rate, Hz, and the full scale, V.
    pub(crate) fn imagenex(self, scale: (f64, f64), plan: &PingPlan, output: &PingOutput) {
        const RANGE_M: u8 = 60;
        let (head, mut session) = imagenex(&store());
        let mut bytes = Vec::new();
        SwitchCommand {
            range_m: RANGE_M,
            frequency_index: 0,
            data_gain: 100,
            balance_gain: 0,
            side: HeadSide::Starboard,
        }
        .emit(&mut bytes);
        session.receive(&bytes, plan.stamp_utc.plus_ns(-1), &mut Vec::new());
        let wanted = session.take_requested();
        let mut answers = Vec::new();
        emit_imagenex(&head, plan, output, scale, wanted, &mut answers);
        assert_eq!(answers.len(), 1);
        let echo = parse_answer(&answers[0].bytes).expect("an answer");
        // 1000 points over the range: larger than a sample.
        let step_m = f64::from(RANGE_M) / 1000.0;
        let at = peak(echo.iter().map(|&b| b.into())) as f64 + 0.5;
        self.holds("imagenex", at * step_m, 0.0, self.step_m.max(step_m));
        answers.clear();
        emit_imagenex(&head, plan, output, scale, Wants::NONE, &mut answers);
        assert!(answers.is_empty(), "no request");
    }
}

/// Body of the only record of a type.
fn body(records: &[Arc<Datagram>], id: u32) -> &[u8] {
    let found = records.iter().find(|r| r.record_type == id);
    let bytes = &found.unwrap_or_else(|| panic!("no {id}")).bytes;
    Record::parse(bytes).expect("whole").body()
}

fn on_the_bottom(family: &str, range_m: f64, angle_rad: f64, step_m: f64) {
    SHELVING.holds(family, range_m, angle_rad, step_m);
}

/// Checks that a detection agrees with the detection of the pipeline in that beam to one sample.
fn as_found(family: &str, output: &PingOutput, range_m: f64, angle_rad: f64, step_m: f64) {
    let off = |s: &&Sounding| (s.angle_rad - angle_rad).abs();
    let sounding = output
        .soundings
        .iter()
        .min_by(|a, b| off(a).total_cmp(&off(b)));
    let sounding = sounding.expect("soundings");
    assert!(off(&sounding) < 1e-5, "{family}: no beam at {angle_rad}");
    let off_m = range_m - 0.5 * SOUND_M_PER_S * sounding.twtt_s;
    assert!(off_m.abs() <= step_m, "{family}: off by {off_m} m");
}

pub(crate) fn peak(values: impl Iterator<Item = f64>) -> usize {
    let (at, _) = values
        .enumerate()
        .max_by(|a, b| a.1.total_cmp(&b.1))
        .expect("values");
    at
}

/// Start of an unfiltered echo: the first sample of at least half the height of the point straight below.
fn onset(values: impl Iterator<Item = f64>) -> usize {
    let found = values
        .enumerate()
        .find(|(_, volts)| *volts > LEVEL_V)
        .expect("an echo");
    found.0
}

fn sevenk(sonar: &SonarSpec, plan: &PingPlan, output: &PingOutput) {
    let mut spec = output_spec();
    spec.arrays = vec![1, 0];
    let sheet = Arc::new(DeviceSheet::new(&spec, sonar, SOUND_M_PER_S, 0.0));
    let mut emitter = SevenKEmitter::new(sheet, 1);
    let mut records = Vec::new();
    emitter.emit_ping(plan, output, RecordSet::ALL, &mut records);
    SHELVING.sevenk(&records, output);
    let raw = RawIq7038::parse(body(&records, 7038)).expect("7038");
    for element in 0..2 {
        let volts = (0..plan.sample_count as u32).map(|k| {
            let [i, q] = raw.iq(k, element).expect("there");
            f64::from(i).hypot(f64::from(q)) / 32_767.0 * FULL_SCALE_V
        });
        on_the_bottom("7k 7038", onset(volts) as f64 * STEP_M, 0.0, STEP_M);
    }
}

fn jsf(sonar: &SonarSpec, plan: &PingPlan, output: &PingOutput) {
    for (channels, format) in [
        (JsfChannels::Sides, JsfFormat::Envelope),
        (JsfChannels::Staves, JsfFormat::Unfiltered),
    ] {
        let sheet = JsfSheet {
            output: jsf_spec(channels, format),
            sonar: sonar.clone(),
        };
        let mut emitter = JsfEmitter::new(Arc::new(sheet), Box::new(|_, _| {}));
        let mut messages = Vec::new();
        assert_eq!(
            emitter.emit_ping(plan, output, |_, _| true, &mut messages),
            0
        );
        let mut seen = 0;
        for message in &messages {
            let message = JsfMessage::parse(&message.bytes).expect("whole");
            if message.header.message_type != message_type::SONAR_DATA {
                continue;
            }
            seen += 1;
            let data = SonarData80::parse(message.body).expect("80");
            let values: Vec<f64> = data.values().collect();
            let width = values.len() / data.header.samples();
            let volts = values
                .chunks(width)
                .map(|v| v.iter().map(|x| x * x).sum::<f64>().sqrt());
            let at = match format {
                JsfFormat::Unfiltered => onset(volts),
                _ => peak(volts),
            };
            let at = at + data.header.starting_depth_samples as usize;
            let interval_s = f64::from(data.header.sample_interval_ns) * 1e-9;
            let c = f64::from(data.header.sound_speed_m_per_s);
            let range_m = 0.5 * c * at as f64 * interval_s;
            on_the_bottom(
                &format!("jsf {channels:?} {format:?}"),
                range_m,
                0.0,
                STEP_M,
            );
        }
        assert_eq!(seen, 2);
    }
}

fn ping_protocol(sonar: &SonarSpec, plan: &PingPlan, output: &PingOutput) {
    for device in [
        PingDevice::Omniscan450 { side: Side::Port },
        PingDevice::Omniscan450 {
            side: Side::Starboard,
        },
        PingDevice::Surveyor240,
    ] {
        let spec = PingProtocolSpec {
            device,
            listen: "127.0.0.1:0".parse().expect("address"),
            serial: None,
            channel: (0, 2),
            client_queue_bytes: 0,
            max_clients: 0,
        };
        let state = PingDeviceState::new(&spec, sonar, SOUND_M_PER_S, plan.stamp_utc);
        let mut sent = Vec::new();
        PingEmitter::new(Arc::new(state), 1).emit_ping(plan, output, &mut sent);
        let mut seen = 0;
        for datagram in &sent {
            let frame = Frame::parse(&datagram.bytes).expect("a frame");
            match PingMessage::parse(&frame).expect("a message") {
                PingMessage::OsMonoProfile(profile) => {
                    let results: Vec<f64> = profile.results_db().collect();
                    let step_m = f64::from(profile.head.length_mm) / 1e3 / results.len() as f64;
                    let at = peak(results.into_iter()) as f64 + 0.5;
                    on_the_bottom("ping 2198", at * step_m, 0.0, step_m.max(STEP_M));
                    seen += 1;
                }
                PingMessage::AtofPointData(data) => {
                    let c = f64::from(data.head.sos_mps);
                    for point in data.points() {
                        let range_m = 0.5 * c * f64::from(point.two_way_time_s);
                        // Positive to port.
                        let angle = -f64::from(point.angle_rad);
                        as_found("ping 3012", output, range_m, angle, STEP_M);
                        seen += 1;
                    }
                }
                _ => {}
            }
        }
        let want = match device {
            PingDevice::Surveyor240 => output.beams[0].beams,
            PingDevice::Omniscan450 { .. } => 1,
        };
        assert_eq!(seen, want, "{device:?}");
    }
}

fn wbms(sonar: &SonarSpec, plan: &PingPlan, output: &PingOutput) {
    let device = Arc::new(WbmsDevice::new(sonar, SOUND_M_PER_S));
    let mut emitter = WbmsEmitter::new(device, 1);
    let all = SubscribedPackets {
        bathymetry: true,
        water_column: true,
        side_scan: true,
    };
    let mut sent = Vec::new();
    emitter.emit_ping(plan, output, all, &mut sent);
    let mut seen = [0; 3];
    for datagram in &sent {
        let packet = WbmsPacket::parse(&datagram.bytes).expect("a packet");
        if packet.header.packet_type == packet_type::BATHYMETRY {
            let bathymetry = Bathymetry::parse(&packet).expect("type 1");
            let head = bathymetry.head;
            let c = f64::from(head.sound_velocity_m_per_s);
            for d in bathymetry.detections() {
                let range_m = 0.5 * c * f64::from(d.sample_number) / f64::from(head.sample_rate_hz);
                as_found("wbms 2210", output, range_m, d.angle_rad.into(), STEP_M);
                seen[0] += 1;
            }
            continue;
        }
        let data = Backscatter::parse(&packet).expect("samples");
        let (beams, t0) = (data.head.beams as usize, data.head.t0_samples as usize);
        let values: Vec<f64> = data.values().map(f64::abs).collect();
        if data.packet_type == packet_type::WATER_COLUMN {
            for (beam, angle) in data.angles_rad().enumerate() {
                let at = peak(values.iter().skip(beam).step_by(beams).copied()) + t0;
                on_the_bottom("wbms 2211", at as f64 * STEP_M, angle.into(), STEP_M);
                seen[1] += 1;
            }
        } else if data.packet_type == packet_type::SIDE_SCAN {
            for side in 0..beams {
                let at = peak(values.iter().skip(side).step_by(beams).copied()) + t0;
                on_the_bottom("wbms 2212", at as f64 * STEP_M, 0.0, STEP_M);
                seen[2] += 1;
            }
        }
    }
    assert_eq!((seen[0], seen[1]), (17, 17), "{seen:?}");
    assert!(sent.len() == 3, "{} packets", sent.len());
}

fn vita49(sonar: &SonarSpec, plan: &PingPlan, output: &PingOutput) {
    let spec = Vita49Spec {
        send_to: Vec::new(),
        arrays: vec![0, 1],
        passband_rate_hz: None,
        is_vector: false,
        first_stream: 1,
        max_packet: 1472,
        pace_bytes_per_s: 1e9,
        multicast_interface: std::net::Ipv4Addr::LOCALHOST,
        multicast_ttl: 1,
    };
    let mut packets = Packets::default();
    Vita49Emitter::new(&spec, sonar).emit_ping(plan, output, false, &mut packets);
    for stream in 1..=2 {
        let mut found = None;
        for bytes in packets.iter() {
            let packet = Packet::parse(bytes).expect("right");
            if packet.stream_id != stream || packet.packet_type == PacketType::Context {
                continue;
            }
            let volts =
                |[i, q]: [i16; 2]| f64::from(i).hypot(f64::from(q)) / 32_767.0 * FULL_SCALE_V;
            let at = complex_samples(packet.payload).position(|iq| volts(iq) > LEVEL_V);
            if let (Some(at), None) = (at, found) {
                let began_ns = packet.time.expect("a time").to_utc_ns() - plan.transmit_utc.0;
                found = Some(began_ns as f64 * 1e-9 + at as f64 / RATE_HZ);
            }
        }
        let after_s = found.expect("an echo");
        on_the_bottom("vita49", 0.5 * SOUND_M_PER_S * after_s, 0.0, STEP_M);
    }
}

/// The fan's elements on 117 degrees of an arc: beams by the elements that look towards them.
#[test]
fn the_fan_of_an_arc_puts_the_bottom_within_one_sample_of_its_depth() {
    let arc = RIG
        .replace(
            "elements = 96\nspacing_m = 0.00375",
            "elements = 136\nspacing_m = 0.00375\nradius_m = 0.25",
        )
        .replace(
            "bottom_detection = true",
            "bottom_detection = true\nformer = \"dynamic-focus\"",
        );
    assert_ne!(arc, RIG);
    let folder = tempfile::tempdir().expect("a folder");
    let (spec, plan, output) = made(&arc, folder.path());
    assert_eq!(output.soundings.len(), 17, "a sounding a beam");
    for s in &output.soundings {
        let range_m = 0.5 * SOUND_M_PER_S * s.twtt_s;
        on_the_bottom("soundings", range_m, s.angle_rad, DEPTH_M / 200.0);
    }
    sevenk(&spec.sonars[0], &plan, &output);
}

#[test]
fn every_family_puts_the_bottom_of_a_whole_ping_within_one_sample_of_its_depth() {
    let folder = tempfile::tempdir().expect("a folder");
    let (spec, plan, output) = made(RIG, folder.path());
    let sonar = &spec.sonars[0];
    assert_eq!(output.soundings.len(), 17, "a sounding a beam");
    // The flat phase of a single point has no definite zero crossing, so half a percent of the depth is allowed.
    for s in &output.soundings {
        let range_m = 0.5 * SOUND_M_PER_S * s.twtt_s;
        on_the_bottom("soundings", range_m, s.angle_rad, DEPTH_M / 200.0);
    }
    sevenk(sonar, &plan, &output);
    jsf(sonar, &plan, &output);
    for is_float in [false, true] {
        let emitter = XtfEmitter::new(&XtfSpec { is_float }, sonar, SOUND_M_PER_S);
        SHELVING.xtf(emitter, &plan, &output);
    }
    SHELVING.imagenex((RATE_HZ, FULL_SCALE_V), &plan, &output);
    ping_protocol(sonar, &plan, &output);
    wbms(sonar, &plan, &output);
    vita49(sonar, &plan, &output);
}

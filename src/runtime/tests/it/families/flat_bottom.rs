//! A flat bottom, written by every family and read back: depths and slant ranges agree to one sample.

use std::sync::Arc;

use echotank_config::spec::{JsfChannels, JsfFormat};
use echotank_core::ping::{Detection, PingOutput, PingPlan, Sounding};
use echotank_core::settings::{ChangeOrigin, SettingsPort, StoredKey, StoredValue};
use echotank_emit::sevenk::records::DeviceSheet;
use echotank_emit::sevenk::stored_settings::StoredSettings;
use echotank_emit::sevenk::{RecordSet, SevenKEmitter};
use echotank_protocols::jsf::{SonarData80, message_type};
use echotank_protocols::sevenk::Record;
use echotank_protocols::sevenk::records::{RawDetections7027, WaterColumn7042};
use echotank_protocols::xtf::{FileHeader, Ping};
use num_complex::{Complex32, Complex64};

use super::pipeline::{Bottom, peak};
use super::rig::*;
use echotank_testing::wire::*;

const DEPTH_M: f64 = 31.5;
/// Number of samples of a ping, and number of sample times before the first.
const SAMPLES: usize = 200;
const SILENT: usize = 7;
/// One sample of range.
const STEP_M: f64 = 0.5 * SOUND_M_PER_S / SAMPLE_RATE_HZ;

fn sample_of(range_m: f64) -> usize {
    (range_m / STEP_M).round() as usize
}

/// Ping with one spike at the bottom: in each beam at its angle, in lines and elements straight down.
fn flat() -> (PingPlan, PingOutput) {
    let mut plan = plan(5, SAMPLES);
    plan.first_sample_s = SILENT as f64 / SAMPLE_RATE_HZ;
    plan.sensor.altitude_m = Some(DEPTH_M);
    let mut output = output(SAMPLES);
    let zero = Complex64::ZERO;
    let fan = &mut output.beams[0];
    fan.iq.fill(Complex32::ZERO);
    for beam in 0..fan.beams {
        let range_m = DEPTH_M / fan.angle_rad[beam].cos();
        fan.iq[beam * SAMPLES + sample_of(range_m) - SILENT] = Complex32::new(1.0, 0.5);
        output.soundings.push(Sounding {
            beam,
            angle_rad: fan.angle_rad[beam],
            twtt_s: 2.0 * range_m / SOUND_M_PER_S,
            error_s: 1e-4,
            detection: Detection::Phase,
            level_v: 1.0,
        });
    }
    for line in &mut output.lines {
        line.amplitude.clear();
        line.amplitude.resize(SILENT + SAMPLES, 0.0);
        line.amplitude[sample_of(DEPTH_M)] = 1.0;
    }
    for frame in &mut output.elements {
        frame.iq.fill(zero);
        for e in 0..frame.elements {
            frame.iq[e * SAMPLES + sample_of(DEPTH_M) - SILENT] = Complex64::new(1.0, -1.0);
        }
    }
    (plan, output)
}

/// Bottom of [`flat`].
const FLAT: Bottom = Bottom {
    range_of: |angle_rad| DEPTH_M / angle_rad.cos(),
    step_m: STEP_M,
};

/// State of the emitter after the command 7042 with `flags`.
fn stored_7042(flags: u32) -> StoredSettings {
    let store = store();
    let key = StoredKey {
        via: "7k",
        name: "compressed water column",
        place: 0,
    };
    let value = StoredValue::Numbers(vec![flags.into()]);
    store
        .store(key, value, ChangeOrigin::from(TRANSMIT_UTC))
        .expect("stored");
    StoredSettings::of(store.as_ref())
}

fn sheet_that_detects() -> Arc<DeviceSheet> {
    let mut sonar = sonar();
    let fan = sonar.beams.fan.as_mut().expect("a fan");
    fan.form.bottom_detection = true;
    sheet_of(&sonar)
}

#[test]
fn sevenk_puts_a_flat_bottom_at_its_depth_in_every_record() {
    let (plan, output) = flat();
    let mut emitter = SevenKEmitter::new(sheet_that_detects(), 1);
    let mut records = Vec::new();
    emitter.emit_ping(&plan, &output, RecordSet::ALL, &mut records);
    FLAT.sevenk(&records, &output);
    let found = records.iter().find(|r| r.record_type == 7027);
    let record = Record::parse(&found.expect("7027").bytes).expect("whole");
    let detections = RawDetections7027::parse(record.body()).expect("7027");
    assert!(
        detections.detections().all(|d| d.flags & 3 == 2),
        "by phase"
    );
}

#[test]
fn the_7042_set_up_is_obeyed_sample_by_sample() {
    let (plan, output) = flat();
    let sheet = sheet_that_detects();
    for (flags, rate_hz, decimated) in [
        (0, 1000.0, SAMPLES),
        (1 << 1, 1000.0, SAMPLES),             // magnitudes only
        (1 << 2, 1000.0, SAMPLES),             // dB in 8 bits
        (1 << 12, 1000.0, SAMPLES),            // 32 bits
        (4 << 4 | 1 << 8, 250.0, SAMPLES / 4), // every fourth sample, the maximum of its window
    ] {
        let mut emitter = SevenKEmitter::new(sheet.clone(), 1);
        emitter.set_stored(stored_7042(flags));
        let mut records = Vec::new();
        emitter.emit_ping(&plan, &output, RecordSet::of(&[7042]), &mut records);
        let record = Record::parse(&records[0].bytes).expect("whole");
        let column = WaterColumn7042::parse(record.body()).expect("7042");
        assert_eq!(
            (column.rth.flags, column.rth.sample_rate_hz),
            (flags, rate_hz)
        );
        let step_m = 0.5 * SOUND_M_PER_S / f64::from(rate_hz);
        for beam in column.beams() {
            assert_eq!(beam.samples().len(), decimated, "flags {flags:#x}");
            let at = peak(beam.samples().map(|(m, _)| m.into())) as f64;
            let range_m = at * step_m + SILENT as f64 * STEP_M;
            let angle = output.beams[0].angle_rad[usize::from(beam.beam)];
            assert!(
                (range_m * angle.cos() - DEPTH_M).abs() <= step_m,
                "{flags:#x}"
            );
        }
    }
    // Truncated after the detections.
    let mut emitter = SevenKEmitter::new(sheet, 1);
    emitter.set_stored(stored_7042(1));
    let mut records = Vec::new();
    emitter.emit_ping(&plan, &output, RecordSet::of(&[7042]), &mut records);
    let record = Record::parse(&records[0].bytes).expect("whole");
    let column = WaterColumn7042::parse(record.body()).expect("7042");
    for beam in column.beams() {
        let at = output.soundings[usize::from(beam.beam)].twtt_s * SAMPLE_RATE_HZ;
        let want = at.ceil() as usize + 1 - SILENT;
        assert_eq!(beam.samples().len(), want, "beam {}", beam.beam);
    }
}

#[test]
fn jsf_puts_a_flat_bottom_at_its_slant_range_in_every_format_and_channel() {
    let (plan, output) = flat();
    for (channels, count) in [(JsfChannels::Sides, 2), (JsfChannels::Staves, 5)] {
        for (format, code, gain) in [
            (JsfFormat::Envelope, 0, 2.0),
            (JsfFormat::Analytic, 1, 2.0),
            (JsfFormat::Unfiltered, 9, 1.0),
        ] {
            let messages = jsf_ping(channels, format, &plan, &output);
            let data: Vec<_> = messages
                .iter()
                .map(|m| jsf_message(m))
                .filter(|m| m.header.message_type == message_type::SONAR_DATA)
                .collect();
            let numbers: Vec<_> = data.iter().map(|m| usize::from(m.header.channel)).collect();
            assert_eq!(numbers, (0..count).collect::<Vec<_>>());
            for message in data {
                let data = SonarData80::parse(message.body).expect("80");
                let what = format!("jsf {channels:?} {format:?}");
                assert_eq!(data.header.data_format, code, "{what}");
                let values: Vec<f64> = data.values().collect();
                let width = values.len() / data.header.samples();
                let power = values.chunks(width).map(|v| v.iter().map(|x| x * x).sum());
                let at = peak(power) + data.header.starting_depth_samples as usize;
                let interval_s = f64::from(data.header.sample_interval_ns) * 1e-9;
                let c = f64::from(data.header.sound_speed_m_per_s);
                FLAT.holds(&what, 0.5 * c * at as f64 * interval_s, 0.0, STEP_M);
                // A line is already an envelope; the other formats show whether the doubling filter was applied.
                let largest = values.iter().fold(0.0_f64, |m, v| m.max(v.abs()));
                let want = match (channels, format) {
                    (JsfChannels::Sides, JsfFormat::Envelope) => 1.0,
                    (_, JsfFormat::Envelope) => gain * 2.0_f64.sqrt(),
                    _ => gain,
                };
                assert!((largest / want - 1.0).abs() < 1e-4, "{what}: {largest}");
                assert_eq!(
                    data.header.altitude_m().map(|a| (a - DEPTH_M).abs() < 1e-2),
                    Some(true)
                );
            }
        }
    }
}

#[test]
fn xtf_and_imagenex_put_a_flat_bottom_at_its_slant_range() {
    let (plan, output) = flat();
    FLAT.xtf(xtf_emitter(&sonar()), &plan, &output);
    FLAT.imagenex((SAMPLE_RATE_HZ, FULL_SCALE_V), &plan, &output);
}

#[test]
fn xtf_doubles_the_full_scale_of_a_line_that_exceeds_it() {
    let (plan, mut output) = flat();
    let mut emitter = xtf_emitter(&sonar());
    let file = FileHeader::parse(&emitter.file_head()).expect("a header");
    let at = sample_of(DEPTH_M);
    let level_v = 4.7 * FULL_SCALE_V as f32;
    output.lines[0].amplitude[at] = level_v;
    let mut packets = Vec::new();
    assert_eq!(
        emitter.emit_ping(&plan, &output, &mut packets),
        0,
        "clipped"
    );
    let ping = Ping::parse(&packets[64..], &file).expect("a ping");
    let [louder, other] = &ping.channels[..] else {
        panic!("two channels");
    };
    assert_eq!(other.header.millivolt_scale, 0, "that of the file header");
    let scale_v = f64::from(louder.header.millivolt_scale) / 1e3;
    assert_eq!(scale_v, 8.0 * FULL_SCALE_V);
    let value_v = louder.values().nth(at).expect("a sample") / 65_535.0 * scale_v;
    assert!(
        (value_v / f64::from(level_v) - 1.0).abs() < 1e-4,
        "{value_v}"
    );
    // Beyond the largest scale of the field (65.535 V), the sample is clipped and counted.
    output.lines[0].amplitude[at] = 1e3;
    assert_eq!(emitter.emit_ping(&plan, &output, &mut Vec::new()), 1);
}

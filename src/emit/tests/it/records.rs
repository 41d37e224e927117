//! Tests of the records of a ping, field by field. Records are parsed with the protocols crate, and by offset from the tables of
//! the data format definition.

use std::sync::Arc;

use echotank_config::spec::{SevenKSpec, VerticalSpec};
use echotank_core::frames::rotation_from_angles;
use echotank_core::ping::{PingOutput, PingPlan, Refraction, Side};
use echotank_core::records::Datagram;
use echotank_core::sound_speed::SoundSpeedProfile;
use echotank_emit::sevenk::records::DeviceSheet;
use echotank_emit::sevenk::{RECORDS, RecordSet, SevenKEmitter};
use echotank_protocols::sevenk::records::{
    BeamGeometry7004, Beamformed7018, Configuration7001, Installation7030, MountingOffset,
    Position1003, RawIq7038, RemoteSettings7503, RollPitchHeave1012, SideScan7007,
    SonarSettings7000, SoundVelocityProfile1009, WaterColumn7042,
};
use echotank_protocols::sevenk::{Record, ping_order_rank};
use echotank_testing::wire::*;
use glam::DVec3;

/// Offset of the record type header in a record.
const RTH: usize = 64;

fn emitted(plan: &PingPlan, output: &PingOutput, wanted: RecordSet) -> (Vec<Arc<Datagram>>, u64) {
    let mut emitter = SevenKEmitter::new(sheet(), 2);
    let mut records = Vec::new();
    let counts = emitter.emit_ping(plan, output, wanted, &mut records);
    assert_eq!(counts.records, records.len() as u64);
    let bytes: usize = records.iter().map(|r| r.bytes.len()).sum();
    assert_eq!(counts.bytes, bytes as u64);
    (records, counts.saturated)
}

fn one(id: u32) -> Vec<u8> {
    let (records, _) = emitted(&plan(9, 6), &output(6), RecordSet::of(&[id]));
    assert_eq!(records.len(), 1, "only {id} was wanted");
    assert_eq!(records[0].record_type, id);
    records[0].bytes.clone()
}

fn body(bytes: &[u8]) -> &[u8] {
    Record::parse(bytes).expect("a whole record").body()
}

fn close(got: f64, want: f64, what: &str) {
    // The field is an f32.
    let tolerance = 1e-6 * want.abs();
    assert!(
        (got - want).abs() <= tolerance,
        "{what}: got {got}, want {want}, error {:e}",
        got - want
    );
}

/// Compares the along-track width with the usual 0.886 lambda / L, which is accurate to 0.1 %.
fn customary(width_rad: f32) {
    let ratio = f64::from(width_rad) / (0.886 * 0.015 / 0.5);
    assert!((ratio - 1.0).abs() < 1e-3, "got {ratio} of 0.886 lambda/L");
}

#[test]
fn a_ping_comes_in_the_order_of_the_format_with_the_sound_velocity_before_7000() {
    let (records, _) = emitted(&plan(9, 6), &output(6), RecordSet::ALL);
    let ids: Vec<u32> = records.iter().map(|r| r.record_type).collect();
    assert_eq!(
        ids,
        [
            7610, 7000, 7503, 7004, 7007, 7018, 7038, 7042, 7057, 10_038, 1003, 1012, 1013, 1015,
            1016
        ]
    );
    assert!(ids.is_sorted_by_key(|&id| ping_order_rank(id)));
    for record in &records {
        let parsed = Record::parse(&record.bytes).expect("size and checksum right");
        assert_eq!(parsed.frame.record_type_id, record.record_type);
        assert_eq!(
            (parsed.frame.device_id, parsed.frame.system_enumerator),
            (DEVICE, ENUMERATOR)
        );
    }
}

#[test]
fn only_subscribed_and_available_records_are_emitted() {
    let bare = PingOutput::default();
    let (records, _) = emitted(&plan(1, 0), &bare, RecordSet::ALL);
    let ids: Vec<u32> = records.iter().map(|r| r.record_type).collect();
    assert_eq!(ids, [7610, 7000, 7503, 1003, 1012, 1013, 1015, 1016]);
    for &id in &RECORDS[..19] {
        // This fan has no bottom detection, and the reference point is at the waterline.
        if ![7027, 7028, 7058, 1008].contains(&id) {
            one(id);
        }
    }
    let (records, _) = emitted(&plan(1, 6), &output(6), RecordSet::EMPTY);
    assert!(records.is_empty());
}

#[test]
fn ping_records_carry_the_end_of_the_transmission_and_navigation_its_own_time() {
    let mut plan = plan(9, 6);
    // The time stamps are one hour ahead. The state is 0.25 s after the start of the pulse.
    plan.stamp_utc = plan.transmit_utc.plus_s(3600.0);
    plan.nav.utc = plan.transmit_utc.plus_s(0.25);
    plan.sensor.still_depth_m = Some(30.0);
    let (records, _) = emitted(&plan, &output(6), RecordSet::ALL);
    for record in &records {
        let time = Record::parse(&record.bytes).expect("a record").frame.time;
        let after_stamp = match record.record_type {
            1003 | 1008 | 1012 | 1013 | 1015 | 1016 => 0.25,
            _ => PULSE_S,
        };
        let got = time.to_utc_ns().expect("a time");
        let want = plan.stamp_utc.plus_s(after_stamp).0;
        assert!(
            (got - want).abs() < 4000,
            "{}: got {got}, want {want}",
            record.record_type
        );
        // Date and time by offset: day 166 of 2025, 16:06:40.
        let b = &record.bytes;
        assert_eq!(
            (u16_at(b, 20), u16_at(b, 22), b[28], b[29]),
            (2025, 166, 16, 6)
        );
        close(f64::from(f32_at(b, 24)), 40.0 + after_stamp, "seconds");
    }
}

#[test]
fn settings_7000_hold_what_the_ping_was_made_with() {
    let bytes = one(7000);
    let s = SonarSettings7000::parse(body(&bytes)).expect("7000");
    assert_eq!((s.sonar_id, s.ping_number, s.tx_pulse_mode), (SERIAL, 9, 1));
    let b = &bytes[RTH..];
    assert_eq!(b.len(), 156 + 4);
    assert_eq!((u64_at(b, 0), u32_at(b, 8), u16_at(b, 12)), (SERIAL, 9, 0));
    for (at, want, what) in [
        (14, 100_000.0, "frequency"),
        (18, SAMPLE_RATE_HZ, "sample rate"),
        (22, SAMPLE_RATE_HZ, "bandwidth"),
        (26, PULSE_S, "pulse width"),
        (38, 0.1, "envelope parameter"),
        (46, 5.0, "max ping rate"),
        (50, 0.25, "ping period"),
        (54, 75.0, "range"),
        (58, 210.0, "power"),
        (62, 20.0, "gain"),
        (74, 0.0, "steering"),
        // lambda is 0.015 m. The width is 0.886 lambda / L; for the short side, the arc sine matters.
        (82, 2.0 * (0.442_946_47_f64 * 0.015 / 0.5).asin(), "along"),
        (86, 2.0 * (0.442_946_47_f64 * 0.015 / 0.02).asin(), "across"),
        (122, 0.31, "receive width"),
        (142, 100.0, "absorption dB/km"),
        (146, SOUND_M_PER_S, "sound"),
        (150, 30.0, "spreading"),
    ] {
        close(f64::from(f32_at(b, at)), want, what);
    }
    customary(f32_at(b, 82));
    assert_eq!((u32_at(b, 30), u32_at(b, 34)), (1, 1), "chirp, Tukey");
    assert_eq!(u32_at(b, 66), 0x9800_8000, "simulator, stamps ok, active");
    assert_eq!(u32_at(b, 118), 0x1_1000, "matched filter, gain");
}

#[test]
fn settings_7503_hold_the_head_and_the_state_too() {
    let bytes = one(7503);
    let s = RemoteSettings7503::parse(body(&bytes)).expect("7503");
    assert_eq!((s.ping_number, s.ping_state), (9, 1));
    let b = &bytes[RTH..];
    assert_eq!(b.len(), 260 + 4);
    for (at, want, what) in [
        (12, 100_000.0, "frequency"),
        (44, 5.0, "max ping rate"),
        (52, 75.0, "range"),
        (56, 210.0, "power"),
        (60, 20.0, "gain"),
        (136, 100.0, "absorption"),
        (140, SOUND_M_PER_S, "sound"),
        (150, -0.25, "x: starboard"),
        (154, 0.5, "y: forward"),
        (158, -0.125, "z: up"),
        (162, 0.0, "tilt about x"),
        (
            166,
            -std::f64::consts::FRAC_PI_3,
            "tilt about y: as our roll",
        ),
        (224, 2.0, "coverage"),
        (252, 100_000.0, "applied frequency"),
    ] {
        close(f64::from(f32_at(b, at)), want, what);
    }
    assert_eq!(u32_at(b, 64), 0x9800_8000);
    assert_eq!((u32_at(b, 174), u16_at(b, 178)), (1, 1));
}

#[test]
fn beam_geometry_is_port_first_in_four_blocks() {
    let bytes = one(7004);
    let g = BeamGeometry7004::parse(body(&bytes)).expect("7004");
    assert_eq!(g.beams, 4);
    let b = &bytes[RTH..];
    assert_eq!((u64_at(b, 0), u32_at(b, 8)), (SERIAL, 4));
    for (beam, (angle, width)) in [(-0.75, 0.4), (-0.25, 0.3), (0.25, 0.31), (0.75, 0.41)]
        .into_iter()
        .enumerate()
    {
        let at = 12 + 4 * beam;
        assert_eq!(f32_at(b, at), 0.0, "along track");
        assert_eq!(f32_at(b, at + 16), angle);
        customary(f32_at(b, at + 32));
        assert_eq!(f32_at(b, at + 48), width);
    }
}

#[test]
fn side_scan_7007_is_port_then_starboard_in_counts_of_full_scale() {
    let bytes = one(7007);
    let s = SideScan7007::parse(body(&bytes)).expect("7007");
    let counts =
        |scale: f64| move |k: usize| (scale * k as f64 / FULL_SCALE_V * 65535.0).round() as u32;
    let (port, starboard) = (counts(0.001), counts(0.002));
    assert!(s.port().eq((0..6).map(port)));
    assert!(s.starboard().eq((0..6).map(starboard)));
    let b = &bytes[RTH..];
    assert_eq!((u32_at(b, 8), u32_at(b, 22)), (9, 6), "ping, samples");
    assert_eq!((u16_at(b, 58), b[62]), (1, 2), "beams, bytes per sample");
    for k in 0..6 {
        assert_eq!(u32::from(u16_at(b, 64 + 2 * k)), port(k));
        assert_eq!(u32::from(u16_at(b, 64 + 12 + 2 * k)), starboard(k));
    }
}

#[test]
fn a_side_that_is_not_there_is_silent() {
    let mut output = output(6);
    output.lines.retain(|line| line.side == Side::Starboard);
    let (records, _) = emitted(&plan(1, 6), &output, RecordSet::of(&[7007]));
    let s = SideScan7007::parse(body(&records[0].bytes)).expect("7007");
    assert!(s.port().eq([0; 6]) && s.starboard().nth(5) == Some(328));
}

#[test]
fn beams_7018_lie_sample_by_sample_from_range_zero() {
    let mut plan = plan(9, 6);
    plan.first_sample_s = 2.0 / SAMPLE_RATE_HZ;
    let (records, saturated) = emitted(&plan, &output(6), RecordSet::of(&[7018]));
    assert_eq!(saturated, 0);
    let bytes = &records[0].bytes;
    let beams = Beamformed7018::parse(body(bytes)).expect("7018");
    assert_eq!((beams.rth.samples, beams.rth.beams), (2 + 6, 4));
    let b = &bytes[RTH..];
    assert_eq!((u32_at(b, 8), u16_at(b, 14), u32_at(b, 16)), (9, 4, 8));
    for k in 0..8_usize {
        for beam in 0..4_usize {
            let at = 52 + 4 * (k * 4 + beam);
            let (want_amplitude, want_phase) = if k < 2 {
                (0, 0)
            } else {
                let amplitude = 0.23 * (beam + 1) as f64 / FULL_SCALE_V * 65535.0;
                let phase = (-1.0 + 0.001 * (k - 2) as f64) * 10_430.0;
                (amplitude.round() as u16, phase.round() as i16)
            };
            let got = (u16_at(b, at), i16_at(b, at + 2));
            assert_eq!(got, (want_amplitude, want_phase), "sample {k} beam {beam}");
            let parsed = beams.sample(k as u32, beam as u16).expect("there");
            assert_eq!((parsed.amplitude, parsed.phase), got);
        }
    }
}

#[test]
fn beams_7042_have_the_samples_of_7018() {
    let wanted = RecordSet::of(&[7018, 7042]);
    let (records, _) = emitted(&plan(9, 6), &output(6), wanted);
    let beams = Beamformed7018::parse(body(&records[0].bytes)).expect("7018");
    let column = WaterColumn7042::parse(body(&records[1].bytes)).expect("7042");
    let silent = beams.rth.samples - 6;
    assert_eq!(
        (column.beams().count(), column.rth.first_sample),
        (4, silent)
    );
    for beam in column.beams() {
        assert_eq!(beam.samples().len(), 6);
        for (k, sample) in (silent..).zip(beam.samples()) {
            let want = beams.sample(k, beam.beam).expect("there");
            assert_eq!(sample, (want.amplitude.into(), want.phase));
        }
    }
    // Without 7018 the record is the same.
    assert_eq!(records[1].bytes, one(7042));
}

#[test]
fn elements_7038_are_those_of_the_configured_arrays_in_their_order() {
    let mut plan = plan(9, 6);
    plan.first_sample_s = 3.0 / SAMPLE_RATE_HZ;
    let (records, saturated) = emitted(&plan, &output(6), RecordSet::of(&[7038]));
    assert_eq!(saturated, 0);
    let bytes = &records[0].bytes;
    let raw = RawIq7038::parse(body(bytes)).expect("7038");
    assert!(raw.element_numbers().eq(0..5));
    let b = &bytes[RTH..];
    assert_eq!((u64_at(b, 0), u32_at(b, 8)), (SERIAL, 9));
    assert_eq!(
        (u16_at(b, 14), u32_at(b, 16), u16_at(b, 20)),
        (10, 9, 5),
        "elements of the sonar, samples in the ping, elements here"
    );
    assert_eq!(
        (u32_at(b, 22), u32_at(b, 26), u16_at(b, 30)),
        (3, 8, 16),
        "start, stop, sample type"
    );
    let columns = [(1, 0), (1, 1), (1, 2), (0, 0), (0, 1)];
    for k in 0..6 {
        for (column, &(array, element)) in columns.iter().enumerate() {
            let v = volts(array, element, k) / FULL_SCALE_V * 32767.0;
            let want = [v.re.round() as i16, v.im.round() as i16];
            let at = 60 + 2 * 5 + 4 * (k * 5 + column);
            assert_eq!([i16_at(b, at), i16_at(b, at + 2)], want, "{k} {column}");
            assert_eq!(raw.iq(k as u32, column as u16), Some(want));
        }
    }
}

#[test]
fn values_out_of_range_are_clipped_and_counted() {
    let mut output = output(6);
    output.elements[0].iq[0].re = 2.0 * FULL_SCALE_V;
    output.elements[1].iq[1].im = -2.0 * FULL_SCALE_V;
    output.elements[2].iq[0].re = 9.0 * FULL_SCALE_V; // not part of the record
    output.beams[0].iq[0] *= 100.0;
    output.lines[0].amplitude[3] = 2.5;
    for (id, want) in [(7038, 2), (7018, 1), (7007, 1), (7000, 0)] {
        let (_, saturated) = emitted(&plan(1, 6), &output, RecordSet::of(&[id]));
        assert_eq!(saturated, want, "{id}");
    }
}

#[test]
fn navigation_has_the_signs_of_the_format() {
    let bytes = one(1003);
    let p = Position1003::parse(body(&bytes)).expect("1003");
    assert_eq!((p.height_m, p.positioning_method), (-12.5, 15));
    let b = &bytes[RTH..];
    assert_eq!(u32_at(b, 0), 0, "WGS84");
    assert_eq!(
        (f64_at(b, 8), f64_at(b, 16), f64_at(b, 24), b[32], b[35]),
        (0.9, -0.1, -12.5, 0, 15)
    );
    let bytes = one(1012);
    let a = RollPitchHeave1012::parse(body(&bytes)).expect("1012");
    assert_eq!(
        (a.roll_rad, a.pitch_rad, a.heave_up_m),
        (0.03, -0.02, -0.75)
    );
    let b = &bytes[RTH..];
    assert_eq!(
        (f32_at(b, 0), f32_at(b, 4), f32_at(b, 8)),
        (0.03, -0.02, -0.75)
    );
    assert_eq!(f32_at(&one(1013)[RTH..], 0), 4.5);
    assert_eq!(f32_at(&one(7610)[RTH..], 0), 1500.0);
}

#[test]
fn depth_1008_is_that_without_heave_and_only_where_the_plan_tells_it() {
    let mut plan = plan(1, 6);
    let wanted = RecordSet::of(&[1008]);
    assert!(emitted(&plan, &output(6), wanted).0.is_empty());
    plan.sensor.still_depth_m = Some(11.75);
    let (records, _) = emitted(&plan, &output(6), wanted);
    let b = &records[0].bytes[RTH..];
    assert_eq!(
        (b[0], b[1], f32_at(b, 4), b.len()),
        (0, 1, 11.75, 8 + 4),
        "depth of the sensor, relative to the mean sea level"
    );
    plan.nav.invalid.vertical = true;
    assert!(emitted(&plan, &output(6), wanted).0.is_empty());
}

#[test]
fn descriptions_hold_the_mounting_and_a_profile_of_one_sound_velocity() {
    let mut nav = echotank_testing::nav::nav(Vec::new());
    nav.vertical = VerticalSpec::Waterline {
        reference_down_m: 0.5,
    };
    let mut sonar = sonar();
    let rolled = rotation_from_angles(-0.3, 0.0, 0.0);
    sonar.transmit[0].mounting.position_m = DVec3::new(0.1, -0.2, 0.8);
    sonar.transmit[0].mounting.body_from_array = rolled;
    // A line across the track, with +x to starboard.
    sonar.receive[0].mounting.body_from_array = rotation_from_angles(0.0, 0.2, 0.0)
        * rotation_from_angles(0.0, 0.0, std::f64::consts::FRAC_PI_2);
    let sheet = DeviceSheet::new(&output_spec(), &sonar, SOUND_M_PER_S, 0.0);
    let [installation, profile] = sheet.with_navigation(&nav).descriptions(TRANSMIT_UTC);
    assert_eq!(
        (installation.record_type, profile.record_type),
        (7030, 1009)
    );

    let i = Installation7030::parse(body(&installation.bytes)).expect("7030");
    assert_eq!(f64::from(i.frequency_hz), sonar.pulse.center_frequency_hz);
    assert!(i.software.text().starts_with("echotank "));
    let t = i.transmit;
    assert_eq!((t.x_m, t.y_m, t.z_m), (-0.2, 0.1, -0.8));
    close(f64::from(t.roll_rad), -0.3, "roll of the transmitter");
    assert_eq!((t.pitch_rad, t.heading_rad), (0.0, 0.0));
    close(f64::from(i.receive.pitch_rad), 0.2, "pitch of the receiver");
    assert!(i.receive.heading_rad.abs() < 1e-6 && i.receive.roll_rad.abs() < 1e-6);
    assert_eq!(
        (i.waterline_m, i.motion_sensor),
        (0.5, MountingOffset::default())
    );

    let p = SoundVelocityProfile1009::parse(body(&profile.bytes)).expect("1009");
    assert_eq!(p.rth.position_flag, 0, "no position");
    let samples: Vec<_> = p.samples().collect();
    assert_eq!((samples.len(), samples[0].depth_m), (2, 0.0));
    assert!(samples[1].depth_m > 11_000.0, "below all oceans");
    for sample in samples {
        assert_eq!(f64::from(sample.sound_velocity_m_per_s), SOUND_M_PER_S);
    }
}

#[test]
fn a_new_profile_is_sent_with_its_first_ping_and_described_from_then_on() {
    let sheet = DeviceSheet::new(&output_spec(), &sonar(), SOUND_M_PER_S, 0.0);
    let mut emitter = SevenKEmitter::new(Arc::new(sheet), 2);
    let mut profiles = |points: &[(f64, f64)]| {
        let profile = Arc::new(SoundSpeedProfile::new(points.to_vec()).expect("sound"));
        let mut plan = plan(9, 6);
        plan.refraction = Some(Refraction {
            profile,
            array_m: DVec3::ZERO,
            floor_m: 50.0,
            reflections: None,
            places: Default::default(),
        });
        let sent = [(); 2].map(|()| {
            let mut records = Vec::new();
            emitter.emit_ping(
                &plan,
                &output(6),
                RecordSet::of(&[1009, 7610]),
                &mut records,
            );
            records.iter().map(|r| r.record_type).collect::<Vec<_>>()
        });
        let [_, described] = emitter.sheet().descriptions(TRANSMIT_UTC);
        let p = SoundVelocityProfile1009::parse(body(&described.bytes)).expect("1009");
        let samples = p.samples();
        let points = samples.map(|s| (s.depth_m.into(), s.sound_velocity_m_per_s.into()));
        (sent, points.collect::<Vec<(f64, f64)>>())
    };
    for points in [
        [(0.0, 1500.0), (20.0, 1480.5)],
        [(0.5, 1490.0), (30.0, 1475.0)],
    ] {
        let want = [vec![1009, 7610], vec![7610]];
        assert_eq!(profiles(&points), (want, points.to_vec()));
    }
}

#[test]
fn files_of_common_records_leave_out_what_common_readers_do_not_know() {
    let mut output = output_spec();
    let of =
        |output: &SevenKSpec| DeviceSheet::new(output, &sonar(), SOUND_M_PER_S, 0.0).file_records();
    assert_eq!(of(&output), RecordSet::ALL);
    output.has_common_files = true;
    let left_out = RecordSet::ALL.without(of(&output));
    let left_out: Vec<u32> = left_out.iter().collect();
    assert_eq!(left_out, [7038, 7042, 7057, 10_038]);
}

#[test]
fn configuration_7001_describes_the_sonar_in_xml_closed_by_one_counted_nul() {
    let datagram = sheet().configuration_7001(TRANSMIT_UTC);
    let bytes = &datagram.bytes;
    let c = Configuration7001::parse(body(bytes)).expect("7001");
    assert_eq!((c.modules.len(), c.modules[0].identifier), (1, DEVICE));
    // Readers take the serial number from the digits after "SN" (NOAA's Kluster).
    let description = &c.modules[0].description;
    let digits = description.strip_prefix("SN").expect("as devices write it");
    let digits = digits.split(' ').next().expect("digits");
    assert_eq!(digits.parse::<u64>(), Ok(sonar().serial), "{description}");
    let b = &bytes[RTH..];
    let len = u32_at(b, 88) as usize;
    let xml = &b[92..92 + len];
    assert_eq!(b.len(), 92 + len + 4);
    assert_eq!(xml.iter().filter(|&&c| c == 0).count(), 1);
    assert_eq!(xml.last(), Some(&0));
    let text = std::str::from_utf8(&xml[..len - 1]).expect("UTF-8");
    assert!(
        text.contains("name=\"rig &lt;1&gt; &amp; &quot;co&quot;\""),
        "{text}"
    );
    assert!(text.contains("simulator=\"true\""));
    for (name, first) in [("starboard", 0), ("port", 3)] {
        let line = text
            .lines()
            .find(|l| l.contains("<receive") && l.contains(name));
        let line = line.expect("a receive array");
        assert!(
            line.contains(&format!("first_element_7038=\"{first}\"")),
            "{line}"
        );
    }
    assert!(
        !text
            .lines()
            .any(|l| l.contains("\"fan\"") && l.contains("first_element")),
        "the fan's elements are not in 7038"
    );
}

#[test]
fn continuous_waves_and_rectangles_are_named() {
    let mut plan = plan(1, 6);
    plan.pulse.kind = echotank_core::pulse::PulseKind::Cw;
    plan.pulse.taper = 0.0;
    let (records, _) = emitted(&plan, &output(6), RecordSet::of(&[7000]));
    let b = &records[0].bytes[RTH..];
    assert_eq!((u32_at(b, 30), u32_at(b, 34)), (0, 4));
}

//! Golden vectors: bytes written from the byte tables of the DFD (files in `golden/`, and short ones here), never by the encoder. Every
//! record is parsed from them and emitted bit for bit.

use crate::support::{STAMP, emitted_body};
use echotank_protocols::sevenk::control::{Ack7501, ControlHeader, Nack7502};
use echotank_protocols::sevenk::file::{
    Catalogue7300, CataloguePointer, CatalogueRow, FileDevice, FileHeader7200, emit_7300,
};
use echotank_protocols::sevenk::records::*;
use echotank_protocols::sevenk::{
    ControlRequest, DataRecordFrame, ErrorCode, NetworkFrame, Packetiser, Record, describe,
};

/// Bytes of a text of hex pairs, with comments after `#`.
fn hex(text: &str) -> Vec<u8> {
    text.lines()
        .flat_map(|line| {
            line.split('#')
                .next()
                .unwrap_or_default()
                .split_whitespace()
        })
        .map(|pair| u8::from_str_radix(pair, 16).expect("two hex digits"))
        .collect()
}

macro_rules! golden {
    ($name:literal) => {
        hex(include_str!(concat!("../golden/", $name)))
    };
}

#[test]
fn network_frame_is_at_its_offsets() {
    let bytes = golden!("network_frame.hex");
    let frame = NetworkFrame {
        protocol_version: 5,
        offset_bytes: 36,
        total_packets: 1,
        total_records: 1,
        transmission_id: 505,
        packet_size_bytes: 136,
        total_size_bytes: 100,
        sequence_number: 0,
        dest_device_id: 100_009,
        dest_enumerator: 510,
        source_enumerator: 511,
        source_device_id: 100_012,
    };
    assert_eq!(NetworkFrame::parse(&bytes), Ok(frame));
    assert_eq!(frame.check(100), Ok(()));
    let mut buf = Vec::new();
    frame.emit(&mut buf);
    assert_eq!(buf, bytes);
}

#[test]
fn data_record_frame_is_at_its_offsets() {
    let bytes = golden!("data_record_frame.hex");
    let frame = DataRecordFrame {
        protocol_version: 5,
        offset_bytes: 60,
        sync_pattern: 0x0000_FFFF,
        size_bytes: 500,
        optional_data_offset_bytes: 400,
        optional_data_id: 7300,
        time: STAMP.time,
        record_version: 1,
        record_type_id: 7200,
        device_id: 7125,
        system_enumerator: 1,
        flags: 0x8001,
        total_records_in_fragmented_set: 0,
        fragment_number: 0,
    };
    assert_eq!(DataRecordFrame::parse(&bytes), Ok(frame));
    assert_eq!(frame.check(), Ok(()));
    let mut buf = Vec::new();
    frame.emit(&mut buf);
    assert_eq!(buf, bytes);
}

/// Heading 1.5 rad, whole packet, with a checksum computed by hand.
const HEADING_PACKET: &str = "
    05 00 24 00  01 00 00 00  01 00  00 00   # network frame: version 5, offset 36, 1 packet, 1 record, transmission 0
    6c 00 00 00  48 00 00 00  00 00 00 00    # packet 108, record 72, sequence 0
    00 00 00 00  00 00  01 00  d5 1b 00 00   # to 0:0, from enumerator 1 of device 7125
    05 00 3c 00  ff ff 00 00  48 00 00 00    # data record frame: version 5, offset 60, sync, size 72
    00 00 00 00  00 00 00 00                 # no optional data
    e9 07  a6 00  00 00 22 42  0f  06        # 2025, day 166, 40.5 s, 15 h, 6 min
    01 00  f5 03 00 00  d5 1b 00 00          # version 1, type 1013, device 7125
    00 00  01 00  00 00 00 00  01 00  00 00  # enumerator 1, flags: checksum valid
    00 00 00 00  00 00 00 00  00 00 00 00
    00 00 c0 3f                              # 1.5
    80 07 00 00                              # 1920 = 647 + 527 + 489 + 2 + 255: the byte sums of the record's lines
";

#[test]
fn a_whole_heading_packet_is_bit_for_bit() {
    let mut record = Vec::new();
    Heading1013 { heading_rad: 1.5 }.emit(&mut record, &STAMP);
    let mut packets = Vec::new();
    let ranges = Packetiser::default().packetise(&record, &mut packets);
    assert_eq!(ranges.len(), 1);
    let expected = hex(HEADING_PACKET);
    assert_eq!(packets, expected);
    assert!(
        describe(&record)
            .to_string()
            .contains("heading: 85.944 deg"),
        "{}",
        describe(&record)
    );
}

#[test]
fn sonar_settings_7000_are_at_their_offsets() {
    let bytes = golden!("7000.hex");
    let settings = SonarSettings7000 {
        sonar_id: 1099511627784,
        ping_number: 100002,
        multi_ping_sequence: 503,
        frequency_hz: 4.5,
        sample_rate_hz: 5.5,
        receiver_bandwidth_hz: 6.5,
        tx_pulse_width_s: 7.5,
        tx_pulse_type: 100008,
        tx_pulse_envelope: 100009,
        tx_pulse_envelope_parameter: 10.5,
        tx_pulse_mode: 511,
        max_ping_rate_hz: 13.5,
        ping_period_s: 14.5,
        range_m: 15.5,
        power_db: 16.5,
        gain_db: 17.5,
        control_flags: 100018,
        projector_id: 100019,
        projector_steer_vertical_rad: 20.5,
        projector_steer_horizontal_rad: 21.5,
        projector_beam_width_vertical_rad: 22.5,
        projector_beam_width_horizontal_rad: 23.5,
        projector_focal_point_m: 24.5,
        projector_weighting_type: 100025,
        projector_weighting_parameter: 26.5,
        transmit_flags: 100027,
        hydrophone_id: 100028,
        receive_weighting_type: 100029,
        receive_weighting_parameter: 30.5,
        receive_flags: 100031,
        receive_beam_width_rad: 32.5,
        bottom_filter_min_range_m: 33.5,
        bottom_filter_max_range_m: 34.5,
        bottom_filter_min_depth_m: 35.5,
        bottom_filter_max_depth_m: 36.5,
        absorption_db_per_km: 37.5,
        sound_velocity_m_per_s: 38.5,
        spreading_db: 39.5,
    };
    assert_eq!(SonarSettings7000::parse(&bytes), Ok(settings));
    assert_eq!(emitted_body(|buf| settings.emit(buf, &STAMP)), bytes);
}

#[test]
fn remote_settings_7503_are_at_their_offsets() {
    let bytes = golden!("7503.hex");
    let settings = RemoteSettings7503 {
        sonar_id: 1099511627784,
        ping_number: 100002,
        frequency_hz: 3.5,
        sample_rate_hz: 4.5,
        receiver_bandwidth_hz: 5.5,
        tx_pulse_width_s: 6.5,
        tx_pulse_type: 100007,
        tx_pulse_envelope: 100008,
        tx_pulse_envelope_parameter: 9.5,
        tx_pulse_mode: 510,
        max_ping_rate_hz: 12.5,
        ping_period_s: 13.5,
        range_m: 14.5,
        power_db: 15.5,
        gain_db: 16.5,
        control_flags: 100017,
        projector_id: 100018,
        projector_steer_vertical_rad: 19.5,
        projector_steer_horizontal_rad: 20.5,
        projector_beam_width_vertical_rad: 21.5,
        projector_beam_width_horizontal_rad: 22.5,
        projector_focal_point_m: 23.5,
        projector_weighting_type: 100024,
        projector_weighting_parameter: 25.5,
        transmit_flags: 100026,
        hydrophone_id: 100027,
        receive_weighting_type: 100028,
        receive_weighting_parameter: 29.5,
        receive_flags: 100030,
        bottom_filter_min_range_m: 31.5,
        bottom_filter_max_range_m: 32.5,
        bottom_filter_min_depth_m: 33.5,
        bottom_filter_max_depth_m: 34.5,
        absorption_db_per_km: 35.5,
        sound_velocity_m_per_s: 36.5,
        spreading_db: 37.5,
        vernier_operation_mode: 38,
        automatic_filter_window_percent: 39,
        tx_array_offset_x_m: 40.5,
        tx_array_offset_y_m: 41.5,
        tx_array_offset_z_m: 42.5,
        head_tilt_x_rad: 43.5,
        head_tilt_y_rad: 44.5,
        head_tilt_z_rad: 45.5,
        ping_state: 100046,
        beam_spacing_mode: 547,
        sonar_mode: 548,
        adaptive_gate_min_depth_m: 49.5,
        adaptive_gate_max_depth_m: 50.5,
        trigger_out_width_s: 51.25,
        trigger_out_offset_s: 52.25,
        seabat_81xx_projector: 553,
        seabat_81xx_alternate_gain_db: 55.5,
        vernier_filter: 56,
        custom_beams: 558,
        coverage_angle_rad: 59.5,
        coverage_mode: 60,
        quality_filter_flags: 61,
        rx_horizontal_steering_rad: 62.5,
        flex_sector_coverage_rad: 63.5,
        flex_sector_steering_rad: 64.5,
        constant_spacing_m: 65.5,
        beam_mode_selection: 566,
        depth_gate_tilt_rad: 67.5,
        applied_frequency_hz: 68.5,
        element_number: 100069,
    };
    assert_eq!(RemoteSettings7503::parse(&bytes), Ok(settings));
    assert_eq!(emitted_body(|buf| settings.emit(buf, &STAMP)), bytes);
}

#[test]
fn platform_records_are_at_their_offsets() {
    let position = Position1003 {
        datum_id: 100_001,
        latency_s: 2.5,
        latitude_rad_or_northing_m: 3.25,
        longitude_rad_or_easting_m: 4.25,
        height_m: 5.25,
        position_type: 6,
        utm_zone: 7,
        quality_flag: 8,
        positioning_method: 9,
        satellites: 10,
    };
    let bytes = golden!("1003.hex");
    assert_eq!(Position1003::parse(&bytes), Ok(position));
    assert_eq!(emitted_body(|buf| position.emit(buf, &STAMP)), bytes);

    let attitude = RollPitchHeave1012 {
        roll_rad: 1.5,
        pitch_rad: 2.5,
        heave_up_m: 3.5,
    };
    let bytes = golden!("1012.hex");
    assert_eq!(RollPitchHeave1012::parse(&bytes), Ok(attitude));
    assert_eq!(emitted_body(|buf| attitude.emit(buf, &STAMP)), bytes);

    let heading = Heading1013 { heading_rad: 1.5 };
    let bytes = golden!("1013.hex");
    assert_eq!(Heading1013::parse(&bytes), Ok(heading));
    assert_eq!(emitted_body(|buf| heading.emit(buf, &STAMP)), bytes);

    let sound = SoundVelocity7610 {
        sound_velocity_m_per_s: 1.5,
        temperature_k: 2.5,
        pressure_pa: 3.5,
    };
    let bytes = golden!("7610.hex");
    assert_eq!(SoundVelocity7610::parse(&bytes), Ok(sound));
    assert_eq!(emitted_body(|buf| sound.emit(buf, &STAMP)), bytes);

    let depth = Depth1008 {
        descriptor: 1,
        correction: 2,
        depth_m: 1.5,
    };
    let bytes = hex("01 02 00 00  00 00 c0 3f");
    assert_eq!(Depth1008::parse(&bytes), Ok(depth));
    assert_eq!(emitted_body(|buf| depth.emit(buf, &STAMP)), bytes);
}

#[test]
fn sound_velocity_profile_1009_is_at_its_offsets() {
    let bytes = hex("
        01 00 00 00               # 0 u8 position flag = 1, reserved
        00 00 00 00 00 00 f8 3f   # 4 f64 latitude = 1.5
        00 00 00 00 00 00 04 40   # 12 f64 longitude = 2.5
        02 00 00 00               # 20 u32 samples = 2
        00 00 c0 3f  00 00 20 40  # depth 1.5, velocity 2.5
        00 00 60 40  00 00 90 40  # depth 3.5, velocity 4.5
    ");
    let profile = SoundVelocityProfile1009::parse(&bytes).expect("1009");
    let rth = Rth1009 {
        position_flag: 1,
        latitude_rad: 1.5,
        longitude_rad: 2.5,
        samples: 2,
    };
    assert_eq!(profile.rth, rth);
    let samples: Vec<_> = profile.samples().collect();
    let said: Vec<_> = samples
        .iter()
        .map(|s| (s.depth_m, s.sound_velocity_m_per_s))
        .collect();
    assert_eq!(said, [(1.5, 2.5), (3.5, 4.5)]);
    let got = emitted_body(|buf| emit_1009(buf, &STAMP, &Rth1009 { samples: 0, ..rth }, &samples));
    assert_eq!(got, bytes);
}

#[test]
fn installation_7030_is_at_its_offsets() {
    // From table 79: a frequency, four texts with their lengths, 12 numbers of two arrays, six of a sensor, a delay, three numbers of
    // another, a delay, and the waterline.
    let mut bytes = 1.5_f32.to_le_bytes().to_vec();
    for text in ["a", "bc", "def", "ghij"] {
        bytes.extend((text.len() as u16).to_le_bytes());
        let mut field = [0; 128];
        field[..text.len()].copy_from_slice(text.as_bytes());
        bytes.extend(field);
    }
    let numbers =
        |from: u16, count: u16| (from..from + count).flat_map(|n| f32::from(n).to_le_bytes());
    bytes.extend(numbers(1, 18));
    bytes.extend(700_u16.to_le_bytes());
    bytes.extend(numbers(19, 3));
    bytes.extend(800_u16.to_le_bytes());
    bytes.extend(numbers(22, 1));
    assert_eq!(bytes.len(), Installation7030::RTH_BYTES);
    let offset = |first: f32| MountingOffset {
        x_m: first,
        y_m: first + 1.0,
        z_m: first + 2.0,
        roll_rad: first + 3.0,
        pitch_rad: first + 4.0,
        heading_rad: first + 5.0,
    };
    let installation = Installation7030 {
        frequency_hz: 1.5,
        firmware: Version::new("a"),
        software: Version::new("bc"),
        sevenk_software: Version::new("def"),
        record_protocol: Version::new("ghij"),
        transmit: offset(1.0),
        receive: offset(7.0),
        motion_sensor: offset(13.0),
        motion_delay_ms: 700,
        position_sensor_m: [19.0, 20.0, 21.0],
        position_delay_ms: 800,
        waterline_m: 22.0,
    };
    assert_eq!(Installation7030::parse(&bytes), Ok(installation));
    assert_eq!(installation.record_protocol.text(), "ghij");
    assert_eq!(emitted_body(|buf| installation.emit(buf, &STAMP)), bytes);
}

const SONAR_ID: u64 = (1 << 40) + 8;

#[test]
fn raw_iq_7038_is_ordered_by_sample_then_element() {
    let mut bytes = golden!("7038_rth.hex");
    bytes.extend(hex("
        00 00  01 00                 # elements 0, 1
        01 00 ff ff   02 00 fe ff    # sample 3: 1 - 1i, 2 - 2i
        03 00 fd ff   04 00 fc ff    # sample 4: 3 - 3i, 4 - 4i
        00 80 ff 7f   05 01 06 02    # sample 5: -32768 + 32767i, 0x0105 + 0x0206i
    "));
    let rth = Rth7038 {
        sonar_serial: SONAR_ID,
        ping_number: 100_002,
        channel_count: 8,
        samples: 10,
        elements: 2,
        start_sample: 3,
        stop_sample: 5,
        sample_type: 16,
    };
    let iq = [
        [1, -1],
        [2, -2],
        [3, -3],
        [4, -4],
        [-32768, 32767],
        [0x0105, 0x0206],
    ];
    let by_element = [iq[0], iq[2], iq[4], iq[1], iq[3], iq[5]];
    let record = RawIq7038::parse(&bytes).unwrap();
    assert_eq!(record.rth, rth);
    assert_eq!(record.element_numbers().collect::<Vec<_>>(), [0, 1]);
    assert_eq!(record.iq_sample_major().collect::<Vec<_>>(), iq);
    assert_eq!(record.iq(2, 1), Some([0x0105, 0x0206]));
    assert_eq!((record.iq(3, 0), record.iq(0, 2)), (None, None));
    assert_eq!(
        emitted_body(|buf| emit_7038(buf, &STAMP, &rth, &[0, 1], &iq)),
        bytes
    );
    assert_eq!(
        emitted_body(|buf| emit_7038_element_major(buf, &STAMP, &rth, &[0, 1], &by_element)),
        bytes
    );
}

#[test]
fn beamformed_7018_is_ordered_by_sample_then_beam() {
    let mut bytes = golden!("7018_rth.hex");
    bytes.extend(hex("
        01 00 ff ff   02 00 fe ff
        03 00 fd ff   04 00 fc ff
        ff ff 00 80   00 00 be 28    # 65535 at -32768 counts, 0 at 10430 counts (1 rad)
    "));
    let rth = Rth7018 {
        sonar_id: SONAR_ID,
        ping_number: 100_002,
        multi_ping_sequence: 503,
        beams: 2,
        samples: 3,
    };
    let sample = |amplitude, phase| BeamSample { amplitude, phase };
    let samples = [
        sample(1, -1),
        sample(2, -2),
        sample(3, -3),
        sample(4, -4),
        sample(65535, -32768),
        sample(0, 10430),
    ];
    let record = Beamformed7018::parse(&bytes).unwrap();
    assert_eq!(record.rth, rth);
    assert_eq!(record.samples().collect::<Vec<_>>(), samples);
    assert_eq!(
        (
            record.sample(2, 0),
            record.sample(3, 0),
            record.sample(0, 2)
        ),
        (Some(samples[4]), None, None)
    );
    assert_eq!(f32::from(samples[5].phase), PHASE_COUNTS_PER_RAD);
    assert_eq!(
        emitted_body(|buf| emit_7018(buf, &STAMP, &rth, &samples)),
        bytes
    );
}

#[test]
fn side_scan_7007_has_port_before_starboard_in_all_widths() {
    let mut bytes = golden!("7007_rth.hex");
    bytes.extend(hex("01 00  02 00  ff ff    04 00  05 00  06 01"));
    let rth = Rth7007 {
        sonar_id: SONAR_ID,
        ping_number: 100_002,
        multi_ping_sequence: 503,
        beam_position_m: 4.5,
        control_flags: 100_005,
        samples_per_side: 3,
        nadir_depth_samples: 100_007,
        beams_per_side: 1,
        current_beam: 0,
        bytes_per_sample: 2,
        data_types: 0,
    };
    let record = SideScan7007::parse(&bytes).unwrap();
    assert_eq!(record.rth, rth);
    assert_eq!(record.port().collect::<Vec<_>>(), [1, 2, 65535]);
    assert_eq!(record.starboard().collect::<Vec<_>>(), [4, 5, 0x0106]);
    // Fields that follow from the slices are not required of the caller.
    let asked = Rth7007 {
        samples_per_side: 0,
        bytes_per_sample: 0,
        beams_per_side: 0,
        ..rth
    };
    let words = SideSamples::U16 {
        port: &[1, 2, 65535],
        starboard: &[4, 5, 0x0106],
    };
    assert_eq!(
        emitted_body(|buf| emit_7007(buf, &STAMP, &asked, &words)),
        bytes
    );

    let (mut narrow, mut wide) = (golden!("7007_rth.hex"), golden!("7007_rth.hex"));
    narrow[62] = 1;
    narrow.extend(hex("01 02 ff 04 05 06"));
    let samples = SideSamples::U8 {
        port: &[1, 2, 255],
        starboard: &[4, 5, 6],
    };
    assert_eq!(
        emitted_body(|buf| emit_7007(buf, &STAMP, &asked, &samples)),
        narrow
    );
    assert_eq!(
        SideScan7007::parse(&narrow)
            .unwrap()
            .starboard()
            .collect::<Vec<_>>(),
        [4, 5, 6]
    );
    wide[62] = 4;
    wide.extend(hex(
        "01 00 00 00 02 00 00 00 ff ff ff ff 04 00 00 00 05 00 00 00 06 00 01 00",
    ));
    let samples = SideSamples::U32 {
        port: &[1, 2, u32::MAX],
        starboard: &[4, 5, 0x0001_0006],
    };
    assert_eq!(
        emitted_body(|buf| emit_7007(buf, &STAMP, &asked, &samples)),
        wide
    );
    assert_eq!(
        SideScan7007::parse(&wide)
            .unwrap()
            .port()
            .collect::<Vec<_>>(),
        [1, 2, u32::MAX]
    );
}

#[test]
fn beam_geometry_7004_has_four_blocks_of_angles() {
    let mut bytes = golden!("7004_rth.hex");
    bytes.extend(hex("
        00 00 00 00  00 00 00 3f    # along track 0, 0.5
        00 00 80 bf  00 00 80 3f    # across track -1, 1
        00 00 80 3e  00 00 00 3e    # width along track 0.25, 0.125
        00 00 80 3d  00 00 00 40    # width across track 0.0625, 2
    "));
    let angles = BeamAngles {
        along_track_rad: &[0.0, 0.5],
        across_track_rad: &[-1.0, 1.0],
        width_y_rad: &[0.25, 0.125],
        width_x_rad: &[0.0625, 2.0],
    };
    assert_eq!(
        emitted_body(|buf| emit_7004(buf, &STAMP, SONAR_ID, &angles)),
        bytes
    );
    let record = BeamGeometry7004::parse(&bytes).unwrap();
    assert_eq!((record.sonar_id, record.beams), (SONAR_ID, 2));
    assert_eq!(record.along_track_rad(1), Some(0.5));
    assert_eq!(record.across_track_rad(0), Some(-1.0));
    assert_eq!(record.width_y_rad(1), Some(0.125));
    assert_eq!(
        (record.width_x_rad(1), record.width_x_rad(2)),
        (Some(2.0), None)
    );
}

#[test]
fn configuration_7001_closes_its_xml_with_one_counted_nul() {
    let mut bytes = golden!("7001_one_module.hex");
    bytes.extend(hex("3c 78 2f 3e 00")); // <x/> and the NUL that the length of 5 counts
    let configuration = Configuration7001 {
        sonar_id: SONAR_ID,
        modules: vec![Module {
            identifier: 100_003,
            description: "tank".into(),
            alphadata_card: 100_005,
            serial_number: 6_597_069_766_699,
            info_xml: "<x/>".into(),
        }],
    };
    assert_eq!(Configuration7001::parse(&bytes), Ok(configuration.clone()));
    assert_eq!(emitted_body(|buf| configuration.emit(buf, &STAMP)), bytes);
}

#[test]
fn file_header_7200_points_to_its_catalogue() {
    let mut bytes = golden!("7200_rth.hex");
    bytes.extend(hex("d5 1b 00 00  01 00")); // device 7125, enumerator 1
    let header = FileHeader7200 {
        file_id: [11, 12],
        session_id: [13, 14],
        recording_name: "rec".into(),
        program_version: "0.1".into(),
        user_defined_name: "user".into(),
        notes: "note".into(),
        devices: vec![FileDevice {
            device_id: 7125,
            system_enumerator: 1,
        }],
    };
    assert_eq!(FileHeader7200::parse(&bytes), Ok(header.clone()));
    let pointer = CataloguePointer {
        size_bytes: 0x0102,
        offset_bytes: 0x0304_0506_0708,
    };
    let mut buf = Vec::new();
    header.emit(&mut buf, &STAMP, pointer);
    let record = Record::parse(&buf).unwrap();
    assert_eq!(record.body(), bytes);
    assert_eq!(record.frame.optional_data_offset_bytes, 64 + 316 + 6);
    assert_eq!(
        record.optional_data(),
        Some((7300, hex("02 01 00 00  08 07 06 05 04 03 00 00").as_slice()))
    );
    assert_eq!(CataloguePointer::of_record(&record), Some(pointer));
}

#[test]
fn catalogue_7300_rows_are_at_their_offsets() {
    let mut bytes = golden!("7300_rth.hex");
    bytes.extend(hex("
        48 00 00 00  08 07 06 05 04 03 00 00   # size 72, offset
        f5 03  d5 1b  01 00                    # type 1013, device 7125, enumerator 1
        e9 07  a6 00  00 00 22 42  0f  06      # 2025, day 166, 40.5 s, 15 h, 6 min
        00 00 00 00                            # record count
        00 00 00 00 00 00 00 00 00 00 00 00 00 00 00 00
    "));
    let row = CatalogueRow {
        size_bytes: 72,
        offset_bytes: 0x0304_0506_0708,
        record_type_id: 1013,
        device_id: 7125,
        system_enumerator: 1,
        time: STAMP.time,
        record_count: 0,
    };
    let catalogue = Catalogue7300::parse(&bytes).unwrap();
    assert_eq!(catalogue.records, 1);
    assert_eq!(catalogue.rows().collect::<Vec<_>>(), [row]);
    assert_eq!(emitted_body(|buf| emit_7300(buf, &STAMP, &[row])), bytes);
}

// ----------------------------------------------------------------------------------------------------------------------- remote control

const TRACKING: [u64; 2] = [0x0807_0605_0403_0201, 0x100f_0e0d_0c0b_0a09];
const TICKET_AND_TRACKING: &str = "2a 00 00 00  01 02 03 04 05 06 07 08  09 0a 0b 0c 0d 0e 0f 10";

#[test]
fn answers_repeat_ticket_and_tracking_number() {
    let header = ControlHeader {
        remote_control_id: 1003,
        ticket: 42,
        tracking_number: TRACKING,
    };
    let ack = hex(TICKET_AND_TRACKING);
    assert_eq!(Ack7501::parse(&ack), Ok(header.ack()));
    assert_eq!(emitted_body(|buf| header.ack().emit(buf, &STAMP)), ack);
    let nack = hex(&format!("{TICKET_AND_TRACKING} 0c 70 00 00"));
    let refusal = header.nack(ErrorCode::RemoteCommandDenied);
    assert_eq!(Nack7502::parse(&nack), Ok(refusal));
    assert_eq!(emitted_body(|buf| refusal.emit(buf, &STAMP)), nack);
}

#[test]
fn every_listed_error_code_has_its_number() {
    let codes: Vec<u32> = ErrorCode::LISTED.iter().map(|error| error.code()).collect();
    assert_eq!(
        codes,
        [
            0x7000, 0x7001, 0x7002, 0x7005, 0x7006, 0x7007, 0x7008, 0x7009, 0x700A, 0x700B, 0x700C,
            0x7050, 0x7051, 0x7052, 0x7053, 0x7054
        ]
    );
    for &error in ErrorCode::LISTED {
        assert_eq!(ErrorCode::from_code(error.code()), error);
    }
    assert_eq!(ErrorCode::from_code(0x1234), ErrorCode::Unlisted(0x1234));
    assert_eq!(
        ErrorCode::DataChecksum.to_string(),
        "data checksum (0x7054)"
    );
}

#[test]
fn every_command_of_the_table_is_bit_for_bit() {
    let cases = [
        (1003, "00 00 48 42", "range 50 m"),
        (1004, "00 00 a0 41", "at most 20 pings/s"),
        (1005, "00 00 5c 43", "power 220 dB re 1 uPa at 1 m"),
        (1006, "00 00 80 38", "pulse length 0.000061035156 s"),
        (1007, "01 00 00 00", "pulse type linear chirp"),
        (1007, "00 00 00 00", "pulse type continuous wave"),
        (1008, "00 00 20 c1", "gain -10 dB"),
        (1009, "00 03 00 00", "bottom detection mask 0x300"),
        (
            1010,
            "00 00 80 3f  00 00 00 40  00 00 40 40  00 00 80 40",
            "bottom detection range 1..2 m, depth 3..4 m",
        ),
        (
            1010,
            "00 00 80 3f  00 00 00 40  00 00 40 40  00 00 80 40  00 00 00 3f",
            "bottom detection range 1..2 m, depth 3..4 m, gate tilt 0.5 rad",
        ),
        (
            1017,
            "00 00 00 00  00 00 00 00 00 00 00 00 00 00 00 00 00 00 00 00",
            "gain type TVG",
        ),
        (
            1017,
            "02 00 00 00  00 00 00 00 00 00 00 00 00 00 00 00 00 00 00 00",
            "gain type fixed",
        ),
        (
            1020,
            "01 00 00 00  00 00 00 3f  00 00 00 00 00 00 00 00 00 00 00 00 00 00 00 00",
            "pulse envelope Tukey, shading 0.5",
        ),
        (
            1021,
            "00 00 00 3f  00 00 80 3e",
            "projector steering 0.5 rad vertical, 0.25 rad horizontal",
        ),
        (
            1022,
            "00 00 00 3f  00 00 80 3e",
            "projector beam widths 0.5 rad vertical, 0.25 rad horizontal",
        ),
        (1026, "00 50 c3 48", "centre frequency 400000 Hz"),
        (
            1027,
            "00 50 c3 48  00 50 43 48",
            "chirp 400000 to 200000 Hz",
        ),
        (
            1033,
            "01 02 00 00 00 00 00 00 00 00 00 00",
            "motion compensation roll 1, pitch 2",
        ),
        (
            1034,
            "03 00 00 00  00 00 00 3f  00 00 00 00 00 00 00 00 00 00 00 00 00 00 00 00",
            "match filter window 3, shading 0.5",
        ),
        (
            1035,
            "00 00 00 40  00 00 00 bf",
            "coverage sector 2 rad, steered -0.5 rad to starboard",
        ),
        (1050, "59 1b 00 00", "send record 7001 once"),
        (
            1051,
            "02 00 00 00  58 1b 00 00  7e 1b 00 00",
            "subscribe to [7000, 7038]",
        ),
        (1052, "00", "end all subscriptions"),
        (
            1053,
            "01 00 00 0a  58 1b  01 00  01 00 00 00  6a 1b 00 00",
            "send [7018] to Tcp 0x0a000001 port 7000",
        ),
        (
            1054,
            "01 00 00 0a  58 1b  00 00",
            "stop sending to Udp 0x0a000001 port 7000",
        ),
        (1055, "e8 03 00 00  f8 03 00 00", "subscribe to 1000..=1016"),
        (1056, "00 00 00 00", "unsubscribe from []"),
        (1100, "00", "start pinging"),
        (1101, "00", "stop pinging"),
        (1107, "00", "ping once"),
        (1114, "00", "ping by external trigger"),
        (
            1115,
            "07 00 00 00  00 00 00 00 00 00 f0 3f  00 00 00 00 00 00 00 c0",
            "trigger out flags 0x7, length 1 s, offset -2 s",
        ),
        (1116, "01 00 00 00", "PPS edge 1"),
        (
            1118,
            "05 00 00 00  0a 00 00 00  14 00 00 00",
            "snippets flags 0x5, window 10..20 samples",
        ),
        (1121, "03 00 00 00", "ping 3 times"),
        (7042, "06 00 00 00", "compressed water column flags 0x6"),
        (
            7610,
            "01 00  00 80 bb 44  09  00 00 00",
            "sound velocity 1500 m/s, flags 0x1, filter 9",
        ),
        (9999, "00", "not a known command"),
    ];
    for (number, arguments, words) in cases {
        let id = u32::to_le_bytes(number);
        let bytes = [&id[..], &hex(&format!("{TICKET_AND_TRACKING} {arguments}"))].concat();
        // The words contain every argument.
        let request = ControlRequest::parse(&bytes).expect("a command");
        let expected = format!("command {number}, ticket 42: {words}");
        assert_eq!(request.to_string(), expected);
        assert_eq!(request.tracking_number, TRACKING);
        assert_eq!(
            emitted_body(|buf| request.emit(buf, &STAMP)),
            bytes,
            "{request}"
        );
        // Later versions append arguments, which must be accepted.
        let with_more = [bytes.as_slice(), &[0; 3]].concat();
        assert_eq!(ControlRequest::parse(&with_more), Ok(request));
    }
}

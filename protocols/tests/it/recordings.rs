//! SigMF metadata and WAV headers: contents, errors, and random bytes.

use crate::support::{assert_same, table};
use echotank_protocols::WireError;
use echotank_protocols::sigmf::{Annotation, Capture, DataType, Recording, SigmfError};
use echotank_protocols::wav::{Container, HEADER_BYTES, WavFormat, WavHeader, WavSample};
use proptest::prelude::*;

const EIGHT: WavFormat = WavFormat {
    channels: 8,
    sample_rate_hz: 192_000,
    sample: WavSample::I16,
};

#[test]
fn a_small_file_is_riff_as_the_wave_definition_specifies() {
    let mut bytes = Vec::new();
    EIGHT.emit_header(&mut bytes, 1000, Container::AsNeeded);
    let guid = [
        1, 0, 0, 0, 0, 0, 0x10, 0, 0x80, 0, 0, 0xAA, 0, 0x38, 0x9B, 0x71,
    ];
    let golden = table(
        104,
        &[
            (0, b"RIFF"),
            (4, &(96 + 16_000_u32).to_le_bytes()),
            (8, b"WAVE"),
            (12, b"JUNK"),
            (16, &28_u32.to_le_bytes()),
            (48, b"fmt "),
            (52, &40_u32.to_le_bytes()),
            (56, &0xFFFE_u16.to_le_bytes()),
            (58, &8_u16.to_le_bytes()),
            (60, &192_000_u32.to_le_bytes()),
            (64, &(192_000 * 16_u32).to_le_bytes()),
            (68, &16_u16.to_le_bytes()),
            (70, &16_u16.to_le_bytes()),
            (72, &22_u16.to_le_bytes()),
            (74, &16_u16.to_le_bytes()),
            (80, &guid),
            (96, b"data"),
            (100, &16_000_u32.to_le_bytes()),
        ],
    );
    assert_same(&bytes, &golden, "RIFF");
    let header = WavHeader::parse(&golden).unwrap();
    assert_eq!((header.format, header.is_rf64), (EIGHT, false));
    assert_eq!(
        (header.data_at, header.sample_times()),
        (HEADER_BYTES, 1000)
    );
}

#[test]
fn a_file_over_4_gib_is_rf64_with_its_sizes_in_ds64() {
    // 16 B x 2^28 = 4 GiB.
    let sample_times = 1_u64 << 28;
    let mut bytes = Vec::new();
    EIGHT.emit_header(&mut bytes, sample_times, Container::AsNeeded);
    assert_eq!((&bytes[..4], &bytes[12..16]), (&b"RF64"[..], &b"ds64"[..]));
    assert_eq!(&bytes[4..8], [0xFF; 4]);
    assert_eq!(&bytes[100..104], [0xFF; 4]);
    assert_eq!(bytes[20..28], ((1_u64 << 32) + 96).to_le_bytes());
    assert_eq!(bytes[28..36], (1_u64 << 32).to_le_bytes());
    assert_eq!(bytes[36..44], sample_times.to_le_bytes());
    let header = WavHeader::parse(&bytes).unwrap();
    assert!(header.is_rf64);
    assert_eq!(header.sample_times(), sample_times);
    // The last one that fits: sizes below 0xFFFFFFFF.
    bytes.clear();
    EIGHT.emit_header(
        &mut bytes,
        (u64::from(u32::MAX) - 97) / 16,
        Container::AsNeeded,
    );
    assert_eq!(&bytes[..4], b"RIFF");
}

#[test]
fn chunks_before_the_samples_are_skipped_and_invalid_ones_refused() {
    let mut bytes = Vec::new();
    EIGHT.emit_header(&mut bytes, 5, Container::AsNeeded);
    let mut more = bytes[..48].to_vec();
    more.extend(b"LIST\x03\0\0\0abc\0");
    more.extend(&bytes[48..]);
    assert_eq!(WavHeader::parse(&more).unwrap().data_at, HEADER_BYTES + 12);
    let data_first = [&bytes[..48], &bytes[96..]].concat();
    assert!(matches!(
        WavHeader::parse(&data_first),
        Err(WireError::Unsupported { .. })
    ));
    assert!(matches!(
        WavHeader::parse(b"OggS"),
        Err(WireError::Mark { .. })
    ));
    assert!(matches!(
        WavHeader::parse(&bytes[..103]),
        Err(WireError::Truncated { .. })
    ));
    let mut no_channel = bytes.clone();
    no_channel[58] = 0;
    assert!(WavHeader::parse(&no_channel).is_err());
}

fn recording() -> Recording {
    Recording {
        data_type: DataType::ComplexI16,
        sample_rate_hz: 34_482.75,
        channels: 8,
        hardware: "a \"simulated\" array".into(),
        description: "two pings".into(),
        recorder: "echotank".into(),
        captures: vec![
            Capture {
                sample_start: 0,
                frequency_hz: Some(400e3),
                utc_ns: 1_750_000_000_123_456_789,
            },
            Capture {
                sample_start: 2000,
                frequency_hz: Some(400e3),
                utc_ns: 1_750_000_000_223_456_789,
            },
        ],
        annotations: vec![Annotation {
            sample_start: 0,
            sample_count: 2000,
            label: "ping 1".into(),
            comment: "roll 5 deg\n".into(),
            band_hz: Some((390e3, 410e3)),
        }],
    }
}

#[test]
fn the_metadata_of_a_recording_use_the_core_namespace() {
    let text = recording().to_json();
    for expected in [
        r#""core:datatype": "ci16_le""#,
        r#""core:sample_rate": 34482.75"#,
        r#""core:num_channels": 8"#,
        r#""core:version": "1.2.5""#,
        r#""core:hw": "a \"simulated\" array""#,
        r#""core:datetime": "2025-06-15T15:06:40.123456789Z""#,
        r#""core:frequency": 400000.0"#,
        r#""core:sample_start": 2000"#,
        r#""core:freq_lower_edge": 390000.0"#,
    ] {
        assert!(text.contains(expected), "no {expected} in\n{text}");
    }
    assert_eq!(Recording::parse(&text).unwrap(), recording());
}

#[test]
fn unsupported_metadata_are_refused_with_their_field() {
    let text = recording().to_json();
    let error = |text: &str| Recording::parse(text).unwrap_err();
    assert!(matches!(error("{"), SigmfError::Json(_)));
    assert!(matches!(error("{}"), SigmfError::Field { field: "global" }));
    assert!(matches!(
        error(&text.replace("ci16_le", "cu8")),
        SigmfError::DataType { .. }
    ));
    for (from, to, field) in [
        ("2025-06-15T", "2025-13-15T", "core:datetime"),
        ("40.123456789Z", "40.123456789", "core:datetime"),
        (
            "\"core:num_channels\": 8",
            "\"core:num_channels\": -8",
            "core:num_channels",
        ),
        (
            "\"core:sample_start\": 2000",
            "\"core:sample_start\": 0.5",
            "core:sample_start",
        ),
    ] {
        let got = error(&text.replace(from, to)).to_string();
        assert!(got.contains(field), "{got} does not name {field}");
    }
}

proptest! {
    #[test]
    fn no_bytes_make_a_parser_panic(mut bytes in proptest::collection::vec(any::<u8>(), 0..200), text: String, spoil in any::<(prop::sample::Index, u8)>()) {
        let _ = WavHeader::parse(&bytes);
        let mut good = Vec::new();
        EIGHT.emit_header(&mut good, 77, Container::Rf64);
        let at = spoil.0.index(good.len());
        good[at] = spoil.1;
        if let Ok(header) = WavHeader::parse(&good) { let _ = header.sample_times(); }
        if bytes.len() > 12 {
            bytes[..4].copy_from_slice(b"RIFF");
            bytes[8..12].copy_from_slice(b"WAVE");
            let _ = WavHeader::parse(&bytes);
        }
        let _ = Recording::parse(&text);
        let mut json = recording().to_json().into_bytes();
        let at = spoil.0.index(json.len());
        json[at] = spoil.1;
        if let Ok(text) = std::str::from_utf8(&json) { let _ = Recording::parse(text); }
    }

    #[test]
    fn headers_round_trip(channels in 1..4000_u16, sample_rate_hz: u32, sample in 0..3_usize, sample_times in 0..1_u64 << 40, is_64: bool) {
        let format = WavFormat { channels, sample_rate_hz, sample: [WavSample::I16, WavSample::I32, WavSample::F32][sample] };
        let mut bytes = Vec::new();
        format.emit_header(&mut bytes, sample_times, if is_64 { Container::Rf64 } else { Container::AsNeeded });
        let header = WavHeader::parse(&bytes).unwrap();
        prop_assert_eq!((header.format, header.sample_times(), header.data_at), (format, sample_times, HEADER_BYTES));
    }

    #[test]
    fn times_round_trip_to_the_nanosecond(utc_ns in 0..9_000_000_000_000_000_000_i64, label: String) {
        let mut recording = recording();
        recording.captures[0].utc_ns = utc_ns;
        recording.annotations[0].label = label;
        prop_assert_eq!(Recording::parse(&recording.to_json()).unwrap(), recording);
    }
}

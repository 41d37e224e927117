//! `.s7k` files: the sample that third-party readers accept, and files of this crate, complete, interrupted and damaged.

use std::collections::BTreeMap;

use crate::support::{STAMP, heading};
use echotank_protocols::sevenk::file::{
    Catalogue7300, CataloguePointer, FileBuilder, FileDevice, FileEnd, FileError, FileHeader7200,
    FileReader,
};
use echotank_protocols::sevenk::records::{Configuration7001, Module};
use echotank_protocols::sevenk::{Record, RecordBody, WireError, describe};

const SAMPLE: &[u8] = include_bytes!("../data/proto_7k_with_7038.s7k");

fn records(bytes: &[u8]) -> Vec<Record<'_>> {
    FileReader::new(bytes)
        .map(|found| found.expect("a right record").record)
        .collect()
}

#[test]
fn the_sample_has_the_record_counts_of_its_makers() {
    let mut counts = BTreeMap::new();
    for record in records(SAMPLE) {
        *counts.entry(record.frame.record_type_id).or_insert(0) += 1;
    }
    let per_ping = [
        1003, 1012, 1013, 1015, 1016, 7000, 7004, 7007, 7018, 7027, 7038,
    ]
    .map(|id| (id, 5));
    let expected: BTreeMap<u32, i32> = per_ping
        .into_iter()
        .chain([(7001, 1), (7200, 1), (7300, 1)])
        .collect();
    assert_eq!(counts, expected);
}

#[test]
fn every_supported_record_of_the_sample_parses() {
    for record in records(SAMPLE) {
        let body =
            RecordBody::parse(&record).unwrap_or_else(|error| panic!("{}: {error}", record.frame));
        match body {
            RecordBody::Other(_) => panic!("{} is not read", record.frame),
            RecordBody::Navigation(navigation) => {
                assert!((-1.6..1.6).contains(&navigation.latitude_rad));
            }
            RecordBody::Attitude(attitude) => assert!(attitude.sets().count() > 0),
            RecordBody::RawDetections(raw) => {
                assert!((1..=5).contains(&raw.rth.ping_number));
                assert_eq!(raw.rth.data_field_size, 34);
                let beams: Vec<u16> = raw.detections().map(|detection| detection.beam).collect();
                assert!(beams.len() > 1 && beams.is_sorted(), "{beams:?}");
            }
            RecordBody::SonarSettings(settings) => {
                assert!((1..=5).contains(&settings.ping_number));
                assert_eq!(
                    record.frame.time.to_utc_ns().unwrap() / 1_000_000_000,
                    1_750_000_000
                );
            }
            RecordBody::RawIq(raw) => {
                assert_eq!(
                    raw.rth.samples_present() * u64::from(raw.rth.elements) * 4,
                    12_960 - 68 - 60 - 2 * u64::from(raw.rth.elements)
                );
                assert!(raw.element_numbers().eq(0..raw.rth.elements));
                assert!(raw.iq_sample_major().any(|iq| iq != [0, 0]));
            }
            RecordBody::Beamformed(beams) => {
                assert_eq!(
                    u64::from(beams.rth.beams) * u64::from(beams.rth.samples) * 4,
                    25_720 - 68 - 52
                );
            }
            RecordBody::SideScan(line) => assert_eq!(line.port().len(), line.starboard().len()),
            RecordBody::BeamGeometry(geometry) => {
                let angle = |beam| geometry.across_track_rad(beam).unwrap();
                assert!(
                    (1..geometry.beams)
                        .all(|beam| angle(beam - 1).abs() < 1.6 && angle(beam) != angle(beam - 1))
                );
            }
            RecordBody::Configuration(configuration) => {
                assert_eq!(configuration.modules[0].description, "EMU sonar");
                assert!(
                    configuration.modules[0]
                        .info_xml
                        .starts_with("<?xml version=\"1.0\"?>")
                );
            }
            RecordBody::FileHeader(header) => {
                assert_eq!(
                    (
                        header.recording_name.as_str(),
                        header.program_version.as_str()
                    ),
                    ("emu", "0.1")
                );
                assert_eq!(
                    header.devices,
                    [FileDevice {
                        device_id: 7125,
                        system_enumerator: 0
                    }]
                );
            }
            _ => {}
        }
        assert!(!describe(record.bytes()).to_string().contains("wrong"));
    }
}

#[test]
fn the_catalogue_of_the_sample_points_to_every_record() {
    assert_catalogue_is_right(SAMPLE);
}

fn assert_catalogue_is_right(file: &[u8]) {
    let all: Vec<_> = FileReader::new(file).map(|found| found.unwrap()).collect();
    let pointer =
        CataloguePointer::of_record(&all[0].record).expect("a closed file points to its catalogue");
    let start = pointer.offset_bytes as usize;
    assert_eq!(start + pointer.size_bytes as usize, file.len());
    let record = Record::parse(&file[start..]).unwrap();
    let catalogue = Catalogue7300::parse(record.body()).unwrap();
    assert_eq!(catalogue.records as usize, all.len() - 1);
    for (row, found) in catalogue.rows().zip(&all) {
        let frame = found.record.frame;
        assert_eq!(
            (row.offset_bytes, row.size_bytes),
            (found.offset_bytes, frame.size_bytes)
        );
        assert_eq!(
            (u32::from(row.record_type_id), u32::from(row.device_id)),
            (frame.record_type_id, frame.device_id)
        );
        assert_eq!(
            (row.system_enumerator, row.time),
            (frame.system_enumerator, frame.time)
        );
    }
}

fn header() -> FileHeader7200 {
    FileHeader7200 {
        recording_name: "line 1".into(),
        devices: vec![FileDevice {
            device_id: 7125,
            system_enumerator: 0,
        }],
        ..FileHeader7200::default()
    }
}

/// A file with three records that is not closed.
fn open_file() -> (FileBuilder, Vec<u8>) {
    let mut file = Vec::new();
    let mut builder = FileBuilder::begin(header(), STAMP, &mut file);
    for i in 0..3_u8 {
        let record = heading(f32::from(i));
        assert_eq!(builder.append(&record), Ok(file.len() as u64));
        file.extend_from_slice(&record);
        assert_eq!(builder.position_bytes(), file.len() as u64);
    }
    assert_eq!(builder.records(), 4);
    (builder, file)
}

#[test]
fn a_closed_file_has_a_valid_catalogue() {
    let (builder, mut file) = open_file();
    let FileEnd { catalogue, header } = builder.close();
    file.extend_from_slice(&catalogue);
    file[..header.len()].copy_from_slice(&header);
    assert_eq!(records(&file).len(), 5);
    assert_catalogue_is_right(&file);
}

#[test]
fn a_file_that_was_not_closed_is_read_to_its_end() {
    let (_, file) = open_file();
    let all = records(&file);
    assert_eq!(all.len(), 4);
    assert_eq!(CataloguePointer::of_record(&all[0]), None);
}

#[test]
fn a_file_cut_within_a_record_gives_all_before_it_and_one_error() {
    let (_, file) = open_file();
    // Cut within the data, and within the frame.
    for (cut_bytes, needed_bytes) in [(6, 72), (10, 64)] {
        let cut = &file[..file.len() - cut_bytes];
        let mut reader = FileReader::new(cut);
        let found: Vec<_> = reader.by_ref().collect();
        assert_eq!(found.iter().filter(|item| item.is_ok()).count(), 3);
        let errors: Vec<_> = found
            .iter()
            .filter_map(|item| item.as_ref().err())
            .collect();
        assert_eq!(errors.len(), 1);
        assert!(
            matches!(errors[0].error, WireError::Truncated { need_bytes, .. } if need_bytes == needed_bytes),
            "{}",
            errors[0]
        );
        assert_eq!(errors[0].offset_bytes, file.len() as u64 - 72);
        assert_eq!(reader.skipped_bytes(), 72 - cut_bytes as u64);
    }
}

#[test]
fn a_damaged_record_does_not_affect_others() {
    let (_, file) = open_file();
    let start = file.len() - 2 * 72;
    // A wrong sample, a wrong size, a wrong sync pattern.
    for at in [start + 64, start + 8, start + 4] {
        let mut damaged = file.clone();
        damaged[at] ^= 0x10;
        let mut reader = FileReader::new(&damaged);
        assert_eq!(
            reader.by_ref().filter(Result::is_ok).count(),
            3,
            "byte {at}"
        );
        assert_eq!(reader.skipped_bytes(), 72);
    }
}

#[test]
fn records_that_would_invalidate_a_file_are_refused() {
    let mut file = Vec::new();
    let mut builder = FileBuilder::begin(header(), STAMP, &mut file);
    let module = Module {
        identifier: 7125,
        description: "tank".into(),
        alphadata_card: 0x1000,
        serial_number: 1,
        info_xml: "<x/>".into(),
    };
    let mut configuration = Vec::new();
    Configuration7001 {
        sonar_id: 1,
        modules: vec![module],
    }
    .emit(&mut configuration, &STAMP);
    assert!(builder.append(&configuration).is_ok());
    assert_eq!(
        builder.append(&configuration),
        Err(FileError::SecondConfiguration)
    );
    assert_eq!(
        builder.append(&file),
        Err(FileError::Reserved {
            record_type_id: 7200
        })
    );
    assert!(matches!(
        builder.append(&configuration[1..]),
        Err(FileError::Record(_))
    ));
    assert!(matches!(
        builder.append(&heading(1.0)[..71]),
        Err(FileError::Record(WireError::RecordSize { .. }))
    ));
    assert_eq!(builder.records(), 2);
}

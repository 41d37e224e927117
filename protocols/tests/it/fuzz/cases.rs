//! Corrupted messages for every decoder of the crate. The rules use the structure of messages. Numbers are inserted at the positions and in
//! the byte orders that formats use. Lengths and checksums are often corrected afterwards, so that the following contents are parsed.
//! Messages are cut, doubled and spliced. The oracle: nothing panics while all is described as text, which parses every field and sample.

use echotank_protocols::describer::{Format, MessageDescriber, datagram};
use echotank_protocols::imagenex872::{Side, SwitchCommand, emit_answer};
use echotank_protocols::jsf;
use echotank_protocols::ping_protocol;
use echotank_protocols::ping_protocol::common::{AckMessage, GeneralRequest};
use echotank_protocols::ping_protocol::omniscan450::{OsMonoProfileHead, OsPingParams, emit_2198};
use echotank_protocols::ping_protocol::surveyor240::{
    AtofHead, AtofPoint, AttitudeReport, YzHead, emit_3011, emit_3012,
};
use echotank_protocols::sevenk::file::FileReader;
use echotank_protocols::sevenk::{
    Command, ControlRequest, Packetiser, RecordStamp, SevenKTime, checksum,
};
use echotank_protocols::sigmf::{Annotation, Capture, DataType, Recording};
use echotank_protocols::vita49::{Context, SignalStream, Trailer, VrtTime};
use echotank_protocols::wav::{Container, WavFormat, WavSample};
use echotank_protocols::wbms::{
    BackscatterHead, BathymetryHead, Detection, Tail, emit_backscatter, emit_bathymetry,
};

/// xorshift64*, deterministic on every platform.
pub(crate) struct Random(pub u64);

impl Random {
    pub(crate) fn next(&mut self) -> u64 {
        self.0 ^= self.0 >> 12;
        self.0 ^= self.0 << 25;
        self.0 ^= self.0 >> 27;
        self.0.wrapping_mul(0x2545_F491_4F6C_DD1D)
    }
    pub(crate) fn below(&mut self, limit: usize) -> usize {
        (self.next() % limit.max(1) as u64) as usize
    }
}

/// One entry point of the crate.
#[derive(Clone, Copy)]
pub(crate) struct Decoder {
    pub(crate) name: &'static str,
    format: Format,
    /// One datagram, instead of a connection or a file.
    is_datagram: bool,
}

/// Every format as a connection or file, and the datagram formats as datagrams.
pub(crate) fn decoders() -> Vec<Decoder> {
    let all = Format::ALL.into_iter().map(|format| Decoder {
        name: format.name(),
        format,
        is_datagram: false,
    });
    let datagrams = [
        ("sevenk-udp", Format::SevenK),
        ("ping-udp", Format::PingProtocol),
    ]
    .map(|(name, format)| Decoder {
        name,
        format,
        is_datagram: true,
    });
    all.chain(datagrams).collect()
}

impl Decoder {
    /// Parses all of `bytes` and returns the number of messages and gaps.
    pub(crate) fn decode(&self, bytes: &[u8]) -> u64 {
        let mut lines = 0;
        self.each_line(bytes, &mut |line| {
            assert!(!line.is_empty());
            lines += 1;
        });
        lines
    }

    /// Describes all of `bytes`.
    pub(crate) fn each_line(&self, bytes: &[u8], each: &mut dyn FnMut(String)) {
        if self.is_datagram {
            datagram(self.format, bytes, each);
        } else {
            let mut describer = MessageDescriber::new(self.format);
            // In two pieces, as connections deliver them.
            let (front, back) = bytes.split_at(bytes.len() / 3);
            describer.push(front, each);
            describer.push(back, each);
            describer.finish(each);
        }
    }

    /// Valid short messages.
    pub(crate) fn seeds(&self) -> Vec<Vec<u8>> {
        match self.format {
            Format::SevenK => sevenk_packets(),
            Format::S7k => sevenk_records(),
            Format::Jsf => jsf_messages(),
            Format::Vita49 => vita49_packets(),
            Format::PingProtocol => ping_frames(),
            Format::Wbms => wbms_packets(),
            Format::WbmsText => WBMS_LINES
                .iter()
                .map(|line| line.as_bytes().to_vec())
                .collect(),
            // The header and one ping.
            Format::Xtf => vec![XTF[..1024 + 3584].to_vec()],
            Format::Imagenex872 => imagenex_messages(),
            Format::Sigmf => vec![sigmf_words()],
            Format::Wav => wav_headers(),
        }
    }

    /// A corrupted message.
    pub(crate) fn corrupted(&self, seeds: &[Vec<u8>], random: &mut Random) -> Vec<u8> {
        let mut bytes = seeds[random.below(seeds.len())].clone();
        for _ in 0..1 + random.below(4) {
            corrupt(&mut bytes, seeds, random);
        }
        if random.below(3) > 0 {
            self.correct(&mut bytes);
        }
        bytes
    }

    /// Corrects checksum and length, so that the following contents are parsed.
    fn correct(&self, bytes: &mut [u8]) {
        let len = bytes.len();
        match self.format {
            Format::PingProtocol if len >= 10 => {
                let payload = (len - 10).min(usize::from(u16::MAX)) as u16;
                bytes[..2].copy_from_slice(b"BR");
                bytes[2..4].copy_from_slice(&payload.to_le_bytes());
                let end = 8 + usize::from(payload);
                let sum = ping_protocol::checksum(&bytes[..end]);
                bytes[end..end + 2].copy_from_slice(&sum.to_le_bytes());
            }
            Format::Wbms if len >= 24 => {
                bytes[..4].copy_from_slice(&0xDEAD_BEEF_u32.to_le_bytes());
                bytes[8..12].copy_from_slice(&(len as u32).to_le_bytes());
                bytes[12..16].copy_from_slice(&4_u32.to_le_bytes());
                let crc = echotank_protocols::wbms::crc32(&bytes[24..]);
                bytes[20..24].copy_from_slice(&crc.to_le_bytes());
            }
            Format::SevenK if len >= 36 + 68 => {
                let record = len - 36;
                bytes[12..16].copy_from_slice(&(len as u32).to_le_bytes());
                bytes[16..20].copy_from_slice(&(record as u32).to_le_bytes());
                correct_record(&mut bytes[36..]);
            }
            Format::S7k if len >= 68 => {
                let size = u32::from_le_bytes([bytes[8], bytes[9], bytes[10], bytes[11]]);
                let end = (size as usize).clamp(68, len);
                correct_record(&mut bytes[..end]);
            }
            Format::Jsf if len >= 16 => {
                bytes[..2].copy_from_slice(&[0x01, 0x16]);
                bytes[12..16].copy_from_slice(&((len - 16) as u32).to_le_bytes());
            }
            Format::Vita49 if len >= 4 => {
                bytes[2..4].copy_from_slice(&((len / 4) as u16).to_be_bytes());
            }
            _ => {}
        }
    }
}

/// Size and checksum of a whole 7k record.
fn correct_record(record: &mut [u8]) {
    let len = record.len();
    record[8..12].copy_from_slice(&(len as u32).to_le_bytes());
    let sum = checksum(&record[..len - 4]);
    record[len - 4..].copy_from_slice(&sum.to_le_bytes());
}

/// Numbers at the limits of fields.
const EDGES: [u64; 16] = [
    0,
    1,
    2,
    0x7F,
    0x80,
    0xFF,
    0x7FFF,
    0x8000,
    0xFFFF,
    0x7FFF_FFFF,
    0x8000_0000,
    0xFFFF_FFFF,
    0x7FF0_0000_0000_0000,
    0x7FC0_0000,
    0x0001_0000_0000,
    u64::MAX,
];

fn corrupt(bytes: &mut Vec<u8>, seeds: &[Vec<u8>], random: &mut Random) {
    if bytes.is_empty() {
        bytes.push(random.next() as u8);
        return;
    }
    // Headers are at the front.
    let reach = match random.below(3) {
        0 => bytes.len().min(32),
        1 => bytes.len().min(256),
        _ => bytes.len(),
    };
    let at = random.below(reach);
    match random.below(9) {
        0 => bytes.truncate(at),
        1 => bytes[at] ^= 1 << random.below(8),
        2 => bytes[at] = random.next() as u8,
        3..=5 => {
            // A number with the width and byte order of a format, at a possible position.
            let width = [1, 2, 4, 8][random.below(4)];
            let at = at / width * width;
            let value = match random.below(3) {
                0 => EDGES[random.below(EDGES.len())],
                1 => (bytes.len() as u64)
                    .wrapping_add(random.below(9) as u64)
                    .wrapping_sub(4),
                _ => random.next() >> random.below(64),
            };
            let (little, big) = (value.to_le_bytes(), value.to_be_bytes());
            let number = match random.below(2) {
                0 => &little[..width],
                _ => &big[8 - width..],
            };
            if let Some(place) = bytes.get_mut(at..at + width) {
                place.copy_from_slice(number);
            }
        }
        6 => {
            let len = random.below(64).min(bytes.len() - at);
            let copy = bytes[at..at + len].to_vec();
            let to = random.below(bytes.len());
            bytes.splice(to..to, copy);
        }
        7 => {
            let len = random.below(64).min(bytes.len() - at);
            bytes.drain(at..at + len);
        }
        _ => {
            let other = &seeds[random.below(seeds.len())];
            bytes.truncate(at);
            bytes.extend_from_slice(&other[random.below(other.len())..]);
        }
    }
    // Messages that grow with every iteration test nothing new.
    bytes.truncate(16_384);
}

// ---------------------------------------------------------------- right messages

const S7K: &[u8] = include_bytes!("../../data/proto_7k_with_7038.s7k");
const XTF: &[u8] = include_bytes!("../../data/proto.xtf");
const JSF: &[u8] = include_bytes!("../../data/proto_iq.jsf");
/// Longer messages make slow cases without further coverage.
const SHORT_BYTES: usize = 3000;

/// One of each kind, and commands.
fn sevenk_records() -> Vec<Vec<u8>> {
    let mut records: Vec<Vec<u8>> = Vec::new();
    let mut seen = std::collections::HashSet::new();
    for found in FileReader::new(S7K).flatten() {
        let bytes = found.record.bytes();
        if bytes.len() < SHORT_BYTES && seen.insert(found.record.frame.record_type_id) {
            records.push(bytes.to_vec());
        }
    }
    let stamp = RecordStamp {
        time: SevenKTime::from_utc_ns_clamped(1_750_000_000_000_000_000),
        device_id: 7125,
        system_enumerator: 1,
    };
    let commands = [
        Command::Range { range_m: 50.0 },
        Command::StartPinging,
        Command::Subscribe {
            record_type_ids: vec![7000, 7038],
        },
        Command::SingleRecord {
            record_type_id: 7001,
        },
    ];
    for command in commands {
        let request = ControlRequest {
            ticket: 1,
            tracking_number: [2; 2],
            command,
        };
        let mut record = Vec::new();
        request.emit(&mut record, &stamp);
        records.push(record);
    }
    assert!(records.len() > 6, "{} seeds", records.len());
    records
}

fn sevenk_packets() -> Vec<Vec<u8>> {
    let records = sevenk_records();
    let mut packetiser = Packetiser::default();
    records
        .iter()
        .map(|record| {
            let mut wire = Vec::new();
            packetiser.packetise(record, &mut wire);
            wire
        })
        .collect()
}

fn jsf_messages() -> Vec<Vec<u8>> {
    let mut messages = Vec::new();
    let mut rest = JSF;
    while let Ok(message) = jsf::Message::parse(rest) {
        let size = message.size_bytes();
        if size < SHORT_BYTES && messages.len() < 8 {
            messages.push(rest[..size].to_vec());
        }
        rest = &rest[size..];
    }
    if messages.is_empty() {
        messages.push(JSF[..SHORT_BYTES.min(JSF.len())].to_vec());
    }
    // A command of each kind of body.
    for message_type in [22_u16, 41, 83, 120, 123, 124, 128, 129] {
        let mut body = vec![0_u8; if message_type == 123 { 256 } else { 12 }];
        body[0] = 1;
        let mut message = vec![0x01, 0x16, 13, 0];
        message.extend(message_type.to_le_bytes());
        message.extend([0, 21, 0, 7, 0, 0]);
        message.extend((body.len() as u32).to_le_bytes());
        message.extend(body);
        messages.push(message);
    }
    messages
}

fn vita49_packets() -> Vec<Vec<u8>> {
    let mut stream = SignalStream::new(0x100, true, 4, 40e3, 400);
    let time = VrtTime::from_utc_ns(1_750_000_000_123_456_789);
    let mut packets = Vec::new();
    let context = Context {
        bandwidth_hz: Some(2e4),
        rf_reference_hz: Some(4e5),
        if_reference_hz: Some(4e5),
        reference_level_dbm: Some(-10.5),
        ..stream.context()
    };
    let mut packet = Vec::new();
    stream.emit_context(&mut packet, time, &context);
    packets.push(packet.clone());
    let trailer = Trailer {
        valid_data: Some(true),
        ..Trailer::default()
    };
    stream.emit_complex(
        &mut packet,
        time,
        &[[100, -100]; 80],
        Some(trailer),
        |bytes| {
            packets.push(bytes.to_vec());
        },
    );
    packets
}

fn ping_frames() -> Vec<Vec<u8>> {
    let mut frames = vec![Vec::new(); 8];
    GeneralRequest { requested_id: 4 }.emit_frame(&mut frames[0], 0, 1);
    AckMessage { acked_id: 2197 }.emit_frame(&mut frames[1], 1, 0);
    let params = OsPingParams {
        start_mm: 0,
        length_mm: 50_000,
        msec_per_ping: 20,
        pulse_len_percent: 0.002,
        filter_duration_percent: 0.0015,
        gain_index: -1,
        num_results: 600,
        enable: 1,
    };
    params.emit_frame(&mut frames[2], 0, 1);
    let head = OsMonoProfileHead {
        max_pwr_db: 90.0,
        ..OsMonoProfileHead::default()
    };
    emit_2198(&mut frames[3], 1, 0, &head, &[1000; 50]);
    let point = AtofPoint {
        angle_rad: 0.5,
        two_way_time_s: 0.02,
    };
    emit_3012(&mut frames[4], 1, 0, &AtofHead::default(), &[point; 20]);
    emit_3011(&mut frames[5], 1, 0, &YzHead::default(), &[[1.0, -2.0]; 20]);
    let report = AttitudeReport {
        up: [0.0, 0.0, 1.0],
        utc_msec: 1,
        pwr_up_msec: 2,
    };
    report.emit_frame(&mut frames[6], 1, 0);
    ping_protocol::emit_frame(&mut frames[7], 3023, 0, 1, |buf| buf.extend([1; 36]));
    frames
}

fn wbms_packets() -> Vec<Vec<u8>> {
    let mut packets = vec![Vec::new(); 4];
    emit_bathymetry(
        &mut packets[0],
        &BathymetryHead::default(),
        &[Detection::default(); 20],
    );
    let head = BackscatterHead {
        gain: 1.0,
        ..BackscatterHead::default()
    };
    let angles_rad = &[0.1, 0.2, 0.3, 0.4];
    let water_column = Tail::WaterColumn { angles_rad };
    emit_backscatter(&mut packets[1], &head, &[7; 80], water_column);
    emit_backscatter(&mut packets[2], &head, &[7; 80], Tail::SideScan);
    let snippets = Tail::Snippets {
        angles_rad,
        start_samples: &[1, 2, 3, 4],
        detection_samples: &[5, 6, 7, 8],
    };
    emit_backscatter(&mut packets[3], &head, &[7; 80], snippets);
    packets
}

const WBMS_LINES: [&str; 10] = [
    "set_range 0 50\r\n",
    "set_tx 400 80 15 500\r\nset_rate -1\r\n",
    "set_rate\r\n",
    "set_power 1",
    "sound_velocity -1 # by the probe\r\n",
    "set_resolution 1 1\r\nexit\r\n",
    "set_mode 1\nset_sidescan_mode 9\r\n",
    "set_gate_tilt -12.5e0\r\n",
    "set_ntp_server 10.0.0.1\r\nset_gain 30\r\n",
    "set_range 0 45 # refused: range_m = 800: must be from 5 to 60\r\n",
];

fn imagenex_messages() -> Vec<Vec<u8>> {
    let command = SwitchCommand {
        range_m: 50,
        frequency_index: 1,
        data_gain: 50,
        balance_gain: 30,
        side: Side::Port,
    };
    let mut messages = vec![Vec::new(); 2];
    command.emit(&mut messages[0]);
    emit_answer(&mut messages[1], &[9; 1000]);
    messages
}

fn sigmf_words() -> Vec<u8> {
    let recording = Recording {
        data_type: DataType::ComplexI16,
        sample_rate_hz: 40e3,
        channels: 4,
        hardware: "a sonar".into(),
        description: "words".into(),
        recorder: "a test".into(),
        captures: vec![Capture {
            sample_start: 0,
            frequency_hz: Some(4e5),
            utc_ns: 1_750_000_000_123_456_789,
        }],
        annotations: vec![Annotation {
            sample_start: 0,
            sample_count: 100,
            label: "ping 1".into(),
            comment: "".into(),
            band_hz: Some((3.9e5, 4.1e5)),
        }],
    };
    recording.to_json().into_bytes()
}

fn wav_headers() -> Vec<Vec<u8>> {
    [Container::AsNeeded, Container::Rf64]
        .map(|container| {
            let format = WavFormat {
                channels: 8,
                sample_rate_hz: 1_000_000,
                sample: WavSample::I16,
            };
            let mut bytes = Vec::new();
            format.emit_header(&mut bytes, 10, container);
            bytes.extend([0; 160]);
            bytes
        })
        .into()
}

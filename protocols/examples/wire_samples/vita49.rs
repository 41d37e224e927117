//! A capture of UDP packets: a vector stream of four elements and one real stream, three pings each, with their contexts.

use std::path::Path;

use echotank_protocols::vita49::{
    Context, ETHERNET_PACKET_BYTES, PORT, SignalStream, Trailer, VrtTime,
};

use super::*;

const ELEMENTS: u64 = 4;
const SAMPLES: u64 = 500;

pub(crate) fn write(folder: &Path) -> std::io::Result<()> {
    let mut pcap = Vec::new();
    // Classic pcap, microseconds, Ethernet.
    for word in [0xA1B2_C3D4_u32, 4 << 16 | 2, 0, 0, 65_535, 1] {
        pcap.extend(word.to_le_bytes());
    }
    let mut vector = SignalStream::new(0x100, true, ELEMENTS as u32, 50e3, ETHERNET_PACKET_BYTES);
    let mut real = SignalStream::new(0x200, false, 1, 2e6, ETHERNET_PACKET_BYTES);
    let mut buf = Vec::new();
    for p in 0..3 {
        let time = VrtTime::from_utc_ns(UTC_NS + p as i64 * 100_000_000);
        let context = Context {
            is_change: p == 0,
            bandwidth_hz: Some(20e3),
            rf_reference_hz: Some(430e3),
            ..vector.context()
        };
        buf.clear();
        vector.emit_context(&mut buf, time, &context);
        frame(&mut pcap, &buf);
        let iq: Vec<[i16; 2]> = (0..SAMPLES)
            .flat_map(|k| (0..ELEMENTS).map(move |c| [count(p, c, 2 * k), count(p, c, 2 * k + 1)]))
            .collect();
        let trailer = Trailer {
            valid_data: Some(true),
            over_range: Some(false),
            ..Trailer::default()
        };
        vector.emit_complex(&mut buf, time, &iq, Some(trailer), |packet| {
            frame(&mut pcap, packet);
        });
        buf.clear();
        let context = real.context();
        real.emit_context(&mut buf, time, &context);
        frame(&mut pcap, &buf);
        let passband: Vec<i16> = (0..SAMPLES).map(|k| count(p, 9, k)).collect();
        real.emit_real(&mut buf, time, &passband, None, |packet| {
            frame(&mut pcap, packet);
        });
    }
    std::fs::write(folder.join("sample_vita49.pcap"), pcap)
}

/// Appends a UDP datagram to port 4991 of this computer, with Ethernet header, without checksums.
fn frame(pcap: &mut Vec<u8>, payload: &[u8]) {
    let udp_bytes = (8 + payload.len()) as u16;
    let mut frame = vec![0_u8; 12];
    frame.extend([0x08, 0x00, 0x45, 0]);
    frame.extend((20 + udp_bytes).to_be_bytes());
    frame.extend([0, 0, 0x40, 0, 64, 17, 0, 0, 127, 0, 0, 1, 127, 0, 0, 1]);
    frame.extend(50_000_u16.to_be_bytes());
    frame.extend(PORT.to_be_bytes());
    frame.extend(udp_bytes.to_be_bytes());
    frame.extend([0, 0]);
    frame.extend_from_slice(payload);
    let len = (frame.len() as u32).to_le_bytes();
    pcap.extend([[0; 4], [0; 4], len, len].as_flattened());
    pcap.extend(frame);
}

//! Compares frames of element samples with the layout, and parses random bytes.

use crate::support::feed_to_end;
use echotank_protocols::elements::{
    ElementFraming, ElementStream, Frame, FrameHead, HEADER_BYTES, SampleType,
};
use proptest::prelude::*;

fn head(frame_number: u32) -> FrameHead {
    FrameHead {
        frame_number,
        ping_number: 0x0102_0304,
        first_sample: 20,
        ping_samples: 900,
        elements: 2,
        sample_type: SampleType::I16,
        volts_per_unit: 0.5,
        pulse_utc_ns: -2,
        first_sample_s: 0.25,
        sample_rate_hz: 40_000.0,
        center_frequency_hz: 2e5,
    }
}

fn frame(number: u32) -> Vec<u8> {
    let mut bytes = Vec::new();
    head(number).emit(&mut bytes, 3, |buf| buf.extend((0..24).map(|k| k as u8)));
    bytes
}

#[test]
fn the_bytes_match_the_layout() {
    let bytes = frame(7);
    let mut want = b"ETEL\x01\x00\x48\x00".to_vec();
    want.extend([96, 0, 0, 0, 7, 0, 0, 0, 4, 3, 2, 1, 20, 0, 0, 0, 3, 0, 0, 0]);
    want.extend([0x84, 3, 0, 0, 2, 0, 1, 0]);
    want.extend(0.5_f32.to_le_bytes());
    want.extend((-2_i64).to_le_bytes());
    for value in [0.25_f64, 40_000.0, 2e5] {
        want.extend(value.to_le_bytes());
    }
    assert_eq!(want.len(), HEADER_BYTES);
    want.extend(0..24);
    assert_eq!(bytes, want);
    let read = Frame::parse(&bytes).expect("a frame");
    assert_eq!((read.head, read.sample_times), (head(7), 3));
    assert_eq!(
        (read.samples, read.size_bytes()),
        (&want[HEADER_BYTES..], 96)
    );
}

#[test]
fn frames_are_found_after_invalid_bytes_for_any_division() {
    let wire = [b"noise ETE".to_vec(), frame(1), frame(2)].concat();
    for piece in [1, 7, 1000] {
        let mut stream = ElementStream::new(ElementFraming);
        let (mut numbers, mut errors) = (Vec::new(), 0);
        for bytes in wire.chunks(piece) {
            stream.feed(bytes, |item| match item {
                Ok(bytes) => numbers.push(Frame::parse(bytes).expect("whole").head.frame_number),
                Err(_) => errors += 1,
            });
        }
        assert_eq!((numbers, errors), (vec![1, 2], 1), "pieces of {piece}");
    }
}

proptest! {
    #[test]
    fn any_bytes_parse_or_are_refused(mut bytes in proptest::collection::vec(any::<u8>(), 0..200), whole in any::<bool>(), at in 0..96_usize, with in any::<u8>()) {
        if whole {
            bytes = frame(3);
            bytes[at] = with;
        }
        if let Ok(read) = Frame::parse(&bytes) {
            prop_assert!(read.size_bytes() <= bytes.len());
        }
        feed_to_end(ElementFraming, &bytes, usize::MAX, |_| {});
    }
}

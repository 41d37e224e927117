//! Short form of `tools/fuzz wire`: every decoder processes thousands of corrupted messages.

mod cases;

use cases::{Random, decoders};
use echotank_protocols::describer::{Format, MessageDescriber};

#[test]
fn twenty_thousand_corrupted_messages_per_decoder_do_not_panic() {
    for decoder in decoders() {
        let seeds = decoder.seeds();
        let mut random = Random(0x9E37_79B9_7F4A_7C15);
        let mut lines = 0;
        for _ in 0..20_000 {
            lines += decoder.decode(&decoder.corrupted(&seeds, &mut random));
        }
        assert!(lines > 10_000, "{}: only {lines} lines", decoder.name);
    }
}

/// Phrases in descriptions of invalid bytes.
const COMPLAINTS: [&str; 13] = [
    "not a message",
    "not a record",
    "not a packet",
    "not a 7k",
    "not a SigMF",
    "not a WAV",
    "not a VITA",
    "not a Ping",
    "not a WBMS",
    "not a JSF",
    "not an ",
    "invalid body",
    "invalid record",
];

fn in_words(format: Format, bytes: &[u8]) -> Vec<String> {
    let mut lines = Vec::new();
    let mut describer = MessageDescriber::new(format);
    describer.push(bytes, &mut |line| lines.push(line));
    describer.finish(&mut |line| lines.push(line));
    lines
}

#[test]
fn golden_files_are_recognised_and_every_message_is_described() {
    let s7k = include_bytes!("../data/proto_7k_with_7038.s7k");
    let jsf = include_bytes!("../data/proto_iq.jsf");
    let xtf = include_bytes!("../data/proto.xtf");
    let cases: [(&[u8], Format, usize, &[&str]); 3] = [
        (
            s7k,
            Format::S7k,
            58,
            &[
                "sonar settings: ping 1 of sonar 1234, 400000.0 Hz, fs 34483.0 Hz",
                "side scan: ping 1 of sonar 1234, 300 samples of 2 B per side",
                "beamformed: ping 5 of sonar 1234, 32 beams x 200 samples",
            ],
        ),
        (
            jsf,
            Format::Jsf,
            70,
            &[
                "JSF 80 subsystem 21 channel 1 4240 B: sonar data: ping 1, 1000 samples of 20000 ns, Analytic, weighting 23",
                "AnalyticUnfiltered",
            ],
        ),
        (
            xtf,
            Format::Xtf,
            6,
            &[
                "sonar_name: \"emulator\"",
                "ping_number: 5",
                "channel 1 of 800 samples",
            ],
        ),
    ];
    for (bytes, format, messages, said) in cases {
        assert_eq!(Format::of_bytes(bytes), Some(format));
        let lines = in_words(format, bytes);
        assert_eq!(lines.len(), messages, "{format}");
        for line in &lines {
            assert!(
                !COMPLAINTS.iter().any(|c| line.contains(c)),
                "{format}: {line}"
            );
        }
        for said in said {
            assert!(
                lines.iter().any(|line| line.contains(said)),
                "{format}: no `{said}`"
            );
        }
    }
}

#[test]
fn valid_messages_of_every_decoder_are_described_without_errors() {
    for decoder in decoders() {
        for (n, seed) in decoder.seeds().iter().enumerate() {
            assert!(decoder.decode(seed) > 0, "{} seed {n}", decoder.name);
            decoder.each_line(seed, &mut |line| {
                let complaint = COMPLAINTS.iter().find(|c| line.contains(**c));
                assert_eq!(complaint, None, "{} seed {n}: {line}", decoder.name);
            });
        }
    }
}

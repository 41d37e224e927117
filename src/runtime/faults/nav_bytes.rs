//! Faults in the bytes of live navigation, before decoding: wrong checksums, sentences cut in two, and noise.
//!
//! Each source counts its sentences from the first fault on. Random draws depend only on that count, and not on the split of the bytes by the
//! transport. A sentence begins with `$` or `!`.

use std::sync::Arc;

use echotank_config::spec::{FaultKind, NavByteFault};
use echotank_core::time::UtcNs;
use echotank_ping::faults::{Faults, InjectionPoint, ScheduledFault, unit};

/// Length of a cut sentence with its start, bytes: the sentence ends in the middle of its first field.
const CUT_AFTER: usize = 9;
/// Separates the random stream of the noise from all others.
const NOISE_TAG: [u8; 8] = *b"navnoise";

/// Injects the byte faults of all sources.
pub(crate) struct NavByteFaults {
    faults: Arc<Faults>,
    sentences: Vec<Sentence>,
    /// Scratch: the altered bytes.
    out: Vec<u8>,
}

/// Current sentence of one source.
#[derive(Clone, Copy, Default)]
struct Sentence {
    number: u32,
    /// Number of bytes of the sentence so far.
    bytes: usize,
    cut: bool,
    wrong_sum: bool,
    after_star: bool,
}

impl NavByteFaults {
    pub(super) fn new(faults: Arc<Faults>, sources: usize) -> Self {
        Self {
            faults,
            sentences: vec![Sentence::default(); sources],
            out: Vec::new(),
        }
    }

    /// Alters the bytes of one source that arrived at `arrival`.
    pub(super) fn inject(&mut self, source: usize, arrival: UtcNs, bytes: &mut Vec<u8>) {
        if self.faults.scheduled() == 0 {
            self.sentences.fill(Sentence::default());
            return;
        }
        let Some(sentence) = self.sentences.get_mut(source) else {
            return;
        };
        let out = &mut self.out;
        out.clear();
        for &byte in bytes.iter() {
            if matches!(byte, b'$' | b'!') {
                *sentence = Sentence {
                    number: sentence.number + 1,
                    ..Sentence::default()
                };
                begin(&self.faults, source, arrival, sentence, out);
            }
            sentence.bytes += 1;
            out.push(match (sentence.wrong_sum && sentence.after_star, byte) {
                (true, b'0') => b'1',
                (true, _) => b'0',
                (false, byte) => byte,
            });
            sentence.after_star = byte == b'*';
            if sentence.cut && sentence.bytes == CUT_AFTER {
                out.extend(b"\r\n");
            }
        }
        std::mem::swap(bytes, out);
    }
}

/// Draws the faults of a new sentence, and writes the noise before it.
fn begin(
    faults: &Faults,
    source: usize,
    arrival: UtcNs,
    sentence: &mut Sentence,
    out: &mut Vec<u8>,
) {
    let point = InjectionPoint {
        utc: arrival,
        number: sentence.number,
        // 0xFF differs from the small numbers of the source's quantities.
        key: (source as u32) << 8 | 0xFF,
    };
    let wanted = |fault: &ScheduledFault| {
        matches!(fault.spec.kind, FaultKind::NavBytes(_))
            && fault.source.is_none_or(|wanted| wanted == source)
    };
    faults.for_each_active(point, wanted, |fault, _, strength| {
        match fault.spec.kind {
            FaultKind::NavBytes(NavByteFault::Checksum) => sentence.wrong_sum = true,
            FaultKind::NavBytes(NavByteFault::Cut) => sentence.cut = true,
            FaultKind::NavBytes(NavByteFault::Noise { bytes }) => {
                let seed = fault.spec.seed;
                out.extend((0..bytes as u32).map(|k| {
                    let draw = unit(
                        seed ^ u64::from(k),
                        fault.id,
                        point.number,
                        point.key,
                        NOISE_TAG,
                    );
                    // Bytes above 0x7F, as from a serial port at the wrong baud rate.
                    0x80 | (draw * 128.0) as u8
                }));
            }
            _ => return,
        }
        let mut injection = faults.injection(fault, point, strength);
        injection.source = faults.sources.get(source).cloned();
        faults.log(fault, injection);
    });
}

#[cfg(test)]
mod tests {
    use super::*;
    use echotank_config::spec::FaultRequest;

    fn sentence(body: &str) -> String {
        let sum = body.bytes().fold(0, |a, b| a ^ b);
        format!("${body}*{sum:02X}\r\n")
    }

    /// Injects faults into a hundred headings, split every `every` bytes. Returns the resulting bytes and the number of injections.
    fn received(json: &str, every: usize) -> (String, usize) {
        let faults = Arc::new(super::super::testing::faults());
        faults.begin(UtcNs(0));
        let request: FaultRequest = serde_json::from_str(json).expect("JSON");
        faults.add(&request).expect("sound");
        let mut byte_faults = NavByteFaults::new(faults.clone(), 2);
        let text: String = (0..100)
            .map(|k| sentence(&format!("GPHDT,{k:03}.25,T")))
            .collect();
        let mut came = Vec::new();
        for chunk in text.as_bytes().chunks(every) {
            let mut bytes = chunk.to_vec();
            byte_faults.inject(0, UtcNs(1), &mut bytes);
            came.extend(bytes);
        }
        let log = faults.take_injections();
        assert!(log.iter().all(|i| i.source.as_deref() == Some("gnss")));
        let came = came.iter().map(|&b| char::from(b)).collect();
        (came, log.len())
    }

    #[test]
    fn wrong_checksums_do_not_depend_on_how_the_bytes_are_split() {
        let json = r#"{"kind": "nav-checksum", "probability": 0.3, "seed": 2}"#;
        let (whole, injected) = received(json, 10_000);
        assert!((14..=46).contains(&injected), "{injected}");
        for every in [1, 2, 7, 19] {
            assert_eq!(received(json, every), (whole.clone(), injected), "{every}");
        }
        let wrong = whole.lines().filter(|line| {
            let body = line.trim_start_matches('$').split('*').next();
            format!("{line}\r\n") != sentence(body.expect("a body"))
        });
        assert_eq!(wrong.count(), injected);
        assert_eq!(whole.lines().count(), 100);
    }

    #[test]
    fn a_cut_sentence_becomes_two_lines_and_noise_precedes_a_sentence() {
        let (cut, injected) = received(r#"{"kind": "nav-cut", "probability": 0.3}"#, 5);
        assert_eq!(cut.lines().count(), 100 + injected);
        assert!(cut.contains("$GPHDT,00\r\n"), "{cut}");
        let (noisy, injected) = received(
            r#"{"kind": "nav-noise", "value": 4, "probability": 0.3}"#,
            5,
        );
        let noise = noisy.chars().filter(|c| !c.is_ascii()).count();
        assert_eq!(noise, 4 * injected);
        assert!((14..=46).contains(&injected), "{injected}");
    }
}

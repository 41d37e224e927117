//! Faults of the bytes of live navigation, before they are decoded: checksums that do not fit, sentences cut in two, noise on the line.
//!
//! Sentences are counted from the first fault on, each source's by themselves, and draws depend on that count alone: it does not matter how the
//! line cuts what it carries. Only what begins with `$` or `!` is a sentence here.

use std::sync::Arc;

use echotank_config::spec::{FaultKind, NavByteFault};
use echotank_core::time::UtcNs;
use echotank_ping::faults::{Faults, Moment, Standing, unit};

/// A cut sentence ends after so many bytes, its start counted: in the middle of its first field.
const CUT_AFTER: usize = 9;
/// Keeps the draws of noise apart from all others.
const NOISE_TAG: [u8; 8] = *b"navnoise";

pub(crate) struct ByteSpoiler {
    faults: Arc<Faults>,
    lines: Vec<Sentence>,
    spoiled: Vec<u8>,
}

/// Where one source's line is.
#[derive(Clone, Copy, Default)]
struct Sentence {
    number: u32,
    /// Bytes of the sentence so far.
    bytes: usize,
    cut: bool,
    wrong_sum: bool,
    after_star: bool,
}

impl ByteSpoiler {
    pub(super) fn new(faults: Arc<Faults>, sources: usize) -> Self {
        Self {
            faults,
            lines: vec![Sentence::default(); sources],
            spoiled: Vec::new(),
        }
    }

    pub(super) fn spoil(&mut self, source: usize, arrival: UtcNs, bytes: &mut Vec<u8>) {
        if self.faults.standing() == 0 {
            self.lines.fill(Sentence::default());
            return;
        }
        let Some(line) = self.lines.get_mut(source) else {
            return;
        };
        let out = &mut self.spoiled;
        out.clear();
        for &byte in bytes.iter() {
            if matches!(byte, b'$' | b'!') {
                *line = Sentence {
                    number: line.number + 1,
                    ..Sentence::default()
                };
                begin(&self.faults, source, arrival, line, out);
            }
            line.bytes += 1;
            out.push(match (line.wrong_sum && line.after_star, byte) {
                (true, b'0') => b'1',
                (true, _) => b'0',
                (false, byte) => byte,
            });
            line.after_star = byte == b'*';
            if line.cut && line.bytes == CUT_AFTER {
                out.extend(b"\r\n");
            }
        }
        std::mem::swap(bytes, out);
    }
}

/// A sentence begins: what strikes it.
fn begin(faults: &Faults, source: usize, arrival: UtcNs, line: &mut Sentence, out: &mut Vec<u8>) {
    let moment = Moment {
        utc: arrival,
        number: line.number,
        // Apart from the quantities of the source, which have small numbers.
        key: (source as u32) << 8 | 0xFF,
    };
    let wanted = |standing: &Standing| {
        matches!(standing.spec.kind, FaultKind::NavBytes(_))
            && standing.source.is_none_or(|wanted| wanted == source)
    };
    faults.each(moment, wanted, |standing, _, strength| {
        match standing.spec.kind {
            FaultKind::NavBytes(NavByteFault::Checksum) => line.wrong_sum = true,
            FaultKind::NavBytes(NavByteFault::Cut) => line.cut = true,
            FaultKind::NavBytes(NavByteFault::Noise { bytes }) => {
                let seed = standing.spec.seed;
                out.extend((0..bytes as u32).map(|k| {
                    let draw = unit(
                        seed ^ u64::from(k),
                        standing.id,
                        moment.number,
                        moment.key,
                        NOISE_TAG,
                    );
                    // No text: what a line at a wrong rate gives.
                    0x80 | (draw * 128.0) as u8
                }));
            }
            _ => return,
        }
        let mut injection = faults.injection(standing, moment, strength);
        injection.source = faults.sources.get(source).cloned();
        faults.log(standing, injection);
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

    /// A hundred headings over a line that cuts them every `every` bytes, through the fault, and how many it injected.
    fn heard(json: &str, every: usize) -> (String, usize) {
        let faults = Arc::new(super::super::testing::faults());
        faults.begin(UtcNs(0));
        let request: FaultRequest = serde_json::from_str(json).expect("JSON");
        faults.add(&request).expect("sound");
        let mut spoiler = ByteSpoiler::new(faults.clone(), 2);
        let text: String = (0..100)
            .map(|k| sentence(&format!("GPHDT,{k:03}.25,T")))
            .collect();
        let mut came = Vec::new();
        for chunk in text.as_bytes().chunks(every) {
            let mut bytes = chunk.to_vec();
            spoiler.spoil(0, UtcNs(1), &mut bytes);
            came.extend(bytes);
        }
        let log = faults.take_injections();
        assert!(log.iter().all(|i| i.source.as_deref() == Some("gnss")));
        let came = came.iter().map(|&b| char::from(b)).collect();
        (came, log.len())
    }

    #[test]
    fn a_wrong_checksum_is_wrong_however_the_line_cuts_the_bytes() {
        let json = r#"{"kind": "nav-checksum", "probability": 0.3, "seed": 2}"#;
        let (whole, injected) = heard(json, 10_000);
        assert!((14..=46).contains(&injected), "{injected}");
        for every in [1, 2, 7, 19] {
            assert_eq!(heard(json, every), (whole.clone(), injected), "{every}");
        }
        let wrong = whole.lines().filter(|line| {
            let body = line.trim_start_matches('$').split('*').next();
            format!("{line}\r\n") != sentence(body.expect("a body"))
        });
        assert_eq!(wrong.count(), injected);
        assert_eq!(whole.lines().count(), 100);
    }

    #[test]
    fn a_cut_sentence_is_two_lines_and_noise_stands_before_it() {
        let (cut, injected) = heard(r#"{"kind": "nav-cut", "probability": 0.3}"#, 5);
        assert_eq!(cut.lines().count(), 100 + injected);
        assert!(cut.contains("$GPHDT,00\r\n"), "{cut}");
        let (noisy, injected) = heard(
            r#"{"kind": "nav-noise", "value": 4, "probability": 0.3}"#,
            5,
        );
        let noise = noisy.chars().filter(|c| !c.is_ascii()).count();
        assert_eq!(noise, 4 * injected);
        assert!((14..=46).contains(&injected), "{injected}");
    }
}

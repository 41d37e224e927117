//! The trigger datagram `$PETKT,NUMBER,SECONDS,SONAR*SUM`, a proprietary NMEA 0183 sentence.
//!
//! NUMBER is the sender's pulse number. SECONDS is the pulse's UTC since 1970 with nine decimals. SUM is the exclusive or of the characters between
//! `$` and `*`, as two hexadecimal digits. Any other content is a trigger without a number.

use echotank_core::time::{NS_PER_S, UtcNs};

const TAG: &[u8] = b"$PETKT";
/// Maximum length of a sentence with its line end, bytes.
pub const MAX_BYTES: usize = 256;

/// A received trigger sentence.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum TriggerSentence {
    /// Content that is not a `$PETKT` sentence: a trigger without a number.
    Plain,
    /// Valid sentence with its pulse number.
    Numbered(u32),
    /// An incomplete or damaged `$PETKT` sentence.
    Invalid,
}

fn sum(body: &[u8]) -> u8 {
    body.iter().fold(0, |a, b| a ^ b)
}

/// Formats a sentence. `sonar` must contain neither commas nor asterisks.
pub fn write(number: u32, utc: UtcNs, sonar: &str) -> String {
    let seconds = utc.0.div_euclid(NS_PER_S);
    let ns = utc.0.rem_euclid(NS_PER_S);
    let body = format!("PETKT,{number},{seconds}.{ns:09},{sonar}");
    format!("${body}*{:02X}\r\n", sum(body.as_bytes()))
}

/// Parses a received datagram or line.
pub fn read(bytes: &[u8]) -> TriggerSentence {
    if !bytes.starts_with(TAG) {
        return TriggerSentence::Plain;
    }
    numbered(bytes.trim_ascii_end()).map_or(TriggerSentence::Invalid, TriggerSentence::Numbered)
}

fn numbered(sentence: &[u8]) -> Option<u32> {
    let (body, digits) = sentence.split_at_checked(sentence.len().checked_sub(3)?)?;
    let digits = std::str::from_utf8(digits.strip_prefix(b"*")?).ok()?;
    let body = body.strip_prefix(b"$")?;
    if u8::from_str_radix(digits, 16).ok()? != sum(body) {
        return None;
    }
    let number = body.split(|b| *b == b',').nth(1)?;
    std::str::from_utf8(number).ok()?.parse().ok()
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn a_sentence_reads_as_it_is_documented() {
        let text = write(17, UtcNs(1_406_851_210_500_000_001), "main");
        // Checksum computed by another program.
        assert_eq!(text, "$PETKT,17,1406851210.500000001,main*69\r\n");
        assert_eq!(read(text.as_bytes()), TriggerSentence::Numbered(17));
        assert_eq!(read(b"TRIG\n"), TriggerSentence::Plain);
        assert_eq!(read(b""), TriggerSentence::Plain);
        assert_eq!(read(b"$PETKT,17,1.0,main*00\r\n"), TriggerSentence::Invalid);
        assert_eq!(read(b"$PETKT"), TriggerSentence::Invalid);
    }

    proptest! {
        #[test]
        fn what_is_written_is_read_and_one_wrong_byte_spoils_it(
            number: u32, ns in 0..i64::MAX, at in 1usize..20, flip in 1u8..127,
        ) {
            let mut bytes = write(number, UtcNs(ns), "bow-1").into_bytes();
            prop_assert_eq!(read(&bytes), TriggerSentence::Numbered(number));
            bytes[at] ^= flip;
            prop_assert_ne!(read(&bytes), TriggerSentence::Numbered(number));
        }

        #[test]
        fn nothing_that_comes_panics(bytes in proptest::collection::vec(any::<u8>(), 0..80), ours: bool) {
            let mut text = if ours { TAG.to_vec() } else { Vec::new() };
            text.extend(bytes);
            read(&text);
        }
    }
}

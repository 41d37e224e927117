//! Imagenex 872 YellowFin: side-scan heads that answer every switch command with one line.
//!
//! Source: the messages of LSTS DUNE's `Sensors.Imagenex872`. This client reads no bytes of the answer's header, so these are 0
//! except for the letters.
//!
//! The TCP port is [`PORT`]. A client sends one [`SwitchCommand`] (27 bytes) per side and ping. The answer has [`ANSWER_BYTES`]: a
//! header of 12 bytes, 1000 bytes of echo, and FC.

use std::ops::Range;

use crate::WireError;
use crate::framing::{Framing, Scan, Splitter};
use crate::layout::data_at;

/// TCP port of the head.
pub const PORT: u16 = 4040;
/// Size of a switch command.
pub const SWITCH_BYTES: usize = 27;
/// Number of points in an echo.
pub const ECHO_BYTES: usize = 1000;
const ANSWER_HEADER_BYTES: usize = 12;
/// Size of an answer.
pub const ANSWER_BYTES: usize = ANSWER_HEADER_BYTES + ECHO_BYTES + 1;
/// Ranges that a head supports, metres.
pub const RANGES_M: [u8; 11] = [10, 20, 30, 40, 50, 60, 80, 100, 125, 150, 200];
/// Frequencies that a head supports, by their index.
pub const FREQUENCIES_KHZ: [u16; 3] = [260, 330, 770];
const BEGIN: [u8; 2] = [0xFE, 0x44];
const END: u8 = 0xFD;
const ANSWER_MARK: [u8; 3] = *b"IMX";
const ANSWER_END: u8 = 0xFC;

/// Side of the head.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Side {
    /// Port transducer.
    Port,
    /// Starboard transducer.
    Starboard,
}

/// Settings that a client requests for one ping.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct SwitchCommand {
    /// Range, one of [`RANGES_M`].
    pub range_m: u8,
    /// Frequency, an index into [`FREQUENCIES_KHZ`].
    pub frequency_index: u8,
    /// Receiver gain, 0 to 100.
    pub data_gain: u8,
    /// Balance between the sides, 0 to 60.
    pub balance_gain: u8,
    /// Side that pings.
    pub side: Side,
}

impl SwitchCommand {
    /// Parses the command at the front of `bytes`. An unsupported range or frequency is an error.
    pub fn parse(bytes: &[u8]) -> Result<Self, WireError> {
        const WHAT: &str = "Imagenex switch command";
        let bytes = data_at(bytes, 0, SWITCH_BYTES as u64, WHAT)?;
        if bytes[..2] != BEGIN || bytes[SWITCH_BYTES - 1] != END {
            let got = u32::from_be_bytes([0, bytes[0], bytes[1], bytes[26]]);
            return Err(WireError::mark(WHAT, 0xFE_44_FDu32, got));
        }
        if !RANGES_M.contains(&bytes[3]) {
            return Err(WireError::unsupported("Imagenex range", bytes[3]));
        }
        if usize::from(bytes[7]) >= FREQUENCIES_KHZ.len() {
            return Err(WireError::unsupported("Imagenex frequency index", bytes[7]));
        }
        let side = match bytes[18] {
            0 => Side::Port,
            2 => Side::Starboard,
            other => return Err(WireError::unsupported("Imagenex side", other)),
        };
        Ok(Self {
            range_m: bytes[3],
            frequency_index: bytes[7],
            data_gain: bytes[8].min(100),
            balance_gain: bytes[10].min(60),
            side,
        })
    }

    /// Appends the command and returns its byte range.
    pub fn emit(&self, buf: &mut Vec<u8>) -> Range<usize> {
        let start = buf.len();
        let mut bytes = [0; SWITCH_BYTES];
        bytes[..2].copy_from_slice(&BEGIN);
        bytes[3] = self.range_m;
        bytes[7] = self.frequency_index;
        bytes[8] = self.data_gain;
        bytes[10] = self.balance_gain;
        bytes[18] = match self.side {
            Side::Port => 0,
            Side::Starboard => 2,
        };
        bytes[SWITCH_BYTES - 1] = END;
        buf.extend(bytes);
        start..buf.len()
    }
}

/// Appends the answer: one side's echo over the whole range, from the head outwards.
pub fn emit_answer(buf: &mut Vec<u8>, echo: &[u8; ECHO_BYTES]) -> Range<usize> {
    let start = buf.len();
    buf.extend(ANSWER_MARK);
    buf.resize(start + ANSWER_HEADER_BYTES, 0);
    buf.extend(echo);
    buf.push(ANSWER_END);
    start..buf.len()
}

/// The echo in the answer at the front of `bytes`.
pub fn parse_answer(bytes: &[u8]) -> Result<&[u8; ECHO_BYTES], WireError> {
    const WHAT: &str = "Imagenex answer";
    let bytes = data_at(bytes, 0, ANSWER_BYTES as u64, WHAT)?;
    if bytes[..3] != ANSWER_MARK || bytes[ANSWER_BYTES - 1] != ANSWER_END {
        return Err(WireError::mark(WHAT, ANSWER_END, bytes[ANSWER_BYTES - 1]));
    }
    let echo = bytes[ANSWER_HEADER_BYTES..].first_chunk();
    Ok(echo.expect("the answer has the echo's length"))
}

/// Framing of answers, which have a constant length.
#[derive(Debug, Clone, Copy, Default)]
pub struct AnswerFraming;

impl Framing for AnswerFraming {
    fn max_message_bytes(&self) -> usize {
        ANSWER_BYTES
    }

    fn scan(&self, bytes: &[u8]) -> Scan {
        let wrong = Scan::Wrong(WireError::mark("Imagenex answer", ANSWER_MARK[0], bytes[0]));
        if bytes
            .iter()
            .zip(ANSWER_MARK)
            .any(|(&byte, mark)| byte != mark)
        {
            return wrong;
        }
        match bytes.get(ANSWER_BYTES - 1) {
            None => Scan::More,
            Some(&ANSWER_END) => Scan::Whole(ANSWER_BYTES),
            Some(_) => wrong,
        }
    }
}

/// Splitter of a connection into answers.
pub type AnswerStream = Splitter<AnswerFraming>;

/// Framing of commands.
#[derive(Debug, Clone, Copy, Default)]
pub struct SwitchFraming;

impl Framing for SwitchFraming {
    fn max_message_bytes(&self) -> usize {
        SWITCH_BYTES
    }

    fn scan(&self, bytes: &[u8]) -> Scan {
        let wrong = Scan::Wrong(WireError::mark("Imagenex switch command", 0xFEu8, bytes[0]));
        if bytes.iter().zip(BEGIN).any(|(&byte, mark)| byte != mark) {
            return wrong;
        }
        match bytes.get(SWITCH_BYTES - 1) {
            None => Scan::More,
            Some(&END) => Scan::Whole(SWITCH_BYTES),
            Some(_) => wrong,
        }
    }
}

/// Framing of both commands and answers.
#[derive(Debug, Clone, Copy, Default)]
pub struct EitherFraming;

impl Framing for EitherFraming {
    fn max_message_bytes(&self) -> usize {
        ANSWER_BYTES
    }

    fn scan(&self, bytes: &[u8]) -> Scan {
        let seen = bytes.len().min(ANSWER_MARK.len());
        if bytes[..seen] != ANSWER_MARK[..seen] {
            return SwitchFraming.scan(bytes);
        }
        match bytes.get(ANSWER_BYTES - 1) {
            None => Scan::More,
            Some(&ANSWER_END) => Scan::Whole(ANSWER_BYTES),
            Some(&other) => Scan::Wrong(WireError::mark("Imagenex answer", ANSWER_END, other)),
        }
    }
}

/// Splitter of a connection into commands.
pub type SwitchStream = Splitter<SwitchFraming>;

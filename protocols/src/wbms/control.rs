//! Text commands of WBMS. Source: TN-180197 and TN-180196 (commands and their limits); revision 11 for the commands of gain, rates,
//! transmit sector, time and logs.
//!
//! A line has a command and its arguments and ends with CR LF. A widely used client omits CR LF, so the end of a TCP segment also
//! ends a command. A command without arguments is a query. The answer repeats the command with its values and may have a comment
//! after `#`.

use std::fmt::Write as _;

/// Maximum length of a line.
pub const MAX_LINE_BYTES: usize = 512;

/// A valid command within its limits.
#[derive(Debug, Clone, PartialEq)]
pub enum Command {
    /// Queries the setting with this name.
    Query(String),
    /// Operating mode, 0 to 7; 1 is bathymetry.
    Mode(u8),
    /// Side-scan mode: 0 off, 1 or 9.
    SidescanMode(u8),
    /// Reverses port and starboard.
    Flip(bool),
    /// Restores the default settings.
    Default,
    /// Gate mode, 0 to 2.
    GateMode(u8),
    /// Tilt of the gates.
    GateTiltDeg(f64),
    /// First and last range, and optionally depths, metres.
    RangeM {
        /// First range.
        start: f64,
        /// Last range.
        stop: f64,
        /// First and last depth.
        depths: Option<(f64, f64)>,
    },
    /// Direction of the swath's centre.
    DirectionDeg(f64),
    /// Width of the swath.
    OpeningAngleDeg(f64),
    /// Resolution of the detections.
    Resolution {
        /// Vertical resolution.
        vertical: f64,
        /// Horizontal resolution.
        horizontal: f64,
    },
    /// Transmitted pulse.
    Tx {
        /// Centre frequency.
        frequency_khz: f64,
        /// Bandwidth.
        bandwidth_khz: f64,
        /// Amplitude, 0 to 15.
        amplitude: u8,
        /// Pulse length.
        length_us: f64,
    },
    /// Ping rate up to 60; -1 means as fast as possible.
    RateHz(f64),
    /// Rate of snippets: -1 with every ping, 0 never.
    SnippetRateHz(f64),
    /// Rate of water-column packets: -1 with every ping, 0 never.
    WaterColumnRateHz(f64),
    /// Receiver gain.
    GainDb(f64),
    /// Variable gain, dB in 100 m.
    VgaDb(f64),
    /// Direction of the transmit sector.
    TxDirectionDeg(f64),
    /// Width of the transmit sector.
    TxOpeningAngleDeg(f64),
    /// Number of transmit beams, 1 to 64.
    TxBeams(u8),
    /// Decimation of the matched filter, 1 to 16.
    MfDecimation(u8),
    /// Source of the time, 0 to 8.
    TimeSource(u8),
    /// Address of the NTP server.
    NtpServer(String),
    /// Trigger mode, 0 to 5; 4 and 5 are external.
    TriggerMode(u8),
    /// Sound speed; `None` uses the probe.
    SoundVelocity(Option<f64>),
    /// Preset of the automatic gate, 0 to 3.
    AutogatePreset(u8),
    /// Switches pinging on or off.
    Power(bool),
    /// Closes the connection.
    Exit,
}

/// Reason why a command is refused.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum CommandError {
    #[error("unknown command {0:?}")]
    /// The command does not exist.
    Unknown(String),
    #[error("{command} takes {expected} arguments, not {got}")]
    /// The number of arguments is wrong.
    Arguments {
        /// Name of the command.
        command: &'static str,
        /// Permitted numbers in words.
        expected: &'static str,
        /// Number found.
        got: usize,
    },
    #[error("{command}: {text:?} is not a number")]
    /// An argument is not a number.
    Number {
        /// Name of the command.
        command: &'static str,
        /// Argument found.
        text: String,
    },
    #[error("{command} takes {low} to {high}, not {got}")]
    /// An argument exceeds its limits.
    Range {
        /// Name of the command.
        command: &'static str,
        /// Lower limit.
        low: f64,
        /// Upper limit.
        high: f64,
        /// Value found.
        got: f64,
    },
    #[error("line of {got} bytes, at most {MAX_LINE_BYTES}")]
    /// The line is too long.
    TooLong {
        /// Number of bytes found.
        got: usize,
    },
}

/// Commands in a TCP segment, ended by CR, LF or the end of the segment; empty lines are skipped.
pub fn commands_in(segment: &str) -> impl Iterator<Item = Result<Command, CommandError>> + '_ {
    segment
        .split(['\r', '\n'])
        .map(str::trim)
        .filter(|line| !line.is_empty())
        .map(Command::parse)
}

/// Text of an answer: the command, its values, an optional comment, CR LF.
pub fn answer(command: &str, values: &[f64], comment: &str) -> String {
    let mut text = command.to_owned();
    for value in values {
        write!(text, " {value}").expect("writing to a String cannot fail");
    }
    if !comment.is_empty() {
        // A line break in a comment would start another answer.
        write!(text, " # {}", comment.replace(['\r', '\n'], " "))
            .expect("writing to a String cannot fail");
    }
    text.push_str("\r\n");
    text
}

/// Commands with arguments, and commands that can be queried.
const COMMANDS: [&str; 33] = [
    "set_mode",
    "set_sidescan_mode",
    "set_flip",
    "set_default",
    "set_gate_mode",
    "set_gate_tilt",
    "set_range",
    "set_direction",
    "set_opening_angle",
    "set_resolution",
    "set_tx",
    "set_gain",
    "set_vga",
    "set_rate",
    "set_tp_rate",
    "set_snippet_rate",
    "set_trigger_mode",
    "set_tx_direction",
    "set_tx_opening_angle",
    "set_tx_beam_number",
    "set_mf_decimation",
    "set_time_source",
    "set_ntp_server",
    "sound_velocity",
    "set_autogate_preset",
    "set_power",
    "exit",
    "temperature",
    "revision",
    "serial",
    "partno",
    "bit_log",
    "ntp_log",
];

impl Command {
    /// Parses one line without its terminator.
    pub fn parse(line: &str) -> Result<Self, CommandError> {
        if line.len() > MAX_LINE_BYTES {
            return Err(CommandError::TooLong { got: line.len() });
        }
        let line = line.split('#').next().unwrap_or_default();
        let mut words = line.split_ascii_whitespace();
        let word = words.next().unwrap_or_default();
        let command = *COMMANDS
            .iter()
            .find(|&&known| known == word)
            .ok_or_else(|| CommandError::Unknown(word.to_owned()))?;
        let texts: Vec<&str> = words.collect();
        match command {
            "set_default" => return Ok(Self::Default),
            "exit" => return Ok(Self::Exit),
            _ if texts.is_empty() => return Ok(Self::Query(command.to_owned())),
            "set_ntp_server" => {
                return match texts[..] {
                    [server] => Ok(Self::NtpServer(server.to_owned())),
                    _ => Err(CommandError::Arguments {
                        command,
                        expected: "one",
                        got: texts.len(),
                    }),
                };
            }
            _ => {}
        }
        let values = texts
            .iter()
            .map(|text| {
                text.parse::<f64>()
                    .ok()
                    .filter(|value| value.is_finite())
                    .ok_or_else(|| CommandError::Number {
                        command,
                        text: (*text).to_owned(),
                    })
            })
            .collect::<Result<Vec<f64>, _>>()?;
        let wrong = |expected| CommandError::Arguments {
            command,
            expected,
            got: values.len(),
        };
        let one = |low: f64, high: f64| match values[..] {
            [value] => within(command, value, low, high),
            _ => Err(wrong("one")),
        };
        Ok(match command {
            "set_mode" => Self::Mode(one(0.0, 7.0)? as u8),
            "set_sidescan_mode" => Self::SidescanMode(one(0.0, 9.0)? as u8),
            "set_flip" => Self::Flip(one(0.0, 1.0)? != 0.0),
            "set_gate_mode" => Self::GateMode(one(0.0, 2.0)? as u8),
            "set_gate_tilt" => Self::GateTiltDeg(one(-90.0, 90.0)?),
            "set_range" => match values[..] {
                [start, stop] => Self::range(start, stop, None)?,
                [start, stop, least, most] => Self::range(start, stop, Some((least, most)))?,
                _ => return Err(wrong("two or four")),
            },
            "set_direction" => Self::DirectionDeg(one(-180.0, 180.0)?),
            "set_opening_angle" => Self::OpeningAngleDeg(one(0.0, 360.0)?),
            "set_resolution" => match values[..] {
                [vertical, horizontal] => Self::Resolution {
                    vertical,
                    horizontal,
                },
                _ => return Err(wrong("two")),
            },
            "set_tx" => match values[..] {
                [frequency_khz, bandwidth_khz, amplitude, length_us] => Self::Tx {
                    frequency_khz: within(command, frequency_khz, 0.0, 1e4)?,
                    bandwidth_khz: within(command, bandwidth_khz, 0.0, 1e4)?,
                    amplitude: within(command, amplitude, 0.0, 15.0)? as u8,
                    length_us: within(command, length_us, 0.0, 1e6)?,
                },
                _ => return Err(wrong("four")),
            },
            "set_rate" => Self::RateHz(one(-1.0, 60.0)?),
            "set_snippet_rate" => Self::SnippetRateHz(one(-1.0, 60.0)?),
            "set_tp_rate" => Self::WaterColumnRateHz(one(-1.0, 60.0)?),
            "set_gain" => Self::GainDb(one(0.0, 100.0)?),
            "set_vga" => Self::VgaDb(one(0.0, 100.0)?),
            "set_tx_direction" => Self::TxDirectionDeg(one(-90.0, 90.0)?),
            "set_tx_opening_angle" => Self::TxOpeningAngleDeg(one(0.0, 90.0)?),
            "set_tx_beam_number" => Self::TxBeams(one(1.0, 64.0)? as u8),
            "set_mf_decimation" => Self::MfDecimation(one(1.0, 16.0)? as u8),
            "set_time_source" => Self::TimeSource(one(0.0, 8.0)? as u8),
            "set_trigger_mode" => Self::TriggerMode(one(0.0, 5.0)? as u8),
            "sound_velocity" => {
                let value = one(-1.0, 3000.0)?;
                Self::SoundVelocity((value > 0.0).then_some(value))
            }
            "set_autogate_preset" => Self::AutogatePreset(one(0.0, 3.0)? as u8),
            "set_power" => Self::Power(one(0.0, 1.0)? != 0.0),
            // Query-only commands.
            _ => return Err(wrong("no")),
        })
    }

    fn range(start: f64, stop: f64, depths: Option<(f64, f64)>) -> Result<Self, CommandError> {
        within("set_range", start, 0.0, 1e4)?;
        within("set_range", stop, start, 1e4)?;
        Ok(Self::RangeM {
            start,
            stop,
            depths,
        })
    }
}

fn within(command: &'static str, got: f64, low: f64, high: f64) -> Result<f64, CommandError> {
    if (low..=high).contains(&got) {
        Ok(got)
    } else {
        Err(CommandError::Range {
            command,
            low,
            high,
            got,
        })
    }
}

//! SigMF: the metadata of a sample file. Source: SigMF specification 1.2 (public), `core` namespace.
//!
//! A recording consists of two files. `NAME.sigmf-data` holds the samples of all channels, interleaved by sample time.
//! `NAME.sigmf-meta` is JSON with the format (`global`), the start and time of each ping (`captures`) and the contents
//! (`annotations`). Sample numbers count sample times; each has a sample of every channel.

use serde_json::{Map, Value, json};

use crate::calendar::DateTime;

/// Version of the specification.
pub const VERSION: &str = "1.2.5";

/// Number type of one sample of a channel.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum DataType {
    /// Complex 16-bit integers.
    ComplexI16,
    /// Real 16-bit integers.
    RealI16,
    /// Complex 32-bit floats.
    ComplexF32,
    /// Real 32-bit floats.
    RealF32,
}

impl DataType {
    /// SigMF name of the type, little endian.
    pub fn name(self) -> &'static str {
        match self {
            Self::ComplexI16 => "ci16_le",
            Self::RealI16 => "ri16_le",
            Self::ComplexF32 => "cf32_le",
            Self::RealF32 => "rf32_le",
        }
    }

    fn from_name(name: &str) -> Option<Self> {
        [
            Self::ComplexI16,
            Self::RealI16,
            Self::ComplexF32,
            Self::RealF32,
        ]
        .into_iter()
        .find(|kind| kind.name() == name)
    }

    /// Size of one sample of one channel.
    pub fn bytes(self) -> usize {
        match self {
            Self::RealI16 => 2,
            Self::ComplexI16 | Self::RealF32 => 4,
            Self::ComplexF32 => 8,
        }
    }
}

/// Contiguous section of samples: one ping.
#[derive(Debug, Clone, PartialEq)]
pub struct Capture {
    /// Index of the first sample.
    pub sample_start: u64,
    /// Frequency at the transducer that is 0 Hz in the samples; `None` for real samples.
    pub frequency_hz: Option<f64>,
    /// Time of the first sample, nanoseconds since 1970.
    pub utc_ns: i64,
}

/// Description of a section of samples.
#[derive(Debug, Clone, PartialEq)]
pub struct Annotation {
    /// Index of the first sample.
    pub sample_start: u64,
    /// Number of samples.
    pub sample_count: u64,
    /// Short label. Many programs display at most 20 characters.
    pub label: String,
    /// Comment, free text.
    pub comment: String,
    /// Lower and upper edge of the pulse's band at the transducer.
    pub band_hz: Option<(f64, f64)>,
}

/// Metadata of a recording.
#[derive(Debug, Clone, PartialEq)]
pub struct Recording {
    /// Type of the samples.
    pub data_type: DataType,
    /// Sample rate of each channel.
    pub sample_rate_hz: f64,
    /// Number of channels.
    pub channels: u32,
    /// Equipment that recorded the samples.
    pub hardware: String,
    /// Description, free text.
    pub description: String,
    /// Program that wrote the file.
    pub recorder: String,
    /// Captures, ordered by first sample.
    pub captures: Vec<Capture>,
    /// Annotations, ordered by first sample.
    pub annotations: Vec<Annotation>,
}

/// Error in SigMF metadata.
#[derive(Debug, thiserror::Error)]
pub enum SigmfError {
    #[error("not JSON: {0}")]
    /// The text is not JSON.
    Json(#[from] serde_json::Error),
    #[error("{field} is missing or has the wrong type")]
    /// A field is missing or has the wrong type.
    Field {
        /// Name of the field.
        field: &'static str,
    },
    #[error("data type {got:?} is not supported")]
    /// The data type is not supported.
    DataType {
        /// Name found.
        got: String,
    },
}

impl Recording {
    /// Text of the `.sigmf-meta` file.
    pub fn to_json(&self) -> String {
        let captures: Vec<Value> = self.captures.iter().map(Capture::to_json).collect();
        let annotations: Vec<Value> = self.annotations.iter().map(Annotation::to_json).collect();
        let all = json!({
            "global": {
                "core:datatype": self.data_type.name(),
                "core:sample_rate": self.sample_rate_hz,
                "core:version": VERSION,
                "core:num_channels": self.channels,
                "core:hw": self.hardware,
                "core:description": self.description,
                "core:recorder": self.recorder,
            },
            "captures": captures,
            "annotations": annotations,
        });
        format!("{all:#}\n")
    }

    /// Parses the text of a `.sigmf-meta` file.
    pub fn parse(text: &str) -> Result<Self, SigmfError> {
        let all: Value = serde_json::from_str(text)?;
        let global = all
            .get("global")
            .ok_or(SigmfError::Field { field: "global" })?;
        let name = text_at(global, "core:datatype")?;
        let list = |field: &'static str| {
            all.get(field)
                .and_then(Value::as_array)
                .ok_or(SigmfError::Field { field })
        };
        let optional = |field| text_at(global, field).unwrap_or_default().to_owned();
        Ok(Self {
            data_type: DataType::from_name(name).ok_or_else(|| SigmfError::DataType {
                got: name.to_owned(),
            })?,
            sample_rate_hz: number_at(global, "core:sample_rate")?,
            channels: match global.get("core:num_channels") {
                None => 1,
                Some(value) => {
                    value
                        .as_u64()
                        .and_then(|n| u32::try_from(n).ok())
                        .ok_or(SigmfError::Field {
                            field: "core:num_channels",
                        })?
                }
            },
            hardware: optional("core:hw"),
            description: optional("core:description"),
            recorder: optional("core:recorder"),
            captures: list("captures")?
                .iter()
                .map(Capture::parse)
                .collect::<Result<_, _>>()?,
            annotations: list("annotations")?
                .iter()
                .map(Annotation::parse)
                .collect::<Result<_, _>>()?,
        })
    }
}

impl Capture {
    /// The capture as a JSON object.
    pub fn to_json(&self) -> Value {
        let mut map = Map::new();
        map.insert("core:sample_start".into(), self.sample_start.into());
        if let Some(hz) = self.frequency_hz {
            map.insert("core:frequency".into(), hz.into());
        }
        map.insert("core:datetime".into(), date_time(self.utc_ns).into());
        map.into()
    }

    /// Parses a capture object.
    pub fn parse(value: &Value) -> Result<Self, SigmfError> {
        Ok(Self {
            sample_start: whole_at(value, "core:sample_start")?,
            frequency_hz: value.get("core:frequency").and_then(Value::as_f64),
            utc_ns: utc_ns(text_at(value, "core:datetime")?).ok_or(SigmfError::Field {
                field: "core:datetime",
            })?,
        })
    }
}

impl Annotation {
    /// The annotation as a JSON object.
    pub fn to_json(&self) -> Value {
        let mut value = json!({
            "core:sample_start": self.sample_start,
            "core:sample_count": self.sample_count,
            "core:label": self.label,
            "core:comment": self.comment,
        });
        if let Some((low, high)) = self.band_hz {
            value["core:freq_lower_edge"] = low.into();
            value["core:freq_upper_edge"] = high.into();
        }
        value
    }

    /// Parses an annotation object.
    pub fn parse(value: &Value) -> Result<Self, SigmfError> {
        let edge = |field| value.get(field).and_then(Value::as_f64);
        let text = |field| text_at(value, field).unwrap_or_default().to_owned();
        Ok(Self {
            sample_start: whole_at(value, "core:sample_start")?,
            sample_count: whole_at(value, "core:sample_count")?,
            label: text("core:label"),
            comment: text("core:comment"),
            band_hz: edge("core:freq_lower_edge").zip(edge("core:freq_upper_edge")),
        })
    }
}

fn text_at<'a>(value: &'a Value, field: &'static str) -> Result<&'a str, SigmfError> {
    let text = value.get(field).and_then(Value::as_str);
    text.ok_or(SigmfError::Field { field })
}

fn number_at(value: &Value, field: &'static str) -> Result<f64, SigmfError> {
    let number = value.get(field).and_then(Value::as_f64);
    number.ok_or(SigmfError::Field { field })
}

fn whole_at(value: &Value, field: &'static str) -> Result<u64, SigmfError> {
    let number = value.get(field).and_then(Value::as_u64);
    number.ok_or(SigmfError::Field { field })
}

/// ISO 8601 with nine decimals of a second.
fn date_time(utc_ns: i64) -> String {
    let m = DateTime::from_utc_ns(utc_ns);
    format!(
        "{:04}-{:02}-{:02}T{:02}:{:02}:{:02}.{:09}Z",
        m.year, m.month, m.day, m.hour, m.minute, m.second, m.nanosecond
    )
}

/// Nanoseconds since 1970 of an ISO 8601 time with up to nine decimals of a second.
fn utc_ns(text: &str) -> Option<i64> {
    let (date, time) = text.strip_suffix('Z')?.split_once('T')?;
    let number = |text: &str, digits: usize| {
        let is_number = text.len() == digits && text.bytes().all(|byte| byte.is_ascii_digit());
        is_number.then(|| text.parse::<i64>().ok()).flatten()
    };
    let mut date = date.split('-');
    let year = number(date.next()?, 4)?;
    let month = number(date.next()?, 2)?;
    let day = number(date.next()?, 2)?;
    let (time, fraction) = time.split_once('.').unwrap_or((time, "0"));
    let mut time = time.split(':');
    let hour = number(time.next()?, 2)?;
    let minute = number(time.next()?, 2)?;
    let second = number(time.next()?, 2)?;
    let digits = fraction.len().min(9);
    let fraction = number(fraction.get(..digits)?, digits)? * 10_i64.pow(9 - digits as u32);
    let is_moment = (1970..2262).contains(&year)
        && (1..=12).contains(&month)
        && (1..=31).contains(&day)
        && hour < 24
        && minute < 60
        && second < 61
        && date.next().is_none()
        && time.next().is_none();
    is_moment.then(|| {
        let days = crate::calendar::days_from_epoch(year, month, day);
        (days * 86_400 + hour * 3600 + minute * 60 + second) * 1_000_000_000 + fraction
    })
}

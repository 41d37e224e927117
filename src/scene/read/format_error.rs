//! Errors in the content of a file.

use std::fmt::Display;

use super::text::TextError;

/// Greatest number of characters of a value in an error.
const SHOWN_CHARACTERS: usize = 60;

/// Error in the content of a file. Displayed as `place: ``value``: rule`.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct FormatError {
    /// Location as precise as the format allows: "line 3", "tag ModelPixelScale", "/BAG_root/elevation".
    pub place: String,
    /// The value; empty if there is none to show.
    pub value: String,
    /// The rule that the value breaks.
    pub rule: String,
}

impl FormatError {
    /// An error at a place of a file. The value is shortened.
    pub fn new(place: impl Into<String>, value: impl Display, rule: impl Into<String>) -> Self {
        let value = value.to_string();
        let shown = value
            .chars()
            .map(|c| if c.is_control() { ' ' } else { c })
            .take(SHOWN_CHARACTERS);
        Self {
            place: place.into(),
            value: shown.collect(),
            rule: rule.into(),
        }
    }

    /// An error that a decoding library reported.
    pub fn decoder(place: impl Into<String>, error: impl Display) -> Self {
        let message = error.to_string();
        let line: String = message.split_whitespace().collect::<Vec<_>>().join(" ");
        let line: String = line.chars().take(200).collect();
        let lower = line.to_ascii_lowercase();
        let unsupported = ["unsupported", "not supported", "unimplemented"];
        let what = match unsupported.iter().any(|word| lower.contains(word)) {
            true => "not supported",
            false => "damaged or cut short",
        };
        Self::new(place, "", format!("{what}: {line}"))
    }
}

/// Refuses a value at a place of a file.
pub(super) fn refuse<T>(
    place: impl Into<String>,
    value: impl Display,
    rule: impl Into<String>,
) -> Result<T, FormatError> {
    Err(FormatError::new(place, value, rule))
}

/// Names the place of an error that a decoding library reported.
pub(super) trait At<T> {
    fn at(self, place: impl Into<String>) -> Result<T, FormatError>;
}

impl<T, E: Display> At<T> for Result<T, E> {
    fn at(self, place: impl Into<String>) -> Result<T, FormatError> {
        self.map_err(|error| FormatError::decoder(place, error))
    }
}

impl Display for FormatError {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self.value.is_empty() {
            true => write!(f, "{}: {}", self.place, self.rule),
            false => write!(f, "{}: `{}`: {}", self.place, self.value, self.rule),
        }
    }
}

impl std::error::Error for FormatError {}

impl From<TextError> for FormatError {
    fn from(error: TextError) -> Self {
        let column = error
            .column
            .map(|c| format!(", column `{c}`"))
            .unwrap_or_default();
        Self::new(
            format!("line {}{column}", error.line),
            &error.value,
            error.rule,
        )
    }
}

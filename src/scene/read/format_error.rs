//! What is wrong with a file, and where.

use super::text::TextError;

/// Characters of an offending value that are repeated.
const SHOWN_CHARACTERS: usize = 60;

/// A place in a file where it does not say what it should. Displayed as `place: ``value``: rule`.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct FormatError {
    /// "line 3", "tag ModelPixelScale", "/BAG_root/elevation": as near as the format lets one name it.
    pub place: String,
    /// Empty where nothing can be shown.
    pub value: String,
    pub rule: String,
}

impl FormatError {
    pub fn new(place: impl Into<String>, value: &str, rule: impl Into<String>) -> Self {
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

    /// What a decoder of somebody else's said.
    pub fn decoder(place: impl Into<String>, error: impl std::fmt::Display) -> Self {
        let said = error.to_string();
        let line: String = said.split_whitespace().collect::<Vec<_>>().join(" ");
        Self::new(
            place,
            "",
            format!(
                "damaged or cut short: {}",
                line.chars().take(200).collect::<String>()
            ),
        )
    }
}

impl std::fmt::Display for FormatError {
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

//! Units of length in seabed files.

/// The international foot, metres.
pub(crate) const FOOT_M: f64 = 0.3048;
/// The foot of United States surveys, metres.
pub(crate) const SURVEY_FOOT_M: f64 = 1200.0 / 3937.0;
const FATHOM_M: f64 = 1.8288;

/// Units of length that a file states, metres; none where it states none.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(crate) struct Units {
    /// Of x and y.
    pub(crate) horizontal_m: Option<f64>,
    /// Of the heights.
    pub(crate) vertical_m: Option<f64>,
}

/// The unit of a code of the EPSG register, metres.
pub(crate) fn of_epsg(code: u32) -> Option<f64> {
    match code {
        9001 => Some(1.0),
        9002 => Some(FOOT_M),
        9003 => Some(SURVEY_FOOT_M),
        9014 => Some(FATHOM_M),
        9036 => Some(1000.0),
        1025 => Some(1e-3),
        1033 => Some(1e-2),
        _ => None,
    }
}

/// The unit that a word names, metres.
pub(crate) fn of_word(word: &str) -> Option<f64> {
    let plain: String = word
        .chars()
        .filter(char::is_ascii_alphanumeric)
        .collect::<String>()
        .to_ascii_lowercase();
    Some(match plain.as_str() {
        "m" | "metre" | "metres" | "meter" | "meters" => 1.0,
        "ft" | "foot" | "feet" | "ift" | "internationalfoot" => FOOT_M,
        "usft" | "ftus" | "ussurveyfoot" | "ussurveyfeet" | "surveyfoot" => SURVEY_FOOT_M,
        "fm" | "fathom" | "fathoms" => FATHOM_M,
        "km" => 1000.0,
        "dm" => 0.1,
        "cm" => 1e-2,
        "mm" => 1e-3,
        _ => return None,
    })
}

/// The unit as text.
pub(crate) fn name(metres: f64) -> String {
    for (unit_m, name) in [
        (1.0, "metres"),
        (FOOT_M, "feet"),
        (SURVEY_FOOT_M, "US survey feet"),
        (FATHOM_M, "fathoms"),
    ] {
        if (metres - unit_m).abs() < 1e-9 {
            return name.to_owned();
        }
    }
    format!("units of {metres} m")
}

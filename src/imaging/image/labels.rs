//! Numbers in pictures: digits of three by five pixels, drawn at double size.

/// Rows of three bits from the top.
const DIGITS: [[u8; 5]; 10] = [
    [7, 5, 5, 5, 7],
    [2, 6, 2, 2, 7],
    [7, 1, 7, 4, 7],
    [7, 1, 7, 1, 7],
    [5, 5, 7, 1, 1],
    [7, 4, 7, 1, 7],
    [7, 4, 7, 5, 7],
    [7, 1, 1, 2, 2],
    [7, 5, 7, 5, 7],
    [7, 5, 7, 1, 7],
];
const POINT: [u8; 5] = [0, 0, 0, 0, 2];
const MINUS: [u8; 5] = [0, 0, 7, 0, 0];
const METRE: [u8; 5] = [0, 0, 7, 7, 5];
const DEGREE: [u8; 5] = [6, 6, 0, 0, 0];
const SCALE: usize = 2;
/// Width of a character with its gap, and height of a line, pixels.
pub(crate) const ADVANCE: usize = 4 * SCALE;
pub(super) const HEIGHT: usize = 5 * SCALE;

/// Pixels (x, y) of `text` relative to its upper left corner. It supports digits, point, minus, `m` and the degree sign; other characters
/// are blank.
pub(super) fn pixels(text: &str) -> impl Iterator<Item = (usize, usize)> + '_ {
    text.chars().enumerate().flat_map(|(place, letter)| {
        let rows = match letter {
            '0'..='9' => DIGITS[letter as usize - '0' as usize],
            '.' => POINT,
            '-' => MINUS,
            'm' => METRE,
            '\u{b0}' => DEGREE,
            _ => [0; 5],
        };
        (0..5 * SCALE).flat_map(move |y| {
            (0..3 * SCALE)
                .filter(move |x| rows[y / SCALE] >> (2 - x / SCALE) & 1 == 1)
                .map(move |x| (place * ADVANCE + x, y))
        })
    })
}

/// The step of 1, 2 or 5 times a power of ten that divides `length` into about `wanted` intervals.
pub(crate) fn round_step(length: f64, wanted: f64) -> f64 {
    let raw = (length / wanted).max(f64::MIN_POSITIVE);
    let power = 10f64.powf(raw.log10().floor());
    let step = [1.0, 2.0, 5.0, 10.0]
        .into_iter()
        .find(|s| s * power >= raw * 0.999);
    step.unwrap_or(10.0) * power
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn steps_are_round_and_fit() {
        for (length, want) in [(10.0, 2.0), (75.0, 20.0), (100.0, 20.0), (0.3, 0.05)] {
            let got = round_step(length, 6.0);
            assert!(
                (got - want).abs() < 1e-9 * want,
                "{length}: {got} want {want}"
            );
        }
        assert_eq!(pixels("1").count(), 4 * 8);
    }
}

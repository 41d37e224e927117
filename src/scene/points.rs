//! Explicit scatterers: a CSV table to [`Scatterers`].
//!
//! Columns `north_m,east_m,down_m,amplitude[,amplitude_imag]`: metres from the scene's origin, and the linear pressure at 1 m for unit incident
//! pressure. Numbers are rounded to the nearest f64 and the rows keep their order, so that an external calculation has the same scene.

use glam::DVec3;
use num_complex::Complex64;

use super::text::{self, Column, MAX_HORIZONTAL_M, MAX_VERTICAL_M, TextError, optional, required};
use echotank_core::scene::{ScatterLaw, Scatterers};

/// Greatest number of rows: 16 million points take a gigabyte.
pub(crate) const MAX_POINTS: usize = 1 << 24;

/// Largest amplitude, 120 dB. It is far above any real one and keeps sums finite.
const MAX_AMPLITUDE: f64 = 1e6;

const COLUMNS: [Column; 5] = [
    required("north_m"),
    required("east_m"),
    required("down_m"),
    required("amplitude"),
    optional("amplitude_imag"),
];

/// Reads a table of points, in scene coordinates.
///
/// # Errors
/// Returns the line, the column, the value and the rule it breaks.
pub fn parse(bytes: &[u8]) -> Result<Scatterers, TextError> {
    let horizontal = -MAX_HORIZONTAL_M..=MAX_HORIZONTAL_M;
    let amplitude = -MAX_AMPLITUDE..=MAX_AMPLITUDE;
    let mut points = Scatterers::default();
    text::read_table(bytes, &COLUMNS, |row| {
        if points.len() == MAX_POINTS {
            let rule = format!("at most {MAX_POINTS} points are read");
            return Err(row.text_error(0, rule));
        }
        let position_m = DVec3::new(
            row.number(0, horizontal.clone(), 0.0)?,
            row.number(1, horizontal.clone(), 0.0)?,
            row.number(2, -MAX_VERTICAL_M..=MAX_VERTICAL_M, 0.0)?,
        );
        let strength = Complex64::new(
            row.number(3, amplitude.clone(), 0.0)?,
            row.number(4, amplitude.clone(), 0.0)?,
        );
        points.push(position_m, super::UP, strength, ScatterLaw::Point);
        Ok(())
    })?;
    Ok(points)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_are_read_to_the_last_bit_in_file_order_whatever_the_column_order() {
        let text = "# a comment\n\namplitude,east_m,north_m,down_m\r\n0.1,2.5,-3,1e1\r\n# between\n 7 , 0.30000000000000004 ,0,0\n";
        let points = parse(text.as_bytes()).unwrap();
        assert_eq!(points.north_m, [-3.0, 0.0]);
        assert_eq!(points.east_m, [2.5, 0.1 + 0.2]);
        assert_eq!(points.down_m, [10.0, 0.0]);
        assert_eq!(points.strength, [Complex64::from(0.1), 7.0.into()]);
        assert!(points.law.iter().all(|l| *l == ScatterLaw::Point));
        let complex = b"north_m,east_m,down_m,amplitude,amplitude_imag\n1,2,3,-4,5e-3\n";
        assert_eq!(
            parse(complex).unwrap().strength,
            [Complex64::new(-4.0, 0.005)]
        );
    }

    #[test]
    fn every_error_names_line_column_value_and_rule() {
        const HEAD: &str = "north_m,east_m,down_m,amplitude\n";
        let message = |text: &str| parse(text.as_bytes()).unwrap_err().to_string();
        for (text, want) in [
            (
                format!("{HEAD}1,2,3,4\n1,2,x,4\n"),
                "line 3, column `down_m`: `x`: must be a number",
            ),
            (
                format!("{HEAD}1,2,nan,4\n"),
                "line 2, column `down_m`: `nan`: must lie in -20000 ..= 20000",
            ),
            (
                format!("{HEAD}1,2,3,1e400\n"),
                "line 2, column `amplitude`: `1e400`: must lie in -1000000 ..= 1000000",
            ),
            (
                format!("{HEAD}1,2,3,\n"),
                "line 2, column `amplitude`: ``: must be a number",
            ),
            (
                format!("{HEAD}1,2,3\n"),
                "line 2: `1,2,3`: must have 4 fields as the header has, not 3",
            ),
            (
                "north_m,east_m,depth,amplitude\n".into(),
                "line 1: `depth`: is not a column of this table; the columns are north_m,east_m,down_m,amplitude,[amplitude_imag]",
            ),
            (
                "north_m,north_m\n".into(),
                "line 1: `north_m`: must be given once",
            ),
            (
                "north_m,east_m,amplitude\n".into(),
                "line 1: `down_m`: is missing; the header must name north_m,east_m,down_m,amplitude,[amplitude_imag]",
            ),
            (
                "# nothing\n".into(),
                "line 2: ``: must begin with a header: north_m,east_m,down_m,amplitude,[amplitude_imag]",
            ),
        ] {
            assert_eq!(message(&text), want);
        }
        assert_eq!(
            parse(b"north_m\n\xff").unwrap_err().to_string(),
            "line 2: ``: must be UTF-8 text"
        );
    }

    proptest::proptest! {
        #[test]
        fn any_bytes_yield_points_or_an_error(tail in proptest::collection::vec(proptest::num::u8::ANY, 0..200)) {
            let _ = parse(&tail);
            let mut bytes = b"north_m,east_m,down_m,amplitude\n1,2,3,4\n".to_vec();
            bytes.extend(&tail);
            let _ = parse(&bytes);
        }
    }
}

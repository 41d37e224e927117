//! Strong named targets laid over the seabed: a CSV table to [`Target`]s.
//!
//! Columns `name,north_m,east_m,height_above_seabed_m,target_strength_db`, metres from the scene's zero. As scatterers they are points with
//! pressure 10^(TS/20) and phase 0 (TS is the ratio of intensities at 1 m: Urick 1983, Principles of Underwater Sound, 9.1).

use glam::DVec3;
use num_complex::Complex64;

use super::text::{self, Column, MAX_HORIZONTAL_M, MAX_VERTICAL_M, Misread, required};
use crate::flow::Target;

/// Rows at most; every ping's truth record carries them all.
pub const MAX_TARGETS: usize = 10_000;

const MAX_NAME_CHARACTERS: usize = 64;
/// dB; a krill has -90, a submarine +30.
const MIN_TARGET_STRENGTH_DB: f64 = -150.0;
const MAX_TARGET_STRENGTH_DB: f64 = 100.0;

const COLUMNS: [Column; 5] = [
    required("name"),
    required("north_m"),
    required("east_m"),
    required("height_above_seabed_m"),
    required("target_strength_db"),
];

/// Targets in the scene's own coordinates. `seabed_down_m` gives the seabed at (north, east), none where there is none.
pub fn parse(
    bytes: &[u8],
    seabed_down_m: impl Fn(f64, f64) -> Option<f64>,
) -> Result<Vec<Target>, Misread> {
    let mut targets: Vec<Target> = Vec::new();
    text::read_table(bytes, &COLUMNS, |row| {
        if targets.len() == MAX_TARGETS {
            return Err(row.misread(0, format!("at most {MAX_TARGETS} targets are read")));
        }
        let name = row.text(0).unwrap_or("");
        if name.is_empty() || name.chars().count() > MAX_NAME_CHARACTERS {
            let rule = format!("must have 1 to {MAX_NAME_CHARACTERS} characters");
            return Err(row.misread(0, rule));
        }
        if name.chars().any(char::is_control) {
            return Err(row.misread(0, "must hold no control characters"));
        }
        if targets.iter().any(|t| t.name == name) {
            return Err(row.misread(0, "must be the name of one target only"));
        }
        let north_m = row.number(1, -MAX_HORIZONTAL_M..=MAX_HORIZONTAL_M, 0.0)?;
        let east_m = row.number(2, -MAX_HORIZONTAL_M..=MAX_HORIZONTAL_M, 0.0)?;
        let height_m = row.number(3, 0.0..=MAX_VERTICAL_M, 0.0)?;
        let Some(seabed_m) = seabed_down_m(north_m, east_m) else {
            let rule = format!(
                "needs a seabed below it; at north {north_m}, east {east_m} the scene has none"
            );
            return Err(row.misread(0, rule));
        };
        targets.push(Target {
            name: name.to_owned(),
            position_m: DVec3::new(north_m, east_m, seabed_m - height_m),
            target_strength_db: row.number(
                4,
                MIN_TARGET_STRENGTH_DB..=MAX_TARGET_STRENGTH_DB,
                0.0,
            )?,
        });
        Ok(())
    })?;
    Ok(targets)
}

/// Echo pressure at 1 m for unit incident pressure.
pub fn strength(target: &Target) -> Complex64 {
    Complex64::from(libm::pow(10.0, target.target_strength_db / 20.0))
}

#[cfg(test)]
mod tests {
    use super::*;

    const HEAD: &str = "name,north_m,east_m,height_above_seabed_m,target_strength_db\n";

    #[test]
    fn a_target_stands_at_its_height_over_the_seabed_with_the_pressure_of_its_strength() {
        let text = format!("{HEAD}wreck A,10,-20,1.5,6\nmine,0,0,0,-20\n");
        let targets = parse(text.as_bytes(), |n, e| Some(50.0 + 0.1 * n + 0.2 * e)).unwrap();
        assert_eq!(targets[0].name, "wreck A");
        assert_eq!(targets[0].position_m, DVec3::new(10.0, -20.0, 45.5));
        let got = strength(&targets[0]).re;
        assert!(
            (got - 1.995_262_314_968_88).abs() < 1e-12,
            "6 dB are a pressure of {got}"
        );
        assert_eq!(strength(&targets[1]), Complex64::from(0.1));
    }

    #[test]
    fn targets_without_a_seabed_or_with_a_name_twice_are_refused_by_name() {
        let said = |rows: &str, seabed: Option<f64>| {
            parse(format!("{HEAD}{rows}").as_bytes(), |_, _| seabed)
                .unwrap_err()
                .to_string()
        };
        assert_eq!(
            said("a,1,2,0,0\n", None),
            "line 2, column `name`: `a`: needs a seabed below it; at north 1, east 2 the scene has none"
        );
        assert_eq!(
            said("a,1,2,0,0\na,3,4,0,0\n", Some(1.0)),
            "line 3, column `name`: `a`: must be the name of one target only"
        );
        assert_eq!(
            said("a,1,2,-1,0\n", Some(1.0)),
            "line 2, column `height_above_seabed_m`: `-1`: must lie in 0 ..= 20000"
        );
        assert_eq!(
            said(",1,2,0,0\n", Some(1.0)),
            "line 2, column `name`: ``: must have 1 to 64 characters"
        );
    }

    proptest::proptest! {
        #[test]
        fn any_bytes_give_targets_or_a_misread(tail in ".{0,80}") {
            let _ = parse(tail.as_bytes(), |_, _| Some(1.0));
            let _ = parse(format!("{HEAD}a,1,2,0,0\n{tail}").as_bytes(), |_, _| Some(1.0));
        }
    }
}

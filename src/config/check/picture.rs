//! `[sonar.picture]`.

use super::super::raw::{Problems, RawTable};
use super::super::spec::*;

pub(super) fn picture(table: &RawTable, problems: &mut Problems) -> Option<PictureSpec> {
    let fixed = table.text("contrast").map(|c| c == "fixed");
    for (low, high) in [("low_db", "high_db"), ("low_percent", "high_percent")] {
        let (least, most) = (table.number(low)?, table.number(high)?);
        if least >= most {
            let entry = table.entry(match table.given(high) {
                true => high,
                false => low,
            });
            problems.refuse(
                entry,
                format!("{low} ({least}) must be below {high} ({most})"),
            );
        }
    }
    Some(PictureSpec {
        range: match table.text("range")? {
            "ground" => PictureRange::Ground,
            "ground-first-return" => PictureRange::GroundFirstReturn,
            _ => PictureRange::Slant,
        },
        raw: table.text("gain")? == "raw",
        colours: match table.text("colours")? {
            "grey" => ColourMap::Grey,
            "blue" => ColourMap::Blue,
            "rainbow" => ColourMap::Rainbow,
            _ => ColourMap::Copper,
        },
        contrast: match fixed? {
            true => Contrast::Fixed {
                low_db: table.number("low_db")?,
                high_db: table.number("high_db")?,
            },
            false => Contrast::Percentiles {
                low: table.scaled("low_percent", -2)?,
                high: table.scaled("high_percent", -2)?,
            },
        },
        flatten: table.bool("flatten")?,
        metres_per_pixel: match table.given("m_per_pixel") {
            true => Some(table.number("m_per_pixel")?),
            false => None,
        },
        fan_every_pings: u32::try_from(table.integer("fan_every_pings")?).ok()?,
        mosaic: MosaicLook {
            metres_per_pixel: table.number("mosaic_m_per_pixel")?,
            overlap: match table.text("overlap")? {
                "mean" => Overlap::Mean,
                "last" => Overlap::Last,
                _ => Overlap::Nearest,
            },
            nadir_rad: table.angle_rad("nadir_deg")?,
        },
    })
}

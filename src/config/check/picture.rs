//! `[sonar.picture]`.

use super::super::spec::*;
use crate::keys;
use crate::raw::Problems;

pub(super) fn picture(table: &keys::Picture, problems: &mut Problems) -> Option<PictureSpec> {
    let fixed = table.contrast.is("fixed");
    let (low_db, high_db) = (table.low_db.get()?, table.high_db.get()?);
    let (low, high) = (table.low_percent.get()?, table.high_percent.get()?);
    if low_db >= high_db {
        let rule = format!("low_db ({low_db}) must be below high_db ({high_db})");
        let entry = if table.high_db.given {
            &table.high_db
        } else {
            &table.low_db
        };
        problems.refuse(entry, rule);
    }
    if low >= high {
        let percent = |share: f64| (share * 1e8).round() / 1e6;
        let rule = format!(
            "low_percent ({}) must be below high_percent ({})",
            percent(low),
            percent(high)
        );
        let entry = if table.high_percent.given {
            &table.high_percent
        } else {
            &table.low_percent
        };
        problems.refuse(entry, rule);
    }
    Some(PictureSpec {
        range: match table.range.text()? {
            "ground" => PictureRange::Ground,
            "ground-first-return" => PictureRange::GroundFirstReturn,
            _ => PictureRange::Slant,
        },
        raw: table.gain.text()? == "raw",
        colours: match table.colours.text()? {
            "grey" => ColourMap::Grey,
            "blue" => ColourMap::Blue,
            "rainbow" => ColourMap::Rainbow,
            _ => ColourMap::Copper,
        },
        contrast: match fixed? {
            true => Contrast::Fixed {
                low_db: table.low_db.get()?,
                high_db: table.high_db.get()?,
            },
            false => Contrast::Percentiles {
                low: table.low_percent.get()?,
                high: table.high_percent.get()?,
            },
        },
        flatten: table.flatten.get()?,
        metres_per_pixel: table.m_per_pixel.if_given()?,
        fan_every_pings: table.fan_every_pings.to()?,
        mosaic: MosaicLook {
            metres_per_pixel: table.mosaic_m_per_pixel.get()?,
            overlap: match table.overlap.text()? {
                "mean" => Overlap::Mean,
                "last" => Overlap::Last,
                _ => Overlap::Nearest,
            },
            nadir_rad: table.nadir_deg.get()?,
        },
    })
}

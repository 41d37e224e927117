//! Checks `[sonar.picture]`.

use super::super::spec::*;
use crate::keys;
use crate::raw::{Field, Problems};

pub(super) fn picture(table: &keys::Picture, problems: &mut Problems) -> Option<PictureSpec> {
    let fixed = table.contrast.is("fixed");
    let percent = |share: f64| (share * 1e8).round() / 1e6;
    let mut in_order = |low_key: &Field<f64>, high_key: &Field<f64>, shown: fn(f64) -> f64| {
        let (low, high) = (low_key.get()?, high_key.get()?);
        if low >= high {
            let (low_name, high_name) = (low_key.key(), high_key.key());
            let (shown_low, shown_high) = (shown(low), shown(high));
            let rule = format!("{low_name} ({shown_low}) must be below {high_name} ({shown_high})");
            problems.refuse(if high_key.given { high_key } else { low_key }, rule);
        }
        Some((low, high))
    };
    let (low_db, high_db) = in_order(&table.low_db, &table.high_db, |db| db)?;
    let (low, high) = in_order(&table.low_percent, &table.high_percent, percent)?;
    Some(PictureSpec {
        range: table.range.named()?,
        raw: table.gain.text()? == "raw",
        colours: table.colours.named()?,
        contrast: match fixed? {
            true => Contrast::Fixed { low_db, high_db },
            false => Contrast::Percentiles { low, high },
        },
        flatten: table.flatten.get()?,
        metres_per_pixel: table.m_per_pixel.if_given()?,
        fan_every_pings: table.fan_every_pings.to()?,
        mosaic: MosaicLook {
            metres_per_pixel: table.mosaic_m_per_pixel.get()?,
            overlap: table.overlap.named()?,
            nadir_rad: table.nadir_deg.get()?,
        },
    })
}

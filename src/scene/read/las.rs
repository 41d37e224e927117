//! LAS point clouds (ASPRS LAS 1.0 to 1.4, uncompressed). Points classified as noise (7 and 18) are dropped. Heights are elevations.

use std::io::Cursor;

use glam::DVec3;
use las::{PointDataBuilder, Reader as LasReader};

use super::format_error::{At, refuse};
use super::{Crs, Facts, FormatError, MAX_POINTS, Raw, RawPoints, RawShape, Reader};
use echotank_config::spec::{HeightSign, SeabedFileSpec, SeabedFormat};

/// Number of points decoded at a time.
const BATCH: u64 = 1 << 16;
/// ASPRS LAS 1.4 R15, table 17: low and high noise.
const NOISE: [u8; 2] = [7, 18];

pub(super) const READER: Reader = Reader {
    format: SeabedFormat::Las,
    name: "LAS points",
    recognises: |head, _| head.starts_with(b"LASF"),
    read,
};

fn read(bytes: Vec<u8>, spec: &SeabedFileSpec) -> Result<Raw, FormatError> {
    let length = bytes.len() as u64;
    let mut reader = LasReader::new(Cursor::new(bytes)).at("LAS header")?;
    let header = reader.header();
    let total = header.number_of_points();
    let record = u64::from(header.point_format().len());
    if total > MAX_POINTS as u64 {
        let rule = format!("at most {MAX_POINTS} points are read: thin or grid them first");
        return refuse("LAS header", total, rule);
    }
    if record == 0 || total.saturating_mul(record) > length {
        let rule = format!("points were announced, more than the file's {length} bytes can hold");
        return refuse("LAS header", total, rule);
    }
    let mut facts = Facts {
        crs: system(&reader, spec)?,
        values: Some((HeightSign::Elevation, "z is up in LAS")),
        ..Facts::default()
    };
    let mut points = Vec::with_capacity(total as usize);
    let mut batch = PointDataBuilder::new().for_header(reader.header()).build();
    let (mut noise, mut read) = (0_u64, 0_u64);
    while read < total {
        let place = || format!("points from {read}");
        let count = reader
            .fill_points(BATCH.min(total - read), &mut batch)
            .at(place())?;
        if count == 0 {
            let rule = format!("the file ends; {total} points were announced");
            return refuse(place(), "", rule);
        }
        let classes = batch.classification();
        for (((x, y), z), class) in batch.x().zip(batch.y()).zip(batch.z()).zip(classes) {
            if NOISE.contains(&class) {
                noise += 1;
            } else {
                points.push(DVec3::new(x, y, z));
            }
        }
        read += count;
    }
    if noise > 0 {
        facts
            .notes
            .push(format!("{noise} points classed as noise were left out"));
    }
    Ok(Raw {
        shape: RawShape::Points(RawPoints {
            points,
            triangles: None,
        }),
        facts,
    })
}

fn system(reader: &LasReader, spec: &SeabedFileSpec) -> Result<Option<Crs>, FormatError> {
    if spec.crs.is_some() {
        return Ok(None);
    }
    let header = reader.header();
    if let Some(wkt) = header.get_wkt_crs_bytes() {
        return Crs::from_wkt(&String::from_utf8_lossy(wkt), "LASF_Projection 2112").map(Some);
    }
    let Ok(Some(keys)) = header.get_geotiff_crs() else {
        return Ok(None);
    };
    let place = "LASF_Projection 34735";
    match (
        keys.get_projected_crs_geo_key_value(),
        keys.get_geodetic_crs_geo_key_value(),
    ) {
        (Some(code), _) if code != 0 => Crs::from_epsg(code.into(), place).map(Some),
        (_, Some(code)) if code != 0 => Crs::from_epsg(code.into(), place).map(Some),
        _ => Ok(None),
    }
}

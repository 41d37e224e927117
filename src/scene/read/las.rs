//! LAS point clouds (ASPRS LAS 1.0 to 1.4, uncompressed). Points classified as noise (7 and 18) are dropped. Heights are elevations.

use std::io::Cursor;

use glam::DVec3;
use las::crs::GeoTiffData;
use las::{PointDataBuilder, Reader as LasReader};

use super::format_error::{At, refuse};
use super::units::{self, Units};
use super::{Crs, Facts, FormatError, MAX_POINTS, Raw, RawPoints, RawShape, Reader, crs};
use echotank_config::spec::{HeightSign, SeabedFileSpec, SeabedFormat};

/// Number of points decoded at a time.
const BATCH: u64 = 1 << 16;
/// ASPRS LAS 1.4 R15, table 17: low and high noise.
const NOISE: [u8; 2] = [7, 18];

/// Offset of the point format in the header; LAZ sets its highest bit.
const POINT_FORMAT_AT: usize = 104;

/// GeoKeys (OGC 19-008r4, annex B).
const LINEAR_UNIT: u16 = 3076;
const VERTICAL_UNIT: u16 = 4099;

pub(super) const READER: Reader = Reader {
    format: SeabedFormat::Las,
    name: "LAS points",
    recognises: |head, _| head.starts_with(b"LASF"),
    read,
};

fn read(bytes: Vec<u8>, spec: &SeabedFileSpec) -> Result<Raw, FormatError> {
    let length = bytes.len() as u64;
    if bytes
        .get(POINT_FORMAT_AT)
        .is_some_and(|format| format & 0x80 != 0)
    {
        let rule = "not supported: LAZ, compressed LAS; decompress it to LAS";
        return refuse("LAS header", "", rule);
    }
    let mut reader = LasReader::new(Cursor::new(bytes)).at("LAS header")?;
    let header = reader.header();
    let total = header.number_of_points();
    let record = u64::from(header.point_format().len());
    if total > MAX_POINTS as u64 {
        let rule = format!("at most {MAX_POINTS} points are read: thin or grid them first");
        return refuse("LAS header", total, rule);
    }
    if record == 0 || total.saturating_mul(record) > length {
        let rule = format!("points are declared, more than the file's {length} bytes can hold");
        return refuse("LAS header", total, rule);
    }
    let (crs, units) = system(&reader)?;
    let mut facts = Facts {
        crs: crs.filter(|_| spec.crs.is_none()),
        units,
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
            let rule = format!("the file ends; the header declares {total} points");
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

fn system(reader: &LasReader) -> Result<(Option<Crs>, Units), FormatError> {
    let header = reader.header();
    if let Some(wkt) = header.get_wkt_crs_bytes() {
        let (crs, units) = Crs::from_wkt(&String::from_utf8_lossy(wkt), "LASF_Projection 2112")?;
        return Ok((Some(crs), units));
    }
    let Ok(Some(keys)) = header.get_geotiff_crs() else {
        return Ok((None, Units::default()));
    };
    let place = "LASF_Projection 34735";
    let short = |wanted: u16| {
        let entry = keys.entries.iter().find(|e| e.id == wanted)?;
        match entry.data {
            GeoTiffData::U16(value) => Some(value),
            _ => None,
        }
    };
    let unit = |key: u16| match short(key) {
        None | Some(0) => Ok(None),
        Some(code) => match units::of_epsg(code.into()) {
            Some(unit_m) => Ok(Some(unit_m)),
            None => refuse(
                place,
                code,
                "is not a supported unit of length (GeoKeys 3076 and 4099)",
            ),
        },
    };
    let projected = keys
        .get_projected_crs_geo_key_value()
        .filter(|code| *code != 0);
    let geodetic = keys
        .get_geodetic_crs_geo_key_value()
        .filter(|code| *code != 0);
    let code = projected.or(geodetic).map(u32::from);
    let units = Units {
        horizontal_m: unit(LINEAR_UNIT)?.or_else(|| crs::unit_of_epsg_system(projected?.into())),
        vertical_m: unit(VERTICAL_UNIT)?,
    };
    let crs = code.map(|code| Crs::from_epsg(code, place)).transpose()?;
    Ok((crs, units))
}

//! PLY files (Turk 1994), text or binary of either byte order: vertices as points, and faces, if any, as a mesh.

use glam::DVec3;
use ply_rs_bw::parser::{Parser, Reader as PlyReader};
use ply_rs_bw::ply::{Property, PropertyAccess, PropertyAccessResult};

use super::format_error::{At, refuse};
use super::{Facts, FormatError, MAX_POINTS, Raw, RawPoints, RawShape, Reader};
use echotank_config::spec::{HeightSign, SeabedFileSpec, SeabedFormat};

pub(super) const READER: Reader = Reader {
    format: SeabedFormat::Ply,
    name: "PLY",
    recognises: |head, _| head.starts_with(b"ply\n") || head.starts_with(b"ply\r"),
    read,
};

fn read(bytes: Vec<u8>, _asked: &SeabedFileSpec) -> Result<Raw, FormatError> {
    let (points, triangles) = parse(&bytes)?;
    Ok(Raw {
        shape: RawShape::Points(RawPoints {
            points,
            triangles: (!triangles.is_empty()).then_some(triangles),
        }),
        facts: Facts {
            values: Some((HeightSign::Elevation, "z is up in PLY by convention")),
            ..Facts::default()
        },
    })
}

/// Vertices in the axes of the file, and its polygons as triangle fans.
pub(super) fn parse(bytes: &[u8]) -> Result<(Vec<DVec3>, Vec<[u32; 3]>), FormatError> {
    let mut reader = PlyReader::new(bytes);
    let header = Parser::<Skipped>::new()
        .read_header(&mut reader)
        .at("PLY header")?;
    for (name, element) in &header.elements {
        if element.count > MAX_POINTS * 4 {
            let rule = format!("at most {} {name} elements are read", MAX_POINTS * 4);
            return refuse("PLY header", element.count, rule);
        }
        // Every element with properties takes at least one byte.
        if element.count > bytes.len() || element.properties.is_empty() {
            let rule = format!("{name} elements are declared, more than the file can hold");
            return refuse("PLY header", element.count, rule);
        }
    }
    let (mut points, mut triangles) = (Vec::new(), Vec::new());
    for (name, element) in &header.elements {
        let place = || format!("PLY element {name}");
        match name.as_str() {
            "vertex" => {
                if element.count > MAX_POINTS {
                    let rule = format!("at most {MAX_POINTS} vertices are read");
                    return refuse("PLY header", element.count, rule);
                }
                for axis in ["x", "y", "z"] {
                    if !element.properties.contains_key(axis) {
                        return refuse("PLY header", axis, "is missing in element vertex");
                    }
                }
                let vertices = Parser::<Vertex>::new()
                    .read_payload_for_element(&mut reader, element, &header)
                    .at(place())?;
                points = vertices.into_iter().map(|v| v.0).collect();
            }
            "face" => {
                let faces = Parser::<Face>::new()
                    .read_payload_for_element(&mut reader, element, &header)
                    .at(place())?;
                for face in &faces {
                    for pair in face.0.get(1..).unwrap_or(&[]).windows(2) {
                        triangles.push([face.0[0], pair[0], pair[1]]);
                    }
                }
            }
            _ => {
                Parser::<Skipped>::new()
                    .read_payload_for_element(&mut reader, element, &header)
                    .at(place())?;
            }
        }
    }
    Ok((points, triangles))
}

/// Element that is read and discarded.
struct Skipped;

impl PropertyAccess for Skipped {
    fn new() -> Self {
        Self
    }
}

struct Vertex(DVec3);

impl PropertyAccess for Vertex {
    fn new() -> Self {
        Self(DVec3::NAN)
    }
    fn set_property(&mut self, name: &str, property: Property) -> PropertyAccessResult {
        let place = match name {
            "x" => &mut self.0.x,
            "y" => &mut self.0.y,
            "z" => &mut self.0.z,
            _ => return PropertyAccessResult::Ignored,
        };
        *place = match property {
            Property::Float(v) => v.into(),
            Property::Double(v) => v,
            Property::Char(v) => v.into(),
            Property::UChar(v) => v.into(),
            Property::Short(v) => v.into(),
            Property::UShort(v) => v.into(),
            Property::Int(v) => v.into(),
            Property::UInt(v) => v.into(),
            _ => return PropertyAccessResult::UnsupportedType,
        };
        PropertyAccessResult::Set
    }
}

struct Face(Vec<u32>);

impl PropertyAccess for Face {
    fn new() -> Self {
        Self(Vec::new())
    }
    fn set_property(&mut self, name: &str, property: Property) -> PropertyAccessResult {
        if !matches!(name, "vertex_indices" | "vertex_index") {
            return PropertyAccessResult::Ignored;
        }
        // A negative index becomes u32::MAX, which is later rejected as out of range.
        fn all<T: Copy>(from: &[T], index: impl Fn(T) -> Option<u32>) -> Vec<u32> {
            from.iter().map(|v| index(*v).unwrap_or(u32::MAX)).collect()
        }
        self.0 = match &property {
            Property::ListInt(v) => all(v, |i| i.try_into().ok()),
            Property::ListUInt(v) => v.clone(),
            Property::ListShort(v) => all(v, |i| i.try_into().ok()),
            Property::ListUShort(v) => all(v, |i| Some(i.into())),
            Property::ListChar(v) => all(v, |i| i.try_into().ok()),
            Property::ListUChar(v) => all(v, |i| Some(i.into())),
            _ => return PropertyAccessResult::UnsupportedType,
        };
        PropertyAccessResult::Set
    }
}

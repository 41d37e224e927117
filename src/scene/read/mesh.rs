//! Meshes of targets: OBJ, STL and PLY to [`TriangleMesh`].
//!
//! None of the formats states its axes or its unit. Numbers are taken as metres; the caller states the axes.

use std::path::Path;

use glam::DVec3;

use super::format_error::{At, refuse};
use super::text::{self, MAX_HORIZONTAL_M};
use super::{Files, FormatError, MAX_POINTS, TriangleMesh, ply};
use crate::SceneError;

/// Greatest number of triangles: in a target they take some 700 MiB.
pub(crate) const MAX_TRIANGLES: usize = 1 << 22;
/// Bytes before the triangles of a binary STL file, and of each triangle.
const STL_HEAD: usize = 84;
const STL_TRIANGLE: usize = 50;

/// Directions of a file's x, y and z axes. All three are right-handed, so triangles keep their outside.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum MeshAxes {
    /// Axes x east, y north, z up: survey and most printing software.
    EastNorthUp,
    /// Axes x north, y east, z down: those of the scene.
    NorthEastDown,
    /// Axes x east, y up, z south: most animation software.
    EastUpSouth,
}

impl MeshAxes {
    fn north_east_down(self, v: DVec3) -> DVec3 {
        match self {
            Self::EastNorthUp => DVec3::new(v.y, v.x, -v.z),
            Self::NorthEastDown => v,
            Self::EastUpSouth => DVec3::new(-v.z, v.x, -v.y),
        }
    }
}

/// Reads a mesh from a file; the extension of the path selects the format.
///
/// # Errors
/// Returns the path and the rule that the file breaks.
pub fn open(files: &dyn Files, path: &Path, axes: MeshAxes) -> Result<TriangleMesh, SceneError> {
    let extension = path.extension().and_then(|e| e.to_str()).unwrap_or("");
    parse(text::read_file(files, path)?, extension, axes).map_err(|error| SceneError::Format {
        path: path.to_owned(),
        error,
    })
}

/// Reads a mesh from bytes; `extension` is obj, stl or ply, in any case.
///
/// # Errors
/// Returns the location and the rule that the file breaks.
pub fn parse(bytes: Vec<u8>, extension: &str, axes: MeshAxes) -> Result<TriangleMesh, FormatError> {
    let (mut vertices_m, triangles) = match extension.to_ascii_lowercase().as_str() {
        "obj" => obj(&bytes)?,
        "stl" => stl(&bytes)?,
        "ply" => ply::parse(&bytes)?,
        other => {
            return refuse("file name", other, "must end in .obj, .stl or .ply");
        }
    };
    for (k, v) in vertices_m.iter_mut().enumerate() {
        if !v.is_finite() || v.abs().max_element() > MAX_HORIZONTAL_M {
            let rule = format!("must be finite, and no more than {MAX_HORIZONTAL_M} m from zero");
            return refuse(format!("vertex {k}"), v, rule);
        }
        *v = axes.north_east_down(*v);
    }
    check_triangles(&triangles, vertices_m.len())?;
    if triangles.is_empty() {
        return refuse("mesh", "", "has no triangles");
    }
    Ok(TriangleMesh {
        vertices_m,
        triangles,
    })
}

/// Checks that every index names a vertex.
pub(super) fn check_triangles(triangles: &[[u32; 3]], vertices: usize) -> Result<(), FormatError> {
    if triangles.len() > MAX_TRIANGLES {
        let rule = format!("at most {MAX_TRIANGLES} triangles are read");
        return refuse("mesh", triangles.len(), rule);
    }
    for (k, triangle) in triangles.iter().enumerate() {
        if triangle.iter().any(|i| *i as usize >= vertices) {
            let rule = format!("refers to a missing vertex: the mesh has {vertices}");
            return refuse(format!("triangle {k}"), format!("{triangle:?}"), rule);
        }
    }
    Ok(())
}

type Parts = (Vec<DVec3>, Vec<[u32; 3]>);

fn obj(bytes: &[u8]) -> Result<Parts, FormatError> {
    let options = tobj::LoadOptions {
        triangulate: true,
        ignore_points: true,
        ignore_lines: true,
        ..tobj::LoadOptions::default()
    };
    let no_materials = |_: &Path| Ok((Vec::new(), Default::default()));
    let (models, _) = tobj::load_obj_buf(&mut &bytes[..], &options, no_materials).at("OBJ")?;
    let (mut vertices, mut triangles) = (Vec::new(), Vec::new());
    for model in models {
        // Each object has its own vertices. Their number is below the number of bytes and so fits in u32.
        let first = vertices.len() as u32;
        vertices.extend(
            model
                .mesh
                .positions
                .chunks_exact(3)
                .map(|v| DVec3::new(v[0].into(), v[1].into(), v[2].into())),
        );
        triangles.extend(
            model
                .mesh
                .indices
                .chunks_exact(3)
                .map(|t| [t[0], t[1], t[2]].map(|i| i.saturating_add(first))),
        );
    }
    Ok((vertices, triangles))
}

fn stl(bytes: &[u8]) -> Result<Parts, FormatError> {
    // Binary files may begin with "solid" as text files do. A triangle count that fits the length identifies them.
    let announced = bytes
        .get(STL_HEAD - 4..STL_HEAD)
        .and_then(|b| b.try_into().ok())
        .map(|b| u32::from_le_bytes(b) as usize);
    let is_text = bytes.starts_with(b"solid")
        && announced.is_none_or(|n| STL_HEAD + n * STL_TRIANGLE != bytes.len());
    if let Some(count) = announced.filter(|_| !is_text)
        && bytes.len() < STL_HEAD + count * STL_TRIANGLE
    {
        let rule = format!(
            "triangles are declared, more than the file's {} bytes can hold",
            bytes.len()
        );
        return refuse("STL header", count, rule);
    }
    let mesh = stl_io::read_stl(&mut std::io::Cursor::new(bytes)).at("STL")?;
    if mesh.vertices.len() > 3 * MAX_POINTS {
        let rule = format!("at most {} vertices are read", 3 * MAX_POINTS);
        return refuse("STL", mesh.vertices.len(), rule);
    }
    let vertices = mesh
        .vertices
        .iter()
        .map(|v| DVec3::new(v[0].into(), v[1].into(), v[2].into()))
        .collect();
    let triangles = mesh
        .faces
        .iter()
        .map(|f| f.vertices.map(|i| i as u32))
        .collect();
    Ok((vertices, triangles))
}

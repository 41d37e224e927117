//! TOML table of targets: shapes with a size, a position and a strength.
//!
//! ```toml
//! [[target]] name = "pier A" shape = "cylinder"           # point, sphere, cylinder, box, rope, mesh north_m = 0.0 east_m = 20.0
//! height_above_seabed_m = 0.0  # of its lowest point above the seabed; or: down_m = 7.5, the depth of its centre radius_m = 1.25 length_m = 12.0
//! lambert_db = -12.0           # of the surface; or: target_strength_db, the mean over all directions
//! ```
//! Further fields: docs/configure/scene.md. A sphere without a strength has that of a rigid sphere, 20 log10(a/2) (Urick 1983, 9.2, ka >> 1).

use std::f64::consts::PI;
use std::ops::RangeInclusive;

use glam::{DMat3, DVec2, DVec3};
use toml::Spanned;
use toml::de::{DeTable, DeValue};

use super::mesh::Mesh;
use super::solid::Solid;
use super::swarm::SwarmShape;
use super::track::{self, MAX_SPEED_M_PER_S};
use super::{
    Body, MAX_TARGETS, MeshFolder, ParsedCourse, ParsedTarget, STRENGTHS_DB, check_name,
    lambert_of_mean, mean_strength_db,
};
use crate::read::mesh::{self, MeshAxes};
use crate::text::{self, MAX_HORIZONTAL_M, MAX_VERTICAL_M, TextError};
use echotank_core::frames::VectorKnot;
use echotank_core::scene::Target;

/// Accepted radii and sides, metres: from a fishing line to an island.
const SIZES_M: RangeInclusive<f64> = 1e-4..=1e4;
const DENSITIES_PER_M2: RangeInclusive<f64> = 1e-3..=1e8;
const DEFAULT_DENSITY_PER_M2: f64 = 100.0;
/// Accepted values of Lambert's mu, dB.
const LAMBERTS_DB: RangeInclusive<f64> = -100.0..=20.0;
const MAX_ROPE_VERTICES: usize = 10_000;

const COMMON: &[&str] = &[
    "name",
    "shape",
    "north_m",
    "east_m",
    "height_above_seabed_m",
];
const SOLID: &[&str] = &[
    "down_m",
    "target_strength_db",
    "lambert_db",
    "density_per_m2",
];
/// Fields of a target that moves as a whole.
const MOTION: &[&str] = &["velocity_m_per_s", "track"];
/// Shapes and their own fields.
const SHAPES: &[(&str, &[&str])] = &[
    ("point", &[]),
    ("sphere", &["radius_m"]),
    (
        "cylinder",
        &["radius_m", "length_m", "heading_deg", "elevation_deg"],
    ),
    ("box", &["size_m", "heading_deg"]),
    ("rope", &["radius_m", "path_m"]),
    ("mesh", &["file", "axes", "scale", "heading_deg"]),
    (
        "school",
        &[
            "size_m",
            "heading_deg",
            "individuals",
            "individuals_per_m3",
            "swim_m_per_s",
        ],
    ),
    (
        "plume",
        &[
            "radius_m",
            "spread",
            "top_m",
            "bubbles_per_m",
            "rise_m_per_s",
            "drift_m_per_s",
        ],
    ),
];
/// Accepted speeds of fish and bubbles, metres per second.
const SWIM_M_PER_S: RangeInclusive<f64> = 0.0..=20.0;
const RISE_M_PER_S: RangeInclusive<f64> = 0.01..=10.0;
const DEFAULT_RISE_M_PER_S: f64 = 0.25;
/// Most individuals of a school or plume.
const MAX_INDIVIDUALS: f64 = 1e6;
/// Names of the mesh axes; the first is the default.
const AXES: [(&str, MeshAxes); 3] = [
    ("east-north-up", MeshAxes::EastNorthUp),
    ("north-east-down", MeshAxes::NorthEastDown),
    ("east-up-south", MeshAxes::EastUpSouth),
];
/// Accepted mesh scales, metres per unit: from micrometres to kilometres.
const SCALES: RangeInclusive<f64> = 1e-6..=1e3;

/// Depth of the seabed at (north, east), metres; none where there is no seabed.
pub(super) type SeabedDown<'a> = &'a dyn Fn(f64, f64) -> Option<f64>;

/// Reads the targets of a TOML table. Names of mesh files are relative to `folder`.
pub(super) fn parse(
    bytes: &[u8],
    folder: MeshFolder,
    seabed: SeabedDown,
) -> Result<Vec<ParsedTarget>, TextError> {
    let text = text::utf8(bytes)?;
    let root = DeTable::parse(text).map_err(|e| {
        let at = e.span().map_or(0, |span| span.start);
        TextError::new(line_of(text, at), "", e.message())
    })?;
    let mut placed: Vec<ParsedTarget> = Vec::new();
    for (key, value) in root.get_ref() {
        let line = line_of(text, key.span().start);
        let entries = value.get_ref().as_array();
        let (true, Some(entries)) = (key.get_ref().as_ref() == "target", entries) else {
            let rule = "must be [[target]]; a table of targets has no other key";
            return Err(TextError::new(line, key.get_ref(), rule));
        };
        for entry in entries {
            let line = line_of(text, entry.span().start);
            let Some(table) = entry.get_ref().as_table() else {
                return Err(TextError::new(line, "target", "must be a table"));
            };
            let fields = Fields { text, table, line };
            let one = target(&fields, folder, seabed)?;
            if placed.len() == MAX_TARGETS {
                let rule = format!("at most {MAX_TARGETS} targets are read");
                return Err(fields.text_error("name", rule));
            }
            if placed.iter().any(|p| p.target.name == one.target.name) {
                return Err(fields.text_error("name", "must be unique among the targets"));
            }
            placed.push(one);
        }
    }
    Ok(placed)
}

fn target(
    fields: &Fields,
    folder: MeshFolder,
    seabed: SeabedDown,
) -> Result<ParsedTarget, TextError> {
    let name = fields.needed_text("name")?;
    check_name(name).map_err(|rule| fields.text_error("name", rule))?;
    let shape = fields.text("shape")?.unwrap_or("point");
    let Some((_, own)) = SHAPES.iter().find(|(known, _)| *known == shape) else {
        let names: Vec<&str> = SHAPES.iter().map(|(known, _)| *known).collect();
        return Err(fields.text_error("shape", format!("must be one of {}", names.join(", "))));
    };
    fields.refuse_others(shape, own)?;
    let course = course(fields, folder)?;
    match shape {
        "point" => return point(fields, name, course, seabed),
        "school" => return school(fields, name, course, seabed),
        "plume" => return plume(fields, name, seabed),
        _ => {}
    }
    let solid = match shape {
        "sphere" => Solid::Sphere {
            center_m: DVec3::ZERO,
            radius_m: fields.needed("radius_m", SIZES_M)?,
        },
        "cylinder" => cylinder(fields)?,
        "box" => {
            let [x, y, z] = fields.needed_triple("size_m", SIZES_M)?;
            Solid::Box {
                center_m: DVec3::ZERO,
                axes: DMat3::from_rotation_z(fields.heading_rad()?),
                half_m: DVec3::new(x, y, z) / 2.0,
            }
        }
        "mesh" => mesh_of_file(fields, folder)?,
        _ => rope(fields, seabed)?,
    };
    let (solid, position_m) = match shape {
        "rope" => {
            let (low, high) = solid.bounds_m();
            (solid, (low + high) / 2.0)
        }
        _ => {
            let position_m = place(fields, seabed, solid.bounds_m().1.z, course.as_ref())?;
            (solid.moved(position_m), position_m)
        }
    };
    let area_m2 = solid.area_m2();
    let lambert = match (
        fields.number("lambert_db", LAMBERTS_DB)?,
        fields.number("target_strength_db", STRENGTHS_DB)?,
        &solid,
    ) {
        (Some(_), Some(_), _) => {
            let rule = "must not be given with lambert_db: one determines the other";
            return Err(fields.text_error("target_strength_db", rule));
        }
        (Some(db), None, _) => libm::pow(10.0, db / 10.0),
        (None, Some(db), _) => lambert_of_mean(db, area_m2),
        (None, None, Solid::Sphere { radius_m, .. }) => {
            // A rigid sphere: pi a^2 / 4 pi = a^2/4.
            lambert_of_mean(
                20.0 * libm::log10(radius_m / 2.0),
                4.0 * PI * radius_m * radius_m,
            )
        }
        (None, None, _) => {
            let rule = format!("a {shape} needs lambert_db or target_strength_db");
            return Err(fields.text_error("shape", rule));
        }
    };
    let density = fields.number("density_per_m2", DENSITIES_PER_M2)?;
    Ok(ParsedTarget {
        target: Target {
            name: name.to_owned(),
            position_m,
            target_strength_db: mean_strength_db(lambert, area_m2),
            course: None,
        },
        body: Body::Solid {
            solid,
            lambert,
            density_per_m2: density.unwrap_or(DEFAULT_DENSITY_PER_M2),
        },
        course: course.map(|course| course.from(position_m)),
        line: fields.line,
    })
}

fn point(
    fields: &Fields,
    name: &str,
    course: Option<FileCourse>,
    seabed: SeabedDown,
) -> Result<ParsedTarget, TextError> {
    fields.refuse_surface("point")?;
    let position_m = place(fields, seabed, 0.0, course.as_ref())?;
    Ok(ParsedTarget {
        target: Target {
            name: name.to_owned(),
            position_m,
            target_strength_db: fields.needed("target_strength_db", STRENGTHS_DB)?,
            course: None,
        },
        body: Body::Point,
        course: course.map(|course| course.from(position_m)),
        line: fields.line,
    })
}

fn school(
    fields: &Fields,
    name: &str,
    course: Option<FileCourse>,
    seabed: SeabedDown,
) -> Result<ParsedTarget, TextError> {
    fields.refuse_surface("school")?;
    let size_m = DVec3::from_array(fields.needed_triple("size_m", SIZES_M)?);
    let half_m = size_m / 2.0;
    let volume_m3 = 4.0 / 3.0 * PI * half_m.x * half_m.y * half_m.z;
    let given = fields.number("individuals", 1.0..=MAX_INDIVIDUALS)?;
    let count = match (given, fields.number("individuals_per_m3", 1e-9..=1e9)?) {
        (Some(count), None) => count.round(),
        (None, Some(per_m3)) => (per_m3 * volume_m3).round().max(1.0),
        _ => {
            let rule = "a school needs either individuals or individuals_per_m3";
            return Err(fields.text_error("shape", rule));
        }
    };
    if count > MAX_INDIVIDUALS {
        let rule =
            format!("gives {count:.0} individuals; at most {MAX_INDIVIDUALS:.0} are allowed");
        return Err(fields.text_error("individuals_per_m3", rule));
    }
    let swim = fields.number("swim_m_per_s", SWIM_M_PER_S)?;
    let position_m = place(fields, seabed, half_m.z, course.as_ref())?;
    let each_db = fields.needed("target_strength_db", STRENGTHS_DB)?;
    let shape = SwarmShape::School {
        half_m,
        world_from_school: DMat3::from_rotation_z(fields.heading_rad()?),
        swim_m_per_s: swim.unwrap_or(0.0),
    };
    let swarm = (shape, count, each_db);
    Ok(swarm_target(fields, name, position_m, swarm, course))
}

fn plume(fields: &Fields, name: &str, seabed: SeabedDown) -> Result<ParsedTarget, TextError> {
    fields.refuse_surface("plume")?;
    let foot_m = place(fields, seabed, 0.0, None)?;
    let top_m = fields.number("top_m", -MAX_VERTICAL_M..=MAX_VERTICAL_M)?;
    let height_m = foot_m.z - top_m.unwrap_or(0.0);
    if height_m < 1e-3 {
        let rule = format!("must lie above the foot of the plume, at {} m", foot_m.z);
        return Err(fields.text_error("top_m", rule));
    }
    let per_m = fields.needed("bubbles_per_m", 1e-6..=1e6)?;
    let count = (per_m * height_m).round().max(1.0);
    if count > MAX_INDIVIDUALS {
        let rule = format!("gives {count:.0} bubbles; at most {MAX_INDIVIDUALS:.0} are allowed");
        return Err(fields.text_error("bubbles_per_m", rule));
    }
    let rise = fields.number("rise_m_per_s", RISE_M_PER_S)?;
    let drift = fields.pair("drift_m_per_s", -20.0..=20.0)?;
    let each_db = fields.needed("target_strength_db", STRENGTHS_DB)?;
    let shape = SwarmShape::Plume {
        height_m,
        radius_m: fields.needed("radius_m", 0.0..=*SIZES_M.end())?,
        spread: fields.number("spread", 0.0..=10.0)?.unwrap_or(0.0),
        rise_m_per_s: rise.unwrap_or(DEFAULT_RISE_M_PER_S),
        drift_m_per_s: drift.map_or(DVec2::ZERO, DVec2::from_array),
    };
    let swarm = (shape, count, each_db);
    Ok(swarm_target(fields, name, foot_m, swarm, None))
}

fn swarm_target(
    fields: &Fields,
    name: &str,
    position_m: DVec3,
    (shape, count, each_db): (SwarmShape, f64, f64),
    course: Option<FileCourse>,
) -> ParsedTarget {
    ParsedTarget {
        target: Target {
            name: name.to_owned(),
            position_m,
            target_strength_db: each_db + 10.0 * libm::log10(count),
            course: None,
        },
        body: Body::Swarm {
            shape,
            count: count as usize,
            each_db,
        },
        course: course.map(|course| course.from(position_m)),
        line: fields.line,
    }
}

/// Motion of a target, before its place is known.
enum FileCourse {
    Uniform(DVec3),
    Track(ParsedCourse),
}

impl FileCourse {
    /// The course of a target that begins at a place.
    fn from(self, position_m: DVec3) -> ParsedCourse {
        match self {
            Self::Track(track) => track,
            Self::Uniform(velocity) => ParsedCourse {
                knots: vec![VectorKnot {
                    time_s: 0.0,
                    value: position_m,
                    rate_per_s: velocity,
                }],
                origin: None,
            },
        }
    }
}

fn course(fields: &Fields, folder: MeshFolder) -> Result<Option<FileCourse>, TextError> {
    let speeds = -MAX_SPEED_M_PER_S..=MAX_SPEED_M_PER_S;
    let velocity = match fields.value("velocity_m_per_s") {
        None => None,
        Some(_) => {
            let velocity = DVec3::from_array(fields.needed_triple("velocity_m_per_s", speeds)?);
            if velocity.length() > MAX_SPEED_M_PER_S {
                let rule = format!("must be at most {MAX_SPEED_M_PER_S} m/s long");
                return Err(fields.text_error("velocity_m_per_s", rule));
            }
            Some(velocity)
        }
    };
    match (velocity, fields.text("track")?) {
        (Some(_), Some(_)) => {
            Err(fields.text_error("track", "must not be given with velocity_m_per_s"))
        }
        (Some(velocity), None) => Ok(Some(FileCourse::Uniform(velocity))),
        (None, None) => Ok(None),
        (None, Some(file)) => {
            let refuse = |why: String| fields.text_error("track", why);
            let path = folder.path.join(file);
            let bytes =
                text::read_file(folder.files, &path).map_err(|error| refuse(error.to_string()))?;
            let track = track::parse(&bytes)
                .map_err(|error| refuse(format!("{}: {error}", path.display())))?;
            Ok(Some(FileCourse::Track(track)))
        }
    }
}

/// A cylinder with its centre at the origin.
fn cylinder(fields: &Fields) -> Result<Solid, TextError> {
    let radius_m = fields.needed("radius_m", SIZES_M)?;
    let length_m = fields.needed("length_m", SIZES_M)?;
    let heading = fields.heading_rad()?;
    let elevation_deg = fields
        .number("elevation_deg", -90.0..=90.0)?
        .unwrap_or(90.0);
    let (rise, level) = libm::sincos(elevation_deg.to_radians());
    let (sin, cos) = libm::sincos(heading);
    let half_m = DVec3::new(level * cos, level * sin, -rise) * (length_m / 2.0);
    Ok(Solid::Cylinder {
        ends_m: [-half_m, half_m],
        radius_m,
    })
}

/// A mesh from a file, with the middle of its bounding box at the origin.
fn mesh_of_file(fields: &Fields, folder: MeshFolder) -> Result<Solid, TextError> {
    let file = fields.needed_text("file")?;
    let axes = match fields.text("axes")? {
        None => AXES[0].1,
        Some(name) => match AXES.iter().find(|(known, _)| *known == name) {
            Some((_, axes)) => *axes,
            None => {
                let names = AXES.map(|(known, _)| known).join(", ");
                return Err(fields.text_error("axes", format!("must be one of {names}")));
            }
        },
    };
    let scale = fields.number("scale", SCALES)?.unwrap_or(1.0);
    let turned = DMat3::from_rotation_z(fields.heading_rad()?) * scale;
    let mut read = mesh::open(folder.files, &folder.path.join(file), axes)
        .map_err(|error| fields.text_error("file", error.to_string()))?;
    for vertex_m in &mut read.vertices_m {
        *vertex_m = turned * *vertex_m;
    }
    let mesh = Mesh::new(&read);
    let mesh =
        mesh.ok_or_else(|| fields.text_error("file", "has no triangle with a nonzero area"))?;
    let solid = Solid::Mesh(mesh);
    let (low, high) = solid.bounds_m();
    Ok(solid.moved(-(low + high) / 2.0))
}

fn rope(fields: &Fields, seabed: SeabedDown) -> Result<Solid, TextError> {
    let radius_m = fields.needed("radius_m", SIZES_M)?;
    for key in ["north_m", "east_m", "down_m"] {
        if fields.value(key).is_some() {
            return Err(
                fields.text_error(key, "is not a field of a rope: path_m gives its position")
            );
        }
    }
    let height_m = fields.number("height_above_seabed_m", 0.0..=MAX_VERTICAL_M)?;
    let Some(rows) = fields.value("path_m") else {
        return Err(fields.text_error("path_m", "is missing"));
    };
    let rule =
        "must be two or more points, all [north, east] over the seabed or all [north, east, down]";
    let wrong = || fields.text_error("path_m", rule);
    let rows = rows.get_ref().as_array().ok_or_else(wrong)?;
    if rows.len() > MAX_ROPE_VERTICES {
        let rule = format!("may have at most {MAX_ROPE_VERTICES} vertices");
        return Err(fields.text_error("path_m", rule));
    }
    let mut vertices_m: Vec<DVec3> = Vec::with_capacity(rows.len());
    let mut width = None;
    for row in rows {
        let row = row.get_ref().as_array().ok_or_else(wrong)?;
        if *width.get_or_insert(row.len()) != row.len() || !(2..=3).contains(&row.len()) {
            return Err(wrong());
        }
        let mut numbers = [0.0; 3];
        for (k, (number, item)) in numbers.iter_mut().zip(row.iter()).enumerate() {
            let limit = if k < 2 {
                MAX_HORIZONTAL_M
            } else {
                MAX_VERTICAL_M
            };
            *number = fields.item("path_m", item.get_ref(), -limit..=limit)?;
        }
        if row.len() == 2 {
            let Some(down_m) = seabed(numbers[0], numbers[1]) else {
                return Err(fields.text_error("path_m", needs_seabed(numbers[0], numbers[1])));
            };
            numbers[2] = down_m - height_m.unwrap_or(0.0) - radius_m;
        }
        vertices_m.push(DVec3::from_array(numbers));
    }
    if width == Some(3) && height_m.is_some() {
        let rule = "applies to a path over the seabed; this path has its own depths";
        return Err(fields.text_error("height_above_seabed_m", rule));
    }
    if vertices_m.len() < 2 {
        return Err(wrong());
    }
    if vertices_m
        .windows(2)
        .any(|pair| pair[0].distance(pair[1]) < 1e-3)
    {
        return Err(fields.text_error("path_m", "must have at least 1 mm between neighbours"));
    }
    Ok(Solid::Rope {
        vertices_m,
        radius_m,
    })
}

fn needs_seabed(north_m: f64, east_m: f64) -> String {
    format!("needs a seabed below it; at north {north_m}, east {east_m} the scene has none")
}

/// Position of the centre. It lies at the given depth, or its lowest point (`lowest_m` below the centre) lies at the given height above the seabed. A track
/// gives the first position.
fn place(
    fields: &Fields,
    seabed: SeabedDown,
    lowest_m: f64,
    course: Option<&FileCourse>,
) -> Result<DVec3, TextError> {
    if let Some(FileCourse::Track(track)) = course {
        for key in ["north_m", "east_m", "down_m", "height_above_seabed_m"] {
            if fields.value(key).is_some() {
                return Err(fields.text_error(key, "must not be given with a track"));
            }
        }
        return Ok(track.knots.first().map_or(DVec3::ZERO, |knot| knot.value));
    }
    let horizontal = -MAX_HORIZONTAL_M..=MAX_HORIZONTAL_M;
    let at = DVec2::new(
        fields.needed("north_m", horizontal.clone())?,
        fields.needed("east_m", horizontal)?,
    );
    let height_m = fields.number("height_above_seabed_m", -MAX_VERTICAL_M..=MAX_VERTICAL_M)?;
    let down_m = fields.number("down_m", -MAX_VERTICAL_M..=MAX_VERTICAL_M)?;
    match (down_m, height_m) {
        (Some(_), Some(_)) => {
            let rule = "must not be given with height_above_seabed_m";
            Err(fields.text_error("down_m", rule))
        }
        (Some(down_m), None) => Ok(at.extend(down_m)),
        (None, height_m) => match seabed(at.x, at.y) {
            Some(seabed_m) => Ok(at.extend(seabed_m - height_m.unwrap_or(0.0) - lowest_m)),
            None => Err(fields.text_error("name", needs_seabed(at.x, at.y))),
        },
    }
}

/// One `[[target]]` table. Its errors name the line.
struct Fields<'a> {
    text: &'a str,
    table: &'a DeTable<'a>,
    line: usize,
}

impl<'a> Fields<'a> {
    fn value(&self, key: &str) -> Option<&'a Spanned<DeValue<'a>>> {
        self.table.get(key)
    }

    /// Error of one field: at its own line if it is present, else at the target's.
    fn text_error(&self, key: &str, rule: impl Into<String>) -> TextError {
        match self.value(key) {
            None => TextError::new(self.line, "", rule),
            Some(value) => {
                let span = value.span();
                let written = self.text.get(span.clone()).unwrap_or("");
                TextError::new(line_of(self.text, span.start), written, rule)
            }
        }
        .in_column(key)
    }

    fn refuse_others(&self, shape: &str, own: &[&str]) -> Result<(), TextError> {
        let motion = if matches!(shape, "rope" | "plume") {
            &[][..]
        } else {
            MOTION
        };
        for (key, _) in self.table {
            let known = |list: &[&str]| list.contains(&key.get_ref().as_ref());
            if !known(COMMON) && !known(SOLID) && !known(motion) && !known(own) {
                let line = line_of(self.text, key.span().start);
                let all = [COMMON, SOLID, motion, own].concat().join(", ");
                let rule = format!("is not a field of a {shape}; its fields are {all}");
                return Err(TextError::new(line, key.get_ref(), rule));
            }
        }
        Ok(())
    }

    /// Refuses the fields of a surface.
    fn refuse_surface(&self, shape: &str) -> Result<(), TextError> {
        for key in ["lambert_db", "density_per_m2"] {
            if self.value(key).is_some() {
                return Err(self.text_error(key, format!("is not a field of a {shape}")));
            }
        }
        Ok(())
    }

    fn pair(&self, key: &str, allowed: RangeInclusive<f64>) -> Result<Option<[f64; 2]>, TextError> {
        let Some(value) = self.value(key) else {
            return Ok(None);
        };
        match value.get_ref().as_array() {
            Some(items) if items.len() == 2 => {
                let mut numbers = [0.0; 2];
                for (number, item) in numbers.iter_mut().zip(items.iter()) {
                    *number = self.item(key, item.get_ref(), allowed.clone())?;
                }
                Ok(Some(numbers))
            }
            _ => Err(self.text_error(key, "must be two numbers")),
        }
    }

    fn text(&self, key: &str) -> Result<Option<&'a str>, TextError> {
        let Some(value) = self.value(key) else {
            return Ok(None);
        };
        match value.get_ref().as_str() {
            Some(text) => Ok(Some(text)),
            None => Err(self.text_error(key, "must be text")),
        }
    }

    fn needed_text(&self, key: &str) -> Result<&'a str, TextError> {
        self.text(key)?
            .ok_or_else(|| self.text_error(key, "is missing"))
    }

    fn item(
        &self,
        key: &str,
        value: &DeValue,
        allowed: RangeInclusive<f64>,
    ) -> Result<f64, TextError> {
        let digits = match value {
            DeValue::Integer(number) if number.radix() == 10 => number.as_str(),
            DeValue::Float(number) => number.as_str(),
            _ => return Err(self.text_error(key, "must be a number")),
        };
        text::number(&digits.replace('_', ""), allowed).map_err(|rule| self.text_error(key, rule))
    }

    fn number(&self, key: &str, allowed: RangeInclusive<f64>) -> Result<Option<f64>, TextError> {
        self.value(key)
            .map(|value| self.item(key, value.get_ref(), allowed))
            .transpose()
    }

    fn needed(&self, key: &str, allowed: RangeInclusive<f64>) -> Result<f64, TextError> {
        self.number(key, allowed)?
            .ok_or_else(|| self.text_error(key, "is missing"))
    }

    fn needed_triple(
        &self,
        key: &str,
        allowed: RangeInclusive<f64>,
    ) -> Result<[f64; 3], TextError> {
        let Some(value) = self.value(key) else {
            return Err(self.text_error(key, "is missing"));
        };
        match value.get_ref().as_array() {
            Some(items) if items.len() == 3 => {
                let mut numbers = [0.0; 3];
                for (number, item) in numbers.iter_mut().zip(items.iter()) {
                    *number = self.item(key, item.get_ref(), allowed.clone())?;
                }
                Ok(numbers)
            }
            _ => Err(self.text_error(key, "must be three numbers")),
        }
    }

    fn heading_rad(&self) -> Result<f64, TextError> {
        let deg = self.number("heading_deg", -360.0..=360.0)?;
        Ok(deg.unwrap_or(0.0).to_radians())
    }
}

fn line_of(text: &str, at: usize) -> usize {
    text.as_bytes()[..at.min(text.len())]
        .iter()
        .filter(|byte| **byte == b'\n')
        .count()
        + 1
}

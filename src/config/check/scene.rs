//! Checks the scene, and computes the density of seabed scatterers that the sonars require.

use glam::DVec3;

use super::super::spec::*;
use super::{MIB, density};
use crate::keys;
use crate::raw::{Entry, Field, Problems};
use echotank_core::arrays::Pattern;

/// Memory of one scatterer in a tile, bytes: three coordinates, a normal, a strength, a rank, a mark and a gain.
const BYTES_PER_SCATTERER: f64 = 42.0;
/// Approximate ratio of the area of the tiles to the insonified area.
const TILE_EDGES: f64 = 1.3;
/// Approximate ratio of the scatterers in the tiles of a ping to those that it keeps, with automatic density.
const TILES_AROUND_LOBES: f64 = 6.0;
/// Cosine between the axes of two arrays above which the arrays count as parallel: 2.6 degrees.
const PARALLEL: f64 = 0.999;

/// Properties of the rig that the scene depends on.
pub(super) struct Rig<'a> {
    pub sonars: &'a [&'a SonarSpec],
    pub sound_speed_m_per_s: Option<f64>,
    pub longest_range_m: f64,
}

pub(super) fn scene(table: &keys::Scene, rig: &Rig, problems: &mut Problems) -> Option<SceneSpec> {
    let seabed_table = table.seabed.as_ref();
    let incidence = table.incidence.named()?;
    let seabed = seabed_table.and_then(|t| seabed(t, rig, incidence, problems));
    let gridded = match seabed_table {
        Some(t) => t.shape.text().map(is_survey),
        None => Some(table.seabed.given),
    };
    let condition = "a seabed of shape \"file\" or \"esri-ascii\"";
    if table.extend.text() == Some("mirror") {
        problems.only_with(&[&table.extend], gridded, condition);
    }
    if table.anchor.text() == Some("file") {
        problems.only_with(&[&table.anchor], gridded, condition);
    }
    // A file of shapes may give depths. The reader of that file reports a missing seabed.
    let shapes = table
        .targets
        .get()
        .is_some_and(|path| path.extension().is_some_and(|e| e == "toml"));
    let carried = Some(table.seabed.given || shapes);
    problems.only_with(
        &[&table.targets],
        carried,
        "a seabed, because the targets lie on it",
    );
    let memory_limit_bytes: u64 = table.memory_mib.to()?;
    if let Some(density) = seabed.as_ref().map(|s| s.density) {
        let scatterers = rig.scatterers_in_beams(&density);
        let needed_mib = (scatterers * BYTES_PER_SCATTERER / MIB as f64).ceil();
        if needed_mib > (memory_limit_bytes / MIB) as f64 {
            let density = match density {
                Density::PerM2(n) => format!("density_per_m2 = {n}"),
                Density::Auto { .. } => {
                    "density = \"auto\"; density_per_m2 is a constant density instead".to_owned()
                }
            };
            let rule = format!(
                "must be at least {needed_mib}, to hold the {scatterers:.3e} scatterers in the beams within {} m ({density})",
                rig.longest_range_m
            );
            problems.refuse(&table.memory_mib, rule);
        }
    }
    Some(SceneSpec {
        seed: table.seed.to()?,
        anchor: table.anchor.named()?,
        mirror: table.extend.text()? == "mirror",
        seabed: match table.seabed.given {
            true => Some(seabed?),
            false => None,
        },
        points: table.points.if_given()?,
        targets: table.targets.if_given()?,
        occlusion: table.occlusion.named()?,
        memory_limit_bytes,
        simplify: simplify(table.simplify.as_ref()?, problems)?,
    })
}

/// Simplification of the scatterers. `Some(None)` without a method; `None` after a problem.
fn simplify(table: &keys::Simplify, problems: &mut Problems) -> Option<Option<SimplifySpec>> {
    let name = table.method.text()?;
    let some = Some(name != "none");
    let of_methods: [&Entry; 5] = [
        &table.keep,
        &table.weight_curvature,
        &table.weight_scattering,
        &table.weight_axis,
        &table.weight_echo,
    ];
    problems.only_with(&of_methods, some, "a method");
    problems.needed_with(&table.keep, some, "a method");
    let Some(method) = table.method.named() else {
        return Some(None);
    };
    let default = EnergyWeights::default_of(method);
    let weight = |key: &Field<f64>, default: f64| Some(key.if_given()?.unwrap_or(default));
    Some(Some(SimplifySpec {
        method,
        keep: table.keep.to()?,
        weights: EnergyWeights {
            curvature: weight(&table.weight_curvature, default.curvature)?,
            scattering: weight(&table.weight_scattering, default.scattering)?,
            axis: weight(&table.weight_axis, default.axis)?,
            echo: weight(&table.weight_echo, default.echo)?,
        },
        hold_m: table.hold_m.get()?,
        hold_rad: table.hold_deg.get()?,
        shadows: table.shadows.get()?,
    }))
}

fn seabed(
    table: &keys::Seabed,
    rig: &Rig,
    incidence: IncidenceSpec,
    problems: &mut Problems,
) -> Option<SeabedSpec> {
    let bottom = bottom(table, problems);
    let mosaic = mosaic(table, problems)?;
    let constant = Some(!table.density.given);
    problems.only_with(
        &[&table.density_per_m2],
        constant,
        "a constant density, not density = \"auto\"",
    );
    let density = match table.density.given || !table.density_per_m2.given {
        true => {
            let depth_m = table
                .depth_m
                .get()
                .filter(|_| table.shape.text() == Some("plane"));
            density::auto(rig, depth_m, table.speckle.get()?)?
        }
        false => Density::PerM2(table.density_per_m2.get()?),
    };
    let shape = match table.shape.text()? {
        "plane" => SeabedShape::Plane {
            depth_m: table.depth_m.get()?,
            slope_north: table.slope_north.get()?,
            slope_east: table.slope_east.get()?,
        },
        name if name.starts_with("paper-") => SeabedShape::Paper(table.shape.named()?),
        shape => SeabedShape::File {
            file: file(table, shape, problems)?,
            offset_north_m: table.offset_north_m.get()?,
            offset_east_m: table.offset_east_m.get()?,
        },
    };
    Some(SeabedSpec {
        shape,
        density,
        bottom: bottom?,
        incidence,
        mosaic,
        speckle: table.speckle.get()?,
    })
}

/// Whether a shape is read from a file.
fn is_survey(shape: &str) -> bool {
    matches!(shape, "file" | "esri-ascii")
}

fn file(table: &keys::Seabed, shape: &str, problems: &mut Problems) -> Option<SeabedFileSpec> {
    let crs = crs(&table.crs, problems)?;
    // Values that name no format or sign, such as "auto", become `None`.
    Some(SeabedFileSpec {
        path: table.path.get()?,
        format: match shape {
            "esri-ascii" => Some(SeabedFormat::EsriAscii),
            _ => table.format.named(),
        },
        crs,
        values: table.values.named(),
        first_row: table.first_row.named(),
        nodata: table.nodata.get(),
        cell_m: table.cell_m.get(),
        max_edge_m: table.max_edge_m.get(),
    })
}

/// Coordinate system of a file. `Some(None)` if the key is absent; `None` after a problem.
fn crs(key: &Field<String>, problems: &mut Problems) -> Option<Option<CrsSpec>> {
    match key.text().map(str::parse) {
        None => Some(None),
        Some(Ok(crs)) => Some(Some(crs)),
        Some(Err(rule)) => {
            problems.refuse(key, rule);
            None
        }
    }
}

fn bottom(table: &keys::Seabed, problems: &mut Problems) -> Option<BottomSpec> {
    let name = table.bottom.text();
    let sediment = table.bottom.named();
    let condition = "bottom = \"lambert\", \"bistatic-lambert\" or \"three-term\"";
    let free = name.map(|_| sediment.is_none());
    problems.only_with(&[&table.lambert_db], free, condition);
    if let Some(sediment) = sediment {
        return Some(BottomSpec::Sediment(sediment));
    }
    let mu_db = table.lambert_db.get()?;
    Some(match name? {
        "three-term" => BottomSpec::ThreeTerm(ThreeTerm {
            specular_db: table.specular_db.get()?,
            specular_rad: table.specular_width_deg.get()?,
            lambert_db: mu_db,
            lambert_exponent: table.lambert_exponent.get()?,
            intermediate_db: table.intermediate_db.get()?,
            intermediate_rad: table.intermediate_width_deg.get()?,
        }),
        "lambert" => BottomSpec::Lambert { mu_db },
        _ => BottomSpec::BistaticLambert { mu_db },
    })
}

/// Mosaic of the seabed. `Some(None)` if no mosaic is given; `None` after a problem.
fn mosaic(table: &keys::Seabed, problems: &mut Problems) -> Option<Option<MosaicSpec>> {
    let given = table.mosaic.given;
    let of_mosaics: [&Entry; 5] = [
        &table.mosaic_crs,
        &table.mosaic_values,
        &table.mosaic_incidence_deg,
        &table.mosaic_offset_north_m,
        &table.mosaic_offset_east_m,
    ];
    problems.only_with(&of_mosaics, Some(given), "a mosaic");
    if !given {
        return Some(None);
    }
    let absolute = table.mosaic_values.text()? == "absolute";
    let condition = "mosaic_values = \"absolute\"";
    problems.only_with(&[&table.mosaic_incidence_deg], Some(absolute), condition);
    Some(Some(MosaicSpec {
        path: table.mosaic.get()?,
        crs: crs(&table.mosaic_crs, problems)?,
        values: match absolute {
            true => MosaicValues::Absolute {
                incidence_rad: table.mosaic_incidence_deg.get()?,
            },
            false => MosaicValues::Relative,
        },
        offset_north_m: table.mosaic_offset_north_m.get()?,
        offset_east_m: table.mosaic_offset_east_m.get()?,
    }))
}

impl Rig<'_> {
    /// Approximate number of scatterers in the tiles that one ping needs, on a flat seabed.
    fn scatterers_in_beams(&self, density: &Density) -> f64 {
        let range_m = self.longest_range_m;
        match *density {
            Density::PerM2(density_per_m2) => {
                let full_circle = density_per_m2 * std::f64::consts::PI * range_m * range_m;
                full_circle * self.widest_share() * TILE_EDGES
            }
            Density::Auto { lobes, .. } => {
                let c = self.sound_speed_m_per_s.unwrap_or(f64::NAN);
                let of =
                    |sonar: &&SonarSpec| density::scatterers_a_ping(sonar, c, None, range_m, lobes);
                let most = self.sonars.iter().map(of).fold(0.0, f64::max);
                most * TILES_AROUND_LOBES
            }
        }
    }

    /// Fraction of the full circle in which the widest pair of transmitter and element is above the culling level.
    fn widest_share(&self) -> f64 {
        let Some(c) = self.sound_speed_m_per_s else {
            return 0.0;
        };
        let share = |sonar: &SonarSpec| {
            let wavelength_m = c / sonar.pulse.center_frequency_hz;
            let Some(db) = sonar.model.cull_db else {
                return 1.0;
            };
            let depth = 10f64.powf(-db / 20.0);
            let pairs = sonar.receive.iter().map(|array| {
                let transmit = &sonar.transmit[array.transmit];
                let sent = knee(&transmit.pattern, wavelength_m);
                let heard = knee(&array.envelope_pattern(), wavelength_m);
                let sine = match along(&transmit.mounting, &array.mounting) > PARALLEL {
                    true => two_way_sine(sent, heard, depth),
                    false => sent * depth,
                };
                sine.min(1.0).asin() * std::f64::consts::FRAC_2_PI
            });
            pairs.fold(0.0, f64::max)
        };
        self.sonars.iter().map(|s| share(s)).fold(0.0, f64::max)
    }
}

/// Sine of the angle from broadside, `knee`, such that the pattern of a radiator stays below knee / sine. Infinite for a radiator
/// without length.
fn knee(pattern: &Pattern, wavelength_m: f64) -> f64 {
    match pattern {
        Pattern::Rectangle { length_m, .. } | Pattern::Part { length_m, .. } => {
            wavelength_m / (std::f64::consts::PI * length_m)
        }
        Pattern::Omnidirectional => f64::INFINITY,
    }
}

/// Sine at which the product of two bounds, each at most 1, falls to 1 / depth.
fn two_way_sine(a: f64, b: f64, depth: f64) -> f64 {
    let (narrow, wide) = (a.min(b), a.max(b));
    match narrow * depth > wide {
        true => (narrow * wide * depth).sqrt(),
        false => narrow * depth,
    }
}

/// Cosine between two array axes, 0 to 1.
fn along(a: &echotank_core::arrays::Mounting, b: &echotank_core::arrays::Mounting) -> f64 {
    let axis = |mounting: &echotank_core::arrays::Mounting| mounting.body_from_array * DVec3::X;
    axis(a).dot(axis(b)).abs()
}

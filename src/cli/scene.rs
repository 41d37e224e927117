//! `echotank scene`: inspects seabeds and 3-D models.

mod simplify;

use std::io::Write;
use std::path::{Path, PathBuf};

use clap::{Args, Subcommand, ValueEnum};
use glam::DVec3;
use serde_json::{Value, json};

use super::{Failure, choice};
use echotank_config::spec::{
    CrsSpec, FirstRow, HeightSign, NamedChoice, SeabedFileSpec, SeabedFormat,
};
use echotank_runtime::io::files::FileSystem;
use echotank_scene::read::mesh::{self, MeshAxes};
use echotank_scene::read::relief;
use echotank_scene::read::survey::{Layout, Lookup, Survey};

/// Printed depth percentiles, as fractions.
const PERCENTILES: [f64; 7] = [0.0, 0.01, 0.05, 0.5, 0.95, 0.99, 1.0];

#[derive(Args, Clone, Debug)]
pub(crate) struct SceneArgs {
    #[command(subcommand)]
    pub(crate) command: SceneCommand,
}

#[derive(Subcommand, Clone, Debug)]
pub(crate) enum SceneCommand {
    /// Print properties of a seabed or model: format, coordinates, sign of heights, holes, depths
    Info(InfoArgs),
    /// Reduce a seabed to the scatterers that matter for one sonar, and write them as points
    Simplify(simplify::SimplifyArgs),
}

pub(crate) fn main(args: &SceneArgs) -> Result<(), Failure> {
    match &args.command {
        SceneCommand::Info(args) => info(args),
        SceneCommand::Simplify(args) => simplify::main(args),
    }
}

#[derive(Args, Clone, Debug)]
pub(crate) struct InfoArgs {
    /// Seabed (GeoTIFF, BAG, ESRI ASCII grid, XYZ or CSV soundings, LAS, PLY) or model (OBJ, STL)
    pub(crate) file: PathBuf,
    /// Draw the seabed as shaded relief
    #[arg(long, value_name = "FILE")]
    pub(crate) png: Option<PathBuf>,
    /// Print JSON
    #[arg(long)]
    pub(crate) json: bool,
    /// Print the depth at a position: northing,easting or latitude,longitude in the file's coordinates; may be repeated
    #[arg(long, value_name = "Y,X", value_parser = parse_place, allow_hyphen_values = true)]
    pub(crate) at: Vec<(f64, f64)>,
    /// File format [default: detected]
    #[arg(long, value_parser = choice::<SeabedFormat>())]
    pub(crate) format: Option<SeabedFormat>,
    /// Coordinate system [default: from the file]: local, geographic, projected, utm-31n, EPSG:32631
    #[arg(long)]
    pub(crate) crs: Option<CrsSpec>,
    /// Sign of heights [default: from the file]
    #[arg(long, value_parser = choice::<HeightSign>())]
    pub(crate) values: Option<HeightSign>,
    /// Position of a grid's first row [default: from the file]
    #[arg(long, value_parser = choice::<FirstRow>())]
    pub(crate) first_row: Option<FirstRow>,
    /// Value that marks holes, in addition to the file's own
    #[arg(long, value_name = "VALUE", allow_hyphen_values = true)]
    pub(crate) nodata: Option<f64>,
    /// Soundings: cell size of the interpolated grid
    #[arg(long, value_name = "M", value_parser = parse_length)]
    pub(crate) cell_m: Option<f64>,
    /// Soundings: triangles with a longer edge are holes
    #[arg(long, value_name = "M", value_parser = parse_length)]
    pub(crate) max_edge_m: Option<f64>,
    /// Models: directions of x, y and z
    #[arg(long, value_enum, default_value = "east-north-up")]
    pub(crate) axes: Axes,
}

#[derive(Clone, Copy, Debug, ValueEnum)]
pub(crate) enum Axes {
    EastNorthUp,
    NorthEastDown,
    EastUpSouth,
}

fn parse_place(text: &str) -> Result<(f64, f64), String> {
    let (y, x) = text.split_once(',').ok_or("expected two numbers, Y,X")?;
    let number = |s: &str| match s.trim().parse::<f64>() {
        Ok(v) if v.is_finite() => Ok(v),
        _ => Err(format!("`{}`: expected a finite number", s.trim())),
    };
    Ok((number(y)?, number(x)?))
}

fn parse_length(text: &str) -> Result<f64, String> {
    match text.parse::<f64>() {
        Ok(v) if v.is_finite() && v > 0.0 => Ok(v),
        _ => Err("must be a length above 0 m".to_owned()),
    }
}

impl InfoArgs {
    fn asked(&self) -> SeabedFileSpec {
        SeabedFileSpec {
            path: self.file.clone(),
            format: self.format,
            crs: self.crs,
            values: self.values,
            first_row: self.first_row,
            nodata: self.nodata,
            cell_m: self.cell_m,
            max_edge_m: self.max_edge_m,
        }
    }

    fn is_model(&self) -> bool {
        let extension = self.file.extension().and_then(|e| e.to_str()).unwrap_or("");
        self.format.is_none() && ["obj", "stl"].contains(&extension.to_ascii_lowercase().as_str())
    }
}

fn info(args: &InfoArgs) -> Result<(), Failure> {
    if args.is_model() {
        return model_info(args);
    }
    let survey = Survey::open(&FileSystem, &args.asked())
        .map_err(|e| Failure::Configuration(e.to_string()))?;
    let caption = match &args.png {
        Some(path) => Some(write_relief(path, &survey).map_err(Failure::Running)?),
        None => None,
    };
    if args.json {
        print_json(&as_json(&args.file, &survey, &args.at));
    } else {
        print!("{}", as_text(&args.file, &survey, &args.at));
        if let (Some(path), Some(caption)) = (&args.png, caption) {
            println!("{:9} {}: {caption}", "picture", path.display());
        }
    }
    Ok(())
}

fn print_json(value: &Value) {
    println!("{value:#}");
}

/// Writes the shaded relief. Returns its caption.
fn write_relief(path: &Path, survey: &Survey) -> Result<String, String> {
    let picture = relief::draw(&survey.field);
    let failed = |e: &dyn std::fmt::Display| format!("{}: {e}", path.display());
    let mut bytes = Vec::new();
    let encoded = (|| {
        let mut encoder =
            png::Encoder::new(&mut bytes, picture.width as u32, picture.height as u32);
        encoder.set_color(png::ColorType::Rgb);
        encoder.set_depth(png::BitDepth::Eight);
        let words = format!("{}, shaded relief, {}", survey.format, picture.caption);
        encoder.add_text_chunk("Description".into(), words)?;
        let mut writer = encoder.write_header()?;
        writer.write_image_data(&picture.rgb)?;
        writer.finish()
    })();
    encoded.map_err(|e: png::EncodingError| failed(&e))?;
    let mut file = std::fs::File::create(path).map_err(|e| failed(&e))?;
    file.write_all(&bytes).map_err(|e| failed(&e))?;
    Ok(picture.caption)
}

/// Formats a number with at most seven decimals and no trailing zeros.
fn short(value: f64) -> String {
    let text = format!("{value:.7}");
    text.trim_end_matches('0').trim_end_matches('.').to_owned()
}

fn as_text(file: &Path, survey: &Survey, at: &[(f64, f64)]) -> String {
    let mut lines = vec![
        ("file", file.display().to_string()),
        (
            "format",
            format!("{}, {} bytes", survey.format, survey.bytes),
        ),
        ("system", format!("{}  [{}]", survey.crs, survey.crs_source)),
        (
            "heights",
            format!("{}  [{}]", sign_words(survey.sign), survey.sign_source),
        ),
    ];
    let field = &survey.field;
    match &survey.layout {
        Layout::Grid {
            rows,
            cols,
            x_step,
            y_step,
            first_row,
            first_row_source,
            from_corners,
        } => {
            lines.push((
                "size",
                format!(
                    "{rows} rows x {cols} columns, cells {} north x {} east",
                    short(*y_step),
                    short(*x_step)
                ),
            ));
            let row = first_row.word();
            lines.push(("first row", format!("{row}  [{first_row_source}]")));
            let given = if *from_corners { "corners" } else { "centres" };
            lines.push((
                "cells",
                format!("given by their {given}, heights at the centres"),
            ));
        }
        Layout::Points {
            count,
            merged,
            triangles,
            own_triangles,
        } => {
            let whose = if *own_triangles {
                "its own"
            } else {
                "Delaunay"
            };
            lines.push((
                "size",
                format!(
                    "{count} soundings ({merged} more at the same places, averaged), {triangles} triangles ({whose})"
                ),
            ));
        }
    }
    let [west, south, east, north] = survey.covers.map(short);
    lines.push((
        "covers",
        format!("x {west} .. {east}, y {south} .. {north}"),
    ));
    lines.push(("zero", zero_words(survey)));
    lines.push((
        "local",
        format!(
            "{} rows x {} columns of {:.3} m north x {:.3} m east; {:.1} .. {:.1} m north, {:.1} .. {:.1} m east of zero",
            field.rows,
            field.cols,
            field.cell_north_m,
            field.cell_east_m,
            field.south_m,
            field.south_m + field.extent_north_m(),
            field.west_m,
            field.west_m + field.extent_east_m()
        ),
    ));
    lines.push(("holes", format!("{:.2} %", 100.0 * field.hole_share())));
    let depths = field.percentiles_m(&PERCENTILES);
    let words: Vec<String> = PERCENTILES
        .iter()
        .zip(&depths)
        .map(|(share, d)| format!("{:.0}%: {d:.3}", 100.0 * share))
        .collect();
    lines.push(("depth m", words.join("  ")));
    for guess in &survey.guesses {
        lines.push(("guessed", guess.clone()));
    }
    for note in &survey.notes {
        lines.push(("note", note.clone()));
    }
    for (y, x) in at {
        lines.push(("at", at_words(*y, *x, &survey.at(*x, *y))));
    }
    lines
        .iter()
        .map(|(label, text)| format!("{label:9} {text}\n"))
        .collect()
}

fn sign_words(sign: HeightSign) -> &'static str {
    match sign {
        HeightSign::Elevation => "elevations, positive up",
        HeightSign::Depth => "depths, positive down",
    }
}

fn zero_words(survey: &Survey) -> String {
    let [x, y] = survey.zero.map(short);
    let place = match survey.zero_geodetic_rad() {
        Some((lat, lon)) => format!(
            "latitude {:.7}, longitude {:.7}",
            lat.to_degrees(),
            lon.to_degrees()
        ),
        None => "geographic position unknown".to_owned(),
    };
    format!("x {x}, y {y}, the middle ({place})")
}

fn at_words(y: f64, x: f64, found: &Lookup) -> String {
    let cell = match found.cell {
        Some((row, col)) => format!("row {row} from the south, column {col}"),
        None => "no cell".to_owned(),
    };
    let depth = |d: Option<f64>| d.map_or("none".to_owned(), |d| format!("{d:.6} m"));
    format!(
        "{y},{x}: depth {} ({cell}), surface {}; {:.3} m north, {:.3} m east of zero",
        depth(found.down_m),
        depth(found.surface_down_m),
        found.north_m,
        found.east_m
    )
}

fn as_json(file: &Path, survey: &Survey, at: &[(f64, f64)]) -> Value {
    let field = &survey.field;
    let layout = match &survey.layout {
        Layout::Grid {
            rows,
            cols,
            x_step,
            y_step,
            first_row,
            first_row_source,
            from_corners,
        } => json!({
            "rows": rows,
            "columns": cols,
            "x_step": x_step,
            "y_step": y_step,
            "first_row": first_row.word(),
            "first_row_source": first_row_source.to_string(),
            "given_by": if *from_corners { "corners" } else { "centres" },
        }),
        Layout::Points {
            count,
            merged,
            triangles,
            own_triangles,
        } => json!({
            "soundings": count,
            "merged": merged,
            "triangles": triangles,
            "own_triangles": own_triangles,
        }),
    };
    let depths = field.percentiles_m(&PERCENTILES);
    let percentiles: Vec<Value> = PERCENTILES
        .iter()
        .zip(depths)
        .map(|(share, depth_m)| json!({ "share": share, "depth_m": depth_m }))
        .collect();
    let zero_deg = survey
        .zero_geodetic_rad()
        .map(|(lat, lon)| json!({ "latitude": lat.to_degrees(), "longitude": lon.to_degrees() }));
    let places: Vec<Value> = at
        .iter()
        .map(|(y, x)| {
            let found = survey.at(*x, *y);
            json!({
                "y": y,
                "x": x,
                "north_m": found.north_m,
                "east_m": found.east_m,
                "row_from_south": found.cell.map(|c| c.0),
                "column": found.cell.map(|c| c.1),
                "depth_m": found.down_m,
                "surface_depth_m": found.surface_down_m,
            })
        })
        .collect();
    json!({
        "file": file.display().to_string(),
        "format": survey.format,
        "bytes": survey.bytes,
        "system": survey.crs.to_string(),
        "system_source": survey.crs_source.to_string(),
        "heights": survey.sign.word(),
        "heights_source": survey.sign_source.to_string(),
        "layout": layout,
        "covers": { "west": survey.covers[0], "south": survey.covers[1], "east": survey.covers[2], "north": survey.covers[3] },
        "zero": { "x": survey.zero[0], "y": survey.zero[1] },
        "zero_geodetic_deg": zero_deg,
        "local": {
            "rows": field.rows,
            "columns": field.cols,
            "cell_north_m": field.cell_north_m,
            "cell_east_m": field.cell_east_m,
            "south_m": field.south_m,
            "west_m": field.west_m,
        },
        "hole_share": field.hole_share(),
        "depth_percentiles": percentiles,
        "guesses": survey.guesses,
        "notes": survey.notes,
        "at": places,
    })
}

fn model_info(args: &InfoArgs) -> Result<(), Failure> {
    if args.png.is_some() || !args.at.is_empty() {
        let text = format!(
            "{}: --png and --at apply to seabeds only; this file is a 3-D model",
            args.file.display()
        );
        return Err(Failure::Configuration(text));
    }
    let axes = match args.axes {
        Axes::EastNorthUp => MeshAxes::EastNorthUp,
        Axes::NorthEastDown => MeshAxes::NorthEastDown,
        Axes::EastUpSouth => MeshAxes::EastUpSouth,
    };
    let mesh = mesh::open(&FileSystem, &args.file, axes)
        .map_err(|e| Failure::Configuration(e.to_string()))?;
    let start = DVec3::splat(f64::INFINITY);
    let low = mesh.vertices_m.iter().fold(start, |m, v| m.min(*v));
    let high = mesh.vertices_m.iter().fold(-start, |m, v| m.max(*v));
    let area_m2 = mesh.area_m2();
    if args.json {
        print_json(&json!({
            "file": args.file.display().to_string(),
            "format": "mesh",
            "vertices": mesh.vertices_m.len(),
            "triangles": mesh.triangles.len(),
            "area_m2": area_m2,
            "low_north_east_down_m": low.to_array(),
            "high_north_east_down_m": high.to_array(),
        }));
        return Ok(());
    }
    println!("{:9} {}", "file", args.file.display());
    println!(
        "{:9} mesh, {} vertices, {} triangles, {area_m2:.4} m2",
        "format",
        mesh.vertices_m.len(),
        mesh.triangles.len()
    );
    println!(
        "{:9} {:?}, unit assumed to be metres  [not in the file: --axes]",
        "axes", args.axes
    );
    for (axis, (low, high)) in ["north", "east", "down"]
        .iter()
        .zip(low.to_array().into_iter().zip(high.to_array()))
    {
        println!("{axis:9} {low:.3} .. {high:.3} m");
    }
    Ok(())
}

//! Soundings as text: one line each with x, y and height or depth, separated by commas, semicolons or blanks.
//!
//! `#` begins a comment and `>` a segment (GMT). A first line of names identifies the columns (`lon lat depth`, `easting, northing, elevation`).
//! A comment directly before the soundings may hold the names. Names may end in a unit (`depth_ft`, `x (m)`).
//! Without names the first three columns are taken for x, y and z, which is a guess. A file that was cut between two lines cannot be told from a complete one.

use glam::DVec3;

use super::text::{self, MAX_VERTICAL_M, TextError};
use super::units::{self, Units};
use super::{Crs, Facts, FormatError, MAX_POINTS, Raw, RawPoints, RawShape, Reader};
use echotank_config::spec::{HeightSign, SeabedFileSpec, SeabedFormat};

/// Accepted coordinates of any projection.
const COORDINATES: std::ops::RangeInclusive<f64> = -1e9..=1e9;
const HEIGHTS: std::ops::RangeInclusive<f64> = -MAX_VERTICAL_M..=MAX_VERTICAL_M;

pub(super) const READER: Reader = Reader {
    format: SeabedFormat::Xyz,
    name: "XYZ soundings",
    recognises: |_, extension| matches!(extension, "xyz" | "csv" | "txt" | "tsv" | "dat" | "pts"),
    read: |bytes, spec| parse(&bytes, spec),
};

/// Positions of the three numbers in a line.
#[derive(Clone, Copy)]
struct Columns {
    x: usize,
    y: usize,
    z: usize,
}

fn parse(bytes: &[u8], spec: &SeabedFileSpec) -> Result<Raw, FormatError> {
    let text = text::utf8(bytes)?;
    let mut facts = Facts::default();
    let mut columns = None;
    let mut points = Vec::new();
    let mut holes = 0_u64;
    let mut fields: Vec<&str> = Vec::new();
    let mut comment = "";
    for (index, content) in text.lines().enumerate() {
        let line = index + 1;
        let content = content.trim();
        if content.is_empty() || content.starts_with(['#', '>']) {
            if columns.is_none() {
                comment = content.trim_start_matches(['#', '>', ' ']);
            }
            continue;
        }
        fields.clear();
        split(content, &mut fields);
        let columns = match columns {
            Some(columns) => columns,
            None if fields[0].parse::<f64>().is_ok() => {
                let found = unnamed(line, comment, &fields, &mut facts);
                *columns.insert(found)
            }
            None => {
                columns = Some(named(line, &fields, &mut facts)?);
                continue;
            }
        };
        let field = |place: usize| {
            fields.get(place).copied().ok_or_else(|| {
                let rule = format!("must have at least {} columns", place + 1);
                TextError::new(line, content, rule)
            })
        };
        let number = |place: usize, allowed| {
            let text = field(place)?;
            text::number(text, allowed).map_err(|rule| TextError::new(line, text, rule))
        };
        let (x, y) = (
            number(columns.x, COORDINATES)?,
            number(columns.y, COORDINATES)?,
        );
        let z = field(columns.z)?;
        if let Ok(value) = z.parse::<f64>()
            && (value.is_nan() || spec.nodata == Some(value))
        {
            holes += 1;
            continue;
        }
        let z = number(columns.z, HEIGHTS)?;
        if points.len() == MAX_POINTS {
            let rule = format!("at most {MAX_POINTS} soundings are read: thin or grid them first");
            return Err(TextError::new(line, content, rule).into());
        }
        points.push(DVec3::new(x, y, z));
    }
    if holes > 0 {
        facts
            .notes
            .push(format!("{holes} soundings without a depth were left out"));
    }
    Ok(Raw {
        shape: RawShape::Points(RawPoints {
            points,
            triangles: None,
        }),
        facts,
    })
}

fn split<'a>(line: &'a str, fields: &mut Vec<&'a str>) {
    let separator = [',', ';'].into_iter().find(|c| line.contains(*c));
    match separator {
        Some(c) => fields.extend(line.split(c).map(|f| f.trim().trim_matches('"'))),
        None => fields.extend(line.split_whitespace()),
    }
}

/// Columns of a file whose first line is numbers: by the names in the comment before it, or else the first three.
fn unnamed(line: usize, comment: &str, fields: &[&str], facts: &mut Facts) -> Columns {
    let mut names = Vec::new();
    split(comment, &mut names);
    let mut stated = Facts::default();
    if names.len() == fields.len()
        && let Ok(columns) = named(line, &names, &mut stated)
    {
        *facts = stated;
        facts
            .notes
            .push(format!("the columns are those of the comment `{comment}`"));
        return columns;
    }
    if fields.len() > 3 {
        let note = format!(
            "{} columns without names: the first three are used",
            fields.len()
        );
        facts.notes.push(note);
    }
    facts.guesses.push(
        "columns without names are taken for x (east), y (north) and z; a first line of names, such as `north east depth`, states them".to_owned(),
    );
    Columns { x: 0, y: 1, z: 2 }
}

/// The unit at the end of a column's name, metres: `depth_ft`, `depth (m)`, `depth[US_ft]`.
fn unit_of(name: &str) -> Option<f64> {
    let (_, unit) = name.split_once(['_', ' ', '(', '['])?;
    units::of_word(unit)
}

/// Columns that a line of names identifies. Stores what the names state about coordinates and heights in `facts`.
fn named(line: usize, fields: &[&str], facts: &mut Facts) -> Result<Columns, TextError> {
    let names: Vec<String> = fields.iter().map(|f| f.to_ascii_lowercase()).collect();
    let place = |known: &[&str]| {
        names.iter().position(|n| {
            let word = n.split(['_', ' ', '(', '[']).next().unwrap_or("");
            known.contains(&word)
        })
    };
    let degrees = (
        place(&["lon", "long", "longitude"]),
        place(&["lat", "latitude"]),
    );
    let metres = (
        place(&["x", "e", "east", "easting"]),
        place(&["y", "n", "north", "northing"]),
    );
    let depth = place(&["depth", "down", "d"]);
    let height = place(&["z", "elevation", "elev", "height", "altitude"]);
    let mut is_metric = true;
    let (x, y) = match (degrees, metres) {
        ((Some(x), Some(y)), _) => {
            is_metric = false;
            facts.crs = Some(Crs::Geographic("by the header".to_owned()));
            (x, y)
        }
        (_, (Some(x), Some(y))) => (x, y),
        _ => {
            let rule = "must name the columns x and y (or easting and northing, or lon and lat)";
            return Err(TextError::new(line, &fields.join(" "), rule));
        }
    };
    let Some(z) = depth.or(height) else {
        let rule = "must name a column depth, elevation or z";
        return Err(TextError::new(line, &fields.join(" "), rule));
    };
    let horizontal = [x, y].map(|column| unit_of(&names[column]));
    if is_metric && horizontal[0] != horizontal[1] {
        let rule = "must give x and y in one unit";
        return Err(TextError::new(line, &fields.join(" "), rule));
    }
    facts.units = Units {
        horizontal_m: horizontal[0].filter(|_| is_metric),
        vertical_m: unit_of(&names[z]),
    };
    if depth.is_some() {
        facts.values = Some((HeightSign::Depth, "by the name of the column"));
    } else if names[z].starts_with("elev") {
        facts.values = Some((HeightSign::Elevation, "by the name of the column"));
    }
    Ok(Columns { x, y, z })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn read(text: &str) -> Result<(Vec<DVec3>, Facts), String> {
        let raw = parse(text.as_bytes(), &SeabedFileSpec::of("a.xyz".into()));
        match raw.map_err(|e| e.to_string())? {
            Raw {
                shape: RawShape::Points(p),
                facts,
            } => Ok((p.points, facts)),
            _ => Err("no points".to_owned()),
        }
    }

    #[test]
    fn blanks_commas_semicolons_names_and_comments_are_understood() {
        let want = [DVec3::new(1.0, 2.0, -3.5), DVec3::new(4.0, 5.0, -6.0)];
        for text in [
            "1 2 -3.5\n4\t5   -6\n",
            "# a survey\n>\n1,2,-3.5\r\n\r\n 4 , 5 , -6 \r\n",
            "1;2;-3.5\n4;5;-6",
            "z_m,y,x\n-3.5,2,1\n-6,5,4\n",
            "\u{feff}x y z name\n1 2 -3.5 a\n4 5 -6 b\n",
        ] {
            assert_eq!(read(text).unwrap().0, want, "{text}");
        }
        let (points, facts) =
            read("Latitude,Longitude,Depth (m)\n10,-20,30\n11,-21,nan\n").unwrap();
        assert_eq!(points, [DVec3::new(-20.0, 10.0, 30.0)]);
        assert!(matches!(facts.crs, Some(Crs::Geographic(_))));
        assert_eq!(facts.values.unwrap().0, HeightSign::Depth);
        assert_eq!(facts.notes, ["1 soundings without a depth were left out"]);
    }

    #[test]
    fn columns_and_units_are_those_of_the_names() {
        let want = [DVec3::new(2.0, 1.0, 3.0), DVec3::new(5.0, 4.0, 6.0)];
        for text in [
            "N,E,D\n1,2,3\n4,5,6\n",
            "# N E D\n1 2 3\n4 5 6\n",
            "# a survey\n#north_m,east_m,down_m\n1,2,3\n4,5,6\n",
        ] {
            let (points, facts) = read(text).unwrap();
            assert_eq!(points, want, "{text}");
            assert_eq!(facts.values.map(|(sign, _)| sign), Some(HeightSign::Depth));
            assert!(facts.guesses.is_empty(), "{:?}", facts.guesses);
        }
        let (points, facts) = read("# by J. Doe\n1 2 3\n4 5 6\n").unwrap();
        assert_eq!(points[0], DVec3::new(1.0, 2.0, 3.0));
        assert!(facts.guesses[0].starts_with("columns without names"));
        let units = |text: &str| read(text).map(|(_, facts)| facts.units);
        let feet = Some(units::FOOT_M);
        assert_eq!(
            units("x_ft,y_ft,depth (ft)\n1,2,3\n"),
            Ok(Units {
                horizontal_m: feet,
                vertical_m: feet
            })
        );
        assert_eq!(units("lon,lat,depth_ft\n1,2,3\n").unwrap().vertical_m, feet);
        assert!(units("x_ft,y_m,z\n1,2,3\n").is_err());
    }

    #[test]
    fn errors_name_their_line() {
        for (text, want) in [
            (
                "1 2 3\n1 2\n",
                "line 2: `1 2`: must have at least 3 columns",
            ),
            ("1 2 3\n1 2 x\n", "line 2: `x`: must be a number"),
            (
                "1 2 30000\n",
                "line 1: `30000`: must lie in -20000 ..= 20000",
            ),
            (
                "1e10 2 3\n",
                "line 1: `1e10`: must lie in -1000000000 ..= 1000000000",
            ),
            (
                "a b c\n1 2 3\n",
                "line 1: `a b c`: must name the columns x and y (or easting and northing, or lon and lat)",
            ),
            (
                "x y name\n",
                "line 1: `x y name`: must name a column depth, elevation or z",
            ),
        ] {
            assert_eq!(read(text).map(|_| ()).unwrap_err(), want);
        }
    }

    proptest::proptest! {
        #[test]
        fn any_bytes_yield_soundings_or_an_error(bytes in proptest::collection::vec(proptest::num::u8::ANY, 0..200), text in "[0-9,; .a-z#>\n-]{0,80}") {
            let spec = SeabedFileSpec::of("a.xyz".into());
            let _ = parse(&bytes, &spec);
            let _ = parse(text.as_bytes(), &spec);
        }
    }
}

//! Coordinate reference systems of seabed files: whether coordinates are degrees or metres, and the geodetic position of a point.
//!
//! Latitudes and longitudes are taken as WGS84 whatever their datum. Modern datums (NAD83, ETRS89, GDA) lie within 2 m of it, old ones (NAD27, ED50)
//! up to some 200 m away. The convergence between grid north and true north is not modelled: the columns of a projected grid are the scene's north.

use std::fmt;

use super::FormatError;
use super::format_error::refuse;
use super::units::{self, Units};
use echotank_config::spec::CrsSpec;
use echotank_core::utm;

/// Name of a system that the configuration states.
const CONFIGURED: &str = "as configured";

/// Coordinate reference system of a file.
#[derive(Clone, Debug, PartialEq)]
pub enum Crs {
    /// Metres about an origin without geodetic position.
    Local,
    /// Degrees: x is longitude, y latitude. The string is the name in the file, if any.
    Geographic(String),
    /// Universal Transverse Mercator on WGS84, or on a datum within 2 m of it, metres.
    Utm {
        /// Zone, 1 to 60.
        zone: u8,
        /// Whether the zone is on the northern hemisphere.
        north: bool,
        /// Name of the system.
        name: String,
    },
    /// Another projection, metres. Its geodetic position is not computed. The string is its name.
    Projected(String),
}

impl fmt::Display for Crs {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Local => f.write_str("local metres"),
            Self::Geographic(name) => write!(f, "geographic degrees ({name})"),
            Self::Utm { zone, north, name } => {
                let side = if *north { "north" } else { "south" };
                write!(f, "UTM zone {zone} {side}, metres ({name})")
            }
            Self::Projected(name) => write!(f, "projected metres ({name})"),
        }
    }
}

impl From<CrsSpec> for Crs {
    fn from(spec: CrsSpec) -> Self {
        match spec {
            CrsSpec::Local => Self::Local,
            CrsSpec::Geographic => Self::Geographic(CONFIGURED.to_owned()),
            CrsSpec::Projected => Self::Projected(CONFIGURED.to_owned()),
            CrsSpec::Utm { zone, north } => Self::Utm {
                zone,
                north,
                name: CONFIGURED.to_owned(),
            },
        }
    }
}

impl Crs {
    /// Whether equal coordinates mean the same position. Datums within 2 m of each other count as equal. Local systems agree with each other, and a
    /// projection that the configuration states agrees with any projection.
    pub(crate) fn agrees(&self, other: &Self) -> bool {
        match (self, other) {
            (Self::Local, Self::Local) | (Self::Geographic(_), Self::Geographic(_)) => true,
            (
                Self::Utm { zone, north, .. },
                Self::Utm {
                    zone: other_zone,
                    north: other_north,
                    ..
                },
            ) => (zone, north) == (other_zone, other_north),
            (Self::Projected(name), Self::Projected(other)) => {
                name == other || [name, other].iter().any(|n| *n == CONFIGURED)
            }
            _ => false,
        }
    }

    /// Latitude and longitude of a point of the file, radians; none for a local or unknown projected system.
    pub fn geodetic_rad(&self, x: f64, y: f64) -> Option<(f64, f64)> {
        match self {
            Self::Geographic(_) => Some((y.to_radians(), x.to_radians())),
            Self::Utm { zone, north, .. } => Some(utm::geodetic_rad(*zone, *north, x, y)),
            Self::Local | Self::Projected(_) => None,
        }
    }

    /// The system of an EPSG code. `place` is the location of the code in the file.
    pub(crate) fn from_epsg(code: u32, place: &str) -> Result<Self, FormatError> {
        let name = format!("EPSG:{code}");
        let utm = |zone: u32, north| Self::Utm {
            zone: zone as u8,
            north,
            name: name.clone(),
        };
        Ok(match code {
            32601..=32660 => utm(code - 32600, true),
            32701..=32760 => utm(code - 32700, false),
            // NAD83, ETRS89, GDA94 and GDA2020.
            26901..=26923 => utm(code - 26900, true),
            25828..=25838 => utm(code - 25800, true),
            28348..=28358 => utm(code - 28300, false),
            7846..=7859 => utm(code - 7800, false),
            // NAD83(2011).
            6330..=6348 => utm(code - 6329, true),
            3857 | 900_913 | 3395 => {
                return refuse(
                    place,
                    &name,
                    "is a Mercator projection, whose metres are not metres on the ground: project the file to UTM first",
                );
            }
            4326 => Self::Geographic("EPSG:4326, WGS 84".to_owned()),
            4001..=4977 | 4979..=4999 | 6318..=6326 | 7844 => Self::Geographic(name),
            1024..=32_766 => Self::Projected(name),
            _ => {
                return refuse(
                    place,
                    &name,
                    "must be a projected or geographic system of the EPSG register (1024 to 32766)",
                );
            }
        })
    }

    /// The system of a well-known text (OGC 01-009, OGC 18-010) and its units of length. Name and units are read.
    pub(crate) fn from_wkt(text: &str, place: &str) -> Result<(Self, Units), FormatError> {
        let text = text.trim().trim_end_matches('\0').trim();
        let keyword: String = text
            .chars()
            .take_while(|c| c.is_ascii_alphanumeric() || *c == '_')
            .collect::<String>()
            .to_ascii_uppercase();
        let name = text.split('"').nth(1).unwrap_or("unnamed").to_owned();
        match keyword.as_str() {
            "COMPD_CS" | "COMPOUNDCRS" => {
                // The horizontal part comes first.
                let inner = ["PROJCS[", "PROJCRS[", "GEOGCS[", "GEOGCRS["];
                let Some(at) = inner.iter().filter_map(|k| text.find(k)).min() else {
                    return refuse(place, &name, "must hold a horizontal system");
                };
                let (crs, mut units) = Self::from_wkt(&text[at..], place)?;
                let vertical = ["VERT_CS[", "VERTCRS[", "VERTICALCRS["];
                let vertical = vertical.iter().filter_map(|k| text.find(k)).min();
                units.vertical_m = vertical.and_then(|at| linear_unit_m(bracketed(&text[at..])));
                Ok((crs, units))
            }
            "GEOGCS" | "GEOGCRS" | "GEODCRS" => Ok((Self::Geographic(name), Units::default())),
            "PROJCS" | "PROJCRS" => {
                let units = Units {
                    horizontal_m: linear_unit_m(bracketed(text)),
                    vertical_m: None,
                };
                if name.to_ascii_lowercase().contains("mercator")
                    && !name.to_ascii_lowercase().contains("transverse")
                {
                    let rule = "is a Mercator projection, whose metres are not metres on the ground: project the file to UTM first";
                    return refuse(place, &name, rule);
                }
                let crs = match utm_in_name(&name) {
                    Some((zone, north)) => Self::Utm { zone, north, name },
                    None => Self::Projected(name),
                };
                Ok((crs, units))
            }
            _ => refuse(
                place,
                text.chars().take(40).collect::<String>(),
                "must be well-known text of a projected or geographic system",
            ),
        }
    }
}

/// The unit of a projected system whose code alone is given: the State Plane systems of NAD83 in feet (EPSG 2222 to 2289).
pub(crate) fn unit_of_epsg_system(code: u32) -> Option<f64> {
    match code {
        2222..=2224 | 2251..=2253 | 2256 | 2265 | 2266 | 2269 | 2270 | 2273 | 2280..=2282 => {
            Some(units::FOOT_M)
        }
        2225..=2289 => Some(units::SURVEY_FOOT_M),
        _ => match Crs::from_epsg(code, "") {
            Ok(Crs::Utm { .. }) => Some(1.0),
            _ => None,
        },
    }
}

/// The beginning of a text up to the bracket that closes its first one.
fn bracketed(text: &str) -> &str {
    let mut depth = 0_usize;
    let mut quoted = false;
    for (at, c) in text.char_indices() {
        match c {
            '"' => quoted = !quoted,
            '[' if !quoted => depth += 1,
            ']' if !quoted => {
                depth = depth.saturating_sub(1);
                if depth == 0 {
                    return &text[..=at];
                }
            }
            _ => {}
        }
    }
    text
}

/// Zone and hemisphere in a name such as "WGS 84 / UTM zone 20N" or "NAD_1983_UTM_Zone_20S".
fn utm_in_name(name: &str) -> Option<(u8, bool)> {
    let plain: String = name
        .to_ascii_lowercase()
        .chars()
        .filter(char::is_ascii_alphanumeric)
        .collect();
    let modern = !(plain.contains("1927") || plain.contains("nad27") || plain.contains("ed50"));
    let after = plain.split("utmzone").nth(1).filter(|_| modern)?;
    let digits: String = after.chars().take_while(char::is_ascii_digit).collect();
    let zone: u8 = digits.parse().ok().filter(|z| (1..=60).contains(z))?;
    match after[digits.len()..].chars().next() {
        Some('n') => Some((zone, true)),
        Some('s') => Some((zone, false)),
        _ => None,
    }
}

/// Size of the linear unit of a projected or vertical system, metres: that of its last UNIT or LENGTHUNIT.
fn linear_unit_m(text: &str) -> Option<f64> {
    let at = text.rfind("LENGTHUNIT[").or_else(|| text.rfind("UNIT["))?;
    let number: String = text[at..]
        .split(',')
        .nth(1)?
        .trim()
        .chars()
        .take_while(|c| c.is_ascii_digit() || matches!(c, '.' | 'e' | 'E' | '-' | '+'))
        .collect();
    number.parse().ok()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn epsg_codes_are_recognised_by_their_ranges() {
        let of = |code| Crs::from_epsg(code, "here").unwrap();
        for (code, want) in [
            (32602, (2, true)),
            (32760, (60, false)),
            (26920, (20, true)),
            (7856, (56, false)),
        ] {
            let Crs::Utm { zone, north, .. } = of(code) else {
                panic!("{code} is a UTM zone");
            };
            assert_eq!((zone, north), want, "{code}");
        }
        assert!(matches!(of(4326), Crs::Geographic(_)));
        assert_eq!(of(32161), Crs::Projected("EPSG:32161".to_owned()));
        let message = Crs::from_epsg(3857, "GeoKey 3072").unwrap_err().to_string();
        assert_eq!(
            message,
            "GeoKey 3072: `EPSG:3857`: is a Mercator projection, whose metres are not metres on the ground: project the file to UTM first"
        );
        assert!(Crs::from_epsg(7, "here").is_err());
    }

    #[test]
    fn well_known_text_gives_zone_and_unit() {
        let utm = r#"PROJCS["NAD83 / UTM zone 19N",GEOGCS["NAD83",DATUM["North_American_Datum_1983",SPHEROID["GRS 1980",6378137,298.257222101]],UNIT["degree",0.0174532925199433]],PROJECTION["Transverse_Mercator"],UNIT["metre",1,AUTHORITY["EPSG","9001"]]]"#;
        assert!(matches!(
            Crs::from_wkt(utm, "metadata").unwrap().0,
            Crs::Utm {
                zone: 19,
                north: true,
                ..
            }
        ));
        let foot = r#"UNIT["US survey foot",0.304800609601219]"#;
        let compound = format!(r#"COMPD_CS["both",{utm},VERT_CS["MLLW",{foot}]]"#);
        let (crs, units) = Crs::from_wkt(&compound, "").unwrap();
        assert!(matches!(crs, Crs::Utm { zone: 19, .. }));
        assert_eq!(units.horizontal_m, Some(1.0));
        assert_eq!(units.vertical_m, Some(0.304800609601219));
        let feet = utm.replace(
            r#"UNIT["metre",1"#,
            r#"UNIT["US survey foot",0.304800609601219"#,
        );
        let (_, units) = Crs::from_wkt(&feet, "metadata").unwrap();
        assert_eq!(units.horizontal_m, Some(0.304800609601219));
        let (crs, units) = Crs::from_wkt(r#"GEOGCS["WGS 84",UNIT["degree",0.01745]]"#, "").unwrap();
        assert_eq!(crs, Crs::Geographic("WGS 84".to_owned()));
        assert_eq!(units, Units::default());
        for text in ["", "nonsense", "PROJCS", "PROJCS[", "COMPD_CS[\"a\""] {
            let _ = Crs::from_wkt(text, "");
        }
    }
}

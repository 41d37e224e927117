//! Small files of all formats, and functions that corrupt them. Used by the tests and by `tools/fuzz`.

use std::io::Cursor;
use std::path::PathBuf;

use echotank_config::spec::SeabedFileSpec;
use echotank_scene::read::Survey;
use echotank_scene::read::mesh::{self, MeshAxes};

pub struct Seed {
    /// Name of the file. The extension distinguishes formats without a signature.
    pub name: &'static str,
    pub bytes: Vec<u8>,
}

impl Seed {
    fn new(name: &'static str, bytes: impl Into<Vec<u8>>) -> Self {
        Self {
            name,
            bytes: bytes.into(),
        }
    }
}

pub fn data(name: &str) -> PathBuf {
    crate::repository().join("tests/data/bathy").join(name)
}

/// Small files, and a real GeoTIFF.
pub fn small() -> Vec<Seed> {
    let reef = std::fs::read(data("laparguera_hitw_bathy.tif")).expect("the GeoTIFF");
    vec![
        Seed::new("grid.asc", ascii()),
        Seed::new("degrees.asc", degrees()),
        Seed::new("soundings.xyz", xyz()),
        Seed::new("reef.tif", reef),
        Seed::new("plain.tif", Tiff::default().bytes()),
        Seed::new("points.las", las()),
        Seed::new("points.ply", ply_points()),
        Seed::new("mesh.ply", ply_mesh()),
        Seed::new("mesh.obj", OBJ),
        Seed::new("mesh.stl", stl()),
        Seed::new("text.stl", STL_TEXT),
    ]
}

pub fn bag() -> Seed {
    let bytes = std::fs::read(data("JD211_public_Release_1-4_UTM.bag")).expect("the BAG");
    Seed::new("survey.bag", bytes)
}

/// Opens bytes in the format of the file name.
pub fn open(name: &str, bytes: Vec<u8>) -> Result<(), String> {
    let extension = name.rsplit('.').next().unwrap_or("");
    if ["obj", "stl"].contains(&extension) {
        let mesh =
            mesh::parse(bytes, extension, MeshAxes::EastNorthUp).map_err(|e| e.to_string())?;
        let vertices = mesh.vertices_m.len();
        assert!(
            mesh.triangles
                .iter()
                .flatten()
                .all(|i| (*i as usize) < vertices)
        );
        assert!(mesh.vertices_m.iter().all(|v| v.is_finite()));
        return Ok(());
    }
    let survey =
        Survey::parse(bytes, &SeabedFileSpec::of(name.into())).map_err(|e| e.to_string())?;
    let field = &survey.field;
    assert_eq!(field.down_m.len(), field.rows * field.cols);
    assert!(field.rows >= 2 && field.cols >= 2);
    assert!(field.cell_north_m > 0.0 && field.cell_east_m > 0.0);
    assert!(
        field
            .down_m
            .iter()
            .all(|d| d.is_nan() || d.abs() <= 20_000.0)
    );
    Ok(())
}

/// Reproducible random numbers (xorshift64, Marsaglia 2003).
pub struct Random(pub u64);

impl Random {
    pub fn below(&mut self, limit: usize) -> usize {
        self.0 ^= self.0 << 13;
        self.0 ^= self.0 >> 7;
        self.0 ^= self.0 << 17;
        (self.0 % limit.max(1) as u64) as usize
    }
}

/// Copy with bytes removed, changed, duplicated or inserted, mostly near the front with the headers.
pub fn spoiled(bytes: &[u8], random: &mut Random) -> Vec<u8> {
    let mut bytes = bytes.to_vec();
    for _ in 0..1 + random.below(6) {
        let reach = match random.below(3) {
            0 => bytes.len().min(512),
            1 => bytes.len().min(16_384),
            _ => bytes.len(),
        };
        let at = random.below(reach);
        if bytes.is_empty() {
            break;
        }
        match random.below(8) {
            0 => bytes.truncate(at),
            1 => bytes[at] ^= 1 << random.below(8),
            2 => bytes[at] = [0, 0xff, 0x7f, 0x80, b'0', b'9', b'-', b'e'][random.below(8)],
            3 => {
                // A four-byte integer becomes a very large number.
                for k in 0..4.min(bytes.len() - at) {
                    bytes[at + k] = 0xff;
                }
            }
            4 => {
                let end = (at + random.below(64)).min(bytes.len());
                bytes.drain(at..end);
            }
            5 => {
                let end = (at + random.below(64)).min(bytes.len());
                let twice = bytes[at..end].to_vec();
                bytes.splice(at..at, twice);
            }
            _ => bytes[at] = random.below(256) as u8,
        }
    }
    bytes
}

pub fn ascii() -> String {
    let mut text =
        "ncols 9\nnrows 7\nxllcorner 1000\nyllcorner 2000\ncellsize 5\nNODATA_value -99\n"
            .to_owned();
    for row in 0..7 {
        for col in 0..9 {
            let hole = (row, col) == (3, 4);
            let down = 40.0 + f64::from(row) * 0.5 - f64::from(col) * 0.25;
            text += &if hole {
                "-99 ".to_owned()
            } else {
                format!("{} ", -down)
            };
        }
        text += "\n";
    }
    text
}

/// Grid of 0.001 degrees around 10 east, 54 north: down = 20 + 1000 (lat - 54) - 500 (lon - 10).
pub fn degrees() -> String {
    let mut text =
        "ncols 21\nnrows 31\nxllcenter 9.99\nyllcenter 53.985\ncellsize 0.001\n".to_owned();
    for row in (0..31).rev() {
        for col in 0..21 {
            let (lat, lon) = (
                53.985 + f64::from(row) * 0.001,
                9.99 + f64::from(col) * 0.001,
            );
            text += &format!(
                "{:.6} ",
                -(20.0 + 1000.0 * (lat - 54.0) - 500.0 * (lon - 10.0))
            );
        }
    }
    text
}

pub fn xyz() -> String {
    (0..60)
        .map(|k| {
            let k = f64::from(k);
            let (x, y) = (
                (k * 0.618_034).fract() * 100.0,
                (k * 0.754_878).fract() * 80.0,
            );
            format!("{x:.3} {y:.3} {:.3}\n", -30.0 - 0.1 * x)
        })
        .collect()
}

/// Corners of a square pyramid, with its base at z = -2 and its top at z = 1.
pub const PYRAMID: [[f64; 3]; 5] = [
    [0.0, 0.0, -2.0],
    [4.0, 0.0, -2.0],
    [4.0, 6.0, -2.0],
    [0.0, 6.0, -2.0],
    [2.0, 3.0, 1.0],
];

pub fn ply_points() -> String {
    let mut text = "ply\nformat ascii 1.0\ncomment soundings\nelement vertex 40\nproperty double x\nproperty double y\nproperty uchar red\nproperty double z\nend_header\n".to_owned();
    for k in 0..40 {
        let k = f64::from(k);
        let (x, y) = (
            (k * 0.618_034).fract() * 50.0,
            (k * 0.754_878).fract() * 50.0,
        );
        text += &format!("{x:.3} {y:.3} 7 {:.3}\n", -12.0 + 0.02 * y);
    }
    text
}

/// Binary PLY mesh with four sides and a four-cornered base.
pub fn ply_mesh() -> Vec<u8> {
    let mut bytes = b"ply\nformat binary_little_endian 1.0\nelement vertex 5\nproperty float x\nproperty float y\nproperty float z\nelement face 5\nproperty list uchar int vertex_indices\nend_header\n".to_vec();
    for v in PYRAMID {
        for c in v {
            bytes.extend((c as f32).to_le_bytes());
        }
    }
    let faces: [&[i32]; 5] = [
        &[0, 1, 4],
        &[1, 2, 4],
        &[2, 3, 4],
        &[3, 0, 4],
        &[0, 3, 2, 1],
    ];
    for face in faces {
        bytes.push(face.len() as u8);
        for i in face {
            bytes.extend(i.to_le_bytes());
        }
    }
    bytes
}

pub const OBJ: &str = "# a pyramid\nmtllib none.mtl\no pyramid\nv 0 0 -2\nv 4 0 -2\nv 4 6 -2\nv 0 6 -2\nv 2 3 1\nvn 0 0 1\nf 1//1 2//1 5//1\nf 2 3 5\nf 3 4 5\nf 4 1 5\nf 1 4 3 2\n";

const STL_TEXT: &str = "solid one\nfacet normal 0 0 1\nouter loop\nvertex 0 0 0\nvertex 1 0 0\nvertex 0 1 0\nendloop\nendfacet\nendsolid one\n";

pub fn stl() -> Vec<u8> {
    let faces = [
        [0, 1, 4],
        [1, 2, 4],
        [2, 3, 4],
        [3, 0, 4],
        [0, 3, 2],
        [0, 2, 1],
    ];
    // The file begins like the text form, as from some programs.
    let mut bytes = b"solid by a writer of binaries".to_vec();
    bytes.resize(80, b' ');
    bytes.extend((faces.len() as u32).to_le_bytes());
    for face in faces {
        bytes.extend([0_u8; 12]);
        for i in face {
            for c in PYRAMID[i] {
                bytes.extend((c as f32).to_le_bytes());
            }
        }
        bytes.extend([0_u8; 2]);
    }
    bytes
}

/// LAS file of 200 points. Every twentieth point is noise at z = 500.
pub fn las() -> Vec<u8> {
    las_with(&[])
}

/// As [`las()`], with a directory of these GeoKeys, all of short values.
pub fn las_with(keys: &[(u16, u16)]) -> Vec<u8> {
    let mut builder = las::Builder::from((1, 2));
    if !keys.is_empty() {
        builder.vlrs.push(las::Vlr {
            user_id: "LASF_Projection".to_owned(),
            record_id: 34735,
            data: geo_keys(keys)
                .iter()
                .flat_map(|k| k.to_le_bytes())
                .collect(),
            ..las::Vlr::default()
        });
    }
    let transform = |offset| las::Transform {
        scale: 0.001,
        offset,
    };
    builder.transforms = las::Vector {
        x: transform(500_000.0),
        y: transform(6_000_000.0),
        z: transform(0.0),
    };
    let header = builder.into_header().expect("LAS header");
    let mut writer = las::Writer::new(Cursor::new(Vec::new()), header).expect("LAS writer");
    for k in 0..200 {
        let f = f64::from(k);
        let noise = k % 20 == 7;
        let class = if noise { 7 } else { 2 };
        let mut point = las::Point {
            x: 500_000.0 + (f * 0.618_034).fract() * 90.0,
            y: 6_000_000.0 + (f * 0.754_878).fract() * 60.0,
            z: if noise { 500.0 } else { -25.0 },
            ..las::Point::default()
        };
        point.classification = las::point::Classification::new(class).expect("a class");
        writer.write_point(point).expect("LAS point");
    }
    writer.close().expect("LAS file");
    writer.into_inner().expect("LAS bytes").into_inner()
}

fn geo_keys(keys: &[(u16, u16)]) -> Vec<u16> {
    let head = [1_u16, 1, 0, keys.len() as u16];
    let entries = keys.iter().flat_map(|(key, value)| [*key, 0, 1, *value]);
    head.into_iter().chain(entries).collect()
}

/// Type, count and bytes of the value of a tag.
type Value = (u16, u32, Vec<u8>);

/// Plain TIFF of one strip with explicit tags.
pub struct Tiff {
    pub width: u32,
    pub height: u32,
    pub scale: Option<[f64; 3]>,
    pub tie: [f64; 6],
    pub transformation: Option<[f64; 16]>,
    /// Keys and values of the GeoKeys with short values.
    pub keys: Vec<(u16, u16)>,
    /// Metadata of GDAL.
    pub metadata: Option<&'static str>,
    pub nodata: Option<&'static str>,
    pub compression: u16,
    pub cells: Vec<f32>,
}

impl Default for Tiff {
    /// 4 columns and 3 rows of 10 m cells. The northern row is -1 -2 -3 -4.
    fn default() -> Self {
        Self {
            width: 4,
            height: 3,
            scale: Some([10.0, 10.0, 0.0]),
            tie: [0.0, 0.0, 0.0, 500_000.0, 6_000_000.0, 0.0],
            transformation: None,
            keys: vec![(1024, 1), (1025, 1), (3072, 32632)],
            metadata: None,
            nodata: None,
            compression: 1,
            cells: (1..=12).map(|k| -(k as f32)).collect(),
        }
    }
}

impl Tiff {
    pub fn bytes(&self) -> Vec<u8> {
        const SHORT: u16 = 3;
        const LONG: u16 = 4;
        const DOUBLE: u16 = 12;
        const ASCII: u16 = 2;
        let long = |v: u32| (LONG, 1, v.to_le_bytes().to_vec());
        let short = |v: u16| (SHORT, 1, v.to_le_bytes().to_vec());
        let doubles = |v: &[f64]| {
            let bytes = v.iter().flat_map(|x| x.to_le_bytes()).collect();
            (DOUBLE, v.len() as u32, bytes)
        };
        let strip: Vec<u8> = self.cells.iter().flat_map(|c| c.to_le_bytes()).collect();
        let mut tags: Vec<(u16, Value)> = vec![
            (256, long(self.width)),
            (257, long(self.height)),
            (258, short(32)),
            (259, short(self.compression)),
            (262, short(1)),
            (273, long(8)),
            (277, short(1)),
            (278, long(self.height)),
            (279, long(strip.len() as u32)),
            (339, short(3)),
        ];
        if let Some(scale) = &self.scale {
            tags.push((33550, doubles(scale)));
            tags.push((33922, doubles(&self.tie)));
        }
        if let Some(m) = &self.transformation {
            tags.push((34264, doubles(m)));
        }
        if !self.keys.is_empty() {
            let keys = geo_keys(&self.keys);
            let bytes: Vec<u8> = keys.iter().flat_map(|k| k.to_le_bytes()).collect();
            tags.push((34735, (SHORT, keys.len() as u32, bytes)));
        }
        for (tag, text) in [(42112, self.metadata), (42113, self.nodata)] {
            if let Some(text) = text {
                let bytes = [text.as_bytes(), b"\0"].concat();
                tags.push((tag, (ASCII, bytes.len() as u32, bytes)));
            }
        }
        let directory = 8 + strip.len();
        let mut tail = directory + 2 + 12 * tags.len() + 4;
        let mut bytes = b"II*\0".to_vec();
        bytes.extend((directory as u32).to_le_bytes());
        bytes.extend(strip);
        bytes.extend((tags.len() as u16).to_le_bytes());
        let mut rest = Vec::new();
        for (tag, (kind, count, value)) in tags {
            bytes.extend(tag.to_le_bytes());
            bytes.extend(kind.to_le_bytes());
            bytes.extend(count.to_le_bytes());
            if value.len() <= 4 {
                let mut inline = value;
                inline.resize(4, 0);
                bytes.extend(inline);
            } else {
                bytes.extend((tail as u32).to_le_bytes());
                tail += value.len();
                rest.extend(value);
            }
        }
        bytes.extend([0_u8; 4]);
        bytes.extend(rest);
        bytes
    }
}

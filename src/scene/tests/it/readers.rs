//! Seabeds and models of every format: detected properties, depths against an independent read, and refusals.

use std::path::PathBuf;

use echotank_config::spec::{CrsSpec, FirstRow, HeightSign, SeabedFileSpec};
use echotank_core::geodesy::LocalTangentPlane;
use echotank_runtime::io::files::FileSystem;
use echotank_scene::read::mesh::{self, MeshAxes};
use echotank_scene::read::survey::{Layout, Source};
use echotank_scene::read::{Crs, Survey, TriangleMesh};
use echotank_testing::seeds::{self, Random, Tiff, data};
use glam::DVec3;

fn survey(name: &str, bytes: impl Into<Vec<u8>>) -> Result<Survey, String> {
    Survey::parse(bytes.into(), &SeabedFileSpec::of(name.into())).map_err(|e| e.to_string())
}

fn refusal(name: &str, bytes: impl Into<Vec<u8>>) -> String {
    match survey(name, bytes) {
        Ok(s) => format!("read as {}", s.format),
        Err(said) => said,
    }
}

fn opened(path: PathBuf) -> Survey {
    Survey::open(&FileSystem, &SeabedFileSpec::of(path)).unwrap_or_else(|e| panic!("{e}"))
}

/// Northing (or latitude), easting (or longitude) and depth, by h5py, tifffile and numpy; drawn at random from the filled cells.
fn hold(survey: &Survey, places: &[(f64, f64, f64)], tolerance_m: f64) {
    for (y, x, want) in places {
        let got = survey.at(*x, *y).down_m.unwrap_or(f64::NAN);
        assert!(
            (got - want).abs() <= tolerance_m,
            "{} at {y},{x}: got {got}, want {want}",
            survey.format
        );
    }
}

#[test]
fn the_bag_is_as_h5py_reads_it_to_the_bit() {
    let s = opened(data("JD211_public_Release_1-4_UTM.bag"));
    assert_eq!(s.format, "BAG");
    assert_eq!(
        s.crs,
        Crs::Utm {
            zone: 2,
            north: true,
            name: "WGS84".to_owned()
        }
    );
    assert!(matches!(s.crs_source, Source::Stated(_)));
    assert_eq!(s.sign, HeightSign::Elevation);
    assert!(matches!(
        s.layout,
        Layout::Grid {
            rows: 1478,
            cols: 1707,
            first_row: FirstRow::South,
            from_corners: false,
            ..
        }
    ));
    let holes = s.field.down_m.iter().filter(|d| d.is_nan()).count();
    assert_eq!(holes, 1_365_640);
    let ends = s.field.percentiles_m(&[0.0, 1.0]);
    assert_eq!(ends, [50.987003326416016, 52.95700454711914]);
    hold(
        &s,
        &[
            (7245343.911727688, 622141.872885373, 51.56500244140625),
            (7245823.911727688, 622279.872885373, 52.009002685546875),
            (7245593.911727688, 622533.872885373, 52.038002014160156),
            (7245693.911727688, 621943.872885373, 51.625003814697266),
            (7245267.911727688, 620573.872885373, 52.2400016784668),
            (7244815.911727688, 620535.872885373, 52.22500228881836),
            (7245951.911727688, 622497.872885373, 52.17100143432617),
            (7244331.911727688, 620689.872885373, 52.12400436401367),
            (7244693.911727688, 623325.872885373, 52.073001861572266),
            (7245441.911727688, 621867.872885373, 51.62900161743164),
        ],
        0.0,
    );
    // Its metadata name its bounding box.
    let (lat, lon) = s.zero_geodetic_rad().expect("UTM has a place");
    let (lat, lon) = (lat.to_degrees(), lon.to_degrees());
    assert!(
        (65.29..65.32).contains(&lat) && (-168.43..-168.34).contains(&lon),
        "{lat} {lon}"
    );
    assert!(
        s.notes
            .iter()
            .any(|n| n.starts_with("vertical uncertainty 0.270 to 0.664 m")),
        "{:?}",
        s.notes
    );
}

#[test]
fn the_geotiff_is_as_tifffile_reads_it_to_the_bit() {
    let s = opened(data("laparguera_hitw_bathy.tif"));
    assert_eq!(s.crs, Crs::Projected("EPSG:32161".to_owned()));
    assert_eq!(s.sign, HeightSign::Elevation);
    assert!(matches!(
        s.layout,
        Layout::Grid {
            rows: 75,
            cols: 75,
            first_row: FirstRow::North,
            from_corners: true,
            ..
        }
    ));
    assert_eq!(s.zero_geodetic_rad(), None);
    let ends = s.field.percentiles_m(&[0.0, 1.0]);
    assert_eq!(ends, [16.6314754486084, 268.9530944824219]);
    hold(
        &s,
        &[
            (205732.37450969967, 137484.22769317782, 51.93876266479492),
            (205836.28983330328, 137520.19838211752, 17.585355758666992),
            (205680.41684789787, 137684.06485395398, 182.38287353515625),
            (205668.4266182513, 137504.21140925543, 170.1570587158203),
            (205888.24749510508, 137552.17232784172, 19.940935134887695),
            (205724.38102326862, 137588.14301678143, 78.8495101928711),
            (205692.40707754443, 137652.0909082298, 154.96531677246094),
            (205672.42336146682, 137732.02577254028, 195.67884826660156),
            (205732.37450969967, 137732.02577254028, 67.27593994140625),
            (205804.31588757908, 137752.00948861788, 19.340925216674805),
        ],
        0.0,
    );
}

#[test]
fn the_ascii_grid_is_as_numpy_reads_it_to_its_last_decimal() {
    let folder = echotank_testing::repository().join("hil-configs/data");
    let s = opened(folder.join("jd211_crop_400x400_2m.asc"));
    assert!(matches!(
        (&s.crs, &s.crs_source),
        (Crs::Local, Source::Guessed(_))
    ));
    let places = [
        (7244835.912, 622521.873, 51.663),
        (7245235.912, 621823.873, 51.332),
        (7244779.912, 622273.873, 51.556),
        (7245429.912, 622591.873, 51.985),
        (7245117.912, 622199.873, 51.492),
        (7244873.912, 621879.873, 51.563),
        (7244917.912, 621909.873, 51.286),
        (7245535.912, 622263.873, 52.017),
        (7245017.912, 622135.873, 51.564),
        (7245421.912, 621831.873, 51.614),
    ];
    // Half the last decimal is 0.5 mm; f32 adds 2 um.
    hold(&s, &places, 4e-6);
    // The same cells of the survey that it was cut from.
    hold(
        &opened(data("JD211_public_Release_1-4_UTM.bag")),
        &places,
        0.51e-3,
    );
}

#[test]
fn the_soundings_are_as_numpy_reads_them() {
    let s = opened(data("gmt_tut_ship.xyz"));
    assert!(matches!(
        (&s.crs, &s.crs_source),
        (Crs::Geographic(_), Source::Guessed(_))
    ));
    assert!(matches!(
        (s.sign, &s.sign_source),
        (HeightSign::Elevation, Source::Guessed(_))
    ));
    assert!(matches!(
        s.layout,
        Layout::Points {
            count: 80_983,
            merged: 1987,
            ..
        }
    ));
    hold(
        &s,
        &[
            (26.30769, 249.66752, 1296.0),
            (20.67591, 250.68385, 2716.0),
            (22.39658, 249.49565, 3061.0),
            (21.7863, 254.15248, 43.0),
            (21.90946, 247.63027, 3342.0),
            (25.89551, 245.96791, 3133.0),
            (24.50677, 247.44407, 677.0),
            (21.04111, 248.5643, 3273.0),
            (26.72531, 245.10116, 3658.0),
            (22.46355, 248.97482, 3191.0),
        ],
        0.0,
    );
}

// ---------------------------------------------------------------- small files of every format

#[test]
fn corners_points_rows_and_holes_of_a_geotiff_are_put_where_its_tags_say() {
    let area = survey("a.tif", Tiff::default().bytes()).unwrap();
    assert!(matches!(
        area.crs,
        Crs::Utm {
            zone: 32,
            north: true,
            ..
        }
    ));
    // The first pixel is north-western; its corner is the tie point.
    assert_eq!(area.at(500_005.0, 5_999_995.0).down_m, Some(1.0));
    assert_eq!(area.at(500_035.0, 5_999_975.0).down_m, Some(12.0));
    assert_eq!(
        area.covers,
        [500_005.0, 5_999_975.0, 500_035.0, 5_999_995.0]
    );
    assert_eq!(area.at(500_000.0 - 0.1, 5_999_995.0).cell, None, "outside");

    let point = Tiff {
        keys: vec![(1024, 1), (1025, 2), (3072, 32632)],
        nodata: Some("-7"),
        ..Tiff::default()
    };
    let point = survey("a.tif", point.bytes()).unwrap();
    assert_eq!(point.at(500_000.0, 6_000_000.0).down_m, Some(1.0));
    assert_eq!(point.at(500_020.0, 5_999_990.0).down_m, None, "a hole");
    assert_eq!(point.field.hole_share(), 1.0 / 12.0);

    // South-up, by a transformation whose rows run north.
    let mut m = [0.0; 16];
    (m[0], m[3], m[5], m[7]) = (10.0, 500_000.0, 20.0, 6_000_000.0);
    let south = Tiff {
        scale: None,
        transformation: Some(m),
        ..Tiff::default()
    };
    let south = survey("a.tif", south.bytes()).unwrap();
    assert_eq!(south.at(500_005.0, 6_000_010.0).down_m, Some(1.0));
    assert_eq!(south.at(500_035.0, 6_000_050.0).down_m, Some(12.0));
    assert_eq!(
        (south.field.cell_north_m, south.field.cell_east_m),
        (20.0, 10.0)
    );
}

#[test]
fn a_grid_of_degrees_becomes_metres_about_its_middle() {
    let s = survey("degrees.asc", seeds::degrees()).unwrap();
    assert!(matches!(
        (&s.crs, &s.crs_source),
        (Crs::Geographic(_), Source::Guessed(_))
    ));
    assert!((s.zero[0] - 10.0).abs() < 1e-9 && (s.zero[1] - 54.0).abs() < 1e-9);
    let plane = LocalTangentPlane::new(s.zero[1].to_radians(), s.zero[0].to_radians());
    let mut worst_m = 0.0_f64;
    for (north_m, east_m) in [
        (0.0, 0.0),
        (1200.0, 300.0),
        (-1500.0, -500.0),
        (733.0, -580.0),
    ] {
        let (lat, lon) = plane.geodetic_rad(north_m, east_m);
        let want = 20.0 + 1000.0 * (lat.to_degrees() - 54.0) - 500.0 * (lon.to_degrees() - 10.0);
        let got = s.field.sample(north_m, east_m).expect("inside").down_m;
        worst_m = worst_m.max((got - want).abs());
    }
    // The plane of the test is bent by 1e-4 m over a cell of the plane on the earth; six decimals and f32 add 2e-6.
    assert!(worst_m < 2e-4, "{worst_m} m");
    // At a cell of the file its own value is returned.
    assert!((s.at(9.995, 53.99).down_m.unwrap() - 12.5).abs() < 1e-6);
}

#[test]
fn points_of_las_and_ply_become_a_surface_and_noise_is_left_out() {
    let las = survey("a.las", seeds::las()).unwrap();
    assert_eq!(las.format, "LAS points");
    assert!(
        matches!(las.layout, Layout::Points { count: 190, .. }),
        "{:?}",
        las.layout
    );
    assert_eq!(las.notes, ["10 points classed as noise were left out"]);
    let filled: Vec<f32> = las
        .field
        .down_m
        .iter()
        .copied()
        .filter(|d| !d.is_nan())
        .collect();
    assert!(filled.len() > 100 && filled.iter().all(|d| *d == 25.0));

    let ply = survey("a.ply", seeds::ply_points()).unwrap();
    assert!(matches!(
        ply.layout,
        Layout::Points {
            count: 40,
            own_triangles: false,
            ..
        }
    ));
    let got = ply.at(25.0, 25.0).down_m.expect("inside");
    assert!((got - 11.5).abs() < 1e-3, "{got}");

    let mesh = survey("mesh.ply", seeds::ply_mesh()).unwrap();
    assert!(matches!(
        mesh.layout,
        Layout::Points {
            count: 5,
            triangles: 6,
            own_triangles: true,
            ..
        }
    ));
}

#[test]
fn meshes_of_all_formats_are_the_same_pyramid() {
    let read = |bytes: Vec<u8>, extension| -> TriangleMesh {
        mesh::parse(bytes, extension, MeshAxes::EastNorthUp).unwrap_or_else(|e| panic!("{e}"))
    };
    // Sides of 5 x 4 and 3.6056 x 6 (base times slant height), halved, twice each; and a base of 4 x 6.
    let area_m2 = 4.0 * 18.0_f64.sqrt() + 6.0 * 13.0_f64.sqrt() + 24.0;
    for mesh in [
        read(seeds::OBJ.into(), "obj"),
        read(seeds::stl(), "STL"),
        read(seeds::ply_mesh(), "ply"),
    ] {
        assert_eq!((mesh.vertices_m.len(), mesh.triangles.len()), (5, 6));
        assert!(
            (mesh.area_m2() - area_m2).abs() < 1e-9,
            "{}",
            mesh.area_m2()
        );
        let top = mesh
            .vertices_m
            .iter()
            .min_by(|a, b| a.z.total_cmp(&b.z))
            .unwrap();
        assert_eq!(*top, DVec3::new(3.0, 2.0, -1.0), "north, east, down");
        // Triangles are oriented outwards: the volume is positive.
        let volume_m3: f64 = mesh
            .triangles
            .iter()
            .map(|t| {
                let [a, b, c] = t.map(|i| mesh.vertices_m[i as usize]);
                a.dot(b.cross(c)) / 6.0
            })
            .sum();
        assert!((volume_m3 - 24.0).abs() < 1e-9, "{volume_m3}");
    }
    // The top, (2, 3, 1) in the file.
    for (axes, top) in [
        (MeshAxes::NorthEastDown, DVec3::new(2.0, 3.0, 1.0)),
        (MeshAxes::EastUpSouth, DVec3::new(-1.0, 2.0, -3.0)),
    ] {
        let mesh = mesh::parse(seeds::OBJ.into(), "obj", axes).unwrap();
        assert!(
            mesh.vertices_m.contains(&top),
            "{axes:?}: {:?}",
            mesh.vertices_m
        );
    }
}

#[test]
fn the_configuration_overrides_what_a_file_says() {
    let asked = |change: fn(&mut SeabedFileSpec)| {
        let mut asked = SeabedFileSpec::of("grid.asc".into());
        change(&mut asked);
        Survey::parse(seeds::ascii().into(), &asked).unwrap_or_else(|e| panic!("{e}"))
    };
    let plain = asked(|_| {});
    // The corner form: the south-western cell's centre lies half a cell inside.
    assert_eq!(plain.at(1002.5, 2002.5).down_m, Some(43.0));
    assert_eq!(plain.at(1002.5, 2032.5).down_m, Some(40.0));
    let turned = asked(|a| a.first_row = Some(FirstRow::South));
    assert_eq!(turned.at(1002.5, 2002.5).down_m, Some(40.0));
    assert_eq!(
        asked(|a| a.values = Some(HeightSign::Depth))
            .at(1002.5, 2002.5)
            .down_m,
        Some(-43.0)
    );
    assert_eq!(
        asked(|a| a.nodata = Some(-43.0)).at(1002.5, 2002.5).down_m,
        None
    );
    let utm = asked(|a| {
        a.crs = Some(CrsSpec::Utm {
            zone: 31,
            north: true,
        })
    });
    assert!(utm.zero_geodetic_rad().is_some() && plain.zero_geodetic_rad().is_none());
    let coarse = Survey::parse(
        seeds::xyz().into(),
        &SeabedFileSpec {
            cell_m: Some(10.0),
            max_edge_m: Some(18.0),
            ..SeabedFileSpec::of("a.xyz".into())
        },
    );
    let coarse = coarse.unwrap_or_else(|e| panic!("{e}"));
    assert_eq!((coarse.field.rows, coarse.field.cols), (8, 10));
    let whole = survey("a.xyz", seeds::xyz()).unwrap();
    assert!(coarse.field.hole_share() > whole.field.hole_share());
}

// ---------------------------------------------------------------- units

#[test]
fn scale_offset_and_unit_of_a_geotiff_are_applied_but_not_to_holes() {
    let of = |metadata, keys: &[(u16, u16)]| {
        let tiff = Tiff {
            metadata: Some(metadata),
            nodata: Some("-1"),
            keys: keys.to_vec(),
            ..Tiff::default()
        };
        survey("a.tif", tiff.bytes()).unwrap_or_else(|e| panic!("{e}"))
    };
    let metadata = "<GDALMetadata>\n<Item name=\"A\">7</Item>\n\
        <Item name=\"OFFSET\" sample=\"0\" role=\"offset\">-0.5</Item>\n\
        <Item name=\"SCALE\" sample=\"0\" role=\"scale\">0.01</Item>\n</GDALMetadata>\n";
    let scaled = of(metadata, &Tiff::default().keys);
    // The southern row is -9 -10 -11 -12; the north-western number is the hole.
    let at = |s: &Survey, row: usize| f64::from(s.field.down_m[row * s.field.cols]);
    assert!(
        (at(&scaled, 0) - (0.09 + 0.5)).abs() < 1e-6,
        "{}",
        at(&scaled, 0)
    );
    assert!(at(&scaled, 2).is_nan());
    let feet = "<GDALMetadata><Item name=\"UNITTYPE\" sample=\"0\" role=\"unittype\">ft</Item></GDALMetadata>";
    let feet = of(feet, &Tiff::default().keys);
    assert!((at(&feet, 0) - 9.0 * 0.3048).abs() < 1e-5);
    assert_eq!(feet.field.cell_east_m, 10.0);
    let keys = [(1024, 1), (3072, 2263), (3076, 9003), (4099, 9001)];
    let mixed = of("<GDALMetadata/>", &keys);
    assert!((mixed.field.cell_east_m - 12_000.0 / 3937.0).abs() < 1e-9);
    assert!((at(&mixed, 0) - 9.0).abs() < 1e-6);
    assert!(mixed.notes.iter().any(|n| n.contains("US survey feet")));
}

#[test]
fn las_in_feet_becomes_metres_by_its_geokeys_or_its_code() {
    let depth = |keys: &[(u16, u16)]| {
        let las = survey("a.las", seeds::las_with(keys)).unwrap_or_else(|e| panic!("{e}"));
        let [low] = las.field.percentiles_m(&[0.0])[..] else {
            panic!("a depth");
        };
        (low, las.covers[2] - las.covers[0], las.guesses)
    };
    let (metres, extent_m, guesses) = depth(&[(1024, 1), (3072, 32632)]);
    assert!(
        (metres - 25.0).abs() < 1e-6 && guesses.is_empty(),
        "{guesses:?}"
    );
    let foot = 1200.0 / 3937.0;
    let stated = [(1024, 1), (3072, 2263), (3076, 9003), (4099, 9003)];
    for (keys, is_guess) in [(&stated[..], false), (&stated[..2], true)] {
        let (feet, extent_ft, guesses) = depth(keys);
        assert!((feet - 25.0 * foot).abs() < 1e-5, "{feet}");
        assert!((extent_ft - extent_m * foot).abs() < 1e-6);
        assert_eq!(
            guesses
                .iter()
                .any(|g| g.contains("do not state") || g.contains("does not state")),
            is_guess,
            "{guesses:?}"
        );
    }
    let (vertical, extent, _) = depth(&[(1024, 1), (3072, 32632), (4099, 9002)]);
    assert!((vertical - 25.0 * 0.3048).abs() < 1e-5);
    assert!((extent - extent_m).abs() < 1e-9);
}

#[test]
fn the_system_beside_a_file_is_read() {
    struct Two(Vec<u8>, &'static str);
    impl echotank_scene::Files for Two {
        fn open(&self, path: &std::path::Path) -> std::io::Result<Box<dyn std::io::Read>> {
            let bytes = match path.extension().and_then(|e| e.to_str()) {
                Some("prj") => self.1.as_bytes().to_vec(),
                Some("xyz") => self.0.clone(),
                _ => return Err(std::io::ErrorKind::NotFound.into()),
            };
            Ok(Box::new(std::io::Cursor::new(bytes)))
        }
    }
    let soundings = "x y depth\n500000 6000000 10\n500090 6000000 20\n500000 6000090 30\n";
    let open = |system| {
        let files = Two(soundings.into(), system);
        Survey::open(&files, &SeabedFileSpec::of("a.xyz".into()))
    };
    let utm = r#"PROJCS["WGS_1984_UTM_Zone_32N",GEOGCS["GCS_WGS_1984",UNIT["Degree",0.017]],UNIT["Meter",1.0]]"#;
    let survey = open(utm).unwrap_or_else(|e| panic!("{e}"));
    assert!(survey.zero_geodetic_rad().is_some());
    assert!(survey.guesses.is_empty(), "{:?}", survey.guesses);
    let feet = utm
        .replace("UTM_Zone_32N", "state")
        .replace("\"Meter\",1.0", "\"Foot\",0.3048");
    let survey = open(feet.leak()).unwrap_or_else(|e| panic!("{e}"));
    assert!((survey.covers[2] - survey.covers[0] - 90.0 * 0.3048).abs() < 1e-6);
    assert!(open("nonsense").is_err_and(|e| e.to_string().contains(".prj beside it")));
}

// ---------------------------------------------------------------- refusals

#[test]
fn formats_that_are_not_supported_are_named() {
    let zstd = Tiff {
        compression: 50_000,
        ..Tiff::default()
    };
    let lerc = Tiff {
        compression: 34_887,
        ..Tiff::default()
    };
    let mut laz = seeds::las();
    laz[104] |= 0x80;
    for (name, bytes, want) in [
        (
            "a.tif",
            zstd.bytes(),
            "tag Compression: `50000`: not supported: ZSTD",
        ),
        (
            "a.tif",
            lerc.bytes(),
            "tag Compression: `34887`: not supported: LERC",
        ),
        ("a.laz", laz, "LAS header: not supported: LAZ"),
        (
            "a.nc",
            b"CDF\x01abc".to_vec(),
            "file: not supported: netCDF",
        ),
    ] {
        let said = refusal(name, bytes);
        assert!(said.starts_with(want), "{said}");
    }
}

#[test]
fn a_wrong_coordinate_system_is_refused_with_the_reason() {
    let keys = |keys: &[(u16, u16)]| {
        let tiff = Tiff {
            keys: keys.to_vec(),
            ..Tiff::default()
        };
        refusal("a.tif", tiff.bytes())
    };
    assert!(
        keys(&[(1024, 2), (2048, 4326)]).starts_with(
            "coordinates as geographic degrees (EPSG:4326, WGS 84): `500005 .. 500035, 5999975 .. 5999995`: are not longitudes"
        ),
        "{}",
        keys(&[(1024, 2), (2048, 4326)])
    );
    assert_eq!(
        keys(&[(1024, 1), (3072, 3857)]),
        "GeoKey 3072: `EPSG:3857`: is a Mercator projection, whose metres are not metres on the ground: project the file to UTM first"
    );
    assert_eq!(
        keys(&[(1024, 1), (3072, 32632), (3076, 9040)]),
        "GeoKey 3076: `9040`: is not a supported unit of length"
    );
    assert!(keys(&[(1024, 3)]).starts_with("GeoKey 1024: `3`: is earth-centred"));
    let far = Tiff {
        tie: [0.0, 0.0, 0.0, 5_000_000.0, 6_000_000.0, 0.0],
        ..Tiff::default()
    };
    assert!(refusal("a.tif", far.bytes()).contains("are not eastings and northings of a UTM zone"));

    // The BAG's metadata moved to another zone, and to the southern hemisphere: they contradict the box that they name.
    let bag = seeds::bag().bytes;
    for (was, becomes, middle) in [
        (
            "<zone>2</zone>",
            "<zone>3</zone>",
            "latitude 65.305, longitude -162.385",
        ),
        (
            "<falseNorthing>0.0<",
            "<falseNorthing>1e7<",
            "latitude -24.9",
        ),
    ] {
        let at = bag
            .windows(was.len())
            .position(|w| w == was.as_bytes())
            .expect("the metadata are plain text");
        let mut wrong = bag.clone();
        wrong[at..at + was.len()].copy_from_slice(becomes.as_bytes());
        let said = refusal("a.bag", wrong);
        assert!(
            said.starts_with("coordinate system: `UTM zone") && said.contains(middle),
            "{said}"
        );
        assert!(
            said.contains("outside the 65.29 .. 65.32, -168.43 .. -168.34"),
            "{said}"
        );
    }
}

/// As in samples of the format's authors.
#[test]
fn corners_that_contradict_a_bags_size_are_warned_of_and_its_cells_are_read() {
    let bag = seeds::bag().bytes;
    let corner = b"623567.87";
    let at = bag.windows(corner.len()).position(|w| w == corner);
    let at = at.expect("the metadata are plain text");
    let mut wrong = bag.clone();
    wrong[at..at + corner.len()].copy_from_slice(b"629567.87");
    let of = |bytes| survey("a.bag", bytes).unwrap_or_else(|e| panic!("{e}"));
    let (right, wrong) = (of(bag), of(wrong));
    assert!(right.guesses.is_empty(), "{:?}", right.guesses);
    let warned = wrong.guesses.iter();
    let mut warned = warned.filter(|g| g.contains("the south-western corner"));
    assert!(warned.next().is_some(), "{:?}", wrong.guesses);
    assert_eq!(wrong.covers, right.covers);
    let bits = |s: &Survey| -> Vec<u32> { s.field.down_m.iter().map(|v| v.to_bits()).collect() };
    assert_eq!(bits(&wrong), bits(&right));
}

#[test]
fn a_file_cut_short_is_refused_wherever_it_is_cut() {
    let mut files = seeds::small();
    files.push(seeds::bag());
    for seed in &files {
        seeds::open(seed.name, seed.bytes.clone()).unwrap_or_else(|e| panic!("{}: {e}", seed.name));
        // Text truncated at a line end is valid: soundings and OBJ cannot detect it.
        let tells = !["soundings.xyz", "mesh.obj"].contains(&seed.name);
        for k in 0..40 {
            let cut = seed.bytes.len() * k / 41;
            match seeds::open(seed.name, seed.bytes[..cut].to_vec()) {
                Ok(()) => assert!(!tells, "{} cut to {cut} of {}", seed.name, seed.bytes.len()),
                Err(said) => assert!(said.contains(": "), "{}: {said}", seed.name),
            }
        }
    }
}

/// A short form of `tools/fuzz scene`.
#[test]
fn corrupted_files_are_read_or_refused_and_never_panic() {
    let mut random = Random(0x5eed_0f5e_abed_0001);
    for seed in seeds::small() {
        let (mut read, mut refused) = (0, 0);
        for _ in 0..400 {
            let bytes = seeds::spoiled(&seed.bytes, &mut random);
            match seeds::open(seed.name, bytes) {
                Ok(()) => read += 1,
                Err(_) => refused += 1,
            }
        }
        println!("{}: {read} read, {refused} refused", seed.name);
        assert!(refused > 20, "{}: the spoiling does something", seed.name);
    }
    let bag = seeds::bag();
    for _ in 0..25 {
        let bytes = seeds::spoiled(&bag.bytes, &mut random);
        let _ = seeds::open(bag.name, bytes);
    }
}

//! The keys of `[scene]` and the tables below it.

use super::*;

table! {
    /// The contents of the water. Without seabed, points and targets there is only noise.
    Scene;

    /// The same seed gives the same speckle.
    seed: Integer(0, MAX_INTEGER), Default("1");

    /// Position of the scene's origin: at nav.origin, under the first position received, or at the coordinates in the seabed file.
    anchor: Choice("origin", "first-fix", "file"), Default("\"origin\"");

    /// Beyond the edge of a gridded seabed: nothing, or periodic mirror images.
    extend: Choice("none", "mirror"), Default("\"none\"");

    /// CSV of point scatterers: north_m, east_m, down_m, amplitude (echo pressure at 1 m for unit pressure), and optionally amplitude_imag.
    points: File, Optional("\"data/points.csv\"");

    /// Named targets: a CSV of points on the seabed, or a TOML file of shapes anywhere in the water. Shapes are spheres, cylinders, boxes, ropes and
    /// meshes (OBJ, STL, PLY). docs/configure/scene.md lists their fields.
    targets: File, Optional("\"data/targets.csv\"");

    /// Memory limit of the seabed tiles around the sonar.
    memory_mib: Mib(1, 1_048_576), Default("512");

    /// Reference of the angles on the seabed: its normal, or the vertical (Eq. 9 of Meng et al. 2023, correct on flat bottoms only).
    incidence: Choice("normal", "flat"), Default("\"normal\"");

    /// Shadows. "none". "horizon": of seabed and solids, from transmitter and receiver. "paper": of the seabed by Eq. 27 of Meng et al. 2023,
    /// which ignores solids.
    occlusion: Choice("none", "horizon", "paper"), Default("\"horizon\"");
    seabed: Table(Seabed), Shown("");
    simplify: Table(Simplify), Default("{}");
}

table! {
    /// Leaves out seabed scatterers that contribute little. Points and targets stay.
    Simplify;

    /// "none": all scatterers. "acoustic-unbiased": random choice with corrected level. "acoustic": the strongest energies (Meng et al. 2023,
    /// corrected). "paper": the same as printed.
    method: Choice("none", "acoustic-unbiased", "acoustic", "paper"; later "conventional"), Default("\"none\"");

    /// Number of scatterers per ping, required unless method is "none". With "acoustic-unbiased" it is the mean number.
    keep: Integer(1, 100_000_000), Optional("20000");

    /// Weight of the Gaussian curvature. Default: 1, with "acoustic-unbiased" 0.
    weight_curvature: Number(from(0.0, 1.0e6)), Optional("1.0");

    /// Weight of the scattered energy. Default: 1, with "acoustic-unbiased" 0.
    weight_scattering: Number(from(0.0, 1.0e6)), Optional("1.0");

    /// Weight of the two-way pattern. Default: 1, with "acoustic-unbiased" 0.
    weight_axis: Number(from(0.0, 1.0e6)), Optional("1.0");

    /// Weight of the product of scattered energy and two-way pattern. Default: 0, with "acoustic-unbiased" 1.
    weight_echo: Number(from(0.0, 1.0e6)), Optional("1.0");

    /// The selection is renewed after the sonar has moved this far.
    hold_m: Number(from(0.0, 1.0e4)), Default("0.5");

    /// The selection is renewed after the sonar has turned this much.
    hold_deg: Degrees(from(0.0, 180.0)), Default("0.5");

    /// Find shadows among the scatterers even with occlusion = "none", and choose shadowed scatterers last. Not with "acoustic-unbiased".
    shadows: Bool, Default("false");
}

table! {
    /// The seabed, as scatterers on a surface. Leave the table out for none.
    Seabed;

    /// "file": a survey in any supported format; `echotank scene info` shows how it is read. "esri-ascii": the same in that format. "paper-...":
    /// the seabeds of Figs. 6, 12 and 17 of Meng et al. 2023, about 30 m below the scene's origin, east of a northward track.
    shape: Choice("plane", "file", "esri-ascii", "paper-curves", "paper-relief", "paper-lake"), Required("\"plane\"");

    /// Depth below the scene's origin. Only with shape = "plane".
    depth_m: Number(METRES), Shown("40.0"), needed with shape = "plane";

    /// Metres of depth per metre northward. Only with shape = "plane".
    slope_north: Number(from(-10.0, 10.0)), Default("0.0"), only with shape = "plane";

    /// Metres of depth per metre eastward. Only with shape = "plane".
    slope_east: Number(from(-10.0, 10.0)), Default("0.0"), only with shape = "plane";

    /// The centre of the survey lies at the scene's origin. Only with shape = "file" or "esri-ascii".
    path: File, Optional("\"data/seabed.asc\""), needed with shape = "file" or "esri-ascii";

    /// Elevations (up positive) or depths. "auto": detected. Only with shape = "file" or "esri-ascii".
    values: Choice("auto", "elevation", "depth"), Default("\"auto\""), only with shape = "file" or "esri-ascii";

    /// Moves the survey northward. Only with shape = "file" or "esri-ascii".
    offset_north_m: Number(METRES), Default("0.0"), only with shape = "file" or "esri-ascii";

    /// Moves the survey eastward. Only with shape = "file" or "esri-ascii".
    offset_east_m: Number(METRES), Default("0.0"), only with shape = "file" or "esri-ascii";

    /// "auto": from the first bytes or the file name. Only with shape = "file".
    format: Choice("auto", "esri-ascii", "geotiff", "bag", "xyz", "las", "ply"), Default("\"auto\""), only with shape = "file";

    /// Coordinate system, if the file names none or a wrong one: local, geographic, projected, utm-31n, EPSG:32631. Only with shape = "file" or
    /// "esri-ascii".
    crs: Text, Optional("\"utm-31n\""), only with shape = "file" or "esri-ascii";

    /// Position of a grid's first row. "auto": as the format defines. Only with shape = "file" or "esri-ascii".
    first_row: Choice("auto", "north", "south"), Default("\"auto\""), only with shape = "file" or "esri-ascii";

    /// Value of a hole, besides the one that the file names. Only with shape = "file" or "esri-ascii".
    nodata: Number(from(-1.0e39, 1.0e39)), Optional("-32768.0"), only with shape = "file" or "esri-ascii";

    /// Grid cell for soundings. Default: their mean distance. Only with shape = "file".
    cell_m: Number(above(0.0, 1.0e6)), Optional("5.0"), only with shape = "file";

    /// Triangles of soundings with a longer edge are holes. Only with shape = "file".
    max_edge_m: Number(above(0.0, 1.0e6)), Optional("50.0"), only with shape = "file";

    /// Five scatterers in every resolution cell, c/(2 B) times beam width times range, of the ping's own arrays; fewer in side lobes. The density falls with range.
    /// Default: "auto", unless density_per_m2 is given.
    density: Choice("auto"), Optional("\"auto\"");

    /// Constant number of scatterers per horizontal square metre. Not with density = "auto". The mean level does not depend on it.
    density_per_m2: Number(above(0.0, 1.0e6)), Optional("1.0");

    /// Scattering law. "three-term": specular facets, Lambert and an intermediate lobe. The sediments are three-term laws with their own
    /// parameters.
    bottom: Choice("bistatic-lambert", "lambert", "three-term", "mud", "silt", "sand", "gravel", "rock"), Default("\"bistatic-lambert\"");

    /// Lambert parameter mu: mud about -35, sand -27, rock -15 (typical values; the sediments follow APL-UW TR 9407, 1994). Not with a sediment.
    lambert_db: Number(from(-100.0, 20.0)), Default("-27.0");

    /// Exponent of the cosine. Only with bottom = "three-term".
    lambert_exponent: Number(from(0.0, 10.0)), Default("2.0"), only with bottom = "three-term";

    /// Strength of the specular lobe at normal incidence. Only with bottom = "three-term".
    specular_db: Number(from(-100.0, 30.0)), Default("-5.0"), only with bottom = "three-term";

    /// Standard deviation of the specular lobe. Only with bottom = "three-term".
    specular_width_deg: Degrees(from(2.0, 60.0)), Default("6.0"), only with bottom = "three-term";

    /// Strength of the intermediate lobe at normal incidence. Only with bottom = "three-term".
    intermediate_db: Number(from(-100.0, 30.0)), Default("-23.0"), only with bottom = "three-term";

    /// Standard deviation of the intermediate lobe. Only with bottom = "three-term".
    intermediate_width_deg: Degrees(from(2.0, 80.0)), Default("18.0"), only with bottom = "three-term";

    /// File of backscattering strengths in dB, in any format of `path` (GeoTIFF, ESRI ASCII grid and so on). Holes and the area outside keep the
    /// bottom's own strength. Over a seabed from a file it lies at its coordinates, which must use the same system. Otherwise its centre lies at
    /// the scene's origin.
    mosaic: File, Optional("\"data/backscatter.asc\"");

    /// Coordinate system of the mosaic file, as crs. Only with a mosaic.
    mosaic_crs: Text, Optional("\"utm-31n\"");

    /// "absolute": strengths at mosaic_incidence_deg, to which the law is scaled. "relative": values added to the law. Only with a mosaic.
    mosaic_values: Choice("absolute", "relative"), Default("\"absolute\"");

    /// Incidence angle of the strengths. Only with mosaic_values = "absolute".
    mosaic_incidence_deg: Degrees(from(0.0, 85.0)), Default("45.0");

    /// Moves the mosaic northward. Only with a mosaic.
    mosaic_offset_north_m: Number(METRES), Default("0.0");

    /// Moves the mosaic eastward. Only with a mosaic.
    mosaic_offset_east_m: Number(METRES), Default("0.0");

    /// true: circular Gaussian reflectivities. false: all reflectivities are 1.
    speckle: Bool, Default("true");
}

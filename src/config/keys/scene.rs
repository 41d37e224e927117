//! The keys of `[scene]` and the tables below it.

use super::*;

table! {
    /// What lies in the water. Without a seabed, points and targets there is only noise.
    Scene;

    /// Same seed, same speckle.
    seed: Integer(0, MAX_INTEGER), Default("1");

    /// Where the scene's own zero lies: at nav.origin, under the first position received, or where the seabed's file says it lies on the earth.
    anchor: Choice("origin", "first-fix", "file"), Default("\"origin\"");

    /// Beyond the edge of a gridded seabed: nothing, or its mirror image for ever.
    extend: Choice("none", "mirror"), Default("\"none\"");

    /// CSV of explicit scatterers: north_m, east_m, down_m, amplitude (echo pressure at 1 m for unit pressure), and if wanted amplitude_imag.
    points: File, Optional("\"data/points.csv\"");

    /// Named targets: CSV of points laid over the seabed, or TOML of shapes (spheres, cylinders, boxes, ropes, meshes from OBJ, STL or PLY)
    /// anywhere in the water; hil-configs/README.md has their fields.
    targets: File, Optional("\"data/targets.csv\"");

    /// Memory for the tiles of seabed around the sonar.
    memory_mib: Mib(1, 1_048_576), Default("512");

    /// What angles on the seabed are measured from: its own normal, or the vertical (the paper's Eq. 9, right on flat bottoms alone).
    incidence: Choice("normal", "flat"), Default("\"normal\"");

    /// Shadows: none; of seabed and solids, from transmitter and receiver; or over the seabed by the paper's rule (Eq. 27), which forgets
    /// obstacles.
    occlusion: Choice("none", "horizon", "paper"), Default("\"horizon\"");
    seabed: Table(Seabed), Shown("");
    simplify: Table(Simplify), Default("{}");
}

table! {
    /// Leaves out scatterers of the seabed that a ping can do without; points and targets stay.
    Simplify;

    /// All are computed; by chance with the lost level made up for; the strongest energies (Meng et al. 2023, mended); the same as printed.
    method: Choice("none", "acoustic-unbiased", "acoustic", "paper"; later "conventional"), Default("\"none\"");

    /// Scatterers of a ping, needed unless method is none; acoustic-unbiased keeps so many on average.
    keep: Integer(1, 100_000_000), Optional("20000");

    /// What Gaussian curvature counts; 1 unless acoustic-unbiased, then 0.
    weight_curvature: Number(from(0.0, 1.0e6)), Optional("1.0");

    /// What the energy that is sent back counts; 1 unless acoustic-unbiased, then 0.
    weight_scattering: Number(from(0.0, 1.0e6)), Optional("1.0");

    /// What the two-way pattern counts; 1 unless acoustic-unbiased, then 0.
    weight_axis: Number(from(0.0, 1.0e6)), Optional("1.0");

    /// What the product of the last two counts; 0 unless acoustic-unbiased, then 1.
    weight_echo: Number(from(0.0, 1.0e6)), Optional("1.0");

    /// A choice is kept until the sonar has moved this far
    hold_m: Number(from(0.0, 1.0e4)), Default("0.5");

    /// or turned this much.
    hold_deg: Degrees(from(0.0, 180.0)), Default("0.5");

    /// Search for shadows among the scatterers itself, where occlusion is none, and choose what lies in them last (acoustic-unbiased: never).
    shadows: Bool, Default("false");
}

table! {
    /// The bottom, as scatterers on a surface. Leave the table out for none.
    Seabed;

    /// "file": a survey in any format that is read; `echotank scene info` shows how it is understood. "esri-ascii": the same, of that format. The
    /// paper's bottoms (Figs. 6, 12, 17) lie some 30 m under the scene's zero, east of a track along north.
    shape: Choice("plane", "file", "esri-ascii", "paper-curves", "paper-relief", "paper-lake"), Required("\"plane\"");

    /// Under the scene's zero. Only with shape = "plane".
    depth_m: Number(METRES), Shown("40.0");

    /// Metres of depth per metre. Only with shape = "plane".
    slope_north: Number(from(-10.0, 10.0)), Default("0.0");

    /// Only with shape = "plane".
    slope_east: Number(from(-10.0, 10.0)), Default("0.0");

    /// The middle of what it covers lies at the scene's zero. Only with shape = "file" or "esri-ascii".
    path: File, Optional("\"data/seabed.asc\"");

    /// Heights (up positive) or depths; auto: as the file says, or as most of its signs are. Only with shape = "file" or "esri-ascii".
    values: Choice("auto", "elevation", "depth"), Default("\"auto\"");

    /// Moves the middle of the file. Only with shape = "file" or "esri-ascii".
    offset_north_m: Number(METRES), Default("0.0");

    /// Only with shape = "file" or "esri-ascii".
    offset_east_m: Number(METRES), Default("0.0");

    /// Auto: by its first bytes, or its name. Only with shape = "file".
    format: Choice("auto", "esri-ascii", "geotiff", "bag", "xyz", "las", "ply"), Default("\"auto\"");

    /// What its coordinates are, where it says so wrongly or not at all: local, geographic, projected, utm-31n, EPSG:32631. Only with shape =
    /// "file" or "esri-ascii".
    crs: Text, Optional("\"utm-31n\"");

    /// Which end of a grid its first row lies at; auto: as the format has it. Only with shape = "file" or "esri-ascii".
    first_row: Choice("auto", "north", "south"), Default("\"auto\"");

    /// Stands for a hole, besides the value that the file names. Only with shape = "file" or "esri-ascii".
    nodata: Number(from(-1.0e39, 1.0e39)), Optional("-32768.0");

    /// Soundings: cell of the grid they are made into; left out: their mean distance. Only with shape = "file".
    cell_m: Number(above(0.0, 1.0e6)), Optional("5.0");

    /// Soundings: triangles with a longer edge are holes. Only with shape = "file".
    max_edge_m: Number(above(0.0, 1.0e6)), Optional("50.0");

    /// Five scatterers or more in every resolution cell of the finest sonar, c/(2 B) times beam width times range: fewer the farther away.
    density: Choice("auto"), Optional("\"auto\"");

    /// The same number everywhere, per square metre of the horizontal; not with density = "auto". The mean level does not depend on it.
    density_per_m2: Number(above(0.0, 1.0e6)), Default("1.0");

    /// The law of scattering. "three-term": mirror facets, Lambert and a slope between them; the names of sediments are three-term with values of
    /// their own.
    bottom: Choice("bistatic-lambert", "lambert", "three-term", "mud", "silt", "sand", "gravel", "rock"), Default("\"bistatic-lambert\"");

    /// Lambert's mu: mud about -35, sand -27, rock -15 (round numbers; the names of sediments are from APL-UW TR 9407, 1994). Not with the name
    /// of a sediment.
    lambert_db: Number(from(-100.0, 20.0)), Default("-27.0");

    /// Of the cosine. Only with bottom = "three-term".
    lambert_exponent: Number(from(0.0, 10.0)), Default("2.0");

    /// What the facets mirror at normal incidence. Only with bottom = "three-term".
    specular_db: Number(from(-100.0, 30.0)), Default("-5.0");

    /// Standard deviation of that lobe. Only with bottom = "three-term".
    specular_width_deg: Degrees(from(2.0, 60.0)), Default("6.0");

    /// The slope between the lobe and Lambert's law, at normal incidence. Only with bottom = "three-term".
    intermediate_db: Number(from(-100.0, 30.0)), Default("-23.0");

    /// Standard deviation of that slope. Only with bottom = "three-term".
    intermediate_width_deg: Degrees(from(2.0, 80.0)), Default("18.0");

    /// Backscattering strengths in dB, a file of any of the formats of `path` (GeoTIFF, ESRI ASCII grid and so on); holes and what lies beyond
    /// keep the bottom's own. Over a seabed from a file it lies where its coordinates put it, and must count them in the same system; otherwise
    /// its centre lies at the scene's zero.
    mosaic: File, Optional("\"data/backscatter.asc\"");

    /// As crs, of the mosaic's file. Only with a mosaic.
    mosaic_crs: Text, Optional("\"utm-31n\"");

    /// "absolute": strengths at mosaic_incidence_deg, to which the law is raised or lowered; "relative": to be added to it. Only with a mosaic.
    mosaic_values: Choice("absolute", "relative"), Default("\"absolute\"");

    /// Only with mosaic_values = "absolute".
    mosaic_incidence_deg: Degrees(from(0.0, 85.0)), Default("45.0");

    /// Moves the mosaic. Only with a mosaic.
    mosaic_offset_north_m: Number(METRES), Default("0.0");

    /// Moves the mosaic. Only with a mosaic.
    mosaic_offset_east_m: Number(METRES), Default("0.0");

    /// Circular Gaussian reflectivities; false: all 1.
    speckle: Bool, Default("true");
}

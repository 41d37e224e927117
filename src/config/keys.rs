//! Every key of a configuration file, declared once: name, kind, unit, rule, default, meaning.
//!
//! [`table!`] generates two items from a declaration: the struct that a table is read into, with one [`Field`] for each key, and
//! the [`Table`] that the reader (`raw`), the template and the JSON Schema (`describe`) use. Rules between keys are in `check`. It
//! names keys as fields, so a misspelt key does not compile.

use glam::DVec3;

use super::declaration::{Key, KeyCondition, Kind, Presence, Range, Table, Unit, above, from};
use super::raw::{ChoiceOr, Declared, Field, RawTable};

use Presence::{Default, Optional, Required, Set, Shown};

/// A field's name without the `r#` that a Rust keyword needs.
const fn key_name(field: &'static str) -> &'static str {
    match field.as_bytes() {
        [b'r', b'#', ..] => field.split_at(2).1,
        _ => field,
    }
}

/// The [`Kind`] of a declaration.
macro_rules! kind {
    (Integer($min:expr, $max:expr)) => { Kind::Integer($min, $max, 1) };
    (Mib($min:expr, $max:expr)) => { Kind::Integer($min, $max, 1 << 20) };
    (Number($range:expr)) => { Kind::Number($range, Unit::Power(0)) };
    (Ms($range:expr)) => { Kind::Number($range, Unit::Power(-3)) };
    (Khz($range:expr)) => { Kind::Number($range, Unit::Power(3)) };
    (PerKm($range:expr)) => { Kind::Number($range, Unit::Power(-3)) };
    (Percent($range:expr)) => { Kind::Number($range, Unit::Power(-2)) };
    (Degrees($range:expr)) => { Kind::Number($range, Unit::Degrees) };
    (Pair($range:expr)) => { Kind::Numbers(2, $range, Unit::Power(0)) };
    (PairMs($range:expr)) => { Kind::Numbers(2, $range, Unit::Power(-3)) };
    (Vector($range:expr)) => { Kind::Numbers(3, $range, Unit::Power(0)) };
    (VectorDegrees($range:expr)) => { Kind::Numbers(3, $range, Unit::Degrees) };
    (Choice($($name:literal),+ $(; later $($later:literal),+)?)) => { Kind::Choice(&[$($name),+], &[$($($later),+)?]) };
    (ChoiceOf($names:expr)) => { Kind::Choice($names, &[]) };
    (ChoiceOrNumber($range:expr, $($choice:tt)*)) => { Kind::Either(&kind!(Choice($($choice)*)), &kind!(Number($range))) };
    (ChoiceOrRows($($choice:tt)*)) => { Kind::Either(&kind!(Choice($($choice)*)), &Kind::Rows("range_m, db")) };
    (ChoiceOrTable($table:ident: $($choice:tt)*)) => { Kind::Either(&kind!(Choice($($choice)*)), &kind!(Table($table))) };
    (Choices($($name:literal),+)) => { Kind::Choices(&[$($name),+]) };
    (Table($table:path)) => { Kind::Table(&<$table as Declared>::TABLE) };
    (Tables($table:path, $max:expr)) => { Kind::Tables(&<$table as Declared>::TABLE, $max) };
    ($($plain:tt)+) => { Kind::$($plain)+ };
}

/// The Rust type of the values of a kind.
macro_rules! value {
    (Bool) => { bool };
    (Integer($($range:tt)*)) => { i64 };
    (Mib($($range:tt)*)) => { i64 };
    (Pair($range:expr)) => { (f64, f64) };
    (PairMs($range:expr)) => { (f64, f64) };
    (Vector($range:expr)) => { DVec3 };
    (VectorDegrees($range:expr)) => { DVec3 };
    (Name) => { String };
    (Text) => { String };
    (File) => { std::path::PathBuf };
    (Folder) => { std::path::PathBuf };
    (Names) => { Vec<String> };
    (Choices($($name:tt)*)) => { Vec<String> };
    (Choice($($name:tt)*)) => { String };
    (ChoiceOf($names:expr)) => { String };
    (ChoiceOrNumber($range:expr, $($choice:tt)*)) => { ChoiceOr<f64> };
    (ChoiceOrRows($($choice:tt)*)) => { ChoiceOr<Vec<(f64, f64)>> };
    (ChoiceOrTable($table:ident: $($choice:tt)*)) => { ChoiceOr<$table> };
    (Rows($columns:literal)) => { Vec<(f64, f64)> };
    (Table($table:path)) => { $table };
    (Tables($table:path, $max:expr)) => { Vec<$table> };
    ($number:ident($range:expr)) => { f64 };
}

/// The [`KeyCondition`] of a declaration, if it has one: `only` with another key, or `needed` with it.
macro_rules! with {
    () => { None };
    (only $key:ident $($value:literal)*) => { Some(KeyCondition { needed: false, key: stringify!($key), values: &[$(stringify!($value)),*] }) };
    (needed $key:ident $($value:literal)*) => { Some(KeyCondition { needed: true, key: stringify!($key), values: &[$(stringify!($value)),*] }) };
}

/// Declares a table: its description, its name, and its keys. Each key has a description, name, kind, `Presence` and the key that
/// it depends on, if any.
macro_rules! table {
    (
        $(#[doc = $about:literal])+
        $table:ident $(, later $($later:literal),+)?;
        $(
            $(#[doc = $doc:literal])*
            $key:ident: $kind:ident $(($($rule:tt)*))?, $presence:expr $(, $bond:ident with $with:ident $(= $($value:literal)or+)?)?;
        )*
    ) => {
        $(#[doc = $about])+
        #[derive(Debug)]
        pub(crate) struct $table {
            $($(#[doc = $doc])* pub(crate) $key: Field<value!($kind $(($($rule)*))?)>,)*
        }

        impl Declared for $table {
            const TABLE: Table = Table {
                doc: concat!($($about),+),
                keys: &[$(Key {
                    name: key_name(stringify!($key)),
                    kind: kind!($kind $(($($rule)*))?),
                    presence: $presence,
                    with: with!($($bond $with $($($value)+)?)?),
                    doc: concat!($($doc),*),
                }),*],
                later: &[$($($later),+)?],
            };

            fn from_raw(mut raw: RawTable) -> Self {
                Self { $($key: raw.take(key_name(stringify!($key)))),* }
            }
        }
    };
}

pub(crate) mod devices;
pub(crate) mod families;
pub(crate) mod faults;
pub(crate) mod instrument;
mod nav;
pub(crate) mod samples;
mod scene;
mod sonar;
pub(crate) mod trigger;

pub(crate) use nav::*;
pub(crate) use scene::*;
pub(crate) use sonar::*;

// The ranges exclude only values that must be an error, such as a wrong unit or a lost digit.
const METRES: Range = from(-1.0e6, 1.0e6);
const ARM_M: Range = from(-1000.0, 1000.0);
const ANGLE_DEG: Range = from(-360.0, 360.0);
const MAX_INTEGER: i64 = i64::MAX;

table! {
    /// An echotank rig: water, navigation, scene, and one or more sonars.
    Rig, later "web", "metrics", "trigger";
    medium: Table(Medium), Default("{}");
    nav: Table(Nav), Required("");
    scene: Table(Scene), Default("{}");
    run: Table(Run), Default("{}");
    record: Table(Record), Optional("");
    control: Table(Control), Default("{}");
    sonar: Tables(Sonar, 32), Required("");
    fault: Tables(faults::Fault, 1000), Optional("");
}

table! {
    /// The water.
    Medium, later "sound_speed_profile";

    /// The same everywhere. Not with a profile.
    sound_speed_m_per_s: Number(from(300.0, 3000.0)), Default("1500.0");

    /// Sound speed over depth, which bends the sound. Left out: one sound speed everywhere.
    profile: Table(Profile), Optional("");

    /// The sea surface. Left out: calm, and it scatters nothing.
    surface: Table(Surface), Optional("");

    /// Echoes by way of the surface and the bottom. Left out: direct echoes only. Not with a profile.
    multipath: Table(Multipath), Optional("");

    /// "francois-garrison": Francois and Garrison 1982. "ainslie-mccolm": Ainslie and McColm 1998. "none": no absorption. Or a fixed one-way
    /// value: { db_per_km = 30.0 }.
    absorption: ChoiceOrTable(FixedAbsorption: "francois-garrison", "ainslie-mccolm", "none"; later "thorp"), Default("\"francois-garrison\"");

    /// Temperature, salinity, depth and pH are used by the absorption formula only.
    temperature_c: Number(from(-4.0, 40.0)), Default("10.0");

    /// 0 for fresh water.
    salinity_psu: Number(from(0.0, 50.0)), Default("35.0");
    depth_m: Number(from(0.0, 11_000.0)), Default("50.0");
    ph: Number(from(6.0, 9.0)), Default("8.0");

    /// Wind speed at a height of 10 m, for receiver.noise_db = "ambient" and for height, slopes and bubbles of \[medium.surface].
    wind_m_per_s: Number(from(0.0, 40.0)), Default("5.0");

    /// Layers of water that scatter: plankton, bubbles, suspended matter. Left out: no volume reverberation.
    volume: Tables(VolumeLayer, 100), Optional("");

    /// Scatterers in each resolution cell of the water, drawn anew at every ping. More make the ping slower; the mean level does not depend on it. Only with
    /// a layer.
    volume_scatterers_per_cell: Number(from(1.0, 50.0)), Default("4.0");

    /// No volume reverberation from nearer than this: the end of the pulse hides it, and near scatterers make pings slow. Only with a layer.
    volume_nearest_m: Number(from(0.0, 1000.0)), Default("1.0");
}

table! {
    /// A layer of water with volume reverberation. Layers must not overlap.
    VolumeLayer;

    /// Depth of its upper edge.
    top_m: Number(from(0.0, 11_000.0)), Required("0.0");

    /// Depth of its lower edge. The seabed ends it earlier.
    bottom_m: Number(above(0.0, 12_000.0)), Required("100.0");

    /// Volume scattering strength at the centre frequency, dB re 1/m.
    sv_db: Number(from(-200.0, 0.0)), Required("-70.0");
}

table! {
    /// A sound-speed profile: a file or points. The speed is linear between the points, and constant above the first and below the last. It can be
    /// replaced while the sonars ping: `echotank ctl profile CAST`.
    Profile;

    /// A cast: .asvp (Kongsberg), .svp (CARIS, SonarWiz), .vel (Hypack, in metres), or any other text with a depth in metres and a sound speed in m/s on
    /// each line (.csv).
    file: File, Optional("\"data/cast.asvp\"");

    /// Depth in metres below the waterline and sound speed in m/s, the shallowest point first: 2 to 1000 points, the first at most 10 m deep.
    points: Rows("depth_m, m_per_s"), Optional("[[0.0, 1500.0], [20.0, 1480.0]]");
}

table! {
    /// The sea surface.
    Surface;

    /// Rms height. Default: 0.0053 times the square of the wind speed.
    roughness_m: Number(from(0.0, 10.0)), Optional("0.1");

    /// Rms slope of the facets. Default: by the wind (APL-UW TR 9407).
    slope_deg: Degrees(from(0.1, 20.0)), Optional("6.0");

    /// Depth of the mean surface below the world's vertical origin.
    down_m: Number(from(-100.0, 100.0)), Default("0.0");

    /// The surface itself scatters, by the wind (APL-UW TR 9407).
    scattering: Bool, Default("false");

    /// The scatterers of the surface move with the orbital velocity of a sea by the wind, which spreads the Doppler of their echoes. Only with
    /// scattering = true.
    waves: Bool, Default("false"), only with scattering = true;

    /// Where the wind comes from, clockwise from north: the waves spread about its direction by cos^2 and drift with it. Default: waves from all directions
    /// alike.
    wind_from_deg: Degrees(ANGLE_DEG), Optional("230.0");

    /// Waves longer than eight times the depth of the sonar raise and lower the reflections of the surface. Only with \[medium.multipath].
    heights: Bool, Default("false");

    /// Time in which the scattering of the surface changes. Only with scattering = true.
    correlation_time_ms: Ms(above(0.0, 1.0e6)), Default("100.0"), only with scattering = true;
}

table! {
    /// Echoes by way of the surface and the bottom.
    Multipath;

    /// Ways of the sound between a scatterer and the sonar besides the direct one. "surface": by the surface. "surface-bottom": also up to the surface and
    /// down to the bottom, which gives the second bottom echo.
    legs: Choice("surface", "surface-bottom"), Default("\"surface-bottom\"");

    /// Density of the bottom relative to the water's. Default: that of the sediment in scene.seabed.bottom, else of sand.
    bottom_density_ratio: Number(from(0.1, 10.0)), Optional("1.845");

    /// Sound speed of the bottom relative to the water's. Default: as above.
    bottom_speed_ratio: Number(from(0.1, 10.0)), Optional("1.178");

    /// Rms height of the bottom, waves longer than a metre aside. Default: as above.
    bottom_roughness_m: Number(from(0.0, 1.0)), Optional("0.008");

    /// Rms slope of the bottom's facets.
    bottom_slope_deg: Degrees(from(0.1, 20.0)), Default("5.0");
}

table! {
    /// A fixed absorption.
    FixedAbsorption;

    /// One way.
    db_per_km: PerKm(from(0.0, 10_000.0)), Required("30.0");
}

table! {
    /// Timing, threads and delivery.
    Run, later "cores";

    /// Number of computing threads. 0: one per core. The samples do not depend on it.
    threads: Integer(0, 1024), Default("0");

    /// A ping is delivered this long after its listening window. A later delivery is counted as a deadline miss.
    latency_ms: Ms(from(0.0, 600_000.0)), Default("200.0");

    /// Interval between printed status lines.
    status_interval_s: Number(from(0.1, 86_400.0)), Default("10.0");

    /// Maximum number of pings that wait for delivery.
    queue_pings: Integer(1, 10_000), Default("4");

    /// What to do when a ping cannot be ready in time because it waited for others. "skip": leave it out. "degrade": compute it with a tolerance ten
    /// times larger, then a hundred times, and return when there is time. "stretch": delay the pulses to the rate that can be computed. Each case is
    /// counted and written to overload-TIME.jsonl. Only under overload do the samples depend on the machine. The key has no effect with clock =
    /// "fast" and "lockstep".
    overload: Choice("skip", "degrade", "stretch"), Default("\"skip\"");

    /// Minimum computing time of a ping, to test overload. Each degradation level halves it. It has no effect with clock = "fast" and "lockstep".
    simulated_compute_ms: Ms(from(0.0, 600_000.0)), Default("0.0");

    /// "ping-end": all records leave at the end of the ping. "streaming": element samples (vita49, elements) leave block by block while the ping is
    /// received. Each block leaves stream_latency_ms after its end; all other records leave at the end of the ping. The ping is computed ahead_ms
    /// before its pulse, so nav.mode must be "predict". With an external trigger it is computed after the pulse, and stream_latency_ms must cover
    /// that time. The samples are the same.
    delivery: Choice("ping-end", "streaming"), Default("\"ping-end\"");

    /// Length of a block. Only with delivery = "streaming".
    stream_block_ms: Ms(from(0.1, 1000.0)), Default("1.0"), only with delivery = "streaming";

    /// Constant delay of each block after its end. Only with delivery = "streaming".
    stream_latency_ms: Ms(from(0.0, 600_000.0)), Default("0.5"), only with delivery = "streaming";

    /// Compute a ping in tiles (sections in time), each twice as long as the one before, and send the first blocks meanwhile. stream_latency_ms then
    /// covers only the first tile. Use it for external triggers, on a machine that computes a ping in a quarter of its window. Only with delivery =
    /// "streaming" and model.synthesis = "reference" or "direct", without error check, further pulses and passband samples.
    stream_tiles: Bool, Default("false"), only with delivery = "streaming";

    /// A ping is computed this long before its pulse, with the settings and the motion known then. It should be at least the computing time of a
    /// ping. Default: 0, or 100 with delivery = "streaming". Above 0 only with nav.mode = "predict".
    ahead_ms: Ms(from(0.0, 10_000.0)), Shown("100.0");

    /// "realtime": the computer's time. "scaled": clock_rate times as fast. "fast": as fast as pings can be computed. "lockstep": one ping for each
    /// requested step (echotank ctl step). All but "realtime" need recorded navigation. The samples do not depend on it.
    clock: Choice("realtime", "scaled", "fast", "lockstep"), Default("\"realtime\"");

    /// Speed relative to real time. Only with clock = "scaled".
    clock_rate: Number(from(0.1, 1000.0)), Default("10.0"), only with clock = "scaled";

    /// "spread": a ping's datagrams leave evenly over a share of the time to the next ping. "burst": they leave all at once, and a receiver with
    /// a default socket buffer loses most of them. TCP loses nothing: see pace_tcp. With clock = "fast" and "lockstep" always "burst".
    pace: Choice("spread", "burst"), Default("\"spread\"");

    /// Share of the time to the next ping. Only with pace = "spread".
    pace_share: Number(from(0.01, 0.95)), Default("0.8"), only with pace = "spread";

    /// Also spread records of 7k, JSF, WBMS and the Ping protocol over TCP, by the kernel (Linux). Otherwise they leave as fast as a client
    /// reads. Only with pace = "spread".
    pace_tcp: Bool, Default("false"), only with pace = "spread";

    /// SCHED_FIFO priority of the delivery threads, with locked memory, where the system allows it (echotank doctor). 0: normal scheduling.
    priority: Integer(0, 99), Default("40");

    /// Nice value of the computing threads, where the system allows it (echotank doctor). Lower values take a larger share of the processors; at -20
    /// other programs keep about 1 %. 0: normal.
    compute_nice: Integer(-20, 0), Default("0");

    /// Folder for faults-TIME.jsonl and overload-TIME.jsonl. Default: record.directory (with overload = "skip" only the fault file); without a
    /// record table no file is written.
    fault_directory: Folder, Optional("\"out\"");

    /// Cost of the methods on this machine, as written by `echotank check --calibrate FILE`. Settings that are "auto" are chosen with it.
    /// Default: the built-in table.
    costs: File, Optional("\"costs.toml\"");
}

table! {
    /// Records everything that is sent. Leave the table out for no recording.
    Record, later "formats", "max_gib";

    /// Created if it does not exist.
    directory: Folder, Required("\"out\"");

    /// Whether recording is on when the daemon starts. The operator's page and `echotank ctl record` stop and start it.
    at_start: Bool, Default("true");
}

table! {
    /// Control over HTTP: the operator's page at http://ADDRESS/, POST /control, GET /status, /metrics, /healthz. Off without `listen`.
    Control;

    /// Address and port.
    listen: Text, Optional("\"127.0.0.1:7780\"");

    /// Password of clients that control the rig, as `Authorization: Bearer TOKEN` or on the page. Required if `listen` accepts other computers.
    token: Text, Optional("\"a long secret\"");
}

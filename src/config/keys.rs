//! Every key of a configuration file, declared once: name, kind, unit, rule, default, meaning.
//!
//! [`table!`] makes two things of a declaration: the struct that a table is read into, with one [`Field`] for each key, and the
//! [`Table`] that the reader (`raw`), the template and the JSON Schema (`describe`) walk. Rules between keys live in `check`, which names
//! keys as fields: a misspelt key does not compile.

use glam::DVec3;

use super::raw::{ChoiceOr, Declared, Field, RawTable};

/// A TOML table.
pub(crate) struct Table {
    pub doc: &'static str,
    pub keys: &'static [Key],
    /// Names that the design knows and this version does not build: refused with those words.
    pub later: &'static [&'static str],
}

/// One key of a table.
pub(crate) struct Key {
    pub name: &'static str,
    pub kind: Kind,
    pub(crate) presence: Presence,
    pub doc: &'static str,
}

/// The values that a key takes.
pub(crate) enum Kind {
    Bool,
    /// A finite number, and its way to SI.
    Number(Range, Unit),
    /// A whole number, both ends included; then what it is multiplied by.
    Integer(i64, i64, i64),
    /// 1 to 32 letters, digits, '-' or '_': fit for file names.
    Name,
    /// Text that is not empty.
    Text,
    /// The name of a file that must exist, relative to the configuration's folder.
    File,
    /// The name of a folder that is there or can be made, relative to the configuration's folder.
    Folder,
    /// One of the names; then the names that the design knows and this version does not build.
    Choice(&'static [&'static str], &'static [&'static str]),
    /// An array of this many numbers.
    Numbers(usize, Range, Unit),
    /// Pairs of numbers.
    Rows,
    /// At least one name.
    Names,
    /// At least one of the choices.
    Choices(&'static [&'static str]),
    Table(&'static Table),
    /// One or more tables.
    Tables(&'static Table),
    /// The first kind whose TOML type fits.
    Either(&'static Kind, &'static Kind),
}

/// How a number in the file becomes one in SI units.
#[derive(Clone, Copy)]
pub(crate) enum Unit {
    /// Times ten to this power.
    Power(i32),
    Degrees,
}

/// Whether a key may be left out.
pub(crate) enum Presence {
    /// Must be there. With an example for the template (tables have none).
    Required(&'static str),
    /// May be left out: this TOML text then stands in its place.
    Default(&'static str),
    /// May be left out, and then does nothing. Commented out in the template.
    Optional(&'static str),
    /// As `Default`; the template has the second text in its place.
    Set(&'static str, &'static str),
    /// Whether it must be there depends on other keys; the template has it.
    Shown(&'static str),
}
use Presence::{Default, Optional, Required, Set, Shown};

/// Numbers from `min` (itself only if `min_included`) to `max`.
#[derive(Clone, Copy)]
pub(crate) struct Range {
    pub min: f64,
    pub(crate) min_included: bool,
    pub max: f64,
}

const fn from(min: f64, max: f64) -> Range {
    Range {
        min,
        min_included: true,
        max,
    }
}

const fn above(min: f64, max: f64) -> Range {
    Range {
        min,
        min_included: false,
        max,
    }
}

/// A field's name without the `r#` that a Rust keyword needs.
const fn key_name(field: &'static str) -> &'static str {
    match field.as_bytes() {
        [b'r', b'#', ..] => field.split_at(2).1,
        _ => field,
    }
}

/// The [`Kind`] that a declaration names.
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
    (ChoiceOrRows($($choice:tt)*)) => { Kind::Either(&kind!(Choice($($choice)*)), &Kind::Rows) };
    (ChoiceOrTable($table:ident: $($choice:tt)*)) => { Kind::Either(&kind!(Choice($($choice)*)), &kind!(Table($table))) };
    (Choices($($name:literal),+)) => { Kind::Choices(&[$($name),+]) };
    (Table($table:path)) => { Kind::Table(&<$table as Declared>::TABLE) };
    (Tables($table:path)) => { Kind::Tables(&<$table as Declared>::TABLE) };
    ($($plain:tt)+) => { Kind::$($plain)+ };
}

/// The type that a value of a kind is read into.
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
    (ChoiceOrRows($($choice:tt)*)) => { ChoiceOr<Vec<(f64, f64)>> };
    (ChoiceOrTable($table:ident: $($choice:tt)*)) => { ChoiceOr<$table> };
    (Table($table:path)) => { $table };
    (Tables($table:path)) => { Vec<$table> };
    ($number:ident($range:expr)) => { f64 };
}

/// Declares a table: its meaning, its name, and of each key the meaning, the name, the kind and whether it may be left out.
macro_rules! table {
    (
        $(#[doc = $about:literal])+
        $table:ident $(, later $($later:literal),+)?;
        $(
            $(#[doc = $doc:literal])*
            $key:ident: $kind:ident $(($($rule:tt)*))?, $presence:expr;
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
mod nav;
pub(crate) mod samples;
mod scene;
mod sonar;
pub(crate) mod trigger;

pub(crate) use nav::*;
pub(crate) use scene::*;
pub(crate) use sonar::*;

// The ranges are those outside of which a value is surely a slip (a wrong unit, a lost digit), not those of good taste.
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
    sonar: Tables(Sonar), Required("");
    fault: Tables(faults::Fault), Optional("");
}

table! {
    /// The water: one sound speed everywhere.
    Medium, later "profile", "sound_speed_profile";
    sound_speed_m_per_s: Number(from(300.0, 3000.0)), Default("1500.0");

    /// Francois and Garrison 1982, Ainslie and McColm 1998, nothing, or a number: { db_per_km = 30.0 }, one way.
    absorption: ChoiceOrTable(FixedAbsorption: "francois-garrison", "ainslie-mccolm", "none"; later "thorp"), Default("\"francois-garrison\"");

    /// This and the next three feed the absorption law only.
    temperature_c: Number(from(-4.0, 40.0)), Default("10.0");

    /// 0 for a lake.
    salinity_psu: Number(from(0.0, 50.0)), Default("35.0");
    depth_m: Number(from(0.0, 11_000.0)), Default("50.0");
    ph: Number(from(6.0, 9.0)), Default("8.0");
}

table! {
    /// A given absorption.
    FixedAbsorption;

    /// One way.
    db_per_km: PerKm(from(0.0, 10_000.0)), Required("30.0");
}

table! {
    /// Pacing and threads.
    Run, later "cores";

    /// 0: as many as there are cores. The samples do not depend on it.
    threads: Integer(0, 1024), Default("0");

    /// A ping is delivered this long after its listening window; later is a deadline miss.
    latency_ms: Ms(from(0.0, 600_000.0)), Default("200.0");

    /// The counters are printed this often.
    status_interval_s: Number(from(0.1, 86_400.0)), Default("10.0");

    /// Pings that may wait for their delivery.
    queue_pings: Integer(1, 10_000), Default("4");

    /// What becomes of a ping that had to wait for others and cannot be ready in time: it is left out; or made with a tolerance ten times looser,
    /// and ten times again, back when there is room; or pulses come later, no faster than pings can be made. Counted, and told in truth.jsonl;
    /// then, and only then, the samples depend on the machine. With clock = "fast" and "lockstep" nothing is late.
    overload: Choice("skip", "degrade", "stretch"), Default("\"skip\"");

    /// Every ping takes at least so long to compute, and half of it at each looser tolerance: to see what an overload does. Without effect with
    /// clock = "fast" and "lockstep".
    simulated_compute_ms: Ms(from(0.0, 600_000.0)), Default("0.0");

    /// "streaming": element samples (vita49, elements) leave as they would be heard, block by block, each stream_latency_ms after its end; the
    /// ping is computed before that, whole: ahead_ms before its pulse, or, where somebody else triggers it, after, and stream_latency_ms must
    /// have room for it; so nav.mode must be "predict". All else leaves at the end of the ping. The samples are the same.
    delivery: Choice("ping-end", "streaming"), Default("\"ping-end\"");

    /// Only with delivery = "streaming".
    stream_block_ms: Ms(from(0.1, 1000.0)), Default("1.0");

    /// Constant. Only with delivery = "streaming".
    stream_latency_ms: Ms(from(0.0, 600_000.0)), Default("0.5");

    /// A ping is computed tile by tile, each twice as long as the one before, and its first blocks leave meanwhile, so that stream_latency_ms
    /// needs room for the first alone, and that for none of the scene where nothing is near enough to be heard in it: for pulses that nobody
    /// knows beforehand, on a machine that makes a ping in a quarter of its window. Only with delivery = "streaming", model.synthesis =
    /// "reference" or "direct", without error checks, further pulses and passband samples.
    stream_tiles: Bool, Default("false");

    /// A ping is computed so long before its pulse, by the settings and from the motion known then; at least what a ping takes. Left out: 0, and
    /// 100 with delivery = "streaming". Above 0 only with nav.mode = "predict".
    ahead_ms: Ms(from(0.0, 10_000.0)), Shown("100.0");

    /// "scaled": clock_rate times as fast; "fast": as fast as pings can be computed; "lockstep": a ping for every step that is asked for
    /// (echotank ctl step). All but "realtime" need recorded navigation. The samples do not depend on it.
    clock: Choice("realtime", "scaled", "fast", "lockstep"), Default("\"realtime\"");

    /// Only with clock = "scaled".
    clock_rate: Number(from(0.1, 1000.0)), Default("10.0");

    /// A ping's datagrams leave evenly over a part of the time to the next ping, or all at once, which a receiver with a socket buffer of stock
    /// size loses most of. TCP loses nothing: see pace_tcp. With clock = "fast" and "lockstep" always all at once.
    pace: Choice("spread", "burst"), Default("\"spread\"");

    /// The part. Only with pace = "spread".
    pace_share: Number(from(0.01, 0.95)), Default("0.8");

    /// Records of 7k, JSF, WBMS and the Ping protocol are spread over TCP too, by the kernel (Linux); otherwise as fast as a client takes them.
    /// Only with pace = "spread".
    pace_tcp: Bool, Default("false");

    /// SCHED_FIFO priority of the threads that hand pings over, and memory locked, where the system allows it (echotank doctor); 0: neither.
    priority: Integer(0, 99), Default("40");

    /// Nice value of the threads that compute pings, where the system allows it (echotank doctor): the lower, the larger their share of the
    /// processors beside other programs that only count; -20 leaves those a hundredth. 0: as any other program.
    compute_nice: Integer(-20, 0), Default("0");

    /// Where faults-TIME.jsonl and overload-TIME.jsonl go; left out: record.directory (with overload = "skip" the first alone), and without that
    /// nowhere.
    fault_directory: Folder, Optional("\"out\"");

    /// What methods cost on this machine, as `echotank check --calibrate FILE` writes it; left out: the table that comes with the program. What
    /// is "auto" is chosen by it.
    costs: File, Optional("\"costs.toml\"");
}

table! {
    /// Records everything that is sent. Leave the table out for no recording.
    Record, later "formats", "max_gib";

    /// Made if it is not there.
    directory: Folder, Required("\"out\"");
}

table! {
    /// Control over HTTP: the operator's page at http://ADDRESS/, POST /control, GET /status, /metrics, /healthz. Without `listen` there is none.
    Control;

    /// Address and port.
    listen: Text, Optional("\"127.0.0.1:7780\"");

    /// Asked of whoever controls, as `Authorization: Bearer TOKEN` or on the page. Needed where `listen` is not this machine alone.
    token: Text, Optional("\"a long secret\"");
}

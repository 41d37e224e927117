//! Raw tables to checked specifications: every rule that needs more than one key, and the change to SI.
//!
//! Each function reads one table and gives its part of the specification, or none if something in it is on the list of problems already.
//! Where a value is missing the checks that need it are passed over, and all others still made: one reading says everything.

mod culling;
mod devices;
mod families;
mod faults;
mod nav;
mod output;
mod overload;
mod picture;
mod samples;
mod scene;
pub(super) mod sonar;
mod streaming;
mod trigger;

use std::collections::HashMap;
use std::net::{IpAddr, Ipv4Addr, SocketAddr};
use std::path::Path;

use super::keys;
use super::problem::{ConfigErrors, Problem};
use super::raw::{self, Problems, RawEntry, RawTable, plain};
use super::spec::*;

const MIB: u64 = 1 << 20;

/// Reads and checks a configuration file, and that the files it names can be read. Opens nothing else.
pub fn load(path: &Path) -> Result<RigSpec, ConfigErrors> {
    let unreadable = |why: String| ConfigErrors {
        file: Some(path.to_owned()),
        problems: vec![Problem {
            rule: format!("cannot be read: {why}"),
            ..Problem::default()
        }],
    };
    let bytes = std::fs::read(path).map_err(|e| unreadable(plain(&e)))?;
    let text = String::from_utf8(bytes).map_err(|e| {
        let byte = e.utf8_error().valid_up_to();
        unreadable(format!("byte {byte} is not UTF-8"))
    })?;
    let base_dir = path.parent().unwrap_or(Path::new("."));
    parse(&text, base_dir).map_err(|errors| ConfigErrors {
        file: Some(path.to_owned()),
        ..errors
    })
}

/// Checks a configuration's text; relative file names in it count from `base_dir`.
pub fn parse(text: &str, base_dir: &Path) -> Result<RigSpec, ConfigErrors> {
    let mut problems = Problems::default();
    let checked = raw::read(text, base_dir, &keys::RIG, &mut problems)
        .and_then(|table| rig(&table, text, &mut problems));
    let mut problems = problems.0;
    // Problems without a line concern the whole file and come first.
    problems.sort_by(|a, b| (a.line, &a.path).cmp(&(b.line, &b.path)));
    problems.dedup();
    if checked.is_none() && problems.is_empty() {
        // The programmer's mistake, found by tests; the operator gets a sentence and no panic.
        debug_assert!(false, "a part is missing and no problem says why");
        problems.push(Problem {
            rule: "refused without a reason: please report this file".to_owned(),
            ..Problem::default()
        });
    }
    match checked {
        Some(spec) if problems.is_empty() => Ok(spec),
        _ => Err(ConfigErrors {
            file: None,
            problems,
        }),
    }
}

// ---------------------------------------------------------------- what the rules share

/// `keys` mean something only while `holds`; given otherwise they are a misunderstanding.
fn only_with(
    table: &RawTable,
    keys: &[&str],
    holds: Option<bool>,
    condition: &str,
    problems: &mut Problems,
) {
    if holds != Some(false) {
        return;
    }
    let entries = keys.iter().map(|key| table.entry(key));
    // What is wrong already is on the list.
    for entry in entries.filter(|e| e.given && e.value.is_some()) {
        problems.refuse(entry, format!("only with {condition}"));
    }
}

/// `key` must be given where `holds`.
fn needed_with(
    table: &RawTable,
    key: &str,
    holds: Option<bool>,
    condition: &str,
    problems: &mut Problems,
) {
    if holds == Some(true) && !table.given(key) {
        problems.refuse(
            table.entry(key),
            format!("missing: needed with {condition}"),
        );
    }
}

/// Names of `tables`, each of which must be another.
fn unique_names<'t>(tables: &'t [RawTable], problems: &mut Problems) -> Vec<Option<&'t str>> {
    let mut seen = HashMap::new();
    tables
        .iter()
        .map(|table| {
            let name = table.text("name")?;
            if let Some(other) = seen.insert(name, &table.path) {
                problems.refuse(
                    table.entry("name"),
                    format!("must be a name of its own; {other} has it too"),
                );
            }
            Some(name)
        })
        .collect()
}

/// Index of the table called `name`.
fn index_of(
    name: &str,
    entry: &RawEntry,
    names: &[Option<&str>],
    what: &str,
    problems: &mut Problems,
) -> Option<usize> {
    let found = names.iter().position(|n| *n == Some(name));
    // Among names that cannot be read it may be there.
    if found.is_none() && names.iter().all(Option::is_some) {
        let rule = format!("must be the name of a {what}");
        problems.refuse_name(entry, rule, name, names.iter().flatten().copied());
    }
    found
}

fn address(table: &RawTable, key: &str, problems: &mut Problems) -> Option<SocketAddr> {
    let parsed = table.text(key)?.parse();
    if parsed.is_err() {
        problems.refuse(
            table.entry(key),
            "must be an address and a port, such as \"127.0.0.1:7000\"",
        );
    }
    parsed.ok()
}

/// All of `parts`, or none if one is missing.
fn all<T>(parts: Vec<Option<T>>) -> Option<Vec<T>> {
    parts.into_iter().collect()
}

/// Somebody who wants a port of this machine.
pub(super) struct Listener<'t> {
    entry: &'t RawEntry,
    protocol: &'static str,
    address: SocketAddr,
    multicast: bool,
}

/// Two cannot have one port; port 0 means any free one, and members of multicast groups share.
fn refuse_port_clashes(listeners: &[Listener<'_>], problems: &mut Problems) {
    for (i, one) in listeners.iter().enumerate() {
        let clash = listeners[..i].iter().find(|other| {
            let same_host = one.address.ip() == other.address.ip()
                || one.address.ip().is_unspecified()
                || other.address.ip().is_unspecified();
            one.protocol == other.protocol
                && one.address.port() != 0
                && one.address.port() == other.address.port()
                && same_host
                && !(one.multicast && other.multicast)
        });
        if let Some(other) = clash {
            problems.refuse(
                one.entry,
                format!(
                    "{} port taken already by {}",
                    one.protocol, other.entry.path
                ),
            );
        }
    }
}

// ---------------------------------------------------------------- the rig

fn rig(table: &RawTable, text: &str, problems: &mut Problems) -> Option<RigSpec> {
    let mut listeners = Vec::new();
    let medium = table.table("medium").and_then(medium);
    let nav = table
        .table("nav")
        .and_then(|t| nav(t, &mut listeners, problems));
    let run = table.table("run").and_then(|t| run(t, problems));
    if let (Some(nav), Some(t)) = (&nav, table.table("run")) {
        refuse_own_time_with_live_sources(nav, t, problems);
        streaming::refuse_without_foresight(nav, t, problems);
    }
    let control = table
        .table("control")
        .and_then(|t| control(t, &mut listeners, problems));

    let tables = table.tables("sonar");
    let names = unique_names(tables, problems);
    let mut sonars: Vec<_> = tables
        .iter()
        .enumerate()
        .map(|(k, t)| sonar::sonar(t, (k, &names), medium.as_ref(), &mut listeners, problems))
        .collect();
    trigger::refuse_what_nobody_can_trigger(tables, &sonars, run.as_ref(), problems);
    let longest_range_m = tables
        .iter()
        .filter_map(sonar::longest_range_m)
        .fold(0.0, f64::max);
    let ground_alone = table
        .table("scene")
        .is_some_and(|t| t.given("seabed") && !t.given("points"));
    if let (Some(medium), true) = (&medium, ground_alone) {
        for sonar in sonars.iter_mut().flatten() {
            let auto = sonar.synthesis.auto.synthesis;
            let keeps = auto || sonar.model.synthesis.keeps_tolerance();
            if sonar.model.cull_db.is_none() && keeps {
                sonar.model.cull_db = culling::floor_db(sonar, medium.sound_speed_m_per_s);
                sonar.synthesis.auto.cull = auto;
            }
        }
    }
    let heads: Vec<_> = sonars.iter().flatten().collect();
    if let (Some(nav), Some(medium), Some(t)) = (&nav, &medium, table.table("run")) {
        streaming::refuse_out_of_sight(nav, t, &heads, medium, problems);
    }
    if let Some(t) = table.table("run") {
        overload::refuse_what_has_nothing_to_give(t, &heads, problems);
        streaming::refuse_what_has_no_tiles(t, &heads, problems);
    }
    let rig = scene::Rig {
        sonars: &heads,
        sound_speed_m_per_s: medium.as_ref().map(|m| m.sound_speed_m_per_s),
        longest_range_m,
    };
    let scene = table
        .table("scene")
        .and_then(|t| scene::scene(t, &rig, problems));
    if let (Some(nav), Some(t)) = (&nav, table.table("scene")) {
        refuse_place_without_earth(nav, t, problems);
    }
    let faults = faults::faults(table.tables("fault"), problems);
    for (sonar, t) in sonars.iter_mut().zip(tables) {
        if let Some(sonar) = sonar {
            output::who_needs_elements(sonar, t, control.as_ref(), &faults, problems);
        }
    }
    refuse_port_clashes(&listeners, problems);
    refuse_files_without_a_folder(table, problems);

    Some(RigSpec {
        source_text: text.to_owned(),
        medium: medium?,
        nav: nav?,
        scene: scene?,
        run: run?,
        record: match table.given("record") {
            true => Some(RecordSpec {
                directory: table.table("record")?.path("directory")?,
            }),
            false => None,
        },
        control: control?,
        faults,
        sonars: all(sonars).filter(|s| !s.is_empty())?,
    })
}

/// Outputs that are files need a folder.
fn refuse_files_without_a_folder(table: &RawTable, problems: &mut Problems) {
    if table.given("record") {
        return;
    }
    let outputs = table
        .tables("sonar")
        .iter()
        .filter_map(|t| t.table("output"));
    for output in outputs {
        for key in ["sigmf", "wav"].into_iter().filter(|key| output.given(key)) {
            problems.refuse(output.entry(key), "needs a folder: [record]");
        }
        if output.given("xtf") {
            problems.refuse(output.entry("xtf"), "needs a folder: [record]");
        }
        if let Some(jsf) = output.table("jsf")
            && output.given("jsf")
            && jsf.bool("record") == Some(true)
        {
            problems.refuse(jsf.entry("record"), "needs a folder: [record]");
        }
    }
}

/// A scene that lies where its file says needs to know where on the earth the platform is.
fn refuse_place_without_earth(nav: &NavSpec, scene: &RawTable, problems: &mut Problems) {
    let in_metres = |s: &NavSourceSpec| matches!(s.input, NavInputSpec::Csv { .. });
    let nowhere = nav.origin == OriginSpec::FirstFix && nav.sources.iter().all(in_metres);
    if nowhere && scene.text("anchor") == Some("file") {
        let rule = "needs a place on the earth: every nav.source is a track in metres, and nav.origin is not given";
        problems.refuse(scene.entry("anchor"), rule);
    }
}

fn medium(table: &RawTable) -> Option<MediumSpec> {
    let water = || {
        Some(Water {
            temperature_c: table.number("temperature_c")?,
            salinity: table.number("salinity_psu")?,
            depth_m: table.number("depth_m")?,
            ph: table.number("ph")?,
        })
    };
    let absorption = match (table.text("absorption"), table.table("absorption")) {
        (Some("none"), _) => Some(AbsorptionSpec::None),
        (Some("francois-garrison"), _) => water().map(AbsorptionSpec::FrancoisGarrison),
        (Some("ainslie-mccolm"), _) => water().map(AbsorptionSpec::AinslieMcColm),
        (_, Some(fixed)) => fixed
            .scaled("db_per_km", -3)
            .map(|db_per_m| AbsorptionSpec::Fixed { db_per_m }),
        _ => None,
    };
    Some(MediumSpec {
        sound_speed_m_per_s: table.number("sound_speed_m_per_s")?,
        absorption: absorption?,
    })
}

/// Live measurements come in the machine's time; a rig with a time of its own would take them for early or late.
fn refuse_own_time_with_live_sources(nav: &NavSpec, run: &RawTable, problems: &mut Problems) {
    let own_time = run.text("clock").is_some_and(|clock| clock != "realtime");
    if own_time && !nav.is_recorded() {
        let rule = "only with recorded navigation: every nav.source of kind \"log\" or \"csv\"";
        problems.refuse(run.entry("clock"), rule);
    }
    let own = matches!(run.text("clock"), Some("fast" | "lockstep"));
    if own && !nav.outputs.is_empty() {
        let rule = "nav.output shares the pings' clock with devices, and this one is nobody's";
        problems.refuse(run.entry("clock"), rule);
    }
}

fn control<'t>(
    table: &'t RawTable,
    listeners: &mut Vec<Listener<'t>>,
    problems: &mut Problems,
) -> Option<ControlSpec> {
    let token = table.text("token").map(str::to_owned);
    let listen = match table.given("listen") {
        true => Some(address(table, "listen", problems)?),
        false => None,
    };
    if let Some(address) = listen {
        listeners.push(Listener {
            entry: table.entry("listen"),
            protocol: "TCP",
            address,
            multicast: false,
        });
        let abroad = !address.ip().is_loopback();
        let condition = "a `listen` that is not this machine alone";
        needed_with(table, "token", Some(abroad), condition, problems);
    }
    Some(ControlSpec {
        listen,
        token,
        or_any_port: false,
    })
}

fn run(table: &RawTable, problems: &mut Problems) -> Option<RunSpec> {
    let clock = table.text("clock");
    let scaled = clock.map(|clock| clock == "scaled");
    let condition = "clock = \"scaled\"";
    only_with(table, &["clock_rate"], scaled, condition, problems);
    let spread = table.text("pace").map(|pace| pace == "spread");
    only_with(
        table,
        &["pace_share", "pace_tcp"],
        spread,
        "pace = \"spread\"",
        problems,
    );
    let delivery = streaming::delivery(table, problems);
    Some(RunSpec {
        spread_share: match spread? {
            true => Some(table.number("pace_share")?),
            false => None,
        },
        pace_tcp: table.bool("pace_tcp")?,
        delivery: delivery?,
        stream_tiles: table.bool("stream_tiles")?,
        overload: match table.text("overload")? {
            "degrade" => OverloadSpec::Degrade,
            "stretch" => OverloadSpec::Stretch,
            _ => OverloadSpec::Skip,
        },
        simulated_compute_s: table.scaled("simulated_compute_ms", -3)?,
        ahead_s: streaming::ahead_s(table)?,
        clock: match clock? {
            "scaled" => ClockSpec::Scaled(table.number("clock_rate")?),
            "fast" => ClockSpec::Fast,
            "lockstep" => ClockSpec::Lockstep,
            _ => ClockSpec::RealTime,
        },
        priority: u8::try_from(table.integer("priority")?).ok()?,
        compute_nice: i8::try_from(table.integer("compute_nice")?).ok()?,
        fault_directory: table.path("fault_directory"),
        costs: table.path("costs"),
        threads: table.count("threads")?,
        latency_s: table.scaled("latency_ms", -3)?,
        status_interval_s: table.number("status_interval_s")?,
        queue_pings: table.count("queue_pings")?,
    })
}

// ---------------------------------------------------------------- navigation

fn nav<'t>(
    table: &'t RawTable,
    listeners: &mut Vec<Listener<'t>>,
    problems: &mut Problems,
) -> Option<NavSpec> {
    let tables = table.tables("source");
    unique_names(tables, problems);
    let sources: Vec<_> = tables
        .iter()
        .map(|t| nav_source(t, listeners, problems))
        .collect();
    refuse_missing_channels(table, tables, problems);

    let kinds: Vec<_> = tables.iter().map(|t| t.text("kind")).collect();
    let recorded = |kind: &Option<&str>| matches!(kind, Some("log" | "csv"));
    let kinds_known = !kinds.is_empty() && kinds.iter().all(Option::is_some);
    let any_recorded = kinds_known.then(|| kinds.iter().any(recorded));
    let mode = match table.text("mode") {
        Some("predict") => NavMode::Predict,
        None if !kinds.iter().all(recorded) => NavMode::Predict,
        _ => NavMode::Settle,
    };
    let mode_known = match table.given("mode") {
        true => table.text("mode").is_some(),
        false => kinds_known,
    };
    only_with(
        table,
        &["max_extrapolation_ms", "on_lost"],
        mode_known.then_some(mode == NavMode::Predict),
        "mode = \"predict\"",
        problems,
    );
    if table.bool("loop") == Some(true) {
        let condition = "a source of kind \"log\" or \"csv\"";
        only_with(table, &["loop"], any_recorded, condition, problems);
    }
    let failing_over = Some(table.given("failover_s"));
    only_with(table, &["hold_off_s"], failing_over, "failover_s", problems);
    only_with(
        table,
        &["max_speed_m_per_s", "max_turn_rate_deg_per_s"],
        table.bool("jump_gate"),
        "jump_gate = true",
        problems,
    );
    if let (Some(stale_s), Some(lost_s)) = (table.number("stale_s"), table.number("lost_s"))
        && lost_s < stale_s
    {
        problems.refuse(table.entry("lost_s"), "must not be below stale_s");
    }
    let vertical = vertical(table, problems);
    let origin = origin(table);
    refuse_unfit_track(table, tables, vertical, problems);
    let tow = match table.table("tow") {
        Some(t) => {
            if matches!(vertical, Some(VerticalSpec::Gnss { .. })) {
                let rule =
                    "must not be \"gnss\" where the sonar is towed: the antenna is the ship's";
                problems.refuse(table.entry("vertical"), rule);
            }
            Some(nav::tow(t))
        }
        None => None,
    };
    let outputs = nav::outputs(table.tables("output"), listeners, problems);

    Some(NavSpec {
        origin: origin?,
        mode,
        vertical: vertical?,
        stamp: match table.text("stamp")? {
            "host" => StampSpec::Host,
            _ => StampSpec::Log,
        },
        loop_log: table.bool("loop")?,
        max_extrapolation_s: table.scaled("max_extrapolation_ms", -3)?,
        history_s: table.number("history_s")?,
        fallback_heading_from_course: table.bool("heading_from_course")?,
        failover: match table.number("failover_s") {
            Some(after_s) => Some(FailoverSpec {
                after_s,
                hold_off_s: table.number("hold_off_s")?,
            }),
            None => None,
        },
        jump_gate: match table.bool("jump_gate")? {
            true => Some(JumpGateSpec {
                max_speed_m_per_s: table.number("max_speed_m_per_s")?,
                max_rate_rad_per_s: table.angle_rad("max_turn_rate_deg_per_s")?,
            }),
            false => None,
        },
        stale_s: table.number("stale_s")?,
        lost_s: table.number("lost_s")?,
        on_lost: match table.text("on_lost")? {
            "hold" => OnLost::Hold,
            _ => OnLost::Skip,
        },
        tow: match tow {
            Some(tow) => Some(tow?),
            None => None,
        },
        outputs: outputs?,
        sources: all(sources).filter(|s| !s.is_empty())?,
    })
}

fn origin(table: &RawTable) -> Option<OriginSpec> {
    match table.table("origin") {
        Some(given) => Some(OriginSpec::Geodetic {
            latitude_rad: given.angle_rad("latitude_deg")?,
            longitude_rad: given.angle_rad("longitude_deg")?,
        }),
        None => table.text("origin").map(|_| OriginSpec::FirstFix),
    }
}

fn vertical(table: &RawTable, problems: &mut Problems) -> Option<VerticalSpec> {
    let choice = table.text("vertical");
    for (key, needs) in [
        ("reference_depth_m", "waterline"),
        ("datum_offset_m", "gnss"),
    ] {
        only_with(
            table,
            &[key],
            choice.map(|c| c == needs),
            &format!("vertical = \"{needs}\""),
            problems,
        );
    }
    Some(match choice? {
        "waterline" => VerticalSpec::Waterline {
            reference_down_m: table.number("reference_depth_m")?,
        },
        "gnss" => VerticalSpec::Gnss {
            datum_offset_m: table.number("datum_offset_m")?,
        },
        _ => VerticalSpec::Depth,
    })
}

/// The first source that provides `channel`; none also while a source's list is not known.
fn owner<'t>(tables: &'t [RawTable], channel: &str) -> Option<&'t RawTable> {
    tables.iter().find(|t| {
        t.texts("provides")
            .is_some_and(|p| p.iter().any(|c| c == channel))
    })
}

fn refuse_missing_channels(table: &RawTable, tables: &[RawTable], problems: &mut Problems) {
    if tables.is_empty() || tables.iter().any(|t| t.texts("provides").is_none()) {
        return;
    }
    let sources = table.entry("source");
    if owner(tables, "position").is_none() {
        problems.refuse(sources, "one source must provide \"position\"");
    }
    if owner(tables, "heading").is_some() {
        return;
    }
    match table.bool("heading_from_course") {
        Some(false) => problems.refuse(
            sources,
            "one source must provide \"heading\", or heading_from_course must be true",
        ),
        Some(true) if owner(tables, "course-speed").is_none() => problems.refuse(
            sources,
            "heading_from_course needs a source that provides \"course-speed\"",
        ),
        _ => {}
    }
}

/// A CSV track says its depth itself and knows no latitude.
fn refuse_unfit_track(
    table: &RawTable,
    tables: &[RawTable],
    vertical: Option<VerticalSpec>,
    problems: &mut Problems,
) {
    let (Some(vertical), Some(owner)) = (vertical, owner(tables, "position")) else {
        return;
    };
    let Some(kind) = owner.text("kind") else {
        return;
    };
    let (is_csv, is_depth) = (kind == "csv", vertical == VerticalSpec::Depth);
    if is_csv && !is_depth {
        problems.refuse(
            table.entry("vertical"),
            "must be \"depth\" where the position comes from a CSV track",
        );
    }
    if is_depth && !is_csv && self::owner(tables, "depth").is_none() {
        problems.refuse(
            table.entry("vertical"),
            "needs a position from a CSV track, or a source that provides \"depth\"",
        );
    }
    if is_csv && table.text("origin").is_some() {
        problems.refuse(
            table.entry("origin"),
            "a CSV track has no latitude: must be { latitude_deg, longitude_deg }",
        );
    }
}

fn nav_source<'t>(
    table: &'t RawTable,
    listeners: &mut Vec<Listener<'t>>,
    problems: &mut Problems,
) -> Option<NavSourceSpec> {
    let kind = table.text("kind");
    let is = |wanted: &str| kind.map(|k| k == wanted);
    let is_file = kind.map(|k| k == "log" || k == "csv");
    only_with(
        table,
        &["path"],
        is_file,
        "kind = \"log\" or \"csv\"",
        problems,
    );
    needed_with(
        table,
        "path",
        is_file,
        "kind = \"log\" or \"csv\"",
        problems,
    );
    only_with(
        table,
        &["plain_rate_hz"],
        is("log"),
        "kind = \"log\"",
        problems,
    );
    only_with(
        table,
        &["listen"],
        kind.map(|k| k == "udp" || k == "tcp"),
        "kind = \"udp\" or \"tcp\"",
        problems,
    );
    only_with(table, &["multicast"], is("udp"), "kind = \"udp\"", problems);
    only_with(table, &["connect"], is("tcp"), "kind = \"tcp\"", problems);
    if is("tcp") == Some(true) && table.given("listen") == table.given("connect") {
        let rule = "tcp needs either `connect` (a server's address) or `listen` (for a client)";
        problems.refuse(table.entry("kind"), rule);
    }
    needed_with(table, "listen", is("udp"), "kind = \"udp\"", problems);
    only_with(
        table,
        &["port", "baud", "line"],
        is("serial"),
        "kind = \"serial\"",
        problems,
    );
    needed_with(table, "port", is("serial"), "kind = \"serial\"", problems);
    needed_with(table, "baud", is("serial"), "kind = \"serial\"", problems);
    only_with(
        table,
        &[
            "time",
            "latency_ms",
            "checksum",
            "ignore_checksum_for",
            "format",
            "variants",
            "reverse",
            "magnetic_variation_deg",
        ],
        is("csv").map(|csv| !csv),
        "sentences, which a CSV track has not",
        problems,
    );
    only_with(
        table,
        &["latency_ms"],
        table.text("time").map(|t| t == "arrival"),
        "time = \"arrival\"",
        problems,
    );

    let input = nav_input(table, listeners, problems);
    Some(NavSourceSpec {
        name: table.text("name")?.to_owned(),
        input: input?,
        time: match table.text("time")? {
            "burst" => TimePolicy::Burst,
            "arrival" => TimePolicy::Arrival {
                latency_s: table.scaled("latency_ms", -3)?,
            },
            _ => TimePolicy::Message,
        },
        checksum: match table.text("checksum")? {
            "accept-missing" => ChecksumPolicy::AcceptMissing,
            "ignore" => ChecksumPolicy::Ignore,
            _ => ChecksumPolicy::Require,
        },
        lever_arm_m: table.vector("lever_arm_m")?,
        mounting: SensorMounting {
            heave_arm_m: table.vector("heave_arm_m")?,
            angles_rad: table.vector("mounting_deg")?.map(f64::to_radians),
        },
        dialect: dialect(table)?,
        provides: table
            .texts("provides")?
            .iter()
            .map(|c| channel(c))
            .collect(),
    })
}

fn dialect(table: &RawTable) -> Option<NavDialect> {
    let says = |key: &str, word: &str| {
        let words = table.texts(key);
        words.is_some_and(|words| words.iter().any(|w| w == word))
    };
    let formats = [
        NavFormat::Nmea,
        NavFormat::Tss1,
        NavFormat::Em3000,
        NavFormat::Seapath26,
        NavFormat::Kmb,
    ];
    let format = table.text("format")?;
    Some(NavDialect {
        format: formats.into_iter().find(|f| f.name() == format)?,
        ignore_checksum_for: table
            .texts("ignore_checksum_for")
            .unwrap_or_default()
            .to_vec(),
        pashr_heave_up: says("variants", "pashr-heave-up"),
        depth_is_own: says("variants", "own-depth"),
        reversed: Reversed {
            roll: says("reverse", "roll"),
            pitch: says("reverse", "pitch"),
            heave: says("reverse", "heave"),
        },
        magnetic_variation_rad: table.angle_rad("magnetic_variation_deg"),
    })
}

fn channel(name: &str) -> NavChannel {
    match name {
        "position" => NavChannel::Position,
        "course-speed" => NavChannel::CourseSpeed,
        "heading" => NavChannel::Heading,
        "roll-pitch" => NavChannel::RollPitch,
        "depth" => NavChannel::Depth,
        _ => NavChannel::Heave,
    }
}

fn nav_input<'t>(
    table: &'t RawTable,
    listeners: &mut Vec<Listener<'t>>,
    problems: &mut Problems,
) -> Option<NavInputSpec> {
    match table.text("kind")? {
        "log" => Some(NavInputSpec::Log {
            path: table.path("path")?,
            plain_rate_hz: table.number("plain_rate_hz")?,
        }),
        "csv" => Some(NavInputSpec::Csv {
            path: table.path("path")?,
        }),
        "udp" => {
            let multicast = table.text("multicast").map(|text| {
                let group = text.parse().ok().filter(Ipv4Addr::is_multicast);
                if group.is_none() {
                    problems.refuse(
                        table.entry("multicast"),
                        "must be an IPv4 multicast group, 224.0.0.0 to 239.255.255.255",
                    );
                }
                group
            });
            let listen = address(table, "listen", problems)?;
            if multicast.is_some() && !matches!(listen.ip(), IpAddr::V4(_)) {
                problems.refuse(
                    table.entry("listen"),
                    "must be an IPv4 address where there is a multicast group",
                );
            }
            listeners.push(Listener {
                entry: table.entry("listen"),
                protocol: "UDP",
                address: listen,
                multicast: multicast.is_some(),
            });
            Some(NavInputSpec::Udp {
                listen,
                multicast: match multicast {
                    Some(group) => Some(group?),
                    None => None,
                },
            })
        }
        "tcp" if table.given("connect") => Some(NavInputSpec::TcpConnect {
            address: table.text("connect")?.to_owned(),
        }),
        "tcp" => {
            if !table.given("listen") {
                return None;
            }
            let listen = address(table, "listen", problems)?;
            listeners.push(Listener {
                entry: table.entry("listen"),
                protocol: "TCP",
                address: listen,
                multicast: false,
            });
            Some(NavInputSpec::TcpListen { listen })
        }
        _ => Some(NavInputSpec::Serial {
            port: table.text("port")?.to_owned(),
            baud: u32::try_from(table.integer("baud")?).ok()?,
            line: nav::serial_line(table)?,
        }),
    }
}

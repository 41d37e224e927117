//! Converts tables to checked specifications and enforces the rules that involve more than one key.
//!
//! Each function reads one table and returns its part of the specification, or `None` if the table has a problem. A check with a
//! missing value is skipped and all other checks are made, so one run lists every problem.

mod arrays;
pub(crate) mod culling;
pub(crate) mod density;
mod devices;
mod families;
mod faults;
mod instrument;
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
use std::sync::Arc;

use echotank_core::sound_speed::{ProfileRefused, SoundSpeedProfile};

use super::files::Files;
use super::keys;
use super::problem::{ConfigErrors, Problem};
use super::profile::read_profile;
use super::raw::{self, Entry, Field, Problems};
use super::spec::*;

const MIB: u64 = 1 << 20;

/// Reads and checks a configuration file. Also checks that the files named in it can be read.
pub fn load(path: &Path, files: &dyn Files) -> Result<RigSpec, ConfigErrors> {
    let unreadable = |why: String| ConfigErrors {
        file: Some(path.to_owned()),
        problems: vec![Problem {
            rule: format!("cannot be read: {why}"),
            ..Problem::default()
        }],
    };
    let bytes = files.read(path).map_err(unreadable)?;
    let text = String::from_utf8(bytes).map_err(|e| {
        let byte = e.utf8_error().valid_up_to();
        unreadable(format!("byte {byte} is not UTF-8"))
    })?;
    let base_dir = path.parent().unwrap_or(Path::new("."));
    parse(&text, base_dir, files).map_err(|errors| ConfigErrors {
        file: Some(path.to_owned()),
        ..errors
    })
}

/// Checks the text of a configuration. Relative file names in it are relative to `base_dir`.
pub fn parse(text: &str, base_dir: &Path, files: &dyn Files) -> Result<RigSpec, ConfigErrors> {
    let mut problems = Problems::default();
    let checked = raw::read(text, base_dir, files, &mut problems)
        .and_then(|table| rig(&table, text, files, &mut problems));
    let mut problems = problems.0;
    // Problems without a line concern the whole file and are listed first.
    problems.sort_by(|a, b| (a.line, &a.path).cmp(&(b.line, &b.path)));
    problems.dedup();
    if checked.is_none() && problems.is_empty() {
        // This is a programming error, which tests find. The operator gets a message instead of a panic.
        debug_assert!(false, "a part is missing and no problem says why");
        problems.push(Problem {
            rule: "refused without a stated rule; this is a bug, please report it with this file"
                .to_owned(),
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

/// The names of an array of tables. Repeated names are refused.
fn unique_names<'t>(
    names: impl Iterator<Item = &'t Field<String>>,
    problems: &mut Problems,
) -> Vec<Option<&'t str>> {
    let mut seen = HashMap::new();
    names
        .map(|field| {
            let name = field.text()?;
            if let Some(other) = seen.insert(name, &field.path) {
                let other = other.trim_end_matches(".name");
                let rule = format!("must be unique; {other} has the same name");
                problems.refuse(field, rule);
            }
            Some(name)
        })
        .collect()
}

/// Index of the table called `name`.
fn index_of(
    name: &str,
    entry: &Entry,
    names: &[Option<&str>],
    what: &str,
    problems: &mut Problems,
) -> Option<usize> {
    let found = names.iter().position(|n| *n == Some(name));
    // A name that could not be read may be the one that is searched for.
    if found.is_none() && names.iter().all(Option::is_some) {
        let rule = format!("must be the name of a {what}");
        problems.refuse_name(entry, rule, name, names.iter().flatten().copied());
    }
    found
}

fn address(key: &Field<String>, problems: &mut Problems) -> Option<SocketAddr> {
    let parsed = key.text()?.parse();
    if parsed.is_err() {
        let rule = "must be an address and a port, such as \"127.0.0.1:7000\"";
        problems.refuse(key, rule);
    }
    parsed.ok()
}

/// The address under `key`. The address is recorded as a port that this program opens.
fn listen<'t>(
    key: &'t Field<String>,
    protocol: &'static str,
    listeners: &mut Vec<Listener<'t>>,
    problems: &mut Problems,
) -> Option<SocketAddr> {
    let address = address(key, problems)?;
    listeners.push(Listener {
        entry: key,
        protocol,
        address,
        multicast: false,
    });
    Some(address)
}

/// All of `parts`; `None` if one is missing.
fn all<T>(parts: Vec<Option<T>>) -> Option<Vec<T>> {
    parts.into_iter().collect()
}

/// A port of this computer that an input or output opens.
pub(super) struct Listener<'t> {
    entry: &'t Entry,
    protocol: &'static str,
    address: SocketAddr,
    multicast: bool,
}

/// Refuses a port that is used twice. Port 0 means any free port, and members of multicast groups share a port.
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
            let rule = format!("{} port already used by {}", one.protocol, other.entry.path);
            problems.refuse(one.entry, rule);
        }
    }
}

// ---------------------------------------------------------------- the rig

fn rig(
    table: &keys::Rig,
    text: &str,
    files: &dyn Files,
    problems: &mut Problems,
) -> Option<RigSpec> {
    let mut listeners = Vec::new();
    let medium = table.medium.and_then(|t| medium(t, files, problems));
    let nav = table
        .nav
        .as_ref()
        .and_then(|t| nav(t, &mut listeners, problems));
    let run = table.run.and_then(run);
    if let (Some(nav), Some(t)) = (&nav, table.run.as_ref()) {
        refuse_scaled_clock_with_live_sources(nav, t, problems);
        streaming::refuse_ahead_without_prediction(nav, t, problems);
    }
    let control = table
        .control
        .as_ref()
        .and_then(|t| control(t, &mut listeners, problems));

    let tables = table.sonar.all();
    let names = unique_names(tables.iter().map(|t| &t.name), problems);
    let mut sonars: Vec<_> = tables
        .iter()
        .enumerate()
        .map(|(k, t)| sonar::sonar(t, (k, &names), medium.as_ref(), &mut listeners, problems))
        .collect();
    // Tiles leave before there is a whole ping to check.
    if run.as_ref().is_some_and(|run| run.stream_tiles) {
        for (sonar, t) in sonars.iter_mut().zip(tables) {
            let given = t.model.as_ref().is_some_and(|t| t.error_check.given);
            if let Some(sonar) = sonar.as_mut().filter(|_| !given) {
                sonar.synthesis.error_check = false;
            }
        }
    }
    trigger::refuse_trigger_conflicts(tables, &sonars, run.as_ref(), problems);
    let longest_range_m = tables
        .iter()
        .filter_map(sonar::longest_range_m)
        .fold(0.0, f64::max);
    let ground_alone = table
        .scene
        .as_ref()
        .is_some_and(|t| t.seabed.given && !t.points.given);
    if let (Some(medium), true) = (&medium, ground_alone) {
        for sonar in sonars.iter_mut().flatten() {
            let auto = sonar.synthesis.auto.synthesis;
            let keeps = auto || sonar.model.synthesis.keeps_tolerance();
            if sonar.model.cull_db.is_none() && keeps {
                sonar.model.cull_db = culling::floor_db(sonar, medium.sound_speed_m_per_s);
                sonar.synthesis.culls_by_window = true;
            }
        }
    }
    let heads: Vec<_> = sonars.iter().flatten().collect();
    if let (Some(nav), Some(medium), Some(t)) = (&nav, &medium, table.run.as_ref()) {
        streaming::refuse_long_prediction(nav, t, &heads, medium, problems);
    }
    if let Some(t) = table.run.as_ref() {
        overload::refuse_overload_conflicts(t, &heads, problems);
        streaming::refuse_tile_conflicts(t, &heads, problems);
    }
    let rig = scene::Rig {
        sonars: &heads,
        sound_speed_m_per_s: medium.as_ref().map(|m| m.sound_speed_m_per_s),
        longest_range_m,
    };
    let scene = table
        .scene
        .as_ref()
        .and_then(|t| scene::scene(t, &rig, problems));
    let scattering = medium
        .as_ref()
        .and_then(|m| m.surface.as_ref()?.scattering.as_ref());
    let of_surface = scattering.and_then(|_| match scene.as_ref()?.seabed.as_ref() {
        Some(seabed) => Some(seabed.density),
        None => density::auto(&rig, None, true),
    });
    if let (Some(nav), Some(t)) = (&nav, table.scene.as_ref()) {
        refuse_anchor_without_position(nav, t, problems);
    }
    if let (Some(spec), Some(t)) = (&nav, table.nav.as_ref()) {
        refuse_arrays_in_air(spec, t, tables, &sonars, problems);
    }
    let faults = faults::faults(table.fault.all(), problems);
    for (sonar, t) in sonars.iter_mut().zip(tables) {
        if let Some(sonar) = sonar {
            sonar.instrument = instrument::instrument(t, sonar, files, problems);
        }
    }
    for (sonar, t) in sonars.iter_mut().zip(tables) {
        if let Some(sonar) = sonar {
            output::note_element_needs(sonar, t, control.as_ref(), &faults, problems);
        }
    }
    refuse_port_clashes(&listeners, problems);
    refuse_recordings_without_folder(table, problems);

    let mut medium = medium?;
    let surface = medium.surface.as_mut().and_then(|s| s.scattering.as_mut());
    if let (Some(scattering), Some(density)) = (surface, of_surface) {
        scattering.density = density;
    }
    Some(RigSpec {
        source_text: text.to_owned(),
        medium,
        nav: nav?,
        scene: scene?,
        run: run?,
        record: table.record.given_and_then(|t| {
            Some(RecordSpec {
                directory: t.directory.get()?,
                at_start: t.at_start.get()?,
            })
        })?,
        control: control?,
        faults,
        sonars: all(sonars).filter(|s| !s.is_empty())?,
    })
}

/// Refuses recorded outputs if the configuration has no record table.
fn refuse_recordings_without_folder(table: &keys::Rig, problems: &mut Problems) {
    if table.record.given {
        return;
    }
    let outputs = table.sonar.all().iter().filter_map(|t| t.output.as_ref());
    for output in outputs {
        let files: [&Entry; 4] = [&output.mcap, &output.sigmf, &output.wav, &output.xtf];
        for entry in files.into_iter().filter(|entry| entry.given) {
            problems.refuse(entry, "needs a folder: [record]");
        }
        if let Some(jsf) = output.jsf.as_ref()
            && output.jsf.given
            && jsf.record.get() == Some(true)
        {
            problems.refuse(&jsf.record, "needs a folder: [record]");
        }
    }
}

/// Refuses arrays above the waterline of a platform at rest.
fn refuse_arrays_in_air(
    nav: &NavSpec,
    nav_table: &keys::Nav,
    tables: &[keys::Sonar],
    sonars: &[Option<SonarSpec>],
    problems: &mut Problems,
) {
    let (VerticalSpec::Waterline { reference_down_m }, None) = (nav.vertical, &nav.tow) else {
        return;
    };
    for (sonar, table) in sonars.iter().zip(tables) {
        let Some(sonar) = sonar else { continue };
        let receive = sonar.receive.iter().zip(table.receive.all());
        let receive = receive.map(|(array, t)| (&t.name, array.mounting, &t.position_m));
        let transmit = sonar.transmit.iter().zip(table.transmit.all());
        let transmit = transmit.map(|(array, t)| (&t.name, array.mounting, &t.position_m));
        for (name, mounting, entry) in receive.chain(transmit) {
            let name = name.text().unwrap_or_default();
            let up_m = -(reference_down_m + mounting.position_m.z);
            if up_m > 0.0 {
                let entry: &Entry = match nav_table.reference_depth_m.given {
                    true => &nav_table.reference_depth_m,
                    false => entry,
                };
                let rule = format!(
                    "array {name} of sonar {} is {up_m} m above the waterline; reference_depth_m and the third number of position_m count downwards",
                    sonar.name
                );
                problems.refuse(entry, rule);
                return;
            }
        }
    }
}

/// Refuses a georeferenced scene if the platform has no geographic position.
fn refuse_anchor_without_position(nav: &NavSpec, scene: &keys::Scene, problems: &mut Problems) {
    let in_metres = |s: &NavSourceSpec| matches!(s.input, NavInputSpec::Csv { .. });
    let nowhere = nav.origin == OriginSpec::FirstFix && nav.sources.iter().all(in_metres);
    if nowhere && scene.anchor.text() == Some("file") {
        let rule =
            "needs a geodetic position: every nav.source is a track in metres, so give nav.origin";
        problems.refuse(&scene.anchor, rule);
    }
}

fn medium(table: &keys::Medium, files: &dyn Files, problems: &mut Problems) -> Option<MediumSpec> {
    let condition = "one sound speed: [medium.profile] holds the sound speeds";
    let is_uniform = Some(!table.profile.given);
    problems.only_with(&[&table.sound_speed_m_per_s], is_uniform, condition);
    let profile = table
        .profile
        .given_and_then(|t| profile(t, &table.profile, files, problems));
    let water = || {
        Some(Water {
            temperature_c: table.temperature_c.get()?,
            salinity: table.salinity_psu.get()?,
            depth_m: table.depth_m.get()?,
            ph: table.ph.get()?,
        })
    };
    let absorption = match (table.absorption.text(), table.absorption.other()) {
        (Some("none"), _) => Some(AbsorptionSpec::None),
        (Some("francois-garrison"), _) => water().map(AbsorptionSpec::FrancoisGarrison),
        (Some("ainslie-mccolm"), _) => water().map(AbsorptionSpec::AinslieMcColm),
        (_, Some(fixed)) => fixed
            .db_per_km
            .get()
            .map(|db_per_m| AbsorptionSpec::Fixed { db_per_m }),
        _ => None,
    };
    let wind_m_per_s = table.wind_m_per_s.get();
    let reflects = table.multipath.given;
    let surface = table
        .surface
        .given_and_then(|t| surface(t, wind_m_per_s?, reflects, problems));
    let multipath = table.multipath.given_and_then(multipath);
    let profile = profile?;
    let sound_speed_m_per_s = match &profile {
        Some(profile) => profile.range_m_per_s().0,
        None => table.sound_speed_m_per_s.get()?,
    };
    Some(MediumSpec {
        sound_speed_m_per_s,
        profile: profile.map(Arc::new),
        absorption: absorption?,
        volume: volume(table, problems)?,
        surface: surface?,
        multipath: multipath?,
        wind_m_per_s: wind_m_per_s?,
    })
}

/// The sea surface. The density of its scatterers follows when the sonars are known.
fn surface(
    table: &keys::Surface,
    wind_m_per_s: f64,
    reflects: bool,
    problems: &mut Problems,
) -> Option<SurfaceSpec> {
    if table.heights.get() == Some(true) {
        problems.only_with(&[&table.heights], Some(reflects), "[medium.multipath]");
    }
    let moves = table.waves.get()? || table.heights.get()?;
    let condition = "waves = true or heights = true";
    problems.only_with(&[&table.wind_from_deg], Some(moves), condition);
    let scattering = match table.scattering.get()? {
        true => Some(SurfaceScatteringSpec {
            density: Density::PerM2(1.0),
            correlation_time_s: table.correlation_time_ms.get()?,
            waves: table.waves.get()?,
        }),
        false => None,
    };
    Some(SurfaceSpec {
        wind_m_per_s,
        roughness_m: table.roughness_m.if_given()?,
        slope_rad: table.slope_deg.if_given()?,
        down_m: table.down_m.get()?,
        wind_from_rad: table.wind_from_deg.if_given()?,
        heights: table.heights.get()?,
        scattering,
    })
}

fn multipath(table: &keys::Multipath) -> Option<MultipathSpec> {
    Some(MultipathSpec {
        surface_bottom: table.legs.text()? == "surface-bottom",
        bottom_density_ratio: table.bottom_density_ratio.if_given()?,
        bottom_speed_ratio: table.bottom_speed_ratio.if_given()?,
        bottom_roughness_m: table.bottom_roughness_m.if_given()?,
        bottom_slope_rad: table.bottom_slope_deg.get()?,
    })
}

/// Volume reverberation. `Some(None)` without layers; `None` after a problem.
fn volume(table: &keys::Medium, problems: &mut Problems) -> Option<Option<VolumeSpec>> {
    let given = table.volume.given;
    let condition = "a layer: [[medium.volume]]";
    let of_layers: [&Entry; 2] = [&table.volume_scatterers_per_cell, &table.volume_nearest_m];
    problems.only_with(&of_layers, Some(given), condition);
    if !given {
        return Some(None);
    }
    let mut layers = Vec::new();
    for t in table.volume.all() {
        let layer = VolumeLayer {
            top_m: t.top_m.get()?,
            bottom_m: t.bottom_m.get()?,
            sv_db: t.sv_db.get()?,
        };
        if layer.bottom_m <= layer.top_m {
            let rule = format!("must be greater than top_m = {}", layer.top_m);
            problems.refuse(&t.bottom_m, rule);
            return None;
        }
        let overlaps = |o: &&VolumeLayer| o.top_m < layer.bottom_m && layer.top_m < o.bottom_m;
        if let Some(other) = layers.iter().find(overlaps) {
            let rule = format!(
                "the layer must not overlap that from {} to {} m",
                other.top_m, other.bottom_m
            );
            problems.refuse(&t.top_m, rule);
            return None;
        }
        layers.push(layer);
    }
    layers.sort_by(|a, b| a.top_m.total_cmp(&b.top_m));
    Some(Some(VolumeSpec {
        layers,
        scatterers_per_cell: table.volume_scatterers_per_cell.get()?,
        nearest_m: table.volume_nearest_m.get()?,
    }))
}

/// The profile of a file or of points.
fn profile(
    table: &keys::Profile,
    entry: &Entry,
    files: &dyn Files,
    problems: &mut Problems,
) -> Option<SoundSpeedProfile> {
    match (table.file.given, table.points.given) {
        (true, false) => {
            let path = table.file.as_ref()?;
            let read = files
                .read(path)
                .map_err(|why| format!("cannot be read: {why}"));
            let read = read.and_then(|bytes| read_profile(path, &bytes));
            read.map_err(|why| problems.refuse(&table.file, why)).ok()
        }
        (false, true) => {
            let read = SoundSpeedProfile::new(table.points.get()?);
            let refuse = |why: ProfileRefused| problems.refuse(&table.points, why.to_string());
            read.map_err(refuse).ok()
        }
        _ => {
            problems.refuse(entry, "must have either `file` or `points`");
            None
        }
    }
}

/// Refuses live sources with a scaled clock, because live measurements carry the computer's time.
fn refuse_scaled_clock_with_live_sources(nav: &NavSpec, run: &keys::Run, problems: &mut Problems) {
    let own_time = run.clock.text().is_some_and(|clock| clock != "realtime");
    if own_time && !nav.is_recorded() {
        let rule = "only with recorded navigation: every nav.source of kind \"log\" or \"csv\"";
        problems.refuse(&run.clock, rule);
    }
    let own = matches!(run.clock.text(), Some("fast" | "lockstep"));
    if own && !nav.outputs.is_empty() {
        let rule = "must be \"realtime\" or \"scaled\" with nav.output, because connected devices follow its clock";
        problems.refuse(&run.clock, rule);
    }
}

/// Minimum length of a token. A shorter token could be guessed.
const MIN_REMOTE_TOKEN_BYTES: usize = 12;

fn control<'t>(
    table: &'t keys::Control,
    listeners: &mut Vec<Listener<'t>>,
    problems: &mut Problems,
) -> Option<ControlSpec> {
    let token = table.token.text().map(str::to_owned);
    let listen = match table.listen.given {
        true => Some(address(&table.listen, problems)?),
        false => None,
    };
    if let Some(address) = listen {
        listeners.push(Listener {
            entry: &table.listen,
            protocol: "TCP",
            address,
            multicast: false,
        });
        let is_remote = !address.ip().is_loopback();
        let condition = "a `listen` that other computers can reach";
        problems.needed_with(&table.token, Some(is_remote), condition);
        let is_short = token
            .as_ref()
            .is_some_and(|token| token.len() < MIN_REMOTE_TOKEN_BYTES);
        if is_remote && is_short {
            let rule = format!(
                "must have at least {MIN_REMOTE_TOKEN_BYTES} characters, because other computers can reach `listen`"
            );
            problems.refuse(&table.token, rule);
        }
    }
    Some(ControlSpec {
        listen,
        token,
        or_any_port: false,
    })
}

fn run(table: &keys::Run) -> Option<RunSpec> {
    Some(RunSpec {
        spread_share: match table.pace.is("spread")? {
            true => Some(table.pace_share.get()?),
            false => None,
        },
        pace_tcp: table.pace_tcp.get()?,
        delivery: streaming::delivery(table)?,
        stream_tiles: table.stream_tiles.get()?,
        overload: table.overload.named()?,
        simulated_compute_s: table.simulated_compute_ms.get()?,
        ahead_s: streaming::ahead_s(table)?,
        clock: match table.clock.text()? {
            "scaled" => ClockSpec::Scaled(table.clock_rate.get()?),
            "fast" => ClockSpec::Fast,
            "lockstep" => ClockSpec::Lockstep,
            _ => ClockSpec::RealTime,
        },
        priority: table.priority.to()?,
        compute_nice: table.compute_nice.to()?,
        fault_directory: table.fault_directory.get(),
        costs: table.costs.get(),
        threads: table.threads.to()?,
        latency_s: table.latency_ms.get()?,
        status_interval_s: table.status_interval_s.get()?,
        queue_pings: table.queue_pings.to()?,
    })
}

// ---------------------------------------------------------------- navigation

fn nav<'t>(
    table: &'t keys::Nav,
    listeners: &mut Vec<Listener<'t>>,
    problems: &mut Problems,
) -> Option<NavSpec> {
    let tables = table.source.all();
    unique_names(tables.iter().map(|t| &t.name), problems);
    let sources: Vec<_> = tables
        .iter()
        .map(|t| nav_source(t, listeners, problems))
        .collect();
    refuse_missing_channels(table, tables, problems);

    let kinds: Vec<_> = tables.iter().map(|t| t.kind.text()).collect();
    let recorded = |kind: &Option<&str>| matches!(kind, Some("log" | "csv"));
    let kinds_known = !kinds.is_empty() && kinds.iter().all(Option::is_some);
    let any_recorded = kinds_known.then(|| kinds.iter().any(recorded));
    let mode = match table.mode.text() {
        Some("predict") => NavMode::Predict,
        None if !kinds.iter().all(recorded) => NavMode::Predict,
        _ => NavMode::Settle,
    };
    let mode_known = match table.mode.given {
        true => table.mode.text().is_some(),
        false => kinds_known,
    };
    let predicts = mode_known.then_some(mode == NavMode::Predict);
    let of_prediction: [&Entry; 2] = [&table.max_extrapolation_ms, &table.on_lost];
    problems.only_with(&of_prediction, predicts, "mode = \"predict\"");
    if table.r#loop.get() == Some(true) {
        let condition = "a source of kind \"log\" or \"csv\"";
        problems.only_with(&[&table.r#loop], any_recorded, condition);
    }
    if let (Some(stale_s), Some(lost_s)) = (table.stale_s.get(), table.lost_s.get())
        && lost_s < stale_s
    {
        problems.refuse(&table.lost_s, "must not be below stale_s");
    }
    let vertical = vertical(table);
    refuse_unfit_track(table, tables, vertical, problems);
    let has_reference = vertical.map(|v| !matches!(v, VerticalSpec::Gnss { .. }));
    let condition = "vertical = \"waterline\" or \"depth\"";
    problems.only_with(&[&table.reference_depth_m], has_reference, condition);
    let of_track = owner(tables, NavChannel::Depth).is_none().then_some(0.0);
    let reference_depth_m = table.reference_depth_m.get().or(of_track);
    if table.tow.as_ref().is_some() && matches!(vertical, Some(VerticalSpec::Gnss { .. })) {
        let rule = "must not be \"gnss\" where the sonar is towed: the antenna is the ship's";
        problems.refuse(&table.vertical, rule);
    }
    let outputs = nav::outputs(table.output.all(), listeners, problems);

    Some(NavSpec {
        origin: origin(table)?,
        mode,
        vertical: vertical?,
        heave_from_depth_m: reference_depth_m.filter(|_| vertical == Some(VerticalSpec::Depth)),
        stamp: table.stamp.named()?,
        loop_log: table.r#loop.get()?,
        max_extrapolation_s: table.max_extrapolation_ms.get()?,
        history_s: table.history_s.get()?,
        heading_from_course: table.heading_from_course.if_given()?,
        failover: table.failover_s.and_then(|&after_s| {
            let hold_off_s = table.hold_off_s.get()?;
            Some(FailoverSpec {
                after_s,
                hold_off_s,
            })
        }),
        jump_gate: match table.jump_gate.get()? {
            true => Some(JumpGateSpec {
                max_speed_m_per_s: table.max_speed_m_per_s.get()?,
                max_rate_rad_per_s: table.max_turn_rate_deg_per_s.get()?,
            }),
            false => None,
        },
        stale_s: table.stale_s.get()?,
        lost_s: table.lost_s.get()?,
        on_lost: table.on_lost.named()?,
        tow: table.tow.and_then(nav::tow),
        outputs: outputs?,
        recording: None,
        sources: all(sources).filter(|s| !s.is_empty())?,
    })
}

fn origin(table: &keys::Nav) -> Option<OriginSpec> {
    match table.origin.other() {
        Some(given) => Some(OriginSpec::Geodetic {
            latitude_rad: given.latitude_deg.get()?,
            longitude_rad: given.longitude_deg.get()?,
        }),
        None => table.origin.text().map(|_| OriginSpec::FirstFix),
    }
}

fn vertical(table: &keys::Nav) -> Option<VerticalSpec> {
    Some(match table.vertical.text()? {
        "waterline" => VerticalSpec::Waterline {
            reference_down_m: table.reference_depth_m.if_given()?.unwrap_or(0.0),
        },
        "gnss" => VerticalSpec::Gnss {
            datum_offset_m: table.datum_offset_m.get()?,
        },
        _ => VerticalSpec::Depth,
    })
}

/// Quantities of a CSV track.
const OF_TRACK: [NavChannel; 3] = [
    NavChannel::Position,
    NavChannel::Heading,
    NavChannel::RollPitch,
];

/// Quantities that a source provides. Without the key `provides`, quantities that the source may provide.
fn provides(table: &keys::NavSource) -> Option<Vec<NavChannel>> {
    match (table.provides.given, table.kind.text()) {
        (true, _) => table.provides.all_named(),
        (false, Some("csv")) => Some(OF_TRACK.to_vec()),
        (false, _) => Some(NavChannel::ALL.to_vec()),
    }
}

/// The first source that provides `channel` or may provide it.
fn owner(tables: &[keys::NavSource], channel: NavChannel) -> Option<&keys::NavSource> {
    let gives = |t: &&keys::NavSource| provides(t).is_some_and(|p| p.contains(&channel));
    tables.iter().find(gives)
}

/// Whether the configuration does not list the quantities of the source.
fn detects(table: &keys::NavSource) -> bool {
    !table.provides.given && table.kind.is("csv") == Some(false)
}

fn refuse_missing_channels(table: &keys::Nav, tables: &[keys::NavSource], problems: &mut Problems) {
    // The quantities of a log are known only after the log is read.
    if tables.is_empty() || tables.iter().any(|t| provides(t).is_none() || detects(t)) {
        return;
    }
    let sources = &table.source;
    if owner(tables, NavChannel::Position).is_none() {
        problems.refuse(sources, "one source must provide \"position\"");
    }
    if owner(tables, NavChannel::Heading).is_some() {
        return;
    }
    match table.heading_from_course.if_given() {
        Some(None | Some(false)) => problems.refuse(
            sources,
            "one source must provide \"heading\", or heading_from_course must be true",
        ),
        Some(Some(true)) if owner(tables, NavChannel::CourseSpeed).is_none() => problems.refuse(
            sources,
            "heading_from_course needs a source that provides \"course-speed\"",
        ),
        _ => {}
    }
}

/// Refuses settings that do not apply to a CSV track, which has its own depth and no latitude.
fn refuse_unfit_track(
    table: &keys::Nav,
    tables: &[keys::NavSource],
    vertical: Option<VerticalSpec>,
    problems: &mut Problems,
) {
    let (Some(vertical), Some(owner)) = (vertical, owner(tables, NavChannel::Position)) else {
        return;
    };
    let Some(kind) = owner.kind.text() else {
        return;
    };
    let (is_csv, is_depth) = (kind == "csv", vertical == VerticalSpec::Depth);
    if is_csv && !is_depth {
        let rule = "must be \"depth\" where the position comes from a CSV track";
        problems.refuse(&table.vertical, rule);
    }
    if is_depth && !is_csv && self::owner(tables, NavChannel::Depth).is_none() {
        let rule = "needs a position from a CSV track, or a source that provides \"depth\"";
        problems.refuse(&table.vertical, rule);
    }
    if is_csv && table.origin.text().is_some() {
        let rule = "a CSV track has no latitude: must be { latitude_deg, longitude_deg }";
        problems.refuse(&table.origin, rule);
    }
}

fn nav_source<'t>(
    table: &'t keys::NavSource,
    listeners: &mut Vec<Listener<'t>>,
    problems: &mut Problems,
) -> Option<NavSourceSpec> {
    let is = |wanted: &str| table.kind.is(wanted);
    if is("tcp") == Some(true) && table.listen.given == table.connect.given {
        let rule = "tcp needs either `connect` (a server's address) or `listen` (for a client)";
        problems.refuse(&table.kind, rule);
    }
    problems.needed_with(&table.listen, is("udp"), "kind = \"udp\"");
    let of_sentences: [&Entry; 8] = [
        &table.time,
        &table.latency_ms,
        &table.checksum,
        &table.ignore_checksum_for,
        &table.format,
        &table.variants,
        &table.reverse,
        &table.magnetic_variation_deg,
    ];
    let condition = "sentences, which a CSV track does not contain";
    problems.only_with(&of_sentences, is("csv").map(|csv| !csv), condition);
    let on_arrival = table.time.is("arrival");
    problems.only_with(&[&table.latency_ms], on_arrival, "time = \"arrival\"");

    let input = nav_input(table, listeners, problems);
    Some(NavSourceSpec {
        name: table.name.text()?.to_owned(),
        input: input?,
        time: match table.time.text()? {
            "burst" => TimePolicy::Burst,
            "arrival" => TimePolicy::Arrival {
                latency_s: table.latency_ms.get()?,
            },
            _ => TimePolicy::Message,
        },
        checksum: table.checksum.named()?,
        lever_arm_m: table.lever_arm_m.get()?,
        mounting: SensorMounting {
            heave_arm_m: table.heave_arm_m.get()?,
            angles_rad: table.mounting_deg.get()?,
        },
        dialect: dialect(table)?,
        provides: provides(table)?,
        detect: detects(table),
    })
}

fn dialect(table: &keys::NavSource) -> Option<NavDialect> {
    let says = |key: &Field<Vec<String>>, word: &str| key.all().iter().any(|w| w == word);
    Some(NavDialect {
        format: table.format.named()?,
        ignore_checksum_for: table.ignore_checksum_for.all().to_vec(),
        pashr_heave_up: says(&table.variants, "pashr-heave-up"),
        depth_is_own: says(&table.variants, "own-depth"),
        reversed: Reversed {
            roll: says(&table.reverse, "roll"),
            pitch: says(&table.reverse, "pitch"),
            heave: says(&table.reverse, "heave"),
        },
        magnetic_variation_rad: table.magnetic_variation_deg.get(),
    })
}

fn nav_input<'t>(
    table: &'t keys::NavSource,
    listeners: &mut Vec<Listener<'t>>,
    problems: &mut Problems,
) -> Option<NavInputSpec> {
    match table.kind.text()? {
        "log" => Some(NavInputSpec::Log {
            path: table.path.get()?,
            plain_rate_hz: table.plain_rate_hz.get()?,
        }),
        "csv" => Some(NavInputSpec::Csv {
            path: table.path.get()?,
        }),
        "udp" => {
            let multicast = table.multicast.text().map(|text| {
                let group = text.parse().ok().filter(Ipv4Addr::is_multicast);
                if group.is_none() {
                    let rule = "must be an IPv4 multicast group, 224.0.0.0 to 239.255.255.255";
                    problems.refuse(&table.multicast, rule);
                }
                group
            });
            let listen = address(&table.listen, problems)?;
            if multicast.is_some() && !matches!(listen.ip(), IpAddr::V4(_)) {
                let rule = "must be an IPv4 address where there is a multicast group";
                problems.refuse(&table.listen, rule);
            }
            listeners.push(Listener {
                entry: &table.listen,
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
        "tcp" if table.connect.given => Some(NavInputSpec::TcpConnect {
            address: table.connect.text()?.to_owned(),
        }),
        "tcp" => {
            if !table.listen.given {
                return None;
            }
            let listen = listen(&table.listen, "TCP", listeners, problems)?;
            Some(NavInputSpec::TcpListen { listen })
        }
        _ => Some(NavInputSpec::Serial {
            port: table.port.text()?.to_owned(),
            baud: table.baud.to()?,
            line: nav::serial_line(&table.line)?,
        }),
    }
}

//! JSON for the operator's page, apart from ping frames: the rig, settings and changes, targets, seabed relief and navigation status.

use std::collections::VecDeque;
use std::sync::{Arc, Mutex, PoisonError};

use serde_json::{Value, json};

use crate::io::control::Bytes;
use crate::io::control::feed::Feed;
use crate::io::control::frame::{Kind, frame};
use crate::io::control::socket::ReliefTile;
use crate::io::nav::SourceCounters;
use crate::settings::{RecentChange, SettingsStore};
use echotank_config::spec::{FaultRequest, NamedChoice, NavChannel, RigSpec, SonarSpec};
use echotank_core::settings::{
    Changed, JournalEntry, SettingChange, SettingsPort, SonarSettings, StoredValue, TriggerSource,
};
use echotank_nav::health::State;
use echotank_ping::world::SharedSceneSummary;

/// Number of cells per side of a relief tile.
const RELIEF_CELLS: i64 = 128;
/// Number of cells per side with the border of one cell.
const WITH_BORDER: i64 = RELIEF_CELLS + 2;
/// Coarsest level: tiles of 256 km per side.
const MAX_LEVEL: u8 = 11;
/// Maximum number of cached tiles: 9 MB.
const MAX_TILES: usize = 128;
/// Maximum number of targets sent to the page.
const MAX_TARGETS: usize = 2000;
/// Maximum length of the displayed text of a stored setting, characters.
const MAX_TEXT: usize = 200;

/// Data shown on the operator's page.
pub struct PageSource {
    /// Distributes ping frames to the open pages.
    pub feed: Arc<Feed>,
    /// Checked configuration.
    pub spec: RigSpec,
    /// Targets and terrain, once they are placed.
    pub world: SharedSceneSummary,
    /// Addresses of the rig's inputs and outputs, one line each: `WHAT NAME TRANSPORT ADDRESS`.
    pub ports: Vec<String>,
}

/// Cache of relief tiles, the newest last.
#[derive(Default)]
pub struct ReliefCache(Mutex<VecDeque<(ReliefTile, Bytes)>>);

impl PageSource {
    /// First message to a page: the sonars, the fault kinds and the navigation sources. `run` identifies this run of the daemon.
    pub fn hello(&self, run: i64) -> Value {
        let faults = FaultRequest::KINDS.iter();
        let quantities = NavChannel::WORDS.iter().map(|(_, name)| *name);
        json!({
            "page": 1,
            "echotank": env!("CARGO_PKG_VERSION"),
            // A page discards its data when this changes.
            "run": run.to_string(),
            "sonars": self.spec.sonars.iter().map(sonar).collect::<Value>(),
            "faults": faults.map(|kind| json!(kind)).collect::<Value>(),
            "quantities": quantities.collect::<Value>(),
            "ports": self.ports,
            "records_to": self.spec.record.as_ref().map(|r| r.directory.display().to_string()),
            "recorded_nav": self.spec.nav.is_recorded(),
            "nav": self.spec.nav.sources.iter().map(|s| Value::from(s.name.as_str())).collect::<Value>(),
            "latency_s": self.spec.run.latency_s,
        })
    }

    /// Targets as rows of name, north, east, down (m) and strength (dB); null until the scene is placed.
    pub fn world(&self) -> Value {
        let Some(world) = self.world.get() else {
            return Value::Null;
        };
        let targets = world.targets.iter().take(MAX_TARGETS);
        let targets = targets.map(|t| {
            let at = t.position_m;
            json!([t.name, at.x, at.y, at.z, t.target_strength_db])
        });
        json!({ "targets": targets.collect::<Value>(), "relief": world.ground.is_some() })
    }

    /// Seabed depths of a tile as a relief frame. `None` without a seabed or beyond the coarsest level.
    ///
    /// Depths are f32, metres down, row by row from the south-west, with a border of one cell; NaN without data.
    pub fn relief(&self, tile: ReliefTile, cache: &ReliefCache) -> Option<Bytes> {
        let ground = self.world.get()?.ground.as_ref()?;
        if tile.level > MAX_LEVEL {
            return None;
        }
        let mut cache = cache.0.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some((_, bytes)) = cache.iter().find(|(known, _)| *known == tile) {
            return Some(bytes.clone());
        }
        let cell_m = f64::from(1_u32 << tile.level);
        let at = |tile: i32, cell: i64| {
            (i64::from(tile) * RELIEF_CELLS + cell - 1) as f64 * cell_m + 0.5 * cell_m
        };
        let mut depths = Vec::with_capacity((WITH_BORDER * WITH_BORDER * 4) as usize);
        for row in 0..WITH_BORDER {
            for col in 0..WITH_BORDER {
                let down_m = ground.down_m(at(tile.row, row), at(tile.col, col));
                let down_m = down_m.map_or(f32::NAN, |down_m| down_m as f32);
                depths.extend(down_m.to_le_bytes());
            }
        }
        let text = json!({
            "level": tile.level, "row": tile.row, "col": tile.col,
            "cells": RELIEF_CELLS, "border": 1, "cell_m": cell_m,
        });
        let bytes = frame(Kind::Relief, 0, 0, &text, &depths);
        if cache.len() == MAX_TILES {
            cache.pop_front();
        }
        cache.push_back((tile, bytes.clone()));
        Some(bytes)
    }
}

fn sonar(sonar: &SonarSpec) -> Value {
    let limits = &sonar.limits;
    let arrays = sonar.receive.iter().zip(&sonar.receive_names);
    let arrays = arrays
        .map(|(array, name)| json!({ "name": name, "elements": array.elements, "spacing_m": array.spacing_m }));
    let lines = sonar.beams.lines.iter();
    json!({
        "name": sonar.name,
        "arrays": arrays.collect::<Value>(),
        "lines": lines.map(|line| Value::from(format!("{:?}", line.side).to_lowercase())).collect::<Value>(),
        "beams": sonar.beams.fan.as_ref().map_or(0, |fan| fan.beams),
        "sector_deg": sonar.beams.fan.as_ref().map_or(0.0, |fan| fan.sector_rad.to_degrees()),
        "bottom_detection": sonar.beams.fan.as_ref().is_some_and(|fan| fan.form.bottom_detection),
        "center_hz": sonar.pulse.center_frequency_hz,
        "bandwidth_hz": sonar.pulse.bandwidth_hz,
        "pulse": format!("{:?}", sonar.pulse.kind),
        "rate_hz": sonar.receiver.sample_rate_hz,
        "full_scale_v": sonar.receiver.full_scale_v,
        "adc_bits": sonar.receiver.adc_bits,
        "limits": {
            "range_m": limits.range_m,
            "rate_hz": limits.ping_rate_hz,
            "source_level_db": limits.source_level_db,
            "gain_db": limits.gain_db,
            "pulse_ms": [limits.pulse_duration_s.0 * 1e3, limits.pulse_duration_s.1 * 1e3],
        },
    })
}

pub(crate) fn settings_json(settings: &SonarSettings) -> Value {
    json!({
        "pinging": settings.pinging,
        "range_m": settings.range_m,
        "rate_hz": settings.max_ping_rate_hz,
        "source_level_db": settings.source_level_db,
        "gain_db": settings.gain_db,
        "pulse_ms": settings.pulse_duration_s * 1e3,
    })
}

/// Name of a trigger source in the page's JSON.
pub fn trigger_name(trigger: TriggerSource) -> &'static str {
    match trigger {
        TriggerSource::Internal => "internal",
        TriggerSource::External => "external",
    }
}

/// Recent setting changes of a sonar, oldest first: requester, setting, value and outcome.
pub fn changes(settings: &SettingsStore) -> Value {
    let stored = settings.changes_since(0);
    let stored = stored.iter().filter_map(stored_change);
    let mut rows: Vec<_> = settings.recent().iter().map(change).chain(stored).collect();
    rows.sort_by_key(|row| row["utc_ms"].as_f64().map(f64::to_bits));
    rows.into()
}

fn row(origin: &echotank_core::settings::ChangeOrigin, what: &str, value: Value) -> Value {
    json!({
        "utc_ms": origin.utc.0 as f64 / 1e6,
        "via": origin.by.via,
        "peer": origin.by.peer.map(|peer| peer.to_string()),
        "what": what,
        "value": value,
    })
}

fn change(recent: &RecentChange) -> Value {
    let (what, value) = match recent.change {
        SettingChange::RangeM(v) => ("range_m", v.into()),
        SettingChange::MaxPingRateHz(v) => ("rate_hz", v.into()),
        SettingChange::SourceLevelDb(v) => ("source_level_db", v.into()),
        SettingChange::GainDb(v) => ("gain_db", v.into()),
        SettingChange::PulseDurationS(v) => ("pulse_ms", (v * 1e3).into()),
        SettingChange::Start => ("start", Value::Null),
        SettingChange::Stop => ("stop", Value::Null),
        SettingChange::PingTimes(n) => ("pings", n.into()),
        SettingChange::Trigger(source) => ("trigger", trigger_name(source).into()),
    };
    let mut row = row(&recent.origin, what, value);
    match recent.outcome {
        Ok(version) => row["version"] = version.into(),
        Err(refused) => row["why"] = refused.to_string().into(),
    }
    row
}

/// Row of a stored setting without effect on the model. The other settings are among the recent changes.
fn stored_change(entry: &JournalEntry) -> Option<Value> {
    let Changed::Stored(key, value) = &entry.changed else {
        return None;
    };
    let value = match value {
        StoredValue::Integer(value) => Value::from(*value),
        StoredValue::Numbers(values) => values.iter().take(16).map(|v| Value::from(*v)).collect(),
        StoredValue::Text(text) => Value::from(text.chars().take(MAX_TEXT).collect::<String>()),
    };
    let mut row = row(&entry.origin, key.name, value);
    row["version"] = entry.version.into();
    row["kept"] = true.into();
    Some(row)
}

/// State and counters of one navigation source.
pub fn nav_source((state, source): &(State, SourceCounters)) -> Value {
    let (d, l) = (&source.decoder, &source.live);
    json!({
        "name": source.name,
        "state": state.name(),
        "sentences": d.sentences,
        "used": d.used,
        "bad_checksum": d.bad_checksum,
        "malformed": d.malformed,
        "unsupported": d.unsupported,
        "time_jumps": d.time_jumps,
        "clock_changes": d.clock_changes,
        "corrected_by_s": d.corrected_by_s,
        "samples": d.samples,
        "received": l.received,
        "dropped": l.dropped_full + l.dropped_flood,
        "read_errors": l.read_errors,
        "reopened": l.reopened,
    })
}

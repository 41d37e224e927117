//! `truth.jsonl`: ground truth, one JSON object per line and ping.
//!
//! | key | content |
//! |---|---|
//! | `sonar`, `ping_number` | as in the records |
//! | `utc`, `utc_ns`, `stamp_utc_ns` | start of the pulse; time stamp of the records |
//! | `pose` | reference point at the start of the pulse: `position_m` (north, east, down), `roll_deg`, `pitch_deg`, `heading_deg`, `heave_down_m`, `latitude_deg`, `longitude_deg`, `height_m` |
//! | `nav_flags` | if any: `invalid-position`, `invalid-heading`, `invalid-roll-pitch`, `invalid-vertical` (too old, held); `time-jumped` (the clock of a source jumped, or its times are corrected) |
//! | `velocity_m_per_s` | north, east, down |
//! | `plan` | settings, pulse, window and models of the ping |
//! | `segments` | trajectory samples used to compute the echoes |
//! | `scene` | seabed scatterers: `made` for this ping, `culled` (tested, outside every footprint or left out by the automatic density), `shadowed`, `used`; `points` and `targets` used; `tiles_used`, `tiles_made`; with a sound-speed profile `unreached`, of the used, by any ray; `surface` scatterers of the sea surface, and `images`, echoes by way of surface or bottom, `volume`, drawn in the water, and `moving`, of targets, where there are any |
//! | `error_check` | if configured and enough windows exist: `error`, `low`, `high`, `worst`, `windows`, `tolerance`, `exceeded`, `fault` |
//! | `methods` | if the method selection applies: `plan` (the block of pings that the methods were selected on, from 1), `predicted_error`, `predicted_ms`, `tolerance`, `output` (`elements`, or `beams` where only lines are computed) with `part_elements` (elements of a line computed as one), and, with an error check, `margin` (tolerance over measured error) |
//! | `soundings` | for each beam with a detected bottom: `beam`, `angle_deg`, `twtt_s`, `error_s` (predicted), `by` (`amplitude`, `phase`), `level_v` |
//! | `targets` | every named target, see below |
//!
//! Keys of a target: `name`, `target_strength_db` (of a school or a plume: of all individuals together), `position_m`; if it moves, also
//! `velocity_m_per_s` and `range_rate_m_per_s` (growth of `range_m`), all at the start of the pulse; `range_m` from the first transmit array at the start of the pulse, `ranges_m` from
//! every transmit array; `delays_s`, one per receive array: arrival of the echo's leading edge at the array's centre, with both ends of the path
//! moving, and `delay_s`, the first of them; `bearing_deg`, horizontal, from the bow, starboard positive; `side`; `along_m`, `across_m` and
//! `below_m` from the first transmit array in body axes (forward, starboard, down).

use std::fs::File;
use std::io::Write;
use std::path::{Path, PathBuf};

use chrono::{DateTime, SecondsFormat};
use glam::DVec3;
use serde::Serialize;
use serde_json::Value;

use super::{RecordError, plan_text};
use echotank_config::spec::SonarSpec;
use echotank_core::frames::{Pose, angles_from_rotation};
use echotank_core::navigation::NavState;
use echotank_core::ping::{
    Detection, ErrorCheck, MethodMark, PingOutput, PingPlan, SceneCounts, Side, Sounding,
};
use echotank_core::scene::Target;

#[derive(Serialize)]
struct PingTruth<'a> {
    sonar: &'a str,
    ping_number: u32,
    utc: String,
    utc_ns: i64,
    stamp_utc_ns: i64,
    pose: PoseTruth,
    #[serde(skip_serializing_if = "Vec::is_empty")]
    nav_flags: Vec<&'static str>,
    velocity_m_per_s: [f64; 3],
    plan: Value,
    segments: Value,
    scene: SceneTruth,
    #[serde(skip_serializing_if = "Option::is_none")]
    error_check: Option<ErrorCheckTruth>,
    #[serde(skip_serializing_if = "Option::is_none")]
    methods: Option<MethodTruth>,
    #[serde(skip_serializing_if = "Vec::is_empty")]
    soundings: Vec<SoundingTruth>,
    targets: Vec<TargetTruth<'a>>,
}

#[derive(Serialize)]
struct MethodTruth {
    plan: u32,
    predicted_error: f64,
    predicted_ms: f64,
    tolerance: f64,
    output: &'static str,
    part_elements: usize,
    #[serde(skip_serializing_if = "Option::is_none")]
    margin: Option<f64>,
}

impl MethodTruth {
    fn of(mark: MethodMark, error_check: Option<ErrorCheck>) -> Self {
        Self {
            plan: mark.plan,
            predicted_error: mark.predicted_error,
            predicted_ms: mark.predicted_ms,
            tolerance: mark.tolerance,
            output: mark.output(),
            part_elements: mark.part_elements,
            margin: error_check.map(|c| mark.tolerance / c.error.max(f64::MIN_POSITIVE)),
        }
    }
}

#[derive(Serialize)]
struct SoundingTruth {
    beam: usize,
    angle_deg: f64,
    twtt_s: f64,
    error_s: f64,
    by: &'static str,
    level_v: f64,
}

impl From<&Sounding> for SoundingTruth {
    fn from(s: &Sounding) -> Self {
        Self {
            beam: s.beam,
            angle_deg: s.angle_rad.to_degrees(),
            twtt_s: s.twtt_s,
            error_s: s.error_s,
            by: match s.detection {
                Detection::Amplitude => "amplitude",
                Detection::Phase => "phase",
            },
            level_v: s.level_v,
        }
    }
}

#[derive(Default, Serialize)]
struct SceneTruth {
    made: u64,
    culled: u64,
    shadowed: u64,
    used: u64,
    points: u64,
    targets: u64,
    tiles_used: u64,
    tiles_made: u64,
    /// Those that no ray reaches; absent if there are none.
    #[serde(skip_serializing_if = "Option::is_none")]
    unreached: Option<u64>,
    /// Of the sea surface; absent if there are none.
    #[serde(skip_serializing_if = "Option::is_none")]
    surface: Option<u64>,
    /// Echoes by way of surface or bottom; absent if there are none.
    #[serde(skip_serializing_if = "Option::is_none")]
    images: Option<u64>,
    /// Those of the water, and those that move; absent if there are none.
    #[serde(skip_serializing_if = "Option::is_none")]
    volume: Option<u64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    moving: Option<u64>,
}

impl From<SceneCounts> for SceneTruth {
    fn from(c: SceneCounts) -> Self {
        Self {
            made: c.made,
            culled: c.culled,
            shadowed: c.shadowed,
            used: c.scatterers,
            points: c.points,
            targets: c.targets,
            tiles_used: c.tiles_used,
            tiles_made: c.tiles_made,
            unreached: (c.unreached > 0).then_some(c.unreached),
            surface: (c.surface > 0).then_some(c.surface),
            images: (c.images > 0).then_some(c.images),
            volume: (c.volume > 0).then_some(c.volume),
            moving: (c.moving > 0).then_some(c.moving),
        }
    }
}

#[derive(Serialize)]
struct ErrorCheckTruth {
    error: f64,
    low: f64,
    high: f64,
    worst: f64,
    windows: u32,
    tolerance: f64,
    exceeded: bool,
    fault: bool,
}

impl From<ErrorCheck> for ErrorCheckTruth {
    fn from(c: ErrorCheck) -> Self {
        Self {
            error: c.error,
            low: c.low,
            high: c.high,
            worst: c.worst,
            windows: c.windows,
            tolerance: c.tolerance,
            exceeded: c.exceeded,
            fault: c.fault,
        }
    }
}

#[derive(Serialize)]
struct PoseTruth {
    position_m: [f64; 3],
    roll_deg: f64,
    pitch_deg: f64,
    heading_deg: f64,
    heave_down_m: f64,
    latitude_deg: f64,
    longitude_deg: f64,
    height_m: f64,
}

#[derive(Serialize)]
struct TargetTruth<'a> {
    name: &'a str,
    target_strength_db: f64,
    position_m: [f64; 3],
    #[serde(skip_serializing_if = "Option::is_none")]
    velocity_m_per_s: Option<[f64; 3]>,
    #[serde(skip_serializing_if = "Option::is_none")]
    range_rate_m_per_s: Option<f64>,
    range_m: f64,
    delay_s: f64,
    delays_s: Vec<f64>,
    ranges_m: Vec<f64>,
    bearing_deg: f64,
    side: &'static str,
    along_m: f64,
    across_m: f64,
    below_m: f64,
}

/// Records `truth.jsonl` line by line.
#[derive(Debug)]
pub(crate) struct TruthRecorder {
    path: PathBuf,
    file: File,
    line: Vec<u8>,
}

impl TruthRecorder {
    /// Creates `dir/truth.jsonl`; the folder must exist. All sonars of a rig share the file.
    pub(crate) fn create(dir: &Path) -> Result<Self, RecordError> {
        Self::at(dir.join("truth.jsonl"))
    }

    fn at(path: PathBuf) -> Result<Self, RecordError> {
        let file = File::create(&path).map_err(RecordError::io(&path, "create"))?;
        // The lock prevents `recover` from changing the file.
        let _ = file.try_lock();
        Ok(Self {
            path,
            file,
            line: Vec::new(),
        })
    }

    /// Appends a ping of `sonar`. The operating system has accepted the whole line before this returns.
    pub(crate) fn push(
        &mut self,
        sonar: &SonarSpec,
        plan: &PingPlan,
        output: &PingOutput,
        targets: &[Target],
    ) -> Result<(), RecordError> {
        self.line.clear();
        write_truth(&mut self.line, sonar, plan, output, targets)
            .map_err(RecordError::io(&self.path, "write"))?;
        self.line.push(b'\n');
        self.file
            .write_all(&self.line)
            .map_err(RecordError::io(&self.path, "write"))
    }

    pub(crate) fn path(&self) -> &Path {
        &self.path
    }
}

/// Appends the truth of a ping to `line`: one JSON object without a line end.
pub(crate) fn write_truth(
    line: &mut Vec<u8>,
    sonar: &SonarSpec,
    plan: &PingPlan,
    output: &PingOutput,
    targets: &[Target],
) -> std::io::Result<()> {
    let truth = PingTruth {
        scene: output.scene.into(),
        error_check: output.error_check.map(Into::into),
        methods: output
            .methods
            .map(|mark| MethodTruth::of(mark, output.error_check)),
        soundings: output.soundings.iter().map(Into::into).collect(),
        ..ping_truth(sonar, plan, targets)
    };
    Ok(serde_json::to_writer(line, &truth)?)
}

fn ping_truth<'a>(sonar: &'a SonarSpec, plan: &PingPlan, targets: &'a [Target]) -> PingTruth<'a> {
    let pose = plan.trajectory.pose_at(0.0);
    let (roll_rad, pitch_rad, heading_rad) = angles_from_rotation(pose.world_from_body);
    PingTruth {
        sonar: &sonar.name,
        ping_number: plan.ping_number,
        utc: DateTime::from_timestamp_nanos(plan.transmit_utc.0)
            .to_rfc3339_opts(SecondsFormat::Nanos, true),
        utc_ns: plan.transmit_utc.0,
        stamp_utc_ns: plan.stamp_utc.0,
        pose: PoseTruth {
            position_m: pose.position_m.to_array(),
            roll_deg: roll_rad.to_degrees(),
            pitch_deg: pitch_rad.to_degrees(),
            heading_deg: heading_rad.to_degrees(),
            heave_down_m: plan.nav.heave_down_m,
            latitude_deg: plan.nav.latitude_rad.to_degrees(),
            longitude_deg: plan.nav.longitude_rad.to_degrees(),
            height_m: plan.nav.height_m,
        },
        nav_flags: nav_flags(&plan.nav),
        velocity_m_per_s: pose.velocity_m_per_s.to_array(),
        plan: plan_text::plan_summary(plan),
        segments: plan_text::segments(&plan.segments),
        scene: SceneTruth::default(),
        error_check: None,
        methods: None,
        soundings: Vec::new(),
        targets: targets
            .iter()
            .map(|target| target_truth(sonar, plan, &pose, heading_rad, target))
            .collect(),
    }
}

fn nav_flags(nav: &NavState) -> Vec<&'static str> {
    let invalid = nav.invalid;
    let flags = [
        (invalid.position, "invalid-position"),
        (invalid.heading, "invalid-heading"),
        (invalid.roll_pitch, "invalid-roll-pitch"),
        (invalid.vertical, "invalid-vertical"),
        (nav.time_jumped, "time-jumped"),
    ];
    let set = flags.into_iter().filter(|(is_set, _)| *is_set);
    set.map(|(_, name)| name).collect()
}

fn target_truth<'a>(
    sonar: &SonarSpec,
    plan: &PingPlan,
    pose: &Pose,
    heading_rad: f64,
    target: &'a Target,
) -> TargetTruth<'a> {
    let (target_m, velocity) = target.at(plan.transmit_utc, 0.0);
    let from = |body_m: DVec3| target_m - pose.point_m(body_m);
    let transmit = sonar.transmit.iter().map(|t| t.mounting.position_m);
    let ranges_m: Vec<_> = transmit.clone().map(|t| from(t).length()).collect();
    let offset = from(transmit.clone().next().unwrap_or(DVec3::ZERO));
    let range_m = offset.length();
    let body = pose.world_from_body.inverse() * offset;
    let bearing_deg = wrap_half_turn_deg((offset.y.atan2(offset.x) - heading_rad).to_degrees());
    let side = if bearing_deg < 0.0 {
        Side::Port
    } else {
        Side::Starboard
    };
    let delays_s: Vec<_> = (0..sonar.receive.len())
        .map(|array| echo_delay_s(sonar, plan, array, target))
        .collect();
    TargetTruth {
        name: &target.name,
        target_strength_db: target.target_strength_db,
        position_m: target_m.to_array(),
        velocity_m_per_s: target.course.as_ref().map(|_| velocity.to_array()),
        range_rate_m_per_s: target.course.as_ref().map(|_| {
            let body_m = transmit.clone().next().unwrap_or(DVec3::ZERO);
            let closing = velocity - pose.point_velocity_m_per_s(body_m);
            closing.dot(offset) / range_m.max(f64::MIN_POSITIVE)
        }),
        range_m,
        delay_s: delays_s
            .first()
            .copied()
            .unwrap_or(2.0 * range_m / plan.sound_speed_m_per_s),
        delays_s,
        ranges_m,
        bearing_deg,
        side: plan_text::side(side),
        along_m: body.x,
        across_m: body.y,
        below_m: body.z,
    }
}

/// Arrival of the leading edge of an echo from the position of `target` at the centre of a receive array, s after the start of the pulse. NaN without a ray.
pub(crate) fn echo_delay_s(
    sonar: &SonarSpec,
    plan: &PingPlan,
    array: usize,
    target: &Target,
) -> f64 {
    let array = &sonar.receive[array];
    let transmit = &sonar.transmit[array.transmit].mounting;
    let transmit_m = plan.trajectory.pose_at(0.0).point_m(transmit.position_m);
    let (mut first_leg_m, mut seen_m) = (0.0, transmit_m);
    // A moving target is where the sound finds it. Each round reduces the error by the ratio of the speeds.
    let rounds = if target.course.is_some() { 12 } else { 1 };
    for _ in 0..rounds {
        let hit_s = first_leg_m / plan.sound_speed_m_per_s;
        let (target_m, _) = target.at(plan.transmit_utc, hit_s);
        let Some(virtual_m) = echotank_ping::virtual_point_m(plan, target_m) else {
            return f64::NAN;
        };
        seen_m = virtual_m;
        first_leg_m = seen_m.distance(transmit_m);
    }
    delay_s(plan, first_leg_m, array.mounting.position_m, seen_m)
}

/// Solves c u = first leg + |target - r(u)| by fixed-point iteration. Each round reduces the error by v/c; twelve reach f64 precision at v = 0.1 c.
fn delay_s(plan: &PingPlan, first_leg_m: f64, receive_body_m: DVec3, target_m: DVec3) -> f64 {
    let mut u_s = 0.0;
    for _ in 0..20 {
        let receive_m = plan.trajectory.pose_at(u_s).point_m(receive_body_m);
        u_s = (first_leg_m + target_m.distance(receive_m)) / plan.sound_speed_m_per_s;
    }
    u_s
}

/// Wraps to -180..=180.
fn wrap_half_turn_deg(angle_deg: f64) -> f64 {
    angle_deg - 360.0 * (angle_deg / 360.0).round()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::io::record::testing::{plan, sonar};
    use echotank_core::frames::{Trajectory, rotation_from_angles};
    use echotank_core::ping::Segment;
    use echotank_core::time::UtcNs;

    fn target(name: &str, position_m: DVec3) -> Target {
        Target {
            name: name.into(),
            position_m,
            target_strength_db: -20.0,
            course: None,
        }
    }

    /// Heading east at 2 m/s with 10 degrees of roll.
    fn heading_east() -> PingPlan {
        let attitude = rotation_from_angles(10_f64.to_radians(), 0.0, 90_f64.to_radians());
        let start = DVec3::new(100.0, -50.0, 1.0);
        let mut plan = plan(17);
        plan.trajectory = Trajectory::uniform(start, DVec3::new(0.0, 2.0, 0.0), attitude);
        plan.segments = vec![Segment {
            start_s: 0.0,
            position_m: start,
            velocity_m_per_s: DVec3::new(0.0, 2.0, 0.0),
            world_from_body: attitude,
        }];
        plan.transmit_utc = UtcNs(1_400_000_000_250_000_000);
        plan
    }

    fn lines(pings: &[PingPlan], targets: &[Target]) -> Vec<Value> {
        let dir = tempfile::tempdir().expect("dir");
        let mut truth = TruthRecorder::create(dir.path()).expect("create");
        for plan in pings {
            truth
                .push(&sonar(), plan, &PingOutput::default(), targets)
                .expect("push");
        }
        let text = std::fs::read_to_string(truth.path()).expect("read");
        assert!(text.ends_with('\n'));
        text.lines()
            .map(|l| serde_json::from_str(l).expect("each line is JSON"))
            .collect()
    }

    #[test]
    fn targets_lie_where_plane_geometry_puts_them() {
        let plan = heading_east();
        let pose = plan.trajectory.pose_at(0.0);
        let transmit = pose.point_m(sonar().transmit[0].mounting.position_m);
        // Heading east: north is port, south is starboard, east is ahead.
        let targets = [
            target("port", transmit + DVec3::new(30.0, 0.0, 40.0)),
            target("starboard bow", transmit + DVec3::new(-10.0, 10.0, 0.0)),
            target("astern", transmit + DVec3::new(-1e-9, -5.0, 0.0)),
        ];
        let line = &lines(std::slice::from_ref(&plan), &targets)[0];
        let near = |got: &Value, want: f64| {
            let got = got.as_f64().expect("a number");
            assert!((got - want).abs() < 1e-6, "got {got} want {want}");
        };
        let [port, bow, astern] = [0, 1, 2].map(|i| &line["targets"][i]);
        near(&port["range_m"], 50.0);
        // Closed form for a receiver at constant velocity (polyline path model, one segment).
        let c = plan.sound_speed_m_per_s;
        for (i, array) in sonar().receive.iter().enumerate() {
            let from = pose.point_m(sonar().transmit[array.transmit].mounting.position_m);
            let first_leg = targets[0].position_m.distance(from);
            let d = targets[0].position_m - pose.point_m(array.mounting.position_m);
            let v = pose.velocity_m_per_s;
            let b = c * first_leg - d.dot(v);
            let a = c * c - v.length_squared();
            let u = (b + (b * b - a * (first_leg * first_leg - d.length_squared())).sqrt()) / a;
            let got = port["delays_s"][i].as_f64().expect("number");
            assert!((got - u).abs() < 1e-14, "array {i}: got {got} want {u}");
        }
        assert_eq!(port["delay_s"], port["delays_s"][0]);
        near(&port["bearing_deg"], -90.0);
        assert_eq!(
            (&port["side"], &port["name"]),
            (&Value::from("port"), &Value::from("port"))
        );
        near(&port["along_m"], 0.0);
        // With 10 degrees of roll, starboard down, points to port and below move outwards in body axes.
        let (sin, cos) = 10_f64.to_radians().sin_cos();
        near(&port["across_m"], -30.0 * cos + 40.0 * sin);
        near(&port["below_m"], 30.0 * sin + 40.0 * cos);
        near(&bow["bearing_deg"], 45.0);
        assert_eq!(bow["side"], "starboard");
        near(&bow["along_m"], 10.0);
        near(
            &astern["bearing_deg"].as_f64().expect("number").abs().into(),
            180.0,
        );
        let second = pose.point_m(sonar().transmit[1].mounting.position_m);
        near(
            &port["ranges_m"][1],
            (targets[0].position_m - second).length(),
        );
    }

    #[test]
    fn a_line_tells_time_pose_velocity_and_plan() {
        let line = &lines(&[heading_east()], &[])[0];
        assert_eq!(line["sonar"], sonar().name.as_str());
        assert_eq!(line["ping_number"], 17);
        assert_eq!(line["utc"], "2014-05-13T16:53:20.250000000Z");
        assert_eq!(line["utc_ns"], 1_400_000_000_250_000_000_i64);
        let heading = line["pose"]["heading_deg"].as_f64().expect("number");
        let roll = line["pose"]["roll_deg"].as_f64().expect("number");
        assert!((heading - 90.0).abs() < 1e-9 && (roll - 10.0).abs() < 1e-9);
        assert_eq!(line["velocity_m_per_s"], serde_json::json!([0.0, 2.0, 0.0]));
        assert_eq!(line["plan"]["model"]["path"], "polyline");
        assert_eq!(line["plan"]["sample_count"], 20);
        assert_eq!(line["segments"][0]["velocity_m_per_s"][1], 2.0);
    }

    #[test]
    fn equal_pings_make_equal_lines_one_per_ping() {
        let all = lines(&[heading_east(), plan(18), heading_east()], &[]);
        assert_eq!(all.len(), 3);
        assert_eq!(all[0], all[2]);
        assert_ne!(all[0], all[1]);
    }

    #[cfg(target_os = "linux")]
    #[test]
    fn a_missing_folder_and_a_full_disk_are_errors_that_name_the_file() {
        let error = TruthRecorder::create(Path::new("/no/such/folder")).expect_err("no folder");
        assert!(
            error
                .to_string()
                .starts_with("/no/such/folder/truth.jsonl: cannot create"),
            "{error}"
        );
        let mut full = TruthRecorder::at("/dev/full".into()).expect("opens");
        let error = full
            .push(&sonar(), &plan(1), &PingOutput::default(), &[])
            .expect_err("full disk");
        assert!(
            error.to_string().starts_with("/dev/full: cannot write"),
            "{error}"
        );
    }
}

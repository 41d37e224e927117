//! Soundings of whole pings (navigation, scene, echoes, elements, beams, bottom detection) compared with their seabed.

use std::collections::BTreeMap;
use std::fmt::Write as _;
use std::path::Path;

use echotank_config::spec::{
    BottomSpec, Density, IncidenceSpec, NavInputSpec, RigSpec, SeabedShape, SeabedSpec,
    VerticalSpec,
};
use echotank_core::ping::{Detection, PingPlan, Sounding};
use echotank_ping::threads::pool;
use echotank_testing::pings::LoggedPings;
use echotank_testing::track::rows;
use glam::DVec3;
use serde::Serialize;

/// Case of a seabed and a motion.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) enum Case {
    Flat,
    /// Plane that slopes down to starboard by 10 degrees.
    Slope,
    /// The survey of the quickstart, on a straight track.
    Survey,
    /// The survey of the quickstart, with its swell.
    Swell,
}

impl Case {
    pub(crate) const ALL: [Self; 4] = [Self::Flat, Self::Slope, Self::Survey, Self::Swell];

    pub(crate) fn name(self) -> &'static str {
        match self {
            Self::Flat => "flat, 50 m",
            Self::Slope => "slope, 10 degrees across",
            Self::Survey => "JD211 grid",
            Self::Swell => "JD211 grid, in the swell",
        }
    }
}

/// One sounding in world coordinates, with the seabed depth below it.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Found {
    pub(crate) angle_rad: f64,
    pub(crate) north_m: f64,
    pub(crate) east_m: f64,
    pub(crate) down_m: f64,
    pub(crate) true_down_m: f64,
    pub(crate) detection: Detection,
}

/// Result of one case.
pub(crate) struct Soundings {
    pub(crate) case: Case,
    pub(crate) pings: usize,
    /// Soundings from port to starboard.
    pub(crate) angles_rad: Vec<f64>,
    pub(crate) found: Vec<Found>,
}

/// Beams in an interval of angle from the vertical, on both sides.
#[derive(Clone, Copy, Debug, Serialize)]
pub(crate) struct Row {
    pub(crate) from_deg: f64,
    pub(crate) to_deg: f64,
    pub(crate) found: usize,
    /// Fraction of the beams with a detection.
    pub(crate) share: f64,
    pub(crate) by_phase: f64,
    pub(crate) mean_m: f64,
    /// 95th percentile of the errors.
    pub(crate) p95_m: f64,
    pub(crate) depth_m: f64,
}

/// Changes to `hil-configs/multibeam.toml` for a case. The track is written to `folder`.
pub(crate) fn spec(
    case: Case,
    folder: &Path,
    elements: usize,
    beams: usize,
) -> Result<RigSpec, String> {
    let root = crate::repository();
    let mut spec = echotank_runtime::config_files::load(&root.join("hil-configs/multibeam.toml"))
        .map_err(|e| e.to_string())?;
    let sonar = &mut spec.sonars[0];
    sonar.receive[0].elements = elements;
    sonar.settings.max_ping_rate_hz = 1.0;
    if let Some(fan) = &mut sonar.beams.fan {
        fan.beams = beams;
        fan.sector_rad = 120f64.to_radians();
        fan.form.bottom_detection = true;
    }
    let plane = |slope_north| SeabedSpec {
        shape: SeabedShape::Plane {
            depth_m: 50.0,
            slope_north,
            slope_east: 0.0,
        },
        density: Density::PerM2(10.0),
        bottom: BottomSpec::Lambert { mu_db: -27.0 },
        incidence: IncidenceSpec::Normal,
        mosaic: None,
        speckle: true,
    };
    match case {
        Case::Flat => spec.scene.seabed = Some(plane(0.0)),
        Case::Slope => {
            // The track is eastward, so starboard is south.
            spec.scene.seabed = Some(plane(-10f64.to_radians().tan()));
            // At 55 degrees, the sloping bottom is 107 m away.
            spec.sonars[0].settings.range_m = 120.0;
            if let Some(fan) = &mut spec.sonars[0].beams.fan {
                fan.sector_rad = 110f64.to_radians();
            }
        }
        Case::Survey | Case::Swell => {}
    }
    if case != Case::Swell {
        // Eastward at 2.5 m/s. The centre of a survey is below the first fix, so half of it is astern.
        let track = rows(140, 2.0, |t_s| [0.0, 2.5 * t_s, 0.0, 0.0, 0.0, 90.0]);
        let path = folder.join("track.csv");
        std::fs::write(&path, track).map_err(|e| e.to_string())?;
        spec.nav.vertical = VerticalSpec::Depth;
        spec.nav.loop_log = false;
        spec.nav.sources.truncate(1);
        spec.nav.sources[0].input = NavInputSpec::Csv { path };
    }
    Ok(spec)
}

/// Soundings of consecutive pings, `every_s` apart.
pub(crate) fn measure(
    case: Case,
    spec: &RigSpec,
    pings: usize,
    every_s: f64,
) -> Result<Soundings, String> {
    let mut spec = spec.clone();
    spec.sonars[0].settings.max_ping_rate_hz = 1.0 / every_s;
    pool(0)
        .map_err(|e| e.to_string())?
        .install(|| run(case, &spec, pings))
}

fn run(case: Case, spec: &RigSpec, pings: usize) -> Result<Soundings, String> {
    let mut log = LoggedPings::open(spec)?.ok_or("the navigation has no position")?;
    let mut out = Soundings {
        case,
        pings,
        angles_rad: Vec::new(),
        found: Vec::new(),
    };
    for _ in 0..pings {
        let order = log.next_order()?;
        if !log.cover(&order) {
            return Err("the navigation ends".into());
        }
        log.make(&order)?;
        let slot = &log.slot;
        out.angles_rad.clone_from(&slot.output.beams[0].angle_rad);
        for sounding in &slot.output.soundings {
            let at_m = place(spec, &slot.plan, sounding);
            if let Some(true_down_m) = log.rig.scene.seabed_down_m(at_m.x, at_m.y) {
                out.found.push(Found {
                    angle_rad: sounding.angle_rad,
                    north_m: at_m.x,
                    east_m: at_m.y,
                    down_m: at_m.z,
                    true_down_m,
                    detection: sounding.detection,
                });
            }
        }
    }
    Ok(out)
}

/// Position of a sounding on the intersection of a plane and a cone, from the midpoint between transmitter and receiver. The plane
/// is across the transmitter, at its attitude at transmission. The cone is about the line of the receiver, at its attitude at
/// reception.
fn place(spec: &RigSpec, plan: &PingPlan, sounding: &Sounding) -> DVec3 {
    let sonar = &spec.sonars[0];
    let (sent, heard) = (
        plan.trajectory.pose_at(0.0),
        plan.trajectory.pose_at(sounding.twtt_s),
    );
    let transmit = &sonar.transmit[sonar.receive[0].transmit].mounting;
    let receive = &sonar.receive[0].mounting;
    let from_m = 0.5 * (sent.point_m(transmit.position_m) + heard.point_m(receive.position_m));
    // Axes: along the transmitter, perpendicular to it along the receiver, and down.
    let along = sent.world_from_body * (transmit.body_from_array * DVec3::X);
    let line = heard.world_from_body * (receive.body_from_array * DVec3::X);
    let (askew, sine) = (along.dot(line), sounding.angle_rad.sin());
    let across = (line - along * askew).normalize();
    let across_sine = sine / (1.0 - askew * askew).sqrt();
    let down = along.cross(across);
    let down = if down.z < 0.0 { -down } else { down };
    let way = across * across_sine + down * (1.0 - across_sine * across_sine).max(0.0).sqrt();
    from_m + way * (0.5 * plan.sound_speed_m_per_s * sounding.twtt_s)
}

impl Soundings {
    /// Statistics by angle from boresight, in steps of `step_deg`.
    pub(crate) fn rows(&self, step_deg: f64) -> Vec<Row> {
        let max_deg = (self.angles_rad.iter()).fold(0.0_f64, |a, b| a.max(b.abs().to_degrees()));
        let steps = (max_deg / step_deg).ceil() as usize;
        (0..steps)
            .filter_map(|k| {
                let (from_deg, to_deg) = (k as f64 * step_deg, (k + 1) as f64 * step_deg);
                let inside = |a: f64| (from_deg..to_deg).contains(&a.abs().to_degrees());
                let beams = self.angles_rad.iter().filter(|a| inside(**a)).count() * self.pings;
                let of: Vec<&Found> = self.found.iter().filter(|f| inside(f.angle_rad)).collect();
                if of.is_empty() {
                    return None;
                }
                let mut errors: Vec<f64> = of.iter().map(|f| f.down_m - f.true_down_m).collect();
                let n = errors.len() as f64;
                let mean_m = errors.iter().sum::<f64>() / n;
                errors.sort_by(|a, b| a.abs().total_cmp(&b.abs()));
                let phase = of
                    .iter()
                    .filter(|f| f.detection == Detection::Phase)
                    .count();
                Some(Row {
                    from_deg,
                    to_deg,
                    found: of.len(),
                    share: n / beams.max(1) as f64,
                    by_phase: phase as f64 / n,
                    mean_m,
                    p95_m: errors[((0.95 * n) as usize).min(errors.len() - 1)].abs(),
                    depth_m: of.iter().map(|f| f.true_down_m).sum::<f64>() / n,
                })
            })
            .collect()
    }

    pub(crate) fn table(&self, step_deg: f64) -> String {
        let mut out = format!(
            "{}, {} pings\n off the vertical  soundings  of the beams  by phase  mean error  95 % below\n",
            self.case.name(),
            self.pings
        );
        for r in self.rows(step_deg) {
            let _ = writeln!(
                out,
                " {:3.0} to {:2.0} degrees  {:9}  {:10.1} %  {:6.0} %  {:+8.3} m  {:8.3} m  {:.2} % of {:.1} m",
                r.from_deg,
                r.to_deg,
                r.found,
                100.0 * r.share,
                100.0 * r.by_phase,
                r.mean_m,
                r.p95_m,
                100.0 * r.p95_m / r.depth_m,
                r.depth_m
            );
        }
        out
    }

    /// Mean sounding and mean truth by cell of `cell_m`, north and east, for cells with at least `least` soundings.
    pub(crate) fn cells(&self, cell_m: f64, least: usize) -> BTreeMap<(i64, i64), (f64, f64)> {
        let mut cells = BTreeMap::<(i64, i64), (f64, f64, usize)>::new();
        let index = |at_m: f64| (at_m / cell_m).floor() as i64;
        for f in &self.found {
            let cell = cells
                .entry((index(f.north_m), index(f.east_m)))
                .or_default();
            *cell = (cell.0 + f.down_m, cell.1 + f.true_down_m, cell.2 + 1);
        }
        cells.retain(|_, cell| cell.2 >= least);
        let mean = |(found, truth, n): (f64, f64, usize)| (found / n as f64, truth / n as f64);
        cells
            .into_iter()
            .map(|(at, cell)| (at, mean(cell)))
            .collect()
    }

    /// Pairs of mean sounding and mean truth of these cells.
    pub(crate) fn relief(&self, cell_m: f64, least: usize) -> Vec<(f64, f64)> {
        self.cells(cell_m, least).into_values().collect()
    }
}

/// Correlation of the pairs, and standard deviations of the second value and of the difference.
pub(crate) fn agreement(pairs: &[(f64, f64)]) -> (f64, f64, f64) {
    let n = pairs.len() as f64;
    let mean = |of: &dyn Fn(&(f64, f64)) -> f64| pairs.iter().map(of).sum::<f64>() / n;
    let (a, b) = (mean(&|p| p.0), mean(&|p| p.1));
    let aa = mean(&|p| (p.0 - a).powi(2));
    let bb = mean(&|p| (p.1 - b).powi(2));
    let ab = mean(&|p| (p.0 - a) * (p.1 - b));
    let apart = mean(&|p| (p.0 - a - p.1 + b).powi(2));
    (ab / (aa * bb).sqrt(), bb.sqrt(), apart.sqrt())
}

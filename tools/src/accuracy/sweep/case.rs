//! Case of one sonar over one scene in one motion, in three families: the ping of the paper, variations of it, and random
//! cases.

use echotank_core::arrays::{ArrayGeometry, Mounting, Pattern, ReceiverFilter, TransmitArray};
use echotank_core::frames::{Trajectory, VectorKnot, rotation_from_angles};
use echotank_core::model::{DopplerModel, ModelChoice, PathModel, Synthesis};
use echotank_core::ping::PingPlan;
use echotank_core::pulse::{Pulse, PulseKind};
use echotank_core::scene::{ScatterLaw, Scatterers};
use echotank_core::settings::SonarSettings;
use echotank_core::testing::plan_at_rest;
use echotank_ping as ping;
use echotank_synthesis::array::gridded2d::Bounds;
use echotank_synthesis::echo::error_models;
use echotank_synthesis::error_model::Conditions;
use echotank_testing::echo as rig;
use glam::{DQuat, DVec3};
use num_complex::Complex64;

use crate::accuracy::case::{attitude_knots, knot_times_s};
use crate::draw::Chance;

pub(crate) const C: f64 = 1500.0;

/// All inputs of a method.
pub(crate) struct Case {
    pub(crate) scene: String,
    pub(crate) motion: String,
    /// Plan of the ping. The methods set path and Doppler model.
    pub(crate) plan: PingPlan,
    pub(crate) tx: TransmitArray,
    pub(crate) rx: ArrayGeometry,
    pub(crate) scatterers: Scatterers,
    pub(crate) rate_hz: f64,
    pub(crate) filter: ReceiverFilter,
    /// Maximum Doppler shift in the pass band of the receiver filter, Hz.
    pub(crate) doppler_hz: f64,
    /// Compared elements.
    pub(crate) looked_at: Vec<usize>,
    pub(crate) conditions: Conditions,
}

/// Motion of the platform, which distinguishes the cells of the table.
#[derive(Clone, Copy)]
pub(crate) struct Motion {
    pub(crate) name: &'static str,
    /// Velocity forward, to starboard, down.
    pub(crate) velocity_m_per_s: DVec3,
    /// Swell: amplitude of heave in metres, of roll and pitch in radians; yaw at a constant rate, radians per second.
    pub(crate) heave_m: f64,
    pub(crate) roll_rad: f64,
    pub(crate) pitch_rad: f64,
    pub(crate) yaw_rad_per_s: f64,
}

/// Motion at a constant velocity.
const fn calm(name: &'static str, x: f64, y: f64, z: f64) -> Motion {
    Motion {
        name,
        velocity_m_per_s: DVec3::new(x, y, z),
        heave_m: 0.0,
        roll_rad: 0.0,
        pitch_rad: 0.0,
        yaw_rad_per_s: 0.0,
    }
}

pub(crate) const MOTIONS: [Motion; 5] = [
    calm("still", 0.0, 0.0, 0.0),
    calm("5 m/s", 5.0, 0.0, 0.0),
    calm("10 m/s", 10.0, 0.0, 0.0),
    calm("5, sway 0.3, heave 0.3", 5.0, 0.3, 0.3),
    Motion {
        heave_m: 1.0,
        roll_rad: 0.14,
        pitch_rad: 0.05,
        yaw_rad_per_s: 0.05,
        ..calm("5 in a swell, rolling", 5.0, 0.3, 0.0)
    },
];

/// Periods of heave, roll and pitch, seconds, and their phases at a ping's start.
const SWELL_S: [f64; 3] = [6.0, 8.0, 5.0];
const SWELL_PHASE_RAD: [f64; 3] = [0.9, 2.0, 0.3];
/// Interval of the knots of the trajectory, as from a fast motion sensor, seconds.
const KNOT_S: f64 = 0.02;

impl Motion {
    fn trajectory(&self, until_s: f64) -> Trajectory {
        let uniform = Trajectory::uniform(DVec3::ZERO, self.velocity_m_per_s, DQuat::IDENTITY);
        if self.uniform() {
            return uniform;
        }
        let attitude = |t_s: f64| {
            let wave =
                |k: usize| (std::f64::consts::TAU * t_s / SWELL_S[k] + SWELL_PHASE_RAD[k]).sin();
            let yaw = self.yaw_rad_per_s * t_s;
            rotation_from_angles(self.roll_rad * wave(1), self.pitch_rad * wave(2), yaw)
        };
        let heave = knot_times_s(KNOT_S, until_s).map(|time_s| {
            let omega = std::f64::consts::TAU / SWELL_S[0];
            let phase = omega * time_s + SWELL_PHASE_RAD[0];
            VectorKnot {
                time_s,
                value: DVec3::Z * (self.heave_m * (phase.sin() - SWELL_PHASE_RAD[0].sin())),
                rate_per_s: DVec3::Z * (self.heave_m * omega * phase.cos()),
            }
        });
        Trajectory {
            heave: heave.collect(),
            attitude: attitude_knots(KNOT_S, until_s, attitude),
            ..uniform
        }
    }

    fn uniform(&self) -> bool {
        self.heave_m == 0.0
            && self.roll_rad == 0.0
            && self.pitch_rad == 0.0
            && self.yaw_rad_per_s == 0.0
    }
}

/// Geometry of the swath: slant ranges, sector about broadside, and depth below the sonar.
#[derive(Clone, Copy)]
struct Swath {
    near_m: f64,
    far_m: f64,
    sector_rad: f64,
    depth_m: f64,
    rough_m: f64,
}

impl Swath {
    fn scatter(&self, count: usize, law: ScatterLaw, chance: &mut Chance) -> Scatterers {
        let mut scatterers = Scatterers::default();
        for _ in 0..count {
            let range_m = chance.between(self.near_m, self.far_m);
            let down_m =
                self.depth_m.min(0.9 * self.near_m) + chance.between(-1.0, 1.0) * self.rough_m;
            let ground_m = (range_m * range_m - down_m * down_m).max(0.0).sqrt();
            let azimuth = chance.between(-1.0, 1.0) * self.sector_rad;
            let strength = Complex64::from_polar(
                chance.between(0.5, 1.5),
                chance.between(0.0, std::f64::consts::TAU),
            );
            let position_m = DVec3::new(ground_m * azimuth.sin(), ground_m * azimuth.cos(), down_m);
            scatterers.push(position_m, [0.0, 0.0, -1.0], strength, law);
        }
        scatterers
    }
}

/// Transmitted pulse and receiver.
#[derive(Clone, Copy)]
struct Reception {
    pulse: Pulse,
    rate_hz: f64,
    filter: ReceiverFilter,
    doppler_hz: f64,
    segment_s: f64,
}

fn build(
    names: (String, String),
    motion: &Motion,
    swath: Swath,
    reception: Reception,
    arrays: (TransmitArray, ArrayGeometry),
    scatterers: Scatterers,
) -> Case {
    let Reception { pulse, .. } = reception;
    let (tx, rx) = arrays;
    let settings = SonarSettings {
        pinging: true,
        range_m: swath.far_m,
        max_ping_rate_hz: 1.0,
        source_level_db: 0.0,
        gain_db: 0.0,
        pulse_duration_s: pulse.duration_s,
    };
    // The record extends from well before the first echo to well past the last, so that no window is truncated.
    let first_sample_s = 2.0 * swath.near_m / C - 3.1e-3;
    let span_s = 2.0 * (swath.far_m - swath.near_m) / C + pulse.duration_s + 6.2e-3;
    let sample_count = (span_s * reception.rate_hz) as usize;
    let until_s = first_sample_s + span_s;
    let trajectory = motion.trajectory(until_s);
    let mut segments = Vec::new();
    // In uniform motion one segment is exact.
    let segment_s = if motion.uniform() {
        10.0
    } else {
        reception.segment_s
    };
    ping::polyline(&trajectory, until_s, segment_s, &mut segments);
    let plan = PingPlan {
        ping_period_s: 1.0,
        settings,
        absorption_db_per_m: 0.096,
        first_sample_s,
        model: ModelChoice {
            path: PathModel::Continuous,
            doppler: DopplerModel::Stretch,
            synthesis: Synthesis::Direct,
            segment_s,
            cull_db: None,
        },
        trajectory,
        segments,
        ..plan_at_rest(&pulse, sample_count, C)
    };
    // The compared elements are the ends and the middle. A median needs three elements.
    let mut looked_at = vec![0, (rx.elements - 1) / 2, rx.elements - 1];
    looked_at.dedup();
    let conditions = conditions(&plan, &tx, &rx, swath, reception, scatterers.len());
    Case {
        scene: names.0,
        motion: names.1,
        plan,
        tx,
        rx,
        scatterers,
        rate_hz: reception.rate_hz,
        filter: reception.filter,
        doppler_hz: reception.doppler_hz,
        looked_at,
        conditions,
    }
}

/// Inputs of the error models, measured on the trajectory.
fn conditions(
    plan: &PingPlan,
    tx: &TransmitArray,
    rx: &ArrayGeometry,
    swath: Swath,
    reception: Reception,
    scatterers: usize,
) -> Conditions {
    const STEPS: usize = 200;
    let until_s = plan.window_s(reception.rate_hz);
    let step_s = until_s / STEPS as f64;
    let points = [
        tx.mounting.position_m,
        rx.element_body_m(0),
        rx.element_body_m(rx.elements - 1),
    ];
    let (mut speed, mut acceleration, mut turning): (f64, f64, f64) = (0.0, 0.0, 0.0);
    let mut farthest_m: f64 = 0.0;
    for body_m in points {
        let velocity = |k: usize| {
            let pose = plan.trajectory.pose_at(k as f64 * step_s);
            (
                pose.point_velocity_m_per_s(body_m),
                pose.velocity_m_per_s,
                pose.point_m(body_m),
            )
        };
        for k in 0..STEPS {
            let (here, platform, place_m) = velocity(k);
            let change = (velocity(k + 1).0 - here).length() / step_s;
            speed = speed.max(here.length());
            // Finite differences of a constant leave rounding errors.
            acceleration = acceleration.max(if change < 1e-9 { 0.0 } else { change });
            turning = turning.max((here - platform).length());
            farthest_m = farthest_m.max(place_m.length());
        }
    }
    let turning = if turning < 1e-12 { 0.0 } else { turning };
    Conditions {
        pulse: plan.pulse,
        sound_speed_m_per_s: C,
        sample_rate_hz: reception.rate_hz,
        filter: reception.filter,
        speed_m_per_s: speed,
        acceleration_m_per_s2: acceleration,
        turning_m_per_s: turning,
        range_m: ((swath.near_m - farthest_m).max(1e-3), swath.far_m),
        segment_s: plan.model.segment_s,
        scatterers,
        elements: rx.elements,
        tolerance: 0.0,
        echo_statistics: None,
    }
}

impl Case {
    /// Combined error of path and Doppler model by their error models.
    pub(crate) fn model_error(&self, path: PathModel, doppler: DopplerModel) -> f64 {
        let error_models = error_models::window_error_models(path, doppler, &self.conditions);
        error_models
            .iter()
            .map(|error_model| error_model.error)
            .sum()
    }

    /// Bounds on angles and speeds of the case, for the design of an engine for the whole line array.
    pub(crate) fn bounds(&self) -> Bounds {
        const INSTANTS: usize = 50;
        let axis_body = self.rx.mounting.body_from_array * DVec3::X;
        let mut bounds = Bounds {
            nearest_m: self.conditions.range_m.0,
            greatest_slope: 0.0,
            along_m_per_s: 0.0,
            across_m_per_s: 0.0,
            turning_rad_per_s: 0.0,
        };
        let until_s = self.plan.window_s(self.rate_hz);
        for k in 0..=INSTANTS {
            let pose = self
                .plan
                .trajectory
                .pose_at(until_s * k as f64 / INSTANTS as f64);
            let axis = pose.world_from_body * axis_body;
            let turning = pose.angular_velocity_rad_per_s.length();
            bounds.turning_rad_per_s = bounds.turning_rad_per_s.max(turning);
            for element in [0, self.rx.elements - 1] {
                let body_m = self.rx.element_body_m(element);
                let velocity = pose.point_velocity_m_per_s(body_m);
                let along = velocity.dot(axis);
                bounds.along_m_per_s = bounds.along_m_per_s.max(along.abs());
                let across = (velocity - axis * along).length();
                bounds.across_m_per_s = bounds.across_m_per_s.max(across);
                let place_m = pose.point_m(body_m);
                for i in 0..self.scatterers.len() {
                    let ray = (self.scatterers.position_m(i) - place_m).normalize();
                    bounds.greatest_slope = bounds.greatest_slope.max(ray.dot(axis).abs());
                }
            }
        }
        // Rounding may exceed 1 slightly.
        bounds.greatest_slope = bounds.greatest_slope.min(1.0);
        bounds
    }

    pub(crate) fn with_models(&self, path: PathModel, doppler: DopplerModel) -> PingPlan {
        let mut plan = self.plan.clone();
        plan.model.path = path;
        plan.model.doppler = doppler;
        plan
    }
}

fn mounting(position_m: DVec3, body_from_array: DQuat) -> Mounting {
    Mounting {
        position_m,
        body_from_array,
    }
}

/// The paper's pulse: 400 kHz, 30 kHz, 5 ms.
fn paper_pulse(kind: PulseKind, taper: f64) -> Pulse {
    Pulse {
        kind,
        center_frequency_hz: 400e3,
        bandwidth_hz: if kind == PulseKind::Cw { 0.0 } else { 30e3 },
        duration_s: 5e-3,
        taper,
    }
}

/// Scenes of the table.
#[derive(Clone, Copy)]
pub(crate) struct Scene {
    pub(crate) name: &'static str,
    kind: PulseKind,
    taper: f64,
    sector_deg: f64,
    elements: usize,
    far_m: f64,
}

pub(crate) const SCENES: [Scene; 5] = [
    scene("paper +-15", PulseKind::LfmUp, 0.0, 15.0, 5, 150.0),
    scene("tapered +-15", PulseKind::LfmUp, 0.5, 15.0, 5, 150.0),
    scene("tapered down +-60", PulseKind::LfmDown, 0.5, 60.0, 5, 150.0),
    scene("CW +-15", PulseKind::Cw, 0.5, 15.0, 5, 75.0),
    scene("line of 64 +-60", PulseKind::LfmUp, 0.5, 60.0, 64, 60.0),
];

const fn scene(
    name: &'static str,
    kind: PulseKind,
    taper: f64,
    sector_deg: f64,
    elements: usize,
    far_m: f64,
) -> Scene {
    Scene {
        name,
        kind,
        taper,
        sector_deg,
        elements,
        far_m,
    }
}

impl Scene {
    /// Case in which every window has several of `scatterers`.
    pub(crate) fn case(&self, motion: &Motion, scatterers: usize) -> Case {
        let swath = Swath {
            near_m: 36.0,
            far_m: self.far_m,
            sector_rad: self.sector_deg.to_radians(),
            depth_m: 30.0,
            rough_m: 0.3,
        };
        let pulse = paper_pulse(self.kind, self.taper);
        let reception = Reception {
            pulse,
            rate_hz: 48e3,
            filter: ReceiverFilter::Fir,
            doppler_hz: 2.0 * 10.0 / C * pulse.center_frequency_hz,
            segment_s: 5e-3,
        };
        let rx = rig::line(DVec3::new(0.5, 0.3, 0.4), self.elements);
        let tx = rig::transmitter(DVec3::new(0.5, 0.3, 0.45));
        let scatterers = swath.scatter(scatterers, ScatterLaw::Lambert, &mut Chance::new(7));
        let names = (self.name.to_string(), motion.name.to_string());
        build(names, motion, swath, reception, (tx, rx), scatterers)
    }
}

/// Random case for a seed: pulse, filter, arrays, ranges and motion.
pub(crate) fn random(seed: u64) -> Case {
    let mut chance = Chance::new(1_000_003 + seed);
    let kind = chance.one_of(&[PulseKind::LfmUp, PulseKind::LfmDown, PulseKind::Cw]);
    let bandwidth_hz = if kind == PulseKind::Cw {
        0.0
    } else {
        chance.between(5e3, 40e3)
    };
    let pulse = Pulse {
        kind,
        center_frequency_hz: chance.between(60e3, 600e3),
        bandwidth_hz,
        duration_s: 10f64.powf(chance.between(-3.5, -2.2)),
        taper: chance.one_of(&[0.0, 0.1, 0.5, 1.0]),
    };
    let speed = chance.one_of(&[0.0, 0.5, 2.0, 5.0, 10.0]);
    let restless = chance.uniform() < 0.4;
    let mut some = |most: f64| {
        if restless {
            chance.between(-most, most)
        } else {
            0.0
        }
    };
    let motion = Motion {
        name: "",
        velocity_m_per_s: DVec3::ZERO,
        heave_m: some(1.0),
        roll_rad: some(0.15),
        pitch_rad: some(0.05),
        yaw_rad_per_s: some(0.1),
    };
    let course = chance.between(-0.2, 0.2);
    let motion = Motion {
        velocity_m_per_s: DVec3::new(course.cos(), course.sin(), chance.between(-0.05, 0.05))
            * speed,
        ..motion
    };
    let near_m = 10f64.powf(chance.between(0.7, 1.8));
    // Length of the swath in pulses, and number of echoes per pulse.
    let windows = chance.between(5.0, 20.0);
    let swath = Swath {
        near_m,
        far_m: near_m + windows * 0.5 * C * pulse.duration_s,
        sector_rad: chance.between(5.0, 85.0).to_radians(),
        depth_m: near_m * chance.between(0.3, 0.9),
        rough_m: 0.3,
    };
    let doppler_hz = 2.0 * 11.0 / C * pulse.center_frequency_hz;
    let occupied_hz = bandwidth_hz.max(4.0 / pulse.duration_s);
    let reception = Reception {
        pulse,
        rate_hz: chance.between(1.25, 2.0) * (occupied_hz + 2.0 * doppler_hz),
        filter: chance.one_of(&[
            ReceiverFilter::Fir,
            ReceiverFilter::Fir,
            ReceiverFilter::Fir,
            ReceiverFilter::None,
        ]),
        doppler_hz,
        segment_s: chance.one_of(&[2e-3, 1e-2, 5e-2]),
    };
    let place = |chance: &mut Chance| {
        let mut side = || chance.between(-1.0, 1.0);
        DVec3::new(side(), side(), side())
    };
    let attitude = |chance: &mut Chance| {
        rotation_from_angles(
            chance.between(-1.2, 0.2),
            chance.between(-0.1, 0.1),
            chance.one_of(&[0.0, 0.0, std::f64::consts::FRAC_PI_2]),
        )
    };
    let wavelength_m = C / pulse.center_frequency_hz;
    let pattern = |chance: &mut Chance| {
        if chance.uniform() < 0.5 {
            return Pattern::Omnidirectional;
        }
        Pattern::Rectangle {
            length_m: chance.between(0.2, 3.0) * wavelength_m,
            width_m: chance.between(0.2, 1.0) * wavelength_m,
            baffled: false,
        }
    };
    let tx = TransmitArray {
        mounting: mounting(place(&mut chance), attitude(&mut chance)),
        pattern: pattern(&mut chance),
        level_offset_db: 0.0,
    };
    let rx = ArrayGeometry {
        mounting: mounting(place(&mut chance), attitude(&mut chance)),
        elements: 1 + (chance.uniform() * 24.0) as usize,
        spacing_m: chance.between(0.3, 1.5) * wavelength_m,
        radius_m: None,
        element_pattern: pattern(&mut chance),
        sensitivity_db: 0.0,
        transmit: 0,
    };
    let law = chance.one_of(&[ScatterLaw::Point, ScatterLaw::Lambert]);
    let count = (windows * chance.between(4.0, 10.0)) as usize;
    let scatterers = swath.scatter(count, law, &mut chance);
    let names = (format!("random {seed}"), format!("{speed} m/s"));
    build(names, &motion, swath, reception, (tx, rx), scatterers)
}

/// One-line description of a random scene, for diagnosis.
pub(crate) fn describe(case: &Case) -> String {
    let p = &case.plan.pulse;
    let c = &case.conditions;
    format!(
        "{}: {:?} {:.0} kHz, {:.1} kHz, {:.2} ms, taper {}; {:?} at {:.1} kHz; {} elements, {:.1}..{:.1} m, {} scatterers; {:.2} m/s, {:.2} m/s2, turning {:.2} m/s",
        case.scene,
        p.kind,
        p.center_frequency_hz * 1e-3,
        p.bandwidth_hz * 1e-3,
        p.duration_s * 1e3,
        p.taper,
        case.filter,
        case.rate_hz * 1e-3,
        case.rx.elements,
        c.range_m.0,
        c.range_m.1,
        case.scatterers.len(),
        c.speed_m_per_s,
        c.acceleration_m_per_s2,
        c.turning_m_per_s,
    )
}

//! Case of one sonar in one motion over a few points, with the parameters that a sweep changes.

use echotank_config::spec::{NavInputSpec, NavMode, RigSpec, SonarSpec};
use echotank_core::frames::{Trajectory, VectorKnot, rotation_from_angles};
use echotank_core::navigation::{NavQuantity, NavSample, NavState};
use echotank_core::ping::PingPlan;
use echotank_core::scene::{ScatterLaw, Scatterers};
use echotank_core::settings::SonarSettings;
use echotank_core::time::{NS_PER_S, UtcNs};
use echotank_nav::NavHistory;
use echotank_ping::{self as ping, PingOrder};
use glam::DVec3;
use num_complex::Complex64;

use crate::accuracy::case::{STEP_S, attitude_knots, knot_times_s};
use echotank_testing::track::{ALONG_TRACK, rows};

pub(crate) const C: f64 = 1500.0;
/// UTC time of navigation samples at the pulse.
const T0: UtcNs = UtcNs(1_793_611_200 * NS_PER_S);
/// Time from the start of navigation to the ping, seconds.
pub(crate) const NAV_BEFORE_S: f64 = 8.0;
/// Navigation recorded after the ping, seconds.
const NAV_AFTER_S: f64 = 8.0;
/// Interval of the knots of an exactly known motion, seconds.
const KNOT_S: f64 = 0.01;

/// Base case: the pulse of the paper and a short line array.
#[derive(Clone)]
pub(crate) struct Base {
    pub(crate) rig: RigSpec,
}

/// Size of a case.
#[derive(Clone, Copy)]
pub(crate) struct Size {
    pub(crate) elements: usize,
    pub(crate) duration_ms: f64,
    pub(crate) bandwidth_khz: f64,
}

impl Size {
    /// Pulse of the paper: 400 kHz, 30 kHz, 5 ms.
    pub(crate) const PAPER: Self = Self {
        elements: 8,
        duration_ms: 5.0,
        bandwidth_khz: 30.0,
    };
    /// Size for tests that run in seconds.
    pub(crate) const SMALL: Self = Self {
        elements: 2,
        duration_ms: 0.5,
        bandwidth_khz: 20.0,
    };
}

impl Base {
    pub(crate) fn new(size: Size) -> Self {
        let Size {
            elements,
            duration_ms,
            bandwidth_khz,
        } = size;
        let text = format!(
            r#"[medium]
sound_speed_m_per_s = {C}
absorption = "none"
{ALONG_TRACK}[scene]
points = "points.csv"
[run]
latency_ms = 600.0
[[sonar]]
name = "one"
[sonar.pulse]
kind = "lfm"
sweep = "up"
center_frequency_khz = 400.0
bandwidth_khz = {bandwidth_khz:.3}
duration_ms = {duration_ms:.4}
taper = 0.5
[[sonar.transmit]]
name = "tx"
position_m = [0.0, 0.0, 0.0]
[[sonar.receive]]
name = "rx"
transmit = "tx"
elements = {elements}
spacing_m = 0.001875
element_pattern = "omnidirectional"
position_m = [0.1, 0.0, 0.0]
roll_deg = -60.0
sensitivity_db = 0.0
[sonar.receiver]
sample_rate_khz = {rate_khz:.3}
rx_filter = "fir"
noise_db = "none"
tvg = "none"
full_scale_v = 1e9
[sonar.ping]
range_m = 45.0
rate_hz = 2.0
source_level_db = 200.0
gain_db = 0.0
[sonar.limits]
range_m = [0.1, 45.0]
ping_rate_hz = [0.1, 20.0]
source_level_db = [170.0, 220.0]
gain_db = [-30.0, 40.0]
pulse_duration_ms = [{duration_ms:.4}, {duration_ms:.4}]
[sonar.model]
path = "continuous"
doppler = "stretch"
synthesis = "direct"
segment_ms = 10.0
tolerance = 1e-3
error_check = false
"#,
            rate_khz = 1.35 * (bandwidth_khz + 4.0 * 10.0 * 415.0 / C),
        );
        let folder = tempfile::tempdir().expect("a folder for two small files");
        let write = |name: &str, text: &str| {
            std::fs::write(folder.path().join(name), text).expect("the folder takes files");
        };
        write(
            "track.csv",
            &rows(2, 1.0, |_| [0.0, 0.0, 5.0, 0.0, 0.0, 0.0]),
        );
        write("points.csv", "north_m,east_m,down_m,amplitude\n0,30,10,1\n");
        let mut rig = echotank_runtime::config_files::parse(&text, folder.path())
            .unwrap_or_else(|why| panic!("{why}\n{text}"));
        // Sample rate of a motion sensor. Recorded tracks may have a lower rate.
        rig.nav.sources[0].input = NavInputSpec::Log {
            path: "sensor.log".into(),
            plain_rate_hz: 10.0,
        };
        Self { rig }
    }

    pub(crate) fn wavelength_m(&self) -> f64 {
        C / self.rig.sonars[0].pulse.center_frequency_hz
    }

    /// Case at rest at the origin, 5 m deep, with five points 30 m to 40 m to starboard.
    pub(crate) fn spot(&self) -> Spot {
        let mut points = Vec::new();
        for k in 0..5 {
            let azimuth_deg = 60.0 + 15.0 * f64::from(k);
            points.push(place(30.0 + 2.2 * f64::from(k), azimuth_deg, 12.0));
        }
        Spot {
            spec: self.rig.sonars[0].clone(),
            rig: self.rig.clone(),
            motion: Motion::default(),
            heard: None,
            scatterers: scatter(&points),
            first_sample_s: 0.0,
            offset_m: DVec3::ZERO,
            refused: None,
        }
    }

    /// As [`Self::spot`], moving.
    pub(crate) fn under_way(&self, speed_m_per_s: f64) -> Spot {
        let mut spot = self.spot();
        spot.motion.velocity_m_per_s = DVec3::X * speed_m_per_s;
        spot
    }
}

/// Position from the distance, the azimuth from the track, and the depth below the platform.
pub(crate) fn place(range_m: f64, azimuth_deg: f64, below_m: f64) -> DVec3 {
    let ground_m = (range_m * range_m - below_m * below_m).max(0.0).sqrt();
    let (sin, cos) = azimuth_deg.to_radians().sin_cos();
    DVec3::new(ground_m * cos, ground_m * sin, DOWN_M + below_m)
}

pub(crate) const DOWN_M: f64 = 5.0;

/// Scatterers of equal strength with different phases.
pub(crate) fn scatter(places: &[DVec3]) -> Scatterers {
    let mut scatterers = Scatterers::default();
    for (k, &at_m) in places.iter().enumerate() {
        let strength = Complex64::from_polar(at_m.length(), 2.4 * k as f64);
        scatterers.push(at_m, [0.0, 0.0, -1.0], strength, ScatterLaw::Point);
    }
    scatterers
}

/// True motion of the platform: uniform, with swell, at a constant turn rate.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct Motion {
    pub(crate) velocity_m_per_s: DVec3,
    pub(crate) heave_m: f64,
    /// Roll amplitude of the swell.
    pub(crate) roll_deg: f64,
    /// Constant pitch.
    pub(crate) pitch_deg: f64,
    pub(crate) heading_deg: f64,
    pub(crate) yaw_deg_per_s: f64,
}

/// Period of the swell, seconds. The pulse is transmitted within it.
const SWELL_S: f64 = 6.0;
const ROLL_S: f64 = 5.0;

impl Motion {
    fn is_uniform(&self) -> bool {
        self.heave_m == 0.0 && self.roll_deg == 0.0 && self.yaw_deg_per_s == 0.0
    }

    /// Reference point, and roll, pitch and heading in radians.
    pub(crate) fn at(&self, time_s: f64) -> (DVec3, [f64; 3]) {
        let wave = |period_s: f64, phase: f64| {
            (std::f64::consts::TAU * time_s / period_s + phase).sin() - phase.sin()
        };
        let place_m = DVec3::Z * DOWN_M
            + self.velocity_m_per_s * time_s
            + DVec3::Z * (self.heave_m * wave(SWELL_S, 0.9));
        let angles = [
            self.roll_deg * wave(ROLL_S, 0.4),
            self.pitch_deg,
            self.heading_deg + self.yaw_deg_per_s * time_s,
        ];
        (place_m, angles.map(f64::to_radians))
    }

    /// The exact motion as closely spaced knots.
    pub(crate) fn trajectory(&self, until_s: f64) -> Trajectory {
        let turned = |t: f64| {
            let (_, [roll, pitch, heading]) = self.at(t);
            rotation_from_angles(roll, pitch, heading)
        };
        if self.is_uniform() {
            let (place_m, _) = self.at(0.0);
            return Trajectory::uniform(place_m, self.velocity_m_per_s, turned(0.0));
        }
        let place = |time_s: f64| VectorKnot {
            time_s,
            value: self.at(time_s).0,
            rate_per_s: (self.at(time_s + STEP_S).0 - self.at(time_s - STEP_S).0) / (2.0 * STEP_S),
        };
        Trajectory {
            position: knot_times_s(KNOT_S, until_s).map(place).collect(),
            attitude: attitude_knots(KNOT_S, until_s, turned),
            ..Trajectory::default()
        }
    }
}

/// All inputs of a ping.
pub(crate) struct Spot {
    pub(crate) spec: SonarSpec,
    rig: RigSpec,
    pub(crate) motion: Motion,
    /// Motion derived from navigation; `None` if the exact motion is used.
    pub(crate) heard: Option<Trajectory>,
    pub(crate) scatterers: Scatterers,
    pub(crate) first_sample_s: f64,
    /// World coordinates offset that the methods get. The reference stays at the origin.
    pub(crate) offset_m: DVec3,
    /// Reason why no ping is computed; `None` if a ping is computed.
    pub(crate) refused: Option<String>,
}

/// One navigation message: seconds from the pulse to its validity and to its arrival, and its content.
pub(crate) struct Said {
    pub(crate) valid_s: f64,
    pub(crate) quantity: NavQuantity,
}

impl Spot {
    /// Samples the motion every `interval_s`, lets `spoil` change the messages, and passes them to the navigation of the
    /// program.
    pub(crate) fn through_navigation(
        mut self,
        interval_s: f64,
        spoil: impl Fn(usize, f64, &mut Vec<Said>),
    ) -> Self {
        let mut history = NavHistory::new(&self.rig.nav);
        let steps = ((NAV_BEFORE_S + NAV_AFTER_S) / interval_s).ceil() as usize;
        for k in 0..=steps {
            let valid_s = k as f64 * interval_s - NAV_BEFORE_S;
            let (place_m, [roll_rad, pitch_rad, heading_rad]) = self.motion.at(valid_s);
            let quantities = [
                NavQuantity::LocalPosition {
                    north_m: place_m.x,
                    east_m: place_m.y,
                    down_m: place_m.z,
                },
                NavQuantity::Heading {
                    heading_rad: heading_rad.rem_euclid(std::f64::consts::TAU),
                },
                NavQuantity::RollPitch {
                    roll_rad,
                    pitch_rad,
                },
            ];
            let mut said: Vec<Said> = quantities
                .into_iter()
                .map(|quantity| Said { valid_s, quantity })
                .collect();
            spoil(k, valid_s, &mut said);
            for Said { valid_s, quantity } in said {
                let utc = T0.plus_s(valid_s);
                history.insert(&NavSample {
                    source: 0,
                    valid_utc: utc,
                    arrival_utc: utc.max(T0.plus_s(k as f64 * interval_s - NAV_BEFORE_S)),
                    quantity,
                });
            }
        }
        let mut trajectory = Trajectory::default();
        match history.motion(
            T0,
            self.plan().window_s(self.rate_hz()),
            NavMode::Settle,
            &mut trajectory,
        ) {
            Ok(_) => self.heard = Some(trajectory),
            Err(gap) => self.refused = Some(gap.to_string()),
        }
        self
    }

    pub(crate) fn rate_hz(&self) -> f64 {
        self.spec.receiver.sample_rate_hz
    }

    pub(crate) fn rig(&self) -> &RigSpec {
        &self.rig
    }

    /// The exact motion, at the origin.
    fn plan(&self) -> PingPlan {
        let order = PingOrder {
            ping_number: 1,
            transmit_utc: T0,
            settings: SonarSettings {
                pinging: true,
                ..self.spec.settings
            },
            period_s: 0.0,
        };
        let mut plan = ping::blank(0, &self.spec, &self.rig.medium, 0.0);
        plan.first_sample_s = self.first_sample_s;
        let until_s = self.first_sample_s + ping::window_s(&order.settings, C);
        plan.trajectory = self.motion.trajectory(until_s);
        ping::fill(&mut plan, &self.spec, &order, NavState::default(), T0);
        plan
    }

    /// The true ping and its scatterers.
    pub(crate) fn truth(&self) -> (PingPlan, Scatterers) {
        (self.plan(), self.scatterers.clone())
    }

    /// The ping and its scatterers that the methods get.
    pub(crate) fn asked(&self) -> (PingPlan, Scatterers) {
        let mut plan = self.plan();
        if let Some(heard) = &self.heard {
            plan.trajectory = heard.clone();
        }
        let mut scatterers = self.scatterers.clone();
        if self.offset_m != DVec3::ZERO {
            for knot in &mut plan.trajectory.position {
                knot.value += self.offset_m;
            }
            let all = [
                (&mut scatterers.north_m, self.offset_m.x),
                (&mut scatterers.east_m, self.offset_m.y),
                (&mut scatterers.down_m, self.offset_m.z),
            ];
            for (values, by) in all {
                values.iter_mut().for_each(|value| *value += by);
            }
        }
        let window_s = plan.window_s(self.rate_hz());
        ping::polyline(
            &plan.trajectory,
            window_s,
            plan.model.segment_s,
            &mut plan.segments,
        );
        (plan, scatterers)
    }
}

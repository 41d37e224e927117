//! Scene with which all methods and peers are timed: a side-scan swath over a rough bottom, as arrivals of the echo model.
//!
//! Side-scan: sonar 30 m above the bottom, slant ranges 36 to 150 m, azimuth within a sector about broadside, array along the track, uniform motion.
//!
//! Fan of a multibeam: sonar 11 m above the bottom, slant ranges to 45 m, 10 m of ground along the track, which the side lobes of a transmitter 0.209 m
//! long reach, array across the track.

use std::f64::consts::FRAC_PI_2;

use echotank_core::arrays::{ArrayGeometry, Pattern, TransmitArray};
use echotank_core::ping::PingPlan;
use echotank_core::pulse::Pulse;
use echotank_core::scene::{ScatterLaw, Scatterers};
use echotank_synthesis::arrivals::{ArrivalChunk, ArrivalSink};
use echotank_synthesis::echo::{TransmitLeg, Window, Workspace, arrivals, insonify};
use glam::{DQuat, DVec3};
use num_complex::Complex64;

use crate::draw::Chance;
use echotank_testing::echo as rig;

pub(crate) use echotank_testing::echo::{C as SOUND_SPEED_M_PER_S, CARRIER_HZ};
pub(crate) const BANDWIDTH_HZ: f64 = 30e3;
pub(crate) const DURATION_S: f64 = 5e-3;
pub(crate) const SAMPLE_RATE_HZ: f64 = 40e3;
/// Period of the transform, seconds. The number of bins is bandwidth times period.
pub(crate) const PERIOD_S: f64 = 0.2048;
pub(crate) const BINS: usize = 6144;
pub(crate) const WINDOW_S: f64 = 0.21;

/// Bottom, and how the array looks at it.
#[derive(Clone, Copy, PartialEq)]
pub(crate) enum Geometry {
    SideScan,
    Fan,
}

impl Geometry {
    /// Length of the record, seconds.
    pub(crate) fn window_s(self) -> f64 {
        match self {
            Self::SideScan => WINDOW_S,
            Self::Fan => 0.0615,
        }
    }

    /// Approximate leading edges of the first and the last echo, seconds.
    pub(crate) fn echoes_s(self) -> [f64; 2] {
        match self {
            Self::SideScan => [0.0485, 0.1985],
            Self::Fan => [0.0152, 0.0595],
        }
    }

    /// A range below those of all scatterers, metres.
    pub(crate) fn nearest_m(self) -> f64 {
        match self {
            Self::SideScan => 35.0,
            Self::Fan => 10.0,
        }
    }

    /// Uniform over the ground.
    fn place_m(self, chance: &mut Chance, sector_deg: f64) -> DVec3 {
        match self {
            Self::SideScan => {
                let (near, far) = (20f64.powi(2), 146f64.powi(2));
                let ground_m = (near + chance.uniform() * (far - near)).sqrt();
                let azimuth = (2.0 * chance.uniform() - 1.0) * sector_deg.to_radians();
                DVec3::new(
                    ground_m * azimuth.sin(),
                    ground_m * azimuth.cos(),
                    30.0 + 0.3 * chance.normal(),
                )
            }
            Self::Fan => DVec3::new(
                10.0 * (chance.uniform() - 0.5),
                2.0 * 43.0 * (chance.uniform() - 0.5),
                11.0 + 0.03 * chance.normal(),
            ),
        }
    }

    fn transmitter(self) -> TransmitArray {
        let transmitter = rig::transmitter(DVec3::ZERO);
        match self {
            Self::SideScan => transmitter,
            Self::Fan => TransmitArray {
                pattern: Pattern::Rectangle {
                    length_m: 0.209,
                    width_m: 0.0018,
                    baffled: false,
                },
                ..transmitter
            },
        }
    }
}

#[derive(Clone, Copy)]
pub(crate) struct Shape {
    pub(crate) geometry: Geometry,
    pub(crate) bandwidth_hz: f64,
    pub(crate) scatterers: usize,
    pub(crate) speed_m_per_s: f64,
    /// Azimuth limits about broadside.
    pub(crate) sector_deg: f64,
    pub(crate) pulse_s: f64,
    /// Fraction of the pulse under its tapers.
    pub(crate) taper: f64,
}

pub(crate) struct Scene {
    geometry: Geometry,
    pub(crate) plan: PingPlan,
    pub(crate) transmit: TransmitArray,
    pub(crate) scatterers: Scatterers,
}

impl Scene {
    /// Scatterers in random order.
    pub(crate) fn new(shape: Shape) -> Self {
        let mut chance = Chance::new(1);
        let mut scatterers = Scatterers::default();
        for _ in 0..shape.scatterers {
            let position_m = shape.geometry.place_m(&mut chance, shape.sector_deg);
            let strength = Complex64::new(chance.normal(), chance.normal());
            scatterers.push(position_m, [0.0, 0.0, -1.0], strength, ScatterLaw::Lambert);
        }
        Self {
            plan: plan(shape),
            geometry: shape.geometry,
            transmit: shape.geometry.transmitter(),
            scatterers,
        }
    }

    /// A line of omnidirectional elements spaced half a wavelength; along the track for a side-scan, across it for a fan.
    pub(crate) fn array(&self, elements: usize) -> ArrayGeometry {
        let mut array = ArrayGeometry {
            sensitivity_db: -180.0,
            ..rig::line(DVec3::ZERO, elements)
        };
        if self.geometry == Geometry::Fan {
            array.mounting.body_from_array = DQuat::from_rotation_z(FRAC_PI_2);
        }
        array
    }

    /// Arrivals at one of `elements`.
    pub(crate) fn chunks_at(&self, elements: usize, element: usize) -> Vec<ArrivalChunk> {
        let mut transmit_leg = TransmitLeg::new();
        let window = Window {
            first_s: 0.0,
            last_s: self.geometry.window_s(),
        };
        let Self {
            plan,
            transmit,
            scatterers,
            ..
        } = self;
        insonify(plan, transmit, window, scatterers, &mut transmit_leg);
        let mut collector = ArrivalCollector(Vec::new());
        let array = self.array(elements);
        arrivals(
            plan,
            &array,
            element,
            &transmit_leg,
            &mut Workspace::new(),
            &mut collector,
        );
        collector.0
    }
}

/// Sink that collects all arrivals.
#[derive(Default)]
pub(crate) struct ArrivalCollector(pub(crate) Vec<ArrivalChunk>);

impl ArrivalSink for ArrivalCollector {
    fn accept(&mut self, chunk: &ArrivalChunk) {
        self.0.push(ArrivalChunk {
            len: chunk.len,
            element: chunk.element,
            delay_s: chunk.delay_s,
            doppler: chunk.doppler,
            curvature_per_s: chunk.curvature_per_s,
            amplitude: chunk.amplitude,
        });
    }
}

fn plan(shape: Shape) -> PingPlan {
    let velocity_m_per_s = DVec3::X * shape.speed_m_per_s;
    let mut plan = rig::uniform(DVec3::ZERO, velocity_m_per_s, DQuat::IDENTITY);
    plan.settings.source_level_db = 220.0;
    plan.pulse = Pulse {
        taper: shape.taper,
        ..rig::lfm(shape.bandwidth_hz, shape.pulse_s)
    };
    plan.absorption_db_per_m = 0.096;
    plan.sample_count = (shape.geometry.window_s() * SAMPLE_RATE_HZ) as usize;
    plan
}

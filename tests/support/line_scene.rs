//! Scenes for line arrays, the driver of the engine, and the error measure.

use std::sync::Mutex;

use echotank_core::arrays::{ArrayGeometry, TransmitArray};
use echotank_core::ping::{EchoCounts, PingPlan};
use echotank_core::scene::{ScatterLaw, Scatterers};
use echotank_core::simd::SimdLevel;
use echotank_synthesis::array::gridded2d::{
    Bounds, Filter, LineEngine, Resolution, Sample, Spec, TaskReport,
};
use echotank_synthesis::array::{Decimator, Direct};
use echotank_synthesis::arrivals::LineSource;
use echotank_synthesis::echo::{
    LineEchoes, LineWorkspace, TransmitLeg, Window, insonify, reference,
};
use glam::{DQuat, DVec3};
use num_complex::Complex64;

use crate::echo::*;

pub const RATE_HZ: f64 = 52e3;

/// All inputs of one ping.
pub struct Scene {
    pub plan: PingPlan,
    pub tx: TransmitArray,
    pub rx: ArrayGeometry,
    pub scatterers: Scatterers,
    pub decimator: Decimator,
}

impl Scene {
    pub fn spec(&self, bounds: Bounds, tolerance: f64) -> Spec<'_> {
        Spec {
            array: &self.rx,
            pulse: &self.plan.pulse,
            sound_speed_m_per_s: C,
            sample_rate_hz: RATE_HZ,
            filter: Some(&self.decimator),
            model: &self.plan.model,
            bounds,
            tolerance,
            level_range_db: 40.0,
            samples: self.plan.sample_count,
            scatterers: 1000,
            simd_level: SimdLevel::best(),
        }
    }

    pub fn transmit_leg(&self) -> (TransmitLeg, EchoCounts) {
        let mut transmit_leg = TransmitLeg::new();
        let counts = insonify(
            &self.plan,
            &self.tx,
            ALWAYS,
            &self.scatterers,
            &mut transmit_leg,
        );
        (transmit_leg, counts)
    }

    pub fn echoes<'a>(
        &'a self,
        transmit_leg: &'a TransmitLeg,
        work: &'a [Mutex<LineWorkspace>],
    ) -> LineEchoes<'a> {
        LineEchoes {
            plan: &self.plan,
            array: &self.rx,
            transmit_leg,
            work,
        }
    }
}

/// Parameters of a random scene.
#[derive(Clone, Copy)]
pub struct Draw {
    pub elements: usize,
    pub scatterers: usize,
    /// Sector to either side of broadside, degrees.
    pub sector_deg: f64,
    /// Surge (along the array), sway and heave, metres per second.
    pub velocity_m_per_s: DVec3,
    pub near_m: f64,
    pub far_m: f64,
    /// Relief of the bottom about its mean depth, metres.
    pub rough_m: f64,
    pub taper: f64,
    pub seed: usize,
}

pub const SIDE_SCAN: Draw = Draw {
    elements: 32,
    scatterers: 300,
    sector_deg: 15.0,
    velocity_m_per_s: DVec3::ZERO,
    near_m: 36.0,
    far_m: 75.0,
    rough_m: 0.3,
    taper: 0.1,
    seed: 0,
};

const DEPTH_M: f64 = 30.0;

/// Scene with a bottom 30 m below a line array along the track, on the starboard side.
pub fn draw(d: Draw) -> Scene {
    let mut plan = uniform(DVec3::ZERO, d.velocity_m_per_s, DQuat::IDENTITY);
    plan.pulse.taper = d.taper;
    plan.absorption_db_per_m = 0.096;
    let margin_s = 1.3e-3;
    plan.first_sample_s = 2.0 * d.near_m / C - margin_s;
    let span_s = 2.0 * (d.far_m - d.near_m) / C + plan.pulse.duration_s + 2.0 * margin_s;
    plan.sample_count = (span_s * RATE_HZ) as usize;
    let sine = d.sector_deg.to_radians().sin();
    let mut scatterers = Scatterers::default();
    for k in 0..d.scatterers {
        let at = k + 1000 * d.seed;
        let range_m = d.near_m + (d.far_m - d.near_m) * weyl(at, 0);
        let down_m = DEPTH_M + d.rough_m * (2.0 * weyl(at, 2) - 1.0);
        let farthest_m = (range_m.powi(2) - down_m.powi(2) - 1.0).sqrt();
        let along_m = (range_m * sine).min(farthest_m) * (2.0 * weyl(at, 1) - 1.0);
        let across_m = (range_m.powi(2) - along_m.powi(2) - down_m.powi(2)).sqrt();
        let phase = std::f64::consts::TAU * weyl(at, 3);
        scatterers.push(
            DVec3::new(along_m, across_m, down_m),
            [0.0; 3],
            Complex64::from_polar(1.0 + weyl(at * 7, 2), phase),
            ScatterLaw::Point,
        );
    }
    let speed = d.velocity_m_per_s.length().max(1.0);
    let decimator =
        Decimator::new(&plan.pulse, RATE_HZ, 2.1 * speed / C * CARRIER_HZ, 32).expect("fits");
    Scene {
        plan,
        tx: transmitter(DVec3::new(0.1, 0.0, 0.05)),
        rx: line(DVec3::ZERO, d.elements),
        scatterers,
        decimator,
    }
}

/// Records of all elements, and the reports of all tasks.
pub fn engine<T: Sample>(
    scene: &Scene,
    resolution: Resolution,
) -> (Vec<Vec<Complex64>>, Vec<TaskReport>) {
    engine_in::<T>(scene, resolution, SimdLevel::best(), false)
}

/// As [`engine`], at a given SIMD level, with tasks in reverse order if `backward`.
pub fn engine_in<T: Sample>(
    scene: &Scene,
    resolution: Resolution,
    simd_level: SimdLevel,
    backward: bool,
) -> (Vec<Vec<Complex64>>, Vec<TaskReport>) {
    let Scene {
        plan,
        rx,
        decimator,
        ..
    } = scene;
    let filter = Filter {
        gain: &|f| decimator.gain(f),
        half_s: decimator.half_s(),
    };
    let mut engine = LineEngine::<T>::new(rx, RATE_HZ, filter, resolution, simd_level);
    let (transmit_leg, _) = scene.transmit_leg();
    let walk = [Mutex::new(LineWorkspace::default())];
    let echoes = scene.echoes(&transmit_leg, &walk);
    engine.prepare_from(plan, echoes.earliest_s());
    let mut work = engine.work();
    let mut outputs = vec![Vec::new(); engine.tasks()];
    let mut reports = Vec::new();
    let mut tasks: Vec<_> = outputs.iter_mut().enumerate().collect();
    if backward {
        tasks.reverse();
    }
    for (task, output) in tasks {
        reports.push(engine.run(task, &echoes, &mut work, output).1);
    }
    let records = (0..rx.elements)
        .map(|e| {
            let mut record = vec![Complex64::ZERO; plan.sample_count];
            engine.assemble(|task| &outputs[task], e, &mut record);
            record
        })
        .collect();
    (records, reports)
}

/// Samples of one element by the direct sum and the receiver filter, or by the reference.
pub fn truth(scene: &Scene, element: usize, slow: bool) -> Vec<Complex64> {
    let Scene {
        plan,
        tx,
        rx,
        scatterers,
        decimator,
    } = scene;
    let mut record = vec![Complex64::ZERO; plan.sample_count];
    if slow {
        let filter = Some(decimator);
        let first_s = plan.first_sample_s;
        reference(
            plan,
            tx,
            rx,
            element,
            scatterers,
            filter,
            RATE_HZ,
            first_s,
            &mut record,
        );
        return record;
    }
    let rate_hz = decimator.dense_rate_hz();
    let first_s = decimator.dense_first_s(plan.first_sample_s);
    let mut dense = vec![Complex64::ZERO; decimator.dense_len(plan.sample_count)];
    let window = Window::of_samples(first_s, rate_hz, dense.len());
    let mut sink =
        Direct::new(plan, rate_hz, first_s, &mut dense).with_ends(Some(decimator.ends()));
    walk(plan, tx, rx, element, window, scatterers, &mut sink);
    decimator.apply(&dense, &mut record);
    record
}

/// Largest |got - want| over |want| in windows of one pulse, a quarter of a window apart. Windows below a millionth of the rms of
/// the record are compared with that level.
pub fn worst_window(got: &[Complex64], want: &[Complex64], pulse_s: f64) -> f64 {
    let length = ((pulse_s * RATE_HZ) as usize).max(32).min(want.len());
    let energy = |x: &[Complex64]| x.iter().map(|v| v.norm_sqr()).sum::<f64>();
    let floor = 1e-12 * energy(want) * length as f64 / want.len() as f64;
    let mut worst: f64 = 0.0;
    for start in (0..=want.len() - length).step_by(length / 4) {
        let span = start..start + length;
        let error: f64 = got[span.clone()]
            .iter()
            .zip(&want[span.clone()])
            .map(|(a, b)| (a - b).norm_sqr())
            .sum();
        worst = worst.max((error / energy(&want[span]).max(floor)).sqrt());
    }
    worst
}

/// True samples of three elements: the ends of the array and one between.
pub struct Truth(Vec<(usize, Vec<Complex64>)>);

impl Truth {
    /// True samples by the slow reference, or by the direct sum.
    pub fn of(scene: &Scene, slow: bool) -> Self {
        let last = scene.rx.elements - 1;
        Self(
            [0, last / 3, last]
                .map(|e| (e, truth(scene, e, slow)))
                .to_vec(),
        )
    }

    /// Largest windowed error of the engine over these elements.
    pub fn error<T: Sample>(
        &self,
        scene: &Scene,
        resolution: Resolution,
    ) -> (f64, Vec<TaskReport>) {
        let (records, reports) = engine::<T>(scene, resolution);
        let worst = self.0.iter().fold(0.0, |worst: f64, (e, want)| {
            worst.max(worst_window(
                &records[*e],
                want,
                scene.plan.pulse.duration_s,
            ))
        });
        (worst, reports)
    }
}

/// Largest windowed error over a few elements, against [`Truth`].
pub fn error<T: Sample>(
    scene: &Scene,
    resolution: Resolution,
    slow: bool,
) -> (f64, Vec<TaskReport>) {
    Truth::of(scene, slow).error::<T>(scene, resolution)
}

//! Whole pings: from scatterers to the time samples of every element.
//!
//! Timed: transmit leg, sonar equation, delays and Doppler of every element, templates for the motion of the ping, receiver filter,
//! inverse transform to time. Not timed: noise, gain, converter.
//!
//! Error: windows of a pulse length at random elements, including the first and last echoes of the ping. In each window, some
//! random samples of the timed ping are computed again by the equation of the reference on the continuous motion. The error is the
//! rms difference over the rms of the window, for the worst window and over all windows.

use std::sync::Mutex;
use std::time::Instant;

use clap::Args;
use echotank_core::arrays::ArrayGeometry;
use echotank_core::model::{DopplerModel, Synthesis};
use echotank_core::ping::PingPlan;
use echotank_core::scene::Scatterers;
use echotank_core::simd::SimdLevel;
use echotank_synthesis::array::gridded::{DopplerSpan, one_dimensional};
use echotank_synthesis::array::gridded2d::{self, Bounds, Gridded2d};
use echotank_synthesis::array::lines::{self, GriddedLines};
use echotank_synthesis::array::{Decimator, Direct};
use echotank_synthesis::comparison::spectral::Bins;
use echotank_synthesis::comparison::spectral::Spectral;
use echotank_synthesis::comparison::spectral::Spectrum;
use echotank_synthesis::echo::{
    LineEchoes, LineWorkspace, TransmitLeg, Window, Workspace, arrivals, doppler_span, insonify,
};
use echotank_synthesis::slabs::{PingElement, SlabDesign};
use glam::DVec3;
use num_complex::Complex64;
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::{Rng, SeedableRng};
use rayon::prelude::*;

use super::scene::{BANDWIDTH_HZ, DURATION_S, Geometry, SOUND_SPEED_M_PER_S, Scene, Shape};
use super::stages::Profile;
use super::transform::simd_level_named;
use crate::reference::{Probe, values};
use crate::report::{Common, Report};

/// Samples a second beyond the band: the Doppler of 10 m/s over +-60 degrees, and the filter.
const SPARE_HZ: f64 = 22e3;
const ENGINE_DENSITY: f64 = 26.0;
/// Number of windows with samples computed again.
const WINDOWS: usize = 8;
/// Number of samples in each window. Eight estimate the error of a window to a quarter.
const SAMPLES: usize = 8;
/// Number of scatterers above which fewer windows are used, because each takes seconds to sum.
const MANY: usize = 1_500_000;
/// Time limits.
#[derive(Clone, Copy)]
struct Effort {
    /// Maximum core time of a ping, seconds. Methods with slower pings are skipped.
    max_ping_s: f64,
    /// Total time after which runs end, seconds.
    runs_s: f64,
    max_scatterers: usize,
}

const FULL: Effort = Effort {
    max_ping_s: 12.0,
    runs_s: 3.0,
    max_scatterers: usize::MAX,
};

const QUICK: Effort = Effort {
    max_ping_s: 1.0,
    runs_s: 0.2,
    max_scatterers: 50_000,
};

/// Maximum predicted cost of `direct` and `spectral` per scatterer and element, seconds.
const DIRECT_S: f64 = 8e-7;
/// Maximum predicted cost of `gridded-1d` per scatterer and element, seconds.
const GRIDDED_S: f64 = 1.5e-8;
/// Maximum number of runs of each method.
const RUNS: usize = 9;
/// Scatterers of one square are stored together, as in a scene's tiles.
const TILE_M: f64 = 3.0;

/// One measured ping.
#[derive(Clone, Copy)]
pub(crate) struct Ping {
    pub(crate) name: &'static str,
    pub(crate) elements: usize,
    pub(crate) scatterers: usize,
    pub(crate) sector_deg: f64,
    pub(crate) velocity_m_per_s: DVec3,
    pub(crate) tolerance: f64,
    pub(crate) pulse_s: f64,
    pub(crate) geometry: Geometry,
    pub(crate) bandwidth_hz: f64,
}

/// Pulses of multibeams, seconds.
const SHORT_S: f64 = 0.3e-3;
const FAN_S: f64 = 0.5e-3;
const STILL: DVec3 = DVec3::ZERO;
const AHEAD: DVec3 = DVec3::new(5.0, 0.0, 0.0);
/// Surge, sway and heave, metres per second.
const SEAWAY: DVec3 = DVec3::new(5.0, 0.3, 0.3);
const FAST: DVec3 = DVec3::new(10.0, 0.3, 0.3);

/// Minimum number of elements for which a line engine is designed.
const MIN_LINE: usize = 4;

impl Ping {
    /// Text that `--only` searches.
    fn label(&self) -> String {
        let v = self.velocity_m_per_s;
        format!(
            "{} {} {} {} {} {} {} {:.0e}",
            self.name,
            self.elements,
            self.scatterers,
            self.sector_deg,
            v.x,
            v.y,
            v.z,
            self.tolerance
        )
    }

    fn rate_hz(&self) -> f64 {
        self.bandwidth_hz + SPARE_HZ
    }
}

const fn ping(
    name: &'static str,
    elements: usize,
    scatterers: usize,
    sector_deg: f64,
    velocity_m_per_s: DVec3,
    tolerance: f64,
) -> Ping {
    Ping {
        name,
        elements,
        scatterers,
        sector_deg,
        velocity_m_per_s,
        tolerance,
        pulse_s: DURATION_S,
        geometry: Geometry::SideScan,
        bandwidth_hz: BANDWIDTH_HZ,
    }
}

/// A wide fan with the short pulse of a multibeam.
const fn short(scatterers: usize, tolerance: f64) -> Ping {
    Ping {
        pulse_s: SHORT_S,
        ..ping("short", 256, scatterers, 60.0, SEAWAY, tolerance)
    }
}

/// A multibeam at 45 m of range.
const fn fan(scatterers: usize, bandwidth_hz: f64, tolerance: f64) -> Ping {
    Ping {
        pulse_s: FAN_S,
        geometry: Geometry::Fan,
        bandwidth_hz,
        ..ping("fan", 256, scatterers, 75.0, SEAWAY, tolerance)
    }
}

/// Bandwidth of a wide-band multibeam, Hz.
const WIDE_HZ: f64 = 80e3;

/// All numbers of elements and scatterers while moving, then the effect of sector, speed and tolerance, then the real-time target.
pub(crate) const PINGS: [Ping; 46] = [
    ping("paper", 5, 42_936, 15.0, STILL, 1e-3),
    ping("paper", 5, 42_936, 15.0, SEAWAY, 1e-3),
    ping("paper", 5, 42_936, 15.0, FAST, 1e-3),
    ping("paper", 5, 42_936, 60.0, SEAWAY, 1e-3),
    ping("grid", 1, 42_936, 15.0, SEAWAY, 1e-3),
    ping("grid", 32, 42_936, 15.0, SEAWAY, 1e-3),
    ping("grid", 128, 42_936, 15.0, SEAWAY, 1e-3),
    ping("grid", 256, 42_936, 15.0, SEAWAY, 1e-3),
    ping("grid", 256, 100_000, 15.0, SEAWAY, 1e-3),
    ping("grid", 1, 1_000_000, 15.0, SEAWAY, 1e-3),
    ping("grid", 5, 1_000_000, 15.0, SEAWAY, 1e-3),
    ping("grid", 32, 1_000_000, 15.0, SEAWAY, 1e-3),
    ping("grid", 128, 1_000_000, 15.0, SEAWAY, 1e-3),
    ping("grid", 256, 1_000_000, 15.0, SEAWAY, 1e-3),
    ping("grid", 1, 6_000_000, 15.0, SEAWAY, 1e-3),
    ping("grid", 5, 6_000_000, 15.0, SEAWAY, 1e-3),
    ping("grid", 32, 6_000_000, 15.0, SEAWAY, 1e-3),
    ping("grid", 128, 6_000_000, 15.0, SEAWAY, 1e-3),
    ping("grid", 256, 6_000_000, 15.0, SEAWAY, 1e-3),
    ping("line", 256, 1_000_000, 15.0, STILL, 1e-3),
    ping("line", 256, 1_000_000, 15.0, AHEAD, 1e-3),
    ping("line", 256, 1_000_000, 15.0, FAST, 1e-3),
    ping("line", 256, 1_000_000, 60.0, STILL, 1e-3),
    ping("line", 256, 1_000_000, 60.0, SEAWAY, 1e-3),
    ping("line", 256, 1_000_000, 60.0, FAST, 1e-3),
    ping("line", 256, 1_000_000, 15.0, SEAWAY, 2e-2),
    ping("line", 256, 1_000_000, 15.0, SEAWAY, 1e-4),
    ping("line", 256, 1_000_000, 15.0, SEAWAY, 2e-5),
    ping("goal", 256, 2_000_000, 15.0, SEAWAY, 1e-3),
    ping("goal", 128, 4_000_000, 15.0, SEAWAY, 1e-3),
    ping("goal", 256, 4_000_000, 15.0, SEAWAY, 1e-3),
    short(43_000, 1e-3),
    short(300_000, 1e-3),
    short(1_000_000, 1e-3),
    short(43_000, 1e-2),
    short(300_000, 1e-2),
    short(1_000_000, 1e-2),
    fan(20_000, BANDWIDTH_HZ, 1e-2),
    fan(43_000, BANDWIDTH_HZ, 1e-2),
    fan(20_000, BANDWIDTH_HZ, 1e-3),
    fan(43_000, BANDWIDTH_HZ, 1e-3),
    fan(100_000, BANDWIDTH_HZ, 1e-3),
    fan(300_000, BANDWIDTH_HZ, 1e-3),
    fan(43_000, WIDE_HZ, 1e-2),
    fan(125_000, WIDE_HZ, 1e-2),
    ping("long", 256, 43_000, 15.0, SEAWAY, 1e-3),
];

/// Everything prepared before the first ping.
struct Ready {
    ping: Ping,
    rate_hz: f64,
    effort: Effort,
    scene: Scene,
    array: ArrayGeometry,
    filter: Decimator,
    iq: Vec<Complex64>,
    /// Reference samples by window, computed on first use.
    truth: Vec<SampledWindow>,
}

/// Window of one element, with reference values of some of its samples.
struct SampledWindow {
    element: usize,
    window: std::ops::Range<usize>,
    samples: Vec<(usize, Complex64)>,
}

/// rms difference over the rms of the window.
struct Error {
    worst: f64,
    all: f64,
}

/// Milliseconds of several runs.
struct RunTimes {
    best_ms: f64,
    median_ms: f64,
    runs: usize,
}

/// Time of a method and the error it predicts.
type Outcome = Result<(RunTimes, String), String>;

impl Ready {
    fn new(ping: Ping, effort: Effort) -> Self {
        let mut scene = Scene::new(Shape {
            geometry: ping.geometry,
            bandwidth_hz: ping.bandwidth_hz,
            scatterers: ping.scatterers,
            speed_m_per_s: ping.velocity_m_per_s.x,
            sector_deg: ping.sector_deg,
            pulse_s: ping.pulse_s,
            taper: 0.1,
        });
        by_tiles(&mut scene.scatterers);
        let rate_hz = ping.rate_hz();
        let plan = &mut scene.plan;
        plan.sample_count = (ping.geometry.window_s() * rate_hz) as usize;
        plan.trajectory = echotank_core::frames::Trajectory::uniform(
            DVec3::ZERO,
            ping.velocity_m_per_s,
            glam::DQuat::IDENTITY,
        );
        plan.segments[0].velocity_m_per_s = ping.velocity_m_per_s;
        plan.model.doppler = match ping.velocity_m_per_s {
            DVec3::ZERO => DopplerModel::None,
            // At these speeds, `stretch` leaves an error of 1e-2 at 36 m.
            _ => DopplerModel::StretchQuadratic,
        };
        let greatest = 2.0 * ping.velocity_m_per_s.length() / SOUND_SPEED_M_PER_S;
        let doppler_hz = greatest * plan.pulse.center_frequency_hz;
        let oversample = (ENGINE_DENSITY * plan.pulse.bandwidth_hz / rate_hz).ceil() as usize;
        let filter = Decimator::new(&plan.pulse, rate_hz, doppler_hz, oversample.max(20))
            .expect("the rate holds the band and the Doppler of 10 m/s");
        Self {
            ping,
            rate_hz,
            effort,
            array: scene.array(ping.elements),
            iq: vec![Complex64::ZERO; ping.elements * scene.plan.sample_count],
            scene,
            filter,
            truth: Vec::new(),
        }
    }

    fn light(&self, plan: &PingPlan, transmit_leg: &mut TransmitLeg) {
        let window = Window::of_samples(0.0, self.rate_hz, plan.sample_count);
        let Scene {
            transmit,
            scatterers,
            ..
        } = &self.scene;
        insonify(plan, transmit, window, scatterers, transmit_leg);
    }

    fn plan(&self, takes: impl Fn(DopplerModel) -> bool) -> PingPlan {
        let mut plan = self.scene.plan.clone();
        if !takes(plan.model.doppler) {
            plan.model.doppler = DopplerModel::Stretch;
        }
        plan
    }

    /// Samples of some windows by the equation of the reference.
    fn sample_windows(&self) -> Vec<SampledWindow> {
        let Scene {
            plan,
            transmit,
            scatterers,
            ..
        } = &self.scene;
        let length = (plan.pulse.duration_s * self.rate_hz).ceil() as usize;
        let [first, last] = self
            .ping
            .geometry
            .echoes_s()
            .map(|s| (s * self.rate_hz) as usize);
        let mut draws = ChaCha8Rng::seed_from_u64(11);
        let mut below = |n: usize| (draws.next_u64() % n as u64) as usize;
        let many = scatterers.len() > MANY;
        let (windows, samples) = if many { (4, 4) } else { (WINDOWS, SAMPLES) };
        let mut looked: Vec<SampledWindow> = (0..windows)
            .map(|k| {
                let start = match k {
                    0 => first,
                    1 => last,
                    _ => first + below(last - first),
                };
                let samples = (0..samples).map(|_| (start + below(length), Complex64::ZERO));
                SampledWindow {
                    samples: samples.collect(),
                    element: below(self.ping.elements),
                    window: start..start + length,
                }
            })
            .collect();
        let of = |looked: &SampledWindow, sample: usize| Probe {
            transmit,
            array: &self.array,
            element: looked.element,
            sample,
        };
        let probes: Vec<Probe> = looked
            .iter()
            .flat_map(|l| l.samples.iter().map(move |s| of(l, s.0)))
            .collect();
        let values = values(plan, scatterers, Some(&self.filter), self.rate_hz, &probes);
        let all = looked.iter_mut().flat_map(|l| &mut l.samples);
        all.zip(values).for_each(|(sample, value)| sample.1 = value);
        looked
    }

    /// Error of the output of the last ping.
    fn error(&mut self) -> Error {
        if self.truth.is_empty() {
            self.truth = self.sample_windows();
        }
        let count = self.scene.plan.sample_count;
        let squares: Vec<f64> = self
            .truth
            .iter()
            .map(|looked| {
                let record = &self.iq[looked.element * count..][..count];
                let window = &record[looked.window.clone()];
                let size = window.iter().map(|x| x.norm_sqr()).sum::<f64>() / window.len() as f64;
                let off = looked
                    .samples
                    .iter()
                    .map(|(at, want)| (record[*at] - want).norm_sqr());
                off.sum::<f64>() / looked.samples.len() as f64 / size
            })
            .collect();
        let worst = squares.iter().copied().fold(0.0, f64::max);
        let all = squares.iter().sum::<f64>() / squares.len() as f64;
        Error {
            worst: worst.sqrt(),
            all: all.sqrt(),
        }
    }
}

/// Reorders scatterers so that those of one square are adjacent.
fn by_tiles(scatterers: &mut Scatterers) {
    let mut order: Vec<usize> = (0..scatterers.len()).collect();
    order.sort_by_key(|&i| {
        let at_m = scatterers.position_m(i) / TILE_M;
        (at_m.y.floor() as i64, at_m.x.floor() as i64)
    });
    let mut sorted = Scatterers::default();
    for i in order {
        sorted.push(
            scatterers.position_m(i),
            scatterers.normal[i],
            scatterers.strength[i],
            scatterers.law[i],
        );
    }
    *scatterers = sorted;
}

/// Times several runs after a first run that grows buffers. A long run reduces their number.
fn timed(effort: Effort, mut run: impl FnMut()) -> RunTimes {
    let started = Instant::now();
    let mut taken = Vec::new();
    for round in 0..=RUNS {
        let start = Instant::now();
        run();
        let ms = start.elapsed().as_secs_f64() * 1e3;
        if round > 0 || ms > 1e3 * effort.runs_s {
            taken.push(ms);
        }
        if started.elapsed().as_secs_f64() > effort.runs_s && !taken.is_empty() {
            break;
        }
    }
    taken.sort_by(f64::total_cmp);
    RunTimes {
        best_ms: taken[0],
        median_ms: taken[taken.len() / 2],
        runs: taken.len(),
    }
}

/// Reason why a method is skipped, or `Ok`.
fn patient(ready: &Ready, per_pair_s: f64) -> Result<(), String> {
    let took_s = (ready.ping.scatterers * ready.ping.elements) as f64 * per_pair_s;
    if took_s > ready.effort.max_ping_s {
        return Err(format!("not run: about {took_s:.0} core seconds"));
    }
    Ok(())
}

fn direct(ready: &mut Ready) -> Outcome {
    patient(ready, DIRECT_S)?;
    let plan = ready.plan(|_| true);
    let own = echotank_synthesis::array::oversample(&plan.pulse, ready.rate_hz, Synthesis::Direct);
    let greatest = 2.0 * ready.ping.velocity_m_per_s.length() / SOUND_SPEED_M_PER_S;
    let doppler_hz = greatest * plan.pulse.center_frequency_hz;
    let filter = Decimator::new(&plan.pulse, ready.rate_hz, doppler_hz, own).expect("as above");
    let took = timed_elements(ready, &plan, |this, transmit_leg, element, out| {
        let mut dense = vec![Complex64::ZERO; filter.dense_len(plan.sample_count)];
        let first_s = filter.dense_first_s(0.0);
        let mut sink = Direct::new(&plan, filter.dense_rate_hz(), first_s, &mut dense)
            .with_ends(Some(filter.ends()));
        let mut work = Workspace::new();
        arrivals(
            &plan,
            &this.array,
            element,
            transmit_leg,
            &mut work,
            &mut sink,
        );
        filter.apply(&dense, out);
    });
    Ok((took, plan.model.doppler.name().into()))
}

/// Times whole pings, element by element.
fn timed_elements(
    ready: &mut Ready,
    plan: &PingPlan,
    element: impl Fn(&Ready, &TransmitLeg, usize, &mut [Complex64]) + Sync,
) -> RunTimes {
    let mut transmit_leg = TransmitLeg::new();
    let mut iq = std::mem::take(&mut ready.iq);
    let this = &*ready;
    let took = timed(this.effort, || {
        this.light(plan, &mut transmit_leg);
        let elements = iq.par_chunks_mut(plan.sample_count).enumerate();
        elements.for_each(|(k, out)| element(this, &transmit_leg, k, out));
    });
    ready.iq = iq;
    took
}

/// The sum of the paper on its frequency grid, valid only for a sonar at rest.
fn spectral(ready: &mut Ready) -> Outcome {
    patient(ready, DIRECT_S)?;
    let plan = ready.plan(|_| true);
    if !Synthesis::Spectral.takes(plan.model.doppler) {
        return Err(format!(
            "takes no Doppler model {}",
            plan.model.doppler.name()
        ));
    }
    let tails_s = -2.0 * ready.filter.dense_first_s(0.0);
    let record_s = ready.ping.geometry.window_s() + plan.pulse.duration_s + tails_s;
    let mut spectrum = Spectrum::new(ready.rate_hz, record_s, None, Some(&ready.filter));
    spectrum.prepare(&plan);
    let took = timed_elements(ready, &plan, |this, transmit_leg, element, out| {
        let mut bins = Bins::default();
        let mut sink = Spectral::new(&plan, &spectrum, plan.first_sample_s, &mut bins);
        let mut work = Workspace::new();
        arrivals(
            &plan,
            &this.array,
            element,
            transmit_leg,
            &mut work,
            &mut sink,
        );
        sink.finish(out);
    });
    Ok((took, plan.model.doppler.name().into()))
}

fn gridded_1d(ready: &mut Ready, simd_level: SimdLevel) -> Outcome {
    patient(ready, GRIDDED_S)?;
    let plan = ready.plan(|d| Synthesis::Gridded1d.takes(d));
    let fastest = 2.0 * ready.ping.velocity_m_per_s.length()
        / (SOUND_SPEED_M_PER_S - ready.ping.velocity_m_per_s.length());
    let spec = one_dimensional::Spec {
        pulse: &plan.pulse,
        sample_rate_hz: ready.rate_hz,
        samples: plan.sample_count,
        filter: Some(&ready.filter),
        doppler: plan.model.doppler,
        span: DopplerSpan {
            least: -fastest,
            greatest: fastest,
        },
        // The curvature is that at half the minimum slant range, for a margin.
        curvature_per_s: ready.ping.velocity_m_per_s.length_squared()
            / (0.5 * ready.ping.geometry.nearest_m() * SOUND_SPEED_M_PER_S),
        tolerance: ready.ping.tolerance,
        level_range_db: 60.0,
        arrivals: ready.ping.scatterers,
        simd_level,
    };
    let sketch = SlabDesign::new(&spec, ready.ping.elements).map_err(|e| e.to_string())?;
    let threads = rayon::current_num_threads();
    let engine = sketch.build(threads);
    let walks: Vec<Mutex<Workspace>> = (0..threads).map(|_| Mutex::default()).collect();
    let mut transmit_leg = TransmitLeg::new();
    let mut scratch = Workspace::new();
    let mut iq = std::mem::take(&mut ready.iq);
    let this = &*ready;
    let took = timed(this.effort, || {
        this.light(&plan, &mut transmit_leg);
        let (least, greatest) = doppler_span(&plan, &this.array, &transmit_leg, &mut scratch);
        let span = DopplerSpan {
            least: least.max(-fastest),
            greatest: greatest.min(fastest),
        };
        let elements = iq.par_chunks_mut(plan.sample_count).enumerate();
        elements.for_each(|(element, record)| {
            let target = PingElement {
                plan: &plan,
                array: &this.array,
                element,
                transmit_leg: &transmit_leg,
                span,
            };
            let slabs = record.par_chunks_mut(engine.slab_samples()).enumerate();
            slabs.for_each(|(slab, out)| {
                let thread = rayon::current_thread_index().unwrap_or(0);
                let walk = &mut walks[thread].lock().expect("no run panics");
                engine.synthesise_slab(target, slab, walk, out);
            });
        });
    });
    ready.iq = iq;
    Ok((
        took,
        format!(
            "{}; {}",
            plan.model.doppler.name(),
            engine.error_model().why
        ),
    ))
}

fn gridded_2d(ready: &mut Ready, simd_level: SimdLevel, stages: bool) -> Outcome {
    let plan = ready.plan(|_| true);
    let velocity = ready.ping.velocity_m_per_s;
    let mut engine = Gridded2d::new(&gridded2d::Spec {
        array: &ready.array,
        pulse: &plan.pulse,
        sound_speed_m_per_s: SOUND_SPEED_M_PER_S,
        sample_rate_hz: ready.rate_hz,
        filter: Some(&ready.filter),
        model: &plan.model,
        bounds: Bounds {
            nearest_m: ready.ping.geometry.nearest_m(),
            greatest_slope: ready.ping.sector_deg.to_radians().sin(),
            along_m_per_s: velocity.x.abs(),
            across_m_per_s: velocity.with_x(0.0).length(),
            turning_rad_per_s: 0.0,
        },
        tolerance: ready.ping.tolerance,
        level_range_db: 60.0,
        samples: plan.sample_count,
        scatterers: ready.ping.scatterers,
        simd_level,
    })
    .map_err(|e| e.to_string())?;
    let work: Vec<_> = (0..rayon::current_num_threads())
        .map(|_| Mutex::new(LineWorkspace::default()))
        .collect();
    let mut transmit_leg = TransmitLeg::new();
    let mut iq = std::mem::take(&mut ready.iq);
    let this = &*ready;
    let mut profile = Profile::start();
    let took = timed(this.effort, || {
        let start = Instant::now();
        this.light(&plan, &mut transmit_leg);
        let insonified = start.elapsed();
        let echoes = LineEchoes {
            plan: &plan,
            array: &this.array,
            transmit_leg: &transmit_leg,
            work: &work,
        };
        engine.synthesise(&plan, &echoes, &mut iq);
        if stages {
            let reports = engine.reports().copied().collect();
            profile.keep(insonified, start.elapsed() - insonified, reports);
        }
    });
    if stages {
        profile.print(rayon::current_num_threads());
    }
    ready.iq = iq;
    Ok((
        took,
        format!(
            "{}; {}",
            plan.model.doppler.name(),
            engine.error_model().why
        ),
    ))
}

fn gridded_lines(ready: &mut Ready, simd_level: SimdLevel) -> Outcome {
    let plan = ready.plan(|_| true);
    let mut engine = GriddedLines::new(&lines::Spec {
        array: &ready.array,
        pulse: &plan.pulse,
        sound_speed_m_per_s: SOUND_SPEED_M_PER_S,
        sample_rate_hz: ready.rate_hz,
        filter: Some(&ready.filter),
        doppler: plan.model.doppler,
        nearest_m: ready.ping.geometry.nearest_m(),
        fastest_m_per_s: ready.ping.velocity_m_per_s.length().max(1.0),
        tolerance: ready.ping.tolerance,
        samples: plan.sample_count,
        scatterers: ready.ping.scatterers,
        min_scatterers: ready.ping.scatterers,
        simd_level,
    })
    .map_err(|e| e.to_string())?;
    let mut transmit_leg = TransmitLeg::new();
    let mut iq = std::mem::take(&mut ready.iq);
    let this = &*ready;
    let took = timed(this.effort, || {
        this.light(&plan, &mut transmit_leg);
        engine.synthesise(&plan, &transmit_leg, &mut iq);
    });
    ready.iq = iq;
    Ok((
        took,
        format!(
            "{}; {}",
            plan.model.doppler.name(),
            engine.error_model().why
        ),
    ))
}

/// What to run.
#[derive(Args)]
pub(crate) struct Selection {
    #[command(flatten)]
    pub(crate) common: Common,
    /// Only whole pings whose name, elements, scatterers, sector, velocity and tolerance contain this ("line 256 1000000 15 5 0.3").
    /// Default: all, and the other tables.
    #[arg(long)]
    pub(crate) only: Option<String>,
    /// Only this method for whole pings: direct, spectral, gridded-1d, gridded-2d, gridded-lines.
    #[arg(long)]
    method: Option<String>,
    /// SIMD level: best, portable, avx2, avx512.
    #[arg(long, value_delimiter = ',', default_value = "best")]
    simd_levels: Vec<String>,
    #[arg(long, value_delimiter = ',', default_values_t = [1, 2])]
    pub(crate) threads: Vec<usize>,
    /// Print the time of gridded-2d stage by stage.
    #[arg(long)]
    stages: bool,
}

/// Prints and records one line per ping, method, SIMD level and number of threads.
pub(crate) fn run(selection: &Selection, report: &mut Report) -> Result<(), String> {
    let effort = if selection.common.quick { QUICK } else { FULL };
    println!(
        "whole pings: 400 kHz, 30 kHz, 5 ms (\"short\": 0.3 ms), 36..150 m, 52 kHz samples; \"fan\": 0.5 ms, 11..45 m, 30 or 80 kHz; transmit leg, sonar equation, Doppler, templates, filter, samples"
    );
    println!(
        "{:<6} {:>4} {:>8} {:>4} {:>14} {:<11} {:<8} {:>3} {:>6} {:>8} {:>8} {:>9} {:>9} {:>8}",
        "ping",
        "E",
        "M",
        "deg",
        "m/s",
        "method",
        "simd_level",
        "thr",
        "asked",
        "window",
        "all",
        "median",
        "best",
        "M/s"
    );
    for ping in PINGS {
        let only = selection.only.as_deref().unwrap_or("");
        if !ping.label().contains(only) || ping.scatterers > effort.max_scatterers {
            continue;
        }
        let mut ready = Ready::new(ping, effort);
        for &threads in &selection.threads {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build();
            pool.map_err(|e| e.to_string())?
                .install(|| one(&mut ready, threads, selection, report))?;
        }
    }
    Ok(())
}

fn one(
    ready: &mut Ready,
    threads: usize,
    selection: &Selection,
    report: &mut Report,
) -> Result<(), String> {
    let ping = ready.ping;
    let wanted = |method: &str| {
        selection
            .method
            .as_deref()
            .is_none_or(|name| name == method)
    };
    for (k, name) in selection.simd_levels.iter().enumerate() {
        let simd_level = simd_level_named(name)?;
        let mut methods: Vec<(&str, Outcome, Error)> = Vec::new();
        let mut add = |name, ready: &mut Ready, outcome: Outcome| {
            methods.push((name, outcome, ready.error()));
        };
        if wanted("gridded-1d") {
            let outcome = gridded_1d(ready, simd_level);
            add("gridded-1d", ready, outcome);
        }
        if ping.elements >= MIN_LINE && wanted("gridded-lines") {
            let outcome = gridded_lines(ready, simd_level);
            add("gridded-lines", ready, outcome);
        }
        if ping.elements >= MIN_LINE && wanted("gridded-2d") {
            let outcome = gridded_2d(ready, simd_level, selection.stages);
            add("gridded-2d", ready, outcome);
        }
        // Columns that all SIMD levels share.
        if k == 0 && wanted("direct") {
            let outcome = direct(ready);
            add("direct", ready, outcome);
        }
        if k == 0 && ping.velocity_m_per_s == STILL && wanted("spectral") {
            let outcome = spectral(ready);
            add("spectral", ready, outcome);
        }
        for (method, outcome, error) in methods {
            let v = ping.velocity_m_per_s;
            let head = format!(
                "{:<6} {:>4} {:>8} {:>4} {:>14} {:<11} {:<8} {:>3} {:>6.0e}",
                ping.name,
                ping.elements,
                ping.scatterers,
                ping.sector_deg,
                format!("{} {} {}", v.x, v.y, v.z),
                method,
                name,
                threads,
                ping.tolerance
            );
            let mut kept = serde_json::json!({
                "ping": ping.name, "elements": ping.elements, "scatterers": ping.scatterers, "sector_deg": ping.sector_deg,
                "velocity_m_per_s": [v.x, v.y, v.z], "pulse_s": ping.pulse_s, "bandwidth_khz": 1e-3 * ping.bandwidth_hz, "method": method, "simd_level": name, "threads": threads,
                "tolerance": ping.tolerance,
            });
            let line = match outcome {
                Ok((took, says)) => {
                    let RunTimes {
                        best_ms,
                        median_ms,
                        runs,
                    } = took;
                    kept["error_worst_window"] = error.worst.into();
                    kept["error_all"] = error.all.into();
                    kept["ms_best"] = best_ms.into();
                    kept["ms_median"] = median_ms.into();
                    kept["runs"] = runs.into();
                    kept["says"] = says.clone().into();
                    let rate = (ping.scatterers * ping.elements) as f64 / best_ms * 1e-3;
                    format!(
                        "{head} {:>8.1e} {:>8.1e} {median_ms:>9.2} {best_ms:>9.2} {rate:>8.0}  of {runs}; {says}",
                        error.worst, error.all
                    )
                }
                Err(why) => {
                    kept["refused"] = why.clone().into();
                    format!("{head} {why}")
                }
            };
            report.row(&line, kept);
        }
    }
    Ok(())
}

//! Whole pings: from scatterers to the time samples of every element.
//!
//! Timed: transmit leg, sonar equation, delays and Doppler of every element, templates for the ping's motion, receiver filter, return to
//! time. Not timed: noise, gain, converter. Error: 64 random samples of the timed ping computed again through the reference's equation on
//! the continuous motion, over the rms of the pulse's length around each: rms, and the greatest.

use std::sync::Mutex;
use std::time::Instant;

use echotank::array::gridded::{Dialect, DopplerSpan, Gridded1d, Gridded1dWork, one_dimensional};
use echotank::array::gridded2d::{self, Bounds, Gridded2d};
use echotank::array::{Decimator, Direct};
use echotank::echo::probe::{self, echoes_at, heard, heard_ranges_m};
use echotank::echo::{
    Illuminated, LineEchoes, LineWorkspace, Window, Workspace, arrivals, doppler_span, illuminate,
};
use echotank::flow::*;
use glam::DVec3;
use num_complex::Complex64;
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::{Rng, SeedableRng};
use rayon::prelude::*;

use super::report::Report;
use super::scene::{SOUND_SPEED_M_PER_S, Scene, Shape, WINDOW_S};
use super::transform::dialect_named;

/// Holds 30 kHz and the Doppler of 10 m/s over +-60 degrees.
const RATE_HZ: f64 = 52e3;
const ENGINE_DENSITY: f64 = 26.0;
/// Samples computed again.
const PROBES: usize = 64;
/// Longer than this a method is not waited for, core seconds.
const PATIENCE_S: f64 = 12.0;
/// Of `direct`, per scatterer and element.
const DIRECT_S: f64 = 8e-7;
/// Scatterers of one square lie together, as a scene's tiles have them.
const TILE_M: f64 = 3.0;

/// What is measured.
#[derive(Clone, Copy)]
pub struct Ping {
    pub name: &'static str,
    pub elements: usize,
    pub scatterers: usize,
    pub sector_deg: f64,
    pub velocity_m_per_s: DVec3,
    pub tolerance: f64,
}

const STILL: DVec3 = DVec3::ZERO;
const AHEAD: DVec3 = DVec3::new(5.0, 0.0, 0.0);
/// Surge, sway and heave.
const SEAWAY: DVec3 = DVec3::new(5.0, 0.3, 0.3);

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
    }
}

pub const PINGS: [Ping; 18] = [
    ping("paper", 5, 42_936, 15.0, STILL, 1e-3),
    ping("paper", 5, 42_936, 15.0, SEAWAY, 1e-3),
    ping("paper", 1, 42_936, 15.0, SEAWAY, 1e-3),
    ping("dense", 5, 1_000_000, 15.0, SEAWAY, 1e-3),
    ping("line", 32, 1_000_000, 15.0, SEAWAY, 1e-3),
    ping("line", 128, 40_000, 15.0, SEAWAY, 1e-3),
    ping("line", 128, 1_000_000, 15.0, SEAWAY, 1e-3),
    ping("line", 256, 1_000_000, 15.0, STILL, 1e-3),
    ping("line", 256, 1_000_000, 15.0, AHEAD, 1e-3),
    ping("line", 256, 1_000_000, 15.0, SEAWAY, 1e-3),
    ping(
        "line",
        256,
        1_000_000,
        15.0,
        DVec3::new(10.0, 0.3, 0.3),
        1e-3,
    ),
    ping("line", 256, 1_000_000, 60.0, SEAWAY, 1e-3),
    ping("line", 256, 1_000_000, 15.0, SEAWAY, 1e-2),
    ping("line", 256, 1_000_000, 15.0, SEAWAY, 1e-4),
    ping("line", 256, 2_000_000, 15.0, SEAWAY, 1e-3),
    ping("line", 128, 4_000_000, 15.0, SEAWAY, 1e-3),
    ping("line", 256, 4_000_000, 15.0, SEAWAY, 1e-3),
    ping("line", 256, 6_000_000, 15.0, SEAWAY, 1e-3),
];

/// Everything made before the first ping.
struct Ready {
    ping: Ping,
    scene: Scene,
    array: ArrayGeometry,
    filter: Decimator,
    iq: Vec<Complex64>,
}

impl Ready {
    fn new(ping: Ping) -> Self {
        let mut scene = Scene::new(Shape {
            scatterers: ping.scatterers,
            speed_m_per_s: ping.velocity_m_per_s.x,
            sector_deg: ping.sector_deg,
            taper: 0.1,
        });
        by_tiles(&mut scene.scatterers);
        let plan = &mut scene.plan;
        plan.sample_count = (WINDOW_S * RATE_HZ) as usize;
        plan.trajectory = echotank::frames::Trajectory::uniform(
            DVec3::ZERO,
            ping.velocity_m_per_s,
            glam::DQuat::IDENTITY,
        );
        plan.segments[0].velocity_m_per_s = ping.velocity_m_per_s;
        plan.model.doppler = match ping.velocity_m_per_s {
            DVec3::ZERO => DopplerModel::None,
            // At these speeds `stretch` alone leaves 1e-2 at 36 m.
            _ => DopplerModel::StretchQuadratic,
        };
        let greatest = 2.0 * ping.velocity_m_per_s.length() / SOUND_SPEED_M_PER_S;
        let doppler_hz = greatest * plan.pulse.center_frequency_hz;
        let oversample = (ENGINE_DENSITY * plan.pulse.bandwidth_hz / RATE_HZ).ceil() as usize;
        let filter = Decimator::new(&plan.pulse, RATE_HZ, doppler_hz, oversample.max(20))
            .expect("52 kHz hold 30 kHz and the Doppler of 10 m/s");
        Self {
            ping,
            array: scene.array(ping.elements),
            iq: vec![Complex64::ZERO; ping.elements * scene.plan.sample_count],
            scene,
            filter,
        }
    }

    fn light(&self, plan: &PingPlan, lit: &mut Illuminated) {
        let window = Window::of_samples(0.0, RATE_HZ, plan.sample_count);
        let Scene {
            transmit,
            scatterers,
            ..
        } = &self.scene;
        illuminate(plan, transmit, window, scatterers, lit);
    }

    fn plan(&self, takes: impl Fn(DopplerModel) -> bool) -> PingPlan {
        let mut plan = self.scene.plan.clone();
        if !takes(plan.model.doppler) {
            plan.model.doppler = DopplerModel::Stretch;
        }
        plan
    }

    /// rms and greatest of the probes' errors.
    fn error(&self) -> (f64, f64) {
        let Scene {
            plan,
            transmit,
            scatterers,
        } = &self.scene;
        let count = plan.sample_count;
        let window = (plan.pulse.duration_s * RATE_HZ) as usize;
        // Where the windows are whole.
        let (first, last) = ((0.05 * RATE_HZ) as usize, (0.195 * RATE_HZ) as usize);
        let mut draws = ChaCha8Rng::seed_from_u64(11);
        let mut below = |n: usize| (draws.next_u64() % n as u64) as usize;
        let half_span_s = 0.5 * self.filter.dense_len(1) as f64 / self.filter.dense_rate_hz();
        let probes: Vec<(usize, probe::Instant)> = (0..PROBES)
            .map(|_| {
                let sample = first + below(last - first);
                let at = probe::Instant {
                    element: below(self.ping.elements),
                    time_s: plan.first_sample_s + sample as f64 / RATE_HZ,
                    half_span_s,
                };
                (sample, at)
            })
            .collect();
        let ranges: Vec<_> = probes
            .iter()
            .map(|(_, at)| heard_ranges_m(plan, transmit, &self.array, *at))
            .collect();
        let mut candidates = Vec::new();
        heard(plan, scatterers, &ranges, &mut candidates);
        let squares: Vec<f64> = probes
            .par_iter()
            .enumerate()
            .map(|(k, &(sample, at))| {
                let mut dense = vec![Complex64::ZERO; self.filter.dense_len(1)];
                let first_s = self.filter.dense_first_s(at.time_s);
                let mut sink = Direct::new(plan, self.filter.dense_rate_hz(), first_s, &mut dense)
                    .with_edges(Edges::Weighted);
                let indices = candidates
                    .iter()
                    .filter(|(_, mask)| mask >> k & 1 == 1)
                    .map(|(i, _)| *i as usize);
                echoes_at(
                    plan,
                    transmit,
                    &self.array,
                    at,
                    scatterers,
                    indices,
                    &mut sink,
                );
                let mut want = [Complex64::ZERO];
                self.filter.apply(&dense, &mut want);
                let record = &self.iq[at.element * count..][..count];
                let around = &record[sample - window / 2..sample + window / 2];
                let square: f64 = around.iter().map(|x| x.norm_sqr()).sum();
                (record[sample] - want[0]).norm_sqr() * around.len() as f64 / square
            })
            .collect();
        let mean = squares.iter().sum::<f64>() / squares.len() as f64;
        let greatest = squares.iter().copied().fold(0.0, f64::max);
        (mean.sqrt(), greatest.sqrt())
    }
}

/// Stores scatterers of one square together.
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

/// Milliseconds of the best of some runs: fewer where one takes long.
fn best_ms(mut run: impl FnMut()) -> f64 {
    let started = Instant::now();
    let mut best_ms = f64::INFINITY;
    for round in 0..8 {
        let start = Instant::now();
        run();
        let ms = start.elapsed().as_secs_f64() * 1e3;
        // The first one grows buffers.
        if round > 0 || ms > 1e3 {
            best_ms = best_ms.min(ms);
        }
        if started.elapsed().as_secs_f64() > 2.5 && best_ms.is_finite() {
            break;
        }
    }
    best_ms
}

fn direct(ready: &mut Ready) -> Result<(f64, String), String> {
    let pairs = (ready.ping.scatterers * ready.ping.elements) as f64;
    if pairs * DIRECT_S > PATIENCE_S {
        return Err(format!(
            "not run: about {:.0} core seconds",
            pairs * DIRECT_S
        ));
    }
    let plan = ready.plan(|_| true);
    let own = echotank::array::oversample(&plan.pulse, RATE_HZ, Synthesis::Direct);
    let greatest = 2.0 * ready.ping.velocity_m_per_s.length() / SOUND_SPEED_M_PER_S;
    let doppler_hz = greatest * plan.pulse.center_frequency_hz;
    let filter = Decimator::new(&plan.pulse, RATE_HZ, doppler_hz, own).expect("as above");
    let mut lit = Illuminated::new();
    let mut iq = std::mem::take(&mut ready.iq);
    let this = &*ready;
    let ms = best_ms(|| {
        this.light(&plan, &mut lit);
        iq.par_chunks_mut(plan.sample_count)
            .enumerate()
            .for_each(|(element, out)| {
                let mut dense = vec![Complex64::ZERO; filter.dense_len(plan.sample_count)];
                let first_s = filter.dense_first_s(0.0);
                let mut sink = Direct::new(&plan, filter.dense_rate_hz(), first_s, &mut dense);
                let mut work = Workspace::new();
                arrivals(&plan, &this.array, element, &lit, &mut work, &mut sink);
                filter.apply(&dense, out);
            });
    });
    ready.iq = iq;
    Ok((ms, plan.model.doppler.name().into()))
}

fn gridded_1d(ready: &mut Ready, dialect: Dialect) -> Result<(f64, String), String> {
    let plan = ready.plan(|d| Synthesis::Gridded1d.takes(d));
    let fastest = 2.0 * ready.ping.velocity_m_per_s.length()
        / (SOUND_SPEED_M_PER_S - ready.ping.velocity_m_per_s.length());
    let engine = Gridded1d::new(&one_dimensional::Spec {
        pulse: &plan.pulse,
        sample_rate_hz: RATE_HZ,
        samples: plan.sample_count,
        filter: Some(&ready.filter),
        doppler: plan.model.doppler,
        span: DopplerSpan {
            least: -fastest,
            greatest: fastest,
        },
        // At 18 m, half the least slant range: room to spare.
        curvature_per_s: ready.ping.velocity_m_per_s.length_squared()
            / (18.0 * SOUND_SPEED_M_PER_S),
        tolerance: ready.ping.tolerance,
        level_range_db: 60.0,
        arrivals: ready.ping.scatterers,
        dialect,
    })
    .map_err(|e| e.to_string())?;
    let work: Vec<Mutex<(Workspace, Gridded1dWork)>> = (0..rayon::current_num_threads())
        .map(|_| Mutex::new((Workspace::new(), engine.work())))
        .collect();
    let mut lit = Illuminated::new();
    let mut scratch = Workspace::new();
    let mut iq = std::mem::take(&mut ready.iq);
    let this = &*ready;
    let ms = best_ms(|| {
        this.light(&plan, &mut lit);
        let (least, greatest) = doppler_span(&plan, &this.array, &lit, &mut scratch);
        let span = DopplerSpan {
            least: least.max(-fastest),
            greatest: greatest.min(fastest),
        };
        iq.par_chunks_mut(plan.sample_count)
            .enumerate()
            .for_each(|(element, out)| {
                let thread = rayon::current_thread_index().unwrap_or(0);
                let (walk, engine) = &mut *work[thread].lock().expect("no run panics");
                engine.start(plan.first_sample_s, span);
                arrivals(&plan, &this.array, element, &lit, walk, engine);
                engine.finish(out);
            });
    });
    ready.iq = iq;
    Ok((
        ms,
        format!("{}; {}", plan.model.doppler.name(), engine.card().why),
    ))
}

fn gridded_2d(ready: &mut Ready, dialect: Dialect) -> Result<(f64, String), String> {
    let plan = ready.plan(|_| true);
    let velocity = ready.ping.velocity_m_per_s;
    let mut engine = Gridded2d::new(&gridded2d::Spec {
        array: &ready.array,
        pulse: &plan.pulse,
        sound_speed_m_per_s: SOUND_SPEED_M_PER_S,
        sample_rate_hz: RATE_HZ,
        filter: Some(&ready.filter),
        model: &plan.model,
        bounds: Bounds {
            nearest_m: 35.0,
            greatest_slope: ready.ping.sector_deg.to_radians().sin(),
            along_m_per_s: velocity.x.abs(),
            across_m_per_s: velocity.with_x(0.0).length(),
            turning_rad_per_s: 0.0,
        },
        tolerance: ready.ping.tolerance,
        level_range_db: 60.0,
        samples: plan.sample_count,
        scatterers: ready.ping.scatterers,
        dialect,
    })
    .map_err(|e| e.to_string())?;
    let work: Vec<_> = (0..rayon::current_num_threads())
        .map(|_| Mutex::new(LineWorkspace::default()))
        .collect();
    let mut lit = Illuminated::new();
    let mut iq = std::mem::take(&mut ready.iq);
    let this = &*ready;
    let ms = best_ms(|| {
        this.light(&plan, &mut lit);
        let echoes = LineEchoes {
            plan: &plan,
            array: &this.array,
            lit: &lit,
            work: &work,
        };
        engine.synthesise(&plan, &echoes, &mut iq);
    });
    ready.iq = iq;
    Ok((
        ms,
        format!("{}; {}", plan.model.doppler.name(), engine.card().why),
    ))
}

/// What to run: dialects by name, numbers of threads, a part of a ping's name and size.
pub struct Selection<'a> {
    pub only: &'a str,
    pub dialects: &'a [String],
    pub threads: &'a [usize],
    pub most_scatterers: usize,
}

/// Prints and keeps one line per ping, method, dialect and number of threads.
pub fn run(selection: &Selection, report: &mut Report) -> Result<(), String> {
    println!(
        "whole pings: 400 kHz, 30 kHz, 5 ms, 36..150 m, {:.0} kHz samples; transmit leg, sonar equation, Doppler, templates, filter, samples",
        RATE_HZ * 1e-3
    );
    println!(
        "{:<6} {:>4} {:>8} {:>4} {:>14} {:<11} {:<8} {:>3} {:>6} {:>8} {:>8} {:>9} {:>8}",
        "ping",
        "E",
        "M",
        "deg",
        "m/s",
        "method",
        "dialect",
        "thr",
        "asked",
        "rms",
        "greatest",
        "ms",
        "M/s"
    );
    for ping in PINGS {
        let label = format!("{} {} {}", ping.name, ping.elements, ping.scatterers);
        if !label.contains(selection.only) || ping.scatterers > selection.most_scatterers {
            continue;
        }
        let mut ready = Ready::new(ping);
        for &threads in selection.threads {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build();
            pool.map_err(|e| e.to_string())?
                .install(|| one(&mut ready, threads, selection.dialects, report))?;
        }
    }
    Ok(())
}

fn one(
    ready: &mut Ready,
    threads: usize,
    dialects: &[String],
    report: &mut Report,
) -> Result<(), String> {
    let ping = ready.ping;
    for (k, name) in dialects.iter().enumerate() {
        let dialect = dialect_named(name)?;
        let mut methods = vec![("gridded-1d", gridded_1d(ready, dialect))];
        let mut errors = vec![ready.error()];
        if ping.elements >= 8 {
            methods.push(("gridded-2d", gridded_2d(ready, dialect)));
            errors.push(ready.error());
        }
        if k == 0 {
            methods.push(("direct", direct(ready)));
            errors.push(ready.error());
        }
        for ((method, outcome), (rms, greatest)) in methods.into_iter().zip(errors) {
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
                "velocity_m_per_s": [v.x, v.y, v.z], "method": method, "dialect": name, "threads": threads,
                "tolerance": ping.tolerance,
            });
            let line = match outcome {
                Ok((ms, says)) => {
                    kept["error_rms"] = rms.into();
                    kept["error_greatest"] = greatest.into();
                    kept["ms_per_ping"] = ms.into();
                    let rate = (ping.scatterers * ping.elements) as f64 / ms * 1e-3;
                    format!("{head} {rms:>8.1e} {greatest:>8.1e} {ms:>9.2} {rate:>8.0}  {says}")
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

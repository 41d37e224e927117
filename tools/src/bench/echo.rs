//! Synthesis methods on one scene's arrivals: error and run time, one line each. See `whole` for whole pings.
//!
//! Timed: from the arrivals of all elements to samples behind the receiver filter, one thread, fastest of several runs. Not timed:
//! computing the arrivals, noise, gain, converter. Error: one element, the first 2000 scatterers, largest error in a window of a pulse
//! length, against the direct sum with 256 points per bandwidth.

use std::sync::Arc;
use std::time::Instant;

use echotank_core::model::DopplerModel;
use echotank_core::ping::PingPlan;
use echotank_fft::{Fft, Planned};
use echotank_synthesis::array::gridded::pulse_spectrum::PulseSpectrum;
use echotank_synthesis::array::gridded::transform::grid_size;
use echotank_synthesis::array::gridded::{
    DopplerSpan, Gridded1d, Gridded1dWork, GriddedError, SimdLevel, one_dimensional,
};
use echotank_synthesis::array::{Decimator, Direct};
use echotank_synthesis::arrivals::{ArrivalChunk, ArrivalSink};
use num_complex::Complex64;

use super::report::Report;
use super::scene::{BANDWIDTH_HZ, DURATION_S, SAMPLE_RATE_HZ, SOUND_SPEED_M_PER_S, Scene, Shape};

const ELEMENTS: usize = 5;
const ERROR_SCATTERERS: usize = 2000;
const TRUTH_DENSITY: f64 = 256.0;
const DIRECT_DENSITY: f64 = 8.0;
/// Doppler allowance of the receiver filter and the engine: platform speed, m/s.
const FASTEST_M_PER_S: f64 = 5.0;

/// Synthesises the samples of one element from its arrivals.
trait Method {
    fn name(&self) -> String;
    fn element(&mut self, chunks: &[ArrivalChunk], out: &mut [Complex64]);
    /// Error that the method predicts.
    fn says(&self) -> String {
        String::new()
    }
}

fn filter(plan: &PingPlan, density: f64) -> Decimator {
    let doppler_hz =
        2.0 * FASTEST_M_PER_S / SOUND_SPEED_M_PER_S * plan.pulse.center_frequency_hz * 0.3;
    let oversample = (density * BANDWIDTH_HZ / SAMPLE_RATE_HZ).ceil() as usize;
    Decimator::new(&plan.pulse, SAMPLE_RATE_HZ, doppler_hz, oversample)
        .expect("40 kHz hold 30 kHz and 800 Hz of Doppler")
}

struct DirectSum<'a> {
    plan: &'a PingPlan,
    filter: Decimator,
    dense: Vec<Complex64>,
}

impl<'a> DirectSum<'a> {
    fn new(plan: &'a PingPlan, density: f64) -> Self {
        let filter = filter(plan, density);
        Self {
            plan,
            dense: vec![Complex64::ZERO; filter.dense_len(plan.sample_count)],
            filter,
        }
    }
}

impl Method for DirectSum<'_> {
    fn name(&self) -> String {
        "direct".into()
    }
    fn element(&mut self, chunks: &[ArrivalChunk], out: &mut [Complex64]) {
        self.dense.fill(Complex64::ZERO);
        let first_s = self.filter.dense_first_s(self.plan.first_sample_s);
        let rate_hz = self.filter.dense_rate_hz();
        let mut sink = Direct::new(self.plan, rate_hz, first_s, &mut self.dense);
        chunks.iter().for_each(|chunk| sink.accept(chunk));
        self.filter.apply(&self.dense, out);
    }
}

struct Gridded {
    tolerance: f64,
    engine: Gridded1d,
    work: Gridded1dWork,
    span: DopplerSpan,
    doppler: DopplerModel,
}

impl Gridded {
    fn new(
        plan: &PingPlan,
        tolerance: f64,
        span: DopplerSpan,
        doppler: DopplerModel,
        arrivals: usize,
    ) -> Result<Self, GriddedError> {
        let fastest = 2.0 * FASTEST_M_PER_S / SOUND_SPEED_M_PER_S;
        // Denser filters differ by about 1e-8; a smaller error requires the reference's own filter.
        let density = if tolerance < 1e-6 {
            TRUTH_DENSITY
        } else {
            32.0
        };
        let filter = filter(plan, density);
        let engine = Gridded1d::new(&one_dimensional::Spec {
            pulse: &plan.pulse,
            sample_rate_hz: SAMPLE_RATE_HZ,
            samples: plan.sample_count,
            filter: Some(&filter),
            doppler,
            span: DopplerSpan {
                least: -fastest,
                greatest: fastest,
            },
            // A platform of that speed at 36 m range: 25/(36 1500).
            curvature_per_s: 5e-4,
            tolerance,
            level_range_db: 55.0,
            arrivals,
            simd_level: SimdLevel::best(),
        })?;
        Ok(Self {
            tolerance,
            work: engine.work(),
            engine,
            span,
            doppler,
        })
    }
}

impl Method for Gridded {
    fn name(&self) -> String {
        let doppler = match self.doppler {
            DopplerModel::None => " no Doppler",
            _ => "",
        };
        format!("gridded-1d {:.0e}{doppler}", self.tolerance)
    }
    fn element(&mut self, chunks: &[ArrivalChunk], out: &mut [Complex64]) {
        self.work.start(0.0, self.span);
        chunks.iter().for_each(|chunk| self.work.accept(chunk));
        self.work.finish(out);
    }
    fn says(&self) -> String {
        self.engine.error_model().why.clone()
    }
}

/// Common practice of simulators: every echo is placed at the nearest sample or split between two, with its carrier phase. One transmitted
/// pulse for all echoes, no Doppler.
struct Samples {
    linear: bool,
    carrier_hz: f64,
    grid: Vec<Complex64>,
    template: Vec<Complex64>,
    forward: Arc<dyn Fft<f64>>,
    inverse: Arc<dyn Fft<f64>>,
    scratch: Vec<Complex64>,
    lead: f64,
}

impl Samples {
    fn new(plan: &PingPlan, linear: bool) -> Self {
        let filter = filter(plan, 32.0);
        let spectrum = PulseSpectrum::new(&plan.pulse, SAMPLE_RATE_HZ);
        let lead = (2.0 * DURATION_S * SAMPLE_RATE_HZ).ceil();
        let len = grid_size(plan.sample_count + 2 * lead as usize);
        let template = (0..len)
            .map(|k| {
                let bin = if k < len / 2 {
                    k as f64
                } else {
                    k as f64 - len as f64
                };
                let f_hz = bin * SAMPLE_RATE_HZ / len as f64;
                spectrum.at(f_hz) * filter.gain(f_hz) * (SAMPLE_RATE_HZ / len as f64)
            })
            .collect();
        let (forward, inverse) = (f64::plan_forward(len), f64::plan_inverse(len));
        let scratch = forward
            .get_inplace_scratch_len()
            .max(inverse.get_inplace_scratch_len());
        Self {
            linear,
            carrier_hz: plan.pulse.center_frequency_hz,
            grid: vec![Complex64::ZERO; len],
            template,
            forward,
            inverse,
            scratch: vec![Complex64::ZERO; scratch],
            lead,
        }
    }
}

impl Method for Samples {
    fn name(&self) -> String {
        if self.linear { "linear" } else { "nearest" }.into()
    }
    fn element(&mut self, chunks: &[ArrivalChunk], out: &mut [Complex64]) {
        self.grid.fill(Complex64::ZERO);
        for chunk in chunks {
            for i in 0..chunk.len {
                let turns = self.carrier_hz * chunk.delay_s[i];
                let phase = -std::f64::consts::TAU * (turns - turns.round());
                let c = chunk.amplitude[i] * Complex64::from_polar(1.0, phase);
                let middle_s = chunk.delay_s[i] + 0.5 * DURATION_S;
                let position = middle_s * SAMPLE_RATE_HZ + self.lead;
                if self.linear {
                    let place = position.floor();
                    let share = position - place;
                    self.grid[place as usize] += c * (1.0 - share);
                    self.grid[place as usize + 1] += c * share;
                } else {
                    self.grid[position.round() as usize] += c;
                }
            }
        }
        self.forward
            .process_with_scratch(&mut self.grid, &mut self.scratch);
        self.grid
            .iter_mut()
            .zip(&self.template)
            .for_each(|(a, b)| *a *= b);
        self.inverse
            .process_with_scratch(&mut self.grid, &mut self.scratch);
        let lead = self.lead as usize;
        out.copy_from_slice(&self.grid[lead..lead + out.len()]);
    }
}

/// Largest relative error over windows of a pulse length that contain whole echoes.
fn windowed(got: &[Complex64], want: &[Complex64]) -> f64 {
    let length = (DURATION_S * SAMPLE_RATE_HZ) as usize;
    let (first, last) = (0.05, 0.195);
    let range = (first * SAMPLE_RATE_HZ) as usize..(last * SAMPLE_RATE_HZ) as usize;
    range
        .map(|at| {
            let window = at..at + length;
            let pairs = got[window.clone()].iter().zip(&want[window.clone()]);
            let off: f64 = pairs.map(|(g, w)| (g - w).norm_sqr()).sum();
            (off / want[window].iter().map(|w| w.norm_sqr()).sum::<f64>()).sqrt()
        })
        .fold(0.0, f64::max)
}

fn doppler_span(chunks: &[Vec<ArrivalChunk>]) -> DopplerSpan {
    let all = chunks.iter().flatten().flat_map(|c| &c.doppler[..c.len]);
    let (least, greatest) = all.fold((0.0f64, 0.0f64), |(a, b), &d| (a.min(d), b.max(d)));
    DopplerSpan { least, greatest }
}

/// Prints and records one line per scene and method.
pub(crate) fn run(quick: bool, report: &mut Report) {
    println!(
        "sums alone: {ELEMENTS} elements, 400 kHz, 30 kHz, 5 ms, 36..150 m, one thread; without the walk over the scatterers and the receiver"
    );
    println!(
        "{:>9} {:>5}  {:<28} {:>9} {:>10} {:>10} {:>9}",
        "M", "m/s", "method", "error", "median ms", "best", "M/s"
    );
    let sizes: &[usize] = if quick {
        &[42_936]
    } else {
        &[42_936, 1_000_000]
    };
    for &scatterers in sizes {
        for speed_m_per_s in [0.0, FASTEST_M_PER_S] {
            scene(scatterers, speed_m_per_s, quick, report);
        }
    }
}

fn scene(scatterers: usize, speed_m_per_s: f64, quick: bool, report: &mut Report) {
    let shape = Shape {
        scatterers,
        speed_m_per_s,
        sector_deg: 15.0,
        taper: 0.1,
    };
    let scene = Scene::new(shape);
    let plan = &scene.plan;
    let chunks = scene.chunks(ELEMENTS);
    let few = Scene::new(Shape {
        scatterers: ERROR_SCATTERERS,
        ..shape
    })
    .chunks(1);
    let mut want = vec![Complex64::ZERO; plan.sample_count];
    DirectSum::new(plan, TRUTH_DENSITY).element(&few[0], &mut want);

    let span = doppler_span(&chunks);
    let gridded = |tolerance, doppler| Gridded::new(plan, tolerance, span, doppler, scatterers);
    let mut methods: Vec<Box<dyn Method>> = vec![
        Box::new(DirectSum::new(plan, DIRECT_DENSITY)),
        Box::new(Samples::new(plan, false)),
        Box::new(Samples::new(plan, true)),
    ];
    let tolerances = [1e-1, 1e-2, 1e-3, 1e-4, 1e-5, 1e-6, 1e-8];
    for (tolerance, doppler) in std::iter::once((1e-3, DopplerModel::None))
        .chain(tolerances.map(|tolerance| (tolerance, DopplerModel::Stretch)))
    {
        match gridded(tolerance, doppler) {
            Ok(method) => methods.push(Box::new(method)),
            Err(refused) => println!("{scatterers:>9} {speed_m_per_s:>5}  {doppler:?}: {refused}"),
        }
    }
    for method in &mut methods {
        let mut out = vec![Complex64::ZERO; plan.sample_count];
        method.element(&few[0], &mut out);
        let error = windowed(&out, &want);
        let slow = method.name() == "direct";
        let runs = match (slow, quick) {
            (true, _) => 1,
            (false, true) => 5,
            (false, false) => 10,
        };
        let mut took_ms: Vec<f64> = (0..runs)
            .map(|_| {
                let start = Instant::now();
                for chunks in &chunks {
                    method.element(chunks, &mut out);
                }
                start.elapsed().as_secs_f64() * 1e3
            })
            .collect();
        took_ms.sort_by(f64::total_cmp);
        let (best_ms, median_ms) = (took_ms[0], took_ms[runs / 2]);
        let per_s = (scatterers * ELEMENTS) as f64 / best_ms * 1e-3;
        let line = format!(
            "{scatterers:>9} {speed_m_per_s:>5}  {:<28} {error:>9.1e} {median_ms:>10.2} {best_ms:>10.2} {per_s:>9.1}  {}",
            method.name(),
            method.says()
        );
        let kept = serde_json::json!({
            "scatterers": scatterers, "elements": ELEMENTS, "speed_m_per_s": speed_m_per_s, "method": method.name(),
            "error": error, "ms_best": best_ms, "ms_median": median_ms, "runs": runs,
        });
        report.row(&line, kept);
    }
}

//! One-dimensional transform of given points. `dump` writes the points, and `serve` runs on request, so peers in another process
//! are timed alternately with the same data.

use std::io::{BufRead, Write};
use std::path::Path;
use std::time::Instant;

use echotank_core::simd::{Kind, SimdLevel};
use echotank_synthesis::array::gridded::moments::Real;
use echotank_synthesis::array::gridded::transform::Transform1d;
use num_complex::{Complex, Complex64};

use super::scene::{BANDWIDTH_HZ, BINS, CARRIER_HZ, DURATION_S, Geometry, PERIOD_S, Scene, Shape};

/// Delays, carrier-rotated amplitudes and the direct sum over the band, in f64.
struct Points {
    delay_s: Vec<f64>,
    amplitude: Vec<Complex64>,
}

impl Points {
    /// Arrivals at one element of a line over the scene, in random order.
    fn new(scatterers: usize, elements: usize, element: usize) -> Self {
        let scene = Scene::new(Shape {
            geometry: Geometry::SideScan,
            bandwidth_hz: BANDWIDTH_HZ,
            scatterers,
            speed_m_per_s: 5.0,
            sector_deg: 15.0,
            pulse_s: DURATION_S,
            taper: 0.0,
        });
        let mut points = Self {
            delay_s: Vec::new(),
            amplitude: Vec::new(),
        };
        for chunk in &scene.chunks_at(elements, element) {
            for i in 0..chunk.len {
                let turns = CARRIER_HZ * chunk.delay_s[i];
                let carrier =
                    Complex64::from_polar(1.0, -std::f64::consts::TAU * (turns - turns.round()));
                points.delay_s.push(chunk.delay_s[i]);
                points.amplitude.push(chunk.amplitude[i] * carrier);
            }
        }
        points
    }

    /// Direct sum with a phasor recurrence over the bins, restarted every 64 bins; error below 1e-14.
    fn direct(&self) -> Vec<Complex64> {
        const RESTART: usize = 64;
        const LANES: usize = 8;
        let mut out = vec![Complex64::ZERO; BINS];
        let blocks = out.len() / RESTART;
        let mut starts = vec![[Complex64::ZERO; LANES]; blocks];
        for (u, c) in self.delay_s.iter().zip(&self.amplitude) {
            let phasor = |k: f64| {
                let turns = k * u / PERIOD_S;
                Complex64::from_polar(1.0, -std::f64::consts::TAU * (turns - turns.round()))
            };
            // A recurrence over the starts of all blocks would lose digits. Every 16th block starts with sine and cosine, the
            // others with one product.
            let (fine, step): (Vec<_>, _) = (
                (0..16).map(|b| phasor((b * RESTART) as f64)).collect(),
                phasor(LANES as f64),
            );
            let lanes: [Complex64; LANES] = std::array::from_fn(|l| phasor(l as f64));
            for (b, start) in starts.iter_mut().enumerate() {
                if b % 16 == 0 {
                    let first = phasor((b * RESTART) as f64 - (BINS / 2) as f64) * c;
                    *start = lanes.map(|l| l * first);
                } else {
                    *start = [Complex64::ZERO; LANES];
                }
            }
            for b in 0..blocks {
                let from = starts[b - b % 16];
                let mut now = from.map(|z| z * fine[b % 16]);
                for values in out[b * RESTART..(b + 1) * RESTART].chunks_exact_mut(LANES) {
                    for (value, z) in values.iter_mut().zip(&mut now) {
                        *value += *z;
                        *z *= step;
                    }
                }
            }
        }
        out
    }
}

fn write(path: &Path, values: impl IntoIterator<Item = f64>) -> Result<(), String> {
    let bytes: Vec<u8> = values.into_iter().flat_map(f64::to_le_bytes).collect();
    std::fs::write(path, bytes).map_err(|e| format!("{}: {e}", path.display()))
}

/// Writes `delay_s.f64`, `amplitude.c128` and `direct.c128` into `directory`, raw little-endian.
pub(crate) fn dump(
    directory: &Path,
    scatterers: usize,
    elements: usize,
    element: usize,
) -> Result<(), String> {
    if element >= elements {
        return Err(format!(
            "element {element} of {elements}: they are counted from 0"
        ));
    }
    std::fs::create_dir_all(directory).map_err(|e| format!("{}: {e}", directory.display()))?;
    let points = Points::new(scatterers, elements, element);
    let flat = |v: &[Complex64]| v.iter().flat_map(|c| [c.re, c.im]).collect::<Vec<_>>();
    write(
        &directory.join("delay_s.f64"),
        points.delay_s.iter().copied(),
    )?;
    write(&directory.join("amplitude.c128"), flat(&points.amplitude))?;
    write(&directory.join("direct.c128"), flat(&points.direct()))?;
    println!(
        "{{\"points\":{},\"bins\":{BINS},\"period_s\":{PERIOD_S}}}",
        points.delay_s.len()
    );
    Ok(())
}

fn read(path: &Path) -> Result<Vec<f64>, String> {
    let bytes = std::fs::read(path).map_err(|e| format!("{}: {e}", path.display()))?;
    Ok(bytes
        .as_chunks::<8>()
        .0
        .iter()
        .map(|b| f64::from_le_bytes(*b))
        .collect())
}

fn complex(values: &[f64]) -> Vec<Complex64> {
    let pair = |p: &[f64; 2]| Complex64::new(p[0], p[1]);
    values.as_chunks::<2>().0.iter().map(pair).collect()
}

trait Runner {
    /// Milliseconds of one transform.
    fn run(&mut self) -> f64;
    /// Error of the last transform against the direct sum.
    fn error(&self, want: &[Complex64]) -> f64;
}

struct Prepared<T: Real> {
    plan: Transform1d<T>,
    work: echotank_synthesis::array::gridded::transform::Workspace<T>,
    delay_s: std::rc::Rc<Vec<f64>>,
    amplitude: Vec<Complex<T>>,
    out: Vec<Complex<T>>,
}

impl<T: Real + Into<f64>> Prepared<T> {
    fn new(
        delay_s: std::rc::Rc<Vec<f64>>,
        amplitude: &[Complex64],
        width: usize,
        oversampling: f64,
        simd_level: SimdLevel,
    ) -> Self {
        let plan = Transform1d::<T>::new(BINS, PERIOD_S, width, oversampling, simd_level);
        let narrow = |c: &Complex64| Complex::new(T::narrow(c.re), T::narrow(c.im));
        Self {
            work: plan.workspace(),
            out: vec![narrow(&Complex64::ZERO); BINS],
            amplitude: amplitude.iter().map(narrow).collect(),
            plan,
            delay_s,
        }
    }
}

impl<T: Real + Into<f64>> Runner for Prepared<T> {
    fn run(&mut self) -> f64 {
        let start = Instant::now();
        self.plan.execute(
            &mut self.work,
            &self.delay_s,
            &self.amplitude,
            &mut self.out,
        );
        start.elapsed().as_secs_f64() * 1e3
    }

    fn error(&self, want: &[Complex64]) -> f64 {
        let (mut off, mut all) = (0.0, 0.0);
        for (g, w) in self.out.iter().zip(want) {
            off += (Complex64::new(g.re.into(), g.im.into()) - w).norm_sqr();
            all += w.norm_sqr();
        }
        (off / all).sqrt()
    }
}

/// Reads `f32|f64 WIDTH OVERSAMPLING SIMD_LEVEL` per input line and prints `MILLISECONDS ERROR` of one transform. The SIMD level is
/// portable, avx2, avx512 or best.
pub(crate) fn serve(directory: &Path) -> Result<(), String> {
    let delay_s = std::rc::Rc::new(read(&directory.join("delay_s.f64"))?);
    let amplitude = complex(&read(&directory.join("amplitude.c128"))?);
    let want = complex(&read(&directory.join("direct.c128"))?);
    let mut plans: Vec<(String, Box<dyn Runner>)> = Vec::new();
    for line in std::io::stdin().lock().lines() {
        let line = line.map_err(|e| e.to_string())?;
        let place = match plans.iter().position(|(name, _)| *name == line) {
            Some(place) => place,
            None => {
                let runner = prepare(&line, &delay_s, &amplitude)?;
                plans.push((line.clone(), runner));
                plans.len() - 1
            }
        };
        let runner = &mut plans[place].1;
        let ms = runner.run();
        println!("{ms:.6} {:.6e}", runner.error(&want));
        std::io::stdout().flush().map_err(|e| e.to_string())?;
    }
    Ok(())
}

fn prepare(
    line: &str,
    delay_s: &std::rc::Rc<Vec<f64>>,
    amplitude: &[Complex64],
) -> Result<Box<dyn Runner>, String> {
    let malformed = || format!("{line:?}: expected f32|f64 WIDTH OVERSAMPLING SIMD_LEVEL");
    let words: Vec<&str> = line.split_whitespace().collect();
    let [precision, width, oversampling, simd_level] = words[..] else {
        return Err(malformed());
    };
    let width: usize = width.parse().map_err(|_| malformed())?;
    let oversampling: f64 = oversampling.parse().map_err(|_| malformed())?;
    let simd_level = simd_level_named(simd_level)?;
    let delay_s = delay_s.clone();
    match precision {
        "f32" => Ok(Box::new(Prepared::<f32>::new(
            delay_s,
            amplitude,
            width,
            oversampling,
            simd_level,
        ))),
        "f64" => Ok(Box::new(Prepared::<f64>::new(
            delay_s,
            amplitude,
            width,
            oversampling,
            simd_level,
        ))),
        _ => Err(malformed()),
    }
}

pub(crate) fn simd_level_named(name: &str) -> Result<SimdLevel, String> {
    let kind = match name {
        "best" => return Ok(SimdLevel::best()),
        "portable" => Kind::Portable,
        "avx2" => Kind::Avx2,
        "avx512" => Kind::Avx512,
        _ => return Err(format!("{name:?}: expected best, portable, avx2 or avx512")),
    };
    SimdLevel::available()
        .find(|d| d.kind() == kind)
        .ok_or_else(|| format!("this processor has no {name}"))
}

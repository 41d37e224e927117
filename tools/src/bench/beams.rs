//! Fans of one line array: run time per ping and error against a direct delay-and-sum in f64, one line each. The module also writes
//! the data for beamforming by peers.
//!
//! Scene: 128 elements spaced half a wavelength at 400 kHz, at rest. 2000 points of equal level are in the plane of the line and
//! its boresight, 1 to 149 m away. Pulse: 24 kHz LFM, 1 ms; 8000 samples at 40 kHz; 256 beams over 120 degrees. One element
//! transmits, because peers support no other transmitter position. Timed on one thread: matched filter, steering, sums.
//!
//! The error is the rms difference at random samples of random beams, over their rms. The reference delays every element's
//! matched-filtered row by a 64-tap sinc times its carrier. The delay is for the exact focus of the sample (or its plane wave),
//! without rounding to fractions, zones or f32.
//!
//! Then the fans of two devices of tools/rates: 512 focused beams of 256 elements, with the pulse, the sample rate and the shading of
//! each, and with the halves of bottom detection.

use std::f64::consts::{PI, TAU};
use std::io::{BufRead, Write};
use std::path::Path;
use std::time::Instant;

use echotank_config::spec::{FanForm, FanSpec, Former, Shading};
use echotank_core::arrays::ArrayGeometry;
use echotank_core::ping::{BeamFrame, ElementFrame, PingPlan};
use echotank_core::pulse::{Pulse, PulseKind};
use echotank_imaging::beam::RowLimits;
use echotank_imaging::beam::fan::Fan;
use echotank_imaging::beam::matched::MatchedFilter;
use echotank_imaging::beam::weights;
use echotank_ping::threads::pool;
use glam::DVec3;
use num_complex::Complex64;

use crate::draw::Chance;
use crate::report::Report;
use echotank_testing::echo as rig;

const C: f64 = rig::C;
/// Number of samples computed again for the error.
const PROBES: usize = 3000;
/// Minimum range of a compared sample, metres. The points begin at 1 m.
const FIRST_PROBE_M: f64 = 1.5;
/// Half the length of the sinc of the reference, taps.
const REACH: i64 = 32;
const BETA: f64 = 9.0;
/// Beams that peers form.
const PEER_BEAMS: usize = 8;

/// A line, its fan and its echoes.
struct Scene {
    name: &'static str,
    rate_hz: f64,
    elements: usize,
    spacing_m: f64,
    beams: usize,
    samples: usize,
    points: usize,
    sector_rad: f64,
    pulse: Pulse,
    shading: Shading,
    bottom_detection: bool,
}

impl Scene {
    fn peers() -> Self {
        Self {
            name: "peers",
            rate_hz: 40e3,
            elements: 128,
            spacing_m: rig::line(DVec3::ZERO, 2).spacing_m,
            beams: 256,
            samples: 8000,
            points: 2000,
            sector_rad: 2.0 * PI / 3.0,
            // Tapered so that almost no energy lies outside the sampled band, where interpolation is undefined.
            pulse: Pulse {
                taper: 0.5,
                ..rig::lfm(24e3, 1e-3)
            },
            shading: Shading::Uniform,
            bottom_detection: false,
        }
    }

    /// As tools/rates/seabat.toml, out to 53 m.
    fn seabat() -> Self {
        Self {
            name: "seabat",
            rate_hz: 34e3,
            elements: 256,
            spacing_m: 0.0016,
            beams: 512,
            samples: 2400,
            points: 1000,
            sector_rad: f64::to_radians(140.0),
            pulse: Pulse {
                kind: PulseKind::Cw,
                bandwidth_hz: 0.0,
                taper: 0.1,
                ..rig::lfm(0.0, 0.3e-3)
            },
            shading: Shading::Taylor { side_lobe_db: 35.0 },
            bottom_detection: true,
        }
    }

    /// As tools/rates/wbms.toml, out to 16 m.
    fn wbms() -> Self {
        Self {
            name: "wbms",
            rate_hz: 115e3,
            spacing_m: 0.00172,
            points: 400,
            sector_rad: f64::to_radians(130.0),
            pulse: Pulse {
                taper: 0.1,
                ..rig::lfm(80e3, 0.5e-3)
            },
            ..Self::seabat()
        }
    }

    fn max_range_m(&self) -> f64 {
        0.5 * C * self.samples as f64 / self.rate_hz
    }

    fn first_probe(&self) -> usize {
        (2.0 * FIRST_PROBE_M / C * self.rate_hz) as usize
    }

    fn array(&self) -> ArrayGeometry {
        ArrayGeometry {
            spacing_m: self.spacing_m,
            radius_m: None,
            ..rig::line(DVec3::ZERO, self.elements)
        }
    }

    fn transmit_x_m(&self) -> f64 {
        self.array().along_m(self.elements / 2)
    }

    fn limits(&self) -> RowLimits {
        RowLimits {
            sample_rate_hz: self.rate_hz,
            samples: self.samples,
            pulse_s: self.pulse.duration_s,
        }
    }

    fn fan(&self, former: Former) -> FanSpec {
        FanSpec {
            array: 0,
            beams: self.beams,
            sector_rad: self.sector_rad,
            shading: self.shading,
            form: FanForm {
                former,
                bottom_detection: self.bottom_detection,
                ..FanForm::default()
            },
        }
    }

    fn angle_rad(&self, beam: usize) -> f64 {
        self.sector_rad * (beam as f64 / (self.beams - 1) as f64 - 0.5)
    }

    fn plan(&self) -> PingPlan {
        let mut plan = rig::ahead(0.0);
        plan.pulse = self.pulse;
        plan.settings.pulse_duration_s = self.pulse.duration_s;
        plan.sample_count = self.samples;
        plan
    }

    /// Element samples: the sum of the delayed pulses of all points.
    fn elements(&self) -> ElementFrame {
        let mut chance = Chance::new(5);
        let array = self.array();
        let pulse = self.pulse;
        let mut iq = vec![Complex64::ZERO; self.elements * self.samples];
        for _ in 0..self.points {
            let (range_m, angle) = (
                1.0 + (self.max_range_m() - 2.0) * chance.uniform(),
                2.4 * (chance.uniform() - 0.5),
            );
            let (x, z) = (range_m * angle.sin(), range_m * angle.cos());
            let phase = chance.uniform();
            for (e, row) in iq.chunks_exact_mut(self.samples).enumerate() {
                let path_m = (x - self.transmit_x_m()).hypot(z) + (x - array.along_m(e)).hypot(z);
                let delay_s = path_m / C;
                let cycles = phase - pulse.center_frequency_hz * delay_s;
                let carrier = Complex64::from_polar(1.0, TAU * cycles.fract());
                let first = (delay_s * self.rate_hz).ceil() as usize;
                let count = (pulse.duration_s * self.rate_hz) as usize + 2;
                for (k, x) in row.iter_mut().enumerate().skip(first).take(count) {
                    *x += carrier * pulse.envelope(k as f64 / self.rate_hz - delay_s);
                }
            }
        }
        ElementFrame {
            array: 0,
            elements: self.elements,
            samples: self.samples,
            iq,
            saturated: 0,
        }
    }

    /// Matched-filtered rows, f64.
    fn compressed(&self, frame: &ElementFrame) -> Vec<Complex64> {
        let mut filter = MatchedFilter::new(&self.pulse, self.limits(), Shading::Uniform);
        let mut rows = frame.iq.clone();
        for row in rows.chunks_exact_mut(self.samples) {
            filter.apply(row);
        }
        rows
    }

    /// Range along a beam of the point whose echo reaches the array's centre at `time_s`.
    fn range_m(&self, sine: f64, time_s: f64) -> f64 {
        let path_m = C * time_s;
        let tx = self.transmit_x_m();
        // |S - p|^2 = (path - R)^2 with |S| = R.
        (path_m * path_m - tx * tx) / (2.0 * (path_m - tx * sine))
    }

    /// One sample of one beam by the reference.
    fn written_out(
        &self,
        (rows, weights): (&[Complex64], &[f64]),
        beam: usize,
        sample: usize,
        focused: bool,
    ) -> Complex64 {
        let array = self.array();
        let sine = self.angle_rad(beam).sin();
        let time_s = sample as f64 / self.rate_hz;
        let r = self.range_m(sine, time_s);
        let (x, z) = (r * sine, r * (1.0 - sine * sine).sqrt());
        let taper = kaiser(BETA);
        let mut sum = Complex64::ZERO;
        let rows = rows.chunks_exact(self.samples);
        for (e, (row, weight)) in rows.zip(weights).enumerate() {
            let at = array.along_m(e);
            let late_s = match focused {
                true => ((x - at).hypot(z) - r) / C,
                false => -at * sine / C,
            };
            let place = sample as f64 + late_s * self.rate_hz;
            let whole = place.floor() as i64;
            let mut value = Complex64::ZERO;
            for k in whole - REACH + 1..=whole + REACH {
                let d = place - k as f64;
                if let Some(y) = usize::try_from(k).ok().and_then(|k| row.get(k)) {
                    let sinc = if d == 0.0 {
                        1.0
                    } else {
                        (PI * d).sin() / (PI * d)
                    };
                    value += y * (sinc * taper(d / REACH as f64));
                }
            }
            let cycles = rig::CARRIER_HZ * late_s;
            sum += value * Complex64::from_polar(*weight, TAU * (cycles - cycles.round()));
        }
        sum
    }

    /// Of the elements; their sum is 1.
    fn weights(&self) -> Vec<f64> {
        let mut weights = vec![0.0; self.elements];
        weights::fill(self.shading, &mut weights);
        let sum: f64 = weights.iter().sum();
        weights.iter().map(|w| w / sum).collect()
    }

    fn probes(&self, rows: &[Complex64]) -> Vec<Probe> {
        let weights = self.weights();
        let rows = (rows, &weights[..]);
        let mut chance = Chance::new(9);
        let mut draw = |n: usize| ((chance.uniform() * n as f64) as usize).min(n - 1);
        (0..PROBES)
            .map(|_| {
                let beam = draw(self.beams);
                let sample = self.first_probe() + draw(self.samples - self.first_probe() - 100);
                Probe {
                    beam,
                    sample,
                    want: [false, true].map(|f| self.written_out(rows, beam, sample, f)),
                }
            })
            .collect()
    }

    fn make(&self, former: Former) -> Fan {
        let transmit = rig::transmitter(DVec3::X * self.transmit_x_m());
        let spec = self.fan(former);
        Fan::new(
            &self.array(),
            &transmit,
            &spec,
            self.limits(),
            &self.pulse,
            Shading::Uniform,
            C,
        )
    }
}

/// Kaiser window on [-1, 1].
fn kaiser(beta: f64) -> impl Fn(f64) -> f64 {
    let i0 = |x: f64| {
        let (mut sum, mut term, mut k) = (1.0, 1.0, 1.0);
        while term > 1e-17 * sum {
            term *= 0.25 * x * x / (k * k);
            sum += term;
            k += 1.0;
        }
        sum
    };
    let middle = i0(beta);
    move |x: f64| i0(beta * (1.0 - x * x).max(0.0).sqrt()) / middle
}

/// Run times of repeated calls of `work` on this thread, milliseconds.
#[derive(Clone, Copy)]
struct RunTimes {
    wall: f64,
    /// Processor time; the wall time where the system does not report it.
    core: f64,
}

fn timed(work: impl FnOnce()) -> RunTimes {
    let on_core_ns = || -> Option<f64> {
        let text = std::fs::read_to_string("/proc/thread-self/schedstat").ok()?;
        text.split_whitespace().next()?.parse().ok()
    };
    let (start, before) = (Instant::now(), on_core_ns());
    work();
    let wall = start.elapsed().as_secs_f64() * 1e3;
    let core = before.zip(on_core_ns()).map(|(a, b)| (b - a) * 1e-6);
    RunTimes {
        wall,
        core: core.unwrap_or(wall),
    }
}

/// Minimum and median.
fn least_and_median(values: impl Iterator<Item = f64>) -> (f64, f64) {
    let mut values: Vec<f64> = values.collect();
    values.sort_by(f64::total_cmp);
    (values[0], values[values.len() / 2])
}

struct Probe {
    beam: usize,
    sample: usize,
    /// Far field, focused.
    want: [Complex64; 2],
}

fn error(probes: &[Probe], focused: bool, out: &BeamFrame) -> f64 {
    let (mut off, mut all) = (0.0, 0.0);
    for p in probes {
        let want = p.want[usize::from(focused)];
        off += (out.sample(p.beam, p.sample) - want).norm_sqr();
        all += want.norm_sqr();
    }
    f64::sqrt(off / all)
}

const FORMERS: [Former; 5] = [
    Former::Exact,
    Former::Fft,
    Former::Phase,
    Former::TimeDelay,
    Former::DynamicFocus,
];

/// Times every beamformer, then the fans of the devices.
pub(crate) fn run(quick: bool, json: Option<&Path>) -> Result<(), String> {
    let mut report = Report::new();
    time(&Scene::peers(), &FORMERS, quick, &mut report)?;
    for scene in [Scene::seabat(), Scene::wbms()] {
        time(&scene, &[Former::DynamicFocus], quick, &mut report)?;
    }
    report.finish(json)
}

fn time(scene: &Scene, formers: &[Former], quick: bool, report: &mut Report) -> Result<(), String> {
    let frame = scene.elements();
    let probes = scene.probes(&scene.compressed(&frame));
    let runs = if quick { 3 } else { 12 };
    for &former in formers {
        let (took, error) = pool(1).map_err(|e| e.to_string())?.install(|| {
            let mut fan = scene.make(former);
            let plan = scene.plan();
            let mut out = BeamFrame::default();
            let mut took: Vec<RunTimes> = (0..=runs)
                .map(|_| {
                    timed(|| {
                        fan.form(&plan, &frame, &mut out);
                    })
                })
                .collect();
            // The first run grows the buffers.
            took.remove(0);
            (took, error(&probes, former == Former::DynamicFocus, &out))
        });
        let (best, median) = least_and_median(took.iter().map(|t| t.wall));
        let (core, _) = least_and_median(took.iter().map(|t| t.core));
        // Products of elements and points, or of beams and samples, of a ping.
        let (elements, beams, samples) = (scene.elements, scene.beams, scene.samples);
        let rate = (elements * beams * samples) as f64 / core * 1e-6;
        let line = format!(
            "{} {elements} x {beams} x {samples}, {}, 1 thread: error {error:.1e}, ms best {best:.1}, median {median:.1}, on a core {core:.1}; {rate:.2} G points/s",
            scene.name,
            former.name()
        );
        report.row(
            &line,
            serde_json::json!({ "scene": scene.name, "former": former.name(), "error": error, "ms_best": best, "ms_median": median, "ms_core": core, "points_per_s": rate * 1e9 }),
        );
    }
    Ok(())
}

/// Beams whose samples peers form, spread over the sector.
fn peer_beam(i: usize) -> usize {
    i * (Scene::peers().beams - 1) / (PEER_BEAMS - 1)
}

/// Writes the data for peers: matched-filtered rows, element positions, points of some beams and their expected samples.
pub(crate) fn dump(directory: &Path) -> Result<(), String> {
    std::fs::create_dir_all(directory).map_err(|e| format!("{}: {e}", directory.display()))?;
    let scene = Scene::peers();
    let rows = scene.compressed(&scene.elements());
    let weights = scene.weights();
    let flat = |v: &[Complex64]| v.iter().flat_map(|c| [c.re, c.im]).collect::<Vec<_>>();
    let array = scene.array();
    let places: Vec<f64> = (0..scene.elements).map(|e| array.along_m(e)).collect();
    let (mut points, mut want) = (Vec::new(), Vec::new());
    for i in 0..PEER_BEAMS {
        let sine = scene.angle_rad(peer_beam(i)).sin();
        for k in 0..scene.samples {
            let r = scene.range_m(sine, (k as f64 / scene.rate_hz).max(1e-3));
            points.extend([r * sine, r * (1.0 - sine * sine).sqrt()]);
            want.push(scene.written_out((&rows, &weights), peer_beam(i), k, true));
        }
    }
    let write = |name: &str, values: &[f64]| {
        let bytes: Vec<u8> = values.iter().flat_map(|v| v.to_le_bytes()).collect();
        let path = directory.join(name);
        std::fs::write(&path, bytes).map_err(|e| format!("{}: {e}", path.display()))
    };
    write("rows.c128", &flat(&rows))?;
    write("element_x_m.f64", &places)?;
    write("point_xz_m.f64", &points)?;
    write("want.c128", &flat(&want))?;
    println!(
        "{}",
        serde_json::json!({
            "elements": scene.elements, "samples": scene.samples, "beams": scene.beams, "peer_beams": PEER_BEAMS, "rate_hz": scene.rate_hz,
            "carrier_hz": rig::CARRIER_HZ, "sound_speed_m_per_s": C, "transmitting": scene.elements / 2, "first_probe": scene.first_probe(),
        })
    );
    Ok(())
}

/// Reads the name of a beamformer per input line. Prints `WALL CORE ERROR` (milliseconds) of one ping of all beams on one thread; the error
/// is over the beams that peers form.
pub(crate) fn serve() -> Result<(), String> {
    let scene = Scene::peers();
    let frame = scene.elements();
    let rows = scene.compressed(&frame);
    let weights = scene.weights();
    let mut probes = Vec::new();
    for i in 0..PEER_BEAMS {
        for sample in (scene.first_probe()..scene.samples - 100).step_by(11) {
            let beam = peer_beam(i);
            let want = [false, true].map(|f| scene.written_out((&rows, &weights), beam, sample, f));
            probes.push(Probe { beam, sample, want });
        }
    }
    let mut made: Vec<(Former, Fan)> = Vec::new();
    let mut out = BeamFrame::default();
    pool(1).map_err(|e| e.to_string())?.install(|| {
        for line in std::io::stdin().lock().lines() {
            let line = line.map_err(|e| e.to_string())?;
            let former = FORMERS
                .into_iter()
                .find(|f| f.name() == line.trim())
                .ok_or_else(|| format!("{line:?}: unknown beamformer"))?;
            let place = match made.iter().position(|(f, _)| *f == former) {
                Some(place) => place,
                None => {
                    made.push((former, scene.make(former)));
                    made.len() - 1
                }
            };
            let RunTimes { wall, core } = timed(|| {
                made[place].1.form(&scene.plan(), &frame, &mut out);
            });
            let error = error(&probes, former == Former::DynamicFocus, &out);
            println!("{wall:.6} {core:.6} {error:.6e}");
            std::io::stdout().flush().map_err(|e| e.to_string())?;
        }
        Ok(())
    })
}

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

use std::f64::consts::{PI, TAU};
use std::io::{BufRead, Write};
use std::path::Path;
use std::time::Instant;

use echotank_config::spec::{FanForm, FanSpec, Former, Shading};
use echotank_core::arrays::ArrayGeometry;
use echotank_core::ping::{BeamFrame, ElementFrame, PingPlan};
use echotank_core::pulse::Pulse;
use echotank_imaging::beam::RowLimits;
use echotank_imaging::beam::fan::Fan;
use echotank_imaging::beam::matched::MatchedFilter;
use echotank_ping::threads::pool;
use glam::DVec3;
use num_complex::Complex64;

use crate::draw::Chance;
use crate::report::Report;
use echotank_testing::echo as rig;

const C: f64 = rig::C;
const RATE_HZ: f64 = 40e3;
const ELEMENTS: usize = 128;
const BEAMS: usize = 256;
const SAMPLES: usize = 8000;
const POINTS: usize = 2000;
const SECTOR_RAD: f64 = 2.0 * PI / 3.0;
const TRANSMITTING: usize = ELEMENTS / 2;
/// Number of samples computed again for the error.
const PROBES: usize = 3000;
/// Minimum index of a compared sample. The points begin at 1 m.
const FIRST_PROBE: usize = 80;
/// Half the length of the sinc of the reference, taps.
const REACH: i64 = 32;
const BETA: f64 = 9.0;
/// Beams that peers form.
const PEER_BEAMS: usize = 8;

/// The pulse is tapered, so that almost no energy is outside the sampled band, where interpolation is undefined.
fn pulse() -> Pulse {
    Pulse {
        taper: 0.5,
        ..rig::lfm(24e3, 1e-3)
    }
}

fn array() -> ArrayGeometry {
    rig::line(DVec3::ZERO, ELEMENTS)
}

fn transmit_x_m() -> f64 {
    array().element_x_m(TRANSMITTING)
}

fn limits() -> RowLimits {
    RowLimits {
        sample_rate_hz: RATE_HZ,
        samples: SAMPLES,
        pulse_s: 1e-3,
    }
}

fn fan(former: Former) -> FanSpec {
    FanSpec {
        array: 0,
        beams: BEAMS,
        sector_rad: SECTOR_RAD,
        shading: Shading::Uniform,
        form: FanForm {
            former,
            ..FanForm::default()
        },
    }
}

fn angle_rad(beam: usize) -> f64 {
    SECTOR_RAD * (beam as f64 / (BEAMS - 1) as f64 - 0.5)
}

fn plan() -> PingPlan {
    let mut plan = rig::ahead(0.0);
    plan.pulse = pulse();
    plan.settings.pulse_duration_s = pulse().duration_s;
    plan.sample_count = SAMPLES;
    plan
}

/// Element samples: the sum of the delayed pulses of all points.
fn elements() -> ElementFrame {
    let mut chance = Chance::new(5);
    let array = array();
    let pulse = pulse();
    let mut iq = vec![Complex64::ZERO; ELEMENTS * SAMPLES];
    for _ in 0..POINTS {
        let (range_m, angle) = (
            1.0 + 148.0 * chance.uniform(),
            2.4 * (chance.uniform() - 0.5),
        );
        let (x, z) = (range_m * angle.sin(), range_m * angle.cos());
        let phase = chance.uniform();
        for (e, row) in iq.chunks_exact_mut(SAMPLES).enumerate() {
            let path_m = (x - transmit_x_m()).hypot(z) + (x - array.element_x_m(e)).hypot(z);
            let delay_s = path_m / C;
            let cycles = phase - pulse.center_frequency_hz * delay_s;
            let carrier = Complex64::from_polar(1.0, TAU * cycles.fract());
            let first = (delay_s * RATE_HZ).ceil() as usize;
            let count = (pulse.duration_s * RATE_HZ) as usize + 2;
            for (k, x) in row.iter_mut().enumerate().skip(first).take(count) {
                *x += carrier * pulse.envelope(k as f64 / RATE_HZ - delay_s);
            }
        }
    }
    ElementFrame {
        array: 0,
        elements: ELEMENTS,
        samples: SAMPLES,
        iq,
        saturated: 0,
    }
}

/// Matched-filtered rows, f64.
fn compressed(frame: &ElementFrame) -> Vec<Complex64> {
    let mut filter = MatchedFilter::new(&pulse(), limits(), Shading::Uniform);
    let mut rows = frame.iq.clone();
    for row in rows.chunks_exact_mut(SAMPLES) {
        filter.apply(row);
    }
    rows
}

/// Range along a beam of the point whose echo reaches the centre of the array at `time_s`.
fn range_m(sine: f64, time_s: f64) -> f64 {
    let path_m = C * time_s;
    let tx = transmit_x_m();
    // |S - p|^2 = (path - R)^2 with |S| = R.
    (path_m * path_m - tx * tx) / (2.0 * (path_m - tx * sine))
}

/// One sample of one beam by the reference.
fn written_out(rows: &[Complex64], beam: usize, sample: usize, focused: bool) -> Complex64 {
    let array = array();
    let sine = angle_rad(beam).sin();
    let time_s = sample as f64 / RATE_HZ;
    let r = range_m(sine, time_s);
    let (x, z) = (r * sine, r * (1.0 - sine * sine).sqrt());
    let taper = kaiser(BETA);
    let mut sum = Complex64::ZERO;
    for (e, row) in rows.chunks_exact(SAMPLES).enumerate() {
        let at = array.element_x_m(e);
        let late_s = match focused {
            true => ((x - at).hypot(z) - r) / C,
            false => -at * sine / C,
        };
        let place = sample as f64 + late_s * RATE_HZ;
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
        sum +=
            value * Complex64::from_polar(1.0 / ELEMENTS as f64, TAU * (cycles - cycles.round()));
    }
    sum
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
struct Took {
    wall: f64,
    /// Processor time. The wall time if the system does not report processor time.
    core: f64,
}

fn timed(work: impl FnOnce()) -> Took {
    let on_core_ns = || -> Option<f64> {
        let text = std::fs::read_to_string("/proc/thread-self/schedstat").ok()?;
        text.split_whitespace().next()?.parse().ok()
    };
    let (start, before) = (Instant::now(), on_core_ns());
    work();
    let wall = start.elapsed().as_secs_f64() * 1e3;
    let core = before.zip(on_core_ns()).map(|(a, b)| (b - a) * 1e-6);
    Took {
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
    /// Reference values for the far field and for focused beams.
    want: [Complex64; 2],
}

fn probes(rows: &[Complex64]) -> Vec<Probe> {
    let mut chance = Chance::new(9);
    let mut draw = |n: usize| ((chance.uniform() * n as f64) as usize).min(n - 1);
    (0..PROBES)
        .map(|_| {
            let beam = draw(BEAMS);
            let sample = FIRST_PROBE + draw(SAMPLES - FIRST_PROBE - 100);
            Probe {
                beam,
                sample,
                want: [false, true].map(|f| written_out(rows, beam, sample, f)),
            }
        })
        .collect()
}

fn error(probes: &[Probe], focused: bool, out: &BeamFrame) -> f64 {
    let (mut off, mut all) = (0.0, 0.0);
    for p in probes {
        let want = p.want[usize::from(focused)];
        off += (out.beam(p.beam)[p.sample] - want).norm_sqr();
        all += want.norm_sqr();
    }
    f64::sqrt(off / all)
}

fn make(former: Former) -> Fan {
    let transmit = rig::transmitter(DVec3::X * transmit_x_m());
    let spec = fan(former);
    Fan::new(
        &array(),
        &transmit,
        &spec,
        limits(),
        &pulse(),
        Shading::Uniform,
        C,
    )
}

const FORMERS: [Former; 5] = [
    Former::Exact,
    Former::Fft,
    Former::Phase,
    Former::TimeDelay,
    Former::DynamicFocus,
];

/// Number of products of elements and points, or of beams and samples, in a ping.
const TERMS: f64 = (ELEMENTS * BEAMS * SAMPLES) as f64;

/// Times every beamformer.
pub(crate) fn run(quick: bool, json: Option<&Path>) -> Result<(), String> {
    let mut report = Report::new();
    let frame = elements();
    let probes = probes(&compressed(&frame));
    let runs = if quick { 3 } else { 12 };
    for former in FORMERS {
        let (took, error) = pool(1).map_err(|e| e.to_string())?.install(|| {
            let mut fan = make(former);
            let mut out = BeamFrame::default();
            let mut took: Vec<Took> = (0..=runs)
                .map(|_| timed(|| fan.form(&plan(), &frame, &mut out)))
                .collect();
            // The first run grows the buffers and is not counted.
            took.remove(0);
            (took, error(&probes, former == Former::DynamicFocus, &out))
        });
        let (best, median) = least_and_median(took.iter().map(|t| t.wall));
        let (core, _) = least_and_median(took.iter().map(|t| t.core));
        let rate = TERMS / core * 1e-6;
        let line = format!(
            "{ELEMENTS} x {BEAMS} x {SAMPLES}, {}, 1 thread: error {error:.1e}, ms best {best:.1}, median {median:.1}, on a core {core:.1}; {rate:.2} G points/s",
            former.name()
        );
        report.row(
            &line,
            serde_json::json!({ "former": former.name(), "error": error, "ms_best": best, "ms_median": median, "ms_core": core, "points_per_s": rate * 1e9 }),
        );
    }
    report.finish(json)
}

/// Index of a beam that peers form. These beams are spread over the sector.
fn peer_beam(i: usize) -> usize {
    i * (BEAMS - 1) / (PEER_BEAMS - 1)
}

/// Writes the data for peers: matched-filtered rows, element positions, points of some beams and their expected samples.
pub(crate) fn dump(directory: &Path) -> Result<(), String> {
    std::fs::create_dir_all(directory).map_err(|e| format!("{}: {e}", directory.display()))?;
    let rows = compressed(&elements());
    let flat = |v: &[Complex64]| v.iter().flat_map(|c| [c.re, c.im]).collect::<Vec<_>>();
    let array = array();
    let places: Vec<f64> = (0..ELEMENTS).map(|e| array.element_x_m(e)).collect();
    let (mut points, mut want) = (Vec::new(), Vec::new());
    for i in 0..PEER_BEAMS {
        let sine = angle_rad(peer_beam(i)).sin();
        for k in 0..SAMPLES {
            let r = range_m(sine, (k as f64 / RATE_HZ).max(1e-3));
            points.extend([r * sine, r * (1.0 - sine * sine).sqrt()]);
            want.push(written_out(&rows, peer_beam(i), k, true));
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
            "elements": ELEMENTS, "samples": SAMPLES, "beams": BEAMS, "peer_beams": PEER_BEAMS, "rate_hz": RATE_HZ,
            "carrier_hz": rig::CARRIER_HZ, "sound_speed_m_per_s": C, "transmitting": TRANSMITTING, "first_probe": FIRST_PROBE,
        })
    );
    Ok(())
}

/// Reads the name of a beamformer per input line. Prints `WALL CORE ERROR` (milliseconds) of one ping of all beams on one thread.
/// The error is over the beams that peers form.
pub(crate) fn serve() -> Result<(), String> {
    let frame = elements();
    let rows = compressed(&frame);
    let mut probes = Vec::new();
    for i in 0..PEER_BEAMS {
        for sample in (FIRST_PROBE..SAMPLES - 100).step_by(11) {
            let beam = peer_beam(i);
            let want = [false, true].map(|f| written_out(&rows, beam, sample, f));
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
                    made.push((former, make(former)));
                    made.len() - 1
                }
            };
            let Took { wall, core } = timed(|| made[place].1.form(&plan(), &frame, &mut out));
            let error = error(&probes, former == Former::DynamicFocus, &out);
            println!("{wall:.6} {core:.6} {error:.6e}");
            std::io::stdout().flush().map_err(|e| e.to_string())?;
        }
        Ok(())
    })
}

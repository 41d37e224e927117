//! The walk over the scatterers: once per ping and transmit array ([`illuminate`]), then once per element ([`arrivals`]).
//!
//! Structure of arrays throughout, in batches of [`CHUNK`] that stay in L1. Coordinates are relative to the transmit position, so that
//! world positions of any size keep the carrier phase to 1e-10 rad.
//!
//! Culling (`ModelChoice::cull_db`) is exact per scatterer-element pair: left out is what has |transmit pattern x element pattern| below
//! the floor, and what has no amplitude at all (behind a baffle, on the far side of its patch). `illuminate` already drops what the
//! transmit pattern alone puts below the floor; no element pattern exceeds 1, so that drops nothing the pair test would keep.

use std::sync::Arc;

use glam::DVec3;
use num_complex::Complex64;

use crate::flow::{
    ArrayGeometry, ArrivalChunk, ArrivalSink, CHUNK, DopplerModel, EchoCounts, LawCurve, PathModel,
    PingPlan, ScatterLaw, Scatterers, TransmitArray,
};

use super::levels::{Directivity, OneWay, amplitude_from_db};
use super::paths::{Batch, ElementTrack, Motion, Rays, Transmit, refine, solve};
use super::stretch::{Leg, about_mid_pulse, paper_eq21_delay_s};

mod line;

pub use line::{LineEchoes, LineWorkspace, line_arrivals};

/// The span of time that will be synthesised, filter margins included: first and last sample, seconds from the start of the pulse.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Window {
    pub first_s: f64,
    pub last_s: f64,
}

impl Window {
    /// Of `count` samples from `first_sample_s` on.
    pub fn of_samples(first_sample_s: f64, rate_hz: f64, count: usize) -> Self {
        Self {
            first_s: first_sample_s,
            last_s: first_sample_s + count.saturating_sub(1) as f64 / rate_hz,
        }
    }
}

/// The scatterers as the transmitter sees them, structure of arrays; what no element can hear is already gone. Kept between pings.
#[derive(Debug, Default)]
pub struct Illuminated {
    window: Option<Window>,
    pub(super) transmit: Transmit,
    /// Relative to the transmit position, metres.
    x_m: Vec<f64>,
    y_m: Vec<f64>,
    z_m: Vec<f64>,
    range_m: Vec<f64>,
    /// Source level, pattern, first leg, strength and the transmit half of the scattering law; uPa at 1 m from the scatterer.
    amplitude: Vec<Complex64>,
    /// |transmit pattern|.
    level: Vec<f64>,
    /// The receive half of the law is sqrt(max(0, bias - normal.ray)): 0 and the normal for Lambert, 1 and zero for points; or, where `curved`, the
    /// curve's value there.
    bias: Vec<f32>,
    curved: Vec<bool>,
    curve: Option<Arc<LawCurve>>,
    normal_x: Vec<f32>,
    normal_y: Vec<f32>,
    normal_z: Vec<f32>,
    /// Transmitter's speed towards the scatterer, m/s.
    closing_m_per_s: Vec<f64>,
    /// Least and greatest `range_m` of each batch of [`CHUNK`].
    pub(super) batch_range_m: Vec<(f64, f64)>,
    /// ... and of `closing_m_per_s`.
    pub(super) batch_closing_m_per_s: Vec<(f64, f64)>,
    /// Lowest and highest corner of each batch.
    batch_box_m: Vec<(DVec3, DVec3)>,
}

impl Illuminated {
    pub fn new() -> Self {
        Self::default()
    }

    pub fn len(&self) -> usize {
        self.range_m.len()
    }

    pub fn is_empty(&self) -> bool {
        self.range_m.is_empty()
    }

    fn clear(&mut self) {
        self.x_m.clear();
        self.y_m.clear();
        self.z_m.clear();
        self.range_m.clear();
        self.amplitude.clear();
        self.level.clear();
        self.bias.clear();
        self.curved.clear();
        self.normal_x.clear();
        self.normal_y.clear();
        self.normal_z.clear();
        self.closing_m_per_s.clear();
        self.batch_range_m.clear();
        self.batch_closing_m_per_s.clear();
        self.batch_box_m.clear();
    }
}

/// Scratch of one thread of [`arrivals`].
#[derive(Default)]
pub struct Workspace {
    pub(super) track: ElementTrack,
    rays: Rays,
    heard: Heard,
    chunk: ArrivalChunk,
}

impl Workspace {
    pub fn new() -> Self {
        Self::default()
    }

    /// With room for a polyline of so many segments, so that no ping allocates.
    pub fn with_room_for(segments: usize) -> Self {
        Self {
            track: ElementTrack::with_room_for(segments),
            ..Self::default()
        }
    }
}

/// A batch at one element, before anything is left out.
struct Heard {
    doppler: [f64; CHUNK],
    /// Half the second derivative of the emission time, per second.
    curvature_per_s: [f64; CHUNK],
    /// Second leg, element pattern, receive half of the law, sensitivity: volts per uPa at 1 m from the scatterer.
    gain: [f64; CHUNK],
    /// |transmit pattern x element pattern|.
    level: [f64; CHUNK],
    range_m: [f64; CHUNK],
}

impl Default for Heard {
    fn default() -> Self {
        let zero = [0.0; CHUNK];
        Self {
            doppler: zero,
            curvature_per_s: zero,
            gain: zero,
            level: zero,
            range_m: zero,
        }
    }
}

fn wavelength_m(plan: &PingPlan) -> f64 {
    plan.sound_speed_m_per_s / plan.pulse.center_frequency_hz
}

/// Least |transmit x element pattern| that is kept.
fn pattern_floor(plan: &PingPlan) -> f64 {
    plan.model.cull_db.map_or(0.0, amplitude_from_db)
}

/// The transmit leg of every scatterer. `window` is what the samples to be made will cover.
///
/// Counts each scatterer that it leaves out once, whatever the number of elements; `used` stays 0.
pub fn illuminate(
    plan: &PingPlan,
    tx: &TransmitArray,
    window: Window,
    scatterers: &Scatterers,
    lit: &mut Illuminated,
) -> EchoCounts {
    let transmit = Transmit::new(plan, tx);
    let pattern = Directivity::new(&tx.pattern, wavelength_m(plan));
    let one_way = OneWay::new(wavelength_m(plan), plan.absorption_db_per_m);
    let source = amplitude_from_db(plan.settings.source_level_db + tx.level_offset_db);
    let floor = pattern_floor(plan);
    let farthest_m = plan.sound_speed_m_per_s * window.last_s;

    lit.clear();
    lit.window = Some(window);
    lit.transmit = transmit;
    lit.curve.clone_from(&scatterers.curve);
    let curve = scatterers.curve.as_deref();
    let mut counts = EchoCounts::default();
    for i in 0..scatterers.len() {
        let ray_m = transmit.relative_m(scatterers.position_m(i));
        let range_m = ray_m.length();
        if range_m > farthest_m || range_m.is_nan() {
            counts.outside_window += 1;
            continue;
        }
        let ray = ray_m / range_m.max(f64::MIN_POSITIVE);
        let in_array = transmit.array_from_world * ray;
        let response = pattern.towards(in_array.x, in_array.y, in_array.z);
        let n = scatterers.normal[i];
        let facing = || (-(DVec3::new(n[0].into(), n[1].into(), n[2].into()).dot(ray))).max(0.0);
        let (law, bias, normal) = match scatterers.law[i] {
            ScatterLaw::Point => (1.0, 1.0, [0.0; 3]),
            ScatterLaw::Lambert => (facing().sqrt(), 0.0, n),
            ScatterLaw::LambertOneWay => (facing(), 1.0, [0.0; 3]),
            ScatterLaw::Curve => (half_of_curve(curve, facing().sqrt()), 0.0, n),
        };
        let amplitude =
            scatterers.strength[i] * (source * response * law * one_way.amplitude(range_m));
        if response.abs() < floor || amplitude == Complex64::ZERO {
            counts.culled += 1;
            continue;
        }
        counts.too_close += u64::from(range_m < one_way.wavelength_m);
        lit.x_m.push(ray_m.x);
        lit.y_m.push(ray_m.y);
        lit.z_m.push(ray_m.z);
        lit.range_m.push(range_m);
        lit.amplitude.push(amplitude);
        lit.level.push(response.abs());
        lit.bias.push(bias);
        lit.curved.push(scatterers.law[i] == ScatterLaw::Curve);
        lit.normal_x.push(normal[0]);
        lit.normal_y.push(normal[1]);
        lit.normal_z.push(normal[2]);
        lit.closing_m_per_s
            .push(transmit.motion.velocity_m_per_s.dot(ray));
    }
    lit.batch_range_m
        .extend(lit.range_m.chunks(CHUNK).map(ends));
    lit.batch_closing_m_per_s
        .extend(lit.closing_m_per_s.chunks(CHUNK).map(ends));
    let places = lit.x_m.chunks(CHUNK).zip(lit.y_m.chunks(CHUNK));
    lit.batch_box_m
        .extend(places.zip(lit.z_m.chunks(CHUNK)).map(|((x, y), z)| {
            let (x, y, z) = (ends(x), ends(y), ends(z));
            (DVec3::new(x.0, y.0, z.0), DVec3::new(x.1, y.1, z.1))
        }));
    counts
}

/// Least and greatest.
fn ends(values: &[f64]) -> (f64, f64) {
    values
        .iter()
        .fold((f64::INFINITY, f64::NEG_INFINITY), |(least, most), &x| {
            (least.min(x), most.max(x))
        })
}

/// One leg of a scatterer on a curve: nothing on the far side.
#[inline(always)]
fn half_of_curve(curve: Option<&LawCurve>, root: f64) -> f64 {
    match curve {
        Some(curve) if root > 0.0 => curve.half(root),
        _ => 0.0,
    }
}

/// Echoes of everything lit at one element, handed to `sink` in chunks of at most [`CHUNK`], in the order of the scatterers.
///
/// An echo that overlaps the window at all is kept. Counts are of scatterer-element pairs.
pub fn arrivals(
    plan: &PingPlan,
    array: &ArrayGeometry,
    element: usize,
    lit: &Illuminated,
    work: &mut Workspace,
    sink: &mut impl ArrivalSink,
) -> EchoCounts {
    let mut counts = EchoCounts::default();
    let Some(window) = lit.window else {
        return counts; // nothing was ever lit
    };
    let c = plan.sound_speed_m_per_s;
    let receive = ReceiveLeg {
        c,
        pattern: Directivity::new(&array.element_pattern, wavelength_m(plan)),
        one_way: OneWay::new(wavelength_m(plan), plan.absorption_db_per_m),
        sensitivity: amplitude_from_db(array.sensitivity_db),
    };
    let floor = pattern_floor(plan);
    let duration_s = plan.pulse.duration_s;
    let Workspace {
        track,
        rays,
        heard,
        chunk,
    } = work;
    track.lay(plan, &lit.transmit, array, element);
    // u >= (2 r_T - reach)/c: batches wholly past the window need no solving. Eq. 21 may move an echo forward, by 3 v/c of its delay at most
    // and with v below 0.1 c.
    let forward = match plan.model.doppler {
        DopplerModel::PaperEq21 => 1.5,
        _ => 1.0,
    };
    let last_s = forward * window.last_s;
    let farthest_m = 0.5 * (c * last_s + track.reach_m(last_s));
    chunk.element = element;
    chunk.len = 0;

    for (b, &(least_range_m, greatest_range_m)) in lit.batch_range_m.iter().enumerate() {
        let span = b * CHUNK..((b + 1) * CHUNK).min(lit.len());
        if least_range_m > farthest_m * (1.0 + 1e-12) {
            counts.outside_window += span.len() as u64;
            continue;
        }
        let batch = Batch {
            x_m: &lit.x_m[span.clone()],
            y_m: &lit.y_m[span.clone()],
            z_m: &lit.z_m[span.clone()],
            range_m: &lit.range_m[span.clone()],
            least_range_m,
            greatest_range_m,
        };
        let odd = solve(track, c, batch, rays);
        counts.no_root += odd.no_root;
        counts.two_roots += odd.two_roots;
        if plan.model.path == PathModel::Continuous {
            refine(plan, &lit.transmit, track, batch, rays);
        }
        weigh(&receive, lit, span.clone(), rays, heard);
        match plan.model.doppler {
            DopplerModel::None | DopplerModel::Stretch => {}
            DopplerModel::StretchQuadratic => {
                stretch_twice(plan, lit, track, batch, rays, heard);
            }
            DopplerModel::PaperEq21 => stretch_delays(c, lit, span.clone(), rays, heard),
        }

        for (i, m) in span.enumerate() {
            let delay_s = rays.delay_s[i];
            let (doppler, curvature_per_s) = (heard.doppler[i], heard.curvature_per_s[i]);
            let heard_s = window.first_s - delay_s;
            let ended = heard_s * (1.0 + doppler + curvature_per_s * heard_s.max(0.0)) > duration_s;
            if delay_s > window.last_s || ended {
                counts.outside_window += 1;
                continue;
            }
            let amplitude = lit.amplitude[m] * heard.gain[i];
            if heard.level[i] < floor || amplitude == Complex64::ZERO {
                counts.culled += 1;
                continue;
            }
            counts.used += 1;
            counts.too_close += u64::from(heard.range_m[i] < receive.one_way.wavelength_m);
            counts.beyond_track += u64::from(delay_s >= track.end_s());
            let at = chunk.len;
            chunk.delay_s[at] = delay_s;
            chunk.doppler[at] = doppler;
            chunk.curvature_per_s[at] = curvature_per_s;
            chunk.amplitude[at] = amplitude;
            chunk.len = at + 1;
            if chunk.len == CHUNK {
                sink.accept(chunk);
                chunk.len = 0;
            }
        }
    }
    if chunk.len > 0 {
        sink.accept(chunk);
        chunk.len = 0;
    }
    counts
}

/// What the second leg of a batch needs besides its rays.
struct ReceiveLeg {
    c: f64,
    pattern: Directivity,
    one_way: OneWay,
    sensitivity: f64,
}

/// Second leg of a batch: gain, pattern level and Doppler.
fn weigh(
    receive: &ReceiveLeg,
    lit: &Illuminated,
    span: std::ops::Range<usize>,
    rays: &Rays,
    heard: &mut Heard,
) {
    if lit.curved[span.clone()].contains(&true) {
        return weigh_as::<true>(receive, lit, span, rays, heard);
    }
    weigh_as::<false>(receive, lit, span, rays, heard);
}

/// `CURVED`: some of the batch lie on the curve.
fn weigh_as<const CURVED: bool>(
    receive: &ReceiveLeg,
    lit: &Illuminated,
    span: std::ops::Range<usize>,
    rays: &Rays,
    heard: &mut Heard,
) {
    #[cfg(target_arch = "x86_64")]
    if is_x86_feature_detected!("avx2") {
        // SAFETY: the processor has AVX2, asked on the line above; the function needs nothing else.
        return unsafe { weigh_avx2::<CURVED>(receive, lit, span, rays, heard) };
    }
    weigh_plain::<CURVED>(receive, lit, span, rays, heard);
}

/// The AVX2 build of [`weigh_plain`]: the same arithmetic in the same order, so the same bits.
#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2")]
fn weigh_avx2<const CURVED: bool>(
    receive: &ReceiveLeg,
    lit: &Illuminated,
    span: std::ops::Range<usize>,
    rays: &Rays,
    heard: &mut Heard,
) {
    weigh_plain::<CURVED>(receive, lit, span, rays, heard);
}

#[inline(always)]
fn weigh_plain<const CURVED: bool>(
    receive: &ReceiveLeg,
    lit: &Illuminated,
    span: std::ops::Range<usize>,
    rays: &Rays,
    heard: &mut Heard,
) {
    let n = span.len().min(CHUNK);
    let level = &lit.level[span.clone()][..n];
    let bias = &lit.bias[span.clone()][..n];
    let normal_x = &lit.normal_x[span.clone()][..n];
    let normal_y = &lit.normal_y[span.clone()][..n];
    let normal_z = &lit.normal_z[span.clone()][..n];
    let curved = &lit.curved[span.clone()][..n];
    let curve = lit.curve.as_deref();
    let closing_m_per_s = &lit.closing_m_per_s[span][..n];
    for i in 0..n {
        let (x, y, z) = (rays.x_m[i], rays.y_m[i], rays.z_m[i]);
        let range_m = (x * x + y * y + z * z).sqrt();
        let per_m = 1.0 / range_m.max(f64::MIN_POSITIVE);
        let response = receive.pattern.towards(
            rays.array_x_m[i] * per_m,
            rays.array_y_m[i] * per_m,
            rays.array_z_m[i] * per_m,
        );
        let normal_along_ray =
            (f64::from(normal_x[i]) * x + f64::from(normal_y[i]) * y + f64::from(normal_z[i]) * z)
                * per_m;
        let mut law = (f64::from(bias[i]) - normal_along_ray).max(0.0).sqrt();
        if CURVED && curved[i] {
            law = half_of_curve(curve, law);
        }
        heard.range_m[i] = range_m;
        heard.gain[i] = receive.sensitivity * response * law * receive.one_way.amplitude(range_m);
        heard.level[i] = level[i] * response.abs();
        // eta - 1 of eta = (c + v_R.e_R)/(c - v_T.e_T), without taking 1 from a number near 1.
        heard.doppler[i] = (rays.closing_m2_per_s[i] * per_m + closing_m_per_s[i])
            / (receive.c - closing_m_per_s[i]);
    }
}

/// [`DopplerModel::StretchQuadratic`]: expansions about mid-pulse in place of those about the leading edge.
fn stretch_twice(
    plan: &PingPlan,
    lit: &Illuminated,
    track: &ElementTrack,
    batch: Batch,
    rays: &mut Rays,
    heard: &mut Heard,
) {
    let half_s = 0.5 * plan.pulse.duration_s;
    for i in 0..batch.range_m.len().min(CHUNK) {
        let transmit = Leg {
            ray_m: DVec3::new(batch.x_m[i], batch.y_m[i], batch.z_m[i]),
            motion: lit.transmit.motion,
        };
        let receive = Leg {
            ray_m: DVec3::new(rays.x_m[i], rays.y_m[i], rays.z_m[i]),
            motion: track.motion_at(plan, rays.delay_s[i]),
        };
        let (delay_s, doppler) = (rays.delay_s[i], heard.doppler[i]);
        let echo = about_mid_pulse(
            plan.sound_speed_m_per_s,
            half_s,
            transmit,
            receive,
            delay_s,
            doppler,
        );
        rays.delay_s[i] = echo.delay_s;
        heard.doppler[i] = echo.doppler;
        heard.curvature_per_s[i] = echo.curvature_per_s;
    }
}

/// [`DopplerModel::PaperEq21`]: the stretch goes into the delays.
fn stretch_delays(
    c: f64,
    lit: &Illuminated,
    span: std::ops::Range<usize>,
    rays: &mut Rays,
    heard: &mut Heard,
) {
    for (i, m) in span.enumerate() {
        let a = lit.closing_m_per_s[m];
        // eta - 1 = (a + b)/(c - a)
        let b = heard.doppler[i] * (c - a) - a;
        rays.delay_s[i] = paper_eq21_delay_s(c, lit.range_m[m] / c, rays.delay_s[i], (a, b));
        heard.doppler[i] = 0.0;
    }
}

#[cfg(all(test, target_arch = "x86_64"))]
mod tests {
    use super::*;
    use crate::flow::Pattern;

    #[test]
    fn the_avx2_build_gives_the_same_bits() {
        if !is_x86_feature_detected!("avx2") {
            return;
        }
        let place = |step: f64| -> Vec<f64> {
            (0..CHUNK)
                .map(|k| (k as f64 * step).fract() - 0.5)
                .collect()
        };
        let narrow = |v: &[f64]| -> Vec<f32> { v.iter().map(|x| *x as f32).collect() };
        let (a, b, c) = (place(0.618), place(0.755), place(0.57));
        let lit = Illuminated {
            level: a.clone(),
            bias: (0..CHUNK).map(|k| (k % 2) as f32).collect(),
            curved: (0..CHUNK).map(|k| k % 4 < 2).collect(),
            curve: Some(Arc::new(LawCurve::new(|cosine| 0.1 + cosine.powi(3)))),
            normal_x: narrow(&a),
            normal_y: narrow(&b),
            normal_z: narrow(&c),
            closing_m_per_s: b.clone(),
            ..Illuminated::default()
        };
        let mut rays = Rays::default();
        for i in 0..CHUNK {
            (rays.x_m[i], rays.y_m[i], rays.z_m[i]) = (90.0 * a[i], 90.0 * b[i], 90.0 * c[i]);
            (rays.array_x_m[i], rays.array_y_m[i]) = (rays.y_m[i], rays.z_m[i]);
            rays.array_z_m[i] = rays.x_m[i];
            rays.closing_m2_per_s[i] = 100.0 * c[i];
        }
        let receive = ReceiveLeg {
            c: 1500.0,
            pattern: Directivity::new(
                &Pattern::Rectangle {
                    length_m: 0.3,
                    width_m: 0.01,
                    baffled: true,
                },
                0.00375,
            ),
            one_way: OneWay::new(0.00375, 0.096),
            sensitivity: 1e-9,
        };
        fn run<const CURVED: bool>(
            wide: bool,
            (receive, lit, rays): (&ReceiveLeg, &Illuminated, &Rays),
        ) -> [[u64; CHUNK]; 4] {
            let mut heard = Heard::default();
            if wide {
                // SAFETY: asked above.
                unsafe { weigh_avx2::<CURVED>(receive, lit, 0..CHUNK, rays, &mut heard) };
            } else {
                weigh_plain::<CURVED>(receive, lit, 0..CHUNK, rays, &mut heard);
            }
            [heard.doppler, heard.gain, heard.level, heard.range_m].map(|v| v.map(f64::to_bits))
        }
        let all = (&receive, &lit, &rays);
        let (plain, curved) = (run::<false>(false, all), run::<true>(false, all));
        assert!(run::<false>(true, all) == plain && run::<true>(true, all) == curved);
        assert!(plain[1].iter().filter(|&&g| g != 0).count() > 50);
        assert!(plain[1] != curved[1]);
    }
}

//! Walk over the scatterers, once per ping and transmit array ([`insonify`]) and then once per
//! element ([`arrivals`]).
//!
//! [`insonify`] computes the one-way amplitude, direction and range from the transmitter to every
//! scatterer. [`arrivals`] solves the two-way delay to one element. It applies pattern, scattering
//! law and loss of the second leg, and emits the echoes in chunks. Delay and Doppler follow from
//! [`paths`](super::paths) and [`stretch`](super::stretch), amplitudes from the sonar equation in
//! [`levels`](super::levels).
//!
//! All data are structures of arrays, processed in batches of [`CHUNK`] that stay in the L1 cache.
//! Coordinates are relative to the transmit position. The carrier phase therefore keeps an accuracy
//! of 1e-10 rad at any world position.
//!
//! Culling (`ModelChoice::cull_db`) is exact for each pair of scatterer and element. It removes
//! pairs whose |transmit pattern x element pattern| is below the floor. It also removes pairs with
//! zero amplitude (behind a baffle, or on the far side of a patch). `insonify` already removes
//! scatterers whose transmit pattern alone is below the floor. No element pattern exceeds 1, so the
//! pair test would remove these pairs too.

use std::ops::Range;
use std::sync::Arc;

use glam::DVec3;
use num_complex::Complex64;
use rayon::prelude::*;

use crate::arrivals::{ArrivalChunk, ArrivalSink, CHUNK};
use echotank_core::arrays::{ArrayGeometry, TransmitArray};
use echotank_core::model::{DopplerModel, PathModel};
use echotank_core::ping::{EchoCounts, PingPlan};
use echotank_core::scene::{LawCurve, ScatterLaw, Scatterers};
use echotank_core::simd::widest;

use super::levels::{Directivity, OneWay, amplitude_from_db};
use super::paths::{Batch, Chord, ElementTrack, Motion, Rays, Transmit, refine, solve};
use super::stretch::{Leg, about_mid_pulse, paper_eq21_delay_s};

mod insonifier;
mod line;
mod nodes;
mod subarray;

use insonifier::Insonifier;
pub use line::{LineEchoes, LineWorkspace, line_arrivals};
pub use nodes::{MAX_GAIN_NODES, MAX_NODES, NodeBatch, NodeTracks, NodeWorkspace, gain_node};
use subarray::{ArrayFactor, SubarrayElements};

/// Time span to synthesise, including filter margins.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Window {
    /// First sample, seconds from the start of the pulse.
    pub first_s: f64,
    /// Last sample, seconds from the start of the pulse.
    pub last_s: f64,
}

impl Window {
    /// The window of `count` samples that starts at `first_sample_s`.
    pub fn of_samples(first_sample_s: f64, rate_hz: f64, count: usize) -> Self {
        Self {
            first_s: first_sample_s,
            last_s: first_sample_s + count.saturating_sub(1) as f64 / rate_hz,
        }
    }
}

/// Insonified scatterers as a structure of arrays, without scatterers that no element can receive.
/// The buffers are reused from ping to ping.
#[derive(Debug, Default)]
pub struct TransmitLeg {
    window: Option<Window>,
    pub(super) transmit: Transmit,
    chords: Vec<Chord>,
    /// Position relative to the transmit position, metres.
    x_m: Vec<f64>,
    y_m: Vec<f64>,
    z_m: Vec<f64>,
    range_m: Vec<f64>,
    /// Product of source level, pattern, first leg, strength and the transmit half of the
    /// scattering law; uPa at 1 m from the scatterer.
    amplitude: Vec<Complex64>,
    /// Magnitude of the transmit pattern.
    level: Vec<f64>,
    /// Term of the receive half of the scattering law, sqrt(max(0, bias - normal.ray)). `bias` is 0
    /// for Lambert; for points it is 1 and the normal is zero. If `curved`, the half is the value
    /// of `curve` at that root.
    bias: Vec<f32>,
    curved: Vec<bool>,
    curve: Option<Arc<LawCurve>>,
    normal_x: Vec<f32>,
    normal_y: Vec<f32>,
    normal_z: Vec<f32>,
    /// Speed of the transmitter towards the scatterer, m/s.
    closing_m_per_s: Vec<f64>,
    /// Transmit points, metres from the transmit position, and half the path by way of them and back; empty where every
    /// scatterer is its own transmit point.
    transmit_m: [Vec<f64>; 3],
    half_path_m: Vec<f64>,
    /// Shortest receive leg, if the legs of any echo may differ.
    pub(super) nearest_receive_m: Option<f64>,
    /// Smallest and largest `range_m` of each batch of [`CHUNK`]; of the half paths where legs differ.
    pub(super) batch_range_m: Vec<(f64, f64)>,
    /// Smallest and largest `closing_m_per_s` of each batch; where legs differ, of its mean over both.
    pub(super) batch_closing_m_per_s: Vec<(f64, f64)>,
    /// Lowest and highest corner of each batch's bounding box.
    batch_box_m: Vec<(DVec3, DVec3)>,
}

impl TransmitLeg {
    /// An empty leg, before any [`insonify`].
    pub fn new() -> Self {
        Self::default()
    }

    /// Number of insonified scatterers.
    pub fn len(&self) -> usize {
        self.range_m.len()
    }

    /// Whether no scatterer is insonified.
    pub fn is_empty(&self) -> bool {
        self.range_m.is_empty()
    }

    /// The transmitter, and the chords of the platform's track.
    pub(super) fn sent(&self) -> (&Transmit, &[Chord]) {
        (&self.transmit, &self.chords)
    }

    /// The scatterers of one batch of [`CHUNK`], with their indices.
    fn batch(&self, b: usize) -> (Range<usize>, Batch<'_>) {
        let span = b * CHUNK..((b + 1) * CHUNK).min(self.len());
        let (min_range_m, max_range_m) = self.batch_range_m[b];
        let [x_m, y_m, z_m] = [&self.x_m, &self.y_m, &self.z_m].map(|axis| &axis[span.clone()]);
        let range_m = &self.range_m[span.clone()];
        let (transmit_m, half_path_m) = match self.has_images() {
            false => ([x_m, y_m, z_m], range_m),
            true => {
                let [x_m, y_m, z_m] = &self.transmit_m;
                let transmit_m = [x_m, y_m, z_m].map(|axis| &axis[span.clone()]);
                (transmit_m, &self.half_path_m[span.clone()])
            }
        };
        let batch = Batch {
            x_m,
            y_m,
            z_m,
            range_m,
            transmit_m,
            half_path_m,
            min_range_m,
            max_range_m,
        };
        (span, batch)
    }

    /// Whether the legs of any echo may differ.
    pub(super) fn has_images(&self) -> bool {
        !self.half_path_m.is_empty()
    }

    /// Sets the number of scatterers, and whether their legs may differ.
    fn resize(&mut self, len: usize, images: bool) {
        let image_len = if images { len } else { 0 };
        for values in &mut self.transmit_m {
            values.resize(image_len, 0.0);
        }
        self.half_path_m.resize(image_len, 0.0);
        for values in [
            &mut self.x_m,
            &mut self.y_m,
            &mut self.z_m,
            &mut self.range_m,
            &mut self.level,
            &mut self.closing_m_per_s,
        ] {
            values.resize(len, 0.0);
        }
        for values in [
            &mut self.bias,
            &mut self.normal_x,
            &mut self.normal_y,
            &mut self.normal_z,
        ] {
            values.resize(len, 0.0);
        }
        self.amplitude.resize(len, Complex64::ZERO);
        self.curved.resize(len, false);
    }

    /// Narrows the window to synthesise to `window`, a part of the insonified window.
    pub fn set_window(&mut self, window: Window) {
        if self.window.is_some() {
            self.window = Some(window);
        }
    }
}

/// Per-thread buffers of [`arrivals`].
#[derive(Default)]
pub struct Workspace {
    pub(super) track: ElementTrack,
    rays: Rays,
    received: ReceivedBatch,
    array_factor: ArrayFactor,
    chunk: ArrivalChunk,
}

impl Workspace {
    /// Empty buffers.
    pub fn new() -> Self {
        Self::default()
    }

    /// Buffers with capacity for a polyline of `segments` segments, so that no ping allocates.
    pub fn with_room_for(segments: usize) -> Self {
        Self {
            track: ElementTrack::with_room_for(segments),
            ..Self::default()
        }
    }
}

/// Values of one batch at one element, before culling.
struct ReceivedBatch {
    doppler: [f64; CHUNK],
    /// Half the second derivative of the emission time, per second.
    curvature_per_s: [f64; CHUNK],
    /// Product of second leg, element pattern, receive half of the law and sensitivity; volts per
    /// uPa at 1 m from the scatterer.
    gain: [f64; CHUNK],
    /// |transmit pattern x element pattern|.
    level: [f64; CHUNK],
    range_m: [f64; CHUNK],
    /// Velocity and acceleration of the element when the leading edge arrives, axis by axis.
    moving: [[f64; CHUNK]; 6],
    /// Volts, with the strength of the scatterer.
    amplitude: [Complex64; CHUNK],
    /// True if the echo is emitted.
    keep: [bool; CHUNK],
}

impl Default for ReceivedBatch {
    fn default() -> Self {
        let zero = [0.0; CHUNK];
        Self {
            doppler: zero,
            curvature_per_s: zero,
            gain: zero,
            level: zero,
            range_m: zero,
            moving: [zero; 6],
            amplitude: [Complex64::ZERO; CHUNK],
            keep: [false; CHUNK],
        }
    }
}

fn wavelength_m(plan: &PingPlan) -> f64 {
    plan.sound_speed_m_per_s / plan.pulse.center_frequency_hz
}

/// Smallest |transmit pattern x element pattern| that culling keeps.
fn pattern_floor(plan: &PingPlan) -> f64 {
    plan.model.cull_db.map_or(0.0, amplitude_from_db)
}

/// Computes the transmit leg of every scatterer. `window` is the span of the samples to synthesise.
///
/// The counts have each culled scatterer once, independent of the number of elements; `used` stays
/// 0.
pub fn insonify(
    plan: &PingPlan,
    tx: &TransmitArray,
    window: Window,
    scatterers: &Scatterers,
    transmit_leg: &mut TransmitLeg,
) -> EchoCounts {
    let transmit = Transmit::new(plan, tx);
    let pattern = Directivity::new(&tx.pattern, wavelength_m(plan));
    let one_way = OneWay::new(wavelength_m(plan), plan.absorption_db_per_m);
    let source = amplitude_from_db(plan.settings.source_level_db + tx.level_offset_db);
    let floor = pattern_floor(plan);
    let farthest_m = plan.sound_speed_m_per_s * window.last_s;

    transmit_leg.window = Some(window);
    transmit_leg.transmit = transmit;
    Chord::all(plan, &mut transmit_leg.chords);
    transmit_leg.curve.clone_from(&scatterers.curve);
    let insonifier = Insonifier {
        leg: TransmitLegTerms {
            transmit: &transmit,
            pattern,
            one_way,
            source,
        },
        scatterers,
        floor,
        range_floors: &plan.range_floors,
        farthest_m,
    };
    let counts = insonifier.insonify_all(transmit_leg);
    transmit_leg.nearest_receive_m = None;
    if transmit_leg.has_images() {
        bound_images(transmit_leg);
        return counts;
    }
    bound(transmit_leg);
    counts
}

/// Bounds of the batches.
fn bound(leg: &mut TransmitLeg) {
    let TransmitLeg {
        x_m,
        y_m,
        z_m,
        range_m,
        closing_m_per_s,
        batch_range_m,
        batch_closing_m_per_s,
        batch_box_m,
        ..
    } = leg;
    let batches = range_m.len().div_ceil(CHUNK);
    batch_range_m.resize(batches, (0.0, 0.0));
    batch_closing_m_per_s.resize(batches, (0.0, 0.0));
    batch_box_m.resize(batches, (DVec3::ZERO, DVec3::ZERO));
    batch_range_m
        .par_iter_mut()
        .zip(batch_closing_m_per_s)
        .zip(batch_box_m)
        .enumerate()
        .with_min_len(16)
        .for_each(|(b, ((of_range, of_closing), of_box))| {
            let span = b * CHUNK..((b + 1) * CHUNK).min(range_m.len());
            *of_range = min_max(&range_m[span.clone()]);
            *of_closing = min_max(&closing_m_per_s[span.clone()]);
            let [x, y, z] = [&*x_m, &*y_m, &*z_m].map(|axis| min_max(&axis[span.clone()]));
            *of_box = (DVec3::new(x.0, y.0, z.0), DVec3::new(x.1, y.1, z.1));
        });
}

/// Bounds of the batches of a leg with echoes whose legs differ.
fn bound_images(leg: &mut TransmitLeg) {
    leg.batch_range_m.clear();
    leg.batch_closing_m_per_s.clear();
    leg.batch_box_m.clear();
    let v = leg.transmit.motion.velocity_m_per_s;
    let mut nearest_receive_m = f64::INFINITY;
    leg.batch_range_m
        .extend(leg.half_path_m.chunks(CHUNK).map(min_max));
    for first in (0..leg.range_m.len()).step_by(CHUNK) {
        let (mut least, mut greatest) = (f64::INFINITY, f64::NEG_INFINITY);
        for i in first..(first + CHUNK).min(leg.range_m.len()) {
            let at_m = DVec3::new(leg.x_m[i], leg.y_m[i], leg.z_m[i]);
            let receive_m = at_m.length();
            let closing = v.dot(at_m) / receive_m.max(f64::MIN_POSITIVE);
            let mean = 0.5 * (leg.closing_m_per_s[i] + closing);
            (least, greatest) = (least.min(mean), greatest.max(mean));
            nearest_receive_m = nearest_receive_m.min(receive_m);
        }
        leg.batch_closing_m_per_s.push((least, greatest));
    }
    leg.nearest_receive_m = Some(nearest_receive_m);
}

/// Terms of the transmit leg that all scatterers share.
struct TransmitLegTerms<'a> {
    transmit: &'a Transmit,
    pattern: Directivity,
    one_way: OneWay,
    source: f64,
}

/// The transmit leg of one batch.
struct TransmitBatch {
    x_m: [f64; CHUNK],
    y_m: [f64; CHUNK],
    z_m: [f64; CHUNK],
    range_m: [f64; CHUNK],
    /// Cosine of the angle of incidence.
    facing: [f64; CHUNK],
    /// Product of source level, pattern and transmission loss.
    amplitude: [f64; CHUNK],
    /// Magnitude of the transmit pattern.
    level: [f64; CHUNK],
    closing_m_per_s: [f64; CHUNK],
}

impl Default for TransmitBatch {
    fn default() -> Self {
        let zero = [0.0; CHUNK];
        Self {
            x_m: zero,
            y_m: zero,
            z_m: zero,
            range_m: zero,
            facing: zero,
            amplitude: zero,
            level: zero,
            closing_m_per_s: zero,
        }
    }
}

/// Computes the transmit leg of `n` scatterers from index `first`; `n` is at most [`CHUNK`].
#[inline(always)]
fn compute_transmit_leg(
    leg: &TransmitLegTerms,
    scatterers: &Scatterers,
    first: usize,
    n: usize,
    out: &mut TransmitBatch,
) {
    let n = n.min(CHUNK);
    let (north_m, east_m, down_m, normal) = match &scatterers.transmit {
        own if own.is_empty() => (
            &scatterers.north_m,
            &scatterers.east_m,
            &scatterers.down_m,
            &scatterers.normal,
        ),
        points => (
            &points.north_m,
            &points.east_m,
            &points.down_m,
            &points.normal,
        ),
    };
    let north_m = &north_m[first..][..n];
    let east_m = &east_m[first..][..n];
    let down_m = &down_m[first..][..n];
    let normal = &normal[first..][..n];
    let v = leg.transmit.motion.velocity_m_per_s;
    for j in 0..n {
        let ray_m = leg
            .transmit
            .relative_m(DVec3::new(north_m[j], east_m[j], down_m[j]));
        let range_m = (ray_m.x * ray_m.x + ray_m.y * ray_m.y + ray_m.z * ray_m.z).sqrt();
        let per_m = 1.0 / range_m.max(f64::MIN_POSITIVE);
        let ray = (ray_m.x * per_m, ray_m.y * per_m, ray_m.z * per_m);
        let m = &leg.transmit.array_from_world;
        let response = leg.pattern.towards(
            m.x_axis.x * ray.0 + m.y_axis.x * ray.1 + m.z_axis.x * ray.2,
            m.x_axis.y * ray.0 + m.y_axis.y * ray.1 + m.z_axis.y * ray.2,
            m.x_axis.z * ray.0 + m.y_axis.z * ray.1 + m.z_axis.z * ray.2,
        );
        let [a, b, c] = normal[j];
        let n = [f64::from(a), f64::from(b), f64::from(c)];
        (out.x_m[j], out.y_m[j], out.z_m[j]) = (ray_m.x, ray_m.y, ray_m.z);
        out.range_m[j] = range_m;
        out.facing[j] = -(n[0] * ray.0 + n[1] * ray.1 + n[2] * ray.2);
        out.amplitude[j] = leg.source * response * leg.one_way.amplitude_at(range_m, per_m);
        out.level[j] = response.abs();
        out.closing_m_per_s[j] = v.x * ray.0 + v.y * ray.1 + v.z * ray.2;
    }
}

/// Smallest and largest value.
fn min_max(values: &[f64]) -> (f64, f64) {
    // Several at a time: each comparison waits for the one before.
    let (parts, rest) = values.as_chunks::<8>();
    let (mut least, mut most) = ([f64::INFINITY; 8], [f64::NEG_INFINITY; 8]);
    for part in parts {
        for (x, (least, most)) in part.iter().zip(least.iter_mut().zip(&mut most)) {
            (*least, *most) = (least.min(*x), most.max(*x));
        }
    }
    (
        least.iter().chain(rest).copied().fold(least[0], f64::min),
        most.iter().chain(rest).copied().fold(most[0], f64::max),
    )
}

/// Value of one leg of a curved scattering law; zero on the far side of the patch.
#[inline(always)]
fn one_leg_of_curve(curve: Option<&LawCurve>, root: f64) -> f64 {
    match curve {
        Some(curve) if root > 0.0 => curve.half(root),
        _ => 0.0,
    }
}

/// Maximum ratio of echo duration to pulse duration. Speeds are below a tenth of the sound speed:
/// (1 + 0.1)/(1 - 0.1) = 1.22.
const LONGEST_ECHO: f64 = 1.3;

/// Emits the echoes of all insonified scatterers at one element to `sink`, in chunks of at most
/// [`CHUNK`] and in the order of the scatterers.
///
/// Echoes that partly overlap the window are emitted. Counts are in scatterer-element pairs.
pub fn arrivals(
    plan: &PingPlan,
    array: &ArrayGeometry,
    element: usize,
    transmit_leg: &TransmitLeg,
    work: &mut Workspace,
    sink: &mut (impl ArrivalSink + ?Sized),
) -> EchoCounts {
    let Some(window) = transmit_leg.window else {
        return EchoCounts::default(); // nothing is insonified yet
    };
    let all = Slab {
        window,
        own_s: (f64::NEG_INFINITY, f64::INFINITY),
    };
    arrivals_of_slab(plan, array, element, transmit_leg, all, work, sink)
}

/// Slab of a record, with the delays that it counts.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Slab {
    /// Time span of the slab.
    pub window: Window,
    /// Half-open interval of delays that the slab counts, seconds. Other slabs count the rest.
    pub(crate) own_s: (f64, f64),
}

/// As [`arrivals`], for the echoes that overlap one slab. All slabs of a record together count
/// every scatterer-element pair once.
pub fn arrivals_of_slab(
    plan: &PingPlan,
    array: &ArrayGeometry,
    element: usize,
    transmit_leg: &TransmitLeg,
    slab: Slab,
    work: &mut Workspace,
    sink: &mut (impl ArrivalSink + ?Sized),
) -> EchoCounts {
    let mut counts = EchoCounts::default();
    let Slab { window, own_s } = slab;
    let is_own = |delay_s: f64| (own_s.0 <= delay_s) & (delay_s < own_s.1);
    let c = plan.sound_speed_m_per_s;
    let receive = ReceiveLeg::new(plan, array);
    let floor = pattern_floor(plan);
    let duration_s = plan.pulse.duration_s;
    let Workspace {
        track,
        rays,
        received,
        array_factor,
        chunk,
    } = work;
    let part = SubarrayElements::of(plan, array);
    track.compute(plan, transmit_leg.sent(), array, element);
    // u >= (2 r_T - reach)/c, so batches entirely after the window are skipped. Eq. 21 can shorten
    // a delay by at most the factor 3 v/c, with v below 0.1 c.
    let forward = match plan.model.doppler {
        DopplerModel::PaperEq21 => 1.5,
        _ => 1.0,
    };
    let last_s = forward * window.last_s;
    let farthest_m = 0.5 * (c * last_s + track.reach_m(last_s));
    // u <= (2 r_T + reach)/c, so batches whose last echo ends before the window are skipped.
    let ended_s = window.first_s - LONGEST_ECHO * duration_s;
    let nearest_m = 0.5 * (c * ended_s / forward - track.reach_m(window.first_s));
    chunk.element = element;
    chunk.len = 0;

    for (b, &(min_range_m, max_range_m)) in transmit_leg.batch_range_m.iter().enumerate() {
        let (span, batch) = transmit_leg.batch(b);
        let [is_late, is_early] = [
            min_range_m > farthest_m * (1.0 + 1e-12),
            max_range_m < nearest_m * (1.0 - 1e-12),
        ];
        if is_late || is_early {
            // Only the first or last slab counts the batch, because it has no neighbour on that
            // side.
            let ends_here = match is_late {
                true => own_s.1 == f64::INFINITY,
                false => own_s.0 == f64::NEG_INFINITY,
            };
            counts.outside_window += u64::from(ends_here) * span.len() as u64;
            continue;
        }
        let root_counts = solve(track, c, batch, rays);
        if is_own(rays.delay_s[0]) {
            counts.no_root += root_counts.no_root;
            counts.two_roots += root_counts.two_roots;
        }
        if plan.model.path == PathModel::Continuous {
            refine(plan, &transmit_leg.transmit, track, batch, rays);
        }
        receive_gains(&receive, transmit_leg, span.clone(), rays, received);
        match plan.model.doppler {
            DopplerModel::None | DopplerModel::Stretch => {}
            DopplerModel::StretchQuadratic => {
                expand_mid_pulse(plan, transmit_leg, track, batch, rays, received);
            }
            DopplerModel::PaperEq21 => {
                apply_paper_eq21(c, transmit_leg, span.clone(), rays, received)
            }
        }

        let n = span.len();
        let amplitude = &transmit_leg.amplitude[span];
        let mut kept = 0;
        for (i, amplitude) in amplitude.iter().enumerate() {
            let delay_s = rays.delay_s[i];
            let counted = is_own(delay_s);
            let (doppler, curvature_per_s) = (received.doppler[i], received.curvature_per_s[i]);
            let received_s = window.first_s - delay_s;
            let ended =
                received_s * (1.0 + doppler + curvature_per_s * received_s.max(0.0)) > duration_s;
            let outside = (delay_s > window.last_s) | ended;
            let product = *amplitude * received.gain[i];
            let inaudible = (received.level[i] < floor) | (product.re == 0.0) & (product.im == 0.0);
            received.amplitude[i] = product;
            let keep = !(outside | inaudible);
            received.keep[i] = keep;
            kept += u64::from(keep);
            counts.used += u64::from(counted & keep);
            counts.outside_window += u64::from(counted & outside);
            counts.culled += u64::from(counted & !outside & inaudible);
            let near = received.range_m[i] < receive.one_way.wavelength_m;
            counts.too_close += u64::from(counted & keep & near);
            counts.beyond_track += u64::from(counted & keep & (delay_s >= track.end_s()));
        }
        if let Some(part) = &part {
            part.array_factor(plan, track, rays, n, array_factor);
            for (amplitude, array_factor) in received.amplitude[..n]
                .iter_mut()
                .zip(array_factor.of_each())
            {
                *amplitude *= array_factor;
            }
        }
        // Common case: a whole batch fills an empty chunk.
        if kept == n as u64 && chunk.len == 0 {
            chunk.delay_s[..n].copy_from_slice(&rays.delay_s[..n]);
            chunk.doppler[..n].copy_from_slice(&received.doppler[..n]);
            chunk.curvature_per_s[..n].copy_from_slice(&received.curvature_per_s[..n]);
            chunk.amplitude[..n].copy_from_slice(&received.amplitude[..n]);
            chunk.len = n;
        } else {
            for i in (0..n).filter(|&i| received.keep[i]) {
                if chunk.len == CHUNK {
                    sink.accept(chunk);
                    chunk.len = 0;
                }
                let at = chunk.len;
                chunk.delay_s[at] = rays.delay_s[i];
                chunk.doppler[at] = received.doppler[i];
                chunk.curvature_per_s[at] = received.curvature_per_s[i];
                chunk.amplitude[at] = received.amplitude[i];
                chunk.len = at + 1;
            }
        }
        if chunk.len == CHUNK {
            sink.accept(chunk);
            chunk.len = 0;
        }
    }
    if chunk.len > 0 {
        sink.accept(chunk);
        chunk.len = 0;
    }
    counts
}

/// Terms of the receive leg that all scatterers share.
struct ReceiveLeg {
    c: f64,
    pattern: Directivity,
    one_way: OneWay,
    sensitivity: f64,
}

impl ReceiveLeg {
    fn new(plan: &PingPlan, array: &ArrayGeometry) -> Self {
        Self {
            c: plan.sound_speed_m_per_s,
            pattern: Directivity::new(&array.element_pattern, wavelength_m(plan)),
            one_way: OneWay::new(wavelength_m(plan), plan.absorption_db_per_m),
            sensitivity: amplitude_from_db(array.sensitivity_db),
        }
    }
}

/// Computes gain, pattern level and Doppler of the receive leg of a batch.
fn receive_gains(
    receive: &ReceiveLeg,
    transmit_leg: &TransmitLeg,
    span: Range<usize>,
    rays: &Rays,
    received: &mut ReceivedBatch,
) {
    let curved = transmit_leg.curved[span.clone()].contains(&true);
    let omni = receive.pattern.is_omnidirectional();
    widest(
        #[inline(always)]
        || match (curved, omni) {
            (false, false) => {
                receive_gains_as::<false, false>(receive, transmit_leg, span, rays, received)
            }
            (false, true) => {
                receive_gains_as::<false, true>(receive, transmit_leg, span, rays, received)
            }
            (true, false) => {
                receive_gains_as::<true, false>(receive, transmit_leg, span, rays, received)
            }
            (true, true) => {
                receive_gains_as::<true, true>(receive, transmit_leg, span, rays, received)
            }
        },
    );
}

/// `CURVED`: some scatterers of the batch follow the curve. `OMNI`: the element pattern is
/// omnidirectional.
#[inline(always)]
fn receive_gains_as<const CURVED: bool, const OMNI: bool>(
    receive: &ReceiveLeg,
    transmit_leg: &TransmitLeg,
    span: Range<usize>,
    rays: &Rays,
    received: &mut ReceivedBatch,
) {
    let n = span.len().min(CHUNK);
    let level = &transmit_leg.level[span.clone()][..n];
    let bias = &transmit_leg.bias[span.clone()][..n];
    let normal_x = &transmit_leg.normal_x[span.clone()][..n];
    let normal_y = &transmit_leg.normal_y[span.clone()][..n];
    let normal_z = &transmit_leg.normal_z[span.clone()][..n];
    let closing_m_per_s = &transmit_leg.closing_m_per_s[span.clone()][..n];
    // The half of the law apart: loops that look up the curve are not vectorised.
    let (mut law, mut pers_m) = ([0.0; CHUNK], [0.0; CHUNK]);
    for i in 0..n {
        let (x, y, z) = (rays.x_m[i], rays.y_m[i], rays.z_m[i]);
        let range_m = (x * x + y * y + z * z).sqrt();
        let per_m = 1.0 / range_m.max(f64::MIN_POSITIVE);
        (received.range_m[i], pers_m[i]) = (range_m, per_m);
        let normal_along_ray =
            (f64::from(normal_x[i]) * x + f64::from(normal_y[i]) * y + f64::from(normal_z[i]) * z)
                * per_m;
        law[i] = (f64::from(bias[i]) - normal_along_ray).max(0.0).sqrt();
    }
    if CURVED {
        let curve = transmit_leg.curve.as_deref();
        let curved = &transmit_leg.curved[span][..n];
        for (law, curved) in law.iter_mut().zip(curved) {
            if *curved {
                *law = one_leg_of_curve(curve, *law);
            }
        }
    }
    for i in 0..n {
        let (range_m, per_m) = (received.range_m[i], pers_m[i]);
        let response = if OMNI {
            1.0
        } else {
            receive.pattern.towards(
                rays.array_x_m[i] * per_m,
                rays.array_y_m[i] * per_m,
                rays.array_z_m[i] * per_m,
            )
        };
        received.gain[i] =
            receive.sensitivity * response * law[i] * receive.one_way.amplitude_at(range_m, per_m);
        received.level[i] = level[i] * response.abs();
        // eta - 1 of eta = (c + v_R.e_R)/(c - v_T.e_T), rearranged to avoid cancellation.
        received.doppler[i] = (rays.closing_m2_per_s[i] * per_m + closing_m_per_s[i])
            / (receive.c - closing_m_per_s[i]);
    }
}

/// Applies [`DopplerModel::StretchQuadratic`]: expands each echo about mid-pulse instead of the
/// leading edge.
fn expand_mid_pulse(
    plan: &PingPlan,
    transmit_leg: &TransmitLeg,
    track: &ElementTrack,
    batch: Batch,
    rays: &mut Rays,
    received: &mut ReceivedBatch,
) {
    let n = batch.range_m.len().min(CHUNK);
    track.motions_at(plan, &rays.delay_s[..n], &mut received.moving);
    let middle = Middle {
        c: plan.sound_speed_m_per_s,
        half_s: 0.5 * plan.pulse.duration_s,
        transmit: transmit_leg.transmit.motion,
    };
    widest(
        #[inline(always)]
        || expand(middle, batch, rays, received),
    );
}

/// Terms that all echoes of a batch share.
#[derive(Clone, Copy)]
struct Middle {
    c: f64,
    half_s: f64,
    transmit: Motion,
}

#[inline(always)]
fn expand(middle: Middle, batch: Batch, rays: &mut Rays, received: &mut ReceivedBatch) {
    let Middle {
        c,
        half_s,
        transmit,
    } = middle;
    let n = batch.range_m.len().min(CHUNK);
    let [x_m, y_m, z_m] = batch.transmit_m.map(|axis| &axis[..n]);
    let [vx, vy, vz, ax, ay, az] = &received.moving;
    for i in 0..n {
        let transmit = Leg {
            ray_m: DVec3::new(x_m[i], y_m[i], z_m[i]),
            motion: transmit,
        };
        let receive = Leg {
            ray_m: DVec3::new(rays.x_m[i], rays.y_m[i], rays.z_m[i]),
            motion: Motion {
                velocity_m_per_s: DVec3::new(vx[i], vy[i], vz[i]),
                acceleration_m_per_s2: DVec3::new(ax[i], ay[i], az[i]),
            },
        };
        let (delay_s, doppler) = (rays.delay_s[i], received.doppler[i]);
        let echo = about_mid_pulse(c, half_s, transmit, receive, delay_s, doppler);
        rays.delay_s[i] = echo.delay_s;
        received.doppler[i] = echo.doppler;
        received.curvature_per_s[i] = echo.curvature_per_s;
    }
}

/// Applies [`DopplerModel::PaperEq21`]: moves the stretch into the delays.
fn apply_paper_eq21(
    c: f64,
    transmit_leg: &TransmitLeg,
    span: Range<usize>,
    rays: &mut Rays,
    received: &mut ReceivedBatch,
) {
    for (i, m) in span.enumerate() {
        let a = transmit_leg.closing_m_per_s[m];
        // eta - 1 = (a + b)/(c - a)
        let b = received.doppler[i] * (c - a) - a;
        rays.delay_s[i] =
            paper_eq21_delay_s(c, transmit_leg.range_m[m] / c, rays.delay_s[i], (a, b));
        received.doppler[i] = 0.0;
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use echotank_core::arrays::Pattern;
    use echotank_core::simd::SimdLevel;

    #[test]
    fn every_build_of_the_second_leg_gives_the_same_bits() {
        let place = |step: f64| -> Vec<f64> {
            (0..CHUNK)
                .map(|k| (k as f64 * step).fract() - 0.5)
                .collect()
        };
        let narrow = |v: &[f64]| -> Vec<f32> { v.iter().map(|x| *x as f32).collect() };
        let (a, b, c) = (place(0.618), place(0.755), place(0.57));
        let transmit_leg = TransmitLeg {
            level: a.clone(),
            bias: (0..CHUNK).map(|k| (k % 2) as f32).collect(),
            curved: (0..CHUNK).map(|k| k % 4 < 2).collect(),
            curve: Some(Arc::new(LawCurve::new(|cosine| 0.1 + cosine.powi(3)))),
            normal_x: narrow(&a),
            normal_y: narrow(&b),
            normal_z: narrow(&c),
            closing_m_per_s: b.clone(),
            ..TransmitLeg::default()
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
            level: SimdLevel,
            (receive, transmit_leg, rays): (&ReceiveLeg, &TransmitLeg, &Rays),
        ) -> [[u64; CHUNK]; 4] {
            let mut received = ReceivedBatch::default();
            let to = &mut received;
            level.run(
                #[inline(always)]
                || receive_gains_as::<CURVED, false>(receive, transmit_leg, 0..CHUNK, rays, to),
            );
            [
                received.doppler,
                received.gain,
                received.level,
                received.range_m,
            ]
            .map(|v| v.map(f64::to_bits))
        }
        let all = (&receive, &transmit_leg, &rays);
        let portable = SimdLevel::PORTABLE;
        let (plain, curved) = (run::<false>(portable, all), run::<true>(portable, all));
        for level in SimdLevel::available() {
            assert!(run::<false>(level, all) == plain && run::<true>(level, all) == curved);
        }
        assert!(plain[1].iter().filter(|&&g| g != 0).count() > 50);
        assert!(plain[1] != curved[1]);
    }

    #[test]
    fn every_build_of_the_second_order_gives_the_same_bits() {
        let place = |k: usize, step: f64| (k as f64 * step).fract() - 0.5;
        let at = |step: f64| -> Vec<f64> { (0..CHUNK).map(|k| 90.0 * place(k, step)).collect() };
        let (x_m, y_m, z_m) = (at(0.618), at(0.755), at(0.57));
        let length = |k: usize| (x_m[k].powi(2) + y_m[k].powi(2) + z_m[k].powi(2)).sqrt();
        let range_m: Vec<f64> = (0..CHUNK).map(length).collect();
        let batch = Batch {
            x_m: &x_m,
            y_m: &y_m,
            z_m: &z_m,
            range_m: &range_m,
            transmit_m: [&x_m, &y_m, &z_m],
            half_path_m: &range_m,
            min_range_m: 0.0,
            max_range_m: 200.0,
        };
        let middle = Middle {
            c: 1500.0,
            half_s: 2.5e-3,
            transmit: Motion {
                velocity_m_per_s: DVec3::new(5.0, 0.3, -0.2),
                acceleration_m_per_s2: DVec3::new(0.1, 0.0, 0.4),
            },
        };
        let run = |level: SimdLevel| {
            let (mut rays, mut received) = (Rays::default(), ReceivedBatch::default());
            for k in 0..CHUNK {
                (rays.x_m[k], rays.y_m[k], rays.z_m[k]) = (x_m[k] - 0.3, y_m[k], z_m[k] + 0.1);
                rays.delay_s[k] = 2.0 * range_m[k] / 1500.0;
                received.doppler[k] = 6e-3 * place(k, 0.33);
                for (axis, moving) in received.moving.iter_mut().enumerate() {
                    moving[k] = 5.0 * place(k + axis, 0.41);
                }
            }
            level.run(
                #[inline(always)]
                || expand(middle, batch, &mut rays, &mut received),
            );
            [rays.delay_s, received.doppler, received.curvature_per_s].map(|v| v.map(f64::to_bits))
        };
        let want = run(SimdLevel::PORTABLE);
        assert!(SimdLevel::available().all(|level| run(level) == want));
        assert!(want[2].iter().filter(|&&q| q != 0).count() > CHUNK / 2);
    }

    #[test]
    fn every_build_of_the_first_leg_gives_the_same_bits() {
        let mut scatterers = Scatterers::default();
        let place = |k: usize, step: f64| (k as f64 * step).fract() - 0.5;
        for k in 0..CHUNK {
            let (a, b, c) = (place(k, 0.618), place(k, 0.755), place(k, 0.57));
            let normal = [a as f32, b as f32, c as f32];
            let position_m = DVec3::new(a, b, c) * 90.0;
            scatterers.push(position_m, normal, Complex64::ONE, ScatterLaw::Lambert);
        }
        let leg = TransmitLegTerms {
            transmit: &Transmit::default(),
            pattern: Directivity::new(&Pattern::Omnidirectional, 0.00375),
            one_way: OneWay::new(0.00375, 0.096),
            source: 3.0,
        };
        let run = |level: SimdLevel| {
            let mut out = TransmitBatch::default();
            level.run(
                #[inline(always)]
                || compute_transmit_leg(&leg, &scatterers, 0, CHUNK, &mut out),
            );
            assert!(out.amplitude.iter().all(|a| *a > 0.0));
            let all = [out.x_m, out.range_m, out.facing, out.amplitude, out.level];
            all.map(|v| v.map(f64::to_bits))
        };
        let want = run(SimdLevel::PORTABLE);
        assert!(SimdLevel::available().all(|level| run(level) == want));
    }
}

//! Motion along the rays of a ping, weighted with the energy of their echoes. The closed forms of the error models hold for echoes from any
//! direction, but a beam to the side receives none from ahead.
//!
//! In: a ping's plan and scatterers. Out: [`EchoStatistics`]. Of a seabed, only an even sample of the scatterers is used;
//! points and targets are all used.

use std::cell::{Cell, RefCell};
use std::f64::consts::SQRT_2;

use glam::{DMat3, DQuat, DVec3};

use crate::conditions::sound_speed_step_up;
use crate::element_synthesis::filter_design;
use crate::method_selection::{MotionScale, fades};
use crate::range_floors::half_path_m;
use echotank_config::spec::SonarSpec;
use echotank_core::arrays::{ArrayGeometry, TransmitArray};
use echotank_core::frames::{Pose, Trajectory, VectorKnot};
use echotank_core::model::{DopplerModel, PathModel, Synthesis};
use echotank_core::ping::PingPlan;
use echotank_core::pulse::{MIN_WINDOW, Pulse, noise_share};
use echotank_core::scene::{ScatterLaw, Scatterers};
use echotank_synthesis::array::displaced_echo_errors;
use echotank_synthesis::echo::levels::{Directivity, OneWay, amplitude_from_db};
use echotank_synthesis::echo::paths::Motion;
use echotank_synthesis::echo::{Chord, segment_motion};
use echotank_synthesis::error_model::{Conditions, EchoStatistics, OVERLAPPING, PROMINENCES};

/// Approximate number of seabed scatterers in the sample. In each of a hundred windows they give root mean squares within a tenth. Fewer
/// predict smaller errors: 5,000 a path error 31 % below that of 20,000 with `line256.toml`.
pub const SAMPLE_SIZE: usize = 20_000;
/// Instants at which an element's motion is tabled.
pub(super) const INSTANTS: usize = 64;
/// ... for [`echo_peaks`], which looks at about so many pairs of a scatterer and an end of an array, and at no more scatterers that are near.
const FEW_INSTANTS: usize = 8;
const FEW_SCATTERERS: usize = 256;
/// Rounding of finite differences of velocities, m/s^2.
const STILL_M_PER_S2: f64 = 1e-9;
/// What a sample of the echoes and of the elements, and motion tabled at instants, may leave out of a root mean square.
pub(super) const SAMPLED: f64 = 1.1;

/// A window may begin anywhere, and cut an echo anywhere: it is put together of so many parts, and looked at from each of them on.
const PARTS: usize = 4;

/// Quantities that the error models multiply, in the order of [`EchoStatistics`]: displacement, closing speed, range acceleration, its rate,
/// acceleration, turning, change of acceleration, unsteadiness, range acceleration throughout.
pub(super) const QUANTITIES: usize = 9;
/// The same, and last how far the path model and its velocities are off, where that is known.
pub(super) const TRACKED: usize = QUANTITIES + 2;
pub(super) const OFF_PATH: usize = QUANTITIES;
pub(super) const OFF_VELOCITY: usize = QUANTITIES + 1;
/// These quantities.
pub(super) fn quantities(echoes: &mut EchoStatistics) -> [&mut f64; QUANTITIES] {
    [
        &mut echoes.displacement_m,
        &mut echoes.closing_m_per_s,
        &mut echoes.range_acceleration_m_per_s2,
        &mut echoes.range_jerk_m_per_s3,
        &mut echoes.acceleration_m_per_s2,
        &mut echoes.turning_m_per_s,
        &mut echoes.acceleration_change_m_per_s2,
        &mut echoes.unsteady_m_per_s2,
        &mut echoes.range_acceleration_throughout_m_per_s2,
    ]
}

/// How their phases grow within an echo, in the order of the quantities.
pub(super) const GROWTH: [Growth; TRACKED] = [
    Growth::Constant,
    Growth::Linear,
    Growth::Square,
    Growth::Cubic,
    Growth::Constant,
    Growth::Constant,
    Growth::Constant,
    Growth::Unsteady,
    Growth::Constant,
    Growth::Constant,
    Growth::Linear,
];

/// A phase within an echo, over the share t of the pulse.
#[derive(Clone, Copy, Debug)]
pub(super) enum Growth {
    Constant,
    /// t and t^2, each with a mean square of 1 over the pulse.
    Linear,
    Square,
    /// The third order about mid-pulse, 1 at both ends: (2 t - 1)^3.
    Cubic,
    /// A track off the parabola with its velocities at both ends, 1 at the end. A step of the acceleration at t = s has t^2/s before and
    /// ((1 - s) t^2 - (t - s)^2)/(s (1 - s)) after it; all are below 2 t - t^2.
    Unsteady,
}

pub(super) const GROWTHS: usize = 5;

impl Growth {
    const ALL: [Self; GROWTHS] = [
        Self::Constant,
        Self::Linear,
        Self::Square,
        Self::Cubic,
        Self::Unsteady,
    ];

    /// Of all growths.
    pub(super) const SHAPES: [fn(f64) -> f64; GROWTHS] = [
        |t| Self::Constant.at(t),
        |t| Self::Linear.at(t),
        |t| Self::Square.at(t),
        |t| Self::Cubic.at(t),
        |t| Self::Unsteady.at(t),
    ];

    fn at(self, t: f64) -> f64 {
        match self {
            Self::Constant => 1.0,
            Self::Linear => 3f64.sqrt() * t,
            Self::Square => 5f64.sqrt() * t * t,
            Self::Cubic => (2.0 * t - 1.0).powi(3),
            Self::Unsteady => 2.0 * t - t * t,
        }
    }
}

/// Instants of a pulse at which its energy is tabled.
const STEPS: usize = 128;

/// Energies of a pulse: by itself, times each [`Growth`], times its square, and of its first and last quarter.
type Sums = [f64; 2 * GROWTHS + 2];
const ALONE_SUM: usize = 0;
const GROWN: usize = 1;
const SQUARED: usize = 1 + GROWTHS;
const END_QUARTERS: usize = 1 + 2 * GROWTHS;

/// The energies of a pulse up to an instant, of a mean of 1. Flanks have little.
pub(super) struct Energies {
    /// Mean square of the pulse.
    pub mean: f64,
    upto: [Sums; STEPS + 1],
    /// Of a window that holds no more than the end of an echo, the worst error over the rms of the last part of the echo.
    pub last: [f64; GROWTHS],
    /// That rms.
    last_part: [f64; GROWTHS],
}

impl Energies {
    pub(super) fn new(pulse: &Pulse) -> Self {
        let step = 1.0 / STEPS as f64;
        let levels: [f64; STEPS] = std::array::from_fn(|i| {
            let t = (i as f64 + 0.5) * step;
            pulse.envelope(t * pulse.duration_s).norm_sqr()
        });
        let mean = levels.iter().sum::<f64>() * step;
        let mut upto = [Sums::default(); STEPS + 1];
        for (i, level) in levels.iter().enumerate() {
            let t = (i as f64 + 0.5) * step;
            let energy = step * level / mean;
            let mut sums = upto[i];
            sums[ALONE_SUM] += energy;
            for (g, growth) in Growth::ALL.into_iter().enumerate() {
                sums[GROWN + g] += energy * growth.at(t);
                sums[SQUARED + g] += energy * growth.at(t).powi(2);
            }
            if !(0.25..0.75).contains(&t) {
                sums[END_QUARTERS] += energy;
            }
            upto[i + 1] = sums;
        }
        let floor = noise_share();
        let part = STEPS - STEPS / PARTS;
        let from = |g: usize, i: usize| {
            let energy = upto[STEPS][ALONE_SUM] - upto[i][ALONE_SUM];
            let error = upto[STEPS][SQUARED + g] - upto[i][SQUARED + g];
            (error / energy.max(floor)).sqrt()
        };
        let last_part = std::array::from_fn(|g| from(g, part).max(f64::MIN_POSITIVE));
        let last = std::array::from_fn(|g| {
            let worst = (part..STEPS).map(|i| from(g, i)).fold(0.0, f64::max);
            worst / last_part[g]
        });
        Self {
            mean,
            upto,
            last,
            last_part,
        }
    }

    /// Counts in windows with no more than the end of an echo also how phases displace flanks and the tail of the receiver filter.
    pub(super) fn with_displaced_ends(mut self, spec: &SonarSpec, plan: &PingPlan) -> Self {
        let c = sound_speed_step_up(plan.sound_speed_m_per_s);
        let filter = filter_design(spec, Synthesis::Direct, c);
        let rate_hz = spec.receiver.sample_rate_hz;
        // A filter that cannot be designed is refused elsewhere.
        if let Ok(errors) = displaced_echo_errors(plan, rate_hz, filter, Growth::SHAPES) {
            for ((last, part), error) in self.last.iter_mut().zip(self.last_part).zip(errors) {
                *last = last.max(error / part);
            }
        }
        self
    }

    /// The sums up to a share of the pulse.
    fn upto(&self, share: f64) -> Sums {
        let at = share * STEPS as f64;
        let below = (at as usize).min(STEPS - 1);
        let (before, after) = (&self.upto[below], &self.upto[below + 1]);
        std::array::from_fn(|k| before[k] + (at - below as f64) * (after[k] - before[k]))
    }

    /// As `last`, over the rms of what has this share of an echo's energy at its end.
    pub(super) fn last_over(&self, growth: Growth, share: f64) -> f64 {
        let g = growth as usize;
        let all = &self.upto[STEPS];
        let left = all[ALONE_SUM] * (1.0 - share);
        let begin = self.upto.partition_point(|sums| sums[ALONE_SUM] < left);
        let part = STEPS - STEPS / PARTS;
        let begin = &self.upto[begin.min(part)];
        let energy = all[ALONE_SUM] - begin[ALONE_SUM];
        let rms = ((all[SQUARED + g] - begin[SQUARED + g]) / energy).sqrt();
        self.last[g] * self.last_part[g] / rms.max(f64::MIN_POSITIVE)
    }
}

/// A window with fewer echoes than this, by their energies, is one echo or the end of one; with fewer than the second, mostly.
pub(super) const ALONE: f64 = 1.001;
pub(super) const SINGLE: f64 = 1.25;

/// All points and targets, and of the ground every so many, about `among` of them: each with how many it stands for.
pub fn sampled(scatterers: &Scatterers, among: usize) -> impl Iterator<Item = (usize, f64)> {
    let stride = scatterers.len().div_ceil(among).max(1);
    let laws = scatterers.law.iter().enumerate();
    laws.filter_map(move |(i, law)| match law {
        ScatterLaw::Point => Some((i, 1.0)),
        _ if i.is_multiple_of(stride) => Some((i, stride as f64)),
        _ => None,
    })
}

/// Smallest and largest of some values.
#[derive(Clone, Copy)]
pub(super) struct Extremes(f64, f64);

impl Default for Extremes {
    /// Of no values.
    fn default() -> Self {
        Self(f64::INFINITY, f64::NEG_INFINITY)
    }
}

impl Extremes {
    fn and(self, other: Self) -> Self {
        Self(self.0.min(other.0), self.1.max(other.1))
    }

    fn apart(self) -> f64 {
        (self.1 - self.0).max(0.0)
    }
}

/// What sounds in a part of a window: energy, and the weighted sums and squares of the quantities of [`EchoStatistics`].
#[derive(Clone, Copy, Default)]
pub(super) struct Part {
    pub energy: f64,
    pub sums: [f64; TRACKED],
    pub squares: [f64; TRACKED],
    /// Squares of the component across the array and of the closing speed of whole echoes.
    pub across2: f64,
    pub closing2: f64,
    /// Closing speeds, m/s.
    pub(super) closing_m_per_s: Extremes,
    /// Of the loudest echo, all of it, and what of it sounds here.
    pub loudest: f64,
    pub loudest_here: f64,
    /// What of the energy is in the first or last quarter of an echo.
    pub ends: f64,
    /// Sum of the products of the energies of two different echoes, from above: what interferes.
    pub mixed: f64,
    /// Of the echoes that begin here: how many, their energy, and the sum of its squares.
    pub echoes: f64,
    pub begun: f64,
    pub begun2: f64,
}

impl Part {
    pub(super) fn and(mut self, other: &Self) -> Self {
        self.energy += other.energy;
        for q in 0..TRACKED {
            self.sums[q] += other.sums[q];
            self.squares[q] += other.squares[q];
        }
        self.across2 += other.across2;
        self.closing2 += other.closing2;
        self.closing_m_per_s = self.closing_m_per_s.and(other.closing_m_per_s);
        self.ends += other.ends;
        self.loudest = self.loudest.max(other.loudest);
        // Echoes that do not sound at the same time do not interfere.
        self.mixed += other.energy * other.energy - other.loudest_here * other.loudest_here;
        self.echoes += other.echoes;
        self.begun += other.begun;
        self.begun2 += other.begun2;
        self
    }

    /// Of an echo what sounds here, between two shares of the pulse with these sums.
    fn add(&mut self, (from, to): (&Sums, &Sums), (energy, whole): (f64, f64), echo: &EchoMotion) {
        let heard: Sums = std::array::from_fn(|k| to[k] - from[k]);
        let share = energy * heard[ALONE_SUM];
        self.energy += share;
        self.loudest = self.loudest.max(whole);
        self.loudest_here = self.loudest_here.max(whole * heard[ALONE_SUM]);
        self.ends += energy * heard[END_QUARTERS];
        for (q, value) in echo.values.into_iter().enumerate() {
            let g = GROWTH[q] as usize;
            self.sums[q] += value * energy * heard[GROWN + g];
            self.squares[q] += value * value * energy * heard[SQUARED + g];
        }
        self.across2 += share * echo.across_m_per_s.powi(2);
        let closing = echo.values[1];
        self.closing2 += share * closing.powi(2);
        self.closing_m_per_s = self.closing_m_per_s.and(Extremes(closing, closing));
    }

    /// The worst that the quantities amount to in samples of a window like this one, among windows whose number has the logarithm `looks`.
    ///
    /// A single echo is off by its own phase. Many echoes of random phases are Gaussian, and so is their error: it has a part in proportion to the
    /// samples (the mean phase) and one that does not depend on them (the spread of the phases), which counts more where the samples cancel.
    /// Between them, the energy of a window varies as the products of the energies of different echoes do.
    ///
    /// The last value is the same for errors of random phase with a mean square of 1 over every echo.
    ///
    /// `last`: of [`Energies`].
    fn amounts(
        &self,
        last: &[f64; GROWTHS],
        floor: f64,
        looks: f64,
        independent: f64,
    ) -> ([f64; QUANTITIES], f64) {
        let energy = self.energy.max(f64::MIN_POSITIVE);
        let of_part = (independent / PARTS as f64).max(1.0);
        let n = energy * energy * of_part / self.mixed.max(f64::MIN_POSITIVE);
        let (ratio, peak) = (
            fades::worst_ratio_of_pulses(looks, n),
            fades::worst_peak(looks, n),
        );
        let crowd = energy / self.loudest.max(f64::MIN_POSITIVE);
        let mut amounts = [0.0; QUANTITIES];
        for (q, amount) in amounts.iter_mut().enumerate() {
            let square = self.squares[q] / energy;
            let mean = (self.sums[q] / energy).abs();
            let variance = (square - mean * mean).max(0.0);
            let all = (square * ratio).sqrt();
            let alone = all.min(mean + (variance * ratio).sqrt());
            let on_floor = (square * peak * energy / floor).sqrt();
            let last = last[GROWTH[q] as usize];
            let margin = match crowd {
                ..ALONE => last,
                ..SINGLE => last * SAMPLED,
                // Where all that sounds is ends, these may be cut as short as that of a lone echo.
                _ => OVERLAPPING.max(last * self.ends / energy),
            };
            *amount = alone.min(on_floor) * margin;
        }
        (
            amounts,
            OVERLAPPING * ratio.min(peak * energy / floor).sqrt(),
        )
    }
}

/// Statistics of the received echoes; `None` without echoes.
pub fn echo_statistics(
    spec: &SonarSpec,
    plan: &PingPlan,
    scatterers: &Scatterers,
) -> Option<EchoStatistics> {
    let rate_hz = spec.receiver.sample_rate_hz;
    let window_s = plan.pulse.duration_s.max(MIN_WINDOW / rate_hz);
    let windows = (plan.window_s(rate_hz) / window_s).ceil().max(1.0) as usize;
    let part_s = window_s / PARTS as f64;
    let elements: usize = spec.receive.iter().map(|array| array.elements).sum();
    let looks = ((windows * PARTS * elements).max(2) as f64).ln();
    let independent = fades::independent_of_pulse(&plan.pulse, window_s);
    let mut worst = [0.0f64; QUANTITIES];
    let (mut across2, mut closing2) = (0.0f64, 0.0f64);
    let (mut apart_m_per_s, mut heard) = (0.0, 0.0);
    let mut sounded = false;
    // Echoes in a loud window that count, at most.
    let mut crowd = 1.0f64;
    let mut fading = 1.0f64;
    let mut prominent = Prominent::default();
    let sample = 1.0 / (plan.pulse.duration_s * rate_hz).max(1.0);
    let energies = Energies::new(&plan.pulse).with_displaced_ends(spec, plan);
    let mut parts = vec![Part::default(); windows * PARTS];
    let poses = Poses::of(&plan.trajectory);
    for array in &spec.receive {
        let transmit = &spec.transmit[array.transmit];
        let outermost = array.outermost().take(array.elements);
        let each = array.elements as f64 / outermost.clone().count() as f64;
        for element in outermost {
            parts.fill(Part::default());
            let ends = (array, element);
            let receiver = ReceivingElement::new(spec, (plan, &poses), transmit, ends, INSTANTS);
            receiver.accumulate(
                plan,
                scatterers,
                &energies,
                part_s,
                &mut parts,
                |_, _, _| (),
            );
            let mean = parts.iter().map(|part| part.energy).sum::<f64>() / windows as f64;
            if mean == 0.0 {
                continue;
            }
            sounded = true;
            let window = |parts: &[Part]| parts.iter().fold(Part::default(), Part::and);
            let strongest = parts.windows(PARTS).map(|parts| window(parts).energy);
            let floor = strongest.fold(mean, f64::max) * noise_share();
            prominent.count(&parts, floor, sample, each);
            for window in parts.windows(PARTS).map(window) {
                if window.energy == 0.0 {
                    continue;
                }
                if window.energy > mean && window.begun > 0.0 {
                    crowd = crowd.max(window.begun.powi(2) / window.begun2);
                }
                // What a typical window has, for costs and pictures.
                let against = window.energy.max(mean);
                across2 = across2.max(window.across2 / against);
                closing2 = closing2.max(window.closing2 / against);
                apart_m_per_s += window.closing_m_per_s.apart();
                heard += 1.0;
                let (amounts, faded) = window.amounts(&energies.last, floor, looks, independent);
                fading = fading.max(faded);
                for (worst, amount) in worst.iter_mut().zip(amounts) {
                    *worst = worst.max(amount);
                }
            }
        }
    }
    let [
        displacement,
        closing,
        range_acceleration,
        range_jerk,
        acceleration,
        turning,
        acceleration_change,
        unsteady,
        throughout,
    ] = worst;
    sounded.then(|| EchoStatistics {
        displacement_m: displacement,
        closing_m_per_s: closing,
        closing_of_echoes_m_per_s: closing2.sqrt(),
        closing_apart_m_per_s: apart_m_per_s / heard,
        range_acceleration_m_per_s2: range_acceleration,
        range_acceleration_throughout_m_per_s2: throughout,
        range_jerk_m_per_s3: range_jerk,
        acceleration_m_per_s2: acceleration,
        turning_m_per_s: turning,
        acceleration_change_m_per_s2: acceleration_change,
        unsteady_m_per_s2: unsteady,
        across_m_per_s: across2.sqrt(),
        spread: 1.0
            + (spread(plan, window_s, windows * elements, crowd) - 1.0) * (1.0 - 1.0 / crowd),
        fading,
        tails: f64::INFINITY,
        ends: SQRT_2,
        off_path_m: None,
        off_velocity_m_per_s: None,
        echoes: prominent.by_error[PROMINENCES - 1],
        prominent: prominent.by_error,
    })
}

/// Numbers of echoes by the error of a sample gained or lost, as in [`EchoStatistics::prominent`].
#[derive(Default)]
struct Prominent {
    by_error: [f64; PROMINENCES],
    squares: Vec<f64>,
}

impl Prominent {
    /// Adds the echoes of one element, which stands for `each`. `sample`: of the energy of an echo, what a sample has.
    fn count(&mut self, parts: &[Part], floor: f64, sample: f64, each: f64) {
        self.squares.clear();
        self.squares.resize(parts.len(), 0.0);
        for (first, parts) in parts.windows(PARTS).enumerate() {
            let window = parts.iter().fold(Part::default(), Part::and);
            let square = (sample * window.loudest / window.energy.max(floor)).min(1.0);
            // Echoes that begin in the window, or before it and end in it.
            for largest in &mut self.squares[first.saturating_sub(PARTS)..first + PARTS] {
                *largest = largest.max(square);
            }
        }
        for (part, square) in parts.iter().zip(&self.squares) {
            for (halvings, count) in self.by_error.iter_mut().enumerate() {
                let is_last = halvings == PROMINENCES - 1;
                if is_last || square.sqrt() > libm::exp2(-(halvings as f64 + 1.0)) {
                    *count += each * part.echoes;
                }
            }
        }
    }
}

/// Of many echoes at random phases. Mean squares of n independent samples of Gaussian noise: the greatest of `looks` is 1 + 2 sqrt(L/n) + 2 L/n times the mean, L = ln looks
/// (Laurent and Massart 2000, Lemma 1, in its sharper form for two degrees of freedom each: 1 + sqrt(2L/n) + L/n). A window has no more
/// independent samples than echoes.
fn spread(plan: &PingPlan, window_s: f64, looks: usize, crowd: f64) -> f64 {
    let independent = (1.0 + plan.pulse.bandwidth_hz * window_s).min(crowd);
    SAMPLED * fades::worst_peak((looks.max(2) as f64).ln(), independent).sqrt()
}

/// How a ping's echo moves, along its rays.
struct EchoMotion {
    /// In the order of [`EchoStatistics`], and the distance from the path model.
    values: [f64; TRACKED],
    /// Across the array.
    across_m_per_s: f64,
}

/// Largest motion of the echoes of a ping, by a small sample of its scatterers: enough to tell one ping from another.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct EchoPeaks {
    /// In the order of [`EchoStatistics`].
    values: [f64; QUANTITIES],
    nearest_m: f64,
    /// Some scatterer is so near that the platform's way during a pulse is no small part of its range: how loud it is counts more than the peaks.
    pub(super) has_near: bool,
}

/// The peaks of a ping.
pub(super) fn echo_peaks(spec: &SonarSpec, plan: &PingPlan, scatterers: &Scatterers) -> EchoPeaks {
    let near = Near::new(spec, plan, scatterers);
    let mut peaks = EchoPeaks {
        values: [0.0; QUANTITIES],
        nearest_m: f64::INFINITY,
        has_near: near.any,
    };
    let heard_m = plan.window_s(spec.receiver.sample_rate_hz) * plan.sound_speed_m_per_s;
    let poses = Poses::of(&plan.trajectory);
    // Each of them looks at others.
    let outermost = spec.receive.iter().map(|array| array.outermost().count());
    let outermost = outermost.sum::<usize>().max(1);
    let mut looked = 0;
    let stride = scatterers.len().div_ceil(FEW_SCATTERERS).max(1);
    for array in &spec.receive {
        let transmit = &spec.transmit[array.transmit];
        for element in array.outermost() {
            let of = (array, element);
            let receiver = ReceivingElement::new(spec, (plan, &poses), transmit, of, FEW_INSTANTS);
            let evenly = (looked * stride..scatterers.len()).step_by(outermost * stride);
            looked += 1;
            for i in evenly.chain(near.indices()) {
                let place_m = scatterers.position_m(i);
                let sent_m = scatterers.transmit_m(i);
                let ray = receiver.ray(sent_m, place_m, plan.sound_speed_m_per_s);
                if ray.out_range_m + ray.back_range_m > heard_m {
                    continue;
                }
                let line_m = receiver.line_distance_m(&ray, &receiver.at[ray.instant]);
                peaks.nearest_m = peaks.nearest_m.min(ray.out_range_m).min(line_m);
                let values = receiver.motion(&ray).values;
                for (peak, value) in peaks.values.iter_mut().zip(values) {
                    *peak = peak.max(value.abs());
                }
            }
        }
    }
    peaks
}

/// Scatterers so near that the platform's way during a pulse is no small part of their range.
struct Near<'a> {
    scatterers: &'a Scatterers,
    at_m: DVec3,
    reach_m: f64,
    any: bool,
}

impl<'a> Near<'a> {
    fn new(spec: &SonarSpec, plan: &PingPlan, scatterers: &'a Scatterers) -> Self {
        let pose = plan.trajectory.pose_at(0.0);
        let arms = spec.receive.iter().flat_map(|array| {
            let transmit = spec.transmit[array.transmit].mounting.position_m;
            let outermost = array.outermost().map(|e| array.element_body_m(e));
            outermost.chain([transmit])
        });
        let arm_m = arms.map(|arm_m| arm_m.length()).fold(0.0, f64::max);
        let way_m = pose.velocity_m_per_s.length() * plan.pulse.duration_s;
        let near = Self {
            scatterers,
            at_m: pose.position_m,
            reach_m: arm_m + NEAR_WAYS * way_m,
            any: false,
        };
        // Mostly there are none: counting is faster than looking for the first.
        let all = (0..scatterers.len()).map(|i| u32::from(near.holds(i)));
        Self {
            any: all.sum::<u32>() > 0,
            ..near
        }
    }

    fn holds(&self, i: usize) -> bool {
        let off_m = self.scatterers.position_m(i) - self.at_m;
        off_m.length_squared() < self.reach_m * self.reach_m
    }

    /// Some of them.
    fn indices(&self) -> impl Iterator<Item = usize> {
        let all = if self.any { self.scatterers.len() } else { 0 };
        (0..all).filter(|i| self.holds(*i)).take(FEW_SCATTERERS)
    }
}

/// So many ways of the platform during a pulse away, a range is expanded about mid-pulse (`echo::stretch`).
const NEAR_WAYS: f64 = 5.0;

impl EchoPeaks {
    /// Those of motion that is so much greater.
    pub(super) fn times(mut self, motion: &MotionScale) -> Self {
        for (value, factor) in self.values.iter_mut().zip(motion.factors()) {
            *value *= factor;
        }
        self
    }

    /// The conditions of a ping with these peaks, from those of another ping whose peaks were `then`.
    pub(super) fn scale(&self, then: &Self, mut conditions: Conditions) -> Conditions {
        if let Some(echoes) = &mut conditions.echo_statistics {
            for (k, statistic) in quantities(echoes).into_iter().enumerate() {
                let (now, then) = (self.values[k], then.values[k]);
                // What the other ping had none of, this one has at most everywhere.
                *statistic = match then > RESTING * now {
                    true => *statistic * now / then,
                    false => now,
                };
            }
        }
        let (nearest_m, farthest_m) = conditions.range_m;
        let nearer = self.nearest_m / then.nearest_m;
        if nearer.is_finite() {
            conditions.range_m.0 = (nearest_m * nearer).min(farthest_m);
        }
        conditions
    }
}

/// Below this share of the range from an array's end, the distance from the array counts.
const NEAR_LINE: f64 = 0.9;

/// Motion below this share of another ping's is none.
const RESTING: f64 = 1e-6;

/// One leg of a path model: place and velocity, relative to the first segment's place, and the axes of the array, which turn evenly.
struct PathLeg {
    start_s: f64,
    at_m: DVec3,
    velocity_m_per_s: DVec3,
    array_from_world: DMat3,
    turning_rad_per_s: DVec3,
    /// When the axes are exact.
    facing_s: f64,
    /// Motion in the Doppler term, and the rate of its velocity along the leg, m/s^2, as `echo::paths` has them.
    doppler: Motion,
    doppler_rate: DVec3,
}

/// Poses of a trajectory, kept for the points that ask for them at the same instants in the same order.
pub(super) struct Poses<'a> {
    trajectory: &'a Trajectory,
    /// With origin and instant.
    known: RefCell<Vec<(DVec3, f64, Pose)>>,
    next: Cell<usize>,
}

impl<'a> Poses<'a> {
    pub(super) fn of(trajectory: &'a Trajectory) -> Self {
        Self {
            trajectory,
            known: RefCell::default(),
            next: Cell::new(0),
        }
    }

    /// Another point begins to ask.
    fn rewind(&self) {
        self.next.set(0);
    }

    fn at(&self, t_s: f64) -> Pose {
        self.from(DVec3::ZERO, t_s)
    }

    /// Relative to `origin_m`.
    fn from(&self, origin_m: DVec3, t_s: f64) -> Pose {
        let mut known = self.known.borrow_mut();
        let next = self.next.replace(self.next.get() + 1);
        if let Some((of_m, at_s, pose)) = known.get(next)
            && *of_m == origin_m
            && *at_s == t_s
        {
            return *pose;
        }
        known.truncate(next);
        let pose = self.trajectory.pose_from(origin_m, t_s);
        known.push((origin_m, t_s, pose));
        pose
    }
}

/// Velocities of a point: at the beginning of a pulse, and in the mean up to its middle and up to its end.
type Velocities = [DVec3; 3];

/// One element with its transmitter, through a ping.
pub(super) struct ReceivingElement {
    transmit_m: DVec3,
    transmit_m_per_s: DVec3,
    transmit_m_per_s2: DVec3,
    transmit_change_m_per_s2: DVec3,
    transmit_unsteady_m_per_s2: DVec3,
    transmit_from_world: DMat3,
    transmit_leg: Directivity,
    element: Directivity,
    one_way: OneWay,
    /// Way along the array from this element to the last one on its other side, metres.
    line_m: f64,
    /// On the body.
    arm_m: DVec3,
    body_from_element: DQuat,
    /// Of the ping's path model, if it is known; and the velocities of the transmitter that it is off by.
    legs: Option<Vec<PathLeg>>,
    transmit_off_m_per_s: Velocities,
    pulse_s: f64,
    step_s: f64,
    at: Vec<At>,
}

/// Places on a line where elements are looked at, from the nearest to a scatterer, in distances of that one: what the pulse leaves of a leg changes
/// with the direction of the ray, by less than [`SAMPLED`] from one place to the next.
const NEAR_PLACES: [f64; 7] = [-1.5, -0.8, -0.35, 0.0, 0.35, 0.8, 1.5];

/// Times within a pulse from which the track is looked at, and within a step of the table, at most; shorter pulses take the change of the tabled
/// acceleration, which is greater.
const LOOKS_OF_A_PULSE: f64 = 4.0;
const MAX_LOOKS: f64 = 8.0;

/// The acceleration that is off by as much, at the end of a pulse that begins at `t_s`, as the track of a point is off the parabola with its velocities at
/// both ends: of a step of A in the acceleration at mid-pulse the end is off by A T^2/8. With p the place and v the velocity,
///
/// ```text
/// off = p(T) - p(0) - (v(0) + v(T)) T/2
/// ```
///
/// This is the parabola of `stretch-quadratic`, whose acceleration is the mean over the pulse. Where the record ends within the pulse, at `heard_s`, the
/// track counts up to there only: as much as leaves that by the shape of [`Growth::Unsteady`].
fn unsteady_m_per_s2(
    poses: &Poses,
    pulse_s: f64,
    arm_m: DVec3,
    (t_s, heard_s): (f64, f64),
) -> DVec3 {
    let origin_m = poses.at(t_s).position_m;
    let pose_at = |t_s: f64| poses.from(origin_m, t_s);
    let begin = pose_at(t_s);
    let off = |until_s: f64| {
        let [.., mean] = off_velocities(pose_at, (arm_m, None), (&begin, t_s), (until_s, pulse_s));
        let off_m = mean * until_s;
        match off_m.length() < STILL_M {
            true => DVec3::ZERO,
            false => off_m * (8.0 / (pulse_s * pulse_s * Growth::Unsteady.at(until_s / pulse_s))),
        }
    };
    let left_s = heard_s - t_s;
    if left_s >= pulse_s {
        return off(pulse_s);
    }
    if left_s <= 0.0 {
        return DVec3::ZERO;
    }
    let (half, whole) = (off(0.5 * left_s), off(left_s));
    if half.length() > whole.length() {
        half
    } else {
        whole
    }
}

/// The velocities of the transmitter that the path model is off by in the pulse.
fn transmit_off_m_per_s(plan: &PingPlan, transmit: &TransmitArray) -> Velocities {
    let segment = &plan.segments[0];
    let arm_m = transmit.mounting.position_m;
    let of_model = match plan.model.path {
        PathModel::StopAndHop | PathModel::Polyline => {
            let motion = segment_motion(plan, 0, segment.world_from_body * arm_m);
            Some([motion.velocity_m_per_s, motion.acceleration_m_per_s2])
        }
        PathModel::KSegment | PathModel::Continuous => None,
    };
    let pose = plan.trajectory.pose_from(segment.position_m, 0.0);
    let pulse_s = plan.pulse.duration_s;
    let pose_at = |t_s: f64| plan.trajectory.pose_from(segment.position_m, t_s);
    off_velocities(pose_at, (arm_m, of_model), (&pose, 0.0), (pulse_s, pulse_s))
}

/// The velocities that a model of the motion of a point on a lever arm is off by, in a pulse that begins at `t_s` with `pose`, and of which `until_s`
/// count. `pose_at`: relative to an origin. `of_model`: velocity and acceleration; none: the exact velocity, with the mean acceleration of the pulse.
///
/// With b and e the velocities off at the beginning and at the end, T apart, and D the way off at the end, the cubic with all three is off by D/2 + (b - e) T/8
/// in the middle.
fn off_velocities(
    pose_at: impl Fn(f64) -> Pose,
    (arm_m, of_model): (DVec3, Option<[DVec3; 2]>),
    (pose, t_s): (&Pose, f64),
    (until_s, pulse_s): (f64, f64),
) -> Velocities {
    let pose_at = |later_s: f64| pose_at(t_s + later_s);
    let velocity = |pose: &Pose| pose.point_velocity_m_per_s(arm_m);
    let later = pose_at(until_s);
    let begins = velocity(pose);
    let [of_model, acceleration] = of_model.unwrap_or_else(|| {
        let end = match until_s < pulse_s {
            true => velocity(&pose_at(pulse_s)),
            false => velocity(&later),
        };
        [begins, (end - begins) / pulse_s]
    });
    let begin = begins - of_model;
    let end = velocity(&later) - of_model - acceleration * until_s;
    let moved = (later.point_m(arm_m) - pose.point_m(arm_m)) / until_s;
    let mean = moved - of_model - acceleration * (0.5 * until_s);
    [begin, mean + (begin - end) * 0.25, mean]
}

/// Times of the knots of a trajectory between two instants, seconds: of each quantity as many as are looked at within a step, at most.
fn knots_s(trajectory: &Trajectory, from_s: f64, to_s: f64) -> impl Iterator<Item = f64> {
    let Trajectory {
        position,
        attitude,
        heave,
        ..
    } = trajectory;
    fn between<K>(knots: &[K], time_s: fn(&K) -> f64, ends_s: [f64; 2]) -> &[K] {
        let [begin, end] = ends_s.map(|end_s| knots.partition_point(|k| time_s(k) < end_s));
        &knots[begin..end.min(begin + MAX_LOOKS as usize)]
    }
    let ends_s = [from_s, to_s];
    let of = |k: &VectorKnot| k.time_s;
    let turning = between(attitude, |k| k.time_s, ends_s);
    let moving = between(position, of, ends_s).iter();
    let moving = moving.chain(between(heave, of, ends_s)).map(of);
    moving.chain(turning.iter().map(|k| k.time_s))
}

/// Rounding of places, metres.
const STILL_M: f64 = 1e-13;

/// One leg at the leading edge: from the sonar's end, which moves, to the scatterer.
#[derive(Clone, Copy)]
struct Leg {
    ray_m: DVec3,
    velocity_m_per_s: DVec3,
    acceleration_m_per_s2: DVec3,
}

impl Leg {
    /// Length, rate and its change, so much later.
    fn at(&self, later_s: f64) -> [f64; 3] {
        let a = self.acceleration_m_per_s2;
        let ray_m = self.ray_m - (self.velocity_m_per_s + a * (0.5 * later_s)) * later_s;
        let velocity = self.velocity_m_per_s + a * later_s;
        let range_m = ray_m.length().max(f64::MIN_POSITIVE);
        let closing = velocity.dot(ray_m) / range_m;
        let across2 = (velocity.length_squared() - closing * closing).max(0.0);
        let second = across2 / range_m - a.dot(ray_m) / range_m;
        [range_m, -closing, second]
    }

    /// Mean of the second derivatives of this leg and another, and of the third derivatives that leave as much at an end of the pulse as
    /// `stretch-quadratic` leaves of both legs: r''' h^3/6 a leg, h half the pulse.
    ///
    /// The range less its parabola about mid-pulse is taken as it is, with all orders. A leg that is too short for the parabola keeps the rate of its
    /// leading edge, and lacks all orders from the second on.
    fn with(&self, other: &Self, pulse_s: f64) -> [f64; 2] {
        let half_s = 0.5 * pulse_s;
        let legs = [self, other];
        let [begin, middle, end] = [0.0, half_s, pulse_s].map(|t_s| legs.map(|leg| leg.at(t_s)));
        let second = 0.5 * (begin[0][2] + begin[1][2]);
        let moved_m = legs.map(|leg| leg.velocity_m_per_s.length() * pulse_s);
        let is_near = begin[0][0].min(begin[1][0]) < NEAR_WAYS * moved_m[0].max(moved_m[1]);
        let off_m = |k: usize| match is_near {
            true => {
                let [range_m, rate, _] = begin[k];
                [0.0, end[k][0] - range_m - rate * pulse_s]
            }
            false => {
                let [range_m, rate, second] = middle[k];
                let even_m = range_m + 0.5 * second * half_s * half_s;
                [
                    begin[k][0] - even_m + rate * half_s,
                    end[k][0] - even_m - rate * half_s,
                ]
            }
        };
        let (one, two) = (off_m(0), off_m(1));
        let ends_m = [one[0] + two[0], one[1] + two[1]];
        // A fourth order makes one end the worse, whichever way the third goes.
        let worst_m = ends_m[0].abs().max(ends_m[1].abs());
        let third = 3.0 * worst_m.copysign(ends_m[1] - ends_m[0]) / half_s.powi(3);
        [second, third]
    }
}

/// The way of an echo: directions, lengths, and the element where it is heard.
struct Ray {
    out: DVec3,
    out_range_m: f64,
    instant: usize,
    since_s: f64,
    here_m: DVec3,
    back: DVec3,
    back_range_m: f64,
}

/// The element at one instant.
#[derive(Clone, Copy)]
struct At {
    position_m: DVec3,
    velocity_m_per_s: DVec3,
    acceleration_m_per_s2: DVec3,
    /// Of the acceleration within a pulse that begins here.
    change_m_per_s2: DVec3,
    /// See [`unsteady_m_per_s2`].
    unsteady_m_per_s2: DVec3,
    turning_m_per_s: DVec3,
    array_from_world: DMat3,
    /// Along its array.
    axis: DVec3,
}

impl ReceivingElement {
    pub(super) fn new(
        spec: &SonarSpec,
        (plan, poses): (&PingPlan, &Poses),
        transmit: &TransmitArray,
        of: (&ArrayGeometry, usize),
        instants: usize,
    ) -> Self {
        Self::with_tables(spec, (plan, poses), transmit, of, (instants, true))
    }

    /// Without the other elements of the array, and with the path model of the plan, for [`Self::accumulate`]. `chords`: of `k-segment`.
    pub(super) fn alone(
        spec: &SonarSpec,
        (plan, poses, chords): (&PingPlan, &Poses, &[Chord]),
        transmit: &TransmitArray,
        of: (&ArrayGeometry, usize),
        instants: usize,
    ) -> Self {
        let receiver = Self::with_tables(spec, (plan, poses), transmit, of, (instants, false));
        Self {
            line_m: 0.0,
            legs: Some(receiver.legs(plan, chords)),
            transmit_off_m_per_s: transmit_off_m_per_s(plan, transmit),
            ..receiver
        }
    }

    /// `tables_changes`: of the acceleration, for echoes whose path model is not known.
    fn with_tables(
        spec: &SonarSpec,
        (plan, poses): (&PingPlan, &Poses),
        transmit: &TransmitArray,
        (array, element): (&ArrayGeometry, usize),
        (instants, tables_changes): (usize, bool),
    ) -> Self {
        poses.rewind();
        let wavelength_m = plan.sound_speed_m_per_s / plan.pulse.center_frequency_hz;
        let heard_s = plan.window_s(spec.receiver.sample_rate_hz);
        let step_s = heard_s / instants as f64;
        let mounting = array.element_mounting(element);
        let arm_m = mounting.position_m;
        // The largest change from an instant on, within a pulse.
        let pulse_steps = (plan.pulse.duration_s / step_s).ceil().max(1.0) as usize;
        let steps = instants.max(pulse_steps) + 1;
        let at: Vec<Pose> = (0..=steps).map(|k| poses.at(k as f64 * step_s)).collect();
        let acceleration = |k: usize, arm_m: DVec3| {
            let [begin, end] = [&at[k], &at[k + 1]].map(|pose| pose.point_velocity_m_per_s(arm_m));
            let a = (end - begin) / step_s;
            if a.length() < STILL_M_PER_S2 {
                DVec3::ZERO
            } else {
                a
            }
        };
        let start = &at[0];
        let place = transmit.mounting.position_m;
        let accelerations: Vec<DVec3> = (0..=instants).map(|k| acceleration(k, arm_m)).collect();
        let largest = |of: &[DVec3]| {
            let changes = of[1..].iter().map(|a| *a - of[0]);
            changes.fold(DVec3::ZERO, |most, change| {
                match change.length() > most.length() {
                    true => change,
                    false => most,
                }
            })
        };
        // The record ends with the last step: what follows is not heard.
        let last = instants - 1;
        let change = |k: usize| {
            if !tables_changes {
                return DVec3::ZERO;
            }
            let from = k.min(last.saturating_sub(1));
            largest(&accelerations[from..=(k + pulse_steps).min(last)])
        };
        let transmit_change = || {
            let steps = (0..=pulse_steps).map(|k| acceleration(k, place));
            largest(&steps.collect::<Vec<DVec3>>())
        };
        // Pulses that begin between two instants see a step of the acceleration at another time.
        let looks = (LOOKS_OF_A_PULSE * step_s / plan.pulse.duration_s).ceil();
        let pulse_s = plan.pulse.duration_s;
        let unsteady_at =
            |arm_m: DVec3, t_s: f64| unsteady_m_per_s2(poses, pulse_s, arm_m, (t_s, heard_s));
        let unsteady = |t_s: f64, change: DVec3| {
            if !tables_changes {
                return DVec3::ZERO;
            }
            let larger = |most: DVec3, off: DVec3| match off.length() > most.length() {
                true => off,
                false => most,
            };
            if looks > MAX_LOOKS {
                // Pulses that the record cuts have an acceleration of what follows it, too.
                let cuts = match t_s + 1.5 * step_s > heard_s {
                    true => LOOKS_OF_A_PULSE as usize,
                    false => 0,
                };
                let from_s = (1..=cuts).map(|k| heard_s - k as f64 / LOOKS_OF_A_PULSE * pulse_s);
                // A knot amid the pulse: the mean accelerations of long steps may hide its step.
                let knots_s = knots_s(&plan.trajectory, t_s, t_s + step_s + pulse_s);
                let amid_s = knots_s.map(|knot_s| (knot_s - 0.5 * pulse_s).max(0.0));
                let all = from_s.chain(amid_s).map(|t_s| unsteady_at(arm_m, t_s));
                return all.fold(change, larger);
            }
            let from_s = (0..=looks as usize).map(|k| t_s + k as f64 / looks * step_s);
            let all = from_s.map(|t_s| unsteady_at(arm_m, t_s));
            all.fold(DVec3::ZERO, larger)
        };
        let [transmit_change_m_per_s2, transmit_unsteady_m_per_s2] = match tables_changes {
            true => [transmit_change(), unsteady_at(place, 0.0)],
            false => [DVec3::ZERO; 2],
        };
        Self {
            transmit_m: start.point_m(place),
            transmit_m_per_s: start.point_velocity_m_per_s(place),
            transmit_m_per_s2: acceleration(0, place),
            transmit_change_m_per_s2,
            transmit_unsteady_m_per_s2,
            transmit_from_world: DMat3::from_quat(
                (start.world_from_body * transmit.mounting.body_from_array).inverse(),
            ),
            transmit_leg: Directivity::new(&transmit.pattern, wavelength_m),
            element: Directivity::new(&array.element_pattern, wavelength_m),
            one_way: OneWay::new(wavelength_m, plan.absorption_db_per_m),
            pulse_s: plan.pulse.duration_s,
            arm_m,
            body_from_element: mounting.body_from_array,
            legs: None,
            transmit_off_m_per_s: Velocities::default(),
            line_m: {
                // Of an arc, along its chord.
                let x_m = |e: usize| array.element_m(e).x;
                let to_last_m = x_m(array.elements - 1) - x_m(element);
                let to_first_m = x_m(0) - x_m(element);
                if element == 0 { to_last_m } else { to_first_m }
            },
            step_s,
            at: (0..=instants)
                .map(|k| {
                    let (t_s, pose) = (k as f64 * step_s, &at[k]);
                    let velocity = pose.point_velocity_m_per_s(arm_m);
                    At {
                        position_m: pose.point_m(arm_m),
                        velocity_m_per_s: velocity,
                        acceleration_m_per_s2: accelerations[k],
                        change_m_per_s2: change(k),
                        unsteady_m_per_s2: unsteady(t_s, change(k)),
                        turning_m_per_s: velocity - pose.velocity_m_per_s,
                        array_from_world: DMat3::from_quat(
                            (pose.world_from_body * mounting.body_from_array).inverse(),
                        ),
                        axis: pose.world_from_body * (array.mounting.body_from_array * DVec3::X),
                    }
                })
                .collect(),
        }
    }

    /// The legs of the plan's path model, as `echo::paths` has them; none of the exact trajectory.
    fn legs(&self, plan: &PingPlan, chords: &[Chord]) -> Vec<PathLeg> {
        let segments = plan.segments.as_slice();
        let origin_m = segments[0].position_m;
        let axes = |world_from_body: DQuat| {
            DMat3::from_quat((world_from_body * self.body_from_element).inverse())
        };
        let of_segment = |k: usize, moves: f64| {
            let segment = &segments[k];
            let arm_m = segment.world_from_body * self.arm_m;
            PathLeg {
                start_s: segment.start_s,
                at_m: segment.position_m - origin_m + arm_m,
                velocity_m_per_s: moves * segment.velocity_m_per_s,
                array_from_world: axes(segment.world_from_body),
                turning_rad_per_s: DVec3::ZERO,
                facing_s: segment.start_s,
                doppler: segment_motion(plan, k, arm_m),
                doppler_rate: DVec3::ZERO,
            }
        };
        let of_chord = |chord: &Chord| {
            let place_m = |pose: &Pose| pose.point_m(self.arm_m);
            let at_m = place_m(&chord.begin);
            let (doppler, doppler_rate) = chord.motion(self.arm_m, self.pulse_s);
            let array_from_world = axes(chord.middle.world_from_body);
            PathLeg {
                start_s: chord.start_s,
                at_m,
                velocity_m_per_s: (place_m(&chord.end) - at_m) / chord.step_s,
                array_from_world,
                turning_rad_per_s: array_from_world * chord.middle.angular_velocity_rad_per_s,
                facing_s: chord.start_s + 0.5 * chord.step_s,
                doppler,
                doppler_rate,
            }
        };
        match plan.model.path {
            PathModel::Continuous => Vec::new(),
            PathModel::StopAndHop => vec![of_segment(0, 0.0)],
            PathModel::Polyline => (0..segments.len()).map(|k| of_segment(k, 1.0)).collect(),
            PathModel::KSegment => chords.iter().map(of_chord).collect(),
        }
    }

    /// The response of the element towards an echo, and how far the path model has the element from where it is as the echo arrives, along its ray,
    /// metres. The path model turns the pattern too: an echo whose level is off by a share e has the error of one that is off by e radians, and
    /// both add in squares. Last the mean velocity within the pulse that it is off by, of both ways together, metres per second.
    fn heard(&self, plan: &PingPlan, legs: &[PathLeg], ray: &Ray) -> (f64, [f64; 2]) {
        let t_s = (ray.out_range_m + ray.back_range_m) / plan.sound_speed_m_per_s;
        let pose = plan.trajectory.pose_from(plan.segments[0].position_m, t_s);
        let towards = |u: DVec3| self.element.towards(u.x, u.y, u.z);
        let axes = DMat3::from_quat((pose.world_from_body * self.body_from_element).inverse());
        let exact = towards(axes * ray.back);
        let before = legs.partition_point(|leg| leg.start_s <= t_s);
        let leg = legs.get(before.max(1) - 1);
        let off_m_per_s = self.off_velocity_m_per_s(plan, leg, (&pose, t_s), ray);
        let Some(leg) = leg else {
            return (exact, [0.0, off_m_per_s]);
        };
        let at_m = leg.at_m + leg.velocity_m_per_s * (t_s - leg.start_s);
        let off_m = pose.point_m(self.arm_m) - at_m;
        let along_m = off_m.dot(ray.back);
        if self.element.is_omnidirectional() || exact == 0.0 {
            return (exact, [along_m, off_m_per_s]);
        }
        let ray_m = ray.back * ray.back_range_m + off_m;
        let facing = leg.array_from_world * ray_m.normalize_or_zero();
        let turned = facing.cross(leg.turning_rad_per_s) * (t_s - leg.facing_s);
        let level = towards(facing + turned) / exact - 1.0;
        let per_rad_m = self.one_way.wavelength_m / std::f64::consts::TAU;
        let off_m = along_m.hypot(level * per_rad_m).copysign(along_m);
        (exact, [off_m, off_m_per_s])
    }

    /// Mean velocity error of the path model during an echo that arrives at `t_s`, m/s, along its rays, the sum of transmitter and element: over the
    /// received part of the echo or over the first half of that part, whichever is larger. `leg` is `None` for `continuous`, whose trajectory is exact.
    fn off_velocity_m_per_s(
        &self,
        plan: &PingPlan,
        leg: Option<&PathLeg>,
        (pose, t_s): (&Pose, f64),
        ray: &Ray,
    ) -> f64 {
        let heard_s = self.step_s * (self.at.len() - 1) as f64;
        let until_s = (heard_s - t_s).clamp(0.0, self.pulse_s);
        if until_s == 0.0 || plan.model.doppler == DopplerModel::None {
            return 0.0;
        }
        let of_model = leg.map(|leg| {
            let moved = leg.doppler_rate * (t_s - leg.start_s);
            let begin = leg.doppler;
            [begin.velocity_m_per_s + moved, begin.acceleration_m_per_s2]
        });
        let origin_m = plan.segments[0].position_m;
        let receive = off_velocities(
            |t_s| plan.trajectory.pose_from(origin_m, t_s),
            (self.arm_m, of_model),
            (pose, t_s),
            (until_s, self.pulse_s),
        );
        let off = std::array::from_fn(|k| {
            receive[k].dot(ray.back) + self.transmit_off_m_per_s[k].dot(ray.out)
        });
        let [begin, middle, end]: [f64; 3] = off;
        match plan.model.doppler {
            // The second order of `stretch` is off as a whole, and counted with the range acceleration.
            DopplerModel::StretchQuadratic if middle.abs() > end.abs() => middle,
            DopplerModel::StretchQuadratic => end,
            _ => begin,
        }
    }

    /// The way to a scatterer and back.
    /// `sent_m`: the place as the transmitter sees it.
    fn ray(&self, sent_m: DVec3, place_m: DVec3, c: f64) -> Ray {
        let out_m = sent_m - self.transmit_m;
        let out_range_m = out_m.length().max(f64::MIN_POSITIVE);
        let about_s = (out_range_m + place_m.distance(self.at[0].position_m)) / c;
        let instant = ((about_s / self.step_s) as usize).min(self.at.len() - 1);
        let at = &self.at[instant];
        let since_s = (about_s - instant as f64 * self.step_s).clamp(0.0, self.step_s);
        let here_m = at.position_m + at.velocity_m_per_s * since_s;
        let back_m = place_m - here_m;
        let back_range_m = back_m.length().max(f64::MIN_POSITIVE);
        Ray {
            out: out_m / out_range_m,
            out_range_m,
            instant,
            since_s,
            here_m,
            back: back_m / back_range_m,
            back_range_m,
        }
    }

    /// Distance of a scatterer from the nearest element of the array.
    fn line_distance_m(&self, ray: &Ray, at: &At) -> f64 {
        let back_m = ray.back * ray.back_range_m;
        (back_m - at.axis * self.on_line_m(back_m.dot(at.axis))).length()
    }

    /// The place on the array nearest to one so far along its axis from this element.
    fn on_line_m(&self, along_m: f64) -> f64 {
        along_m.clamp(self.line_m.min(0.0), self.line_m.max(0.0))
    }

    fn motion(&self, ray: &Ray) -> EchoMotion {
        let at = &self.at[ray.instant];
        // The acceleration is the mean up to the next instant, so the velocity is exact there too.
        let v_back = at.velocity_m_per_s + at.acceleration_m_per_s2 * ray.since_s;
        let v_out = self.transmit_m_per_s;
        let (closing_out, closing_back) = (v_out.dot(ray.out), v_back.dot(ray.back));
        // What is nearer than a wavelength is no far field of anything; see [`crate::conditions`].
        let at_least = |range_m: f64| range_m.max(self.one_way.wavelength_m);
        let transmit = Leg {
            ray_m: ray.out * at_least(ray.out_range_m),
            velocity_m_per_s: v_out,
            acceleration_m_per_s2: self.transmit_m_per_s2,
        };
        let receive = Leg {
            ray_m: ray.back * at_least(ray.back_range_m),
            velocity_m_per_s: v_back,
            acceleration_m_per_s2: at.acceleration_m_per_s2,
        };
        let mut change = transmit.with(&receive, self.pulse_s);
        // Elements between the ends may be nearer.
        let ends_m = ray.out_range_m.min(ray.back_range_m);
        let nearest_m = self.line_distance_m(ray, at);
        if nearest_m < NEAR_LINE * ends_m {
            let closest_m = (ray.back * ray.back_range_m).dot(at.axis);
            for distances in NEAR_PLACES {
                let along_m = self.on_line_m(closest_m + distances * nearest_m);
                let ray_m = ray.back * ray.back_range_m - at.axis * along_m;
                let between = Leg {
                    ray_m: ray_m.normalize_or_zero() * at_least(ray_m.length()),
                    ..receive
                };
                let there = transmit.with(&between, self.pulse_s);
                for (value, there) in change.iter_mut().zip(there) {
                    *value = if there.abs() > value.abs() {
                        there
                    } else {
                        *value
                    };
                }
            }
        }
        EchoMotion {
            values: [
                (ray.here_m - self.at[0].position_m).dot(ray.back),
                0.5 * (closing_out + closing_back),
                change[0],
                change[1],
                at.acceleration_m_per_s2.dot(ray.back),
                at.turning_m_per_s.dot(ray.back),
                self.transmit_change_m_per_s2
                    .dot(ray.out)
                    .abs()
                    .max(at.change_m_per_s2.dot(ray.back).abs()),
                0.5 * (self.transmit_unsteady_m_per_s2.dot(ray.out)
                    + at.unsteady_m_per_s2.dot(ray.back)),
                change[0],
                0.0,
                0.0,
            ],
            across_m_per_s: closing_back - v_back.dot(at.axis) * at.axis.dot(ray.back),
        }
    }

    pub(super) fn accumulate(
        &self,
        plan: &PingPlan,
        scatterers: &Scatterers,
        energies: &Energies,
        part_s: f64,
        parts: &mut [Part],
        mut begins_with: impl FnMut(f64, f64, &[f64; TRACKED]),
    ) {
        // Of a pulse, in parts.
        let length = plan.pulse.duration_s / part_s;
        let floor = plan.model.cull_db.map_or(0.0, amplitude_from_db);
        let curve = scatterers.curve.as_deref();
        for (i, weight) in sampled(scatterers, SAMPLE_SIZE) {
            let law = scatterers.law[i];
            let place_m = scatterers.position_m(i);
            let ray = self.ray(scatterers.transmit_m(i), place_m, plan.sound_speed_m_per_s);
            let (out, back) = (ray.out, ray.back);
            let at = &self.at[ray.instant];
            let begins = (ray.out_range_m + ray.back_range_m) / plan.sound_speed_m_per_s / part_s;
            if begins as usize >= parts.len() {
                continue;
            }
            let towards = |d: &Directivity, m: &DMat3, ray: DVec3| {
                let u = *m * ray;
                d.towards(u.x, u.y, u.z)
            };
            let (response, off) = match &self.legs {
                Some(legs) => self.heard(plan, legs, &ray),
                None => (towards(&self.element, &at.array_from_world, back), [0.0; 2]),
            };
            let level = response * towards(&self.transmit_leg, &self.transmit_from_world, out);
            let floor = plan
                .range_floors
                .at(floor, half_path_m(scatterers, i, self.transmit_m));
            if level.abs() * f64::from(scatterers.loud[i]) < floor {
                continue;
            }
            let facing = |normal: [f32; 3], ray: DVec3| {
                (-DVec3::from_array(normal.map(f64::from)).dot(ray)).max(0.0)
            };
            let facing_out = facing(scatterers.transmit_normal(i), out);
            let facing_back = facing(scatterers.normal[i], back);
            let law = match law {
                ScatterLaw::Point | ScatterLaw::Water => 1.0,
                ScatterLaw::Lambert => (facing_out * facing_back).sqrt(),
                ScatterLaw::LambertOneWay => facing_out,
                ScatterLaw::Curve => curve.map_or(0.0, |curve| {
                    curve.half(facing_out.sqrt().min(1.0)) * curve.half(facing_back.sqrt().min(1.0))
                }),
            };
            let amplitude = level
                * law
                * self.one_way.amplitude(ray.out_range_m)
                * self.one_way.amplitude(ray.back_range_m);
            let energy = weight * amplitude * amplitude * scatterers.strength[i].norm_sqr();
            let mut echo = self.motion(&ray);
            [echo.values[OFF_PATH], echo.values[OFF_VELOCITY]] = off;
            let first = &mut parts[begins as usize];
            first.echoes += weight;
            first.begun += energy;
            begins_with(begins * part_s, energy, &echo.values);
            first.begun2 += energy * energy;
            let mut from = energies.upto[0];
            for (k, part) in parts.iter_mut().enumerate().skip(begins as usize) {
                let share = (((k + 1) as f64 - begins) / length).min(1.0);
                let to = energies.upto(share);
                part.add((&from, &to), (energy, energy / weight), &echo);
                if share == 1.0 {
                    break;
                }
                from = to;
            }
        }
    }
}

/// Of all pairs of scatterer and element.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Shares {
    /// Above the floor as the transmitter sees them: these are walked.
    pub transmit_leg: f64,
    /// ... and as the element hears them: these are summed.
    pub kept: f64,
}

impl Shares {
    pub(crate) const ALL: Self = Self {
        transmit_leg: 1.0,
        kept: 1.0,
    };
}

/// What the pattern floors leave. `cull_db`: the one of the model.
pub(crate) fn kept_shares(
    spec: &SonarSpec,
    plan: &PingPlan,
    scatterers: &Scatterers,
    cull_db: f64,
) -> Shares {
    let floor = amplitude_from_db(cull_db);
    let (mut all, mut transmit_leg, mut kept) = (0.0, 0.0, 0.0);
    let stride = scatterers.len().div_ceil(SAMPLE_SIZE).max(1);
    let poses = Poses::of(&plan.trajectory);
    for array in &spec.receive {
        let transmit = &spec.transmit[array.transmit];
        let receiver = ReceivingElement::new(spec, (plan, &poses), transmit, (array, 0), 1);
        let at = &receiver.at[0];
        let pairs = array.elements as f64;
        for i in (0..scatterers.len()).step_by(stride) {
            let place_m = scatterers.position_m(i);
            let out_m = scatterers.transmit_m(i) - receiver.transmit_m;
            let out = receiver.transmit_from_world * out_m.normalize_or_zero();
            let back = at.array_from_world * (place_m - at.position_m).normalize_or_zero();
            let loud = f64::from(scatterers.loud[i]);
            let sent = (receiver.transmit_leg.towards(out.x, out.y, out.z) * loud).abs();
            let level = (sent * receiver.element.towards(back.x, back.y, back.z)).abs();
            let floor = plan
                .range_floors
                .at(floor, half_path_m(scatterers, i, receiver.transmit_m));
            all += pairs;
            transmit_leg += if sent >= floor { pairs } else { 0.0 };
            kept += if level >= floor { pairs } else { 0.0 };
        }
    }
    let share = |sum: f64| if all > 0.0 { sum / all } else { 0.0 };
    Shares {
        transmit_leg: share(transmit_leg),
        kept: share(kept),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::f64::consts::TAU;

    use glam::DQuat;
    use num_complex::Complex64;
    use rand_chacha::ChaCha8Rng;
    use rand_chacha::rand_core::{Rng, SeedableRng};

    /// Samples of a window.
    const SAMPLES: usize = 6;

    /// Windows of so many echoes at random phases, with amplitudes from `amplitudes` and errors that differ from echo to echo: the largest error of
    /// many windows is below the prediction, and not far below. Independent of the model: samples are drawn and summed.
    #[test]
    fn the_worst_of_many_windows_is_predicted() {
        let trials = 20_000;
        let mut chance = ChaCha8Rng::seed_from_u64(7);
        let mut turn = || TAU * f64::from(chance.next_u32()) / 2f64.powi(32);
        for amplitudes in [
            &[1.0][..],
            &[1.0, 0.3],
            &[1.0, 0.8],
            &[1.0, 0.7, 0.5],
            &[1.0; 40],
        ] {
            let phases: Vec<f64> = (0..amplitudes.len())
                .map(|i| 1e-3 * (1.0 + (i as f64 * 0.618).fract()))
                .collect();
            let mut worst = 0.0f64;
            for _ in 0..trials {
                let mut got = [Complex64::ZERO; SAMPLES];
                let mut off = [Complex64::ZERO; SAMPLES];
                for (amplitude, phase) in amplitudes.iter().zip(&phases) {
                    for k in 0..SAMPLES {
                        let sample = Complex64::from_polar(*amplitude, turn());
                        got[k] += sample;
                        off[k] += sample * phase;
                    }
                }
                let energy = |all: &[Complex64]| all.iter().map(|x| x.norm_sqr()).sum::<f64>();
                worst = worst.max((energy(&off) / energy(&got)).sqrt());
            }
            let mut window = Part::default();
            for _ in 0..PARTS {
                let mut part = Part::default();
                for (amplitude, phase) in amplitudes.iter().zip(&phases) {
                    let energy = amplitude * amplitude / PARTS as f64;
                    part.energy += energy;
                    part.loudest = part.loudest.max(amplitude * amplitude);
                    part.loudest_here = part.loudest_here.max(energy);
                    part.sums[0] += energy * phase;
                    part.squares[0] += energy * phase * phase;
                }
                window = window.and(&part);
            }
            let looks = f64::from(trials).ln();
            let (amounts, _) = window.amounts(&[1.0; GROWTHS], 1e-9, looks, SAMPLES as f64);
            println!("{amplitudes:?}: {worst:.2e}, predicted {:.2e}", amounts[0]);
            // A lone echo is predicted exactly.
            assert!(
                worst <= amounts[0] * (1.0 + 1e-9),
                "{amplitudes:?}: {worst:e} > {:e}",
                amounts[0]
            );
            assert!(
                amounts[0] <= 6.0 * worst,
                "{amplitudes:?}: {:e} of {worst:e}",
                amounts[0]
            );
        }
    }

    /// Echoes of 32 samples that begin together: alone a sample is much of what a window holds, among a hundred little.
    #[test]
    fn lone_echoes_are_prominent_and_those_of_a_crowd_are_not() {
        let by_error = |echoes: f64| {
            let mut parts = vec![Part::default(); 4 * PARTS];
            parts[PARTS].echoes = echoes;
            for part in &mut parts[PARTS..2 * PARTS] {
                part.energy = echoes / PARTS as f64;
                part.loudest = 1.0;
            }
            let mut prominent = Prominent::default();
            prominent.count(&parts, 1e-9, 1.0 / 32.0, 3.0);
            prominent.by_error
        };
        // The least that a window has is a quarter of the echoes.
        for (echoes, largest) in [
            (1.0f64, (4.0f64 / 32.0).sqrt()),
            (100.0, (0.04f64 / 32.0).sqrt()),
        ] {
            for (k, count) in by_error(echoes).into_iter().enumerate() {
                let level = libm::exp2(-(k as f64 + 1.0));
                let want = if largest > level { 3.0 * echoes } else { 0.0 };
                assert_eq!(count, want, "{echoes}, above {level}");
            }
        }
    }

    /// Legs of a platform that flies past: far away the third derivatives, near by all that is left beyond the leading edge's rate.
    #[test]
    fn what_a_pulse_leaves_of_a_range_is_its_third_derivative_or_all_of_it() {
        let pulse_s = 5e-3;
        let leg = |ray_m: DVec3| Leg {
            ray_m,
            velocity_m_per_s: DVec3::new(6.0, -2.0, 0.5),
            acceleration_m_per_s2: DVec3::new(0.4, 0.7, -1.0),
        };
        let transmit = leg(DVec3::new(5.0, 9.0, 4.0));
        let receive = leg(DVec3::new(6.0, 8.0, 4.0));
        let third = |leg: &Leg| {
            // At mid-pulse: r''' = 3 (v.a - r' r'')/r.
            let a = leg.acceleration_m_per_s2;
            let v = leg.velocity_m_per_s + a * (0.5 * pulse_s);
            let [range_m, rate, second] = leg.at(0.5 * pulse_s);
            3.0 * (v.dot(a) - rate * second) / range_m
        };
        let [_, got] = transmit.with(&receive, pulse_s);
        let want = 0.5 * (third(&transmit) + third(&receive));
        println!("far: {got:.4e}, {want:.4e}");
        assert!((got.abs() / want.abs() - 1.0).abs() < 0.01, "{got} {want}");

        let near = Leg {
            acceleration_m_per_s2: DVec3::ZERO,
            ..leg(DVec3::new(0.03, 0.09, 0.0))
        };
        let [_, got] = near.with(&near, pulse_s);
        let off_m = got * (0.5 * pulse_s).powi(3) / 3.0;
        let end_m = (near.ray_m - near.velocity_m_per_s * pulse_s).length();
        let rate = -near.velocity_m_per_s.dot(near.ray_m) / near.ray_m.length();
        let want_m = 2.0 * (end_m - near.ray_m.length() - rate * pulse_s);
        println!("near: {off_m:.4e} m, {want_m:.4e} m");
        assert!((off_m / want_m - 1.0).abs() < 1e-9, "{off_m} {want_m}");
    }

    /// A step of the acceleration, anywhere in a pulse, against the parabola with the velocities of both ends.
    #[test]
    fn an_unsteady_track_is_off_by_no_more_than_its_shape() {
        for at in [0.05, 0.3, 0.5, 0.8, 0.95] {
            let off = |t: f64| 0.5 * ((t - at).max(0.0).powi(2) - (1.0 - at) * t * t);
            for k in 0..=50 {
                let t = f64::from(k) / 50.0;
                let share = off(t) / off(1.0);
                assert!(
                    share <= Growth::Unsteady.at(t) + 1e-12,
                    "{at}, {t}: {share}"
                );
            }
        }
    }

    #[test]
    fn closing_speeds_lie_apart_in_a_window_of_several_parts() {
        let part = |closing: &[f64]| {
            let mut part = Part::default();
            for &closing in closing {
                part.closing_m_per_s = part.closing_m_per_s.and(Extremes(closing, closing));
            }
            part
        };
        let apart = |parts: &[Part]| {
            let window = parts.iter().fold(Part::default(), Part::and);
            window.closing_m_per_s.apart()
        };
        assert_eq!(apart(&[part(&[-3.0]), part(&[]), part(&[-1.0, -2.0])]), 2.0);
        assert_eq!(apart(&[part(&[5.0]), part(&[])]), 0.0);
        assert_eq!(apart(&[part(&[])]), 0.0);
    }

    /// A track that bends after the end of the record, which cuts the pulse.
    #[test]
    fn a_track_counts_only_as_far_as_it_is_heard() {
        let knot = |time_s: f64, north_m: f64, rate: f64| VectorKnot {
            time_s,
            value: DVec3::X * north_m,
            rate_per_s: DVec3::X * rate,
        };
        let mut trajectory = Trajectory::uniform(DVec3::ZERO, DVec3::X, DQuat::IDENTITY);
        trajectory.position = vec![
            knot(0.0, 0.0, 1.0),
            knot(0.02, 0.02, 1.0),
            knot(0.04, 0.04, 1.5),
        ];
        let (pulse_s, t_s, heard_s) = (5e-3, 0.0165, 0.018);
        let at = |heard_s: f64| {
            let poses = Poses::of(&trajectory);
            unsteady_m_per_s2(&poses, pulse_s, DVec3::ZERO, (t_s, heard_s)).length()
        };
        let (cut, whole) = (at(heard_s), at(0.05));
        println!("{cut:.3e} of {whole:.3e} m/s^2");
        assert!(cut > 0.0 && cut < 0.5 * whole, "{cut} {whole}");
        // The parabola leaves what it takes from the bend: the platform moves evenly up to there.
        let mean = (trajectory.pose_at(t_s + pulse_s).velocity_m_per_s.x - 1.0) / pulse_s;
        for k in 1..=20 {
            let s = f64::from(k) / 20.0 * (heard_s - t_s);
            let off_m = 0.5 * mean.abs() * s * s;
            let bound_m = cut * pulse_s * pulse_s / 8.0 * Growth::Unsteady.at(s / pulse_s);
            assert!(off_m <= bound_m * (1.0 + 1e-6), "{s}: {off_m} {bound_m}");
        }
        assert_eq!(at(t_s), 0.0);
    }

    /// A track of constant jerk with the mean acceleration of the pulse, whole and cut by the end of the record; and a model without acceleration, whose
    /// velocity is off too.
    #[test]
    fn velocities_are_off_by_the_way_that_is_left() {
        let [speed, acceleration, jerk] = [3.0, 0.5, 20.0];
        let moved_m = |t: f64| speed * t + acceleration * t * t / 2.0 + jerk * t * t * t / 6.0;
        let velocity = |t: f64| speed + acceleration * t + jerk * t * t / 2.0;
        let mut track = Trajectory::uniform(DVec3::ZERO, DVec3::X, DQuat::IDENTITY);
        track.position = [0.0, 0.1]
            .map(|time_s| VectorKnot {
                time_s,
                value: DVec3::X * moved_m(time_s),
                rate_per_s: DVec3::X * velocity(time_s),
            })
            .to_vec();
        let (t_s, pulse_s) = (0.02, 0.01);
        let pose = track.pose_at(t_s);
        let off = |of_model, until_s: f64| {
            let of = (DVec3::ZERO, of_model);
            let upto_s = (until_s, pulse_s);
            off_velocities(|t_s| track.pose_at(t_s), of, (&pose, t_s), upto_s).map(|v| v.x)
        };
        // Of a cubic: x(s) = v s + a s^2/2 + j s^3/6, less the parabola with a + j T/2.
        for until_s in [pulse_s, 0.5 * pulse_s] {
            let upto = |s: f64| jerk * s * s / 6.0 - jerk * pulse_s * s / 4.0;
            let want = [0.0, upto(0.5 * until_s), upto(until_s)];
            let got = off(None, until_s);
            println!("{until_s} s: {got:?} m/s");
            for (got, want) in got.into_iter().zip(want) {
                assert!((got - want).abs() < 1e-9, "{until_s}: {got:e} {want:e}");
            }
        }
        let slow = [DVec3::X * (velocity(t_s) - 0.1), DVec3::ZERO];
        let upto = |s: f64| (moved_m(t_s + s) - moved_m(t_s)) / s - slow[0].x;
        let want = [0.1, upto(0.5 * pulse_s), upto(pulse_s)];
        for (got, want) in off(Some(slow), pulse_s).into_iter().zip(want) {
            assert!((got - want).abs() < 1e-9, "{got:e} {want:e}");
        }
    }

    /// Whatever share of an echo its end is, the last sample has what its phase has grown to.
    #[test]
    fn the_last_sample_is_known_from_any_share_of_an_echo() {
        let energies = Energies::new(&Pulse {
            kind: echotank_core::pulse::PulseKind::Cw,
            center_frequency_hz: 100e3,
            bandwidth_hz: 0.0,
            duration_s: 1e-3,
            taper: 0.0,
        });
        for share in [0.25, 0.4, 0.7, 1.0] {
            let begin = 1.0 - share;
            // Means over the share, of the growth's square.
            let linear = (1.0 - begin * begin * begin) / share;
            let square = (1.0 - f64::powi(begin, 5)) / share;
            for (growth, rms, last) in [
                (Growth::Linear, linear.sqrt(), 3f64.sqrt()),
                (Growth::Square, square.sqrt(), 5f64.sqrt()),
            ] {
                let got = rms * energies.last_over(growth, share);
                println!("{share}: {got:.3} of {last:.3}");
                assert!((got / last - 1.0).abs() < 0.02, "{share}: {got} {last}");
            }
        }
    }

    /// Points that ask for the same instants, and one that asks for others from the third on.
    #[test]
    fn kept_poses_are_those_of_the_trajectory() {
        let track = Trajectory::uniform(DVec3::ZERO, DVec3::X, DQuat::IDENTITY);
        let poses = Poses::of(&track);
        for asked in [
            &[0.0, 0.5, 1.0][..],
            &[0.0, 0.5, 1.0],
            &[0.0, 0.5, 2.0, 3.0],
            &[0.0],
        ] {
            poses.rewind();
            for &t_s in asked {
                assert_eq!(poses.at(t_s), track.pose_at(t_s));
                assert_eq!(poses.from(DVec3::X, t_s), track.pose_from(DVec3::X, t_s));
            }
        }
        assert_eq!(poses.known.borrow().len(), 8);
    }

    #[test]
    fn knots_are_those_within_the_interval() {
        let mut track = Trajectory::uniform(DVec3::ZERO, DVec3::X, DQuat::IDENTITY);
        let knot = |k: u32| VectorKnot {
            time_s: f64::from(k),
            value: DVec3::ZERO,
            rate_per_s: DVec3::ZERO,
        };
        track.position = (0..40).map(knot).collect();
        track.heave = vec![knot(3)];
        track.attitude[0].time_s = 4.0;
        let between = |from_s: f64, to_s: f64| knots_s(&track, from_s, to_s).collect::<Vec<_>>();
        assert_eq!(between(1.5, 4.0), [2.0, 3.0, 3.0]);
        assert_eq!(between(3.5, 4.5), [4.0, 4.0]);
        assert_eq!(between(10.0, 39.0).len(), MAX_LOOKS as usize);
    }

    /// Under a full taper the ends of a pulse hardly sound. The third order of a sharp pulse has a mean square of 1/7.
    #[test]
    fn flanks_take_the_ends_of_a_pulse() {
        let of = |taper: f64| {
            Energies::new(&Pulse {
                kind: echotank_core::pulse::PulseKind::Cw,
                center_frequency_hz: 100e3,
                bandwidth_hz: 0.0,
                duration_s: 1e-3,
                taper,
            })
        };
        let cubic = Growth::Cubic as usize;
        let whole = |energies: &Energies| energies.upto[STEPS][SQUARED + cubic];
        let sharp = of(0.0);
        assert!(
            (7.0 * whole(&sharp) - 1.0).abs() < 1e-3,
            "{}",
            whole(&sharp)
        );
        // Over a quarter at an end, (1 - 2^-7)/(14/4).
        assert!(
            (sharp.last[cubic] - 1.88).abs() < 0.05,
            "{}",
            sharp.last[cubic]
        );
        let (all, energy) = (0..10_000).fold((0.0, 0.0), |(all, energy), k| {
            let t = (f64::from(k) + 0.5) / 1e4;
            let level = (TAU / 2.0 * t).sin().powi(4);
            (all + level * (2.0 * t - 1.0).powi(6), energy + level)
        });
        let smooth = whole(&of(1.0));
        assert!((smooth * energy / all - 1.0).abs() < 1e-2, "{smooth}");
    }
}

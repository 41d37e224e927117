//! Parameters of one task: the number of terms of each series, and the model of an echo beyond the
//! plane wave.

use std::f64::consts::TAU;

use num_complex::Complex64;

use crate::array::phasor::cis;

use super::engine::{LineEngine, Orders, PulseMotion, Section};
use super::lanes::BLOCK;
use super::merge::{MIDWAY, Merge};
use super::panel::PANEL;
use super::pulse::{MAX_INSTANTS, PulseSpectra};
use super::sample::Sample;
use super::series::{chebyshev_terms as chebyshev, sizes, terms_needed};
use super::smooth::{Echoes, GAIN_TERMS, Smooth, Span};

/// Maximum number of terms of each series. A larger remainder is reported as error.
pub(crate) const MAX_ALONG: usize = 16;
const MAX_BAND: usize = 10;
pub(crate) const MAX_DILATION: usize = MAX_INSTANTS;
pub(crate) const MAX_CURVATURE_TERMS: usize = 8;
pub(crate) const MAX_TURN: usize = 12;
pub(crate) const MAX_RATE_GRADIENT_TERMS: usize = 4;
const MAX_NODES: usize = 16;
const MAX_PRODUCTS: usize = KINDS * MAX_CURVATURE_TERMS * MAX_RATE_GRADIENT_TERMS;
/// Maximum number of products of the series, and of channels of the grid.
pub(super) const MAX_CHANNELS: usize = 96;
/// Error of the merged products, as a share of the truncation error allowed per series.
const MERGED: f64 = 1.0;
/// Smallest weight of a product's template.
const MIN_WEIGHT: f64 = 1e-9;

/// Size of a kind that gets no channels, as a share of the truncation error allowed per series.
const KIND_SHARE: f64 = 0.5;
/// Largest value of a kind in a window relative to a sample of echoes.
const KIND_PEAK: f64 = 3.0;

/// Step of the finite differences for the derivatives of 1/D, cycles per column. The derivatives
/// appear in terms of fourth order.
const STEP_NU: f64 = 1e-3;

/// Values of an echo beyond its slope: inverse range, and residual rate gradient relative to its
/// maximum.
#[derive(Clone, Copy)]
pub(crate) struct Ray {
    pub(crate) per_range_per_m: f64,
    pub rate_gradient: f64,
    pub kind: Kind,
}

/// Kinds of values in a channel.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(super) enum Kind {
    /// The echoes themselves.
    #[default]
    Whole,
    /// Gain slope (0) and gain curvature (1).
    Gain(usize),
    /// The residual acceleration.
    Acceleration,
}

/// Number of kinds.
pub(super) const KINDS: usize = 2 + GAIN_TERMS;

/// Channels of one kind times one term of the curvature times one of the rate gradient.
#[derive(Clone, Copy, Default)]
pub(super) struct ChannelProduct {
    /// Index in [`Task::kinds`].
    pub kind: usize,
    pub curvature: usize,
    pub rate_gradient: usize,
    /// Number of terms of the dilation, from the first.
    pub dilation: usize,
}

/// Parameters of one task.
pub(crate) struct Task<'a, T: Sample> {
    pub engine: &'a LineEngine<T>,
    pub pulse: &'a PulseSpectra<T>,
    pub section: &'a Section,
    pub smooth: Smooth,
    pub orders: Orders,
    /// Slopes at which the shape is computed; columns interpolate between them.
    pub nodes: usize,
    kinds: [Kind; KINDS],
    /// Products of kinds and terms of curvature and rate gradient that have channels, with their
    /// number of terms of the dilation.
    kept: [ChannelProduct; MAX_PRODUCTS],
    kept_len: usize,
    merged: usize,
    pub left_out: f64,
    /// Slope per column, index of the first column, number of columns.
    pub step: f64,
    pub first: isize,
    pub columns: usize,
}

impl<'a, T: Sample> Task<'a, T> {
    /// Chooses the parameters from `smooth`, the fit to the surveyed `echoes`. Sets `merge` to the
    /// channels of this task.
    pub(super) fn new(
        engine: &'a LineEngine<T>,
        section: &'a Section,
        smooth: Smooth,
        echoes: &Echoes,
        merge: &mut Merge,
    ) -> Self {
        let ping = &engine.ping;
        let c = ping.sound_speed_m_per_s;
        // The aperture, extended by the motion along the line during the emission.
        let drift_m = 0.5 * ping.duration_s * c * smooth.dilation1.abs();
        let reach_m = (section.half_m + drift_m).max(0.25 * c / ping.carrier_hz);
        let step = c / (engine.top_hz() * 2.0 * engine.resolution.slope_oversampling * reach_m);
        let kernel = &engine.slope_kernel;
        let cell = |slope: f64| (slope / step + kernel.shift()).floor() as isize;
        let first = cell(smooth.slope.at(-1.0)) + kernel.first();
        let last = cell(smooth.slope.at(1.0)) + kernel.first() + kernel.width as isize - 1;
        let mut task = Self {
            engine,
            pulse: engine.pulse.as_ref().expect("prepared"),
            section,
            smooth,
            orders: Orders::default(),
            nodes: 1,
            kinds: [Kind::Whole; KINDS],
            kept: [ChannelProduct::default(); MAX_PRODUCTS],
            kept_len: 0,
            merged: 0,
            left_out: 0.0,
            step,
            first,
            columns: (last - first + 1) as usize,
        };
        task.choose_orders(echoes, merge);
        task
    }

    /// Kinds that have channels.
    pub(super) fn kinds(&self) -> &[Kind] {
        &self.kinds[..self.orders.kinds]
    }

    /// Whether any of them is a change of strength.
    pub(super) fn gain_terms(&self) -> bool {
        self.kinds()
            .iter()
            .any(|kind| matches!(kind, Kind::Gain(_)))
    }

    /// Size of a kind relative to the echo.
    fn size_of(&self, kind: Kind) -> f64 {
        match kind {
            Kind::Whole => 1.0,
            Kind::Gain(order) => self.smooth.gain_variation[order],
            Kind::Acceleration => self.smooth.acceleration_rest * self.rad_per_acceleration(),
        }
    }

    /// Phase per acceleration at the ends of the pulse.
    pub(crate) fn rad_per_acceleration(&self) -> f64 {
        let per_m = TAU * self.engine.top_hz() / self.engine.ping.sound_speed_m_per_s;
        let half_s = 0.5 * self.engine.ping.duration_s;
        match self.engine.resolution.motion {
            PulseMotion::Stretch => 0.0,
            PulseMotion::Quadratic => 0.5 * per_m * half_s * half_s,
        }
    }

    pub(super) fn half_m(&self) -> f64 {
        // A single element has no length to scale by.
        self.section.half_m.max(1e-6)
    }

    pub(crate) fn absolute_hz(&self, band: f64) -> f64 {
        self.engine.ping.carrier_hz + 0.5 * self.engine.rate_hz * band
    }

    /// Factor of an echo beyond the plane wave, at `x` (relative to half the section), `w` (half
    /// the pulse) and `band` (half the band).
    fn beyond_plane(&self, s: f64, ray: Ray, x: f64, w: f64, band: f64) -> Complex64 {
        let ping = &self.engine.ping;
        let c = ping.sound_speed_m_per_s;
        let (y, t) = (x * self.section.half_m, w * 0.5 * ping.duration_s);
        let per_range = ray.per_range_per_m;
        // Polynomials in the slope, which continue smoothly for columns beside the echoes' slopes,
        // even beyond endfire.
        let curvature = per_range * (1.0 - s * s);
        let (rate_gradient, acceleration) = (
            self.smooth.rate_gradient.at(s),
            self.smooth.acceleration.at(s),
        );
        let rate_gradient_rest = ray.rate_gradient * self.smooth.rate_gradient_rest;
        let quadratic = match self.engine.resolution.motion {
            PulseMotion::Stretch => 0.0,
            PulseMotion::Quadratic => 1.0,
        };
        // Second order of the delay, and the third order that follows from the change of range
        // along the line.
        let path_m = per_range * t * (rate_gradient * y + 0.5 * quadratic * acceleration * t)
            + rate_gradient_rest * y * t
            + c * self.smooth.bow(s) * t
            + curvature * y * y * 0.5 * (1.0 + s * y * per_range)
            + 1.5
                * s
                * per_range
                * per_range
                * y
                * t
                * (rate_gradient * y + quadratic * acceleration * t);
        let (cos, sin) = cis(-self.absolute_hz(band) / c * path_m);
        let level = match ray.kind {
            Kind::Whole => {
                let shared = self.smooth.shared_gain_slope(s, per_range);
                1.0 + y * (s * (per_range + ping.nepers_per_m) + shared)
            }
            Kind::Gain(order) => x.powi(order as i32 + 1),
            Kind::Acceleration => {
                // To first order, relative to the largest residual.
                let turned = self.absolute_hz(band) / self.engine.top_hz() * w * w;
                return Complex64::new(turned * sin, -turned * cos);
            }
        };
        Complex64::new(level * cos, level * sin)
    }

    /// Weight of the column at slope `s`, divided by the kernel's spectrum at `x` at rest.
    ///
    /// A column also represents echoes beside it. Let Y be the position along the aperture in
    /// cycles per unit of slope, and D the spectrum of the kernel. exp(j 2pi Y s) has the weights
    /// exp(j 2pi Y s_k) / D(Y), and differentiation by Y gives those of s exp(j 2pi Y s). A factor
    /// g(s) therefore needs g/D + g' (1/D)'/(j 2pi) + g''/2 (1/D)''/(j 2pi)^2 + ...
    pub(super) fn shape(&self, s: f64, ray: Ray, x: f64, w: f64, band: f64) -> Complex64 {
        let ping = &self.engine.ping;
        let c = ping.sound_speed_m_per_s;
        let per_column = self.absolute_hz(band) / c * self.step;
        let y = x * self.section.half_m;
        let moved_m = y - c * self.smooth.dilation1 * w * 0.5 * ping.duration_s;
        let nu = moved_m * per_column;
        let inverse = |nu: f64| self.engine.slope_inverse.at(nu);
        let at = inverse(nu);
        let (before, after) = (inverse(nu - STEP_NU), inverse(nu + STEP_NU));
        let first = (after - before) / (2.0 * STEP_NU);
        let second = (after + before - 2.0 * at) / (STEP_NU * STEP_NU);

        let g = |columns: f64| self.beyond_plane(s + columns * self.step, ray, x, w, band);
        let (here, left, right) = (g(0.0), g(-0.5), g(0.5));
        let slope = right - left;
        let curve = (left + right - here * 2.0) * 4.0;
        let turn = Complex64::new(0.0, -1.0 / TAU);
        (here * at + slope * turn * first + curve * (turn * turn * (0.5 * second)))
            * (1.0 / inverse(y * per_column))
    }

    fn choose_orders(&mut self, echoes: &Echoes, merge: &mut Merge) {
        let ping = &self.engine.ping;
        let half_m = self.section.half_m;
        // The truncation error of a series is as smooth over the slope as its kept part, so the
        // kernel's spectrum cancels from it too.
        let tolerance = self.engine.resolution.series.max(1e-13);
        let slopes = [-1.0, 0.0, 1.0].map(|x| self.smooth.slope.at(x));
        let inverse_ranges = [-1.0, 1.0].map(|x| self.smooth.per_range_per_m.at(x));
        let mut left_out: f64 = 0.0;
        // f of the coordinate, slope, ray and the sign of the others.
        let mut most = |f: &dyn Fn(f64, f64, Ray, f64) -> Complex64, limit: usize| {
            let (mut terms, mut rest) = (1, 0.0f64);
            for s in slopes {
                for per_range_per_m in inverse_ranges {
                    for sign in [-1.0, 1.0] {
                        let ray = Ray {
                            per_range_per_m,
                            rate_gradient: sign,
                            kind: Kind::Whole,
                        };
                        let got = terms_needed(|x| f(x, s, ray, sign), limit, tolerance);
                        terms = terms.max(got.0);
                        rest = rest.max(got.1);
                    }
                }
            }
            left_out += rest;
            terms
        };
        let rest_rad = self.rest_rad(1.0);
        let beyond = |angle: f64| Complex64::from_polar(1.0, -angle);
        let bent = |ray: Ray, b: f64| Ray {
            per_range_per_m: self.smooth.per_range_per_m.at(b),
            ..ray
        };
        let with_rate_gradient = |ray: Ray, rate_gradient: f64| Ray {
            rate_gradient,
            ..ray
        };
        let instants = most(
            &|w, s, ray, x| self.shape(s, ray, x, w, 1.0) * beyond(rest_rad * w),
            MAX_INSTANTS,
        );
        // Kinds that matter; everything beyond the last gain term is omitted with it.
        let mut kinds = 1;
        let mut unkept = 0.0;
        for kind in [Kind::Gain(0), Kind::Gain(1), Kind::Acceleration] {
            let size = self.size_of(kind);
            if size > KIND_SHARE * tolerance {
                self.kinds[kinds] = kind;
                kinds += 1;
            } else {
                unkept += size;
            }
        }
        let along = most(
            &|x, s, ray, w| self.shape(s, ray, x, w, 1.0),
            MAX_ALONG - GAIN_TERMS,
        );
        // The channels of a gain term have powers of their own.
        let along = along + if kinds > 1 { GAIN_TERMS } else { 0 };
        let curvature = most(
            &|b, s, ray, x| self.shape(s, bent(ray, b), x, x, 1.0),
            MAX_CURVATURE_TERMS,
        );
        let rate_gradient = most(
            &|z, s, ray, x| self.shape(s, with_rate_gradient(ray, z), x, x, 1.0),
            MAX_RATE_GRADIENT_TERMS,
        );
        let dilation = most(&|d, _, _, _| beyond(rest_rad * d), MAX_DILATION);
        let band = most(
            &|b, s, ray, x| self.shape(s, ray, x, x, b) * beyond(self.rest_rad(b)),
            MAX_BAND,
        );
        let all = self.slopes();
        let nodes = most(
            &|p, _, ray, x| self.shape(all.at(p), ray, x, x, 1.0),
            MAX_NODES,
        );
        let turn_rad = self.turn_rad(0, self.greatest_slope());
        // This truncation error has steps between blocks and spreads over the whole slab, so it is
        // compared with the weakest window of the slab.
        let turn = terms_of_turn(turn_rad.abs(), self.engine.resolution.far);
        self.orders = Orders {
            instants,
            kinds,
            along,
            turn,
            band,
            dilation,
            curvature,
            rate_gradient,
        };
        left_out += unkept;
        self.nodes = nodes;
        left_out += self.choose_channels(slopes, tolerance, echoes, merge);
        let per_m = TAU * self.engine.top_hz() / ping.sound_speed_m_per_s;
        // Fourth order of the delay along the section.
        left_out +=
            per_m * half_m.powi(4) / 8.0 * self.smooth.per_range_per_m.at(1.0).max(0.0).powi(3);
        self.left_out = left_out;
    }

    /// Omits products whose terms are jointly negligible, and merges the others into channels.
    /// Returns the total omitted.
    fn choose_channels(
        &mut self,
        slopes: [f64; 3],
        tolerance: f64,
        echoes: &Echoes,
        merge: &mut Merge,
    ) -> f64 {
        let Orders {
            dilation,
            curvature,
            rate_gradient,
            ..
        } = self.orders;
        let rest_rad = self.rest_rad(1.0);
        let dilation_sizes = sizes(|d| Complex64::from_polar(1.0, -rest_rad * d), dilation + 4);
        let (mut curvature_sizes, mut rate_gradient_sizes) = (
            [0.0f64; MAX_CURVATURE_TERMS],
            [0.0f64; MAX_RATE_GRADIENT_TERMS],
        );
        let widen = |most: &mut [f64], found: &[f64]| {
            for (most, size) in most.iter_mut().zip(found) {
                *most = most.max(*size);
            }
        };
        for s in slopes {
            for x in [-1.0, 1.0] {
                let at = |b: f64, rate_gradient: f64| {
                    let per_range_per_m = self.smooth.per_range_per_m.at(b);
                    self.shape(
                        s,
                        Ray {
                            per_range_per_m,
                            rate_gradient,
                            kind: Kind::Whole,
                        },
                        x,
                        x,
                        1.0,
                    )
                };
                widen(&mut curvature_sizes, &sizes(|b| at(b, 0.0), curvature + 4));
                widen(
                    &mut rate_gradient_sizes,
                    &sizes(|z| at(0.0, z), rate_gradient + 4),
                );
            }
        }
        let products = self.orders.kinds * curvature * rate_gradient;
        let mut share = tolerance / products as f64;
        let left_out = loop {
            let (channels, left_out) = self.keep(
                share,
                &dilation_sizes[..dilation],
                &curvature_sizes,
                &rate_gradient_sizes,
            );
            // If there are too many, the accuracy of all is reduced alike.
            if channels <= MAX_CHANNELS {
                break left_out;
            }
            share *= 1.5;
        };
        let weights = self.products().map(|(kept, r)| {
            (dilation_sizes[r]
                * curvature_sizes[kept.curvature]
                * rate_gradient_sizes[kept.rate_gradient])
                .max(MIN_WEIGHT)
        });
        let (every, looked) = Merge::sample(echoes.len());
        let midway = Merge::midway(looked);
        merge.start(weights, looked + midway);
        self.look(echoes, every, looked, merge);
        let unmerged = merge.choose(MERGED * tolerance, self.engine.simd_level);
        for (number, kind) in self.kinds().iter().enumerate() {
            if matches!(kind, Kind::Gain(_)) {
                let products = self.products().enumerate();
                let of_kind = products.filter(|(_, (kept, _))| kept.kind == number);
                let peak = (KIND_PEAK * self.size_of(*kind)).min(1.0);
                merge.keep_apart(of_kind.map(|(product, _)| product), peak);
            }
        }
        self.merged = merge.count;
        left_out + unmerged
    }

    /// Computes the products of all echoes in the process, except the gain terms.
    fn look(&self, echoes: &Echoes, every: usize, looked: usize, merge: &mut Merge) {
        let per = |half: f64| if half > 0.0 { 1.0 / half } else { 0.0 };
        let smooth = &self.smooth;
        let (per_dilation, per_rate_gradient) =
            (per(smooth.dilation_rest), per(smooth.rate_gradient_rest));
        let per_curvature = per(smooth.per_range_per_m.half);
        let per_acceleration = self.rad_per_acceleration();
        let own = |i: usize| {
            let (s, per_range) = (echoes.slope[i], echoes.per_range_per_m[i]);
            [
                smooth.rest(echoes, i) * per_dilation,
                (per_range - smooth.per_range_per_m.middle) * per_curvature,
                (echoes.rate_gradient_per_s[i] - per_range * smooth.rate_gradient.at(s))
                    * per_rate_gradient,
                (echoes.acceleration_m_per_s2[i] - per_range * smooth.acceleration.at(s))
                    * per_acceleration,
            ]
        };
        let all = looked + Merge::midway(looked);
        let products = merge.products_mut();
        for k in 0..all {
            let [dilation, curvature, rate_gradient, acceleration] = match k.checked_sub(looked) {
                None => own(k * every),
                Some(between) => {
                    let (a, b) = (
                        own(between * MIDWAY * every),
                        own((between * MIDWAY + 1) * every),
                    );
                    std::array::from_fn(|j| 0.5 * (a[j] + b[j]))
                }
            };
            let of_dilation = chebyshev::<f64, MAX_DILATION>(dilation, self.orders.dilation);
            let of_curvature =
                chebyshev::<f64, MAX_CURVATURE_TERMS>(curvature, self.orders.curvature);
            let of_rate_gradient =
                chebyshev::<f64, MAX_RATE_GRADIENT_TERMS>(rate_gradient, self.orders.rate_gradient);
            for (m, (kept, r)) in self.products().enumerate() {
                let of_kind = match self.kinds[kept.kind] {
                    Kind::Whole => 1.0,
                    Kind::Gain(_) => 0.0,
                    Kind::Acceleration => acceleration,
                };
                products[m * all + k] = of_kind
                    * of_dilation[r]
                    * of_curvature[kept.curvature]
                    * of_rate_gradient[kept.rate_gradient];
            }
        }
    }

    /// Keeps as many terms of the dilation for every product as limit the truncation error to
    /// `share`. Returns the number of channels and the total truncation error.
    fn keep(
        &mut self,
        share: f64,
        dilation_sizes: &[f64],
        curvature_sizes: &[f64; MAX_CURVATURE_TERMS],
        rate_gradient_sizes: &[f64; MAX_RATE_GRADIENT_TERMS],
    ) -> (usize, f64) {
        let Orders {
            kinds,
            curvature,
            rate_gradient,
            ..
        } = self.orders;
        let (mut left_out, mut channels, mut len) = (0.0, 0, 0);
        let products = |kind| {
            (0..curvature * rate_gradient)
                .map(move |k| (kind, k / rate_gradient, k % rate_gradient))
        };
        for (kind, p, z) in (0..kinds).flat_map(products) {
            let of_kind = match kind {
                0 => 1.0,
                _ => (KIND_PEAK * self.size_of(self.kinds[kind])).min(1.0),
            };
            let size = of_kind * curvature_sizes[p] * rate_gradient_sizes[z];
            let (mut rest, mut terms) = (0.0, dilation_sizes.len());
            // The first product carries the echo itself.
            let first = kind + p + z == 0;
            while terms > usize::from(first) && rest + dilation_sizes[terms - 1] * size <= share {
                rest += dilation_sizes[terms - 1] * size;
                terms -= 1;
            }
            left_out += rest;
            if terms > 0 {
                self.kept[len] = ChannelProduct {
                    kind,
                    curvature: p,
                    rate_gradient: z,
                    dilation: terms,
                };
                len += 1;
                channels += terms;
            }
        }
        self.kept_len = len;
        (channels, left_out)
    }

    pub(super) fn kept(&self) -> &[ChannelProduct] {
        &self.kept[..self.kept_len]
    }

    /// Rotation of the rotor of slope `s` at the end of the section from the middle of a block to a
    /// lane, radians.
    pub(crate) fn turn_rad(&self, lane: usize, s: f64) -> f64 {
        let step_hz = self.engine.rate_hz / self.engine.bins() as f64;
        let from_middle = lane as f64 - 0.5 * (BLOCK - 1) as f64;
        TAU * from_middle * step_hz * s * self.section.half_m / self.engine.ping.sound_speed_m_per_s
    }

    /// Largest slope of the columns that matter.
    pub(super) fn greatest_slope(&self) -> f64 {
        let [least, most] = [-1.0, 1.0].map(|x| self.smooth.slope.at(x));
        least.abs().max(most.abs()) + self.step
    }

    /// Products that the channels are sums of: each kept product times each of its terms of the
    /// dilation.
    pub(super) fn products(&self) -> impl Iterator<Item = (ChannelProduct, usize)> + '_ {
        let terms = |kept: &ChannelProduct| {
            let kept = *kept;
            (0..kept.dilation).map(move |r| (kept, r))
        };
        self.kept().iter().flat_map(terms)
    }

    /// Channels of the grid.
    pub(super) fn channels(&self) -> usize {
        self.merged
    }

    pub(super) fn slope(&self, column: usize) -> f64 {
        (self.first + column as isize) as f64 * self.step
    }

    /// Panels of the grid.
    pub(super) fn panels(&self) -> usize {
        (self.columns * self.channels()).div_ceil(PANEL)
    }

    /// Span of the slopes of all columns.
    pub(super) fn slopes(&self) -> Span {
        Span::of([self.slope(0), self.slope(self.columns - 1)].into_iter())
    }
}

/// Number of terms of exp(j theta) whose remainder is at most `far`.
fn terms_of_turn(theta: f64, far: f64) -> usize {
    let (mut terms, mut rest) = (1, theta);
    while rest > far && terms < MAX_TURN {
        terms += 1;
        rest *= theta / terms as f64;
    }
    terms
}

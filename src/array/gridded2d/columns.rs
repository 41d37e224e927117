//! Columns of the grid to powers along the stretch: Fourier transforms, pulse and shape.

use std::f64::consts::PI;
use std::time::Instant;

use num_complex::Complex64;

use super::engine::{Orders, Work};
use super::lanes::{BLOCK, Lanes, Split};
use super::panel::{PANEL, transposed};
use super::pulse::{Instants, MOST_INSTANTS, chebyshev, chebyshev_nodes};
use super::sample::Sample;
use super::stages::Stage;
use super::task::{MOST_ALONG, MOST_TURN, Ray, Task};

/// Of what a series may leave out, what powers along the stretch that are left out of single products may.
const TRIMMED: f64 = 0.1;

/// One coefficient of the templates.
#[derive(Clone, Copy)]
pub struct Entry {
    /// Which sound it is of: instant times products and product.
    pub source: usize,
    /// Along the stretch.
    pub power: usize,
}

impl<T: Sample> Task<'_, T> {
    /// Bins that the filter leaves.
    pub fn heard(&self) -> usize {
        self.engine.blocks.len() * BLOCK
    }

    /// Instants, products of kind, bend and twist, powers along the stretch: entries of a template per power of the frequency.
    fn entries(&self) -> usize {
        self.orders.instants * self.kept().len() * self.orders.along
    }

    /// Each column to frequency, and there into the powers along the stretch.
    #[inline(always)]
    pub fn to_moments<const FUSED: bool>(&self, work: &mut Work<T>) {
        let instants = &self.engine.instants[self.orders.instants - 1];
        let mut since = Instant::now();
        self.spectra::<FUSED>(work);
        work.stages.lap(Stage::Transform, &mut since);
        self.dilation_series(work);
        self.dilation_lines::<FUSED>(work);
        self.shapes(work, instants);
        work.stages.lap(Stage::Templates, &mut since);
        work.moments
            .resize(self.heard() * self.columns * work.powers);
        work.sounds
            .resize(instants.len() * self.kept().len(), Lanes::ZERO);
        for split in &mut work.here {
            split.resize(work.entries.len());
        }
        for column in 0..self.columns {
            self.template(work, column);
            for block in 0..self.engine.blocks.len() {
                self.block::<FUSED>(work, column, block, instants);
            }
        }
        work.stages.lap(Stage::Combine, &mut since);
    }

    /// All channels of all columns to frequency.
    #[inline(always)]
    fn spectra<const FUSED: bool>(&self, work: &mut Work<T>) {
        let (rows, bins) = (self.engine.rows, self.engine.bins());
        let heard = self.heard();
        let all = self.columns * self.channels();
        work.spectrum.resize(all * heard);
        let [a, b] = &mut work.panel;
        // The first bin that is heard lies below the centre: at the transform's end.
        let first = (rows + self.engine.blocks.start * BLOCK - bins / 2) % rows;
        for (panel, grid) in work.grid.chunks_exact(self.engine.panel_rows()).enumerate() {
            let from = self.engine.forward.run::<FUSED>(&grid[..rows], [a, b]);
            let lanes = PANEL.min(all - panel * PANEL);
            let re = &mut work.spectrum.re[panel * PANEL * heard..][..lanes * heard];
            let im = &mut work.spectrum.im[panel * PANEL * heard..][..lanes * heard];
            // Squares of 16 by 16 stay in the cache.
            for q in (0..heard).step_by(PANEL) {
                let mut square = [&from[0]; PANEL];
                for (k, row) in square.iter_mut().enumerate() {
                    *row = &from[(first + q + k) % rows];
                }
                let (mut of_re, mut of_im) = ([[T::ZERO; PANEL]; PANEL], [[T::ZERO; PANEL]; PANEL]);
                for k in 0..PANEL {
                    (of_re[k], of_im[k]) = (square[k].re, square[k].im);
                }
                let (of_re, of_im) = (transposed(of_re), transposed(of_im));
                for lane in 0..lanes {
                    let to = lane * heard + q;
                    re[to..][..PANEL].copy_from_slice(&of_re[lane]);
                    im[to..][..PANEL].copy_from_slice(&of_im[lane]);
                }
            }
        }
    }

    /// exp(-j psi w d) at each instant w as a series of T_r(d): the r-th term's coefficient is (-j)^r times a real number, which goes in as
    /// powers of the frequency.
    fn dilation_series(&self, work: &mut Work<T>) {
        let orders = self.orders;
        let powers = &self.engine.powers[orders.band - 1];
        let series = &self.engine.series[orders.dilation - 1];
        let entries = orders.instants * orders.dilation;
        work.dilation.clear();
        work.dilation.resize(orders.band * entries, T::ZERO);
        for (n, w) in chebyshev_nodes(orders.instants).enumerate() {
            for r in 0..orders.dilation {
                for power in 0..orders.band {
                    let mut sum = Complex64::ZERO;
                    for (b, f) in chebyshev_nodes(orders.band).enumerate() {
                        let angle = self.rest_rad(f) * w;
                        for (d, unit) in chebyshev_nodes(orders.dilation).enumerate() {
                            let share =
                                series[r * orders.dilation + d] * powers[power * orders.band + b];
                            sum += Complex64::from_polar(share, -angle * unit);
                        }
                    }
                    work.dilation[power * entries + n * orders.dilation + r] =
                        T::narrow(if r % 2 == 0 { sum.re } else { sum.im });
                }
            }
        }
    }

    /// The same over the bins of each block: `[block][instant][dilation][lane]`.
    #[inline(always)]
    fn dilation_lines<const FUSED: bool>(&self, work: &mut Work<T>) {
        let orders = self.orders;
        let entries = orders.instants * orders.dilation;
        let x = self.lanes();
        work.dilation_lines.clear();
        for block in 0..self.engine.blocks.len() {
            let middle = self.middle_band(block);
            for entry in 0..entries {
                work.dilation_lines.push(line::<T, FUSED>(
                    &work.dilation,
                    entry,
                    entries,
                    orders.band,
                    middle,
                    &x,
                ));
            }
        }
    }

    /// Of the lanes of a block, in half bands from its middle.
    fn lanes(&self) -> [T; BLOCK] {
        let half_bins = 0.5 * self.engine.bins() as f64;
        std::array::from_fn(|lane| T::narrow((lane as f64 - 0.5 * (BLOCK - 1) as f64) / half_bins))
    }

    fn middle_band(&self, block: usize) -> f64 {
        self.middle_hz(block) / (0.5 * self.engine.rate_hz)
    }

    /// The shape at a few slopes, as series of bend and twist, powers along the stretch and powers of the frequency.
    fn shapes(&self, work: &mut Work<T>, instants: &Instants) {
        let orders = self.orders;
        let (along, band) = (orders.along, orders.band);
        let slopes = self.slopes();
        let engine = self.engine;
        work.all_shapes.clear();
        for node in chebyshev_nodes(self.nodes) {
            let s = slopes.at(node);
            let (values, next) = (&mut work.values, &mut work.values_next);
            values.clear();
            let kinds = self.kinds();
            let each = instants
                .x
                .iter()
                .flat_map(|&w| kinds.iter().map(move |&kind| (w, kind)));
            for (w, kind) in each {
                for b in chebyshev_nodes(orders.bend) {
                    for twist in chebyshev_nodes(orders.twist) {
                        let ray = Ray {
                            per_range_per_m: self.smooth.per_range_per_m.at(b),
                            twist,
                            kind,
                        };
                        for x in chebyshev_nodes(along) {
                            for f in chebyshev_nodes(band) {
                                values.push(self.shape(s, ray, x, w, f));
                            }
                        }
                    }
                }
            }
            // One dimension after the other, from the outside in.
            let inner = along * band;
            along_dimension(
                &engine.series[orders.bend - 1],
                values,
                next,
                orders.twist * inner,
            );
            along_dimension(&engine.series[orders.twist - 1], next, values, inner);
            along_dimension(&engine.powers[along - 1], values, next, band);
            along_dimension(&engine.powers[band - 1], next, values, 1);
            for power in 0..band {
                for n in 0..orders.instants {
                    for kept in self.kept() {
                        let kind = n * orders.kinds + kept.kind;
                        let from = (kind * orders.bend + kept.bend) * orders.twist + kept.twist;
                        let along = (0..along).map(|q| values[(from * along + q) * band + power]);
                        work.all_shapes.extend(along);
                    }
                }
            }
        }
        self.choose_entries(work);
        let (all, kept) = (self.entries(), work.entries.len());
        work.shapes.resize(self.nodes * band * kept);
        let rows = work.all_shapes.chunks_exact(all).enumerate();
        for (row, values) in rows {
            for (e, entry) in work.entries.iter().enumerate() {
                let value = values[entry.source * along + entry.power];
                work.shapes.re[row * kept + e] = T::narrow(value.re);
                work.shapes.im[row * kept + e] = T::narrow(value.im);
            }
        }
    }

    /// Of every kept product, the highest powers along the stretch that together are next to nothing are left out; and of those that the turn
    /// inside a block adds.
    fn choose_entries(&self, work: &mut Work<T>) {
        let Orders {
            instants,
            along,
            turn,
            band,
            ..
        } = self.orders;
        let products = self.kept().len();
        let all = self.entries();
        // Of each product and power: the most that it is at any slope, instant and frequency.
        work.most.clear();
        work.most.resize(products * along, 0.0);
        for node in work.all_shapes.chunks_exact(all * band) {
            for entry in 0..all {
                let size: f64 = node[entry..].iter().step_by(all).map(|c| c.norm()).sum();
                let most = &mut work.most[entry % (products * along)];
                *most = most.max(size);
            }
        }
        let share = TRIMMED * self.engine.fineness.series / products as f64;
        work.entries.clear();
        let powers_of = |most: &[f64]| {
            let (mut powers, mut rest) = (along, 0.0);
            while powers > 0 && rest + most[powers - 1] <= share {
                rest += most[powers - 1];
                powers -= 1;
            }
            powers
        };
        for power in 0..along {
            for source in 0..instants * products {
                let product = source % products;
                if power < powers_of(&work.most[product * along..][..along]) {
                    work.entries.push(Entry { source, power });
                }
            }
        }
        // What is left out of the turn jumps from block to block.
        let theta = self.turn_rad(0, self.greatest_slope()).abs();
        let turned = |m: usize| (1..=m).fold(1.0, |term, k| term * theta / k as f64);
        let left_out = |powers: usize| -> f64 {
            (0..along)
                .flat_map(|q| (0..turn).map(move |m| (q, m)))
                .filter(|(q, m)| q + m >= powers)
                .map(|(q, m)| {
                    let size: f64 = work.most[q..].iter().step_by(along).sum();
                    size * turned(m)
                })
                .sum()
        };
        work.powers = (along..self.most_powers())
            .find(|&powers| left_out(powers) <= self.engine.fineness.far)
            .unwrap_or(self.most_powers());
    }

    /// A column's template, from those at the few slopes.
    #[inline(always)]
    fn template(&self, work: &mut Work<T>, column: usize) {
        let len = self.orders.band * work.entries.len();
        let x = self.slopes().unit(self.slope(column));
        let series = &self.engine.series[self.nodes - 1];
        work.template.clear_to(len);
        for node in 0..self.nodes {
            let share: f64 = (0..self.nodes)
                .map(|n| series[n * self.nodes + node] * chebyshev(n, x))
                .sum();
            let share = T::narrow(share);
            let at = node * len..(node + 1) * len;
            add_scaled(&mut work.template.re, &work.shapes.re[at.clone()], share);
            add_scaled(&mut work.template.im, &work.shapes.im[at], share);
        }
    }

    /// The pulse's spectra as a column at slope `s` hears them, shifted by its Doppler: of Lagrange's polynomials of the instants.
    #[inline(always)]
    fn pulses<const FUSED: bool>(
        &self,
        s: f64,
        block: usize,
        nodes: &Instants,
    ) -> [Lanes<T>; MOST_INSTANTS] {
        let mut pulses = [Lanes::ZERO; MOST_INSTANTS];
        let f_hz = self.middle_hz(block);
        let dilation = self.smooth.dilation(s);
        let g_hz = f_hz + (self.engine.ping.carrier_hz + f_hz) * dilation;
        let Some(place) = self.pulse.place::<BLOCK>(g_hz, 1.0 + dilation) else {
            return pulses;
        };
        let count = nodes.len();
        for j in 0..count {
            let mut term = Lanes::<T>::ZERO;
            self.pulse
                .read::<BLOCK, FUSED>(j, &place, &mut term.re, &mut term.im);
            for (n, pulse) in pulses[..count].iter_mut().enumerate() {
                pulse.add_real::<FUSED>(&term, T::narrow(nodes.share[n * count + j]));
            }
        }
        pulses
    }

    /// Middle of one of the blocks that are heard, Hz from the centre.
    pub fn middle_hz(&self, block: usize) -> f64 {
        let bins = self.engine.bins();
        let first = (self.engine.blocks.start + block) * BLOCK;
        let middle = first as f64 + 0.5 * (BLOCK - 1) as f64 - (bins / 2) as f64;
        middle * self.engine.rate_hz / bins as f64
    }

    /// One block of one column: channels, pulse and shape into powers along the stretch.
    #[inline(always)]
    fn block<const FUSED: bool>(
        &self,
        work: &mut Work<T>,
        column: usize,
        block: usize,
        nodes: &Instants,
    ) {
        let orders = self.orders;
        let (along, powers, heard_bins) = (orders.along, work.powers, self.heard());
        // Over a block everything smooth is a line.
        let (middle, x) = (self.middle_band(block), self.lanes());
        let [here, slope] = &mut work.here;
        let entries = work.entries.len();
        tangent::<T, FUSED>(&work.template, entries, orders.band, middle, here, slope);
        let lines = orders.instants * orders.dilation;
        let lines = &work.dilation_lines[block * lines..][..lines];
        let first = column * self.channels() * heard_bins + block * BLOCK;

        let s = self.slope(column);
        let pulses = self.pulses::<FUSED>(s, block, nodes);
        // Of each instant, every product as the pulse then has it.
        let mut source = 0;
        for (n, pulse) in pulses[..orders.instants].iter().enumerate() {
            let lines = &lines[n * orders.dilation..][..orders.dilation];
            let mut at = first;
            for kept in self.kept() {
                let mut heard = Lanes::ZERO;
                for (r, weights) in lines[..kept.dilation].iter().enumerate() {
                    let channel = Lanes::load(&work.spectrum, at);
                    at += heard_bins;
                    heard.add_weighted::<FUSED>(&channel, weights, r % 2 == 1);
                }
                work.sounds[source] = heard.times::<FUSED>(pulse);
                source += 1;
            }
        }
        let mut sums = [Lanes::<T>::ZERO; MOST_ALONG + MOST_TURN];
        let mut e = 0;
        for (q, sum) in sums[..along].iter_mut().enumerate() {
            let mut total = Lanes::<T>::ZERO;
            while e < entries && work.entries[e].power == q {
                let shape =
                    Lanes::line::<FUSED>([here.re[e], here.im[e]], [slope.re[e], slope.im[e]], &x);
                total.add_product::<FUSED>(&work.sounds[work.entries[e].source], &shape);
                e += 1;
            }
            *sum = total;
        }
        // exp(j theta x), theta the turn within the block, times the powers so far.
        let mut theta = [T::ZERO; BLOCK];
        for (lane, theta) in theta.iter_mut().enumerate() {
            *theta = T::narrow(self.turn_rad(lane, s));
        }
        let mut total = [Lanes::<T>::ZERO; MOST_ALONG + MOST_TURN];
        for m in 0..orders.turn {
            let left = along.min(powers.saturating_sub(m));
            for q in 0..left {
                total[q + m].add(&sums[q]);
            }
            for sum in &mut sums[..left] {
                sum.turn(&theta, T::narrow(1.0 / (m + 1) as f64));
            }
        }
        for (q, lanes) in total[..powers].iter().enumerate() {
            let at = ((block * self.columns + column) * powers + q) * BLOCK;
            work.moments.re[at..][..BLOCK].copy_from_slice(&lanes.re);
            work.moments.im[at..][..BLOCK].copy_from_slice(&lanes.im);
        }
    }

    /// Phase of what is left of the dilation at the pulse's ends, radians.
    pub fn rest_rad(&self, band: f64) -> f64 {
        PI * self.absolute_hz(band) * self.smooth.dilation_rest * self.engine.ping.duration_s
    }
}

/// Polynomials `[power][entry]` at `x`: value and slope, each multiplied out from the highest power.
#[inline(always)]
fn tangent<T: Sample, const FUSED: bool>(
    series: &Split<T>,
    entries: usize,
    powers: usize,
    x: f64,
    value: &mut Split<T>,
    slope: &mut Split<T>,
) {
    let x = T::narrow(x);
    tangent_of::<T, FUSED>(&series.re, entries, powers, x, &mut value.re, &mut slope.re);
    tangent_of::<T, FUSED>(&series.im, entries, powers, x, &mut value.im, &mut slope.im);
}

#[inline(always)]
fn tangent_of<T: Sample, const FUSED: bool>(
    series: &[T],
    entries: usize,
    powers: usize,
    x: T,
    value: &mut [T],
    slope: &mut [T],
) {
    for e in 0..entries {
        (value[e], slope[e]) = (series[(powers - 1) * entries + e], T::ZERO);
    }
    for power in (0..powers - 1).rev() {
        let row = &series[power * entries..][..entries];
        let (value, slope) = (&mut value[..entries], &mut slope[..entries]);
        for e in 0..entries {
            slope[e] = slope[e].times_plus::<FUSED>(x, value[e]);
            value[e] = value[e].times_plus::<FUSED>(x, row[e]);
        }
    }
}

#[inline(always)]
fn add_scaled<T: Sample>(to: &mut [T], from: &[T], share: T) {
    for (sum, value) in to.iter_mut().zip(from) {
        *sum = *sum + share * *value;
    }
}

/// One real polynomial `[power][entry]` about `middle`, as a line over `x`.
#[inline(always)]
fn line<T: Sample, const FUSED: bool>(
    series: &[T],
    entry: usize,
    entries: usize,
    powers: usize,
    middle: f64,
    x: &[T; BLOCK],
) -> [T; BLOCK] {
    let middle = T::narrow(middle);
    let (mut value, mut slope) = (T::ZERO, T::ZERO);
    for power in (0..powers).rev() {
        slope = slope.times_plus::<FUSED>(middle, value);
        value = value.times_plus::<FUSED>(middle, series[power * entries + entry]);
    }
    std::array::from_fn(|j| slope.times_plus::<FUSED>(x[j], value))
}

/// Applies a square matrix along one dimension of `from`: that with `inner` values between neighbours.
fn along_dimension(matrix: &[f64], from: &[Complex64], to: &mut Vec<Complex64>, inner: usize) {
    let count = matrix.len().isqrt();
    to.clear();
    to.resize(from.len(), Complex64::ZERO);
    for (from, to) in from
        .chunks_exact(count * inner)
        .zip(to.chunks_exact_mut(count * inner))
    {
        for i in 0..count {
            for j in 0..count {
                let share = matrix[i * count + j];
                for k in 0..inner {
                    to[i * inner + k] += from[j * inner + k] * share;
                }
            }
        }
    }
}

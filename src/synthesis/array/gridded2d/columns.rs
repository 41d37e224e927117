//! Columns of the grid to powers along the section: Fourier transforms, pulse and shape.

use std::f64::consts::PI;

use num_complex::Complex64;

use super::engine::{Orders, Work};
use super::lanes::{BLOCK, Lanes, ProductSum, Split};
use super::merge::Merge;
use super::panel::{PANEL, Row, transposed};
use super::pulse::{chebyshev, chebyshev_nodes};
use super::sample::Sample;
use super::stages::{self, Stage};
use super::task::{Ray, Task};

/// Joint error of the omitted coefficients, as a share of the truncation error allowed per series.
const TRIMMED: f64 = 1.0;

/// Size of a coefficient that is always omitted, as a share of the error allowed over a whole slab.
const NOTHING: f64 = 1e-3;

/// Number of coefficients processed together; their rows are padded with zeros.
const WHOLE: usize = 16;

/// One coefficient of the templates.
#[derive(Clone, Copy)]
pub(super) struct Entry {
    /// Index of the source that it multiplies.
    pub sound: usize,
    /// Power along the section.
    pub power: usize,
}

impl<T: Sample> Task<'_, T> {
    /// Number of bins in the pass band.
    pub(super) fn passed_bins(&self) -> usize {
        self.engine.blocks.len() * BLOCK
    }

    /// Entries of a template per power of the frequency: terms of the emission, channels, powers
    /// along the section.
    fn entries(&self) -> usize {
        self.orders.instants * self.channels() * self.orders.along
    }

    /// Transforms each column to frequency and computes its contribution to the powers along the
    /// section.
    #[inline(always)]
    pub(crate) fn to_spectra<const FUSED: bool>(&self, work: &mut Work<T>) {
        let mut since = stages::now();
        self.dilation_series(work);
        self.shapes(work);
        self.shares_of_nodes(work);
        work.sounds.resize(work.sources.len(), Lanes::ZERO);
        work.pulses.resize(self.orders.instants, Lanes::ZERO);
        for powers in &mut work.of_powers {
            powers.resize(work.powers, Lanes::ZERO);
        }
        let whole = work.entries.len().next_multiple_of(WHOLE);
        for split in &mut work.chords {
            split.resize(self.nodes * whole);
        }
        for split in &mut work.here {
            split.resize(whole);
        }
        work.stages.lap(Stage::Templates, &mut since);
        let lanes = self.columns * self.channels();
        work.spectrum.resize(lanes * self.passed_bins());
        for panel in 0..self.panels() {
            self.spectra::<FUSED>(work, panel);
        }
        work.cleared = true;
        work.stages.lap(Stage::Transform, &mut since);
    }

    /// Transforms one panel of channels and columns to frequency.
    #[inline(always)]
    fn spectra<const FUSED: bool>(&self, work: &mut Work<T>, panel: usize) {
        let (rows, bins) = (self.engine.rows, self.engine.bins());
        let passed_bins = self.passed_bins();
        let all = self.columns * self.channels();
        let [a, b] = &mut work.panel;
        // The first bin in the pass band lies below the centre frequency, at the end of the
        // transform.
        let first = (rows + self.engine.blocks.start * BLOCK - bins / 2) % rows;
        let grid = &mut work.grid[panel * self.engine.panel_rows()..][..rows];
        let forward = &self.engine.forward;
        let from = forward.run::<FUSED>(grid, [a, b]);
        let lanes = PANEL.min(all - panel * PANEL);
        let Split { re, im } = &mut work.spectrum;
        // Squares of 16 by 16 stay in the cache.
        for q in (0..passed_bins).step_by(PANEL) {
            let mut square = [&from[0]; PANEL];
            for (k, row) in square.iter_mut().enumerate() {
                *row = &from[forward.place((first + q + k) % rows)];
            }
            let (mut of_re, mut of_im) = ([[T::ZERO; PANEL]; PANEL], [[T::ZERO; PANEL]; PANEL]);
            for k in 0..PANEL {
                (of_re[k], of_im[k]) = (square[k].re, square[k].im);
            }
            let (of_re, of_im) = (transposed(of_re), transposed(of_im));
            let first = (q / BLOCK * all + panel * PANEL) * BLOCK + q % BLOCK;
            for lane in 0..lanes {
                let to = first + lane * BLOCK;
                re[to..][..PANEL].copy_from_slice(&of_re[lane]);
                im[to..][..PANEL].copy_from_slice(&of_im[lane]);
            }
        }
        // Cleared for the next task while it is in the cache.
        grid.fill(Row::ZERO);
    }

    /// exp(-j psi w d) at each instant w as a series of T_r(d), at a few frequencies:
    /// `[instant][dilation][frequency]`.
    fn dilation_series(&self, work: &mut Work<T>) {
        let orders = self.orders;
        let series = &self.engine.series[orders.dilation - 1];
        work.dilation.clear();
        for w in chebyshev_nodes(orders.instants) {
            for r in 0..orders.dilation {
                let shares = &series[r * orders.dilation..][..orders.dilation];
                for f in chebyshev_nodes(orders.band) {
                    let angle = self.rest_rad(f) * w;
                    let terms = chebyshev_nodes(orders.dilation).zip(shares);
                    let term =
                        |(unit, &share): (f64, &f64)| Complex64::from_polar(share, -angle * unit);
                    work.dilation.push(terms.map(term).sum());
                }
            }
        }
    }

    /// Positions of the lanes of a block, in half bands from its middle.
    fn lanes(&self) -> [T; BLOCK] {
        let half_bins = 0.5 * self.engine.bins() as f64;
        std::array::from_fn(|lane| T::narrow((lane as f64 - 0.5 * (BLOCK - 1) as f64) / half_bins))
    }

    fn middle_band(&self, block: usize) -> f64 {
        self.middle_hz(block) / (0.5 * self.engine.rate_hz)
    }

    /// Computes the shape at a few slopes, as series of curvature and rate gradient, powers along
    /// the section and powers of the frequency.
    fn shapes(&self, work: &mut Work<T>) {
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
            let each = chebyshev_nodes(orders.instants)
                .flat_map(|w| kinds.iter().map(move |&kind| (w, kind)));
            for (w, kind) in each {
                for b in chebyshev_nodes(orders.curvature) {
                    for rate_gradient in chebyshev_nodes(orders.rate_gradient) {
                        let ray = Ray {
                            per_range_per_m: self.smooth.per_range_per_m.at(b),
                            rate_gradient,
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
            // One dimension after the other, from the outermost.
            let inner = along * band;
            along_dimension(
                &engine.series[orders.curvature - 1],
                values,
                next,
                orders.rate_gradient * inner,
            );
            along_dimension(
                &engine.series[orders.rate_gradient - 1],
                next,
                values,
                inner,
            );
            self.merge_products(&work.merge, &work.dilation, values, next);
            along_dimension(&engine.powers[along - 1], next, values, band);
            along_dimension(&engine.powers[band - 1], values, next, 1);
            for power in 0..band {
                let of_power = next.iter().skip(power).step_by(band);
                work.all_shapes.extend(of_power);
            }
        }
        self.most_of_powers(work);
        // From instants to terms of the emission.
        let inner = self.channels() * along;
        along_dimension(
            &engine.series[orders.instants - 1],
            &work.all_shapes,
            &mut work.values,
            inner,
        );
        self.choose_entries(work);
        let all = self.entries();
        let kept = work.entries.len().next_multiple_of(WHOLE);
        work.shapes.clear_to(self.nodes * band * kept);
        let rows = work.values.chunks_exact(all).enumerate();
        for (row, values) in rows {
            for (e, entry) in work.entries.iter().enumerate() {
                let value = values[work.sources[entry.sound] * along + entry.power];
                work.shapes.re[row * kept + e] = T::narrow(value.re);
                work.shapes.im[row * kept + e] = T::narrow(value.im);
            }
        }
    }

    /// Converts templates of products,
    /// `[instant][kind][curvature][rate_gradient][place][frequency]`, times those of the residual
    /// dilation, to those of channels: `[instant][channel][place][frequency]`.
    fn merge_products(
        &self,
        merge: &Merge,
        dilation: &[Complex64],
        from: &[Complex64],
        to: &mut Vec<Complex64>,
    ) {
        let orders = self.orders;
        let (channels, band) = (self.channels(), orders.band);
        let inner = orders.along * band;
        to.clear();
        to.resize(orders.instants * channels * inner, Complex64::ZERO);
        for (n, to) in to.chunks_exact_mut(channels * inner).enumerate() {
            for (m, (kept, r)) in self.products().enumerate() {
                let kind = n * orders.kinds + kept.kind;
                let product = (kind * orders.curvature + kept.curvature) * orders.rate_gradient
                    + kept.rate_gradient;
                let from = &from[product * inner..][..inner];
                let turned = &dilation[(n * orders.dilation + r) * band..][..band];
                for (i, to) in to.chunks_exact_mut(inner).enumerate() {
                    let share = merge.of_template(m, i);
                    if share == 0.0 {
                        continue;
                    }
                    for (to, from) in to.chunks_exact_mut(band).zip(from.chunks_exact(band)) {
                        for ((to, from), turned) in to.iter_mut().zip(from).zip(turned) {
                            *to += from * turned * share;
                        }
                    }
                }
            }
        }
    }

    /// Largest value of each channel's templates for each power along the section, over slopes,
    /// instants and frequencies.
    fn most_of_powers(&self, work: &mut Work<T>) {
        let Orders { along, band, .. } = self.orders;
        let (channels, all) = (self.channels(), self.entries());
        work.most.clear();
        work.most.resize(channels * along, 0.0);
        for node in work.all_shapes.chunks_exact(all * band) {
            for entry in 0..all {
                let size: f64 = node[entry..].iter().step_by(all).map(|c| c.norm()).sum();
                let at = entry % (channels * along);
                let most = &mut work.most[at];
                *most = most.max(size * work.merge.peak[at / along]);
            }
        }
    }

    /// Omits the smallest coefficients whose sum is negligible, and the highest of the powers that
    /// the rotation inside a block adds.
    fn choose_entries(&self, work: &mut Work<T>) {
        let Orders {
            along, turn, band, ..
        } = self.orders;
        let channels = self.channels();
        let all = self.entries();
        // Largest value of each coefficient over slopes and frequencies.
        work.sizes.clear();
        work.sizes.extend((0..all).map(|entry| (0.0, entry)));
        for node in work.values.chunks_exact(all * band) {
            for (most, entry) in &mut work.sizes {
                let of_entry = node[*entry..].iter().step_by(all);
                let size: f64 = of_entry.map(|c| c.norm()).sum();
                *most = f64::max(*most, size * work.merge.peak[*entry / along % channels]);
            }
        }
        let order = |a: &(f64, usize), b: &(f64, usize)| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1));
        work.sizes.sort_unstable_by(order);
        let share = TRIMMED * self.engine.resolution.series;
        // Such values are mere rounding, and their products approach subnormal numbers, which are
        // slow.
        let nothing = NOTHING * self.engine.resolution.far;
        let mut rest = 0.0;
        let small = work.sizes.iter().take_while(|(size, _)| {
            rest += size;
            rest <= share || *size <= nothing
        });
        let small = small.count();
        let kept = &mut work.sizes[small..];
        // By source, then by power.
        kept.sort_unstable_by_key(|(_, entry)| *entry);
        work.sources.clear();
        work.entries.clear();
        for (_, entry) in kept.iter() {
            let source = *entry / along;
            if work.sources.last() != Some(&source) {
                work.sources.push(source);
            }
            work.entries.push(Entry {
                sound: work.sources.len() - 1,
                power: *entry % along,
            });
        }
        work.entries
            .sort_unstable_by_key(|entry| (entry.power, entry.sound));
        let used = work.entries.last().map_or(1, |entry| entry.power + 1);
        work.along = used;
        // The truncation error of the rotation has steps between blocks.
        let theta = self.turn_rad(0, self.greatest_slope()).abs();
        let turned = |m: usize| (1..=m).fold(1.0, |term, k| term * theta / k as f64);
        let left_out = |powers: usize| -> f64 {
            (0..used)
                .flat_map(|q| (0..turn).map(move |m| (q, m)))
                .filter(|(q, m)| q + m >= powers)
                .map(|(q, m)| {
                    let size: f64 = work.most[q..].iter().step_by(along).sum();
                    size * turned(m)
                })
                .sum()
        };
        let most = used + turn - 1;
        work.powers = (used..most)
            .find(|&powers| left_out(powers) <= self.engine.resolution.far)
            .unwrap_or(most);
    }

    /// Interpolation weights of each column on the templates at the few slopes: `[column][node]`.
    fn shares_of_nodes(&self, work: &mut Work<T>) {
        let series = &self.engine.series[self.nodes - 1];
        let slopes = self.slopes();
        work.shares.clear();
        for column in 0..self.columns {
            let x = slopes.unit(self.slope(column));
            let share = |node: usize| -> f64 {
                (0..self.nodes)
                    .map(|n| series[n * self.nodes + node] * chebyshev(n, x))
                    .sum()
            };
            work.shares
                .extend((0..self.nodes).map(|node| T::narrow(share(node))));
        }
    }

    /// Templates at the few slopes in one block, where all smooth functions are linear.
    #[inline(always)]
    pub(super) fn chords<const FUSED: bool>(&self, work: &mut Work<T>, block: usize) {
        let middle = self.middle_band(block);
        let half = BLOCK as f64 / self.engine.bins() as f64;
        let whole = work.entries.len().next_multiple_of(WHOLE);
        let band = self.orders.band;
        let Work { shapes, chords, .. } = work;
        let [value, slope] = chords;
        let ends = [middle - half, middle + half].map(T::narrow);
        let rise = T::narrow(0.5 / half);
        for node in 0..self.nodes {
            let (from, to) = (node * band * whole, node * whole);
            chord::<T, FUSED>(
                (&shapes.re[from..], whole, band),
                (ends, rise),
                &mut value.re[to..][..whole],
                &mut slope.re[to..][..whole],
            );
            chord::<T, FUSED>(
                (&shapes.im[from..], whole, band),
                (ends, rise),
                &mut value.im[to..][..whole],
                &mut slope.im[to..][..whole],
            );
        }
    }

    /// Template of a column in one block, interpolated from those at the few slopes.
    #[inline(always)]
    fn template<const FUSED: bool>(&self, work: &mut Work<T>, column: usize) {
        let whole = work.entries.len().next_multiple_of(WHOLE);
        let shares = &work.shares[column * self.nodes..][..self.nodes];
        for (from, to) in work.chords.iter().zip(&mut work.here) {
            for (from, to) in [(&from.re, &mut to.re), (&from.im, &mut to.im)] {
                let (first, others) = from[..shares.len() * whole].split_at(whole);
                for (to, &from) in to[..whole].iter_mut().zip(first) {
                    *to = from * shares[0];
                }
                for (from, &share) in others.chunks_exact(whole).zip(&shares[1..]) {
                    for (to, &from) in to[..whole].iter_mut().zip(from) {
                        *to = from.times_plus::<FUSED>(share, *to);
                    }
                }
            }
        }
    }

    /// Spectra of the pulse received by a column at slope `s`, shifted by its Doppler, by terms of
    /// the emission.
    #[inline(always)]
    fn pulses<const FUSED: bool>(&self, s: f64, block: usize, pulses: &mut [Lanes<T>]) {
        pulses.fill(Lanes::ZERO);
        let f_hz = self.middle_hz(block);
        let dilation = self.smooth.dilation(s);
        let g_hz = f_hz + (self.engine.ping.carrier_hz + f_hz) * dilation;
        let Some(place) = self.pulse.place::<BLOCK>(g_hz, 1.0 + dilation) else {
            return;
        };
        for (j, pulse) in pulses.iter_mut().enumerate() {
            self.pulse
                .read::<BLOCK, FUSED>(j, &place, &mut pulse.re, &mut pulse.im);
        }
    }

    /// Middle of one of the blocks in the pass band, Hz from the centre.
    pub(crate) fn middle_hz(&self, block: usize) -> f64 {
        let bins = self.engine.bins();
        let first = (self.engine.blocks.start + block) * BLOCK;
        let middle = first as f64 + 0.5 * (BLOCK - 1) as f64 - (bins / 2) as f64;
        middle * self.engine.rate_hz / bins as f64
    }

    /// Combines channels, pulse and shape of one block of one column into powers along the section,
    /// at index `near` of the current columns.
    #[inline(always)]
    pub(super) fn block<const FUSED: bool>(
        &self,
        work: &mut Work<T>,
        column: usize,
        block: usize,
        near: usize,
    ) {
        self.template::<FUSED>(work, column);
        let (along, powers, channels) = (work.along, work.powers, self.channels());
        let first = (block * self.columns + column) * channels * BLOCK;
        let s = self.slope(column);
        self.pulses::<FUSED>(s, block, &mut work.pulses);
        // For each term of the emission, every channel times the pulse.
        for (sound, source) in work.sounds.iter_mut().zip(&work.sources) {
            let received = Lanes::load(&work.spectrum, first + source % channels * BLOCK);
            *sound = received.times::<FUSED>(&work.pulses[source / channels]);
        }
        let x = self.lanes();
        let [here, slope] = &work.here;
        let [sums, total] = &mut work.of_powers;
        let mut e = 0;
        for (q, sum) in sums[..along].iter_mut().enumerate() {
            let mut total = ProductSum::<T>::ZERO;
            let of_power = work.entries[e..]
                .iter()
                .take_while(|entry| entry.power == q);
            let at = e..e + of_power.count();
            e = at.end;
            let values = here.re[at.clone()].iter().zip(&here.im[at.clone()]);
            let slopes = slope.re[at.clone()].iter().zip(&slope.im[at.clone()]);
            for ((entry, value), slope) in work.entries[at].iter().zip(values).zip(slopes) {
                let shape = Lanes::line::<FUSED>([*value.0, *value.1], [*slope.0, *slope.1], &x);
                total.add_product::<FUSED>(&work.sounds[entry.sound], &shape);
            }
            *sum = total.sum();
        }
        // exp(j theta x), theta the rotation within the block, times the powers so far.
        let mut theta = [T::ZERO; BLOCK];
        for (lane, theta) in theta.iter_mut().enumerate() {
            *theta = T::narrow(self.turn_rad(lane, s));
        }
        total[along..powers].fill(Lanes::ZERO);
        total[..along].copy_from_slice(&sums[..along]);
        for m in 1..self.orders.turn {
            let left = along.min(powers.saturating_sub(m));
            let scale = T::narrow(1.0 / m as f64);
            for (sum, total) in sums[..left].iter_mut().zip(&mut total[m..]) {
                sum.turn(&theta, scale);
                total.add(sum);
            }
        }
        for (q, lanes) in total[..powers].iter().enumerate() {
            let at = (near * powers + q) * BLOCK;
            work.moments.re[at..][..BLOCK].copy_from_slice(&lanes.re);
            work.moments.im[at..][..BLOCK].copy_from_slice(&lanes.im);
        }
    }

    /// Phase of the residual dilation at the ends of the pulse, radians.
    pub(crate) fn rest_rad(&self, band: f64) -> f64 {
        PI * self.absolute_hz(band) * self.smooth.dilation_rest * self.engine.ping.duration_s
    }
}

/// Linear interpolation of polynomials `[power][entry]` between two positions, given the numbers of
/// entries and powers. It is continuous from block to block, since steps would spread over the
/// whole slab.
#[inline(always)]
fn chord<T: Sample, const FUSED: bool>(
    (series, entries, powers): (&[T], usize, usize),
    ([low, high], rise): ([T; 2], T),
    value: &mut [T],
    slope: &mut [T],
) {
    let last = &series[(powers - 1) * entries..][..entries];
    let middle = T::narrow(0.5);
    for at in (0..entries).step_by(WHOLE) {
        let part = |row: &[T]| -> [T; WHOLE] { row[at..][..WHOLE].try_into().expect("whole") };
        let (mut below, mut above) = (part(last), part(last));
        for power in (0..powers - 1).rev() {
            let next = part(&series[power * entries..]);
            for e in 0..WHOLE {
                below[e] = below[e].times_plus::<FUSED>(low, next[e]);
                above[e] = above[e].times_plus::<FUSED>(high, next[e]);
            }
        }
        for e in 0..WHOLE {
            value[at + e] = (below[e] + above[e]) * middle;
            slope[at + e] = (above[e] - below[e]) * rise;
        }
    }
}

/// Applies a square matrix along one dimension of `from`, the one with `inner` values between
/// neighbours.
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

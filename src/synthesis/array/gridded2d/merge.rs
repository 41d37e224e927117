//! Reduces the products of the series to fewer channels, for the echoes of one task.
//!
//! Each echo has its own dilation, curvature, rate gradient and acceleration, which enter as products of
//! Chebyshev terms. Over a seabed these values are correlated, since nearly all follow from the position of
//! the echo, so the products span few directions. A pivoted Gram-Schmidt process over the surveyed echoes
//! finds a basis: each step adds the echo with the largest residual. Products are weighted by the largest
//! value of their templates, so the largest residual bounds the error.

use echotank_core::simd::{Kind as Processor, SimdLevel};

/// Maximum number of echoes in the process; a larger set is thinned evenly.
const MAX_LOOKED: usize = 4096;
/// Stride, in echoes, at which a point halfway to the next echo is added, since corners of boxes miss
/// it.
pub(crate) const MIDWAY: usize = 4;
/// Relative size of a direction below which it is rounding and adds nothing to the basis.
const LEAST: f64 = 1e-14;

/// Sums of products that the channels carry.
#[derive(Default)]
pub(crate) struct Merge {
    pub count: usize,
    products: usize,
    /// Orthonormal, `[channel][product]`.
    basis: Vec<f64>,
    /// Largest value of each product's template.
    weight: Vec<f64>,
    /// Largest value of each channel over the echoes.
    pub peak: Vec<f64>,
    /// Residual of the weighted products of every echo, `[product][echo]`.
    left: Vec<f64>,
    squares: Vec<f64>,
    along: Vec<f64>,
    /// Number of echoes in the process.
    looked: usize,
}

impl Merge {
    /// Resets the basis; `weight` holds the weight of each product.
    pub(super) fn start(&mut self, weight: impl Iterator<Item = f64>, echoes: usize) {
        self.weight.clear();
        self.weight.extend(weight);
        self.products = self.weight.len();
        self.basis.clear();
        self.peak.clear();
        self.count = 0;
        self.looked = echoes;
    }

    /// For a set of `echoes` echoes: how many are used, the stride between them, and how many there
    /// are with the midway points.
    pub(super) fn sample(echoes: usize) -> (usize, usize) {
        let every = echoes.div_ceil(MAX_LOOKED).max(1);
        (every, echoes.div_ceil(every))
    }

    /// Number of midway points among the echoes used.
    pub(crate) fn midway(kept: usize) -> usize {
        kept.saturating_sub(1) / MIDWAY
    }

    /// Buffer for the products of all echoes used, `[product][echo]`, with unspecified contents.
    pub(crate) fn products_mut(&mut self) -> &mut [f64] {
        self.left.resize(self.products * self.looked, 0.0);
        &mut self.left
    }

    /// Gives every product of `among` a channel of its own; `peak` is its largest value.
    pub(crate) fn keep_apart(&mut self, among: impl Iterator<Item = usize>, peak: f64) {
        for product in among {
            let row = self.basis.len();
            self.basis.resize(row + self.products, 0.0);
            self.basis[row + product] = 1.0;
            self.peak.push(peak * self.weight[product]);
            self.count += 1;
        }
    }

    /// Adds channels until the residual of every echo's products of `among` (the others must be 0)
    /// is at most `tolerance`. Returns the largest residual.
    pub(super) fn choose(&mut self, tolerance: f64, simd_level: SimdLevel) -> f64 {
        #[cfg(target_arch = "x86_64")]
        match simd_level.kind() {
            // SAFETY: such a `SimdLevel` proves that the processor has these features.
            Processor::Avx512 => return unsafe { self.choose_avx512(tolerance) },
            // SAFETY: as above.
            Processor::Avx2 => return unsafe { self.choose_avx2(tolerance) },
            Processor::Portable => {}
        }
        self.choose_plain(tolerance)
    }

    /// The AVX-512 build of [`Self::choose_plain`]: the same arithmetic in the same order, so the same bits.
    #[cfg(target_arch = "x86_64")]
    #[target_feature(enable = "avx512f")]
    fn choose_avx512(&mut self, tolerance: f64) -> f64 {
        self.choose_plain(tolerance)
    }

    /// As [`Self::choose_avx512`].
    #[cfg(target_arch = "x86_64")]
    #[target_feature(enable = "avx2")]
    fn choose_avx2(&mut self, tolerance: f64) -> f64 {
        self.choose_plain(tolerance)
    }

    #[inline(always)]
    fn choose_plain(&mut self, tolerance: f64) -> f64 {
        let Self {
            left,
            weight,
            squares,
            along,
            basis,
            looked,
            products,
            count,
            peak,
        } = self;
        let (looked, products) = (*looked, *products);
        if looked == 0 {
            return 0.0;
        }
        squares.clear();
        squares.resize(looked, 0.0);
        for (row, weight) in left.chunks_exact_mut(looked).zip(&*weight) {
            for (value, square) in row.iter_mut().zip(&mut *squares) {
                *value *= weight;
                *square += *value * *value;
            }
        }
        loop {
            let (worst, &most) = squares
                .iter()
                .enumerate()
                .max_by(|a, b| a.1.total_cmp(b.1))
                .expect("there are echoes");
            let met = most.max(0.0).sqrt();
            if met <= tolerance || *count == products || met < LEAST {
                return met;
            }
            // A new direction: the residual of the worst echo, orthogonalised once more against
            // rounding.
            let at = basis.len();
            basis.extend((0..products).map(|m| left[m * looked + worst]));
            let (known, new) = basis.split_at_mut(at);
            for row in known.chunks_exact(products) {
                let share: f64 = row.iter().zip(&*new).map(|(a, b)| a * b).sum();
                new.iter_mut()
                    .zip(row)
                    .for_each(|(new, row)| *new -= share * row);
            }
            let length = new.iter().map(|x| x * x).sum::<f64>().sqrt();
            if length < LEAST {
                basis.truncate(at);
                return met;
            }
            new.iter_mut().for_each(|x| *x /= length);
            along.clear();
            along.resize(looked, 0.0);
            for (row, &share) in left.chunks_exact(looked).zip(&*new) {
                for (sum, value) in along.iter_mut().zip(row) {
                    *sum += share * value;
                }
            }
            squares.fill(0.0);
            for (row, &share) in left.chunks_exact_mut(looked).zip(&*new) {
                for ((value, square), along) in row.iter_mut().zip(&mut *squares).zip(&*along) {
                    *value -= share * along;
                    *square += *value * *value;
                }
            }
            peak.push(along.iter().fold(0.0, |most: f64, x| most.max(x.abs())));
            *count += 1;
        }
    }

    /// Contribution of a product to a channel.
    pub(crate) fn share_of_channel(&self, product: usize, channel: usize) -> f64 {
        self.basis[channel * self.products + product] * self.weight[product]
    }

    /// Contribution of a product's template to that of a channel.
    pub(crate) fn of_template(&self, product: usize, channel: usize) -> f64 {
        self.basis[channel * self.products + product] / self.weight[product]
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Products over a seabed on which two values follow from one position, with a small
    /// independent part.
    fn products(echo: usize) -> Vec<f64> {
        let at = |step: f64| 2.0 * (echo as f64 * step).fract() - 1.0;
        let (place, own) = (at(0.618_034), at(0.754_878));
        let (a, b) = (0.7 * place + 0.1 * own, 0.8 * place * place - 0.2 * place);
        (0..4)
            .flat_map(|p| (0..3).map(move |q| a.powi(p) * b.powi(q)))
            .collect()
    }

    #[test]
    fn merged_channels_keep_every_echo_within_the_tolerance() {
        const ECHOES: usize = 1000;
        let weights: Vec<f64> = (0..12).map(|m| 0.3f64.powi(m / 3 + m % 3)).collect();
        let mut counts = Vec::new();
        for tolerance in [1e-2, 1e-3, 1e-5] {
            let mut merge = Merge::default();
            merge.start(weights.iter().copied(), ECHOES);
            let left = merge.products_mut();
            for echo in 0..ECHOES {
                for (m, value) in products(echo).into_iter().enumerate() {
                    left[m * ECHOES + echo] = value;
                }
            }
            let says = merge.choose(tolerance, SimdLevel::PORTABLE);
            let mut worst: f64 = 0.0;
            for echo in 0..ECHOES {
                let own = products(echo);
                let channel = |i: usize| -> f64 {
                    let parts = own.iter().enumerate();
                    parts.map(|(m, c)| merge.share_of_channel(m, i) * c).sum()
                };
                let channels: Vec<f64> = (0..merge.count).map(channel).collect();
                let off = |m: usize| {
                    let parts = channels.iter().enumerate();
                    let met: f64 = parts.map(|(i, c)| merge.of_template(m, i) * c).sum();
                    weights[m] * (met - own[m])
                };
                worst = worst.max((0..12).map(|m| off(m).powi(2)).sum::<f64>().sqrt());
                for (channel, peak) in channels.iter().zip(&merge.peak) {
                    assert!(channel.abs() <= peak * (1.0 + 1e-9), "{channel} > {peak}");
                }
            }
            println!("{tolerance:e}: {} channels, left {worst:e}", merge.count);
            assert!(worst <= tolerance && (worst - says).abs() < 1e-9 + 1e-6 * says);
            counts.push(merge.count);
        }
        // Without merging, as many products are needed as bring the remaining weights below the
        // tolerance.
        let apart = [1e-2, 1e-3, 1e-5].map(|tolerance: f64| {
            let mut sorted = weights.clone();
            sorted.sort_by(f64::total_cmp);
            let mut square = 0.0;
            let spared = sorted.iter().take_while(|weight| {
                square += *weight * *weight;
                square <= tolerance * tolerance
            });
            12 - spared.count()
        });
        assert!(
            counts[0] < apart[0] && counts[1] < apart[1] && counts[2] <= apart[2],
            "{counts:?} of {apart:?}"
        );
    }
}

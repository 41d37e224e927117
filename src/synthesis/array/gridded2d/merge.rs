//! Fewer channels than products of the series: a few sums of them, as this task's own echoes need.
//!
//! What an echo has of its own (dilation, bend, twist, swing) is given product by product of Chebyshev's terms. Over a sea floor those hang
//! together: nearly all follows from the echo's place, so that the products span far fewer directions than there are. A basis of those
//! directions is found among the surveyed echoes, always adding the echo that is met worst so far (Gram and Schmidt with pivots), each
//! product weighed by the most that its template is. So the greatest of what is left is known.

use crate::array::gridded::simd_level::{Kind as Processor, SimdLevel};

/// Echoes that are looked at; more are thinned out evenly.
const MAX_LOOKED: usize = 4096;
/// Every so many echoes, one half way to the next: what corners of boxes do not show.
pub(crate) const MIDWAY: usize = 4;
/// Tenths of a direction beyond this are rounding: no basis grows on them.
const LEAST: f64 = 1e-14;

/// Which sums of products the channels carry.
#[derive(Default)]
pub(crate) struct Merge {
    pub count: usize,
    products: usize,
    /// Orthonormal, `[channel][product]`.
    basis: Vec<f64>,
    /// The most that the template of each product is.
    weight: Vec<f64>,
    /// The most that each channel is of an echo.
    pub peak: Vec<f64>,
    /// Of every echo looked at, what is left of its weighed products, `[product][echo]`.
    left: Vec<f64>,
    squares: Vec<f64>,
    along: Vec<f64>,
    /// Echoes looked at.
    looked: usize,
}

impl Merge {
    /// Forgets everything; `weight` of each product.
    pub(super) fn start(&mut self, weight: impl Iterator<Item = f64>, echoes: usize) {
        self.weight.clear();
        self.weight.extend(weight);
        self.products = self.weight.len();
        self.basis.clear();
        self.peak.clear();
        self.count = 0;
        self.looked = echoes;
    }

    /// How many of so many echoes are looked at, every which, and how many with those between.
    pub(super) fn sample(echoes: usize) -> (usize, usize) {
        let every = echoes.div_ceil(MAX_LOOKED).max(1);
        (every, echoes.div_ceil(every))
    }

    /// Looked at besides, between an echo and the next.
    pub(crate) fn midway(kept: usize) -> usize {
        kept.saturating_sub(1) / MIDWAY
    }

    /// Room for the products of all echoes that are looked at, `[product][echo]`, unspecified.
    pub(crate) fn products_mut(&mut self) -> &mut [f64] {
        self.left.resize(self.products * self.looked, 0.0);
        &mut self.left
    }

    /// A channel of its own for every product of `among`, which an echo has up to `peak` times.
    pub(crate) fn keep_apart(&mut self, among: impl Iterator<Item = usize>, peak: f64) {
        for product in among {
            let row = self.basis.len();
            self.basis.resize(row + self.products, 0.0);
            self.basis[row + product] = 1.0;
            self.peak.push(peak * self.weight[product]);
            self.count += 1;
        }
    }

    /// Adds channels until no echo's products of `among` (the others are to be 0) are left by more than `tolerance`. Returns the most that is.
    pub(super) fn choose(&mut self, tolerance: f64, simd_level: SimdLevel) -> f64 {
        #[cfg(target_arch = "x86_64")]
        match simd_level.kind() {
            // SAFETY: a `SimdLevel` of that kind is proof that the processor has these.
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
            // A new direction: what is left of the echo that is met worst, made orthogonal once more against rounding.
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

    /// How much of a product goes into a channel.
    pub(crate) fn share_of_channel(&self, product: usize, channel: usize) -> f64 {
        self.basis[channel * self.products + product] * self.weight[product]
    }

    /// How much of a product's template a channel's has.
    pub(crate) fn of_template(&self, product: usize, channel: usize) -> f64 {
        self.basis[channel * self.products + product] / self.weight[product]
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Products of a bottom on which two things follow from one place, a little of their own beside it.
    fn products(echo: usize) -> Vec<f64> {
        let at = |step: f64| 2.0 * (echo as f64 * step).fract() - 1.0;
        let (place, own) = (at(0.618_034), at(0.754_878));
        let (a, b) = (0.7 * place + 0.1 * own, 0.8 * place * place - 0.2 * place);
        (0..4)
            .flat_map(|p| (0..3).map(move |q| a.powi(p) * b.powi(q)))
            .collect()
    }

    #[test]
    fn a_few_sums_of_products_leave_no_echo_more_than_the_tolerance() {
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
        // Kept apart, as many products are needed as leave no more than the tolerance of the weights behind them.
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

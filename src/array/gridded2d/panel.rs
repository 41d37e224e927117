//! Fourier transforms of many columns side by side, one column to a vector lane: no shuffles, and every access is a whole vector.
//!
//! Stockham's self-sorting form (Cooley and Tukey 1965; Stockham 1966), radices 8, 4, 2, 3 and 5, between two buffers.

use std::f64::consts::TAU;

use super::sample::Sample;

/// Columns of one panel.
pub const PANEL: usize = 16;

/// One row of a panel.
#[derive(Clone, Copy)]
#[repr(align(64))]
pub struct Row<T> {
    pub re: [T; PANEL],
    pub im: [T; PANEL],
}

impl<T: Sample> Row<T> {
    pub const ZERO: Self = Self {
        re: [T::ZERO; PANEL],
        im: [T::ZERO; PANEL],
    };

    #[inline(always)]
    fn plus(&self, b: &Self) -> Self {
        let mut sum = *self;
        for j in 0..PANEL {
            sum.re[j] = sum.re[j] + b.re[j];
            sum.im[j] = sum.im[j] + b.im[j];
        }
        sum
    }

    #[inline(always)]
    fn minus(&self, b: &Self) -> Self {
        let mut difference = *self;
        for j in 0..PANEL {
            difference.re[j] = difference.re[j] - b.re[j];
            difference.im[j] = difference.im[j] - b.im[j];
        }
        difference
    }

    /// self + b scale.
    #[inline(always)]
    fn plus_scaled<const FUSED: bool>(&self, b: &Self, scale: T) -> Self {
        let mut sum = *self;
        for j in 0..PANEL {
            sum.re[j] = b.re[j].times_plus::<FUSED>(scale, sum.re[j]);
            sum.im[j] = b.im[j].times_plus::<FUSED>(scale, sum.im[j]);
        }
        sum
    }

    #[inline(always)]
    fn scaled(&self, scale: T) -> Self {
        let mut product = *self;
        for j in 0..PANEL {
            product.re[j] = product.re[j] * scale;
            product.im[j] = product.im[j] * scale;
        }
        product
    }

    /// -j times self.
    #[inline(always)]
    fn turned(&self) -> Self {
        let mut turned = *self;
        for j in 0..PANEL {
            turned.re[j] = self.im[j];
            turned.im[j] = T::ZERO - self.re[j];
        }
        turned
    }

    #[inline(always)]
    fn times<const FUSED: bool>(&self, [re, im]: [T; 2]) -> Self {
        let mut product = *self;
        for j in 0..PANEL {
            product.re[j] = self.re[j].times_plus::<FUSED>(re, T::ZERO - self.im[j] * im);
            product.im[j] = self.im[j].times_plus::<FUSED>(re, self.re[j] * im);
        }
        product
    }
}

/// Rows to columns of a square, by halves, quarters, ...: a few shuffles of whole vectors.
#[inline(always)]
pub fn transposed<T: Sample>(mut square: [[T; PANEL]; PANEL]) -> [[T; PANEL]; PANEL] {
    swap_corners::<T, 8>(&mut square);
    swap_corners::<T, 4>(&mut square);
    swap_corners::<T, 2>(&mut square);
    swap_corners::<T, 1>(&mut square);
    square
}

/// Of every square of twice `D` along the diagonal's blocks, the upper right and the lower left quarter change places.
#[inline(always)]
fn swap_corners<T: Sample, const D: usize>(square: &mut [[T; PANEL]; PANEL]) {
    for i in 0..PANEL {
        if i & D == 0 {
            let (a, b) = (square[i], square[i + D]);
            for j in 0..PANEL {
                if j & D == 0 {
                    square[i + D][j] = a[j + D];
                } else {
                    square[i][j] = b[j - D];
                }
            }
        }
    }
}

type Pair<'a, T> = (&'a mut [Row<T>], &'a mut [Row<T>]);

#[inline(always)]
fn quarters<T>(rows: &mut [Row<T>], s: usize) -> (Pair<'_, T>, Pair<'_, T>) {
    let (low, high) = rows.split_at_mut(2 * s);
    (low.split_at_mut(s), high.split_at_mut(s))
}

/// exp(-j 2pi k q / size), summed over q.
pub struct PanelFft<T> {
    size: usize,
    radices: Vec<usize>,
    /// exp(-j 2pi k / size).
    twiddles: Vec<[T; 2]>,
}

impl<T: Sample> PanelFft<T> {
    /// `size` has no prime factors but 2, 3 and 5.
    pub fn new(size: usize) -> Self {
        let mut radices = Vec::new();
        let mut rest = size;
        for radix in [8, 4, 2, 3, 5] {
            while rest.is_multiple_of(radix) && rest > 1 {
                radices.push(radix);
                rest /= radix;
            }
        }
        assert_eq!(rest, 1, "{size} has other factors than 2, 3 and 5");
        let twiddles = (0..size)
            .map(|k| {
                let angle = TAU * k as f64 / size as f64;
                [T::narrow(libm::cos(angle)), T::narrow(-libm::sin(angle))]
            })
            .collect();
        Self {
            size,
            radices,
            twiddles,
        }
    }

    /// Transforms `from` with the help of two buffers, all `size` rows. Returns the one that the result is in.
    #[inline(always)]
    pub fn run<'a, const FUSED: bool>(
        &self,
        from: &'a [Row<T>],
        [a, b]: [&'a mut [Row<T>]; 2],
    ) -> &'a [Row<T>] {
        let (mut done, mut to) = (&mut a[..self.size], &mut b[..self.size]);
        let Some((&first, rest)) = self.radices.split_first() else {
            return from;
        };
        self.pass::<FUSED>(first, &from[..self.size], done, 1);
        let mut stride = first;
        for &radix in rest {
            self.pass::<FUSED>(radix, done, to, stride);
            stride *= radix;
            std::mem::swap(&mut done, &mut to);
        }
        done
    }

    #[inline(always)]
    fn pass<const FUSED: bool>(
        &self,
        radix: usize,
        from: &[Row<T>],
        to: &mut [Row<T>],
        stride: usize,
    ) {
        let groups = self.size / (stride * radix);
        match radix {
            8 => self.pass8::<FUSED>(from, to, stride, groups),
            4 => self.pass4::<FUSED>(from, to, stride, groups),
            3 => self.pass3::<FUSED>(from, to, stride, groups),
            5 => self.pass5::<FUSED>(from, to, stride, groups),
            _ => self.pass2::<FUSED>(from, to, stride, groups),
        }
    }

    #[inline(always)]
    fn pass2<const FUSED: bool>(&self, from: &[Row<T>], to: &mut [Row<T>], s: usize, m: usize) {
        for p in 0..m {
            let w = self.twiddles[p * s];
            let x = |i: usize| &from[s * (p + m * i)..][..s];
            let (x0, x1) = (x(0), x(1));
            let (y0, y1) = to[s * 2 * p..][..2 * s].split_at_mut(s);
            for q in 0..s {
                y0[q] = x0[q].plus(&x1[q]);
                y1[q] = x0[q].minus(&x1[q]).times::<FUSED>(w);
            }
        }
    }

    #[inline(always)]
    fn pass3<const FUSED: bool>(&self, from: &[Row<T>], to: &mut [Row<T>], s: usize, m: usize) {
        let sin = T::narrow(-libm::sin(TAU / 3.0));
        for p in 0..m {
            let (w1, w2) = (self.twiddles[p * s], self.twiddles[2 * p * s]);
            let x = |i: usize| &from[s * (p + m * i)..][..s];
            let (x0, x1, x2) = (x(0), x(1), x(2));
            let (y0, rest) = to[s * 3 * p..][..3 * s].split_at_mut(s);
            let (y1, y2) = rest.split_at_mut(s);
            for q in 0..s {
                let sum = x1[q].plus(&x2[q]);
                let even = x0[q].plus_scaled::<FUSED>(&sum, T::narrow(-0.5));
                // j sin (x1 - x2), sin negative: forwards.
                let odd = x2[q].minus(&x1[q]).scaled(sin).turned();
                y0[q] = x0[q].plus(&sum);
                y1[q] = even.plus(&odd).times::<FUSED>(w1);
                y2[q] = even.minus(&odd).times::<FUSED>(w2);
            }
        }
    }

    #[inline(always)]
    fn pass4<const FUSED: bool>(&self, from: &[Row<T>], to: &mut [Row<T>], s: usize, m: usize) {
        for p in 0..m {
            let w = |i: usize| self.twiddles[i * p * s];
            let (w1, w2, w3) = (w(1), w(2), w(3));
            let x = |i: usize| &from[s * (p + m * i)..][..s];
            let (x0, x1, x2, x3) = (x(0), x(1), x(2), x(3));
            let (low, high) = to[s * 4 * p..][..4 * s].split_at_mut(2 * s);
            let (y0, y1) = low.split_at_mut(s);
            let (y2, y3) = high.split_at_mut(s);
            for q in 0..s {
                let (even, even_less) = (x0[q].plus(&x2[q]), x0[q].minus(&x2[q]));
                let (odd, odd_less) = (x1[q].plus(&x3[q]), x1[q].minus(&x3[q]).turned());
                y0[q] = even.plus(&odd);
                y1[q] = even_less.plus(&odd_less).times::<FUSED>(w1);
                y2[q] = even.minus(&odd).times::<FUSED>(w2);
                y3[q] = even_less.minus(&odd_less).times::<FUSED>(w3);
            }
        }
    }

    #[inline(always)]
    fn pass8<const FUSED: bool>(&self, from: &[Row<T>], to: &mut [Row<T>], s: usize, m: usize) {
        let half = T::narrow(std::f64::consts::FRAC_1_SQRT_2);
        for p in 0..m {
            let w = |i: usize| self.twiddles[i * p * s];
            let (w1, w2, w3, w4) = (w(1), w(2), w(3), w(4));
            let (w5, w6, w7) = (w(5), w(6), w(7));
            let x = |i: usize| &from[s * (p + m * i)..][..s];
            let (x0, x1, x2, x3) = (x(0), x(1), x(2), x(3));
            let (x4, x5, x6, x7) = (x(4), x(5), x(6), x(7));
            let (low, high) = to[s * 8 * p..][..8 * s].split_at_mut(4 * s);
            let ((y0, y1), (y2, y3)) = quarters(low, s);
            let ((y4, y5), (y6, y7)) = quarters(high, s);
            for q in 0..s {
                let (e0, e2) = (x0[q].plus(&x4[q]), x0[q].minus(&x4[q]));
                let (e1, e3) = (x2[q].plus(&x6[q]), x2[q].minus(&x6[q]).turned());
                let (o0, o2) = (x1[q].plus(&x5[q]), x1[q].minus(&x5[q]));
                let (o1, o3) = (x3[q].plus(&x7[q]), x3[q].minus(&x7[q]).turned());
                let (even, odd) = (e0.plus(&e1), o0.plus(&o1));
                y0[q] = even.plus(&odd);
                y4[q] = even.minus(&odd).times::<FUSED>(w4);
                let (even, odd) = (e0.minus(&e1), o0.minus(&o1).turned());
                y2[q] = even.plus(&odd).times::<FUSED>(w2);
                y6[q] = even.minus(&odd).times::<FUSED>(w6);
                // Times exp(-j pi/4): (x - j x)/sqrt(2).
                let (even, odd) = (e2.plus(&e3), o2.plus(&o3));
                let odd = odd.plus(&odd.turned()).scaled(half);
                y1[q] = even.plus(&odd).times::<FUSED>(w1);
                y5[q] = even.minus(&odd).times::<FUSED>(w5);
                // And exp(-j 3pi/4) = -j exp(-j pi/4).
                let (even, odd) = (e2.minus(&e3), o2.minus(&o3));
                let odd = odd.plus(&odd.turned()).scaled(half).turned();
                y3[q] = even.plus(&odd).times::<FUSED>(w3);
                y7[q] = even.minus(&odd).times::<FUSED>(w7);
            }
        }
    }

    #[inline(always)]
    fn pass5<const FUSED: bool>(&self, from: &[Row<T>], to: &mut [Row<T>], s: usize, m: usize) {
        let (c1, c2) = (libm::cos(TAU / 5.0), libm::cos(2.0 * TAU / 5.0));
        let (s1, s2) = (libm::sin(TAU / 5.0), libm::sin(2.0 * TAU / 5.0));
        let [c1, c2, s1, s2] = [c1, c2, s1, s2].map(T::narrow);
        for p in 0..m {
            let w = |i: usize| self.twiddles[i * p * s];
            let x = |i: usize| &from[s * (p + m * i)..][..s];
            let at = s * 5 * p;
            for q in 0..s {
                let (sum1, less1) = (x(1)[q].plus(&x(4)[q]), x(1)[q].minus(&x(4)[q]));
                let (sum2, less2) = (x(2)[q].plus(&x(3)[q]), x(2)[q].minus(&x(3)[q]));
                let x0 = &x(0)[q];
                let even1 = x0
                    .plus_scaled::<FUSED>(&sum1, c1)
                    .plus_scaled::<FUSED>(&sum2, c2);
                let even2 = x0
                    .plus_scaled::<FUSED>(&sum1, c2)
                    .plus_scaled::<FUSED>(&sum2, c1);
                let odd1 = less1.scaled(s1).plus_scaled::<FUSED>(&less2, s2).turned();
                let odd2 = less1
                    .scaled(s2)
                    .plus_scaled::<FUSED>(&less2, T::ZERO - s1)
                    .turned();
                to[at + q] = x0.plus(&sum1).plus(&sum2);
                to[at + s + q] = even1.plus(&odd1).times::<FUSED>(w(1));
                to[at + 2 * s + q] = even2.plus(&odd2).times::<FUSED>(w(2));
                to[at + 3 * s + q] = even2.minus(&odd2).times::<FUSED>(w(3));
                to[at + 4 * s + q] = even1.minus(&odd1).times::<FUSED>(w(4));
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use echotank_fft::Planned;
    use num_complex::Complex64;

    #[test]
    fn a_square_is_transposed() {
        let square: [[f32; PANEL]; PANEL] =
            std::array::from_fn(|i| std::array::from_fn(|j| (i * PANEL + j) as f32));
        let got = transposed(square);
        for (i, row) in got.iter().enumerate() {
            for (j, value) in row.iter().enumerate() {
                assert_eq!(*value, square[j][i], "{i}, {j}");
            }
        }
    }

    #[test]
    fn every_column_is_what_a_plain_transform_makes_of_it() {
        for size in [1, 2, 3, 4, 5, 8, 12, 30, 96, 60, 64, 768, 4096] {
            let fft = PanelFft::<f64>::new(size);
            let value = |row: usize, lane: usize| {
                Complex64::new(
                    ((row * 7 + lane * 3) % 11) as f64 - 5.0,
                    ((row * 5 + lane) % 13) as f64 - 6.0,
                )
            };
            let mut a = vec![Row::ZERO; size];
            for (r, row) in a.iter_mut().enumerate() {
                row.re = std::array::from_fn(|lane| value(r, lane).re);
                row.im = std::array::from_fn(|lane| value(r, lane).im);
            }
            let (mut b, mut c) = (vec![Row::ZERO; size], vec![Row::ZERO; size]);
            let got = fft.run::<false>(&a, [&mut b, &mut c]);
            for lane in 0..PANEL {
                let mut want: Vec<_> = (0..size).map(|r| value(r, lane)).collect();
                f64::plan_forward(size).process(&mut want);
                for (r, want) in want.iter().enumerate() {
                    let got = Complex64::new(got[r].re[lane], got[r].im[lane]);
                    assert!((got - want).norm() < 1e-10, "{size}: {got} {want}");
                }
            }
        }
    }
}

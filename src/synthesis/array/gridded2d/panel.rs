//! Fourier transforms of many columns, one column per vector lane. There are no shuffles, and every
//! access is a whole vector.
//!
//! Stockham's self-sorting form (Cooley and Tukey 1965; Stockham 1966), radices 8, 4, 2, 3 and 5,
//! between two buffers.

use std::f64::consts::TAU;

use super::sample::Sample;

/// Columns of one panel.
pub(crate) const PANEL: usize = 16;

/// One row of a panel.
#[derive(Clone, Copy)]
#[repr(align(64))]
pub(super) struct Row<T> {
    pub re: [T; PANEL],
    pub im: [T; PANEL],
}

impl<T: Sample> Row<T> {
    pub(super) const ZERO: Self = Self {
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

/// Transposes a square by halves, quarters and so on, with a few shuffles of whole vectors.
#[inline(always)]
pub(crate) fn transposed<T: Sample>(mut square: [[T; PANEL]; PANEL]) -> [[T; PANEL]; PANEL] {
    swap_corners::<T, 8>(&mut square);
    swap_corners::<T, 4>(&mut square);
    swap_corners::<T, 2>(&mut square);
    swap_corners::<T, 1>(&mut square);
    square
}

/// In every square of size twice `D` along the diagonal, exchanges the upper right and lower left
/// quarters.
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

/// exp(-j 2pi k q / size), summed over q.
pub(crate) struct PanelFft<T> {
    size: usize,
    radices: Vec<usize>,
    /// The buffers have a spare row after every `period` rows. Otherwise the rows of a pass would
    /// lie a power of two apart and share cache sets.
    period: usize,
    /// exp(-j 2pi k / size).
    twiddles: Vec<[T; 2]>,
}

impl<T: Sample> PanelFft<T> {
    /// `size` may have only the prime factors 2, 3 and 5.
    pub(super) fn new(size: usize) -> Self {
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
            // The strides of all passes are divisors or multiples of it.
            period: radices.iter().take(2).product::<usize>().max(1),
            radices,
            twiddles,
        }
    }

    /// Rows of a buffer.
    pub(super) fn room(&self) -> usize {
        self.place(self.size) + 1
    }

    /// Index of a row in a buffer.
    #[inline(always)]
    pub(super) fn place(&self, row: usize) -> usize {
        row + row / self.period
    }

    /// Transforms the `size` rows of `from` with two buffers. Returns the buffer with the result,
    /// row r at [`Self::place`].
    #[inline(always)]
    pub(super) fn run<'a, const FUSED: bool>(
        &self,
        from: &'a [Row<T>],
        [a, b]: [&'a mut [Row<T>]; 2],
    ) -> &'a [Row<T>] {
        let (mut done, mut to) = (a, b);
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
        match radix {
            8 => self.each::<8, Eight, FUSED>(from, to, stride),
            4 => self.each::<4, Four, FUSED>(from, to, stride),
            3 => self.each::<3, Three, FUSED>(from, to, stride),
            5 => self.each::<5, Five, FUSED>(from, to, stride),
            _ => self.each::<2, Two, FUSED>(from, to, stride),
        }
    }

    /// One pass over groups of `s`; the input of the first pass is not in a buffer.
    #[inline(always)]
    fn each<const RADIX: usize, B: Butterfly<RADIX>, const FUSED: bool>(
        &self,
        from: &[Row<T>],
        to: &mut [Row<T>],
        s: usize,
    ) {
        let m = self.size / (s * RADIX);
        let together = s.min(self.period);
        for p in 0..m {
            let w: [[T; 2]; RADIX] = std::array::from_fn(|i| self.twiddles[i * p * s]);
            for b in (0..s).step_by(together) {
                let x: [usize; RADIX] = std::array::from_fn(|i| {
                    let row = s * (p + m * i) + b;
                    if s == 1 { row } else { self.place(row) }
                });
                let y: [usize; RADIX] =
                    std::array::from_fn(|i| self.place(s * (RADIX * p + i) + b));
                for q in 0..together {
                    B::run::<T, FUSED>(from, x.map(|x| x + q), to, y.map(|y| y + q), &w);
                }
            }
        }
    }
}

/// Transforms rows at the indices `x` to rows at the indices `y`; `w` are the twiddle factors.
trait Butterfly<const RADIX: usize> {
    fn run<T: Sample, const FUSED: bool>(
        from: &[Row<T>],
        x: [usize; RADIX],
        to: &mut [Row<T>],
        y: [usize; RADIX],
        w: &[[T; 2]; RADIX],
    );
}

struct Two;

impl Butterfly<2> for Two {
    #[inline(always)]
    fn run<T: Sample, const FUSED: bool>(
        from: &[Row<T>],
        x: [usize; 2],
        to: &mut [Row<T>],
        y: [usize; 2],
        w: &[[T; 2]; 2],
    ) {
        let x0 = &from[x[0]];
        let x1 = &from[x[1]];
        to[y[0]] = x0.plus(x1);
        to[y[1]] = x0.minus(x1).times::<FUSED>(w[1]);
    }
}

struct Three;

impl Butterfly<3> for Three {
    #[inline(always)]
    fn run<T: Sample, const FUSED: bool>(
        from: &[Row<T>],
        x: [usize; 3],
        to: &mut [Row<T>],
        y: [usize; 3],
        w: &[[T; 2]; 3],
    ) {
        let x0 = &from[x[0]];
        let x1 = &from[x[1]];
        let x2 = &from[x[2]];
        let sin = T::narrow(-0.866_025_403_784_438_6);
        let sum = x1.plus(x2);
        let even = x0.plus_scaled::<FUSED>(&sum, T::narrow(-0.5));
        // j sin (x1 - x2), with negative sin: forward transform.
        let odd = x2.minus(x1).scaled(sin).turned();
        to[y[0]] = x0.plus(&sum);
        to[y[1]] = even.plus(&odd).times::<FUSED>(w[1]);
        to[y[2]] = even.minus(&odd).times::<FUSED>(w[2]);
    }
}

struct Four;

impl Butterfly<4> for Four {
    #[inline(always)]
    fn run<T: Sample, const FUSED: bool>(
        from: &[Row<T>],
        x: [usize; 4],
        to: &mut [Row<T>],
        y: [usize; 4],
        w: &[[T; 2]; 4],
    ) {
        let x0 = &from[x[0]];
        let x1 = &from[x[1]];
        let x2 = &from[x[2]];
        let x3 = &from[x[3]];
        let (even, even_less) = (x0.plus(x2), x0.minus(x2));
        let (odd, odd_less) = (x1.plus(x3), x1.minus(x3).turned());
        to[y[0]] = even.plus(&odd);
        to[y[1]] = even_less.plus(&odd_less).times::<FUSED>(w[1]);
        to[y[2]] = even.minus(&odd).times::<FUSED>(w[2]);
        to[y[3]] = even_less.minus(&odd_less).times::<FUSED>(w[3]);
    }
}

struct Eight;

impl Butterfly<8> for Eight {
    #[inline(always)]
    fn run<T: Sample, const FUSED: bool>(
        from: &[Row<T>],
        x: [usize; 8],
        to: &mut [Row<T>],
        y: [usize; 8],
        w: &[[T; 2]; 8],
    ) {
        let half = T::narrow(std::f64::consts::FRAC_1_SQRT_2);
        let (x0, x1, x2, x3) = (&from[x[0]], &from[x[1]], &from[x[2]], &from[x[3]]);
        let (x4, x5, x6, x7) = (&from[x[4]], &from[x[5]], &from[x[6]], &from[x[7]]);
        let (e0, e2) = (x0.plus(x4), x0.minus(x4));
        let (e1, e3) = (x2.plus(x6), x2.minus(x6).turned());
        let (o0, o2) = (x1.plus(x5), x1.minus(x5));
        let (o1, o3) = (x3.plus(x7), x3.minus(x7).turned());
        let (even, odd) = (e0.plus(&e1), o0.plus(&o1));
        to[y[0]] = even.plus(&odd);
        to[y[4]] = even.minus(&odd).times::<FUSED>(w[4]);
        let (even, odd) = (e0.minus(&e1), o0.minus(&o1).turned());
        to[y[2]] = even.plus(&odd).times::<FUSED>(w[2]);
        to[y[6]] = even.minus(&odd).times::<FUSED>(w[6]);
        // Times exp(-j pi/4): (x - j x)/sqrt(2).
        let (even, odd) = (e2.plus(&e3), o2.plus(&o3));
        let odd = odd.plus(&odd.turned()).scaled(half);
        to[y[1]] = even.plus(&odd).times::<FUSED>(w[1]);
        to[y[5]] = even.minus(&odd).times::<FUSED>(w[5]);
        // And exp(-j 3pi/4) = -j exp(-j pi/4).
        let (even, odd) = (e2.minus(&e3), o2.minus(&o3));
        let odd = odd.plus(&odd.turned()).scaled(half).turned();
        to[y[3]] = even.plus(&odd).times::<FUSED>(w[3]);
        to[y[7]] = even.minus(&odd).times::<FUSED>(w[7]);
    }
}

struct Five;

impl Butterfly<5> for Five {
    #[inline(always)]
    fn run<T: Sample, const FUSED: bool>(
        from: &[Row<T>],
        x: [usize; 5],
        to: &mut [Row<T>],
        y: [usize; 5],
        w: &[[T; 2]; 5],
    ) {
        let x0 = &from[x[0]];
        let x1 = &from[x[1]];
        let x2 = &from[x[2]];
        let x3 = &from[x[3]];
        let x4 = &from[x[4]];
        // Cosines and sines of one fifth and two fifths of a turn.
        let [c1, c2] = [0.309_016_994_374_947_45, -0.809_016_994_374_947_5].map(T::narrow);
        let [s1, s2] = [0.951_056_516_295_153_5, 0.587_785_252_292_473_1].map(T::narrow);
        let (sum1, less1) = (x1.plus(x4), x1.minus(x4));
        let (sum2, less2) = (x2.plus(x3), x2.minus(x3));
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
        to[y[0]] = x0.plus(&sum1).plus(&sum2);
        to[y[1]] = even1.plus(&odd1).times::<FUSED>(w[1]);
        to[y[2]] = even2.plus(&odd2).times::<FUSED>(w[2]);
        to[y[3]] = even2.minus(&odd2).times::<FUSED>(w[3]);
        to[y[4]] = even1.minus(&odd1).times::<FUSED>(w[4]);
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
    fn every_column_matches_a_plain_transform() {
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
            let (mut b, mut c) = (vec![Row::ZERO; fft.room()], vec![Row::ZERO; fft.room()]);
            let got = fft.run::<false>(&a, [&mut b, &mut c]);
            for lane in 0..PANEL {
                let mut want: Vec<_> = (0..size).map(|r| value(r, lane)).collect();
                f64::plan_forward(size).process(&mut want);
                for (r, want) in want.iter().enumerate() {
                    let row = &got[fft.place(r)];
                    let got = Complex64::new(row.re[lane], row.im[lane]);
                    assert!((got - want).norm() < 1e-10, "{size}: {got} {want}");
                }
            }
        }
    }
}

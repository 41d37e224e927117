//! A block of neighbouring bins.

use super::sample::Sample;

/// Bins processed together. Over this few bins, the rotor from a column to an element hardly
/// changes from that of the middle.
pub(super) const BLOCK: usize = 32;

/// Complex numbers with separate real and imaginary parts.
#[derive(Default)]
pub(crate) struct Split<T> {
    pub re: Vec<T>,
    pub im: Vec<T>,
}

impl<T: Sample> Split<T> {
    /// Resizes to `len`; the contents are unspecified.
    pub(super) fn resize(&mut self, len: usize) {
        self.re.resize(len, T::ZERO);
        self.im.resize(len, T::ZERO);
    }

    /// Resizes to `len` zeros.
    pub(crate) fn clear_to(&mut self, len: usize) {
        self.re.clear();
        self.re.resize(len, T::ZERO);
        self.im.clear();
        self.im.resize(len, T::ZERO);
    }
}

/// A block of complex numbers with separate parts.
#[derive(Clone, Copy)]
pub(crate) struct Lanes<T> {
    pub re: [T; BLOCK],
    pub im: [T; BLOCK],
}

impl<T: Sample> Lanes<T> {
    pub(super) const ZERO: Self = Self {
        re: [T::ZERO; BLOCK],
        im: [T::ZERO; BLOCK],
    };

    #[inline(always)]
    pub(super) fn load(from: &Split<T>, at: usize) -> Self {
        let mut lanes = Self::ZERO;
        lanes.re.copy_from_slice(&from.re[at..][..BLOCK]);
        lanes.im.copy_from_slice(&from.im[at..][..BLOCK]);
        lanes
    }

    /// at + x slope, a complex line over real `x`.
    #[inline(always)]
    pub(super) fn line<const FUSED: bool>(at: [T; 2], slope: [T; 2], x: &[T; BLOCK]) -> Self {
        let mut lanes = Self::ZERO;
        for (j, &x) in x.iter().enumerate() {
            lanes.re[j] = slope[0].times_plus::<FUSED>(x, at[0]);
            lanes.im[j] = slope[1].times_plus::<FUSED>(x, at[1]);
        }
        lanes
    }

    #[inline(always)]
    pub(super) fn add(&mut self, a: &Self) {
        for j in 0..BLOCK {
            self.re[j] = self.re[j] + a.re[j];
            self.im[j] = self.im[j] + a.im[j];
        }
    }

    #[inline(always)]
    pub(crate) fn add_product<const FUSED: bool>(&mut self, a: &Self, b: &Self) {
        for j in 0..BLOCK {
            let re = a.re[j].times_plus::<FUSED>(b.re[j], self.re[j]);
            let im = a.re[j].times_plus::<FUSED>(b.im[j], self.im[j]);
            self.re[j] = (-a.im[j]).times_plus::<FUSED>(b.im[j], re);
            self.im[j] = a.im[j].times_plus::<FUSED>(b.re[j], im);
        }
    }

    #[inline(always)]
    pub(super) fn times<const FUSED: bool>(&self, b: &Self) -> Self {
        let mut product = Self::ZERO;
        product.add_product::<FUSED>(self, b);
        product
    }

    /// Multiplies by j theta scale.
    #[inline(always)]
    pub(super) fn turn(&mut self, theta: &[T; BLOCK], scale: T) {
        for (j, &theta) in theta.iter().enumerate() {
            let angle = theta * scale;
            (self.re[j], self.im[j]) = (T::ZERO - self.im[j] * angle, self.re[j] * angle);
        }
    }
}

/// A sum of products of blocks with four separate real products, so no addition depends on the
/// previous one.
#[derive(Clone, Copy)]
pub(crate) struct ProductSum<T> {
    parts: [[T; BLOCK]; 4],
}

impl<T: Sample> ProductSum<T> {
    pub(super) const ZERO: Self = Self {
        parts: [[T::ZERO; BLOCK]; 4],
    };

    #[inline(always)]
    pub(crate) fn add_product<const FUSED: bool>(&mut self, a: &Lanes<T>, b: &Lanes<T>) {
        let [re_re, im_im, re_im, im_re] = &mut self.parts;
        for j in 0..BLOCK {
            re_re[j] = a.re[j].times_plus::<FUSED>(b.re[j], re_re[j]);
            im_im[j] = a.im[j].times_plus::<FUSED>(b.im[j], im_im[j]);
            re_im[j] = a.re[j].times_plus::<FUSED>(b.im[j], re_im[j]);
            im_re[j] = a.im[j].times_plus::<FUSED>(b.re[j], im_re[j]);
        }
    }

    #[inline(always)]
    pub(super) fn sum(&self) -> Lanes<T> {
        let [re_re, im_im, re_im, im_re] = &self.parts;
        let mut sum = Lanes::ZERO;
        for j in 0..BLOCK {
            sum.re[j] = re_re[j] - im_im[j];
            sum.im[j] = re_im[j] + im_re[j];
        }
        sum
    }
}

//! Fades and peaks of windows of Gaussian samples: how far the mean squares of a few independent samples stray from their means in the worst of
//! many windows.
//!
//! `looks` is the logarithm of the number of windows, `n` the number of independent samples of each.

/// The greatest of mean squares of `n` samples, over their mean: Laurent and Massart 2000, Lemma 1, in its sharper form for complex samples.
pub(crate) fn worst_peak(looks: f64, n: f64) -> f64 {
    let l = looks / n;
    1.0 + (2.0 * l).sqrt() + l
}

/// The greatest ratio of mean squares of `n` samples to those of `n` others, each over its mean. For two gamma variables of shape n,
/// P(ratio > R) <= (4 R/(1 + R)^2)^n by Chernoff's bound.
pub(crate) fn worst_ratio(looks: f64, n: f64) -> f64 {
    let half = 2.0 * (looks / n).exp() - 1.0;
    half + (half * half - 1.0).max(0.0).sqrt()
}

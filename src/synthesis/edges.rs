//! Weights of the samples next to the edges of an echo.

/// Weights of the samples next to the edges of an echo in a sum over echoes. An echo of a rectangular pulse starts and ends with
/// a step between two samples.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Edges {
    /// No weights: the value at the sample, as from a receiver without a filter.
    #[default]
    Sampled,
    /// Samples next to a step are weighted with [`edge_corrections`]. A convolution sum over them converges to its integral with
    /// order five in the step, instead of order one.
    Weighted,
}

/// Number of samples that [`edge_corrections`] weights at each end of an echo.
pub const EDGE_POINTS: usize = 4;

/// Corrections to the weight 1 of the first samples inside an edge, outermost first. `inside` is the distance of the outermost
/// sample from the edge in steps, 0..1.
///
/// Exact for cubics. The weights are those of Gregory's formula for an edge on a sample (251, 897, 633, 739 over 720). The
/// integral between the edge and the outermost sample is added, for the cubic through the four samples. With one sample instead
/// of four, the weight would be the covered part of its cell, `inside` + 1/2.
pub fn edge_corrections(inside: f64) -> [f64; EDGE_POINTS] {
    let x = inside;
    [
        x * (1.0 + x * (11.0 / 12.0 + x * (1.0 / 3.0 + x / 24.0))) - 469.0 / 720.0,
        177.0 / 720.0 - x * x * (1.5 + x * (5.0 / 6.0 + x / 8.0)),
        x * x * (0.75 + x * (2.0 / 3.0 + x / 8.0)) - 87.0 / 720.0,
        19.0 / 720.0 - x * x * (1.0 / 6.0 + x * (1.0 / 6.0 + x / 24.0)),
    ]
}

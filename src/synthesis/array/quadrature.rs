//! Receiver filter without dense samples: the integral of its response times an echo, by Gauss and Legendre's rule on panels in which both are smooth.
//!
//! Input: pieces of echoes, each analytic between two instants. Result: samples after the filter, exact to about 1e-9 of an echo. The response is that
//! of [`Decimator`]. It has corners at its ends, so panels end where a corner meets a sample. All whole panels of all echoes share their nodes and are
//! summed before the filter; a part of a panel has nodes of its own.

use num_complex::Complex64;

use super::filter::Decimator;

/// Number of nodes of a panel of a length, in samples. An echo behind the filter has up to one oscillation per sample, or one and a half with short
/// flanks; ten nodes leave 1e-10 of it.
fn nodes(panel: f64) -> usize {
    4 + (7.0 * panel).ceil() as usize
}

/// Shorter panels, in samples, hold nothing.
const SHORTEST: f64 = 1e-9;

/// Node of a rule.
#[derive(Clone, Copy)]
pub(crate) struct Node {
    /// Position: of shared nodes, samples after a sample.
    pub(crate) at: f64,
    pub(crate) weight: f64,
}

/// Sum of echoes at one element after the receiver filter.
pub(crate) struct Quadrature<'a> {
    filter: &'a Decimator,
    first_sample_s: f64,
    /// Corners after a sample, samples: panels of sample n are between n + corners[i] and n + corners[i + 1].
    corners: Vec<f64>,
    /// Nodes of all panels of a sample.
    nodes: Vec<Node>,
    /// Number of samples from the first cell to the first sample of the output.
    reach: usize,
    /// Number of cells: of samples from `reach` before the first one to `reach` after the last one.
    cells: usize,
    /// Sums at the nodes: node-major, a value for each cell.
    values: Vec<Complex64>,
    /// Contributions of parts of panels.
    parts: Vec<Complex64>,
}

impl<'a> Quadrature<'a> {
    /// For `count` samples from `first_sample_s`.
    pub(crate) fn new(filter: &'a Decimator, first_sample_s: f64, count: usize) -> Self {
        let half = filter.response_half_s() * filter.sample_rate_hz();
        let corner = half.fract();
        let (low, high) = (corner.min(1.0 - corner), corner.max(1.0 - corner));
        let mut corners = vec![low];
        if high - low > SHORTEST {
            corners.push(high);
        }
        corners.push(low + 1.0);
        let panels = corners.windows(2);
        let nodes: Vec<Node> = panels.flat_map(|ends| rule(ends[0], ends[1])).collect();
        let reach = half.ceil() as usize + 2;
        let cells = count + 2 * reach;
        Self {
            filter,
            first_sample_s,
            corners,
            values: vec![Complex64::ZERO; nodes.len() * cells],
            nodes,
            reach,
            cells,
            parts: vec![Complex64::ZERO; count],
        }
    }

    /// Instants of the shared nodes, in the order of the indices that [`Self::add`] passes.
    pub(crate) fn shared_s(&self) -> impl Iterator<Item = f64> {
        (0..self.nodes.len())
            .flat_map(move |g| (0..self.cells).map(move |cell| self.node_s(g, cell)))
    }

    fn node_s(&self, g: usize, cell: usize) -> f64 {
        let samples = cell as f64 - self.reach as f64 + self.nodes[g].at;
        self.first_sample_s + samples / self.filter.sample_rate_hz()
    }

    /// Adds a piece of an echo between two instants. `echo` gets instants within the piece, and the index of each shared node.
    pub(crate) fn add(
        &mut self,
        (begin_s, end_s): (f64, f64),
        mut echo: impl FnMut(f64, Option<usize>) -> Complex64,
    ) {
        let rate_hz = self.filter.sample_rate_hz();
        let samples = |at_s: f64| (at_s - self.first_sample_s) * rate_hz;
        let outermost = self.reach as f64;
        let begin = samples(begin_s).max(-outermost + 1.0);
        let end = samples(end_s).min((self.cells as f64) - outermost - 1.0);
        if end - begin <= SHORTEST {
            return;
        }
        let low = self.corners[0];
        let (first, last) = ((begin - low).floor() as i64, (end - low).floor() as i64);
        for sample in first..=last {
            for panel in 0..self.corners.len() - 1 {
                let from = sample as f64 + self.corners[panel];
                let to = sample as f64 + self.corners[panel + 1];
                let (part_from, part_to) = (from.max(begin), to.min(end));
                if part_to - part_from <= SHORTEST {
                    continue;
                }
                if part_from == from && part_to == to {
                    let cell = (sample + self.reach as i64) as usize;
                    for g in self.panel_nodes(panel) {
                        let index = g * self.cells + cell;
                        let value = echo(self.node_s(g, cell), Some(index));
                        self.values[index] += value;
                    }
                    continue;
                }
                for node in rule(part_from, part_to) {
                    let value = echo(self.first_sample_s + node.at / rate_hz, None);
                    self.add_part(node, value);
                }
            }
        }
    }

    /// Indices of the nodes of a panel.
    fn panel_nodes(&self, panel: usize) -> std::ops::Range<usize> {
        let length = |panel: usize| self.corners[panel + 1] - self.corners[panel];
        let first = (0..panel).map(|before| nodes(length(before))).sum();
        first..first + nodes(length(panel))
    }

    fn add_part(&mut self, node: Node, value: Complex64) {
        let rate_hz = self.filter.sample_rate_hz();
        let half = self.filter.response_half_s() * rate_hz;
        let first = (node.at - half).ceil().max(0.0) as usize;
        let end = ((node.at + half).floor() + 1.0).max(0.0) as usize;
        let end = end.min(self.parts.len());
        for n in first..end {
            let response = self.filter.response((n as f64 - node.at) / rate_hz);
            self.parts[n] += value * (response * node.weight / rate_hz);
        }
    }

    /// Overwrites `out` with the samples.
    pub(crate) fn finish(self, out: &mut [Complex64]) {
        out.copy_from_slice(&self.parts);
        let rate_hz = self.filter.sample_rate_hz();
        for (node, values) in self.nodes.iter().zip(self.values.chunks(self.cells)) {
            // Sample n is `reach` cells after cell n.
            let taps: Vec<f64> = (0..=2 * self.reach)
                .map(|k| self.reach as f64 - k as f64 - node.at)
                .map(|after| self.filter.response(after / rate_hz) * node.weight / rate_hz)
                .collect();
            for (sample, values) in out.iter_mut().zip(values.windows(taps.len())) {
                let products = taps.iter().zip(values).map(|(tap, value)| value * tap);
                *sample += products.sum::<Complex64>();
            }
        }
    }
}

/// Nodes of Gauss and Legendre's rule on a panel between two positions in samples.
pub(crate) fn rule(from: f64, to: f64) -> impl Iterator<Item = Node> {
    let (middle, half) = (0.5 * (from + to), 0.5 * (to - from));
    gauss_legendre(nodes(to - from))
        .iter()
        .map(move |&(x, weight)| Node {
            at: middle + half * x,
            weight: half * weight,
        })
}

/// Most nodes of a rule: of a panel of one sample, whose length may round up.
const MAX_NODES: usize = 12;

/// Nodes on -1..1 and weights of the rule of `count` nodes, by Newton's iteration on the Legendre polynomial (Abramowitz and Stegun, 25.4.29).
fn gauss_legendre(count: usize) -> &'static [(f64, f64)] {
    static RULES: std::sync::LazyLock<Vec<Vec<(f64, f64)>>> = std::sync::LazyLock::new(|| {
        let rule = |count: usize| {
            let node = |i: usize| {
                let n = count as f64;
                let mut x = libm::cos(std::f64::consts::PI * (i as f64 + 0.75) / (n + 0.5));
                let mut slope = 1.0;
                for _ in 0..20 {
                    let (mut before, mut value) = (1.0, x);
                    for k in 2..=count {
                        let k = k as f64;
                        (before, value) = (
                            value,
                            ((2.0 * k - 1.0) * x * value - (k - 1.0) * before) / k,
                        );
                    }
                    slope = n * (x * value - before) / (x * x - 1.0);
                    x -= value / slope;
                }
                (x, 2.0 / ((1.0 - x * x) * slope * slope))
            };
            (0..count).map(node).collect()
        };
        (0..=MAX_NODES).map(rule).collect()
    });
    &RULES[count.min(MAX_NODES)]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_rule_integrates_polynomials_of_twice_its_degree() {
        for count in 4..=MAX_NODES {
            for power in 0..2 * count as i32 {
                let got: f64 = gauss_legendre(count)
                    .iter()
                    .map(|(x, w)| w * x.powi(power))
                    .sum();
                let want = if power % 2 == 0 {
                    2.0 / f64::from(power + 1)
                } else {
                    0.0
                };
                assert!((got - want).abs() < 1e-14, "{count} {power}: {got} {want}");
            }
        }
    }
}

//! How punctual a sonar is: high-dynamic-range histograms of microseconds.

use std::sync::{Mutex, PoisonError};

use hdrhistogram::Histogram;

/// Counted apart up to here, microseconds (ten minutes); what is beyond counts as this.
const MAX_US: u64 = 600_000_000;
/// Two digits: percentiles within 1 %.
const DIGITS: u8 = 2;

/// Of a picture of a histogram: the first bin ends here, and each is so many times as wide as the one before.
const FIRST_BIN_US: u64 = 16;
const BIN_GROWTH: f64 = 2.0;

/// Of one sonar. Their memory is all taken when they are made.
pub struct Histograms {
    start_error: Spread,
    margin: Spread,
    nav_to_samples: Spread,
    hand_over: Spread,
    pacing: Spread,
}

/// One histogram.
pub struct Spread(Mutex<Histogram<u64>>);

impl Default for Spread {
    fn default() -> Self {
        Self::new()
    }
}

impl Spread {
    pub fn new() -> Self {
        let histogram = Histogram::new_with_bounds(1, MAX_US, DIGITS);
        Self(Mutex::new(
            histogram.expect("bounds that hdrhistogram takes"),
        ))
    }

    pub fn note(&self, us: u64) {
        let mut histogram = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        histogram.saturating_record(us);
    }

    /// Where bins end, microseconds, and what is in them.
    pub fn bins(&self) -> Vec<(u64, u64)> {
        let histogram = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        let bins = histogram.iter_log(FIRST_BIN_US, BIN_GROWTH);
        let bins = bins.map(|bin| (bin.value_iterated_to(), bin.count_since_last_iteration()));
        bins.collect()
    }

    /// The same in bins of so many microseconds.
    pub fn bins_of(&self, step_us: u64) -> Vec<(u64, u64)> {
        let histogram = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        let bins = histogram.iter_linear(step_us);
        let bins = bins.map(|bin| (bin.value_iterated_to(), bin.count_since_last_iteration()));
        bins.collect()
    }

    pub fn figures(&self) -> Figures {
        let histogram = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        Figures {
            count: histogram.len(),
            min_us: histogram.min(),
            p01_us: histogram.value_at_quantile(0.001),
            p1_us: histogram.value_at_quantile(0.01),
            p50_us: histogram.value_at_quantile(0.5),
            p99_us: histogram.value_at_quantile(0.99),
            p999_us: histogram.value_at_quantile(0.999),
            max_us: histogram.max(),
            sum_us: (histogram.mean() * histogram.len() as f64) as u64,
        }
    }
}

/// A histogram in a few words.
#[derive(Clone, Copy, Debug, PartialEq, Eq, serde::Serialize)]
pub struct Figures {
    pub count: u64,
    pub(crate) min_us: u64,
    /// A thousandth and a hundredth are no more than this: the bad end of a margin.
    pub(crate) p01_us: u64,
    pub(crate) p1_us: u64,
    pub p50_us: u64,
    pub p99_us: u64,
    pub p999_us: u64,
    pub max_us: u64,
    /// Of all values, to the histogram's resolution.
    #[serde(skip)]
    pub(crate) sum_us: u64,
}

impl Histograms {
    pub fn new() -> Self {
        Self {
            start_error: Spread::new(),
            margin: Spread::new(),
            nav_to_samples: Spread::new(),
            hand_over: Spread::new(),
            pacing: Spread::new(),
        }
    }

    /// A ping's records began to be handed over so long after their instant.
    pub(crate) fn start_error_us(&self, us: u64) {
        self.start_error.note(us);
    }

    /// A ping was whole so long before its records had to leave; too late counts as 0.
    pub(crate) fn margin_us(&self, ns: i64) {
        self.margin.note((ns.max(0) / 1000) as u64);
    }

    /// From the pulse, whose motion is the newest the ping is made with, until its samples were whole.
    pub(crate) fn nav_to_samples_us(&self, ns: i64) {
        self.nav_to_samples.note((ns.max(0) / 1000) as u64);
    }

    /// All of a ping's records were with the servers and the recorder so long after their instant.
    pub(crate) fn handed_over_us(&self, ns: i64) {
        self.hand_over.note((ns.max(0) / 1000) as u64);
    }

    /// A group of datagrams left so long after its own instant.
    pub(crate) fn pacing_us(&self, ns: i64) {
        self.pacing.note((ns.max(0) / 1000) as u64);
    }

    /// By name: where bins end, microseconds, and what is in them; up to the last with anything in it.
    pub fn bins(&self) -> [(&'static str, Vec<(u64, u64)>); 5] {
        [
            ("start_error", self.start_error.bins()),
            ("compute_margin", self.margin.bins()),
            ("nav_to_samples", self.nav_to_samples.bins()),
            ("hand_over", self.hand_over.bins()),
            ("send_pacing", self.pacing.bins()),
        ]
    }

    /// Name, meaning, figures.
    pub fn all(&self) -> [(&'static str, &'static str, Figures); 5] {
        [
            (
                "start_error",
                "From the instant a ping's records were due until they began to be handed over",
                self.start_error.figures(),
            ),
            (
                "compute_margin",
                "From when a ping was computed until its records were due",
                self.margin.figures(),
            ),
            (
                "nav_to_samples",
                "From the pulse until the ping was computed",
                self.nav_to_samples.figures(),
            ),
            (
                "hand_over",
                "From the instant a ping's records were due until all were handed over",
                self.hand_over.figures(),
            ),
            (
                "send_pacing",
                "From the instant a group of datagrams was due until it was handed to the kernel",
                self.pacing.figures(),
            ),
        ]
    }
}

impl Default for Histograms {
    fn default() -> Self {
        Self::new()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn percentiles_are_within_one_in_a_hundred_and_nothing_is_too_large() {
        let histograms = Histograms::new();
        for us in 1..=1000 {
            histograms.start_error_us(us);
        }
        let figures = histograms.all()[0].2;
        assert_eq!((figures.count, figures.min_us), (1000, 1));
        for (got, want) in [
            (figures.p50_us, 500.0),
            (figures.p99_us, 990.0),
            (figures.p999_us, 999.0),
            (figures.max_us, 1000.0),
        ] {
            assert!((got as f64 / want - 1.0).abs() < 0.01, "{got} {want}");
        }
        let (name, bins) = &histograms.bins()[0];
        assert_eq!(*name, "start_error");
        assert_eq!(bins.iter().map(|(_, count)| count).sum::<u64>(), 1000);
        assert!(bins.windows(2).all(|w| w[0].0 < w[1].0), "{bins:?}");
        histograms.margin_us(i64::MAX);
        histograms.margin_us(-5);
        let margin = histograms.all()[1].2;
        assert_eq!((margin.count, margin.min_us), (2, 0));
        assert!(margin.max_us >= MAX_US);
    }
}

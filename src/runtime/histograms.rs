//! Latency histograms of a sonar's output, in microseconds (HdrHistogram).

use std::sync::{Mutex, PoisonError};

use hdrhistogram::Histogram;

/// Largest recorded value, microseconds (ten minutes). Larger values count as this value.
const MAX_US: u64 = 600_000_000;
/// Significant decimal digits, so that percentiles are within 1 %.
const DIGITS: u8 = 2;

/// End of the first logarithmic bin, microseconds.
const FIRST_BIN_US: u64 = 16;
/// Width of each logarithmic bin relative to the one before.
const BIN_GROWTH: f64 = 2.0;

/// Latency histograms of one sonar. Memory is allocated only at creation.
#[derive(Default)]
pub struct Histograms {
    start_error: LatencyHistogram,
    margin: LatencyHistogram,
    nav_to_samples: LatencyHistogram,
    hand_over: LatencyHistogram,
    pacing: LatencyHistogram,
}

/// A thread-safe histogram of durations in microseconds.
pub struct LatencyHistogram(Mutex<Histogram<u64>>);

impl Default for LatencyHistogram {
    fn default() -> Self {
        Self::new()
    }
}

impl LatencyHistogram {
    /// Creates an empty histogram with all its memory allocated.
    pub fn new() -> Self {
        let histogram = Histogram::new_with_bounds(1, MAX_US, DIGITS);
        Self(Mutex::new(
            histogram.expect("bounds that hdrhistogram takes"),
        ))
    }

    /// Records one duration, microseconds.
    pub fn note(&self, us: u64) {
        let mut histogram = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        histogram.saturating_record(us);
    }

    /// Logarithmic bins as (end in microseconds, count).
    pub fn bins(&self) -> Vec<(u64, u64)> {
        let histogram = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        let bins = histogram.iter_log(FIRST_BIN_US, BIN_GROWTH);
        let bins = bins.map(|bin| (bin.value_iterated_to(), bin.count_since_last_iteration()));
        bins.collect()
    }

    /// Linear bins of `step_us` microseconds as (end in microseconds, count).
    pub fn bins_of(&self, step_us: u64) -> Vec<(u64, u64)> {
        let histogram = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        let bins = histogram.iter_linear(step_us);
        let bins = bins.map(|bin| (bin.value_iterated_to(), bin.count_since_last_iteration()));
        bins.collect()
    }

    /// Count, extremes and percentiles.
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

/// Count, extremes and percentiles of a histogram, microseconds.
#[derive(Clone, Copy, Debug, PartialEq, Eq, serde::Serialize)]
pub struct Figures {
    /// Number of recorded durations.
    pub count: u64,
    /// Minimum.
    pub(crate) min_us: u64,
    /// 0.1 % quantile: the critical end of a margin.
    pub(crate) p01_us: u64,
    /// 1 % quantile.
    pub(crate) p1_us: u64,
    /// Median.
    pub p50_us: u64,
    /// 99 % quantile.
    pub p99_us: u64,
    /// 99.9 % quantile.
    pub p999_us: u64,
    /// Maximum.
    pub max_us: u64,
    /// Sum of all values, within the resolution of the histogram.
    #[serde(skip)]
    pub(crate) sum_us: u64,
}

impl Histograms {
    /// Records the delay of a ping's delivery start after its deadline, us.
    pub(crate) fn start_error_us(&self, us: u64) {
        self.start_error.note(us);
    }

    /// Records the time from the completion of a ping to its deadline, ns; a late ping counts as 0.
    pub(crate) fn margin_us(&self, ns: i64) {
        self.margin.note((ns.max(0) / 1000) as u64);
    }

    /// Records the time from the pulse to the completion of the ping, ns. The pulse is the instant of the newest motion used.
    pub(crate) fn nav_to_samples_us(&self, ns: i64) {
        self.nav_to_samples.note((ns.max(0) / 1000) as u64);
    }

    /// Records the delay of a ping's complete delivery after its deadline, ns.
    pub(crate) fn note_delivery(&self, ns: i64) {
        self.hand_over.note((ns.max(0) / 1000) as u64);
    }

    /// Records the delay of a group of datagrams after its scheduled instant, ns.
    pub(crate) fn pacing_us(&self, ns: i64) {
        self.pacing.note((ns.max(0) / 1000) as u64);
    }

    /// Logarithmic bins by histogram name, as (end in microseconds, count), up to the last non-empty bin.
    pub fn bins(&self) -> [(&'static str, Vec<(u64, u64)>); 5] {
        self.named()
            .map(|(name, _, histogram)| (name, histogram.bins()))
    }

    /// Name, description and figures of every histogram.
    pub fn all(&self) -> [(&'static str, &'static str, Figures); 5] {
        self.named()
            .map(|(name, description, histogram)| (name, description, histogram.figures()))
    }

    fn named(&self) -> [(&'static str, &'static str, &LatencyHistogram); 5] {
        [
            (
                "start_error",
                "From the due time of a ping's records until the delivery began",
                &self.start_error,
            ),
            (
                "compute_margin",
                "From the end of a ping's computation until its records were due",
                &self.margin,
            ),
            (
                "nav_to_samples",
                "From the pulse until the ping was computed",
                &self.nav_to_samples,
            ),
            (
                "hand_over",
                "From the due time of a ping's records until the delivery of all ended",
                &self.hand_over,
            ),
            (
                "send_pacing",
                "From the due time of a group of datagrams until it was passed to the kernel",
                &self.pacing,
            ),
        ]
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn percentiles_are_within_one_percent_and_large_values_are_clamped() {
        let histograms = Histograms::default();
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

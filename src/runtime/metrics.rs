//! The Prometheus text exposition (format 0.0.4) of `/metrics`, written by the `prometheus` crate.

use prometheus::TextEncoder;
use prometheus::proto::{
    Counter, Gauge, LabelPair, Metric, MetricFamily, MetricType, Quantile, Summary,
};

/// Whether a value only grows.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Kind {
    Counter,
    Gauge,
}

/// Names and values of a sample's labels.
pub(crate) type Labels<'a> = &'a [(&'static str, &'a str)];

/// One metric with a sample for each set of labels.
pub(crate) struct Family(MetricFamily);

impl Family {
    pub(crate) fn new(name: &str, help: &str, kind: Kind) -> Self {
        Self::of(
            name,
            help,
            match kind {
                Kind::Counter => MetricType::COUNTER,
                Kind::Gauge => MetricType::GAUGE,
            },
        )
    }

    /// Creates a family of quantiles.
    pub(crate) fn summary(name: &str, help: &str) -> Self {
        Self::of(name, help, MetricType::SUMMARY)
    }

    fn of(name: &str, help: &str, field_type: MetricType) -> Self {
        let mut family = MetricFamily::default();
        family.set_name(format!("echotank_{name}"));
        family.set_help(help.to_owned());
        family.set_field_type(field_type);
        Self(family)
    }

    pub(crate) fn push(&mut self, labels: Labels<'_>, value: f64) {
        let mut metric = metric(labels);
        match self.0.get_field_type() {
            MetricType::COUNTER => {
                let mut counter = Counter::default();
                counter.set_value(value);
                metric.set_counter(counter);
            }
            _ => {
                let mut gauge = Gauge::default();
                gauge.set_value(value);
                metric.set_gauge(gauge);
            }
        }
        self.0.mut_metric().push(metric);
    }

    /// Adds a summary. `quantiles` holds pairs of quantile and value; `sum` is the sum of all observations.
    pub(crate) fn push_summary(
        &mut self,
        labels: Labels<'_>,
        quantiles: &[(f64, f64)],
        sum: f64,
        count: u64,
    ) {
        let quantile = |&(quantile, value): &(f64, f64)| {
            let mut pair = Quantile::default();
            pair.set_quantile(quantile);
            pair.set_value(value);
            pair
        };
        let mut summary = Summary::default();
        summary.set_quantile(quantiles.iter().map(quantile).collect());
        summary.set_sample_sum(sum);
        summary.set_sample_count(count);
        let mut metric = metric(labels);
        metric.set_summary(summary);
        self.0.mut_metric().push(metric);
    }
}

fn metric(labels: Labels<'_>) -> Metric {
    let pair = |&(name, value): &(&'static str, &str)| {
        let mut pair = LabelPair::default();
        pair.set_name(name.to_owned());
        pair.set_value(value.to_owned());
        pair
    };
    Metric::from_label(labels.iter().map(pair).collect())
}

/// Formats the exposition. Families without samples are omitted.
pub(crate) fn text(families: Vec<Family>) -> String {
    let families: Vec<_> = families
        .into_iter()
        .map(|Family(family)| family)
        .filter(|family| !family.get_metric().is_empty())
        .collect();
    // The encoder cannot fail, because every family has a name and a sample.
    TextEncoder::new()
        .encode_to_string(&families)
        .unwrap_or_default()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn families_are_written_with_their_kind_and_escaped_labels() {
        let mut made = Family::new("pings_made", "Pings computed", Kind::Counter);
        made.push(&[("sonar", "a\"b")], 3.0);
        let mut error = Family::new("checked_error", "Measured error", Kind::Gauge);
        error.push(&[("sonar", "c")], 1.5e-4);
        let mut late = Family::summary("start_error_seconds", "Lateness");
        late.push_summary(&[("sonar", "c")], &[(0.5, 0.001), (1.0, 0.25)], 0.5, 7);
        let empty = Family::new("empty", "No samples", Kind::Gauge);
        assert_eq!(
            text(vec![made, error, late, empty]),
            "# HELP echotank_pings_made Pings computed\n\
             # TYPE echotank_pings_made counter\n\
             echotank_pings_made{sonar=\"a\\\"b\"} 3\n\
             # HELP echotank_checked_error Measured error\n\
             # TYPE echotank_checked_error gauge\n\
             echotank_checked_error{sonar=\"c\"} 0.00015\n\
             # HELP echotank_start_error_seconds Lateness\n\
             # TYPE echotank_start_error_seconds summary\n\
             echotank_start_error_seconds{sonar=\"c\",quantile=\"0.5\"} 0.001\n\
             echotank_start_error_seconds{sonar=\"c\",quantile=\"1\"} 0.25\n\
             echotank_start_error_seconds_sum{sonar=\"c\"} 0.5\n\
             echotank_start_error_seconds_count{sonar=\"c\"} 7\n"
        );
    }
}

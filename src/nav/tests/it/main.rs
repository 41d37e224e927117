//! Tests of the navigation from bytes to motion: sentences, formats, recorded logs, history.

mod decode;
mod detection;
mod formats;
mod history;
mod logs;
mod mounting;

use echotank_config::spec::{
    NavChannel, NavInputSpec, NavSourceSpec, NavSpec, TimePolicy, VerticalSpec,
};
use echotank_core::navigation::{NavQuantity, NavSample};
use echotank_core::time::{NS_PER_S, UtcNs};
use echotank_nav::NavCounters;
use echotank_testing::allocations::Counting;

#[global_allocator]
static COUNTING: Counting = Counting;

const ALL: [NavChannel; 5] = [
    NavChannel::Position,
    NavChannel::CourseSpeed,
    NavChannel::Heading,
    NavChannel::RollPitch,
    NavChannel::Heave,
];

/// A recorded log at the reference point of the vessel, with required checksums and message times.
fn log_source(provides: &[NavChannel]) -> NavSourceSpec {
    let input = NavInputSpec::Log {
        path: "test.log".into(),
        plain_rate_hz: 10.0,
    };
    NavSourceSpec {
        time: TimePolicy::Message,
        ..echotank_testing::nav::source("test", input, provides)
    }
}

/// Navigation in mode `settle` 2 m below the waterline, with 30 s of history.
fn nav_spec(sources: Vec<NavSourceSpec>) -> NavSpec {
    NavSpec {
        vertical: VerticalSpec::Waterline {
            reference_down_m: 2.0,
        },
        history_s: 30.0,
        ..echotank_testing::nav::nav(sources)
    }
}

const T0: UtcNs = UtcNs(1_406_851_200 * NS_PER_S);

/// A sample that is valid and received `time_s` seconds after [`T0`].
fn sample(source: u16, time_s: f64, quantity: NavQuantity) -> NavSample {
    let utc = T0.plus_s(time_s);
    NavSample {
        source,
        valid_utc: utc,
        arrival_utc: utc,
        quantity,
    }
}

/// Sum of the sentences of all classes. Every sentence is in one class.
fn sum_of_classes(c: &NavCounters) -> u64 {
    let refused = c.refused_checksum + c.malformed + c.unsupported + c.empty_fields;
    c.used + refused + c.not_taken + c.time_jumps
}

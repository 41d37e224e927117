//! Navigation from bytes to motion: sentences, formats, recorded logs, history.

mod decode;
mod formats;
mod history;
mod logs;
mod mounting;

use echotank_config::spec::{ChecksumPolicy, NavChannel, NavInputSpec, NavSourceSpec, TimePolicy};
use echotank_testing::allocations::Counting;
use glam::DVec3;

#[global_allocator]
static COUNTING: Counting = Counting;

const ALL: [NavChannel; 5] = [
    NavChannel::Position,
    NavChannel::CourseSpeed,
    NavChannel::Heading,
    NavChannel::RollPitch,
    NavChannel::Heave,
];

/// A recorded log at the vessel's reference point that must have checksums and is timed by its messages.
fn log_source(provides: &[NavChannel]) -> NavSourceSpec {
    NavSourceSpec {
        name: "test".into(),
        input: NavInputSpec::Log {
            path: "test.log".into(),
            plain_rate_hz: 10.0,
        },
        time: TimePolicy::Message,
        checksum: ChecksumPolicy::Require,
        lever_arm_m: DVec3::ZERO,
        mounting: Default::default(),
        dialect: Default::default(),
        provides: provides.to_vec(),
    }
}

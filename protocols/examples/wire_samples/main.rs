//! Writes one small file per format into a folder, for third-party readers: `wire_samples FOLDER`.
//!
//! `tools/test_wire_readers.py` states the contents a second time, from the same definitions: integers of [`count`], one position, one
//! attitude.

mod jsf;
mod ping_protocol;
mod recordings;
mod vita49;
mod wbms;
mod xtf;

use std::path::Path;

/// 2025-06-15 15:06:40.123456789 UTC.
pub const UTC_NS: i64 = 1_750_000_000_123_456_789;
/// Southern and western hemisphere, all angles different, heading near a full turn.
pub const LATITUDE_DEG: f64 = -36.8;
pub const LONGITUDE_DEG: f64 = -121.8;
pub const HEADING_DEG: f64 = 359.9;
pub const PITCH_BOW_UP_DEG: f64 = 3.0;
pub const ROLL_PORT_UP_DEG: f64 = 5.0;
pub const SOUND_SPEED_M_PER_S: f32 = 1500.0;

/// The integer of sample `k` in channel `c` of ping `p`: -20000..=20000, all rows different.
pub(crate) fn count(p: u64, c: u64, k: u64) -> i16 {
    (((k * 7_919 + c * 104_729 + p * 15_485_863) % 40_001) as i32 - 20_000) as i16
}

fn main() -> std::io::Result<()> {
    let folder = std::env::args_os()
        .nth(1)
        .expect("usage: wire_samples FOLDER");
    let folder = Path::new(&folder);
    std::fs::create_dir_all(folder)?;
    jsf::write(folder)?;
    xtf::write(folder)?;
    vita49::write(folder)?;
    recordings::write(folder)?;
    ping_protocol::write(folder)?;
    wbms::write(folder)
}

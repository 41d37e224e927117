//! Description of the machine and its load during a measurement.

use echotank_protocols::calendar::DateTime;

fn first_line(path: &str, key: &str) -> Option<String> {
    let text = std::fs::read_to_string(path).ok()?;
    let line = text.lines().find(|line| line.starts_with(key))?;
    Some(line.split(':').next_back()?.trim().to_string())
}

/// Model of the processor.
pub(crate) fn processor() -> String {
    let name = first_line("/proc/cpuinfo", "model name").unwrap_or_else(|| "unknown".into());
    let name = name.replace("(R)", "");
    name.split(" Processor").next().unwrap_or(&name).to_owned()
}

/// Processor, cores, vector instructions and one-minute load average.
pub(crate) fn describe() -> String {
    let processor = processor();
    let cores = std::thread::available_parallelism().map_or(0, std::num::NonZero::get);
    let simd_level = echotank_core::simd::SimdLevel::best();
    format!(
        "{processor}, {cores} cores, {:?}, load {}",
        simd_level.kind(),
        load()
    )
}

/// The day in UTC, as YYYY-MM-DD.
pub(crate) fn today() -> String {
    let elapsed = std::time::SystemTime::now()
        .duration_since(std::time::UNIX_EPOCH)
        .unwrap_or_default();
    let now = DateTime::from_utc_ns(elapsed.as_nanos() as i64);
    format!("{:04}-{:02}-{:02}", now.year, now.month, now.day)
}

/// One-minute load average. Above about 1, other load affects a single-thread measurement on two
/// cores.
pub(crate) fn load() -> String {
    std::fs::read_to_string("/proc/loadavg")
        .ok()
        .and_then(|text| text.split_whitespace().next().map(str::to_string))
        .unwrap_or_else(|| "unknown".into())
}

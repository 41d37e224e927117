//! `echotank doctor`: checks whether this machine can run the daemon on time and without packet loss.

use std::fs;
use std::path::Path;

use clap::Args;

use super::Failure;
use echotank_runtime::io::priority::{self, Limit};

/// Required kernel limit of socket buffers, bytes: a whole ping of 128 elements.
const SOCKET_BUFFER_BYTES: u64 = 4 << 20;
/// Required number of file descriptors for clients, ports and files, with margin.
const OPEN_FILES: u64 = 1024;
/// Default of `run.priority`.
const PRIORITY: u64 = 40;
/// Value of `run.compute_nice` that takes effect beside other compute-bound programs.
const COMPUTE_NICE: i64 = -10;

#[derive(Args, Clone, Debug)]
pub(crate) struct DoctorArgs {
    /// Print JSON
    #[arg(long)]
    pub(crate) json: bool,
}

#[derive(Clone, Debug, PartialEq, Eq, serde::Serialize)]
struct Finding {
    what: &'static str,
    good: bool,
    found: String,
    /// Remedy; empty if good.
    #[serde(skip_serializing_if = "String::is_empty")]
    advice: String,
}

impl Finding {
    fn of(what: &'static str, good: bool, found: impl Into<String>, advice: &str) -> Self {
        let advice = if good { "" } else { advice };
        Self {
            what,
            good,
            found: found.into(),
            advice: advice.to_owned(),
        }
    }
}

pub(crate) fn main(args: &DoctorArgs) -> Result<(), Failure> {
    let findings = findings(Path::new("/"));
    if args.json {
        println!("{}", serde_json::json!(findings));
    } else {
        for finding in &findings {
            let mark = if finding.good { "good" } else { "BAD " };
            println!("{mark}  {:<22} {}", finding.what, finding.found);
            if !finding.advice.is_empty() {
                println!("      {:<22} -> {}", "", finding.advice);
            }
        }
    }
    match findings.iter().filter(|finding| !finding.good).count() {
        0 => Ok(()),
        bad => Err(Failure::Running(format!(
            "{bad} of {} checks failed; the daemon runs, but may be late or lose packets",
            findings.len()
        ))),
    }
}

fn line(root: &Path, file: &str) -> Option<String> {
    let text = fs::read_to_string(root.join(file)).ok()?;
    Some(text.trim().to_owned())
}

fn number(root: &Path, file: &str) -> Option<u64> {
    line(root, file)?.parse().ok()
}

/// Runs every check. `root` is the root of the file system.
fn findings(root: &Path) -> Vec<Finding> {
    let mut all = Vec::new();
    for (what, file) in [
        ("receive buffers", "proc/sys/net/core/rmem_max"),
        ("send buffers", "proc/sys/net/core/wmem_max"),
    ] {
        let bytes = number(root, file);
        let key = file.trim_start_matches("proc/sys/").replace('/', ".");
        all.push(Finding::of(
            what,
            bytes.is_some_and(|bytes| bytes >= SOCKET_BUFFER_BYTES),
            bytes.map_or("unknown".into(), |b| {
                format!("at most {b} bytes per socket")
            }),
            &format!("sysctl -w {key}={SOCKET_BUFFER_BYTES}"),
        ));
    }
    let root_user = priority::is_root();
    let rtprio = priority::limit(Limit::RealTimePriority);
    all.push(Finding::of(
        "real-time priority",
        root_user || rtprio >= PRIORITY,
        match (root_user, rtprio) {
            (true, _) => "root".to_owned(),
            (_, limit) => format!("limit {limit}"),
        },
        "LimitRTPRIO=50 in the service, or `@audio - rtprio 50` in /etc/security/limits.d",
    ));
    // RLIMIT_NICE is 20 minus the lowest allowed nice value.
    let lowest_nice = 20 - priority::limit(Limit::Nice).min(40) as i64;
    all.push(Finding::of(
        "nice values",
        root_user || lowest_nice <= COMPUTE_NICE,
        match root_user {
            true => "root".to_owned(),
            false => format!("{lowest_nice} and above"),
        },
        "LimitNICE=-10 in the service, or `- nice -10` in /etc/security/limits.d: for run.compute_nice, if other programs load the processor",
    ));
    let locked = priority::limit(Limit::LockedMemory);
    all.push(Finding::of(
        "locked memory",
        root_user || locked == u64::MAX,
        match (root_user, locked) {
            (true, _) => "root".to_owned(),
            (_, u64::MAX) => "unlimited".to_owned(),
            (_, bytes) => format!("limit {bytes} bytes"),
        },
        "LimitMEMLOCK=infinity in the service, or `- memlock unlimited` in /etc/security/limits.d",
    ));
    let files = priority::limit(Limit::OpenFiles);
    all.push(Finding::of(
        "open files",
        files >= OPEN_FILES,
        format!("limit {files}"),
        "LimitNOFILE=4096 in the service",
    ));
    let governor = line(root, "sys/devices/system/cpu/cpu0/cpufreq/scaling_governor");
    all.push(Finding::of(
        "frequency governor",
        governor
            .as_deref()
            .is_none_or(|governor| governor == "performance"),
        governor.unwrap_or_else(|| "none: the system does not control the frequency".into()),
        "cpupower frequency-set -g performance",
    ));
    let source = line(
        root,
        "sys/devices/system/clocksource/clocksource0/current_clocksource",
    );
    all.push(Finding::of(
        "clock source",
        source
            .as_deref()
            .is_none_or(|s| !matches!(s, "acpi_pm" | "refined-jiffies")),
        source.unwrap_or_else(|| "unknown".into()),
        "slow clock source: boot with clocksource=tsc if the processor's TSC is stable",
    ));
    let (disciplined, error_us) = priority::clock_discipline();
    all.push(Finding::of(
        "clock discipline",
        disciplined,
        match disciplined {
            true => format!("disciplined, estimated error {error_us} us"),
            false => "no program disciplines the clock".to_owned(),
        },
        "run chrony, ntpd or ptp4l: time stamps with nav.stamp = \"host\" follow this clock",
    ));
    all.extend(mtus(root));
    all
}

/// Checks the MTU of every network interface except loopback.
fn mtus(root: &Path) -> Vec<Finding> {
    let Ok(entries) = fs::read_dir(root.join("sys/class/net")) else {
        return Vec::new();
    };
    let mut names: Vec<String> = entries
        .flatten()
        .map(|entry| entry.file_name().to_string_lossy().into_owned())
        .filter(|name| name != "lo")
        .collect();
    names.sort();
    names
        .iter()
        .filter_map(|name| {
            let mtu = number(root, &format!("sys/class/net/{name}/mtu"))?;
            Some(Finding::of(
                "MTU",
                mtu >= 1500,
                format!("{name} {mtu}"),
                "ip link set dev NAME mtu 1500: a smaller MTU fragments datagrams",
            ))
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn put(root: &Path, file: &str, text: &str) {
        let path = root.join(file);
        fs::create_dir_all(path.parent().expect("a folder")).expect("made");
        fs::write(path, text).expect("written");
    }

    #[test]
    fn small_buffers_a_powersave_governor_and_a_small_mtu_are_found() {
        let folder = tempfile::tempdir().expect("folder");
        let root = folder.path();
        put(root, "proc/sys/net/core/rmem_max", "212992\n");
        put(root, "proc/sys/net/core/wmem_max", "8388608\n");
        put(
            root,
            "sys/devices/system/cpu/cpu0/cpufreq/scaling_governor",
            "powersave\n",
        );
        put(root, "sys/class/net/eth0/mtu", "576\n");
        put(root, "sys/class/net/lo/mtu", "65536\n");
        let all = findings(root);
        let good = |what: &str| {
            let found: Vec<_> = all.iter().filter(|f| f.what == what).collect();
            assert_eq!(found.len(), 1, "{what}");
            assert_eq!(found[0].good, found[0].advice.is_empty());
            found[0].good
        };
        assert!(!good("receive buffers"));
        assert!(good("send buffers"));
        assert!(!good("frequency governor"));
        assert!(!good("MTU"), "loopback is skipped");
        assert!(good("clock source"), "an unknown value is not a failure");
    }
}

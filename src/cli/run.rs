//! `echotank run`: the daemon.

use std::io::{self, Write};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread;
use std::time::Duration;

use clap::Args;
use tempfile::TempDir;

use super::{Failure, load};
use echotank_config::spec::{NavInputSpec, RigSpec, SeabedShape};
use echotank_runtime::daemon::{Daemon, DaemonError};
use echotank_runtime::io::nav::NavOpenError;
use echotank_runtime::io::signals;
use echotank_runtime::rig::OpenError;

/// Default configuration in the repository: a real navigation log over a real seabed.
const QUICKSTART: &str = "hil-configs/quickstart.toml";

#[derive(Args, Clone, Debug, Default)]
pub(crate) struct RunArgs {
    /// Configuration file (TOML) [default: hil-configs/quickstart.toml, or the built-in copy of it]
    pub(crate) config: Option<PathBuf>,
    /// Change a value before checking, e.g. --set 'sonar.output.sevenk.listen="127.0.0.1:7001"' (every [[sonar]]) or --set sonar.0.ping.range_m=75
    #[arg(long = "set", value_name = "KEY=VALUE")]
    pub(crate) set: Vec<String>,
    /// Write what the live navigation sources receive, and the pings, to this new file (pcapng); `replay --nav FILE` repeats the run
    #[arg(long, value_name = "FILE")]
    pub(crate) record_nav: Option<PathBuf>,
    /// Threads; 0 means one per core (default: the configuration's)
    #[arg(long)]
    pub(crate) threads: Option<usize>,
    /// Stop after this many seconds (default: run until SIGINT or SIGTERM)
    #[arg(long, value_name = "S", allow_negative_numbers = true)]
    pub(crate) seconds: Option<f64>,
}

/// The quickstart and its data for a program without its repository, by name in the folder of the configuration.
const BUILT_IN: [(&str, &[u8]); 4] = [
    (
        "quickstart.toml",
        include_bytes!("../../hil-configs/quickstart.toml"),
    ),
    (
        "data/nbp1406_s330_2014-08-01.rvdas",
        include_bytes!("../../hil-configs/data/nbp1406_s330_2014-08-01.rvdas"),
    ),
    (
        "data/jd211_crop_400x400_2m.asc",
        include_bytes!("../../hil-configs/data/jd211_crop_400x400_2m.asc"),
    ),
    (
        "data/quickstart_targets.csv",
        include_bytes!("../../hil-configs/data/quickstart_targets.csv"),
    ),
];

/// Writes the built-in quickstart into a temporary folder, which is removed with the guard.
fn built_in_quickstart() -> io::Result<TempDir> {
    let folder = tempfile::Builder::new().prefix("echotank-").tempdir()?;
    std::fs::create_dir(folder.path().join("data"))?;
    for (name, content) in BUILT_IN {
        std::fs::write(folder.path().join(name), content)?;
    }
    Ok(folder)
}

/// Describes navigation sources, seabed and sonars, one line each.
fn describe(spec: &RigSpec) -> Vec<String> {
    let mut lines = Vec::new();
    for source in &spec.nav.sources {
        lines.push(match &source.input {
            NavInputSpec::Log { path, .. } | NavInputSpec::Csv { path } => {
                let how = if spec.nav.loop_log { ", looped" } else { "" };
                format!("navigation from {}{how}", path.display())
            }
            NavInputSpec::Udp { listen, .. } => format!("navigation from UDP {listen}"),
            NavInputSpec::TcpConnect { address } => {
                format!("navigation from the TCP server {address}")
            }
            NavInputSpec::TcpListen { listen } => {
                format!("navigation from a client of TCP {listen}")
            }
            NavInputSpec::Serial { port, baud, .. } => {
                format!("navigation from {port} at {baud} baud")
            }
        });
    }
    match spec.scene.seabed.as_ref().map(|seabed| &seabed.shape) {
        Some(SeabedShape::File { file, .. }) => {
            lines.push(format!("seabed {}", file.path.display()))
        }
        Some(SeabedShape::Plane { depth_m, .. }) => {
            lines.push(format!("seabed: plane at {depth_m} m depth"))
        }
        Some(SeabedShape::Paper(shape)) => lines.push(format!("seabed {}", shape.name())),
        None => {}
    }
    for sonar in &spec.sonars {
        lines.push(format!(
            "sonar {}: {} elements at {:.1} kHz, {:.0} m range, at most {} pings/s",
            sonar.name,
            sonar
                .receive
                .iter()
                .map(|array| array.elements)
                .sum::<usize>(),
            sonar.pulse.center_frequency_hz / 1e3,
            sonar.settings.range_m,
            sonar.settings.max_ping_rate_hz,
        ));
    }
    lines
}

/// The failure to open a port or device, with its remedy.
fn not_opened(error: &DaemonError) -> Failure {
    let text = error.to_string();
    let remedy = if text.contains("Address already in use") {
        "; another program uses this port: end it, or choose another port (0 means any free one)"
    } else if text.contains("serial port") {
        "; `ls /dev/tty* /dev/serial/by-id` shows the ports, and the group of the device may use it"
    } else {
        ""
    };
    Failure::Running(format!("{text}{remedy}"))
}

/// Prints a line. Errors are ignored, so that the daemon continues after its standard output is closed.
fn print_line(line: &str) {
    let _ = writeln!(io::stdout(), "{line}");
}

pub(crate) fn main(args: &RunArgs) -> Result<(), Failure> {
    let mut built_in = None;
    let path = match &args.config {
        Some(path) => path.clone(),
        None if Path::new(QUICKSTART).exists() => PathBuf::from(QUICKSTART),
        None => {
            let folder = built_in_quickstart().map_err(|error| {
                Failure::Running(format!("no temporary folder for the quickstart: {error}"))
            })?;
            built_in.insert(folder).path().join("quickstart.toml")
        }
    };
    if let Some(seconds) = args.seconds.filter(|s| !(s.is_finite() && *s > 0.0)) {
        let why = format!("--seconds {seconds}: must be above 0");
        return Err(Failure::Configuration(why));
    }
    let mut spec = load(&path, &args.set)?;
    // The user did not choose the control port of the quickstart, so any free port is acceptable.
    spec.control.or_any_port = args.config.is_none();
    if let Some(file) = &args.record_nav {
        let name = file.display();
        let refuse = |why| {
            Err(Failure::Configuration(format!(
                "--record-nav {name}: {why}"
            )))
        };
        if spec.nav.is_recorded() {
            return refuse("this rig has no live navigation source; replay its log");
        }
        if file.exists() {
            return refuse("exists; name a new file");
        }
    }
    let stop = Arc::new(AtomicBool::new(false));
    signals::stop_on_signals(&stop).map_err(Failure::running)?;
    let threads = args.threads.unwrap_or(spec.run.threads);
    let mut daemon = Daemon::open(&spec, threads, stop.clone()).map_err(|error| match &error {
        DaemonError::Rig(OpenError::Nav(NavOpenError::Source { .. })) => not_opened(&error),
        DaemonError::Rig(error) => Failure::opening(error),
        _ => not_opened(&error),
    })?;
    if let Some(file) = &args.record_nav {
        daemon.record_navigation(file).map_err(Failure::running)?;
    }
    print_line(&format!(
        "echotank {}: {}",
        env!("CARGO_PKG_VERSION"),
        path.display()
    ));
    for line in describe(&spec).into_iter().chain(daemon.describe()) {
        print_line(&line);
    }
    let look = match daemon.page() {
        Some(address) => format!("open http://{address}/ in a browser, or"),
        None => "to print records:".to_owned(),
    };
    print_line(&format!(
        "pinging; stop with Ctrl-C; {look} echotank listen ADDRESS"
    ));
    if let Some(seconds) = args.seconds {
        let stop = stop.clone();
        thread::spawn(move || {
            thread::sleep(Duration::from_secs_f64(seconds.min(1e9)));
            stop.store(true, Ordering::Release);
        });
    }
    daemon.run(print_line).map_err(Failure::running)
}

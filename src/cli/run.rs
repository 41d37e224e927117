//! `echotank run`: the daemon.

use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread;
use std::time::Duration;

use clap::Args;

use super::{Failure, load};
use echotank_config::spec::{NavInputSpec, RigSpec, SeabedShape};
use echotank_runtime::daemon::Daemon;
use echotank_runtime::io::signals;

/// Runs when no configuration is named: a real navigation log over a real seabed, both in the repository.
const QUICKSTART: &str = "hil-configs/quickstart.toml";

#[derive(Args, Clone, Debug, Default)]
pub(crate) struct RunArgs {
    /// Configuration file (TOML) [default: hil-configs/quickstart.toml]
    pub(crate) config: Option<PathBuf>,
    /// Change a value before checking, e.g. --set 'sonar.output.sevenk.listen="127.0.0.1:7001"' (every [[sonar]]) or --set sonar.0.ping.range_m=75
    #[arg(long = "set", value_name = "KEY=VALUE")]
    pub(crate) set: Vec<String>,
    /// Threads; 0 means as many as there are cores (default: the configuration's)
    #[arg(long)]
    pub(crate) threads: Option<usize>,
    /// Stop after this many seconds (default: run until SIGINT or SIGTERM)
    #[arg(long, value_name = "S")]
    pub(crate) seconds: Option<f64>,
}

/// The quickstart: in the folder we are in or, for a build from source, where it was built.
fn quickstart() -> Result<PathBuf, Failure> {
    let built = Path::new(env!("CARGO_MANIFEST_DIR")).join(QUICKSTART);
    [PathBuf::from(QUICKSTART), built].into_iter().find(|path| path.exists()).ok_or_else(|| {
        Failure::Configuration(format!(
            "no configuration was named, and {QUICKSTART} is not here; name one (`echotank check --template` prints one to start from)"
        ))
    })
}

/// Where the platform's motion, the seabed and the pings come from, a line each.
fn what_it_does(spec: &RigSpec) -> Vec<String> {
    let mut lines = Vec::new();
    for source in &spec.nav.sources {
        lines.push(match &source.input {
            NavInputSpec::Log { path, .. } | NavInputSpec::Csv { path } => {
                let how = if spec.nav.loop_log { ", for ever" } else { "" };
                format!("replays {}{how}", path.display())
            }
            NavInputSpec::Udp { listen, .. } => format!("takes navigation from UDP {listen}"),
            NavInputSpec::TcpConnect { address } => {
                format!("takes navigation from the TCP server {address}")
            }
            NavInputSpec::TcpListen { listen } => {
                format!("takes navigation from a client of TCP {listen}")
            }
            NavInputSpec::Serial { port, baud, .. } => {
                format!("takes navigation from {port} at {baud} baud")
            }
        });
    }
    match spec.scene.seabed.as_ref().map(|seabed| &seabed.shape) {
        Some(SeabedShape::File { file, .. }) => lines.push(format!("over {}", file.path.display())),
        Some(SeabedShape::Plane { depth_m, .. }) => {
            lines.push(format!("over a plane {depth_m} m deep"))
        }
        Some(SeabedShape::Paper(shape)) => lines.push(format!("over {}", shape.name())),
        None => {}
    }
    for sonar in &spec.sonars {
        lines.push(format!(
            "sonar {}: {} elements at {:.1} kHz, {:.0} m range, {} pings/s at most",
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

pub(crate) fn main(args: &RunArgs) -> Result<(), Failure> {
    let path = match &args.config {
        Some(path) => path.clone(),
        None => quickstart()?,
    };
    let mut spec = load(&path, &args.set)?;
    // Nobody asked for the quickstart's port.
    spec.control.or_any_port = args.config.is_none();
    let stop = Arc::new(AtomicBool::new(false));
    signals::stop_on_signals(&stop).map_err(Failure::running)?;
    let threads = args.threads.unwrap_or(spec.run.threads);
    let daemon = Daemon::open(&spec, threads, stop.clone()).map_err(Failure::running)?;
    println!("echotank {}: {}", env!("CARGO_PKG_VERSION"), path.display());
    for line in what_it_does(&spec).into_iter().chain(daemon.describe()) {
        println!("{line}");
    }
    let look = match daemon.page() {
        Some(address) => format!("open http://{address}/ in a browser, or"),
        None => "to look:".to_owned(),
    };
    println!("pinging; stop with Ctrl-C; {look} echotank listen ADDRESS");
    if let Some(seconds) = args.seconds {
        if !(seconds.is_finite() && seconds > 0.0) {
            return Err(Failure::Configuration(format!(
                "--seconds {seconds}: must be above 0"
            )));
        }
        let stop = stop.clone();
        thread::spawn(move || {
            thread::sleep(Duration::from_secs_f64(seconds.min(1e9)));
            stop.store(true, Ordering::Release);
        });
    }
    daemon
        .run(|status| println!("{status}"))
        .map_err(Failure::running)
}

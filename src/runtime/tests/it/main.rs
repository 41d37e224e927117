//! Configurations, navigation inputs and servers, with files and sockets.

mod config_accepts;
mod config_refuses;
mod families;
mod nav_failover;
mod nav_inputs;
mod nav_rates;
mod seats;
mod server;

use std::time::{Duration, Instant};

/// Time limit of a wait.
const PATIENCE: Duration = Duration::from_secs(20);

fn eventually(what: &str, mut holds: impl FnMut() -> bool) {
    let deadline = Instant::now() + PATIENCE;
    while !holds() {
        assert!(Instant::now() < deadline, "never came: {what}");
        std::thread::sleep(Duration::from_millis(2));
    }
}

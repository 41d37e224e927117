//! SIGINT, SIGTERM and SIGHUP.

use std::io;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread;
use std::time::{Duration, Instant};

use tokio::signal::unix::{Signal, SignalKind, signal};

/// Time within which a second signal is ignored. A shell signals the process group, and a wrapper can signal its child again.
const SAME_WISH: Duration = Duration::from_secs(1);

/// Sets `stop` at the first SIGINT, SIGTERM or SIGHUP. A SIGHUP that the parent process ignores (`nohup`) stays ignored. A further signal more than 1
/// s later ends the process at once with status 128 + signal; recorded files stay readable.
///
/// # Errors
/// The signal handlers or their thread cannot be installed.
pub fn stop_on_signals(stop: &Arc<AtomicBool>) -> io::Result<()> {
    let runtime = tokio::runtime::Builder::new_current_thread()
        .enable_io()
        .build()?;
    let (mut interrupt, mut terminate, mut hangup) = {
        let _inside = runtime.enter();
        (
            signal(SignalKind::interrupt())?,
            signal(SignalKind::terminate())?,
            (!is_hangup_ignored())
                .then(|| signal(SignalKind::hangup()))
                .transpose()?,
        )
    };
    let stop = stop.clone();
    thread::Builder::new()
        .name("signals".into())
        .spawn(move || {
            runtime.block_on(async {
                let mut first: Option<Instant> = None;
                loop {
                    let number = tokio::select! {
                        _ = interrupt.recv() => 2,
                        _ = terminate.recv() => 15,
                        _ = receive(&mut hangup) => 1,
                    };
                    match first {
                        None => {
                            first = Some(Instant::now());
                            stop.store(true, Ordering::Release);
                            tracing::info!(signal = number, "stopping");
                        }
                        Some(at) if at.elapsed() > SAME_WISH => std::process::exit(128 + number),
                        Some(_) => {}
                    }
                }
            });
        })?;
    Ok(())
}

/// Waits for a signal. Never returns if the signal has no handler.
async fn receive(signal: &mut Option<Signal>) {
    match signal {
        Some(signal) => {
            signal.recv().await;
        }
        None => std::future::pending().await,
    }
}

fn is_hangup_ignored() -> bool {
    // SAFETY: a null action only reads the present one into `action`, which is plain data.
    unsafe {
        let mut action: libc::sigaction = std::mem::zeroed();
        libc::sigaction(libc::SIGHUP, std::ptr::null(), &raw mut action) == 0
            && action.sa_sigaction == libc::SIG_IGN
    }
}

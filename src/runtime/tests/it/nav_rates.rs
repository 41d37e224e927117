//! Attitude at 1 kHz with positions at 100 Hz, over UDP and a serial line, while pings are predicted: nothing is lost.
//!
//! Three seconds here; `ECHOTANK_NAV_RATE_S=600 cargo nextest run --test nav_rates --no-capture` is the long form, and prints how old the newest attitude is at a ping.

use std::io::Write;
use std::net::UdpSocket;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

use echotank_config::spec::*;
use echotank_core::frames::Trajectory;
use echotank_core::time::UtcNs;
use echotank_nav::NavHistory;
use echotank_runtime::clock::{Clock, SystemClock};
use echotank_runtime::io::nav::NavInputs;
use echotank_testing::nav::{nav, sentence, source, udp};
use serialport::SerialPort;

use super::nav_inputs::pseudo_terminal;
use super::{PATIENCE, eventually};

/// 921600 Bd carries 92 kB/s; this traffic is 46 kB/s.
const BAUD: u32 = 921_600;
const STEP: Duration = Duration::from_millis(1);
const PING: Duration = Duration::from_millis(20);

fn seconds() -> u64 {
    let asked = std::env::var("ECHOTANK_NAV_RATE_S").ok();
    asked.and_then(|s| s.parse().ok()).unwrap_or(3)
}

fn spec(input: NavInputSpec) -> NavSpec {
    let provides = [
        NavChannel::Position,
        NavChannel::Heading,
        NavChannel::RollPitch,
    ];
    NavSpec {
        mode: NavMode::Predict,
        max_extrapolation_s: 5.0,
        history_s: 10.0,
        ..nav(vec![source("ins", input, &provides)])
    }
}

/// Sends on time, late sentences at once. Returns the number of sentences sent.
fn send(mut out: impl FnMut(&[u8]), seconds: u64) -> u64 {
    let start = Instant::now();
    let mut sent = 0;
    for i in 0..seconds * 1000 {
        let due = start + STEP * i as u32;
        let left = due.saturating_duration_since(Instant::now());
        std::thread::sleep(left);
        let t = i as f64 / 1000.0;
        let (roll, pitch) = (5.0 * t.sin(), 2.0 * (1.3 * t).sin());
        out(&sentence(&format!(
            "PRDID,{pitch:+07.2},{roll:+07.2},045.00"
        )));
        sent += 1;
        if i % 10 == 0 {
            let minutes = 10.0 + t * 1e-4;
            out(&sentence(&format!(
                "GPGGA,,54{minutes:08.5},N,010{minutes:08.5},E,1,12,0.7,1.0,M,,M,,"
            )));
            sent += 1;
        }
    }
    sent
}

fn check(
    name: &str,
    spec: &NavSpec,
    start: impl FnOnce(&NavInputs) -> std::thread::JoinHandle<u64>,
) {
    let clock: Arc<dyn Clock> = Arc::new(SystemClock::new());
    let mut inputs = NavInputs::open(spec, clock.clone()).expect("opens");
    let mut history = NavHistory::new(spec);
    let mut trajectory = Trajectory::default();
    let sender = start(&inputs);
    let mut ages_ms = Vec::new();
    while !sender.is_finished() {
        std::thread::sleep(PING);
        inputs.pull(UtcNs(i64::MAX), &mut history);
        let Some(timeline) = inputs.timeline() else {
            continue;
        };
        let now = timeline.utc(clock.mono());
        if let Ok(state) = history.motion(now, 0.0, NavMode::Predict, &mut trajectory) {
            ages_ms.push(state.attitude_age_s * 1e3);
        }
    }
    let sent = sender.join().expect("sent");
    eventually("every sentence", || {
        inputs.pull(UtcNs(i64::MAX), &mut history);
        inputs.counters()[0].decoder.sentences >= sent
    });
    let counters = inputs.counters()[0].clone();
    ages_ms.sort_by(f64::total_cmp);
    let at = |share: f64| ages_ms[((ages_ms.len() - 1) as f64 * share) as usize];
    println!(
        "{name}: {sent} sentences, {} pings; newest attitude {:.2} ms old (p50), {:.2} (p99), {:.2} (most)",
        ages_ms.len(),
        at(0.5),
        at(0.99),
        at(1.0)
    );
    let d = counters.decoder;
    assert_eq!(
        (d.sentences, d.used, d.bad_checksum, d.resync_bytes),
        (sent, sent, 0, 0),
        "{name}: {counters:?}"
    );
    assert_eq!(
        (counters.live.dropped_full, counters.live.read_errors),
        (0, 0)
    );
    assert!(ages_ms.len() > 10, "pings went on");
}

#[test]
fn nothing_is_lost_over_udp() {
    let spec = spec(udp());
    check("UDP", &spec, |inputs| {
        let (_, address) = inputs.listening()[0].clone();
        std::thread::spawn(move || {
            let socket = UdpSocket::bind("127.0.0.1:0").expect("a socket");
            let out = |bytes: &[u8]| {
                socket.send_to(bytes, address).expect("sent");
            };
            send(out, seconds())
        })
    });
}

#[test]
fn nothing_is_lost_over_a_serial_line() {
    let (instrument, port) = pseudo_terminal();
    // Both ends stay open until everything was read.
    let kept = Arc::new(Mutex::new(instrument));
    let instrument = kept.clone();
    let spec = spec(NavInputSpec::Serial {
        port: port.name().expect("a name"),
        baud: BAUD,
        line: Default::default(),
    });
    check("921600 Bd", &spec, move |_| {
        std::thread::spawn(move || {
            let mut instrument = instrument.lock().unwrap_or_else(PoisonError::into_inner);
            let out = |bytes: &[u8]| {
                let mut left = bytes;
                let begun = Instant::now();
                while !left.is_empty() && begun.elapsed() < PATIENCE {
                    if let Ok(written) = instrument.write(left) {
                        left = &left[written..];
                    }
                }
            };
            send(out, seconds())
        })
    });
    drop((kept, port));
}

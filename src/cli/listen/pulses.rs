//! `echotank listen --trigger`: triggers pings and measures the latency to their first sample.

use std::io::Write;
use std::net::{SocketAddr, TcpStream, UdpSocket};
use std::str::FromStr;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicI64, Ordering};
use std::thread::{self, JoinHandle};
use std::time::Duration;

use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::{Rng, SeedableRng};
use serde_json::json;

use crate::cli::Failure;
use echotank_runtime::clock::{Clock, SystemClock};
use echotank_runtime::histograms::LatencyHistogram;
use echotank_runtime::io::control::client;

/// Value of `sent_ns` if no trigger is pending.
const NONE: i64 = i64::MIN;

/// Link over which triggers are sent.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum TriggerLink {
    /// `[sonar.trigger] source = "udp"`.
    Udp,
    /// `[sonar.trigger] source = "tcp"`.
    Tcp,
    /// A request over HTTP control, like `echotank ctl trigger`. The ping starts at the ping period of the sonar.
    Control,
}

/// Destination of triggers, written as `udp=127.0.0.1:7100`.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct TriggerTo {
    link: TriggerLink,
    address: SocketAddr,
}

impl FromStr for TriggerTo {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let rule = "must be udp=ADDRESS, tcp=ADDRESS or ctl=ADDRESS";
        let (link, address) = text.split_once('=').ok_or(rule)?;
        let link = match link {
            "udp" => TriggerLink::Udp,
            "tcp" => TriggerLink::Tcp,
            "ctl" => TriggerLink::Control,
            _ => return Err(rule.to_owned()),
        };
        let address = address
            .parse()
            .map_err(|why| format!("{address}: {why}; {rule}"))?;
        Ok(Self { link, address })
    }
}

/// Trigger generator with random intervals, active until dropped.
pub(crate) struct Pulses {
    /// Host time of the pending trigger, ns since 1970; `NONE` once the first sample has arrived.
    sent_ns: Arc<AtomicI64>,
    sent: Arc<AtomicI64>,
    stop: Arc<AtomicBool>,
    thread: Option<JoinHandle<()>>,
    to_first_sample: LatencyHistogram,
}

impl Pulses {
    /// Starts to send triggers at intervals of 0.5 to 1.5 times `every`.
    pub(crate) fn start(to: TriggerTo, every: Duration) -> Result<Self, Failure> {
        let mut send = sender(to).map_err(Failure::running)?;
        let stop = Arc::new(AtomicBool::new(false));
        let sent_ns = Arc::new(AtomicI64::new(NONE));
        let sent = Arc::new(AtomicI64::new(0));
        let thread = thread::Builder::new().name("pulses".into()).spawn({
            let (stop, sent_ns, sent) = (stop.clone(), sent_ns.clone(), sent.clone());
            move || {
                let clock = SystemClock::new();
                let mut rng = ChaCha8Rng::seed_from_u64(1);
                while !stop.load(Ordering::Acquire) {
                    let part = 0.5 + f64::from(rng.next_u32()) / f64::from(u32::MAX);
                    thread::sleep(every.mul_f64(part));
                    sent_ns.store(clock.host_utc().0, Ordering::Release);
                    // A failed send is not counted and starts no ping.
                    sent.fetch_add(i64::from(send().is_ok()), Ordering::Relaxed);
                }
            }
        });
        Ok(Self {
            sent_ns,
            sent,
            stop,
            thread: Some(thread.map_err(Failure::running)?),
            to_first_sample: LatencyHistogram::new(),
        })
    }

    /// Records the arrival of the first sample of a ping. `now_ns` is host time, ns since 1970.
    pub(crate) fn first_sample(&self, now_ns: i64) {
        let sent_ns = self.sent_ns.swap(NONE, Ordering::AcqRel);
        if sent_ns != NONE {
            let us = (now_ns - sent_ns).max(0) / 1000;
            self.to_first_sample.note(us as u64);
        }
    }

    pub(crate) fn print(&self) {
        println!("{} triggers sent", self.sent.load(Ordering::Relaxed));
        super::print_spread("first sample after its trigger", &self.to_first_sample);
    }
}

impl Drop for Pulses {
    fn drop(&mut self) {
        self.stop.store(true, Ordering::Release);
        if let Some(thread) = self.thread.take() {
            // The panic hook has already printed a panic of the thread.
            let _ = thread.join();
        }
    }
}

/// A function that sends one trigger.
type Sender = Box<dyn FnMut() -> std::io::Result<()> + Send>;

fn sender(to: TriggerTo) -> std::io::Result<Sender> {
    let address = to.address;
    Ok(match to.link {
        TriggerLink::Udp => {
            let any = match address {
                SocketAddr::V4(_) => "0.0.0.0:0",
                SocketAddr::V6(_) => "[::]:0",
            };
            let socket = UdpSocket::bind(any)?;
            Box::new(move || socket.send_to(b"ping!", address).map(|_| ()))
        }
        TriggerLink::Tcp => {
            let mut stream = TcpStream::connect(address)?;
            stream.set_nodelay(true)?;
            Box::new(move || stream.write_all(b"ping!\n"))
        }
        TriggerLink::Control => Box::new(move || {
            let asked = json!({ "do": "trigger", "pings": 1 });
            client::command(address, &asked, None).map(|_| ())
        }),
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_first_sample_after_a_trigger_is_attributed_to_it() {
        let listener = UdpSocket::bind("127.0.0.1:0").expect("a socket");
        let patience = Some(Duration::from_secs(30));
        listener.set_read_timeout(patience).expect("set");
        let to = format!("udp={}", listener.local_addr().expect("bound"));
        let to: TriggerTo = to.parse().expect("an address");
        let pulses = Pulses::start(to, Duration::from_millis(1)).expect("sends");
        let mut buffer = [0; 16];
        let len = listener.recv(&mut buffer).expect("a trigger");
        assert_eq!(&buffer[..len], b"ping!");
        pulses.stop.store(true, Ordering::Release);
        while pulses.thread.as_ref().is_some_and(|t| !t.is_finished()) {
            thread::yield_now();
        }
        let sent_ns = pulses.sent_ns.load(Ordering::Acquire);
        pulses.first_sample(sent_ns + 1_500_000);
        // No trigger is pending for this sample.
        pulses.first_sample(sent_ns + 9_000_000);
        let figures = pulses.to_first_sample.figures();
        assert_eq!(figures.count, 1);
        assert!(
            (1490..=1520).contains(&figures.p50_us),
            "{}",
            figures.p50_us
        );
    }

    #[test]
    fn an_unknown_trigger_link_is_refused_with_the_known_ones() {
        for text in ["7000", "pigeon=127.0.0.1:1", "udp=somewhere"] {
            let said = TriggerTo::from_str(text).expect_err("refused");
            assert!(said.contains("udp=ADDRESS"), "{said}");
        }
    }
}

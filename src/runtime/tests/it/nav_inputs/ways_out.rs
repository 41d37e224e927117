//! Navigation output over TCP and over a serial line, as a device under test receives it.

use std::io::{ErrorKind, Read};
use std::net::{SocketAddr, TcpStream};
use std::path::Path;
use std::sync::Arc;
use std::time::{Duration, Instant};

use echotank_config::spec::{
    NavDialect, NavOutputSpec, NavSentence, NavTargetSpec, PulseSpec, SerialLine, VerticalSpec,
};
use echotank_core::navigation::{FixQuality, NavQuantity, NavSample};
use echotank_core::time::UtcNs;
use echotank_nav::NavHistory;
use echotank_nav::framing::{Checksum, Framing};
use echotank_nav::reading::{Kind, Reading, StatedTime};
use echotank_nav::sentence::decode;
use echotank_ping::faults::Faults;
use echotank_runtime::clock::{Clock, SystemClock};
use echotank_runtime::io::nav::output::{ClockFaults, NavOutputs, OutputTime};
use serialport::TTYPort;

use super::{PATIENCE, nav_spec, pseudo_terminal, source, udp};

const PULSE: u8 = 7;

fn output(target: NavTargetSpec, pulse: PulseSpec) -> NavOutputSpec {
    NavOutputSpec {
        name: "board".into(),
        target,
        sentences: vec![NavSentence::Zda, NavSentence::Gga, NavSentence::Hdt],
        talker: "GP".into(),
        rate_hz: 5.0,
        latency_s: 0.0,
        pulse,
    }
}

/// A platform that moves north at 10 m/s and turns, with one output.
struct Bench {
    clock: Arc<dyn Clock>,
    history: NavHistory,
    outputs: NavOutputs,
    begun: UtcNs,
}

impl Bench {
    fn new(output: NavOutputSpec) -> Self {
        Self::with(output, None)
    }

    fn with(output: NavOutputSpec, faults: Option<Arc<dyn ClockFaults>>) -> Self {
        let mut spec = nav_spec(vec![source("ins", udp())]);
        spec.sources[0].lever_arm_m = glam::DVec3::ZERO;
        spec.sources[0].provides.truncate(3);
        spec.vertical = VerticalSpec::Waterline {
            reference_down_m: 0.0,
        };
        let clock: Arc<dyn Clock> = Arc::new(SystemClock::new());
        let time: OutputTime = {
            let clock = clock.clone();
            Arc::new(move || clock.host_utc())
        };
        let outputs = NavOutputs::open_with(&[output], &clock, &time, faults.as_ref());
        let outputs = outputs.expect("opens");
        Self {
            history: NavHistory::new(&spec),
            outputs,
            begun: clock.host_utc(),
            clock,
        }
    }

    fn address(&self) -> SocketAddr {
        let line = &self.outputs.addresses()[0];
        let word = line.rsplit(' ').next().expect("a word");
        word.parse().unwrap_or_else(|_| panic!("{line}"))
    }

    /// Executes one step of the pipeline.
    fn turn(&mut self) {
        let now = self.clock.host_utc();
        let t = now.seconds_since(self.begun);
        let position = NavQuantity::Position {
            // The meridian's radius at 0.9 rad is 6,374,674 m.
            latitude_rad: 0.9 + 10.0 * t / 6_374_674.0,
            longitude_rad: -0.1,
            height_m: Some(0.0),
            fix: FixQuality::RtkFixed,
        };
        let heading = NavQuantity::Heading {
            heading_rad: heading_deg(t).to_radians(),
        };
        for quantity in [position, heading] {
            self.history.insert(&NavSample {
                source: 0,
                valid_utc: now,
                arrival_utc: now,
                quantity,
            });
        }
        self.outputs
            .publish(&mut self.history, self.clock.mono(), now);
        std::thread::sleep(Duration::from_millis(5));
    }

    /// Receives lines with their times until `enough` returns true.
    fn hear(
        &mut self,
        line: &mut dyn Read,
        what: &str,
        enough: impl Fn(&[Heard]) -> bool,
    ) -> Vec<Heard> {
        let begun = Instant::now();
        let (mut heard, mut pending) = (Vec::new(), Vec::new());
        while !enough(&heard) {
            assert!(begun.elapsed() < PATIENCE, "{what}: {heard:?}");
            self.turn();
            let mut buffer = [0; 4096];
            match line.read(&mut buffer) {
                Ok(0) => panic!("{what}: closed after {heard:?}"),
                Ok(len) => pending.extend_from_slice(&buffer[..len]),
                Err(e) if matches!(e.kind(), ErrorKind::WouldBlock | ErrorKind::TimedOut) => {}
                Err(e) => panic!("{what}: {e}"),
            }
            let at = self.clock.host_utc();
            loop {
                if pending.first() == Some(&PULSE) {
                    pending.remove(0);
                    heard.push(Heard::Pulse(at));
                } else if let Some(end) = pending.iter().position(|&b| b == b'\n') {
                    let rest = pending.split_off(end + 1);
                    let text = std::mem::replace(&mut pending, rest);
                    heard.push(Heard::Said(at, read(&text)));
                } else {
                    break;
                }
            }
        }
        heard
    }
}

fn heading_deg(t: f64) -> f64 {
    (359.0 + 2.0 * t).rem_euclid(360.0)
}

#[derive(Clone, Debug)]
enum Heard {
    Pulse(UtcNs),
    Said(UtcNs, Reading),
}

fn read(line: &[u8]) -> Reading {
    let mut framing = Framing::new();
    let mut left = line;
    let sentence = framing
        .next(&mut left, UtcNs(0), 0)
        .unwrap_or_else(|| panic!("no sentence in {:?}", String::from_utf8_lossy(line)));
    assert_eq!(sentence.checksum, Checksum::Right, "{}", sentence.body);
    decode(sentence.body, &NavDialect::default(), &mut String::new()).expect(sentence.body)
}

fn kinds(heard: &[Heard], kind: Kind) -> impl Iterator<Item = (UtcNs, &Reading)> {
    heard.iter().filter_map(move |h| match h {
        Heard::Said(at, r) if r.kind == kind => Some((*at, r)),
        _ => None,
    })
}

fn seconds(heard: &[Heard]) -> usize {
    kinds(heard, Kind::Zda).count()
}

/// Checks the clock, the motion and the order of every sentence: the pulse, the ZDA of this pulse, GGA, HDT.
fn check(bench: &Bench, heard: &[Heard], has_pulses: bool) {
    let mut before = None;
    for h in heard {
        match h {
            Heard::Pulse(at) => {
                let late_s = at.seconds_since(UtcNs(at.0 / 1_000_000_000 * 1_000_000_000));
                assert!(late_s < 0.9, "{late_s} s after its second");
            }
            Heard::Said(at, r) if r.kind == Kind::Zda => {
                let named = r.instant().expect("dated");
                assert_eq!(named.0 % 1_000_000_000, 0, "whole seconds");
                let late_s = at.seconds_since(named);
                assert!((0.0..0.9).contains(&late_s), "{late_s} s late");
                let is_pulse = matches!(before, Some(Heard::Pulse(_)));
                assert_eq!(is_pulse, has_pulses, "the pulse, then what names it");
            }
            Heard::Said(..) => {}
        }
        before = Some(h.clone());
    }
    let mut last = None;
    for (_, r) in kinds(heard, Kind::Gga) {
        let (latitude, longitude) = r.position_rad.expect("a position");
        assert_eq!(r.fix, FixQuality::RtkFixed);
        // The value is valid at the time in the sentence, independent of its arrival.
        let Some(StatedTime::TimeOfDay(ns)) = r.when else {
            panic!("{r:?}")
        };
        let named_s = ns as f64 / 1e9;
        let t = named_s - bench.begun.0.rem_euclid(86_400_000_000_000) as f64 / 1e9;
        let north_m = (latitude - 0.9) * 6_374_674.0;
        // A speed needs two measurements.
        assert!(
            t < 0.5 || (north_m - 10.0 * t).abs() < 0.3,
            "{north_m} m north at {t} s"
        );
        assert!((longitude + 0.1).abs() < 1e-8);
        if let Some(last) = last {
            let step_s: f64 = named_s - last;
            assert!(step_s > 0.0, "{named_s} after {last}");
        }
        last = Some(named_s);
    }
    for (at, r) in kinds(heard, Kind::Hdt) {
        let got = r.heading_rad.expect("a heading").to_degrees();
        let want = heading_deg(at.seconds_since(bench.begun));
        let off = (got - want + 540.0).rem_euclid(360.0) - 180.0;
        // 2 degrees per second; a busy machine can receive late.
        assert!((-1.8..0.1).contains(&off), "got {got}, want {want}");
    }
}

#[test]
fn clients_of_a_tcp_output_receive_the_same_and_leave_independently() {
    let listen = "127.0.0.1:0".parse().expect("an address");
    let mut bench = Bench::new(output(NavTargetSpec::TcpListen { listen }, PulseSpec::Byte));
    let join = |bench: &Bench| {
        let client = TcpStream::connect(bench.address()).expect("listening");
        client.set_nonblocking(true).expect("set");
        client
    };
    let mut first = join(&bench);
    let second = join(&bench);
    let heard = bench.hear(&mut first, "first", |h| seconds(h) == 2);
    check(&bench, &heard, true);
    assert!(kinds(&heard, Kind::Gga).count() >= 6, "five a second");
    drop(second);
    // Later clients receive from their connection on.
    let mut third = join(&bench);
    let heard = bench.hear(&mut third, "third", |h| seconds(h) == 1);
    check(&bench, &heard[1..], true);
    let line = &bench.outputs.lines()[0];
    assert!(
        line.ends_with("0 ticks too late, 0 errors, 2 clients"),
        "{line}"
    );
}

#[test]
fn lost_pulses_and_wrong_seconds_are_exactly_those_in_the_log() {
    const OFF_S: f64 = -3.0;
    let listen = "127.0.0.1:0".parse().expect("an address");
    let faults = Arc::new(Faults::new(&[], &[]));
    let mut bench = Bench::with(
        output(NavTargetSpec::TcpListen { listen }, PulseSpec::Byte),
        Some(faults.clone()),
    );
    faults.begin(bench.begun);
    // The first whole second from now on has no pulse; the second has its own pulse.
    for json in [
        r#"{"kind": "pps-loss", "at_s": 0, "for_s": 1}"#,
        r#"{"kind": "wrong-zda", "value": -3, "at_s": 1, "for_s": 1}"#,
    ] {
        let request = serde_json::from_str(json).expect("JSON");
        faults.add(&request).expect("sound");
    }
    let mut client = TcpStream::connect(bench.address()).expect("listening");
    client.set_nonblocking(true).expect("set");
    let heard = bench.hear(&mut client, "client", |h| seconds(h) == 3);
    let log = faults.take_injections();
    let injected = |kind: &str, second: i64| {
        let mut of_kind = log.iter().filter(|i| i.kind == kind);
        of_kind.any(|i| i.utc_ns == second)
    };
    let (mut before, mut lost, mut misnamed) = (None, 0, 0);
    for h in &heard {
        if let Heard::Said(at, r) = h
            && r.kind == Kind::Zda
        {
            let second = at.0 / 1_000_000_000 * 1_000_000_000;
            let is_pulse = matches!(before, Some(Heard::Pulse(_)));
            assert_eq!(is_pulse, !injected("pps-loss", second), "{second}");
            let named = r.instant().expect("dated").seconds_since(UtcNs(second));
            let is_off = injected("wrong-zda", second);
            assert_eq!(named, if is_off { OFF_S } else { 0.0 }, "{second}");
            (lost, misnamed) = (lost + u32::from(!is_pulse), misnamed + u32::from(is_off));
        }
        before = Some(h.clone());
    }
    assert_eq!((lost, misnamed), (1, 1), "{log:?}");
}

fn plug_in(name: &Path) -> (TTYPort, TTYPort) {
    let (mut device, port) = pseudo_terminal();
    serialport::SerialPort::set_timeout(&mut device, Duration::from_millis(1)).expect("set");
    let _ = std::fs::remove_file(name);
    let path = serialport::SerialPort::name(&port).expect("a name");
    std::os::unix::fs::symlink(path, name).expect("a link");
    (device, port)
}

#[test]
fn a_serial_output_pulses_names_the_second_and_survives_disconnection() {
    let folder = tempfile::tempdir().expect("a folder");
    let name = folder.path().join("board");
    let (mut device, port) = plug_in(&name);
    let target = NavTargetSpec::Serial {
        port: name.display().to_string(),
        baud: 57_600,
        line: SerialLine::default(),
    };
    let mut bench = Bench::new(output(target, PulseSpec::Byte));
    assert_eq!(
        serialport::SerialPort::baud_rate(&device).expect("known"),
        57_600
    );
    let heard = bench.hear(&mut device, "plugged in", |h| seconds(h) == 2);
    check(&bench, &heard, true);
    let errors = |bench: &Bench| {
        let line = bench.outputs.lines()[0].clone();
        let (before, _) = line.split_once(" errors").expect("errors");
        let count = before.rsplit(' ').next().expect("a count");
        count.parse::<u64>().expect("a number")
    };
    assert_eq!(errors(&bench), 0);
    drop((device, port));
    let begun = Instant::now();
    while errors(&bench) == 0 {
        assert!(begun.elapsed() < PATIENCE, "it never noticed");
        bench.turn();
    }
    let (mut device, _port) = plug_in(&name);
    let heard = bench.hear(&mut device, "again", |h| seconds(h) == 1);
    check(&bench, &heard[heard.len() - 2..], true);
}

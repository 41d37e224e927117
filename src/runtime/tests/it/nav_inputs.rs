//! Files, sockets and serial ports: the same log gives the same states through each of them.

mod datagrams;
mod spoiled;
mod ways_out;

use std::io::Write;
use std::net::UdpSocket;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicI64, Ordering::SeqCst};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Instant;

use echotank_config::spec::{
    NavChannel, NavInputSpec, NavMode, NavSourceSpec, NavSpec, TimePolicy, VerticalSpec,
};
use echotank_core::frames::Trajectory;
use echotank_core::navigation::NavState;
use echotank_core::time::{MonoNs, NS_PER_S, Timeline, UtcNs};
use echotank_nav::stamp::split_line;
use echotank_nav::{Coverage, NavGap, NavHistory};
use echotank_runtime::clock::{Clock, SystemClock};
use echotank_runtime::io::nav::{LiveCounters, NavInputs, NavOpenError};
use echotank_testing::nav::{nav, udp};
use glam::DVec3;
use serialport::{SerialPort, TTYPort};

use super::{PATIENCE, eventually};

/// Start of 2014-08-01.
const DAY: UtcNs = UtcNs(1_406_851_200 * NS_PER_S);
fn data(name: &str) -> PathBuf {
    echotank_testing::repository()
        .join("tests/data/nav")
        .join(name)
}

fn source(name: &str, input: NavInputSpec) -> NavSourceSpec {
    let provides = [
        NavChannel::Position,
        NavChannel::CourseSpeed,
        NavChannel::Heading,
        NavChannel::RollPitch,
        NavChannel::Heave,
    ];
    NavSourceSpec {
        time: TimePolicy::Burst,
        lever_arm_m: DVec3::new(2.0, 1.0, -15.0),
        ..echotank_testing::nav::source(name, input, &provides)
    }
}

fn log(path: PathBuf) -> NavInputSpec {
    NavInputSpec::Log {
        path,
        plain_rate_hz: 10.0,
    }
}

fn serial(port: String, baud: u32) -> NavInputSpec {
    NavInputSpec::Serial {
        port,
        baud,
        line: Default::default(),
    }
}

fn nav_spec(sources: Vec<NavSourceSpec>) -> NavSpec {
    NavSpec {
        vertical: VerticalSpec::Waterline {
            reference_down_m: 3.0,
        },
        history_s: 200.0,
        ..nav(sources)
    }
}

pub(crate) fn opened(spec: &NavSpec) -> (NavInputs, NavHistory) {
    let inputs = NavInputs::open(spec, Arc::new(SystemClock::new())).expect("opens");
    (inputs, NavHistory::new(spec))
}

fn received(inputs: &mut NavInputs, source: usize) -> u64 {
    inputs.counters()[source].live.received
}

/// Sends datagrams to a source. Each datagram is sent after the previous one was received.
fn send<'a>(inputs: &mut NavInputs, source: usize, datagrams: impl IntoIterator<Item = &'a [u8]>) {
    let (_, address) = inputs.listening()[0];
    let sender = UdpSocket::bind("127.0.0.1:0").expect("a port");
    for datagram in datagrams {
        let before = received(inputs, source);
        sender.send_to(datagram, address).expect("sent");
        eventually("received", || received(inputs, source) > before);
    }
}

/// Opens a pseudo-terminal: the instrument's end and a port. Only one at a time, because `ptsname` has a buffer shared by threads.
pub(crate) fn pseudo_terminal() -> (TTYPort, TTYPort) {
    static ONE: Mutex<()> = Mutex::new(());
    let _held = ONE.lock().unwrap_or_else(PoisonError::into_inner);
    TTYPort::pair().expect("a pseudo-terminal")
}

/// Sentences of the log without the time stamps of the recorder, as an instrument sends them.
fn sentences() -> Vec<Vec<u8>> {
    std::fs::read(data("seapath330_90s.rvdas"))
        .expect("test data")
        .split_inclusive(|&b| b == b'\n')
        .map(|line| {
            let (_, sentence) = split_line(line);
            [sentence.trim_ascii_end(), b"\r\n"].concat()
        })
        .collect()
}

fn ping_times() -> impl Iterator<Item = UtcNs> {
    (0..28).map(|k| DAY.plus_s(2.03 + 3.07 * f64::from(k)))
}

fn states(history: &mut NavHistory) -> Vec<NavState> {
    let mut trajectory = Trajectory::default();
    ping_times()
        .map(|utc| {
            history
                .motion(utc, 0.5, NavMode::Settle, &mut trajectory)
                .expect("covered")
        })
        .collect()
}

fn from_file() -> Vec<NavState> {
    let spec = nav_spec(vec![source("s330", log(data("seapath330_90s.rvdas")))]);
    let (mut inputs, mut history) = opened(&spec);
    while inputs.pull_next(&mut history) {}
    assert!(inputs.finished());
    states(&mut history)
}

/// Reads until the last ping is covered.
fn pull_all(inputs: &mut NavInputs, history: &mut NavHistory, what: &str) {
    let last = ping_times().last().expect("some pings");
    eventually(what, || {
        inputs.pull(UtcNs(0), history);
        history.coverage(last, last.plus_s(0.5)) == Coverage::Ready
    });
}

/// Compares states. Times of validity come from the messages, so different arrivals do not change the states.
fn same(got: &[NavState], want: &[NavState]) {
    assert_eq!(got.len(), want.len());
    for (g, w) in got.iter().zip(want) {
        let (g_pose, w_pose) = (&g.pose, &w.pose);
        let metres = (g_pose.position_m - w_pose.position_m).length();
        let radians = (g_pose.world_from_body.inverse() * w_pose.world_from_body)
            .to_scaled_axis()
            .length();
        let speed = (g_pose.velocity_m_per_s - w_pose.velocity_m_per_s).length();
        assert!(
            metres < 1e-6 && radians < 1e-9 && speed < 1e-6,
            "{metres} m, {radians} rad, {speed} m/s at {:?}",
            g.utc
        );
        assert!((g.latitude_rad - w.latitude_rad).abs() < 1e-12);
        assert_eq!((g.utc, g.fix), (w.utc, w.fix));
    }
}

#[test]
fn udp_gives_the_states_of_the_file() {
    let spec = nav_spec(vec![source("s330", udp())]);
    let (mut inputs, mut history) = opened(&spec);
    assert_eq!(inputs.listening()[0].0, "s330");
    let stream = sentences().concat();
    // Datagrams from a gateway that splits sentences anywhere.
    send(&mut inputs, 0, stream.chunks(301));
    pull_all(&mut inputs, &mut history, "udp");
    same(&states(&mut history), &from_file());
    // The last ping is covered before the last sentence is decoded.
    eventually("the last sentence", || {
        inputs.pull(UtcNs(0), &mut history);
        inputs.counters()[0].decoder.sentences == 720
    });
    let counters = inputs.counters()[0].clone();
    assert_eq!(counters.live.received as usize, stream.chunks(301).len());
    assert_eq!(
        (counters.live.dropped_full, counters.decoder.bad_checksum),
        (0, 0)
    );
    let timeline = inputs.timeline().expect("from the first date");
    let clock = SystemClock::new();
    let rig_now = timeline.utc(clock.mono());
    assert!(
        (rig_now.seconds_since(DAY)).abs() < 600.0,
        "rig time is the log's: {rig_now:?}"
    );
    assert!(!inputs.finished());
}

#[test]
fn a_serial_port_gives_the_states_of_the_file() {
    let (mut instrument, port) = pseudo_terminal();
    let spec = nav_spec(vec![source(
        "s330",
        serial(port.name().expect("a name"), 115_200),
    )]);
    let (mut inputs, mut history) = opened(&spec);
    let writer = std::thread::spawn(move || {
        for piece in sentences().concat().chunks(97) {
            let mut left = piece;
            let begun = Instant::now();
            while !left.is_empty() && begun.elapsed() < PATIENCE {
                if let Ok(written) = instrument.write(left) {
                    left = &left[written..];
                }
            }
        }
        instrument
    });
    pull_all(&mut inputs, &mut history, "serial");
    let instrument = writer.join().expect("wrote all");
    // The last ping was covered before the last sentence. Data written meanwhile are still in transit.
    eventually("720 sentences", || {
        inputs.pull(UtcNs(0), &mut history);
        inputs.counters()[0].decoder.sentences >= 720
    });
    same(&states(&mut history), &from_file());
    let counters = inputs.counters()[0].clone();
    assert_eq!(
        (counters.decoder.sentences, counters.decoder.bad_checksum),
        (720, 0)
    );
    assert_eq!(counters.decoder.undated, 0);
    drop(instrument);
}

#[test]
fn a_vanished_serial_port_is_looked_for_and_found_again() {
    let directory = tempfile::tempdir().expect("a directory");
    let path = directory.path().join("mru");
    let plug_in = || {
        let (instrument, port) = pseudo_terminal();
        let _ = std::fs::remove_file(&path);
        std::os::unix::fs::symlink(port.name().expect("a name"), &path).expect("a link");
        (instrument, port)
    };
    let first = plug_in();
    let spec = nav_spec(vec![source(
        "mru",
        serial(path.display().to_string(), 9600),
    )]);
    let (mut inputs, _) = opened(&spec);
    let mut wait_for = |what: &str, holds: &dyn Fn(&LiveCounters) -> bool| {
        eventually(what, || holds(&inputs.counters()[0].live));
        assert!(!inputs.finished());
    };
    drop(first);
    wait_for("vanished", &|c| c.read_errors > 0);
    let (mut instrument, _port) = plug_in();
    wait_for("found again", &|c| c.reopened > 0);
    instrument
        .write_all(b"$HEHDT,218.53,T*12\r\n")
        .expect("written");
    wait_for("received", &|c| c.received > 0);
}

#[test]
fn beside_a_recorded_source_rig_time_is_given_from_outside() {
    let mut gyro = source("gyro", log(data("gyro_90s.rvdas")));
    gyro.provides = vec![NavChannel::Heading];
    let spec = nav_spec(vec![gyro, source("gps", udp())]);
    let (mut inputs, mut history) = opened(&spec);
    send(&mut inputs, 1, [&sentences()[..2].concat()[..]]);
    inputs.pull(UtcNs(0), &mut history);
    assert_eq!((inputs.timeline(), history.counts().inserted), (None, 0));
    let given = Timeline::through(MonoNs(0), DAY);
    inputs.set_timeline(given);
    inputs.pull(UtcNs(0), &mut history);
    assert_eq!(
        (inputs.timeline(), history.counts().inserted),
        (Some(given), 1)
    );
}

/// A clock with settable time.
struct Still {
    mono: AtomicI64,
    utc: UtcNs,
}
impl Clock for Still {
    fn mono(&self) -> MonoNs {
        MonoNs(self.mono.load(SeqCst))
    }
    fn host_utc(&self) -> UtcNs {
        self.utc
    }
    fn sleep_until(&self, deadline: MonoNs) {
        self.mono.fetch_max(deadline.0, SeqCst);
    }
}

fn timeline_after(clock: Arc<Still>, time: TimePolicy, bytes: &[u8]) -> Option<Timeline> {
    let mut source = source("gps", udp());
    source.time = time;
    let spec = nav_spec(vec![source]);
    let mut inputs = NavInputs::open(&spec, clock).expect("opens");
    let mut history = NavHistory::new(&spec);
    send(&mut inputs, 0, [bytes]);
    inputs.pull(UtcNs(0), &mut history);
    inputs.timeline()
}

#[test]
fn rig_time_is_the_messages_if_they_are_far_from_the_host_and_the_hosts_otherwise() {
    let clock = |utc: UtcNs| {
        Arc::new(Still {
            mono: AtomicI64::new(7 * NS_PER_S),
            utc,
        })
    };
    let zda = b"$INZDA,000001.17,01,08,2014,,*7F\r\n";
    let message = DAY.plus_ns(1_170_000_000);
    let far = clock(UtcNs(1_800_000_000 * NS_PER_S));
    let near = clock(message.plus_ns(1_500_000_000));
    let mono = far.mono();
    let host = |c: &Still| Some(Timeline::through(mono, c.utc));
    // The time stamp of the kernel is real: the datagram arrived slightly before the time of the fixed clock.
    let found = timeline_after(far.clone(), TimePolicy::Burst, zda).expect("dated");
    let earlier_ns = found.utc_minus_mono_ns - Timeline::through(mono, message).utc_minus_mono_ns;
    assert!(
        (0..PATIENCE.as_nanos() as i64).contains(&earlier_ns),
        "{earlier_ns} ns"
    );
    assert_eq!(
        timeline_after(near.clone(), TimePolicy::Burst, zda),
        host(&near)
    );
    let by_arrival = TimePolicy::Arrival { latency_s: 0.0 };
    assert_eq!(timeline_after(far.clone(), by_arrival, zda), host(&far));
    let hdt = b"$HEHDT,218.53,T*12\r\n";
    assert_eq!(
        timeline_after(far, TimePolicy::Message, hdt),
        None,
        "still waiting for a date"
    );
}

#[test]
fn data_before_rig_time_is_known_are_kept() {
    let clock = Arc::new(Still {
        mono: AtomicI64::new(0),
        utc: UtcNs(1_800_000_000 * NS_PER_S),
    });
    let spec = nav_spec(vec![source("gps", udp())]);
    let mut inputs = NavInputs::open(&spec, clock).expect("opens");
    let mut history = NavHistory::new(&spec);
    // A fix of the same day, without a date.
    let gga = b"$INGGA,000001.16,2200.113054,S,01756.360985,W,1,12,0.7,-3.05,M,4.67,M,,*69\r\n";
    send(&mut inputs, 0, [&gga[..]]);
    inputs.pull(UtcNs(0), &mut history);
    assert_eq!((history.counts().inserted, inputs.timeline()), (0, None));
    send(
        &mut inputs,
        0,
        [&b"$INZDA,000001.17,01,08,2014,,*7F\r\n"[..]],
    );
    inputs.pull(UtcNs(0), &mut history);
    assert_eq!(history.counts().inserted, 1);
    let fix = DAY.plus_ns(1_160_000_000);
    assert_eq!(
        history.coverage(fix, fix),
        Coverage::Waiting,
        "the fix is at its own day's second"
    );
    assert!(matches!(
        history.coverage(fix.plus_ns(-1), fix),
        Coverage::Missing(NavChannel::Position)
    ));
}

fn write(directory: &Path, name: &str, text: &str) -> PathBuf {
    let path = directory.join(name);
    std::fs::write(&path, text).expect("written");
    path
}

#[test]
fn recorded_sources_are_merged_by_arrival_and_pulled_up_to_a_time() {
    let mut gyro = source("gyro", log(data("gyro_90s.rvdas")));
    gyro.time = TimePolicy::Message;
    gyro.provides = vec![NavChannel::Heading];
    let seapath = source("s330", log(data("seapath330_90s.rvdas")));
    // The gyro has priority, so heading comes from it.
    let spec = nav_spec(vec![gyro, seapath]);
    let (mut inputs, mut history) = opened(&spec);
    let start = inputs.recorded_start().expect("recorded");
    assert_eq!(start, DAY.plus_ns(183_000_000));
    inputs.pull(DAY.plus_s(10.0), &mut history);
    let mut trajectory = Trajectory::default();
    let utc = DAY.plus_s(7.9);
    assert_eq!(history.coverage(utc, utc.plus_s(0.1)), Coverage::Ready);
    let state = history
        .motion(utc, 0.1, NavMode::Settle, &mut trajectory)
        .expect("covered");
    assert!(
        (state.heading_rad.to_degrees() - 217.1).abs() < 0.3,
        "{}",
        state.heading_rad
    );
    assert_eq!(
        history.coverage(DAY.plus_s(12.0), DAY.plus_s(12.1)),
        Coverage::Waiting
    );
    // 48 HDT of the gyro up to 9.984 s; positions of the Seapath up to 9.16 s.
    let age_s = trajectory.position.last().map(|k| utc.plus_s(k.time_s));
    assert_eq!(age_s, Some(DAY.plus_ns(9_160_000_000)));
}

#[test]
fn a_looped_log_continues_with_short_gaps() {
    let directory = tempfile::tempdir().expect("a directory");
    let header = "time_s,north_m,east_m,down_m,roll_deg,pitch_deg,heading_deg";
    let rows: String = (0..=40)
        .map(|k| {
            format!(
                "{:.2},{},0,5,0,0,90\n",
                100.0 + 0.25 * f64::from(k),
                2.0 * 0.25 * f64::from(k)
            )
        })
        .collect();
    let path = write(directory.path(), "line.csv", &format!("{header}\n{rows}"));
    let mut track = source("track", NavInputSpec::Csv { path });
    track.lever_arm_m = DVec3::ZERO;
    track.provides = vec![
        NavChannel::Position,
        NavChannel::Heading,
        NavChannel::RollPitch,
    ];
    let mut spec = nav_spec(vec![track]);
    spec.loop_log = true;
    spec.vertical = VerticalSpec::Depth;
    spec.history_s = 5.0;
    let (mut inputs, mut history) = opened(&spec);
    let mut trajectory = Trajectory::default();
    let (mut good, mut seams) = (0, 0);
    for k in 0..1000 {
        let utc = UtcNs(100 * NS_PER_S).plus_s(0.1 * f64::from(k));
        while history.coverage(utc, utc.plus_s(0.05)) == Coverage::Waiting {
            assert!(inputs.pull_next(&mut history));
        }
        match history.motion(utc, 0.05, NavMode::Settle, &mut trajectory) {
            Ok(state) => {
                // 10 s of log and 0.25 s of seam.
                let along_s = (0.1 * f64::from(k)) % 10.25;
                let error_m =
                    (state.pose.position_m - DVec3::new(2.0 * along_s, 0.0, 5.0)).length();
                assert!(error_m < 1e-9, "ping {k}: {error_m} m");
                good += 1;
            }
            Err(gap) => {
                assert_eq!(gap, NavGap::Seam, "ping {k}");
                seams += 1;
            }
        }
    }
    println!("{good} pings, {seams} at seams");
    // Nine loops of 0.25 s and a window of 0.05 s, ten pings per second.
    assert!((18..=36).contains(&seams), "{seams}");
    assert!(!inputs.finished());
    assert_eq!(history.counts().seams, seams);
}

#[test]
fn errors_name_the_source_the_place_and_the_reason() {
    let directory = tempfile::tempdir().expect("a directory");
    let open = |source: NavSourceSpec| {
        let error = NavInputs::open(&nav_spec(vec![source]), Arc::new(SystemClock::new()))
            .err()
            .expect("refused");
        (error.to_string(), error)
    };
    let (message, _) = open(source("a", log("/no/such.log".into())));
    assert_eq!(
        message,
        "nav source `a`: cannot read /no/such.log: not found"
    );
    let path = write(
        directory.path(),
        "bad.csv",
        "time_s,north_m,east_m,down_m,roll_deg,pitch_deg,heading_deg\n1,x,0,0,0,0,0\n",
    );
    let (message, _) = open(source("b", NavInputSpec::Csv { path: path.clone() }));
    assert_eq!(
        message,
        format!(
            "nav source `b`: {}:2: column `north_m`: `x` is not a finite number",
            path.display()
        )
    );
    // A buoy without heave whose attitude has wrong checksums: the operator is warned.
    let mut buoy = source("c", log(data("hydroball_22s.txt")));
    buoy.provides = vec![NavChannel::Heave];
    let (message, error) = open(buoy);
    assert!(matches!(error, NavOpenError::NothingUsable { .. }));
    assert!(message.contains("168 with a wrong checksum"), "{message}");
    let (message, _) = open(source("d", serial("/no/tty".into(), 9600)));
    assert!(
        message.starts_with("nav source `d`: cannot open serial port /no/tty at 9600 baud: "),
        "{message}"
    );
    let (message, _) = open(source(
        "e",
        NavInputSpec::Udp {
            // A documentation address that no machine has.
            listen: "192.0.2.1:5000".parse().expect("an address"),
            multicast: None,
        },
    ));
    assert!(
        message.starts_with("nav source `e`: cannot listen on udp 192.0.2.1:5000: "),
        "{message}"
    );
}

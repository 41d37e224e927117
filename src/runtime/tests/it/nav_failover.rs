//! Several sources at once: the active source, motion across failover, jumps, source states, and TCP as client and server.

use std::io::Write;
use std::net::{TcpListener, TcpStream};

use echotank_config::spec::*;
use echotank_core::frames::Trajectory;
use echotank_core::navigation::{FixQuality, NavQuantity, NavSample, NavState};
use echotank_core::time::UtcNs;
use echotank_nav::health::State;
use echotank_nav::{NavGap, NavHistory};
use echotank_runtime::io::nav::NavInputs;
use echotank_testing::nav::{nav, sentence, source, udp};
use glam::DVec3;

use super::eventually;

fn spec(sources: Vec<NavSourceSpec>) -> NavSpec {
    NavSpec {
        origin: OriginSpec::Geodetic {
            latitude_rad: 0.9,
            longitude_rad: 0.1,
        },
        failover: Some(FailoverSpec {
            after_s: 2.0,
            hold_off_s: 5.0,
        }),
        ..nav(sources)
    }
}

fn insert(history: &mut NavHistory, source: u16, t: f64, quantity: NavQuantity) {
    let at = UtcNs(0).plus_s(t);
    history.insert(&NavSample {
        source,
        valid_utc: at,
        arrival_utc: at,
        quantity,
    });
}

const NORTHWARD: NavQuantity = NavQuantity::Heading { heading_rad: 0.0 };

/// Position north of the origin, metres: the radius of the meridian at 0.9 rad is 6,374,674 m.
fn position(north_m: f64) -> NavQuantity {
    NavQuantity::Position {
        latitude_rad: 0.9 + north_m / 6_374_674.0,
        longitude_rad: 0.1,
        height_m: Some(0.0),
        fix: FixQuality::Autonomous,
    }
}

fn motion(history: &mut NavHistory, t: f64) -> Result<NavState, NavGap> {
    let mut trajectory = Trajectory::default();
    history.motion(UtcNs(0).plus_s(t), 0.1, NavMode::Settle, &mut trajectory)
}

#[test]
fn failover_from_a_silent_gnss_uses_the_new_lever_arm_without_interpolation() {
    let provides = [NavChannel::Position, NavChannel::Heading];
    let mut first = source("first", udp(), &provides);
    first.lever_arm_m = DVec3::new(10.0, 0.0, 0.0);
    let mut second = source("second", udp(), &[NavChannel::Position]);
    second.lever_arm_m = DVec3::new(-20.0, 0.0, 0.0);
    let compass = source("compass", udp(), &[NavChannel::Heading]);
    let mut history = NavHistory::new(&spec(vec![first, second, compass]));
    for i in 0..400 {
        let t = f64::from(i) / 10.0;
        // Northward at 2 m/s, heading north: the antennas are 10 m ahead and 20 m astern of the reference point.
        if !(10.0..20.0).contains(&t) {
            insert(&mut history, 0, t, position(2.0 * t + 10.0));
            insert(&mut history, 0, t, NORTHWARD);
        }
        insert(&mut history, 1, t, position(2.0 * t - 20.0));
        insert(&mut history, 2, t, NORTHWARD);
        let north =
            |history: &mut NavHistory, t: f64| motion(history, t).map(|s| s.pose.position_m.x);
        if i == 80 {
            assert!((north(&mut history, 5.0).expect("first") - 10.0).abs() < 0.1);
        }
        if i == 180 {
            assert_eq!(history.active_source(NavChannel::Position), Some(1));
            assert!((north(&mut history, 15.0).expect("second") - 30.0).abs() < 0.1);
            // Earlier motion keeps the lever arm of its own source.
            assert!((north(&mut history, 9.0).expect("first") - 18.0).abs() < 0.1);
            let across = motion(&mut history, 11.5);
            assert!(across.is_err(), "no source at 11.5 s: {across:?}");
        }
    }
    // The source returns at 20 s and is trusted again at 25 s.
    assert_eq!(history.active_source(NavChannel::Position), Some(0));
    let back = motion(&mut history, 30.0).expect("first again");
    assert!((back.pose.position_m.x - 60.0).abs() < 0.1, "{back:?}");
    // Position and heading, for failover and failback.
    assert_eq!(history.counts().switches, 4);
}

#[test]
fn a_jump_is_rejected_and_a_lasting_one_becomes_a_reset() {
    let provides = [NavChannel::Position, NavChannel::Heading];
    let mut spec = spec(vec![source("gnss", udp(), &provides)]);
    spec.failover = None;
    spec.jump_gate = Some(JumpGateSpec {
        max_speed_m_per_s: 20.0,
        max_rate_rad_per_s: 1.0,
    });
    let mut history = NavHistory::new(&spec);
    for i in 0..200 {
        let t = f64::from(i) / 10.0;
        let jump_m = match i {
            50 => 5000.0,
            100.. => 300.0,
            _ => 0.0,
        };
        insert(&mut history, 0, t, position(2.0 * t + jump_m));
        insert(&mut history, 0, t, NORTHWARD);
    }
    let counts = *history.counts();
    assert_eq!(
        (counts.quarantined, counts.resets),
        (1 + 4, 1),
        "{counts:?}"
    );
    let north = |history: &mut NavHistory, t: f64| motion(history, t).map(|s| s.pose.position_m.x);
    // The stray fix at 5 s has no effect.
    assert!((north(&mut history, 5.0).expect("fine") - 10.0).abs() < 0.05);
    assert!((north(&mut history, 15.0).expect("fine") - 330.0).abs() < 0.05);
    assert!(
        north(&mut history, 10.2).is_err(),
        "not joined across the reset"
    );
}

#[test]
fn source_states_follow_from_arrivals() {
    let provides = [NavChannel::Position, NavChannel::Heading];
    let mut history = NavHistory::new(&spec(vec![
        source("a", udp(), &provides),
        source("b", udp(), &provides),
    ]));
    for i in 0..50 {
        insert(&mut history, 0, f64::from(i) / 10.0, position(0.0));
    }
    let mut state = |source: usize, t: f64| history.source_state(source, UtcNs(0).plus_s(t));
    assert_eq!((state(0, 5.0), state(1, 5.0)), (State::Ok, State::Silent));
    assert_eq!(state(0, 5.5), State::Hold);
    assert_eq!(state(0, 8.0), State::Stale);
    assert_eq!(state(0, 16.0), State::Lost);
}

// ---------------------------------------------------------------- TCP

fn hdt(degrees: f64) -> Vec<u8> {
    sentence(&format!("HEHDT,{degrees:.1},T"))
}

fn wait(inputs: &mut NavInputs, history: &mut NavHistory, samples: u64) {
    eventually("samples", || {
        inputs.pull(UtcNs(i64::MAX), history);
        inputs.counters()[0].decoder.samples >= samples
    });
}

fn opened(input: NavInputSpec) -> (NavInputs, NavHistory) {
    super::nav_inputs::opened(&spec(vec![source("tcp", input, &[NavChannel::Heading])]))
}

#[test]
fn sentences_of_a_tcp_server_are_read_in_any_pieces_and_after_a_reconnection() {
    let server = TcpListener::bind("127.0.0.1:0").expect("a port");
    let address = server.local_addr().expect("bound").to_string();
    let (mut inputs, mut history) = opened(NavInputSpec::TcpConnect { address });
    for connection in 1..=2_u64 {
        let (mut client, _) = server.accept().expect("connects, again too");
        let text: Vec<u8> = (0..20).flat_map(|i| hdt(f64::from(i))).collect();
        for piece in text.chunks(7) {
            client.write_all(piece).expect("sent");
        }
        wait(&mut inputs, &mut history, 20 * connection);
        drop(client);
        let counters = &inputs.counters()[0];
        assert_eq!(counters.live.reopened, connection);
        assert_eq!(
            (counters.decoder.bad_checksum, counters.decoder.resync_bytes),
            (0, 0)
        );
    }
}

#[test]
fn the_newest_client_of_a_tcp_source_is_active() {
    let listen = "127.0.0.1:0".parse().expect("an address");
    let (mut inputs, mut history) = opened(NavInputSpec::TcpListen { listen });
    let (_, address) = inputs.listening()[0].clone();
    let mut old = TcpStream::connect(address).expect("connects");
    old.write_all(&hdt(10.0)).expect("sent");
    wait(&mut inputs, &mut history, 1);
    let mut new = TcpStream::connect(address).expect("connects");
    new.write_all(&hdt(20.0)).expect("sent");
    wait(&mut inputs, &mut history, 2);
    assert_eq!(inputs.counters()[0].live.reopened, 2);
}

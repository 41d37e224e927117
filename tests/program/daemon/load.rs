//! Tests of the daemon with the records of a large multibeam sonar, two topside clients that read and one that does not.
//! `tools/soak --load` is the long form. It has a client that reads a byte per second, and compares the timing with that without
//! clients.

use echotank_runtime::io::sonar::client::SevenKClient;
use echotank_runtime::io::sonar::verify::Verifier;

use super::modes::status;
use super::{Daemon, PATIENCE, eventually};

/// Multibeam sonar with 256 elements, and beams of 2000 samples. A record has 2 MB; four records may wait for a client, and more in
/// its socket.
const LARGE: [&str; 10] = [
    "sonar.receive=[{name=\"rx\", elements=256, spacing_m=0.00375, position_m=[0.6, 0.0, 0.9], yaw_deg=90.0, element_pattern=\"omnidirectional\", sensitivity_db=0.0}]",
    "sonar.beams={fan={array=\"rx\", beams=256, sector_deg=120.0, shading=\"uniform\", former=\"fft\"}}",
    "sonar.output.sevenk={id=103, arrays=[\"rx\"], listen=\"127.0.0.1:0\", client_queue_mib=8}",
    "control.listen=127.0.0.1:0",
    "sonar.model.synthesis=direct",
    "sonar.receiver.sample_rate_khz=50",
    "sonar.pulse.duration_ms=0.5",
    "sonar.ping.range_m=29.61",
    "sonar.ping.rate_hz=5",
    "nav.source.0.path=data/launch_nav.csv",
];
const PINGS: u64 = 8;

#[test]
fn readers_get_every_ping_while_a_stalled_client_misses_whole_records() {
    let mut daemon = Daemon::start("hil-configs/points.toml", LARGE);
    let http = daemon.announced("control http", "http");
    let address = daemon.address_of("7k points", "tcp");
    let mut third = SevenKClient::connect(address).expect("listening");
    third.subscribe(&[7038, 7018]).expect("subscribed");
    let peer = third.local_addr().expect("bound");
    let readers: Vec<_> = (0..2)
        .map(|_| {
            let mut client = SevenKClient::connect(address).expect("listening");
            client.subscribe(&[7038, 7018]).expect("subscribed");
            std::thread::spawn(move || {
                let mut verifier = Verifier::default();
                while verifier.tally(7038).received < PINGS {
                    let record = client.next_record(PATIENCE).expect("connected");
                    let record = record.expect("a record in time");
                    verifier.note(record.record_type(), record.body());
                }
                assert_eq!(client.counters().checksum_errors, 0);
                verifier
            })
        })
        .collect();
    let verifiers: Vec<_> = readers
        .into_iter()
        .map(|reader| reader.join().expect("no panic"))
        .collect();
    // A ping skipped on a loaded machine has a number but is never sent.
    let (skipped, line) = eventually(|| {
        let status = status(http);
        let sonar = &status["sonars"][0];
        let counters = sonar["counters"].as_object().expect("counters");
        let skipped: u64 = counters
            .iter()
            .filter(|(name, _)| name.starts_with("pings_skipped"))
            .filter_map(|(_, count)| count.as_u64())
            .sum();
        let outputs = sonar["outputs"].as_array().expect("outputs");
        let its = outputs.iter().filter_map(|line| line.as_str());
        let its = its.filter_map(|line| line.lines().find(|l| l.contains(&format!("{peer}: "))));
        let line = its.map(str::to_owned).next().expect("the third is there");
        match line.contains(" 0 dropped") {
            true => Err(line),
            false => Ok((skipped, line)),
        }
    });
    println!("{line}; {skipped} pings skipped");
    for verifier in &verifiers {
        let tally = verifier.tally(7038);
        assert!(tally.lost <= skipped, "{tally:?}, {skipped} skipped");
        assert_eq!((tally.duplicate, tally.late), (0, 0));
        // The last ping's beams may still be in transit.
        let beams = verifier.tally(7018);
        assert!(
            beams.lost <= skipped && beams.received + 1 >= PINGS,
            "{beams:?}"
        );
    }
    daemon.terminate();
}

//! Tests that recordings hold every sent ping after a kill at any time, and that the next start recovers them.

use std::io::BufReader;
use std::os::fd::OwnedFd;
use std::process::{ChildStdout, Command};

use echotank_protocols::sevenk::file::{CataloguePointer, FileReader};
use echotank_runtime::io::control::client;

use super::modes::{pings_in, pings_of, rig, status, wait_delivered};
use super::{Daemon, eventually};
use crate::{file_of, files_in, run_well, sets};

#[test]
fn a_killed_daemon_loses_no_sent_ping_and_the_next_recovers_its_recording() {
    let folder = tempfile::tempdir().expect("folder");
    let mut daemon = rig(folder.path(), &[]);
    let at = daemon.announced("control http", "http");
    let delivered = wait_delivered(at, 6);
    daemon.child.kill().expect("killed");
    daemon.child.wait().expect("gone");

    let mut next = rig(folder.path(), &["run.clock=lockstep"]);
    next.announced("control http", "http");
    let printed = next.terminate();
    assert!(printed.contains("had been cut off: recovered"), "{printed}");

    // The second run begins a new recording. In the same second, it may have the same name with another
    // suffix.
    let mut files: Vec<_> = files_in(folder.path()).collect();
    files.sort();
    let mended = &files[0];
    let bytes = std::fs::read(mended).expect("readable");
    let first = FileReader::new(&bytes).next().expect("one").expect("sound");
    let pointer = CataloguePointer::of_record(&first.record).expect("closed");
    let end = pointer.offset_bytes + u64::from(pointer.size_bytes);
    assert_eq!(end, bytes.len() as u64);
    for file in &files[1..] {
        std::fs::remove_file(file).expect("removed");
    }
    let pings = pings_in(&pings_of(folder.path())) as u64;
    assert!(pings >= delivered, "{pings} of {delivered} pings");
    let said = run_well("recover", [mended]);
    assert!(said.contains("is complete"), "{said}");
}

#[test]
fn a_daemon_that_loses_its_terminal_closes_its_recording() {
    let folder = tempfile::tempdir().expect("folder");
    let mut daemon = rig(folder.path(), &[]);
    let at = daemon.announced("control http", "http");
    wait_delivered(at, 2);
    let nothing = std::fs::File::open("/dev/null").expect("opens");
    daemon.stdout = BufReader::new(ChildStdout::from(OwnedFd::from(nothing)));
    daemon.signal("-HUP");
    let ended = daemon.child.wait().expect("ended");
    assert!(ended.success(), "{ended}");
    let said = run_well("recover", files_in(folder.path()));
    assert!(said.contains("is complete"), "{said}");
}

/// All record formats together.
const EVERY_KIND: [&str; 13] = [
    "run.queue_pings=30",
    "sonar.output.sevenk.listen=127.0.0.1:0",
    "control.listen=127.0.0.1:0",
    "sonar.model.synthesis=direct",
    "sonar.ping.range_m=15",
    "sonar.ping.rate_hz=20",
    "nav.loop=true",
    "sonar.output.jsf={listen=\"127.0.0.1:0\", listen_data=\"127.0.0.1:0\", record=true}",
    "sonar.output.xtf={}",
    "sonar.output.ping={device=\"omniscan450\", side=\"port\", listen=\"127.0.0.1:0\"}",
    "sonar.output.sigmf={arrays=[\"port\"]}",
    "sonar.output.wav={arrays=[\"port\"]}",
    "sonar.output.mcap={}",
];

#[test]
fn a_full_disk_stops_recordings_and_they_go_on_when_there_is_room() {
    let folder = tempfile::tempdir().expect("folder");
    // The limit is some tens of kilobytes per file. SIGXFSZ is ignored, so a write fails as on a full disk.
    let limited = "trap '' XFSZ; ulimit -S -f 40; exec \"$0\" \"$@\"";
    let mut command = Command::new("sh");
    command.args(["-c", limited, env!("CARGO_BIN_EXE_echotank"), "run"]);
    command.arg("hil-configs/points.toml");
    let record = format!("record.directory={:?}", folder.path());
    command
        .args(sets([&EVERY_KIND[..], &[&record]].concat()))
        .current_dir(echotank_testing::repository());
    let mut daemon = Daemon::spawn(&mut command);
    let at = daemon.announced("control http", "http");
    eventually(|| {
        let stopped = &status(at)["sonars"][0]["counters"]["recordings_stopped"];
        let all = (stopped.as_u64() >= Some(7)).then_some(());
        all.ok_or(format!("{stopped} of 7 recordings stopped"))
    });
    let then = status(at)["pings_delivered"].as_u64().expect("a count");
    wait_delivered(at, then + 5);
    let health = || client::get(at, "/healthz", None).expect("answers");
    // Short pings fit into the next file, which is then full in turn.
    for kind in ["s7k", "jsf", "xtf", "svlog", "sigmf-data", "wav", "mcap"] {
        eventually(|| match health() {
            (503, why) if why.contains(&format!("points.{kind} stopped")) => Ok(()),
            (code, why) => Err(format!("{code} {why}, not {kind}")),
        });
    }
    let pid = format!("--pid={}", daemon.child.id());
    let freed = Command::new("prlimit")
        .args([&pid, "--fsize=unlimited"])
        .status();
    assert!(freed.expect("prlimit").success());
    eventually(|| match health() {
        (200, _) => Ok(()),
        (_, why) => Err(why),
    });
    wait_delivered(at, then + 10);
    daemon.child.kill().expect("killed");
    daemon.child.wait().expect("gone");
    // The files are complete or recovered.
    let kinds = ["s7k", "jsf", "xtf", "svlog", "sigmf-meta", "wav", "mcap"];
    for kind in kinds {
        let file = file_of(folder.path(), "", &format!(".{kind}"));
        for want in ["", "is complete"] {
            let said = run_well("recover", [&file]);
            assert!(said.contains(want), "{said}");
        }
    }
}

//! Killed at any moment, a record holds every ping that had left, and the next start mends it.

use std::process::Command;

use echotank_protocols::sevenk::file::{CataloguePointer, FileReader};

use super::modes::{pings_in, pings_of, rig, wait_delivered};

#[test]
fn a_killed_daemon_loses_no_ping_that_had_left_and_the_next_mends_its_record() {
    let folder = tempfile::tempdir().expect("folder");
    let mut daemon = rig(folder.path(), &[]);
    let at = daemon.announced("control http", "http");
    let delivered = wait_delivered(at, 6);
    daemon.child.kill().expect("killed");
    daemon.child.wait().expect("gone");

    let mut next = rig(folder.path(), &["run.clock=lockstep"]);
    next.announced("control http", "http");
    let printed = next.terminate();
    assert!(printed.contains("had been cut off: mended"), "{printed}");

    // The second begins a record of its own; of one second it may have the first's name with another's.
    let mut files: Vec<_> = std::fs::read_dir(folder.path())
        .expect("folder")
        .map(|e| e.expect("entry").path())
        .collect();
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
    let done = Command::new(env!("CARGO_BIN_EXE_echotank"))
        .arg("recover")
        .arg(mended)
        .output()
        .expect("echotank runs");
    let said = String::from_utf8_lossy(&done.stdout);
    assert!(done.status.success() && said.contains("is whole"), "{said}");
}

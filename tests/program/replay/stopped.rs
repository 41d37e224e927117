//! Test of a replay that is stopped with Ctrl-C.

use std::process::{Command, Stdio};
use std::time::{Duration, Instant};
use std::{fs, thread};

use echotank_protocols::sevenk::file::FileReader;

use super::files;
use crate::command;

#[test]
fn a_stopped_replay_completes_its_files_and_says_how_many_pings_they_hold() {
    let out = tempfile::tempdir().expect("folder");
    let child = command("replay")
        .args([
            "hil-configs/quickstart.toml",
            "--formats",
            "s7k,npz,png,jsf",
        ])
        .args(["--set", "scene.seabed.density_per_m2=0.2", "--out"])
        .arg(out.path())
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()
        .expect("started");
    let truth = out.path().join("truth.jsonl");
    let until = Instant::now() + Duration::from_secs(120);
    while fs::read_to_string(&truth).map_or(0, |text| text.lines().count()) < 3 {
        assert!(Instant::now() < until, "no ping");
        thread::sleep(Duration::from_millis(5));
    }
    let told = Command::new("kill")
        .args(["-INT", &child.id().to_string()])
        .status();
    assert!(told.expect("kill").success());
    let ended = child.wait_with_output().expect("ended");
    let said = String::from_utf8_lossy(&ended.stderr).into_owned();
    assert_eq!(ended.status.code(), Some(1), "{said}");
    let printed = String::from_utf8_lossy(&ended.stdout).into_owned();
    let (_, after) = said
        .split_once("stopped by a signal after ")
        .unwrap_or_else(|| panic!("{said}"));
    assert!(
        after.contains(" pings; the files above are complete and hold these pings"),
        "{said}"
    );
    let pings: usize = after
        .split(' ')
        .next()
        .expect("a word")
        .parse()
        .expect("a number");
    assert!(pings >= 3);

    let files = files(out.path());
    let names: Vec<_> = files.keys().map(String::as_str).collect();
    assert_eq!(
        names,
        [
            "hull.jsf",
            "hull.s7k",
            "pings.npz",
            "truth.jsonl",
            "waterfall.png"
        ]
    );
    for name in names {
        assert!(printed.contains(name), "{name}: {printed}");
    }
    let lines = String::from_utf8_lossy(&files["truth.jsonl"])
        .lines()
        .count();
    assert_eq!(lines, pings);
    let types: Vec<_> = FileReader::new(&files["hull.s7k"])
        .map(|found| found.expect("whole").record.frame.record_type_id)
        .collect();
    let of_pings = types.iter().filter(|&&id| id == 7000).count();
    assert_eq!(
        (of_pings, types.last()),
        (pings, Some(&7300)),
        "a catalogue ends the file"
    );
}

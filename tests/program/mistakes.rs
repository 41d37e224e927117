//! Mistakes of users, and the answer to each: a table of commands, exit statuses and the words that name the place, the value, the rule and the
//! remedy.

use std::net::TcpListener;
use std::path::Path;

use crate::run;

/// A mistake: what it is, the command, its exit status, and words of the answer.
type Mistake = (&'static str, &'static str, i32, &'static [&'static str]);

const Q: &str = "hil-configs/quickstart.toml";

/// In the commands, `{Q}` is the quickstart, `{tmp}` a folder with the files of [`prepare`], and `{used}` and `{free}` are TCP ports with and
/// without a listener.
const MISTAKES: &[Mistake] = &[
    // Configuration
    (
        "a misspelt key",
        "check {Q} --set sonar.ping.rnage_m=75",
        2,
        &["sonar[0].ping.rnage_m = 75: unknown key; did you mean \"range_m\"?"],
    ),
    (
        "a key without its table",
        "check {Q} --set elements=75",
        2,
        &["elements = 75: unknown key; did you mean \"sonar.receive.elements\"?"],
    ),
    (
        "a misspelt word",
        "check {Q} --set nav.mode=setle",
        2,
        &["nav.mode = \"setle\": must be \"settle\" or \"predict\"; did you mean \"settle\"?"],
    ),
    (
        "a value with a unit",
        "check {Q} --set sonar.ping.range_m=75m",
        2,
        &[
            "range_m = \"75m\": must be a number above 0",
            "write the number alone",
        ],
    ),
    (
        "a negative range",
        "check {Q} --set sonar.ping.range_m=-5",
        2,
        &["sonar[0].ping.range_m = -5: must be a number above 0, at most 20000"],
    ),
    (
        "a number that is none",
        "check {Q} --set sonar.ping.range_m=nan",
        2,
        &["sonar[0].ping.range_m = nan: must be a number above 0"],
    ),
    (
        "a range beyond the limits",
        "check {Q} --set sonar.ping.range_m=5000",
        2,
        &["range_m = 5000: must lie within limits.range_m = ["],
    ),
    (
        "a ping rate beyond the limits",
        "check {Q} --set sonar.ping.rate_hz=100",
        2,
        &["rate_hz = 100: must lie within limits.ping_rate_hz = [0.1, 10.0]"],
    ),
    (
        "a ping rate beyond the speed of sound",
        "check {Q} --set sonar.ping.rate_hz=10",
        0,
        &["the range of 150 m is too long for 10.00 pings/s; the rate is reduced to 4.98"],
    ),
    (
        "arrays in the air",
        "check {Q} --set nav.reference_depth_m=-10",
        2,
        &[
            "nav.reference_depth_m = -10: array port of sonar hull is 5.9 m above the waterline",
            "count downwards",
        ],
    ),
    (
        "a text that is not TOML",
        "check {tmp}/syntax.toml",
        2,
        &["syntax.toml: 1 problem", "line 2: not TOML: "],
    ),
    (
        "a text that is not TOML, and an override",
        "check {tmp}/syntax.toml --set run.threads=1",
        2,
        &["line 2: not TOML: "],
    ),
    (
        "a configuration that does not exist",
        "check {tmp}/none.toml",
        2,
        &["none.toml: 1 problem", "cannot be read: not found"],
    ),
    (
        "a log that does not exist",
        "check {Q} --set nav.source.0.path=none.log",
        2,
        &["nav.source[0].path = \"none.log\": must be a file that can be read: not found"],
    ),
    (
        "an unknown coordinate system",
        "check {Q} --set scene.seabed.crs=utm-33x",
        2,
        &[
            "scene.seabed.crs = \"utm-33x\": must be \"local\", \"geographic\", \"projected\", a zone like \"utm-31n\"",
        ],
    ),
    (
        "a seabed that is no seabed",
        "check {Q} --set scene.seabed.path=README.md",
        2,
        &["hil-configs/README.md: line 1: `ncols`: is missing in the header"],
    ),
    (
        "elements too far apart",
        "check hil-configs/multibeam.toml --set sonar.receive.0.spacing_m=0.01",
        1,
        &["grating lobes", "remedy     ", "spacing_m of at most "],
    ),
    (
        "a side-scan without patterns",
        "check tests/data/config/minimal.toml --set sonar.receive.0.yaw_deg=0 --set sonar.receive.0.roll_deg=60 --set sonar.beams.port=\"rx\"",
        1,
        &["sides mirrored", "pattern = \"rectangle\""],
    ),
    // Navigation
    (
        "a log without positions",
        "replay {Q} --nav {tmp}/heading.log --out {tmp}/out",
        2,
        &["no source gives a position", "gives heading"],
    ),
    (
        "a log with wrong checksums",
        "replay {Q} --nav {tmp}/checksums.log --out {tmp}/out",
        2,
        &["2 sentences: 2 with a wrong checksum; checksum = \"ignore\""],
    ),
    (
        "live navigation replayed without a log",
        "replay tests/data/config/minimal.toml --out {tmp}/out",
        2,
        &["no recorded navigation", "give one with --nav LOG"],
    ),
    (
        "a recording of navigation that is not live",
        "run {Q} --record-nav {tmp}/nav.pcapng",
        2,
        &["--record-nav ", "no live navigation source; replay its log"],
    ),
    (
        "a serial port that does not exist",
        "run {tmp}/serial.toml",
        1,
        &[
            "nav source `gnss`: cannot open serial port /dev/ttyNONE at 9600 baud",
            "ls /dev/tty*",
        ],
    ),
    // Replay
    (
        "a misspelt format",
        "replay {Q} --out {tmp}/out --formats s7kk",
        2,
        &["invalid value 's7kk'", "a similar value exists: 's7k'"],
    ),
    (
        "a format without data in this rig",
        "replay hil-configs/board.toml --out {tmp}/out --formats wav,xtf",
        2,
        &[
            "--formats xtf: would write nothing, because no sonar of this rig has side-scan lines",
            "sonar.beams.port",
        ],
    ),
    (
        "a range of pings backwards",
        "replay {Q} --out {tmp}/out --pings 10..5",
        2,
        &["invalid value '10..5'", "B must not be below A"],
    ),
    (
        "a range of pings that is none",
        "replay {Q} --out {tmp}/out --pings ten",
        2,
        &["expected A..B, the first and the last ping, e.g. 1..600"],
    ),
    (
        "pings after the end of the navigation",
        "replay hil-configs/points.toml --out {tmp}/out --pings 500..600",
        2,
        &[
            "--pings 500..600: the navigation holds only about ",
            "choose from 1..",
        ],
    ),
    (
        "no folder for the results",
        "replay {Q}",
        2,
        &["required arguments were not provided", "--out <DIR>"],
    ),
    (
        "a file in place of the folder for the results",
        "replay {Q} --out {tmp}/syntax.toml",
        2,
        &["--out ", "syntax.toml: is a file; name a folder"],
    ),
    // Commands
    (
        "a misspelt command",
        "rnu {Q}",
        2,
        &[
            "unrecognized subcommand 'rnu'",
            "a similar subcommand exists: 'run'",
        ],
    ),
    (
        "a misspelt protocol",
        "new sidescan --frequency-khz 455 --range-m 75 --protocol jfs",
        2,
        &["invalid value 'jfs'", "a similar value exists: 'jsf'"],
    ),
    (
        "a number of threads that is none",
        "run {Q} --threads many",
        2,
        &["invalid value 'many' for '--threads <THREADS>': must be a whole number"],
    ),
    (
        "a negative duration",
        "run {Q} --seconds -1",
        2,
        &["--seconds -1: must be above 0"],
    ),
    (
        "a port in use",
        "run {Q} --set sonar.output.sevenk.listen=127.0.0.1:{used} --set control.listen=127.0.0.1:0",
        1,
        &[
            "127.0.0.1:{used}",
            "another program uses this port",
            "0 means any free one",
        ],
    ),
    // Control of a daemon
    (
        "no daemon",
        "ctl --address 127.0.0.1:{free} status",
        1,
        &[
            "no daemon listens at 127.0.0.1:{free}",
            "echotank run RIG",
            "--address",
        ],
    ),
    (
        "a misspelt setting",
        "ctl --address 127.0.0.1:{free} set rnage_m=75",
        2,
        &[
            "rnage_m: \"set\" has no such key; did you mean \"range_m\"?",
            "gain_db",
        ],
    ),
    (
        "a setting with a unit",
        "ctl --address 127.0.0.1:{free} set range_m=75m",
        2,
        &["range_m = 75m: must be a finite number, without a unit"],
    ),
    (
        "a setting as an option",
        "ctl --address 127.0.0.1:{free} set --range-m 75",
        2,
        &["--range-m: expected KEY=VALUE; did you mean \"range_m\"?"],
    ),
    (
        "an unknown fault",
        "ctl --address 127.0.0.1:{free} fault gian element=3 value=-6",
        2,
        &[
            "kind = \"gian\": must be one of dead, stuck,",
            "did you mean \"gain\"?",
        ],
    ),
    (
        "a fault that is too large",
        "ctl --address 127.0.0.1:{free} fault gain element=3 value=500",
        2,
        &["value = 500.0: must be from -200 to 100 dB"],
    ),
    (
        "a command that is not JSON",
        "ctl --address 127.0.0.1:{free} send {do:step}",
        2,
        &["is not valid JSON"],
    ),
];

fn prepare(folder: &Path) {
    let write = |name: &str, text: &str| std::fs::write(folder.join(name), text).expect("written");
    write("syntax.toml", "[medium]\nsound_speed_m_per_s 1500\n");
    write("heading.log", "$HEHDT,1.5,T*2B\r\n$HEHDT,1.6,T*28\r\n");
    write("checksums.log", "$HEHDT,1.5,T*00\r\n$HEHDT,1.6,T*00\r\n");
    let minimal = echotank_testing::repository().join("tests/data/config/minimal.toml");
    let minimal = std::fs::read_to_string(minimal).expect("readable");
    let serial = minimal.replace(
        "kind = \"udp\"\nlisten = \"127.0.0.1:10110\"",
        "kind = \"serial\"\nport = \"/dev/ttyNONE\"\nbaud = 9600",
    );
    assert_ne!(serial, minimal);
    write("serial.toml", &serial);
}

#[test]
fn every_mistake_is_answered_with_its_place_its_rule_and_a_remedy() {
    let folder = tempfile::tempdir().expect("folder");
    prepare(folder.path());
    let listener = || TcpListener::bind("127.0.0.1:0").expect("a port");
    let (used, free) = (listener(), listener());
    let port = |l: &TcpListener| l.local_addr().expect("bound").port().to_string();
    let ports = (port(&used), port(&free));
    drop(free);
    let fill = |text: &str| {
        text.replace("{Q}", Q)
            .replace("{tmp}", folder.path().to_str().expect("text"))
            .replace("{used}", &ports.0)
            .replace("{free}", &ports.1)
    };
    let mut wrong = Vec::new();
    for (mistake, command, code, words) in MISTAKES {
        let command = fill(command);
        let mut arguments = command.split(' ');
        let done = run(arguments.next().expect("a command"), arguments);
        let said = format!("{}{}", done.out, done.err);
        let missing = words
            .iter()
            .map(|w| fill(w))
            .find(|w| !said.contains(w.as_str()));
        if done.code != Some(*code) || missing.is_some() {
            wrong.push(format!(
                "{mistake}: `{command}` ended with {:?}, not {code}; no {missing:?} in\n{said}",
                done.code
            ));
        }
        // Names of Rust types, parsers and panics are not for users.
        for leaked in [
            "panicked",
            "serde",
            "Err(",
            "Some(",
            "invalid type",
            "os error 2)",
        ] {
            let is_serial = *mistake == "a serial port that does not exist";
            if said.contains(leaked) && !is_serial {
                wrong.push(format!("{mistake}: `{leaked}` in\n{said}"));
            }
        }
    }
    assert!(wrong.is_empty(), "{}", wrong.join("\n\n"));
    assert!(MISTAKES.len() >= 24);
    assert!(
        !folder.path().join("out").exists(),
        "no mistake leaves results"
    );
}

/// The page `docs/operate/mistakes.md`.
fn page() -> String {
    let mut text = String::from(
        "# Mistakes and answers\n\nEach entry is a test: the command ends with this status, and its answer holds these words. Status 2 means that the\ncommand or the configuration is wrong. Status 1 means that it failed, or that the rig runs otherwise than meant.\n",
    );
    for (mistake, command, code, words) in MISTAKES {
        let own = |text: &str| {
            text.replace("{Q}", "rig.toml")
                .replace("{tmp}/", "")
                .replace("{used}", "7000")
                .replace("{free}", "7780")
        };
        let words: Vec<_> = words.iter().map(|w| own(w.trim())).collect();
        text += &format!(
            "\n**{mistake}**: `{}` ({code})\n\n```text\n{}\n```\n",
            own(command),
            words.join("\n")
        );
    }
    text
}

/// `ECHOTANK_WRITE_DOCS=1 cargo nextest run -p echotank page_of_mistakes` renews the page.
#[test]
fn the_page_of_mistakes_is_that_of_the_table() {
    let path = echotank_testing::repository().join("docs/operate/mistakes.md");
    if std::env::var_os("ECHOTANK_WRITE_DOCS").is_some() {
        std::fs::write(&path, page()).expect("written");
    }
    let found = std::fs::read_to_string(path).expect("the page");
    assert!(found == page(), "renew docs/operate/mistakes.md");
}

#[test]
fn the_help_names_every_protocol_family() {
    let done = run("--help", [""; 0]);
    assert_eq!(done.code, Some(0));
    for family in [
        "7k",
        "JSF",
        "WBMS",
        "Ping",
        "Imagenex 872",
        "VITA 49",
        "element stream",
        "XTF",
        "SigMF",
        "WAV",
    ] {
        assert!(done.out.contains(family), "{family}:\n{}", done.out);
    }
}

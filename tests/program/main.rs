//! Tests of the program as its user runs it: commands, daemon and replay.

mod campaign;
mod commands;
mod daemon;
mod generate;
mod mistakes;
mod new;
mod new_mistakes;
mod replay;
mod verdict;

use std::ffi::OsStr;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

/// `echotank SUBCOMMAND` in the folder of the repository.
fn command(subcommand: &str) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_echotank"));
    command
        .arg(subcommand)
        .current_dir(echotank_testing::repository());
    command
}

/// That a command whose standard output is closed at once ends without a word on standard error.
fn ends_quietly<'a>(subcommand: &str, arguments: impl IntoIterator<Item = &'a str>) {
    let mut child = command(subcommand)
        .args(arguments)
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()
        .expect("started");
    drop(child.stdout.take());
    let ended = child.wait_with_output().expect("ended");
    let words = String::from_utf8_lossy(&ended.stderr);
    assert!(words.is_empty(), "{subcommand}: {words}");
}

/// Result of a command: its exit code and its output.
struct Ended {
    code: Option<i32>,
    out: String,
    err: String,
}

fn ended(command: &mut Command) -> Ended {
    let done = command.output().expect("echotank runs");
    let text = |bytes| String::from_utf8(bytes).expect("UTF-8");
    Ended {
        code: done.status.code(),
        out: text(done.stdout),
        err: text(done.stderr),
    }
}

/// Runs `echotank SUBCOMMAND ARGUMENTS...` to its end.
fn run<A: AsRef<OsStr>>(subcommand: &str, arguments: impl IntoIterator<Item = A>) -> Ended {
    ended(command(subcommand).args(arguments))
}

/// As [`run`], for a command that must succeed. Returns the standard output.
fn run_well<A: AsRef<OsStr>>(subcommand: &str, arguments: impl IntoIterator<Item = A>) -> String {
    let done = run(subcommand, arguments);
    assert_eq!(done.code, Some(0), "{}\n{}", done.out, done.err);
    done.out
}

/// Replays a configuration into a folder.
fn replay_into(out: &Path, config: impl AsRef<OsStr>, arguments: &[impl AsRef<OsStr>]) {
    let head = [config.as_ref(), "--quiet".as_ref(), "--out".as_ref()];
    let head = head.into_iter().chain([out.as_os_str()]);
    run_well("replay", head.chain(arguments.iter().map(AsRef::as_ref)));
}

/// `--set` before each setting.
fn sets<S: AsRef<str>>(settings: impl IntoIterator<Item = S>) -> Vec<String> {
    let settings = settings.into_iter();
    let pairs = settings.flat_map(|set| ["--set".to_owned(), set.as_ref().to_owned()]);
    pairs.collect()
}

fn files_in(folder: &Path) -> impl Iterator<Item = PathBuf> {
    let entries = std::fs::read_dir(folder).expect("folder");
    entries.map(|entry| entry.expect("entry").path())
}

/// The file in a folder with a name that begins with `start` and ends with `end`.
fn file_of(folder: &Path, start: &str, end: &str) -> PathBuf {
    let found = files_in(folder).find(|path| {
        let name = path.file_name().expect("a name").to_string_lossy();
        name.starts_with(start) && name.ends_with(end)
    });
    found.unwrap_or_else(|| panic!("no {start}*{end} in {}", folder.display()))
}

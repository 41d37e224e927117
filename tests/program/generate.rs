//! Tests of the generated manual pages and shell completions. A program that is not installed checks nothing.

use std::path::Path;
use std::process::{Command, Stdio};

use crate::{files_in, run, run_well};

/// Runs a checker, which must end with status 0 and print nothing.
fn finds_nothing(checker: &str, arguments: &[&str], file: &Path) {
    let mut command = Command::new(checker);
    command.args(arguments).arg(file).stdin(Stdio::null());
    let Ok(done) = command.output() else {
        return;
    };
    let printed = [done.stdout, done.stderr].concat();
    let printed = String::from_utf8_lossy(&printed);
    assert!(
        done.status.success() && printed.is_empty(),
        "{checker} {}: {}\n{printed}",
        file.display(),
        done.status
    );
}

#[test]
fn every_command_has_a_manual_page_that_renders_without_a_warning() {
    let folder = tempfile::tempdir().expect("a folder");
    let folder = folder.path().join("man1");
    run_well("generate", ["man".as_ref(), folder.as_os_str()]);
    let help = run_well("help", [""; 0]);
    let commands = help
        .lines()
        .skip_while(|line| *line != "Commands:")
        .skip(1)
        .take_while(|line| !line.is_empty())
        .filter(|line| line.starts_with("  ") && !line.starts_with("   "))
        .filter_map(|line| line.split_whitespace().next())
        .filter(|name| *name != "help");
    for name in commands {
        let page = folder.join(format!("echotank-{name}.1"));
        assert!(page.exists(), "{}", page.display());
    }
    for page in files_in(&folder) {
        // `-z` parses only.
        finds_nothing("groff", &["-man", "-Tutf8", "-ww", "-z"], &page);
        finds_nothing("mandoc", &["-T", "lint", "-W", "error"], &page);
    }
    let main = std::fs::read_to_string(folder.join("echotank.1")).expect("the page");
    assert!(main.contains("EXIT STATUS"), "{main}");
}

#[test]
fn each_shell_reads_its_completions() {
    let folder = tempfile::tempdir().expect("a folder");
    for (shell, arguments) in [
        (
            "bash",
            &[
                "--norc",
                "-uc",
                "source $0 && complete -p echotank >/dev/null",
            ][..],
        ),
        (
            "zsh",
            &[
                "-fc",
                "autoload -U compinit && compinit -D && source $0 && [[ $_comps[echotank] = _echotank ]]",
            ],
        ),
        (
            "fish",
            &[
                "--no-config",
                "-c",
                "source $argv[1]; and complete -C 'echotank scene ' | string match -q 'info*'",
            ],
        ),
    ] {
        let script = run_well("generate", ["completions", shell]);
        assert!(script.contains("mosaic"), "{shell}");
        let file = folder.path().join(shell);
        std::fs::write(&file, script).expect("written");
        finds_nothing(shell, arguments, &file);
    }
    for shell in ["elvish", "powershell"] {
        assert!(run_well("generate", ["completions", shell]).contains("mosaic"));
    }
    let done = run("generate", ["completions", "dos"]);
    assert_eq!(done.code, Some(2));
}

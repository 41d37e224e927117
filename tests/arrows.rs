//! The house's arrows: no stage imports another stage. Only `run` and `cli` know the order; `io` may use the stages' sans-I/O types.

use std::fs;
use std::path::{Path, PathBuf};

/// What each folder or file of `src` may name after `crate::`.
const MAY_USE: &[(&str, &[&str])] = &[
    ("time.rs", &[]),
    ("geodesy.rs", &[]),
    ("utm.rs", &[]),
    ("frames.rs", &["time"]),
    ("flow.rs", &["frames", "time"]),
    ("config", &["flow", "frames", "time"]),
    ("nav", SHARED),
    ("ping", SHARED),
    ("scene", SHARED),
    ("echo", SHARED),
    ("array", SHARED),
    ("beam", SHARED),
    ("image", SHARED),
    ("emit", SHARED),
    (
        "io",
        &["config", "flow", "frames", "time", "nav", "image", "emit"],
    ),
];
const SHARED: &[&str] = &["config", "flow", "frames", "geodesy", "time", "utm"];

fn rust_files(path: &Path, into: &mut Vec<PathBuf>) {
    if path.is_dir() {
        for entry in fs::read_dir(path).expect("readable folder") {
            rust_files(&entry.expect("entry").path(), into);
        }
    } else if path.extension().is_some_and(|e| e == "rs") {
        into.push(path.to_path_buf());
    }
}

/// First names after `crate::` in `text`, `crate::{a, b}` included; comments are not code.
fn crate_uses(text: &str) -> Vec<String> {
    let code: String = text
        .lines()
        .map(|line| line.split("//").next().unwrap_or(""))
        .collect::<Vec<_>>()
        .join("\n");
    let mut names = Vec::new();
    for rest in code.split("crate::").skip(1) {
        if let Some(group) = rest.strip_prefix('{') {
            let mut depth = 0;
            let mut name = String::new();
            for ch in group.chars() {
                match ch {
                    '{' => depth += 1,
                    '}' if depth == 0 => break,
                    '}' => depth -= 1,
                    ',' if depth == 0 => names.push(std::mem::take(&mut name)),
                    _ if depth == 0 => name.push(ch),
                    _ => {}
                }
            }
            names.push(name);
        } else {
            names.push(
                rest.chars()
                    .take_while(|c| c.is_alphanumeric() || *c == '_')
                    .collect(),
            );
        }
    }
    names
        .into_iter()
        .map(|n| n.trim().split("::").next().unwrap_or("").trim().to_string())
        .filter(|n| !n.is_empty())
        .collect()
}

#[test]
fn no_stage_imports_another_stage() {
    let src = Path::new(env!("CARGO_MANIFEST_DIR")).join("src");
    let mut wrong = Vec::new();
    let mut seen = 0;
    for (place, allowed) in MAY_USE {
        let root = src.join(place);
        assert!(root.exists(), "{place} is named here but is not in src");
        let own = place.trim_end_matches(".rs");
        let mut files = Vec::new();
        rust_files(&root, &mut files);
        for file in files {
            let text = fs::read_to_string(&file).expect("readable source");
            for name in crate_uses(&text) {
                seen += 1;
                if name != own && !allowed.contains(&name.as_str()) {
                    wrong.push(format!("{} uses crate::{name}", file.display()));
                }
            }
        }
    }
    assert!(seen > 20, "the test reads the sources: {seen} uses found");
    assert!(wrong.is_empty(), "{}", wrong.join("\n"));
}

#[test]
fn only_io_and_cli_open_sockets_ports_and_files() {
    let src = Path::new(env!("CARGO_MANIFEST_DIR")).join("src");
    let mut wrong = Vec::new();
    for place in [
        "flow.rs",
        "frames.rs",
        "nav",
        "ping",
        "echo",
        "array",
        "beam",
        "image",
        "emit",
        "run",
    ] {
        let mut files = Vec::new();
        rust_files(&src.join(place), &mut files);
        for file in files {
            let text = fs::read_to_string(&file).expect("readable source");
            let code = text.split("#[cfg(test)]").next().unwrap_or("");
            for word in [
                "tokio::",
                "socket2::",
                "serialport::",
                "std::net::Tcp",
                "std::net::Udp",
                "std::fs::",
            ] {
                if code.contains(word) {
                    wrong.push(format!("{} names {word}", file.display()));
                }
            }
        }
    }
    assert!(wrong.is_empty(), "{}", wrong.join("\n"));
}

#[test]
fn wire_formats_import_nothing_of_the_house() {
    let manifest =
        fs::read_to_string(Path::new(env!("CARGO_MANIFEST_DIR")).join("protocols/Cargo.toml"))
            .expect("manifest");
    assert!(!manifest.contains("echotank = "), "{manifest}");
}

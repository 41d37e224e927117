//! Files, sockets, serial ports and the tokio runtimes.
pub mod capture_text;
pub mod control;
pub mod datagrams;
pub mod files;
mod icmp;
pub mod link;
mod listening;
pub mod nav;
pub(crate) mod notify;
pub mod pace;
pub mod priority;
pub mod record;
pub mod serial_line;
pub mod signals;
pub mod sonar;
mod stamp;
mod tcp;
pub mod trigger;

/// What is wrong with a line of JSON, without the parser's own wording for syntax and places.
pub fn json_problem(error: &serde_json::Error) -> String {
    if !error.is_data() {
        return format!("is not valid JSON, from column {} on", error.column());
    }
    let text = error.to_string();
    let place = text.rfind(" at line ").unwrap_or(text.len());
    text[..place].to_owned()
}

/// Reads a text file.
///
/// # Errors
/// The file cannot be read or is not UTF-8.
pub fn text_of(path: &std::path::Path) -> std::io::Result<String> {
    std::fs::read_to_string(path)
}

/// Writes a text file, replacing an existing one.
///
/// # Errors
/// The file cannot be written.
pub fn write_text(path: &std::path::Path, text: &str) -> std::io::Result<()> {
    std::fs::write(path, text)
}

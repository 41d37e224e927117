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

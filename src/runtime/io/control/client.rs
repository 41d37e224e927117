//! A blocking HTTP/1.1 client for single requests, used by `echotank ctl` and the tests.

use std::io::{self, Read, Write};
use std::net::{SocketAddr, TcpStream};
use std::time::Duration;

use serde_json::Value;

/// Time limit of connecting, reading and writing.
const PATIENCE: Duration = Duration::from_secs(10);
/// Longest response read, bytes.
const MAX_BYTES: u64 = 16 << 20;

/// HTTP status and body of a response.
pub type Reply = (u16, String);

/// Sends a GET request and returns the response.
///
/// # Errors
/// The connection fails, or connecting, reading or writing exceeds 10 s.
pub fn get(address: SocketAddr, path: &str, token: Option<&str>) -> io::Result<Reply> {
    exchange(address, &format!("GET {path} HTTP/1.1\r\n"), token, "")
}

/// Sends a command as POST /control and returns the response.
///
/// # Errors
/// See [`get`].
pub fn command(address: SocketAddr, body: &Value, token: Option<&str>) -> io::Result<Reply> {
    let body = body.to_string();
    let head = format!(
        "POST /control HTTP/1.1\r\nContent-Type: application/json\r\nContent-Length: {}\r\n",
        body.len()
    );
    exchange(address, &head, token, &body)
}

fn exchange(address: SocketAddr, head: &str, token: Option<&str>, body: &str) -> io::Result<Reply> {
    let mut stream = TcpStream::connect_timeout(&address, PATIENCE)?;
    stream.set_read_timeout(Some(PATIENCE))?;
    stream.set_write_timeout(Some(PATIENCE))?;
    let token = token.map_or(String::new(), |t| format!("Authorization: Bearer {t}\r\n"));
    let request = format!("{head}Host: {address}\r\n{token}Connection: close\r\n\r\n{body}");
    stream.write_all(request.as_bytes())?;
    let mut bytes = Vec::new();
    stream.take(MAX_BYTES).read_to_end(&mut bytes)?;
    let text = String::from_utf8_lossy(&bytes);
    let broken = || io::Error::new(io::ErrorKind::InvalidData, "not an HTTP response");
    let (head, body) = text.split_once("\r\n\r\n").ok_or_else(broken)?;
    let status = head.split_whitespace().nth(1);
    let status = status.and_then(|s| s.parse().ok()).ok_or_else(broken)?;
    Ok((status, body.to_owned()))
}

//! The only home of tokio, socket2, serialport and files.
pub mod control;
pub mod datagrams;
pub mod line;
pub mod nav;
pub mod notify;
pub mod pace;
pub mod priority;
pub mod record;
pub mod serial_line;
pub mod signals;
pub mod sonar;
mod stamp;
pub mod trigger;

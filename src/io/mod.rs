//! The only home of tokio, socket2, serialport and files.
pub mod control;
pub mod nav;
pub mod record;
pub mod signals;
pub mod sonar;

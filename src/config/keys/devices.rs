//! Outputs that imitate one maker's device.

use super::*;

table! {
    /// The Ping protocol of Blue Robotics and Cerulean, over TCP and UDP on one port, and on a serial line.
    Ping;

    /// A side-scan, which sends one line, or a multibeam, which sends the soundings of a fan with bottom_detection.
    device: Choice("omniscan450", "surveyor240"), Required("\"omniscan450\"");

    /// The side-scan line that an omniscan450 sends.
    side: Choice("port", "starboard"), Shown("\"port\""), needed with device = "omniscan450";

    /// Only this computer by default: the protocol has no password.
    listen: Text, Default("\"127.0.0.1:51200\"");

    /// A serial port in addition.
    serial_port: Text, Optional("\"/dev/ttyUSB0\"");
    serial_baud: Integer(1200, 4_000_000), Default("115200");

    /// Number of an omniscan450 among synchronised devices.
    channel_number: Integer(0, 255), Default("0");

    /// Number of synchronised devices.
    channels: Integer(1, 255), Default("1");

    /// Queue of each client; records beyond it are dropped.
    client_queue_mib: Mib(1, 65_536), Default("16");
    max_clients: Integer(1, 1000), Default("8");
}

table! {
    /// NORBIT WBMS on four TCP ports in a row: text control, bathymetry, water column, side-scan or snippets.
    Wbms, later "xml", "georeferenced";

    /// Control port; the other three ports follow it. Only this computer by default: the protocol has no password.
    listen: Text, Default("\"127.0.0.1:2209\"");

    /// Queue of each client; records beyond it are dropped.
    client_queue_mib: Mib(1, 65_536), Default("16");
    max_clients: Integer(1, 1000), Default("8");
}

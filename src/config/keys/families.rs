//! Side-scan families: JSF, XTF, Imagenex 872.

use super::*;

table! {
    /// EdgeTech JSF over two TCP connections, commands and data.
    Jsf;

    /// Commands. Only this computer by default: the protocol has no password.
    listen: Text, Default("\"127.0.0.1:1700\"");

    /// Data, sent to every client that connects.
    listen_data: Text, Default("\"127.0.0.1:1701\"");

    /// 20, 21, 22: side-scan of low, high, very high frequency. 40, 41, 42: bathymetry. With channels = "sides" and format = "envelope" each
    /// [[sonar.more_pulse]] uses the next subsystem.
    subsystem: Integer(0, 255), Default("20");

    /// A second subsystem that accepts and reports commands and sends no data. Clients of dual-frequency systems need it.
    silent_subsystem: Integer(0, 255), Optional("21");

    /// A channel for each line (0 port, 1 starboard), or one for each element of `arrays`.
    channels: Choice("sides", "staves"), Default("\"sides\"");

    /// Receive arrays whose elements are the channels, in this order. Default: all. Only with channels = "staves".
    arrays: Names, Shown("[\"rx\"]"), only with channels = "staves";

    /// Data format 0 (envelope), 1 (real and imaginary, after the matched filter) or 9 (before it). With channels = "sides", 1 and 9 are the mean
    /// of the elements.
    format: Choice("envelope", "analytic", "unfiltered"), Default("\"envelope\"");

    /// Also write a file in the folder of [record].
    record: Bool, Default("false");

    /// Queue of each client; records beyond it are dropped.
    client_queue_mib: Mib(1, 65_536), Default("64");
    max_clients: Integer(1, 1000), Default("8");
}

table! {
    /// Triton XTF: side-scan lines in a file in the folder of [record].
    Xtf;

    /// Counts with the receiver's full scale as 65535, or volts.
    samples: Choice("u16", "f32"), Default("\"u16\"");
}

table! {
    /// Imagenex 872 YellowFin over TCP: a line of 1000 points for every switch command.
    Imagenex872;

    /// Only this computer by default: the protocol has no password.
    listen: Text, Default("\"127.0.0.1:4040\"");

    /// Queue of each client; records beyond it are dropped.
    client_queue_mib: Mib(1, 65_536), Default("64");
    max_clients: Integer(1, 1000), Default("8");
}

//! Side-scan families: JSF, XTF, Imagenex 872.

use super::*;

table! {
    /// EdgeTech JSF over two TCP connections, commands and data.
    Jsf;

    /// Commands. Only this computer by default: the protocol knows no password.
    listen: Text, Default("\"127.0.0.1:1700\"");

    /// Data: whoever connects gets them.
    listen_data: Text, Default("\"127.0.0.1:1701\"");

    /// 20, 21, 22 side-scan of low, high, very high frequency; 40, 41, 42 bathymetric. With channels = "sides" and format = "envelope" the lines
    /// of each [[sonar.more_pulse]] are the next one's.
    subsystem: Integer(0, 255), Default("20");

    /// One more that commands may be for: it keeps and reports what it is told, and sends no data. Clients of dual-frequency systems need it.
    silent_subsystem: Integer(0, 255), Optional("21");

    /// A channel for each line (0 port, 1 starboard), or one for each element of `arrays`.
    channels: Choice("sides", "staves"), Default("\"sides\"");

    /// Receive arrays whose elements are the channels, in this order. Left out: all. Only with channels = "staves".
    arrays: Names, Shown("[\"rx\"]");

    /// Data format 0, 1 (real and imaginary, behind the matched filter) or 9 (before it). Of a side, 1 and 9 are the mean of its elements.
    format: Choice("envelope", "analytic", "unfiltered"), Default("\"envelope\"");

    /// Into a file in [record]'s folder, which must be there.
    record: Bool, Default("false");

    /// What may wait for one slow client before its records are dropped.
    client_queue_mib: Mib(1, 65_536), Default("64");
    max_clients: Integer(1, 1000), Default("8");
}

table! {
    /// Triton XTF: side-scan lines into a file in [record]'s folder.
    Xtf;

    /// Counts, the receiver's full scale as 65535, or volts.
    samples: Choice("u16", "f32"), Default("\"u16\"");
}

table! {
    /// Imagenex 872 YellowFin over TCP: a line of 1000 points for every switch command.
    Imagenex872;

    /// Only this computer by default: the protocol knows no password.
    listen: Text, Default("\"127.0.0.1:4040\"");

    /// What may wait for one slow client before its records are dropped.
    client_queue_mib: Mib(1, 65_536), Default("64");
    max_clients: Integer(1, 1000), Default("8");
}

//! Side-scan families: JSF, XTF, Imagenex 872.

use super::Presence::{Default, Optional, Shown};
use super::{Key, Kind, Table, key};

const CLIENT_QUEUE: Key = key(
    "client_queue_mib",
    Kind::Integer(1, 65_536),
    Default("64"),
    "What may wait for one slow client before its records are dropped.",
);
const MAX_CLIENTS: Key = key("max_clients", Kind::Integer(1, 1000), Default("8"), "");
const RECORD: Key = key(
    "record",
    Kind::Bool,
    Default("false"),
    "Into a file in [record]'s folder, which must be there.",
);

pub(super) static JSF: Table = Table {
    doc: "EdgeTech JSF over two TCP connections, commands and data.",
    keys: &[
        key(
            "listen",
            Kind::Text,
            Default("\"127.0.0.1:1700\""),
            "Commands. Only this computer by default: the protocol knows no password.",
        ),
        key(
            "listen_data",
            Kind::Text,
            Default("\"127.0.0.1:1701\""),
            "Data: whoever connects gets them.",
        ),
        key(
            "subsystem",
            Kind::Integer(0, 255),
            Default("20"),
            "20, 21, 22 side-scan of low, high, very high frequency; 40, 41, 42 bathymetric. With channels = \"sides\" and format = \"envelope\" the lines of each [[sonar.more_pulse]] are the next one's.",
        ),
        key(
            "silent_subsystem",
            Kind::Integer(0, 255),
            Optional("21"),
            "One more that commands may be for: it keeps and reports what it is told, and sends no data. Clients of dual-frequency systems need it.",
        ),
        key(
            "channels",
            Kind::Choice(&["sides", "staves"], &[]),
            Default("\"sides\""),
            "A channel for each line (0 port, 1 starboard), or one for each element of `arrays`.",
        ),
        key(
            "arrays",
            Kind::Names,
            Shown("[\"rx\"]"),
            "Receive arrays whose elements are the channels, in this order. Left out: all. Only with channels = \"staves\".",
        ),
        key(
            "format",
            Kind::Choice(&["envelope", "analytic", "unfiltered"], &[]),
            Default("\"envelope\""),
            "Data format 0, 1 (real and imaginary, behind the matched filter) or 9 (before it). Of a side, 1 and 9 are the mean of its elements.",
        ),
        RECORD,
        CLIENT_QUEUE,
        MAX_CLIENTS,
    ],
    later: &[],
};

pub(super) static XTF: Table = Table {
    doc: "Triton XTF: side-scan lines into a file in [record]'s folder.",
    keys: &[key(
        "samples",
        Kind::Choice(&["u16", "f32"], &[]),
        Default("\"u16\""),
        "Counts, the receiver's full scale as 65535, or volts.",
    )],
    later: &[],
};

pub(super) static IMAGENEX872: Table = Table {
    doc: "Imagenex 872 YellowFin over TCP: a line of 1000 points for every switch command.",
    keys: &[
        key(
            "listen",
            Kind::Text,
            Default("\"127.0.0.1:4040\""),
            "Only this computer by default: the protocol knows no password.",
        ),
        CLIENT_QUEUE,
        MAX_CLIENTS,
    ],
    later: &[],
};

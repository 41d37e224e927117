//! Outputs of samples: packets for boards, and recordings.

use super::Presence::{Default, Optional, Shown};
use super::{Key, Kind, Table, from, key};

const ARRAYS: Key = key(
    "arrays",
    Kind::Names,
    Shown("[\"rx\"]"),
    "Receive arrays whose elements go out, in this order. Left out: all.",
);

pub(super) static VITA49: Table = Table {
    doc: "ANSI/VITA 49.2 over UDP: element samples for acquisition and DSP boards. Sent whether or not anybody listens.",
    keys: &[
        key(
            "send_to",
            Kind::Text,
            Default("\"127.0.0.1:4991\""),
            "Where to; several addresses with commas between them, groups (multicast) among them.",
        ),
        ARRAYS,
        key(
            "samples",
            Kind::Choice(&["baseband", "passband"], &[]),
            Default("\"baseband\""),
            "I and Q at the receiver's rate, or what a converter of passband_rate_khz would have seen.",
        ),
        key(
            "passband_rate_khz",
            Kind::Number(from(1.0, 100_000.0)),
            Shown("1000.0"),
            "Above twice the highest frequency of the band. Only with samples = \"passband\".",
        ),
        key(
            "streams",
            Kind::Choice(&["elements", "vector"], &[]),
            Default("\"elements\""),
            "A stream for every element, or one whose samples are vectors of all.",
        ),
        key(
            "first_stream",
            Kind::Integer(0, 0xFFFF_0000),
            Default("1"),
            "Stream identifier of the first; the others count up.",
        ),
        key(
            "max_packet_bytes",
            Kind::Integer(64, 65_504),
            Default("1472"),
            "1472 fits an Ethernet frame.",
        ),
        key(
            "pace_mbit_per_s",
            Kind::Number(from(0.1, 100_000.0)),
            Default("400.0"),
            "Packets of a ping leave no faster than this, or boards lose them.",
        ),
        key(
            "multicast_interface",
            Kind::Text,
            Default("\"127.0.0.1\""),
            "Address of this computer from which groups are sent to.",
        ),
        key(
            "multicast_ttl",
            Kind::Integer(0, 255),
            Default("1"),
            "1 stays in the local network.",
        ),
    ],
    later: &[],
};

pub(super) static ELEMENTS: Table = Table {
    doc: "Element samples with little around them (protocols/README.md), over TCP to whoever connects and over UDP to fixed addresses.",
    keys: &[
        key(
            "listen",
            Kind::Text,
            Default("\"127.0.0.1:7172\""),
            "TCP. Only this computer by default: there is no password.",
        ),
        key(
            "send_to",
            Kind::Text,
            Optional("\"127.0.0.1:7173\""),
            "UDP; several addresses with commas between them. Left out: TCP only.",
        ),
        ARRAYS,
        key(
            "sample",
            Kind::Choice(&["i16", "f32"], &[]),
            Default("\"i16\""),
            "I and Q as counts, the receiver's full scale as 32767, or as volts.",
        ),
        key(
            "max_packet_bytes",
            Kind::Integer(128, 65_504),
            Default("1472"),
            "Of UDP; 1472 fits an Ethernet frame.",
        ),
        key(
            "pace_mbit_per_s",
            Kind::Number(from(0.1, 100_000.0)),
            Default("400.0"),
            "Datagrams leave no faster than this.",
        ),
        key(
            "client_queue_mib",
            Kind::Integer(1, 65_536),
            Default("64"),
            "What may wait for one slow client before its frames are dropped.",
        ),
        key("max_clients", Kind::Integer(1, 1000), Default("8"), ""),
    ],
    later: &[],
};

pub(crate) static SIGMF: Table = Table {
    doc: "SigMF: element samples with an annotation for every ping, in the folder of [record].",
    keys: &[ARRAYS],
    later: &[],
};

pub(super) static WAV: Table = Table {
    doc: "Multichannel WAV (RF64 above 4 GiB) of what the elements hear, for benches that play it out, in the folder of [record]. Silence between the pings.",
    keys: &[
        ARRAYS,
        key(
            "rate_khz",
            Kind::Number(from(1.0, 100_000.0)),
            Shown("1000.0"),
            "Rate of the bench's converters; above twice the highest frequency of the band. Left out: the lowest usual rate that is 2.5 times that frequency.",
        ),
        key(
            "sample",
            Kind::Choice(&["i16", "f32"], &[]),
            Default("\"i16\""),
            "",
        ),
    ],
    later: &[],
};

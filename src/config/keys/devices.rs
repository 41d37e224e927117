//! Outputs that imitate one maker's device.

use super::Presence::{Default, Optional, Required, Shown};
use super::{Key, Kind, Table, key};

const CLIENT_QUEUE: Key = key(
    "client_queue_mib",
    Kind::Integer(1, 65_536),
    Default("16"),
    "What may wait for one slow client before its records are dropped.",
);
const MAX_CLIENTS: Key = key("max_clients", Kind::Integer(1, 1000), Default("8"), "");

pub(super) static PING: Table = Table {
    doc: "The Ping protocol of Blue Robotics and Cerulean, over TCP and UDP on one port, and on a serial line.",
    keys: &[
        key(
            "device",
            Kind::Choice(&["omniscan450", "surveyor240"], &[]),
            Required("\"omniscan450\""),
            "A side-scan, which sends one line, or a multibeam, which sends the soundings of a fan with bottom_detection.",
        ),
        key(
            "side",
            Kind::Choice(&["port", "starboard"], &[]),
            Shown("\"port\""),
            "Whose line an omniscan450 sends.",
        ),
        key(
            "listen",
            Kind::Text,
            Default("\"127.0.0.1:51200\""),
            "Only this computer by default: the protocol knows no password.",
        ),
        key(
            "serial_port",
            Kind::Text,
            Optional("\"/dev/ttyUSB0\""),
            "A serial line besides.",
        ),
        key(
            "serial_baud",
            Kind::Integer(1200, 4_000_000),
            Default("115200"),
            "",
        ),
        key(
            "channel_number",
            Kind::Integer(0, 255),
            Default("0"),
            "Which of the synchronised devices an omniscan450 is.",
        ),
        key(
            "channels",
            Kind::Integer(1, 255),
            Default("1"),
            "How many they are.",
        ),
        CLIENT_QUEUE,
        MAX_CLIENTS,
    ],
    later: &[],
};

pub(super) static WBMS: Table = Table {
    doc: "NORBIT WBMS on four TCP ports in a row: text control, bathymetry, water column, side-scan or snippets.",
    keys: &[
        key(
            "listen",
            Kind::Text,
            Default("\"127.0.0.1:2209\""),
            "Of the control; the others are behind it. Only this computer by default: the protocol knows no password.",
        ),
        CLIENT_QUEUE,
        MAX_CLIENTS,
    ],
    later: &["xml", "georeferenced"],
};

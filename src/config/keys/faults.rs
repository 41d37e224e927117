//! The keys of `[[fault]]`.

use super::Presence::{Optional, Required};
use super::{Kind, Table, above, from, key};

const SECONDS: super::Range = from(0.0, 1.0e9);

pub(super) static FAULT: Table = Table {
    doc: "Something that goes wrong, and when; write the table again for another. Live: echotank ctl fault. Every injection is a line of faults-TIME.jsonl.",
    keys: &[
        key(
            "kind",
            Kind::Choice(
                &[
                    "dead",
                    "stuck",
                    "inverted",
                    "swapped",
                    "gain",
                    "phase",
                    "clipping",
                    "offset",
                    "noise-burst",
                    "mains-hum",
                    "adc-bit-stuck-high",
                    "adc-bit-stuck-low",
                    "crosstalk",
                    "clock-drift",
                    "sample-slip",
                    "drop",
                    "duplicate",
                    "reorder",
                    "corrupt",
                    "corrupt-mended",
                    "truncate",
                    "delay",
                    "link-down",
                    "trigger-missed",
                    "wrong-second",
                ],
                &["trigger-double", "pps-loss", "reset", "half-open"],
            ),
            Required("\"gain\""),
            "Of an element: dead, stuck (V), inverted, swapped, gain (dB), phase (degrees), clipping (V), offset (V), noise-burst (V rms), mains-hum (V rms), adc-bit-stuck-high and -low (bit), crosstalk (dB), clock-drift (ppm), sample-slip (samples). Of the line to the clients, record by record: drop, duplicate, reorder, corrupt, corrupt-mended (the checksum fits), truncate, delay (ms), link-down. Of time: trigger-missed, wrong-second (s).",
        ),
        key(
            "sonar",
            Kind::Name,
            Optional("\"main\""),
            "Left out: every one.",
        ),
        key(
            "array",
            Kind::Integer(0, 65_535),
            Optional("0"),
            "Which [[sonar.receive]], from 0; left out: every one. Only of elements.",
        ),
        key(
            "element",
            Kind::Integer(0, 65_535),
            Optional("3"),
            "From 0; left out: every one.",
        ),
        key(
            "other",
            Kind::Integer(0, 65_535),
            Optional("4"),
            "The second element of swapped; where crosstalk comes from.",
        ),
        key(
            "value",
            Kind::Number(from(-1.0e9, 1.0e9)),
            Optional("-6.0"),
            "In the unit of the kind.",
        ),
        key(
            "at_s",
            Kind::Number(SECONDS),
            Optional("60.0"),
            "After the first ping, in rig time; left out: 0.",
        ),
        key(
            "for_s",
            Kind::Number(above(0.0, 1.0e9)),
            Optional("10.0"),
            "Left out: for ever.",
        ),
        key(
            "ramp_s",
            Kind::Number(SECONDS),
            Optional("5.0"),
            "It grows to its full size in so long.",
        ),
        key(
            "probability",
            Kind::Number(from(0.0, 1.0)),
            Optional("0.1"),
            "Of striking, drawn for every ping (on the line: record); left out: 1.",
        ),
        key(
            "burst",
            Kind::Integer(1, 10_000),
            Optional("3"),
            "Pings in a row that a strike lasts; left out: 1.",
        ),
        key(
            "seed",
            Kind::Integer(0, super::MAX_INTEGER),
            Optional("1"),
            "Of the draws; left out: 0.",
        ),
    ],
    later: &[],
};

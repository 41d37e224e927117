//! The keys of `[[fault]]`.

use super::*;

const SECONDS: Range = from(0.0, 1.0e9);

table! {
    /// Something that goes wrong, and when; write the table again for another. Live: echotank ctl fault. Every injection is a line of
    /// faults-TIME.jsonl.
    Fault;

    /// Of an element: dead, stuck (V), inverted, swapped, gain (dB), phase (degrees), clipping (V), offset (V), noise-burst (V rms), mains-hum (V
    /// rms), adc-bit-stuck-high and -low (bit), crosstalk (dB), clock-drift (ppm), sample-slip (samples). Of the line to the clients, record by
    /// record (of VITA 49 and element streams: packet by packet): drop, duplicate, reorder, corrupt, corrupt-mended (the checksum fits, where
    /// there is one), truncate, delay (ms), jitter (up to so many ms, drawn for each), link-down. Of their TCP connections, at a ping: reset,
    /// half-open. Of navigation, sample by sample: nav-off, nav-stuck, nav-garbage, nav-wrong (m, m/s or degrees added), nav-slow (one in so
    /// many), nav-delayed (ms), nav-intermittent (ms off, ms on). Of the sentences that live sources say, before they are decoded: nav-checksum
    /// (it does not fit), nav-cut (in two lines), nav-noise (so many bytes before it). Of time: trigger-missed, trigger-double (ms later),
    /// wrong-second (s, of the records), pps-loss and wrong-zda (s) of nav.output.
    kind: Choice("dead", "stuck", "inverted", "swapped", "gain", "phase", "clipping", "offset", "noise-burst", "mains-hum", "adc-bit-stuck-high", "adc-bit-stuck-low", "crosstalk", "clock-drift", "sample-slip", "drop", "duplicate", "reorder", "corrupt", "corrupt-mended", "truncate", "delay", "jitter", "link-down", "reset", "half-open", "nav-off", "nav-stuck", "nav-garbage", "nav-wrong", "nav-slow", "nav-delayed", "nav-intermittent", "nav-checksum", "nav-cut", "nav-noise", "trigger-missed", "trigger-double", "wrong-second", "pps-loss", "wrong-zda"), Required("\"gain\"");

    /// Left out: every one.
    sonar: Name, Optional("\"main\"");

    /// Which [[sonar.receive]], from 0; left out: every one. Only of elements.
    array: Integer(0, 65_535), Optional("0");

    /// From 0; left out: every one.
    element: Integer(0, 65_535), Optional("3");

    /// The second element of swapped; where crosstalk comes from.
    other: Integer(0, 65_535), Optional("4");

    /// Which [[nav.source]]; left out: every one. Only of navigation.
    source: Name, Optional("\"gnss\"");

    /// What of it; left out: all it gives. Only of navigation.
    quantity: Choice("position", "course-speed", "heading", "roll-pitch", "heave", "depth"), Optional("\"heading\"");

    /// In the unit of the kind.
    value: Number(from(-1.0e9, 1.0e9)), Optional("-6.0");

    /// After the first ping, in rig time; left out: 0.
    at_s: Number(SECONDS), Optional("60.0");

    /// Left out: for ever.
    for_s: Number(above(0.0, 1.0e9)), Optional("10.0");

    /// It grows to its full size in so long.
    ramp_s: Number(SECONDS), Optional("5.0");

    /// Of striking, drawn for every ping (on the line: record); left out: 1.
    probability: Number(from(0.0, 1.0)), Optional("0.1");

    /// Pings in a row that a strike lasts; left out: 1.
    burst: Integer(1, 10_000), Optional("3");

    /// Of the draws; left out: 0.
    seed: Integer(0, MAX_INTEGER), Optional("1");
}

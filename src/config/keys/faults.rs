//! The keys of `[[fault]]`.

use super::*;

const SECONDS: Range = from(0.0, 1.0e9);

table! {
    /// A fault and its time; repeat the table for another. Live: echotank ctl fault. Every injection is a line of faults-TIME.jsonl.
    Fault;

    /// Elements: dead, stuck (V), inverted, swapped, gain (dB), phase (degrees), clipping (V), offset (V), noise-burst (V rms), mains-hum (V
    /// rms), adc-bit-stuck-high and -low (bit), crosstalk (dB), clock-drift (ppm), sample-slip (samples). Link to the clients, per record (VITA
    /// 49 and element streams: per packet): drop, duplicate, reorder, corrupt, corrupt-mended (with a valid checksum), truncate, delay (ms),
    /// jitter (random up to this many ms), link-down. TCP connections, per ping: reset, half-open. Navigation, per sample: nav-off, nav-stuck,
    /// nav-garbage, nav-wrong (m, m/s or degrees added), nav-slow (one in this many), nav-delayed (ms), nav-intermittent (ms off, ms on).
    /// Sentences of live sources, before decoding: nav-checksum (wrong), nav-cut (split into two lines), nav-noise (this many bytes before it).
    /// Time: trigger-missed, trigger-double (ms later), wrong-second (s, in the records), pps-loss and wrong-zda (s) of nav.output.
    kind: Choice("dead", "stuck", "inverted", "swapped", "gain", "phase", "clipping", "offset", "noise-burst", "mains-hum", "adc-bit-stuck-high", "adc-bit-stuck-low", "crosstalk", "clock-drift", "sample-slip", "drop", "duplicate", "reorder", "corrupt", "corrupt-mended", "truncate", "delay", "jitter", "link-down", "reset", "half-open", "nav-off", "nav-stuck", "nav-garbage", "nav-wrong", "nav-slow", "nav-delayed", "nav-intermittent", "nav-checksum", "nav-cut", "nav-noise", "trigger-missed", "trigger-double", "wrong-second", "pps-loss", "wrong-zda"), Required("\"gain\"");

    /// Default: every sonar.
    sonar: Name, Optional("\"main\"");

    /// Index of a [[sonar.receive]], from 0. Default: every array. Only for element faults.
    array: Integer(0, 65_535), Optional("0");

    /// From 0. Default: every element.
    element: Integer(0, 65_535), Optional("3");

    /// The second element of swapped; the source of crosstalk.
    other: Integer(0, 65_535), Optional("4");

    /// Name of a [[nav.source]]. Default: every source. Only for navigation faults.
    source: Name, Optional("\"gnss\"");

    /// Default: every quantity of the source. Only for navigation faults.
    quantity: Choice("position", "course-speed", "heading", "roll-pitch", "heave", "depth"), Optional("\"heading\"");

    /// Size of the fault, in the unit of its kind.
    value: Number(from(-1.0e9, 1.0e9)), Optional("-6.0");

    /// Start after the first ping, in rig time. Default: 0.
    at_s: Number(SECONDS), Optional("60.0");

    /// Duration. Default: unlimited.
    for_s: Number(above(0.0, 1.0e9)), Optional("10.0");

    /// Time in which the fault grows to its full size.
    ramp_s: Number(SECONDS), Optional("5.0");

    /// Probability of injection, drawn per ping (link: per record). Default: 1.
    probability: Number(from(0.0, 1.0)), Optional("0.1");

    /// Consecutive pings that one injection lasts. Default: 1.
    burst: Integer(1, 10_000), Optional("3");

    /// Seed of the random draws. Default: 0.
    seed: Integer(0, MAX_INTEGER), Optional("1");
}

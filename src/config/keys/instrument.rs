//! Imperfections of transducers and receiver: `[sonar.instrument]`.

use super::*;

const COUPLING_DB: Range = from(-200.0, 0.0);
const LEVEL_DB: Range = from(-300.0, 300.0);
const KHZ: Range = above(0.0, 10_000.0);
const Q: Range = from(0.5, 1000.0);

table! {
    /// Imperfections of transducers and receiver, and other sources in the samples. Each is absent unless its keys are given.
    Instrument;

    /// The pulse leaks from the transmitter into each receive element, with this level at the element relative to ping.source_level_db at 1 m. It
    /// arrives after the straight way from the transmitter.
    leakage_db: Number(from(-300.0, 60.0)), Optional("-70.0");

    /// Quality factor of the resonance that the leaked pulse passes. It rings with exp(-pi f t / Q).
    ring_down_q: Number(Q), Optional("20.0"), only with leakage_db;

    /// Frequency of that resonance. Default: that of the pulse.
    ring_down_khz: Khz(KHZ), Optional("200.0"), only with ring_down_q;

    /// Coupling of each element into its neighbours in the array, before noise and gain.
    crosstalk_elements_db: Number(COUPLING_DB), Optional("-40.0");

    /// Coupling between elements with the same index in different receive arrays, such as port and starboard.
    crosstalk_arrays_db: Number(COUPLING_DB), Optional("-50.0");

    /// Standard deviation of the gains of the elements. Each element keeps its gain.
    element_gain_db: Number(from(0.0, 20.0)), Optional("0.5");

    /// Standard deviation of the phases of the elements. Each element keeps its phase.
    element_phase_deg: Degrees(from(0.0, 180.0)), Optional("5.0");

    /// Seed of these gains and phases. Default: 1.
    element_seed: Integer(0, MAX_INTEGER), Optional("1");

    /// Measured gains and phases in place of random ones: lines of receive array, element (from 0), gain in dB, phase in degrees.
    element_file: File, Optional("\"data/elements.csv\"");

    /// Response of the transducers over frequency.
    response: Table(Response), Optional("");
    tone: Tables(Tone, 32), Optional("");
    second_sonar: Tables(SecondSonar, 16), Optional("");
}

table! {
    /// Response of transmitter and receive elements together: one resonance, or a file. Source level and sensitivity are those at a response of 0 dB.
    Response;

    /// Quality factor of one resonance.
    q: Number(Q), Optional("10.0");

    /// Frequency of the resonance. Default: that of the pulse.
    resonance_khz: Khz(KHZ), Optional("200.0"), only with q;

    /// Measured response: lines of frequency in kHz, level in dB, phase in degrees. Linear between the lines, constant beyond them.
    file: File, Optional("\"data/response.csv\"");
}

table! {
    /// A tone in all elements, such as mains or a switching supply; repeat the table for another. Its phase is continuous from ping to ping.
    Tone;
    frequency_khz: Khz(from(0.0, 100_000.0)), Required("150.0");

    /// dB re 1 V (rms), before the gain.
    level_db: Number(LEVEL_DB), Required("-80.0");

    /// At UTC 0.
    phase_deg: Degrees(ANGLE_DEG), Default("0.0");

    /// "input": before the receiver filter. "baseband": in I and Q alike, after mixer and filter. Frequencies beyond half the sample rate alias.
    entry: Choice("input", "baseband"), Default("\"input\"");
}

table! {
    /// Another sonar, far away; repeat the table for another. Its pulses arrive as plane waves, on its own clock.
    SecondSonar;
    kind: Choice("lfm", "cw"), Required("\"lfm\"");

    /// Only with kind = "lfm".
    sweep: Choice("up", "down"), Default("\"up\""), only with kind = "lfm";
    center_frequency_khz: Khz(from(0.01, 10_000.0)), Required("195.0");

    /// Width of the sweep. Only with kind = "lfm".
    bandwidth_khz: Khz(above(0.0, 10_000.0)), Shown("10.0"), needed with kind = "lfm";
    duration_ms: Ms(from(0.001, 200.0)), Required("1.0");

    /// Tukey taper: the share of the pulse under its two cosine flanks.
    taper: Number(from(0.0, 1.0)), Default("0.0");

    /// Time between its pulses, on its own clock.
    period_ms: Ms(from(1.0, 1.0e6)), Required("130.0");

    /// Arrival of a pulse at the reference point after UTC 0 (1970). The others precede and follow in periods.
    offset_ms: Ms(from(-1.0e6, 1.0e6)), Default("0.0");

    /// Error of its clock, parts per million: its periods last longer by it, and its frequency is lower.
    drift_ppm: Number(from(-1000.0, 1000.0)), Default("0.0");

    /// Direction in which it lies, clockwise from north.
    bearing_deg: Degrees(ANGLE_DEG), Required("90.0");

    /// Its direction below the horizon.
    depression_deg: Degrees(from(-90.0, 90.0)), Default("0.0");

    /// Level at this sonar, dB re 1 uPa (rms).
    level_db: Number(LEVEL_DB), Required("120.0");
}

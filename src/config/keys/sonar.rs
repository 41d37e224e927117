//! The keys of `[[sonar]]` and most of the tables below it.

use super::*;

const RANGE_M: Range = above(0.0, 20_000.0);
const RATE_HZ: Range = above(0.0, 1000.0);
const LEVEL_DB: Range = from(-100.0, 300.0);
const GAIN_DB: Range = from(-200.0, 200.0);
const PULSE_MS: Range = from(0.001, 10_000.0);
const SIDE_M: Range = from(0.0, 100.0);

table! {
    /// One sonar head; write the table again for another.
    Sonar, later "stabilisation";
    name: Name, Required("\"main\"");
    serial: Integer(0, MAX_INTEGER), Default("1");
    pulse: Table(Pulse), Required("");
    more_pulse: Tables(MorePulse), Optional("");
    transmit: Tables(Transmit), Required("");
    receive: Tables(Receive), Required("");
    receiver: Table(Receiver), Required("");
    ping: Table(Ping), Required("");
    limits: Table(Limits), Default("{}");
    trigger: Table(trigger::Trigger), Default("{}");
    trigger_out: Table(trigger::TriggerOut), Default("{}");
    model: Table(Model), Default("{}");
    beams: Table(Beams), Default("{}");
    picture: Table(Picture), Default("{}");
    output: Table(Output), Default("{}");
}

table! {
    /// sqrt(2) Re{ a(t) exp(j 2 pi f_c t) }, 0 <= t <= T. LFM: a = taper(t) exp(+-j pi (B/T) (t - T/2)^2), plus for an up sweep, so f_c is the
    /// frequency at mid-pulse. CW: a = taper(t).
    Pulse;
    kind: Choice("lfm", "cw"; later "samples"), Required("\"lfm\"");

    /// Only with kind = "lfm".
    sweep: Choice("up", "down"), Default("\"up\"");
    center_frequency_khz: Khz(from(0.01, 10_000.0)), Required("200.0");

    /// The whole sweep. Only with kind = "lfm".
    bandwidth_khz: Khz(above(0.0, 10_000.0)), Shown("20.0");
    duration_ms: Ms(PULSE_MS), Required("2.0");

    /// Tukey taper: the part of the pulse under its two cosine flanks together.
    taper: Number(from(0.0, 1.0)), Default("0.0");
}

table! {
    /// A pulse in the water together with the sonar's own, of the same kind, duration and taper; write the table again for another. Its echoes
    /// are in the same element samples; a matched filter of its own makes side-scan lines of them (more_lines in .npz, rows of their own in the
    /// picture, records 7000 and 7007 of their own, channels of XTF, subsystems of JSF). Two pulses a ping, the second half a period later, see
    /// the bottom at twice the density. With synthesis "direct", "gridded-1d" or "reference".
    MorePulse;

    /// Only up against down, or another band, tells pulses apart.
    sweep: Choice("up", "down"), Default("\"down\"");

    /// Left out: the pulse's own.
    center_frequency_khz: Khz(from(0.01, 10_000.0)), Optional("200.0");

    /// At most the pulse's own; left out: as wide.
    bandwidth_khz: Khz(above(0.0, 10_000.0)), Optional("20.0");

    /// After the sonar's own pulse.
    delay_ms: Ms(from(0.0, 10_000.0)), Default("0.0");

    /// The transmit array that sends it to all receive arrays; left out: each one's own.
    transmit: Name, Optional("\"tx\"");
}

table! {
    /// One transmit array, a single radiator. Angles: with all zero the array's x axis points forward and it looks straight down; roll_deg = -60
    /// looks to starboard and 30 degrees below the horizon, 60 to port; body_from_array = Rz(yaw) Ry(pitch) Rx(roll).
    Transmit;
    name: Name, Required("\"tx\"");

    /// Its centre: forward, starboard, down of the reference point.
    position_m: Vector(ARM_M), Default("[0.0, 0.0, 0.0]");
    roll_deg: Degrees(ANGLE_DEG), Default("0.0");
    pitch_deg: Degrees(ANGLE_DEG), Default("0.0");
    yaw_deg: Degrees(ANGLE_DEG), Default("0.0");

    /// "rectangle": a flat piston, sinc(L u_x/lambda) sinc(W u_y/lambda).
    pattern: Choice("omnidirectional", "rectangle"; later "circle", "table"), Default("\"omnidirectional\"");

    /// Along the array's x; 0: no directivity that way. Only with pattern = "rectangle".
    length_m: Number(SIDE_M), Default("0.0");

    /// Along the array's y. Only with pattern = "rectangle".
    width_m: Number(SIDE_M), Default("0.0");

    /// Nothing goes out of the back. Only with pattern = "rectangle".
    baffled: Bool, Default("true");

    /// Added to ping.source_level_db.
    level_offset_db: Number(GAIN_DB), Default("0.0");
}

table! {
    /// One receive array: equal elements in a line along the array's x axis, centred on position_m. Angles as for transmit; yaw_deg = 90 lays the
    /// line across the track with its +x end to starboard.
    Receive, later "element_errors", "dead_elements";
    name: Name, Required("\"rx\"");

    /// Whose pulse it listens to; may be left out where there is one transmit array.
    transmit: Name, Shown("\"tx\"");
    elements: Integer(1, 65_535), Required("32");

    /// Centre to centre. Needed for more than one element.
    spacing_m: Number(above(0.0, 100.0)), Shown("0.00375");
    position_m: Vector(ARM_M), Default("[0.0, 0.0, 0.0]");
    roll_deg: Degrees(ANGLE_DEG), Default("0.0");
    pitch_deg: Degrees(ANGLE_DEG), Default("0.0");
    yaw_deg: Degrees(ANGLE_DEG), Set("0.0", "90.0");
    element_pattern: Choice("omnidirectional", "rectangle"; later "circle", "table"), Default("\"omnidirectional\"");

    /// Along the line, at most the spacing. Only with element_pattern = "rectangle".
    element_length_m: Number(SIDE_M), Default("0.0");

    /// Across the line. Only with element_pattern = "rectangle".
    element_width_m: Number(SIDE_M), Default("0.0");

    /// Nothing is heard through the back. Only with element_pattern = "rectangle".
    baffled: Bool, Default("true");

    /// dB re 1 V/uPa; 0 makes volts of micropascals.
    sensitivity_db: Number(from(-400.0, 200.0)), Default("-190.0");
}

table! {
    /// From the elements' volts to samples: complex envelopes about the centre frequency.
    Receiver, later "passband";

    /// At least 1.25 (max(B, 4/T) + 2 f_d), f_d the Doppler shift at 10 m/s.
    sample_rate_khz: Khz(from(0.001, 100_000.0)), Required("40.0");

    /// "fir": a linear-phase low-pass ahead of the sampling, its delay removed.
    rx_filter: Choice("none", "fir"), Set("\"none\"", "\"fir\"");

    /// Time-varying gain: N log10 r + 2 alpha r, held between 0 and tvg_max_db, or a table [[range_m, db], ...].
    tvg: ChoiceOrRows("none", "20logr", "30logr", "40logr"), Default("\"none\"");

    /// Only with one of the laws.
    tvg_max_db: Number(from(0.0, 300.0)), Default("120.0");

    /// At the elements, dB re 1 uPa^2/Hz. Left out: no noise.
    noise_db: Number(from(-200.0, 250.0)), Optional("45.0");

    /// Left out: not quantised.
    adc_bits: Integer(2, 32), Optional("16");

    /// Volts (rms of the envelope) that fill the converter and the wire's integers.
    full_scale_v: Number(above(0.0, 1.0e12)), Default("1.0");

    /// Same seed, same noise.
    seed: Integer(0, MAX_INTEGER), Default("1");
}

table! {
    /// The settings at the start; a topside may change them within the limits.
    Ping;
    range_m: Number(RANGE_M), Required("100.0");

    /// Or period_ms; a range too long for it lowers the rate.
    rate_hz: Number(RATE_HZ), Shown("5.0");

    /// In place of rate_hz.
    period_ms: Ms(above(0.0, 1.0e6)), Optional("200.0");

    /// dB re 1 uPa at 1 m, rms.
    source_level_db: Number(LEVEL_DB), Required("210.0");
    gain_db: Number(GAIN_DB), Default("0.0");
}

table! {
    /// [lowest, highest] of each setting; buffers are sized from them. Left out: the setting cannot be changed.
    Limits;
    range_m: Pair(RANGE_M), Optional("[10.0, 150.0]");
    ping_rate_hz: Pair(RATE_HZ), Optional("[0.1, 20.0]");
    source_level_db: Pair(LEVEL_DB), Optional("[170.0, 220.0]");
    gain_db: Pair(GAIN_DB), Optional("[0.0, 80.0]");
    pulse_duration_ms: PairMs(PULSE_MS), Optional("[1.0, 5.0]");
}

table! {
    /// How the echoes are computed.
    Model, later "simd", "incidence";

    /// How the platform moves between pulse and echo: not, on straight pieces, each element on straight pieces of its own, or as it does. "auto"
    /// (here, of doppler and of synthesis): the cheapest that keeps the tolerance with this sonar, scene and motion; `check` says what and why.
    path: Choice("stop-and-hop", "polyline", "k-segment", "continuous", "auto"), Default("\"polyline\"");

    /// "stretch-quadratic" also follows the change of the stretch during the pulse; "paper-eq21" is Eq. 21 of Meng et al. 2023 as printed, for
    /// comparison.
    doppler: Choice("none", "stretch", "stretch-quadratic", "paper-eq21", "auto"; later "common", "rank-r"), Default("\"stretch\"");

    /// "reference" solves the travel time of every sample on the continuous motion (slow, trusted; path and doppler are then not used); "direct"
    /// sums linearised echoes; "gridded-1d" does within tolerance, faster, with any doppler but "paper-eq21"; "gridded-2d" for line arrays of
    /// many elements, with the receiver filter, and any doppler but "paper-eq21". For comparison, with doppler "none" or "paper-eq21": "spectral"
    /// (the paper's sum by frequency), "nearest" and "linear" (a sampled pulse laid down). Left out: "gridded-1d" where it takes the doppler and
    /// the receiver has its filter, else "direct".
    synthesis: Choice("reference", "direct", "gridded-1d", "gridded-2d", "spectral", "nearest", "linear", "auto"; later "gridded"), Shown("\"gridded-1d\"");

    /// Relative error of element samples, before noise and converter, in any stretch of them as long as the pulse: what the "gridded" ones are
    /// made for, and what an error check is held to.
    tolerance: Number(from(1e-8, 1e-1)), Default("1e-3");

    /// Of what is "auto", where pictures are all that is looked at: path and doppler may displace things by so many cells of range, and by 2.5
    /// times as many along the track, whatever the samples are off by. Left out: samples count.
    tolerance_image: Number(from(1e-6, 10.0)), Optional("0.1");

    /// What pings are made of. "beams": lines alone, each from parts of its array, several elements made as one, as coarse as the tolerance
    /// bears; only where nobody sees elements. "auto": so where it may be and is cheaper; `check` says what and why.
    output: Choice("elements", "beams", "auto"), Default("\"elements\"");

    /// The nearest scatterer for which "gridded-2d" is made; pings with nearer ones are counted. Left out: 5.
    nearest_m: Number(above(0.0, 20_000.0)), Optional("5.0");

    /// Of "spectral". Left out: one over the record, or finer. Coarser, and late echoes wrap around onto early ones.
    frequency_step_hz: Number(from(0.01, 1e6)), Optional("5.0");

    /// Whether random samples are recomputed through the reference and the error found is printed. Above 1.3 times tolerance on two pings running
    /// it is a fault.
    error_check: Bool, Default("false");

    /// Longest piece of the polyline.
    segment_ms: Ms(from(0.1, 60_000.0)), Default("50.0");

    /// Scatterers whose two-way pattern lies below are left out; for targets and points it lies lower by as much as they are stronger than the
    /// ground's. Left out: with synthesis = "gridded-1d" or "gridded-2d" over a seabed and without scene.points, the highest that costs half the
    /// tolerance on flat ground; otherwise all are kept.
    cull_db: Number(from(-300.0, -1.0)), Optional("-60.0");
}

table! {
    /// What is made of the elements: side-scan lines and a fan of beams.
    Beams;

    /// The receive array of the port side-scan line.
    port: Name, Optional("\"rx-port\"");

    /// The receive array of the starboard side-scan line.
    starboard: Name, Optional("\"rx-starboard\"");

    /// "aperture": the plain sum of the elements. "dynamic-focus": refocused along range, with the receiver's motion.
    line_former: Choice("aperture", "dynamic-focus"), Default("\"aperture\"");

    /// Dynamic aperture: the length in use is range / line_f_number, at most the whole line. Left out: the whole line everywhere. Only with
    /// line_former = "dynamic-focus".
    line_f_number: Number(above(0.0, 10_000.0)), Optional("50.0");

    /// Along the line. Only with line_former = "dynamic-focus".
    line_shading: Choice("uniform", "hann", "taylor", "chebyshev"), Default("\"uniform\"");

    /// Of "taylor" and "chebyshev", below the main lobe.
    line_side_lobe_db: Number(from(15.0, 80.0)), Default("30.0");

    /// Along the pulse, of every matched filter: lower side lobes of the compressed pulse, wider peak.
    weighting: Choice("none", "hann", "hamming", "taylor", "kaiser"), Default("\"none\"");

    /// Of "taylor", below the peak.
    weighting_side_lobe_db: Number(from(15.0, 80.0)), Default("35.0");

    /// Of "kaiser".
    weighting_beta: Number(from(0.0, 20.0)), Default("6.0");
    fan: Table(Fan), Shown("");
    synthetic_aperture: Table(SyntheticAperture), Optional("");
}

table! {
    /// A patch of the world that all pings of a replay are back-projected on, by their navigation: echotank replay --formats sas writes it as
    /// picture, NumPy array and numbers. Leave the table out for none.
    SyntheticAperture;

    /// Receive arrays; each of their elements adds a row per ping.
    arrays: Names, Required("[\"rx\"]");

    /// Southern and northern edge.
    north_m: Pair(METRES), Required("[-5.0, 5.0]");

    /// Western and eastern edge.
    east_m: Pair(METRES), Required("[30.0, 40.0]");

    /// The depth of all its points.
    down_m: Number(METRES), Required("20.0");

    /// Side of a pixel; below half the resolution.
    cell_m: Number(above(0.0, 100.0)), Default("0.02");
}

table! {
    /// How the pictures of `echotank replay --formats png,fan,masks,mosaic` look. Records and pings.npz do not depend on it.
    Picture;

    /// Columns of the waterfall. "ground": over a flat bottom as deep as the seabed under the sonar (the truth); "ground-first-return": as far
    /// away as the line's own first echo of the bottom.
    range: Choice("slant", "ground", "ground-first-return"), Default("\"slant\"");

    /// "received": as the receiver's time-varying gain left it. "raw": that gain taken out again.
    gain: Choice("received", "raw"), Default("\"received\"");

    /// Of waterfall and mosaic; fans are blue.
    colours: Choice("copper", "grey", "blue", "rainbow"), Default("\"copper\"");

    /// Darkest and brightest: shares of the picture's own pixels, or levels.
    contrast: Choice("percentiles", "fixed"), Default("\"percentiles\"");

    /// Of "percentiles": of the pixels are darkest (of a mosaic at most 2, since it has no water column).
    low_percent: Percent(from(0.0, 100.0)), Default("28.0");

    /// Of "percentiles": of the pixels are not brightest.
    high_percent: Percent(from(0.0, 100.0)), Default("99.997");

    /// Of "fixed", dB re 1 V.
    low_db: Number(from(-400.0, 400.0)), Default("-80.0");

    /// Of "fixed", dB re 1 V.
    high_db: Number(from(-400.0, 400.0)), Default("0.0");

    /// The mean level at each range is taken out.
    flatten: Bool, Default("false");

    /// Across the waterfall. Left out: 600 pixels to a side.
    m_per_pixel: Number(above(0.0, 1000.0)), Optional("0.1");

    /// A picture of the fan for the first ping and then every so many.
    fan_every_pings: Integer(1, 1_000_000), Default("100");
    mosaic_m_per_pixel: Number(from(0.01, 1000.0)), Default("0.25");

    /// What a pixel of the mosaic keeps of several passes.
    overlap: Choice("nearest", "mean", "last"), Default("\"nearest\"");

    /// Directions nearer to the vertical are left out of the mosaic.
    nadir_deg: Degrees(from(0.0, 89.0)), Default("0.0");
}

table! {
    /// Beams of one array: across the track, beam 0 port-most; or, of an array that lies fore and aft (multibeam side-scan), beam 0 aft-most.
    /// Leave the table out for none.
    Fan;

    /// A receive array whose +x end points to starboard or forward.
    array: Name, Required("\"rx\"");
    beams: Integer(1, 4096), Required("64");

    /// From the first beam to the last.
    sector_deg: Degrees(above(0.0, 180.0)), Required("120.0");

    /// Middle of the sector, from the boresight.
    center_deg: Degrees(from(-90.0, 90.0)), Default("0.0");

    /// Equal steps of angle, of distance on a flat bottom, or of sine.
    spacing: Choice("equi-angle", "equi-distant", "equi-sine"), Default("\"equi-angle\"");

    /// Angles from the vertical: the beams are steered against the roll.
    roll_stabilised: Bool, Default("false");
    shading: Choice("uniform", "hann", "taylor", "chebyshev"), Default("\"uniform\"");

    /// Of "taylor" and "chebyshev", below the main lobe.
    shading_side_lobe_db: Number(from(15.0, 80.0)), Default("30.0");

    /// Far field in f64 at every frequency; the same by fast transforms in f32 (the fastest for a line of many elements); far field with time
    /// delays or with phases, or focused along range with the receiver's motion, in f32.
    former: Choice("exact", "fft", "conventional", "phase", "dynamic-focus"), Default("\"exact\"");

    /// A sounding for each beam, from amplitude or from the phase between the two halves of the line.
    bottom_detection: Bool, Default("false");

    /// The aperture in use is range / f_number, at most the whole line. Left out: the whole line everywhere. Only with former = "dynamic-focus".
    f_number: Number(above(0.0, 10_000.0)), Optional("50.0");

    /// Carrier phase that a focus may err by at the ends of its zone of ranges. Only with former = "dynamic-focus".
    focus_error_deg: Degrees(from(0.1, 90.0)), Default("5.0");
}

table! {
    /// The protocols this sonar speaks; one table for each.
    Output, later "kmall", "r2sonic";
    sevenk: Table(Sevenk), Shown("");
    jsf: Table(families::Jsf), Optional("");
    xtf: Table(families::Xtf), Optional("");
    imagenex872: Table(families::Imagenex872), Optional("");
    ping: Table(devices::Ping), Optional("");
    wbms: Table(devices::Wbms), Optional("");
    vita49: Table(samples::Vita49), Optional("");
    elements: Table(samples::Elements), Optional("");
    sigmf: Table(samples::Sigmf), Optional("");
    wav: Table(samples::Wav), Optional("");
}

table! {
    /// Teledyne RESON 7k over TCP and UDP.
    Sevenk;

    /// 7k device id: 7125 SeaBat 7125, 103 a multibeam, 104 a side-scan.
    id: Integer(1, u32::MAX as i64), Required("7125");

    /// Tells heads with one device id apart.
    enumerator: Integer(0, u16::MAX as i64), Default("0");

    /// Receive arrays whose elements fill record 7038, in this order. Left out: all.
    arrays: Names, Shown("[\"rx\"]");

    /// Only this computer by default: the protocol knows no password.
    listen: Text, Default("\"127.0.0.1:7000\"");

    /// Longer records go out in several packets of this length.
    max_packet_bytes: Integer(1024, 1 << 30), Default("60000");

    /// What may wait for one slow client before its records are dropped.
    client_queue_mib: Mib(1, 65_536), Default("64");

    /// What becomes of a client whose queue is full: it misses whole records, or is disconnected.
    when_full: Choice("skip", "disconnect"), Default("\"skip\"");
    max_clients: Integer(1, 1000), Default("8");
}

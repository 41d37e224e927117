//! The keys of `[[sonar]]` and most of the tables below it.

use super::*;

const RANGE_M: Range = above(0.0, 20_000.0);
const RATE_HZ: Range = above(0.0, 1000.0);
const LEVEL_DB: Range = from(-100.0, 300.0);
const GAIN_DB: Range = from(-200.0, 200.0);
const PULSE_MS: Range = from(0.001, 10_000.0);
const SIDE_M: Range = from(0.0, 100.0);

table! {
    /// One sonar head; repeat the table for another.
    Sonar, later "stabilisation";
    name: Name, Required("\"main\"");
    serial: Integer(0, MAX_INTEGER), Default("1");
    pulse: Table(Pulse), Required("");
    more_pulse: Tables(MorePulse, 32), Optional("");
    transmit: Tables(Transmit, 32), Required("");
    receive: Tables(Receive, 256), Required("");
    receiver: Table(Receiver), Required("");
    instrument: Table(instrument::Instrument), Optional("");
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
    sweep: Choice("up", "down"), Default("\"up\""), only with kind = "lfm";
    center_frequency_khz: Khz(from(0.01, 10_000.0)), Required("200.0");

    /// Width of the sweep. Only with kind = "lfm".
    bandwidth_khz: Khz(above(0.0, 10_000.0)), Shown("20.0"), needed with kind = "lfm";
    duration_ms: Ms(PULSE_MS), Required("2.0");

    /// Tukey taper: the share of the pulse under its two cosine flanks.
    taper: Number(from(0.0, 1.0)), Default("0.0");
}

table! {
    /// A further pulse in the same ping, of the same kind, duration and taper; repeat the table for another. Its echoes are in the same element
    /// samples. Its own matched filter gives further side-scan lines: more_lines in .npz, further rows in the picture, records 7000 and 7007,
    /// channels of XTF, subsystems of JSF. A second pulse half a period later doubles the density along the track. With synthesis "direct",
    /// "gridded-1d" or "reference".
    MorePulse;

    /// The pulses must differ in sweep direction or band, or they cannot be separated.
    sweep: Choice("up", "down"), Default("\"down\"");

    /// Default: that of the pulse.
    center_frequency_khz: Khz(from(0.01, 10_000.0)), Optional("200.0");

    /// At most that of the pulse. Default: the same.
    bandwidth_khz: Khz(above(0.0, 10_000.0)), Optional("20.0");

    /// Delay after the sonar's own pulse.
    delay_ms: Ms(from(0.0, 10_000.0)), Default("0.0");

    /// The transmit array that insonifies for all receive arrays. Default: the one of each receive array.
    transmit: Name, Optional("\"tx\"");
}

table! {
    /// One transmit array, a single radiator. With all angles zero, its x axis points forward and it looks straight down. roll_deg = -60 looks to
    /// starboard and 30 degrees below the horizon, 60 to port. The rotation is body_from_array = Rz(yaw) Ry(pitch) Rx(roll).
    Transmit;
    name: Name, Required("\"tx\"");

    /// Centre: forward, starboard, down of the reference point.
    position_m: Vector(ARM_M), Default("[0.0, 0.0, 0.0]");
    roll_deg: Degrees(ANGLE_DEG), Default("0.0");
    pitch_deg: Degrees(ANGLE_DEG), Default("0.0");
    yaw_deg: Degrees(ANGLE_DEG), Default("0.0");

    /// "rectangle": a flat piston, sinc(L u_x/lambda) sinc(W u_y/lambda). "auto": a rectangle if length_m or width_m is given, else
    /// omnidirectional.
    pattern: Choice("auto", "omnidirectional", "rectangle"; later "circle", "table"), Default("\"auto\"");

    /// Along the array's x. 0: no directivity in that direction.
    length_m: Number(SIDE_M), Default("0.0"), only with pattern = "auto" or "rectangle";

    /// Along the array's y.
    width_m: Number(SIDE_M), Default("0.0"), only with pattern = "auto" or "rectangle";

    /// No transmission to the back.
    baffled: Bool, Default("true"), only with pattern = "auto" or "rectangle";

    /// Added to ping.source_level_db.
    level_offset_db: Number(GAIN_DB), Default("0.0");
}

table! {
    /// One receive array: equal elements in a line along its x axis, or on an arc, centred on position_m. Angles are as for transmit. yaw_deg = 90 lays
    /// the line across the track, with its +x end to starboard.
    Receive, later "element_errors", "dead_elements";
    name: Name, Required("\"rx\"");

    /// The transmit array whose echoes it receives. May be left out if there is only one.
    transmit: Name, Shown("\"tx\"");
    elements: Integer(1, 65_535), Required("32");

    /// Centre to centre. Needed for more than one element.
    spacing_m: Number(above(0.0, 100.0)), Shown("0.00375");

    /// Radius of an arc that bulges towards the boresight; each element looks along its own normal. spacing_m counts along the arc, of half a circle at
    /// most. Default: a straight line.
    radius_m: Number(above(0.0, 100.0)), Optional("0.21");
    position_m: Vector(ARM_M), Default("[0.0, 0.0, 0.0]");
    roll_deg: Degrees(ANGLE_DEG), Default("0.0");
    pitch_deg: Degrees(ANGLE_DEG), Default("0.0");
    yaw_deg: Degrees(ANGLE_DEG), Set("0.0", "90.0");

    /// "rectangle": as for transmit. "auto": a rectangle if element_length_m or element_width_m is given; otherwise elements of a line are as long as
    /// their spacing, and a single element is omnidirectional.
    element_pattern: Choice("auto", "omnidirectional", "rectangle"; later "circle", "table"), Default("\"auto\"");

    /// Along the line, at most the spacing.
    element_length_m: Number(SIDE_M), Default("0.0"), only with element_pattern = "auto" or "rectangle";

    /// Across the line.
    element_width_m: Number(SIDE_M), Default("0.0"), only with element_pattern = "auto" or "rectangle";

    /// No reception from the back. Elements on an arc have none: leave the key out there, or set it to false.
    baffled: Bool, Default("true"), only with element_pattern = "auto" or "rectangle";

    /// dB re 1 V/uPa. With 0 the volts are micropascals.
    sensitivity_db: Number(from(-400.0, 200.0)), Default("-190.0");
}

table! {
    /// From element voltages to samples: complex envelopes about the centre frequency.
    Receiver, later "passband";

    /// At least 1.25 (max(B, 4/T) + 2 f_d), f_d the Doppler shift at 10 m/s.
    sample_rate_khz: Khz(from(0.001, 100_000.0)), Required("40.0");

    /// "fir": a linear-phase low-pass before sampling, with its delay removed.
    rx_filter: Choice("none", "fir"), Default("\"fir\"");

    /// Time-varying gain: N log10 r + 2 alpha r, limited to 0 to tvg_max_db, or a table [[range_m, db], ...].
    tvg: ChoiceOrRows("none", "20logr", "30logr", "40logr"), Default("\"none\"");

    /// Only with one of the "logr" laws.
    tvg_max_db: Number(from(0.0, 300.0)), Default("120.0");

    /// Noise at the elements, dB re 1 uPa^2/Hz, as of omnidirectional ones. "ambient": thermal noise, and that of the surface at medium.wind_m_per_s, at
    /// the centre frequency (Coates 1990).
    noise_db: ChoiceOrNumber(from(-200.0, 250.0), "ambient", "none"), Default("\"ambient\"");

    /// Default: no quantisation.
    adc_bits: Integer(2, 32), Optional("16");

    /// Full scale of the converter and of the integers in the records, in volts (rms of the envelope).
    full_scale_v: Number(above(0.0, 1.0e12)), Default("1.0");

    /// The same seed gives the same noise.
    seed: Integer(0, MAX_INTEGER), Default("1");
}

table! {
    /// The settings at the start; a topside may change them within the limits.
    Ping;
    range_m: Number(RANGE_M), Required("100.0");

    /// Or period_ms. The rate is lowered if the range is too long for it.
    rate_hz: Number(RATE_HZ), Shown("5.0");

    /// In place of rate_hz.
    period_ms: Ms(above(0.0, 1.0e6)), Optional("200.0");

    /// dB re 1 uPa at 1 m, rms.
    source_level_db: Number(LEVEL_DB), Required("210.0");
    gain_db: Number(GAIN_DB), Default("0.0");
}

table! {
    /// [lowest, highest] of each setting. Buffers are sized from them. Default: the setting cannot be changed.
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

    /// Motion of the platform between pulse and echo. "stop-and-hop": none. "polyline": straight segments. "k-segment": straight chords of each
    /// element's track. "continuous": the exact motion. "auto" (here, for doppler and for synthesis): the cheapest method that keeps the tolerance
    /// for this sonar, scene and motion; `check` reports the choice.
    path: Choice("stop-and-hop", "polyline", "k-segment", "continuous", "auto"), Default("\"auto\"");

    /// "stretch": time scaling of the pulse. "stretch-quadratic": also the change of the scaling during the pulse. "paper-eq21": Eq. 21 of Meng
    /// et al. 2023 as printed, for comparison.
    doppler: Choice("none", "stretch", "stretch-quadratic", "paper-eq21", "auto"; later "common", "rank-r"), Default("\"auto\"");

    /// "reference": solves the travel time of every sample on the continuous motion (slow; ignores path and doppler). "direct": sums linearised
    /// echoes. "gridded-1d": the same within tolerance, faster. "gridded-lines": for line arrays and short pulses, with tolerances from 3e-4 on.
    /// "gridded-2d": for line arrays, long pulses and many scatterers. Both need the receiver filter. The three take any doppler but
    /// "paper-eq21". For comparison, with doppler "none" or "paper-eq21": "spectral" (the sum over frequency of Meng et al. 2023), "nearest" and
    /// "linear" (a sampled pulse is added).
    synthesis: Choice("reference", "direct", "gridded-1d", "gridded-lines", "gridded-2d", "spectral", "nearest", "linear", "auto"; later "gridded"), Default("\"auto\"");

    /// Relative error of element samples, before noise and quantisation, in any window of one pulse length. The gridded methods are designed for
    /// it, and the error check tests it.
    tolerance: Number(from(1e-8, 1e-1)), Default("1e-3");

    /// Tolerance of the "auto" choices if only pictures are used. path and doppler may displace echoes by this many range cells in range, and by 2.5
    /// times as many along the track. Default: the sample tolerance applies.
    tolerance_image: Number(from(1e-6, 10.0)), Optional("0.1");

    /// "elements": element samples. "beams": only side-scan lines, if no output needs elements. Each line is computed from groups of elements, as
    /// coarse as the tolerance allows. "auto": "beams" where possible and cheaper; `check` reports the choice.
    output: Choice("elements", "beams", "auto"), Default("\"elements\"");

    /// Range of the nearest scatterer that "gridded-2d" is designed for. Pings with nearer scatterers are counted. Default: 5.
    nearest_m: Number(above(0.0, 20_000.0)), Optional("5.0"), only with synthesis = "gridded-2d";

    /// Frequency step of "spectral". Default: one over the record length, or finer. With a coarser step late echoes wrap around onto early ones.
    frequency_step_hz: Number(from(0.01, 1e6)), Optional("5.0"), only with synthesis = "spectral";

    /// Recompute windows of a ping with the reference and print the error, for 1 % of its predicted cost. Errors above 1.3 times the tolerance on two checked pings running
    /// are a fault. Default: true, but false with synthesis = "reference" and with run.stream_tiles.
    error_check: Bool, Optional("true");

    /// Longest segment of "polyline" and "k-segment". Default: 50 ms, and with path = "auto" the longest that keeps the tolerance.
    segment_ms: Ms(from(0.1, 60_000.0)), Optional("50.0");

    /// Scatterers whose two-way pattern is below this level are left out. For targets and points the level is lower by their excess strength over the
    /// seabed. Default: with a gridded synthesis, a seabed and no scene.points, every ping has its own levels by range, with which culling leaves out at
    /// most two fifths of the tolerance in every window of a pulse length; otherwise all scatterers are kept.
    cull_db: Number(from(-300.0, -1.0)), Optional("-60.0");
}

table! {
    /// Beamforming: side-scan lines and a fan of beams.
    Beams;

    /// The receive array of the port side-scan line.
    port: Name, Optional("\"rx-port\"");

    /// The receive array of the starboard side-scan line.
    starboard: Name, Optional("\"rx-starboard\"");

    /// "aperture": the plain sum of the elements. "dynamic-focus": refocused along range, with the receiver's motion.
    line_former: Choice("aperture", "dynamic-focus"), Default("\"aperture\"");

    /// Dynamic aperture: range / line_f_number, at most the whole array. Default: the whole array. Only with line_former = "dynamic-focus".
    line_f_number: Number(above(0.0, 10_000.0)), Optional("50.0"), only with line_former = "dynamic-focus";

    /// Shading along the array. Only with line_former = "dynamic-focus".
    line_shading: Choice("uniform", "hann", "taylor", "chebyshev"), Default("\"uniform\""), only with line_former = "dynamic-focus";

    /// Side-lobe level of "taylor" and "chebyshev", below the main lobe.
    line_side_lobe_db: Number(from(15.0, 80.0)), Default("30.0");

    /// Window of every matched filter along the pulse: lower range side lobes, wider peak.
    weighting: Choice("none", "hann", "hamming", "taylor", "kaiser"), Default("\"none\"");

    /// Side-lobe level of "taylor", below the peak.
    weighting_side_lobe_db: Number(from(15.0, 80.0)), Default("35.0");

    /// Parameter of "kaiser".
    weighting_beta: Number(from(0.0, 20.0)), Default("6.0");
    fan: Table(Fan), Shown("");
    synthetic_aperture: Table(SyntheticAperture), Optional("");
}

table! {
    /// A horizontal area onto which a replay back-projects all pings with their navigation. echotank replay --formats sas writes a picture, a NumPy
    /// array and a file of numbers. Leave the table out for none.
    SyntheticAperture;

    /// Receive arrays; each of their elements adds a row per ping.
    arrays: Names, Required("[\"rx\"]");

    /// Southern and northern edge.
    north_m: Pair(METRES), Required("[-5.0, 5.0]");

    /// Western and eastern edge.
    east_m: Pair(METRES), Required("[30.0, 40.0]");

    /// Depth of all pixels.
    down_m: Number(METRES), Required("20.0");

    /// Pixel size; below half the resolution.
    cell_m: Number(above(0.0, 100.0)), Default("0.02");
}

table! {
    /// How the pictures of `echotank replay --formats png,fan,masks,mosaic` look. Records and pings.npz do not depend on it.
    Picture;

    /// Across-track axis of the waterfall. "ground": with a flat bottom at the true depth under the sonar. "ground-first-return": at the range of
    /// the line's first bottom echo.
    range: Choice("slant", "ground", "ground-first-return"), Default("\"slant\"");

    /// "received": with the receiver's time-varying gain. "raw": with that gain removed.
    gain: Choice("received", "raw"), Default("\"received\"");

    /// Colour map of waterfall and mosaic; fans are blue.
    colours: Choice("copper", "grey", "blue", "rainbow"), Default("\"copper\"");

    /// Limits of the grey scale: percentiles of the picture's pixels, or fixed levels.
    contrast: Choice("percentiles", "fixed"), Default("\"percentiles\"");

    /// Percentage of the pixels that are shown darkest; at most 2 in a mosaic, which has no water column. Only used with "percentiles".
    low_percent: Percent(from(0.0, 100.0)), Default("28.0");

    /// Percentage of the pixels that are not shown brightest. Only used with "percentiles".
    high_percent: Percent(from(0.0, 100.0)), Default("99.997");

    /// Level of the darkest colour, dB re 1 V. Only used with "fixed".
    low_db: Number(from(-400.0, 400.0)), Default("-80.0");

    /// Level of the brightest colour, dB re 1 V. Only used with "fixed".
    high_db: Number(from(-400.0, 400.0)), Default("0.0");

    /// Remove the mean level at each range.
    flatten: Bool, Default("false");

    /// Pixel size across the waterfall. Default: 600 pixels per side.
    m_per_pixel: Number(above(0.0, 1000.0)), Optional("0.1");

    /// Interval between pictures of the fan, from the first ping on.
    fan_every_pings: Integer(1, 1_000_000), Default("100");
    mosaic_m_per_pixel: Number(from(0.01, 1000.0)), Default("0.25");

    /// Value of a mosaic pixel that several passes cover.
    overlap: Choice("nearest", "mean", "last"), Default("\"nearest\"");

    /// Directions closer to the vertical are left out of the mosaic.
    nadir_deg: Degrees(from(0.0, 89.0)), Default("0.0");
}

table! {
    /// Beams of one array. Across the track: beam 0 is port-most. Along the track (multibeam side-scan): beam 0 is aft-most. Leave the table out
    /// for none.
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

    /// Beam angles count from the vertical; the beams are steered against the roll.
    roll_stabilised: Bool, Default("false");
    shading: Choice("uniform", "hann", "taylor", "chebyshev"), Default("\"uniform\"");

    /// Side-lobe level of "taylor" and "chebyshev", below the main lobe.
    shading_side_lobe_db: Number(from(15.0, 80.0)), Default("30.0");

    /// "exact": far field in f64 at every frequency. "fft": the same with FFTs in f32, fastest for many elements. "conventional": far field with
    /// time delays, f32. "phase": far field with phases, f32. "dynamic-focus": focused along range with the receiver's motion, f32.
    /// An arc needs one of the last three.
    former: Choice("exact", "fft", "conventional", "phase", "dynamic-focus"), Default("\"exact\"");

    /// Each beam uses the elements whose normals lie within half of this of its direction; shading is along them. Only with an arc (radius_m).
    aperture_deg: Degrees(from(1.0, 180.0)), Default("80.0");

    /// A sounding for each beam, from amplitude or from the phase between the two halves of the line.
    bottom_detection: Bool, Default("false");

    /// Dynamic aperture: range / f_number, at most the whole array. Default: the whole array. Only with former = "dynamic-focus".
    f_number: Number(above(0.0, 10_000.0)), Optional("50.0"), only with former = "dynamic-focus";

    /// Maximum carrier phase error at the ends of a focal zone. In fans of many elements and beams the focus moves from sample to sample wherever it would be exceeded. Only with former = "dynamic-focus".
    focus_error_deg: Degrees(from(0.1, 90.0)), Default("5.0"), only with former = "dynamic-focus";

    /// Nearest range of the focus, 0.75 times the array's length at least. Nearer samples are summed with the focus there. The focus of a long array changes fastest at the nearest ranges, where it takes much of the time. Only with former = "dynamic-focus".
    focus_from_m: Number(from(0.0, 20_000.0)), Default("0.0"), only with former = "dynamic-focus";
}

table! {
    /// Protocols of this sonar, one table each.
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
    mcap: Table(samples::Mcap), Optional("");
    wav: Table(samples::Wav), Optional("");
}

table! {
    /// Teledyne RESON 7k over TCP and UDP.
    Sevenk;

    /// 7k device identifier: 7125 SeaBat 7125, 103 multibeam, 104 side-scan.
    id: Integer(1, u32::MAX as i64), Required("7125");

    /// Distinguishes heads with the same device identifier.
    enumerator: Integer(0, u16::MAX as i64), Default("0");

    /// Receive arrays whose elements fill record 7038, in this order. Default: all.
    arrays: Names, Shown("[\"rx\"]");

    /// Only this computer by default: the protocol has no password.
    listen: Text, Default("\"127.0.0.1:7000\"");

    /// Records of .s7k files. "common" leaves out records that common readers do not know: 7038, 7042, 7057 and 10038.
    file_records: Choice("all", "common"), Default("\"all\"");

    /// Longer records are split into packets of this length.
    max_packet_bytes: Integer(1024, 1 << 30), Default("60000");

    /// Queue of each client; records beyond it are dropped.
    client_queue_mib: Mib(1, 65_536), Default("64");

    /// A client whose queue is full misses whole records, or is disconnected.
    when_full: Choice("skip", "disconnect"), Default("\"skip\"");

    /// Addresses, separated by commas. With command 1053 a client may send records to them, besides its own address.
    third_parties: Text, Optional("\"192.168.1.20\"");
    max_clients: Integer(1, 1000), Default("8");
}

//! Summary of the derived quantities of a rig, as text.

mod families;
mod instrument;
mod nav;
mod outputs;
mod rates;
mod verdict;

pub use verdict::{Finding, FindingKind, findings};

use std::fmt::{self, Write};

use super::check::density::Estimate;
use super::check::sonar::{MAX_PLATFORM_SPEED_M_PER_S, max_doppler_hz, min_sample_rate_hz};
use glam::DVec3;

use super::spec::*;
use echotank_core::arrays::{ArrayGeometry, Pattern, Receiver, ReceiverFilter, TimeVaryingGain};
use echotank_core::frames::rotation_from_angles;
use echotank_core::model::{DopplerModel, PathModel, Synthesis};
use echotank_core::pulse::PulseKind;

/// Tilt of the platform in the sign test, degrees.
const SIGN_TEST_DEG: f64 = 10.0;

/// -3 dB beam width of a uniform line, in units of wavelength over length: sinc^2(0.443) = 1/2.
const BEAMWIDTH: f64 = 0.886;
/// Pause between listening window and next pulse, seconds. Equal to `ping::TURNAROUND_S`, which this crate cannot import.
const TURNAROUND_S: f64 = 1e-3;
/// Width of the column of names.
const LABEL: usize = 12;

/// Derived quantities of a rig, one per line, with notes on unusual settings.
pub fn summary(rig: &RigSpec) -> String {
    let mut text = String::new();
    write_rig(&mut text, rig).expect("a String takes everything");
    text
}

/// What surface and bottom do, if anything.
fn boundaries(medium: &MediumSpec) -> Option<String> {
    let echoes = medium.multipath.as_ref().map(|multipath| {
        let second = match multipath.surface_bottom {
            true => " and by surface and bottom",
            false => "",
        };
        format!("echoes by the surface{second}")
    });
    let surface = medium.surface.as_ref();
    let scattering = surface.and_then(|surface| surface.scattering.as_ref());
    let scattering = scattering.map(|scattering| match scattering.waves {
        true => "the surface scatters and moves".to_owned(),
        false => "the surface scatters".to_owned(),
    });
    let wind = surface.map(|surface| match surface.wind_from_rad {
        None => format!("wind {} m/s", surface.wind_m_per_s),
        Some(from_rad) => {
            let from_deg = from_rad.to_degrees();
            format!("wind {} m/s from {from_deg:.0} deg", surface.wind_m_per_s)
        }
    });
    let heights = surface.is_some_and(|surface| surface.heights);
    let heights = heights.then(|| "waves lift the surface".to_owned());
    let words: Vec<_> = [wind, scattering, echoes, heights]
        .into_iter()
        .flatten()
        .collect();
    (!words.is_empty()).then(|| words.join(", "))
}

fn write_rig(out: &mut String, rig: &RigSpec) -> fmt::Result {
    let c = rig.medium.sound_speed_m_per_s;
    let absorption = match rig.medium.absorption {
        AbsorptionSpec::None => "none".to_owned(),
        AbsorptionSpec::Fixed { db_per_m } => format!("{} dB/km", db_per_m * 1e3),
        AbsorptionSpec::FrancoisGarrison(water) => format!("Francois-Garrison, {}", words(&water)),
        AbsorptionSpec::AinslieMcColm(water) => format!("Ainslie-McColm, {}", words(&water)),
    };
    let speed = match &rig.medium.profile {
        None => format!("{c} m/s"),
        Some(profile) => {
            let (low, high) = profile.range_m_per_s();
            let points = profile.points();
            let deepest_m = points.last().map_or(0.0, |point| point.0);
            format!(
                "{low} to {high} m/s, a profile of {} points down to {deepest_m} m",
                points.len()
            )
        }
    };
    line(out, "medium", &format!("{speed}, absorption {absorption}"))?;
    if let Some(words) = boundaries(&rig.medium) {
        line(out, "boundaries", &words)?;
    }
    if let Some(volume) = &rig.medium.volume {
        let layers = volume.layers.iter();
        let layers = layers.map(|l| format!("{} dB from {} to {} m", l.sv_db, l.top_m, l.bottom_m));
        let layers: Vec<String> = layers.collect();
        line(out, "volume", &format!("Sv {}", layers.join(", ")))?;
    }
    let mode = match rig.nav.mode {
        NavMode::Settle => "settle: pings wait for measurements on both sides",
        NavMode::Predict => "predict: pings are extrapolated to",
    };
    line(out, "nav", mode)?;
    for source in &rig.nav.sources {
        let input = match &source.input {
            NavInputSpec::Log { path, .. } | NavInputSpec::Csv { path } => {
                path.display().to_string()
            }
            NavInputSpec::Udp { listen, .. } => format!("UDP {listen}"),
            NavInputSpec::Serial { port, baud, line } => {
                format!("{port} at {baud} Bd {}", line.name())
            }
            NavInputSpec::TcpConnect { address } => format!("TCP server {address}"),
            NavInputSpec::TcpListen { listen } => format!("TCP clients on {listen}"),
        };
        let names: Vec<_> = source.provides.iter().map(|c| c.name()).collect();
        let gives = match (source.detect, names.is_empty()) {
            (true, _) if source.is_recorded() => "provides the quantities found in it".to_owned(),
            (true, _) => "provides the quantities it sends".to_owned(),
            (false, true) => "provides nothing".to_owned(),
            (false, false) => format!("provides {}", names.join(", ")),
        };
        line(out, "", &format!("{}: {input}; {gives}", source.name))?;
        if source.lever_arm_m != DVec3::ZERO {
            let what = match source.provides.contains(&NavChannel::Position) {
                true => "antenna",
                false => "sensor",
            };
            let text = format!("{}: {what} {}", source.name, tilted(source.lever_arm_m));
            line(out, "  signs", &text)?;
        }
        nav::write_mounting(out, source)?;
    }
    nav::write_rest(out, &rig.nav)?;
    line(out, "scene", &scene(rig))?;
    let threads = match rig.run.threads {
        0 => "a thread per core".to_owned(),
        n => format!("{n} threads"),
    };
    let latency_ms = rig.run.latency_s * 1e3;
    let text = format!("{threads}, delivery {latency_ms} ms after each listening window");
    line(out, "run", &text)?;
    if let DeliverySpec::Streaming { block_s, latency_s } = rig.run.delivery {
        let tiles = match rig.run.stream_tiles {
            true => ", tile by tile",
            false => "",
        };
        let text = format!(
            "element samples stream in blocks of {} ms, each {} ms after its end: the first {} ms after the pulse; pings are computed {} ms ahead{tiles}",
            block_s * 1e3,
            latency_s * 1e3,
            (block_s + latency_s) * 1e3,
            rig.run.ahead_s * 1e3
        );
        line(out, "", &text)?;
    }
    if let Some(record) = &rig.record {
        line(out, "record", &record.directory.display().to_string())?;
    }
    let mut notes = Vec::new();
    for sonar in &rig.sonars {
        write_sonar(out, sonar, c, &mut notes)?;
    }
    for note in notes {
        line(out, "note", &note)?;
    }
    Ok(())
}

fn mbit_per_s(bytes_per_s: f64) -> f64 {
    bytes_per_s * 8.0 / 1e6
}

fn line(out: &mut String, label: &str, text: &str) -> fmt::Result {
    writeln!(out, "{label:LABEL$} {text}")
}

fn words(water: &Water) -> String {
    format!(
        "{} C, salinity {}, {} m deep, pH {}",
        water.temperature_c, water.salinity, water.depth_m, water.ph
    )
}

fn scene(rig: &RigSpec) -> String {
    let scene = &rig.scene;
    let mut parts = Vec::new();
    if let Some(seabed) = &scene.seabed {
        let shape = match &seabed.shape {
            SeabedShape::Plane { depth_m, .. } => format!("plane {depth_m} m deep"),
            SeabedShape::File { file, .. } => file.path.display().to_string(),
            SeabedShape::Paper(shape) => shape.name().to_owned(),
        };
        let mirrored = if scene.mirror { " mirrored" } else { "" };
        let density = match seabed.density {
            Density::PerM2(n) => format!("{n} scatterers/m^2"),
            Density::Auto {
                per_cell,
                cell,
                lobes,
                ..
            } => {
                let depth_m = match seabed.shape {
                    SeabedShape::Plane { depth_m, .. } => Some(depth_m),
                    _ => None,
                };
                let c = rig.medium.sound_speed_m_per_s;
                let Estimate {
                    scatterers,
                    kurtosis: [open, shadow],
                } = Estimate::new(&rig.sonars, c, depth_m, lobes);
                format!(
                    "{per_cell} scatterers in {:.1} cm x {:.2} degrees, in side lobes {lobes} times their relative pressure (about {:.0},000 a ping; kurtosis {open:.2}, in a shadow {shadow:.2})",
                    cell.range_m * 1e2,
                    cell.beam_rad.to_degrees(),
                    (scatterers / 1e3).max(1.0),
                )
            }
        };
        let bottom = match &seabed.bottom {
            BottomSpec::BistaticLambert { mu_db } => format!("Lambert {mu_db} dB"),
            BottomSpec::Lambert { mu_db } => format!("Lambert of the incoming ray {mu_db} dB"),
            BottomSpec::Sediment(s) => s.name().to_owned(),
            BottomSpec::ThreeTerm(t) => format!(
                "three terms {:.1} dB over {:.1} degrees, Lambert {} dB, {} dB over {:.1} degrees",
                t.specular_db,
                t.specular_rad.to_degrees(),
                t.lambert_db,
                t.intermediate_db,
                t.intermediate_rad.to_degrees()
            ),
        };
        parts.push(format!("{shape}{mirrored}, {density}, {bottom}"));
    }
    for (what, path) in [("points", &scene.points), ("targets", &scene.targets)] {
        if let Some(path) = path {
            parts.push(format!("{what} {}", path.display()));
        }
    }
    if let Some(simplify) = &scene.simplify {
        parts.push(format!(
            "{} of them by {}",
            simplify.keep,
            simplify.method.name()
        ));
    }
    match parts.is_empty() {
        true => "empty".to_owned(),
        false => parts.join("; "),
    }
}

/// Rates, lengths and sizes of one sonar at its initial settings.
struct Derived {
    wavelength_m: f64,
    window_s: f64,
    samples: f64,
    /// The set ping rate, or the maximum that the range allows if that is lower.
    ping_rate_hz: f64,
    longest_rate_hz: f64,
}

impl Derived {
    fn of(sonar: &SonarSpec, c: f64) -> Self {
        let settings = &sonar.settings;
        let window_s = 2.0 * settings.range_m / c + settings.pulse_duration_s;
        let longest_rate_hz = 1.0 / (window_s + TURNAROUND_S);
        Self {
            wavelength_m: c / sonar.pulse.center_frequency_hz,
            window_s,
            samples: (window_s * sonar.receiver.sample_rate_hz).ceil(),
            ping_rate_hz: settings.max_ping_rate_hz.min(longest_rate_hz),
            longest_rate_hz,
        }
    }
}

fn write_sonar(
    out: &mut String,
    sonar: &SonarSpec,
    c: f64,
    notes: &mut Vec<String>,
) -> fmt::Result {
    let d = Derived::of(sonar, c);
    let (pulse, settings) = (&sonar.pulse, &sonar.settings);
    let elements: usize = sonar.receive.iter().map(|a| a.elements).sum();
    let text = format!(
        "\"{}\", {elements} elements in {} receive arrays, {} transmit arrays",
        sonar.name,
        sonar.receive.len(),
        sonar.transmit.len()
    );
    line(out, "sonar", &text)?;
    let (kind, resolution_m) = match pulse.kind {
        PulseKind::Cw => ("CW", c * pulse.duration_s / 2.0),
        PulseKind::LfmUp => ("LFM up", c / (2.0 * pulse.bandwidth_hz)),
        PulseKind::LfmDown => ("LFM down", c / (2.0 * pulse.bandwidth_hz)),
    };
    let text = format!(
        "{kind} {} kHz, B {} kHz, T {} ms, BT {:.0}; wavelength {:.2} mm, range resolution {:.1} cm",
        pulse.center_frequency_hz / 1e3,
        pulse.bandwidth_hz / 1e3,
        pulse.duration_s * 1e3,
        pulse.bandwidth_hz * pulse.duration_s,
        d.wavelength_m * 1e3,
        resolution_m * 1e2,
    );
    line(out, "  pulse", &text)?;
    let text = format!(
        "range {} m: window {:.1} ms, at most {:.2} pings/s; configured {:.2}, used {:.2}; {:.0} samples per element and ping",
        settings.range_m,
        d.window_s * 1e3,
        d.longest_rate_hz,
        settings.max_ping_rate_hz,
        d.ping_rate_hz,
        d.samples
    );
    line(out, "  ping", &text)?;
    line(out, "  receiver", &receiver(sonar, c))?;
    let text = format!(
        "source level {} dB, gain {} dB, {}",
        settings.source_level_db,
        settings.gain_db,
        gain(&sonar.receiver, settings.range_m)
    );
    line(out, "  gain", &text)?;
    instrument::write(out, sonar)?;
    write_arrays(out, sonar, d.wavelength_m)?;
    write_beams(out, sonar)?;
    line(out, "  model", &model(sonar))?;
    write_outputs(out, sonar, &d)?;
    note_surprises(sonar, &d, c, notes);
    Ok(())
}

fn receiver(sonar: &SonarSpec, c: f64) -> String {
    let receiver = &sonar.receiver;
    let min_hz = min_sample_rate_hz(&sonar.pulse, sonar.limits.pulse_duration_s.0, c);
    let doppler_hz = max_doppler_hz(&sonar.pulse, c);
    let filter = match receiver.filter {
        ReceiverFilter::None => "no filter",
        ReceiverFilter::Fir => "low-pass filter",
    };
    let noise = match receiver.noise_db {
        Some(db) => format!("noise {db:.1} dB re 1 uPa^2/Hz"),
        None => "no noise".to_owned(),
    };
    let converter = match receiver.adc_bits {
        Some(bits) => format!("{bits} bits for {} V", receiver.full_scale_v),
        None => "not quantised".to_owned(),
    };
    format!(
        "{} kHz (needs {:.2}; Doppler at {MAX_PLATFORM_SPEED_M_PER_S} m/s is {doppler_hz:.0} Hz), {filter}, {noise}, {converter}",
        receiver.sample_rate_hz / 1e3,
        min_hz / 1e3,
    )
}

fn gain(receiver: &Receiver, range_m: f64) -> String {
    match &receiver.tvg {
        TimeVaryingGain::None => "no TVG".to_owned(),
        TimeVaryingGain::Law {
            spreading, max_db, ..
        } => format!(
            "TVG {spreading} log r + 2 alpha r, at most {max_db} dB ({:.1} dB of spreading at {range_m} m)",
            spreading * range_m.max(1.0).log10()
        ),
        TimeVaryingGain::Table(rows) => format!("TVG table of {} rows", rows.len()),
    }
}

/// -3 dB beam width of an aperture of this length, degrees; 180 if the aperture is too short for a beam.
fn beamwidth_deg(wavelength_m: f64, length_m: f64) -> f64 {
    let sine = BEAMWIDTH * wavelength_m / length_m;
    if sine.is_finite() && sine < 2.0 {
        (2.0 * (sine / 2.0).asin()).to_degrees()
    } else {
        180.0
    }
}

fn pattern(pattern: &Pattern, wavelength_m: f64) -> String {
    match pattern {
        Pattern::Omnidirectional => "omnidirectional".to_owned(),
        Pattern::Rectangle {
            length_m, width_m, ..
        }
        | Pattern::Part {
            length_m, width_m, ..
        } => format!(
            "{:.1} x {:.1} deg",
            beamwidth_deg(wavelength_m, *length_m),
            beamwidth_deg(wavelength_m, *width_m)
        ),
    }
}

fn aperture_m(array: &ArrayGeometry) -> f64 {
    array.length_m()
}

fn write_arrays(out: &mut String, sonar: &SonarSpec, wavelength_m: f64) -> fmt::Result {
    for (name, array) in sonar.transmit_names.iter().zip(&sonar.transmit) {
        let pattern = pattern(&array.pattern, wavelength_m);
        let text = format!("{name}: {pattern} (along x, along y)");
        line(out, "  transmit", &text)?;
    }
    for (name, array) in sonar.receive_names.iter().zip(&sonar.receive) {
        let arc = array.radius_m.map_or(String::new(), |radius_m| {
            let degrees = 2.0 * array.half_arc_rad().to_degrees();
            format!(" on an arc of {degrees:.0} deg, radius {radius_m} m,")
        });
        let text = format!(
            "{name}: {} elements{arc} every {:.2} mm ({:.2} wavelengths), together {:.2} deg, each {}",
            array.elements,
            array.spacing_m * 1e3,
            array.spacing_m / wavelength_m,
            beamwidth_deg(wavelength_m, aperture_m(array)),
            pattern(&array.element_pattern, wavelength_m),
        );
        line(out, "  receive", &text)?;
    }
    write_signs(out, sonar)
}

/// Displacement of a body point when the platform rolls and pitches.
fn tilted(at: DVec3) -> String {
    let tilt_rad = SIGN_TEST_DEG.to_radians();
    let moves = |roll_rad: f64, pitch_rad: f64| {
        let down_m = (rotation_from_angles(roll_rad, pitch_rad, 0.0) * at).z - at.z;
        match down_m {
            d if d > 5e-4 => format!("sinks {d:.3} m"),
            d if d < -5e-4 => format!("rises {:.3} m", -d),
            _ => "keeps its depth".to_owned(),
        }
    };
    format!(
        "at {:.3} m forward, {:.3} starboard, {:.3} down; roll +{SIGN_TEST_DEG} deg (starboard down): {}; pitch +{SIGN_TEST_DEG} deg (bow up): {}",
        at.x,
        at.y,
        at.z,
        moves(tilt_rad, 0.0),
        moves(0.0, tilt_rad)
    )
}

/// Effect of roll and pitch on each array. It reveals a wrong sign or an exchanged axis.
fn write_signs(out: &mut String, sonar: &SonarSpec) -> fmt::Result {
    let transmit = sonar.transmit_names.iter().zip(&sonar.transmit);
    let receive = sonar.receive_names.iter().zip(&sonar.receive);
    let arrays = transmit
        .map(|(name, a)| (name, a.mounting))
        .chain(receive.map(|(name, a)| (name, a.mounting)));
    for (name, mounting) in arrays {
        let looks = mounting.body_from_array * DVec3::Z;
        let text = format!(
            "{name} faces ({:.2}, {:.2}, {:.2}) forward, starboard, down; {}",
            looks.x,
            looks.y,
            looks.z,
            tilted(mounting.position_m)
        );
        line(out, "  signs", &text)?;
    }
    Ok(())
}

fn write_beams(out: &mut String, sonar: &SonarSpec) -> fmt::Result {
    for line_spec in &sonar.beams.lines {
        let side = line_spec.side.word();
        let name = &sonar.receive_names[line_spec.array];
        line(out, "  line", &format!("{side} from {name}"))?;
    }
    if let Some(fan) = &sonar.beams.fan {
        let step_deg = fan.sector_rad.to_degrees() / (fan.beams.max(2) - 1) as f64;
        let text = format!(
            "{} beams over {:.1} deg from {}, every {step_deg:.2} deg",
            fan.beams,
            fan.sector_rad.to_degrees(),
            sonar.receive_names[fan.array],
        );
        line(out, "  fan", &text)?;
    }
    Ok(())
}

fn model(sonar: &SonarSpec) -> String {
    let (model, auto) = (&sonar.model, sonar.synthesis.auto);
    let path = match model.path {
        _ if auto.path => "path auto".to_owned(),
        PathModel::StopAndHop | PathModel::Continuous => model.path.name().to_owned(),
        PathModel::Polyline | PathModel::KSegment => {
            format!("{} of {} ms", model.path.name(), model.segment_s * 1e3)
        }
    };
    let doppler = match model.doppler {
        _ if auto.doppler => "Doppler auto".to_owned(),
        DopplerModel::None => "no Doppler".to_owned(),
        other => format!("Doppler {}", other.name()),
    };
    let cull = match model.cull_db {
        Some(_) if sonar.synthesis.culls_by_window => "culled by window".to_owned(),
        Some(db) => format!("scatterers below {db} dB left out"),
        None => "no scatterer left out".to_owned(),
    };
    let error_check = match sonar.synthesis.error_check {
        true => format!(", checked against {:.0e}", sonar.synthesis.tolerance),
        false => String::new(),
    };
    match model.synthesis {
        Synthesis::Reference => format!("reference, {cull}{error_check}"),
        other => {
            let within = match other.keeps_tolerance() || auto.synthesis {
                true => format!(" within {:.0e}", sonar.synthesis.tolerance),
                false => String::new(),
            };
            format!(
                "{}{within}, {path}, {doppler}, {cull}{error_check}",
                match auto.synthesis {
                    true => "auto",
                    false => other.name(),
                }
            )
        }
    }
}

fn write_outputs(out: &mut String, sonar: &SonarSpec, d: &Derived) -> fmt::Result {
    for all in &sonar.outputs {
        let OutputSpec::SevenK(output) = all else {
            families::write(out, sonar, d, all)?;
            outputs::write(out, sonar, d, all)?;
            continue;
        };
        let [of_elements, of_beams] = rates::bytes_per_s(sonar, d, all).map(mbit_per_s);
        let beams = match &sonar.beams.fan {
            Some(_) => format!(", beams (7018) {of_beams:.2} Mbit/s"),
            None => String::new(),
        };
        let text = format!(
            "TCP {}, device {}.{}; elements (7038) {of_elements:.2} Mbit/s{beams} to each client that asks",
            output.listen, output.device_id, output.enumerator,
        );
        line(out, "  7k", &text)?;
    }
    Ok(())
}

fn note_surprises(sonar: &SonarSpec, d: &Derived, c: f64, notes: &mut Vec<String>) {
    let name = &sonar.name;
    if sonar.settings.max_ping_rate_hz > d.longest_rate_hz {
        notes.push(format!(
            "{name}: the range of {} m is too long for {:.2} pings/s; the rate is reduced to {:.2}",
            sonar.settings.range_m, sonar.settings.max_ping_rate_hz, d.longest_rate_hz
        ));
    }
    let longest_window_s = 2.0 * sonar.limits.range_m.1 / c + sonar.limits.pulse_duration_s.1;
    let slowest_rate_hz = 1.0 / (longest_window_s + TURNAROUND_S);
    if sonar.limits.range_m.1 > sonar.settings.range_m
        && sonar.settings.max_ping_rate_hz > slowest_rate_hz
    {
        notes.push(format!(
            "{name}: at the longest range allowed, {} m, the rate is reduced to {:.2} pings/s",
            sonar.limits.range_m.1, slowest_rate_hz
        ));
    }
    for output in &sonar.outputs {
        let OutputSpec::SevenK(output) = output else {
            continue;
        };
        if !output.listen.ip().is_loopback() {
            notes.push(format!(
                "{name}: {} can be reached from other computers, and 7k knows no password",
                output.listen
            ));
        }
    }
}
